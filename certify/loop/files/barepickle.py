"""A pickle that stands alone, as pickle.dump writes it and frameworks keep their states in, as data.

A tensor of torch in one has its storage as the bytes of a whole file of torch before version 1.6.
"""

from __future__ import annotations

from typing import Any

from certify.errors import InputError
from certify.loop.files.arrays import Numbers, bytes_of
from certify.loop.files.pickles import Call, Name, Persistent, brief, read_pickle
from certify.loop.files.torchfile import TorchFile, is_tensor, unwrapped

BEGINNING = b"\x80"
"""The first byte of such a pickle, unless it is of one of the two protocols before Python 2.3."""
_STORAGE = Name("torch.storage", "_load_from_bytes")


class BarePickle:
    """Its value, and the tensors in it.

    Parameters
    ----------
    raw : the file.
    what : its name in messages.

    Raises
    ------
    InputError : it is damaged, or uses an opcode that plain data does not need.
    """

    def __init__(self, raw: bytes, what: str) -> None:
        self.what = what
        self.root = read_pickle(raw, what)

    def tensor(self, node: Any, what: str) -> Numbers:
        """The numbers of a tensor, as `TorchFile.tensor` gives them.

        Raises
        ------
        InputError : as there, or its storage is not in the pickle.
        """
        node = unwrapped(node)
        plain = is_tensor(node) and isinstance(node.arguments, tuple) and node.arguments
        storage = node.arguments[0] if plain else None
        given = storage.arguments if isinstance(storage, Call) and storage.function == _STORAGE else None
        if not isinstance(given, tuple) or len(given) != 1:
            raise InputError(f"tensor {what} must have its storage in the pickle; found {brief(storage)}.")
        file = TorchFile(bytes_of(given[0], f"tensor {what}"), f"the storage of tensor {what}")
        reference = file.pickle("data.pkl")
        if not isinstance(reference, Persistent):
            raise InputError(f"the storage of tensor {what} must be one; found {brief(reference)}.")
        return file.tensor(Call(node.function, (reference, *node.arguments[1:])), what)
