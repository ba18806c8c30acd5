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
from certify.provers.ball.local import Array, ball_around, order_on
from certify.provers.ball.models import Models, paths
from certify.provers.ball.steps import Steps, steps_of

_MOST_CONES = 1024  # of directions
_LEAST = 1e-12  # share of the decay: a weight must not be 0


def contraction(problem: Problem, T: Array, floor: float) -> Contraction | None:
    """The evidence for {V <= floor}; None where not even the linearisation contracts, or the network is too large.

    Parameters
    ----------
    T : (n, n), with T'PT about the unit matrix: the ball is a multiple of x = T z.
    """
    J, held = ball_around(problem, T, floor), problem.loop.system.sample is not None
    try:
        with np.errstate(all="ignore"):
            steps = steps_of(paths(problem.loop), False, order_on(problem))
            models, directions = _models(steps, J), None
            if not models.finite and (directions := _directions(problem, steps, J)) is not None:
                models = _models(steps, J, ALL)
    except InputError:
        return None
    decay, b = _decay(problem, steps, J, models.A)
    if not (models.finite and np.linalg.eigvalsh(decay)[0] > 0):
        return None
    half = np.einsum("ia,ijb->jab", b, models.Q)
    N = 2 * (half + half.transpose(0, 2, 1))
    weight = np.asarray(np.linalg.inv(decay), dtype=np.float64)
    spread = np.sum((N @ weight) * N, axis=(0, 2))
    g = np.sqrt(np.maximum(spread, 0.0) / np.diag(weight))
    g = np.maximum(g, _LEAST * float(np.max(np.diag(decay))))
    return Contraction(J, g, weight, directions, steps.order if held else None)


def _models(steps: Steps, J: Array, cone: Cone | None = None) -> Models:
    """Models of what a step adds, uncertain quantities in the middle of their ranges."""
    cell = tuple(((lo + hi) / 2,) * 2 for lo, hi in steps.known.loop.system.ranges.values())
    return steps.models_on(J[None], [cell], np.zeros((1, len(J))), cone)[0][0]


def _decay(problem: Problem, steps: Steps, J: Array, A: Array) -> tuple[Array, Array]:
    """The decay of a distance to first order, (n, n), and the b_i of the checker's rule, in rows."""
    P, h = problem.V.P, steps.longest
    crossed = (P @ J).T @ A
    return -(crossed + crossed.T) - h * A.T @ P @ A, P @ (J + h * A)


def _directions(problem: Problem, steps: Steps, J: Array) -> tuple[bytes, ...] | None:
    """Trees of directions on whose cones the loop contracts to first order, whatever the slopes of kinks are; None if
    there are no kinks, or too many cones."""
    if not has_kinks(steps.known.network) or problem.loop.system.ranges:
        return None

    def contracts(cone: Cone) -> bool:
        models = _models(steps, J, replace(cone, close=True))
        if not models.finite or models.kinks is None:
            return False
        decay, b = _decay(problem, steps, J, models.A)
        return is_left(decay - bound_of(models.kinks, models.shares.T @ b, np.eye(len(J))))

    found = Directions(len(J)) if contracts(ALL) else Directions(len(J)).refined(contracts, _MOST_CONES)
    return None if found is None else found.trees
