"""Modules whose annotations torch compiles, so that they must not be strings."""

import torch

from tests.support.foreign import mlp


class SetsItsState(torch.nn.Module):
    """A module whose method runs whenever torch loads it."""

    k: torch.Tensor

    def __init__(self) -> None:
        super().__init__()
        self.k = torch.ones(1, 2)
        self.training = False

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return torch.tanh(torch.nn.functional.linear(x, self.k))

    @torch.jit.export
    def __getstate__(self) -> tuple[torch.Tensor, bool]:
        return (self.k, self.training)

    @torch.jit.export
    def __setstate__(self, state: tuple[torch.Tensor, bool]) -> None:
        print("executed")  # noqa: T201
        self.k, self.training = state[0], state[1]


class Constant(torch.nn.Module):
    gain: torch.jit.Final[float]

    def __init__(self) -> None:
        super().__init__()
        self.net, self.gain = mlp(), 2.5

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.net(x) * self.gain
