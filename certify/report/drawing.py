"""Draw a report's figures in a thread, while the process waits for the checker's.

The drawing library takes as long to load as the proof of a small plant, and the verdict does not need it. The checker's
answer comes later; without it there is no page. If the thread fails for any reason, the figures are drawn again with
the page, and a failure is reported as any other.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from certify.report.page import Figures

_MOST = 2**15  # bytes of a certificate: the checker of a larger one may need every core


class Drawing:
    """The figures of a certificate that is about to be checked."""

    def __init__(self) -> None:
        self._thread: Thread | None = None
        self._drawn: dict[bytes, Figures | None] = {}

    def begin(self, raw: bytes, path: Path) -> None:
        """Start drawing the figures of a certificate that is about to be checked.

        The first call counts: what follows a refusal is drawn with the page. So is a large certificate.
        """
        if self._thread is None and len(raw) <= _MOST:
            self._thread = Thread(target=self._draw, args=(raw, path), daemon=True)
            self._thread.start()

    def page_of(self, raw: bytes, path: Path, answer: dict[str, Any] | None, data: dict[str, Any] | None) -> str:
        """Write the page like `certify.report.drawn.page_of`, with the same errors."""
        from certify.report import drawn

        if self._thread is not None:
            self._thread.join()
        return drawn.page_of(raw, path, answer, data, self._drawn.get(raw))

    def _draw(self, raw: bytes, path: Path) -> None:
        from certify.report import drawn

        with suppress(Exception):  # the page comes upon it again
            self._drawn[raw] = drawn.figures_if_accepted(raw, path)
