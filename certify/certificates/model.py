"""The certificate as data, its canonical writer and a reader for reports.

Numbers never pass through decimal: hex floats, exact fractions, or raw little-endian bytes in base64. The reader here
serves pictures and summaries; only the checker decides whether a certificate is valid.

A file may change between two reads. So code about a certificate reads it once (`read_raw`) and takes everything from
these bytes: `parse_certificate`, their sha256, and the checker's answer about a private file that holds them.
"""

from __future__ import annotations

import base64
import json
import os
import re
import stat
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.certificates.claims import CLAIMS, Claim, Enlarged, Outer, Reached
from certify.certificates.formats import SCHEMA, other_version
from certify.errors import CertificateFormatError, InputError
from certify.loop.expressions import Number, Symbol, from_tree, to_tree
from certify.loop.plants import System
from certify.loop.plants.system import Interval
from certify.loop.policies import TanhNetwork
from certify.lyapunov.function import Quadratic
from certify.lyapunov.neural import Neural
from certify.lyapunov.symbolic import Symbolic

Array = NDArray[np.float64]
MAX_BYTES = 256 * 2**20
_LONGEST_UNIT = 40
_OF_A_BALL = ("J", "multipliers", "weight")
_OF_A_PATH = ("share", "edge", "motion", "joint")


@dataclass(frozen=True, slots=True)
class LocalBall:
    """Evidence of the local proof: a ball x = J d, ||d|| <= 1, J (n, n), that contains {V <= c1}, and `multipliers`
    (3, n) of the matrix inequality on it with the `weight` (n, n) from which all others follow.

    `edge` is the multiplier of V - c0 of a practical claim, `order` that of the series in time of a sampled one.
    """

    J: Array
    multipliers: Array
    weight: Array
    edge: float = 0.0
    order: int = 1


@dataclass(frozen=True, slots=True)
class Contraction:
    """Evidence that trajectories come closer: a ball x = J d, ||d|| <= 1, J (n, n), that contains {V <= c0}, and the
    `weights` (n,) of one bound on it and the `weight` (n, n) of another."""

    J: Array
    weights: Array
    weight: Array


@dataclass(frozen=True, slots=True)
class Waypoint:
    """The end of a slab of a tube around a path, and its inequality's further numbers.

    Parameters
    ----------
    centre : the centre of the slab's ellipsoid at its end, (n,); between its ends the centre moves on a line.
    share : the share of the slab's ball that the centre's motion takes; between 0 and 1.
    edge, motion, joint : multipliers of the tube's boundary and of the motion, and the motion's entry of the third row.
    """

    centre: Array
    share: float
    edge: float
    motion: float
    joint: float


@dataclass(frozen=True, slots=True)
class Slab:
    """A piece of a tube, on which P(t) is a polynomial of degree 2 in Bernstein's form.

    Parameters
    ----------
    middle, end : its coefficients after that of the slab before, (n, n); the piece ends at {x'Px <= 1}, P = `end`.
    duration : units of time.
    J, multipliers, weight : a ball that contains it, (n, n), and the numbers of the matrix inequalities on it, (3, n)
    and (k, k), k = n at rest and n + 1 along a path.
    path : None where the ellipsoids stay around the origin.
    """

    middle: Array
    end: Array
    duration: float
    J: Array
    multipliers: Array
    weight: Array
    path: Waypoint | None = None


@dataclass(frozen=True, slots=True)
class OuterTree:
    """Evidence of a claim's outer set: a partition of a box around the domain, and one of each of the domain's faces.

    Parameters
    ----------
    T, root : (n, n) and (n,), half-widths of the root box in z, x = T z.
    tree : the partition in preorder, one byte per node.
    faces : the same for the lower and the upper end of each state, in the order of the states, 2 n in all.
    """

    T: Array
    root: Array
    tree: bytes
    faces: tuple[bytes, ...]


@dataclass(frozen=True, slots=True)
class PartitionTree:
    """Evidence that the checker replays.

    Parameters
    ----------
    T, root : (n, n) and (n,), half-widths of the root box in z, x = T z.
    tree : the partition in preorder, one byte per node.
    local : the local proof; None if the claim has none.
    cells : number of parts of each uncertain quantity's range in the local proof, in their order.
    tube : the slabs of a claim with a tube, in their order.
    order : order of the series in time on its leaves, if the input is held over a period.
    contraction : the contraction of a claim of a nearby equilibrium.
    outer : the outer set's evidence, if the claim has one.
    """

    T: Array
    root: Array
    tree: bytes
    local: LocalBall | None = None
    tube: tuple[Slab, ...] = ()
    cells: tuple[int, ...] = ()
    order: int = 1
    contraction: Contraction | None = None
    outer: OuterTree | None = None


@dataclass(frozen=True, slots=True)
class TrustedSolver:
    """Evidence that cannot be replayed: a solver's answers. `queries` are pairs (name, answer)."""

    solver: str
    version: str
    precision: float
    queries: tuple[tuple[str, str], ...]


@dataclass(frozen=True, slots=True)
class Certificate:
    """A claim with its evidence.

    Parameters
    ----------
    system, network : the closed loop; parameters are already put into the equations.
    V : the Lyapunov function.
    claim : the claim about them, with its levels.
    provenance : anything that helps people; the checker ignores it.

    Raises
    ------
    InputError : the policy has an origin other than 0 under a claim or a centring that does not allow it.
    """

    system: System
    network: TanhNetwork
    V: Quadratic
    claim: Claim
    evidence: PartitionTree | TrustedSolver
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.network.is_moved and (self.claim.at_rest or self.network.centre != "none"):
            raise InputError(
                f"`origin` of a policy must be 0 with centre {self.network.centre!r} and claim {self.kind!r}; found "
                f"{self.network.origin.tolist()}."
            )

    @property
    def P(self) -> Array:
        """The matrix of V, (n, n)."""
        return self.V.P

    @property
    def kind(self) -> str:
        """The claim's kind."""
        return self.claim.kind

    @property
    def inner(self) -> float:
        """The level from which the ring reaches outwards."""
        return self.claim.inner

    @property
    def roa(self) -> float:
        """c2."""
        return self.claim.roa

    def to_json(self) -> str:
        """The file's text: sorted by section, one line per section, the same bytes for the same certificate."""
        system, network = self.system, self.network
        sections: dict[str, Any] = {
            "schema": SCHEMA,
            "claim": {
                "kind": self.claim.kind,
                "rate": float(self.claim.rate).hex(),
                "sample": None if system.sample is None else [str(h) for h in system.sample],
                "outer": None if self.claim.outer is None else _outer(self.claim.outer),
            }
            | _start(self.claim),
            **loop_sections(system, network),
            "lyapunov": {"kind": "quadratic", "P": encode(self.V.P)},
            "levels": {name: float(level).hex() for name, level in self.claim.levels.items()},
            "evidence": _evidence(self.evidence),
            "provenance": {k: str(v) for k, v in self.provenance.items()} | _for_people(system),
        }
        lines = [f"{json.dumps(k)}: {json.dumps(v)}" for k, v in sections.items()]
        return "{\n" + ",\n".join(lines) + "\n}\n"


def loop_sections(system: System, network: TanhNetwork) -> dict[str, Any]:
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
            "layers": _layers(network.weights, network.biases),
            "squash": network.squash,
            "centre": network.centre,
            "scale": encode(network.scale),
            "offset": encode(network.offset),
            "clip": None if network.clip is None else [encode(end) for end in network.clip],
            "origin": encode(network.origin),
            "sha256": network.sha256(),
        },
    }


def read_raw(path: Path) -> bytes:
    """The file's bytes, read once.

    Raises
    ------
    CertificateFormatError : the file cannot be read, is no regular file, or is larger than a certificate may be.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))  # nobody may ever write into a pipe
        with open(descriptor, "rb") as stream:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                raise CertificateFormatError(
                    f"{path} must be a regular file; it is a folder, a pipe, a socket or a device. Name the "
                    "certificate's own file."
                )
            raw = stream.read(MAX_BYTES + 1)
    except OSError as error:
        raise CertificateFormatError(f"{path} cannot be read: {error.strerror}.") from error
    if len(raw) > MAX_BYTES:
        raise CertificateFormatError(f"{path} is not a certificate: it is larger than {MAX_BYTES:,} bytes.")
    return raw


def read_certificate(path: Path) -> Certificate:
    """Read a certificate for a report or a picture, once. This does not check it.

    Raises
    ------
    CertificateFormatError : the file cannot be read as a certificate.
    """
    return parse_certificate(read_raw(path), str(path))


def parse_certificate(raw: bytes, name: str) -> Certificate:
    """Parse a certificate from its bytes. This does not check it.

    Parameters
    ----------
    raw : the file's bytes.
    name : their name in messages.

    Raises
    ------
    CertificateFormatError : the bytes are no certificate.
    """
    try:
        data = json.loads(raw.decode("utf-8"))
        if data["schema"] != SCHEMA:
            known = other_version(data["schema"])
            raise CertificateFormatError(
                f"{name}: `schema` must be {SCHEMA!r}; found {data['schema']!r:.60}.{f' {known}' if known else ''}"
            )
        kind = data["claim"]["kind"]
        if kind not in CLAIMS:
            raise CertificateFormatError(f"{name}: `claim.kind` must be one of {', '.join(CLAIMS)}; found {kind!r}.")
        plant, policy, evidence = data["plant"], data["policy"], data["evidence"]
        states, inputs = (tuple(Symbol(s) for s in plant[k]) for k in ("states", "inputs"))
        ranges = {q["name"]: (Fraction(q["range"][0]), Fraction(q["range"][1])) for q in plant["uncertain"]}
        names = {s.name: s for s in (*states, *inputs, *map(Symbol, ranges))}
        n, m = len(states), len(inputs)
        sample = data["claim"]["sample"]
        provenance, units, x_eq, nominal = _read_provenance(data["provenance"], names)
        system = System(
            name=plant["name"],
            states=states,
            inputs=inputs,
            parameters={name: _nominal(interval, nominal.get(name)) for name, interval in ranges.items()},
            dynamics=tuple(from_tree(t, names) for t in plant["dynamics"]),
            u_eq=tuple(Number(Fraction(q)) for q in plant["u_eq"]),
            domain=tuple((Fraction(lo), Fraction(hi)) for lo, hi in plant["domain"]),
            input_bounds=tuple((Fraction(lo), Fraction(hi)) for lo, hi in plant["input_bounds"]),
            units=units,
            x_eq=tuple(Number(Fraction(x_eq.get(s.name, "0"))) for s in states),
            ranges=ranges,
            time=plant["time"],
            sample=None if sample is None else (Fraction(sample[0]), Fraction(sample[1])),
        )
        network = TanhNetwork(
            *_read_layers(policy["layers"]),
            scale=decode(policy["scale"], (m,)),
            offset=decode(policy["offset"], (m,)),
            squash=policy["squash"],
            centre=policy["centre"],
            clip=_read_clip(policy["clip"], m),
            origin=decode(policy["origin"], (n,)),
        )
        return Certificate(
            system=system,
            network=network,
            V=Quadratic(decode(data["lyapunov"]["P"], (n, n))),
            claim=_read_claim(data, states),
            evidence=_read_evidence(evidence, n),
            provenance=provenance,
        )
    except CertificateFormatError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise CertificateFormatError(f"{name} is not a certificate: {type(error).__name__}: {error}.") from error


def _read_claim(data: Mapping[str, Any], states: tuple[Symbol, ...]) -> Claim:
    n = len(states)
    levels: dict[str, Any] = {k: float.fromhex(v) for k, v in data["levels"].items()}
    levels["rate"] = float.fromhex(data["claim"]["rate"])
    kind, outer = data["claim"]["kind"], data["claim"]["outer"]
    if outer is not None:
        return replace(CLAIMS[kind](**levels), outer=_read_outer(outer, states))
    if kind == Enlarged.kind:
        return Enlarged(**levels, start=Quadratic(decode(data["claim"]["start"], (n, n))))
    if kind == Reached.kind:
        start, centre = decode(data["claim"]["start"], (n, n)), decode(data["claim"]["centre"], (n,))
        return Reached(**levels, start=Quadratic(start), centre=tuple(centre.tolist()))
    return CLAIMS[kind](**levels)


def _outer(outer: Outer) -> dict[str, Any]:
    N = outer.function
    if isinstance(N, Neural):
        stated: dict[str, Any] = {"kind": "network", "layers": _layers(N.weights, N.biases)}
    else:
        stated = {"kind": "expression", "expression": to_tree(N.expression)}
    return {**stated, "level": float(outer.level).hex()}


def _read_outer(data: Mapping[str, Any], states: tuple[Symbol, ...]) -> Outer:
    level = float.fromhex(data["level"])
    if data["kind"] == "network":
        return Outer(Neural(*_read_layers(data["layers"])), level)
    return Outer(Symbolic(from_tree(data["expression"], {s.name: s for s in states}), states), level)


def _layers(weights: Sequence[Array], biases: Sequence[Array]) -> list[dict[str, Any]]:
    return [
        {"shape": list(W.shape), "weight": encode(W), "bias": encode(b)} for W, b in zip(weights, biases, strict=True)
    ]


def _read_layers(layers: Sequence[Mapping[str, Any]]) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    weights = tuple(decode(x["weight"], tuple(x["shape"])) for x in layers)
    return weights, tuple(decode(x["bias"], (x["shape"][0],)) for x in layers)


def _nominal(interval: Interval, said: str | None) -> Fraction:
    """A nominal value of an uncertain quantity: the file's note for people, if it lies in the range; else 0 if that
    does, else the middle. No claim depends on it.
    """
    lo, hi = interval
    if said is not None and lo <= Fraction(said) <= hi:
        return Fraction(said)
    return Fraction(0) if lo <= 0 <= hi else (lo + hi) / 2


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


def _read_provenance(
    data: Any, names: Mapping[str, Any]
) -> tuple[dict[str, str], dict[str, str], dict[str, str], dict[str, str]]:
    """The provenance as text, and units, operating point and nominal values in it; it is for people, so invalid
    entries are ignored.
    """
    found = data if isinstance(data, dict) else {}
    read = {}
    for key, is_one in (("units", _is_unit), ("x_eq", _is_value), ("nominal", _is_value)):
        entry = found.get(key)
        usable = isinstance(entry, dict) and all(k in names and is_one(v) for k, v in entry.items())
        read[key] = entry if usable and isinstance(entry, dict) else {}
    text = {k: str(v) for k, v in found.items() if not read.get(k)}
    return text, read["units"], read["x_eq"], read["nominal"]


def _is_value(value: Any) -> bool:
    return isinstance(value, str) and re.fullmatch(r"-?[0-9]{1,200}(/[1-9][0-9]{0,199})?", value) is not None


def _is_unit(value: Any) -> bool:
    return isinstance(value, str) and len(value) <= _LONGEST_UNIT and value.isprintable()


def _evidence(evidence: PartitionTree | TrustedSolver) -> dict[str, Any]:
    if isinstance(evidence, PartitionTree):
        return {
            "kind": "partition-tree",
            "T": encode(evidence.T),
            "root": encode(evidence.root),
            "tree": base64.b64encode(evidence.tree).decode("ascii"),
            "cells": list(evidence.cells),
            "order": evidence.order,
            "local": None if evidence.local is None else _local(evidence.local),
            "contraction": None if evidence.contraction is None else _contraction(evidence.contraction),
            "tube": [
                {"middle": encode(slab.middle), "end": encode(slab.end), "duration": float(slab.duration).hex()}
                | _ball(slab)
                | {"path": None if slab.path is None else _path(slab.path)}
                for slab in evidence.tube
            ],
            "outer": None if evidence.outer is None else _outer_tree(evidence.outer),
        }
    return {
        "kind": "trusted-solver",
        "solver": evidence.solver,
        "version": evidence.version,
        "precision": float(evidence.precision).hex(),
        "queries": [list(pair) for pair in evidence.queries],
    }


def _read_evidence(data: Mapping[str, Any], n: int) -> PartitionTree | TrustedSolver:
    if data["kind"] == "partition-tree":
        root, local = decode(data["root"], (n,)), data["local"]
        return PartitionTree(
            decode(data["T"], (n, n)),
            root,
            base64.b64decode(data["tree"]),
            None if local is None else _read_local(local, n),
            tuple(
                Slab(
                    decode(slab["middle"], (n, n)),
                    decode(slab["end"], (n, n)),
                    float.fromhex(slab["duration"]),
                    *_read_ball(slab, n, n + (slab["path"] is not None)),
                    None if slab["path"] is None else _read_path(slab["path"], n),
                )
                for slab in data["tube"]
            ),
            tuple(map(int, data["cells"])),
            int(data["order"]),
            None if data["contraction"] is None else _read_contraction(data["contraction"], n),
            None if data["outer"] is None else _read_outer_tree(data["outer"], n),
        )
    queries = tuple((str(name), str(answer)) for name, answer in data["queries"])
    return TrustedSolver(str(data["solver"]), str(data["version"]), float.fromhex(data["precision"]), queries)


def _outer_tree(evidence: OuterTree) -> dict[str, Any]:
    tree, *faces = (base64.b64encode(nodes).decode("ascii") for nodes in (evidence.tree, *evidence.faces))
    return {"T": encode(evidence.T), "root": encode(evidence.root), "tree": tree, "faces": faces}


def _read_outer_tree(data: Mapping[str, Any], n: int) -> OuterTree:
    tree, *faces = (base64.b64decode(nodes) for nodes in (data["tree"], *data["faces"]))
    return OuterTree(decode(data["T"], (n, n)), decode(data["root"], (n,)), tree, tuple(faces))


def _ball(evidence: LocalBall | Slab) -> dict[str, str]:
    return {name: encode(getattr(evidence, name)) for name in _OF_A_BALL}


def _contraction(ball: Contraction) -> dict[str, str]:
    return {name: encode(getattr(ball, name)) for name in ("J", "weights", "weight")}


def _read_contraction(data: Mapping[str, str], n: int) -> Contraction:
    return Contraction(decode(data["J"], (n, n)), decode(data["weights"], (n,)), decode(data["weight"], (n, n)))


def _local(ball: LocalBall) -> dict[str, Any]:
    return {**_ball(ball), "edge": float(ball.edge).hex(), "order": ball.order}


def _read_local(data: Mapping[str, Any], n: int) -> LocalBall:
    return LocalBall(*_read_ball(data, n, n), float.fromhex(data["edge"]), int(data["order"]))


def _read_ball(data: Mapping[str, str], n: int, k: int) -> tuple[Array, Array, Array]:
    """k is how many entries d has."""
    J, multipliers, weight = (data[name] for name in _OF_A_BALL)
    return decode(J, (n, n)), decode(multipliers, (3, n)), decode(weight, (k, k))


def _path(path: Waypoint) -> dict[str, str]:
    numbers = {name: float(getattr(path, name)).hex() for name in _OF_A_PATH}
    return {"centre": encode(path.centre), **numbers}


def _read_path(data: Mapping[str, str], n: int) -> Waypoint:
    return Waypoint(decode(data["centre"], (n,)), *(float.fromhex(data[name]) for name in _OF_A_PATH))


def _start(claim: Claim) -> dict[str, str]:
    if isinstance(claim, Reached):
        return {"start": encode(claim.start.P), "centre": encode(np.array(claim.centre))}
    return {"start": encode(claim.start.P)} if isinstance(claim, Enlarged) else {}


def _read_clip(data: Any, m: int) -> tuple[Array, Array] | None:
    if data is None:
        return None
    lo, hi = data
    return decode(lo, (m,)), decode(hi, (m,))


def encode(array: Array) -> str:
    return base64.b64encode(np.ascontiguousarray(array, dtype="<f8").tobytes()).decode("ascii")


def decode(text: str, shape: tuple[int, ...]) -> Array:
    return np.frombuffer(base64.b64decode(text), dtype="<f8").reshape(shape).astype(np.float64)
