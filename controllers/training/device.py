"""The device on which networks, replay table and batches live."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from certify.errors import OptionError

Array = NDArray[np.float64]
CPU = torch.device("cpu")


def find_device(name: str) -> torch.device:
    """The device `name`, cpu or cuda.

    Raises
    ------
    InputError : it is neither, or this machine or this torch has none.
    """
    if name not in ("cpu", "cuda"):
        raise OptionError(f"`device` must be cpu or cuda; found {name!r}.")
    if name == "cuda" and not torch.cuda.is_available():
        raise OptionError("`device` is cuda, but torch finds no CUDA device here.")
    return torch.device(name)


def exact(tensor: Tensor) -> Array:
    """The numbers of a tensor in float64, which holds them exactly."""
    return tensor.detach().cpu().double().numpy()
