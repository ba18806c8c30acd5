"""abs, min, max and clip in equations: read, written, evaluated in every arithmetic, and refused where there is no
derivative."""

from __future__ import annotations

import json
import math
import random
from fractions import Fraction
from pathlib import Path

import flint
import numpy as np
import pytest
import sympy
import torch

import certify
from certify.certificates.claims import Asymptotic, Problem, conditions
from certify.certificates.claims.queries import query
from certify.certificates.coq.expression import from_tree as coq_tree
from certify.certificates.limits import require_within_limits
from certify.errors import InputError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.equilibrium import find_rest
from certify.loop.expressions import (
    Algebra,
    PowerSeries,
    Series,
    differentiate,
    evaluate,
    evaluate_exactly,
    from_sympy,
    from_tree,
    in_absolute_values,
    numerical,
    sin,
    symbols_of,
    to_tree,
    value_if_rational,
)
from certify.loop.plants import linearise, load_system
from certify.loop.plants.equations import parse_expression
from certify.loop.rigorous import MeanSlopes, evaluate_arb
from certify.lyapunov.function import Quadratic
from certify.lyapunov.symbolic import Symbolic
from certify.report.mathml import typeset
from tests.support.corners import U, X, Y, plant, regulator, tree, value

POINTS = np.random.default_rng(0).standard_normal((2, 40)) * 2


@pytest.mark.parametrize("seed", range(40))
def test_all_arithmetics_give_numpys_values(seed: int) -> None:
    e = tree(random.Random(seed), 4)
    wanted = value(e, {X: POINTS[0], Y: POINTS[1]})
    near = pytest.approx(wanted, rel=1e-9, abs=1e-9)
    for expression in (e, in_absolute_values(e), from_tree(to_tree(e), {"x": X, "y": Y})):
        assert np.broadcast_to(numerical([expression], [X, Y])(*POINTS)[0], 40) == near
    assert np.broadcast_to(numerical([e], [X, Y], "torch")(*map(torch.tensor, POINTS))[0], 40) == near
    with_balls = [evaluate_arb(e, {X: flint.arb(x), Y: flint.arb(y)}) for x, y in POINTS.T.tolist()]
    assert np.array([float(v.mid()) for v in with_balls]) == near
    for (x, y), v in zip(POINTS.T.tolist(), wanted, strict=True):
        exact = value_if_rational(e, {X: Fraction(x), Y: Fraction(y)})
        assert isinstance(exact, str) or float(exact) == pytest.approx(v, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("seed", range(40))
def test_text_is_read_as_it_was_written(seed: int) -> None:
    e = tree(random.Random(seed), 4)
    assert parse_expression(str(e), {"x": X, "y": Y}) is parse_expression(str(e), {"x": X, "y": Y})
    read = parse_expression(str(e), {"x": X, "y": Y})
    assert str(read) == str(e)
    assert value(read, {X: POINTS[0], Y: POINTS[1]}) == pytest.approx(value(e, {X: POINTS[0], Y: POINTS[1]}))


def test_the_tree_is_the_tree_that_was_written() -> None:
    e = parse_expression("clip(u, -2, 2) - min(x, 1, y)*abs(-x)", {"x": X, "y": Y, "u": U})
    assert to_tree(e) == [
        "+", ["clip", "u", "-2", "2"], ["-", ["*", ["min", "x", "1", "y"], ["abs", ["-", "x"]]]],
    ]  # fmt: skip
    assert e is certify.clip(U, -2, 2) - certify.minimum(X, 1, Y) * abs(-X)
    assert certify.maximum(X, Y) is parse_expression("max(x, y)", {"x": X, "y": Y})
    assert str(abs(X)) == "abs(x)"


def test_sympys_extremes() -> None:
    x, y = sympy.symbols("x y", real=True)
    for e in (sympy.Abs(x - y), sympy.Max(x, y, 1) - sympy.Min(x, y**2)):
        wanted = [float(e.subs({x: a, y: b})) for a, b in POINTS.T.tolist()]
        assert value(from_sympy(e), {X: POINTS[0], Y: POINTS[1]}) == pytest.approx(wanted)


@pytest.mark.parametrize("seed", range(40))
def test_derivatives_are_slopes_where_no_corner_is_near(seed: int) -> None:
    e, h = tree(random.Random(seed), 3), 1e-6
    slope = np.broadcast_to(numerical([differentiate(e, X)], [X, Y])(*POINTS)[0], 40)
    left, right = (value(e, {X: POINTS[0] + d, Y: POINTS[1]}) for d in (-h, h))
    middle = value(e, {X: POINTS[0], Y: POINTS[1]})
    smooth = np.abs(right - 2 * middle + left) < 1e-9 * (1 + np.abs(middle))
    assert np.sum(smooth) > 30
    assert slope[smooth] == pytest.approx(((right - left) / (2 * h))[smooth], rel=1e-4, abs=1e-4)


def test_a_derivative_at_a_corner() -> None:
    """From the right in floats, nothing in rationals and balls, but all slopes where means are meant."""
    slope = differentiate(abs(X), X)
    assert numerical([slope], [X])(np.array([-1.0, 0.0, 2.0]))[0].tolist() == [-1.0, 1.0, 1.0]
    with pytest.raises(InputError, match="the slope of abs at 0 has no exact value"):
        evaluate_exactly(slope, {X: Fraction(0)})
    assert evaluate_arb(slope, {X: flint.arb(0, 1e-30)}).is_nan()
    assert evaluate(slope, {X: flint.arb(0, 1e-30)}, MeanSlopes(), {}).contains(flint.arb(0, 1))
    assert evaluate_arb(slope, {X: flint.arb(-1, 0.5)}) == -1


class _Floats(Algebra[float]):
    def constant(self, q: Fraction) -> float:
        return float(q)

    def function(self, name: str, value: float) -> float:
        if name == "sign":
            return math.copysign(1.0, value)
        return abs(value) if name == "abs" else float(getattr(math, name)(value))


def test_series_in_time_take_the_sign_of_the_first_coefficient() -> None:
    """|sin(x) - y|, of x = 1 + t and y = 2: minus the series of sin(x) - y."""
    series = PowerSeries(_Floats())
    x, y = Series(1.0, 1.0, *(3 * [None])), Series(2.0, *(4 * [None]))
    found = [evaluate(e, {X: x, Y: y}, series) for e in (abs(sin(X) - Y), Y - sin(X), certify.maximum(sin(X), Y))]
    for _ in range(3):
        series.advance()
    assert found[0].coefficients == pytest.approx(found[1].coefficients)
    assert [v or 0.0 for v in found[2].coefficients] == pytest.approx([2.0, 0.0, 0.0, 0.0])


def test_what_is_constant_in_time_needs_no_sign() -> None:
    class NoSign(_Floats):
        def function(self, name: str, value: float) -> float:
            return math.nan if name == "sign" else super().function(name, value)

    series = PowerSeries(NoSign())
    found = [evaluate(abs(s), {X: Series(0.5, None, None), Y: Series(0.5, 1.0, None)}, series) for s in (X, Y)]
    for _ in range(2):
        series.advance()
    assert found[0].coefficients == [0.5, None, None]
    assert all(math.isnan(v) for v in found[1].coefficients[1:] if v is not None) and None not in found[1].coefficients


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("np.clip(x, -1, 1)", "write clip(x, -1, 1)."),
        ("torch.clamp(x, min=-1, max=1)", "write clip(x, -1, 1)."),
        ("np.minimum(x, 1)", "write min(x, 1)."),
        ("maximum(x, 1)", "for maximum(x, 1) write max(x, 1)."),
        ("np.abs(x)", "write abs(x)."),
        ("fabs(x)", "write abs(x)."),
        ("relu(x + 1)", "write max(x + 1, 0)."),
        ("sat(x)", "write clip(x, -1, 1)."),
        ("sign(x)", "write tanh(50*x)"),
        ("floor(x)", "(1 + tanh(50*y))/2"),
        ("x // 2", "(1 + tanh(50*y))/2"),
        ("x % 6", "sin and cos repeat"),
        ("np.interp(x, 1, 2)", "max(x - x1, 0)"),
        ("1 if x > 0 else 0", "no cases"),
        ("clip(x, 1)", "clip takes three arguments, a value and two ends; found 'clip(x, 1)'"),
        ("min(x)", "min takes two arguments or more"),
        ("abs(x, 1)", "abs takes one argument"),
        ("clip", "clip must have its arguments in brackets, as in clip(x, -1, 1)"),
    ],
)
def test_other_spellings_are_corrected(text: str, said: str) -> None:
    with pytest.raises(InputError) as refused:
        parse_expression(text, {"x": X})
    assert said in str(refused.value) and "smooth" not in str(refused.value)


def test_pythons_min_and_numpys_clip_are_corrected() -> None:
    for attempt in (lambda: min(X, Y), lambda: max(X, 1), lambda: X < 0, lambda: np.clip(np.array(X), 0, 1)):
        with pytest.raises(InputError, match=r"certify\.minimum"):
            attempt()
    with pytest.raises(InputError, match="clip must have 3 operands; found 2"):
        certify.loop.expressions.function("clip", X, 1)


@pytest.mark.parametrize(
    ("equation", "term"),
    [
        ("u - abs(x)", "abs(x)"),
        ("u - (1 + x)*max(x, 0)", "max(x, 0)"),
        ("u - abs(x)*sqrt(2)*exp(x + 1)", "abs(x)"),
        ("u + exp(x + 1)*x - abs(x + abs(x))", "abs(x)"),
        ("clip(u, 0, 1) - x", "clip(u, 0, 1)"),
        ("u - max(x, 2*x)", "max(x, 2*x)"),
        ("u - x + 2*min(1 - x, 1 + x, 3)", "min(1 - x, 1 + x, 3)"),
    ],
)
def test_a_corner_at_the_operating_point_is_named(equation: str, term: str) -> None:
    found = plant("x", equation, ranges={"w": (Fraction(-1), Fraction(1))})
    with pytest.raises(InputError) as refused:
        linearise(found)
    assert f"must be differentiable at the operating point; {term} has a corner there" in str(refused.value)


@pytest.mark.parametrize(
    ("equation", "slope"),
    [
        ("u - 3*x - x*abs(x)", -3),
        ("u - x + max(x, 0)*x", -1),
        ("u + 2*x + abs(x)**3", 2),
        ("u - abs(x)*sin(x)*cos(x)", 0),
        ("u - x + abs(x*abs(x))", -1),
        ("u - x + 0*min(1 - x, 1 + x, 3)", -1),
        ("u - x*abs(w)", 0),
        ("clip(x, -1, 1)*min(x, 2*x) + u - x", -1),
    ],
)
def test_a_corner_times_0_has_a_derivative(equation: str, slope: int) -> None:
    A, B = linearise(plant("x", equation, ranges={"w": (Fraction(-1), Fraction(1))}))
    assert (str(A[0][0]), str(B[0][0])) == (str(slope), "1")


def test_a_corner_elsewhere_does_not_count() -> None:
    A, B = linearise(plant("x", "clip(u, -1, 1) - 3*abs(x + 1) + 3 + max(x - 1, 0)"))
    assert (str(A[0][0]), str(B[0][0])) == ("-3", "1")


def test_what_needs_derivatives_everywhere_refuses_corners() -> None:
    with pytest.raises(InputError, match=r"continuously differentiable; abs\(x\) has a corner"):
        Symbolic(abs(X) + X**2, (X,))
    with pytest.raises(InputError, match="Coq's statement is about smooth equations; found clip"):
        coq_tree(["clip", "u", "-1", "1"], {"x": 0}, {"u": 0})
    loop = ClosedLoop(plant("x", "clip(u, -1, 1)"), regulator(1.0))
    problem = Problem(loop, Quadratic(np.eye(1)))
    for condition in conditions(Asymptotic(roa=1.0, local=0.5), problem):
        with pytest.raises(
            InputError, match=r"smooth equations; cornered has clip\(u, -1, 1\)\. Use the engine bounds"
        ):
            query(condition, problem)


def test_an_equilibrium_beside_a_corner_is_found_and_one_on_it_is_not() -> None:
    beside = ClosedLoop(plant("x", "u + max(x, 0) + 1"), regulator(3.0))
    rest = find_rest(beside)
    assert rest is not None and float(rest.x[0]) == pytest.approx(0.5, abs=0.1) and rest.stable
    assert find_rest(ClosedLoop(plant("x", "u + abs(x)/2"), regulator(3.0))) is None


def test_limits_count_what_the_checker_counts() -> None:
    deep = "x"
    for _ in range(150):
        deep = f"max({deep}, x)"
    require_within_limits(plant("x", f"clip(u, -1, 1) - {deep}"), regulator(1.0))
    with pytest.raises(InputError, match="at most 200 deep"):
        plant("x", "u - " + "abs(" * 199 + "x" + ")" * 199)


def test_pages_show_corners() -> None:
    shown = str(typeset("<mi>f</mi>", certify.clip(U, -1, 1) + abs(X)))
    assert "<mi>clip</mi>" in shown and shown.count("<mo>,</mo>") == 2 and shown.count("<mo>|</mo>") == 2


PENDULUM = """
name = "gymnasium_pendulum"
time = "discrete"
states = ["theta", "omega"]
inputs = ["u"]
parameters = {g = 10, m = 1, l = 1, dt = 0.05}

[where]
faster = "clip(omega + (3*g/(2*l)*sin(theta) + 3/(m*l**2)*clip(u, -2, 2))*dt, -8, 8)"

[dynamics]
theta = "theta + faster*dt"
omega = "faster"

[u_eq]
u = 0

[domain]
theta = [-4, 4]
omega = [-10, 10]

[input_bounds]
u = [-5, 5]
"""


def test_a_step_of_gymnasiums_pendulum(tmp_path: Path) -> None:
    """Saturated torque and speed, as its own code computes them."""
    gymnasium = pytest.importorskip("gymnasium")
    path = tmp_path / "pendulum.toml"
    path.write_text(PENDULUM)
    found = load_system(path)
    f, env = found.function(), gymnasium.make("Pendulum-v1").unwrapped
    env.reset(seed=0)
    rng, saturated = np.random.default_rng(0), 0
    for _ in range(300):
        x, u = rng.uniform([-4, -10], [4, 10]), rng.uniform(-5, 5)
        env.state = x
        env.step(np.array([u]))
        assert f(x, np.array([u])) == pytest.approx(env.state, rel=1e-12, abs=1e-12)
        saturated += abs(env.state[1]) == 8
    assert saturated > 30
    assert json.dumps(to_tree(found.exact_dynamics()[1]))[:8] == '["clip",'
    assert symbols_of(found.exact_dynamics()[0]) == {*found.states, *found.inputs}
