"""Levels of N at which a set {N <= n2} may end that is never left: sampled bands, from the widest on.

At a level of a band no sampled state with N = n2 was found at which N does not fall, and below its end lie neither a
state of the domain's faces nor one at which an input or a constraint is violated. It says where to try; nothing is
proved with it.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from certify.effort import UNLIMITED, Effort
from certify.loop.closed_loop import ClosedLoop
from certify.lyapunov.neural import Neural
from certify.lyapunov.symbolic import Symbolic
from certify.provers.outer.falsify import Hazards, Rise, Sampler

Array = NDArray[np.float64]
_FEW, _STEPS = 256, 60  # violating states that are driven along the edge of what violates, and how far
_NARROW = 1e-3  # share of the span of N, that a band must have
_WITHIN = (0.05, 0.2, 0.5)  # shares of a band, below its end, at which a level is tried
_MOST = 8  # levels


@dataclass(frozen=True, slots=True)
class Aim:
    """Levels to try, the best first, and the least N that was sampled; `hazard` is the lowest state that no set may
    have, if that is what ends the highest band."""

    levels: tuple[float, ...]
    least: float
    hazard: Rise | None


@np.errstate(all="ignore")
def aim(loop: ClosedLoop, function: Neural | Symbolic, effort: Effort = UNLIMITED, level: float | None = None) -> Aim:
    """The levels of a loop and a function; only `level`, if it is given and may do."""
    search, hazards = Sampler(loop, function, effort), Hazards(loop, function, effort)
    top, hazard = search.lowest_on_faces(), None
    if hazards.check_inputs or hazards.constraints is not None:
        hazard = hazards.search(top)
        top = top if hazard is None else hazard.level
    x = search.sample(np.random.default_rng(0))
    values = search.value(x)
    least = float(values.min())
    if level is not None:
        return Aim((level,) if least <= level < top else (), least, hazard)
    x, values = x[values < top], values[values < top]
    if not len(x):
        return Aim((), least, hazard)
    worst = search.rates(x)[0].max(0)
    near = search.climb(x[np.argsort(-np.where(worst < 0, worst, -np.inf), kind="stable")[:_FEW]])
    near = near[search.asked(near) & (search.rates(near)[0].max(0) >= 0)]
    bad = np.concatenate([x[~(worst < 0)], near])
    held = np.sort(np.concatenate([search.value(bad), _edges(search, bad, top)]))
    ends = np.concatenate([[least], held[(held >= least) & (held < top)], [top]])
    gaps = [(lo, hi) for lo, hi in itertools.pairwise(ends) if hi - lo > _NARROW * (top - least)]
    gaps.sort(key=lambda gap: gap[0] - gap[1])  # the widest first: there N falls with the largest margin, probably
    tried = [hi - share * (hi - lo) for lo, hi in gaps for share in _WITHIN]
    return Aim(tuple(map(float, tried[:_MOST])), least, hazard)


def _edges(search: Sampler, bad: Array, top: float) -> Array:
    """Values of N at the ends of what violates, about: from states at which N does not fall, up and down."""
    if not len(bad):
        return np.zeros(0)
    order = np.argsort(search.value(bad), kind="stable")
    some = bad[order[np.unique(np.linspace(0, len(bad) - 1, _FEW).astype(int))]]
    found = []
    for sign in (1.0, -1.0):
        x, step = some, np.full(len(some), 0.02)
        value = search.value(x)
        for _ in range(_STEPS):
            way = sign * search.N.gradient(x) * search.half
            way /= np.linalg.norm(way, axis=-1, keepdims=True) + 1e-300
            tried = np.clip(x + step[:, None] * way * search.half, search.low, search.high)
            after = search.value(tried)
            better = (sign * after > sign * value) & (after < top) & (search.rates(tried)[0].max(0) >= 0)
            x, value = np.where(better[:, None], tried, x), np.where(better, after, value)
            step = np.where(better, 1.3 * step, 0.5 * step)
        found.append(value)
    return np.concatenate(found)
