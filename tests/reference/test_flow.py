"""Enclosures of what a step changes, against points: the means of periods in which what is uncertain jumps.

A point that a model does not hold at its d, its means of q and its period would be a false bound of D; so would a state
that leaves what `reached` says, within the period.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from fractions import Fraction
from itertools import pairwise
from typing import Any

import mpmath
import numpy as np
import pytest
from flint import arb, arb_mat, ctx, fmpq

from certify.reference import flow, series
from certify.reference.balls import PRECISION
from certify.reference.document import Certificate
from certify.reference.document import read as read_certificate
from certify.reference.evidence import Ball, Tree
from certify.reference.leaves import Box, Leaves
from certify.reference.local import cells
from certify.reference.loop import Loop
from certify.reference.model import Model
from certify.reference.refusal import Refused
from certify.reference.taylor import Taylor
from tests.support.balls import exactly
from tests.support.certificates import Document, decode, dump, make
from tests.support.marks import slow_after
from tests.support.models import may_be
from tests.support.periods import mean_change, switching

FUNCTIONS: dict[str, Callable[[Any], Any]] = {
    "sin": lambda v: ["sin", v],
    "cos": lambda v: ["cos", v],
    "tan": lambda v: ["tan", v],
    "tanh": lambda v: ["tanh", v],
    "exp": lambda v: ["exp", v],
    "atan": lambda v: ["atan", v],
    "sqrt": lambda v: ["sqrt", ["+", "2", v]],
    "inverse": lambda v: ["/", "1", ["+", "3/2", v]],
    "cube": lambda v: ["**", ["+", "1/2", v], 3],
    "square of a difference": lambda v: ["**", ["-", v, "q"], 2],
}
W1, W2 = np.array([[0.9, -0.7], [0.4, 0.8], [-1.1, 0.2]]), np.array([[0.7, -0.5, 0.6]])
SLACK = 1e-13  # of the points themselves


def document(
    name: str, sample: tuple[str, str] | None, order: int, practical: bool, ranges: Sequence[tuple[str, str, str]] = ()
) -> Document:
    """Two states; q and p stand in several places, and at 0 everything vanishes unless the claim is `practical`."""
    phi = FUNCTIONS[name]
    first = [
        "+",
        ["*", "-1/2", "x"],
        ["*", "y", phi(["+", "1/4", ["*", "1/4", "q"], ["*", "q", "x"], ["*", "1/3", "y"]])],
        ["*", "q", "u"],
    ]
    second = ["+", ["*", "p", "x", phi(["+", ["*", "p", "x", "y"], ["*", "1/2", "u"]])], ["-", ["*", "q", "y"]]]
    bias = np.zeros(3)
    if practical:
        first, bias = [*first, ["*", "1/5", "q"]], np.array([0.3, -0.2, 0.1])
    data = make(
        [first, second], [(W1, bias), (W2, [0.1 * practical])], np.array([[1.0, 0.25], [0.25, 0.75]]), (0.01, 0.01),
        states="xy", squash="identity", centre="none", scale=[0.8], input_bounds=[("-9", "9")],
        domain=[("-3", "3")] * 2, uncertain=ranges or [("q", "3/4", "5/4"), ("p", "-1/2", "1/2")],
    )  # fmt: skip
    data["evidence"]["local"] |= {"order": order if sample else 1}
    data["evidence"]["order"] = order if sample else 1
    data["claim"]["sample"] = sample and list(sample)
    if practical:
        data["claim"]["kind"] = "practical"
        data["levels"]["floor"] = (0.005).hex()
    return data


def act(data: Document, x: Sequence[float]) -> mpmath.mpf:
    """The policy, in many digits."""
    first, last = data["policy"]["layers"]
    with mpmath.workdps(40):
        hidden = [
            mpmath.tanh(sum((mpmath.mpf(w) * v for w, v in zip(row, x, strict=True)), mpmath.mpf(b)))
            for row, b in zip(decode(first["weight"]).reshape(3, 2), decode(first["bias"]), strict=True)
        ]
        net = sum((mpmath.mpf(w) * v for w, v in zip(decode(last["weight"]), hidden, strict=True)), mpmath.mpf(0))
        return mpmath.mpf(decode(data["policy"]["scale"])[0]) * (net + mpmath.mpf(decode(last["bias"])[0]))


def means(data: Document, pieces: Sequence[tuple[float, dict[str, Any]]], h: float) -> list[float]:
    """The mean of each quantity over the period as its symbol."""
    result = []
    for each in data["plant"]["uncertain"]:
        lo, hi = (Fraction(end) for end in each["range"])
        mean = sum(d * q[each["name"]] for d, q in pieces) / h if h > 0 else pieces[0][1][each["name"]]
        result.append(float((mean - mpmath.mpf(float((lo + hi) / 2))) / float((hi - lo) / 2)))
    return result


def drawn_period(sample: tuple[str, str], generator: np.random.Generator) -> tuple[float, float]:
    """A period, at an end of the range half of the time, and its symbol."""
    lo, hi = (float(Fraction(end)) for end in sample)
    h = float(generator.choice([lo, hi, generator.uniform(lo, hi)]))
    return h, (2 * h - lo - hi) / (hi - lo) if lo < hi else 0.0


SAMPLES = [
    (("1/10", "1/10"), 1),
    (("1/10", "1/10"), 2),
    (("0", "1/10"), 3),
    (("1/20", "1/12"), 4),
    (("1/12", "1/12"), 6),
]


# ------------------------------------------------------------------------------------------------------------ on a ball


def around(value: mpmath.mpf) -> arb:
    return arb(mpmath.nstr(value, 30)) + arb(0, SLACK)


def holds(f: Model, true: arb, d: Sequence[float], y: Sequence[float]) -> bool:
    return may_be(f.where([arb(v) + arb(0, 1e-12) for v in y]), true, d)


def steps_of(data: Document, J: np.ndarray) -> tuple[Certificate, flow.Steps]:
    c = read_certificate(dump(data))
    loop, ball = Loop(c), c.evidence.ball  # type: ignore[union-attr]
    assert isinstance(ball, Ball)
    return c, flow.steps_on(loop, loop.known(exactly(J), "local", "ball"), ball, "ball")


def points_of(generator: np.random.Generator, count: int) -> list[np.ndarray]:
    """Points of the unit disc, a third of them near its edge and one at its middle."""
    d = generator.standard_normal((count, 2))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    d *= np.where(np.arange(count) % 3 == 0, 0.999, generator.random(count))[:, None]
    d[-1] = 0
    return list(d)


@pytest.mark.parametrize("practical", slow_after(1, [False, True]))
@pytest.mark.parametrize(("sample", "order"), slow_after(1, SAMPLES))
@pytest.mark.parametrize("name", slow_after(6, FUNCTIONS))
def test_a_ball_encloses_the_mean_of_every_period(
    name: str, sample: tuple[str, str], order: int, practical: bool
) -> None:
    data = document(name, sample, order, practical)
    generator = np.random.default_rng(5)
    J = 0.2 * np.array([[0.9, 0.1], [-0.3, 0.8]])
    with ctx.workprec(PRECISION):
        c, steps = steps_of(data, J)
        (cell,) = cells(c.plant.ranges, (1, 1))
        G = steps.change(cell, "local", "ball").components
        for d in points_of(generator, 6):
            x = (J @ d).tolist()
            h, share = drawn_period(sample, generator)
            pieces = switching(data, h, generator)
            true = mean_change(data, x, [act(data, x)], pieces)
            y = means(data, pieces, h) + [share] * (sample[0] != sample[1])
            for g, value in zip(G, true, strict=True):
                assert holds(g, around(value), d, y), (d, pieces)


@pytest.mark.parametrize("practical", [False, True])
def test_higher_orders_are_tighter(practical: bool) -> None:
    """What is known of G at one d and one period, with what is uncertain known: about h^order."""
    widths = []
    for order in range(1, 7):
        data = document("sin", ("1/10", "1/10"), order, practical, [("q", "1", "1000000001/1000000000")])
        data["plant"]["dynamics"][1] = ["-", "y"]
        with ctx.workprec(PRECISION):
            c, steps = steps_of(data, 1e-4 * np.eye(2))
            G = steps.change(c.plant.ranges, "local", "ball").components
            widths.append(max(float(g.slack) for g in G))
    assert all(b < a / 4 for a, b in pairwise(widths[:4])), widths


@pytest.mark.parametrize("order", [1, 2, 3])
def test_a_ball_in_one_cell_encloses_periods_that_visit_other_cells(order: int) -> None:
    """All but x_1 must hold for every q of the ranges: with x_1 at another cell's q the rest is the same."""
    data = document("tanh", ("1/4", "1/4"), order, True, [("q", "0", "2")])
    data["plant"]["dynamics"] = [["*", "q", "y"], ["+", ["*", "q", "x"], ["-", "y"], "1/5"]]
    J, generator = 0.2 * np.eye(2), np.random.default_rng(1)
    with ctx.workprec(PRECISION):
        c, steps = steps_of(data, J)
        parts = [steps.change(cell, "local", "ball").components for cell in cells(c.plant.ranges, (2,))]
        for d in points_of(generator, 12):
            x, pieces = (J @ d).tolist(), switching(data, 0.25, generator)
            true = mean_change(data, x, [act(data, x)], pieces)
            (mean,) = (v + 1 for v in means(data, pieces, 0.25))  # q itself
            for g, value in zip(zip(*parts, strict=True), true, strict=True):
                below, above = (f.where([arb(1 if k == 0 else -1)]) for k, f in enumerate(g))  # both at q = 1
                assert below.v.overlaps(above.v)
                part = g[0] if mean <= 1 else g[1]
                assert holds(part, around(value), d, [2 * mean - 1 if mean <= 1 else 2 * mean - 3])


@pytest.mark.parametrize("practical", slow_after(1, [False, True]))
def test_no_state_leaves_what_is_reached(practical: bool) -> None:
    """At many times within the period, for periods that are nearly too long."""
    data = document("exp", ("1/8", "1/8"), 2, practical)
    J, generator = 0.1 * np.eye(2), np.random.default_rng(2)
    with ctx.workprec(PRECISION):
        c, steps = steps_of(data, J)
        for d in points_of(generator, 8):
            x = (J @ d).tolist()
            for share in (0.01, 0.5, 1.0):
                pieces = switching(data, 0.125 * share, generator)
                moved = mean_change(data, x, [act(data, x)], pieces)
                for name, start, g in zip(c.plant.states, x, moved, strict=True):
                    assert holds(steps.within[name], around(start + 0.125 * share * g), d, [])  # type: ignore[index]


# ------------------------------------------------------------------------------------------------------------ on leaves


def leaf_of(data: Document, box: Box) -> tuple[Leaves, Any]:
    c = read_certificate(dump(data))
    assert isinstance(c.evidence, Tree)
    leaves = Leaves(c, c.evidence.T, c.evidence.T.transpose() * c.P * c.evidence.T)
    return leaves, leaves.enclose([box])[0]


def value_at(model: Taylor, d: Sequence[arb]) -> arb:
    value, column = model.c, arb_mat(len(d), 1, list(d))
    if model.g is not None:
        value += (model.g * column)[0, 0]
    if model.Q is not None:
        value += (column.transpose() * model.Q * column)[0, 0]
    return value + model.r.union(-model.r)


@pytest.mark.parametrize(("sample", "order"), slow_after(1, SAMPLES))
@pytest.mark.parametrize("name", slow_after(6, FUNCTIONS))
def test_a_leaf_encloses_the_mean_of_every_period(name: str, sample: tuple[str, str], order: int) -> None:
    data = document(name, sample, order, True)
    data["levels"] = {key: (4.0).hex() for key in data["levels"]}
    generator = np.random.default_rng(7)
    with ctx.workprec(PRECISION):
        for size in (0.01, 0.02 if name == "tan" else 0.1):  # a pole is near
            centre = generator.uniform(-0.4, 0.4, 2)
            box = Box(0, (centre - size).tolist(), (centre + size).tolist())
            leaves, leaf = leaf_of(data, box)
            within = leaves.reached(leaf)
            G, D = leaves.G(leaf, within), leaves.D(leaf, within)
            for _ in range(4):
                z = np.where(generator.random(2) < 0.4, 1.0, generator.uniform(-1, 1, 2))
                x = (centre + size * z).tolist()
                h, share = drawn_period(sample, generator)
                pieces = switching(data, h, generator)
                true = [around(v) for v in mean_change(data, x, [act(data, x)], pieces)]
                symbols = [arb(v) + arb(0, 1e-12) for v in z] + [arb(0, 1)]
                symbols += [arb(v) + arb(0, 1e-12) for v in means(data, pieces, h)]
                symbols += [arb(share) + arb(0, 1e-12)] * (sample[0] != sample[1])
                for g, value in zip(G, true, strict=True):
                    assert value_at(g, symbols).overlaps(value), (x, pieces)
                    assert not value > g.bound() and not -value > (-g).bound()
                P, at = arb_mat(leaves.c.P), arb_mat(2, 1, [arb(v) for v in x])
                g = arb_mat(2, 1, true)
                fell = 2 * (at.transpose() * P * g)[0, 0] + arb(h) * (g.transpose() * P * g)[0, 0]
                assert not fell > D.bound()


@pytest.mark.parametrize("practical", [False, True])
@pytest.mark.parametrize("name", FUNCTIONS)
def test_discrete_time(name: str, practical: bool) -> None:
    """G = f - x, at q of a step; on balls and on leaves."""
    data = document(name, None, 1, practical)
    data["plant"]["time"] = "discrete"
    generator, J = np.random.default_rng(8), 0.3 * np.eye(2)
    with ctx.workprec(PRECISION):
        c, steps = steps_of(data, J)
        G = steps.change(c.plant.ranges, "local", "ball").components
        leaves, leaf = leaf_of(data, Box(0, [0.1, -0.2], [0.3, 0.0]))
        on_leaf = leaves.G(leaf)
        for d in points_of(generator, 6):
            pieces = [(0.0, switching(data, 0.0, generator)[0][1])]
            for x, models in (((J @ d).tolist(), "ball"), ((np.array([0.2, -0.1]) + 0.1 * d).tolist(), "leaf")):
                true = mean_change(data, x, [act(data, x)], pieces)
                less = [around(v - mpmath.mpf(e)) for v, e in zip(true, x, strict=True)]
                y = means(data, pieces, 0.0)
                symbols = [arb(v) + arb(0, 1e-12) for v in d] + [arb(0, 1)] + [arb(v) + arb(0, 1e-12) for v in y]
                for g, t, value in zip(G, on_leaf, less, strict=True):
                    assert holds(g, value, d, y) if models == "ball" else value_at(t, symbols).overlaps(value)


# ------------------------------------------------------------------------------------- the a-priori box, and the series


@pytest.mark.parametrize(
    ("dynamics", "on_leaf", "on_ball"),
    [
        (["-", "x"], True, True),
        (["*", "-2", "x"], True, True),
        (["*", "-40", "x"], False, False),  # hi L = 4: nothing is enough
        (["**", "x", 3], True, True),
        (["+", "x", ["*", "0", ["/", "1", ["-", "x", "1/5"]]]], False, False),  # a pole within reach
        (["+", "x", ["*", "0", ["sqrt", ["-", "1/5", "x"]]]], False, False),
        (["+", ["-", "x"], ["*", "0", ["/", "1", ["-", "x", "1/5"]]]], True, False),  # on the leaf it falls, from 0.19
        (["+", ["-", "x"], ["*", "0", ["sqrt", ["-", "1/5", "x"]]]], True, False),
        (["+", ["-", "x"], ["*", "0", ["sqrt", ["-", "1/2", "x"]]]], True, True),
        (["*", "0", "x"], True, True),
    ],
)
def test_the_a_priori_box_fails_closed(dynamics: Any, on_leaf: bool, on_ball: bool) -> None:
    for practical in (False, True):
        data = document("sin", ("0", "1/10"), 2, practical)
        data["plant"]["dynamics"] = [dynamics, ["-", "y"]]
        with ctx.workprec(PRECISION):
            leaves, leaf = leaf_of(data, Box(0, [0.0, 0.0], [0.19, 0.1]))
            with nullcontext() if on_leaf else pytest.raises(Refused, match="rule=flow at=leaf 0"):
                assert leaves.reached(leaf)
            with nullcontext() if on_ball else pytest.raises(Refused, match="rule=flow at=ball"):
                assert steps_of(data, 0.19 * np.eye(2))[1].within


@pytest.mark.parametrize(("domain", "good"), [("201/1000", True), ("1/5", False), ("191/1000", False)])
def test_the_domain_is_not_left_between_the_samples(domain: str, good: bool) -> None:
    """x' = y <= 0.1 from x <= 0.19 over 0.1: up to 0.2, not strictly inside 1/5."""
    for swap in (False, True):
        data = document("sin", ("1/10", "1/10"), 1, True)
        data["plant"]["dynamics"] = [["*", "-1" if swap else "1", ["cos", "0"], "1/10"], "0"]
        data["levels"] = {key: (100.0).hex() for key in data["levels"]}
        data["plant"]["domain"][0] = [f"-{domain}", "3"] if swap else ["-3", domain]
        lo, hi = ([-0.19, 0.0], [-0.1, 0.1]) if swap else ([0.1, 0.0], [0.19, 0.1])
        with ctx.workprec(PRECISION):
            leaves, leaf = leaf_of(data, Box(3, lo, hi))
            if good:
                leaves.reached(leaf)
            else:
                with pytest.raises(Refused, match="rule=flow at=leaf 3"):
                    leaves.reached(leaf)


def test_states_beyond_the_level_do_not_count_for_the_domain() -> None:
    """A leaf that reaches beyond {V <= c2} may reach beyond the domain."""
    data = document("sin", ("1/10", "1/10"), 1, True)
    data["plant"]["dynamics"] = ["1/10", "0"]
    data["plant"]["domain"][0] = ["-3", "1/4"]
    for level, good in ((0.05, True), (0.06, False)):  # x <= (c2 0.75 / (0.75 - 1/16))^(1/2) = 0.2335, 0.2558
        data["levels"] = {"floor": (0.01).hex(), "local": (0.01).hex(), "roa": level.hex()}
        with ctx.workprec(PRECISION):
            leaves, leaf = leaf_of(data, Box(3, [0.0, 0.0], [0.5, 0.5]))
            if good:
                leaves.reached(leaf)
            else:
                with pytest.raises(Refused, match="rule=flow"):
                    leaves.reached(leaf)


class Point:
    """A number of a series that is a single ball."""

    def __init__(self, v: arb) -> None:
        self.v = v

    def __add__(self, other: Point) -> Point:
        return Point(self.v + other.v)

    def __mul__(self, other: Point) -> Point:
        return Point(self.v * other.v)

    def __neg__(self) -> Point:
        return Point(-self.v)

    def scaled(self, k: arb) -> Point:
        return Point(k * self.v)

    def function(self, name: str) -> Point:
        return Point(1 / self.v if name == "1/" else getattr(self.v, name)())


@pytest.mark.parametrize("name", FUNCTIONS)
def test_the_series_of_every_function(name: str) -> None:
    """Against mpmath's derivatives of the solution's own series: the sum of 30 terms is the flow."""
    data = document(name, ("1/10", "1/10"), 1, True)
    c, x, u = read_certificate(dump(data)), [0.21, -0.13], mpmath.mpf("0.17")
    q = {"q": mpmath.mpf("0.8"), "p": mpmath.mpf("0.3")}
    with ctx.workprec(300):
        held = {"u": Point(arb("0.17")), "q": Point(arb("0.8")), "p": Point(arb("0.3"))}
        states = {name: Point(arb(v)) for name, v in zip(c.plant.states, x, strict=True)}
        found = series.coefficients(c.plant.dynamics, states, held, lambda r: Point(arb(r)), 24, lambda v: v)
        true = mean_change(data, x, [u], [(0.0625, q)])
        for i in range(2):
            total = sum((row[i].v * arb(fmpq(1, 16)) ** k for k, row in enumerate(found)), arb(0))
            assert abs(total - arb(mpmath.nstr(true[i], 35))) < 1e-16


def test_a_mean_does_not_say_which_came_first() -> None:
    """x' = q, y' = x: with q = 1 and then -1, or the other way round, its mean is 0 and y moves by +- h^2 / 4."""
    data = document("sin", ("1", "1"), 2, True, [("q", "-1", "1")])
    data["plant"]["dynamics"] = ["q", "x"]
    data["plant"]["domain"] = [["-30", "30"]] * 2
    data["levels"] = {key: (4.0).hex() for key in data["levels"]}
    one, other = {"q": mpmath.mpf(1)}, {"q": mpmath.mpf(-1)}
    with ctx.workprec(PRECISION):
        leaves, leaf = leaf_of(data, Box(0, [-(2.0**-60)] * 2, [2.0**-60] * 2))
        G = leaves.G(leaf, leaves.reached(leaf))
        c, steps = steps_of(data, 0.25 * np.eye(2))
        on_ball = steps.change(c.plant.ranges, "local", "ball").components
        for pieces in (
            [(0.5, one), (0.5, other)],
            [(0.5, other), (0.5, one)],
            [(1.0, one)],
            [(0.75, one), (0.25, other)],
        ):
            value = around(mean_change(data, [0.0, 0.0], [act(data, [0, 0])], pieces)[1])
            mean = arb(means(data, pieces, 1.0)[0]) + arb(0, 1e-12)
            assert value_at(G[1], [arb(0), arb(0), arb(0, 1), mean]).overlaps(value)
            assert holds(on_ball[1], value, [0.0, 0.0], means(data, pieces, 1.0))


def test_the_mean_of_a_product_of_symbols_is_not_that_of_the_means() -> None:
    """x' = q p with q = p = 1 and then -1: both means are 0, and the mean of the product is 1."""
    data = document("sin", ("1/10", "1/10"), 2, True, [("q", "-1", "1"), ("p", "-1", "1")])
    data["plant"]["dynamics"] = [["*", "q", "p"], ["**", "q", 2]]
    same = [(0.05, {"q": mpmath.mpf(s), "p": mpmath.mpf(s)}) for s in (1, -1)]
    apart = [(0.05, {"q": mpmath.mpf(s), "p": mpmath.mpf(-s)}) for s in (1, -1)]
    with ctx.workprec(PRECISION):
        leaves, leaf = leaf_of(data, Box(0, [0.1, 0.1], [0.2, 0.2]))
        on_leaf = leaves.G(leaf, leaves.reached(leaf))
        c, steps = steps_of(data, 0.1 * np.eye(2))
        on_ball = steps.change(c.plant.ranges, "local", "ball").components
        for pieces in (same, apart):
            true = [around(v) for v in mean_change(data, [0.15, 0.15], [act(data, [0.15, 0.15])], pieces)]
            for g, t, value in zip(on_ball, on_leaf, true, strict=True):
                assert value_at(t, [arb(0), arb(0), arb(0, 1), arb(0), arb(0)]).overlaps(value)
                assert holds(g, value, [0.0, 0.0], [0.0, 0.0])
