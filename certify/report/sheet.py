"""Shared by this program's pages: a style sheet, and templates that are filled with every text escaped.

A page loads nothing from anywhere; it contains everything that it shows.
"""

from __future__ import annotations

import functools
from importlib import resources
from typing import TYPE_CHECKING, Any

from certify.report.figures.style import legend_style

if TYPE_CHECKING:
    import jinja2


def filled(package: str, file: str, /, **values: Any) -> str:
    """A template of a package with these values; it includes `style.html`, which knows `one_plane`."""
    from markupsafe import Markup

    page = template(package, file).render(legend_style=Markup(legend_style()), **values)
    return str(page).encode("utf-8", "replace").decode("utf-8")  # a file's text may hold half a surrogate pair


@functools.cache
def template(package: str, name: str) -> jinja2.Template:
    """A page without its content; to read it takes as long as a figure."""
    import jinja2

    def source(of: str, name: str) -> str:
        return resources.files(of).joinpath(name).read_text(encoding="utf-8")

    environment = jinja2.Environment(
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        loader=jinja2.FunctionLoader(lambda name: source("certify.report", name)),
    )
    return environment.from_string(source(package, name))
