"""Facts on an outer set: its size, what limits it, why a level that was asked for is missed; facts on boxes with ranks,
and constraints as people read them."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from typing import TYPE_CHECKING

from certify.analysis.facts import OuterFacts, RankFacts
from certify.analysis.options import RoaOptions
from certify.certificates import AnyCertificate, PartitionTree, RanksAlone
from certify.certificates.claims import Claim, Outer, Problem
from certify.certificates.ranked import count
from certify.loop.plants.constraints import in_words
from certify.lyapunov import sampled_volume
from certify.lyapunov.rigorous import evaluate_rise

if TYPE_CHECKING:
    from certify.provers.outer import OuterProof, Rise
    from certify.provers.ranks import RankProof


def outer_facts(problem: Problem, claim: Claim, outer: Outer, found: OuterProof) -> OuterFacts:
    """The facts on a proved outer set; its volume, with that of the ellipsoid, is estimated from samples."""
    held = sampled_volume(
        lambda x: (outer.function(x) <= outer.level) | (problem.V(x) <= claim.roa), problem.loop.system.domain
    )
    facts = OuterFacts(outer.function, outer.level, *held, found.stop.name.lower(), found.boxes, found.leaves)
    return with_hazard(facts, found.witness)


def with_hazard(facts: OuterFacts, hazard: Rise | None) -> OuterFacts:
    """The facts with the state at which a condition of the set fails, if one was met."""
    if hazard is None:
        return facts
    at = tuple(hazard.x.tolist())
    named = hazard.constraint or None
    return replace(facts, witness=at, witness_level=hazard.level, violation=hazard.kind, constraint=named)


def rank_facts(certificate: AnyCertificate, search: RankProof | None = None) -> RankFacts | None:
    """The facts on the boxes with ranks of a certificate; None without any."""
    ranks, evidence = certificate.claim.ranks, certificate.evidence
    tree = evidence.ranks if isinstance(evidence, PartitionTree | RanksAlone) else None
    if ranks is None or tree is None:
        return None
    names = [s.name for s in certificate.system.states]
    found = count(tree, [names.index(name) for name in ranks.angles])
    facts = RankFacts(tree, ranks.angles, found.leaves, found.proved, found.share, found.volume, found.steps)
    if search is None:
        return facts
    return replace(facts, rounds=search.rounds, done=search.done or search.full, full=search.full)


def constraints_in_words(certificate: AnyCertificate) -> dict[str, str]:
    """The claim's constraints by name, over the states' values, as in `p - 3/2 < 0`."""
    return in_words(replace(certificate.system, constraints=certificate.constraints))


def short_of(problem: Problem, claim: Claim, options: RoaOptions, found: OuterProof | None) -> str:
    """The reason why the level of the function that was asked for is not proved."""
    reached = "nothing beyond V <= " + f"{claim.roa:.6g} is proved"
    if claim.outer is not None:
        reached = f"proved only up to N <= {claim.outer.level:.12g}, not {options.lyapunov_level:g}"
    if found is None or found.witness is None:
        return reached
    shown = _rises(problem, claim, found) if options.lyapunov_level is not None else False
    return f"{reached}; {found.witness.describe(problem.loop.system)}{', shown in Arb' if shown else ''}"


def _rises(problem: Problem, claim: Claim, found: OuterProof) -> bool:
    """True if N certainly does not fall at the witness, and the certificate has no range to choose a value from."""
    witness = found.witness
    if witness is None or witness.kind != "rise" or problem.loop.system.ranges:
        return False
    _, rise = evaluate_rise(problem.loop, found.outer.function, witness.x)
    return bool(rise >= 0) and problem.V.exactly(witness.x) >= Fraction(claim.roa)
