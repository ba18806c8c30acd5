"""Neural Lyapunov functions: a tanh network from the states to one number.

Only sublevel sets `{N <= n2}` matter, so a strictly increasing function after the last layer (a sigmoid, a scale) can
be omitted: it changes the level and not the set. The numbers need not satisfy the aims of training (N(0) = 0, N > 0,
decrease); a claim states and proves its own conditions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from certify.errors import InputError
from certify.loop.networks import Network, frozen_layers, layered, sha256_of, tanh, through, widths

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Neural:
    """`N(x)`: affine layers with tanh between them, the last with one output; float32 numbers convert exactly.

    Parameters
    ----------
    weights : arrays of shape (out, in); the first `in` is n, the last `out` is 1.
    biases : arrays of shape (out,).

    Raises
    ------
    InputError : shapes do not chain, the last layer has several outputs, or a number is not finite.

    Examples
    --------
    >>> N = Neural((np.eye(2), np.ones((1, 2))), (np.zeros(2), np.array([0.5])))
    >>> N.widths, float(N(np.zeros(2))), N.gradient(np.zeros(2)).tolist()
    ((2, 2, 1), 0.5, [1.0, 1.0])
    """

    weights: tuple[Array, ...]
    biases: tuple[Array, ...]

    def __post_init__(self) -> None:
        weights, biases = frozen_layers(self.weights, self.biases, "a Lyapunov network")
        object.__setattr__(self, "weights", weights)
        object.__setattr__(self, "biases", biases)
        if self.widths[-1] != 1:
            raise InputError(f"a Lyapunov network must have one output; its last layer has {self.widths[-1]}.")

    @property
    def n(self) -> int:
        """Number of states."""
        return self.widths[0]

    @property
    def widths(self) -> tuple[int, ...]:
        """Widths from the states to 1, such as (2, 16, 16, 1)."""
        return widths(self.weights)

    @property
    def network(self) -> Network:
        """Its layers as a network."""
        return Network(self.n, layered(self.weights, self.biases))

    def sha256(self) -> str:
        """Hash by which a network is named: of each layer's weight and bias, as `sha256_of` has them."""
        pairs = [a for pair in zip(self.weights, self.biases, strict=True) for a in pair]
        return sha256_of(b"certify-lyapunov/1\0", pairs)

    def __call__(self, x: Array) -> Array:
        """N in float64, shape (..., n) to (...)."""
        return np.asarray(through(self.weights, self.biases, x)[..., 0])

    def gradient(self, x: Array) -> Array:
        """dN/dx in float64, shape (..., n) to (..., n)."""
        slopes, h = [], x
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            h = tanh(h @ weight.T + bias)
            slopes.append(1 - h**2)
        gradient = np.broadcast_to(self.weights[-1][0], (*x.shape[:-1], self.widths[-2]))
        for weight, slope in zip(self.weights[-2::-1], reversed(slopes), strict=True):
            gradient = (gradient * slope) @ weight
        return np.array(gradient)
