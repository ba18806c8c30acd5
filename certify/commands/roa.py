"""`certify roa`."""

from __future__ import annotations

import json
import shlex
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from certify.commands.arguments import numbers, plant_of, region, widths
from certify.commands.contains import stated, text
from certify.commands.importing import policy_of
from certify.commands.shared import Json, page_of, write
from certify.commands.terminal import ProgressLine, say, show, tell
from certify.errors import BackendError, InputError

if TYPE_CHECKING:
    from certify.containment import Box
    from certify.policies import Policy
    from certify.policies.importers import ImportOptions
    from certify.results import RoaResult
    from certify.systems import System


def roa(
    context: typer.Context,
    policy: Annotated[Path, typer.Option(help="Policy file (.pt), or another program's (see certify import).")],
    importing: ImportOptions,
    system: Annotated[
        str | None,
        typer.Option(
            help="Plant: a name, FILE.toml, or FILE.py:NAME, whose code is run; default: what the policy file says."
        ),
    ] = None,
    param: Annotated[list[str] | None, typer.Option(help="Parameter of the plant, NAME=VALUE; repeatable.")] = None,
    domain: Annotated[
        list[str] | None, typer.Option(help="Half-width NAME=D or interval NAME=LO:HI of a state; repeatable.")
    ] = None,
    claim: Annotated[
        str,
        typer.Option(
            help="asymptotic (converges to the origin), practical (enters a small set and stays there), or auto: the "
            "first if the loop rests at the origin exactly."
        ),
    ] = "auto",
    candidate: Annotated[
        str,
        typer.Option(
            help="Lyapunov candidate: auto (of all, the largest proved), lyapunov, scaled, lqr, optimised, robust."
        ),
    ] = "auto",
    q: Annotated[str | None, typer.Option("--Q", help="Diagonal of Q, as in 1,1.")] = None,
    r: Annotated[str | None, typer.Option("--R", help="Diagonal of R (candidate lqr), as in 1.")] = None,
    level: Annotated[float | None, typer.Option(help="Prove exactly this level; less is not PROVED.")] = None,
    engine: Annotated[
        str, typer.Option(envvar="CERTIFY_ENGINE", help="bounds, dreal (trusted, not checked), or both.")
    ] = "bounds",
    precision: Annotated[float, typer.Option(help="dReal's delta.")] = 1e-3,
    jobs: Annotated[int, typer.Option(help="dReal's threads.")] = 1,
    device: Annotated[str, typer.Option(help="cpu or cuda.")] = "cpu",
    enlarge: Annotated[
        bool, typer.Option("--enlarge", help="Look for a tube that leads from a larger set into the proved one.")
    ] = False,
    box: Annotated[
        str | None,
        typer.Option(
            help="Enlarge for the largest multiple of an ellipsoid with these half-axes, as in x=0.4,phi=0.2."
        ),
    ] = None,
    contains: Annotated[
        str | None,
        typer.Option(help="Say whether the proved set contains a state or a box, as in x=1.57,x_dot=-1..1."),
    ] = None,
    time_limit: Annotated[float, typer.Option(help="Seconds for everything up to the verdict.")] = 50.0,
    max_boxes: Annotated[int, typer.Option(help="Boxes for the ring.")] = 4_000_000,
    out: Annotated[Path | None, typer.Option(help="Folder for the results; default: out/POLICY.")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress and no notices, errors only.")] = False,
    as_json: Json = False,
) -> None:
    """Certify a region of attraction: prove, write a certificate, have it checked, report."""
    from certify.report import summary
    from certify.roa import RoaOptions, certify_roa

    start = time.perf_counter()
    stored = policy_of(policy, importing, system, param or [])
    plant = plant_of(stored, system, param or [], domain or [])
    note = (lambda _: None) if quiet else tell
    note(_plant_line(stored, plant, system is not None))
    shift = stored.beta_shift(plant.exact_u_eq())
    if shift:
        note(f"the file's rounded beta is read as the real number; this shifts u(0) by {shift:.3g}")
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
        enlarge=enlarge,
        box=widths(box, "--box"),
        time_limit=time_limit,
        max_boxes=max_boxes,
    )
    asked = None if contains is None else region(contains, plant, "--contains")
    folder = out if out is not None else Path("out") / policy.stem
    progress = None if quiet else ProgressLine()
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
        if progress is not None:
            progress.close()
    data = result.to_dict()
    if data["diagnosis"] is not None and data["diagnosis"]["next"]["options"]:
        data["diagnosis"]["next"]["command"] = _command(context, data["diagnosis"]["next"]["options"])
    if result.notice is not None:
        note(result.notice)
    if result.certificate is not None and result.raw is not None:
        answer = None if result.checker is None else dict(result.checker)
        write(folder / "report.html", page_of(result.raw, result.certificate, answer, data))
    where = None if asked is None else _where(result, asked)
    if where is not None:
        data["contains"] = where[0]
    if as_json:
        say(json.dumps(data))
    else:
        show(summary(data))
        if where is not None:
            say(where[1])
        if result.certificate is not None:
            say(f"certificate  {result.certificate}\nreport       {folder / 'report.html'}")
    raise typer.Exit(result.verdict.exit_status)


def _where(result: RoaResult, box: Box) -> tuple[dict[str, Any], str]:
    """Whether the proved set contains a box, for JSON and in words, from the very bytes that were checked."""
    from certify.containment import NOTHING_PROVED, set_of
    from certify.verdict import Verdict

    found = NOTHING_PROVED
    if result.verdict is Verdict.PROVED and result.raw is not None:
        found = set_of(result.raw, str(result.certificate)).locate(box)
    return stated(found, box, result.system), text(found, box, result.system)


def _command(context: typer.Context, changed: Mapping[str, str]) -> str:
    """The command that was given, with these options in the place of what it had."""
    parts = ["certify", "roa"]
    for option in context.command.params:
        source = context.get_parameter_source(option.name or "")
        name, value = max(option.opts, key=len), context.params[option.name or ""]
        if source is None or source.name != "COMMANDLINE" or (name in changed and not option.multiple):
            continue
        values = list(value) if isinstance(value, list | tuple) else [value]
        if name in changed:  # NAME=VALUE options replace those of the same name
            values = [v for v in values if v.partition("=")[0] != changed[name].partition("=")[0]]
        for each in values:
            parts += [name] if each is True else [name, str(each)]
    return shlex.join([*parts, *(part for pair in changed.items() for part in pair if part)])


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
    from certify.installation import versions

    return {"policy": policy.name, **versions()}
