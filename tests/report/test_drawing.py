"""Figures drawn while the checker works: the same page, whatever happens to them, and no word before it answers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from certify.analysis.results import RoaResult
from certify.analysis.run import certify_roa
from certify.errors import SoundnessError
from certify.loop.plants import get_system
from certify.report import drawing, drawn, page
from certify.report.drawing import Drawing
from certify.report.sampling import _smoothed
from tests.support.loops import pendulum_network

Asked = tuple[bytes, Path, dict[str, Any], dict[str, Any]]


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> RoaResult:
    return certify_roa(get_system("pendulum"), pendulum_network((8, 8)), tmp_path_factory.mktemp("run"))


@pytest.fixture
def asked(result: RoaResult) -> Asked:
    assert result.raw is not None and result.certificate is not None and result.checker is not None
    return result.raw, result.certificate, dict(result.checker), result.to_dict()


@pytest.fixture(scope="module")
def expected(result: RoaResult) -> str:
    assert result.raw is not None and result.certificate is not None and result.checker is not None
    return drawn.page_of(result.raw, result.certificate, dict(result.checker), result.to_dict())


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """Grows whenever figures are drawn."""
    found, draw = list[bool](), page.draw

    def noted(*given: Any, **named: Any) -> Any:
        found.append(True)
        return draw(*given, **named)

    monkeypatch.setattr(page, "draw", noted)
    monkeypatch.setattr("certify.report.figures.draw", noted)
    return found


@pytest.mark.parametrize("begun", [True, False])
def test_the_page_is_the_same_and_drawn_once(begun: bool, asked: Asked, expected: str, figures: list[bool]) -> None:
    one = Drawing()
    if begun:
        one.begin(asked[0], asked[1])
    assert one.page_of(*asked) == expected and len(figures) == 1


def test_a_certificate_that_came_later_is_drawn_with_the_page(asked: Asked, expected: str, figures: list[bool]) -> None:
    one = Drawing()
    one.begin(asked[0].replace(b"provenance", b"provisions"), asked[1])
    one.begin(asked[0], asked[1])
    assert one.page_of(*asked) == expected and len(figures) == 1  # the first is no certificate, and has no figures


def test_figures_begun_early_say_nothing_before_the_checker_does(asked: Asked) -> None:
    """A refusal after figures were drawn: the page is the one that a refusal has, drawn anew."""
    raw, path, _answer, data = asked
    refused = {"result": "REJECTED", "rule": "ring", "at": "leaf 3", "detail": "positive"}
    one = Drawing()
    one.begin(raw, path)
    page = one.page_of(raw, path, refused, data)
    assert page == drawn.page_of(raw, path, refused, data)
    assert "Nothing here is proved" in page and "The independent checker accepted" not in page


def test_an_answer_about_other_bytes_is_an_error_and_no_page(asked: Asked) -> None:
    raw, path, answer, data = asked
    one = Drawing()
    one.begin(raw, path)
    with pytest.raises(SoundnessError, match="must be about the certificate"):
        one.page_of(raw, path, {**answer, "certificate_sha256": "0" * 64}, data)


def test_figures_that_fail_are_drawn_again_with_the_page(
    asked: Asked,
    expected: str,
    figures: list[bool],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def fail(*_: object) -> None:
        raise MemoryError

    one = Drawing()
    with monkeypatch.context() as patched:
        patched.setattr(drawn, "figures_if_accepted", fail)
        one.begin(asked[0], asked[1])
        assert one._thread is not None
        one._thread.join()
    assert one.page_of(*asked) == expected and len(figures) == 1
    assert capsys.readouterr() == ("", "")


def test_nothing_is_drawn_early_of_a_large_certificate(asked: Asked) -> None:
    one = Drawing()
    one.begin(asked[0] + b" " * drawing._MOST, asked[1])
    assert one._thread is None


@pytest.mark.parametrize("shape", [(1, 1), (2, 9), (5, 3), (60, 41)])
def test_an_edge_is_smoothed_as_scipy_does_it(shape: tuple[int, int]) -> None:
    from scipy.ndimage import gaussian_filter

    values = (np.random.default_rng(0).random(shape) < 0.4).astype(np.float64)
    expected = gaussian_filter(values, 1.0, mode="nearest")
    np.testing.assert_allclose(_smoothed(_smoothed(values).T).T, expected, rtol=0, atol=1e-15)
