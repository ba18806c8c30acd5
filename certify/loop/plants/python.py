"""A user's plant in Python: `my_plant.py:plant`; and anything else that somebody names in this way.

Reading it runs its code. So this module is never called for a name in a file, only for a name that a person typed
on the command line (`registry.chosen_system`).
"""

from __future__ import annotations

import importlib.util
import sys
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

from certify.errors import CertifyError, InputError
from certify.loop.plants.equations import nearest
from certify.loop.plants.operating_point import require_equilibrium
from certify.loop.plants.system import System


def load_python_system(path: Path, name: str) -> System:
    """Load the plant `name` of a Python file: a System, or a function without arguments that returns one.

    Raises
    ------
    InputError : the file cannot be run, has no such name, or the name is no plant; an x_eq that is no equilibrium.
    """
    made: System = load_python(path, name, System, "a System")
    if any(made.exact_x_eq()):
        require_equilibrium(made, lambda message: InputError(f"`{name}` in {path}: {message}"))
    return made


def load_python(path: Path, name: str, kind: type, what: str) -> Any:
    """Run a Python file and return its `name`, of this kind, or the result of that without arguments.

    Parameters
    ----------
    what : the kind in words, with an article.

    Raises
    ------
    InputError : the file cannot be run, has no such name, or it is nothing of this kind.
    """
    if not path.is_file():
        raise InputError(f"system file {path} cannot be read: there is no such file.")
    spec = importlib.util.spec_from_file_location("certify_plant_of_ones_own", path)
    if spec is None or spec.loader is None:
        raise InputError(f"system file {path} must be a Python file, with the ending .py.")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    writes, sys.dont_write_bytecode = sys.dont_write_bytecode, True  # somebody's folder stays as it is
    try:
        with redirect_stdout(sys.stderr):  # standard output is for results
            spec.loader.exec_module(module)
            found = getattr(module, name, None)
            made = found() if callable(found) and not isinstance(found, kind) else found
    except CertifyError as error:
        raise InputError(f"{path}: {error}") from error
    except (Exception, SystemExit) as error:  # another's code may raise anything, and its exit status is no verdict
        line = _line(error, path)
        raise InputError(f"{path}{line}: running it raises {type(error).__name__}: {error}.") from error
    finally:
        sys.dont_write_bytecode = writes
        sys.modules.pop(spec.name, None)
    if found is None:
        public = [key for key in vars(module) if not key.startswith("_")]
        close = nearest(name, public) or f"; give {what}, or a function without arguments that returns one."
        raise InputError(f"{path} has no {name!r}{close}")
    if not isinstance(made, kind):
        raise InputError(
            f"`{name}` in {path} must be {what} or a function without arguments that returns one; "
            f"it gives {type(made).__name__}."
        )
    return made


def _line(error: BaseException, path: Path) -> str:
    """`, line N` of the file where the error arose, if it arose in the file."""
    if isinstance(error, SyntaxError):
        return f", line {error.lineno}" if error.lineno else ""
    traceback, line = error.__traceback__, None
    while traceback is not None:
        if Path(traceback.tb_frame.f_code.co_filename) == path.resolve() or (
            traceback.tb_frame.f_code.co_filename == str(path)
        ):
            line = traceback.tb_lineno
        traceback = traceback.tb_next
    return "" if line is None else f", line {line}"
