"""A report drawn by a process of its own: the same page, whatever happens to the process, and nothing left running."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from certify.analysis.results import RoaResult
from certify.analysis.run import certify_roa
from certify.errors import SoundnessError
from certify.loop.plants import get_system
from certify.report import drawing, drawn
from certify.report.drawing import Drawing
from tests.support.loops import pendulum_network
from tests.support.marks import slow_after

Asked = tuple[bytes, Path, dict[str, Any], dict[str, Any]]


@pytest.fixture(autouse=True)
def drawn_here() -> None:
    """Here reports are drawn as they are for users."""


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> RoaResult:
    return certify_roa(get_system("pendulum"), pendulum_network((8, 8)), tmp_path_factory.mktemp("run"))


@pytest.fixture
def asked(result: RoaResult) -> Asked:
    assert result.raw is not None and result.certificate is not None and result.checker is not None
    return result.raw, result.certificate, dict(result.checker), result.to_dict()


@pytest.fixture
def here(asked: Asked, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The page as it is drawn in this process; afterwards each page that is drawn here is noted in the list."""
    found, page_of = [drawn.page_of(*asked)], drawn.page_of

    def noted(*given: Any) -> str:
        found.append(page_of(*given))
        return found[-1]

    monkeypatch.setattr(drawn, "page_of", noted)
    return found


def process_of(one: Drawing) -> subprocess.Popen[bytes]:
    assert one._process is not None
    return one._process


def is_gone(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return False


@pytest.mark.parametrize("begun", slow_after(1, [True, False]))
def test_the_page_is_the_same_and_the_process_ends(begun: bool, asked: Asked, here: list[str]) -> None:
    with Drawing() as one:
        pid = process_of(one).pid
        if begun:
            one.begin(asked[0], asked[1], 1.0)
        assert one.page_of(*asked) == here[0]
    assert len(here) == 1 and is_gone(pid)


@pytest.mark.slow
def test_a_certificate_that_came_later_is_the_one_that_is_drawn(asked: Asked, here: list[str]) -> None:
    with Drawing() as one:
        first = process_of(one).pid
        one.begin(asked[0].replace(b"provenance", b"provisions"), asked[1], 1.0)
        one.begin(asked[0], asked[1], 1.0)
        assert is_gone(first) and process_of(one).pid != first
        assert one.page_of(*asked) == here[0] and len(here) == 1
    with Drawing() as one:
        first = process_of(one).pid
        one.begin(asked[0].replace(b"provenance", b"provisions"), asked[1], 1.0)
        assert one.page_of(*asked) == here[0] and len(here) == 2  # what was begun is of no use
        assert is_gone(first)


def test_figures_begun_early_say_nothing_before_the_checker_does(asked: Asked) -> None:
    """A refusal after figures were drawn: the page is the one that a refusal has, drawn anew."""
    raw, path, _answer, data = asked
    refused = {"result": "REJECTED", "rule": "ring", "at": "leaf 3", "detail": "positive"}
    with Drawing() as one:
        one.begin(raw, path, 1.0)
        page = one.page_of(raw, path, refused, data)
    assert page == drawn.page_of(raw, path, refused, data)
    assert "Nothing here is proved" in page and "The independent checker accepted" not in page


def test_an_answer_about_other_bytes_is_an_error_and_no_page(asked: Asked) -> None:
    raw, path, answer, data = asked
    with Drawing() as one, pytest.raises(SoundnessError, match="must be about the certificate"):
        one.begin(raw, path, 1.0)
        one.page_of(raw, path, {**answer, "certificate_sha256": "0" * 64}, data)


@pytest.mark.parametrize("when", ["before", "begun", "never"])
def test_without_its_process_the_page_is_drawn_here(
    when: str, asked: Asked, here: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    if when == "never":

        def refuse(*_: object, **__: object) -> None:
            raise OSError("no more processes")

        monkeypatch.setattr(subprocess, "Popen", refuse)
    with Drawing() as one:
        if when == "before":
            process_of(one).kill()
            process_of(one).wait()
        one.begin(asked[0], asked[1], 1.0)
        if when == "begun":
            process_of(one).kill()
        assert one.page_of(*asked) == here[0] and len(here) == 2


def test_a_process_that_fails_is_no_page(asked: Asked, here: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """It says something, and then ends as processes do that failed."""
    monkeypatch.setattr(drawing, "_LAUNCH", "import sys; print('<!DOCTYPE html>half a page'); sys.exit(1)")
    with Drawing() as one:
        assert one.page_of(*asked) == here[0] and len(here) == 2


def test_nothing_waits_for_a_large_certificate(asked: Asked, monkeypatch: pytest.MonkeyPatch) -> None:
    """The process never reads; a pipe that is full would hold the command up."""
    monkeypatch.setattr(drawing, "_LAUNCH", "import time; time.sleep(600)")
    with Drawing() as one:
        pid = process_of(one).pid
        one.begin(asked[0] + b" " * 2**20, asked[1], 1.0)
        one.begin(asked[0] + b" " * (drawing._FITS - len(asked[0])), asked[1], 1.0)
        start = time.monotonic()
    assert is_gone(pid) and time.monotonic() - start < 60


@pytest.mark.slow
def test_the_process_has_the_import_path_of_this_one(tmp_path: Path, asked: Asked, here: list[str]) -> None:
    """A module of the current folder that bears the name of one that is needed is not imported."""
    (tmp_path / "json.py").write_text("raise SystemExit(1)")
    (tmp_path / "matplotlib.py").write_text("raise SystemExit(1)")
    before = os.getcwd()
    os.chdir(tmp_path)
    try:
        with Drawing() as one:
            assert one.page_of(*asked) == here[0] and len(here) == 1
    finally:
        os.chdir(before)


def test_a_parent_that_dies_takes_the_process_along(tmp_path: Path) -> None:
    code = (
        "import os, signal\nfrom certify.report.drawing import Drawing\none = Drawing().__enter__()\n"
        "print(one._process.pid, flush=True)\nos.kill(os.getpid(), signal.SIGKILL)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    pid = int(done.stdout)
    for _ in range(600):
        if is_gone(pid):
            break
        time.sleep(0.1)
    assert is_gone(pid)
