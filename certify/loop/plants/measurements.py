"""Measurements of a plant whose parameters are known by them alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from certify.errors import InputError

Array = NDArray[np.float64]
Interval = tuple[Fraction, Fraction]


class Run(NamedTuple):
    """A run: measured states (T + 1, n), one after the other, and the inputs (T, m) that are held in between."""

    states: Array
    inputs: Array


@dataclass(frozen=True, slots=True, eq=False)
class Measurements:
    """Measured transitions of a plant whose parameters are only known to lie in their priors.

    Parameters
    ----------
    priors : the parameters, uncertain quantities of the plant, with the ranges that are assumed.
    period : shortest and longest time that a transition takes, in units of time; None in discrete time.
    noise : n numbers; each measured state is within these of the true one, in the states' units.
    runs : what was measured, in the states' own values, not in deviations; none where only the file is known.
    sha256 : of the file that they come from, 64 hexadecimal digits.

    Raises
    ------
    InputError : shapes do not match, a number is not finite, the noise is negative, or no parameter has a prior.
    """

    priors: Mapping[str, Interval]
    period: Interval | None
    noise: tuple[Fraction, ...]
    runs: tuple[Run, ...]
    sha256: str

    def __post_init__(self) -> None:
        if not self.priors:
            raise InputError("measurements must be of a plant of which a parameter has a prior range.")
        n = len(self.noise)
        for number, (states, inputs) in enumerate(self.runs):
            if states.ndim != 2 or states.shape[1] != n or len(inputs) != len(states) - 1 or not len(inputs):
                raise InputError(
                    f"run {number} must have states of shape (T + 1, {n}) and T inputs, T at least 1; found "
                    f"{states.shape} and {inputs.shape}."
                )
            if not (np.all(np.isfinite(states)) and np.all(np.isfinite(inputs))):
                raise InputError(f"run {number} must have finite numbers only.")
        if min(self.noise) < 0:
            raise InputError("noise must be at least 0 in each state.")

    @property
    def transitions(self) -> int:
        """The number of transitions."""
        return sum(len(run.inputs) for run in self.runs)

    def only(self, used: NDArray[np.bool_]) -> Measurements:
        """The same with the transitions alone that are marked, (T,); runs are cut where one is missing."""
        found, first = list[Run](), 0
        for states, inputs in self.runs:
            own = used[first : first + len(inputs)]
            found += [Run(states[a : b + 1], inputs[a:b]) for a, b in _stretches(own)]
            first += len(inputs)
        return Measurements(self.priors, self.period, self.noise, tuple(found), self.sha256)


def _stretches(marked: Sequence[bool] | NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
    """First and behind the last of each unbroken stretch of marks."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], np.asarray(marked), [False]]).astype(int)))
    yield from zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
