"""The rule for a box: its bound holds wherever the box meets the ring, and tightens at second order."""

from __future__ import annotations

import numpy as np
import pytest

from certify.loop.plants import get_system
from certify.provers.boxes.rule import VdotBound
from certify.provers.execution import ThreadRunner
from tests.provers.test_bounds import vdot
from tests.support.cases import Case, case_of
from tests.support.loops import lqr_gain, pendulum_network, saturated_lqr, scalar_tanh

INNER, OUTER = 0.02, 0.5


def cartpole_case() -> Case:
    system = get_system("cartpole")
    K = lqr_gain(system, np.eye(4), 0.1 * np.eye(1))
    return case_of(system, saturated_lqr(K, 30.0, 0.0, [1.0, 0.5, 1.5, 2.0], (24, 24), "preactivation", 0))


CASES = {
    "scalar": lambda: case_of(*scalar_tanh()),
    "pendulum": lambda: case_of(get_system("pendulum"), pendulum_network()),
    "cartpole": cartpole_case,
}


def scalar_rule() -> VdotBound:
    case = CASES["scalar"]()
    return VdotBound(case.problem, case.T)


def boxes(n: int, count: int, size: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Boxes in z with half-widths up to `size`, whose centres lie around the ring's two edges and between."""
    generator = np.random.default_rng(seed)
    centre = generator.standard_normal((n, count))
    centre *= np.sqrt(generator.uniform(0.5 * INNER, 1.2 * OUTER, count)) / np.linalg.norm(centre, axis=0)
    radius = size * generator.uniform(0.2, 1.0, (n, count))
    return np.array(centre - radius), np.array(centre + radius)


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("size", [0.5, 0.1, 1e-3])
def test_the_bound_holds_wherever_a_box_meets_the_ring(name: str, size: float) -> None:
    case = CASES[name]()
    n = case.loop.system.n
    lo, hi = boxes(n, 300, size)
    found = VdotBound(case.problem, case.T)(lo, hi, INNER, OUTER)
    generator = np.random.default_rng(1)
    met = 0
    for _ in range(30):
        share = generator.random(lo.shape)
        share = np.where(generator.random(lo.shape) < 0.3, np.round(share), share)
        z = (lo + share * (hi - lo)).T
        inside = ((z**2).sum(1) >= INNER) & ((z**2).sum(1) <= OUTER)
        values = vdot(case, z[inside] @ case.T.T)
        assert np.all(values <= found.bound[inside] + 1e-12)
        met += int(inside.sum())
    assert met > 500
    assert np.array_equal(found.proved, found.bound < 0)


@pytest.mark.parametrize("name", CASES)
def test_the_bound_is_of_second_order(name: str) -> None:
    """Bound less the sampled maximum, at halved sizes, away from the ring's edges."""
    case = CASES[name]()
    n = case.loop.system.n
    rule = VdotBound(case.problem, case.T)
    corners = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * n, indexing="ij"), -1).reshape(-1, n)
    errors = []
    for size in (0.04, 0.02, 0.01):
        lo, hi = boxes(n, 60, size)
        centre, radius = ((lo + hi) / 2), ((hi - lo) / 2)
        z = centre.T[:, None] + corners[None] * radius.T[:, None]
        highest = vdot(case, z.reshape(-1, n) @ case.T.T).reshape(60, -1).max(1)
        errors.append(float(np.median(rule(lo, hi, 1e-12, 1e12).bound - highest)))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.all(orders > 1.7), errors


def test_multipliers_decide_boxes_that_stick_out_of_the_ring() -> None:
    """xdot = x/2 - tanh x: the box [1.9, 1.93] holds a violation at 1.915008, beyond V = 1.914^2."""
    rule = scalar_rule()
    scale = float(rule.T[0, 0])
    lo, hi = (np.array([[v / scale]]) for v in (1.9, 1.93))
    below, above = ((v / scale) ** 2 for v in (1.914, 1.916))
    assert bool(rule(lo, hi, 1e-3, below).proved)
    assert not bool(rule(lo, hi, 1e-3, above).proved)
    inner = np.array([[1e-3]])
    assert bool(rule(-inner, 50 * inner, 1e-4, 1.0).proved)  # the origin lies in it, below the ring
    assert not bool(rule(-inner, 50 * inner, 1e-300, 1.0).proved)


def test_a_violation_at_the_centre_is_seen() -> None:
    rule = scalar_rule()
    scale = float(rule.T[0, 0])
    lo, hi = (np.array([[v / scale, u / scale]]) for v, u in ((2.0, 1.0), (2.1, 1.1)))
    assert rule(lo, hi, 1e-3, 1e3).violated.tolist() == [True, False]


def test_threads_do_not_change_the_bounds() -> None:
    case = CASES["cartpole"]()
    rule = VdotBound(case.problem, case.T)
    lo, hi = boxes(4, 1500, 0.05)
    with ThreadRunner(2).start(rule) as bound:
        pieces = bound(lo, hi, INNER, OUTER)
    for a, b in zip(pieces, rule(lo, hi, INNER, OUTER), strict=True):
        assert np.array_equal(a, b)
