"""Errors of images of boxes in directions that move: loops whose images are known in rationals, by both programs' rule.

A trajectory of x+ = A x + g q + s, with another q in [-1, 1] in each step, is c + R d + A^(k-1) g q_1 + ... + g q_k
after k steps from a box with symbols d. What is held against it is exact, so that roundings must be in the bounds too.
"""

from __future__ import annotations

import itertools
import json
import math
import random
from collections.abc import Iterable
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from flint import arb, ctx

from certify.checker import document
from certify.checker.case import Case
from certify.checker.ranks import Course, Steps
from certify.reference.balls import total
from certify.reference.directions import orthogonal
from certify.reference.document import read
from certify.reference.evidence import Ranked
from certify.reference.leaves import Box
from certify.reference.ranks import Rows, Walk
from certify.reference.refusal import Refused
from tests.support.marks import slow_after
from tests.support.rank_forgeries import verdicts
from tests.support.ranked import Document, Loop, affine, around_level, dumped, encode, two_bytes

Vector = list[Fraction]
Truth = tuple[Vector, list[Vector], list[Vector]]
NAMES = ("x", "y", "z")
LOOPS: dict[str, tuple[list[str], str]] = {  # the rows of A, one after the other, and g
    "turn": (["3/5", "-4/5", "4/5", "3/5"], "1 0"),
    "slow turn": (["1599/1601", "-80/1601", "80/1601", "1599/1601"], "1/3 -1/7"),
    "shear": (["1", "1/3", "0", "1"], "0 1"),
    "contraction": (["1/2", "1/3", "-1/9", "1/3"], "1 1"),
    "stretch": (["7/3", "1/10", "1/10", "1/3"], "1/3 1"),
    "swap": (["0", "1", "1", "0"], "1 0"),
    "one state is set": (["0", "0", "1", "1/3"], "0 1/3"),
    "both are alike": (["1/3", "2/3", "1/3", "2/3"], "1 0"),
    "nilpotent": (["0", "1/3", "0", "0"], "1/3 1"),
    "all is set": (["0", "0", "0", "0"], "1/3 1/7"),
    "nothing moves": (["1", "0", "0", "1"], "1/7 1/3"),
    "roundings alone": (["3/5", "-4/5", "4/5", "3/5"], "0 0"),
    "roundings of a shear": (["1", "1/3", "0", "1"], "0 0"),
    "a screw": (["3/5", "-4/5", "0", "4/5", "3/5", "0", "0", "1/3", "1"], "0 1/3 1"),
    "a line": (["-9/10"], "1/3"),
}
FRAMES: dict[int, list[list[list[float]] | None]] = {
    1: [None, [[-3.0]]],
    2: [None, [[1.0, 0.5], [-3.0, 2.0]], [[1000003.0, 1e6], [1e6, 999999.0]]],  # the last has rows that are alike
    3: [None, [[0.0, 0.0, 3.0], [1.0, 2.0, 0.5], [-1.0, 0.25, 0.0]]],
}


@dataclass
class Linear:
    """x+ = A x + g q + s from centre + radius d."""

    A: list[Vector]
    g: Vector
    s: Vector
    lo: list[float]
    hi: list[float]

    def loop(self, target: list[Any] | None = None, **more: Any) -> Loop:
        n = len(self.A)
        rows = [[["*", str(a), x] for a, x in zip(row, NAMES, strict=False)] for row in self.A]
        dynamics = [["+", *row, ["*", str(g), "q"], str(s)] for row, g, s in zip(rows, self.g, self.s, strict=True)]
        more = {
            "uncertain": [("q", "-1", "1")],
            "domain": ("-999999999999999", "999999999999999"),
            "most": 65_534,
        } | more
        return Loop(dynamics, [affine([[0.0] * n])], target or [["-", "x", "999"]], NAMES[:n], **more)

    def document(self, k: int, target: list[Any] | None = None, **more: Any) -> Document:
        return self.loop(target, **more).document(self.lo, self.hi, b"\xff", two_bytes([k]), two_bytes([k]))

    def after(self, k: int) -> tuple[Vector, list[Vector], list[Vector]]:
        """The centre, and columns of coefficients of d and of all q."""
        n = len(self.A)
        ends = [(Fraction(a), Fraction(b)) for a, b in zip(self.lo, self.hi, strict=True)]
        centre = [(a + b) / 2 for a, b in ends]
        columns = [[(b - a) / 2 if i == j else Fraction(0) for i in range(n)] for j, (a, b) in enumerate(ends)]
        errors = list[Vector]()
        for _ in range(k):
            centre = [v + s for v, s in zip(times(self.A, centre), self.s, strict=True)]
            columns, errors = [times(self.A, v) for v in columns], [self.g, *(times(self.A, v) for v in errors)]
        return centre, columns, errors

    def most(self, k: int, i: int) -> Fraction:
        """The largest x_i after k steps."""
        centre, columns, errors = self.after(k)
        return centre[i] + sum(abs(v[i]) for v in (*columns, *errors))


def times(A: list[Vector], v: Vector) -> Vector:
    return [dot(row, v) for row in A]


def linear(name: str, wide: float = 0.125) -> Linear:
    entries, g = LOOPS[name]
    n = len(g.split())
    A = [[Fraction(v) for v in entries[n * i : n * i + n]] for i in range(n)]
    s = [Fraction(1, 3), Fraction(0), Fraction(-1, 11)][:n]
    return Linear(A, [Fraction(v) for v in g.split()], s, [0.5] * n, [0.5 + wide] * n)


def moving(data: Document) -> Document:
    data["evidence"]["ranks"]["moving"] = True
    return data


# --------------------------------------------------------------------------------------------------------- the images


def exactly(v: arb) -> Fraction:
    man, exp = v.mid().man_exp()
    return Fraction(int(man)) * Fraction(2) ** int(exp)


def walked(data: Document, steps: int) -> list[Rows]:
    """The forms of the one leaf of a document after each step."""
    c = read(dumped(data))
    assert isinstance(c.evidence, Ranked)
    ranking = c.evidence.ranking
    walk, found = Walk(c, c.evidence.order, ranking), []
    rows = walk.start(Box(0, list(ranking.lo), list(ranking.hi)))
    for _ in range(steps):
        (rows,) = walk.step(rows, "here", *walk.inputs([rows]))
        found.append(rows)
    return found


def known(data: Document, steps: int) -> list[tuple[list[Vector], Vector]]:
    """The checker's forms, exactly, and the bounds of their errors, as long as these are finite."""
    found = list[tuple[list[Vector], Vector]]()
    with np.errstate(all="ignore"):
        walk = Steps(Case(document.certificate(json.loads(dumped(data)), "0" * 64)))
        ranking = walk.c.ranks
        x = walk.start(ranking.lo[:, None], ranking.hi[:, None])
        for _ in range(steps):
            x, _ = walk.step(x, np.arange(1), Course())
            if not np.all(np.isfinite(x.value)) or not np.all(np.isfinite(x.error.top)):
                break
            rows = [[Fraction(v) for v in row] for row in x.value[:, :, 0].T.tolist()]
            found.append((rows, [Fraction(v) for v in x.error.top[:, 0].tolist()]))
    return found


def along(v: Vector, each: Iterable[Vector]) -> Fraction:
    """The sum of magnitudes of products with v."""
    return sum((abs(dot(v, w)) for w in each), Fraction(0))


def dot(v: Vector, w: Vector) -> Fraction:
    return sum((a * b for a, b in zip(v, w, strict=True)), Fraction(0))


def away(v: Vector, stays: list[Vector], truth: Truth) -> Fraction:
    """How far what is true goes beyond the part of a form in 1 and d, along v."""
    centre, columns, errors = truth
    both = zip([centre, *columns], zip(*stays, strict=True), strict=True)
    return along(v, [[p - q for p, q in zip(*pair, strict=True)] for pair in both] + errors)


def loose(v: Vector, rows: Rows, truth: Truth) -> tuple[Fraction, Fraction]:
    """The same of a form of balls, and how far it lets it."""
    n = len(v)
    bounds = zip(*(row[n + 1 :] for row in rows), strict=True)
    allowed = [abs(total(arb(int(a)) * x for a, x in zip(v, each, strict=True))).upper() for each in bounds]
    stays = [[exactly(x) for x in row[: n + 1]] for row in rows]
    return away(v, stays, truth), sum(map(exactly, allowed), Fraction(0))


@pytest.mark.parametrize("memory", slow_after(1, [3, 1]))
@pytest.mark.parametrize("name", LOOPS)
def test_images_hold_all_that_is_true(name: str, memory: int) -> None:
    """In many directions, of integers, without any tolerance."""
    loop, chance = linear(name), random.Random(3)
    n = len(loop.A)
    ways = [[Fraction(int(i == j)) for j in range(n)] for i in range(n)]
    ways += [[Fraction(chance.randint(-9, 9)) for _ in range(n)] for _ in range(6)]
    for frame in FRAMES[n]:
        data = loop.document(7, frame=frame, memory=memory, moving=True)
        rows_too = [[Fraction(v) for v in row] for row in frame or [] if all(v == int(v) for v in row)]
        with ctx.workprec(64):
            for k, (rows, (other, error)) in enumerate(zip(walked(data, 7), known(data, 7), strict=True), 1):
                truth = loop.after(k)
                for v in ways + rows_too:
                    true, allowed = loose(v, rows, truth)
                    assert true <= allowed, (frame, k, v)
                    bounds = along(v, zip(*(row[n + 1 :] for row in other), strict=True))
                    more = dot([abs(a) for a in v], error)
                    assert away(v, [row[: n + 1] for row in other], truth) <= bounds + more, (frame, k, v)


@pytest.mark.parametrize("memory", [1, 3])
@pytest.mark.parametrize("name", ["turn", "contraction", "stretch", "a screw"])
def test_both_programs_have_the_same_directions(name: str, memory: int) -> None:
    """Where no errors are roundings alone, whose columns are as long as others."""
    loop = linear(name)
    loop.g = [g + Fraction(1, 13) for g in loop.g]
    for frame in FRAMES[len(loop.A)][:2]:
        data = loop.document(7, frame=frame, memory=memory, moving=True)
        with ctx.workprec(64):
            each = zip(walked(data, 7), known(data, 7), strict=True)
            for balls, (rows, _) in each:
                for row, other in zip(balls, rows, strict=True):
                    most = max(map(abs, other))
                    assert all(abs(exactly(v) - w) <= most / 10**9 for v, w in zip(row, other, strict=True))


def of_no_use(chance: np.random.Generator, n: int, kind: str) -> Any:
    """A matrix that is not orthogonal, or not one of numbers."""
    Q = np.linalg.qr(chance.standard_normal((n, n)))[0]
    if kind == "near":
        return Q + 1e-3 * chance.standard_normal((n, n))
    if kind == "far":
        return Q @ np.diag([0.75, 1.2, 0.9][:n]) + 0.03 * chance.standard_normal((n, n))
    if kind == "any":
        return chance.standard_normal((n, n))
    if kind == "singular":
        return Q * np.array([0.0, 1.0, 1.0])[:n]
    Q[0, 0] = np.nan
    return Q


@pytest.mark.parametrize("kind", ["near", "far", "any", "singular", "nan"])
def test_nothing_is_believed_of_the_directions(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Images hold what is true, or none are known, whatever is taken for the directions."""
    chance, found = np.random.default_rng(3), 0
    for name, memory in itertools.product(("turn", "contraction", "one state is set", "a screw", "a line"), (1, 2)):
        loop = linear(name)
        n = len(loop.A)
        ways = [[Fraction(int(i == j)) for j in range(n)] for i in range(n)]
        ways += [[Fraction(int(a)) for a in chance.integers(-9, 10, n)] for _ in range(4)]
        with monkeypatch.context() as patch, ctx.workprec(64):
            Q = [of_no_use(chance, n, kind) for _ in range(3)]
            data = loop.document(3, memory=memory, moving=True)
            once, again = iter(Q), iter(Q)
            patch.setattr("certify.reference.directions.orthogonal", lambda columns, some=once: next(some).tolist())
            patch.setattr(np.linalg, "qr", lambda columns, some=again: (next(some)[None], np.abs(columns)))
            try:
                balls = walked(data, 3)
            except Refused:
                balls = []
            rows = known(data, 3)
        for k in range(3):
            for v in ways:
                if balls:
                    with ctx.workprec(64):
                        true, allowed = loose(v, balls[k], loop.after(k + 1))
                    assert true <= allowed
                if k < len(rows):
                    other, error = rows[k]
                    bounds = along(v, zip(*(row[n + 1 :] for row in other), strict=True))
                    more = dot([abs(a) for a in v], error)
                    assert away(v, [row[: n + 1] for row in other], loop.after(k + 1)) <= bounds + more
        found += len(balls) + len(rows)
    assert (found > 0) == (kind not in ("singular", "nan"))


@pytest.mark.parametrize("memory", [1, 2])
def test_a_frame_is_that_in_which_errors_are_boxes(memory: int) -> None:
    """x+ = N^-1 L N x + N^-1 q e_1 with L that swaps: each N x is reached to its corners, and no image is larger."""
    N, swap = [[1.0, 3.0], [-1.0, 1.0]], [[Fraction(0), Fraction(1)], [Fraction(1), Fraction(0)]]
    exact, back = [[Fraction(v) for v in row] for row in N], [[Fraction(1, 4), Fraction(-3, 4)], [Fraction(1, 4)] * 2]
    A = matrix_product(back, matrix_product(swap, exact))
    loop = Linear(A, [row[0] for row in back], [Fraction(0)] * 2, [0.5, 0.5], [0.625, 0.625])
    data = loop.document(6, frame=N, memory=memory, moving=True)
    with ctx.workprec(64):
        for k, rows in enumerate(walked(data, 6), 1):
            for v in exact:
                true, allowed = loose(v, rows, loop.after(k))
                assert true <= allowed <= true * (1 + Fraction(1, 2**16)) + LITTLE


def matrix_product(A: list[Vector], B: list[Vector]) -> list[Vector]:
    return [[dot(row, list(column)) for column in zip(*B, strict=True)] for row in A]


@pytest.mark.parametrize("memory", [None, 3])
@pytest.mark.parametrize("k", [1, 2, 4])
def test_products_with_what_is_uncertain(k: int, memory: int | None) -> None:
    """x+ is one half of a turn, and q times another matrix: the corners of all q are the truth, d and q are factors."""
    turn, other = ["3/10", "-2/5", "2/5", "3/10"], ["1/4", "1/8", "-1/3", "1/4"]
    (a, b, c, d), (e, f, g, h) = turn, other
    dynamics = [
        ["+", ["*", a, "x"], ["*", b, "y"], ["*", "q", ["+", ["*", e, "x"], ["*", f, "y"]]]],
        ["+", ["*", c, "x"], ["*", d, "y"], ["*", "q", ["+", ["*", g, "x"], ["*", h, "y"]]]],
    ]
    M, D = ([[Fraction(v) for v in part[i : i + 2]] for i in (0, 2)] for part in (turn, other))
    lo, hi = [0.5, -0.25], [1.5, 0.75]
    for i in range(2):
        most = Fraction(-9)
        for qs in itertools.product((-1, 1), repeat=k):
            for corner in itertools.product(*zip(lo, hi, strict=True)):
                x = [Fraction(v) for v in corner]
                for q in qs:
                    x = [p + q * r for p, r in zip(times(M, x), times(D, x), strict=True)]
                most = max(most, x[i])
        for bound, said in ((most - HAIR, "ranks"), (2 * most + 1, None)):
            target = [["-", NAMES[i], short(bound)]]
            loop = Loop(dynamics, [affine([[0.0, 0.0]])], target, NAMES[:2], uncertain=[("q", "-1", "1")])
            loop.memory, loop.moving = memory, True
            assert verdict(loop.document(lo, hi, b"\xff", two_bytes([k]), two_bytes([k]))) == said


def test_directions_that_turn_have_errors_that_only_add_up() -> None:
    """After 200 slow turns, along the axes: 2^1/2 times what is true, where axes that stay have 10,000 times."""
    loop = linear("slow turn")
    truth, ways = loop.after(200), ([Fraction(1), Fraction(0)], [Fraction(0), Fraction(1)])
    with ctx.workprec(64):
        still, moved = (walked(data, 200)[-1] for data in (loop.document(9), moving(loop.document(9))))
        for v in ways:
            true, allowed = loose(v, moved, truth)
            assert true <= allowed <= 1.45 * true and loose(v, still, truth)[1] > 1000 * true


def test_what_is_orthogonal_is_so_whatever_the_columns_are() -> None:
    chance = random.Random(1)
    for n in (1, 2, 3, 5) * 30:
        columns = [[chance.choice([0.0, 1.0, -0.5, 1e-300, chance.uniform(-1, 1)]) for _ in range(n)] for _ in range(n)]
        columns[-1] = chance.choice([columns[-1], columns[0], [0.0] * n])
        Q = orthogonal([list(v) for v in columns])
        for i, j in itertools.product(range(n), repeat=2):
            assert abs(sum(row[i] * row[j] for row in Q) - (i == j)) < 1e-14
            below = sum(row[i] * x for row, x in zip(Q, columns[j], strict=True))
            assert i <= j or abs(below) < 1e-14  # columns[j] is made of the first j + 1 columns of Q


# ------------------------------------------------------------------------------------------------------- the verdicts


HAIR, LITTLE = Fraction(1, 10**15), Fraction(1, 10**12)  # below what is true, and above it: one program rounds


def verdict(data: Document) -> str | None:
    """Both programs say the same."""
    checker, reference = verdicts(data)
    assert checker == reference
    return checker


def short(q: Fraction) -> str:
    """At most 10^-18 above q, with few digits."""
    return str(Fraction(math.ceil(q * 10**18), 10**18))


def verdicts_near(loop: Linear, k: int, i: int, over: Fraction, **more: Any) -> tuple[str | None, str | None]:
    """The verdicts on x_i <= b after k steps, for b a hair less than what x_i reaches, and `over` more than that."""
    most = loop.most(k, i)
    found = []
    for b in (most - HAIR, most + over):
        target = [["-", NAMES[i], short(b)]]
        found.append(verdict(moving(loop.document(k, target, **more))))
    return found[0], found[1]


@pytest.mark.parametrize("memory", [None, 3])
@pytest.mark.parametrize("k", slow_after(2, [7, 1, 40]))
@pytest.mark.parametrize("name", ["turn", "slow turn", "swap", "nothing moves", "a line"])
def test_targets_of_loops_that_only_turn(name: str, k: int, memory: int | None) -> None:
    """Each loop is at the end of its box after some step, and its bound within the 1-norms of all errors."""
    loop = linear(name, 2.0**-10)
    loop.g = [g / 10**6 for g in loop.g]
    for i in range(len(loop.A)):
        errors = sum(abs(x) for v in loop.after(k)[2] for x in v)
        assert verdicts_near(loop, k, i, errors + LITTLE, memory=memory) == ("ranks", None)


def test_axes_that_stay_are_refused_where_those_that_move_are_not() -> None:
    loop = linear("slow turn", 2.0**-10)
    loop.g = [g / 10**6 for g in loop.g]
    target = [["-", x, "20"] for x in NAMES[:2]]  # far from all that is true
    assert verdict(moving(loop.document(400, target))) is None
    assert verdict(loop.document(400, target)) == "ranks"


@pytest.mark.parametrize("memory", slow_after(1, [2, None, 4]))
@pytest.mark.parametrize("name", ["one state is set", "both are alike", "nilpotent", "all is set", "shear"])
def test_targets_after_steps_that_have_no_inverse_or_flatten(name: str, memory: int | None) -> None:
    """What is lost is at most twice the errors that have no symbols any more."""
    loop = linear(name)
    for i, k in itertools.product(range(2), (1, 2, 3, 6)):
        errors = loop.after(k)[2]
        lost = [v for j, v in enumerate(errors) if memory is None or j >= memory]
        over = 2 * sum((abs(x) for v in lost for x in v), LITTLE)
        assert verdicts_near(loop, k, i, over, memory=memory) == ("ranks", None)


HELD = Linear([[Fraction(31, 32), Fraction(7, 32)], [Fraction(-1, 4), Fraction(3, 4)]],
              [Fraction(1, 32), Fraction(1, 4)], [Fraction(0)] * 2, [0.5, -0.5], [0.625, -0.375])  # fmt: skip


@pytest.mark.parametrize("memory", [None, 2])
@pytest.mark.parametrize("k", [1, 3, 12])
def test_targets_with_held_inputs(k: int, memory: int | None) -> None:
    """x' = v, v' = u + q with u = -x - v, held for 1/4: the images are those of HELD where q is held too."""
    more = {"sample": ("1/4", "1/4"), "order": 2, "memory": memory}
    data = moving(HELD.document(k, **more))
    data["plant"]["dynamics"] = ["y", ["+", "u", "q"]]
    policy = HELD.loop(**more)
    policy.dynamics, policy.network = ["y", ["+", "u", "q"]], [affine([[-1.0, -1.0]])]
    for i in range(2):
        most = HELD.most(k, i)
        for b, said in ((most - HAIR, "ranks"), (2 * most + 1, None)):
            policy.target = [["-", NAMES[i], short(b)]]
            made = policy.document(HELD.lo, HELD.hi, b"\xff", two_bytes([k]), two_bytes([k]))
            assert verdict(moving(made)) == said


@pytest.mark.parametrize("steps", [1, 2, 5])
def test_jumps_have_directions_for_each_image(steps: int) -> None:
    """x+ turns to one side or, where y > 0, to the other; z counts, so that no image arrives too soon."""
    c, s = "3/5", ["*", "4/5", ["-", ["*", "2", ["heaviside", "y"]], "1"]]
    dynamics = [
        ["+", ["*", c, "x"], ["*", s, "y"], ["*", "1/9", "q"]],
        ["+", ["*", c, "y"], ["*", "-1", s, "x"], ["*", "-1/7", "q"]],
        ["+", "z", "1"],
    ]
    lo, hi = [0.5, -0.25, 0.0], [0.75, 0.5, 0.0625]
    chance, most = random.Random(steps), [Fraction(-9)] * 2
    for _ in range(300):
        x, y = (Fraction(chance.choice([a, b, chance.uniform(a, b)])) for a, b in zip(lo[:2], hi[:2], strict=True))
        for _ in range(steps):
            side = chance.choice([-1, 1]) if y == 0 else 1 if y > 0 else -1
            q, turn = chance.choice([-1, 1]), Fraction(4, 5) * side
            x, y = Fraction(3, 5) * x + turn * y + Fraction(q, 9), Fraction(3, 5) * y - turn * x - Fraction(q, 7)
        most = [max(most[0], x), max(most[1], y)]
    for memory, i in itertools.product((1, 3), range(2)):
        for b, said in ((most[i] - HAIR, "ranks"), (most[i] + Fraction(3, 2), None)):
            target = [["-", NAMES[i], short(b)], ["-", str(steps - Fraction(1, 2)), "z"]]
            loop = Loop(dynamics, [affine([[0.0] * 3])], target, NAMES, uncertain=[("q", "-1", "1")], memory=memory)
            data = loop.document(lo, hi, b"\xff", two_bytes([steps]), two_bytes([steps]))
            assert verdict(moving(data)) == said


# ----------------------------------------------------------------------------------------------------------- the format


@pytest.mark.parametrize("value", [False, 1, 1.0, 0, "true", "", None, [], [True], {}, {"true": True}])
def test_moving_is_true_or_is_not_there(value: Any) -> None:
    data = linear("turn").document(1)
    assert verdict(data) is None and verdict(moving(data)) is None
    data["evidence"]["ranks"]["moving"] = value
    assert verdict(data) == "format"


def test_moving_is_a_key_of_ranks_alone() -> None:
    for path in (("evidence",), ("claim",), ("claim", "ranks"), ("plant",), ("policy",), ()):
        data = moving(linear("turn").document(1))
        at: Any = data
        for key in path:
            at = at[key]
        at["moving"] = True
        assert verdict(data) == "format"


def test_moving_beside_V_and_where_no_target_is() -> None:
    data = linear("contraction").document(2)
    data["plant"]["dynamics"] = [["*", "1/2", "x"], ["*", "1/2", "y"]]
    data["claim"] = {k: v for k, v in data["claim"].items() if k != "target"} | {"kind": "remains"}
    data["evidence"]["ranks"] |= {"lo": encode(-1.0, -1.0), "hi": encode(1.0, 1.0)}
    assert verdict(moving(data)) is None
    data["plant"]["dynamics"] = [["*", "1/2", "x"], ["*", "9/8", "y"]]
    assert verdict(moving(data)) == "ranks"
    loop = Loop([["+", "x", "u"]], [affine([[-0.5]])], [["-", ["*", "x", "x"], "1/16"]])
    for end, said in ((0.4999, None), (0.51, "ranks")):
        alone = loop.document([-0.25], [end], b"\xff", two_bytes([1]), b"\1")
        assert verdict(moving(around_level(alone, 1.0, 1 / 16))) == said


@pytest.mark.parametrize("frame", [[[1.0, 2.0], [2.0, 4.0]], [[0.0, 0.0], [0.0, 0.0]]])
def test_a_frame_without_an_inverse_is_refused_as_ever(frame: list[list[float]]) -> None:
    assert verdict(moving(linear("turn").document(1, frame=frame))) == "ranks"
