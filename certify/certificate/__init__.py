"""Writing certificates, having them checked, reading them for reports. Their meaning is the checker's FORMAT.md."""

from __future__ import annotations

from certify.certificate.checking import join_parts, run_checker, run_part
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
    decode,
    encode,
    loop_sections,
    parse_certificate,
    read_certificate,
    read_raw,
)
from certify.certificate.tree import leaves
from certify.certificate.writing import sole_writer, write_atomically, write_beside

__all__ = [
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
    "require_short",
    "require_within_limits",
    "run_checker",
    "run_part",
    "sole_writer",
    "write_atomically",
    "write_beside",
]
