"""The reference's verdicts in a word, on documents that were built in Python."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

from certify.reference import rules

BEFORE, NOW = "certify-certificate/5", "certify-certificate/6"
CONTINUOUS = {"rate": (0.0).hex(), "sample": None}  # of a claim


def judge_bytes(raw: bytes) -> str | None:
    """None if a file is accepted, the name of the first rule that fails, or `TRUSTED`."""
    verdict = rules.judge(raw)
    return None if verdict.result == "ACCEPTED" else verdict.rule or verdict.result


def judge(data: dict[str, Any]) -> str | None:
    return judge_bytes(json.dumps(upgraded(data)).encode())


def upgraded(data: dict[str, Any]) -> dict[str, Any]:
    """A document of version 5 as one of version 6 that says the same; any other is left alone.

    What a forgery has taken out or put in stays so: each key is added where it is not there.
    """
    if not isinstance(data, dict) or data.get("schema") != BEFORE:
        return data
    data = copy.deepcopy(data)
    data["schema"] = NOW
    claim, plant, levels, evidence = (data.get(key) for key in ("claim", "plant", "levels", "evidence"))
    if isinstance(claim, dict):
        for key, value in CONTINUOUS.items():
            claim.setdefault(key, value)
    if isinstance(plant, dict):
        plant.setdefault("time", "continuous")
    if isinstance(levels, dict) and isinstance(claim, dict) and claim.get("kind") == "practical" and "floor" in levels:
        levels.setdefault("local", levels["floor"])
    if isinstance(evidence, dict) and evidence.get("kind") == "partition-tree":
        evidence.setdefault("order", 1)
        if isinstance(ball := evidence.get("local"), dict):
            ball.setdefault("edge", (0.0).hex())
            ball.setdefault("order", 1)
    return data


def dump(data: dict[str, Any]) -> bytes:
    return json.dumps(upgraded(data)).encode("ascii")


def write(data: dict[str, Any] | bytes, folder: Path) -> Path:
    path = folder / "certificate.json"
    path.write_bytes(data if isinstance(data, bytes) else dump(data))
    return path
