"""The loops of `kernels.py`, compiled by numba once they are worth its start.

numba takes half a second to import with what is in its cache, and compiles for seconds where nothing is. A process gets
the compiled loops once it has done as much with numpy as their start costs, so that a short search never pays for it
and no search pays twice. Nothing that is bounded depends on when that is: both give the same bits.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from types import FunctionType, SimpleNamespace
from typing import Any, Protocol

from certify.provers.bounds import kernels, vectors

_WORTH = 1e7  # work that takes as much longer without them as their start takes
_FORMULAS = (
    *("smaller", "larger", "enclosed", "chord", "relaxed", "bent", "expansion"),
    *("corner", "coefficients", "sizes", "cube", "third", "enter", "result"),
)
_LOOPS = ("ranges", "chords", "relax", "bend", "backwards", "play")
_TYPES = {
    "Line": "f8[::1]",
    "Plane": "f8[:,::1]",
    "Block": "f8[:,:,::1]",
    "float": "f8",
    "int": "i8",
    "bool": "b1",
    "None": "void",
}
_TYPES |= {"Steps": "i8[:,::1]", "Real": "f8"}
_TYPES |= {name: f"UniTuple(f8, {count})" for count, name in ((2, "Two"), (4, "Four"), (5, "Five"))}
Loop = Callable[..., None]


class Loops(Protocol):
    """The loops, on arrays that they change; see `kernels.py`."""

    ranges: Loop
    chords: Loop
    relax: Loop
    bend: Loop
    backwards: Loop
    play: Loop


class Compiled:
    """Gives the loops: called with work that is about to be done, a neuron on a box being 1.

    Parameters
    ----------
    worth : work that has to be asked for before they are compiled.
    """

    def __init__(self, worth: float = _WORTH) -> None:
        self.worth = worth
        self._lock = threading.Lock()
        self._asked = 0.0
        self._loops: Loops = vectors
        self._tried = False

    def __call__(self, work: float) -> Loops:
        with self._lock:
            self._asked += work
            if self._asked >= self.worth and not self._tried:
                self._loops, self._tried = load() or vectors, True
            return self._loops


def load() -> Loops | None:
    """The compiled loops; None where numba is not there, does not know this numpy, or would give other bits."""
    try:
        import numba
    except ImportError:
        return None
    if numba.config.USING_SVML:  # then sin and cos are not libm's, and bits may differ
        return None
    space = {**vars(kernels), **kernels.LIBM}
    space["choose"] = compile_one(numba.njit, kernels.one, space)
    for name in (*_FORMULAS, *_LOOPS):
        space[name] = compile_one(numba.njit, getattr(kernels, name), space)
    return SimpleNamespace(**{name: space[name] for name in _LOOPS})


def compile_one(njit: Any, function: Callable[..., Any], space: dict[str, Any]) -> Any:
    """A function with these names around it, compiled for its annotated types, without the interpreter's lock; into
    numba's cache, if one can be written."""
    *parameters, returned = (_TYPES[name] for name in function.__annotations__.values())
    signature, how = f"{returned}({','.join(parameters)})", {"nogil": True, "error_model": "numpy"}
    bare = FunctionType(function.__code__, space, function.__name__)
    try:
        return njit(signature, cache=True, **how)(bare)
    except (RuntimeError, OSError):  # there is no folder for the cache, or it is full
        return njit(signature, **how)(bare)


_of_process = Compiled()


def loops(work: float) -> Loops:
    """The loops for that much work, compiled if that is worth its start in this process by now."""
    return _of_process(work)
