"""The policy as it is trained for proof: float32, with gradients."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from certify.loop.policies import PolicyNetwork
from controllers.training.departure import departure, departure_of_steps, linearised
from controllers.training.forms import Form, Forms, Numbers, TrainedValues
from controllers.training.units import Units

Array = NDArray[np.float64]


class Student(torch.nn.Module):
    """The policy as it is trained: float32, `scale * squash(net(x) - net(0) + value) + offset`, then the clip.

    Parameters
    ----------
    start : whose steps and numbers it begins with.
    value : what enters the squash at the origin (m,).
    folded : the policy with its centring folded in, whose squash, scale, offset and clip it has.
    """

    def __init__(self, start: PolicyNetwork, value: Array, folded: PolicyNetwork, trains_biases: bool) -> None:
        super().__init__()
        layers = start.network.affine
        self._weights = torch.nn.ParameterList(torch.tensor(a.weight, dtype=torch.float32) for a in layers)
        self._biases = torch.nn.ParameterList(
            torch.nn.Parameter(torch.tensor(a.bias, dtype=torch.float32), requires_grad=trains_biases) for a in layers
        )
        self.value, self.scale, self.offset = (
            torch.tensor(a, dtype=torch.float32) for a in (value, folded.scale, folded.offset)
        )
        self.folded, self.network, self.n = folded, start.network, start.n
        self.units = Units(next(iter(start.network.functions), "tanh"))
        self.origin = torch.tensor(start.origin)

    @property
    def weights(self) -> list[Tensor]:
        return list(self._weights)

    @property
    def biases(self) -> list[Tensor]:
        return list(self._biases)

    def numbers(self, precision: torch.dtype = torch.float32) -> Numbers:
        """The present numbers."""
        weights, biases = ([p.to(precision) for p in of] for of in (self._weights, self._biases))
        return Numbers(self.network, weights, biases)

    def departure(self, box: Tensor) -> Tensor:
        """The departure of the present numbers on the box with half-widths (n,)."""
        if self.network.is_chain:
            return departure(self.weights, self.biases, box, self.units)
        return departure_of_steps(self.numbers(torch.float64), box.double(), self.origin)

    def forward(self, x: Tensor) -> Tensor:
        """Inputs (batch, m) at states (batch, n)."""
        at = self.origin.to(x.dtype)
        h = TrainedValues(self.numbers())(torch.cat([x, x.new_zeros(1, self.n)]) + at)
        return self._input(h[:-1] - h[-1] + self.value)

    def on_boxes(self, x: Tensor, axes: Tensor) -> tuple[Tensor, Tensor]:
        """Inputs (B, m) at the centres x (B, n) of boxes with half-axes (B, k, n), and the errors of their bounds."""
        numbers = self.numbers()
        forms = Forms(numbers)
        at_0 = TrainedValues(numbers)(self.origin.to(x.dtype)[None])
        y, J = forms.run(self.network, (x + self.origin.to(x.dtype), axes))
        form: Form = (y - at_0 + self.value, J)
        if self.folded.squash == "tanh":
            form = forms.squashed(form, Units())
        u: Tensor = self.folded.clipped(self.scale * form[0] + self.offset)
        return u, forms.errors(self.scale * form[0])

    def distance(self, x: Tensor) -> Tensor:
        """The root mean square of the distance from the saturated linear feedback of the same gain at states (B, n),
        relative to this feedback's own change."""
        linear = self._input(x @ self.jacobian().to(x.dtype).T + self.value)
        at_0 = self._input(self.value[None])
        apart, own = (((a - b) / self.scale).square().mean() for a, b in ((self(x), linear), (linear, at_0)))
        found: Tensor = apart.sqrt() / own.sqrt()
        return found

    def jacobian(self) -> Tensor:
        """The Jacobian (m, n) of net at the origin, in float64."""
        if self.network.is_chain:
            weights, biases = ([p.double() for p in of] for of in (self._weights, self._biases))
            return linearised(weights, biases, self.units).jacobians[-1]
        forms = Forms(self.numbers(torch.float64))
        J: Tensor = forms.run(self.network, (self.origin[None], torch.eye(self.n, dtype=torch.float64)[None]))[1]
        return J[0].T

    def groups(self, states: Array, rate: float) -> list[dict[str, Any]]:
        """Parameters with their first steps: a share of a layer's weights, and of the values that a bias is added to.

        Layers differ by the contraction's factor, on purpose, so one step for all would tear down the first one.
        """
        groups: list[dict[str, Any]] = []
        sized = _Sized(self.numbers())
        with torch.no_grad():
            sized(torch.from_numpy(states).float() + self.origin.float())
        for step, W, b in zip(self.network.affine, self._weights, self._biases, strict=True):
            groups.append({"params": [W], "lr": rate * _size(W.detach())})
            if b.requires_grad:
                groups.append({"params": [b], "lr": rate * sized.sizes[step]})
        return groups

    def _input(self, y: Tensor) -> Tensor:
        u: Tensor = self.folded.clipped(self.scale * self.folded.squashed(y) + self.offset)
        return u


class _Sized(TrainedValues):
    """Values that remember the size of each layer's."""

    def __init__(self, numbers: Numbers) -> None:
        super().__init__(numbers)
        self.sizes: dict[Any, float] = {}

    def affine(self, step: Any, v: Tensor) -> Tensor:
        h = super().affine(step, v)
        self.sizes[step] = _size(h)
        return h


def _size(tensor: Tensor) -> float:
    return float(tensor.square().mean().sqrt())
