"""Write files completely or not at all, with one writer per folder at a time."""

from __future__ import annotations

import fcntl
import os
import tempfile
from collections.abc import Callable, Iterator
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
    """Write `data` to a new file with a unique name in the folder of `path`; return it.

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


SEARCH = "search.json"
_CERTIFICATE = "certificate.json"
_OURS = {_CERTIFICATE: b"certify-certificate/", "report.html": b"-m certify.checker", SEARCH: b"certify-search/"}
"""The files that a run writes, by names, each with words that its text holds."""


@contextmanager
def earlier_aside(folder: Path, tell: Callable[[str], None], *, keep: bool = False) -> Iterator[None]:
    """Set an earlier run's files aside during a run; a run that cannot begin, by an `InputError`, leaves them in place.

    Parameters
    ----------
    tell : told where the earlier certificate lies, if the run ends without one of its own.
    keep : True to leave the saved search in place, to be resumed.

    Raises
    ------
    InputError : a file cannot be renamed, or somebody's own file has the other name.
    """
    renamed = set_aside(folder, keep=keep)
    try:
        yield
    except InputError:
        for path, other in renamed.items():
            if not path.exists():
                other.replace(path)
        raise
    finally:
        path = folder / _CERTIFICATE
        if path in renamed and not path.exists():
            tell(f"no certificate is written; that of an earlier run is kept as {renamed[path]}")


def set_aside(folder: Path, *, keep: bool = False) -> dict[Path, Path]:
    """Rename an earlier run's files in a folder, `certificate.json` to `certificate.earlier.json` and so on.

    A run's folder must not show another run's results, and hours of work must not be lost to a slip.

    A file that by its name and its text belongs to no run stays as it is.

    Parameters
    ----------
    keep : True to leave the saved search in place, to be resumed.

    Returns
    -------
    dict : the new path of each file that was renamed.

    Raises
    ------
    InputError : a file cannot be renamed, or somebody's own file has the other name.
    """
    renamed = dict[Path, Path]()
    for name, text in _OURS.items():
        path = folder / name
        if (keep and name == SEARCH) or not _holds(path, text):
            continue
        other = path.with_suffix(f".earlier{path.suffix}")
        if other.exists() and not _holds(other, text):
            raise InputError(f"{path} is to be kept as {other.name}, which is another file; rename one of them.")
        try:
            path.replace(other)
        except OSError as error:
            raise InputError(f"{path} cannot be renamed: {error.strerror}.") from error
        renamed[path] = other
    return renamed


def remove(path: Path) -> None:
    """Remove a file of a run, if it is one by its name and its text."""
    if _holds(path, _OURS[path.name]):
        path.unlink(missing_ok=True)


def _holds(path: Path, text: bytes) -> bool:
    try:
        return path.is_file() and text in path.read_bytes()
    except OSError:
        return False


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
