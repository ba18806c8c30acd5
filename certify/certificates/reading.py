"""Certificates read for reports and pictures. Whether one is valid is for the checker alone to say.

A file may change between two reads, and some give other bytes at each. Whoever says something about a certificate
reads it once (`read_raw`) and takes everything from these bytes: `parse_certificate`, their sha256, and the checker's
answer about a file of its own that holds them.
"""

from __future__ import annotations

import json
import os
import re
import stat
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.certificates.claims import CLAIMS, Claim, Invariant, Outer, Ranks, Reaches, Remains
from certify.certificates.data import DataBounds, read_data_bounds, read_measurements
from certify.certificates.encoding import decode, network_named, read_network
from certify.certificates.evidence import read_evidence, read_outer_alone, read_ranks_alone
from certify.certificates.formats import SCHEMA, other_version
from certify.certificates.model import (
    AnyCertificate,
    Certificate,
    InvariantCertificate,
    ReachCertificate,
    RemainCertificate,
)
from certify.certificates.samples import SampleBounds, read_samples
from certify.errors import CertificateFormatError
from certify.loop.expressions import Expression, Number, Symbol, from_tree
from certify.loop.plants import System
from certify.loop.plants.system import Interval
from certify.loop.policies import PolicyNetwork
from certify.lyapunov.function import Quadratic
from certify.lyapunov.neural import Neural
from certify.lyapunov.symbolic import Symbolic

Array = NDArray[np.float64]
MAX_BYTES = 256 * 2**20
_LONGEST_UNIT = 40


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
    except FileNotFoundError as error:
        raise CertificateFormatError(
            f"{path} cannot be read: there is no such file. certify roa writes certificate.json into its folder --out."
        ) from error
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
    """The certificate with a V that the bytes hold. This does not check it.

    Parameters
    ----------
    raw : the file's bytes.
    name : what messages call them.

    Raises
    ------
    CertificateFormatError : the bytes are no certificate, or one without V.
    """
    found = parse_any(raw, name)
    if not isinstance(found, Certificate):
        what = "a region is reached" if isinstance(found, ReachCertificate) else "a set is never left"
        raise CertificateFormatError(
            f"{name} says that {what}, and has no V, of which a certificate for this command must be. certify check, "
            "certify contains and certify report take it."
        )
    return found


def parse_any(raw: bytes, name: str) -> AnyCertificate:
    """The certificate that the bytes hold, of any claim. This does not check it.

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
        kind, kinds = data["claim"]["kind"], (*CLAIMS, Reaches.kind, Remains.kind, Invariant.kind)
        if kind not in kinds:
            raise CertificateFormatError(f"{name}: `claim.kind` must be one of {', '.join(kinds)}; found {kind!r}.")
        n = len(data["plant"]["states"])
        provenance, people = _read_provenance(data["provenance"], data["plant"])
        system = _read_system(data["plant"], data["claim"].get("sample"), people)
        names = provenance.pop("constraints", "")
        network = _read_network(data["policy"], data["networks"], n, len(data["plant"]["inputs"]))
        if kind == Reaches.kind:
            reaches = _read_reaches(data["claim"], system)
            evidence = read_ranks_alone(data["evidence"], n)
            return ReachCertificate(_with_constraints(system, reaches, names), network, reaches, evidence, provenance)
        if kind == Remains.kind:
            remains = Remains(_read_ranks(data["claim"]["ranks"]), _read_keep(data["claim"], system))
            evidence = read_ranks_alone(data["evidence"], n)
            return RemainCertificate(_with_constraints(system, remains, names), network, remains, evidence, provenance)
        if kind == Invariant.kind:
            stays = Invariant(
                _read_outer(data["claim"]["outer"], data["networks"], system.states), _read_keep(data["claim"], system)
            )
            tree = read_outer_alone(data["evidence"], n)
            return InvariantCertificate(_with_constraints(system, stays, names), network, stays, tree, provenance)
        claim = _read_claim(data, system)
        system, bounds = _with_data(_with_constraints(system, claim, names), data)
        return Certificate(
            then=None if "then" not in data else parse_certificate(json.dumps(data["then"]).encode(), name),
            system=system,
            network=network,
            V=Quadratic(decode(data["lyapunov"]["P"], (n, n))),
            claim=claim,
            evidence=read_evidence(data["evidence"], n),
            provenance=provenance,
            data=bounds,
        )
    except CertificateFormatError:
        raise
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise CertificateFormatError(f"{name} is not a certificate: {type(error).__name__}: {error}.") from error


def _read_system(plant: Mapping[str, Any], sample: Any, people: Mapping[str, Mapping[str, str]]) -> System:
    states, inputs = (tuple(Symbol(s) for s in plant[k]) for k in ("states", "inputs"))
    ranges = {q["name"]: (Fraction(q["range"][0]), Fraction(q["range"][1])) for q in plant["uncertain"]}
    names = {s.name: s for s in (*states, *inputs, *map(Symbol, ranges))}
    units, x_eq, nominal = (people[key] for key in _FOR_PEOPLE)
    return System(
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


def _read_network(policy: Mapping[str, Any], networks: Sequence[Mapping[str, Any]], n: int, m: int) -> PolicyNetwork:
    return PolicyNetwork(
        read_network(network_named(networks, policy["network"])),
        scale=decode(policy["scale"], (m,)),
        offset=decode(policy["offset"], (m,)),
        squash=policy["squash"],
        centre=policy["centre"],
        clip=_read_clip(policy["clip"], m),
        origin=decode(policy["origin"], (n,)),
    )


def _read_provenance(data: Any, plant: Mapping[str, Any]) -> tuple[dict[str, str], dict[str, dict[str, str]]]:
    """The provenance as text, and units, operating point and nominal values in it; it is for people, so what is odd is
    passed over.
    """
    found = data if isinstance(data, dict) else {}
    names = {*plant["states"], *plant["inputs"], *(q["name"] for q in plant["uncertain"])}
    read = {}
    for key, is_one in _FOR_PEOPLE.items():
        entry = found.get(key)
        usable = isinstance(entry, dict) and all(k in names and is_one(v) for k, v in entry.items())
        read[key] = entry if usable and isinstance(entry, dict) else {}
    return {k: str(v) for k, v in found.items() if not read.get(k)}, read


def _with_constraints(system: System, claim: Claim | Reaches | Remains | Invariant, names: str) -> System:
    """The plant with the claim's angles, and its constraints by the names that the file has for people, if it has a
    usable one for each."""
    found = re.findall(r"'([A-Za-z_][A-Za-z0-9_]{0,63})'", names)
    usable = len(found) == len(claim.keep) and len(set(found)) == len(found)
    called = found if usable else [f"constraint_{k + 1}" for k in range(len(claim.keep))]
    angles = () if claim.ranks is None else claim.ranks.angles
    return replace(system, angles=angles, constraints=dict(zip(called, claim.keep, strict=True)))


def _with_data(system: System, data: Mapping[str, Any]) -> tuple[System, DataBounds | SampleBounds | None]:
    """The plant with the claim's measurements or samples, and the evidence about them."""
    claim, evidence = data["claim"], data["evidence"]
    if "data" in claim:
        measured = read_measurements(claim["data"], system.n, system.m)
        return replace(system, measurements=measured), read_data_bounds(evidence["data"], measured)
    if "samples" in claim:
        samples, bounds = read_samples(claim["samples"], evidence["samples"])
        # numbers of the claim are deviations, and its pages show them as they are
        return replace(system, samples=samples, x_eq=(Number(0),) * system.n), bounds
    return system, None


def _read_claim(data: Mapping[str, Any], system: System) -> Claim:
    states, n, stated = system.states, system.n, data["claim"]
    claim = CLAIMS[stated["kind"]]
    levels: dict[str, Any] = {k: float.fromhex(v) for k, v in data["levels"].items()}
    levels["rate"] = float.fromhex(stated["rate"])
    if "ranks" in stated:
        levels["ranks"] = _read_ranks(stated["ranks"])
    levels["keep"] = _read_keep(stated, system)
    if stated["outer"] is not None:  # never with a tube
        return claim(**levels, outer=_read_outer(stated["outer"], data["networks"], states))
    own, tube = {f.name for f in fields(claim)}, dict[str, Any]()
    if "start" in own:
        tube["start"] = Quadratic(decode(stated["start"], (n, n)))
    if "centre" in own:
        tube["centre"] = tuple(decode(stated["centre"], (n,)).tolist())
    return claim(**levels, **tube)


def _read_reaches(stated: Mapping[str, Any], system: System) -> Reaches:
    named = {s.name: s for s in system.states}
    target = tuple(from_tree(t, named) for t in stated["target"])
    return Reaches(target, _read_ranks(stated["ranks"]), _read_keep(stated, system))


def _read_ranks(stated: Mapping[str, Any]) -> Ranks:
    return Ranks(tuple(map(str, stated["angles"])), int(stated["steps"]))


def _read_keep(stated: Mapping[str, Any], system: System) -> tuple[Expression, ...]:
    named = {s.name: s for s in (*system.states, *system.inputs, *(s for s, _ in system.uncertain))}
    return tuple(from_tree(g, named) for g in stated.get("keep", ()))


def _read_outer(data: Mapping[str, Any], networks: Sequence[Mapping[str, Any]], states: tuple[Symbol, ...]) -> Outer:
    level, tree = float.fromhex(data["level"]), data["expression"]
    if tree[:1] == ["network"] and tree[2:] == [0, *(s.name for s in states)]:
        network = read_network(network_named(networks, tree[1]))
        if not network.is_chain or network.functions not in ((), ("tanh",)):
            raise CertificateFormatError(
                f"the network {tree[1]} must be of affine steps with tanh between them, each of the vector just "
                "before; found others, which the checkers read but this command does not yet."
            )
        layers = network.affine
        return Outer(Neural(tuple(step.weight for step in layers), tuple(step.bias for step in layers)), level)
    return Outer(Symbolic(from_tree(tree, {s.name: s for s in states}), states), level)


def _nominal(interval: Interval, said: str | None) -> Fraction:
    """A value of an uncertain quantity: what the file says for people, if it lies in the range, which nothing that is
    claimed depends on; else 0 if it may be 0, else the middle.
    """
    lo, hi = interval
    if said is not None and lo <= Fraction(said) <= hi:
        return Fraction(said)
    return Fraction(0) if lo <= 0 <= hi else (lo + hi) / 2


def _read_clip(data: Any, m: int) -> tuple[Array, Array] | None:
    if data is None:
        return None
    lo, hi = data
    return decode(lo, (m,)), decode(hi, (m,))


def _is_value(value: Any) -> bool:
    return isinstance(value, str) and re.fullmatch(r"-?[0-9]{1,200}(/[1-9][0-9]{0,199})?", value) is not None


def _is_unit(value: Any) -> bool:
    return isinstance(value, str) and len(value) <= _LONGEST_UNIT and value.isprintable()


_FOR_PEOPLE = {"units": _is_unit, "x_eq": _is_value, "nominal": _is_value}
"""Entries of the provenance that say something about what the plant names, and what each of their values must be."""
