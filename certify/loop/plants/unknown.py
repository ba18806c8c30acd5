"""Tables of a plant's file for what is not known of it: ranges of parameters, residuals of equations, measurements."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Any

from certify.loop.expressions import Expression, Operation, Symbol
from certify.loop.plants.measurements import Measurements
from certify.loop.plants.source import PlantFile, interval_at, interval_in, number_at
from certify.loop.plants.system import Interval

_DATA = ("file", "sha256", "period", "noise", "priors")
_DIGITS = frozenset("0123456789abcdef")


def parameter(file: PlantFile, name: str) -> tuple[Fraction, Interval | None]:
    """The value of an entry of `parameters`, and its range if the entry is a pair, of which the value is the middle."""
    value = file.table("parameters")[name]
    if not isinstance(value, list):
        return number_at(file, value, "parameters", name), None
    lo, hi = interval_at(file, "parameters", name)
    return (lo + hi) / 2, (lo, hi)


def residual_ranges(file: PlantFile, states: Sequence[str]) -> dict[str, Interval]:
    """The disturbances in [-1, 1], one for each state of the table `residual`, by their names.

    Raises
    ------
    InputError : an entry is no state, or its disturbance's name is one of the table `disturbances`.
    """
    file.require_known("residual", list(states), "state")
    twice = next(
        (s for s in states if s in file.table("residual") and _residual(s) in file.table("disturbances")), None
    )
    if twice is not None:
        raise file.refuse(f"its disturbance is {_residual(twice)}, a name that stands for another.", "residual", twice)
    return {_residual(s): (Fraction(-1), Fraction(1)) for s in states if s in file.table("residual")}


def with_residuals(
    dynamics: Sequence[Expression],
    states: Sequence[str],
    bounds: Mapping[str, Expression],
    symbol: Mapping[str, Symbol],
) -> list[Expression]:
    """Equations with what they may lack: each of those with a bound as f + w bound, |w| <= 1.

    The bound's sign does not count, so that its factors abs(e) are written as e: these have no corner where e is 0.
    """
    return [
        Operation("+", e, Operation("*", symbol[_residual(s)], _without_corners(bounds[s]))) if s in bounds else e
        for s, e in zip(states, dynamics, strict=True)
    ]


def _without_corners(bound: Expression) -> Expression:
    """An expression of the same size at each point, with e instead of each factor abs(e)."""
    if not isinstance(bound, Operation):
        return bound
    if bound.operator in ("abs", "-"):
        return _without_corners(bound.operands[0])
    if bound.operator in ("*", "/"):
        return Operation(bound.operator, *map(_without_corners, bound.operands))
    return bound


def _residual(state: str) -> str:
    return f"residual_{state}"


def measurements_in(
    file: PlantFile, states: Sequence[str], ranges: Mapping[str, Interval], time: str
) -> Measurements | None:
    """The table `data`, without the measured numbers, which another file has; None without one.

    Raises
    ------
    InputError : an entry is missing, unknown or no number, or a parameter with a prior has no range.
    """
    if "data" not in file.data:
        return None
    table = file.table("data")
    file.require_known("data", list(_DATA), "entry of a plant's data")
    wanted = [key for key in _DATA if key not in table and not (key == "period" and time == "discrete")]
    if wanted:
        raise file.refuse(f"must have {', '.join(wanted)}. `certify identify` writes this table.", "data")
    if time == "discrete" and "period" in table:
        raise file.refuse("must be left out in discrete time, where a transition is a step.", "data", "period")
    sha256 = table["sha256"]
    if not isinstance(sha256, str) or len(sha256) != 64 or not set(sha256) <= _DIGITS:
        raise file.refuse(f"must be 64 hexadecimal digits; found {sha256!r:.80}.", "data", "sha256")
    if not isinstance(table["file"], str):
        raise file.refuse(f"must be the name of a file; found {table['file']!r:.80}.", "data", "file")
    noise = _inner(file, "noise", list(states), "state")
    missing = [s for s in states if s not in noise]
    if missing:
        raise file.refuse(f"there must be a bound for every state; {missing[0]} has none.", "data", "noise")
    bounds = tuple(number_at(file, noise[s], "data", "noise", s) for s in states)
    if min(bounds) < 0:
        raise file.refuse("must be at least 0 in each state.", "data", "noise")
    stated = _inner(file, "priors", list(ranges), "ranged parameter")
    priors = {p: interval_in(file, value, "data", "priors", p) for p, value in stated.items()}
    if not priors:
        raise file.refuse("there must be a range for a parameter at least.", "data", "priors")
    return Measurements(priors, _period(file) if time == "continuous" else None, bounds, (), sha256)


def _inner(file: PlantFile, key: str, known: list[str], what: str) -> Mapping[str, Any]:
    """A table within the table `data`."""
    found = file.table("data")[key]
    if not isinstance(found, dict):
        raise file.refuse(f"must be a table with an entry for each {what}; found {found!r:.80}.", "data", key)
    for name in found:
        if name not in known:
            raise file.refuse(f"{name!r} is no {what}; known are {', '.join(known) or 'none'}.", "data", key, name)
    return found


def _period(file: PlantFile) -> Interval:
    value = file.table("data")["period"]
    ends = value if isinstance(value, list) and len(value) == 2 else [value, value]
    lo, hi = (number_at(file, end, "data", "period") for end in ends)
    if not 0 < lo <= hi:
        raise file.refuse(f"must be a positive time, or [lo, hi] with lo <= hi; found {value!r:.80}.", "data", "period")
    return lo, hi
