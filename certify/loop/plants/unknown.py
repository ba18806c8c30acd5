"""Tables of a plant's file for what is not known of it: ranges of parameters, residuals, measurements, samples."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from typing import Any

from certify.loop.expressions import Expression, Operation, Symbol
from certify.loop.plants.axes import axes_of
from certify.loop.plants.measurements import Axis, Measurements
from certify.loop.plants.samples import Box, Samples, Unknown, slope_name
from certify.loop.plants.source import PlantFile, interval_at, interval_in, number_at
from certify.loop.plants.system import Interval

_DATA = ("file", "sha256", "period", "noise", "priors", "axes")
_SAMPLES = ("file", "sha256", "noise", "box", "near_origin")
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
        (s for s in states if s in file.table("residual") and residual_name(s) in file.table("disturbances")), None
    )
    if twice is not None:
        raise file.refuse(
            f"its disturbance is {residual_name(twice)}, a name that stands for another.", "residual", twice
        )
    return {residual_name(s): (Fraction(-1), Fraction(1)) for s in states if s in file.table("residual")}


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
        Operation("+", e, Operation("*", symbol[residual_name(s)], _without_corners(bounds[s]))) if s in bounds else e
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


def residual_name(state: str) -> str:
    """The name of the disturbance by which an equation may be off."""
    return f"residual_{state}"


def beyond_name(state: str, term: int) -> str:
    """The name of the disturbance that is a share of one term of what an equation has beyond A x + B u, from 1."""
    return f"beyond_{state}_{term}"


def residual_names(state: str, ranges: Mapping[str, Interval]) -> list[str]:
    """The names of the disturbances with ranges around 0 that bound what a state's equation lacks."""
    own = [residual_name(state), *(beyond_name(state, k + 1) for k in range(len(ranges)))]
    return [name for name in own if name in ranges and ranges[name][0] == -ranges[name][1]]


def _standing(one: Unknown, ranges: Collection[str]) -> Unknown:
    """The unknown with the names of the disturbance and of the slopes that have ranges, as `certify fit` writes them;
    where there are slopes it vanishes."""
    slopes, error = tuple(slope_name(one.state, v) for v in one.variables), residual_name(one.state)
    own = slopes if all(name in ranges for name in slopes) else ()
    return replace(one, error=error if error in ranges else None, slopes=own, vanishes=bool(own))


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
    free = ("axes", "period") if time == "discrete" else ("axes",)
    wanted = [key for key in _DATA if key not in table and key not in free]
    if wanted:
        raise file.refuse(f"must have {', '.join(wanted)}. `certify identify` writes this table.", "data")
    if time == "discrete" and "period" in table:
        raise file.refuse("must be left out in discrete time, where a transition is a step.", "data", "period")
    sha256 = _file_of(file, "data")
    noise = _inner(file, "data", "noise", list(states), "state")
    missing = [s for s in states if s not in noise]
    if missing:
        raise file.refuse(f"there must be a bound for every state; {missing[0]} has none.", "data", "noise")
    bounds = tuple(number_at(file, noise[s], "data", "noise", s) for s in states)
    if min(bounds) < 0:
        raise file.refuse("must be at least 0 in each state.", "data", "noise")
    stated = _inner(file, "data", "priors", list(ranges), "ranged parameter")
    priors = {p: interval_in(file, value, "data", "priors", p) for p, value in stated.items()}
    if not priors:
        raise file.refuse("there must be a range for a parameter at least.", "data", "priors")
    period = _period(file) if time == "continuous" else None
    return Measurements(priors, period, bounds, (), sha256, _axes(file, list(priors)) if "axes" in table else ())


def _axes(file: PlantFile, names: list[str]) -> tuple[Axis, ...]:
    """The table `data.axes`, of each parameter its value in the middle and its slopes along the axes."""
    stated = _inner(file, "data", "axes", names, "parameter with a prior")
    rows = [stated.get(name) for name in names]
    if not all(isinstance(row, list) and len(row) == len(names) + 1 for row in rows):
        raise file.refuse(f"there must be a list of {len(names) + 1} numbers for each prior.", "data", "axes")
    return axes_of(
        [
            tuple(number_at(file, q, "data", "axes", name) for q in row or ())
            for name, row in zip(names, rows, strict=True)
        ]
    )


def unknowns_in(file: PlantFile, names: Sequence[str], states: Sequence[str]) -> tuple[Unknown, ...]:
    """The tables `unknown.STATE` of a structure, whose entries are as in `"theta*u" = 0.5`.

    Raises
    ------
    InputError : there is none, a name is unknown, a number is negative, or a pair of variables has no bound.
    """
    file.require_known("unknown", list(states), "state")
    found = tuple(_unknown(file, state, names) for state in file.table("unknown"))
    if not found:
        raise file.refuse("there must be a table [unknown.STATE] with bounds of second derivatives; found none.")
    return found


def _unknown(file: PlantFile, state: str, names: Sequence[str]) -> Unknown:
    table, bounds = file.table("unknown")[state], dict[frozenset[str], Fraction]()
    if not isinstance(table, dict) or not table:
        raise file.refuse('must be a table with entries as in "x*u" = 0.5; found none.', "unknown", state)
    for key, value in table.items():
        pair = [name.strip() for name in key.split("*")]
        if len(pair) != 2 or not set(pair) <= set(names):
            raise file.refuse(
                f"must be two states or inputs with * between them, of {', '.join(names)}; found {key!r}.",
                "unknown",
                state,
            )
        bound = number_at(file, value, "unknown", state, key)
        if bound < 0 or frozenset(pair) in bounds:
            raise file.refuse(
                f"the bound of {key} must be at least 0, and stand once; found {value}.", "unknown", state
            )
        bounds[frozenset(pair)] = bound
    variables = tuple(name for name in names if any(name in pair for pair in bounds))
    missing = [(a, b) for a in variables for b in variables if frozenset((a, b)) not in bounds]
    if missing:
        raise file.refuse(
            f"there must be a bound for each pair of {', '.join(variables)}; found none for {'*'.join(missing[0])}.",
            "unknown",
            state,
        )
    rows = tuple(tuple(bounds[frozenset((a, b))] for b in variables) for a in variables)
    return Unknown(state, variables, rows)


def samples_in(
    file: PlantFile, states: Sequence[str], inputs: Sequence[str], ranges: Collection[str]
) -> Samples | None:
    """The tables `samples` and `unknown`, without the sampled numbers, which another file has; None without them.

    Raises
    ------
    InputError : an entry is missing, unknown or no number.
    """
    if "samples" not in file.data:
        return None
    file.require_known("samples", list(_SAMPLES), "entry of a plant's samples")
    missing = [key for key in _SAMPLES[:-1] if key not in file.table("samples")]
    if missing:
        raise file.refuse(f"must have {', '.join(missing)}. `certify fit` writes this table.", "samples")
    unknowns = unknowns_in(file, [*states, *inputs], states)
    named = [one.state for one in unknowns]
    noise = _inner(file, "samples", "noise", named, "unknown function")
    odd = [state for state in named if state not in noise]
    if odd:
        raise file.refuse(f"there must be a bound for {odd[0]}; found none.", "samples", "noise")
    bounds = {state: number_at(file, noise[state], "samples", "noise", state) for state in named}
    if min(bounds.values()) < 0:
        raise file.refuse("must be at least 0.", "samples", "noise")
    _inner(file, "samples", "box", named, "unknown function")
    boxed = tuple(_standing(replace(one, box=_box(file, one)), ranges) for one in unknowns)
    near_origin = float(number_at(file, file.table("samples").get("near_origin", 0), "samples", "near_origin"))
    return Samples(_file_of(file, "samples"), boxed, bounds, {}, near_origin)


def _box(file: PlantFile, one: Unknown) -> Box:
    """The box on which the bounds of second derivatives hold."""
    found = file.table("samples")["box"].get(one.state)
    if not isinstance(found, dict) or {*found} != {*one.variables}:
        what = f"must be a table of intervals of {', '.join(one.variables)}; found {found!r:.80}."
        raise file.refuse(what, "samples", "box", one.state)
    return tuple(interval_in(file, found[name], "samples", "box", one.state, name) for name in one.variables)


def _file_of(file: PlantFile, table: str) -> str:
    """The sha256 of the file that a table names."""
    sha256, name = (file.table(table)[key] for key in ("sha256", "file"))
    if not isinstance(sha256, str) or len(sha256) != 64 or not set(sha256) <= _DIGITS:
        raise file.refuse(f"must be 64 hexadecimal digits; found {sha256!r:.80}.", table, "sha256")
    if not isinstance(name, str):
        raise file.refuse(f"must be the name of a file; found {name!r:.80}.", table, "file")
    return sha256


def _inner(file: PlantFile, table: str, key: str, known: list[str], what: str) -> Mapping[str, Any]:
    """A table within a table."""
    found = file.table(table)[key]
    if not isinstance(found, dict):
        raise file.refuse(f"must be a table with an entry for each {what}; found {found!r:.80}.", table, key)
    for name in found:
        if name not in known:
            raise file.refuse(f"{name!r} is no {what}; known are {', '.join(known) or 'none'}.", table, key, name)
    return found


def _period(file: PlantFile) -> Interval:
    value = file.table("data")["period"]
    ends = value if isinstance(value, list) and len(value) == 2 else [value, value]
    lo, hi = (number_at(file, end, "data", "period") for end in ends)
    if not 0 < lo <= hi:
        raise file.refuse(f"must be a positive time, or [lo, hi] with lo <= hi; found {value!r:.80}.", "data", "period")
    return lo, hi
