"""Forms of stable-baselines3's files beside the plain ones: exploration, sb3-contrib, old versions, several arrays."""

from __future__ import annotations

import base64
import io
import json
import math
import pickle
import zipfile
from collections.abc import Mapping
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import flint
import gymnasium
import numpy as np
import pytest
import torch

from certify.errors import InputError
from certify.loop.files.archives import Archive
from certify.loop.policies.importers import ImportOptions, import_policy
from certify.loop.policies.importers.comparing import apply
from certify.loop.policies.importers.normalisers import load_normaliser
from certify.loop.policies.importers.sb3 import read_sb3
from certify.loop.policies.importers.steps import Clip, Tanh
from tests.support.foreign import Several, mlp, plant, sb3

SAID = ImportOptions(states=("x0", "x1"), normaliser="none", action_scale=(Fraction(1),))
X = np.random.default_rng(3).uniform(-5, 5, (3000, 2)).astype(np.float32)
U_EQ = (Fraction(0),)
SMALL: dict[str, Any] = {"net_arch": [16, 8]}
OTHERS = {
    "TQC": "sb3_contrib.tqc.policies TQCPolicy",
    "ARS": "sb3_contrib.ars.policies ARSPolicy",
    "linear": "sb3_contrib.ars.policies ARSLinearPolicy",
    "PPO": "stable_baselines3.common.policies ActorCriticPolicy",
}


def rewritten(
    path: Path,
    *,
    policy: str | None = None,
    tensors: Mapping[str, torch.Tensor] | None = None,
    given: Any = None,
    space: Any = None,
    old: bool = False,
) -> Path:
    """The file with another class of policies, tensors, policy_kwargs or observations, or of old torch."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    data = json.loads(members["data"])
    if policy is not None:
        module, name = OTHERS[policy].split()
        data["policy_class"] = {":serialized:": base64.b64encode(f"c{module}\n{name}\n.".encode()).decode()}
    for key, value in (("policy_kwargs", given), ("observation_space", space)):
        if value is not None:
            data[key] = {":serialized:": base64.b64encode(pickle.dumps(value)).decode()}
    members["data"] = json.dumps(data).encode()
    if tensors is not None or old:
        state = tensors or torch.load(io.BytesIO(members["policy.pth"]), weights_only=True)
        buffer = io.BytesIO()
        torch.save(dict(state), buffer, _use_new_zipfile_serialization=not old)
        members["policy.pth"] = buffer.getvalue()
    with zipfile.ZipFile(path, "w") as archive:
        for member, content in members.items():
            archive.writestr(member, content)
    return path


def state_of(path: Path) -> dict[str, torch.Tensor]:
    with zipfile.ZipFile(path) as archive:
        found: dict[str, torch.Tensor] = torch.load(io.BytesIO(archive.read("policy.pth")), weights_only=True)
    return found


def steep(model: Any, path: Path) -> None:
    """Make the means large, so that clips act, and write the file again."""
    with torch.no_grad():
        last = model.policy.action_net if hasattr(model.policy, "action_net") else model.policy.actor.mu
        for name, parameter in last.named_parameters():
            parameter.mul_(0 if name.endswith("bias") else 100)
    model.save(path)


def network_of(path: Path) -> Any:
    return import_policy(path, plant(), SAID).policy.network


# --------------------------------------------------------------------------------------- state-dependent exploration


@pytest.mark.parametrize("clip_mean", [None, 2.0, 0.3, 1, 0.0])
def test_the_clip_of_the_mean_with_state_dependent_exploration(clip_mean: float | None, tmp_path: Path) -> None:
    given = SMALL | ({} if clip_mean is None else {"clip_mean": clip_mean})
    model, _, path, _ = sb3("SAC", tmp_path, sde=True, **given)
    steep(model, path)
    imported = import_policy(path, plant(), SAID)
    theirs, _ = model.predict(X, deterministic=True)
    ours = imported.policy.network(X.astype(float), U_EQ)
    assert np.max(np.abs(ours - theirs)) < 1e-4 and imported.difference.in_double < 1e-12
    clip, bound = imported.policy.network.clip, 2.0 if clip_mean is None else clip_mean
    if bound == 0:
        assert clip is None and np.max(np.abs(theirs)) > 6 * math.tanh(2.5)
        return
    assert clip is not None and f"clipped to {bound:g}" in imported.words
    assert np.isclose(np.max(np.abs(theirs)), 6 * math.tanh(bound), rtol=1e-6)  # the clip acts
    reading = read_sb3(Archive(path.read_bytes(), "f"), "f")
    squash, limit, _ = reading.steps[-3:]
    assert isinstance(squash, Tanh) and isinstance(limit, Clip) and limit.hi[0] is not None
    with flint.ctx.workprec(500):
        for side, (value,) in zip((-1, 1), clip, strict=True):  # the nearest binary64 inside
            assert 0 <= 6 * flint.arb(bound).tanh() - side * value < math.ulp(value)


def test_a_clip_of_the_mean_that_is_no_number_is_refused(tmp_path: Path) -> None:
    _, _, path, _ = sb3("SAC", tmp_path, sde=True, **SMALL)
    for wrong in ("2", True, math.inf, None):
        rewritten(path, given={"use_sde": True, "clip_mean": wrong})
        with pytest.raises(InputError, match="clip_mean of SAC"):
            import_policy(path, plant(), SAID)
    rewritten(path, given={"use_sde": 1})
    with pytest.raises(InputError, match="true or false"):
        import_policy(path, plant(), SAID)
    # What is said of the exploration and the names of the layers must agree.
    rewritten(path, given={"use_sde": False})
    with pytest.raises(InputError, match=r"missing \['actor\.mu\.bias"):
        import_policy(path, plant(), SAID)
    rewritten(path, given={})  # then the method's own use_sde says so
    assert network_of(path).clip is not None


@pytest.mark.parametrize("kind", ["PPO", "A2C"])
@pytest.mark.parametrize("squash", [False, True])
def test_on_policy_methods_with_state_dependent_exploration(kind: str, squash: bool, tmp_path: Path) -> None:
    model, _, path, _ = sb3(kind, tmp_path, sde=True, squash_output=squash, log_std_init=-2, full_std=False)
    steep(model, path)
    imported = import_policy(path, plant(), SAID)
    theirs, _ = model.predict(X, deterministic=True)
    assert np.max(np.abs(imported.policy.network(X.astype(float), U_EQ) - theirs)) < 1e-4
    assert imported.policy.network.squash == ("tanh" if squash else "identity")
    assert ("squashed by tanh" in imported.words) == squash


def test_a_squash_without_that_exploration_is_refused(tmp_path: Path) -> None:
    _, _, path, _ = sb3("PPO", tmp_path, sde=False)
    rewritten(path, given={"squash_output": True})
    with pytest.raises(InputError, match="squash_output=True, which is not read"):
        import_policy(path, plant(), SAID)
    _, _, path, _ = sb3("SAC", tmp_path, sde=True, **SMALL)
    rewritten(path, given={"squash_output": False, "use_sde": True})
    with pytest.raises(InputError, match="squash_output=False, which is not read"):
        import_policy(path, plant(), SAID)


# ------------------------------------------------------------------------------------------------------- sb3-contrib


@pytest.mark.parametrize("sde", [False, True])
def test_tqc_has_the_actor_of_sac(sde: bool, tmp_path: Path) -> None:
    _, _, path, _ = sb3("SAC", tmp_path, sde=sde, **SMALL)
    before = network_of(path)
    rewritten(path, policy="TQC", given={"n_quantiles": 25, "n_critics": 2, "use_sde": sde})
    imported = import_policy(path, plant(), SAID)
    assert imported.policy.network.sha256() == before.sha256() and " TQC 2-16-8-1, actions" in imported.words
    assert all(name.startswith(("actor.log_std", "critic")) for name in imported.not_read if "/" not in name)


def test_ars_squashes_a_network_and_clips_a_linear_policy(tmp_path: Path) -> None:
    _, _, path, _ = sb3("PPO", tmp_path)
    module = torch.nn.Sequential(torch.nn.Linear(2, 16), torch.nn.ReLU(), torch.nn.Linear(16, 1), torch.nn.Tanh())
    state = {f"action_net.{k}": v for k, v in module.state_dict().items()}
    rewritten(path, policy="ARS", tensors=state, given={"net_arch": [16]})
    with torch.no_grad():
        theirs = 6 * module.double()(torch.tensor(X, dtype=torch.float64)).numpy()
    assert np.max(np.abs(network_of(path)(X.astype(float), U_EQ) - theirs)) < 1e-12
    rewritten(path, given={"squash_output": False})  # versions differ in what that does
    with pytest.raises(InputError, match="squash_output=False"):
        import_policy(path, plant(), SAID)

    weight = torch.tensor([[3.0, -2.0]])
    for state, bias, squash in (
        ({"action_net.weight": weight}, 0, False),
        ({"action_net.weight": weight, "action_net.bias": torch.ones(1)}, 1, False),
        ({"action_net.0.weight": weight}, 0, False),
        ({"action_net.0.weight": weight, "action_net.0.bias": torch.ones(1)}, 1, True),
    ):
        rewritten(path, policy="linear", tensors=state, given={"squash_output": squash})
        reading = read_sb3(Archive(path.read_bytes(), "f"), "f")
        y = X.astype(float) @ weight.numpy().T.astype(float) + bias
        expected = 6 * np.tanh(y) if squash else np.clip(y, -6, 6)
        assert np.max(np.abs(apply(reading.steps, X.astype(float)) - expected)) < 1e-12
        assert np.max(np.abs(reading.evaluate(X, True) - expected)) < 1e-12
    rewritten(path, tensors={"action_net.0.weight": weight, "action_net.weight": weight})
    with pytest.raises(InputError, match=r"could belong to it: action_net\.0"):
        import_policy(path, plant(), SAID)


def test_other_classes_are_refused_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _, _, path, _ = sb3("PPO", tmp_path)
    for name in ("RecurrentActorCriticPolicy", "ActorCriticCnnPolicy"):
        monkeypatch.setitem(OTHERS, "odd", f"sb3_contrib.common.recurrent.policies {name}")
        with pytest.raises(InputError, match=f"MlpPolicy or MultiInputPolicy of PPO.*{name}"):
            import_policy(rewritten(path, policy="odd"), plant(), SAID)


# ---------------------------------------------------------------------------------------------------- older versions


@pytest.mark.parametrize("own", [(), (5,)])
def test_layers_that_policy_and_value_share(own: tuple[int, ...], tmp_path: Path) -> None:
    """Versions before 2 had `net_arch=[7, dict(pi=[...], vf=[...])]`."""
    _, _, path, _ = sb3("PPO", tmp_path)
    module = mlp((2, 7, 6, *own, 1))
    linears = [layer for layer in module if isinstance(layer, torch.nn.Linear)]
    names = ["mlp_extractor.shared_net.0", "mlp_extractor.shared_net.2", *["mlp_extractor.policy_net.0"][: len(own)]]
    state = {"log_std": torch.zeros(1), "value_net.weight": torch.ones(1, 6), "value_net.bias": torch.ones(1)}
    for name, layer in zip([*names, "action_net"], linears, strict=True):
        state |= {f"{name}.weight": layer.weight.detach(), f"{name}.bias": layer.bias.detach()}
    imported = import_policy(rewritten(path, tensors=state), plant(), SAID)
    with torch.no_grad():
        theirs = module.double()(torch.tensor(X, dtype=torch.float64)).numpy()
    assert np.max(np.abs(imported.policy.network(X.astype(float), U_EQ) - np.clip(theirs, -6, 6))) < 1e-12
    assert set(imported.not_read) >= {"log_std", "value_net.weight", "value_net.bias"}


@pytest.mark.parametrize("kind", ["PPO", "SAC"])
def test_tensors_in_the_format_of_old_torch(kind: str, tmp_path: Path) -> None:
    _, _, path, _ = sb3(kind, tmp_path, **SMALL)
    before = network_of(path)
    assert network_of(rewritten(path, old=True)).sha256() == before.sha256()


def test_a_network_of_its_own_for_the_exploration_is_left_out(tmp_path: Path) -> None:
    _, _, path, _ = sb3("PPO", tmp_path, sde=True)
    before = network_of(path)
    more = {"sde_features_extractor.0.weight": torch.ones(4, 2), "sde_features_extractor.0.bias": torch.ones(4)}
    rewritten(path, tensors=state_of(path) | more, given={"sde_net_arch": [4]})
    imported = import_policy(path, plant(), SAID)
    assert imported.policy.network.sha256() == before.sha256()
    assert "spread" in imported.not_read["sde_features_extractor.0.weight"]


# ---------------------------------------------------------------------------------------------------- several arrays


@pytest.mark.parametrize("kind", ["PPO", "SAC", "TD3"])
def test_several_arrays_are_joined_in_the_order_of_their_names(kind: str, tmp_path: Path) -> None:
    model, environment, path, normaliser = sb3(kind, tmp_path, Several, **SMALL)
    environment.obs_rms["place"].mean, environment.obs_rms["speed"].var = np.array([0.7]), np.array([3.0])
    environment.save(str(normaliser))
    imported = import_policy(path, plant(), replace(SAID, normaliser=normaliser))
    assert " of place (1), speed (1), actions" in imported.words and imported.policy.valid is not None
    low, high = np.maximum(imported.policy.valid[:, 0], -5), np.minimum(imported.policy.valid[:, 1], 5)
    x = np.random.default_rng(0).uniform(low, high, (2000, 2)).astype(np.float32)
    theirs, _ = model.predict(environment.normalize_obs({"place": x[:, :1], "speed": x[:, 1:]}), deterministic=True)
    assert np.max(np.abs(imported.policy.network(x.astype(float), U_EQ) - theirs)) < 1e-4


def test_arrays_in_another_order_or_of_another_kind_are_refused(tmp_path: Path) -> None:
    _, environment, path, normaliser = sb3("PPO", tmp_path, Several)
    box, deep = gymnasium.spaces.Box(-1, 1, (1,), np.float32), gymnasium.spaces.Box(-1, 1, (1, 1), np.float32)
    spaces: list[tuple[Any, str]] = [
        (gymnasium.spaces.Dict([("speed", box), ("place", box)]), "in the order of their names; found speed, place"),
        (gymnasium.spaces.Dict({"place": box, "speed": deep}), "boxes of one axis"),
        (gymnasium.spaces.Dict({"place": box, "speed": gymnasium.spaces.Discrete(2)}), "speed of .* must be a box"),
        (gymnasium.spaces.Dict({"place": box}), "match its layers; they have 1 and 1"),
        (gymnasium.spaces.Dict({}), "a dictionary of boxes"),
        (gymnasium.spaces.Box(-1, 1, (2,), np.float32), "a dictionary of boxes"),
    ]
    for space, message in spaces:
        with pytest.raises(InputError, match=message):
            import_policy(rewritten(path, space=space), plant(), SAID)
    for rms, message in (({"place": environment.obs_rms["place"]}, "norm_obs_keys"), ({}, "by the names")):
        environment.obs_rms = rms
        environment.save(str(normaliser))
        with pytest.raises(InputError, match=message):
            load_normaliser(normaliser, None)
