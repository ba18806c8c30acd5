"""An environment of Gymnasium as a plant without equations: names, operating point, bounds, and how it is trained."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.analysis.identifying.environments import Black, opened, reader, states_of
from certify.errors import InputError, OptionError
from certify.loop.expressions import Number, Symbol
from certify.loop.plants import System
from controllers.options import Plant
from controllers.plants.defaults import default_plant

Array = NDArray[np.float64]
_HALF_TURN = Fraction(314, 100)
_STILL = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class Told:
    """The things that equations would say of a plant, and an environment does not.

    Parameters
    ----------
    name : the environment's id in Gymnasium, or FILE.py:NAME.
    observed : the observation's entries, as of `Black`; None for states x1 to xn.
    inputs : names, separated by commas; None for u, or u1 to um.
    domain : half-widths around the operating point by state; by default as far as the observation's bounds.
    rest, rest_input : the operating point x_eq and u_eq by name; 0 where nothing is said.
    dt : seconds of a step; None for the environment's attribute `dt`.
    """

    name: str
    observed: str | None = None
    inputs: str | None = None
    domain: Mapping[str, Fraction]
    rest: Mapping[str, Fraction]
    rest_input: Mapping[str, Fraction]
    dt: float | None = None


@dataclass(frozen=True, slots=True)
class BlackBox:
    """An environment, and the plant as a learner is told of it.

    Parameters
    ----------
    env : the environment of Gymnasium.
    read : the states' own values (n,) from an observation.
    system : names, bounds and operating point; each derivative is a disturbance, of which nothing is known.
    plant : the training.
    angles : True for each state that is shown by its cos and sin, (n,).
    settable : True if `env.unwrapped.state` may be set.
    """

    env: Any
    read: Callable[[Any], Array]
    system: System
    plant: Plant
    angles: NDArray[np.bool_]
    settable: bool


def black_box(told: Told) -> BlackBox:
    """Open an environment for training.

    Raises
    ------
    InputError : it does not exist, its actions are not numbers with finite bounds, its observation is not as it was
        said, a step has no time, a state no bounds, an option names nothing of it, or a step from the operating point
        leads away, where the state can be set to find out.
    """
    env = opened(told.name)
    import gymnasium

    space = env.action_space
    if not isinstance(space, gymnasium.spaces.Box) or len(space.shape) != 1 or not np.isfinite(space.low).all():
        raise InputError(f"actions of {told.name} must be a row of numbers with finite bounds; they are {space}.")
    if not isinstance(env.observation_space, gymnasium.spaces.Box):
        raise InputError(f"observations of {told.name} must be a row of numbers; they are {env.observation_space}.")
    count = int(np.prod(env.observation_space.shape))
    observed = told.observed or ",".join(f"x{k + 1}" for k in range(count))
    states, m = states_of(observed), space.shape[0]
    named = None if told.inputs is None else [part.strip() for part in told.inputs.split(",")]
    inputs = named or (["u"] if m == 1 else [f"u{k + 1}" for k in range(m)])
    if len(inputs) != m:
        raise OptionError(f"`inputs` must name the {m} actions of {told.name}; found {', '.join(inputs)}.")
    for option, names, known in (
        ("domain", told.domain, states),
        ("rest", told.rest, states),
        ("rest_input", told.rest_input, inputs),
    ):
        odd = next((name for name in names if name not in known), None)
        if odd is not None:
            raise OptionError(f"`{option}` names {odd!r}; {told.name} has {', '.join(known)}.")
    read = reader(Black(told.name, 1, observed=observed), list(states))
    read(env.reset(seed=0)[0])  # refuses an observation of another length
    system = _system(told, env, states, inputs, [part.strip() for part in observed.split(",")])
    settable = _settable(env, read, np.array([states[s] for s in states]))
    plant = default_plant(system, _step_of(told, env))
    starts = plant.preset if settable else replace(plant.preset, identification_starts="domain")
    box = BlackBox(env, read, system, replace(plant, preset=starts), np.array(list(states.values())), settable)
    if settable:
        _require_rest(box)
    return box


def _system(told: Told, env: Any, states: Mapping[str, bool], inputs: list[str], entries: list[str]) -> System:
    space, seen = env.action_space, env.observation_space
    rest = [told.rest.get(s, Fraction(0)) for s in states]
    domain = []
    for name, at in zip(states, rest, strict=True):
        half: Fraction | None = told.domain.get(name, _HALF_TURN if states[name] else None)
        if half is None:
            k = entries.index(name)
            low, high = float(seen.low.ravel()[k]), float(seen.high.ravel()[k])
            if not (abs(low) < 1e9 and abs(high) < 1e9):  # of some environments 3.4e38 stands for infinity
                raise OptionError(f"`domain` must have a half-width of {name}, as in {name}=1: it is unbounded.")
            half = min(Fraction(high) - at, at - Fraction(low))
            if not half > 0:
                raise OptionError(f"`rest` must lie inside what {told.name} shows; found {name}={float(at):g}.")
        domain.append((-half, half))
    unknown = tuple(Symbol(f"unknown_{s}") for s in states)
    return System(
        name=re.sub(r"\W", "_", told.name.rpartition("/")[2]),
        states=tuple(map(Symbol, states)),
        inputs=tuple(map(Symbol, inputs)),
        parameters={},
        dynamics=unknown,
        disturbances=unknown,
        u_eq=tuple(Number(told.rest_input.get(u, Fraction(0))) for u in inputs),
        x_eq=tuple(map(Number, rest)),
        domain=tuple(domain),
        input_bounds=tuple(
            (Fraction(float(lo)), Fraction(float(hi))) for lo, hi in zip(space.low, space.high, strict=True)
        ),
    )


def _step_of(told: Told, env: Any) -> float:
    dt = told.dt if told.dt is not None else getattr(env.unwrapped, "dt", None)
    if isinstance(dt, int | float) and dt > 0:
        return float(dt)
    raise OptionError(f"`dt` must be given, in seconds: {told.name} has no attribute dt.")


def _settable(env: Any, read: Callable[[Any], Array], angles: NDArray[np.bool_]) -> bool:
    """True if `env.unwrapped.state` is all of the state: the observed one, and a step from where it is set is the same
    again, and another from elsewhere."""
    env.action_space.seed(0)
    u = env.action_space.sample()
    try:
        shown = read(env.reset(seed=0)[0])
        x = np.array(env.unwrapped.state, dtype=np.float64)
        if x.shape != shown.shape or not np.allclose(turned(x - shown, angles), 0, atol=1e-5, rtol=1e-6):
            return False
        ends = [read(env.step(u)[0])]
        for start in (x, x + 0.01):
            env.reset(seed=1)
            env.unwrapped.state = start
            ends.append(read(env.step(u)[0]))
    except (AttributeError, TypeError, ValueError):
        return False
    return bool(np.array_equal(ends[0], ends[1]) and not np.array_equal(ends[0], ends[2]))


def _require_rest(box: BlackBox) -> None:
    """Refuse an operating point from which a step moves a state by more than a thousandth of its domain."""
    system, env = box.system, box.env
    x, u = (np.array([float(q) for q in point]) for point in (system.exact_x_eq(), system.exact_u_eq()))
    env.reset(seed=0)
    env.unwrapped.state = x
    moved = turned(box.read(env.step(u.astype(env.action_space.dtype))[0]) - x, box.angles)
    for s, by, (_, half) in zip(system.states, moved.tolist(), system.domain, strict=True):
        if abs(by) > _STILL * float(half):
            raise OptionError(
                "`rest` and `rest_input` must say where the environment rests; a step from there moves "
                f"{s} by {by:.3g}."
            )


def turned(difference: Array, angles: NDArray[np.bool_]) -> Array:
    """Differences of states, of angles without their full turns."""
    return np.asarray(difference - np.where(angles, 2 * np.pi * np.round(difference / (2 * np.pi)), 0.0))
