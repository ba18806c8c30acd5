"""V = x'Px on boxes in the coordinates z, x = T z: bounds by intervals, and as a model.

In good coordinates T'PT is nearly diagonal: what it has beside the diagonal is bounded by magnitudes.
"""

from __future__ import annotations

import numpy as np

from certify.provers.bounds import Taylor
from certify.provers.bounds.arrays import Array, product
from certify.provers.bounds.taylor import EPS, TINY


class FormBound:
    """Bounds of z'Sz, S = T'PT."""

    def __init__(self, P: Array, T: Array) -> None:
        S = T.T @ P @ T
        cross = np.abs(S - np.diag(np.diag(S))) + 1e-13 * np.sqrt(np.outer(np.diag(S), np.diag(S)))
        self.diagonal = np.diag(S).copy()[:, None]
        self.cross, self.S = cross, S

    def levels(self, lo: Array, hi: Array) -> tuple[Array, Array]:
        """Bounds of V from below and above on boxes (n, B)."""
        far = np.maximum(np.abs(lo), np.abs(hi))
        near = np.where((lo <= 0) & (hi >= 0), 0.0, np.minimum(np.abs(lo), np.abs(hi)))
        cross = (far * product(self.cross, far)).sum(0)
        return (self.diagonal * near**2).sum(0) - cross, (self.diagonal * far**2).sum(0) + cross

    def at(self, z: Array) -> Array:
        """V at points (n, B)."""
        return np.asarray((z * product(self.S, z)).sum(0))

    def model(self, centre: Array, radius: Array, like: Taylor) -> Taylor:
        """V as a model in the box coordinates, among as many symbols as another model has."""
        n = len(centre)
        far = np.abs(centre) + radius
        g, Q = np.zeros_like(like.g), np.zeros_like(like.Q)
        g[:n] = 2 * self.diagonal * centre * radius
        np.einsum("iib->ib", Q)[:n] = self.diagonal * radius * radius
        size = (self.diagonal * far * far).sum(0)
        rest = (far * product(self.cross, far)).sum(0) + n * EPS * size + TINY
        return Taylor((self.diagonal * centre * centre).sum(0), g, Q, rest)

    def gap(self, centre: Array, radius: Array, like: Taylor, level: float, sign: float) -> Taylor:
        """sign (level - V), likewise."""
        V, n = self.model(centre, radius, like), len(centre)
        return Taylor(sign * (level - V.c), -sign * V.g, -sign * V.Q, V.r + n * EPS * level + TINY)
