"""`certify.identify`: the command `certify identify` for Python."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping, Sequence
from fractions import Fraction
from pathlib import Path

from certify.analysis.identifying.linear import LinearStructure, linear_structure, structure_for
from certify.analysis.identifying.run import IdentifyResult, identify_plant, read_and_measure
from certify.analysis.values import bounds_in, path_in, period_in
from certify.certificates import write_atomically
from certify.errors import InputError
from certify.loop.plants import System, load_system
from certify.loop.plants.system import Interval
from certify.report.identified import page

Exact = Fraction | float | int | str
"""A number: text means its decimal value, a float its binary value."""


def identify(
    data: str | os.PathLike[str],
    structure: str | os.PathLike[str] | System | LinearStructure,
    *,
    noise: Exact | Mapping[str, Exact],
    sample_time: Exact | Sequence[Exact] | None = None,
    out: str | os.PathLike[str] | None = None,
    rotate: bool = False,
) -> IdentifyResult:
    """Bound a plant's unknown parameters by measured transitions.

    Parameters
    ----------
    data : a file .csv, .npz or .parquet; see `certify.analysis.tables`.
    structure : a plant's file, or a `System`, in which each unknown parameter has a range, its prior; or a
        `LinearStructure`, of which no equation is known.
    noise : a bound of the error of each measured state, in its units: one for all, or by state.
    sample_time : the time of a transition, or a pair (lo, hi) in which it lies; None in discrete time.
    rotate : True for a plant in axes along which parameters are bounded closely, where sums of them are.
    out : a .toml file for the plant with the ranges that are left, with a page beside it; it needs a structure in a
        file.

    Returns
    -------
    IdentifyResult : `result.system` is the plant with its ranges and measurements, which `certify_roa` takes:
        the claim is then about every constant parameter that is consistent with them.

    Raises
    ------
    Contradiction : no parameter within the priors is consistent with the measurements; an `InputError`, with the
        `transitions` that show it.
    InputError : an argument, the file or the plant cannot be used.
    """
    path, given, bounds = Path(path_in(data, "data")), structure, bounds_in(noise, "noise")
    period = None if sample_time is None else period_in(sample_time, "sample_time")
    if isinstance(given, LinearStructure):
        given = _of_linear(path, given, out, period, bounds)
    system = given if isinstance(given, System) else load_system(Path(path_in(given, "structure")))
    target = None if out is None else Path(path_in(out, "out"))
    if target is not None and (isinstance(given, System) or target.suffix != ".toml"):
        raise InputError("`out` must be a .toml file, and needs the structure's file, whose text it takes over.")
    measured, readings = read_and_measure(path, system, period, bounds)
    source = None if isinstance(given, System) else Path(path_in(given, "structure"))
    result = identify_plant(measured, readings, path.name, source, target, rotate)
    if target is not None:
        write_atomically(target.with_suffix(".html"), page(result.residuals(), result.to_dict()).encode())
    return result


def _of_linear(
    data: Path,
    linear: LinearStructure,
    out: str | os.PathLike[str] | None,
    period: Fraction | Interval | None,
    noise: Fraction | Mapping[str, Fraction],
) -> System | Path:
    """The structure's plant, or its file beside `out`."""
    if out is not None:
        return structure_for(data, Path("linear"), linear, Path(path_in(out, "out")), period, noise)
    with tempfile.TemporaryDirectory(prefix="certify-") as folder:
        path = Path(folder) / "linear.toml"
        path.write_text(linear_structure(data, linear, period, noise), encoding="utf-8")
        return load_system(path)
