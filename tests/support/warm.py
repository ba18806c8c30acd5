"""Start checkers quickly: a process that has loaded both programs forks one for each certificate.

A checker's start, in which it loads numpy and Arb, takes ten times as long as most checks of the suite. The processes
are isolated as those of `certify.certificates.checking` are (`-I`, nothing of the project but their own folder) and run
the same `main`; what a check loads only where it needs it is loaded after the fork. Every other command line, and those
that tests start themselves, run as they would without this.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from threading import Lock
from typing import Any

from certify.certificates import checking

_SERVE = """
import importlib, importlib.util, json, os, sys, tempfile
os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
programs = {}
for name, folder, loaded in json.loads(sys.argv[1]):
    spec = importlib.util.spec_from_file_location(name, folder + "/__init__.py", submodule_search_locations=[folder])
    sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sys.modules[name])
    programs[name] = importlib.import_module(name + ".__main__")
    for module in loaded:
        importlib.import_module(name + "." + module)
for line in sys.stdin:
    name, folder, arguments = json.loads(line)
    with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as err:
        child = os.fork()
        if child == 0:
            status = 70
            try:
                os.chdir(folder)
                for number, stream in ((1, out), (2, err)):
                    os.dup2(stream.fileno(), number)
                os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
                status = programs[name].main(arguments)
                sys.stdout.flush()
                sys.stderr.flush()
            finally:
                os._exit(status)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        for stream in (out, err):
            stream.seek(0)
        print(json.dumps((status, out.read(), err.read())), flush=True)
"""
_PYTHON = sys.executable  # a test may name another one later
_LOADED = {"certify_checker": ("document", "words", "rules", "boxes"), "certify_reference": ()}


class WarmCheckers:
    """`subprocess.run` for the module `certify.certificates.checking`."""

    DEVNULL = subprocess.DEVNULL

    def __init__(self) -> None:
        self._lock = Lock()
        self._server: subprocess.Popen[str] | None = None
        room = Path(checking.__file__).resolve().parent.parent
        self._folders = {f"certify_{name}": str(room / name) for name in ("checker", "reference")}

    def run(self, line: Sequence[str], *, check: bool, **options: Any) -> subprocess.CompletedProcess[str]:
        """The result of a command line, in a fork if it is that of a checker."""
        name, folder = (*line, *[""] * 6)[4:6]
        if list(line[:4]) != [_PYTHON, "-I", "-c", checking._LAUNCH] or self._folders.get(name) != folder:
            return subprocess.run(line, check=check, **options)
        with self._lock:
            ask, answer = self._streams()
            ask.write(json.dumps((name, os.getcwd(), line[6:])) + "\n")
            ask.flush()
            status, out, err = json.loads(answer.readline())
        return subprocess.CompletedProcess(line, status, out, err)

    def _streams(self) -> tuple[Any, Any]:
        """The input and output of the process, which is started if it does not run."""
        if self._server is None:
            programs = json.dumps([(name, folder, _LOADED[name]) for name, folder in self._folders.items()])
            line = [_PYTHON, "-I", "-c", _SERVE, programs]
            self._server = subprocess.Popen(line, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        return self._server.stdin, self._server.stdout

    def close(self) -> None:
        """End the process."""
        if self._server is not None:
            self._server.communicate()
