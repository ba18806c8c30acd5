"""Write certificates, run the checkers on them, read them for reports. The checker's FORMAT.md defines their meaning.

Names are resolved on first use (PEP 562): a check alone needs neither plants nor arithmetic.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from certify.certificates.checking import run_checker
    from certify.certificates.encoding import decode, encode
    from certify.certificates.evidence import (
        Contraction,
        LocalBall,
        OuterTree,
        PartitionTree,
        RanksAlone,
        RankTree,
        Slab,
        TrustedSolver,
        Waypoint,
    )
    from certify.certificates.limits import require_short, require_within_limits
    from certify.certificates.model import (
        AnyCertificate,
        Certificate,
        InvariantCertificate,
        ReachCertificate,
        RemainCertificate,
        loop_sections,
    )
    from certify.certificates.reading import parse_any, parse_certificate, read_certificate, read_raw
    from certify.certificates.tree import leaves, leaves_within
    from certify.certificates.writing import (
        SEARCH,
        earlier_aside,
        remove,
        set_aside,
        sole_writer,
        write_atomically,
        write_beside,
    )

_NAMES = {
    "checking": ("run_checker",),
    "encoding": ("decode", "encode"),
    "evidence": (
        "Contraction",
        "LocalBall",
        "OuterTree",
        "PartitionTree",
        "RankTree",
        "RanksAlone",
        "Slab",
        "TrustedSolver",
        "Waypoint",
    ),
    "limits": ("require_short", "require_within_limits"),
    "model": (
        "AnyCertificate",
        "Certificate",
        "InvariantCertificate",
        "ReachCertificate",
        "RemainCertificate",
        "loop_sections",
    ),
    "reading": ("parse_any", "parse_certificate", "read_certificate", "read_raw"),
    "tree": ("leaves", "leaves_within"),
    "writing": ("SEARCH", "earlier_aside", "remove", "set_aside", "sole_writer", "write_atomically", "write_beside"),
}
_PLACES = {name: module for module, names in _NAMES.items() for name in names}

__all__ = [
    "SEARCH",
    "AnyCertificate",
    "Certificate",
    "Contraction",
    "InvariantCertificate",
    "LocalBall",
    "OuterTree",
    "PartitionTree",
    "RankTree",
    "RanksAlone",
    "ReachCertificate",
    "RemainCertificate",
    "Slab",
    "TrustedSolver",
    "Waypoint",
    "decode",
    "earlier_aside",
    "encode",
    "leaves",
    "leaves_within",
    "loop_sections",
    "parse_any",
    "parse_certificate",
    "read_certificate",
    "read_raw",
    "remove",
    "require_short",
    "require_within_limits",
    "run_checker",
    "set_aside",
    "sole_writer",
    "write_atomically",
    "write_beside",
]


def __getattr__(name: str) -> Any:
    if name in _PLACES:
        return getattr(import_module(f"certify.certificates.{_PLACES[name]}"), name)
    raise AttributeError(f"module 'certify.certificates' has no attribute {name!r}")
