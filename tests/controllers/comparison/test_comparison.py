"""The comparison: sums, quartiles and counts against hand-computed ones, resuming, divergence, figures, the command."""

from __future__ import annotations

import csv
import io
import json
import math
import sys
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from certify.certificates import sole_writer
from certify.errors import BackendError, InputError
from certify.loop.plants import get_system
from certify.loop.policies import load_policy
from certify.provers.execution.tasks import Cluster, Processes
from controllers.cli import app
from controllers.comparison import comparison, learners, places, runs
from controllers.comparison.learning_curve import Measurement
from controllers.comparison.methods import ABLATIONS, BASELINES, OURS, Method, remaining
from controllers.comparison.options import CompareOptions
from controllers.comparison.stopping import Stopping
from controllers.comparison.table import Response, quartiles, table
from controllers.figures import comparison as figures
from controllers.options import get_plant, preset
from controllers.plants.shipped import pendulum
from controllers.simulation import closed_loop
from controllers.simulation.trajectories import simulate
from controllers.storage import make_folder
from controllers.training.trainer import Trainer
from tests.support.marks import slow_after
from tests.support.pieces import Here

TINY = replace(preset("pendulum"), steps=160, warm_up=60, n_A=25, n_B=25, batch=8, actor=(6, 5), critic=(7,))
SHORT = CompareOptions(seeds=1, states=4, duration=1.2)
SAC = Method("sac", False)

KEPT = {"ours": (), "sac": ("actor.pt",), "sb3-ppo": ("model.zip",), "sb3-sac": ("model.zip",)}
COMMON = ("course.json", "curve.csv", "policy.pt")

runner = CliRunner()


@pytest.fixture(scope="module")
def pendulum_system():
    return get_system("pendulum")


@pytest.fixture(scope="module", autouse=True)
def _judged_in_little_time():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(learners, "_JUDGED", CompareOptions(states=3, start_seed=1, duration=1.2))
        yield


DRAW = figures._drawings


@pytest.fixture(autouse=True)
def _drawn_in_no_time(monkeypatch):
    """Figures are drawn by `finished`, and where a test is about them: they take longer than all the rest."""
    names = ("cost", "curves", "norm", "positions", "states")
    monkeypatch.setattr(figures, "_drawings", lambda *_: dict.fromkeys(names, b"\x89PNG"))


def _compared(system, training, runs, out, *rest, **named):
    make_folder(out)
    return figures.write_comparison(comparison.compare(system, training, runs, *rest, **named), out)


@pytest.fixture(scope="module")
def finished(pendulum_system, tmp_path_factory):
    """A whole comparison: its folder of runs, of results, and what it returned."""
    folder, out = tmp_path_factory.mktemp("runs"), tmp_path_factory.mktemp("results") / "new"
    lines = []
    result = _compared(pendulum_system, TINY, folder, out, SHORT, lines.append)
    return folder, out, result, lines


def test_quartiles_are_numpy_s_for_finite_numbers_and_survive_infinity():
    values = np.random.default_rng(0).standard_normal((3, 10))
    np.testing.assert_allclose(quartiles(values), np.quantile(values, [0.25, 0.5, 0.75], axis=-1), rtol=0, atol=1e-15)
    inf = math.inf
    assert quartiles(np.array([5.0])).tolist() == [5.0, 5.0, 5.0]
    assert quartiles(np.array([inf, 1.0, 2.0, 3.0])).tolist() == [1.75, 2.5, inf]
    assert quartiles(np.array([inf, inf, 1.0, inf])).tolist() == [inf, inf, inf]
    assert quartiles(np.array([1.0, 2.0, 3.0, 4.0, inf])).tolist() == [2.0, 3.0, 4.0]


def test_a_divergent_trajectory_is_counted_and_costs_infinity(pendulum_system, monkeypatch):
    monkeypatch.setattr(closed_loop, "DIVERGED", 5.0)
    x0, asked = np.array([[0.0, 0.0], [1.0, 0.0]]), []

    def act(x):
        asked.append(x.copy())
        return 6.0 * np.sign(x[:, :1])

    states, cost = simulate(pendulum_system, TINY, act, x0, 1.0)
    assert np.all(np.isfinite(asked))
    gone = np.isnan(states[:, 1]).any(axis=1)
    first = int(gone.argmax())
    assert 0 < first < 50 and gone[first:].all() and not gone[:first].any()
    assert np.isfinite(cost[:first, 1]).all() and np.isinf(cost[first:, 1]).all()
    assert (cost[:, 0] == 0).all()
    [row, pooled] = table(pendulum_system, 0.02, [Response(OURS, 0, 160, states, cost)], CompareOptions(duration=1.0))
    assert (row.trajectories, row.settled, row.diverged, row.left_domain) == (2, 1, 1, 1)
    assert row.cost_lower == row.cost_median == row.cost_upper == math.inf
    assert row.as_json()["cost_median"] is None and row.as_json()["floor"] is None
    assert replace(pooled, seed=0) == row


def test_the_floor_is_the_median_of_the_largest_norm_in_the_last_second(pendulum_system):
    x = np.zeros((101, 3, 2))
    x[:, :, 0] = [1e-3, 2e-3, 1e-9]
    x[50, 0] = [0.3, 0.4]  # the last second begins here
    x[49, 1] = [9.0, 0.0]  # before it; outside the domain
    response = Response(SAC, 0, 160, x, np.tile([1.0, 2.0, 4.0], (101, 1)))
    other = replace(response, seed=1, x=0 * x)
    rows = table(pendulum_system, 0.02, [response, other], CompareOptions(duration=2.0))
    assert [(r.method, r.seed, r.trajectories) for r in rows] == [
        ("sac mean", 0, 3),
        ("sac mean", 1, 3),
        ("sac mean", None, 6),
    ]
    assert rows[0].floor == 2e-3 and rows[0].settled == 1 and rows[0].left_domain == 1
    assert (rows[0].cost_lower, rows[0].cost_median, rows[0].cost_upper) == (1.5, 2.0, 3.0)
    assert rows[2].settled == 4 and rows[2].floor == pytest.approx(5e-10)
    later = x.copy()
    later[50] = x[51]
    assert table(pendulum_system, 0.02, [replace(response, x=later)], CompareOptions(duration=2.0))[0].floor == 1e-3


def test_a_comparison_trains_every_run_and_writes_figures_and_table(finished):
    folder, out, result, lines = finished
    assert sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()) == [
        f"{run}/seed-0/{name}"
        for run in ("ours", "sac", "sb3-ppo", "sb3-sac")
        for name in sorted((*COMMON, *KEPT[run]))
    ]
    assert "sac seed 0: 160 of 160 steps" in lines and "sb3-ppo seed 0: 16 of 160 steps" in lines
    for name in ("cost", "norm", "states"):
        assert (out / f"pendulum-{name}.png").read_bytes().startswith(b"\x89PNG")
    assert json.loads((out / "pendulum-table.json").read_text())["rows"] == result["rows"]
    with (out / "pendulum-table.csv").open(newline="") as file:
        written = list(csv.DictReader(file))
    assert [(row["method"], row["seed"]) for row in written] == [(m.name, s) for m in BASELINES for s in ("0", "all")]
    assert [float(row["floor"]) for row in written] == [row["floor"] for row in result["rows"]]
    assert {row["trajectories"] for row in result["rows"]} == {4}
    assert {row["steps"] for row in result["rows"]} == {160}


def test_sampled_actions_give_other_figures_than_means(finished):
    rows = {row["method"]: row for row in finished[2]["rows"]}
    for run in ("sac", "sb3-sac", "sb3-ppo"):
        assert rows[f"{run} mean"]["cost_median"] != rows[f"{run} stochastic"]["cost_median"]


def test_sac_without_the_gain_is_not_centred_and_ours_is(finished, pendulum_system):
    folder = finished[0]
    ours, sac = (runs.obtain(run, pendulum_system, TINY, folder).trained for run in ("ours", "sac"))
    origin = np.zeros((1, 2))
    assert ours.mean(origin) == pytest.approx(0.0, abs=1e-15)
    assert abs(sac.mean(origin)[0, 0]) > 1e-6


def test_what_is_there_is_not_trained_again(finished, pendulum_system, tmp_path, monkeypatch):
    def refuse(*_):
        raise AssertionError("nothing is missing")

    monkeypatch.setattr(runs, "train_run", refuse)
    again = _compared(pendulum_system, TINY, finished[0], tmp_path, SHORT)
    assert again["rows"] == finished[2]["rows"]
    assert (tmp_path / "pendulum-table.csv").read_bytes() == (finished[1] / "pendulum-table.csv").read_bytes()
    with pytest.raises(AssertionError, match="nothing is missing"):  # a second seed is
        _compared(pendulum_system, TINY, finished[0], tmp_path, replace(SHORT, seeds=2))


@pytest.mark.parametrize("run", ["ours", "sac"])
def test_an_interrupted_run_of_ours_goes_on_from_its_checkpoint(finished, pendulum_system, tmp_path, run):
    chosen = TINY if run == "ours" else learners.without_gain(TINY)
    trainer = Trainer(pendulum_system, chosen)
    while trainer.steps_done < 90:
        trainer.advance()
    folder = tmp_path / run / "seed-0"
    folder.mkdir(parents=True)
    (folder / "checkpoint.pt").write_bytes(trainer.snapshot())
    lines = []
    trained = runs.obtain(run, pendulum_system, TINY, tmp_path, say=lines.append).trained
    assert lines[0] == f"{run} seed 0: 96 of 160 steps"
    x = np.random.default_rng(0).uniform(-1, 1, (5, 2))
    expected = runs.obtain(run, pendulum_system, TINY, finished[0]).trained
    np.testing.assert_array_equal(trained.mean(x), expected.mean(x))


def test_runs_of_another_plan_or_seed_are_refused(finished, pendulum_system, tmp_path):
    for run in ("ours", "sac", "sb3-sac", "sb3-ppo"):
        with pytest.raises(InputError, match="another plan: its `steps` is 160, and 170 is asked for"):
            runs.obtain(run, pendulum_system, replace(TINY, steps=170), finished[0])
    rule = Stopping(budget=300, every=50)
    with pytest.raises(InputError, match="its `kind` is fixed, and to the floor is asked for"):
        runs.obtain("sac", pendulum_system, TINY, finished[0], rule)
    (tmp_path / "ours").mkdir()
    (tmp_path / "ours" / "seed-1").symlink_to(finished[0] / "ours" / "seed-0")
    with pytest.raises(InputError, match="with seed 1 after 160 steps; it is of 160 steps with seed 0"):
        runs.obtain("ours", pendulum_system, replace(TINY, seed=1), tmp_path)


def test_a_policy_of_unknown_origin_is_not_written_over(finished, pendulum_system, tmp_path):
    folder = tmp_path / "ours" / "seed-0"
    folder.mkdir(parents=True)
    (folder / "policy.pt").write_bytes(b"somebody's")
    with pytest.raises(InputError, match="would be written over"):
        runs.obtain("ours", pendulum_system, TINY, tmp_path)
    assert (folder / "policy.pt").read_bytes() == b"somebody's"


@pytest.mark.slow
def test_figures_hold_when_everything_diverges(finished, pendulum_system, tmp_path, monkeypatch):
    monkeypatch.setattr(closed_loop, "DIVERGED", 1e-3)
    monkeypatch.setattr(figures, "_drawings", DRAW)
    result = _compared(pendulum_system, TINY, finished[0], tmp_path, SHORT)
    assert all(row["diverged"] == 4 and row["floor"] is None and row["settled"] == 0 for row in result["rows"])
    assert len(list(tmp_path.glob("*.png"))) == 5
    assert "inf" in (tmp_path / "pendulum-table.csv").read_text()


def test_a_comparison_tells_how_far_it_is(pendulum_system, tmp_path):
    told = []
    options = replace(SHORT, methods=(OURS, SAC))
    _compared(pendulum_system, TINY, tmp_path / "runs", tmp_path, options, watch=told.append)
    assert next((d.run, d.runs) for d in told if d.done == d.steps) == (1, 2) and told[-1].run == 2
    first = [d.done for d in told if d.run == 1]
    assert first == sorted(first) and len(set(first)) == 160 and first[-1] == told[0].steps == 160
    assert {d.what for d in told} == {"ours, seed 0", "SAC without gain, seed 0"}
    again = []
    _compared(pendulum_system, TINY, tmp_path / "runs", tmp_path, options, watch=again.append)
    assert [(d.run, d.done, d.steps) for d in again] == [(1, 160, 160), (2, 160, 160)]  # nothing is trained twice


def _compare(*arguments):
    return runner.invoke(app, ["compare", *map(str, arguments)])


def test_the_command_prints_the_table_or_one_json_object(finished, tmp_path, monkeypatch):
    monkeypatch.setattr(pendulum, "PLANT", replace(get_plant("pendulum"), preset=TINY))
    sizes = ["--seeds", 1, "--duration", 1.2, "--states", 4, "--steps", 160]
    arguments = ["pendulum", "--runs", finished[0], "--out", tmp_path, *sizes]
    result = _compare(*arguments, "--json")
    assert result.exit_code == 0, result.stderr
    assert json.loads(result.stdout)["rows"] == finished[2]["rows"]
    text = _compare(*arguments)
    assert text.exit_code == 0, text.stderr
    assert text.stdout.startswith("method") and "sb3-ppo stochastic" in text.stdout
    assert str(tmp_path / "pendulum-cost.png") in text.stdout


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["spaceship"], "spaceship"),
        (["pendulum", "--seeds", "0"], "--seeds must be positive"),
        (["pendulum", "--duration", "0.5"], "--duration must be at least the window, 1 s"),
        (["pendulum", "--duration", "nan"], "--duration"),
        (["pendulum", "--without", "ours"], "--without must be one of sac, sb3-ppo, sb3-sac"),
        (["pendulum", "--jobs", "0"], "--jobs must be at least 1"),
        (["pendulum", "--jobs", "2", "--cluster", "local:2"], "--jobs must stand without --cluster"),
        (["pendulum", "--budget", "0"], "--budget must be at least 1"),
        (["pendulum", "--steps", "20", "--budget", "50"], "--steps is for runs of one length"),
        (["pendulum", "--ablations", "--without", "sb3-sac"], "--without must be one of before, sac, uncentred"),
    ],
)
def test_bad_input_is_one_sentence(tmp_path, arguments, message):
    result = _compare(*arguments, "--runs", tmp_path / "runs", "--out", tmp_path / "out")
    assert result.exit_code == 2
    assert message in result.stderr and result.stderr.startswith("Error: ") and result.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_without_stable_baselines_nothing_is_trained(tmp_path, monkeypatch):
    for name in [name for name in sys.modules if name.split(".")[0] == "stable_baselines3"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    result = _compare("pendulum", "--runs", tmp_path / "runs", "--out", tmp_path / "out")
    assert result.exit_code == 2
    assert (
        result.stderr == "Error: stable-baselines3 is not installed; "
        "`pip install '.[baselines]'` in the project's folder brings it.\n"
    )
    assert not list(tmp_path.iterdir())


def test_a_kind_of_run_can_be_left_out(finished, pendulum_system, tmp_path, monkeypatch):
    monkeypatch.setattr(comparison, "require_stable_baselines", lambda: pytest.fail("nothing of it is compared"))
    methods = remaining(BASELINES, ["sb3-sac", "sb3-ppo"])
    result = _compared(pendulum_system, TINY, finished[0], tmp_path, replace(SHORT, methods=methods))
    assert list(dict.fromkeys(row["method"] for row in result["rows"])) == ["ours", "sac mean", "sac stochastic"]
    rows = [row for row in finished[2]["rows"] if not row["method"].startswith("sb3")]
    assert result["rows"] == rows


def test_ablations_change_one_part_of_our_own_training(finished, pendulum_system, tmp_path):
    folder = tmp_path / "runs"
    for run in ("ours", "sac"):
        (folder / run).mkdir(parents=True)
        (folder / run / "seed-0").symlink_to(finished[0] / run / "seed-0")
    result = _compared(pendulum_system, TINY, folder, tmp_path / "out", replace(SHORT, methods=ABLATIONS))
    rows = {row["method"]: row for row in result["rows"]}
    assert list(rows) == ["ours", "sac mean", "before mean", "uncentred mean"]
    assert rows["ours"] == next(row for row in finished[2]["rows"] if row["method"] == "ours" and row["seed"] is None)
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        *(f"pendulum-ablations-{name}.png" for name in ("cost", "curves", "norm", "positions", "states")),
        *(f"pendulum-ablations-table.{kind}" for kind in ("csv", "json")),
    }
    records = {
        run: load_policy(folder / run / "seed-0" / "policy.pt").training for run in ("ours", "before", "uncentred")
    }
    assert [records[run]["identification"] for run in records] == ["during", "before", "during"]
    assert [records[run]["centre"] for run in records] == ["preactivation", "preactivation", "none"]
    origin = np.zeros((1, 2))
    drift = {run: runs.obtain(run, pendulum_system, TINY, folder).trained.mean(origin)[0, 0] for run in records}
    assert abs(drift["before"]) < 1e-15 and abs(drift["uncentred"]) > 1e-6


def test_a_policy_that_is_called_by_another_s_name_is_refused(finished, pendulum_system, tmp_path):
    (tmp_path / "before").mkdir()
    (tmp_path / "before" / "seed-0").symlink_to(finished[0] / "ours" / "seed-0")
    with pytest.raises(InputError, match="`identification` must be 'before' for the run before; it is 'during'"):
        runs.obtain("before", pendulum_system, TINY, tmp_path)


OF_OURS = replace(SHORT, methods=(OURS, SAC))


class Elsewhere(Here):
    """A place that is not this machine's processes: what is sent there comes back as bytes."""


@pytest.mark.slow
@pytest.mark.parametrize("place", slow_after(1, [Processes(2), Elsewhere()]), ids=["processes", "elsewhere"])
def test_where_runs_are_trained_changes_nothing(finished, pendulum_system, tmp_path, place):
    folder, lines, told = tmp_path / "runs", [], []
    result = _compared(pendulum_system, TINY, folder, tmp_path, OF_OURS, lines.append, told.append, place)
    before = {row["method"]: row for row in finished[2]["rows"]}
    for row in result["rows"]:
        if row["seed"] is None:  # but for the time that it took
            assert {**row, "wall": 0, "cpu": 0} == {**before[row["method"]], "wall": 0, "cpu": 0}
    assert result["rows"] and all(row["wall"] > 0 and row["cpu"] > 0 for row in result["rows"])
    ours = "ours/seed-0/policy.pt"
    assert (folder / ours).read_bytes() == (finished[0] / ours).read_bytes()
    kept = sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())
    assert kept == sorted(f"{run}/seed-0/{name}" for run in ("ours", "sac") for name in (*COMMON, *KEPT[run]))
    assert sorted(lines) == ["ours seed 0: 160 of 160 steps", "sac seed 0: 160 of 160 steps"]
    assert {(d.run, d.runs) for d in told} == {(1, 2), (2, 2)}
    nothing = Elsewhere()
    _compared(pendulum_system, TINY, folder, tmp_path, OF_OURS, place=nothing)
    assert nothing.done == []


def test_a_cluster_goes_on_from_the_checkpoint_that_is_here(finished, pendulum_system, tmp_path):
    trainer = Trainer(pendulum_system, TINY)
    while trainer.steps_done < 90:
        trainer.advance()
    checkpoint = tmp_path / "runs" / "ours" / "seed-0" / "checkpoint.pt"
    checkpoint.parent.mkdir(parents=True)
    checkpoint.write_bytes(trainer.snapshot())
    sent = []
    place = Elsewhere(lambda piece: sent.append(piece.arguments[3]) or piece.work(*piece.arguments))
    options = replace(SHORT, methods=(OURS,))
    _compared(pendulum_system, TINY, tmp_path / "runs", tmp_path, options, place=place)
    with zipfile.ZipFile(io.BytesIO(sent[0])) as archive:
        assert archive.read("checkpoint.pt") == trainer.snapshot()
    assert len(sent) == 1 and not checkpoint.exists()
    ours = "ours/seed-0/policy.pt"
    assert (tmp_path / "runs" / ours).read_bytes() == (finished[0] / ours).read_bytes()


@pytest.mark.parametrize("sent", slow_after(2, ["another seed", "unfinished", b"no files", b"\x80\x04N."]))
def test_what_comes_back_and_is_no_such_run_is_not_written(finished, pendulum_system, tmp_path, sent):
    content, source = sent, finished[0] / "ours" / "seed-0"
    if isinstance(sent, str):
        packed = io.BytesIO()
        with zipfile.ZipFile(packed, "w") as archive:
            for name in COMMON if sent == "another seed" else COMMON[1:]:
                archive.write(source / name, name)
            archive.writestr("../outside", b"")
        content = packed.getvalue()
    place = Elsewhere(lambda piece: content if "seed 1" in piece.key else piece.work(*piece.arguments))
    options = replace(SHORT, methods=(OURS,), seeds=2)
    message = {"another seed": "with seed 1 after", "unfinished": "would be written over|must be a run that is over"}
    message = message.get(sent, "cannot be read") if isinstance(sent, str) else "be read"
    with pytest.raises(BackendError, match=f"1 of 2 runs could not be trained, ours seed 1 among them: .*({message})"):
        _compared(pendulum_system, TINY, tmp_path / "runs", tmp_path, options, place=place)
    kept = tmp_path / "runs" / "ours"
    assert sorted(path.name for path in kept.iterdir()) == ["seed-0"] and not list(tmp_path.rglob("outside"))


def test_a_run_that_is_lost_takes_none_with_it(pendulum_system, tmp_path):
    place = Elsewhere(lambda piece: "its worker died" if piece.key.startswith("ours") else piece.work(*piece.arguments))
    with pytest.raises(BackendError, match="1 of 2 runs could not be trained, ours seed 0 among them: its worker died"):
        _compared(pendulum_system, TINY, tmp_path / "runs", tmp_path, OF_OURS, place=place)
    kept = sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.pt"))
    assert kept == ["runs/sac/seed-0/actor.pt", "runs/sac/seed-0/policy.pt"]


def test_more_bytes_than_a_run_has_are_not_unpacked(tmp_path, monkeypatch):
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("policy.pt", bytes(10**6))
        archive.writestr("curve.csv", b"step")
    monkeypatch.setattr(places, "_MOST_BYTES", 10**6)
    with pytest.raises(InputError, match="must have at most 1000000 bytes; what came back has 1000004"):
        places._unpack(packed.getvalue(), tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("damage", ["a password", "its bytes"])
def test_files_that_cannot_be_unpacked_are_one_sentence(tmp_path, damage):
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("curve.csv", bytes(range(256)) * 4)
    content = bytearray(packed.getvalue())
    if damage == "a password":
        content[content.index(b"PK\x01\x02") + 8] |= 1
        content[6] |= 1
    else:
        content[39:45] = b"\xff" * 6
    with pytest.raises(InputError, match="the files of a run that came back cannot be read"):
        places._unpack(bytes(content), tmp_path)


def test_the_best_policy_of_a_run_that_goes_on_elsewhere_comes_back_with_it(pendulum_system, tmp_path, monkeypatch):
    """It may be older than the checkpoint: then no evaluation elsewhere writes it again."""
    rule, count = Stopping(budget=120, every=40, closing=0.0), iter(range(100))
    monkeypatch.setattr(
        learners, "measure", lambda *_: Measurement(1.0 + next(count), 1.0, 0, 1)
    )  # the first one is the best

    def cut(done):
        if done == 90:
            raise KeyboardInterrupt

    folder = tmp_path / "sac" / "seed-0"
    with pytest.raises(KeyboardInterrupt):
        learners.train_run("sac", pendulum_system, TINY, folder, rule, cut)
    kept = (folder / "actor.pt").read_bytes()
    places.train_at(
        Elsewhere(),
        [runs.WantedRun("sac", TINY, rule)],
        pendulum_system,
        tmp_path,
        lambda line: None,
        lambda doing: None,
    )
    found = runs.obtain("sac", pendulum_system, TINY, tmp_path, rule)
    assert (found.finished.kept, found.finished.steps, found.trained.steps) == (40, 120, 40)
    assert (folder / "actor.pt").read_bytes() == kept


CHANGED = {"learning_rate": 1e-3, "reward_weights": (1.0, 3.0), "dt": 0.01, "state_weights": (2.0, 0.5), "batch": 9}


@pytest.mark.parametrize("run", slow_after(2, ["ours", "sac", "sb3-sac", "sb3-ppo"]))
@pytest.mark.parametrize("name", CHANGED)
def test_a_run_of_other_options_is_not_used_in_silence(finished, pendulum_system, run, name):
    """As after a change of the preset."""
    message = f"policy.pt must be of a run with the options that are asked for; its `{name}` was"
    with pytest.raises(InputError, match=message):
        runs.obtain(run, pendulum_system, replace(TINY, **{name: CHANGED[name]}), finished[0])


def test_options_that_change_nothing_in_a_run_do_not_part_it_from_the_preset(finished, pendulum_system):
    ours, learner = {"gain_weight": 2.0, "transitions": "latest"}, {"curvature_weight": 0.5, "anneal": 0.0}
    for run in ("sac", "sb3-sac", "sb3-ppo"):
        assert runs.obtain(run, pendulum_system, replace(TINY, **ours), finished[0]).finished.steps == 160
    for run in ("sb3-sac", "sb3-ppo"):
        assert runs.obtain(run, pendulum_system, replace(TINY, **learner), finished[0]).finished.steps == 160
    for run, changes in (("ours", ours), ("ours", learner), ("sac", learner)):
        with pytest.raises(InputError, match="the options that are asked for"):
            runs.obtain(run, pendulum_system, replace(TINY, **changes), finished[0])


@pytest.mark.parametrize("run", slow_after(2, ["ours", "sac", "sb3-sac", "sb3-ppo"]))
def test_a_run_on_another_pendulum_is_not_used_in_silence(finished, pendulum_system, run):
    heavier = pendulum_system.with_parameters({"m": "0.2"})
    with pytest.raises(InputError, match="must be of pendulum at the same parameters"):
        runs.obtain(run, heavier, TINY, finished[0])


def test_two_processes_do_not_train_one_run(pendulum_system, tmp_path):
    folder = tmp_path / "ours" / "seed-0"
    with (
        sole_writer(folder),
        pytest.raises(InputError, match=r"another run is writing into .*seed-0; wait for it"),
    ):
        runs.obtain("ours", pendulum_system, TINY, tmp_path)
    assert not list(folder.iterdir())


def test_a_run_that_another_process_ended_meanwhile_is_not_begun_again(finished, pendulum_system, monkeypatch):
    monkeypatch.setattr(learners, "learner_of", lambda *_: pytest.fail("it is over"))
    plan = runs.fixed("ours", TINY)
    learners.train_run("ours", pendulum_system, TINY, finished[0] / "ours" / "seed-0", plan, lambda done: None)


@pytest.mark.slow
def test_a_cluster_trains_the_same_runs(finished, pendulum_system, tmp_path):
    result = _compared(pendulum_system, TINY, tmp_path / "runs", tmp_path, SHORT, place=Cluster("local:2"))
    both = zip(result["rows"], finished[2]["rows"], strict=True)
    assert all({**row, "wall": 0, "cpu": 0} == {**other, "wall": 0, "cpu": 0} for row, other in both)
    for name in ("ours/seed-0/policy.pt", "sac/seed-0/actor.pt"):
        assert (tmp_path / "runs" / name).read_bytes() == (finished[0] / name).read_bytes()
