"""Writing certificates, having them checked, reading them for reports. Their meaning is the checker's FORMAT.md.

Names are resolved on first use (PEP 562): who only has a file checked needs neither plants nor arithmetic.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from certify.certificate.checking import run_checker
    from certify.certificate.limits import require_short, require_within_limits
    from certify.certificate.model import (
        Certificate,
        Contraction,
        LocalBall,
        OuterTree,
        PartitionTree,
        Slab,
        TrustedSolver,
        Waypoint,
        parse_certificate,
        read_certificate,
        read_raw,
    )
    from certify.certificate.tree import leaves
    from certify.certificate.writing import sole_writer, write_atomically, write_beside

_OTHERS = {
    "run_checker": "checking",
    "require_short": "limits",
    "require_within_limits": "limits",
    "leaves": "tree",
    "sole_writer": "writing",
    "write_atomically": "writing",
    "write_beside": "writing",
}

__all__ = [
    "Certificate",
    "Contraction",
    "LocalBall",
    "OuterTree",
    "PartitionTree",
    "Slab",
    "TrustedSolver",
    "Waypoint",
    "leaves",
    "parse_certificate",
    "read_certificate",
    "read_raw",
    "require_short",
    "require_within_limits",
    "run_checker",
    "sole_writer",
    "write_atomically",
    "write_beside",
]


def __getattr__(name: str) -> Any:
    if name in __all__:
        return getattr(import_module(f"certify.certificate.{_OTHERS.get(name, 'model')}"), name)
    raise AttributeError(f"module 'certify.certificate' has no attribute {name!r}")
