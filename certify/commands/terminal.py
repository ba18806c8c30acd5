"""What the command line shows: results on standard output, everything else on standard error."""

from __future__ import annotations

import os
import shutil
import sys
import time
from importlib import import_module
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


def load_tables() -> None:
    """Import what tables are printed with, while there is time to."""
    for module in ("rich.box", "rich.console", "rich.table", "rich.text"):
        import_module(module)


def tell(line: str) -> None:
    """A diagnostic, on standard error."""
    sys.stderr.write(line + "\n")


def _ring_line(state: Progress) -> str:
    left = "" if state.seconds_left is None else f", at most {max(state.seconds_left, 0):.0f} s left"
    return (
        f"{state.name}: proved to V = {state.level:.4g} of {state.target:.4g} ({state.proved:.1%} of the volume), "
        f"{state.boxes} boxes, {state.open} open{left}"
    )


_STAGES = {
    "candidate": "choosing candidates",
    "ring": "proving",
    "tube": "looking for a tube",
    "learn": "learning beyond the ellipsoid",
    "outer": "proving beyond the ellipsoid",
    "check": "checking",
}


class ProgressLine:
    """A line on standard error that moves, at most five times a second; where that is no terminal, a line every ten
    seconds."""

    def __init__(self) -> None:
        self.terminal = sys.stderr.isatty()
        self.every = 0.2 if self.terminal else 10.0
        self.last = time.monotonic() - (self.every if self.terminal else 0.0)
        self.shown = 0

    def __call__(self, stage: str, state: Progress | None) -> None:
        now = time.monotonic()
        if now - self.last < self.every:
            return
        self.last = now
        line = _ring_line(state) if state is not None else _STAGES[stage]
        if self.terminal:
            line = line[: shutil.get_terminal_size().columns - 1]
            self.shown = len(line)
            sys.stderr.write(f"\r{line}\x1b[K")
        else:
            sys.stderr.write(line + "\n")
        sys.stderr.flush()

    def close(self) -> None:
        """Wipe the line."""
        if self.shown:
            sys.stderr.write("\r\x1b[K")
