"""The words about time in a claim's sentences: they depend on the closed loop's timing and on the claimed rate.

Each text of a report that depends on this takes its words from here, so that no text has to be written once for every
kind of claim.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from fractions import Fraction
from typing import Any, Self

from certify.certificates.timing import PERCENT, Timing
from certify.report.words import above, below, exact_number, inside


class TimingInWords(Timing):
    """A timing that says itself."""

    __slots__ = ()

    @classmethod
    def of_result(cls, result: Mapping[str, Any]) -> Self:
        """The timing in the object of `certify roa --json`; a missing entry means continuous time without a rate."""
        claim = result.get("claim") or {}
        sample = claim.get("sample")
        ends = None if sample is None else (Fraction(sample[0]), Fraction(sample[1]))
        return cls(result.get("time") == "discrete", ends, float(claim.get("rate") or 0.0))

    @property
    def unit(self) -> str:
        """The unit of time."""
        return "steps" if self.discrete else "s"

    @property
    def axis(self) -> str:
        """The label of a picture's time axis."""
        return "steps" if self.discrete else "time (s)"

    @property
    def periods(self) -> str:
        """The periods over which the input is held, such as `exactly 0.02 s`; empty if it is not held.

        >>> TimingInWords(sample=(Fraction(1, 50), Fraction(1, 50))).periods
        'exactly 0.02 s'
        >>> TimingInWords(sample=(Fraction(0), Fraction(1, 50))).periods
        'any sequence of periods up to 0.02 s'
        """
        if self.sample is None:
            return ""
        lo, hi = self.sample
        if lo == hi:
            return f"exactly {exact_number(hi)} s"
        return f"any sequence of periods {f'in {inside(lo, hi)}' if lo else f'up to {below(hi)}'} s"

    @property
    def linearised(self) -> str:
        """The map whose eigenvalues are meant, in words; empty in continuous time."""
        if self.sample is not None:
            return f" over a period of {exact_number(self.sample[1])} s"
        return " over a step" if self.discrete else ""

    @property
    def over_what(self) -> str:
        """The time over which V has to fall; empty if that is every instant."""
        return " over a period" if self.sample is not None else " in a step" if self.discrete else ""

    @property
    def loop(self) -> str:
        """The words after the equation `dx/dt = f(...)` or `x+ = f(...)`."""
        if self.discrete:
            return "in exact real arithmetic, one step after the other"
        if self.sample is None:
            return "in exact real arithmetic and continuous time"
        lo, hi = self.sample
        apart = f"tₖ₊₁ − tₖ = {exact_number(hi)} s" if lo == hi else f"tₖ₊₁ − tₖ {self.each()[len(' and every h ') :]}"
        return f"for t from tₖ to tₖ₊₁, {apart}, in exact real arithmetic and continuous time"

    @property
    def derivative(self) -> str:
        """The symbol of V's change per unit of time, the margin without a rate."""
        return "V̇" if self.is_plain else "D"

    @property
    def decrease(self) -> str:
        """The symbol of the margin."""
        return f"{self.derivative} + 2λV" if self.rate else self.derivative

    @property
    def definition(self) -> str:
        """The definition of D; empty in continuous time."""
        if self.discrete:
            return "D(x) = V(F(x)) − V(x), F(x) = f(x, π(x)): by how much V changes in a step."
        if self.sample is None:
            return ""
        lo, hi = self.sample
        which = f"{exact_number(hi)} s" if lo == hi else "any of the periods"
        return (
            "D(x) = (V(φ(h)) − V(x))/h: by how much V changes over a period, by time, where φ(h) is the state that x "
            f"has become when the input has been held at π(x) for h = {which}{'' if lo else '; V̇ at h = 0'}."
        )

    @property
    def definitions(self) -> str:
        """The definitions of D and lambda, as far as the conditions use them."""
        rate = f"λ = {self.shown_rate} is the rate, rounded down here." if self.rate else ""
        return f"{self.definition} {rate}".strip()

    @property
    def shown_rate(self) -> str:
        """The rate, rounded down: V is claimed to fall at least as fast."""
        return f"{below(self.rate)} {self.per_time}"

    @property
    def per_time(self) -> str:
        """The unit of a rate, after a number."""
        return "per step" if self.discrete else "per s"

    def each(self, *, proper: bool = False) -> str:
        """For which periods a condition on D holds; one on what is reached is not asked of a `proper` period of 0."""
        if self.sample is None or self.sample[0] == self.sample[1]:
            return ""
        lo, hi = self.sample
        if lo:
            return f" and every h in {inside(lo, hi)} s"
        return f" and every h {'above 0' if proper else 'from 0'} {'up ' * proper}to {below(hi)} s"

    def speed(self, inner: float | None, outer: float) -> str:
        """The consequence of a rate for trajectories, after the statement of the claim; empty without a rate.

        Parameters
        ----------
        inner, outer : levels c0 and c2 of a practical claim; of an asymptotic one `inner` is None.
        """
        if not self.rate:
            return ""
        bound, when = self._bound(all_times=inner is None)
        time = self.time_to_fall(PERCENT if inner is None else Fraction(outer) / Fraction(inner))
        value = f" = {above(time)} {self.unit}" if math.isfinite(time) else ""
        until = "" if inner is None else " until it is in the smaller set"
        said = f" Moreover {bound}{until}, with λ = {self.shown_rate}: "
        if inner is not None:
            return f"{said}it is there {when.format(f'ln(c₂/c₀)/(2λ){value}')}."
        return (
            f"{said}V is at most 1 % of what it was {when.format(f'ln(100)/(2λ){value}')}, and for "
            f"c′ < c ≤ c₂ what starts in {{V ≤ c}} is in {{V ≤ c′}} {when.format('ln(c/c′)/(2λ)')}."
        )

    def _bound(self, *, all_times: bool) -> tuple[str, str]:
        """The inequality of V over time, and from when on something holds, with a place for the time.

        `all_times` says that it is asked for between sampling instants, too, if it holds there.
        """
        if self.discrete:
            return "V(xₖ) ≤ V(x₀) e^(−2λk) after k steps", "after {} at the latest, rounded up to whole steps"
        if self.is_plain:
            return "V(x(t)) ≤ V(x(0)) e^(−2λt)", "after {} at the latest"
        if self.from_zero and all_times:
            return "V(x(t)) ≤ V(x(t₀)) e^(−2λ(t − t₀)) at all later times", "after {} at the latest"
        bound = "V(x(tₖ)) ≤ V(x(t₀)) e^(−2λ(tₖ − t₀)) at the sampling instants tₖ"
        return bound, "at every sampling instant that comes {} or more after the start"

    def headline_rate(self) -> str:
        """The same in a line of the terminal."""
        if not self.rate:
            return ""
        return f", V falling at least as exp(-2*{below(self.rate)} {'k) in k steps' if self.discrete else 't)'}"


PLAIN = TimingInWords()
