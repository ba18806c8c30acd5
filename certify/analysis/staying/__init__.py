"""The proof that a set is never left; `certify roa --claim invariant`."""

from __future__ import annotations

from certify.analysis.staying.results import InvariantResult
from certify.analysis.staying.run import certify_invariant

__all__ = ["InvariantResult", "certify_invariant"]
