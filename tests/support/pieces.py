"""Pieces of work for tests of where work is done: functions that a child process or a worker can import."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Callable, Generator, Iterable
from pathlib import Path

from certify.provers.execution.tasks import Outcome, Piece


def double(text: str) -> bytes:
    return (2 * text).encode()


def process(_: str) -> bytes:
    return f"{os.getpid()} {os.getppid()}".encode()


def fail(text: str) -> bytes:
    raise ValueError(f"no\n{text}")


def die(_: str) -> bytes:
    os.kill(os.getpid(), signal.SIGKILL)
    return b""


def odd(_: str) -> bytes:
    return "text"  # type: ignore[return-value]


def linger(folder: str) -> bytes:
    """Say which process this is, and one that it has started; then stay."""
    child = subprocess.Popen(["sleep", "60"])
    (Path(folder) / f"{os.getpid()}.{child.pid}").touch()
    time.sleep(60)
    return b""


def slowly(name: str, folder: str, seconds: float) -> bytes:
    """Leave a mark with the process's number, and take some time."""
    (Path(folder) / f"{name}.{os.getpid()}").touch()
    time.sleep(seconds)
    return f"{name} {os.getpid()}".encode()


class Here:
    """A place of these tests: each piece is done at once, by a function of the piece or its own."""

    def __init__(self, do: Callable[[Piece], bytes | str | BaseException] | None = None) -> None:
        self.do, self.done = do, list[str]()

    def run(self, pieces: Iterable[Piece]) -> Generator[Outcome | None, None, None]:
        for piece in pieces:
            self.done.append(piece.key)
            found = piece.work(*piece.arguments) if self.do is None else self.do(piece)
            if isinstance(found, BaseException):
                raise found
            yield Outcome(piece.key, None, found) if isinstance(found, str) else Outcome(piece.key, found)
            yield None
