"""What a loop's equations are evaluated at on boxes: its states, inputs and uncertain quantities as Taylor models."""

from __future__ import annotations

from collections.abc import Mapping
from types import ModuleType
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from certify.loop.expressions import Symbol
from certify.loop.plants import System
from certify.provers.bounds.tape import Tape
from certify.provers.bounds.taylor import EPS, TINY, Taylor


class LoopModels(NamedTuple):
    """Models by symbol, each kind in the plant's order."""

    states: Mapping[Symbol, Taylor]
    inputs: Mapping[Symbol, Taylor]
    quantities: Mapping[Symbol, Taylor]


def loop_models(
    system: System, x: Tensor, error: Tensor, mid: Tensor, slopes: Tensor, wide: Tensor, more: int = 0
) -> LoopModels:
    """Models in n box coordinates, m input errors, the uncertain quantities, and `more` symbols that none of them uses.

    Parameters
    ----------
    x, error : (n, n + 1, B) and (n, B): states are `x[:, 0] + x[:, 1:] d` within the error.
    mid, slopes, wide : (m, B), (m, n, B), (m, B): inputs are `mid + slopes d` within `wide`.
    """
    n, m, batch = system.n, system.m, x.shape[2]
    k = len(system.uncertain) + more
    zeros = torch.zeros(n + m + k, n + m + k, batch, dtype=x.dtype, device=x.device)
    none = zeros[0, : m + k]
    states: dict[Symbol, Taylor] = {}
    inputs: dict[Symbol, Taylor] = {}
    quantities: dict[Symbol, Taylor] = {}
    for i, symbol in enumerate(system.states):
        states[symbol] = Taylor(x[i, 0], torch.cat([x[i, 1:], none]), zeros, error[i])
    for j, symbol in enumerate(system.inputs):
        own = none.clone()
        own[j] = wide[j]
        inputs[symbol] = Taylor(mid[j], torch.cat([slopes[j], own]), zeros, zeros[0, 0])
    for j, ((symbol, _), (middle, reach, rounding)) in enumerate(zip(system.uncertain, _ranges(system), strict=True)):
        own = zeros[0].clone()
        own[n + m + j] = reach
        quantities[symbol] = Taylor(zeros[0, 0] + middle, own, zeros, zeros[0, 0] + rounding)
    return LoopModels(states, inputs, quantities)


def played(
    kernels: ModuleType, tape: Tape, system: System, x: Tensor, error: Tensor, mid: Tensor, slopes: Tensor, wide: Tensor
) -> Taylor:
    """The result of a tape whose inputs are all of `loop_models`, with compiled loops; parameters are those of that."""
    N, batch = system.n + system.m + len(system.uncertain), x.shape[2]
    c, g, Q, r = (torch.empty(*shape, batch, dtype=torch.float64) for shape in ((), (N,), (N, N), ()))
    given = (v.contiguous().numpy() for v in (x, error, mid, slopes, wide))
    ranges = np.array(_ranges(system)).reshape(-1, 3)
    kernels.play(tape.steps, tape.k, tape.places, *given, ranges, *(v.numpy() for v in (c, g, Q, r)))
    return Taylor(c, g, Q, r)


def _ranges(system: System) -> list[tuple[float, float, float]]:
    """The middle of each uncertain quantity, its reach, and the rounding of these."""
    ends = ((float((lo + hi) / 2), float((hi - lo) / 2)) for _, (lo, hi) in system.uncertain)
    return [(middle, reach, EPS * (abs(middle) + reach) + TINY) for middle, reach in ends]
