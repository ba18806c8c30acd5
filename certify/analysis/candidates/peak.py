"""The candidate `peak`: P for a practical claim, whose floor is to be small beside the set.

What pushes the loop off the origin (a disturbance, a parameter that moves its equilibrium, a policy that is not
centred) makes a floor that P shapes. To first order the least floor c0 of {x'Px <= 1} at an edge k is a linear
matrix inequality in P at each corner of the ranges (the peak of a bounded input: Boyd, El Ghaoui, Feron,
Balakrishnan 1994, section 6.1), and P >= W keeps the set inside one that the local rule proves without the push.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from certify.analysis.candidates.robust import CONE, PROGRAM, NoCandidateError, robust_candidate, solve
from certify.effort import UNLIMITED, Effort
from certify.errors import BackendError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.plants import at_values, corners

Array = NDArray[np.float64]
_EDGES = (0.3, 0.5, 0.65, 0.8)  # shares of the slowest rate at which V can fall
_ROUND = 1e-3  # share of the floor, for a set that is not small where it need not be
_FOR_W = 0.6  # share of the effort
_MOST = 16  # corners


def peak_candidate(loop: ClosedLoop, effort: Effort = UNLIMITED) -> Array:
    """P (n, n), scaled so that about {x'Px <= 1} can be proved where nothing pushes.

    Parameters
    ----------
    loop : the closed loop, with its ranges; without them, and centred, its linearisation is stable.

    Raises
    ------
    BackendError : cvxpy is missing.
    NoCandidateError : there is no such P.
    InputError : the network is larger than the checker's local rule allows.
    """
    try:
        import cvxpy
    except ImportError as error:
        raise BackendError(f"the candidate 'peak' needs cvxpy: {error}. Install it, or use another.") from error
    W, h, n = robust_candidate(_alone(loop), effort.share(_FOR_W)), loop.step, loop.system.n
    corners = _corners(loop)
    slowest = min(-float(np.max(np.linalg.eigvals(L).real)) for L, _ in corners)
    best, least = None, math.inf
    for share in _EDGES:
        P, c0, k = cvxpy.Variable((n, n), symmetric=True), cvxpy.Variable(), 2 * share * slowest
        within = [P >> W]
        for L, f in corners:
            side, b = L.T @ P + P @ L + h * (L.T @ P @ L) + k * P, (np.eye(n) + h * L).T @ P @ f
            corner = cvxpy.reshape(k * c0 - h * (f.T @ P @ f), (1, 1), order="C")
            within.append(cvxpy.bmat([[-side, -b], [-b.T, corner]]) >> 0)
        size = cvxpy.trace(np.linalg.inv(W) @ P) / n
        effort.charge(PROGRAM + CONE * n**4 * (len(corners) * (n + 1) ** 2 + n**2))
        problem = cvxpy.Problem(cvxpy.Minimize(c0 + _ROUND * size), within)
        if not solve(problem):
            continue
        if P.value is not None and np.all(np.isfinite(P.value)) and float(c0.value) < least:
            best, least = np.asarray((P.value + P.value.T) / 2), float(c0.value)
        if effort.over:
            break
    if best is None or not slowest > 0:
        raise NoCandidateError("no ellipsoid is found that keeps what pushes the loop small beside the set", effort)
    return best


def _alone(loop: ClosedLoop) -> ClosedLoop:
    """The loop whose input follows at once, at the nominal values, centred."""
    system = loop.system.with_ranges(dict.fromkeys(loop.system.ranges)).with_sample(None)
    network = replace(loop.folded, centre="output") if loop.network.centre == "none" else loop.network
    return ClosedLoop(system, network)


def _corners(loop: ClosedLoop) -> list[tuple[Array, Array]]:
    """G to first order at corners of the ranges: L (n, n) and f (n, 1) with G = L x + f."""
    system, found = loop.system, []
    origin = np.zeros(system.n)
    u, field = loop.policy(origin[None])[0], system.uncertain_function()
    for values in corners(system, _MOST):
        held = ClosedLoop(at_values(system, values), loop.network)
        f = np.asarray(field(origin, u, [float(q) for q in values.values()]), dtype=np.float64)
        found.append((held.mean_rate(), f[:, None]))
    return found
