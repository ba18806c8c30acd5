"""Reports: a summary for the terminal and one self-contained HTML page. They only read certificates.

`import certify.report` loads neither matplotlib nor jinja2: public names are resolved on first use (PEP 562), and
the drawing library only when a page is rendered.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

# At once, because the function and its module share a name; the module is light.
from certify.report.summary import summary

if TYPE_CHECKING:
    from certify.report.page import render_html
    from certify.report.sampling import SimulatedRoa, simulated_roa_fraction

__all__ = ["SimulatedRoa", "render_html", "simulated_roa_fraction", "summary"]

_PUBLIC = {
    "render_html": "certify.report.page",
    "simulated_roa_fraction": "certify.report.sampling",
    "SimulatedRoa": "certify.report.sampling",
}


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        return getattr(import_module(_PUBLIC[name]), name)
    raise AttributeError(f"module 'certify.report' has no attribute {name!r}")
