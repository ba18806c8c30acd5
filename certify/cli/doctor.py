"""`certify doctor`: test an installation, and name missing packages with the command that installs each.

It runs one proof on a loop with a known region of attraction: xdot = x/2 - tanh(x) attracts exactly |x| < 1.915. Both
checkers must accept the proof for |x| <= 1, and reject the same file with |x| <= 2 written into it: a checker that
accepts everything is no better than one that does not start.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import typer

from certify.cli.shared import Json
from certify.cli.terminal import say, show

if TYPE_CHECKING:
    from rich.table import Table

State = Literal["ok", "missing", "warning", "fault"]
_CORE = {  # package of the registry, module to import
    "numpy": "numpy", "scipy": "scipy", "sympy": "sympy", "numba": "numba", "python-flint": "flint", "typer": "typer",
    "rich": "rich", "matplotlib": "matplotlib", "jinja2": "jinja2", "cvxpy": "cvxpy", "clarabel": "clarabel",
    "threadpoolctl": "threadpoolctl",
}  # fmt: skip
_EXTRAS = {  # package: module, extra, what for
    "onnx": ("onnx", "onnx", "policies of ONNX"),
    "safetensors": ("safetensors", "safetensors", "policies of safetensors"),
    "gymnasium": ("gymnasium", "controllers", "training with controllers train"),
    "control": ("control", "controllers", "training with controllers train"),
    "distributed": ("distributed", "cluster", "--cluster of certify and controllers"),
    "torch": ("torch", "torch", "modules of torch, policies of TorchScript, training with controllers train"),
    "pyarrow": ("pyarrow", "parquet", "Parquet tables of certify sweep"),
    "stable-baselines3": ("stable_baselines3", "baselines", "baselines of controllers compare; not needed to import"),
}
_OLDEST = (3, 11)


@dataclass(frozen=True, slots=True)
class Finding:
    """One finding about the installation.

    Parameters
    ----------
    part : its group: core, optional, path, checkers or threads.
    name : its name.
    state : `fault` if the core does not work without it.
    found : what was found, such as a version.
    advice : the remedy; empty if none is needed.
    """

    part: str
    name: str
    state: State
    found: str
    advice: str = ""


def doctor(as_json: Json = False) -> None:
    """Test the installation: versions, missing packages with their install commands, and both checkers."""
    findings = [_python(), *_core(), *_optional(), *_path(), _threads()]
    # Without the core the job cannot even be tried.
    broken = any(f.state == "fault" for f in findings)
    findings += [_skipped()] if broken else _job()
    healthy = not any(f.state == "fault" for f in findings)
    if as_json:
        say(json.dumps({"healthy": healthy, "findings": [asdict(f) for f in findings]}))
    else:
        show(_page(findings))
        say("\nThe core works." if healthy else "\nThe core does not work; see the faults above.")
    raise typer.Exit(0 if healthy else 1)


def _python() -> Finding:
    found = f"{sys.version.split()[0]} at {sys.executable}"
    if sys.version_info < _OLDEST:
        return Finding("core", "python", "fault", found, "Use Python 3.11 or newer.")
    return Finding("core", "python", "ok", found)


def _core() -> list[Finding]:
    """Import every package that certify needs: an installed package may still not load."""
    return [_cvxpy() if name == "cvxpy" else _package(name, module) for name, module in _CORE.items()]


def _package(name: str, module: str) -> Finding:
    from certify.analysis.installation import version_of

    advice = f"pip install {name}"
    try:
        importlib.import_module(module)
    except Exception as error:  # an installed package may fail in any way
        found = version_of(name)
        why = f"{type(error).__name__}: {error}".splitlines()[0]
        return Finding("core", name, "fault", f"{found or 'not installed'}; {why}", advice)
    return Finding("core", name, "ok", version_of(name) or "version unknown")


def _cvxpy() -> Finding:
    """cvxpy with Clarabel, the solver that the candidates `robust` and `peak` ask through it."""
    found = _package("cvxpy", "cvxpy")
    if found.state != "ok":
        return found
    import cvxpy

    if "CLARABEL" not in cvxpy.installed_solvers():
        return Finding("core", "cvxpy", "fault", f"{found.found} without Clarabel", "pip install clarabel")
    from certify.analysis.installation import version_of

    return Finding("core", "cvxpy", "ok", f"{found.found} with Clarabel {version_of('clarabel')}")


def _optional() -> list[Finding]:
    from certify.analysis.installation import version_of
    from certify.certificates.coq.kernel import find_coqc
    from certify.errors import BackendError
    from certify.provers.dreal.backend import find_backend

    findings = []
    for name, (module, extra, purpose) in _EXTRAS.items():
        version = version_of(name)
        command = f"pip install '.[{extra}]'"
        if version is None or importlib.util.find_spec(module) is None:
            findings.append(Finding("optional", name, "missing", purpose, command))
        else:
            findings.append(Finding("optional", name, "ok", version))
    try:
        backend = find_backend()
        findings.append(Finding("optional", "dReal", "ok", f"{backend.version}, as a {backend.kind}"))
    except BackendError as error:
        purpose = "--engine dreal and both; bounds, the default, needs no solver"
        findings.append(Finding("optional", "dReal", "missing", purpose, str(error)))
    try:
        findings.append(Finding("optional", "Coq", "ok", f"{find_coqc().version} with its library Interval"))
    except BackendError as error:
        findings.append(Finding("optional", "Coq", "missing", "certify prove-in-coq", str(error)))
    return findings


def _path() -> list[Finding]:
    """Report the installed package, and warn if a script in this folder would import another copy."""
    import certify
    from certify.analysis.installation import found_by_import, version_of

    here = Path(certify.__file__).resolve().parent
    version = version_of("certify")
    own = f"{certify.__version__} in {here}"
    findings = [Finding("path", "certify", "ok", own)]
    if version is None:
        findings = [Finding("path", "certify", "warning", f"{own}, not installed", "pip install . in its folder.")]
    elif version != certify.__version__:
        findings = [
            Finding(
                "path", "certify", "warning", f"{own}, while {version} is installed",
                "Two copies are on the path. python -I -m certify doctor shows the installed one.",
            )
        ]  # fmt: skip
    other = found_by_import(Path.cwd())
    if other is not None and (Path.cwd() / "certify" / "checker" / "FORMAT.md").exists():
        findings.append(Finding("path", "import certify", "ok", f"scripts of this folder import its own, {other}"))
    elif other is not None:
        findings.append(
            Finding(
                "path", "import certify", "warning", f"scripts and notebooks of this folder import {other}",
                "Rename that folder or file, or start from another folder: it hides the installed package.",
            )
        )  # fmt: skip
    return findings


def _threads() -> Finding:
    from certify.provers.execution.threads import cores

    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    set_to = os.environ.get("OMP_NUM_THREADS")
    found = f"{usable} cores usable, proofs use {cores()}"
    return Finding("threads", "threads", "ok", found + (f" (OMP_NUM_THREADS={set_to})" if set_to else ""))


def _skipped() -> Finding:
    return Finding("checkers", "self-test", "warning", "not tried: the core does not work")


def _job() -> list[Finding]:
    """Prove a loop with a known answer, and ask both checkers about the proof and about a forgery of it."""
    from certify.certificates.checking import Program, ask

    programs: tuple[Program, ...] = ("checker", "reference")
    with tempfile.TemporaryDirectory(prefix="certify-doctor-") as name:
        folder = Path(name)
        try:
            genuine, forged = _certificates(folder)
        except Exception as error:  # whatever it is, it is the finding
            found = f"{type(error).__name__}: {error}"
            return [Finding("checkers", "proof", "fault", found, "Report this with the output of certify --version.")]
        findings = [Finding("checkers", "proof", "ok", "xdot = x/2 - tanh(x) proved on |x| <= 1")]
        for program in programs:
            try:
                said = [ask(path, program)[1].get("result", "no verdict") for path in (genuine, forged)]
            except Exception as error:
                said = [f"{type(error).__name__}: {error}"]
            found = f"the proof {said[0]}" + (f", a forgery {said[1]}" if len(said) == 2 else "")
            works = said == ["ACCEPTED", "REJECTED"]
            advice = "" if works else "It must say ACCEPTED and REJECTED: trust no verdict of this installation."
            findings.append(Finding("checkers", program, "ok" if works else "fault", found, advice))
    return findings


def _certificates(folder: Path) -> tuple[Path, Path]:
    """A certificate of {x^2 <= 1}, and the same with {x^2 <= 4}, which is false: x = 1.92 is not attracted."""
    from fractions import Fraction

    import numpy as np

    from certify.analysis.options import RoaOptions
    from certify.analysis.run import certify_roa
    from certify.certificates.verdict import Verdict
    from certify.errors import SoundnessError
    from certify.loop.expressions import Number, symbols
    from certify.loop.plants import System
    from certify.loop.policies import PolicyNetwork

    x, u = symbols(["x", "u"])
    system = System(
        name="known", states=(x,), inputs=(u,), parameters={}, dynamics=(x / 2 + u,), u_eq=(Number(0),),
        domain=((Fraction(-3), Fraction(3)),), input_bounds=((Fraction(-1), Fraction(1)),),
    )  # fmt: skip
    network = PolicyNetwork.of_layers((np.array([[-1.0]]),), (np.zeros(1),), np.ones(1), np.zeros(1), "tanh", "none")
    result = certify_roa(system, network, folder, RoaOptions(P=np.eye(1), level=1.0))
    if result.verdict is not Verdict.PROVED or result.raw is None or result.certificate is None:
        raise SoundnessError(
            f"a loop with a known answer must be PROVED; found {result.verdict.value}: {result.reason}."
        )
    data: dict[str, Any] = json.loads(result.raw)
    data["levels"]["roa"] = (4.0).hex()
    forged = folder / "forged.json"
    forged.write_text(json.dumps(data), encoding="utf-8")
    return result.certificate, forged


def _page(findings: list[Finding]) -> Table:
    from rich.table import Table
    from rich.text import Text

    colours = {"ok": "green", "missing": "dim", "warning": "yellow", "fault": "bold red"}
    table = Table.grid(padding=(0, 2))
    for f in findings:
        text = Text(f.found)
        if f.advice:
            text.append(f"\n{f.advice}", style="dim")
        table.add_row(Text(f.state, style=colours[f.state]), Text(f.name), text)
    return table
