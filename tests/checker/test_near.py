"""The attack on the checker's rounding: operands of every kind, subnormal, huge and cancelling, against exact numbers.

A bound that is infinite or NaN claims nothing. Everything else is compared in fractions or in Arb, without tolerance.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from flint import arb, ctx

from certify.checker import elementary, near
from certify.checker.near import ZERO, Above, Cubic, Form, Near, Square, Uniform, Vector, gram, mixed, outer, symmetric
from tests.support.marks import slow_after

Array = np.ndarray
Generator = np.random.Generator
LARGEST = float(np.finfo(float).max)
SPECIAL = np.array([0.0, 5e-324, 2.0**-1022, 2.0**-1022 - 2.0**-1074, 2.0**-538, 2.0**-511, 1.0, 1 - 2.0**-53,
                    1 + 2.0**-52, 3.0, 2.0**53 + 2, 2.0**511, 2.0**512, LARGEST])  # fmt: skip


@pytest.fixture(autouse=True)
def _quiet() -> Iterator[None]:
    """As in `rules.check`: overflow becomes infinity or NaN."""
    with np.errstate(all="ignore"):
        yield


def operands(generator: Generator, *shape: int) -> Array:
    """Numbers of all sizes, some of them next to others, some special."""
    sign, kind = generator.choice([-1.0, 1.0], shape), generator.random(shape)
    wide = generator.uniform(1, 2, shape) * 2.0 ** generator.uniform(-1074, 1023, shape)
    plain = generator.uniform(1, 2, shape) * 2.0 ** generator.integers(-30, 30, shape)
    same = np.ldexp(1.0 + 2.0**-52 * generator.integers(0, 3, shape), int(generator.integers(-1000, 1000)))
    found = np.where(kind < 0.3, wide, np.where(kind < 0.7, plain, np.where(kind < 0.85, same, 0.0)))
    return np.asarray(sign * np.where(kind > 0.9, generator.choice(SPECIAL, shape), found))


def fractions(x: Any) -> list[Fraction]:
    return [Fraction(v) for v in np.ravel(x).tolist()]


def known(x: Near) -> Array:
    """The numbers of which anything is said."""
    return np.flatnonzero(np.isfinite(np.ravel(x.value)) & np.isfinite(np.ravel(x.error.top) + 0 * np.ravel(x.value)))


def near_ones(generator: Generator, count: int) -> tuple[Near, list[Fraction]]:
    """Numbers within their errors of others, some exact, and some that they may be: at an end, or between."""
    value = operands(generator, count)
    error = np.abs(operands(generator, count)) * generator.choice([0, 1, 1], count)
    shares = [Fraction(int(k), 4) for k in generator.choice([-4, 4, -1, 0, 3], count)]
    if generator.random() < 0.3:
        return Near(value), fractions(value)
    true = [v + k * e for v, k, e in zip(fractions(value), shares, fractions(error), strict=True)]
    return Near(value, Above(error)), true


BINARY: dict[str, Callable[[Any, Any], Any]] = {
    "+": lambda x, y: x + y, "-": lambda x, y: x - y, "*": lambda x, y: x * y,
    "(x + y) * x": lambda x, y: (x + y) * x, "x * y - y * x": lambda x, y: x * y - y * x,
    "(x - y) * (x + y) * y": lambda x, y: (x - y) * (x + y) * y,
}  # fmt: skip


@pytest.mark.parametrize("name", BINARY)
@pytest.mark.parametrize("count", slow_after(1, [3_000, 170_000]))
def test_numbers_near_others_hold_what_they_stand_for(name: str, count: int) -> None:
    generator, size, said = np.random.default_rng([len(name), count]), 1_000, 0
    for _ in range(count // size):
        (x, p), (y, q) = near_ones(generator, size), near_ones(generator, size)
        found = BINARY[name](x, y)
        errors = np.broadcast_to(found.error.top, size)
        for i in known(found):
            said += 1
            assert abs(BINARY[name](p[i], q[i]) - Fraction(found.value[i])) <= Fraction(float(errors[i]))
    assert said > count / 4


@pytest.mark.parametrize("count", slow_after(1, [2_000, 100_000]))
def test_ends_quotients_roots_and_inverses_hold(count: int) -> None:
    generator, size, said = np.random.default_rng(count), 1_000, 0
    for _ in range(count // size):
        x, p = near_ones(generator, size)
        lo, hi = x.ends
        k = np.abs(operands(generator, size))
        quotient, inverse, root, least = x.over(k), elementary.inverse(x), elementary.sqrt(x), near.lower(x)
        for i in range(size):
            assert not lo[i] > -np.inf or Fraction(float(lo[i])) <= p[i]
            assert not hi[i] < np.inf or p[i] <= Fraction(float(hi[i]))
            assert np.isnan(least[i]) or 0 < Fraction(float(least[i])) <= abs(p[i])
        for found, truth in ((quotient, lambda v, i, k=k: v / Fraction(float(k[i]))), (inverse, lambda v, i: 1 / v)):
            errors = np.broadcast_to(found.error.top, size)
            for i in known(found):
                said += 1
                assert abs(truth(p[i], i) - Fraction(float(found.value[i]))) <= Fraction(float(errors[i]))
        errors = np.broadcast_to(root.error.top, size)
        for i in known(root):
            value, error = Fraction(float(root.value[i])), Fraction(float(errors[i]))
            assert p[i] > 0 and p[i] <= (value + error) ** 2 and (value < error or (value - error) ** 2 <= p[i])
    assert said > count / 4


@pytest.mark.parametrize("count", slow_after(1, [300, 20_000]))
def test_upper_bounds_are_no_less(count: int) -> None:
    """Expressions of ten operations: their top against the same in Arb at 4,000 bits."""
    generator, said = np.random.default_rng(count), 0
    with ctx.workprec(4000):
        for _ in range(count // 10):
            numbers = np.abs(operands(generator, 6))
            bounds, truths = [Above(v) for v in numbers], [arb(float(v)) for v in numbers]
            for _ in range(10):
                i, j = (int(v) for v in generator.integers(0, len(bounds), 2))
                a, b, p, q = bounds[i], bounds[j], truths[i], truths[j]
                least = float(abs(operands(generator, 1)[0]))
                which = int(generator.integers(0, 7))
                pair = np.stack([np.asarray(a.top), np.asarray(b.top)])
                made: Any = [
                    (a + b, p + q), (a * b, p * q), (a.root, p.sqrt()), (a.most(b), p.max(q)),
                    (a.over(least), p / arb(least) if least > 0 else None), (a * least, p * arb(least)),
                    (Above(pair).norm(), (p * p + q * q).sqrt()),
                ][which]  # fmt: skip
                if made[1] is None or not np.isfinite(made[0].top):
                    continue
                said += 1
                assert not made[1] > arb(float(made[0].top)), which
                bounds.append(made[0])
                truths.append(made[1])
    assert said > count / 4


def test_a_bound_of_each_number_is_none_of_their_sum() -> None:
    """A single bound does not know how many numbers it bounds."""
    for added in (lambda bound: bound.sum(), lambda bound: bound.norm(), lambda bound: Near(np.ones(3), bound).sum()):
        with pytest.raises(TypeError, match="no bound of their sum"):
            added(Above(np.float64(1.0)))
    assert Above(np.ones(3)).sum().top >= 3 and ZERO.sum() is ZERO


def test_a_bound_of_many_roundings_keeps_its_promise() -> None:
    """A thousand products by 1 + 2^-52, and sums of a third, against exact numbers."""
    factor, bound, truth = 1 + 2.0**-52, Above(1.0), Fraction(1)
    for _ in range(5_000):
        bound, truth = bound * factor, truth * Fraction(factor)
    assert truth <= Fraction(float(bound.top)) <= truth * (1 + Fraction(1, 2**30))
    third, bound = 1 / 3, Above(0.0)
    for _ in range(5_000):
        bound = bound + third
    assert 5_000 * Fraction(third) <= Fraction(float(bound.top)) <= 5_000 * Fraction(third) * (1 + Fraction(1, 2**30))


def shared(generator: Generator, kind: Any, *shape: int) -> tuple[Near, Array]:
    """Numbers that share an error in the norm of their kind, and others within it, up to rounding towards them."""
    value = operands(generator, *shape)
    moved = np.where(generator.random(shape) < 0.5, operands(generator, *shape), 0.0) * 2.0**-20
    true = value + moved
    off = [[abs(Fraction(a) - Fraction(b)) for a, b in zip(np.ravel(v), np.ravel(t), strict=True)]
           for v, t in zip(np.moveaxis(value, -1, 0), np.moveaxis(true, -1, 0), strict=True)
           if np.all(np.isfinite(t))]  # fmt: skip
    if len(off) < shape[-1]:
        return shared(generator, kind, *shape)
    most = [sum(part, Fraction(0)) for part in off]  # no norm is larger than the sum, but that of a packed tensor
    times = 6 if kind is Cubic else 1
    error = np.array([float(times * v) * (1 + 2.0**-50) + 5e-324 if times * v < LARGEST else np.inf for v in most])
    return kind(value, Above(error)), true


def certainly_within(kind: Any, found: Near, truth: list[list[Fraction]]) -> bool:
    """The norm of the distance is at most the error, for each that has one; the 2-norm by squares."""
    for column, error, exact in zip(np.moveaxis(found.value, -1, 0), found.error.top, truth, strict=True):
        if not (np.isfinite(error) and np.all(np.isfinite(column))):
            continue
        off = [abs(Fraction(float(a)) - b) for a, b in zip(np.ravel(column), exact, strict=True)]
        if kind is Form:
            good = sum(off, Fraction(0)) <= Fraction(float(error))
        elif kind is Uniform:
            good = max(off) <= Fraction(float(error))
        else:
            often = (
                [1.0] * len(off)
                if kind is not Cubic
                else near.triples(round((6 * len(off)) ** (1 / 3)) - 1)[-1].tolist()
            )
            squares = sum((Fraction(w) * v * v for w, v in zip(often, off, strict=True)), Fraction(0))
            good = squares <= Fraction(float(error)) ** 2
        if not good:
            return False
    return True


def columns(x: Array) -> list[list[Fraction]]:
    return [fractions(column) for column in np.moveaxis(x, -1, 0)]


SHAPES: dict[Any, tuple[int, ...]] = {Form: (4,), Uniform: (3,), Vector: (3,), Square: (2, 2), Cubic: (4,)}


@pytest.mark.parametrize("kind", SHAPES)
@pytest.mark.parametrize("count", slow_after(1, [200, 12_000]))
def test_forms_vectors_and_tensors_hold(kind: Any, count: int) -> None:
    """Sums, products with numbers near others, and combinations, in the norm of each kind."""
    generator, size = np.random.default_rng([count, len(kind.__name__)]), 20
    for _ in range(count // size):
        (x, p), (y, q) = (shared(generator, kind, *SHAPES[kind], size) for _ in range(2))
        k, t = near_ones(generator, size)
        a, b = columns(p), columns(q)
        sums = [[v + w for v, w in zip(r, s, strict=True)] for r, s in zip(a, b, strict=True)]
        assert certainly_within(kind, x + y, sums)
        scaled = [[v * f for v in r] for r, f in zip(a, t, strict=True)]
        assert certainly_within(kind, x * k, scaled)
        both = [[v + w for v, w in zip(r, s, strict=True)] for r, s in zip(scaled, b, strict=True)]
        assert certainly_within(kind, x * k + y, both)
        assert certainly_within(kind, -x, [[-v for v in r] for r in a])


@pytest.mark.parametrize("count", slow_after(1, [60, 3_000]))
def test_products_of_vectors_and_matrices_hold(count: int) -> None:
    generator, size, k = np.random.default_rng(count), 6, 2
    for _ in range(count // size):
        (x, p), (y, q) = (shared(generator, Vector, k, size) for _ in range(2))
        a, b = columns(p), columns(q)
        pairs = [[(r[i] * s[j] + r[j] * s[i]) / 2 for i in range(k) for j in range(k)]
                 for r, s in zip(a, b, strict=True)]  # fmt: skip
        assert certainly_within(Square, outer(x, y), pairs)
        half = operands(generator, k, k, size) * 2.0**-2
        M = half + half.swapaxes(0, 1)
        if not np.all(np.isfinite(M)):
            continue
        places = list(zip(*(v.tolist() for v in near.triples(k)[:3]), strict=True))
        m = [np.array(c, dtype=object).reshape(k, k) for c in columns(M)]
        thirds = [[(r[h] * c[i, j] + r[i] * c[h, j] + r[j] * c[h, i]) / 3 for h, i, j in places]
                  for r, c in zip(a, m, strict=True)]  # fmt: skip
        assert certainly_within(Cubic, symmetric(x, Square(M)), thirds)
        W, (v, w) = operands(generator, 3, k), near_ones(generator, k)
        found, rows = v.through(W), [fractions(row) for row in W]
        for i in known(found):
            truth = sum((f * g for f, g in zip(rows[i], w, strict=True)), Fraction(0))
            assert abs(truth - Fraction(float(found.value[i]))) <= Fraction(float(found.error.top[i]))
        mapped = x.mapped(W, near.spectral_norm(W))
        images = [[sum((f * g for f, g in zip(row, r, strict=True)), Fraction(0)) for row in rows] for r in a]
        assert certainly_within(Vector, mapped, images)
        weights, t = near_ones(generator, size)
        one = Near(weights.value[:, None], Above(np.broadcast_to(weights.error.top, size)[:, None].copy()))
        total = [[sum((f * r[i] for f, r in zip(t, a, strict=True)), Fraction(0)) for i in range(k)]]
        assert certainly_within(Vector, mixed(x, one), total)
        numbers, s = near_ones(generator, k * 3)
        X = Near(numbers.value.reshape(k, 3), Above(np.broadcast_to(numbers.error.top, k * 3).reshape(k, 3).copy()))
        table = [s[:3], s[3:]]
        whole = [[sum((f * g for f, g in zip(r, c, strict=True)), Fraction(0)) for r in table for c in table]]
        product = gram(X)
        assert certainly_within(Square, Square(product.value[..., None], Above(np.array([product.error.top]))), whole)


@pytest.mark.parametrize("count", slow_after(1, [200, 10_000]))
def test_a_majorant_is_one(count: int) -> None:
    """d'X d <= d'M d at points for X within the error in the Frobenius norm, in fractions."""
    generator = np.random.default_rng(count)
    for _ in range(count // 10):
        value = operands(generator, 2, 2)
        value = (value + value.T) / 2
        error = np.abs(operands(generator, 1))[0]
        M = Square(value, Above(error)).majorant
        if not np.all(np.isfinite(M)):
            continue
        for d in generator.uniform(-1, 1, (10, 2)).tolist():
            x = [Fraction(v) for v in d]
            length = sum(v * v for v in x)
            form = sum(Fraction(float(M[i, j])) * x[i] * x[j] for i in range(2) for j in range(2))
            inner = sum(Fraction(float(value[i, j])) * x[i] * x[j] for i in range(2) for j in range(2))
            assert inner + Fraction(float(error)) * length <= form


@pytest.mark.parametrize("name", ["tanh", "sin", "cos", "exp", "atan"])
@pytest.mark.parametrize("count", slow_after(1, [2_000, 60_000]))
def test_functions_of_numbers_near_others_hold(name: str, count: int) -> None:
    generator, said = np.random.default_rng([count, len(name)]), 0
    c = generator.uniform(-70, 70, count) * 10.0 ** generator.uniform(-300, 0, count) ** generator.choice([0, 1], count)
    error = np.abs(c) * generator.choice([0, 1e-18, 1e-9, 0.5], count)
    x = Near(c, Above(error))
    found = {"tanh": near.tanh, "exp": elementary.exp, "atan": elementary.atan}.get(name)
    y = found(x) if found else near.sin_cos(x)[name == "cos"]
    with ctx.workprec(1300):
        for i in known(y):
            said += 1
            v = arb(float(c[i])) + arb(float(generator.choice([-1.0, 0.0, 1.0]))) * arb(float(error[i]))
            assert abs(getattr(v, name)() - arb(float(y.value[i]))) <= arb(float(y.error.top[i])), c[i]
    assert said > 0.6 * count


def test_a_table_keeps_what_is_not_known() -> None:
    """Where Arb has no number, a bound over all numbers has none, and an entry of a table is refused."""
    bent = elementary.Polynomials(lambda v: (v * v + arb(2) ** -40).sqrt())  # around 0 Arb's square may be negative
    assert all(np.isnan(bound.top) for bound in bent.sup)
    with pytest.raises(ArithmeticError, match="not accurate"):
        elementary.Polynomials(lambda v: v.log())
    with pytest.raises(ArithmeticError, match="not accurate"):
        near.table(lambda _: arb("nan"), 1.0)
