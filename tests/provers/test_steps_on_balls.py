"""Balls of a step, in cells and around a level: models enclose what solutions do, and only what is true is shown."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from certify.certificates import Certificate, PartitionTree
from certify.certificates.claims import Asymptotic, Practical, Problem
from certify.effort import Effort
from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import Expression, Number, Symbol, atan, cos, exp, sin, sqrt, symbols, symbols_of, tanh
from certify.loop.plants import System, at_values, corners, get_system
from certify.loop.plants.system import Interval
from certify.loop.policies import PolicyNetwork, load_policy
from certify.lyapunov import choose_candidate, diagonalising_coordinates, domain_limit
from certify.lyapunov.function import Quadratic
from certify.provers.ball.cells import cut, cuts_for
from certify.provers.ball.decrease import corners_of
from certify.provers.ball.local import Rule, ball_around, local_ball, prove_band, prove_local
from certify.provers.ball.models import Models, paths
from certify.provers.ball.steps import Steps, steps_of
from certify.provers.boxes.search import empty_ring
from tests.support.certificates import verdict
from tests.support.loops import box
from tests.support.marks import slow_after

Array = np.ndarray
POLICIES = Path(__file__).parents[2] / "examples" / "policies"
X, U, W = symbols("x u w")


def about(name: str, share: Fraction, names: Sequence[str]) -> dict[str, Interval]:
    known = get_system(name).parameters
    return {k: (known[k] * (1 - share), known[k] * (1 + share)) for k in names}


MASSES = about("cartpole", Fraction(1, 20), ("mc", "mp"))
TENTH = about("pendulum", Fraction(1, 10), ("m", "b"))
TORQUE = {"torque": (Fraction(-1, 20), Fraction(1, 20))}
HUNDREDTH = Fraction(1, 100)


def shipped(name: str, ranges: dict[str, Interval] | None = None, sample: Interval | None = None) -> ClosedLoop:
    system = get_system(name).with_ranges(ranges or {}).with_sample(sample)
    return ClosedLoop(system, load_policy(POLICIES / f"{name}.pt").network)


def in_steps(name: str, h: Fraction, ranges: dict[str, Interval] | None = None) -> ClosedLoop:
    """x+ = x + h f(x, u)."""
    loop, step = shipped(name, ranges), Fraction(h.numerator, h.denominator)
    dynamics = tuple(x + step * f for x, f in zip(loop.system.states, loop.system.dynamics, strict=True))
    return ClosedLoop(dataclasses.replace(loop.system, dynamics=dynamics, time="discrete"), loop.network)


def linear(f: Expression, gain: str = "-1", **more: object) -> tuple[Problem, Array]:
    """One state, u = gain x, V = x^2, w between -1/10 and 1/10 if it is there."""
    acting = {W} & symbols_of(f)
    system = System("line", (X,), (U,), {}, (f,), (Number(0),), box(3), box(9), disturbances=tuple(acting))
    system = dataclasses.replace(system, **more)  # type: ignore[arg-type]
    if acting:
        system = system.with_ranges({"w": (Fraction(-1, 10), Fraction(1, 10))})
    gains = np.array([[float(Fraction(gain))]])
    network = PolicyNetwork.of_layers((gains,), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none")
    return Problem(ClosedLoop(system, network), Quadratic(np.eye(1))), np.eye(1)


def problem_of(loop: ClosedLoop, rate: float = 0.0) -> tuple[Problem, Array, float]:
    """With V of the plant in continuous time, and the domain's limit."""
    nominal = shipped(loop.system.name)
    P, (A, _, _) = choose_candidate(nominal, "lqr").P, nominal.linearise()
    limit = domain_limit(P, loop.system.domain) * (1 - 1e-9)
    return Problem(loop, Quadratic(P), rate), diagonalising_coordinates(P, A), limit


def accepted(problem: Problem, T: Array, c1: float, c0: float | None = None) -> str:
    """The checker's word on a claim that the ball alone carries."""
    ball, cells = local_ball(problem, T, c1, c0)
    ring = empty_ring(problem, T, c1)
    if c0 is None:
        claim: Asymptotic | Practical = Asymptotic(roa=c1, local=c1, rate=problem.rate)
    else:
        claim = Practical(roa=c1, local=c1, floor=c0, rate=problem.rate)
    evidence = PartitionTree(T, ring.root, ring.tree, ball, cells=cells, order=ball.order)
    loop = problem.loop
    return verdict(json.loads(Certificate(loop.system, loop.network, problem.V, claim, evidence, {}).to_json()))


# --------------------------------------------------------------------------------------------- what solutions do


def after(loop: ClosedLoop, x: Array, h: float, values: Array) -> Array:
    """States (points, n) a step later: `values` (parts, N) is what is uncertain, in equal parts of the period."""
    f, u = loop.system.uncertain_function(), loop.policy(x)
    if loop.system.time == "discrete":
        return np.asarray(f(x, u, values[0]))
    steps = 8
    dt = h / len(values) / steps
    for q in values:
        for _ in range(steps):
            k1 = f(x, u, q)
            k2 = f(x + dt / 2 * k1, u, q)
            k3 = f(x + dt / 2 * k2, u, q)
            x = x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + f(x + dt * k3, u, q))
    return x


def drawn(generator: np.random.Generator, loop: ClosedLoop, parts: int) -> Array:
    """Values of what is uncertain, (parts, N), at ends of the ranges more often than not."""
    ends = np.array([[float(q) for q in ends] for ends in loop.system.ranges.values()]).reshape(-1, 2)
    share = generator.choice([0.0, 1.0, generator.random()], (parts, len(ends)))
    return ends[:, 0] + share * (ends[:, 1] - ends[:, 0])


def step_of(generator: np.random.Generator, loop: ClosedLoop) -> float:
    system = loop.system
    if system.sample is None:
        return float(system.time == "discrete")
    lo, hi = map(float, system.sample)
    return float(generator.choice([hi, max(lo, 1e-3 * hi), lo + (hi - lo) * generator.random()]))


def mean_rate(loop: ClosedLoop, x: Array, h: float, values: Array) -> Array:
    """G."""
    if loop.system.time == "continuous" and loop.system.sample is None:
        return np.asarray(loop.system.uncertain_function()(x, loop.policy(x), values[0]))
    return (after(loop, x, h, values) - x) / h


def in_ball(generator: np.random.Generator, points: int, n: int) -> Array:
    d = generator.standard_normal((points, n))
    return d * generator.random((points, 1)) ** 0.3 / np.linalg.norm(d, axis=1, keepdims=True)


# ------------------------------------------------------------------------------------------------------- models


def every_function() -> ClosedLoop:
    q, r = symbols("q r")
    f = (
        q * sin(X + q * W) + exp(-r * X) / (2 + q * W) - Fraction(1, 3),
        sqrt(3 + q + X) * atan(W - r) + tanh(q * X + r) * cos(U - q) + U**3 / (1 + r),
    )
    system = System("all", (X, W), (U,), {"q": Fraction(1), "r": Fraction(1, 2)}, f, (Number(0),), box(3, 3), box(9))
    weights = np.array([[0.7, -1.1], [0.4, 0.9]]), np.array([[-0.8, 0.5]])
    network = PolicyNetwork.of_layers(
        weights, (np.array([0.2, -0.1]), np.zeros(1)), np.ones(1), np.zeros(1), "tanh", "none"
    )
    return ClosedLoop(
        system.with_ranges({"q": (Fraction(4, 5), Fraction(6, 5)), "r": (Fraction(2, 5), Fraction(3, 5))}), network
    )


def loops() -> dict[str, tuple[ClosedLoop, float, bool]]:
    """Each with the size of a ball and whether it rests at the origin."""
    curved, sampled = every_function(), (Fraction(1, 50), Fraction(1, 20))
    free = dataclasses.replace(curved.system, time="discrete")
    return {
        "masses": (shipped("cartpole", MASSES), 0.2, True),
        "torque": (shipped("pendulum", TENTH | TORQUE), 0.3, False),
        "all": (curved, 0.2, False),
        "all in steps": (ClosedLoop(free, curved.network), 0.2, False),
        "all sampled": (ClosedLoop(curved.system.with_sample(sampled), curved.network), 0.2, False),
        "sampled": (shipped("pendulum", sample=(Fraction(1, 50), Fraction(1, 50))), 0.3, True),
        "sampled, torque": (shipped("pendulum", TENTH | TORQUE, (Fraction(0), Fraction(1, 50))), 0.3, False),
        "sampled masses": (shipped("cartpole", MASSES, (HUNDREDTH, Fraction(1, 50))), 0.1, True),
        "in steps": (in_steps("cartpole", HUNDREDTH, MASSES), 0.2, True),
    }


def beyond(models: Models, y: Array, d: Array, G: Array) -> tuple[Array, Array]:
    """What G has beyond the models at y, and the bound of that, (points, n)."""
    s = models.spread
    assert s is not None
    f, A = models.f + y @ s.moves, models.A + np.tensordot(y, s.turns, 1)
    cubic = np.einsum("ihjk,ph,pj,pk->pi", models.K, d, d, d, optimize=True)
    polynomial = f + d @ A.T + np.einsum("ijk,pj,pk->pi", models.Q, d, d) + cubic
    units = np.einsum("qjk,pj,pk->pq", models.R, d, d, optimize=True) @ np.abs(models.shares).T
    size = np.linalg.norm(d, axis=1, keepdims=True)
    bound = s.error + s.slack * size + np.einsum("ijk,pj,pk->pi", models.E, d, d) + units
    return np.abs(G - polynomial), bound


@pytest.mark.parametrize("order", slow_after(1, [3, 2, 4]))
@pytest.mark.parametrize("name", list(loops()))
def test_models_enclose_what_a_step_does(name: str, order: int) -> None:
    """With quantities that switch within the period: y stands for their mean."""
    loop, size, at_rest = loops()[name]
    system, generator = loop.system, np.random.default_rng(5)
    if system.sample is None and order > 2:
        pytest.skip("there is no series")
    n = system.n
    J = size / math.sqrt(n) * (np.eye(n) + 0.3 * generator.standard_normal((n, n)))
    ranges = list(system.ranges.values())
    cells = cut(ranges, (2 if system.sample is None else 1,) * len(ranges))
    found = steps_of(paths(loop, resting=at_rest), at_rest, order).models(J, cells, np.full(n, 1e-3))
    varies = system.sample is not None and system.sample[0] < system.sample[1]
    assert len(found) == len(cells)
    for models, cell in zip(found, cells, strict=True):
        assert models.finite
        ends = np.array([[float(q) for q in ends] for ends in cell]).reshape(-1, 2)
        middle, half = ends.mean(axis=1), (ends[:, 1] - ends[:, 0]) / 2
        for _ in range(20):
            h, d = step_of(generator, loop), in_ball(generator, 100, n)
            if system.sample is None:
                values = middle + half * generator.uniform(-1, 1, (1, len(cell)))
            else:
                values = drawn(generator, loop, 4)
            y = (values.mean(axis=0) - middle) / half
            if varies and system.sample is not None:
                lo, hi = map(float, system.sample)
                y = np.append(y, (2 * h - lo - hi) / (hi - lo))
            error, bound = beyond(models, y, d, mean_rate(loop, d @ J.T, h, values))
            assert np.all(error <= bound * (1 + 1e-9) + 1e-10)


@pytest.mark.parametrize("name", list(loops()))
def test_models_of_steps_on_several_balls_are_those_on_each(name: str) -> None:
    """A small ball's states are near after fewer attempts than a large one's, and stay in the domain for certain."""
    loop, size, at_rest = loops()[name]
    n, generator = loop.system.n, np.random.default_rng(6)
    balls = np.array([1.0, 0.02, 0.4])[:, None, None] * (np.eye(n) + 0.3 * generator.standard_normal((3, n, n)))
    balls *= size / math.sqrt(n)
    ends = np.array([[float(v) for v in pair] for pair in loop.system.domain])
    reach = np.array([1.0 - 1e-9, 0.01, 0.5])[:, None] * np.min(np.abs(ends), axis=1)
    ranges = list(loop.system.ranges.values())
    cells = cut(ranges, (2 if loop.system.sample is None else 1,) * len(ranges))
    steps = steps_of(paths(loop, resting=at_rest), at_rest, 3)
    together = steps.models_on(balls, cells, reach)
    for J, far, of_ball in zip(balls, reach, together, strict=True):
        for models, alone in zip(of_ball, steps.models(J, cells, far), strict=True):
            assert alone.finite and models.stays == alone.stays
            assert alone.spread is not None and models.spread is not None
            for mine, other, parts in (
                (models, alone, ("f", "A", "Q", "K", "E", "shares", "R")),
                (models.spread, alone.spread, ("moves", "turns", "error", "slack")),
            ):
                for part in parts:
                    a, b = getattr(mine, part), getattr(other, part)
                    assert np.allclose(a, b, rtol=1e-12, atol=1e-14 * np.max(np.abs(b), initial=0.0)), part
    if loop.system.sample is not None:
        assert [of_ball[0].stays for of_ball in together] == [False, True, True]


def test_models_without_ranges_are_those_of_the_plain_rule() -> None:
    """The two arithmetics share no product."""
    loop = shipped("cartpole")
    J = 0.2 * np.eye(4) + 0.01
    known = paths(loop)
    plain, held = known.models(J), in_steps("cartpole", HUNDREDTH)
    step = steps_of(paths(held), True, 1).models(J, [()], np.zeros(4))[0]
    for mine, other in ((step.A, plain.A), (step.Q, plain.Q), (step.K, plain.K), (step.E, plain.E)):
        assert np.allclose(100 * mine, other, rtol=1e-9, atol=1e-9 * np.max(np.abs(other)))


def test_what_may_leave_the_domain_within_a_period_is_not_admitted() -> None:
    loop = shipped("pendulum", sample=(HUNDREDTH, HUNDREDTH))
    steps, J = steps_of(paths(loop), True, 3), 0.1 * np.eye(2)
    ends = np.array([float(hi) for _, hi in loop.system.domain])
    assert steps.models(J, [()], 0.5 * ends)[0].admitted
    assert not steps.models(J, [()], (1 - 1e-6) * ends)[0].admitted


def test_a_period_too_long_for_any_enclosure_has_no_models() -> None:
    loop = shipped("pendulum", sample=(Fraction(2), Fraction(2)))
    assert not steps_of(paths(loop), True, 3).models(0.1 * np.eye(2), [()], np.zeros(2))[0].finite


# ------------------------------------------------------------------------------------------------- decrease


@pytest.mark.parametrize(
    "loop",
    slow_after(
        2,
        [
            shipped("pendulum", TENTH),
            shipped("pendulum", TENTH, (HUNDREDTH, HUNDREDTH)),
            shipped("pendulum", sample=(Fraction(0), Fraction(1, 50))),
            shipped("cartpole", MASSES),
            shipped("cartpole", sample=(HUNDREDTH, HUNDREDTH)),
            in_steps("pendulum", HUNDREDTH, TENTH),
        ],
    ),
    ids=["ranges", "ranges sampled", "any period", "masses", "cartpole sampled", "in steps"],
)
def test_what_is_proved_at_rest_is_accepted_and_true(loop: ClosedLoop) -> None:
    """The checker has the last word; V falls over steps in which quantities switch."""
    problem, T, limit = problem_of(loop)
    level = prove_local(problem, T, limit)
    assert level is not None and level > 0.02 * limit
    assert accepted(problem, T, level) == "ACCEPTED"
    generator, P = np.random.default_rng(2), problem.V.P
    L = np.linalg.inv(np.linalg.cholesky(P)).T
    for _ in range(40):
        x = math.sqrt(level) * in_ball(generator, 200, loop.system.n) @ L.T
        h, values = step_of(generator, loop), drawn(generator, loop, 4)
        G = mean_rate(loop, x, h, values)
        V, step = np.einsum("pi,ij,pj->p", x, P, x), h if loop.system.sample or loop.system.time == "discrete" else 0.0
        D = 2 * np.einsum("pi,ij,pj->p", x, P, G) + step * np.einsum("pi,ij,pj->p", G, P, G)
        assert np.all(D < 1e-9 * V)


@pytest.mark.slow
def test_the_cart_under_uncertain_masses_keeps_most_of_its_level() -> None:
    """With charges by norms it had none at all."""
    problem, T, limit = problem_of(shipped("cartpole", MASSES))
    nominal = prove_local(*problem_of(shipped("cartpole")))
    level = prove_local(problem, T, limit)
    assert nominal is not None and level is not None
    assert 0.6 * nominal < level < nominal
    _, cells = local_ball(problem, T, level)
    assert math.prod(cells) <= 8


def test_between_the_corners_the_inequality_holds_as_at_them() -> None:
    problem, T, _ = problem_of(shipped("cartpole", MASSES, (HUNDREDTH, HUNDREDTH)))
    steps = steps_of(paths(problem.loop), True, 3)
    J, P = ball_around(problem, T, 1e-3), problem.V.P
    models = steps.models(J, cut(list(MASSES.values()), (8, 1)), np.zeros(4))[3]
    assert models.spread is not None
    h, generator = steps.longest, np.random.default_rng(0)
    corners = corners_of(models, J, P, None, h)
    assert len(corners) == 4
    exact = dataclasses.replace(models.spread, moves=0 * models.spread.moves, turns=0 * models.spread.turns)
    for _ in range(50):
        y, d = generator.uniform(-1, 1, 2), generator.standard_normal(4)
        A = models.A + np.tensordot(y, models.spread.turns, 1)
        inside = corners_of(dataclasses.replace(models, A=A, spread=exact), J, P, None, h)[0].decay
        assert d @ inside @ d >= min(d @ c.decay @ d for c in corners) - 1e-9 * abs(d @ inside @ d)


# ------------------------------------------------------------------------------------------------- known answers


HOLD = (Fraction(1, 2), Fraction(1, 2))


@pytest.mark.parametrize(
    ("f", "gain", "more", "rate", "holds"),
    [
        (U, "-399/100", {"sample": HOLD}, 0.0, True),  # x+ = (1 - k/2) x
        (U, "-401/100", {"sample": HOLD}, 0.0, False),
        (U, "-399/100", {"sample": (Fraction(0), Fraction(1, 2))}, 0.0, True),
        (U, "-401/100", {"sample": (Fraction(0), Fraction(1, 2))}, 0.0, False),
        (U, "1/1000", {"sample": HOLD}, 0.0, False),
        (X + U, "-4", {"sample": (Fraction(1, 10), Fraction(1, 10))}, 0.0, True),
        (X + U, "-99/100", {"sample": (Fraction(1, 10), Fraction(1, 10))}, 0.0, False),
        (Fraction(99, 100) * X, "-1", {"time": "discrete"}, 0.0, True),
        (Fraction(101, 100) * X, "-1", {"time": "discrete"}, 0.0, False),
        (-Fraction(99, 100) * X, "-1", {"time": "discrete"}, 0.0, True),
        (-Fraction(101, 100) * X, "-1", {"time": "discrete"}, 0.0, False),
        (U, "-1", {}, 0.99, True),
        (U, "-1", {}, 1.01, False),
        (U, "-1", {"sample": HOLD}, 0.74, True),  # ((1 - h)^2 - 1)/h = h - 2
        (U, "-1", {"sample": HOLD}, 0.76, False),
        (X / 2, "-1", {"time": "discrete"}, 0.37, True),
        (X / 2, "-1", {"time": "discrete"}, 0.38, False),
    ],
)
def test_lines_of_which_all_is_known(
    f: Expression, gain: str, more: dict[str, object], rate: float, holds: bool
) -> None:
    problem, T = linear(f, gain, **more)
    problem = dataclasses.replace(problem, rate=rate)
    level = prove_local(problem, T, 0.25)
    assert (level == 0.25) if holds else (level is None)
    if level is not None:
        assert accepted(problem, T, level) == "ACCEPTED"


@pytest.mark.parametrize(("hi", "holds"), [("99/100", True), ("1001/1000", False)])
def test_a_plant_in_steps_with_a_range_up_to_one(hi: str, holds: bool) -> None:
    q = Symbol("q")
    system = System("line", (X,), (U,), {"q": Fraction(3, 4)}, (q * X,), (Number(0),), box(3), box(9), time="discrete")
    problem, T = linear(U)
    system = system.with_ranges({"q": (Fraction(-1, 2), Fraction(hi))})
    problem = Problem(ClosedLoop(system, problem.loop.network), problem.V)
    assert (prove_local(problem, T, 0.25) == 0.25) is holds


@pytest.mark.parametrize(
    ("f", "more", "least"),
    [
        (U + W, {}, 0.01),
        (X / 2 + W, {"time": "discrete"}, 0.04),
        (U + W, {"sample": HOLD}, 0.01),
        (2 * U + X + W, {}, 0.01),
    ],
)
def test_the_least_floor_of_a_line_is_found_from_above(f: Expression, more: dict[str, object], least: float) -> None:
    """|x| ends at w over the rate at which x falls: no floor below that is true, and one not far above it is shown."""
    problem, T = linear(f, **more)
    found = prove_band(problem, T, 0.25)
    assert found is not None
    floor, level = found
    assert least < floor < 1.1 * least and level == 0.25
    assert accepted(problem, T, level, floor) == "ACCEPTED"
    assert accepted(problem, T, level, 0.99 * least) != "ACCEPTED"


def test_no_band_where_the_disturbance_is_stronger_than_the_input() -> None:
    problem, T = linear(U + W, "-1/10")
    assert prove_band(problem, T, 0.25) is None  # |x| ends at 1


def test_a_ball_without_a_definite_decay_costs_no_rounds_of_multipliers() -> None:
    problem, T = linear(U + W, "-1/10")
    rule = Rule.anywhere(problem, T)
    assert rule.around(0.25).rounds > 0
    upwards, T = linear(X / 2 + X + U / 4)
    assert Rule.anywhere(upwards, T).around(0.25).rounds == 0


def test_a_policy_that_is_not_centred_has_a_band_around_where_it_rests() -> None:
    """u = -x + 1/20: V = x^2 falls for |x| > 1/20 alone."""
    problem, T = linear(U)
    network = problem.loop.network.with_layers(biases=(np.array([0.05]),))
    problem = Problem(ClosedLoop(problem.loop.system, network), problem.V)
    found = prove_band(problem, T, 0.25)
    assert found is not None and found[0] > 0.0025 and found[0] == pytest.approx(0.0025, rel=0.1)
    assert accepted(problem, T, found[1], found[0]) == "ACCEPTED"


@pytest.mark.parametrize(
    "loop",
    slow_after(
        2,
        [
            shipped("pendulum", TORQUE),
            shipped("pendulum", TENTH | TORQUE),
            shipped("pendulum", TORQUE, (HUNDREDTH, HUNDREDTH)),
            shipped("pendulum", TORQUE, (Fraction(0), HUNDREDTH)),
            in_steps("pendulum", HUNDREDTH, TORQUE),
        ],
    ),
    ids=["torque", "all", "sampled", "any period", "in steps"],
)
def test_bands_are_accepted_and_true(loop: ClosedLoop) -> None:
    """Where c0 <= V <= c1 V falls; from V < c0 no step leads out of {V < c0}."""
    problem, T, limit = problem_of(loop)
    found = prove_band(problem, T, limit)
    assert found is not None
    floor, level = found
    assert floor < level and accepted(problem, T, level, floor) == "ACCEPTED"
    generator, P = np.random.default_rng(4), problem.V.P
    L = np.linalg.inv(np.linalg.cholesky(P)).T
    stepwise = loop.system.sample is not None or loop.system.time == "discrete"
    for k in range(60):
        top = level if k % 2 else 1.5 * floor
        x = math.sqrt(top) * in_ball(generator, 200, loop.system.n) @ L.T
        V, h, values = np.einsum("pi,ij,pj->p", x, P, x), step_of(generator, loop), drawn(generator, loop, 3)
        G = mean_rate(loop, x, h, values)
        step = h if stepwise else 0.0
        D = 2 * np.einsum("pi,ij,pj->p", x, P, G) + step * np.einsum("pi,ij,pj->p", G, P, G)
        assert np.all(D[(floor <= V) & (level >= V)] < 0)
        if stepwise:
            assert np.all((V + step * D)[floor > V] < floor)


def test_the_edge_is_at_most_one_over_the_step() -> None:
    """x+ = w: everything ends within one step, and only the edge's limit says where."""
    problem, T = linear(W, time="discrete")
    found = prove_band(problem, T, 0.25)
    assert found is not None and found[0] == pytest.approx(0.01, rel=0.1) and found[0] > 0.01
    ball, _ = local_ball(problem, T, found[1], found[0])
    assert 0 < ball.edge < 1


# ---------------------------------------------------------------------------------------------------- the search


def test_one_cell_is_enough_where_the_gradients_move_in_a_straight_line() -> None:
    problem, T, _ = problem_of(shipped("pendulum", TORQUE | {"b": TENTH["b"]}))
    steps = steps_of(paths(problem.loop), True, 1)
    assert cuts_for(steps, T, problem.V.P, None) == (1, 1)


def test_what_no_ball_can_show_is_given_up_at_once() -> None:
    loop = shipped("cartpole", MASSES)
    P, (A, _, _) = choose_candidate(shipped("cartpole"), "lyapunov").P, loop.linearise()
    T, steps = diagonalising_coordinates(P, A), steps_of(paths(loop), True, 1)
    assert cuts_for(steps, T, P, None) is None
    corner = ClosedLoop(at_values(loop.system, corners(loop.system)[-1]), loop.network).linearise()[0]
    assert np.linalg.eigvalsh(P @ corner + corner.T @ P)[-1] > 0  # it is false, not only not shown
    assert prove_local(Problem(loop, Quadratic(P)), T, 1.0) is None


def test_a_search_ends_with_its_effort() -> None:
    problem, T, limit = problem_of(shipped("cartpole", MASSES))
    one = Rule.at_rest(problem, T).operations
    for search in (prove_local, prove_band):
        effort = Effort(one)
        assert search(problem, T, limit, effort=effort) is None
        assert one <= effort.spent < 8 * one


def test_a_rule_at_rest_starts_from_zero_exactly() -> None:
    problem, T, _ = problem_of(shipped("pendulum", TENTH, (HUNDREDTH, HUNDREDTH)))
    rule = Rule.at_rest(problem, T)
    assert isinstance(rule.steps, Steps)
    for models in rule.models(ball_around(problem, T, 1.0), 1.0):
        assert models.spread is not None
        assert not np.any(models.f) and not np.any(models.spread.error) and not np.any(models.spread.moves)
