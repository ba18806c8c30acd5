"""Draw a report in a separate process, which loads the drawing libraries while the proof is still running.

The drawing library takes as long to load as the proof of a small plant, and the verdict does not need it. The process
has the import path of this one, and draws the figures while the checker works. It gets the checker's answer later;
without it there is no page. If the process fails for any reason, the page is drawn in this process, and a failure is
reported as any other.
"""

from __future__ import annotations

import base64
import json
import os
import subprocess
import sys
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any, Self

_LAUNCH = """
import gc, json, sys
gc.set_threshold(100_000)
sys.path[:] = json.loads(sys.argv[1])
from certify.report.drawing import draw_one
draw_one()
"""
_NEEDED = (
    "matplotlib.figure", "matplotlib.backends.backend_svg", "scipy.ndimage",
    "certify.report.drawn", "certify.report.page",
)  # fmt: skip
_FITS = 2**15  # bytes of a certificate; a pipe holds twice as many


class Drawing:
    """A process that gets ready to draw one report; it has ended when the context is left, drawn or not."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._begun: bytes | None = None

    def __enter__(self) -> Self:
        line = [sys.executable, "-P", "-c", _LAUNCH, json.dumps(sys.path)]
        with suppress(OSError):
            # In a session of its own it leaves an interrupt from the keyboard to this process, which ends it.
            self._process = subprocess.Popen(
                line, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, start_new_session=True
            )
        return self

    def __exit__(self, *_: object) -> None:
        process, self._process, self._begun = self._process, None, None
        if process is None:
            return
        process.kill()
        process.wait()
        for end in (process.stdin, process.stdout):
            with suppress(OSError):
                if end is not None:
                    end.close()

    def begin(self, raw: bytes, path: Path, spent: float) -> None:
        """Start drawing the figures of a certificate that is about to be checked, `spent` seconds after the run began.

        The last call counts, and earlier drawings are dropped. For a large certificate nothing is drawn yet: it does
        not fit into the pipe, and its checker needs every core.
        """
        if self._begun is not None:
            self.__exit__()
            self.__enter__()
        process = self._process
        if len(raw) > _FITS or process is None or process.stdin is None:
            return
        with suppress(OSError):  # it has ended
            process.stdin.write(_first(raw, path, spent))
            process.stdin.flush()
            self._begun = raw

    def page_of(self, raw: bytes, path: Path, answer: dict[str, Any] | None, data: dict[str, Any] | None) -> str:
        """Write the page like `certify.report.drawn.page_of`, with the same errors."""
        if self._begun not in (None, raw):
            self.__exit__()
        first = b"" if self._begun == raw else _first(raw, path, None)
        process = self._process
        if process is not None and process.poll() is None:
            page, _ = process.communicate(first + _line({"answer": answer, "data": data}))
            if process.returncode == 0:
                return page.decode("utf-8")
        from certify.report import drawn

        return drawn.page_of(raw, path, answer, data)


def _first(raw: bytes, path: Path, spent: float | None) -> bytes:
    """The first line of a request; with None for the time no figure is drawn before the second."""
    return _line({"certificate": base64.b64encode(raw).decode("ascii"), "path": str(path), "spent": spent})


def _line(message: dict[str, Any]) -> bytes:
    return json.dumps(message).encode("ascii") + b"\n"


def draw_one() -> None:
    """Run in the process: load everything, read the certificate and the facts about it, write the page."""
    for module in _NEEDED:
        import_module(module)
    import matplotlib

    from certify.report import drawn, page, sheet
    from certify.report.figures import style

    sheet.template(*page.TEMPLATE)
    with matplotlib.rc_context(style.RC):
        style.to_svg(style.figure_of(2.0, 2.0)[0])  # fonts are looked for once
    about = json.loads(sys.stdin.buffer.readline())
    raw, path, spent = base64.b64decode(about["certificate"]), Path(about["path"]), about["spent"]
    figures = None if spent is None else drawn.figures_if_accepted(raw, path, spent)
    known = json.loads(sys.stdin.buffer.readline())
    made = drawn.page_of(raw, path, known["answer"], known["data"], figures)
    sys.stdout.buffer.write(made.encode("utf-8"))
    sys.stdout.buffer.flush()
    os._exit(0)  # somebody waits for the end, and what is in memory goes with it
