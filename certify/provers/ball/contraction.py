"""Evidence that trajectories come closer near a point of rest that is not the origin: a ball, and weights on it.

The checker bounds what bends F on the ball; the weights say only how it is to share that among the directions, so that
they are worked out from the models at the origin, and nothing is shown here.
"""

from __future__ import annotations

import numpy as np

from certify.certificates import Contraction
from certify.certificates.claims import Problem
from certify.errors import InputError
from certify.provers.ball.local import Array, ball_around
from certify.provers.ball.models import paths

_LEAST = 1e-12  # share of the decay: a weight must not be 0


def contraction(problem: Problem, T: Array, floor: float) -> Contraction | None:
    """The evidence for {V <= floor}; None where not even the linearisation contracts, or the network is too large.

    Parameters
    ----------
    T : (n, n), with T'PT about the unit matrix: the ball is a multiple of x = T z.
    """
    J = ball_around(problem, T, floor)
    try:
        with np.errstate(all="ignore"):
            models = paths(problem.loop).models(J)
    except InputError:
        return None
    A, b = models.A, problem.V.P @ J  # b_i is row i
    if problem.loop.system.time == "discrete":
        A = A - J  # of what a step adds
    crossed = b.T @ A
    decay = -(crossed + crossed.T)
    if problem.loop.system.time == "discrete":
        moved = problem.V.P @ A
        decay, b = decay - A.T @ moved, b + moved
    if not (models.finite and np.linalg.eigvalsh(decay)[0] > 0):
        return None
    half = np.einsum("ia,ijb->jab", b, models.Q)
    N = 2 * (half + half.transpose(0, 2, 1))
    weight = np.asarray(np.linalg.inv(decay), dtype=np.float64)
    spread = np.sum((N @ weight) * N, axis=(0, 2))
    g = np.sqrt(np.maximum(spread, 0.0) / np.diag(weight))
    return Contraction(J, np.maximum(g, _LEAST * float(np.max(np.diag(decay)))), weight)
