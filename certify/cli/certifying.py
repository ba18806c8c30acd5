"""The run that `certify roa` and `certify reach` share: the notices before it, its files, its summary."""

from __future__ import annotations

import json
import shlex
import time
from collections.abc import Callable, Mapping
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import typer

from certify.analysis.arguments import region
from certify.certificates import SEARCH
from certify.cli.contains import stated, text
from certify.cli.ending import Interrupted
from certify.cli.options import as_typed, options_of
from certify.cli.shared import given_words, noting, write
from certify.cli.terminal import ProgressLine, say, show

if TYPE_CHECKING:
    from certify.analysis.maximise import Quantity
    from certify.analysis.options import RoaOptions
    from certify.analysis.results import RoaResult
    from certify.analysis.without_v import ResultWithoutV
    from certify.loop.plants import System
    from certify.loop.policies import Policy

CONTAINS = "--contains"
_OF_SEARCH = ("candidate", "Q", "R", "level")


def certified(
    context: typer.Context,
    policy: Path,
    stored: Policy,
    plant: System,
    options: RoaOptions,
    out: Path | None,
    start: float,
    quiet: bool,
    as_json: bool,
    asked: str | None = None,
    largest: Quantity | None = None,
) -> None:
    """Run, write certificate and report, print the result; ends the command with the verdict's exit status.

    Parameters
    ----------
    stored, plant : the policy in the file `policy`, and the plant that it is certified on.
    out : folder for the results.
    start : when the command began, by `time.perf_counter`.
    asked : a state or a box, as people write it; the result says if the proved set contains it.
    largest : the quantity that is to be as large as can be proved for the set.
    """
    from certify.report import summary
    from certify.report.drawing import Drawing

    note, drawing = noting(quiet), Drawing()
    note(_plant_line(stored, plant, context.params["system"] is not None))
    folder = out if out is not None else Path("out") / policy.stem

    def draw(raw: bytes) -> None:
        drawing.begin(raw, folder / "certificate.json")

    run = _run_for(largest, draw)
    progress, later = None if quiet else ProgressLine(), list[str]()
    try:
        about = {"load_seconds": time.perf_counter() - start, "provenance": _provenance(policy)}
        result = run(plant, stored.network, folder, options, progress=progress, tell=later.append, **about)
    except KeyboardInterrupt:
        if largest is not None or not (folder / SEARCH).exists():
            raise
        raise _interrupted(context, folder / SEARCH) from None
    finally:
        if progress is not None:
            progress.close()
        for line in later:
            note(line)
    if result.notice is not None:
        note(as_typed(result.notice, options_of(context.command)))
    data = _with_next_command(result.to_dict(), context, policy)
    finished(result, data, drawing.page_of, folder, summary, as_json, asked)


def finished(
    result: RoaResult | ResultWithoutV,
    data: dict[str, Any],
    page_of: Callable[..., str],
    folder: Path,
    summary: Callable[[Mapping[str, Any]], Any],
    as_json: bool,
    asked: str | None,
) -> NoReturn:
    """Write the report of a result with this JSON object, print it, and end the command with the verdict's exit status.

    Parameters
    ----------
    page_of, summary : make the page and what is printed.
    asked : a state or a box, as people write it; the result says if the proved set contains it.
    """
    if result.certificate is not None and result.raw is not None:
        answer, begin = None if result.checker is None else dict(result.checker), time.perf_counter()
        write(folder / "report.html", page_of(result.raw, result.certificate, answer, data))
        spent, total = time.perf_counter() - begin, data["seconds"].pop("total")
        data["seconds"] |= {"report": spent, "total": total + spent}
    where = None if asked is None else where_of(result, asked)
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


def _interrupted(context: typer.Context, search: Path) -> Interrupted:
    return Interrupted(
        f"interrupted; the search is kept in {search}, and the same command with --resume{_without(context)} "
        "continues it."
    )


def _run_for(largest: Quantity | None, draw: Callable[[bytes], None]) -> Callable[..., RoaResult]:
    """The function that certifies; `draw` gets the certificate's bytes while they are checked."""
    if largest is not None:
        from certify.analysis.maximise import certify_largest

        return partial(certify_largest, largest)
    from certify.analysis.run import certify_roa

    return partial(certify_roa, show=draw)


def _provenance(policy: Path) -> dict[str, str]:
    from certify.analysis.installation import versions

    return {"policy": policy.name, **versions()}


def _with_next_command(data: dict[str, Any], context: typer.Context, policy: Path) -> dict[str, Any]:
    """The result's data with what to type next, where an option or `controllers flatten` may help."""
    following = {} if data["diagnosis"] is None else data["diagnosis"]["next"]
    if following.get("flatten"):
        following["command"] = _flattened(context, policy)
    else:
        add_command(following, context)
    return data


def add_command(following: dict[str, Any], context: typer.Context) -> None:
    """Say in a next step what to type, if the command has the step's options."""
    if following.get("options") and following["options"].keys() <= set(options_of(context.command).values()):
        following["command"] = _command(context, following["options"])


def where_of(result: RoaResult | ResultWithoutV, asked: str) -> tuple[dict[str, Any], str]:
    """The answer if the proved set contains a box, for JSON and in words, from the very bytes that were checked.

    The box is read as of the result's plant, in whose deviations the set is: those of the plant that was asked about
    may be others.
    """
    from certify.certificates.membership import NOTHING_PROVED, set_of
    from certify.certificates.verdict import Verdict

    found, box = NOTHING_PROVED, region(asked, result.system, CONTAINS)
    if result.verdict is Verdict.PROVED and result.raw is not None:
        found = set_of(result.raw, str(result.certificate)).locate(box)
    return stated(found, box, result.system), text(found, box, result.system)


def _without(context: typer.Context) -> str:
    """Name the options that were given and that a resumed search has of its own."""
    given = _known(context)
    return f" and without {', '.join(given)}" if given else ""


def _known(context: typer.Context) -> list[str]:
    """The options that were given and that a resumed search has of its own; a learned function is no part of it."""
    from certify.lyapunov import BEYOND

    found = {f"--{key}": context.params.get(key) for key in _OF_SEARCH}
    return [name for name, value in found.items() if value not in (None, "auto", "ellipsoid", *BEYOND)]


def _command(context: typer.Context, changed: Mapping[str, str]) -> str:
    """The command that was given, with these options instead of its own; a resumed search has some already."""
    known = _known(context) if "--resume" in changed else []
    added = (part for pair in changed.items() for part in pair if part)
    return shlex.join(["certify", str(context.info_name), *given_words(context, changed, without=known), *added])


def _flattened(context: typer.Context, policy: Path) -> str:
    """The commands that import the policy if it is another program's, fine-tune it for proof, and certify the result.

    Each policy lies beside the one that it was made from."""
    from certify.analysis.inputs import is_own
    from certify.loop.policies.importers import ImportOptions

    foreign = {f.name for f in fields(ImportOptions)}
    others = {option.name or "" for option in context.command.params} - {"file", "policy", "resume"}
    flat, plant, commands = policy.with_name(f"{policy.stem}_flat.pt"), context.params["system"], list[list[str]]()
    if not is_own(policy, ImportOptions()):
        read = policy.with_name(f"{policy.stem}_imported.pt")
        said = given_words(context, only=foreign | {"system", "parameters"})
        said = ["--from" if part == "--kind" else part for part in said]
        commands.append(["certify", "import", str(policy), *said, "--out", str(read)])
        policy, others = read, others - foreign
    named = [] if plant is None else ["--system", plant]
    commands.append(["controllers", "flatten", str(policy), *named, "--out", str(flat)])
    commands.append(["certify", str(context.info_name), str(flat), *given_words(context, only=others)])
    return " && ".join(map(shlex.join, commands))


def _plant_line(stored: Policy, plant: System, overridden: bool) -> str:
    from certify.loop.plants import kind_of

    values = ", ".join(f"{name} = {float(q):g}{_within(plant, name)}" for name, q in plant.parameters.items())
    acting = [name for name in plant.ranges if name not in plant.parameters]
    moved = "".join(f"; {kind_of(plant, name)} {name}{_within(plant, name)}" for name in acting)
    source = "from the command line" if overridden else "from the policy file"
    layers = "-".join(map(str, stored.network.layers))
    return f"plant {plant.name} ({source}) with {values or 'no parameters'}{moved}; policy {layers}"


def _within(plant: System, name: str) -> str:
    """The range of an uncertain quantity, as it is proved for."""
    if name not in plant.ranges:
        return ""
    from certify.report.words import inside

    return f" in {inside(*plant.ranges[name])}"
