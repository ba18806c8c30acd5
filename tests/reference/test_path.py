"""Attacks on claim `reached`: honest tubes around a path are accepted, and each forgery is refused by its rule.

`decay` is x' = -x, followed by intervals of constant width; `bent` has a sine and a network in one state, at rest with
an input that is not 0; `oscillator` is linear in two; `swing` is a pendulum that stands up under a network. The path is
a few points of a trajectory, and no trajectory itself.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
from array import array as floats
from collections.abc import Callable, Iterator
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flint import arb, arb_mat, ctx, fmpq, fmpq_mat
from hypothesis import example, given
from hypothesis import strategies as st

from certify.analysis.run import RoaOptions, certify_roa
from certify.checker.errors import Rejected
from certify.loop.plants import get_system
from certify.loop.policies import load_policy
from certify.reference import __main__ as command
from certify.reference import decrease, rules, tube
from certify.reference.balls import PRECISION
from certify.reference.decrease import decreases_along
from certify.reference.document import read
from certify.reference.evidence import Ball
from certify.reference.evidence import Path as Motion
from certify.reference.loop import Field, Loop
from certify.reference.model import Model
from certify.reference.rational import beyond_domain, root_above
from tests.reference.test_local import row
from tests.reference.test_tube import array, at, more, of_tube, times, without, yes
from tests.support.balls import TINY, around, ball, centred, exactly, slab_of, square, with_ball
from tests.support.certificates import Document, decode, dump, edited, encode, make, write
from tests.support.certificates import verdict as verdict_of_the_checker
from tests.support.marks import slow_after
from tests.support.models import curves, field, inputs_on, model, numbers, units
from tests.support.paths import along, follow
from tests.support.reference import CONTINUOUS, judge

Edit = Callable[[Document], Document]
LEAST = 5e-324
SHIPPED = Path(__file__).parents[2] / "examples" / "policies"


@pytest.fixture(autouse=True)
def precision() -> Iterator[None]:
    with ctx.workprec(PRECISION):
        yield


def decay() -> Document:
    """From [3, 5] into |x| <= 2: in h = 9/32 the centre falls by a quarter of itself; the radius is 1 throughout."""
    data = make([["-", "x"]], [([[0.0]], [0.0])], 1.0, (4.0, 4.0), domain=[("-6", "6")], scale=[1.0])
    return follow(data, [np.array([4 * 0.75**k]) for k in range(6)], [np.eye(1)] * 6, [9 / 32] * 5)


def bent() -> Document:
    """x' = -x + sin(x)/8 + (u - 1/4)/4, u = tanh(net(x) - net(0) + atanh(1/4))/2 + 1/8."""
    dynamics = ["+", ["-", "x"], ["/", ["sin", "x"], "8"], ["/", ["-", "u", "1/4"], "4"]]
    layers = [([[1.0], [0.5]], [0.25, -0.5]), ([[1.0, 0.25], [-0.5, 1.0]], [0.5, 0.0]), ([[0.5, -0.25]], [1.0])]
    options: dict[str, Any] = {"u_eq": ["1/4"], "scale": [0.5], "offset": [0.125], "domain": [("-4", "4")]}
    data = make([dynamics], layers, 1.0, (0.5, 0.5), **options)
    return run_along("bent", data, [-2.0], [np.eye(1) * 16] * 17, 0.125)


def oscillator() -> Document:
    """x' = y, y' = u, u = -2 x - 3 y."""
    P = np.array([[1.25, 0.25], [0.25, 0.25]])
    options: dict[str, Any] = {
        "states": "xy", "domain": [("-9", "9")] * 2, "squash": "identity", "centre": "none", "scale": [1.0],
        "input_bounds": [("-30", "30")], "T": around(P),
    }  # fmt: skip
    data = make(["y", "u"], [([[-2.0, -3.0]], [0.0])], P, (0.5, 0.5), **options)
    return run_along("oscillator", data, [3.0, -2.0], [P * 8] * 41, 1 / 16)


@cache
def swing_of(**more: Any) -> Document:
    """x' = y, y' = sin(x)/2 + u, u = -6 tanh(x/4) - 6 tanh(y/4), in V of its linear part."""
    A, Q = np.array([[0.0, 1.0], [-1.0, -1.5]]), np.eye(2)
    P = np.linalg.solve(np.kron(A.T, np.eye(2)) + np.kron(np.eye(2), A.T), -Q.ravel()).reshape(2, 2)
    P = (P + P.T) / 2
    options: dict[str, Any] = {
        "squash": "identity", "centre": "output", "scale": [1.0], "input_bounds": [("-3", "3")],
        "states": "xy", "domain": [("-2", "2")] * 2, **more,
    }  # fmt: skip
    layers = [(np.eye(2) / 4, [0.0, 0.0]), ([[-6.0, -6.0]], [0.0])]
    data = make(["y", ["+", ["/", ["sin", "x"], "2"], "u"]], layers, P, (0.2, 0.2), **options)
    return run_along("swing", data, [1.25, -0.5], [P * 40 / 1.02**k for k in range(41)], 1 / 16)


def swing() -> Document:
    return swing_of()


def F_of(name: str, x: np.ndarray) -> np.ndarray:
    """The loops once more, in floats; x has a row for each state."""
    if name == "decay":
        return -x
    if name == "bent":
        return -x + np.sin(x) / 8 + (np.tanh(bent_net(x) - bent_net(0 * x) + np.arctanh(0.25)) / 2 + 0.125 - 0.25) / 4
    if name == "oscillator":
        return np.stack([x[1], -2 * x[0] - 3 * x[1]])
    return np.stack([x[1], np.sin(x[0]) / 2 - 6 * np.tanh(x[0] / 4) - 6 * np.tanh(x[1] / 4)])


def bent_net(x: np.ndarray) -> np.ndarray:
    first, second = np.tanh(x + 0.25), np.tanh(x / 2 - 0.5)
    one, other = np.tanh(first + second / 4 + 0.5), np.tanh(second - first / 2)
    result: np.ndarray = one / 2 - other / 4 + 1
    return result


def flow(name: str, x: np.ndarray, h: float, steps: int = 16) -> np.ndarray:
    """Runge-Kutta."""
    h /= steps
    for _ in range(steps):
        k1 = F_of(name, x)
        k2 = F_of(name, x + h / 2 * k1)
        k3 = F_of(name, x + h / 2 * k2)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + F_of(name, x + h * k3))
    return x


def run_along(name: str, data: Document, start: list[float], nodes: list[np.ndarray], h: float) -> Document:
    """The tube around a run from `start`, a slab each h."""
    centres = [np.array(start)]
    for _ in nodes[1:]:
        centres.append(flow(name, centres[-1], h))
    return follow(data, centres, nodes, [h] * (len(nodes) - 1))


MAKERS = (decay, bent, oscillator, swing)
NAMES = [maker.__name__ for maker in MAKERS]


@cache
def honest(name: str) -> Document:
    with ctx.workprec(PRECISION):
        return next(maker for maker in MAKERS if maker.__name__ == name)()


@pytest.mark.parametrize("name", slow_after(3, NAMES))
def test_honest_tubes_are_accepted(name: str) -> None:
    verdict = rules.judge(dump(honest(name)))
    assert verdict.result == "ACCEPTED", f"{verdict.rule} {verdict.at} {verdict.detail}"


@pytest.mark.parametrize("name", NAMES)
def test_what_is_accepted_is_true_of_runs(name: str) -> None:
    """Runge-Kutta from the edge of the start: at each node inside of its ellipsoid, and in the end in {V <= c2}."""
    data = honest(name)
    n = len(data["plant"]["states"])
    start, centre = square(data["claim"]["start"]), decode(data["claim"]["centre"])
    directions = np.random.default_rng(1).standard_normal((n, 64))
    x = centre[:, None] + directions / np.sqrt(np.einsum("ib,ij,jb->b", directions, start, directions))
    assert (V_of(data, x) > 1.5 * float.fromhex(data["levels"]["roa"])).all()  # the start is far outside
    for each in data["evidence"]["tube"]:
        x = flow(name, x, float.fromhex(each["duration"]), 64)
        e = x - decode(each["path"]["centre"])[:, None]
        assert (np.einsum("ib,ij,jb->b", e, square(each["end"]), e) < 1).all()
    assert (V_of(data, x) < float.fromhex(data["levels"]["roa"])).all()


def V_of(data: Document, x: np.ndarray) -> np.ndarray:
    result: np.ndarray = np.einsum("ib,ij,jb->b", x, square(data["lyapunov"]["P"]), x)
    return result


# ------------------------------------------------------------------------------------------------------- forgeries


def number(path: str, change: Callable[[float], float]) -> Edit:
    return at(path, lambda text: change(float.fromhex(text)).hex())


def of_path(k: int, key: str, value: float) -> Edit:
    return at(f"evidence.tube.{k}.path.{key}", value.hex())


def centre(k: int, change: Callable[[np.ndarray], Any]) -> Edit:
    return array(f"evidence.tube.{k}.path.centre" if k >= 0 else "claim.centre", change)


def rows(k: int, change: Callable[[np.ndarray], Any]) -> Edit:
    return array(f"evidence.tube.{k}.multipliers", lambda values: change(values.reshape(3, -1)))


def plus(step: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda values: values + step


def stays(data: Document) -> Document:
    """The second slab's centre at that of the first."""
    return edited(data, "evidence.tube.1.path.centre", data["evidence"]["tube"][0]["path"]["centre"])


def of_three(values: list[list[int]]) -> Callable[[np.ndarray], np.ndarray]:
    """Alpha, beta and g, each times its numbers."""
    return lambda rows: np.ones_like(rows) * [each[: rows.shape[1]] for each in values]


FORGERIES: list[tuple[str, str, str, Edit]] = [  # place, base, what, edit; all under rule `tube`
    *(("slab", name, "the first slab is missing", of_tube(lambda s: s[1:])) for name in NAMES),
    *(("node", name, "the last slab is missing", of_tube(lambda s: s[:-1])) for name in NAMES if name == "decay"),
    *(("slab 2", name, "the second slab is missing", of_tube(lambda s: [s[0], *s[2:]])) for name in NAMES),
    *(("slab 1", name, "the start elsewhere", centre(-1, plus(0.25))) for name in NAMES),
    *(("slab 1", name, "the start on the other side", centre(-1, times(-1))) for name in NAMES if name != "swing"),
    *(("slab 2", name, "a centre that the flow leaves", centre(1, plus(0.25))) for name in NAMES),
    *(("slab 2", name, "a centre that stays", stays) for name in NAMES),
    *(("slab 3", name, "too slow", number("evidence.tube.2.duration", lambda h: 4 * h)) for name in NAMES),
    *(("slab 3", name, "too fast", number("evidence.tube.2.duration", lambda h: h / 4)) for name in NAMES),
    ("node 5", "decay", "the last centre outside of {V <= c2}", centre(4, lambda _: [2.5])),
    ("node 5", "decay", "the last centre on the edge of {V <= c2}", centre(4, lambda _: [2.0])),
    ("node 5", "decay", "the last ellipsoid just outside", centre(4, lambda _: [math.nextafter(1, 2)])),
    ("node 5", "decay", "the last ellipsoid touches the edge", centre(4, lambda _: [1.0])),
    ("node 5", "decay", "the last ellipsoid touches the other edge", centre(4, lambda _: [-1.0])),
    ("node 5", "decay", "the last ellipsoid larger", array("evidence.tube.4.end", times(0.75))),
    ("node 0", "decay", "the start's centre on the edge of the domain", centre(-1, lambda _: [6.0])),
    ("node 0", "decay", "the start's centre beyond the domain", centre(-1, lambda _: [-8.0])),
    ("node 0", "decay", "the start touches the domain", centre(-1, lambda _: [5.0])),
    ("node 0", "decay", "the start touches the domain below", centre(-1, lambda _: [-5.0])),
    ("node 0", "decay", "the start leaves a smaller domain", at("plant.domain.0", ["-6", "5"])),
    ("node 2", "decay", "a centre beyond the domain", centre(2, lambda _: [-6.5])),
    ("node 2", "decay", "a centre so near to the edge that a neighbour's ellipsoid leaves", centre(2, lambda _: [5.0])),
    ("node 0", "swing", "a centre beyond the domain in one state", centre(0, lambda v: [v[0], 2.5])),
    ("middle 2", "decay", "a middle that leaves the domain", array("evidence.tube.1.middle", lambda _: [0.1])),
    ("middle 1", "decay", "a middle of zeros", array("evidence.tube.0.middle", times(0))),
    ("node 0", "decay", "a start of zeros", array("claim.start", times(0))),
    ("node 0", "swing", "a start that is not symmetric", array("claim.start", lambda v: v * [1, 1.0001, 1, 1])),
    ("node 3", "swing", "an end that is not definite", array("evidence.tube.2.end", lambda v: v * [1, 1, 1, -1])),
    *(("slab 1", name, "a larger start", array("claim.start", times(0.5))) for name in NAMES),
    *(("slab 2", name, "an end larger", array("evidence.tube.1.end", times(3))) for name in NAMES),
    *(("slab 3", name, "a share of 0", of_path(2, "share", 0.0)) for name in NAMES),
    *(("slab 3", name, "a share of -0", of_path(2, "share", -0.0)) for name in NAMES),
    *(("slab 3", name, "a share of 1", of_path(2, "share", 1.0)) for name in NAMES),
    *(("slab 3", name, "a share beyond 1", of_path(2, "share", 1.5)) for name in NAMES),
    *(("slab 3", name, "a negative share", of_path(2, "share", -0.5)) for name in NAMES),
    *(("slab 3", name, "the least share", of_path(2, "share", LEAST)) for name in ("decay", "bent")),
    *(("slab 3", name, "a share too large for the ball", of_path(2, "share", 0.51)) for name in NAMES),
    *(("slab 3", name, "a negative edge", number("evidence.tube.2.path.edge", lambda k: -k)) for name in NAMES),
    *(("slab 3", name, "the least negative edge", of_path(2, "edge", -LEAST)) for name in NAMES),
    *(("slab 3", name, "no edge", of_path(2, "edge", 0.0)) for name in NAMES),
    *(("slab 3", name, "a huge edge", of_path(2, "edge", 1e9)) for name in NAMES),
    *(("slab 3", name, "a negative motion", number("evidence.tube.2.path.motion", lambda q: -q)) for name in NAMES),
    *(("slab 3", name, "the least negative motion", of_path(2, "motion", -LEAST)) for name in NAMES),
    *(("slab 3", name, "no motion", of_path(2, "motion", 0.0)) for name in NAMES),
    *(("slab 3", name, "a huge motion", of_path(2, "motion", 1e9)) for name in NAMES),
    *(("slab 3", name, "a negative joint", of_path(2, "joint", -LEAST)) for name in NAMES),
    *(("slab 3", name, "J too small", array("evidence.tube.2.J", times(0.99))) for name in NAMES),
    *(("slab 3", name, "J of zeros", array("evidence.tube.2.J", times(0))) for name in NAMES),
    *(("slab 3", name, f"row {k} negative", rows(2, row(k, -1.0))) for k in range(3) for name in NAMES),
    *(("slab 3", name, "no beta and a g of 0", rows(2, of_three([[1, 1], [0, 0], [0, 1]]))) for name in NAMES),
    *(
        ("slab 3", name, "no beta and a joint of 0", lambda d: of_path(2, "joint", 0.0)(rows(2, row(1, 0.0))(d)))
        for name in NAMES
    ),
    ("slab 3", "bent", "no beta and a small joint", lambda d: of_path(2, "joint", LEAST)(rows(2, row(1, 0.0))(d))),
    ("slab 3", "bent", "no beta and a large joint", lambda d: of_path(2, "joint", 1e9)(rows(2, row(1, 0.0))(d))),
    ("slab 3", "swing", "a large alpha", rows(2, row(0, 1e9))),
    ("slab 3", "swing", "a small alpha", rows(2, row(0, 1e-30))),
    ("slab 3", "swing", "a large beta", rows(2, row(1, 1e9))),
    ("slab 3", "swing", "a small beta", rows(2, row(1, 1e-9))),
    *(("slab 1", name, "a duration of 0", at("evidence.tube.0.duration", (0.0).hex())) for name in NAMES),
    *(("slab 1", name, "a negative duration", number("evidence.tube.0.duration", lambda h: -h)) for name in NAMES),
    (
        "slab 1",
        "decay",
        "a pole on the path",
        at("plant.dynamics.0", ["+", ["-", "x"], ["*", "0", ["/", "1", ["-", "x", "7/2"]]]]),
    ),
    (
        "slab 1",
        "decay",
        "growth on the path alone",
        lambda d: with_ball(edited(d, "plant.dynamics.0", ["+", ["-", "x"], ["*", "1/8", ["**", "x", 2]]])),
    ),
]  # fmt: skip


@pytest.mark.parametrize(
    ("place", "name", "edit"), [pytest.param(p, n, e, id=f"{n}: {what}") for p, n, what, e in FORGERIES]
)
def test_forgeries(place: str, name: str, edit: Edit) -> None:
    verdict = rules.judge(dump(edit(honest(name))))
    assert (verdict.result, verdict.rule) == ("REJECTED", "tube"), verdict.detail
    assert str(verdict.at).startswith(place)


@pytest.mark.parametrize("name", slow_after(2, NAMES))
def test_the_checker_says_the_same(name: str) -> None:
    """Of the honest tube and of each forgery, by the rule that refuses it."""
    edits = [edit for _, base, _, edit in FORGERIES if base == name]
    assert len(edits) > 25 and said_by_the_checker(honest(name)) == "ACCEPTED"
    for edit in edits:
        assert said_by_the_checker(edit(honest(name))) == "tube"


HARMLESS: list[tuple[str, str, Edit]] = [
    *((name, "a smaller start", array("claim.start", times(1.001))) for name in NAMES),
    *((name, "J with another sign", array("evidence.tube.2.J", times(-1))) for name in NAMES),
    *((name, "a joint of 0 that nobody needs", of_path(2, "joint", 0.0)) for name in NAMES),
    *((name, "the least multipliers of the path changed", number("evidence.tube.2.path.edge", times(1.0001)))
      for name in NAMES),
    ("swing", "components taken jointly", lambda d: of_path(2, "joint", 0.01)(
        rows(2, lambda v: [v[0], [0, 0], [0.01, 0.01]])(d))),
    *((name, "a weight in other units", array("evidence.tube.2.weight", times(1e9))) for name in NAMES),
    ("oscillator", "no weight where nothing is bent", array("evidence.tube.2.weight", times(0))),
    ("decay", "a larger domain", at("plant.domain.0", ["-7", "8"])),
    ("decay", "the last ellipsoid just inside", array("evidence.tube.4.end", lambda _: [1.001])),
]  # fmt: skip


@pytest.mark.parametrize(("name", "edit"), [pytest.param(n, e, id=f"{n}: {what}") for n, what, e in HARMLESS])
def test_harmless_edits(name: str, edit: Edit) -> None:
    assert judge(edit(honest(name))) is None


# ------------------------------------------------------------------------------------------------------- the file


def enlarged(data: Document) -> Document:
    """With the paths, and so malformed."""
    return without("claim", "centre")(edited(data, "claim.kind", "enlarged"))


def pathless(data: Document) -> Document:
    return edited(data, "evidence.tube", lambda slabs: [each | {"path": None} for each in slabs])


TRUSTED = {"kind": "trusted-solver", "solver": "dReal", "version": "4", "precision": (0.5).hex(), "queries": []}
PATH_KEYS = ("centre", "share", "edge", "motion", "joint")
MALFORMED: dict[str, Edit] = {
    "version 4": at("schema", "certify-certificate/4"),
    "no path at all": pathless,
    "no path in one slab": at("evidence.tube.1.path", None),
    "a slab that does not know of paths": without("evidence.tube.1", "path"),
    "paths under claim enlarged": enlarged,
    "one path under claim enlarged": lambda d: edited(
        enlarged(d), "evidence.tube", lambda s: [s[0], *(v | {"path": None} for v in s[1:])]
    ),
    "a centre under claim enlarged": lambda d: edited(pathless(d), "claim.kind", "enlarged"),
    "no centre": without("claim", "centre"),
    "no start": without("claim", "start"),
    "an empty tube": at("evidence.tube", []),
    "a tube under claim asymptotic": at("claim", {"kind": "asymptotic", **CONTINUOUS}),
    "a centre under claim asymptotic": lambda d: edited(
        edited(d, "claim", {"kind": "asymptotic", **CONTINUOUS, "centre": encode([0.0])}), "evidence.tube", []
    ),
    "a solver's word": at("evidence", TRUSTED),
    "a centre of another size": at("claim.centre", encode([1.0, 2.0])),
    "a centre that is not a number": at("claim.centre", encode([math.nan])),
    "a slab's centre of another size": at("evidence.tube.0.path.centre", encode([1.0, 2.0])),
    "a slab's centre that is infinite": at("evidence.tube.0.path.centre", encode([math.inf])),
    "g with the motion's number in the array": rows(0, lambda v: [*v.ravel(), 1.0]),
    "g without a row": rows(0, lambda v: v[:2]),
    "multipliers with a column for the motion": rows(0, lambda v: np.ones((3, 2))),
    "multipliers as an object": at(
        "evidence.tube.0.multipliers", {key: encode([1.0]) for key in ("alpha", "beta", "g")}
    ),
    "a weight without a row for the motion": at("evidence.tube.0.weight", encode(np.eye(1))),
    "a weight with a column for the motion": at("evidence.tube.0.weight", encode([1.0, 0.0])),
    "a weight for two motions": at("evidence.tube.0.weight", encode(np.eye(3))),
    "a weight of the ball for a motion": at("evidence.local.weight", encode(np.eye(2))),
    "a weight that is not a number": at("evidence.tube.0.weight", encode([1.0, 0.0, 0.0, math.nan])),
    "no weight": without("evidence.tube.0", "weight"),
    "a weight of the path": more("evidence.tube.0.path", "weight", encode(np.eye(2))),
    "a path that knows more": more("evidence.tube.0.path", "velocity", encode([1.0])),
    "a path that is a list": at("evidence.tube.0.path", []),
    **{f"no {key}": without("evidence.tube.0.path", key) for key in PATH_KEYS},
    **{f"{key} decimal": at(f"evidence.tube.0.path.{key}", "0.5") for key in PATH_KEYS},
    **{f"{key} an integer": at(f"evidence.tube.0.path.{key}", 1) for key in PATH_KEYS},
    **{f"{key} infinite": at(f"evidence.tube.0.path.{key}", "inf") for key in PATH_KEYS},
    **{f"{key} no number": at(f"evidence.tube.0.path.{key}", "nan") for key in PATH_KEYS},
    **{f"{key} null": at(f"evidence.tube.0.path.{key}", None) for key in PATH_KEYS},
}


@pytest.mark.parametrize("what", MALFORMED)
def test_malformed(what: str) -> None:
    data = MALFORMED[what](honest("decay"))
    assert judge(data) == "format" and said_by_the_checker(data) == "format"


# ------------------------------------------------------------------------------------------------------ inputs, clips


def inputs_of(data: Document) -> list[Any]:
    """The model of the input on each slab."""
    return [u[0] for u, _ in models_of(data)]


def models_of(data: Document) -> list[tuple[list[Model], list[Model]]]:
    """Those of the inputs and of F on each slab, wide as the file's ball."""
    c = read(dump(data))
    loop, result = Loop(c), []
    places = [c.centre, *(each.path.centre for each in c.evidence.tube)]  # type: ignore[union-attr]
    for each, (before, after) in zip(c.evidence.tube, itertools.pairwise(places), strict=True):  # type: ignore[union-attr]
        w = (after - before) / (2 * fmpq(*each.path.share.as_integer_ratio()))  # type: ignore[union-attr,operator]
        wide = fmpq_mat([[*a, b] for a, b in zip(each.ball.J.tolist(), w.entries(), strict=True)])
        m = (before + after) / 2  # type: ignore[operator]
        result.append(
            (inputs_on(c, wide, m), loop.within(loop.known(wide, "tube", "slab", m), (), "tube", "slab").components)
        )
    return result


def test_the_inputs_on_a_slab() -> None:
    """Bounds that the models reach on the first slab, where the input is far from u_eq, to the one side alone."""
    lows = [float((u.v - u.radius).lower()) for u in inputs_of(swing_of())]
    assert min(lows) == lows[0] < 1.05 * lows[1] < 0
    for bound, place in ((1.001 * lows[0], None), (0.999 * lows[0], "slab 1")):
        limit = f"{round(1e9 * bound)}/1000000000"
        verdict = rules.judge(dump(edited(swing_of(), "plant.input_bounds.0", [limit, "1"])))
        assert (verdict.rule, verdict.at) == (place and "inputs", place), verdict.detail


@pytest.mark.slow
def test_a_clip_must_not_act_on_a_slab() -> None:
    """Where the input is far from 0 the clip is seen from there, and not from u_eq."""
    reach = [float((abs(u.v) + u.radius).upper()) for u in inputs_of(swing_of())]
    between = (max(reach) + min(reach)) / 2
    for limit, found in ((1.001 * max(reach), None), (0.999 * max(reach), "tube"), (between, "tube")):
        data = swing_of(clip=((-limit,), (limit,)))
        verdict = rules.judge(dump(data))
        assert verdict.rule == found, verdict.detail
        assert found is None or "left alone by the clip" in str(verdict.detail)


@pytest.mark.parametrize("name", NAMES)
def test_the_models_on_a_slab_hold_at_every_point(name: str) -> None:
    """F in floats, at points of the wide ball; and the models are not much wider than they need to be."""
    data, generator = honest(name), np.random.default_rng(5)
    places = [decode(data["claim"]["centre"]), *(decode(s["path"]["centre"]) for s in data["evidence"]["tube"])]
    for (_, F), each, (before, after) in zip(
        models_of(data), data["evidence"]["tube"], itertools.pairwise(places), strict=True
    ):
        n = len(before)
        wide = np.column_stack([square(each["J"]), after - before])  # share 1/2
        d = generator.standard_normal((n + 1, 200))
        d *= generator.choice([1, 1, 0.3], 200) * (1 - 1e-12) / np.linalg.norm(d, axis=0)
        truth = F_of(name, (before + after)[:, None] / 2 + wide @ d)
        for f, values in zip(F, truth, strict=True):
            left = values - float(f.v) - numbers(f.a).T[0] @ d - curves(f, d)
            assert (np.abs(left) <= np.einsum("ib,ij,jb->b", d, numbers(f.whole), d) + 1e-12).all()


POLICIES: list[tuple[str, str, str]] = [
    ("tanh", "preactivation", "1/4"),
    ("tanh", "output", "1/4"),
    ("tanh", "none", "1/8"),
    ("identity", "output", "-3/8"),
    ("identity", "none", "1/8"),
]


@pytest.mark.parametrize(("squash", "centring", "u_eq"), POLICIES)
def test_the_policy_away_from_the_origin(squash: str, centring: str, u_eq: str) -> None:
    """Its value and gradient at a centre, by the formulas of the claim in floats; at the origin it is u_eq."""
    generator = np.random.default_rng(7)
    bias = 0.0 if centring == "none" else 1.0
    sizes = ((3, 2), (3, 3), (1, 3))
    layers = [(generator.standard_normal(s), bias * generator.standard_normal(s[0])) for s in sizes]
    scale, offset, rest = -0.75, 0.125, float(Fraction(u_eq))
    data = make(
        ["y", ["-", "x"]], layers, np.eye(2), (0.5, 0.5), states="xy", domain=[("-3", "3")] * 2, u_eq=[u_eq],
        squash=squash, centre=centring, scale=[scale], offset=[offset],
    )  # fmt: skip

    def net(x: np.ndarray) -> np.ndarray:
        for k, (W, b) in enumerate(layers):
            x = W @ (np.tanh(x) if k else x) + b[:, None]
        return x[0]

    def policy(x: np.ndarray) -> np.ndarray:
        squashed: Callable[[Any], Any] = np.tanh if squash == "tanh" else lambda v: v
        at_0 = net(np.zeros((2, 1)))
        if centring == "preactivation":
            result: np.ndarray = scale * np.tanh(net(x) - at_0 + np.arctanh((rest - offset) / scale)) + offset
            return result
        raw = scale * squashed(net(x)) + offset
        return raw - scale * squashed(at_0) - offset + rest if centring == "output" else raw

    c = read(dump(data))
    assert abs(policy(np.zeros((2, 1)))[0] - rest) < 1e-14
    J = exactly(np.array([[0.05, 0.01, 0.02], [0.0, 0.04, -0.03]]))
    wide = np.array([[float(v) for v in each] for each in arb_mat(J).tolist()])
    (u,) = inputs_on(c, J)
    assert u.v == arb(fmpq(*Fraction(u_eq).as_integer_ratio()))
    for centre in generator.uniform(-2, 2, (20, 2)):
        (u,) = inputs_on(c, J, fmpq_mat(2, 1, [fmpq(*float(v).as_integer_ratio()) for v in centre]))
        assert abs(float(u.v) - policy(centre[:, None])[0]) < 1e-13
        d = generator.standard_normal((3, 300))
        d *= (1 - 1e-12) / np.linalg.norm(d, axis=0)
        left = policy(centre[:, None] + wide @ d) - float(u.v) - numbers(u.a).T[0] @ d - curves(u, d)
        assert (np.abs(left) <= np.einsum("ib,ij,jb->b", d, numbers(u.whole), d) + 1e-12).all()
        assert np.abs(left).max() < 0.005  # the first three orders are right, or else it is of that size


# ------------------------------------------------------------------------------------------------------ the inequality


def hints(J: Any, alpha: Any, beta: Any, g: Any, weight: Any = None) -> Ball:
    rows_of = (floats("d", list(values)) for values in (alpha, beta, g))
    return Ball(exactly(np.atleast_2d(J)), *rows_of, exactly(np.eye(len(g)) if weight is None else weight))


def motion(share: float, edge: float, motion: float) -> Motion:
    return Motion(fmpq_mat(1, 1), share, edge, motion)


def scalar(f: float, a: float, w: float, *, P: float = 1.0, R: float = 0.0, edge: float, move: float) -> bool:
    """R z^2 + 2 P z (f + a z + w sigma) < 0 where P z^2 = 1 and |sigma| <= 1/2."""
    flat = np.zeros((2, 2))
    F = [model(f, [a, w], flat, flat)]
    path, (P_, R_) = motion(0.5, edge, move), (exactly(np.array([[value]])) for value in (P, R))
    return decreases_along(hints([[1.0]], [0.0], [TINY], [1.0, 1.0]), path, P_, R_, field(F))


GRID = np.geomspace(1e-3, 1e3, 121)


def some(f: float, a: float, w: float, **more: float) -> bool:
    """With any edge and motion."""
    return any(scalar(f, a, w, edge=k, move=q * k * 4, **more) for k in GRID for q in GRID[GRID < 1][::-6])


@pytest.mark.slow
def test_the_edge_in_one_state() -> None:
    """For P = 1 it is negative at z = 1 and z = -1 while |f| + |w|/2 < -a - R/2; f and w apart meet their edge."""
    assert some(0.98, -1.0, 0.0) and not some(1.0, -1.0, 0.0) and some(-0.98, -1.0, 0.0)
    assert some(0.0, -1.0, 1.8) and not some(0.0, -1.0, 2.0) and some(0.0, -1.0, -1.8)
    assert some(0.0, -1.0, 0.0, R=1.95) and not some(0.0, -1.0, 0.0, R=2.0)
    assert some(0.0, 1.0, 0.0, R=-2.05) and not some(0.0, 1.0, 0.0, R=-2.0)
    assert some(0.49, -1.0, 0.0, P=4.0) and not some(0.5, -1.0, 0.0, P=4.0)
    assert some(0.48, -1.0, 0.95) and not some(0.5, -1.0, 1.0)


def test_neither_edge_nor_motion_need_be_asked_not_to_be_negative_here() -> None:
    """What multiplies sigma^2 and 1 has to be positive by itself; rule `tube` asks all the same."""
    for k, q in itertools.product((-4.0, -1.0, -LEAST, 0.0, 0.5), (-8.0, -LEAST, 0.0)):
        assert not scalar(0.0, -1.0, 0.0, edge=k, move=q)
    assert not scalar(0.0, -1.0, 0.0, edge=1.0, move=4.0) and scalar(0.0, -1.0, 0.0, edge=1.0, move=3.999)


@pytest.mark.parametrize("bad", ["nan", "inf", "-inf", "[0 +/- inf]"])
@pytest.mark.parametrize("part", ["v", "a", "Q", "K", "E", "B", "L", "R"])
@pytest.mark.parametrize("multipliers", [([0.0], [1.0], [1.0, 1.0]), ([1.0], [0.0], [1.0, 1.0])])
def test_what_is_not_finite_does_not_decrease(bad: str, part: str, multipliers: Any) -> None:
    one, zero, path = fmpq_mat([[1]]), fmpq_mat(1, 1), motion(0.5, 1.0, 2.0)
    F, behind = model(0.0, [-9, 0], np.zeros((2, 2)), np.zeros((2, 2)), B=[1.0]), units([[1.0]], [0.1 * np.eye(2)])
    assert decreases_along(hints([[1.0]], *multipliers), path, one, zero, field([F], behind))
    number_of = {"v": 1, "a": 2, "Q": 4, "K": 4, "E": 4, "B": 1, "L": 1, "R": 3}[part]
    for place in range(number_of):
        changed, units_of = F, behind
        if part == "v":
            changed = dataclasses.replace(F, v=arb(bad))
        elif part == "B":
            changed = dataclasses.replace(F, B=(arb(bad),))
        elif part == "L":
            units_of = dataclasses.replace(behind, L=arb_mat([[arb(bad)]]))
        elif part == "R":
            units_of = dataclasses.replace(
                behind, R=[[arb(bad) if k == place else v for k, v in enumerate(behind.R[0])]]
            )
        else:
            M = getattr(F, part)
            entries = [arb(bad) if k == place else v for k, v in enumerate(M.entries())]
            changed = dataclasses.replace(F, **{part: arb_mat(M.nrows(), M.ncols(), entries)})
        assert not decreases_along(hints([[1.0]], *multipliers), path, one, zero, field([changed], units_of))


@pytest.mark.parametrize("n", slow_after(1, [1, 2, 3]))
@pytest.mark.parametrize("kind", ["apart", "jointly"])
def test_what_decreases_does_so_at_every_point(n: int, kind: str) -> None:
    """Systems at random, near the edge; remainders and errors take the worst sign and size that their bounds allow.

    With the terms of edge and motion, at every point of the ball: that is what the three coefficients of a slab share.
    """
    generator, answers = np.random.default_rng(n), []
    for _ in range(150):
        size = generator.uniform(0, 0.3) / n**2
        Q, E = size * generator.standard_normal((2, n, n + 1, n + 1))
        Q, E = (Q + Q.transpose(0, 2, 1)) / 2, np.einsum("iab,icb->iac", E, E) / max(size, 1e-9) / n
        K = size / n * generator.standard_normal((n, (n + 1) * (n + 2) * (n + 3) // 6))
        inputs, L = generator.standard_normal((n, 2)), generator.standard_normal((2, 3))
        S = generator.standard_normal((3, n + 1, n + 1))
        S = 0.3 * size / n * np.einsum("qab,qcb->qac", S, S)
        B, R = generator.standard_normal((2, n, n))
        P, R = B @ B.T + np.eye(n), 0.1 / n * (R + R.T)
        P = (P + P.T) / 2
        share = float(generator.uniform(0.2, 0.8))
        J = np.linalg.inv(np.linalg.cholesky(P)).T / np.sqrt(1 - share**2)
        a = (-np.eye(n) + 0.2 / n * generator.standard_normal((n, n))) @ J
        a = np.column_stack([a, 0.2 * generator.standard_normal(n)])
        f = 0.1 * generator.standard_normal(n)
        k = float(generator.uniform(0.3, 1.5))
        q = float(generator.uniform(0.2, 0.9)) * k / share**2
        F = [model(*each) for each in zip(f, a, Q, E, K, inputs.tolist(), strict=True)]
        beta = size * np.ones(n) if kind == "apart" else np.zeros(n)
        C = generator.standard_normal((n + 1, n + 1))
        weight = [np.eye(n + 1), C @ C.T, C][generator.integers(3)]
        alpha = size * generator.choice([0, 1], n)
        multipliers = hints(J, alpha, beta, n * size * np.ones(n + 1) + 1e-9, weight)
        answer = decreases_along(multipliers, motion(share, k, q), exactly(P), exactly(R), field(F, units(L, S)))
        answers.append(answer)
        if not answer:
            continue
        for direction in generator.standard_normal((200, n + 1)):
            d = direction * generator.choice([1, 1, 0.5]) * (1 - 1e-12) / np.linalg.norm(direction)
            z, b = d[:-1], P @ J @ d[:-1]
            known = f + a @ d + np.array([curves(each, d[:, None])[0] for each in F])
            worst = np.sign(b) * np.array([d @ each @ d for each in E])
            errors = inputs @ L @ (np.sign(b @ inputs @ L) * np.array([d @ each @ d for each in S]))
            W = z @ J.T @ P @ J @ z
            form = z @ J.T @ R @ J @ z + 2 * b @ (known + worst + errors) + k * (W - 1) + q * (share**2 - d[-1] ** 2)
            assert form < 0
    assert 5 < sum(answers) < 145


# ----------------------------------------------------------------------------------------------------- small pieces


@given(st.fractions(0, max_denominator=10**6) | st.floats(0, 1e300).map(Fraction))
@example(Fraction(0))
@example(Fraction(LEAST))
@example(Fraction(1, 3))
@example(Fraction(2**53 - 1, 2**53))
def test_a_root_is_bounded_from_above(value: Fraction) -> None:
    r = root_above(fmpq(*value.as_integer_ratio()))
    above = Fraction(int(r.p), int(r.q))
    assert value <= above**2 <= value * (1 + Fraction(1, 2**60))


@pytest.mark.parametrize("value", [Fraction(0), Fraction(4), Fraction(9, 16), Fraction(1, 2**80)])
def test_roots_of_squares_are_exact(value: Fraction) -> None:
    r = root_above(fmpq(*value.as_integer_ratio()))
    assert Fraction(int(r.p), int(r.q)) ** 2 == value


def test_a_centre_has_to_lie_inside_of_the_domain() -> None:
    """Also where the square of its distance would be large enough."""
    c = read(dump(honest("decay")))
    for x, most, found in (
        (5, 1, "x"), (5, fmpq(99, 100), None), (-5, 1, "x"), (-5, fmpq(99, 100), None), (6, 0, "x"), (-6, 0, "x"),
        (60, 1, "x"), (-60, 1, "x"), (0, 36, "x"), (0, 35, None),
    ):  # fmt: skip
        assert beyond_domain(c, [fmpq(most)], fmpq_mat([[x]])) == found


# ----------------------------------------------------------------------------------------------------- what is true


@given(
    st.lists(st.tuples(st.floats(-3, 3), st.floats(0.1, 2), st.floats(0.02, 2)), min_size=1, max_size=3),
    st.floats(-4, 4),
    st.floats(0.1, 2),
    st.floats(1.0, 1.3),
    st.sampled_from([0.125, 0.5, 0.75]),
)
@example([(3.0, 1.0, 9 / 32), (2.25, 1.0, 9 / 32)], 4.0, 1.0, 1.0, 0.5)
@example([(3.0, 1.0, 9 / 32), (2.25, 1.0, 9 / 320)], 4.0, 1.0, 1.0, 0.5)
@example([(0.0, 1.0, 1.0)], 0.0, 1.01, 1.0, 0.5)
def test_no_tube_is_narrower_than_the_flow(
    tube_of: list[tuple[float, float, float]], start: float, radius: float, wide: float, share: float
) -> None:
    """x' = -x takes [c - r, c + r] into e^-h times itself, whatever a file says of centres, radii and times."""
    data = honest("decay")
    with ctx.workprec(PRECISION):
        loop, before, r, slabs, low, high, kept = Loop(read(dump(data))), start, radius, [], 0.0, 0.0, True
        low, high = start - radius, start + radius
        for centre, r_after, h in tube_of:
            shapes = [np.array([[v**-2]]) for v in (r, (r + r_after) / 2, r_after)]
            slab = along(loop, [np.array([before]), np.array([centre])], shapes, h, share)
            slab["J"] = encode(decode(slab["J"]) * wide)
            slabs.append(slab)
            low, high = low * math.exp(-h), high * math.exp(-h)
            kept = kept and centre - r_after <= low + 1e-9 and high <= centre + r_after + 1e-9
            before, r = centre, r_after
    data = edited(
        data, "claim", {"kind": "reached", **CONTINUOUS, "start": encode([radius**-2]), "centre": encode([start])}
    )
    if judge(edited(data, "evidence.tube", slabs)) is None:
        assert kept and abs(before) + r <= 2 + 1e-9


def test_some_of_those_tubes_are_accepted() -> None:
    """The property above is not empty: a few of its kind at random."""
    generator, accepted = np.random.default_rng(3), 0
    data = honest("decay")
    loop = Loop(read(dump(data)))
    for _ in range(40):
        x, h = generator.uniform(-3, 3), generator.uniform(0.1, 0.6)
        centres = [np.array([x]), np.array([x * math.exp(-h)])]
        shapes = [np.eye(1) * 1.5**-2, np.eye(1) * 1.4**-2, np.eye(1) * 1.3**-2]
        claim = {"kind": "reached", **CONTINUOUS, "start": encode(shapes[0]), "centre": encode(centres[0])}
        tried = edited(edited(data, "claim", claim), "evidence.tube", [along(loop, centres, shapes, h)])
        accepted += judge(edited(tried, "levels", {"local": (16.0).hex(), "roa": (16.0).hex()}) | {
            "evidence": tried["evidence"] | {"root": encode([4.0]), "local": centred([[4.5]], [[0.0], [1.0], [0.0]])}
        }) is None  # fmt: skip
    assert 5 <= accepted < 40


@pytest.mark.parametrize("reach", [2.05, 3.0])
def test_no_path_helps_a_start_beyond_the_region_of_attraction(reach: float) -> None:
    """x' = x/2 - tanh(x), whose origin attracts |x| < 1.915008: with a path that goes inwards all the same."""
    base = make([["+", ["/", "x", "2"], "u"]], [([[1.0]], [0.0])], 1.0, (0.25, 0.25), domain=[("-9", "9")])
    for count, h in itertools.product((1, 4, 16), (0.05, 0.3, 3.0)):
        centres = [np.array([v]) for v in np.linspace(reach, 0.1, count + 1)]
        assert judge(follow(base, centres, [np.eye(1) * 100] * (count + 1), [h] * count)) == "tube"


# ----------------------------------------------------------------------------------------------- beside the checker


def said_by_the_checker(data: Document) -> str:
    try:
        return verdict_of_the_checker(data)
    except Rejected as no:  # its reader raises, its rules are caught
        return no.rule


EDGES: list[tuple[str, Callable[[Document, float], Document]]] = [  # how an edit grows, from 0 on
    ("share", lambda d, s: number("evidence.tube.3.path.share", lambda v: v * (1 - s))(d)),
    ("edge", lambda d, s: number("evidence.tube.3.path.edge", lambda v: v * (1 + s))(d)),
    ("motion", lambda d, s: number("evidence.tube.3.path.motion", lambda v: v * (1 - s))(d)),
    ("duration", lambda d, s: number("evidence.tube.3.duration", lambda v: v * (1 - s))(d)),
    ("centre", lambda d, s: centre(3, plus(s))(d)),
    ("start", lambda d, s: centre(-1, plus(-s))(d)),
    ("middle", lambda d, s: array("evidence.tube.3.middle", times(1 + s))(d)),
    ("J", lambda d, s: array("evidence.tube.3.J", times(1 + 9 * s))(d)),
]


@pytest.mark.slow
@pytest.mark.parametrize("name", slow_after(1, ["bent", "swing"]))
@pytest.mark.parametrize(("what", "edit"), slow_after(1, EDGES))
def test_the_checker_draws_the_same_line(what: str, edit: Callable[[Document, float], Document], name: str) -> None:
    """How far a number can be moved before a file is refused: the same for two programs."""
    ends = []
    for accepts in (lambda d: judge(d) is None, lambda d: said_by_the_checker(d) == "ACCEPTED"):
        low, high = 0.0, 1.0
        assert accepts(edit(honest(name), low)) and not accepts(edit(honest(name), high))
        while high - low > 1e-4:
            middle = (low + high) / 2
            low, high = (middle, high) if accepts(edit(honest(name), middle)) else (low, middle)
        ends.append(low)
    assert abs(ends[0] - ends[1]) < 2e-4 < ends[0]


@pytest.mark.slow
def test_a_tube_that_the_engine_finds(tmp_path: Path) -> None:
    """Of the pendulum that ships, from far outside of its local level: both programs accept it, or neither."""
    policy = load_policy(SHIPPED / "pendulum.pt")
    state = {"theta": Fraction(26, 10), "theta_dot": Fraction(-3)}
    options = RoaOptions(candidate="lqr", max_boxes=1, effort=0.16, reach_from=state)
    result = certify_roa(get_system("pendulum"), policy.network, tmp_path, options)
    assert result.claim == "reached" and result.certificate is not None
    data = json.loads(result.certificate.read_bytes())
    assert data["claim"]["kind"] == "reached" and len(data["evidence"]["tube"]) > 5
    assert judge(data) is None and said_by_the_checker(data) == "ACCEPTED"
    slabs = data["evidence"]["tube"]
    for edit in (
        of_tube(lambda _: slabs[:-1]),
        of_tube(lambda _: slabs[1:]),
        centre(-1, times(1.5)),
        centre(len(slabs) // 2, times(1.2)),
        array("claim.start", times(0.5)),
        number("evidence.tube.4.duration", lambda h: h / 2),
        number("evidence.tube.4.duration", lambda h: h * 2),
        number("evidence.tube.4.path.share", lambda v: v / 8),
        array("evidence.tube.4.J", times(0.5)),
    ):
        assert judge(edit(data)) == said_by_the_checker(edit(data)) == "tube"


# -------------------------------------------------------------------------------------------- every clause is needed


def one(_: Motion, __: str) -> fmpq:
    return fmpq(1, 2)


def unmoved(loop: Loop, slab: Any, path: Motion, centres: Any, at: str) -> Field:
    """As if the path stood at its end: no velocity, and no motion."""
    J = fmpq_mat([[*each, 0] for each in slab.ball.J.tolist()])
    return loop.within(loop.known(J, "tube", at, centres[1]), (), "tube", at)


CLAUSES: dict[str, tuple[Any, str, Callable[..., Any], Edit]] = {  # where, what it says instead, the forgery
    "the last node": (tube, "ends_inside", yes, of_tube(lambda slabs: slabs[:3])),
    "the ball": (tube, "contains", yes, array("evidence.tube.0.J", times(0.75))),
    "the share": (tube, "share_of", one, of_path(0, "share", -0.5)),
    "the multipliers": (tube, "sound_multipliers", lambda *_: None, of_path(0, "joint", -1.0)),
    "what decreases": (tube, "decreases_along", yes, number("evidence.tube.0.duration", lambda h: h / 8)),
    "the domain": (tube, "beyond_domain", lambda *_: None, at("plant.domain.0", ["-6", "5"])),
    "the velocity": (
        tube, "relative", unmoved,
        lambda d: edited(follow_still(d), "claim.centre", encode([0.5])),
    ),
}  # fmt: skip


def follow_still(data: Document) -> Document:
    """Around 0, and accepted as such, before somebody moves its first centre, in a time far too short for that."""
    data = edited(edited(data, "claim", {"kind": "asymptotic", **CONTINUOUS}), "evidence.tube", [])
    return follow(data, [np.zeros(1), np.zeros(1)], [np.eye(1), np.eye(1) * 1.03125], [1 / 32])


@pytest.mark.parametrize("clause", CLAUSES)
def test_with_a_clause_disabled_a_forgery_gets_through(clause: str, monkeypatch: pytest.MonkeyPatch) -> None:
    module, name, instead, edit = CLAUSES[clause]
    data = edit(honest("decay"))
    assert judge(data) == "tube"
    monkeypatch.setattr(module, name, instead)
    assert judge(data) is None


def test_a_path_that_stands_still_is_a_path() -> None:
    assert judge(follow_still(honest("decay"))) is None


COEFFICIENTS = ["first", "middle", "last"]


@pytest.mark.parametrize("which", COEFFICIENTS)
def test_every_coefficient_of_a_slab_is_asked(which: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A slab that stands still around 0, the loop linear, in which two of the three coefficients are negative."""
    data, A = honest("oscillator"), np.array([[0.0, 1.0], [-2.0, -3.0]])
    generator, h, number_of = np.random.default_rng(2), 4.0, COEFFICIENTS.index(which)
    while True:
        first, middle, last = (30 * (np.eye(2) + B @ B.T) for B in generator.standard_normal((3, 2, 2)))
        rates = (2 * (middle - first) / h, (last - first) / h, 2 * (last - middle) / h)
        each = zip(rates, (first, middle, last), strict=True)
        worst = [float(np.linalg.eigvalsh(rate + A.T @ P + P @ A)[-1]) for rate, P in each]
        if worst.pop(number_of) > 1 and max(worst) < -1:
            break
    zero, J = np.zeros(2), around(first, middle, last) / math.sqrt(1 - 0.25)
    path = {
        "centre": encode(zero),
        "share": (0.5).hex(),
        "edge": (0.0009).hex(),
        "motion": (0.0018).hex(),
        "joint": "0x0.0p+0",
    }
    slab = slab_of(middle, last, h) | ball(J, [[0.0] * 2, [TINY] * 2, [0.0] * 2], np.eye(3)) | {"path": path}
    claim = {"kind": "reached", **CONTINUOUS, "start": encode(first), "centre": encode(zero)}
    data = edited(edited(data, "claim", claim), "evidence.tube", [slab])
    verdict = rules.judge(dump(data))
    assert (verdict.rule, verdict.at) == ("tube", "slab 1") and f"the {which} coefficient" in str(verdict.detail)
    asked = itertools.count()

    def spared(*arguments: Any) -> bool:
        return next(asked) == number_of or decrease.decreases_along(*arguments)

    monkeypatch.setattr(tube, "decreases_along", spared)
    assert judge(data) is None


# ------------------------------------------------------------------------------------------------------ what is printed


def test_the_claim_in_words(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert command.main([str(write(honest("decay"), tmp_path))]) == 0
    claim, verdict = capsys.readouterr().out.splitlines()
    assert "starts in (x - c_0)'P_0 (x - c_0) <= 1 reaches V <= 4.0 after the sum of the durations (1.40625)" in claim
    assert claim.endswith("P_0 = [[1.0]]; c_0 = [4.0]") and verdict.startswith("ACCEPTED c1=4.0 c2=4.0 sha256=")


def test_the_claim_in_json(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert command.main([str(write(honest("decay"), tmp_path)), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["result"], said["claim"], said["start"]) == ("ACCEPTED", "reached", [[1.0]])
    assert (said["centre"], said["time"]) == ([4.0], 1.40625)
