"""Terminal output: results on standard output, everything else on standard error."""

from __future__ import annotations

import math
import shutil
import sys
import time
from typing import TYPE_CHECKING, Any, TextIO

from certify.cli.ending import closed_pipe

if TYPE_CHECKING:
    from certify.provers.base import Progress


def say(text: str) -> None:
    """Print the result and flush it: a closed pipe must not look like a verdict."""
    _put(sys.stdout, text + "\n")


def _put(stream: TextIO, text: str) -> None:
    try:
        stream.write(text)
        stream.flush()
    except BrokenPipeError:
        import typer

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
    _put(sys.stderr, line + "\n")


def ring_line(stage: str, state: Progress) -> str:
    """The progress of a proof in one line: the level of V, or of N for the outer set, or the share of boxes."""
    left = "" if state.seconds_left is None else f", at most {max(state.seconds_left, 0):.0f} s left"
    if stage in ("ranks", "set"):
        covered = math.floor(1000 * state.proved) / 10
        return f"{stage}: {covered:.1f} % of the box is proved, {state.boxes} boxes, {state.open} open{left}"
    letter, name = ("N", "beyond the ellipsoid") if stage == "outer" else ("V", state.name)
    proved = f"{letter} = {state.level:.4g}"
    aim = f"down to {proved}, the aim is" if state.down else f"to {proved} of"
    share = math.floor(1000 * state.proved) / 10  # 100 % only if all is proved
    return (
        f"{name}: proved {aim} {state.target:.4g} ({share:.1f} % of the volume), "
        f"{state.boxes} boxes, {state.open} open{left}"
    )


_STAGES = {
    "candidate": "choosing candidates",
    "ring": "proving",
    "tube": "looking for a tube",
    "simulate": "simulating runs",
    "learn": "learning beyond the ellipsoid",
    "outer": "proving beyond the ellipsoid",
    "function": "learning a function",
    "set": "proving that the set is not left",
    "ranks": "proving ranks of boxes",
    "check": "checking",
}


class ProgressLine:
    """A progress line on standard error: rewritten at most five times a second on a terminal, else one line every ten
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
        line = ring_line(stage, state) if state is not None else _STAGES[stage]
        if self.terminal:
            line = line[: shutil.get_terminal_size().columns - 1]
            self.shown = len(line)
            _put(sys.stderr, f"\r{line}\x1b[K")
        else:
            tell(line)

    def close(self) -> None:
        """Erase the line."""
        if self.shown:
            _put(sys.stderr, "\r\x1b[K")
