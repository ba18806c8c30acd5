"""How a page looks in a browser: narrow, wide, dark and printed. Facts are measured; the pictures are kept where
`CERTIFY_SCREENSHOTS` says, for eyes.

A Chromium must be installed (`apt-get install chromium`); without one these tests are skipped.
"""

from __future__ import annotations

import io
import json
import os
import unicodedata
from collections.abc import Iterator
from pathlib import Path

import pypdf
import pytest

from certify.analysis.run import RoaOptions, certify_roa
from certify.certificates import read_certificate
from certify.loop.plants import get_system
from certify.loop.policies import load_policy
from certify.report import render_html
from tests.report.test_tube import soft_spring
from tests.support.browser import Browser, find_browser
from tests.support.loops import chain
from tests.support.marks import slow_after

PROGRAM = find_browser()
pytestmark = pytest.mark.skipif(PROGRAM is None, reason="no Chromium is installed (apt-get install chromium)")
PENDULUM = Path(__file__).parent.parent.parent / "examples" / "policies" / "pendulum.pt"
LOOKS = [(400, False), (1400, True), (400, True), (1400, False), (800, False), (800, True)]
"""Widths in pixels, and if the reader's choice is dark."""

CONTRAST = """(() => {
  const light = c => { const v = c / 255; return v <= .04045 ? v / 12.92 : ((v + .055) / 1.055) ** 2.4; };
  const parts = s => s.match(/[\\d.]+/g).map(Number);
  const bright = p => .2126 * light(p[0]) + .7152 * light(p[1]) + .0722 * light(p[2]);
  const ground = e => { for (; e; e = e.parentElement) { const p = parts(getComputedStyle(e).backgroundColor);
    if (p.length < 4 || p[3] > 0) return p; } return [255, 255, 255]; };
  const found = [];
  for (const e of document.querySelectorAll('body *')) {
    if (![...e.childNodes].some(n => n.nodeType === 3 && n.textContent.trim())) continue;
    const a = bright(parts(getComputedStyle(e).color)), b = bright(ground(e));
    found.push([(Math.max(a, b) + .05) / (Math.min(a, b) + .05), e.textContent.trim().slice(0, 60)]);
  }
  return JSON.stringify(found.sort((p, q) => p[0] - q[0]).slice(0, 3));
})()"""


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A page of two states, one of four, one with a tube and one around a path, as a run leaves them."""
    found = {}
    loops = {
        "pendulum": (get_system("pendulum"), load_policy(PENDULUM).network),
        "chain": chain(4, [-1.0, -2.0, -3.0, -4.0]),
        "tube": soft_spring(),
        "path": soft_spring(),
    }
    for name, (system, network) in loops.items():
        folder = tmp_path_factory.mktemp(name)
        asked = {"p": 1.2, "v": 0.5} if name == "path" else None
        options = RoaOptions(candidate="lyapunov", enlarge=name == "tube", reach_from=asked, effort=0.02)
        result = certify_roa(system, network, folder, options, provenance={"numpy": "1.2.3"})
        assert result.certificate is not None and result.checker is not None
        data = result.to_dict()
        data["diagnosis"]["next"]["command"] = "certify roa --policy " + "a/very/long/path/" * 8 + "policy.pt"
        html = render_html(read_certificate(result.certificate), dict(result.checker), data, result.certificate)
        found[name] = folder / "report.html"
        found[name].write_text(html)
    return found


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    assert PROGRAM is not None
    with Browser(PROGRAM, tmp_path_factory.mktemp("profile")) as opened:
        yield opened


def keep(name: str, content: bytes) -> None:
    """For eyes, if somebody said where."""
    if folder := os.environ.get("CERTIFY_SCREENSHOTS"):
        Path(folder).mkdir(parents=True, exist_ok=True)
        (Path(folder) / name).write_bytes(content)


@pytest.mark.parametrize(("width", "dark"), slow_after(2, LOOKS))
@pytest.mark.parametrize("name", slow_after(1, ["pendulum", "chain", "tube", "path"]))
def test_a_page_fits_and_can_be_read(
    browser: Browser, pages: dict[str, Path], name: str, width: int, dark: bool
) -> None:
    browser.show(pages[name], width, dark=dark)
    content = browser.picture()
    keep(f"{name}-{width}-{'dark' if dark else 'light'}.png", content)
    assert content.startswith(b"\x89PNG")
    assert browser.evaluate("innerWidth") == width
    assert browser.evaluate("document.documentElement.scrollWidth") <= width  # no horizontal scroll bar
    worst = json.loads(browser.evaluate(CONTRAST))
    assert worst[0][0] >= 4.5, worst  # WCAG 2, level AA
    ground = browser.evaluate("getComputedStyle(document.querySelector('main')).backgroundColor")
    assert (ground == "rgb(255, 255, 255)") == (not dark)
    pictures = browser.evaluate("[...document.images].every(i => i.complete && i.naturalWidth > 0)")
    assert pictures is True
    # Text in a drawing is at least 8 pixels high: its points are fonts of 8 and more at the drawing's own width.
    scale = "Math.min(...[...document.images].map(i => i.getBoundingClientRect().width / i.naturalWidth))"
    assert browser.evaluate(scale) * 8 * 96 / 72 >= 7.9
    overlapping = browser.evaluate(
        "(() => { const a = document.querySelector('.toc').getBoundingClientRect(), "
        "b = document.querySelector('#claim').getBoundingClientRect(); "
        "return a.bottom > b.top && a.right > b.left; })()"
    )
    assert overlapping is False


def test_a_full_bar_reaches_the_end_of_its_frame(browser: Browser, pages: dict[str, Path]) -> None:
    """The frame shows how long a bar can be, and fills its column up to the number."""
    browser.show(pages["pendulum"], 800)
    bar, filled, number = json.loads(
        browser.evaluate(
            "JSON.stringify(['.bar', '.bar i', '.track + .num'].map(s => "
            "document.querySelector(`table.shares tbody ${s}`).getBoundingClientRect()).map(r => [r.left, r.right]))"
        )
    )
    assert filled[0] == bar[0] and filled[1] == pytest.approx(bar[1], abs=0.01 * bar[1])
    assert 0 <= number[0] - bar[1] < 30
    assert browser.evaluate("getComputedStyle(document.querySelector('.bar')).outlineStyle") == "solid"


def test_every_section_stands_on_the_pages_paper(browser: Browser, pages: dict[str, Path]) -> None:
    for page in pages.values():
        browser.show(page, 800)
        bottoms = browser.evaluate(
            "JSON.stringify([...document.querySelectorAll('main, main *')].map(e => e.getBoundingClientRect().bottom))"
        )
        paper, *inside = json.loads(bottoms)
        assert max(inside) <= paper


def test_drawings_turn_dark_with_the_page(browser: Browser, pages: dict[str, Path]) -> None:
    """The corner of a drawing, read back through a canvas, is as dark as the page says: its text would not be seen."""
    brightest = (
        "(() => { const i = document.images[0], c = document.createElement('canvas'); c.width = i.naturalWidth; "
        "c.height = i.naturalHeight; const x = c.getContext('2d'); x.drawImage(i, 0, 0); "
        "const d = x.getImageData(0, 0, c.width, c.height).data; let top = 0, low = 255; "
        "for (let k = 0; k < d.length; k += 4) if (d[k + 3] > 250) { const v = (d[k] + d[k + 1] + d[k + 2]) / 3; "
        "top = Math.max(top, v); low = Math.min(low, v); } return [top, low].join(); })()"
    )
    found = {}
    for dark in (False, True):
        browser.show(pages["pendulum"], 800, dark=dark)
        top, low = map(float, browser.evaluate(brightest).split(","))
        found[dark] = top, low
    assert found[False][1] < 60  # dark ink on the light page
    assert found[True][0] > 200 and found[True][1] < 70  # light ink, dark areas


def test_the_table_of_contents_leads_to_every_section(browser: Browser, pages: dict[str, Path]) -> None:
    for page in pages.values():
        browser.show(page, 800)
        targets = browser.evaluate("[...document.querySelectorAll('.toc a')].map(a => a.getAttribute('href')).join()")
        sections = browser.evaluate("[...document.querySelectorAll('h2')].map(h => '#' + h.id).join()")
        assert targets == sections and "#," not in sections


@pytest.mark.slow
def test_a_pendulum_prints_on_two_or_three_pages_and_one_more_with_a_tube(
    browser: Browser, pages: dict[str, Path]
) -> None:
    for name, page in pages.items():
        browser.show(page, 800, dark=True)
        headings = browser.evaluate("JSON.stringify([...document.querySelectorAll('h2, h3')].map(h => h.textContent))")
        pdf = browser.pdf()
        keep(f"{name}.pdf", pdf)
        sheets = pypdf.PdfReader(io.BytesIO(pdf)).pages
        printed = [unicodedata.normalize("NFKC", sheet.extract_text()) for sheet in sheets]  # without ligatures
        assert 2 <= len(printed) <= 3 + (name in ("tube", "path"))
        plain = {unicodedata.normalize("NFKC", " ".join(text.split())) for text in json.loads(headings)}
        for text in printed:
            lines = [" ".join(line.split()) for line in text.splitlines() if line.strip()]
            assert lines[-1] not in plain, lines[-1]  # no orphaned heading
        assert "What was not proved" in " ".join(printed[0].split())
        assert "How to check the certificate" in printed[-1] and "python -I -m certify.checker" in printed[-1]
