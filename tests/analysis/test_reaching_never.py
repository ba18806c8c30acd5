"""Starts that never arrive: found where they are known to be, and never where there are none."""

from __future__ import annotations

import re
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import flint
import numpy as np
import pytest
import scipy.linalg

from certify.analysis.reaching import ReachOptions, ReachResult, certify_reach
from certify.analysis.reaching.never import Search, Stay
from certify.analysis.reaching.options import target_of
from certify.analysis.reaching.runs import Simulation, begins
from certify.analysis.reaching.saddle import Saddle, _norm, _spectral, saddle_at
from certify.certificates.ellipsoids import Box
from certify.certificates.verdict import Verdict
from certify.effort import Effort
from certify.errors import InputError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.equilibrium import _is_inside, rest_in
from certify.loop.plants import System
from certify.loop.policies import PolicyNetwork
from certify.loop.rigorous import Balls, ball, points, precision, step_on
from tests.support.corners import plant
from tests.support.marks import slow_after

TENTH = (Fraction(1, 10), Fraction(1, 10))


def gain(*row: float) -> PolicyNetwork:
    """u = row x."""
    return PolicyNetwork.of_layers((np.array([row]),), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none")


def searched(system: System, network: PolicyNetwork, begin: Box, target: str) -> Stay | None:
    loop = ClosedLoop(system, network)
    beyond = target_of(system, (target,))
    search = Search(loop, beyond, begin, Simulation(loop, beyond, begin), Effort(1e10))
    return search.found(begins(begin))


def from_rest(lo: str, hi: str, speed: str = "0") -> Box:
    return (Fraction(lo), Fraction(hi)), (Fraction(speed), Fraction(speed))


def stepped(p: str, v: str, half: float = 3.0) -> System:
    return plant("p v", p, v, half=half, bound=99, time="discrete")


def held(p: str, v: str) -> System:
    return plant("p v", p, v, bound=99).with_sample(TENTH)


AWAY = "p**2 >= 1"


SADDLE = (stepped("p + u + v/10", "4*v/5"), gain(0.2, 0.0), from_rest("-0.4", "0.3", "0.5"))
"""p + v/4 grows by 1.2 a step, v falls: that one is 0 where p = -v/4."""


def test_a_start_that_ends_at_a_saddle() -> None:
    stay = searched(*SADDLE, AWAY)
    assert stay is not None and stay.steps > 0
    assert abs(float(stay.x[0]) + 0.125) <= stay.error < 1e-4
    assert float(stay.x[1]) == 0.5 and np.abs(np.array(stay.at, dtype=float)).max() < 1e-12


def test_a_start_beside_a_saddle_does_not_rest() -> None:
    """The line of starts crosses the saddle's small N at once; the saddle itself is not of the box."""
    system = stepped("101/100*p + 1000000*p**3", "v/2")
    stay = searched(system, gain(0.0, 0.0), from_rest("-0.32", "0.31", "1e-8"), "p**2 >= 1/100000")
    assert stay is not None and stay.steps > 0 and abs(float(stay.x[0])) <= stay.error


def test_the_part_that_arrives_is_proved_beside_it(tmp_path: Path) -> None:
    system, network, begin = SADDLE
    result = certify_reach(system, network, tmp_path, ReachOptions(target=(AWAY,), begin=begin, effort=0.02))
    assert result.verdict is Verdict.REFUTED and result.checker is not None and result.stay is not None
    assert result.checker["result"] == "ACCEPTED" and "of the box is proved" in result.reason
    assert "p = 0, v = 0 from step" in result.reason and "never gets there, shown in Arb" in result.reason
    told = result.to_dict()["never"]
    assert set(told) == {"x", "error", "steps", "at", "radius"} and told["steps"] == result.stay.steps


def test_a_start_that_ends_at_a_saddle_with_a_held_input() -> None:
    """p' = p + v/2 as u = p would have it, held over 0.1 s; v' = -v."""
    stay = searched(held("u + v/2", "-v"), gain(1.0, 0.0), from_rest("-0.4", "0.3", "0.5"), AWAY)
    A = np.array([[0.0, 0.5, 1.0], [0.0, -1.0, 0.0], [0.0, 0.0, 0.0]])
    M = scipy.linalg.expm(A * 0.1)
    step = M[:2, :2] + M[:2, 2:] @ np.array([[1.0, 0.0]])
    grows = step[0, 1] / (step[0, 0] - step[1, 1])  # p + grows v is multiplied by what p alone is
    assert stay is not None and abs(float(stay.x[0]) + grows * 0.5) <= stay.error < 1e-4


@pytest.mark.parametrize("time", ["steps", "held"])
def test_a_body_at_rest_where_the_push_and_the_slope_are_equal(time: str) -> None:
    """Two rates for one unknown: without speed that of p is 0, or the same as that of v."""
    if time == "steps":
        push = "clip(v + u/100 + (p - 1/5)**3/10, -1, 1)"
        system = stepped(f"max(p + {push}, -2)", f"({push})*heaviside(p + {push} + 2)")
    else:
        system = held("v", "u + (p - 1/5)**3")
    stay = searched(system, gain(1.0, 0.2), from_rest("-0.5", "0.7"), "p**2 >= 2")
    assert stay is not None and stay.steps == 0 and stay.x[1] == 0
    a, b = (0.1, 0.01) if time == "steps" else (1.0, 1.0)
    root = np.roots([a, -0.6 * a, 0.12 * a + b, -0.008 * a])
    assert np.abs(root - float(stay.x[0])).min() <= 1e-12 + stay.error < 1e-11


def test_a_state_that_rests_is_told(tmp_path: Path) -> None:
    """Runs from it are late."""
    options = ReachOptions(target=("p >= 1",), begin=from_rest("-0.1", "0.1"), effort=0.01)
    result = certify_reach(stepped("p + p/10", "v/2"), gain(0.0, 0.0), tmp_path, options)
    assert result.verdict is Verdict.REFUTED and result.stay is not None and result.stay.steps == 0
    assert "of p = 0, v = 0 rests and so never gets there, shown in Arb" in result.reason


ARRIVE = {
    "rest just outside of the box": (stepped("p + p/10", "v/2"), gain(0.0, 0.0), from_rest("1e-9", "0.5"), "p >= 1"),
    "a saddle's starts just outside of the box": (
        stepped("p + u + v/10", "4*v/5"),
        gain(0.2, 0.0),
        from_rest("-0.1249999", "0.3", "0.5"),
        "p >= 1",
    ),
    "a saddle in the target": (
        stepped("p + u + v/10", "4*v/5"),
        gain(0.2, 0.0),
        from_rest("-0.4", "0.3", "0.5"),
        "max(abs(v) - 1/1000, 1/100000 - p**2)*1000 <= 0",
    ),
    "a step over 0": (
        stepped("p + heaviside(p - 1/10)/5 - 1/10", "v/2"),
        gain(0.0, 0.0),
        from_rest("-0.2", "0.3"),
        "p**2 >= 1",
    ),
    "a step that parts the starts on either side of those of a saddle": (
        stepped("6*p/5 - v/5 - max(v - 3/10, 0)/2 + heaviside(p - 1/7 + 1/1000000000 + 10*(v - 1/2))/5", "v/2"),
        gain(0.0, 0.0),
        from_rest("0", "0.3", "0.5"),
        "p**2 >= 1",
    ),
    "rest outside of the box by less than floats know": (
        stepped("p + (p - 1/3)/10", "v/2"),
        gain(0.0, 0.0),
        ((Fraction(1, 3) + Fraction(1, 10**20), Fraction(1, 2)), (Fraction(0), Fraction(0))),
        "p >= 1",
    ),
    "a saddle in the target, which its starts reach late": (
        stepped("p + u + v/10", "4*v/5"),
        gain(0.2, 0.0),
        from_rest("-0.4", "0.3", "0.5"),
        "min(1 - p**2, max(abs(v), abs(p)) - 1/1000) <= 0",
    ),
    "rest in the target": (
        stepped("p + p/10", "v/2"),
        gain(0.0, 0.0),
        from_rest("-0.1", "0.1"),
        "min(1 - p**2, p**2 - 1/10000) <= 0",
    ),
}


@pytest.mark.parametrize("name", slow_after(4, ARRIVE))
def test_what_arrives_is_not_refuted(name: str) -> None:
    assert searched(*ARRIVE[name]) is None


def test_rests_are_shown_within_their_radius_alone() -> None:
    loop = ClosedLoop(stepped("p + v", "v + u + sin(p)/2 - 1/8"), gain(0.0, 0.0))
    root = Fraction(np.arcsin(0.25))
    with precision():
        for off, shown in ((0, True), (Fraction(1, 1000), True), (Fraction(1, 50), False)):
            found = rest_in(loop, [root + off, Fraction(0)], [0], [Fraction(1, 100)] * 2)
            assert (found is not None) is shown
            assert found is None or (found[0].contains(ball(root)) and found[1] == 0)
        assert rest_in(loop, [root, Fraction(1, 2**60)], [0], [Fraction(1, 100)] * 2) is None  # two equations
        assert rest_in(loop, [root, Fraction(0)], [], [Fraction(1, 100)] * 2) is None
        both = rest_in(loop, [root, Fraction(1, 1000)], [0, 1], [Fraction(1, 100)] * 2)
        assert both is not None and both[1].contains(0)


def test_nothing_rests_where_a_rate_has_no_value() -> None:
    """Floats take v for 1/3."""
    loop = ClosedLoop(stepped("p + p/10/heaviside(v - 1/3)", "v"), gain(0.0, 0.0))
    with precision():
        for off, shown in ((Fraction(1, 10**30), True), (Fraction(-1, 10**30), False)):
            found = rest_in(loop, [Fraction(0), Fraction(1, 3) + off], [0], [Fraction(1, 100)] * 2)
            assert (found is not None) is shown


@pytest.mark.parametrize(
    ("p", "v", "rests"),
    [
        ("2*p - 1/10", "v + 2*p - 1/5", True),
        ("2*p - 1/10", "v + (p - 1/10)*(p + 3) - p**2 + p/10", True),
        ("2*p - 1/10", "v + 2*p - 1/5 + 1/1000000000000000000000000000000", False),
        ("2*p - 1/10", "v + p - 1/5", False),
        ("2*p - 1/10", "v + 2*p + 1/5", False),
        ("2*p - 1/10", "v + 2*p - 1/5*cos(v)*exp(v)", True),
        ("2*p - 1/10", "v + 2*p - 1/5 + cos(v)/10", False),
        ("2*p - 1/10", "v + 2*p - 1/5 + exp(v)/10", False),
        ("p + abs(p - 101/1000)/10 + 1/100000", "v", False),
        ("p + abs(p - 101/1000)/10 - 1/100000", "v + abs(p - 101/1000)/5 - 1/50000", False),  # two, on both sides
        ("p + (p - 1/10)*(1 + heaviside(p - 101/1000))", "v", False),
    ],
)
def test_rates_are_one_where_they_are_multiples(p: str, v: str, rests: bool) -> None:
    with precision():
        found = rest_in(
            ClosedLoop(stepped(p, v), gain(0.0, 0.0)), [Fraction(1, 10), Fraction(0)], [0], [Fraction(1, 100)] * 2
        )
        assert (found is not None) is rests
        assert found is None or (found[0].contains(ball(Fraction(1, 10))) and found[1] == 0)


@pytest.mark.parametrize(
    ("at", "slope", "shown"),
    [(0.4, 0.0, True), (0.51, 0.0, False), (0.6, 0.0, False), (0.2, 0.5, True), (0.3, 0.5, False), (0.0, 1.0, False)],
)
def test_a_zero_is_shown_where_all_slopes_lead_into_the_box(at: float, slope: float, shown: bool) -> None:
    def change(x: Balls) -> tuple[Balls, flint.arb_mat]:
        return [x[0] - at], flint.arb_mat([[flint.arb(1, slope)]])

    def none(x: Balls) -> tuple[Balls, flint.arb_mat]:
        return [flint.arb.nan()], flint.arb_mat([[1]])

    with precision():
        assert _is_inside(change, [flint.arb(0)], [flint.arb(0, 0.5)]) is shown
        assert not _is_inside(none, [flint.arb(0)], [flint.arb(0, 0.5)])


@pytest.mark.parametrize(
    ("p", "v", "size"),
    [
        ("6*p/5 + v**2", "v/2 + p**2", 1e-2),
        ("6*p/5 + 20*v**2", "v/2", 1e-3),
        ("6*p/5", "v/2 + 20*p**2", 1e-3),
        ("6*p/5", "9*v/10 + 10*p**2", 1e-3),
        ("-6*p/5 + v**2", "v/2 + p**2", 1e-2),
        ("101*p/100 + p**3", "v/2", 1e-2),
        ("101*p/100 - 10*p**3", "v/2", 1e-3),
    ],
)
def test_a_saddle_covers_itself(p: str, v: str, size: float) -> None:
    loop = ClosedLoop(stepped(p, v), gain(0.0, 0.0))
    with precision():
        saddle = saddle_at(loop, np.zeros(2), np.ones(2))
        assert saddle is not None and saddle.r >= size
        corner = np.abs(saddle.V) @ np.full(2, saddle.r)  # all sampled corners keep the rule
        for w in np.random.default_rng(0).uniform(-1, 1, (200, 2)):
            w[0] = np.sign(w[0])
            after, _ = step_on(loop, points(saddle.V @ (w * saddle.r)))
            moved = np.linalg.solve(saddle.V, [float(q) for q in after]) / saddle.r
            assert abs(moved[0]) > 1 and abs(moved[1]) < 1 and np.all(corner > 0)


@pytest.mark.parametrize(
    ("p", "v"),
    [
        ("p/2 + v**2", "v/3"),  # none grows
        ("2*p", "3*v"),  # both grow
        ("p + v", "v - p/10"),  # a pair that grows
        ("p + p**3", "v/2"),  # 1 is not growth
        ("6*p/5", "v"),  # nor is it decay
        ("6*p/5 + 1", "v/2"),  # rests elsewhere
        ("6*p/5", "v/2 + 1"),  # so does this
        ("6*p/5 + 2*abs(p)", "v/2"),  # both sides go to the right
        ("6*p/5 + heaviside(p)/1000", "v/2"),  # a jump at the place
        ("6*p/5 + heaviside(p - 1/10000000)/1000", "v/2"),  # and beside it
    ],
)
def test_other_places_are_no_saddles(p: str, v: str) -> None:
    loop = ClosedLoop(stepped(p, v), gain(0.0, 0.0))
    with precision():
        assert saddle_at(loop, np.zeros(2), np.ones(2)) is None


def test_norms_of_balls_are_of_all_that_lies_in_them() -> None:
    rng = np.random.default_rng(0)
    with precision():
        for n in (1, 2, 3, 4) * 5:
            middle, radius = rng.normal(size=(n, n)), rng.uniform(0, 0.1, (n, n))
            balls = flint.arb_mat([[flint.arb(m, r) for m, r in zip(*rows, strict=True)]
                                   for rows in zip(middle.tolist(), radius.tolist(), strict=True)])  # fmt: skip
            for end in (middle + rng.uniform(-1, 1, (n, n)) * radius, middle + radius, middle - radius):
                assert _spectral(balls).upper() >= np.linalg.norm(end, 2) - 1e-9
                assert _norm(balls.tolist()[0]).upper() >= np.linalg.norm(end[0]) - 1e-9
        assert not _norm([flint.arb.nan()]) < 1 and _norm([]) == 0


def test_a_curve_crosses_from_side_to_side_within() -> None:
    saddle = Saddle(np.zeros(2), np.eye(2), 0.5)
    with precision():
        for m, D, crosses in (
            ((0.0, 0.0), (0.6, 0.1), True),
            ((0.0, 0.0), (-0.6, 0.1), True),
            ((0.0, 0.4), (0.6, 0.2), False),  # leaves above
            ((0.2, 0.0), (0.6, 0.1), False),  # ends before the left side
            ((0.0, 0.0), (0.5, 0.1), False),  # ends on the sides
            ((2.0, 0.0), (0.6, 0.1), False),
        ):
            assert saddle.is_crossed(points(np.array(m)), points(np.array(D))) is crosses
        wide = [flint.arb(0.6, 0.2), flint.arb(0)]  # of a D that may be less
        assert not saddle.is_crossed(points(np.zeros(2)), wide)
        assert not saddle.is_crossed(points(np.zeros(2)), [flint.arb.nan(), flint.arb(0)])


@pytest.mark.parametrize(("factor", "crosses"), [(1, True), (1000000, False)])
def test_a_line_that_is_elsewhere_between_its_ends_does_not_cross(factor: int, crosses: bool) -> None:
    """After a step its ends and its middle have the speed 0, and there it has no slope."""
    loop = ClosedLoop(stepped("6*p/5", f"v/2 + {factor}*p**3*(1/100 - p**2)"), gain(0.0, 0.0))
    beyond, begin = target_of(loop.system, (AWAY,)), from_rest("-0.1", "0.1")
    search = Search(loop, beyond, begin, Simulation(loop, beyond, begin), Effort(1e10))
    with precision():
        saddle = saddle_at(loop, np.zeros(2), np.ones(2))
        assert saddle is not None
        assert search._crosses((np.array([-0.1, 0.0]), np.array([0.1, 0.0])), saddle, 1) is crosses


@pytest.mark.parametrize(("v", "crosses"), [("1/8", False), ("1/64", False), ("3/8", True)])
def test_a_line_that_meets_the_target_on_the_way_does_not_cross(v: str, crosses: bool) -> None:
    """The speeds after 0, 1, ... steps are 1, 1/2, ...; a part of the line alone is in the target."""
    loop = ClosedLoop(stepped("6*p/5", "v/2"), gain(0.0, 0.0))
    beyond, begin = target_of(loop.system, (f"max(abs(v - {v}), abs(p)) <= 1/1000",)), from_rest("-0.1", "0.1", "1")
    search = Search(loop, beyond, begin, Simulation(loop, beyond, begin), Effort(1e10))
    with precision():
        saddle = Saddle(np.zeros(2), np.eye(2), 0.01)
        assert search._crosses((np.array([-0.1, 1.0]), np.array([0.1, 1.0])), saddle, 8) is crosses


@pytest.mark.parametrize("seed", slow_after(3, range(6)))
def test_slopes_of_a_step_with_a_held_input(seed: int) -> None:
    """Beside differences of the step itself; abs is beside its corner."""
    rng = np.random.default_rng(seed)
    loop = ClosedLoop(held("v*cos(p) + u**2/4", "u - tanh(v) + p*abs(v - 9)/5"), gain(*rng.uniform(-1, 1, 2)))
    x = rng.uniform(-1, 1, 2)
    with precision():
        _, J = step_on(loop, points(x))
        small = flint.arb(2) ** -60
        for j in range(2):
            ends = []
            for sign in (1, -1):
                y = points(x)
                y[j] += sign * small
                ends.append(step_on(loop, y)[0])
            for i in range(2):
                assert abs(float((ends[0][i] - ends[1][i]) / (2 * small) - J[i, j].mid())) < 1e-9
                wide = step_on(loop, [v + flint.arb(0, 1e-3) for v in points(x)])[1]
                assert wide[i, j].contains(J[i, j].mid())


def test_a_corner_within_a_step_has_no_slopes() -> None:
    loop = ClosedLoop(held("abs(v)", "u"), gain(0.0, 0.0))
    with precision():
        _, J = step_on(loop, [flint.arb(0), flint.arb(0, 1e-3)])
        assert not all(v.is_finite() for v in J.entries())


def test_a_target_that_counts_turns_is_refused_before_anything_is_said_of_it(tmp_path: Path) -> None:
    """p = 0 rests, and is the same place as 2 pi, which is in p >= 6."""
    system = replace(stepped("p + sin(p)/10", "v/2", 8.0), angles=("p",))
    options = ReachOptions(target=("p >= 6",), begin=from_rest("-0.1", "0.1"), effort=0.01)
    with pytest.raises(InputError, match="the same after a full turn of p"):
        certify_reach(system, gain(0.0, 0.0), tmp_path, options)


def test_what_is_said_of_a_start_holds_of_its_rounded_numbers() -> None:
    """Six digits of 1/3 are 3e-7 beside it, however small the error."""
    loop = stepped("p + p/10", "v/2"), gain(0.0, 0.0)
    result = ReachResult(Verdict.REFUTED, "", *loop, ReachOptions(target=("p >= 1",)))
    for p, v, error in ((1 / 3, 1e-17, 1e-12), (-0.1, 0.25, 3e-5), (2e-5, 1.0, 3e-5)):
        said = result.told_of(Stay((Fraction(p), Fraction(v)), error, (Fraction(p), Fraction(v)), error, 0))
        found = re.search(r"within (\S+) of p = (\S+), v = (\S+) rests", said)
        assert found is not None
        within, *shown = map(float, found.groups())
        assert within >= error + max(abs(p - shown[0]), abs(v - shown[1]))
        assert within < 1.2 * (error + 2e-6) + max(abs(p - shown[0]), abs(v - shown[1]))
