"""The checker's enclosures against Arb: containment without any tolerance, then how wide and of which order they are.

Each test draws a true function that the enclosure claims to hold, evaluates it in ball arithmetic of high precision,
and asks for a comparison that is certain. Extreme exponents are drawn on purpose: an enclosure may become infinite or
NaN there, which the rules read as a failure, but never too small.
"""

from __future__ import annotations

import itertools
import math
import tracemalloc
from collections.abc import Callable, Iterator
from fractions import Fraction

import numpy as np
import pytest
from flint import arb, ctx, fmpq, fmpq_mat
from hypothesis import example, given
from hypothesis import strategies as st

from certify.checker import near
from certify.checker.document import MAX_STATES, Policy
from certify.checker.exact import contains_ball, gershgorin_lower, inverse_diagonal, is_definite, root_above
from certify.checker.near import ZERO, Above, self_test
from certify.checker.network import fold
from certify.checker.ring import Ring
from tests.support.jets import Jet, changed, curved, enclose_on_ball, members, plain
from tests.support.jets import constant as constant_jet
from tests.support.marks import slow_after
from tests.support.maxima import drawn as drawn_model
from tests.support.maxima import largest
from tests.support.oracle import awkward, ball, certainly_within, policy_in_arb, quadratic
from tests.support.plain import (
    Taylor,
    affine,
    arb_with_error,
    atan,
    atanh_with_error,
    both_bounds,
    chain,
    elementary,
    enclose_on_boxes,
    exp,
    float_with_error,
    inner_product,
    norm,
    relax_tanh,
    sin_cos,
    spectral_norm,
    tanh,
    total,
    upper_bound,
)
from tests.support.plain import constant as constant_model

FLOATS = st.floats(allow_nan=False, allow_infinity=False)
MAGNITUDES = st.floats(min_value=0.0, allow_nan=False, allow_infinity=False)


@pytest.fixture(autouse=True)
def _quiet() -> Iterator[None]:
    """As in `rules.check`: overflow becomes infinity or NaN."""
    with np.errstate(all="ignore"):
        yield


# ------------------------------------------------------------------------------------------------ elementary functions


def drawn(count: int, end: float, seed: int) -> np.ndarray:
    generator = np.random.default_rng(seed)
    signs = generator.choice([-1.0, 1.0], count)
    return signs * np.where(
        generator.random(count) < 0.5,
        generator.uniform(0, 1.1 * end, count),
        2.0 ** generator.uniform(-60, 8, count),
    )


def assert_tanh_encloses(points: np.ndarray) -> None:
    t, e = tanh(points)
    with ctx.workprec(200):
        for y, value, error in zip(points.tolist(), t.tolist(), e.tolist(), strict=True):
            assert certainly_within(arb(y).tanh(), value, error), y.hex()


def assert_sin_cos_enclose(points: np.ndarray) -> None:
    s, c, s_error, c_error = sin_cos(points)
    with ctx.workprec(1300):  # the argument is reduced by multiples of pi/2 up to 2^1024
        columns = (points.tolist(), s.tolist(), s_error.tolist(), c.tolist(), c_error.tolist())
        for y, sine, sine_error, cosine, cosine_error in zip(*columns, strict=True):
            x = arb(y)
            assert certainly_within(x.sin(), sine, sine_error), y.hex()
            assert certainly_within(x.cos(), cosine, cosine_error), y.hex()


def test_tanh() -> None:
    assert_tanh_encloses(np.concatenate([awkward(20.0), drawn(10_000, 20.0, 1)]))


def test_sin_cos() -> None:
    assert_sin_cos_enclose(awkward(64.0))
    with ctx.workprec(200):
        assert_sin_cos_enclose(drawn(10_000, 64.0, 2))


@pytest.mark.parametrize(("name", "end"), [("exp", 64.0), ("atan", 4.0)])
def test_exp_and_atan(name: str, end: float) -> None:
    points = np.concatenate([awkward(end), drawn(10_000, end, 6), [-745.0, -1e9, -64.1, 64.0, -64.0, 1e16, 2.0**53]])
    values, errors = {"exp": exp, "atan": atan}[name](points)
    known = np.isfinite(errors)
    assert np.array_equal(known, np.isfinite(points) & (points <= 64.0) if name == "exp" else np.isfinite(points))
    with ctx.workprec(200):
        for y, value, error in zip(*(v[known].tolist() for v in (points, values, errors)), strict=True):
            assert certainly_within(getattr(arb(y), name)(), value, error), y.hex()
    inside = known & (np.abs(points) <= 64)
    assert np.all(errors[inside] <= 14.001 * 2.0**-53 * np.abs(values[inside]) + 2.0**-900)  # relative, also near 0


def test_elementary_functions_are_narrow() -> None:
    y = drawn(10_000, 20.0, 3)
    t, e = tanh(y)
    assert np.all(e <= 7.001 * 2.0**-53 * np.abs(t) + 2.0**-900)  # relative, also near 0
    _, _, s_error, c_error = sin_cos(y[np.abs(y) <= 64])
    assert np.all(s_error <= 5.2 * 2.0**-53) and np.all(c_error <= 5.2 * 2.0**-53)
    s, _, s_error, _ = sin_cos(y[np.abs(y) <= 1])
    assert np.all(s_error <= 9.001 * 2.0**-53 * np.abs(s) + 2.0**-900)


@pytest.mark.parametrize("y", [np.nan, np.inf, -np.inf])
def test_elementary_functions_know_nothing_of_what_is_not_finite(y: float) -> None:
    functions = (tanh, sin_cos, exp, atan)
    assert all(np.isnan(v).all() for function in functions for v in function(np.array([y])))


def test_tanh_is_odd_in_every_bit() -> None:
    y = drawn(1000, 20.0, 4)
    (t, e), (minus_t, minus_e) = tanh(y), tanh(-y)
    assert np.array_equal(t, -minus_t) and np.array_equal(e, minus_e)  # `supremum` takes the lower line from -y


def test_tables_are_accurate_to_one_rounding() -> None:
    tanh, sech2 = (near.table(function, near._TANH_END) for function in (arb.tanh, near._sech2))
    others = [(function, near.table(function, near._ANGLE_END)) for function in (arb.sin, arb.cos)]
    with ctx.workprec(200):
        for k in range(0, 641, 8):
            t = (arb(k) / 32).tanh()
            assert certainly_within(t, tanh[k], 2.0**-53 * tanh[k] * (1 + 2.0**-19))
            assert certainly_within(1 - t * t, sech2[k], 2.0**-53 * sech2[k] * (1 + 2.0**-19))
        for k in range(0, 2049, 16):
            x = arb(k) / 32
            for value, table in ((function(x), table) for function, table in others):
                assert certainly_within(value, table[k], 2.0**-53 * abs(table[k]) * (1 + 2.0**-19))


# -------------------------------------------------------------------------------------------- sums, norms, conversions


@given(st.lists(MAGNITUDES, min_size=1, max_size=40))
def test_totals_and_norms_are_upper_bounds(numbers: list[float]) -> None:
    array = np.array(numbers)
    bound = float(total(array, 0))
    assert bound == np.inf or Fraction(bound) >= sum(map(Fraction, numbers))
    bound = float(norm(array, 0))
    assert bound == np.inf or Fraction(bound) ** 2 >= sum(Fraction(v) ** 2 for v in numbers)
    bound = float(norm(array[:, None], (0, 1)))
    assert bound == np.inf or Fraction(bound) ** 2 >= sum(Fraction(v) ** 2 for v in numbers)


@given(MAGNITUDES, st.integers(0, 1000))
def test_the_top_covers_its_roundings(bound: float, roundings: int) -> None:
    result = float(Above(np.float64(bound), roundings).top)
    assert result == np.inf or Fraction(result) >= Fraction(bound) * (1 + Fraction(2, 2**53)) ** roundings


@given(st.integers(-(10**40), 10**40), st.integers(1, 10**40), st.integers(-1400, 1400))
@example(1, 1, -1075)
@example(3, 1, -1076)
@example(1, 1, 1024)
@example(2**1024 - 2**970, 1, 0)
@example(2**1024 - 2**970 - 1, 1, 0)
def test_rational_to_binary64(numerator: int, denominator: int, exponent: int) -> None:
    q = Fraction(numerator, denominator) * Fraction(2) ** exponent
    value, error = float_with_error(q)
    assert error == np.inf or abs(Fraction(value) - q) <= Fraction(error)
    assert error != np.inf or abs(q) > Fraction(2) ** 1023


@given(st.integers(1, 10**12), st.integers(-(2**60) + 1, 2**60 - 1))
def test_atanh_of_a_rational(denominator: int, position: int) -> None:
    q = Fraction(position, 2**60) * Fraction(denominator, denominator + 1)
    value, error = atanh_with_error(q)
    with ctx.workprec(300):
        assert certainly_within(ball(q).atanh(), value, error)


def test_atanh_close_to_its_poles_is_finite_or_unknown() -> None:
    for bits in (30, 100, 127, 128, 129, 400, 3000):
        q = 1 - Fraction(1, 2**bits)
        value, error = atanh_with_error(q)
        with ctx.workprec(4000):
            assert not np.isfinite(error) or certainly_within(ball(q).atanh(), value, error)


def test_arb_with_error_holds_the_whole_ball() -> None:
    for x in (arb(1) / 3, arb("1 +/- 0.25"), arb(2) ** -1080, arb("1e400")):
        value, error = arb_with_error(x)
        assert error == np.inf or (abs(x - arb(value)) <= arb(error))


def test_self_test_passes_here_and_fails_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    self_test()
    monkeypatch.setattr(Above, "ulps", lambda bound, _: Above(0 * bound.v))  # no matrix product is exact
    with pytest.raises(ArithmeticError):
        self_test()


Matrix = list[list[Fraction]]


def flint_of(A: Matrix) -> fmpq_mat:
    return fmpq_mat([[fmpq(v.numerator, v.denominator) for v in row] for row in A])


def pivots(A: Matrix) -> list[Fraction]:
    """D of A = LDL', up to the first that is not positive; A is symmetric and definite if it has as many as rows.

    By elimination, in fractions: what the checker decides by determinants.
    """
    rows, found = [list(row) for row in A], []
    while rows:
        pivot, *rest = rows[0]
        if pivot <= 0:
            break
        found.append(pivot)
        rows = [[v - row[0] * w / pivot for v, w in zip(row[1:], rest, strict=True)] for row in rows[1:]]
    return found


def is_semidefinite(A: Matrix) -> bool:
    """Exact, by the pivots of A + t I for a t that changes no sign that matters here."""
    n, t = len(A), Fraction(1, 2**4000)
    return len(pivots([[A[i][j] + (t if i == j else 0) for j in range(n)] for i in range(n)])) == n


@pytest.mark.parametrize("shape", [(1, 1), (2, 2), (1, 5), (5, 1), (3, 4), (6, 3), (5, 5)])
@pytest.mark.parametrize("exponent", [-700, -520, -3, 0, 300, 500])
def test_spectral_norm_is_an_upper_bound(shape: tuple[int, int], exponent: int) -> None:
    generator = np.random.default_rng(abs(exponent) * 100 + shape[0] * 10 + shape[1])
    kinds = [generator.standard_normal(shape), np.ones(shape), np.eye(*shape), np.zeros(shape)]
    graded = generator.standard_normal(shape) * 2.0 ** generator.integers(-300, 1, shape)
    for W in (*kinds, graded):
        scaled = W * 2.0**exponent
        sigma = spectral_norm(scaled)
        R = [[Fraction(v) for v in row] for row in (scaled.T if shape[0] >= shape[1] else scaled).tolist()]
        gram = [[sum((x * y for x, y in zip(p, q, strict=True)), Fraction(0)) for q in R] for p in R]
        assert is_semidefinite([
            [(Fraction(sigma) ** 2 if i == j else Fraction(0)) - v for j, v in enumerate(row)]
            for i, row in enumerate(gram)
        ])  # fmt: skip
        if exponent > -300:
            assert sigma <= np.linalg.norm(scaled, 2) * min(shape) ** (1 / 128) * (1 + 1e-9) + 2.0**-470


def test_spectral_norm_of_what_overflows_is_infinite() -> None:
    assert spectral_norm(np.full((2, 2), 2.0**600)) == np.inf
    assert spectral_norm(np.full((2, 2), np.nan)) == np.inf


# ------------------------------------------------------------------------------------------------- rational arithmetic


@given(st.integers(1, 4), st.integers(0, 10**6))
def test_definiteness_is_decided_exactly(n: int, seed: int) -> None:
    generator = np.random.default_rng(seed)
    L = [[Fraction(int(v)) for v in row] for row in generator.integers(-3, 4, (n, n))]
    D = [Fraction(int(v)) for v in generator.integers(-1, 4, n)]
    A = [[sum((L[i][k] * D[k] * L[j][k] for k in range(n)), Fraction(0)) for j in range(n)] for i in range(n)]
    exact_minors = [determinant([row[:k] for row in A[:k]]) for k in range(1, n + 1)]
    diagonal, definite = inverse_diagonal(flint_of(A)), all(d > 0 for d in exact_minors)
    assert bool(diagonal) == is_definite(flint_of(A)) == (len(pivots(A)) == n) == definite
    if definite:
        for i, value in enumerate(diagonal):
            minor = [[A[r][c] for c in range(n) if c != i] for r in range(n) if r != i]
            assert value == (determinant(minor) if n > 1 else 1) / exact_minors[-1]
    if gershgorin_lower(flint_of(A)) > 0:
        assert definite


def determinant(A: list[list[Fraction]]) -> Fraction:
    n, result = len(A), Fraction(0)
    for order in itertools.permutations(range(n)):
        sign = (-1) ** sum(order[i] > order[j] for i in range(n) for j in range(i + 1, n))
        result += sign * math.prod((A[i][order[i]] for i in range(n)), start=Fraction(1))
    return result


@given(st.integers(1, 5), st.integers(0, 10**6), st.integers(0, 400))
def test_definiteness_is_decided_up_to_its_edge(n: int, seed: int, digits: int) -> None:
    """A matrix of rank n - 1, and what is added to its last entry: its sign alone decides."""
    generator = np.random.default_rng(seed)
    L = [[Fraction(int(v), 7) for v in row] for row in generator.integers(-9, 10, (n, n))]
    L = [[v if j < i else Fraction(int(i == j)) for j, v in enumerate(row)] for i, row in enumerate(L)]
    D = [*(Fraction(int(v)) for v in generator.integers(1, 5, n - 1)), Fraction(0)]
    A = [[sum((L[i][k] * D[k] * L[j][k] for k in range(n)), Fraction(0)) for j in range(n)] for i in range(n)]
    for added in (Fraction(0), Fraction(1, 2**digits), -Fraction(1, 2**digits)):
        near = [[v + (added if i == j == n - 1 else 0) for j, v in enumerate(row)] for i, row in enumerate(A)]
        assert is_definite(flint_of(near)) == (len(pivots(near)) == n) == (added > 0)
        skew = [[v + (j - i) * Fraction(3, 8) for j, v in enumerate(row)] for i, row in enumerate(near)]
        assert is_definite(flint_of(skew)) == (added > 0)  # the form d'A d knows the symmetric part alone
        assert n == 1 or inverse_diagonal(flint_of(skew)) == []


def test_an_unsymmetric_matrix_has_no_inverse_for_the_rules() -> None:
    A = fmpq_mat([[2, 1], [0, 2]])
    assert inverse_diagonal(A) == [] and is_definite(A) and not is_definite(fmpq_mat([[2, 5], [0, 2]]))


def test_a_matrix_of_long_numbers_is_not_decided() -> None:
    """Twice the symmetric part: two rows of numbers of 2^15 bits are the most."""
    for bits, decided in ((2**15 - 2, True), (2**15, False)):
        A = fmpq_mat([[fmpq(2**bits), 1], [1, 1]])
        assert is_definite(A) is decided and bool(inverse_diagonal(A)) is decided


@given(st.integers(0, 10**6))
def test_a_ball_contains_an_ellipsoid_where_no_point_of_it_is_outside(seed: int) -> None:
    """x'Px <= c at x = J d with ||d|| > 1 refutes it; J'PJ - c I has a kernel where the two touch."""
    generator = np.random.default_rng(seed)
    n = int(generator.integers(1, 4))
    J = [[Fraction(int(v), 4) for v in row] for row in generator.integers(-8, 9, (n, n))]
    B = generator.integers(-4, 5, (n, n))
    P = [[Fraction(int(v)) for v in row] for row in B @ B.T]
    level = Fraction(int(generator.integers(1, 60)), 16)
    image = [[sum((J[k][i] * P[k][m] * J[m][j] for k in range(n) for m in range(n)), Fraction(0)) for j in range(n)]
             for i in range(n)]  # fmt: skip
    left = [[v - (level if i == j else 0) for j, v in enumerate(row)] for i, row in enumerate(image)]
    answer = contains_ball(flint_of(J), flint_of(P), level)
    assert answer == (len(pivots(left)) == n)
    for d in generator.standard_normal((50, n)) * generator.uniform(1, 1.5, (50, 1)):
        length, at = sum(Fraction(v) ** 2 for v in d.tolist()), [Fraction(v) for v in d.tolist()]
        value = sum((p * image[i][j] * q for i, p in enumerate(at) for j, q in enumerate(at)), Fraction(0))
        assert not (answer and length >= 1 and value <= level)


@pytest.mark.parametrize(
    ("radius", "inside"), [(1.0, False), (np.nextafter(1.0, 2.0), True), (-1.5, True), (0.0, False)]
)
def test_a_ball_that_touches_does_not_contain(radius: float, inside: bool) -> None:
    J, P = fmpq_mat([[fmpq(*float(radius).as_integer_ratio()), 0], [0, 3]]), fmpq_mat([[1, 0], [0, 1]])
    assert contains_ball(J, P, Fraction(1)) is inside


@given(st.fractions(0, 10**9), st.integers(-3000, 3000))
@example(Fraction(0), 0)
@example(Fraction(1), 0)
@example(Fraction(4), -2148)
@example(Fraction(2**300 - 1), 0)
@example(Fraction(1, 2**300 - 1), 0)
def test_roots_from_above(q: Fraction, exponent: int) -> None:
    scaled = q * Fraction(2) ** exponent
    root = root_above(fmpq(scaled.numerator, scaled.denominator))
    bound = Fraction(int(root.p), int(root.q))
    assert scaled <= bound**2 <= scaled * (1 + Fraction(1, 2**60)) ** 2 and bound >= 0


# ------------------------------------------------------------------------------------------------------- Taylor models


def models(generator: np.random.Generator, N: int, batch: int, low: int, high: int) -> Taylor:
    """Random models: every coefficient with an exponent of its own below that of c, some exactly 0."""

    def numbers(*shape: int, least: int, most: int) -> np.ndarray:
        exponents = generator.integers(least, most + 1, shape).astype(float)
        values = generator.choice([-1.0, 1.0], shape) * generator.uniform(1, 2, shape) * 2.0**exponents
        return np.where(generator.random(shape) < 0.1, 0.0, values)

    unit = 2.0 ** generator.integers(low, high + 1, batch).astype(float)
    return Taylor(
        numbers(batch, least=-2, most=2) * unit,
        numbers(N, batch, least=-30, most=0) * unit,
        numbers(N, N, batch, least=-40, most=-2) * unit,
        np.abs(numbers(batch, least=-60, most=-3)) * unit,
    )


def polynomial(model: Taylor, b: int, d: list[float]) -> arb:
    """c + g.d + d'Q d."""
    value = arb(float(model.c[b]))
    for i, x in enumerate(d):
        value += arb(float(model.g[i, b])) * arb(x)
        for j, y in enumerate(d):
            value += arb(float(model.Q[i, j, b])) * arb(x) * arb(y)
    return value


def points_in_the_box(generator: np.random.Generator, N: int) -> list[list[float]]:
    corners = generator.choice([-1.0, 1.0], (3, N))
    return [[0.0] * N, *corners.tolist(), *generator.uniform(-1, 1, (4, N)).tolist()]


def assert_contains(
    result: Taylor, operands: list[Taylor], function: Callable[..., arb], generator: np.random.Generator
) -> int:
    """Every member of the operands' models goes into the result; returns how many bounds were finite."""
    finite, N = 0, result.g.shape[0]
    with ctx.workprec(400):
        for b in range(len(result.c)):
            if not np.isfinite(result.r[b]):
                continue
            finite += 1
            for d in points_in_the_box(generator, N):
                members = [
                    polynomial(m, b, d) + arb(float(m.r[b])) * arb(float(generator.choice([-1.0, 1.0, 0.3])))
                    for m in operands
                ]
                value = function(*members)
                assert abs(value - polynomial(result, b, d)) <= arb(float(result.r[b])), (b, d)
    return finite


RANGES = [(-4, 4), (-300, 300), (-520, -480), (-1000, -900), (480, 520)]


@pytest.mark.parametrize(("low", "high"), RANGES)
@pytest.mark.parametrize("seed", slow_after(1, range(2)))
def test_taylor_ring_operations_contain(low: int, high: int, seed: int) -> None:
    generator = np.random.default_rng(1000 * low + high + seed + 10**7)
    N = 2 + seed
    a, b = models(generator, N, 30, low, high), models(generator, N, 30, low, high)
    assert assert_contains(a + b, [a, b], lambda x, y: x + y, generator) == 30
    assert assert_contains(-a, [a], lambda x: -x, generator) == 30
    assert_contains(a * b, [a, b], lambda x, y: x * y, generator)
    assert_contains(a * a, [a, a], lambda x, y: x * y, generator)
    factor = float(generator.standard_normal())
    assert_contains(a.scaled(factor), [a], lambda x: x * arb(factor), generator)
    mixed = models(generator, N, 30, -high, -low)
    assert assert_contains(a * mixed, [a, mixed], lambda x, y: x * y, generator) > 20


@pytest.mark.parametrize(("low", "high"), [(-4, 4), (-300, 300), (-360, -330), (330, 360), (-700, -500), (500, 700)])
def test_taylor_quotients_contain(low: int, high: int) -> None:
    generator = np.random.default_rng(low + 2000)
    a = models(generator, 2, 60, low, high)
    shrink = 2.0 ** generator.integers(-40, 0, 60).astype(float)
    a = Taylor(a.c, a.g * shrink, a.Q * shrink, a.r * shrink)
    result = a.function("inv")
    finite = assert_contains(result, [a], lambda x: 1 / x, generator)
    assert finite > 20 or abs(low) > 4


@pytest.mark.parametrize("spread", [-40, -6, 0, 3])
def test_taylor_sine_and_cosine_contain(spread: int) -> None:
    generator = np.random.default_rng(spread + 3000)
    a = models(generator, 2, 60, spread, spread)
    a = Taylor(generator.uniform(-80, 80, 60), a.g, a.Q, a.r)
    assert assert_contains(a.function("sin"), [a], lambda x: x.sin(), generator) == 60
    assert assert_contains(a.function("cos"), [a], lambda x: x.cos(), generator) == 60


@pytest.mark.parametrize(("low", "high"), RANGES)
@pytest.mark.parametrize("count", slow_after(1, [3, 1]))
def test_an_inner_product_is_nowhere_below(low: int, high: int, count: int) -> None:
    """Of all members; with a second summand that cancels the first but for rounding, of what is of third order too."""
    generator = np.random.default_rng([count, low + 2000])
    x, y = ([models(generator, 3, 30, low, high) for _ in range(count)] for _ in range(2))
    for cancelled in (False, True):
        more = [Taylor(-v.c, -v.g * (1 + 2.0**-50), -v.Q, v.r) for v in x] if cancelled else []
        firsts, seconds = [*x, *more], [*y, *(y if cancelled else [])]
        bound, finite = inner_product(firsts, seconds), 0
        with ctx.workprec(400):
            for b in np.flatnonzero(np.isfinite(bound.r)):
                finite += 1
                for d in points_in_the_box(generator, 3):
                    value = arb(0)
                    for v, w in zip(firsts, seconds, strict=True):
                        ends = (arb(float(m.r[b])) * arb(float(generator.choice([-1.0, 1.0]))) for m in (v, w))
                        value += (polynomial(v, b, d) + next(ends)) * (polynomial(w, b, d) + next(ends))
                    assert value <= polynomial(bound, b, d) + arb(float(bound.r[b])), (b, d)
        assert finite > 0 or high > 500


def test_an_inner_product_knows_what_cancels() -> None:
    """x y^2 - x y^2, of which term by term nothing is known, and x y^2 alone, at most (x^2 + 2 y^2) / 3."""
    x, y, none = np.array([[1.0], [0.0]]), np.array([[0.0], [1.0]]), np.zeros(1)
    first = Taylor(none, x, np.zeros((2, 2, 1)), none)
    second = Taylor(none, 0 * x, np.einsum("ib,jb->ijb", y, y), none)
    assert upper_bound(inner_product([first, first], [second, Taylor(none, 0 * x, -second.Q, none)])) < 1e-14
    alone = inner_product([first], [second])
    assert abs(alone.Q[0, 0, 0] - 1 / 3) < 1e-14 and abs(alone.Q[1, 1, 0] - 2 / 3) < 1e-14 and alone.r[0] < 1e-14
    assert 3 * Fraction(float(alone.Q[0, 0, 0])) >= 1 and 3 * Fraction(float(alone.Q[1, 1, 0])) >= 2


def alone(g: float, Q: float, c: float = 0.0) -> Taylor:
    """c + g d + Q d^2."""
    return Taylor(np.array([c]), np.array([[g]]), np.array([[[Q]]]), np.zeros(1))


def most_at_1(found: Taylor) -> Fraction:
    """The largest value at d = 1."""
    return sum((Fraction(float(part.ravel()[0])) for part in (found.c, found.g, found.Q, found.r)), Fraction(0))


@pytest.mark.parametrize("count", [1, 40, 400])
def test_an_inner_product_covers_its_roundings_in_third_order(count: int) -> None:
    """Products that round to numbers which cancel; and many numbers, each of which is lost beside the first."""
    x, y = [alone(1 + 2.0**-30, 0), alone(1, 0)], [alone(0, 1 + 2.0**-30), alone(0, -1 - 2.0**-29)]
    assert most_at_1(inner_product(x, y)) >= Fraction(1, 2**60)
    assert most_at_1(inner_product(y, x)) >= Fraction(1, 2**60)
    lost = [alone(1, 0), *[alone(2.0**-54, 0)] * count, alone(1, 0)], [alone(0, 1)] * (count + 1) + [alone(0, -1)]
    assert most_at_1(inner_product(*lost)) >= count * Fraction(1, 2**54)


def test_an_inner_product_rounds_its_squares_up() -> None:
    """A constant times a square, which is exact, and a sum of such products; a third is no binary64 number."""
    for k in np.random.default_rng(5).uniform(1, 2, 50).tolist():
        assert most_at_1(inner_product([alone(0, 0, 1)], [alone(0, k)])) >= Fraction(k)
        assert (
            most_at_1(inner_product([alone(0, 0, 1), alone(k, 0)], [alone(0, k), alone(0, k)])) >= k + Fraction(k) ** 2
        )


def test_an_inner_product_in_many_symbols_fills_no_memory() -> None:
    """As many as two states, and all inputs and uncertain quantities that a file may have, on one leaf."""
    N = 2 + 2 * MAX_STATES
    numbers = np.random.default_rng(0).standard_normal((N, N, 1))
    model = Taylor(np.ones(1), numbers[0], numbers, np.ones(1))
    tracemalloc.start()
    inner_product([model] * 2, [model] * 2)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 2**28


@pytest.mark.parametrize("spread", [-40, -6, -2, 0, 3])
@pytest.mark.parametrize("name", ["tanh", "exp", "atan", "sqrt"])
def test_other_taylor_functions_contain(name: str, spread: int) -> None:
    generator = np.random.default_rng(spread + 3500)
    a = models(generator, 2, 60, spread, spread)
    centre = generator.uniform(0.01, 20, 60) if name == "sqrt" else generator.uniform(-70, 30, 60)
    a = Taylor(centre, a.g, a.Q, a.r)
    finite = assert_contains(a.function(name), [a], lambda x: getattr(x, name)(), generator)
    assert finite == 60 or (name == "sqrt" and (finite > 40 or spread >= 0)) or (name == "exp" and spread == 3)


def test_a_root_of_what_may_not_be_positive_gives_nothing() -> None:
    c = np.array([1.0, 1.0, 0.0, -1.0, 5e-324, 1.0])
    g = np.array([[1.0, 0.5, 0.0, 0.25, 0.0, -1.0]])
    r = np.array([0.0, 0.5, 0.0, 0.5, 5e-324, 2.0**-1000])
    result = Taylor(c, g, np.zeros((1, 1, 6)), r).function("sqrt")
    assert np.isnan(result.r).all()
    assert np.isnan((result * affine(np.zeros(6), np.zeros((1, 6)))).r).all()  # 0 times it is still unknown
    assert not np.any(upper_bound(result) < 0)


def test_exp_of_what_may_be_too_large_gives_nothing() -> None:
    c = np.array([64.5, 60.0, 1e300, 0.0])
    g = np.array([[0.0, 4.5, 0.0, 1e300]])
    result = Taylor(c, g, np.zeros((1, 1, 4)), np.zeros(4)).function("exp")
    assert np.isnan(result.r).all() and not np.any(upper_bound(result) < 0)


@given(st.integers(-(10**30), 10**30), st.integers(1, 10**30))
def test_taylor_constants_contain(numerator: int, denominator: int) -> None:
    q = Fraction(numerator, denominator)
    model = constant_model(q, 2, 3)
    assert np.all(model.g == 0) and np.all(model.Q == 0)
    assert all(abs(Fraction(c) - q) <= Fraction(r) for c, r in zip(model.c.tolist(), model.r.tolist(), strict=True))


def test_a_divisor_that_may_vanish_gives_nothing() -> None:
    c = np.array([1.0, 1.0, 0.0, -1.0])
    g = np.array([[1.0, 0.5, 0.0, 0.25]])
    r = np.array([0.0, 0.5, 0.0, 0.75])
    result = Taylor(c, g, np.zeros((1, 1, 4)), r).function("inv")
    assert np.isnan(result.r).all()
    assert np.isnan((result * affine(np.zeros(4), np.zeros((1, 4)))).r).all()  # 0 times it is still unknown
    assert not np.any(upper_bound(result) < 0)


@pytest.mark.parametrize("operation", ["mul", "inv", "sin", "cos", "tanh", "exp", "atan", "sqrt"])
def test_taylor_remainders_are_of_third_order(operation: str) -> None:
    generator = np.random.default_rng(7)
    c, g, Q = generator.uniform(0.5, 1, 8), generator.uniform(-1, 1, (2, 8)), generator.uniform(-1, 1, (2, 2, 8))
    remainders = []
    for h in (2.0**-6, 2.0**-7, 2.0**-8):
        a = Taylor(c, g * h, Q * h * h, np.zeros(8))
        result = a * a if operation == "mul" else a.function(operation)
        remainders.append(result.r)
    orders = np.log2(np.array(remainders[:-1]) / np.array(remainders[1:]))
    assert np.all(orders > 2.9), orders


def maximum(c: Fraction, g: Fraction, q: Fraction) -> Fraction:
    """Exact maximum of c + g t + q t^2 over |t| <= 1."""
    g = abs(g)
    return c + (g * g / (-4 * q) if q < 0 and g < -2 * q else g + q)


@given(FLOATS, FLOATS, FLOATS, MAGNITUDES)
@example(-(2.0**-545), 2.0**-540, -(2.0**-540), 0.0)  # g * g underflows
@example(-(2.0**1000), 2.0**1018, -1.5 * 2.0**1022, 0.0)  # 4 q overflows
@example(-(2.0**1010), 2.0**1023, -(2.0**1023), 0.0)
@example(-1.0, 2.0**600, -(2.0**1000), 0.0)  # g * g overflows
@example(-5e-324, 5e-324, -5e-324, 0.0)
@example(-0.249999, 1.0, -1.0, 0.0)
@example(-1.0, 2.0, -1.0, 0.0)
def test_upper_bound_on_one_axis_against_exact_arithmetic(c: float, g: float, q: float, r: float) -> None:
    model = Taylor(np.array([c]), np.array([[g]]), np.array([[[q]]]), np.array([r]))
    bound = float(upper_bound(model)[0])
    assert not bound < np.inf or Fraction(bound) >= maximum(*map(Fraction, (c, g, q))) + Fraction(r)


@given(st.sampled_from([np.inf, -np.inf, np.nan]), st.sampled_from(["c", "g", "Q", "r", "cross"]), st.booleans())
def test_upper_bound_of_what_is_not_finite_is_never_negative(value: float, where: str, other: bool) -> None:
    parts = {
        "c": np.array([-1.0]), "g": np.array([[1.0], [1.0]]), "Q": -np.ones((2, 2, 1)) * np.eye(2)[:, :, None],
        "r": np.array([0.0]),
    }  # fmt: skip
    if where == "cross":
        parts["Q"][0, 1] = value
    else:
        parts[where][(int(other),) * (parts[where].ndim - 1) or 0] = value
    if where == "r" and value == -np.inf:
        return  # a remainder is never negative
    assert not upper_bound(Taylor(**parts))[0] < 0


@pytest.mark.parametrize("exponent", slow_after(1, [0, -900, -540, 400, 1000]))
def test_upper_bound_on_many_axes_holds_all_samples(exponent: int) -> None:
    generator = np.random.default_rng(exponent + 5000)
    model = models(generator, 3, 40, exponent, exponent)
    bound = upper_bound(model)
    for b in range(40):
        best = max(point_value(model, b, d) for d in stationary_points(generator, model, b))
        assert not bound[b] < np.inf or Fraction(float(bound[b])) >= best + Fraction(float(model.r[b]))


def point_value(model: Taylor, b: int, d: list[float]) -> Fraction:
    x = [Fraction(v) for v in d]
    value = Fraction(float(model.c[b]))
    for i in range(3):
        value += Fraction(float(model.g[i, b])) * x[i]
        value += sum(Fraction(float(model.Q[i, j, b])) * x[i] * x[j] for j in range(3))
    return value


def stationary_points(generator: np.random.Generator, model: Taylor, b: int) -> list[list[float]]:
    candidates = []
    for i in range(3):
        g, q = float(model.g[i, b]), float(model.Q[i, i, b])
        t = -g / (2 * q) if q else 0.0
        candidates.append([-1.0, 1.0, 0.0, min(1.0, max(-1.0, t))])
    return [*map(list, itertools.product(*candidates)), *generator.uniform(-1, 1, (20, 3)).tolist()]


@pytest.mark.parametrize("kind", ["steep", "level", "flat"])
@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_no_bound_is_below_the_exact_maximum(n: int, kind: str) -> None:
    """Inside, on faces and at corners; each of the two alone, and the one that counts is the lesser."""
    generator, exact = np.random.default_rng([n, len(kind)]), 0
    each = [drawn_model(generator, n, kind) for _ in range(60)]
    g, Q = (np.moveaxis(np.array(part, dtype=np.float64), 0, -1) for part in zip(*each, strict=True))
    model = Taylor(np.zeros(60), g, Q, np.zeros(60))
    squares, corner = both_bounds(model)
    for b, most in enumerate(largest(*one) for one in each):
        assert most <= min(Fraction(float(squares[b])), Fraction(float(corner[b])))
        exact += Fraction(float(corner[b])) <= most + Fraction(1, 2**40)
    assert kind != "steep" or exact > 10
    assert np.all((upper_bound(model) == np.fmin(squares, corner)) | (squares < 0))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_upper_bound_of_a_sum_that_rounds_to_0(sign: float) -> None:
    """Of what is x + y less x + y rounded at (1, 1, 1) and (1, -1, -1), with coefficients that cancel."""
    for y in (2.0**-60, 2.0**-54, 2.0**-400, 5e-324):
        Q = np.diag([-(1 + y), -1, -y])
        Q[0, 1:] = Q[1:, 0] = sign, sign * y
        model = Taylor(np.zeros(1), np.zeros((3, 1)), Q[:, :, None], np.zeros(1))
        assert all(bound[0] >= y for bound in (*both_bounds(model), upper_bound(model)))


def test_upper_bound_of_a_separable_model_is_its_maximum() -> None:
    generator = np.random.default_rng(11)
    g, q = generator.standard_normal((3, 200)), generator.standard_normal((3, 200))
    Q = q[:, None] * np.eye(3)[:, :, None]
    bound = upper_bound(Taylor(np.zeros(200), g, Q, np.zeros(200)))
    for b in range(200):
        exact = sum(maximum(Fraction(0), Fraction(float(g[i, b])), Fraction(float(q[i, b]))) for i in range(3))
        assert exact <= Fraction(float(bound[b])) <= exact + Fraction(1, 2**40)


# ---------------------------------------------------------------------------------------------------------------- jets


class Member:
    """A function that a jet holds: `c0 + a0.d + d'Q d + w d'E d`, every deviation drawn within the jet's bounds."""

    def __init__(self, jet: Jet, generator: np.random.Generator) -> None:
        s, t, self.w = (float(v) for v in generator.choice([-1.0, 1.0, 0.5, 0.0], 3))
        self.jet = jet
        self.c = arb(float(jet.c)) + arb(s) * arb(float(jet.error))
        self.a = [arb(float(v)) for v in jet.a]
        self.a[int(generator.integers(len(jet.a)))] += arb(t) * arb(float(jet.slack))

    def __call__(self, d: list[float]) -> arb:
        linear = sum((p * arb(x) for p, x in zip(self.a, d, strict=True)), self.c)
        return linear + curved(self.jet, d) + arb(self.w) * quadratic(self.jet.E, d)


def points_in_the_ball(generator: np.random.Generator, n: int) -> list[list[float]]:
    d = generator.standard_normal((6, n))
    d /= np.linalg.norm(d, axis=1, keepdims=True) * (1 + 2.0**-40)
    return (d * np.array([1, 0.999, 0.5, 1e-3, 1e-30, 1e-200])[:, None]).tolist()


def assert_jet(
    result: Jet, value: Callable[[list[float]], arb], gradient: list[arb], points: list[list[float]]
) -> bool:
    """v(0), the gradient, and the remainder at every point; False if the jet says nothing."""
    n = len(gradient)
    if not np.isfinite([result.error, result.slack, *np.ravel(result.Q), *result.K, *np.ravel(result.E)]).all():
        return False
    at_0 = value([0.0] * n)
    assert abs(at_0 - arb(float(result.c))) <= arb(float(result.error))
    distance = sum(((p - arb(float(q))) ** 2 for p, q in zip(gradient, result.a, strict=True)), arb(0))
    assert distance <= arb(float(result.slack)) ** 2
    for d in points:
        linear = sum((p * arb(x) for p, x in zip(gradient, d, strict=True)), at_0)
        assert abs(value(d) - linear - curved(result, d)) <= quadratic(result.E, d), d
    return True


def jets(generator: np.random.Generator, n: int, exponent: int) -> Jet:
    scale = 2.0**exponent

    def number(most: int) -> float:
        return float(abs(generator.standard_normal()) * 2.0 ** generator.integers(-40, most) * scale)

    sign = float(generator.choice([-1.0, 1.0]))
    some = generator.random(5) < 0.8
    half, root = generator.standard_normal((2, n, n))
    E = root @ root.T * number(0) * some[3]
    thirds = generator.standard_normal(n * (n + 1) * (n + 2) // 6) * number(0) * some[4]
    return plain(
        np.float64(sign * number(2)), number(-4) * some[0], generator.standard_normal(n) * number(1),
        number(-4) * some[1], (half + half.T) * number(0) * some[2], (E + E.T) / 2 + 2.0**-39 * np.trace(E) * np.eye(n),
        thirds,
    )  # fmt: skip


@pytest.mark.parametrize("exponent", [-600, -520, -300, 0, 300, 500])
def test_jets_contain(exponent: int) -> None:
    generator, finite = np.random.default_rng(exponent + 9000), 0
    n = 3
    with ctx.workprec(3000):
        for _ in range(25):
            x, y = jets(generator, n, exponent), jets(generator, n, exponent)
            v, w = Member(x, generator), Member(y, generator)
            points = points_in_the_ball(generator, n)
            sums = [p + q for p, q in zip(v.a, w.a, strict=True)]
            products = [v.c * q + w.c * p for p, q in zip(v.a, w.a, strict=True)]
            inverses = [-p / (v.c * v.c) for p in v.a]
            assert assert_jet(x + y, lambda d, v=v, w=w: v(d) + w(d), sums, points)
            assert assert_jet(-x, lambda d, v=v: -v(d), [-p for p in v.a], points)
            finite += assert_jet(x * y, lambda d, v=v, w=w: v(d) * w(d), products, points)
            finite += assert_jet(x.function("inv"), lambda d, v=v: 1 / v(d), inverses, points)
    assert finite > 10 or abs(exponent) > 300


@pytest.mark.parametrize("spread", [-30, -3, 0, 4])
def test_jets_of_sine_and_cosine_contain(spread: int) -> None:
    generator = np.random.default_rng(spread + 9500)
    with ctx.workprec(1600):
        for _ in range(40):
            x = jets(generator, 2, spread)
            centre = np.float64(generator.choice([0.0, 1.0, 70.0]) * generator.standard_normal())
            x = changed(x, c=centre)
            v, points = Member(x, generator), points_in_the_ball(generator, 2)
            assert assert_jet(x.function("sin"), lambda d, v=v: v(d).sin(), [v.c.cos() * p for p in v.a], points)
            assert assert_jet(x.function("cos"), lambda d, v=v: v(d).cos(), [-v.c.sin() * p for p in v.a], points)


@pytest.mark.parametrize("spread", slow_after(2, [-30, -8, -3, 0]))
def test_jets_of_other_functions_contain(spread: int) -> None:
    generator, roots = np.random.default_rng(spread + 9700), 0
    with ctx.workprec(1600):
        for _ in range(40):
            x = jets(generator, 2, spread)
            centre = np.float64(generator.choice([0.0, 1.0, 20.0]) * generator.standard_normal())
            x = changed(x, c=centre)
            v, points = Member(x, generator), points_in_the_ball(generator, 2)
            slopes = {"exp": v.c.exp(), "atan": 1 / (1 + v.c * v.c), "tanh": 1 - v.c.tanh() ** 2}
            for name, slope in slopes.items():
                gradient = [slope * p for p in v.a]
                found = assert_jet(x.function(name), lambda d, v=v, f=name: getattr(v(d), f)(), gradient, points)
                assert found or (name == "exp" and centre + x.radius > 60)
            positive = [p / (2 * v.c.sqrt()) for p in v.a]
            roots += assert_jet(x.function("sqrt"), lambda d, v=v: v(d).sqrt(), positive, points)
    assert roots > 5 or spread == 0


def test_a_jet_of_a_root_that_may_not_be_defined_gives_nothing() -> None:
    nothing = np.zeros((1, 1))
    for c, error, slope in ((1.0, 0.0, 1.0), (0.0, 0.0, 0.0), (1.0, 1.0, 0.0), (-4.0, 0.0, 0.5), (1.0, 0.5, 0.5)):
        x = plain(np.float64(c), error, np.full(1, slope), 0.0, nothing, nothing)
        with np.errstate(all="ignore"):
            assert np.isnan(x.function("sqrt").E) and np.isnan(x.function("sqrt").slack)


def test_a_jet_of_a_divisor_that_may_vanish_gives_nothing() -> None:
    nothing = np.zeros((1, 1))
    for c, error, slope in ((1.0, 0.0, 1.0), (0.0, 0.0, 0.0), (1.0, 1.0, 0.0)):
        x = plain(np.float64(c), error, np.full(1, slope), 0.0, nothing, nothing)
        assert np.isnan(x.function("inv").E) and np.isnan(x.function("inv").slack)
    whole = plain(np.float64("inf"), float("inf"), np.zeros(1), 0.0, nothing, nothing)
    assert not np.isfinite((whole * plain(np.float64(0), 0.0, np.zeros(1), 0.0, nothing, nothing)).error)


@pytest.mark.parametrize(("c", "slope"), [(1e170, 1e100), (-1e160, 1e90), (1e170, 1e80)])
def test_an_inverse_whose_derivative_underflows_contains(c: float, slope: float) -> None:
    """1/c^2 is 0 in binary64, and its error is multiplied by a large gradient."""
    nothing = np.zeros((1, 1))
    jet = plain(np.float64(c), 0.0, np.full(1, slope), 0.0, nothing, nothing)
    with ctx.workprec(3000):
        value = Member(jet, np.random.default_rng(0))
        assert assert_jet(jet.function("inv"), lambda d: 1 / value(d), [-arb(slope) / arb(c) ** 2], [[0.9], [-1e-30]])


@given(st.integers(-(10**30), 10**30), st.integers(1, 10**30))
def test_jets_of_constants_contain(numerator: int, denominator: int) -> None:
    q = Fraction(numerator, denominator)
    jet = constant_jet(q, np.zeros((1, 2, 2)), 2)
    assert abs(Fraction(jet.c) - q) <= Fraction(jet.error) and not (jet.a.any() or jet.Q.any() or jet.E.any())


# --------------------------------------------------------------------------------------------- the policy's enclosures

CENTRES = [0.0, -0.0, 1e-200, 1e-9, 3e-4, 0.1, -0.7, 1.5, -4.0, 9.0, 18.0, 25.0, -700.0, 1e9]
RADII = [0.0, 1e-300, 1e-20, 1e-9, 9e-5, 1.1e-4, 1e-2, 0.3, 1.0, 4.0, 30.0, 1e4, 1e15, 1e300]


def test_parallel_lines_enclose_tanh() -> None:
    pairs = np.array(list(itertools.product(CENTRES, RADII)))
    generator = np.random.default_rng(21)
    extra = np.stack([3 * generator.standard_normal(400), np.abs(generator.standard_normal(400))], 1)
    centre, radius = np.concatenate([pairs, extra]).T
    slope, shift, gap = relax_tanh(centre, radius)
    assert np.isfinite(gap).all() and np.all((slope >= 0) & (slope <= 1))
    with ctx.workprec(1300):
        for c, r, s, m, g in zip(*(a.tolist() for a in (centre, radius, slope, shift, gap)), strict=True):
            critical = math.atanh(math.sqrt(min(1 - 2.0**-53, max(0.0, 1 - s))))
            inside = [(p - c) / r for p in (critical, -critical) if r > 0 and abs(p - c) <= r * (1 - 1e-12)]
            for t in (*np.linspace(-1, 1, 21).tolist(), *inside):
                y = arb(c) + arb(r) * arb(t)
                assert certainly_within(y.tanh() - arb(s) * y, m, g), (c, r, t)


def best_gap(c: float, r: float, s: float) -> arb:
    """Half of what tanh(y) - s y spans over |y - c| <= r: of its ends and its critical points in there."""
    ends = arb(c) - arb(r), arb(c) + arb(r)
    critical = (1 - arb(s)).sqrt().atanh() if 0 < s < 1 else arb(0)
    inside = [p for p in (critical, -critical) if ends[0] < p < ends[1]]
    values = [y.tanh() - arb(s) * y for y in (*ends, *inside)]
    greatest = least = values[0]
    for value in values[1:]:
        greatest, least = greatest.max(value), least.min(value)
    return (greatest - least) / 2


def extremes() -> tuple[np.ndarray, np.ndarray]:
    """Centres with radii: around 0 and off it by shares of the radius, saturated, subnormal, near overflow."""
    radii = [5e-324, 1e-310, 1e-160, 1e-30, 1e-12, 1e-8, 1e-4, 0.03, 0.25, 1.0, 3.0, 19.0, 40.0, 1e6, 1e150, 1e307]
    shares = [0.0, 1e-300, 1e-16, 1e-3, 0.2, 1 / 3, 0.5, 0.577, 0.58, 0.9, 1 - 1e-9, 1.0, 1 + 1e-9, 1.1, 2.0, 7.0]
    pairs = [(sign * r * share, r) for r in radii for share in shares for sign in (1, -1)]
    pairs += [
        (sign * c, r) for c in (1e-320, 1e-5, 0.5, 2.0, 18.9, 25.0, 1e8, 1e307) for r in radii for sign in (1, -1)
    ]
    centre, radius = np.array(pairs).T
    return centre, radius


def test_parallel_lines_enclose_tanh_at_extremes_on_every_side() -> None:
    """At the ends, at the critical points and between them: exactly the places where a line would be crossed first."""
    centre, radius = extremes()
    with np.errstate(all="ignore"):
        slope, shift, gap = relax_tanh(centre, radius)
    assert np.all((slope >= 0) & (slope <= 1) & (gap >= 0))
    with ctx.workprec(2400):
        for c, r, s, m, g in zip(*(a.tolist() for a in (centre, radius, slope, shift, gap)), strict=True):
            lo, hi = arb(c) - arb(r), arb(c) + arb(r)
            critical = (1 - arb(s)).sqrt().atanh() if 0 < s < 1 else arb(0)
            places = [lo, hi, *(lo + (hi - lo) * k / 16 for k in range(1, 16)), arb(0), critical, -critical]
            for y in (*places, *(p * (1 + sign * arb(2) ** -20) for p in places for sign in (1, -1))):
                if lo <= y <= hi:
                    assert certainly_within(y.tanh() - arb(s) * y, m, g), (c, r, y)


@pytest.mark.parametrize("wrong", [0.0, 0.5, 1.1, 50.0, np.inf])
def test_parallel_lines_do_not_depend_on_where_a_library_puts_the_critical_point(
    wrong: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    honestly, generator = np.arctanh, np.random.default_rng(8)
    monkeypatch.setattr(np, "arctanh", lambda x: wrong * honestly(x) if wrong < np.inf else np.full_like(x, wrong))
    centre, radius = 2 * generator.standard_normal(300), np.abs(generator.standard_normal(300))
    slope, shift, gap = relax_tanh(centre, radius)
    with ctx.workprec(200):
        for c, r, s, m, g in zip(*(a.tolist() for a in (centre, radius, slope, shift, gap)), strict=True):
            for t in np.linspace(-1, 1, 33).tolist():
                y = arb(c) + arb(r) * arb(t)
                assert certainly_within(y.tanh() - arb(s) * y, m, g), (c, r, t)


def test_parallel_lines_are_as_close_as_their_slope_allows() -> None:
    """Whichever of the critical points the interval holds: one, both, or one beyond an end."""
    centre, radius = extremes()
    generator = np.random.default_rng(5)
    radii = 10.0 ** generator.uniform(-3, 0.7, 1500)
    fine = (radius > 1e-4) & (radius < 20) & (np.abs(centre) < 20)
    centre = np.concatenate([centre[fine], radii * generator.uniform(-3, 3, 1500)])
    radius = np.concatenate([radius[fine], radii])
    slope, _, gap = relax_tanh(centre, radius)
    with ctx.workprec(300):
        for c, r, s, g in zip(*(a.tolist() for a in (centre, radius, slope, gap)), strict=True):
            assert arb(g) <= best_gap(c, r, s) * (1 + arb(2) ** -30) + 2.0**-46 * (1 + r), (c, r)


@pytest.mark.parametrize("first", [2.0**-3, 2.0**-14])
@pytest.mark.parametrize("centre", [0.3, -0.7, 2.0])
def test_the_gap_is_of_second_order(first: float, centre: float) -> None:
    radius = first / 2.0 ** np.arange(4)
    _, _, gap = relax_tanh(np.full(4, centre), radius)
    orders = np.log2(gap[:-1] / gap[1:])
    assert np.all(orders > 1.9), orders


def test_parallel_lines_are_never_looser_than_an_interval() -> None:
    centre, radius = np.array(list(itertools.product(CENTRES, [r for r in RADII if r < 1e5]))).T
    _, _, gap = relax_tanh(centre, radius)
    interval = (np.tanh(centre + radius) - np.tanh(centre - radius)) / 2
    assert np.all(gap <= interval * (1 + 1e-9) + 2.0**-45 * (1 + radius))


def test_parallel_lines_of_what_is_not_finite_are_unknown() -> None:
    for centre, radius in ((np.nan, 1.0), (1.0, np.nan), (np.inf, 1.0), (0.0, np.inf)):
        assert np.isnan(relax_tanh(np.array([centre]), np.array([radius]))[2]).all()


def random_policy(
    generator: np.random.Generator, widths: list[int], size: float, squash: str, centre: str
) -> tuple[Policy, tuple[Fraction, ...]]:
    weights = tuple(size * generator.standard_normal((out, into)) for into, out in itertools.pairwise(widths))
    biases = tuple(0.3 * generator.standard_normal(out) for out in widths[1:])
    m = widths[-1]
    scale, offset = generator.choice([-1.0, 1.0], m) * generator.uniform(0.5, 3, m), 0.2 * generator.standard_normal(m)
    offset = np.clip(offset, -0.29, 0.29)  # so that u_eq lies inside offset +- scale
    return Policy(chain(weights, biases), scale, offset, squash, centre), tuple(Fraction(1, 5 + j) for j in range(m))


POLICIES = list(
    itertools.product(
        [[2, 1], [2, 6, 1], [3, 5, 4, 2], [2, 7, 6, 5, 1]],
        [1e-200, 1e-3, 0.8, 5.0, 1e4, 1e90],
        [("tanh", "preactivation"), ("tanh", "output"), ("identity", "output")],
    )
)


@pytest.mark.parametrize("radius", slow_after(2, [0.0, 1e-200, 1e-12, 1e-2, 0.7, 50.0, 1e9]))
def test_the_policy_on_boxes(radius: float) -> None:
    generator, finite, boxes = np.random.default_rng(int(radius) % 97 + 31), 0, 4
    for widths, size, (squash, centre) in POLICIES:
        policy, u_eq = random_policy(generator, widths, size, squash, centre)
        n = widths[0]
        x = generator.standard_normal((n, n + 1, boxes))
        x[:, 1:] *= radius
        x[:, 0, 0] = 0.0  # one box around the origin
        x_error = np.abs(generator.standard_normal((n, boxes))) * 1e-9 * radius
        mid, slopes, error = enclose_on_boxes(fold(policy, u_eq), x, x_error)
        with ctx.workprec(900):
            for b in range(boxes):
                if not np.isfinite(error[:, b]).all():
                    continue
                finite += 1
                for d in points_in_the_box(generator, n)[:5]:
                    state = [
                        sum((arb(float(x[i, 1 + k, b])) * arb(v) for k, v in enumerate(d)), arb(float(x[i, 0, b])))
                        + arb(float(generator.choice([-1.0, 1.0]))) * arb(float(x_error[i, b]))
                        for i in range(n)
                    ]
                    for j, u in enumerate(policy_in_arb(policy, u_eq, state)):
                        line = sum((arb(float(slopes[j, k, b])) * arb(v) for k, v in enumerate(d)), arb(0))
                        assert certainly_within(u - line, mid[j, b], error[j, b]), (widths, size, squash, centre, b)
    assert finite > boxes * len(POLICIES) // 2


def assert_policy_enclosed(
    policy: Policy, u_eq: tuple[Fraction, ...], x: np.ndarray, points: list[list[float]]
) -> None:
    n = x.shape[0]
    mid, slopes, error = enclose_on_boxes(fold(policy, u_eq), x, np.zeros((n, x.shape[2])))
    assert np.isfinite(error).all()
    with ctx.workprec(400):
        for b, d in itertools.product(range(x.shape[2]), points):
            state = [
                sum((arb(float(x[i, 1 + k, b])) * arb(v) for k, v in enumerate(d)), arb(float(x[i, 0, b])))
                for i in range(n)
            ]
            for j, u in enumerate(policy_in_arb(policy, u_eq, state)):
                line = sum((arb(float(slopes[j, k, b])) * arb(v) for k, v in enumerate(d)), arb(0))
                assert certainly_within(u - line, mid[j, b], error[j, b]), (b, d)


@pytest.mark.parametrize("second", [0.0, -3.0, 2.0])
@pytest.mark.parametrize("third", [0.0, -3.0, 2.0])
def test_errors_of_earlier_layers_widen_the_range_of_later_ones(second: float, third: float) -> None:
    """The affine parts of two neurons cancel in the second layer, so its whole range is the errors made before.

    A further neuron is saturated: the largest slope of a layer counts, not the least.
    """
    W1 = np.array([[3.0], [0.5]])
    cancel = np.tanh(3.0) / np.tanh(0.5)
    W2 = 3 * np.array([[1.0, -cancel], [0.0, 0.0]])
    weights = (W1, W2, np.array([[3.0, 0.0]]))
    biases = (np.zeros(2), np.array([second, 20.0]), np.array([third]))
    policy = Policy(chain(weights, biases), np.ones(1), np.zeros(1), "tanh", "output")
    x = np.array([[[0.0], [1.0]]])
    assert_policy_enclosed(policy, (Fraction(0),), x, [[t] for t in np.linspace(-1, 1, 81).tolist()])
    wide = Policy(chain((W1, W2[:1]), (biases[0], biases[1][:1])), np.ones(1), np.zeros(1), "tanh", "output")
    assert_policy_enclosed(wide, (Fraction(0),), x, [[t] for t in np.linspace(-1, 1, 81).tolist()])


@pytest.mark.parametrize("seed", range(10))
def test_rounding_is_bounded_where_numbers_cancel(seed: int) -> None:
    generator = np.random.default_rng(seed + 70)
    half = generator.standard_normal((1, 8)) * 1e8
    x = np.zeros((16, 17, 1))
    x[:8, 0, 0] = generator.standard_normal(8)
    x[8:, 0, 0] = x[:8, 0, 0] * (1 + 2.0**-40 * generator.standard_normal(8))
    W = np.concatenate([half, -half], 1)  # W x is 12 digits smaller than its terms
    origin = [[0.0] * 16]
    for squash, centre in (("identity", "none"), ("identity", "output"), ("tanh", "output"), ("tanh", "preactivation")):
        offset = 0.0 if centre == "none" else 0.1
        policy = Policy(chain((W,), (np.zeros(1),)), np.ones(1), np.full(1, offset), squash, centre)
        assert_policy_enclosed(policy, (Fraction(0),), x, origin)
    far = chain((1e-9 * W,), (np.array([-1e7 / 3]),))
    shifted = Policy(far, np.array([0.7]), np.array([0.7 * 1e7 / 3]), "identity", "output")
    assert_policy_enclosed(shifted, (Fraction(10**8, 3),), x, origin)
    two = chain((W, np.array([[1e6]])), (np.full(1, 1e-9), np.zeros(1)))
    deep = Policy(two, np.ones(1), np.zeros(1), "identity", "output")
    assert_policy_enclosed(deep, (Fraction(1, 3),), 1e-9 * x, origin)


def test_the_policys_error_on_boxes_is_of_second_order() -> None:
    generator = np.random.default_rng(41)
    policy, u_eq = random_policy(generator, [2, 8, 8, 1], 0.7, "tanh", "preactivation")
    x = generator.standard_normal((2, 3, 5))
    errors = []
    for h in (2.0**-5, 2.0**-6, 2.0**-7):
        forms = x.copy()
        forms[:, 1:] *= h
        errors.append(enclose_on_boxes(fold(policy, u_eq), forms, np.zeros((2, 5)))[2][0])
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert np.all(orders > 1.8), orders


def at_rest(J: np.ndarray) -> list[Jet]:
    """The states x = J d."""
    nothing = np.zeros((J.shape[1], J.shape[1]))
    return [plain(np.float64(0), 0.0, row, 0.0, nothing, nothing) for row in J]


@pytest.mark.parametrize("radius", slow_after(2, [1e-200, 1e-9, 1e-3, 0.2, 3.0]))
def test_the_policy_at_the_origin(radius: float) -> None:
    generator, finite = np.random.default_rng(int(radius * 1000) + 51), 0
    for widths, size, (squash, centre) in POLICIES:
        policy, u_eq = random_policy(generator, widths, size, squash, centre)
        n = widths[0]
        J = radius * generator.standard_normal((n, n))
        folded = fold(policy, u_eq)
        found = members(enclose_on_ball(folded, [v.model for v in at_rest(J)]))
        if not all(np.isfinite([h.slack, *np.ravel(h.whole)]).all() for h in found):
            continue
        finite += 1
        with ctx.workprec(3000):
            for d in points_in_the_ball(generator, n):
                square = sum((arb(v) ** 2 for v in d), arb(0))
                state = [sum((arb(p) * arb(v) for p, v in zip(row, d, strict=True)), arb(0)) for row in J.tolist()]
                for j, (u, q) in enumerate(zip(policy_in_arb(policy, u_eq, state), u_eq, strict=True)):
                    scale = arb(float(folded.scale[j]))
                    h = found[j]
                    linear = sum((arb(float(g)) * arb(v) for g, v in zip(h.a, d, strict=True)), arb(0))
                    line = ball(q) + scale * linear
                    bound = arb(float(h.slack)) * square.sqrt() + quadratic(h.whole, d)
                    assert abs(u - line - scale * curved(h, d)) <= abs(scale) * bound, (
                        widths,
                        size,
                        squash,
                        centre,
                        d,
                    )
    assert finite > len(POLICIES) // 2


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize(("squash", "centre"), [("identity", "output"), ("tanh", "output"), ("tanh", "preactivation")])
def test_folded_numbers_are_enclosed(squash: str, centre: str, seed: int) -> None:
    """Offset and shift against Arb, where the last layer's terms cancel to 12 digits less."""
    generator = np.random.default_rng(seed + 80)
    half, bias = generator.standard_normal((1, 8)) * 1e6, generator.standard_normal(8)
    W = np.concatenate([half, -half], 1)
    b1 = np.concatenate([bias, bias * (1 + 2.0**-40 * generator.standard_normal(8))])
    network = chain((np.ones((16, 1)), W), (b1, np.full(1, 1e-7)))
    policy = Policy(network, np.full(1, -3e5), np.full(1, 1e4), squash, centre)
    u_eq = (Fraction(1, 3),)
    folded = fold(policy, u_eq)
    with ctx.workprec(400):
        product = sum((arb(w) * arb(b).tanh() for w, b in zip(W[0].tolist(), b1.tolist(), strict=True)), arb(0))
        y = product + arb(1e-7)
        assert folded.network is policy.network and not folded.origin.any()
        if centre == "preactivation":
            beta = ((ball(u_eq[0]) - arb(1e4)) / arb(-3e5)).atanh()
            assert folded.shift is not None
            assert certainly_within(beta - y, folded.shift.value[0], folded.shift.error.top[0])
            assert folded.offset.value is policy.offset and folded.offset.error is ZERO
        else:
            h = y.tanh() if squash == "tanh" else y
            assert certainly_within(ball(u_eq[0]) + arb(3e5) * h, folded.offset.value[0], folded.offset.error.top[0])
            assert folded.shift is None


@pytest.mark.parametrize("squash", ["tanh", "identity"])
def test_without_centring_nothing_is_folded(squash: str) -> None:
    network = chain((np.array([[2.0, -1.0]]),), (np.zeros(1),))
    policy = Policy(network, np.array([3.0]), np.array([0.5]), squash, "none")
    folded = fold(policy, (Fraction(1, 2),))
    assert folded.shift is None and not folded.origin.any() and folded.offset.error is ZERO
    assert folded.network is policy.network and folded.offset.value is policy.offset


# --------------------------------------------------------------- what underflows and is multiplied by much afterwards


@pytest.mark.parametrize("k", [5e-324, 3 * 2.0**-1074, 5 * 2.0**-1060, -(2.0**-1073)])
@pytest.mark.parametrize("value", [1 + 2.0**-52, 3.0 / 7.0])
def test_a_subnormal_multiple_of_a_large_model_contains(k: float, value: float) -> None:
    """u k is 0 in binary64, but u k times the model's size is not."""
    model = Taylor(np.full(1, value * 2.0**900), np.full((1, 1), 2.0**900 / 3), np.zeros((1, 1, 1)), np.zeros(1))
    result = model.scaled(k)
    with ctx.workprec(2500):
        for d in (-1.0, 0.3, 1.0):
            truth = arb(k) * polynomial(model, 0, [d])
            assert abs(truth - polynomial(result, 0, [d])) <= arb(float(result.r[0]))
    least = 2.0**-53 * (Fraction(float(model.c[0])) + Fraction(float(model.g[0, 0]))) * abs(Fraction(k))
    assert Fraction(float(result.r[0])) >= least  # what the roundings of normal numbers may come to


@pytest.mark.parametrize("exponent", [-900, -200, -100])
def test_products_of_far_corners_in_the_off_diagonal_part_of_V_are_not_lost(exponent: int) -> None:
    """S_01 far_0 underflows, and far_1 is large."""
    ring = object.__new__(Ring)
    small = 2.0**-900
    ring.S_rest = Above(np.array([[0.0, small], [small, 0.0]]))
    far = np.array([[2.0**exponent], [2.0**1000]])
    assert Fraction(float(ring.cross(Above(far)).top[0])) >= 2 * Fraction(small) * Fraction(far[0, 0]) * Fraction(
        far[1, 0]
    )
    far = np.full((2, 1), 2.0**-600)
    ring.S_rest = Above(np.array([[0.0, 2.0**900], [2.0**900, 0.0]]))
    assert Fraction(float(ring.cross(Above(far)).top[0])) >= 2 * Fraction(2) ** 900 * Fraction(2) ** -1200


# ------------------------------------------------------------------------------------------------- what is no number


@pytest.mark.parametrize("name", ["sin", "cos", "inv", "tanh", "exp", "atan", "sqrt"])
def test_nothing_is_known_of_a_function_where_nothing_is_known_of_its_argument(name: str) -> None:
    radii = (0.0, 1.0, 1e300, np.inf, np.nan)
    wrong = [(c, 0.0) for c in (np.nan, np.inf, -np.inf)] + [(1.0, np.nan), (np.nan, np.nan), (np.inf, np.inf)]
    for (c, error), radius in itertools.product(wrong, radii):
        errors = elementary(name, np.array([c]), error, np.array([radius])).e
        assert not np.isfinite([float(np.ravel(e)[0]) for e in errors]).any(), (c, error, radius)
    for c, error, radius in ((1.0, 0.0, np.nan), (1.0, 0.0, np.inf), (0.0, 0.0, 1.0), (-0.0, 0.0, 0.0), (1.0, 1.0, 0)):
        if name in ("inv", "sqrt"):
            phi = elementary(name, np.array([c]), error, np.array([radius]))
            assert all(np.isnan(np.ravel(v)[0]) for v in (*phi.e, phi.third, phi.fourth)), (c, error, radius)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("where", range(4))
def test_what_is_not_finite_never_ends_in_a_negative_bound(value: float, where: int) -> None:
    if where == 3 and value == -np.inf:
        return  # a remainder is never negative
    parts = [np.array([-1.0]), np.array([[0.1], [0.2]]), np.zeros((2, 2, 1)), np.array([0.01])]
    parts[where].flat[0] = value
    m, one = Taylor(*parts), affine(np.array([-1.0]), np.zeros((2, 1)))
    zero = one.scaled(0.0)
    functions = ("sin", "cos", "inv", "tanh", "exp", "atan", "sqrt")
    unary = (-m, *map(m.function, functions), *(m.scaled(k) for k in (1.0, 0.0, 5e-324)))
    unknown = (m.function(name) * zero + one for name in functions)
    for result in (*unary, m + one, m * one, one * m, m * zero, *unknown):
        assert not np.isfinite((result.size + result.r)[0]) and not upper_bound(result)[0] < 0
