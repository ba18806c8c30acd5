"""Boxes with ranks, constraints and the claim `reaches` in the reference, angles in both: true claims, many false ones.

Every certificate is JSON by hand, and its ranks are found in floats (`tests.support.ranked`).
"""

from __future__ import annotations

import copy
import json
import math
import random
import subprocess
import sys
from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest
from flint import arb

from certify.reference import rules
from certify.reference.__main__ import in_words
from certify.reference.document import read
from certify.reference.evidence import Ranked
from certify.reference.leaves import Box
from certify.reference.ranks import Cover, Walk, around
from certify.reference.refusal import Refused
from tests.support.rank_forgeries import by_reference as verdict
from tests.support.rank_forgeries import verdicts
from tests.support.ranked import (
    UNRANKED,
    Document,
    Image,
    Interval,
    Loop,
    affine,
    around_level,
    dumped,
    encode,
    hashed,
    mapped,
    ranked,
    raw,
    two_bytes,
    uniform,
)

HALF = [affine([[-0.5]])]  # u = -x/2
NEAR: list[Any] = [["-", ["**", "x", 2], "1/16"]]  # |x| <= 1/4
TURNING: list[Any] = [["-", "9/10", ["cos", "x"]]]


def certificate(
    loop: Loop,
    image: Image,
    inside: Callable[[Sequence[Interval]], bool],
    ends: tuple[float, float] = (-2.0, 2.0),
    depth: int = 5,
    longest: int = 1,
) -> tuple[Document, list[int], list[int]]:
    n = len(loop.states)
    tree, leaves = uniform([ends[0]] * n, [ends[1]] * n, depth)
    angles = [loop.states.index(name) for name in loop.angles]
    ranks, steps = ranked(leaves, image, inside, longest, angles)
    return document(loop, ends, tree, ranks, steps), ranks, steps


def document(
    loop: Loop, ends: tuple[float, float], tree: bytes, ranks: Sequence[int], steps: Sequence[int]
) -> Document:
    n = len(loop.states)
    return loop.document([ends[0]] * n, [ends[1]] * n, tree, two_bytes(ranks), bytes(steps))


def repeated(step: Callable[[Sequence[Interval]], Sequence[Interval]]) -> Image:
    def image(box: Sequence[Interval], count: int) -> Sequence[Interval]:
        for _ in range(count):
            box = step(box)
        return box

    return image


def scaled(a: float, b: float = 0.0, wide: float = 0.0) -> Image:
    """a x + b within `wide`."""
    return repeated(lambda box: [(min(a * p, a * q) + b - wide, max(a * p, a * q) + b + wide) for p, q in box])


def within(size: float) -> Callable[[Sequence[Interval]], bool]:
    return lambda box: all(-size <= p and q <= size for p, q in box)


def cosine(box: Sequence[Interval]) -> bool:
    """cos x >= 9/10 on all of a box."""
    (a, b), far = box[0], math.acos(0.9) - 1e-6
    w = round((a + b) / 2 / (2 * math.pi)) * 2 * math.pi
    return -far <= a - w and b - w <= far


def edited(data: Document, path: str, value: Any) -> Document:
    """With the entry at a path replaced by a value, or by value(old); without it where the value is `...`."""
    result = copy.deepcopy(data)
    *parents, last = path.split(".")
    at = result
    for key in parents:
        at = at[int(key)] if isinstance(at, list) else at[key]
    if value is ...:
        del at[last]
    else:
        at[last] = value(at[last]) if callable(value) else value
    return result


def reranked(data: Document, ranks: Sequence[int], steps: Sequence[int]) -> Document:
    made = edited(data, "evidence.ranks.ranks", raw(two_bytes(ranks)))
    return edited(made, "evidence.ranks.steps", raw(bytes(steps)))


HALVING = Loop([["+", "x", "u"]], HALF, NEAR)


def halving(**more: Any) -> tuple[Document, list[int], list[int]]:
    return certificate(Loop(**{**HALVING.__dict__, **more}), scaled(0.5), within(0.25 + 2e-7))


# ------------------------------------------------------------------------------------------------------- what is true


def test_the_half_of_x_comes_near() -> None:
    data, ranks, steps = halving()
    assert max(ranks) == 4 and set(steps) == {0, 1} and verdict(data) is None
    c = rules.judge(dumped(data)).certificate
    assert c is not None
    words = in_words(c)
    assert "1000 at most" in words and "u within the input bounds, and x inside the domain" in words
    assert "nothing is said of what happens there" in words


def spiral(box: Sequence[Interval], count: int) -> list[Interval]:
    """Exact ends: two steps are a quarter of a turn, and a box in between is no longer one."""
    corners = [complex(x, y) * (0.6 + 0.6j) ** count for x in box[0] for y in box[1]]
    return [(min(part), max(part)) for part in ([z.real for z in corners], [z.imag for z in corners])]


SPIRAL = Loop(
    [["-", ["*", "3/5", "x"], ["*", "3/5", "y"]], ["+", ["*", "3/5", "x"], "u"]],
    [affine([[0.0, 0.6]])],
    [["-", ["+", ["**", "x", 2], ["**", "y", 2]], "1/2"]],
    states=("x", "y"),
)


def far_corner(box: Sequence[Interval]) -> float:
    return sum(max(p * p, q * q) for p, q in box)


def test_two_states_that_wind_inwards_in_several_steps() -> None:
    data, ranks, steps = certificate(SPIRAL, spiral, lambda b: far_corner(b) <= 0.49, (-2.0, 2.0), 8, 4)
    assert max(steps) > 1 and UNRANKED not in ranks
    assert verdict(data) is None


def test_many_steps_of_terms_that_cancel() -> None:
    """x+ = 31/3 x + 59/3 u = x/2; the radii of balls that are passed on from step to step grow 20 times in each."""
    loop = Loop([["+", ["*", "31/3", "x"], ["*", "59/3", "u"]]], HALF, NEAR)
    tree, leaves = uniform([-2.0], [2.0], 5)
    count = [0 if within(0.2)(box) else 99 for box in leaves]
    assert verdicts(document(loop, (-2.0, 2.0), tree, count, count)) == (None, None)


def test_an_angle_goes_round_and_over_the_seam() -> None:
    loop = Loop([["+", "x", "1/2", "u"]], [affine([[0.0]])], TURNING, angles=("x",))
    data, ranks, _ = certificate(loop, scaled(1.0, 0.5), cosine, (-3.25, 3.25), 6)
    assert UNRANKED not in ranks and max(ranks) > 10 and verdict(data) is None
    backwards = Loop([["+", "x", "-1/2", "u"]], [affine([[0.0]])], TURNING, angles=("x",))
    data, ranks, _ = certificate(backwards, scaled(1.0, -0.5), cosine, (-3.25, 3.25), 6)
    assert UNRANKED not in ranks and verdict(data) is None
    elsewhere, ranks, _ = certificate(loop, scaled(1.0, 0.5), cosine, (7.0, 13.5), 6)
    assert UNRANKED not in ranks and verdict(elsewhere) is None
    assert verdict(edited(data, "claim.ranks.angles", [])) == "ranks"  # it leaves the box of the tree


def sines(box: Sequence[Interval]) -> list[Interval]:
    ((a, b),) = box
    return [(a - 0.5 * math.sin(a), b - 0.5 * math.sin(b))]  # increasing


def test_a_policy_that_reads_the_sine_of_an_angle() -> None:
    loop = Loop([["+", "x", "u"]], [mapped("sin", 0), affine([[-0.5]], of=1)], TURNING, angles=("x",))
    data, ranks, _ = certificate(loop, repeated(sines), cosine, (-3.25, 3.25), 7)
    assert ranks.count(UNRANKED) in range(2, 40) and verdict(data) is None


HELD = Loop(["u"], [affine([[-1.0]])], NEAR, sample=("1/4", "1/2"), order=2)


def held(box: Sequence[Interval]) -> list[Interval]:
    ((a, b),) = box
    return [(min(0.5 * a, 0.75 * a), max(0.5 * b, 0.75 * b))]


def test_held_inputs_with_periods_in_a_range() -> None:
    for order in (1, 2, 3):
        loop = Loop(**{**HELD.__dict__, "order": order})
        data, ranks, _ = certificate(loop, repeated(held), within(0.25), (-2.0, 2.0), 6, 3)
        assert UNRANKED not in ranks and verdict(data) is None
    assert verdict(edited(data, "claim.sample", ["0", "1/2"])) == "ranks"  # nothing has moved after no time
    assert verdict(edited(data, "plant.domain", [["-2", "9"]])) in ("ranks", "flow")


def test_what_is_uncertain_has_another_value_in_each_step() -> None:
    """x+ = -9/10 x + q comes near 0 for each constant q, and is driven far by one that changes its sign."""
    network, target = [affine([[-0.9]])], [["-", ["abs", "x"], "1/2"]]
    loop = Loop([["+", "u", "q"]], network, target, uncertain=[("q", "-1/10", "1/10")])
    true, found, _ = certificate(loop, scaled(-0.9, 0.0, 0.1), within(0.5), (-2.0, 2.0), 7, 6)
    assert found.count(0) > 20 and verdict(true) is None
    false, ranks, _ = certificate(loop, scaled(-0.9, 0.0, 0.02), within(0.5), (-1.0, 1.0), 7, 6)
    assert UNRANKED not in ranks and verdict(false) == "ranks"


def test_ranks_beside_an_asymptotic_claim() -> None:
    data = around_level(halving()[0], 1.0, 1 / 16)
    assert verdict(data) is None
    c = rules.judge(dumped(data)).certificate
    assert c is not None and "converges to the origin" in in_words(c) and "V <= 0.0625, until then" in in_words(c)
    assert verdict(edited(data, "levels", {"local": (0.0624).hex(), "roa": (0.0624).hex()})) == "ranks"
    held_too = around_level(certificate(HELD, repeated(held), within(0.25), (-2.0, 2.0), 6, 3)[0], 1.0, 1 / 16)
    assert verdict(held_too) is None


def test_a_level_set_of_V_as_a_place() -> None:
    """x+ = x - sin(x)/2 on a box of an angle that does not hold 0, but 2 pi."""
    loop = Loop([["+", "x", "u"]], [mapped("sin", 0), affine([[-0.5]], of=1)], None, angles=("x",))
    data, ranks, _ = certificate(loop, repeated(sines), lambda box: within(0.25)([(p - 2 * math.pi, q - 2 * math.pi) for p, q in box]), (3.0, 9.5), 8)  # fmt: skip  # noqa: E501
    assert ranks.count(0) > 5 and ranks.count(UNRANKED) < 100
    ball = around_level(data, 1.0, 1 / 16)
    ball["evidence"]["local"]["multipliers"] = around_level(halving()[0], 1.0, 1 / 16)["evidence"]["local"][
        "multipliers"
    ]
    assert verdict(ball) is None
    wrong = edited(ball, "claim.ranks.angles", [])
    assert verdict(wrong) == "ranks"  # then 2 pi is far from {V <= c2}


# ------------------------------------------------------------------------------------------------ ranks that are false


def test_a_rank_that_is_too_low_by_one() -> None:
    data, ranks, steps = halving()
    lowered = 0
    for i, r in enumerate(ranks):
        if r > 1:
            made = reranked(data, [*ranks[:i], r - 1, *ranks[i + 1 :]], steps)
            lowered += verdict(made) == "ranks"
    assert lowered == sum(r > 1 for r in ranks)


def test_ranks_that_run_in_a_circle() -> None:
    for sign in (1.0, -1.0):
        loop = Loop(["u"], [affine([[sign]])], NEAR)
        tree, leaves = uniform([-2.0], [2.0], 4)
        near = [within(0.25)(box) for box in leaves]
        for high in (1, 2, 7):
            ranks = [0 if here else high if box[0][0] < 0 else 1 for here, box in zip(near, leaves, strict=True)]
            steps = [int(r > 0) for r in ranks]
            assert verdict(document(loop, (-2.0, 2.0), tree, ranks, steps)) == "ranks"
            most = [0 if here else 7 for here in near]
            long = [0 if here else 7 for here in near]
            assert verdict(document(loop, (-2.0, 2.0), tree, most, long)) == "ranks"


@pytest.mark.parametrize(("shift", "good"), [(1e-9, True), (-1e-9, False)])
def test_an_image_that_leaves_the_tree_by_little(shift: float, good: bool) -> None:
    """x+ = -x/2 + shift of the leaf at 2, where the tree begins at -1."""
    loop = Loop(["u"], [affine([[-0.5]], [shift])], NEAR)
    tree, leaves = uniform([-1.0], [2.0], 5)

    def clipped(box: Sequence[Interval], count: int) -> list[Interval]:
        return [(max(p, -0.9999), q) for p, q in scaled(-0.5)(box, count)]

    ranks, steps = ranked(leaves, clipped, within(0.25))
    assert UNRANKED not in ranks
    assert (verdict(document(loop, (-1.0, 2.0), tree, ranks, steps)) is None) == good


def test_a_leaf_that_is_met_at_its_edge_counts() -> None:
    """x+ = x/2 takes the leaf [1, 2] to [1/2, 1], whose end it shares."""
    tree = bytes([0, 0, 255, 255, 0, 255, 255])  # of [0, 4]: [0, 1], [1, 2], [2, 3], [3, 4]
    loop = Loop([["+", "x", "u"]], HALF, [["-", "x", "1"]])
    assert verdict(document(loop, (0.0, 4.0), tree, [0, 3, 5, 7], [0, 3, 2, 1])) is None
    assert verdict(document(loop, (0.0, 4.0), tree, [0, 1, 2, 3], [0, 1, 1, 1])) is None  # [1/2, 1] is in the target
    below = Loop([["+", "x", "u"]], HALF, [["-", "x", "999999999/1000000000"]])
    assert verdict(document(below, (0.0, 4.0), tree, [0, 1, 2, 3], [0, 1, 1, 1])) == "ranks"


@pytest.mark.parametrize("index", [0, -1])
def test_wrong_numbers_of_bytes(index: int) -> None:
    data, ranks, steps = halving()
    both = two_bytes(ranks)
    for wrong in (both[:-1], both[:-2], both + b"\0", both + b"\0\0", b"", both[::2]):
        assert verdict(edited(data, "evidence.ranks.ranks", raw(wrong))) == "ranks"
    for short in (bytes(steps[:-1]), bytes([*steps, 0]), b"", bytes(2 * len(steps))):
        assert verdict(edited(data, "evidence.ranks.steps", raw(short))) == "ranks"
    tree = uniform([-2.0], [2.0], 5)[0]
    for cut in (tree[:-1], tree + b"\xff", b"\xff", b"", b"\x01" + tree[1:]):
        assert verdict(edited(data, "evidence.ranks.tree", raw(cut))) == "ranks"


def test_ranks_and_steps_that_do_not_fit() -> None:
    data, ranks, steps = halving()
    at_0, high = ranks.index(0), ranks.index(max(ranks))

    def at(i: int, r: int, k: int) -> str | None:
        return verdict(reranked(data, [*ranks[:i], r, *ranks[i + 1 :]], [*steps[:i], k, *steps[i + 1 :]]))

    assert at(high, 900, 1) is None and at(high, 1000, 2) is None and at(high, UNRANKED, 0) is None
    assert at(high, 1001, 1) == "ranks"  # above the claim's
    assert at(high, 65_534, 1) == "ranks" and at(high, UNRANKED, 1) == "ranks"
    assert at(high, 5, 0) == "ranks" and at(high, 2, 3) == "ranks" and at(high, 0, 0) == "ranks"
    assert at(at_0, 0, 1) == "ranks" and at(at_0, 0, 255) == "ranks"
    assert at(high, 3, 3) is None  # in the target after three steps
    assert at(high, 2, 2) == "ranks"  # not yet: 2/4


def test_the_lower_byte_of_a_rank_is_first() -> None:
    data, ranks, steps = halving()
    spread = [200 * r for r in ranks]
    assert verdict(reranked(data, spread, steps)) is None
    swapped = b"".join(r.to_bytes(2, "big") for r in spread)
    assert verdict(edited(data, "evidence.ranks.ranks", raw(swapped))) == "ranks"
    wrapped = edited(data, "claim.ranks.steps", 65_534)
    assert verdict(reranked(wrapped, [16_000 * r for r in ranks], steps)) is None


def test_a_target_that_is_missed() -> None:
    data, ranks, _ = halving()
    assert verdict(edited(data, "claim.target", [["-", ["**", "x", 2], "624/10000"]])) == "ranks"
    assert verdict(edited(data, "claim.target", [*NEAR, ["-", "x", "249/1000"]])) == "ranks"
    assert verdict(edited(data, "claim.target", [*NEAR, ["-", "x", "1/4"]])) is None
    assert verdict(edited(data, "claim.target", [*NEAR, ["sqrt", "x"]])) == "ranks"  # it has no finite model
    assert verdict(edited(data, "claim.target", [["/", "-1", "x"]])) == "ranks"
    empty = reranked(data, [1 if r == 1 else UNRANKED for r in ranks], [int(r == 1) for r in ranks])
    assert verdict(empty) is None  # what ends in the target need not meet a leaf of rank 0
    assert verdict(edited(empty, "claim.target", ["1"])) == "ranks"


# ------------------------------------------------------------------------------------------------------ before a step


def test_inputs_and_domain_before_each_step() -> None:
    data = halving()[0]
    assert verdict(edited(data, "plant.input_bounds", [["-1", "1"]])) is None
    assert verdict(edited(data, "plant.input_bounds", [["-1", "999999/1000000"]])) == "inputs"
    assert verdict(edited(data, "plant.domain", [["-9", "2"]])) == "ranks"  # 2 is not inside
    assert verdict(edited(data, "plant.domain", [["-9", "2000001/1000000"]])) is None
    loop = Loop(["u"], [affine([[-3.0]])], [["-", ["*", "x", "x"], "1"]], bound="99")
    tree = bytes([0, 255, 255])  # x+ = -3 x takes [1/4, 1/3] to [-1, -3/4]
    away = Loop(**{**loop.__dict__, "domain": ("-2/5", "9")})
    assert verdict(away.document([-5.0], [0.0], b"\xff", two_bytes([UNRANKED]), b"\0")) is None
    steps = two_bytes([2, UNRANKED])
    assert verdict(away.document([0.03], [0.3], tree, steps, b"\2\0")) == "ranks"  # the first state is outside
    assert verdict(edited(away.document([0.03], [0.3], tree, steps, b"\2\0"), "claim.target", ["-1"])) == "ranks"
    wide = Loop(**{**loop.__dict__, "domain": ("-1", "9"), "target": ["-1"]})
    assert verdict(wide.document([0.03], [0.3], tree, steps, b"\2\0")) is None


@pytest.mark.parametrize("sign", [1, -1])
def test_both_ask_the_domain_before_each_step_to_the_last_digit(sign: int) -> None:
    """x+ = -3 x takes [1/32, 1/4] to [-3/4, -3/32], then to [9/32, 9/4] and the target; there nothing is asked."""
    loop = Loop(["u"], [affine([[-3.0]])], [["-", ["*", str(-sign), "x"], "-1/4"]], bound="99")
    ends = [sign / 32, sign / 4]
    for first, last, rule in (
        ("-3/4", "9/4", "ranks"),
        ("-750000001/1000000000", "1/4", "ranks"),
        ("-750000001/1000000000", "250000001/1000000000", None),
    ):
        loop.domain = (first, last) if sign > 0 else (negative(last), negative(first))
        assert verdicts(loop.document([min(ends)], [max(ends)], b"\xff", two_bytes([2]), b"\2")) == (rule, rule)


def negative(q: str) -> str:
    return q[1:] if q.startswith("-") else f"-{q}"


@pytest.mark.parametrize("bounds", [("1", "3"), ("3", "1"), ("3", "3")])
def test_both_ask_each_of_two_inputs(bounds: tuple[str, str]) -> None:
    """x+ = (u + v)/8 from [1, 2] with u = x and v = -x."""
    loop = Loop([["*", "1/8", ["+", "u", "v"]]], [affine([[1.0], [-1.0]])], [["-", "x", "1"]])
    data = loop.document([1.0], [2.0], b"\xff", two_bytes([1]), b"\1")
    plant = {"inputs": ["u", "v"], "u_eq": ["0", "0"], "input_bounds": [[f"-{b}", b] for b in bounds]}
    policy = data["policy"] | {"scale": encode(1.0, 1.0), "offset": encode(0.0, 0.0)}
    policy["sha256"] = hashed(policy, loop.network)
    said = None if bounds == ("3", "3") else "inputs"
    assert verdicts(data | {"plant": data["plant"] | plant, "policy": policy}) == (said, said)


@pytest.mark.parametrize("sign", ["1", "-1"])
def test_errors_of_two_inputs_do_not_cancel(sign: str) -> None:
    """u is a hat of y and v one of z, between 0 and 1, of which the forms know nothing but errors: u - v is up to 1."""
    hat, none = [1.0, -2.0, 1.0], [0.0] * 3
    rows = [[0.0, 1.0, 0.0]] * 3 + [[0.0, 0.0, 1.0]] * 3
    network = [affine(rows, [1.0, 0.0, -1.0] * 2), mapped("relu", 1), affine([hat + none, none + hat], of=2)]
    loop = Loop([["*", sign, ["-", "u", "v"]], "y", "z"], network, [], ("x", "y", "z"))
    for bound, said in (("999/1000", "ranks"), ("1001/1000", None)):
        loop.target = [["-", "x", bound]]
        data = loop.document([0.0, -1.0, -1.0], [0.5, 1.0, 1.0], b"\xff", two_bytes([1]), b"\1")
        plant = {"inputs": ["u", "v"], "u_eq": ["0", "0"], "input_bounds": [["-9", "9"]] * 2}
        policy = data["policy"] | {"scale": encode(1.0, 1.0), "offset": encode(0.0, 0.0)}
        policy["sha256"] = hashed(policy, network)
        assert verdicts(data | {"plant": data["plant"] | plant, "policy": policy}) == (said, said)


def test_the_domain_is_not_asked_of_angles() -> None:
    loop = Loop([["+", "x", "1/2", "u"]], [affine([[0.0]])], TURNING, angles=("x",), domain=("-1", "1"))
    assert verdict(certificate(loop, scaled(1.0, 0.5), cosine, (-3.25, 3.25), 6)[0]) is None


@pytest.mark.parametrize(
    ("keep", "good"),
    [
        (["-", "x", "2000001/1000000"], True),
        (["-", "x", "1999999/1000000"], False),
        (["-", ["abs", "u"], "1000001/1000000"], True),
        (["-", ["abs", "u"], "999999/1000000"], False),
        (["-", "x", "2"], False),  # 0 is not negative
        (["/", "-1", ["+", "3", "x"]], True),
        (["/", "-1", ["+", "2", "x"]], False),
    ],
)
def test_constraints_in_steps(keep: Any, good: bool) -> None:
    assert verdict(halving(keep=["-1", keep])[0]) == (None if good else "keep")


def test_constraints_are_not_asked_in_the_target_and_of_leaves_without_a_rank() -> None:
    above = ["-", "1/25", ["*", "x", "x"]]
    data, ranks, _ = halving(keep=[above])  # |x| > 1/5
    assert verdict(data) is None
    far = edited(data, "claim.keep", [["-", "x", "1"]])
    assert verdict(far) == "keep"
    few = [r if r < 4 else UNRANKED for r in ranks]
    assert verdict(reranked(far, few, [int(0 < r < UNRANKED) for r in few])) == "keep"
    few = [r if i < 24 else UNRANKED for i, r in enumerate(ranks)]  # x < 1
    assert verdict(reranked(far, few, [int(0 < r < UNRANKED) for r in few])) == "keep"  # at 1 it is 0
    few = [r if i < 23 else UNRANKED for i, r in enumerate(ranks)]
    assert verdict(reranked(far, few, [int(0 < r < UNRANKED) for r in few])) is None


def test_constraints_in_the_middle_of_several_steps() -> None:
    """x+ = -x/2 from [1, 2] in two steps: -1 comes between."""
    loop = Loop(["u"], HALF, [["-", ["*", "x", "x"], "1"]])
    tree = bytes([0, 255, 255])
    for bound, good in (("1000001/1000000", True), ("999999/1000000", False)):
        loop.keep = [["-", ["-", "x"], bound]]
        data = document(loop, (0.0, 2.0), tree, [0, 2], [0, 2])
        assert verdict(data) == (None if good else "keep")


def test_constraints_between_instants() -> None:
    """x' = u, u = -x: no state passes 2, where some start. x' = 4 goes past 2 before it is at 5."""
    data, *_ = certificate(Loop(**{**HELD.__dict__, "keep": [["-", "x", "2000001/1000000"]]}), repeated(held), within(0.25), (-2.0, 2.0), 6, 3)  # fmt: skip  # noqa: E501
    assert verdict(data) is None
    assert verdict(edited(data, "claim.keep", [["-", "x", "1999999/1000000"]])) == "keep"
    rising = Loop(
        [["+", "4", ["*", "0", "u"]]],
        HALF,
        [["-", "4", "x"]],
        sample=("1", "1"),
        keep=[["-", ["*", ["-", "x", "3"], ["-", "x", "3"]]]],
    )
    tree = b"\xff"
    assert verdict(edited(document(rising, (0.5, 1.0), tree, [1], [1]), "claim.keep", ["-1"])) is None
    assert verdict(document(rising, (0.5, 1.0), tree, [1], [1])) == "keep"  # -(x - 3)^2 is 0 at 3


def test_the_domain_between_instants() -> None:
    """From [1/2, 1] x' = 4 is at 5 after one period, and beyond 3 before."""
    rising = Loop([["+", "4", ["*", "0", "u"]]], HALF, [["-", "4", "x"]], sample=("1", "1"))
    assert verdict(document(rising, (0.5, 1.0), b"\xff", [1], [1])) is None
    rising.domain = ("-9", "3")
    assert verdict(document(rising, (0.5, 1.0), b"\xff", [1], [1])) == "flow"
    rising.domain = ("1/2", "9")
    assert verdict(document(rising, (0.5, 1.0), b"\xff", [1], [1])) == "flow"  # 1/2 is not inside


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("brakes", ["160", "q"])
def test_a_state_that_turns_back_between_instants(side: int, brakes: str) -> None:
    """From x <= 1/1000 at v <= 8/5 a brake of 160 turns x back after 10 ms, at 9/1000; x + hi f(xi) is beyond."""
    away = "v" if side > 0 else ["-", "v"]
    force = ["-", brakes] if side > 0 else brakes
    quantities = [("q", "160", "170")] if brakes == "q" else []
    loop = Loop([["*", "1", "v"], ["+", force, ["*", "0", "u"]]], [affine([[0.0, 0.0]])], [away], ("x", "v"),
                ("1/50", "1/50"), 2, quantities)  # fmt: skip
    near, fast = sorted([0.0, side / 1024]), sorted([side * 1.5, side * 1.6])
    data = loop.document([near[0], fast[0]], [near[1], fast[1]], b"\xff", two_bytes([1]), bytes([1]))
    exact = 1 / 1024 + 1.6**2 / 320

    def ending(at: float) -> Document:
        ends = [str(Fraction(-side)), str(Fraction(side * at))][::side]
        return edited(data, "plant.domain", [ends, ["-9", "9"]])

    for at, good in ((exact + 1e-9, True), (exact - 1e-9, False), (exact - 1e-6, False), (0.03, True)):
        assert verdicts(ending(at)) == ((None, None) if good else ("flow", "flow")), at
        assert set(verdicts(edited(ending(at), "evidence.order", 1))) == {"flow"}
    assert verdicts(edited(ending(0.2), "evidence.order", 1)) == (None, None)  # v is within 5.6


def test_constraints_between_instants_on_a_ball() -> None:
    """{x^2 <= 1/16} of x' = u, u = -x, as wide as 0.2525, and 1.25 times the way of a period more."""
    data = around_level(certificate(HELD, repeated(held), within(0.25), (-2.0, 2.0), 6, 3)[0], 1.0, 1 / 16)
    alone = edited(edited(data, "claim.ranks", ...), "evidence.ranks", ...)
    for bound, rule in (("28/100", "keep"), ("1/2", None)):
        assert verdict(edited(alone, "claim", lambda c, b=bound: c | {"keep": [["-", "x", b]]})) == rule
    still = edited(alone, "claim", lambda c: c | {"keep": [["-", "u", "28/100"]]})
    assert verdict(still) is None  # the input is held


def test_constraints_where_a_leaf_reaches_beyond_the_level() -> None:
    data = around_level(halving()[0], 1.0, 1 / 16)
    small = around_level(halving()[0], 1.0, 1 / 1024)["evidence"]["local"]["J"]
    data = edited(edited(data, "claim.ranks", ...), "evidence.ranks", ...)
    data = edited(data, "levels.local", (1 / 1024).hex())
    data = edited(edited(data, "evidence.local.J", small), "evidence.root", encode(0.5))
    data = edited(data, "evidence.tree", raw(uniform([-0.5], [0.5], 3)[0]))  # the leaf [1/4, 3/8] is not outside
    for bound, rule in (("3/10", None), ("24/100", "keep")):
        assert verdict(edited(data, "claim", lambda c, b=bound: c | {"keep": [["-", "x", b]]})) == rule
        assert verdict(edited(data, "claim", lambda c, b=bound: c | {"keep": [["-", ["-", "x"], b]]})) == rule


def test_constraints_with_what_is_uncertain() -> None:
    loop = Loop([["+", "u", "q"]], [affine([[-0.5]])], NEAR, uncertain=[("q", "-1/50", "1/50")])
    data, *_ = certificate(loop, scaled(-0.5, 0.0, 0.02), within(0.25), (-2.0, 2.0), 6)
    for bound, rule in (("21/1000", None), ("19/1000", "keep")):
        loop.keep = [["-", "q", bound]]
        assert verdict(edited(data, "claim", lambda c: c | {"keep": loop.keep})) == rule


def test_constraints_beside_V() -> None:
    data = around_level(halving()[0], 1.0, 1 / 16)
    assert verdict(edited(data, "claim", lambda c: c | {"keep": [["-", "x", "3"], ["-", "u", "3"]]})) is None
    assert verdicts(edited(data, "claim", lambda c: c | {"keep": [["-", "x", "1"]]})) == ("keep", "keep")
    alone = edited(edited(data, "claim.ranks", ...), "evidence.ranks", ...)
    assert verdicts(alone) == (None, None)
    assert verdicts(edited(alone, "claim", lambda c: c | {"keep": [["-", "x", "3/10"]]})) == (None, None)
    assert verdicts(edited(alone, "claim", lambda c: c | {"keep": [["-", "x", "1/4"]]})) == ("keep", "keep")
    leaves = edited(alone, "levels", {"local": (1 / 1024).hex(), "roa": (1 / 16).hex()})
    leaves = edited(leaves, "evidence.tree", "AAD//wD//w==")
    small = edited(leaves, "evidence.local", lambda b: b | {"J": around_level(halving()[0], 1.0, 1 / 1024)["evidence"]["local"]["J"]})  # fmt: skip  # noqa: E501
    grown = edited(small, "evidence.root", around_level(halving()[0], 1.0, 1 / 16)["evidence"]["root"])
    assert verdicts(grown) == (None, None)
    assert verdicts(edited(grown, "claim", lambda c: c | {"keep": [["-", "x", "27/100"]]})) == (None, None)
    assert verdicts(edited(grown, "claim", lambda c: c | {"keep": [["-", "x", "249/1000"]]})) == ("keep", "keep")
    assert verdicts(edited(grown, "claim", lambda c: c | {"keep": [["-", "1/100", "x"]]})) == ("keep", "keep")


# ------------------------------------------------------------------------------------------------------------ periodic

ROUND = Loop([["+", "x", "1/2", "u"]], [affine([[0.0]])], TURNING, angles=("x",))
SINE = [mapped("sin", 0), affine([[0.0]], of=1)]


@pytest.mark.parametrize(
    ("change", "rule"),
    [
        ({"dynamics": [["+", "x", "1/2", "u", ["*", "0", "x"]]]}, None),
        ({"dynamics": [["+", ["*", "2", "x"], "1/2", "u", ["-", "x"]]]}, None),
        ({"dynamics": [["+", "x", "1/2", ["*", "0", ["tan", ["*", "2", "x"]]]]]}, "ranks"),  # periodic, but not finite
        ({"dynamics": [["+", "x", "1/2", ["*", "0", ["sin", ["*", "3", "x"]]]]]}, None),
        ({"dynamics": [["+", "x", "1/2", ["*", "0", ["sin", ["*", "1/2", "x"]]]]]}, "angles"),
        ({"dynamics": [["+", ["*", "2", "x"], "1/2"]]}, "angles"),
        ({"dynamics": [["+", "1/2", "u"]]}, "angles"),
        ({"dynamics": [["+", ["-", "x"], "u"]]}, "angles"),
        ({"dynamics": [["+", "x", "1/2", ["*", "0", "x", "x"]]]}, "angles"),
        ({"dynamics": [["+", "x", "1/2", ["*", "0", ["abs", "x"]]]]}, "angles"),
        ({"dynamics": [["+", "x", "1/2", ["*", "0", ["clip", "x", "-1", "1"]]]]}, "angles"),
        ({"dynamics": [["+", "x", "1/2", ["*", "0", ["/", "1", ["+", "9", "x"]]]]]}, "angles"),
        ({"network": SINE}, None),
        ({"network": [affine([[3.0]]), mapped("cos", 1), affine([[0.0]], of=2)]}, None),
        ({"network": [affine([[0.5]]), mapped("cos", 1), affine([[0.0]], of=2)]}, "angles"),
        ({"network": [mapped("tanh", 0), affine([[0.0]], of=1)]}, "angles"),
        ({"network": [affine([[1.0]])]}, "angles"),
        ({"network": [affine([[1.0]])], "squash": "tanh"}, "angles"),
        ({"target": [["-", "x", "9"]]}, "angles"),
        ({"target": [*TURNING, ["-", ["sin", ["*", "1/2", "x"]], "2"]]}, "angles"),
        ({"target": [*TURNING, ["-", ["sin", ["*", "2", "x"]], "2"]]}, None),
        ({"keep": [["-", "x", "9"]]}, "angles"),
        ({"keep": [["-", ["cos", "x"], "2"]]}, None),
        ({"keep": [["-", ["-", "x", "x"], "2"]]}, None),
    ],
)
def test_what_is_periodic(change: dict[str, Any], rule: str | None) -> None:
    loop = Loop(**{**ROUND.__dict__, **change})
    assert verdicts(certificate(loop, scaled(1.0, 0.5), cosine, (-3.25, 3.25), 6)[0]) == (rule, rule)


@pytest.mark.parametrize(("factor", "rule"), [("3", None), ("1/2", "angles")])
def test_a_product_in_a_network_winds_as_one_in_equations(factor: str, rule: str | None) -> None:
    data = certificate(ROUND, scaled(1.0, 0.5), cosine, (-3.25, 3.25), 6)[0]
    first, second = ({"kind": "observe", "of": [0], "names": ["a", "b"], "expressions": [name]} for name in "ab")
    times = {"name": "times", "reads": 2, "steps": [first, second, {"kind": "product", "of": [1, 2]}]}
    called = ["sin", ["network", "times", 0, factor, "x"]]
    data = edited(
        data | {"networks": [*data["networks"], times]}, "plant.dynamics", [["+", "x", "1/2", ["*", "0", called]]]
    )
    assert verdicts(data) == (rule, rule)


def test_rates_of_angles_have_no_winding() -> None:
    loop = Loop([["+", "1", "u"]], [affine([[0.0]])], TURNING, angles=("x",), sample=("1/2", "1/2"))
    data = certificate(loop, scaled(1.0, 0.5), cosine, (-3.25, 3.25), 6)[0]
    assert verdicts(data) == (None, None)
    assert verdicts(edited(data, "plant.dynamics", [["+", "1", ["*", "0", "x"]]])) == (None, None)
    assert verdicts(edited(data, "plant.dynamics", [["+", "1", ["*", "1/99", "x"]]])) == ("angles", "angles")
    assert verdicts(edited(data, "plant.dynamics", [["+", "1", "x"]])) == ("angles", "angles")


def test_a_tree_must_be_longer_than_a_turn() -> None:
    tree, _ = uniform([0.0], [1.0], 6)
    everywhere = document(ROUND, (-3.25, 3.25), tree, [0] * 64, [0] * 64)
    assert verdict(edited(everywhere, "claim.target", ["-1"])) is None
    for end in (3.0, 2 * math.pi - 3.25, math.nextafter(2 * math.pi - 3.25, -9)):
        short = edited(document(ROUND, (-3.25, end), tree, [0] * 64, [0] * 64), "claim.target", ["-1"])
        assert verdict(short) == "ranks"
    assert verdict(edited(document(ROUND, (-3.25, -3.25), tree, [0] * 64, [0] * 64), "claim.target", ["-1"])) == "ranks"


def test_an_image_wider_than_a_turn_is_everywhere() -> None:
    loop = Loop([["+", "x", "q"]], [affine([[0.0]])], TURNING, angles=("x",), uncertain=[("q", "-4", "4")])
    tree, leaves = uniform([-3.25], [3.25], 6)
    near = [cosine(box) for box in leaves]
    ranks = [0 if here else 1 for here in near]
    assert verdict(document(loop, (-3.25, 3.25), tree, ranks, [int(r > 0) for r in ranks])) == "ranks"
    one = [UNRANKED] * 64
    one[40] = 1
    assert verdict(document(loop, (-3.25, 3.25), tree, one, [int(i == 40) for i in range(64)])) == "ranks"


def test_the_parts_of_an_interval_of_an_angle_have_all_its_places() -> None:
    """And lie between the ends; parts that have no more than a turn have no more than the interval, but for a hair."""
    chance, turn, seams = random.Random(3), 2 * arb.pi(), 0
    for _ in range(3000):
        lo = chance.choice([-3.1416, -3.25, 0.0, 7.0, -100.0, chance.uniform(-9, 9)])
        hi = lo + chance.choice([6.2832, 6.3, 7.0, 12.0, 13.0, chance.uniform(6.2832, 20)])
        a = chance.choice([lo, hi, chance.uniform(-30, 30)]) + chance.choice([0.0, 1e-9, -1e-9, 2 * math.pi, -0.1])
        b = a + chance.choice([0.0, 1e-9, 0.2, 3.0, 6.0, 6.29, 9.0, chance.uniform(0, 8)])
        parts = around(arb(a), arb(b), lo, hi, turn)
        assert parts and all(lo <= p <= q <= hi for p, q in parts)
        seams += len(parts) == 2
        if parts != [(lo, hi)]:
            assert sum(q - p for p, q in parts) <= b - a + (hi - lo - 2 * math.pi) + 1e-9
        for x in (a, b, lo, hi, *(chance.uniform(a, b) for _ in range(5))):
            if a <= x <= b:
                turns = range(math.floor((lo - x) / 6.28) - 1, math.ceil((hi - x) / 6.28) + 2)
                near = [x + w * 2 * math.pi for w in turns]
                assert any(p - 1e-12 <= y <= q + 1e-12 for p, q in parts for y in near)
    assert seams > 300


def test_an_angle_of_many_turns_is_a_place() -> None:
    turn = 2 * arb.pi()
    ((p, q),) = around(arb(10**6), arb(10**6) + arb("0.01"), -3.25, 3.25, turn)
    assert math.isclose(p, math.remainder(10**6, 2 * math.pi), abs_tol=1e-9) and math.isclose(q - p, 0.01, abs_tol=1e-9)
    assert around(arb(10**30), arb(10**30), -3.25, 3.25, turn) == [(-3.25, 3.25)]  # nobody knows which
    assert around(arb(0), arb(10) ** 400, -3.25, 3.25, turn) == [(-3.25, 3.25)]


@pytest.mark.parametrize("hole", [0, 1, 62, 63])
def test_a_hole_at_the_seam_is_seen_from_its_other_side(hole: int) -> None:
    data, ranks, steps = certificate(ROUND, scaled(1.0, 0.5), cosine, (-3.1416, 3.1416), 6)
    assert verdict(data) is None
    holed = [*ranks[:hole], UNRANKED, *ranks[hole + 1 :]]
    assert verdict(reranked(data, holed, [*steps[:hole], 0, *steps[hole + 1 :]])) == "ranks"


def test_two_seams_meet_in_four_corners() -> None:
    """The leaf [0, 1.625]^2, moved by 2.4 in both angles."""
    loop = Loop(["x", "y"], [affine([[0.0, 0.0]])], ["1"], ("x", "y"), angles=("x", "y"))
    tree, leaves = uniform([-3.25, -3.25], [3.25, 3.25], 4)
    corners = [i for i, box in enumerate(leaves) if all(abs(p + q) > 3.5 for p, q in box)]
    assert len(corners) == 4
    rows = [[arb("3.2125"), arb("0.8125"), 0, 0, 0], [arb("3.2125"), 0, arb("0.8125"), 0, 0]]
    rows = [[arb(v) for v in row] for row in rows]
    for hole in (None, *corners):
        ranks = [5 if i in corners and i != hole else UNRANKED for i in range(16)]
        c = read(dumped(document(loop, (-3.25, 3.25), tree, ranks, [int(r == 5) for r in ranks])))
        assert c.ranks is not None and isinstance(c.evidence, Ranked)
        cover = Cover(c, c.ranks, c.evidence.ranking)
        for rank in (4, 5):
            if rank == 5 and hole is None:
                cover.leads_to(rows, rank, "here")
            else:
                with pytest.raises(Refused):
                    cover.leads_to(rows, rank, "here")


def test_centring_of_a_policy_without_V() -> None:
    """The equilibrium is not asked, but a centring must exist."""
    data, *_ = halving()

    def recentred(**more: Any) -> str | None:
        made = edited(data, "policy", lambda p: p | more)
        return verdict(edited(made, "policy.sha256", hashed(made["policy"], made["networks"][0]["steps"])))

    assert recentred(centre="output") is None
    assert recentred(centre="preactivation", squash="tanh", scale=encode(0.125)) is not None  # u is too little
    assert recentred(centre="preactivation", squash="tanh", offset=encode(2.0)) == "centring"
    assert recentred(centre="output", clip=[encode(0.0), encode(9.0)]) == "centring"
    assert recentred(clip=[encode(-1.0), encode(1.0)]) is None
    assert recentred(clip=[encode(-0.01), encode(0.01)]) == "ranks"


# -------------------------------------------------------------------------------------------------------------- format


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("claim.ranks", ...),
        ("claim.target", ...),
        ("claim.sample", ...),
        ("claim.rate", (0.0).hex()),
        ("claim.outer", None),
        ("claim.start", None),
        ("claim.sample", ["1/4", "1/2"]),
        ("claim.keep", None),
        ("claim.keep", []),
        ("claim.keep", ["x"] * 65),
        ("claim.keep", [["network", "pi", 0, "x"]]),
        ("claim.keep", ["y"]),
        ("claim.target", []),
        ("claim.target", "x"),
        ("claim.target", ["u"]),
        ("claim.target", [["network", "pi", 0, "x"]]),
        ("claim.target", ["0"] * 65),
        ("claim.ranks.angles", ["x", "x"]),
        ("claim.ranks.angles", ["u"]),
        ("claim.ranks.angles", ["y"]),
        ("claim.ranks.angles", [["x"]]),
        ("claim.ranks.angles", "x"),
        ("claim.ranks.angles", None),
        ("claim.ranks.steps", 0),
        ("claim.ranks.steps", True),
        ("claim.ranks.steps", "9"),
        ("claim.ranks.steps", 65_535),
        ("claim.ranks.steps", -1),
        ("claim.ranks.more", 1),
        ("plant.time", "continuous"),
        ("lyapunov", {"kind": "quadratic", "P": "AAAAAAAA8D8="}),
        ("levels", {"local": (1.0).hex(), "roa": (1.0).hex()}),
        ("evidence.kind", "partition-tree"),
        ("evidence.kind", "trusted-solver"),
        ("evidence.order", 2),
        ("evidence.order", 0),
        ("evidence.T", "AAAAAAAA8D8="),
        ("evidence.ranks", ...),
        ("evidence.ranks", None),
        ("evidence.ranks.lo", "AAAAAAAA8D8"),
        ("evidence.ranks.lo", "AAAAAAAA8H8="),  # infinity
        ("evidence.ranks.hi", ""),
        ("evidence.ranks.tree", ...),
        ("evidence.ranks.ranks", [0]),
        ("evidence.ranks.steps", "AA"),
        ("evidence.ranks.more", ""),
        ("keep", []),
    ],
)
def test_what_has_no_form(path: str, value: Any) -> None:
    data = halving(keep=[["-", "x", "9"]])[0]
    assert verdict(data) is None and verdict(edited(data, path, value)) == "format"


def test_keys_of_other_claims() -> None:
    data = around_level(halving()[0], 1.0, 1 / 16)
    for path in ("evidence.ranks", "claim.ranks"):
        assert verdict(edited(data, path, ...)) == "format"
    assert verdict(edited(data, "claim", lambda c: c | {"target": NEAR})) == "format"
    assert verdict(edited(data, "plant.time", "continuous")) == "format"
    trusted = {"kind": "trusted-solver", "solver": "a", "version": "1", "precision": (1.0).hex(), "queries": []}
    plain = edited(edited(edited(data, "plant.time", "continuous"), "claim.ranks", ...), "evidence", trusted)
    plain = edited(plain, "plant.dynamics", ["u"])
    assert rules.judge(dumped(plain)).result == "TRUSTED"
    assert verdict(edited(plain, "claim", lambda c: c | {"keep": ["-1"]})) == "format"
    further = {"keep": ["-1"], "outer": {"expression": "x", "level": (1.0).hex()}}
    tube = {"kind": "enlarged", "start": encode(1.0), "keep": ["-1"]}
    for more in (further, tube):  # which a solver's word does not go with
        found = rules.judge(dumped(edited(plain, "claim", lambda c, more=more: c | more)))
        assert found.rule == "format" and found.at in ("evidence.kind", "claim.keep")


def test_the_command_and_its_words(tmp_path: Path) -> None:
    data, *_ = certificate(
        Loop(**{**ROUND.__dict__, "keep": [["-", ["cos", "x"], "2"]]}), scaled(1.0, 0.5), cosine, (-3.25, 3.25), 6
    )
    path = tmp_path / "c.json"
    path.write_bytes(dumped(data))
    command = [sys.executable, "-I", "-m", "certify.reference", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    claim, said = done.stdout.splitlines()
    assert done.returncode == 0 and not done.stderr and said.startswith("ACCEPTED sha256=")
    assert "multiples of 2 pi in x" in claim and "the 1 expressions of keep are negative at every step" in claim
    done = subprocess.run([*command, "--json"], capture_output=True, text=True, check=False, timeout=60)
    found = json.loads(done.stdout)
    assert (found["result"], found["claim"], found["leaves"], found["levels"]) == ("ACCEPTED", "reaches", 64, {})
    path.write_bytes(dumped(reranked(data, [0] * 64, [0] * 64)))
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 1 and "REJECTED rule=ranks at=ranks leaf 0" in done.stdout


# -------------------------------------------------------------------------------------------------------------- chance


def reaches(x: float, q: Callable[[], float], r: int) -> bool:
    """True if x+ = -7/10 x + q is in [-1/4, 1/4] after r steps at the latest."""
    for _ in range(r + 1):
        if abs(x) <= 0.25 + 1e-12:
            return True
        x = -0.7 * x + q()
    return False


def test_accepted_mutants_are_true() -> None:
    """Ranks and steps at random near those that hold: of what is accepted no trajectory is found that is late."""
    chance = random.Random(7)
    loop = Loop([["+", "u", "q"]], [affine([[-0.7]])], NEAR, uncertain=[("q", "-1/50", "1/50")])
    data, ranks, steps = certificate(loop, scaled(-0.7, 0.0, 0.02), within(0.25), (-2.0, 2.0), 5, 3)
    _, leaves = uniform([-2.0], [2.0], 5)
    assert verdict(data) is None
    found = {True: 0, False: 0}
    for _ in range(120):
        made, taken = list(ranks), list(steps)
        for i in chance.sample(range(32), chance.choice([1, 1, 2, 3])):
            if chance.random() < 0.5 and ranks[i]:
                made[i] = max(1, ranks[i] + chance.choice([-2, -1, 1, 2]))
            taken[i] = min(made[i], max(int(made[i] > 0), taken[i] + chance.choice([-1, 0, 1])))
        good = verdict(reranked(data, made, taken)) is None
        found[good] += 1
        for box, r in zip(leaves, made, strict=True):
            for _ in range(20 if good else 0):
                x = chance.choice([*box[0], chance.uniform(*box[0])])
                assert reaches(x, lambda: chance.choice([-0.02, 0.02]), r)
    assert min(found.values()) > 10


PENDULUM = [["+", "y", ["*", "q", ["cos", "x"]]], ["+", ["*", "2", ["sin", "x"]], ["*", "u", ["+", "1", "q"]], ["*", "x", "y", "1/9"]]]  # fmt: skip  # noqa: E501
TANH = [affine([[-0.7, 0.2], [0.4, -0.9]], [0.1, -0.3]), mapped("tanh", 1), affine([[-1.5, 0.8]], of=2)]


def policy(x: float, y: float) -> float:
    return -1.5 * math.tanh(-0.7 * x + 0.2 * y + 0.1) + 0.8 * math.tanh(0.4 * x - 0.9 * y - 0.3)


def rates(x: float, y: float, u: float, q: float, calls: int) -> tuple[float, float]:
    return y + q * math.cos(x), 2 * math.sin(x) + u * (1 + q) + x * y / 9 + calls * policy(y, q) / 3


def moved(x: float, y: float, h: float, q: Callable[[], float], calls: int) -> tuple[float, float]:
    """By steps of Runge and Kutta, the input held, with another q in each of four parts of the period."""
    u, part, values = policy(x, y), h / 40, [q() for _ in range(4)]
    for k in range(40):
        now = values[k // 10]
        a, b = rates(x, y, u, now, calls)
        c, d = rates(x + part / 2 * a, y + part / 2 * b, u, now, calls)
        e, f = rates(x + part / 2 * c, y + part / 2 * d, u, now, calls)
        g, i = rates(x + part * e, y + part * f, u, now, calls)
        x, y = x + part / 6 * (a + 2 * c + 2 * e + g), y + part / 6 * (b + 2 * d + 2 * f + i)
    return x, y


@pytest.mark.parametrize("frame", [None, [[1.0, 0.5], [-3.0, 2.0]]])
@pytest.mark.parametrize(("order", "calls"), [(0, 0), (1, 0), (2, 0), (3, 0), (5, 0), (0, 1), (1, 1)])
def test_boxes_hold_all_trajectories(order: int, calls: int, frame: list[list[float]] | None) -> None:
    """Each N x is within the error of its form, at the same d, after some steps; order 0 is discrete time.

    Also where the equations call a network, of a state and of what is uncertain.
    """
    sample = ("1/20", "1/10") if order else None
    called = ["*", "1/3", ["network", "pi", 0, "y", "q"]]
    dynamics = [PENDULUM[0], [*PENDULUM[1], called]] if calls else PENDULUM
    target, uncertain = [["-", "x", "9"]], [("q", "-1/10", "1/5")]
    loop = Loop(dynamics, TANH, target, ("x", "y"), sample, max(order, 1), uncertain, frame=frame)
    c = read(dumped(loop.document([0.5, -0.5], [0.6, -0.4], b"\xff", two_bytes([3]), b"\3")))
    assert isinstance(c.evidence, Ranked) and c.evidence.ranking is not None
    chance, walk = random.Random(order), Walk(c, max(order, 1), c.evidence.ranking)
    N = frame or [[1.0, 0.0], [0.0, 1.0]]
    rows = [walk.start(Box(0, [0.5, -0.5], [0.6, -0.4]))]
    for _ in range(3):
        rows += walk.step(rows[-1], "here", *walk.inputs([rows[-1]]))
    nearest = 0.0
    for _ in range(150):
        d = [chance.choice([-1.0, 1.0, chance.uniform(-1, 1)]) for _ in range(2)]
        far = chance.choice([-0.1, 0.2])

        def q(far: float = far) -> float:
            return chance.choice([far, far, chance.uniform(-0.1, 0.2)])

        state = 0.55 + 0.05 * d[0], -0.45 + 0.05 * d[1]
        for row in rows[1:]:
            if order:
                state = moved(*state, chance.choice([0.05, 0.1, chance.uniform(0.05, 0.1)]), q, calls)
            else:
                state = rates(*state, policy(*state), q(), calls)
            forms = [[float(v.mid()) for v in form] for form in row]
            away = [x - form[0] - form[1] * d[0] - form[2] * d[1] for x, form in zip(state, forms, strict=True)]
            for i, turned in enumerate(N):
                error = abs(turned[0] * away[0] + turned[1] * away[1])
                bounds = [turned[0] * forms[0][3 + k] + turned[1] * forms[1][3 + k] for k in range(2)]
                assert error <= bounds[i] + 1e-9 and abs(bounds[1 - i]) < 1e-12
                nearest = max(nearest, error / bounds[i])
    assert nearest > 0.3
