"""`certify learn-lyapunov`."""

from __future__ import annotations

import json
import shlex
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from certify.cli.arguments import layers, plant_of
from certify.cli.importing import policy_of
from certify.cli.shared import Domain, Json, PlantName, PolicyArgument, PolicyFile, Quiet, the_policy
from certify.cli.terminal import ProgressLine, say
from certify.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from certify.loop.plants import System
    from certify.loop.policies import Policy
    from certify.loop.policies.importers import ImportOptions
    from certify.lyapunov import Neural, Polynomial
    from certify.lyapunov.learning import Learned, Round

    Array = NDArray[np.float64]

_FOR_ELLIPSOID = 0.4  # of the time limit, at most
_HIDDEN = "16,16"


def learn_lyapunov(
    context: typer.Context,
    importing: ImportOptions,
    out: Annotated[Path, typer.Option(help="Lyapunov file to write (.pt).")],
    file: PolicyArgument = None,
    policy: PolicyFile = None,
    system: PlantName = None,
    param: Annotated[list[str] | None, typer.Option(help="Parameter of the plant, NAME=VALUE; repeatable.")] = None,
    domain: Domain = None,
    hidden: Annotated[
        str | None, typer.Option(help=f"Widths of the network between the states and its output; default: {_HIDDEN}.")
    ] = None,
    degree: Annotated[
        int | None, typer.Option(help="Fit a polynomial of this even degree instead of a network.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Random seed: the same seed learns the same function.")] = 0,
    time_limit: Annotated[float, typer.Option(help="Seconds for the ellipsoid and for learning.")] = 120.0,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Learn a second function N from simulated runs, for a set beyond the ellipsoid that `roa --lyapunov` proves."""
    from certify.loop.closed_loop import ClosedLoop
    from certify.lyapunov import save_lyapunov, volume
    from certify.lyapunov.function import Quadratic
    from certify.lyapunov.learning import fit_polynomial, learn

    start = time.monotonic()
    if hidden is not None and degree is not None:
        raise InputError("--hidden must stand without --degree; found both. A polynomial has no layers.")
    widths = layers(hidden or _HIDDEN, "--hidden")
    if not time_limit > 0:
        raise InputError(f"--time-limit must be positive; found {time_limit}.")
    path = the_policy(context, file, policy)
    stored = policy_of(path, importing, system, param or [])
    plant = plant_of(stored, system, param or [], domain or [])
    progress = None if quiet else ProgressLine()
    try:
        P, c2 = _ellipsoid(plant, stored, _FOR_ELLIPSOID * time_limit, progress)
        loop, V = ClosedLoop(plant, stored.network), Quadratic(P)
        left, tell_round = time_limit - (time.monotonic() - start), None if progress is None else _shown(progress)
        learned = (
            learn(loop, V, c2, widths, seed, left, tell_round)
            if degree is None
            else fit_polynomial(loop, V, c2, degree, seed, left, tell_round)
        )
    finally:
        if progress is not None:
            progress.close()
    record: dict[str, Any] = {
        "seed": seed,
        "rounds": len(learned.history),
        "sampled_level": learned.level,
        "sampled_cover": learned.cover,
        "P": V.P.tolist(),
        "c2": c2,
    }
    parameters = {name: str(q) for name, q in plant.parameters.items()}
    save_lyapunov(out, learned.function, plant.name, parameters, {"learned": record})
    data = {"lyapunov": str(out), "function": _described(learned.function), **record}
    data["seconds"] = time.monotonic() - start
    say(json.dumps(data) if as_json else _text(learned, volume(P, c2), out, _next(path, system, param, domain, out)))


def _ellipsoid(plant: System, stored: Policy, seconds: float, progress: ProgressLine | None) -> tuple[Array, float]:
    """Prove the ellipsoid that trajectories of the outer set have to enter.

    Raises
    ------
    InputError : none is proved in the time.
    """
    from certify.analysis.options import RoaOptions
    from certify.analysis.run import certify_roa
    from certify.certificates.verdict import Verdict

    with tempfile.TemporaryDirectory() as folder:
        found = certify_roa(plant, stored.network, Path(folder), RoaOptions(time_limit=seconds), progress=progress)
    if found.verdict is not Verdict.PROVED or found.P is None or found.levels.roa is None:
        raise InputError(
            "an ellipsoid must be proved before a function beyond it is learned; the verdict on one is "
            f"{found.verdict.value}. See certify roa, or give --time-limit more seconds."
        )
    return found.P, found.levels.roa


def _shown(progress: ProgressLine) -> Any:
    def shown(_: Round) -> None:
        progress("learn", None)

    return shown


def _described(function: Neural | Polynomial) -> dict[str, Any]:
    from certify.lyapunov import Polynomial

    if isinstance(function, Polynomial):
        return {"kind": "polynomial", "degree": function.degree, "terms": len(function.exponents)}
    return {"kind": "network", "layers": list(function.widths)}


def _text(learned: Learned, area: float, out: Path, command: str) -> str:
    from certify.lyapunov import Polynomial

    function = learned.function
    words = (
        f"polynomial of degree {function.degree}, {len(function.exponents)} terms"
        if isinstance(function, Polynomial)
        else f"network {'-'.join(map(str, function.widths))}"
    )
    last = learned.history[-1]
    return "\n".join([
        f"ellipsoid  of the volume {area:.6g}, proved",
        f"learned    {words}, in {len(learned.history)} rounds, {last.seconds:.0f} s",
        f"sampled    {{N <= {learned.level:.6g}}} and the ellipsoid hold {learned.cover:.1%} of the converging states",
        "           nothing is proved about N yet",
        f"written    {out}",
        f"next       {command}",
    ])  # fmt: skip


def _next(policy: Path, system: str | None, param: list[str] | None, domain: list[str] | None, out: Path) -> str:
    """The command that proves the learned function's set."""
    parts = ["certify", "roa", "--policy", str(policy)]
    parts += [] if system is None else ["--system", system]
    for name, values in (("--param", param), ("--domain", domain)):
        parts += [part for value in values or [] for part in (name, value)]
    return shlex.join([*parts, "--lyapunov", str(out)])
