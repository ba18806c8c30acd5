"""Early ends of a command: Ctrl-C, SIGTERM, or a reader that closed the pipe.

A closed pipe (`certify roa … 2>&1 | head -2`) ends a command with the status that a shell reports for SIGPIPE. Click
and rich would exit with status 1, which means REFUTED among the verdicts; this module catches their exit.
"""

from __future__ import annotations

import os
import select
import signal
import sys
import threading
from types import FrameType

INTERRUPTED = 130  # as a shell reports SIGINT
CLOSED_PIPE = 141  # as a shell reports SIGPIPE


class Interrupted(Exception):
    """Ctrl-C ends a command; the message names the work that is kept."""


def end_by_sigterm() -> None:
    """Let SIGTERM end this process like Ctrl-C: a batch system sends it when a job's time is over."""
    if threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGTERM) is signal.SIG_DFL:
        signal.signal(signal.SIGTERM, _terminate)


def _terminate(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def is_of_closed_pipe(stop: SystemExit) -> bool:
    """True if click or rich raised this exit because the pipe is closed."""
    return isinstance(stop.__context__, BrokenPipeError)


def closed_pipe() -> int:
    """Discard further output of closed pipes; return the exit status, which is no verdict."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    poll = select.poll()
    for number in (1, 2):
        poll.register(number, 0)  # an error is always reported
    for number, _ in poll.poll(0):
        os.dup2(nowhere, number)
    os.close(nowhere)
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    return CLOSED_PIPE
