"""Writing certificates; reading them for reports. Their meaning is the checker's FORMAT.md."""

from __future__ import annotations

from certify.certificate.model import (
    INNER,
    Certificate,
    PartitionTree,
    TrustedSolver,
    parse_certificate,
    read_certificate,
    read_raw,
    write_certificate,
)
from certify.certificate.tree import leaves

__all__ = [
    "INNER",
    "Certificate",
    "PartitionTree",
    "TrustedSolver",
    "leaves",
    "parse_certificate",
    "read_certificate",
    "read_raw",
    "write_certificate",
]
