"""A case of a study: all that its run depends on, as it travels to whoever does it, and its identity.

A worker may have neither the study's folder nor any disk in common with whoever asked, so that files go with the case
as bytes. Two cases are the same if their files' bytes, their texts and the program are: what files are called, and
where they lie, is not part of it.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from certify.analysis.arguments import layers, numbers, plant_of, widths
from certify.analysis.inputs import Tell, ellipsoid_beside, function_in
from certify.analysis.installation import source_sha256, version_of
from certify.analysis.options import RoaOptions
from certify.errors import InputError
from certify.loop.plants import exact
from certify.loop.plants import shipped as plants
from certify.loop.policies import Policy, load_policy

if TYPE_CHECKING:
    from certify.loop.plants import System

_LONGEST = 100  # characters of a name, beyond which a hash ends it
_ODD = re.compile(r"[^A-Za-z0-9_.,=+-]+")


@dataclass(frozen=True, slots=True)
class Option:
    """An option of a run as text: the field of `RoaOptions` that it fills, and how it is read."""

    field: str
    reader: Callable[[str, str], Any]

    def read(self, text: str) -> dict[str, Any]:
        """The field with its value.

        Raises
        ------
        InputError : the text is not what the option takes.
        """
        return {self.field: self.reader(text, self.field)}


def _word(text: str, _: str) -> str:
    return text


def _number(text: str, name: str) -> float:
    return float(exact(text, name))


def _whole(text: str, name: str) -> int:
    value = exact(text, name)
    if value.denominator != 1:
        raise InputError(f"`{name}` must be a whole number; found {text}.")
    return int(value)


def _flag(text: str, name: str) -> bool:
    if text not in ("true", "false"):
        raise InputError(f"`{name}` must be true or false; found {text!r}.")
    return text == "true"


OPTIONS: Mapping[str, Option] = {
    "claim": Option("claim", _word),
    "around": Option("around", _word),
    "Q": Option("Q", numbers),
    "R": Option("R", numbers),
    "rate": Option("rate", _number),
    "level": Option("level", _number),
    "engine": Option("engine", _word),
    "precision": Option("dreal_precision", _number),
    "enlarge": Option("enlarge", _flag),
    "box": Option("box", widths),
    "lyapunov_level": Option("lyapunov_level", _number),
    "hidden": Option("hidden", layers),
    "degree": Option("degree", _whole),
    "seed": Option("seed", _whole),
    "time_limit": Option("time_limit", _number),
    "max_boxes": Option("max_boxes", _whole),
}
"""The options of `certify roa` that a study may give, by its names, besides those of the plant and a file."""
PLANT_OPTIONS = ("sample_time", "input_error")


@dataclass(frozen=True, slots=True)
class File:
    """A file that goes with a case."""

    name: str
    content: bytes = field(repr=False)

    @property
    def sha256(self) -> str:
        """Of its bytes."""
        return hashlib.sha256(self.content).hexdigest()

    def put(self, folder: Path) -> Path:
        """Write it into `folder`; its path."""
        path = folder / Path(self.name).name
        path.write_bytes(self.content)
        return path


@dataclass(frozen=True, slots=True)
class Case:
    """One run of a study.

    Parameters
    ----------
    name : of its folder, the same whatever other cases there are.
    coordinates : the text of each entry of the study, by its key, such as `parameters.m`.
    policy, plant, lyapunov : what goes with it; a plant by its name where it ships, None for the policy's own.
    """

    name: str
    coordinates: Mapping[str, str]
    policy: File
    plant: File | str | None
    lyapunov: File | None

    @property
    def inputs(self) -> str:
        """A hash of all that the run depends on: equal ones need not be done twice."""
        labels = ("policies", "systems", "options.lyapunov")
        found = {
            "policy": self.policy.sha256,
            "plant": self.plant.sha256 if isinstance(self.plant, File) else self.plant,
            "lyapunov": None if self.lyapunov is None else self.lyapunov.sha256,
            "texts": {key: text for key, text in self.coordinates.items() if key not in labels},
            "program": _program(),
        }
        return hashlib.sha256(json.dumps(found, sort_keys=True).encode()).hexdigest()

    def loop(self, folder: Path, tell: Tell) -> tuple[Policy, System, RoaOptions]:
        """Policy, plant and options as `certify roa` has them, with the case's files put into `folder`.

        Raises
        ------
        InputError : a file cannot be read, or the plant cannot have what is asked for.
        """
        stored = load_policy(self.policy.put(folder))
        named = str(self.plant.put(folder)) if isinstance(self.plant, File) else self.plant
        plant = plant_of(
            stored,
            named,
            self._pairs("parameters"),
            self._pairs("domain"),
            self._pairs("disturbances"),
            self.coordinates.get("options.input_error"),
            self.coordinates.get("options.sample_time"),
            tell,
        )
        chosen: dict[str, Any] = {"candidate": self.coordinates.get("candidates", "auto")}
        for name, option in OPTIONS.items():
            if (text := self.coordinates.get(f"options.{name}")) is not None:
                chosen |= option.read(text)
        if self.lyapunov is not None:
            beyond = function_in(self.lyapunov.put(folder), plant, tell)
            chosen["lyapunov"] = beyond.function
            if chosen["candidate"] == "auto" and not {"Q", "R", "level"} & set(chosen):
                chosen["P"] = ellipsoid_beside(beyond, plant)
        return stored, plant, RoaOptions(**chosen)

    def _pairs(self, table: str) -> list[str]:
        """The entries of a table as on the command line, NAME=VALUE."""
        own = {key.partition(".")[2]: text for key, text in self.coordinates.items() if key.startswith(f"{table}.")}
        return [f"{name}={text}" for name, text in own.items()]


def readable_ids(coordinates: Sequence[Mapping[str, str]], listed: Sequence[str]) -> list[str]:
    """A folder's name for each case: policy, plant, what is varied with its values, and the candidate.

    A name does not depend on which other values there are, unless policies of two folders are called alike. What a
    folder cannot be called is replaced, and a hash then tells names apart.
    """
    stems = Counter(Path(policy).stem for policy in {where["policies"] for where in coordinates})
    parts = [_parts(where, listed, stems) for where in coordinates]
    names = [_ODD.sub("-", "_".join(part)) for part in parts]
    count = Counter(names)
    return [
        name
        if count[name] == 1 and len(name) <= _LONGEST and all(_ODD.search(text) is None for text in part[1:])
        else f"{name[:_LONGEST]}-{hashlib.sha256(json.dumps(part).encode()).hexdigest()[:8]}"
        for name, part in zip(names, parts, strict=True)
    ]


def _parts(where: Mapping[str, str], listed: Sequence[str], stems: Mapping[str, int]) -> list[str]:
    stem = Path(where["policies"]).stem
    found = [stem if stems[stem] == 1 else where["policies"]]
    for key in listed:
        _, _, name = key.partition(".")
        if key == "systems":
            found.append(Path(where[key]).stem)
        elif name:
            found.append(f"{name}={where[key]}")
    return found + [where[key] for key in listed if key == "candidates"]


@cache
def _program() -> dict[str, str | None]:
    """What of this program decides on a case: its version, the checker's source, and the plants that ship."""
    digest = hashlib.sha256()
    for path in sorted(Path(plants.__path__[0]).glob("*.py")):
        digest.update(path.name.encode() + b"\0" + hashlib.sha256(path.read_bytes()).digest())
    return {"certify": version_of("certify"), "checker": source_sha256("checker"), "plants": digest.hexdigest()}
