"""Learning beyond an ellipsoid: rows against differences, runs against regions that are known, and what is refused."""

from __future__ import annotations

import dataclasses
import math
from fractions import Fraction

import numpy as np
import pytest

from certify.effort import Effort
from certify.errors import InputError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import Number, Symbol, symbols, tanh
from certify.loop.plants import System
from certify.loop.policies import PolicyNetwork
from certify.lyapunov import Neural, Polynomial
from certify.lyapunov.function import Quadratic
from certify.lyapunov.learning import Learned, fit_polynomial, learn
from certify.lyapunov.learning.counterexamples import Search
from certify.lyapunov.learning.fit import Slopes, Values, along, fit
from certify.lyapunov.learning.flow import Fate, LearningFlow
from certify.lyapunov.learning.models import Model, Network, Terms
from certify.lyapunov.learning.samples import Samples, draw
from tests.support.loops import box, scalar_tanh

EDGE = 1.915008048  # of what x' = x/2 - tanh(x) attracts
UNIT = Quadratic(np.eye(2))
MODELS: list[Model] = [Network(3, (5,)), Network(2, (6, 4)), Network(2, (4, 3, 5)), Terms(2, 4), Terms(3, 2)]


def disc(half: float = 2.0, n: int = 2) -> ClosedLoop:
    """r' = r (r^2 - 1) in n states, turning in the first two: attracted is the open unit ball."""
    states = symbols(f"x{i}" for i in range(0, n))
    u = Symbol("u")
    grows = sum(s**2 for s in states) - 1
    dynamics = [s * grows for s in states]
    dynamics[0] -= states[1]
    dynamics[1] += states[0] + u
    system = System(
        name="disc",
        states=states,
        inputs=(u,),
        parameters={},
        dynamics=tuple(dynamics),
        u_eq=(Number(0),),
        domain=box(*[half] * n),
        input_bounds=box(1),
    )
    return ClosedLoop(system, silent(n))


def silent(n: int) -> PolicyNetwork:
    return PolicyNetwork.of_layers((np.zeros((1, n)),), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none")


def pushed(system: System) -> System:
    """The scalar loop under a disturbance on its rate."""
    w = Symbol("w")
    dynamics = (system.dynamics[0] + w,)
    return dataclasses.replace(
        system, dynamics=dynamics, disturbances=(w,), ranges={"w": (Fraction(-1, 10), Fraction(1, 10))}
    )


# ------------------------------------------------------------------------------------------------------- rows and fits


@pytest.mark.parametrize("model", MODELS)
def test_rows_are_the_limits_of_difference_quotients(model: Model) -> None:
    """Central quotients of a smooth function converge at order 2; a wrong derivative would leave a distance."""
    generator = np.random.default_rng(0)
    p = model.initial(generator)
    p = p + 0.3 * generator.standard_normal(len(p))
    n = model.function(p).n
    z, v, d = (generator.uniform(-1, 1, (9, n)), generator.standard_normal((9, n)), generator.standard_normal(len(p)))

    def values(h: float) -> np.ndarray:
        return np.asarray(model.function(p + h * d)(z))

    def slopes(h: float) -> np.ndarray:
        return along(model.function(p + h * d), z, v)

    for function, rows in ((values, model.value_rows(p, z)), (slopes, model.slope_rows(p, z, v))):
        assert rows.shape == (9, len(p))
        off = [np.max(np.abs((function(h) - function(-h)) / (2 * h) - rows @ d)) for h in (1e-2, 1e-3)]
        assert off[1] < max(off[0] / 50, 1e-9)


@pytest.mark.parametrize("model", MODELS)
def test_a_scaled_function_is_the_same_function(model: Model) -> None:
    generator = np.random.default_rng(1)
    p = model.initial(generator) + generator.standard_normal(len(model.initial(generator)))
    n = model.function(p).n
    scale, z = generator.uniform(0.1, 30, n), generator.uniform(-1, 1, (20, n))
    np.testing.assert_allclose(model.function(p, scale)(z * scale), model.function(p)(z), rtol=1e-9, atol=1e-12)


def test_a_linear_fit_finds_the_polynomial_that_the_values_are_of() -> None:
    model, generator = Terms(2, 4), np.random.default_rng(2)
    true = generator.standard_normal(len(model.exponents))
    z = generator.uniform(-1, 1, (80, 2))
    values = model.function(true)(z)
    nothing = Slopes(z[:0], z[:0], values[:0], values[:0])
    found = fit(model, model.initial(generator), Values(z, values, values, np.ones(80)), nothing, 30, 1e-3)
    np.testing.assert_allclose(found.p, true, atol=1e-3)  # the decay of the parameters moves them a little


def test_rows_that_keep_their_bounds_cost_nothing() -> None:
    z = np.array([[0.0], [1.0]])
    values = Values(z, np.array([-math.inf, 0.5]), np.array([0.0, math.inf]), np.array([1.0, 2.0]))
    assert values.residuals(np.array([-5.0, 7.0])).tolist() == [0.0, 0.0]
    assert values.residuals(np.array([1.0, 0.0])).tolist() == [1.0, -1.0]
    slopes = Slopes(z, z, np.array([-0.1, -0.1]), np.array([1.0, 10.0]))
    np.testing.assert_allclose(slopes.residuals(np.array([-0.3, 0.0])), [0.0, 1.0])


def test_a_fit_trades_values_for_slopes() -> None:
    """Values ask for z^2 on [0, 1] and slopes for a fall along +z there: heavy slopes win."""
    model, z = Terms(1, 2), np.linspace(0.05, 1, 40)[:, None]
    values = Values(z, z[:, 0] ** 2, z[:, 0] ** 2, np.full(40, 0.1))
    slopes = Slopes(z, np.ones((40, 1)), np.full(40, -0.2), np.full(40, 10.0))
    found = model.function(fit(model, np.zeros(3), values, slopes, 40, 1e-3).p)
    assert np.all(found.gradient(z)[:, 0] < -0.19)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Network(2, ()), "positive widths"),
        (lambda: Network(2, (4, 0)), "positive widths"),
        (lambda: Terms(2, 3), "must be even"),
        (lambda: Terms(2, 14), "must be even"),
        (lambda: Values(np.zeros((2, 1)), np.zeros(2), np.zeros(1), np.zeros(2)), "counts differ"),
        (lambda: Slopes(np.zeros((2, 1)), np.zeros((1, 1)), np.zeros(2), np.zeros(2)), "counts differ"),
        (lambda: Samples(np.zeros((2, 1)), np.zeros(2), np.zeros(1), np.ones(1), 0.5), "counts differ"),
    ],
)
def test_what_cannot_be_is_refused(make: object, message: str) -> None:
    with pytest.raises(InputError, match=message):
        make()  # type: ignore[operator]


# ---------------------------------------------------------------------------------------------------- runs and samples


def test_fates_of_runs_from_a_line() -> None:
    system, network = scalar_tanh()
    flow = LearningFlow(ClosedLoop(system, network), Quadratic(np.eye(1)), 0.25)
    x = np.array([0.4, 1.0, EDGE - 0.02, EDGE + 0.05, 2.9, 3.1])[:, None]
    found = flow.run(x, np.ones(1))
    assert found.fate.tolist() == [Fate.CONVERGED] * 3 + [Fate.LOST] * 3
    assert found.length[0] == 0
    np.testing.assert_allclose(found.length[1:3], [0.5, EDGE - 0.52], atol=0.05)  # the way, to a step
    np.testing.assert_array_equal(found.nearness[:3], 0.0)


def test_a_run_along_a_face_pays_for_it_and_one_that_meets_it_is_lost() -> None:
    """In the disc r' = r (r^2 - 1) a domain of half-width 0.9 loses what turns out of it."""
    flow = LearningFlow(disc(0.9), UNIT, 0.01)
    found = flow.run(np.array([[0.5, 0.0], [0.87, 0.0], [0.89, -0.3]]), np.ones(2))
    assert found.fate.tolist() == [Fate.CONVERGED, Fate.CONVERGED, Fate.LOST]
    assert found.nearness[0] == 0 < found.nearness[1] < 1


def test_whoever_asks_for_an_input_out_of_bounds_is_lost() -> None:
    loop = disc()
    network = silent(2).with_layers(weights=(np.array([[0.0, -4.0]]),))
    found = LearningFlow(ClosedLoop(loop.system, network), UNIT, 0.01).run(
        np.array([[0.0, 0.2], [0.0, 0.3]]), np.ones(2)
    )
    assert found.fate.tolist() == [Fate.CONVERGED, Fate.LOST]  # |u| <= 1 means |y| <= 1/4


def test_a_plant_that_is_stiff_far_out_has_steps_by_state() -> None:
    """Steps for the fastest time constant, 1 ms, would come to 2 s; the slowest is 100 s."""
    loop = disc(1.0)
    dynamics = tuple(-s / 100 - 100 * s**9 for s in loop.system.states)
    flow = LearningFlow(ClosedLoop(dataclasses.replace(loop.system, dynamics=dynamics), loop.network), UNIT, 0.01)
    assert flow.by_state and flow.steps * flow.step < 5 and not LearningFlow(disc(), UNIT, 0.01).by_state
    assert flow.run(np.array([[0.9, 0.0], [0.3, -0.8]]), np.ones(2)).converged.all()


def test_runs_last_until_a_saturated_input_has_brought_them_home() -> None:
    """x' = -tanh(60 x) decays at 60 about 0, twelve time constants of which are 1/5; from 2 the way takes two units."""
    loop = disc(n=2)
    fast = tuple(-tanh(60 * s) for s in loop.system.states)
    flow = LearningFlow(ClosedLoop(dataclasses.replace(loop.system, dynamics=fast), loop.network), UNIT, 0.01)
    assert 1.6 <= flow.horizon <= 6.4
    assert flow.run(flow.uniform(300, np.random.default_rng(1)), np.ones(2)).converged.all()
    assert LearningFlow(disc(), UNIT, 0.01).horizon == pytest.approx(12)


def test_runs_are_as_many_as_the_effort_is_worth() -> None:
    few = draw(LearningFlow(disc(), UNIT, 0.04, Effort(2e8)), np.random.default_rng(0))
    many = draw(LearningFlow(disc(), UNIT, 0.04, Effort(1e12)), np.random.default_rng(0))
    assert 900 < len(few.x) < len(many.x) / 2


def test_directions_are_those_of_every_corner() -> None:
    system, network = scalar_tanh()
    flow = LearningFlow(ClosedLoop(pushed(system), network), Quadratic(np.eye(1)), 0.25)
    found = flow.directions(np.array([[0.05], [1.0]]), np.ones(1))[..., 0].T
    np.testing.assert_allclose(found, [[-1.0, 1.0], [-1.0, -1.0]])


def test_values_are_shares_of_the_region() -> None:
    """Of the unit disc, where they are the distance itself: the share of area below r is r^2, and its root is r."""
    flow = LearningFlow(disc(), UNIT, 0.04)
    samples = draw(flow, np.random.default_rng(0))
    radius = np.linalg.norm(samples.x, axis=1)
    assert np.array_equal(samples.attracted, radius < 1)
    np.testing.assert_allclose(samples.value[samples.attracted], radius[samples.attracted], atol=0.03)
    np.testing.assert_allclose(samples.scale, 1.0, atol=0.03)
    assert samples.inner == pytest.approx(0.04, abs=0.01)


@pytest.mark.slow
def test_a_small_region_of_several_states_is_walked_through() -> None:
    """The unit ball is 0.4 % of its domain here; the walk's states fill it evenly."""
    flow = LearningFlow(disc(5.0, 3), Quadratic(np.eye(3)), 0.04)
    samples = draw(flow, np.random.default_rng(0))
    radius = np.linalg.norm(samples.x, axis=1)
    slow = np.abs(radius - 1) < 1e-4  # next to the edge a run takes longer than any that is made
    assert np.array_equal(samples.attracted[~slow], radius[~slow] < 1) and slow.sum() < 10
    assert samples.attracted.sum() > 3000 and (~samples.attracted).sum() > 1000
    np.testing.assert_allclose(
        np.quantile(radius[samples.attracted], [0.25, 0.5, 0.75]) ** 3, [0.25, 0.5, 0.75], atol=0.06
    )
    share = np.mean(samples.value[samples.attracted][:, None] ** 3 <= [0.25, 0.5, 0.75], axis=0)
    np.testing.assert_allclose(share, [0.25, 0.5, 0.75], atol=0.02)  # but for what lies in the ellipsoid


def test_where_nothing_more_converges_nothing_is_learned() -> None:
    with pytest.raises(InputError, match="must converge from outside"):
        draw(LearningFlow(disc(), UNIT, 0.999), np.random.default_rng(0))


# ----------------------------------------------------------------------------------------------------- counterexamples


def searched() -> tuple[LearningFlow, Search]:
    flow = LearningFlow(disc(), UNIT, 0.04)
    samples = draw(flow, np.random.default_rng(0))
    return flow, Search(flow, dataclasses.replace(samples, scale=np.ones(2)))


def test_a_function_that_falls_has_no_counterexample_and_others_have() -> None:
    flow, search = searched()
    generator, none = np.random.default_rng(1), np.zeros((0, 2))
    good = Polynomial(np.array([[2, 0], [0, 2]]), np.ones(2))
    assert len(search.rising(good, 0.95, 0.0, none, generator)[0]) == 0
    assert len(search.low(good, 0.95, generator)) == 0
    z, v, slope = search.rising(good, 1.5, 0.0, none, generator)  # beyond the disc r rises
    assert len(z) and np.all(np.linalg.norm(z, axis=1) >= 1) and np.all(slope > 0)
    np.testing.assert_allclose(np.linalg.norm(v, axis=1), 1.0)
    assert len(search.low(good, 1.2, generator))
    shifted = Polynomial(np.array([[2, 0], [1, 0], [0, 2]]), np.array([1.0, -1.0, 1.0]))  # least at (1/2, 0)
    z, _, slope = search.rising(shifted, 0.5, 0.0, none, generator)
    np.testing.assert_allclose(along(shifted, z, search.worst(shifted, z)[0]), slope)
    assert len(z) and np.all(flow.V(z) > flow.c) and np.all(shifted(z) < 0.5) and np.all(slope > 0)


def test_around_a_violation_there_are_others() -> None:
    flow, search = searched()
    shifted = Polynomial(np.array([[2, 0], [1, 0], [0, 2]]), np.array([1.0, -1.0, 1.0]))  # least at (1/2, 0)
    at = np.array([0.3, 0.0])
    z, v = search.near(shifted, at, np.random.default_rng(1))
    assert len(z) > 100 and np.all(along(shifted, z, v) >= 0) and np.all(flow.V(z) > flow.c)
    assert np.array_equal(z[0], at) and np.linalg.norm(z - at, axis=1).max() < 0.4
    falls = Polynomial(np.array([[2, 0], [0, 2]]), np.ones(2))
    assert not len(search.near(falls, at, np.random.default_rng(1))[0])


def test_the_worst_corner_is_the_one_that_counts() -> None:
    system, network = scalar_tanh()
    flow = LearningFlow(ClosedLoop(pushed(system), network), Quadratic(np.eye(1)), 0.25)
    search = Search(flow, draw(flow, np.random.default_rng(0)))
    N = Polynomial(np.array([[2]]), np.ones(1))
    z = np.array([[0.05], [-0.05], [1.0]]) / search.scale
    v, slope = search.worst(N, z)
    np.testing.assert_allclose(v[:, 0], [1.0, -1.0, -1.0])
    assert np.all(slope[:2] > 0) and slope[2] < 0


# ------------------------------------------------------------------------------------------------------------ learning


@pytest.fixture(scope="module")
def network() -> Learned:
    return learn(disc(), UNIT, 0.09, (8,), seed=3)


def area(learned: Learned) -> float:
    """Share of the unit disc in the sublevel set, and nothing of the rest of the domain."""
    x = np.random.default_rng(9).uniform(-2, 2, (100_000, 2))
    below, radius = learned.function(x) <= learned.level, np.linalg.norm(x, axis=1)
    assert not np.any(below & (radius > 1))
    return float(below.sum() / (radius < 1).sum())


def falls(learned: Learned, loop: ClosedLoop, inner: Quadratic, c2: float) -> bool:
    """Whether N falls at many states of the domain outside of the ellipsoid, seen without the learner's own search."""
    low, high = np.array([[float(end) for end in pair] for pair in loop.system.domain]).T
    x = np.random.default_rng(8).uniform(low, high, (100_000, inner.n))
    x = x[(learned.function(x) <= learned.level) & (inner(x) > c2)]
    return bool(np.all((learned.function.gradient(x) * loop.system.function()(x, loop.policy(x))).sum(-1) < 0))


@pytest.mark.slow
def test_a_network_learns_the_disc(network: Learned) -> None:
    assert isinstance(network.function, Neural) and network.function.widths == (2, 8, 1)
    assert area(network) > 0.9 and network.cover == pytest.approx(area(network), abs=0.05)
    assert falls(network, disc(), UNIT, 0.09)


@pytest.mark.slow
def test_another_seed_learns_another_function(network: Learned) -> None:
    other = learn(disc(), UNIT, 0.09, (8,), seed=4)
    assert not np.array_equal(network.function.weights[0], other.function.weights[0])


@pytest.mark.slow
def test_the_same_seed_learns_the_same_function(network: Learned) -> None:
    again = learn(disc(), UNIT, 0.09, (8,), seed=3)
    for name in ("weights", "biases"):
        for a, b in zip(getattr(network.function, name), getattr(again.function, name), strict=True):
            np.testing.assert_array_equal(a, b)
    assert [r.cost for r in network.history] == [r.cost for r in again.history]


def test_a_polynomial_learns_the_disc() -> None:
    found = fit_polynomial(disc(), UNIT, 0.09, 4)
    assert isinstance(found.function, Polynomial) and found.function.degree == 4
    assert area(found) > 0.9 and falls(found, disc(), UNIT, 0.09)


def test_what_is_uncertain_is_learned_from_too() -> None:
    """x' = x/2 - tanh(x) + w with |w| <= 1/10: the edge is where x/2 - tanh(x) = -1/10, and not 1.915."""
    system, network = scalar_tanh()
    loop = ClosedLoop(pushed(system), network)
    found = fit_polynomial(loop, Quadratic(np.eye(1)), 0.25, 2)
    x = np.linspace(-3, 3, 20_001)[:, None]
    reach = np.abs(x[found.function(x) <= found.level]).max()
    assert 1.4 < reach < 1.66  # tanh(1.66) = 1.66/2 + 1/10


def test_rounds_are_told_and_end_with_the_effort() -> None:
    told: list[object] = []
    found = learn(disc(), UNIT, 0.09, (4,), effort=Effort(1.0), progress=told.append)
    assert tuple(told) == found.history and len(found.history) == 1


@pytest.mark.slow
def test_a_set_inside_of_a_narrow_domain_keeps_off_its_faces() -> None:
    loop = disc(0.8)
    found = learn(loop, UNIT, 0.09, (8,))
    x = np.random.default_rng(7).uniform(-0.8, 0.8, (40_000, 2))
    x[np.arange(40_000), np.arange(40_000) % 2] = np.where(np.arange(40_000) % 4 < 2, 0.8, -0.8)
    assert found.function(x).min() > found.level and falls(found, loop, UNIT, 0.09)


@pytest.mark.parametrize(
    ("change", "V", "c2", "message"),
    [
        ({"time": "discrete"}, UNIT, 0.09, "in continuous time"),
        ({"sample": (Fraction(1, 10), Fraction(1, 10))}, UNIT, 0.09, "in continuous time"),
        ({}, Quadratic(np.eye(3)), 0.09, "must be of the 2 states"),
        ({}, UNIT, 0.0, "at a positive level"),
        ({}, UNIT, math.nan, "at a positive level"),
    ],
)
def test_other_loops_and_ellipsoids_are_refused(
    change: dict[str, object], V: Quadratic, c2: float, message: str
) -> None:
    loop = disc()
    system = dataclasses.replace(loop.system, **change)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=message):
        learn(ClosedLoop(system, loop.network), V, c2)
