"""The reference on claim `nearby`: one equilibrium in {V <= c0}, to which everything goes that enters it.

What must not happen is that two points of {V <= c0} are said to approach each other and do not: the derivative of F is
known, here in closed form and there from differences.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from flint import arb, arb_mat, ctx

from certify.reference.__main__ import as_json, in_words
from certify.reference.balls import PRECISION
from certify.reference.contraction import contracts
from certify.reference.decrease import whatever_y
from certify.reference.document import read
from certify.reference.evidence import Tree
from certify.reference.local import cells
from certify.reference.loop import Loop
from certify.reference.model import Model
from certify.reference.rational import identity
from certify.reference.refusal import Refused
from certify.reference.rules import judge as whole_verdict
from certify.reference.table import FUNCTIONS as ROWS
from tests.reference.test_flow import FUNCTIONS, document
from tests.reference.test_practical import scalar
from tests.support.balls import around, exactly, square
from tests.support.certificates import Document, dump, edited, encode, make, rehash
from tests.support.claim_oracle import Loop as Plant
from tests.support.marks import slow_after
from tests.support.models import curved, linear
from tests.support.oracle import value_of
from tests.support.reference import judge
from tests.support.uncertain import corners, drawn, held, random_plant

Edit = Callable[[Document], Document]
NARROW = Fraction(1, 2**60)  # a range for a quantity that is as good as known
TRUSTED = {"kind": "trusted-solver", "solver": "dReal", "version": "4", "precision": (0.5).hex(), "queries": []}


def nearby(data: Document, J: Any, weights: Any) -> Document:
    """A practical document with a ball on which it contracts."""
    data = edited(data, "claim.kind", "nearby")
    return edited(
        data, "evidence.contraction", {"J": encode(J), "weights": encode(weights), "weight": encode(np.eye(len(J)))}
    )


def bent(term: Any, *, J: float = 1.0, weight: float = 1.0, floor: float = 0.99, outer: float = 1.0) -> Document:
    """x' = term, whose input does nothing, V = x^2."""
    data = scalar(term, (floor, outer), depth=10, domain=[("-3/2", "3/2")])
    return nearby(data, [[J]], [weight])


def honest() -> Document:
    """x' = -x - u / 2 + w + 1 / 20, u = -tanh(x) / 2."""
    term = ["+", ["-", "x"], ["*", "-1/2", "u"], "w", "1/20"]
    return nearby(scalar(term, (0.09, 1.0), uncertain=[("w", "-1/10", "1/10")]), [[0.31]], [0.01])


def at(path: str, value: Any) -> Edit:
    return lambda data: edited(data, path, value)


# ------------------------------------------------------------------------------------------------------------ the claim


def test_an_honest_claim() -> None:
    verdict = whole_verdict(dump(honest()))
    c = verdict.certificate
    assert verdict.result == "ACCEPTED" and c is not None and not c.ends_at_origin
    said = in_words(c)
    assert f"where w stays as it is there is exactly one equilibrium in V <= {0.09!r}" in said
    assert "enters" in said and "origin" not in said
    answer = as_json(verdict, 1.0)
    assert (answer["claim"], answer["rate"], answer["sample"], answer["discrete"]) == ("nearby", 0.0, None, False)
    assert set(answer["levels"]) == {"floor", "local", "roa"}
    assert judge(at("claim.rate", (0.05).hex())(honest())) is None


FORGERIES: list[tuple[str, str, Edit]] = [
    ("contraction", "a ball that is too small", at("evidence.contraction.J", encode([[0.299]]))),
    ("contraction", "a ball that touches", lambda d: edited(
        edited(d, "levels", {"floor": (0.0625).hex(), "local": (0.0625).hex(), "roa": (1.0).hex()}),
        "evidence.contraction.J", encode([[0.25]]))),
    ("contraction", "a ball of 0", at("evidence.contraction.J", encode([[0.0]]))),
    ("contraction", "a huge ball", at("evidence.contraction.J", encode([[1e200]]))),
    ("contraction", "a weight of 0", at("evidence.contraction.weights", encode([0.0]))),
    ("contraction", "a weight of -0", at("evidence.contraction.weights", encode([-0.0]))),
    ("contraction", "a weight below 0", at("evidence.contraction.weights", encode([-1.0]))),
    ("contraction", "a weight that is too large", at("evidence.contraction.weights", encode([9.0]))),
    ("contraction", "a clip that acts", lambda d: rehash(edited(d, "policy.clip", [encode([-0.05]), encode([0.05])]))),
    ("format", "no contraction", at("evidence.contraction", None)),
    ("format", "two weights", at("evidence.contraction.weights", encode([1.0, 1.0]))),
    ("format", "no weights", at("evidence.contraction", {"J": encode([[0.31]]), "weight": encode([1.0])})),
    ("format", "no weight", at("evidence.contraction", {"J": encode([[0.31]]), "weights": encode([1.0])})),
    ("format", "a weight of two rows", at("evidence.contraction.weight", encode(np.eye(2)))),
    ("format", "an edge", lambda d: edited(d, "evidence.contraction", lambda old: {**old, "edge": (0.0).hex()})),
    ("format", "practical with a contraction", at("claim.kind", "practical")),
    ("format", "asymptotic", at("claim.kind", "asymptotic")),
    ("format", "a sample", at("claim.sample", ["1/100", "1/100"])),
    ("ring", "discrete time, in which it leaps over", at("plant.time", "discrete")),
    ("format", "a solver's word", at("evidence", TRUSTED)),
    ("format", "a solver's word of what is certain", lambda d: edited(
        edited(edited(d, "plant.uncertain", []), "plant.dynamics.0", ["-", "x"]), "evidence", TRUSTED)),
    ("levels", "no floor", at("levels.floor", (0.0).hex())),
    ("levels", "a floor below c1, without a ball", at("levels.floor", (0.01).hex())),
]  # fmt: skip


@pytest.mark.parametrize(("rule", "edit"), [pytest.param(rule, edit, id=what) for rule, what, edit in FORGERIES])
def test_forgeries(rule: str, edit: Edit) -> None:
    assert judge(honest()) is None
    assert judge(edit(honest())) == rule


def test_inputs_are_asked_where_they_are_claimed() -> None:
    """The ball may be larger than {V <= c2}: there the inputs may leave their bounds."""
    term = ["+", ["-", "x"], ["*", "-1/20", "u"], "1/20"]
    data = scalar(term, (0.09, 0.1), depth=6, input_bounds=[("-1/5", "1/5")])
    assert judge(nearby(data, [[0.31]], [0.01])) is None
    assert judge(nearby(data, [[0.6]], [0.01])) is None
    assert judge(edited(data, "plant.input_bounds.0", ["-1/10", "1/10"])) == "inputs"


# -------------------------------------------------------------------------------------------------- what is false, just


@pytest.mark.parametrize(("a", "rule"), [("3/2", "contraction"), ("199/100", "contraction"), ("201/100", None)])
def test_the_limit_of_a_square(a: str, rule: str | None) -> None:
    """x' = -a x + x^2 contracts where 2 x < a, and the rule knows it all: |x| <= 1 on the ball."""
    assert judge(bent(["+", ["*", a, ["-", "x"]], ["**", "x", 2], "1/64"], weight=4.0)) == rule


@pytest.mark.parametrize(("a", "rule"), [("2", "contraction"), ("299/100", "contraction"), ("301/100", None)])
def test_the_limit_of_a_cube(a: str, rule: str | None) -> None:
    """x' = -a x + x^3 contracts where 3 x^2 < a."""
    assert judge(bent(["+", ["*", a, ["-", "x"]], ["**", "x", 3], "1/64"], weight=1e-3)) == rule


POLES = {
    "1/v": ["-", ["+", "1/2", ["*", "-19/20", "x"]], ["/", "1", ["+", "2", "x"]]],
    "1/v, far": ["+", ["*", "-30", "x"], ["*", "-1/8", ["/", "1", ["+", "51/50", "x"]]], "1"],
    "sqrt": ["+", ["*", "-3", "x"], ["sqrt", ["+", "101/100", "x"]], "-1"],
    "sqrt, less": ["+", ["*", "-2", "x"], ["sqrt", ["+", "101/100", "x"]], "-1"],
}


@pytest.mark.parametrize("weight", slow_after(1, [0.1, 0.5, 0.01, 0.3, 1.0, 3.0]))
@pytest.mark.parametrize("name", POLES)
def test_trajectories_that_part_at_the_edge(name: str, weight: float) -> None:
    """The slope of F is positive at the left end of {V <= c0}. Near a pole the remainder's own factor is too small."""
    data = bent(POLES[name], weight=weight)
    left, step = -math.sqrt(0.99), 1e-7
    F = Plant(data).field(np.array([[left, left + step]]), np.zeros((1, 2)))[0]
    assert (F[1] - F[0]) / step > 0
    assert judge(data) == "contraction"
    assert judge(edited(edited(data, "claim.kind", "practical"), "evidence.contraction", None)) is None


@pytest.mark.parametrize("name", ["1/", "sqrt", "tanh", "exp", "atan", "sin", "cos"])
def test_the_largest_fourth_derivative(name: str) -> None:
    """What the slope of the cubic leaves, |phi' - p - q D - r D^2/2|, is within m |D|^3 / 6, up to the edge."""
    generator = np.random.default_rng(4)
    row = ROWS[name]
    with ctx.workprec(PRECISION):
        for _ in range(40):
            c, share = generator.uniform(0.2, 3.0), generator.uniform(0.01, 0.999)
            centre, reach = arb(c), arb(c * share)
            at_c = row.derivatives(centre)
            most, other = row.last(centre, at_c, reach), row.fourth(centre, at_c, reach)
            assert most is not None and other is not None and not most < other
            for part in (-0.999999, -0.5, 1e-3, 0.7, 0.999999):
                D = reach * part
                slope = row.derivatives(centre + D)[1]
                left = abs(slope - at_c[1] - at_c[2] * D - at_c[3] * D * D / 2)
                assert not left > most / 6 * abs(D) ** 3
        assert ROWS["1/"].last(arb(1), (arb(1),) * 4, arb(1)) is None
        assert ROWS["sqrt"].last(arb(1), (arb(1),) * 4, arb(2)) is None


# --------------------------------------------------------------------------------------------------------- the constant


@pytest.mark.parametrize("name", FUNCTIONS)
@pytest.mark.parametrize("size", slow_after(1, [0.05, 0.2]))
def test_the_constant_of_what_is_beyond_the_third_order(name: str, size: float) -> None:
    """Differences at pairs of points, near each other and apart, in the middle and at the edge of the ball."""
    data = document(name, None, 1, True, [("q", "1", f"{1 + NARROW}"), ("p", "1/4", f"{NARROW + Fraction(1, 4)}")])
    J, generator = size * np.array([[0.9, 0.1], [-0.3, 0.8]]), np.random.default_rng(6)
    with ctx.workprec(PRECISION):
        c = read(dump(data))
        loop = Loop(c)
        F = loop.within(loop.steady(exactly(J), "contraction", "ball"), c.plant.ranges, "contraction", "ball")
        points = generator.standard_normal((30, 2))
        points *= (np.where(np.arange(30) % 3 == 0, 0.999999, generator.random(30)) / np.linalg.norm(points, axis=1))[
            :, None
        ]
        others = np.where(np.arange(30)[:, None] % 2 == 0, points * 0.999, -points[::-1])
        for f, node in zip(F.where([-1, -1]).components, data["plant"]["dynamics"], strict=True):
            assert f.lip is not None
            most = 0.0
            for d, e in zip(points.tolist(), others.tolist(), strict=True):
                there, here = (rest_of(data, f, node, J, point) for point in (d, e))
                apart = sum(((arb(v) - arb(w)) ** 2 for v, w in zip(d, e, strict=True)), arb(0)).sqrt()
                assert not abs(there - here) > f.lip * apart, (d, e)
                most = max(most, float(abs(there - here) / apart))
            assert float(f.lip) < 200 * most + 1e-9, name  # of the right size


def rest_of(data: Document, f: Model, node: Any, J: np.ndarray, d: list[float]) -> arb:
    """What F has beyond the third order at a point."""
    e = [arb(v) for v in d]
    x = [sum((arb(p) * v for p, v in zip(row, e, strict=True)), arb(0)) for row in J.tolist()]
    (u,) = policy(data, x)
    names = {"x": x[0], "y": x[1], "u": u, "q": arb(1), "p": arb(1) / 4}
    return value_of(node, names) - linear(f, d) - curved(f, d)


def policy(data: Document, x: list[arb]) -> list[arb]:
    """Its input; the loop of the oracle has no q."""
    return Plant(held(data, {"q": Fraction(1), "p": Fraction(1, 4)})).closed_loop([x])[0][0]


POLYNOMIALS = {  # of d: v(0), a, Q, K
    "d^2": (0, 0, 0.1, 0),
    "d^3": (0, 0, 0, 0.1),
    "d + d^2": (0.5, 0.1, 0.1, 0),
    "d + d^3": (0.5, 0.1, 0, 0.1),
    "1 + d": (1, 0.25, 0, 0),
    "1 + d^2": (1, 0, 0.125, 0),
    "all": (1, 0.1, -0.05, 0.025),
}
OPERATIONS: dict[str, tuple[Callable[[Model], Model], Callable[[arb], arb]]] = {
    "square": (lambda m: m * m, lambda v: v * v),
    "cube": (lambda m: m * m * m, lambda v: v * v * v),
    "negative": (lambda m: -(m + m), lambda v: -2 * v),
    "scaled": (lambda m: (m * m).scaled(arb(-3)), lambda v: -3 * v * v),
    "exp": (lambda m: m.function("exp"), lambda v: v.exp()),
    "sin": (lambda m: m.function("sin"), lambda v: v.sin()),
    "cos": (lambda m: m.function("cos"), lambda v: v.cos()),
    "tanh": (lambda m: m.function("tanh"), lambda v: v.tanh()),
    "atan": (lambda m: m.function("atan"), lambda v: v.atan()),
    "1/(2 + v)": (lambda m: m.shifted(arb(2)).function("1/"), lambda v: 1 / (2 + v)),
    "sqrt(2 + v)": (lambda m: m.shifted(arb(2)).function("sqrt"), lambda v: (2 + v).sqrt()),
    "sin of exp": (lambda m: m.function("exp").function("sin"), lambda v: v.exp().sin()),
}
SHARP = {("d^2", "square"), ("d^3", "square"), ("d^2", "exp"), ("d^2", "cos"), ("d^2", "sin"), ("d^3", "sin")}


@pytest.mark.parametrize("operation", OPERATIONS)
@pytest.mark.parametrize("name", POLYNOMIALS)
def test_the_constant_of_each_operation(name: str, operation: str) -> None:
    """In one variable what is beyond the third order is steepest at an end, near the constant."""
    with ctx.workprec(600):
        at_0, a, Q, K = (arb(v) for v in POLYNOMIALS[name])
        one, nothing = arb_mat([[1]]), arb_mat(1, 1)
        model = Model(at_0, a * one, Q * one, K * one, nothing, lip=arb(0))
        apply, true = OPERATIONS[operation]
        result, most = apply(model), arb(0)
        assert result.lip is not None

        def rest(d: arb) -> arb:
            v = true(at_0 + a * d + Q * d * d + K * d * d * d)
            return v - linear(result, [d]) - curved(result, [d])

        for end in (-1, -0.5, 0.5, 1):
            near = arb(end) * (1 - arb(2) ** -60)
            slope = abs((rest(arb(end)) - rest(near)) / (arb(end) - near))
            assert not slope > result.lip * (1 + arb(2) ** -40)
            most = most.max(slope)
        if (name, operation) in SHARP:
            assert most > result.lip / 2


@pytest.mark.parametrize("centre", ["none", "preactivation", "output"])
@pytest.mark.parametrize("squash", ["tanh", "identity"])
@pytest.mark.parametrize("hidden", [False, True])
def test_the_constant_of_an_input(hidden: bool, squash: str, centre: str) -> None:
    if (squash, centre) == ("identity", "preactivation"):
        return
    layers: list[tuple[Any, Any]] = [([[2.0]], [0.7])]
    if hidden:
        layers = [([[2.0], [-1.0]], [0.7, 0.2]), ([[1.0, 0.5]], [0.3])]
    data = make(
        [["-", "x"]], layers, 1.0, (0.01, 0.01), squash=squash, centre=centre, scale=[0.75], u_eq=["1/4"],
        offset=[0.125], claim="practical",
    )  # fmt: skip
    steep = arb(0)
    with ctx.workprec(300):
        loop, plant = Loop(read(dump(data))), Plant(data)
        u = loop.steady(exactly(np.array([[0.2]])), "contraction", "ball").names["u"]
        assert u.lip is not None
        for end in (-1.0, -0.5, 0.5, 1.0):
            rest = []
            for d in (arb(end), arb(end) * (1 - arb(2) ** -30)):
                ((value,), _) = plant.closed_loop([[d * arb(0.2)]])[0]
                rest.append(value - linear(u, [d]) - curved(u, [d]))
            steep = steep.max(abs((rest[0] - rest[1]) / (arb(end) * arb(2) ** -30)))
        assert not steep > u.lip
        assert u.lip == 0 or steep > u.lip / 40
        assert hidden or squash == "tanh" or u.lip == 0


# ----------------------------------------------------------------------------------------------------- plants at random


@pytest.mark.parametrize("seed", slow_after(4, range(24)))
def test_what_contracts_on_a_random_plant_does(seed: int) -> None:
    """The largest ball that is accepted; on it P DF is negative definite at every q tried."""
    data, generator = random_plant(seed, True), np.random.default_rng(seed)
    P, n, accepted = square(data["lyapunov"]["P"]), len(data["plant"]["states"]), 0.0
    with ctx.workprec(PRECISION):
        c = read(dump(data))
        assert isinstance(c.evidence, Tree)
        loop = Loop(c)
        for level in 4.0 ** np.arange(-6, 3):
            J = around(P / level)
            if not any(holds(loop, J, share * level * np.ones(n), c.evidence.cells) for share in (0.02, 0.1, 0.5)):
                break
            accepted = float(level)
    if accepted == 0:
        return
    d = generator.standard_normal((n, 400))
    x = around(P / accepted) @ (d / np.linalg.norm(d, axis=0) * np.maximum(generator.random(400), 0.3))
    for q in [*corners(data), *(drawn(data, generator) for _ in range(4))]:
        plant = Plant(held(data, q))
        step, columns = 1e-6, []
        for k in range(n):
            ahead, behind = (x + s * step * np.eye(n)[:, k : k + 1] for s in (1, -1))
            columns.append(
                (plant.field(ahead, plant.inputs(ahead)) - plant.field(behind, plant.inputs(behind))) / 2 / step
            )
        slope = np.einsum("ij,kjb->bik", P, np.stack(columns))
        assert np.linalg.eigvalsh(slope + slope.transpose(0, 2, 1)).max() < 1e-8


def holds(loop: Loop, J: np.ndarray, g: np.ndarray, parts: tuple[int, ...]) -> bool:
    c, weights = loop.c, [arb(float(v)) for v in g]
    try:
        known = loop.steady(exactly(J), "contraction", "ball")
        each = [loop.within(known, cell, "contraction", "ball") for cell in cells(c.plant.ranges, parts)]
    except Refused:
        return False
    return all(whatever_y(F, lambda G: contracts(c, exactly(J), weights, arb_mat(identity(c.n)), G)) for F in each)
