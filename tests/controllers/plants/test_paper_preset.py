"""Departures from the paper: each is undone by itself, all of them by the preset `paper`, and none by old files."""

from __future__ import annotations

import io
import json
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
from controllers.comparison.trained import from_checkpoint
from controllers.options import TrainingOptions, available_plants, get_plant, preset
from controllers.plants.paper_preset import DEPARTURES, as_in_paper
from controllers.training.actor import Actor
from controllers.training.environment import PlantEnvironment
from controllers.training.interface import Interface
from controllers.training.trainer import Trainer, train

ROOT = Path(__file__).parents[3]
SHORT = {"steps": 250, "n_A": 40, "n_B": 40, "refresh": 200, "batch": 16, "critic": (8, 8)}
LATER = ("log_std", "reward_at", "identification_starts", "gain_norm")
ACTORS = {"pendulum": (16,) * 2, "cartpole": (256,) * 2, "quadrotor2d": (256,) * 4, "quadrotor3d": (256,) * 5}
TABLE = {"learning_rate": 3e-4, "gamma": 0.99, "replay": 10**6, "batch": 256, "tau": 0.005, "reward_scale": 2.0}
STAY = {"pendulum": set(), "cartpole": {"start"}, "quadrotor2d": {"start", "ball"}, "quadrotor3d": {"start", "ball"}}


def _differing(one, other):
    return {
        option.name for option in fields(TrainingOptions) if getattr(one, option.name) != getattr(other, option.name)
    }


@pytest.mark.parametrize("departure", DEPARTURES, ids=lambda departure: departure.name)
def test_a_departure_is_undone_by_itself_and_once(departure):
    moved = set()
    for name in available_plants():
        ours = preset(name)
        undone = departure.undone(ours)
        assert _differing(ours, undone) <= departure.undoing(ours).keys()
        assert departure.undone(undone) == undone
        moved |= _differing(ours, undone)
    assert moved  # some plant that ships departs in it
    assert f"`{departure.name}`" in (ROOT / "docs" / "departures.md").read_text("utf-8")


@pytest.mark.parametrize("name", ACTORS)
def test_the_preset_follows_the_paper_but_for_what_its_file_says(name):
    paper = get_plant(name).named("paper")
    assert {departure.name for departure in DEPARTURES if departure.undone(paper) != paper} == STAY[name]
    assert paper.actor == paper.critic == ACTORS[name]
    assert {option: getattr(paper, option) for option in TABLE} == TABLE
    assert get_plant(name).named("ours") is preset(name)


def test_what_stays_is_named_and_must_be_a_departure():
    ours = preset("quadrotor2d")
    assert as_in_paper(ours, but=[departure.name for departure in DEPARTURES]) == ours
    assert as_in_paper(ours, but=["critics"]).critic == ours.critic != as_in_paper(ours).critic
    with pytest.raises(InputError, match=r"must be among critics, .*; found 'critic'"):
        as_in_paper(ours, but=["critic"])


def test_a_preset_that_is_not_there_is_refused():
    plant = get_plant("pendulum")
    with pytest.raises(InputError, match="one of ours, paper; found 'theirs'"):
        plant.named("theirs")
    with pytest.raises(InputError, match="no preset `paper`"):
        replace(plant, paper=None).named("paper")
    narrow = replace(plant, paper=replace(plant.preset, reward_weights=(1.0,)))
    with pytest.raises(InputError, match="`reward_weights` must be 2 numbers"):
        narrow.check(get_system("pendulum"))


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("log_std", (2.0, -5.0), "two rising numbers"),
        ("log_std", (1.0,), "two rising numbers"),
        ("log_std", (-float("inf"), 2.0), "finite"),
        ("reward_at", "previous", "one of"),
        ("gain_norm", "nuclear", "one of"),
        ("identification_starts", "corner", "one of"),
    ],
)
def test_options_out_of_their_range_are_refused(option, value, message):
    with pytest.raises(InputError, match=rf"`{option}` must be .*{message}"):
        replace(preset("pendulum"), **{option: value})


def _actor(plant, log_std=(-5.0, 2.0)):
    with torch.random.fork_rng():
        torch.manual_seed(4)
        return Actor(Interface(get_system(plant)), (16, 16), "output", log_std)


@pytest.mark.parametrize("plant", ["pendulum", "quadrotor2d", "quadrotor3d"])
def test_the_spectral_norm_is_the_largest_singular_value_and_one_input_has_one_norm(plant):
    actor = _actor(plant)
    mean, jacobian = (part.detach() for part in actor.at_origin())
    K = torch.from_numpy(np.random.default_rng(0).normal(size=jacobian.shape)).float()
    offset = float(torch.linalg.vector_norm(mean - actor.u_eq))
    difference = (jacobian + K).double().numpy()
    frobenius, spectral = (actor.gain_loss(K, norm).item() - offset for norm in ("frobenius", "spectral"))
    assert spectral == pytest.approx(np.linalg.svd(difference, compute_uv=False)[0], rel=1e-5)
    assert frobenius == pytest.approx(np.linalg.norm(difference), rel=1e-5)
    assert (spectral < 0.99 * frobenius) == (len(jacobian) > 1)


def test_descending_the_spectral_norm_ties_every_direction_and_rests_at_the_gain():
    actor, K = _actor("quadrotor2d"), torch.linspace(-1, 1, 12).reshape(2, 6)
    optimiser = torch.optim.Adam(actor.parameters(), 3e-3)
    for rate in (*[5e-3] * 250, *np.linspace(5e-3, 0, 150)):
        optimiser.param_groups[0]["lr"] = rate
        optimiser.zero_grad()
        actor.gain_loss(K, "spectral").backward()
        optimiser.step()
    assert torch.linalg.vector_norm(actor.at_origin()[1] + K) < 0.02 * torch.linalg.vector_norm(K)
    optimiser.zero_grad()
    exactly = -actor.at_origin()[1].detach()
    actor.gain_loss(exactly, "spectral").backward()
    assert all(torch.isfinite(weight.grad).all() for weight in actor.parameters() if weight.grad is not None)


@pytest.mark.parametrize(("log_std", "found"), [((-5.0, 2.0), 2.0), ((-20.0, 3.0), 3.0), ((), 7.0)])
def test_the_standard_deviation_has_the_bounds_that_are_chosen(log_std, found):
    actor = _actor("pendulum", log_std)
    with torch.no_grad():
        actor.log_std.weight.zero_()
        actor.log_std.bias.fill_(7.0)
    assert actor(torch.zeros(3, 2))[1].detach().unique().tolist() == [found]


def test_a_checkpoint_is_sampled_with_the_bounds_it_was_trained_with():
    system = get_system("pendulum")
    deviations = {}
    for log_std in ((-5.0, 2.0), ()):
        trainer = Trainer(system, replace(preset("pendulum"), **SHORT, log_std=log_std))
        with torch.no_grad():
            trainer.sac.actor.mean.weight.zero_(), trainer.sac.actor.mean.bias.zero_()
            trainer.sac.actor.log_std.weight.zero_(), trainer.sac.actor.log_std.bias.fill_(-9.0)
        checkpoint = trainer.snapshot()
        read = from_checkpoint(checkpoint, system)
        deviations[log_std] = float(read.sample(np.zeros((500, 2)), np.random.default_rng(0)).std())
        if log_std:  # a run before there was a choice
            assert _without(checkpoint, LATER) != checkpoint
            older = from_checkpoint(_without(checkpoint, LATER), system)
            assert float(older.sample(np.zeros((500, 2)), np.random.default_rng(0)).std()) == deviations[log_std]
    assert deviations[-5.0, 2.0] == pytest.approx(6 * np.exp(-5), rel=0.1)
    assert deviations[()] == pytest.approx(6 * np.exp(-9), rel=0.1)


def test_the_reward_of_a_step_is_that_of_the_state_that_was_asked_for():
    ours = preset("pendulum")
    for reward_at, of in (("next", 1), ("current", 0)):
        environment = PlantEnvironment(get_system("pendulum"), replace(ours, reward_at=reward_at))
        for start, leaves in (((0.5, 1.0), False), ((3.1, 10.0), True)):
            environment.reset(seed=0)
            environment.restore(replace(environment.snapshot(), x=start))
            x, reward, terminated, _, _ = environment.step(np.ones(1))
            judged = (np.array(start), x)[of]
            wanted = ours.reward_offset - float(np.dot(ours.reward_weights, judged**2)) - ours.penalty * leaves
            assert terminated == leaves
            assert reward == pytest.approx(wanted, abs=1e-12)


def test_identification_can_wait_for_what_passes_by():
    """In a ball that most of the domain's episodes pass, rounds end too, and no episode begins in it on purpose."""
    waiting = replace(
        preset("pendulum"),
        **{**SHORT, "n_A": 20, "n_B": 20, "steps": 150},
        eta=9.0,
        warm_up=50,
        identification_starts="domain",
    )
    trainer = Trainer(get_system("pendulum"), waiting)
    starts, zero = [trainer.episode.x], []
    while trainer.steps_done < waiting.steps:
        x, asked, episodes = trainer.episode.x, trainer.gain.phase, len(trainer.episodes)
        trainer.advance()
        zero.append((asked == "A" and trainer.gain.inside(x), float(trainer.replay.table[trainer.steps_done - 1, 2])))
        if len(trainer.episodes) > episodes:
            starts.append(trainer.episode.x)
    assert trainer.policy().training["K"]
    assert {episode.kind for episode in trainer.episodes} == {"training"}
    assert {episode.outcome for episode in trainer.episodes} <= {"terminated", "truncated"}
    assert any(np.linalg.norm(x) > waiting.eta for x in starts)
    assert {action for inside, action in zero if inside} == {0.0}
    assert sum(inside for inside, _ in zero) >= waiting.n_A


def test_a_run_that_waited_in_vain_says_where_to_go():
    waiting = replace(preset("pendulum"), **SHORT, eta=1e-6, warm_up=50, identification_starts="domain")
    with pytest.raises(InputError, match="without a gain; it needs more `steps`, or `identification_starts` ball"):
        train(Trainer(get_system("pendulum"), waiting))


def _without(checkpoint, names):
    state = torch.load(io.BytesIO(checkpoint), weights_only=True)
    for name in names:
        del state["options"][name]
    older = io.BytesIO()
    torch.save(state, older)
    return older.getvalue()


def test_a_checkpoint_that_is_older_than_the_choices_is_of_a_run_with_ours():
    ours = replace(preset("pendulum"), **SHORT, warm_up=50)
    trainer = Trainer(get_system("pendulum"), ours)
    while trainer.steps_done < 60:
        trainer.advance()
    older = _without(trainer.snapshot(), LATER)
    resumed = Trainer(get_system("pendulum"), ours)
    resumed.restore(older)
    assert resumed.steps_done == 60
    for departure in DEPARTURES:
        if departure.undoing(ours).keys() & set(LATER):
            with pytest.raises(InputError, match="is resumed with the options it began with"):
                Trainer(get_system("pendulum"), departure.undone(ours)).restore(older)


def test_the_command_takes_a_preset_by_name_and_options_over_it(tmp_path):
    out, runner = tmp_path / "p.pt", CliRunner()
    short = [part for name, value in SHORT.items() for part in ("--" + name.replace("_", "-"), str(value).strip("()"))]
    arguments = ["train", "pendulum", *short, "--out", str(out), "--json", "--evaluate-every", "0", "--preset"]
    done = runner.invoke(app, [*arguments, "paper", "--identification-starts", "ball"])
    assert done.exit_code == 0, done.stderr
    paper = replace(get_plant("pendulum").named("paper"), **SHORT, identification_starts="ball")
    assert paper.record().items() <= load_policy(out).training.items()
    unbounded = runner.invoke(
        app, [*arguments, "ours", "--log-std", "none", "--evaluate-every", "0", "--warm-up", "50"]
    )
    assert unbounded.exit_code == 0, unbounded.stderr
    assert load_policy(out).training["log_std"] == []
    wrong = runner.invoke(app, [*arguments, "theirs"])
    assert wrong.exit_code == 2 and "one of ours, paper" in json.loads(wrong.stdout)["error"]
