"""Files that are there as a whole or not at all, and refusals that come before hours of work, not after."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from certify.errors import InputError


def write_atomically(path: Path, content: bytes) -> None:
    """Replace `path` by `content` in one move: a reader sees the old file or the new one.

    Raises
    ------
    InputError : the file cannot be written there.
    """
    temporary = path.with_name(path.name + ".partial")
    try:
        temporary.write_bytes(content)
        os.replace(temporary, path)
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror}.") from error


def read(path: Path) -> bytes:
    """The bytes of a file.

    Raises
    ------
    InputError : it cannot be read.
    """
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from error


def make_folder(folder: Path) -> None:
    """Make `folder` and those above it unless they are there.

    Raises
    ------
    InputError : it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"the folder {folder} cannot be made: {error.strerror}.") from error


def require_writable(path: Path) -> None:
    """Raise InputError unless a file can be written at `path`; one that is there is left as it is."""
    if path.is_dir():
        raise InputError(f"{path} must be a file to write; it is a folder.")
    try:
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror}.") from error
