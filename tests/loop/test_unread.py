"""Tensors that an import does not read: each is named, and none that could belong to the policy is left out unasked."""

from __future__ import annotations

import json
import shlex
import warnings
from collections import defaultdict, deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch

from certify.analysis.inputs import lines
from certify.cli.main import _run
from certify.errors import InputError
from certify.loop.policies import load_policy
from certify.loop.policies.importers import ImportOptions, import_policy, import_state_dict
from certify.loop.policies.importers.state_dict import read_lyapunov, read_state_dict, read_two_stage
from certify.loop.policies.importers.tensors import load_tensors
from certify.loop.policies.importers.unread import braced
from certify.lyapunov import import_lyapunov
from tests.support.foreign import TWO_STAGE, external, mlp, plant, saved, sb3

SAID = ImportOptions(states=("x0", "x1"), normaliser="none", action_scale=(Fraction(1),))
LAYERS = replace(SAID, activation="tanh", squash="identity")
ACTOR = {f"actor.{k}": v for k, v in mlp().state_dict().items()}
CRITIC = dict(mlp((2, 4, 1), seed=1).state_dict())


@dataclass
class Statistics:
    """An object beside the weights, as training programs keep their normalisers."""

    mean: np.ndarray
    rate: float = 0.5


class Config(dict[str, Any]):
    """A dictionary as programs keep their options in."""


class Pair(NamedTuple):
    """Two numbers or tensors."""

    K: Any
    b: Any


@dataclass(slots=True)
class Slotted:
    """An object without a dictionary."""

    K: Any


def traced(path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.jit.save(torch.jit.trace(mlp(), torch.zeros(1, 2)), str(path))  # type: ignore[no-untyped-call]


COULD: dict[str, tuple[dict[str, Any], str]] = {
    "a gain beside the network": ({"K": torch.ones(1, 2)}, r"K \(1, 2\).*--ignore (agent\.)?K"),
    "a gain among its layers": ({"actor.K": torch.ones(1, 2)}, r"actor\.K \(1, 2\)"),
    "a second network": ({f"base.{k}": v for k, v in CRITIC.items()}, r"base\.0\.bias"),
    "a normaliser": ({"mean": torch.ones(2), "std": torch.ones(1)}, r"mean \(2,\), (agent\.)?std \(1,\)"),
    "a spread of another size": ({"std": torch.ones(2)}, r"std \(2,\)"),
    "a scale of the action": ({"action_scale": torch.ones(1)}, "action_scale"),
    "a layer without a number": ({"actor.norm.weight": torch.ones(7)}, r"actor\.norm\.weight"),
    "a goal": ({"target": torch.ones(2), "target_state": torch.ones(2)}, "target_state"),
    "a goal in a part": ({"target.x": torch.ones(2)}, r"target\.x"),
    "networks of positions and velocities": ({f"v.{k}": v for k, v in CRITIC.items()}, r"v\.0\.bias"),
    "a named value": ({"value": torch.ones(1)}, "value"),
    "an array of numpy": ({"K": np.ones((1, 2))}, "K"),
    "a gain in a list": ({"gains": [torch.ones(1, 2)]}, r"gains\.0"),
    "a gain in a tuple": ({"gains": (1, torch.ones(1, 2))}, r"gains\.1"),
    "an object": ({"obs_rms": Statistics(np.ones(2))}, r"obs_rms\.mean"),
    "a dictionary of another class": ({"more": Config(K=torch.ones(1, 2))}, r"more\.K"),
    "a dictionary with a default": ({"more": defaultdict(list, K=torch.ones(1, 2))}, r"more\.K"),
    "a named tuple": ({"more": Pair(torch.ones(1, 2), 1)}, r"more\.0"),
    "a list of another class": ({"more": deque([torch.ones(1, 2)])}, r"more\.0"),
    "an object with slots": ({"more": Slotted(torch.ones(1, 2))}, r"more\.K"),
    "many": ({f"a{i}": torch.ones(1) for i in range(12)}, r"and 4 more.*--ignore (agent\.)?a0 --ignore .*a9\. "),
}


@pytest.mark.parametrize("name", COULD)
@pytest.mark.parametrize("wrap", [False, True])
def test_what_could_belong_to_the_policy_is_refused(name: str, wrap: bool, tmp_path: Path) -> None:
    more, message = COULD[name]
    data = ACTOR | more
    with pytest.raises(InputError, match=message):
        path = saved(tmp_path, {"agent": data, "epoch": 3} if wrap else data)
        import_policy(path, plant(), replace(LAYERS, prefix="agent.actor" if wrap else "actor"))


@pytest.mark.parametrize("name", COULD)
def test_what_a_refusal_advises_leaves_out_all_that_it_names(name: str, tmp_path: Path) -> None:
    more, options = COULD[name][0], replace(LAYERS, prefix="actor")
    path = saved(tmp_path, ACTOR | more)
    with pytest.raises(InputError) as refused:
        import_policy(path, plant(), options)
    advice = str(refused.value).split("say so: ")[1].split(". If")[0]
    ignored = tuple(shlex.split(advice.replace("--ignore", "")))
    assert len(ignored) <= len(load_tensors(path.read_bytes(), "p")) - len(ACTOR)
    plain = import_policy(saved(tmp_path, ACTOR, "plain.pt"), plant(), LAYERS)
    found = import_policy(path, plant(), replace(options, ignore=ignored))
    assert found.policy.network.sha256() == plain.policy.network.sha256()


KNOWN: dict[str, tuple[dict[str, Any], str]] = {
    "log_std": ({"log_std": torch.ones(1), "actor.logstd": torch.ones(1)}, "spread"),
    "the names of cleanrl": ({"actor_logstd": torch.ones(1, 1)}, "spread"),
    "a layer of log_std": ({"actor.log_std.weight": torch.ones(1, 5)}, "spread"),
    "std": ({"std": torch.ones(1)}, "spread"),
    "weights of losses": ({"log_sigma_pde": torch.tensor(1.0), "log_alpha": torch.ones(1)}, "spread"),
    "a critic": ({f"critic.{k}": v for k, v in CRITIC.items()}, "another network"),
    "two critics": ({f"{q}.{k}": v for q in ("q1", "qf2_target") for k, v in CRITIC.items()}, "another network"),
    "a value": ({f"ac.v_net.{k}": v for k, v in CRITIC.items()}, "another network"),
    "a target policy": ({f"target_actor.net.{k}": v for k, v in CRITIC.items()}, "another network"),
    "a target policy in short": (
        {f"ac_targ.net.{k}": v for k, v in CRITIC.items()},
        "another network",
    ),
    "an old policy": ({f"actor_old.{k}": v for k, v in mlp(seed=1).state_dict().items()}, "another network"),
    "a Lyapunov network": ({f"lyapunov.layers.{k}": v for k, v in CRITIC.items()}, "another network"),
    "Adam": ({"opt": {"state": {0: {"step": torch.tensor(1.0), "exp_avg": torch.ones(7, 2)}}}}, "optimiser"),
    "an optimiser": ({"optimizer": {"moments": torch.ones(3)}}, "optimiser"),
    "the run": ({"step": torch.tensor(3), "obs": np.ones((4, 2)), "rng_state": torch.ones(9)}, "state of the run"),
}


@pytest.mark.parametrize("name", KNOWN)
def test_what_is_known_not_to_belong_is_named_with_its_reason(name: str, tmp_path: Path) -> None:
    more, reason = KNOWN[name]
    options = replace(LAYERS, prefix="actor")
    path = saved(tmp_path, ACTOR | more)
    imported = import_policy(path, plant(), options)
    assert set(imported.not_read) == set(load_tensors(path.read_bytes(), "p")) - set(ACTOR) != set()
    assert all(reason in why for why in imported.not_read.values())
    assert imported.policy.training["imported"]["not_read"] == imported.not_read
    said = "\n".join(lines(imported))
    assert f"not read {braced(imported.not_read)}: " in said


def test_an_old_policy_beside_the_policy_is_not_asked_about(tmp_path: Path) -> None:
    """As tianshou has them."""
    path = saved(tmp_path, ACTOR | KNOWN["an old policy"][0])
    imported = import_policy(path, plant(), LAYERS)
    assert imported.words.startswith("state_dict actor ") and "actor_old.0.weight" in imported.not_read


def test_ignore_names_what_is_no_part_of_the_policy(tmp_path: Path) -> None:
    path = saved(tmp_path, ACTOR | {"K": torch.ones(1, 2), "extra.a": torch.ones(1), "extra.b": torch.ones(1)})
    plain = import_policy(saved(tmp_path, ACTOR, "plain.pt"), plant(), LAYERS)
    imported = import_policy(path, plant(), replace(LAYERS, ignore=("K", "extra.*")))
    assert imported.policy.network.sha256() == plain.policy.network.sha256()
    assert imported.not_read == dict.fromkeys(("K", "extra.a", "extra.b"), "--ignore names it")
    assert imported.policy.training["imported"]["options"]["--ignore"] == "K,extra.*"
    with pytest.raises(InputError, match=r"that are not read; found 'L'. Not read are K, extra\.\{a,b\}"):
        import_policy(path, plant(), replace(LAYERS, ignore=("K", "extra.*", "L")))
    with pytest.raises(InputError, match=r"it names what is read; found 'actor\.0\.bias'"):
        import_policy(path, plant(), replace(LAYERS, ignore=("K", "extra.*", "actor.0.bias")))
    with pytest.raises(InputError, match=r"could belong to it: extra\.a"):
        import_policy(path, plant(), replace(LAYERS, ignore=("K",)))


def test_safetensors_and_state_dicts_in_memory(tmp_path: Path) -> None:
    from safetensors.torch import save_file

    more = ACTOR | {"K": torch.ones(1, 2)}
    save_file(more, tmp_path / "p.safetensors")
    with pytest.raises(InputError, match=r"K \(1, 2\)"):
        import_policy(tmp_path / "p.safetensors", plant(), LAYERS)
    with pytest.raises(InputError, match=r"K \(1, 2\)"):
        import_state_dict(more, plant(), LAYERS)
    imported = import_state_dict(more, plant(), replace(LAYERS, ignore=("K",)))
    assert imported.compared_with is None and list(imported.not_read) == ["K"]


@pytest.mark.parametrize("kind", ["PPO", "SAC", "TD3"])
def test_files_of_stable_baselines_name_what_is_not_read(kind: str, tmp_path: Path) -> None:
    given = {} if kind == "PPO" else {"activation_fn": torch.nn.Tanh, "net_arch": [8]}
    model, _, path, _ = sb3(kind, tmp_path, **given)
    imported = import_policy(path, plant(), SAID)
    assert imported.compared_with is None and "stable-baselines3 documents" in imported.assumed
    read = {"PPO": ("mlp_extractor.policy_net.", "action_net."), "SAC": ("actor.latent_pi", "actor.mu")}
    wanted = {k for k in model.policy.state_dict() if not k.startswith(read.get(kind, ("actor.mu",)))}
    assert {name for name in imported.not_read if "/" not in name} == wanted
    assert ("pytorch_variables/log_ent_coef" in imported.not_read) == (kind == "SAC")


def test_a_tensor_that_stable_baselines_does_not_write_is_refused(tmp_path: Path) -> None:
    import io
    import zipfile

    _, _, path, _ = sb3("PPO", tmp_path)
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    state = torch.load(io.BytesIO(members["policy.pth"]), weights_only=True)
    buffer = io.BytesIO()
    torch.save(state | {"residual.gain": torch.ones(1)}, buffer)
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in (members | {"policy.pth": buffer.getvalue()}).items():
            archive.writestr(name, content)
    with pytest.raises(InputError, match=r"could belong to it: residual\.gain"):
        import_policy(path, plant(), SAID)
    assert "residual.gain" in import_policy(path, plant(), replace(SAID, ignore=("residual.*",))).not_read


def test_options_of_programs_and_of_numbers_are_kept_apart(tmp_path: Path) -> None:
    traced(tmp_path / "p.pt")
    with pytest.raises(InputError, match="--ignore must be left out"):
        import_policy(tmp_path / "p.pt", plant(), replace(SAID, ignore=("K",)))
    with pytest.raises(InputError, match="--output must be mean"):
        import_policy(saved(tmp_path, ACTOR), plant(), replace(LAYERS, output="u"))


# ------------------------------------------------------------------------------------------------ Lyapunov networks


def test_a_lyapunov_network_names_what_is_not_read(tmp_path: Path) -> None:
    network = {f"V.net.{k}": v for k, v in mlp((2, 4, 1), seed=2).state_dict().items()}
    path = saved(tmp_path, ACTOR | network | {"log_std": torch.ones(1)})
    imported = import_lyapunov(path, plant(), LAYERS, "V.net")
    assert imported.not_read == dict.fromkeys(sorted(ACTOR), "the policy beside it") | {
        "log_std": "the spread of actions in training, or a weight of a loss"
    }
    record = imported.stored.training["imported"]
    assert record["compared_with"] is None and record["not_read"] == imported.not_read
    quadratic = saved(tmp_path, ACTOR | network | {"P": torch.ones(2, 2)}, "quadratic.pt")
    with pytest.raises(InputError, match=r"all of the Lyapunov function.*P \(2, 2\)"):
        import_lyapunov(quadratic, plant(), LAYERS, "V.net")
    assert "P" in import_lyapunov(quadratic, plant(), replace(LAYERS, ignore=("P",)), "V.net").not_read
    # The policy beside it knows the network by its prefix, and nothing else.
    policy = import_policy(path, plant(), replace(LAYERS, prefix="actor"), beside="V.net")
    assert policy.not_read["V.net.0.weight"] == "the Lyapunov network that is imported beside it"
    with pytest.raises(InputError, match="could belong"):
        import_policy(path, plant(), replace(LAYERS, prefix="actor"))


# ---------------------------------------------------------------------------------------- what was compared, in words


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., Any]:
    monkeypatch.chdir(tmp_path)

    def command(*arguments: Any) -> tuple[int, str, str]:
        given = [str(a) for a in arguments]
        status = _run(given, "--json" in given)
        return (status, *capsys.readouterr())

    return command


NAMED = ("--system", "pendulum", "--states", "theta,theta_dot", "--normaliser", "none", "--action-scale", "1")


def test_nothing_is_said_to_be_compared_with_a_file_of_numbers(run: Callable[..., Any]) -> None:
    """A network with SiLU cannot be told from one with tanh by its numbers: no word may say that it was."""
    torch.manual_seed(0)
    module = torch.nn.Sequential(torch.nn.Linear(2, 5), torch.nn.SiLU(), torch.nn.Linear(5, 1))
    torch.save(module.state_dict() | {"log_std": torch.zeros(1)}, "silu.pt")
    given = ("import", "silu.pt", *NAMED, "--activation", "tanh", "--squash", "identity", "--out", "p.pt")
    status, out, _ = run(*given)
    assert status == 0
    assert "framework's own" not in out and "compared with the file's" not in out
    assert "no program: nothing was compared with the file" in out and "what --activation says" in out
    assert "folding  checked with the same numbers in numpy" in out and "not read log_std: the spread" in out
    data = json.loads(run(*given, "--json")[1])
    assert data["compared"] is None and data["compared_with"] is None and list(data["not_read"]) == ["log_std"]
    record = load_policy("p.pt").training["imported"]
    assert record["compared_with"] is None and "largest_difference" not in record
    assert record["folding_difference"] < 1e-5


def test_ignore_on_the_command_line_is_repeatable(run: Callable[..., Any]) -> None:
    torch.save(mlp().state_dict() | {"K": torch.ones(1, 2), "L": torch.ones(1), "M": torch.ones(1)}, "k.pt")
    given = ("import", "k.pt", *NAMED, "--activation", "tanh", "--squash", "identity", "--out", "p.pt")
    status, _, err = run(*given)
    assert status == 2 and "--ignore K --ignore L --ignore M" in err and not Path("p.pt").exists()
    status, out, _ = run(*given, "--ignore", "K", "--ignore", "[LM]")
    assert status == 0 and "not read {K,L,M}: --ignore names it" in out


def test_a_program_is_compared_and_says_which(tmp_path: Path) -> None:
    traced(tmp_path / "p.pt")
    imported = import_policy(tmp_path / "p.pt", plant(), SAID)
    assert imported.compared_with is not None and "not run" in imported.compared_with
    assert "compared with the operations of the file's code" in "\n".join(lines(imported))
    assert imported.policy.training["imported"]["largest_difference"] == imported.difference.largest


def test_names_in_few_words() -> None:
    names = [f"{a}.{k}.{p}" for a in ("critic", "critic_2") for k in (0, 2) for p in ("weight", "bias")]
    assert braced([*names, "K"]) == "K, {critic,critic_2}.{0,2}.{bias,weight}"
    assert braced([]) == "" and braced(["a"]) == "a" and braced(["a", "a.b"]) == "a, a.b"


# --------------------------------------------------------------------------------------------- other people's files


def test_every_tensor_of_the_external_files_is_read_or_named() -> None:
    place = external("safe_control_gym", "ppo_quadrotor_2D_stab.pt")
    if place is None:
        pytest.skip("the folder of other people's policies is not beside the project")
    tensors = load_tensors(place.read_bytes(), place.name)
    reading = read_state_dict(tensors, LAYERS, 6, 2)
    layers = {f"agent.ac.actor.pi_net.fcs.{k}.{part}" for k in range(3) for part in ("weight", "bias")}
    assert set(tensors) - set(reading.unread) == layers
    assert {"obs", "random_state.torch", "agent.ac.actor.logstd"} <= set(reading.unread)
    for file in TWO_STAGE:
        place = external("two_stage", file)
        assert place is not None
        tensors = load_tensors(place.read_bytes(), file)
        said = ImportOptions(squash=TWO_STAGE[file][2])  # type: ignore[arg-type]
        policy, function = read_two_stage(tensors, said), read_lyapunov(tensors, None, said)
        layers = {name for name in tensors if ".layers." in name}
        centred = {name for name in tensors if name.endswith(("controller.b", "controller.x_equilibrium"))}
        assert set(tensors) - set(policy.unread) == {n for n in layers if "lyapunov" not in n} | centred
        assert set(tensors) - set(function.unread) == {n for n in layers if "lyapunov" in n}


def test_from_python_the_same_is_asked_and_told(tmp_path: Path) -> None:
    from certify.analysis.api import certify_roa

    said = {"states": "theta,theta_dot", "activation": "tanh", "squash": "tanh", "normaliser": "none"}
    said |= {"action_scale": 6}  # type: ignore[dict-item]
    state = mlp((2, 4, 1)).state_dict() | {"K": torch.ones(1, 2)}
    with pytest.raises(InputError, match=r"K \(1, 2\).*`ignore` K.*in `importing`"):
        certify_roa("pendulum", state, importing=said)
    for ignore in ("K", ["K"]):
        result = certify_roa("pendulum", state, importing=said | {"ignore": ignore}, max_boxes=1, effort=0.04)
        told = "\n".join(result.notices)
        assert "not read K: `ignore` names it" in told and "nothing was compared with the file" in told


@pytest.mark.parametrize("name", ["00.bias", ".0.bias", "actor.00.bias", "actor.00.weight"])
def test_a_name_that_only_looks_like_a_layers_is_refused(name: str) -> None:
    """It was left out without a word, and the layer had no bias."""
    prefix = "actor." if name.startswith("actor.") else ""
    tensors = {prefix + k: v for k, v in mlp().state_dict().items()}
    tensors[name] = tensors.pop(f"{prefix}0.bias") if name.endswith("bias") else torch.ones(2, 2)
    with pytest.raises(InputError, match=rf"found {name.replace('.', chr(92) + '.')}, which is neither"):
        import_state_dict(tensors, plant(), LAYERS)
