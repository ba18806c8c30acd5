"""Which states are drawn together, how sets look in a plane, the figure for a paper, and what limits the set."""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from certify.analysis.run import RoaOptions, certify_roa
from certify.certificates import Certificate, PartitionTree
from certify.certificates.claims import Asymptotic
from certify.cli.main import _run
from certify.errors import InputError
from certify.loop.expressions import Number, cos, symbols
from certify.loop.plants import System, get_system
from certify.loop.policies import PolicyNetwork
from certify.lyapunov import extents
from certify.lyapunov.function import Quadratic
from certify.report import render_html, summary
from certify.report.figures import draw
from certify.report.figures.geometry import circle, over_level
from certify.report.figures.pairs import MOST, coupling, named_pairs, pairs_of, rates
from certify.report.figures.paper import PaperOptions, paper_figure
from certify.report.sampling import quadratic
from tests.support.loops import box, chain, pendulum_network, scalar_tanh
from tests.support.marks import slow_after

FOUR = PartitionTree(np.eye(4), np.ones(4), bytes([255]))


def vehicle() -> System:
    """Names that tell nothing: a's rate is c, b's is 2 d, and d has an input."""
    a, b, c, d, u = symbols("a b c d u")
    f = (c, 2 * d * cos(b), -a - c, -b - d + u)
    return System("vehicle", (a, b, c, d), (u,), {}, f, (Number(0),), box(1, 1, 1, 1), box(1))


def drawable(P: np.ndarray, level: float, inner: float) -> Certificate:
    network = PolicyNetwork.of_layers((np.zeros((1, 4)),), (np.zeros(1),), np.ones(1), np.zeros(1), "tanh", "none")
    return Certificate(vehicle(), network, Quadratic(P), Asymptotic(roa=level, local=inner), FOUR)


def test_a_coordinate_belongs_to_its_rate_whatever_their_names() -> None:
    assert rates(vehicle()) == [(0, 2), (1, 3)]
    assert rates(get_system("cartpole")) == [(0, 2), (1, 3)]
    assert rates(get_system("quadrotor3d")) == [(k, k + 6) for k in range(6)]
    assert rates(chain(4, [-1.0, -2.0, -3.0, -4.0])[0]) == [(0, 1), (2, 3)]  # a rate is no coordinate as well


def test_the_pair_of_the_state_that_binds_comes_first() -> None:
    assert pairs_of(vehicle(), np.eye(4), np.array([0.1, 0.2, 0.3, 0.9]))[:2] == [(1, 3), (0, 2)]
    assert pairs_of(vehicle(), np.eye(4), np.array([0.95, 0.2, 0.3, 0.9]))[:2] == [(0, 2), (1, 3)]


def test_states_without_a_rate_are_drawn_with_what_p_couples_them_to() -> None:
    x, y, z, u = symbols("x y z u")
    system = System("mixed", (x, y, z), (u,), {}, (-x + u, -y + u, -z + u), (Number(0),), box(1, 1, 1), box(1))
    P = np.array([[4.0, 0.1, 1.9], [0.1, 1.0, -0.2], [1.9, -0.2, 1.0]])
    assert coupling(P)[0, 2] == pytest.approx(0.95) and np.all(np.diag(coupling(P)) == 0)
    pairs = pairs_of(system, P, np.array([0.5, 0.4, 0.3]))
    assert pairs[0] == (0, 2) and {k for pair in pairs for k in pair} == {0, 1, 2} and (1, 2) in pairs


@given(st.integers(3, 9), st.integers(0, 1000))
def test_pairs_are_few_different_and_hold_the_state_that_binds(n: int, seed: int) -> None:
    generator = np.random.default_rng(seed)
    M = generator.standard_normal((n, n))
    system, _ = chain(n, [-1.0 - k for k in range(n)])
    shares = generator.uniform(0.1, 1.0, n)
    pairs = pairs_of(system, M @ M.T + np.eye(n), shares)
    assert 2 <= len(pairs) <= MOST and len({frozenset(pair) for pair in pairs}) == len(pairs)
    assert all(i != j for i, j in pairs) and int(np.argmax(shares)) in pairs[0]


def test_pairs_by_name() -> None:
    assert named_pairs(vehicle(), ["a,c", "d, a"]) == [(0, 2), (3, 0)]
    for wrong in ("a", "a,a", "a,e", "a,b,c", ""):
        with pytest.raises(InputError, match=r"two different states of vehicle.*Its states are a, b, c, d"):
            named_pairs(vehicle(), [wrong])


@given(st.integers(0, 10_000), st.floats(1e-6, 1e6))
def test_trajectories_start_over_the_outline_of_the_projection(seed: int, level: float) -> None:
    M = np.random.default_rng(seed).standard_normal((4, 4))
    P = M @ M.T + 0.1 * np.eye(4)
    x = over_level(P, (1, 3), circle(12), level)
    assert np.allclose(quadratic(P, x), level, rtol=1e-8)
    covariance = np.linalg.inv(P)[np.ix_((1, 3), (1, 3))]
    assert np.allclose(quadratic(np.linalg.inv(covariance), x[:, [1, 3]]), level, rtol=1e-6)
    # V only rises if the other two states change.
    for k in (0, 2):
        for delta in (-1e-3, 1e-3):
            moved = x + delta * np.sqrt(level) * np.eye(4)[k]
            assert np.all(quadratic(P, moved) > level)


def test_pictures_of_four_states_are_zoomed_to_the_set() -> None:
    P = np.diag([1.0, 4.0, 1.0, 4.0])
    pictures, _ = draw(drawable(P, 1e-4, 1e-5), accepted=True)
    numbers = [
        float(t.replace("\N{MINUS SIGN}", "-")) for t in re.findall(r">(\N{MINUS SIGN}?[\d.]+)</text>", pictures[0].svg)
    ]
    assert numbers and max(map(abs, numbers)) <= 1.3 * 0.01  # the set reaches 0.01 in a domain of 1
    assert {p.legend for p in pictures[:4]} == {pictures[0].legend} and pictures[4].legend == ()  # one for all planes


def test_a_local_set_that_is_the_whole_set_is_not_zero_of_one_leaves(tmp_path: Path) -> None:
    system, network = chain(4, [-1.0, -2.0, -3.0, -4.0])
    result = certify_roa(system, network, tmp_path, RoaOptions(candidate="lyapunov", effort=0.2))
    assert result.levels.local == result.levels.roa and result.certificate is not None and result.checker is not None
    from certify.certificates import read_certificate

    html = render_html(read_certificate(result.certificate), dict(result.checker), result.to_dict(), result.certificate)
    assert "none needed: the local part covers the whole set" in html
    assert not re.search(r"0 (of 1|in the ring)|of which 0", html) and "The leaf partition" not in html
    import io

    from rich.console import Console

    console = Console(file=io.StringIO(), width=160, color_system=None)
    console.print(summary(result.to_dict()))
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert "the local part covers the whole set and no leaf is needed" in text and " leaves" not in text


# What limits the set


@pytest.fixture(scope="module")
def proved(tmp_path_factory: pytest.TempPathFactory) -> tuple[Certificate, dict[str, Any], dict[str, Any], Path]:
    from certify.certificates import read_certificate

    folder = tmp_path_factory.mktemp("proved")
    result = certify_roa(
        get_system("pendulum"), pendulum_network(), folder, RoaOptions(candidate="lyapunov", effort=0.2)
    )
    assert result.certificate is not None and result.checker is not None
    return read_certificate(result.certificate), dict(result.checker), result.to_dict(), result.certificate


def test_the_page_says_what_limits_the_set_and_what_to_try(proved: Any) -> None:
    certificate, answer, result, path = proved
    step = {
        "options": {"--time-limit": "90"},
        "why": "it still grew",
        "command": "certify roa --policy p.pt --time-limit 90",
    }
    diagnosis = {
        **result["diagnosis"], "kind": "time", "binds": "time", "stiffness": 12.5, "fastest": -25.0, "slowest": -2.0,
        "hurts": {"theta": 1.0, "theta_dot": 0.25}, "next": step,
    }  # fmt: skip
    html = render_html(certificate, answer, {**result, "diagnosis": diagnosis}, path)
    assert "The limit of the set, and the next thing to try" in html and "the time limit: more may be provable" in html
    assert "slowest decays at 2 per second (time constant 0.5 s), the fastest at 25 per second (0.04 s)." in html
    assert "stiffness" not in html
    assert "<b>Try next:</b> it still grew.</p>" in html and f"<pre>{step['command']}</pre>" in html
    assert '<span class="bar hurts"><i style="width: 25.0%">' in html
    assert "The states that cost the proof most" in html and ">25 %</td>" in html
    # A limit that is met at a state is named with it, and has no direction besides.
    at_a_point = {**diagnosis, "kind": "domain", "binds": "the upper side of the domain in θ, 3 rad"}
    met = render_html(certificate, answer, {**result, "diagnosis": at_a_point}, path)
    assert "<b>the upper side of the domain in θ, 3 rad</b>" in met and "had most to do" not in met
    # The words of a run are text.
    hostile = {**diagnosis, "binds": "<script>", "next": {"options": {}, "why": "<b>&", "command": "<i>"}}
    html = render_html(certificate, answer, {**result, "diagnosis": hostile}, path)
    assert (
        "<script" not in html
        and "<b>&lt;b&gt;&amp;" not in html
        and "&lt;script&gt;" in html
        and "<pre>&lt;i&gt;" in html
    )


def test_bars_are_the_certificates_own_shares(proved: Any) -> None:
    certificate, answer, result, path = proved
    shares = extents(certificate.P, certificate.roa) / [float(hi) for _, hi in certificate.system.domain]
    for given_result in (None, result):
        html = render_html(certificate, answer, given_result, path)
        found = [float(w) for w in re.findall(r'<span class="bar"><i style="width: ([\d.]+)%">', html)]
        assert found == pytest.approx(100 * shares, abs=0.06) and max(found) > 99
        assert ("next thing to try" in html) == (given_result is not None)
    assert ">Share of the domain</h2>" in render_html(certificate, answer, None, path)


# The figure for a paper


def width_of(pdf: bytes) -> float:
    """Inches."""
    box = re.search(rb"/MediaBox \[ ?([\d. ]+)\]", pdf)
    assert box is not None
    left, _, right, _ = map(float, box.group(1).split())
    return (right - left) / 72


@pytest.mark.slow
@pytest.mark.parametrize(("columns", "inches"), slow_after(1, [(1, 3.4), (2, 7.0)]))
def test_the_figure_is_as_wide_as_its_columns(proved: Any, columns: Any, inches: float) -> None:
    options = PaperOptions(columns)
    pdf = paper_figure(proved[0], True, options)
    assert pdf.startswith(b"%PDF") and width_of(pdf) == pytest.approx(inches, abs=1e-3)
    assert pdf == paper_figure(proved[0], True, options)  # no date, no chance


def test_the_figure_says_what_was_accepted_and_what_is_simulated(proved: Any) -> None:
    svg = paper_figure(proved[0], True, PaperOptions(format="svg")).decode()
    assert "proved set, V = " in svg and "* simulated or on a grid, not proved" in svg and "claimed" not in svg
    assert "claimed set" in paper_figure(proved[0], False, PaperOptions(format="svg")).decode()
    assert paper_figure(proved[0], True, PaperOptions(format="png")).startswith(b"\x89PNG")


def test_the_figure_shows_the_pairs_that_are_asked_for() -> None:
    four = drawable(np.diag([1.0, 4.0, 1.0, 4.0]), 1e-2, 1e-3)
    svg = paper_figure(four, False, PaperOptions(2, ("d,a",), "svg")).decode()
    labels = set(re.findall(r">([abcd])</text>", svg))
    assert labels == {"a", "d"}
    assert set(re.findall(r">([abcd])</text>", paper_figure(four, False, PaperOptions(2, (), "svg")).decode())) == set(
        "abcd"
    )


def test_one_state_has_a_figure_and_no_pairs() -> None:
    system, network = scalar_tanh()
    line = Certificate(system, network, Quadratic(np.eye(1)), Asymptotic(roa=1.0, local=0.1),
                       PartitionTree(np.eye(1), np.ones(1), bytes([255])))  # fmt: skip
    assert "V̇ (float64, not proved)" in paper_figure(line, True, PaperOptions(format="svg")).decode()
    with pytest.raises(InputError, match="pairs need two states or more"):
        paper_figure(line, True, PaperOptions(pairs=("x,y",)))


@pytest.mark.parametrize("wrong", [{"columns": 3}, {"format": "jpg"}, {"format": ""}])
def test_wrong_options_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=r"must be (1 or 2|one of pdf, svg, png)"):
        PaperOptions(**wrong)


def test_the_command_checks_and_draws(proved: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, out = proved[3], tmp_path / "roa.pdf"
    assert _run(["plot", str(path), "--out", str(out), "--columns", "2"], False) == 0
    assert capsys.readouterr().out == f"ACCEPTED  {out}\n" and width_of(out.read_bytes()) == pytest.approx(
        7.0, abs=1e-3
    )
    # A certificate that is refused is drawn as a claim, and the status says so.
    data = json.loads(path.read_bytes())
    data["levels"]["roa"] = (1.5 * proved[0].roa).hex()
    forged = tmp_path / "forged.json"
    forged.write_text(json.dumps(data))
    assert _run(["plot", str(forged), "--out", str(tmp_path / "f.svg"), "--json"], True) == 1
    assert json.loads(capsys.readouterr().out)["result"] == "REJECTED"
    assert "claimed set" in (tmp_path / "f.svg").read_text()
    before = hashlib.sha256(out.read_bytes()).hexdigest()
    for wrong, message in (
        (["--pairs", "theta,nobody"], "two different states"),
        (["--columns", "3"], "`columns` must be"),
    ):
        assert _run(["plot", str(path), "--out", str(out), *wrong], False) == 2
        assert message in capsys.readouterr().err
    assert _run(["plot", str(path), "--out", str(tmp_path / "roa.doc")], False) == 2
    assert "one of pdf, svg, png" in capsys.readouterr().err
    assert hashlib.sha256(out.read_bytes()).hexdigest() == before  # nothing was half-written


def test_states_that_nothing_couples_are_still_paired_with_others() -> None:
    a, b, c, u = symbols("a b c u")
    system = System(
        name="apart", states=(a, b, c), inputs=(u,), parameters={}, dynamics=(u - a, -b, -c), u_eq=(Number(0),),
        domain=box(1, 1, 1), input_bounds=box(1),
    )  # fmt: skip
    assert all(i != j for i, j in pairs_of(system, np.eye(3), np.full(3, 0.5)))
