"""The replay table."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from controllers.training.device import CPU

Array = NDArray[np.float64]


class Replay:
    """A ring of transitions (x, tanh(w), reward, x+, terminated) in one float32 table."""

    def __init__(self, capacity: int, n: int, m: int, device: torch.device = CPU) -> None:
        self.table = torch.empty(capacity, 2 * n + m + 2, device=device)
        self._sizes = [n, m, 1, n, 1]
        self.count = 0

    def __len__(self) -> int:
        return min(self.count, len(self.table))

    def add(self, x: Array, normalised: Array, reward: float, x_next: Array, terminated: bool) -> None:
        """Store one transition over the oldest."""
        row = np.concatenate([x, normalised, [reward], x_next, [terminated]])
        self.table[self.count % len(self.table)].copy_(torch.from_numpy(row))
        self.count += 1

    def sample(self, size: int, generator: torch.Generator) -> tuple[Tensor, ...]:
        """`size` transitions, uniformly with replacement; `generator` lives on the CPU."""
        index = torch.randint(len(self), (size,), generator=generator, device=CPU)
        return torch.split(self.table[index.to(self.table.device)], self._sizes, dim=1)

    def state(self) -> dict[str, Any]:
        """Tensors and plain values for a checkpoint."""
        return {"rows": self.table[: len(self)].cpu().clone(), "count": self.count}

    def load_state(self, state: dict[str, Any]) -> None:
        """Continue from `state()`."""
        rows = state["rows"]
        self.table[: len(rows)] = rows
        self.count = state["count"]
