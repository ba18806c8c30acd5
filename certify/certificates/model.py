"""The certificate as data, and its canonical text. Numbers never pass through decimal: hex floats, exact fractions, or
raw bytes.
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.certificates.claims import Claim, Invariant, Outer, Ranks, Reaches, Remains
from certify.certificates.data import DataBounds, data_claim, data_evidence
from certify.certificates.encoding import encode, network_section
from certify.certificates.evidence import OuterTree, PartitionTree, RanksAlone, TrustedSolver, evidence_section
from certify.certificates.formats import SCHEMA
from certify.certificates.samples import SampleBounds, samples_claim, samples_evidence
from certify.errors import InputError
from certify.loop.expressions import Expression, to_tree
from certify.loop.plants import System, kept_constraints
from certify.loop.policies import PolicyNetwork
from certify.lyapunov.function import Quadratic
from certify.lyapunov.neural import Neural

Array = NDArray[np.float64]
POLICY, N_NAME = "policy", "N"
"""Names of networks in a file."""


class _Stated(ABC):
    """A closed loop with a claim; parameters are already put into the equations, and the checker ignores
    `provenance`."""

    __slots__ = ()
    system: System
    network: PolicyNetwork
    claim: Claim | Reaches | Remains | Invariant
    provenance: Mapping[str, Any]

    @property
    def kept(self) -> tuple[Expression, ...]:
        """The claim's constraints."""
        return self.claim.keep

    @property
    def kind(self) -> str:
        """The claim's kind."""
        return self.claim.kind

    @abstractmethod
    def sections(self) -> dict[str, Any]:
        """The sections of the claim, V, its levels and the evidence, and of networks beside the policy's."""

    @property
    def constraints(self) -> dict[str, Expression]:
        """The claim's constraints: g of each condition g < 0, by its name in the plant, or else by its number."""
        named = {g: name for name, g in kept_constraints(self.system).items()}
        return {named.get(g, f"constraint_{k}"): g for k, g in enumerate(self.kept, 1)}

    def to_json(self) -> str:
        """The file's text: sorted by section, one line per section, the same bytes for the same certificate."""
        lines = [f"{json.dumps(k)}: {json.dumps(v)}" for k, v in self.document().items()]
        return "{\n" + ",\n".join(lines) + "\n}\n"

    def document(self) -> dict[str, Any]:
        """The file's JSON object."""
        own = self.sections()
        people = _for_people(self.system) | _names_of(list(self.constraints))
        return {
            "schema": SCHEMA,
            "claim": own["claim"],
            "networks": [network_section(POLICY, self.network.network), *own["networks"]],
            **loop_sections(self.system, self.network),
            "lyapunov": own["lyapunov"],
            "levels": own["levels"],
            "evidence": own["evidence"],
            "provenance": {k: str(v) for k, v in self.provenance.items()} | people,
            **own.get("after", {}),
        }


@dataclass(frozen=True, slots=True)
class Certificate(_Stated):
    """A claim about the level sets of a Lyapunov function, with its evidence.

    Parameters
    ----------
    system, network : the closed loop; parameters are already put into the equations.
    V : the Lyapunov function.
    claim : the claim about them, with its levels.
    provenance : anything that helps people; the checker ignores it.
    data : the evidence that the plant's measurements bound its parameters, or that its equations stand for sampled
        functions; None if ranges and equations are assumed.
    then : the certificate that takes over where a practical claim ends; None if nothing is said of that.

    Raises
    ------
    InputError : the policy has an origin other than 0 under a claim or a centring that does not allow it, or only one
        of claim and evidence has ranks.
    """

    system: System
    network: PolicyNetwork
    V: Quadratic
    claim: Claim
    evidence: PartitionTree | TrustedSolver
    provenance: Mapping[str, Any] = field(default_factory=dict)
    data: DataBounds | SampleBounds | None = None
    then: Certificate | None = None

    def __post_init__(self) -> None:
        if self.network.is_moved and (self.claim.at_rest or self.network.centre != "none"):
            raise InputError(
                f"`origin` of a policy must be 0 with centre {self.network.centre!r} and claim {self.kind!r}; found "
                f"{self.network.origin.tolist()}."
            )
        tree = self.evidence.ranks if isinstance(self.evidence, PartitionTree) else None
        if (self.claim.ranks is None) is not (tree is None):
            raise InputError("a claim with ranks must have evidence with ranks, and another claim none.")

    @property
    def P(self) -> Array:
        """The matrix of V, (n, n)."""
        return self.V.P

    @property
    def inner(self) -> float:
        """The level from which the ring reaches outwards."""
        return self.claim.inner

    @property
    def roa(self) -> float:
        """c2."""
        return self.claim.roa

    def sections(self) -> dict[str, Any]:
        """The sections of the claim, V, its levels and the evidence, and of networks beside the policy's."""
        claim, system = self.claim, self.system
        claimed, shown = self._of_data()
        return {
            "claim": {
                "kind": claim.kind,
                "rate": float(claim.rate).hex(),
                "sample": _sample(system),
                "outer": None if claim.outer is None else _outer(claim.outer, system),
            }
            | _start(claim)
            | _ranks(claim.ranks)
            | _keep(claim.keep)
            | claimed,
            "networks": _networks(claim.outer),
            "lyapunov": {"kind": "quadratic", "P": encode(self.V.P)},
            "levels": {name: float(level).hex() for name, level in claim.levels.items()},
            "evidence": evidence_section(self.evidence) | shown,
            "after": {} if self.then is None else {"then": self.then.document()},
        }

    def _of_data(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """The entries `data` or `samples` of the claim and of the evidence; nothing without data."""
        by, measured, sampled = self.data, self.system.measurements, self.system.samples
        if isinstance(by, DataBounds) and measured is not None:
            return {"data": data_claim(measured, self.system)}, {"data": data_evidence(by)}
        if isinstance(by, tuple) and sampled is not None:
            return {"samples": samples_claim(sampled)}, {"samples": samples_evidence(sampled, by)}
        return {}, {}


@dataclass(frozen=True, slots=True)
class ReachCertificate(_Stated):
    """A claim that a region is reached, with its evidence.

    Parameters
    ----------
    system, network : the closed loop; parameters are already put into the equations.
    claim, evidence : the region, and boxes with ranks.
    provenance : anything that helps people; the checker ignores it.
    """

    system: System
    network: PolicyNetwork
    claim: Reaches
    evidence: RanksAlone
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def sections(self) -> dict[str, Any]:
        """The sections of the claim, V, its levels and the evidence, and of networks beside the policy's."""
        return _of_ranks(self, {"target": [to_tree(t) for t in self.claim.target]})


@dataclass(frozen=True, slots=True)
class RemainCertificate(_Stated):
    """A claim that boxes are never left, with its evidence.

    Parameters
    ----------
    system, network : the closed loop; parameters are already put into the equations.
    claim, evidence : what is kept, and the boxes.
    provenance : anything that helps people; the checker ignores it.
    """

    system: System
    network: PolicyNetwork
    claim: Remains
    evidence: RanksAlone
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def sections(self) -> dict[str, Any]:
        """The sections of the claim, V, its levels and the evidence, and of networks beside the policy's."""
        return _of_ranks(self, {})


@dataclass(frozen=True, slots=True)
class InvariantCertificate(_Stated):
    """A claim that a set is never left, with its evidence.

    Parameters
    ----------
    system, network : the closed loop; parameters are already put into the equations.
    claim, evidence : the set, and trees of boxes over the domain and its faces.
    provenance : anything that helps people; the checker ignores it.

    Raises
    ------
    InputError : the loop's time goes in steps.
    """

    system: System
    network: PolicyNetwork
    claim: Invariant
    evidence: OuterTree
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.system.in_steps:
            raise InputError("a claim that a set is never left must be about a loop whose time does not go in steps.")

    def sections(self) -> dict[str, Any]:
        """The sections of the claim, V, its levels and the evidence, and of networks beside the policy's."""
        claim = self.claim
        return {
            "claim": {"kind": claim.kind, "outer": _outer(claim.outer, self.system)} | _keep(claim.keep),
            "networks": _networks(claim.outer),
            "lyapunov": None,
            "levels": {},
            "evidence": evidence_section(self.evidence),
        }


AnyCertificate = Certificate | ReachCertificate | RemainCertificate | InvariantCertificate


def _of_ranks(certificate: ReachCertificate | RemainCertificate, target: dict[str, Any]) -> dict[str, Any]:
    """The sections of a certificate whose claim is about ranks alone, with a target or none."""
    claim = certificate.claim
    return {
        "claim": {"kind": claim.kind, "sample": _sample(certificate.system), **target}
        | _ranks(claim.ranks)
        | _keep(claim.keep),
        "networks": [],
        "lyapunov": None,
        "levels": {},
        "evidence": evidence_section(certificate.evidence),
    }


def loop_sections(system: System, network: PolicyNetwork) -> dict[str, Any]:
    """The file's sections `plant` and `policy`."""
    return {
        "plant": {
            "name": system.name,
            "time": system.time,
            "states": [s.name for s in system.states],
            "inputs": [s.name for s in system.inputs],
            "uncertain": [{"name": s.name, "range": [str(lo), str(hi)]} for s, (lo, hi) in system.uncertain],
            "dynamics": [to_tree(e) for e in system.uncertain_dynamics()],
            "u_eq": [str(u) for u in system.exact_u_eq()],
            "domain": [[str(lo), str(hi)] for lo, hi in system.domain],
            "input_bounds": [[str(lo), str(hi)] for lo, hi in system.input_bounds],
        },
        "policy": {
            "network": POLICY,
            "squash": network.squash,
            "centre": network.centre,
            "scale": encode(network.scale),
            "offset": encode(network.offset),
            "clip": None if network.clip is None else [encode(end) for end in network.clip],
            "origin": encode(network.origin),
            "sha256": network.sha256(),
        },
    }


def _start(claim: Claim) -> dict[str, str]:
    """The set from which a tube leads; nothing without a tube."""
    start = {} if claim.start is None else {"start": encode(claim.start.P)}
    return start if claim.centre is None else {**start, "centre": encode(np.array(claim.centre))}


def _sample(system: System) -> list[str] | None:
    return None if system.sample is None else [str(h) for h in system.sample]


def _ranks(ranks: Ranks | None) -> dict[str, Any]:
    """The ranks; nothing where there are none."""
    return {} if ranks is None else {"ranks": {"angles": list(ranks.angles), "steps": ranks.steps}}


def _keep(keep: Sequence[Expression]) -> dict[str, Any]:
    """The constraints; nothing where there are none."""
    return {"keep": [to_tree(g) for g in keep]} if keep else {}


def _networks(outer: Outer | None) -> list[dict[str, Any]]:
    """The networks that N calls."""
    if outer is None or not isinstance(outer.function, Neural):
        return []
    return [network_section(N_NAME, outer.function.network)]


def _outer(outer: Outer, system: System) -> dict[str, Any]:
    N = outer.function
    called: list[Any] = ["network", N_NAME, 0, *(s.name for s in system.states)]
    return {"expression": called if isinstance(N, Neural) else to_tree(N.expression), "level": float(outer.level).hex()}


def _names_of(constraints: Sequence[str]) -> dict[str, list[str]]:
    """The provenance's entry for names of constraints, in their order; none without constraints."""
    return {"constraints": list(constraints)} if constraints else {}


def _for_people(system: System) -> dict[str, dict[str, str]]:
    """The provenance's entries for units of what the plant names, for the operating point, and for nominal values of
    uncertain parameters; none where there are none.

    The plant of a certificate is in deviations from x_eq, so that no check depends on either.
    """
    names = [s.name for s in (*system.states, *system.inputs, *(s for s, _ in system.uncertain))]
    units = {name: system.units[name] for name in names if name in system.units}
    x_eq = {name: str(q) for name, q in system.operating_point().items()}
    nominal = {name: str(system.parameters[name]) for name in system.ranges if name in system.parameters}
    return {key: entry for key, entry in (("units", units), ("x_eq", x_eq), ("nominal", nominal)) if entry}
