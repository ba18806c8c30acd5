"""Bounds on boxes by slopes, in plain floats, for the search; Coq's check computes them with outward rounding.

A quantity q on a box with centre c has a range, its value at c, and slopes g: `q(z) - q(c)` is `sum of g_k (z_k - c_k)`
with g_k in an interval, for every z of the box. The range is cut with the bound by slopes. Many
boxes are treated at once: the first axis of every array is that of the boxes. Nothing here is a proof.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from operator import add
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.certificates.coq.data import Claimed
from certify.certificates.coq.expression import Expression

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Interval:
    """Lower and upper ends; where the lower exceeds the upper end, or either is not a number, nothing is known."""

    lo: Array
    hi: Array

    def __add__(self, other: Interval) -> Interval:
        return Interval(self.lo + other.lo, self.hi + other.hi)

    def __neg__(self) -> Interval:
        return Interval(-self.hi, -self.lo)

    def __sub__(self, other: Interval) -> Interval:
        return self + -other

    def __mul__(self, other: Interval) -> Interval:
        products = (self.lo * other.lo, self.lo * other.hi, self.hi * other.lo, self.hi * other.hi)
        return Interval(np.minimum.reduce(products), np.maximum.reduce(products))

    def scaled(self, factor: Any) -> Interval:
        """Times exact numbers."""
        return self * Interval(np.asarray(factor), np.asarray(factor))

    def __getitem__(self, where: Any) -> Interval:
        return Interval(self.lo[where], self.hi[where])

    def cut(self, other: Interval) -> Interval:
        """The intersection of both intervals."""
        return Interval(np.maximum(self.lo, other.lo), np.minimum(self.hi, other.hi))

    def total(self) -> Interval:
        """Summed over the last axis."""
        return Interval(self.lo.sum(-1), self.hi.sum(-1))

    def through(self, matrix: Array) -> Interval:
        """A matrix (out, in) times the last axis but one of columns (..., in, k)."""
        up, down = np.maximum(matrix, 0), np.minimum(matrix, 0)
        return Interval(up @ self.lo + down @ self.hi, up @ self.hi + down @ self.lo)

    @property
    def magnitude(self) -> Array:
        """The largest absolute value."""
        return np.maximum(np.abs(self.lo), np.abs(self.hi))


@dataclass(frozen=True, slots=True)
class Boxes:
    """Boxes in z: centres and half-widths, (N, n) each."""

    centre: Array
    half: Array

    def coordinates(self) -> Quantity:
        """z itself, as a quantity with n entries."""
        slopes = np.broadcast_to(np.eye(self.centre.shape[1]), (*self.centre.shape, self.centre.shape[1]))
        return Quantity(
            self, Interval(self.centre - self.half, self.centre + self.half), self.centre, Interval(slopes, slopes)
        )

    def spread(self, slopes: Interval) -> Array:
        """The largest change of a quantity with these slopes (N, ..., n) from its value at the centre, (N, ...)."""
        half = self.half.reshape(len(self.half), *(1,) * (slopes.lo.ndim - 2), -1)
        return np.asarray((slopes.magnitude * half).sum(-1))


@dataclass(frozen=True, slots=True)
class Quantity:
    """Numbers on boxes: `range` (N, ...), `value` at the centres (N, ...), `slopes` (N, ..., n)."""

    boxes: Boxes
    range: Interval
    value: Array
    slopes: Interval

    def __getitem__(self, place: int) -> Quantity:
        """An entry of a vector."""
        return Quantity(self.boxes, self.range[:, place], self.value[:, place], self.slopes[:, place])

    def cut(self) -> Quantity:
        """Cut the range with the bound by slopes."""
        spread = self.boxes.spread(self.slopes)
        near = Interval(self.value - spread, self.value + spread)
        return Quantity(self.boxes, self.range.cut(near), self.value, self.slopes)

    def plus(self, number: Any) -> Quantity:
        """Exact numbers added."""
        moved = Interval(self.range.lo + number, self.range.hi + number)
        return Quantity(self.boxes, moved, self.value + number, self.slopes)

    def times(self, number: Any) -> Quantity:
        """Times exact numbers, one an entry or one for all."""
        factor = np.asarray(number, dtype=np.float64)
        return Quantity(
            self.boxes, self.range.scaled(factor), self.value * factor, self.slopes.scaled(factor[..., None])
        )

    def __add__(self, other: Quantity) -> Quantity:
        """The sum, whose range is not cut."""
        return Quantity(self.boxes, self.range + other.range, self.value + other.value, self.slopes + other.slopes)

    def __mul__(self, other: Quantity) -> Quantity:
        wide = Interval(other.range.lo[..., None], other.range.hi[..., None])
        slopes = self.slopes * wide + other.slopes.scaled(self.value[..., None])
        return Quantity(self.boxes, self.range * other.range, self.value * other.value, slopes).cut()

    def through(self, matrix: Array, bias: Array | float = 0.0) -> Quantity:
        """A matrix times the vector, plus a bias."""
        column = Interval(self.range.lo[..., None], self.range.hi[..., None]).through(matrix)[..., 0]
        moved = Interval(column.lo + bias, column.hi + bias)
        return Quantity(self.boxes, moved, self.value @ matrix.T + bias, self.slopes.through(matrix)).cut()

    def after(self, outer: Interval, value: Array, derivative: Interval) -> Quantity:
        """A function of it: its range, its values, and the range of its slopes."""
        wide = Interval(derivative.lo[..., None], derivative.hi[..., None])
        return Quantity(self.boxes, outer, value, self.slopes * wide).cut()

    def tanh(self) -> Quantity:
        lo, hi = np.tanh(self.range.lo), np.tanh(self.range.hi)
        square = _square(Interval(lo, hi))
        return self.after(Interval(lo, hi), np.tanh(self.value), Interval(1 - square.hi, 1 - square.lo))

    def function(self, name: str) -> Quantity:
        """One of the functions of an equation, by its name; `inv` is one of them."""
        lo, hi, value = self.range.lo, self.range.hi, self.value
        match name:
            case "tanh":
                return self.tanh()
            case "sin":
                return self.after(_sine(self.range), np.sin(value), _sine(self.range, np.pi / 2))
            case "cos":
                return self.after(_sine(self.range, np.pi / 2), np.cos(value), -_sine(self.range))
            case "exp":
                return self.after(Interval(np.exp(lo), np.exp(hi)), np.exp(value), Interval(np.exp(lo), np.exp(hi)))
            case "atan":
                square = _square(self.range)
                slope = Interval(1 / (1 + square.hi), 1 / (1 + square.lo))
                return self.after(Interval(np.arctan(lo), np.arctan(hi)), np.arctan(value), slope)
            case "sqrt":
                known = lo > 0
                roots = [np.where(known, np.sqrt(np.where(known, end, 1)), np.nan) for end in (lo, hi, value)]
                slope = Interval(1 / (roots[1] + roots[2]), 1 / (roots[0] + roots[2]))
                return self.after(Interval(roots[0], roots[1]), roots[2], slope)
        known = (lo > 0) | (hi < 0)
        ends = [np.where(known, 1 / np.where(known, end, 1), np.nan) for end in (hi, lo, value)]
        slope = -Interval(ends[0], ends[1]).scaled(ends[2])
        return self.after(Interval(ends[0], ends[1]), ends[2], slope)

    def power(self, exponent: int) -> Quantity:
        """To a positive integer power."""
        slope = _power(self.range, exponent - 1).scaled(float(exponent))
        return self.after(_power(self.range, exponent), self.value**exponent, slope)

    def constant(self, number: float) -> Quantity:
        """A number, as a quantity on the same boxes."""
        full = np.full_like(self.value, number)
        nothing = np.zeros_like(self.slopes.lo)
        return Quantity(self.boxes, Interval(full, full), full, Interval(nothing, nothing))


def _square(a: Interval) -> Interval:
    return _power(a, 2)


def _power(a: Interval, k: int) -> Interval:
    if k == 0:
        return Interval(np.ones_like(a.lo), np.ones_like(a.lo))
    lo, hi = a.lo**k, a.hi**k
    if k % 2:
        return Interval(lo, hi)
    crosses = (a.lo <= 0) & (a.hi >= 0)
    return Interval(np.where(crosses, 0.0, np.minimum(lo, hi)), np.maximum(lo, hi))


def _sine(a: Interval, shift: float = 0.0) -> Interval:
    """sin(a + shift)."""
    lo, hi = a.lo + shift, a.hi + shift
    ends = np.sin(lo), np.sin(hi)
    top = np.floor((hi - np.pi / 2) / (2 * np.pi)) >= np.ceil((lo - np.pi / 2) / (2 * np.pi))
    bottom = np.floor((hi + np.pi / 2) / (2 * np.pi)) >= np.ceil((lo + np.pi / 2) / (2 * np.pi))
    return Interval(np.where(bottom, -1.0, np.minimum(*ends)), np.where(top, 1.0, np.maximum(*ends)))


@dataclass(frozen=True, slots=True)
class Bounds:
    """Bounds of a loop on boxes: the inputs, F, V and Vdot, and V from its formula alone."""

    inputs: tuple[Quantity, ...]
    F: tuple[Quantity, ...]
    V: Quantity
    Vdot: Quantity
    V_plain: Interval


def inputs_of(claimed: Claimed, x: Quantity) -> tuple[Quantity, ...]:
    """The policy."""
    network = claimed.network
    at_0 = network.net(np.zeros(claimed.n))
    shift, offset = np.zeros(network.m), network.offset
    u_eq = np.array([float(u) for u in claimed.u_eq])
    if network.centre == "preactivation":
        shift = network.beta(claimed.u_eq) - at_0
    if network.centre == "output":
        offset = u_eq - network.scale * network.squashed(at_0)
    y = x
    for k, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        y = (y.tanh() if k else y).through(weight, bias)
    y = y.plus(shift)
    u = (y.tanh() if network.squash == "tanh" else y).times(network.scale).plus(offset)
    return tuple(u[j] for j in range(network.m))


def field_of(claimed: Claimed, x: Quantity, inputs: Sequence[Quantity]) -> tuple[Quantity, ...]:
    """F(x), an entry a state."""
    known: dict[Expression, Quantity] = {}
    return tuple(_evaluate(e, x, inputs, known) for e in claimed.field)


def _evaluate(e: Expression, x: Quantity, inputs: Sequence[Quantity], known: dict[Expression, Quantity]) -> Quantity:
    if e not in known:
        known[e] = _value(e, [_evaluate(a, x, inputs, known) for a in e.operands], x, inputs)
    return known[e]


def _value(e: Expression, operands: list[Quantity], x: Quantity, inputs: Sequence[Quantity]) -> Quantity:
    match e.kind:
        case "state":
            return x[e.index]
        case "input":
            return inputs[e.index]
        case "const":
            return x[0].constant(float(e.number))
        case "add":
            return (operands[0] + operands[1]).cut()
        case "neg":
            return operands[0].times(-1.0)
        case "mul":
            return operands[0] * operands[1]
        case "pow":
            return operands[0].power(e.index)
    return operands[0].function(e.kind)


def bounds(claimed: Claimed, T: Array, boxes: Boxes) -> Bounds:
    """The closed loop on boxes of z, x = T z."""
    z = boxes.coordinates()
    x = z.through(T)
    inputs = inputs_of(claimed, x)
    F = field_of(claimed, x, inputs)
    Y = claimed.P @ T
    S = T.T @ Y
    y, Sz = z.through(Y), z.through(S)
    Vdot = reduce(add, [y[i] * F[i] for i in range(claimed.n)])
    V = reduce(add, [z[i] * Sz[i] for i in range(claimed.n)])
    plain = _form(S, z.range)
    return Bounds(inputs, F, Quantity(boxes, plain.cut(V.range), V.value, V.slopes).cut(), Vdot.times(2.0), plain)


def _form(S: Array, z: Interval) -> Interval:
    """z'S z, product by product."""
    products = z[:, :, None] * z[:, None, :]
    square = _square(z)
    eye = np.eye(len(S), dtype=bool)
    lo, hi = np.where(eye, square.lo[:, :, None], products.lo), np.where(eye, square.hi[:, :, None], products.hi)
    return Interval(lo, hi).scaled(S).total().total()
