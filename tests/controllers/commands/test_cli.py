"""The `controllers` command: what goes where, exit statuses, and that failure leaves files alone."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
import subprocess
import sys
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from certify import certify_roa, get_system
from certify.certificates.located import Containment
from certify.certificates.membership import proved_set
from certify.errors import InputError
from certify.loop.policies import load_policy, save_policy
from controllers.cli import app
from controllers.simulation.trajectories import initial_states

SHIPPED = Path(__file__).parents[3] / "examples" / "policies" / "pendulum.pt"
SHORT = ["--steps", "260", "--warm-up", "100", "--n-A", "60", "--n-B", "60", "--batch", "16", "--critic", "8,8"]

runner = CliRunner()


def _train(*arguments):
    return runner.invoke(app, ["train", *map(str, arguments)])


def test_train_writes_policy_log_and_checkpoint_and_resumes(tmp_path):
    out, log, folder = tmp_path / "p.pt", tmp_path / "p.csv", tmp_path / "runs"
    arguments = ["pendulum", *SHORT, "--log", log, "--checkpoint-dir", folder, "--checkpoint-every", 130]
    first = _train(*arguments, "--out", out, "--seed", 3, "--centre", "output", "--json")
    assert first.exit_code == 0, first.stderr
    result = json.loads(first.stdout)
    policy = load_policy(out)
    assert result["sha256"] == policy.network.sha256()
    assert policy.training["seed"] == 3 and policy.training["critic"] == [8, 8]
    assert policy.network.centre == "output"
    assert log.read_text().startswith("step,kind,length,total")
    assert not list(tmp_path.glob("*.partial"))
    assert (folder / "checkpoint.pt").is_file()
    again = tmp_path / "again.pt"
    resumed = _train(*arguments, "--out", again, "--seed", 3, "--centre", "output", "--resume")
    assert resumed.exit_code == 0, resumed.stderr
    assert again.read_bytes() == out.read_bytes()


def test_a_plant_whose_operating_point_is_no_equilibrium_is_not_trained_for(tmp_path):
    plant, example = tmp_path / "off.toml", Path(__file__).parents[3] / "examples" / "van_der_pol.toml"
    plant.write_text(example.read_text().replace('u = "0"', 'u = "1"').replace("van_der_pol", "pushed"))
    done = _train(plant, "--out", tmp_path / "p.pt", *SHORT)
    assert done.exit_code == 2 and "must be an equilibrium" in done.stderr and not (tmp_path / "p.pt").exists()


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["spaceship"], "'spaceship'"),
        (["spaceship"], "A plant of your own is a file: give FILE.toml"),
        (["pendulum", "--gamma", "1.5"], "--gamma must be in [0, 1)"),
        (["pendulum", "--critic", "64,wide"], "--critic must be numbers"),
        (["pendulum", "--reward-weights", "1,2,3"], "--reward-weights must be 2 numbers"),
        (["cartpole", "--state-weights", "1,2"], "--state-weights must be 4 numbers"),
        (["pendulum", "--centre", "nowhere"], "--centre"),
        (["pendulum", "--resume"], "--checkpoint-dir"),
        (["pendulum", "--checkpoint-every", "0"], "--checkpoint-every"),
        (["pendulum", "--log", "/nonexistent/folder/log.csv"], "cannot be written"),
    ],
)
def test_bad_input_is_one_sentence_and_changes_nothing(tmp_path, arguments, message):
    out = tmp_path / "p.pt"
    out.write_bytes(b"precious")
    result = _train(*arguments, "--out", out)
    assert result.exit_code == 2
    assert message in result.stderr
    errors = [line for line in result.stderr.splitlines() if line.startswith("Error: ")]
    assert len(errors) == 1 and "Traceback" not in result.stderr
    assert result.stdout == ""
    assert out.read_bytes() == b"precious"


def _fails(monkeypatch, module, name, error):
    """Let a function fail once it has begun."""

    def fail(*_, **__):
        raise error

    monkeypatch.setattr(f"controllers.{module}.{name}", fail)


RUNS = {
    "train": ["train", "pendulum", *SHORT],
    "flatten": ["flatten", str(SHIPPED), "--steps", "1", "--states", "2"],
    "train-baseline": ["train-baseline", "ppo", "pendulum", "--steps", "20"],
}
BEGUN = {"train": ("training.trainer", "train"), "flatten": ("flattening.flattening", "flatten")}


@pytest.mark.parametrize("command", RUNS)
@pytest.mark.parametrize("error", [InputError("it fails"), KeyboardInterrupt()], ids=["fails", "interrupted"])
def test_a_run_that_ends_before_its_time_leaves_no_earlier_result(tmp_path, monkeypatch, command, error):
    """It lies beside under another name: nothing that the run did not make may pass for its result."""
    module, name = BEGUN.get(command, ("comparison.stable_baselines.file", "train_sb3"))
    _fails(monkeypatch, module, name, error)
    out = tmp_path / "p.v2.pt"
    out.write_bytes(b"precious")
    done = runner.invoke(app, [*RUNS[command], "--out", str(out)])
    assert done.exit_code == (2 if isinstance(error, InputError) else 130)
    assert not out.exists() and (tmp_path / "p.v2.earlier.pt").read_bytes() == b"precious"


def test_a_run_without_a_gain_leaves_no_earlier_policy(tmp_path):
    out = tmp_path / "p.pt"
    out.write_bytes(b"precious")
    done = _train("pendulum", "--steps", "20", "--out", out)
    assert done.exit_code == 2 and "without a gain; it needs more --steps" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["p.earlier.pt"]


@pytest.mark.slow
def test_a_run_keeps_the_policy_before_it_and_no_older_one(tmp_path):
    out = tmp_path / "p.pt"
    for seed in (1, 2, 3):
        assert _train("pendulum", *SHORT, "--out", out, "--seed", seed).exit_code == 0
    seeds = {path.name: load_policy(path).training["seed"] for path in tmp_path.iterdir()}
    assert seeds == {"p.pt": 3, "p.earlier.pt": 2}


def test_an_output_that_cannot_be_written_is_refused_before_training(tmp_path):
    for out in (tmp_path / "missing" / "p.pt", tmp_path):
        result = _train("pendulum", "--out", out, "--json")  # the whole preset: minutes, if it began
        assert result.exit_code == 2
        assert list(json.loads(result.stdout)) == ["error"]


def test_resuming_from_nothing_or_from_rubbish_is_refused(tmp_path):
    arguments = ["pendulum", *SHORT, "--out", tmp_path / "p.pt", "--checkpoint-dir", tmp_path, "--resume"]
    missing = _train(*arguments)
    (tmp_path / "checkpoint.pt").write_bytes(b"rubbish")
    damaged = _train(*arguments)
    assert missing.exit_code == damaged.exit_code == 2
    assert "there is no checkpoint" in missing.stderr and "cannot be read" in damaged.stderr
    assert (tmp_path / "checkpoint.pt").read_bytes() == b"rubbish"
    assert not (tmp_path / "p.pt").exists()


def test_evaluate_prints_one_json_object_that_says_nothing_of_a_proof_without_a_certificate():
    result = runner.invoke(app, ["evaluate", str(SHIPPED), "--states", "3", "--duration", "12", "--json"])
    assert result.exit_code == 0, result.stderr
    figures = json.loads(result.stdout)
    assert figures["proved"] is None
    assert figures["continuous"]["settled"] == figures["held"]["settled"] == 3
    assert figures["gain"]["relative"] < 0.01
    assert figures["policy"]["sha256"] == load_policy(SHIPPED).network.sha256()


def test_evaluate_prints_text_that_says_nothing_of_a_proof_without_a_certificate():
    """A run of a second has not settled; the window of the last second is all of it."""
    result = runner.invoke(app, ["evaluate", str(SHIPPED), "--states", "2", "--duration", "1"])
    assert result.exit_code == 0, result.stderr
    assert "0 of 2 settled" in result.stdout and "proved" not in result.stdout
    shorter = runner.invoke(app, ["evaluate", str(SHIPPED), "--duration", "0.5"])
    assert shorter.exit_code == 2 and "--duration must be at least the window, 1 s" in shorter.stderr


@pytest.mark.parametrize("content", [None, b"rubbish"])
def test_evaluate_refuses_a_file_it_cannot_read(tmp_path, content):
    path = tmp_path / "p.pt"
    if content is not None:
        path.write_bytes(content)
    result = runner.invoke(app, ["evaluate", str(path), "--json"])
    assert result.exit_code == 2
    assert str(path) in json.loads(result.stdout)["error"]


def test_unknown_options_exit_2_without_a_traceback():
    for arguments in (["train", "pendulum", "--bogus"], ["train", "pendulum", "--out", "p.pt", "--steps", "many"]):
        result = runner.invoke(app, arguments)
        assert result.exit_code == 2
        assert "Traceback" not in result.stderr


def test_help_lists_every_option_of_a_run():
    from dataclasses import fields

    from controllers.options import TrainingOptions

    text = runner.invoke(app, ["train", "--help"]).stdout
    for option in fields(TrainingOptions):
        assert f"--{option.name.replace('_', '-')} " in text


def test_help_loads_no_torch():
    code = "import sys; import controllers.cli; print('torch' in sys.modules, 'gymnasium' in sys.modules)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.split() == ["False", "False"]


@pytest.fixture(scope="module")
def certificate(tmp_path_factory):
    """Of the shipped policy of the pendulum: V <= 0.3, quickly."""
    found = certify_roa("pendulum", SHIPPED, tmp_path_factory.mktemp("certificate"), level=0.3)
    assert found.certificate is not None, found.reason
    return found.certificate


def _evaluate(*arguments):
    return runner.invoke(app, ["evaluate", *map(str, arguments), "--json"])


@pytest.mark.slow
def test_evaluate_counts_the_states_in_the_proved_set(certificate):
    """Each decided by itself, in rationals, also where thousands are asked about."""
    done = _evaluate(SHIPPED, "--states", 300, "--seed", 5, "--certificate", certificate)
    assert done.exit_code == 0, done.stderr
    found = json.loads(done.stdout)["proved"]
    proved = proved_set(certificate)
    states = initial_states(get_system("pendulum"), 300, 5)
    each = [
        proved.locate(tuple((Fraction(v),) * 2 for v in x)).answer is Containment.CONTAINED for x in states.tolist()
    ]
    assert found == {
        "inside": sum(each),
        "states": 300,
        "claim": "asymptotic",
        "certificate_sha256": hashlib.sha256(certificate.read_bytes()).hexdigest(),
    }
    assert 0 < found["inside"] < 300
    said = runner.invoke(app, ["evaluate", str(SHIPPED), "--states", "20", "--certificate", str(certificate)]).stdout
    assert re.search(r"in the proved set +\d+ of 20 initial states", said)


def _forged(certificate, folder, edit):
    data = json.loads(certificate.read_text())
    edit(data)
    path = folder / "forged.json"
    path.write_text(json.dumps(data))
    return path


def test_evaluate_refuses_a_certificate_that_the_checker_does(certificate, tmp_path):
    path = _forged(certificate, tmp_path, lambda data: data["levels"].update(roa=(100.0).hex()))
    done = _evaluate(SHIPPED, "--states", 5, "--certificate", path)
    assert done.exit_code == 2
    assert "must be a certificate that the checker accepts; it says REJECTED" in json.loads(done.stdout)["error"]


def test_evaluate_refuses_a_certificate_of_another_policy(certificate, tmp_path):
    """The policy with its last weight moved by one unit in the last place."""
    policy = load_policy(SHIPPED)
    last = policy.network.weights[-1].copy()
    last[0, -1] = np.nextafter(last[0, -1], np.inf)
    weights = (*policy.network.weights[:-1], last)
    moved = tmp_path / "moved.pt"
    save_policy(moved, dataclasses.replace(policy, network=policy.network.with_layers(weights=weights)))
    done = _evaluate(moved, "--states", 5, "--certificate", certificate)
    assert done.exit_code == 2
    assert "must be about the policy that is evaluated" in json.loads(done.stdout)["error"]


def test_evaluate_refuses_a_certificate_of_another_plant(certificate, tmp_path):
    """The same policy, which a record sends to a heavier pendulum: the set is not proved about that."""
    policy = load_policy(SHIPPED)
    heavier = tmp_path / "heavier.pt"
    save_policy(heavier, dataclasses.replace(policy, parameters={**policy.parameters, "m": "0.2"}))
    assert load_policy(heavier).network.sha256() == policy.network.sha256()
    done = _evaluate(heavier, "--states", 5, "--certificate", certificate)
    assert done.exit_code == 2
    assert "must be about the plant that is simulated" in json.loads(done.stdout)["error"]
