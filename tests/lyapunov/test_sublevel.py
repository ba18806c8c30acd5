"""Whether states lie in {N <= n2} within the domain: nothing that is said is wrong, and at rationals all is said."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from fractions import Fraction
from itertools import pairwise
from typing import Any

import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from certify.errors import InputError
from certify.loop.expressions import as_expression, cos, exp, sin, sqrt, symbols, tan, tanh
from certify.loop.rigorous import ball, precision
from certify.lyapunov import Neural, Symbolic
from certify.lyapunov.rigorous import function_on
from certify.lyapunov.sublevel import Sublevel

F = Fraction
x, y = symbols("x y")
UNIT = (F(-1), F(1))
TINY = F(1, 10**200)


def of(expression: Any, level: float = 1.0, half: Fraction | int = 2) -> Sublevel:
    return Sublevel(Symbolic(as_expression(expression), (x, y)), level, ((F(-half), F(half)),) * 2)


def network(seed: int, widths: Sequence[int], size: float = 1.0) -> Neural:
    generator = np.random.default_rng(seed)
    weights = tuple(size * generator.standard_normal((b, a)) for a, b in pairwise(widths))
    return Neural(weights, tuple(generator.standard_normal(w) for w in widths[1:]))


def sides(where: Sublevel, *point: Fraction | float) -> tuple[bool, bool]:
    """Whether a state is shown to lie in the set, and whether outside."""
    return where.holds([point])[0], where.excludes([point])[0]


INSIDE, OUTSIDE, OPEN = (True, False), (False, True), (False, False)


@pytest.mark.parametrize(
    ("N", "point", "expected"),
    [
        (x**2 + y**2, (F(3, 5), F(4, 5)), INSIDE),  # on the boundary, exactly
        (x**2 + y**2, (F(3, 5), F(4, 5) + TINY), OUTSIDE),
        (x**2 + y**2, (F(3, 5), F(4, 5) - TINY), INSIDE),
        (x**2 - 10, (F(2), F(0)), INSIDE),  # the domain is closed
        (x**2 - 10, (F(2) + TINY, F(0)), OUTSIDE),
        (x**2 - 10, (F(0), -F(2) - TINY), OUTSIDE),
        (exp(x) + y, (0.0, 0.0), INSIDE),  # exp has a rational value at 0, and it is the level
        (exp(x) + y, (TINY, F(0)), OUTSIDE),
        (tanh(x) ** 2 + 1 - tanh(x) ** 2, (F(1), F(0)), OPEN),  # 1 to whoever simplifies it, as nobody does
        (sin(x) ** 2 + cos(x) ** 2, (F(1), F(0)), OPEN),  # 1 as well, and no ball tells
        (1 / x, (F(0), F(1)), OPEN),  # N has no value there
        (sqrt(x) - 3, (F(-1), F(1)), OPEN),
        (sqrt(x) - 3, (F(1), F(1)), INSIDE),
    ],
)
def test_known_states(N: Any, point: tuple[Any, ...], expected: tuple[bool, bool]) -> None:
    assert sides(of(N), *point) == expected


def test_bits_are_added_until_it_is_decided() -> None:
    """tanh(x) - x + x^3/3 is 2 x^5/15 or so, which is lost beside x at 1e-60 unless there are five times its digits."""
    N, at = tanh(x) - x + x**3 / 3, F(1, 10**60)
    value = 2.0 / 15 * 1e-300
    assert sides(of(N, 1.001 * value), at, F(0)) == INSIDE
    assert sides(of(N, 0.999 * value), at, F(0)) == OUTSIDE


def test_the_level_is_the_binary_number_that_it_is() -> None:
    tenth = of(x, 0.1)
    assert sides(tenth, F(0.1), F(0)) == INSIDE and F(0.1) > F(1, 10)
    assert sides(tenth, math.nextafter(0.1, 1), 0.0) == OUTSIDE


@pytest.mark.parametrize("widths", [(1, 1), (2, 3, 1), (3, 8, 8, 1), (2, 5, 4, 3, 1)])
def test_a_network_is_what_its_numbers_say(widths: tuple[int, ...]) -> None:
    """Against mpmath with the level a hair above and below the value."""
    N, generator = network(sum(widths), widths), np.random.default_rng(1)
    domain = ((F(-2), F(2)),) * widths[0]
    for point in generator.uniform(-2, 2, (4, widths[0])):
        with mpmath.workdps(40):
            h = mpmath.matrix(point.tolist())
            for k, (W, b) in enumerate(zip(N.weights, N.biases, strict=True)):
                h = mpmath.matrix(W.tolist()) * (h.apply(mpmath.tanh) if k else h) + mpmath.matrix(b.tolist())
            value = h[0]
        near = float(value)
        levels = [math.nextafter(math.nextafter(near, d * math.inf), d * math.inf) for d in (-1, 1)]
        assert levels[0] < value < levels[1]
        assert [sides(Sublevel(N, level, domain), *point) for level in levels] == [OUTSIDE, INSIDE]


def test_large_weights_say_nothing_wrong() -> None:
    """A step of 2^60: on one side of its middle the network is 1, on the other -1, and there it is 0."""
    step = Neural((np.array([[2.0**60]]), np.array([[1.0]])), (np.array([0.0]), np.array([0.0])))
    where = Sublevel(step, 0.0, (UNIT,))
    assert [sides(where, v) for v in (F(-1, 2**50), F(1, 2**50), F(0))] == [INSIDE, OUTSIDE, INSIDE]
    assert sides(Sublevel(step, math.nextafter(1.0, 0), (UNIT,)), F(1, 2**50)) == OUTSIDE
    assert where.look([(F(-1, 2**70), F(1, 2**70))]).covered is False


@given(st.integers(0, 10**6))
def test_a_box_that_is_covered_is(seed: int) -> None:
    generator = np.random.default_rng(seed)
    N = network(seed, (2, 6, 1))
    if seed % 2:
        a, b, c = generator.integers(-3, 4, 3)
        N = Symbolic(int(a) * x**2 + sin(int(b) * x * y) + int(c) * y / (x**2 + 1), (x, y))  # type: ignore[assignment]
    middle, half = generator.uniform(-1, 1, 2), generator.uniform(0, 0.4, 2) * (generator.random(2) < 0.8)
    box = [(F(c) - F(h), F(c) + F(h)) for c, h in zip(middle, half, strict=True)]
    level = float(N(middle) + generator.uniform(-0.2, 1.5))
    where = Sublevel(N, level, ((F(-2), F(2)),) * 2)
    seen = where.look(box)
    shares = generator.integers(0, 65, (12, 2))
    points = [[lo + (hi - lo) * F(int(k), 64) for (lo, hi), k in zip(box, row, strict=True)] for row in shares]
    if seen.covered:
        assert all(where.holds(points))
    assert (seen.axis is None) is (not np.any(half)) and (seen.axis is None or half[seen.axis] > 0)


def test_small_boxes_are_decided() -> None:
    """Far from the level a box needs no subdivision, and the width of what is undecided falls with that of the box."""
    N = network(3, (2, 8, 8, 1))
    centre, domain = np.array([0.3, -0.2]), ((F(-2), F(2)),) * 2
    for half in (F(1, 10), F(1, 100), F(1, 1000)):
        box = [(F(c) - half, F(c) + half) for c in centre]
        spread = float(np.abs(N.gradient(centre)).sum() * half)
        assert Sublevel(N, float(N(centre)) + 1.5 * spread + float(5000 * half**2), domain).look(box).covered
        assert not Sublevel(N, float(N(centre)) + 0.9 * spread - float(5000 * half**2), domain).look(box).covered


@pytest.mark.parametrize(
    ("N", "box"),
    [
        (x**2, ((F(1), F(5, 2)), UNIT)),  # beyond the domain
        (1 / x - 9, (UNIT, UNIT)),  # it is below the level on most of the box
        (sqrt(x) - 9, (UNIT, UNIT)),
        (tan(2 * x) - 99, (UNIT, UNIT)),
    ],
)
def test_a_box_that_leaves_the_domain_or_that_n_has_no_value_on_is_not_covered(N: Any, box: Any) -> None:
    where = of(N, 1e9)
    assert not where.look(box).covered
    assert of(x - 9, 1e9).look((UNIT, UNIT)).covered


@pytest.mark.parametrize("make", [lambda: network(5, (3, 7, 4, 1)), lambda: Symbolic(exp(x) * y**3 - x / y, (x, y))])
def test_gradients_are_those_of_n(make: Callable[[], Any]) -> None:
    N = make()
    point = np.array([0.3, -0.7, 0.2])[: N.n]
    with precision():
        value, slopes = function_on(N, [ball(F(v)) for v in point])
        assert abs(float(value) - float(N(point))) < 1e-14
        assert np.allclose([float(g) for g in slopes], N.gradient(point), rtol=1e-13)
        around, steep = function_on(N, [ball(F(v) - F(1, 50)).union(ball(F(v) + F(1, 50))) for v in point])
        for corner in np.stack(np.meshgrid(*[[-0.02, 0.0, 0.02]] * N.n), -1).reshape(-1, N.n):
            assert around.contains(float(N(point + 0.9 * corner)))
            assert all(g.contains(float(v)) for g, v in zip(steep, N.gradient(point + 0.9 * corner), strict=True))


def test_n_and_the_domain_are_of_one_plant() -> None:
    with pytest.raises(InputError, match="must have 2 states"):
        Sublevel(Symbolic(x + y, (x, y)), 1.0, (UNIT,))
