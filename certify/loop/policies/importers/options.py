"""Options of an import: facts about a policy that its file does not contain.

Nothing is guessed: a reader that misses a fact asks for the option by name.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from fractions import Fraction
from pathlib import Path
from typing import Any, Literal, get_args

from certify.errors import InputError
from certify.loop.policies.importers.steps import IMPORTED, Clip, parted
from certify.loop.policies.network import Centre

Kind = Literal["auto", "state-dict", "torchscript", "onnx", "sb3", "safetensors", "two-stage"]
Output = Literal["identity", "tanh", "relu-tanh"]
Norm = Literal["layer-before", "layer-after"]
Observes = Literal["absolute", "deviation"]
KNOWN_ACTIVATIONS = f"{', '.join(IMPORTED[:-1])} and {IMPORTED[-1]}"
"""The activations that are proved, in words."""
_WITH_ANOTHER = (
    "Train the policy again with one of them between its layers, such as tanh: "
    "policy_kwargs=dict(activation_fn=torch.nn.Tanh) for stable-baselines3, activation = 'tanh' for rsl_rl, "
    "fcnet_activation = 'tanh' for RLlib."
)
WITH_TANH = f"The activations that are proved are {KNOWN_ACTIVATIONS}. {_WITH_ANOTHER}"
"""The next step where a policy has another activation."""
WITHOUT_NORMALISATION = (
    "LayerNorm is read of a module, of TorchScript, of ONNX, and of a policy's state_dict with --norm layer-before or "
    "layer-after (the activation); RMSNorm, and BatchNorm in evaluation, of all these but a state_dict; for another "
    "normalisation between layers train the policy again without it."
)
"""The next step where a policy has a normalisation between its layers."""


@dataclass(frozen=True, slots=True)
class ImportOptions:
    """Known facts about a policy file of another program; None where nothing is given.

    Parameters
    ----------
    kind : the kind of file, or `auto`.
    prefix : in a state_dict, the keys of the policy's layers up to their numbers, such as `actor.pi_net.fcs`; or
        several of these, and layers without a number, in their order, as in `pi.net,pi.mu`.
    activation : between the layers of a state_dict, by its name: tanh, relu, elu (alpha 1), sigmoid, silu, gelu (the
        exact one), gelu-tanh (its tanh form), softplus (beta 1), mish, softsign, leaky_relu (slope 0.01), selu, celu
        (alpha 1), hardtanh, relu6, hardsigmoid, hardswish or logsigmoid; another number than that in brackets, a
        binary64, is said as in `leaky_relu:0.1`.
    norm : the layer normalisation between the layers of a state_dict, `layer-before` or `layer-after` the activation;
        None if there is none.
    norm_epsilon : the number that it adds to the variance; 1e-5 by default.
    squash : what follows the last layer of a state_dict: `identity`, `tanh`, or `relu-tanh` for relu(tanh(.)).
    states : what the network reads, in its order: states of the plant, or expressions of them and of its parameters,
        such as `cos(theta)`.
    normaliser : a file with the observations' normaliser, or `none`.
    epsilon : the number that rsl_rl's normaliser adds to the standard deviation; 1/100 by default.
    action_scale, action_offset : `u = scale * action + offset` in the plant's units, exact, one number or m.
    clip : bounds of the action, before scale and offset.
    centre : the centring that gives pi(0) = u_eq; None leaves the policy as it is.
    observes : `absolute` if the network reads the states' values, `deviation` if deviations from the operating point.
    ignore : names of tensors that are no part of the policy, with `*` and `?` as in names of files.
    output : which output of a program is the action, where it has several: a name for ONNX, for TorchScript and modules
        the place, counted from 0. Of a state_dict: `mean`, if its last layer gives the mean of the actions and then
        their spread, or the places of the actions in what that gives, as in 0,2.

    Raises
    ------
    InputError : a value is none of those that an option takes.
    """

    kind: Kind = "auto"
    prefix: str | None = None
    activation: str | None = None
    squash: Output | None = None
    states: tuple[str, ...] | None = None
    normaliser: Path | Literal["none"] | None = None
    epsilon: Fraction | None = None
    action_scale: tuple[Fraction, ...] | None = None
    action_offset: tuple[Fraction, ...] | None = None
    clip: Clip | None = None
    centre: Centre | None = None
    observes: Observes | None = None
    ignore: tuple[str, ...] | None = None
    output: str | None = None
    norm: Norm | None = None
    norm_epsilon: Fraction | None = None

    def __post_init__(self) -> None:
        for option, value, known in (
            ("--from", self.kind, get_args(Kind)),
            ("--norm", self.norm, get_args(Norm)),
            ("--squash", self.squash, get_args(Output)),
            ("--centre", self.centre, get_args(Centre)),
            ("--observes", self.observes, get_args(Observes)),
        ):
            if value is not None and value not in known:
                raise InputError(f"{option} must be one of {', '.join(known)}; found {value!r}.")
        if self.activation is not None:
            named = {_plain(name): name for name in IMPORTED}
            typed, colon, number = self.activation.partition(":")
            if _plain(typed) not in named:
                raise InputError(
                    f"--activation must be one of {', '.join(IMPORTED)}; found {self.activation!r}. {_WITH_ANOTHER}"
                )
            object.__setattr__(self, "activation", f"{named[_plain(typed)]}{colon}{number}")
            parted(self.activation)
        for name in ("action_scale", "action_offset"):
            if isinstance(value := getattr(self, name), int | float | Fraction):
                object.__setattr__(self, name, (Fraction(value),))
        if self.action_scale is not None and 0 in self.action_scale:
            raise InputError("--action-scale must not be 0.")
        if self.epsilon is not None and self.epsilon < 0:
            raise InputError(f"--epsilon must not be negative; found {float(self.epsilon)}.")
        if self.norm_epsilon is not None and (self.norm is None or self.norm_epsilon <= 0):
            raise InputError(
                f"--norm-epsilon must be positive, and go with --norm; found {float(self.norm_epsilon)}, and "
                f"{'no --norm' if self.norm is None else self.norm}."
            )

    @property
    def given(self) -> dict[str, Any]:
        """The options that were given, as text: for messages and for the record in the policy file."""
        names = (f.name for f in fields(self))
        values = {name: getattr(self, name) for name in names}
        return {_OPTIONS[k]: _text(v) for k, v in values.items() if v is not None and v != "auto"}


_OPTIONS = {
    "kind": "--from", "prefix": "--prefix", "activation": "--activation", "squash": "--squash", "states": "--states",
    "normaliser": "--normaliser", "epsilon": "--epsilon", "action_scale": "--action-scale",
    "action_offset": "--action-offset", "clip": "--clip", "centre": "--centre", "observes": "--observes",
    "ignore": "--ignore", "output": "--output", "norm": "--norm", "norm_epsilon": "--norm-epsilon",
}  # fmt: skip


def _plain(name: str) -> str:
    """A name as `LeakyReLU`, `leaky_relu` and `leaky-relu` have it in common."""
    return name.lower().replace("_", "").replace("-", "")


def _text(value: Any) -> str:
    if isinstance(value, Path):
        return value.name
    if isinstance(value, Clip):
        return ",".join(
            f"{'' if lo is None else lo}:{'' if hi is None else hi}" for lo, hi in zip(value.lo, value.hi, strict=True)
        )
    return ",".join(map(str, value)) if isinstance(value, tuple) else str(value)
