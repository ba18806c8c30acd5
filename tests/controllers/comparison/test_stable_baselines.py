"""The baselines: same environment and budget, inputs of the right size, files that are read back exactly."""

from __future__ import annotations

import io
import json
import sys
import zipfile
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from certify.errors import InputError
from certify.loop.plants import get_system
from certify.loop.policies import load_policy
from controllers.cli import app
from controllers.comparison.learners import without_gain
from controllers.comparison.stable_baselines import model
from controllers.comparison.stable_baselines.file import read_sb3, train_sb3
from controllers.comparison.stable_baselines.learner import Sb3Learner
from controllers.comparison.trained import from_checkpoint, from_policy
from controllers.options import preset
from controllers.training.environment import PlantEnvironment
from controllers.training.interface import Interface
from controllers.training.trainer import Trainer

SHIPPED = Path(__file__).parents[3] / "examples" / "policies" / "pendulum.pt"
TINY = replace(preset("pendulum"), steps=150, warm_up=50, n_A=20, n_B=20, batch=8, actor=(6, 5), critic=(7,), seed=3)
X = np.random.default_rng(0).uniform(-1, 1, (40, 2)) * [2.0, 8.0]

runner = CliRunner()


@pytest.fixture(scope="module")
def pendulum_system():
    return get_system("pendulum")


@pytest.fixture(scope="module", params=["ppo", "sac"])
def reference(request, pendulum_system, tmp_path_factory):
    """Bytes of a trained baseline."""
    path = tmp_path_factory.mktemp(request.param) / "model"  # no suffix: the file is written where it was asked for
    train_sb3(request.param, pendulum_system, TINY, path)
    return request.param, path.read_bytes()


@pytest.fixture(scope="module")
def checkpoint(pendulum_system):
    """A run of the same SAC without the gain, ended after a few gradient steps."""
    trainer = Trainer(pendulum_system, without_gain(TINY))
    while trainer.steps_done < 60:
        trainer.advance()
    return trainer, trainer.snapshot()


def test_a_baseline_is_read_back_as_stable_baselines_itself_would(reference, pendulum_system):
    import stable_baselines3

    algorithm, content = reference
    trained = read_sb3(content, pendulum_system, TINY)
    assert (trained.system, trained.steps, trained.seed) == ("pendulum", 150, 3)
    model = {"ppo": stable_baselines3.PPO, "sac": stable_baselines3.SAC}[algorithm].load(io.BytesIO(content))
    factors = Interface(pendulum_system).state_factors
    action, _ = model.predict((X * factors).astype(np.float32), deterministic=True)
    np.testing.assert_allclose(trained.mean(X), 6.0 * action, rtol=0, atol=1e-5)
    assert model.policy.net_arch["pi"] == [6, 5]
    assert model.policy.activation_fn is torch.nn.Tanh


def test_samples_are_spread_around_the_mean_and_stay_in_the_bounds(reference, pendulum_system):
    algorithm, content = reference
    trained = read_sb3(content, pendulum_system, TINY)
    many = np.repeat(X[:1], 4000, axis=0)
    u = trained.sample(many, np.random.default_rng(1))
    assert u.shape == (4000, 1) and np.abs(u).max() <= 6.0
    np.testing.assert_array_equal(u, trained.sample(many, np.random.default_rng(1)))
    mean = trained.mean(X[:1])[0, 0]
    assert np.median(u) == pytest.approx(mean, abs=0.6)
    assert u.std() > 0.5
    if algorithm == "ppo":  # its deviation is one parameter, near 1 at first, and samples are clipped
        assert (np.abs(u) == 6.0).mean() == pytest.approx(0.32, abs=0.05)


def test_training_a_baseline_twice_gives_the_same_networks(reference, pendulum_system, tmp_path):
    algorithm, content = reference
    train_sb3(algorithm, pendulum_system, TINY, tmp_path / "again.zip")
    train_sb3(algorithm, pendulum_system, replace(TINY, seed=4), tmp_path / "other.zip")
    first = read_sb3(content, pendulum_system, TINY).mean(X)
    again, other = (
        read_sb3((tmp_path / name).read_bytes(), pendulum_system, TINY).mean(X) for name in ("again.zip", "other.zip")
    )
    np.testing.assert_array_equal(again, first)
    assert np.abs(other - first).max() > 1e-3


def test_training_leaves_torch_s_generator_alone(pendulum_system, tmp_path):
    before = torch.random.get_rng_state()
    train_sb3("ppo", pendulum_system, replace(TINY, steps=20), tmp_path / "m.zip")
    assert torch.equal(before, torch.random.get_rng_state())


def test_two_runs_in_a_process_know_nothing_of_each_other(pendulum_system):
    alone = Sb3Learner("ppo", pendulum_system, TINY, 40)
    alone.advance(120)
    one, other = (Sb3Learner("ppo", pendulum_system, replace(TINY, seed=k), 40) for k in (3, 4))
    for steps in (40, 80, 120):
        one.advance(steps)
        other.advance(steps)
        np.random.seed(steps)  # noqa: NPY002  # what others draw makes no difference
        torch.rand(3)
    np.testing.assert_array_equal(one.trained().mean(X), alone.trained().mean(X))
    assert np.abs(other.trained().mean(X) - alone.trained().mean(X)).max() > 1e-3


def test_the_scaled_environment_is_the_plant_s(pendulum_system):
    scaled = model.scaled_environment(PlantEnvironment(pendulum_system, TINY))
    plant, factors = scaled.unwrapped, Interface(pendulum_system).state_factors
    seen, _ = scaled.reset(seed=5)
    start = np.array(plant.snapshot().x)
    np.testing.assert_array_equal(seen, (start * factors).astype(np.float32))
    assert seen.dtype == np.float32 and scaled.action_space.high == 1.0
    seen, reward, *_ = scaled.step(np.array([0.5], dtype=np.float32))
    plant.reset(seed=5)
    x, expected, *_ = plant.step(np.array([3.0]))
    np.testing.assert_array_equal(seen, (x * factors).astype(np.float32))
    assert reward == expected


def test_ppo_makes_whole_rollouts_within_the_budget(pendulum_system, tmp_path, monkeypatch):
    monkeypatch.setattr(model, "ROLLOUT", 20)
    seen = []
    made = train_sb3("ppo", pendulum_system, replace(TINY, steps=45), tmp_path / "m.zip", seen.append)
    assert seen == list(range(1, 45)) and made == 44  # two rollouts of 22
    assert read_sb3((tmp_path / "m.zip").read_bytes(), pendulum_system, TINY).steps == 44


def test_without_the_gain_everything_else_is_the_same():
    changed = without_gain(TINY)
    assert changed.gain_weight == 0.0
    known = {option.name for option in fields(TINY)}
    if "identification" in known:
        assert changed.identification == "never"
    rest = known - {"gain_weight", "identification"}
    assert {name: getattr(changed, name) for name in rest} == {name: getattr(TINY, name) for name in rest}


def test_a_checkpoint_gives_the_whole_actor(checkpoint, pendulum_system):
    trainer, content = checkpoint
    trained = from_checkpoint(content, pendulum_system)
    assert (trained.system, trained.steps, trained.seed) == ("pendulum", 60, 3)
    x = torch.from_numpy(X).float()
    with torch.no_grad():
        mean, log_std = (part.double().numpy() for part in trainer.sac.actor(x))
    np.testing.assert_allclose(trained.mean(X), 6.0 * np.tanh(mean), rtol=0, atol=1e-5)
    u = trained.sample(X, np.random.default_rng(2))
    noise = np.random.default_rng(2).standard_normal((40, 1))
    np.testing.assert_allclose(u, 6.0 * np.tanh(mean + np.exp(log_std) * noise), rtol=0, atol=1e-4)
    # The mean is what was trained: not centred, so the input at the origin is not u_eq.
    assert np.abs(trained.mean(np.zeros((1, 2)))).max() > 1e-6


def test_an_exported_policy_is_taken_as_it_ships(pendulum_system):
    policy = load_policy(SHIPPED)
    trained = from_policy(policy, pendulum_system)
    np.testing.assert_array_equal(trained.mean(X), policy.network(X, pendulum_system.exact_u_eq()))
    assert trained.sample is None
    assert (trained.steps, trained.seed) == (policy.training["steps"], policy.training["seed"])
    with pytest.raises(InputError, match="must be of cartpole; it is of pendulum"):
        from_policy(policy, get_system("cartpole"))
    heavier = pendulum_system.with_parameters({"m": "0.2"})
    with pytest.raises(InputError, match="at the same parameters"):
        from_policy(policy, heavier)
    with pytest.raises(InputError, match="`steps` and `seed`"):
        from_policy(replace(policy, training={}), pendulum_system)


def test_files_of_another_plant_other_widths_or_no_file_at_all_are_refused(reference, checkpoint, pendulum_system):
    _, content = reference
    with pytest.raises(InputError, match="of cartpole; it is"):
        read_sb3(content, get_system("cartpole"), TINY)
    with pytest.raises(InputError, match="preset's widths"):
        read_sb3(content, pendulum_system, preset("pendulum"))
    with pytest.raises(InputError, match="must be of cartpole; it is of pendulum"):
        from_checkpoint(checkpoint[1], get_system("cartpole"))
    with pytest.raises(InputError, match="at the same parameters"):
        from_checkpoint(checkpoint[1], pendulum_system.with_parameters({"m": "0.2"}))
    for rubbish in (b"", b"rubbish", content[:1000]):
        with pytest.raises(InputError, match="cannot be read"):
            read_sb3(rubbish, pendulum_system, TINY)
        with pytest.raises(InputError, match="checkpoint cannot be read"):
            from_checkpoint(rubbish, pendulum_system)


def test_nothing_in_a_baseline_s_file_is_unpickled(reference, pendulum_system):
    _, content = reference
    hostile = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(hostile, "w") as new:
        for name in old.namelist():
            data = old.read(name)
            if name == "data":  # every pickled object of it becomes rubbish
                record = json.loads(data)
                for entry in record.values():
                    if isinstance(entry, dict) and ":serialized:" in entry:
                        entry[":serialized:"] = "AAAA"
                data = json.dumps(record).encode()
            new.writestr(name, data)
    changed = read_sb3(hostile.getvalue(), pendulum_system, TINY)
    expected = read_sb3(content, pendulum_system, TINY)
    np.testing.assert_array_equal(changed.mean(X), expected.mean(X))


def test_the_command_writes_the_file_and_says_what_it_did(tmp_path):
    out = tmp_path / "ppo.zip"
    arguments = ["train-baseline", "ppo", "pendulum", "--out", str(out), "--seed", "2", "--steps", "60", "--json"]
    result = runner.invoke(app, arguments)
    assert result.exit_code == 0, result.stderr
    assert json.loads(result.stdout) == {
        "baseline": str(out),
        "algorithm": "ppo",
        "system": "pendulum",
        "steps": 60,
        "seed": 2,
    }
    trained = read_sb3(out.read_bytes(), get_system("pendulum"), preset("pendulum"))
    assert (trained.steps, trained.seed) == (60, 2)


@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_the_mean_is_a_policy_file_with_the_same_numbers(pendulum_system, tmp_path, algorithm):
    """Exact numbers of the library's networks: its own forward pass differs by rounding, the clip not at all."""
    learner = Sb3Learner(algorithm, pendulum_system, TINY, 50)
    learner.advance(100)
    with torch.no_grad():  # far from 0, so that the clip acts
        (learner.model.policy.action_net if algorithm == "ppo" else learner.model.policy.actor.mu).weight.mul_(200)
    learner.keep(tmp_path)
    policy, trained = load_policy(tmp_path / "policy.pt"), learner.trained()
    u = policy.network(X, pendulum_system.exact_u_eq())
    np.testing.assert_allclose(u, trained.mean(X), rtol=0, atol=1e-4)
    assert (policy.network.clip is not None) == (algorithm == "ppo") and policy.network.centre == "none"
    if algorithm == "ppo":
        assert 0 < (np.abs(u) == 6.0).mean() < 1
    whole = (tmp_path / "model.zip").read_bytes()
    kept = read_sb3(whole, pendulum_system, TINY)
    np.testing.assert_array_equal(kept.mean(X), trained.mean(X))
    lean = read_sb3(_without(whole, "optimizer"), pendulum_system, TINY)
    np.testing.assert_array_equal(lean.mean(X), trained.mean(X))
    with pytest.raises(InputError):
        read_sb3(_without(whole, "policy.pth"), pendulum_system, TINY)


def _without(content: bytes, word: str) -> bytes:
    """The archive less the files with this word in their names, of which there are some."""
    lean = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as archive, zipfile.ZipFile(lean, "w", zipfile.ZIP_DEFLATED) as out:
        kept = [name for name in archive.namelist() if word not in name]
        assert len(kept) < len(archive.namelist())
        for name in kept:
            out.writestr(name, archive.read(name))
    return lean.getvalue()


def test_a_checkpoint_of_another_run_or_none_is_refused(pendulum_system):
    learner = Sb3Learner("ppo", pendulum_system, TINY, 50)
    learner.advance(50)
    content = learner.snapshot()
    others = [
        Sb3Learner("sac", pendulum_system, TINY),
        Sb3Learner("ppo", pendulum_system, replace(TINY, seed=4), 50),
        Sb3Learner("ppo", pendulum_system, replace(TINY, gamma=0.9), 50),
    ]
    for other in others:
        with pytest.raises(InputError, match="the same algorithm on the same plant with the same options"):
            other.restore(content)
    for rubbish in (b"", content[:1000]):
        with pytest.raises(InputError, match="checkpoint cannot be read"):
            learner.restore(rubbish)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["td3", "pendulum"], "must be one of ppo, sac; found 'td3'"),
        (["ppo", "spaceship"], "spaceship"),
        (["ppo", "pendulum", "--steps", "0"], "--steps must be positive"),
        (["ppo", "pendulum", "--steps", "1"], "at least 2"),
    ],
)
def test_bad_input_is_one_sentence(tmp_path, arguments, message):
    result = runner.invoke(app, ["train-baseline", *arguments, "--out", str(tmp_path / "m.zip")])
    assert result.exit_code == 2
    assert message in result.stderr and result.stderr.startswith("Error: ") and result.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_without_stable_baselines_the_command_says_what_to_install(tmp_path, monkeypatch):
    for name in [name for name in sys.modules if name.split(".")[0] == "stable_baselines3"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    result = runner.invoke(app, ["train-baseline", "sac", "pendulum", "--out", str(tmp_path / "m.zip")])
    assert result.exit_code == 2
    assert (
        result.stderr == "Error: stable-baselines3 is not installed; "
        "`pip install '.[baselines]'` in the project's folder brings it.\n"
    )
    assert not list(tmp_path.iterdir())
