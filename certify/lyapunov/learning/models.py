"""Functions with free parameters, and the derivatives in the parameters of values and of slopes along a vector.

Fits of a few hundred parameters to a few thousand rows converge in seconds by Levenberg's and Marquardt's method where
descent by gradients takes minutes. It needs the rows' derivatives, one row per sample, which this module computes; a
polynomial, whose rows do not depend on the parameters, is the linear case.

States are scaled, z = x / scale, so that numbers are about 1.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from certify.errors import OptionError
from certify.lyapunov.neural import Neural
from certify.lyapunov.polynomial import MAX_DEGREE, Polynomial, monomials

Array = NDArray[np.float64]
_GAIN, _BIAS, _LAST = 1.2, 0.6, 0.5  # of random layers: tanh is bent, and the function about as large as its target


class Model(Protocol):
    """A function of z with parameters p (k,)."""

    def initial(self, generator: np.random.Generator) -> Array:
        """Parameters from which a fit may start, (k,)."""

    def function(self, p: Array, scale: Array | None = None) -> Neural | Polynomial:
        """The function of z, or of x = scale z."""

    def value_rows(self, p: Array, z: Array) -> Array:
        """Derivatives in p, (B, k), of the values at states (B, n)."""

    def slope_rows(self, p: Array, z: Array, v: Array) -> Array:
        """Derivatives in p, (B, k), of the derivatives along vectors v (B, n) at states (B, n)."""


@dataclass(frozen=True, slots=True)
class Network:
    """A tanh network whose last layer is affine, with one output.

    Parameters
    ----------
    n : number of states.
    hidden : widths of the layers between the states and the output, at least one.

    Raises
    ------
    InputError : a width is not positive, or there is none.
    """

    n: int
    hidden: tuple[int, ...]

    def __post_init__(self) -> None:
        if not self.hidden or min(self.hidden) < 1:
            raise OptionError(f"`hidden` must be positive widths, at least one; found {self.hidden}.")

    def initial(self, generator: np.random.Generator) -> Array:
        """Random layers."""
        parts, before = [], self.n
        for width in self.hidden:
            weight, bias = generator.normal(size=(width, before)), generator.normal(size=width)
            parts += [weight.ravel() * _GAIN / before**0.5, bias * _BIAS]
            before = width
        return np.concatenate([*parts, generator.normal(size=before) * _LAST / before**0.5, np.zeros(1)])

    def function(self, p: Array, scale: Array | None = None) -> Neural:
        """The network of z, or of x."""
        weights, biases = self._layers(p)
        return Neural(weights if scale is None else (weights[0] / scale, *weights[1:]), biases)

    def value_rows(self, p: Array, z: Array) -> Array:
        """By the chain rule, backwards."""
        weights, biases = self._layers(p)
        h = [z]
        for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
            h.append(np.tanh(h[-1] @ weight.T + bias))
        parts: list[Array] = []
        y = np.ones((len(z), 1))  # dN/dy of a layer's output y before its tanh
        for k in reversed(range(len(weights))):
            parts = [_outer(y, h[k]), y, *parts]
            if k:
                y = (y @ weights[k]) * (1 - h[k] ** 2)
        return np.concatenate(parts, axis=1)

    def slope_rows(self, p: Array, z: Array, v: Array) -> Array:
        """The same of a layer's values h and their tangents d, which go forwards together."""
        weights, biases = self._layers(p)
        h, d, t = [z], [v], []
        for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
            t.append(d[-1] @ weight.T)
            h.append(np.tanh(h[-1] @ weight.T + bias))
            d.append((1 - h[-1] ** 2) * t[-1])
        parts: list[Array] = []
        by_t, by_y = np.ones((len(z), 1)), np.zeros((len(z), 1))  # of the slope, in a layer's tangent t and output y
        for k in reversed(range(len(weights))):
            parts = [_outer(by_t, d[k]) + _outer(by_y, h[k]), by_y, *parts]
            if k:
                slope, by_d, by_h = 1 - h[k] ** 2, by_t @ weights[k], by_y @ weights[k]
                by_t, by_y = slope * by_d, slope * (by_h - 2 * by_d * t[k - 1] * h[k])
        return np.concatenate(parts, axis=1)

    def _layers(self, p: Array) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
        weights, biases, at = [], [], 0
        for before, width in itertools.pairwise((self.n, *self.hidden, 1)):
            weights.append(p[at : at + width * before].reshape(width, before))
            at += width * before
            biases.append(p[at : at + width])
            at += width
        return tuple(weights), tuple(biases)


@dataclass(frozen=True, slots=True)
class Terms:
    """A polynomial of all terms up to a degree.

    Parameters
    ----------
    n : number of states.
    degree : even, so that the function can rise in every direction; at least 2.

    Raises
    ------
    InputError : the degree is another one.
    """

    n: int
    degree: int

    def __post_init__(self) -> None:
        if self.degree % 2 or not 2 <= self.degree <= MAX_DEGREE:
            raise OptionError(f"`degree` must be even, from 2 to {MAX_DEGREE}; found {self.degree}.")

    @property
    def exponents(self) -> NDArray[np.int64]:
        """(k, n), the constant first."""
        rows = itertools.product(range(self.degree + 1), repeat=self.n)
        return np.array([row for row in rows if sum(row) <= self.degree], dtype=np.int64)

    def initial(self, generator: np.random.Generator) -> Array:
        """Zeros: the fit is linear, and begins anywhere."""
        return np.zeros(len(self.exponents))

    def function(self, p: Array, scale: Array | None = None) -> Polynomial:
        """The polynomial of z, or of x."""
        exponents = self.exponents
        return Polynomial(exponents, p if scale is None else p / np.prod(scale**exponents, axis=1))

    def value_rows(self, p: Array, z: Array) -> Array:
        """The monomials."""
        return monomials(z, self.exponents)

    def slope_rows(self, p: Array, z: Array, v: Array) -> Array:
        """The derivatives of the monomials along v."""
        exponents = self.exponents
        rows = np.zeros((len(z), len(exponents)))
        for i, unit in enumerate(np.eye(self.n, dtype=np.int64)):
            some = exponents[:, i] > 0
            rows[:, some] += v[:, i, None] * exponents[some, i] * monomials(z, exponents[some] - unit)
        return rows


def _outer(a: Array, b: Array) -> Array:
    """Products of all pairs, (B, i) and (B, j) to (B, i j)."""
    return (a[:, :, None] * b[:, None, :]).reshape(len(a), a.shape[1] * b.shape[1])
