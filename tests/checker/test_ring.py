"""The ring rule's multipliers: what they add to Vdot is never negative in the ring, and only there do they help."""

from __future__ import annotations

from fractions import Fraction
from functools import cache

import numpy as np
import pytest
from flint import arb, ctx
from hypothesis import given
from hypothesis import strategies as st

from certify.checker import boxes as checker_boxes
from certify.checker.boxes import multipliers
from certify.checker.case import Case
from certify.checker.exact import exactly, fraction
from certify.checker.ring import Ring
from tests.checker.test_rules import honest, scalar_claim
from tests.support.certificates import grow, parse, verdict
from tests.support.leaves import on_boxes
from tests.support.oracle import policies_in_arb, value_of
from tests.support.plain import Taylor, upper_bound

Array = np.ndarray
CASES = ("scalar", "linear", "rotor", "rotor, preactivation")


@cache
def ring_of(name: str) -> Ring:
    return Ring.of(Case(parse(honest(name))))


def vdot_on(ring: Ring, centre: Array, radius: Array) -> Taylor:
    states, F, _ = on_boxes(ring, centre, radius)
    return Taylor.of(ring.rise(states, F))


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
    T = exactly(ring.T)
    S = [[fraction(v) for v in row] for row in (T.transpose() * exactly(ring.c.P) * T).tolist()]
    generator = np.random.default_rng(seed)
    centre = generator.standard_normal((n, 3)) * 10.0**magnitude
    radius = np.abs(generator.standard_normal((n, 3))) * 10.0 ** generator.uniform(-14, 6)
    level = float(10.0 ** generator.uniform(-9, 6))
    model = Taylor.of(ring.gap(centre, radius, level, sign))
    assert not np.any(model.g[n:]) and not np.any(model.Q[n:]) and not np.any(model.Q[:, n:])
    for index in range(3):
        for _ in range(3):
            d = [Fraction(int(k), 8) for k in generator.integers(-8, 9, n)]
            z = [Fraction(float(centre[i, index])) + Fraction(float(radius[i, index])) * d[i] for i in range(n)]
            V = sum((z[i] * S[i][j] * z[j] for i in range(n) for j in range(n)), Fraction(0))
            lower, upper = ends(model, index, d)
            assert lower <= Fraction(sign) * (Fraction(level) - V) <= upper


@given(seed=st.integers(0, 10**6))
def test_no_multiplier_is_negative_and_none_is_better_than_the_first(seed: int) -> None:
    generator = np.random.default_rng(seed)
    a, b = generator.standard_normal((2, 4, 50)) * 10.0 ** generator.uniform(-3, 3, (2, 1, 50))
    b[generator.random((4, 50)) < 0.2] = 0
    c = np.abs(b).sum(0) * generator.uniform(-1, 1, 50)  # so that the sum is bounded from below
    with np.errstate(divide="ignore", invalid="ignore"):
        found = multipliers(a, b, c)

    def value(k: Array) -> Array:
        return np.asarray(c * k + np.abs(a + k * b).sum(0))

    assert found.shape == (4, 50)
    assert np.all(found >= 0)
    first = np.minimum(value(found[0]), value(np.zeros(50)))  # 0 is tried before any of them
    for other in (*found[1:], 1.01 * found[0], 0.99 * found[0], np.full(50, 1e-2), np.full(50, 3.0)):
        assert np.all(first <= value(other) + 1e-12 * (np.abs(a).sum(0) + np.abs(b).sum(0) * (found[0] + other)))


@pytest.mark.parametrize("name", ["rotor", "rotor, preactivation"])
def test_every_multiplier_is_tried_and_none_depends_on_the_level(name: str) -> None:
    """A search may lower c2 after it has proved a leaf with a multiplier for an earlier c2; the leaf must still hold.

    A k that proves a leaf proves it for every lower c2. The single best k of the first-order part would not do, because
    it is another one for another level. The models are any that could be met: the property is not one of Vdot.
    """
    ring = ring_of(name)
    c, n, count, S = ring.c, ring.n, 20_000, ring.S[:, None]
    generator = np.random.default_rng(2)
    direction = generator.standard_normal((n, count)) / np.sqrt(S)
    direction /= np.sqrt((direction**2 * S).sum(0))
    centre = direction * np.sqrt(c.c2 * generator.uniform(0.7, 1.3, count))
    radius = np.sqrt(c.c2 / S) * 10.0 ** generator.uniform(-2, -0.3, (n, count))
    like = vdot_on(ring, centre, radius)
    bend = 0.2 * generator.standard_normal((*like.g.shape[:1], *like.g.shape))
    vdot = Taylor(0.3 * generator.standard_normal(count), generator.standard_normal(like.g.shape), bend, like.r)
    with np.errstate(divide="ignore", invalid="ignore"):
        bound, best, decided = ring.bound(vdot.model, centre, radius), [], 0
        for level, sign in ((c.c2, 1.0), (0.5 * c.c2, 1.0), (c.c1, -1.0)):
            gap = Taylor.of(ring.gap(centre, radius, level, sign))
            tried = multipliers(vdot.g[:n], gap.g[:n], gap.c)
            best.append(np.sort(tried, axis=0))
            if level == 0.5 * c.c2:
                continue
            for number, k in enumerate(tried):
                other = upper_bound(vdot + gap.scaled(k))
                assert not np.any((other < 0) & (bound >= 0))
                decided += number and np.sum((other < 0) & (upper_bound(vdot + gap.scaled(tried[0])) >= 0))
    assert np.array_equal(best[0], best[1])
    assert decided >= 10  # the second best of the first-order part decides some boxes


def test_a_multiplier_that_is_no_number_proves_nothing() -> None:
    ring = ring_of("rotor")
    centre, radius = np.full((2, 1), 0.1), np.full((2, 1), 1e-3)
    vdot = vdot_on(ring, centre, radius)
    gap = Taylor.of(ring.gap(centre, radius, ring.c.c2, 1.0))
    with np.errstate(all="ignore"):
        for k in (np.nan, np.inf):
            assert not upper_bound(vdot + gap.scaled(np.array([k])))[0] < 0


@pytest.mark.parametrize("name", CASES)
def test_the_bound_holds_wherever_a_box_meets_the_ring(name: str) -> None:
    """Boxes of many sizes around V = c1 and V = c2, against Vdot in Arb at points of the ring."""
    ring = ring_of(name)
    c, n, count = ring.c, ring.n, 200
    generator = np.random.default_rng(0)
    diagonal = ring.S[:, None]
    direction = generator.standard_normal((n, count)) / np.sqrt(diagonal)
    direction /= np.sqrt((direction**2 * diagonal).sum(0))
    level = np.where(np.arange(count) % 2 == 0, c.c2, c.c1)
    centre = direction * np.sqrt(level) * generator.uniform(0.6, 1.2, count)
    radius = (
        np.sqrt(level / diagonal) * 10.0 ** generator.uniform(-2, 0.4, count) * generator.uniform(0.1, 1, (n, count))
    )
    vdot = vdot_on(ring, centre, radius)
    with np.errstate(divide="ignore", invalid="ignore"):
        bound = ring.bound(vdot.model, centre, radius)
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
    monkeypatch.setattr(checker_boxes, "multipliers", lambda a, b, c, least=0.0: np.full((1, *c.shape), -1e9))
    assert verdict(grown) == "ACCEPTED"
