"""Evaluations during a run: what they say, that they change nothing, and where they are written."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import astuple, replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from certify.errors import InputError
from certify.policies import load_policy
from certify.systems import get_system
from controllers.cli import app
from controllers.evaluate import MONITORING, curvature, evaluate, settle
from controllers.options import TrainingOptions, preset
from controllers.training import Trainer, train

PENDULUM = get_system("pendulum")
SHIPPED = Path(__file__).parents[2] / "examples" / "policies" / "pendulum.pt"
ARGUMENTS = ["--steps", "250", "--warm-up", "100", "--n-A", "60", "--n-B", "60", "--batch", "16", "--critic", "8,8"]


@pytest.fixture(scope="module")
def short() -> TrainingOptions:
    return replace(preset("pendulum"), steps=250, warm_up=100, n_A=60, n_B=60, batch=16, critic=(8, 8))


def _settle(network, options=MONITORING, system=PENDULUM):
    chosen = preset("pendulum")
    weights = np.array(chosen.state_weights), np.array(chosen.input_weights)
    return settle(network, system, chosen.dt, *weights, options)


def test_evaluations_come_on_time_and_at_the_end_and_change_nothing(short):
    trainer = Trainer(PENDULUM, short)
    watched = train(trainer, evaluate_every=100)
    plain = Trainer(PENDULUM, short)
    assert train(plain).network.sha256() == watched.network.sha256()
    assert plain.monitored == [] and repr(plain.episodes) == repr(trainer.episodes)
    assert plain.environment.np_random.bit_generator.state == trainer.environment.np_random.bit_generator.state
    assert [row.step for row in trainer.monitored] == [100, 200, 250]
    last, found = trainer.monitored[-1], _settle(watched.network)
    assert astuple(last)[1:3] == trainer.distance()
    assert last.curvature == curvature(watched.network, PENDULUM, short.eta)
    assert (last.settled, last.cost) == (found.settled / 100, found.cost)


def test_the_share_is_that_of_the_evaluation_and_needs_a_policy_that_stabilises():
    policy, options = load_policy(SHIPPED), replace(MONITORING, states=10, duration=10.0)
    assert _settle(policy.network, options) == evaluate(policy, options).held
    assert _settle(policy.network, options).settled == 10
    backwards = replace(policy.network, scale=-policy.network.scale)
    assert _settle(backwards, options).settled == 0


def test_a_plant_without_initial_states_is_monitored_without_a_simulation(short):
    system = replace(PENDULUM, name="a_pendulum_of_my_own")
    trainer = Trainer(system, short)
    trainer.monitor()
    row = trainer.monitored[0]
    assert math.isnan(row.settled) and math.isnan(row.cost) and row.offset > 0 and row.curvature > 0
    with pytest.raises(InputError, match="box of initial states"):
        _settle(trainer.sac.actor.network(), system=system)


def test_the_command_shows_and_writes_them_and_a_resumed_run_writes_the_same(tmp_path):
    def run(name, *more):
        path = tmp_path / f"{name}.csv"
        folder = ["--checkpoint-dir", tmp_path, "--checkpoint-every", 150]
        arguments = ["pendulum", "--out", tmp_path / f"{name}.pt", *ARGUMENTS, *folder, "--evaluations", path, *more]
        result = CliRunner().invoke(app, ["train", *map(str, arguments), "--json"])
        assert result.exit_code == 0, result.stderr
        return path.read_text(), result

    whole, result = run("whole", "--evaluate-every", 100)
    rows = list(csv.DictReader(whole.splitlines()))
    assert [row["step"] for row in rows] == ["100", "200", "250"]
    assert list(rows[0]) == ["step", "distance", "offset", "curvature", "settled", "cost"]
    assert f"settled {float(rows[-1]['settled']):.0%}" in result.stderr
    assert json.loads(result.stdout)["distance"] == float(rows[-1]["distance"])
    assert run("resumed", "--evaluate-every", 100, "--resume")[0] == whole
    recorded = load_policy(tmp_path / "whole.pt").training
    assert "evaluate_every" not in recorded and float(rows[-1]["curvature"]) == recorded["curvature"]


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--evaluate-every", "-1"], "`evaluate_every` must be at least 0"),
        (["--evaluate-every", "0", "--evaluations", "e.csv"], "--evaluate-every"),
        (["--evaluations", "/nonexistent/folder/e.csv"], "cannot be written"),
    ],
)
def test_bad_options_are_refused_before_training(tmp_path, arguments, message):
    result = CliRunner().invoke(app, ["train", "pendulum", "--out", str(tmp_path / "p.pt"), *arguments])
    assert result.exit_code == 2 and message in result.stderr
    assert not list(tmp_path.iterdir())
