"""A person's changes of a plant, as one value, and the one place where they are put into the plant."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from fractions import Fraction
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

from certify.analysis.declaration import option
from certify.errors import InputError, OptionError

if TYPE_CHECKING:
    from certify.loop.plants import System
    from certify.loop.plants.system import Interval

    Changes = Mapping[str, Fraction | Interval]


@dataclass(frozen=True, slots=True, kw_only=True)
class PlantChanges:
    """Changes of a plant: values and ranges of its parameters, its domain, what acts on it, when its input changes,
    what trajectories have to keep.

    The fields are the tables and options of a study; None changes nothing.
    """

    # fmt: off
    parameters: Changes | None = option(
        None, "loop", "ranges", typed="--param", keyword="ranges", metavar="NAME=VALUE", first=True, help=(
        "Parameters of the plant; if one has a range, the claim holds for every function of time in it."),
        written="A value, in place of a range that the file has, or a range NAME=LO..HI; repeatable.",
        python="Pairs (lo, hi) by parameter; a parameter whose value is outside its range takes the middle.")
    domain: Changes | None = option(None, "loop", "ranges", keyword="", metavar="NAME=D", first=True, help=(
        "Domain of a state, outside of which nothing is proved."),
        written="A half-width, or an interval NAME=LO..HI of its values; repeatable.")
    disturbances: Changes | None = option(None, "loop", "ranges", typed="--disturbance", metavar="NAME=D", help=(
        "Disturbances that act, as any function of time between their bounds; with the half-width 0 one does not act."),
        written="A half-width, or a range NAME=LO..HI; repeatable.",
        python="Half-widths, or pairs (lo, hi), by disturbance.")
    input_error: Fraction | Mapping[str, Fraction] | None = option(None, "loop", "bounds", metavar="E", help=(
        "Bound of the difference between what the policy says and what acts on the plant, at any time."),
        written="One for all inputs, or NAME=E,NAME=E.", python="One bound for all inputs, or bounds by input.")
    sample_time: Fraction | Interval | None = option(None, "loop", "period", metavar="PERIOD", help=(
        "Period over which the input is held; by default the input follows the state at once."),
        written="As in 0.02. LO..HI: any sequence of periods between the two. max: the longest period for which the "
        "set that is proved without one is still proved.",
        python="A period, or a pair (lo, hi) for any sequence of periods between the two.")
    keep: tuple[str, ...] | None = option(None, "loop", "comparisons", metavar="COMPARISON", help=(
        "A constraint that has to hold along every trajectory, at all times: a comparison of the values of states and "
        "inputs, with parameters and disturbances."),
        written="As in 'p <= 1.5' or 'force: abs(F) <= 8', which names it; repeatable.",
        python="A comparison or several, as text.")
    avoid: tuple[str, ...] | None = option(None, "loop", "comparisons", metavar="COMPARISON", help=(
        "States that no trajectory may meet: those at which the comparison holds."),
        written="As in '(x - 1)**2 + y**2 < 0.25'; repeatable.",
        python="A comparison or several, as text.")
    data: str | PathLike[str] | None = option(None, "loop", "file", metavar="FILE", varies=False, help=(
        "Measured transitions of which the plant's file has the table [data], or samples of which it has the table "
        "[samples]: the claim then is for every constant value of its parameters, or for every function, with which "
        "they are consistent."),
        written="The file that certify identify or certify fit has read.")
    # fmt: on

    def of(self, plant: System) -> System:
        """The plant with these changes.

        Raises
        ------
        InputError : the plant has no such parameter, disturbance, state or input, or cannot have what is asked for.
        """
        given = self.parameters or {}
        _require_known(plant, "parameter", given, plant.parameters)
        plant = plant.with_parameters({name: q for name, q in given.items() if not isinstance(q, tuple)})
        plant = plant.with_ranges({name: q if isinstance(q, tuple) else None for name, q in given.items()})
        plant = plant.with_domain(self._domain(plant)).with_ranges(self._acting(plant))
        if self.keep or self.avoid:
            from certify.loop.plants import with_constraints

            plant = with_constraints(plant, self.keep or (), self.avoid or ())
        if (error := self.input_error) is not None:
            from certify.loop.plants import with_input_errors

            bounds = error if isinstance(error, Mapping) else {s.name: error for s in plant.inputs}
            plant = with_input_errors(plant, bounds)
        if self.data is not None:
            from certify.analysis.identifying.run import with_data

            plant = with_data(plant, Path(self.data))
        held = self.sample_time
        lo, hi = held if isinstance(held, tuple) else (held, held)
        if lo is not None and hi is not None and not (0 <= lo <= hi and hi > 0):
            found = f"{float(lo):g}..{float(hi):g}" if isinstance(held, tuple) else f"{float(lo):g}"
            raise OptionError(f"`sample_time` must be a positive time, or a range with 0 <= LO <= HI; found {found}.")
        return plant if held is None else plant.with_sample(held if isinstance(held, tuple) else (held, held))

    def _domain(self, plant: System) -> Mapping[str, Interval]:
        """Intervals of deviations from the operating point."""
        found, at = dict[str, "Interval"](), plant.operating_point()
        for state, ends in (self.domain or {}).items():
            shift = at.get(state, Fraction(0))
            found[state] = (ends[0] - shift, ends[1] - shift) if isinstance(ends, tuple) else (-ends, ends)
        return found

    def _acting(self, plant: System) -> Mapping[str, Interval | None]:
        """Ranges of disturbances; None of one that does not act."""
        given, found = self.disturbances or {}, dict[str, "Interval | None"]()
        _require_known(plant, "disturbance", given, [s.name for s in plant.disturbances])
        for name, value in given.items():
            if not isinstance(value, tuple) and value < 0:
                raise InputError(
                    f"disturbance {name} must have a half-width that is not negative, or a range; found "
                    f"{float(value):g}."
                )
            found[name] = value if isinstance(value, tuple) else (-value, value) if value else None
        return found


def _require_known(plant: System, what: str, names: Iterable[str], known: Iterable[str]) -> None:
    for name in names:
        if name not in known:
            raise InputError(f"{plant.name} has no {what} {name!r}; it has: {', '.join(known) or 'none'}.")
