"""`identify`: measured transitions and a structure with priors become a plant with the ranges that are left."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from certify.analysis.identifying.reading import Readings, read_data
from certify.analysis.identifying.writing import rounded, write_known
from certify.errors import InputError, OptionError
from certify.loop.expressions import Symbol, differentiate, symbols_of
from certify.loop.plants import Measurements, System
from certify.loop.plants.system import Interval
from certify.report.identified import Residuals

if TYPE_CHECKING:
    from certify.analysis.identifying.determined import Direction
    from certify.provers.data import Identified, Least

SCHEMA = "certify-identify/1"
_NARROWED = 1.01  # least factor by which a prior that is narrowed becomes smaller
Tell = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class IdentifyResult:
    """A plant with the ranges that measurements leave of its parameters.

    Parameters
    ----------
    system : the plant, with ranges rounded outwards, and with all measurements, which `certify_roa` makes a part of its
        claim; along axes where these were asked for and are closer.
    known : the same without axes.
    smaller : the factor by which the axes' box is smaller than the ranges'; 1 without axes.
    ranges : of the parameters that had a prior range, before they were rounded.
    readings : the file's runs.
    source : the file's name.
    shown_by : for each parameter the transitions, by their numbers, that count most.
    least_determined : the direction in the space of parameters in which most is left; None if it was not found.
    least_noise : a factor: noise smaller than so many times the declared one contradicts the measurements; None
        without noise.
    least_residual : factors of the bounds in the structure's table `residual`, of all and of each; none without it.
    found : all that the prover says.
    seconds : spent on it.
    plant : the file that was written, None without one.
    """

    system: System
    known: System
    smaller: float
    ranges: Mapping[str, Interval]
    readings: Readings
    source: str
    shown_by: Mapping[str, tuple[int, ...]]
    least_determined: Direction | None
    least_noise: float | None
    least_residual: tuple[Least, ...]
    found: Identified = field(repr=False)
    seconds: float
    plant: Path | None = None

    @property
    def measurements(self) -> Measurements:
        """All measurements, with the priors."""
        if self.system.measurements is None:
            raise InputError("an identified plant must have measurements.")
        return self.system.measurements

    def shrink(self, name: str) -> float:
        """The factor by which a parameter's range is smaller than its prior."""
        (a, b), (lo, hi) = self.measurements.priors[name], self.known.ranges[name]
        return float((b - a) / (hi - lo))

    def not_narrowed(self) -> tuple[str, ...]:
        """The parameters whose priors are left as they are."""
        return tuple(name for name in self.measurements.priors if self.shrink(name) < _NARROWED)

    def next_step(self) -> str:
        """The advice where some priors are not narrowed, by whether the equations are linear in the parameters."""
        parameters = [Symbol(name) for name in self.measurements.priors]
        slopes = [differentiate(e, p) for e in self.known.dynamics for p in parameters]
        if symbols_of(*slopes) & {*parameters}:
            return (
                "the equations are not linear in the parameters: write each quotient or product of some as one "
                "parameter, as in a = R/L, or narrow the priors"
            )
        return "measure where states or inputs beside them are larger, or more often"

    def at(self, transition: int) -> str:
        """The measured state and the input of a transition, in words."""
        for states, inputs in self.measurements.runs:
            if transition < len(inputs):
                values = [*states[transition], *inputs[transition]]
                names = [*self.system.states, *self.system.inputs]
                return ", ".join(f"{s} = {v:.4g}" for s, v in zip(names, values, strict=True))
            transition -= len(inputs)
        raise InputError("there must be a transition of this number.")

    def residuals(self) -> Residuals:
        """The measured ends of transitions against predicted ones, in the ranges that are left."""
        rows, system, data = self.found.rows, self.system, self.measurements
        noise = np.array([float(w) for w in data.noise])
        reach = rows.slack + np.abs(rows.slopes).sum(1) + noise[:, None]
        names = [s.name for s in system.states]
        units = [system.units.get(name, "") for name in names]
        return Residuals(tuple(names), tuple(units), -rows.alpha, reach, self.found.used)

    def to_dict(self) -> dict[str, Any]:
        """The JSON object of `certify identify --json`."""
        system, data, axis = self.known, self.measurements, self.least_determined
        return {
            "schema": SCHEMA,
            "verdict": "IDENTIFIED",
            "system": system.name,
            "data": data_in_json(self.source, self.readings) | {"used": int(self.found.used.sum())},
            "period": None if data.period is None else [str(h) for h in data.period],
            "noise": {s.name: str(w) for s, w in zip(system.states, data.noise, strict=True)},
            "not_narrowed": list(self.not_narrowed()),
            "parameters": [
                {
                    "name": name,
                    "unit": system.units.get(name, ""),
                    "prior": [str(q) for q in prior],
                    "left": [str(q) for q in self.ranges[name]],
                    "range": [str(q) for q in system.ranges[name]],
                    "shrink": self.shrink(name),
                    "shown_by": [self.readings.places[t] for t in self.shown_by[name]],
                }
                for name, prior in data.priors.items()
            ],
            "least_determined": None
            if axis is None
            else {
                "direction": dict(axis.entries),
                "share_of_priors": axis.share,
                "telling": self.readings.places[axis.telling],
            },
            "axes": {
                "smaller": self.smaller,
                "sums": {each.name: [str(q) for q in (each.at, *each.by)] for each in data.axes},
            },
            "least_noise": self.least_noise,
            "least_residual": sizes_in_json(self.least_residual),
            "rounds": len(self.found.bounds.rounds),
            "order": self.found.bounds.order,
            "pieces": self.found.bounds.pieces,
            "notes": list(self.readings.notes),
            "seconds": self.seconds,
            "plant": None if self.plant is None else str(self.plant),
        }


def data_in_json(source: str, readings: Readings) -> dict[str, Any]:
    """A file of measurements as plain values."""
    return {
        "file": source,
        "sha256": readings.sha256,
        "runs": len(readings.runs),
        "transitions": len(readings.places),
    }


def sizes_in_json(each: Sequence[Least]) -> list[dict[str, Any]]:
    """Sizes of residuals as plain values."""
    return [{"refuted": dict(one.refuted), "open": None if one.open is None else dict(one.open)} for one in each]


def residuals_of_refuted(measured: System) -> dict[str, list[dict[str, Any]]]:
    """The least residuals of a structure that its measurements refute, as plain values.

    `least_residual` has a factor of its bounds in the table `residual`; `least_constants` has constant bounds, of a
    structure without that table.
    """
    from certify.provers.data import least_of_refuted, residual_states

    if measured.measurements is None:
        raise InputError("a structure must have measurements that refute it.")
    found = sizes_in_json(least_of_refuted(measured, measured.measurements))
    factors = bool(residual_states(measured))
    return {"least_residual": found if factors else [], "least_constants": [] if factors else found}


def measured_plant(
    system: System,
    readings: Readings,
    period: Fraction | Interval | None,
    noise: Fraction | Mapping[str, Fraction],
) -> System:
    """A structure with its measurements; its parameters' ranges are the priors.

    Raises
    ------
    InputError : no parameter has a range, a state has no noise, or the period does not suit the plant's time.
    """
    if system.measurements is not None:
        raise InputError(f"{system.name} must have no table [data] yet: a structure has priors alone.")
    priors = {name: pair for name, pair in system.ranges.items() if name in system.parameters}
    if not priors:
        raise InputError(
            f"{system.name} must have a range for each parameter that is not known, as in m = [0.1, 0.3] of "
            "[parameters]; found none."
        )
    names = [s.name for s in system.states]
    bounds = noise if isinstance(noise, Mapping) else dict.fromkeys(names, noise)
    odd, missing = [s for s in bounds if s not in names], [s for s in names if s not in bounds]
    if odd or missing:
        what = f"{odd[0]} is no state" if odd else f"{', '.join(missing)} is missing"
        raise OptionError(f"`noise` takes a bound for each of {', '.join(names)}; {what}.")
    if min(bounds.values()) < 0:
        raise OptionError("`noise` must be at least 0.")
    if (period is None) is not (system.time == "discrete"):
        what = "must be left out: a transition is a step of" if system.time == "discrete" else "must be given for"
        raise OptionError(f"`sample_time` {what} {system.name}, whose time is {system.time}.")
    pair = (period, period) if isinstance(period, Fraction) else period
    if pair is not None and not 0 < pair[0] <= pair[1]:
        raise OptionError("`sample_time` must be a positive time, or a range LO..HI of them.")
    data = Measurements(priors, pair, tuple(bounds[s] for s in names), readings.runs, readings.sha256)
    return replace(system, measurements=data)


def identify_plant(
    measured: System,
    readings: Readings,
    source: str,
    structure: Path | None = None,
    out: Path | None = None,
    rotate: bool = False,
) -> IdentifyResult:
    """The ranges that measurements leave, and with a file `out` the plant that has them; with `rotate` along axes where
    their box is smaller.

    Parameters
    ----------
    measured : the structure with its measurements, as `measured_plant` makes it.
    source : the name of the file of measurements.
    structure : the structure's file, whose text the plant's takes over.

    Raises
    ------
    Contradiction : no parameter within the priors is consistent with the measurements.
    InputError : the flow has no enclosure, the measurements narrow no prior, or the file cannot be written.
    """
    from certify.analysis.identifying.determined import polytope_of, showing
    from certify.analysis.identifying.rotated import axes_for
    from certify.loop.plants.axes import along_axes
    from certify.provers.data import identify, least_factors

    start, data = time.perf_counter(), measured.measurements
    if data is None:
        raise InputError("a structure must have measurements to be identified.")
    found = identify(measured, data, narrows=not rotate)
    ranges = rounded(found.ranges, data.priors)
    plant = measured.with_parameters({name: (lo + hi) / 2 for name, (lo, hi) in ranges.items()}).with_ranges(ranges)
    if list(plant.ranges) != list(measured.ranges):
        plant = replace(plant, ranges={name: plant.ranges[name] for name in measured.ranges})
    left, (axes, smaller) = polytope_of(found), axes_for(found) if rotate else ((), 1.0)
    known, plant = plant, along_axes(replace(plant, measurements=replace(data, axes=axes)))
    if axes and not _holds(plant):
        smaller, plant = 1.0, along_axes(replace(known, measurements=replace(data, axes=())))
    if out is not None and structure is not None:
        write_known(out, structure, replace(known, measurements=plant.measurements), source)
    return IdentifyResult(
        system=plant,
        known=known,
        smaller=smaller,
        ranges=dict(found.ranges),
        readings=readings,
        source=source,
        shown_by=showing(found),
        least_determined=left.least_determined(),
        least_noise=left.least_noise(),
        least_residual=least_factors(measured, data, found),
        found=found,
        seconds=time.perf_counter() - start,
        plant=out,
    )


def _holds(plant: System) -> bool:
    """True unless the measurements, in another run, leave more of a plant than the ranges along its axes."""
    from certify.provers.data import identify

    data = plant.measurements
    found = {} if data is None else identify(plant, data).turned
    return all(-1 <= lo <= hi <= 1 for lo, hi in found.values())


def with_data(system: System, path: Path, tell: Tell = lambda _: None) -> System:
    """A plant whose file has a table `data` or `samples`, with the measurements or samples of that file.

    Raises
    ------
    InputError : the plant has no such table, or the file is another one or cannot be read.
    """
    stated = system.measurements
    if system.samples is not None and stated is None:
        from certify.analysis.fitting.samples import with_samples

        return with_samples(system, system.samples, path)
    if stated is None:
        raise InputError(
            f"{system.name} must have a table [data] that says what its data are; certify identify writes such a plant."
        )
    readings = read_data(path, system)
    if readings.sha256 != stated.sha256:
        raise InputError(
            f"data file {path} must be the one from which the plant was identified, of sha256 {stated.sha256}; found "
            f"{readings.sha256}. For other data run certify identify again."
        )
    for note in readings.notes:
        tell(note)
    return replace(system, measurements=replace(stated, runs=readings.runs))


def read_and_measure(
    path: Path,
    system: System,
    period: Fraction | Interval | None,
    noise: Fraction | Mapping[str, Fraction],
) -> tuple[System, Readings]:
    """A structure with the measurements of a file, and the file's readings.

    Raises
    ------
    InputError : as `read_data` and `measured_plant` say.
    """
    readings = read_data(path, system)
    return measured_plant(system, readings, period, noise), readings
