"""The ring rule's multipliers: what they add to Vdot is never negative in the ring, and only there do they help."""

from __future__ import annotations

from fractions import Fraction
from functools import cache

import numpy as np
import pytest
from flint import arb, ctx
from hypothesis import given
from hypothesis import strategies as st

from certify.checker import ring as checker_ring
from certify.checker.case import Case
from certify.checker.exact import congruence, rational
from certify.checker.network import enclose_on_boxes
from certify.checker.ring import Ring, multiplier
from certify.checker.taylor import Taylor, upper_bound
from tests.checker.test_rules import honest, scalar_claim
from tests.support.certificates import grow, parse, verdict
from tests.support.oracle import policies_in_arb, value_of

Array = np.ndarray
CASES = ("scalar", "linear", "rotor", "rotor, preactivation")


@cache
def ring_of(name: str) -> Ring:
    return Ring(Case(parse(honest(name))))


def vdot_on(ring: Ring, centre: Array, radius: Array) -> Taylor:
    x, error = ring.states(centre, radius)
    vdot, _ = ring.models(x, error, *enclose_on_boxes(ring.net, x, error))
    return vdot


def ends(model: Taylor, index: int, d: list[Fraction]) -> tuple[Fraction, Fraction]:
    """Exact lower and upper end of a model at the box coordinates d."""
    n = len(d)
    value = Fraction(float(model.c[index]))
    for i in range(n):
        value += Fraction(float(model.g[i, index])) * d[i]
        value += sum(Fraction(float(model.Q[i, j, index])) * d[i] * d[j] for j in range(n))
    r = Fraction(float(model.r[index]))
    return value - r, value + r


@pytest.mark.parametrize("name", CASES)
@given(seed=st.integers(0, 10**6), magnitude=st.floats(-12, 6), sign=st.sampled_from([1.0, -1.0]))
def test_the_gap_contains_what_it_stands_for(name: str, seed: int, magnitude: float, sign: float) -> None:
    """sign (level - V) with V = z'Sz in fractions, at points centre + radius d."""
    ring = ring_of(name)
    n = ring.n
    S = congruence(rational(ring.T), rational(ring.c.P))
    generator = np.random.default_rng(seed)
    centre = generator.standard_normal((n, 3)) * 10.0**magnitude
    radius = np.abs(generator.standard_normal((n, 3))) * 10.0 ** generator.uniform(-14, 6)
    level = float(10.0 ** generator.uniform(-9, 6))
    model = ring.gap(centre, radius, level, sign)
    assert not np.any(model.g[n:]) and not np.any(model.Q[n:]) and not np.any(model.Q[:, n:])
    for index in range(3):
        for _ in range(3):
            d = [Fraction(int(k), 8) for k in generator.integers(-8, 9, n)]
            z = [Fraction(float(centre[i, index])) + Fraction(float(radius[i, index])) * d[i] for i in range(n)]
            V = sum((z[i] * S[i][j] * z[j] for i in range(n) for j in range(n)), Fraction(0))
            lower, upper = ends(model, index, d)
            assert lower <= Fraction(sign) * (Fraction(level) - V) <= upper


@given(seed=st.integers(0, 10**6))
def test_the_multiplier_is_not_negative_and_no_other_is_better(seed: int) -> None:
    generator = np.random.default_rng(seed)
    a, b = generator.standard_normal((2, 4, 50)) * 10.0 ** generator.uniform(-3, 3, (2, 1, 50))
    b[generator.random((4, 50)) < 0.2] = 0
    c = np.abs(b).sum(0) * generator.uniform(-1, 1, 50)  # so that the sum is bounded from below
    with np.errstate(divide="ignore", invalid="ignore"):
        k = multiplier(a, b, c)

    def value(k: Array) -> Array:
        return np.asarray(c * k + np.abs(a + k * b).sum(0))

    assert np.all(k >= 0)
    for other in (np.zeros(50), 1.01 * k, 0.99 * k, np.full(50, 1e-2), np.full(50, 3.0)):
        assert np.all(value(k) <= value(other) + 1e-12 * (np.abs(a).sum(0) + np.abs(b).sum(0) * (k + other)))


def test_a_multiplier_that_is_no_number_proves_nothing() -> None:
    ring = ring_of("rotor")
    centre, radius = np.full((2, 1), 0.1), np.full((2, 1), 1e-3)
    vdot = vdot_on(ring, centre, radius)
    gap = ring.gap(centre, radius, ring.c.c2, 1.0)
    with np.errstate(all="ignore"):
        for k in (np.nan, np.inf):
            assert not upper_bound(vdot + gap.scaled(np.array([k])))[0] < 0


@pytest.mark.parametrize("name", CASES)
def test_the_bound_holds_wherever_a_box_meets_the_ring(name: str) -> None:
    """Boxes of many sizes around V = c1 and V = c2, against Vdot in Arb at points of the ring."""
    ring = ring_of(name)
    c, n, count = ring.c, ring.n, 200
    generator = np.random.default_rng(0)
    diagonal = ring.S
    direction = generator.standard_normal((n, count)) / np.sqrt(diagonal)
    direction /= np.sqrt((direction**2 * diagonal).sum(0))
    level = np.where(np.arange(count) % 2 == 0, c.c2, c.c1)
    centre = direction * np.sqrt(level) * generator.uniform(0.6, 1.2, count)
    radius = (
        np.sqrt(level / diagonal) * 10.0 ** generator.uniform(-2, 0.4, count) * generator.uniform(0.1, 1, (n, count))
    )
    vdot = vdot_on(ring, centre, radius)
    with np.errstate(divide="ignore", invalid="ignore"):
        bound = ring.bound(vdot, centre, radius)
    assert np.all(bound <= upper_bound(vdot))
    assert np.sum((bound < 0) & (upper_bound(vdot) >= 0)) >= 2  # the multipliers decide some boxes
    ctx.prec = 128
    met = 0
    for index in range(count):
        d = generator.uniform(-1, 1, (n, 4))
        z = np.where(generator.random(d.shape) < 0.3, np.sign(d), d) * radius[:, [index]] + centre[:, [index]]
        V = (diagonal * z * z).sum(0)
        inside = (c.c1 * (1 + 1e-9) < V) & (c.c2 * (1 - 1e-9) > V)
        x = (c.evidence.T @ z[:, inside]).T
        met += len(x)
        for value in vdots(ring, x):
            assert value <= arb(float(bound[index])) + 1e-12 * abs(value)  # 1e-12 for x = T z rounded
    assert met > 100


def vdots(ring: Ring, x: Array) -> list[arb]:
    """Vdot = 2 x'P f(x, pi(x)) in Arb at states (k, n)."""
    if not len(x):
        return []
    data = HONEST_DYNAMICS[ring.c.states]
    states = [[arb(float(v)) for v in row] for row in x]
    result = []
    for row, u in zip(states, policies_in_arb(ring.c.policy, ring.c.u_eq, states), strict=True):
        names = dict(zip((*ring.c.states, *ring.c.inputs), (*row, *u), strict=True))
        F = [value_of(tree, names) for tree in data]
        P = ring.c.P.tolist()
        result.append(2 * sum((row[i] * P[i][j] * F[j] for i in range(ring.n) for j in range(ring.n)), arb(0)))
    return result


HONEST_DYNAMICS = {parse(honest(name)).states: honest(name)["plant"]["dynamics"] for name in CASES}


@pytest.mark.parametrize(("root", "expected"), [(1.914, "ACCEPTED"), (1.916, "ring")])
def test_a_leaf_may_reach_beyond_the_truth_but_the_level_may_not(root: float, expected: str) -> None:
    """xdot = x/2 - tanh x, whose region of attraction is |x| < 1.915008."""
    data = grow(scalar_claim(c2=root**2, bias=0.0, root=[2.5]), max_leaves=400)
    assert verdict(data) == expected


def test_a_negative_multiplier_would_accept_what_is_false(monkeypatch: pytest.MonkeyPatch) -> None:
    """With c2 beyond the truth, the leaf of a violation is refused because of the multiplier's sign alone."""
    false = scalar_claim(c2=2.2**2, bias=0.0)
    grown = grow(false, max_leaves=400, depth=12)
    assert verdict(grown) == "ring"
    monkeypatch.setattr(checker_ring, "multiplier", lambda a, b, c: np.full_like(c, -1e9))
    assert verdict(grown) == "ACCEPTED"
