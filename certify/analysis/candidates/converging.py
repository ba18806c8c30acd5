"""The stronger claim that a practical one's proof may carry: that all trajectories converge to one equilibrium."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from certify.certificates import Certificate, PartitionTree, run_checker, write_beside
from certify.certificates.claims import Problem
from certify.provers.ball.contraction import contraction
from certify.provers.base import Proof
from certify.provers.boxes.search import empty_ring


def is_nearby(problem: Problem, proof: Proof, path: Path) -> bool:
    """True if the checker accepts that trajectories converge to one equilibrium in {V <= c0}.

    Only the checker bounds what bends F there. It is asked about {V <= c1} alone, for which no leaf has to be bounded;
    about all where leaves carry the floor.

    Parameters
    ----------
    path : of a certificate, beside which a file is written and removed again.

    Raises
    ------
    InputError : the file cannot be written.
    BackendError : the checker process failed.
    """
    claim, evidence = proof.claim, proof.evidence
    if claim is None or claim.floor is None or not isinstance(evidence, PartitionTree):
        return False
    closer, asked = contraction(problem, evidence.T, claim.floor), evidence
    if evidence.local is not None:
        claim, ring = replace(claim, roa=claim.local), empty_ring(problem, evidence.T, claim.local)
        asked = replace(evidence, root=ring.root, tree=ring.tree)
    inner = claim.converging()
    if closer is None or inner is None:
        return False
    loop = problem.loop
    certificate = Certificate(loop.system, loop.network, problem.V, inner, replace(asked, contraction=closer))
    file = write_beside(path, certificate.to_json().encode(), ".unchecked.json")
    try:
        return bool(run_checker(file)["result"] == "ACCEPTED")
    finally:
        file.unlink(missing_ok=True)
