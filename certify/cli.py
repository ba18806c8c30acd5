"""The command line `certify`: arguments, printing, exit statuses; no mathematics.

Standard output carries the result, or with `--json` exactly one JSON object; progress and diagnostics go to
standard error. Exit status: 0 proved or accepted, 1 refuted or rejected, 2 usage or unusable input, 3 unknown
or trusted, 70 internal error; 130 and 141 after Ctrl-C and a closed pipe.
"""

from __future__ import annotations

import gc
import json
import os
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from certify.arguments import numbers, plant_of
from certify.errors import BackendError, CertifyError, InputError, SoundnessError
from certify.terminal import ProgressLine, closed_pipe, say, show, tell

if TYPE_CHECKING:
    from certify.lyapunov import Candidate
    from certify.policies import Policy
    from certify.results import RoaResult
    from certify.roa import RoaOptions
    from certify.systems import System

app = typer.Typer(
    help="Regions of attraction of plants controlled by tanh networks, proved and independently checked.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)

_INTERRUPTED = 130  # as a shell reports SIGINT
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
    claim: Annotated[
        str,
        typer.Option(help="asymptotic (converges to the origin) or practical (enters a small set and stays there)."),
    ] = "asymptotic",
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
    from certify.report import summary
    from certify.roa import RoaOptions, certify_roa

    start = time.perf_counter()
    stored = load_policy(policy)
    plant = plant_of(stored, system, param or [], domain or [])
    tell(_plant_line(stored, plant, system is not None))
    shift = stored.beta_shift(plant.exact_u_eq())
    if shift:
        tell(f"the file's rounded beta is read as the real number; this shifts u(0) by {shift:.3g}")
    options = RoaOptions(
        claim=claim,  # type: ignore[arg-type]
        candidate=candidate,  # type: ignore[arg-type]
        Q=numbers(q, "--Q"),
        R=numbers(r, "--R"),
        level=level,
        engine=_engine(context, engine),  # type: ignore[arg-type]
        dreal_precision=precision,
        jobs=jobs,
        device=_device(device),
        time_limit=time_limit,
        max_boxes=max_boxes,
    )
    folder = out if out is not None else Path("out") / policy.stem
    progress = ProgressLine()
    try:
        result = certify_roa(
            plant,
            stored.network,
            folder,
            options,
            load_seconds=time.perf_counter() - start,
            provenance=_provenance(policy),
            progress=progress,
        )
    finally:
        progress.close()
    data = result.to_dict()
    if result.notice is not None:
        tell(result.notice)
    if result.certificate is not None and result.raw is not None:
        data["candidates"] = _candidates(result, options, compare) if claim == "asymptotic" else []
        answer = None if result.checker is None else dict(result.checker)
        _write(folder / "report.html", _page(result.raw, result.certificate, answer, data))
    if as_json:
        say(json.dumps(data))
    else:
        show(summary(data))
        if result.certificate is not None:
            say(f"certificate  {result.certificate}\nreport       {folder / 'report.html'}")
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
    from certify.claims import Asymptotic, conditions
    from certify.claims.queries import query
    from certify.engines.dreal.backend import to_smt2
    from certify.policies import load_policy
    from certify.roa import RoaOptions, certify_roa
    from certify.verdict import Verdict

    stored = load_policy(policy)
    plant = plant_of(stored, system, param or [], domain or [])
    options = RoaOptions(candidate=candidate, level=level, time_limit=time_limit)  # type: ignore[arg-type]
    result = certify_roa(plant, stored.network, out, options)
    inner, outer = result.levels.local, result.levels.roa
    if result.verdict is not Verdict.PROVED or result.problem is None or inner is None or outer is None:
        raise InputError(f"there are no levels to export; {result.verdict.value}: {result.reason}")
    outer = outer if level is not None else max(inner, 0.99 * outer)
    written = []
    for condition in conditions(Asymptotic(roa=outer, local=inner), result.problem):
        path = out / f"{condition.name}.smt2"
        text = to_smt2(query(condition, result.problem), "unsat (proved by the bounds engine, accepted by the checker)")
        _write(path, text)
        written.append(str(path))
    say(json.dumps({"files": written}) if as_json else "\n".join(written))


@app.command()
def check(
    certificate: Annotated[Path, typer.Argument(help="Certificate file.")],
    policy: Annotated[
        Path | None, typer.Option(help="Policy file that the certificate must be about (compares hashes).")
    ] = None,
    reference: Annotated[
        bool, typer.Option("--reference", help="Ask the second checker (fractions and balls): slower, shares no code.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Check a certificate with the independent checker, in a process of its own."""
    from certify.certificate.checking import ask

    wanted = None
    if policy is not None:
        from certify.policies import load_policy

        wanted = load_policy(policy).network.sha256()
    status, answer = ask(certificate, "reference" if reference else "checker")
    lines = answer.pop("text", [])
    if wanted is not None and "policy_sha256" in answer and answer["policy_sha256"] != wanted:
        detail = f"the certificate is about policy {answer['policy_sha256']}, not about {policy} ({wanted})"
        answer = {"result": "REJECTED", "rule": "policy", "at": "policy.sha256", "detail": detail}
        status, lines = 1, [f"REJECTED rule=policy at=policy.sha256: {detail}"]
    if "error" in answer and not as_json:
        raise typer.Exit(_fail(False, answer["error"], status))
    say(json.dumps(answer) if as_json else "\n".join(lines))
    raise typer.Exit(status)


@app.command()
def report(
    certificate: Annotated[Path, typer.Argument(help="Certificate file.")],
    out: Annotated[Path | None, typer.Option(help="HTML file; default: report.html beside the certificate.")] = None,
    as_json: Json = False,
) -> None:
    """Check a certificate and draw its report."""
    import tempfile

    from certify.certificate import read_raw, run_checker

    target = out if out is not None else certificate.parent / "report.html"
    raw = read_raw(certificate)
    with tempfile.TemporaryDirectory() as folder:  # what is checked is what is drawn, whatever happens to the path
        private = Path(folder) / "certificate.json"
        private.write_bytes(raw)
        answer = run_checker(private)
    _write(target, _page(raw, certificate, answer, None))
    stated = {"report": str(target), "result": answer["result"]}
    say(json.dumps(stated) if as_json else f"{answer['result']}  {target}")
    raise typer.Exit({"ACCEPTED": 0, "TRUSTED": 3}.get(answer["result"], 1))


@app.command()
def systems(as_json: Json = False) -> None:
    """List the plants that ship, with their parameters, domain and input bounds."""
    from certify.systems import available_systems, get_system

    found = [get_system(name) for name in available_systems()]
    if as_json:
        say(json.dumps({"systems": [_describe(s) for s in found]}))
        return
    for s in found:
        lines = [f"{s.name}: {s.description}"]
        lines += [f"  {symbol}' = {expression}" for symbol, expression in zip(s.states, s.dynamics, strict=True)]
        lines += [f"  {name} = {float(value):g} {s.units.get(name, '')}" for name, value in s.parameters.items()]
        for symbols, intervals in ((s.states, s.domain), (s.inputs, s.input_bounds)):
            for symbol, (lo, hi) in zip(symbols, intervals, strict=True):
                lines.append(f"  {symbol} in [{float(lo):g}, {float(hi):g}] {s.units.get(symbol.name, '')}")
        say("\n".join(lines))


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
        return closed_pipe()
    except Exception as error:  # the last resort: no traceback reaches a user
        return _fail(as_json, f"internal error: {type(error).__name__}: {error}", 70)


def _fail(as_json: bool, message: str, status: int) -> int:
    if as_json:
        try:
            say(json.dumps({"error": message}))
        except typer.Exit as closed:
            return closed.exit_code
    else:
        tell(f"certify: {message}")
    return status


def _page(raw: bytes, path: Path, answer: dict[str, Any] | None, data: dict[str, Any] | None) -> str:
    """The report on a certificate's bytes, with the checker's answer about them and what the run says, if there are."""
    import hashlib

    from certify.certificate import parse_certificate
    from certify.report import render_html

    read, sha256 = parse_certificate(raw, str(path)), hashlib.sha256(raw).hexdigest()
    return render_html(read, answer, data, path, sha256=sha256, size=len(raw))


def _candidates(result: RoaResult, options: RoaOptions, compare: bool) -> list[dict[str, Any]]:
    """The volumes within reach of the other candidates, sampled, beside the one that was proved."""
    from dataclasses import asdict

    from certify.candidates import compare_candidates

    known = {} if result.candidate is None or result.problem is None else {result.candidate: result.problem.V.P}
    names: list[Candidate] = ["lyapunov", "lqr"]
    if compare or "optimised" in known:
        names.append("optimised")
    rows = compare_candidates(result.system, result.network, options, known, names)
    return [{**asdict(row), "proved": row.candidate in known} for row in rows]


def _device(name: str) -> str:
    import torch

    if name == "cpu" or (name.startswith("cuda") and torch.cuda.is_available()):
        return name
    raise InputError(f"--device must be cpu, or cuda on a machine that has it; found {name!r}.")


def _engine(context: typer.Context, name: str) -> str:
    """The engine; without dReal, one that only the environment names falls back to bounds with a notice."""
    from certify.engines.dreal.backend import find_backend

    source = context.get_parameter_source("engine")
    if name in ("dreal", "both") and source is not None and source.name == "ENVIRONMENT":
        try:
            find_backend()
        except BackendError as error:
            tell(f"engine bounds in the place of {name}: {error}")
            return "bounds"
    return name


def _plant_line(stored: Policy, plant: System, overridden: bool) -> str:
    values = ", ".join(f"{name} = {float(q):g}" for name, q in plant.parameters.items())
    source = "from the command line" if overridden else "from the policy file"
    layers = "-".join(map(str, stored.network.layers))
    return f"plant {plant.name} ({source}) with {values or 'no parameters'}; policy {layers}"


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
    from certify.certificate import write_atomically

    write_atomically(path, text.encode())
