"""Inputs that keep their bounds because tanh is monotone, where parallel lines around it leave them: FORMAT.md, inputs.

One leaf of a loop whose single step leads into a target that is everything, so that its inputs are all that is asked.
Bounds are placed at what Arb says that the inputs reach, a hair beyond and a hair within.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flint import arb, ctx

from certify.checker.document import Policy
from certify.checker.near import Above, Form
from certify.checker.network import enclose_on_boxes, fold, keep_bounds
from certify.checker.networks import Affine, Map, Network
from certify.reference.document import read
from certify.reference.evidence import Ranked
from certify.reference.ranks import Walk
from tests.support.rank_forgeries import by_checker, by_reference, verdicts
from tests.support.ranked import Document, Loop, affine, dumped, encode, hashed, mapped, raw, two_bytes

HAIR, BAND = Fraction(1, 10**9), Fraction(1, 1000)
Bounds = tuple[Fraction | int, Fraction | int]
WIDE: Bounds = (-99, 99)


def loop(
    network: Sequence[Document], *bounds: Bounds, lo: float = 0.0, hi: float = 1.0, steps: int = 1, **policy: Any
) -> Document:
    """x+ = 3 x/2 on the leaf [lo, hi], with inputs of these bounds that do not act."""
    names = [f"u{j}" for j in range(len(bounds))]
    idle = [["*", "0", name] for name in names]
    made = Loop([["+", ["*", "3/2", "x"], *idle]], list(network), ["-1"])
    data = made.document([lo], [hi], b"\xff", two_bytes([steps]), bytes([steps]))
    if steps > 1:  # the target is reached by the last step alone
        data["claim"]["target"] = [["-", "5/4", "x"]]
    ones = [1.0] * len(bounds)
    known = {"squash": "tanh", "scale": encode(*ones), "offset": encode(*(0 * v for v in ones)), "centre": "output"}
    data["policy"] |= known | policy
    data["policy"]["sha256"] = hashed(data["policy"], network)
    data["plant"] |= {
        "inputs": names,
        "u_eq": ["0"] * len(names),
        "input_bounds": [[str(a), str(b)] for a, b in bounds],
    }
    return data


def tanh(q: Fraction | float, down: bool) -> Fraction:
    """tanh, rounded to 80 bits."""
    q, old = Fraction(q), ctx.prec
    ctx.prec = 200
    try:
        value = (arb(q.numerator) / q.denominator).tanh()
    finally:
        ctx.prec = old
    return Fraction(int((value * 2**80).floor().unique_fmpz()) + (not down), 2**80)


def reaches(a: float, b: float, beta: float = 0.0) -> Bounds:
    """The inputs of tanh(y) - tanh(beta), y from a to b, outwards by 2^-79."""
    return tanh(a, True) - tanh(beta, False), tanh(b, False) - tanh(beta, True)


def moved(bounds: Bounds, lower: Fraction | int = 0, upper: Fraction | int = 0) -> Bounds:
    return bounds[0] + lower, bounds[1] + upper


def said(data: Document) -> str | None:
    """The rule that both refuse it by."""
    found = verdicts(data)
    assert found[0] == found[1]
    return found[0]


SATURATED = [affine([[6.0]], [-0.25])]  # its argument goes from -1/4 to 23/4


def test_an_input_that_saturates_keeps_the_bounds_that_it_reaches() -> None:
    bounds = reaches(-0.25, 5.75, -0.25)
    assert said(loop(SATURATED, moved(bounds, -HAIR, HAIR))) is None
    for lower, upper in ((HAIR, HAIR), (-HAIR, -HAIR)):
        assert said(loop(SATURATED, moved(bounds, lower, upper))) == "inputs"


def test_in_the_second_step_as_in_the_first() -> None:
    """From [9/10, 1] the state comes to [27/20, 3/2]: 8.75 is where tanh is taken then."""
    bounds = reaches(0.9 * 6 - 0.25, 8.75, -0.25)
    assert said(loop(SATURATED, moved(bounds, -HAIR, HAIR), lo=0.9, steps=2)) is None
    hair = tanh(8.75, True) - tanh(5.75, False)  # what the second step alone reaches
    assert hair > HAIR
    assert said(loop(SATURATED, moved(bounds, -HAIR, -hair / 2), lo=0.9, steps=2)) == "inputs"


@pytest.mark.parametrize("gain", [6.0, -6.0])
@pytest.mark.parametrize("scale", [2.0, -2.0])
def test_scales_and_slopes_of_both_signs(gain: float, scale: float) -> None:
    network = [affine([[gain]], [-0.25])]
    ends = sorted(Fraction(scale) * (tanh(y, True) - tanh(-0.25, True)) for y in (-0.25, gain - 0.25))
    bounds = ends[0] - HAIR, ends[1] + HAIR
    policy = {"scale": encode(scale), "offset": encode(0.5)}  # centring takes the offset out again
    assert said(loop(network, bounds, **policy)) is None
    assert said(loop(network, moved(bounds, 2 * HAIR), **policy)) == "inputs"
    assert said(loop(network, moved(bounds, 0, -2 * HAIR), **policy)) == "inputs"
    assert said(loop(network, bounds, scale=encode(0.0))) == "format"


@pytest.mark.parametrize("bias", [1e-9, 0.5, -0.5])
def test_centring_pushes_an_input_out_of_the_bounds_of_its_squash(bias: float) -> None:
    """tanh lies in [-1, 1], the input beyond it by |raw(0)| at one of the ends."""
    network = [affine([[60.0]], [bias])]
    assert said(loop(network, (-1, 1), lo=-1.0)) == "inputs"
    assert said(loop(network, (-1, 1), lo=-1.0, centre="none")) is None
    least = abs(Fraction(bias)) + HAIR / 1000
    free = moved((-1, 1), -least, least)
    assert said(loop(network, free, lo=-1.0)) is None


@pytest.mark.parametrize("weight", [1e308, -1e308])
def test_an_argument_that_overflows_shows_nothing(weight: float) -> None:
    """Forms of 10^308 x - 10^308 x, which is 0, are not a number, or infinite."""
    network = [affine([[weight], [weight]]), affine([[weight, -weight]], of=1)]
    assert by_checker(loop(network, WIDE, lo=-1.0)) == "inputs"
    assert said(loop([affine([[weight]])], WIDE, lo=-1.0)) is None  # far, but finite


def both_ways() -> list[Document]:
    """y_1 = 6 x - 1/4, which saturates; y_2 = h - h, h = tanh(y_1)/16: its form is 0, its range knows little."""
    h = affine([[1 / 16], [1 / 16]], of=2)
    cancel = [affine([[6.0]], [-0.25]), mapped("tanh", 1), h, affine([[1.0, -1.0]], of=3)]
    return [*cancel, {"kind": "concat", "of": [1, 4]}]


def test_one_input_by_its_form_and_the_other_by_its_squash() -> None:
    reached, narrow = moved(reaches(-0.25, 5.75, -0.25), -HAIR, HAIR), (-BAND, BAND)
    assert said(loop(both_ways(), reached, narrow)) is None
    assert said(loop(both_ways(), moved(reached, 0, -2 * HAIR), narrow)) == "inputs"
    assert said(loop(both_ways(), moved(reached, 2 * HAIR), narrow)) == "inputs"
    assert said(loop(both_ways(), reached, (HAIR, 1))) == "inputs"  # 0 is below it
    assert said(loop(both_ways(), narrow, reached)) == "inputs"  # the bounds of the other


def test_no_other_squash_and_no_clip() -> None:
    """With `identity` the input goes to 6; a clip may lift it out of bounds that tanh keeps."""
    assert said(loop(SATURATED, (-2, 2), squash="identity")) == "inputs"
    reached = moved(reaches(-0.25, 5.75, -0.25), -HAIR, HAIR)
    for lo, hi in ((1.5, 4.0), (-1.0, 4.0)):
        clipped = {"clip": [encode(lo), encode(hi)]}
        assert said(loop(SATURATED, reached, **clipped)) in ("inputs", "centring")
    assert said(loop(SATURATED, (-2, 2), clip=[encode(-3.0), encode(-2.5)], centre="none")) == "inputs"


def test_two_leaves_by_two_ways() -> None:
    """Around 0 the form is nearly exact, on [0, 1] the input saturates: each leaf takes what shows it."""
    data = loop(SATURATED, moved(reaches(-0.25, 5.75, -0.25), -HAIR, HAIR), lo=-(2.0**-40), hi=2.0**-40)
    assert said(data) is None
    ranks = data["evidence"]["ranks"]
    ranks |= {"lo": encode(-1.0), "hi": encode(1.0), "tree": raw(bytes([0, 255, 255]))}
    ranks |= {"ranks": raw(two_bytes([65_535, 1])), "steps": raw(bytes([0, 1]))}
    assert said(data) is None
    ranks |= {"ranks": raw(two_bytes([1, 1])), "steps": raw(bytes([1, 1]))}
    assert said(data) == "inputs"  # on [-1, 0] the input goes to -1


@np.errstate(all="ignore")
@pytest.mark.parametrize("seed", range(12))
def test_what_samples_reach_is_never_outside_of_what_is_kept(seed: int) -> None:
    """Random networks and boxes: no bound is kept that a sampled state's input leaves."""
    chance = np.random.default_rng(seed)
    n, width, m, batch = 3, 6, 2, 40
    first, last = 3 * chance.standard_normal((width, n)), 3 * chance.standard_normal((m, width))
    network = Network(
        "pi", n, (
            Affine((0,), width, first, chance.standard_normal(width)), Map((1,), width, "tanh"),
            Affine((2,), m, last, chance.standard_normal(m)),
        ),
    )  # fmt: skip
    scale, offset = chance.choice([-3.0, 0.5, 2.0], m), chance.standard_normal(m)
    centre = str(chance.choice(["output", "none"]))
    policy = Policy(network, scale, offset, "tanh", centre)
    net = fold(policy, (Fraction(1, 7),) * m)
    centres, radii = chance.uniform(-1, 1, (n, batch)), 10.0 ** chance.uniform(-3, 0, (n, batch))
    x = Form(np.concatenate([centres[None], np.eye(n)[:, :, None] * radii]), Above(np.zeros((n, batch))))
    d = chance.uniform(-1, 1, (200, n, batch))
    states = centres + radii * np.concatenate([d, np.sign(d)])
    reached = np.einsum("ij,sjb->sib", first, states) + network.steps[0].bias[:, None]
    u = scale[:, None] * np.tanh(np.einsum("ij,sjb->sib", last, np.tanh(reached)) + network.steps[2].bias[:, None])
    if centre == "output":
        at_0 = scale * np.tanh(last @ np.tanh(network.steps[0].bias) + network.steps[2].bias)
        u += (1 / 7 - at_0)[:, None]
    else:
        u += offset[:, None]
    found = enclose_on_boxes(net, x)
    least, most, gained = u.min(0), u.max(0), 0
    for k in range(batch):
        for lower, upper in ((1e-9, 1.0), (-1.0, -1e-9)):  # beyond what is reached at one end
            bounds = [(Fraction(a + lower), Fraction(b + upper)) for a, b in zip(least[:, k], most[:, k], strict=True)]
            assert not keep_bounds(net, bounds, x[:, [k]], found[:, [k]]).any()
        spare = 0.02 * np.abs(scale)
        bounds = [(Fraction(a - s), Fraction(b + s)) for a, b, s in zip(least[:, k], most[:, k], spare, strict=True)]
        by_form = found.range.ends[0][:, k] >= least[:, k] - spare
        by_form &= found.range.ends[1][:, k] <= most[:, k] + spare
        gained += int(np.sum(keep_bounds(net, bounds, x[:, [k]], found[:, [k]])[:, 0] & ~by_form))
    assert gained  # the rule has been at work
    far = [(Fraction(np.quantile(a, 0.5)), Fraction(np.quantile(b, 0.9))) for a, b in zip(least, most, strict=True)]
    alone = [keep_bounds(net, far, x[:, [k]], found[:, [k]])[:, 0] for k in range(batch)]
    assert np.array_equal(keep_bounds(net, far, x, found), np.transpose(alone))  # a batch is its boxes
    assert 0 < np.sum(alone) < np.size(alone)


@pytest.mark.parametrize("seed", range(16))
def test_bounds_that_are_a_hair_of_a_hair_too_narrow(seed: int) -> None:
    """Neither the ball of an end nor the middle of one lies in bounds that the input leaves by 2^-70."""
    chance = np.random.default_rng(seed)
    lo, hi = sorted(chance.uniform(-1, 1, 2).tolist())
    gain, bias, scale = chance.normal(0, 2), chance.normal(), chance.choice([-1, 1]) * chance.uniform(0.3, 3)
    network, policy = [affine([[gain]], [bias])], {"centre": "none", "scale": encode(scale)}
    values = sorted(Fraction(scale) * tanh(Fraction(gain) * Fraction(x) + Fraction(bias), True) for x in (lo, hi))
    bounds, bit = (values[0], values[1]), Fraction(1, 2**70)
    assert said(loop(network, moved(bounds, -Fraction(1, 2**40), Fraction(1, 2**40)), lo=lo, hi=hi, **policy)) is None
    assert said(loop(network, moved(bounds, bit, 1), lo=lo, hi=hi, **policy)) == "inputs"
    assert said(loop(network, moved(bounds, -1, -bit), lo=lo, hi=hi, **policy)) == "inputs"


def test_a_bound_that_is_reached_exactly() -> None:
    assert by_reference(loop([affine([[6.0]])], (0, 1))) is None  # tanh(0) is 0 in balls too
    assert by_reference(loop([affine([[6.0]])], (HAIR, 1))) == "inputs"


@pytest.mark.parametrize("u_eq", ["0", "-9/10", "4/5"])
def test_centring_before_tanh_moves_what_tanh_is_taken_of(u_eq: str) -> None:
    beta = np.arctanh(float(Fraction(u_eq)))
    bounds = tanh(beta, True), tanh(6 + beta, False)
    data = loop(SATURATED, moved(bounds, -HAIR, HAIR), centre="preactivation")
    for plant, expected in ((moved(bounds, -HAIR, HAIR), None), (moved(bounds, HAIR, 1), "inputs")):
        ends = [str(v) for v in plant]
        assert said(data | {"plant": data["plant"] | {"u_eq": [u_eq], "input_bounds": [ends]}}) == expected


def test_one_end_by_the_form_and_the_other_by_the_squash() -> None:
    """y_1 + (h - h), h = tanh(y_1): lines around tanh lie far above it, its range reaches far below what cancels.

    The form of the input goes from -0.35 to 2.15, what it is at the ends of the range from -0.53 to 1.24.
    """
    h = affine([[1.0], [1.0]], of=2)
    network = [affine([[6.0]], [-0.25]), mapped("tanh", 1), h, affine([[1.0, -1.0]], of=3)]
    network.append({"kind": "sum", "of": [1, 4]})
    low, high = (Fraction(-11, 25), Fraction(-27, 50)), (Fraction(13, 10), Fraction(11, 5))
    assert said(loop(network, (low[0], high[1]))) is None
    assert said(loop(network, (low[1], high[0]))) is None
    assert said(loop(network, (low[0], high[0]))) == "inputs"  # though it is true


@pytest.mark.parametrize("gain", [6.0, -6.0])
def test_each_leaf_of_a_batch_has_a_range_of_its_own(gain: float) -> None:
    """One half has its inputs within loose bounds by their forms, the other one leaves them: in both orders."""
    data = loop([affine([[gain]])], (Fraction(-1, 2), 2), lo=-1.0)
    ranks = data["evidence"]["ranks"]
    ranks |= {"tree": raw(bytes([0, 255, 255])), "ranks": raw(two_bytes([65_535, 1])), "steps": raw(bytes([0, 1]))}
    one = {"ranks": raw(two_bytes([1, 65_535])), "steps": raw(bytes([1, 0]))}
    alone = [said(data), said(data | {"evidence": data["evidence"] | {"ranks": ranks | one}})]
    assert sorted(alone, key=str) == [None, "inputs"]
    ranks |= {"ranks": raw(two_bytes([1, 1])), "steps": raw(bytes([1, 1]))}
    assert said(data) == "inputs"


@pytest.mark.parametrize("weight", [0.0, 1.0])
def test_where_the_policy_may_not_exist_its_squash_shows_nothing(weight: float) -> None:
    """The root of x - 1/2 has no value on half of the leaf, whatever it is multiplied by."""
    root, bounds = [affine([[1.0]], [-0.5]), mapped("sqrt", 1), affine([[weight]], of=2)], (-BAND, 1 - BAND)
    assert said(loop(root, bounds, centre="none")) == "inputs"
    assert said(loop(root, bounds, centre="none", lo=0.75)) is None


def along_leaves(claim: str, bounds: Bounds) -> Document:
    """xdot = -x on the halves of [-1, 1], with one input that does not act, under rules `ring`, `outer`, `invariant`.

    With `outer` {V <= c2} is small, and its ring has leaves of its own.
    """
    data, zero, halves = loop(SATURATED, bounds), (0.0).hex(), raw(bytes([0, 255, 255]))
    dynamics = [["+", ["-", "x"], ["*", "0", "u0"]]]
    data["plant"] |= {"time": "continuous", "dynamics": dynamics, "domain": [["-1", "1"]]}
    N = {"expression": ["*", "x", "x"], "level": (0.5).hex()}
    covering = {"T": encode(1.0), "root": encode(1.0), "tree": halves, "faces": [raw(b"\xff")] * 2}
    if claim == "invariant":
        evidence = {"kind": "outer", "outer": covering}
        return data | {"claim": {"kind": claim, "outer": N}, "evidence": evidence}
    far = claim == "outer"
    return data | {
        "claim": {"kind": "practical", "rate": zero, "sample": None, "outer": N if far else None},
        "lyapunov": {"kind": "quadratic", "P": encode(64.0 if far else 1.0)},
        "levels": {"local": (0.25).hex(), "floor": (0.25).hex(), "roa": (0.9).hex()},
        "evidence": {
            "kind": "partition-tree", "T": encode(1.0), "root": encode(0.125 if far else 1.0), "tree": halves,
            "order": 1, "cells": [], "local": None, "contraction": None, "tube": [], "outer": covering if far else None,
        },
    }  # fmt: skip


@pytest.mark.parametrize("claim", ["ring", "outer", "invariant"])
def test_leaves_of_all_rules(claim: str) -> None:
    bounds = reaches(-6.25, 5.75, -0.25)
    assert said(along_leaves(claim, moved(bounds, -HAIR, HAIR))) is None
    for lower, upper in ((HAIR, HAIR), (-HAIR, -HAIR)):
        assert said(along_leaves(claim, moved(bounds, lower, upper))) == "inputs"


def test_an_input_whose_form_is_no_number_has_no_ends() -> None:
    c = read(dumped(loop(SATURATED, WIDE)))
    assert isinstance(c.evidence, Ranked)
    walk, nan = Walk(c, 1, c.evidence.ranking), arb("nan")
    assert len(walk.input(0, (arb(0), [arb(1)], arb(0)), (arb(0), arb(1))).ends) == 2
    assert not walk.input(0, (nan, [arb(1)], nan), (arb(0), arb(1))).ends


def test_an_input_that_no_equation_reads_must_have_a_value() -> None:
    """By its form it keeps any bounds that hold [-1, 1], where it is a number at all."""

    def read_by_nobody(shift: float) -> Document:
        data = loop([affine([[1.0]], [shift]), mapped("sqrt", 1), affine([[1.0]], [0.0], of=2)], (-1, 1), centre="none")
        data["plant"]["dynamics"] = [["*", "3/2", "x"]]
        return data

    assert said(read_by_nobody(0.5)) is None
    assert said(read_by_nobody(-0.5)) == "inputs"  # the root of a negative number, up to x = 1/2


def test_nor_may_it_be_without_one_on_a_ring() -> None:
    """x' = -x, and a policy sqrt(x + 3/5): {V <= 1/2} has states where that is no number."""
    path = Path(__file__).parents[1] / "data" / "undefined_policy.json"
    found = verdicts(json.loads(path.read_text()))
    assert found == ("inputs", "inputs")
