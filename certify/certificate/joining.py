"""One answer about a certificate from the checker's answers about its parts.

Parts are examined by whoever has a core to spare; what is put together here has to be all of them, about these bytes.
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from certify.certificate.model import Certificate, PartitionTree, parse_certificate
from certify.certificate.tree import LEAF
from certify.errors import BackendError

_OF_A_PART = ("part", "by_leaf", "examined", "leaves_in_all")


def join_parts(raw: bytes, parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The answer that the checker would have given about a file, from its answers about all of N parts of it.

    Whoever made the answers is trusted as much as the checker itself; what is not trusted is how they came here.

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
    BackendError : these are not the answers of the parts 1 to N, each once, that refuse nothing, are about these bytes
        and what they state, agree about all that is no leaf, and have looked at every leaf of the file.
    """
    certificate = parse_certificate(raw, "the file whose parts were checked")
    try:
        return _joined(_stated(certificate, raw), [dict(part) for part in parts])
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise BackendError(
            f"the answers of {len(parts)} parts cannot be read: {type(error).__name__}: {error}."
        ) from error


def _stated(certificate: Certificate, raw: bytes) -> dict[str, Any]:
    """What each part has to say of the file."""
    evidence, claim, sample = certificate.evidence, certificate.claim, certificate.system.sample
    if not isinstance(evidence, PartitionTree):
        raise BackendError("a certificate in parts must have leaves; this one is a solver's word. Check it as a whole.")
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
        "levels": levels,
        "leaves": leaves,
        "leaves_in_all": ring + sum(tree.count(LEAF) for tree in outer),
    }


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
    stated |= {key: first.get(key) for key in ("start", "centre", "time")}
    stated["elsewhere"] = _elsewhere(first)
    stated["level of the outer set"] = first["outer"]["level"] if "outer" in first else None
    for answer in parts:
        said = answer | {"elsewhere": _elsewhere(answer)}
        said["level of the outer set"] = answer["outer"]["level"] if "outer" in answer else None
        for key, value in stated.items():
            if _text(said.get(key)) != _text(value):
                raise BackendError(f"`{key}` of each part must be {value}; part {answer['part']} says {said.get(key)}.")
    examined = sum(_count(answer["examined"]) for answer in parts)
    if examined != stated["leaves_in_all"] or stated["elsewhere"].get("tree") != stated["leaves"]:
        raise BackendError(f"all {stated['leaves_in_all']} leaves must be examined; the parts have done {examined}.")
    rules = Counter(stated["elsewhere"])
    for answer in parts:
        rules.update(answer["by_leaf"])
    margins = {
        name: min((float(own) for answer in parts if (own := answer["margins"][name]) is not None), default=None)
        for name in ("local", "ring", "outer")
    }
    seconds = {name: sum(answer["seconds"][name] for answer in parts) for name in ("start", "check")}
    joined = {key: value for key, value in first.items() if key not in _OF_A_PART}
    joined |= {"result": "ACCEPTED", "rules": dict(rules), "ring_leaves": rules["ring"], "margins": margins}
    joined |= {"seconds": seconds, "parts": len(parts)}
    if "outer" in first:
        joined["outer"] = first["outer"] | {"face_leaves": rules["faces"]}
    return joined | {"text": [f"ACCEPTED by {len(parts)} parts together sha256={stated['certificate_sha256']}"]}


def _elsewhere(answer: Mapping[str, Any]) -> dict[str, int]:
    """What the rules have looked at that is no leaf."""
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
