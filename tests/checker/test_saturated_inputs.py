"""Inputs that keep their bounds because tanh is monotone, where parallel lines around it leave them: FORMAT.md, inputs.

One leaf of a loop whose single step leads into a target that is everything, so that its inputs are all that is asked.
Bounds are placed at what Arb says that the inputs reach, a hair beyond and a hair within.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from flint import arb, ctx

from certify.checker.document import Policy
from certify.checker.near import Above, Form
from certify.checker.network import enclose_on_boxes, fold, keep_bounds
from certify.checker.networks import Affine, Map, Network
from tests.support.rank_forgeries import by_checker, verdicts
from tests.support.ranked import Document, Loop, affine, encode, hashed, mapped, raw, two_bytes

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
