"""A run, looked back on: how near its gain came to the true one, and what could have been proved of it at each step.

The true gain is that of the simulator's own linearisation, which training never sees. What is proved of a policy is
what `certify_roa` writes down and the checker accepts, each policy by itself and with the same options; where that
comes to nothing in its time, the history has a gap there, which says nothing about the policy.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from certify.certificates.membership import ProvedSet, proved_set, set_of
from certify.certificates.verdict import Verdict
from certify.errors import CertificateFormatError, InputError
from certify.loop.plants import System
from certify.lyapunov import Candidate, volume
from controllers.evaluate import discrete_linearisation, recorded, recorded_step, require_same_question
from controllers.files import read
from controllers.kept import Kept
from controllers.lqr import riccati_gain

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Distances:
    """Relative distances in the Frobenius norm after `step` steps.

    `A`, `B` and `K` are what was learned, against the simulator's linearisation and its discrete LQR gain; NaN where
    nothing was. `mean` is the mean action's Jacobian at the origin, which should be -K, against the same true gain.
    """

    step: int
    A: float
    B: float
    K: float
    mean: float


@dataclass(frozen=True, slots=True)
class Proof:
    """What came of proving the policy after `step` steps.

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
    """How each policy is proved.

    Parameters
    ----------
    time_limit : seconds for one policy.
    candidate : where P comes from, as `certify_roa` names it.

    Raises
    ------
    InputError : the limit is not positive and finite, or there is no such candidate.
    """

    time_limit: float = 50.0
    candidate: Candidate = "auto"

    def __post_init__(self) -> None:
        if not 0 < self.time_limit < math.inf:
            raise InputError(f"`time_limit` must be positive and finite; found {self.time_limit}.")
        if self.candidate not in get_args(Candidate):
            raise InputError(f"`candidate` must be one of {', '.join(get_args(Candidate))}; found {self.candidate!r}.")


def distances(history: Sequence[Kept], system: System) -> list[Distances]:
    """How far what was learned is from the true A, B and gain, for each policy.

    Raises
    ------
    InputError : a policy is not one of this plant, or its record lacks dt or the weights of its gain.
    """
    found = []
    for kept in history:
        policy, n, m = kept.policy, system.n, system.m
        if (policy.network.n, policy.network.m) != (n, m):
            raise InputError(
                f"the policies must map {n} states to {m} inputs for {system.name}; found {policy.network.n} and "
                f"{policy.network.m}."
            )
        dt = recorded_step(policy, system)
        Q, R = (np.diag(recorded(policy, f"{of}_weights", (k,))) for of, k in (("state", n), ("input", m)))
        A, B = discrete_linearisation(system, dt)
        K = riccati_gain(A, B, Q, R)
        J = policy.network.jacobian_at_origin(system.exact_u_eq())
        learned = {
            name: _relative(recorded(policy, name, true.shape), true) if name in policy.training else math.nan
            for name, true in (("A", A), ("B", B), ("K", K))
        }
        found.append(Distances(step=kept.step, **learned, mean=_relative(-J, K)))
    return found


def read_settled(path: Path) -> list[tuple[int, float]]:
    """Steps, and the share of initial states that settle then, as `controllers train --evaluations` wrote them.

    Raises
    ------
    InputError : the file cannot be read, or is no such table.
    """
    try:
        rows = list(csv.DictReader(io.StringIO(read(path).decode())))
        return [(int(row["step"]), float(row["settled"])) for row in rows]
    except (KeyError, TypeError, ValueError, csv.Error) as error:
        raise InputError(f"{path} must be a table that `controllers train --evaluations` wrote: {error!r}.") from error


def prove(kept: Kept, system: System, folder: Path, options: ProvingOptions) -> Proof:
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
        result = certify_roa(system, kept.policy, folder, candidate=options.candidate, time_limit=options.time_limit)
    except InputError as error:
        return Proof(kept.step, Verdict.UNKNOWN, str(error))
    if result.verdict is not Verdict.PROVED or result.raw is None:
        verdict = Verdict.UNKNOWN if result.verdict is Verdict.PROVED else result.verdict
        return Proof(kept.step, verdict, result.reason)
    proved = set_of(result.raw, str(path))
    require_same_question(proved, network, system)
    return _proof(kept.step, proved)


def prove_all(
    history: Sequence[Kept],
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


def table(found: Sequence[Distances], proofs: Sequence[Proof]) -> bytes:
    """Distances and, of the same steps, proofs as CSV; without proofs the distances alone."""
    names = [column.name for column in fields(Distances)]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*names, "verdict", "claim", "level", "volume", "reason"] if proofs else names)
    of = {proof.step: proof for proof in proofs}
    for each in found:
        proof = of.get(each.step)
        said = [] if proof is None else [proof.verdict.value, proof.claim, proof.level, proof.volume, proof.reason]
        writer.writerow([*astuple(each), *said])
    return text.getvalue().encode()


def _proof(step: int, proved: ProvedSet) -> Proof:
    """The ellipsoid {V <= c2} of an accepted certificate."""
    ellipsoid = proved.ellipsoids[0]
    size = volume(ellipsoid.P, ellipsoid.level)
    return Proof(step, Verdict.PROVED, "", proved.claim, ellipsoid.P, ellipsoid.level, size)


def _relative(found: Array, true: Array) -> float:
    return float(np.linalg.norm(found - true) / np.linalg.norm(true))
