"""Rule `keep` within a period, in the reference: constraints that are violated in one quarter of it alone, or where two
meet, each seen to pass where that quarter is left out or ends too soon; and one that only quarters can show."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from typing import Any

import pytest
from flint import arb, fmpq

from certify.reference import motion
from certify.reference.motion import Motion
from certify.reference.taylor import Taylor
from tests.support.rank_forgeries import by_reference, verdicts
from tests.support.ranked import Document, Loop, affine, two_bytes

WIDE = 2.0**-40  # half of the leaf's width
HELD = [["*", "3", "u"], "u"]  # from the origin, with u = 1: x = 3 s and v = s
BENT = ["v", "u"]  # x = s^2 / 2
Times = Callable[[Any], list[Taylor]]


def document(
    hi: Fraction, g: Any, dynamics: Any = HELD, jitter: bool = False, start: tuple[float, float] = (0.0, 0.0)
) -> Document:
    """A certificate that says that g < 0 at all times of a period of at most hi, from this state with u = 1."""
    loop = Loop(
        dynamics, [affine([[0.0, 0.0]], [1.0])], [["-", "-8", "x"]], states=("x", "v"),
        sample=(str(hi / 2 if jitter else hi), str(hi)), order=2, keep=["-1", g],
    )  # fmt: skip
    lo, up = ([x + sign * WIDE for x in start] for sign in (-1, 1))
    return loop.document(lo, up, b"\xff", two_bytes([1]), bytes([1]))


def around(time: Fraction, by: Fraction) -> Any:
    """(v - time)^2 < by, times -1: in the loops above only at times within by^(1/2) of this one it is not negative."""
    return ["-", str(by), ["**", ["-", "v", str(time)], 2]]


def without(k: int) -> Times:
    as_stated = Motion.quarters
    return lambda self: [s for i, s in enumerate(as_stated(self)) if i != k]


def shortened(*less: tuple[int, str]) -> Times:
    """Quarters of which some start or end by 2^-12 of the period too late or too soon."""

    def quarters(self: Any) -> list[Taylor]:
        hi, lost = self.c.step, self.c.step / 2**12
        ends = [(hi * fmpq(k, 4), hi * fmpq(k + 1, 4)) for k in range(4)]
        return [
            self.between(a + lost * ((k, "start") in less), b - lost * ((k, "end") in less))
            for k, (a, b) in enumerate(ends)
        ]

    return quarters


LENGTHS = [Fraction(1), Fraction(1, 3), Fraction(7, 10)]


@pytest.mark.parametrize("jitter", [False, True])
@pytest.mark.parametrize("hi", LENGTHS)
@pytest.mark.parametrize("k", range(4))
def test_each_quarter_is_asked(k: int, hi: Fraction, jitter: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """By 1e-6, only within it: accepted without this quarter, and not without any other."""
    violated = document(hi, around(hi * (2 * k + 1) / 8, Fraction(1, 10**6)), jitter=jitter)
    assert verdicts(violated) == ("keep", "keep")
    for left_out in range(4):
        with monkeypatch.context() as patched:
            patched.setattr(Motion, "quarters", without(left_out))
            assert by_reference(violated) == (None if left_out == k else "keep")


@pytest.mark.parametrize("hi", LENGTHS)
@pytest.mark.parametrize("k", range(5))
def test_quarters_leave_no_time_between_them(k: int, hi: Fraction, monkeypatch: pytest.MonkeyPatch) -> None:
    """At the ends of quarters, within 1e-9 of them: accepted only where all quarters that have it forget it."""
    violated = document(hi, around(hi * k / 4, Fraction(1, 10**18)))
    assert verdicts(violated) == ("keep", "keep")
    those = [(i, end) for i, end in ((k - 1, "end"), (k, "start")) if 0 <= i < 4]
    for some in ([], *([one] for one in those), those):
        with monkeypatch.context() as patched:
            patched.setattr(Motion, "quarters", shortened(*some))
            assert by_reference(violated) == (None if some == those else "keep")


@pytest.mark.parametrize("k", range(1, 4))
@pytest.mark.parametrize("end", ["start", "end"])
def test_a_time_between_two_quarters_is_noticed(k: int, end: str, monkeypatch: pytest.MonkeyPatch) -> None:
    beside = Fraction(1 if end == "start" else -1, 2**13)
    violated = document(Fraction(1), around(Fraction(k, 4) + beside, Fraction(1, 10**10)))
    assert verdicts(violated) == ("keep", "keep")
    monkeypatch.setattr(Motion, "quarters", shortened((k if end == "start" else k - 1, end)))
    assert by_reference(violated) is None


@pytest.mark.parametrize("by", [Fraction(1, 10**6), Fraction(1, 10**3)])
def test_the_mean_is_that_until_the_same_time(by: Fraction, monkeypatch: pytest.MonkeyPatch) -> None:
    """x = v^2 / 2 is violated near s = 1/8 alone, and would be accepted if G were always that of the whole period."""
    g = ["-", ["-", ["/", ["**", "v", 2], "2"], "x"], ["*", "8", ["**", ["-", "v", "1/8"], 2]]]
    grazed = [document(Fraction(1), ["+", g, str(sign * by)], BENT) for sign in (1, -1)]
    assert [verdicts(one) for one in grazed] == [("keep", "keep"), (None, None)]
    mean = motion.mean_on

    def of_the_whole(c: Any, leaf: Any, within: Any, order: int, s: Taylor, at: str) -> list[Taylor]:
        whole = s if s.g is None else Taylor(arb(0.5), s.g * 4)  # the next state is that at the end
        return mean(c, leaf, within, order, whole, at)

    monkeypatch.setattr(motion, "mean_on", of_the_whole)
    assert by_reference(grazed[0]) is None


PAST = ["-", "1/2", ["max", ["abs", "x"], ["abs", "v"]]]  # outside of a square


@pytest.mark.parametrize("height, whole, kept", [(0.6, "keep", None), (0.505, "keep", None), (0.499, "keep", "keep")])
def test_quarters_show_what_the_period_as_a_whole_does_not(
    height: float, whole: str | None, kept: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From x = -1 to 1 past both corners of the square."""
    data = document(Fraction(1), PAST, [["*", "2", "u"], "0"], start=(-1.0, height))
    assert verdicts(data) == (kept, kept)
    monkeypatch.setattr(Motion, "quarters", lambda self: [self.between(self.c.step * 0, self.c.step)])
    assert by_reference(data) == whole
