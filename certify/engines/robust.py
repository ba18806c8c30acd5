"""The candidate `robust`: P chosen together with the bound that has to prove it, by a sequence of matrix inequalities.

On a ball somewhat larger than the present set the models of the closed loop are F = sum of A d and errors n_i along the
axes e_i, |n_i|^2 <= d'R_i d. V = x'Px then decreases on {V <= 1}, inside the ball, if with Y = P^-1 and lambda_i > 0

    A Y + Y A' + sum_i (lambda_i e_i e_i' + Y R_i Y / lambda_i) < 0,

which is a linear matrix inequality in Y and lambda: its largest det Y is found, and the ball follows the new set. Each
step is judged by the local rule itself, whose bounds are sharper; one that does not gain is refused, and the next is
shorter (Boyd, El Ghaoui, Feron, Balakrishnan, Linear Matrix Inequalities in System and Control Theory, SIAM 1994,
sections 5.1 and 7.2).
"""

from __future__ import annotations

import math
import time
import warnings

import numpy as np
from numpy.typing import NDArray

from certify.claims import Problem
from certify.closed_loop import ClosedLoop
from certify.engines.local import prove_local
from certify.engines.models import Paths, paths
from certify.errors import BackendError
from certify.lyapunov import SOLVED, choose_candidate, diagonalising_coordinates, domain_limit, volume
from certify.lyapunov.function import Quadratic

Array = NDArray[np.float64]
_STEP, _LEAST_STEP = 1.2, 1.01  # size of the ball, relative to the present set
_WORTH = 1.001  # of a volume: less is no gain
_SLACK = 1e-2  # of the decrease, in the coordinates in which the present set is the unit ball
_SMALL, _THIN = 1e-13, 1e-5  # errors, and directions of one, that are left out
_BELOW = 1 - 1e-9  # of the domain's limit


def robust_candidate(loop: ClosedLoop, seconds: float = math.inf) -> Array:
    """P (n, n), scaled so that the local rule proves {x'Px <= 1}, for the largest such set found in the time.

    Parameters
    ----------
    loop : the closed loop; its linearisation is stable.

    Raises
    ------
    BackendError : cvxpy is missing, or the local rule proves nothing with any candidate to begin with.
    InputError : the network is larger than the checker's local rule allows.
    """
    end, known = time.perf_counter() + seconds, paths(loop)
    starts = [_scaled(loop, known, choose_candidate(loop, name).P) for name in SOLVED]
    proved = [P for P in starts if P is not None]
    if not proved:
        raise BackendError("the local rule proves nothing with the candidates that solve a Lyapunov equation")
    best = max(proved, key=lambda P: volume(P, 1.0))
    step = _STEP
    while step > _LEAST_STEP and time.perf_counter() < end:
        try:
            asked = _larger(known, best, step)
        except np.linalg.LinAlgError:  # an ellipsoid without extent in some direction
            asked = None
        found = None if asked is None else _scaled(loop, known, asked)
        if found is not None and volume(found, 1.0) > _WORTH * volume(best, 1.0):
            best = found
        else:
            step = 1 + (step - 1) / 2
    return best


def _scaled(loop: ClosedLoop, known: Paths, P: Array) -> Array | None:
    """P over the largest level that the local rule proves with it; None if there is none."""
    if not np.linalg.eigvalsh(P)[0] > 0:
        return None
    T = diagonalising_coordinates(P, loop.linearise()[0])
    level = prove_local(Problem(loop, Quadratic(P)), T, domain_limit(P, loop.system.domain) * _BELOW, known)
    return None if level is None else P / level


def _larger(known: Paths, P: Array, step: float) -> Array | None:
    """The P of the matrix inequality on a ball `step` times as large as {x'Px <= 1}; None if there is none."""
    try:
        import cvxpy
    except ImportError as error:
        raise BackendError(f"the candidate 'robust' needs cvxpy: {error}. Install it, or use another.") from error

    n = len(P)
    L = np.linalg.inv(np.linalg.cholesky(P)).T
    with np.errstate(all="ignore"):
        models = known.models(step * L)
    if not (models.finite and models.admitted):
        return None
    inverse = np.linalg.inv(L)
    A = inverse @ models.A / step
    Y = cvxpy.Variable((n, n), symmetric=True)
    corner, columns, weights = A @ Y + Y @ A.T + _SLACK * np.eye(n), [], []
    for i in range(n):
        root = _error(models.Q[i], models.E[i], float(np.linalg.norm(models.A[i])))
        if root is None:
            continue
        balance = math.sqrt(np.linalg.norm(root) / (step * np.linalg.norm(inverse[:, i])))
        along, root = balance * inverse[:, i], root / (step * balance)
        weight = cvxpy.Variable(nonneg=True)
        corner = corner + weight * np.outer(along, along)
        columns.append(Y @ root.T)
        weights.append(weight * np.ones(len(root)))
    if not columns:
        return None
    edge = cvxpy.hstack(columns)
    whole = cvxpy.bmat([[corner, edge], [edge.T, -cvxpy.diag(cvxpy.hstack(weights))]])
    within = [Y << step**2 * np.eye(n), (whole + whole.T) / 2 << 0]
    problem = cvxpy.Problem(cvxpy.Maximize(cvxpy.log_det(Y)), within)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a solution that may be inaccurate: the local rule judges it
            problem.solve(solver=cvxpy.CLARABEL)
    except cvxpy.SolverError:
        return None
    if Y.value is None or not np.all(np.isfinite(Y.value)):
        return None
    found = inverse.T @ np.linalg.inv(Y.value) @ inverse
    return np.asarray((found + found.T) / 2)


def _error(Q: Array, E: Array, size: float) -> Array | None:
    """A root of R, (k, n), with (d'Qd + r)^2 <= d'Rd for ||d|| <= 1 and |r| <= d'Ed; None if that is as good as 0."""
    q, e = float(np.linalg.norm(Q, 2)), float(np.linalg.norm(E, 2))
    if q + e <= _SMALL * size:
        return None
    R = (1 + e / q) * Q.T @ Q + (1 + q / e) * E.T @ E if q > 0 and e > 0 else Q.T @ Q + E.T @ E
    values, vectors = np.linalg.eigh(R)
    kept = values > _THIN * values[-1]
    return np.asarray((vectors[:, kept] * np.sqrt(values[kept])).T)
