"""V = x'Px on boxes in the coordinates z, x = T z: bounds by intervals, and as a model.

In good coordinates T'PT is nearly diagonal: what it has beside the diagonal is bounded by magnitudes.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from certify.provers.bounds import Taylor
from certify.provers.bounds.taylor import EPS, TINY

Array = NDArray[np.float64]


class FormBound:
    """Bounds of z'Sz, S = T'PT, on the device that holds it."""

    def __init__(self, P: Array, T: Array, device: torch.device) -> None:
        S = T.T @ P @ T
        cross = np.abs(S - np.diag(np.diag(S))) + 1e-13 * np.sqrt(np.outer(np.diag(S), np.diag(S)))
        self.diagonal = torch.tensor(np.diag(S).copy(), dtype=torch.float64, device=device)[:, None]
        self.cross = torch.tensor(cross, dtype=torch.float64, device=device)
        self.S = torch.tensor(S, dtype=torch.float64, device=device)

    def levels(self, lo: Tensor, hi: Tensor) -> tuple[Tensor, Tensor]:
        """Bounds of V from below and above on boxes (n, B)."""
        far = torch.maximum(lo.abs(), hi.abs())
        near = torch.where((lo <= 0) & (hi >= 0), 0.0, torch.minimum(lo.abs(), hi.abs()))
        cross = (far * (self.cross @ far)).sum(0)
        return (self.diagonal * near**2).sum(0) - cross, (self.diagonal * far**2).sum(0) + cross

    def at(self, z: Tensor) -> Tensor:
        """V at points (n, B)."""
        return (z * (self.S @ z)).sum(0)

    def model(self, centre: Tensor, radius: Tensor, like: Taylor) -> Taylor:
        """V as a model in the box coordinates, among as many symbols as another model has."""
        n = len(centre)
        far = centre.abs() + radius
        g, Q = torch.zeros_like(like.g), torch.zeros_like(like.Q)
        g[:n] = 2 * self.diagonal * centre * radius
        torch.diagonal(Q, dim1=0, dim2=1)[:, :n] = (self.diagonal * radius * radius).T
        size = (self.diagonal * far * far).sum(0)
        rest = (far * (self.cross @ far)).sum(0) + n * EPS * size + TINY
        return Taylor((self.diagonal * centre * centre).sum(0), g, Q, rest)

    def gap(self, centre: Tensor, radius: Tensor, like: Taylor, level: float, sign: float) -> Taylor:
        """sign (level - V), likewise."""
        V, n = self.model(centre, radius, like), len(centre)
        return Taylor(sign * (level - V.c), -sign * V.g, -sign * V.Q, V.r + n * EPS * level + TINY)
