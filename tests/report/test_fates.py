"""What becomes of simulated runs: slow is not leaving, and nothing certified is drawn as leaving."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction
from itertools import count, pairwise

import numpy as np
import pytest

from certify.certificates import Certificate, PartitionTree
from certify.certificates.claims import Asymptotic
from certify.effort import Effort
from certify.errors import InputError
from certify.loop.expressions import Number, symbols
from certify.loop.plants import System
from certify.loop.plants.equations import parse_expression
from certify.loop.policies import PolicyNetwork
from certify.lyapunov.function import Quadratic
from certify.report import simulated_roa_fraction
from certify.report.figures import draw, region_of, simulated_roa
from certify.report.figures.portrait import keys
from certify.report.figures.scene import Detail, Scene
from certify.report.figures.style import LEAVING, UNSETTLED
from certify.report.figures.trajectories import runs_from, starts
from certify.report.flow import Flow, simulate
from certify.report.sampling import SETTLED, Runs, SimulatedRoa, edge_of, quadratic, runs_of
from certify.report.sections.simulated import simulated_of
from tests.support.loops import box

ONE_LEAF = PartitionTree(np.eye(2), np.ones(2), bytes([255]))
QUIET = PolicyNetwork.of_layers((np.zeros((1, 2)),), (np.zeros(1),), np.ones(1), np.zeros(1), "tanh", "none")


def plane(first: str, second: str, half: float = 1.0) -> System:
    """x' and y' as texts, in a square domain; the input does nothing."""
    x, y, u = symbols("x y u")
    f = tuple(parse_expression(text, {"x": x, "y": y}) for text in (first, second))
    return System("plane", (x, y), (u,), {}, f, (Number(0),), box(half, half), box(1))


def certificate(system: System, level: float, inner: float | None = None) -> Certificate:
    claim = Asymptotic(roa=level, local=level / 4 if inner is None else inner)
    return Certificate(system, QUIET, Quadratic(np.eye(2)), claim, ONE_LEAF)


def fates(system: System, begin: Sequence[Sequence[float]], level: float, step: float, steps: int) -> Runs:
    flow = Flow.of(system, QUIET)
    return runs_of(flow, np.array(begin), np.eye(2), level, SETTLED * level, step, steps)


def test_a_slow_run_does_neither_settle_nor_leave() -> None:
    slow = plane("-x/1000", "-y")
    runs = fates(slow, [[0.6, 0.0], [0.0, 0.6], [0.9, 0.9]], 0.5, 0.1, 100)
    assert runs.settled.tolist() == [False, True, False]
    assert not runs.left.any() and runs.unsettled.tolist() == [True, False, True]
    assert runs.seconds == pytest.approx(10.0)


def test_what_leaves_the_domain_or_rises_out_of_the_set_leaves() -> None:
    assert fates(plane("x", "-y"), [[0.5, 0.0], [0.0, 0.5]], 0.5, 0.05, 100).left.tolist() == [True, False]
    # A cycle of radius 1 in a wide domain: what starts in a set that is claimed inside of it leaves the set alone.
    cycle = plane("x*(1 - x**2 - y**2) - y", "y*(1 - x**2 - y**2) + x", 4)
    runs = fates(cycle, [[0.4, 0.0], [2.0, 0.0]], 0.25, 0.05, 400)
    assert np.all(np.isfinite(runs.path)) and runs.left.tolist() == [True, False]
    assert runs.unsettled.tolist() == [False, True]


def test_a_run_that_leaves_for_its_step_alone_is_simulated_again() -> None:
    stiff = plane("-40*x", "-y")
    flow = Flow.of(stiff, QUIET)
    assert np.isnan(simulate(flow, np.array([[0.6, 0.0]]), 0.1, 40)[-1]).any()  # beyond 2.8 of the time constant
    runs = fates(stiff, [[0.6, 0.0]], 0.5, 0.1, 40)
    assert runs.settled.all() and not runs.left.any() and np.all(np.isfinite(runs.path))
    roa = simulated_roa_fraction(stiff, QUIET, np.eye(2), 0.5, step=0.1, horizon=10.0)
    assert roa.contradictions == 0 and roa.left.any()  # those outside the set are not asked twice


def test_fates_exclude_each_other() -> None:
    both, one = np.array([True]), np.array([False])
    with pytest.raises(InputError, match="both settle and leave"):
        Runs(np.zeros((2, 1, 2)), 0.1, both, both)
    with pytest.raises(InputError, match="both settle and leave"):
        SimulatedRoa((np.zeros(1),), both, both, one, 0.1, 1.0)
    with pytest.raises(InputError, match="N fates"):
        Runs(np.zeros((2, 2, 2)), 0.1, both, one)


@pytest.mark.slow
def test_nothing_from_a_certified_set_is_drawn_as_leaving() -> None:
    """The slow mode needs 7,000 seconds; the page draws what the steps allow."""
    slow = certificate(plane("-x/1000", "-y*50"), 0.9)
    pictures, roa = draw(slow, accepted=True)
    first = pictures[0]
    texts = [key.text for key in first.legend]
    assert any(text.startswith("trajectories not settled in") for text in texts)
    assert not any("leave" in text for text in texts) and LEAVING not in first.svg.split("</style>")[-1]
    assert UNSETTLED in first.svg.split("</style>")[-1]
    assert roa is not None and roa.contradictions == 0 and not roa.left.any() and roa.slow > 0


@pytest.mark.slow
def test_runs_that_are_too_short_tell_no_share() -> None:
    """Of the pages' runs hardly one comes near where the effort ends early: then no share of them is stated."""
    slow = certificate(plane("-x/1000", "-y*50"), 0.9)
    roa = simulated_roa_fraction(slow.system, QUIET, slow.P, slow.roa)
    said = simulated_of(roa, slow)
    assert roa.attracted.any() and not roa.tells and np.isnan(roa.fraction) and not said["tells"]
    assert region_of(Scene(slow, accepted=True), roa) is None
    quick = simulated_roa_fraction(plane("-x", "-y"), QUIET, slow.P, slow.roa)
    assert quick.tells and 0 < quick.fraction < 1


def test_a_held_input_is_asked_once_a_step() -> None:
    """A step of Runge and Kutta has four stages, in each of which a policy that follows at once is asked."""
    wide = replace(QUIET, network=PolicyNetwork.of_layers((np.zeros((500, 2)), np.zeros((1, 500))),
                   (np.zeros(500), np.zeros(1)), np.ones(1), np.zeros(1), "tanh", "none").network)  # fmt: skip
    system = plane("-x", "-y")
    each = [
        flow.operations(2) - flow.operations(1)
        for flow in (Flow.of(system, wide), Flow.of(replace(system, sample=(Fraction(1, 10),) * 2), wide))
    ]
    assert each[0] == 4 * Flow.of(system, wide).cost and each[1] < 0.4 * each[0]


def test_the_grids_runs_last_until_they_are_home() -> None:
    """x' = -tanh(60 x) decays at 60 about 0, 15 time constants of which are 1/4; from 1 the way takes one unit."""
    roa = simulated_roa_fraction(plane("-tanh(60*x)", "-tanh(60*y)"), QUIET, np.eye(2), 0.04)
    assert roa.attracted.all() and 1.0 <= roa.horizon <= 4.0
    assert simulated_roa_fraction(plane("-x", "-y"), QUIET, np.eye(2), 0.04).horizon == pytest.approx(15)


def test_trajectories_are_drawn_as_long_as_the_grids_runs() -> None:
    """Of the same plant: half of 1/4 brings none home from the domain's edge, half of a few units does."""
    scene = Scene(certificate(plane("-tanh(60*x)", "-tanh(60*y)"), 0.04), accepted=True)
    assert runs_from(scene, starts(scene)).unsettled.any()
    assert simulated_roa(scene) is not None
    assert runs_from(scene, starts(scene)).settled.all()


def test_what_leaves_is_drawn_so() -> None:
    """Beyond |x| = 1 everything leaves."""
    pictures, roa = draw(certificate(plane("x**3 - x", "-y", 2), 0.8), accepted=True)
    drawn = pictures[0].svg.split("</style>")[-1]
    assert any(key.text == "trajectories that leave the domain*" for key in pictures[0].legend) and LEAVING in drawn
    assert not any("not settled" in key.text for key in pictures[0].legend) and UNSETTLED not in drawn
    assert roa is not None and roa.left.any() and roa.contradictions == 0


def test_a_claimed_set_that_runs_leave_is_not_spared() -> None:
    scene = Scene(certificate(plane("x**3 - x", "-y", 2), 2.0), accepted=False)
    runs = runs_from(scene, starts(scene))
    begins = quadratic(scene.P, runs.path[0]) <= scene.outer
    assert np.any(runs.left & begins)
    assert "trajectories that leave the domain*" in {key.text for key in keys(scene, runs, None, True)}


def test_the_edge_of_the_simulated_region_is_smooth_and_where_it_is() -> None:
    system = plane("x**3 - x", "-y", 2)
    flow, P = Flow.of(system, QUIET), np.eye(2)
    roa = simulated_roa_fraction(system, QUIET, P, 0.8)
    a, b, share = edge_of(flow, roa, P, SETTLED * 0.8)
    coarse = roa.axes[0][1] - roa.axes[0][0]
    fine = a[1] - a[0]
    assert fine == pytest.approx(coarse / 4) and share.shape == (len(a), len(b)) and 0 <= share.min() < share.max() <= 1
    for row in share.T:  # each crossing of 1/2, by interpolation
        (at,) = np.flatnonzero((row[:-1] >= 0.5) & (row[1:] < 0.5))
        edge = a[at] + fine * (row[at] - 0.5) / (row[at] - row[at + 1])
        assert abs(edge - 1.0) < 1.5 * fine
    with pytest.raises(InputError, match="plane"):
        edge_of(flow, replace(roa, axes=roa.axes[:1], attracted=roa.attracted[0], left=roa.left[0],
                              certified=roa.certified[0]), P, 1e-3)  # fmt: skip


def test_states_from_which_an_input_leaves_its_bounds_are_outside_the_simulated_region() -> None:
    """x' = -x, y' = u with u = -y, |u| <= 1: all states converge, but the loop is this only where |y| <= 1."""
    system = plane("-x", "-y", 2)
    follows = PolicyNetwork.of_layers((np.array([[0.0, -1.0]]),), (np.zeros(1),), np.ones(1), np.zeros(1), "identity",
                                      "none")  # fmt: skip
    roa = simulated_roa_fraction(system, follows, np.eye(2), 0.5)
    (bound,) = system.input_bounds
    assert np.array_equal(roa.attracted, np.broadcast_to(np.abs(roa.axes[1]) <= float(bound[1]), roa.attracted.shape))
    assert not roa.attracted.all() and roa.attracted.any()
    said = simulated_of(roa, certificate(system, 0.5))
    assert roa.clipped == int(roa.left.sum()) and said["clipped"] and said["bounds"] == " or the bounds of inputs"
    clipped = simulated_roa_fraction(system, replace(follows, clip=(-np.ones(1), np.ones(1))), np.eye(2), 0.5)
    assert clipped.attracted.all() and clipped.clipped is None


def test_a_curved_edge_is_found_as_if_the_whole_grid_were_fine() -> None:
    """The unit circle is the edge: r' = r^3 - r, turning."""
    system = plane("(x**2 + y**2 - 1)*x - y", "(x**2 + y**2 - 1)*y + x", 2)
    flow, P = Flow.of(system, QUIET), np.eye(2)
    roa = simulated_roa_fraction(system, QUIET, P, 0.5)
    a, b, share = edge_of(flow, roa, P, SETTLED * 0.5)
    radius = np.hypot(*np.meshgrid(a, b, indexing="ij"))
    cell = a[1] - a[0]
    assert np.all(share[radius < 1 - 3 * cell] > 0.5) and np.all(share[radius > 1 + 3 * cell] < 0.5)


# Effort


def test_without_effort_the_sets_are_drawn_and_nothing_is_called_leaving() -> None:
    claimed = certificate(plane("-x/10", "-y*50"), 0.9)
    pictures, roa = draw(claimed, accepted=True, effort=Effort(0.0))
    texts = [key.text for key in pictures[0].legend]
    assert texts[0].startswith("proved set") and any("not settled in" in text for text in texts)
    assert not any("leave" in text for text in texts)
    assert roa is not None and not roa.left.any() and roa.horizon == 0.0  # it says how far it came
    full, whole = draw(claimed, accepted=True)
    assert [p.title for p in full] == [p.title for p in pictures] and whole is not None and whole.attracted.all()


def test_counted_work_ends_runs_early_and_keeps_what_there_is() -> None:
    flow, begin = Flow.of(plane("-x", "-y"), QUIET), np.array([[0.5, 0.5]])
    path = simulate(flow, begin, 0.01, 10_000, Effort(0.0))
    assert len(path) == 2 and np.all(np.isfinite(path))
    effort = Effort(20 * flow.operations(1))
    assert len(simulate(flow, begin, 0.01, 100, effort)) == 21 and effort.over
    assert len(simulate(flow, begin, 0.01, 100)) == 101


@pytest.mark.slow
def test_a_picture_is_the_same_on_a_machine_that_is_busy(monkeypatch: pytest.MonkeyPatch) -> None:
    """Seconds pass between two readings of the clock, as on a machine where other programs run."""
    claimed = certificate(plane("-x/10", "-y*50"), 0.9)
    quiet, readings = draw(claimed, accepted=True), count(0.0, 7.0)
    monkeypatch.setattr(time, "monotonic", lambda: next(readings))
    busy = draw(claimed, accepted=True)
    assert busy[0] == quiet[0]
    assert busy[1] is not None and quiet[1] is not None and busy[1].horizon == quiet[1].horizon


def test_how_much_is_simulated_follows_from_the_policy_alone() -> None:
    def policy(width: int, layers: int) -> PolicyNetwork:
        sizes = [6, *([width] * layers), 1]
        weights = tuple(np.zeros((b, a)) for a, b in pairwise(sizes))
        return PolicyNetwork.of_layers(
            weights, tuple(np.zeros(b) for b in sizes[1:]), np.ones(1), np.zeros(1), "tanh", "none"
        )

    small, large, huge = Detail.of(policy(16, 2), 3), Detail.of(policy(256, 5), 3), Detail.of(policy(2048, 4), 3)
    assert small == Detail(grid=101, starts=8, steps=500, rates=200)
    for a, b in ((small, large), (large, huge)):
        assert a.grid >= b.grid and a.starts >= b.starts and a.steps >= b.steps and a.rates >= b.rates
    assert huge == Detail(grid=25, starts=4, steps=120, rates=24)  # what is left of a picture at the least
    assert Detail.of(policy(256, 5), 6).grid <= large.grid
