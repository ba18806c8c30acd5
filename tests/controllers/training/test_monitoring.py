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
from certify.loop.plants import get_system
from certify.loop.policies import load_policy
from controllers.cli import app
from controllers.evaluation.curvature import curvature
from controllers.evaluation.evaluation import evaluate
from controllers.evaluation.settling import MONITORING, settle
from controllers.identification.gain_learner import Identified
from controllers.identification.linearisation import discrete_linearisation, errors_of
from controllers.identification.riccati import riccati_gain
from controllers.options import TrainingOptions, preset
from controllers.training.log import Monitored
from controllers.training.trainer import Trainer, train

PENDULUM = get_system("pendulum")
SHIPPED = Path(__file__).parents[3] / "examples" / "policies" / "pendulum.pt"
ARGUMENTS = ["--steps", "250", "--warm-up", "100", "--n-A", "60", "--n-B", "60", "--batch", "16", "--critic", "8,8"]


@pytest.fixture(scope="module")
def short() -> TrainingOptions:
    return replace(preset("pendulum"), steps=250, warm_up=100, n_A=60, n_B=60, batch=16, critic=(8, 8))


def _settle(network, options=MONITORING, system=PENDULUM):
    chosen = preset("pendulum")
    weights = np.array(chosen.state_weights), np.array(chosen.input_weights)
    return settle(network, system, chosen.dt, *weights, options)


@pytest.mark.slow
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


def test_as_long_as_nothing_is_learned_there_is_no_error_of_it(short):
    trainer = Trainer(PENDULUM, replace(short, identification="never"))
    trainer.monitor()
    assert all(math.isnan(error) for error in astuple(trainer.monitored[0])[-3:])
    assert Monitored(*astuple(trainer.monitored[0])[:6]).step == 0  # a row of a checkpoint that had no errors


def test_the_errors_are_those_of_the_true_plant_and_of_its_gain_for_the_same_weights():
    options = preset("pendulum")
    Q, R = np.array(options.state_weights), np.array(options.input_weights)
    A, B = discrete_linearisation(PENDULUM, options.dt)
    K = riccati_gain(A, B, np.diag(Q), np.diag(R))
    assert errors_of(Identified(A, B, K), PENDULUM, options.dt, Q, R) == (0, 0, 0)
    found = errors_of(Identified(1.25 * A, 0.5 * B, 3 * K), PENDULUM, options.dt, Q, R)
    np.testing.assert_allclose(found, (0.25, 0.5, 2.0), rtol=1e-12)
    assert errors_of(Identified(A, B, K), PENDULUM, options.dt, 10 * Q, R)[2] > 0.1
    nothing = errors_of(Identified(A, B, K), PENDULUM, options.dt, 0 * Q, R)  # the least input still stabilises
    assert math.isfinite(nothing[2]) and nothing[2] > 1e-3


def test_a_policy_that_was_given_another_gain_is_measured_by_the_weights_of_that_gain():
    policy, options = load_policy(SHIPPED), replace(MONITORING, states=1, duration=1.0)
    assert 4e-4 < evaluate(policy, options).K_relative_error < 6e-4
    other = {"K": policy.training["K"], "Q": [10.0, 0.5], "R": [1.0]}
    given = replace(policy, training={**policy.training, "flattened": other})
    assert evaluate(given, options).K_relative_error > 0.1
    with pytest.raises(InputError, match="'Q'"):
        evaluate(replace(policy, training={**policy.training, "flattened": {"K": []}}), options)


def test_a_plant_without_initial_states_is_monitored_without_a_simulation(short):
    system = replace(PENDULUM, name="a_pendulum_of_my_own")
    trainer = Trainer(system, short)
    trainer.monitor()
    row = trainer.monitored[0]
    assert math.isnan(row.settled) and math.isnan(row.cost) and row.offset > 0 and row.curvature > 0
    with pytest.raises(InputError, match="box of initial states"):
        _settle(trainer.sac.actor.network(), system=system)


@pytest.mark.slow
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
    figures = ["step", "distance", "offset", "curvature", "settled", "cost", "A_error", "B_error", "K_error"]
    assert list(rows[0]) == figures
    identified = [float(rows[-1][name]) for name in figures[-3:]]
    judged = CliRunner().invoke(
        app, ["evaluate", str(tmp_path / "whole.pt"), "--states", "1", "--duration", "1", "--json"]
    )
    assert list(json.loads(judged.stdout)["identification"].values()) == identified and 0 < max(identified) < 0.01
    assert f"settled {float(rows[-1]['settled']):.0%}" in result.stderr
    assert json.loads(result.stdout)["distance"] == float(rows[-1]["distance"])
    assert run("resumed", "--evaluate-every", 100, "--resume")[0] == whole
    recorded = load_policy(tmp_path / "whole.pt").training
    assert "evaluate_every" not in recorded and float(rows[-1]["curvature"]) == recorded["curvature"]


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--evaluate-every", "-1"], "--evaluate-every must be at least 0"),
        (["--evaluate-every", "0", "--evaluations", "e.csv"], "--evaluate-every"),
        (["--evaluations", "/nonexistent/folder/e.csv"], "cannot be written"),
    ],
)
def test_bad_options_are_refused_before_training(tmp_path, arguments, message):
    result = CliRunner().invoke(app, ["train", "pendulum", "--out", str(tmp_path / "p.pt"), *arguments])
    assert result.exit_code == 2 and message in result.stderr
    assert not list(tmp_path.iterdir())
