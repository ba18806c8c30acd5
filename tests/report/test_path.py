"""A certificate with a tube around a path: what is claimed of the state, and that nothing around it claims more."""

from __future__ import annotations

import hashlib
import io
import math
import re
from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from certify.analysis.results import RoaResult
from certify.analysis.run import RoaOptions, certify_roa
from certify.certificates import Certificate, PartitionTree, Slab, Waypoint, read_certificate
from certify.certificates.claims import Asymptotic, Reached
from certify.certificates.verdict import Stop, Verdict
from certify.loop.expressions import Number
from certify.loop.plants import System
from certify.loop.policies import PolicyNetwork
from certify.lyapunov import extents, semi_axes
from certify.lyapunov.function import Quadratic
from certify.report import render_html, simulated_roa_fraction, summary
from certify.report.figures import draw
from certify.report.figures.geometry import shadows
from certify.report.figures.paper import PaperOptions, paper_figure
from certify.report.figures.scene import Scene
from certify.report.figures.sets import Band, band_of
from certify.report.figures.style import START, START_FILL
from certify.report.figures.trajectories import runs_from, starts
from certify.report.sampling import quadratic
from certify.report.words import above, below
from tests.report.test_report import Page, exactly
from tests.report.test_tube import QUIET, plane, slab, soft_spring
from tests.support.loops import chain, scalar_tanh
from tests.support.marks import slow_after

FROM = {"p": Fraction(6, 5), "v": Fraction(1, 2)}


def shifted_spring() -> tuple[System, PolicyNetwork]:
    """The soft spring around p = 1/2, by the values of its states."""
    system, network = soft_spring()
    return replace(system, name="shifted", x_eq=(Fraction(1, 2), Number(0))), network


def claimed(
    system: System, network: PolicyNetwork, start: np.ndarray, centre: Sequence[float], slabs: Sequence[Slab] = ()
) -> Certificate:
    """A claim that nobody has checked, with V = x'x and c2 = 1/2."""
    n = system.n
    claim = Reached(roa=0.5, local=0.25, start=Quadratic(start), centre=tuple(centre))
    evidence = PartitionTree(np.eye(n), np.ones(n), bytes([255]), tube=tuple(slabs))
    return Certificate(system, network, Quadratic(np.eye(n)), claim, evidence)


def moving(middle: np.ndarray, end: np.ndarray, to: Sequence[float], duration: float = 1.0) -> Slab:
    return replace(slab(middle, end, duration), path=Waypoint(np.array(to), 0.25, 1.0, 1.0, 1.0))


@pytest.fixture(scope="module")
def proved(tmp_path_factory: pytest.TempPathFactory) -> RoaResult:
    options = RoaOptions(candidate="lyapunov", reach_from=FROM, effort=0.1)
    result = certify_roa(*soft_spring(), tmp_path_factory.mktemp("soft"), options)
    assert result.verdict is Verdict.PROVED and result.claim == "reached" and result.tube is not None
    return result


@pytest.fixture(scope="module")
def missed(tmp_path_factory: pytest.TempPathFactory) -> RoaResult:
    """The state lies beyond the edge of what the policy can do: by simulation it leaves the domain."""
    options = RoaOptions(candidate="lyapunov", reach_from={"p": 1.95, "v": 1.95}, effort=0.08)
    result = certify_roa(*soft_spring(), tmp_path_factory.mktemp("missed"), options)
    assert result.verdict is Verdict.UNKNOWN and result.stop is Stop.PATH
    return result


def certificate_of(result: RoaResult) -> Certificate:
    assert result.certificate is not None
    return read_certificate(result.certificate)


def claim_of(certificate: Certificate) -> Reached:
    assert isinstance(certificate.claim, Reached)
    return certificate.claim


def band_in(certificate: Certificate) -> Band:
    assert isinstance(certificate.evidence, PartitionTree)
    claim = claim_of(certificate)
    band = band_of(claim.start.P, np.array(claim.centre), certificate.evidence.tube)
    assert band is not None
    return band


def page_of(result: RoaResult, answer: dict[str, Any] | None = None) -> Page:
    assert result.certificate is not None and result.checker is not None
    sha256 = hashlib.sha256(result.certificate.read_bytes()).hexdigest()
    said = dict(result.checker) if answer is None else answer
    data = result.to_dict() if answer is None else None
    return Page(render_html(certificate_of(result), said, data, result.certificate, sha256=sha256))


def rendered(data: dict[str, Any]) -> str:
    console = Console(file=io.StringIO(), width=200, color_system=None)
    console.print(summary(data))
    return " ".join(console.file.getvalue().split())  # type: ignore[attr-defined]


# The page


def test_the_statement_names_the_state_and_both_sets_and_nothing_between(proved: RoaResult) -> None:
    certificate, text = certificate_of(proved), page_of(proved).text
    level = below(certificate.roa)
    shown = re.search(
        r"around the state c₀, p = 1\.2 m, v = 0\.5 m/s, stays in the domain, is in \{V\(x\) ≤ (\S+)\} after (\S+) s "
        r"at the latest, and converges to the origin as well",
        text,
    )
    assert shown is not None and shown.group(1) == level
    assert isinstance(certificate.evidence, PartitionTree)
    duration = sum(Fraction(s.duration) for s in certificate.evidence.tube)
    assert duration <= exactly(shown.group(2)) < duration * (1 + Fraction(1, 10**4))
    assert f"starts in the set {{V(x) ≤ {level}}} stays in it for all time and converges" in text
    assert "starts in the ellipsoid {(x − c₀)′P₀(x − c₀) ≤ 1}" in text
    assert "it says nothing about trajectories that start between them" in text and "The set is the union" in text
    assert "PROVED · ACCEPTED" in text and "The proof has 8 parts" in text and "UNKNOWN" not in text
    assert "outside {V ≤ c₂} and the ellipsoid around c₀" in text and "P, P₀ and c₀ are below" in text


def test_what_is_said_of_the_start_is_said_around_its_centre(proved: RoaResult) -> None:
    certificate, page = certificate_of(proved), page_of(proved)
    claim = claim_of(certificate)
    assert claim.centre == (1.2, 0.5)
    reach, axes = extents(claim.start.P, 1.0), semi_axes(claim.start.P, 1.0)
    for k, (name, where) in enumerate((("p (m)", "|p − 1.2| ≤ "), ("v (m/s)", "|v − 0.5| ≤ "))):
        row = next(row for row in page.rows if row and row[0] == name)
        assert row[1] == ("1.2", "0.5")[k]  # c₀ stands before what is measured from it
        assert row[2] == below(float(axes[k])) and row[4] == above(float(reach[k]))
        found = re.search(re.escape(where) + r"(\S+) < (\S+)", page.text)
        assert found is not None
        lo, hi = certificate.system.domain[k]
        c = Fraction(claim.centre[k])
        assert Fraction(reach[k]) <= exactly(found.group(1)) < exactly(found.group(2)) <= min(c - lo, hi - c)
    assert "At the start |p − 1.2|" in page.text and "from its centre along each axis" in page.text
    for value in (*claim.start.P.ravel().tolist(), *claim.centre):
        assert repr(value) in page.text


def test_shares_of_the_domain_are_those_of_the_set_around_the_origin(proved: RoaResult) -> None:
    assert proved.certificate is not None and proved.checker is not None
    certificate = certificate_of(proved)
    html = render_html(certificate, dict(proved.checker), proved.to_dict(), proved.certificate)
    assert "bar start" not in html.split("</style>")[-1]
    found = [float(w) for w in re.findall(r'<span class="bar"><i style="width: ([\d.]+)%">', html)]
    assert found == pytest.approx(50 * extents(certificate.P, certificate.roa), abs=0.06)


@pytest.mark.parametrize("answer", [{"result": "REJECTED", "rule": "tube", "at": "tube[0]"}, {"result": "odd"}])
def test_nothing_is_called_proved_unless_it_was_accepted(proved: RoaResult, answer: dict[str, Any]) -> None:
    page = page_of(proved, answer)
    captions = [a.get("alt") or "" for _, a in page.tags]
    for shown in (page.text, *captions, *page.drawings()):
        assert not re.search(
            r"certified|proved (?:set|tube|start|outer)|PROVED"
            r"|(?<!here )(?<!nothing )is proved|was proved|ACCEPTED(?! or)",
            shown,
        )
    assert "claimed tube" in page.text and "claimed start of the tube, around c₀" in page.text


@pytest.mark.slow
def test_a_state_that_is_missed_is_said_to_be_first(missed: RoaResult) -> None:
    page = page_of(missed)
    text = page.text
    assert missed.certificate is not None and certificate_of(missed).kind == "asymptotic"
    said = "The state p = 1.95 m, v = 1.95 m/s was asked about. It is not shown to converge: no tube from there"
    assert said in text and "The certificate is about {V ≤ c₂} alone, in which this state does not lie." in text
    assert text.index("UNKNOWN") < text.index("PROVED · ACCEPTED")
    assert "c₀" not in text and "tube in p" not in text
    assert text.count("no tube from there") == 1 and "The limit of the set" not in text  # it is no limit of the set
    assert missed.diagnosis is not None and dict(missed.diagnosis.next.options) == {"--effort": "0.32"}
    alone = page_of(missed, dict(missed.checker or {}))  # the certificate by itself knows of no state
    assert "UNKNOWN" not in alone.text and "PROVED · ACCEPTED" in alone.text


@pytest.mark.slow
def test_values_and_deviations_are_told_apart(tmp_path: Path) -> None:
    options = RoaOptions(candidate="lyapunov", reach_from={"p": Fraction(17, 10), "v": Fraction(1, 2)}, effort=0.02)
    result = certify_roa(*shifted_spring(), tmp_path, options)
    assert result.verdict is Verdict.PROVED and claim_of(certificate_of(result)).centre == (1.2, 0.5)
    text = page_of(result).text
    assert "around the state c₀, p = 1.2 m, v = 0.5 m/s" in text  # in deviations, like V
    assert "deviations from the operating point p = 0.5 m" in text
    assert "By the states' values c₀ is p = 1.7 m, v = 0.5 m/s." in text.replace("’", "'")
    assert "p − 0.5 (m)" in "".join(page_of(result).drawings())
    told = rendered(result.to_dict())
    assert "state p = 1.7 m, v = 0.5 m/s" in told and "around p = 1.7 m, v = 0.5 m/s, which holds p +-" in told
    assert result.contains([1.7, 0.5]) is True and result.contains([1.2, 0.5], deviations=True) is True


@pytest.mark.parametrize(
    "change",
    slow_after(3, [
        {"centre": [math.nan, 0.0]},
        {"centre": [math.inf, 0.0]},
        {"centre": [50.0, 0.0]},
        {"start": -np.eye(2)},
        {"slabs": []},
        {"slabs": [slab(np.eye(2), np.eye(2))]},
        {"slabs": [moving(np.eye(2), np.eye(2), [math.nan, 0.0])]},
        {"slabs": [moving(np.full((2, 2), math.nan), np.eye(2), [0.0, 0.0])]},
        {"slabs": [moving(-np.eye(2), -np.eye(2), [0.0, 0.0])]},
        {"slabs": [moving(np.eye(2), np.zeros((2, 2)), [0.0, 0.0])]},
        {"slabs": [moving(np.eye(2), np.eye(2), [0.0, 0.0], -1.0)]},
        {"slabs": [moving(np.eye(2), np.eye(2), [0.0, 0.0], math.inf)]},
    ]),
    ids=["nan", "endless", "far out", "no start", "no slabs", "no path", "lost", "nan in it", "negative", "singular",
         "backwards", "for ever"],
)  # fmt: skip
def test_a_refused_path_still_has_a_page(change: dict[str, Any], tmp_path: Path) -> None:
    slabs = change.get("slabs", [moving(2 * np.eye(2), 4 * np.eye(2), [0.0, 0.0])])
    broken = claimed(plane("-x", "-y"), QUIET, change.get("start", np.eye(2)), change.get("centre", [0.5, 0.0]), slabs)
    answer = {"result": "REJECTED", "rule": "tube", "at": "tube[0]"}
    text = Page(render_html(broken, answer, None, tmp_path / "none.json")).text
    assert "rule tube at tube[0]" in text and "PROVED" not in text


# The tube over time and in the planes


def test_the_band_is_that_of_bernsteins_form_around_a_line() -> None:
    way = [
        moving(np.array([[2.0]]), np.array([[4.0]]), [1.0], 3.0),
        moving(np.array([[4.0]]), np.array([[4.0]]), [0.0]),
    ]
    band = band_of(np.array([[1.0]]), np.array([5.0]), way)
    assert band is not None and band.time[-1] == 4
    assert (band.centre[0, 0], band.centre[-1, 0], band.half[0, 0], band.half[-1, 0]) == (5, 0, 1, 0.5)
    (middle,) = np.flatnonzero(band.time == 1.5)
    assert band.half[middle, 0] == pytest.approx(2 / 3, rel=1e-12) and band.centre[middle, 0] == pytest.approx(3)
    (node,) = np.flatnonzero(band.time == 3)
    assert band.centre[node, 0] == 1 and band.half[node, 0] == 0.5


def test_shadows_are_the_outlines_of_projections() -> None:
    P = np.array([[3.0, 1.0, 0.5], [1.0, 2.0, -0.3], [0.5, -0.3, 1.0]])
    c = np.array([1.0, -2.0, 3.0])
    (outline,) = shadows(P[None], c[None], (0, 2), 500)
    reach = np.sqrt(np.diag(np.linalg.inv(P)))[[0, 2]]
    assert np.max(outline, axis=0) - c[[0, 2]] == pytest.approx(reach, rel=1e-4)
    assert c[[0, 2]] - np.min(outline, axis=0) == pytest.approx(reach, rel=1e-4)
    x = np.random.default_rng(1).standard_normal((4000, 3))
    x = c + x / np.sqrt(quadratic(P, x))[:, None]  # on the ellipsoid's edge
    block = np.linalg.inv(np.linalg.inv(P)[np.ix_([0, 2], [0, 2])])
    assert quadratic(block, outline - c[[0, 2]]) == pytest.approx(np.ones(500), rel=1e-9)
    assert np.max(quadratic(block, (x - c)[:, [0, 2]])) <= 1 + 1e-9


def test_simulated_trajectories_stay_in_the_bands(proved: RoaResult) -> None:
    certificate = certificate_of(proved)
    scene, claim, band = Scene(certificate, accepted=True), claim_of(certificate), band_in(certificate)
    runs = runs_from(scene, starts(scene))
    inside = scene.detail.starts
    begins = runs.path[0, :inside] - np.array(claim.centre)
    assert np.all(quadratic(claim.start.P, begins) == pytest.approx(0.999, rel=1e-9))
    assert not np.any(runs.left[:inside]) and np.all(runs.settled[:inside])
    at = runs.step * np.arange(len(runs.path))
    passed = at <= band.time[-1]
    assert passed.sum() > 20
    for k in range(2):
        middle, half = (np.interp(at[passed], band.time, v[:, k]) for v in (band.centre, band.half))
        share = np.abs(runs.path[passed][:, :inside, k] - middle[:, None]) / half[:, None]
        assert np.max(share) <= 1 + 1e-3 and np.max(share) > 0.9


def test_a_plane_of_two_states_shows_start_path_and_tube(proved: RoaResult) -> None:
    pictures, roa = draw(certificate_of(proved), accepted=True)
    first, texts = pictures[0], [key.text for key in pictures[0].legend]
    assert texts[0] == "proved start of the tube, around c₀" and "its path c(t)" in texts
    assert any(re.fullmatch(r"the tube at \d+ moments", text) for text in texts)
    drawn = first.svg.split("</style>")[-1]
    assert START in drawn and START_FILL in drawn and "of which only the start, around c₀, is claimed" in first.caption
    bands = [p for p in pictures if p.title.startswith("The tube in")]
    assert [p.title for p in bands] == ["The tube in p", "The tube in v"] and "1.2 ± " in bands[0].caption
    assert roa is not None and roa.contradictions == 0


def test_with_more_states_there_are_projections_alone_and_no_sign_of_vdot() -> None:
    system, network = chain(4, [1.0, -2.0, -3.0, -4.0])  # Vdot >= 0 along the first state
    start = np.eye(4) / 0.04**2
    path = [moving(start, start, [0.0, 0.0, 0.0, 0.0])]
    certificate = claimed(system, network, start, [0.6, 0.2, -0.3, 0.4], path)
    pictures, _ = draw(certificate, accepted=True)
    first = pictures[0]
    texts = [key.text for key in first.legend]
    assert all("projection" in text for text in texts if "tube" in text or "path" in text or "c₀" in text)
    assert "section of the start" not in texts and not any("V̇" in text for text in texts)
    assert "V̇" not in first.caption and "are projections" in first.about
    plain = replace(certificate, claim=Asymptotic(roa=0.5, local=0.25))
    with_sign = draw(plain, accepted=True)[0]
    assert any("V̇" in key.text for key in with_sign[0].legend)  # or nothing would be left out
    surface = next(p for p in pictures if p.title == "The policy's surface")
    assert START not in surface.svg.split("</style>")[-1] and "start" not in surface.caption


def test_a_view_holds_the_whole_tube() -> None:
    system, network = chain(4, [-1.0, -2.0, -3.0, -4.0])
    start = np.eye(4) / 0.02**2
    path = [moving(start, start, [0.8, -0.7, 0.0, 0.0]), moving(start, start, [0.0, 0.0, 0.0, 0.0])]
    certificate = replace(
        claimed(system, network, start, [0.1, 0.0, 0.0, 0.0], path),
        claim=Reached(roa=1e-4, local=5e-5, start=Quadratic(start), centre=(0.1, 0.0, 0.0, 0.0)),
    )
    box = Scene(certificate, accepted=False).view((0, 1))
    assert box.lo[0] < -0.01 and 0.82 < box.hi[0] < 1.1 and -1.1 < box.lo[1] < -0.72 and 0.01 < box.hi[1] < 0.3


def test_the_simulated_share_counts_the_start_where_it_lies(proved: RoaResult) -> None:
    c = certificate_of(proved)
    claim = claim_of(c)
    centre = np.array(claim.centre)
    both = simulated_roa_fraction(c.system, c.network, c.P, c.roa, start=claim.start.P, centre=centre)
    x = np.stack(np.meshgrid(*both.axes, indexing="ij"), -1)
    around = quadratic(claim.start.P, x - centre) <= 1
    assert np.array_equal(both.certified, (quadratic(c.P, x) <= c.roa) | around) and around.any()
    assert both.certified.sum() > (quadratic(c.P, x) <= c.roa).sum() and both.contradictions == 0
    assert f"covers {100 * both.fraction:.1f} % of the area" in page_of(proved).text


@pytest.mark.slow
def test_one_state_has_an_interval_where_it_lies(tmp_path: Path) -> None:
    options = RoaOptions(candidate="lyapunov", level=0.5, reach_from={"x": 1.5}, effort=0.3)
    result = certify_roa(*scalar_tanh(), tmp_path, options)
    assert result.claim == "reached" and result.tube is not None
    page = page_of(result)
    assert "proved start of the tube, around c₀" in page.text and "around the state c₀, x = 1.5," in page.text
    low, high = Scene(certificate_of(result), accepted=True).start_on_line
    (half,) = extents(result.tube.start, 1.0)
    assert (low, high) == (1.5 - half, 1.5 + half) and 0.5 < low < high < 1.9150081
    assert result.contains([-1.5]) is False and result.contains([1.5]) is True


def test_the_figure_for_a_paper_shows_the_tube(proved: RoaResult) -> None:
    certificate = certificate_of(proved)
    for accepted, word in ((True, "proved"), (False, "claimed")):
        svg = paper_figure(certificate, accepted, PaperOptions(format="svg")).decode()
        assert f"{word} start of the tube, around c₀" in svg and START_FILL in svg.split("</style>")[-1]


# The terminal and the result


def test_the_summary_says_what_the_state_has_and_of_which_set_sizes_are(proved: RoaResult) -> None:
    data = proved.to_dict()
    text = rendered(data)
    assert data["reach_from"] == {"p": "6/5", "v": "1/2"} and data["tube"]["centre"] == [1.2, 0.5]
    assert text.startswith("PROVED") and "every trajectory from an ellipsoid around the state enters it" in text
    alone = [below(v, 3) for v in data["tube"]["semi_axes"]]
    assert f"around p = 1.2 m, v = 0.5 m/s, which holds p +- {alone[0]} m, v +- {alone[1]} m/s, one at a time" in text
    assert f"into {{V <= c2}}, {data['tube']['slabs']} slabs" in text
    assert "nothing is claimed about states between the two sets" in text
    assert f"area {below(data['volume'])} m · m/s, of {{V <= c2}}" in text
    equal = {**data, "tube": {**data["tube"], "volume": data["volume"]}}
    assert "of the tube's start" not in rendered(equal)  # sizes are those of the set around the origin


def test_the_result_holds_the_union_of_two_sets_and_not_the_path(proved: RoaResult) -> None:
    certificate = certificate_of(proved)
    claim = claim_of(certificate)
    c, axes = np.array(claim.centre), semi_axes(claim.start.P, 1.0)
    assert proved.contains(c) is True and proved.contains([0.0, 0.0]) is True
    assert proved.contains(c + 0.999 * np.array([axes[0], 0.0])) is True
    assert proved.contains(c + 1.001 * np.array([axes[0], 0.0])) is False
    assert proved.contains(-c) is False  # a set around the origin would hold it
    band = band_in(certificate)
    edges = band.centre - band.half * [0.0, 1.0]
    in_sets = (quadratic(certificate.P, edges) <= certificate.roa) | (quadratic(claim.start.P, edges - c) <= 1)
    assert in_sets.any() and not in_sets.all() and np.array_equal(proved.contains(edges), in_sets)


def test_the_summary_does_not_hide_that_the_state_was_missed(missed: RoaResult) -> None:
    data = missed.to_dict()
    text = rendered(data)
    assert data["verdict"] == "UNKNOWN" and data["checked"] == "ACCEPTED" and data["stop"] == "path"
    assert text.startswith("UNKNOWN soft_spring: the state is NOT shown to converge; what is proved is {V <= ")
    assert "without it" in text and "PROVED" not in text and "state p = 1.95 m, v = 1.95 m/s" in text
    assert "ACCEPTED BY BOTH, about {V <= c2} alone, in which the state does not lie" in text
    unchecked = rendered({**data, "checked": None})  # of which nothing may be called proved
    assert "nothing was proved" in unchecked and "what is proved" not in unchecked


def test_a_state_in_the_set_needs_no_tube_and_is_named(tmp_path: Path) -> None:
    result = certify_roa(*soft_spring(), tmp_path, RoaOptions(candidate="lyapunov", reach_from={"p": Fraction(1, 10)}))
    assert result.verdict is Verdict.PROVED and result.claim == "asymptotic" and result.tube is None
    assert result.notice is not None and "no tube is needed" in result.notice
    assert "state p = 0.1 m, v = 0 m/s, which lies in {V <= c2}" in rendered(result.to_dict())
