"""Transitions of an environment of Gymnasium as a CSV file: a black box is identified from files, as others are."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.analysis.tables import NEXT
from certify.certificates import write_atomically
from certify.errors import InputError
from certify.loop.plants import System
from certify.loop.plants.python import load_python

Array = NDArray[np.float64]
_ANGLES = "cos", "sin"


@dataclass(frozen=True, slots=True)
class Black:
    """An environment to be recorded.

    Parameters
    ----------
    name : its id in Gymnasium, or FILE.py:NAME, whose code is run.
    episodes : how many.
    policy : a policy file whose inputs are the actions; None for random ones.
    observed : the observation's entries, states or cos and sin of one, separated by commas; None for the states.
    seed : of episodes and actions.
    """

    name: str
    episodes: int
    policy: Path | None = None
    observed: str | None = None
    seed: int = 0


def record(black: Black, system: System, path: Path) -> None:
    """Run the environment, and write its transitions: rows of states, inputs and next states.

    Raises
    ------
    InputError : Gymnasium is missing, has no such environment, or this shows other numbers than the plant's states.
    """
    env = opened(black.name)
    import gymnasium

    if not isinstance(env.action_space, gymnasium.spaces.Box) or env.action_space.shape != (system.m,):
        raise InputError(
            f"actions of {black.name} must be {system.m} numbers, the inputs of {system.name}; they are "
            f"{env.action_space}."
        )
    names = [s.name for s in system.states]
    read, act = reader(black, names), _actor(black, env, system)
    write_transitions(path, names, [u.name for u in system.inputs], _rows(black, env, read, act))
    env.close()


def opened(name: str) -> Any:
    """The environment of this id, or of a class or function FILE.py:NAME, whose code is run.

    Raises
    ------
    InputError : Gymnasium is missing, or there is no such environment.
    """
    try:
        import gymnasium
    except ImportError as error:
        raise InputError("an environment needs gymnasium: pip install gymnasium; or give a file of data.") from error
    file, _, attribute = name.rpartition(":")
    if file.endswith(".py"):
        return load_python(Path(file), attribute, gymnasium.Env, "an environment of Gymnasium")
    try:
        return gymnasium.make(name)
    except (gymnasium.error.Error, ImportError) as error:
        raise InputError(f"gymnasium has no environment {name!r}: {str(error).rstrip('.')}.") from error


def write_transitions(
    path: Path, states: Sequence[str], inputs: Sequence[str], rows: Iterable[Sequence[float]]
) -> None:
    """Write a CSV file of single transitions: rows of states, inputs and next states."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([*states, *inputs, *(f"{s}{NEXT}" for s in states)])
    writer.writerows([repr(float(v)) for v in row] for row in rows)
    write_atomically(path, stream.getvalue().encode())


def _rows(
    black: Black, env: Any, read: Callable[[Any], Array], act: Callable[[Array], NDArray[Any]]
) -> Iterator[list[float]]:
    for episode in range(black.episodes):
        shown, _ = env.reset(seed=black.seed + episode)
        over = False
        while not over:
            x = read(shown)
            u = act(x)
            shown, _, terminated, truncated, _ = env.step(u)
            over = bool(terminated or truncated)
            yield [*x.tolist(), *np.asarray(u, dtype=np.float64).tolist(), *read(shown).tolist()]


def _actor(black: Black, env: Any, system: System) -> Callable[[Array], NDArray[Any]]:
    """The actions: numbers in the environment's own type, within its bounds, which are the ones that are recorded."""
    space = env.action_space
    if black.policy is None:
        space.seed(black.seed)
        return lambda _: np.asarray(space.sample())
    from certify.loop.closed_loop import ClosedLoop
    from certify.loop.policies import load_policy

    loop = ClosedLoop(system, load_policy(black.policy).network)
    at = np.array([float(q) for q in system.exact_x_eq()])
    return lambda x: np.clip(np.asarray(loop.policy(x - at), dtype=space.dtype), space.low, space.high)


def states_of(observed: str) -> dict[str, bool]:
    """The states that an observation shows, in its order, and of each if it is an angle, by its cos and sin.

    >>> states_of("cos(theta), sin(theta), theta_dot")
    {'theta': True, 'theta_dot': False}
    """
    entries = [part.strip() for part in observed.split(",")]
    angles = [re.fullmatch(rf"(?:{'|'.join(_ANGLES)})\((.*)\)", entry) for entry in entries]
    return {(found[1] if found else entry): bool(found) for entry, found in zip(entries, angles, strict=True)}


def reader(black: Black, names: Sequence[str]) -> Callable[[Any], Array]:
    """The states of these names from an observation.

    Raises
    ------
    InputError : it does not have every state once, or an angle without its cos or sin.
    """
    entries = list(names) if black.observed is None else [part.strip() for part in black.observed.split(",")]
    places = [_place(name, entries) for name in names]
    used = sorted(k for place in places for k in place)
    if used != list(range(len(entries))):
        raise InputError(
            f"`observed` must name each of {', '.join(names)} once, an angle as cos(NAME),sin(NAME); found "
            f"{', '.join(entries)}."
        )

    def read(shown: Any) -> Array:
        values = np.asarray(shown, dtype=np.float64).ravel()
        if len(values) != len(entries):
            raise InputError(
                f"observations of {black.name} must be the {len(entries)} numbers {', '.join(entries)}; there are "
                f"{len(values)}. Say what they are with --observed."
            )
        return np.array([_value(values, place) for place in places])

    return read


def _place(name: str, entries: Sequence[str]) -> tuple[int, ...]:
    """The places of a state among the entries: one, those of its cosine and sine, or none."""
    if name in entries:
        return (entries.index(name),)
    both = [f"{function}({name})" for function in _ANGLES]
    return tuple(entries.index(each) for each in both) if all(each in entries for each in both) else ()


def _value(values: Array, place: tuple[int, ...]) -> float:
    if len(place) == 1:
        return float(values[place[0]])
    cosine, sine = (float(values[k]) for k in place)
    return math.atan2(sine, cosine)
