"""The smooth activations and their derivatives, in floats and in Arb, for the table of activations.

A function of this name gives phi and its four first derivatives, one with `_pair` phi and the first alone.
"""

from __future__ import annotations

import math
from typing import Any

import flint
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Five = tuple[Array, Array, Array, Array, Array]
_DENSITY = 1 / math.sqrt(2 * math.pi)


def sigmoid(y: Array) -> Array:
    return np.asarray(0.5 + 0.5 * np.tanh(0.5 * y))


def sigmoids(y: Array) -> Five:
    """The sigmoid and its derivatives."""
    s = sigmoid(y)
    p, odd = s * (1 - s), 1 - 2 * s
    return s, p, p * odd, p * (1 - 6 * p), p * odd * (1 - 12 * p)


def silu(y: Array) -> Five:
    return _times_v(y, sigmoids(y))


def softplus(y: Array) -> Five:
    s, p, p2, p3, _ = sigmoids(y)
    return _logarithm(y), s, p, p2, p3


def _logarithm(y: Array) -> Array:
    """log(1 + exp(y))."""
    return np.asarray(np.maximum(y, 0.0) + np.log1p(np.exp(-np.abs(y))))


def _normal(y: Array) -> tuple[Array, Array]:
    """The normal distribution and its density."""
    from scipy.special import ndtr

    return ndtr(y), _DENSITY * np.exp(-0.5 * y * y)


def gelu(y: Array) -> Five:
    below, g = _normal(y)
    w = y * y
    return y * below, below + y * g, g * (2 - w), g * y * (w - 4), g * (w * (7 - w) - 4)


def mish(y: Array) -> Five:
    s1, s2, s3, s4, _ = sigmoids(y)
    t, q = _tanh_of_softplus(y)
    q2, q3, q4 = -2 * t * q, q * (6 * t * t - 2), q * t * (16 - 24 * t * t)
    return _times_v(
        y,
        (
            t,
            q * s1,
            q2 * s1**2 + q * s2,
            q3 * s1**3 + 3 * q2 * s1 * s2 + q * s3,
            q4 * s1**4 + 6 * q3 * s1**2 * s2 + q2 * (3 * s2**2 + 4 * s1 * s3) + q * s4,
        ),
    )


def _tanh_of_softplus(y: Array) -> tuple[Array, Array]:
    """tanh(log w), w = 1 + exp(y), which is 1 - 2/(1 + w^2), and 1 minus its square, which is (2 w/(1 + w^2))^2."""
    e = np.exp(-np.abs(y))
    up = y > 0
    a = np.where(up, e, 1.0)  # w = b/a
    b = np.where(up, e + 1, 1 + e)
    whole = a * a + b * b
    half = 2 * a * b / whole
    return 1 - 2 * a * a / whole, half * half


def _times_v(y: Array, f: Five) -> Five:
    """v f(v) and its derivatives, by those of f."""
    f0, f1, f2, f3, f4 = f
    return y * f0, f0 + y * f1, 2 * f1 + y * f2, 3 * f2 + y * f3, 4 * f3 + y * f4


def silu_pair(y: Array) -> tuple[Array, Array]:
    s = sigmoid(y)
    f = y * s
    return f, s + f * (1 - s)


def gelu_pair(y: Array) -> tuple[Array, Array]:
    below, g = _normal(y)
    return y * below, below + y * g


def softplus_pair(y: Array) -> tuple[Array, Array]:
    return _logarithm(y), sigmoid(y)


def mish_pair(y: Array) -> tuple[Array, Array]:
    t, q = _tanh_of_softplus(y)
    return y * t, t + y * q * sigmoid(y)


def mish_in_arb(v: Any) -> Any:
    w = v.exp() + 1
    return v * (1 - 2 / (w * w + 1))


def gelu_in_arb(v: Any) -> Any:
    return v * ((v * (flint.arb(1) / 2).sqrt()).erf() + 1) / 2


def silu_in_arb(v: Any) -> Any:
    return v / ((-v).exp() + 1)


def softplus_in_arb(v: Any) -> Any:
    return (v.exp() + 1).log()
