"""Second-order Taylor models on a box, batched: what the rules for leaves evaluate the plant in.

A model of a function v over symbols d in [-1, 1]^N is `v(d) in c + g.d + sum_(i <= j) q_ij d_i d_j + [-r, r]`. The
symbols are the box coordinates of the leaf and one error symbol for each input. c, g and q are numbers that mean
themselves; r bounds the rest: all terms of third order, and the roundings of c, g and q. Below, G = sum |g_i| and
H = sum |q_ij|. Arrays carry the batch on their last axis.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cache, cached_property, reduce
from math import isqrt
from operator import add
from typing import Any

import numpy as np

from .functions import FUNCTIONS, Derivative, Expansion
from .near import ZERO, Above, Array, Form, Near, combined, near, products, size

_NOISE = 2.0**-30  # of all coefficients


@cache
def pairs(N: int) -> tuple[Array, Array]:
    """i and j of the terms of second order, i <= j."""
    i, j = np.triu_indices(N)
    return i, j


@dataclass(frozen=True)
class Taylor:
    """`c` (B,), the coefficients `p` (N + N (N + 1) / 2, B), g and then q as `pairs` has them, and remainder `r`."""

    c: Array
    p: Array
    r: Above

    @cached_property
    def symbols(self) -> int:
        """N."""
        return (isqrt(9 + 8 * len(self.p)) - 3) // 2

    @property
    def g(self) -> Array:
        return self.p[: self.symbols]

    @property
    def q(self) -> Array:
        return self.p[self.symbols :]

    @cached_property
    def linear(self) -> Above:
        """G."""
        return size(self.g).sum()

    @cached_property
    def quadratic(self) -> Above:
        """H."""
        return size(self.q).sum()

    @cached_property
    def beyond(self) -> Form:
        """v - c without the remainder."""
        found = Form(self.p)
        found.size = self.linear + self.quadratic
        return found

    @cached_property
    def moved(self) -> Above:
        """Upper bound of |v - c| on the box."""
        return self.beyond.size + self.r

    @cached_property
    def size(self) -> Above:
        """Upper bound of |v| on the box."""
        return size(self.c) + self.moved

    @property
    def range(self) -> Near:
        """v as a number."""
        return Near(self.c, self.moved)

    def at(self, index: Array) -> Taylor:
        """The models of some members of the batch."""
        return Taylor(self.c[..., index], self.p[..., index], self.r[..., index])

    def widened(self, symbols: int) -> Taylor:
        """The same among so many symbols, of which those that come after its own do not matter to it."""
        if symbols == self.symbols:
            return self
        i, j = pairs(symbols)
        p = np.zeros((symbols + len(i), *self.p.shape[1:]))
        p[: self.symbols] = self.g
        p[symbols + np.flatnonzero((i < self.symbols) & (j < self.symbols))] = self.q
        return Taylor(self.c, p, self.r)

    def __add__(self, other: Taylor) -> Taylor:
        return combination((1.0, self), (1.0, other))

    def __neg__(self) -> Taylor:
        return Taylor(-self.c, -self.p, self.r)

    def scaled(self, k: Any) -> Taylor:
        """Product with an exact number, or with one for each member of the batch (B,)."""
        return combination((k, self))

    def __mul__(self, other: Taylor) -> Taylor:
        found = self.short_of(other)
        return Taylor(found.c, found.p, found.r + self.third(other))

    def third(self, other: Taylor) -> Above:
        """Upper bound of what is of third order in the product, term by term."""
        return self.linear * other.quadratic + self.quadratic * other.linear

    def short_of(self, other: Taylor) -> Taylor:
        """The product without that. r bounds constants times remainders, all of fourth order, and remainders times the
        rest."""
        a, b = self, other
        c, ca, cb = a.c * b.c, size(a.c), size(b.c)
        r = ca * b.r + cb * a.r + a.quadratic * b.quadratic
        r = r + a.r * b.moved + b.r * a.beyond.size
        p, wrong = combined((a.c, b.beyond), (b.c, a.beyond), (1.0, a.squared(b)))
        return Taylor(c, p, r + wrong + size(c).ulps(1))

    def squared(self, other: Taylor) -> Form:
        """The terms of second order in the product of what is of first order."""
        return products(self.g, other.g, self.linear * other.linear, *pairs(self.symbols))

    def function(self, name: str) -> Taylor:
        """phi(v) for a function phi of the table."""
        return self.composed(FUNCTIONS[name].expansion(Near(self.c), self.moved))

    def composed(self, phi: Expansion | Derivative) -> Taylor:
        """phi(v) = f0 + f1 D + f2 D^2 + R, v = c + D, |R| <= third |D|^3, for phi expanded at c where |D| <= `moved`.

        D^2 differs from (g.d)^2 by at most 2 G w + w^2, w = H + r.
        """
        f0, f1, f2 = phi.stored
        w, D = self.quadratic + self.r, self.moved
        p, wrong = combined((f1.value, self.beyond), (f2.value, self.squared(self)))
        r = f1.size * self.r + f1.error * D + f2.size * ((self.linear * 2 + w) * w)
        r = r + (f2.error + phi.third * D) * (D * D) + f0.error + wrong
        return Taylor(f0.value, p, r)


def combination(*terms: tuple[Any, Taylor]) -> Taylor:
    """`sum_t k_t v_t` for exact numbers k_t, or one for each member of the batch."""
    c, off = combined(*((k, Near(v.c, v.r)) for k, v in terms))
    p, wrong = combined(*((k, v.beyond) for k, v in terms))
    return Taylor(c, p, off + wrong)


def inner_product(x: Sequence[Taylor], y: Sequence[Taylor]) -> Taylor:
    """A model that is at least sum_i x_i y_i, and of which nothing else is known.

    The coefficients of third order of all products are summed up before their magnitudes are taken, in 2 n + 3
    roundings or fewer. Of each magnitude a third goes to d_i^2, d_j^2 and d_k^2: |d_i d_j d_k| is at most their mean.
    """
    found = reduce(add, [v.short_of(w) for v, w in zip(x, y, strict=True)])
    N, T = found.symbols, np.zeros((found.symbols, *found.q.shape))
    for v, w in zip(x, y, strict=True):
        T += v.g[:, None] * w.q + w.g[:, None] * v.q
    T = T.reshape(N * len(found.q), -1)
    places, there, own = _triples(N)
    cubic = sum(there[k][:, None] * T[places[k]] for k in range(3))
    all_terms = reduce(add, [v.third(w) for v, w in zip(x, y, strict=True)])
    third, p = size(cubic) * np.nextafter(1 / 3, 1), found.p.copy()
    squares = np.array([third[terms].sum().top for terms in own])
    i, j = pairs(N)
    p[N:][i == j] = (Near(found.q[i == j]) + Near(squares)).ends[1]
    return Taylor(found.c, p, found.r + all_terms.ulps(2 * len(x) + 3))


@cache
def _triples(N: int) -> tuple[Array, Array, list[Array]]:
    """The K terms d_i d_j d_k, i <= j <= k: the places (3, K) in an array (N, pairs) of what d_i, d_j and d_k are
    multiplied by there, 1 where such a place is another one, else 0; and for each index the terms that have it, as
    often as they do."""
    pair, index = np.zeros((N, N), dtype=np.intp), np.arange(N)
    pair[pairs(N)] = np.arange(len(pairs(N)[0]))
    i, j, k = np.nonzero((index[:, None, None] <= index[:, None]) & (index[:, None] <= index))
    places = np.array([(N * (N + 1) // 2) * a + pair[b, c] for a, b, c in ((i, j, k), (j, i, k), (k, i, j))])
    own = [np.concatenate([np.flatnonzero(each == one) for each in (i, j, k)]) for one in range(N)]
    return places, np.array([np.ones(len(i)), i < j, j < k]), own


def affine(c: Array, g: Array, r: Above = ZERO) -> Taylor:
    """c + g.d within r, c (B,), g (N, B)."""
    N = len(g)
    return Taylor(c, np.concatenate([g, np.zeros((N * (N + 1) // 2, *g.shape[1:]))]), r)


def constant(q: Fraction, symbols: int, batch: int) -> Taylor:
    """A rational, the same over the batch."""
    number = near(q)
    return affine(np.full(batch, number.value), np.zeros((symbols, batch)), number.error)


def constants(like: Taylor) -> Callable[[Fraction], Taylor]:
    """The function that gives a rational's model among such models."""
    return lambda q: constant(q, like.symbols, like.c.shape[-1])


def models(h: Form, error: Above) -> list[Taylor]:
    """The entries of a vector as models."""
    wide = error.top + 0 * h.value[0]
    return [affine(h.value[0, i], h.value[1:, i], Above(wide[i])) for i in range(h.value.shape[1])]


def forms(v: Sequence[Taylor]) -> Form:
    """Models as forms: what is of second order becomes an error."""
    value = np.stack([np.concatenate([x.c[None], x.g]) for x in v], 1)
    return Form(value, Above(np.stack([(x.r + x.quadratic).top + 0 * x.c for x in v])))


def upper_bound(model: Taylor) -> Array:
    """An upper bound of the model over the box, (B,); the lesser of two. Each bounds the terms in two symbols by terms
    in one."""
    bound = _by_squares(model)
    left = np.flatnonzero(np.logical_not(bound < 0))
    if len(left):
        bound[left] = np.fmin(bound[left], _at_a_corner(model.at(left)))
    return bound


def _by_squares(model: Taylor) -> Array:
    """`2 |d_i d_j| <= d_i^2 + d_j^2`."""
    (i, j), q = pairs(model.symbols), model.q
    squares = Near(q[i == j]) + Near(np.abs(q[i != j])).through(_half(model.symbols))
    return _added(Near(model.c), size(model.g), squares, model.r)


def _at_a_corner(model: Taylor) -> Array:
    """For a corner s, of 1 and -1, and d_i = s_i e_i: `2 e_i e_j <= e_i^2 + e_j^2`, and `-e_i e_j <= 1 - e_i - e_j`
    since (1 - e_i) (1 - e_j) >= 0. So a pair takes the first or the second as s_i s_j q_ij is positive or negative."""
    (i, j), s, half = pairs(model.symbols), _corner(model), _half(model.symbols)
    mixed = (s[i] * s[j] * model.q)[i != j]
    up, down = np.maximum(mixed, 0.0), np.maximum(-mixed, 0.0)
    along = Near(s * model.g) - Near(2 * down).through(half)
    squares = Near(model.q[i == j]) + Near(up).through(half)
    return _added(Near(model.c) + Near(down).sum(), along.size, squares, model.r)


def _added(c: Near, along: Above, squares: Near, r: Above) -> Array:
    """Upper bounds of `c + sum_i (a_i t_i + b_i t_i^2) + r` over |t_i| <= 1, for numbers a and b of at most the sizes
    `along` and the values `squares`: each term is largest at t_i = a_i / (-2 b_i), or else at 1."""
    a, b = along.top, squares.ends[1]
    inside = a < -2 * b
    peak = (size(a) * size(a)).over(np.where(inside, -4 * b, 1.0)).top
    most = Near(np.where(inside, peak, (Near(a) + Near(b)).ends[1]))
    found: Array = (c + most.sum() + Near(0 * c.value, r)).ends[1]
    return found


@cache
def _half(N: int) -> Array:
    """1/2 for each symbol of a term in two: (N, N (N - 1) / 2)."""
    i, j = pairs(N)
    i, j = i[i != j], j[i != j]
    half = np.zeros((N, len(i)))
    half[i, np.arange(len(i))] = half[j, np.arange(len(i))] = 0.5
    return half


def _corner(model: Taylor) -> Array:
    """The corner to which the gradient points, of 1 and -1. Multipliers make coefficients of about 0, whose signs are
    noise: there the terms of second order decide, with the other signs."""
    g, (i, j) = model.g, pairs(model.symbols)
    s = np.where(np.abs(g) <= _NOISE * np.sum(np.abs(g), axis=0), 0.0, np.where(g < 0, -1.0, 1.0))
    mixed, slope = np.where((i == j)[:, None], 0.0, model.q), np.zeros_like(g)
    np.add.at(slope, i, mixed * s[j])
    np.add.at(slope, j, mixed * s[i])
    return np.where(s == 0, np.where(slope < 0, -1.0, 1.0), s)
