"""Rule `keep` between two sampling instants, in both checkers: motions whose peak within a period is known, grazed from
both sides, and mutants of the rule that each let one of them pass."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import mpmath
import pytest

from certify.checker import flow as checker_flow
from certify.checker.boxes import Boxes
from certify.reference import motion as reference_motion
from certify.reference.motion import Motion
from tests.support.rank_forgeries import verdicts
from tests.support.ranked import Document, Loop, affine, two_bytes

KEPT, REFUSED = (None, None), ("keep", "keep")
WIDE = 2.0**-40  # half of the leaf's width
EVERYWHERE: list[Any] = [["-", "-8", "x"]]  # a target that all images lie in: what is refused is so by `keep`


@dataclass(frozen=True)
class Case:
    """Equations whose states start at `start`, and g, whose largest value in a period of at most `hi` is `peak`.
    It is shown with this much room: what the remainder of the series and terms of third order take."""

    dynamics: list[Any]
    start: tuple[float, ...]
    g: Any
    peak: Fraction
    order: int = 1
    hi: str = "1"
    uncertain: tuple[tuple[str, str, str], ...] = ()
    room: float = 1e-9

    def document(self, by: Fraction, lo: str | None = None) -> Document:
        """A certificate with the constraint that g is less than its peak and `by`."""
        loop = Loop(
            self.dynamics, [affine([[0.0] * len(self.start)], [1.0])], EVERYWHERE,
            states=("x", "v")[: len(self.start)], sample=(lo or self.hi, self.hi), order=self.order,
            uncertain=list(self.uncertain), keep=["-1", ["-", self.g, str(self.peak + by)]],
        )  # fmt: skip
        ends = ([v + sign * WIDE for v in self.start] for sign in (-1, 1))
        return loop.document(*ends, b"\xff", two_bytes([1]), bytes([1]))


def swung(gravity: float, angle: float, speed: float, hi: float) -> Fraction:
    """The largest angle of x'' = -gravity sin x from this angle, with this speed, before it is over."""
    with mpmath.workdps(30):
        path = mpmath.odefun(
            lambda _, y: [y[1], -gravity * mpmath.sin(y[0])], 0, [mpmath.mpf(angle), mpmath.mpf(speed)]
        )
        top = mpmath.findroot(lambda t: path(t)[1], 0.1)
        assert 0 < top < hi
        return Fraction(str(path(top)[0]))


FALLING = ["v", ["-", "u"]]  # u = 1: the top is at s = 1/2
CASES = {
    "held": Case(["u"], (0.0,), ["*", "x", ["-", "1", "x"]], Fraction(1, 4)),
    "until the end": Case(["u"], (0.0,), "x", Fraction(1)),
    "falling": Case(FALLING, (0.0, 0.5), "x", Fraction(1, 8), 2),
    "falling, a longer series": Case(FALLING, (0.0, 0.5), "x", Fraction(1, 8), 4),
    "pendulum": Case(["v", ["*", "-4", ["sin", "x"]]], (1.0, 0.5), "x",
                     swung(4.0, 1.0, 0.5, 0.25), 8, "1/4", room=1e-2),
    "mean": Case(["q"], (0.0,), "x", Fraction(1), uncertain=(("q", "-1", "1"),)),
    "mean and instant": Case(["q"], (0.0,), ["-", "x", "q"], Fraction(2), uncertain=(("q", "-1", "1"),)),
    "mean of a square": Case([["*", "q", "q"]], (0.0,), "x", Fraction(1), uncertain=(("q", "-1", "1"),), room=1e-6),
}  # fmt: skip
GROWING = Case(["x"], (1.0,), "x", Fraction(str(mpmath.exp(0.5))), 1, "1/2")


@pytest.mark.parametrize("jitter", [False, True])
@pytest.mark.parametrize("name", CASES)
def test_what_is_grazed_within_a_period_is_refused_and_what_is_kept_is_shown(name: str, jitter: bool) -> None:
    case = CASES[name]
    lo = str(Fraction(case.hi) / 2) if jitter else None
    for by in (1e-9, 1e-6, 1e-3):
        assert verdicts(case.document(-Fraction(by), lo)) == REFUSED
    assert verdicts(case.document(Fraction(case.room), lo)) == KEPT


@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_a_remainder_that_grows_is_counted(order: int) -> None:
    case = replace(GROWING, order=order)
    for by in (1e-9, 1e-6, 1e-3, 1e-2):
        assert verdicts(case.document(-Fraction(by))) == REFUSED
    assert verdicts(case.document(Fraction(8, 5) / order**3)) == KEPT


# ------------------------------------------------------------------------------------------------------------- mutants

VIOLATED = {
    "half": (CASES["until the end"], Fraction(-1, 4)),  # x = 1 is reached at the end alone
    "end": (CASES["falling"], Fraction(-1, 16)),  # the top is in the middle
    "symbols": (CASES["mean and instant"], Fraction(-1, 2)),  # the mean may be 1 while q is -1
    "start": (GROWING, Fraction(-1, 50)),  # 1 + s x where x grows
}


def halved(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Motion, "quarters", lambda self: [self.between(self.c.step * 0, self.c.step / 2)])
    as_stated: Callable[..., Any] = Boxes.number

    def number(self: Any, pair: Any, symbol: int, batch: int) -> Any:
        most = self.c.step / 2
        return as_stated(
            self, (min(pair[0], most), min(pair[1], most)) if symbol == self.symbols else pair, symbol, batch
        )

    monkeypatch.setattr(Boxes, "number", number)


def ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Motion, "quarters", lambda self: [self.between(self.c.step, self.c.step)])
    as_stated: Callable[..., Any] = Boxes.number

    def number(self: Any, pair: Any, symbol: int, batch: int) -> Any:
        return as_stated(self, (self.c.step, self.c.step) if symbol == self.symbols else pair, symbol, batch)

    monkeypatch.setattr(Boxes, "number", number)


def known(monkeypatch: pytest.MonkeyPatch) -> None:
    """Quantities with their symbols in g; of the checker what makes them ranges is left out."""
    as_stated: Callable[..., Any] = Motion.numbers

    def numbers(self: Any, at: Any) -> Any:
        found = as_stated(self, at)
        return replace(found, anything=found.uncertain)

    monkeypatch.setattr(Motion, "numbers", numbers)
    kept: Callable[..., Any] = Boxes.kept

    def with_symbols(self: Any, courses: Any, held: Any, gaps: Any) -> Any:
        own = [v.widened(held[0].symbols) for v in self.quantities(len(held[0].c))]
        return kept(self, courses, [*held[: self.m], *own], gaps)

    monkeypatch.setattr(Boxes, "kept", with_symbols)


def unmoved(monkeypatch: pytest.MonkeyPatch) -> None:
    mean: Callable[..., Any] = reference_motion.mean_on

    def at_start(c: Any, leaf: Any, _within: Mapping[str, Any], *more: Any) -> Any:
        return mean(c, leaf, leaf.states, *more)

    monkeypatch.setattr(reference_motion, "mean_on", at_start)
    enclosed: Callable[..., Any] = checker_flow.enclosed
    monkeypatch.setattr(checker_flow, "enclosed", lambda f, x, longest: (x, enclosed(f, x, longest)[1]))


MUTANTS = {"half": halved, "end": ended, "symbols": known, "start": unmoved}


@pytest.mark.parametrize("name", MUTANTS)
def test_each_part_of_the_rule_is_needed(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A false constraint is refused by both; a rule that forgets one thing accepts it in both."""
    case, by = VIOLATED[name]
    assert verdicts(case.document(by)) == REFUSED
    MUTANTS[name](monkeypatch)
    assert verdicts(case.document(by)) == KEPT


@pytest.mark.parametrize("k", range(4))
def test_the_checker_asks_each_quarter(k: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """x is the time: within 1e-3 of the middle of one quarter alone g is not negative."""
    bump = Case(["u"], (0.0,), ["-", ["**", ["-", "x", str(Fraction(2 * k + 1, 8))], 2]], Fraction(0))
    violated = bump.document(-Fraction(1, 10**6))
    assert verdicts(violated) == REFUSED
    as_stated: Callable[..., Any] = Boxes.number
    for left_out in range(4):

        def number(self: Any, pair: Any, symbol: int, batch: int, left_out: int = left_out) -> Any:
            other = Fraction((left_out + 2) % 4, 4)
            missing = symbol == self.symbols and pair[0] == Fraction(left_out, 4)
            return as_stated(self, (other, other) if missing else pair, symbol, batch)

        with monkeypatch.context() as patched:
            patched.setattr(Boxes, "number", number)
            assert verdicts(violated) == ((None if left_out == k else "keep"), "keep")
