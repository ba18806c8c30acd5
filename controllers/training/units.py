"""The units of a network in torch: the values and slopes of an activation, and biases that keep its corner away.

relu has a corner at 0, elu and softsign one in their slope. Where the argument of a relu is 0 at the origin, the policy
has no Jacobian there; where one of these units has its corner nearby, the local part of a proof is small. So biases
begin at a distance from 0, and training keeps one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from certify.loop.activations import activation

Pair = tuple[Tensor, Tensor]
Layers = Sequence[tuple[Tensor, Tensor]]  # weights (out, in) and biases (out,)


def _tanh(y: Tensor) -> Pair:
    h = torch.tanh(y)
    return h, 1 - h * h


def _relu(y: Tensor) -> Pair:
    return torch.relu(y), (y > 0).to(y.dtype)


def _elu(y: Tensor) -> Pair:
    return nn.functional.elu(y), torch.exp(y.clamp(max=0.0))


def _sigmoid(y: Tensor) -> Pair:
    s = torch.sigmoid(y)
    return s, s * (1 - s)


def _silu(y: Tensor) -> Pair:
    s = torch.sigmoid(y)
    return y * s, s * (1 + y * (1 - s))


def _gelu(y: Tensor) -> Pair:
    below = torch.special.ndtr(y)
    return y * below, below + y * torch.exp(-0.5 * y * y) / (2 * torch.pi) ** 0.5


def _softplus(y: Tensor) -> Pair:
    phi: Tensor = activation("softplus")(y)
    return phi, torch.sigmoid(y)


def _mish(y: Tensor) -> Pair:
    t = torch.tanh(activation("softplus")(y))
    return y * t, t + y * (1 - t * t) * torch.sigmoid(y)


def _softsign(y: Tensor) -> Pair:
    r = 1 / (1 + y.abs())
    return y * r, r * r


_PAIRS: dict[str, Callable[[Tensor], Pair]] = {
    "tanh": _tanh,
    "relu": _relu,
    "elu": _elu,
    "sigmoid": _sigmoid,
    "silu": _silu,
    "gelu": _gelu,
    "softplus": _softplus,
    "mish": _mish,
    "softsign": _softsign,
}


class Units:
    """The units of one activation; all of it can be differentiated."""

    def __init__(self, name: str = "tanh") -> None:
        self.row = activation(name)
        self.name, self.is_smooth = name, self.row.is_smooth

    def __call__(self, y: Tensor) -> Tensor:
        """phi(y)."""
        value: Tensor = self.row(y)
        return value

    def pair(self, y: Tensor) -> Pair:
        """phi(y) and phi'(y)."""
        return _PAIRS[self.name](y)


@torch.no_grad()
def begin_away(layers: Layers, units: Units) -> None:
    """Move the biases of new hidden layers so that no unit's argument at the origin is near the activation's corner.

    With b = 1 / sqrt(inputs) of the layer, torch's largest first bias, the argument y becomes `sign(y) (b + |y|) / 2`.
    Layers of smooth units stay as they are.
    """
    if units.is_smooth:
        return
    h = layers[0][0].new_zeros(layers[0][0].shape[1])
    for weight, bias in layers:
        y = weight @ h + bias
        h = units(_moved(bias, y, (weight.shape[1] ** -0.5 + y.abs()) / 2))


@torch.no_grad()
def keep_away(layers: Layers, units: Units, half_widths: Tensor) -> None:
    """Move the biases of hidden layers as little as needed so that no unit passes its corner in a box.

    To first order, as `nearest_corner` has it; a unit stays on its side. Layers of smooth units stay as they are.

    Parameters
    ----------
    half_widths : (n,), of the box around the origin, in what the first layer reads.
    """
    if units.is_smooth:
        return
    h, J = torch.zeros_like(half_widths), torch.diag(half_widths)
    for weight, bias in layers:
        y, J = weight @ h + bias, weight @ J
        h, slope = units.pair(_moved(bias, y, torch.maximum(y.abs(), J.abs().sum(1))))
        J = slope[:, None] * J


def _moved(bias: Tensor, y: Tensor, size: Tensor) -> Tensor:
    """Arguments of this size on the side where they are, y, by the layer's bias."""
    away = torch.where(y < 0, -size, size)
    bias.add_(away - y)
    return away
