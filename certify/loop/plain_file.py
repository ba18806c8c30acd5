"""The format that this program's files share: plain tensors, their plant, and how they were made.

Nothing in a file is executed (`weights_only=True`). Equal contents give equal bytes: the archive is written through
memory, so that neither a file name nor a clock enters it. Numbers are stored as float32 where that loses nothing.
"""

from __future__ import annotations

import io
import os
import pickle
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from certify.errors import InputError

if TYPE_CHECKING:
    import torch

Array = NDArray[np.float64]


def write_plain(path: str | Path, data: Mapping[str, Any], what: str) -> None:
    """Write tensors, texts and numbers in one step; `what` names the file in messages, such as "policy file".

    Raises
    ------
    InputError : the file cannot be written.
    """
    import torch

    buffer = io.BytesIO()
    torch.save(_interned(dict(data)), buffer)
    target = Path(path)
    temporary = target.with_name(target.name + ".partial")
    try:
        temporary.write_bytes(buffer.getvalue())
        os.replace(temporary, target)
    except OSError as error:
        raise InputError(f"{what} {path} cannot be written: {error.strerror}.") from error


def read_plain(path: str | Path, what: str) -> Any:
    """Read a file's contents without executing anything in it.

    Raises
    ------
    InputError : the file is missing, or no archive of plain tensors.
    """
    import torch

    path = Path(path)
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise InputError(f"{what} {path} cannot be read: {error.strerror}.") from error
    try:
        return torch.load(io.BytesIO(raw), map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        raise InputError(
            f"{what} {path} must hold plain tensors only; it holds other objects or is damaged "
            "(nothing in it was executed)."
        ) from error
    except Exception as error:  # torch.load has no closed list of what it raises on a damaged file
        raise InputError(f"{what} {path} is not a file that torch.load can read: {error}.") from error


def tensors(arrays: Sequence[Array]) -> list[torch.Tensor]:
    """The arrays as tensors: all in float32 if that loses nothing of any, else all in float64."""
    import torch

    with np.errstate(over="ignore"):  # a number beyond float32 becomes infinity, which is not equal to it
        single = all(np.array_equal(a.astype(np.float32).astype(np.float64), a) for a in arrays)
    return [torch.tensor(a, dtype=torch.float32 if single else torch.float64) for a in arrays]


def array_in(value: Any, name: str) -> Array:
    """The numbers of a dense float32 or float64 tensor.

    Raises
    ------
    InputError : it is something else.
    """
    import torch

    if not isinstance(value, torch.Tensor) or value.dtype not in (torch.float32, torch.float64):
        raise InputError(f"`{name}` must be a float32 or float64 tensor; found {_kind(value)}.")
    result: Array = _dense(value, name).to(torch.float64).numpy()
    return result


def integers_in(value: Any, name: str) -> NDArray[np.int64]:
    """The numbers of a dense int64 tensor.

    Raises
    ------
    InputError : it is something else.
    """
    import torch

    if not isinstance(value, torch.Tensor) or value.dtype != torch.int64:
        raise InputError(f"`{name}` must be an int64 tensor; found {_kind(value)}.")
    result: NDArray[np.int64] = _dense(value, name).numpy()
    return result


def layers_in(data: Mapping[str, Any]) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    """`weights` and `biases`, two lists of tensors.

    Raises
    ------
    InputError : they are something else.
    """
    lists = data["weights"], data["biases"]
    if not all(isinstance(one, list | tuple) for one in lists):
        raise InputError("`weights` and `biases` must be lists of tensors.")
    weights, biases = (
        tuple(array_in(a, f"{name}[{k}]") for k, a in enumerate(one))
        for name, one in zip(("weights", "biases"), lists, strict=True)
    )
    return weights, biases


def origin_in(data: Mapping[str, Any]) -> tuple[str, dict[str, Any], dict[str, Any]]:
    """The plant's name, its parameters, and how the file's content was made.

    Raises
    ------
    InputError : `system` or `training` is something else.
    """
    system, training = data["system"], data.get("training", {})
    if not isinstance(system, dict) or set(system) != {"name", "parameters"} or not isinstance(system["name"], str):
        raise InputError("`system` must be a dictionary with name and parameters.")
    if not isinstance(system["parameters"], dict) or not isinstance(training, dict):
        raise InputError("`system.parameters` and `training` must be dictionaries.")
    return system["name"], system["parameters"], training


def require_keys(data: Mapping[Any, Any], wanted: set[str], optional: set[str]) -> None:
    """Reject a dictionary with a missing or an unknown key.

    Raises
    ------
    InputError : it does.
    """
    keys = set(data)
    if not wanted <= keys <= wanted | optional:
        odd = sorted(map(str, keys - wanted - optional))
        raise InputError(f"missing keys {sorted(wanted - keys)}, unknown keys {odd}.")


def _dense(value: torch.Tensor, name: str) -> torch.Tensor:
    import torch

    if value.layout is not torch.strided:
        raise InputError(f"`{name}` must be a dense tensor; found {value.layout}.")
    return value.detach()


def _kind(value: Any) -> Any:
    import torch

    return value.dtype if isinstance(value, torch.Tensor) else type(value).__name__


def _interned(value: Any) -> Any:
    """Equal strings become one object: pickle writes a repeated object as a reference, so identity shows in bytes."""
    if isinstance(value, str):
        return sys.intern(value)
    if isinstance(value, dict):
        return {_interned(k): _interned(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(_interned(v) for v in value)
    return value
