"""The options of a training run, which are also the command line, and each plant's choice among them.

Numbers that the paper fixes are defaults of `TrainingOptions`; numbers that depend on the plant have no default there
and come from the plant's preset. All of them are written into the policy's `training` record.

There is no list of plants: the plant `NAME` is the file `plants/shipped/NAME.py` with its constant `PLANT`, as its
equations are the file `NAME.py` among `certify.loop.plants.shipped`.
"""

from __future__ import annotations

import importlib
import math
import pkgutil
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields, replace
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

from certify.errors import InputError, OptionError
from controllers.plants import shipped

if TYPE_CHECKING:
    from certify.loop.plants import System

Activation = Literal["tanh", "relu", "elu", "sigmoid", "silu", "gelu", "softplus", "mish", "softsign"]
Centre = Literal["preactivation", "output", "none"]
Identification = Literal["during", "before", "never"]
Transitions = Literal["all", "latest"]
Terms = Literal["linear", "quadratic"]
IdentificationStarts = Literal["ball", "domain"]
RewardAt = Literal["next", "current"]
GainNorm = Literal["frobenius", "spectral"]
PresetName = Literal["ours", "paper"]


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingOptions:
    """The options on which a run of SAC with a learned LQR gain depends, beside the plant.

    Weights are the diagonals of Q_r, Q_c (one entry a state) and R_c (one entry an input).

    Raises
    ------
    InputError : a number is out of its range; the message names it.
    """

    # The run
    steps: Annotated[int, "Environment steps of the whole run."]
    seed: Annotated[int, "Seed of everything random."] = 0
    threads: Annotated[int, "Threads of torch; networks this small are fastest with one."] = 1
    # The task
    dt: Annotated[
        float, "Seconds for which an input is held, integrated by one RK4 step; 1 for a plant in discrete time."
    ]
    horizon: Annotated[int, "Steps after which an episode is truncated."]
    start: Annotated[float, "Episodes start uniformly in this share of the domain."] = 1.0
    reward_offset: Annotated[float, "r0 of the reward r0 - x'Q_r x."]
    reward_weights: Annotated[tuple[float, ...], "Diagonal of Q_r."]
    reward_at: Annotated[
        RewardAt, "State whose cost x'Q_r x the reward of a step has: the next one, or the current one."
    ] = "next"
    penalty: Annotated[float, "c: subtracted from the reward when the state leaves the domain."]
    # Soft actor-critic
    learning_rate: Annotated[float, "Step of Adam, actor and critics."] = 3e-4
    gamma: Annotated[float, "Discount factor."] = 0.99
    replay: Annotated[int, "Transitions that the replay buffer holds."] = 1_000_000
    batch: Annotated[int, "Transitions in a gradient step."] = 256
    tau: Annotated[float, "Weight of the newest value network in its averaged target."] = 0.005
    reward_scale: Annotated[float, "Factor on the reward, the inverse temperature."] = 2.0
    critic_scale: Annotated[float, "Unit of the critics' values; about the size of a return."] = 100.0
    warm_up: Annotated[int, "First steps, with uniform random actions and without gradient steps."] = 1000
    actor: Annotated[tuple[int, ...], "Hidden widths of the actor."]
    activation: Annotated[
        Activation,
        "Function between the actor's layers: tanh, relu, elu, sigmoid, silu, gelu, softplus, mish or softsign.",
    ] = "tanh"
    critic: Annotated[tuple[int, ...], "Hidden widths of the value and Q networks."]
    log_std: Annotated[
        tuple[float, ...], "Lower and upper bound of the log standard deviation; none means that it has no bounds."
    ] = (-5.0, 2.0)
    anneal: Annotated[float, "Last share of the run in which the actor's step falls linearly to zero."] = 0.2
    curvature_weight: Annotated[
        float, "Weight of the mean ||J_mu(x) - J_mu(0)|| / ||x|| in the ball in the actor's loss; 0 drops the term."
    ] = 0.0
    rest_weight: Annotated[
        float,
        "Weight of the hidden units' norms at the origin, summed over layers, in the actor's loss; 0 drops it. Of tanh "
        "units only.",
    ] = 0.0
    proof_weight: Annotated[
        float,
        "Weight of the departure on a box in the actor's loss; 0 drops the term.",
    ] = 0.0
    proof_box: Annotated[
        tuple[float, ...], "Half-widths of that box, one a state; none means the states in which episodes start."
    ] = ()
    corner_margin: Annotated[
        float, "Share of the domain, around the origin, in which no unit of relu, elu or softsign passes its corner."
    ] = 0.1
    # The stabilising part
    identification: Annotated[
        Identification,
        "Time of the identification: during the run, once before the warm-up, or never (plain SAC).",
    ] = "during"
    eta: Annotated[float, "Radius of the ball in which transitions identify A and B, in the states' units."]
    n_A: Annotated[int, "Transitions with zero action that fit A."]
    n_B: Annotated[int, "Transitions with actions that fit B given A."]
    refresh: Annotated[int, "Steps between two identifications during the run."]
    identification_starts: Annotated[
        IdentificationStarts,
        "Start of episodes while A or B is being learned: in the ball, which ends them when they leave it, or in the "
        "domain as always, so that only transitions in the ball count.",
    ] = "ball"
    transitions: Annotated[
        Transitions, "Transitions that fit A and B: those of all rounds so far, or of the latest round only."
    ] = "all"
    terms_A: Annotated[
        Terms, "Terms fitted to x+ for A: linear ones, or quadratic ones as well, of which nothing is kept."
    ] = "linear"
    gain_weight: Annotated[float, "Weight of ||J_mu(0) + K|| + ||mu(0) - u_eq|| in the actor's loss; 0 drops the term."]
    gain_norm: Annotated[
        GainNorm, "Norm of J_mu(0) + K: frobenius, or spectral, the largest singular value; one for a single input."
    ] = "frobenius"
    state_weights: Annotated[tuple[float, ...], "Diagonal of Q_c, the LQR's state weights."]
    input_weights: Annotated[tuple[float, ...], "Diagonal of R_c, the LQR's input weights."]
    centre: Annotated[Centre, "Centring of the mean action: preactivation, output, or none."] = "preactivation"

    def __post_init__(self) -> None:
        for name in ("steps", "threads", "dt", "horizon", "learning_rate", "replay", "batch", "reward_scale"):
            self._require(name, getattr(self, name) > 0, "positive")
        for name in ("critic_scale", "eta", "n_A", "n_B", "refresh"):
            self._require(name, getattr(self, name) > 0, "positive")
        for name in ("seed", "penalty", "gain_weight", "curvature_weight", "rest_weight", "proof_weight", "warm_up"):
            self._require(name, getattr(self, name) >= 0, "at least 0")
        self._require("seed", self.seed < 2**63, "below 2^63")
        for name in ("gamma", "anneal", "corner_margin"):
            self._require(name, 0 <= getattr(self, name) < 1, "in [0, 1)")
        for name in ("tau", "start"):
            self._require(name, 0 < getattr(self, name) <= 1, "in (0, 1]")
        for name in ("actor", "critic"):
            widths = getattr(self, name)
            self._require(name, bool(widths) and all(w > 0 for w in widths), "positive widths, at least one")
        for name in ("reward_weights", "state_weights"):
            self._require(name, all(w >= 0 for w in getattr(self, name)), "at least 0")
        for name in ("input_weights", "proof_box"):
            self._require(name, all(w > 0 for w in getattr(self, name)), "positive")
        rising = len(self.log_std) == 2 and self.log_std[0] < self.log_std[1]
        self._require("log_std", not self.log_std or rising, "two rising numbers, or none")
        choices_of = {
            "activation": Activation,
            "centre": Centre,
            "identification": Identification,
            "transitions": Transitions,
            "terms_A": Terms,
            "identification_starts": IdentificationStarts,
            "reward_at": RewardAt,
            "gain_norm": GainNorm,
        }
        for name, choices in ((name, get_args(literal)) for name, literal in choices_of.items()):
            self._require(name, getattr(self, name) in choices, f"one of {choices}")
        for option in fields(self):
            value = getattr(self, option.name)
            numbers = value if isinstance(value, tuple) else (value,)
            self._require(option.name, all(map(_finite, numbers)), "finite")

    def _require(self, name: str, holds: bool, requirement: str) -> None:
        if not holds:
            raise OptionError(f"`{name}` must be {requirement}; found {getattr(self, name)!r}.")

    def check(self, system: System) -> None:
        """Raise InputError unless there is one weight a state and one an input, one half-width of a box a state, and
        `dt` is a time over which this plant's inputs are held."""
        sizes = {"reward_weights": system.n, "state_weights": system.n, "input_weights": system.m}
        if self.proof_box:
            sizes["proof_box"] = system.n
        for name, size in sizes.items():
            self._require(name, len(getattr(self, name)) == size, f"{size} numbers for {system.name}")
        require_one_step(system, self.dt)
        if system.sample is not None:
            lo, hi = map(float, system.sample)
            held = f"the time {hi:g}" if lo == hi else f"between {lo:g} and {hi:g}"
            self._require("dt", lo <= self.dt <= hi, f"{held}, over which {system.name} holds its inputs")

    def record(self) -> dict[str, Any]:
        """The options as plain values, for the policy file and for checkpoints; those of a tanh run look as ever."""
        values = _plain({option.name: getattr(self, option.name) for option in fields(self)})
        left_out = _LATER if self.activation == "tanh" else {}
        return {name: value for name, value in values.items() if (name, value) not in left_out.items()}

    def full_record(self) -> dict[str, Any]:
        """All options as plain values, to compare with `default_record()` and what a record has beyond it."""
        return {**default_record(), **self.record()}


_LATER = {"activation": "tanh", "corner_margin": 0.1}
"""Defaults of options that came later, which the record of a tanh run leaves out."""

_FORMER = {"transitions": "latest"}
"""Values that runs had before an option was there, where they are not its default."""


def default_record() -> dict[str, Any]:
    """The options with a default as a record without them means them, in the form of `TrainingOptions.record`.

    It is the default, except where runs did something else before the option was there.
    """
    defaults = {option.name: option.default for option in fields(TrainingOptions) if option.default is not MISSING}
    return _plain(defaults) | _FORMER


def _plain(values: Mapping[str, Any]) -> dict[str, Any]:
    return {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}


def _finite(value: object) -> bool:
    return not isinstance(value, float) or math.isfinite(value)


@dataclass(frozen=True, slots=True, kw_only=True)
class Plant:
    """The training of one plant, the runs that judge it, and the states that are drawn.

    Parameters
    ----------
    preset : the options that it trains with unless told otherwise.
    initial_states : n half-widths, in the states' units, of the box from which simulations start, uniformly.
    positions : names of the states whose trajectories are drawn, from the top of the figure to its bottom.
    paper : those that follow the paper where it is definite; None for a plant that the paper does not have.

    Raises
    ------
    InputError : a half-width is not positive and finite, or there is no position.
    """

    preset: TrainingOptions
    initial_states: tuple[float, ...]
    positions: tuple[str, ...]
    paper: TrainingOptions | None = None

    def __post_init__(self) -> None:
        if not self.initial_states or not all(0 < width < math.inf for width in self.initial_states):
            raise InputError(f"`initial_states` must be positive and finite; found {self.initial_states}.")
        if not self.positions:
            raise InputError("`positions` must name at least one state.")

    def check(self, system: System) -> None:
        """Raise InputError unless weights, box and positions are those of a plant with the states of `system`."""
        for options in filter(None, (self.preset, self.paper)):
            options.check(system)
        if len(self.initial_states) != system.n:
            raise InputError(
                f"`initial_states` of {system.name} must have {system.n} half-widths; found {len(self.initial_states)}."
            )
        names = [symbol.name for symbol in system.states]
        unknown = [name for name in self.positions if name not in names]
        if unknown:
            raise InputError(f"`positions` of {system.name} must be among its states {names}; found {unknown[0]!r}.")

    def named(self, name: str) -> TrainingOptions:
        """The preset of that name, `ours` or `paper`.

        Raises
        ------
        InputError : there is none.
        """
        if name not in get_args(PresetName):
            raise OptionError(f"`preset` must be one of {', '.join(get_args(PresetName))}; found {name!r}.")
        if name == "ours":
            return self.preset
        if self.paper is None:
            raise InputError("this plant has no preset `paper`, since the paper does not have the plant; use `ours`.")
        return self.paper


def require_one_step(system: System, dt: float) -> None:
    """Refuse a time step of a plant in discrete time that is not the plant's own.

    Raises
    ------
    InputError : the plant is in discrete time, and `dt` is not 1.
    """
    if system.time == "discrete" and dt != 1:
        raise OptionError(
            f"`dt` must be 1 for {system.name}, a plant in discrete time, whose equations give the state one step "
            f"later; found {dt}. Leave `dt` out."
        )


def held_over(system: System, dt: float) -> float:
    """The time nearest to `dt` over which this plant holds its inputs: 1 in discrete time, where it is a step; `dt`
    itself for a plant that does not say."""
    if system.time == "discrete":
        return 1.0
    return dt if system.sample is None else min(max(dt, float(system.sample[0])), float(system.sample[1]))


def available_plants() -> tuple[str, ...]:
    """Names that `get_plant` knows, in alphabetical order; none of them is imported."""
    names = (module.name for module in pkgutil.iter_modules(shipped.__path__))
    return tuple(sorted(name for name in names if not name.startswith("_")))


def get_plant(name: str) -> Plant:
    """The plant `name` of the folder `plants/shipped`.

    Raises
    ------
    InputError : no such plant, or its file does not define what it must.
    """
    known = available_plants()
    if name not in known:
        raise InputError(
            f"no training options, box of initial states and positions are known for the plant {name!r}; "
            f"known are {', '.join(known)}. A plant of your own is a file: give FILE.toml, or FILE.py:NAME."
        )
    module = importlib.import_module(f"{shipped.__name__}.{name}")
    plant = getattr(module, "PLANT", None)
    if not isinstance(plant, Plant):
        raise InputError(f"{module.__file__} must define `PLANT`, a Plant; found {type(plant).__name__}.")
    return plant


def overridden(options: TrainingOptions, chosen: Mapping[str, Any]) -> TrainingOptions:
    """The options with those replaced that were chosen; None means not chosen."""
    return replace(options, **{name: value for name, value in chosen.items() if value is not None})


def preset(name: str) -> TrainingOptions:
    """The options that the plant `name` trains with unless told otherwise; raises as `get_plant` does."""
    return get_plant(name).preset
