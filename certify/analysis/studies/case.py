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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from certify.analysis.arguments import changes_of, options_of
from certify.analysis.changes import PlantChanges
from certify.analysis.declaration import declared
from certify.analysis.inputs import Tell, plant_of
from certify.analysis.installation import source_sha256, version_of
from certify.analysis.options import RoaOptions
from certify.loop.plants import shipped as plants
from certify.loop.policies import Policy, load_policy

if TYPE_CHECKING:
    from certify.loop.plants import System

_LONGEST = 100  # characters of a name, beyond which a hash ends it
_ODD = re.compile(r"[^A-Za-z0-9_.,=+-]+")


OPTIONS = {option.key: name for name, option in declared(RoaOptions).items() if option.varies}
"""The fields of `RoaOptions` that a study may vary, by its keys, besides the candidates."""
TABLES, PLANT_OPTIONS = (
    tuple(name for name, option in declared(PlantChanges).items() if (option.kind == "ranges") is table)
    for table in (True, False)
)
"""The fields of `PlantChanges`: tables of a study, and those among its options."""


@dataclass(frozen=True, slots=True)
class File:
    """A file that goes with a case."""

    name: str
    content: bytes = field(repr=False)

    @property
    def sha256(self) -> str:
        """The hash of its bytes."""
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
        plant = plant_of(stored, named, self._changes(), tell)
        given = {field: self.coordinates.get(f"options.{key}") for key, field in OPTIONS.items()}
        given["candidate"] = self.coordinates.get("candidates")
        given["lyapunov"] = None if self.lyapunov is None else str(self.lyapunov.put(folder))
        texts = {field: text for field, text in given.items() if text is not None}
        return stored, plant, options_of(texts, plant, tell)

    def _changes(self) -> PlantChanges:
        single = {name: self.coordinates.get(f"options.{name}") for name in PLANT_OPTIONS}
        texts: dict[str, Any] = {name: text for name, text in single.items() if text is not None}
        return changes_of(texts | {table: self._pairs(table) for table in TABLES})

    def _pairs(self, table: str) -> list[str]:
        """The entries of a table as on the command line, NAME=VALUE."""
        own = {key.partition(".")[2]: text for key, text in self.coordinates.items() if key.startswith(f"{table}.")}
        return [f"{name}={text}" for name, text in own.items()]


def readable_ids(coordinates: Sequence[Mapping[str, str]], listed: Sequence[str]) -> list[str]:
    """A folder's name for each case: policy, plant, what is varied with its values, and the candidate.

    A name does not depend on the other values, unless policies of two folders are called alike. Characters that a
    folder's name cannot have are replaced, and a hash then tells names apart.
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
    """The parts of this program that decide a case: its version, the checker's source, and the plants that ship."""
    digest = hashlib.sha256()
    for path in sorted(Path(plants.__path__[0]).glob("*.py")):
        digest.update(path.name.encode() + b"\0" + hashlib.sha256(path.read_bytes()).digest())
    return {"certify": version_of("certify"), "checker": source_sha256("checker"), "plants": digest.hexdigest()}
