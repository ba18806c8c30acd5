"""The matrix inequality of rules `local` and `tube`, in floats: which multipliers show it best, and by what margin.

On the ball x = J d, `d'J'RJ d + 2 d'J'P F(J d) < 0` for 0 < ||d|| <= 1 if the decay -(J'RJ + B + B') dominates bounds
of what the models of F add to their gradients (checker/FORMAT.md, `decrease`). An error kept apart keeps its direction;
errors of several components taken jointly may cancel, as those of a plant's inputs do.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from certify.engines.models import Models

Array = NDArray[np.float64]
_ROUNDS = 5  # of weights that look at the worst direction more and more
_FOCUS, _LEAST_WEIGHT = 3.0, 1e-3
_NEGLIGIBLE, _ROUNDING = 1e-9, 1e-12  # of the bounds; of the decay, where a checker's Q is not quite 0
_SHORT = 5  # bits of a multiplier: the checker's rationals stay short


@dataclass(frozen=True, slots=True)
class Shown:
    """Multipliers (3, n), and the share of the decay that the rest leaves: positive means that they show it."""

    multipliers: Array
    margin: float


NOT_SHOWN = Shown(np.zeros((3, 0)), -math.inf)


def best_multipliers(models: Models, J: Array, P: Array, R: Array | None = None) -> Shown:
    """The multipliers with the largest margin found.

    Parameters
    ----------
    models : of F on the ball of J.
    J, P, R : (n, n), P positive definite, R symmetric (None: 0).
    """
    if not models.finite:
        return NOT_SHOWN
    b = P @ J
    decay = decay_of(models, J, b, R)
    try:
        root = np.linalg.cholesky(decay)
    except np.linalg.LinAlgError:
        return NOT_SHOWN
    inverse = np.linalg.inv(root)
    each = (_best_of_a_kind(models, b, inverse, joint) for joint in (True, False))
    return max(each, key=lambda shown: shown.margin)


def _best_of_a_kind(models: Models, b: Array, inverse: Array, joint: bool) -> Shown:
    """`inverse` (n, n) is that of the decay's Cholesky factor."""
    weight, best = inverse.T @ inverse, NOT_SHOWN
    for _ in range(_ROUNDS):
        multipliers = multipliers_for(models, b, weight, joint)
        relative = inverse @ rest_of(models, b, multipliers) @ inverse.T
        if not np.all(np.isfinite(relative)):
            return best
        values, vectors = np.linalg.eigh(relative)
        if 1 - values[-1] > best.margin:
            best = Shown(multipliers, float(1 - values[-1]))
        if not values[-1] > 0:
            return best
        focus = np.maximum(np.exp(_FOCUS * (values / values[-1] - 1)), _LEAST_WEIGHT)
        weight = inverse.T @ (vectors * focus) @ vectors.T @ inverse
    return best


def decay_of(models: Models, J: Array, b: Array, R: Array | None = None) -> Array:
    """-(J'RJ + B + B'), (k, k), where row i of b (n, k) is J'P_i."""
    B = b.T @ models.A
    return -(B + B.T) - (0.0 if R is None else J.T @ R @ J)


def rest_of(models: Models, b: Array, multipliers: Array) -> Array:
    """The sum of the bounds of all that the decay is not, (k, k); multipliers (3, k), of which alpha and beta use n."""
    n, k = b.shape
    (alpha, beta), g = multipliers[:2, :n], multipliers[2]
    rest = np.zeros((k, k))
    for i in range(n):
        E, Q, square = models.E[i], models.Q[i], np.outer(b[i], b[i])
        rest += alpha[i] * square + E.T @ E / alpha[i] if alpha[i] > 0 else 2 * np.linalg.norm(b[i]) * E
        rest += beta[i] * square + Q.T @ Q / beta[i] if beta[i] > 0 else 0.0
    if np.any(beta == 0):
        C = _joint(models, b, beta == 0)
        rest += np.diag(g) + np.einsum("jmk,m,jml->kl", C, 1 / g, C, optimize=True)
    return (rest + rest.T) / 2


def multipliers_for(models: Models, b: Array, weight: Array, joint: bool | None = None) -> Array:
    """Those with the least trace of weight times the sum of the bounds, (3, k), for weight (k, k) positive definite.

    `joint` says whether the Q of all components are taken jointly or all apart; None is what has the smaller trace.
    """
    size = np.linalg.norm(b, axis=1)
    along = np.einsum("ij,jk,ik->i", b, weight, b)
    E2, Q2 = (np.einsum("ikj,jl,ikl->i", part, weight, part, optimize=True) for part in (models.E, models.Q))
    by_size = size * np.einsum("ijk,jk->i", models.E, weight)
    with np.errstate(divide="ignore", invalid="ignore"):
        apart = np.sqrt(E2 * along) < by_size
        alpha = np.where(apart, np.sqrt(E2 / along), 0.0)
        beta = np.where(along > 0, np.sqrt(Q2 / along), 0.0)
    C = _joint(models, b, np.ones(len(b), dtype=bool))
    spread = np.einsum("jmk,kl,jml->m", C, weight, C, optimize=True)
    diagonal, apart_in_all = np.diag(weight), np.sum(np.sqrt(Q2 * along))
    g = np.sqrt(spread / diagonal)
    usual = _ROUNDING * float(np.max(size)) * float(np.max(np.linalg.norm(models.A, axis=1)))  # beside the decay
    least = max(_NEGLIGIBLE * float(np.max(g)), _NEGLIGIBLE * apart_in_all / np.trace(weight), usual)
    joint = np.sum(np.sqrt(spread * diagonal)) <= apart_in_all if joint is None else joint
    if joint or not np.all(np.isfinite(beta)):
        beta, g = np.zeros_like(beta), np.maximum(g, least)
    else:  # what has no Q stays joint, at next to no cost
        g = np.full_like(g, least)
    unused = np.zeros(b.shape[1] - len(b))
    alpha, beta = (np.append(row, unused) for row in (np.where(np.isfinite(alpha), alpha, 0.0), beta))
    return np.array([short(alpha), short(beta), short(g)])


def _joint(models: Models, b: Array, chosen: NDArray[np.bool_]) -> Array:
    """C_j = sum over the chosen components of (b_i)_j Q_i, (k, k, k)."""
    return np.tensordot(b[chosen].T, models.Q[chosen], 1)


def short(values: Array) -> Array:
    """The numbers to a few bits."""
    mantissa, exponent = np.frexp(values)
    return np.asarray(np.ldexp(np.round(mantissa * 2.0**_SHORT) / 2.0**_SHORT, exponent))
