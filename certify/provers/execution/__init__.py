"""Where work is done: on threads of this machine, or by a cluster. Another place is another `Runner`."""

from __future__ import annotations

from certify.provers.execution.base import Bound, Counted, Jobs, Runner, Work
from certify.provers.execution.threads import ThreadRunner, in_pieces

__all__ = ["Bound", "Counted", "Jobs", "Runner", "ThreadRunner", "Work", "in_pieces"]
