"""How a command ends before it is done: by Ctrl-C, by SIGTERM, or because nobody reads any more what it says.

A reader that has gone (`certify roa … 2>&1 | head -2`) ends a command with the status that a shell reports for SIGPIPE.
Click and rich end it with status 1 then, which among verdicts means REFUTED: so their exit is recognised here.
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
    """A command ends by Ctrl-C, and the message says what is kept of its work."""


def end_by_sigterm() -> None:
    """Let SIGTERM end this process as Ctrl-C does: a batch system sends it when a job's time is over."""
    if threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGTERM) is signal.SIG_DFL:
        signal.signal(signal.SIGTERM, _terminate)


def _terminate(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def is_of_closed_pipe(stop: SystemExit) -> bool:
    """True if click or rich has raised this exit because a reader has gone."""
    return isinstance(stop.__context__, BrokenPipeError)


def closed_pipe() -> int:
    """Send what is left to say nowhere, where a reader has gone; the exit status, which is no verdict."""
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
