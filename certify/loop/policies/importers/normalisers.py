"""Normalisers of observations: VecNormalize of stable-baselines3, and the empirical one of rsl_rl.

`VecNormalize` is a pickle of an environment; it is read as data, and of it only the mean, the variance, epsilon and the
clip. It computes `clip((o - mean) / sqrt(var + epsilon), -clip, clip)`; rsl_rl `(o - mean) / (std + epsilon)`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any

from certify.errors import InputError
from certify.loop.files.arrays import Numbers, array_of
from certify.loop.files.pickles import Call, Name, brief, read_pickle
from certify.loop.policies.importers.steps import Diagonal, Normalise, exactly
from certify.loop.policies.importers.tensors import load_tensors

Normaliser = Normalise | Diagonal
_RSL_EPSILON = Fraction(1, 100)
_CRITIC = ("critic", "privileged")


def load_normaliser(path: Path, epsilon: Fraction | None) -> Normaliser:
    """The normaliser in a file of VecNormalize (`.pkl`) or in a checkpoint of rsl_rl.

    Raises
    ------
    InputError : the file is none of the two, or holds no statistics of arrays of observations.
    """
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise InputError(f"normaliser file {path} cannot be read: {error.strerror}.") from error
    what = f"normaliser file {path}"
    if raw.startswith(b"PK"):
        found = rsl_normaliser(load_tensors(raw, what), epsilon)
        if found is None:
            raise InputError(f"{what} must hold _mean and _std, as rsl_rl writes them; it has none.")
        return found
    if epsilon is not None:
        raise InputError("--epsilon must be left out: a file of VecNormalize says its own.")
    return _vec_normalize(read_pickle(raw, what), what)


def _vec_normalize(root: Any, what: str) -> Normaliser:
    if not isinstance(root, Call) or not isinstance(root.function, Name) or root.function.name != "VecNormalize":
        raise InputError(f"{what} must be a pickle of VecNormalize; found {brief(root)}.")
    state = _state(root, what)
    normalises = state.get("norm_obs", True)
    if not isinstance(normalises, bool):
        raise InputError(f"norm_obs in {what} must be true or false; found {brief(normalises)}.")
    if not normalises:
        return Diagonal((Fraction(1),), (Fraction(0),))
    moments = [_moments(each, of) for each, of in _statistics(state, what)]
    mean, var = (tuple(v for each in moments for v in exactly(each[k])) for k in (0, 1))
    epsilon = _one(state.get("epsilon"), "epsilon")
    limit = None if state.get("clip_obs") == math.inf else _one(state.get("clip_obs"), "clip_obs")
    return Normalise(mean, tuple(v + epsilon for v in var), limit)


def _statistics(state: dict[Any, Any], what: str) -> list[tuple[Any, str]]:
    """The statistics of the observation, or of each array of it in the order of their names."""
    found = state.get("obs_rms")
    if not isinstance(found, dict):
        return [(found, f"obs_rms in {what}")]
    names, normalised = list(found), state.get("norm_obs_keys")
    if not names or not all(isinstance(name, str) for name in names):
        raise InputError(f"obs_rms in {what} must have statistics by the names of observations; it has none.")
    if normalised is not None and (not isinstance(normalised, list) or set(map(str, normalised)) != set(names)):
        raise InputError(f"{what} must normalise each array of its observation; norm_obs_keys leaves some as they are.")
    return [(found[name], f"obs_rms of {name} in {what}") for name in sorted(names)]


def _moments(statistics: Any, what: str) -> tuple[Numbers, Numbers]:
    if not isinstance(statistics, Call) or not isinstance(statistics.function, Name):
        raise InputError(f"a normaliser must hold obs_rms of arrays of observations; {what} is {brief(statistics)}.")
    if statistics.function.name != "RunningMeanStd":
        raise InputError(f"{what} must be a RunningMeanStd; found {statistics.function}.")
    inner = _state(statistics, what)
    mean, var = array_of(inner.get("mean"), "obs_rms.mean"), array_of(inner.get("var"), "obs_rms.var")
    if mean.ndim != 1 or mean.shape != var.shape:
        raise InputError(
            f"the mean and variance of {what} must be two vectors of one size; found {mean.shape}, {var.shape}."
        )
    return mean, var


def normaliser_root(tensors: Mapping[str, Numbers]) -> str | None:
    """Prefix of the names of that normaliser's tensors, or None if the file has none.

    Raises
    ------
    InputError : there are several.
    """
    roots = [name.removesuffix("_mean") for name in tensors if name.rpartition(".")[2] == "_mean"]
    roots = [r for r in roots if f"{r}_std" in tensors and not any(word in r for word in _CRITIC)]
    if len(roots) > 1:
        raise InputError(f"a checkpoint must hold one normaliser of observations; found {', '.join(roots)}.")
    return roots[0] if roots else None


def rsl_normaliser(tensors: Mapping[str, Numbers], epsilon: Fraction | None) -> Diagonal | None:
    """The empirical normaliser of the policy's observations in a checkpoint of rsl_rl, or None if it has none."""
    root = normaliser_root(tensors)
    if root is None:
        return None
    mean, std = exactly(tensors[f"{root}_mean"]), exactly(tensors[f"{root}_std"])
    divisors = [s + (_RSL_EPSILON if epsilon is None else epsilon) for s in std]
    if len(mean) != len(std) or any(d <= 0 for d in divisors):
        raise InputError("a normaliser must have as many means as standard deviations, and these must be positive.")
    pairs = zip(mean, divisors, strict=True)
    return Diagonal(tuple(1 / d for d in divisors), tuple(-m / d for m, d in pairs))


def _one(node: Any, name: str) -> Fraction:
    values = exactly(array_of(node, name))
    if len(values) != 1:
        raise InputError(f"{name} must be one number; found {len(values)}.")
    return values[0]


def _state(node: Call, what: str) -> dict[Any, Any]:
    if len(node.states) != 1 or not isinstance(node.states[0], dict):
        raise InputError(f"{what} must hold its attributes as a dictionary; found {brief(node)}.")
    return node.states[0]
