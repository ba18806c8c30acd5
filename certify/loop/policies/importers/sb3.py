"""The zip files of stable-baselines3: PPO, A2C, SAC, TD3 and DDPG with an activation of the table between the layers.

The numbers come from `policy.pth`, their meaning from `data`: JSON with other objects as pickles in base64, which are
read as data. PPO and A2C *clip* their actions to the bounds of the action space; SAC, TD3 and DDPG squash them by tanh
and scale them to the bounds, and have ReLU by default. The file does not say whether observations went through
VecNormalize.
"""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from certify.errors import InputError
from certify.loop.activations import ACTIVATIONS
from certify.loop.files.archives import Archive
from certify.loop.files.arrays import Numbers, array_of
from certify.loop.files.pickles import Call, Name, brief, read_pickle
from certify.loop.policies.importers.options import WITH_TANH
from certify.loop.policies.importers.reading import Observations, Reading, Values, between, perceptron, widths
from certify.loop.policies.importers.steps import Affine, Clip, Diagonal, Tanh, exactly, linear
from certify.loop.policies.importers.tensors import load_tensors
from certify.loop.policies.importers.unread import braced, unread

_ON_POLICY = Name("stable_baselines3.common.policies", "ActorCriticPolicy")
_SAC = Name("stable_baselines3.sac.policies", "SACPolicy")
_TD3 = Name("stable_baselines3.td3.policies", "TD3Policy")
_TANH = Name("torch.nn.modules.activation", "Tanh")
_MODULES = {row.name: Name("torch.nn.modules.activation", row.module) for row in ACTIVATIONS.values()}
_FLATTEN = Name("stable_baselines3.common.torch_layers", "FlattenExtractor")
_HARMLESS = {  # they change how a policy was trained, or are seen in its tensors
    "net_arch", "ortho_init", "log_std_init", "full_std", "use_expln", "optimizer_class", "optimizer_kwargs",
    "n_critics", "share_features_extractor", "clip_mean", "normalize_images", "features_extractor_kwargs",
}  # fmt: skip
_BELOW = ("features_extractor", "pi_features_extractor")


def read_sb3(archive: Archive, what: str, ignored: tuple[str, ...] | None = None) -> Reading:
    """The deterministic policy of an SB3 file.

    Parameters
    ----------
    ignored : names of tensors that are no part of the policy.

    Raises
    ------
    InputError : the file is damaged, its policy is of another class or activation, holds a tensor that could belong to
        it, or a space is no box.
    """
    try:
        data = json.loads(archive.read("data"))
    except (ValueError, RecursionError) as error:
        raise InputError(f"data in {what} must be JSON: {error}.") from error
    if not isinstance(data, dict):
        raise InputError(f"data in {what} must be a JSON object; found {brief(data)}.")
    policy, given = _value(data, "policy_class"), _value(data, "policy_kwargs")
    if policy not in (_ON_POLICY, _SAC, _TD3):
        raise InputError(
            f"the policy of {what} must be MlpPolicy of PPO, A2C, SAC, TD3 or DDPG; it is {brief(policy)}. "
            "Export it to ONNX and import that."
        )
    activation = _activation(policy, {} if given is None else given, what)
    n, bounds = _spaces(data, what)
    tensors = load_tensors(archive.read("policy.pth"), f"policy.pth in {what}")
    if any(name.startswith(_BELOW) for name in tensors):
        raise InputError(f"{what} must have no features extractor of its own; its tensors have one.")
    layers, left = _layers(tensors, policy, what, ignored)
    if layers[0].weight.shape[1] != n or len(layers[-1].bias) != bounds.shape[1]:
        raise InputError(f"the spaces of {what} must match its layers; they have {n} and {bounds.shape[1]} numbers.")
    steps = list(between(layers, activation))
    low, high = bounds
    described = widths(layers)
    net = perceptron(layers, "identity" if policy == _ON_POLICY else "tanh", activation)
    if policy == _ON_POLICY:
        lows = [None if np.isneginf(v) else exactly(v)[0] for v in low]
        highs = [None if np.isposinf(v) else exactly(v)[0] for v in high]
        if any(v is not None for v in (*lows, *highs)):
            steps.append(Clip(tuple(lows), tuple(highs)))
        words = f"stable-baselines3 PPO or A2C {described}, actions clipped"
    else:
        if not np.all(np.isfinite(bounds)):
            raise InputError(f"the action space of {what} must be bounded: the policy scales a tanh to its bounds.")
        pairs = list(zip(exactly(low), exactly(high), strict=True))
        scale, offset = tuple((hi - lo) / 2 for lo, hi in pairs), tuple((hi + lo) / 2 for lo, hi in pairs)
        steps += [Tanh(), Diagonal(scale, offset)]
        words = f"stable-baselines3 {'SAC' if policy == _SAC else 'TD3 or DDPG'} {described}, actions squashed by tanh"

    def evaluate(x: Observations, double: bool) -> Values:
        y = net(x, double)
        kind = np.result_type(y, low)
        lower, upper = low.astype(kind), high.astype(kind)
        clipped: Values = np.clip(y, lower, upper)
        unscaled: Values = lower + 0.5 * (y + 1) * (upper - lower)
        return clipped if policy == _ON_POLICY else unscaled

    finite = bool(np.all(np.isfinite(bounds)))
    action = tuple(zip(exactly(low), exactly(high), strict=True)) if finite else None
    left |= _elsewhere(archive)
    who = "what its policy_kwargs say" if given and "activation_fn" in given else "the default of its kind"
    assumed = f"{activation} between the layers is {who}, the rest is how stable-baselines3 documents its policies"
    return Reading(words=words, steps=tuple(steps), evaluate=evaluate, action=action, assumed=assumed, unread=left)


def _elsewhere(archive: Archive) -> dict[str, str]:
    """Tensors of the file's other members, which no policy has its numbers from."""
    found: dict[str, str] = {}
    for member in sorted(set(archive.names) - {"policy.pth"}):
        if member.endswith(".pth"):
            why = (
                "the state of an optimiser"
                if "optimizer" in member
                else "no part of the policy: it lies beside policy.pth, which holds that"
            )
            tensors = load_tensors(archive.read(member), member)
            found |= dict.fromkeys((f"{member.removesuffix('.pth')}/{name}" for name in tensors), why)
    return found


def _value(data: Mapping[str, Any], key: str) -> Any:
    """An entry of the file's JSON: plain, or a pickle that is read as data."""
    entry = data.get(key)
    if not isinstance(entry, dict) or ":serialized:" not in entry:
        return entry
    try:
        raw = base64.b64decode(entry[":serialized:"], validate=True)
    except (binascii.Error, ValueError, TypeError) as error:
        raise InputError(f"{key} in data must be base64: {error}.") from error
    return read_pickle(raw, f"{key} in data")


def _activation(policy: Name, given: Any, what: str) -> str:
    """The activation between layers, and refusals of what else changes the policy."""
    if not isinstance(given, dict):
        raise InputError(f"policy_kwargs of {what} must be a dictionary; found {brief(given)}.")
    activation = given.get("activation_fn", _TANH if policy == _ON_POLICY else Name("torch.nn", "ReLU"))
    rows = [row for row, name in _MODULES.items() if activation in (name, Name("torch.nn", name.name))]
    if not rows:
        found = activation.name if isinstance(activation, Name) else brief(activation)
        raise InputError(f"the activation of {what} is not proved; it is {found}. {WITH_TANH}")
    if given.get("use_sde") not in (None, False) and policy == _SAC:
        raise InputError(
            f"{what} has state-dependent exploration, which bounds its mean by another function (use_sde)."
        )
    if given.get("squash_output") not in (None, False):
        raise InputError(f"{what} has squash_output; a policy with it is not read. Export it to ONNX.")
    if given.get("features_extractor_class", _FLATTEN) != _FLATTEN:
        raise InputError(f"{what} has a features extractor of its own; export the policy to ONNX and import that.")
    known = _HARMLESS | {"activation_fn", "use_sde", "squash_output", "features_extractor_class"}
    unknown = sorted(str(key) for key in given if key not in known)
    if unknown:
        raise InputError(f"policy_kwargs of {what} must be those of MlpPolicy; unknown are {', '.join(unknown)}.")
    return rows[0]


def _spaces(data: Mapping[str, Any], what: str) -> tuple[int, Numbers]:
    """The number of observations, and low and high of the actions, (2, m)."""
    observation, action = (
        _box(_value(data, f"{name}_space"), f"{name}_space of {what}") for name in ("observation", "action")
    )
    if observation["low"].ndim != 1 or action["low"].ndim != 1 or action["low"].shape != action["high"].shape:
        raise InputError(f"the spaces of {what} must be boxes of one axis; found {observation['low'].shape}.")
    return len(observation["low"]), np.stack([action["low"], action["high"]])


def _box(space: Any, what: str) -> dict[str, Numbers]:
    if not isinstance(space, Call) or not isinstance(space.function, Name) or space.function.name != "Box":
        raise InputError(f"{what} must be a box; found {brief(space)}.")
    state = space.states[0] if len(space.states) == 1 and isinstance(space.states[0], dict) else {}
    found = {name: array_of(state.get(name), f"{name} of {what}") for name in ("low", "high")}
    if any(a.dtype.kind != "f" or a.dtype.itemsize < 4 for a in found.values()):
        raise InputError(f"{what} must be of single or double precision; found {found['low'].dtype}.")
    return found


def _layers(
    tensors: Mapping[str, Numbers], policy: Name, what: str, ignored: tuple[str, ...] | None
) -> tuple[list[Affine], dict[str, str]]:
    """The policy's layers, and why each other tensor of `policy.pth` is left out."""
    if policy == _ON_POLICY:
        if any(name.startswith("mlp_extractor.shared_net") for name in tensors):
            raise InputError(f"{what} has layers that policy and value share; export the policy to ONNX.")
        hidden, last = "mlp_extractor.policy_net", "action_net"
        others = ("mlp_extractor.value_net", "value_net.", "log_std")
    elif policy == _SAC:
        hidden, last, others = "actor.latent_pi", "actor.mu", ("actor.log_std", "critic", "critic_target")
    else:
        hidden, last, others = "actor.mu", "", ("actor_target", "critic", "critic_target")
    count = sum(name.startswith(f"{hidden}.") and name.endswith(".weight") for name in tensors)
    names = [f"{hidden}.{2 * k}" for k in range(count)] + ([last] if last else [])
    wanted = {f"{name}.{part}" for name in names for part in ("weight", "bias")}
    if wanted - set(tensors) or not names:
        raise InputError(
            f"the tensors of {what} must be those of MlpPolicy; missing {sorted(wanted - set(tensors))}, "
            f"found {braced(tensors) or 'none'}."
        )
    layers = [linear(tensors[f"{name}.weight"], tensors[f"{name}.bias"]) for name in names]
    known = {name: "the value, or the spread of actions, of training" for name in tensors if name.startswith(others)}
    return layers, unread(tensors, wanted, hidden, len(layers[-1].bias), ignored, known)
