"""All rounding of the checker: numbers in binary64 that carry a bound of their error.

`Above` is an upper bound of a number that is not negative, `Near` are numbers near others, in a norm. The other files
are formulas over these two, over rationals, and over binary64 numbers that mean exactly what they say.

u = 2^-53 is the unit roundoff. fl(a op b) = (a op b)(1 + d) with |d| <= u for sums, products, quotients and roots, but
for underflow: sums and roots have none, a product or quotient loses at most 2^-1075. So the rule of every bound here is

    the exact number is at most v (1 + 2u)^k,

v being computed from non-negative numbers in k or fewer roundings, each of which takes at most a factor
1/(1 - u) <= 1 + 2u away; products and quotients add LEAST = 2^-1022 to v. k stays below 2^11, where
(1 + 2u)^k < 1 + 2^-41.

Sums and matrix products are bounded for any order of summation and with or without fused multiply-add:
|fl(AB) - AB| <= gamma_n |A||B| with gamma_n = n u / (1 - n u) <= 2 n u (Higham 2002, section 3.5).

Overflow never helps: it makes a bound infinite or NaN, and a comparison that has to hold is then False. NaN means that
nothing is known.

tanh, sin, cos, exp and atan use a table of values on a grid of step h = 2^-5, which Arb computes at first use, an
addition theorem, and Taylor polynomials on |d| <= h/2 = 2^-6. No libm value is trusted; the square root is IEEE's own.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from fractions import Fraction
from functools import cache, cached_property, reduce
from itertools import combinations_with_replacement, permutations
from operator import add
from typing import Any, Self

import numpy as np
from flint import arb, ctx, fmpq

Array = Any  # of binary64; numpy's own types say nothing of shapes
U = 2.0**-53
LEAST = 2.0**-1022
_MORE = 1 + 2.0**-40
_MOST_ROUNDINGS = 1000
STEP = 2.0**-5
_TANH_END = 20.0  # 1 - tanh(20) < 2^-56
_ANGLE_END = 64.0  # beyond, sin and cos are only known to lie in [-1, 1]


# -------------------------------------------------------------------------------------------------------- upper bounds


class Above:
    """Upper bounds of numbers that are not negative: each is at most `v (1 + 2u)^k`."""

    __slots__ = ("k", "v")

    def __init__(self, v: Any, k: int = 0) -> None:
        """v is a number or an array, without negative entries.

        The first line keeps the promise with k = 0: fl(v _MORE) >= v (1 + 2^-40)(1 - u) >= v (1 + 2u)^k for k < 2^11;
        where v is below 2^-1022, LEAST makes up for what that product loses.
        """
        if k > _MOST_ROUNDINGS:
            v, k = v * _MORE + LEAST, 0
        self.v, self.k = v, k

    @property
    def top(self) -> Any:
        """The bounds as binary64 numbers, rounded up: 1 + 4u (k + 2) is exact, and times 1 - u at least (1 + 2u)^k."""
        return self.v * (1 + 4 * U * (self.k + 2)) + LEAST if self.k else self.v

    def __add__(self, other: Any) -> Above:
        """The sum with bounds, or with exact numbers that are not negative."""
        if not isinstance(other, Above):
            return Above(self.v + other, self.k + 1)
        if self is ZERO or other is ZERO:
            return other if self is ZERO else self
        return Above(self.v + other.v, (self.k if self.k > other.k else other.k) + 1)

    def __mul__(self, other: Any) -> Above:
        """The product with bounds, or with exact numbers that are not negative. What is bounded by ZERO is 0,
        and so is its product with any number, whatever bounds that."""
        if self is ZERO or other is ZERO:
            return ZERO
        if not isinstance(other, Above):
            return Above(self.v * other + LEAST, self.k + 2)
        return Above(self.v * other.v + LEAST, self.k + other.k + 2)

    __radd__, __rmul__ = __add__, __mul__

    def over(self, least: Any) -> Above:
        """Quotient by a number that is at least `least`; NaN unless that is positive and finite.

        Its overflow is infinite. Underflow of the quotient is at most 2^-1075.
        """
        return Above(self.v / np.where((least > 0) & (least < np.inf), least, np.nan) + LEAST, self.k + 2)

    def share(self, of: Above) -> Above:
        """Numbers whose products with `of`, taken as bounds, are bounds of these: of.top is below of.v (1 + 2^-41)."""
        return self.over(of.top) * _MORE

    @property
    def root(self) -> Above:
        """Square roots."""
        return self if self is ZERO else Above(np.sqrt(self.v), self.k + 1)

    def ulps(self, roundings: int) -> Above:
        """2 u times the numbers, so many times: what that many roundings in a row, of numbers that are not larger, come
        to (gamma_n <= 2 n u)."""
        return Above(self.v * (2 * roundings * U) + LEAST, self.k + 2)

    def least(self, other: Above) -> Above:
        """The lesser of two bounds of the same numbers; NaN where either is."""
        return Above(np.minimum(self.v, other.v), max(self.k, other.k))

    def most(self, other: Above) -> Above:
        """The larger of two, which bounds both."""
        return Above(np.maximum(self.v, other.v), max(self.k, other.k))

    def less(self, x: Any) -> Above:
        """The differences from exact numbers, or 0 where these are larger."""
        return Above(np.maximum(self.top - x, 0.0), 1)

    def sum(self, axis: int | tuple[int, ...] = 0) -> Above:
        """Sums along axes, in any order: of n numbers they lose a factor 1 - n u, and 4 n u makes up for it. A single
        bound of all numbers does not know how many there are."""
        if self is ZERO:
            return self
        if np.ndim(self.v) == 0:
            raise TypeError("a bound of each number is no bound of their sum")
        added = np.sum(self.v, axis=axis)
        n = np.size(self.v) // max(np.size(added), 1)
        return Above(added * (1 + 4 * n * U), self.k + 2)

    def max(self, axis: int = 0) -> Above:
        """The largest along an axis."""
        return self if self is ZERO else Above(np.max(self.v, axis=axis, initial=0.0), self.k)

    def norm(self, axis: int | tuple[int, ...] = 0) -> Above:
        """2-norms along axes."""
        return (self * self).sum(axis).root

    def through(self, W: Array) -> Above:
        """|W| x for an exact matrix W, the numbers x along the first axis."""
        n = W.shape[1]
        return (
            self
            if self is ZERO
            else Above(np.tensordot(np.abs(W), self.v, 1) * (1 + 4 * n * U) + n * LEAST, self.k + 3)
        )

    def __getitem__(self, index: Any) -> Above:
        """The bounds of some entries; a number bounds all of them."""
        return self if np.ndim(self.v) == 0 else Above(self.v[index], self.k)

    def shaped(self, *shape: int) -> Above:
        """The same in another shape."""
        return Above(self.v.reshape(shape), self.k)

    def beside(self, other: Above) -> Above:
        """These, and then others."""
        return Above(np.concatenate([self.v, other.v]), max(self.k, other.k))

    def where(self, condition: Any, other: Above) -> Above:
        """These where the condition holds, others elsewhere."""
        return Above(np.where(condition, self.v, other.v), max(self.k, other.k))


ZERO = Above(0.0)


def size(x: Any) -> Above:
    """The magnitude of exact numbers."""
    return Above(np.abs(x))


def norm(x: Any, axis: int | tuple[int, ...] = 0) -> Above:
    """The 2-norm of exact numbers along axes."""
    return size(x).norm(axis)


# -------------------------------------------------------------------------------------------------- numbers near others


class Near:
    """Numbers near `value`: each lies within its `error` of it.

    With `axes` leading axes, which `value` has and `error` has not, an error is one for all numbers along them: a bound
    of the sum of their distances. So on the box |d_i| <= 1 a form with these coefficients is within `error` of the one
    that is stored.
    """

    axes: tuple[int, ...] = ()

    def __init__(self, value: Any, error: Above = ZERO, rough: Above | None = None) -> None:
        self.value, self.error, self.rough = value, error, rough

    def length(self, x: Above) -> Above:
        """The norm of magnitudes x."""
        return x

    @cached_property
    def size(self) -> Above:
        """Upper bound of the norm of the numbers."""
        return self.length(size(self.value)) + self.error

    @property
    def roughly(self) -> Above:
        """Upper bound of the norm of what is stored: of sums and products by those of their parts.

        It may be short by the roundings that made what is stored, which `error` has, twice. So it stands beside
        `error`, or in `ulps`, which has a factor 2 to spare.
        """
        return self.rough or self.size

    @property
    def ends(self) -> tuple[Any, Any]:
        """(lo, hi), binary64 numbers around each number.

        b = 4u |value| + error is computed as `top`, at least b (1 + 4u); then fl(value - top) <= value - top
        + u (|value| + top) <= value - error. So with the other end.
        """
        if self.error is ZERO:
            return self.value, self.value
        reach = (self.error + size(self.value).ulps(2)).top
        return self.value - reach, self.value + reach

    def wider(self, by: Above) -> Self:
        """The same numbers, of which less is known."""
        return type(self)(self.value, self.error + by, self.rough)

    def __add__(self, other: Near) -> Self:
        """The norm of a sum's roundings is at most u times that of the terms."""
        value = self.value + other.value
        made = self.roughly + other.roughly if self.axes else size(value)
        return type(self)(value, self.error + other.error + made.ulps(1), made)

    def __neg__(self) -> Self:
        return type(self)(-self.value, self.error, self.rough)

    def __sub__(self, other: Near) -> Self:
        return self + -other

    def __mul__(self, other: Near | float) -> Self:
        """Products with one number for all that share an error. |xy - XY| <= |x||y - Y| + |x - X||Y|, where |Y| is not
        bounded roughly alone, since x may be a range; nor by itself, whose squares may overflow."""
        x, y = other if isinstance(other, Near) else Near(other), self
        of_x, rough = size(x.value), y.roughly
        made = of_x * (y.error + rough.ulps(1))
        made = made if x.error is ZERO else made + x.error * y.size.least(rough + y.error)
        return type(self)(x.value * y.value, made, of_x * rough)

    __rmul__ = __mul__

    def over(self, k: Any) -> Self:
        """Quotients by exact positive numbers."""
        return type(self)(self.value / k, (self.error + self.size.ulps(1)).over(k))

    def sum(self) -> Near:
        """The sums along the first axis, of numbers with an error each; gamma_n bounds what is rounded."""
        value = np.sum(self.value, axis=0)
        made = size(self.value).sum().ulps(len(self.value))
        return Near(value, made if self.error is ZERO else made + self.error.sum())

    def __getitem__(self, index: Any) -> Self:
        """Some of those that have an error each."""
        place = (*(slice(None) for _ in self.axes), *(index if isinstance(index, tuple) else (index,)))
        return type(self)(self.value[place], self.error[index])

    def through(self, W: Array) -> Self:
        """W x for an exact matrix W, x along the first axis of `error`, the last or last but one of `value`.

        A row's roundings are at most gamma_n sum_l |W_il| times the norms of the x_l, and so is what underflows.
        """
        flat = np.ndim(self.value) == len(self.axes) + 1
        value = self.value @ W.T if flat else np.matmul(W, self.value)
        return type(self)(value, (self.error + self.size.ulps(W.shape[1])).through(W))


class Form(Near):
    """Coefficients along the first axis, of 1 and of symbols in [-1, 1], with one error for all."""

    axes = (0,)

    def length(self, x: Above) -> Above:
        return x.sum(0)

    @property
    def range(self) -> Near:
        """The forms as numbers, whatever the symbols are."""
        return Near(self.value[0], size(self.value[1:]).sum() + self.error)

    def raised(self, b: Near) -> Form:
        """The sum with numbers, at the first coefficient."""
        value = self.value.copy()
        value[0] += b.value
        return Form(value, self.error + b.error + size(value[0]).ulps(1))


class Uniform(Near):
    """Numbers along the first axis, with one error that bounds each of them."""

    axes = (0,)

    def length(self, x: Above) -> Above:
        return x.max(0)

    def times(self, k: Array) -> Uniform:
        """Products with an exact number for each."""
        return Uniform(self.value * k, (self.error + self.size.ulps(1)) * size(k).max(0))

    def through(self, W: Array) -> Uniform:
        """W x for an exact matrix W, the numbers x along the first axis; |W| has rows of sums up to the largest."""
        value = np.tensordot(W, self.value, 1)
        return Uniform(value, (self.error + self.size.ulps(W.shape[1])) * size(W).sum(1).max(0))


class Vector(Near):
    """Vectors along the first axis, each within its error in the 2-norm."""

    axes: tuple[int, ...] = (0,)

    @cached_property
    def stored(self) -> Above:
        """The norms of what is stored."""
        return self.length(size(self.value))

    def length(self, x: Above) -> Above:
        return x.norm(self.axes)

    def mapped(self, W: Array, norm2: Above) -> Vector:
        """W x for an exact matrix W, ||W||_2 <= norm2: |fl(W x) - W x| <= gamma_n |W||x|, whose 2-norm is at most
        gamma_n ||W||_F ||x||."""
        made = norm(W, (0, 1)) * self.size.ulps(W.shape[1])
        return Vector(W @ self.value, norm2 * self.error + made)

    def beside(self, W: Array) -> Vector:
        """These vectors, and then exact ones."""
        return Vector(np.concatenate([self.value, W], 1), self.error.beside(Above(np.zeros(W.shape[1]))))

    def times(self, k: Near) -> Vector:
        """Entry by entry products with numbers k."""
        made = size(k.value).max() * (self.error + self.size.ulps(1)) + k.error.max() * self.size
        return Vector(self.value * k.value[:, None], made)


class Square(Vector):
    """Matrices along the first two axes, each within its error in the Frobenius norm."""

    axes: tuple[int, ...] = (0, 1)

    @property
    def majorant(self) -> Array:
        """Matrices M with d'X d <= d'M d for all X within the error: its identity is added on the diagonal."""
        if self.error is ZERO:
            return self.value
        M = self.value + 0.0 * self.error.v
        i = np.arange(len(M))
        M[i, i] = Near(M[i, i], self.error).ends[1]
        return M


class Tensor(Square):
    """The same with any number of axes but the last."""

    def __init__(self, value: Any, error: Above = ZERO, rough: Above | None = None) -> None:
        super().__init__(value, error, rough)
        self.axes = tuple(range(np.ndim(value) - 1))


class Cubic(Vector):
    """Symmetric tensors with three indices, along the first axis as `triples` has them, within an error in the 2-norm
    of the whole tensor."""

    def length(self, x: Above) -> Above:
        k = round((6 * len(x.v)) ** (1 / 3)) - 1  # of k (k + 1)(k + 2)/6 entries
        often = triples(k)[-1].reshape(-1, *[1] * (np.ndim(x.v) - 1))
        found: Above = (x * x * often).sum(0).root
        return found


@cache
def triples(k: int) -> tuple[Array, Array, Array, Array]:
    """h <= i <= j, in the order in which the entries of a symmetric tensor K are stored, and how often each stands in
    the whole tensor."""
    kept = list(combinations_with_replacement(range(k), 3))
    h, i, j = np.array(kept).T
    return h, i, j, np.array([float(len(set(permutations(triple)))) for triple in kept])


def outer(x: Vector, y: Vector) -> Square:
    """The symmetric part of x y', (k, k): the Frobenius norm of each half is at most that of x y'; three roundings."""
    whole = x.value[:, None] * y.value
    value = (whole + whole.swapaxes(0, 1)) / 2
    both = x.stored * y.stored
    return Square(value, x.stored * y.error + both.ulps(3) + x.error * y.size, both)


def symmetric(a: Vector, Q: Square) -> Cubic:
    """The symmetric part of a_h Q_ij, Q symmetric; its norm is at most ||a|| ||Q||_F; five roundings."""
    h, i, j, _ = triples(len(a.value))
    x, M = a.value, Q.value
    value = (x[h] * M[i, j] + x[i] * M[h, j] + x[j] * M[h, i]) / 3
    both = a.stored * Q.roughly
    return Cubic(value, a.stored * Q.error + both.ulps(5) + a.error * (Q.roughly + Q.error), both)


def mixed(x: Near, weights: Near) -> Any:
    """`sum_q w_q x_q` of the same kind: q runs along the last axis of x, and along the first of the weights, (q,) or
    (q, rows). Of N terms gamma_N bounds what is rounded."""
    rows = (slice(None), *[None] * (np.ndim(weights.value) - 1))
    wrong = (weights.error + weights.size.ulps(len(weights.value))) * x.size[rows] + size(weights.value) * x.error[rows]
    return type(x)(x.value @ weights.value, wrong.sum())


def gram(X: Near) -> Square:
    """X X' of numbers (k, N) with an error each, e in the whole: X X' - Y Y' is at most e (2 ||X|| + e), and gamma_N
    ||X||^2 bounds what is rounded, in the Frobenius norm."""
    whole, e = norm(X.value, (0, 1)), X.error.norm((0, 1))
    return Square(X.value @ X.value.T, (whole * whole).ulps(X.value.shape[1]) + e * (whole * 2 + e))


def near_one(x: Any) -> tuple[Any, int]:
    """(y, e): x is y 2^e, and nothing in y exceeds 1; exact but for underflow, at most 2^-1075 a number."""
    most = np.maximum(np.max(np.abs(x.value), initial=0.0), np.max(x.error.top, initial=0.0))
    by = int(np.frexp(most)[1])
    return type(x)(np.ldexp(x.value, -by), Above(np.ldexp(x.error.top, -by)) + np.size(x.value) * LEAST), by


def symmetrised(N: Tensor) -> Tensor:
    """The part of N_l[h, i, j], (k, k, k, l), symmetric in all indices, N being so in the first three: a projection, so
    that the distance of the whole does not grow, and four roundings."""
    X = N.value
    value = (X + X.transpose(3, 1, 2, 0) + X.transpose(0, 3, 2, 1) + X.transpose(0, 1, 3, 2)) / 4
    wrong = (N.error + N.size.ulps(4)).norm()
    return Tensor(value, wrong * np.ones(len(X)))


def combined(*terms: tuple[Any, Near]) -> tuple[Any, Above]:
    """`sum_t k_t x_t`, and what it is away at most, for exact numbers k_t, one for all that share an error.

    Of N terms each coefficient has N roundings or fewer: they come to at most gamma_N sum_t |k_t||x_t|.
    """
    made, wrong = ZERO, ZERO
    for k, x in terms:
        of_k = size(k)
        made, wrong = made + of_k * x.size, wrong + of_k * x.error
    return reduce(add, (k * x.value for k, x in terms)), wrong + made.ulps(len(terms))


def products(x: Array, y: Array, both: Above, first: Array, second: Array) -> Form:
    """As many zeros as x has entries; then x_i y_j for i = j, and x_i y_j + x_j y_i for i < j, for all pairs
    (first, second) = (i, j) of exact numbers, `both` being the product of their sums of magnitudes.

    That is the sum of the magnitudes of all terms, too; each number has three roundings or fewer.
    """
    N = len(x)
    whole = np.zeros((N + len(first), *x.shape[1:]))
    np.multiply(x[first], y[second], out=whole[N:])
    apart = first != second
    whole[N:][apart] += x[second[apart]] * y[first[apart]]
    found = Form(whole, both.ulps(3))
    found.size = both + found.error
    return found


def near(q: Fraction) -> Near:
    """The binary64 number nearest to a rational; 0, and infinitely far, if it is too large."""
    try:
        value = float(q)
    except OverflowError:
        return Near(np.float64(0), Above(np.float64(np.inf)))
    left = abs(Fraction(value) - q)
    return Near(np.float64(value), Above(np.float64(left) + LEAST, 2) if left else ZERO)


def stacked(numbers: Sequence[Near]) -> Near:
    """Single numbers as an array."""
    errors = [0.0 if x.error is ZERO else x.error.top for x in numbers]
    return Near(np.array([x.value for x in numbers], dtype=np.float64), Above(np.array(errors, dtype=np.float64)))


def all_near(numbers: Iterable[Fraction]) -> Near:
    """Rationals as an array."""
    return stacked([near(q) for q in numbers])


def near_ball(x: arb) -> Near:
    """Every point of an Arb ball."""
    value = float(x.mid())
    return Near(np.float64(value), Above(np.float64((x - arb(value)).abs_upper()), 1) + LEAST)


def near_atanh(q: Fraction) -> Near:
    """`atanh(q)` for a rational q in (-1, 1)."""
    return near_ball(arb(fmpq(q.numerator, q.denominator)).atanh())


def within(bounds: tuple[Fraction, Fraction], x: Near) -> Any:
    """Elementwise: x certainly lies in the bounds."""
    (_, least), (most, _) = (near(q).ends for q in bounds)
    lo, hi = x.ends
    return (lo >= least) & (hi <= most)


def at_least_0(x: Near) -> Above:
    """Upper bounds of numbers that are not negative."""
    return Above(np.maximum(x.ends[1], 0.0))


def lower(x: Near) -> Any:
    """Lower bounds of |x|, NaN unless they are positive and finite."""
    least = np.where(x.value < 0, -x.ends[1], x.ends[0])
    return np.where((least > 0) & (least < np.inf), least, np.nan)


# ----------------------------------------------------------------------------------------------------------- functions


@cache
def table(function: Callable[[arb], arb], end: float) -> Array:
    """The binary64 numbers nearest to a function at 0, h, 2h, ..., end."""
    with ctx.workprec(128):
        return np.array([entry(function(arb(k) * STEP), 4 * LEAST) for k in range(int(end / STEP) + 1)])


def entry(x: arb, slack: float) -> float:
    """The binary64 number nearest to a value, within u of it and a slack. At 128 bits the midpoint rounds to within
    u |value| (1 + 2^-50) of the ball."""
    found = near_ball(x)
    if not found.error.top <= U * abs(found.value) * (1 + 2.0**-20) + slack:
        raise ArithmeticError("a table entry is not accurate enough")
    return float(found.value)


def _sech2(x: arb) -> arb:
    t = x.tanh()
    return 1 - t * t


ctx.prec = 128


def split(y: Array, end: float) -> tuple[Any, Array]:
    """Index k and remainder d with y = k h + d exactly, for 0 <= y <= end: |d| <= h/2, or k = 0 and d = y <= h.

    k h has at most 11 bits. If k = 0, d = y. Otherwise y >= h, so d is a multiple of ulp(y) >= 2^-57 with
    |d| <= 2^-6: it has at most 51 bits, and the subtraction is exact.
    """
    k = np.where(y < STEP, 0.0, np.rint(y * (1 / STEP)))
    return k.astype(np.intp), y - k * STEP


def _tanh(y: Array) -> tuple[Array, Above]:
    """(t, e) with |tanh(y) - t| <= e for every finite y; NaN where y is not finite.

    With k and d from `split`, `tanh(kh + d) = T + q`, `q = (1 - T^2) s / (1 + T s)`, T = tanh(kh), s = tanh(d).
    s = d - d^3/3 + 2 d^5/15 - 17 d^7/315 + 62 d^9/2835 + r: the series alternates and its terms decrease for |d| <= h,
    so |r| <= 1382/155925 |d|^11 < 0.08u |d|. What Horner's rule adds to d is below |d|/3000, so that its roundings
    are below 0.01u |d|: s is within 1.1u |s|. If k = 0, q = s exactly. Otherwise 1 - T^2 and T come with u each, and
    T s <= 2^-6: q is within (1 + 1.1 + 1)u + 1.1u + u < 6u of itself, and the last addition adds u (T + |q|): t is
    within 2u T + 7u |q|, and 2u |q| if k = 0. For y > 20 the value 1 is within 2^-56: 3u T + 8u |q| covers that. As
    tanh is concave, |q| <= |d| T/(kh) <= T/(2k): at most T/2, and T/4 where q < 0, since k >= 2 there. Either way
    3u T + 8u |q| <= 6.7u |T + q|. The claim is 7u |t|.
    """
    finite = np.isfinite(y)
    k, d = split(np.fmin(np.abs(y), _TANH_END), _TANH_END)
    w = d * d
    s = d + d * (w * (-1 / 3 + w * (2 / 15 + w * (-17 / 315 + w * (62 / 2835)))))
    T = table(arb.tanh, _TANH_END)[k]
    t = np.where(finite, np.copysign(T + table(_sech2, _TANH_END)[k] * s / (1 + T * s), y), np.nan)
    return t, size(t) * (7 * U)


def _sin_cos(y: Array) -> tuple[Near, Near]:
    """sin(y) and cos(y); NaN where y is not finite.

    sin(kh + d) = S cos(d) + C sin(d) and cos(kh + d) = C cos(d) - S sin(d) on the same grid. The Taylor polynomials of
    degree 9 and 8 leave out less than |d|^11 / 11! and |d|^10 / 10!, |d| <= h; as above, sin(d) and cos(d) are within
    1.1u of themselves. S and C come with u each: a product is within 3.2u of itself, and the sum adds u of both. The
    claim is 5u times the products' magnitudes. For |y| > 64: 0 within 1.
    """
    finite, close = np.isfinite(y), np.abs(y) <= _ANGLE_END
    k, d = split(np.where(close, np.abs(y), 0.0), _ANGLE_END)
    w = d * d
    sd = d + d * (w * (-1 / 6 + w * (1 / 120 + w * (-1 / 5040 + w * (1 / 362880)))))
    cd = 1 + w * (-1 / 2 + w * (1 / 24 + w * (-1 / 720 + w * (1 / 40320))))
    S, C = (table(function, _ANGLE_END)[k] for function in (arb.sin, arb.cos))

    def known(value: Array, large: Array, small: Array) -> Near:
        error = (size(large) + size(small)) * (5 * U)
        value, bound = (np.where(finite, np.where(close, v, far), np.nan) for v, far in ((value, 0.0), (error.v, 1.0)))
        return Near(value, Above(bound, error.k))

    return (
        known(np.copysign(1.0, y) * (S * cd + C * sd), S, C * sd),
        known(C * cd - S * sd, C, S * sd),
    )


def tanh(x: Near) -> Near:
    """tanh of numbers near others; its slope is at most 1. The same holds of sin, cos and atan."""
    return Near(*_tanh(x.value)).wider(x.error)


def sin_cos(x: Near) -> tuple[Near, Near]:
    s, c = _sin_cos(x.value)
    return s.wider(x.error), c.wider(x.error)


# ----------------------------------------------------------------------------------------------------- fused operations


def lines_around_tanh(centre: Array, radius: Above) -> tuple[Array, Array, Above]:
    """Parallel lines around tanh: (s, m, gap) with |tanh(y) - s y - m| <= gap for all |y - centre| <= radius.

    The slope s is *any* number in [0, 1] (here near the chord's). D(y) = tanh(y) - s y is odd: what is shown of
    [lo, hi] around |centre|, where hi > 0 and |lo| <= hi, holds around -|centre| with the signs changed. On y >= 0
    tanh is concave, so D lies below its tangent at any p >= 0 and is least at an end; on y <= 0 it is convex, so D is
    largest at an end. Hence sup D is at most D(lo) or the larger end of the tangent over [max(lo, 0), hi]. And inf D
    is at least D(hi) or, if lo >= 0, D(lo), else, as D is odd, minus the larger end over [0, -lo] of the tangent at any
    p >= 0 (at 0 the tangent is not below D(0) = 0). p should be the critical point, or the end that is nearest to it,
    but nothing depends on that.

    Roundings, with |y| <= hi and so |t| <= t_hi (1 + 14u): `t - s y` is within 9u t_hi + 3u s hi, and `excess` within
    18u (7u of t twice, and three roundings); the product with a part of the width adds 2u of it, and the last sum u of
    all: 10u t_hi + 4u s hi + 21u (hi - start) is less than `slack`.
    """
    lo, hi = Near(np.abs(centre), radius).ends
    t_lo, _ = _tanh(lo)
    t_hi, _ = _tanh(hi)
    slope = np.maximum(np.minimum((t_hi - t_lo) / (hi - lo), 1.0), 0.0)
    start = np.maximum(lo, 0.0)
    p = np.minimum(np.maximum(np.arctanh(np.sqrt(1 - slope)), start), hi)
    t, _ = _tanh(p)

    def tangent(p: Array, t: Array, start: Array | float, end: Array) -> Array:
        excess = 1 - t * t - slope
        return t - slope * p + np.maximum(excess * (start - p), excess * (end - p))

    at_lo, at_hi, below = t_lo - slope * lo, t_hi - slope * hi, -lo
    upper = np.maximum(at_lo, tangent(p, t, start, hi))
    least = -tangent(np.minimum(p, below), np.where(p < below, t, -t_lo), 0.0, below)
    lower = np.minimum(at_hi, np.where(lo < 0, least, at_lo))
    slack = Above(32 * U * (t_hi + slope * hi + (hi - start)) + LEAST)
    shift = np.where(centre < 0, -0.5, 0.5) * (upper + lower)
    gap = Above(0.5 * np.maximum(upper - lower, 0.0), 2) + (size(upper) + size(lower)).ulps(1) + slack
    return slope, shift, gap


def spectral_norm(W: Array) -> Above:
    """||W||_2 by repeated squaring.

    ||G||_2^2 = ||G'G||_2 <= ||fl(G'G)||_2 + gamma_k ||G||_F^2. Six squarings leave the Frobenius norm at the end,
    which is at most n^(1/128) times too large. G is divided by a power of two first, which is exact
    but for underflow: at most 2^-1075 an entry, and so is what underflows in G'G.
    """
    G = W if W.shape[0] >= W.shape[1] else W.T
    steps: list[tuple[float, Above]] = []
    for _ in range(6):
        whole = float(norm(G, (0, 1)).top)
        if not whole < np.inf:
            return Above(np.inf)
        scale = math.ldexp(1.0, math.frexp(whole)[1])
        G, part = G / scale, Above(whole).over(scale)
        steps.append((scale, (part * part).ulps(G.shape[0]) + G.size * LEAST))
        G = G.T @ G
    bound = norm(G, (0, 1))
    for scale, error in reversed(steps):
        bound = (bound + error).root * scale
    return bound


def self_test() -> None:
    """Fail closed unless this machine rounds to nearest even and keeps subnormal numbers.

    Raises
    ------
    ArithmeticError : a rounding mode other than nearest, flushed subnormals, or a matrix product whose
        error exceeds its bound.
    """
    one, least = np.full(64, 1.0), np.full(64, LEAST)
    integers = np.array([k * 0x9E3779B97F4A7C15 % 2**54 - 2**53 for k in range(288)], dtype=object).reshape(2, 12, 12)
    A, B = integers.astype(np.float64)
    found = Near(B).through(A)
    products = zip(found.value.ravel(), (integers[0] @ integers[1]).ravel(), found.error.top.ravel(), strict=True)
    good = (
        np.all(one + U == 1.0)
        and np.all(one + 3 * U == 1.0 + 4 * U)
        and np.all(-one - U == -1.0)
        and np.all(one - U / 2 == 1.0)
        and np.all((least * 0.5) * 2 == least)
        and np.all(np.sqrt(one * 2) == float.fromhex("0x1.6a09e667f3bcdp+0"))
        and np.all(one / 3 == float.fromhex("0x1.5555555555555p-2"))
        and all(abs(int(product) - exact) <= bound for product, exact, bound in products)
    )
    if not good:
        raise ArithmeticError("this machine's binary64 arithmetic is not IEEE round-to-nearest with subnormals")
