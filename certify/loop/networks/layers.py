"""Affine layers with a function between them, as exact binary64 numbers, for policies and neural Lyapunov functions.

This module has only the layers. A squash, a scale or a centring after the last one belongs to their owner.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.errors import InputError
from certify.loop.activations import ACTIVATIONS

Array = NDArray[np.float64]


def frozen(array: Any, name: str, whose: str) -> Array:
    """A copy in binary64 that cannot be written to; float32 converts exactly.

    Raises
    ------
    InputError : a number is not finite.
    """
    result = np.array(array, dtype=np.float64)
    if not np.all(np.isfinite(result)):
        raise InputError(f"`{name}` of {whose} must be finite; found NaN or infinity.")
    result.setflags(write=False)
    return result


def frozen_layers(
    weights: Sequence[Any], biases: Sequence[Any], whose: str
) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    """Weights (out, in) and biases (out,) of layers that chain.

    Parameters
    ----------
    whose : the network's name in messages, such as "the policy".

    Raises
    ------
    InputError : there is no layer, shapes do not chain, or a number is not finite.
    """
    frozen_weights = tuple(frozen(a, "weights", whose) for a in weights)
    frozen_biases = tuple(frozen(a, "biases", whose) for a in biases)
    if not frozen_weights or len(frozen_weights) != len(frozen_biases):
        raise InputError(
            f"{whose} must have as many weights as biases, at least one; "
            f"found {len(frozen_weights)} and {len(frozen_biases)}."
        )
    for k, (weight, bias) in enumerate(zip(frozen_weights, frozen_biases, strict=True)):
        if weight.ndim != 2 or bias.shape != weight.shape[:1] or 0 in weight.shape:
            raise InputError(
                f"layer {k} must have a weight (out, in) and a bias (out,); found {weight.shape} and {bias.shape}."
            )
        if k and weight.shape[1] != frozen_weights[k - 1].shape[0]:
            raise InputError(
                f"layer {k} must take the {frozen_weights[k - 1].shape[0]} outputs of layer {k - 1}; "
                f"its weight has shape {weight.shape}."
            )
    return frozen_weights, frozen_biases


def widths(weights: Sequence[Array]) -> tuple[int, ...]:
    """The layers' widths from input to output, such as (2, 16, 16, 1)."""
    return (int(weights[0].shape[1]), *(int(w.shape[0]) for w in weights))


def sha256_of(head: bytes, arrays: Iterable[Array], words: str = "") -> str:
    """Hash of `head`, then of each array's shape and little-endian binary64, then of `words`.

    Every array contributes its number of axes and its axes as unsigned 64-bit little-endian integers, then its numbers
    in row order.
    """
    digest = hashlib.sha256(head)
    for array in arrays:
        digest.update(struct.pack(f"<{1 + array.ndim}Q", array.ndim, *array.shape))
        digest.update(np.ascontiguousarray(array, dtype="<f8").tobytes())
    digest.update(words.encode())
    return digest.hexdigest()


def through(weights: Sequence[Array], biases: Sequence[Array], x: Any) -> Any:
    """Apply layers with tanh between them to the last axis of x, in x's arithmetic (numpy array or torch tensor)."""
    for k, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        if k:
            x = tanh(x)
        x = x @ like(weight.T, x) + like(bias, x)
    return x


def tanh(x: Any) -> Any:
    """tanh of a number, a numpy array or a torch tensor."""
    return ACTIVATIONS["tanh"](x)


def clipped(x: Any, lo: Any, hi: Any) -> Any:
    """`min(max(x, lo), hi)` of a number, a numpy array or a torch tensor, with ends of its kind."""
    if isinstance(x, np.ndarray | float):
        return np.minimum(np.maximum(x, lo), hi)
    return x.clamp(lo, hi)


def like(array: Array, x: Any) -> Any:
    """Convert the array to the kind of x: for a torch tensor a tensor of its precision, on its device."""
    if isinstance(x, np.ndarray):
        return array
    import torch

    return torch.tensor(array, dtype=x.dtype, device=x.device)
