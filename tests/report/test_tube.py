"""A certificate with a tube: both sets are named, measured and drawn, and nothing from the start seems to leave."""

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
from certify.certificates import Certificate, PartitionTree, Slab, read_certificate
from certify.certificates.claims import Asymptotic, Enlarged
from certify.certificates.verdict import Verdict
from certify.loop.expressions import Number, symbols
from certify.loop.plants import System
from certify.loop.plants.equations import parse_expression
from certify.loop.policies import PolicyNetwork
from certify.lyapunov import extents, semi_axes, volume
from certify.lyapunov.function import Quadratic
from certify.report import render_html, simulated_roa_fraction, summary
from certify.report.claims import CLAIMS
from certify.report.figures import draw
from certify.report.figures.paper import PaperOptions, paper_figure
from certify.report.figures.portrait import keys
from certify.report.figures.scene import Scene
from certify.report.figures.sets import Band, band_of
from certify.report.figures.style import LEAVING, START
from certify.report.figures.trajectories import runs_from, starts
from certify.report.figures.tube import MOST, tube
from certify.report.flow import Flow
from certify.report.sampling import SETTLED, quadratic, runs_of
from certify.report.words import above, below
from tests.report.test_report import Page, exactly
from tests.support.loops import box, chain, scalar_tanh
from tests.support.marks import slow_after

QUIET = PolicyNetwork.of_layers((np.zeros((1, 2)),), (np.zeros(1),), np.ones(1), np.zeros(1), "tanh", "none")


def soft_spring() -> tuple[System, PolicyNetwork]:
    """p' = v, v' = -p + p^3/4 - 2 v + u under one tanh."""
    p, v, u = symbols("p v u")
    f = (v, -p + p**3 / 4 - 2 * v + u)
    units = {"p": "m", "v": "m/s", "u": "N"}
    system = System("soft_spring", (p, v), (u,), {}, f, (Number(0),), box(2, 2), box(1), units=units)
    weights = (np.array([[-0.3, -0.2]]),)
    return system, PolicyNetwork.of_layers(weights, (np.zeros(1),), np.ones(1), np.zeros(1), "tanh", "none")


def enlarged(
    system: System, network: PolicyNetwork, start: np.ndarray, slabs: Sequence[Slab] = (), level: float = 0.5
) -> Certificate:
    """A claim that nobody has checked, with V = x'x."""
    n = system.n
    claim = Enlarged(roa=level, local=level / 2, start=Quadratic(start))
    evidence = PartitionTree(np.eye(n), np.ones(n), bytes([255]), tube=tuple(slabs))
    return Certificate(system, network, Quadratic(np.eye(n)), claim, evidence)


def slab(middle: np.ndarray, end: np.ndarray, duration: float = 1.0) -> Slab:
    n = len(end)
    return Slab(middle, end, duration, 2 * np.eye(n), np.ones((3, n)), np.eye(n))


def plane(first: str, second: str, half: float = 1.0) -> System:
    x, y, u = symbols("x y u")
    f = tuple(parse_expression(text, {"x": x, "y": y}) for text in (first, second))
    return System("plane", (x, y), (u,), {}, f, (Number(0),), box(half, half), box(1))


@pytest.fixture(scope="module")
def proved(tmp_path_factory: pytest.TempPathFactory) -> RoaResult:
    options = RoaOptions(candidate="lyapunov", level=0.3, enlarge=True)
    result = certify_roa(*soft_spring(), tmp_path_factory.mktemp("soft"), options)
    assert result.verdict is Verdict.PROVED and result.claim == "enlarged" and result.tube is not None
    return result


def certificate_of(result: RoaResult) -> Certificate:
    assert result.certificate is not None
    return read_certificate(result.certificate)


def start_of(certificate: Certificate) -> np.ndarray:
    assert isinstance(certificate.claim, Enlarged)
    return certificate.claim.start.P


def slabs_of(certificate: Certificate) -> tuple[Slab, ...]:
    assert isinstance(certificate.evidence, PartitionTree)
    return certificate.evidence.tube


def shadow(start: np.ndarray, slabs: Sequence[Slab]) -> tuple[np.ndarray, np.ndarray]:
    """Times and half-widths of a tube around the origin."""
    band = band_of(start, None, slabs)
    assert isinstance(band, Band) and not np.any(band.centre)
    return band.time, band.half


def page_of(result: RoaResult, answer: dict[str, Any] | None = None) -> Page:
    assert result.certificate is not None and result.checker is not None
    sha256 = hashlib.sha256(result.certificate.read_bytes()).hexdigest()
    said = dict(result.checker) if answer is None else answer
    data = result.to_dict() if answer is None else None
    return Page(render_html(certificate_of(result), said, data, result.certificate, sha256=sha256))


# The page


def test_the_statement_names_both_sets_and_the_time(proved: RoaResult) -> None:
    certificate, text = certificate_of(proved), page_of(proved).text
    level = below(certificate.roa)
    duration = sum(Fraction(s.duration) for s in slabs_of(certificate))
    shown = re.search(r"is in \{V\(x\) ≤ ([^}]*)\} after (\S+) s at the latest", text)
    assert shown is not None and shown.group(1) == level
    assert duration <= exactly(shown.group(2)) < duration * (1 + Fraction(1, 10**4))
    assert f"starts in the set {{V(x) ≤ {level}}} stays in it for all time and converges" in text
    assert "starts in the ellipsoid {x′P₀x ≤ 1}, the start of a tube, stays in the domain" in text
    assert "On the way the input stays within −1 ≤ u ≤ 1 N" in text
    assert "PROVED · ACCEPTED" in text and "The proof has 8 parts" in text
    assert "no clip acts, and the input stays in its bounds" in text and "Along the tube." in text
    assert "may leave that ellipsoid on its way" in text and "outside {V ≤ c₂} and the tube's start" in text
    assert f"{len(slabs_of(certificate))} slabs, " in text


def test_sizes_stand_side_by_side_and_are_rounded_to_the_safe_side(proved: RoaResult) -> None:
    certificate, page = certificate_of(proved), page_of(proved)
    P0, sides = start_of(certificate), [float(hi) for _, hi in certificate.system.domain]
    sets = ((P0, 1.0), (certificate.P, certificate.roa))
    for k, name in enumerate(("p (m)", "v (m/s)")):
        row = next(row for row in page.rows if row and row[0] == name)
        assert len(row) == 6
        for cell, largest, (P, level) in zip(row[1:3], row[3:5], sets, strict=True):
            axis, extent = float(semi_axes(P, level)[k]), float(extents(P, level)[k])
            length, share = cell.removesuffix(" %)").split(" (")
            assert length == below(axis) and exactly(length) <= Fraction(axis)
            assert exactly(share) <= Fraction(100 * axis / sides[k]) < exactly(share) + Fraction(1, 10)
            assert largest == above(extent)
    for name, (P, level) in zip(("area of the start", "area of {V ≤ c₂}"), sets, strict=True):
        assert [name, f"{below(volume(P, level))} m · m/s"] in page.rows
    for value in P0.ravel():
        assert repr(float(value)) in page.text
    assert volume(*sets[0]) > 1.5 * volume(*sets[1])  # or there would be nothing to show


def test_bars_show_both_shares_of_the_domain(proved: RoaResult) -> None:
    assert proved.certificate is not None and proved.checker is not None
    certificate = certificate_of(proved)
    html = render_html(certificate, dict(proved.checker), proved.to_dict(), proved.certificate)
    sides = [float(hi) for _, hi in certificate.system.domain]
    for pattern, P, level in (
        ("bar start", start_of(certificate), 1.0),
        ("bar", certificate.P, certificate.roa),
    ):
        found = [float(w) for w in re.findall(rf'<span class="{pattern}"><i style="width: ([\d.]+)%">', html)]
        assert found == pytest.approx(100 * extents(P, level) / sides, abs=0.06)


@pytest.mark.parametrize("answer", [{"result": "REJECTED", "rule": "tube", "at": "tube[0]"}, {"result": "odd"}])
def test_nothing_of_a_tube_is_called_proved_unless_it_was_accepted(proved: RoaResult, answer: dict[str, Any]) -> None:
    page = page_of(proved, answer)
    captions = [a.get("alt") or "" for _, a in page.tags]
    for shown in (page.text, *captions, *page.drawings()):
        assert not re.search(
            r"certified|proved (?:set|tube|start|outer)|PROVED"
            r"|(?<!here )(?<!nothing )is proved|was proved|ACCEPTED(?! or)",
            shown,
        )
    assert "claimed tube" in page.text and "in its band, if the claim is true" in page.text
    assert "claimed start of the tube" in page.text


def test_the_accepted_page_has_a_picture_of_the_tube_in_each_state(proved: RoaResult) -> None:
    page = page_of(proved)
    assert "The tube in p." in page.text and "The tube in v." in page.text and "proved tube" in page.text
    assert "if the claim is true" not in page.text and len(page.drawings()) == 5


@pytest.mark.parametrize(
    "change",
    slow_after(
        5,
        [
            {"slabs": [slab(np.full((2, 2), math.nan), np.eye(2))]},
            {"slabs": [slab(-np.eye(2), -np.eye(2))]},
            {"slabs": [slab(np.eye(2), np.zeros((2, 2)))]},
            {"slabs": [slab(np.eye(2), np.eye(2), math.inf)]},
            {"slabs": [slab(np.eye(2), np.eye(2), math.nan)]},
            {"slabs": [slab(np.eye(2), np.eye(2), 0.0)]},
            {"slabs": [slab(np.eye(2), np.eye(2), -1.0)]},
            {"start": -np.eye(2)},
            {"slabs": []},
        ],
    ),
    ids=["nan", "negative", "singular", "endless", "nan long", "at once", "backwards", "no start", "none"],
)
def test_a_refused_tube_still_has_a_page(change: dict[str, Any], tmp_path: Path) -> None:
    broken = enlarged(plane("-x", "-y"), QUIET, change.get("start", np.eye(2)), change.get("slabs", ()))
    answer = {"result": "REJECTED", "rule": "tube", "at": "tube[0]"}
    text = Page(render_html(broken, answer, None, tmp_path / "none.json")).text
    assert "rule tube at tube[0]" in text and "PROVED" not in text


# The tube over time


def test_the_shadow_is_that_of_bernsteins_form() -> None:
    time, half = shadow(np.array([[1.0]]), [slab(np.array([[2.0]]), np.array([[4.0]]), 3.0)])
    assert time[0] == 0 and time[-1] == 3 and half[0, 0] == 1 and half[-1, 0] == 0.5
    (middle,) = np.flatnonzero(time == 1.5)
    assert half[middle, 0] == pytest.approx(2 / 3, rel=1e-12)  # P = 1/4 + 2/2 + 4/4
    assert half[1, 0] < 1  # it moves from the first moment on


def test_the_shadow_meets_the_nodes_of_a_real_tube(proved: RoaResult) -> None:
    certificate = certificate_of(proved)
    slabs = slabs_of(certificate)
    time, half = shadow(start_of(certificate), slabs)
    assert np.all(np.diff(time) > 0) and time[-1] == pytest.approx(math.fsum(s.duration for s in slabs), rel=1e-12)
    pieces = (len(time) - 1) // len(slabs)
    for node, P in ((0, start_of(certificate)), *((k + 1, s.end) for k, s in enumerate(slabs))):
        assert half[node * pieces] == pytest.approx(extents(P, 1.0), rel=1e-9)


def test_simulated_trajectories_from_the_start_stay_in_the_shadow(proved: RoaResult) -> None:
    certificate = certificate_of(proved)
    scene = Scene(certificate, accepted=True)
    runs = runs_from(scene, starts(scene))
    inside = scene.detail.starts
    assert np.all(quadratic(start_of(certificate), runs.path[0, :inside]) == pytest.approx(0.999, rel=1e-9))
    time, half = shadow(start_of(certificate), slabs_of(certificate))
    at = runs.step * np.arange(len(runs.path))
    passed = at <= time[-1]
    assert passed.sum() > 20
    for k in range(2):
        width = np.interp(at[passed], time, half[:, k])
        share = np.abs(runs.path[passed][:, :inside, k]) / width[:, None]
        assert np.max(share) <= 1 + 1e-3 and np.max(share) > 0.9  # it would fail for a shadow half as wide again


def test_at_most_so_many_states_are_shown() -> None:
    n = MOST + 2
    system, network = chain(n, [-1.0 - k for k in range(n)])
    shares = np.arange(1.0, n + 1)
    start = np.diag((shares / n / 2) ** -2.0)
    certificate = enlarged(system, network, start, [slab(2 * start, 4 * start)], level=1e-3)
    scene = Scene(certificate, accepted=False)
    pictures = tube(scene, runs_from(scene, starts(scene)[:1], steps=2))
    assert len(pictures) == MOST and len({p.legend for p in pictures}) == 1
    drawn = {p.title.removeprefix("The tube in ") for p in pictures}
    sides = [float(hi) for _, hi in system.domain]
    far = np.argsort(-extents(start, 1.0) / sides, kind="stable")
    assert len(drawn) == MOST and f"The {MOST} of {n} states" in pictures[0].about
    from certify.report.words import symbol

    assert drawn == {symbol(system.states[k].name) for k in far[:MOST]}


# The planes


@pytest.mark.slow
def test_pictures_are_zoomed_to_the_larger_set_and_tell_the_two_apart() -> None:
    system, network = chain(4, [-1.0, -2.0, -3.0, -4.0])
    start = np.diag([4.0, 1.0, 4.0, 1.0]) / 0.04  # reaches 0.1 and 0.2
    certificate = enlarged(system, network, start, [slab(2 * start, 4 * start)], level=1e-4)  # which reaches 0.01
    pictures, _ = draw(certificate, accepted=True)
    first = pictures[0]
    numbers = [
        float(t.replace("\N{MINUS SIGN}", "-")) for t in re.findall(r">(\N{MINUS SIGN}?[\d.]+)</text>", first.svg)
    ]
    assert 0.1 <= max(map(abs, numbers)) <= 1.3 * 0.2
    texts = [key.text for key in first.legend]
    assert texts[:2] == ["proved start of the tube: projection", "section of the start"]
    assert {key.colour for key in first.legend[:2]} == {START} and START in first.svg.split("</style>")[-1]
    assert "the start takes" in first.caption and "{V ≤ c₂}" in first.caption
    plain, _ = draw(replace(certificate, claim=Asymptotic(roa=1e-4, local=5e-5)), accepted=True)
    assert not any("tube" in key.text for p in plain for key in p.legend)
    assert START not in plain[0].svg.split("</style>")[-1] and not any("The tube" in p.title for p in plain)


def test_nothing_from_a_certified_start_is_drawn_as_leaving(proved: RoaResult) -> None:
    scene = Scene(certificate_of(proved), accepted=True)
    runs = runs_from(scene, starts(scene))
    begins = quadratic(start_of(certificate_of(proved)), runs.path[0]) <= 1
    assert begins.any() and not np.any(runs.left & begins) and np.all(runs.settled[begins])
    outside = quadratic(scene.P, runs.path[0]) > scene.outer
    assert np.any(begins & outside)  # those that a picture without a tube would not ask twice
    for picture in draw(certificate_of(proved), accepted=True)[0]:
        if picture.title.startswith("The tube"):
            assert LEAVING not in picture.svg.split("</style>")[-1]


def test_a_run_from_the_start_that_leaves_for_its_step_alone_is_simulated_again() -> None:
    flow, begin = Flow.of(plane("-40*x", "-y"), QUIET), np.array([[0.8, 0.0]])
    fates = [
        runs_of(flow, begin, np.eye(2), 0.25, SETTLED * 0.25, 0.1, 60, start=start).left[0]
        for start in (None, np.eye(2), np.eye(2) / 0.3)  # 0.8 lies in the second alone
    ]
    assert fates == [True, False, True]


def test_a_claimed_start_that_runs_leave_is_not_spared() -> None:
    certificate = enlarged(plane("x**3 - x", "-y", 2), QUIET, np.eye(2) / 2.0, [slab(np.eye(2), 4 * np.eye(2))])
    scene = Scene(certificate, accepted=False)
    runs = runs_from(scene, starts(scene))
    assert np.any(runs.left[: scene.detail.starts])
    assert "trajectories that leave the domain*" in {key.text for key in keys(scene, runs, None, True)}
    pictures, roa = draw(certificate, accepted=False)
    assert roa is not None and roa.contradictions > 0
    drawn = next(p for p in pictures if p.title == "The tube in x")
    assert LEAVING in drawn.svg.split("</style>")[-1]


def test_the_simulated_share_counts_the_start(proved: RoaResult) -> None:
    c = certificate_of(proved)
    alone = simulated_roa_fraction(c.system, c.network, c.P, c.roa)
    both = simulated_roa_fraction(c.system, c.network, c.P, c.roa, start=start_of(c))
    x = np.stack(np.meshgrid(*both.axes, indexing="ij"), -1)
    wanted = (quadratic(c.P, x) <= c.roa) | (quadratic(start_of(c), x) <= 1)
    assert np.array_equal(both.certified, wanted) and both.certified.sum() > alone.certified.sum()
    assert np.array_equal(both.attracted, alone.attracted) and both.contradictions == 0
    assert f"set with the start of its tube covers {100 * both.fraction:.1f} % of the area" in page_of(proved).text


def test_the_figure_for_a_paper_shows_the_start(proved: RoaResult) -> None:
    certificate = certificate_of(proved)
    svg = paper_figure(certificate, True, PaperOptions(format="svg")).decode()
    assert "proved start of the tube" in svg and START in svg.split("</style>")[-1]
    assert "claimed start of the tube" in paper_figure(certificate, False, PaperOptions(format="svg")).decode()


def test_one_state_has_a_start_too(tmp_path: Path) -> None:
    result = certify_roa(*scalar_tanh(), tmp_path, RoaOptions(candidate="lyapunov", level=0.3, enlarge=True))
    assert result.claim == "enlarged"
    page = page_of(result)
    assert "proved start of the tube" in page.text and "The tube in x." in page.text
    assert "length of the start" in page.text and len(page.drawings()) == 4


# The terminal


def test_the_summary_says_of_which_set_its_sizes_are(proved: RoaResult) -> None:
    def rendered(data: dict[str, Any]) -> str:
        console = Console(file=io.StringIO(), width=160, color_system=None)
        console.print(summary(data))
        return " ".join(console.file.getvalue().split())  # type: ignore[attr-defined]

    data = proved.to_dict()
    text = rendered(data)
    assert "is invariant and attracted by the origin, and every trajectory from the tube's start enters it" in text
    assert (
        f"area {below(data['volume'])} m · m/s, of the tube's start" in text and "lengths, of the tube's start" in text
    )
    assert f"tube from an ellipsoid of the shape {data['tube']['shape']}, {data['tube']['slabs']} slabs" in text
    smaller = {**data, "volume": 2 * data["volume"]}  # of {V <= c2}, were it the larger one
    assert "of {V <= c2}" in rendered(smaller) and "of the tube's start" not in rendered(smaller)
    assert "lengths" not in rendered({**data, "tube": None})


@pytest.mark.parametrize("kind", ["enlarged", "reached"])
def test_no_more_is_said_of_the_loop_along_the_tube_than_is_proved(kind: str) -> None:
    """abs may have its corner in a tube, where the loop has no second derivative."""
    said = next(condition for name, condition, _ in CLAIMS[kind].parts if name == "Along the tube")
    assert "locally Lipschitz" in said and "differentiable" not in said
