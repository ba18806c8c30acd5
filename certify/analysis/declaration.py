"""An option of a run as it is declared: once, at the field that holds its value.

The options of the command line, the keywords of `certify.certify_roa` and the keys of a study are made of these
declarations, and so is what is said of them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cache
from typing import Any, Literal

Group = Literal["loop", "claim", "candidate", "effort"]
Kind = Literal[
    "word",
    "number",
    "whole",
    "flag",
    "row",
    "layers",
    "widths",
    "box",
    "matrix",
    "file",
    "ranges",
    "bounds",
    "period",
    "comparisons",
]
"""The form of a value: `certify.analysis.arguments` reads it as text, `certify.analysis.values` as Python's."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Option:
    """A declared option.

    Parameters
    ----------
    name : the field that holds its value.
    default : its value where it is not given.
    must : what a value must be or do, in words, and the test of it.
    help : plain sentences, for the command line and for Python.
    written : how it is written on the command line.
    python : how it is given in Python.
    typed : the option of the command line, by default after the field; empty for one that only Python has.
    keyword : the keyword of Python, by default the field's name; empty for one that Python does not have.
    metavar : stands for the value in a help text.
    varies : studies take it.
    first : a newcomer needs it.
    variable : of the environment, which gives it where the command line does not.
    """

    name: str = ""
    default: Any
    group: Group
    kind: Kind
    must: tuple[str, Callable[[Any], bool]] | None = None
    help: str
    written: str = ""
    python: str = ""
    typed: str = "--"
    keyword: str = "="
    metavar: str = ""
    varies: bool = True
    first: bool = False
    variable: str | None = None

    @property
    def key(self) -> str:
        """Its key in a study: the option of the command line without dashes."""
        return self.typed.removeprefix("--").replace("-", "_")

    def require(self, value: Any, error: type[Exception]) -> None:
        """Refuse a value that breaks the option's rule, with this kind of error."""
        if value is not None and self.must is not None and not self.must[1](value):
            raise error(f"`{self.name}` must {self.must[0]}; found {_shown(value)}.")


def option(default: Any, group: Group, kind: Kind, must: Any = None, **more: Any) -> Any:
    """A field of a dataclass that declares an option; for `more` see `Option`."""
    declaration = Option(default=default, group=group, kind=kind, must=must, **more)
    return field(default=default, metadata={"option": declaration})


@cache
def declared(of: type) -> Mapping[str, Option]:
    """The options that a dataclass declares, by the names of its fields."""
    found = {}
    for one in fields(of):
        said: Option = one.metadata["option"]
        typed = f"--{one.name.replace('_', '-')}" if said.typed == "--" else said.typed
        metavar = said.metavar or typed.lstrip("-").replace("-", "_").upper()
        keyword = one.name if said.keyword == "=" else said.keyword
        found[one.name] = replace(said, name=one.name, typed=typed, metavar=metavar, keyword=keyword)
    return found


def _shown(value: Any) -> str:
    if isinstance(value, Mapping):
        ends = {name: each if isinstance(each, tuple) else (each,) for name, each in value.items()}
        return ", ".join(f"{name}={'..'.join(f'{float(end):g}' for end in each)}" for name, each in ends.items())
    return f"{value:g}" if isinstance(value, float) else repr(value)
