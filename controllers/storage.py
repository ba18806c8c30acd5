"""Files of a run: refused before hours of work and not after, and an earlier result set aside when a run starts."""

from __future__ import annotations

import tempfile
from pathlib import Path

from certify.errors import InputError


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


def set_aside(path: Path) -> None:
    """Rename the file that an earlier run has left at `path`: `policy.pt` becomes `policy.earlier.pt`.

    A run that is cut off must leave nothing where its result is looked for. A file that has the other name is replaced.

    Raises
    ------
    InputError : the file cannot be renamed.
    """
    try:
        path.replace(path.with_suffix(f".earlier{path.suffix}"))
    except FileNotFoundError:
        return
    except OSError as error:
        raise InputError(f"{path} cannot be renamed: {error.strerror}.") from error
