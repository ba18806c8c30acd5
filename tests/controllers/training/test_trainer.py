"""Whole runs: determinism, exact resumption, the exported file, and the policy that ships."""

from __future__ import annotations

import csv
import io
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

from certify.errors import InputError
from certify.loop.plants import get_system
from certify.loop.policies import load_policy, save_policy
from controllers.evaluation.evaluation import evaluate
from controllers.evaluation.settling import EvaluationOptions
from controllers.identification.linearisation import discrete_linearisation
from controllers.options import TrainingOptions, preset
from controllers.training.log import Episode, Log
from controllers.training.trainer import Trainer, train
from tests.support.marks import slow_after

POLICIES = Path(__file__).parents[3] / "examples" / "policies"
SHIPPED = POLICIES / "pendulum.pt"


# Long enough for a gain, a refresh of it, gradient steps and an annealed end; short enough for a test.
SHORT = {"steps": 420, "warm_up": 100, "n_A": 60, "n_B": 60, "refresh": 200, "batch": 32, "critic": (16, 16)}
CASES: dict[str, tuple[str, dict[str, object]]] = {
    "pendulum": ("pendulum", SHORT),
    "cartpole": ("cartpole", {**SHORT, "steps": 500, "actor": (16, 16)}),
    "identified before": ("pendulum", {**SHORT, "steps": 400, "identification": "before"}),
}


@pytest.fixture(scope="module")
def short() -> TrainingOptions:
    return _case("pendulum").options


def _case(name) -> Trainer:
    plant, changes = CASES[name]
    return Trainer(get_system(plant), replace(preset(plant), **changes))


def _trainer(options):
    return Trainer(get_system("pendulum"), options)


def _in_full(value):
    if isinstance(value, dict):
        return {name: _in_full(part) for name, part in value.items()}
    return repr(value.tolist() if isinstance(value, torch.Tensor) else value)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Of a case: an uninterrupted run, its policy file and checkpoints from the middle of an episode."""

    @cache
    def run(name):
        folder, checkpoints = tmp_path_factory.mktemp("run"), {}

        def keep(trainer):
            if trainer.steps_done in (50, 333):  # the first is in the warm-up, while A is being collected
                checkpoints[trainer.steps_done] = trainer.snapshot()

        trainer = _case(name)
        save_policy(folder / "policy.pt", train(trainer, keep))
        return trainer, (folder / "policy.pt").read_bytes(), checkpoints

    return run


@pytest.fixture(scope="module")
def whole(runs):
    return runs("pendulum")


@pytest.mark.parametrize("case", slow_after(1, CASES))
def test_training_twice_gives_the_same_bytes_and_another_seed_does_not(runs, tmp_path, case):
    whole, trainer = runs(case), _case(case)
    save_policy(tmp_path / "again.pt", train(trainer))
    assert (tmp_path / "again.pt").read_bytes() == whole[1]
    other = train(Trainer(trainer.system, replace(trainer.options, seed=1)))
    assert other.network.sha256() != trainer.policy().network.sha256()


@pytest.mark.parametrize("step", slow_after(1, [333, 50]))
@pytest.mark.parametrize("case", slow_after(1, CASES))
def test_a_resumed_run_equals_an_uninterrupted_one(runs, tmp_path, case, step):
    whole, trainer = runs(case), _case(case)
    assert whole[0].gain.identified is not None and whole[0].sac.actor_optimiser.state
    trainer.restore(whole[2][step])
    assert trainer.steps_done == step
    save_policy(tmp_path / "resumed.pt", train(trainer))
    assert (tmp_path / "resumed.pt").read_bytes() == whole[1]
    assert repr(trainer.episodes) == repr(whole[0].episodes)  # repr: NaN before the first gain
    # Everything else that a checkpoint holds; printed in full, since NaN is not equal to itself.
    states = [torch.load(io.BytesIO(t.snapshot()), weights_only=True) for t in (trainer, whole[0])]
    assert _in_full(states[0]) == _in_full(states[1])


def test_a_run_is_resumed_with_its_own_options_only(short, whole):
    with pytest.raises(InputError, match=r"`gamma` was 0\.99, now it is 0\.9"):
        _trainer(replace(short, gamma=0.9)).restore(whole[2][50])
    heavier = get_system("pendulum").with_parameters({"m": "0.2"})
    with pytest.raises(InputError, match="checkpoint must be of pendulum"):
        Trainer(heavier, short).restore(whole[2][50])


def test_an_option_that_came_later_had_its_default(short, whole):
    state = torch.load(io.BytesIO(whole[2][50]), weights_only=True)
    for name in ("proof_weight", "proof_box"):
        del state["options"][name]
    older = io.BytesIO()
    torch.save(state, older)
    trainer = _trainer(short)
    trainer.restore(older.getvalue())
    assert trainer.steps_done == 50
    with pytest.raises(InputError, match=r"`proof_weight` was 0\.0, now it is 1\.0"):
        _trainer(replace(short, proof_weight=1.0)).restore(older.getvalue())


def test_a_run_that_could_not_choose_its_transitions_fitted_those_of_the_latest_round(whole, short):
    state = torch.load(io.BytesIO(whole[2][50]), weights_only=True)
    del state["options"]["transitions"], state["gain"]["missing"]
    state["gain"]["rows"] = state["gain"]["rows"][state["gain"]["phase"]]
    older = io.BytesIO()
    torch.save(state, older)
    with pytest.raises(InputError, match="`transitions` was latest, now it is all"):
        _trainer(short).restore(older.getvalue())
    resumed = _trainer(replace(short, transitions="latest"))
    resumed.restore(older.getvalue())
    assert resumed.gain.transitions == "latest" and resumed.gain.terms_A == "linear"
    assert _trainer(replace(short, terms_A="quadratic")).gain.terms_A == "quadratic"
    now = torch.load(io.BytesIO(whole[2][50]), weights_only=True)["gain"]
    assert resumed.gain.state() == now and len(now["rows"]["A"]) == 50


def test_a_damaged_checkpoint_is_refused(short, whole):
    for content in (b"", b"not a checkpoint", whole[2][50][:5000]):
        with pytest.raises(InputError, match="checkpoint"):
            _trainer(short).restore(content)


def test_the_gain_is_identified_first_and_refreshed_later(short):
    trainer, gains = _trainer(short), []

    def keep(trainer):
        if trainer.gain.identified is not None and (not gains or gains[-1] is not trainer.gain.identified):
            gains.append(trainer.gain.identified)

    train(trainer, keep)
    assert len(gains) == 2
    assert not np.array_equal(gains[0].A, gains[1].A)
    np.testing.assert_allclose(gains[0].K, gains[1].K, rtol=0.02)
    kinds = [episode.kind for episode in trainer.episodes]
    assert kinds[0] == "identification" and "training" in kinds
    assert {e.outcome for e in trainer.episodes if e.kind == "identification"} <= {"left the ball", "truncated"}


def test_the_file_holds_the_policy_in_memory_bit_for_bit(whole, tmp_path):
    trainer = whole[0]
    save_policy(tmp_path / "policy.pt", trainer.policy())
    loaded = load_policy(tmp_path / "policy.pt")
    actor, factors = trainer.sac.actor, trainer.sac.actor.factors
    weights = [actor.hidden[0].weight * factors, actor.hidden[1].weight, actor.mean.weight]
    for found, weight in zip(loaded.network.weights, weights, strict=True):
        np.testing.assert_array_equal(found, weight.detach().double().numpy())
    x, u_eq = np.random.default_rng(0).uniform(-3, 3, (50, 2)), get_system("pendulum").exact_u_eq()
    np.testing.assert_array_equal(loaded.network(x, u_eq), trainer.policy().network(x, u_eq))
    assert loaded.parameters == {"m": "0.15", "l": "0.5", "b": "0.1", "g": "9.81"}
    assert {**loaded.training}.items() >= trainer.options.record().items()


@pytest.mark.parametrize("centre", ["preactivation", "output"])
def test_each_centring_gives_u_eq_at_the_origin_and_records_it(short, centre):
    policy = train(_trainer(replace(short, centre=centre, steps=300)))
    u_eq = get_system("pendulum").exact_u_eq()
    assert policy.network.centre == policy.training["centre"] == centre
    raw = replace(policy.network, centre="none")
    assert abs(raw(np.zeros(2), u_eq)[0]) > 1e-6
    assert policy.network(np.zeros(2), u_eq) == pytest.approx(0.0, abs=0)


def test_a_run_that_diverges_ends_with_the_reason_and_keeps_its_checkpoint(short, tmp_path):
    trainer, path = _case("pendulum"), tmp_path / "checkpoint.pt"
    while trainer.steps_done < 200:
        trainer.advance()
    path.write_bytes(trainer.snapshot())
    kept = path.read_bytes()
    with torch.no_grad():
        trainer.sac.actor.mean.bias.fill_(float("nan"))
    for attempt in (trainer.snapshot, trainer.policy, lambda: train(trainer, checkpoint=path, checkpoint_every=10)):
        with pytest.raises(InputError, match="diverged"):
            attempt()
    assert path.read_bytes() == kept


def test_no_policy_without_a_gain(short):
    with pytest.raises(InputError, match="without a gain"):
        train(_trainer(replace(short, steps=30)))


def test_the_log_holds_every_episode_once_also_after_a_resume(short, whole, tmp_path):
    path = tmp_path / "log.csv"
    trainer = _trainer(short)
    trainer.restore(whole[2][333])
    with Log(path, Episode) as log:
        train(trainer, lambda t: log.extend(t.episodes))
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["step"]) for row in rows] == [e.step for e in whole[0].episodes]
    assert [float(row["total"]) for row in rows] == [e.total for e in whole[0].episodes]


@pytest.mark.parametrize(
    "change, name",
    [
        ({"steps": 0}, "steps"),
        ({"gamma": 1.0}, "gamma"),
        ({"tau": 0.0}, "tau"),
        ({"dt": float("nan")}, "dt"),
        ({"penalty": float("inf")}, "penalty"),
        ({"actor": ()}, "actor"),
        ({"centre": "nowhere"}, "centre"),
        ({"identification": "always"}, "identification"),
        ({"transitions": "some"}, "transitions"),
        ({"terms_A": "cubic"}, "terms_A"),
        ({"input_weights": (0.0,)}, "input_weights"),
        ({"seed": -1}, "seed"),
    ],
)
def test_options_out_of_range_are_refused_by_name(short, change, name):
    with pytest.raises(InputError, match=f"`{name}`"):
        replace(short, **change)


MEMBERS = [
    ("pendulum", (2, 16, 16, 1), 20, -1.0),
    ("cartpole", (4, 256, 256, 1), 20, -1.0),
    ("quadrotor2d", (6, 256, 256, 256, 256, 2), 5, -0.6),
    ("quadrotor3d", (12, 256, 256, 256, 256, 256, 4), 5, -0.6),
]


@pytest.mark.parametrize(("name", "layers", "states", "slowest"), slow_after(1, MEMBERS))
def test_the_shipped_policy_matches_its_gain_and_settles(name, layers, states, slowest):
    policy = load_policy(POLICIES / f"{name}.pt")
    assert policy.system == name
    assert policy.network.layers == layers
    record = {**preset(name).record(), "transitions": "latest"}  # by the preset, before identification accumulated
    assert {option: policy.training[option] for option in record} == record
    result = evaluate(policy, EvaluationOptions(states=states, seed=7, duration=30.0))
    assert result.gain_relative < 1e-2
    assert result.A_relative_error < 1e-2 and result.B_relative_error < 1e-2
    assert max(e.real for e in result.eigenvalues) < slowest
    assert result.continuous.settled == result.held.settled == states
    assert result.continuous.left_domain == 0


def test_a_run_on_the_cartpole_identifies_its_gain_within_the_first_episodes():
    options = replace(preset("cartpole"), steps=1100, actor=(16, 16), critic=(16, 16), batch=32)
    policy = train(Trainer(get_system("cartpole"), options))
    A, B = discrete_linearisation(get_system("cartpole"), options.dt)
    np.testing.assert_allclose(policy.training["A"], A, atol=1e-3)
    np.testing.assert_allclose(policy.training["B"], B, atol=1e-3)
    closed = np.array(policy.training["A"]) - np.array(policy.training["B"]) @ np.array(policy.training["K"])
    assert np.abs(np.linalg.eigvals(closed)).max() < 1
    assert policy.network.layers == (4, 16, 16, 1)
    assert policy.network.scale == 30 and policy.network.offset == 0
    assert policy.network.centre == "preactivation"


def test_a_policy_that_does_not_stabilise_does_not_settle():
    policy = load_policy(SHIPPED)
    options = EvaluationOptions(states=5, duration=3.0)
    backwards = replace(policy, network=replace(policy.network, scale=-policy.network.scale))
    result = evaluate(backwards, options)
    assert result.continuous.settled == result.held.settled == 0
    assert result.continuous.left_domain == 5
    assert result.gain_relative == pytest.approx(2.0, abs=0.02)
    # and one that does, but has not had the time
    assert evaluate(policy, options).continuous.settled == 0


def test_an_evaluation_needs_a_record_that_it_can_use():
    policy = load_policy(SHIPPED)
    with pytest.raises(InputError, match="'dt'"):
        evaluate(replace(policy, training={}))
    with pytest.raises(InputError, match="state_weights"):
        evaluate(replace(policy, training={**policy.training, "state_weights": [1.0]}))
