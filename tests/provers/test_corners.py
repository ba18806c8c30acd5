"""Bounds of equations with abs, min, max and clip: on boxes lines that hold beside the corner, on balls and in series
in time nothing unless the corner is far; and what is proved of such plants."""

from __future__ import annotations

import random
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from certify.analysis.run import RoaOptions, certify_roa
from certify.certificates import PartitionTree
from certify.certificates.claims import Problem
from certify.certificates.reading import read_certificate
from certify.certificates.verdict import Verdict
from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import Expression, evaluate
from certify.loop.plants import System
from certify.loop.plants.ode import rk4_step
from certify.loop.rigorous import evaluate_increment
from certify.lyapunov import solve_lyapunov
from certify.lyapunov.function import Quadratic
from certify.provers.ball.jets import Jet, Jets, basis
from certify.provers.ball.ranged import RangedJets
from certify.provers.bounds import Flow, compiled, tape
from certify.provers.bounds.taylor import Models, Taylor
from certify.provers.boxes.mend import are_shown
from certify.provers.boxes.order import choose_order
from certify.provers.boxes.rule import VdotBound
from tests.support.corners import X, Y, plant, regulator, tree, value
from tests.support.marks import slow_after
from tests.support.ways import WAYS, Way, bounded

Array = np.ndarray
BATCH = 50
TENTH = (Fraction(1, 10), Fraction(1, 10))


def boxes(rng: np.random.Generator, size: float) -> tuple[Array, Array]:
    """States of two symbols (2, 3, BATCH), and their errors."""
    x = rng.standard_normal((2, 3, BATCH))
    x[:, 1:] *= size
    return x, np.full((2, BATCH), 1e-14)


def models(x: Array, error: Array) -> dict[Any, Taylor]:
    return {s: Taylor(x[i, 0], x[i, 1:], np.zeros((2, 2, BATCH)), error[i]) for i, s in enumerate((X, Y))}


def played(e: Expression, x: Array, error: Array, way: Way) -> Taylor:
    steps = tape.recorded(2, lambda v, algebra: evaluate(e, dict(zip((X, Y), v, strict=True)), algebra).scaled(1.0))
    given = [x, error, np.zeros((0, BATCH)), np.zeros((0, 2, BATCH)), np.zeros((0, BATCH)), np.zeros((0, 3))]
    found = [np.zeros((*shape, BATCH)) for shape in ((), (2,), (2, 2), (), (2,))]
    with bounded(way):
        compiled.loops(1).play(steps.steps, steps.k, steps.places, *given, *found)
    return Taylor(*found[:-1])


def misses(model: Taylor, e: Expression, x: Array, rng: np.random.Generator) -> Array:
    """By how much the values at random points are outside of the model, relative to its size."""
    worst = np.full(BATCH, -np.inf)
    for _ in range(60):
        d = rng.uniform(-1, 1, (2, BATCH)).clip(*rng.choice([[-1, 1], [-0.1, 0.1]]))
        d = np.where(rng.random((2, BATCH)) < 0.2, np.sign(d), d)
        true = value(e, {s: x[i, 0] + (x[i, 1:] * d).sum(0) for i, s in enumerate((X, Y))})
        shown = model.c + (model.g * d).sum(0) + np.einsum("ijb,ib,jb->b", model.Q, d, d)
        worst = np.maximum(worst, np.abs(true - shown) - model.r - 1e-13 * (1 + np.abs(true)))
    return worst


@pytest.mark.parametrize("size", [0.0, 1e-6, 0.03, 0.5])
@pytest.mark.parametrize("seed", slow_after(5, range(12)))
def test_models_on_boxes_hold_the_values_both_ways(seed: int, size: float) -> None:
    rng, e = np.random.default_rng(seed), tree(random.Random(seed), 4)
    x, error = boxes(rng, size)
    values = models(x, error)
    model = evaluate(e, values, Models(values[X]))
    plain, fast = (played(e, x, error, way) for way in WAYS)
    for part in ("c", "g", "Q", "r"):
        assert np.array_equal(getattr(plain, part), getattr(fast, part))
    for found in (model, plain):
        assert np.isfinite(found.r).all()
        assert (misses(found, e, x, rng) <= 0).all()
    assert plain.r == pytest.approx(model.r, rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("way", WAYS)
def test_the_lines_of_abs_are_as_near_as_lines_can_be(way: Way) -> None:
    """|v| on [c - 1, c + 1]: between parallel lines with the chord's slope, c, the gap is (1 - c^2)/2."""
    x = np.zeros((2, 3, BATCH))
    x[0, 0], x[0, 1] = np.linspace(-1.5, 1.5, BATCH), 1.0
    inside = np.abs(x[0, 0]) < 1
    found, expected = played(abs(X), x, np.zeros((2, BATCH)), way), np.maximum(0.0, (1 - x[0, 0] ** 2) / 2)
    assert found.r == pytest.approx(expected, abs=1e-13)
    assert found.g[0] == pytest.approx(np.where(inside, x[0, 0], np.sign(x[0, 0])))


@np.errstate(all="ignore")
@pytest.mark.parametrize("way", WAYS)
def test_what_is_no_number_stays_none(way: Way) -> None:
    x = np.zeros((2, 3, BATCH))
    x[0, 0], x[0, 1] = np.resize([np.nan, np.inf, 0.0, 1.0], BATCH), np.resize([0.0, 1.0, np.inf, np.nan], BATCH)
    found = played(abs(X), x, np.zeros((2, BATCH)), way)
    assert not any(np.isfinite(v).all(0).any() for v in (np.vstack([found.c, found.r, found.g]),))


def jets(algebra: Jets | RangedJets, centre: Array, a: Array) -> dict[Any, Any]:
    return {s: algebra.state(float(centre[i]), a[i][None]) for i, s in enumerate((X, Y))}


@np.errstate(all="ignore")
@pytest.mark.parametrize("size", [1e-3, 0.05, 0.3])
@pytest.mark.parametrize("seed", range(30))
def test_models_on_balls_hold_the_values_or_are_none(seed: int, size: float) -> None:
    rng, e = np.random.default_rng(seed), tree(random.Random(seed), 3)
    centre, a = rng.standard_normal(2), rng.standard_normal((2, 2)) * size
    plain = evaluate(e, jets(Jets(1, 2, np.zeros((0, 3))), centre, a), Jets(1, 2, np.zeros((0, 3))))
    ranged = RangedJets(1, 2, 0, np.zeros((0, 3)))
    with_ranges = evaluate(e, jets(ranged, centre, a), ranged)
    assert np.isfinite(with_ranges.c) or not np.isfinite(plain.c)  # abs is known to first order where it may be 0
    d = rng.standard_normal((2, 400))
    d *= rng.random(400) ** 0.5 / np.linalg.norm(d, axis=0)
    true = value(e, {s: centre[i] + a[i] @ d for i, s in enumerate((X, Y))})
    for jet in (jet for jet in (plain, with_ranges) if np.isfinite(jet.c)):
        assert np.all(np.abs(true - shown(jet, d)) <= left(jet, d) + 1e-12 * (1 + np.abs(true)))


def shown(jet: Any, d: Array) -> Array:
    form = basis(2)
    Q, K = form.matrices(jet.Q)[0], form.forms(jet.K)[0]
    return np.asarray(
        jet.c + jet.a[0] @ d + np.einsum("ij,ib,jb->b", Q, d, d) + np.einsum("ijk,ib,jb,kb->b", K, d, d, d)
    )


def left(jet: Any, d: Array) -> Array:
    error = getattr(jet, "error", np.zeros(1))[0] + getattr(jet, "slack", np.zeros(1))[0] * np.linalg.norm(d, axis=0)
    return np.asarray(error + np.einsum("ij,ib,jb->b", basis(2).matrices(jet.E)[0], d, d))


@np.errstate(all="ignore")
def test_a_ball_that_meets_a_corner_has_no_model() -> None:
    algebra = Jets(1, 2, np.zeros((0, 3)))
    for middle, there in ((0.3, False), (-0.3, False), (0.301, True), (-0.301, True), (0.0, False), (0.2995, False)):
        jet = algebra.state(middle, np.array([[0.3, 0.0]])).abs()
        assert isinstance(jet, Jet) and bool(np.isfinite(jet.c)) == there
        assert not there or (jet.c == abs(middle) and jet.a[0, 0] == 0.3 * np.sign(middle) and not jet.E.any())


@np.errstate(all="ignore")
def test_a_certain_sign_needs_all_that_is_uncertain() -> None:
    algebra = RangedJets(1, 2, 1, np.zeros((0, 3)))
    q = algebra.quantity(Fraction(-1, 2), Fraction(1, 2), 0)
    for shift, there in ((0.81, True), (0.79, False), (-0.81, True)):
        v = q + algebra.state(shift, np.array([[0.3, 0.0]]))
        assert bool(np.isfinite(algebra.function("abs", v).c)) == there
        assert bool(np.isfinite(algebra.function("sign", v).c)) == there


# --------------------------------------------------------------------------------------------------- series in time


def passing(x0: float, v0: float, u: float, order: int) -> Any:
    """G of `p' = clip(v), v' = u` over a period of 1/10, at a point."""
    found = plant("p v", "clip(v, -1, 1)", "u")
    (p, v), (w,) = found.states, found.inputs

    def at(c: float) -> Taylor:
        return Taylor(np.array([c]), np.zeros((2, 1)), np.zeros((2, 2, 1)), np.zeros(1))

    with np.errstate(all="ignore"):
        return Flow(found.dynamics, TENTH, order)({p: at(x0), v: at(v0)}, {w: at(u)}, {}, 2).G[0]


PASSES, FAR = (0.85, 0.95, 0.999, -1.2), (0.3, 0.0, 1.6, -1.6)


@pytest.mark.parametrize("order", [1, 2, 3, 4])
@pytest.mark.parametrize("v0", [*PASSES, *FAR])
def test_a_solution_that_passes_a_corner_has_no_series(v0: float, order: int) -> None:
    """All coefficients after x_2 vanish, and still the series is not the solution."""
    G, t = passing(0.0, v0, 4.0, order), (np.arange(20_000) + 0.5) * 0.1 / 20_000
    true = float(np.mean(np.clip(v0 + 4 * t, -1, 1)))
    assert bool(np.isfinite(G.r[0])) == (order == 1 or v0 in FAR)
    assert not abs(true - G.c[0]) > G.r[0] + 1e-8


def test_orders_are_chosen_for_corners_of_states_not_for_those_of_inputs() -> None:
    for equations, wanted in ((("clip(v, -1, 1)", "u"), {1}), (("v", "clip(u, -1, 1)"), {2, 3, 4})):
        loop = ClosedLoop(plant("p v", *equations).with_sample(TENTH), regulator(1.0, 1.73))
        P = solve_lyapunov(loop.mean_rate(), np.eye(2), loop.step)
        P = P / np.max(np.diag(np.linalg.inv(P)) ** -1) / 9
        T = np.linalg.inv(np.linalg.cholesky(P).T)
        assert choose_order(Problem(loop, Quadratic(P)), T, 0.01, 1.0) in wanted


def test_a_bound_over_a_period_holds_beside_corners() -> None:
    loop = ClosedLoop(plant("p v", "clip(v, -1, 1)", "u - max(p, -1)/9").with_sample(TENTH), regulator(1.0, 1.73))
    P = solve_lyapunov(loop.mean_rate(), np.eye(2), loop.step)
    T, rng = np.linalg.inv(np.linalg.cholesky(P).T), np.random.default_rng(1)
    f = loop.system.function()
    for order in (1, 2, 3):
        centre = rng.standard_normal((2, 200)) * 2
        radius = rng.random((2, 200)) * 0.1
        found = VdotBound(Problem(loop, Quadratic(P)), T, order=order)(centre - radius, centre + radius, 1e-6, 1e6)
        for _ in range(20):
            x = (T @ (centre + radius * rng.uniform(-1, 1, (2, 200)))).T
            y, u = x, loop.policy(x)
            for _ in range(50):
                y = rk4_step(lambda s, u=u: f(s, u), y, 0.1 / 50)
            D = (np.einsum("bi,ij,bj->b", y, P, y) - np.einsum("bi,ij,bj->b", x, P, x)) / 0.1
            bound = np.nan_to_num(found.bound, nan=np.inf)
            assert np.all(bound - D >= -1e-3 * (1 + np.abs(D)))


def test_balls_of_a_point_show_what_the_increment_is() -> None:
    """In Arb, with a corner passed within the period: nothing."""
    loop = ClosedLoop(plant("p v", "clip(v, -1, 1)", "u").with_sample(TENTH), regulator(1.0, 1.73))
    far, near = (evaluate_increment(loop, np.eye(2), np.array([2.0, v]), TENTH[0]) for v in (0.2, 1.05))
    assert far.is_finite() and not near.is_finite()


# ------------------------------------------------------------------------------------------------------ what is proved

W = {"ranges": {"w": (Fraction(-1, 10), Fraction(1, 10))}}
DOUBLE = ("v", "clip(u, -1, 1) - v*abs(1 + v)/10")
LOOPS: dict[str, tuple[Any, float]] = {
    "double integrator": (lambda: plant("p v", *DOUBLE), 0.9),
    "uncertain": (lambda: plant("p v", "v", "clip(u, -1, 1)*(1 + w) - v*abs(1/2 + w)", **W), 0.9),
    "held": (lambda: plant("p v", *DOUBLE).with_sample((Fraction(1, 20), Fraction(1, 10))), 0.2),
    "held speed": (lambda: plant("p v", "clip(v, -1, 1)", "u").with_sample(TENTH), 0.9),
    "discrete": (
        lambda: plant("p v", "p + v/10 + clip(u, -1, 1)/200", "clip(v + clip(u, -1, 1)/10, -2, 2)", time="discrete"),
        0.6,
    ),
}


@pytest.mark.parametrize(
    "name", [*slow_after(0, [k for k in LOOPS if "held" in k]), *(k for k in LOOPS if "held" not in k)]
)
def test_saturated_plants_are_proved(name: str, tmp_path: Path) -> None:
    """To the end: the checker accepts it, and simulated runs from the set converge."""
    build, least = LOOPS[name]
    result = certify_roa(build(), regulator(1.0, 1.73), tmp_path, RoaOptions(effort=0.2 if "held" in name else 0.02))
    assert result.verdict is Verdict.PROVED and result.levels.roa is not None and result.problem is not None
    assert result.levels.roa > least
    system, loop = result.problem.loop.system, result.problem.loop
    f, rng = system.uncertain_function(), np.random.default_rng(0)
    x = rng.standard_normal((200, 2))
    x *= np.sqrt(result.levels.roa / np.einsum("bi,ij,bj->b", x, result.problem.V.P, x))[:, None]
    step = float(system.sample[1]) if system.sample else 0.02
    for _ in range(int(40 / step) if system.time == "continuous" else 400):
        q, u = [rng.uniform(float(lo), float(hi)) for _, (lo, hi) in system.uncertain], loop.policy(x)
        held = u if system.in_steps else None
        if system.time == "discrete":
            x = f(x, u, q)
        else:
            x = rk4_step(lambda y, u=held, q=q: f(y, loop.policy(y) if u is None else u, q), x, step)
    assert np.abs(x).max() < 1e-2


@pytest.mark.slow
def test_leaves_across_a_corner_are_shown_in_the_order_that_they_were_proved_in_alone(tmp_path: Path) -> None:
    """A series of order 2 does not exist there, and boxes with ranks ask for it: the ring's proof keeps its order."""
    result = certify_roa(
        LOOPS["held"][0](), regulator(1.0, 1.73), tmp_path, RoaOptions(candidate="optimised", effort=0.05)
    )
    assert result.certificate is not None and result.problem is not None
    read = read_certificate(result.certificate)
    assert isinstance(read.evidence, PartitionTree) and read.evidence.order == 1
    assert [are_shown(result.problem, read.evidence, read.claim, order) for order in (1, 2)] == [True, False]
    whole = replace(read.claim, roa=float(read.claim.roa) * 1.1)  # leaves beyond the level were not asked
    assert not are_shown(result.problem, read.evidence, whole, 1)


FALSE = {
    "a push beyond 1": ("u - x + 9*max(x - 1, 0)", 3.0),
    "a thin push": ("u - x + 400*max(1/100 - abs(x - 7/10), 0)", 2.5),
    "a thin push on the other side": ("u - x - 400*max(1/100 - abs(x + 7/10), 0)", 2.5),
    "a hold": ("clip(u - x, -1/2, 1/2) + clip(x - 1, 0, 1/2)", 2.5),
    "a weak input": ("x/2 + clip(u, -1, 1)", 2.5),
    "rest elsewhere": ("u - x + 8*max(x - 1, 0) - 20*max(x - 3/2, 0)", 2.5),
}


TIMES = ["at once", "held", "steps"]


def timed(equation: str, half: float, time: str) -> System:
    """x' = the equation, its input held, or a step of Euler's."""
    if time == "steps":
        return plant("x", f"x + ({equation})/100", half=half, bound=9, time="discrete")
    system = plant("x", equation, half=half, bound=9)
    return system.with_sample((Fraction(1, 100), Fraction(1, 100))) if time == "held" else system


@pytest.mark.parametrize("name", FALSE)
@pytest.mark.parametrize("time", TIMES)
def test_a_false_claim_is_never_proved(name: str, time: str, tmp_path: Path) -> None:
    """There the state rises, or rests elsewhere, inside of the set that is asked for."""
    equation, half = FALSE[name]
    system = timed(equation, half, time)
    x, loop = np.linspace(-half, half, 200_001)[:, None], ClosedLoop(system, regulator(0.5))
    moved = system.function()(x, loop.policy(x)) - (x if time == "steps" else 0)
    assert np.any((moved * x > -1e-12) & (np.abs(x) > 0.1))
    result = certify_roa(system, regulator(0.5), tmp_path, RoaOptions(level=0.99 * half**2, P=np.eye(1)))
    assert result.verdict is not Verdict.PROVED


@pytest.mark.parametrize("time", TIMES)
def test_a_true_claim_beside_it_is_proved(time: str, tmp_path: Path) -> None:
    system = timed("u - x + 9*max(x - 4, 0) - max(x - 1, 0)", 3.0, time)
    result = certify_roa(system, regulator(0.5), tmp_path, RoaOptions(level=0.99 * 9, P=np.eye(1)))
    assert result.verdict is Verdict.PROVED


DRAG = "0*u + (x*abs(x) - x)/8"  # turns at |x| = 1


@pytest.mark.parametrize("time", slow_after(1, TIMES))
def test_drag_of_the_wrong_sign_is_proved_up_to_where_it_turns(time: str, tmp_path: Path) -> None:
    system, options = timed(DRAG, 2.0, time), RoaOptions(level=1 - 1e-3, P=np.eye(1))
    assert certify_roa(system, regulator(0.5), tmp_path, options).verdict is Verdict.PROVED
    for level in (1 + 1e-9, 1.5):
        beyond = certify_roa(system, regulator(0.5), tmp_path, RoaOptions(level=level, P=np.eye(1)))
        assert beyond.verdict is not Verdict.PROVED


@pytest.mark.slow
@pytest.mark.parametrize("claim", slow_after(1, ["nearby", "asymptotic", "practical"]))
def test_drag_at_rest_is_proved_with_ranges(claim: str, tmp_path: Path) -> None:
    """The corner moves with w in the last two, so that the loop does not rest at the origin."""
    moved = "abs(v)" if claim == "asymptotic" else "abs(v - w)"
    system = plant("v p", f"3*u - p - (1 + w)*v*{moved}", "v", **W)
    result = certify_roa(system, regulator(1.0, 1.73), tmp_path, RoaOptions(effort=0.02, claim=claim))
    assert result.verdict is Verdict.PROVED


@pytest.mark.slow
def test_a_corner_of_a_held_input_at_rest_costs_the_ball_nothing(tmp_path: Path) -> None:
    """The input does not change within a period, and so the series in time is known."""
    system = plant("p v", "v", "-p - v + u*abs(u)").with_sample(TENTH)
    result = certify_roa(system, regulator(0.2, 0.2), tmp_path, RoaOptions(effort=0.02))
    assert result.verdict is Verdict.PROVED and result.levels.roa is not None and result.levels.roa > 0.99


@pytest.mark.slow
def test_a_corner_at_rest_that_a_state_may_pass_in_a_period_is_named(tmp_path: Path) -> None:
    system = plant("p v", "v", "-p - v - v*abs(v) + u").with_sample(TENTH)
    result = certify_roa(system, regulator(0.2, 0.2), tmp_path, RoaOptions(effort=0.02))
    assert result.verdict is Verdict.UNKNOWN
    assert result.reason.startswith("local: abs(v) has its corner at the operating point") and "1e-2" in result.reason
    assert result.diagnosis is not None and result.diagnosis.next.options == (("--claim", "practical"),)
    weaker = certify_roa(system, regulator(0.2, 0.2), tmp_path, RoaOptions(claim="practical", effort=0.03))
    assert weaker.verdict is Verdict.PROVED
