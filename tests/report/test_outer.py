"""A claim with an outer set: what belongs to it and what does not is said, estimates are called so, figures show it."""

from __future__ import annotations

import base64
import copy
import hashlib
import io
import json
import math
import re
import struct
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from certify import certify_roa as certify
from certify.analysis.results import RoaResult
from certify.certificates import Certificate, parse_certificate, run_checker
from certify.certificates.claims import Asymptotic, Outer
from certify.certificates.verdict import Stop, Verdict
from certify.errors import InputError, SoundnessError
from certify.loop.expressions import Number, exp, sqrt, symbols
from certify.loop.plants import System
from certify.loop.policies import PolicyNetwork
from certify.lyapunov import Neural, Polynomial, Symbolic, sampled_volume
from certify.lyapunov.function import Quadratic
from certify.report import render_html, summary
from certify.report.claims import CLAIMS, Additions, words_for
from certify.report.figures import draw, simulated_roa
from certify.report.figures.paper import set_figure
from certify.report.figures.scene import Scene
from certify.report.figures.style import START
from certify.report.figures.trajectories import farthest, runs_from, starts
from certify.report.limits import outer_limited_by
from certify.report.sampling import quadratic
from certify.report.sections.claim import _beyond, claim_of
from certify.report.sections.status import Status, missed_of, status_of
from tests.report.test_report import ONE_LEAF, Page, exactly
from tests.support.beyond import line, network, plane, well
from tests.support.certificates import Document, write
from tests.support.loops import box, chain

F = Fraction


@dataclass(frozen=True)
class Case:
    """A file with what the checker says of it."""

    data: Document
    path: Path
    answer: dict[str, Any]

    @classmethod
    def of(cls, data: Document, folder: Path) -> Case:
        path = write(data, folder)
        return cls(data, path, run_checker(path))

    @property
    def certificate(self) -> Certificate:
        return parse_certificate(self.path.read_bytes(), "certificate")

    @property
    def sha256(self) -> str:
        return hashlib.sha256(self.path.read_bytes()).hexdigest()

    def page(self) -> Page:
        return Page(_rendered(self.path, json.dumps(self.answer)))


@cache
def _rendered(path: Path, answer: str) -> str:
    raw = path.read_bytes()
    sha256 = hashlib.sha256(raw).hexdigest()
    return render_html(parse_certificate(raw, "certificate"), json.loads(answer), None, path, sha256=sha256)


@pytest.fixture(scope="module")
def by_network(tmp_path_factory: pytest.TempPathFactory) -> Case:
    return Case.of(network(), tmp_path_factory.mktemp("network"))


@pytest.fixture(scope="module")
def by_formula(tmp_path_factory: pytest.TempPathFactory) -> Case:
    return Case.of(plane(), tmp_path_factory.mktemp("formula"))


@pytest.fixture(scope="module")
def practical(tmp_path_factory: pytest.TempPathFactory) -> Case:
    return Case.of(plane(claim="practical"), tmp_path_factory.mktemp("practical"))


def named(data: Document) -> str:
    """The hash by which a network N is named, written down a second time."""
    digest = hashlib.sha256(b"certify-lyapunov/1\0")
    for layer in data["claim"]["outer"]["layers"]:
        rows, columns = layer["shape"]
        digest.update(struct.pack("<3Q", 2, rows, columns) + base64.b64decode(layer["weight"]))
        digest.update(struct.pack("<2Q", 1, rows) + base64.b64decode(layer["bias"]))
    return digest.hexdigest()


# The checker's words


def test_the_checker_says_what_the_format_says(by_network: Case, by_formula: Case) -> None:
    for case, level, names in (
        (by_network, "-2.55", ["N(x) = N[0](x, y)", f"network N: 2-4-1 tanh, sha256 {named(by_network.data)}"]),
        (by_formula, "0.9", ["N(x) = ((x * x) + ((1/4) * y * y))"]),
    ):
        assert case.answer["result"] == "ACCEPTED"
        text = case.answer["text"]
        assert set(names) <= set(text) and f" n2={level} " in text[-1]
        said = text[next(k for k, one in enumerate(text) if one.startswith("claim:")) + 1]
        assert said == (
            "  and every trajectory that starts in the union of V <= 0.25 and of the states of the domain with "
            f"N(x) <= {level} stays in this union, enters V <= 0.25 in finite time, and from then on is one of those "
            "above; u stays in its bounds; states outside the domain are not meant, whatever N is there"
        )
        found = case.answer["outer"]
        assert found == {"level": float(level), "leaves": 4096, "face_leaves": 32}
        assert case.answer["margins"]["outer"] > 0


# The page


def test_the_statement_says_which_states_and_what_becomes_of_them(by_network: Case) -> None:
    page = by_network.page()
    text = page.text
    assert "starts in the set {V(x) ≤ 0.25} stays in it for all time and converges to the origin" in text
    assert (
        "Moreover every trajectory that starts in the outer set, the states x of the domain with N(x) ≤ −2.55 and no "
        "others, enters {V(x) ≤ 0.25} in finite time, and from then on behaves as just stated; on the way it "
        "stays in the union of the two sets." in text
    )
    assert "N is the 2-4-1 tanh network" in text and named(by_network.data) in text
    assert "c₁ = 0.0625 (local), c₂ = 0.25 (enlarged) and n₂ = −2.55 (of N)" in text
    assert "The proof has 8 parts" in text and "Shown on 32 leaves." in text and "Shown on 4,096 leaves; " in text
    for head in ("Other parts of {N ≤ n₂}.", "When {V ≤ c₂} is entered.", "V and N on the way."):
        assert head in text
    assert "what starts outside {V ≤ c₂} and the outer set may do the same or not" in text
    assert ["n₂, of N", "-2.55"] in page.rows and ["sha256 of N", named(by_network.data)] in page.rows
    assert "tube" not in text


def test_an_expression_is_shown_as_it_is(by_formula: Case) -> None:
    html = _rendered(by_formula.path, json.dumps(by_formula.answer))
    assert "<mi>N</mi><mo>(</mo><mi>x</mi><mo>)</mo><mo>=</mo>" in html and "sha256 of N" not in html
    x, y = by_formula.certificate.system.states
    long = Symbolic(sum(((x - k) ** 2 * y for k in range(200)), Number(0)), (x, y))
    found = _beyond(by_formula.certificate, Outer(long, 1.0))
    assert found is not None and not found["formula"]
    assert re.fullmatch(r"an expression of [\d,]+ operations, which stands in the file", found["name"])


def test_the_area_is_an_estimate_and_says_so(by_formula: Case, by_network: Case) -> None:
    """pi * 0.9 * 2 of the ellipse, in which the disc lies."""
    for case, area in ((by_formula, math.pi * 0.9 * 2), (by_network, None)):
        page = case.page()
        (row,) = (row for row in page.rows if row and row[0] == "area with the outer set")
        match = re.fullmatch(r"about (\S+), estimated \(standard deviation (\S+)\)", row[1])
        assert match is not None
        volume, deviation = (float(v) for v in match.groups())
        assert 0.001 < deviation < 0.03
        if area is not None:
            assert abs(volume - area) < 4 * deviation
        assert "Not a bound: the share of random states" in page.text
        assert ["area", "0.785398"] in page.rows and "This is {V ≤ c₂} without the outer set." in page.text


def test_a_practical_claim_keeps_its_words(practical: Case) -> None:
    assert practical.answer["result"] == "ACCEPTED"
    claim = claim_of(practical.certificate, practical.answer)
    assert "enters the smaller set {V(x) ≤ 0.0625} in finite time, and stays there from then on." in claim["statement"]
    assert "Moreover every trajectory that starts in the outer set" in claim["statement"]
    assert "N(x) ≤ 0.9 and no others" in claim["statement"] and len(claim["parts"]) == 7
    words = words_for("practical", has=Additions(beyond=True))
    assert "Anything inside {V ≤ c₀}." in dict(words.excluded)
    said = "V may rise above c₂; that it comes down to c₂ in finite time is proved. That V falls below c₀"
    assert words.decay.format(word="proved").startswith(said)


@pytest.mark.parametrize("kind", ["asymptotic", "practical", "nearby"])
def test_nothing_is_said_of_an_outer_set_without_one(kind: str) -> None:
    plain, beyond = words_for(kind), words_for(kind, has=Additions(beyond=True))
    for name in ("statement", "headline", "sets"):
        assert "N(x)" not in getattr(plain, name) and "outer" not in getattr(plain, name).replace("{outer}", "")
        assert getattr(plain, name) != getattr(beyond, name)
    assert beyond.statement.startswith(plain.statement) and beyond.parts[: len(plain.parts)] == plain.parts
    assert set(plain.excluded) < set(beyond.excluded) and plain.excluded[-1] == beyond.excluded[-1]
    assert len(CLAIMS[kind].parts) == len(beyond.parts) - 2


def test_nothing_of_it_is_called_proved_unless_it_was_accepted(by_network: Case) -> None:
    answer = {"result": "REJECTED", "rule": "outer", "at": "outer leaf 7"}
    page = replace(by_network, answer=answer).page()
    captions = [a.get("alt") or "" for _, a in page.tags]
    for shown in (page.text, *captions, *page.drawings()):
        assert not re.search(
            r"certified|proved (?:set|tube|start|outer)|PROVED"
            r"|(?<!here )(?<!nothing )is proved|was proved|ACCEPTED(?! or)",
            shown,
        )
    assert "claimed outer set" in page.text and "enters the blue one, if the claim is true" in page.text
    assert "leaves of the outer set" not in page.text and "Shown on" not in page.text


def test_an_answer_about_another_outer_level_is_no_page(by_network: Case) -> None:
    certificate = by_network.certificate
    assert status_of(certificate, by_network.sha256, by_network.answer).accepted
    for other in (None, {}, {"level": -2.5}, {"level": None}, [-2.55], -2.55):
        with pytest.raises(SoundnessError, match="level of the outer set"):
            status_of(certificate, by_network.sha256, {**by_network.answer, "outer": other})
    plain = replace(certificate, claim=replace(certificate.claim, outer=None))
    with pytest.raises(SoundnessError, match="level of the outer set"):
        status_of(plain, by_network.sha256, by_network.answer)
    without = {k: v for k, v in by_network.answer.items() if k != "outer"}
    assert status_of(plain, by_network.sha256, without).accepted


# Figures


def test_the_outline_is_where_n_is_at_its_level(by_formula: Case) -> None:
    scene = Scene(by_formula.certificate, accepted=True)
    outline = scene.outline((0, 1))
    assert outline is not None
    a, b, excess = outline
    assert (a[0], a[-1], b[0], b[-1]) == (-2, 2, -2, 2)
    assert excess == pytest.approx(a[None, :] ** 2 + b[:, None] ** 2 / 4 - 0.9, abs=1e-12)
    x = farthest(scene, (0, 1), 16)
    assert np.all(scene.in_outer(x)) and not np.any(scene.in_outer(1.01 * x))
    assert scene.in_outer(np.array([[0.0, 0.0], [0.0, 1.9], [0.9, 0.0], [0.0, 2.5]])).tolist() == [
        True,
        False,
        True,
        False,
    ]
    level = replace(by_formula.certificate, claim=replace(by_formula.certificate.claim, outer=None))
    assert Scene(level, accepted=True).outline((0, 1)) is None
    assert not np.any(Scene(level, accepted=True).in_outer(np.zeros((3, 2))))


def test_a_set_beyond_the_domain_does_not_count() -> None:
    """N = x - 9 is below 0 everywhere: what lies outside the domain is not in the set all the same."""
    system, law = chain(1, [-1.0])
    certificate = Certificate(
        system,
        law,
        Quadratic(np.eye(1)),
        Asymptotic(roa=0.25, local=0.1, outer=Outer(Symbolic(system.states[0] - 9, system.states), 0.0)),
        replace(ONE_LEAF, T=np.eye(1), root=np.ones(1)),
    )
    scene = Scene(certificate, accepted=False)
    edge = float(system.domain[0][1])
    assert scene.in_outer(np.array([[edge], [1.001 * edge], [-1.001 * edge]])).tolist() == [True, False, False]


def test_runs_from_the_outer_set_settle_and_its_share_counts(by_formula: Case) -> None:
    certificate = by_formula.certificate
    scene = Scene(certificate, accepted=True)
    runs = runs_from(scene, starts(scene))
    inside = scene.in_outer(runs.path[0])
    assert np.sum(inside & (quadratic(scene.P, runs.path[0]) > scene.outer)) >= 10
    assert np.all(runs.settled[inside]) and np.any(runs.left)
    roa = simulated_roa(scene)
    assert roa is not None and roa.contradictions == 0
    x, y = np.meshgrid(*roa.axes, indexing="ij")
    assert np.array_equal(roa.certified, (x**2 + y**2 / 4 <= 0.9) | (x**2 + y**2 <= 0.25))


def test_the_portrait_shows_both_sets(by_network: Case) -> None:
    pictures, _ = draw(by_network.certificate, accepted=True)
    first, texts = pictures[0], [key.text for key in pictures[0].legend]
    assert texts[:2] == ["proved outer set, N = −2.55", "proved set, V = 0.25"]
    assert "N′F ≥ 0 on a grid*" in texts and START in first.svg.split("</style>")[-1]
    assert "Magenta: the proved outer set {N ≤ n₂} in the domain" in first.caption
    (surface,) = (p for p in pictures if p.title == "The policy's surface")
    assert "boundaries of the outer set (magenta)" in surface.caption
    (decay,) = (p for p in pictures if p.title == "V along trajectories")
    assert "that it comes down to c₂ in finite time is proved" in decay.caption
    legend = set_figure(by_network.certificate, accepted=True).legends[0]
    assert "proved outer set, N = −2.55" in [t.get_text() for t in legend.get_texts()]


def test_sections_in_more_than_two_states() -> None:
    system, law = chain(4, [-1.0, -2.0, -3.0, -4.0])
    outer = Outer(Symbolic(sum((s**2 for s in system.states), Number(0)), system.states), 0.5)
    certificate = Certificate(
        system,
        law,
        Quadratic(np.eye(4)),
        Asymptotic(roa=0.01, local=0.005, outer=outer),
        replace(ONE_LEAF, T=np.eye(4), root=np.ones(4)),
    )
    scene = Scene(certificate, accepted=True)
    begin = starts(scene)
    assert np.linalg.norm(begin, axis=1) == pytest.approx(math.sqrt(0.5), rel=0.01)
    view, side = scene.view(scene.pairs[0]), float(system.domain[scene.pairs[0][0]][1])
    assert view.hi[0] >= side  # the domain, in which the set lies
    pictures, roa = draw(certificate, accepted=True)
    assert roa is None and "of the outer set there is none" in pictures[0].about
    texts = [key.text for key in pictures[0].legend]
    assert texts[0] == "proved outer set, N = 0.5: section through the origin"
    assert "Of its domain {V ≤ c₂} takes" in pictures[0].caption
    assert "N′F ≥ 0 on a grid*" in texts and "< 0 at every grid point" not in pictures[0].caption


def test_an_interval_of_one_state(tmp_path: Path) -> None:
    case = Case.of(line(), tmp_path)
    pictures, roa = draw(case.certificate, accepted=True)
    assert case.answer["result"] == "ACCEPTED" and roa is not None
    assert pictures[0].title == "N′F along the state" and "proved outer set" in {k.text for k in pictures[0].legend}
    assert roa.fraction == pytest.approx(math.sqrt(0.9), abs=0.01)


def test_a_function_without_a_value_somewhere_can_be_drawn(by_formula: Case) -> None:
    """A rejected file may have any N; nothing warns, and what has no value is not in the set."""
    x, y = by_formula.certificate.system.states
    odd = Symbolic(1 / x + sqrt(y) + exp(800 * x) + x**-3, (x, y))
    claim = replace(by_formula.certificate.claim, outer=Outer(odd, 1.0))
    scene = Scene(replace(by_formula.certificate, claim=claim), accepted=False)
    points = np.array([[0.0, 1.0], [-1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]])
    assert scene.in_outer(points).tolist() == [False, False, True, False]
    outline, change = scene.outline((0, 1)), scene.growth(points)
    assert outline is not None and np.isnan(outline[2]).any() and np.isnan(change[:2]).all()
    assert np.all(np.isfinite(farthest(scene, (0, 1), 8)))


def test_samples_find_the_volume_of_a_ball() -> None:
    sides = [(F(-1), F(2))] * 3
    volume, deviation = sampled_volume(lambda x: np.sum(x**2, axis=1) <= 1, sides)
    assert abs(volume - 4 / 3 * math.pi) < 4 * deviation < 0.1
    assert sampled_volume(lambda x: np.sum(x**2, axis=1) < 0, sides) == (0.0, 0.0)
    assert sampled_volume(lambda x: x[:, 0] < 9, sides) == (27.0, 0.0)


# Results


@pytest.fixture(scope="module")
def proved(tmp_path_factory: pytest.TempPathFactory) -> RoaResult:
    """The plane's plant by the whole pipeline, N = x^2 + y^2/4 as a polynomial."""
    x, y, u = symbols("x y u")
    system = System(
        "plane",
        (x, y),
        (u,),
        {},
        (-x + x**3 + u, -y),
        (Number(0),),
        box(2, 2),
        box(1),
        units={"x": "m", "y": "m"},
    )
    law = PolicyNetwork.of_layers((np.zeros((1, 2)),), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none")
    N = Polynomial(np.array([[2, 0], [0, 2]]), np.array([1.0, 0.25]))
    folder = tmp_path_factory.mktemp("run")
    result = certify(system, law, folder, P=np.eye(2), level=0.25, lyapunov=N, lyapunov_level=0.9)
    assert result.verdict.value == "PROVED" and result.outer is not None, result.reason
    return result


def rendered(data: dict[str, Any]) -> str:
    console = Console(file=io.StringIO(), width=200, color_system=None)
    console.print(summary(data))
    return " ".join(console.file.getvalue().split())  # type: ignore[attr-defined]


def test_a_result_contains_the_union(proved: RoaResult) -> None:
    points = np.random.default_rng(0).uniform(-2.2, 2.2, (400, 2))
    x, y = points.T
    assert np.array_equal(proved.contains(points), (x**2 + y**2 / 4 <= 0.9) | (x**2 + y**2 <= 0.25))
    assert proved.contains([0.9, 0.0]) is True and proved.contains([0.95, 0.0]) is False
    assert proved.contains([F(0), F(0)]) is True
    with_tiny = F(1, 10**50)
    root = replace(proved.outer, level=0.5625) if proved.outer is not None else None
    exact = replace(proved, outer=root)
    assert exact.contains([F(3, 4), F(0)]) is True and exact.contains([F(3, 4) + with_tiny, F(0)]) is False


def test_the_terminal_says_what_it_is(proved: RoaResult) -> None:
    data = proved.to_dict()
    text = rendered(data)
    assert "from every state of the domain with N(x) <= 0.9, {V <= 0.25} is entered in finite time" in text
    assert "outer set {N(x) <= 0.9} in the domain, and nothing outside of it, N being x**2 + 0.25*y**2" in text
    assert "of {V <= c2} alone" in text and "estimated (standard deviation" in text
    assert f"its limit {outer_limited_by(data['outer'])}" in text
    as_network = copy.deepcopy(data)
    as_network["outer"] |= {"kind": "network", "layers": [2, 40, 1], "sha256": "a" * 64, "limit": "witness"}
    as_network["outer"] |= {"witness_level": 0.91}
    text = rendered(as_network)
    assert "N being the 2-40-1 tanh network" in text and "a" * 16 + "…" in text
    assert "a state at which N does not fall, where N = 0.91" in text
    plain = rendered({**data, "outer": None})
    assert "outer set" not in plain and "N <=" not in plain and "alone" not in plain
    assert "N <= 0.9 in the domain" in repr(proved) and "estimated" in repr(proved)
    assert "estimated" in proved._repr_html_()
    json.dumps(data)


def test_a_level_that_was_asked_for_and_missed_is_told_from_what_is_proved(proved: RoaResult) -> None:
    missed = replace(proved, verdict=Verdict.UNKNOWN, stop=Stop.BEYOND, detail="only up to N <= 0.9, not 0.95")
    data = missed.to_dict()
    text = rendered(data)
    assert text.startswith("UNKNOWN plane: the level of N is NOT proved; what is proved is {V <= 0.25} with the states")
    assert "of the domain where N(x) <= 0.9 reason" in text and "ACCEPTED BY BOTH, about a smaller set" in text
    alone = rendered({**data, "outer": None})
    assert "NOT proved; what is proved is {V <= 0.25} reason" in alone
    accepted, rejected = Status("ACCEPTED", ""), Status("REJECTED", "")
    assert missed_of(data, accepted) == (
        "An outer set was asked for that is not proved: the level of the function: only up to N <= 0.9, not 0.95. The "
        "certificate is about a smaller set."
    )
    assert "smaller" not in missed_of(data, rejected) and not missed_of(proved.to_dict(), accepted)


def test_the_page_of_a_run_has_the_run_s_words(proved: RoaResult) -> None:
    assert proved.certificate is not None and proved.checker is not None and proved.outer is not None
    certificate = parse_certificate(proved.certificate.read_bytes(), "certificate")
    sha256 = hashlib.sha256(proved.certificate.read_bytes()).hexdigest()
    answer, data = dict(proved.checker), proved.to_dict()
    page = Page(render_html(certificate, answer, data, proved.certificate, sha256=sha256))
    limit = outer_limited_by(data["outer"])
    assert ["n₂ limited by", limit] in page.rows and f"Limit of the outer set: {limit}" in page.text
    (row,) = (row for row in page.rows if row and row[0] == "area with the outer set")
    assert row[1].startswith("about 5.6") and "m · m" in row[1] and "estimated" in row[1]
    for wrong in ({**data["outer"], "level": 0.8}, None):
        with pytest.raises(InputError, match="its policy or a level is another"):
            render_html(certificate, answer, {**data, "outer": wrong}, proved.certificate, sha256=sha256)


def test_the_network_of_the_tests_is_what_it_says(by_network: Case) -> None:
    outer = by_network.certificate.claim.outer
    assert outer is not None and isinstance(outer.function, Neural)
    assert float(outer.function(np.array([0.3, -0.7]))) == pytest.approx(well(0.3) + well(-0.7), rel=1e-14)
    assert outer.function.sha256() == named(by_network.data)
    assert exactly("−2.55") == F(-255, 100)
