"""Measurements of a plant whose parameters are known by them alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from certify.errors import InputError

Array = NDArray[np.float64]
Interval = tuple[Fraction, Fraction]


class Axis(NamedTuple):
    """A quantity `at + sum_k by_k p_k` of the parameters, in the order of their priors."""

    name: str
    at: Fraction
    by: tuple[Fraction, ...]


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
    axes : where there are some, these are uncertain quantities of the plant, in which it is written in place of the
        parameters.

    Raises
    ------
    InputError : shapes do not match, a number is not finite, the noise is negative, or no parameter has a prior.
    """

    priors: Mapping[str, Interval]
    period: Interval | None
    noise: tuple[Fraction, ...]
    runs: tuple[Run, ...]
    sha256: str
    axes: tuple[Axis, ...] = ()

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
        return replace(self, runs=tuple(found))

    @property
    def constants(self) -> tuple[str, ...]:
        """The uncertain quantities of the plant that are constant: the axes, or the parameters themselves."""
        return tuple(axis.name for axis in self.axes) or tuple(self.priors)


def _stretches(marked: Sequence[bool] | NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
    """First and behind the last of each unbroken stretch of marks."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], np.asarray(marked), [False]]).astype(int)))
    yield from zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
