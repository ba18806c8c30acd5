"""A file of torch.save or torch.jit.save: its pickle as data, and the tensors that its storages hold; and how one is
written.

torch's own `weights_only` refuses a checkpoint with a numpy random state beside the weights, and without it torch.load
runs the pickle's calls. Here nothing runs in either case: an object that is no tensor stays a name.
"""

from __future__ import annotations

import io
import pickle
import zipfile
from collections import OrderedDict
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np

from certify.errors import InputError
from certify.loop.files.archives import Archive
from certify.loop.files.arrays import Numbers, product
from certify.loop.files.legacy import BEGINNING, Legacy
from certify.loop.files.pickles import Call, Name, Persistent, brief, read_pickle

_MAX_NUMBERS = 2**26
_TYPES = {
    "Float": "f4", "Double": "f8", "Half": "f2", "BFloat16": "bf16",
    "Long": "i8", "Int": "i4", "Short": "i2", "Char": "i1", "Byte": "u1", "Bool": "b1",
}  # fmt: skip
_DTYPES = {
    "float32": "f4", "float64": "f8", "float16": "f2", "bfloat16": "bf16",
    "int64": "i8", "int32": "i4", "int16": "i2", "int8": "i1", "uint8": "u1", "bool": "b1",
}  # fmt: skip


class TorchFile:
    """A zip file of torch, or a file of torch before version 1.6, read without running anything in it.

    Parameters
    ----------
    raw : the file.
    what : its name in messages.
    archive : the file as an archive, if it has been opened.

    Raises
    ------
    InputError : it is damaged, or holds no pickle.
    """

    def __init__(self, raw: bytes, what: str, archive: Archive | None = None) -> None:
        self.what = what
        self.archive: Archive | Legacy
        if archive is not None:
            self.archive = archive
        else:
            self.archive = Legacy(raw, what) if raw.startswith(BEGINNING) else Archive(raw, what)
        roots = [name.removesuffix("data.pkl") for name in self.archive.names if _depth(name) == 1]
        roots = [root for root in roots if f"{root}data.pkl" in self.archive]
        if not roots and any(name.endswith("/models/model.json") for name in self.archive.names):
            raise InputError(
                f"{what} is a program of torch.export, which is not read. Write the module as ONNX: "
                "torch.onnx.export(module.eval(), (torch.zeros(1, n),), FILE, dynamo=True)."
            )
        if len(set(roots)) != 1:
            raise InputError(f"{what} must hold one data.pkl, as torch.save writes it; found {len(set(roots))}.")
        self.root = roots[0]
        if isinstance(self.archive, Archive):
            _require_torchs_names(self.archive.names, self.root, what)
        self.order = "<"
        if f"{self.root}byteorder" in self.archive:
            word = self.archive.read(f"{self.root}byteorder")
            if word not in (b"little", b"big"):
                raise InputError(f"the byte order of {what} must be little or big; found {word[:20]!r}.")
            self.order = "<" if word == b"little" else ">"
        self._storages: dict[str, bytes] = {}
        self._left = _MAX_NUMBERS

    def pickle(self, name: str) -> Any:
        """A pickle of the archive, as data."""
        return read_pickle(self.archive.read(self.root + name), f"{name} in {self.what}")

    def holds(self, name: str) -> bool:
        """True if the archive has a member of that name."""
        return self.root + name in self.archive

    def tensor(self, node: Any, what: str, folder: str = "data") -> Numbers:
        """The numbers of a tensor, in their own precision; float16 and bfloat16 as float32, which holds them exactly.

        Raises
        ------
        InputError : it is no dense tensor of plain numbers, or reaches out of its storage.
        """
        node = unwrapped(node)
        if not is_tensor(node):
            raise InputError(f"{what} must be a dense tensor; found {brief(node)}.")
        given = node.arguments
        if not isinstance(given, tuple) or len(given) < 6 or not isinstance(given[0], Persistent):
            raise InputError(f"tensor {what} is damaged.")
        _, offset, size, stride = given[:4]
        typed = node.function.name == "_rebuild_tensor_v3"
        dtype = given[6] if typed and len(given) > 6 else None
        # Further arguments may mark the numbers as negated or conjugated, or give their shape.
        if any(given[7 if typed else 6 :]):
            raise InputError(f"tensor {what} must be plain numbers; something is said of how to read them.")
        flat = self._storage(given[0].reference, dtype, what, folder)
        count = product(size, what)
        if type(offset) is not int or offset < 0:
            raise InputError(f"tensor {what} must begin inside its storage.")
        if (
            not isinstance(stride, tuple | list)
            or len(stride) != len(size)
            or not all(type(s) is int and 0 <= s <= flat.size for s in stride)
        ):
            raise InputError(f"the strides of tensor {what} must be as many numbers as its sizes, none below zero.")
        # A view that repeats its storage would make much of little; weights are no such views.
        if not 0 < count <= flat.size:
            raise InputError(f"tensor {what} must have 1 to {flat.size} numbers, as its storage has; it has {count}.")
        self._left -= count
        if self._left < 0:
            raise InputError(f"{self.what} must hold at most {_MAX_NUMBERS} numbers in its tensors; it holds more.")
        last = offset + sum((k - 1) * s for k, s in zip(size, stride, strict=True))
        if last >= flat.size:
            raise InputError(f"tensor {what} must lie inside its storage of {flat.size} numbers; it reaches {last}.")
        index = np.full(tuple(size), offset, dtype=np.int64)
        for axis, (k, s) in enumerate(zip(size, stride, strict=True)):
            shape = [1] * len(size)
            shape[axis] = k
            index += (np.arange(k, dtype=np.int64) * s).reshape(shape)
        result: Numbers = flat[index]
        return result

    def _storage(self, reference: Any, dtype: Any, what: str, folder: str) -> Numbers:
        if isinstance(self.archive, Legacy) and isinstance(reference, tuple) and reference[5:] == (None,):
            reference = reference[:5]  # it is no view of another storage
        if not isinstance(reference, tuple) or len(reference) != 5 or reference[0] != "storage":
            raise InputError(f"tensor {what} must name a storage of the file; it names something else.")
        _, kind, key, _, count = reference
        code = _DTYPES.get(dtype.name) if isinstance(dtype, Name) and dtype.module == "torch" else None
        if code is None and dtype is None and isinstance(kind, Name) and kind.module in ("torch", "torch.cuda"):
            code = _TYPES.get(kind.name.removesuffix("Storage"))
        if code is None:
            raise InputError(f"tensor {what} must hold plain real numbers; its storage is {brief(kind)}.")
        if not isinstance(key, str) or not key.isascii() or not key.isdigit():
            raise InputError(f"tensor {what} must lie in a storage of this file, by its number; found {brief(key)}.")
        name = f"{self.root}{folder}/{key}"
        if name not in self._storages:
            self._storages[name] = self.archive.read(name)
        raw = self._storages[name]
        width = 2 if code == "bf16" else int(code[1])
        # Version 3 of tensors counts its storage in bytes, the others in numbers.
        if type(count) is not int or len(raw) % width or count not in (len(raw) // width, len(raw)):
            raise InputError(f"the storage of tensor {what} must hold what is said of it; it has {len(raw)} bytes.")
        if code == "bf16":
            high = np.frombuffer(raw, dtype=f"{self.order}u2").astype(np.uint32) << 16
            return high.view(np.float32)
        array = np.frombuffer(raw, dtype=f"{self.order}{code}")
        return array.astype(np.float32 if code == "f2" else array.dtype.newbyteorder("="))


def unwrapped(node: Any) -> Any:
    """The tensor of a parameter; any other node as it is."""
    if not isinstance(node, Call) or node.function != Name("torch._utils", "_rebuild_parameter"):
        return node
    return node.arguments[0] if isinstance(node.arguments, tuple) and node.arguments else None


def is_tensor(node: Any) -> bool:
    """True if a node of the pickle describes a dense tensor, or a parameter that is one."""
    if not isinstance(node, Call) or not isinstance(node.function, Name) or node.function.module != "torch._utils":
        return False
    return node.function.name in ("_rebuild_tensor_v2", "_rebuild_tensor_v3", "_rebuild_parameter")


def _require_torchs_names(names: Sequence[str], root: str, what: str) -> None:
    """Refuse an archive of which torch would read other members: it takes the folder of the first one, and capitals for
    small letters."""
    if not names[0].startswith(root) or len({name.lower() for name in names}) != len(names):
        raise InputError(
            f"{what} must begin with its folder {root}, and no two of its members may differ in capital letters alone: "
            "torch would read other ones."
        )


def _depth(name: str) -> int:
    return name.count("/") if name.endswith("/data.pkl") else -1


def written(data: Any) -> bytes:
    """The bytes of a file of torch.save: equal ones for equal data of containers, texts, numbers and arrays."""
    buffer, archive = io.BytesIO(), io.BytesIO()
    writer = _Writer(buffer)
    writer.dump(data)
    members = {"data.pkl": buffer.getvalue(), "byteorder": b"little", "version": b"3\n"}
    members |= {f"data/{k}": array.tobytes() for k, array in enumerate(writer.arrays)}
    with zipfile.ZipFile(archive, "w") as file:
        for name, content in members.items():
            file.writestr(zipfile.ZipInfo(f"archive/{name}"), content)
    return archive.getvalue()


class _Writer(pickle._Pickler):  # whose methods the stubs leave out
    """Pickles containers, with an array as the tensor that torch makes of its bytes."""

    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file, protocol=2)
        self.arrays: list[Numbers] = []

    def persistent_id(self, node: Any) -> Any:
        """The reference of an object outside of the pickle."""
        return node.reference if isinstance(node, Persistent) else None

    def _array(self, array: Numbers) -> None:
        kind = _STORAGES[array.dtype.str[1:]]
        reference = Persistent(("storage", kind, str(len(self.arrays)), "cpu", array.size))
        self.arrays.append(np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<")))
        strides = tuple(s // array.itemsize for s in self.arrays[-1].strides)
        save: Any = self.save  # type: ignore[attr-defined]
        save(_REBUILD)
        save((reference, 0, array.shape, strides, False, OrderedDict()))
        self.write(pickle.REDUCE)  # type: ignore[attr-defined]

    def _name(self, name: Name) -> None:
        self.write(pickle.GLOBAL + f"{name.module}\n{name.name}\n".encode())  # type: ignore[attr-defined]

    dispatch: ClassVar[Any] = {**pickle._Pickler.dispatch, np.ndarray: _array, Name: _name}


_REBUILD = Name("torch._utils", "_rebuild_tensor_v2")
_STORAGES = {code: Name("torch", f"{kind}Storage") for kind, code in _TYPES.items()}
