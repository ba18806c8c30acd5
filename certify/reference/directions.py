"""Matrices after which the errors of an image are bounded: the same after each step, or such as move with the errors.

Where errors are turned by each step, bounds along the same axes grow by each turn. Those of the last step move along if
the axes do: Q has the directions in which the oldest errors lie now. It is found in floats and then taken as it is, for
any Q that has an inverse is sound.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from operator import mul

from flint import arb, arb_mat

from .balls import finite, total
from .refusal import Refused, require

Rows = list[list[float]]
LITTLE = 2.0**-20  # of each axis, for columns of errors that vanish or are alike


@dataclass(frozen=True)
class Frame:
    """A matrix N and its inverse."""

    N: arb_mat
    inverse: arb_mat

    def moved(self, C: arb_mat, rule: str, at: str) -> Frame:
        """Q^-1 N, Q being that of the QR decomposition of N C + 2^-20 I, R_ii >= 0, with shares for columns of N C."""
        columns = [shares(column) for column in (self.N * C).transpose().tolist()]
        for i, column in enumerate(columns):
            column[i] += LITTLE
        Q = arb_mat(orthogonal(columns))
        try:
            back = Q.inv()
        except ZeroDivisionError:
            raise Refused(rule, at, "the directions of its errors are not certain to have an inverse") from None
        require(finite([*Q.entries(), *back.entries()]), rule, at, "the directions of its errors are not finite")
        return Frame(back * self.N, self.inverse * Q)


def shares(column: list[arb]) -> list[float]:
    """Its numbers, nearly, divided by the sum of their magnitudes, if that is not 0."""
    middles = [v.mid() for v in column]
    size = total(map(abs, middles))
    return [0.0 if size.is_zero() else float(v / size) for v in middles]


def orthogonal(columns: Rows) -> Rows:
    """The rows of Q in Q R, nearly, where R has no entries below its diagonal and none below 0 on it: a product of
    Householder's reflections and of signs. All of it is orthogonal whatever the columns are, which are changed."""
    n = len(columns)
    Q = [[float(i == k) for k in range(n)] for i in range(n)]
    for k, column in enumerate(columns):
        normal = [0.0] * k + column[k:]
        normal[k] += math.copysign(math.hypot(*normal), normal[k])
        size = math.hypot(*normal)
        if size > 0:
            for v in (*columns[k + 1 :], *Q):
                reflect(v, [x / size for x in normal])
        for row in Q if normal[k] > 0 else ():
            row[k] = -row[k]
    return Q


def reflect(v: list[float], normal: list[float]) -> None:
    along = 2 * sum(map(mul, normal, v))
    v[:] = [x - along * y for x, y in zip(v, normal, strict=True)]
