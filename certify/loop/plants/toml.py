"""A user's plant in TOML. See `examples/plants`.

The file is in measured values: equations, operating point and domain are in absolute states, and this module converts
them to deviations from x_eq. Every error names the line, the entry and the expected value.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import cast, get_args

from certify.errors import InputError
from certify.loop.expressions import (
    NAMED,
    Expression,
    Number,
    Symbol,
    substitute,
    symbols,
    symbols_of,
    value_if_rational,
)
from certify.loop.plants.axes import along_axes
from certify.loop.plants.calls import Call, Named
from certify.loop.plants.deviations import in_deviations
from certify.loop.plants.equations import nearest, parse_constraint, parse_expression
from certify.loop.plants.operating_point import clocks, require_equilibrium
from certify.loop.plants.source import PlantFile, interval_at, number_at, read_plant_file
from certify.loop.plants.system import Interval, System, Time, irrational
from certify.loop.plants.unknown import measurements_in, parameter, residual_ranges, samples_in, with_residuals

_REQUIRED = ("name", "states", "inputs", "dynamics", "u_eq", "domain", "input_bounds")
_KEYS = (
    *_REQUIRED,
    "description",
    "parameters",
    "disturbances",
    "positive",
    "where",
    "x_eq",
    "units",
    "training",
    "time",
    "observations",
    "networks",
    "angles",
    "constraints",
    "residual",
    "samples",
    "unknown",
    "data",
)
_TURN = "2*pi"  # the only period of an angle


def load_system(path: Path) -> System:
    """Read a plant from a TOML file. Its table `training` is the trainer's and is ignored.

    Raises
    ------
    InputError : the file is missing or not TOML, a key is unknown or absent, an equation is outside the grammar, or
        x_eq is no equilibrium. The message names file, line and entry.
    """
    return build_system(read_plant_file(path))


def build_system(file: PlantFile) -> System:
    """Build the plant of a parsed file; raises like `load_system`."""
    _check_keys(file)
    name, description, time = _text(file, "name"), _text(file, "description"), _time(file)
    states, inputs = _names(file, "states"), _names(file, "inputs")
    given = {p: parameter(file, p) for p in file.table("parameters")}
    parameters = {p: value for p, (value, _) in given.items()}
    ranges = {p: interval for p, (_, interval) in given.items() if interval is not None}
    acting = {w: _disturbance(file, w) for w in file.table("disturbances")} | residual_ranges(file, states)
    everything = [*states, *inputs, *parameters, *acting]
    _check_names(file, states, inputs, parameters, acting)
    try:
        symbol = dict(zip(everything, symbols(everything), strict=True))
        constants = {p: symbol[p] for p in parameters}
        x_eq = [_equation(file, "x_eq", s, constants, "parameter", 0) for s in states]
        networks = _networks(file, everything)
        shorthand = _shorthand(file, symbol, networks)
        known = "state, input, parameter or disturbance" + (", and not defined in [where] above" if shorthand else "")
        dynamics = [_equation(file, "dynamics", s, symbol | shorthand, known, networks=networks) for s in states]
        lacking = {s: _equation(file, "residual", s, symbol | shorthand, known) for s in file.table("residual")}
        dynamics = with_residuals(dynamics, states, lacking, symbol)
        constraints = _constraints(file, symbol | shorthand, known, networks)
        calls = [call for network in networks.values() for call in network.made()]
        at = [symbol[s] for s in states], x_eq
        u_eq = [_equation(file, "u_eq", s, constants, "parameter") for s in inputs]
        for s, e in zip(inputs, u_eq, strict=True):
            _at_rest(file, "u_eq", s, e, parameters)
        system = System(
            name=name,
            description=description,
            states=tuple(symbol[s] for s in states),
            inputs=tuple(symbol[s] for s in inputs),
            parameters=parameters,
            positive=frozenset(_list(file, "positive")),
            dynamics=in_deviations(dynamics, [symbol[s] for s in states], x_eq, time),
            time=time,
            u_eq=tuple(u_eq),
            domain=tuple(_domain(file, s, e, parameters) for s, e in zip(states, x_eq, strict=True)),
            input_bounds=tuple(interval_at(file, "input_bounds", s) for s in inputs),
            units={name: _unit(file, name) for name in file.table("units")},
            x_eq=tuple(x_eq),
            disturbances=tuple(symbol[w] for w in acting),
            ranges=ranges | {w: interval for w, interval in acting.items() if interval is not None},
            calls=tuple(replace(call, arguments=in_deviations(call.arguments, *at)) for call in _in_order(calls)),
            rest_of_calls={name: q for network in networks.values() for name, q in network.at_rest().items()},
            angles=_angles(file, states),
            constraints=dict(zip(constraints, in_deviations(list(constraints.values()), *at), strict=True)),
            observations=tuple(_observations(file, {s: symbol[s] for s in (*states, *parameters)}, shorthand)),
            measurements=measurements_in(file, states, ranges, time),
            samples=samples_in(file, states, inputs, {*ranges, *acting}),
        )
    except InputError as error:
        if str(file.path) in str(error):
            raise
        raise file.refuse(str(error)) from error
    system = along_axes(system)
    if "x_eq" in file.data:
        require_equilibrium(system, lambda message: file.refuse(message, "x_eq"), but=clocks(system))
    return system


def _check_keys(file: PlantFile) -> None:
    for key in file.data:
        if key not in _KEYS:
            close = nearest(key, _KEYS) or f"; known are {', '.join(_KEYS)}."
            raise file.refuse(f"unknown keys are refused: {key!r} is none of a plant's{close}", key)
    if "unknown" in file.data and "samples" not in file.data:
        raise file.refuse("unknown functions must be sampled first: certify fit writes plants from samples.", "unknown")
    missing = [key for key in _REQUIRED if key not in file.data]
    if missing:
        raise file.refuse(f"missing keys: a plant must have {', '.join(missing)}.")


def _check_names(
    file: PlantFile, states: list[str], inputs: list[str], parameters: Collection[str], acting: Collection[str]
) -> None:
    """Refuse a name that stands for two things, and an entry of something that the plant does not have."""
    everything = [*states, *inputs, *parameters, *acting]
    for key, names in (
        ("states", states),
        ("inputs", inputs),
        ("parameters", parameters),
        ("disturbances", acting),
    ):
        twice = next((name for name in names if everything.count(name) > 1), None)
        if twice is not None:
            raise file.refuse(
                f"names of states, inputs, parameters and disturbances must differ; found {twice!r} twice.", key
            )
    file.require_known("units", everything, "state, input, parameter or disturbance")
    for table, names, what in (
        ("dynamics", states, "state"),
        ("domain", states, "state"),
        ("x_eq", states, "state"),
        ("u_eq", inputs, "input"),
        ("input_bounds", inputs, "input"),
    ):
        file.require_known(table, names, what)


def _networks(file: PlantFile, everything: list[str]) -> dict[str, Named]:
    """The table `networks`: functions that equations may call."""
    for name in file.table("networks"):
        if name in everything or name in NAMED or not name.isidentifier():
            raise file.refuse("must be a new name, and no state, input, parameter or function.", "networks", name)
    return {name: Named(file, name, everything) for name in file.table("networks")}


def _in_order(calls: list[Call]) -> list[Call]:
    """The calls, each behind those whose results it reads."""
    found, known = list[Call](), set[Symbol]()
    results = {symbol for call in calls for _, symbol in call.results}
    while len(found) < len(calls):
        for call in calls:
            if call not in found and symbols_of(*call.arguments) & results <= known:
                found.append(call)
                known |= {symbol for _, symbol in call.results}
    return found


def _shorthand(file: PlantFile, symbol: Mapping[str, Symbol], networks: Mapping[str, Named]) -> dict[str, Expression]:
    """The table `where`: names for expressions that equations share, each over the plant's names and those above."""
    found: dict[str, Expression] = {}
    for name in file.table("where"):
        if name in symbol or name in NAMED or not name.isidentifier():
            raise file.refuse("must be a new name, and no state, input, parameter or function.", "where", name)
        names, known = {**symbol, **found}, "name of the plant or of a line above"
        found[name] = _equation(file, "where", name, names, known, networks=networks)
    return found


def _observations(
    file: PlantFile, symbol: Mapping[str, Symbol], shorthand: Mapping[str, Expression]
) -> Iterator[Expression]:
    """The table `observations`: what a policy reads, in its order, over the states' values."""
    names = {**symbol, **{k: e for k, e in shorthand.items() if symbols_of(e) <= {*symbol.values()}}}
    for name in file.table("observations"):
        if not name.isidentifier():
            raise file.refuse("must be a name.", "observations", name)
        yield _equation(file, "observations", name, names, "state, parameter or name of [where] made of these")


def _angles(file: PlantFile, states: list[str]) -> tuple[str, ...]:
    """The table `angles`: states of which a full turn more is the same place."""
    file.require_known("angles", states, "state")
    for name, value in file.table("angles").items():
        if value != _TURN:
            raise file.refuse(
                f'an angle repeats after a full turn: write {name} = "{_TURN}"; found {value!r}.', "angles", name
            )
    return tuple(name for name in states if name in file.table("angles"))


def _constraints(
    file: PlantFile, names: Mapping[str, Expression], known: str, networks: Mapping[str, Named]
) -> dict[str, Expression]:
    """The table `constraints`: g by name, over the states' values, of comparisons such as `p <= 1.5`."""
    found = dict[str, Expression]()
    for name, value in file.table("constraints").items():
        if not isinstance(value, str):
            raise file.refuse(
                f"must be a comparison as text, such as 'p <= 1.5'; found {value!r}.", "constraints", name
            )
        try:
            found[name] = parse_constraint(value, names, known, networks)
        except InputError as error:
            raise file.refuse(str(error), "constraints", name) from error
        if not symbols_of(found[name]):
            raise file.refuse(f"must depend on a state or an input; found {value!r}.", "constraints", name)
    return found


def _time(file: PlantFile) -> Time:
    """`continuous` unless the file says `discrete`."""
    found = file.data.get("time", "continuous")
    for known in get_args(Time):
        if found == known:
            return cast("Time", known)
    raise file.refuse(f"must be one of {', '.join(get_args(Time))}; found {found!r}.", "time")


def _equation(
    file: PlantFile,
    table: str,
    name: str,
    symbol: Mapping[str, Expression],
    known: str,
    default: int | None = None,
    networks: Mapping[str, Named] | None = None,
) -> Expression:
    entries = file.table(table)
    if name not in entries:
        if default is not None:
            return Number(default)
        raise file.refuse(f'there must be an equation for {name}; none was found. Write {name} = "...".', table)
    value = entries[name]
    if isinstance(value, bool) or not isinstance(value, str | int | Fraction):
        raise file.refuse(f"must be an equation as text, or a number; found {value!r}.", table, name)
    try:
        return parse_expression(value, symbol, known, networks)
    except InputError as error:
        raise file.refuse(str(error), table, name) from error


def _domain(file: PlantFile, name: str, x_eq: Expression, parameters: Mapping[str, Fraction]) -> Interval:
    """The interval of a state's values as one of deviations. Where nobody says `x_eq`, nothing need rest in it."""
    lo, hi = interval_at(file, "domain", name)
    at = _at_rest(file, "x_eq", name, x_eq, parameters)
    if "x_eq" in file.data and not lo < at < hi:
        raise file.refuse(
            f"the domain must have the operating point {name} = {float(at):g} in its interior; "
            f"found [{float(lo):g}, {float(hi):g}].",
            "domain",
            name,
        )
    return lo - at, hi - at


def _at_rest(
    file: PlantFile, table: str, name: str, expression: Expression, parameters: Mapping[str, Fraction]
) -> Fraction:
    """The value of an entry of x_eq or u_eq."""
    point = substitute(expression, {Symbol(p): Number(q) for p, q in parameters.items()})
    try:
        value = value_if_rational(point, {})
    except InputError as error:
        raise file.refuse(f"the operating point has no value: {error}.", table, name) from error
    if isinstance(value, str):
        raise file.refuse(f"the operating point {irrational(point)}", table, name)
    return value


def _disturbance(file: PlantFile, name: str) -> Interval | None:
    """The range of a disturbance: a half-width or a pair; None for 0, which acts only on request."""
    value = file.table("disturbances")[name]
    if isinstance(value, list):
        return interval_at(file, "disturbances", name)
    half = number_at(file, value, "disturbances", name)
    if half < 0:
        raise file.refuse(
            f"must be a half-width that is not negative, or a pair [lo, hi]; found {value!r}.", "disturbances", name
        )
    return (-half, half) if half else None


def _text(file: PlantFile, key: str) -> str:
    value = file.data.get(key, "")
    if not isinstance(value, str):
        raise file.refuse(f"must be text; found {value!r}.", key)
    return value


def _unit(file: PlantFile, name: str) -> str:
    value = file.table("units")[name]
    if not isinstance(value, str):
        raise file.refuse(f"must be a unit as text, such as 'rad/s'; found {value!r}.", "units", name)
    return value


def _names(file: PlantFile, key: str) -> list[str]:
    names = _list(file, key)
    if not names:
        raise file.refuse("must name at least one; found none.", key)
    return names


def _list(file: PlantFile, key: str) -> list[str]:
    value = file.data.get(key, [])
    if not isinstance(value, list) or not all(isinstance(name, str) for name in value):
        raise file.refuse(f'must be a list of names, as in ["x1", "x2"]; found {value!r}.', key)
    return value
