"""Claim `remains`: boxes with ranks that are never left, and what just leaves them, in both programs.

Every certificate is JSON by hand: small trees whose images are known.
"""

from __future__ import annotations

import json
import random
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from certify.reference import rules
from certify.reference.__main__ import in_words
from certify.reference.document import read
from tests.support.certificates import edited
from tests.support.rank_forgeries import by_checker, by_reference
from tests.support.ranked import UNRANKED, Document, Loop, affine, dumped, encode, raw, two_bytes, uniform

NO, PLANE = UNRANKED, ("x", "y")
Ends = Sequence[float]


def made(more: Document, **known: Any) -> Loop:
    return Loop(**{"target": None} | known | more)


def remaining(loop: Loop, lo: Ends, hi: Ends, depth: int, ranks: Sequence[int], steps: Sequence[int]) -> Document:
    tree, _ = uniform(lo, hi, depth)
    data = loop.document(lo, hi, tree, two_bytes(ranks), bytes(steps))
    claim = {key: value for key, value in data["claim"].items() if key != "target"}
    return edited(data, "claim", claim | {"kind": "remains"})


def verdict(data: Document) -> str | None:
    """The rule that both refuse it by, if any."""
    by = by_reference(data)
    assert by_checker(data) == by
    return by


def rejected(data: Document) -> tuple[str | None, str | None]:
    """The rule that refuses it, and where."""
    found = rules.judge(dumped(data))
    assert found.result == "REJECTED"
    return found.rule, found.at


def contracting(kept: float = 1.0, **more: Any) -> Document:
    """x+ = x/2 + y/4, y+ = u = y/2 - x/4 on [-2, 2]^2, 64 leaves, of which those in [-kept, kept]^2 have ranks."""
    dynamics: list[Any] = [["+", ["/", "x", "2"], ["/", "y", "4"]], "u"]
    loop = made(more, dynamics=dynamics, network=[affine([[-0.25, 0.5]])], states=PLANE)
    _, leaves = uniform([-2.0, -2.0], [2.0, 2.0], 6)
    inside = [all(-kept <= a and b <= kept for a, b in leaf) for leaf in leaves]
    return remaining(loop, [-2.0] * 2, [2.0] * 2, 6, [1 if here else NO for here in inside], list(map(int, inside)))


def winding(count: int, lo: Ends = (-1.0, -1.0), **more: Any) -> Document:
    """x+ = -y, y+ = u = x - y, a third of a turn: on the one leaf [-1, 1]^2 |y| is at most 2 after one step, |x| is
    after two, and after three steps each state is where it was."""
    loop = made(more, dynamics=[["-", "y"], "u"], network=[affine([[1.0, -1.0]])], states=PLANE)
    return remaining(loop, lo, [1.0, 1.0], 0, [count], [count])


def turning(hole: int | None = None, **more: Any) -> Document:
    """An angle x+ = x + 1/2 and y+ = u = y/2 + sin(x)/4 on [-3.25, 3.25] x [-1, 1], without the leaf `hole` of 8."""
    dynamics: list[Any] = [["+", "x", "1/2"], ["+", "u", ["/", ["sin", "x"], "4"]]]
    known = {"states": PLANE, "angles": ("x",), "domain": ("-2", "2")} | more
    loop = made(known, dynamics=dynamics, network=[affine([[0.0, 0.5]])])
    ranks = [NO if i == hole else 1 for i in range(8)]
    return remaining(loop, [-3.25, -1.0], [3.25, 1.0], 3, ranks, [int(r == 1) for r in ranks])


def braking(wall: str = "17/10", **more: Any) -> Document:
    """x' = v, v' = u = -x - 3/2 v, held for 1: all is 0 after two periods. From x = 1, v = 2 the state x is at most 1
    at sampling instants, and 3/2 between the first two."""
    known = {"sample": ("1", "1"), "order": 2, "keep": [["-", "x", wall]]} | more
    loop = made(known, dynamics=["v", "u"], network=[affine([[-1.0, -1.5]])], states=("x", "v"))
    return remaining(loop, [-1.0, -2.0], [1.0, 2.0], 0, [2], [2])


def line(gain: float, shift: float, ranks: Sequence[int], steps: Sequence[int] | None = None, **more: Any) -> Document:
    """x+ = u = gain x + shift on the leaves [0, 1], [1, 2], [2, 3], [3, 4]."""
    loop = made(more, dynamics=["u"], network=[affine([[gain]], [shift])])
    return remaining(loop, [0.0], [4.0], 2, ranks, [int(r < NO) for r in ranks] if steps is None else steps)


# ------------------------------------------------------------------------------------------------------- what is true


def test_boxes_of_a_contraction_are_never_left() -> None:
    assert verdict(contracting()) is None and verdict(contracting(2.0)) is None
    assert verdict(contracting(0.5)) is None  # 3/4 of it
    none = edited(contracting(), "evidence.ranks.ranks", raw(two_bytes([NO] * 64)))
    assert verdict(none) == "ranks"  # they have steps
    assert verdict(edited(none, "evidence.ranks.steps", raw(bytes(64)))) is None  # there may be no such leaf
    assert rejected(edited(contracting(), "plant.dynamics.1", ["*", "4", "u"]))[0] == "ranks"


def test_a_third_of_a_turn_returns_after_three_steps() -> None:
    assert by_reference(winding(3)) is None and by_reference(winding(6)) is None
    for count in (1, 2, 4):
        assert rejected(winding(count)) == ("ranks", "ranks leaf 0")


def test_a_little_less_than_a_third_of_a_turn() -> None:
    """Edges that coincide exactly are for rationals; three steps shrink this by 3e-8."""
    less = [affine([[1 - 1e-4, 1e-4 - 1]])]
    assert verdict(winding(3, network=less)) is None and verdict(winding(6, network=less)) is None
    for count in (1, 2, 4):
        assert verdict(winding(count, network=less)) == "ranks"
    assert verdict(winding(3, network=less, domain=("-2", "2"))) is None
    assert verdict(winding(3, network=less, domain=("-19/10", "19/10"))) == "ranks"
    assert verdict(winding(3, network=less, keep=[["-", "x", "199/100"]])) == "keep"
    assert verdict(winding(3, network=less, bound="199/100")) == "inputs"
    mirrored = [
        line(-1 + 1e-9, 4 - 1e-9, ranks, most=65_534) for ranks in ([1] * 4, [1, 2, 2, 65_534], [65_534, 9, 9, 3])
    ]
    assert [verdict(one) for one in mirrored] == [None] * 3


def test_an_angle_goes_round_for_ever() -> None:
    assert verdict(turning()) is None
    assert verdict(edited(turning(), "claim.ranks.angles", [])) == "ranks"  # it leaves the box of the tree
    for hole in range(8):
        assert verdict(turning(hole)) == "ranks"
    assert verdict(turning(keep=[["-", ["sin", "x"], "2"], ["-", "y", "3/2"]])) is None
    assert verdict(turning(keep=[["-", "x", "9"]])) == "angles"
    assert verdict(turning(domain=("-1", "1"))) == "ranks"  # that of y; nothing is asked of x


def test_held_inputs_keep_constraints_between_sampling_instants() -> None:
    assert verdict(braking()) is None
    assert rejected(braking("7/5")) == ("keep", "ranks leaf 0")
    assert rejected(edited(braking(), "plant.domain.0", ["-9", "7/5"])) == ("flow", "ranks leaf 0")


def test_ranks_need_not_fall() -> None:
    """x+ = 4 - x exchanges [0, 1] with [3, 4]: whatever ranks they have, the other's may be higher."""
    for ranks in ([1, 1, 1, 1], [1, 2, 2, 65_534], [65_534, 9, 9, 3]):
        assert by_reference(line(-1.0, 4.0, ranks, most=65_534)) is None
    assert by_reference(line(-1.0, 4.0, [5] * 4, [5, 3, 3, 5])) is None
    reaches = edited(line(-1.0, 4.0, [5] * 4), "claim", lambda claim: claim | {"kind": "reaches", "target": ["1"]})
    assert by_reference(reaches) == "ranks"


def test_what_is_uncertain() -> None:
    dynamics = ["+", "u", "q"]
    assert verdict(line(0.25, 1.0, [NO, 1, NO, NO], dynamics=[dynamics], uncertain=[("q", "-1/5", "1/5")])) is None
    assert verdict(line(0.25, 1.0, [NO, 1, NO, NO], dynamics=[dynamics], uncertain=[("q", "-1/4", "1/5")])) == "ranks"


# ------------------------------------------------------------------------------------------------------ what is false


@pytest.mark.parametrize(("end", "good"), [(2 - 1e-12, True), (2.0, False), (2 + 1e-12, False)])
def test_an_image_that_meets_a_leaf_without_a_rank_by_little(end: float, good: bool) -> None:
    """[1, 2] to [end - 1/2, end], and mirrored to [3 - end, 7/2 - end]: an edge is met, too."""
    for data in (line(0.5, end - 1, [NO, 1, NO, NO]), line(0.5, 2.5 - end, [NO, 1, NO, NO])):
        assert verdict(data) is None if good else rejected(data) == ("ranks", "ranks leaf 1")


@pytest.mark.parametrize(("by", "good"), [(0.0, True), (1e-12, False)])
def test_an_image_that_leaves_the_root_box_by_little(by: float, good: bool) -> None:
    for shift in (2 + by, -by):
        assert (by_reference(line(0.5, shift, [1] * 4)) is None) == good
    quarter = [affine([[1.0, 0.0]])]  # of a turn, on a box that is `by` less high than wide
    assert (by_reference(winding(1, lo=(-1.0, by - 1.0), network=quarter)) is None) == good


def test_one_leaf_of_many_leads_out() -> None:
    """x+ = x/2 + 1/4: [3, 4] to [1.75, 2.25], which meets two leaves."""
    assert verdict(line(0.5, 0.25, [1, 1, 1, 1])) is None
    for hole in (1, 2):
        ranks = [NO if i == hole else 1 for i in range(4)]
        assert rejected(line(0.5, 0.25, ranks))[0] == "ranks"
    assert verdict(line(0.5, 0.25, [1, 1, 1, NO])) is None


def test_no_leaf_has_rank_0() -> None:
    """Nothing lies in the target, and all leaves that this one meets have ranks."""
    for i in range(4):
        ranks = [int(i != j) for j in range(4)]
        assert rejected(line(0.5, 1.0, ranks, ranks)) == ("ranks", f"ranks leaf {i}")
    assert rejected(winding(0)) == ("ranks", "ranks leaf 0")


def test_ranks_and_steps_that_do_not_fit() -> None:
    for rank, count in ((1, 0), (2, 3), (9, 10), (11, 1), (NO, 1), (65_534, 1)):
        assert rejected(line(0.5, 1.0, [1, 1, rank, 1], [1, 1, count, 1], most=10)) == ("ranks", "ranks leaf 2")
    assert verdict(line(0.5, 1.0, [1, 1, 10, 1], [1, 1, 10, 1], most=10)) is None


def test_the_domain_on_the_way() -> None:
    assert by_reference(winding(3, domain=("-2001/1000", "2001/1000"))) is None
    assert rejected(winding(3, domain=("-2", "2"))) == ("ranks", "ranks leaf 0")
    for axis in (0, 1):  # x touches its end after two of three steps, y after one
        for end in (["-9", "2"], ["-2", "9"]):
            assert by_reference(edited(winding(3), f"plant.domain.{axis}", end)) == "ranks"
            wider = ["-9", "2001/1000"] if end[1] == "2" else ["-2001/1000", "9"]
            assert by_reference(edited(winding(3), f"plant.domain.{axis}", wider)) is None
    assert by_reference(line(0.5, 1.0, [1] * 4, domain=("0", "9"))) == "ranks"  # a leaf's end is the domain's
    assert by_reference(line(0.5, 1.0, [NO, 1, 1, 1], domain=("0", "9"))) is None


def test_constraints_and_inputs_on_the_way() -> None:
    """y is 2 after the first of three steps alone, x after the second alone."""
    for axis in PLANE:
        for sign in ("1", "-1"):
            g = ["*", sign, axis]
            assert by_reference(winding(3, keep=["-1", ["-", g, "2001/1000"]])) is None
            assert rejected(winding(3, keep=["-1", ["-", g, "1999/1000"]])) == ("keep", "ranks leaf 0")
    assert by_reference(winding(3, bound="2")) is None and by_reference(winding(3, bound="1999/1000")) == "inputs"
    assert by_reference(line(0.5, 1.0, [1] * 4, keep=[["-", "x", "4"]])) == "keep"  # also where it starts
    assert by_reference(line(0.5, 1.0, [1, 1, 1, NO], keep=[["-", "x", "4"]])) is None


def test_a_next_state_that_may_not_exist() -> None:
    assert verdict(line(0.5, 1.0, [1] * 4, dynamics=[["+", "u", ["*", "0", "x", ["/", "1", "x"]]]])) == "ranks"
    assert verdict(line(0.5, 1.0, [NO, 1, 1, 1], dynamics=[["+", "u", ["*", "0", ["/", "1", "x"]]]])) is None


# --------------------------------------------------------------------------------------------------- form, words, work


@pytest.mark.parametrize(
    ("section", "more"),
    [
        ("claim", {"target": ["x"]}),
        ("claim", {"target": None}),
        ("claim", {"rate": (0.0).hex()}),
        ("claim", {"outer": None}),
        ("claim", {"start": None}),
        ("claim", {"data": {}}),
        ("claim", {"samples": {}}),
        ("claim", {"keep": None}),
        ("claim", {"keep": []}),
        ("claim", {"keep": [["network", "pi", 0, "x", "y"]]}),
        ("claim", {"kind": "Remains"}),
        ("claim", {"kind": "reaches"}),  # without a target
        ("claim", {"kind": "invariant"}),
        ("claim", {"kind": "asymptotic"}),
        ("claim", {"sample": ["1/4", "1/2"]}),
        ("claim", {"sample": ["0", "0"]}),
        ("claim", {"ranks": None}),
        ("claim", {"ranks": {"angles": [], "steps": 0}}),
        ("claim", {"ranks": {"angles": [], "steps": 65_535}}),
        ("claim", {"ranks": {"angles": ["u"], "steps": 1}}),
        ("plant", {"time": "continuous"}),
        ("evidence", {"kind": "partition-tree"}),
        ("evidence", {"kind": "outer"}),
        ("evidence", {"kind": "remains"}),
        ("evidence", {"kind": "trusted-solver"}),
        ("evidence", {"order": 2}),
        ("evidence", {"T": encode(1.0, 0.0, 0.0, 1.0)}),
        ("evidence", {"ranks": None}),
    ],
)
def test_what_has_no_form(section: str, more: Document) -> None:
    data = contracting(keep=[["-", "x", "9"]])
    assert verdict(data) is None
    assert verdict(edited(data, section, lambda old: old | more)) == "format"


def test_what_is_missing_or_of_other_claims() -> None:
    data = contracting()
    for section, key in (("claim", "sample"), ("claim", "ranks"), ("evidence", "ranks"), ("evidence", "order")):
        less = {name: value for name, value in data[section].items() if name != key}
        assert verdict(edited(data, section, less)) == "format"
    assert verdict(edited(data, "lyapunov", {"kind": "quadratic", "P": encode(1.0, 0.0, 0.0, 1.0)})) == "format"
    assert verdict(edited(data, "levels", {"local": (1.0).hex(), "roa": (1.0).hex()})) == "format"
    assert verdict(data | {"then": data}) == "format"
    wrong = rules.judge(dumped(edited(data, "evidence.kind", "outer")))
    assert wrong.at == "evidence.kind" and wrong.detail == "'ranks' was expected with claim 'remains'"


def words(data: Document) -> str:
    return in_words(read(dumped(data))).split(": ", 1)[1]


def test_the_claim_in_words() -> None:
    assert words(contracting()) == (
        "every trajectory that starts in a box of the certificate's tree of ranks whose rank is r < 65535 exists at "
        "all times, is in such a box again after at most 1000 steps, and so on for ever, at all times with u within "
        "the input bounds, and x, y inside the domain; nothing is said of where it goes among these boxes"
    )
    held = words(braking())
    assert held.startswith("every trajectory that starts at a sampling instant in a box of the certificate's tree")
    assert "again after at most 1000 periods, and so on for ever, at all times with u" in held
    assert held.endswith("; and along each of these trajectories the 1 expressions of keep are negative at all times")
    angle = words(turning(keep=["-1"], uncertain=[("q", "0", "1")]))
    assert "for ever (states that differ by multiples of 2 pi in x being the same), at all times with u" in angle
    assert "and y inside the domain, whatever values these have at any time: q in [0, 1]; nothing is said" in angle
    assert angle.endswith("the 1 expressions of keep are negative at every step")


def test_the_command(tmp_path: Path) -> None:
    path = tmp_path / "c.json"
    path.write_bytes(dumped(contracting()))
    command = [sys.executable, "-I", "-m", "certify.reference", str(path)]
    done = subprocess.run([*command, "--json", "--jobs", "2"], capture_output=True, text=True, check=False, timeout=60)
    found = json.loads(done.stdout)
    assert done.returncode == 0 and not done.stderr
    assert (found["result"], found["claim"], found["leaves"], found["levels"]) == ("ACCEPTED", "remains", 64, {})
    path.write_bytes(dumped(contracting(1.5, network=[affine([[-0.25, 1.0]])])))
    done = subprocess.run([*command, "--jobs", "2"], capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 1 and "REJECTED rule=ranks at=ranks leaf" in done.stdout


# -------------------------------------------------------------------------------------------------------------- chance


@pytest.mark.slow
def test_what_is_accepted_is_never_left() -> None:
    """x+ = -4/5 x + q on 32 leaves with ranks and steps at random: no trajectory is away for longer than its steps."""
    chance = random.Random(3)
    loop = Loop([["+", "u", "q"]], [affine([[-0.8]])], None, uncertain=[("q", "-1/10", "1/10")], most=3)
    _, leaves = uniform([-2.0], [2.0], 5)
    found = {True: 0, False: 0}
    for _ in range(150):
        half, hole = chance.uniform(0.3, 2), chance.choice([-2.0, chance.uniform(0.3, 2)])
        kept = [-half <= a and b <= half and not a <= hole <= b for ((a, b),) in leaves]
        steps = [chance.randint(1, 3) if here else 0 for here in kept]
        ranks = [chance.randint(k, 3) if k else NO for k in steps]
        good = verdict(remaining(loop, [-2.0], [2.0], 5, ranks, steps)) is None
        found[good] += 1
        boxes = [(a, b, k) for ((a, b),), k in zip(leaves, steps, strict=True) if k]
        for a, b, k in boxes if good else ():
            for _ in range(10):
                x = chance.choice([a, b, chance.uniform(a, b)])
                for _ in range(k):
                    x = -0.8 * x + chance.choice([-0.1, 0.1])
                assert any(p - 1e-12 <= x <= q + 1e-12 for p, q, _ in boxes)
    assert min(found.values()) > 20
