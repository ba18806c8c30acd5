"""A module whose method runs when torch loads it; its annotations are no strings, because torch compiles them."""

import torch


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
