"""The table of activations: what the producer knows of each function that may stand between a policy's layers.

A row has its values in numpy, torch, Arb and rationals, its derivatives, and bounds of these. The checkers have tables
of their own (FORMAT.md, functions); no number here is trusted. Bounds are not below the checker's, so that what is
found with them is accepted.

A row that is not smooth at 0 has derivatives where the sign of its argument is certain, elsewhere a tangent.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import flint
import numpy as np

from certify.errors import InputError
from certify.loop import smooth
from certify.loop.smooth import Array, Five

Pair = Callable[[Array], tuple[Array, Array]]
Derivatives = Callable[[Array], Five]
Formula = Callable[[Any], Any]
CERTAIN = 1 + 1e-3  # share of its range by which a number must be away from 0 for its sign, beyond all rounding
TANH4, TANH5 = 4.1, 16.0  # no derivative of tanh of this order is larger
_THRESHOLD = 40.0  # where torch's softplus may become v itself


class Activation(ABC):
    """A function phi of one number.

    `module` names it in `torch.nn`; `rises` says that it is monotone, `is_smooth` that it has all derivatives at 0.
    `bend`, `steepest`, `fourth` and `fifth` bound |phi''|/2, |phi'|, |phi''''|/24 and |phi'''''|/120.
    """

    name: str
    module: str
    rises, is_smooth = True, True
    bend, steepest, fourth, fifth = 0.5, 1.0, math.inf, math.inf

    def exact(self, q: Fraction) -> Fraction | None:
        """phi(q), None where rationals do not know it."""
        return Fraction(0) if q == 0 else None

    def __call__(self, x: Any) -> Any:
        """phi of a number, a numpy array or a torch tensor."""
        return self.pair(np.asarray(x))[0] if isinstance(x, np.ndarray | float) else self.in_torch(x)

    @abstractmethod
    def pair(self, y: Array) -> tuple[Array, Array]:
        """phi and phi'."""

    @abstractmethod
    def series(self, y: Array) -> Five:
        """phi, phi', phi''/2, phi'''/6 and phi''''/24."""

    @abstractmethod
    def formula(self, v: Any) -> Any:
        """phi of an Arb ball or series; an activation that is not smooth has that of its side, if the ball has one."""

    def in_torch(self, x: Any) -> Any:
        """phi of a torch tensor."""
        import torch

        return getattr(torch.nn.functional, self.name)(x)

    def around(self, y: Array, radius: Array) -> Five:
        """phi, phi', phi''/2 and phi'''/6 at y, and a bound of |phi''''|/24 on |v - y| <= radius."""
        *terms, there = self.series(y)
        f0, f1, f2, f3 = terms
        return f0, f1, f2, f3, np.minimum(self.fourth, np.abs(there) + 5 * self.fifth * radius)

    def in_arb(self, v: flint.arb) -> flint.arb:
        """phi of a whole ball; where phi does not rise, by its slope around the middle as well."""
        if self.rises:
            return self.at_point(v.lower()).union(self.at_point(v.upper())) if v.rad() != 0 else self.at_point(v)
        direct, middle = self.formula(v), v.mid()
        near = self.formula(middle) + self.slope_in_arb(v) * (v - middle)
        return direct.intersection(near) if direct.is_finite() else near

    def at_point(self, v: flint.arb) -> flint.arb:
        """phi of a small ball."""
        return self.formula(v)

    def slope_in_arb(self, v: flint.arb) -> flint.arb:
        """phi' on a ball: of all its points, and so a slope for mean values."""
        middle = v.mid()
        if not middle.is_finite():
            return flint.arb.nan()
        here = self.formula(flint.arb_series([middle, 1], prec=2))[1]
        found = here + flint.arb(0, 2 * self.bend) * (v - middle)
        most = flint.arb(0, self.steepest)
        return found.intersection(most) if found.is_finite() else most


def fourth_of_tanh(y: Array, radius: Array) -> Array:
    """At least |tanh''''|/24 on |v - y| <= radius."""
    t = np.tanh(y)
    there = np.abs(8 * t * (2 - 3 * t**2) * (1 - t**2))
    return np.asarray(np.minimum(TANH4, there + TANH5 * radius) / 24)


class _Tanh(Activation):
    name, module = "tanh", "Tanh"
    fourth, fifth = TANH4 / 24, TANH5 / 120

    def __call__(self, x: Any) -> Any:
        return np.tanh(x) if isinstance(x, np.ndarray | float) else x.tanh()

    def pair(self, y: Array) -> tuple[Array, Array]:
        t = np.tanh(y)
        return t, 1 - t**2

    def series(self, y: Array) -> Five:
        t = np.tanh(y)
        slope = 1 - t**2
        return t, slope, -t * slope, (3 * t**2 - 1) * slope / 3, 8 * t * (2 - 3 * t**2) * slope / 24

    def around(self, y: Array, radius: Array) -> Five:
        f0, f1, f2, f3, _ = self.series(y)
        return f0, f1, f2, f3, fourth_of_tanh(y, radius)

    def formula(self, v: Any) -> Any:
        return v.tanh()

    def in_arb(self, v: flint.arb) -> flint.arb:
        return v.tanh()

    def slope_in_arb(self, v: flint.arb) -> flint.arb:
        t = v.tanh()
        return 1 - t * t  # Arb's own power is NaN for a ball around 0


class _Sigmoid(Activation):
    """1/(1 + exp(-v)), which is (1 + tanh(v/2))/2."""

    name, module = "sigmoid", "Sigmoid"
    bend, steepest, fourth, fifth = 0.77 / 8, 0.25, TANH4 / 24 / 32, TANH5 / 120 / 64

    def exact(self, q: Fraction) -> Fraction | None:
        return Fraction(1, 2) if q == 0 else None

    def pair(self, y: Array) -> tuple[Array, Array]:
        s = smooth.sigmoid(y)
        return s, s * (1 - s)

    def series(self, y: Array) -> Five:
        s, p, p2, p3, p4 = smooth.sigmoids(y)
        return s, p, p2 / 2, p3 / 6, p4 / 24

    def formula(self, v: Any) -> Any:
        return 1 / ((-v).exp() + 1)


class _Smooth(Activation):
    """A smooth function by its values and slopes, its derivatives, and a formula in Arb."""

    def __init__(self, name: str, module: str, pair: Pair, derivatives: Derivatives, formula: Formula) -> None:
        self.name, self.module = name, module
        self._pair, self._derivatives, self._formula = pair, derivatives, formula

    def bounded(self, rises: bool, bend: float, steepest: float, fourth: float, fifth: float) -> Activation:
        """The same with these bounds."""
        self.rises, self.bend, self.steepest, self.fourth, self.fifth = rises, bend, steepest, fourth, fifth
        return self

    def pair(self, y: Array) -> tuple[Array, Array]:
        return self._pair(y)

    def series(self, y: Array) -> Five:
        f0, f1, f2, f3, f4 = self._derivatives(y)
        return f0, f1, f2 / 2, f3 / 6, f4 / 24

    def formula(self, v: Any) -> Any:
        return self._formula(v)


class _Softplus(_Smooth):
    """log(1 + exp(v))."""

    def exact(self, q: Fraction) -> Fraction | None:
        return None

    def in_torch(self, x: Any) -> Any:
        import torch

        return torch.nn.functional.softplus(x, threshold=_THRESHOLD)


class _Bent(Activation):
    """A function that is smooth but at 0."""

    is_smooth = False

    def around(self, y: Array, radius: Array) -> Five:
        """As of a smooth one where the sign of v is certain. Elsewhere the tangent is all there is: the last two terms
        are 0, and what it leaves, a multiple of (v - y)^2, stands for |phi^(4)|/24 times radius^2."""
        f0, f1, f2, f3, _ = self.series(y)
        certain = np.abs(y) > CERTAIN * radius
        with np.errstate(divide="ignore", invalid="ignore"):
            left = self.left_by_tangent(y) * CERTAIN / radius**2
        fourth = np.where(certain, self.beyond(y, radius), left)
        return f0, f1, np.where(certain, f2, 0.0), np.where(certain, f3, 0.0), fourth

    def left_by_tangent(self, y: Array) -> Array:
        """A bound of what the tangent at y leaves, by (v - y)^2."""
        return self.bend + 0 * y

    @abstractmethod
    def beyond(self, y: Array, radius: Array) -> Array:
        """A bound of |phi''''|/24 on |v - y| <= radius, of one sign."""

    def at_point(self, v: flint.arb) -> flint.arb:
        if v >= 0 or v < 0:
            return self.formula(v)
        return self.formula(v.lower()).union(self.formula(flint.arb(0))).union(self.formula(v.upper()))


class _Relu(_Bent):
    name, module, bend, fourth = "relu", "ReLU", 0.0, 0.0

    def exact(self, q: Fraction) -> Fraction | None:
        return max(q, Fraction(0))

    def pair(self, y: Array) -> tuple[Array, Array]:
        return np.maximum(y, 0.0), np.where(y > 0, 1.0, 0.0)

    def series(self, y: Array) -> Five:
        none = np.zeros_like(y)
        return np.maximum(y, 0.0), np.where(y > 0, 1.0, 0.0), none, none, none

    def beyond(self, y: Array, radius: Array) -> Array:
        return 0.0 * radius

    def left_by_tangent(self, y: Array) -> Array:
        return np.asarray(0.25 / np.abs(y))

    def formula(self, v: Any) -> Any:
        return v if v >= 0 else flint.arb(0) if v < 0 else flint.arb.nan()

    def slope_in_arb(self, v: flint.arb) -> flint.arb:
        return flint.arb(1) if v > 0 else flint.arb(0) if v < 0 else flint.arb(0.5, 0.5)


class _Elu(_Bent):
    """v, and exp(v) - 1 for v < 0."""

    name, module, fourth = "elu", "ELU", 1 / 24

    def exact(self, q: Fraction) -> Fraction | None:
        return q if q >= 0 else None

    def pair(self, y: Array) -> tuple[Array, Array]:
        e = np.exp(np.minimum(y, 0.0))
        return np.where(y > 0, y, e - 1), e  # where y > 0, e is 1

    def series(self, y: Array) -> Five:
        f0, f1 = self.pair(y)
        e = np.where(y > 0, 0.0, f1)
        return f0, f1, e / 2, e / 6, e / 24

    def beyond(self, y: Array, radius: Array) -> Array:
        return np.exp(np.minimum(y + radius, 0.0)) / 24

    def formula(self, v: Any) -> Any:
        return v if v >= 0 else v.expm1()

    def slope_in_arb(self, v: flint.arb) -> flint.arb:
        zero = flint.arb(0)
        return v.lower().min(zero).exp().union(v.upper().min(zero).exp())


class _Softsign(_Bent):
    """v / (1 + |v|), with the derivatives 1, -2 sign(v), 6, -24 sign(v) over (1 + |v|)^2, ^3, ^4, ^5."""

    name, module, bend, fourth = "softsign", "Softsign", 1.0, 1.0

    def exact(self, q: Fraction) -> Fraction | None:
        return q / (1 + abs(q))

    def pair(self, y: Array) -> tuple[Array, Array]:
        r = 1 / (1 + np.abs(y))
        return y * r, r * r

    def series(self, y: Array) -> Five:
        r, sign = 1 / (1 + np.abs(y)), np.where(y < 0, -1.0, 1.0)
        square = r * r
        return y * r, square, -sign * square * r, square * square, -sign * square * square * r

    def beyond(self, y: Array, radius: Array) -> Array:
        return np.asarray((1 + np.maximum(np.abs(y) - CERTAIN * radius, 0.0)) ** -5.0)

    def formula(self, v: Any) -> Any:
        return v / (1 + v) if v >= 0 else v / (1 - v)

    def slope_in_arb(self, v: flint.arb) -> flint.arb:
        far, near = (1 / (1 + end) for end in (v.abs_upper(), v.abs_lower()))
        return (far * far).union(near * near)


ACTIVATIONS: dict[str, Activation] = {
    row.name: row
    for row in (
        *(_Tanh(), _Relu(), _Elu(), _Sigmoid()),
        _Smooth("silu", "SiLU", smooth.silu_pair, smooth.silu, smooth.silu_in_arb).bounded(
            rises=False, bend=0.2621, steepest=1.106, fourth=0.03516, fifth=0.03693
        ),
        _Smooth("gelu", "GELU", smooth.gelu_pair, smooth.gelu, smooth.gelu_in_arb).bounded(
            rises=False, bend=0.3991, steepest=1.139, fourth=0.06654, fifth=0.02508
        ),
        _Softplus("softplus", "Softplus", smooth.softplus_pair, smooth.softplus, smooth.softplus_in_arb).bounded(
            rises=True, bend=0.138, steepest=1.0, fourth=0.07006, fifth=0.08393
        ),
        _Smooth("mish", "Mish", smooth.mish_pair, smooth.mish, smooth.mish_in_arb).bounded(
            rises=False, bend=0.3406, steepest=1.105, fourth=0.3439, fifth=0.7983
        ),
        _Softsign(),
    )
}
"""The rows by their names."""


def activation(name: str) -> Activation:
    """The row of this name.

    Raises
    ------
    InputError : there is none.
    """
    if name not in ACTIVATIONS:
        raise InputError(f"`activation` must be one of {', '.join(ACTIVATIONS)}; found {name!r}.")
    return ACTIVATIONS[name]
