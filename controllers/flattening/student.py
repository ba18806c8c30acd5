"""The policy as it is trained for proof: float32, with gradients."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from certify.loop.policies import PolicyNetwork
from controllers.training.departure import linearised
from controllers.training.units import Units

Array = NDArray[np.float64]


class Student(torch.nn.Module):
    """The policy as it is trained: float32, `scale * squash(net(x) - net(0) + value) + offset`, then the clip."""

    def __init__(self, start: PolicyNetwork, value: Array, folded: PolicyNetwork, trains_biases: bool) -> None:
        super().__init__()
        self._weights = torch.nn.ParameterList(torch.tensor(W, dtype=torch.float32) for W in start.weights)
        self._biases = torch.nn.ParameterList(
            torch.nn.Parameter(torch.tensor(b, dtype=torch.float32), requires_grad=trains_biases) for b in start.biases
        )
        self.value, self.scale, self.offset = (
            torch.tensor(a, dtype=torch.float32) for a in (value, folded.scale, folded.offset)
        )
        self.folded, self.units = folded, Units(start.activation)
        self.n = start.n

    @property
    def weights(self) -> list[Tensor]:
        return list(self._weights)

    @property
    def biases(self) -> list[Tensor]:
        return list(self._biases)

    def forward(self, x: Tensor) -> Tensor:
        """Inputs (batch, m) at states (batch, n)."""
        h = torch.cat([x, x.new_zeros(1, self.n)])
        for k, (W, b) in enumerate(zip(self._weights, self._biases, strict=True)):
            h = torch.addmm(b, self.units(h) if k else h, W.T)
        y = self.folded.squashed(h[:-1] - h[-1] + self.value)
        u: Tensor = self.folded.clipped(self.scale * y + self.offset)
        return u

    def jacobian(self) -> Tensor:
        """The Jacobian (m, n) of net at the origin, in float64."""
        weights, biases = ([p.double() for p in of] for of in (self._weights, self._biases))
        return linearised(weights, biases, self.units).jacobians[-1]

    def groups(self, states: Array, rate: float) -> list[dict[str, Any]]:
        """Parameters with their first steps: a share of a layer's weights, and of the values that a bias is added to.

        Layers differ by the contraction's factor, on purpose, so one step for all would tear down the first one.
        """
        groups: list[dict[str, Any]] = []
        h = torch.from_numpy(states).float()
        with torch.no_grad():
            for k, (W, b) in enumerate(zip(self._weights, self._biases, strict=True)):
                h = torch.addmm(b, self.units(h) if k else h, W.T)
                groups.append({"params": [W], "lr": rate * _size(W)})
                if b.requires_grad:
                    groups.append({"params": [b], "lr": rate * _size(h)})
        return groups


def _size(tensor: Tensor) -> float:
    return float(tensor.square().mean().sqrt())
