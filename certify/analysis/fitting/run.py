"""From samples of what nobody wrote down to two plants: far from the origin a polynomial within a constant error, near
it the linear part within an error that vanishes there.

Each is a plant of which `certify roa` proves a claim; `certify compose` joins the two. What the claims say is about
every plant within these errors. That the sampled plant is one of them follows from the samples, their noise and the
declared bounds of second derivatives by what stands in `polynomial.py` and `linear.py`. `certify roa --data` makes the
samples a part of the claim, and both checkers derive this again.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

from certify.analysis.fitting.grid import Grid, axes_of, enclosed
from certify.analysis.fitting.linear import Sampling, residual_text
from certify.analysis.fitting.polynomial import Bound, Missing, Polynomial, bounded, errors, fitted, missing
from certify.analysis.fitting.possible import require_consistent, require_possible
from certify.analysis.fitting.samples import bounds_of, boxed, read_samples, require_within
from certify.certificates import write_atomically
from certify.errors import InputError
from certify.loop.plants import Sampled, System, Unknown, load_system
from certify.loop.plants.samples import slope_name
from certify.loop.plants.source import read_plant_file
from certify.loop.plants.toml import build_system
from certify.loop.plants.unknown import unknowns_in

Interval = tuple[Fraction, Fraction]


@dataclass(frozen=True, slots=True)
class Fitted:
    """One unknown.

    Parameters
    ----------
    sampling : its samples in the box, of which there are `found` in the file.
    grid, polynomial, error, largest : the polynomial, and a bound of its error, whose largest value is on some cell.
    slopes, beyond : intervals of the slopes at the origin, and the bound of what lies beyond them.
    missing : what more samples would help.
    """

    sampling: Sampling
    found: int
    grid: Grid
    polynomial: Polynomial
    error: Bound
    largest: Fraction
    slopes: tuple[Interval, ...]
    beyond: str
    missing: Missing

    @property
    def unknown(self) -> Unknown:
        return self.sampling.one

    def of_variables(self) -> Iterator[tuple[str, Interval]]:
        """The variables with the ranges of their slopes."""
        return zip(self.unknown.variables, self.slopes, strict=True)


@dataclass(frozen=True, slots=True)
class FitResult:
    """The two plants, and what was found of each unknown."""

    found: tuple[Fitted, ...]
    far: Path
    near: Path
    sha256: str

    def to_dict(self) -> dict[str, Any]:
        """The JSON object."""
        return {
            "far": str(self.far),
            "near": str(self.near),
            "data": {"sha256": self.sha256},
            "unknown": {
                one.unknown.state: {
                    "samples": len(one.sampling.values),
                    "left_out": one.found - len(one.sampling.values),
                    "grid": len(one.grid.bounds),
                    "terms": len(one.polynomial.powers),
                    "error": one.error.text(),
                    "largest_error": str(one.largest),
                    "slopes": {v: [str(lo), str(hi)] for v, (lo, hi) in one.of_variables()},
                    "beyond": one.beyond,
                    "missing": [list(map(str, point)) for point in one.missing.points],
                }
                for one in self.found
            },
        }


def fit_plant(
    samples: Path,
    structure: Path,
    noise: Callable[[str], Fraction],
    out: Path,
    degree: int = 9,
    near_origin: float = 0.0,
) -> FitResult:
    """Fit the unknown functions of a structure, and write `far.toml` and `near.toml` into a folder.

    Parameters
    ----------
    samples : .csv, .npz or .parquet with the columns of variables, and `NAME_rate` (in discrete time `NAME_next`) of
        each unknown; see `certify.analysis.tables`.
    structure : a plant's file in which some states have a table `unknown.STATE` instead of an equation.
    noise : the bound of the error of a sampled value, by the state's name.
    degree : of the polynomial in each variable.
    near_origin : how much more a low error counts near the origin, as a power of the distance.

    Raises
    ------
    InputError : a file cannot be read, or the samples do not bound a function on the domain and the input bounds.
    Contradicted : no function with the bounds has these samples.
    """
    unknowns, system = structure_in(structure)
    taken, sha256 = read_samples(samples, unknowns, system)
    found = tuple(_fitted(one, taken[one.state], noise(one.state), system, degree, near_origin) for one in unknowns)
    said = [f'file = "{samples.name}"', f'sha256 = "{sha256}"']
    bounds = ", ".join(f'{one.state} = "{noise(one.state)}"' for one in unknowns)
    boxes = ", ".join(f"{one.unknown.state} = {{ {_sides(one.unknown)} }}" for one in found)
    said += [f"noise = {{ {bounds} }}", f"box = {{ {boxes} }}", *([f"near_origin = {near_origin}"] * (near_origin > 0))]
    text = "\n".join(_into(structure.read_text(encoding="utf-8").splitlines(), "samples", said))
    out.mkdir(parents=True, exist_ok=True)
    far = {one.unknown.state: (one.polynomial.text(), one.error.text()) for one in found}
    near = {one.unknown.state: (_sum(one), one.beyond) for one in found}
    ranges = {slope_name(one.unknown.state, v): pair for one in found for v, pair in one.of_variables()}
    _write(out / "far.toml", _text(text, far, {}, f"fitted to {samples.name} (sha256 {sha256})"))
    _write(out / "near.toml", _text(text, near, ranges, f"from {samples.name} (sha256 {sha256}), around the origin"))
    return FitResult(found, out / "far.toml", out / "near.toml", sha256)


def structure_in(path: Path) -> tuple[tuple[Unknown, ...], System]:
    """The unknown functions of a structure, and the plant with 0 in their place.

    Raises
    ------
    InputError : the file cannot be read, or is no such structure, at rest where states and inputs are 0.
    """
    file = read_plant_file(path)
    table, states = file.table("dynamics"), [str(name) for name in file.data.get("states", ())]
    unknowns = unknowns_in(file, [*states, *map(str, file.data.get("inputs", ()))], states)
    twice = next((one.state for one in unknowns if one.state in table), None)
    if twice is not None:
        raise file.refuse("must have an equation or a table [unknown], not both.", "dynamics", twice)
    known = {key: value for key, value in file.data.items() if key != "unknown"}
    zeros = {**known, "dynamics": {**table, **{one.state: "0" for one in unknowns}}}
    system = build_system(replace(file, data=zeros))
    if any(system.exact_x_eq()) or any(system.exact_u_eq()):
        raise file.refuse("a structure with unknown functions must have x_eq and u_eq 0; found another.", "x_eq")
    return unknowns, system


def _fitted(one: Unknown, taken: Sampled, noise: Fraction, system: System, degree: int, near_origin: float) -> Fitted:
    if noise < 0:
        raise InputError(f"the bound of the noise must be at least 0; found {float(noise):g} for {one.state}.")
    axes = axes_of(taken)
    one = boxed(system, one, axes)
    require_within(system, one, noise)
    sampling = Sampling(one, taken.within(one.box), noise)
    grid = enclosed(sampling, near_origin)
    if grid.axes == axes:
        require_possible(one, grid, noise)
    p = fitted(one, grid, degree)
    if grid.axes != axes:
        require_consistent(sampling, p)
    sizes = [max(abs(lo), abs(hi)) for lo, hi in (bounds_of(system)[name] for name in one.variables)]
    each = errors(p, one, grid)
    a = tuple((slope.lo, slope.hi) for slope in sampling.slopes())
    more = Missing() if grid.axes == axes else missing(p, grid, each, noise)
    bound, beyond = bounded(one, each, near_origin), residual_text(one, sizes)
    return Fitted(sampling, len(taken.points), grid, p, bound, max(each.values()), a, beyond, more)


def _sides(one: Unknown) -> str:
    """The box as a table of TOML."""
    return ", ".join(f'{v} = ["{lo}", "{hi}"]' for v, (lo, hi) in zip(one.variables, one.box, strict=True))


def _sum(one: Fitted) -> str:
    """The linear part as an equation."""
    return " + ".join(f"{slope_name(one.unknown.state, v)}*{v}" for v in one.unknown.variables)


def _text(text: str, equations: Mapping[str, tuple[str, str]], ranges: Mapping[str, Interval], source: str) -> str:
    """The structure's text with these equations, residuals and ranges."""
    kept = _into(text.splitlines(), "dynamics", [f'{state} = "{e}" # {source}' for state, (e, _) in equations.items()])
    if ranges:
        kept = _into(kept, "parameters", [f"{name} = {_decimals(pair)}" for name, pair in ranges.items()])
    lacking = [f'{state} = "{bound}"' for state, (_, bound) in equations.items() if bound != "0"]
    return "\n".join([*_into(kept, "residual", lacking), ""])


def _into(lines: Sequence[str], section: str, entries: Sequence[str]) -> list[str]:
    """The lines with entries at the beginning of a table, which is made at the end if there is none."""
    at = next((k for k, line in enumerate(lines) if re.fullmatch(rf"\s*\[{section}\]\s*(#.*)?", line)), None)
    if at is None:
        return [*lines, "", f"[{section}]", *entries]
    return [*lines[: at + 1], *entries, *lines[at + 1 :]]


def _decimals(pair: Interval) -> str:
    """A range that holds this one, of decimals."""
    lo, hi = pair[0] * 10**9 // 1, -(-pair[1] * 10**9 // 1)
    hi = hi if hi > lo else lo + 1
    return "[" + ", ".join(f"{'-' if q < 0 else ''}{abs(q) // 10**9}.{abs(q) % 10**9:09d}" for q in (lo, hi)) + "]"


def _write(path: Path, text: str) -> None:
    """Write a plant's file, after it has been read again."""
    with tempfile.TemporaryDirectory(prefix="certify-") as folder:
        copy = Path(folder) / path.name
        copy.write_text(text, encoding="utf-8")
        load_system(copy)
    write_atomically(path, text.encode())
