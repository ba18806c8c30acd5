"""Pages of the site that would go stale if they were written by hand: commands with their options, and public names.

mkdocs calls the functions `on_...` for each page; the places are marked with a comment in the page. What the package
says of itself when the site is built is what the page shows, so that a command or a name that is added needs no page.
"""

from __future__ import annotations

import inspect
import re
from itertools import pairwise
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
    markdown = re.sub(r"```mermaid\n(.*?)```", lambda found: diagram(found[1]), markdown, flags=re.S)
    return markdown.replace(OPTIONS, ", ".join(f"`{key}`" for key in KNOWN))


def diagram(text: str) -> str:
    """A graph of boxes and arrows (`a --> b & c --> d` a line) as SVG, which needs no program from elsewhere."""
    arrows, trusted = list[tuple[str, str]](), re.findall(r"(\w+):::trusted", text)
    for line in text.splitlines():
        units = [[name.strip() for name in part.split("&")] for part in line.split("-->")]
        arrows += [(a, b) for sources, targets in pairwise(units) for a in sources for b in targets]
    column = {name: 0 for arrow in arrows for name in arrow} | dict.fromkeys(trusted, 0)
    for _ in column:  # each box right of all that point at it
        for a, b in arrows:
            column[b] = max(column[b], column[a] + 1)
    columns = [[name for name in column if column[name] == x] for x in range(1 + max(column.values()))]
    rows, wide, high = max(map(len, columns)), 15 * max(map(len, column)) // 2 + 26, 54
    step = wide + 34
    at = {
        name: (x * step + 2, (rows - len(names)) * high // 2 + y * high + 10)
        for x, names in enumerate(columns)
        for y, name in enumerate(names)
    }
    shapes = [
        f'<path d="M{x0 + wide} {y0 + 17}C{x0 + wide + 18} {y0 + 17} {x1 - 22} {y1 + 17} {x1 - 3} {y1 + 17}"/>'
        for (x0, y0), (x1, y1) in ((at[a], at[b]) for a, b in arrows)
    ]
    for name, (x, y) in at.items():
        kind = ' class="trusted"' if name in trusted else ""
        shapes += [f'<rect x="{x}" y="{y}" width="{wide}" height="34" rx="5"{kind}/>']
        shapes += [f'<text x="{x + wide // 2}" y="{y + 22}">{name}</text>']
    head = '<marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
    view = f"0 0 {len(columns) * step - 30} {rows * high}"
    tip = f'<defs>{head}<path class="tip" d="M0 0L8 4L0 8z"/></marker></defs>'
    return f'<svg class="diagram" role="img" viewBox="{view}">{tip}{"".join(shapes)}</svg>'


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
