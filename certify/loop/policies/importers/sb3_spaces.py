"""The spaces of a stable-baselines3 file: boxes of observations, and boxes or discrete sets of actions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from certify.errors import InputError
from certify.loop.files.arrays import Numbers, array_of
from certify.loop.files.pickles import Call, Name, brief

_MOST_ACTIONS = 4096
_GYMS = ("gym.spaces.", "gymnasium.spaces.")


@dataclass(frozen=True, slots=True)
class Spaces:
    """The spaces of a policy.

    Parameters
    ----------
    observations : how many numbers it reads.
    joined : for people, the names of its arrays of observations where they are joined.
    bounds : low and high of its actions, (2, m); None where actions are discrete.
    actions : how many bounds there are, or how many actions.
    """

    observations: int
    joined: str
    bounds: Numbers | None
    actions: int


def spaces_of(observation: Any, action: Any, joined: bool, what: str) -> Spaces:
    """The spaces of a file, of which `joined` says that the observation is a dictionary of arrays.

    Raises
    ------
    InputError : a space is neither a box of one axis nor, of actions, a discrete set.
    """
    boxes = _parts(observation, what) if joined else {"": observation}
    sizes = {name: _box(box, f"observation_space {name}".rstrip() + f" of {what}") for name, box in boxes.items()}
    shapes = [low.shape for low, _ in sizes.values()]
    if not _is(action, "Discrete") and not _is(action, "Box"):
        raise InputError(f"action_space of {what} must be a box or Discrete; found {brief(action)}.")
    bounds = None if _is(action, "Discrete") else _box(action, f"action_space of {what}")
    flat = bounds is None or (bounds[0].ndim == 1 and bounds[0].shape == bounds[1].shape)
    if any(len(shape) != 1 for shape in shapes) or not flat:
        raise InputError(f"the spaces of {what} must be boxes of one axis; found {shapes[0]}.")
    named = ", ".join(f"{name} ({low.size})" for name, (low, _) in sizes.items())
    count = _count(action, f"action_space of {what}") if bounds is None else bounds[0].size
    words = f" of {named}" if joined else ""
    return Spaces(sum(shape[0] for shape in shapes), words, None if bounds is None else np.stack(bounds), count)


def _is(space: Any, name: str) -> bool:
    """True if it is a space of this name."""
    return isinstance(space, Call) and isinstance(space.function, Name) and space.function.name == name


def _state(space: Call) -> Mapping[str, Any]:
    """The attributes of a space."""
    return space.states[0] if len(space.states) == 1 and isinstance(space.states[0], dict) else {}


def _count(space: Call, what: str) -> int:
    """The number of a discrete set's actions, which begin with 0."""
    if not str(space.function).startswith(_GYMS):
        raise InputError(f"{what} must be a box or Discrete of gymnasium; found {brief(space)}.")
    n, start = (_whole(_state(space).get(*key), f"{key[0]} of {what}") for key in (("n",), ("start", 0)))
    if not 1 < n <= _MOST_ACTIONS or start:
        raise InputError(
            f"{what} must have 2 to {_MOST_ACTIONS} actions, the first of which is 0; it has {n} from {start} on."
        )
    return n


def _whole(node: Any, what: str) -> int:
    """A whole number of a pickle that was read as data."""
    if type(node) is int:
        return node
    number = array_of(node, what)
    if number.shape or number.dtype.kind not in "iu":
        raise InputError(f"{what} must be a whole number; found {brief(node)}.")
    return int(number)


def _parts(space: Any, what: str) -> dict[str, Any]:
    """The spaces of a dictionary by their names; of another order versions of torch make different ones."""
    found = _state(space).get("spaces") if _is(space, "Dict") else None
    if not isinstance(found, dict) or not found or not all(isinstance(name, str) for name in found):
        raise InputError(f"observation_space of {what} must be a dictionary of boxes; found {brief(space)}.")
    if list(found) != sorted(found):
        raise InputError(f"the observations of {what} must be in the order of their names; found {', '.join(found)}.")
    return found


def _box(space: Any, what: str) -> tuple[Numbers, Numbers]:
    """The bounds of a box, low and high."""
    if not _is(space, "Box"):
        raise InputError(f"{what} must be a box; found {brief(space)}.")
    low, high = (array_of(_state(space).get(name), f"{name} of {what}") for name in ("low", "high"))
    if any(a.dtype.kind != "f" or a.dtype.itemsize < 4 for a in (low, high)):
        raise InputError(f"{what} must be of single or double precision; found {low.dtype}.")
    return low, high
