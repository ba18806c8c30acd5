"""The format of torch before version 1.6, as data: five pickles in a row, and after them the bytes of the storages.

The pickles are a magic number, the version of the protocol, the writer's sizes of types, what was saved, and the keys
of the storages in the order in which their bytes follow, each after its number of entries. A storage's type stands only
where a tensor refers to it.
"""

from __future__ import annotations

import io
from typing import Any

from certify.errors import InputError
from certify.loop.files.pickles import Name, Persistent, brief, read_next

BEGINNING = b"\x80\x02\x8a\x0al\xfc\x9cF\xf9 j\xa8P\x19."
"""The pickled magic number with which such a file begins."""
_PROTOCOL = 1001
_WIDTHS = {
    "Float": 4, "Double": 8, "Half": 2, "BFloat16": 2, "Long": 8, "Int": 4, "Short": 2, "Char": 1, "Byte": 1, "Bool": 1,
}  # fmt: skip


class Legacy:
    """The members of such a file under the names that a zip file of torch gives them.

    Parameters
    ----------
    raw : the file.
    what : its name in messages.

    Raises
    ------
    InputError : it is damaged, of another protocol, or refers to storages that it does not hold.
    """

    def __init__(self, raw: bytes, what: str) -> None:
        self.what = what
        stream = io.BytesIO(raw)
        read_next(stream, what)
        protocol, _ = read_next(stream, what)
        system, _ = read_next(stream, what)
        if protocol != _PROTOCOL or not isinstance(system, dict) or system.get("little_endian") is not True:
            raise InputError(f"{what} must be of torch's protocol {_PROTOCOL} and little-endian; it is of another.")
        start = stream.tell()
        _, references = read_next(stream, what)
        self._members = {"archive/data.pkl": raw[start : stream.tell()]}
        keys, _ = read_next(stream, what)
        widths = _widths(references, what)
        if not isinstance(keys, list) or not all(isinstance(key, str) for key in keys):
            raise InputError(f"{what} must list the keys of its storages; found {brief(keys)}.")
        if set(keys) != set(widths) or len(set(keys)) != len(keys):
            raise InputError(f"{what} must hold each storage that its tensors name, once, and no other.")
        for key in keys:
            count = int.from_bytes(stream.read(8), "little", signed=True)
            size = count * widths[key]
            content = stream.read(size) if 0 <= size <= len(raw) else b""
            if count < 0 or len(content) != size:
                raise InputError(f"a storage of {what} must lie inside the file; one says that it has {count} numbers.")
            self._members[f"archive/data/{key}"] = content
        if stream.read(1):
            raise InputError(f"{what} must end with its storages; there is more behind them.")

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self._members)

    def __contains__(self, name: str) -> bool:
        return name in self._members

    def read(self, name: str) -> bytes:
        """The bytes of a member.

        Raises
        ------
        InputError : there is none of that name.
        """
        if name not in self._members:
            raise InputError(f"{self.what} must hold {name}; it does not.")
        return self._members[name]


def _widths(references: list[Persistent], what: str) -> dict[str, int]:
    """The bytes of a number of each storage, by its key."""
    found: dict[str, int] = {}
    for each in references:
        given: Any = each.reference
        if isinstance(given, tuple) and len(given) == 4 and given[0] == "module" and isinstance(given[1], Name):
            continue  # the class of a module, and its source
        # The last one is None, or marks a view of another storage, which torch no longer writes.
        if not isinstance(given, tuple) or len(given) != 6 or given[0] != "storage" or given[5] is not None:
            raise InputError(f"{what} must refer to plain storages only; it refers to something else.")
        kind, key = given[1:3]
        width = None
        if isinstance(kind, Name) and kind.module in ("torch", "torch.cuda"):
            width = _WIDTHS.get(kind.name.removesuffix("Storage"))
        if width is None or not isinstance(key, str) or found.setdefault(key, width) != width:
            raise InputError(f"the storages of {what} must hold plain real numbers of one type; found {brief(kind)}.")
    return found
