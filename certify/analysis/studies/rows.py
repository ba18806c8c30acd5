"""A row: a case that is done, in a table, and its file."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from certify.analysis.facts import Levels
from certify.analysis.studies.case import Case
from certify.certificates import (
    set_aside,
    write_atomically,
)
from certify.certificates.verdict import Verdict
from certify.errors import InputError

if TYPE_CHECKING:
    pass

Array = NDArray[np.float64]
SCHEMA = "certify-sweep-row/2"
ERROR = "error"  # instead of a stop, where a case could not be run
ANSWERS = {Verdict.PROVED: "ACCEPTED", Verdict.TRUSTED: "TRUSTED"}
FILE = "row.json"


@dataclass(frozen=True, slots=True)
class Row:
    """The outcome of a case.

    Parameters
    ----------
    case, coordinates : its name, and the text of each entry of the study.
    inputs : the hash of all that it depends on.
    verdict : UNKNOWN too if the case could not be run: `error` says why.
    claim, stop, reason, candidate, notice : as a run of `certify roa` says them.
    levels, volume, volume_unit, semi_axes, extents : of the set that the certificate states, None without one;
        volume, in the product of the states' units, and lengths are certain lower bounds.
    states : their names; none where the case could not be run.
    units : of states, parameters and disturbances, by name.
    witness : the violation at which the sampled limit lies: its state, kind and values; None without one.
    boxes, leaves, seconds : the work.
    certificate, certificate_sha256, checked : the file, relative to the sweep's folder, its hash, and what the checker
        of this machine said of it.
    """

    case: str
    coordinates: Mapping[str, str]
    inputs: str
    verdict: Verdict
    stop: str
    reason: str = ""
    claim: str | None = None
    candidate: str | None = None
    levels: Levels = field(default_factory=Levels)
    volume: float | None = None
    volume_unit: str = ""
    semi_axes: tuple[float, ...] = ()
    extents: tuple[float, ...] = ()
    states: tuple[str, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)
    witness: Mapping[str, Any] | None = None
    boxes: int = 0
    leaves: int = 0
    seconds: float | None = None
    certificate: str | None = None
    certificate_sha256: str | None = None
    checked: str | None = None
    notice: str = ""
    error: str = ""

    def __post_init__(self) -> None:
        backed = ANSWERS.get(self.verdict)
        if backed is not None and (self.checked != backed or None in (self.certificate, self.volume, self.levels.roa)):
            raise InputError(
                f"a row that says {self.verdict.value} must have a certificate that the checker answered with "
                f"{backed}, and the set that it states; found {self.checked}."
            )
        if (self.stop == ERROR) != bool(self.error) or (self.error and self.verdict is not Verdict.UNKNOWN):
            raise InputError("a row has an error where its stop says so and nothing is known, and nowhere else.")

    @property
    def failed(self) -> bool:
        """True if the case could not be run."""
        return bool(self.error)

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        stated = asdict(self)
        return {"schema": SCHEMA, **stated, "verdict": self.verdict.value}

    def write(self, out: Path) -> None:
        """Put it into the case's folder, in one step: from then on the case is done."""
        folder = folder_of(out, self.case)
        for left in (
            *folder.glob("certificate.*.unchecked.json"),
            *folder.glob("row.*.partial"),
        ):  # left by a run that was killed
            left.unlink(missing_ok=True)
        if self.certificate is None:
            set_aside(folder)  # of an attempt that was refused
        write_atomically(folder / FILE, (json.dumps(self.to_dict(), indent=1) + "\n").encode())


def failed(case: Case, error: str) -> Row:
    """The row of a case that could not be run."""
    return Row(case.name, case.coordinates, case.inputs, Verdict.UNKNOWN, ERROR, error=error)


def folder_of(out: Path, name: str) -> Path:
    folder = out / "cases" / name
    folder.mkdir(parents=True, exist_ok=True)
    return folder
