"""The set that a run is to reach: a region that is named, or the set of a certificate about the same loop."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import reduce
from operator import add
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.analysis.options import RoaOptions
from certify.analysis.reaching.options import target_of
from certify.certificates import (
    Certificate,
    PartitionTree,
    RanksAlone,
    RankTree,
    ReachCertificate,
    loop_sections,
    parse_certificate,
)
from certify.certificates.claims import Ranks, Reaches
from certify.certificates.ellipsoids import Ellipsoid, sublevel_set
from certify.certificates.membership import accepted_bytes
from certify.effort import Effort
from certify.errors import OptionError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.composition import composed
from certify.loop.expressions import Expression, Number, to_tree
from certify.loop.plants import System, kept_constraints, with_origin
from certify.loop.policies import PolicyNetwork
from certify.provers.ranks import Question, Region, Sublevel, root_box, turning, with_frame, with_order

Array = NDArray[np.float64]
Stated = Certificate | ReachCertificate
_LEAST = 2  # order of the series in time that a search begins with
_NAMED = {
    "time": "time",
    "states": "states",
    "inputs": "inputs",
    "uncertain": "ranges",
    "dynamics": "equations and parameters",
    "u_eq": "u_eq",
    "input_bounds": "input bounds",
}
"""Entries of a file's plant that make a loop, by what people call them; its domain may be wider."""


@dataclass(frozen=True, slots=True)
class Goal:
    """A set that is to be reached, where all `expressions` are at most 0.

    Parameters
    ----------
    loop : in deviations from where V is 0, if there is one.
    given : the certificate whose set {V <= c2} it is; None for a region that is named.
    """

    loop: ClosedLoop
    expressions: tuple[Expression, ...]
    given: Certificate | None = None

    @property
    def turned(self) -> list[int]:
        """The numbers of the angles whose full turns the expressions do not see."""
        return [] if self.given is None else turning(self.loop)

    @property
    def ellipsoid(self) -> Ellipsoid | None:
        """{V <= c2}; None for a region."""
        return None if self.given is None else sublevel_set(self.given.P, self.given.roa)

    @property
    def target(self) -> Region | Sublevel:
        """The set as the search sees it."""
        if self.given is None:
            return Region(self.expressions, self.loop.system.states)
        return Sublevel(self.given.V, self.given.roa)

    def question(self, x: Array, effort: Effort, tried: Callable[[Stated], Mapping[str, Any]]) -> Question:
        """The question from where it is reached, for a search around states x (n, N); of a certificate the order of the
        series in time is raised if the checker still accepts it, `tried` so."""
        asked = with_order(replace(self.bare_question(), order=_LEAST), x, effort)
        if self.given is not None:
            known = _tree_of(self.given)
            higher = replace(self.given, system=self.loop.system, evidence=replace(known, order=asked.order))
            if asked.order <= known.order or tried(higher)["result"] != "ACCEPTED":
                asked = replace(asked, order=known.order)
        return with_frame(asked, x, effort)

    def bare_question(self) -> Question:
        """The question with the order that the certificate has, if there is one, and no frame."""
        kept = tuple(kept_constraints(self.loop.system).values())
        order = 1 if self.loop.system.sample is None else _LEAST
        order = order if self.given is None else _tree_of(self.given).order
        return Question(self.loop, self.target, kept, root_box(self.loop), order)

    def certificate(
        self, question: Question, evidence: RankTree, ranks: Ranks, provenance: Mapping[str, Any]
    ) -> Stated:
        """The certificate that leaves with ranks lead there."""
        system, network = self.loop.system, self.loop.network
        if self.given is None:
            claim = Reaches(self.expressions, ranks, question.keep)
            return ReachCertificate(system, network, claim, RanksAlone(evidence, question.order), provenance)
        tree = replace(_tree_of(self.given), order=question.order)
        given = replace(self.given, system=system, evidence=tree, provenance=provenance)
        return with_ranks(given, ranks, evidence)


def with_ranks(certificate: Stated, ranks: Ranks, leaves: RankTree) -> Stated:
    """The certificate with these ranks, of these leaves."""
    if isinstance(certificate, ReachCertificate):
        claim, evidence = replace(certificate.claim, ranks=ranks), replace(certificate.evidence, ranks=leaves)
        return replace(certificate, claim=claim, evidence=evidence)
    return replace(
        certificate,
        claim=replace(certificate.claim, ranks=ranks),
        evidence=replace(_tree_of(certificate), ranks=leaves),
    )


def leaves_of(certificate: Stated) -> RankTree:
    """The leaves with ranks of a certificate that has some."""
    evidence = certificate.evidence if isinstance(certificate, ReachCertificate) else _tree_of(certificate)
    if evidence.ranks is None:
        raise TypeError("a certificate of this run has leaves with ranks")
    return evidence.ranks


def goal_of(loop: ClosedLoop, target: Sequence[str], certificate: Path | None) -> Goal:
    """The set that comparisons of the states' values say, or that a certificate proves.

    Raises
    ------
    InputError : a text is no comparison, or the certificate is not accepted, or of another loop.
    """
    if certificate is None:
        return Goal(loop, target_of(loop.system, target))
    given = _certified(certificate)
    moved = replace(loop.system, measurements=None, samples=None)
    network = loop.network
    if given.network.is_moved:
        moved = with_origin(moved, [Fraction(v) for v in given.network.origin.tolist()], given.system.exact_u_eq())
        network = replace(network, origin=given.network.origin)
    there = ClosedLoop(moved, network)
    _require_same(there, given, certificate)
    x = moved.states
    pairs = [(i, j) for i in range(len(x)) for j in range(len(x))]
    terms = [Number(Fraction(float(given.P[i, j]))) * x[i] * x[j] for i, j in pairs]
    return Goal(there, (reduce(add, terms) - Number(Fraction(given.roa)),), given)


def into_set_of(path: Path, system: System, network: PolicyNetwork, options: RoaOptions) -> RoaOptions:
    """The options of a run that looks for a tube into the set of a certificate, which this run proves again.

    Raises
    ------
    InputError : the certificate is not accepted, of another loop, or of trajectories that need not converge to x = 0.
    """
    given = goal_of(ClosedLoop(*composed(system, network)), (), path).given
    if given is None or not given.claim.at_rest:
        raise OptionError(f"`target` must be an asymptotic certificate where a tube leads into its set; {path} is not.")
    return replace(options, P=given.P, level=given.roa)


def _certified(path: Path) -> Certificate:
    """The certificate in a file, which the checker accepts, without a tube, ranks or a set beyond its ellipsoid.

    Raises
    ------
    InputError : the checker does not accept it, or its claim has no ellipsoid or rests on data.
    """
    found = parse_certificate(accepted_bytes(path), str(path))
    if found.data is not None or found.then is not None:
        raise OptionError(
            f"`target` must be a certificate without data and without one that takes over; {path} has one of them."
        )
    for weaker in (found.claim.without_tube(), found.claim.without_outer(), found.claim.without_ranks()):
        found = found if weaker is None else replace(found, claim=weaker, evidence=_alone(found))
    return found


def _tree_of(given: Certificate) -> PartitionTree:
    if not isinstance(given.evidence, PartitionTree):  # the checker accepts no solver's word
        raise TypeError("a certificate that the checker accepts has a tree")
    return given.evidence


def _alone(given: Certificate) -> PartitionTree:
    """The evidence for the ellipsoid alone."""
    return replace(_tree_of(given), tube=(), outer=None, ranks=None)


def _require_same(loop: ClosedLoop, given: Certificate, path: Path) -> None:
    """Refuse a loop that is not the certificate's, but for a name and a wider domain.

    Raises
    ------
    OptionError : it is not.
    """
    system, other = loop.system, given.system
    here, there = (loop_sections(s, n) for s, n in ((system, loop.network), (other, given.network)))
    differ = [name for key, name in _NAMED.items() if here["plant"][key] != there["plant"][key]]
    differ += ["period"] if system.sample != other.sample else []
    differ += ["policy"] if here["policy"] != there["policy"] else []
    kept = [list(map(to_tree, g)) for g in (kept_constraints(system).values(), given.kept)]
    differ += ["constraints"] if kept[0] != kept[1] else []
    if differ:
        raise OptionError(
            f"`target` must be a certificate about the same loop; that in {path} differs in {', '.join(differ)}. Make "
            "it with the same policy, plant and options."
        )
    narrower = any(lo > least or hi < most for (lo, hi), (least, most) in zip(system.domain, other.domain, strict=True))
    if narrower:
        raise OptionError(
            f"`target` must be a certificate for this domain, or for a part of it; that in {path} has a wider one. "
            "`domain` widens that of the run."
        )
