"""The candidate for which few boxes are forecast: what a round gains, and where it is asked for at all."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from certify.analysis.candidates.economical import Forecast, economical_candidate
from certify.analysis.candidates.trials import economical, economical_from, trial
from certify.analysis.options import RoaOptions
from certify.effort import UNLIMITED, Effort
from certify.loop.closed_loop import ClosedLoop
from certify.loop.plants import get_system
from certify.loop.policies import PolicyNetwork, load_policy
from certify.lyapunov import choose_candidate, slowest_decay, volume
from tests.support.mutants import POLICIES

BOXES = 30_000


def bent(damping: float = 1.0, seed: int = 0, aside: float = 0.0) -> ClosedLoop:
    """The planar quadrotor under one layer of 24 units, whose slope at the origin is a gain, with a share of its
    damping, and which saturate; `aside` keeps the policy from being centred."""
    system, generator = get_system("quadrotor2d"), np.random.default_rng(seed)
    shipped = ClosedLoop(system, load_policy(POLICIES / "quadrotor2d.pt").network)
    first = 3 * generator.standard_normal((24, 6)) / np.array([3, 3, 1.2, 8, 8, 8])
    K = shipped.linearise()[2] * np.array([1, 1, 1, damping, 1, damping])
    layers = [first, -K @ np.linalg.pinv(first)], [np.zeros(24), np.full(2, aside)]
    centre = "none" if aside else "output"
    return ClosedLoop(system, PolicyNetwork.of_layers(*layers, np.ones(2), shipped.u_eq, "identity", centre))


@pytest.fixture(scope="module")
def curved() -> ClosedLoop:
    return bent()


def starts(loop: ClosedLoop) -> list[np.ndarray]:
    return [choose_candidate(loop, name).P for name in ("lyapunov", "scaled")]


def test_a_round_needs_fewer_boxes_for_a_set_as_large(curved: ClosedLoop) -> None:
    forecast, (P, _) = Forecast(curved, states=400), starts(curved)
    level = forecast.level(P, BOXES)
    new = forecast.easier(P, level, 0.1)
    assert np.linalg.det(new) == pytest.approx(np.linalg.det(P))
    assert np.all(np.linalg.eigvalsh(new) > 0) and np.array_equal(new, new.T)
    assert forecast.boxes(new, level) < 0.9 * forecast.boxes(P, level)


def test_the_candidate_is_larger_for_the_same_boxes_by_states_that_it_has_not_seen(curved: ClosedLoop) -> None:
    P = economical_candidate(curved, starts(curved), BOXES)
    unseen = Forecast(curved, states=1000, seed=1)
    assert unseen.boxes(P, 1.0) < 2 * BOXES
    before = max(volume(start, unseen.level(start, BOXES)) for start in starts(curved))
    assert volume(P, unseen.level(P, BOXES)) > 1.5 * before


def test_a_larger_set_needs_more_boxes_and_the_error_counts(curved: ClosedLoop) -> None:
    forecast, (P, _) = Forecast(curved, states=400), starts(curved)
    level = forecast.level(P, BOXES)
    assert forecast.boxes(P, level) == pytest.approx(BOXES, rel=0.4)
    assert forecast.boxes(P, 2 * level) > 2 * forecast.boxes(P, level) > 8 * forecast.boxes(P, level / 2)


def test_where_no_effort_is_left_the_best_start_is_taken(curved: ClosedLoop) -> None:
    P = economical_candidate(curved, starts(curved), BOXES, Effort(1.0))
    assert any(np.allclose(P / P[0, 0], start / start[0, 0]) for start in starts(curved))


def test_it_is_asked_for_where_boxes_limit_the_proof_alone(curved: ClosedLoop) -> None:
    options, found = RoaOptions(), {"lyapunov": starts(curved)[0]}
    asked = economical(curved, found, 20, options, UNLIMITED)
    assert asked is not None and asked.name == "economical"
    assert economical(curved, found, 1e12, options, UNLIMITED) is None


def test_corners_of_ranges_count(curved: ClosedLoop) -> None:
    """A wider range takes more boxes, and one of no extent none."""
    (P, _), taken = starts(curved), list[float]()
    level = Forecast(curved, states=2000).level(P, BOXES)
    middle = curved.system.parameters["I"]
    for share in (0, Fraction(1, 10**9), Fraction(1, 4)):
        ranges = {"I": (middle * (1 - share), middle * (1 + share))} if share else {}
        loop = ClosedLoop(curved.system.with_ranges(ranges), curved.network)
        taken.append(Forecast(loop, states=2000).boxes(P, level))
    assert taken[1] == pytest.approx(taken[0], rel=1e-6) and taken[2] > 1.1 * taken[0]


def held(loop: ClosedLoop, period: Fraction = Fraction(1, 50)) -> ClosedLoop:
    return ClosedLoop(loop.system.with_sample((period, period)), loop.network)


def test_the_forecast_of_a_short_period_is_that_of_none(curved: ClosedLoop) -> None:
    short, (P, _) = held(curved, Fraction(1, 10**6)), starts(curved)
    level = Forecast(curved, states=400).level(P, BOXES)
    plain, other = (Forecast(loop, states=400) for loop in (curved, short))
    assert other.boxes(P, level) == pytest.approx(plain.boxes(P, level), rel=1e-3)
    assert other.decrease(P) == pytest.approx(plain.decrease(P), rel=1e-3)
    changed = Forecast(held(curved), states=400).boxes(P, level) / plain.boxes(P, level)
    assert not 0.99 < changed < 1.01


def test_over_a_period_it_counts_how_v_ends(curved: ClosedLoop) -> None:
    """m is a quotient of what V loses in the period and of what inputs that err change in that."""
    loop, (P, _) = held(curved), starts(curved)
    forecast = Forecast(loop, states=50)
    found = forecast.sampled(P, 0.1)
    x, h = 2 * found.middle - found.end, loop.step

    def value(G: np.ndarray) -> np.ndarray:
        return np.einsum("ki,ij,kj->k", x + h * G, P, x + h * G) / h

    lost = np.einsum("ki,ij,kj->k", x, P, x) / h - value(found.G)
    small = 1e-4
    asked = sum(np.abs(value(found.G + small * e) - value(found.G - small * e)) for e in found.errors.swapaxes(0, 1))
    assert found.margins(P) == pytest.approx(lost / (asked / (2 * small)), rel=1e-4)
    assert found.end == pytest.approx(x + h * found.G)


def test_it_is_made_of_loops_whose_input_is_held(curved: ClosedLoop) -> None:
    loop = held(curved)
    found = [choose_candidate(loop, name).P for name in ("lyapunov", "scaled")]
    P, unseen = economical_candidate(loop, found, BOXES), Forecast(loop, states=1000, seed=1)
    assert unseen.boxes(P, 1.0) < 2 * BOXES
    assert volume(P, unseen.level(P, BOXES)) > 1.5 * max(volume(one, unseen.level(one, BOXES)) for one in found)
    assert unseen.decrease(P) > 0.1 * slowest_decay(loop.mean_rate(), loop.step)


def test_it_is_made_from_another_candidate_where_more_is_forecast_of_it_than_of_all_others(curved: ClosedLoop) -> None:
    options, (P, other) = RoaOptions(), starts(curved)
    certain, large = (trial(curved, one, name, options) for one, name in ((P, "robust"), (other, "large")))
    assert economical_from(curved, certain, [large], 1e12, options, UNLIMITED) is None
    found, forecast = economical_from(curved, certain, [large], 20, options, UNLIMITED), Forecast(curved)
    assert found is not None and found.name == "economical"
    most = max(volume(one.P, forecast.level(one.P, 20)) for one in (certain, large))
    assert volume(found.P, forecast.level(found.P, 20)) > most


def decrease(loop: ClosedLoop, P: np.ndarray) -> float:
    """The largest r with `A'P + PA <= -2 r P`."""
    A, half = loop.mean_rate(), np.linalg.inv(np.linalg.cholesky(P))
    return float(-np.linalg.eigvalsh(half @ (A.T @ P + P @ A) @ half.T).max() / 2)


def test_v_falls_in_the_few_directions_that_samples_miss() -> None:
    loop = bent(damping=0.05, seed=2)
    P = economical_candidate(loop, starts(loop), BOXES)
    slowest = -np.linalg.eigvals(loop.mean_rate()).real.max()
    assert decrease(loop, P) > 0.02 * slowest
    forecast = Forecast(loop, states=400)
    assert forecast.decrease(P) == pytest.approx(decrease(loop, P), rel=1e-6)
    assert volume(P, 1.0) > max(volume(one, forecast.level(one, BOXES)) for one in starts(loop))


def test_a_round_ends_where_v_does_not_fall_at_all(curved: ClosedLoop) -> None:
    A, forecast = curved.mean_rate(), Forecast(curved, states=100)
    P = np.eye(6) + 0.9 * (A + A.T) / np.abs(np.linalg.eigvalsh(A + A.T)).max()
    assert decrease(curved, P) < 0
    assert np.all(np.linalg.eigvalsh(forecast.easier(P, 1e-4, 0.1)) > 0)
