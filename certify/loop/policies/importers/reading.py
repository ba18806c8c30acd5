"""The result of reading a file: exact steps, and the framework's own evaluation of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.errors import InputError
from certify.loop.activations import ACTIVATIONS
from certify.loop.policies.importers.options import Output
from certify.loop.policies.importers.steps import (
    Affine,
    Branches,
    Diagonal,
    Normalise,
    Step,
    activated,
    exactly,
    layer_normalised,
    parted,
)
from certify.loop.policies.network import Array

Observations = NDArray[np.floating[Any]]
Values = NDArray[Any]
Evaluate = Callable[[Observations, bool], Values]


@dataclass(frozen=True, slots=True)
class Reading:
    """A policy as its file describes it.

    Parameters
    ----------
    words : the kind of file and of policy, for people.
    steps : from the (normalised) observation to the action.
    evaluate : the framework's own evaluation of the same, observations (k, n) to actions (k, m), in single precision,
        or, if the second argument says so, with the same operations in double precision.
    normaliser : the file's own normaliser, if it has one.
    action : the bounds of the action that the file states, (m,) pairs, if it states any.
    beta : stored `atanh((u_eq - offset) / scale)` of a policy that is centred inside its squash, shape (m,).
    equilibrium : the state at which a policy of that kind is centred, shape (n,).
    double : True if the file itself asks for double precision.
    program : the part of the file's own program that `evaluate` runs, for people; None where the file holds numbers and
        no program, so that `evaluate` can check the folding alone.
    assumed : without a program, the source of the functions between the numbers.
    unread : the reason why each unread tensor is left out, by its name.
    beside : SHA-256 of each other file that was read with it, by its name.
    scores : True if the outputs are scores of a discrete set of actions, of which the largest is taken.

    Raises
    ------
    InputError : there is no layer among the steps.
    """

    words: str
    steps: tuple[Step, ...]
    evaluate: Evaluate
    normaliser: Normalise | Diagonal | None = None
    action: tuple[tuple[Fraction, Fraction], ...] | None = None
    beta: Array | None = None
    equilibrium: Array | None = None
    double: bool = False
    program: str | None = None
    assumed: str = ""
    unread: Mapping[str, str] = field(default_factory=dict)
    beside: Mapping[str, str] = field(default_factory=dict)
    scores: bool = False

    def __post_init__(self) -> None:
        if _reads(self.steps) is None:
            raise InputError("a policy must have a layer; the file has none.")

    @property
    def n(self) -> int:
        """Number of observations that the first layer reads."""
        return _reads(self.steps) or 0

    @property
    def m(self) -> int:
        """Number of actions."""
        return gives(self.steps, self.n)


def _reads(steps: Sequence[Step]) -> int | None:
    """The number of entries that a chain's first layer reads; None if it has no layer."""
    for step in steps:
        if isinstance(step, Affine):
            return int(step.weight.shape[1])
        if isinstance(step, Branches):
            known = [found for chain in step.of if (found := _reads(chain)) is not None]
            if known:
                return known[0]
    return None


def gives(steps: Sequence[Step], width: int) -> int:
    """The number of entries that a chain makes of so many."""
    for step in steps:
        if isinstance(step, Affine):
            width = int(step.weight.shape[0])
        if isinstance(step, Branches):
            ends = [gives(chain, width) for chain in step.of]
            width = sum(ends) if step.kind == "concat" else max(ends)
    return width


_FORMULAS: Mapping[str, Callable[..., Values]] = {
    "leaky_relu": lambda v, slope=0.01: np.where(v > 0, v, slope * v),
    "elu": lambda v, alpha=1.0: np.where(v > 0, v, alpha * ACTIVATIONS["elu"](v)),
    "softplus": lambda v, beta=1.0: ACTIVATIONS["softplus"](beta * v) / beta,
    "selu": lambda v: 1.0507009873554805 * np.where(v > 0, v, 1.6732632423543772 * ACTIVATIONS["elu"](v)),
    "celu": lambda v, alpha=1.0: np.where(v > 0, v, alpha * ACTIVATIONS["elu"](v / alpha)),
    "hardtanh": lambda v: np.clip(v, -1, 1),
    "relu6": lambda v: np.clip(v, 0, 6),
    "hardsigmoid": lambda v: np.clip(v + 3, 0, 6) / 6,
    "hardswish": lambda v: v * (np.clip(v + 3, 0, 6) / 6),
    "logsigmoid": lambda v: -np.logaddexp(0, -v),
    "gelu-tanh": lambda v: 0.5 * v * (1 + np.tanh(0.7978845608028654 * (v + 0.044715 * v * v * v))),
}
"""The activations that are made of others, or have a number, as they are written elsewhere."""


@dataclass(frozen=True, slots=True)
class LayerNorm:
    """A layer normalisation between two layers, before the activation or after it, with its gain and bias (n,)."""

    gain: Array
    bias: Array
    epsilon: Fraction
    before: bool

    @property
    def steps(self) -> tuple[Step, ...]:
        """It as exact steps."""
        nothing, one = (Fraction(0),), (Fraction(1),)
        tail = Diagonal(exactly(self.gain), nothing), Diagonal(one, exactly(self.bias))
        return (*layer_normalised(self.gain.size, self.epsilon), *tail)

    def __call__(self, v: Values) -> Values:
        """Its values of rows of numbers, in their precision."""
        apart = v - np.mean(v, axis=-1, keepdims=True)
        root = np.sqrt(np.mean(apart * apart, axis=-1, keepdims=True) + v.dtype.type(self.epsilon))
        found: Values = apart / root * self.gain.astype(v.dtype) + self.bias.astype(v.dtype)
        return found


Norms = Mapping[int, LayerNorm]
"""Normalisations by the number of the layer that they stand before."""


def perceptron(
    layers: Sequence[Affine],
    squash: Output = "identity",
    activation: str = "tanh",
    norms: Norms | None = None,
) -> Evaluate:
    """The layers with an activation, and maybe a normalisation, between them, and `squash` behind them, in numpy."""
    name, numbers = parted(activation)

    def phi(v: Values) -> Values:
        return _FORMULAS[name](v, *numbers) if name in _FORMULAS else ACTIVATIONS[name](v)

    ends: dict[Output, Callable[[Values], Values]] = {
        "identity": lambda y: y,
        "tanh": np.tanh,
        "relu-tanh": lambda y: np.maximum(np.tanh(y), 0),
    }

    def evaluate(x: Observations, double: bool) -> Values:
        kind = np.float64 if double else np.float32
        h = x.astype(kind)
        for k, layer in enumerate(layers):
            for function in _between(k, phi, norms):
                h = function(h)
            h = h @ layer.weight.T.astype(kind) + layer.bias.astype(kind)
        return ends[squash](h)

    return evaluate


def _between(k: int, phi: Callable[[Values], Values], norms: Norms | None) -> tuple[Callable[[Values], Values], ...]:
    """The functions before layer `k`, in order."""
    norm = (norms or {}).get(k)
    return () if not k else (phi,) if norm is None else (norm, phi) if norm.before else (phi, norm)


def between(layers: Sequence[Affine], activation: str = "tanh", norms: Norms | None = None) -> tuple[Step, ...]:
    """The layers as steps, with an activation, and maybe a normalisation, between them."""
    name, numbers = parted(activation)
    function, steps = activated(name, *map(Fraction, numbers)), list[Step]()
    for k, layer in enumerate(layers):
        norm = (norms or {}).get(k)
        if k:
            normalised = () if norm is None else norm.steps
            steps += (*normalised, *function) if norm is not None and norm.before else (*function, *normalised)
        steps.append(layer)
    return tuple(steps)


def widths(layers: Sequence[Affine]) -> str:
    """The widths from observation to action, such as 2-16-16-1."""
    return "-".join(str(w) for w in (layers[0].weight.shape[1], *(len(layer.bias) for layer in layers)))
