"""Writing certificates; reading them for reports. Their meaning is the checker's FORMAT.md."""

from __future__ import annotations

from certify.certificate.model import (
    Certificate,
    PartitionTree,
    TrustedSolver,
    read_certificate,
    write_certificate,
)

__all__ = ["Certificate", "PartitionTree", "TrustedSolver", "read_certificate", "write_certificate"]
