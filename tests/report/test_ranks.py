"""A claim with ranks and constraints: what is said of it on the page, in the terminal and as JSON, and its map."""

from __future__ import annotations

import hashlib
import html
import io
import json
import re
from dataclasses import replace
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from certify import certify_roa
from certify.analysis.beyond import constraints_in_words, rank_facts
from certify.analysis.results import RoaResult
from certify.certificates import Certificate, PartitionTree, RankTree, parse_certificate
from certify.certificates.claims import CLAIMS, UNPROVED, Ranks
from certify.certificates.membership import region_of
from certify.certificates.timing import Timing
from certify.errors import InputError, SoundnessError
from certify.loop.expressions import Number, symbols
from certify.loop.plants import System
from certify.loop.policies import PolicyNetwork
from certify.report import render_html, summary
from certify.report.claims import Additions, words_for
from certify.report.figures import draw
from certify.report.figures.scene import Scene
from certify.report.timing import TimingInWords
from tests.support import ranks as made
from tests.support.loops import box

F = Fraction


def answer_to(certificate: Certificate, raw: bytes) -> dict[str, Any]:
    return {
        "result": "ACCEPTED",
        "certificate_sha256": hashlib.sha256(raw).hexdigest(),
        "policy_sha256": certificate.network.sha256(),
        "levels": dict(certificate.claim.levels),
        "ranks": {"leaves": 3, "steps": certificate.claim.ranks.steps if certificate.claim.ranks else 0, "of": 2},
    }


@cache
def page(name: str, *, accepted: bool = True) -> str:
    """The page's text, without its markup."""
    certificate = {"linear": made.linear, "pendulum": made.pendulum}[name]()
    raw = certificate.to_json().encode()
    answer = answer_to(certificate, raw) if accepted else None
    text = render_html(parse_certificate(raw, "c"), answer, None, Path("c.json"))
    text = re.sub(r"<style>.*?</style>|data:image[^\"]*", "", text, flags=re.S)
    return re.sub(r"\s+", " ", html.unescape(re.sub(r"<[^>]+>", "", text)))


def test_the_page_says_what_is_proved_of_boxes_and_constraints() -> None:
    text = page("linear")
    assert "starts in one of the certificate's boxes with ranks is in {V(x) ≤ 3} after 10 steps at the latest" in text
    assert "the constraints hold at every step: wall and force." in text
    assert "wall:x−5<0" in text and "force:uu−1<0" in text
    assert "Wrapped angles. States are real numbers" in text and "full turns" not in text
    for part in ("Boxes.", "Constraints.", "256 of 256 boxes have a rank.", "Boxes without a rank.", "100 %"):
        assert part in text
    assert "The proof has 8 parts" in text and "Angles." not in text


def test_the_page_says_which_angles_are_turned() -> None:
    text = page("pendulum")
    assert "all states but θ are inside the domain; states that differ by full turns, multiples of 2π in θ" in text
    assert "with θ up to full turns, and other states as real numbers" in text
    assert "Wrapped angles." not in text and "Other angles. Full turns are the same place in θ alone." in text
    assert "The number of turns." in text and "of one turn of θ" in text
    assert "constraints hold" not in text and "0 leave the domain" in text


def test_without_an_accepting_answer_nothing_is_proved() -> None:
    text = page("pendulum", accepted=False)
    assert "What the file claims, without proof" in text and "if the claim is true" in text
    assert "White: nothing is claimed." in text and "White: nothing is proved." not in text


@pytest.mark.parametrize("said", [None, {"steps": 11}, {}])
def test_an_answer_about_other_ranks_is_an_error(said: Any) -> None:
    certificate = made.linear()
    answer = answer_to(certificate, certificate.to_json().encode()) | {"ranks": said}
    with pytest.raises(SoundnessError, match="steps of ranks"):
        render_html(certificate, answer, None, Path("c.json"))


@pytest.mark.parametrize("kind", ["asymptotic", "practical", "nearby"])
@pytest.mark.parametrize("sample", [None, (F(1, 10), F(1, 10)), (F(0), F(1, 10))])
def test_words_of_every_kind_have_no_open_places(kind: str, sample: Any) -> None:
    timing = TimingInWords.of(replace(made.linear_plant()[0], time="discrete" if sample is None else "continuous",
                                      sample=sample))  # fmt: skip
    plain = words_for(kind, timing)
    for has in (Additions(ranked=True), Additions(ranked=True, angles=("theta",), kept=True), Additions(kept=True)):
        words = words_for(kind, timing, has)
        places = {"outer": "2", "inner": "1", "speed": "", "constant": "", "steps": "STEPS", "constraints": "KEPT"}
        said = words.statement.format(**places), words.headline.format(**places)
        for text in said:
            assert "$" not in text
            assert ("STEPS" in text) is has.ranked and ("KEPT" in text) is has.kept
        assert len(words.parts) == len(plain.parts) + has.ranked + bool(has.angles) + has.kept
        assert all("$" not in text for part in words.parts for text in part)
        assert ("sampling instants at the latest" in said[0]) is (has.ranked and sample is not None)
        assert words.excluded[-1] == plain.excluded[-1] and ("boxes with ranks" in words.sets) is has.ranked
    assert set(CLAIMS) >= {kind} and not Timing().discrete


# --------------------------------------------------------------------------------------------------------- the figures


def made_up(n: int) -> Certificate:
    """A certificate of n states that shrink, with two leaves, of which the upper one has no rank."""
    names = symbols([f"x{k + 1}" for k in range(n)])
    u = symbols("u")[0]
    system = System(
        name="cube", states=names, inputs=(u,), parameters={}, dynamics=(names[0] / 2 + u, *(s / 2 for s in names[1:])),
        u_eq=(Number(0),), domain=box(*[2] * n), input_bounds=box(1), time="discrete",
    )  # fmt: skip
    weights = (np.zeros((1, n)),), (np.zeros(1),)
    network = PolicyNetwork.of_layers(*weights, np.ones(1), np.zeros(1), "identity", "none")
    raw = certify_roa(system, network, level=0.5).raw
    assert raw is not None
    read = parse_certificate(raw, "cube")
    assert isinstance(read.evidence, PartitionTree)
    tree = RankTree(-np.ones(n), np.ones(n), bytes([0, 255, 255]), np.array([4, UNPROVED], np.uint16),
                    np.array([4, 0], np.uint16))  # fmt: skip
    claim = replace(read.claim, ranks=Ranks((), 4))
    return replace(read, claim=claim, evidence=replace(read.evidence, ranks=tree))


@pytest.mark.parametrize(("n", "maps"), [(1, 1), (2, 1), (3, 3)])
def test_there_is_a_map_for_each_plane(n: int, maps: int) -> None:
    pictures, _ = draw(made_up(n), accepted=True)
    found = [p for p in pictures if p.title.startswith("Steps to {V ≤ c₂}, at most")]
    assert len(found) == maps and not any(p.simulated for p in found)
    assert all(("all other states at rest" in p.caption) is (n > 2) for p in found)
    assert all("<image" in p.svg for p in found)


def test_the_map_has_the_ranks_of_the_leaves() -> None:
    certificate = made.pendulum()
    ranked, region = region_of(certificate).ranked, region_of(certificate)
    assert ranked is not None and isinstance(certificate.evidence, PartitionTree)
    states = np.random.default_rng(2).uniform(-1.1, 1.1, (400, 2)) * [3.25, 6.5]
    found = ranked.ranks_at(states)
    inside = np.isfinite(found)
    assert all(region.holds(states[inside].tolist())) and not np.all(inside)
    assert np.all(np.isnan(found[np.any(np.abs(states) > [3.25, 6.5], axis=1)]))
    tree = certificate.evidence.ranks
    assert tree is not None and set(found[inside]) <= set(tree.ranks.tolist()) and len(set(found[inside])) > 4
    scene = Scene(certificate, True)
    assert np.array_equal(scene.in_more(states), inside)


def test_simulated_angles_are_turned_only_under_such_a_claim() -> None:
    certificate = made.pendulum()
    plain = replace(certificate, claim=certificate.claim.without_ranks(),
                    evidence=replace(certificate.evidence, ranks=None))  # fmt: skip
    fast = np.array([[3.0, 5.0]])
    assert Scene(certificate, True).flow.advance(fast, None, 1.0)[0, 0] == pytest.approx(3.5 - 2 * np.pi)
    assert Scene(plain, True).flow.advance(fast, None, 1.0)[0, 0] == pytest.approx(3.5)


# ---------------------------------------------------------------------------------------------------------- the result


@cache
def result(name: str) -> RoaResult:
    """A run's result, with the ranks and constraints that are put beside it."""
    certificate = {"linear": made.linear, "pendulum": made.pendulum}[name]()
    plant, level = {"linear": (made.linear_plant(), 3.0), "pendulum": (made.hanging(), 10.0)}[name]
    found = certify_roa(replace(plant[0], constraints={}, angles=()), plant[1], level=level)
    raw = certificate.to_json().encode()
    return replace(
        found, ranks=replace(rank_facts(certificate), rounds=7), constraints=constraints_in_words(certificate), raw=raw,
        checker=answer_to(certificate, raw),
    )  # fmt: skip


def terminal(data: dict[str, Any]) -> str:
    out = io.StringIO()
    Console(file=out, width=400).print(summary(data))
    return out.getvalue()


def test_the_terminal_has_rows_for_boxes_angles_and_constraints() -> None:
    text = terminal(result("linear").to_dict())
    assert "from the boxes with ranks {V <= 3} is reached after 10 steps at the latest; kept on the way" in text
    assert re.search(r"boxes with ranks +256 of 256, 100 % of the box that was cut: from each of them", text)
    assert re.search(r"kept +wall: x - 5 < 0; force: u\*u - 1 < 0", text)
    assert "angles" not in text and "7 rounds" in text and ", of {V <= c2} alone" in text
    turned = terminal(result("pendulum").to_dict())
    assert re.search(r"angles +θ: states that differ by full turns are the same place", turned) and "kept" not in turned


def test_json_has_the_numbers_and_no_tree() -> None:
    data = json.loads(json.dumps(result("pendulum").to_dict()))
    ranks = data["ranks"]
    assert ranks["angles"] == ["theta"] and ranks["leaves"] == 1024 and 0 < ranks["proved"] < 1024
    assert 0.5 < ranks["covered"] < 1 and ranks["rounds"] == 7 and ranks["steps"] % 5 == 0 and "tree" not in ranks
    assert ranks["lo"] == [-3.25, -6.5] and 0 < ranks["volume"] < 2 * np.pi * 13
    assert data["constraints"] == {} and result("linear").to_dict()["constraints"] == {
        "wall": "x - 5 < 0",
        "force": "u*u - 1 < 0",
    }


def test_a_result_answers_about_states_as_places_and_shows_itself() -> None:
    found = result("pendulum")
    assert found.contains([0.1 + 2 * np.pi, 0.0]) and not found.contains([np.pi, 0.0])
    assert "at most" in repr(found) and "with boxes" in found._repr_html_()
    assert "kept x - 5 < 0" in repr(result("linear"))
    other = replace(found, ranks=None)
    assert not other.contains([0.1 + 2 * np.pi, 0.0])


def test_a_certificate_in_memory_belongs_together() -> None:
    certificate = made.linear()
    with pytest.raises(InputError, match="must have evidence with ranks"):
        replace(certificate, claim=certificate.claim.without_ranks())
