"""The options of a proof that a region is reached, and the region in a plant's own terms."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

from certify.certificates.claims import MOST_RANK, MOST_TARGETS
from certify.certificates.ellipsoids import Box
from certify.errors import InputError, OptionError
from certify.loop.expressions import Expression, Number, Symbol, substitute, symbols_of
from certify.loop.plants import System, in_deviations
from certify.loop.plants.equations import parse_comparison


@dataclass(frozen=True, slots=True, kw_only=True)
class ReachOptions:
    """The options of a run.

    Parameters
    ----------
    target : comparisons of the states' values by <= or >=, all of which hold in the region; or one name of a file,
        *.json, a certificate whose set {V <= c2} is to be reached.
    begin : a box of states, in deviations, about which the verdict is; None for no box in particular.
    within : the most steps that it may take.
    effort, time_limit, jobs, cluster : as of `certify roa`.

    Raises
    ------
    OptionError : a number is not what it must be.
    """

    target: tuple[str, ...]
    begin: Box | None = None
    within: int | None = None
    effort: float = 1.0
    time_limit: float | None = None
    jobs: int | None = None
    cluster: str | None = None

    def __post_init__(self) -> None:
        if not 1 <= len(self.target) <= MOST_TARGETS:
            raise OptionError(f"`target` must be 1 to {MOST_TARGETS} comparisons; found {len(self.target)}.")
        if len(self.target) > 1 and any(map(is_file, self.target)):
            raise OptionError("`target` must be one certificate, or comparisons alone; found both, or several files.")
        if self.within is not None and not 1 <= self.within <= MOST_RANK:
            raise OptionError(f"`within` must be 1 to {MOST_RANK:,} steps; found {self.within}.")

    @property
    def certificate(self) -> Path | None:
        """The file whose set is to be reached; None for comparisons."""
        return Path(self.target[0]) if is_file(self.target[0]) else None


def is_file(target: str) -> bool:
    """True for a target that names a certificate."""
    return target.endswith(".json")


def steps_within(text: str, system: System) -> int:
    """The number of steps that `within` says: as it stands, or as many as a time in seconds, as in `2.5s`, has of the
    longest period.

    Raises
    ------
    OptionError : it is neither, or no period is as short as that time, or steps of the loop take no time.
    """
    found = re.fullmatch(r"(?P<number>\d{1,9}(?:\.\d{1,9})?)\s*(?P<unit>s?)", text.strip())
    if found is None or (not found["unit"] and "." in found["number"]):
        raise OptionError(f"`within` must be a number of steps, or a time such as 2.5s; found {text!r}.")
    if not found["unit"]:
        return int(found["number"])
    if system.sample is None:
        raise OptionError(f"`within` must be a number of steps, which in {system.name} take no time; found {text!r}.")
    steps = int(Fraction(found["number"]) / system.sample[1])
    if not steps:
        raise OptionError(f"`within` must be at least a period, {float(system.sample[1]):g} s; found {text!r}.")
    return steps


def target_of(system: System, texts: Sequence[str]) -> tuple[Expression, ...]:
    """The expressions, in deviations from the operating point, that are at most 0 in the region.

    Raises
    ------
    OptionError : a text is no comparison by <= or >= of expressions in states and parameters.
    """
    return tuple(_expression(system, text) for text in texts)


def _expression(system: System, text: str) -> Expression:
    shown = " ".join(text.split())
    known = [*system.states, *map(Symbol, system.parameters)]
    try:
        sides = parse_comparison(text, {s.name: s for s in known}, "state or parameter")
    except InputError as error:
        raise OptionError(f"`target`: {str(error).replace('constraint ', '', 1)}") from error
    if sides is None or re.search(r"[<>](?!=)", text):
        raise OptionError(
            f"`target` takes a comparison by <= or >=, whose ends belong to the region, such as 'position >= 0.45'; "
            f"found {shown!r}."
        )
    (t,) = in_deviations([sides[0] - sides[1]], system.states, system.x_eq)
    odd = symbols_of(t) & {s for s, _ in system.uncertain}
    if odd or not symbols_of(t) & set(system.states):
        names = ", ".join(s.name for s in system.states)
        raise OptionError(f"`target` must be of states, {names}, and of parameters without a range; found {shown!r}.")
    return substitute(t, {Symbol(name): Number(q) for name, q in system.parameters.items()})


def in_words(texts: Sequence[str]) -> str:
    """The region as it was written."""
    return " and ".join(" ".join(text.split()) for text in texts)
