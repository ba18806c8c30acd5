"""Scores of actions, of which the largest is taken: proved, whichever of equal ones it is, and accepted."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from certify.analysis.reaching import ReachOptions, certify_reach
from certify.analysis.reaching.runs import Simulation
from certify.certificates import parse_any
from certify.certificates.drawn import nonlinearity_of
from certify.certificates.verdict import Verdict
from certify.effort import Effort
from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import Number, symbols
from certify.loop.expressions.tree import heaviside
from certify.loop.plants import System, load_system
from certify.loop.policies import PolicyNetwork
from tests.support.foreign import ROOT
from tests.support.loops import box

PLANT = ROOT / "examples" / "plants" / "gymnasium" / "mountain_car_actions.toml"


@pytest.fixture(scope="module")
def car() -> System:
    return load_system(PLANT)


def along(stay: float) -> PolicyNetwork:
    """Scores -velocity, `stay` and velocity: the car is pushed along its way, and at rest to either side, unless it is
    left alone."""
    weight, bias = np.array([[0.0, -1.0], [0.0, 0.0], [0.0, 1.0]]), np.array([0.0, stay, 0.0])
    return PolicyNetwork.of_layers((weight,), (bias,), np.ones(3), np.zeros(3), "identity", "none")


TARGET = ("position >= 0.5", "velocity >= 0")


def asked(lo: str, hi: str, effort: float = 0.3) -> ReachOptions:
    """From rest between two positions to the flag."""
    begin = ((Fraction(lo), Fraction(hi)), (Fraction(0), Fraction(0)))
    return ReachOptions(target=TARGET, begin=begin, effort=effort)


def test_both_of_two_equal_scores_are_followed(tmp_path: Path) -> None:
    """By one of two actions a step is 1 long, by the other 2: with equal scores the longer way is claimed."""
    x, short, long = symbols("x short long")
    system = System(
        name="walk",
        states=(x,),
        inputs=(short, long),
        parameters={},
        dynamics=(x + 1 + heaviside(long - short),),
        u_eq=(Number(0), Number(0)),
        domain=box(6),
        input_bounds=box(1, 1),
        time="discrete",
    )
    options = ReachOptions(target=("x >= 2",), begin=((Fraction(1, 4), Fraction(1, 2)),), effort=0.05)
    for score, steps in ((0.0, 2), (0.5, 1), (-0.5, 2)):
        weight, bias = np.zeros((2, 1)), np.array([0.0, score])
        network = PolicyNetwork.of_layers((weight,), (bias,), np.ones(2), np.zeros(2), "identity", "none")
        result = certify_reach(system, network, tmp_path / str(score), options)
        assert result.verdict is Verdict.PROVED and result.steps == steps and result.raw is not None
        assert result.checker is not None and result.checker["result"] == "ACCEPTED"
        assert nonlinearity_of(parse_any(result.raw, "f")) is None


@pytest.mark.slow
def test_a_car_that_may_be_left_alone_is_not_proved(car: System, tmp_path: Path) -> None:
    """At rest all scores are 0, so that it may stay there where nothing moves it; and it stays if that is larger."""
    assert certify_reach(car, along(1.0), tmp_path / "stays", asked("-0.47", "-0.468")).verdict is Verdict.UNKNOWN
    options = asked("-0.523598775598299", "-0.523598775598298", 0.02)
    assert certify_reach(car, along(0.0), tmp_path / "may", options).verdict is Verdict.UNKNOWN


def test_simulated_runs_stop_at_the_wall(car: System) -> None:
    loop = ClosedLoop(car, along(-1e-3))
    options = asked("-0.6", "-0.4")
    assert options.begin is not None
    position, velocity = car.states
    simulation = Simulation(loop, (Fraction(1, 2) - position, -velocity), options.begin)
    stopped = simulation.later(np.array([[-1.19, -0.05], [-1.19, 0.02]]))
    assert np.array_equal(stopped[0], [-1.2, 0.0]) and stopped[1, 0] > -1.19
    runs = simulation.runs(None, Effort(1e9))
    assert runs.failing is None and runs.longest is not None and runs.longest < 200
