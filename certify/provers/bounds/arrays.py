"""Arrays of numpy whose last axis is the boxes, and two operations that numpy has only in ways that know of the others.

A box's bounds must not depend on the boxes beside it, so that they are the same on any number of threads. Elementwise
operations, and sums along an axis that is not the last, are; but a product of matrices rounds as its width has it, and
a sum in blocks where there is one box alone.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]


def product(matrix: Array, values: Array) -> Array:
    """A small matrix (p, q) times (q, ..., B), one column after the other."""
    columns: Array = matrix.T.reshape(*matrix.shape[::-1], *[1] * (values.ndim - 1))
    total: Array = columns[0] * values[0]
    for column, value in zip(columns[1:], values[1:], strict=True):
        total += column * value
    return total


def chosen(mask: Mask) -> Index:
    """The boxes for which it holds, ascending; one alone comes twice."""
    index = np.flatnonzero(mask)
    return np.repeat(index, 2) if len(index) == 1 else index


def is_whole(index: Index, count: int) -> bool:
    """True if these are all of so many boxes, in order."""
    return len(index) == count and (not count or bool(index[0] == 0 and index[-1] == count - 1))


def pieces(count: int, most: int) -> int:
    """Into how many pieces of at most so many boxes these are cut, at least one."""
    return max(1, -(-count // most))


def joined(parts: Any) -> Any:
    """Batches (..., B) one after the other, as one array."""
    return np.concatenate(parts, -1)
