"""Read zip archives with bounds, without trusting the sizes that members claim."""

from __future__ import annotations

import io
import struct
import zipfile
import zlib

from certify.errors import InputError

MAX_BYTES = 2**29  # of a file, and of a member once it is unpacked


class Archive:
    """The members of a zip archive in memory, each unpacked on demand.

    Parameters
    ----------
    raw : the archive.
    what : its name in messages.

    Raises
    ------
    InputError : it is no zip archive, or two members have one name.
    """

    def __init__(self, raw: bytes, what: str) -> None:
        self.what = what
        try:
            self._zip = zipfile.ZipFile(io.BytesIO(raw))
        except (zipfile.BadZipFile, ValueError, struct.error, NotImplementedError, OverflowError) as error:
            raise InputError(f"{what} is no zip archive or is damaged: {error}.") from error
        start = min((member.header_offset for member in self._zip.infolist()), default=0)
        if start > 0:  # the directory is of a later archive, as of the last one inside of one that is cut
            raise InputError(
                f"{what} must begin with the first member of its archive; what its directory says begins {start} bytes "
                "later. The file is cut, or damaged: fetch it again."
            )
        self.names = tuple(self._zip.namelist())
        if len(set(self.names)) != len(self.names):
            raise InputError(f"{what} must hold each member once; one of its names stands there twice.")
        self._left = MAX_BYTES

    def __contains__(self, name: str) -> bool:
        return name in self.names

    def read(self, name: str) -> bytes:
        """The bytes of a member.

        Raises
        ------
        InputError : there is none of that name, it is damaged, or it unpacks to too much.
        """
        if name not in self.names:
            raise InputError(f"{self.what} must hold {name}; it has {', '.join(self.names[:12]) or 'no members'}.")
        try:
            with self._zip.open(name) as member:
                content = member.read(self._left + 1)
        except (zipfile.BadZipFile, zlib.error, EOFError, ValueError, RuntimeError, OSError, struct.error) as error:
            raise InputError(f"{name} in {self.what} is damaged or encrypted: {error}.") from error
        if len(content) > self._left:
            raise InputError(f"{self.what} must unpack to at most {MAX_BYTES >> 20} MiB; {name} goes beyond it.")
        self._left -= len(content)
        return content
