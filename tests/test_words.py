"""Plain English: docstrings and sentences name the thing, then the verb, and some phrases do not occur."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
SOURCES = [path for room in ("certify", "controllers") for path in sorted((ROOT / room).rglob("*.py"))]
PAGES = [
    *sorted((ROOT / "docs").rglob("*.md")),
    *(ROOT / name for name in ("README.md", "CHANGELOG.md", "CONTRIBUTING.md", "examples/README.md")),
    *sorted((ROOT / "certify" / "checker").rglob("*.md")),
]
_OPENER = re.compile(r"\W*(?:What|Whether|Of|Those|How|Where|Which|That)\b")
_SENTENCE = re.compile(r"(?:^\W*|[.:!] |\| )((?:What|Whether|Of|Those|How)\b[^.?|]*)(?:[.|]|$)", re.M)
_PHRASE = re.compile(
    r"\bin the place of\b|\bgo(?:es|ing|ne)? on with\b"
    r"|\b(?:a|one) (?:byte|column|condition|figure|file|line|page|picture|process|row|script) an? [a-z]"
)


def named(path: Path) -> str:
    return str(path.relative_to(ROOT))


def prose(page: str) -> str:
    """A page without headings, comments, links and blocks of code, and with each paragraph on one line."""
    page = re.sub(r"^```.*?^```$|^#.*?$|<!--.*?-->", "", page, flags=re.M | re.S)
    page = re.sub(r"\[[^]]*\]\([^)]*\)", "Link", page)
    return re.sub(r"(?<=\S)\n[ \t]*(?![ \t]*(?:[-*|:]|\d+\. |\n))", " ", page)


def openers(text: str) -> list[str]:
    return [found[1] for found in _SENTENCE.finditer(text)]


def test_a_docstring_names_the_thing_first() -> None:
    for path in SOURCES:
        nodes = (node.value for node in ast.walk(ast.parse(path.read_text("utf-8"))) if isinstance(node, ast.Expr))
        texts = [str(node.value) for node in nodes if isinstance(node, ast.Constant)]
        assert not [text for text in texts if _OPENER.match(text)], named(path)


def test_no_phrase_that_readers_stumble_over() -> None:
    for path in [*SOURCES, *PAGES]:
        assert not _PHRASE.findall(path.read_text("utf-8")), named(path)


def test_a_sentence_of_a_page_names_the_thing_first() -> None:
    for page in PAGES:
        assert not openers(prose(page.read_text("utf-8"))), named(page)


@pytest.mark.parametrize("text", ["Whether it holds.", "It is. What is left\nis small.", "- Of all sets\nthe largest."])
def test_a_bad_opener_is_found(text: str) -> None:
    assert openers(prose(text))


@pytest.mark.parametrize("text", ["Does it hold? What does\nit prove?", "# What is proved", "It says what is left."])
def test_a_question_and_a_heading_are_no_bad_openers(text: str) -> None:
    assert not openers(prose(text))


@pytest.mark.parametrize("text", ["X in the place of Y", "gone on with", "a file a plant", "one line a row"])
def test_a_bad_phrase_is_found(text: str) -> None:
    assert _PHRASE.search(text)
