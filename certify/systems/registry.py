"""The plants that ship, by name; a path to a `.toml` file names a plant of one's own.

There is no list of plants: a plant is a file of the folder `plants`. Listing them imports none of them, so that a
plant with a fault keeps nobody from using the others.
"""

from __future__ import annotations

import importlib
import pkgutil
from pathlib import Path

from certify.errors import InputError
from certify.systems import plants
from certify.systems.system import System
from certify.systems.toml import load_system


def available_systems() -> tuple[str, ...]:
    """Names that `get_system` knows, in alphabetical order."""
    names = (module.name for module in pkgutil.iter_modules(plants.__path__))
    return tuple(sorted(name for name in names if not name.startswith("_")))


def get_system(name: str) -> System:
    """The plant `name` of the folder `plants`, or the plant described by the TOML file at that path.

    Raises
    ------
    InputError : no such plant or file, or the plant's file does not define what it must.
    """
    known = available_systems()
    if name in known:
        return _build(name)
    if name.endswith(".toml"):
        return load_system(Path(name))
    raise InputError(f"unknown system {name!r}; known are {', '.join(known)}, or give the path of a .toml file.")


def _build(name: str) -> System:
    module = importlib.import_module(f"{plants.__name__}.{name}")
    make = getattr(module, name, None)
    if not callable(make):
        raise InputError(f"{module.__file__} must define a function `{name}()` that returns its plant; it has none.")
    system = make()
    if not isinstance(system, System):
        raise InputError(f"`{name}()` in {module.__file__} must return a System; it returns {type(system).__name__}.")
    if system.name != name:
        raise InputError(f"the plant in {module.__file__} must have the name {name!r}; it is called {system.name!r}.")
    return system
