"""A set {x'Px <= 1} that is trained together with the policy, and a forecast of the boxes that its proof takes.

The forecast is that of the candidate `economical` (`certify.analysis.candidates.economical`) in torch, so that a
gradient goes through the policy, the plant and P at once.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from certify.analysis.candidates.economical import LEAST, NEAREST, OVERHEAD
from certify.loop.closed_loop import ClosedLoop
from certify.loop.plants import System
from certify.lyapunov import ball_volume, diagonalising_coordinates, solve_lyapunov
from controllers.flattening.student import Student

Array = NDArray[np.float64]


class ProvableSet(torch.nn.Module):
    """{x'Px <= 1} of a given volume, by P = L L' with a triangular L of fixed determinant.

    Parameters
    ----------
    loop : in continuous time, its input follows at once, its policy has its equilibrium at 0.
    volume, share : see `aim`.
    """

    def __init__(self, loop: ClosedLoop, volume: float, share: float) -> None:
        super().__init__()
        system: System = loop.system
        self.n, self.m, self.f = system.n, system.m, system.function("torch")
        sides = np.array([min(-float(lo), float(hi)) for lo, hi in system.domain])
        L = np.linalg.cholesky(solve_lyapunov(loop.mean_rate(), np.diag(sides**-2.0)))
        self.below = torch.nn.Parameter(torch.tensor(np.tril(L, -1) / np.diag(L)[:, None]).float())
        self.diagonal = torch.nn.Parameter(torch.tensor(np.log(np.diag(L))).float())
        self.sides = torch.tensor(sides).float()
        self.aim(volume, share)
        self.turn(loop)

    def aim(self, volume: float, share: float) -> None:
        """Ask for this volume, in the product of the states' units, by boxes whose half-widths are this share of their
        distance from the origin."""
        ball = ball_volume(self.n)
        self.shrink = math.log(ball / volume) / self.n  # L's mean logarithm
        boxes = OVERHEAD * 2 ** (self.n / 2) * self.n * ball * -math.log(NEAREST) / (2 * share) ** self.n
        self.share, self.log_unit = share, math.log(boxes)

    def factor(self) -> Tensor:
        """L (n, n)."""
        scale = torch.exp(self.diagonal - self.diagonal.mean() + self.shrink)
        return (torch.tril(self.below, -1) + torch.eye(self.n)) * scale[:, None]

    def P(self) -> Array:
        """P (n, n)."""
        L = self.factor().detach().double().numpy()
        return np.asarray(L @ L.T)

    def turn(self, loop: ClosedLoop) -> None:
        """Turn the boxes as a proof has them, by the linearisation of this loop."""
        P = self.P()
        T = diagonalising_coordinates(P, loop.mean_rate(), loop.step)
        T = np.linalg.cholesky(P).T @ T
        self.basis = torch.tensor(T / np.linalg.norm(T, axis=0)).float()

    def outside(self) -> Tensor:
        """The sum of the shares by which the set passes the domain."""
        inverse = torch.linalg.inv(self.factor())
        passed: Tensor = torch.linalg.vector_norm(inverse, dim=0) / self.sides - 1
        return passed.clamp_min(0).sum()

    def log_boxes(self, student: Student, generator: torch.Generator, count: int) -> tuple[Tensor, Tensor]:
        """The logarithm of the number of boxes, from this many that are drawn, and the mean of what m is short of at
        those where nothing would be proved, which is 0 if there are none."""
        z = torch.randn(count, self.n, generator=generator)
        r = torch.exp(math.log(NEAREST) * torch.rand(count, generator=generator))
        z = z / torch.linalg.vector_norm(z, dim=1, keepdim=True) * r[:, None]
        L = self.factor()
        inverse = torch.linalg.inv(L)
        x = z @ inverse
        axes = (inverse.T @ self.basis).T[None] * (self.share * r)[:, None, None]  # half-axes in rows
        u, errors = student.on_boxes(x, axes)
        F, along = self.f(x, u), 2 * z @ L.T
        moved = (self.f(x, u + errors[:, j : j + 1] * one) - F for j, one in enumerate(torch.eye(self.m)))
        asked = torch.stack([(along * change).sum(1).abs() for change in moved]).sum(0)
        m = -(along * F).sum(1) / asked.clamp_min(1e-9)
        power = torch.logsumexp(-self.n / 2 * m.clamp_min(LEAST).log(), 0) - math.log(count)
        return self.log_unit + power, (LEAST - m).clamp_min(0).mean() / LEAST
