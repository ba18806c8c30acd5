"""What the pages of this program have in common: a style sheet, and templates that are filled with every text escaped.

Nothing on a page is loaded from anywhere; what it shows stands in it.
"""

from __future__ import annotations

from importlib import resources
from typing import Any

from certify.report.figures.style import legend_style


def filled(package: str, template: str, **values: Any) -> str:
    """A template of a package with these values; it includes `style.html`, which knows `one_plane`."""
    import jinja2
    from markupsafe import Markup

    def source(of: str, name: str) -> str:
        return resources.files(of).joinpath(name).read_text(encoding="utf-8")

    environment = jinja2.Environment(
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        loader=jinja2.FunctionLoader(lambda name: source("certify.report", name)),
    )
    page = environment.from_string(source(package, template)).render(legend_style=Markup(legend_style()), **values)
    return str(page).encode("utf-8", "replace").decode("utf-8")  # a file's text may hold half a surrogate pair
