"""The proof that a region is reached: from which boxes, in how many steps; `certify reach --target`."""

from __future__ import annotations

from certify.analysis.reaching.options import ReachOptions
from certify.analysis.reaching.results import ReachResult
from certify.analysis.reaching.run import certify_reach

__all__ = ["ReachOptions", "ReachResult", "certify_reach"]
