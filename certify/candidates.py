"""What other candidates for P could give at most, by sampling: whether another one is worth a try."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from certify.claims import Problem
from certify.closed_loop import ClosedLoop
from certify.engines.falsify import falsify
from certify.lyapunov import Candidate, choose_candidate, diagonalising_coordinates, domain_limit, volume
from certify.lyapunov.function import Quadratic
from certify.options import RoaOptions
from certify.policies import TanhNetwork
from certify.systems import System

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class CandidateVolume:
    """What a candidate could give at most: `level` is the smaller of the domain's limit and the lowest violation found.

    Sampled, not proved, unless the candidate is the one that was proved.
    """

    candidate: str
    level: float
    limited_by: Literal["domain", "sampled"]
    volume: float


def compare_candidates(
    system: System, network: TanhNetwork, options: RoaOptions, known: Mapping[str, Array], names: Sequence[Candidate]
) -> tuple[CandidateVolume, ...]:
    """The volumes within reach of several candidates; `known` has those whose P is there already."""
    loop = ClosedLoop(system, network)
    A, _, _ = loop.linearise()
    result = []
    for name in names:
        P = known[name] if name in known else choose_candidate(loop, name, options.Q, options.R).P
        limit = domain_limit(P, system.domain)
        witness = falsify(Problem(loop, Quadratic(P)), diagonalising_coordinates(P, A), limit, samples=4000)
        level = limit if witness is None else witness.level
        result.append(CandidateVolume(name, level, "domain" if witness is None else "sampled", volume(P, level)))
    return tuple(result)
