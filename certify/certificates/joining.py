"""One answer about a certificate from the checker's answers about its parts.

The parts must be complete and about these bytes.
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from certify.certificates.claims import Claim
from certify.certificates.evidence import PartitionTree
from certify.certificates.model import Certificate
from certify.certificates.reading import parse_certificate
from certify.certificates.tree import LEAF
from certify.errors import BackendError

_STATED = (  # entries that are equal in the answers of all parts and of the whole
    "certificate_sha256", "policy_sha256", "claim", "rate", "sample", "discrete", "origin", "levels", "leaves",
    "start", "centre", "time",
)  # fmt: skip


def join_parts(raw: bytes, parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The answer that the checker would have given about a file, from its answers about all of N parts of it.

    The programs that made the answers are trusted like the checker itself; their transport is not.

    Parameters
    ----------
    raw : the certificate's bytes.
    parts : answers of `run_part`, in any order.

    Returns
    -------
    dict
        ACCEPTED, with the counts of all parts together, the least margins and the sum of the times; `parts` is N.

    Raises
    ------
    BackendError : these are not the answers of the parts 1 to N, each once, that reject nothing, are about these bytes
    and their statements, agree on the rules without leaves, and have examined every leaf of the file.
    """
    certificate = parse_certificate(raw, "the file whose parts were checked")
    try:
        return _joined(_stated(certificate, raw), [dict(part) for part in parts])
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError, RecursionError) as error:
        raise BackendError(
            f"the answers of {len(parts)} parts cannot be read: {type(error).__name__}: {str(error)[:200]}."
        ) from error


def _stated(certificate: Certificate, raw: bytes) -> dict[str, Any]:
    """The facts about the file that each part must report."""
    evidence, claim, sample = certificate.evidence, certificate.claim, certificate.system.sample
    if not isinstance(evidence, PartitionTree):
        raise BackendError("a certificate in parts must have leaves; this one has a solver's answer. Check it whole.")
    leaves, levels = evidence.tree.count(LEAF), {name: float(level) for name, level in claim.levels.items()}
    ring = leaves if evidence.local is None or levels["local"] != levels["roa"] else 0
    outer = () if evidence.outer is None else (evidence.outer.tree, *evidence.outer.faces)
    return {
        "certificate_sha256": hashlib.sha256(raw).hexdigest(),
        "policy_sha256": certificate.network.sha256(),
        "claim": claim.kind,
        "rate": float(claim.rate),
        "sample": None if sample is None else [str(h) for h in sample],
        "discrete": certificate.system.time == "discrete",
        "origin": certificate.network.origin.tolist() if certificate.network.is_moved else None,
        "levels": levels,
        "leaves": leaves,
        "leaves_in_all": ring + sum(tree.count(LEAF) for tree in outer),
        "faces": 0 if evidence.outer is None else sum(tree.count(LEAF) for tree in evidence.outer.faces),
        "outer": None if claim.outer is None else [claim.outer.level, *(tree.count(LEAF) for tree in outer[:1])],
        **_started(claim),
    }


def _started(claim: Claim) -> dict[str, Any]:
    """The set from which a tube leads, as an answer has it."""
    centre = None if claim.centre is None else list(claim.centre)
    return {"start": None if claim.start is None else claim.start.P.tolist(), "centre": centre}


def _joined(stated: dict[str, Any], parts: list[dict[str, Any]]) -> dict[str, Any]:
    for answer in parts:
        if answer["result"] != "PART":
            refusal = {key: answer[key] for key in ("result", "rule", "at", "detail") if key in answer}
            raise BackendError(f"a part must refuse nothing, but one of them says {refusal}.")
    numbers = [_text(answer["part"]) for answer in parts]
    wanted = [_text([k + 1, len(parts)]) for k in range(len(parts))]
    if not parts or sorted(numbers) != sorted(wanted):
        raise BackendError(f"each part must be there exactly once; of {len(parts)} answers these are {numbers}.")
    first = parts[0]
    faces, total = stated.pop("faces"), stated["leaves_in_all"]
    stated |= {"time": first.get("time"), "elsewhere": _elsewhere(first)}
    for answer in parts:
        said = answer | {"elsewhere": _elsewhere(answer)}
        said["outer"] = [answer["outer"]["level"], answer["outer"]["leaves"]] if "outer" in answer else None
        for key, value in stated.items():
            if _text(said.get(key)) != _text(value):
                raise BackendError(f"`{key}` of each part must be {value}; part {answer['part']} says {said.get(key)}.")
    _require_all(parts, total)
    rules = Counter(stated["elsewhere"])
    for answer in parts:
        rules.update(answer["by_leaf"])
    if stated["elsewhere"].get("tree") != stated["leaves"] or rules["faces"] != faces:
        raise BackendError(f"each rule must have looked at what the file has; the parts say {dict(rules)}.")
    margins = {
        name: min((float(own) for answer in parts if (own := answer["margins"][name]) is not None), default=None)
        for name in ("local", "ring", "outer")
    }
    seconds = {name: sum(answer["seconds"][name] for answer in parts) for name in ("start", "check")}
    joined = {"result": "ACCEPTED"} | {key: stated[key] for key in _STATED if stated[key] is not None or key in first}
    joined |= {"rules": dict(rules), "ring_leaves": rules["ring"], "margins": margins}
    joined |= {"seconds": seconds, "parts": len(parts)}
    if stated["outer"] is not None:
        level, leaves = stated["outer"]
        joined["outer"] = {"level": level, "leaves": leaves, "face_leaves": faces}
    return joined | {"text": [f"ACCEPTED by {len(parts)} parts together sha256={stated['certificate_sha256']}"]}


def _require_all(parts: list[dict[str, Any]], total: int) -> None:
    """Reject the parts unless together they examined every leaf exactly once."""
    spans = sorted([_count(first), _count(beyond)] for answer in parts for first, beyond in answer["spans"])
    reached = 0
    for first, beyond in spans:
        if first != reached or beyond <= first:
            raise BackendError(f"all {total} leaves must be examined, each once; after leaf {reached} comes {first}.")
        reached = beyond
    said = sum(_count(answer["examined"]) for answer in parts)
    if reached != total or said != total:
        raise BackendError(f"all {total} leaves must be examined; the parts have done {min(reached, said)}.")


def _elsewhere(answer: Mapping[str, Any]) -> dict[str, int]:
    """Each rule's count without the leaves."""
    rules, by_leaf = answer["rules"], answer["by_leaf"]
    if not by_leaf.keys() <= rules.keys():
        raise ValueError(f"unknown rules {by_leaf.keys() - rules.keys()}")
    return {name: _count(_count(count) - _count(by_leaf.get(name, 0))) for name, count in rules.items()}


def _count(value: Any) -> int:
    if type(value) is not int or value < 0:
        raise ValueError(f"a count must be an integer of at least 0; found {value!r}")
    return value


def _text(value: Any) -> str:
    """By which JSON values are compared: True is not 1 there, and nan is itself."""
    return json.dumps(value, sort_keys=True)
