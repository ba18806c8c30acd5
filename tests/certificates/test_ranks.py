"""Certificates with ranks and constraints: the file, states and boxes in the leaves, and claims made from others."""

from __future__ import annotations

import base64
import json
import math
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from certify.certificates import Certificate, PartitionTree, RankTree, leaves_within, parse_certificate, run_checker
from certify.certificates.claims import UNPROVED, Asymptotic, Nearby, Outer, Practical, Ranks
from certify.certificates.located import Containment
from certify.certificates.membership import Region, proved_set, region_of, set_of
from certify.certificates.ranked import Ranked, proved_volume
from certify.certificates.turns import bounds_of, sign_against, turns_into
from certify.errors import CertificateFormatError, InputError
from certify.loop.expressions import Symbol
from certify.lyapunov.function import Quadratic
from tests.support import ranks as made

F = Fraction
g = Symbol("x") - 1


def tree_of(certificate: Certificate) -> RankTree:
    assert isinstance(certificate.evidence, PartitionTree) and certificate.evidence.ranks is not None
    return certificate.evidence.ranks


@pytest.fixture
def certificate(request: pytest.FixtureRequest) -> Certificate:
    found = getattr(made, request.param)()
    assert isinstance(found, Certificate)
    return found


def ranked_of(certificate: Certificate) -> Ranked:
    found = region_of(certificate).ranked
    assert found is not None
    return found


# ------------------------------------------------------------------------------------------------------------ the file


@pytest.mark.parametrize("certificate", ["linear", "pendulum"], indirect=True)
def test_a_file_reads_back_as_it_was_written(certificate: Certificate) -> None:
    text = certificate.to_json()
    data, read = json.loads(text), parse_certificate(text.encode(), "ranked")
    assert read.to_json() == text
    assert read.claim == certificate.claim and read.constraints == certificate.constraints
    assert data["claim"]["ranks"] == {"angles": list(certificate.system.angles), "steps": certificate.claim.ranks.steps}
    assert ("keep" in data["claim"]) is bool(certificate.claim.keep)
    assert set(data["evidence"]["ranks"]) == {"lo", "hi", "tree", "ranks", "steps"}
    for name in ("lo", "hi", "ranks", "steps"):
        assert np.array_equal(getattr(tree_of(read), name), getattr(tree_of(certificate), name))


@pytest.mark.parametrize("certificate", ["linear", "pendulum"], indirect=True)
def test_both_checkers_accept_them_and_a_state_is_asked_about(certificate: Certificate, tmp_path: Path) -> None:
    path = tmp_path / "certificate.json"
    path.write_text(certificate.to_json())
    assert run_checker(path, program="reference")["result"] == "ACCEPTED"
    assert proved_set(path).holds([[3.0, -2.0]]) == [True]
    data = json.loads(path.read_text())
    data["evidence"]["ranks"]["ranks"] = encode_ranks(np.zeros(len(tree_of(certificate).ranks)))
    path.write_text(json.dumps(data))
    with pytest.raises(InputError, match="rule=ranks"):
        proved_set(path)


def encode_ranks(ranks: np.ndarray) -> str:
    return base64.b64encode(ranks.astype("<u2").tobytes()).decode()


def test_a_file_without_them_keeps_its_keys() -> None:
    data = json.loads(made.base("linear").to_json())
    assert set(data["claim"]) == {"kind", "rate", "sample", "outer"}
    assert "ranks" not in data["evidence"] and "constraints" not in data["provenance"]


def test_constraints_have_names_only_where_the_file_has_usable_ones() -> None:
    data = json.loads(made.linear().to_json())
    assert parse_certificate(json.dumps(data).encode(), "c").constraints.keys() == {"wall", "force"}
    for odd in (["wall"], ["wall", "wall"], "no list", {"wall": 0}, ["a b", "c"]):
        data["provenance"]["constraints"] = odd
        assert list(parse_certificate(json.dumps(data).encode(), "c").constraints) == ["constraint_1", "constraint_2"]


def test_what_does_not_belong_together_is_refused() -> None:
    data = json.loads(made.linear().to_json())
    for section, key in (("claim", "ranks"), ("evidence", "ranks")):
        other = json.loads(json.dumps(data))
        del other[section][key]
        with pytest.raises(CertificateFormatError, match="must have evidence with ranks"):
            parse_certificate(json.dumps(other).encode(), "c")
    data["evidence"]["ranks"]["steps"] = ""
    with pytest.raises(CertificateFormatError, match="a rank and steps for each of its 256 leaves"):
        parse_certificate(json.dumps(data).encode(), "c")


# ---------------------------------------------------------------------------------------------------------- the claims


def test_other_claims_carry_ranks_and_constraints_or_have_no_such_form() -> None:
    more = {"ranks": Ranks((), 7), "keep": (g,)}
    claim = Asymptotic(2.0, 0.5, **more)
    lower, whole = claim.lowered(1.0), claim.without_ranks()
    assert lower is not None and lower.ranks is None and lower.keep == (g,)
    assert whole == Asymptotic(2.0, 0.5, keep=(g,)) and Asymptotic(2.0, 0.5).without_ranks() is None
    assert claim.local_only(0.5) == Asymptotic(0.5, 0.5, keep=(g,))
    assert claim.with_tube(Quadratic(np.eye(1))) is None
    practical = Practical(2.0, 0.5, 0.1, **more)
    nearby = practical.converging()
    assert nearby == Nearby(2.0, 0.5, 0.1, **more) and nearby.without_equilibrium() == practical
    assert practical.with_floor(0.2) == Practical(2.0, 0.5, 0.2, **more)


def test_claims_that_no_checker_reads_cannot_be_made() -> None:
    outer = Outer(None, 1.0)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="can have no ranks"):
        Asymptotic(2.0, 0.5, outer=outer, ranks=Ranks((), 7))
    assert Asymptotic(2.0, 0.5, outer=outer, keep=(g,)).keep == (g,)
    with pytest.raises(InputError, match="at most 64"):
        Asymptotic(2.0, 0.5, keep=(g,) * 65)
    for angles, steps in ((("a", "a"), 1), ((), 0), ((), 65_535)):
        with pytest.raises(InputError):
            Ranks(angles, steps)


# ------------------------------------------------------------------------------------------------------------- angles


def test_turns_are_compared_exactly() -> None:
    near = F(355, 113)  # above pi by 2.7e-7
    assert sign_against((-2 * near, 1), F(0)) == -1 and sign_against((2 * near, -1), F(0)) == 1
    assert sign_against((F(1, 3), 0), F(1, 3)) == 0
    below, above = bounds_of((F(0), 1))
    assert F(math.pi) * 2 < above and below < above < below + F(1, 2**70)
    assert list(turns_into(F(0), F(-7), F(7))) == [-1, 0, 1] and not turns_into(F(1), F(-1), F(0))
    assert list(turns_into(F(10**40), F(0), F(7)))  # far away, and still decided
    for q, lo, hi in ((F(5), F(-3), F(4)), (F(-31, 7), F(-20), F(-7)), (2 * near, F(0), F(1, 10**6))):
        assert list(turns_into(q, lo, hi)) == [w for w in range(-9, 9) if lo <= q + 2 * w * math.pi <= hi]


@pytest.mark.parametrize("name", ["linear", "pendulum"])
def test_states_lie_in_the_set_as_floats_say_where_they_can(name: str) -> None:
    certificate = {"linear": made.linear(), "pendulum": made.pendulum()}[name]
    tree, region = tree_of(certificate), region_of(certificate)
    lower, upper = leaves_within(tree.tree, tree.lo, tree.hi)
    draw = np.random.default_rng(1).uniform(-1.3, 1.3, (300, 2)) * np.where(name == "pendulum", [8.0, 6.5], [4.0, 4.0])
    turns = (-2, -1, 0, 1, 2) if name == "pendulum" else (0,)
    expected = []
    for x in draw:
        each = [x + np.array([2 * np.pi * w, 0.0]) for w in turns]
        met = [np.all((lower <= y) & (y <= upper), axis=1) & (tree.ranks != UNPROVED) for y in each]
        expected.append(bool(np.any(met)) or any(y @ certificate.P @ y <= certificate.roa for y in each))
    assert region.holds(draw.tolist()) == expected and region.excludes(draw.tolist()) == [not v for v in expected]
    assert {True, False} <= set(expected)


def one_row() -> Ranked:
    """The leaves [0, 1], [1, 2], [2, 3], [3, 4] with ranks but for the third, and V <= 1/4."""
    certificate = made.linear()
    tree = RankTree(
        np.zeros(1), np.full(1, 4.0), bytes([0, 0, 255, 255, 0, 255, 255]),
        np.array([0, 3, UNPROVED, 9], dtype=np.uint16), np.array([0, 1, 0, 1], dtype=np.uint16),
    )  # fmt: skip
    inner = replace(region_of(certificate).ellipsoids[0], P=np.eye(1), level=0.25)
    return Ranked(tree, inner)


@pytest.mark.parametrize(
    ("lo", "hi", "answer"),
    [
        ("0", "2", "contained"),  # both edges, and the one between
        ("2", "2", "contained"),  # of a leaf of finite rank, and of one without
        ("3", "3", "contained"),
        ("3", "4", "contained"),
        ("-1/2", "2", "contained"),  # in {V <= c2} below 0
        ("-51/100", "2", "undecided"),  # the corner says more
        ("1", "201/100", "not contained"),
        ("9/4", "11/4", "not contained"),
        ("2", "3", "not contained"),
        ("7/2", "5", "not contained"),
        ("5", "6", "not contained"),
    ],
)
def test_boxes_are_cut_where_the_tree_is(lo: str, hi: str, answer: str) -> None:
    found = one_row().locate(((F(lo), F(hi)),))
    if answer == "undecided":
        assert found.answer in (Containment.UNDECIDED, Containment.NOT_CONTAINED)
    else:
        assert found.answer == answer
    if found.outside is not None:
        assert F(lo) <= found.outside[0] <= F(hi) and one_row().excludes([found.outside]) == [True]


def test_a_box_is_the_same_place_after_turns() -> None:
    region = region_of(made.pendulum())
    turn = F(math.pi) * 2
    box = ((F(-1, 2), F(1, 2)), (F(-3), F(3)))
    assert region.locate(box).answer == "contained"
    moved = ((box[0][0] + 5 * turn, box[0][1] + 5 * turn), box[1])
    assert region.locate(moved).answer == "contained"
    across = ((F(math.pi) - F(1, 2), F(math.pi) + F(1, 2)), (F(4), F(5)))  # over the top, fast enough
    upright = ((F(math.pi) - F(1, 8), F(math.pi) + F(1, 8)), (F(-1, 8), F(1, 8)))
    found = region.locate(upright)
    assert found.answer == "not contained" and region.excludes([found.outside]) == [True]
    assert region.locate(across).answer == region.locate(((across[0][0] - turn, across[0][1] - turn), across[1])).answer
    whole = region.locate(((F(0), F(100)), (F(0), F(0))))
    assert whole.answer == "not contained"


def test_boxes_in_the_set_have_all_their_states_in_it() -> None:
    region: Region = region_of(made.pendulum())
    draw = np.random.default_rng(3)
    answers = set()
    for _ in range(60):
        centre, half = draw.uniform(-1, 1, 2) * [9.0, 6.5], draw.uniform(0.01, 0.5, 2)
        box = tuple((F(float(c - h)), F(float(c + h))) for c, h in zip(centre, half, strict=True))
        found = region.locate(box)
        answers.add(found.answer)
        states = draw.uniform(centre - half, centre + half, (40, 2)).tolist()
        if found.answer == "contained":
            assert all(region.holds(states))
        elif found.answer == "not contained":
            assert found.outside is not None and region.excludes([found.outside]) == [True]
            assert all(a <= v <= b for v, (a, b) in zip(found.outside, box, strict=True))
    assert {Containment.CONTAINED, Containment.NOT_CONTAINED} <= answers


# ------------------------------------------------------------------------------------------------------------- volumes


def test_volumes_are_of_the_leaves_and_of_one_turn() -> None:
    tree = one_row().tree
    volume, share = proved_volume(tree)
    assert volume <= 3 and volume == pytest.approx(3, abs=1e-12) and share == pytest.approx(0.75, abs=1e-12)
    certificate = made.pendulum()
    tree = tree_of(certificate)
    lower, upper = leaves_within(tree.tree, tree.lo, tree.hi)
    upper[:, 0] = np.minimum(upper[:, 0], tree.lo[0] + 2 * np.pi)
    expected = np.prod(np.maximum(upper - lower, 0), axis=1)[tree.ranks != UNPROVED].sum()
    volume, share = proved_volume(tree, [0])
    assert volume <= expected and volume == pytest.approx(expected, rel=1e-12)
    assert share == pytest.approx(expected / (2 * np.pi * 13), rel=1e-12)
    assert proved_volume(tree_of(made.linear()))[1] == 1.0


def test_the_set_of_accepted_bytes_has_them() -> None:
    certificate = made.pendulum()
    proved = set_of(certificate.to_json().encode(), "c")
    assert proved.ranked is not None and proved.ranked.angles == (0,)
    assert proved.holds([[2 * math.pi + 0.1, 0.0], [math.pi, 0.0]]) == [True, False]
