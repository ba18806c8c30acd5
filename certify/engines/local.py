"""The local step: the largest level below which the linearisation alone proves Vdot < 0, and the evidence for it."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from certify.certificate import LocalBall
from certify.claims import Problem
from certify.engines.cells import Cells, cells_for
from certify.engines.decrease import NOT_SHOWN, Shown, best_multipliers
from certify.engines.models import Paths, paths

Array = NDArray[np.float64]
_LEAST = 1e-280  # a level, below which binary64 holds nothing more
_MARGIN = 1e-3  # share of the decay that is left to the checker's rounding
_ENOUGH = 1.01 * _MARGIN
_WIDER = 1 + 1e-9  # of the ball, which has to contain {V <= c1} beyond all rounding


def prove_local(problem: Problem, T: Array, limit: float, known: Paths | None = None) -> float | None:
    """The largest level up to `limit` that the local proof reaches, within 2 %; None if there is none.

    Parameters
    ----------
    T : (n, n), with T'PT about the unit matrix: the ball of the proof is x = T z.
    known : the `paths` of the loop, if they are there already.

    Raises
    ------
    InputError : the network is larger than the checker's local rule allows.
    """
    known = known or paths(problem.loop)
    cells = _cells(problem, T, known)

    def good(level: float) -> bool:
        return _shown(problem, ball_around(problem, T, level), known, cells, _ENOUGH).margin > _MARGIN

    if good(limit):
        return limit
    high, low = limit, limit
    while not good(low):
        high, low = low, low * 1e-2
        if low <= 1e-30 * limit or low < _LEAST:
            return None
    while high > 1.02 * low:
        middle = math.sqrt(low * high)
        low, high = (middle, high) if good(middle) else (low, middle)
    return low


def local_margin(problem: Problem, T: Array, level: float, known: Paths) -> float:
    """Share of the decay that the remainder leaves on {V <= level}; positive means Vdot < 0."""
    return _shown(problem, ball_around(problem, T, level), known, _cells(problem, T, known)).margin


def local_ball(problem: Problem, T: Array, level: float) -> tuple[LocalBall, tuple[int, ...]]:
    """The evidence for a level that `prove_local` has found, or a lower one, and into how many parts the range of each
    uncertain quantity is cut for it."""
    J, known = ball_around(problem, T, level), paths(problem.loop)
    cells = _cells(problem, T, known)
    shown = _shown(problem, J, known, cells).multipliers
    return LocalBall(J, shown.rows, shown.weight), () if cells is None else cells.cuts


def ball_around(problem: Problem, T: Array, level: float) -> Array:
    """J (n, n), a multiple of T, with {V <= level} inside {J d : ||d|| <= 1}."""
    least = float(np.linalg.eigvalsh(T.T @ problem.V.P @ T)[0])
    return T * (math.sqrt(level / least) * _WIDER) if least > 0 else np.full_like(T, math.inf)


def _cells(problem: Problem, T: Array, known: Paths) -> Cells | None:
    """The cells of what is uncertain; None where nothing is."""
    return cells_for(known, T, problem.V.P) if problem.loop.system.ranges else None


def _shown(problem: Problem, J: Array, known: Paths, cells: Cells | None, enough: float = math.inf) -> Shown:
    with np.errstate(all="ignore"):  # what overflows is not shown
        if cells is not None:
            return cells.shown(J, problem.V.P)
        models = known.models(J)
        return best_multipliers(models, J, problem.V.P, enough=enough) if models.admitted else NOT_SHOWN
