"""Numbers in a pickle that was read as data: the few forms in which numpy and torch write arrays.

Every size is compared with the available bytes before an array is made.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.errors import InputError
from certify.loop.files.pickles import Call, Name, brief

_KINDS = {"f2", "f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "b1"}
_MAX_NUMBERS = 2**24
_BYTES = (Name("__builtin__", "bytes"), Name("builtins", "bytes"))
_NUMPY_PARTS = ("numpy.core", "numpy._core")

Numbers = NDArray[Any]


def array_of(node: Any, what: str) -> Numbers:
    """A numpy array, a numpy scalar or a number of a pickle that was read as data.

    Raises
    ------
    InputError : it is something else, or its bytes do not match its shape.
    """
    if isinstance(node, float | int) and not isinstance(node, bool):
        return np.array(float(node))
    if isinstance(node, Call) and isinstance(node.function, Name) and isinstance(node.arguments, tuple):
        module, name, given = node.function.module, node.function.name, node.arguments
        if module in [f"{part}.multiarray" for part in _NUMPY_PARTS]:
            if name == "_reconstruct" and len(node.states) == 1:
                state = node.states[0]
                if isinstance(state, tuple) and len(state) == 5:
                    return _filled(bytes_of(state[4], what), state[2], state[1], bool(state[3]), what)
            if name == "scalar" and len(given) == 2:
                return _filled(bytes_of(given[1], what), given[0], (), False, what)
        if module in [f"{part}.numeric" for part in _NUMPY_PARTS] and name == "_frombuffer" and len(given) == 4:
            return _filled(bytes_of(given[0], what), given[1], given[2], given[3] == "F", what)
    raise InputError(f"{what} must be a number or an array of numbers; found {brief(node)}.")


def is_array(node: Any) -> bool:
    """True if a node of a pickle describes an array of numpy; a single number is none."""
    if not isinstance(node, Call) or not isinstance(node.function, Name):
        return False
    module, name = node.function.module, node.function.name
    rebuilt = module in [f"{part}.multiarray" for part in _NUMPY_PARTS] and name == "_reconstruct"
    return rebuilt or (module in [f"{part}.numeric" for part in _NUMPY_PARTS] and name == "_frombuffer")


def is_number(node: Any) -> bool:
    """True if a node of a pickle describes a single number, of Python or of numpy."""
    if isinstance(node, Call) and isinstance(node.function, Name):
        return node.function in [Name(f"{part}.multiarray", "scalar") for part in _NUMPY_PARTS]
    return isinstance(node, float) or (type(node) is int and abs(node) < 2**53)


def product(shape: Any, what: str) -> int:
    """The number of entries of a shape.

    Raises
    ------
    InputError : it is no shape, or has too many entries.
    """
    whole = isinstance(shape, tuple | list) and all(type(k) is int and 0 <= k <= _MAX_NUMBERS for k in shape)
    count = math.prod(shape) if whole and len(shape) <= 8 else _MAX_NUMBERS + 1
    if count > _MAX_NUMBERS:
        raise InputError(f"the shape of {what} must be a few sizes with at most 2^24 numbers; found {brief(shape)}.")
    return count


def _filled(raw: bytes, dtype: Any, shape: Any, fortran: bool, what: str) -> Numbers:
    kind, count = _dtype(dtype, what), product(shape, what)
    if len(raw) != count * kind.itemsize:
        raise InputError(f"{what} must hold {count} numbers of {kind.itemsize} bytes; it holds {len(raw)} bytes.")
    flat = np.frombuffer(raw, dtype=kind)
    array: Numbers = flat.reshape(tuple(shape), order="F" if fortran else "C").astype(kind.newbyteorder("="))
    return array


def _dtype(node: Any, what: str) -> np.dtype[Any]:
    code, order = None, "<"
    if isinstance(node, Call) and node.function == Name("numpy", "dtype") and isinstance(node.arguments, tuple):
        code = node.arguments[0] if node.arguments else None
        state: Sequence[Any] = node.states[0] if node.states and isinstance(node.states[0], tuple) else ()
        order = state[1] if len(state) > 1 and state[1] in ("<", ">") else "<"
    if not isinstance(code, str) or code not in _KINDS:
        raise InputError(f"{what} must hold plain numbers; its type is {brief(code)}.")
    return np.dtype(f"{order}{code}")


def bytes_of(node: Any, what: str) -> bytes:
    """Bytes as they are, or as the old protocols write them: text to be encoded as Latin-1.

    Raises
    ------
    InputError : it is neither.
    """
    if isinstance(node, bytes | bytearray):
        return bytes(node)
    if isinstance(node, Call) and node.function in _BYTES and node.arguments == ():
        return b""
    if (
        isinstance(node, Call)
        and node.function == Name("_codecs", "encode")
        and isinstance(node.arguments, tuple)
        and len(node.arguments) == 2
        and isinstance(node.arguments[0], str)
        and node.arguments[1] in ("latin1", "latin-1")
    ):
        try:
            return node.arguments[0].encode("latin-1")
        except UnicodeEncodeError as error:
            raise InputError(f"the bytes of {what} are damaged: {error}.") from error
    raise InputError(f"the numbers of {what} must be bytes; found {brief(node)}.")
