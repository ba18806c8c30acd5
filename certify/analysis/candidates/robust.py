"""The candidate `robust`: P chosen together with the rule that has to prove it, by a sequence of matrix inequalities.

In coordinates in which the present set is the unit ball let P = 1 + X. The rule's matrix inequality, on the ball of
that set and with the multipliers that are best at X = 0, is nearly linear in X for small X, and so is what the inputs
take of their room. Its derivatives are difference quotients of the rule itself, so that nothing of what makes it sharp
is lost: errors that cancel, or that keep their direction. With log det(1 + X) <= tr X the largest set within a trust
region is a small semidefinite program, and the local rule judges what it gives. (Boyd, El Ghaoui, Feron, Balakrishnan,
Linear Matrix Inequalities in System and Control Theory, SIAM 1994, section 5.1, have the inequality for errors that do
not depend on the set.)
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from certify.certificates.claims import Problem
from certify.effort import UNLIMITED, Effort
from certify.errors import BackendError
from certify.loop.closed_loop import ClosedLoop
from certify.lyapunov import SOLVED, choose_candidate, diagonalising_coordinates, domain_limit, volume
from certify.lyapunov.function import Quadratic
from certify.provers.ball.decrease import Corner, Multipliers, best_at, corners_of, rests_of
from certify.provers.ball.local import Rule, ball_around, prove_local
from certify.provers.ball.models import Models, Paths, paths
from certify.provers.base import MANY

if TYPE_CHECKING:
    import cvxpy

Array = NDArray[np.float64]
_TRUST, _MOST_TRUST, _LEAST_TRUST = 0.4, 0.6, 0.01  # bounds of the eigenvalues of X
_WIDER, _NARROWER = 1.5, 0.5  # the next trust region, after a gain as foretold and after none
_FORETOLD = 0.5  # share of the gain that the program promises
_WORTH = 0.005  # gain of the logarithm of a volume: less is none
_DIFFERENCE = 1e-3
_AS_ASKED = 1.05  # a level above which there is little hope, where 1 was asked for
_TOGETHER = 16  # balls that are looked at in one go
_FAR = -1.0  # a margin
PROGRAM, CONE = 2e7, 30.0  # operations of a program, however small, and for each product of its sizes
_AT_ONCE = 0.5  # share of the effort for the loop whose input follows at once, where one is held
_LEFT = 3e-3  # share of the decay that is to be left
_INSIDE = 0.995  # share of the room of an input or a state
_BELOW = 1 - 1e-9  # share of the domain's limit


class NoCandidateError(BackendError):
    """There is no such candidate; `ran_out` says that the effort ended before it was looked for everywhere."""

    def __init__(self, message: str, effort: Effort) -> None:
        super().__init__(message)
        self.ran_out = effort.over


def robust_candidate(loop: ClosedLoop, effort: Effort = UNLIMITED) -> Array:
    """P (n, n), scaled so that the local rule proves {x'Px <= 1}, for the largest such set that the effort finds.

    Parameters
    ----------
    loop : the closed loop; its linearisation is stable.

    Raises
    ------
    BackendError : cvxpy is missing.
    NoCandidateError : the local rule proves nothing with any candidate to begin with.
    InputError : the network is larger than the checker's local rule allows.
    """
    known, proved = paths(loop), list[Array]()
    if loop.system.sample is not None:  # a period is short, and the rule without one is cheap
        at_once = replace(loop, system=loop.system.with_sample(None))
        proved = _all_scaled(known, [robust_candidate(at_once, effort.share(_AT_ONCE))], effort)
    proved = proved or _all_scaled(known, [choose_candidate(loop, name).P for name in SOLVED], effort)
    if not proved:
        raise NoCandidateError(
            "the local rule proves nothing with the candidates that solve a Lyapunov equation", effort
        )
    best = max(proved, key=_log_volume)
    while True:
        before = _log_volume(best)
        best = max((_climbed(known, best, effort, quick) for quick in (True, False)), key=_log_volume)
        if loop.system.n <= MANY or effort.over or _log_volume(best) <= before + _WORTH:
            return best  # boxes add to a ball in few states, and a climb for its sake alone may cost what they add


def solve(problem: cvxpy.Problem) -> bool:
    """Solve a semidefinite program; True if the solver comes to an end.

    The solution may be inaccurate, and is judged by the checker's rules."""
    import cvxpy

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the solution may be inaccurate
            problem.solve(solver=cvxpy.CLARABEL)
    except cvxpy.SolverError:
        return False
    return True


def _climbed(known: Paths, best: Array, effort: Effort, quick: bool) -> Array:
    """From {x'Px <= 1}, P = `best`, on, as far as steps gain and the effort allows; `quick`: with old derivatives as
    long as what they foretell comes, and levels about those that were asked for. Either way may end far below the
    other, and go on from where that ended."""
    trust, about, fresh = _TRUST, None, True
    while trust > _LEAST_TRUST and not effort.over:
        if about is None:
            about, fresh = _linearised(known, best, effort), True
        if about is None:
            break
        effort.charge(PROGRAM + CONE * len(about.slopes) ** 2 * about.slopes.shape[1])
        asked = about.largest(trust)
        found = None if asked is None else _scaled(known, asked, effort, best if quick else None)
        gain = -math.inf if found is None else _log_volume(found) - _log_volume(best)
        as_foretold = asked is not None and gain > _FORETOLD * (_log_volume(asked) - _log_volume(best))
        if fresh:  # older derivatives say little about how far new ones reach
            trust = min(_WIDER * trust, _MOST_TRUST) if as_foretold else _NARROWER * trust
        if found is not None and gain > _WORTH:
            best, about, fresh = found, about.at(found) if quick and as_foretold else None, False
        elif not fresh:
            about = None
    return best


def _log_volume(P: Array) -> float:
    return math.log(volume(P, 1.0))


def _all_scaled(known: Paths, candidates: Sequence[Array], effort: Effort) -> list[Array]:
    """Scale each P by the level that the local rule proves with it; leave out those without one."""
    return [P for P in (_scaled(known, P, effort) for P in candidates) if P is not None]


def _scaled(known: Paths, P: Array, effort: Effort, best: Array | None = None) -> Array | None:
    """P over the largest level that the local rule proves with it; None if there is none, or none with a set that is
    larger than that of `best`, when the level should be about 1."""
    if not np.linalg.eigvalsh(P)[0] > 0:
        return None
    limit, between = domain_limit(P, known.loop.system.domain) * _BELOW, None
    if best is not None:
        least = math.exp(2 / len(P) * (_WORTH + _log_volume(best) - _log_volume(P)))
        between = least, _AS_ASKED
    level = prove_local(*_problem(known, P), limit, known, effort, between)
    return None if level is None else P / level


def _problem(known: Paths, P: Array) -> tuple[Problem, Array]:
    """With the coordinates of its proof."""
    return Problem(known.loop, Quadratic(P)), diagonalising_coordinates(P, known.loop.mean_rate(), known.loop.step)


@dataclass(frozen=True, slots=True)
class _Linearised:
    """The rule around {x'Px <= 1}, x = J d where X = 0.

    A row holds what the decay leaves at each corner of the ranges, (n, n) each, between the `roots`, the
    inverses of those of the decays at X = 0, and how far inputs, states and constraints move, who have that `room`,
    (m + n + K,): `here` at this X. `slopes` are its derivatives at 0 by the entries of X on and above the diagonal.
    """

    rule: Rule
    J: Array
    roots: tuple[Array, ...]
    X: Array
    here: Array
    slopes: Array
    room: Array

    def at(self, P: Array) -> _Linearised | None:
        """From P on, with the same derivatives, which cost much more than a row; None if the rule is far from
        holding."""
        X = self.J.T @ P @ self.J - np.eye(len(P))
        X = (X + X.T) / 2
        ball = _balls(self.J, X[None])[0]
        with np.errstate(all="ignore"):
            models = self.rule.models(ball, 1.0)
            if not (models and all(one.finite for one in models)):
                return None
            corners = _corners(self.rule, models, ball, P)
            shown = best_at(corners)
            held = _kept(self.rule, ball[None])[0]
            here = self.here
            if shown.margin > _FAR:
                here = np.append(_row(models, corners, ball, shown.multipliers, self.roots), held)
        return replace(self, X=X, here=here) if shown.margin > _FAR and np.all(np.isfinite(here)) else None

    def largest(self, trust: float) -> Array | None:
        """P (n, n) of the largest set with (1 + X) up to `trust` of itself from where it is; None if there is none."""
        try:
            import cvxpy
        except ImportError as error:
            raise BackendError(f"the candidate 'robust' needs cvxpy: {error}. Install it, or use another.") from error

        n, now = len(self.J), np.eye(len(self.J)) + self.X
        x = cvxpy.Variable(len(self.slopes))
        change = cvxpy.reshape(np.reshape(_directions(n), (-1, n * n)).T @ x, (n, n), order="C")
        asked = self.here + self.slopes.T @ x
        within = [change << trust * now, change >> -trust * now]
        after = len(self.here) - len(self.room)
        for start in range(0, after, n * n):
            left = cvxpy.reshape(asked[start : start + n * n], (n, n), order="C")
            least = min(_LEFT, float(np.linalg.eigvalsh(self.here[start : start + n * n].reshape(n, n))[0]))
            within.append(left + left.T >> 2 * least * np.eye(n))
        within += [asked[after + j] <= _INSIDE * room for j, room in enumerate(self.room) if math.isfinite(room)]
        problem = cvxpy.Problem(cvxpy.Minimize(cvxpy.trace(np.linalg.inv(now) @ change)), within)
        if not solve(problem) or change.value is None or not np.all(np.isfinite(change.value)):
            return None
        inverse = np.linalg.inv(self.J)
        found = inverse.T @ (now + change.value) @ inverse
        return np.asarray((found + found.T) / 2)


def _linearised(known: Paths, P: Array, effort: Effort) -> _Linearised | None:
    """None if the effort ends before, or the rule is far from holding."""
    problem, T = _problem(known, P)
    rule, J = Rule.at_rest(problem, T, known), ball_around(problem, T, 1.0)
    with np.errstate(all="ignore"):
        models = rule.models(J, 1.0)
        if not (models and all(one.finite for one in models)):
            return None
        corners = _corners(rule, models, J, P)
        shown = best_at(corners)
        if not shown.margin > _FAR:
            return None
        roots = tuple(np.linalg.inv(np.linalg.cholesky(corner.decay)) for corner in corners)
        changes = np.array([np.zeros_like(P), *(_DIFFERENCE * X for X in _directions(len(P)))])
        rows, inverse = list[Array](), np.linalg.inv(J)
        for start in range(0, len(changes), _TOGETHER):
            if effort.over:
                return None
            some = changes[start : start + _TOGETHER]
            effort.charge(len(some) * rule.operations_of_models)
            balls = _balls(J, some)
            held = _kept(rule, balls)
            for X, ball, found, kept in zip(some, balls, rule.models_on(balls, 1.0), held, strict=True):
                corners = _corners(rule, found, ball, P + inverse.T @ X @ inverse)
                rows.append(np.append(_row(found, corners, ball, shown.multipliers, roots), kept))
    here = rows[0]
    slopes = (np.array(rows[1:]) - here) / _DIFFERENCE
    half = [float(min(-lo, hi)) for lo, hi in known.loop.system.domain]
    at_rest = rule.kept_on(J[None]) if problem.keep else None
    room = np.concatenate([models[0].inputs.room, half, [] if at_rest is None else -at_rest[0]])
    return _Linearised(rule, J, roots, changes[0], here, slopes, room) if np.all(np.isfinite(slopes)) else None


def _corners(rule: Rule, models: Sequence[Models], J: Array, P: Array) -> list[Corner]:
    return [corner for one in models for corner in corners_of(one, J, P, None, rule.steps.longest)]


def _kept(rule: Rule, balls: Array) -> Array:
    """The motion of each constraint on each ball, (N, K), infinite where one has no finite model."""
    found = rule.kept_on(balls) if rule.problem.keep else None
    return np.full((len(balls), len(rule.problem.keep)), math.inf) if found is None else found[1]


def _directions(n: int) -> list[Array]:
    """A basis of the symmetric matrices, (n, n) each."""
    found = []
    for i, j in zip(*np.triu_indices(n), strict=True):
        X = np.zeros((n, n))
        X[i, j] = X[j, i] = 1.0
        found.append(X)
    return found


def _balls(J: Array, changes: Array) -> Array:
    """The balls of 1 + X for each X of `changes`, (N, n, n) both."""
    values, vectors = np.linalg.eigh(np.eye(len(J)) + changes)
    return np.asarray(J @ (vectors / np.sqrt(values)[:, None]) @ np.swapaxes(vectors, 1, 2))


def _row(
    models: Sequence[Models], corners: Sequence[Corner], ball: Array, multipliers: Multipliers, roots: Sequence[Array]
) -> Array:
    """As `_Linearised` has it."""
    rests = rests_of(corners, multipliers)
    left = [root @ (c.decay - rest) @ root.T for root, c, rest in zip(roots, corners, rests, strict=True)]
    inputs = models[0].inputs
    moved = np.linalg.norm(inputs.A, axis=1) + inputs.curve
    return np.concatenate([np.ravel(left), moved, np.linalg.norm(ball, axis=1)])
