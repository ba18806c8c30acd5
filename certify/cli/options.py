"""Parameters of a command made of options that are declared elsewhere; the command receives them as one value."""

from __future__ import annotations

import functools
import inspect
import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from inspect import Parameter
from typing import Annotated, Any, get_type_hints

import typer
from typer.core import TyperCommand

from certify.analysis.arguments import changes_of
from certify.analysis.changes import PlantChanges
from certify.analysis.declaration import declared
from certify.analysis.options import RoaOptions

FIRST, LOOP, OUTPUT = "To begin with", "The loop", "Output"
_PANELS = {
    "loop": LOOP,
    "claim": "The claim",
    "candidate": "The candidate",
    "effort": "Effort and engine",
    "output": OUTPUT,
}


@dataclass(frozen=True, slots=True)
class Bundle:
    """Parameters that a command receives as one value: what `read` makes of those that are given, by name."""

    parameters: Mapping[str, Parameter]
    read: Callable[[Mapping[str, Any]], Any]


class Grouped(TyperCommand):
    """A command whose help shows its options by panels."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the arguments, and then each panel in its order."""
        panels: dict[str, list[Any]] = {panel: [] for panel in ("Arguments", FIRST, "Options", *_PANELS.values())}
        for one in self.get_params(ctx):
            panel = "Arguments" if one.param_type_name == "argument" else OUTPUT if one.name == "help" else "Options"
            panel = getattr(one, "rich_help_panel", None) or panel
            panels.setdefault(panel, []).append(one.get_help_record(ctx))
        for panel, records in panels.items():
            if records:
                with formatter.section(panel):
                    formatter.write_dl(records, col_max=24)


def parameter(name: str, typed: str, help_: str, of: Any = str, required: bool = False, **shown: Any) -> Parameter:
    """A parameter of a command for an option; one that is not given is None, a flag False."""
    default = Parameter.empty if required else False if of is bool else None
    kind = of | None if default is None else of
    annotation: Any = Annotated[kind, typer.Option(typed, help=help_, **shown)]
    return Parameter(name, Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


def takes(**bundles: Bundle) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a command the parameters of each bundle instead of its parameter of that name."""

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        own, parameters = inspect.signature(command), list[Parameter]()
        hints = get_type_hints(command, localns={"ImportOptions": object}, include_extras=True)
        for name, one in own.parameters.items():
            if name in bundles:
                parameters += bundles[name].parameters.values()
            else:
                parameters.append(one.replace(annotation=hints[name], kind=Parameter.KEYWORD_ONLY))

        @functools.wraps(command)
        def wrapped(**given: Any) -> None:
            read = {}
            for receives, bundle in bundles.items():
                found = {name: given.pop(name) for name in bundle.parameters}
                read[receives] = bundle.read({name: v for name, v in found.items() if v not in (None, False)})
            command(**given, **read)

        wrapped.__signature__ = own.replace(parameters=parameters)  # type: ignore[attr-defined]
        wrapped.__annotations__ = {p.name: p.annotation for p in parameters}
        return wrapped

    return decorate


def options_of_a_run(*names: str, required: Collection[str] = (), **otherwise: str) -> Bundle:
    """Options of a run, all or those that are named, some with another default; the command receives texts by field."""
    return Bundle(_declared(RoaOptions, names, required, otherwise), lambda typed: otherwise | dict(typed))


def changes_of_a_plant(*names: str) -> Bundle:
    """Changes of a plant, all or those that are named; the command receives a `PlantChanges`."""
    return Bundle(_declared(PlantChanges, names), changes_of)


def _declared(
    kind: type, names: Collection[str], required: Collection[str] = (), otherwise: Mapping[str, str] | None = None
) -> dict[str, Parameter]:
    found, others = {}, otherwise or {}
    for name, option in declared(kind).items():
        if option.typed and (name in names or not names):
            of: Any = {"flag": bool, "ranges": list[str], "comparisons": list[str]}.get(option.kind, str)
            default = others.get(name, option.default)
            said = "" if default in (None, False) else f"[default: {_shown(default)}]"
            help_ = " ".join(filter(None, (option.help, option.written, said)))
            shown: dict[str, Any] = {"rich_help_panel": FIRST if option.first else _PANELS[option.group]}
            if of is not bool:
                shown |= {"metavar": option.metavar, "envvar": option.variable}
            found[name] = parameter(name, option.typed, help_, of, name in required, **shown)
    return found


def options_of(command: Any) -> dict[str, str]:
    """The options of a command of click by the names that Python has for them."""
    return {one.name: max(one.opts, key=len) for one in command.params if one.param_type_name == "option"}


def as_typed(message: str, options: Mapping[str, str]) -> str:
    """A message with each option in backquotes as it is typed.

    >>> as_typed("`time_limit` must be positive, unlike `P`.", {"time_limit": "--time-limit"})
    '--time-limit must be positive, unlike `P`.'
    """
    return re.sub(r"`([A-Za-z_]+)`", lambda found: options.get(found[1], found[0]), message)


def _shown(value: Any) -> str:
    return ",".join(map(str, value)) if isinstance(value, tuple) else str(value).removesuffix(".0")
