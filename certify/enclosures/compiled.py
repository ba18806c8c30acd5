"""Whether loops compiled by numba are there, and when they are worth their start.

numba is optional (`certify[fast]`), takes a quarter of a second to import, and compiles for seconds where nothing is in
its cache. A process asks for them with the work that it is about to do, and gets them once it has done enough without
them for the start to be small beside it: a short search never pays for it, a long one hardly.
"""

from __future__ import annotations

import importlib
import threading
from types import ModuleType

_WORTH = 0.0

_lock = threading.Lock()
_done = 0.0
_found: list[ModuleType | None] = []


def kernels(work: float) -> ModuleType | None:
    """`kernels.py` if it is there and worth its start; `work` is counted, a neuron of a box as 1."""
    global _done
    if _found:
        return _found[0]
    with _lock:
        _done += work
        if _done < _WORTH:
            return None
        if not _found:
            _found.append(_load())
    return _found[0]


def _load() -> ModuleType | None:
    try:
        return importlib.import_module("certify.enclosures.kernels")
    except ImportError:  # numba is not installed, or not for this numpy
        return None
