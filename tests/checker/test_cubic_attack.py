"""Attacks on third-order models and on the inequality `decrease`: searches for what would make ACCEPTED wrong.

Loops are random, with every function, quotient and power, under networks of every form, at rest and along a path. At
each of them points of the ball climb to where a bound is used most, and there it must hold with certainty, in ball
arithmetic. Where the true limit of a claim is known, no hint may reach it; slabs that are accepted next to the true
flow are true. Each campaign has a sample that always runs and a full size, `pytest -m slow`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from flint import arb, ctx, fmpq, fmpq_mat

from certify.checker import tube
from certify.checker.ball import Ball
from certify.checker.case import Case
from certify.checker.decrease import Models, Multipliers, are_finite
from certify.checker.document import Certificate
from certify.checker.errors import Rejected
from certify.checker.exact import exactly
from certify.checker.sections import Path, Slab
from tests.support.balls import with_ball
from tests.support.certificates import Document, decode, edited, encode, make, parse, verdict
from tests.support.jets import Jet, curved, seen, sides
from tests.support.marks import slow_after
from tests.support.oracle import ball, policies_in_arb, quadratic
from tests.support.reached import dot, field_in_arb

Array = np.ndarray
Generator = np.random.Generator
BITS = 400
JUST = 1 - 2.0**-40
Line = tuple[list[Fraction], list[Fraction]]


@pytest.fixture(autouse=True)
def _quiet() -> Iterator[None]:
    """As in `rules.check`: overflow becomes infinity or NaN."""
    with np.errstate(all="ignore"), ctx.workprec(BITS):
        yield


def sizes(sample: int, full: int) -> pytest.MarkDecorator:
    """How many loops a campaign takes."""
    return pytest.mark.parametrize("count", slow_after(1, [sample, full]), ids=["sample", "full"])


def quotient(v: float) -> fmpq:
    return fmpq(*float(v).as_integer_ratio())


# --------------------------------------------------------------------------------------------------------- random loops


@dataclass(frozen=True)
class Moving(Ball):
    """A ball at rest, or along a line, that no slab asked for."""

    line: Line | None = None

    @property
    def motion(self) -> Line | None:
        return self.line


def random_tree(generator: Generator, names: str, depth: int) -> Any:
    if depth == 0 or generator.random() < 0.15:
        name = names[generator.integers(len(names))]
        number = Fraction(int(generator.integers(-9, 10)), int(generator.integers(1, 8)))
        return name if generator.random() < 0.8 else str(number)

    def sub() -> Any:
        return random_tree(generator, names, depth - 1)

    away = str(generator.choice(["2", "-3", "5"]))
    forms: list[Callable[[], Any]] = [
        lambda: ["+", sub(), sub()],
        lambda: ["-", sub(), sub()],
        lambda: ["*", sub(), sub()],
        lambda: ["*", sub(), sub(), sub()],
        lambda: ["/", sub(), ["+", away, sub()]],
        lambda: ["**", sub(), int(generator.choice([2, 3, 5]))],
        lambda: ["**", ["+", away, sub()], int(generator.choice([-1, -3]))],
        lambda: ["sqrt", ["+", "4", sub()]],
        lambda: [str(generator.choice(["sin", "cos", "tan", "tanh", "exp", "atan"])), sub()],
    ]
    return forms[generator.integers(len(forms))]()


def random_loop(generator: Generator) -> tuple[Document, Ball]:
    """Of one to three states; not a claim that anything holds. The ball is flat, up to a million to one."""
    n, m, moving = int(generator.integers(1, 4)), int(generator.integers(1, 3)), generator.random() < 0.5
    states, inputs = "xyz"[:n], "uv"[:m]
    dynamics = [
        ["+", random_tree(generator, states + inputs, int(generator.integers(1, 4))), ["*", "1/3", inputs[0]]]
        for _ in states
    ]
    widths, layers = [n, *generator.integers(1, 9, generator.integers(0, 4)), m], []
    for columns, rows in pairwise(widths):
        W = generator.standard_normal((rows, columns)) / columns**0.5
        layers.append(
            (generator.choice([0.01, 1, 1, 3, 1e3]) * W, generator.choice([0, 1, 5]) * generator.normal(size=rows))
        )
    forms = [
        ("tanh", "output"),
        ("tanh", "preactivation"),
        ("identity", "output"),
        ("tanh", "none"),
        ("identity", "none"),
    ]
    squash, centre = forms[generator.integers(5 if moving else 3)]
    scale = generator.choice([-1, 1], m) * generator.choice([0.125, 1, 3, 50], m)
    data = make(
        dynamics, layers, np.eye(n), (0.01, 0.01), states=states, inputs=inputs, squash=squash, centre=centre,
        scale=scale, offset=scale / 8, u_eq=[str(Fraction(float(s)) / 4) for s in scale],
        domain=[("-9", "9")] * n, input_bounds=[("-900", "900")] * m,
    )  # fmt: skip
    size = 10.0 ** generator.uniform(-4, 0.3)
    J = generator.standard_normal((n, n)) * 10.0 ** -(generator.choice([0, 0, 2, 6]) * generator.random(n))
    line = None
    if moving:
        middle = [Fraction(int(v), 7) for v in generator.integers(-9, 10, n)]
        line = middle, [Fraction(float(size * v)) / 3 for v in generator.standard_normal(n)]
    try:
        return data, Moving(Case(parse(data)), size * J, "ball", line)
    except Rejected as refused:
        if "the number 0" not in refused.detail:  # 1/(2 - 2), which the format does not have
            raise
        return random_loop(generator)


class Truth:
    """The loop at points of a ball, in ball arithmetic: values of all inputs, then of all components of F."""

    def __init__(self, found: Ball) -> None:
        self.c, self.J, self.motion = found.case.c, found.J, found.motion
        self.centre = self.at(np.zeros(len(self.J) + (self.motion is not None)))

    def at(self, d: Array) -> list[arb]:
        parts = [arb(v) for v in d.tolist()]
        x = [dot([arb(v) for v in row], parts[: len(self.J)]) for row in self.J.tolist()]
        if self.motion is not None:
            x = [p + ball(m) + ball(w) * parts[-1] for p, m, w in zip(x, *self.motion, strict=True)]
        return [*policies_in_arb(self.c.policy, self.c.u_eq, [x])[0], *field_in_arb(self.c, [x])[0]]


def scattered(generator: Generator, count: int, k: int) -> Array:
    d = generator.standard_normal((count, k))
    d *= JUST / np.linalg.norm(d, axis=1, keepdims=True)
    return np.asarray(d * generator.choice([1, 1, 1, 0.9, 0.5, 1e-6], count)[:, None])


def climb(generator: Generator, k: int, use: Callable[[Array], float], count: int = 14) -> float:
    """The largest `use` that was met: from the best of some points of the ball, by steps that become smaller."""
    points = list(scattered(generator, count, k))
    values = [use(d) for d in points]
    best = int(np.argmax(values))
    point, value = points[best], values[best]
    for step in np.geomspace(0.3, 0.01, count):
        d = point + step * generator.standard_normal(k)
        d *= min(1.0, JUST / max(np.linalg.norm(d), 1e-300))
        new = use(d)
        if new > value:
            point, value = d, new
    return value


def is_known(jet: Jet) -> bool:
    return bool(np.all([np.isfinite(v).all() for v in (jet.c, jet.error, jet.a, jet.slack, jet.Q, jet.K, jet.radius)]))


def part_used(jet: Jet, value: arb, at_0: arb, d: Array) -> float:
    """The part that is used of what the model allows; what is not certainly allowed fails."""
    entries = d.tolist()
    length = sum((arb(v) ** 2 for v in entries), arb(0)).sqrt()
    left = abs(value - at_0 - dot([arb(v) for v in jet.a.tolist()], [arb(v) for v in entries]) - curved(jet, entries))
    weights = [arb(1), *(abs(arb(v)) for v in jet.B.tolist())]
    bounds = [quadratic(M.tolist(), entries) for M in (jet.E, *jet.U)]
    bound = arb(float(jet.slack)) * length + dot(weights, bounds)
    assert abs(at_0 - arb(float(jet.c))) <= arb(float(jet.error))
    assert left <= bound, (float(left / bound), entries)
    assert abs(value - at_0) <= arb(float(jet.radius)) * length
    return float(left / bound)


@sizes(12, 400)
def test_no_point_of_a_ball_leaves_its_models(count: int) -> None:
    closest, known = 0.0, 0
    for seed in range(count):
        generator = np.random.default_rng(seed)
        _, found = random_loop(generator)
        truth = Truth(found)
        jets = seen([*found.inputs, *found.F()])
        at_0 = [ball(q) for q in found.case.c.u_eq] if found.motion is None else truth.centre[: len(found.inputs)]
        at_0 += truth.centre[len(found.inputs) :]
        asked = [i for i, jet in enumerate(jets) if is_known(jet)]
        known += len(asked)

        def use(d: Array, truth: Truth = truth, jets: Any = jets, at_0: Any = at_0, asked: Any = asked) -> float:
            values = truth.at(d)
            return max((part_used(jets[i], values[i], at_0[i], d) for i in asked), default=0.0)

        closest = max(closest, climb(generator, len(truth.J) + (truth.motion is not None), use))
    assert 0.9 < closest <= 1 and known > count


# ------------------------------------------------------------------------------------------------------ only roundings


def wild(generator: Generator, span: int) -> str:
    number = Fraction(int(generator.integers(-(10**6), 10**6)), int(generator.integers(1, 10**6)))
    return str(number * Fraction(10) ** int(generator.integers(-span, span + 1)))


@pytest.mark.parametrize("span", slow_after(1, [0, 3, 40]))
def test_polynomials_up_to_the_third_degree_leave_roundings_alone(span: int) -> None:
    """Products that cancel, of numbers that are far apart; a model has all three orders, so that E is rounding."""
    closest = 0.0
    for seed in range(6):
        generator = np.random.default_rng([span, seed])

        def line(generator: Generator = generator) -> Any:
            return ["+", *(["*", wild(generator, span), name] for name in "xy"), wild(generator, span)]

        a, b, c = line(), line(), line()
        dynamics = [
            ["-", ["*", a, b, c], ["*", c, ["*", b, a]]],
            ["+", ["**", line(), 3], ["*", line(), line(), line()]],
        ]
        data = make(
            dynamics, [(np.zeros((1, 2)), [0.0])], np.eye(2), (0.01, 0.01), states="xy", domain=[("-9", "9")] * 2
        )
        J = (
            10.0 ** generator.uniform(-8, 3)
            * generator.standard_normal((2, 2))
            * 10.0 ** generator.uniform(-4, 0, (2, 2))
        )
        middle = [Fraction(wild(generator, 3)) for _ in range(2)]
        found = Moving(Case(parse(data)), J, "ball", (middle, [Fraction(wild(generator, 3)) for _ in range(2)]))
        with ctx.workprec(1500):
            truth = Truth(found)
            for d in scattered(generator, 4, 3):
                for jet, value, at_0 in zip(seen(found.F()), truth.at(d)[1:], truth.centre[1:], strict=True):
                    assert is_known(jet)
                    closest = max(closest, part_used(jet, value, at_0, d))
    assert 1e-6 < closest <= 1


# ------------------------------------------------------------------------------------------------------ the inequality

WEIGHTS = ("even", "semidefinite", "negative", "neither", "huge", "tiny", "none")


def random_weight(generator: Generator, k: int) -> Array:
    A = generator.standard_normal((k, k))
    kind = generator.choice(WEIGHTS)
    parts = {"even": np.eye(k), "semidefinite": A @ A.T, "negative": -A @ A.T, "neither": A, "huge": 1e300 * A,
             "tiny": 1e-300 * np.eye(k), "none": np.zeros((k, k))}  # fmt: skip
    return np.asarray(parts[str(kind)])


def random_hints(generator: Generator, J: Array, P: Array, F: Sequence[Jet], k: int) -> tuple[Multipliers, Path]:
    """Near what balances the sums, with zeros among them; the path is for a ball that moves."""
    n = len(J)
    lengths = np.linalg.norm(J.T @ P, axis=0) + 1e-30
    rows = np.array(
        [[np.linalg.norm(f.E) for f in F] / lengths, [np.linalg.norm(f.Q) for f in F] / lengths, np.ones(n)]
    )
    rows *= np.exp(generator.standard_normal(rows.shape))
    rows[:2] *= generator.choice([0, 1, 1], (2, n))
    alpha, beta, g = (tuple(quotient(v) for v in row) for row in rows.tolist())
    share, edge, motion = np.exp(generator.standard_normal(3)).tolist()
    path = Path(np.zeros(n), min(share, 0.9), edge, motion * int(generator.choice([0, 1])), 1.0)
    return Multipliers(alpha, beta, g, random_weight(generator, k)), path


def in_form(A: Any, y: Sequence[arb]) -> arb:
    return dot([dot([arb(v) for v in row], y) for row in A], y)


@sizes(12, 400)
def test_no_point_of_a_ball_crosses_the_inequality(count: int) -> None:
    """What has to be negative is at most -(decay - S) everywhere on the ball, for P and R that may be anything."""
    closest, known = 0.0, 0
    for seed in range(count):
        generator = np.random.default_rng([1, seed])
        _, found = random_loop(generator)
        n, moving = len(found.J), found.motion is not None
        if not are_finite(found.F()):
            continue
        known += 1
        truth, A, B = Truth(found), generator.standard_normal((n, n)), generator.standard_normal((n, n))
        P, R = A + A.T if seed % 2 else A @ A.T, 10.0 ** generator.uniform(-3, 3) * (B + B.T)
        by, path = random_hints(generator, found.J, P, seen(found.F()), n + moving)
        v = [fmpq(int(q), 7) for q in generator.integers(-9, 10, n)]
        models = Models(found.J, found.F(), not moving, v if moving else ())
        decay, rest = sides(models, exactly(P), exactly(R), by, path if moving else None)
        inputs = len(found.inputs)
        moved = [arb(q) for q in v] if moving else truth.centre[inputs:]

        def use(d: Array, truth: Truth = truth, P: Array = P, R: Array = R, path: Path = path, moving: bool = moving,
                moved: Any = moved, decay: fmpq_mat = decay, rest: fmpq_mat = rest) -> float:  # fmt: skip
            y = [arb(v) for v in d.tolist()]
            e = [dot([arb(v) for v in row], y[: len(truth.J)]) for row in truth.J.tolist()]
            F = [p - q for p, q in zip(truth.at(d)[-len(e) :], moved, strict=True)]
            Pe = [dot([arb(v) for v in row], e) for row in P.tolist()]
            value = in_form(R.tolist(), e) + 2 * dot(Pe, F)
            if moving:
                value += arb(path.edge) * (dot(e, Pe) - 1) + arb(path.motion) * (arb(path.share) ** 2 - y[-1] ** 2)
                y = [arb(1), *y]
            linear, bound = in_form(decay.tolist(), y), in_form(rest.tolist(), y)
            assert value <= bound - linear, d
            return float((value + linear) / bound) if bound > 0 else 0.0

        closest = max(closest, climb(generator, n + moving, use))
    assert 0.5 < closest <= 1 and known > count / 2


# ----------------------------------------------------------------------------------- claims whose true limits are known


def one_state(tree: Any, W: float = 0.0) -> Document:
    return make([tree], [([[W]], [0.0])], np.eye(1), (0.01, 0.01), domain=[("-9", "9")], root=[1.0])


# where Vdot is 0 again, at or just beyond the true place, on which side, and the part of that level that is proved
LIMITS: dict[str, tuple[Document, float, int, float]] = {
    "cube": (one_state(["-", ["**", "x", 3], "x"]), 1.0, 1, 0.999),
    "square": (one_state(["-", ["*", "x", "x"], "x"]), 1.0, 1, 0.999),
    "inv": (one_state(["-", ["/", "x", ["-", "2", "x"]], "x"]), 1.0, 1, 0.99),
    "sqrt": (one_state(["-", ["sqrt", ["+", "1", "x"]], ["+", "1", ["*", "3/4", "x"]]]), 0.8888888888888890, -1, 0.99),
    "exp": (one_state(["-", ["exp", "x"], ["+", "1", ["*", "2", "x"]]]), 1.256431208626170, 1, 0.8),
    "tan": (one_state(["-", ["tan", "x"], ["*", "2", "x"]]), 1.165561185207212, 1, 0.6),
    "sin": (one_state(["-", ["sin", "x"]]), 3.141592653589794, 1, 0.4),
    "atan": (one_state(["-", ["/", "x", "2"], ["atan", "x"]]), 2.331122370414424, 1, 0.15),
    "policy": (one_state(["+", ["/", "x", "2"], "u"], 1.0), 1.915008048215, 1, 0.2),
}


def at_level(data: Document, level: float) -> Document:
    """c1 = c2, so that rule `local` alone decides, with hints that balance the sums."""
    n = len(data["plant"]["states"])
    data = edited(data, "levels", {"local": level.hex(), "roa": level.hex()})
    return with_ball(edited(data, "evidence.root", encode(np.full(n, 2 * level**0.5))))


def jointly(data: Document) -> Document:
    """With all components taken together, as is best where they cancel; there is no second order."""
    rows = decode(data["evidence"]["local"]["multipliers"]).reshape(3, -1)
    rows[1], rows[2] = 0.0, 2.0**-60
    return edited(data, "evidence.local.multipliers", encode(rows))


def varied(generator: Generator, data: Document) -> Document:
    """The same claim by other hints: multipliers, weight and ball."""
    path = "evidence.local"
    rows = decode(data["evidence"]["local"]["multipliers"])
    n = len(rows) // 3
    rows = rows * np.exp(generator.choice([0.3, 3, 30]) * generator.standard_normal(3 * n))
    rows[: 2 * n] *= generator.choice([0, 1, 1, 1], 2 * n)
    J = decode(data["evidence"]["local"]["J"]).reshape(n, n) * (1 + 10.0 ** generator.uniform(-12, -0.5))
    turn = np.linalg.qr(generator.standard_normal((n, n)))[0]
    data = edited(edited(data, f"{path}.multipliers", encode(rows)), f"{path}.J", encode(J @ turn))
    return edited(data, f"{path}.weight", encode(random_weight(generator, n)))


FALSE = (1.0, 1 + 2.0**-40, 1.0001, 1.01, 1.05, 1.3, 4.0)


@pytest.mark.parametrize("name", slow_after(5, LIMITS))
def test_no_hint_reaches_the_true_limit(name: str) -> None:
    data, edge, side, part = LIMITS[name]
    assert field_in_arb(parse(data), [[arb(side * edge)]])[0][0] * side >= 0  # Vdot is not negative there
    assert verdict(at_level(data, part * edge**2)) == "ACCEPTED"
    generator = np.random.default_rng(0)
    for factor in FALSE:
        false = at_level(data, float(np.nextafter(factor * edge**2, np.inf)))
        for forged in [false, *(varied(generator, false) for _ in range(5))]:
            assert verdict(forged) != "ACCEPTED"


@pytest.mark.parametrize("shear", [0, -3])
@pytest.mark.parametrize("power", slow_after(1, [0, -9, 9]))
def test_a_cubic_in_skewed_coordinates_is_not_proved_to_its_limit(shear: int, power: int) -> None:
    """z' = (|z|^2 - 1) z + 2 (z turned), z = T x, V = |z|^2: Vdot < 0 in {V < 1}, and 0 where V = 1. All is exact."""
    T = np.array([[1.0, shear], [0.0, 2.0**power]])
    back = [["1", str(Fraction(-shear) / Fraction(2.0**power))], ["0", str(1 / Fraction(2.0**power))]]
    z = [["+", ["*", str(Fraction(p)), "x"], ["*", str(Fraction(q)), "y"]] for p, q in T.tolist()]
    outwards = ["-", ["+", ["*", z[0], z[0]], ["*", z[1], z[1]]], "1"]
    rates = [["-", ["*", outwards, z[0]], ["*", "2", z[1]]], ["+", ["*", outwards, z[1]], ["*", "2", z[0]]]]
    dynamics = [["+", ["*", p, rates[0]], ["*", q, rates[1]]] for p, q in back]
    data = make(
        dynamics, [(np.zeros((1, 2)), [0.0])], T.T @ T, (0.01, 0.01), states="xy", domain=[("-9999", "9999")] * 2,
        T=np.linalg.inv(T), root=[1.0, 1.0],
    )  # fmt: skip
    assert verdict(jointly(at_level(data, 0.75))) == "ACCEPTED"
    generator = np.random.default_rng(abs(power))
    for factor in FALSE:
        assert verdict(at_level(data, factor)) == verdict(varied(generator, at_level(data, factor))) == "local"


# --------------------------------------------------------------------------------------------- slabs next to the flow


def refused_by(piece: tube.Piece) -> str | None:
    """The rule of slabs that fails."""
    return next((name for name, rule in tube.ON_SLABS if next(rule(piece), None) is not None), None)


def flow(field: Callable[[float], float], x: float, seconds: float) -> float:
    h = seconds / 50
    for _ in range(50):
        k1 = field(x)
        k2 = field(x + h / 2 * k1)
        k3 = field(x + h / 2 * k2)
        x += h / 6 * (k1 + 2 * k2 + 2 * k3 + field(x + h * k3))
    return x


def rates(c: Certificate, start: float, centre: float | None, slab: Slab) -> Iterator[arb]:
    """dW/dt where W = 1, at instants of a slab of one state."""
    (middle,), (end,), h = slab.middle.tolist(), slab.end.tolist(), arb(slab.duration)
    p, m, q = arb(start), arb(middle[0]), arb(end[0])
    at, to = (arb(0), arb(0)) if slab.path is None else (arb(float(centre or 0)), arb(float(slab.path.centre[0])))
    for s in (arb(j) / 8 for j in range(9)):
        P, slope = (1 - s) ** 2 * p + 2 * s * (1 - s) * m + s**2 * q, 2 * (1 - s) * (m - p) + 2 * s * (q - m)
        for e in (1 / P.sqrt(), -1 / P.sqrt()):
            F = field_in_arb(c, [[(1 - s) * at + s * to + e]])[0][0]
            yield e * slope * e / h + 2 * e * P * (F - (to - at) / h)


GRID = np.geomspace(0.1, 10, 5).tolist()


def attempts(case: Case, piece: tube.Piece) -> Iterator[tube.Piece]:
    """The slab with multipliers that balance the sums, edge and motion on a grid around the rate of the flow."""
    F = seen(piece.F())
    b = abs(float(piece.J[0, 0] * piece.slab.middle[0, 0]))
    rest, apart = (max(float(np.linalg.norm(getattr(F[0], part))) / b, 1e-30) for part in ("E", "Q"))
    slab, path = replace(piece.slab, multipliers=np.array([[rest], [apart], [1.0]])), piece.slab.path
    if path is None:
        yield replace(piece, slab=slab)
        return
    for edge in GRID:
        for motion in GRID:
            moving = replace(path, edge=edge, motion=motion * edge)
            yield replace(piece, slab=replace(slab, path=moving))


@pytest.mark.parametrize("name", slow_after(2, LIMITS))
@pytest.mark.parametrize("moving", [False, True])
@sizes(1, 20)
def test_slabs_that_are_accepted_next_to_the_flow_are_true(name: str, moving: bool, count: int) -> None:
    """The interval around a point that moves with the flow; its end is the image by the flow, or a little more or less
    than that: what is false by any amount is refused, and some of what is true is accepted."""
    data, limit, _, _ = LIMITS[name]
    case, accepted, false = Case(parse(data)), 0, 0

    def field(x: float) -> float:
        return float(field_in_arb(case.c, [[arb(x)]])[0][0])

    for seed in range(count):
        generator = np.random.default_rng([moving, seed])
        centre = 0.5 * limit * float(generator.uniform(-1, 1)) if moving else 0.0
        radius, h = 0.1 * limit * float(generator.uniform(0.3, 1)), float(generator.uniform(0.02, 0.1))
        to = flow(field, centre, h) if moving else 0.0
        reach = max(abs(flow(field, centre + side * radius, h) - to) for side in (1, -1))
        for loose in (-0.05, -0.01, 0.01, 0.05, 0.5, 2.0):
            start, end = radius**-2, (reach * (1 + loose * h)) ** -2
            middle = (start + end) / 2 - (start**0.5 - end**0.5) ** 2 / 2
            share = 0.3 if moving else 0.0
            path = Path(np.array([to]), share, 1.0, 1.0, 1.0) if moving else None
            J = np.array([[min(start, middle, end) ** -0.5 * 1.001 / (1 - share**2) ** 0.5]])
            by = np.array([[0.0], [1.0], [1.0]])
            slab = Slab(np.array([[middle]]), np.array([[end]]), h, J, by, np.eye(1 + moving), path)
            piece = tube.Piece(case, J, "slab", np.array([[start]]), np.array([centre]) if moving else None, slab)
            passes = any(refused_by(each) is None for each in attempts(case, piece))
            found = list(rates(case.c, start, centre, slab))
            accepted += passes
            false += any(bool(rate >= 0) for rate in found)
            assert not passes or all(bool(rate < 0) for rate in found), (seed, loose)
    assert accepted > 0 and false > 0
