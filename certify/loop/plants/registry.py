"""The shipped plants, by name; a path to a `.toml` file names a user's plant.

There are three functions, by who names the plant. `shipped_system` takes names only and is for names in a file, such as
a policy's: a file must not make anybody read another. `get_system` reads a TOML file too, which executes nothing.
`chosen_system` is for names typed on the command line, and only it runs a plant's Python file.

There is no list of plants: a plant is a file of the folder `shipped`. Listing them imports none of them, so that a
faulty plant does not block the others.
"""

from __future__ import annotations

import importlib
import pkgutil
from pathlib import Path

from certify.errors import InputError
from certify.loop.plants import shipped as plants
from certify.loop.plants.equations import nearest
from certify.loop.plants.python import load_python_system
from certify.loop.plants.system import System
from certify.loop.plants.toml import load_system


def available_systems() -> tuple[str, ...]:
    """Names that `get_system` knows, in alphabetical order."""
    names = (module.name for module in pkgutil.iter_modules(plants.__path__))
    return tuple(sorted(name for name in names if not name.startswith("_")))


def get_system(name: str) -> System:
    """The plant `name` of the folder `shipped`, or the plant described by the TOML file at that path.

    Raises
    ------
    InputError : no such plant or file, or the plant's file does not define what it must.
    """
    if name not in available_systems() and name.endswith(".toml"):
        return load_system(Path(name))
    return shipped_system(name)


def shipped_system(name: str) -> System:
    """The plant `name` of the folder `shipped`, and of no other place.

    Raises
    ------
    InputError : no such plant, or its file does not define what it must.
    """
    known = available_systems()
    if name in known:
        return _build(name)
    close = nearest(name, known).replace("?", ",") or "; known are " + ", ".join(known) + ","
    raise InputError(f"unknown system {name!r}{close} or name the file of a plant of your own with --system FILE.toml.")


def chosen_system(name: str) -> System:
    """The plant that a person chose by typing `name`: as `get_system`, or `FILE.py:NAME`, whose code is run.

    Raises
    ------
    InputError : as `get_system`, or the Python file has no such plant.
    """
    file, colon, attribute = name.rpartition(":")
    if colon and file.endswith(".py"):
        return load_python_system(Path(file), attribute)
    if name.endswith(".py"):
        raise InputError(f"{name} must be followed by the name of the plant in it, as in {name}:plant.")
    return get_system(name)


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
