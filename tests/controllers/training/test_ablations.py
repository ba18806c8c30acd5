"""Runs with a part of the method left out: what is learned, what ships, and that it can be evaluated."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from certify.loop.plants import get_system
from certify.loop.policies import load_policy, save_policy
from controllers.cli import app
from controllers.evaluation.evaluation import evaluate
from controllers.evaluation.settling import EvaluationOptions
from controllers.options import TrainingOptions, preset
from controllers.training.interface import Interface
from controllers.training.sac import SAC
from controllers.training.trainer import Trainer, train

U_EQ = get_system("pendulum").exact_u_eq()


@pytest.fixture(scope="module")
def short() -> TrainingOptions:
    changes = {"steps": 400, "warm_up": 50, "n_A": 60, "n_B": 60, "refresh": 150, "batch": 16, "critic": (16, 16)}
    return replace(preset("pendulum"), **changes)


def _run(options, keep=None):
    trainer = Trainer(get_system("pendulum"), options)
    return trainer, train(trainer, keep)


def test_without_its_weight_the_gain_term_moves_nothing_and_its_distance_is_still_logged(short):
    weights = []
    for K in (None, torch.tensor([[1.76, 0.59]])):
        with torch.random.fork_rng():
            torch.manual_seed(0)
            sac = SAC(Interface(get_system("pendulum")), replace(short, gain_weight=0.0), torch.Generator())
        sac.generator.manual_seed(0)
        x = torch.linspace(-1, 1, 32).reshape(16, 2)
        sac.update((x, x[:, :1], torch.ones(16, 1), x, torch.zeros(16, 1)), K, 1.0)
        weights.append(torch.cat([part.detach().flatten() for part in sac.actor.parameters()]))
    assert torch.equal(*weights)
    trainer, policy = _run(replace(short, gain_weight=0.0))
    assert policy.training["distance"] == trainer.distance()[0] > 0
    assert trainer.episodes[-1].distance > 0


def test_identification_before_the_run_is_one_round_with_random_actions_and_delays_the_warm_up(short):
    moved, phases, gains, actions = [], [], [], []

    def keep(trainer):
        weight = trainer.sac.actor.mean.weight.detach().clone()
        moved.append(not torch.equal(weight, first))
        phases.append(trainer.gain.phase)
        gains.append(trainer.gain.identified)
        actions.append(float(trainer.replay.table[trainer.steps_done - 1, 2]))

    options = replace(short, identification="before")
    trainer = Trainer(get_system("pendulum"), options)
    first = trainer.sac.actor.mean.weight.detach().clone()
    chosen, act = [], trainer.sac.act
    trainer.sac.act = lambda x: chosen.append(trainer.steps_done) or act(x)  # type: ignore[method-assign]
    policy = train(trainer, keep)
    end = phases.index("idle") + 1  # steps of the identification
    assert 120 <= end < 250
    assert set(phases[end:]) == {"idle"} and len({id(gain) for gain in gains[end:]}) == 1  # never refreshed
    assert moved.index(True) == end + options.warm_up and chosen[0] == end + options.warm_up
    begins_B = phases.index("B") + 1
    assert not any(actions[:begins_B])
    assert np.ptp(actions[begins_B:end]) > 1.5  # uniform in [-1, 1]
    kinds = {e.kind for e in trainer.episodes if e.step > end}
    assert kinds == {"training"} and trainer.episodes[0].kind == "identification"
    assert policy.training["identification"] == "before" and policy.training["distance"] > 0


def test_plain_sac_has_no_identification_no_gain_and_a_policy(short, tmp_path):
    trainer, policy = _run(replace(short, identification="never"))
    assert {episode.kind for episode in trainer.episodes} == {"training"}
    assert not {"A", "B", "K", "distance"} & set(policy.training)
    assert all(np.isnan(e.distance) and e.offset > 0 for e in trainer.episodes)
    save_policy(tmp_path / "p.pt", policy)
    loaded = load_policy(tmp_path / "p.pt")
    assert loaded.network.sha256() == policy.network.sha256()
    result = evaluate(loaded, EvaluationOptions(states=3, duration=1.0))
    assert np.isnan(result.gain_relative) and result.held.states == 3


def test_without_centring_the_raw_mean_ships(short):
    trainer, policy = _run(replace(short, centre="none"))
    actor = trainer.sac.actor
    assert policy.network.centre == "none"
    x = np.random.default_rng(0).uniform(-1, 1, (20, 2))
    with torch.no_grad():
        expected = 6 * torch.tanh(actor(torch.from_numpy(x).float())[0]).numpy()
    np.testing.assert_allclose(policy.network(x, U_EQ), expected, atol=1e-5)
    mean, jacobian = (part.detach().numpy() for part in actor.at_origin())
    assert abs(mean[0]) > 1e-6
    np.testing.assert_allclose(policy.network(np.zeros(2), U_EQ), mean, atol=1e-6)
    np.testing.assert_allclose(policy.network.jacobian_at_origin(U_EQ), jacobian, atol=1e-5)
    assert policy.training["offset_before_centring"] == pytest.approx(abs(mean[0]))


@pytest.mark.slow
def test_the_command_trains_and_evaluates_an_ablation(tmp_path):
    runner, out = CliRunner(), tmp_path / "p.pt"
    small = ["--steps", "60", "--warm-up", "20", "--batch", "8", "--critic", "8"]
    ablation = ["--identification", "never", "--centre", "none", "--gain-weight", "0"]
    trained = runner.invoke(app, ["train", "pendulum", "--out", str(out), *small, *ablation, "--json"])
    assert trained.exit_code == 0, trained.stderr
    result = json.loads(trained.stdout)
    assert result["K"] is None and result["distance"] is None
    text = runner.invoke(app, ["evaluate", str(out), "--states", "2", "--duration", "1"])
    assert text.exit_code == 0, text.stderr
    assert "nan" not in text.stdout
    rows = dict(line.split("  ", 1) for line in text.stdout.splitlines())
    assert rows["||J+K||/||K||"].strip() == "-"
    evaluated = runner.invoke(app, ["evaluate", str(out), "--states", "2", "--duration", "1", "--json"])
    assert json.loads(evaluated.stdout)["gain"] == {"distance": None, "relative": None}
