"""A place to run: it takes a bound of boxes and gives back one that does the same work there."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, Protocol

import torch
from torch import Tensor

Bound = Callable[[Tensor, Tensor, float, float], Any]


class Runner(Protocol):
    """Bounds batches of boxes. The answer for a box must not depend on where or with which others it was bounded."""

    @property
    def device(self) -> torch.device:
        """Where the boxes of a batch lie."""

    def start(self, bound: Bound) -> AbstractContextManager[Bound]:
        """`bound`, a function of corners (n, B) and two levels to a named tuple of tensors (..., B), as run here."""
