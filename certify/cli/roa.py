"""`certify roa`."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from certify.cli.arguments import layers, numbers, plant_of, region, widths
from certify.cli.certifying import CONTAINS, certified
from certify.cli.importing import policy_of
from certify.cli.shared import (
    Domain,
    Json,
    PlantName,
    PolicyArgument,
    PolicyFile,
    Quiet,
    Results,
    Resume,
    TimeLimit,
    the_policy,
)
from certify.cli.terminal import tell
from certify.errors import BackendError, InputError
from certify.report.drawing import Drawing

if TYPE_CHECKING:
    from certify.analysis.maximise import Quantity
    from certify.loop.policies.importers import ImportOptions

_MOST = "max"


def roa(
    context: typer.Context,
    importing: ImportOptions,
    file: PolicyArgument = None,
    policy: PolicyFile = None,
    system: PlantName = None,
    param: Annotated[
        list[str] | None,
        typer.Option(help="Parameter of the plant, NAME=VALUE, or NAME=LO..HI: proved for all of it; repeatable."),
    ] = None,
    disturbance: Annotated[
        list[str] | None,
        typer.Option(help="Disturbance that acts, NAME=D for any value within +-D at any time, or NAME=LO..HI."),
    ] = None,
    input_error: Annotated[
        str | None,
        typer.Option(help="Bound of what the inputs may be off by at any time: one number, or NAME=E,NAME=E."),
    ] = None,
    sample_time: Annotated[
        str | None,
        typer.Option(
            help="Period over which the input is held, as in 0.02; LO..HI: any sequence of periods between them; max: "
            "the longest for which the set proved without one can still be proved."
        ),
    ] = None,
    domain: Domain = None,
    claim: Annotated[
        str,
        typer.Option(
            help="asymptotic (converges to the origin), practical (enters a small set and stays there), nearby (that, "
            "and converges to one equilibrium in it, if that can be shown), or auto: the first if the loop rests at "
            "the origin exactly, the last if not."
        ),
    ] = "auto",
    around: Annotated[
        str,
        typer.Option(
            help="Where V is 0 if the loop does not rest at the origin: origin, rest (the point at which it does), or "
            "auto: the point of rest, if it is stable."
        ),
    ] = "auto",
    candidate: Annotated[
        str,
        typer.Option(
            help="Lyapunov candidate: auto (of all, the largest proved; with --Q or --level lyapunov, with --R lqr), "
            "lyapunov, scaled, lqr, optimised, robust, peak (practical claims, a small floor), neural or polynomial "
            "(auto, and a function learned for a set beyond its ellipsoid)."
        ),
    ] = "auto",
    q: Annotated[str | None, typer.Option("--Q", help="Diagonal of Q, as in 1,1.")] = None,
    r: Annotated[str | None, typer.Option("--R", help="Diagonal of R (candidate lqr), as in 1.")] = None,
    rate: Annotated[
        str,
        typer.Option(
            help="Prove that V falls at least as exp(-2 RATE t), in discrete time by the share 2 RATE a step; max: the "
            "largest for which the set proved without one can still be proved."
        ),
    ] = "0",
    level: Annotated[
        float | None,
        typer.Option(help="Prove exactly this level c2, of the reachability-enlarged set; less is not PROVED."),
    ] = None,
    engine: Annotated[
        str, typer.Option(envvar="CERTIFY_ENGINE", help="bounds, dreal (trusted, not checked), or both.")
    ] = "bounds",
    precision: Annotated[float, typer.Option(help="dReal's delta.")] = 1e-3,
    jobs: Annotated[
        int | None,
        typer.Option(min=1, max=256, help="Processes of the checker (default: a core each), and dReal's threads (1)."),
    ] = None,
    cluster: Annotated[
        str | None,
        typer.Option(
            help="Have boxes grown by the workers of a Dask cluster: local:N for N processes of this machine, or a "
            "scheduler's address, such as tcp://host:8786."
        ),
    ] = None,
    cluster_checks: Annotated[
        bool,
        typer.Option("--cluster-checks", help="Its workers check the certificate as well, in parts, and are believed."),
    ] = False,
    resume: Resume = False,
    enlarge: Annotated[
        bool, typer.Option("--enlarge", help="Look for a tube that leads from a larger set into the proved one.")
    ] = False,
    box: Annotated[
        str | None,
        typer.Option(
            help="Enlarge for the largest multiple of an ellipsoid with these half-axes, as in x=0.4,phi=0.2."
        ),
    ] = None,
    lyapunov: Annotated[
        Path | None,
        typer.Option(
            help="File of a function N (certify-lyapunov/1): prove the largest {N <= n2} in the domain from which "
            "every trajectory enters the proved ellipsoid, that with which N was learned if the file says so and no "
            "candidate is named."
        ),
    ] = None,
    lyapunov_level: Annotated[float | None, typer.Option(help="Prove exactly this n2.")] = None,
    hidden: Annotated[str, typer.Option(help="Widths of the layers that the candidate neural learns.")] = "16,16",
    degree: Annotated[int, typer.Option(help="Degree of the candidate polynomial, even.")] = 4,
    seed: Annotated[int, typer.Option(help="Seed of what is learned.")] = 0,
    contains: Annotated[
        str | None,
        typer.Option(help="Say whether the proved set contains a state or a box, as in x=1.57,x_dot=-1..1."),
    ] = None,
    time_limit: TimeLimit = 50.0,
    max_boxes: Annotated[int, typer.Option(help="Boxes for the ring.")] = 4_000_000,
    out: Results = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Certify a region of attraction: prove, write a certificate, have it checked, report."""
    start, drawing = time.perf_counter(), context.with_resource(Drawing())
    from certify.analysis.inputs import ellipsoid_beside, function_in
    from certify.analysis.options import RoaOptions

    largest = _largest(sample_time, rate, resume)
    path = the_policy(context, file, policy)
    stored = policy_of(path, importing, system, param or [])
    plant = plant_of(
        stored,
        system,
        param or [],
        domain or [],
        disturbance or [],
        input_error,
        None if sample_time == _MOST else sample_time,
    )
    beyond, P = None if lyapunov is None else function_in(lyapunov, plant, tell), None
    if beyond is not None and candidate == "auto" and q is None and r is None and level is None:
        P = ellipsoid_beside(beyond, plant)
    options = RoaOptions(
        claim=claim,  # type: ignore[arg-type]
        around=around,  # type: ignore[arg-type]
        candidate=candidate,  # type: ignore[arg-type]
        Q=numbers(q, "--Q"),
        R=numbers(r, "--R"),
        P=P,
        level=level,
        engine=_engine(context, engine),  # type: ignore[arg-type]
        dreal_precision=precision,
        jobs=jobs,
        cluster=cluster,
        cluster_checks=cluster_checks,
        resume=resume,
        enlarge=enlarge,
        box=widths(box, "--box"),
        time_limit=time_limit,
        max_boxes=max_boxes,
        rate=0.0 if rate == _MOST else _number(rate),
        lyapunov=None if beyond is None else beyond.function,
        lyapunov_level=lyapunov_level,
        hidden=layers(hidden, "--hidden"),
        degree=degree,
        seed=seed,
    )
    if contains is not None:
        region(contains, plant, CONTAINS)  # what cannot be read is said before the run
    certified(context, path, stored, plant, options, out, start, drawing, quiet, as_json, contains, largest)


def _largest(sample_time: str | None, rate: str, resume: bool) -> Quantity | None:
    """What is to be as large as can be proved, if anything is."""
    if resume and (sample_time == _MOST or rate == _MOST):
        raise InputError("--resume goes on with one search; ask for a period or a rate in the place of max.")
    if sample_time == _MOST and rate != "0":
        raise InputError("--sample-time max must stand without --rate; found both. Ask for one of them at a time.")
    return "period" if sample_time == _MOST else "rate" if rate == _MOST else None


def _number(rate: str) -> float:
    try:
        return float(rate)
    except ValueError as error:
        raise InputError(f"--rate takes a number of at least 0, or max; found {rate!r}.") from error


def _engine(context: typer.Context, name: str) -> str:
    """The engine; without dReal, one that only the environment names falls back to bounds with a notice."""
    source = context.get_parameter_source("engine")
    if name in ("dreal", "both") and source is not None and source.name == "ENVIRONMENT":
        from certify.provers.dreal.backend import find_backend

        try:
            find_backend()
        except BackendError as error:
            tell(f"engine bounds in the place of {name}: {error}")
            return "bounds"
    return name
