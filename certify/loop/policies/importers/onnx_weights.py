"""Weights of an ONNX model that lie in one more file, as exporters write them.

It is read if it lies in the model's own folder under a plain name and is no link, up to the size that any policy may
have.
"""

from __future__ import annotations

import hashlib
import os
import stat
from pathlib import Path
from typing import Any

from certify.errors import InputError
from certify.loop.files.archives import MAX_BYTES

_INSIDE = "Or write the model again as one file, with torch.onnx.export(..., external_data=False)."


def load_weights(graph_: Any, folder: Path | None, what: str) -> dict[str, str]:
    """Load the tensors of a file beside the model into it; return that file's SHA-256, by its name."""
    import onnx

    contents: dict[str, bytes] = {}
    left = MAX_BYTES
    for tensor in graph_.initializer:
        if tensor.data_location != onnx.TensorProto.EXTERNAL:
            continue
        at = f"tensor {tensor.name} of {what}"
        said = {entry.key: entry.value for entry in tensor.external_data}
        place = said.get("location", "")
        if len(said) != len(tensor.external_data) or place in ("", ".", "..") or set(place) & set("/\\:\0"):
            raise InputError(
                f"{at} must lie in the file itself or in one beside it under a plain name; it lies in {place[:80]!r}. "
                f"{_INSIDE}"
            )
        if folder is None:
            raise InputError(f"{at} must lie in the file itself; it lies in {place[:80]!r}. {_INSIDE}")
        if place not in contents:
            contents[place] = _plain_bytes(folder / place, f"the weights of {what}")
        content = contents[place]
        texts = said.get("offset", "0"), said.get("length", str(len(content)))
        if not all(text.isascii() and text.isdigit() and len(text) < 16 for text in texts):
            raise InputError(
                f"{at} must lie at whole numbers of bytes of {place}; found {texts[0]!r:.40}, {texts[1]!r:.40}."
            )
        offset = int(texts[0])
        length = int(texts[1]) if "length" in said else len(content) - offset
        if length < 0 or offset + length > len(content):
            raise InputError(
                f"{at} must lie inside of {place}, which has {len(content)} bytes; it ends at {offset + length}."
            )
        left -= length
        if left < 0:
            raise InputError(f"the tensors of {what} must have at most {MAX_BYTES >> 20} MiB; they have more.")
        tensor.raw_data = content[offset : offset + length]
        tensor.data_location = onnx.TensorProto.DEFAULT
        del tensor.external_data[:]
    return {place: hashlib.sha256(content).hexdigest() for place, content in contents.items()}


def _plain_bytes(path: Path, what: str) -> bytes:
    """The bytes of a regular file that is no link, if it is small enough for a policy."""
    try:
        # A pipe must not make it wait, nor a link lead elsewhere.
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0))
    except OSError as error:
        raise InputError(
            f"{what} must lie beside it in {path.name}, a plain file and no link; it cannot be read: "
            f"{os.strerror(error.errno or 0)}. Put it there. {_INSIDE}"
        ) from error
    found = os.fstat(handle)
    if not stat.S_ISREG(found.st_mode) or found.st_size > MAX_BYTES:
        os.close(handle)
        raise InputError(
            f"{what} must lie in a plain file of at most {MAX_BYTES >> 20} MiB; {path.name} is none. {_INSIDE}"
        )
    with os.fdopen(handle, "rb") as file:
        return file.read(MAX_BYTES + 1)[:MAX_BYTES]
