"""dReal as a solver: a query goes to a process of its own, which is killed at the deadline.

dReal (Gao, Kong, Clarke 2013) decides nonlinear formulas up to delta. Its "unsat" is a proof if dReal is right, so the
certificate can only say that it was trusted; its "delta-sat" says that a perturbed formula holds somewhere in a box,
and is looked at rigorously by the caller. It comes as a Python module or as a binary on the PATH, or not at all.

The module is looked for and run in isolated mode: only what is installed counts, never a `dreal.py` in the folder in
which somebody happens to work.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from decimal import Context, Decimal
from fractions import Fraction
from pathlib import Path
from typing import Literal

from certify.certificates.claims.queries import Query
from certify.errors import BackendError, InputError
from certify.loop.expressions import Tree
from certify.provers.dreal.formula import Formula, formula

Status = Literal["unsat", "delta-sat", "timeout", "failed"]
_STATUS: Mapping[str, Status] = {"unsat": "unsat", "delta-sat": "delta-sat"}
_MEANING: Mapping[Status, str] = {
    "unsat": "the condition holds, on dReal's word",
    "delta-sat": "the perturbed formula holds within delta; no violation was shown",
    "timeout": "no answer before the limit",
    "failed": "no answer",
}
_EXACT = Context(prec=2000, Emax=10**6, Emin=-(10**6))
_INLINED = 2**22  # characters of a file without definitions
_CHILD = Path(__file__).with_name("child.py")
_INSTALL = (
    "It is a solver that one installs oneself. pip install '.[dreal]' in the project's folder brings its wheel, "
    "dreal==4.21.6.2 (Linux on x86-64, Python 3.11), and no more: the wheel needs the shared library of IBEX 2.7.4 "
    "(libibex.so), which comes from dReal's own package archive for Ubuntu or its Docker image, and Debian's "
    "coinor-libclp1, libnlopt0, liblapack3 and libblas3. The wheel must be installed in the Python that runs this, "
    "because PYTHONPATH and the current folder are not searched. A `dreal` binary on the PATH does as well. The engine "
    "bounds, the default, needs neither."
)


@dataclass(frozen=True, slots=True)
class Backend:
    """An installed dReal: `kind` is "module" or "binary"; `command` starts it."""

    kind: Literal["module", "binary"]
    command: tuple[str, ...]
    version: str


@dataclass(frozen=True, slots=True)
class Answer:
    """The answer of dReal to a query: `box` for "delta-sat" (name to [lo, hi]), `detail` for a failure.

    `seconds` is the whole process, `solver_seconds` dReal alone where it is known.
    """

    status: Status
    seconds: float
    version: str
    box: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    detail: str = ""
    solver_seconds: float | None = None

    @property
    def meaning(self) -> str:
        """The answer's meaning for the condition, in words."""
        return _MEANING[self.status]


def find_backend() -> Backend:
    """The Python module, or else the binary.

    Raises
    ------
    BackendError : neither is usable; the message says what is missing and where to get it.
    """
    probe = [sys.executable, "-I", "-c", "import dreal; print(getattr(dreal, '__version__', 'unknown'))"]
    done = subprocess.run(probe, capture_output=True, text=True, check=False)
    if done.returncode == 0:
        return Backend("module", (sys.executable, "-I", str(_CHILD)), done.stdout.strip())
    lines = done.stderr.strip().splitlines()
    missing = f"`import dreal` fails ({lines[-1] if lines else 'no message'})"
    if missing.endswith("No module named 'dreal')"):
        missing = "the Python module `dreal` is not installed"
    binary = shutil.which("dreal")
    if binary is not None:
        done = subprocess.run([binary, "--version"], capture_output=True, text=True, check=False)
        lines = (done.stdout + done.stderr).strip().splitlines()
        if done.returncode == 0 and lines:
            return Backend("binary", (binary,), lines[-1])
        missing += f", {binary} --version ends with status {done.returncode}"
    raise BackendError(f"dReal cannot be used: {missing}, and no usable `dreal` binary is on the PATH. {_INSTALL}")


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
        asked = formula(query)
    except InputError as error:
        return Answer("failed", spent(), backend.version, detail=str(error))
    try:
        if backend.kind == "module":
            done = _run(backend.command, seconds, _to_json(asked, precision, jobs))
        else:
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / "query.smt2"
                path.write_text(_to_smt2(asked, None), encoding="ascii")
                options = ("--precision", repr(precision), "--jobs", str(jobs), "--model", str(path))
                done = _run(backend.command + options, seconds)
    except subprocess.TimeoutExpired:
        return Answer("timeout", spent(), backend.version)
    if done.returncode != 0:
        return Answer("failed", spent(), backend.version, detail=done.stderr.strip()[-300:])
    try:
        if backend.kind == "module":
            said = json.loads(done.stdout)
            box = {name: (float(lo), float(hi)) for name, (lo, hi) in said["box"].items()}
            return Answer(_STATUS[said["answer"]], spent(), said["version"], box, solver_seconds=float(said["seconds"]))
        return _read_binary(done.stdout, spent(), backend.version)
    except (ValueError, KeyError, TypeError) as error:
        return Answer("failed", spent(), backend.version, detail=f"unreadable answer ({error}): {done.stdout[-300:]!r}")


def to_smt2(query: Query, expected: str | None) -> str:
    """The query as SMT-LIB 2 in QF_NRA with functions, min and max; `expected` becomes a comment.

    Every number is one of binary64. Where the condition has another, a variable lies between its two neighbours, and a
    comment says what it stands for: "unsat" is about the condition, "sat" only about numbers that close to it.
    Definitions are written out where they are used, because dReal makes a variable and an equation of each `let` and
    each function without arguments, and searches over it; where that would be too long, they are functions of an
    argument that does not matter, which dReal puts in their place.

    Raises
    ------
    InputError : the query has a number beyond binary64.
    """
    return _to_smt2(formula(query), expected)


def _run(command: tuple[str, ...], seconds: float, text: str | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, input=text, capture_output=True, text=True, timeout=seconds, check=False)


def _to_smt2(asked: Formula, expected: str | None) -> str:
    lines = [f"; {asked.name}: unsatisfiable only if the condition holds"]
    if expected is not None:
        lines.append(f"; expected: {expected}")
    lines.append("(set-logic QF_NRA)")
    for name, lo, hi in asked.variables:
        if name in asked.stands_for:
            lines.append(f"; {name} stands for {asked.stands_for[name]}")
        lines.append(f"(declare-fun {name} () Real)")
        lines.append(f"(assert (>= {name} {_smt_number(Fraction(lo))}))")
        lines.append(f"(assert (<= {name} {_smt_number(Fraction(hi))}))")
    replacing: dict[str, str] = {}
    inline = _length_inlined(asked) < _INLINED
    for name, tree in asked.definitions:
        replacing[name] = _smt(tree, replacing)
        if not inline:
            lines.append(f"(define-fun {name} ((v. Real)) Real {replacing[name]})")
            replacing[name] = f"({name} {asked.variables[0][0]})"
    for left, relation, right in asked.constraints:
        lines.append(f"(assert ({relation} {_smt(left, replacing)} {_smt(right, replacing)}))")
    return "\n".join([*lines, "(check-sat)", "(exit)", ""])


def _length_inlined(asked: Formula) -> int:
    """About the characters of the file with every definition written out where it is used."""
    lengths: dict[str, int] = {}

    def length(tree: Tree) -> int:
        if isinstance(tree, list):
            return sum(map(length, tree)) + 2 + len(tree)
        return lengths.get(tree, 20)

    for name, tree in asked.definitions:
        lengths[name] = length(tree)
    return sum(length(left) for left, _, _ in asked.constraints)


def _to_json(asked: Formula, precision: float, jobs: int) -> str:
    stated = {"variables": asked.variables, "definitions": asked.definitions, "constraints": asked.constraints}
    return json.dumps({**stated, "precision": precision, "jobs": jobs})


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


def _smt(tree: Tree, replacing: Mapping[str, str]) -> str:
    if isinstance(tree, str):
        if tree in replacing:
            return replacing[tree]
        try:
            return _smt_number(Fraction(tree))
        except ValueError:
            return tree
    operator, *rest = tree
    if operator == "**":
        return f"(^ {_smt(rest[0], replacing)} {int(rest[1])})"
    return f"({operator} {' '.join(_smt(part, replacing) for part in rest)})"


def _smt_number(q: Fraction) -> str:
    """All the digits of a binary64 number: dReal takes integers and quotients through roundings of its own."""
    size = format(_EXACT.divide(Decimal(abs(q.numerator)), Decimal(q.denominator)), "f")
    size = size if "." in size else f"{size}.0"
    return size if q >= 0 else f"(- {size})"
