"""The certificates that the docs link to: what they are accepted for is what the page beside them says."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from certify.certificates import run_checker
from tests.support.marks import slow_after

DOCS = Path(__file__).parent.parent / "docs"
CERTIFICATES = sorted((DOCS / "published").glob("*.json"))
PROGRAMS = slow_after(1, ["checker", "reference"])


@pytest.mark.parametrize("program", PROGRAMS)
@pytest.mark.parametrize("path", CERTIFICATES, ids=lambda path: path.stem)
def test_a_certificate_that_is_linked_is_accepted(path: Path, program: str) -> None:
    answer = run_checker(path, program)  # type: ignore[arg-type]
    assert answer["result"] == "ACCEPTED"
    page = (DOCS / "published.md").read_text()
    row = next(line for line in page.splitlines() if f"(published/{path.name})" in line)
    leaves = answer["outer"]["leaves"] + answer["outer"]["face_leaves"] if program == "checker" else None
    said = int(row.split("|")[5].replace(",", ""))
    assert leaves is None or leaves == said


def test_every_certificate_is_linked_once() -> None:
    page = (DOCS / "published.md").read_text()
    assert sorted(re.findall(r"\(published/([a-z0-9_]+\.json)\)", page)) == [path.name for path in CERTIFICATES] != []
