"""A run's history: policies kept as they would ship, distances with known values, no set without a proof."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from fractions import Fraction
from functools import partial

import numpy as np
import pytest
from typer.testing import CliRunner

from certify.certificates.verdict import Verdict
from certify.errors import InputError
from certify.loop.plants import get_system, with_input_errors
from certify.loop.policies import Policy, PolicyNetwork, load_policy, save_policy
from controllers.cli import app
from controllers.evaluation.settling import MONITORING, settle
from controllers.history.gain_distance import Distances, distances
from controllers.history.policies import PolicyWriter, RunPolicy, read_policies
from controllers.history.proofs import ProvingOptions, prove
from controllers.history.table import read_settled, table
from controllers.identification.linearisation import discrete_linearisation
from controllers.identification.riccati import riccati_gain
from controllers.options import preset
from controllers.training.trainer import Trainer, train

PENDULUM = get_system("pendulum")
OPTIONS = replace(preset("pendulum"), steps=200, warm_up=80, n_A=50, n_B=50, batch=16, critic=(8, 8))
TRAIN = ["--steps", 200, "--warm-up", 80, "--n-A", 50, "--n-B", 50, "--batch", 16, "--critic", "8,8"]
QUICK = ProvingOptions(effort=0.4, candidate="lyapunov")

runner = CliRunner()


def _run(*arguments):
    return runner.invoke(app, [*map(str, arguments)])


@pytest.fixture(scope="module", autouse=True)
def _evaluated_in_little_time():
    few = replace(MONITORING, states=2, duration=1.0, window=0.5)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("controllers.training.monitoring.settle", partial(settle, options=few))
        yield


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A short training whose policies are kept: its folder, and the policy that it ends with."""
    folder = tmp_path_factory.mktemp("run")
    done = _run(
        "train", "pendulum", *TRAIN, "--out", folder / "p.pt", "--keep", folder / "kept", "--evaluate-every", 40,
        "--evaluations", folder / "e.csv", "--checkpoint-dir", folder, "--checkpoint-every", 150, "--json",
    )  # fmt: skip
    assert done.exit_code == 0, done.stderr
    return folder


def _law(gain, **record):
    """The policy u = -gain x with this record."""
    network = PolicyNetwork.of_layers((-np.asarray(gain),), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none")
    options = {"dt": 0.02, "state_weights": [1.0, 0.5], "input_weights": [1.0], "seed": 4}
    return Policy(network, "pendulum", {"m": "0.15", "l": "0.5", "b": "0.1", "g": "9.81"}, training=options | record)


def _true():
    A, B = discrete_linearisation(PENDULUM, 0.02)
    return A, B, riccati_gain(A, B, np.diag([1.0, 0.5]), np.eye(1))


def test_the_policies_are_kept_at_the_evaluations_from_the_first_gain_on(run):
    trainer, first = Trainer(PENDULUM, OPTIONS), []
    while not first:
        trainer.advance()
        if trainer.ships:
            first.append(trainer.steps_done)
    steps = [step for step in range(40, 201, 40) if step >= first[0]]
    assert 40 < first[0] < 200 and len(steps) >= 2
    assert sorted(path.name for path in (run / "kept").iterdir()) == [f"{step:07d}.pt" for step in steps]
    history, last = read_policies(run / "kept"), load_policy(run / "p.pt")
    assert [kept.step for kept in history] == steps
    assert history[-1].policy.network.sha256() == last.network.sha256() != history[0].policy.network.sha256()
    assert dict(history[-1].policy.training) == {**last.training, "steps_done": 200}
    assert {kept.policy.training["steps"] for kept in history} == {200}
    assert [step for step, _ in read_settled(run / "e.csv")] == [40, 80, 120, 160, 200]


def test_a_policy_that_is_kept_is_the_one_that_would_have_shipped(run):
    trainer = Trainer(PENDULUM, OPTIONS)
    while trainer.steps_done < 160:
        trainer.advance()
    then = load_policy(run / "kept" / "0000160.pt")
    assert then.network.sha256() == trainer.policy().network.sha256()
    assert dict(then.training) == {**trainer.policy().training, "steps_done": 160}


def test_a_resumed_run_keeps_the_same_bytes_and_a_new_one_is_refused(run, tmp_path):
    before = {path.name: path.read_bytes() for path in (run / "kept").iterdir()}
    arguments = [
        "train",
        "pendulum",
        *TRAIN,
        "--out",
        tmp_path / "p.pt",
        "--keep",
        run / "kept",
        "--evaluate-every",
        40,
    ]
    refused = _run(*arguments)
    assert refused.exit_code == 2 and "must hold no policy of another run" in refused.stderr
    (run / "kept" / "0000200.pt").unlink()
    done = _run(*arguments, "--checkpoint-dir", run, "--resume")
    assert done.exit_code == 0, done.stderr
    assert {path.name: path.read_bytes() for path in (run / "kept").iterdir()} == before


def test_plain_sac_is_kept_from_its_first_evaluation(tmp_path):
    options = replace(OPTIONS, steps=20, warm_up=10, identification="never", gain_weight=0.0)
    train(Trainer(PENDULUM, options), PolicyWriter(tmp_path / "new", False), evaluate_every=10)
    history = read_policies(tmp_path / "new")
    assert [kept.step for kept in history] == [10, 20]
    assert all(np.isnan([each.A, each.B, each.K]).all() and each.mean > 0 for each in distances(history, PENDULUM))


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--keep", "new", "--evaluate-every", 0], "--keep needs an --evaluate-every above 0"),
        (["--keep", "/nonexistent/there/kept"], "cannot be"),
    ],
)
def test_a_folder_that_cannot_be_written_is_refused_before_training(tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    if not arguments[1].startswith("new"):
        (tmp_path / "file").write_text("")
        arguments = ["--keep", tmp_path / "file" / "kept"]
    done = _run("train", "pendulum", "--out", tmp_path / "p.pt", *arguments)
    assert done.exit_code == 2 and message in done.stderr
    assert not list(tmp_path.glob("*.pt"))


def test_policies_of_several_runs_are_no_history(tmp_path):
    save_policy(tmp_path / "0000001.pt", _law([[8.0, 2.0]], steps_done=1))
    with pytest.raises(InputError, match=r"must hold two policies or more .* found 1"):
        read_policies(tmp_path)
    save_policy(tmp_path / "0000002.pt", _law([[8.0, 2.0]], steps_done=2, seed=5))
    with pytest.raises(InputError, match="`seed` is 4 after 1 steps and 5 after 2"):
        read_policies(tmp_path)
    save_policy(tmp_path / "0000002.pt", _law([[8.0, 2.0]]))
    with pytest.raises(InputError, match=r"0000002.pt must be a policy that `controllers train --keep` wrote"):
        read_policies(tmp_path)


def test_distances_are_zero_for_what_is_true_and_known_for_what_is_not():
    A, B, K = _true()
    true = _law(K, A=A.tolist(), B=B.tolist(), K=K.tolist())
    off = _law(1.1 * K, A=(2 * A).tolist(), B=(0.5 * B).tolist(), K=(0.7 * K).tolist())
    first, second = distances([RunPolicy(1, true), RunPolicy(2, off)], PENDULUM)
    assert first == Distances(1, 0.0, 0.0, 0.0, 0.0)
    assert [second.A, second.B, second.K, second.mean] == pytest.approx([1.0, 0.5, 0.3, 0.1], rel=1e-12)
    backwards = distances([RunPolicy(1, _law(-K))], PENDULUM)[0]  # +K in the place of -K is as far as can be
    assert backwards.mean == pytest.approx(2.0, rel=1e-12)


@pytest.mark.parametrize(
    "record, message",
    [
        ({"dt": "fast"}, "must hold numbers"),
        ({"dt": None}, "`training.dt` must hold finite numbers"),
        ({"state_weights": [1.0]}, "`training.state_weights` must hold finite numbers of shape"),
        ({"K": [[float("nan"), 0.0]]}, "`training.K` must hold finite numbers"),
    ],
)
def test_a_record_that_cannot_be_used_is_refused(record, message):
    with pytest.raises(InputError, match=message):
        distances([RunPolicy(1, _law([[8.0, 2.0]], **record))], PENDULUM)
    with pytest.raises(InputError, match="must map 4 states to 1 inputs"):
        distances([RunPolicy(1, _law([[8.0, 2.0]]))], get_system("cartpole"))


def test_a_certificate_that_is_there_is_believed_only_if_it_is_accepted_and_about_this_policy(tmp_path, monkeypatch):
    kept = RunPolicy(10, _law([[8.0, 2.0]]))
    path = tmp_path / "certificate.json"
    proof = prove(kept, PENDULUM, tmp_path, QUICK)
    assert proof.verdict is Verdict.PROVED and proof.claim == "asymptotic" and proof.volume > 1
    raw, searched = path.read_bytes(), []

    def search(*_, **__):
        searched.append(1)
        raise InputError("it was searched for")

    with monkeypatch.context() as patch:
        patch.setattr("certify.analysis.api.certify_roa", search)
        again = prove(kept, PENDULUM, tmp_path, QUICK)
        np.testing.assert_array_equal(again.P, proof.P)
        assert (again.level, again.volume, again.verdict) == (proof.level, proof.volume, Verdict.PROVED)
        assert not searched
        larger = json.loads(raw)
        larger["levels"]["roa"] = (16 * float.fromhex(larger["levels"]["roa"])).hex()
        heavier = PENDULUM.with_parameters({"m": "0.2"})
        for which, plant, content in (
            (kept, PENDULUM, json.dumps(larger).encode()),  # which the checker refuses
            (kept, PENDULUM, raw[:-40]),
            (RunPolicy(10, _law([[8.5, 2.0]])), PENDULUM, raw),
            (kept, heavier, raw),
            (kept, PENDULUM.with_domain({"theta": (Fraction(-1), Fraction(1))}), raw),
            (kept, replace(PENDULUM, input_bounds=((Fraction(-1), Fraction(1)),)), raw),
            (kept, with_input_errors(PENDULUM, {"u": Fraction(1, 10)}), raw),
            (kept, PENDULUM.with_sample((Fraction(0), Fraction(1, 50))), raw),
        ):
            path.write_bytes(content)
            found = prove(which, plant, tmp_path, QUICK)
            assert (found.verdict, found.P, found.reason) == (Verdict.UNKNOWN, None, "it was searched for")
            assert searched.pop() and not path.exists()


def test_what_is_not_proved_has_no_set(tmp_path):
    unstable = prove(RunPolicy(1, _law([[-1.0, 0.0]])), PENDULUM, tmp_path / "a", QUICK)
    assert (unstable.verdict, unstable.P, unstable.volume) == (Verdict.REFUTED, None, 0.0) and unstable.reason
    late = prove(RunPolicy(2, _law([[0.73575, 1.0]])), PENDULUM, tmp_path / "b", QUICK)  # an eigenvalue at 0
    assert (late.verdict, late.P) == (Verdict.UNKNOWN, None) and "must be Hurwitz" in late.reason
    text = table([Distances(1, 0.1, 0.2, 0.3, 0.4), Distances(2, 0.1, 0.2, 0.3, 0.4)], [late]).decode()
    first, second = csv.DictReader(text.splitlines())
    assert first["verdict"] is None and second["verdict"] == "UNKNOWN" and second["volume"] == "0.0"


@pytest.fixture(scope="module")
def told(tmp_path_factory):
    """A folder of three policies: two without a stable loop, and one with the true gain."""
    folder, (A, B, K) = tmp_path_factory.mktemp("kept"), _true()
    learned = {"A": A.tolist(), "B": B.tolist(), "K": K.tolist()}
    for step, law in ((100, [[0.0, 0.0]]), (200, [[0.1, 0.0]]), (300, K)):
        save_policy(folder / f"{step:07d}.pt", _law(law, **learned, steps_done=step))
    return folder


@pytest.mark.slow
def test_the_command_draws_what_was_accepted_and_writes_the_table(told, tmp_path):
    out = tmp_path / "new" / "out"
    arguments = ["history", told, "--out", out, "--candidate", "lyapunov", "--effort", 0.4, "--json"]
    done = _run(*arguments)
    assert done.exit_code == 0, done.stderr
    result = json.loads(done.stdout)
    assert (result["policies"], result["asked"], result["accepted"], result["K"]) == (3, 3, 1, 0.0)
    assert "100 steps: REFUTED" in done.stderr and "300 steps: PROVED" in done.stderr
    for name in ("gain", "growth"):
        assert (out / f"pendulum-{name}.png").read_bytes().startswith(b"\x89PNG")
    with (out / "pendulum-history.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["step"], row["verdict"]) for row in rows] == [
        ("100", "REFUTED"),
        ("200", "REFUTED"),
        ("300", "PROVED"),
    ]
    assert float(rows[0]["mean"]) == 1.0 and float(rows[2]["mean"]) == 0.0
    assert float(rows[2]["volume"]) > 0 == float(rows[0]["volume"])
    assert (out / "0000300" / "certificate.json").is_file() and not (out / "0000100" / "certificate.json").exists()


def test_the_command_without_proofs_and_of_every_second_policy(told, tmp_path, monkeypatch):
    asked = []

    def instead(history, *_):
        asked.extend(kept.step for kept in history)
        return []

    monkeypatch.setattr("controllers.history.proofs.prove_all", instead)
    monkeypatch.setattr("controllers.figures.draw_gain", lambda *_: b"drawn")
    done = _run("history", told, "--out", tmp_path, "--no-proofs", "--json")
    assert done.exit_code == 0 and asked == [] and not list(tmp_path.glob("*growth*"))
    assert _run("history", told, "--out", tmp_path, "--every", 2, "--json").exit_code == 0
    assert asked == [100, 300]
    assert _run("history", told, "--out", tmp_path, "--every", 3, "--json").exit_code == 0
    assert asked == [100, 300, 100, 300]


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--effort", "0"], "--effort must be positive"),
        (["--every", "0"], "--every must be at least 1"),
        (["--evaluations", "missing.csv"], "missing.csv cannot be read"),
        (["--candidate", "mine"], "candidate"),
        (["--system", "spaceship"], "spaceship"),
    ],
)
def test_bad_input_is_one_sentence(told, tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    done = _run("history", told, "--out", tmp_path / "out", *arguments)
    assert done.exit_code == 2 and done.stderr.startswith("Error: ") and done.stderr.count("\n") == 1
    assert message in done.stderr


def test_a_table_that_is_none_is_refused(tmp_path):
    (tmp_path / "e.csv").write_text("step,cost\n1,2\n")
    with pytest.raises(InputError, match="must be a table that `controllers train --evaluations` wrote"):
        read_settled(tmp_path / "e.csv")
