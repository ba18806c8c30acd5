"""Which P is tried: the three candidates by name, and what happens when the optimised one is not to be had."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from certify.closed_loop import ClosedLoop
from certify.errors import BackendError, InputError
from certify.lyapunov.candidates import solve_lyapunov
from certify.lyapunov.optimised import optimise_candidate

Array = NDArray[np.float64]
Candidate = Literal["lyapunov", "lqr", "optimised"]


@dataclass(frozen=True, slots=True)
class Chosen:
    """P (n, n), the candidate that it comes from, and a notice if that is not the one that was asked for."""

    P: Array
    name: Candidate
    notice: str | None = None


def choose_candidate(
    loop: ClosedLoop, name: Candidate, Q: tuple[float, ...] | None = None, R: tuple[float, ...] | None = None
) -> Chosen:
    """The candidate `name` for the closed loop.

    Parameters
    ----------
    name : `lyapunov` solves `A'P + PA = -Q`; `lqr` has `Q + K'RK` in the place of Q, K = -J_pi(0); `optimised` starts
        at `lyapunov` and enlarges the sampled set, and falls back to it with a notice.
    Q, R : diagonals, (n,) and (m,); None means ones.

    Raises
    ------
    InputError : a weight is not positive, or the linearisation is not stable.
    """
    A, _, K = loop.linearise()
    weight = _weight(Q, A.shape[0], "Q")
    if name == "lqr":
        M = K.T @ _weight(R, K.shape[0], "R") @ K
        return Chosen(solve_lyapunov(A, weight + (M + M.T) / 2), "lqr")
    P = solve_lyapunov(A, weight)
    if name == "lyapunov":
        return Chosen(P, "lyapunov")
    try:
        return Chosen(optimise_candidate(loop, P), "optimised")
    except BackendError as error:
        return Chosen(P, "lyapunov", f"candidate lyapunov in the place of optimised: {error}")


def _weight(diagonal: tuple[float, ...] | None, count: int, name: str) -> Array:
    values = np.ones(count) if diagonal is None else np.array(diagonal, dtype=np.float64)
    if values.shape != (count,) or not np.all(np.isfinite(values)) or not np.all(values > 0):
        raise InputError(f"`{name}` must have {count} positive numbers; found {diagonal}.")
    return np.diag(values)
