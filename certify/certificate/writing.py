"""Files appear complete or not at all, and a folder has one writer at a time."""

from __future__ import annotations

import fcntl
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from certify.errors import InputError


def write_atomically(path: Path, data: bytes) -> None:
    """Write `data` to `path` in one step, under a name of its own until it is complete.

    Raises
    ------
    InputError : the file cannot be written.
    """
    try:
        write_beside(path, data, ".partial").replace(path)
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror}.") from error


def write_beside(path: Path, data: bytes, suffix: str) -> Path:
    """Write `data` to a new file in the folder of `path`, whose name nobody else has; returns it.

    Raises
    ------
    InputError : the file cannot be written.
    """
    try:
        handle, name = tempfile.mkstemp(prefix=f"{path.stem}.", suffix=suffix, dir=path.parent)
        file = Path(name)
        try:
            with os.fdopen(handle, "wb") as stream:
                stream.write(data)
            file.chmod(0o666 & ~_umask())
        except BaseException:
            file.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror}.") from error
    return file


@contextmanager
def sole_writer(folder: Path) -> Iterator[None]:
    """Make `folder` and lock it until the end; the system lets go of a run that dies.

    Raises
    ------
    InputError : the folder cannot be written, or another run is at work in it.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except OSError as error:
        raise InputError(f"output folder {folder} cannot be written: {error.strerror}.") from error
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise InputError(f"another run is writing into {folder}; wait for it, or name another folder.") from error
        yield
    finally:
        os.close(handle)


def _umask() -> int:
    """The mask of new files; there is no way to read it without setting it."""
    mask = os.umask(0o077)
    os.umask(mask)
    return mask
