"""Write certificates, run the checkers on them, read them for reports. The checker's FORMAT.md defines their meaning.

Names are resolved on first use (PEP 562): a check alone needs neither plants nor arithmetic.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from certify.certificates.checking import run_checker, run_part
    from certify.certificates.joining import join_parts
    from certify.certificates.limits import require_short, require_within_limits
    from certify.certificates.model import (
        Certificate,
        Contraction,
        LocalBall,
        OuterTree,
        PartitionTree,
        Slab,
        TrustedSolver,
        Waypoint,
        decode,
        encode,
        loop_sections,
        parse_certificate,
        read_certificate,
        read_raw,
    )
    from certify.certificates.tree import leaves
    from certify.certificates.writing import SEARCH, remove, set_aside, sole_writer, write_atomically, write_beside

_OTHERS = {
    "join_parts": "joining",
    "run_checker": "checking",
    "run_part": "checking",
    "require_short": "limits",
    "require_within_limits": "limits",
    "leaves": "tree",
    "SEARCH": "writing",
    "remove": "writing",
    "set_aside": "writing",
    "sole_writer": "writing",
    "write_atomically": "writing",
    "write_beside": "writing",
}

__all__ = [
    "SEARCH",
    "Certificate",
    "Contraction",
    "LocalBall",
    "OuterTree",
    "PartitionTree",
    "Slab",
    "TrustedSolver",
    "Waypoint",
    "decode",
    "encode",
    "join_parts",
    "leaves",
    "loop_sections",
    "parse_certificate",
    "read_certificate",
    "read_raw",
    "remove",
    "require_short",
    "require_within_limits",
    "run_checker",
    "run_part",
    "set_aside",
    "sole_writer",
    "write_atomically",
    "write_beside",
]


def __getattr__(name: str) -> Any:
    if name in __all__:
        return getattr(import_module(f"certify.certificates.{_OTHERS.get(name, 'model')}"), name)
    raise AttributeError(f"module 'certify.certificates' has no attribute {name!r}")
