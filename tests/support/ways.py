"""Two ways in which boxes are bounded, by torch alone and with compiled loops: one of them for a block of code."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal

from certify.provers.bounds import compiled

Way = Literal["torch", "compiled"]
WAYS: tuple[Way, ...] = ("torch", "compiled")


@contextmanager
def bounded(way: Way) -> Iterator[None]:
    """All boxes in that way, however few; fails where numba is missing, so that nothing passes for lack of it."""
    before = compiled._of_process
    chosen = compiled.Compiled(worth=math.inf) if way == "torch" else compiled.Compiled(worth=0.0, least=0.0)
    if way == "compiled" and chosen(1.0) is None:
        raise RuntimeError("the tests need numba; found none: install the extra `test`.")
    compiled._of_process = chosen
    try:
        yield
    finally:
        compiled._of_process = before
