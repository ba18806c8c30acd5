"""`certify learn-lyapunov`."""

from __future__ import annotations

import json
import shlex
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from certify.analysis.arguments import options_of
from certify.analysis.changes import PlantChanges
from certify.analysis.inputs import plant_of, policy_in
from certify.cli.importing import import_options
from certify.cli.options import changes_of_a_plant, options_of_a_run, takes
from certify.cli.shared import Json, PlantName, PolicyArgument, PolicyFile, Quiet, given_words, noting, the_policy
from certify.cli.terminal import ProgressLine, say
from certify.effort import WHOLE, Effort
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

_FOR_ELLIPSOID = 0.4  # the largest share of the effort
_TIMES = 2.4  # the effort of a proof: that of ellipsoid and learning


@takes(
    importing=import_options(),
    changes=changes_of_a_plant("parameters", "domain"),
    typed=options_of_a_run("hidden", "degree", "seed", "effort", "time_limit"),
)
def learn_lyapunov(
    context: typer.Context,
    *,
    out: Annotated[Path, typer.Option(help="Lyapunov file to write (.pt).")],
    file: PolicyArgument = None,
    policy: PolicyFile = None,
    system: PlantName = None,
    changes: PlantChanges,
    typed: dict[str, Any],
    as_json: Json = False,
    quiet: Quiet = False,
    importing: ImportOptions,
) -> None:
    """Learn a second function N from simulated runs, for a set beyond the ellipsoid that `roa --lyapunov` proves."""
    from certify.loop.closed_loop import ClosedLoop
    from certify.lyapunov import save_lyapunov, volume
    from certify.lyapunov.function import Quadratic
    from certify.lyapunov.learning import fit_polynomial, learn

    start = time.monotonic()
    if {"hidden", "degree"} <= typed.keys():
        raise InputError("--hidden must stand without --degree; found both. A polynomial has no layers.")
    note, path = noting(quiet), the_policy(context, file, policy)
    stored = policy_in(path, importing, system, changes, note)
    plant = plant_of(stored, system, changes, note)
    options = options_of(typed, plant, note)
    effort = Effort(_TIMES * options.effort * WHOLE, options.time_limit)
    progress = None if quiet else ProgressLine()
    try:
        P, c2 = _ellipsoid(plant, stored, effort.share(_FOR_ELLIPSOID), progress)
        loop, V = ClosedLoop(plant, stored.network), Quadratic(P)
        tell_round = None if progress is None else _shown(progress)
        learned = (
            fit_polynomial(loop, V, c2, options.degree, options.seed, effort, tell_round)
            if "degree" in typed
            else learn(loop, V, c2, options.hidden, options.seed, effort, tell_round)
        )
    finally:
        if progress is not None:
            progress.close()
    record: dict[str, Any] = {
        "seed": options.seed,
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
    say(json.dumps(data) if as_json else _text(learned, volume(P, c2), out, _next(context, path, out)))


def _ellipsoid(plant: System, stored: Policy, effort: Effort, progress: ProgressLine | None) -> tuple[Array, float]:
    """A proved region of attraction, into which trajectories are to fall.

    Raises
    ------
    InputError : none is proved with that effort.
    """
    from certify.analysis.options import RoaOptions
    from certify.analysis.run import certify_roa
    from certify.certificates.verdict import Verdict

    with tempfile.TemporaryDirectory() as folder:
        found = certify_roa(
            plant, stored.network, Path(folder), RoaOptions(candidate="ellipsoid"), progress=progress, effort=effort
        )
    if found.verdict is not Verdict.PROVED or found.P is None or found.levels.roa is None:
        raise InputError(
            "an ellipsoid must be proved before a function beyond it is learned; the verdict on one is "
            f"{found.verdict.value}. See certify roa, or give more --effort."
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


def _next(context: typer.Context, policy: Path, out: Path) -> str:
    """The command that proves the learned function."""
    given = given_words(context, only={"system", "parameters", "domain"})
    return shlex.join(["certify", "roa", "--policy", str(policy), *given, "--lyapunov", str(out)])
