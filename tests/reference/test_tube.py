"""Attacks on claim `enlarged`: honest tubes are accepted, and each forgery is refused by the rule that it breaks.

`decay` is x' = -x with every number of its tube worked out by hand; `bent` has a sine and a network in one state;
`oscillator` is linear in two, and its nodes are no level sets of V: they follow the flow backwards; `swing` is a
pendulum that stands up under a network, and `ring` has a tree between its local ball and c2.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.linalg import expm

from certify.reference import __main__ as command
from certify.reference import decrease, rules, tube
from tests.support.balls import around, ball, enlarge, slab_of, square, with_ball
from tests.support.certificates import Document, decode, dump, edited, encode, grow, make, write
from tests.support.models import inputs_on
from tests.support.reference import CONTINUOUS, judge, judge_bytes

Edit = Callable[[Document], Document]
NONE = 2.0**-60  # a beta of a component that has no Q


def still(dynamics: list[Any], P: Any, levels: tuple[float, float], **more: Any) -> Document:
    """Without an input: the policy is 0."""
    n = len(dynamics)
    options: dict[str, Any] = {"states": "xyz"[:n], "domain": [("-3", "3")] * n, **more}
    return make(dynamics, [(np.zeros((1, n)), [0.0])], P, levels, **options)


def slab(before: Any, end: Any, duration: float, J: Any, rows: Any) -> Document:
    """P(t) linear in t: the middle is the mean of the ends."""
    start, end = np.atleast_2d(before), np.atleast_2d(end)
    return slab_of((start + end) / 2, end, duration) | ball(np.atleast_2d(J), rows)


def decay() -> Document:
    """From |x| <= 2 into |x| <= 1 by |x| <= 4/3: (P_k - P_(k-1)) / h < 2 P_(k-1), with P_k = 1/4, 9/16, 17/16."""
    data = edited(
        with_ball(still([["-", "x"]], 1.0, (1.0, 1.0))),
        "claim",
        {"kind": "enlarged", **CONTINUOUS, "start": encode([0.25])},
    )
    rows = [[0.0], [NONE], [0.0]]
    data["evidence"]["tube"] = [slab(0.25, 0.5625, 0.75, 2.125, rows), slab(0.5625, 1.0625, 0.5, 1.375, rows)]
    return data


def levels_of(P: np.ndarray, outer: float, inner: float, count: int) -> list[np.ndarray]:
    return [P / c for c in np.geomspace(outer, inner, count + 1)]


def bent() -> Document:
    """x' = -x + sin(x)/8 + u/4, u = tanh(tanh(x) + tanh(x / 2) / 4)."""
    dynamics = ["+", ["-", "x"], ["/", ["sin", "x"], "8"], ["/", "u", "4"]]
    layers = [([[1.0], [0.5]], [0.0, 0.0]), ([[1.0, 0.25]], [0.0])]
    data = make([dynamics], layers, 1.0, (0.25, 0.25), scale=[1.0], domain=[("-1", "1")])
    return enlarge(data, levels_of(np.eye(1), 0.49, 0.2499, 20), [0.06] * 20)


def oscillator() -> Document:
    """x1' = x2, x2' = -2 x1 - 3 x2."""
    P, A = np.array([[1.25, 0.25], [0.25, 0.25]]), np.array([[0.0, 1.0], [-2.0, -3.0]])
    dynamics = ["y", ["+", ["*", "-2", "x"], ["*", "-3", "y"]]]
    data = still(dynamics, P, (0.5, 0.5), domain=[("-99", "99")] * 2, T=around(P))
    h, nodes = 1 / 64, [P / 0.4999]
    for _ in range(48):
        back = expm(A * h).T @ nodes[0] @ expm(A * h) * (1 + h / 2)
        nodes.insert(0, (back + back.T) / 2)
    return enlarge(data, nodes, [h] * 48)


@cache
def swing_of(**more: Any) -> Document:
    """x' = y, y' = sin(x)/2 + u, u = -6 tanh(x/4) - 6 tanh(y/4), in V of its linear part."""
    A, Q = np.array([[0.0, 1.0], [-1.0, -1.5]]), np.eye(2)
    P = np.linalg.solve(np.kron(A.T, np.eye(2)) + np.kron(np.eye(2), A.T), -Q.ravel()).reshape(2, 2)
    P = (P + P.T) / 2
    options: dict[str, Any] = {
        "squash": "identity", "centre": "output", "scale": [1.0], "input_bounds": [("-3", "3")],
        "states": "xy", "domain": [("-1", "1")] * 2, **more,
    }  # fmt: skip
    layers = [(np.eye(2) / 4, [0.0, 0.0]), ([[-6.0, -6.0]], [0.0])]
    data = make(["y", ["+", ["/", ["sin", "x"], "2"], "u"]], layers, P, (0.2, 0.2), **options)
    return enlarge(data, levels_of(P, 0.35, 0.1999, 12), [0.125] * 12)


def swing() -> Document:
    return swing_of()


def ring() -> Document:
    """A small local ball, leaves up to c2, and a tube that starts outside of both."""
    data = still([["+", ["-", "x"], ["*", "1/8", ["**", "x", 3]]]], 1.0, (0.04, 1.0))
    return enlarge(grow(data), levels_of(np.eye(1), 1.44, 0.999, 8), [0.125] * 8)


MAKERS = (decay, bent, oscillator, swing, ring)


@cache
def honest(name: str) -> Document:
    return next(maker for maker in MAKERS if maker.__name__ == name)()


NAMES = [maker.__name__ for maker in MAKERS]


@pytest.mark.parametrize("name", NAMES)
def test_honest_tubes_are_accepted(name: str) -> None:
    verdict = rules.judge(dump(honest(name)))
    assert verdict.result == "ACCEPTED", f"{verdict.rule} {verdict.at} {verdict.detail}"


@pytest.mark.parametrize("name", NAMES)
def test_without_its_tube_each_is_an_asymptotic_claim(name: str) -> None:
    data = edited(edited(honest(name), "evidence.tube", []), "claim", {"kind": "asymptotic", **CONTINUOUS})
    assert judge(data) is None


def test_starts_are_larger_than_what_the_claim_began_with() -> None:
    for name in NAMES:
        data = honest(name)
        start, c2 = square(data["claim"]["start"]), float.fromhex(data["levels"]["roa"])
        assert np.linalg.det(start) < np.linalg.det(square(data["lyapunov"]["P"]) / c2) / 1.2


# ------------------------------------------------------------------------------------------------------- forgeries


def at(path: str, value: Any) -> Edit:
    return lambda data: edited(data, path, value)


def array(path: str, change: Callable[[np.ndarray], Any]) -> Edit:
    return at(path, lambda text: encode(change(decode(text))))


def duration(k: int, change: Callable[[float], float]) -> Edit:
    return at(f"evidence.tube.{k}.duration", lambda text: change(float.fromhex(text)).hex())


def of_tube(change: Callable[[list[Any]], list[Any]]) -> Edit:
    return at("evidence.tube", change)


def rows(path: str, change: Callable[[np.ndarray], Any]) -> Edit:
    return array(f"{path}.multipliers", lambda values: change(values.reshape(3, -1)))


def with_row(index: int, value: Any) -> Callable[[np.ndarray], np.ndarray]:
    def change(values: np.ndarray) -> np.ndarray:
        result = values.copy()
        result[index] = value
        return result

    return change


def times(factor: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda values: values * factor


def swapped(i: int, j: int) -> Callable[[list[Any]], list[Any]]:
    def change(slabs: list[Any]) -> list[Any]:
        result = list(slabs)
        result[i], result[j] = slabs[j], slabs[i]
        return result

    return change


def asymmetric(values: np.ndarray) -> np.ndarray:
    return values + np.array([0, 1e-9, 0, 0])


def indefinite(values: np.ndarray) -> np.ndarray:
    return values * [1, 1, 1, -1]


ANY = ""  # a slab or a node
FORGERIES: list[tuple[str, str, str, str, Edit]] = [  # rule, place, base, what, edit
    *(("tube", ANY, name, "two slabs swapped", of_tube(swapped(0, 1))) for name in NAMES),
    *(("tube", ANY, name, "the first slab is missing", of_tube(lambda s: s[1:])) for name in NAMES if name != "decay"),
    *(("tube", "node", name, "the last slab is missing", of_tube(lambda s: s[:-1])) for name in NAMES),
    ("tube", "node", "oscillator", "in reverse", of_tube(lambda s: s[::-1])),
    ("tube", "slab 2", "decay", "a slab twice", of_tube(lambda s: [s[0], s[0] | {"end": encode([0.125])}, *s[1:]])),
    ("tube", "slab 1", "oscillator", "the first end larger", array("evidence.tube.0.end", times(0.5))),
    ("tube", "slab 4", "swing", "an end larger", array("evidence.tube.3.end", times(0.75))),
    ("tube", "slab 4", "swing", "an end smaller", array("evidence.tube.3.end", times(1.5))),
    ("tube", "node 2", "decay", "the last end larger", array("evidence.tube.1.end", times(0.5))),
    ("tube", "node 2", "decay", "the last end is {V <= c2} itself", array("evidence.tube.1.end", lambda _: [1.0])),
    ("tube", "node 48", "oscillator", "the last end larger", array("evidence.tube.47.end", times(0.99))),
    ("tube", "slab 1", "decay", "a larger start", array("claim.start", times(0.75))),
    ("tube", "slab 1", "oscillator", "a larger start", array("claim.start", times(0.97))),
    ("tube", "slab 1", "swing", "a start longer in one direction", array("claim.start", lambda v: v * [0.9, 1, 1, 1])),
    ("tube", "node 0", "swing", "a start of another plant", array("claim.start", lambda v: v - [v[0] / 2, 0, 0, 0])),
    ("tube", "node 0", "decay", "a start of zeros", array("claim.start", lambda _: [0.0])),
    ("tube", "node 0", "decay", "a negative start", array("claim.start", lambda v: -v)),
    ("tube", "node 0", "oscillator", "an indefinite start", array("claim.start", indefinite)),
    ("tube", "node 0", "oscillator", "a start that is not symmetric", array("claim.start", asymmetric)),
    ("tube", "node 3", "oscillator", "an end that is not symmetric", array("evidence.tube.2.end", asymmetric)),
    ("tube", "node 3", "oscillator", "an end that is not definite", array("evidence.tube.2.end", indefinite)),
    ("tube", "middle 1", "decay", "a middle of zeros", array("evidence.tube.0.middle", times(0))),
    ("tube", "middle 1", "decay", "a negative middle", array("evidence.tube.0.middle", times(-1))),
    ("tube", "middle 3", "oscillator", "a middle that is not symmetric", array("evidence.tube.2.middle", asymmetric)),
    ("tube", "middle 3", "oscillator", "a middle that is not definite", array("evidence.tube.2.middle", indefinite)),
    ("tube", "middle 2", "decay", "a middle leaves the domain", array("evidence.tube.1.middle", lambda _: [0.1])),
    *(("tube", "slab 2", name, "a middle too early", array("evidence.tube.1.middle", times(2))) for name in NAMES),
    *(
        ("tube", "slab 2", name, "a middle outside the ball", array("evidence.tube.1.middle", times(0.9)))
        for name in NAMES
        if name != "decay"
    ),
    ("tube", "slab 2", "decay", "a duration of 0", duration(1, lambda h: 0.0)),
    ("tube", "slab 2", "decay", "a duration of -0", duration(1, lambda h: -0.0)),
    ("tube", "slab 1", "decay", "a negative duration", duration(0, lambda h: -h)),
    ("tube", "slab 1", "decay", "the least duration", duration(0, lambda h: 5e-324)),
    ("tube", "slab 1", "decay", "a duration just too short", duration(0, lambda h: 0.625)),
    *(("tube", "slab", name, "a duration too short", duration(1, lambda h: h / 9)) for name in NAMES),
    *(
        ("tube", "slab", name, "J too small", array("evidence.tube.1.J", times(0.97)))
        for name in NAMES
        if name != "decay"
    ),
    ("tube", "slab 1", "decay", "J that touches its ellipsoid", array("evidence.tube.0.J", lambda _: [2.0])),
    ("tube", "slab 1", "oscillator", "J of zeros", array("evidence.tube.0.J", times(0))),
    ("tube", "slab 1", "oscillator", "J of rank one", array("evidence.tube.0.J", lambda v: [9, 9, 9, 9])),
    ("tube", "slab 1", "oscillator", "J turned", array("evidence.tube.0.J", lambda v: v.reshape(2, 2)[::-1])),
    ("tube", "slab 2", "bent", "J too large", array("evidence.tube.1.J", times(8))),
    *(("tube", "slab 3", "swing", f"row {k} negative", rows("evidence.tube.2", with_row(k, -1.0))) for k in range(3)),
    ("tube", "slab 3", "swing", "one multiplier barely negative", rows("evidence.tube.2", with_row((0, 1), -5e-324))),
    ("tube", "slab 3", "swing", "alpha and beta swapped", rows("evidence.tube.2", lambda v: v[[1, 0, 2]])),
    ("tube", "slab 3", "swing", "all multipliers 0", rows("evidence.tube.2", lambda v: 0 * v)),
    (
        "tube",
        "slab 3",
        "swing",
        "no beta and one g of 0",
        rows("evidence.tube.2", lambda v: with_row((2, 1), 0)(0 * v + 1)),
    ),
    ("tube", "slab 3", "swing", "a large alpha", rows("evidence.tube.2", with_row(0, 1e9))),
    ("tube", "slab 3", "swing", "a small alpha", rows("evidence.tube.2", with_row(0, 1e-9))),
    ("tube", "slab 3", "swing", "a large beta", rows("evidence.tube.2", with_row(1, 1e9))),
    ("tube", "slab 1", "decay", "a large g", rows("evidence.tube.0", lambda _: [[0], [0], [1e9]])),
    ("tube", "node 0", "oscillator", "the start leaves the domain", at("plant.domain.0", ["-1", "1"])),
    ("tube", "node 0", "decay", "the start touches the domain", at("plant.domain.0", ["-2", "3"])),
    ("tube", "node 1", "decay", "a node leaves the domain", array("evidence.tube.0.end", times(0.125))),
    ("tube", "slab 1", "decay", "growth", at("plant.dynamics.0", ["+", ["-", "x"], ["*", "1/2", ["**", "x", 3]]])),
    ("local", "ball", "decay", "growth everywhere", at("plant.dynamics.0", "x")),
    (
        "tube",
        "slab 1",
        "decay",
        "a pole",
        at("plant.dynamics.0", ["+", ["-", "x"], ["*", "0", ["/", "1", ["-", "x", "2"]]]]),
    ),
    (
        "tube",
        "slab 1",
        "decay",
        "a root",
        at("plant.dynamics.0", ["+", ["-", "x"], ["*", "0", ["sqrt", ["+", "x", "2"]]]]),
    ),
]


@pytest.mark.parametrize(
    ("rule", "place", "name", "edit"),
    [pytest.param(r, p, n, e, id=f"{n}: {what}") for r, p, n, what, e in FORGERIES],
)
def test_forgeries(rule: str, place: str, name: str, edit: Edit) -> None:
    verdict = rules.judge(dump(edit(honest(name))))
    assert (verdict.result, verdict.rule) == ("REJECTED", rule), verdict.detail
    assert str(verdict.at).startswith(place)


def test_numbers_at_the_edge_of_the_tube_by_hand() -> None:
    """h > (P_1 - P_0) / (2 P_0) = 5/8 and J > 1 / sqrt(P_0) = 2 for the first slab; the last node is 1 / P_2 < c2."""
    for edit in (
        duration(0, lambda h: math.nextafter(0.625, 1)),
        array("evidence.tube.0.J", lambda _: [math.nextafter(2, 3)]),
        array("evidence.tube.1.end", lambda _: [math.nextafter(1, 2)]),
        at("plant.domain.0", ["-2000000000001/1000000000000", "3"]),
        rows("evidence.tube.0", lambda v: [[0], [0], [NONE]]),
        rows("evidence.tube.0", lambda v: [[1e-9], [NONE], [7]]),
    ):
        data = rows("evidence.tube.0", with_row(1, 5e-324))(honest("decay"))
        assert judge(edit(data)) is None
    assert judge(duration(0, lambda h: 1e300)(honest("decay"))) is None


def test_a_middle_at_its_edges_by_hand() -> None:
    """Slab 1 of `decay`, P_0 = 1/4, P_1 = 9/16, h = 3/4: the coefficients ask for M < (1 + h) P_0, 2 M > (P_1 - P_0)
    / h and M > (1 - h) P_1, which is less, the ball for J^2 M > 1, a domain of 4 for M > 1/16."""
    wide = at("plant.domain.0", ["-4", "5"])(honest("decay"))
    widest = array("evidence.tube.0.J", lambda _: [8.0])
    for P, J, place, detail in (
        (0.4375, None, "slab 1", "the first coefficient"),
        (math.nextafter(0.4375, 0), None, None, ""),
        (math.nextafter(5 / 24, 0), widest, "slab 1", "the middle coefficient"),
        (5 / 24, widest, None, ""),  # the float lies above
        (0.25, array("evidence.tube.0.J", lambda _: [math.nextafter(2, 3)]), None, ""),
        (0.25 - 2.0**-52, array("evidence.tube.0.J", lambda _: [math.nextafter(2, 3)]), "slab 1", "its middle"),
        (0.0625, widest, "middle 1", "the ellipsoid leaves the interior of the domain"),
        (math.nextafter(0.0625, 1), widest, "slab 1", "the middle coefficient"),
    ):
        data = rows("evidence.tube.0", with_row(1, 5e-324))(array("evidence.tube.0.middle", lambda _, P=P: [P])(wide))
        verdict = rules.judge(dump(data if J is None else J(data)))
        assert (verdict.rule, verdict.at) == (place and "tube", place) and detail in str(verdict.detail), P
    assert Fraction(math.nextafter(5 / 24, 0)) < Fraction(5, 24) < Fraction(5 / 24)


def test_a_middle_lets_a_tube_bend() -> None:
    """Not linear in t: the tube of `bent` with each middle moved towards its end or its start, as far as it goes."""
    for share, found in ((0.4, None), (0.6, None), (0.01, "tube"), (0.99, "tube")):
        data, before = honest("bent"), square(honest("bent")["claim"]["start"])
        for k, each in enumerate(honest("bent")["evidence"]["tube"]):
            end = square(each["end"])
            data = edited(data, f"evidence.tube.{k}.middle", encode((1 - share) * before + share * end))
            before = end
        assert judge(data) == found, share


HARMLESS: list[tuple[str, str, Edit]] = [
    ("swing", "a component taken jointly", rows("evidence.tube.2", lambda v: [v[0], [0, v[1, 1]], [1e-9, 1e-9]])),
    ("swing", "all components taken jointly", rows("evidence.tube.2", lambda v: [v[0], [0, 0], [1e-9, 1e-9]])),
    ("swing", "no component jointly, and a g of 0", rows("evidence.tube.2", with_row((2, 0), 0.0))),
    ("swing", "J with another sign", array("evidence.tube.2.J", times(-1))),
    ("swing", "J with other axes", array("evidence.tube.2.J", lambda v: v.reshape(2, 2) @ [[0.6, -0.8], [0.8, 0.6]])),
    ("swing", "a smaller start", array("claim.start", times(1.01))),
    *((name, "a weight in other units", array("evidence.tube.1.weight", times(1e-9))) for name in NAMES),
    ("decay", "no weight where nothing is bent", array("evidence.tube.1.weight", times(0))),
    ("decay", "a larger domain", at("plant.domain.0", ["-4", "5"])),
    ("decay", "a start that is the last end", array("claim.start", lambda _: [1.0625])),
    ("ring", "a longer duration", duration(3, lambda h: 2 * h)),
]


@pytest.mark.parametrize(("name", "edit"), [pytest.param(n, e, id=f"{n}: {what}") for n, what, e in HARMLESS])
def test_harmless_edits(name: str, edit: Edit) -> None:
    assert judge(edit(honest(name))) is None


# ------------------------------------------------------------------------------------------------------ inputs, clips


def test_the_inputs_on_a_slab() -> None:
    """Bounds that the models reach on the first slab and not on the last, nor on the local ball."""
    reach = [float(u.radius) for u in inputs_of(swing_of())]
    assert reach == sorted(reach, reverse=True) and reach[0] > 1.1 * reach[-1]
    for bound, place in ((1.001 * reach[0], None), ((reach[0] + reach[-1]) / 2, "slab 1")):
        limit = f"{round(1e6 * bound)}/1000000"
        for ends in ([f"-{limit}", "9"], ["-9", limit]):
            verdict = rules.judge(dump(edited(swing_of(), "plant.input_bounds.0", ends)))
            assert (verdict.rule, verdict.at) == (place and "inputs", place)


def inputs_of(data: Document) -> list[Any]:
    """The model of the input on each slab."""
    c = rules.read(dump(data))
    return [inputs_on(c, each.ball.J)[0] for each in c.evidence.tube]  # type: ignore[union-attr]


def test_by_form_the_inputs_need_no_model() -> None:
    """tanh keeps `bent` within [-1, 1], whatever its models say; within less they have to say it."""
    (reach, *_) = (float(u.radius) for u in inputs_of(honest("bent")))
    assert 0.4 < reach < 2
    for bound, found in ((1.0, None), (math.nextafter(1, 0), "inputs" if reach > 1 else None), (0.4, "inputs")):
        ends = ["-{}/{}".format(*bound.as_integer_ratio()), "2"]
        assert judge(edited(honest("bent"), "plant.input_bounds.0", ends)) == found


def test_a_clip_must_not_act_on_a_slab() -> None:
    reach = [float(u.radius) for u in inputs_of(swing_of())]
    for limit, found in ((1.001 * reach[0], None), ((reach[0] + reach[1]) / 2, "slab 1"), (reach[-1], "slab 1")):
        data = swing_of(clip=((-limit,), (limit,)))
        verdict = rules.judge(dump(data))
        assert (verdict.rule, verdict.at) == (found and "tube", found)


# ------------------------------------------------------------------------------------------------------- the file


def other_claim(kind: str) -> Edit:
    return lambda data: edited(data, "claim", {"kind": kind})


def without(path: str, key: str) -> Edit:
    return at(path, lambda old: {k: v for k, v in old.items() if k != key})


def more(path: str, key: str, value: Any) -> Edit:
    return at(path, lambda old: old | {key: value})


def practical(data: Document) -> Document:
    data = other_claim("practical")(data)
    return edited(data, "levels", lambda old: {"floor": old["local"], **old})


TRUSTED = {"kind": "trusted-solver", "solver": "dReal", "version": "4", "precision": (0.5).hex(), "queries": []}
MALFORMED: dict[str, Edit] = {
    "a tube under claim asymptotic": other_claim("asymptotic"),
    "a tube under claim practical": lambda d: edited(practical(d), "evidence.local", None),
    "no ball under claim enlarged": at("evidence.local", None),
    "no ball under claim asymptotic": lambda d: edited(
        edited(other_claim("asymptotic")(d), "evidence.tube", []), "evidence.local", None
    ),
    "an empty tube": at("evidence.tube", []),
    "no tube": at("evidence.tube", None),
    "a tube that is an object": at("evidence.tube", {}),
    "too many slabs": of_tube(lambda slabs: (slabs * 5001)[:10_001]),
    "a start under claim asymptotic": lambda d: edited(more("claim", "kind", "asymptotic")(d), "evidence.tube", []),
    "no start": without("claim", "start"),
    "no kind": without("claim", "kind"),
    "an unknown claim": more("claim", "kind", "larger"),
    "a claim that is a list": more("claim", "kind", ["enlarged"]),
    "a start of another size": at("claim.start", encode([1.0, 2.0])),
    "a start that is not a number": at("claim.start", encode([math.nan])),
    "an end that is infinite": at("evidence.tube.0.end", encode([math.inf])),
    "an end of another size": at("evidence.tube.1.end", encode([1.0, 0.0, 0.0, 1.0])),
    "a middle of another size": at("evidence.tube.0.middle", encode([1.0, 0.0, 0.0, 1.0])),
    "a middle that is not a number": at("evidence.tube.0.middle", encode([math.nan])),
    "no middle": without("evidence.tube.1", "middle"),
    "J of another size": at("evidence.tube.1.J", encode([1.0, 0.0])),
    "two rows of multipliers": at("evidence.tube.0.multipliers", encode([1.0, 1.0])),
    "four rows of multipliers": at("evidence.local.multipliers", encode([1.0] * 4)),
    "a multiplier that is not a number": at("evidence.tube.0.multipliers", encode([math.nan, 1.0, 1.0])),
    "an infinite multiplier": at("evidence.local.multipliers", encode([1.0, math.inf, 1.0])),
    "no weight of the ball": without("evidence.local", "weight"),
    "no weight of a slab": without("evidence.tube.1", "weight"),
    "a weight that is not a number": at("evidence.local.weight", encode([math.nan])),
    "an infinite weight of a slab": at("evidence.tube.0.weight", encode([-math.inf])),
    "a weight for a motion that is none": at("evidence.tube.0.weight", encode(np.eye(2))),
    "a weight for a motion of the ball": at("evidence.local.weight", encode(np.eye(2))),
    "an empty weight": at("evidence.tube.0.weight", ""),
    "a weight that is null": at("evidence.tube.0.weight", None),
    "a decimal weight": at("evidence.local.weight", 1),
    "a weight instead of multipliers": lambda d: edited(
        without("evidence.tube.0", "multipliers")(d), "evidence.tube.0.weights", encode([1.0])
    ),
    "an infinite duration": at("evidence.tube.0.duration", "inf"),
    "a duration that is no number": at("evidence.tube.0.duration", "nan"),
    "a decimal duration": at("evidence.tube.0.duration", "1"),
    "an integer as duration": at("evidence.tube.0.duration", 1),
    "no duration": without("evidence.tube.0", "duration"),
    "a slab that knows more": more("evidence.tube.0", "start", encode([0.25])),
    "a ball that knows more": more("evidence.local", "radius", 1),
    "a slab without J": without("evidence.tube.1", "J"),
    "evidence without local": without("evidence", "local"),
    "evidence without tube": without("evidence", "tube"),
    "a slab that is a list": at("evidence.tube.1", []),
    "a solver's word": at("evidence", TRUSTED),
    "version 3": at("schema", "certify-certificate/3"),
}


@pytest.mark.parametrize("what", MALFORMED)
def test_malformed_tubes(what: str) -> None:
    assert judge_bytes(dump(MALFORMED[what](honest("decay")))) == "format"


PLACES = [
    "claim",
    "claim.kind",
    "claim.start",
    "evidence.local",
    "evidence.local.J",
    "evidence.local.multipliers",
    "evidence.local.weight",
]
PLACES += [
    "evidence.tube",
    "evidence.tube.1",
    *(f"evidence.tube.1.{key}" for key in ("middle", "end", "duration", "J", "weight")),
]


@pytest.mark.parametrize("path", PLACES)
@pytest.mark.parametrize(
    "value", [None, True, 0, -1, "", "a", "0x1p0", [], {}, [[]], [None], {"J": 1}, "AAAAAAAA8D8"], ids=repr
)
def test_odd_values(path: str, value: Any) -> None:
    assert judge_bytes(dump(edited(honest("decay"), path, value))) == "format"


def test_ten_thousand_slabs_are_read() -> None:
    """They are refused later: the same slab does not begin where it ends."""
    data = of_tube(lambda slabs: [slabs[0] | {"end": encode([-1.0])}, *(slabs * 5000)[1:10_000]])(honest("decay"))
    assert judge(data) == "tube"


# ----------------------------------------------------------------------------------------------------- what is true


@given(
    st.lists(st.tuples(st.floats(1e-3, 4), st.floats(-0.5, 3)), min_size=1, max_size=4),
    st.floats(0.12, 1.5),
    st.floats(1.0, 1.2),
)
@example([(1.1, 0.1)], 0.5, 1.001)
@example([(1.1, 0.05), (0.3, -0.05), (1.1, 2.0)], 0.5, 1.001)
def test_nothing_is_faster_than_the_flow(tube_of: list[tuple[float, float]], start: float, wide: float) -> None:
    """x' = -x takes ln(r / s) from |x| = r to |x| = s: whatever a file says of nodes, times and balls."""
    data, before = decay(), start
    data["claim"]["start"] = encode([start])
    data["evidence"]["tube"], total = [], 0.0
    for end, h in tube_of:
        J = wide / math.sqrt(min(before, end))
        data["evidence"]["tube"].append(slab(before, end, h, J, [[0.0], [NONE], [0.0]]))
        total, before = total + h, end
    if judge(data) is None:
        assert before > 1 and total >= math.log(before / start) / 2 * (1 - 1e-9)


@pytest.mark.parametrize("reach", [1.92, 2.5])
def test_no_tube_helps_a_start_beyond_the_region_of_attraction(reach: float) -> None:
    """x' = x/2 - tanh(x), whose origin attracts |x| < 1.915008: any ball, any time, any multipliers, many nodes."""
    base = make([["+", ["/", "x", "2"], "u"]], [([[1.0]], [0.0])], 1.0, (0.25, 0.25))
    generator = np.random.default_rng(0)
    for count, h in itertools.product((1, 5, 40), (1e-3, 0.3, 1e3)):
        data = enlarge(base, levels_of(np.eye(1), reach**2, 0.24, count), [h] * count)
        assert judge(data) == "tube"
        for k in range(min(count, 5)):
            data["evidence"]["tube"][k]["multipliers"] = encode(np.exp(generator.standard_normal(3)))
        assert judge(data) == "tube"


@pytest.mark.parametrize("name", NAMES)
def test_what_is_accepted_is_true_of_runs(name: str) -> None:
    """Runge-Kutta from the edge of the start: at each node inside of its ellipsoid, and in the end in {V <= c2}."""
    data = honest(name)
    n, slabs = len(data["plant"]["states"]), data["evidence"]["tube"]
    start, generator = square(data["claim"]["start"]), np.random.default_rng(1)
    directions = generator.standard_normal((n, 64))
    x = directions / np.sqrt(np.einsum("ib,ij,jb->b", directions, start, directions))
    for each in slabs:
        h = float.fromhex(each["duration"]) / 64
        for _ in range(64):
            k1 = F_of(name, x)
            k2 = F_of(name, x + h / 2 * k1)
            k3 = F_of(name, x + h / 2 * k2)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + F_of(name, x + h * k3))
        assert (np.einsum("ib,ij,jb->b", x, square(each["end"]), x) < 1).all()
    V = np.einsum("ib,ij,jb->b", x, square(data["lyapunov"]["P"]), x)
    assert (float.fromhex(data["levels"]["roa"]) > V).all()


def F_of(name: str, x: np.ndarray) -> np.ndarray:
    """The loops once more, in floats."""
    if name == "decay":
        return -x
    if name == "bent":
        return -x + np.sin(x) / 8 + np.tanh(np.tanh(x) + np.tanh(x / 2) / 4) / 4
    if name == "oscillator":
        return np.stack([x[1], -2 * x[0] - 3 * x[1]])
    if name == "swing":
        return np.stack([x[1], np.sin(x[0]) / 2 - 6 * np.tanh(x[0] / 4) - 6 * np.tanh(x[1] / 4)])
    return -x + x**3 / 8


# -------------------------------------------------------------------------------------------- every clause is needed


def yes(*_: Any) -> bool:
    return True


CLAUSES: dict[str, tuple[Any, str, Callable[..., Any], Edit]] = {  # where, what it says instead, the forgery
    "the last node": (
        tube, "positive_definite", yes, of_tube(lambda slabs: slabs[:1]),
    ),
    "the ball": (
        tube, "contains", yes, array("evidence.tube.0.J", times(0.5)),
    ),
    "the multipliers": (
        tube, "sound_multipliers", lambda *_: None, rows("evidence.tube.0", with_row(2, -1.0)),
    ),
    "what decreases": (
        tube, "decreases", yes, duration(0, lambda h: 0.5),
    ),
    "the domain": (
        tube, "beyond_domain", lambda *_: None, at("plant.domain.0", ["-3/2", "3/2"]),
    ),
}  # fmt: skip


@pytest.mark.parametrize("clause", CLAUSES)
def test_with_a_clause_disabled_a_forgery_gets_through(clause: str, monkeypatch: pytest.MonkeyPatch) -> None:
    module, name, instead, edit = CLAUSES[clause]
    data = edit(honest("decay"))
    assert judge(data) == "tube"
    monkeypatch.setattr(module, name, instead)
    assert judge(data) is None


COEFFICIENTS = ["first", "middle", "last"]


@pytest.mark.parametrize("which", COEFFICIENTS)
def test_every_coefficient_of_a_slab_is_asked(which: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A slab of the oscillator in which two of the three coefficients of what x'P(t)x does are negative."""
    data, A = honest("oscillator"), np.array([[0.0, 1.0], [-2.0, -3.0]])
    generator, h, number = np.random.default_rng(2), 4.0, COEFFICIENTS.index(which)
    while True:
        shapes = generator.standard_normal((3, 2, 2))
        start, middle, end = (30 * (np.eye(2) + B @ B.T) for B in shapes)
        rates = (2 * (middle - start) / h, (end - start) / h, 2 * (end - middle) / h)
        each = zip(rates, (start, middle, end), strict=True)
        worst = [float(np.linalg.eigvalsh(rate + A.T @ P + P @ A)[-1]) for rate, P in each]
        if worst.pop(number) > 1 and max(worst) < -1:
            break
    rows, J = [[0.0] * 2, [NONE] * 2, [0.0] * 2], around(start, middle, end)
    one = slab_of(middle, end, h) | ball(J, rows)
    data = edited(edited(data, "claim.start", encode(start)), "evidence.tube", [one])
    verdict = rules.judge(dump(data))
    assert (verdict.rule, verdict.at) == ("tube", "slab 1") and f"the {which} coefficient" in str(verdict.detail)
    asked = itertools.count()

    def spared(*arguments: Any) -> bool:
        return next(asked) == number or decrease.decreases(*arguments)

    monkeypatch.setattr(tube, "decreases", spared)
    assert judge(data) is None


# ------------------------------------------------------------------------------------------------------ what is printed


def test_the_claim_in_words(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert command.main([str(write(honest("oscillator"), tmp_path))]) == 0
    claim, verdict = capsys.readouterr().out.splitlines()
    start = square(honest("oscillator")["claim"]["start"]).tolist()
    assert "every trajectory that starts in V <= 0.5 stays there and converges to the origin" in claim
    assert "starts in x'P_0 x <= 1 reaches V <= 0.5 after the sum of the durations (0.75) at the latest" in claim
    assert claim.endswith(f"P_0 = {start}") and verdict.startswith("ACCEPTED c1=0.5 c2=0.5 sha256=")


def test_the_claim_in_json(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert command.main([str(write(honest("decay"), tmp_path)), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["result"], said["claim"], said["start"], said["time"]) == ("ACCEPTED", "enlarged", [[0.25]], 1.25)
    assert said["levels"] == {"local": 1.0, "roa": 1.0} and "P_0 = [[0.25]]" in said["text"][0]


@pytest.mark.parametrize(
    ("durations", "time"),
    [
        ((0.1, 0.2), math.nextafter(0.3, 1)),  # exactly 0.1 + 0.2 lies above the float next to 3/10
        ((1.0, 2.0**-60), math.nextafter(1, 2)),
        ((1.7e308, 1.7e308), None),
        ((-1.0, 0.5), -0.5),
        ((-1.7e308, -1.7e308), None),
    ],
)
def test_the_time_is_rounded_upwards(durations: tuple[float, float], time: float | None) -> None:
    data = honest("decay")
    for k, h in enumerate(durations):
        data = duration(k, lambda _, h=h: h)(data)  # type: ignore[misc]
    verdict = rules.judge(dump(data))
    assert verdict.certificate is not None and command.time_of_tube(verdict.certificate) == time
    json.loads(json.dumps(command.as_json(verdict, 0.0), allow_nan=False))


@pytest.mark.parametrize("edit", [array("claim.start", lambda _: [0.0]), array("claim.start", lambda _: [-1e-320])])
def test_what_is_rejected_is_printed_too(edit: Edit, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = str(write(edit(honest("decay")), tmp_path))
    assert command.main([path]) == 1 and command.main([path, "--json"]) == 1
    assert capsys.readouterr().out.splitlines()[1].startswith("REJECTED rule=tube at=node 0: ")
