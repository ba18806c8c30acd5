"""What the command line shows: results on standard output, everything else on standard error."""

from __future__ import annotations

import os
import sys
import threading
import time
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from certify.engines.base import Progress

CLOSED_PIPE = 141  # as a shell reports SIGPIPE


def closed_pipe() -> int:
    """What is left to say goes nowhere: whoever read it has gone, which is no verdict."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return CLOSED_PIPE


def say(text: str) -> None:
    """Print the result, and be sure that it has left: a reader that has gone must not look like a verdict."""
    try:
        sys.stdout.write(text + "\n")
        sys.stdout.flush()
    except BrokenPipeError:
        raise typer.Exit(closed_pipe()) from None


def show(renderable: Any) -> None:
    """Print a table of rich."""
    from rich.console import Console

    console = Console(file=sys.stdout)
    with console.capture() as captured:
        console.print(renderable)
    say(captured.get().rstrip("\n"))


def tell(line: str) -> None:
    """A diagnostic, on standard error."""
    sys.stderr.write(line + "\n")


def _ring_line(state: Progress) -> str:
    left = "" if state.seconds_left is None else f", about {state.seconds_left:.0f} s left"
    return (
        f"ring: proved to V = {state.level:.4g} of {state.target:.4g} ({state.proved:.1%} of the volume), "
        f"{state.boxes} boxes, {state.open} open{left}"
    )


class ProgressLine:
    """A line on standard error, at most five times a second, only on a terminal."""

    def __init__(self) -> None:
        self.last = 0.0
        self.shown = False

    def __call__(self, stage: str, state: Progress | None) -> None:
        if stage == "check":  # the checker works in a process of its own: load the drawing libraries meanwhile
            from certify.report import warm_up

            threading.Thread(target=warm_up, daemon=True).start()
        now = time.monotonic()
        if sys.stderr.isatty() and now - self.last > 0.2:
            self.last, self.shown = now, True
            sys.stderr.write(f"\r{_ring_line(state) if state is not None else 'checking'}\x1b[K")
            sys.stderr.flush()

    def close(self) -> None:
        """Wipe the line."""
        if self.shown:
            sys.stderr.write("\r\x1b[K")
