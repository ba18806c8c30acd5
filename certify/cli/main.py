"""The command line `certify`: its commands and exit statuses; one file per command in `certify.cli`.

Standard output carries the result, or with `--json` exactly one JSON object; progress and diagnostics go to
standard error. Exit status: 0 proved or accepted, 1 refuted or rejected, 2 usage or unusable input, 3 unknown
or trusted, 4 one part of a certificate checked, 70 internal error; 130 after Ctrl-C or SIGTERM, 141 after a
closed pipe.
"""

from __future__ import annotations

import atexit
import gc
import json
import os
import sys
from collections.abc import Iterable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn

from certify.cli.checked import checked
from certify.cli.ending import INTERRUPTED, Interrupted, closed_pipe, end_by_sigterm, is_of_closed_pipe
from certify.cli.terminal import say, tell
from certify.errors import BackendError, CertifyError, OptionError, SoundnessError

_COMMANDS: dict[str, bool] = {
    "roa": True,
    "reach": True,
    "identify": True,
    "fit": True,
    "compose": True,
    "sweep": False,
    "check": False,
    "contains": False,
    "report": False,
    "plot": False,
    "import": True,
    "learn-lyapunov": True,
    "plant": True,
    "systems": False,
    "export-smt2": True,
    "prove-in-coq": False,
    "float-error": True,
    "doctor": False,
}
"""The commands in the order of the help, each in a file of its name; those whose help has panels are grouped."""

_STOPPED = "interrupted; nothing was left half-written."


def command_line(names: Iterable[str] = _COMMANDS) -> Any:
    """The program with all its commands, or with these: only their files are loaded."""
    import typer

    from certify.cli.options import Grouped
    from certify.cli.version import certify

    app = typer.Typer(
        no_args_is_help=True,
        rich_markup_mode=None,
        pretty_exceptions_enable=False,
        context_settings={"max_content_width": 100},
    )
    app.callback()(certify)
    for name in names:
        function = "import_" if name == "import" else name.replace("-", "_")
        app.command(name, cls=Grouped if _COMMANDS[name] else None)(
            getattr(import_module(f"certify.cli.{function}"), function)
        )
    return typer.main.get_command(app)


def main(arguments: list[str] | None = None) -> None:
    """Entry point: turn every error into one sentence and the right exit status."""
    gc.set_threshold(500_000)  # most objects of a run are modules, which live to its end
    # Waiting threads must not spin: on a busy machine spinning costs a factor of ten. OpenBLAS has no such setting, and
    # the checker's matrices are small; the engine shares out boxes among threads of its own.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    end_by_sigterm()
    given = sys.argv[1:] if arguments is None else arguments
    status = _run(given, "--json" in given)
    if arguments is None and sys.getprofile() is None and sys.gettrace() is None:
        _leave(status)
    sys.exit(status)


def _leave(status: int) -> NoReturn:
    """End the process without tearing down its thousands of modules one by one: that takes a tenth of a second, and
    the memory goes back with the process."""
    atexit._run_exitfuncs()
    try:
        sys.stdout.flush()
        sys.stderr.flush()
    except BrokenPipeError:
        status = closed_pipe()
    os._exit(status)


def _run(arguments: list[str], as_json: bool) -> int:
    try:
        return _ended(arguments, as_json)
    except _typer().Exit as stop:  # a message met a closed pipe
        return int(stop.exit_code)
    except BrokenPipeError:
        return closed_pipe()
    except SystemExit as stop:
        if not is_of_closed_pipe(stop):
            raise
        return closed_pipe()


def _ended(arguments: list[str], as_json: bool) -> int:
    """Run a command and return its exit status, however it ends."""
    plain = len(arguments) == 2 and arguments[0] == "check" and not arguments[1].startswith("-")
    # To load what reads options takes longer than to check a small certificate.
    command = None if plain else command_line([name for name in arguments[:1] if name in _COMMANDS] or _COMMANDS)
    try:
        if command is None:
            return checked(Path(arguments[1]))
        status = command.main(arguments, prog_name="certify", standalone_mode=False)
        if status == INTERRUPTED:  # typer's answer to Ctrl-C
            return _fail(as_json, _STOPPED, INTERRUPTED)
        return status if isinstance(status, int) else 0
    except _typer().Exit as stop:
        return int(stop.exit_code)
    except _typer().TyperException as error:  # usage
        return _fail(as_json, error.format_message() if hasattr(error, "format_message") else str(error), 2)
    except Interrupted as stop:
        return _fail(as_json, str(stop), INTERRUPTED)
    except (_typer().Abort, KeyboardInterrupt):
        return _fail(as_json, _STOPPED, INTERRUPTED)
    except SoundnessError as error:
        return _fail(as_json, f"internal error: {error}", 70)
    except BackendError as error:  # from another program: a checker, a solver, a scheduler
        return _fail(as_json, str(error), 70)
    except OptionError as error:
        commands: Mapping[str, Any] = getattr(command, "commands", {})
        from certify.cli.options import as_typed, options_of

        called = next((commands[name] for name in arguments if name in commands), command)
        return _fail(as_json, as_typed(str(error), options_of(called)), 2)
    except CertifyError as error:
        return _fail(as_json, str(error), 2)
    except BrokenPipeError:
        return closed_pipe()
    except Exception as error:  # the last resort: no traceback reaches a user
        return _fail(as_json, f"internal error: {type(error).__name__}: {error}", 70)


def _typer() -> Any:
    """The library that reads options, loaded at the first use."""
    return import_module("typer")


def _fail(as_json: bool, message: str, status: int) -> int:
    if as_json:
        say(json.dumps({"error": message}))
    else:
        tell(f"certify: {message}")
    return status
