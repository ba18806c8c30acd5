"""Samples of an unknown right-hand side, from a file.

Numbers are the decimals of the file, as exact fractions: nothing here is rounded.
"""

from __future__ import annotations

import csv
import hashlib
import io
from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction
from itertools import chain
from pathlib import Path

from certify.errors import InputError
from certify.loop.plants.equations import decimal
from certify.loop.plants.samples import Point, Sampled, Samples, Unknown
from certify.loop.plants.system import Interval, System

_MOST_BITS = 2**7  # of a number, as the checkers read them
_MOST_PARTS, _OF_A_SAMPLE = 900_000, 12  # commas and brackets of a certificate; of a sample, beside its variables
_LENGTH = "some 35 digits at most"


def read_samples(path: Path, unknowns: Sequence[Unknown], suffix: str) -> tuple[dict[str, Sampled], str]:
    """The samples of each unknown, by its state, from a CSV file; and the sha256 of the file.

    A column `NAME_rate` (`suffix`; in discrete time `NAME_next`) has the values of each unknown.

    Raises
    ------
    InputError : the file cannot be read, or a column or a number is missing.
    """
    try:
        raw = path.read_bytes()
        rows = [row for row in csv.reader(io.StringIO(raw.decode("utf-8-sig"), newline=""), strict=True) if row]
    except OSError as error:
        raise InputError(f"samples {path} cannot be read: {error.strerror}.") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"samples {path} must be CSV, which is UTF-8 text: {error}.") from error
    most = _MOST_PARTS // sum(len(one.variables) + _OF_A_SAMPLE for one in unknowns)
    if not 2 <= len(rows) <= most + 1:
        raise InputError(f"samples {path} must have a header and 1 to {most:,} rows; found {len(rows):,} lines.")
    header = [name.strip() for name in rows[0]]
    wanted = {name for one in unknowns for name in (*one.variables, f"{one.state}{suffix}")}
    odd = next((name for name in sorted(wanted) if header.count(name) != 1), None)
    if odd is not None:
        raise InputError(f"samples {path} must have the column {odd} once; its columns are {', '.join(header)}.")
    columns = {
        name: [_number(row, header.index(name), path, k) for k, row in enumerate(rows[1:], 2)] for name in wanted
    }
    taken = {
        one.state: Sampled(
            tuple(zip(*(columns[v] for v in one.variables), strict=True)), tuple(columns[f"{one.state}{suffix}"])
        )
        for one in unknowns
    }
    return taken, hashlib.sha256(raw).hexdigest()


def boxed(system: System, one: Unknown, axes: tuple[Point, ...] | None) -> Unknown:
    """The unknown with its box: that of samples that are a grid over the domain, the input bounds and 0, else the box
    of these."""
    bounds = bounds_of(system)
    box = tuple((min(lo, Fraction(0)), max(hi, Fraction(0))) for lo, hi in (bounds[name] for name in one.variables))
    reach = tuple((axis[0], axis[-1]) for axis in axes or ())
    if reach and all(a <= lo and hi <= b for (a, b), (lo, hi) in zip(reach, box, strict=True)):
        box = reach
    return replace(one, box=box)


def require_within(system: System, one: Unknown, noise: Fraction) -> None:
    """Reject a domain or input bounds beyond the box, and bounds of too long numbers."""
    bounds = bounds_of(system)
    if any(map(_is_long, (noise, *chain(*one.curvature)))):
        raise InputError(f"bounds of the noise and of second derivatives of {one.state} must have {_LENGTH}.")
    if any(map(_is_long, chain(*one.box))):
        raise InputError(f"the domain and the input bounds of {', '.join(one.variables)} must have {_LENGTH}.")
    for name, (first, last) in zip(one.variables, one.box, strict=True):
        lo, hi = bounds[name]
        if not (first <= lo and hi <= last):
            raise InputError(
                f"{name} must lie in [{float(first):g}, {float(last):g}], where the bounds of second derivatives of "
                f"{one.state} are assumed; found [{float(lo):g}, {float(hi):g}]. Fit again with that domain."
            )


def bounds_of(system: System) -> dict[str, Interval]:
    """The domain and the input bounds, by the names of states and inputs."""
    both = zip((*system.states, *system.inputs), (*system.domain, *system.input_bounds), strict=True)
    return {s.name: interval for s, interval in both}


def with_samples(system: System, samples: Samples, path: Path) -> System:
    """A plant whose file has a table `samples`, with the samples of that file.

    Raises
    ------
    InputError : the file is another one or cannot be read.
    """
    taken, sha256 = read_samples(path, samples.unknowns, suffix_of(system))
    if sha256 != samples.sha256:
        raise InputError(
            f"data file {path} must be the one to which the plant was fitted, of sha256 {samples.sha256}; found "
            f"{sha256}. For other samples run certify fit again."
        )
    taken = {one.state: taken[one.state].within(one.box) for one in samples.unknowns}
    return replace(system, samples=replace(samples, taken=taken))


def suffix_of(system: System) -> str:
    """The end of the name of a column of values."""
    return "_next" if system.time == "discrete" else "_rate"


def _number(row: Sequence[str], at: int, path: Path, line: int) -> Fraction:
    try:
        found = Fraction(decimal(row[at].strip()))
    except (IndexError, ValueError) as error:
        raise InputError(f"samples {path}, line {line}: entry {at + 1} must be a decimal number.") from error
    if _is_long(found):
        raise InputError(f"samples {path}, line {line}: entry {at + 1} must have {_LENGTH}.")
    return found


def _is_long(q: Fraction) -> bool:
    return max(q.numerator.bit_length(), q.denominator.bit_length()) > _MOST_BITS
