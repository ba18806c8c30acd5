"""Bounds of boxes as bytes, which travel: a box is its corners, bit for bit, and its bounds are one row.

Bytes from elsewhere are not believed: their lengths have to fit, and they carry the seal of what was asked for, made by
the same sources and the same numpy.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.errors import CertificateFormatError

Array = NDArray[np.float64]
_SEAL = 16  # bytes


@dataclass(frozen=True, slots=True)
class Layout:
    """The bounds of a rule as rows: their class, a named tuple of arrays (..., B), and the types of these."""

    kind: type[Any]
    types: tuple[np.dtype[Any], ...]
    row: np.dtype[Any]

    @classmethod
    def of(cls, found: Any) -> Layout:
        """The layout of bounds like these."""
        types = tuple(values.dtype for values in found)
        plain = (np.dtype(np.uint8) if t == np.bool_ else t for t in types)  # a byte that is no truth value is one so
        row = [(name, t, v.shape[:-1]) for name, t, v in zip(found._fields, plain, found, strict=True)]
        return cls(type(found), types, np.dtype(row))

    def write(self, found: Any) -> bytes:
        """The rows of bounds of boxes, one after the other."""
        rows = np.empty(found[0].shape[-1], self.row)
        for name, values in zip(found._fields, found, strict=True):
            rows[name] = np.moveaxis(values, -1, 0)
        return rows.tobytes()

    def read(self, rows: bytes) -> Any:
        """The bounds in rows."""
        read = np.frombuffer(rows, self.row)
        values = (np.moveaxis(read[name], 0, -1) for name in self.kind._fields)
        return self.kind(*(v.astype(t, order="C") for v, t in zip(values, self.types, strict=True)))


def boxes_of(lo: Array, hi: Array) -> list[bytes]:
    """Boxes of corners (n, B), each as bytes."""
    n, count = lo.shape
    return pieces(np.ascontiguousarray(np.concatenate([lo, hi]).T), 16 * n) if count else []


def corners_of(boxes: list[bytes], n: int) -> tuple[Array, Array]:
    """The corners (n, B) of boxes."""
    both = np.frombuffer(b"".join(boxes)).reshape(len(boxes), 2 * n).T
    return np.ascontiguousarray(both[:n]), np.ascontiguousarray(both[n:])


def pieces(data: Any, size: int) -> list[bytes]:
    """Data as pieces of so many bytes."""
    found: list[bytes] = np.frombuffer(data, f"V{size}").tolist()
    return found


def sealed(job: bytes, body: bytes) -> bytes:
    """The answer to a job with this body."""
    return _seal(job, body) + body


def unsealed(job: bytes, answer: bytes) -> bytes:
    """The body of an answer.

    Raises
    ------
    CertificateFormatError : it is damaged, another job's, or made by another version.
    """
    if answer[:_SEAL] != _seal(job, answer[_SEAL:]):
        raise CertificateFormatError("an answer must have the seal of its job, made by the same version.")
    return answer[_SEAL:]


@cache
def _sources() -> bytes:
    """A digest of the project's sources and numpy's version: with others, bounds may be others."""
    digest = hashlib.blake2b(np.__version__.encode(), digest_size=_SEAL)
    for file in sorted(Path(__file__).parents[2].rglob("*.py")):
        digest.update(file.read_bytes())
    return digest.digest()


def _seal(job: bytes, body: bytes) -> bytes:
    seal = hashlib.blake2b(job, digest_size=_SEAL)
    seal.update(_sources())
    seal.update(body)
    return seal.digest()
