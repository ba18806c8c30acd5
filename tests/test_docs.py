"""The site builds without a warning and loads nothing from elsewhere, and what its pages tell a reader to run works.

Each fenced block of sh or python in docs/ and in the README carries a comment on the line above it, which readers do
not see:

    <!-- run -->         it is run; by the slow tests where the page is not one that is read first
    <!-- run slow -->    it is run by the slow tests
    <!-- shown: why -->  it is not run; commands of `certify` and `controllers` in it must exist with these options

`<!-- file: NAME -->` above a block of any language writes it into the page's folder; `<!-- prints -->` above a block of
text says what the block before prints: its lines in this order, an ellipsis standing for anything. The blocks of a page
are run in order in one new folder that has `examples` in it.
"""

from __future__ import annotations

import os
import re
import runpy
import shlex
import subprocess
import sys
from dataclasses import dataclass
from functools import cache
from html import unescape
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import pytest
import typer

from tests.support.marks import slow_after

ROOT = Path(__file__).parent.parent
README = ROOT / "README.md"
PAGES = sorted((ROOT / "docs").rglob("*.md"))
FORMAT = sorted((ROOT / "certify" / "checker").rglob("*.md"))
READ = [README, *PAGES]
FIRST = ("README.md", "tutorial.md")  # what a newcomer reads; the commands of index.md are the README's
_BLOCK = re.compile(r"(?:<!-- (?P<mark>[^\n]*?) -->\n)?^```(?P<language>[^\n]*)\n(?P<code>.*?)^```$", re.M | re.S)
_OUTSIDE = re.compile(r"""<(?:script|link|img|iframe|source|object)\b[^>]*?(?:src|href|data)=["']?(?:https?:)?//""")


@dataclass(frozen=True)
class Block:
    """A fenced block of a page, and the comment above it."""

    mark: str
    language: str
    code: str

    @property
    def is_run(self) -> bool:
        return self.mark in ("run", "run slow")


def blocks(page: Path) -> list[Block]:
    return [Block(m["mark"] or "", m["language"], m["code"]) for m in _BLOCK.finditer(page.read_text("utf-8"))]


def named(page: Path) -> str:
    return page.name if page == README else str(page.relative_to(ROOT / "docs"))


def run_page(page: Path, folder: Path, slow: bool) -> None:
    """Run a page's blocks in order; with `slow` all of them."""
    (folder / "examples").symlink_to(ROOT / "examples", target_is_directory=True)
    environment = os.environ | {
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "COLUMNS": "100",
    }
    printed = None
    for block in blocks(page):
        if block.mark.startswith("file: "):
            (folder / block.mark.removeprefix("file: ")).write_text(block.code, "utf-8")
        elif block.mark == "prints" and printed is not None:
            pattern = ".*".join(re.escape(line.strip()).replace("…", ".*") for line in block.code.splitlines())
            assert re.search(pattern, printed, re.S), (
                f"{named(page)} says\n{block.code}\nwhere this was printed:\n{printed}"
            )
        elif block.is_run:
            printed = None
            if block.mark == "run slow" and not slow:
                continue
            shell = ["bash", "-eu", "-o", "pipefail", "-c", block.code]
            command = shell if block.language == "sh" else [sys.executable, "-W", "error", "-c", block.code]
            done = subprocess.run(
                command, cwd=folder, env=environment, capture_output=True, text=True, timeout=900, check=False
            )
            assert done.returncode == 0, f"{named(page)}\n{block.code}\n{done.stdout}\n{done.stderr}"
            printed = done.stdout


def test_the_pages_have_blocks_that_are_run() -> None:
    run = {named(page): sum(block.is_run for block in blocks(page)) for page in PAGES}
    assert run["tutorial.md"] >= 5 and sum(run.values()) >= 20


@pytest.mark.parametrize("page", READ, ids=named)
def test_every_block_says_whether_it_is_run(page: Path) -> None:
    for block in blocks(page):
        known = ("run", "run slow", "prints")
        assert block.mark in ("", *known) or block.mark.startswith(("shown: ", "file: ")), block.mark
        assert block.language != "", f"a block without a language: {block.code[:80]}"
        if block.language in ("sh", "python"):
            assert block.is_run or block.mark.startswith(("shown: ", "file: ")), block.code[:80]
        if block.mark == "prints":
            assert block.language == "text"


@cache
def command_lines() -> dict[str, Any]:
    from certify.cli.main import command_line
    from controllers.cli import app as controllers

    return {"certify": command_line(), "controllers": typer.main.get_command(controllers)}


@pytest.mark.parametrize("page", READ, ids=named)
def test_commands_exist_with_their_options(page: Path) -> None:
    programs = command_lines()
    for block in blocks(page):
        if block.language != "sh":
            continue
        for line in block.code.replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True)
            if not words or words[0] not in programs:
                continue
            commands = getattr(programs[words[0]], "commands")  # noqa: B009
            assert words[1] in commands, line
            known = {name for parameter in commands[words[1]].params for name in parameter.opts}
            until = next((k for k, word in enumerate(words) if word in ("|", "||", "&&", ">")), len(words))
            given = {word.partition("=")[0] for word in words[2:until] if word.startswith("--")}
            assert given <= known | {"--help"}, f"{line}: {sorted(given - known)}"


def running() -> list[Path]:
    """The pages with a command that is run, those that are read first before the others."""
    return sorted((p for p in READ if any(b.mark == "run" for b in blocks(p))), key=lambda p: named(p) not in FIRST)


@pytest.mark.parametrize("page", slow_after(len(FIRST), running()), ids=map(named, running()))
def test_what_a_page_runs_works(page: Path, tmp_path: Path) -> None:
    run_page(page, tmp_path, slow=False)


@pytest.mark.slow
@pytest.mark.parametrize("page", [p for p in PAGES if any(b.mark == "run slow" for b in blocks(p))], ids=named)
def test_all_that_a_page_runs_works(page: Path, tmp_path: Path) -> None:
    run_page(page, tmp_path, slow=True)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built as `make docs` builds it."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout + done.stderr == ""
    return folder


def test_the_site_is_whole_and_loads_nothing_from_elsewhere(site: Path) -> None:
    html = {str(page.relative_to(site)): page.read_text("utf-8") for page in site.rglob("*.html")}
    assert {str(page.relative_to(ROOT / "docs").with_suffix(".html")) for page in PAGES} <= set(html)
    for name, text in html.items():
        assert not _OUTSIDE.search(text), f"{name}: {_OUTSIDE.search(text)}"
        assert 'class="mermaid"' not in text, name  # would be drawn by a program from elsewhere
    for style in site.rglob("*.css"):
        assert not re.search(r"""(?:@import|url\()\s*["']?(?:https?:)?//""", style.read_text("utf-8")), style
    assert not list(site.rglob("*.py"))


def without(tags: str, html: str) -> str:
    return re.sub(rf"<({tags})\b.*?</\1>", "", html, flags=re.S)


def text_of(html: str) -> str:
    """What a reader sees: each block in a line of its own, and the letters of a formula together."""
    html = re.sub(r"</(?:p|li|d[dt]|t[dh]|h\d|div|blockquote)>|<br\b[^>]*>", "\n", html)
    return unescape(re.sub(r"<!--.*?-->|<[^>]*>", "", html, flags=re.S))


# What a page's text has where Markdown or TeX was not understood; in a line's beginning a list, heading or table.
_MARKERS = re.compile(r"klzzwxh|wzxhzdk|[\x02\x03]")
_TEX = re.compile(r"\$|\\\S|(?<=\w)[_^]\{|&(?=[a-z=])")
_MARKDOWN = re.compile(
    r"\*\*|`|~~|(?<![\w*])\*\w|(?<!\w)_\w[^_\n]*_(?!\w)|\]\(|\]\[|<!--|--8<--|&#?\w+;"
    r"|^\s*(?:[-*+]|\d+\.) +\S|^\s*(?:#+ |>|!!!|:::)|^\s*\|.*\|\s*$",
    re.M,
)


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_a_pages_text_has_no_trace_of_markdown_or_tex(page: Path, site: Path) -> None:
    html = without("code|pre|script|style", (site / named(page)).with_suffix(".html").read_text("utf-8"))
    everything, prose = text_of(html), text_of(without("math", html))
    for pattern, text in ((_MARKERS, everything), (_TEX, everything), (_MARKDOWN, prose)):
        traces = [text[max(0, m.start() - 30) : m.end() + 30] for m in pattern.finditer(text)]
        assert not traces, f"{named(page)}, {len(traces)} times: {traces[:5]}"


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_every_formula_of_a_page_becomes_mathml(page: Path, site: Path) -> None:
    """As many as the page's text has, none of them empty, and with all their braces."""
    written = re.sub(r"^```.*?^```$|`[^`\n]*`", "", page.read_text("utf-8"), flags=re.M | re.S)
    formulas = [a or b for a, b in re.findall(r"\$\$(.+?)\$\$|\$(.+?)\$", written, re.S)]
    html = (site / named(page)).with_suffix(".html").read_text("utf-8")
    shown = [text_of(m) for m in re.findall(r"<math\b.*?</math>", html, re.S)]
    assert len(shown) == len(formulas) and all(shown)
    for formula, text in zip(formulas, shown, strict=True):
        assert [formula.count(rf"\{brace}") for brace in "{}"] == [text.count(brace) for brace in "{}"], formula


@pytest.mark.parametrize("page", [*PAGES, *FORMAT], ids=lambda page: page.name)
def test_no_cell_of_a_table_ends_in_braces(page: Path) -> None:
    """Markdown takes them for attributes, and the reader does not see them."""
    cells = re.sub(r"`[^`]*`|\$\$.*?\$\$|\$[^$]*\$", "", page.read_text("utf-8"))
    assert not re.findall(r"^\|.*\} *\|.*$", cells, re.M)


def test_every_link_within_the_site_leads_somewhere(site: Path) -> None:
    """Anchors too; mkdocs looks at those of Markdown alone."""
    pages = {page: page.read_text("utf-8") for page in site.rglob("*.html") if page.name != "404.html"}
    anchors = {page: set(re.findall(r"""\bid=["']?([^"'\s>]+)""", html)) for page, html in pages.items()}
    links = 0
    for page, html in pages.items():
        for link in re.findall(r"""<(?:a|img|link|script)\b[^>]*?\b(?:href|src)=["']?([^"'\s>]*)""", html):
            address, _, anchor = unquote(unescape(link)).partition("#")
            if re.match(r"\w+:", address):
                continue
            target = (page.parent / address).resolve() if address else page
            target = target / "index.html" if target.is_dir() else target
            assert target.is_file(), f"{page.name}: {link}"
            assert not anchor or anchor == "__skip" or anchor in anchors[target], f"{page.name}: {link}"
            links += 1
    assert links > 1000


@pytest.mark.parametrize(
    ("formula", "text"),
    [
        (r"\{V \le c_2\}", "{V≤c2}"),
        (r"\tanh v", "tanh v"),
        (r"m_p \sin\theta\,(l - g\cos\theta)", "mp sin θ(l−g cos θ)"),
        (r"\tanh'(a)", "tanh′(a)"),
        (r"6 \cos^4(x)", "6 cos4(x)"),
        (r"a + \max_i x", "a+maxi x"),
    ],
)
def test_formulas_have_room_beside_functions(formula: str, text: str) -> None:
    """None before what is in brackets. Room is shown as a space here."""
    html = runpy.run_path(str(ROOT / "docs" / "formulas.py"))["mathml"](formula, False)
    html = re.sub(r'(<mo[^>]*rspace="0\.[^>]*>[^<]*</mo>(?:<m[in]>[^<]*</m[in]></msu[bp]>)?)', r"\1 ", html)
    assert text_of(re.sub(r'(<mo[^>]*lspace="0\.)', r" \1", html)) == text


def test_the_reference_has_every_command_and_public_name(site: Path) -> None:
    import certify
    from certify.cli.main import command_line

    commands = (site / "reference" / "commands.html").read_text("utf-8")
    for name in getattr(command_line(), "commands"):  # noqa: B009
        assert f">certify {name}<" in commands, name
    python = (site / "reference" / "python.html").read_text("utf-8")
    for name in certify.__all__:
        assert name.startswith("_") or re.search(rf'id="[\w.]*\.{name}"', python), name


def test_the_sites_packages_are_pinned() -> None:
    pinned = {line.split("==")[0] for line in (ROOT / "constraints.txt").read_text().splitlines() if "==" in line}
    assert {
        "mkdocs",
        "mkdocs-material",
        "mkdocstrings",
        "mkdocstrings-python",
        "griffelib",
        "latex2mathml",
    } <= pinned


def test_the_table_of_the_comparison_is_of_the_figures_beside_it() -> None:
    """The page shows exactly the table that `make paper` would write."""
    script = runpy.run_path(str(ROOT / "docs" / "paper" / "table.py"))
    written = (ROOT / "docs" / "paper" / "baselines.txt").read_text("utf-8")
    assert written == script["table"]() and written.count("| ours |") == len(script["PLANTS"])


def test_the_readme_is_short_and_its_links_lead_somewhere() -> None:
    text = README.read_text("utf-8")
    assert len(text.splitlines()) <= 150
    links = re.findall(r"\]\((?!https?:)([^)#]+)", text)
    missing = [link for link in links if not (ROOT / link).exists()]
    assert len(links) > 20 and not missing, missing


def test_the_home_page_is_a_picture_three_commands_and_five_places() -> None:
    page = ROOT / "docs" / "index.md"
    text = page.read_text("utf-8")
    commands = [line for block in blocks(page) if block.language == "sh" for line in block.code.splitlines()]
    assert len(re.findall(r"!\[", text)) == 1 and len(commands) == 3
    assert len(re.findall(r"^- ", text, re.M)) == 5


def test_the_glossary_has_each_term_once_with_an_anchor(site: Path) -> None:
    html = (site / "glossary.html").read_text("utf-8")
    terms = re.findall(r"<dt\b([^>]*)>(.*?)</dt>", html, re.S)
    names = [text_of(name).strip().lower() for _, name in terms]
    assert len(names) == len(set(names)) >= 90 and all("id=" in attributes for attributes, _ in terms)
    assert html.count("<dd>") == len(terms)  # an indentation that is wrong makes two terms one
