"""Least squares with one-sided residuals: values between bounds, derivatives along the flow below bounds.

A row within its bounds costs nothing, so that a fit can be exact where the shape is free, and rows that are found
violated later can be added directly. Steps are those of Levenberg and Marquardt, damped by the diagonal
(D. Marquardt, J. SIAM 11 (1963)), on the rows that are violated at the moment.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from certify.effort import UNLIMITED, Effort
from certify.errors import InputError
from certify.lyapunov.function import LyapunovFunction
from certify.lyapunov.learning.models import Model

Array = NDArray[np.float64]
_TRIES = 8  # of a step, with more damping each time
_MORE, _LESS, _LEAST = 3.0, 0.4, 1e-8  # damping
_ENOUGH = 1e-5  # relative gain of a step, below which the fit ends
_CALL, _ENTRY, _EACH = 4e6, 0.03, 100.0  # operations of a step, and of a product and an entry of its violated rows,
_VALUE, _CUBE = 2.0, 0.015  # of a parameter in each row, and of solving: a core's seconds, measured
_DECAY = 1e-6  # of the parameters: small weights make smooth functions


@dataclass(frozen=True, slots=True)
class Values:
    """Rows `low <= N(z) <= high`: states (B, n), bounds (B,) that may be infinite, weights (B,)."""

    z: Array
    low: Array
    high: Array
    weight: Array

    def __post_init__(self) -> None:
        if not len(self.z) == len(self.low) == len(self.high) == len(self.weight):
            raise InputError("rows must have a state, two bounds and a weight each; their counts differ.")

    def residuals(self, values: Array) -> Array:
        """The signed distance of each value (B,) to its bounds, weighted; 0 within them."""
        return np.asarray((values - np.clip(values, self.low, self.high)) * self.weight)


@dataclass(frozen=True, slots=True)
class Slopes:
    """Rows `dN/dz v <= most`: states and vectors (B, n), bounds and weights (B,)."""

    z: Array
    v: Array
    most: Array
    weight: Array

    def __post_init__(self) -> None:
        if not len(self.z) == len(self.v) == len(self.most) == len(self.weight):
            raise InputError("rows must have a state, a vector, a bound and a weight each; their counts differ.")

    def residuals(self, slopes: Array) -> Array:
        """The weighted excess of each slope (B,) over its bound; 0 below it."""
        return np.asarray(np.maximum(slopes - self.most, 0.0) * self.weight)


@dataclass(frozen=True, slots=True)
class Fit:
    """Parameters (k,) with the sum of squares there, and the damping with which a further fit may begin."""

    p: Array
    cost: float
    damping: float


def fit(
    model: Model, p: Array, values: Values, slopes: Slopes, steps: int, damping: float = 1.0, effort: Effort = UNLIMITED
) -> Fit:
    """Least squares from the parameters p, in at most so many steps, or until the effort is over."""

    def cost(q: Array) -> float:
        function = model.function(q)
        r = values.residuals(function(values.z))
        s = slopes.residuals(along(function, slopes.z, slopes.v))
        return float(r @ r + s @ s + _DECAY * (q @ q))

    least = cost(p)
    rows, size = len(values.z) + len(slopes.z), len(p)
    for _ in range(steps):
        normal, downhill, violated = _normal_equations(model, p, values, slopes)
        effort.charge(_CALL + _ENTRY * violated * size * (size + _EACH) + _VALUE * rows * size + _CUBE * size**3)
        diagonal = np.diag(normal)
        floor = 1e-6 * diagonal.max()
        for _ in range(_TRIES):
            try:
                damped = scipy.linalg.cho_factor(normal + np.diag(damping * (diagonal + floor)))
                step = scipy.linalg.cho_solve(damped, downhill)
                found = cost(p + step)
            except (
                scipy.linalg.LinAlgError,
                InputError,
            ):  # not positive definite by rounding, or not finite: damp more
                found = np.inf
            if found < least:
                break
            damping *= _MORE
        else:
            break
        gain, p, least = (least - found) / least, p + step, found
        damping = max(damping * _LESS, _LEAST)
        if gain < _ENOUGH or effort.over:
            break
    return Fit(p, least, damping)


def _normal_equations(model: Model, p: Array, values: Values, slopes: Slopes) -> tuple[Array, Array, int]:
    """(J'J, -J'r) of the rows that are violated, the decay of the parameters included; and how many these are."""
    function = model.function(p)
    r, s = values.residuals(function(values.z)), slopes.residuals(along(function, slopes.z, slopes.v))
    high, rising = r != 0, s != 0
    normal, downhill = _DECAY * np.eye(len(p)), -_DECAY * p
    for residual, rows in (
        (r[high], model.value_rows(p, values.z[high]) * values.weight[high, None]),
        (s[rising], model.slope_rows(p, slopes.z[rising], slopes.v[rising]) * slopes.weight[rising, None]),
    ):
        normal += rows.T @ rows
        downhill -= rows.T @ residual
    return normal, downhill, int(high.sum() + rising.sum())


def along(function: LyapunovFunction, z: Array, v: Array) -> Array:
    """Derivatives of a function at states (B, n) along vectors (B, n), shape (B,)."""
    return np.asarray((function.gradient(z) * v).sum(-1))
