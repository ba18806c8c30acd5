"""Attacks on rule `local`: the ball of the file around {V <= c1}, and the multipliers on it.

`cubic` is x' = -x + x^3, which attracts |x| < 1 and whose rule ends exactly there; `rotor` is a pendulum under a random
network with input bounds that only models can show.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from fractions import Fraction
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from certify.reference import local, rules
from certify.reference.decrease import decreases
from tests.checker.test_rules import honest as of_version_3
from tests.support.balls import centred, with_ball
from tests.support.certificates import Document, decode, dump, edited, encode, make
from tests.support.reference import judge

Edit = Callable[[Document], Document]
LEAST = 5e-324


def cubic(c1: float = 0.81, J: float = 0.9375, rows: Any = ((0.0,), (LEAST,), (0.0,))) -> Document:
    """P = 1; the square of x has a Q, its cube E = |J|^3: 2 J^2 - 2 J J^3 > 0 for |J| < 1."""
    dynamics = ["+", ["-", "x"], ["**", "x", 3]]
    data = make([dynamics], [([[0.0]], [0.0])], 1.0, (c1, c1), domain=[("-1", "1")])
    return edited(with_ball(data), "evidence.local", centred([[J]], rows))


@cache
def rotor() -> Document:
    """With c2 at c1: the local ball is all."""
    data = of_version_3("rotor")
    return with_ball(edited(data, "levels.roa", data["levels"]["local"]))


def J(change: Callable[[np.ndarray], Any]) -> Edit:
    return lambda data: edited(data, "evidence.local.J", lambda text: encode(change(decode(text))))


def rows(change: Callable[[np.ndarray], Any]) -> Edit:
    return lambda data: edited(
        data, "evidence.local.multipliers", lambda text: encode(change(decode(text).reshape(3, -1)))
    )


def row(index: Any, value: float) -> Callable[[np.ndarray], np.ndarray]:
    def change(values: np.ndarray) -> np.ndarray:
        result = values.copy()
        result[index] = value
        return result

    return change


def weight(change: Callable[[np.ndarray], Any]) -> Edit:
    return lambda data: edited(data, "evidence.local.weight", lambda text: encode(change(decode(text))))


def level(value: float) -> Edit:
    """Of both levels, with a root box that is large enough."""
    levels = {"local": value.hex(), "roa": value.hex()}
    return lambda data: edited(edited(data, "levels", levels), "evidence.root", encode([1.0]))


def test_honest_balls_are_accepted() -> None:
    assert judge(cubic()) is None and judge(rotor()) is None
    assert judge(J(lambda v: -v)(cubic())) is None
    assert judge(J(lambda v: v.reshape(2, 2)[:, ::-1])(rotor())) is None  # the same ball


FORGERIES: list[tuple[str, Document, Edit]] = [
    ("J that touches {V <= c1}", cubic(0.765625), J(lambda _: [0.875])),
    ("c1 that touches the ball", cubic(), level(0.9375**2)),
    ("c1 beyond the ball", cubic(), level(0.9)),
    ("a larger ball than the rule allows", cubic(), J(lambda _: [1.0])),
    ("J of 0", cubic(), J(lambda _: [0.0])),
    ("the least J", cubic(), J(lambda _: [LEAST])),
    ("J too small", rotor(), J(lambda v: 0.99 * v)),
    ("J of rank one", rotor(), J(lambda v: v[[0, 0, 2, 2]])),
    ("J of zeros", rotor(), J(lambda v: 0 * v)),
    ("J without a row", rotor(), J(lambda v: v * [1, 1, 0, 0])),
    ("the rows of J swapped", rotor(), J(lambda v: v[[2, 3, 0, 1]] / 8)),
    ("a huge J", cubic(), J(lambda _: [1e300])),
    ("a negative alpha", cubic(), rows(row(0, -LEAST))),
    ("a negative beta", cubic(), rows(row(1, -1.0))),
    ("a negative g", cubic(), rows(row(2, -LEAST))),
    ("no multiplier at all", cubic(), rows(row(1, 0.0))),
    ("a negative g of two", rotor(), rows(row((2, 0), -1.0))),
    ("multipliers of another order", rotor(), rows(lambda v: v[[1, 2, 0]])),
    ("huge multipliers", rotor(), rows(lambda v: v + 1e300)),
    ("tiny multipliers", rotor(), rows(lambda v: 0 * v + LEAST)),
]


@pytest.mark.parametrize(("data", "edit"), [pytest.param(data, edit, id=what) for what, data, edit in FORGERIES])
def test_forgeries(data: Document, edit: Edit) -> None:
    assert judge(data) is None
    verdict = rules.judge(dump(edit(data)))
    assert (verdict.result, verdict.rule, verdict.at) == ("REJECTED", "local", "ball")


@given(
    st.floats(0.01, 4.0),
    st.floats(-2.0, 2.0),
    st.tuples(*[st.sampled_from([-1.0, 0.0, LEAST, 1e-9]) | st.floats(0, 4)] * 3),
    st.sampled_from([0.0, -0.0, -1.0, LEAST, 1.0]) | st.floats(allow_nan=False, allow_infinity=False),
)
@example(0.99, 0.999, (0.0, LEAST, 0.0), 1.0)
@example(1.0, 1.0001, (0.0, LEAST, 0.0), 1.0)
@example(0.99, 0.999, (0.999, LEAST, 0.0), -1.0)
@example(0.25, 0.75, (0.0, LEAST, 0.0), 0.0)
def test_no_ball_helps_a_claim_beyond_the_region_of_attraction(
    c1: float, reach: float, multipliers: tuple[float, float, float], of_weight: float
) -> None:
    """x' = -x + x^3 attracts |x| < 1."""
    data = edited(cubic(c1, reach, [[v] for v in multipliers]), "plant.domain.0", ["-9", "9"])
    data = weight(lambda _: [of_weight])(data)
    if judge(data) is None:
        assert c1 < reach**2 < 1 and min(multipliers) >= 0 and max(multipliers[1:]) > 0


def test_the_edge_of_the_ball_by_hand() -> None:
    """c1 < J^2 in rationals, to the last bit, and J < 1."""
    answers = set()
    for reach in (0.5, 0.9, 0.9375, math.nextafter(1, 0)):
        for c1 in (math.nextafter(reach**2, 0), reach**2, math.nextafter(reach**2, 1)):
            inside = Fraction(c1) < Fraction(reach) ** 2
            assert judge(cubic(c1, reach)) == (None if inside else "local")
            answers.add(inside)
    assert answers == {True, False} and judge(cubic(0.81, 1.0)) == "local"


@pytest.mark.parametrize("factor", [LEAST, 1e-300, 1e-9, 3.0, 1e300, -1.0])
def test_a_weight_counts_in_proportion(factor: float) -> None:
    assert judge(weight(lambda v: 0 * v + factor)(cubic())) is None
    whole = rotor()["evidence"]["local"]["weight"]
    assert decode(whole).tolist() == np.eye(2).ravel().tolist()
    assert judge(weight(lambda v: factor * v)(rotor())) is None


def test_a_weight_may_be_anything() -> None:
    """Nothing is asked of it: not symmetric, not definite; what is accepted with it is true anyway."""
    generator, found = np.random.default_rng(5), set()
    for _ in range(20):
        found.add(
            judge(weight(lambda v: np.exp(9 * generator.standard_normal(4)) * generator.choice([-1, 1], 4))(rotor()))
        )
    assert found <= {None, "local"}


def test_a_division_anywhere_on_the_ball() -> None:
    """Though the pole lies outside of {V <= c1}."""
    pole = ["*", "0", ["/", "1", ["-", "x", "15/16"]]]
    for dynamics, found in ((pole, "local"), (["*", "0", ["/", "1", ["-", "x", "16/15"]]], None)):
        data = edited(cubic(), "plant.dynamics.0", lambda f, dynamics=dynamics: [*f, dynamics])
        assert judge(data) == found


CLAUSES: dict[str, tuple[str, Callable[..., Any], Document, Edit]] = {
    "the ball contains {V <= c1}": ("contains", lambda *_: True, cubic(), level(0.9)),
    "the multipliers": ("sound_multipliers", lambda *_: None, cubic(), rows(row(2, -1.0))),
    "what decreases": ("decreases", lambda *_: True, cubic(), J(lambda _: [1.5])),
}


@pytest.mark.parametrize("clause", CLAUSES)
def test_with_a_clause_disabled_a_forgery_gets_through(clause: str, monkeypatch: pytest.MonkeyPatch) -> None:
    name, instead, data, edit = CLAUSES[clause]
    assert judge(edit(data)) == "local"
    monkeypatch.setattr(local, name, instead)
    assert judge(edit(data)) is None


def test_P_does_not_change_with_time_in_a_local_ball(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []

    def looking(*arguments: Any) -> bool:
        seen.append(arguments[2])
        return decreases(*arguments)

    monkeypatch.setattr(local, "decreases", looking)
    assert judge(rotor()) is None and len(seen) == 1 and not any(seen[0].entries())
