"""Time in a closed loop, and the time after which a claim with a rate holds.

A claim says the same of every loop, but at other times: at all times of a loop in continuous time, at the sampling
instants if its input is held over a period, and at the steps of a loop in discrete time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from certify.loop.plants import System
    from certify.loop.plants.system import Interval

PERCENT = 100  # of V: the share of it after which a rate is told as a time


@dataclass(frozen=True, slots=True)
class Timing:
    """`discrete` time or not, the least and the largest period over which the input is held (`sample`; None if it
    follows the state at once), and the `rate` lambda at which V is claimed to fall (0: no rate)."""

    discrete: bool = False
    sample: Interval | None = None
    rate: float = 0.0

    @classmethod
    def of(cls, system: System, rate: float = 0.0) -> Self:
        """The timing of a plant, with the rate that is claimed."""
        return cls(system.time == "discrete", system.sample, rate)

    @property
    def is_plain(self) -> bool:
        """True if the input follows at once in continuous time."""
        return not self.discrete and self.sample is None

    @property
    def from_zero(self) -> bool:
        """True if the claim holds within each period as well, because each part of a period is an allowed period."""
        return self.sample is not None and self.sample[0] == 0

    @property
    def simulated(self) -> Self:
        """The timing that is simulated, with the longest of several periods."""
        return self if self.sample is None else replace(self, sample=(self.sample[1], self.sample[1]))

    def time_to_fall(self, factor: Fraction | int) -> float:
        """The longest time until V is divided by a factor of at least 1, rounded up; infinite without a rate.

        If the input is held, a sampling instant at which that is so comes within the longest period after it.
        """
        if not self.rate:
            return math.inf
        if factor <= 1:
            return 0.0
        time = math.nextafter(_log(Fraction(factor)) / self.rate / 2, math.inf)
        return float(math.ceil(time)) if self.discrete and math.isfinite(time) else time

    def reach_time(self, factor: Fraction | int) -> float | None:
        """The time after which V is certainly divided by the factor: in units of time, at a step, or at a sampling
        instant that has come by then. None without a rate, or if no number is as large."""
        time = self.time_to_fall(factor)
        if self.sample is not None:  # the next instant comes within a period
            time = math.nextafter(time + math.nextafter(float(self.sample[1]), math.inf), math.inf)
        return time if math.isfinite(time) else None


def reach_time(timing: Timing, floor: float | None, roa: float | None) -> float | None:
    """The time after which a trajectory from {V <= c2} is in {V <= c0}, `floor`; without a floor, after which V is at
    most a hundredth of its first value. None if nothing is claimed."""
    if roa is None:
        return None
    return timing.reach_time(PERCENT if floor is None else Fraction(roa) / Fraction(floor))


def _log(factor: Fraction) -> float:
    """The natural logarithm of a number above 1, rounded up."""
    try:
        # of the next number above the factor; the logarithm itself is off by less than two units in the last place
        value = math.log(math.nextafter(float(factor), math.inf))
    except OverflowError:
        value = (math.log(factor.numerator) - math.log(factor.denominator)) * (1 + 1e-12)
    for _ in range(3):
        value = math.nextafter(value, math.inf)
    return value
