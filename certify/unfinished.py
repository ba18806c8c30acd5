"""Searches that can be gone on with: a file beside the certificate, with the candidate and the tree as far as it is.

Nothing here is trusted. What a search that was gone on with proves, the checker sees leaf by leaf like any other.
"""

from __future__ import annotations

import base64
import hashlib
import json
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from certify.certificate import decode, encode, loop_sections, write_atomically
from certify.claims import Problem
from certify.closed_loop import ClosedLoop
from certify.engines.base import SearchState, Task
from certify.engines.falsify import Witness
from certify.errors import InputError
from certify.lyapunov.function import Quadratic
from certify.policies import TanhNetwork
from certify.systems import System
from certify.trials import Trial

_FORMAT = "certify-search/1"
_MOST = 2**30  # bytes of a tree, or of its keys
_LIMITS = ("domain", "sampled")


@dataclass(frozen=True, slots=True)
class Unfinished:
    """A candidate, with a search for the largest level that has not come to its end."""

    trial: Trial
    state: SearchState


def identity(system: System, network: TanhNetwork, rate: float) -> str:
    """A hash of the loop and the rate, which a search is about."""
    said = json.dumps([loop_sections(system, network), float(rate).hex()], sort_keys=True)
    return hashlib.sha256(said.encode()).hexdigest()


def save(path: Path, unfinished: Unfinished) -> None:
    """Write the search to a file, in one step.

    Raises
    ------
    InputError : the file cannot be written.
    """
    trial, state, problem = unfinished.trial, unfinished.state, unfinished.trial.task.problem
    data = {
        "format": _FORMAT,
        "about": identity(problem.loop.system, problem.loop.network, problem.rate),
        "candidate": trial.name,
        "P": encode(trial.P),
        "T": encode(trial.T),
        "target": trial.task.target.hex(),
        "exactly": trial.task.exactly,
        "limit": float(trial.limit).hex(),
        "limited_by": trial.limited_by,
        "volume": float(trial.volume).hex(),
        "witness": _stated(trial.task.witness),
        "inner": state.inner.hex(),
        "outer": state.outer.hex(),
        "boxes": state.boxes,
        "proved": state.proved,
        "met": _stated(state.witness),
        "tree": _packed(state.tree),
        "keys": _packed(state.keys.astype("<f8").tobytes()),
    }
    write_atomically(path, (json.dumps(data) + "\n").encode())


def load(path: Path, loop: ClosedLoop, rate: float) -> Unfinished:
    """The search in a file, which must be one of this loop and rate.

    Raises
    ------
    InputError : it is not there, is about another loop or rate, or is damaged.
    """
    try:
        data = json.loads(path.read_bytes())
    except FileNotFoundError as error:
        raise InputError(f"there is no search to go on with in {path.parent}; run without --resume.") from error
    except (OSError, ValueError) as error:
        raise InputError(f"the search in {path} cannot be read: {error}. Run without --resume.") from error
    try:
        if data["format"] != _FORMAT:
            raise InputError(f"{path} must be of the format {_FORMAT}; found {data['format']!r:.40}.")
        if data["about"] != identity(loop.system, loop.network, rate):
            raise InputError(
                f"the search in {path} is about another policy, plant, domain or rate; run without --resume, or into "
                "another folder."
            )
        return _read(data, loop, rate)
    except InputError:
        raise
    except (KeyError, TypeError, ValueError, OverflowError, zlib.error) as error:
        raise InputError(f"the search in {path} is damaged ({error!r:.80}); run without --resume.") from error


def _read(data: Mapping[str, Any], loop: ClosedLoop, rate: float) -> Unfinished:
    n = loop.system.n
    P, T = decode(data["P"], (n, n)), decode(data["T"], (n, n))
    target, limit, volume = (float.fromhex(data[name]) for name in ("target", "limit", "volume"))
    inner, outer = (float.fromhex(data[name]) for name in ("inner", "outer"))
    if not 0 < inner <= outer <= target or not np.all(np.isfinite(T)) or data["limited_by"] not in _LIMITS:
        raise ValueError("its numbers do not fit together")
    task = Task(
        Problem(loop, Quadratic(P), rate),
        "asymptotic",
        target,
        bool(data["exactly"]),
        _read_witness(data["witness"], n),
    )
    trial = Trial(str(data["candidate"]), task, T, limit, data["limited_by"], volume)
    keys = np.frombuffer(_unpacked(data["keys"]), dtype="<f8").astype(np.float64)
    counts = int(data["boxes"]), int(data["proved"])
    met = _read_witness(data["met"], n)
    return Unfinished(trial, SearchState(inner, outer, *counts, met, _unpacked(data["tree"]), keys))


def _stated(witness: Witness | None) -> dict[str, Any] | None:
    if witness is None:
        return None
    values = {name: str(q) for name, q in witness.values.items()}
    period = None if witness.period is None else str(witness.period)
    level = float(witness.level).hex()
    return {"x": encode(witness.x), "level": level, "kind": witness.kind, "values": values, "period": period}


def _read_witness(data: Mapping[str, Any] | None, n: int) -> Witness | None:
    if data is None:
        return None
    if data["kind"] not in ("vdot", "input"):
        raise ValueError("a violation of no kind")
    values = {str(name): Fraction(q) for name, q in data["values"].items()}
    period = None if data["period"] is None else Fraction(data["period"])
    return Witness(decode(data["x"], (n,)), float.fromhex(data["level"]), data["kind"], values, period)


def _packed(data: bytes) -> str:
    return base64.b64encode(zlib.compress(data, 1)).decode()


def _unpacked(text: str) -> bytes:
    reader = zlib.decompressobj()
    data = reader.decompress(base64.b64decode(text, validate=True), _MOST)
    if reader.unconsumed_tail:
        raise ValueError("it is too large")
    return data
