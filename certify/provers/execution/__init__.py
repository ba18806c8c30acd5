"""The places where work is done: threads of this machine, or a cluster. Another place is another `Runner`."""

from __future__ import annotations

from certify.provers.execution.base import Bound, Counted, Jobs, Runner, Work
from certify.provers.execution.runners import runner_at
from certify.provers.execution.threads import ThreadRunner, in_pieces

__all__ = ["Bound", "Counted", "Jobs", "Runner", "ThreadRunner", "Work", "in_pieces", "runner_at"]
