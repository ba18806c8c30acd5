"""Frames of ranks: images that rationals know to the last digit, in both programs.

A loop x+ = N^-1 L N x + N^-1 w q turns N x by a matrix L of one entry s or -s a row and column, and adds an independent
number to each N x. So boxes in N x are reached up to their corners: what a program leaves out of them is a state that
some trajectory has.
"""

from __future__ import annotations

import json
import math
import random
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from flint import arb, ctx, fmpq, fmpq_mat

from certify.checker import document
from certify.checker.case import Case
from certify.checker.near import Above, Near
from certify.checker.ranks import Course, Steps, turned
from certify.checker.taylor import Taylor
from certify.reference.document import read
from certify.reference.evidence import Ranked
from certify.reference.leaves import Box
from certify.reference.ranks import Walk, ends
from tests.support.marks import slow_after
from tests.support.rank_forgeries import verdicts
from tests.support.ranked import Document, Loop, affine, dumped, encode, two_bytes

Matrix = list[list[Fraction]]
Ends = list[tuple[Fraction, Fraction]]  # of each state, after a step
WIDE = ("-1000000000", "1000000000")
GAP = 1e-11  # relative, more than the checker's rounding in a step


def times(row: Sequence[Fraction], column: Sequence[Fraction]) -> Fraction:
    return sum((a * b for a, b in zip(row, column, strict=True)), Fraction(0))


def product(A: Matrix, B: Matrix) -> Matrix:
    return [[times(row, column) for column in zip(*B, strict=True)] for row in A]


def inverse(A: Matrix) -> Matrix:
    found = fmpq_mat([[fmpq(v.numerator, v.denominator) for v in row] for row in A]).inv()
    return [[Fraction(int(v.p), int(v.q)) for v in row] for row in found.tolist()]


def identity(n: int) -> Matrix:
    return [[Fraction(int(i == j)) for j in range(n)] for i in range(n)]


@dataclass
class Turned:
    """x+ = M x + B q, the |q_k| at most 1, with the frame N that is given."""

    M: Matrix
    B: Matrix
    N: list[list[float]]
    lo: list[float]
    hi: list[float]

    @staticmethod
    def drawn(chance: random.Random, scale: int, whole: bool = False) -> Turned:
        """With rows of N times powers of 2 up to 2^scale; if `whole`, one where all but N^-1 is an integer."""
        n = chance.choice([1, 2, 2, 3, 4])
        N = [[Fraction(chance.randint(-4, 4)) for _ in range(n)] for _ in range(n)]
        try:
            back = inverse(N)
        except ZeroDivisionError:
            return Turned.drawn(chance, scale, whole)
        s = Fraction(1) if whole else chance.choice([Fraction(1), Fraction(-9, 10), Fraction(21, 20)])
        order = chance.sample(range(n), n)
        L = [[s * chance.choice([-1, 1]) * (j == order[i]) for j in range(n)] for i in range(n)]
        unit = abs(math.lcm(*(v.denominator for row in back for v in row)))
        some = [Fraction(unit), Fraction(2 * unit)] if whole else [Fraction(0), Fraction(1, 64), Fraction(3, 7)]
        w = [chance.choice(some) for _ in range(n)]
        M = [[Fraction(0)] * n for _ in range(n)] if whole else product(back, product(L, N))
        frame = [[math.ldexp(float(v), power) for v in row] for row in N for power in [chance.randint(-scale, scale)]]
        lo = [chance.randint(-64, 64) / 32 for _ in range(n)]
        hi = [a + chance.choice([1 / 1024, 1 / 64, 0.5]) for a in lo]
        return Turned(M, [[b * v for b, v in zip(row, w, strict=True)] for row in back], frame, lo, hi)

    @property
    def loop(self) -> Loop:
        n = len(self.M)
        names = tuple(f"x{i}" for i in range(n))
        rows = [
            ["+", ["*", "0", "u"], "0"]
            + [["*", str(a), x] for a, x in zip(along, names, strict=True) if a]
            + [["*", str(b), f"q{k}"] for k, b in enumerate(doubts) if b]
            for along, doubts in zip(self.M, self.B, strict=True)
        ]
        uncertain = [(f"q{k}", "-1", "1") for k in range(n)]
        return Loop(
            rows, [affine([[0.0] * n])], [["-", "x0", "1"]], names, uncertain=uncertain, domain=WIDE, frame=self.N
        )

    @property
    def data(self) -> Document:
        return leading(self.loop, self.lo, self.hi, 1)

    def ends(self, steps: int) -> list[Ends]:
        """Where the states are after each step."""
        centre = [(Fraction(a) + Fraction(b)) / 2 for a, b in zip(self.lo, self.hi, strict=True)]
        radius = [(Fraction(b) - Fraction(a)) / 2 for a, b in zip(self.lo, self.hi, strict=True)]
        A, doubt, found = identity(len(self.M)), [Fraction(0)] * len(self.M), list[Ends]()
        for _ in range(steps):
            doubt = [e + sum(map(abs, row)) for e, row in zip(doubt, product(A, self.B), strict=True)]
            A = product(A, self.M)
            middle = [times(row, centre) for row in A]
            reach = [times([abs(a) for a in row], radius) + e for row, e in zip(A, doubt, strict=True)]
            found.append([(m - r, m + r) for m, r in zip(middle, reach, strict=True)])
        return found


def leading(loop: Loop, lo: Sequence[float], hi: Sequence[float], steps: int) -> Document:
    """A leaf from which so many steps lead to the target."""
    return loop.document(lo, hi, b"\xff", two_bytes([steps]), bytes([steps]))


def by_checker(data: Document, lo: Sequence[float], hi: Sequence[float], count: int) -> list[Ends]:
    """The ends of images after each step, infinite where they are not known."""
    found = list[Ends]()
    with np.errstate(all="ignore"):
        steps = Steps(Case(document.certificate(json.loads(dumped(data)), "0" * 64)))
        x = steps.start(np.array(lo)[:, None], np.array(hi)[:, None])
        for _ in range(count):
            x, _ = steps.step(x, np.arange(1), Course())
            each = np.array(x.range.ends)[:, :, 0].T
            if not np.all(np.isfinite(each)):
                break
            found.append([(Fraction(a), Fraction(b)) for a, b in each.tolist()])
    return found


def by_reference(data: Document, lo: list[float], hi: list[float], count: int) -> list[Ends]:
    def exactly(x: arb) -> Fraction:
        mantissa, power = x.man_exp()
        return Fraction(int(mantissa)) * Fraction(2) ** int(power)

    c, found = read(dumped(data)), list[Ends]()
    assert isinstance(c.evidence, Ranked) and c.evidence.ranking is not None
    with ctx.workprec(64):
        walk = Walk(c, c.evidence.order, c.evidence.ranking)
        rows = walk.start(Box(0, lo, hi))
        for _ in range(count):
            (rows,) = walk.step(rows, "here", *walk.inputs([rows]))
            found.append([(exactly(a), exactly(b)) for a, b in map(ends, rows)])
    return found


def farthest(true: list[Ends], found: list[Ends]) -> float:
    """How far images reach beyond what is true, relative to a state's size; they must have all of it."""
    gap = Fraction(0)
    for state, image in zip(true, found, strict=False):
        for (a, b), (lo, hi) in zip(state, image, strict=True):
            assert lo <= a and b <= hi
            gap = max(gap, max(a - lo, hi - b) / max(abs(a), abs(b), Fraction(1, 100)))
    return float(gap)


@pytest.mark.parametrize("seed", slow_after(12, [*range(10), 12, 21, *range(22, 100)]))
@pytest.mark.parametrize("scale", [0, 300, 900])
def test_images_have_all_that_is_reached_and_no_more(seed: int, scale: int) -> None:
    chance = random.Random(seed)
    made = Turned.drawn(chance, scale, whole=seed % 3 == 0)
    count = 60 if seed == 1 else chance.choice([1, 2, 9])
    true = made.ends(count)
    for images in (by_checker, by_reference):
        found = images(made.data, made.lo, made.hi, count)
        assert len(found) == count and farthest(true, found) < count * GAP


@pytest.mark.parametrize("seed", slow_after(6, range(60)))
def test_frames_at_the_edge_of_binary64_leave_nothing_out(seed: int) -> None:
    """Where numbers overflow the checker knows nothing, and where N^-1 has no digits more than is true."""
    made, chance = Turned.drawn(random.Random(seed), 0), random.Random(seed)
    powers = [chance.choice([1015, -1015, -1060, 0]) for _ in made.N]
    made.N = [[math.ldexp(v, power) for v in row] for row, power in zip(made.N, powers, strict=True)]
    true = made.ends(3)
    for images in (by_checker, by_reference):
        farthest(true, images(made.data, made.lo, made.hi, 3))


@pytest.mark.parametrize("seed", slow_after(4, range(40)))
def test_a_target_that_is_reached_by_a_hair(seed: int) -> None:
    """As whole certificates: a half space that a corner of the last image touches, and one less."""
    chance = random.Random(1000 + seed)
    made = Turned.drawn(chance, 40)
    loop, count, i = made.loop, chance.choice([1, 4, 30]), chance.randrange(len(made.M))
    _, most = made.ends(count)[-1][i]
    for part, rule in ((Fraction(1, 10**9), None), (Fraction(-1, 10**15), "ranks")):
        loop.target = [["-", f"x{i}", str(most + part * max(abs(most), Fraction(1)))]]
        assert verdicts(leading(loop, made.lo, made.hi, count)) == (rule, rule)


@pytest.mark.parametrize("seed", slow_after(4, range(20)))
def test_periods_and_products_of_doubts_are_in_the_frame(seed: int) -> None:
    """x' = N^-1 w q over any period of [1/2, 1]: h q is of second order, and h = 1 is the farthest."""
    made = Turned.drawn(random.Random(seed), 20)
    made.M = [[Fraction(0)] * len(row) for row in made.M]
    loop = made.loop
    made.M, loop.sample, loop.order = identity(len(made.M)), ("1/2", "1"), 2
    true = made.ends(3)
    for images in (by_checker, by_reference):
        assert farthest(true, images(leading(loop, made.lo, made.hi, 1), made.lo, made.hi, 3)) < 1e-8


@pytest.mark.parametrize(("a", "b"), [(1, 1), (1, -1), (-1, -1)])
def test_remainders_count_with_all_signs(a: int, b: int) -> None:
    """p^3 is of third order, and a x + b y, the first entry of N x, is 2 p^3."""
    cube, along = ["*", "p", "p", "p"], ["+", ["*", str(a), "x"], ["*", str(b), "y"]]
    rows = [["+", ["*", str(a), cube], ["*", "0", "u"]], ["+", ["*", str(b), cube], ["*", "0", "x", "y"]]]
    frame = [[float(a), float(b)], [float(a), -float(b)]]
    for bound, rule in (("3/2", "ranks"), ("5/2", None)):
        target, doubt = [["-", along, bound]], [("p", "-1", "1")]
        loop = Loop(rows, [affine([[0.0, 0.0]])], target, ("x", "y"), uncertain=doubt, frame=frame)
        assert verdicts(leading(loop, [0.0, 0.0], [0.5, 0.5], 1)) == (rule, rule)


@pytest.mark.parametrize("given", ["u", "x"])
def test_an_entry_of_the_inverse_that_underflows_is_an_error(given: str) -> None:
    """-2^-1200 in N^-1 is all that is known of x, which goes on to z, through the policy or not."""
    tiny, frame = Fraction(1, 2**600), [[2.0**600, 1.0, 0.0], [0.0, 2.0**600, 0.0], [0.0, 0.0, 1.0]]
    loop = Loop(
        [["*", str(-tiny), "q"], "q", ["+", given, ["*", "0", "u", "x", "y", "z"]]],
        [affine([[1.0, 0.0, 0.0]])],
        [["-", "z", "1"]],
        ("x", "y", "z"),
        uncertain=[("q", "-1", "1")],
        frame=frame,
    )
    lo, hi, far = [0.0] * 3, [2.0**-700] * 3, (-tiny, tiny)
    true = [[far, (Fraction(-1), Fraction(1)), (Fraction(0), Fraction(hi[0]))], [far, (Fraction(-1), Fraction(1)), far]]
    for images in (by_checker, by_reference):
        farthest(true, images(leading(loop, lo, hi, 1), lo, hi, 2))
    for name, bound, rule in (("x", 2 * tiny, "ranks"), ("z", Fraction(1, 2**100), None), ("z", tiny / 2, "ranks")):
        loop.target = [["-", name, str(bound)]]
        assert verdicts(leading(loop, lo, hi, 2))[0] == rule
    assert verdicts(leading(loop, lo, hi, 2))[1] == "ranks"
    loop.target = [["-", "x", str(tiny / 2)]]
    assert verdicts(leading(loop, lo, hi, 1)) == ("ranks", "ranks")


@pytest.mark.parametrize("turned", [False, True])
def test_what_cancels_in_the_frame_is_bounded_with_its_rounding(turned: bool) -> None:
    """p + b p' = 0 in binary64, and not in truth: the first entry of N^-1 is 1, so that b_1 is a coefficient."""
    chance = np.random.default_rng(1)
    for _ in range(50):
        b, p = chance.uniform(0.5, 1.0, 2)
        rows = [[b, 1.0], [1.0, 0.0]] if turned else [[1.0, b], [0.0, 1.0]]
        at = (p, -b * p) if turned else (-b * p, p)
        loop = Loop([["+", "x", "u"], "y"], [affine([[0.0, 0.0]])], [["-", "x", "9"]], ("x", "y"), frame=rows)
        data = leading(loop, [0.0, 0.0], [0.0, 0.0], 1)
        steps = Steps(Case(document.certificate(json.loads(dumped(data)), "0" * 64)))
        coefficients = np.zeros((2, steps.symbols * (steps.symbols + 3) // 2, 1))
        coefficients[:, 2, 0] = at
        form = steps.form([Taylor(np.zeros(1), row, Above(np.zeros(1))) for row in coefficients])
        exact = times([Fraction(N) for N in rows[0]], [Fraction(float(v)) for v in at])
        assert Fraction(float(form.value[3, int(turned), 0])) >= abs(exact)


@pytest.mark.parametrize("seed", slow_after(3, range(20)))
def test_a_frame_has_the_same_images_with_its_rows_in_another_order_and_scaled(seed: int) -> None:
    """Boxes in N x are the same for other orders, signs and powers of 2 of its rows."""
    chance = random.Random(seed)
    made = Turned.drawn(chance, 0)
    found = by_checker(made.data, made.lo, made.hi, 4)
    for _ in range(3):
        factors = [chance.choice([-1, 1]) * 2.0 ** chance.randint(-50, 50) for _ in made.N]
        rows = chance.sample(made.N, len(made.N))
        made.N = [[factor * v for v in row] for factor, row in zip(factors, rows, strict=True)]
        for ours, other in zip(found, by_checker(made.data, made.lo, made.hi, 4), strict=True):
            assert np.array(other, dtype=float) == pytest.approx(np.array(ours, dtype=float), rel=1e-12, abs=1e-12)


FRAMES: dict[str, tuple[Any, str | None]] = {
    "identity": ([1.0, 0.0, 0.0, 1.0], None),
    "orders and signs": ([0.0, -1.0, 2.0, 0.0], None),
    "none": ([], "format"),
    "of another size": ([1.0] * 9, "format"),
    "singular": ([1.0, 2.0, 2.0, 4.0], "ranks"),
    "zero": ([0.0] * 4, "ranks"),
    "a zero row": ([1.0, 1.0, 0.0, -0.0], "ranks"),
    "nearly singular": ([1.0, 1.0, 1.0, 1.0 + 2.0**-30], None),
    "not finite": ([1.0, 0.0, 0.0, math.inf], "format"),
    "not a number": ([1.0, 0.0, 0.0, math.nan], "format"),
}


@pytest.mark.parametrize("name", FRAMES)
def test_which_frames_are_read(name: str) -> None:
    entries, rule = FRAMES[name]
    loop = Loop(
        [["+", ["*", "1/2", "x"], "u"], ["*", "1/2", "y"]], [affine([[0.0, 0.0]])], [["-", "x", "8"]], ("x", "y")
    )
    data = leading(loop, [-1.0, -1.0], [1.0, 1.0], 2)
    data["evidence"]["ranks"]["frame"] = encode(*entries)
    assert verdicts(data) == (rule, rule)


@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_bounds_in_directions_that_move_hold_for_all_errors(n: int) -> None:
    """Of columns with symbols in [-1, 1] and of numbers known by their size alone; Q is what the rule says of it."""
    chance, batch, K = np.random.default_rng(n), 7, n + 4
    columns, sizes = (
        chance.normal(size=(n, K, batch)) * 10.0 ** chance.integers(-6, 3, (K, 1)),
        chance.uniform(0, 3, (n, batch)),
    )
    identity = Near(np.eye(n)[:, :, None], Above(np.zeros((n, n, 1))))
    bound, back = turned(Near(columns), Above(sizes), identity)
    for b in range(batch):
        Q = back.value[:, :, b].T  # (N^-1 Q)', N the identity
        N = np.linalg.inv(Q)
        most = np.abs(N @ columns[:, :, b]).sum(1) + np.abs(N) @ sizes[:, b]
        assert np.all(bound.top[:, b] >= most * (1 - 1e-12))
        assert np.all(bound.top[:, b] <= most.max() * 1e-12 + most * (1 + 1e-12))
        R = N @ (columns[:, :n, b] / np.abs(columns[:, :n, b]).sum(0) + 2.0**-20 * np.eye(n))
        assert np.allclose(np.tril(R, -1), 0, atol=1e-12) and np.all(np.diagonal(R) >= 0)
