"""Rule `contraction` in discrete time, attacked in both checkers: no two states may part that are said to come closer.

What is true is known here without models: by the slope in loops of one state, by pairs of states elsewhere.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from fractions import Fraction
from functools import cache
from typing import Any

import numpy as np
import pytest
from flint import arb, ctx

from certify.checker import contraction, rules, words
from certify.checker.case import Case
from certify.checker.decrease import Models
from certify.checker.errors import Rejected
from certify.reference import contraction as other
from certify.reference.__main__ import in_words
from certify.reference.balls import PRECISION
from certify.reference.document import read
from certify.reference.evidence import Tree
from certify.reference.loop import Loop
from certify.reference.refusal import Refused
from tests.support.balls import around, square
from tests.support.certificates import Document, dump, edited, encode, grow, make, parse, rehash, verdict
from tests.support.claim_oracle import Loop as Plant
from tests.support.marks import slow_after
from tests.support.reference import judge
from tests.support.uncertain import corners, drawn, held

NOTHING = ["*", "0", "u"]
INSIDE = 1 - 2.0**-20  # of the ball's radius
JUDGES: list[Callable[[Document], bool]] = []


def judges(rule: Callable[[Document], bool]) -> Callable[[Document], bool]:
    JUDGES.append(rule)
    return rule


@judges
def passes_the_checker(data: Document) -> bool:
    """The rule alone: a loop need not be one whose V falls."""
    with np.errstate(all="ignore"):
        case = Case(parse(data))
        try:
            rules.Tally().hold(
                contraction.OF_CONTRACTION,
                contraction.Contracted.of(case),
            )
        except Rejected as no:
            assert no.rule == "contraction"
            return False
    return True


@judges
def passes_the_reference(data: Document) -> bool:
    with ctx.workprec(PRECISION):
        c = read(dump(data))
        assert isinstance(c.evidence, Tree) and c.evidence.contraction is not None
        try:
            other.contraction(Loop(c), c.evidence.contraction, c.evidence.cells)
        except Refused as no:
            assert no.rule == "contraction"
            return False
    return True


def nearby(
    dynamics: list[Any], P: Any, level: float, weights: Any, *, layers: Any = None, J: Any = None, **more: Any
) -> Document:
    """A claim in discrete time about {V <= level}, of which nothing but the contraction is meant to hold."""
    P = np.atleast_2d(np.asarray(P, dtype=float))
    n = len(P)
    settings = {"squash": "identity", "centre": "none", "scale": [1.0], "domain": [("-9", "9")] * n, **more}
    data = make(
        dynamics, layers or [(np.zeros((1, n)), [0.0])], P, (level, level), states=("x", "y", "z")[:n],
        claim="nearby", time="discrete", input_bounds=[("-99", "99")], **settings,
    )  # fmt: skip
    J = around(P / level) if J is None else J
    ball = {"J": encode(J), "weights": encode(weights), "weight": encode(np.eye(n))}
    return edited(data, "evidence.contraction", ball)


def exactly(value: float) -> str:
    return str(Fraction(value))


# ----------------------------------------------------------------------------------------------------------- one state


def scalar(term: Any, radius: float = 1.0, weight: float = 2.0**-40, **more: Any) -> Document:
    return nearby([["+", term, NOTHING]], [[1.0]], (radius * INSIDE) ** 2, [weight], J=[[radius]], **more)


X = ["+", "1", "x"]
SHAPES: dict[str, tuple[Any, float, Callable[[Any], Any], float]] = {  # phi, radius, phi', and the share that is found
    "line": ("x", 1.0, lambda x: 1 + 0 * x, 0.999),
    "turned": (["-", "x"], 1.0, lambda x: -1 + 0 * x, 0.999),
    "square": (["*", "x", "x"], 1.0, lambda x: 2 * x, 0.999),
    "cube": (["*", "x", "x", "x"], 1.0, lambda x: 3 * x * x, 0.999),
    "quartic": (["*", "x", "x", "x", "x"], 0.5, lambda x: 4 * x**3, 0.3),
    "line and square": (["-", ["*", "x", "x"], "x"], 1.0, lambda x: 2 * x - 1, 0.9),
    "line and cube": (["-", ["*", "x", "x", "x"], "x"], 1.0, lambda x: 3 * x * x - 1, 0.3),
    "all three": (["+", "x", ["*", "x", "x"], ["*", "-1/2", ["**", "x", 3]]], 0.75,
                  lambda x: 1 + 2 * x - 1.5 * x**2, 0.3),
    "sin": (["sin", ["*", "2", "x"]], 1.0, lambda x: 2 * np.cos(2 * x), 0.1),
    "cos": (["cos", ["*", "2", "x"]], 0.75, lambda x: -2 * np.sin(2 * x), 0.1),
    "tanh": (["tanh", ["*", "2", "x"]], 0.5, lambda x: 2 / np.cosh(2 * x) ** 2, 0.1),
    "exp": (["exp", "x"], 1.0, np.exp, 0.3),
    "atan": (["atan", ["*", "2", "x"]], 0.375, lambda x: 2 / (1 + 4 * x * x), 0.1),
    "inverse": (["/", "1", X], 0.75, lambda x: -1 / (1 + x) ** 2, 0.03),
    "root": (["sqrt", X], 0.96875, lambda x: 0.5 / np.sqrt(1 + x), 0.02),
    "corner": (["abs", ["+", "x", "1/2"]], 0.75, lambda x: np.sign(x + 0.5), 0.1),
    "clip": (["clip", ["*", "2", "x"], "-1", "1"], 0.75, lambda x: 2.0 * (np.abs(x) < 0.5), 0.02),
}  # fmt: skip

FIRST = ("line", "cube", "all three", "cos", "exp", "inverse", "corner", "clip")
CORNERS = ("corner", "clip")  # of which one checker may know more than the other


def last(claim: Callable[[float], Document], start: float, end: float, passes: Callable[[Document], bool]) -> float:
    """The largest number accepted between two, within a thousandth; 0 if the first is not."""
    if not passes(claim(start)):
        return 0.0
    good, bad = start, end
    while bad > good * 1.0005:
        middle = math.sqrt(good * bad)
        good, bad = (middle, bad) if passes(claim(middle)) else (good, middle)
    return good


def best(term: Callable[[float], Any], truth: float, radius: float, passes: Callable[[Document], bool]) -> float:
    """With the best of some weights."""
    return max(
        last(lambda t, w=w: scalar(term(t), radius, w), 0.001 * truth, 4 * truth, passes)  # type: ignore[misc]
        for w in (2.0**-40, 0.01, 0.1, 0.5, 1.0)
    )


@pytest.mark.parametrize("passes", JUDGES)
@pytest.mark.parametrize("name", slow_after(len(FIRST) // 2, [*FIRST, *(name for name in SHAPES if name not in FIRST)]))
def test_a_map_is_accepted_until_its_slope_is_1(name: str, passes: Callable[[Document], bool]) -> None:
    """x+ = t phi(x) + 1/64, whatever the signs of its slope."""
    phi, radius, slope, share = SHAPES[name]
    truth = 1 / float(np.max(np.abs(slope(np.linspace(-radius, radius, 20001) * INSIDE))))
    found = best(lambda t: ["+", ["*", exactly(t), phi], "1/64"], truth, radius, passes)
    least = 0.0 if name in CORNERS and passes is passes_the_reference else share
    assert least * truth <= found <= truth * (1 + 2e-4), found / truth


@pytest.mark.parametrize("passes", JUDGES)
def test_orbits_of_period_2_and_second_fixed_points(passes: Callable[[Document], bool]) -> None:
    """V may fall from wherever it is large, and the loop have an orbit, or three points of rest, further inside."""
    orbit = ["+", ["*", "-11/10", "x"], ["*", "1/5", ["**", "x", 3]]]  # x = +- 0.707
    three = ["+", ["*", "11/10", "x"], ["*", "-1/5", ["**", "x", 3]]]
    beside = ["+", ["*", "-1/2", "x"], ["*", "2", "x", "x"]]  # 0 and 3/4
    for term in (orbit, three, beside):
        for radius in (0.75, 1.0):
            assert not any(passes(scalar(term, radius, w)) for w in (2.0**-40, 0.1, 0.5, 1.0, 2.0))
    tame = ["+", ["*", "-9/10", "x"], ["*", "1/10", ["**", "x", 3]]]
    assert passes(scalar(tame, 0.25, 2.0**-40))
    assert passes(scalar(beside, 0.1, 0.01))


@pytest.mark.parametrize("passes", JUDGES)
@pytest.mark.parametrize("cells", [1, 8])
def test_an_uncertain_factor(cells: int, passes: Callable[[Document], bool]) -> None:
    """x+ = q x + r, q to 1 or beyond: the slope counts at both ends, with its own square at each."""

    def claim(lo: str, hi: str) -> Document:
        ranges = [("q", lo, hi), ("r", "-1", "1")]
        term = ["+", ["*", "q", "x"], "r"]
        return scalar(term, uncertain=ranges, cells=[cells, 1])

    assert passes(claim("-999/1000", "999/1000"))
    for ends in (("-1001/1000", "1/2"), ("-1/2", "1001/1000"), ("0", "3"), ("-3", "0")):
        assert not passes(claim(*ends))


# ------------------------------------------------------------------------------------------------------- broken rules


def without_the_square(models: Models, *rest: Any) -> float:
    return 0.0


def at_one_corner(models: Models) -> Iterator[Models]:
    return iter([next(CORNERS_OF(models))])


CORNERS_OF = Models.corners
BROKEN: dict[str, tuple[Any, str, Any, Callable[[], Document]]] = {
    "no square of the rest": (
        contraction, "_size_beyond", without_the_square, lambda: scalar(["*", "3/4", "x", "x"], weight=2.0**-40)
    ),
    "b without A": (
        contraction, "_rest", lambda models, b, *rest: 0 * REST(models, b, *rest),
        lambda: scalar(["+", ["*", "1/2", "x"], ["*", "3/8", "x", "x"]], weight=0.5),
    ),
    "one corner": (
        Models, "corners", at_one_corner,
        lambda: scalar(["*", "q", "x"], uncertain=[("q", "-2", "1/2")], cells=[1]),
    ),
}  # fmt: skip
REST = contraction._rest


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_rule_is_caught(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Slopes of 3/2, 5/4 and -2."""
    owner, rule, broken, claim = BROKEN[name]
    assert not any(passes(claim()) for passes in JUDGES)
    monkeypatch.setattr(owner, rule, broken)
    assert passes_the_checker(claim())


def test_a_broken_reference_is_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where A is -J only the square of the rest counts, and its slope is 3/2."""
    data = scalar(["*", "3/4", "x", "x"])
    assert not passes_the_reference(data)
    monkeypatch.setattr(other, "longest_rest", lambda *rest: arb(0))
    assert passes_the_reference(data)


# ------------------------------------------------------------------------------------------------------ a whole claim


@cache
def honest() -> Document:
    """x+ = q x + w + x^2/8 + 1/40 with |x| at most 3/10 in the end."""
    term = ["+", ["*", "q", "x"], "w", "1/40", ["*", "1/8", "x", "x"], NOTHING]
    ranges = [("q", "-1/2", "1/2"), ("w", "-1/10", "1/10")]
    data = nearby([term], [[1.0]], 0.09, [0.05], J=[[0.31]], uncertain=ranges)
    data = edited(edited(data, "levels.roa", (1.0).hex()), "evidence.root", encode([1.0]))
    return grow(data)


def test_an_honest_claim() -> None:
    data = honest()
    assert verdict(data) == "ACCEPTED" and judge(data) is None
    said = " ".join(words.claim(parse(data)))
    assert "after finitely many steps" in said and "is there at every step from then on" in said
    assert "exactly one equilibrium" in said
    with ctx.workprec(PRECISION):
        assert "in discrete time" in in_words(read(dump(data)))
    faster = grow(edited(data, "claim.rate", (0.02).hex()))
    assert verdict(faster) == "ACCEPTED" and judge(faster) is None


def ball(key: str, value: Any) -> Callable[[Document], Document]:
    return lambda data: edited(data, f"evidence.contraction.{key}", encode(value))


def at(path: str, value: Any) -> Callable[[Document], Document]:
    return lambda data: edited(data, path, value)


FORGERIES: list[tuple[str, str, Callable[[Document], Document]]] = [
    ("contraction", "a ball in the set", ball("J", [[0.3 * (1 - 1e-9)]])),
    ("contraction", "a ball of 0", ball("J", [[0.0]])),
    ("contraction", "a huge ball", ball("J", [[1e200]])),
    ("contraction", "a ball on which states part", ball("J", [[2.1]])),
    ("contraction", "a weight of 0", ball("weights", [0.0])),
    ("contraction", "a weight of -0", ball("weights", [-0.0])),
    ("contraction", "a weight below 0", ball("weights", [-0.05])),
    ("contraction", "a weight that is too large", ball("weights", [1.0])),
    ("contraction", "a clip that acts", lambda d: rehash(edited(d, "policy.clip", [encode([-1.0]), encode([0.0])]))),
    ("format", "no contraction", at("evidence.contraction", None)),
    ("format", "two weights", ball("weights", [1.0, 1.0])),
    ("format", "a matrix of two rows", ball("weight", np.eye(2))),
    ("format", "a sample", at("claim.sample", ["1", "1"])),
    ("format", "practical with a contraction", at("claim.kind", "practical")),
    ("format", "an outer set", at("claim.outer", {"expression": ["**", "x", 2], "level": (2.0).hex()})),
    ("format", "a tube", at("claim.kind", "enlarged")),
    ("format", "a solver's word", at("evidence", {"kind": "trusted-solver", "solver": "dReal", "version": "4",
                                                  "precision": (0.5).hex(), "queries": []})),
    ("ring", "continuous time", at("plant.time", "continuous")),
    ("ring", "a floor that is left", lambda d: edited(edited(d, "levels.floor", (0.04).hex()), "levels.local",
                                                      (0.04).hex())),
    ("levels", "no floor", at("levels.floor", (0.0).hex())),
]  # fmt: skip


@pytest.mark.parametrize(("rule", "edit"), [pytest.param(rule, edit, id=what) for rule, what, edit in FORGERIES])
def test_forgeries(rule: str, edit: Callable[[Document], Document]) -> None:
    data = edit(honest())
    assert (verdict(data), judge(data)) == (rule, rule)


# --------------------------------------------------------------------------------------------- some states, at random


def random_map(seed: int) -> Document:
    """A map of one to three states about its contraction's limit."""
    random = np.random.default_rng(seed)
    n = int(random.integers(1, 4))
    turn, _ = np.linalg.qr(random.standard_normal((n, n)))
    A = turn @ np.diag(random.uniform(-1.0, 1.0, n)) @ np.linalg.qr(random.standard_normal((n, n)))[0]
    C = np.eye(n) + 0.4 * random.standard_normal((n, n))
    P, A = C.T @ C, np.linalg.solve(C, A @ C)
    names = ("x", "y", "z")[:n]
    rows: list[Any] = []
    for i in range(n):
        row: list[Any] = ["+", *(["*", exactly(round(a * 256) / 256), s] for a, s in zip(A[i], names, strict=True))]
        one, two = random.choice(names, 2)
        strength = str(Fraction(int(random.integers(-16, 17)), 64))
        row.append(["*", strength, [
            ["*", one, two], ["sin", ["+", one, two]], ["**", one, 3], ["*", "q", one], ["exp", two],
            ["abs", ["+", one, "1/4"]], ["tanh", ["*", "2", two]], ["/", two, ["+", "2", one]],
        ][int(random.integers(8))]])  # fmt: skip
        row.append(["*", "1/8", "u"] if i == 0 else "r")
        rows.append(row)
    layers = [
        (random.standard_normal((2, n)), 0.3 * random.standard_normal(2)),
        (random.standard_normal((1, 2)), [0.1]),
    ]
    ranges = [("q", "-1/2", "1/2"), ("r", "-1/8", "1/8")]
    cells = [int(random.integers(1, 3)), 1]
    return nearby(rows, P, 1.0, np.ones(n), layers=layers, uncertain=ranges, cells=cells)


def on_ball(data: Document, P: np.ndarray, level: float, share: float) -> Document:
    J = around(P / level)
    ball = {"J": encode(J), "weights": encode(share * level * np.ones(len(P))), "weight": encode(np.eye(len(P)))}
    data = edited(data, "levels", {name: level.hex() for name in ("floor", "local", "roa")})
    return edited(data, "evidence.contraction", ball)


def pairs_of(n: int, random: np.random.Generator) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Pairs (n, 2000) in the unit ball: anywhere, opposite, and close to each other at the edge."""
    points = random.standard_normal((n, 2000))
    points /= np.linalg.norm(points, axis=0)
    yield points, -points
    yield points, np.roll(points, 1, axis=1)
    yield points * random.random(2000) ** (1 / n), np.roll(points, 7, axis=1) * random.random(2000)
    beside = points * (1 - 1e-4) + 1e-4 * random.standard_normal((n, 2000))
    yield points, beside / np.maximum(1, np.linalg.norm(beside, axis=0))


@pytest.mark.parametrize("seed", slow_after(4, range(80)))
def test_no_pair_parts_on_a_random_map(seed: int) -> None:
    data = random_map(seed)
    P = square(data["lyapunov"]["P"])
    n, random, accepted = len(P), np.random.default_rng(seed), [0.0, 0.0]
    for k, passes in enumerate(JUDGES):
        for level in 2.0 ** np.arange(-12, 4):
            if not any(passes(on_ball(data, P, float(level), share)) for share in (1e-3, 0.02, 0.1, 0.4)):
                break
            accepted[k] = float(level)
    level = max(accepted)
    if level == 0:
        return
    J = around(P / level)
    for q in [*corners(data), *(drawn(data, random) for _ in range(3))]:
        plant = Plant(held(data, q))
        for d, e in pairs_of(n, random):
            x, y = J @ d, J @ e
            gap, moved = x - y, plant.field(x, plant.inputs(x)) - plant.field(y, plant.inputs(y))
            before, after = (np.einsum("ib,ij,jb->b", v, P, v) for v in (gap, moved))
            some = before > 1e-14
            assert np.all(after[some] < before[some] * (1 + 1e-9)), (
                accepted,
                float(np.max(after[some] / before[some])),
            )


def test_some_random_maps_are_accepted() -> None:
    found = 0
    for seed in range(12):
        data = random_map(seed)
        P = np.frombuffer(__import__("base64").b64decode(data["lyapunov"]["P"])).reshape(
            len(data["plant"]["states"]), -1
        )
        found += any(passes_the_checker(on_ball(data, P, 2.0**-8, share)) for share in (1e-3, 0.02, 0.1))
    assert found >= 3
