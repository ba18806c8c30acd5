"""Shared by several commands: an option, a report on a certificate's bytes, a file written in one step."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from certify.cli.options import FIRST, LOOP, OUTPUT
from certify.cli.terminal import tell
from certify.errors import InputError

if TYPE_CHECKING:
    from certify.analysis.inputs import Tell
    from certify.loop.plants import Measurements, System

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object instead of text.", rich_help_panel=FIRST)]
PolicyFile = Annotated[
    Path | None,
    typer.Option("--policy", metavar="FILE", help="The policy file, as the argument FILE.", rich_help_panel=LOOP),
]
PolicyArgument = Annotated[
    Path | None, typer.Argument(metavar="FILE", help="Policy file (.pt), or another program's; see certify import.")
]
PlantName = Annotated[
    str | None,
    typer.Option(
        metavar="PLANT",
        help="Plant: a name, FILE.toml, or FILE.py:NAME, whose code is run. By default the policy file says it.",
        rich_help_panel=FIRST,
    ),
]
Results = Annotated[
    Path | None,
    typer.Option(metavar="FOLDER", help="Folder for the results. By default out/POLICY.", rich_help_panel=FIRST),
]
Quiet = Annotated[
    bool, typer.Option("--quiet", help="No progress and no notices, errors only.", rich_help_panel=OUTPUT)
]


def the_policy(context: typer.Context, file: Path | None, policy: Path | None) -> Path:
    """The policy file, given as the argument or with --policy.

    Raises
    ------
    InputError : none is given, or two different files.
    """
    if file is not None and policy is not None and file.resolve() != policy.resolve():
        raise InputError(f"one policy file must be named; found {file} and --policy {policy}. Leave one of them out.")
    found = policy if policy is not None else file
    if found is None:
        raise InputError(f"a policy file must be named, as in certify {context.info_name} policy.pt; found none.")
    return found


def noting(quiet: bool) -> Tell:
    """The function that receives notices."""
    return (lambda _: None) if quiet else tell


def given_words(
    context: typer.Context,
    changed: Mapping[str, str] | None = None,
    only: Collection[str] | None = None,
    without: Collection[str] = (),
) -> list[str]:
    """The words that were given to the command, but for options that are `changed` or named in `without`; of the
    parameters in `only`, if there are such."""
    parts, changed = list[str](), changed or {}
    for option in context.command.params:
        source = context.get_parameter_source(option.name or "")
        name, value = max(option.opts, key=len), context.params[option.name or ""]
        if source is None or source.name != "COMMANDLINE" or name in without:
            continue
        if name in changed and not option.multiple:
            continue
        if only is not None and option.name not in only:
            continue
        values = list(value) if isinstance(value, list | tuple) else [value]
        if option.param_type_name == "argument":
            parts += map(str, values)
            continue
        if name in changed:  # NAME=VALUE options replace those of the same name
            values = [v for v in values if v.partition("=")[0] != changed[name].partition("=")[0]]
        for each in values:
            parts += [name] if each is True else [name, str(each)]
    return parts


def page_of(raw: bytes, path: Path, answer: dict[str, Any] | None, data: dict[str, Any] | None) -> str:
    """The report on a certificate's bytes, with the checker's answer and the run's data where they exist."""
    from certify.provers.execution.threads import one_thread
    from certify.report import drawn

    with one_thread():
        return drawn.page_of(raw, path, answer, data)


def describe(s: System) -> dict[str, Any]:
    """A plant as plain values; equations, operating point and domain are in the states' values, not deviations."""
    from certify.loop.plants import constraints_of_values, domain_of_values, dynamics_of_values

    domain, x_eq, u_eq = domain_of_values(s), s.exact_x_eq(), s.exact_u_eq()
    return {
        "name": s.name,
        "description": s.description,
        "time": s.time,
        "states": [x.name for x in s.states],
        "inputs": [u.name for u in s.inputs],
        "parameters": {name: str(q) for name, q in s.parameters.items()},
        "disturbances": [w.name for w in s.disturbances],
        "ranges": {name: [str(lo), str(hi)] for name, (lo, hi) in s.ranges.items()},
        "data": None if s.measurements is None else settings(s, s.measurements),
        "domain": {x.name: [str(lo), str(hi)] for x, (lo, hi) in zip(s.states, domain, strict=True)},
        "input_bounds": {u.name: [str(lo), str(hi)] for u, (lo, hi) in zip(s.inputs, s.input_bounds, strict=True)},
        "dynamics": {x.name: str(e) for x, e in zip(s.states, dynamics_of_values(s), strict=True)},
        "x_eq": {x.name: str(q) for x, q in zip(s.states, x_eq, strict=True)},
        "u_eq": {u.name: str(q) for u, q in zip(s.inputs, u_eq, strict=True)},
        "units": dict(s.units),
        "angles": list(s.angles),
        "constraints": {name: f"{e} < 0" for name, e in constraints_of_values(s).items()},
    }


def settings(s: System, data: Measurements) -> dict[str, Any]:
    """The table `data` of a plant's file as plain values."""
    return {
        "sha256": data.sha256,
        "period": None if data.period is None else [str(h) for h in data.period],
        "noise": {x.name: str(w) for x, w in zip(s.states, data.noise, strict=True)},
        "priors": {name: [str(lo), str(hi)] for name, (lo, hi) in data.priors.items()},
    }


def write(path: Path, text: str) -> None:
    from certify.certificates import write_atomically

    write_atomically(path, text.encode())
