"""What the rules compute with: binary64 numbers or Arb balls, under the same names.

The rules are written once. Each formula bounds its own roundings, as if every operation were rounded to nearest. Under
`arb`, `carry` turns the numbers from which they start into balls (object arrays), and every operation that follows is
done in balls as well: what a formula adds for roundings is then superfluous, and a term forgotten there does no
harm. Any mixture is an enclosure: a formula on binary64 numbers stands by itself, and a ball with a binary64
number gives a ball. But a ball must never become a binary64 number, except through `middle`, for choices on which no
bound depends; and of two balls that overlap, `np.maximum` would take either.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from flint import arb, arb_mat

from . import float64
from .float64 import spectral_norm

Number = Any  # a binary64 number, a ball, or an array of either


def is_ball(x: Number) -> bool:
    """True for a ball or an array of balls."""
    return np.asarray(x).dtype == object


def carry(x: Number, arithmetic: str) -> Number:
    """Binary64 numbers in the arithmetic of that name."""
    return _ball(x) if arithmetic == "arb" else x


def _either(in_balls: Callable[..., Any], in_float64: Callable[..., Any]) -> Callable[..., Any]:
    def choose(x: Number, *rest: Number) -> Any:
        return (in_balls if any(map(is_ball, (x, *rest))) else in_float64)(x, *rest)

    return choose


def _each(function: Callable[..., arb], operands: int = 1) -> Any:
    return np.frompyfunc(lambda *x: function(*map(arb, x)), operands, 1)


_ball, _sqrt, _larger = _each(arb), _each(arb.sqrt), _each(arb.max, 2)
_smaller = _each(lambda x, y: x if x < y else y, 2)
_lower, _upper, _magnitude = _each(arb.lower), _each(arb.upper), _each(arb.abs_upper)
_tanh, _sin, _cos = _each(arb.tanh), _each(arb.sin), _each(arb.cos)


def _total(x: Number, axis: int) -> Number:
    return _magnitude(np.sum(_ball(x), axis=axis))


def _product(A: Number, B: Number) -> Number:
    left, right = (arb_mat([list(map(arb, row)) for row in np.asarray(M).tolist()]) for M in (A, B))
    return np.array((left * right).tolist(), dtype=object)


up = _either(_magnitude, float64.up)
total = _either(_total, float64.total)
norm = _either(lambda x, axis: _magnitude(_sqrt(_total(x * x, axis))), float64.norm)
maximum = _either(_larger, np.maximum)
lesser = _either(_smaller, lambda x, y: np.where(x < y, x, y))  # of two upper bounds: either one will do
largest = _either(lambda x, axis: _larger.reduce(x, axis=axis), lambda x, axis: np.max(x, axis=axis))
product = _either(_product, np.matmul)  # of matrices
tanh = _either(lambda y: (_tanh(y), 0.0), float64.tanh)
sin_cos = _either(lambda y: (_sin(y), _cos(y), 0.0, 0.0), float64.sin_cos)
middle = _either(np.vectorize(lambda x: float(arb(x).mid()), otypes=[float]), np.asarray)
ends = _either(lambda c, r: (_lower(c - r), _upper(c + r)), float64.ends)


def frobenius(G: Number) -> Number:
    """An upper bound of ||G||_F, G (..., n, n)."""
    return norm(norm(G, -1), -1)


def spectral(G: Number) -> Number:
    """An upper bound of ||G||_2, G a matrix."""
    return up(spectral_norm(middle(G)) + frobenius(up(np.abs(G - middle(G)))))
