"""Evidence that the search hands to Coq (Data.v): coordinates, boxes, and each box's reason."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

from certify.errors import InputError

Matrix = tuple[tuple[Fraction, ...], ...]


@dataclass(frozen=True, slots=True)
class Leaf:
    """A box that is not divided, with the multiplier of c2 - V in its inequality."""

    k: float


@dataclass(frozen=True, slots=True)
class Split:
    """A box divided across an axis."""

    axis: int
    at: float
    below: Leaf | Split
    above: Leaf | Split


Tree = Leaf | Split


@dataclass(frozen=True, slots=True)
class Evidence:
    """The evidence that guides Coq's check.

    Parameters
    ----------
    T, W : x = T z and z = W x, inverse to one another, exactly.
    root, core : half-widths in z, of the root box and of the box around the origin.
    splits : the partition tree of the root box.
    """

    T: Matrix
    W: Matrix
    root: tuple[float, ...]
    core: tuple[float, ...]
    splits: Tree

    @property
    def leaves(self) -> int:
        """The number of leaves."""
        count, todo = 0, [self.splits]
        while todo:
            node = todo.pop()
            if isinstance(node, Leaf):
                count += 1
            else:
                todo += [node.below, node.above]
        return count


def inverse(T: Matrix) -> Matrix:
    """The inverse of a matrix of rationals, exactly.

    Raises
    ------
    InputError : it has none.
    """
    n = len(T)
    rows = [[*row, *(Fraction(int(i == j)) for j in range(n))] for i, row in enumerate(T)]
    for k in range(n):
        pivot = next((i for i in range(k, n) if rows[i][k] != 0), None)
        if pivot is None:
            raise InputError("the coordinates must have an inverse; found a singular matrix.")
        rows[k], rows[pivot] = rows[pivot], rows[k]
        head = rows[k][k]
        rows[k] = [v / head for v in rows[k]]
        for i in range(n):
            if i != k and rows[i][k] != 0:
                factor = rows[i][k]
                rows[i] = [v - factor * w for v, w in zip(rows[i], rows[k], strict=True)]
    return tuple(tuple(row[n:]) for row in rows)
