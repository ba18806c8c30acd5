"""`certify plant`: show a plant before anybody trains for it or proves anything about it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from fractions import Fraction
from typing import TYPE_CHECKING, Annotated, Any

import typer

from certify.analysis.changes import PlantChanges
from certify.cli.options import changes_of_a_plant, takes
from certify.cli.shared import Json, describe
from certify.cli.terminal import say, show, tell
from certify.errors import InputError

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.table import Table

    from certify.loop.plants import Controllability, Matrix, Measurements, System

_WITHOUT_REST = "certify reach --target and certify roa --claim invariant need no equilibrium."


@takes(changes=changes_of_a_plant("parameters"))
def plant(
    system: Annotated[str, typer.Argument(help="A plant that ships, FILE.toml, or FILE.py:NAME, whose code is run.")],
    changes: PlantChanges,
    as_json: Json = False,
) -> None:
    """Show a plant: equations, operating point, linearisation, controllability, disturbances, bounds and units.

    The exit status is 2 if the operating point is no equilibrium, unless that is for a clock alone.
    """
    from certify.loop.composition import with_results_as_inputs
    from certify.loop.plants import chosen_system, clocks, controllability, linearise, require_equilibrium

    found = with_results_as_inputs(changes.of(chosen_system(system)))
    A, B = linearise(found)
    eigenvalues, reach = _eigenvalues(A), controllability(A, B)
    if as_json:
        say(json.dumps(_data(found, A, B, eigenvalues, reach)))
    else:
        show(_page(found, A, B, eigenvalues, reach))
    try:
        require_equilibrium(found, but=clocks(found))
    except InputError as error:
        tell(f"certify: {error} {_WITHOUT_REST}")
        raise typer.Exit(2) from None


def _data(s: System, A: Matrix, B: Matrix, eigenvalues: Sequence[complex], reach: Controllability) -> dict[str, Any]:
    from certify.loop.plants import residuals

    return {
        **describe(s),
        "residual": {name: str(r) for name, r in residuals(s).items() if r != 0 or isinstance(r, float)},
        "A": _floats(A),
        "B": _floats(B),
        "eigenvalues": [[e.real, e.imag] for e in eigenvalues],
        "controllability": {"rank": reach.rank, "of": s.n, "exact": reach.exact, "smallest": reach.smallest},
    }


def _page(s: System, A: Matrix, B: Matrix, eigenvalues: Sequence[complex], reach: Controllability) -> RenderableType:
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    from certify.loop.plants import dynamics_of_values

    grid = Table.grid(padding=(0, 2))
    grid.add_column(style="dim", no_wrap=True)
    grid.add_column(overflow="fold")
    for x, e in zip(s.states, dynamics_of_values(s), strict=True):
        grid.add_row(Text(f"d {x}/dt" if s.time == "continuous" else f"{x}, next"), Text(f"= {e}"))
    facts = Table.grid(padding=(0, 2))
    facts.add_column(style="dim", no_wrap=True)
    facts.add_column(overflow="fold")
    for name, text in _facts(s, eigenvalues, reach):
        facts.add_row(Text(name), Text(text))
    parts: list[RenderableType] = [Text.assemble((s.name, "bold"), f"  {s.description}"), Text(), grid, Text()]
    parts.append(_variables(s))
    if s.parameters:
        parts += [Text(), _parameters(s)]
    if s.disturbances:
        parts += [Text(), _disturbances(s)]
    parts += [Text(), _matrix("A", s, A, [x.name for x in s.states]), Text()]
    parts += [_matrix("B", s, B, [u.name for u in s.inputs]), Text(), facts]
    return Group(*parts)


def _facts(s: System, eigenvalues: Sequence[complex], reach: Controllability) -> list[tuple[str, str]]:
    from certify.loop.plants import constraints_of_values

    steps = s.time == "discrete"
    largest = max(abs(e) - 1 if steps else e.real for e in eigenvalues)
    edge = "on the unit circle, within rounding" if steps else "on the axis, within rounding"
    word = "unstable" if largest > 1e-9 else "stable" if largest < -1e-9 else edge
    shown = ", ".join(_complex(e) for e in eigenvalues)
    how = (
        "exact rank of [B, AB, ...] in rationals"
        if reach.exact
        else f"rank in floats: the smallest singular value of [B, AB, ...] over the largest: {reach.smallest:.3g}"
    )
    word_reach = "controllable" if reach.rank == s.n else "NOT controllable"
    rows = [
        ("open loop", f"{word}; eigenvalues {shown}"),
        ("inputs reach", f"{reach.rank} of {s.n} directions: {word_reach} ({how})"),
    ]
    rows.insert(0, ("at rest", _rest(s)))
    rows += [(f"asked: {name}", f"{e} < 0") for name, e in constraints_of_values(s).items()]
    if s.angles:
        rows.append(("angles", f"{', '.join(s.angles)}: the same place after a full turn, 2 pi"))
    if s.ranges:
        rows.append(
            ("uncertain", f"{', '.join(s.ranges)}: any value in their ranges, at any time; A, B at nominal ones")
        )
    if s.measurements is not None:
        rows += _measured(s, s.measurements)
    if s.samples is not None:
        named = ", and ".join(f"{one.state} of {', '.join(one.variables)}" for one in s.samples.unknowns)
        said = f"the equation stands for a function that was sampled, {named}; sha256 {s.samples.sha256[:16]}..."
        rows.append(("samples", f"{said}; --data makes the file a part of a claim"))
    if s.operating_point():
        reads = ", ".join(f"{x} - {_number(q)}" if q else x.name for x, q in zip(s.states, s.exact_x_eq(), strict=True))
        rows.append(("policy reads", f"{reads}: deviations from x_eq, and so do A, B, V and the certificate"))
    return rows


def _rest(s: System) -> str:
    """The value of f at the operating point, or its distance from an equilibrium, in words."""
    from certify.loop.plants import clocks, moves_off, residuals, rests_where

    verb = " moves by" if s.time == "discrete" else "' ="
    running, moves = clocks(s), residuals(s)
    off = {name: float(r) for name, r in moves.items() if name not in running}
    ever = ", ".join(f"{name}{verb} {float(r):.6g}" for name, r in running.items())
    told = f"; but {ever} whatever states and inputs are: {_WITHOUT_REST}" if running else ""
    where = f"f(x_eq, u_eq) = {rests_where(s)}"
    if all(isinstance(moves[name], Fraction) and r == 0 for name, r in off.items()):
        return f"{where}{told}"
    if not moves_off(s, running):
        largest = max(map(abs, off.values()))
        return f"{where} within rounding, not exactly: the largest residual is {largest:.2g} in floats{told}"
    found = (f"{name}{verb} {r:.6g}" for name, r in off.items() if r != 0)
    return f"no equilibrium: {', '.join(found)} at (x_eq, u_eq){told}"


def _measured(s: System, data: Measurements) -> list[tuple[str, str]]:
    """The file on which ranges rest, and what was said of it."""
    priors = [f"{name} {_number(lo)} to {_number(hi)}" for name, (lo, hi) in data.priors.items()]
    noise = [f"{x} {_number(w)}" for x, w in zip(s.states, data.noise, strict=True)]
    each = "" if data.period is None else f"; transitions of {' to '.join(map(_number, dict.fromkeys(data.period)))}"
    return [
        ("data", f"sha256 {data.sha256[:16]}...; noise at most {', '.join(noise)}{each}"),
        ("before data", f"{', '.join(priors)}; --data makes the file a part of a claim"),
    ]


def _variables(s: System) -> Table:
    from certify.loop.plants import domain_of_values

    table = _table("", "unit", "at rest", "from", "to")
    for symbols, rest, bounds in (
        (s.states, s.exact_x_eq(), domain_of_values(s)),
        (s.inputs, s.exact_u_eq(), s.input_bounds),
    ):
        for symbol, value, (lo, hi) in zip(symbols, rest, bounds, strict=True):
            kind = "state" if symbols is s.states else "input"
            _row(table, f"{kind} {symbol}", _unit(s, symbol.name), _number(value), _number(lo), _number(hi))
    return table


def _parameters(s: System) -> Table:
    ranged = any(name in s.ranges for name in s.parameters)
    table = _table("parameter", "unit", "value", *(("from", "to") if ranged else ()))
    for name, value in s.parameters.items():
        _row(table, name, _unit(s, name), _number(value), *(_ends(s, name) if ranged else ()))
    return table


def _disturbances(s: System) -> Table:
    table = _table("disturbance", "unit", "from", "to")
    for symbol in s.disturbances:
        _row(table, symbol.name, _unit(s, symbol.name), *(_ends(s, symbol.name)))
    return table


def _ends(s: System, name: str) -> tuple[str, str]:
    """The ends of a quantity's range; empty for an exact parameter, 0 for a disturbance without a range."""
    if name in s.ranges:
        lo, hi = s.ranges[name]
        return _number(lo), _number(hi)
    return ("", "") if name in s.parameters else ("0", "0")


def _matrix(title: str, s: System, matrix: Matrix, columns: Sequence[str]) -> Table:
    table = _table(title, *columns)
    for name, row in zip(s.states, _floats(matrix), strict=True):
        _row(table, f"{name}'", *(f"{v:.6g}" for v in row))
    return table


def _table(first: str, *others: str) -> Table:
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False, header_style="dim")
    table.add_column(first)
    for name in others:
        table.add_column(name, justify="left" if name == "unit" else "right")
    return table


def _row(table: Table, *cells: str) -> None:
    from rich.text import Text

    table.add_row(*(Text(cell) for cell in cells))


def _unit(s: System, name: str) -> str:
    from certify.report.words import pretty_unit

    return pretty_unit(s.units.get(name, ""))


def _number(value: Fraction) -> str:
    """The number in digits, with the fraction too where the digits are not exact."""
    text = f"{float(value):.10g}"
    return text if Fraction(text) == value else f"{float(value):.6g} ({value})" if len(str(value)) <= 20 else text


def _complex(value: complex) -> str:
    return f"{value.real:.6g}" if value.imag == 0 else f"{value.real:.6g}{value.imag:+.6g}j"


def _floats(matrix: Matrix) -> list[list[float]]:
    from certify.loop.plants import in_floats

    found: list[list[float]] = in_floats(matrix).tolist()
    return found


def _eigenvalues(A: Matrix) -> list[complex]:
    import numpy as np

    return sorted((complex(e) for e in np.linalg.eigvals(np.array(_floats(A)))), key=lambda e: (-e.real, e.imag))
