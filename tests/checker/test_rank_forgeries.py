"""Attacks on ranks, angles and constraints: no forgery is accepted, and no file keeps a checker busy."""

from __future__ import annotations

import json
from fractions import Fraction
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from certify.checker import clauses, document, rules, words
from certify.checker.case import Case
from certify.checker.ranks import Cover
from certify.reference import rules as reference_rules
from certify.reference.__main__ import in_words as said
from tests.support import ranks as made
from tests.support.marks import slow_after
from tests.support.rank_forgeries import Draw, Forger, Forgery, by_checker, verdicts
from tests.support.rank_truth import Truth, numbers
from tests.support.ranked import (
    UNRANKED,
    Document,
    Loop,
    affine,
    around_level,
    dumped,
    encode,
    mapped,
    two_bytes,
    uniform,
)

# ------------------------------------------------------------------------------------------------------------- angles


def standing(n: int, near: bool = False) -> Document:
    """n angles that stay, of which one leaf has all, and a target that holds none or, if near, all of them."""
    names = tuple(f"x{i}" for i in range(n))
    never = ["-", ["cos", "x0"], "99" if near else "-2"]
    loop = Loop([["+", name] for name in names], [affine([[0.0] * n])], [never], states=names, angles=names)
    return loop.document([-3.25] * n, [3.25] * n, b"\xff", two_bytes([1]), b"\1")


@pytest.mark.parametrize("n", [1, 13, 15, 64])
def test_many_angles_that_are_cut_in_two_do_not_take_hours(n: int) -> None:
    """The boxes of an image count: 2^64 of them would never be done."""
    assert verdicts(standing(n)) == ("ranks", "ranks")
    assert verdicts(standing(n, near=True)) == (None, None)


@pytest.mark.parametrize(("digits", "rule"), [(0, None), (300, "ranks"), (2000, "ranks")])
def test_a_frame_with_many_digits_does_not_take_minutes(digits: int, rule: str | None) -> None:
    """Its inverse has as many times 64."""
    chance = np.random.default_rng(0)
    rows = chance.integers(-4, 5, (64, 64)) + 20 * np.eye(64)
    data = standing(64, near=True)
    powers = chance.integers(-digits // 2, digits // 2 + 1, (64, 64))
    data["evidence"]["ranks"]["frame"] = encode(*np.ldexp(rows, powers).ravel().tolist())
    assert verdicts(data) == (rule, rule)


def covered(chance: np.random.Generator, n: int, angles: tuple[int, ...]) -> tuple[Cover, Any, Any]:
    """A root box, and boxes that are in it but for their angles."""
    lo = chance.choice([-3.1416, -3.25, 0.0, 7.0, -100.0], n)
    hi = lo + chance.choice([6.28319, 6.3, 7.0, 12.6, 13.0, 40.0], n)
    ranks = SimpleNamespace(lo=lo, hi=hi, angles=angles, tree=b"\xff", numbers=(np.zeros(1, int), np.zeros(1, int)))
    centre = chance.uniform(-30, 30, (n, 30))
    wide = chance.choice([0.0, 1e-9, 0.1, 1.0, 3.0, 6.0, 6.3, 10.0], (n, 30))
    low, high = centre - wide, centre + wide
    for i in set(range(n)).difference(angles):
        low[i], high[i] = np.clip(low[i], lo[i], hi[i]), np.clip(high[i], lo[i], hi[i])
    return Cover(cast(Case, SimpleNamespace(c=SimpleNamespace(ranks=ranks)))), low, high


@pytest.mark.parametrize("seed", range(4))
def test_the_parts_of_a_box_have_all_its_places(seed: int) -> None:
    chance, cut = np.random.default_rng(seed), 0
    for _ in range(40):
        n = int(chance.integers(1, 5))
        angles = tuple(int(i) for i in chance.permutation(n)[: chance.integers(0, n + 1)])
        cover, lo, hi = covered(chance, n, angles)
        found = [list[tuple[Any, Any]]() for _ in range(lo.shape[1])]
        for low, high, some in cover.places(lo, hi):
            for b in some:
                found[b].append((low[:, b], high[:, b]))
        for b, parts in enumerate(found):
            assert all(np.all((cover.lo <= p) & (p <= q) & (q <= cover.hi)) for p, q in parts)
            cut += len(parts) > 1
            for x in lo[:, b] + chance.choice([0.0, 1.0, 0.5, 0.2], (5, n)) * (hi - lo)[:, b]:
                turned = [x[i] + 2 * np.pi * np.arange(-40, 41) * (i in angles) for i in range(n)]
                assert any(
                    all(np.any((p[i] - 1e-12 <= y) & (y <= q[i] + 1e-12)) for i, y in enumerate(turned))
                    for p, q in parts
                )
    assert cut > 100


def wound(factors: int, steps: int) -> Document:
    """An angle times 2^64 so many times, under a sine, in the equations and in the policy's network."""
    network = [affine([[2.0**1000]], of=k) for k in range(steps)]
    network += [mapped("sin", steps), affine([[0.0]], of=steps + 1)]
    far = ["*", "x", *([["**", "2", 64]] * factors)] if factors else "x"
    loop = Loop([["+", "x", "1/2", ["*", "0", ["sin", far]]]], network, [["-", ["cos", "x"], "99"]], angles=("x",))
    return loop.document([-3.25], [3.25], b"\xff", two_bytes([0]), b"\0")


@pytest.mark.parametrize(("factors", "steps"), [(1, 0), (0, 1), (9000, 0), (0, 250)])
def test_an_angle_that_winds_very_often_is_refused_at_once(factors: int, steps: int) -> None:
    """Or else integers have so many digits that their products take hours."""
    assert verdicts(wound(0, 0)) == (None, None)
    assert verdicts(wound(factors, steps)) == ("angles", "angles")


# -------------------------------------------------------------------------------------------------------- random loops

SEEDS = (19, 25, 28, 43, 53, 60, 16, 47, 104, 131, 12, 23, 32, 35, 38, 59, 64, 77, 85, 89, 91, 94, 98, 109, 113, 127)
FAST = 2


def is_a_lie(data: Document, times: int = 3) -> str | None:
    """A sentence on a trajectory that does not do what a document claims; None if none was found."""
    truth = Truth(data)
    return next((lie for lie in (truth.lie(np.random.default_rng(k)) for k in range(times)) if lie), None)


def refuses(forgery: Forgery) -> bool:
    """True if both refuse it under a rule that says so. What may be true may be accepted, if it is no lie."""
    found = verdicts(forgery.data)
    assert all((rule is None and forgery.maybe) or rule in forgery.rules for rule in found), (forgery.what, found)
    assert None not in found or is_a_lie(forgery.data) is None, forgery.what
    return None not in found


@pytest.mark.parametrize("seed", slow_after(1, SEEDS))
def test_random_loops_do_what_is_accepted_and_no_forgery_is(seed: int) -> None:
    drawn = Draw(seed, (1, 1, 2)).ranked(depths=(5, 6, 6))
    assert len(drawn.moving) > 5 and verdicts(drawn.document) == (None, None)
    assert is_a_lie(drawn.document, 10) is None
    refused = [refuses(forgery) for forgery in Forger(drawn, seed).all()]
    assert sum(refused) > 25 and refused.count(False) < 30


@pytest.mark.parametrize("seed", slow_after(5, range(200, 280)))
def test_what_the_checker_accepts_without_any_margin_is_true(seed: int) -> None:
    """Its own images of leaves, to the last bit, give the ranks."""
    drawn = Draw(seed).ranked(0.0)
    assert by_checker(drawn.document) is None and is_a_lie(drawn.document, 6) is None


# ----------------------------------------------------------------------------------------------------------- by a hair


@pytest.mark.parametrize(("over", "rule"), [("1/1000000000", "ranks"), ("-1/1000000000", None)])
def test_an_image_that_leaves_the_root_box_or_meets_a_leaf_by_a_billionth(over: str, rule: str | None) -> None:
    """x+ = (10 + x)/4, and a hair where x is 2: [0, 2] goes to [5/2, 3], and [2, 3] to where x > 299/100."""
    slope = str(Fraction(1, 4) + Fraction(over) / 2)
    loop = Loop([["+", "5/2", ["*", slope, "x"], ["*", "0", "u"]]], [affine([[0.0]])], [["-", "299/100", "x"]])
    met = loop.document([0.0], [4.0], bytes([0, 255, 0, 255, 255]), two_bytes([2, 1, UNRANKED]), b"\1\1\0")
    out = loop.document([1.0], [3.0], bytes([0, 255, 255]), two_bytes([2, 1]), b"\1\1")
    assert verdicts(met) == verdicts(out) == (rule, rule)


@pytest.mark.parametrize("name", ["linear", "hanging"])
def test_an_obstacle_that_an_ellipsoid_grazes(name: str) -> None:
    """The largest a'x where V <= c2 is sqrt(c2 a'P^-1 a), to the last digit that floats have."""
    data = json.loads(made.base(name).to_json())
    states, level = data["plant"]["states"], float.fromhex(data["levels"]["roa"])
    P = numbers(data["lyapunov"]["P"]).reshape(2, 2)
    for a in ([1, 0], [0, -1], [1, 2], [-3, 1]):
        largest = Fraction(float(np.sqrt(level * (a @ np.linalg.solve(P, a)))))
        along = ["+", *(["*", str(k), state] for k, state in zip(a, states, strict=True))]
        for more, rule in ((Fraction(-1, 10**6), "keep"), (largest / 100, None)):
            keep = data["claim"] | {"keep": ["-1", ["-", along, str(largest + more)]]}
            assert verdicts(data | {"claim": keep}) == (rule, rule)


@pytest.mark.parametrize("sign", slow_after(1, ["", "-"]))
def test_ranks_that_run_in_a_circle(sign: str) -> None:
    """x+ = x or -x stays at the same distance for ever."""
    loop = Loop([["*", f"{sign}1", "x"]], [affine([[0.0]])], [["-", ["*", "x", "x"], "1/16"]])
    tree, leaves = uniform([-2.0], [2.0], 5)
    near = [max(map(abs, box[0])) <= 0.25 for box in leaves]
    for left, right, count in ((1, 1, 1), (1, 2, 1), (9, 8, 1), (9, 9, 9), (255, 254, 254)):
        ranks = [0 if here else left if box[0][0] < 0 else right for here, box in zip(near, leaves, strict=True)]
        steps = [min(count, rank) for rank in ranks]
        assert verdicts(loop.document([-2.0], [2.0], tree, two_bytes(ranks), bytes(steps))) == ("ranks", "ranks")


# -------------------------------------------------------------------------------------------------------- many steps


def slow(count: int, steps: bytes) -> Document:
    """x+ = x - 1/64 from [1, 2] to below 0, one leaf with a rank of so many steps; all numbers are exact."""
    loop = Loop([["-", "x", "1/64"]], [affine([[0.0]])], ["x"])
    return loop.document([1.0], [2.0], b"\xff", two_bytes([count]), steps)


def test_steps_have_one_byte_or_two() -> None:
    """The upper end is at 0 after 128 steps, an image that may have them rounded outward after 129."""
    assert verdicts(slow(129, bytes([129]))) == verdicts(slow(129, two_bytes([129]))) == (None, None)
    assert verdicts(slow(128 - 1, bytes([127]))) == verdicts(slow(127, two_bytes([127]))) == ("ranks", "ranks")
    assert verdicts(slow(385, two_bytes([129]))) == (None, None)  # a rank may be higher
    for octets in (b"", b"\x81\0\0", b"\x81\1", b"\0\x81"):  # none, three, 385 steps of a rank of 129, 33,024
        assert verdicts(slow(129, octets)) == ("ranks", "ranks")


@pytest.mark.parametrize(("count", "steps"), [(129, bytes([129])), (129, two_bytes([129])), (257, two_bytes([257]))])
def test_an_answer_counts_leaves_and_not_their_bytes(count: int, steps: bytes) -> None:
    c = document.certificate(json.loads(dumped(slow(count, steps))), "0" * 64)
    said = clauses.answers(c, rules.check(c))["ranks"]
    assert (said["leaves"], said["of"]) == (1, 1)


@pytest.mark.parametrize(("speed", "rule"), [("1/200", None), ("1/201", "ranks")])
def test_a_leaf_may_have_more_steps_than_a_byte_can_say(speed: str, rule: str | None) -> None:
    """After 401 steps of 1/200 the upper end of [1, 2] is below 0, after as many of 1/201 it is not."""
    loop = Loop([["-", "x", speed]], [affine([[0.0]])], ["x"])
    assert verdicts(loop.document([1.0], [2.0], b"\xff", two_bytes([401]), two_bytes([401]))) == (rule, rule)
    assert verdicts(loop.document([1.0], [2.0], b"\xff", two_bytes([401]), bytes([401 - 256]))) == ("ranks", "ranks")


# -------------------------------------------------------------------------------------------------------------- words


def in_words(data: Document) -> tuple[str, str]:
    """The claim as each program says it."""
    c = document.certificate(json.loads(dumped(data)), "0" * 64)
    judged = reference_rules.judge(dumped(data))
    assert judged.certificate is not None and judged.result == "ACCEPTED"
    return "\n".join(words.claim(c)), said(judged.certificate)


def test_what_is_said_of_places_and_of_instants() -> None:
    """Trajectories start where an input begins to be held, and a place is no state."""
    held = Loop(["u"], [affine([[-1.0]])], [["-", ["*", "x", "x"], "1/4"]], sample=("1/2", "1/2"))
    checker, reference = in_words(held.document([0.5], [0.75], b"\xff", two_bytes([1]), b"\1"))
    assert "leaf of finite rank (1 of 1 leaves) at a sampling instant is in the target after as many periods" in checker
    assert "starts at a sampling instant in a box" in reference and "after r periods at the latest" in reference
    loop = Loop([["+", "x", "u"]], [mapped("sin", 0), affine([[-0.5]], of=1)], None, angles=("x",))
    tree = bytes([0, 0, 255, 255, 255])
    data = loop.document([-3.25], [3.25], tree, two_bytes([65535] * 3), bytes(3))
    checker, reference = in_words(around_level(data, 1.0, 1 / 16))
    assert "(0 of 3 leaves)" in checker and "and from then on is, up to these multiples, one of those above" in checker
    assert "until then u stays in its bounds" in checker and "each state but" not in checker
    assert "is, as a place, one of these" in reference
