"""The proof that a region or a certified set is reached, from which boxes and when; `certify reach --target`."""

from __future__ import annotations

from certify.analysis.reaching.goals import into_set_of
from certify.analysis.reaching.options import ReachOptions
from certify.analysis.reaching.results import ReachResult
from certify.analysis.reaching.run import certify_reach

__all__ = ["ReachOptions", "ReachResult", "certify_reach", "into_set_of"]
