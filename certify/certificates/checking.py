"""Run the two checkers of this package as isolated child processes, on a file by its path.

`python -m certify.checker` would run the installed package; this module names the folder. Each program runs
under `-I`, so that neither the current folder nor the environment supplies a module.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any, Literal

from certify.errors import BackendError

Program = Literal["checker", "reference"]
_STATUS = {"ACCEPTED": 0, "REJECTED": 1, "TRUSTED": 3}
_LAUNCH = """
import importlib, importlib.util, sys
name, folder = sys.argv[1:3]
spec = importlib.util.spec_from_file_location(name, folder + "/__init__.py", submodule_search_locations=[folder])
sys.modules[name] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(sys.modules[name])
program = importlib.import_module(name + ".__main__")
program.bound_memory()
sys.exit(program.main(sys.argv[3:]))
"""


def command(program: Program, arguments: list[str]) -> list[str]:
    """The command line of the checker or the reference that belongs to this package."""
    folder = Path(__file__).resolve().parent.parent / program
    return [sys.executable, "-I", "-c", _LAUNCH, f"certify_{program}", str(folder), *arguments]


def ask(
    path: Path,
    program: Program = "checker",
    jobs: int = 1,
    every: bool = False,
    seconds: int | None = None,
) -> tuple[int, dict[str, Any]]:
    """Run a checker on a file in a separate process; return its exit status and its JSON answer.

    Parameters
    ----------
    path : the certificate.
    program : the checker or the reference.
    jobs : number of processes that examine the leaves.
    every : True if the checker's refusal of leaves should have their places, as `every`: under rule `ring` of all.
    seconds : of processor time, after which the reference ends without a verdict; None if it may take any time.

    Raises
    ------
    TimeoutError : it ended so.
    BackendError : it printed no JSON object, or its status is not the answer's.
    """
    options = [] if jobs == 1 else ["--jobs", str(jobs)]
    options += ["--every"] if every else []
    options += [] if seconds is None else ["--seconds", str(seconds)]
    line = command(program, ["--json", *options, "--", str(path)])
    done = subprocess.run(line, capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL)
    if seconds is not None and done.returncode in (-signal.SIGXCPU, -signal.SIGKILL):
        raise TimeoutError(f"the {program} had no verdict after {seconds} s.")
    try:
        answer = dict(json.loads(done.stdout))
    except (ValueError, TypeError) as error:
        said = done.stderr.strip()[-300:]
        raise BackendError(f"the {program} ended with status {done.returncode} and no verdict: {said}") from error
    if done.returncode != _STATUS.get(answer.get("result", ""), done.returncode if "error" in answer else -1):
        raise BackendError(f"the {program} ended with status {done.returncode} and says {answer}.")
    return done.returncode, answer


def run_checker(
    path: Path,
    program: Program = "checker",
    jobs: int = 1,
    every: bool = False,
    seconds: int | None = None,
) -> dict[str, Any]:
    """The JSON answer of a checker that reached a verdict; the parameters are those of `ask`.

    Raises
    ------
    TimeoutError : it ended without one after `seconds`.
    BackendError : it ended with neither ACCEPTED, nor TRUSTED, nor REJECTED.
    """
    status, answer = ask(path, program, jobs, every, seconds)
    if "error" in answer:
        raise BackendError(f"the {program} ended with status {status} and no verdict: {answer['error']}")
    return answer
