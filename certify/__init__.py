"""Regions of attraction of plants controlled by tanh networks, proved and independently checked.

`import certify` loads nothing heavy: public names are resolved on first use (PEP 562).
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

_PUBLIC = {
    "CertifyError": "certify.errors",
    "InputError": "certify.errors",
    "Verdict": "certify.verdict",
    "System": "certify.systems",
    "get_system": "certify.systems",
    "TanhNetwork": "certify.policies",
    "Policy": "certify.policies",
    "load_policy": "certify.policies",
    "save_policy": "certify.policies",
    "ClosedLoop": "certify.closed_loop",
    "certify_roa": "certify.roa",
    "RoaResult": "certify.results",
    "RoaOptions": "certify.options",
}

__version__ = "0.1.0"
__all__ = ["__version__", *_PUBLIC]  # noqa: PLE0604


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        return getattr(import_module(_PUBLIC[name]), name)
    raise AttributeError(f"module 'certify' has no attribute {name!r}")
