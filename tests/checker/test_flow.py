"""Enclosures over steps, against points: jets that are affine in what is uncertain, the mean of f over a period on a
ball and on leaves, with what is uncertain switching within the period, and the inequality of a step around a level."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from fractions import Fraction
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from flint import arb, arb_mat, ctx, fmpq, fmpq_mat
from numpy.random import Generator

from certify.checker.case import Case
from certify.checker.decrease import Level, Multipliers
from certify.checker.exact import exactly
from certify.checker.flow import Series, enclosed
from certify.checker.jets import Units
from certify.checker.local import Local
from certify.checker.ring import Ring
from certify.checker.stepping import size_beyond
from certify.checker.taylor import affine, constants
from certify.reference.balls import ON_LEAVES
from certify.reference.flow import Moving, moved_within
from certify.reference.refusal import Refused
from certify.reference.taylor import Taylor as BallModel
from certify.reference.taylor import constant
from tests.checker.test_ball import points
from tests.checker.test_cubic import FUNCTIONS, JUST, Member, closeness, derivatives, random_jet, shares, value
from tests.checker.test_uncertain import holds
from tests.support.certificates import Document, edited, make, parse
from tests.support.jets import (
    Jet,
    between,
    changed,
    curved,
    given,
    models_of,
    no_units,
    plain,
    remainders,
    seen,
    sides,
    uncertain,
    units_of,
)
from tests.support.leaves import on_boxes
from tests.support.marks import slow_after
from tests.support.plain import Taylor, layers
from tests.support.stepped_loops import fitted

# ------------------------------------------------------------------------------------------ jets with what is uncertain


def swaying(generator: Generator, k: int, U: np.ndarray, count: int, size: float) -> Jet:
    jet = random_jet(generator, k, U, size)
    by = size * 2.0 ** generator.integers(-8, 0, 2)
    c_y, a_y = by[0] * generator.standard_normal(count), by[1] * generator.standard_normal((count, k))
    return changed(jet, c_y=c_y, a_y=a_y)


class At(Member):
    """A function that a jet holds where what is uncertain has these y."""

    def __init__(self, jet: Jet, own: float, common: list[float], y: list[float]) -> None:
        super().__init__(jet, own, common)
        for sign, c, a in zip(y, jet.c_y.tolist(), jet.a_y.tolist(), strict=True):
            self.c += arb(sign) * arb(c)
            self.a = [p + arb(sign) * arb(q) for p, q in zip(self.a, a, strict=True)]


@pytest.mark.parametrize("size", slow_after(1, [1e-6, 0.02, 0.2]))
def test_jets_that_are_affine_in_y_contain_what_they_stand_for(size: float) -> None:
    """Sums, products and functions at the corners of y, in the middle and anywhere, with the errors that are shared."""
    generator, used, k, m, count = np.random.default_rng(int(size * 1e6)), 0.0, 2, 2, 2
    with ctx.workprec(2500):
        for number in range(12):
            U = shares(generator, m, k) * size
            common = generator.choice([-1.0, 1.0, 0.5, 0.0], m).tolist()
            x, y = (swaying(generator, k, U, count, size) for _ in range(2))
            where = points(generator, k)
            corners = [list(signs) for signs in itertools.product((-1.0, 1.0), repeat=count)]
            for at in (corners[number % 4], [0.0, 0.0], generator.uniform(-1, 1, count).tolist()):
                v, w = (At(jet, float(generator.choice([-JUST, JUST, 0.0])), common, at) for jet in (x, y))
                sums = [p + q for p, q in zip(v.a, w.a, strict=True)]
                products = [v.c * q + w.c * p for p, q in zip(v.a, w.a, strict=True)]
                closeness(given(x + y, at), common, lambda d, v=v, w=w: v(d) + w(d), sums, where)
                closeness(given(-x, at), common, lambda d, v=v: -v(d), [-p for p in v.a], where)
                truth: Any = lambda d, v=v, w=w: v(d) * w(d)  # noqa: E731
                used = max(used, closeness(given(x * y, at), common, truth, products, where))
                for name in FUNCTIONS:
                    jet = changed(x, c=np.float64(abs(x.c) + 14 * size)) if name in ("inv", "sqrt") else x
                    f, u = jet.function(name), At(jet, v.own, common, at)
                    if not np.isfinite(f.E).all():
                        assert name in ("inv", "sqrt")
                        continue
                    slope = derivatives(name, u.c)[1]
                    truth = lambda d, u=u, name=name: value(name, u(d))  # noqa: E731
                    used = max(used, closeness(given(f, at), common, truth, [slope * p for p in u.a], where))
    assert used > 0.05


def test_what_is_left_of_y_is_of_second_order() -> None:
    """The error of sin(c + r y) falls by four where r is halved, that of a range without a symbol by two."""
    U = np.zeros((0, 1, 1))
    ends = [(1 - r, 1 + r) for r in (Fraction(1, 2**8), Fraction(1, 2**9))]
    known = [uncertain(*pair, U, 0, 1).function("sin").error for pair in ends]
    ranges = [between(*pair, U, 1).function("sin").error for pair in ends]
    assert known[0] / known[1] == pytest.approx(4, rel=0.05) and ranges[0] / ranges[1] == pytest.approx(2, rel=0.05)


# ----------------------------------------------------------------------------------------------- the mean over a period

EQUATIONS: list[Any] = [
    ["+", ["-", "y", ["*", "q", "x"]], ["/", ["sin", ["*", "p", "x", "y"]], "3"],
     ["*", "p", ["-", ["exp", ["/", "x", "2"]], "1"]], ["*", "1/2", ["-", ["sqrt", ["+", "1", ["*", "q", "y"]]], "1"]]],
    ["+", "u", ["*", "q", "q", ["tanh", "x"]], ["*", "p", ["atan", ["-", "y", "x"]]], ["-", ["cos", "y"], "1"],
     ["/", "x", ["+", "2", ["*", "p", "y"]]], ["tan", ["*", "q", "y"]], ["*", "p", "x", "x"]],
]  # fmt: skip


def curved_plant(disturbed: bool, lo: str, hi: str, order: int, wide: float = 1.0) -> Document:
    """Every function of the format, two uncertain quantities, two layers. Nothing here has to be stable."""
    generator = np.random.default_rng(8)
    layers = [
        (generator.standard_normal((4, 2)), generator.uniform(-1, 1, 4)),
        (generator.standard_normal((1, 4)), [0.3]),
    ]
    equations = [["+", tree, ["*", "p", "1/8"]] for tree in EQUATIONS] if disturbed else EQUATIONS
    ends = [(str(Fraction(1, 2) - Fraction(wide) / 4), str(Fraction(1, 2) + Fraction(wide) / 4)),
            (str(-Fraction(wide) / 2), str(Fraction(wide) / 2))]  # fmt: skip
    data = make(
        equations, layers, np.eye(2), (0.01, 0.01, 0.01) if disturbed else (0.01, 0.01), states="xy", centre="output",
        domain=[("-3", "3")] * 2, input_bounds=[("-9", "9")], scale=[-1.5], sample=(lo, hi), order=order,
        claim="practical" if disturbed else "asymptotic", uncertain=[("q", *ends[0]), ("p", *ends[1])],
    )  # fmt: skip
    return edited(fitted(data), "evidence.local.order", order)


def field(x: np.ndarray, u: np.ndarray, w: np.ndarray, disturbed: bool) -> np.ndarray:
    (a, b), (q, p) = x, w
    first = b - q * a + np.sin(p * a * b) / 3 + p * np.expm1(a / 2) + (np.sqrt(1 + q * b) - 1) / 2
    second = u[0] + q * q * np.tanh(a) + p * np.arctan(b - a) + np.cos(b) - 1
    second = second + a / (2 + p * b) + np.tan(q * b) + p * a * a
    return np.array([first, second]) + disturbed * p / 8


def policy(data: Document, x: np.ndarray) -> np.ndarray:
    c = parse(data)
    h, h0 = x, np.zeros_like(x)
    *hidden, (last, bias) = layers(c.policy.network)
    for W, b in hidden:
        h, h0 = np.tanh(W @ h + b), np.tanh(W @ h0 + b)
    return np.asarray(c.policy.scale * (np.tanh(last @ h + bias) - np.tanh(last @ h0 + bias)))


def travelled(x: np.ndarray, f: Callable[[np.ndarray, np.ndarray], np.ndarray], pieces: list[Any]) -> list[np.ndarray]:
    """The states at the ends of pieces (time, values), and on the way; Runge and Kutta's rule of 20 steps a piece."""
    path = [x]
    for time, w in pieces:
        step = time / 20
        for _ in range(20):
            at = path[-1]
            k1 = f(at, w)
            k2 = f(at + step / 2 * k1, w)
            k3 = f(at + step / 2 * k2, w)
            path.append(at + step / 6 * (k1 + 2 * k2 + 2 * k3 + f(at + step * k3, w)))
    return path


def switching(generator: Generator, lo: float, hi: float, ends: np.ndarray) -> tuple[float, list[Any], np.ndarray]:
    """A period, its pieces with the values of both quantities, and their means; most pieces are at ends of ranges."""
    h = float(generator.choice([lo or hi / 64, hi, generator.uniform(lo, hi)]))
    count = int(generator.choice([1, 2, 3]))
    times = generator.dirichlet(np.ones(count)) * h
    values = np.where(generator.random((count, 2)) < 0.8, ends[generator.integers(2, size=(count, 2)), [0, 1]],
                      generator.uniform(ends[0], ends[1], (count, 2)))  # fmt: skip
    return h, list(zip(times, values, strict=True)), times @ values / h


def period_of(
    data: Document, x: np.ndarray, disturbed: bool, sample: tuple[str, str], ends: np.ndarray, generator: Generator
) -> tuple[float, list[Any], list[np.ndarray], list[float]]:
    """A period from x with the input held: how long it is, its pieces, the states on the way, and the numbers y of the
    means and of the period, if that has a range."""
    u, (lo, hi) = policy(data, x), (Fraction(end) for end in sample)
    h, pieces, mean = switching(generator, float(lo), float(hi), ends)
    path = travelled(x, lambda at, w: field(at, u, w, disturbed), pieces)
    y = ((2 * mean - ends.sum(0)) / (ends[1] - ends[0])).tolist()
    if lo != hi:
        y.append((2 * h - float(lo) - float(hi)) / float(hi - lo))
    return h, pieces, path, y


def within_jet(jet: Jet, y: list[float], d: np.ndarray, true: float, sure: float) -> bool:
    at = given(jet, y)
    with ctx.workprec(120):
        middle = at.c + at.a @ d + float(curved(at, d.tolist()).mid())
    room = at.error + at.slack * np.linalg.norm(d) + d @ at.whole @ d
    return bool(abs(true - middle) <= room + sure)


CASES = [(False, "1/10", "1/10", 1), (True, "1/20", "1/10", 2), (False, "0", "1/10", 4), (False, "1/10", "1/10", 2),
         (False, "1/20", "1/10", 3), (True, "1/10", "1/10", 3), (True, "1/20", "1/10", 4)]  # fmt: skip


@pytest.mark.parametrize(("disturbed", "lo", "hi", "order"), slow_after(2, CASES))
def test_the_ball_holds_the_mean_over_a_period_in_which_what_is_uncertain_switches(
    disturbed: bool, lo: str, hi: str, order: int
) -> None:
    for wide in (1.0, 1 / 64):
        data, generator = curved_plant(disturbed, lo, hi, order, wide), np.random.default_rng(order)
        with np.errstate(all="ignore"):
            local = Local.of(Case(parse(data)))
            [cell] = local.case.cells
            G, way = seen(local.G(cell)), local.way
        assert way is not None and all(np.isfinite(g.E).all() for g in G)
        ends = np.array([[float(q) for q in pair] for pair in cell]).T
        widest = 0.0
        for d in (np.array(p) for _ in range(6) for p in points(generator, 2)[:5]):
            x = local.J @ d
            h, pieces, path, y = period_of(data, x, disturbed, (lo, hi), ends, generator)
            true = (path[-1] - x) / h
            for jet, each in zip(G, true.tolist(), strict=True):
                assert within_jet(jet, y, d, each, 1e-9), (d, pieces)
            moved = np.max(np.abs(np.array(path) - x), axis=0)
            assert np.all(moved <= way[0] + way[1] * np.linalg.norm(d) + 1e-9)
            widest = max(widest, float(np.max(np.abs(true))))
        assert max(np.linalg.norm(g.whole) + g.error + g.slack for g in G) < 40 * widest  # not everything is held


@pytest.mark.parametrize(("disturbed", "lo", "hi", "order"), slow_after(3, CASES))
def test_leaves_hold_the_mean_over_a_period_in_which_what_is_uncertain_switches(
    disturbed: bool, lo: str, hi: str, order: int
) -> None:
    data, generator = curved_plant(disturbed, lo, hi, order), np.random.default_rng(order + 10)
    c = replace(parse(data), levels={"floor": 1.0, "local": 1.0, "roa": 4.0})
    ring = Ring.of(Case(c))
    centre, radius = 0.3 * generator.standard_normal((2, 6)), 10.0 ** generator.uniform(-4, -1.5, (2, 6))
    with np.errstate(all="ignore"):
        states, G, between_ = on_boxes(ring, centre, radius)
        rise = Taylor.of(ring.rise(states, G))
        G = [Taylor.of(g) for g in G]
    ends = np.array([[float(q) for q in pair] for pair in c.ranges]).T
    symbols = 2 + (lo != hi)
    known = np.flatnonzero(np.isfinite(G[0].r + G[1].r))
    assert len(known) >= 4
    for index in known:
        for _ in range(12):
            d = np.where(generator.random(2) < 0.5, np.sign(generator.standard_normal(2)), generator.uniform(-1, 1, 2))
            x = centre[:, index] + radius[:, index] * d
            h, pieces, path, y = period_of(data, x, disturbed, (lo, hi), ends, generator)
            true = (path[-1] - x) / h
            for model, each in zip(G, true.tolist(), strict=True):
                assert holds(replace_slack(model), index, 2, symbols, [*d, *y], arb(each)), (index, pieces)
            D = float((path[-1] @ path[-1] - x @ x) / h)
            assert holds(replace_slack(rise), index, 2, symbols, [*d, *y], arb(D), below=True), (index, pieces)
            if x @ x <= 4:
                assert np.all(np.array(path) >= between_[0, :, index] - 1e-9)
                assert np.all(np.array(path) <= between_[1, :, index] + 1e-9)


def replace_slack(model: Taylor) -> Taylor:
    """With room for what integration and rounding of points may miss."""
    return Taylor(model.c, model.g, model.Q, model.r + 1e-9)


def idle(equations: list[Any], names: str, h: str, order: int = 1) -> Document:
    """A practical claim about equations that ignore the input, with quantities in [-1, 1]."""
    n = len(equations)
    data = make(
        [["+", tree, ["*", "0", "u"]] for tree in equations], [(np.zeros((1, n)), [0.0])], np.eye(n), (0.25,) * 3,
        states="xy"[:n], domain=[("-3", "3")] * n, claim="practical", uncertain=[(name, "-1", "1") for name in names],
        sample=(h, h), order=order,
    )  # fmt: skip
    return edited(fitted(data), "evidence.local.order", order)


def test_a_symbol_in_the_place_of_the_mean_is_not_enough_for_its_square() -> None:
    """x' = q^2, q = 1 and -1 for half a period each: the mean of q is 0, that of q^2 is 1."""
    case = Case(parse(idle([["**", "q", 2]], "q", "1/8")))
    [g] = map(Taylor.of, on_boxes(Ring.of(case), np.zeros((1, 1)), np.full((1, 1), 0.1))[1])
    assert float(g.c[0] + g.r[0]) >= 1.0
    [jet] = seen(Local.of(case).G(next(iter(case.cells))))
    assert jet.c + jet.error >= 1.0


@pytest.mark.parametrize("order", [1, 2, 3])
def test_the_order_of_values_within_a_period_counts(order: int) -> None:
    """x' = q, y' = x: the same, and linear in q."""
    h, case = 0.25, Case(parse(idle(["q", "x"], "q", "1/4", order)))
    for jet, each in zip(seen(Local.of(case).G(next(iter(case.cells)))), (0.0, h / 4), strict=True):
        assert within_jet(jet, [0.0], np.zeros(2), each, 1e-12)
    for model, each in zip(
        on_boxes(Ring.of(case), np.zeros((2, 1)), np.full((2, 1), 0.01))[1], (0.0, h / 4), strict=True
    ):
        assert holds(replace_slack(Taylor.of(model)), 0, 2, 1, [0.0, 0.0, 0.0], arb(each))


@pytest.mark.parametrize("order", [1, 2, 3, 5])
def test_what_switches_within_a_period_may_do_what_no_constant_does(order: int) -> None:
    """x' = q, y' = p x: from 0, with p = 1, and q = 1 and then -1, y rises by h^2/4, and q has mean 0."""
    h, case = 0.25, Case(parse(idle(["q", ["*", "p", "x"]], "qp", "1/4", order)))
    path = travelled(np.zeros(2), lambda at, w: np.array([w, at[0]]), [(h / 2, 1.0), (h / 2, -1.0)])
    true = path[-1] / h
    assert true == pytest.approx([0, h / 4], abs=1e-12)
    for jet, each in zip(seen(Local.of(case).G(next(iter(case.cells)))), true, strict=True):
        assert within_jet(jet, [0.0, 1.0], np.zeros(2), each, 1e-12)
    for model, each in zip(on_boxes(Ring.of(case), np.zeros((2, 1)), np.full((2, 1), 0.01))[1], true, strict=True):
        assert holds(replace_slack(Taylor.of(model)), 0, 2, 2, [0.0, 0.0, 0.0, 1.0], arb(each))


@dataclasses.dataclass(frozen=True)
class Number:
    """An arithmetic for series, of one number each."""

    v: arb

    def __add__(self, other: Number) -> Number:
        return Number(self.v + other.v)

    def __neg__(self) -> Number:
        return Number(-self.v)

    def __mul__(self, other: Number) -> Number:
        return Number(self.v * other.v)

    def function(self, name: str) -> Number:
        return Number(1 / self.v if name == "inv" else getattr(self.v, name)())


@pytest.mark.parametrize("name", ["sin", "cos", "exp", "tanh", "atan", "sqrt", "inv"])
@pytest.mark.parametrize("length", [1, 2, 4, 7])
def test_coefficients_of_functions_are_those_of_the_series(name: str, length: int) -> None:
    """phi(v) at several instants, from the coefficients of v: what is left is of the order that follows."""
    generator, count = np.random.default_rng(length), 7
    v = [Number(arb(float(c))) for c in [1.5, *generator.uniform(-1, 1, length - 1)]]
    with ctx.workprec(400):
        found = Series(v, count, lambda q: Number(arb(q.numerator) / q.denominator)).function(name).parts
        for t in (arb(2) ** -20, -(arb(2) ** -21)):
            at = sum((c.v * t**k for k, c in enumerate(v)), arb(0))
            left = Number(at).function(name).v - sum((c.v * t**k for k, c in enumerate(found)), arb(0))
            assert abs(left) < 1000 * abs(t) ** count


# -------------------------------------------------------------------------------------------- the inequality of a step


def stepped(generator: Generator, n: int, units: int, count: int) -> tuple[list[Jet], Units]:
    m = 2
    U = np.zeros((m, n, n))
    jets = [
        changed(
            swaying(generator, n, U, count, 0.4),
            B=generator.standard_normal(m),
            c=np.float64(0.2 * generator.standard_normal()),
        )
        for _ in range(n)
    ]
    return jets, units_of(generator.standard_normal((m, units)), shares(generator, units, n))


def beyond(jets: list[Jet], units: Units, generator: Generator, d: np.ndarray) -> np.ndarray:
    """What some member of the models has beyond f and a.d; all errors are at an end of what they may be."""
    errors = np.array([generator.choice([-1, 1]) * (d @ R @ d) for R in remainders(units)])
    own = np.array([generator.choice([-1, 1]) * (d @ jet.E @ d) for jet in jets])
    with ctx.workprec(120):
        curves = np.array([float(curved(jet, d.tolist()).mid()) for jet in jets])
    return curves + np.array([jet.B for jet in jets]) @ units.L @ errors + own


@pytest.mark.parametrize("n", [1, 2, 3])
def test_gamma_bounds_what_models_have_beyond_their_first_order(n: int) -> None:
    generator, used = np.random.default_rng(n), 0.0
    for _ in range(15):
        jets, units = stepped(generator, n, 3, 0)
        root = generator.standard_normal((n, n))
        P = root @ root.T + 0.1 * np.eye(n)
        most = size_beyond(models_of(np.eye(n), jets, units, True), P)
        for _ in range(40):
            d = generator.standard_normal(n)
            d /= np.linalg.norm(d) * (1 + 2.0**-40)
            d *= generator.choice([1.0, 1.0, 0.3])
            g = beyond(jets, units, generator, d)
            length = float(np.sqrt(g @ P @ g))
            assert length <= most * (d @ d) * (1 + 1e-12)
            used = max(used, length / (most * (d @ d)))
    assert used > 0.2


@pytest.mark.parametrize("n", [1, 2])
@pytest.mark.parametrize("level", [False, True])
@pytest.mark.parametrize("h", slow_after(1, [0.0, 0.25, 1.0]))
def test_the_sides_of_a_step_bound_what_they_stand_for(n: int, level: bool, h: float) -> None:
    """D + 2 lambda V + k (V - c0) at points is at most what the matrices say, at every corner and between them."""
    generator, closest = np.random.default_rng(n), np.inf
    for _ in range(12):
        count = int(generator.integers(0, 3))
        jets, units = stepped(generator, n, 2, count)
        jets = [changed(jet, error=0.05 * generator.random(), slack=0.05 * generator.random()) for jet in jets]
        root, J = generator.standard_normal((2, n, n))
        P = root @ root.T + 0.1 * np.eye(n)
        rate, c0, k = 0.3, 0.5, float(generator.choice([0.0, 0.7, 2.0]))
        rows = np.exp(generator.uniform(-3, 1, (3, n))).tolist()
        by = Multipliers(*(tuple(map(q, row)) for row in rows), np.eye(n))
        models = models_of(J, jets, units, not level)
        most, around = size_beyond(models, P), Level(q(c0), q(k)) if level else None
        for corner, signs in zip(models.corners(), itertools.product((1, -1), repeat=count), strict=True):
            R = 2 * q(rate) * exactly(P)
            decay, rest = sides(corner, exactly(P), R, by, None, q(h), q(most), around)
            left = numbers(decay - rest)
            for _ in range(25):
                d = generator.standard_normal(n)
                d /= np.linalg.norm(d) * (1 + 2.0**-40)
                d *= generator.choice([1.0, 1.0, 0.5, 0.01])
                at = [given(changed(jet, error=0.0, slack=0.0), list(signs)) for jet in jets]
                f = np.array([jet.c for jet in at]) + np.array([jet.error for jet in jets]) * generator.choice(
                    [-1, 1], n
                )
                away = generator.standard_normal((n, n))
                away /= np.linalg.norm(away, axis=1, keepdims=True)
                a = np.array([jet.a for jet in at]) + np.array([[jet.slack] for jet in jets]) * away
                G = (f if level else 0 * f) + a @ d + beyond(jets, units, generator, d)
                x = J @ d
                V = x @ P @ x
                true = 2 * x @ P @ G + h * G @ P @ G + 2 * rate * V + (k * (V - c0) if level else 0.0)
                y = np.append(1.0, d) if level else d
                bound = -float(y @ left @ y)
                assert true <= bound + 1e-9 * (1 + abs(bound))
                closest = min(closest, (bound - true) / (1 + abs(bound)))
    assert closest < 0.5


def test_what_is_left_counts_twice_with_the_value_that_it_is_added_to() -> None:
    """Next to x = 0 the increment f + c d^2 has the square f^2 + 2 f c d^2 + c^2 d^4."""
    f, c, small = 1.0, 0.5, 2.0**-30
    jet = plain(np.float64(f), 0.0, np.zeros(1), 0.0, np.full((1, 1), c), np.zeros((1, 1)))
    models, one = models_of(np.full((1, 1), small), [jet], no_units(1), False), np.eye(1)
    by, around = Multipliers((fmpq(1),), (fmpq(1),), (fmpq(1),), one), Level(q(1.0), q(0.0))
    decay, rest = sides(models, exactly(one), exactly(0 * one), by, None, q(1.0), q(size_beyond(models, one)), around)
    left = numbers(decay - rest)
    for d in (1.0, -1.0, 0.5):
        y, true = np.array([1.0, d]), (f + c * d * d) ** 2
        assert true - 1e-6 <= -(y @ left @ y) <= true + c * c + 1e-6  # S_apart has c^2 more


def q(value_: float) -> fmpq:
    return fmpq(*float(value_).as_integer_ratio())


def numbers(A: fmpq_mat) -> np.ndarray:
    return np.array([[float(Fraction(int(v.p), int(v.q))) for v in row] for row in A.tolist()])


# ----------------------------------------------------------------------------------------- the a-priori box of a leaf

Field = Callable[[list[Any]], list[Any]]


def around(lo: np.ndarray, hi: np.ndarray) -> list[Any]:
    """Models of all states of boxes (n, B)."""
    slopes = np.eye(len(lo))[:, :, None] * (0.5 * (hi - lo))[:, None]
    return [affine(c, g) for c, g in zip(0.5 * (lo + hi), slopes, strict=True)]


def by_the_checker(field: Field, lo: np.ndarray, hi: np.ndarray, h: float) -> np.ndarray:
    """The ends (n, 2, B) of the states of a period from boxes (n, B), rationals, None where there are none."""
    with np.errstate(all="ignore"):  # boxes of states that escape
        during, _ = enclosed(field, around(lo, hi), h)
    ends = np.array([v.range.ends for v in during])
    found = np.full(ends.shape, None)
    for at in np.argwhere(np.isfinite(ends).all((0, 1)))[:, 0]:
        found[:, :, at] = [[Fraction(v) for v in pair] for pair in ends[:, :, at]]
    return found


def by_the_reference(field: Field, lo: np.ndarray, hi: np.ndarray, h: float) -> np.ndarray:
    n, names = len(lo), [f"x{i}" for i in range(len(lo))]

    def evaluate(known: Mapping[str, Any], *rest: object) -> list[Any]:
        return field([known[name] for name in names])

    c: Any = SimpleNamespace(n=n, plant=SimpleNamespace(states=names, dynamics=SimpleNamespace(evaluate=evaluate)))
    found = np.full((n, 2, lo.shape[1]), None)
    with ctx.workprec(ON_LEAVES):
        for at in range(lo.shape[1]):
            ends = [(arb(a), arb(b)) for a, b in zip(lo[:, at].tolist(), hi[:, at].tolist(), strict=True)]
            rows = [arb_mat(1, n, [(b - a) / 2 * (i == j) for j in range(n)]) for i, (a, b) in enumerate(ends)]
            states = {k: BallModel((a + b) / 2, g) for k, (a, b), g in zip(names, ends, rows, strict=True)}
            leaf = Moving(states, {}, {}, {}, None, (), (), None)
            with suppress(Refused):
                within, _ = moved_within(c, leaf, arb(h), "leaf")
                sides = [(v.c - v.first - v.r, v.c + v.first + v.r) for v in within.values()]
                found[:, :, at] = [[rational(a.lower()), rational(b.upper())] for a, b in sides]
    return found


def rational(v: arb) -> Fraction:
    digits, exponent = v.man_exp()
    return Fraction(int(digits)) * Fraction(2) ** int(exponent)


BOTH = pytest.mark.parametrize("program", [by_the_checker, by_the_reference])


def constant_beside(x: Any) -> Callable[[Fraction], Any]:
    """Constants in the numbers of x: those of either program, or floats."""
    if isinstance(x, BallModel):
        return lambda q: constant(fmpq(q.numerator, q.denominator))
    return float if isinstance(x, np.ndarray) else constants(x)


def cubic(terms: np.ndarray) -> Field:
    """The fields k_i0 + k_i1 x + k_i2 y + k_i3 x y + k_i4 x^3 + k_i5 y^3 of models, or numbers."""

    def field(states: list[Any]) -> list[Any]:
        x, y = states
        number = constant_beside(x)
        parts = [number(Fraction(1)), x, y, x * y, x * x * x, y * y * y]
        found = []
        for row in terms.tolist():
            each = [number(Fraction(k)) * part for k, part in zip(row, parts, strict=True)]
            found.append(sum(each[1:], each[0]))
        return found

    return field


@BOTH
def test_solutions_stay_in_the_a_priori_box(program: Any) -> None:
    """Random cubic fields, solutions from corners and within, by short steps; boxes that are far from square too."""
    generator, seen, one_sided = np.random.default_rng(0), 0, 0
    for _ in range(20):
        terms = generator.standard_normal((2, 6)) * 2.0 ** generator.integers(-3, 3, (2, 6))
        lo = generator.uniform(-2, 2, (2, 8))
        hi, h = lo + 2.0 ** generator.integers(-8, 0, (2, 8)), 2.0 ** float(generator.integers(-6, -1))
        ends = program(cubic(terms), lo, hi, h).astype(float)
        held = np.isfinite(ends).all((0, 1))
        seen += int(held.sum())
        falls, rises = lo - ends[:, 0], ends[:, 1] - hi
        one_sided += int((held & ((rises > 4 * falls) | (falls > 4 * rises))).sum())
        for at in (lo, hi, np.stack([lo[0], hi[1]]), np.stack([hi[0], lo[1]]), generator.uniform(lo, hi)):
            x = at[:, held]
            for _ in range(40):
                x = x + h / 40 * np.array(cubic(terms)(list(x + h / 80 * np.array(cubic(terms)(list(x))))))
                assert np.all((ends[:, 0, held] < x + 1e-12) & (x - 1e-12 < ends[:, 1, held]))
    assert seen > 60 and one_sided > 20


def test_rates_of_the_a_priori_box_hold_along_it() -> None:
    """The checker's f there at random points of the box."""
    generator = np.random.default_rng(2)
    for _ in range(10):
        terms = generator.standard_normal((2, 6)) * 2.0 ** generator.integers(-3, 3, (2, 6))
        lo = generator.uniform(-2, 2, (2, 8))
        with np.errstate(all="ignore"):
            during, F = enclosed(cubic(terms), around(lo, lo + 2.0 ** generator.integers(-8, 0, (2, 8))), 1 / 32)
        ends, rates = (np.array([v.range.ends for v in some]) for some in (during, F))  # (n, 2, B)
        held = np.isfinite(ends).all((0, 1))
        for at in np.array(list(itertools.product([0.0, 0.5, 1.0], repeat=2))):
            x = ends[:, 0, held] + at[:, None] * (ends[:, 1, held] - ends[:, 0, held])
            f = np.array(cubic(terms)(list(x)))
            assert held.any() and np.all((rates[:, 0, held] <= f + 1e-12) & (f - 1e-12 <= rates[:, 1, held]))


@BOTH
def test_moves_are_less_than_the_way_to_the_ends_of_the_a_priori_box(program: Any) -> None:
    """The condition in rationals for linear fields, whose extremes are at corners: of all sizes, some rows 0, boxes
    with ends of 0 and points. The reference's box is what is found to be below a and b: no more than to these ends."""
    generator, found, strict = np.random.default_rng(1), 0, program is by_the_checker
    for _ in range(30):
        size = 2.0 ** int(generator.choice([-900, -30, 0, 0, 0, 30, 300]))
        A = generator.standard_normal((2, 2)) * generator.choice([0.0, 1.0, 4.0], (2, 1))
        k = generator.standard_normal((2, 1)) * generator.choice([0.0, size], (2, 1))
        lo = generator.standard_normal((2, 6)) * generator.choice([0.0, size], (2, 6))
        hi, h = lo + size * generator.choice([0.0, 0.0, 0.5], (2, 6)), 2.0 ** float(generator.integers(-6, 0))

        def field(v: list[Any], A: np.ndarray = A, k: np.ndarray = k) -> list[Any]:
            number, each = constant_beside(v[0]), zip(A.tolist(), k[:, 0].tolist(), strict=True)
            return [number(Fraction(a)) * v[0] + number(Fraction(b)) * v[1] + number(Fraction(c)) for (a, b), c in each]

        ends = program(field, lo, hi, h)
        for box in range(6):
            low, high = ends[:, :, box].T.tolist()
            if None in low:
                continue
            found += 1
            corners = list(itertools.product(*zip(low, high, strict=True)))
            for i in range(2):
                rates = [
                    sum(Fraction(a) * v for a, v in zip(A[i], x, strict=True)) + Fraction(k[i, 0]) for x in corners
                ]
                fall = Fraction(lo[i, box]) + Fraction(h) * min(*rates, 0) - low[i]
                rise = high[i] - Fraction(hi[i, box]) - Fraction(h) * max(*rates, 0)
                assert (fall > 0 and rise > 0) if strict else (fall >= 0 and rise >= 0)
    assert found > 100


@BOTH
def test_a_state_that_only_falls_is_not_looked_at_above(program: Any) -> None:
    """x' = -x^3 from 5/2: it falls by 5/8 at most in 1/25, but from 5/8 more by 1.2, and so on, so that no box has ends
    that are equally far. A state that escapes has no box: x' = x^2 from 10, which is infinite after 1/10."""
    at = np.array([[2.5]])
    for sign in (1, -1):
        ((low, high),) = sign * program(lambda v: [-(v[0] * v[0] * v[0])], sign * at, sign * at, 1 / 25)[:, ::sign, 0]
        assert 2.5 - 1.25 * 0.625 - 1e-9 <= low < 2.5 / np.sqrt(1.5) and 2.5 <= high <= 2.5 + 1e-9
    for h, held in ((1 / 80, True), (1 / 10, False)):
        found = program(lambda v: [v[0] * v[0]], 4 * at, 4 * at, h)
        assert (None not in found) == held


@BOTH
def test_an_even_box_serves_where_one_with_other_ends_does_not(program: Any) -> None:
    """x' = 2 + x^3 from [-1, 1]: models of the cube bound the lesser move less well if the ends are not equally far."""
    one = np.array([[1.0]])

    def field(v: list[Any]) -> list[Any]:
        return [constant_beside(v[0])(Fraction(2)) + v[0] * v[0] * v[0]]

    for h, held in ((0.08, True), (0.1, True), (0.15, False)):
        assert (None not in program(field, -one, one, h)) == held


@pytest.mark.slow
def test_the_reference_has_an_a_priori_box_where_the_checker_has_one() -> None:
    """Random cubic fields, about the longest period for which the checker has one."""
    generator, asked = np.random.default_rng(3), 0
    for _ in range(12):
        terms = generator.standard_normal((2, 6)) * 2.0 ** generator.integers(-3, 3, (2, 6))
        lo = generator.uniform(-2, 2, (2, 1))
        hi, good, bad = lo + 2.0 ** generator.integers(-8, 0, (2, 1)), 0.0, 1.0
        while bad - good > bad / 128 and bad > 2.0**-10:
            h = (good + bad) / 2
            good, bad = (good, h) if None in by_the_checker(cubic(terms), lo, hi, h) else (h, bad)
        if good:
            asked += bad < 1
            assert None not in by_the_reference(cubic(terms), lo, hi, good)
    assert asked > 6
