"""The largest level n2 for which N falls wherever N <= n2 and V >= c2, and N > n2 on the domain's boundary.

The level is the least of three: what is asked for, the least N on the faces of the domain, and the lowest violation
that sampling finds. Then one pass over a box around the domain proves it, or a lower one.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from certify.certificates import OuterTree
from certify.certificates.claims import Outer, Problem
from certify.certificates.verdict import Stop
from certify.errors import InputError
from certify.loop.plants import System
from certify.lyapunov.neural import Neural
from certify.lyapunov.symbolic import Symbolic
from certify.provers.base import Budget, Report
from certify.provers.execution import Runner
from certify.provers.outer.falsify import Falsifier, Hazards, Rise, Sampler
from certify.provers.outer.rule import FaceBound, FallBound
from certify.provers.outer.search import Cover, count

Array = NDArray[np.float64]
_BESIDE_FACE = 1e-4  # share of N's span, kept from the least N on the faces
_BESIDE_RISE = 1e-3  # share of N's span, kept from a violation
_FOR_FACES = 0.25  # the largest share of the effort
_AGAIN = 0.05  # share of N's span that the level must have fallen for smaller trees of the faces


@dataclass(frozen=True, slots=True)
class OuterProof:
    """An outer set with its evidence.

    `stop` says what limits the level; `witness` is the lowest violation found, maybe above the level; `boxes` were
    bounded, `leaves` are those of all trees, and `seconds` the wall time of the stages `falsify`, `faces`, `leaves`.
    """

    outer: Outer
    evidence: OuterTree
    stop: Stop
    witness: Rise | None
    boxes: int
    leaves: int
    seconds: dict[str, float]


@dataclass(frozen=True, slots=True)
class Nothing:
    """No set beyond {V <= c2} is proved, and `why`; if for a violation, `witness` is the lowest one found."""

    why: str
    witness: Rise | None = None


def prove_outer(
    problem: Problem,
    c2: float,
    T: Array,
    function: Neural | Symbolic,
    level: float | None,
    budget: Budget,
    runner: Runner,
    report: Report | None = None,
) -> OuterProof | Nothing:
    """Prove that N falls in the domain wherever N <= n2 and V >= c2, for the largest n2 up to `level`.

    Parameters
    ----------
    c2 : the level of the set {V <= c2} into which trajectories fall; that it is a region of attraction is not shown.
    T : (n, n), invertible; boxes are drawn in z, x = T z.
    level : of N; None for the largest.
    report : called after every batch of the last stage.

    Returns
    -------
    OuterProof, or Nothing where nothing beyond {V <= c2} is proved.

    Raises
    ------
    InputError : the plant has steps or a rate is asked for, or N is a function of other states.
    """
    require_function(system := problem.loop.system, function, problem.rate)
    start = time.monotonic()
    searches = _searches(problem, c2, function, budget)
    floor = searches[0].least_value()
    if not math.isfinite(floor):
        return Nothing("every sampled state of the domain lies in the ellipsoid")
    aim = _aim(searches, floor, level)
    if isinstance(aim, Nothing):
        return aim
    top, span, stop, witness = aim
    seconds = {"falsify": time.monotonic() - start}

    share = replace(budget, effort=budget.effort.share(_FOR_FACES))
    found = prove_faces(system, function, top, floor, share, runner)
    if isinstance(found, Nothing):
        return found if top > floor else replace(found, witness=witness)
    boxes, faces, on_faces, stopped = found
    if on_faces < top:
        top, stop = on_faces, stopped
    seconds["faces"] = time.monotonic() - start - seconds["falsify"]

    def deepen(z: Array) -> float:
        nonlocal witness
        deeper = _lowest(each.lowest((T @ z)[None]) for each in searches)
        witness = _lowest((witness, deeper))
        return math.inf if deeper is None else deeper.level

    root, rule = root_around(system, T), FallBound(problem, c2, T, function)
    cover = Cover(rule, -root, root, runner, top, floor, _BESIDE_RISE * span, deepen)
    stopped = cover.advance(budget, report)
    if not cover.level > floor:
        why = f"{cover.boxes:,} boxes did not show that N falls at any level; {_ended_by(stopped)}"
        return Nothing(why, witness if stopped is Stop.WITNESS else None)
    if cover.level < top:
        stop = stopped
    if cover.level < top - _AGAIN * span:
        again = prove_faces(system, function, cover.level, floor, share, runner)
        if not isinstance(again, Nothing) and again[2] == cover.level:
            boxes, faces = boxes + again[0], again[1]
    seconds["leaves"] = time.monotonic() - start - seconds["falsify"] - seconds["faces"]
    tree = cover.tree()
    return OuterProof(
        Outer(function, cover.level),
        OuterTree(T, root, tree, faces),
        stop,
        witness,
        boxes + cover.boxes,
        sum(count(each) for each in (tree, *faces)),
        seconds,
    )


def _searches(problem: Problem, c2: float, function: Neural | Symbolic, budget: Budget) -> Sequence[Sampler]:
    """The searches for violations: of N's fall, and of constraints if there are any."""
    falls = Falsifier(problem, c2, function, budget.effort)
    return (falls, Hazards(problem.loop, function, budget.effort, (problem.V, c2))) if problem.keep else (falls,)


def _lowest(found: Iterable[Rise | None]) -> Rise | None:
    return min((each for each in found if each is not None), key=lambda each: each.level, default=None)


def _aim(
    searches: Sequence[Sampler], floor: float, level: float | None
) -> tuple[float, float, Stop, Rise | None] | Nothing:
    """The level that sampling allows, the span of N down to its least value, what limits the level, and the lowest
    violation."""
    search = searches[0]
    top = min(search.lowest_on_faces(), math.inf if level is None else level)
    if not top > floor:
        what = "the level that was asked for" if level is not None and top == level else "N somewhere on the faces"
        return Nothing(f"{what}, {top:.6g}, is not above the least value of N that was sampled beyond it, {floor:.6g}")
    stop = Stop.DOMAIN if level is None or top < level else Stop.REQUESTED
    span = top - floor
    top = level if stop is Stop.REQUESTED and level is not None else top - _BESIDE_FACE * span
    witness = _lowest(each.search(top) for each in searches)
    if witness is not None and witness.level - _BESIDE_RISE * span < top:
        top, stop = witness.level - _BESIDE_RISE * span, Stop.WITNESS
    return top, span, stop, witness


def root_around(system: System, T: Array) -> Array:
    """Half-widths (n,) of a box in z around the domain, a hair larger for the checker's rationals."""
    widest = np.array([float(max(-lo, hi)) for lo, hi in system.domain])
    inverse = np.linalg.inv(T)
    doubt = 1e-9 + 1e-14 * len(T) * np.linalg.cond(T)
    return np.asarray(np.abs(inverse) @ widest * (1 + doubt))


def face_box(system: System, axis: int, side: int) -> tuple[Array, Array]:
    """Corners (n,) of a box around the lower (side 0) or the upper end of a state, in binary64 numbers."""
    lo = np.array([_outwards(float(low), low, -math.inf) for low, _ in system.domain])
    hi = np.array([_outwards(float(high), high, math.inf) for _, high in system.domain])
    lo[axis] = hi[axis] = float(system.domain[axis][side])
    return lo, hi


def prove_faces(
    system: System, function: Neural | Symbolic, level: float, floor: float, budget: Budget, runner: Runner
) -> tuple[int, tuple[bytes, ...], float, Stop] | Nothing:
    """Boxes, trees of all faces, the level below which N is on none of them, and what limits it."""
    trees: list[bytes] = []
    boxes, stop = 0, Stop.DOMAIN
    for axis in range(system.n):
        for side in range(2):
            rule = FaceBound(system, axis, side, function)
            lo, hi = face_box(system, axis, side)
            cover = Cover(rule, lo, hi, runner, level, floor, _BESIDE_FACE * (level - floor))
            share = budget.effort.share(1 / (2 * system.n - len(trees)))
            ended = cover.advance(replace(budget, effort=share, check=0.0))
            boxes += cover.boxes
            if not cover.level > floor:
                where = f"{system.states[axis]} = {float(system.domain[axis][side]):g}"
                return Nothing(
                    f"{cover.boxes:,} boxes did not show that N is above any level where {where}; {_ended_by(ended)}"
                )
            if cover.level < level:
                level, stop = cover.level, Stop.DOMAIN if ended is Stop.WITNESS else ended
            trees.append(cover.tree())
    return boxes, tuple(trees), level, stop


def _ended_by(stop: Stop) -> str:
    """The end of a pass that proved nothing, and what may help."""
    if stop.ran_out:
        return f"the {stop.value} for that ended: more of it{', or a cluster,' if stop is Stop.TIME else ''} may do"
    return "a smaller level, or another function, is needed" if stop is Stop.WITNESS else f"it ended by {stop.value}"


def _outwards(value: float, exact: Fraction, towards: float) -> float:
    """The binary64 number next to an exact one, on the side of `towards`."""
    beyond = value > exact if towards < 0 else value < exact
    return math.nextafter(value, towards) if beyond else value


def require_function(system: System, function: Neural | Symbolic, rate: float = 0.0) -> None:
    """Refuse a plant or a function that no set {N <= n2} is proved of.

    Raises
    ------
    InputError : the plant has steps or a rate is asked for, or N is a function of other states.
    """
    if system.in_steps or rate:
        found = "steps" if system.in_steps else f"the rate {rate:g}"
        raise InputError(f"an outer set is for plants in continuous time whose input follows at once; found {found}.")
    if function.n != system.n:
        raise InputError(f"N must be a function of the {system.n} states of {system.name}; it has {function.n}.")
    if isinstance(function, Symbolic) and function.states != system.states:
        raise InputError(f"N must be an expression of {system.states}, in this order; found {function.states}.")
