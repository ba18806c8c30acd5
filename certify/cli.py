"""The command line `certify`: arguments, printing, exit statuses; no mathematics.

Standard output carries the result, or with `--json` exactly one JSON object; progress and diagnostics go to
standard error. Exit status: 0 proved or accepted, 1 refuted or rejected, 2 usage or unusable input, 3 unknown,
70 internal error.
"""

from __future__ import annotations

import gc
import json
import os
import sys
import threading
import time
from contextlib import suppress
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from certify.errors import BackendError, CertificateFormatError, CertifyError, InputError, SoundnessError

if TYPE_CHECKING:
    from certify.engines.branch_and_bound import RingProgress
    from certify.lyapunov import Candidate
    from certify.policies import Policy
    from certify.roa import RoaOptions, RoaResult
    from certify.systems import System

app = typer.Typer(
    help="Regions of attraction of plants controlled by tanh networks, proved and independently checked.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)

_INTERRUPTED = 130
_STOPPED = "interrupted; nothing was left half-written."

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object instead of text.")]


@app.command()
def roa(
    context: typer.Context,
    policy: Annotated[Path, typer.Option(help="Policy file (certify-policy/1, .pt).")],
    system: Annotated[
        str | None, typer.Option(help="Plant: a name or a .toml file; default: what the policy file says.")
    ] = None,
    param: Annotated[list[str] | None, typer.Option(help="Parameter of the plant, NAME=VALUE; repeatable.")] = None,
    domain: Annotated[
        list[str] | None, typer.Option(help="Half-width NAME=D or interval NAME=LO:HI of a state; repeatable.")
    ] = None,
    candidate: Annotated[str, typer.Option(help="Lyapunov candidate: lyapunov, lqr or optimised.")] = "lyapunov",
    compare: Annotated[
        bool, typer.Option("--compare", help="Compare with the optimised candidate too; takes its time.")
    ] = False,
    q: Annotated[str | None, typer.Option("--Q", help="Diagonal of Q, as in 1,1.")] = None,
    r: Annotated[str | None, typer.Option("--R", help="Diagonal of R (candidate lqr), as in 1.")] = None,
    level: Annotated[float | None, typer.Option(help="Prove exactly this level; less is not PROVED.")] = None,
    engine: Annotated[
        str, typer.Option(envvar="CERTIFY_ENGINE", help="bounds, dreal (trusted, not checked), or both.")
    ] = "bounds",
    precision: Annotated[float, typer.Option(help="dReal's delta.")] = 1e-3,
    jobs: Annotated[int, typer.Option(help="dReal's threads.")] = 1,
    device: Annotated[str, typer.Option(help="cpu or cuda.")] = "cpu",
    time_limit: Annotated[float, typer.Option(help="Seconds for the ring.")] = 600.0,
    max_boxes: Annotated[int, typer.Option(help="Boxes for the ring.")] = 4_000_000,
    out: Annotated[Path | None, typer.Option(help="Folder for the results; default: out/POLICY.")] = None,
    as_json: Json = False,
) -> None:
    """Certify a region of attraction: prove, write a certificate, have it checked, report."""
    from certify.policies import load_policy
    from certify.report import render_html, summary
    from certify.roa import RoaOptions, certify_roa

    start = time.perf_counter()
    stored = load_policy(policy)
    plant = _system(stored, system, param or [], domain or [])
    _tell(_plant_line(stored, plant, system is not None))
    shift = _beta_shift(stored, plant)
    if shift:
        _tell(shift)
    options = RoaOptions(
        candidate=candidate,  # type: ignore[arg-type]
        Q=_numbers(q, "--Q"),
        R=_numbers(r, "--R"),
        level=level,
        engine=_engine(context, engine),  # type: ignore[arg-type]
        dreal_precision=precision,
        jobs=jobs,
        device=_device(device),
        time_limit=time_limit,
        max_boxes=max_boxes,
    )
    folder = out if out is not None else Path("out") / policy.stem
    progress = _Progress()
    try:
        result = certify_roa(
            plant, stored.network, folder, options,
            load_seconds=time.perf_counter() - start, provenance=_provenance(policy), progress=progress,
        )  # fmt: skip
    finally:
        progress.close()
    data = result.to_dict()
    if result.notice is not None:
        _tell(result.notice)
    if result.certificate is not None:
        data["candidates"] = _candidates(result, options, compare)
        from certify.certificate import read_certificate

        answer = None if result.checker is None else dict(result.checker)
        page = render_html(read_certificate(result.certificate), answer, data, result.certificate)
        _write(folder / "report.html", page)
    if as_json:
        sys.stdout.write(json.dumps(data) + "\n")
    else:
        _print(summary(data))
        if result.certificate is not None:
            sys.stdout.write(f"certificate  {result.certificate}\nreport       {folder / 'report.html'}\n")
    raise typer.Exit(result.verdict.exit_status)


@app.command("export-smt2")
def export_smt2(
    policy: Annotated[Path, typer.Option(help="Policy file (certify-policy/1, .pt).")],
    out: Annotated[Path, typer.Option(help="Folder for the files, one a claim.")],
    system: Annotated[str | None, typer.Option(help="Plant; default: what the policy file says.")] = None,
    param: Annotated[list[str] | None, typer.Option(help="Parameter of the plant, NAME=VALUE; repeatable.")] = None,
    domain: Annotated[list[str] | None, typer.Option(help="Half-width NAME=D or interval NAME=LO:HI.")] = None,
    candidate: Annotated[str, typer.Option(help="Lyapunov candidate: lyapunov, lqr or optimised.")] = "lyapunov",
    level: Annotated[float | None, typer.Option(help="c2; default: 0.99 of the largest that is proved.")] = None,
    time_limit: Annotated[float, typer.Option(help="Seconds for the ring.")] = 600.0,
    as_json: Json = False,
) -> None:
    """Prove levels with the bounds engine and write its claims as SMT-LIB 2 for another solver."""
    from certify.engines.dreal import to_smt2
    from certify.obligations import queries
    from certify.policies import load_policy
    from certify.roa import RoaOptions, certify_roa, obligations_of

    stored = load_policy(policy)
    plant = _system(stored, system, param or [], domain or [])
    options = RoaOptions(candidate=candidate, level=level, time_limit=time_limit)  # type: ignore[arg-type]
    result = certify_roa(plant, stored.network, out, options)
    inner, outer = result.levels.get("local"), result.levels.get("roa")
    if result.verdict.exit_status != 0 or inner is None or outer is None:
        raise InputError(f"there are no levels to export; {result.verdict.value}: {result.reason}")
    outer = outer if level is not None else max(inner, 0.99 * outer)
    written = []
    for query in queries(obligations_of(result), inner, outer):
        path = out / f"{query.name}.smt2"
        _write(path, to_smt2(query, "unsat (proved by the bounds engine, accepted by the checker)"))
        written.append(str(path))
    sys.stdout.write((json.dumps({"files": written}) if as_json else "\n".join(written)) + "\n")


@app.command()
def check(
    certificate: Annotated[Path, typer.Argument(help="Certificate file.")],
    policy: Annotated[
        Path | None, typer.Option(help="Policy file that the certificate must be about (compares hashes).")
    ] = None,
    arithmetic: Annotated[
        str, typer.Option(help="float64 (binary64, every rounding bounded) or arb (balls; slow, the reference).")
    ] = "float64",
    as_json: Json = False,
) -> None:
    """Check a certificate with the independent checker, in a process of its own."""
    import subprocess

    if arithmetic not in ("float64", "arb"):
        raise InputError(f"--arithmetic must be float64 or arb, not {arithmetic!r}.")
    if policy is not None:
        from certify.certificate import read_certificate
        from certify.policies import load_policy

        network, claimed = load_policy(policy).network, None
        with suppress(CertificateFormatError):  # the checker says below what is wrong with the file
            claimed = read_certificate(certificate).network.sha256()
        if claimed is not None and claimed != network.sha256():
            detail = f"the certificate is about policy {claimed}, not about {policy} ({network.sha256()})"
            if as_json:
                stated = {"result": "REJECTED", "rule": "policy", "at": "policy.sha256", "detail": detail}
                sys.stdout.write(json.dumps(stated) + "\n")
            else:
                sys.stdout.write(f"REJECTED rule=policy at=policy.sha256: {detail}\n")
            raise typer.Exit(1)
    command = [sys.executable, "-I", "-m", "certify.checker", str(certificate), "--arithmetic", arithmetic]
    command += ["--json"] if as_json else []
    raise typer.Exit(subprocess.run(command, check=False).returncode)


@app.command()
def report(
    certificate: Annotated[Path, typer.Argument(help="Certificate file.")],
    out: Annotated[Path | None, typer.Option(help="HTML file; default: report.html beside the certificate.")] = None,
    as_json: Json = False,
) -> None:
    """Check a certificate and draw its report."""
    from certify.certificate import read_certificate
    from certify.report import render_html
    from certify.roa import run_checker

    target = out if out is not None else certificate.parent / "report.html"
    read = read_certificate(certificate)
    answer = run_checker(certificate)
    _write(target, render_html(read, answer, None, certificate))
    stated = {"report": str(target), "result": answer["result"]}
    sys.stdout.write((json.dumps(stated) if as_json else f"{answer['result']}  {target}") + "\n")
    raise typer.Exit({"ACCEPTED": 0, "TRUSTED": 3}.get(answer["result"], 1))


@app.command()
def systems(as_json: Json = False) -> None:
    """List the plants that ship, with their parameters, domain and input bounds."""
    from certify.systems import available_systems, get_system

    found = [get_system(name) for name in available_systems()]
    if as_json:
        sys.stdout.write(json.dumps({"systems": [_describe(s) for s in found]}) + "\n")
        return
    for s in found:
        sys.stdout.write(f"{s.name}: {s.description}\n")
        for symbol, expression in zip(s.states, s.dynamics, strict=True):
            sys.stdout.write(f"  {symbol}' = {expression}\n")
        for name, value in s.parameters.items():
            sys.stdout.write(f"  {name} = {float(value):g} {s.units.get(name, '')}\n")
        for symbols, intervals in ((s.states, s.domain), (s.inputs, s.input_bounds)):
            for symbol, (lo, hi) in zip(symbols, intervals, strict=True):
                unit = s.units.get(symbol.name, "")
                sys.stdout.write(f"  {symbol} in [{float(lo):g}, {float(hi):g}] {unit}\n")


def main(arguments: list[str] | None = None) -> None:
    """Entry point: turns every error into one sentence and the right exit status."""
    gc.set_threshold(100_000)  # most objects of a run are modules, which live to its end
    # Threads that wait must not spin: on a busy machine spinning costs a factor of ten. OpenBLAS cannot be told so, and
    # numpy's matrices are small here, also the checker's; the engine's threads are torch's.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    given = sys.argv[1:] if arguments is None else arguments
    sys.exit(_run(given, "--json" in given))


def _run(arguments: list[str], as_json: bool) -> int:
    command = typer.main.get_command(app)
    try:
        status = command.main(arguments, prog_name="certify", standalone_mode=False)
        if status == _INTERRUPTED:  # what typer makes of Ctrl-C
            return _fail(as_json, _STOPPED, _INTERRUPTED)
        return status if isinstance(status, int) else 0
    except typer.Exit as stop:
        return stop.exit_code
    except typer.TyperException as error:  # usage
        return _fail(as_json, error.format_message() if hasattr(error, "format_message") else str(error), 2)
    except (typer.Abort, KeyboardInterrupt):
        return _fail(as_json, _STOPPED, _INTERRUPTED)
    except (SoundnessError, BackendError) as error:
        return _fail(as_json, f"internal error: {error}", 70)
    except CertifyError as error:
        return _fail(as_json, str(error), 2)
    except BrokenPipeError:
        return 70
    except Exception as error:  # the last resort: no traceback reaches a user
        return _fail(as_json, f"internal error: {type(error).__name__}: {error}", 70)


def _fail(as_json: bool, message: str, status: int) -> int:
    if as_json:
        sys.stdout.write(json.dumps({"error": message}) + "\n")
    else:
        sys.stderr.write(f"certify: {message}\n")
    return status


def _candidates(result: RoaResult, options: RoaOptions, compare: bool) -> list[dict[str, Any]]:
    """The volumes within reach of the other candidates, sampled, beside the one that was proved."""
    from dataclasses import asdict

    from certify.roa import compare_candidates

    known = {} if result.candidate is None or result.P is None else {result.candidate: result.P}
    names: list[Candidate] = ["lyapunov", "lqr"]
    if compare or "optimised" in known:
        names.append("optimised")
    rows = compare_candidates(result.system, result.network, options, known, names)
    return [{**asdict(row), "proved": row.candidate in known} for row in rows]


def _system(stored: Policy, name: str | None, params: list[str], bounds: list[str]) -> System:
    from certify.systems import exact, get_system

    plant = get_system(name if name is not None else stored.system)
    if name is None or name == stored.system:
        plant = plant.with_parameters(stored.parameters)
    plant = plant.with_parameters(dict(_assignment(p, "--param") for p in params))
    domain: dict[str, tuple[Fraction, Fraction]] = {}
    for text in bounds:
        state, value = _assignment(text, "--domain")
        lo, _, hi = value.rpartition(":")
        domain[state] = (exact(lo, state), exact(hi, state)) if lo else (-exact(hi, state), exact(hi, state))
    return plant.with_domain(domain)


def _assignment(text: str, option: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not equals or not name or not value:
        raise InputError(f"{option} takes NAME=VALUE; found {text!r}.")
    return name.strip(), value.strip()


def _numbers(text: str | None, option: str) -> tuple[float, ...] | None:
    if text is None:
        return None
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError as error:
        raise InputError(f"{option} takes numbers separated by commas, as in 1,1; found {text!r}.") from error


def _device(name: str) -> str:
    import torch

    if name == "cpu" or (name.startswith("cuda") and torch.cuda.is_available()):
        return name
    raise InputError(f"--device must be cpu, or cuda on a machine that has it; found {name!r}.")


def _engine(context: typer.Context, name: str) -> str:
    """The engine; without dReal, one that only the environment names falls back to bounds with a notice."""
    from certify.engines.dreal import find_backend

    source = context.get_parameter_source("engine")
    if name in ("dreal", "both") and source is not None and source.name == "ENVIRONMENT":
        try:
            find_backend()
        except BackendError as error:
            _tell(f"engine bounds in the place of {name}: {error}")
            return "bounds"
    return name


def _plant_line(stored: Policy, plant: System, overridden: bool) -> str:
    values = ", ".join(f"{name} = {float(q):g}" for name, q in plant.parameters.items())
    source = "from the command line" if overridden else "from the policy file"
    layers = "-".join(map(str, stored.network.layers))
    return f"plant {plant.name} ({source}) with {values or 'no parameters'}; policy {layers}"


def _beta_shift(stored: Policy, plant: System) -> str | None:
    """What reading a stored, rounded beta as the real number changes in u at the origin."""
    import numpy as np

    if stored.beta is None:
        return None
    network = stored.network
    u = network.scale * np.tanh(stored.beta) + network.offset
    shift = np.max(np.abs(u - np.array([float(v) for v in plant.exact_u_eq()])))
    return f"the file's rounded beta is read as the real number; this shifts u(0) by {shift:.3g}"


def _provenance(policy: Path) -> dict[str, Any]:
    from importlib.metadata import version

    packages = ("certify", "torch", "numpy", "scipy", "sympy", "python-flint")
    return {"policy": policy.name, "python": sys.version.split()[0], **{p: version(p) for p in packages}}


def _describe(s: System) -> dict[str, Any]:
    return {
        "name": s.name,
        "description": s.description,
        "states": [x.name for x in s.states],
        "inputs": [u.name for u in s.inputs],
        "parameters": {name: str(q) for name, q in s.parameters.items()},
        "domain": {x.name: [str(lo), str(hi)] for x, (lo, hi) in zip(s.states, s.domain, strict=True)},
        "input_bounds": {u.name: [str(lo), str(hi)] for u, (lo, hi) in zip(s.inputs, s.input_bounds, strict=True)},
        "dynamics": {x.name: str(e) for x, e in zip(s.states, s.dynamics, strict=True)},
        "units": dict(s.units),
    }


def _write(path: Path, text: str) -> None:
    partial = path.with_name(path.name + ".partial")
    try:
        partial.write_text(text, encoding="utf-8")
        partial.replace(path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise InputError(f"{path} cannot be written: {error.strerror}.") from error


def _print(renderable: Any) -> None:
    from rich.console import Console

    Console(file=sys.stdout).print(renderable)


def _tell(line: str) -> None:
    sys.stderr.write(line + "\n")


def _ring_line(state: RingProgress) -> str:
    left = "" if state.seconds_left is None else f", about {state.seconds_left:.0f} s left"
    return (
        f"ring: proved to V <= {state.level:.4g} of {state.target:.4g} ({state.proved:.1%} of the volume), "
        f"{state.boxes} boxes, {state.open} open{left}"
    )


class _Progress:
    """A line on standard error, at most five times a second, only on a terminal."""

    def __init__(self) -> None:
        self.last = 0.0
        self.shown = False

    def __call__(self, stage: str, state: RingProgress | None) -> None:
        if stage == "check":  # the checker works in a process of its own: load the drawing libraries meanwhile
            from certify.report import warm_up

            threading.Thread(target=warm_up, daemon=True).start()
        now = time.monotonic()
        if sys.stderr.isatty() and now - self.last > 0.2:
            self.last, self.shown = now, True
            sys.stderr.write(f"\r{_ring_line(state) if state is not None else 'checking'}\x1b[K")
            sys.stderr.flush()

    def close(self) -> None:
        if self.shown:
            sys.stderr.write("\r\x1b[K")
