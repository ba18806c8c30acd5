"""Attacks on claim `reached`: tubes around a path. Each forgery breaks one clause, and both checkers refuse it.

`glide` is x' = -x with every number of its tube worked out by hand, `well` is x' = x^3 - x, whose origin attracts
exactly |x| < 1, and the rotors are pendulums under random networks, with tubes that the engine finds. What the
inequalities say is also asked of the loops themselves, of the true field at points of every edge, of the models at
points of the ball, and, exactly, of the worst that models allow.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from fractions import Fraction
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from flint import arb, ctx, fmpq, fmpq_mat
from hypothesis import assume, example, given
from hypothesis import strategies as st

from certify.checker import clauses, tube
from certify.checker.case import Case
from certify.checker.decrease import Models, Multipliers, are_finite
from certify.checker.document import Certificate
from certify.checker.exact import exactly
from certify.checker.sections import Path
from certify.checker.tube import are_all_usable
from tests.checker.test_rules import (
    array,
    at,
    both,
    general,
    leaves_of,
    level,
    linear_claim,
    rehashed,
    rotor_claim,
)
from tests.checker.test_tube import (
    CUBIC,
    NO_CURVATURE,
    NONE,
    Edit,
    ball,
    joint,
    random_loop,
    scalar,
    slabs_to,
    verdicts,
)
from tests.support.balls import enlarged_from, reached_from
from tests.support.certificates import ASYMPTOTIC, Document, decode, edited, encode, make, parse, rehash, verdict
from tests.support.jets import Jet, curved, models_of, no_units, plain, seen, shows, sides
from tests.support.marks import slow_after
from tests.support.oracle import ball as exact
from tests.support.oracle import policy_in_arb, quadratic
from tests.support.reached import attracted, field_in_arb, loop_of, nodes_before, rates_outwards, surrounded

# ------------------------------------------------------------------------------------------------- honest certificates

RADIUS, STEP = 0.25, 2.0 ** (-1 / 3)


def waypoint(centre: Sequence[float], share: float, edge: float, motion: float, joint: float = 1.0) -> Document:
    numbers = {"share": share, "edge": edge, "motion": motion, "joint": joint}
    return {"centre": encode(centre)} | {key: float(value).hex() for key, value in numbers.items()}


def moved(before: float, after: float, h: float, radius: float, *, slower: float = 0.0, share: float = 0.5) -> Document:
    """A slab of x' = -(1 - slower) x for {|x - c| <= radius} on its way, with the best multipliers there are.

    With e = x - c, alpha = F - v in the middle and |F - v - alpha + e| <= (1 - slower) half, half the way that c goes,
    2 P e (F - v) < 0 where P e^2 = 1 if and only if (|alpha| + (1 - slower) half) / radius < 1 - slower.
    """
    alpha = -(1 - slower) * (before + after) / 2 - (after - before) / h
    line, motion = abs(alpha) / radius + 2.0**-12, (1 - slower) * abs(after - before) / 2 / radius + 2.0**-12
    J, P = radius * math.sqrt(1 / (1 - share**2)) * (1 + 2.0**-20), encode([1 / radius**2])
    path = waypoint([after], share, line + motion, motion / share**2)
    return (
        {"middle": P, "end": P, "duration": h.hex(), "path": path}
        | ball(J, NO_CURVATURE)
        | {"weight": encode(np.eye(2))}
    )


def glide(
    *, slower: float = 0.0, radius: float = RADIUS, dynamics: Any = None, share: float = 0.5, side: int = 1
) -> Document:
    """From |x - 2| <= 1/4 by lines between points of the flow into |x| < 1; on the other side from |x + 2| <= 1/4."""
    centres = [side * 2 * STEP**k for k in range(7)]
    h = -math.log(STEP)
    slabs = [moved(a, b, h, radius, slower=slower, share=share) for a, b in itertools.pairwise(centres)]
    return following(dynamics or ["-", "x"], 1.0, ball(1.5, NO_CURVATURE), 1 / radius**2, centres[0], slabs)


def following(
    dynamics: Any, c: float, local: Document, start: float, centre: float, slabs: Any, **more: Any
) -> Document:
    """In V = x^2 with c1 = c2 = c: the tree is a leaf of which nothing is asked."""
    data = scalar(dynamics, c, local, start, slabs, **more)
    data["claim"] = reached_from([start], [centre])
    return data


@cache
def well(centre: float = 0.7, radius: float = 0.08) -> Document:
    """x' = x^3 - x from |x - centre| <= radius into |x| < 1/2, by the engine."""
    data = scalar(CUBIC, 0.25, ball(0.5005, joint()), 1.0, [])
    found = surrounded(edited(data, "claim", ASYMPTOTIC), [centre], [[1 / radius**2]])
    assert found is not None
    return found


ROTORS: dict[str, tuple[dict[str, Any], tuple[float, float]]] = {
    "rotor": ({}, (0.4, 0.0)),
    "rotor, preactivation": ({"centre": "preactivation"}, (0.25, 0.1)),
    "clipped rotor": ({"clip": ([-1.0], [2.0])}, (0.3, 0.0)),
}


@cache
def rotor(name: str = "rotor") -> Document:
    """Of two states; of `rotor` no input bound holds by form."""
    more, centre = ROTORS[name]
    found = surrounded(attracted(rotor_claim(**more), 0.03), centre, [[100.0, 0.0], [0.0, 100.0]])
    assert found is not None
    return found


@cache
def linear() -> Document:
    """A double integrator under a linear policy, without centring; an ellipsoid that is no ball."""
    found = surrounded(attracted(linear_claim(0.25, 0.25), 0.25), [0.8, -0.5], [[60.0, 10.0], [10.0, 20.0]])
    assert found is not None
    return found


@cache
def spatial() -> Document:
    """Of three states and two inputs, with a quotient, a root and products; an asymmetric domain."""
    dynamics = [
        ["+", ["-", "x"], ["/", ["*", "y", "z"], ["+", "4", "x"]], ["*", "1/4", "u"]],
        ["+", ["*", "-3/2", "y"], ["*", "1/2", "x"], ["*", "1/3", "z", ["-", ["sqrt", ["+", "4", "x"]], "2"]], "v"],
        ["+", ["*", "-2", "z"], ["*", "1/2", ["-", ["cos", "y"], "1"]], ["*", "1/4", ["-", ["exp", "x"], "1"]]],
    ]
    generator = np.random.default_rng(3)
    layers = [(0.5 * generator.standard_normal((4, 3)), generator.uniform(-1, 1, 4)),
              (0.5 * generator.standard_normal((2, 4)), [0.1, 0.2])]  # fmt: skip
    data = make(
        dynamics, layers, np.eye(3), (0.05, 0.05), states="xyz", inputs="uv", u_eq=["0", "0"], centre="output",
        domain=[("-2", "5/2")] * 3, input_bounds=[("-9", "9")] * 2, scale=[0.5, -0.25], offset=[0.0, 0.25],
    )  # fmt: skip
    found = surrounded(attracted(data, 0.05), [0.6, -0.4, 0.3], np.eye(3) * 64)
    assert found is not None
    return found


HONEST: dict[str, Callable[[], Document]] = {
    "glide": glide,
    "well": well,
    **{name: lambda name=name: rotor(name) for name in ROTORS},
    "linear": linear,
    "spatial": spatial,
}


def kinked(size: float) -> Document:
    """x' = -x + s |x - 1| - s from |x - 2.3125| <= 3/2, by one slab that has the kink in its middle, into |x| < 1.9.

    With s = 10 states above 20/9 go off; the abs has no slope in the middle of the slab, and is an error there.
    """
    dynamics = ["+", ["-", "x"], ["*", str(Fraction(size)), ["abs", ["-", "x", "1"]]], str(-Fraction(size))]
    before, after, radius, share = 2.3125, -0.3125, 1.5, 0.5
    half = (before - after) / 2
    line, motion = 2.0**-12, half / radius + 2.0**-12
    J, P = radius * math.sqrt(1 / (1 - share**2)) * (1 + 2.0**-20), encode([1 / radius**2])
    path = waypoint([after], share, line + motion, motion / share**2)
    one = {"middle": P, "end": P, "duration": (2 * half / (1 + size)).hex(), "path": path}
    one |= ball(J, NO_CURVATURE) | {"weight": encode(np.eye(2))}
    local = ball(1.9, [[10.0 if size > 1 else 0.125], [NONE], [0.0]])
    return following(dynamics, 3.6, local, 1 / radius**2, before, [one], root=[2.5])


@pytest.mark.parametrize(("size", "said"), [(10, "tube"), (1 / 4, "tube"), (1 / 32, "ACCEPTED")])
def test_a_kink_in_the_middle_of_a_slab_is_an_error_of_first_order(size: float, said: str) -> None:
    assert verdicts(kinked(size)) == {said}


@pytest.mark.parametrize("name", slow_after(4, HONEST))
def test_honest_tubes_around_a_path_are_accepted(name: str) -> None:
    data = HONEST[name]()
    assert verdicts(data) == {"ACCEPTED"}
    assert len(data["evidence"]["tube"]) > 5


@pytest.mark.parametrize("name", HONEST)
def test_without_its_tube_each_is_an_asymptotic_claim(name: str) -> None:
    data = edited(edited(HONEST[name](), "evidence.tube", []), "claim", ASYMPTOTIC)
    assert verdicts(data) == {"ACCEPTED"}


@pytest.mark.parametrize("share", [0.01, 0.25, 1 / 3, 0.99, 1 - 2.0**-20])
def test_any_share_will_do_where_nothing_bends(share: float) -> None:
    assert verdicts(glide(share=share)) == {"ACCEPTED"}


# ------------------------------------------------------------------------------------------------------------ forgeries

START, CENTRE, FIRST, SECOND = "claim.start", "claim.centre", "evidence.tube.0", "evidence.tube.1"


def times(path: str, factor: float) -> Edit:
    return array(path, lambda a: a * factor)


def plus(path: str, i: int, step: float) -> Edit:
    def change(a: np.ndarray) -> np.ndarray:
        a[i] += step
        return a

    return array(path, change)


def number(path: str, value: float | Callable[[float], float]) -> Edit:
    def change(text: str) -> str:
        return float(value(float.fromhex(text)) if callable(value) else value).hex()

    return lambda data: edited(data, path, change)


def entry(path: str, i: int, value: float) -> Edit:
    def change(a: np.ndarray) -> np.ndarray:
        a[i] = value
        return a

    return array(path, change)


def last(key: str, change: Callable[[np.ndarray], np.ndarray]) -> Edit:
    return lambda data: array(f"evidence.tube.{len(data['evidence']['tube']) - 1}.{key}", change)(data)


def term(i: int, tree: Any) -> Edit:
    return lambda data: edited(data, f"plant.dynamics.{i}", lambda old: ["+", old, tree])


def shifted(data: Document) -> Document:
    """All centres moved together: each slab is as long as before, and somewhere else."""
    data = plus(CENTRE, 0, 0.1)(data)
    for k in range(len(data["evidence"]["tube"])):
        data = plus(f"evidence.tube.{k}.path.centre", 0, 0.1)(data)
    return data


def touching(data: Document) -> Document:
    """A domain whose upper end the start's ellipsoid reaches in the first state, and goes beyond by a millionth."""
    P, c = decode(data["claim"]["start"]), decode(data["claim"]["centre"])
    n = len(c)
    reach = math.sqrt(np.linalg.inv(P.reshape(n, n))[0, 0]) * (1 - 1e-6)
    return edited(data, "plant.domain.0.1", str(Fraction(float(c[0] + reach))))


def copied(key: str, of: int, to: int) -> Edit:
    return lambda data: edited(data, f"evidence.tube.{to}.{key}", data["evidence"]["tube"][of][key])


FORGERIES: list[tuple[str, str, Edit]] = [  # of the rotor
    *[(f"a start that is larger by {1 / f:.3g}", "tube", times(START, f)) for f in (0.9, 0.5, 0.01)],
    ("a start of 0", "tube", times(START, 0)),
    ("a negative start", "tube", times(START, -1)),
    ("an indefinite start", "tube", entry(START, 3, -100.0)),
    ("a start that is not symmetric by one bit", "tube", entry(START, 1, 5e-324)),
    *[(f"the centre is moved by {d} along state {i}", "tube", plus(CENTRE, i, d))
      for i in (0, 1) for d in (0.05, -0.05, 1e3)],
    *[(f"the centre is moved by 1/2 along state {i}", "inputs", plus(CENTRE, i, 0.5)) for i in (0, 1)],
    ("the centre is on the other side", "inputs", times(CENTRE, -1)),
    ("the centre lies out of the domain", "tube", entry(CENTRE, 0, 3.5)),
    ("the centre lies at the origin", "inputs", times(CENTRE, 0)),
    *[(f"slab 3 ends {d} off along state {i}", "tube", plus("evidence.tube.3.path.centre", i, d))
      for i in (0, 1) for d in (0.03, -0.03, 1e9)],
    ("the path stands still for a slab", "tube", lambda d: edited(d, f"{FIRST}.path.centre", d["claim"]["centre"])),
    ("all centres are moved together", "tube", shifted),
    ("two slabs change places", "tube", slabs_to(lambda s: [*s[:3], s[4], s[3], *s[5:]])),
    ("slabs in the other order", "tube", slabs_to(lambda s: s[::-1])),
    ("the first slab is missing", "tube", slabs_to(lambda s: s[1:])),
    ("the last slab is missing", "tube", slabs_to(lambda s: s[:-1])),
    ("a slab is missing", "tube", slabs_to(lambda s: s[:4] + s[5:])),
    ("a slab stands twice", "tube", slabs_to(lambda s: [*s[:5], *s[4:]])),
    ("the last slab alone", "tube", slabs_to(lambda s: s[-1:])),
    *[(f"a duration is {v}", "tube", number("evidence.tube.2.duration", v))
      for v in (0.0, -0.0, -0.02, 5e-324, -5e-324, 2.0**-1000, 1e308)],
    *[(f"a duration is {f} of itself", "tube", number("evidence.tube.2.duration", lambda h, f=f: h * f))
      for f in (0.1, 0.5, 0.8, 2.0, 10.0)],
    *[(f"the share is {v}", "tube", number(f"{SECOND}.path.share", v))
      for v in (0.0, -0.0, 1.0, -0.25, 1.5, 0.5, 1e300, 1 - 2.0**-53)],
    ("the share is as good as nothing", "inputs", number(f"{SECOND}.path.share", 5e-324)),
    ("the share is that of another sign and J as large as one likes", "tube", both(
        number(f"{SECOND}.path.share", lambda v: -v), times(f"{SECOND}.J", 2))),
    *[(f"{key} is {v}", "tube", number(f"{SECOND}.path.{key}", v))
      for key in ("edge", "motion") for v in (0.0, -0.0, -5e-324, -1e9, 1e300)],
    *[(f"joint is {v}", "tube", number(f"{SECOND}.path.joint", v)) for v in (0.0, -0.0, -5e-324, -1.0, 1e300)],
    *[(f"multiplier {i} is negative", "tube", entry(f"{SECOND}.multipliers", i, -5e-324)) for i in range(6)],
    ("all multipliers are 0", "tube", times(f"{SECOND}.multipliers", 0)),
    ("all multipliers are negative", "tube", times(f"{SECOND}.multipliers", -1)),
    ("alpha is huge", "tube", entry(f"{SECOND}.multipliers", 1, 1e300)),
    *[(f"J is {f} of itself", "tube", times(f"{SECOND}.J", f)) for f in (0.0, 0.9)],
    *[(f"J is {f} of itself", "inputs", times(f"{SECOND}.J", f)) for f in (1e150, 3.0)],
    ("J has a column of 0", "tube", array(f"{SECOND}.J", lambda a: a * [1, 0, 1, 0])),
    ("J of another slab", "tube", copied("J", -1, 1)),
    *[(f"the middle is {f} of itself", "tube", times(f"{SECOND}.middle", f)) for f in (-1.0, 0.0, 0.5, 0.9, 1.2, 5.0)],
    *[(f"the end is {f} of itself", "tube", times(f"{SECOND}.end", f)) for f in (-1.0, 0.0, 0.5, 0.9, 1.2, 5.0)],
    ("the middle is not symmetric by one bit", "tube", array(f"{SECOND}.middle", lambda a: np.nextafter(
        a, a * [1, 2, 1, 1]))),
    ("the last ellipsoid is larger", "tube", last("end", lambda a: 0.5 * a)),
    ("the last centre lies further out", "tube", last("path.centre", lambda a: 1.3 * a)),
    ("the last centre lies beyond {V <= c2}", "tube", last("path.centre", lambda a: a + 1)),
    ("c2 is smaller", "tube", both(level("local", 2.0**-7), level("roa", 2.0**-7))),
    ("c2 is larger", "root", both(level("local", 0.3), level("roa", 0.3))),
    ("c2 is larger, and the root", "local", both(level("local", 0.3), level("roa", 0.3), times("evidence.root", 5))),
    ("P is larger", "tube", times("lyapunov.P", 2)),
    ("P is smaller", "root", times("lyapunov.P", 0.5)),
    ("the domain is touched", "tube", touching),
    ("less torque than the path takes", "inputs", at("plant.input_bounds", [["-1/4", "5/2"]])),
    ("a clip that the path alone meets", "tube", rehashed("clip", [encode([-0.4]), encode([2.5])])),
    *[(f"a plant with {tree} more", rule, term(1, tree)) for rule, tree in (
        ("tube", ["*", "4", ["**", "theta", 3]]),
        ("local", ["*", "20", ["**", "theta", 4]]),  # of fourth order, for which the local alphas leave no room
        ("local", ["*", "80", ["**", "theta", 5]]),
        ("tube", ["*", "4", "theta", ["-", "1", ["cos", ["*", "2", "theta"]]]]))],
    ("a pole on the path alone", "tube", term(1, ["/", ["*", "1/999999", ["**", "theta", 2]], ["-", "theta", "2/5"]])),
    ("the same, times 0", "tube", term(1, ["*", "0", ["/", ["**", "theta", 2], ["-", "theta", "2/5"]]])),
    ("a root on the path alone", "tube", term(1, ["*", "1/999999", "theta", "theta", ["sqrt", ["-", "2/5", "theta"]]])),
    ("another policy", "hash", times("policy.layers.0.weight", 1.01)),
    ("another policy, rehashed", "tube", lambda d: rehash(times("policy.layers.0.weight", 1.1)(d))),
    ("not at rest", "equilibrium", term(1, "1/1000000000")),
    ("the origin of another u_eq", "equilibrium", at("plant.u_eq", ["1/4"])),
]  # fmt: skip


@pytest.mark.parametrize(("rule", "edit"), [pytest.param(rule, edit, id=what) for what, rule, edit in FORGERIES])
def test_forgeries(rule: str, edit: Edit) -> None:
    forged = edit(rotor())
    assert forged != rotor()
    assert verdicts(forged) == {rule}


def test_every_field_of_a_tube_around_a_path_has_a_forgery() -> None:
    before = dict(leaves_of(rotor()))
    touched = set()
    for _, _, edit in FORGERIES:
        after = dict(leaves_of(edit(rotor())))
        touched |= {general(path) for path in before.keys() | after.keys() if before.get(path) != after.get(path)}
    assert {general(path) for path in before if path.startswith(("claim.", "evidence.tube."))} - touched == {
        "claim.kind", "claim.rate", "claim.sample", "claim.outer"
    }  # fmt: skip


OF_GLIDE: list[tuple[str, str, Callable[[], Document]]] = [
    ("slower by 3 %", "tube", lambda: at("plant.dynamics", [["*", "-97/100", "x"]])(glide(slower=0.03))),
    ("slower by 5 %, with the multipliers of the honest plant", "tube", lambda: glide(dynamics=["*", "-19/20", "x"])),
    ("faster by 5 %", "tube", lambda: glide(dynamics=["*", "-21/20", "x"])),
    ("slower at the path's begin alone", "tube", lambda: glide(dynamics=["-", ["/", ["**", "x", 3], "90"], "x"])),
    ("a radius less than the lines miss by", "tube", lambda: glide(radius=0.21)),
    ("a domain that the start touches", "tube", lambda: at("plant.domain", [["-9", "9/4"]])(glide())),
    ("a domain that the start touches below", "tube", lambda: at("plant.domain", [["-9/4", "9"]])(glide(side=-1))),
    ("a domain that the first end touches", "tube", lambda: at("plant.domain", [["-9", "2"]])(glide())),
    ("a start around another centre", "tube", lambda: entry(CENTRE, 0, 2.1)(glide())),
    ("a ball that misses the motion alone", "tube", lambda: times(f"{FIRST}.J", 0.9)(glide())),
    ("a share that leaves no room", "tube", lambda: number(f"{FIRST}.path.share", 0.51)(glide())),
    ("no tube arrives at a point of the edge", "tube", lambda: edited(glide(), "evidence.tube", lambda s: s[:2])),
    ("nothing moves", "tube", lambda: edited(glide(), "evidence.tube", [moved(2.0, 2.0, 1.0, 1.9)])),
]  # fmt: skip


@pytest.mark.parametrize(("rule", "make_it"), [pytest.param(rule, data, id=what) for what, rule, data in OF_GLIDE])
def test_forgeries_by_hand(rule: str, make_it: Callable[[], Document]) -> None:
    assert verdicts(make_it()) == {rule}


NEXT: dict[str, Callable[[], Document]] = {
    "slower by 2 %": lambda: at("plant.dynamics", [["*", "-49/50", "x"]])(glide(slower=0.02)),
    "a radius that the lines miss by": lambda: glide(radius=0.225),
    "a domain beyond the start": lambda: at("plant.domain", [["-9", "2251/1000"]])(glide()),
    "a domain beyond the start below": lambda: at("plant.domain", [["-2251/1000", "9"]])(glide(side=-1)),
    "a mirrored ball": lambda: times(f"{FIRST}.J", -1)(glide()),
    "a smaller start": lambda: times(START, 1.0)(glide()),
    "joint for nothing": lambda: number(f"{FIRST}.path.joint", 0.0)(glide()),
    "a smaller share": lambda: number(f"{FIRST}.path.share", 0.499)(glide()),
}


@pytest.mark.parametrize("name", NEXT)
def test_next_to_forgeries(name: str) -> None:
    """So it is the clause that refuses, and nothing else."""
    assert verdicts(NEXT[name]()) == {"ACCEPTED"}


MALFORMED: dict[str, Edit] = {
    "no centre": lambda d: edited(d, "claim", lambda c: {k: v for k, v in c.items() if k != "centre"}),
    "no start": lambda d: edited(d, "claim", lambda c: {k: v for k, v in c.items() if k != "start"}),
    "a centre for nothing": at("claim.kind", "enlarged"),
    "a path under enlarged": lambda d: edited(d, "claim", enlarged_from(decode(d["claim"]["start"]))),
    "a path under asymptotic": at("claim", ASYMPTOTIC),
    "a centre of another size": at(CENTRE, encode([1.0, 2.0])),
    "a centre that is not finite": at(CENTRE, encode([math.inf])),
    "no path": at(f"{FIRST}.path", None),
    "no path on a later slab": at("evidence.tube.5.path", None),
    "an empty path": at(f"{FIRST}.path", {}),
    "a path without its share": lambda d: edited(d, f"{FIRST}.path", lambda p: {k: p[k] for k in p if k != "share"}),
    "a path with a velocity": lambda d: edited(d, f"{FIRST}.path", lambda p: p | {"velocity": p["centre"]}),
    "a centre of two states": at(f"{FIRST}.path.centre", encode([1.0, 1.0])),
    "NaN in a path": at(f"{FIRST}.path.centre", encode([math.nan])),
    "an infinite edge": at(f"{FIRST}.path.edge", "inf"),
    "an edge in decimals": at(f"{FIRST}.path.edge", "0.5"),
    "a motion as a number": at(f"{FIRST}.path.motion", 1),
    "multipliers of n + 1": at(f"{FIRST}.multipliers", encode(np.ones((3, 2)))),
    "version 4": at("schema", "certify-certificate/4"),
    "a solver's word": at("evidence", {
        "kind": "trusted-solver", "solver": "s", "version": "1", "precision": "0x1.0000000000000p-10", "queries": []}),
}  # fmt: skip


@pytest.mark.parametrize("name", MALFORMED)
def test_malformed_paths(name: str) -> None:
    assert verdicts(MALFORMED[name](glide())) == {"format"}


@pytest.mark.parametrize("value", [None, False, 0, 3, "", "a text", [], [[]], {}, {"a": []}], ids=repr)
def test_a_value_of_another_type_is_malformed(value: Any) -> None:
    data = glide()
    for path in [*(f"claim{p}" for p in ("", ".start", ".centre")), f"{FIRST}.path", FIRST, *(
        f"{FIRST}.path.{key}" for key in ("centre", "share", "edge", "motion", "joint"))]:  # fmt: skip
        assert verdict(edited(data, path, value)) == "format", path


# ------------------------------------------------------------------------------ planted violations, of a few per cent


def growth(c: Certificate, directions: int, seed: int = 0) -> tuple[arb, arb]:
    """The largest dW/dt that is found where W = 1, and the largest |dW/dt|."""
    generator, rates = np.random.default_rng(seed), []
    n = len(c.states)
    for slab, before in zip(c.tube.slabs, nodes_before(c), strict=True):
        points = generator.standard_normal((directions, n)) if n > 1 else np.array([[1.0], [-1.0]])
        for s in (Fraction(0), Fraction(1, 2), Fraction(1)):
            rates += [rate for rate, _ in rates_outwards(c, before, slab, s, points)]
    return max(rates), max(abs(rate) for rate in rates)


PLANTED: dict[str, tuple[Callable[[], Document], int, Any]] = {  # base, component, what grows there
    "glide, x": (glide, 0, "x"),
    "glide, x^2": (glide, 0, ["**", "x", 2]),
    "glide, -x^3": (glide, 0, ["-", ["**", "x", 3]]),
    "well, x^2": (well, 0, ["**", "x", 2]),
    "rotor, theta^2": (rotor, 1, ["**", "theta", 2]),
    "rotor, -theta^2": (rotor, 1, ["-", ["**", "theta", 2]]),
    "rotor, omega^2": (rotor, 0, ["**", "omega", 2]),
    "rotor, theta omega": (rotor, 0, ["*", "theta", "omega"]),
    "linear, x1^2": (linear, 1, ["**", "x1", 2]),
    "linear, x2^3": (linear, 0, ["**", "x2", 3]),
    "spatial, x^2": (spatial, 0, ["**", "x", 2]),
    "spatial, y z": (spatial, 1, ["*", "y", "z"]),
}


@pytest.mark.parametrize("name", slow_after(5, PLANTED))
def test_planted_violations_are_refused(name: str) -> None:
    """The least term that breaks condition 7' where it is looked, by at most 5 % of the largest rate."""
    base, i, tree = PLANTED[name]
    data, low, high = base(), 0.0, 1.0

    def planted(size: float) -> Document:
        return term(i, ["*", str(Fraction(size)), tree])(data)

    with ctx.workprec(100):
        assert growth(parse(data), 8)[0] < 0
        while not growth(parse(planted(high)), 8)[0] > 0:
            low, high = high, 2 * high
            assert high < 1e6
        for _ in range(12):
            middle = (low + high) / 2
            low, high = (low, middle) if growth(parse(planted(middle)), 8)[0] > 0 else (middle, high)
        rate, size = growth(parse(planted(high)), 8)
    assert 0 < rate < size / 20
    assert verdict(planted(high)) in ("tube", "local")  # a term of first order may break the claim at the origin first


# --------------------------------------------------------------------------- what the claim says, asked of the loops


@pytest.mark.parametrize("name", HONEST)
def test_nothing_leaves_the_tube_where_the_true_field_is_asked(name: str) -> None:
    """In ball arithmetic: every rate where W = 1 is negative, such x lie in the domain, their inputs in the bounds."""
    c = parse(HONEST[name]())
    generator, highest = np.random.default_rng(5), -math.inf
    with ctx.workprec(120):
        for slab, before in zip(c.tube.slabs, nodes_before(c), strict=True):
            for s in (Fraction(0), Fraction(1), Fraction(int(generator.integers(1, 999)), 1000)):
                directions = generator.standard_normal((6, len(c.states)))
                for rate, x in rates_outwards(c, before, slab, s, directions):
                    assert rate < 0
                    highest = max(highest, float(rate.mid()))
                    u = policy_in_arb(c.policy, c.u_eq, x)
                    assert all(exact(lo) < v < exact(hi) for v, (lo, hi) in zip(x, c.domain, strict=True))
                    assert all(exact(lo) <= v <= exact(hi) for v, (lo, hi) in zip(u, c.input_bounds, strict=True))
    assert highest > -10


@pytest.mark.parametrize("name", HONEST)
def test_runs_stay_in_the_tube_and_arrive(name: str) -> None:
    """By Runge and Kutta's method, from the start's edge."""
    data = HONEST[name]()
    c, loop = parse(data), loop_of(data)
    function, n, steps = loop.system.function(), len(c.states), 16

    def field(x: np.ndarray) -> np.ndarray:
        return np.asarray(function(x, loop.policy(x)))

    generator = np.random.default_rng(6)
    inverse, widest = np.linalg.inv(np.linalg.cholesky(c.tube.start)).T, 0.0
    for _ in range(4):
        d = generator.standard_normal(n)
        x = c.tube.centre + inverse @ d / np.linalg.norm(d)
        for slab, (P_0, c_0) in zip(c.tube.slabs, nodes_before(c), strict=True):
            h = slab.duration / steps
            for k in range(steps):
                k1 = field(x)
                k2 = field(x + h / 2 * k1)
                k3 = field(x + h / 2 * k2)
                x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + field(x + h * k3))
                s = (k + 1) / steps
                P = (1 - s) ** 2 * P_0 + 2 * s * (1 - s) * slab.middle + s * s * slab.end
                e = x - (1 - s) * c_0 - s * slab.path.centre
                assert e @ P @ e < 1
                widest = max(widest, float(e @ P @ e))
        assert x @ c.P @ x < c.c2
    assert widest > 0.2  # the tube is not a proof of something much weaker


@given(st.floats(0.03, 1.2), st.floats(1.0, 1.3), st.floats(0.01, 0.95), st.integers(1, 5), st.floats(0.05, 3.0))
@example(0.5, 1.0, 0.5, 3, 1.0)
def test_no_path_leads_from_beyond_the_region_of_attraction(
    radius: float, reach: float, share: float, count: int, h: float
) -> None:
    """x' = x^3 - x rests at 1: whatever stands in a tube from a set that holds a point x >= 1 is no proof."""
    centres = np.linspace(reach - radius, 0.0, count + 1).tolist()
    slabs = []
    for a, b in itertools.pairwise(centres):
        slab = moved(a, b, h, radius, share=share)
        slab["end"] = encode([max(4.5, 1 / radius**2)]) if b == 0.0 else slab["end"]
        slabs.append(slab | {"multipliers": encode([[1.0], [0.0], [1.0]])})
    data = following(CUBIC, 0.25, ball(0.5005, joint()), 1 / radius**2, centres[0], slabs)
    assert verdicts(data) == {"tube"}


@given(
    st.floats(-1, 3), st.floats(-1, 3), st.floats(0.01, 3), st.floats(0.05, 2), st.floats(0.01, 0.99), st.floats(0, 0.3)
)
@example(1.0, 0.5, math.log(2), 0.26, 0.5, 0.0)
@example(1.0, 1.0, 1.0, 1.01, 0.5, 0.0)
def test_in_one_state_a_tube_is_shown_exactly_where_there_is_one(
    before: float, after: float, h: float, radius: float, share: float, slower: float
) -> None:
    """x' = -(1 - slower) x: nothing leaves |x - c| <= radius if and only if |F(c) - v| stays below (1 - slower) radius,
    and the worst of these is at one of the ends."""
    rate, v = 1 - slower, (after - before) / h
    worst = max(abs(-rate * c - v) for c in (before, after)) / (rate * radius)
    assume(abs(worst - 1) > 1e-2)
    slabs = [moved(before, after, h, radius, slower=slower, share=share)]
    slabs += [] if abs(after) + radius < 0.99 else [moved(after, 0.0, 1.0, 0.9, slower=slower, share=share)]
    data = following(
        ["*", f"-{Fraction(rate)}", "x"], 1.0, ball(1.5, NO_CURVATURE), 1 / radius**2, before, slabs[:1],
        domain=[("-99", "99")],
    )  # fmt: skip
    case = Case(parse(data))
    (piece,) = tube.pieces(case)
    with np.errstate(all="ignore"):
        assert not list(tube.fits(piece))
        shown = not list(tube.decreases(piece))
    assert shown == (worst < 1)


# ----------------------------------------------------------- edits as large as the checker lets through, and a campaign

Size = Callable[[Document, float, np.random.Generator], Document]


def one_slab(data: Document, generator: np.random.Generator) -> str:
    return f"evidence.tube.{generator.integers(len(data['evidence']['tube']))}"


def scaled(key: str) -> Size:
    return lambda d, size, g: times(f"{one_slab(d, g)}.{key}", 1 + size * float(g.choice([-1, 1])))(d)


def pushed(key: str) -> Size:
    return lambda d, size, g: array(f"{one_slab(d, g)}.{key}", lambda a: a + size * g.standard_normal(len(a)))(d)


def counted(key: str) -> Size:
    return lambda d, size, g: number(f"{one_slab(d, g)}.{key}", lambda v: v * (1 + size * float(g.choice([-1, 1]))))(d)


def bent(key: str) -> Size:
    """Congruent to what it was, and symmetric."""

    def change(data: Document, size: float, generator: np.random.Generator) -> Document:
        def of(a: np.ndarray) -> np.ndarray:
            n = math.isqrt(len(a))
            B = np.eye(n) + size * generator.standard_normal((n, n))
            A = B.T @ a.reshape(n, n) @ B
            return (A + A.T) / 2

        return array(f"{one_slab(data, generator)}.{key}" if key != START else key, of)(data)

    return change


def another_plant(data: Document, size: float, generator: np.random.Generator) -> Document:
    states = data["plant"]["states"]
    i, x, y = int(generator.integers(len(states))), *generator.choice(states, 2)
    k = str(Fraction(size * float(generator.choice([-1, 1]))))
    trees = [["*", k, x, y], ["*", k, ["**", x, 3]], ["*", k, x, ["sin", y]], ["*", k, ["-", ["cos", x], "1"]]]
    return term(i, trees[generator.integers(len(trees))])(data)


def another_policy(data: Document, size: float, generator: np.random.Generator) -> Document:
    path = f"policy.layers.{generator.integers(len(data['policy']['layers']))}.weight"
    return rehash(array(path, lambda a: a * (1 + size * generator.standard_normal(len(a))))(data))


def another_domain(data: Document, size: float, generator: np.random.Generator) -> Document:
    path = f"plant.domain.{generator.integers(len(data['plant']['domain']))}.{generator.integers(2)}"
    return edited(data, path, lambda q: str(Fraction(q) * Fraction(1 - min(size, 0.999))))


SIZED: dict[str, Size] = {
    "a larger start": lambda d, size, g: times(START, 1 / (1 + size))(d),
    "another start": bent(START),
    "another centre": lambda d, size, g: array(CENTRE, lambda a: a + size * g.standard_normal(len(a)))(d),
    "another path": pushed("path.centre"),
    "a duration": counted("duration"),
    "a share": counted("path.share"),
    "an edge": counted("path.edge"),
    "a motion": counted("path.motion"),
    "a joint": counted("path.joint"),
    "multipliers": scaled("multipliers"),
    "a ball": scaled("J"),
    "a middle": bent("middle"),
    "an end": bent("end"),
    "a smaller c2": lambda d, size, g: both(*(
        number(f"levels.{key}", lambda c: c / (1 + size)) for key in ("local", "roa")))(d),
    "another P": lambda d, size, g: times("lyapunov.P", 1 + size)(d),
    "another plant": another_plant,
    "another policy": another_policy,
    "a smaller domain": another_domain,
}  # fmt: skip


def assert_true(data: Document, directions: int) -> None:
    """Condition 7' at points of each slab's edge, and where those lie; the last ellipsoid in {V <= c2}."""
    c = parse(data)
    generator = np.random.default_rng(8)
    with ctx.workprec(100):
        for slab, before in zip(c.tube.slabs, nodes_before(c), strict=True):
            for s in (Fraction(0), Fraction(1, 2), Fraction(1)):
                for rate, x in rates_outwards(
                    c, before, slab, s, generator.standard_normal((directions, len(c.states)))
                ):
                    assert rate < 0
                    assert all(exact(lo) < v < exact(hi) for v, (lo, hi) in zip(x, c.domain, strict=True))
        slab = c.tube.slabs[-1]
        edge = np.linalg.inv(np.linalg.cholesky(slab.end)).T @ generator.standard_normal((len(c.states), 99))
        edge /= np.sqrt(np.einsum("ik,ij,jk->k", edge, slab.end, edge))
        x = slab.path.centre[:, None] + edge
        assert np.all(np.einsum("ik,ij,jk->k", x, c.P, x) < c.c2 * (1 + 1e-12))


def just_accepted(name: str, edit: Size, seed: int) -> Document:
    """The largest size of this edit, in one direction, that the checker lets through, to a part in a thousand."""
    data, low, high = HONEST[name](), 0.0, 1.0

    def of(size: float) -> Document:
        return edit(data, size, np.random.default_rng(seed))

    while high < 2**6 and verdict(of(high)) == "ACCEPTED":
        low, high = high, 4 * high
    for _ in range(10):
        middle = (low + high) / 2 if low else high / 8
        low, high = (middle, high) if verdict(of(middle)) == "ACCEPTED" else (low, middle)
    return of(low)


@pytest.mark.parametrize("what", slow_after(3, SIZED))
def test_what_is_just_accepted_of_a_well_is_true(what: str) -> None:
    assert_true(just_accepted("well", SIZED[what], 1), 2)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in HONEST if name not in ("glide", "well")])
@pytest.mark.parametrize("what", SIZED)
def test_what_is_just_accepted_is_true(what: str, name: str) -> None:
    data = just_accepted(name, SIZED[what], 2)
    assert verdicts(data) == {"ACCEPTED"}
    assert_true(data, 12)


@pytest.mark.slow
@pytest.mark.parametrize("name", HONEST)
def test_edits_at_random_are_refused_or_leave_a_true_claim(name: str) -> None:
    """Two edits at a time, of sizes from 10^-3 to 3: both checkers say the same, but where one of them is tighter, and
    nothing that either accepts is false where it is looked."""
    generator, said = np.random.default_rng(list(HONEST).index(name)), []
    for _ in range(120):
        data = HONEST[name]()
        for what in generator.choice(list(SIZED), 2):
            data = SIZED[what](data, float(10.0 ** generator.uniform(-3, 0.5)), generator)
        answers = verdicts(data)
        said.append("ACCEPTED" in answers)
        if said[-1]:
            assert_true(data, 4)
    assert 0 < sum(said) < len(said)


# ------------------------------------------------------------------------------------------- soundness of the numbers


def placed(data: Document, centre: Sequence[float], after: Sequence[float], share: float, J: np.ndarray) -> Document:
    """A slab around a path that need not be a proof of anything."""
    n = len(centre)
    one = {"middle": encode(np.eye(n)), "end": encode(np.eye(n)), "duration": (1.0).hex(),
           "path": waypoint(after, share, 1.0, 1.0)} | ball(J, np.ones((3, n)))  # fmt: skip
    one["weight"] = encode(np.eye(n + 1))
    data = edited(data, "claim", reached_from(np.eye(n), centre))
    return edited(data, "evidence.tube", [one])


ENCLOSED: dict[str, Callable[[], Document]] = {
    "rotor": rotor_claim,
    "rotor, preactivation": lambda: rotor_claim(centre="preactivation"),
    "linear": linear_claim,
    "spatial": lambda: edited(spatial(), "claim", ASYMPTOTIC),
}
WHERE = ["near", "far", "inexact", "tiny motion", "large motion", "point"]


def state_at(m: Sequence[arb], w: Sequence[arb], J: np.ndarray, d: list[float]) -> list[arb]:
    """m + J z + w sigma, d = (z, sigma)."""
    return [
        p + q * arb(d[-1]) + sum((arb(a) * arb(v) for a, v in zip(row, d, strict=False)), arb(0))
        for p, q, row in zip(m, w, J.tolist(), strict=True)
    ]


def left_over(jet: Jet, change: arb, d: list[float]) -> tuple[arb, arb]:
    """What a jet does not say of v(d) - v(0), and the bound of it."""
    size = sum((arb(v) ** 2 for v in d), arb(0)).sqrt()
    linear = sum((arb(float(a)) * arb(p) for a, p in zip(jet.a, d, strict=True)), arb(0))
    return change - curved(jet, d) - linear, arb(float(jet.slack)) * size + quadratic(jet.whole.tolist(), d)


@pytest.mark.parametrize("where", slow_after(1, WHERE))
@pytest.mark.parametrize("name", ENCLOSED)
def test_the_models_along_a_path_enclose_the_field(name: str, where: str) -> None:
    """F and the inputs at points of balls whose middles and steps binary64 does not hold, without any tolerance."""
    base, generator = ENCLOSED[name](), np.random.default_rng(WHERE.index(where))
    n, met, tight = len(base["plant"]["states"]), 0, 0.0
    for _ in range(12):
        reach = {"near": 1e-3, "far": 1.2, "point": 0.5}.get(where, 0.8)
        first = generator.uniform(-reach, reach, n)
        step = {"tiny motion": 1e-200, "large motion": 0.3, "point": 0.0}.get(where, 0.05)
        after = first + step * generator.standard_normal(n)
        if where == "inexact":  # 1 + 2^-52 and a number far below it: their mean has too many bits
            first, after = first + 2.0**-30, np.ldexp(generator.standard_normal(n), -70)
        J = (0.0 if where == "point" else 0.15) * generator.standard_normal((n, n))
        data = placed(base, first.tolist(), after.tolist(), float(generator.uniform(0.05, 0.95)), J)
        c = parse(data)
        (piece,) = tube.pieces(Case(c))
        with np.errstate(all="ignore"):
            jets = seen([*piece.F(), *piece.inputs])
        if not all(np.isfinite(part).all() for jet in jets for part in (jet.c, jet.error, jet.a, jet.Q, jet.E)):
            continue
        met += 1
        assert piece.motion is not None
        m, w = ([exact(q) for q in part] for part in piece.motion)
        with ctx.workprec(2400):
            points = generator.standard_normal((4, n + 1))
            points *= (np.array([1, 1, 0.9, 1e-6]) / np.linalg.norm(points, axis=1) * (1 - 2**-50))[:, None]
            points[1] = [*[0.0] * n, 1.0]
            at_0 = values(c, m)
            for d in points.tolist():
                size = sum((arb(v) ** 2 for v in d), arb(0)).sqrt()
                for jet, v, v_0 in zip(jets, values(c, state_at(m, w, J, d)), at_0, strict=True):
                    left, known = left_over(jet, v - v_0, d)
                    assert abs(left) <= known
                    assert abs(v_0 - arb(float(jet.c))) <= arb(float(jet.error))
                    assert abs(v - v_0) <= arb(float(jet.radius)) * size
                    if known > 1e-6:
                        tight = max(tight, float((abs(left) / known).mid()))
    assert met > 3
    assert tight > 0.01 or where not in ("far", "large motion") or name == "linear"


@pytest.mark.parametrize("seed", slow_after(1, range(4)))
def test_models_of_random_loops_hold_along_random_paths(seed: int) -> None:
    """Loops, balls and motions of all sizes, at points of the ball: never certainly outside."""
    random, met, tight = np.random.default_rng(seed + 40), 0, 0.0
    while met < 60:
        base, J = random_loop(random)
        n = len(J)
        first, step = (random.standard_normal((2, n)).T * 10.0 ** random.uniform([-3, -4], 0.5)).T
        if random.random() < 0.2:
            first, step = first * 10.0 ** random.uniform(-300, 0), step * 10.0 ** random.uniform(-300, 1)
        share = float(random.choice([random.uniform(0.01, 0.99), 2.0**-40, 1 - 2.0**-40]))
        (piece,) = tube.pieces(Case(parse(placed(base, first.tolist(), (first + step).tolist(), share, J))))
        with np.errstate(all="ignore"):
            jets = seen([*piece.F(), *piece.inputs])
            finite = are_finite([*piece.F(), *piece.inputs])
        if not finite:
            continue
        met += 1
        assert piece.motion is not None
        m, w = ([exact(q) for q in part] for part in piece.motion)
        points = random.standard_normal((3, n + 1))
        points *= (np.array([1, 1, 10.0 ** random.uniform(-6, 0)]) / np.linalg.norm(points, axis=1))[:, None]
        points[1] *= [*[0.01] * n, 1]
        with ctx.workprec(3000):
            c = piece.case.c
            at_0 = values(c, m)
            for d in (points * (1 - 2.0**-50)).tolist():
                for jet, v, v_0 in zip(jets, values(c, state_at(m, w, J, d)), at_0, strict=True):
                    left, known = left_over(jet, v - v_0, d)
                    assert left.is_finite() and not abs(left) > known
                    assert not abs(v_0 - arb(float(jet.c))) > arb(float(jet.error))
                    if known > 1e-9:
                        tight = max(tight, float((abs(left) / known).mid()))
    assert tight > 0.5


def values(c: Certificate, x: list[arb]) -> list[arb]:
    """F, and the inputs."""
    return [*field_in_arb(c, [x])[0], *policy_in_arb(c.policy, c.u_eq, x)]


def quotient(v: float) -> fmpq:
    return fmpq(*float(v).as_integer_ratio())


def random_models(generator: np.random.Generator, n: int) -> tuple[Models, list[Jet], list[fmpq], np.ndarray]:
    """F - v over n + 1 symbols; E is semidefinite exactly: B B' of whole numbers times a power of two."""
    k, jets = n + 1, []
    for _ in range(n):
        B, half = generator.integers(-3, 4, (k, k)), generator.integers(-9, 10, (k, k))
        unit = 2.0 ** generator.integers(-9, 0)
        Q, E = (half + half.T) * unit * generator.choice([0, 1, 1]), B @ B.T * unit * generator.choice([0, 1, 1])
        slack, error = (float(generator.choice([0, 2.0**-4, 2.0**-30])) for _ in range(2))
        jets.append(plain(np.float64(generator.standard_normal()), error, generator.standard_normal(k), slack, Q, E))
    velocity = [quotient(v) for v in generator.standard_normal(n)]
    J = generator.standard_normal((n, n))
    return models_of(J, jets, no_units(k), False, velocity), jets, velocity, J


def multipliers_of(generator: np.random.Generator, n: int, kind: str) -> tuple[Multipliers, Path]:
    alpha = np.exp(generator.standard_normal(n)) * generator.choice([0, 1], n)
    beta = np.exp(generator.standard_normal(n)) * {"apart": 1, "jointly": 0, "both": generator.choice([0, 1], n)}[kind]
    rows = (alpha, beta, np.exp(generator.standard_normal(n)))
    share, edge, motion, joint = (
        float(v) for v in (generator.uniform(0.1, 0.9), *np.exp(generator.standard_normal(3)))
    )
    return Multipliers(*(tuple(quotient(v) for v in row) for row in rows), np.eye(n + 1)), Path(
        np.zeros(n), share, edge, motion, joint
    )


@pytest.mark.parametrize("n", slow_after(2, [1, 2, 3]))
@pytest.mark.parametrize("kind", ["apart", "jointly", "both"])
def test_the_sides_along_a_path_bound_what_they_stand_for(n: int, kind: str) -> None:
    """Exactly, at rational points of the ball, with errors of the worst sign; P and R are symmetric and otherwise
    arbitrary. y'My and the sums are those of FORMAT.md, written down a second time."""
    generator, closest = np.random.default_rng(n), 0.0
    for _ in range(40):
        models, jets, v, J = random_models(generator, n)
        by, path = multipliers_of(generator, n, kind)
        P, R = (generator.integers(-8, 9, (n, n)) / 8 for _ in range(2))
        P, R = exactly(P + P.T), exactly(R + R.T)
        decay, rest = sides(models, P, R, by, path)
        assert decay == decay.transpose() and rest == rest.transpose() and decay.nrows() == n + 2
        for _ in range(8):
            direction = generator.standard_normal(n + 1)
            direction *= generator.choice([1, 1, 0.5, 1e-3]) / np.linalg.norm(direction) * (1 - 2.0**-50)
            d = [quotient(p) for p in direction]
            z, sigma = fmpq_mat(n, 1, d[:n]), d[n]
            e = exactly(J) * z
            y = fmpq_mat(n + 2, 1, [fmpq(1), *d])
            value = (e.transpose() * R * e)[0, 0]
            value += quotient(path.edge) * ((e.transpose() * P * e)[0, 0] - 1)
            value += quotient(path.motion) * (quotient(path.share) ** 2 - sigma * sigma)
            for jet, velocity, along in zip(jets, v, (P * e).entries(), strict=True):
                column = fmpq_mat(n + 2 - 1, 1, d)
                model = (
                    quotient(jet.c) - velocity + sum((quotient(a) * p for a, p in zip(jet.a, d, strict=True)), fmpq(0))
                )
                model += (column.transpose() * exactly(jet.Q) * column)[0, 0]
                most = quotient(jet.error) + (column.transpose() * exactly(jet.E) * column)[0, 0]
                most += quotient(jet.slack) * quotient(
                    float(np.max(np.abs(direction)))
                )  # a gradient off along one axis
                value += 2 * along * model + 2 * abs(along) * most
            left, bound = value + (y.transpose() * decay * y)[0, 0], (y.transpose() * rest * y)[0, 0]
            assert left <= bound
            closest = max(closest, float(int((left / bound).p)) / int((left / bound).q) if bound else 0.0)
    assert closest > 0.2


def test_multipliers_that_a_path_can_use() -> None:
    def by(*rows: list[float]) -> Multipliers:
        return Multipliers(*(tuple(quotient(v) for v in row) for row in rows), np.eye(1))

    def path(edge: float = 1.0, motion: float = 1.0, joint: float = 1.0) -> Path:
        return Path(np.zeros(1), 0.5, edge, motion, joint)

    apart, jointly = by([0.0], [1.0], [0.0]), by([0.0], [0.0], [1.0])
    assert are_all_usable(apart, path(0.0, 0.0, 0.0)) and are_all_usable(jointly, path(0.0, 0.0))
    assert not are_all_usable(jointly, path(joint=0.0))
    for key in ("edge", "motion", "joint"):
        for value in (-5e-324, -1.0, math.nan):
            assert not are_all_usable(apart, path(**{key: value}))


def test_the_homogenised_matrix_is_refused_at_its_edges() -> None:
    """x' - v = alpha - e: shown while |alpha| < radius = 1, whatever stands in for the multipliers beyond that."""

    def shown(alpha: float, edge: float, error: float = 0.0, slack: float = 0.0, E: float = 0.0) -> bool:
        widest = np.zeros((2, 2))
        widest[0, 0] = E
        jet = plain(np.float64(alpha), error, np.array([-1.0, 0.0]), slack, np.zeros((2, 2)), widest)
        models = models_of(np.array([[1.0]]), [jet], no_units(2), False, [fmpq(0)])
        rows = Multipliers((fmpq(0),), (quotient(NONE),), (fmpq(0),), np.eye(2))
        path = Path(np.zeros(1), 0.5, edge, 2 * (error + slack) + 2.0**-20, 0.0)
        return shows(models, exactly(np.eye(1)), fmpq_mat(1, 1), rows, path)

    edges = np.geomspace(1e-6, 1e6, 193).tolist()
    assert shown(0.999, 1.0) and shown(-0.999, 1.0)
    assert not any(shown(alpha, edge) for alpha in (1.0, -1.0, 1.5, -3.0) for edge in edges)
    assert not shown(0.0, 0.0) and not shown(0.0, 2.0) and shown(0.0, 1.0)
    for worst in ((0.2, 0.0, 0.0), (0.0, 0.2, 0.0), (0.0, 0.0, 0.2)):
        assert any(shown(0.5, edge, *worst) for edge in edges)
        assert not any(shown(0.5, edge, *(2.5 * v for v in worst)) for edge in edges)


# ------------------------------------------------------------------------------------------------- where a tube may lie


@pytest.mark.parametrize("name", HONEST)
def test_the_motion_of_a_ball_leads_from_centre_to_centre(name: str) -> None:
    """m - w rho is the centre before, m + w rho the one after, exactly; v is their difference over the time."""
    c = parse(HONEST[name]())
    for piece, (_, before) in zip(tube.pieces(Case(c)), nodes_before(c), strict=True):
        assert piece.motion is not None and piece.velocity is not None and piece.slab.path is not None
        rho, h = Fraction(piece.slab.path.share), Fraction(piece.slab.duration)
        centres = zip(before.tolist(), piece.slab.path.centre.tolist(), strict=True)
        for m, w, v, (a, b) in zip(*piece.motion, piece.velocity, centres, strict=True):
            assert (m - w * rho, m + w * rho) == (Fraction(a), Fraction(b))
            assert Fraction(int(v.p), int(v.q)) * h == Fraction(b) - Fraction(a)


@pytest.mark.parametrize("which", [0, 1])
@pytest.mark.parametrize("side", [0, 1])
@pytest.mark.parametrize("state", [0, 1])
def test_the_ellipsoids_around_both_centres_lie_in_the_domain(which: int, side: int, state: int) -> None:
    """Around (0, 0) and (1, 1)/4, in either order: one side of the domain at a time."""
    data, rows = linear_claim(0.25, 0.25), np.array([[8.0, 5.0], [5.0, 8.0]])
    reach = Fraction(math.sqrt(np.linalg.inv(rows)[0, 0]))
    ends = [Fraction(0), Fraction(1, 4)]
    edge = ends[1] + reach if side else ends[0] - reach  # of the outermost ellipsoid on this side
    centres = [(ends[which], ends[1 - which])] * 2
    for more, expected in ((1 + Fraction(1, 2**30), True), (1 - Fraction(1, 2**30), False)):
        domain = [["-2", "2"], ["-2", "2"]]
        domain[state][side] = str(edge * more)
        assert tube.lies_in(Case(parse(edited(data, "plant.domain", domain))), exactly(rows), centres) is expected


@pytest.mark.parametrize("lo", ["1/4", "1/3"])
def test_a_centre_on_the_domains_edge_or_beyond_lies_nowhere(lo: str) -> None:
    """(P^-1)_ii is compared with a square, which does not know on which side of the edge a centre is."""
    case = Case(parse(edited(glide(), "plant.domain", [[lo, "9"]])))
    inside = (Fraction(5), Fraction(5))
    narrow = exactly(np.array([[2.0**40]]))
    assert tube.lies_in(case, narrow, [inside])
    for centre in (Fraction(1, 4), Fraction(-5), Fraction(9), Fraction(10)):
        assert not tube.lies_in(case, narrow, [(inside[0], centre)])
        assert not tube.lies_in(case, narrow, [(centre, inside[0])])


@pytest.mark.parametrize("matrix", [[[16.0]], [[-1.0]], [[0.0]]])
def test_only_a_definite_matrix_lies_anywhere(matrix: list[list[float]]) -> None:
    case = Case(parse(glide()))
    assert tube.lies_in(case, exactly(np.array(matrix)), [(Fraction(0), Fraction(1))]) is (matrix[0][0] > 0)


@given(st.floats(-0.999, 0.999), st.floats(0.5, 2.0), st.floats(2.0**-20, 2.0**20))
@example(0.5, 1.0 + 2.0**-40, 1.0)
@example(0.5, 1.0 - 2.0**-40, 1.0)
@example(0.0, 1.0, 1.0)
def test_the_last_ellipsoid_in_one_state(centre: float, factor: float, c2: float) -> None:
    """|x - c| <= 1 / sqrt(P_N) in x^2 <= c2: |c| + 1 / sqrt(P_N) < sqrt(c2)."""
    c = Fraction(centre) * Fraction(math.sqrt(c2))
    data = edited(glide(), "levels", {"local": c2.hex(), "roa": c2.hex()})
    left = math.sqrt(c2) - abs(float(c))
    P_N = Fraction(1 / left**2) * Fraction(factor)
    assume(abs(factor - 1) > 1e-12)
    shown = tube.is_attracted(Case(parse(data)), fmpq_mat([[fmpq(P_N.numerator, P_N.denominator)]]), [c])
    assert shown == (factor > 1)


@pytest.mark.parametrize("seed", range(5))
def test_the_last_ellipsoid_is_attracted(seed: int) -> None:
    """In three states, just shown: V stays below c2 on its edge, and comes near to it where it can."""
    generator = np.random.default_rng(seed)
    data, nearest = edited(spatial(), "levels.roa", (2.0).hex()), 0.0
    B = generator.standard_normal((3, 3))
    P = B @ B.T + 0.1 * np.eye(3)
    P = (P + P.T) / 2
    case = Case(parse(edited(data, "lyapunov.P", encode(P))))
    for k in range(10):
        d = generator.standard_normal(3)
        c = d / math.sqrt(d @ P @ d / 2.0) * generator.uniform(0, 1)
        A = np.eye(3) + 0.1 * generator.standard_normal((3, 3))
        shape = P if k == 0 else A.T @ P @ A
        low, high = 1e-9, 1e9
        for _ in range(60):
            middle = math.sqrt(low * high)
            node = exactly((shape + shape.T) / 2 * middle)
            low, high = (low, middle) if tube.is_attracted(case, node, [Fraction(v) for v in c]) else (middle, high)
        edge = generator.standard_normal((4000, 3))
        edge /= np.sqrt(np.einsum("ki,ij,kj->k", edge, shape * high, edge))[:, None]
        edge = np.concatenate([edge, c[None] / math.sqrt(c @ shape @ c * high)])
        V = np.einsum("ki,ij,kj->k", edge + c, P, edge + c)
        assert V.max() <= 2.0 * (1 + 1e-12)
        nearest = max(nearest, float(V.max()))
        assert not tube.is_attracted(
            case, exactly(P * 1e9), [Fraction(v) * 2 / Fraction(math.sqrt(c @ P @ c)) for v in c]
        )
    assert nearest > 2.0 * (1 - 1e-6)


# --------------------------------------------------------------------------------------------- what each clause is for


def beyond_the_wall() -> Document:
    return at("plant.domain", [["-9", "2"]])(glide())


def unfinished() -> Document:
    return edited(glide(), "evidence.tube", lambda slabs: slabs[:2])


def standing() -> Document:
    """{|x - 2| <= 1/4} stays where it is: so it does if nobody looks at F - v beside its motion."""
    slabs = [moved(2.0, 0.0, 1e-3, RADIUS)]
    return following(["-", "x"], 1.0, ball(1.5, NO_CURVATURE), 16.0, 2.0, slabs)


def blinkered() -> Document:
    """x' = x^3 - x from |x - 3/2| <= 1/4 at a speed that leads to 0, on a ball that knows nothing of the way."""
    slab = moved(1.5, 0.0, 30.0, 1.25) | ball(1e-3, joint(1e-3))
    return following(CUBIC, 0.25, ball(0.5005, joint()), 0.64, 1.5, [slab])


CLAUSES: dict[str, tuple[Callable[[], Document], str, Any]] = {
    "the ellipsoids lie in the domain": (beyond_the_wall, "lies_in", lambda *_: True),
    "the last ellipsoid lies in {V <= c2}": (unfinished, "is_attracted", lambda *_: True),
    "each slab decreases": (standing, "inequality", lambda *_: SimpleNamespace(holds=True)),
}


@pytest.mark.parametrize("clause", CLAUSES)
def test_with_a_clause_disabled_a_false_claim_gets_through(clause: str, monkeypatch: pytest.MonkeyPatch) -> None:
    false, name, blind = CLAUSES[clause]
    assert verdicts(false()) == {"tube"}
    monkeypatch.setattr(tube, name, blind)
    assert verdict(false()) == "ACCEPTED"


def test_the_velocity_is_part_of_the_inequality(monkeypatch: pytest.MonkeyPatch) -> None:
    """From |x - 1| <= 3/4 by a centre at 0 after no time at all: without v it is F alone that points inwards."""
    slab = moved(0.2, 0.0, 1e-4, 0.9) | {"path": waypoint([0.0], 0.5, 0.5, 1.0)}
    data = following(["-", "x"], 0.9, ball(1.5, NO_CURVATURE), 1 / 0.81, 0.2, [slab])
    assert verdicts(data) == {"tube"}
    monkeypatch.setattr(tube.Piece, "velocity", property(lambda _: [fmpq(0)]))
    assert verdict(data) == "ACCEPTED"


# --------------------------------------------------------------------------------------------------- what is printed


def test_the_claim_is_printed_with_its_centre_and_time() -> None:
    data = glide()
    c = parse(data)
    said = clauses.CLAIMS["reached"].format(c=c, time=clauses.duration(c))
    time = said.split(" after ")[1].split(" units")[0]
    assert Fraction(time) >= sum(Fraction(float.fromhex(s["duration"])) for s in data["evidence"]["tube"])
    assert "(x - c)'S(x - c) <= 1" in said and "stays in the domain" in said
