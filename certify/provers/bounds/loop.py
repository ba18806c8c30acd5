"""A loop's states, inputs and uncertain quantities as Taylor models on boxes, at which its equations are evaluated."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from certify.loop.expressions import Symbol
from certify.loop.plants import System
from certify.provers.bounds.arrays import Array
from certify.provers.bounds.compiled import Loops
from certify.provers.bounds.tape import Tape
from certify.provers.bounds.taylor import EPS, TINY, Taylor


class LoopModels(NamedTuple):
    """Models by symbol, each kind in the plant's order."""

    states: Mapping[Symbol, Taylor]
    inputs: Mapping[Symbol, Taylor]
    quantities: Mapping[Symbol, Taylor]


def loop_models(
    system: System, x: Array, error: Array, mid: Array, slopes: Array, wide: Array, more: int = 0
) -> LoopModels:
    """Models in k symbols (box coordinates and others), m input errors, the uncertain quantities, and `more` symbols
    that none of them uses.

    Parameters
    ----------
    x, error : (n, k + 1, B) and (n, B): states are `x[:, 0] + x[:, 1:] d` within the error.
    mid, slopes, wide : (m, B), (m, k, B), (m, B): inputs are `mid + slopes d` within `wide`.
    """
    n, m, batch = x.shape[1] - 1, system.m, x.shape[2]
    k = len(system.uncertain) + more
    zeros = np.zeros((n + m + k, n + m + k, batch))
    none = zeros[0, : m + k]
    states: dict[Symbol, Taylor] = {}
    inputs: dict[Symbol, Taylor] = {}
    quantities: dict[Symbol, Taylor] = {}
    for i, symbol in enumerate(system.states):
        states[symbol] = Taylor(x[i, 0], np.concatenate([x[i, 1:], none]), zeros, error[i])
    for j, symbol in enumerate(system.inputs):
        own = none.copy()
        own[j] = wide[j]
        inputs[symbol] = Taylor(mid[j], np.concatenate([slopes[j], own]), zeros, zeros[0, 0])
    for j, ((symbol, _), (middle, reach, rounding)) in enumerate(zip(system.uncertain, _ranges(system), strict=True)):
        own = zeros[0].copy()
        own[n + m + j] = reach
        quantities[symbol] = Taylor(zeros[0, 0] + middle, own, zeros, zeros[0, 0] + rounding)
    return LoopModels(states, inputs, quantities)


def played(
    loops: Loops, tape: Tape, system: System, x: Array, error: Array, mid: Array, slopes: Array, wide: Array
) -> tuple[Taylor, Array]:
    """The result of a tape whose inputs are all of `loop_models`, and t (N, B) of `inner_product` if it ends with one;
    the other parameters are those of `loop_models`."""
    N, batch = system.n + system.m + len(system.uncertain), x.shape[2]
    c, g, Q, r, t = (np.empty((*shape, batch)) for shape in ((), (N,), (N, N), (), (N,)))
    given = (np.ascontiguousarray(v) for v in (x, error, mid, slopes, wide))
    ranges = np.array(_ranges(system)).reshape(-1, 3)
    loops.play(tape.steps, tape.k, tape.places, *given, ranges, c, g, Q, r, t)
    return Taylor(c, g, Q, r), t


def _ranges(system: System) -> list[tuple[float, float, float]]:
    """The middle of each uncertain quantity, its reach, and the rounding of these."""
    ends = ((float((lo + hi) / 2), float((hi - lo) / 2)) for _, (lo, hi) in system.uncertain)
    return [(middle, reach, EPS * (abs(middle) + reach) + TINY) for middle, reach in ends]
