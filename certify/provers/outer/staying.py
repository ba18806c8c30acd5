"""A set {N <= n2} of the domain that is never left: the highest level at which one pass over the domain shows it."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from certify.certificates import OuterTree
from certify.certificates.claims import Outer
from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import Expression
from certify.lyapunov.neural import Neural
from certify.lyapunov.symbolic import Symbolic
from certify.provers.base import Budget, Report
from certify.provers.execution import Runner
from certify.provers.outer.bands import aim
from certify.provers.outer.falsify import Rise
from certify.provers.outer.prove import Nothing, prove_faces, require_function, root_around
from certify.provers.outer.search import Cover, count
from certify.provers.outer.stay import StayBound

_SHARE = 0.4  # of the effort that is left, for a level


@dataclass(frozen=True, slots=True)
class StayProof:
    """A set that is never left, with its evidence: `boxes` were bounded, `leaves` are those of all trees; `tried` are
    the levels above it at which nothing was shown, and `hazard` is the state that no larger set may have, if one was
    found."""

    outer: Outer
    evidence: OuterTree
    boxes: int
    leaves: int
    tried: tuple[float, ...]
    hazard: Rise | None
    seconds: dict[str, float]


def prove_staying(
    loop: ClosedLoop,
    keep: Sequence[Expression],
    function: Neural | Symbolic,
    level: float | None,
    budget: Budget,
    runner: Runner,
    report: Report | None = None,
) -> StayProof | Nothing:
    """Prove that trajectories stay where N <= n2 in the domain, for the highest n2 that is found, or for `level`.

    Parameters
    ----------
    keep : each g is negative on the set.
    report : called after every batch of the passes over the domain.

    Returns
    -------
    StayProof, or Nothing and why.

    Raises
    ------
    InputError : the plant has steps, or N is a function of other states.
    """
    system = loop.system
    require_function(system, function)
    start = time.monotonic()
    found = aim(loop, function, budget.effort, level)
    seconds, boxes, tried = {"falsify": time.monotonic() - start}, 0, list[float]()
    if not found.levels:
        return Nothing(_no_level(loop, found.least, found.hazard, level))
    T, why = np.eye(system.n), ""
    root, rule = root_around(system, T), StayBound(loop, keep, T, function)
    for each in found.levels:
        share = replace(budget, effort=budget.effort.share(1.0 if level is not None else _SHARE))
        floor = math.nextafter(each, -math.inf)
        faces = prove_faces(system, function, each, floor, share, runner)
        if isinstance(faces, Nothing):
            why = faces.why
        else:
            cover = Cover(rule, -root, root, runner, each, floor, 0.0)
            stop = cover.advance(share, report)
            boxes += faces[0] + cover.boxes
            if cover.level == each:
                tree = cover.tree()
                leaves = sum(count(part) for part in (tree, *faces[1]))
                evidence = OuterTree(T, root, tree, faces[1])
                seconds["leaves"] = time.monotonic() - start - seconds["falsify"]
                return StayProof(Outer(function, each), evidence, boxes, leaves, tuple(tried), found.hazard, seconds)
            why = f"{cover.boxes:,} boxes did not show it for N <= {each:.6g}; the pass ended by {stop.value}"
        tried.append(each)
        if budget.effort.over:
            break
    return Nothing(why)


def _no_level(loop: ClosedLoop, least: float, hazard: Rise | None, level: float | None) -> str:
    """The reason why no level is worth a try."""
    if hazard is not None and (level is None or hazard.level <= level):
        return f"no level is left: {hazard.describe(loop.system)}"
    if level is not None and level < least:
        return f"no sampled state of the domain has N <= {level:.6g}; the least N that was sampled is {least:.6g}"
    if level is not None:
        return f"N is {level:.6g} or less on a face of the domain"
    return "at no level down to the least N that was sampled does N fall everywhere where it has that level"
