"""`certify reach`."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from certify.analysis.arguments import options_of, read_option, region
from certify.analysis.changes import PlantChanges
from certify.analysis.declaration import declared
from certify.analysis.inputs import plant_of, policy_in
from certify.cli.certifying import certified
from certify.cli.importing import import_options, kind_called
from certify.cli.options import FIRST, changes_of_a_plant, options_of_a_run, takes
from certify.cli.shared import Json, PlantName, PolicyArgument, PolicyFile, Quiet, Results, noting, the_policy
from certify.cli.without_v import concluded
from certify.errors import OptionError

if TYPE_CHECKING:
    from certify.loop.policies.importers import ImportOptions

_KIND = "--kind"  # the kind of another program's policy file: --from is the state
_CLAIM = "The claim"


@takes(
    importing=import_options(_KIND),
    changes=changes_of_a_plant(*(name for name in declared(PlantChanges) if name != "data")),
    typed=options_of_a_run("reach_from", "box", "resume", "effort", "time_limit", "jobs", "cluster"),
)
def reach(
    context: typer.Context,
    *,
    file: PolicyArgument = None,
    policy: PolicyFile = None,
    system: PlantName = None,
    changes: PlantChanges,
    typed: dict[str, Any],
    target: Annotated[
        list[str] | None,
        typer.Option(
            metavar="COMPARISON|FILE",
            help="Prove that this region is reached, in discrete time or with a held input, from which boxes of the "
            "domain, and in how many steps at most: a comparison of the states' values, such as 'position >= 0.45'; "
            "repeatable, for a region where all of them hold. Or FILE.json, a certificate about the same loop: its set "
            "{V <= c2} is then to be reached, after which its claim holds.",
            rich_help_panel=FIRST,
        ),
    ] = None,
    within: Annotated[
        str | None,
        typer.Option(
            metavar="STEPS|TIMEs",
            help="With --target: the most steps that it may take, or with a held input a time, as in 2.5s.",
            rich_help_panel=_CLAIM,
        ),
    ] = None,
    out: Results = None,
    as_json: Json = False,
    quiet: Quiet = False,
    importing: ImportOptions,
) -> None:
    """Prove that a state or a box converges, by a tube around a trajectory, or with --target that a region is reached,
    or the set of a certificate."""
    start, note, path = time.perf_counter(), noting(quiet), the_policy(context, file, policy)
    from certify.analysis.reaching import ReachOptions, certify_reach, into_set_of
    from certify.analysis.reaching.options import is_file, steps_within
    from certify.report.reached import summary

    with kind_called(_KIND):
        stored = policy_in(path, importing, system, changes, note)
    plant = plant_of(stored, system, changes, note)
    by_tube = target is None or (len(target) == 1 and is_file(target[0]) and not plant.in_steps)
    _require_one(target, within, typed, by_tube)
    if target is None or by_tube:
        options = options_of(typed, plant, note)
        options = options if target is None else into_set_of(Path(target[0]), plant, stored.network, options)
        certified(context, path, stored, plant, options, out, start, quiet, as_json)
        return
    asked = typed.pop("reach_from", None)
    towards = ReachOptions(
        target=tuple(target),
        begin=None if asked is None else region(asked, plant, "--from"),
        within=None if within is None else steps_within(within, plant),
        **{name: read_option(name, text) for name, text in typed.items()},
    )
    concluded(context, certify_reach, summary, path, stored, plant, towards, out, start, quiet, as_json)


def _require_one(target: list[str] | None, within: str | None, typed: dict[str, Any], by_tube: bool) -> None:
    """Refuse options that do not go together; `by_tube` says that a tube is looked for.

    Raises
    ------
    OptionError : there is neither a target nor a state, or an option belongs to the other question.
    """
    if target is None and "reach_from" not in typed:
        raise OptionError("`target` or `reach_from` must be given: a region that is to be reached, or a state or box.")
    if by_tube and "reach_from" not in typed:
        raise OptionError(
            "`reach_from` must be given: in continuous time a tube leads from a state or box into the set."
        )
    if by_tube and within is not None:
        raise OptionError("`within` needs a `target` that is reached in steps: how many it may take.")
    if not by_tube and (odd := [name for name in ("box", "resume") if name in typed]):
        raise OptionError(f"`{odd[0]}` is about a tube; leave it out where a `target` is given.")
