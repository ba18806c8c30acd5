"""All tensors of a file of weights by their names, from any dictionaries, lists and objects."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from certify.errors import InputError
from certify.loop.files.archives import Archive
from certify.loop.files.arrays import Numbers, array_of, is_array, is_number
from certify.loop.files.barepickle import BEGINNING as BARE
from certify.loop.files.barepickle import BarePickle
from certify.loop.files.legacy import BEGINNING
from certify.loop.files.pickles import Call, Name, Persistent
from certify.loop.files.torchfile import TorchFile, is_tensor
from certify.loop.policies.importers.operations import WITHOUT_WEIGHT_NORM

_SAFE = {
    "F64": "f8", "F32": "f4", "F16": "f2", "BOOL": "b1", "U8": "u1", "U16": "u2", "U32": "u4", "U64": "u8",
    "I8": "i1", "I16": "i2", "I32": "i4", "I64": "i8",
}  # fmt: skip
_MAX_NUMBERS = 2**26  # a small pickle may name one array many times
_MOST_MODULES = 1000
_HELD = ("_parameters", "_buffers", "_modules")
METADATA = "__metadata__"
"""The entry of a file of safetensors for texts."""


def load_tensors(
    raw: bytes,
    what: str,
    file: TorchFile | None = None,
    also: re.Pattern[str] | None = None,
    modules: dict[str, Call] | None = None,
) -> dict[str, Numbers]:
    """The tensors and arrays of a file of torch.save, or of a pickle that stands alone: the keys on the way to one are
    joined by dots. A `kernel` (in, out) of numpy becomes a `weight` (out, in).

    Parameters
    ----------
    also : keys of single numbers that are taken for tensors; None for none.
    modules : gets the modules of torch that were pickled whole, by their names; None refuses such.

    Raises
    ------
    InputError : the file is no archive of torch.save, or a module that was pickled whole, whose `forward` is code that
        the file does not hold, where these are refused; two tensors have one name, or one cannot be read.
    """
    held, root = _opened(raw, what, file)
    found, count = dict[str, Numbers](), 0
    waiting, seen = [("", root)], set[int]()
    while waiting:
        prefix, node = waiting.pop()
        named = also is not None and is_number(node) and also.fullmatch(prefix)
        if is_tensor(node) or is_array(node) or named:
            if prefix.startswith(("_modules.", "_parameters.")):
                raise InputError(
                    f"{what} is a module that was pickled whole, and what its forward does with {prefix} is not in the "
                    "file. Save it traced, torch.jit.trace(model.eval(), torch.zeros(1, n)).save(FILE), or its "
                    "state_dict, of which you say what stands between the layers."
                )
            dense = is_tensor(node)
            name, array = (prefix, held.tensor(node, prefix)) if dense else _out_in(prefix, array_of(node, prefix))
            if name in found:
                raise InputError(f"{what} must name each tensor once; {name} stands there twice.")
            found[name], count = array, count + array.size
            if count > _MAX_NUMBERS:
                raise InputError(f"{what} must hold at most {_MAX_NUMBERS} numbers in its tensors; it holds more.")
        elif isinstance(node, dict | list | tuple | Call):
            module = None if modules is None else _module(node, prefix or what)
            if module is not None and modules is not None and isinstance(node, Call):
                modules[prefix] = node  # under each of its names, as in a state_dict
                if len(modules) > _MOST_MODULES:
                    raise InputError(f"{what} must have at most {_MOST_MODULES:,} modules; it has more.")
            elif id(node) in seen:
                continue
            seen.add(id(node))
            within = _inside(node) if module is None else module
            inside = [(k, v) for k, v in within if isinstance(k, str | int | Name)]
            waiting += [(f"{prefix}.{k}" if prefix else str(k), v) for k, v in reversed(inside)]
    return found


def _opened(raw: bytes, what: str, file: TorchFile | None) -> tuple[TorchFile | BarePickle, Any]:
    """The reader of a file's tensors, and the value of its pickle."""
    if raw.startswith(BARE) and not raw.startswith(BEGINNING):
        bare = BarePickle(raw, what)
        made = bare.root.function if isinstance(bare.root, Call) else None
        if isinstance(made, Name) and made.name == "VecNormalize":
            raise InputError(f"{what} is a normaliser of observations: name it with --normaliser, beside the policy.")
        return bare, bare.root
    file = file if file is not None else TorchFile(raw, what)
    return file, file.pickle("data.pkl")


def _inside(node: dict[Any, Any] | list[Any] | tuple[Any, ...] | Call) -> Iterable[tuple[Any, Any]]:
    """Items of a container, or of an object that the pickle would have made, by key, number or attribute; what it would
    have been made of counts too, as of a named tuple."""
    if isinstance(node, dict):
        return node.items()
    if not isinstance(node, Call):
        return enumerate(node)
    held = [node.arguments, node.items, *(part for state in node.states for part in _parts(state))]
    return [*node.pairs, *(pair for each in held if isinstance(each, dict | list | tuple) for pair in _inside(each))]


def _module(node: Any, what: str) -> list[tuple[Any, Any]] | None:
    """The content of a module of torch, by the names of a state_dict; None if a node is none.

    Raises
    ------
    InputError : it calls other functions before or after its own.
    """
    state = node.states[0] if isinstance(node, Call) and len(node.states) == 1 else None
    if not isinstance(state, dict) or not all(isinstance(state.get(part), dict) for part in _HELD):
        return None
    if any(state.get(hooks) for hooks in ("_forward_pre_hooks", "_forward_hooks")):
        raise InputError(
            f"the module {what} must have no hooks, which change what it reads or gives. {WITHOUT_WEIGHT_NORM}"
        )
    rest = {} if str(class_of(node)).startswith("torch.") else state  # torch's own use no tensor beside these
    named = [(k, v) for k, v in rest.items() if not (isinstance(k, str) and k.startswith("_"))]
    return [*(pair for part in _HELD for pair in state[part].items()), *named]


def class_of(module: Call) -> Name | None:
    """The class of a module that was pickled whole; in a file of torch before version 1.6 its source is with it."""
    found = module.function
    if isinstance(found, Persistent) and isinstance(found.reference, tuple) and len(found.reference) > 1:
        found = found.reference[1]
    return found if isinstance(found, Name) else None


def _parts(state: Any) -> tuple[Any, ...]:
    """The attributes of an object: a dictionary, or with slots two of them."""
    return state if isinstance(state, tuple) else (state,)


def is_npz(archive: Archive) -> bool:
    """True if an archive holds arrays of numpy."""
    return bool(archive.names) and all(name.endswith(".npy") for name in archive.names)


def load_npz(raw: bytes, what: str) -> dict[str, Numbers]:
    """The arrays of a file of numpy.savez by their names, in which a slash becomes a dot; a `kernel` (in, out), as flax
    has it, becomes a `weight` (out, in).

    Raises
    ------
    InputError : the file is damaged, numbers are complex or have more than 64 bits, or two arrays have one name.
    """
    archive, found = Archive(raw, what), dict[str, Numbers]()
    for member in archive.names:
        name = member.removesuffix(".npy").replace("/", ".")
        try:
            array = np.lib.format.read_array(io.BytesIO(archive.read(member)), allow_pickle=False)
        except (ValueError, EOFError, TypeError, SyntaxError, MemoryError) as error:
            raise InputError(f"{member} in {what} is no plain array of numpy: {error}.") from error
        if array.dtype.kind == "c" or (array.dtype.kind in "fiu" and array.dtype.itemsize > 8):
            raise InputError(f"{member} in {what} must hold real numbers of at most 64 bits; found {array.dtype}.")
        name, array = _out_in(name, array)
        if name in found:
            raise InputError(f"{what} must name each array once; {name} stands there twice.")
        found[name] = array
    return found


def _out_in(name: str, array: Numbers) -> tuple[str, Numbers]:
    """A `kernel` (in, out), as flax and Keras call it, as the `weight` (out, in); other arrays as they are."""
    if name.rpartition(".")[2] == "kernel" and array.ndim == 2:
        return f"{name.removesuffix('kernel')}weight", array.T
    return name, array


def load_safetensors(raw: bytes, what: str, also: re.Pattern[str] | None = None) -> dict[str, Numbers]:
    """The tensors of a file of safetensors; float16 and bfloat16 as float32, which holds them exactly.

    Parameters
    ----------
    also : keys of its metadata whose texts are taken for single numbers; None for none.

    Raises
    ------
    InputError : the package is missing, the file is damaged, or such a text is no number.
    """
    try:
        import safetensors
    except ImportError as error:
        raise InputError(
            "a file of safetensors needs the package that reads it; "
            "install it with pip install '.[safetensors]' in the project's folder."
        ) from error
    try:
        held = safetensors.deserialize(raw)  # type: ignore[no-untyped-call]
    except (safetensors.SafetensorError, ValueError, KeyError, RuntimeError) as error:
        raise InputError(f"{what} is no file of safetensors or is damaged: {error}.") from error
    found = {name: _array(tensor, f"{name} of {what}") for name, tensor in held}
    said = {key: text for key, text in metadata(raw).items() if also is not None and also.fullmatch(key)}
    for key, text in said.items():
        try:
            found[f"{METADATA}.{key}"] = np.array(float(text))
        except ValueError as error:
            raise InputError(f"{key} in the metadata of {what} must be a number; found {text!r}.") from error
    return found


def metadata(raw: bytes) -> dict[str, str]:
    """The texts beside the tensors of a file of safetensors that was read."""
    size = int.from_bytes(raw[:8], "little")
    held: dict[str, str] = json.loads(raw[8 : 8 + size]).get(METADATA) or {}
    return held


def _array(tensor: Mapping[str, Any], what: str) -> Numbers:
    """A tensor of a file of safetensors, whose bytes are little-endian."""
    kind, raw, shape = tensor["dtype"], tensor["data"], tensor["shape"]
    if kind == "BF16":
        return (np.frombuffer(raw, "<u2").astype(np.uint32) << 16).view(np.float32).reshape(shape)
    if kind not in _SAFE:
        raise InputError(f"tensor {what} must hold plain real numbers; they are {kind}.")
    array = np.frombuffer(raw, f"<{_SAFE[kind]}").reshape(shape)
    return array.astype(np.float32 if kind == "F16" else array.dtype.newbyteorder("="))
