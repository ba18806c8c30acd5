"""`certify import`, and `certify roa --policy` with the file of another program."""

from __future__ import annotations

import base64
import json
import pickle
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from certify.cli.main import _run
from certify.loop.policies import Policy, PolicyNetwork, load_policy, save_policy
from certify.lyapunov import Neural, load_lyapunov
from tests.support.foreign import TWO_STAGE, external, mlp, sb3, values

PLANT = """
name = "chain"
states = ["x0", "x1"]
inputs = ["u"]
[parameters]
k = 2
[dynamics]
x0 = "x1"
x1 = "-k*x0 - k*x1 + u/100"
[u_eq]
u = "0"
[domain]
x0 = [-50, 5]
x1 = [-5, 5]
[input_bounds]
u = [-6, 6]
"""
SAID = (
    "--states",
    "x0,x1",
    "--activation",
    "tanh",
    "--squash",
    "identity",
    "--normaliser",
    "none",
    "--action-scale",
    "1",
)
Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    monkeypatch.chdir(tmp_path)
    Path("plant.toml").write_text(PLANT)
    torch.save(mlp().state_dict(), "weights.pt")

    def command(*arguments: Any) -> tuple[int, str, str]:
        given = [str(a) for a in arguments]
        status = _run(given, "--json" in given)
        out, err = capsys.readouterr()
        assert "Traceback" not in out + err
        return status, out, err

    return command


def test_import_says_what_it_found_and_writes_a_policy(run: Run) -> None:
    status, out, _ = run("import", "weights.pt", "--out", "p.pt", "--system", "plant.toml", *SAID)
    assert status == 0
    for words in (
        "state_dict",
        "10,000 states",
        "pi(0)",
        "u_eq 0",
        "--centre output changes u by up to",
        "p.pt",
        "(x0, x1)",
    ):
        assert words in out
    assert load_policy("p.pt").network.layers == (2, 7, 5, 1)


def test_import_as_json(run: Run) -> None:
    clip, centre = ("--clip", "-1:2"), ("--centre", "output", "--action-offset", "1/3", "--param", "k=3")
    status, out, _ = run(
        "import", "weights.pt", "--out", "p.pt", "--system", "plant.toml", *SAID, *clip, *centre, "--json"
    )
    assert status == 0 and out.count("\n") == 1
    data = json.loads(out)
    policy = load_policy("p.pt")
    assert data["policy"]["sha256"] == policy.network.sha256() and policy.parameters == {"k": "3"}
    assert policy.network.clip is not None and policy.network.clip[0][0] == float(-2 / 3)
    assert data["compared"] is None and data["compared_with"] is None and "--activation" in data["assumed"]
    assert data["folding"]["states"] == 10_000 and data["folding"]["in_double_precision"] < 1e-12
    assert data["imported"]["compared_with"] is None and "largest_difference" not in data["imported"]
    assert data["not_read"] == {} == data["imported"]["not_read"]
    assert data["centre"] == "output" and data["centring_changes_u_by"]["output"] == pytest.approx(abs(data["pi_0"][0]))
    assert data["imported"]["options"]["--action-offset"] == "1/3"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--system", "plant.toml"], "required: --states x0,x1"),
        ([*SAID], "name the plant with --system"),
        (["--system", "plant.toml", *SAID, "--clip", "1"], "--clip takes LO..HI"),
        (["--system", "plant.toml", *SAID, "--clip", "2:1"], "lo < hi"),
        (["--system", "plant.toml", *SAID, "--action-offset", "one"], "--action-offset"),
        (["--system", "plant.toml", *SAID, "--epsilon", "1,2"], "--epsilon takes one number"),
        (["--system", "plant.toml", *SAID[2:], "--states", "x0,cos_x1"], "cos_x1"),
        (["--system", "plant.toml", *SAID, "--from", "sb3"], "--from says"),
        (["--system", "plant.toml", *SAID[:2], "--activation", "prelu"], "found 'prelu'"),
        (["--system", "plant.toml", *SAID, "--stats", "x"], "No such option"),
    ],
)
def test_wrong_options_end_with_status_2_and_one_sentence(run: Run, arguments: list[str], message: str) -> None:
    for last in ([], ["--json"]):
        status, out, err = run("import", "weights.pt", "--out", "p.pt", *arguments, *last)
        assert status == 2 and message in (json.loads(out)["error"] if last else err) and not Path("p.pt").exists()
        given = ["roa", "--policy", "weights.pt", "--out", "o", *arguments, *last]
        status, out, err = run(*given)
        assert status == 2 and message in (json.loads(out)["error"] if last else err)


def test_an_action_space_that_is_the_input_bounds_is_said_to_be_u(run: Run, tmp_path: Path) -> None:
    sb3("PPO", tmp_path)
    given = (
        "PPO.zip",
        "--system",
        "plant.toml",
        "--states",
        "x0,x1",
        "--normaliser",
        "normaliser.pkl",
        "--out",
        "p.pt",
    )
    status, out, _ = run("import", *given)
    assert status == 0 and "action   its space is the plant's input bounds, so the output is taken as u; if" in out
    assert "the output is taken as u" not in run("import", *given, "--action-scale", 1)[1]


@pytest.mark.slow
def test_roa_reads_another_programs_file_and_keeps_to_where_no_observation_is_clipped(run: Run, tmp_path: Path) -> None:
    sb3("PPO", tmp_path)
    given = ("--system", "plant.toml", "--states", "x0,x1", "--normaliser", "normaliser.pkl", "--claim", "practical")
    quick = ("--candidate", "lyapunov")
    status, out, err = run("roa", "--policy", "PPO.zip", *given, *quick, "--out", "o", "--json")
    assert status == 0 and json.loads(out)["verdict"] == "PROVED"
    assert "the domain of x0 is cut to" in err and "largest difference" in err
    certificate = json.loads(Path("o/certificate.json").read_text())
    [at, _] = np.frombuffer(base64.b64decode(certificate["policy"]["origin"]))  # where the loop rests
    lo, hi = (eval_fraction(text) + at for text in certificate["plant"]["domain"][0])
    valid = np.array([lo, hi])
    state = pickle.loads(Path("normaliser.pkl").read_bytes())
    reach = state.clip_obs * np.sqrt(state.obs_rms.var[0] + state.epsilon)
    assert lo > state.obs_rms.mean[0] - reach - 1e-12 and hi <= min(5, state.obs_rms.mean[0] + reach + 1e-12)
    assert np.max(np.abs(valid)) < 50
    # the same through a policy file
    assert run("import", "PPO.zip", *given[:6], "--out", "p.pt")[0] == 0
    status, out, err = run(
        "roa", "--policy", "p.pt", "--system", "plant.toml", "--claim", "practical", *quick, "--out", "q", "--json"
    )
    assert status == 0 and "is cut to" in err
    again = json.loads(Path("q/certificate.json").read_text())
    assert again["plant"] == certificate["plant"] and again["policy"] == certificate["policy"]
    # a domain inside is left as it is; one beyond is cut
    inside = run(
        *("roa", "--policy", "p.pt", "--system", "plant.toml", "--domain", "x0=0.05", "--claim", "practical"),
        *(*quick, "--out", "r"),
    )
    assert "the domain of x0 is cut" not in inside[2]


def beside() -> torch.nn.Sequential:
    """A Lyapunov network; it is written beside the policy."""
    module = mlp((2, 6, 1), seed=5)
    state = {f"actor.{k}": v for k, v in mlp().state_dict().items()}
    torch.save(state | {f"V.{k}": v for k, v in module.state_dict().items()}, "both.pt")
    return module


def test_the_lyapunov_network_beside_the_policy(run: Run) -> None:
    module, given = (
        beside(),
        ("import", "both.pt", "--system", "plant.toml", *SAID, "--prefix", "actor", "--param", "k=3"),
    )
    wanted = ("--lyapunov-out", "V.pt", "--lyapunov-prefix", "V")
    status, out, _ = run(*given, "--out", "p.pt", *wanted)
    assert status == 0
    for words in ("lyapunov V 2-6-1, as certify-lyapunov/1", "what increases strictly", "N(0)", "not imported", "V.pt"):
        assert words in out
    assert out.count("10,000 states") == 2 and "sigmoid" not in out
    stored = load_lyapunov("V.pt")
    assert isinstance(stored.function, Neural) and stored.parameters == {"k": "3"} and stored.system == "chain"
    x = np.random.default_rng(0).uniform(-1, 1, (20, 2))
    np.testing.assert_allclose(stored.function(x), values(module, x)[:, 0], rtol=1e-12)
    # without --lyapunov-out the network could belong to the policy; with --ignore the policy is the same
    status, _, err = run(*given, "--out", "q.pt")
    assert status == 2 and "--ignore 'V.*'" in err and not Path("q.pt").exists()
    status, plain, _ = run(*given, "--ignore", "V.*", "--out", "q.pt")
    assert load_policy("p.pt").network.sha256() == load_policy("q.pt").network.sha256()
    same = plain.replace("q.pt", "p.pt").replace("--ignore names it", "the Lyapunov network that is imported beside it")
    assert same.splitlines() == out.splitlines()[: plain.count("\n")]
    data = json.loads(run(*given, "--out", "p.pt", *wanted, "--json")[1])
    found = data["lyapunov"]
    assert (found["path"], found["format"], found["widths"]) == ("V.pt", "certify-lyapunov/1", [2, 6, 1])
    assert found["level"] is None and found["N_0"] == stored.function(np.zeros(2))
    assert found["compared"] is None and "--activation" in found["assumed"]
    assert found["folding"]["states"] == 10_000 and found["folding"]["in_double_precision"] < 1e-12
    assert set(found["not_read"].values()) == {"the policy beside it"} and len(found["not_read"]) == 6
    assert json.loads(run(*given, "--ignore", "V.*", "--out", "p.pt", "--json")[1])["lyapunov"] is None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--lyapunov-prefix", "V"], "--lyapunov-prefix must go with --lyapunov-out"),
        (["--lyapunov-out", "V.pt"], "required: --lyapunov-prefix"),
        (["--lyapunov-out", "V.pt", "--lyapunov-prefix", "W"], "no tensor is called W.0.weight"),
        (["--lyapunov-out", "./p.pt", "--lyapunov-prefix", "V"], "must be two files"),
    ],
)
def test_without_a_lyapunov_network_nothing_is_written(run: Run, arguments: list[str], message: str) -> None:
    beside()
    status, _, err = run(
        "import", "both.pt", "--system", "plant.toml", *SAID, "--prefix", "actor", "--out", "p.pt", *arguments
    )
    assert status == 2 and message in err
    assert not Path("p.pt").exists() and not Path("V.pt").exists()


@pytest.mark.parametrize("name", TWO_STAGE)
def test_both_networks_of_the_two_stage_checkpoints(name: str, run: Run) -> None:
    path = external("two_stage", name)
    if path is None:
        pytest.skip("the folder of other people's policies is not beside the project")
    plant, states, squash, scale, parameters = TWO_STAGE[name]
    given = ["--from", "two-stage", "--system", plant, "--states", states, "--squash", squash, "--action-scale", scale]
    given += [part for k, v in parameters.items() for part in ("--param", f"{k}={v}")]
    status, out, err = run("import", path, *given, "--out", "p.pt", "--lyapunov-out", "V.pt")
    assert status == 0, err
    assert "the file's V is sigmoid(N)" in out and "log(v / (1 - v))" in out
    assert load_lyapunov("V.pt").function.n == load_policy("p.pt").network.n


def eval_fraction(text: str) -> float:
    from fractions import Fraction

    return float(Fraction(text))


def test_options_of_other_programs_do_not_go_with_a_policy_file_of_this_one(run: Run) -> None:
    network = PolicyNetwork.of_layers((np.ones((1, 2)),), (np.zeros(1),), np.ones(1), np.zeros(1), "tanh", "none")
    save_policy("own.pt", Policy(network, "chain"))
    status, _, err = run("roa", "--policy", "own.pt", "--system", "plant.toml", "--states", "x0,x1", "--out", "o")
    assert status == 2 and "--states must be left out" in err
    status, _, err = run("import", "own.pt", "--out", "p.pt", "--system", "plant.toml")
    assert status == 2 and "already" in err


def test_bounds_for_another_number_of_states_are_refused(run: Run) -> None:
    network = PolicyNetwork.of_layers((np.ones((1, 3)),), (np.zeros(1),), np.ones(1), np.zeros(1), "tanh", "none")
    save_policy("own.pt", Policy(network, "chain", valid=np.array([[-1.0, 1.0]] * 3)))
    status, _, err = run("roa", "--policy", "own.pt", "--system", "plant.toml", "--out", "o")
    assert status == 2 and "3 states" in err


def test_layer_norm_is_an_option(run: Run) -> None:
    layers = torch.nn.Linear(2, 4), torch.nn.LayerNorm(4, eps=0.01), torch.nn.Tanh(), torch.nn.Linear(4, 1)
    torch.save(torch.nn.Sequential(*layers).state_dict(), "norm.pt")
    given = "import", "norm.pt", "--out", "p.pt", "--system", "plant.toml", *SAID
    assert run(*given)[0] == 2 and "--norm layer-before" in run(*given)[2]
    status, out, _ = run(*given, "--norm", "layer-before", "--norm-epsilon", "0.01")
    assert status == 0 and "with layer normalisation" in out
    status, _, err = run(*given, "--norm", "layer-before", "--norm-epsilon", "1,2")
    assert status == 2 and "--norm-epsilon takes one number" in err


MOVED = """
name = "moved"
states = ["p", "v"]
inputs = ["F"]
[parameters]
m = 0.5
[dynamics]
p = "v"
v = "F - v - (p - m)"
[u_eq]
F = 0
[x_eq]
p = "m"
[domain]
p = [-2, 2]
v = [-4, 4]
[input_bounds]
F = [-10, 10]
"""
GAIN = ("--states", "p,v", *SAID[2:])


@pytest.mark.parametrize(
    ("plant", "more", "message"),
    [
        (MOVED, ("--param", "m=1.5"), "with the operating point 1/2, 0; this plant has 3/2, 0"),
        (MOVED.replace("m = 0.5", "m = 1.5"), (), "with the operating point 1/2, 0; this plant has 3/2, 0"),
        (MOVED.replace('"p", "v"', '"v", "p"'), (), "the states p, v in this order; this plant has v, p"),
    ],
)
def test_an_imported_policy_reads_what_its_file_reads(
    plant: str, more: tuple[str, ...], message: str, run: Run
) -> None:
    """u = -p - v + 1/2 of the values rests elsewhere where the plant does: its numbers hold the operating point."""
    torch.save({"0.weight": torch.tensor([[-1.0, -1.0]]), "0.bias": torch.tensor([0.5])}, "gain.pt")
    Path("moved.toml").write_text(MOVED)
    Path("other.toml").write_text(plant)
    assert run("import", "gain.pt", "--system", "moved.toml", *GAIN, "--observes", "absolute", "--out", "p.pt")[0] == 0
    status, out, err = run("roa", "--policy", "p.pt", "--system", "other.toml", *more, "--effort", "0.2")
    assert status == 2 and not out and message in err and "Import its file again" in err


@pytest.mark.slow
def test_a_policy_of_deviations_goes_with_another_operating_point(run: Run) -> None:
    torch.save({"0.weight": torch.tensor([[-1.0, -1.0]]), "0.bias": torch.zeros(1)}, "gain.pt")
    Path("moved.toml").write_text(MOVED)
    assert run("import", "gain.pt", "--system", "moved.toml", *GAIN, "--observes", "deviation", "--out", "p.pt")[0] == 0
    more = ("--param", "m=1.5", "--candidate", "ellipsoid", "--effort", "0.2")
    status, out, _ = run("roa", "--policy", "p.pt", "--system", "moved.toml", *more)
    assert status == 0 and "attracted by the operating point" in " ".join(out.split())


def test_observations_are_those_of_the_import(run: Run) -> None:
    """The parameters of observations are numbers of the policy."""
    torch.save({"0.weight": torch.tensor([[-1.0, -1.0]]), "0.bias": torch.zeros(1)}, "gain.pt")
    plant = MOVED.replace('[x_eq]\np = "m"', '[observations]\nscaled = "p/k"\nv = "v"').replace("(p - m)", "p")
    Path("moved.toml").write_text(plant.replace("m = 0.5", "k = 2"))
    assert run("import", "gain.pt", "--system", "moved.toml", *SAID[2:], "--out", "p.pt")[0] == 0
    status, _, err = run("roa", "--policy", "p.pt", "--system", "moved.toml", "--param", "k=3", "--effort", "0.2")
    assert status == 2 and "the observations p/2, v; this plant has p/3, v" in err


def test_names_and_parameters_in_observations(run: Run) -> None:
    """Observations may use names of [where] that stand for expressions of states and parameters, --states parameters;
    a policy with these numbers is not used with others, nor with a range."""
    torch.save({"0.weight": torch.tensor([[-1.0, -1.0]]), "0.bias": torch.zeros(1)}, "gain.pt")
    plain = MOVED.replace('[x_eq]\np = "m"\n', "").replace("(p - m)", "p").replace("m = 0.5", "k = 2")
    where = '[where]\ntip = "p/k + v"\npush = "F/k"\n[observations]\ntip = "tip"\nv = "v"\n'
    Path("where.toml").write_text(plain + where)
    Path("plain.toml").write_text(plain)
    Path("range.toml").write_text(plain.replace("k = 2", "k = [1, 3]"))
    assert run("import", "gain.pt", "--system", "where.toml", *SAID[2:], "--out", "w.pt")[0] == 0
    states = ("--states", "p/k + v,v", *SAID[2:])
    assert run("import", "gain.pt", "--system", "plain.toml", *states, "--out", "p.pt")[0] == 0
    x = np.array([[0.5, -1.25]])
    assert [load_policy(f).network(x, (Fraction(0),)).item() for f in ("w.pt", "p.pt")] == [2.25, 2.25]
    status, _, err = run("roa", "--policy", "p.pt", "--system", "plain.toml", "--param", "k=3", "--effort", "0.2")
    assert status == 2 and "to read states with k = 2; this plant has k = 3" in err
    status, _, err = run("import", "gain.pt", "--system", "range.toml", *states, "--out", "p.pt")
    assert status == 2 and "'k' is no state or parameter" in err
    Path("where.toml").write_text(plain + where.replace('tip = "tip"', 'tip = "push"'))
    status, _, err = run("import", "gain.pt", "--system", "where.toml", *SAID[2:], "--out", "w.pt")
    assert status == 2 and "observations.tip" in err and "'push' is no state, parameter or name of [where]" in err
