"""The tables of a history: the one that is written, and the one of evaluations that is read."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import astuple, fields
from pathlib import Path

from certify.errors import InputError
from controllers.history.gain_distance import Distances
from controllers.history.proofs import Proof
from controllers.storage import read


def read_settled(path: Path) -> list[tuple[int, float]]:
    """Steps, and the share of initial states that settle then, as `controllers train --evaluations` wrote them.

    Raises
    ------
    InputError : the file cannot be read, or is no such table.
    """
    try:
        rows = list(csv.DictReader(io.StringIO(read(path).decode())))
        return [(int(row["step"]), float(row["settled"])) for row in rows]
    except (KeyError, TypeError, ValueError, csv.Error) as error:
        raise InputError(f"{path} must be a table that `controllers train --evaluations` wrote: {error!r}.") from error


def table(found: Sequence[Distances], proofs: Sequence[Proof]) -> bytes:
    """Distances and, of the same steps, proofs as CSV; without proofs the distances alone."""
    names = [column.name for column in fields(Distances)]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*names, "verdict", "claim", "level", "volume", "reason"] if proofs else names)
    of = {proof.step: proof for proof in proofs}
    for each in found:
        proof = of.get(each.step)
        said = [] if proof is None else [proof.verdict.value, proof.claim, proof.level, proof.volume, proof.reason]
        writer.writerow([*astuple(each), *said])
    return text.getvalue().encode()
