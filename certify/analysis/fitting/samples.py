"""Samples of an unknown right-hand side, from a file.

Numbers are the file's own as exact fractions, decimals of CSV and binary values of other files: nothing is rounded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import Any

from certify.analysis.tables import NEXT, RATE, read_table
from certify.errors import InputError
from certify.loop.plants.equations import decimal
from certify.loop.plants.samples import Point, Sampled, Samples, Unknown
from certify.loop.plants.system import Interval, System

_MOST_BITS = 2**7  # of a number, as the checkers read them
_MOST_PARTS, _OF_A_SAMPLE = 900_000, 12  # commas and brackets of a certificate; of a sample, beside its variables
_LENGTH = "some 35 digits at most"


def read_samples(path: Path, unknowns: Sequence[Unknown], system: System) -> tuple[dict[str, Sampled], str]:
    """The samples of each unknown, by its state, from a file; and the sha256 of the file.

    A column `NAME_rate`, in discrete time `NAME_next`, has the values of each unknown. In discrete time rows may also
    be in time order, and the next row has them.

    Raises
    ------
    InputError : the file cannot be read, a column is missing, or an entry is no number.
    """
    table = read_table(path, [s.name for s in system.states], [u.name for u in system.inputs])
    suffix = NEXT if system.time == "discrete" else RATE
    in_order = suffix == NEXT and not any(name.endswith(NEXT) for name in table.columns)
    rows = list(range(len(table.places)))
    if in_order:
        suffix, rows = "", [k for first, last in table.stretches() for k in range(first, last - 1)]
    wanted = list(dict.fromkeys(name for one in unknowns for name in (*one.variables, f"{one.state}{suffix}")))
    if suffix == RATE and not any(name.endswith(RATE) for name in table.columns):
        raise InputError(
            f"data file {path} must have rates, in columns such as {unknowns[0].state}{RATE}; it has "
            f"{', '.join(table.columns)}. Rows of states and inputs alone are for certify identify, or for a structure "
            'with time = "discrete", whose functions give the next row.'
        )
    table.require(wanted)
    most = _MOST_PARTS // sum(len(one.variables) + _OF_A_SAMPLE for one in unknowns)
    if len(rows) > most:
        raise InputError(f"samples {path} must be of 1 to {most:,} rows; found {len(rows):,}.")
    columns = {name: [_number(entry, where) for entry, where in table.entries(name)] for name in wanted}
    taken = dict[str, Sampled]()
    for one in unknowns:
        points = tuple(zip(*([columns[v][k] for k in rows] for v in one.variables), strict=True))
        taken[one.state] = Sampled(points, tuple(columns[f"{one.state}{suffix}"][k + in_order] for k in rows))
    return taken, table.sha256


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
    taken, sha256 = read_samples(path, samples.unknowns, system)
    if sha256 != samples.sha256:
        raise InputError(
            f"data file {path} must be the one to which the plant was fitted, of sha256 {samples.sha256}; found "
            f"{sha256}. For other samples run certify fit again."
        )
    taken = {one.state: taken[one.state].within(one.box) for one in samples.unknowns}
    return replace(system, samples=replace(samples, taken=taken))


def _number(entry: Any, where: str) -> Fraction:
    """A decimal of a text, or the value of a float."""
    try:
        if isinstance(entry, bool):
            raise TypeError(entry)
        found = decimal(entry) if isinstance(entry, str) else Fraction(entry)
    except (ValueError, TypeError, OverflowError) as error:
        raise InputError(f"{where}: there must be a finite number; found {entry!r:.40}.") from error
    if _is_long(found):
        raise InputError(f"{where}: a number must have {_LENGTH}; found {entry}. Round it.")
    return found


def _is_long(q: Fraction) -> bool:
    return max(q.numerator.bit_length(), q.denominator.bit_length()) > _MOST_BITS
