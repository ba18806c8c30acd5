"""dReal as an engine: a query goes to a process of its own, which is killed at the deadline.

dReal (Gao, Kong, Clarke 2013) decides nonlinear formulas up to delta. Its "unsat" is a proof if dReal is right, so the
certificate can only say that it was trusted; its "delta-sat" says that a perturbed formula holds somewhere in a box,
and is looked at rigorously by the caller. It comes as a Python module or as a binary on the PATH, or not at all.
"""

from __future__ import annotations

import importlib.util
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Literal

from certify.claims.queries import Query
from certify.errors import BackendError
from certify.expressions import Tree

Status = Literal["unsat", "delta-sat", "timeout", "failed"]
_INSTALL = (
    "The wheel dreal==4.21.6.2 (Python 3.10 and 3.11) needs the shared library of IBEX 2.7.4 (libibex.so), which comes "
    "from dReal's own package archive for Ubuntu or its Docker image, and Debian's coinor-libclp1, libnlopt0, "
    "liblapack3 and libblas3. A `dreal` binary on the PATH does as well."
)


@dataclass(frozen=True, slots=True)
class Backend:
    """Where dReal is: `kind` is "module" or "binary"; `command` starts it."""

    kind: Literal["module", "binary"]
    command: tuple[str, ...]
    version: str


@dataclass(frozen=True, slots=True)
class Answer:
    """What dReal said of a query: `box` for "delta-sat" (name to [lo, hi]), `detail` for a failure.

    `seconds` is the whole process, `solver_seconds` dReal alone where it is known.
    """

    status: Status
    seconds: float
    version: str
    box: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    detail: str = ""
    solver_seconds: float | None = None


def find_backend() -> Backend:
    """The Python module, or else the binary.

    Raises
    ------
    BackendError : neither is usable; the message says what is missing and where to get it.
    """
    missing = "the Python module `dreal` is not installed"
    if importlib.util.find_spec("dreal") is not None:
        probe = [sys.executable, "-c", "import dreal; print(getattr(dreal, '__version__', 'unknown'))"]
        done = subprocess.run(probe, capture_output=True, text=True, check=False)
        if done.returncode == 0:
            command = (sys.executable, "-m", "certify.engines.dreal.child")
            return Backend("module", command, done.stdout.strip())
        lines = done.stderr.strip().splitlines()
        missing = f"`import dreal` fails ({lines[-1] if lines else 'no message'})"
    binary = shutil.which("dreal")
    if binary is not None:
        done = subprocess.run([binary, "--version"], capture_output=True, text=True, check=False)
        return Backend("binary", (binary,), (done.stdout + done.stderr).strip().splitlines()[-1])
    raise BackendError(f"dReal cannot be used: {missing}, and no `dreal` binary is on the PATH. {_INSTALL}")


def decide(backend: Backend, query: Query, precision: float, jobs: int, seconds: float) -> Answer:
    """Ask dReal one query.

    Parameters
    ----------
    precision : dReal's delta.
    jobs : threads.
    seconds : after these the process is killed and the answer is "timeout".
    """
    start = time.monotonic()

    def spent() -> float:
        return time.monotonic() - start

    try:
        if backend.kind == "module":
            done = subprocess.run(
                backend.command, input=_to_json(query, precision, jobs), capture_output=True, text=True,
                timeout=seconds, check=False,
            )  # fmt: skip
        else:
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / "query.smt2"
                path.write_text(to_smt2(query, None), encoding="ascii")
                options = ("--precision", repr(precision), "--jobs", str(jobs), "--model", str(path))
                done = subprocess.run(
                    backend.command + options, capture_output=True, text=True, timeout=seconds, check=False
                )
    except subprocess.TimeoutExpired:
        return Answer("timeout", spent(), backend.version)
    if done.returncode != 0:
        return Answer("failed", spent(), backend.version, detail=done.stderr.strip()[-300:])
    try:
        if backend.kind == "module":
            said = json.loads(done.stdout)
            box = {name: (float(lo), float(hi)) for name, (lo, hi) in said["box"].items()}
            status: Status = {"unsat": "unsat", "delta-sat": "delta-sat"}[said["answer"]]  # type: ignore[assignment]
            return Answer(status, spent(), said["version"], box, solver_seconds=float(said["seconds"]))
        return _read_binary(done.stdout, spent(), backend.version)
    except (ValueError, KeyError, TypeError) as error:
        return Answer("failed", spent(), backend.version, detail=f"unreadable answer ({error}): {done.stdout[-300:]!r}")


def to_smt2(query: Query, expected: str | None) -> str:
    """The query as SMT-LIB 2 in QF_NRA with sin, cos, tanh and log; `expected` becomes a comment."""
    lines = [f"; {query.name}: satisfiable if and only if the claim is false"]
    if expected is not None:
        lines.append(f"; expected: {expected}")
    lines.append("(set-logic QF_NRA)")
    for name, lo, hi in query.variables:
        lines += [f"(declare-fun {name} () Real)", f"(assert (>= {name} {_smt_number(lo)}))",
                  f"(assert (<= {name} {_smt_number(hi)}))"]  # fmt: skip
    lines += [f"(define-fun {name} () Real {_smt(tree)})" for name, tree in query.definitions]
    lines += [f"(assert ({relation} {_smt(left)} {_smt(right)}))" for left, relation, right in query.constraints]
    return "\n".join([*lines, "(check-sat)", "(exit)", ""])


def _to_json(query: Query, precision: float, jobs: int) -> str:
    return json.dumps({
        "variables": [(name, str(lo), str(hi)) for name, lo, hi in query.variables],
        "definitions": query.definitions, "constraints": query.constraints, "precision": precision, "jobs": jobs,
    })  # fmt: skip


def _read_binary(text: str, seconds: float, version: str) -> Answer:
    """`unsat`, or `delta-sat with delta = d` and lines `name : [lo, hi]`."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    if lines and lines[0] == "unsat":
        return Answer("unsat", seconds, version)
    if not lines or not lines[0].startswith("delta-sat"):
        return Answer("failed", seconds, version, detail=f"unreadable answer: {text[-300:]!r}")
    box = {}
    for line in lines[1:]:
        name, colon, interval = line.partition(":")
        if colon and "[" in interval:
            lo, hi = interval.strip(" []").split(",")
            box[name.strip()] = (float(lo), float(hi))
    return Answer("delta-sat", seconds, version, box)


def _smt(tree: Tree) -> str:
    if isinstance(tree, str):
        try:
            return _smt_number(Fraction(tree))
        except ValueError:
            return tree
    operator, *rest = tree
    if operator == "**":
        base, exponent = _smt(rest[0]), int(rest[1])
        power = f"(^ {base} {abs(exponent)})"
        return power if exponent > 0 else f"(/ 1 {power})"
    return f"({operator} {' '.join(_all(rest))})"


def _all(trees: Iterable[Tree]) -> list[str]:
    return [_smt(tree) for tree in trees]


def _smt_number(q: Fraction) -> str:
    """Decimals, because solvers read integers into 64 bits; binary64 holds those of weights exactly."""
    top = f"{abs(q.numerator)}.0"
    size = top if q.denominator == 1 else f"(/ {top} {q.denominator}.0)"
    return size if q >= 0 else f"(- {size})"
