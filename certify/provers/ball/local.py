"""The local step: the largest level below which the linearisation alone proves V's decrease, and the evidence for it.

Around a level c0 of a practical claim the models do not start from 0, and what drives V up near the origin is paid with
`edge (V - c0)`: so c0 has a least value for each ball, and each ball its best edge.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from certify.certificates import LocalBall
from certify.certificates.claims import Problem
from certify.effort import UNLIMITED, Effort
from certify.loop.expressions import Expression, symbols_of
from certify.loop.plants import System, corners_at_rest
from certify.lyapunov import domain_limit, extents
from certify.provers.ball.cells import cut, cuts_for
from certify.provers.ball.decrease import (
    NOT_SHOWN,
    Corner,
    Multipliers,
    Shown,
    best_at,
    corners_of,
    of_others,
    rests_of,
)
from certify.provers.ball.kinks import ALL, Cone, Directions, has_kinks, is_left
from certify.provers.ball.models import AT_CORNERS, Models, Paths, meets_corner, paths
from certify.provers.ball.steps import Cell, Steps, steps_of
from certify.provers.base import FEW

Array = NDArray[np.float64]
_LEAST = 1e-280  # a level, below which binary64 holds nothing more
_MARGIN = 1e-3  # share of the decay that is left to the checker's rounding
_ENOUGH = 1.01 * _MARGIN
_WIDER = 1 + 1e-9  # factor of the ball, which has to contain {V <= c1} beyond all rounding
_WEIGHINGS, _WEIGHING = 8, 7e5  # rounds of multipliers on a ball, and operations of one, however small
_ORDER = 4  # order of the series in time, where an input is held
_FAR, _NEAR = 1e-2, 0.3  # from one level to the next lower one, where all below one is good, and where not
_LOWER = 0.5  # from one level to the next, while floors fall with them
_NOTHING = 1e-10  # share of the limit: no floor is asked to be lower
_EDGES = 400  # edges that are tried
_AMPLE = 0.3  # a margin that is good enough for the multipliers of a floor
_ROUNDS = 3  # rounds of multipliers and edge, each best for the other
_WORTH = 0.01  # share of a floor: less is no gain
_ROUNDING = 1e-12  # share of the decay: the checker's numbers are in doubt by it at d = 0 as well
_MOST_CONES = 4096  # of directions
_FAR_BELOW = 1e-3  # share of its limit below which a level is tried to be raised by kinks
_WORTH_KINKS, _DOWN = 4.0, 0.1  # from a level without kinks to the first with them, and on; down to one that is good
_FOR_KINKS = 0.5  # share of the effort for a higher level with kinks, where one is found without
_TINY, _LOWEST = 1e-10, 1e-6  # shares of the largest level: where directions are chosen, and the lowest that is tried
_SHARED = 0.1  # share of a rule's operations that one of many cones takes
_ABOVE = 1 + 1e-3  # factor of the least floor that is shown


def prove_local(
    problem: Problem,
    T: Array,
    limit: float,
    known: Paths | None = None,
    effort: Effort = UNLIMITED,
    between: tuple[float, float] | None = None,
) -> float | None:
    """The largest level up to `limit` that the local proof of a claim at rest reaches, within 2 %; None if there is
    none, or the effort ends before one is found.

    Parameters
    ----------
    T : (n, n), with T'PT about the unit matrix: the ball of the proof is x = T z.
    known : the `paths` of the loop, if they are there already.
    effort : where it ends, the search ends with what it has.
    between : a level below which nothing is of interest, and a higher one, above which little is expected.

    Raises
    ------
    InputError : the network is larger than the checker's local rule allows.
    """
    rule = Rule.at_rest(problem, T, known)
    if rule.cuts is None:
        return None

    def good(level: float) -> bool:
        effort.charge(rule.operations)
        return rule.shown(level, _ENOUGH).margin > _MARGIN

    if between is None:
        found = _largest(good, limit, effort)
        return _beyond_kinks(rule, found, limit, effort) if found is None or found < _FAR_BELOW * limit else found
    low, high = between[0], min(between[1], limit)
    if not (low < high and good(low)):
        return None
    while high < limit and not effort.over and good(high):
        low, high = high, min(high * high / low, limit)
    return _closer(good, low, high, effort)


def _beyond_kinks(rule: Rule, found: float | None, limit: float, effort: Effort) -> float | None:
    """A large level up to `limit` that the rule proves with kinks, or the one that was found without."""
    if not has_kinks(rule.steps.known.network):
        return found

    def good(level: float, kinked: Rule | None) -> bool:
        if kinked is None or kinked.directions is None or effort.over:
            return False
        effort.charge(kinked.operations)
        return kinked.shown(level, _ENOUGH).margin > _MARGIN

    if found is not None:
        low, high = found, min(_WORTH_KINKS * found, limit)
        while low < limit and good(high, rule.with_kinks(high, effort)):
            low, high = high, min(high * _WORTH_KINKS, limit)
        return low
    kinked, level = rule.with_kinks(limit, effort), limit
    while not good(level, kinked):
        level *= _DOWN
        if kinked is None or level < _LOWEST * limit or effort.over:
            return None
    if level < limit and len(rule.T) > FEW:  # no ring is expected to lead on
        return _closer(lambda one: good(one, kinked), level, min(level / _DOWN, limit), effort)
    return level


def prove_band(
    problem: Problem,
    T: Array,
    limit: float,
    known: Paths | None = None,
    effort: Effort = UNLIMITED,
    above: float = 1.5,
    beside: float = 0.0,
) -> tuple[float, float] | None:
    """(c0, c1) with c0 < c1: V falls where c0 <= V <= c1; None if there are none, or the effort
    ends before.

    Parameters
    ----------
    known : the `paths` of the loop, which need not be at rest.
    effort : where it ends, the search ends with what it has.
    above, beside : a large ball has a large floor: c1, up to `limit`, is about the largest level whose ball shows a
        floor of at most `above` times the least that any ball shows, or of at most `beside` times c1, which nothing
        smaller is worth; c0 is that floor.

    Raises
    ------
    InputError : the network is larger than the checker's local rule allows.
    """
    rule = Rule.anywhere(problem, T, known)
    if rule.cuts is None:
        return None
    found = _band(lambda level: _alone(rule, level, effort)[1].floor, limit, effort, above, beside)
    if not has_kinks(rule.steps.known.network) or (found is not None and found[1] >= _NEAR * limit):
        return found
    part, least = (effort, 0.0) if found is None else (effort.share(_FOR_KINKS), found[1])
    return _band(lambda level: _around(rule, level, part)[1].floor, limit, part, above, beside, least) or found


def _band(
    floor_on: Callable[[float], float],
    limit: float,
    effort: Effort,
    above: float,
    beside: float = 0.0,
    lowest: float = 0.0,
) -> tuple[float, float] | None:
    """The same by the least floor on the ball of a level; None also where no level from `lowest` on has a lower one.

    A floor that roundings alone make falls with the level, as its root: `beside` ends the search for the least.
    """
    floors: dict[float, float] = {}

    def floor(level: float) -> float:
        if level not in floors:
            floors[level] = max(floor_on(level), _NOTHING * limit)
        return floors[level]

    level = limit
    while not floor(level) < level:
        level *= _NEAR
        if level <= max(1e-30 * limit, lowest) or level < _LEAST or effort.over:
            return None
    least = floor(level)
    while not effort.over and floor(level) > beside * level:
        if not floor(level * _LOWER) < min(level * _LOWER, (1 - _WORTH) * least):
            break
        level, least = level * _LOWER, floor(level * _LOWER)

    def good(level: float) -> bool:
        return floor(level) < level and floor(level) <= max(above * least, beside * level)

    c1 = max(filter(good, floors))
    higher = [level for level in floors if level > c1]
    c1 = _closer(good, c1, min(higher), effort) if higher else c1
    return floor(c1), c1


def _around(rule: Rule, level: float, effort: Effort = UNLIMITED, floor: float = math.inf) -> tuple[Rule, _Around]:
    """The rule, with kinks where it shows no floor up to that without, and the least floor on the ball of a level."""
    found = _alone(rule, level, effort)
    if found[1].floor < level and found[1].floor <= floor:
        return found
    kinked = rule.with_kinks(level, effort)
    return found if kinked is None else _alone(kinked, level, effort)


def _alone(rule: Rule, level: float, effort: Effort) -> tuple[Rule, _Around]:
    """The rule as it is."""
    found = rule.around(level)
    effort.charge(max(found.rounds * rule.operations, rule.operations_of_models))
    return rule, found


def local_margin(problem: Problem, T: Array, level: float, known: Paths) -> float:
    """Share of the decay that the remainder leaves on {V <= level}; positive means that V falls there."""
    return Rule.at_rest(problem, T, known).shown(level).margin


def local_ball(
    problem: Problem, T: Array, level: float, floor: float | None = None
) -> tuple[LocalBall, tuple[int, ...]]:
    """The evidence for a level that `prove_local` has found, or a lower one, and into how many parts the range of each
    uncertain quantity is cut for it; with a floor, for both that `prove_band` has found, or a higher floor."""
    if floor is None:
        rule = Rule.at_rest(problem, T)
        shown = rule.shown(level)
        if not shown.margin > _MARGIN and (kinked := rule.with_kinks(level)) is not None:
            rule, shown = kinked, kinked.shown(level)
        by, edge = shown.multipliers, 0.0
    else:
        rule, found = _around(Rule.anywhere(problem, T), level, floor=floor)
        by, edge = found.multipliers, found.edge
    directions = None if rule.directions is None else rule.directions.trees
    ball = LocalBall(ball_around(problem, T, level), by.rows, by.weight, edge, rule.steps.order, directions)
    return ball, rule.cuts or (1,) * len(problem.loop.system.ranges)


def ball_around(problem: Problem, T: Array, level: float) -> Array:
    """J (n, n), a multiple of T, with {V <= level} inside {J d : ||d|| <= 1}."""
    least = float(np.linalg.eigvalsh(T.T @ problem.V.P @ T)[0])
    return T * (math.sqrt(level / least) * _WIDER) if least > 0 else np.full_like(T, math.inf)


@dataclass(frozen=True, slots=True)
class _Around:
    """The least level around which a ball's inequality holds, infinite if there is none, and by what.

    `rounds` is how many rounds of multipliers count as work; without a definite decay none is weighed.
    """

    floor: float
    edge: float
    multipliers: Multipliers
    rounds: int = 0


_NOWHERE = _Around(math.inf, 0.0, NOT_SHOWN.multipliers)


@dataclass(frozen=True, slots=True)
class Rule:
    """The rule `local` on balls of one shape; `cuts` is None where it can show nothing on any. With `directions` relus
    and clips have kinks."""

    problem: Problem
    T: Array
    steps: Steps
    cuts: tuple[int, ...] | None
    cells: Sequence[Cell]
    R: Array | None
    directions: Directions | None = None

    @classmethod
    def at_rest(cls, problem: Problem, T: Array, known: Paths | None = None) -> Rule:
        """For a loop that rests at the origin; `known` are its paths, if they are there already."""
        return cls._of(problem, T, steps_of(known or paths(problem.loop), True, order_on(problem)))

    @classmethod
    def anywhere(cls, problem: Problem, T: Array, known: Paths | None = None) -> Rule:
        """For one that need not."""
        return cls._of(problem, T, steps_of(known or paths(problem.loop, resting=False), False, order_on(problem)))

    @classmethod
    def _of(cls, problem: Problem, T: Array, steps: Steps) -> Rule:
        """With as many cells as it takes."""
        R = 2 * problem.rate * problem.V.P if problem.rate else None
        with np.errstate(all="ignore"):
            cuts = cuts_for(steps, T, problem.V.P, R)
        cells = [] if cuts is None else cut(list(problem.loop.system.ranges.values()), cuts)
        return cls(problem, T, steps, cuts, cells, R)

    @property
    def operations(self) -> float:
        """Operations of a look at one ball, on all its cones, about, as an `Effort` counts them."""
        looks = 1.0 if self.directions is None else _SHARED * len(self.directions.cones)
        n, units = len(self.T), self.problem.loop.network.network.units
        corners = max(1, len(self.cells)) * 2 ** min(len(self.problem.loop.system.ranges), AT_CORNERS)
        each = self.operations_of_models + corners * _WEIGHINGS * (_WEIGHING + 30.0 * units * n**2 + 15.0 * n**5)
        return looks * float(each)

    @property
    def operations_of_models(self) -> float:
        """The operations of the models alone."""
        cells = max(1, len(self.cells)) * (1 if self.steps.is_plain else 3)
        cells += 0 if self.problem.loop.system.sample is None else 20  # the series, and where the state is meanwhile
        return cells * self.steps.known.operations

    def shown(self, level: float, enough: float = math.inf) -> Shown:
        """At rest, on the ball of a level."""
        with np.errstate(all="ignore"):  # an overflow shows nothing
            corners = self._corners(level)
            return NOT_SHOWN if corners is None else best_at(corners, enough)

    def around(self, level: float) -> _Around:
        """The least floor on the ball of a level, with its edge."""
        with np.errstate(all="ignore"):
            J = ball_around(self.problem, self.T, level)
            corners, best, edge = self._corners(level), _NOWHERE, 0.0
            if corners is None:
                return best
            V = J.T @ self.problem.V.P @ J
            for rounds in range(1, _ROUNDS + 1):
                found = best_at([replace(c, decay=c.decay - edge * V) for c in corners], _AMPLE)
                if not found.margin > _MARGIN:
                    return replace(best, rounds=rounds - (found is NOT_SHOWN))
                around = self._least(corners, V, found.multipliers)
                if not around.floor < best.floor * (1 - _WORTH):
                    return replace(min(around, best, key=lambda one: one.floor), rounds=rounds)
                best, edge = replace(around, rounds=rounds), around.edge
            return best

    def _least(self, corners: Sequence[Corner], V: Array, by: Multipliers) -> _Around:
        """The least floor, and its edge, with `edge floor - start > linear' (D - edge V)^-1 linear` and D > edge V at
        all corners; D is the part of the decay that the bounds leave."""
        from scipy.linalg import eigh

        parts = []
        for c, rest in zip(corners, rests_of(corners, by), strict=True):
            left = (1 - _MARGIN) * c.decay - rest
            values, vectors = eigh((left + left.T) / 2, V)
            more = of_others(c, by.weight)
            linear, start = c.linear + more[1:, 0], c.start + float(more[0, 0])
            parts.append((values, (vectors.T @ linear) ** 2, start + _ROUNDING * float(np.trace(c.decay))))
        most, h = min(float(values[0]) for values, _, _ in parts), self.steps.longest
        if not most > 0:
            return _NOWHERE
        edges = most * np.append(np.geomspace(1e-4, 0.5, _EDGES), 1 - np.geomspace(0.5, 1e-4, _EDGES))
        edges = np.minimum(edges, (1 - _MARGIN) / h) if h else edges
        floors = [(s + np.sum(w / (v - edges[:, None]), axis=1)) / edges for v, w, s in parts]
        worst = np.max(floors, axis=0) * _ABOVE
        at = int(np.argmin(worst))
        return _Around(float(worst[at]), float(edges[at]), by)

    def models(self, J: Array, level: float, cone: Cone | None = None) -> list[Models]:
        """The models of a step on a ball that holds {V <= level}, in each cell."""
        return self.models_on(J[None], level, cone)[0]

    def models_on(self, balls: Array, level: float, cone: Cone | None = None) -> list[list[Models]]:
        """The same on each of several balls, (N, n, n); if one has no finite models, none has."""
        reach = np.minimum(np.linalg.norm(balls, axis=2), extents(self.problem.V.P, level) * _WIDER)
        return self.steps.models_on(balls, self.cells, reach, cone)

    def kept_on(self, balls: Array) -> tuple[Array, Array] | None:
        """The constraints' g on several balls, as `Steps.largest` has them."""
        with np.errstate(all="ignore"):
            return self.steps.largest(balls, self.problem.keep, self.cells, self.whole)

    @property
    def whole(self) -> Cone | None:
        """All of d, if there are kinks."""
        return None if self.directions is None else ALL

    def with_kinks(self, level: float, effort: Effort = UNLIMITED) -> Rule | None:
        """The rule with directions that leave some decay on each of their cones, on the ball of a level, or on a small
        one if there is a kink at the origin; None if a few thousand do not, or the network has no kinks."""
        known = self.steps.known
        if not has_kinks(known.network):
            return None
        if meets_corner(known):
            level = _TINY * domain_limit(self.problem.V.P, self.problem.loop.system.domain)
        found = self.directions_at(level, effort)
        return None if found is None else replace(self, directions=found)

    def directions_at(self, level: float, effort: Effort) -> Directions | None:
        """Directions that leave some decay on each of their cones; None also where the effort ends before."""
        J = ball_around(self.problem, self.T, level)

        def leaves_decay(cone: Cone) -> bool:
            if not cone.narrow or effort.over:
                return False
            effort.charge(_SHARED * self.operations)
            models = self.models(J, level, cone)
            if not all(one.finite for one in models):
                return False
            return all(is_left(c.decay) for one in models for c in self._corners_of(one, J))

        with np.errstate(all="ignore"):
            if not np.all(np.isfinite(J)):
                return None
            if not all(models.finite and models.admitted for models in self.models(J, level, ALL)):
                return None
            return Directions(len(J)).refined(leaves_decay, _MOST_CONES)

    def keeps(self, J: Array) -> bool:
        """True if every constraint holds on the ball."""
        if not self.problem.keep:
            return True
        found = self.kept_on(J[None])
        return found is not None and bool(np.all(found[1] < -(1 - _ROUNDING) * found[0]))

    def _corners(self, level: float) -> list[Corner] | None:
        """The inequality at the corners of all cells; None where something has no finite model, may leave its
        bounds, or may violate a constraint."""
        if self.cuts is None:
            return None
        J, found = ball_around(self.problem, self.T, level), list[Corner]()
        if not self.keeps(J):
            return None
        every = self.models(J, level, self.whole)
        if not all(models.finite and models.admitted for models in every):
            return None
        for cone in [] if self.directions is None else self.directions.cones:
            found += [corner for models in self.models(J, level, cone) for corner in self._corners_of(models, J)]
        return found or [corner for models in every for corner in self._corners_of(models, J)]

    def _corners_of(self, models: Models, J: Array) -> list[Corner]:
        return corners_of(models, J, self.problem.V.P, self.R, self.steps.longest)


def order_on(problem: Problem) -> int:
    """The order of the series in time on a ball; 1 where no input is held."""
    system = problem.loop.system
    return 1 if system.sample is None or corners_in_a_period(system) else _ORDER


def corners_in_a_period(system: System) -> list[Expression]:
    """The terms with a corner at the operating point that a state may pass while an input is held: their series in
    time is not known, and the mean of f alone is left. An input does not change in a period."""
    corners = [] if system.sample is None else corners_at_rest(system)
    return [term for term in corners if symbols_of(term) & set(system.states)]


def _largest(good: Callable[[float], bool], limit: float, effort: Effort, fall: float = _FAR) -> float | None:
    """The largest level up to `limit` that is good, within 2 %, if those somewhat below it are."""
    if good(limit):
        return limit
    high, low = limit, limit
    while not good(low):
        high, low = low, low * fall
        if low <= 1e-30 * limit or low < _LEAST or effort.over:
            return None
    return _closer(good, low, high, effort)


def _closer(good: Callable[[float], bool], low: float, high: float, effort: Effort) -> float:
    """A good level, within 2 % of one that is not, from a good one and one that is not."""
    while high > 1.02 * low and not effort.over:
        middle = math.sqrt(low * high)
        low, high = (middle, high) if good(middle) else (low, middle)
    return low
