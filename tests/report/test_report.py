"""Reports say what the certificate says, call nothing proved that is not, and load nothing from anywhere."""

from __future__ import annotations

import base64
import hashlib
import io
import json
import math
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from fractions import Fraction
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from certify.analysis.run import RoaOptions, certify_roa
from certify.certificates import (
    Certificate,
    PartitionTree,
    TrustedSolver,
    leaves,
    parse_certificate,
    read_certificate,
    read_raw,
    run_checker,
    write_atomically,
)
from certify.certificates.claims import CLAIMS as KINDS
from certify.certificates.claims import Asymptotic, Practical
from certify.certificates.verdict import Verdict
from certify.errors import CertificateFormatError, InputError, SoundnessError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import Number, Symbol, sin, symbols
from certify.loop.plants import System, get_system
from certify.loop.plants.ode import rk4_step
from certify.loop.policies import PolicyNetwork
from certify.lyapunov import domain_limit, solve_lyapunov, volume
from certify.lyapunov.function import Quadratic
from certify.report import render_html, simulated_roa_fraction, summary
from certify.report.claims import CLAIMS
from certify.report.figures import draw
from certify.report.figures.geometry import PARTS, ellipse, refine, shadow
from certify.report.flow import Flow, domain_bounds, simulate, time_scales
from certify.report.limits import limited_by, outer_limited_by
from certify.report.sampling import quadratic
from certify.report.sections.status import status_of
from certify.report.words import above, below, kept_apart, label, number, symbol
from tests.support.loops import box, chain, pendulum_network, scalar_tanh
from tests.support.marks import slow_after

ONE_LEAF = PartitionTree(np.eye(2), np.ones(2), bytes([255]))


@dataclass(frozen=True)
class Case:
    """A certificate with all that a report may be given."""

    certificate: Certificate
    answer: dict[str, Any]
    result: dict[str, Any]
    path: Path

    @property
    def raw(self) -> bytes:
        return self.path.read_bytes()

    @property
    def sha256(self) -> str:
        return hashlib.sha256(self.raw).hexdigest()

    def page(self) -> str:
        raw = self.raw
        return render_html(self.certificate, self.answer, self.result, self.path, sha256=self.sha256, size=len(raw))


def certified(system: System, network: PolicyNetwork, folder: Path) -> Case:
    result = certify_roa(
        system, network, folder, RoaOptions(candidate="lyapunov", effort=0.2), provenance={"numpy": "1.2.3-test"}
    )
    assert result.certificate is not None and result.checker is not None
    return Case(read_certificate(result.certificate), dict(result.checker), result.to_dict(), result.certificate)


def claimed(P: np.ndarray, local: float, roa: float) -> tuple[Quadratic, Asymptotic]:
    return Quadratic(P), Asymptotic(roa=roa, local=local)


def with_level(certificate: Certificate, roa: float) -> Certificate:
    return replace(certificate, claim=replace(certificate.claim, roa=roa))


def raw(certificate: Certificate) -> bytes:
    return certificate.to_json().encode()


def named(system: System) -> dict[str, Any]:
    """Names and units of states and inputs, as a result gives them."""
    return {
        key: [{"name": s.name, "unit": system.units.get(s.name, "")} for s in symbols]
        for key, symbols in (("states", system.states), ("inputs", system.inputs))
    }


@pytest.fixture(scope="module")
def pendulum_case(tmp_path_factory: pytest.TempPathFactory) -> Case:
    return certified(get_system("pendulum"), pendulum_network(), tmp_path_factory.mktemp("pendulum"))


@pytest.fixture(scope="module")
def scalar_case(tmp_path_factory: pytest.TempPathFactory) -> Case:
    return certified(*scalar_tanh(), tmp_path_factory.mktemp("scalar"))


@pytest.fixture(scope="module")
def chain_case(tmp_path_factory: pytest.TempPathFactory) -> Case:
    return certified(*chain(4, [-1.0, -2.0, -3.0, -4.0]), tmp_path_factory.mktemp("chain"))


class Page(HTMLParser):
    """What a browser would see: tags with their attributes, and the text."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.pieces: list[str] = []
        self.rows: list[list[str]] = []  # of tables
        self._styles = 0
        self.feed(html)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        self._styles += tag == "style"
        if tag == "tr":
            self.rows.append([])
        elif tag in ("td", "th") and self.rows:
            self.rows[-1].append("")

    def handle_endtag(self, tag: str) -> None:
        self._styles -= tag == "style"
        if tag == "table":
            self.rows.append([])

    def handle_data(self, data: str) -> None:
        if not self._styles:
            self.pieces.append(data)
        if self.rows and self.rows[-1] and data.strip():
            self.rows[-1][-1] += data

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.pieces).split())

    def drawings(self) -> list[str]:
        prefix = "data:image/svg+xml;base64,"
        sources = [attributes["src"] or "" for tag, attributes in self.tags if tag == "img"]
        assert all(source.startswith(prefix) for source in sources)
        return [base64.b64decode(source.removeprefix(prefix)).decode("utf-8") for source in sources]


# The partition


def random_tree(draw: Callable[[st.SearchStrategy[int]], int], n: int, depth: int) -> bytes:
    axis = draw(st.integers(-1, n - 1)) if depth else -1
    if axis < 0:
        return b"\xff"
    return bytes([axis]) + random_tree(draw, n, depth - 1) + random_tree(draw, n, depth - 1)


@st.composite
def trees(draw: Any) -> tuple[bytes, np.ndarray]:
    n = draw(st.integers(1, 4))
    root = np.array(draw(st.lists(st.floats(0.1, 10), min_size=n, max_size=n)))
    return random_tree(draw, n, 6), root


def recursive_leaves(tree: bytes, root: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """The rule of the format, word for word."""
    found: list[tuple[np.ndarray, np.ndarray]] = []
    nodes = iter(tree)

    def visit(lower: np.ndarray, upper: np.ndarray) -> None:
        axis = next(nodes)
        if axis == 255:
            found.append((lower, upper))
            return
        middle = 0.5 * lower[axis] + 0.5 * upper[axis]
        below, above = upper.copy(), lower.copy()
        below[axis] = above[axis] = middle
        visit(lower, below)
        visit(above, upper)

    visit(-root, root)
    return found


@given(trees())
def test_leaves_cover_the_root_box_exactly(case: tuple[bytes, np.ndarray]) -> None:
    tree, root = case
    lo, hi = leaves(tree, root)
    volumes = [
        math.prod(Fraction(float(b)) - Fraction(float(a)) for a, b in zip(lower, upper, strict=True))
        for lower, upper in zip(lo, hi, strict=True)
    ]
    assert sum(volumes) == math.prod(2 * Fraction(float(b)) for b in root)  # exact: no gap, given no overlap
    assert all(v > 0 for v in volumes)
    for (lower, upper), a, b in zip(recursive_leaves(tree, root), lo, hi, strict=True):
        assert np.array_equal(lower, a) and np.array_equal(upper, b)


def test_lower_half_first() -> None:
    lo, hi = leaves(bytes([1, 255, 0, 255, 255]), np.array([2.0, 4.0]))
    assert lo.tolist() == [[-2, -4], [-2, 0], [0, 0]]
    assert hi.tolist() == [[2, 0], [0, 4], [2, 4]]


@pytest.mark.parametrize(
    ("tree", "message"),
    [
        (b"", "ends early"),
        (bytes([0, 255]), "ends early"),
        (bytes([255, 255]), "too many"),
        (bytes([2, 255, 255]), "axis"),
    ],
)
def test_broken_trees_are_refused(tree: bytes, message: str) -> None:
    with pytest.raises(CertificateFormatError, match=message):
        leaves(tree, np.ones(2))


def test_leaves_of_a_real_certificate(pendulum_case: Case) -> None:
    certificate = pendulum_case.certificate
    evidence = certificate.evidence
    assert isinstance(evidence, PartitionTree)
    lo, hi = leaves(evidence.tree, evidence.root)
    assert len(lo) == pendulum_case.answer["leaves"]
    total = np.prod(hi - lo, axis=1).sum()
    assert total == pytest.approx(np.prod(2 * evidence.root), rel=1e-12)


# Geometry of the drawings


@given(st.integers(0, 10_000), st.floats(1e-6, 1e6))
def test_drawn_ellipses_lie_on_the_level(seed: int, level: float) -> None:
    generator = np.random.default_rng(seed)
    M = generator.standard_normal((4, 4))
    P = M @ M.T + 0.1 * np.eye(4)
    i, j = 1, 3
    section = np.zeros((241, 4))
    section[:, i], section[:, j] = ellipse(P, (i, j), level)
    assert np.allclose(quadratic(P, section), level, rtol=1e-9)
    # The projection: through each of its points passes a point of the level set, and none reaches further.
    inverse = np.linalg.inv(P)[np.ix_((i, j), (i, j))]
    projected = np.stack(shadow(P, (i, j), level), -1)
    assert np.allclose(quadratic(np.linalg.inv(inverse), projected), level, rtol=1e-6)
    assert np.max(np.abs(projected[:, 0])) <= math.sqrt(level * inverse[0, 0]) * (1 + 1e-9)
    assert np.max(np.abs(projected[:, 0])) >= math.sqrt(level * inverse[0, 0]) * (1 - 1e-3)


def test_refined_paths_keep_their_points_and_follow_the_flow() -> None:
    system, network = chain(2, [-1.0, -3.0])
    flow = Flow.of(system, network)
    errors = []
    for step in (0.2, 0.1):
        coarse = simulate(flow, np.array([[0.5, -0.2]]), step, 5)
        fine = refine(coarse, flow.field, step)
        assert np.array_equal(fine[::PARTS], coarse)
        pieces = 8 * PARTS  # of each step: exact enough
        exact = simulate(flow, coarse[0], step / pieces, 5 * pieces)[::8]
        errors.append(float(np.max(np.abs(fine - exact))))
    assert errors[1] < errors[0] / 8 and errors[1] < 1e-4  # of fourth order


# Simulation


def test_runge_kutta_has_order_four() -> None:
    errors = []
    for steps in (8, 16, 32):
        x = np.array([1.0, 0.0])
        for _ in range(steps):
            x = rk4_step(lambda s: np.array([s[1], -s[0]]), x, 1.0 / steps)
        errors.append(float(np.linalg.norm(x - [math.cos(1), -math.sin(1)])))
    assert 14 < errors[0] / errors[1] < 18 and 14 < errors[1] / errors[2] < 18


def test_scalar_roa_by_simulation_is_the_known_one() -> None:
    system, network = scalar_tanh()
    roa = simulated_roa_fraction(system, network, np.eye(1), 1.0, points=1201)
    inside = roa.axes[0][roa.attracted]
    cell = 6 / 1201
    assert abs(inside.max() - 1.915008048) < cell and abs(inside.min() + 1.915008048) < cell
    assert roa.fraction == pytest.approx(1 / 1.915008048, abs=2e-3)
    assert roa.contradictions == 0 and roa.undecided == 0


def test_a_set_that_is_too_large_is_contradicted() -> None:
    system, network = scalar_tanh()
    roa = simulated_roa_fraction(system, network, np.eye(1), 2.5**2)
    assert roa.contradictions > 0 and roa.fraction > 1


def test_stable_linear_plants_lose_only_what_leaves_the_domain() -> None:
    x, y, u = symbols("x y u")
    system = System("decay", (x, y), (u,), {}, (-x, -y + u), (Number(0),), box(1, 1), box(1))
    network = PolicyNetwork.of_layers((np.zeros((1, 2)),), (np.zeros(1),), np.ones(1), np.zeros(1), "tanh", "none")
    roa = simulated_roa_fraction(system, network, np.eye(2), 1.0, points=60)
    assert roa.attracted.all()
    assert roa.fraction == pytest.approx(math.pi / 4, abs=0.01)


def test_simulated_fraction_of_the_pendulum_contains_the_certified_set(pendulum_case: Case) -> None:
    c = pendulum_case.certificate
    roa = simulated_roa_fraction(c.system, c.network, c.P, c.roa)
    assert roa.contradictions == 0 and 0.3 < roa.fraction < 1
    finer = simulated_roa_fraction(c.system, c.network, c.P, c.roa, step=roa.step / 4)
    assert abs(finer.fraction - roa.fraction) < 0.01


def test_a_short_horizon_is_reported_as_undecided(pendulum_case: Case) -> None:
    c = pendulum_case.certificate
    assert simulated_roa_fraction(c.system, c.network, c.P, c.roa, points=9, horizon=0.01).undecided > 0


def test_grids_are_for_planes() -> None:
    system, network = chain(3, [-1.0, -2.0, -3.0])
    with pytest.raises(InputError, match="one or two states"):
        simulated_roa_fraction(system, network, np.eye(3), 1.0)


@pytest.mark.parametrize("wrong", [{"points": 0}, {"step": -1.0}, {"horizon": math.inf}])
def test_bad_options_are_refused(wrong: dict[str, Any]) -> None:
    system, network = scalar_tanh()
    with pytest.raises(InputError, match="positive and finite"):
        simulated_roa_fraction(system, network, np.eye(1), 1.0, **wrong)


def test_paths_end_where_they_leave_the_domain() -> None:
    system, network = scalar_tanh()
    flow = Flow.of(system, network)
    path = simulate(flow, np.array([[2.9], [1.0]]), 0.5, 40)
    lo, hi = domain_bounds(system)
    assert np.isnan(path[-1, 0, 0]) and abs(path[-1, 1, 0]) < 0.1
    finite = path[np.isfinite(path)]
    assert finite.min() >= lo[0] and finite.max() <= hi[0]


def test_the_step_resolves_a_plant_that_is_stiff_away_from_the_origin() -> None:
    x, u = symbols("x u")
    system = System("cubic", (x,), (u,), {}, (-x - x**3 + u,), (Number(0),), box(10), box(1))
    network = PolicyNetwork.of_layers((np.zeros((1, 1)),), (np.zeros(1),), np.ones(1), np.zeros(1), "tanh", "none")
    step, _ = time_scales(Flow.of(system, network))
    assert 1 / 301 <= step < 2 / 301  # the Jacobian is -301 at the domain's edge, -1 at the origin
    assert simulated_roa_fraction(system, network, np.eye(1), 1.0).attracted.all()


# The page


def test_the_page_loads_nothing_and_runs_nothing(pendulum_case: Case) -> None:
    html = pendulum_case.page()
    page = Page(html)
    assert len(html) < 2_000_000
    assert "http:" not in html and "https:" not in html and "url(" not in html and "@import" not in html
    for tag, attributes in page.tags:
        assert tag not in {"script", "link", "iframe", "object", "embed", "base", "form"}
        assert not any(name.startswith("on") for name in attributes)
        assert set(attributes) & {"srcset", "action"} == set()
        assert (attributes.get("href") or "#").startswith("#")
    drawings = page.drawings()
    assert len(drawings) == 5
    for drawing in drawings:
        root = ElementTree.fromstring(drawing)
        assert root.tag.endswith("svg")
        for element in root.iter():
            assert not element.tag.endswith("script")
            for name, value in element.attrib.items():
                if name.endswith("href"):
                    assert value.startswith(("#", "data:"))


def test_numbers_on_the_page_are_the_certificates(pendulum_case: Case) -> None:
    certificate, text = pendulum_case.certificate, Page(pendulum_case.page()).text
    assert repr(certificate.inner) in text and repr(certificate.roa) in text
    for value in certificate.P.ravel():
        assert repr(float(value)) in text
    assert certificate.network.sha256() in text
    assert pendulum_case.answer["certificate_sha256"] in text
    assert f"{pendulum_case.path.stat().st_size:,} bytes" in text
    assert f"{pendulum_case.answer['leaves']:,}, of which {pendulum_case.answer['ring_leaves']:,} in the ring" in text
    assert below(volume(certificate.P, certificate.roa)) + " rad · rad/s" in text
    assert "1.2.3-test" in text
    assert f"boxes examined {pendulum_case.result['boxes']:,}" in text


def test_what_was_proved_and_what_was_not(pendulum_case: Case) -> None:
    text = Page(pendulum_case.page()).text
    assert "PROVED · ACCEPTED" in text and "REJECTED." not in text
    assert f"starts in the set {{V(x) ≤ {below(pendulum_case.certificate.roa)}}}" in text
    assert f"the input stays within {number(-6.0)} ≤ u ≤ 6 N m" in text
    for item in ("Anything outside the set", "Disturbances", "sampled controller", "exact real arithmetic",
                 "Simulated figures"):  # fmt: skip
        assert item in text
    assert "certify check certificate.json" in text
    assert "python -I -m certify.checker certificate.json" in text


def test_the_checkers_modules_are_named_where_it_answered(pendulum_case: Case) -> None:
    used = ", ".join(pendulum_case.answer["modules"])
    assert "ring" in used and f"modules of the checker that were used {used}" in Page(pendulum_case.page()).text
    refused = {"result": "REJECTED", "rule": "ring", "at": "leaf 31", "modules": ["ring"]}
    silent = {name: value for name, value in pendulum_case.answer.items() if name != "modules"}
    for answer in (None, refused, silent):
        sha256 = pendulum_case.sha256
        html = render_html(pendulum_case.certificate, answer, None, pendulum_case.path, sha256=sha256)
        assert "modules of the checker" not in Page(html).text


def test_every_simulated_figure_says_so(pendulum_case: Case, scalar_case: Case, chain_case: Case) -> None:
    for case in (pendulum_case, scalar_case, chain_case):
        pictures, _ = draw(case.certificate, accepted=True)
        for picture in pictures:
            told = picture.svg + " ".join(key.text for key in picture.legend)
            simulated = any(word in told for word in ("trajectories", "simulated", "V(x(t))", "grid"))
            assert picture.simulated or not simulated
            if picture.simulated:
                assert "not proved" in picture.caption
        html = case.page()
        assert html.count('<span class="tag">with simulated lines, not proved</span>') == sum(
            p.simulated for p in pictures
        )
        assert html.count('<span class="tag">simulated, not proved</span>') == (case.certificate.system.n <= 2)


def test_the_simulated_share_is_the_sampled_one(pendulum_case: Case) -> None:
    c = pendulum_case.certificate
    roa = simulated_roa_fraction(c.system, c.network, c.P, c.roa)
    text = Page(pendulum_case.page()).text
    assert f"By simulation, the proved set covers {100 * roa.fraction:.1f} % of the area" in text
    assert "did not settle" not in text


def test_a_set_beyond_the_simulated_roa_is_pointed_out(scalar_case: Case) -> None:
    wider = with_level(scalar_case.certificate, 2.5**2 * float(scalar_case.certificate.P[0, 0]))
    text = Page(render_html(wider, None, None, scalar_case.path)).text
    assert "grid points of the set leave the domain in the simulation" in text


def test_equal_certificates_give_equal_pages(pendulum_case: Case) -> None:
    assert pendulum_case.page() == pendulum_case.page()


def test_rejected_is_on_the_page_and_nothing_is_called_proved(pendulum_case: Case) -> None:
    answer = {"result": "REJECTED", "rule": "ring", "at": "leaf 31", "detail": "Vdot < 0 is not shown"}
    html = render_html(pendulum_case.certificate, answer, None, pendulum_case.path)
    text = Page(html).text
    assert "REJECTED" in text and "rule ring at leaf 31: Vdot < 0 is not shown" in text
    assert "PROVED" not in text.replace("UNPROVED", "") and "What was proved" not in text
    assert "ACCEPTED" not in text.replace("ACCEPTED or REJECTED", "")
    assert "certified" not in text and "Shown on" not in text


@pytest.mark.parametrize("change", ["none", "odd"])
def test_only_an_answer_about_this_certificate_counts(pendulum_case: Case, change: str) -> None:
    answer: dict[str, Any] | None = dict(pendulum_case.answer)
    assert status_of(pendulum_case.certificate, pendulum_case.sha256, answer).accepted
    assert answer is not None
    if change == "none":
        answer = None
    else:
        answer["result"] = "accepted"
    assert status_of(pendulum_case.certificate, pendulum_case.sha256, answer).kind == "NOT CHECKED"
    text = Page(render_html(pendulum_case.certificate, answer, None, pendulum_case.path)).text
    assert "NOT CHECKED" in text and "What was proved" not in text


@pytest.mark.parametrize("verdict", ["ACCEPTED", "TRUSTED"])
@pytest.mark.parametrize("change", ["bytes", "no bytes", "policy", "level", "no levels"])
def test_an_answer_about_something_else_is_an_error(pendulum_case: Case, change: str, verdict: str) -> None:
    answer = dict(pendulum_case.answer) | {"result": verdict}
    if change == "bytes":
        answer["certificate_sha256"] = "0" * 64
    elif change == "no bytes":
        del answer["certificate_sha256"]
    elif change == "policy":
        answer["policy_sha256"] = "0" * 64
    elif change == "level":
        answer["levels"] = {**answer["levels"], "roa": math.nextafter(answer["levels"]["roa"], 0.0)}
    else:
        answer["levels"] = None
    with pytest.raises(SoundnessError, match="must be about the certificate that the report shows"):
        replace(pendulum_case, answer=answer).page()
    with pytest.raises(SoundnessError):  # nor is it taken for another solver's word
        status_of(pendulum_case.certificate, pendulum_case.sha256, dict(pendulum_case.answer) | {"result": "TRUSTED"})


def test_a_file_that_gives_other_bytes_at_each_read_gets_no_page(pendulum_case: Case, tmp_path: Path) -> None:
    """The file gives the reader an unstable plant and the checker a proved one; the old call must not merge them."""
    unstable = replace(
        pendulum_case.certificate.system, dynamics=tuple(-e for e in pendulum_case.certificate.system.dynamics)
    )
    shown = tmp_path / "shown.json"
    write_atomically(shown, raw(replace(pendulum_case.certificate, system=unstable)))
    read = read_certificate(shown)
    shown.write_bytes(pendulum_case.raw)
    answer = run_checker(shown)
    assert answer["result"] == "ACCEPTED"
    with pytest.raises(SoundnessError, match="sha256"):
        render_html(read, answer, None, shown)


def test_one_read_is_enough(pendulum_case: Case, tmp_path: Path) -> None:
    """From bytes that are read once: what is drawn is what was checked, in whatever layout the file has."""
    path = tmp_path / "certificate.json"
    raw = json.dumps(json.loads(pendulum_case.raw), indent=2).encode()
    path.write_bytes(raw)
    read = read_raw(path)
    path.unlink()
    private = tmp_path / "private.json"
    private.write_bytes(read)
    sha256, answer = hashlib.sha256(read).hexdigest(), run_checker(private)
    html = render_html(parse_certificate(read, str(path)), answer, None, path, sha256=sha256, size=len(read))
    assert "PROVED · ACCEPTED" in html and sha256 in html and f"{len(raw):,} bytes" in html
    with pytest.raises(SoundnessError):  # without the hash it is taken for a file that certify wrote, which it is not
        render_html(parse_certificate(read, str(path)), answer, None, path)


def test_the_run_must_be_the_certificates(pendulum_case: Case) -> None:
    for key, other in (("policy", {"sha256": "0" * 64, "layers": [2, 1]}), ("levels", {"roa": 1.0})):
        with pytest.raises(InputError, match="`result` must be of the run"):
            replace(pendulum_case, result={**pendulum_case.result, key: other}).page()


def test_leaves_that_were_not_asked_are_not_called_shown(chain_case: Case) -> None:
    assert chain_case.certificate.inner == chain_case.certificate.roa
    page = Page(chain_case.page())
    assert "As c₁ = c₂, the local part covers the whole set." in page.text
    assert "the checker showed" not in page.text and "Shown on" not in page.text


def test_a_page_reads_no_file(pendulum_case: Case) -> None:
    elsewhere = Path("/nowhere/at/all/certificate.json")
    c = pendulum_case
    assert render_html(c.certificate, c.answer, c.result, elsewhere, sha256=c.sha256, size=len(c.raw)) == c.page()


def test_a_tampered_file_is_reported_as_rejected(pendulum_case: Case, tmp_path: Path) -> None:
    path = tmp_path / "certificate.json"
    write_atomically(path, raw(with_level(pendulum_case.certificate, pendulum_case.certificate.roa * 1.5)))
    text = Page(render_html(read_certificate(path), run_checker(path), None, path)).text
    assert "REJECTED" in text and "PROVED" not in text


HOSTILE = "<script>alert('x')</script> $\\frac$ & \"quoted\" {{ 7 * 7 }}"


def hostile_certificate() -> Certificate:
    """Names that a System refuses, put in behind its back; a page must survive them all the same."""
    x, y = Symbol("<img src=x onerror=alert(1)>"), Symbol("$\\frac$")
    u = Symbol("</svg><script>u</script>")
    a, b, v = symbols("a b v")
    system = System("plain", (a, b), (v,), {}, (-a + v, -b + sin(a)), (Number(0),), box(1, 1), box(2))
    hostile = {"name": HOSTILE, "states": (x, y), "inputs": (u,), "dynamics": (-x + u, -y + sin(x))}
    for field, value in hostile.items():
        object.__setattr__(system, field, value)
    network = PolicyNetwork.of_layers(
        (np.array([[0.1, 0.2]]),), (np.zeros(1),), np.ones(1), np.zeros(1), "tanh", "none"
    )
    return Certificate(system, network, *claimed(np.eye(2), 0.1, 0.5), ONE_LEAF, {HOSTILE: HOSTILE})


def test_hostile_names_are_text(tmp_path: Path) -> None:
    path = tmp_path / "<b>&.json"
    answer = {"result": "REJECTED", "rule": HOSTILE, "at": HOSTILE, "detail": HOSTILE}
    html = render_html(hostile_certificate(), answer, None, path)
    page = Page(html)
    known = {"html", "head", "meta", "title", "style", "body", "main", "h1", "h2", "h3", "p", "code", "div", "strong",
             "b", "span", "ol", "ul", "li", "figure", "img", "figcaption", "table", "thead", "tr", "th", "td", "pre",
             "nav", "a", "i", "math", "mi", "mn", "mo", "mrow", "mfrac", "mover", "msup", "mspace",
             "mfenced"}  # fmt: skip
    assert {tag for tag, _ in page.tags} <= known
    assert not any(name.startswith("on") for _, attributes in page.tags for name in attributes)
    assert "alert('x')" in page.text and "{{ 7 * 7 }}" in page.text
    assert len(page.drawings()) == 5
    for drawing in page.drawings():
        assert not any(e.tag.endswith(("script", "img")) for e in ElementTree.fromstring(drawing).iter())


@pytest.mark.parametrize(
    "change",
    [
        {"evidence": replace(ONE_LEAF, tree=bytes([0, 255]))},
        {"V": Quadratic(-np.eye(2))},
        {"V": Quadratic(np.zeros((2, 2)))},
        {"claim": Asymptotic(roa=-1.0, local=0.1)},
        {"claim": Asymptotic(roa=0.5, local=math.inf)},
    ],
    ids=["tree", "negative", "zero", "level", "infinite"],
)
def test_a_rejected_file_that_cannot_be_drawn_still_has_a_page(change: dict[str, Any], tmp_path: Path) -> None:
    broken = replace(hostile_certificate(), **change)
    answer = {"result": "REJECTED", "rule": "coverage", "at": "tree"}
    text = Page(render_html(broken, answer, None, tmp_path / "none.json")).text
    assert "There are no figures" in text and "rule coverage at tree" in text


def test_an_accepted_certificate_that_cannot_be_drawn_is_an_error(pendulum_case: Case) -> None:
    broken = replace(pendulum_case.certificate, evidence=replace(ONE_LEAF, tree=b""))
    with pytest.raises(CertificateFormatError):
        render_html(broken, pendulum_case.answer, None, pendulum_case.path, sha256=pendulum_case.sha256)


@pytest.mark.parametrize("name", ["scalar_case", "chain_case"])
def test_other_dimensions(name: str, request: pytest.FixtureRequest) -> None:
    case: Case = request.getfixturevalue(name)
    page = Page(case.page())
    assert "PROVED · ACCEPTED" in page.text
    assert repr(case.certificate.roa) in page.text
    assert len(page.drawings()) == {"scalar_case": 3, "chain_case": 6}[name]  # four planes, the policy, V
    if name == "chain_case":
        assert "x₁, x₂." in page.text and "all states together" in page.text
        assert (
            "its section through the origin" in page.text
            and f"V = {below(case.certificate.roa)}: projection" in page.text
        )
        assert "By simulation" not in page.text


def test_many_leaves_are_rasterised() -> None:
    system, network = chain(2, [-1.0, -3.0])
    A, _, _ = ClosedLoop(system, network).linearise()
    P = solve_lyapunov(A, np.eye(2))
    depth = 12
    tree = b"\xff"
    for k in range(depth):
        tree = bytes([k % 2]) + tree + tree
    certificate = Certificate(system, network, *claimed(P, 1e-3, 0.5), PartitionTree(np.eye(2), np.ones(2), tree))
    picture = next(p for p in draw(certificate, accepted=False)[0] if p.title == "The leaf partition")
    assert "4,096 leaves" in picture.caption and "data:image/png" in picture.svg
    assert len(picture.svg) < 500_000


def test_long_fractions_are_rounded_and_the_page_says_so(scalar_case: Case) -> None:
    c = scalar_case.certificate
    x, u = c.system.states[0], c.system.inputs[0]
    tenth = Fraction(*(0.1).as_integer_ratio())
    long = replace(c, system=replace(c.system, dynamics=(tenth * x + u,)))
    text = Page(render_html(long, None, None, scalar_case.path)).text
    assert "Long fractions are rounded here" in text
    assert "Long fractions" not in Page(scalar_case.page()).text


def test_a_pole_in_the_domain_does_no_harm() -> None:
    x, y, u = symbols("x y u")
    system = System("pole", (x, y), (u,), {}, (-x, -y + x**2 / (1 - x) + u), (Number(0),), box(2, 2), box(2))
    network = PolicyNetwork.of_layers(
        (np.array([[0.1, 0.2]]),), (np.zeros(1),), np.ones(1), np.zeros(1), "tanh", "none"
    )
    certificate = Certificate(system, network, *claimed(np.eye(2), 0.01, 0.02), ONE_LEAF)
    pictures, roa = draw(certificate, accepted=False)
    assert len(pictures) == 5 and roa is not None and roa.contradictions == 0


# Words


def test_symbols_and_units(pendulum_case: Case) -> None:
    assert symbol("theta_dot") == "θ\u0307" and symbol("x12") == "x₁₂" and symbol("_") == "_"
    assert label("v", "m/s^2") == "v (m/s²)"
    assert pendulum_case.certificate.system.units["theta_dot"] == "rad/s"


def exactly(text: str) -> Fraction:
    """The decimal that a text shows."""
    mantissa, _, power = text.replace("\N{MINUS SIGN}", "-").partition(" \N{MULTIPLICATION SIGN} 10")
    exponent = int(power.translate(str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻", "0123456789-"))) if power else 0
    return Fraction(mantissa) * Fraction(10) ** exponent


@given(
    st.floats(allow_nan=False, allow_infinity=False) | st.fractions() | st.integers(-9, 9).map(lambda k: 10.0**k),
    st.integers(1, 17),
)
def test_rounded_texts_keep_their_direction(value: float | Fraction, digits: int) -> None:
    down, up, exact = exactly(below(value, digits)), exactly(above(value, digits)), Fraction(value)
    assert down <= exact <= up
    assert up - down <= abs(exact) * Fraction(10) ** (1 - digits)


@given(st.floats(1e-3, 1e3), st.floats(1e-12, 1))
def test_what_is_smaller_is_shown_smaller(value: float, gap: float) -> None:
    limit = Fraction(value) * (1 + Fraction(gap))
    shown, less_than = map(exactly, kept_apart(value, limit).split(" < "))
    assert Fraction(value) <= shown < less_than <= limit


def test_numbers_on_the_page_are_rounded_to_the_safe_side() -> None:
    """Of a set whose P has condition 1e14, against exact arithmetic."""
    system, network = chain(2, [-1.0, -3.0])
    d = 2.0**-45
    P = np.array([[1.0, 1.0], [1.0, 1.0 + d]])  # its inverse is ((1 + 1/d, -1/d), (-1/d, 1/d))
    c2 = 0.7 * d
    page = Page(
        render_html(Certificate(system, network, *claimed(P, c2 / 2, c2), ONE_LEAF), None, None, Path("c.json"))
    )
    first = next(row for row in page.rows if row and row[0] == "x₁" and not row[1].startswith("±"))
    axis, extent = exactly(first[1]) ** 2, exactly(first[2]) ** 2
    assert axis <= Fraction(c2) < axis * (1 + Fraction(1, 10**4))
    reached = Fraction(c2) * (1 + 1 / Fraction(d))
    assert reached <= extent < reached * (1 + Fraction(1, 10**4))
    area = next(exactly(row[1]) for row in page.rows if row and row[0] == "area")
    pi = Fraction(31415926535897932384626433832795, 10**31)
    assert area**2 <= pi**2 * Fraction(c2) ** 2 / Fraction(d) < area**2 * (1 + Fraction(1, 10**4))


# The terminal


def rendered(result: dict[str, Any], width: int = 100) -> str:
    console = Console(file=io.StringIO(), width=width, color_system=None)
    console.print(summary(result))
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert isinstance(text, str)
    return text


def test_summary_of_a_proof(pendulum_case: Case) -> None:
    result = json.loads(json.dumps(pendulum_case.result))  # what `--json` prints is enough
    text = rendered(result)
    assert text.startswith("PROVED  pendulum")
    for shown in (below(result["levels"]["roa"]), below(result["levels"]["local"]), below(result["volume"]),
                  result["policy"]["sha256"][:16] + "…", "2-16-16-1", f"{result['leaves']:,} leaves", "ACCEPTED",
                  "rad/s", above(result["extents"][1]), below(result["semi_axes"][0])):  # fmt: skip
        assert shown in text
    assert all(stage in text for stage in ("candidate", "local", "ring", "write", "check"))


def test_units_are_the_certificates_own(tmp_path: Path) -> None:
    """A plant that bears the name of another: nothing of the other's appears."""
    x, v, u = symbols("range speed u")
    units = {"range": "km", "speed": "<b>kn</b>", "u": "kN"}
    plant = System("pendulum", (x, v), (u,), {}, (-x + u, -v), (Number(0),), box(1, 1), box(2), units=units)
    network = PolicyNetwork.of_layers(
        (np.array([[0.1, 0.2]]),), (np.zeros(1),), np.ones(1), np.zeros(1), "tanh", "none"
    )
    path = tmp_path / "certificate.json"
    write_atomically(
        path, raw(Certificate(plant, network, *claimed(np.eye(2), 0.1, 0.5), ONE_LEAF, {"policy": "p.pt"}))
    )
    read = read_certificate(path)
    assert dict(read.system.units) == units and read.provenance == {"policy": "p.pt"}
    assert read.to_json() == path.read_text()
    html = render_html(read, None, None, path)
    page = Page(html)
    assert "range (km)" in page.text and "kN" in page.text and "<b>kn</b>" in page.text and "<b>kn" not in html
    for shown in (page.text, *page.drawings()):
        assert not re.search(r"\brad\b", shown)


def test_a_certificate_without_units_gets_none(pendulum_case: Case) -> None:
    data = json.loads(pendulum_case.raw)
    assert data["provenance"].pop("units") == {"theta": "rad", "theta_dot": "rad/s", "u": "N m"}
    read = parse_certificate(json.dumps(data).encode(), "edited")
    page = Page(render_html(read, None, None, pendulum_case.path))
    for shown in (page.text, *page.drawings()):
        assert not re.search(r"\brad\b", shown)


def test_the_summary_looks_no_plant_up(pendulum_case: Case) -> None:
    result = {**pendulum_case.result, "states": [{"name": "range", "unit": "km"}, {"name": "speed", "unit": "kn"}]}
    result["diagnosis"] = None  # which names the states as the run did
    text = rendered(result)
    assert "range (km)" in text and "speed (kn)" in text and "km · kn" in text and "rad" not in text
    old = {k: v for k, v in pendulum_case.result.items() if k not in ("states", "inputs", "diagnosis")}
    assert "rad" not in rendered(old) and "θ" not in rendered(old) and "x₁" in rendered(old)


@pytest.mark.parametrize(
    "provenance",
    slow_after(
        2,
        [
            [],
            "text",
            None,
            {"units": []},
            {"units": "rad"},
            {"units": {"theta": 1}},
            {"units": {"theta": "r" * 41}},
            {"units": {"nobody": "rad"}},
            {"units": {"theta": "a\u0000b"}},
            {"units": {"theta": "\ud800"}},
            {"units": {"theta": None}, "half": "\ud800", "deep": [[{}]]},
        ],
    ),
)
def test_a_provenance_of_any_kind_does_no_harm(pendulum_case: Case, provenance: Any) -> None:
    data = json.loads(pendulum_case.raw)
    data["provenance"] = provenance
    read = parse_certificate(json.dumps(data).encode(), "edited")
    assert dict(read.system.units) == {}
    render_html(read, None, None, pendulum_case.path).encode("utf-8")


# Another solver's word


@pytest.fixture(scope="module")
def trusted_case(pendulum_case: Case, tmp_path_factory: pytest.TempPathFactory) -> Case:
    """What a run of an engine leaves whose answers nobody can replay, 4 deltas below the domain's limit."""
    path = tmp_path_factory.mktemp("trusted") / "certificate.json"
    c = pendulum_case.certificate
    limit = domain_limit(c.P, c.system.domain)
    level = limit * (1 - 4e-3)
    evidence = TrustedSolver("dreal", "4.21.06", 1e-3, (("local-0.1", "unsat"), ("ring-7", "unsat")))
    write_atomically(path, raw(replace(with_level(c, level), evidence=evidence)))
    query = {"query": "ring", "level": 7.0, "answer": "unsat", "seconds": 1.0, "detail": ""}
    result = {
        **pendulum_case.result,
        "verdict": "PROVED",
        "checked": "TRUSTED",
        "reason": "domain",
        "levels": {"local": c.inner, "roa": level, "domain_limit": limit, "sampled_limit": None},
        "solver": {"solver": "dreal", "version": "4.21.06", "precision": 1e-3, "queries": [query]},
        "boxes": 0,
        "leaves": 0,
    }
    return Case(read_certificate(path), run_checker(path), result, path)


def test_a_trusted_page_is_about_answers_and_not_about_leaves(trusted_case: Case) -> None:
    assert trusted_case.answer["result"] == "TRUSTED"
    page = Page(trusted_case.page())
    text = page.text
    assert "TRUSTED" in text and "PROVED" not in text and "ACCEPTED" not in text and "What was proved" not in text
    captions = [a.get("alt") or "" for _, a in page.tags]
    for shown in (text, *page.drawings(), *captions):
        assert not re.search(r"\blea(f|ves)\b|partition|linearisation and a bound|certified", shown)
    assert text.count("Not checked: dreal's word.") == 4 and text.count("Checked in exact arithmetic.") == 2
    assert "dreal 4.21.06, delta 0.001" in text and ["its answer to ring-7", "unsat"] in page.rows


def test_a_trusted_summary_says_so_first(trusted_case: Case) -> None:
    for verdict in ("PROVED", "TRUSTED"):
        text = rendered({**trusted_case.result, "verdict": verdict})
        assert text.startswith("TRUSTED  pendulum") and "PROVED" not in text
        assert "if the solver is right" in " ".join(text.split())
    assert rendered({**trusted_case.result, "checked": None}).startswith("UNKNOWN")


def test_what_limits_is_the_margin_and_not_the_domain(trusted_case: Case) -> None:
    words = limited_by(trusted_case.result)
    assert words.startswith("the precision of dreal (delta 0.001), which stops 0.4 % below the domain's limit 7.")
    page = Page(trusted_case.page())
    assert words in page.text and words in " ".join(rendered(trusted_case.result, 400).split())
    assert any(row[0] == "domain's limit" and "of which c₂ is 99.6" in row[1] for row in page.rows if len(row) > 1)
    levels = trusted_case.result["levels"]
    close = {**trusted_case.result, "levels": {**levels, "roa": levels["domain_limit"] * (1 - 1e-9)}}
    assert limited_by(close) == "the domain"


def test_a_limit_that_is_near_says_how_near() -> None:
    levels = {"roa": 0.998, "domain_limit": 1.0}
    near = "domain: the effort ended 0.2 % below its limit"
    assert limited_by({"reason": near, "levels": levels}) == f"the {near}"
    small = limited_by({"reason": "boxes too small", "levels": levels})
    assert "more effort gains nothing" in small and outer_limited_by({"limit": "boxes too small"}) == small


def test_trusted_is_a_verdict_of_its_own() -> None:
    assert Verdict.TRUSTED.exit_status == Verdict.UNKNOWN.exit_status == 3
    assert Verdict("TRUSTED") is not Verdict.PROVED


# The practical claim


@pytest.fixture(scope="module")
def practical_case(tmp_path_factory: pytest.TempPathFactory) -> Case:
    """x' = 1/4 - x + u and y' = -y with u = tanh(x)/10: no equilibrium at 0, but V = x^2 + y^2 falls for V >= 1/3."""
    x, y, u = symbols("x y u")
    f = (Fraction(1, 4) - x + u, -y)
    system = System("drifting", (x, y), (u,), {}, f, (Number(0),), box(2, 2), box(1))
    network = PolicyNetwork.of_layers(
        (np.array([[1.0, 0.0]]),), (np.zeros(1),), np.full(1, 0.1), np.zeros(1), "tanh", "none"
    )
    path = tmp_path_factory.mktemp("practical") / "certificate.json"
    write_atomically(
        path,
        raw(Certificate(system, network, Quadratic(np.eye(2)), Practical(roa=1.7, local=1 / 3, floor=1 / 3), ONE_LEAF)),
    )
    answer = {
        "result": "ACCEPTED",
        "certificate_sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
        "policy_sha256": network.sha256(),
        "levels": {"floor": 1 / 3, "local": 1 / 3, "roa": 1.7},
        "leaves": 9,
        "ring_leaves": 8,
        "margins": {"local": None, "ring": 0.0123456},
    }
    result = {
        "verdict": "PROVED",
        "reason": "requested",
        "system": "drifting",
        "claim": {"kind": "practical"},
        "policy": {"sha256": network.sha256(), "layers": [2, 1], "words": "2-1"},
        "levels": {"local": 1 / 3, "floor": 1 / 3, "roa": 1.7, "sampled_limit": None, "domain_limit": 4.0},
        "checked": "ACCEPTED",
        "volume": 5.0,
        "semi_axes": [1.3, 1.3],
        "extents": [1.3, 1.3],
        "seconds": {"total": 1.0},
        "boxes": 9,
        "leaves": 9,
        **named(system),
    }
    return Case(read_certificate(path), answer, result, path)


def test_the_practical_claim_survives_the_file(practical_case: Case) -> None:
    data, read = json.loads(practical_case.raw), practical_case.certificate
    assert data["claim"] == {"kind": "practical", "rate": "0x0.0p+0", "sample": None, "outer": None}
    assert set(data["levels"]) == {"floor", "local", "roa"}
    assert (read.kind, read.inner, read.to_json()) == ("practical", 1 / 3, practical_case.raw.decode())
    for kind in ("other", ["practical"], None):
        data["claim"]["kind"] = kind
        with pytest.raises(CertificateFormatError, match=r"asymptotic, practical|unhashable"):
            parse_certificate(json.dumps(data).encode(), "edited")


MISREAD = re.compile(r"asymptotic|attract|converge|local set|c₁|\(local\)|[Rr]egion of attraction|settle")


def test_a_practical_page_cannot_be_misread(practical_case: Case) -> None:
    page = Page(practical_case.page())
    text = page.text
    assert "PROVED · ACCEPTED" in text and "Practical stability of drifting" in text
    assert f"enters the smaller set {{V(x) ≤ {above(1 / 3)}}} in finite time" in text
    assert f"starts in the set {{V(x) ≤ {below(1.7)}}}" in text
    excluded = "The origin need not attract them, and need not be an equilibrium at all."
    assert "Anything inside {V ≤ c₀}." in text and excluded in text
    for shown in (text.replace(excluded, ""), *page.drawings(), *(a.get("alt") or "" for _, a in page.tags)):
        assert MISREAD.search(shown) is None, MISREAD.search(shown)
    assert "Equilibrium." not in text and "Local." not in text and "has 5 parts" in text
    assert ["c₀, floor", repr(1 / 3)] in page.rows
    assert "inner set, V = 0.334" in text


def test_a_practical_summary_cannot_be_misread(practical_case: Case) -> None:
    text = " ".join(rendered(practical_case.result, 200).split())
    assert text.startswith("PROVED drifting: from {V <= 1.69999} every trajectory enters {V <= 0.333334} and stays")
    assert "floor c0 0.333334, proved c2 1.69999" in text and "nothing is claimed about the origin" in text
    assert MISREAD.search(text) is None


def test_runs_of_the_practical_claim_count_when_they_enter_the_inner_set(practical_case: Case) -> None:
    pictures, roa = draw(practical_case.certificate, accepted=True)
    assert roa is not None and roa.contradictions == 0 and roa.attracted.any() and len(pictures) == 5
    # near the origin none of them stays: the equilibrium is at x = 0.278
    c = practical_case.certificate
    assert not simulated_roa_fraction(c.system, c.network, c.P, c.roa).attracted.all()


def test_every_claim_has_all_its_words() -> None:
    assert set(CLAIMS) == set(KINDS)
    for kind, words in CLAIMS.items():
        assert words.inner_word == ("local" if KINDS[kind].at_rest else "floor")
        assert {"Equations", "Domain", "Ring", "Inputs"} <= {name for name, _, _ in words.parts}


def test_summary_without_a_proof() -> None:
    refuted = {
        "schema": "certify-roa/1", "verdict": "REFUTED", "reason": "unstable linearisation: eigenvalues 3.1, -5.8",
        "system": "pendulum", "policy": {"sha256": "ab", "layers": [2, 1], "words": "2-1"}, "lyapunov": {"P": None},
        "levels": {"local": None, "roa": None, "sampled_limit": None, "domain_limit": None}, "witness": None,
        "eigenvalues": ["3.1", "-5.8"], "volume": None, "semi_axes": None, "extents": None, "boxes": 0, "leaves": 0,
        "seconds": {"load": 0.0, "total": 0.1}, "certificate": None, "checked": None,
    }  # fmt: skip
    text = rendered(refuted)
    assert text.startswith("REFUTED") and "3.1, -5.8" in text and "not reached" in text
    assert "invariant" not in text and "another V may show" in text
    unstable = rendered({**refuted, "stop": "unstable"})
    assert "the closed loop is unstable at the origin, so that no V can prove the claim" in unstable
    assert "another V" not in unstable
    again = {"stiffness": None, "hurts": {}, "kind": "unstable", "next": {"options": {}, "why": refuted["reason"]}}
    assert "try next" not in rendered({**refuted, "diagnosis": again})  # it would only repeat the reason
    elsewhere = rendered({**refuted, "stop": "unstable", "operating_point": {"theta": "1/2"}})
    assert "unstable at the operating point" in elsewhere
    unknown = rendered({**refuted, "verdict": "UNKNOWN", "reason": "[bold]time[/bold]", "system": "[red]x[/red]"})
    assert "nothing was proved" in unknown and "[bold]time[/bold]" in unknown and "[red]x[/red]" in unknown


def test_importing_the_report_loads_no_drawing_library() -> None:
    code = (
        "import sys, certify.report\n"
        "assert certify.report.summary and certify.report.render_html\n"
        "loaded = {'matplotlib', 'jinja2'} & set(sys.modules)\n"
        "assert not loaded, loaded\n"
        "from certify.report import page, sheet\n"
        "sheet.template(*page.TEMPLATE)\n"
        "assert 'jinja2' in sys.modules and 'matplotlib.pyplot' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
