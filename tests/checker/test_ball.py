"""The closed loop's models on a ball, against ball arithmetic that shares nothing with them: values, edges, order.

A model is asked at rational points of the ball, in Arb, and nothing that is not certain counts as contained.
"""

from __future__ import annotations

from fractions import Fraction
from functools import cache, partial
from typing import Any

import numpy as np
import pytest
from flint import arb, ctx, fmpq

from certify.checker import ball, local, rules, tube
from certify.checker.ball import Ball
from certify.checker.case import Case
from certify.checker.errors import Rejected
from tests.checker.test_rules import honest
from tests.support.balls import with_ball
from tests.support.certificates import Document, decode, edited, encode, make, parse, rehash
from tests.support.jets import Jet, changed, seen
from tests.support.jets import curved as beyond_linear
from tests.support.marks import slow_after
from tests.support.oracle import policy_in_arb, quadratic, value_of

BITS = 3000


@cache
def curved() -> Document:
    """Every function of the format, a quotient and a power, of two states and two inputs of a network with two layers;
    F(0) = 0. Nothing here has to be stable."""
    generator = np.random.default_rng(4)
    W1, W2 = generator.standard_normal((5, 2)), generator.standard_normal((2, 5))
    first = [
        "+",
        ["-", "x"],
        ["/", ["sin", "y"], "3"],
        ["-", ["cos", "x"], "1"],
        "u",
        ["*", "v", ["exp", ["/", "x", "2"]]],
    ]
    second = [
        "+", ["-", ["sqrt", ["+", "1", ["*", "x", "y"]]], "1"], ["atan", ["-", "y", "x"]], ["tan", ["/", "y", "4"]],
        ["/", "v", ["+", "2", "x"]], ["*", "1/7", ["tanh", ["+", "x", "u"]]], ["**", "y", 3],
    ]  # fmt: skip
    return make(
        [first, second], [(W1, generator.uniform(-1, 1, 5)), (W2, [0.3, -0.2])], np.eye(2), (0.01, 0.01), states="xy",
        inputs="uv", u_eq=["0", "0"], domain=[("-3", "3")] * 2, input_bounds=[("-9", "9")] * 2, centre="output",
        scale=[-1.5, 0.75], offset=[0.0, 0.125],
    )  # fmt: skip


def document_of(name: str) -> Document:
    return curved() if name == "curved" else honest(name)


def on_ball(data: Document, J: np.ndarray) -> Ball:
    with np.errstate(all="ignore"):
        found = Ball(Case(parse(data)), J, "ball")
        assert found.F() and found.inputs
        return found


def points(generator: np.random.Generator, n: int) -> list[list[float]]:
    """In the unit ball, most of them next to its edge, the others next to its centre."""
    d = generator.standard_normal((8, n))
    d /= np.linalg.norm(d, axis=1, keepdims=True) * (1 + 2.0**-40)
    return (d * np.array([1, 1, 1, 0.99, 0.5, 1e-3, 1e-30, 1e-200])[:, None]).tolist()


def states(J: np.ndarray, d: list[float]) -> list[arb]:
    return [sum((arb(p) * arb(q) for p, q in zip(row, d, strict=True)), arb(0)) for row in J.tolist()]


def contains(v: Jet, value: arb, at_0: arb, d: list[float]) -> bool:
    """|v(d) - v(0) - a.d - d'Q d| <= slack ||d|| + d'E d, and v(0) within its error."""
    length = sum((arb(p) ** 2 for p in d), arb(0)).sqrt()
    linear = sum((arb(p) * arb(q) for p, q in zip(v.a.tolist(), d, strict=True)), arb(0))
    left = abs(value - at_0 - linear - beyond_linear(v, d))
    return bool(
        abs(at_0 - arb(float(v.c))) <= arb(float(v.error))
        and left <= arb(float(v.slack)) * length + quadratic(v.whole, d)
        and abs(value - at_0) <= arb(float(v.radius)) * length
    )


@pytest.mark.parametrize("name", ["curved", "rotor", "rotor, preactivation", "scalar", "linear", "clipped rotor"])
@pytest.mark.parametrize("size", slow_after(2, [2.0**-100, 1e-6, 0.01, 0.1]))
def test_the_ball_encloses_F_and_the_inputs(name: str, size: float) -> None:
    data = document_of(name)
    c, plant, generator = parse(data), data["plant"], np.random.default_rng(int(-np.log2(size)))
    n = len(plant["states"])
    for _ in range(3):
        J = size * generator.standard_normal((n, n))
        found = on_ball(data, J)
        with ctx.workprec(BITS):
            zero = [arb(fmpq(q.numerator, q.denominator)) for q in c.u_eq]
            for d in points(generator, n):
                x = states(J, d)
                u = policy_in_arb(c.policy, c.u_eq, x)
                assert all(contains(v, *pair, d) for v, *pair in zip(seen(found.inputs), u, zero, strict=True))
                names = dict(zip(plant["states"] + plant["inputs"], x + u, strict=True))
                for equation, f in zip(plant["dynamics"], seen(found.F()), strict=True):
                    assert contains(f, value_of(equation, names), arb(0), d), (d, equation)


@pytest.mark.parametrize("name", ["curved", "rotor, preactivation"])
def test_what_is_left_is_of_fourth_order(name: str) -> None:
    """On a ball half as large a is half, Q a quarter, K an eighth and what is left a sixteenth."""
    data, sizes = document_of(name), (2.0**-9, 2.0**-10, 2.0**-11)
    found = [
        [[np.linalg.norm(part) for part in (f.a, f.Q, f.K, f.whole)] for f in seen(on_ball(data, s * np.eye(2)).F())]
        for s in sizes
    ]
    with np.errstate(all="ignore"):  # a component that is a state has no Q
        orders = np.log2(np.array(found[:-1]) / np.array(found[1:]))
    bends = np.array(found)[:-1, :, 1] > 0
    assert (abs(orders[..., 0] - 1) < 1e-9).all()
    assert (abs(orders[..., 1] - 2) < 1e-6)[bends].all() and bends.any()
    thirds, rests = np.array(found)[:-1, :, 2] > 0, np.array(found)[:-1, :, 3] > 1e-14
    assert (abs(orders[..., 2] - 3) < 1e-4)[thirds].all() and thirds.any()
    assert (orders[..., 3] > 3.9)[rests].all() and rests.any()


def test_the_models_know_directions() -> None:
    """xdot = sin(x) of the first state alone: nothing is left in the second's direction, but for rounding."""
    data = make(
        [["sin", "x"], "y"], [(np.zeros((1, 2)), [0.0])], np.eye(2), (0.01, 0.01), states="xy",
        domain=[("-3", "3")] * 2,
    )  # fmt: skip
    f = seen(on_ball(data, 0.5 * np.eye(2)).F())[0]
    assert f.E[0, 0] > 0.001 > 1e-12 > f.E[1, 1] >= 0


# --------------------------------------------------------------------------------------------------- edges of the rules


def refusal(data: Document) -> tuple[str, str, str] | None:
    try:
        rules.check(parse(data))
    except Rejected as no:
        return no.rule, no.at, str(no)
    return None


def reach(data: Document) -> tuple[float, float]:
    """u_eq and the radius of the first input on the local ball."""
    c = parse(data)
    assert c.evidence.local is not None
    u = seen(on_ball(data, c.evidence.local.J).inputs)[0]
    return float(c.u_eq[0]), float(u.radius)


def local_only() -> Document:
    data = honest("rotor")
    return with_ball(edited(data, "levels.roa", data["levels"]["local"]))


@pytest.mark.parametrize("side", [0, 1])
def test_the_inputs_up_to_the_edge_of_their_model(side: int) -> None:
    data = local_only()
    u_eq, radius = reach(data)
    for factor, found in ((1 + 2.0**-20, None), (1 - 2.0**-20, ("inputs", "local ball"))):
        bound = Fraction(u_eq) + (1 if side else -1) * Fraction(radius) * Fraction(factor)
        got = refusal(edited(data, f"plant.input_bounds.0.{side}", str(bound)))
        assert (got and got[:2]) == found and (got is None or "may leave its bounds" in got[2])


@pytest.mark.parametrize("side", [0, 1])
def test_a_clip_up_to_the_edge_of_its_model(side: int) -> None:
    """It must certainly not act; bounds of the inputs hold by form where there is a clip."""
    data = honest("clipped rotor")
    data = with_ball(edited(data, "levels.roa", data["levels"]["local"]))
    u_eq, radius = reach(data)
    for factor, found in ((1 + 2.0**-20, None), (1 - 2.0**-20, ("local", "local ball"))):
        clip = [-0.75, 1.75]
        clip[side] = u_eq + (1 if side else -1) * radius * factor
        changed = edited(data, "policy.clip", [encode([v]) for v in clip])
        got = refusal(rehash(changed))
        assert (got and got[:2]) == found and (got is None or "may be clipped" in got[2])


def first(failures: Any) -> tuple[str, str] | None:
    return next(failures, None)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("part", ["c", "error", "a", "slack", "Q", "K", "E", "B", "U"])
def test_what_is_not_finite_keeps_no_input_and_is_clipped(bad: float, part: str) -> None:
    data = honest("clipped rotor")
    data = edited(data, "plant.input_bounds", [["-1/2", "3/2"]])  # not by form
    c = parse(data)
    assert c.evidence.local is not None
    found = on_ball(data, c.evidence.local.J)
    with np.errstate(all="ignore"):
        assert first(ball.keeps_inputs(found)) is None and first(ball.is_not_clipped(found)) is None
        u = seen(found.inputs)[0]
        spoilt = np.array(getattr(u, part), float)
        spoilt[(0,) * spoilt.ndim] = bad
        found.__dict__["inputs"] = [changed(u, **{part: spoilt}).model]
        assert first(ball.keeps_inputs(found)) == ("ball", "u may leave its bounds")
        assert first(ball.is_not_clipped(found)) == ("ball", "u may be clipped: policy.clip")


def given(jets: list[Jet], cell: Any = ()) -> list[Jet]:
    """In the place of a ball's models, whatever the cell."""
    return jets


@pytest.mark.parametrize("part", ["a", "slack", "Q", "K", "E", "B"])
def test_what_is_not_finite_does_not_decrease(part: str) -> None:
    data = honest("enlarged")
    case = Case(parse(data))
    with np.errstate(all="ignore"):
        pieces: list[tuple[Any, Any]] = [(local.Local.of(case), local.decreases)]
        pieces += [(piece, tube.decreases) for piece in tube.pieces(case)][:1]
        for subject, decreases in pieces:
            assert first(decreases(subject)) is None
            F = subject.F()
            spoilt = np.array(getattr(Jet.of(F[0]), part), float)
            spoilt[(0,) * spoilt.ndim] = np.nan
            subject.__dict__["F"] = partial(given, [changed(Jet.of(F[0]), **{part: spoilt}).model, *F[1:]])
            subject.__dict__.pop("sides", None)  # what it found before
            found = first(decreases(subject))
            assert found is not None and "no finite model" in found[1]


def test_the_local_margin_is_the_share_that_is_left() -> None:
    """In one state, of -x + E: 1 - E by hand; the rest grows with the ball, and the margin falls."""
    data, margins = honest("scalar"), []
    for level in (1e-6, 1e-4, 1e-2, 0.1):
        subject = local.Local.of(Case(parse(with_ball(edited(data, "levels.local", level.hex())))))
        assert first(local.decreases(subject)) is None
        [found] = subject.sides()
        assert found is not None
        decay, rest = found
        share = Fraction(int(rest[0, 0].p), int(rest[0, 0].q)) / Fraction(int(decay[0, 0].p), int(decay[0, 0].q))
        assert abs(min(subject.margins) - float(1 - share)) < 1e-12
        margins.append(min(subject.margins))
    assert margins == sorted(margins, reverse=True) and margins[-1] > 0 and margins[0] > 0.999
    assert decode(data["evidence"]["local"]["J"]).shape == (1,)
