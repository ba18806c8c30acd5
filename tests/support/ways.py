"""Two ways in which boxes are bounded, by numpy alone and with compiled loops: one of them for a block of code."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from certify.provers.bounds import compiled, vectors
from certify.provers.bounds.kernels import chord, relaxed
from certify.provers.bounds.taylor import EPS, TINY

Array = NDArray[np.float64]

Way = Literal["numpy", "compiled"]
WAYS: tuple[Way, ...] = ("numpy", "compiled")
CHOSEN = {"numpy": compiled.Compiled(worth=math.inf), "compiled": compiled.Compiled(worth=0.0)}  # compiled once


@contextmanager
def bounded(way: Way) -> Iterator[None]:
    """All boxes in that way, however few; fails where numba is missing, so that nothing passes for lack of it."""
    before, chosen = compiled._of_process, CHOSEN[way]
    if way == "compiled" and chosen(1.0) is vectors:
        raise RuntimeError("the tests need numba; found none.")
    compiled._of_process = chosen
    try:
        yield
    finally:
        compiled._of_process = before


@np.errstate(all="ignore")
def relax_tanh(centre: Array, radius: Array) -> tuple[Array, Array, Array]:
    """The lines (s, m, gap) of the producer, |tanh(y) - s y - m| <= gap for |y - centre| <= radius, with the range's
    ends rounded as `kernels.enclosed` does."""
    radius = radius * (1 + EPS) + EPS * abs(centre) + TINY
    ends = centre - radius, centre + radius
    values = np.tanh(ends[0]), np.tanh(ends[1])
    slope, t = chord(*ends, *values)
    shift, gap = relaxed(ends, values, slope, np.arctanh(t), t, centre)
    return slope, shift, gap
