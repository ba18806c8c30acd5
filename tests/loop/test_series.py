"""Power series of solutions: against sympy's derivatives, and against a dense integration."""

from __future__ import annotations

import gc
import math
import weakref
from fractions import Fraction

import numpy as np
import pytest
import scipy.integrate
import sympy

from certify.loop.expressions import Algebra, Number, PowerSeries, Series, evaluate, sin, solution_series, symbols
from certify.loop.plants.equations import parse_expression
from tests.support.algebra import to_sympy
from tests.support.marks import slow_after

X, Y, U = symbols("x y u")
T = sympy.Symbol("t")


class Numbers(Algebra[float]):
    def constant(self, q: Fraction) -> float:
        return float(q)

    def inverse(self, value: float) -> float:
        return 1 / value

    def function(self, name: str, value: float) -> float:
        return float(getattr(math, name)(value))


@pytest.mark.parametrize(
    "text",
    slow_after(
        4,
        [
            "sin(x)",
            "cos(x)*sin(x)",
            "tan(x)",
            "tanh(x - 1)",
            "exp(-x)",
            "atan(2*x)",
            "sqrt(1 + x)",
            "1/(2 + x)",
            "x**5 - 3*x**3/7 + 2",
            "x**(-3)",
            "sqrt(x)*tanh(sin(x) + exp(x)/3)/(1 + atan(x)**2)",
        ],
    ),
)
def test_coefficients_of_a_function_along_a_series(text: str) -> None:
    expression = parse_expression(text, {"x": X})
    row = [sympy.Rational(1, 3), sympy.Rational(-1, 2), sympy.Integer(0), sympy.Rational(5, 7), sympy.Rational(1, 9)]
    algebra = PowerSeries(Numbers())
    x = Series(float(row[0]))
    found = evaluate(expression, {X: x}, algebra)
    for c in row[1:]:
        x.coefficients.append(float(c) if c else None)
        algebra.advance()
    along = to_sympy(expression).subs(sympy.Symbol("x"), sum(c * T**k for k, c in enumerate(row)))
    for k, coefficient in enumerate(found.coefficients):
        wanted = float((along.diff(T, k).subs(T, 0) / sympy.factorial(k)).evalf(30))
        assert (coefficient or 0.0) == pytest.approx(wanted, rel=1e-11, abs=1e-12)


def test_a_coefficient_that_is_certainly_0_is_no_value() -> None:
    algebra = PowerSeries(Numbers())
    found = evaluate(sin(X) * U + 3, {X: algebra.held(1.0), U: algebra.held(2.0)}, algebra)
    algebra.advance()
    assert found.coefficients[1] is None
    assert found.coefficients[0] == 3 + 2 * math.sin(1)


def test_the_series_of_a_solution_ends_at_the_solution() -> None:
    """x' = y, y' = -sin(x) + u - y/5 from (1, -1/2), u = 3/10: the error of order r over h falls as h^(r + 1)."""
    f = (Y, -sin(X) + U - Y / 5)
    rows = solution_series(f, {X: 1.0, Y: -0.5}, {U: 0.3}, Numbers(), 6)

    def rate(_: float, z: np.ndarray) -> list[float]:
        return [z[1], -math.sin(z[0]) + 0.3 - z[1] / 5]

    for order in (1, 3, 6):
        errors = []
        for h in (0.5, 0.25):
            solution = scipy.integrate.solve_ivp(rate, (0.0, h), [1.0, -0.5], "DOP853", rtol=1e-13, atol=1e-15)
            reached = [
                x + sum(c * h ** (k + 1) for k, c in enumerate(row[:order]))
                for x, row in zip((1, -0.5), rows, strict=True)
            ]
            errors.append(float(np.max(np.abs(reached - solution.y[:, -1]))))
        assert order + 0.5 < math.log2(errors[0] / errors[1]) < order + 1.5


def test_a_solution_that_moves_at_a_constant_rate() -> None:
    rows = solution_series((Number(2), X), {X: 1.0, Y: 0.0}, {}, Numbers(), 4)
    assert rows == [[2, 0, 0, 0], [1, 1, 0, 0]]


def test_what_a_series_is_made_of_goes_with_it() -> None:
    """Models of a network's inputs have megabytes, and Python looks for circles by the number of objects."""

    class Large(float):
        pass

    made: list[weakref.ref[Large]] = []

    class Watched(Numbers):
        def function(self, name: str, value: float) -> float:
            found = Large(super().function(name, value))
            made.append(weakref.ref(found))
            return found

    gc.disable()
    try:
        solution_series([parse_expression("sin(x)*tanh(x) + exp(x)", {"x": X})], {X: 0.5}, {}, Watched(), 4)
        assert len(made) == 4  # sin and cos, tanh, exp
        assert not [found for found in made if found() is not None]
    finally:
        gc.enable()
