"""The plants that ship, by name; a path to a `.toml` file names a plant of one's own."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from certify.errors import InputError
from certify.systems.cartpole import cartpole
from certify.systems.pendulum import pendulum
from certify.systems.quadrotor2d import quadrotor2d
from certify.systems.quadrotor3d import quadrotor3d
from certify.systems.system import System
from certify.systems.toml import load_system

_REGISTRY: dict[str, Callable[[], System]] = {
    "pendulum": pendulum,
    "cartpole": cartpole,
    "quadrotor2d": quadrotor2d,
    "quadrotor3d": quadrotor3d,
}


def available_systems() -> tuple[str, ...]:
    """Names that `get_system` knows."""
    return tuple(_REGISTRY)


def get_system(name: str) -> System:
    """The registered plant `name`, or the plant described by the TOML file at that path.

    Raises
    ------
    InputError : no such plant or file.
    """
    if name in _REGISTRY:
        return _REGISTRY[name]()
    if name.endswith(".toml"):
        return load_system(Path(name))
    raise InputError(f"unknown system {name!r}; known are {', '.join(_REGISTRY)}, or give the path of a .toml file.")
