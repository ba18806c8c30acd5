"""Where work is done: on threads of this machine. Another place is another `Runner`."""

from __future__ import annotations

from certify.running.base import Bound, Runner
from certify.running.threads import ThreadRunner

__all__ = ["Bound", "Runner", "ThreadRunner"]
