"""Power series of solutions: against sympy's series, and against solutions that are known."""

from __future__ import annotations

from fractions import Fraction

import mpmath
import pytest
import sympy

from certify.expressions import Algebra, PowerSeries, Series, evaluate, solution_series

X, Y, U, T = sympy.symbols("x y u t")


class Numbers(Algebra[mpmath.mpf]):
    def constant(self, q: Fraction) -> mpmath.mpf:
        return mpmath.mpf(q.numerator) / q.denominator

    def inverse(self, value: mpmath.mpf) -> mpmath.mpf:
        return 1 / value

    def function(self, name: str, value: mpmath.mpf) -> mpmath.mpf:
        return getattr(mpmath, name)(value)


@pytest.mark.parametrize(
    "text",
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
)
def test_coefficients_of_a_function_along_a_series(text):
    expression = sympy.sympify(text, locals={"x": X})
    row = [sympy.Rational(1, 3), sympy.Rational(-1, 2), 0, sympy.Rational(5, 7), sympy.Rational(1, 9)]
    with mpmath.workdps(40):
        algebra = PowerSeries(Numbers())
        x = Series(Numbers().constant(Fraction(1, 3)))
        found = evaluate(expression, {X: x}, algebra)
        for c in row[1:]:
            x.coefficients.append(mpmath.mpf(c.p) / c.q if c else None)
            algebra.advance()
        along = expression.subs(X, sum(c * T**k for k, c in enumerate(row)))
        for k, coefficient in enumerate(found.coefficients):
            wanted = (along.diff(T, k).subs(T, 0) / sympy.factorial(k)).evalf(35)
            assert abs((coefficient or 0) - mpmath.mpf(wanted)) < mpmath.mpf(10) ** -30


def test_a_coefficient_that_is_certainly_0_is_no_value():
    algebra = PowerSeries(Numbers())
    found = evaluate(sympy.sin(X) * U + 3, {X: algebra.held(mpmath.mpf(1)), U: algebra.held(mpmath.mpf(2))}, algebra)
    algebra.advance()
    assert found.coefficients[1] is None
    assert found.coefficients[0] == 3 + 2 * mpmath.sin(1)


def test_the_series_of_a_solution_ends_at_the_solution():
    """x' = y, y' = -sin(x) + u - y/5 from (1, -1/2): order 25 over 1/10 against a dense integration."""
    with mpmath.workdps(40):
        f = (Y, -sympy.sin(X) + U - Y / 5)
        values = {X: mpmath.mpf(1), Y: mpmath.mpf(-1) / 2}
        x, y = solution_series(f, values, {U: mpmath.mpf(3) / 10}, Numbers(), 25)
        h = mpmath.mpf(1) / 10

        def rate(_, z):
            return [z[1], -mpmath.sin(z[0]) + mpmath.mpf(3) / 10 - z[1] / 5]

        wanted = mpmath.odefun(rate, 0, [mpmath.mpf(1), mpmath.mpf(-1) / 2])(h)
        for row, first, value in zip((x, y), values.values(), wanted, strict=True):
            total = first + sum(c * h ** (k + 1) for k, c in enumerate(row))
            assert abs(total - value) < mpmath.mpf(10) ** -30


def test_a_solution_that_moves_at_a_constant_rate():
    rows = solution_series((sympy.Integer(2), X), {X: mpmath.mpf(1), Y: mpmath.mpf(0)}, {}, Numbers(), 4)
    assert rows == [[2, 0, 0, 0], [1, 1, 0, 0]]
