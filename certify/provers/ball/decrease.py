"""The matrix inequality of rules `local` and `tube`, in floats: which multipliers show it best, and by what margin.

On the ball x = J d, `d'J'RJ d + 2 d'J'P F(J d) < 0` for 0 < ||d|| <= 1 if the decay -(J'RJ + B + B') dominates bounds
of what the models of F add to their gradients (checker/FORMAT.md, `decrease`). An error kept apart keeps its direction;
errors of several components taken jointly may cancel, as those of a plant's inputs do. The errors of the tanhs and the
third order take multipliers that follow from one `weight` of directions: there would be a thousand of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from certify.provers.ball.kinks import bound_of
from certify.provers.ball.models import Models

Array = NDArray[np.float64]
_ROUNDS = 16  # rounds of weights that look at bad directions more and more
_FOCUS, _LEAST_WEIGHT = 2.0, 1e-4
_SETTLED = 2e-3  # the least gain of a margin by further rounds
_NEGLIGIBLE, _ROUNDING = 1e-9, 1e-12  # shares: of the bounds; of the decay, where a checker's Q is not quite 0
_SHARE = 0.25  # weight of 1 against d in products of the two, as the checker has it
_OF_ONE = 16  # the weight of 1 over that of all of d, as the checker has it
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


@dataclass(frozen=True, slots=True)
class Corner:
    """The inequality at a corner of a cell, as far as it does not depend on multipliers.

    `b` (n, k) are the weights of the components, `decay` (k, k) is what the rest has to stay below. Where G does not
    vanish at d = 0 it gives `2 linear.d + start` beside them: linear (k,), and each component has the weight `of_1` of
    1 beside b, (n,).
    """

    models: Models
    b: Array
    decay: Array
    linear: Array
    start: float
    of_1: Array


def corners_of(models: Models, J: Array, P: Array, R: Array | None = None, h: float = 0.0) -> list[Corner]:
    """The inequality at each corner of the models' cell, for a step of length h.

    What is known of f and A as a norm is charged to the decay, and so is `h g'P g`, g what the models have beyond them.
    """
    models, weights = models.with_others(P), dict[bytes, Array]()
    gamma = _gamma(models, P) if h else 0.0
    found = []
    for f, A in models.corners:
        key = A.tobytes() if h else b""
        if key not in weights:  # corners with the same b have the same bounds
            weights[key] = P @ (J + h * A) if h else P @ J
        found.append(_corner(models, J, P, R, h, f, A, gamma, weights[key]))
    return found


def _corner(
    models: Models, J: Array, P: Array, R: Array | None, h: float, f: Array, A: Array, gamma: float, b: Array
) -> Corner:
    moved = P @ f
    whole = J.T @ P @ A
    decay = -(whole + whole.T) - (h * A.T @ P @ A if h else 0.0) - (0.0 if R is None else J.T @ R @ J)
    charge = h * (gamma**2 + 2 * math.sqrt(max(float(f @ moved), 0.0)) * gamma)
    start = h * float(f @ moved)
    error, slack = models.rounding, models.slack
    if models.spread is not None:
        error, slack = error + models.spread.error, slack + models.spread.slack
    far, wide = _lengths(models.others, P) if h else (0.0, 0.0)
    wide += _length_of_kinks(models, P) if h else 0.0
    if np.any(error) or np.any(slack) or far or wide:
        roots = np.sqrt(np.diag(P))
        e, s, p = float(roots @ error) + far, float(roots @ slack) + wide, h * np.abs(moved)
        lengths = np.linalg.norm(b, axis=1)
        both = float(lengths @ error + p @ slack) + h * e * s
        charge += 2 * float(lengths @ slack) + h * s * s + 2 * h * gamma * (e + s) + both / _SHARE
        start += 2 * float(p @ error) + h * e * e + _SHARE * both
    found = Corner(models, b, decay - charge * np.eye(len(decay)), b.T @ f, start, h * moved)
    return found if models.kinks is None or not models.cone.narrow else _on_cone(found)


def _on_cone(corner: Corner) -> Corner:
    """The inequality as it is asked on a cone: less what kinks take, and less what is not negative there."""
    cone = corner.models.cone
    S = _of_kinks(corner, cone.weight)
    decay = cone.left(corner.decay - S[1:, 1:])
    return replace(corner, decay=decay, linear=corner.linear + S[1:, 0], start=corner.start + float(S[0, 0]))


def _of_kinks(corner: Corner, weight: Array) -> Array:
    """The bound of what kinks add, over (1, d): (1 + k, 1 + k)."""
    k = len(weight)
    W = np.zeros((1 + k, 1 + k))
    if corner.models.kinks is None:
        return W
    W[1:, 1:], W[0, 0] = weight, _OF_ONE * np.trace(weight)
    return bound_of(corner.models.kinks, corner.models.shares.T @ np.column_stack([corner.of_1, corner.b]), W)


def _length_of_kinks(models: Models, P: Array) -> float:
    """||G||_P has at most this times ||d|| of kinks."""
    if models.kinks is None:
        return 0.0
    each = np.sqrt(np.maximum(np.sum(models.shares * (P @ models.shares), axis=0), 0.0))
    return float(each @ models.kinks.rho)


def _lengths(others: tuple[Array, Array] | None, P: Array) -> tuple[float, float]:
    """(e, s): ||eps||_P of what the others add is at most e + s ||d||."""
    if others is None:
        return 0.0, 0.0
    squares = (
        np.sum((part.swapaxes(1, -1) @ P).swapaxes(1, -1) * part, axis=tuple(range(1, part.ndim))) for part in others
    )
    e, s = (float(np.sum(np.sqrt(np.maximum(each, 0.0)))) for each in squares)
    return e, s


def _gamma(models: Models, P: Array) -> float:
    """||g||_P is at most this times ||d||^2."""
    size = np.sqrt(np.diag(P))
    bends = np.sum(np.tensordot(P, models.Q, 1) * models.Q)
    twists = np.sum(np.tensordot(P, models.K, 1) * models.K)
    units = np.sqrt(np.maximum(np.sum(models.shares * (P @ models.shares), axis=0), 0.0))
    each = np.linalg.norm(models.R, axis=(1, 2)), np.linalg.norm(models.E, axis=(1, 2))
    return float(math.sqrt(max(bends, 0.0)) + math.sqrt(max(twists, 0.0)) + units @ each[0] + size @ each[1])


def best_multipliers(models: Models, J: Array, P: Array, R: Array | None = None, enough: float = math.inf) -> Shown:
    """The multipliers with the largest margin found, for a step of no length.

    Parameters
    ----------
    models : of F on the ball of J.
    J, P, R : (n, n), P positive definite, R symmetric (None: 0).
    enough : the margin at which the search may end; it ends too where no multipliers reach that.
    """
    return best_at(corners_of(models, J, P, R), enough) if models.finite else NOT_SHOWN


def best_at(corners: Sequence[Corner], enough: float = math.inf) -> Shown:
    """The multipliers whose margin is the largest found at the corner where it is least."""
    try:
        roots = [np.linalg.inv(np.linalg.cholesky(corner.decay)) for corner in corners]
    except np.linalg.LinAlgError:
        return NOT_SHOWN
    best = NOT_SHOWN
    for joint in (False, True):
        if best.margin < enough:
            best = max(best, _best_of_a_kind(corners, roots, joint, enough), key=lambda shown: shown.margin)
    return best


def _best_of_a_kind(corners: Sequence[Corner], roots: Sequence[Array], joint: bool, enough: float) -> Shown:
    """`roots` are the inverses of the decays' Cholesky factors, (k, k) each.

    What the rest takes of the decay in its worst direction is least at a saddle: of all weights, of directions at all
    corners, the one whose own best multipliers leave the least. Weights that look at bad directions more and more, by
    all rounds so far, lead there (matrix multiplicative weights: Arora, Hazan, Kale, Theory of Computing 8, 2012,
    section 5), and no multipliers leave more than the weighted mean of any round.
    """
    best, looked = NOT_SHOWN, [np.zeros_like(root) for root in roots]
    weights = [np.eye(len(root)) / (len(root) * len(roots)) for root in roots]
    for _ in range(_ROUNDS):
        seen = [root.T @ weight @ root for root, weight in zip(roots, weights, strict=True)]
        multipliers = _multipliers_at(corners, seen, joint)
        rests = rests_of(corners, multipliers)
        relative = [root @ rest @ root.T for root, rest in zip(roots, rests, strict=True)]
        if not all(np.all(np.isfinite(one)) for one in relative):
            return best
        worst = max(float(np.linalg.eigvalsh(one)[-1]) for one in relative)
        best = max(best, Shown(multipliers, 1 - worst), key=lambda shown: shown.margin)
        most = 1 - sum(float(np.sum(weight * one)) for weight, one in zip(weights, relative, strict=True))
        if not worst > 0 or best.margin >= enough or most < min(enough, best.margin + _SETTLED):
            return best
        looked = [before + _FOCUS / worst * one for before, one in zip(looked, relative, strict=True)]
        spectra = [np.linalg.eigh(one) for one in looked]
        top = max(values[-1] for values, _ in spectra)
        focus = [np.maximum(np.exp(values - top), _LEAST_WEIGHT) for values, _ in spectra]
        total = sum(float(np.sum(part)) for part in focus)
        weights = [(v * (part / total)) @ v.T for (_, v), part in zip(spectra, focus, strict=True)]
    return best


def decay_of(models: Models, J: Array, b: Array, R: Array | None = None) -> Array:
    """-(J'RJ + B + B'), (k, k), where row i of b (n, k) is J'P_i."""
    B = b.T @ models.A
    return -(B + B.T) - (0.0 if R is None else J.T @ R @ J)


def rests_of(corners: Sequence[Corner], multipliers: Multipliers) -> list[Array]:
    """`rest_of` at each corner, (k, k)."""
    known: dict[int, Array] = {}
    for corner in corners:
        if id(corner.b) not in known:
            known[id(corner.b)] = rest_of(corner.models, corner.b, multipliers)
    return [known[id(corner.b)] + of_others(corner, multipliers.weight)[1:, 1:] for corner in corners]


def of_others(corner: Corner, weight: Array) -> Array:
    """The bound of what the models' others add, over (1, d): (1 + k, 1 + k)."""
    k = len(weight)
    found = np.zeros((1 + k, 1 + k)) if corner.models.cone.narrow else _of_kinks(corner, weight)
    if corner.models.others is None:
        return found
    moves, turns = corner.models.others
    W = np.zeros((1 + k, 1 + k))
    W[1:, 1:], W[0, 0] = weight, _OF_ONE * np.trace(weight)
    p = np.concatenate([np.column_stack([corner.of_1, corner.b])] * len(moves))
    steps = np.concatenate([moves[..., None], turns], axis=2).reshape(len(p), 1 + k)
    return found + _by_weight(p, steps[:, :, None] * steps[:, None], W)


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
        rest += np.diag(g) + np.tensordot(C / g[:, None], C, ((0, 1), (0, 1)))
        rest += _by_weight(np.eye(k), _cubic(models, b, beta == 0), multipliers.weight)
    rest += _by_weight(b[beta > 0], _squares(models.K[beta > 0]), multipliers.weight)
    rest += _by_weight(models.shares.T @ b, models.squares, multipliers.weight)
    return (rest + rest.T) / 2


def multipliers_for(models: Models, b: Array, weight: Array, joint: bool | None = None) -> Multipliers:
    """The multipliers with the least trace of weight times the sum of the bounds, for weight (k, k) positive definite.

    `joint` says whether the Q of all components are taken jointly or all apart; None takes the smaller trace.
    """
    return _multipliers_of([(models, b, weight)], joint)


def _multipliers_at(corners: Sequence[Corner], weights: Sequence[Array], joint: bool) -> Multipliers:
    """The same for the sum of the traces at several corners, each with its own weight."""
    parts: dict[int, tuple[Models, Array, Array]] = {}  # corners that share their b share their bounds
    for corner, weight in zip(corners, weights, strict=True):
        _, _, before = parts.get(id(corner.b), (None, None, 0.0))
        parts[id(corner.b)] = corner.models, corner.b, before + weight
    largest = max(float(np.max(np.diag(corner.decay))) for corner in corners)
    return _multipliers_of(list(parts.values()), joint, largest)


def _multipliers_of(
    parts: Sequence[tuple[Models, Array, Array]], joint: bool | None, decay: float = 1.0
) -> Multipliers:
    """`decay` is what g is to be small beside where no component has any weight."""
    n, k = parts[0][1].shape
    usual, whole = 0.0, np.zeros((k, k))
    along, by_size, E2, Q2, spread = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(k)
    for models, b, weight in parts:
        whole = whole + weight
        size = np.linalg.norm(b, axis=1)
        along = along + np.sum((b @ weight) * b, axis=1)
        E2, Q2 = (
            before + np.sum((part @ weight) * part, axis=(1, 2)) for before, part in ((E2, models.E), (Q2, models.Q))
        )
        by_size = by_size + size * np.einsum("ijk,jk->i", models.E, weight)
        C = _joint(models, b, np.ones(n, dtype=bool))
        spread = spread + np.sum((C @ weight) * C, axis=(0, 2))
        usual = max(usual, float(np.max(size)) * float(np.max(np.linalg.norm(models.A, axis=1))))
    with np.errstate(divide="ignore", invalid="ignore"):
        apart = np.sqrt(E2 * along) < by_size
        alpha = np.where(apart, np.sqrt(E2 / along), 0.0)
        beta = np.where(along > 0, np.sqrt(Q2 / along), 0.0)
    diagonal, apart_in_all = np.diag(whole), np.sum(np.sqrt(Q2 * along))
    g = np.sqrt(spread / diagonal)
    least = max(
        _NEGLIGIBLE * float(np.max(g)), _NEGLIGIBLE * apart_in_all / np.trace(whole), _ROUNDING * (usual or decay)
    )
    joint = np.sum(np.sqrt(spread * diagonal)) <= apart_in_all if joint is None else joint
    if joint or not np.all(np.isfinite(beta)):
        beta, g = np.zeros_like(beta), np.maximum(g, least)
    else:  # a component without Q stays joint, at next to no cost
        g = np.full_like(g, least)
    unused = np.zeros(k - n)
    alpha, beta = (np.append(row, unused) for row in (np.where(np.isfinite(alpha), alpha, 0.0), beta))
    return Multipliers(np.array([short(alpha), short(beta), short(g)]), whole)


def _joint(models: Models, b: Array, chosen: NDArray[np.bool_]) -> Array:
    """C_j = sum over the chosen components of (b_i)_j Q_i, (k, k, k)."""
    return np.tensordot(b[chosen].T, models.Q[chosen], 1)


def _cubic(models: Models, b: Array, chosen: NDArray[np.bool_]) -> Array:
    """N_l'N_l for each l, (k, k, k): N is the mean of the sum of the chosen b_i K_i over all orders of four indices."""
    N = np.tensordot(b[chosen].T, models.K[chosen], 1)  # K_i is symmetric: only the index of b is open
    return _squares((N + N.transpose(1, 0, 2, 3) + N.transpose(1, 2, 0, 3) + N.transpose(1, 2, 3, 0)) / 4)


def _squares(forms: Array) -> Array:
    """T'T for forms of order three, (N, k, k, k), as matrices T (k^2, k)."""
    k = forms.shape[-1]
    T = forms.reshape(-1, k**2, k)
    return np.asarray(T.transpose(0, 2, 1) @ T)


def _by_weight(p: Array, squares: Array, weight: Array) -> Array:
    """The sum of the bounds of 2 |p.d| ||T d|| for the rows of p (N, k) and T'T = `squares` (N, k, k)."""
    size = np.einsum("qij,ij->q", squares, weight)
    along = np.sum((p @ weight) * p, axis=1)
    some = ~((size <= 0) | (along <= 0))
    p, tau = p[some], np.sqrt(size[some] / along[some])
    return np.asarray((p.T * tau) @ p + np.tensordot(1 / tau, squares[some], 1))


def short(values: Array) -> Array:
    """The numbers to a few bits."""
    mantissa, exponent = np.frexp(values)
    return np.asarray(np.ldexp(np.round(mantissa * 2.0**_SHORT) / 2.0**_SHORT, exponent))
