"""The policy file: plain tensors only. It is `certify-policy/1`, with a clip or bounds of validity `certify-policy/2`,
with another activation than tanh `certify-policy/3`, and with other steps than layers `certify-policy/4`.

Nothing in a file is executed, and equal policies give equal bytes (see `certify.loop.files.plain`).
"""

from __future__ import annotations

import json
import shlex
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from types import MappingProxyType
from typing import Any, cast

import numpy as np

from certify.errors import CertificateFormatError, InputError
from certify.loop.activations import ACTIVATIONS
from certify.loop.expressions import Symbol, from_tree, to_tree
from certify.loop.files.arrays import Numbers
from certify.loop.files.foreign import described
from certify.loop.files.plain import array_in, layers_in, origin_in, read_plain, require_keys, tensors, write_plain
from certify.loop.networks import Affine, Clip, Concat, Map, Network, Observe, Product, Step, Sum
from certify.loop.policies.network import Array, Centre, PolicyNetwork, Squash
from certify.loop.policies.programmed import chain

FORMAT = "certify-policy/1"
# The same with `output.clip`, a pair of tensors, or `valid`, a tensor (n, 2), or both; others stay version 1.
SECOND = "certify-policy/2"
# The same with another `activation`.
THIRD = "certify-policy/3"
# The same with `reads` and `steps` instead of `activation`, `weights` and `biases`.
FOURTH = "certify-policy/4"
_LAYERS = {"activation", "weights", "biases"}
_KEYS = {"format", "output", "centre", "system"}
_ARRAYS = {"affine": ("weight", "bias"), "clip": ("lo", "hi")}  # of a step
_PARTS = {"map": {"function"}, "observe": {"names", "expressions"}}  # and what else it has
_OPTIONAL = {"training", "beta", "valid"}
_WHAT = "policy file"
_START = 4096
_HEAD = 100  # bytes of a file, within which a certificate says what it is
_COMES_FROM = (
    "A policy file comes from controllers train, or from another program's file through certify import FILE "
    "--system PLANT --out policy.pt."
)
_BETA_ROUNDING = 2.0**-20  # of tanh(beta): a few operations in single precision


@dataclass(frozen=True, slots=True)
class Policy:
    """A network with the plant it was trained for.

    Parameters
    ----------
    network : the policy itself.
    system : name of the plant.
    parameters : parameters of the plant as text or numbers (text means its decimal value).
    training : the record of its training (seed, steps, versions, A, B, K ...); never trusted, may be empty.
    beta : rounded `atanh((u_eq - offset) / scale)` stored by another program, shape (m,), or None;
        the proof uses the real number and reports the shift.
    valid : bounds of each state, shape (n, 2), infinite where there is none, or None. Only between them the network
        equals its source, because no observation is clipped there. A plant's domain must be cut to them before a
        proof; `certify roa` does so.

    Raises
    ------
    InputError : the bounds are not n pairs lo < 0 < hi, or bound nothing.
    """

    network: PolicyNetwork
    system: str
    parameters: Mapping[str, float | int | str] = field(default_factory=dict)
    training: Mapping[str, Any] = field(default_factory=dict)
    beta: Array | None = None
    valid: Array | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "parameters", MappingProxyType(dict(self.parameters)))
        object.__setattr__(self, "training", MappingProxyType(dict(self.training)))
        if self.valid is not None:
            valid = np.array(self.valid, dtype=np.float64)
            if valid.shape != (self.network.n, 2) or np.all(np.isinf(valid)):
                raise InputError(f"`valid` must be bounds of shape ({self.network.n}, 2); found {valid.tolist()}.")
            if not (np.all(valid[:, 0] < 0) and np.all(valid[:, 1] > 0)):
                raise InputError(
                    "the states where no observation is clipped must surround the origin; "
                    f"found the bounds {valid.tolist()}."
                )
            valid.setflags(write=False)
            object.__setattr__(self, "valid", valid)

    def beta_shift(self, u_eq: Sequence[Fraction]) -> float:
        """The change of u at the origin when the stored beta is read as the real number, in the input's units.

        Raises
        ------
        InputError : the stored beta is another number than the real one rounded.
        """
        if self.beta is None:
            return 0.0
        network, ratios = self.network, np.array([float(q) for q in self.network.ratios(u_eq)])
        off = np.abs(np.tanh(self.beta) - ratios)
        if not np.all(off <= _BETA_ROUNDING):
            j = int(np.argmax(off))
            raise InputError(
                f"`beta` must be atanh((u_eq - offset) / scale) up to rounding, {network.beta(u_eq)[j]:.9g} for input "
                f"{j}; the file has {self.beta[j]:.9g}, which shifts u(0) by {abs(network.scale[j]) * off[j]:.3g}. "
                "Was it trained for other parameters?"
            )
        return float(np.max(np.abs(network.scale) * off))


def save_policy(path: str | Path, policy: Policy) -> None:
    """Write `policy` to `path` in one step; the same policy gives the same bytes.

    Raises
    ------
    InputError : the file cannot be written.
    """
    network = policy.network
    if network.is_moved:
        raise InputError("a policy must be written as its layers read it; found one that is looked at from elsewhere.")
    of_steps = [a for step in network.network.steps for a in step.arrays]
    numbers = tensors((*of_steps, network.scale, network.offset, *(network.clip or ())))
    scale, offset, *clip = numbers[len(of_steps) :]
    data: dict[str, Any] = {
        "format": _format_of(policy),
        **_program(network.network, iter(numbers)),
        "output": {"squash": network.squash, "scale": scale, "offset": offset},
        "centre": network.centre,
        "system": {"name": policy.system, "parameters": dict(policy.parameters)},
        "training": dict(policy.training),
    }
    if network.clip is not None:
        data["output"]["clip"] = clip
    if policy.valid is not None:
        data["valid"] = np.asarray(policy.valid)
    if policy.beta is not None:
        data["beta"] = np.asarray(policy.beta, dtype=np.float64)
    write_plain(path, data, _WHAT)


def _program(network: Network, numbers: Iterator[Numbers]) -> dict[str, Any]:
    """The steps, whose arrays come as numbers in their order; of a chain its layers."""
    if network.is_chain:
        of_layers = [(next(numbers), next(numbers)) for _ in network.affine]
        weights, biases = (list(column) for column in zip(*of_layers, strict=True))
        return {"activation": next(iter(network.functions), "tanh"), "weights": weights, "biases": biases}
    steps = []
    for step in network.steps:
        part: dict[str, Any] = {"kind": step.kind, "of": list(step.of)}
        part |= {name: next(numbers) for name in _ARRAYS.get(step.kind, ())}
        if isinstance(step, Map):
            part["function"] = step.function
        if isinstance(step, Observe):
            part["names"] = [s.name for s in step.symbols]
            part["expressions"] = json.dumps([to_tree(e) for e in step.expressions])
        steps.append(part)
    return {"reads": network.reads, "steps": steps}


def _format_of(policy: Policy) -> str:
    """The oldest version of the format that holds it."""
    if not policy.network.network.is_chain:
        return FOURTH
    if policy.network.network.functions not in ((), ("tanh",)):
        return THIRD
    return FORMAT if policy.network.clip is None and policy.valid is None else SECOND


def _require_activation(version: str, name: Any) -> None:
    """Reject a function that this version does not have; version 3 is there for all but tanh."""
    known = ("tanh",) if version != THIRD else tuple(row for row in ACTIVATIONS if row != "tanh")
    if not isinstance(name, str) or name not in known:
        raise InputError(f"`activation` of {version} must be one of {', '.join(known)}; found {name!r}.")


def load_policy(path: str | Path) -> Policy:
    """Read a policy file.

    Raises
    ------
    InputError : the file is missing, is not an archive of plain tensors, follows none of the four
        versions, or is another program's; then the message says how to import it.
    """
    try:
        data = read_plain(path, _WHAT)
    except InputError as error:
        raise InputError(_other(Path(path)) or str(error)) from error
    if not isinstance(data, dict) or "format" not in data:
        found = f"a file of torch.save without `format`, a {type(data).__name__}"
        raise InputError(_to_import(Path(path), found))
    try:
        return _policy(data)
    except InputError as error:
        raise InputError(f"policy file {path}: {error}") from error


def is_text(raw: bytes) -> bool:
    """True if the first bytes are readable text."""
    start = raw[:_START]
    try:
        words = start.decode("utf-8")
    except UnicodeDecodeError as error:
        if error.start < len(start) - 3:  # a letter may be cut off at the end
            return False
        words = start[: error.start].decode("utf-8")
    return bool(words) and all(c.isprintable() or c in "\t\r\n\f" for c in words)


def _other(path: Path) -> str | None:
    """The message for a file that is no policy file of this program, if its bytes show its kind."""
    try:
        with path.open("rb") as file:
            raw = file.read(_START)
            names = set(zipfile.ZipFile(file).namelist()) if raw.startswith(b"PK") else set()
    except (OSError, ValueError, zipfile.BadZipFile, NotImplementedError):
        return None
    if (known := described(raw, path.name, names)) is not None:
        return f"{_WHAT} {path} must hold a policy; it is {known}"
    if {"data", "policy.pth"} <= names:
        return _to_import(path, "a zip file of stable-baselines3")
    if any("/code/" in name for name in names):
        return _to_import(path, "a file of TorchScript")
    if any(name.endswith("/data.pkl") for name in names):
        return _to_import(path, "a file of torch.save with more than plain tensors in it")
    if path.suffix == ".onnx":
        return _to_import(path, "an ONNX model")
    if path.suffix == ".safetensors" or raw[8:9] == b"{":
        return _to_import(path, "a file of safetensors")
    if b'"certify-certificate/' in raw[:_HEAD]:
        return (
            f"{_WHAT} {path} must hold a policy; it is a certificate, which has a policy inside and is no policy file. "
            f"Name the policy file from which it was made: this command proves the claim anew."
        )
    if raw.startswith(b"\x93NUMPY"):
        return (
            f"{_WHAT} {path} must hold a policy; it is one array of numpy. A gain K, u = -K x, is one layer: write it "
            "by numpy.savez('gain.npz', **{'0.weight': -K}), and name that file, with the options of certify import."
        )
    if is_text(raw):
        return f"{_WHAT} {path} must hold a policy; it is text. {_COMES_FROM}"
    return None


def _to_import(path: Path, found: str) -> str:
    """The message for a file that another program wrote, with the command to type."""
    file, out = (shlex.quote(str(p)) for p in (path, f"{path.stem}-policy.pt"))
    return (
        f"{_WHAT} {path} must be one of this program; it is {found} (nothing in it was executed). If it holds a "
        f"policy, import it first, for the plant that it controls: certify import {file} --system PLANT --out {out}. "
        "The import asks for what the file does not say."
    )


def _policy(data: Any) -> Policy:
    found = data.get("format") if isinstance(data, dict) else type(data).__name__
    if not isinstance(data, dict) or found not in (FORMAT, SECOND, THIRD, FOURTH):
        raise InputError(f"`format` must be {FORMAT!r}, {SECOND!r}, {THIRD!r} or {FOURTH!r}; found {found!r}.")
    keys, output = set(data), data.get("output")
    parts = {"squash", "scale", "offset"}
    if found == SECOND and isinstance(output, dict) and ("clip" in output or "valid" not in keys):
        parts |= {"clip"}  # one of the two is what makes a file version 2
    if found in (THIRD, FOURTH) and isinstance(output, dict) and "clip" in output:
        parts |= {"clip"}
    if found == FORMAT and "valid" in keys:
        raise InputError(f"`valid` must go with format {SECOND!r}; found {FORMAT!r}.")
    require_keys(data, _KEYS | ({"reads", "steps"} if found == FOURTH else _LAYERS), _OPTIONAL)
    if not isinstance(output, dict) or set(output) != parts:
        raise InputError(f"`output` of {found} must be a dictionary with exactly {', '.join(sorted(parts))}.")
    clip = output.get("clip", ())
    if not isinstance(clip, list | tuple) or len(clip) != (2 if "clip" in parts else 0):
        raise InputError("`output.clip` must be a list of two tensors, lo and hi.")
    system, parameters, training = origin_in(data)
    network = PolicyNetwork(
        _read_steps(data) if found == FOURTH else _read_layers(data),
        scale=array_in(output["scale"], "output.scale"),
        offset=array_in(output["offset"], "output.offset"),
        squash=cast(Squash, output["squash"]),
        centre=cast(Centre, data["centre"]),
        clip=cast(Any, tuple(array_in(end, "output.clip") for end in clip) or None),
    )
    beta = array_in(data["beta"], "beta") if "beta" in data else None
    if beta is not None and (beta.shape != (network.m,) or network.centre != "preactivation"):
        raise InputError(f"`beta` must have shape ({network.m},) and goes with centre 'preactivation'.")
    valid = array_in(data["valid"], "valid") if "valid" in data else None
    return Policy(network, system, parameters, training, beta, valid)


def _read_layers(data: Mapping[str, Any]) -> Network:
    version, function = data["format"], data["activation"]
    _require_activation(version, function)
    weights, biases = layers_in(data)
    network = chain(weights, biases, function)
    if len(weights) == 1 and function != "tanh":
        raise InputError(f"`activation` must be 'tanh' of a policy with one layer; found {function!r}.")
    return network


def _read_steps(data: Mapping[str, Any]) -> Network:
    reads, steps = data["reads"], data["steps"]
    if type(reads) is not int or reads < 1 or not isinstance(steps, list):
        raise InputError("`reads` must be a number of states, `steps` a list.")
    network = Network(reads, tuple(_read_step(step, f"steps[{k}]") for k, step in enumerate(steps)))
    if network.is_chain:
        raise InputError(f"layers with a function between them must go with format {THIRD!r} or an earlier one.")
    return network


def _read_step(step: Any, name: str) -> Step:
    kind = step.get("kind") if isinstance(step, dict) else None
    kinds: dict[Any, type[Step]] = {of.kind: of for of in (Affine, Map, Clip, Sum, Concat, Product, Observe)}
    if not isinstance(kind, str) or kind not in kinds:
        raise InputError(f"`{name}.kind` must be one of {', '.join(kinds)}; found {kind!r}.")
    arrays = _ARRAYS.get(kind, ())
    require_keys(step, {"kind", "of", *arrays} | _PARTS.get(kind, set()), set())
    of = step["of"]
    if not isinstance(of, list) or not all(type(i) is int for i in of):
        raise InputError(f"`{name}.of` must be a list of numbers of vectors; found {of!r:.60}.")
    if len(of) != 1 and kind not in ("sum", "concat", "product"):
        raise InputError(f"`{name}.of` must be one vector; found {of!r:.60}.")
    if kind == "map" and step["function"] not in ACTIVATIONS:
        raise InputError(f"`{name}.function` must be one of {', '.join(ACTIVATIONS)}; found {step['function']!r:.60}.")
    others = [array_in(step[part], f"{name}.{part}") for part in arrays]
    if kind == "map":
        others = [step["function"]]
    if kind == "observe":
        others = _read_observation(step, name)
    return kinds[kind](tuple(of), *others)


def _read_observation(step: Mapping[str, Any], name: str) -> list[Any]:
    names, text = step["names"], step["expressions"]
    if not isinstance(names, list) or not all(isinstance(s, str) and s.isidentifier() for s in names):
        raise InputError(f"`{name}.names` must be a list of names; found {names!r:.60}.")
    symbols = {s: Symbol(s) for s in names}
    try:
        trees = json.loads(text)
        if not isinstance(trees, list):
            raise ValueError("it is no list")
        expressions = tuple(from_tree(tree, symbols) for tree in trees)
    except (ValueError, TypeError, RecursionError, CertificateFormatError) as error:
        raise InputError(f"`{name}.expressions` must be a text of expressions as lists: {error}.") from error
    return [tuple(map(Symbol, names)), expressions]
