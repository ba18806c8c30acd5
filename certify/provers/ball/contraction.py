"""Evidence that trajectories come closer near a point of rest that is not the origin: a ball, and weights on it.

The checker bounds what bends F on the ball; the weights say only how it is to share that among the directions, so that
they are worked out from the models at the origin, and nothing is shown here.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from certify.certificates import Contraction
from certify.certificates.claims import Problem
from certify.errors import InputError
from certify.provers.ball.kinks import ALL, Cone, Directions, bound_of, has_kinks, is_left
from certify.provers.ball.local import Array, ball_around
from certify.provers.ball.models import Paths, paths
from certify.provers.ball.steps import steps_of

_MOST_CONES = 1024  # of directions
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
            known = paths(problem.loop)
            models, directions = known.models(J), None
            if not models.finite and (directions := _directions(problem, known, J)) is not None:
                models = steps_of(known, False, 1).models_on(J[None], [()], np.zeros((1, len(J))), ALL)[0][0]
    except InputError:
        return None
    A, b = models.A, problem.V.P @ J  # b_i is row i
    if problem.loop.system.time == "discrete" and directions is None:
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
    return Contraction(J, np.maximum(g, _LEAST * float(np.max(np.diag(decay)))), weight, directions)


def _directions(problem: Problem, known: Paths, J: Array) -> tuple[bytes, ...] | None:
    """Trees of directions on whose cones the loop contracts to first order, whatever the slopes of kinks are; None if
    there are no kinks, or too many cones."""
    if not has_kinks(known.network) or problem.loop.system.ranges or problem.loop.system.sample is not None:
        return None
    steps, P = steps_of(known, False, 1), problem.V.P

    def contracts(cone: Cone) -> bool:
        one = replace(cone, close=True)
        models = steps.models_on(J[None], [()], np.zeros((1, len(J))), one)[0][0]
        if not models.finite or models.kinks is None:
            return False
        b = P @ J + steps.longest * P @ models.A
        crossed = (P @ J).T @ models.A
        decay = -(crossed + crossed.T) - steps.longest * models.A.T @ P @ models.A
        return is_left(decay - bound_of(models.kinks, models.shares.T @ b, np.eye(len(J))))

    found = Directions(len(J)) if contracts(ALL) else Directions(len(J)).refined(contracts, _MOST_CONES)
    return None if found is None else found.trees
