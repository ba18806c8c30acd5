"""Value networks of the critics."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

from controllers.training.device import CPU


class Critic(nn.Module):
    """`copies` independent tanh networks of one shape, evaluated together by batched products.

    Returns shape (copies, batch) for inputs of shape (batch, inputs). Values are `scale` times the last layer's output:
    returns of some hundreds, learned with steps of 3e-4, would otherwise be reached only by saturating every tanh.
    """

    def __init__(self, inputs: int, widths: Sequence[int], copies: int, scale: float = 1.0) -> None:
        super().__init__()
        self.scale = scale
        sizes = [inputs, *widths, 1]
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for a, b in pairwise(sizes):
            bound = 1 / math.sqrt(a)
            self.weights.append(nn.Parameter(torch.empty(copies, a, b, device=CPU).uniform_(-bound, bound)))
            self.biases.append(nn.Parameter(torch.empty(copies, 1, b, device=CPU).uniform_(-bound, bound)))
        self.copies = copies

    def forward(self, x: Tensor) -> Tensor:
        """Values, shape (copies, batch)."""
        h = x.expand(self.copies, *x.shape)
        last = len(self.weights) - 1
        for k, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            h = torch.baddbmm(bias, h, weight)
            if k < last:
                h = torch.tanh(h)
        return self.scale * h.squeeze(-1)
