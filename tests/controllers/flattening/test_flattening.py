"""Flattening: what falls, what stays, which bounds hold, and what is written if none can be held."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
import torch
from click.testing import CliRunner as ClickRunner
from typer.testing import CliRunner

from certify.cli.main import command_line
from certify.errors import InputError, OptionError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.equilibrium import find_rest
from certify.loop.plants import get_system
from certify.loop.policies import Policy, PolicyNetwork, load_policy, require_centred, save_policy
from controllers.cli import app
from controllers.evaluation.curvature import curvature, nonlinearity_on
from controllers.evaluation.evaluation import evaluate
from controllers.evaluation.settling import EvaluationOptions
from controllers.flattening import task as module
from controllers.flattening.flattening import FACTORS, flatten
from controllers.flattening.options import FlattenOptions
from controllers.identification.linearisation import discrete_linearisation
from controllers.options import get_plant
from controllers.simulation.trajectories import initial_states
from tests.support.marks import slow_after

PENDULUM = get_system("pendulum")
GAIN = np.array([[0.9, 0.35]])  # of net, before 6 tanh(.): a stable loop
QUICK = FlattenOptions(steps=40, batch=64, states=20)
OWN = """name = "slider"
states = ["x", "v"]
inputs = ["f"]
[dynamics]
x = "v"
v = "f/2 - 4*x**3"
[domain]
x = [-1, 1]
v = [-2, 2]
[u_eq]
f = 0
[input_bounds]
f = [-4, 4]
"""
runner = CliRunner()


def curved(centre="preactivation", squash="tanh", scale=6.0, bias=0.5, clip=None, gain=GAIN, seed=2) -> PolicyNetwork:
    """A 2-12-12-1 policy with bent hidden units whose outputs are fitted to -gain x, so that it holds the plant."""
    generator = np.random.default_rng(seed)
    W0, W1 = generator.normal(size=(12, 2)) * [1.0, 0.25], generator.normal(size=(12, 12))
    b0, b1 = bias * generator.normal(size=12), bias * generator.normal(size=12)
    x = generator.uniform(-1, 1, (400, 2)) * [1.0, 4.0]
    h = np.tanh(np.tanh(x @ W0.T + b0) @ W1.T + b1)
    at_0 = np.tanh(np.tanh(b0) @ W1.T + b1)
    last = np.linalg.lstsq(h - at_0, -x @ gain.T, rcond=None)[0].T
    rounded = [a.astype(np.float32).astype(float) for a in (W0, W1, last, b0, b1, -last @ at_0)]
    return PolicyNetwork.of_layers(
        tuple(rounded[:3]), tuple(rounded[3:]), np.array([scale]), np.zeros(1), squash, centre, clip
    )


def _record(**changes):
    return {"dt": 0.02, "state_weights": [1.0, 0.1], "input_weights": [0.1]} | changes


@pytest.fixture(scope="module")
def result():
    return flatten(Policy(curved(), "pendulum", training=_record()), QUICK)


def test_it_is_easier_to_prove_and_within_its_bounds(result):
    before, after = result.before, result.after
    assert after.departure < 0.1 * before.departure and after.bend < before.bend
    assert after.settled >= before.settled == 20
    assert after.cost <= 1.05 * before.cost
    assert result.steps == QUICK.steps and result.ended == "steps" and result.factor in FACTORS


def test_its_form_is_the_old_one(result):
    old, new = curved(), result.policy.network
    assert new.layers == old.layers and (new.squash, new.centre, new.clip) == (old.squash, old.centre, old.clip)
    np.testing.assert_array_equal(new.scale, old.scale)
    np.testing.assert_array_equal(new.offset, old.offset)
    require_centred(new, PENDULUM.exact_u_eq())
    assert all(np.array_equal(a.astype(np.float32), a) for a in (*new.weights, *new.biases))
    assert new.sha256() != old.sha256()


def test_its_figures_are_those_of_the_two_policies(result):
    old, new, u_eq = curved(), result.policy.network, PENDULUM.exact_u_eq()
    J, Jn = old.jacobian_at_origin(u_eq), new.jacobian_at_origin(u_eq)
    box = np.array(get_plant("pendulum").initial_states)
    assert result.gain_change == pytest.approx(np.linalg.norm((Jn - J) * box) / np.linalg.norm(J * box))
    assert result.gain_change < 0.05
    x0 = initial_states(PENDULUM, 64, 0)  # the first states that were visited
    change = np.abs(new(x0, u_eq) - old(x0, u_eq)).max()
    assert 0 < change <= result.largest[0] * (1 + 1e-9) and result.rms[0] < result.largest[0]
    assert result.before.bend == pytest.approx(nonlinearity_on(old, u_eq, box).bend)


def test_the_record_says_how_and_the_old_one_stays(result):
    record = result.policy.training
    assert {name: record[name] for name in _record()} == _record()
    flattened = record["flattened"]
    assert flattened["sha256"] == curved().sha256()
    assert flattened["departure"] == [result.before.departure, result.after.departure]
    assert flattened["weight"] == 1.0 and flattened["box"] == list(get_plant("pendulum").initial_states)


@pytest.mark.slow
def test_what_the_record_says_of_the_numbers_is_said_of_the_new_ones():
    K = [[5.5, 2.0]]
    old = _record(K=K, eta=0.1, distance=-1.0, curvature=-1.0)
    network = (found := flatten(Policy(curved(), "pendulum", training=old), replace(QUICK, steps=8)).policy).network
    record = found.training
    distance = np.linalg.norm(network.jacobian_at_origin(PENDULUM.exact_u_eq()) + np.array(K))
    assert record["distance"] == pytest.approx(distance) and record["K"] == K
    assert record["curvature"] == curvature(network, PENDULUM, 0.1) < curvature(curved(), PENDULUM, 0.1)
    assert evaluate(found, EvaluationOptions(states=2, duration=1.0)).curvature == record["curvature"]


@pytest.mark.slow
def test_the_same_seed_gives_the_same_policy(result):
    again = flatten(Policy(curved(), "pendulum", training=_record()), QUICK)
    assert again.policy.network.sha256() == result.policy.network.sha256()


@pytest.mark.slow
def test_a_small_weight_changes_less():
    little = flatten(Policy(curved(), "pendulum", training=_record()), replace(QUICK, weight=1e-3))
    much = flatten(Policy(curved(), "pendulum", training=_record()), replace(QUICK, weight=10.0))
    assert little.rms[0] < much.rms[0]
    assert much.after.departure < little.after.departure < little.before.departure


@pytest.mark.slow
@pytest.mark.parametrize(
    ("centre", "squash", "scale", "clip"),
    slow_after(
        1,
        [
            ("output", "tanh", 6.0, None),
            ("output", "identity", 6.0, (np.array([-6.0]), np.array([6.0]))),
            ("preactivation", "tanh", 6.0, (np.array([-5.0]), np.array([5.0]))),
        ],
    ),
)
def test_every_form_of_a_policy_can_be_flattened(centre, squash, scale, clip):
    teacher = curved(centre, squash, scale, clip=clip)
    found = flatten(Policy(teacher, "pendulum", training=_record()), QUICK)
    network, u_eq = found.policy.network, PENDULUM.exact_u_eq()
    assert found.after.departure < found.before.departure and found.after.settled == 20
    require_centred(network, u_eq)
    np.testing.assert_array_equal(network.clip or (), teacher.clip or ())
    zero = np.zeros((1, 2))
    np.testing.assert_allclose(network.net(zero), teacher.net(zero), atol=1e-5)  # what enters the squash at 0 stays


@pytest.mark.slow
def test_exact_centring_by_zero_biases_is_kept():
    teacher = curved("none", bias=0.0)
    require_centred(teacher, PENDULUM.exact_u_eq())
    network = flatten(Policy(teacher, "pendulum", training=_record()), QUICK).policy.network
    assert not any(np.any(b) for b in network.biases)
    require_centred(network, PENDULUM.exact_u_eq())


@pytest.mark.slow
def test_a_policy_without_centring_keeps_its_value_at_the_origin():
    *others, last = curved("none").biases
    teacher = curved("none").with_layers(biases=(*others, last - 0.125))  # it rests beside the origin
    found = flatten(Policy(teacher, "pendulum", training=_record()), replace(QUICK, max_cost_change=1.0))
    zero, u_eq = np.zeros((1, 2)), PENDULUM.exact_u_eq()
    np.testing.assert_allclose(found.policy.network(zero, u_eq), teacher(zero, u_eq), atol=1e-5)


def _chattering(centre="preactivation", bias=0.5) -> PolicyNetwork:
    """A policy with sixty times the gain: with actions held over 0.02 s its loop never comes to rest."""
    steep = curved(centre, bias=bias)
    return steep.with_layers(
        weights=(*steep.weights[:-1], 60 * steep.weights[-1]), biases=(*steep.biases[:-1], np.zeros(1))
    )


@pytest.mark.slow
def test_another_gain_is_the_lqr_gain_of_the_weights_that_judge():
    """A is stable under it, runs settle that did not, and the gain is that of the discrete Riccati equation."""
    old, record = _chattering(), _record(K=[[5.0, 2.0]])
    found = flatten(Policy(old, "pendulum", training=record), replace(QUICK, gain="lqr"))
    network, u_eq = found.policy.network, PENDULUM.exact_u_eq()
    K = np.array(found.policy.training["flattened"]["K"])
    A, B = discrete_linearisation(PENDULUM, record["dt"])
    Q, R = np.diag(record["state_weights"]), np.diag(record["input_weights"])
    X = scipy.linalg.solve_discrete_are(A, B, Q, R)  # another way than riccati_gain's
    np.testing.assert_allclose(K, np.linalg.solve(R + B.T @ X @ B, B.T @ X @ A), rtol=1e-6)
    np.testing.assert_allclose(network.jacobian_at_origin(u_eq), -K, rtol=0.02)
    assert found.before.settled == 0 and found.after.settled == 20
    assert found.after.cost < 0.1 * found.before.cost and found.after.departure < found.before.departure
    assert found.policy.training["flattened"]["gain"] == "lqr"
    assert found.policy.training["K"] == K.tolist() != record["K"]
    distance = np.linalg.norm(network.jacobian_at_origin(u_eq) + K)
    assert found.policy.training["distance"] == pytest.approx(distance)


@pytest.mark.slow
def test_what_changed_is_said_beside_the_old_policy_and_not_beside_the_goal():
    old = _chattering()
    found = flatten(Policy(old, "pendulum", training=_record()), replace(QUICK, gain="lqr"))
    u_eq, box = PENDULUM.exact_u_eq(), np.array(get_plant("pendulum").initial_states)
    J, Jn = old.jacobian_at_origin(u_eq), found.policy.network.jacobian_at_origin(u_eq)
    assert found.gain_change == pytest.approx(np.linalg.norm((Jn - J) * box) / np.linalg.norm(J * box))
    assert found.gain_change > 0.5
    x0 = initial_states(PENDULUM, 64, 0)
    change = np.abs(found.policy.network(x0, u_eq) - old(x0, u_eq)).max()
    assert found.largest[0] * (1 + 1e-9) >= change > 1


def test_without_a_run_that_settles_nothing_is_judged_and_nothing_flattened():
    """0 of 20 before would allow 0 of 20 after: the gain is changed if that is asked for, else the policy refused."""
    with pytest.raises(OptionError, match=r"none of 20 runs of pendulum does.*`gain` lqr"):
        flatten(Policy(_chattering(), "pendulum", training=_record()), QUICK)


@pytest.mark.slow
def test_runs_settle_towards_where_the_loop_rests():
    """A policy without centring rests beside the origin: there its runs settle, and do after flattening."""
    old = curved("none", bias=0.5)
    off = old.with_layers(biases=(*old.biases[:-1], old.biases[-1] + 0.05))
    rest = find_rest(ClosedLoop(PENDULUM, off))
    assert rest.stable and np.linalg.norm(np.array(rest.x, dtype=float)) > 1e-2
    found = flatten(Policy(off, "pendulum", training=_record()), QUICK)
    assert found.before.settled == found.after.settled == 20 and found.after.departure < found.before.departure


def test_another_gain_is_bound_by_what_the_old_policy_costs(monkeypatch):
    """The bounds are the old policy's own, whatever is copied."""
    calls = _judging(monkeypatch, lambda call: (20, 1.0 if call == 1 else 1.06))
    with pytest.raises(InputError, match="no policy within the bounds is easier to prove"):
        flatten(Policy(curved(), "pendulum", training=_record()), replace(QUICK, gain="lqr"))
    assert calls[0].sha256() == curved().sha256()


@pytest.mark.slow
def test_zero_biases_stay_under_another_gain():
    teacher = _chattering("none", bias=0.0)
    require_centred(teacher, PENDULUM.exact_u_eq())
    network = flatten(Policy(teacher, "pendulum", training=_record()), replace(QUICK, gain="lqr")).policy.network
    assert not any(np.any(b) for b in network.biases)
    require_centred(network, PENDULUM.exact_u_eq())


def test_an_lqr_gain_needs_input_weights():
    given = Policy(curved(), "pendulum", training=_record(input_weights=[0.0]))
    with pytest.raises(InputError, match="needs input weights that are positive"):
        flatten(given, replace(QUICK, gain="lqr"))
    flatten(given, replace(QUICK, gain="lqr", R=(0.1,), steps=0))


@pytest.mark.slow
def test_other_weights_give_another_gain_and_runs_are_judged_as_before():
    """Dearer inputs, less gain; what a run costs is still what the record's weights say."""
    own = flatten(Policy(curved(), "pendulum", training=_record(K=[[5.0, 2.0]])), replace(QUICK, gain="lqr"))
    wide = replace(QUICK, gain="lqr", R=(0.2,), max_cost_change=1.0)
    dear = flatten(Policy(curved(), "pendulum", training=_record(K=[[5.0, 2.0]])), wide)
    K, dear_K = (np.array(found.policy.training["K"]) for found in (own, dear))
    assert np.linalg.norm(dear_K) < np.linalg.norm(K)
    said = dear.policy.training["flattened"]
    assert (said["K"], said["Q"], said["R"]) == (dear_K.tolist(), [1.0, 0.1], [0.2])
    assert dear.policy.training["input_weights"] == [0.1] and dear.before == own.before
    u_eq = PENDULUM.exact_u_eq()
    np.testing.assert_allclose(dear.policy.network.jacobian_at_origin(u_eq), -dear_K, rtol=0.02)
    assert dear.policy.training["distance"] == pytest.approx(
        np.linalg.norm(dear.policy.network.jacobian_at_origin(u_eq) + dear_K)
    )
    cheap = flatten(Policy(curved(), "pendulum", training=_record()), replace(wide, R=None, Q=(2.0, 0.1)))
    assert cheap.policy.network.jacobian_at_origin(u_eq)[0, 0] < own.policy.network.jacobian_at_origin(u_eq)[0, 0]


@pytest.mark.parametrize("weights", [{"Q": (1.0,)}, {"R": (1.0, 1.0)}])
def test_weights_of_another_size_are_refused(weights):
    with pytest.raises(InputError, match="`Q` and `R` must have 2 and 1 weights for pendulum"):
        flatten(Policy(curved(), "pendulum", training=_record()), replace(QUICK, gain="lqr", **weights))


def test_weights_without_the_gain_that_they_are_for_are_refused():
    with pytest.raises(InputError, match='`R` must be left out unless `gain` is "lqr"'):
        replace(QUICK, R=(1.0,))
    for bad in (0.0, np.nan, np.inf):
        with pytest.raises(InputError, match="`Q` must be positive and finite weights"):
            replace(QUICK, gain="lqr", Q=(1.0, bad))


def test_time_ends_training_and_what_is_there_is_judged():
    found = flatten(Policy(curved(), "pendulum", training=_record()), replace(QUICK, time_limit=1e-3))
    assert found.ended == "time limit" and found.steps == 0
    assert found.after.departure < found.before.departure  # the contraction, which was judged


def _judging(monkeypatch, figures):
    """Let `settle` tell what a test says, by the number of the call."""
    from controllers.evaluation.settling import Settling

    calls = []

    def settle(network, *_):
        calls.append(network)
        settled, cost = figures(len(calls))
        return Settling(settled=settled, states=20, largest=0.0, left_domain=0, cost=cost, step=0.02)

    monkeypatch.setattr(module, "settle", settle)
    return calls


@pytest.mark.parametrize(
    "figures",
    slow_after(
        1,
        [
            lambda call: (20, 1.0 if call == 1 else 1.06),  # costs more than it may
            lambda call: (20 if call == 1 else 19, 0.5),  # one run less settles
            lambda call: (20, 1.0 if call == 1 else np.inf),
            lambda call: (20, 1.0 if call == 1 else np.nan),
        ],
    ),
)
def test_beyond_the_bounds_there_is_no_result(monkeypatch, figures):
    _judging(monkeypatch, figures)
    with pytest.raises(InputError, match="no policy within the bounds is easier to prove: as many of 20 runs"):
        flatten(Policy(curved(), "pendulum", training=_record()), QUICK)


def test_the_best_iterate_within_the_bounds_is_the_result(monkeypatch):
    """Only the fourth policy that is judged costs little enough: that one it is, whatever comes later."""
    calls = _judging(monkeypatch, lambda call: (20, 1.0 if call in (1, 4) else 2.0))
    found = flatten(Policy(curved(), "pendulum", training=_record()), QUICK)
    assert found.policy.network.sha256() == calls[3].sha256() and found.after.cost == 1.0
    assert [found.policy.network.sha256()] == [n.sha256() for n in calls[3:4]]


@pytest.mark.slow
def test_a_huge_weight_with_a_tight_bound_ends_honestly(tmp_path):
    """Of itself: here straight feedback costs more than the policy does, so nothing flatter is within 0 %."""
    save_policy(tmp_path / "p.pt", Policy(curved(), "pendulum", training=_record()))
    out = tmp_path / "q.pt"
    out.write_bytes(b"precious")
    done = runner.invoke(
        app,
        [
            *("flatten", str(tmp_path / "p.pt"), "--out", str(out), "--weight", "1e9", "--max-cost-change", "0"),
            *("--states", "20", "--steps", "16", "--json"),
        ],
    )
    assert done.exit_code == 2, done.stdout
    assert "no policy within the bounds" in json.loads(done.stdout)["error"]
    assert not out.exists() and (tmp_path / "q.earlier.pt").read_bytes() == b"precious"


def test_a_loop_that_diverges_has_nothing_to_compare_with(monkeypatch):
    _judging(monkeypatch, lambda call: (0, np.inf))
    with pytest.raises(InputError, match="finite median cost"):
        flatten(Policy(curved(), "pendulum", training=_record()), QUICK)


@pytest.mark.parametrize(
    ("policy", "options", "message"),
    [
        (Policy(curved(), "spaceship"), {}, "spaceship"),
        (Policy(curved(), "cartpole"), {}, "must map 4 states to 1 inputs for cartpole"),
        (Policy(curved(), "pendulum"), {"box": (1.0,)}, "`box` must have 2 half-widths"),
        (Policy(curved(), "pendulum", training={"dt": "soon"}), {}, "`training.dt` of the policy must hold numbers"),
        (Policy(curved(), "pendulum", training={"dt": 0}), {}, "`training.dt` of the policy must be positive"),
        (Policy(curved(), "pendulum", training={"state_weights": [1.0]}), {}, "`training.state_weights`"),
        (Policy(curved(gain=0 * GAIN), "pendulum"), {}, "its inputs never leave"),
        (
            Policy(PolicyNetwork.of_layers((-GAIN,), (np.zeros(1),), np.array([6.0]), np.zeros(1)), "pendulum"),
            {},
            "must have hidden units",
        ),
    ],
)
def test_what_cannot_be_flattened_is_refused(policy, options, message):
    with pytest.raises(InputError, match=message):
        flatten(policy, replace(QUICK, **options))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("weight", 0.0),
        ("weight", np.nan),
        ("box", (1.0, -1.0)),
        ("steps", -1),
        ("time_limit", 0.0),
        ("max_cost_change", -0.1),
        ("max_cost_change", np.nan),
        ("states", 0),
        ("gain", "pid"),
        ("seed", -1),
    ],
)
def test_options_out_of_their_range_are_refused(name, value):
    with pytest.raises(InputError, match=f"`{name}` must be"):
        replace(QUICK, **{name: value})


def _flatten(*arguments):
    return runner.invoke(app, ["flatten", *map(str, arguments), "--steps", "16", "--states", "10"])


def test_the_command_writes_the_policy_and_one_json_object(tmp_path):
    save_policy(tmp_path / "p.pt", Policy(curved(), "pendulum", training=_record()))
    done = _flatten(tmp_path / "p.pt", "--out", tmp_path / "q.pt", "--box", "theta=0.5", "--seed", 3, "--json")
    assert done.exit_code == 0, done.stderr
    found = json.loads(done.stdout)
    new = load_policy(tmp_path / "q.pt")
    assert found["sha256"] == new.network.sha256() and found["policy"] == str(tmp_path / "q.pt")
    assert found["after"]["departure"] < found["before"]["departure"]
    assert new.training["flattened"]["box"] == [0.5, get_plant("pendulum").initial_states[1]]
    assert new.training["flattened"]["seed"] == 3
    text = _flatten(tmp_path / "p.pt", "--out", tmp_path / "r.pt")
    assert text.exit_code == 0 and "10 of 10 settled" in text.stdout


@pytest.mark.slow
def test_the_command_says_what_to_try_where_no_run_settles(tmp_path):
    save_policy(tmp_path / "p.pt", Policy(_chattering(), "pendulum", training=_record()))
    kept = _flatten(tmp_path / "p.pt", "--out", tmp_path / "q.pt")
    assert kept.exit_code == 2 and "none of 10 runs of pendulum does" in kept.stderr and "--gain lqr" in kept.stderr
    assert not (tmp_path / "q.pt").exists()
    lqr = _flatten(tmp_path / "p.pt", "--out", tmp_path / "q.pt", "--gain", "lqr")
    assert lqr.exit_code == 0 and "10 of 10 settled" in lqr.stdout


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--box", "z=1"], "--box must name states of pendulum"),
        (["--box", "theta"], "--box must be NAME=HALF-WIDTH"),
        (["--box", "theta=wide"], "--box must be NAME=HALF-WIDTH"),
        (["--box", "theta=-1"], "--box must be positive"),
        (["--weight", "-1"], "--weight must be positive"),
        (["--gain", "pid"], "--gain must be one of"),
        (["--gain", "lqr", "--Q", "1,much"], "--Q must be numbers as in 1,1,0.1"),
        (["--R", "1"], "--R must be left out"),
        (["--system", "nowhere"], "nowhere"),
    ],
)
def test_bad_input_is_one_sentence_and_writes_nothing(tmp_path, arguments, message):
    save_policy(tmp_path / "p.pt", Policy(curved(), "pendulum", training=_record()))
    done = _flatten(tmp_path / "p.pt", "--out", tmp_path / "q.pt", *arguments, "--json")
    assert done.exit_code == 2 and "Traceback" not in done.stderr
    assert message in json.loads(done.stdout)["error"]
    assert not (tmp_path / "q.pt").exists()


def test_a_place_that_cannot_be_written_is_refused_before_training(tmp_path):
    save_policy(tmp_path / "p.pt", Policy(curved(), "pendulum", training=_record()))
    done = _flatten(tmp_path / "p.pt", "--out", tmp_path / "missing" / "q.pt")
    assert done.exit_code == 2 and "cannot be written" in done.stderr


def test_a_plant_of_ones_own_and_a_policy_that_names_it(tmp_path):
    (tmp_path / "slider.toml").write_text(OWN)
    network = curved(scale=4.0, gain=np.array([[1.0, 1.0]]))
    save_policy(tmp_path / "p.pt", Policy(network, "slider"))  # no record: dt and weights are the plant's
    refused = _flatten(tmp_path / "p.pt", "--out", tmp_path / "q.pt")
    assert refused.exit_code == 2 and "slider" in refused.stderr
    done = _flatten(tmp_path / "p.pt", "--out", tmp_path / "q.pt", "--system", tmp_path / "slider.toml", "--json")
    assert done.exit_code == 0, done.stderr
    found, new = json.loads(done.stdout), load_policy(tmp_path / "q.pt")
    assert new.system == "slider" and new.training["flattened"]["box"] == [0.5, 1.0]  # half of the domain
    assert found["after"]["departure"] < found["before"]["departure"]


@pytest.mark.slow
def test_an_imported_policy(tmp_path):
    """Weights of another program, a clip from its last step, and no record of a training."""
    network = curved(scale=12.0, gain=GAIN / 2)
    state = {f"{2 * k}.weight": torch.tensor(W).float() for k, W in enumerate(network.weights)}
    state |= {f"{2 * k}.bias": torch.tensor(b).float() for k, b in enumerate(network.biases)}
    torch.save(state, tmp_path / "agent.pth")
    imported = ClickRunner().invoke(
        command_line(),
        [
            *("import", str(tmp_path / "agent.pth"), "--system", "pendulum", "--states", "theta,theta_dot"),
            *("--activation", "tanh", "--squash", "tanh", "--normaliser", "none", "--action-scale", "12"),
            *("--clip=-0.5:0.5", "--centre", "preactivation", "--out", str(tmp_path / "p.pt")),
        ],
    )
    assert imported.exit_code == 0, imported.stderr
    old = load_policy(tmp_path / "p.pt")
    assert old.network.clip is not None and "dt" not in old.training
    done = _flatten(tmp_path / "p.pt", "--out", tmp_path / "q.pt", "--json")
    assert done.exit_code == 0, done.stderr
    new = load_policy(tmp_path / "q.pt")
    np.testing.assert_array_equal(new.network.clip, old.network.clip)
    assert new.training["imported"] == old.training["imported"]
    assert new.network.layers == old.network.layers
