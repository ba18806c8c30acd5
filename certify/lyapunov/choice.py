"""Choose P: the candidates by name, and the fallback when the optimised one is unavailable."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from certify.effort import UNLIMITED, Effort
from certify.errors import BackendError, InputError, OptionError
from certify.loop.closed_loop import ClosedLoop
from certify.lyapunov.candidates import solve_lyapunov
from certify.lyapunov.optimised import largest_sampled, optimise_repeatedly

Array = NDArray[np.float64]
Solved = Literal["lyapunov", "scaled", "lqr"]
Named = Literal["lyapunov", "scaled", "lqr", "optimised", "robust", "peak"]
Beyond = Literal["neural", "polynomial"]
Candidate = Literal[
    "auto", "ellipsoid", "lyapunov", "scaled", "lqr", "optimised", "robust", "peak", "neural", "polynomial"
]
SOLVED: tuple[Solved, ...] = ("lyapunov", "scaled", "lqr")
"""The candidates that solve a Lyapunov equation."""
BEYOND: tuple[Beyond, ...] = ("neural", "polynomial")
"""The candidates that are learned for a set beyond the ellipsoid of another one."""


@dataclass(frozen=True, slots=True)
class Chosen:
    """P (n, n), its candidate, and a notice if that is not the requested one."""

    P: Array
    name: Named
    notice: str | None = None


def choose_candidate(
    loop: ClosedLoop,
    name: Literal["lyapunov", "scaled", "lqr", "optimised"],
    Q: tuple[float, ...] | None = None,
    R: tuple[float, ...] | None = None,
    effort: Effort = UNLIMITED,
    decays: tuple[float, ...] | None = None,
) -> Chosen:
    """The candidate `name` for the closed loop.

    Parameters
    ----------
    name : `lyapunov` solves `A'P + PA = -Q`, or its like for the map of a step; `scaled` has the Q that weighs each
        state by its domain, `1 / d_i^2`; `lqr` has `Q + K'RK`, K = -J_pi(0); `optimised` starts at the one of these
        whose sampled set is largest, or at `lyapunov` if Q is given, and enlarges it; it falls back to `lyapunov` with
        a notice.
    Q, R : diagonals, (n,) and (m,); None means ones.
    effort : where it ends, `optimised` takes what it has.
    decays : of `optimised`, its margins over the slowest decay of A, if not the usual ones.

    Raises
    ------
    InputError : a weight is not positive, or the linearisation is not stable.
    """
    K = loop.linearise()[2]
    A, h = loop.mean_rate(), loop.step
    weight = _weight(Q, A.shape[0], "Q")
    if name == "lqr":
        M = K.T @ _weight(R, K.shape[0], "R") @ K
        return Chosen(solve_lyapunov(A, weight + (M + M.T) / 2, h), "lqr")
    if name == "scaled":
        nearer = np.array([min(-float(lo), float(hi)) for lo, hi in loop.system.domain])
        with np.errstate(over="ignore", under="ignore"):
            weights = nearer**-2.0
        if not np.all((weights > 0) & np.isfinite(weights)):
            raise InputError(
                "the domain's half-widths must have squares within the range of binary64; found "
                f"{', '.join(f'{d:g}' for d in nearer)}. Scale the states."
            )
        return Chosen(solve_lyapunov(A, np.diag(weights), h), "scaled")
    P = solve_lyapunov(A, weight, h)
    if name == "lyapunov":
        return Chosen(P, "lyapunov")
    try:
        starts = [P] if Q is not None else [choose_candidate(loop, one).P for one in SOLVED]
        start = largest_sampled(loop, starts, effort=effort) if len(starts) > 1 else P
        return Chosen(optimise_repeatedly(loop, start, effort, decays=decays), "optimised")
    except BackendError as error:
        return Chosen(P, "lyapunov", f"candidate lyapunov instead of optimised: {error}")


def _weight(diagonal: tuple[float, ...] | None, count: int, name: str) -> Array:
    values = np.ones(count) if diagonal is None else np.array(diagonal, dtype=np.float64)
    if values.shape != (count,) or not np.all(np.isfinite(values)) or not np.all(values > 0):
        raise OptionError(f"`{name}` must have {count} positive numbers; found {diagonal}.")
    return np.diag(values)
