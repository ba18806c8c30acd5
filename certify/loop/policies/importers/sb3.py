"""The zip files of stable-baselines3 and sb3-contrib: PPO, A2C, TRPO, SAC, TQC, TD3, DDPG, ARS, DQN and QRDQN.

The numbers come from `policy.pth`, their meaning from `data`: JSON with other objects as pickles in base64, which are
read as data. The classes of the policies say the rest: PPO, A2C and TRPO *clip* their actions to the bounds of the
action space; SAC, TQC, TD3 and DDPG squash them by tanh and scale them to the bounds, and have ReLU by default. With
state-dependent exploration SAC and TQC clip the mean before its tanh (`clip_mean`), and PPO and A2C may squash theirs
(`squash_output`). Where actions are a discrete set, all take the one with the largest score: DQN its value, QRDQN the
mean of its quantiles, PPO, A2C, TRPO and ARS the last layer's number; the scores are then the outputs, as they are.
Several arrays of observations are joined in the order of their names. The file does not say whether observations went
through VecNormalize.
"""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from typing import Any

import flint
import numpy as np

from certify.errors import InputError
from certify.loop.activations import ACTIVATIONS
from certify.loop.files.archives import Archive
from certify.loop.files.arrays import Numbers
from certify.loop.files.pickles import Name, brief, read_pickle
from certify.loop.policies.importers.options import WITH_TANH
from certify.loop.policies.importers.reading import Evaluate, Observations, Reading, Values, between, perceptron, widths
from certify.loop.policies.importers.sb3_spaces import spaces_of
from certify.loop.policies.importers.steps import Affine, Clip, Diagonal, Step, Tanh, exactly, in_words, linear
from certify.loop.policies.importers.tensors import load_tensors
from certify.loop.policies.importers.unread import braced, unread


@dataclass(frozen=True, slots=True)
class _Class:
    """A class of policies.

    Parameters
    ----------
    words : the methods that train it.
    activation : between its layers by default.
    hidden : prefixes of the keys of its sequences of layers, in their order.
    last : key of the layer behind them, if that lies on its own.
    others : beginnings of the keys of its tensors for training alone.
    squashed : True if its actions are squashed and scaled by default, False if they are clipped.
    joined : True if its observation is a dictionary of arrays.
    actions : what its actions may be, `box`, `discrete` or both.
    """

    words: str
    activation: str
    hidden: tuple[str, ...]
    last: str
    others: tuple[str, ...]
    squashed: bool
    joined: bool = False
    actions: tuple[str, ...] = ("box",)


_SDE = "sde_features_extractor."
_BOTH = ("mlp_extractor.shared_net", "mlp_extractor.policy_net")  # versions before 2 have layers that both share
_ACTOR = ("actor.log_std", f"actor.{_SDE}", "critic", "critic_target")
_SPREAD = ("mlp_extractor.value_net", "value_net.", "log_std", _SDE)
_ANY, _DISCRETE = ("box", "discrete"), ("discrete",)


def _classes(joined: bool, a: str, s: str, t: str) -> dict[Name, _Class]:
    """The classes for one array of observations, or for several, by where they are defined."""
    return {
        Name("stable_baselines3.common.policies", a): _Class(
            "PPO, A2C or TRPO", "tanh", _BOTH, "action_net", _SPREAD, squashed=False, joined=joined, actions=_ANY
        ),
        Name("stable_baselines3.sac.policies", s): _Class(
            "SAC", "relu", ("actor.latent_pi",), "actor.mu", _ACTOR, squashed=True, joined=joined
        ),
        Name("sb3_contrib.tqc.policies", s.replace("SAC", "TQC")): _Class(
            "TQC", "relu", ("actor.latent_pi",), "actor.mu", _ACTOR, squashed=True, joined=joined
        ),
        Name("stable_baselines3.td3.policies", t): _Class(
            "TD3 or DDPG", "relu", ("actor.mu",), "", ("actor_target", "critic", "critic_target"), True, joined
        ),
        Name("stable_baselines3.dqn.policies", s.replace("SAC", "DQN")): _Class(
            "DQN", "relu", ("q_net.q_net",), "", ("q_net_target.",), False, joined, _DISCRETE
        ),
        Name("sb3_contrib.qrdqn.policies", s.replace("SAC", "QRDQN")): _Class(
            "QRDQN", "relu", ("quantile_net.quantile_net",), "", ("quantile_net_target.",), False, joined, _DISCRETE
        ),
    }


_CLASSES = {
    **_classes(False, "ActorCriticPolicy", "SACPolicy", "TD3Policy"),
    **_classes(True, "MultiInputActorCriticPolicy", "MultiInputPolicy", "MultiInputPolicy"),
    Name("sb3_contrib.ars.policies", "ARSPolicy"): _Class(
        "ARS", "relu", ("action_net",), "", (), squashed=True, actions=_ANY
    ),
    Name("sb3_contrib.ars.policies", "ARSLinearPolicy"): _Class(
        "linear ARS", "relu", ("action_net",), "", (), squashed=False, actions=_ANY
    ),
}
_COMPOSED = {
    **{"leaky_relu": "LeakyReLU", "selu": "SELU", "celu": "CELU", "hardtanh": "Hardtanh", "relu6": "ReLU6"},
    **{"hardsigmoid": "Hardsigmoid", "hardswish": "Hardswish", "logsigmoid": "LogSigmoid"},
}
_MODULES = {
    name: Name("torch.nn.modules.activation", module)
    for name, module in ({row.name: row.module for row in ACTIVATIONS.values()} | _COMPOSED).items()
}
_LAYERS = "stable_baselines3.common.torch_layers"
_FLATTEN, _COMBINED = Name(_LAYERS, "FlattenExtractor"), Name(_LAYERS, "CombinedExtractor")
_HARMLESS = {  # they change how a policy was trained, or are seen in its tensors
    "net_arch", "ortho_init", "log_std_init", "full_std", "use_expln", "optimizer_class", "optimizer_kwargs",
    "n_critics", "n_quantiles", "share_features_extractor", "normalize_images", "features_extractor_kwargs",
    "sde_net_arch", "with_bias", "device",
}  # fmt: skip
_READ = {"activation_fn", "use_sde", "squash_output", "clip_mean", "features_extractor_class"}
_CLIP_MEAN = 2.0  # where nothing is said
_BITS = 320
_QUANTILES, _MOST_QUANTILES = 200, 10_000  # of an action, where nothing is said; and at most
_NAMED = 8  # actions that are named each
_OF_TRAINING = "the value, or the spread of actions, of training"
_BELOW = ("features_extractor", "pi_features_extractor")


def read_sb3(archive: Archive, what: str, ignored: tuple[str, ...] | None = None) -> Reading:
    """The deterministic policy of an SB3 file; where its actions are a discrete set, their scores.

    Parameters
    ----------
    ignored : names of tensors that are no part of the policy.

    Raises
    ------
    InputError : the file is damaged, its policy is of another class or activation, holds a tensor that could belong to
        it, or a space is no box and, of actions, no discrete set.
    """
    data = _data(archive, what)
    policy, given = _value(data, "policy_class"), _value(data, "policy_kwargs")
    if not isinstance(policy, Name) or policy not in _CLASSES:
        raise InputError(
            f"the policy of {what} must be MlpPolicy or MultiInputPolicy of PPO, A2C, TRPO, SAC, TQC, TD3, DDPG, ARS, "
            f"DQN or QRDQN; it is {brief(policy)}. Export it to ONNX and import that."
        )
    kind, given = _CLASSES[policy], {} if given is None else given
    activation = _activation(kind, given, what)
    spaces = spaces_of(_value(data, "observation_space"), _value(data, "action_space"), kind.joined, what)
    found = "discrete" if spaces.bounds is None else "box"
    if found not in kind.actions:
        raise InputError(f"action_space of {what} must be {kind.actions[0]} for {kind.words}; it is {found}.")
    scores = spaces.bounds is None
    squashed, bound = (False, None) if scores else _end(kind, given, data.get("use_sde"), what)
    if scores and (given.get("use_sde", data.get("use_sde")) or (kind.others and given.get("squash_output"))):
        raise InputError(f"{what} must have neither use_sde nor squash_output, as its actions are discrete.")
    tensors = load_tensors(archive.read("policy.pth"), f"policy.pth in {what}")
    if any(name.startswith(_BELOW) for name in tensors):
        raise InputError(f"{what} must have no features extractor of its own; its tensors have one.")
    layers, left = _layers(tensors, kind, bound is not None, what, ignored)
    quantiles = _quantiles(given, what) if kind.words == "QRDQN" else 1
    n, m = spaces.observations, spaces.actions
    if layers[0].weight.shape[1] != n or len(layers[-1].bias) != m * quantiles:
        raise InputError(f"the spaces of {what} must match its layers; they have {n} and {m * quantiles} numbers.")
    net = perceptron(layers, "identity", activation)
    shape = f"stable-baselines3 {kind.words} {widths(layers)}{spaces.joined}"
    who = "what its policy_kwargs say" if "activation_fn" in given else "the default of its kind"
    reading = partial(
        Reading,
        assumed=f"{in_words(activation)} between the layers is {who}, the rest is how stable-baselines3 documents its "
        "policies",
        unread=left | _elsewhere(archive),
    )
    steps = between(layers, activation)
    if spaces.bounds is None:
        end, words = _scores(m, quantiles)
        return reading(f"{shape}, {words}", (*steps, *end), _means(net, quantiles), scores=True)
    low, high = spaces.bounds
    said = "squashed by tanh" if squashed else "clipped"
    within = "" if bound is None else f", their means clipped to {bound:g} before it"
    return reading(
        f"{shape}, actions {said}{within}",
        (*steps, *_to_the_bounds(low, high, squashed, bound, what)),
        _bounded(net, low, high, squashed, bound),
        action=tuple(zip(exactly(low), exactly(high), strict=True)) if np.all(np.isfinite(spaces.bounds)) else None,
    )


def _data(archive: Archive, what: str) -> dict[str, Any]:
    """The file's JSON."""
    try:
        data = json.loads(archive.read("data"))
    except (ValueError, RecursionError) as error:
        raise InputError(f"data in {what} must be JSON: {error}.") from error
    if not isinstance(data, dict):
        raise InputError(f"data in {what} must be a JSON object; found {brief(data)}.")
    return data


def _bounded(net: Evaluate, low: Numbers, high: Numbers, squashed: bool, bound: float | None) -> Evaluate:
    """The network's values, clipped or squashed and scaled to the bounds of the action space."""

    def evaluate(x: Observations, double: bool) -> Values:
        y = net(x, double)
        number = np.result_type(y, low)
        lower, upper = low.astype(number), high.astype(number)
        if not squashed:
            clipped: Values = np.clip(y, lower, upper)
            return clipped
        y = np.tanh(y if bound is None else np.clip(y, -bound, bound))
        scaled: Values = lower + 0.5 * (y + 1) * (upper - lower)
        return scaled

    return evaluate


def _scores(actions: int, quantiles: int) -> tuple[tuple[Step, ...], str]:
    """The steps from the last layer to the scores of so many actions, and what they are, for people."""
    names = ", ".join(map(str, range(actions))) if actions <= _NAMED else f"0, 1, ..., {actions - 1}"
    words = f"outputs are the scores of actions {names} in this order, of which the largest is taken"
    if quantiles == 1:
        return (), f"{words} (deterministic=True)"
    # Of each quantile the scores of all actions come one behind the other.
    share = Diagonal((Fraction(1, quantiles),), (Fraction(0),))
    total = Affine(np.tile(np.eye(actions), quantiles), np.zeros(actions))
    return (share, total), f"{words} (deterministic=True), each the mean of {quantiles} quantiles"


def _means(net: Evaluate, quantiles: int) -> Evaluate:
    """The network's values; of several quantiles their means."""

    def evaluate(x: Observations, double: bool) -> Values:
        y = net(x, double)
        means: Values = y.reshape(len(y), quantiles, -1).mean(1)
        return means

    return evaluate


def _quantiles(given: Mapping[str, Any], what: str) -> int:
    """The number of quantiles of each action."""
    count = given.get("n_quantiles", _QUANTILES)
    if type(count) is not int or not 0 < count <= _MOST_QUANTILES:
        raise InputError(
            f"n_quantiles of {what} must be a whole number from 1 to {_MOST_QUANTILES}; found {brief(count)}."
        )
    return count


def _to_the_bounds(low: Numbers, high: Numbers, squashed: bool, bound: float | None, what: str) -> list[Step]:
    """The steps behind the last layer."""
    if not squashed:
        lows = [None if np.isneginf(v) else exactly(v)[0] for v in low]
        highs = [None if np.isposinf(v) else exactly(v)[0] for v in high]
        return [Clip(tuple(lows), tuple(highs))] if any(v is not None for v in (*lows, *highs)) else []
    if not np.all(np.isfinite((low, high))):
        raise InputError(f"the action space of {what} must be bounded: the policy scales a tanh to its bounds.")
    pairs = list(zip(exactly(low), exactly(high), strict=True))
    scale, offset = tuple((hi - lo) / 2 for lo, hi in pairs), tuple((hi + lo) / 2 for lo, hi in pairs)
    if bound is None:
        return [Tanh(), Diagonal(scale, offset)]
    # tanh rises: of what is clipped to +-c it is what is clipped to +-tanh(c) behind it.
    most = _tanh(Fraction(bound))
    return [Tanh(), Clip((-most,), (most,)), Diagonal(scale, offset)]


def _tanh(c: Fraction) -> Fraction:
    """tanh(c) to 300 bits: it is irrational, and each number that is folded from it is rounded to 53."""
    with flint.ctx.workprec(_BITS):
        mantissa, exponent = flint.arb(flint.fmpq(c.numerator, c.denominator)).tanh().mid().man_exp()
    return Fraction(int(mantissa)) * Fraction(2) ** int(exponent)


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


def _activation(kind: _Class, given: Any, what: str) -> str:
    """The activation between layers, and refusals of what else changes the policy."""
    if not isinstance(given, dict):
        raise InputError(f"policy_kwargs of {what} must be a dictionary; found {brief(given)}.")
    activation = given.get("activation_fn", _MODULES[kind.activation])
    rows = [row for row, name in _MODULES.items() if activation in (name, Name("torch.nn", name.name))]
    if not rows:
        found = activation.name if isinstance(activation, Name) else brief(activation)
        raise InputError(f"the activation of {what} is not proved; it is {found}. {WITH_TANH}")
    extractor = _COMBINED if kind.joined else _FLATTEN
    if given.get("features_extractor_class", extractor) != extractor:
        raise InputError(f"{what} has a features extractor of its own; export the policy to ONNX and import that.")
    unknown = sorted(str(key) for key in given if key not in _HARMLESS | _READ)
    if unknown:
        raise InputError(f"policy_kwargs of {what} must be those of MlpPolicy; unknown are {', '.join(unknown)}.")
    return rows[0]


def _end(kind: _Class, given: Mapping[str, Any], exploration: Any, what: str) -> tuple[bool, float | None]:
    """True if the action is squashed, and the bound of its mean before that, where it is clipped.

    Parameters
    ----------
    exploration : the method's own `use_sde`; what is said to the policy of SAC and TQC counts more.
    """
    sde, squash = given.get("use_sde", exploration), given.get("squash_output")
    if not isinstance(sde, bool | None) or not isinstance(squash, bool | None):
        raise InputError(f"use_sde and squash_output of {what} must be true or false; found {brief(sde)}.")
    squash = kind.squashed if squash is None else squash
    # Without that exploration PPO refuses it; some versions of ARS squash their networks in both cases.
    possible = kind.words == "linear ARS" or (kind.last == "action_net" and sde is True)
    if squash != kind.squashed and not possible:
        raise InputError(f"{what} has squash_output={squash}, which is not read there. Export it to ONNX.")
    if kind.last != "actor.mu" or not sde:
        return squash, None
    bound = given.get("clip_mean", _CLIP_MEAN)
    if not isinstance(bound, float | int) or isinstance(bound, bool) or not np.isfinite(float(bound)):
        raise InputError(f"clip_mean of {what} must be a number; found {brief(bound)}.")
    return squash, float(bound) if bound > 0 else None


def _layers(
    tensors: Mapping[str, Numbers], kind: _Class, within: bool, what: str, ignored: tuple[str, ...] | None
) -> tuple[list[Affine], dict[str, str]]:
    """The policy's layers, and why each other tensor of `policy.pth` is left out.

    Parameters
    ----------
    within : True if the last layer's values are clipped, so that it lies in a sequence with the clip.
    """
    names = []
    for hidden in kind.hidden:
        count = sum(name.startswith(f"{hidden}.") and name.endswith(".weight") for name in tensors)
        names += [f"{hidden}.{2 * k}" for k in range(count)]
    if kind.last:
        names.append(f"{kind.last}.0" if within else kind.last)
    if not kind.others:  # ARS: a linear policy may lie on its own, and a layer may have no bias
        names = names if "action_net.weight" not in tensors else ["action_net"]
    wanted = {f"{name}.{part}" for name in names for part in ("weight", "bias")}
    if not kind.others:
        wanted -= {f"{name}.bias" for name in names if f"{name}.bias" not in tensors}
    if wanted - set(tensors) or not names:
        raise InputError(
            f"the tensors of {what} must be those of MlpPolicy; missing {sorted(wanted - set(tensors))}, "
            f"found {braced(tensors) or 'none'}."
        )
    layers = [linear(tensors[f"{name}.weight"], tensors.get(f"{name}.bias")) for name in names]
    why = _OF_TRAINING if "box" in kind.actions else "the target network of training"
    known = {name: why for name in tensors if name.startswith(kind.others)}
    return layers, unread(tensors, wanted, kind.hidden[-1], len(layers[-1].bias), ignored, known)
