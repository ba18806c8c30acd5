"""Searches that can be resumed: a file beside the certificate, with the candidate and the tree as far as it is.

A run that is stopped early has no candidate yet, or no tree, or has not decided among candidates. The file says so, and
the run that resumes it does the rest. Nothing here is trusted. The checker sees the proof of a resumed search leaf by
leaf like any other. A hash tells a damaged file. Numbers and violations are looked at all the same: somebody else may
have written the file."""

from __future__ import annotations

import base64
import hashlib
import json
import math
import re
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, get_args

import numpy as np

from certify.analysis.candidates.trials import Trial
from certify.analysis.selection import Contender, Race
from certify.certificates import SEARCH, decode, encode, loop_sections, remove, write_atomically
from certify.certificates.claims import Problem
from certify.errors import InputError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.plants import System, kept_constraints
from certify.loop.policies import PolicyNetwork
from certify.lyapunov import is_positive_definite, leaves_domain
from certify.lyapunov.function import Quadratic
from certify.provers.base import SearchState, Task
from certify.provers.boxes.partition import MOST_SPLITS
from certify.provers.falsify import Kind, Witness, confirm

FORMAT = "certify-search/2"
_LARGEST = 2**30  # bytes of a file
_MOST = 2 * MOST_SPLITS + 1  # bytes of a tree
_RATIONAL = re.compile(r"-?\d{1,1000}(/[1-9]\d{0,999})?")
_NAME = 80  # characters of a candidate's
_SAME = 1e-9  # relative, of a level
_LIMITS = ("domain", "sampled")


@dataclass(frozen=True, slots=True)
class Unfinished:
    """A candidate, with a search for the largest level that has not come to its end.

    Parameters
    ----------
    trial : the candidate.
    state : its search; one without a tree has not bounded any box yet.
    decided : True if this candidate was chosen for the rest of the effort; if not, others may be better.
    """

    trial: Trial
    state: SearchState
    decided: bool = True

    @classmethod
    def of(cls, trial: Trial, state: SearchState | None, decided: bool) -> Unfinished:
        """With the state of an attempt, which may have none."""
        target = trial.task.target
        return cls(trial, state or SearchState(target, target, 0, 0, None, b"", np.zeros(0)), decided)


class Keeper:
    """Keeps the search of a run that is stopped before its end.

    Parameters
    ----------
    out : folder of the run.
    can_keep : False where the options leave nothing to resume.
    names_candidate : the run was told its candidate, so that a file without one could not say which.
    """

    def __init__(self, out: Path, can_keep: bool, names_candidate: bool) -> None:
        self.path, self.can_keep, self.names_candidate = out / SEARCH, can_keep, names_candidate
        self.about: tuple[ClosedLoop, float] | None = None
        self.race: Race | None = None
        self.winner: Contender | None = None
        self.interruptible = False

    def begin(self, loop: ClosedLoop, rate: float, race: Race, interruptible: bool) -> None:
        """Keep from now on the searches of this race."""
        self.about, self.race, self.interruptible = (loop, rate), race, interruptible

    @property
    def first(self) -> Contender | None:
        """The contender whose search is worth most; None if there is none."""
        if self.winner is not None or self.race is None:
            return self.winner
        begun = [*self.race.contenders, *([] if self.race.early is None else [self.race.early])]
        return max(begun, key=lambda c: c.proved, default=None)

    @property
    def gains(self) -> bool:
        """True if more effort may gain something that a kept search saves."""
        one = self.first
        return self.interruptible and one is not None and not (one.attempt.done or one.hopeless)

    def keep(self) -> None:
        """Write the search that `--resume` continues."""
        if self.about is None or not self.can_keep:
            return
        (loop, rate), one = self.about, self.first
        if one is not None and self.interruptible:
            save(self.path, Unfinished.of(one.trial, one.attempt.state(), one is self.winner))
        elif not self.names_candidate:
            save_nothing_yet(self.path, loop.system, loop.network, rate)

    def drop(self) -> None:
        """Remove the search, which has come to its end."""
        remove(self.path)


class NothingYetError(InputError):
    """The run that left this file was stopped before it had a candidate."""


def identity(system: System, network: PolicyNetwork, rate: float) -> str:
    """A hash of the loop, its periods, the rate and the constraints, which a search is about."""
    sample = None if system.sample is None else [str(h) for h in system.sample]
    about = [loop_sections(system, network), sample, float(rate).hex()]
    kept = {name: str(g) for name, g in kept_constraints(system).items()}
    said = json.dumps([*about, kept] if kept else about, sort_keys=True)
    return hashlib.sha256(said.encode()).hexdigest()


def save(path: Path, unfinished: Unfinished) -> None:
    """Write the search to a file, in one step.

    Raises
    ------
    InputError : the file cannot be written.
    """
    trial, state, problem = unfinished.trial, unfinished.state, unfinished.trial.task.problem
    data = {
        "format": FORMAT,
        "about": identity(problem.loop.system, problem.loop.network, problem.rate),
        "decided": unfinished.decided,
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
    _write(path, data)


def save_nothing_yet(path: Path, system: System, network: PolicyNetwork, rate: float) -> None:
    """Write down that a run about this loop and rate was stopped before it had a candidate.

    Raises
    ------
    InputError : the file cannot be written.
    """
    _write(path, {"format": FORMAT, "about": identity(system, network, rate), "candidate": None})


def _write(path: Path, data: Mapping[str, Any]) -> None:
    write_atomically(path, (json.dumps({**data, "sha256": _digest(data)}) + "\n").encode())


def load(path: Path, loop: ClosedLoop, rate: float) -> Unfinished:
    """The search in a file, which must be one of this loop and rate.

    Raises
    ------
    NothingYetError : the run that left it had no candidate yet.
    InputError : it is not there, is about another loop or rate, or is damaged.
    """
    try:
        if path.stat().st_size > _LARGEST:
            raise ValueError(f"it is larger than {_LARGEST} bytes")
        data = json.loads(path.read_bytes())
    except FileNotFoundError as error:
        raise InputError(f"there is no search to resume in {path.parent}; run without --resume.") from error
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"the search in {path} cannot be read: {error}. Run without --resume.") from error
    try:
        if data["format"] != FORMAT:
            raise _Unfit(f"{path} must be of the format {FORMAT}; found {data['format']!r:.40}. Run without --resume.")
        if data.pop("sha256") != _digest(data):
            raise ValueError("it has another hash than when it was written")
        if data["about"] != identity(loop.system, loop.network, rate):
            raise _Unfit(
                f"the search in {path} is about another policy, plant, domain, period or rate; run without --resume, "
                "or into another folder."
            )
        if data["candidate"] is None:
            raise NothingYetError(f"the run that left {path} was stopped before it had a candidate.")
        return _read(data, loop, rate)
    except _Unfit as error:
        raise InputError(str(error)) from error
    except NothingYetError:
        raise
    except (KeyError, TypeError, AttributeError, ValueError, ArithmeticError, RecursionError, zlib.error) as error:
        raise InputError(f"the search in {path} is damaged ({error!r:.200}); run without --resume.") from error


class _Unfit(Exception):
    """A file that is in order, but does not fit this run."""


def _read(data: Mapping[str, Any], loop: ClosedLoop, rate: float) -> Unfinished:
    n = loop.system.n
    P, T = decode(data["P"], (n, n)), decode(data["T"], (n, n))
    target, limit, volume = (float.fromhex(data[name]) for name in ("target", "limit", "volume"))
    inner, outer = (float.fromhex(data[name]) for name in ("inner", "outer"))
    problem, name, boxes, proved = Problem(loop, Quadratic(P), rate), data["candidate"], data["boxes"], data["proved"]
    if not (
        0 < inner <= outer <= target <= limit < math.inf
        and 0 <= volume < math.inf
        and data["limited_by"] in _LIMITS
        and type(name) is str
        and name.isprintable()
        and len(name) <= _NAME
        and type(data["exactly"]) is type(data["decided"]) is bool
        and type(boxes) is type(proved) is int
        and 0 <= proved <= boxes < 2**62
        and is_positive_definite(P)
        and not leaves_domain(P, target, loop.system.domain)
        and np.linalg.cond(T) < 1 / np.finfo(np.float64).eps
    ):
        raise ValueError("its numbers do not fit together")
    task = Task(problem, "asymptotic", target, data["exactly"], _read_witness(data["witness"], problem))
    trial = Trial(name, task, T, limit, data["limited_by"], volume)
    tree = _unpacked(data["tree"], _MOST)
    keys = np.frombuffer(_unpacked(data["keys"], 8 * len(tree)), dtype="<f8").astype(np.float64)
    state = SearchState(inner, outer, boxes, proved, _read_witness(data["met"], problem), tree, keys)
    return Unfinished(trial, state, data["decided"])


def _digest(data: Mapping[str, Any]) -> str:
    """A hash of all that is said."""
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()


def _stated(witness: Witness | None) -> dict[str, Any] | None:
    if witness is None:
        return None
    values = {name: str(q) for name, q in witness.values.items()}
    period = None if witness.period is None else str(witness.period)
    level = float(witness.level).hex()
    named = {"constraint": witness.constraint} if witness.constraint else {}
    return {"x": encode(witness.x), "level": level, "kind": witness.kind, "values": values, "period": period, **named}


def _read_witness(data: Mapping[str, Any] | None, problem: Problem) -> Witness | None:
    """A violation, which is shown again."""
    if data is None:
        return None
    system, x = problem.loop.system, decode(data["x"], (problem.V.n,))
    values = {name: _rational(q) for name, q in data["values"].items()}
    period = None if data["period"] is None else _rational(data["period"])
    named = str(data.get("constraint", ""))
    witness = Witness(x, float.fromhex(data["level"]), data["kind"], values, period, named)
    if not (
        witness.kind in get_args(Kind)
        and np.all(np.isfinite(x))
        and all(system.ranges[name][0] <= q <= system.ranges[name][1] for name, q in values.items())
        and (period is None) == (system.sample is None or witness.kind != "vdot")
        and (period is None or system.sample is None or system.sample[0] <= period <= system.sample[1])
        and math.isclose(witness.level, float(problem.V(x)), rel_tol=_SAME)
        and confirm(problem, witness)
    ):
        raise ValueError("a violation that is none")
    return witness


def _rational(text: str) -> Fraction:
    if not _RATIONAL.fullmatch(text):
        raise ValueError("a rational number must be P or P/Q")
    return Fraction(text)


def _packed(data: bytes) -> str:
    return base64.b64encode(zlib.compress(data, 1)).decode()


def _unpacked(text: str, most: int) -> bytes:
    reader = zlib.decompressobj()
    data = reader.decompress(base64.b64decode(text, validate=True), most + 1)
    if not reader.eof or len(data) > most or reader.unused_data:
        raise ValueError("what is packed in it has no end, or is too large")
    return data
