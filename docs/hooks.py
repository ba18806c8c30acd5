"""Pages of the site that would go stale if they were written by hand: commands with their options, and public names.

mkdocs calls the functions `on_...` for each page; the places are marked with a comment in the page. What the package
says of itself when the site is built is what the page shows, so that a command or a name that is added needs no page.
"""

from __future__ import annotations

import inspect
from typing import Any

import certify
from certify.analysis.studies.study import KNOWN
from certify.cli.main import command_line

COMMANDS, NAMES = "<!-- every command -->", "<!-- every public name -->"
OPTIONS = "<!-- every option of a study -->"


def on_page_markdown(markdown: str, **_: Any) -> str:
    """The page with its marks replaced."""
    if COMMANDS in markdown:
        markdown = markdown.replace(COMMANDS, commands())
    if NAMES in markdown:
        markdown = markdown.replace(NAMES, public_names())
    return markdown.replace(OPTIONS, ", ".join(f"`{key}`" for key in KNOWN))


def commands() -> str:
    """A section for each command of `certify`: its summary, arguments and options with their defaults."""
    group = command_line()
    sections = []
    for name, command in getattr(group, "commands", {}).items():
        lines = [
            f"## certify {name}",
            "",
            inspect.cleandoc(command.help or ""),
            "",
            "| option | what it says |",
            "|---|---|",
        ]
        for parameter in command.params:
            names = ", ".join(f"`{text}`" for text in (*parameter.opts, *parameter.secondary_opts))
            if parameter.param_type_name == "argument":
                names = f"`{parameter.name.upper()}`"
            said = " ".join((getattr(parameter, "help", None) or "").split()).replace("|", "\\|")
            if parameter.required:
                said += " Required."
            elif parameter.default not in (None, False, (), [], ""):
                said += f" Default: `{parameter.default}`."
            lines.append(f"| {names} | {said} |")
        sections.append("\n".join(lines))
    return "\n\n".join(sections)


def public_names() -> str:
    """A directive of mkdocstrings for each name that `certify` exports, where it is defined."""
    exported = (getattr(certify, name) for name in certify.__all__ if not name.startswith("_"))
    return "\n".join(f"::: {thing.__module__}.{thing.__qualname__}" for thing in exported)
