"""The format that this program's files share: plain tensors, their plant, and how they were made.

Nothing in a file is executed, and equal contents give equal bytes: neither a file name nor a clock enters the archive.
It is one of torch's, so that torch can read it as well. Numbers are float32 where that loses nothing, which is a
smaller file of the same numbers.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.errors import InputError
from certify.loop.files.arrays import Numbers
from certify.loop.files.pickles import Call, Name
from certify.loop.files.torchfile import TorchFile, written

Array = NDArray[np.float64]
_MOST_NESTED = 32


def write_plain(path: str | Path, data: Mapping[str, Any], what: str) -> None:
    """Write arrays, texts and numbers in one step; `what` is what messages call the file, such as "policy file".

    Raises
    ------
    InputError : the file cannot be written.
    """
    raw = written(_interned(dict(data)))
    target = Path(path)
    temporary = target.with_name(target.name + ".partial")
    try:
        temporary.write_bytes(raw)
        os.replace(temporary, target)
    except OSError as error:
        raise InputError(f"{what} {path} cannot be written: {error.strerror}.") from error


def read_plain(path: str | Path, what: str) -> Any:
    """Read a file's contents, its tensors as arrays, without executing anything in it.

    Raises
    ------
    InputError : the file is missing, or no archive of plain tensors.
    """
    path = Path(path)
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise InputError(f"{what} {path} cannot be read: {error.strerror}.") from error
    file = TorchFile(raw, f"{what} {path}")
    data = file.pickle("data.pkl")
    try:
        return _plain(data, file, "")
    except InputError as error:
        raise InputError(f"{file.what}: {error}") from error


def tensors(arrays: Sequence[Array]) -> list[Numbers]:
    """The arrays as they are written: all in float32 if that loses nothing of any, else all in float64."""
    with np.errstate(over="ignore"):  # a number beyond float32 becomes infinity, which is not equal to it
        single = all(np.array_equal(a.astype(np.float32).astype(np.float64), a) for a in arrays)
    return [a.astype(np.float32 if single else np.float64) for a in arrays]


def array_in(value: Any, name: str) -> Array:
    """The numbers of a dense float32 or float64 tensor.

    Raises
    ------
    InputError : it is something else.
    """
    if not isinstance(value, np.ndarray) or value.dtype not in (np.float32, np.float64):
        raise InputError(f"`{name}` must be a float32 or float64 tensor; found {_kind(value)}.")
    return value.astype(np.float64)


def integers_in(value: Any, name: str) -> NDArray[np.int64]:
    """The numbers of a dense int64 tensor.

    Raises
    ------
    InputError : it is something else.
    """
    if not isinstance(value, np.ndarray) or value.dtype != np.int64:
        raise InputError(f"`{name}` must be an int64 tensor; found {_kind(value)}.")
    return value


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


def _plain(node: Any, file: TorchFile, name: str, depth: int = 0) -> Any:
    """A value of the pickle with arrays for its tensors; refused if it is anything but containers and numbers."""
    if isinstance(node, Call) and isinstance(node.function, Name) and node.function.module == "torch._utils":
        return file.tensor(node, name or "of the file")
    if depth < _MOST_NESTED:
        if type(node) is dict:
            return {k: _plain(v, file, f"{name}.{k}" if name else str(k), depth + 1) for k, v in node.items()}
        if type(node) in (list, tuple):
            return type(node)(_plain(v, file, f"{name}[{k}]", depth + 1) for k, v in enumerate(node))
    if node is None or type(node) in (str, int, float, bool):
        return node
    raise InputError("it must hold plain tensors only; it holds other objects (nothing in it was executed).")


def _kind(value: Any) -> str:
    return str(value.dtype) if isinstance(value, np.ndarray) else type(value).__name__


def _interned(value: Any) -> Any:
    """Equal strings become one object: pickle writes a repeated object as a reference, so identity shows in bytes."""
    if isinstance(value, str):
        return sys.intern(value)
    if isinstance(value, float):  # numpy's own are written as objects of numpy
        return float(value)
    if isinstance(value, dict):
        return {_interned(k): _interned(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(_interned(v) for v in value)
    return value
