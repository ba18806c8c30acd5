"""The matrix inequality of rules `local` and `tube`, in floats: which multipliers show it best, and by what margin.

On the ball x = J d, `d'J'RJ d + 2 d'J'P F(J d) < 0` for 0 < ||d|| <= 1 if the decay -(J'RJ + B + B') dominates bounds
of what the models of F add to their gradients (checker/FORMAT.md, `decrease`). An error kept apart keeps its direction;
errors of several components taken jointly may cancel, as those of a plant's inputs do. What the tanhs leave, and the
third order, take multipliers that follow from one `weight` of directions: there would be a thousand of them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from certify.engines.models import Models

Array = NDArray[np.float64]
_ROUNDS = 16  # of weights that look at bad directions more and more
_FOCUS, _LEAST_WEIGHT = 2.0, 1e-4
_SETTLED = 2e-3  # of a margin: more rounds are not worth less
_NEGLIGIBLE, _ROUNDING = 1e-9, 1e-12  # of the bounds; of the decay, where a checker's Q is not quite 0
_SHORT = 5  # bits of a multiplier: the checker's rationals stay short


@dataclass(frozen=True, slots=True)
class Multipliers:
    """`rows` (3, k): alpha and beta, of which n entries count, and g; `weight` (k, k), k the entries of d."""

    rows: Array
    weight: Array


@dataclass(frozen=True, slots=True)
class Shown:
    """Multipliers, and the share of the decay that the rest leaves: positive means that they show it."""

    multipliers: Multipliers
    margin: float


NOT_SHOWN = Shown(Multipliers(np.zeros((3, 0)), np.zeros((0, 0))), -math.inf)


def best_multipliers(models: Models, J: Array, P: Array, R: Array | None = None, enough: float = math.inf) -> Shown:
    """The multipliers with the largest margin found.

    Parameters
    ----------
    models : of F on the ball of J.
    J, P, R : (n, n), P positive definite, R symmetric (None: 0).
    enough : the margin at which the search may end; it ends too where no multipliers reach that.
    """
    if not models.finite:
        return NOT_SHOWN
    b = P @ J
    decay = decay_of(models, J, b, R)
    try:
        root = np.linalg.cholesky(decay)
    except np.linalg.LinAlgError:
        return NOT_SHOWN
    inverse, best = np.linalg.inv(root), NOT_SHOWN
    for joint in (False, True):
        if best.margin < enough:
            best = max(best, _best_of_a_kind(models, b, inverse, joint, enough), key=lambda shown: shown.margin)
    return best


def _best_of_a_kind(models: Models, b: Array, inverse: Array, joint: bool, enough: float) -> Shown:
    """`inverse` (n, n) is that of the decay's Cholesky factor.

    What the rest takes of the decay in its worst direction is least at a saddle: of all weights the one whose own best
    multipliers leave the least. Weights that look at bad directions more and more, by all rounds so far, lead there
    (matrix multiplicative weights: Arora, Hazan, Kale, Theory of Computing 8, 2012, section 5), and no multipliers
    leave more than the weighted mean of any round.
    """
    best, looked = NOT_SHOWN, np.zeros_like(inverse)
    weight = np.eye(len(inverse)) / len(inverse)
    for _ in range(_ROUNDS):
        multipliers = multipliers_for(models, b, inverse.T @ weight @ inverse, joint)
        relative = inverse @ rest_of(models, b, multipliers) @ inverse.T
        if not np.all(np.isfinite(relative)):
            return best
        worst = float(np.linalg.eigvalsh(relative)[-1])
        best = max(best, Shown(multipliers, 1 - worst), key=lambda shown: shown.margin)
        most = 1 - float(np.sum(weight * relative))
        if not worst > 0 or best.margin >= enough or most < min(enough, best.margin + _SETTLED):
            return best
        looked += _FOCUS / worst * relative
        values, vectors = np.linalg.eigh(looked)
        focus = np.maximum(np.exp(values - values[-1]), _LEAST_WEIGHT)
        weight = (vectors * (focus / np.sum(focus))) @ vectors.T
    return best


def decay_of(models: Models, J: Array, b: Array, R: Array | None = None) -> Array:
    """-(J'RJ + B + B'), (k, k), where row i of b (n, k) is J'P_i."""
    B = b.T @ models.A
    return -(B + B.T) - (0.0 if R is None else J.T @ R @ J)


def rest_of(models: Models, b: Array, multipliers: Multipliers) -> Array:
    """The sum of the bounds of all that the decay is not, (k, k)."""
    n, k = b.shape
    (alpha, beta), g = multipliers.rows[:2, :n], multipliers.rows[2]
    rest = np.zeros((k, k))
    for i in range(n):
        E, Q, square = models.E[i], models.Q[i], np.outer(b[i], b[i])
        rest += alpha[i] * square + E.T @ E / alpha[i] if alpha[i] > 0 else 2 * np.linalg.norm(b[i]) * E
        rest += beta[i] * square + Q.T @ Q / beta[i] if beta[i] > 0 else 0.0
    if np.any(beta == 0):
        C = _joint(models, b, beta == 0)
        rest += np.diag(g) + np.einsum("jmk,m,jml->kl", C, 1 / g, C, optimize=True)
        rest += _by_weight(np.eye(k), _cubic(models, b, beta == 0), multipliers.weight)
    rest += _by_weight(b[beta > 0], _squares(models.K[beta > 0]), multipliers.weight)
    rest += _by_weight(models.shares.T @ b, models.squares, multipliers.weight)
    return (rest + rest.T) / 2


def multipliers_for(models: Models, b: Array, weight: Array, joint: bool | None = None) -> Multipliers:
    """Those with the least trace of weight times the sum of the bounds, for weight (k, k) positive definite.

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
    return Multipliers(np.array([short(alpha), short(beta), short(g)]), weight)


def _joint(models: Models, b: Array, chosen: NDArray[np.bool_]) -> Array:
    """C_j = sum over the chosen components of (b_i)_j Q_i, (k, k, k)."""
    return np.tensordot(b[chosen].T, models.Q[chosen], 1)


def _cubic(models: Models, b: Array, chosen: NDArray[np.bool_]) -> Array:
    """N_l'N_l for each l, (k, k, k): N is the mean of the sum of the chosen b_i K_i over all orders of four indices."""
    N = np.tensordot(b[chosen].T, models.K[chosen], 1)  # K_i is symmetric: what is left is which index is that of b
    return _squares((N + N.transpose(1, 0, 2, 3) + N.transpose(1, 2, 0, 3) + N.transpose(1, 2, 3, 0)) / 4)


def _squares(forms: Array) -> Array:
    """T'T for forms of order three, (N, k, k, k), as matrices T (k^2, k)."""
    k = forms.shape[-1]
    T = forms.reshape(-1, k**2, k)
    return np.asarray(T.transpose(0, 2, 1) @ T)


def _by_weight(p: Array, squares: Array, weight: Array) -> Array:
    """The sum of the bounds of 2 |p.d| ||T d|| for the rows of p (N, k) and T'T = `squares` (N, k, k)."""
    size = np.einsum("qij,ij->q", squares, weight)
    along = np.einsum("qi,ij,qj->q", p, weight, p, optimize=True)
    some = ~((size <= 0) | (along <= 0))
    p, tau = p[some], np.sqrt(size[some] / along[some])
    return np.asarray((p.T * tau) @ p + np.tensordot(1 / tau, squares[some], 1))


def short(values: Array) -> Array:
    """The numbers to a few bits."""
    mantissa, exponent = np.frexp(values)
    return np.asarray(np.ldexp(np.round(mantissa * 2.0**_SHORT) / 2.0**_SHORT, exponent))
