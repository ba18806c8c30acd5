"""The proofs of a run's history: the set that can be proved of each of its policies.

A policy is proved by itself, with the same options as all others, and counts as proved if the checker accepts what
`certify_roa` writes down. If nothing is proved with its effort, the history has a gap, which says nothing about the
policy.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from certify.certificates.membership import ProvedSet, proved_set, set_of
from certify.certificates.verdict import Verdict
from certify.errors import CertificateFormatError, InputError, OptionError
from certify.loop.plants import System
from certify.lyapunov import Candidate, volume
from controllers.evaluation.proved_set import require_same_question
from controllers.history.policies import RunPolicy

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Proof:
    """The answer about the policy after `step` steps.

    Parameters
    ----------
    verdict, reason : of `certify_roa`; the reason is empty for a certificate that was there.
    claim : the kind of claim; empty without a proof.
    P, level : the set {x'Px <= level} of a certificate that the checker accepted; None and NaN without one.
    volume : of that set, rounded down; 0 without one.
    """

    step: int
    verdict: Verdict
    reason: str = ""
    claim: str = ""
    P: Array | None = None
    level: float = math.nan
    volume: float = 0.0

    def __post_init__(self) -> None:
        if (self.P is not None) != (self.verdict is Verdict.PROVED):
            raise InputError(f"a proof has a set exactly if it is PROVED; found {self.verdict.value}.")


@dataclass(frozen=True, slots=True, kw_only=True)
class ProvingOptions:
    """The options with which each policy is proved.

    Parameters
    ----------
    effort : counted work for one policy, as `certify_roa` takes it.
    candidate : where P comes from, as `certify_roa` names it.

    Raises
    ------
    OptionError : the effort is not positive and finite, or there is no such candidate.
    """

    effort: float = 1.0
    candidate: Candidate = "ellipsoid"

    def __post_init__(self) -> None:
        if not 0 < self.effort < math.inf:
            raise OptionError(f"`effort` must be positive and finite; found {self.effort}.")
        if self.candidate not in get_args(Candidate):
            raise OptionError(f"`candidate` must be one of {', '.join(get_args(Candidate))}; found {self.candidate!r}.")


def prove(kept: RunPolicy, system: System, folder: Path, options: ProvingOptions) -> Proof:
    """Prove one policy and keep its certificate in `folder`; one that is there about this loop is checked again.

    A loop with which nothing can be begun, such as one with an eigenvalue on the imaginary axis, is UNKNOWN: it is one
    policy of many.

    Raises
    ------
    BackendError : the checker is missing or failed.
    """
    from certify.analysis.api import certify_roa

    path, network = folder / "certificate.json", kept.policy.network
    if path.is_file():
        try:
            proved = proved_set(path)
            require_same_question(proved, network, system)
        except (InputError, CertificateFormatError):  # refused, damaged, or of another policy: it is written anew
            path.unlink()
        else:
            return _proof(kept.step, proved)
    try:
        result = certify_roa(system, kept.policy, folder, candidate=options.candidate, effort=options.effort)
    except InputError as error:
        return Proof(kept.step, Verdict.UNKNOWN, str(error))
    if result.verdict is not Verdict.PROVED or result.raw is None:
        verdict = Verdict.UNKNOWN if result.verdict is Verdict.PROVED else result.verdict
        return Proof(kept.step, verdict, result.reason)
    proved = set_of(result.raw, str(path))
    require_same_question(proved, network, system)
    return _proof(kept.step, proved)


def prove_all(
    history: Sequence[RunPolicy],
    system: System,
    folder: Path,
    options: ProvingOptions,
    say: Callable[[str], None] = lambda line: None,
) -> list[Proof]:
    """`prove` for each policy, its certificate in a folder of `folder` with the number of its steps.

    Parameters
    ----------
    say : takes a line for each.
    """
    proofs = []
    for kept in history:
        proof = prove(kept, system, folder / f"{kept.step:07d}", options)
        told = f"volume {proof.volume:.4g}" if proof.P is not None else proof.reason
        say(f"{kept.step} steps: {proof.verdict.value}, {told}")
        proofs.append(proof)
    return proofs


def _proof(step: int, proved: ProvedSet) -> Proof:
    """The ellipsoid {V <= c2} of an accepted certificate."""
    ellipsoid = proved.ellipsoids[0]
    size = volume(ellipsoid.P, ellipsoid.level)
    return Proof(step, Verdict.PROVED, "", proved.claim, ellipsoid.P, ellipsoid.level, size)
