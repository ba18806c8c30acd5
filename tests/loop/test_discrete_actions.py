"""Agents of stable-baselines3 and sb3-contrib with a discrete set of actions: what is read is the actions' scores."""

from __future__ import annotations

import base64
import io
import itertools
import json
import pickle
import zipfile
from collections.abc import Mapping
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch

from certify.cli.main import _run
from certify.errors import InputError
from certify.loop.plants import System, load_system
from certify.loop.policies.importers import ImportOptions, import_policy
from certify.loop.policies.importers.steps import Clip
from tests.support.foreign import ROOT, Toy, sb3

PLANT = ROOT / "examples" / "plants" / "gymnasium" / "mountain_car_actions.toml"
SAID = ImportOptions(states=("position", "velocity"), normaliser="none")
X = np.random.default_rng(3).uniform([-1.2, -0.07], [0.6, 0.07], (3000, 2)).astype(np.float32)
U_EQ = (Fraction(0),) * 3
SMALL: dict[str, Any] = {"net_arch": [16, 8]}
CLASSES = {
    "QRDQN": "sb3_contrib.qrdqn.policies QRDQNPolicy",
    "ARS": "sb3_contrib.ars.policies ARSPolicy",
    "linear": "sb3_contrib.ars.policies ARSLinearPolicy",
    "SAC": "stable_baselines3.sac.policies SACPolicy",
    "CNN": "stable_baselines3.dqn.policies CnnPolicy",
}


class Three(Toy):
    """Three actions."""

    action_space = gymnasium.spaces.Discrete(3)


@pytest.fixture
def car() -> System:
    return load_system(PLANT)


def changed(
    path: Path, *, policy: str | None = None, tensors: Mapping[str, torch.Tensor] | None = None, **entries: Any
) -> Path:
    """The file with another class of policies, other tensors, or entries of its JSON."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    data = json.loads(members["data"])
    if policy is not None:
        module, name = CLASSES[policy].split()
        data["policy_class"] = {":serialized:": base64.b64encode(f"c{module}\n{name}\n.".encode()).decode()}
    for key, value in entries.items():
        raw = value if isinstance(value, bytes) else pickle.dumps(value)
        data[key] = {":serialized:": base64.b64encode(raw).decode()}
    members["data"] = json.dumps(data).encode()
    if tensors is not None:
        buffer = io.BytesIO()
        torch.save(dict(tensors), buffer)
        members["policy.pth"] = buffer.getvalue()
    with zipfile.ZipFile(path, "w") as archive:
        for member, content in members.items():
            archive.writestr(member, content)
    return path


def layers(widths: tuple[int, ...], prefix: str) -> dict[str, torch.Tensor]:
    """Random tensors of layers of these widths, numbered as those of a sequence with activations between them."""
    torch.manual_seed(5)
    found: dict[str, torch.Tensor] = {}
    for k, (i, o) in enumerate(itertools.pairwise(widths)):
        found |= {f"{prefix}.{2 * k}.weight": torch.randn(o, i), f"{prefix}.{2 * k}.bias": torch.randn(o)}
    return found


def forward(tensors: Mapping[str, torch.Tensor], prefix: str, x: np.ndarray, phi: Any) -> np.ndarray:
    """The layers' values in double precision, with `phi` between them."""
    numbers = sorted({int(name.split(".")[-2]) for name in tensors if name.startswith(f"{prefix}.")})
    h: np.ndarray = x.astype(float)
    for k in numbers:
        W, b = (np.asarray(tensors[f"{prefix}.{k}.{part}"], dtype=float) for part in ("weight", "bias"))
        h = np.asarray((h if k == 0 else phi(h)) @ W.T + b)
    return h


def relu(v: np.ndarray) -> np.ndarray:
    return np.where(v > 0, v, 0)


@pytest.mark.parametrize("kind", ["DQN", "PPO", "A2C"])
@pytest.mark.parametrize("normalised", [False, True])
def test_the_largest_score_is_the_action_that_is_taken(
    kind: str, normalised: bool, car: System, tmp_path: Path
) -> None:
    model, environment, path, normaliser = sb3(kind, tmp_path, Three, **SMALL)
    environment.obs_rms.mean, environment.obs_rms.var = np.array([-0.4, 0.0]), np.array([0.3, 0.002])
    environment.save(str(normaliser))
    imported = import_policy(path, car, replace(SAID, normaliser=normaliser if normalised else "none"))
    network = imported.policy.network
    assert network.squash == "identity" and network.clip is None and imported.difference.in_double < 1e-12
    assert "outputs are the scores of actions 0, 1, 2 in this order, of which the largest is taken" in imported.words
    assert "(deterministic=True)" in imported.words and not imported.centring
    scores = network(X.astype(float), U_EQ)
    order = np.sort(scores, axis=1)
    clear = order[:, -1] - order[:, -2] > 1e-5
    theirs, _ = model.predict(environment.normalize_obs(X) if normalised else X, deterministic=True)
    assert clear.mean() > 0.9 and len(set(theirs)) > 1
    np.testing.assert_array_equal(scores.argmax(1)[clear], theirs[clear])


def test_a_target_network_is_not_read(car: System, tmp_path: Path) -> None:
    model, _, path, _ = sb3("DQN", tmp_path, Three, **SMALL)
    before = import_policy(path, car, SAID)
    assert "the target network" in before.not_read["q_net_target.q_net.0.weight"]
    with torch.no_grad():
        for parameter in model.q_net_target.parameters():
            parameter.mul_(-3)
    model.save(path)
    assert import_policy(path, car, SAID).policy.network.sha256() == before.policy.network.sha256()
    state = {name: v for name, v in model.policy.state_dict().items() if not name.startswith("q_net.")}
    with pytest.raises(InputError, match="must be those of MlpPolicy; missing"):
        import_policy(changed(path, tensors=state), car, SAID)
    odd = model.policy.state_dict() | {"q_net.features_extractor.linear.0.weight": torch.ones(4, 4)}
    with pytest.raises(InputError, match=r"could belong to it: q_net\.features_extractor"):
        import_policy(changed(path, tensors=odd), car, SAID)


@pytest.mark.parametrize("quantiles", [1, 7, None])
def test_a_score_of_quantiles_is_their_mean(quantiles: int | None, car: System, tmp_path: Path) -> None:
    """The layer has the scores of all actions for one quantile after the other, and the means are rounded once."""
    _, _, path, _ = sb3("DQN", tmp_path, Three, **SMALL)
    count = 200 if quantiles is None else quantiles
    state = layers((2, 9, 3 * count), "quantile_net.quantile_net")
    target = layers((2, 9, 3 * count), "quantile_net_target.quantile_net")
    given = SMALL | ({} if quantiles is None else {"n_quantiles": quantiles})
    changed(path, policy="QRDQN", tensors=state | target, policy_kwargs=given)
    imported = import_policy(path, car, SAID)
    theirs = forward(state, "quantile_net.quantile_net", X, relu).reshape(-1, count, 3).mean(1)
    network = imported.policy.network
    assert np.max(np.abs(network(X.astype(float), U_EQ) - theirs)) < 1e-12
    assert (f"the mean of {count} quantiles" in imported.words) == (count > 1)
    weight = state["quantile_net.quantile_net.2.weight"].numpy().astype(float).reshape(count, 3, 9)
    exact = [[float(sum(map(Fraction, weight[:, a, j])) / count) for j in range(9)] for a in range(3)]
    assert np.array_equal(network.weights[-1], exact) and np.all(network.scale == 1)


def test_a_number_of_quantiles_has_to_be_that_of_the_layers(car: System, tmp_path: Path) -> None:
    _, _, path, _ = sb3("DQN", tmp_path, Three, **SMALL)
    changed(path, policy="QRDQN", tensors=layers((2, 9, 21), "quantile_net.quantile_net"))
    for given, message in (
        ({"n_quantiles": 8}, "they have 2 and 24 numbers"),
        ({}, "they have 2 and 600 numbers"),
        ({"n_quantiles": 7.0}, "n_quantiles of DQN.zip must be a whole number"),
        ({"n_quantiles": True}, "must be a whole number"),
        ({"n_quantiles": 0}, "must be a whole number"),
    ):
        with pytest.raises(InputError, match=message):
            import_policy(changed(path, policy_kwargs=given), car, SAID)


@pytest.mark.parametrize("squash", [False, True])
def test_ars_has_scores_without_a_squash(squash: bool, car: System, tmp_path: Path) -> None:
    _, _, path, _ = sb3("PPO", tmp_path, Three)
    state = layers((2, 6, 3), "action_net")
    changed(path, policy="ARS", tensors=state, policy_kwargs={"squash_output": squash})
    ours = import_policy(path, car, SAID).policy.network(X.astype(float), U_EQ)
    assert np.max(np.abs(ours - forward(state, "action_net", X, relu))) < 1e-12
    weight = torch.tensor([[3.0, -2.0], [1.0, 5.0], [-1.0, 0.5]])
    changed(path, policy="linear", tensors={"action_net.weight": weight})
    ours = import_policy(path, car, SAID).policy.network(X.astype(float), U_EQ)
    assert np.max(np.abs(ours - X.astype(float) @ weight.numpy().T.astype(float))) < 1e-12


def test_spaces_and_classes_that_are_not_read_are_refused(car: System, tmp_path: Path) -> None:
    Box, Discrete = gymnasium.spaces.Box, gymnasium.spaces.Discrete
    _, _, path, _ = sb3("DQN", tmp_path, Three, **SMALL)
    spaces: list[tuple[Any, str]] = [
        (Box(-1, 1, (3,), np.float32), "action_space of DQN.zip must be discrete for DQN; it is box"),
        (Discrete(3, start=1), "the first of which is 0; it has 3 from 1 on"),
        (Discrete(1), "must have 2 to 4096 actions"),
        (Discrete(4), "they have 2 and 4 numbers"),
        (gymnasium.spaces.MultiDiscrete([3]), "must be a box or Discrete; found a call of .*MultiDiscrete"),
        (b"cours.spaces\nDiscrete\n)\x81}X\x01\x00\x00\x00nK\x03sb.", "must be a box or Discrete of gymnasium"),
        (b"cgym.spaces.discrete\nDiscrete\n)\x81}X\x01\x00\x00\x00nG@\x08\x00\x00\x00\x00\x00\x00sb.", "whole number"),
        (b"cgym.spaces.discrete\nDiscrete\n)\x81}b.", "n of action_space"),
    ]
    for space, message in spaces:
        with pytest.raises(InputError, match=message):
            import_policy(changed(path, action_space=space), car, SAID)
    changed(path, action_space=b"cgym.spaces.discrete\nDiscrete\n)\x81}X\x01\x00\x00\x00nK\x03sb.")  # of old files
    assert import_policy(path, car, SAID).policy.network.m == 3
    with pytest.raises(InputError, match=r"observation_space .*must be a box"):
        import_policy(changed(path, observation_space=Discrete(2)), car, SAID)
    with pytest.raises(InputError, match="must be box for SAC; it is discrete"):
        import_policy(changed(path, policy="SAC", observation_space=Box(-np.inf, np.inf, (2,), np.float32)), car, SAID)
    with pytest.raises(InputError, match=r"ARS, DQN or QRDQN; it is .*CnnPolicy"):
        import_policy(changed(path, policy="CNN"), car, SAID)
    _, _, path, _ = sb3("PPO", tmp_path, Three, **SMALL)
    for given in ({"use_sde": True}, {"squash_output": True}):
        with pytest.raises(InputError, match="neither use_sde nor squash_output"):
            import_policy(changed(path, policy_kwargs=given), car, SAID)


def test_scores_stay_as_they_are(car: System, tmp_path: Path) -> None:
    """Whatever is done to the scores of single actions may change which is the largest."""
    _, _, path, _ = sb3("DQN", tmp_path, Three, **SMALL)
    for option, changes in (
        ("--action-scale", {"action_scale": (Fraction(1),)}),
        ("--action-offset", {"action_offset": (Fraction(1),)}),
        ("--clip", {"clip": Clip((Fraction(-1),), (Fraction(1),))}),
        ("--centre", {"centre": "output"}),
    ):
        with pytest.raises(InputError, match=f"{option} must be left out: the outputs are scores"):
            import_policy(path, car, replace(SAID, **changes))
    two = load_system(PLANT.with_name("mountain_car_goal.toml"))
    with pytest.raises(InputError, match=r"a score for each of 3 actions, so .* must have 3 inputs.* it has 1"):
        import_policy(path, two, SAID)


def test_the_command_says_what_the_outputs_are(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _, _, path, _ = sb3("DQN", tmp_path, Three, **SMALL)
    words = ["--system", str(PLANT), "--states", "position,velocity", "--normaliser", "none"]
    assert _run(["import", str(path), *words, "--out", str(tmp_path / "policy.pt")], False) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "DQN 2-16-8-3, outputs are the scores of actions 0, 1, 2 in this order" in said
    assert "the largest is taken (deterministic=True)" in said and "centring none, as of scores" in said
