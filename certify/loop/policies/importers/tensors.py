"""All tensors of a file of weights by their names, from any dictionaries, lists and objects."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from certify.errors import InputError
from certify.loop.files.arrays import Numbers, array_of, is_array
from certify.loop.files.pickles import Call
from certify.loop.files.torchfile import TorchFile, is_tensor


def load_tensors(raw: bytes, what: str, file: TorchFile | None = None) -> dict[str, Numbers]:
    """The tensors and arrays of a file of torch.save: the keys on the way to one are joined by dots.

    Raises
    ------
    InputError : the file is no archive of torch.save, two tensors have one name, or one cannot be read.
    """
    file = file if file is not None else TorchFile(raw, what)
    found: dict[str, Numbers] = {}
    waiting, seen = [("", file.pickle("data.pkl"))], set[int]()
    while waiting:
        prefix, node = waiting.pop()
        if is_tensor(node) or is_array(node):
            if prefix in found:
                raise InputError(f"{what} must name each tensor once; {prefix} stands there twice.")
            found[prefix] = file.tensor(node, prefix) if is_tensor(node) else array_of(node, prefix)
        elif isinstance(node, dict | list | tuple | Call) and id(node) not in seen:
            seen.add(id(node))
            waiting += [
                (f"{prefix}.{k}" if prefix else str(k), v) for k, v in _inside(node) if isinstance(k, str | int)
            ]
    return found


def _inside(node: dict[Any, Any] | list[Any] | tuple[Any, ...] | Call) -> Iterable[tuple[Any, Any]]:
    """Items of a container, or of an object that the pickle would have made, by key, number or attribute."""
    if isinstance(node, dict):
        return node.items()
    if not isinstance(node, Call):
        return enumerate(node)
    return [pair for state in node.states if isinstance(state, dict) for pair in state.items()]


def load_safetensors(raw: bytes, what: str) -> dict[str, Numbers]:
    """The tensors of a file of safetensors; float16 and bfloat16 as float32, which holds them exactly.

    Raises
    ------
    InputError : the package is missing, or the file is damaged.
    """
    import torch

    try:
        import safetensors
        from safetensors.torch import load
    except ImportError as error:
        raise InputError(
            "a file of safetensors needs the package that reads it; install it with pip install 'certify[safetensors]'."
        ) from error
    try:
        tensors = load(raw)
    except (safetensors.SafetensorError, ValueError, KeyError, RuntimeError) as error:
        raise InputError(f"{what} is no file of safetensors or is damaged: {error}.") from error
    narrow = (torch.float16, torch.bfloat16)
    return {name: (t.to(torch.float32) if t.dtype in narrow else t).numpy() for name, t in tensors.items()}
