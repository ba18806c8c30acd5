"""Whether loops compiled by numba are there, and when they are worth their start.

numba is optional (`certify[fast]`), takes most of a second to import with what is in its cache, and compiles for
seconds where nothing is. A process gets the loops once it has done as much without them as their start costs, so that a
short search never pays for it and no search pays twice. Which of two threads asks first may decide how a batch is
bounded: either way the bounds hold, and they differ by rounding.
"""

from __future__ import annotations

import importlib
import threading
from types import ModuleType

_WORTH = 1e7  # work that takes as much longer without them as their start takes
_LEAST = 2.0**14  # work that is worth calling them


class Compiled:
    """The module `kernels.py`, or None: called with work that is about to be done, a neuron on a box being 1.

    Parameters
    ----------
    worth : work that has to be asked for before they are loaded.
    least : work for which they are never given.
    """

    def __init__(self, worth: float = _WORTH, least: float = _LEAST) -> None:
        self.worth, self.least = worth, least
        self._lock = threading.Lock()
        self._asked, self._tried = 0.0, False
        self._module: ModuleType | None = None

    def __call__(self, work: float) -> ModuleType | None:
        if work < self.least:
            return None
        with self._lock:
            self._asked += work
            if self._asked >= self.worth and not self._tried:
                self._module, self._tried = _load(), True
            return self._module


def _load() -> ModuleType | None:
    try:
        return importlib.import_module("certify.provers.bounds.kernels")
    except ImportError:  # numba is not installed, or does not know this numpy
        return None


_of_process = Compiled()


def kernels(work: float) -> ModuleType | None:
    """`kernels.py` for that much work, if it is there and worth its start in this process by now."""
    return _of_process(work)
