"""Rule `keep` in outer sets and along tubes, in both checkers: honest constraints, grazing ones, forgeries."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from certify.certificates import parse_any
from certify.certificates.verdict import Verdict
from certify.checker import outer, tube, words
from certify.reference import outer as reference_outer
from certify.reference import tube as reference_tube
from tests.support.certificates import LEAF, Document, decode, dump, edited, encode, parse, verdict
from tests.support.kept import ASKED, CENTRE, SIZE, away_from, base, certified, number, touching, widest
from tests.support.marks import slow_after
from tests.support.outer import packed, unpacked
from tests.support.reference import judge
from tests.support.staying import RADIUS, U, X, Y, without

KINDS = tuple(ASKED)
KEEP = "claim.keep"
SAID = {"outer": "outer", "tube": "start", "path": "centre"}


def verdicts(data: Document) -> tuple[str, str | None]:
    return verdict(data), judge(data)


def keeping(kind: str, *g: Any) -> Document:
    """The honest certificate with other constraints."""
    return edited(base(kind), KEEP, list(g))


@pytest.mark.parametrize("kind", KINDS)
def test_honest_certificates_are_accepted_by_both(kind: str) -> None:
    data = base(kind)
    assert data["claim"]["keep"] and data["claim"][SAID[kind]] is not None
    assert verdicts(data) == ("ACCEPTED", None)
    assert "and along every trajectory of these, at all times: (x + (-3)) < 0" in " ".join(words.claim(parse(data)))


@pytest.mark.parametrize("kind", KINDS)
def test_a_certificate_is_read_and_written_as_it_is(kind: str) -> None:
    data = base(kind)
    again = json.loads(parse_any(dump(data), "file").to_json())
    assert again | {"provenance": {}} == data | {"provenance": {}}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("by", slow_after(1, [1e-6, 1e-3]))
def test_what_is_grazed_is_refused(kind: str, by: float) -> None:
    """Obstacles that touch the outer set, or the tube at its start and on its way, by so much."""
    data, found = base(kind), []
    for g in touching(data, 12, by):
        found.append(verdicts(edited(data, KEEP, ["-1", g])))
    assert len(found) >= 12 and set(found) == {("keep", "keep")}


@pytest.mark.parametrize("kind", KINDS)
def test_without_the_rule_these_would_be_accepted(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    data = base(kind)
    grazing = [edited(data, KEEP, [g]) for g in [*touching(data, 3, 1e-3)][::3]]
    for module, table in ((outer, "ON_OUTER_LEAVES"), (tube, "ON_SLABS")):
        monkeypatch.setattr(module, table, tuple(row for row in getattr(module, table) if row[0] != "keep"))
    monkeypatch.setattr(reference_outer, "kept", lambda *_: None)
    monkeypatch.setattr(reference_tube, "kept_on_ball", lambda *_: None)
    assert {verdicts(one) for one in grazing} == {("ACCEPTED", None)}


@pytest.mark.parametrize("kind", ["tube", "path"])
@pytest.mark.parametrize("axis", slow_after(1, [0, 1]))
def test_a_wall_may_stand_beside_the_balls_and_no_nearer(kind: str, axis: int) -> None:
    """g is linear, so that its models are exact: it counts on the balls, which are wider than the ellipsoids."""
    far, name = widest(base(kind), axis), "xy"[axis]
    for share, answer in ((1 + 1e-9, ("ACCEPTED", None)), (1 - 1e-9, ("keep", "keep"))):
        assert verdicts(keeping(kind, ["-", name, str(number(far * share))])) == answer


def _leaves(tree: bytes) -> Iterator[int]:
    """Places of splits whose halves are both leaves."""
    return (k for k in range(len(tree) - 2) if tree[k] != LEAF and tree[k + 1 : k + 3] == bytes([LEAF, LEAF]))


@pytest.mark.slow
def test_a_leaf_counts_even_where_n_falls_on_it(tmp_path: Path) -> None:
    """x^3 y is at most 0.325 in the set, whose tree is fine there. Where two leaves become one the constraint is no
    longer shown on some, and both checkers name the rule; N falls on all but a few."""
    result = certified("outer", tmp_path, X**3 * Y - number(0.33))
    assert result.verdict is Verdict.PROVED and result.raw is not None
    data = json.loads(result.raw)
    tree, found = unpacked(data["evidence"]["outer"]["tree"]), Counter[tuple[str, str | None]]()
    for k in range(len(tree) - 2):
        if tree[k] != LEAF and tree[k + 1 : k + 3] == bytes([LEAF, LEAF]):
            merged = tree[:k] + bytes([LEAF]) + tree[k + 3 :]
            found[verdicts(edited(data, "evidence.outer.tree", packed(merged)))] += 1
    assert set(found) <= {("ACCEPTED", None), ("keep", "keep"), ("outer", "outer")} and found["keep", "keep"] >= 3
    for octets in (tree[:-1], tree + bytes([LEAF])):
        assert verdicts(edited(data, "evidence.outer.tree", packed(octets))) == ("outer", "outer")


@pytest.mark.parametrize("kind", KINDS)
def test_the_inner_set_keeps_them_too(kind: str) -> None:
    """Of g that is violated in {V <= c2} alone: neither the outer leaves nor the slabs see it, but the ball does."""
    inside = keeping(kind, ["-", "1/100", ["+", ["**", "x", 2], ["**", "y", 2]]])
    assert verdicts(inside) == ("keep", "keep")
    assert verdicts(keeping(kind, ["-", "u", "10"])) == ("ACCEPTED", None)


def forged(kind: str) -> Iterator[tuple[str, str, Document]]:
    """Each with the rule that must refuse it."""
    data = base(kind)
    for keep in ([], ["x"] * 65, "x", [["network", "policy", 0, "x", "y"]], [["-", "z"]], None, ["q"], [["max", "x"]]):
        yield "format", f"keep {keep!s:.30}", edited(data, KEEP, keep)
    others = {"ranks": {"angles": [], "steps": 1}, "target": ["x"], "keep2": ["x"]}
    for key, value in others.items():
        yield "format", f"a claim with {key}", edited(data, f"claim.{key}", value)
    yield "format", "keep beside the claim", edited(data, "keep", ["x"])
    trusted = {"kind": "trusted-solver", "solver": "a", "version": "1", "precision": (1.0).hex(), "queries": []}
    yield "format", "a solver's word", edited(data, "evidence", trusted)
    wrong = {
        "0": "0", "a positive number": "1/1000000", "a pole": ["-", ["/", "0", "x"], "1"],
        "a root": ["-", ["*", "0", ["sqrt", "x"]], "1"], "a half plane": ["-", "x", "1/2"],
        "another": ["-", "1/2", "y"], "the input": ["-", "u", "1/5"], "the input below": ["-", ["-", "u"], "1/5"],
        "a corner": ["-", ["abs", "x"], "1/2"],
        "a larger one": ["-", ["max", "x", "y"], "2/5"], "a product": ["-", ["*", "x", "x"], "1/4"],
    }  # fmt: skip
    for what, g in wrong.items():
        yield "keep", what, edited(data, KEEP, ["-1", g])
    for k in range(1, 6):
        yield "keep", f"one of {k + 1}", edited(data, KEEP, [*["-1"] * k, away_from(np.array([0.4, 0.1]), 0.0), "-1"])
    if kind == "outer":
        yield (
            "keep",
            "a higher level",
            edited(edited(data, KEEP, [away_from(np.array([1.31, 0.0]), 0)]), "claim.outer.level", (1.1).hex()),
        )
        tree = unpacked(data["evidence"]["outer"]["tree"])
        yield "outer", "half a tree", edited(data, "evidence.outer.tree", packed(tree[: len(tree) // 2]))
        return
    slabs, first = data["evidence"]["tube"], data["evidence"]["tube"][0]
    yield "tube", "a slab less", edited(data, "evidence.tube", slabs[1:])
    yield "tube", "the last slab less", edited(data, "evidence.tube", slabs[:-1])
    yield "tube", "a smaller ball", edited(data, "evidence.tube.0.J", encode(0.9 * decode(first["J"])))
    near = str(number(widest(data, 0) * (1 + 1e-9)))
    wider = edited(edited(data, KEEP, [["-", "x", near]]), "evidence.tube.0.J", encode(1.02 * decode(first["J"])))
    yield "keep", "a wall in a wider ball", wider


@pytest.mark.parametrize("kind", KINDS)
def test_forgeries_are_refused_by_their_rule_in_both(kind: str) -> None:
    made = list(forged(kind))
    found = {what: verdicts(data) for _, what, data in made}
    assert len(made) >= 29 and found == {what: (rule, rule) for rule, what, _ in made}


@pytest.mark.parametrize("kind", KINDS)
def test_without_constraints_it_is_the_certificate_of_old(kind: str) -> None:
    assert verdicts(without("claim.keep")(base(kind))) == ("ACCEPTED", None)


@pytest.mark.slow
@pytest.mark.parametrize("by", slow_after(1, [1e-6, 1e-3]))
def test_the_search_ends_below_what_is_planted(by: float, tmp_path: Path) -> None:
    """The level 1 of x^2 + y^2 is asked for, where an obstacle reaches into that disc: it is not PROVED."""
    for k, angle in enumerate(np.linspace(0.3, 6.0, 5)):
        a, b = (number((1 + SIZE) * v) for v in (np.cos(angle), np.sin(angle)))
        obstacle = number(SIZE + by) ** 2 - ((X - a) ** 2 + (Y - b) ** 2)
        result = certified("outer", tmp_path / str(k), obstacle)
        assert result.verdict is not Verdict.PROVED
        assert result.outer is None or result.outer.level < (1 - by) ** 2


@pytest.mark.parametrize("kind", ["tube", "path"])
def test_a_tube_is_shaped_by_what_stands_beside_it(kind: str, tmp_path: Path) -> None:
    """A wall takes from the start: its tube is smaller, keeps the wall by the oracle, and both accept it."""
    centre, most = (np.zeros(2), 0.45) if kind == "tube" else (np.array(CENTRE), 1.3)
    free, walled = base(kind), certified(kind, tmp_path, X - number(most))
    assert walled.verdict is Verdict.PROVED and walled.raw is not None and walled.claim == free["claim"]["kind"]
    data = json.loads(walled.raw)
    P, Q = (decode(one["claim"]["start"]).reshape(2, 2) for one in (data, free))
    assert np.linalg.det(P) > np.linalg.det(Q)
    assert centre[0] + np.sqrt(np.linalg.inv(P)[0, 0]) < most
    assert verdicts(data) == ("ACCEPTED", None)


@pytest.mark.slow
def test_a_path_into_an_obstacle_says_so(tmp_path: Path) -> None:
    obstacle = number(0.1) ** 2 - ((X - number(0.8)) ** 2 + Y**2)
    result = certified("path", tmp_path, obstacle, RADIUS - 3, U - 2)
    assert result.verdict is Verdict.UNKNOWN and "constraint" in str(result.detail)
