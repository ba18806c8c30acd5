"""Third-order jets on a ball, in floats: how a plant's operations act on what rules `local` and `tube` bound.

On ||d|| <= 1 a value is `v(0) + a.d + d'Q d + K[d] + sum_j B_j e_j + r(d)`, |r(d)| <= d'E d, where K is symmetric of
order three, and the e_j are what is left of the inputs beyond their own third order: an error that drives several
components of F stays one error there (checker/FORMAT.md, models).

Symmetric matrices and forms of order three are rows of numbers in an orthonormal basis: less than a fourth of the room
and of the products, and the norm of a form is that of its row. A layer of a network is a batch of rows, and so are the
jets of one value on several balls around the same middle: an operation has few products, and costs more than they do.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.loop.activations import CERTAIN, fourth_of_tanh
from certify.loop.expressions import Algebra, evaluate
from certify.loop.networks import Observe
from certify.provers.bounds.taylor import EXP_END

Array = NDArray[np.float64]
ATAN4 = 4.7  # no derivative of this order is larger


@dataclass(frozen=True, slots=True, eq=False)
class Basis:
    """A basis of the symmetric forms of order two and three in k variables."""

    k: int
    pairs: tuple[NDArray[np.intp], ...]  # i <= j, of the entries of a matrix
    triples: tuple[NDArray[np.intp], ...]  # i <= j <= l
    scale: Array  # 1 or the root of 2, of each pair
    scale3: Array  # the root of how often a triple stands in a form
    others: tuple[NDArray[np.intp], ...]  # for each triple the pairs (j, l), (i, l) and (i, j)
    eye: Array
    unpacked: NDArray[np.intp]  # the pair of each entry of a matrix, (k, k)
    unpacked3: NDArray[np.intp]  # the triple of each entry of a form, (k, k, k)

    def square(self, a: Array) -> Array:
        """a a', one a row; a is (N, k)."""
        i, j = self.pairs
        return a[:, i] * a[:, j] * self.scale

    def cube(self, a: Array) -> Array:
        """(a.d)^3, one a row."""
        i, j, k = self.triples
        return a[:, i] * a[:, j] * a[:, k] * self.scale3

    def between(self, a: Array, b: Array) -> Array:
        """(a.d)(b.d), one a row."""
        i, j = self.pairs
        return (a[:, i] * b[:, j] + a[:, j] * b[:, i]) * (self.scale / 2)

    def times(self, a: Array, Q: Array) -> Array:
        """(a.d)(d'Q d), one a row."""
        plain = Q / self.scale
        found = sum(a[:, i] * plain[:, pair] for i, pair in zip(self.triples, self.others, strict=True))
        return np.asarray(found * (self.scale3 / 3))

    def matrices(self, Q: Array) -> Array:
        """Rows as matrices, (N, k, k)."""
        return (Q / self.scale)[:, self.unpacked]

    def forms(self, K: Array) -> Array:
        """Rows as symmetric forms of order three, (N, k, k, k)."""
        return (K / self.scale3)[:, self.unpacked3]


@cache
def basis(k: int) -> Basis:
    """The one for k variables."""
    i, j = np.triu_indices(k)
    pair = np.zeros((k, k), dtype=np.intp)
    pair[i, j] = pair[j, i] = np.arange(len(i))
    every = np.sort(np.stack(np.meshgrid(*3 * [np.arange(k)], indexing="ij"), -1).reshape(-1, 3), axis=1)
    triples, unpacked3, count = np.unique(every, axis=0, return_inverse=True, return_counts=True)
    p, q, r = triples.T
    return Basis(
        k,
        (i, j),
        (p, q, r),
        np.where(i == j, 1.0, math.sqrt(2)),
        np.sqrt(count),
        (pair[q, r], pair[p, r], pair[p, q]),
        (i == j).astype(np.float64),
        pair,
        unpacked3.reshape(k, k, k),
    )


@dataclass(frozen=True, slots=True)
class Sizes:
    """Norms of a value's parts, (N,): slope of a, bend of Q, twist of K, curve = bend + twist + ||E||."""

    slope: Array
    bend: Array
    twist: Array
    curve: Array

    @property
    def radius(self) -> Array:
        """No value of the ball is further from that at its middle."""
        return self.slope + self.curve


def sizes(a: Array, Q: Array, K: Array, E: Array) -> Sizes:
    """The sizes of rows a (N, k), and of Q, K, E in their basis."""
    slope, bend, twist, rest = (np.sqrt(np.einsum("ij,ij->i", part, part)) for part in (a, Q, K, E))
    return Sizes(slope, bend, twist, bend + twist + rest)


def beyond_tangent(a: Array, squares: Array, Q: Array, K: Array, second: Array, third: Array) -> tuple[Array, Array]:
    """The terms that a function adds to its tangent, but for its `remainder`: H and K, in rows.

    Parameters
    ----------
    squares : the squares of the gradients a, in their basis.
    second, third : (N,), phi''/2 and phi'''/6 at the middle.
    """
    b, x = basis(a.shape[1]), np.newaxis
    return second[:, x] * squares, 2 * second[:, x] * b.times(a, Q) + third[:, x] * b.cube(a)


def remainder(squares: Array, size: Sizes, E: Array, second: Array, third: Array, fourth: Array) -> Array:
    """R of what a function adds to its tangent, one a row.

    Parameters
    ----------
    squares : those of the gradients, in their basis.
    second, third : (N,), at or above |phi''|/2 and |phi'''|/6 at the middle.
    fourth : (N,), at or above |phi''''|/24 on the range.
    """
    x, slope, curve = np.newaxis, size.slope, size.curve
    eye = basis(math.isqrt(2 * squares.shape[1])).eye  # k (k + 1) / 2 pairs
    flat = size.twist[:, x] * eye + E
    wide = flat + size.bend[:, x] * eye
    m = fourth * size.radius**2
    spread = second * curve + third * (3 * slope * curve + curve**2) + m * (2 * slope + curve)
    along = 3 * third * curve + m
    return np.asarray((2 * second * slope)[:, x] * flat + spread[:, x] * wide + along[:, x] * squares)


def product_beyond(
    a: Array, Q: Array, K: Array, E: Array, of_a: Array, of_Q: Array, of_K: Array, of_E: Array
) -> tuple[Array, Array, Array]:
    """H, K and R of the products of rows of what values add to those at the middle; a single row stands for all."""
    rows = max(len(a), len(of_a))
    a, Q, K, E, of_a, of_Q, of_K, of_E = (
        np.broadcast_to(part, (rows, part.shape[1])) for part in (a, Q, K, E, of_a, of_Q, of_K, of_E)
    )
    b, x, p, q = basis(a.shape[1]), np.newaxis, sizes(a, Q, K, E), sizes(of_a, of_Q, of_K, of_E)
    left = p.slope * q.twist + p.twist * q.slope + (p.bend + p.twist) * (q.bend + q.twist)
    R = p.radius[:, x] * of_E + (q.slope + q.bend + q.twist)[:, x] * E + left[:, x] * b.eye
    return b.between(a, of_a), b.times(a, of_Q) + b.times(of_a, Q), R


def is_extreme(c: float) -> bool:
    """True if the powers of a middle c, that inverses and roots have derivatives of, may leave binary64."""
    return not 2.0**-200 < abs(c) < 2.0**200


def of_inputs(B: Array, errors: Array, like: Array) -> Array:
    """The bound of B (1, m) times the e_j, a row for each ball as `like` has them."""
    return np.asarray((np.abs(B) @ errors).reshape(like.shape))


@dataclass(frozen=True, slots=True)
class Jet:
    """A value on N balls around the same middle: a is (N, k), Q, K and E are rows in their basis, and B is (1, m).
    `errors` has the E of each e_j: m rows, in each those of all balls one after the other."""

    c: float
    a: Array
    Q: Array
    K: Array
    B: Array
    E: Array
    errors: Array

    @property
    def rest(self) -> Array:
        """The bound of all that is left, the e_j with it."""
        return self.E + of_inputs(self.B, self.errors, self.E)

    @property
    def sizes(self) -> Sizes:
        return sizes(self.a, self.Q, self.K, self.rest)

    @property
    def radius(self) -> Array:
        return self.sizes.radius

    def __add__(self, other: Jet) -> Jet:
        x, y = self, other
        return Jet(x.c + y.c, x.a + y.a, x.Q + y.Q, x.K + y.K, x.B + y.B, x.E + y.E, x.errors)

    def __mul__(self, other: Jet) -> Jet:
        x, y, b, rows = self, other, basis(self.a.shape[1]), np.newaxis
        p, q = x.sizes, y.sizes
        Q = x.c * y.Q + y.c * x.Q + b.between(x.a, y.a)
        K = x.c * y.K + y.c * x.K + b.times(x.a, y.Q) + b.times(y.a, x.Q)
        left = p.slope * q.twist + p.twist * q.slope + (p.bend + p.twist) * (q.bend + q.twist)
        both = p.radius[:, rows] * y.rest + (q.slope + q.bend + q.twist)[:, rows] * x.rest
        E = abs(x.c) * y.E + abs(y.c) * x.E + both + left[:, rows] * b.eye
        return Jet(x.c * y.c, x.c * y.a + y.c * x.a, Q, K, x.c * y.B + y.c * x.B, E, x.errors)

    def compose(self, f0: float, f1: float, f2: float, f3: float, fourth: Array) -> Jet:
        """A function's value and derivatives at c, and at least |phi''''|/24 on each ball's range or on all."""
        a, Q, K = self.a, self.Q, self.K
        second, third = np.array([f2 / 2]), np.array([f3 / 6])
        squares = basis(a.shape[1]).square(a)
        H, cubic = beyond_tangent(a, squares, Q, K, second, third)
        R = remainder(squares, self.sizes, self.rest, np.abs(second), np.abs(third), fourth)
        return Jet(f0, f1 * a, f1 * Q + H, f1 * K + cubic, f1 * self.B, abs(f1) * self.E + R, self.errors)

    def _nowhere(self) -> Jet:
        """The jet on all balls if one of them has no finite model."""
        return Jet(math.nan, self.a, self.Q, self.K, self.B, self.E + math.inf, self.errors)

    def inverse(self) -> Jet:
        c, least = self.c, abs(self.c) - self.radius
        if not np.all(least > 0) or is_extreme(c):
            return self._nowhere()
        return self.compose(1 / c, -1 / c**2, 2 / c**3, -6 / c**4, 1 / (c**4 * least))  # D^4 / (c^4 v) is what is left

    def sqrt(self) -> Jet:
        least = self.c - self.radius
        if not np.all(least > 0) or is_extreme(self.c):
            return self._nowhere()
        s, w = math.sqrt(self.c), np.sqrt(least)
        fourth = (5 * s**2 + 4 * s * w + w**2) / (16 * s**5 * (s + w) ** 4)  # the remainder of a root w, over D^4
        return self.compose(s, 1 / (2 * s), -1 / (4 * s**3), 3 / (8 * s**5), fourth)

    def abs(self) -> Jet:
        if not np.all(abs(self.c) > CERTAIN * self.radius):
            return self._nowhere()
        return self.compose(abs(self.c), math.copysign(1.0, self.c), 0.0, 0.0, np.zeros(1))

    def exp(self) -> Jet:
        end = self.c + self.radius
        if not np.all(end < EXP_END):
            return self._nowhere()
        e = math.exp(self.c)
        return self.compose(e, e, e, e, np.exp(end) / 24)

    def tanh(self) -> Jet:
        t = math.tanh(self.c)
        slope = 1 - t * t
        fourth = fourth_of_tanh(np.array(self.c), self.radius)
        return self.compose(t, slope, -2 * t * slope, (6 * t * t - 2) * slope, fourth)

    def atan(self) -> Jet:
        slope = 1 / (1 + self.c**2)
        f3 = (6 * self.c**2 - 2) * slope**3
        return self.compose(math.atan(self.c), slope, -2 * self.c * slope**2, f3, np.array([ATAN4 / 24]))

    def sin(self) -> Jet:
        if math.isinf(self.c):
            return self._nowhere()
        s, c = math.sin(self.c), math.cos(self.c)
        return self.compose(s, c, -s, -c, np.minimum(1.0, abs(s) + self.radius) / 24)

    def cos(self) -> Jet:
        if math.isinf(self.c):
            return self._nowhere()
        s, c = math.sin(self.c), math.cos(self.c)
        return self.compose(c, -s, -c, s, np.minimum(1.0, abs(c) + self.radius) / 24)


class Jets(Algebra[Jet]):
    """Jets in k variables on N balls, with the errors that they share."""

    def __init__(self, N: int, k: int, errors: Array) -> None:
        b = basis(k)
        nothing = (np.zeros((N, k)), np.zeros((N, len(b.eye))), np.zeros((N, len(b.scale3))))
        self._parts = (*nothing, np.zeros((1, len(errors))), np.zeros((N, len(b.eye))), errors)

    def constant(self, q: Fraction) -> Jet:
        return Jet(float(q), *self._parts)

    def state(self, value: float, rows: Array) -> Jet:
        """A value at the middle and its gradients, (N, k)."""
        _, *others = self._parts
        return Jet(value, rows, *others)

    def input(self, number: int, value: float, a: Array, Q: Array, K: Array) -> Jet:
        """An input's model, without its error, which is e of its number."""
        *_, nothing, errors = self._parts
        return Jet(value, a, Q, K, np.eye(len(errors))[number][None], nothing, errors)


def observed(step: Observe, y: Array, G: Array, Q: Array, K: Array, E: Array) -> tuple[Array, ...]:
    """Values (M,), gradients, Q, K and E, a row each, of an observation's M expressions at entries that have such."""
    algebra, none = Jets(1, G.shape[1], np.zeros((0, E.shape[1]))), np.zeros((1, 0))
    entries = [
        Jet(float(y[i]), G[i][None], Q[i][None], K[i][None], none, E[i][None], none.T @ E[:1]) for i in range(len(y))
    ]
    values, shared = dict(zip(step.symbols, entries, strict=True)), dict[Any, Jet]()
    made = [evaluate(e, values, algebra, shared) for e in step.expressions]
    parts = (np.concatenate([getattr(jet, part) for jet in made]) for part in ("a", "Q", "K", "E"))
    return np.array([jet.c for jet in made]), *parts
