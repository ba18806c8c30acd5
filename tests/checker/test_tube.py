"""Attacks on rules `local` and `tube`: each forgery breaks one clause, and both checkers refuse it under its rule.

`pendulum` is what `certify roa --enlarge` writes for the shipped policy; `decay` is x' = -x, with every number of its
tube worked out by hand, and `cubic` is x' = x^3 - x, whose origin attracts exactly |x| < 1. What the inequalities say
is also asked of the loops themselves: of runs, and of points of a ball in ball arithmetic.
"""

from __future__ import annotations

import itertools
import json
import math
import subprocess
import sys
from collections.abc import Callable, Sequence
from fractions import Fraction
from functools import cache
from pathlib import Path
from tempfile import NamedTemporaryFile, TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from flint import arb, ctx, fmpq, fmpq_mat
from hypothesis import example, given
from hypothesis import strategies as st

from certify.certificates import checking
from certify.checker import clauses, tube
from certify.checker.ball import Ball
from certify.checker.case import Case
from certify.checker.decrease import Multipliers, are_finite, are_usable
from certify.checker.errors import Rejected
from certify.checker.exact import MAX_MATRIX_BITS, exactly, is_definite, root_above
from certify.reference import rules as second
from tests.support.balls import AT_REST, centred, enlarged_from
from tests.support.certificates import (
    ASYMPTOTIC,
    Document,
    decode,
    dump,
    edited,
    encode,
    make,
    parse,
    rehash,
    verdict,
    write,
)
from tests.support.earlier import earlier
from tests.support.jets import curved, models_of, no_units, plain, seen, shows, sides
from tests.support.marks import slow_after
from tests.support.oracle import policy_in_arb, quadratic, value_of

ROOT = Path(__file__).parents[2]
NONE = 2.0**-60  # a beta of a component that has no Q
Edit = Callable[[Document], Document]


def verdicts(data: Document | bytes) -> set[str]:
    """What the two programs say: ACCEPTED or a rule's name, one entry if they agree."""
    raw = data if isinstance(data, bytes) else dump(data)
    judged = second.judge(raw)
    first = verdict(data) if isinstance(data, dict) else verdict_of(raw)
    return {first, judged.rule or judged.result}


def verdict_of(raw: bytes) -> str:
    """The checker's word as a child process."""
    with NamedTemporaryFile(suffix=".json") as file:
        file.write(raw)
        file.flush()
        _, answer = checking.ask(Path(file.name))
    return str(answer.get("rule") or answer["result"])


# ------------------------------------------------------------------------------------------------- honest certificates


@cache
def pendulum() -> Document:
    """As the command writes it: c1 = c2, and a tube from outside. Shared between tests, which edit copies only."""
    with TemporaryDirectory() as folder:
        command = [sys.executable, "-c", "from certify.cli.main import main; main()", "roa"]
        command += ["--policy", str(ROOT / "examples" / "policies" / "pendulum.pt")]
        command += ["--level", "0.3", "--enlarge", "--effort", "0.6", "--out", folder, "--quiet"]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        data: Document = earlier(json.loads((Path(folder) / "certificate.json").read_text()))
    return data


def ball(J: Any, rows: Any) -> Document:
    n = len(np.atleast_2d(J))
    return {"J": encode(np.atleast_2d(J)), "multipliers": encode(rows), "weight": encode(np.eye(n))}


def slab(middle: float, end: float, duration: float, J: float, rows: Any) -> Document:
    nodes = {"middle": encode([middle]), "end": encode([end])}
    return nodes | {"duration": duration.hex(), "path": None} | ball(J, rows)


def scalar(dynamics: Any, c: float, local: Document, start: float, slabs: Sequence[Document], **more: Any) -> Document:
    """In V = x^2 with c1 = c2 = c: the tree is a leaf of which nothing is asked."""
    options: dict[str, Any] = {"root": [math.sqrt(c) * 1.25], "domain": [("-9", "9")], **more}
    data = make([dynamics], [([[0.0]], [0.0])], 1.0, (c, c), **options)
    data["claim"] = enlarged_from([start])
    data["evidence"] |= {"local": local | AT_REST, "tube": list(slabs)}
    return data


NO_CURVATURE = [[0.0], [NONE], [0.0]]


def decay(**more: Any) -> Document:
    """From |x| <= 2 by |x| <= 4/3 into |x| < 1: in one state the rate must be below 2 P, at each coefficient."""
    slabs = [slab(0.375, 0.5625, 0.75, 2.125, NO_CURVATURE), slab(0.75, 1.0625, 0.5, 1.375, NO_CURVATURE)]
    return scalar(["-", "x"], 1.0, ball(1.5, NO_CURVATURE), 0.25, slabs, **more)


CUBIC = ["-", ["**", "x", 3], "x"]


def cubic() -> Document:
    """From |x| <= 3/4 into |x| < 1/2."""
    nodes = np.geomspace(1 / 0.75**2, 4.0625, 9).tolist()
    slabs = []
    for before, after in itertools.pairwise(nodes):
        J = 1.0005 / math.sqrt(before)
        slabs.append(slab(math.sqrt(before * after), after, 0.3, J, joint()))
    return scalar(CUBIC, 0.25, ball(0.5005, joint()), nodes[0], slabs)


def joint() -> list[list[float]]:
    """No Q at the origin, as little as possible for g, no alpha: x^3 is its own model, only rounding is left."""
    return [[0.0], [0.0], [NONE]]


HONEST: dict[str, Callable[[], Document]] = {"pendulum": pendulum, "decay": decay, "cubic": cubic}


@pytest.mark.parametrize("name", HONEST)
def test_honest_tubes_are_accepted(name: str) -> None:
    data = HONEST[name]()
    assert verdicts(data) == {"ACCEPTED"}
    assert len(data["evidence"]["tube"]) > 1


@pytest.mark.parametrize("name", HONEST)
def test_without_its_tube_each_is_an_asymptotic_claim(name: str) -> None:
    data = edited(edited(HONEST[name](), "evidence.tube", []), "claim", ASYMPTOTIC)
    assert verdicts(data) == {"ACCEPTED"}


# ------------------------------------------------------------------------------------------------------------ forgeries


def times(path: str, factor: float | np.ndarray) -> Edit:
    """Every number of an array, or those for which a factor is given."""
    return lambda data: edited(data, path, lambda text: encode((decode(text) * np.ravel(factor)).reshape(-1)))


def entry(path: str, i: int, value: float | Callable[[float], float]) -> Edit:
    def edit(text: str) -> str:
        numbers = decode(text)
        numbers[i] = value(numbers[i]) if callable(value) else value
        return encode(numbers)

    return lambda data: edited(data, path, edit)


def at(path: str, value: Any) -> Edit:
    return lambda data: edited(data, path, value)


def slabs_to(change: Callable[[list[Document]], list[Document]]) -> Edit:
    return lambda data: edited(data, "evidence.tube", lambda slabs: change(list(slabs)))


def duration(k: int, value: float | Callable[[float], float]) -> Edit:
    def edit(text: str) -> str:
        return float(value(float.fromhex(text)) if callable(value) else value).hex()

    return lambda data: edited(data, f"evidence.tube.{k}.duration", edit)


def up(v: float) -> float:
    return float(np.nextafter(v, np.inf))


START, FIRST, LOCAL = "claim.start", "evidence.tube.0", "evidence.local"
NODES = [START, f"{FIRST}.middle", f"{FIRST}.end", "evidence.tube.3.middle"]
BALLS = [(LOCAL, "local"), (FIRST, "tube")]
FORGERIES: list[tuple[str, str, Edit]] = [
    *[(f"{at} is not symmetric by one bit", "tube", entry(at, 1, up)) for at in NODES],
    *[(f"{at} is negative definite", "tube", times(at, -1)) for at in NODES],
    *[(f"{at} is indefinite", "tube", entry(at, 3, lambda v: -v)) for at in NODES],
    *[(f"{at} is 0", "tube", times(at, 0)) for at in NODES],
    *[(f"{at} leaves the domain", "tube", times(at, 0.1)) for at in NODES],
    *[(f"{at} is negative where the domain looks", "tube", entry(at, 0, lambda v: -v)) for at in NODES],
    ("a larger start", "tube", times(START, 0.95)),
    ("the last slab is missing", "tube", slabs_to(lambda slabs: slabs[:-1])),
    ("the first slab is missing", "tube", slabs_to(lambda slabs: slabs[1:])),
    ("one slab of many", "tube", slabs_to(lambda slabs: slabs[-1:])),
    ("slabs in the other order", "tube", slabs_to(lambda slabs: slabs[::-1])),
    ("two slabs change places", "tube", slabs_to(lambda slabs: [*slabs[:3], slabs[4], slabs[3], *slabs[5:]])),
    ("the end is the start", "tube", lambda data: ends_at(data["claim"]["start"], data)),
    ("the last node is V <= c2 and no less", "tube", lambda d: ends_at(over_c2(d), d)),
    *[
        (f"a duration is {value}", "tube", duration(2, value))
        for value in (0.0, -0.0, -0.015, 5e-324, -5e-324, 2.0**-1000)
    ],
    ("a duration is a tenth", "tube", duration(2, lambda h: h / 10)),
    ("the middle is the end", "tube", lambda d: edited(d, f"{FIRST}.middle", d["evidence"]["tube"][0]["end"])),
    ("the middle is the start", "tube", lambda d: edited(d, f"{FIRST}.middle", d["claim"]["start"])),
    *[(f"{at}: J is 0", rule, times(f"{at}.J", 0)) for at, rule in BALLS],
    *[(f"{at}: J is a little smaller", rule, times(f"{at}.J", 0.99)) for at, rule in BALLS],
    *[(f"{at}: J is singular", rule, times(f"{at}.J", [1e3, 0, 1e3, 0])) for at, rule in BALLS],
    *[(f"{at}: J has a row of 0", rule, times(f"{at}.J", [1e3, 1e3, 0, 0])) for at, rule in BALLS],
    *[(f"{at}: J is nearly singular", rule, times(f"{at}.J", [1, 1, 2.0**-1060, 2.0**-1060])) for at, rule in BALLS],
    *[(f"{at}: J is huge", rule, times(f"{at}.J", 1e150)) for at, rule in BALLS],
    *[(f"{at}: J has a huge column", rule, entry(f"{at}.J", 2, 1e300)) for at, rule in BALLS],
    *[
        (f"{at}: multiplier {i} is negative", rule, entry(f"{at}.multipliers", i, value))
        for at, rule in BALLS
        for i in range(6)
        for value in (-5e-324, -1e9)
    ],
    *[
        (f"{at}: multiplier {i} is {value}", rule, entry(f"{at}.multipliers", i, value))
        for at, rule in BALLS
        for i, value in ((1, 0.0), (1, 1e300), (3, 1e-300), (3, 1e300), (4, 0.0), (5, -0.0), (4, 1e300), (1, 5e-324))
        if (at, i, value) != (LOCAL, 1, 0.0)  # where so little is left that alpha may be 0
    ],
    (
        "a ball of the slab for the local one",
        "local",
        lambda d: edited(d, LOCAL, ball_of(d["evidence"]["tube"][0]) | AT_REST),
    ),
    (
        "the local ball for a slab's",
        "tube",
        lambda d: edited(d, FIRST, lambda old: old | ball_of(d["evidence"]["local"])),
    ),
    ("c1 = c2 are larger", "local", lambda d: levels(0.5, times("evidence.root", 2)(d))),
    ("c1 = c2 are smaller", "tube", lambda d: levels(0.2, d)),
    ("a domain that the start touches", "tube", lambda d: edited(d, "plant.domain.0", touching(d))),
    ("less torque than the tube takes", "inputs", at("plant.input_bounds", [["-23/4", "23/4"]])),
]


def ball_of(of: Document) -> Document:
    return {key: of[key] for key in ("J", "multipliers", "weight")}


def levels(c: float, data: Document) -> Document:
    return edited(data, "levels", {"local": c.hex(), "roa": c.hex()})


def ends_at(node: str, data: Document) -> Document:
    return slabs_to(lambda slabs: [*slabs[:-1], slabs[-1] | {"end": node}])(data)


def over_c2(data: Document) -> str:
    return encode(decode(data["lyapunov"]["P"]) / float.fromhex(data["levels"]["roa"]))


def touching(data: Document) -> list[str]:
    """The least interval of these digits around the start's extent, less the last digit."""
    P = decode(data["claim"]["start"]).reshape(2, 2)
    reach = math.isqrt(int(Fraction(np.linalg.inv(P)[0, 0]) * 10**20))
    return [f"-{reach}/{10**10}", f"{reach}/{10**10}"]


@pytest.mark.parametrize(("rule", "edit"), [pytest.param(rule, edit, id=what) for what, rule, edit in FORGERIES])
def test_forgeries(rule: str, edit: Edit) -> None:
    forged = edit(pendulum())
    assert forged != pendulum()
    assert verdicts(forged) == {rule}


SMALL: list[tuple[str, str, Callable[[], Document]]] = [
    ("the rate is 2 P at the first coefficient", "tube", lambda: entry(f"{FIRST}.middle", 0, 0.4375)(decay())),
    ("the rate is 2 P at the last coefficient", "tube", lambda: last_of_decay(0.53125, 1.0625)),
    ("the rate is 2 P at the middle coefficient", "tube", lambda: last_of_decay(0.75, 1.3125)),
    ("the ball touches the first ellipsoid", "tube", lambda: times(f"{FIRST}.J", 2 / 2.125)(decay())),
    ("the ball misses the middle alone", "tube", lambda: entry(f"{FIRST}.middle", 0, 0.2)(decay())),
    ("the ball touches {V <= c1}", "local", lambda: times(f"{LOCAL}.J", 1 / 1.5)(decay())),
    ("the start touches the domain", "tube", lambda: decay(domain=[("-2", "9")])),
    ("the last ellipsoid is {V <= c2}", "tube", lambda: entry("evidence.tube.1.end", 0, 1.0)(decay())),
    ("slower than its rates", "local", lambda: at("plant.dynamics", [["*", "-1/2", "x", ["-", "1", "x"]]])(decay())),
    ("away from the origin", "local", lambda: at("plant.dynamics", ["x"])(decay())),
    ("not at rest", "equilibrium", lambda: at("plant.dynamics", [["-", "1/9", "x"]])(decay())),
    ("a clip in the tube alone", "tube", lambda: fed(clip=([-1.75], [9.0]))),
    ("a clip at its very end", "tube", lambda: fed(clip=([-2.125], [2.125]))),
    ("inputs in the tube alone", "inputs", lambda: fed(input_bounds=[("-7/4", "9")])),
    ("a division in the tube alone", "tube", lambda: divided("2")),
    ("the same, times 0", "tube", lambda: times_0(divided("2"))),
    ("a division on the ball alone", "tube", lambda: divided("17/8")),
    ("a root in the tube alone", "tube", lambda: rooted("2")),
]


def last_of_decay(middle: float, end: float) -> Document:
    """From 0.5625 in the time 1/2: rates of 4 (middle - 0.5625), 2 (end - 0.5625) and 4 (end - middle)."""
    return slabs_to(lambda slabs: [slabs[0], slab(middle, end, 0.5, 1.375, NO_CURVATURE)])(decay())


def fed(**more: Any) -> Document:
    """x' = u, u = -x by a network without a squash."""
    options = {"squash": "identity", "centre": "none", "scale": [-1.0], "input_bounds": [("-9", "9")], **more}
    data = decay(**options)
    data["policy"]["layers"][0]["weight"] = encode([1.0])
    return rehash(at("plant.dynamics", ["u"])(data))


def divided(pole: str) -> Document:
    """x' = -x + 2^-30 x^2 / (x - pole)."""
    small = ["/", ["*", "1/1073741824", ["**", "x", 2]], ["-", "x", pole]]
    return with_curvature(at("plant.dynamics", [["-", small, "x"]])(decay()))


def times_0(data: Document) -> Document:
    return edited(data, "plant.dynamics.0.1", lambda part: ["*", "0", part])


def rooted(pole: str) -> Document:
    """x' = -x + 2^-30 x (sqrt(pole + x) - sqrt(pole)) up to what stands for the last."""
    small = ["*", "1/1073741824", ["**", "x", 2], ["sqrt", ["+", "x", pole]]]
    return with_curvature(at("plant.dynamics", [["-", small, "x"]])(decay()))


def with_curvature(data: Document) -> Document:
    """All Q joint, and an alpha: what is small enough passes."""
    for place in (LOCAL, FIRST, "evidence.tube.1"):
        data = edited(data, f"{place}.multipliers", encode([[2.0**-10], [0.0], [2.0**-10]]))
    return data


@pytest.mark.parametrize(("rule", "make_it"), [pytest.param(rule, data, id=what) for what, rule, data in SMALL])
def test_small_forgeries(rule: str, make_it: Callable[[], Document]) -> None:
    assert verdicts(make_it()) == {rule}


NEXT: dict[str, Callable[[], Document]] = {
    "the rate is below 2 P by one bit": lambda: entry(f"{FIRST}.middle", 0, math.nextafter(0.4375, 0))(decay()),
    "the last rate is below 2 P by one bit": lambda: last_of_decay(up(0.53125), 1.0625),
    "the middle rate is below 2 P by one bit": lambda: last_of_decay(up(0.75), 1.3125),
    "the ball is larger by one bit": lambda: entry(f"{FIRST}.J", 0, up(2.0))(decay()),
    "a mirrored ball": lambda: times(f"{FIRST}.J", -1)(decay()),
    "a ball of 10^100": lambda: times(f"{LOCAL}.J", 1e100)(decay()),
    "a domain that is larger by 10^-30": lambda: decay(domain=[("-2" + 29 * "0" + "1/1" + 30 * "0", "9")]),
    "the last ellipsoid is smaller by one bit": lambda: entry("evidence.tube.1.end", 0, up(1.0))(decay()),
    "a clip that is further away by little": lambda: fed(clip=([-2.125 * (1 + 2**-30)], [9.0])),
    "inputs by the enclosure": lambda: fed(input_bounds=[("-43/20", "43/20")]),
    "a network": fed,
    "a pole outside of the balls": lambda: divided("9/4"),
    "the same, of a root": lambda: rooted("9/4"),
    "multipliers of nothing are 0": lambda: at("evidence.local.multipliers", encode([[0.0], [0.0], [5e-324]]))(decay()),
    "a time of 10^308 and another": lambda: duration(1, 1e308)(duration(0, 1e308)(decay())),
}


@pytest.mark.parametrize("name", NEXT)
def test_next_to_forgeries(name: str) -> None:
    """So it is the clause that refuses, and nothing else."""
    assert verdicts(NEXT[name]()) == {"ACCEPTED"}


MALFORMED: dict[str, Edit] = {
    "no start": at("claim", ASYMPTOTIC | {"kind": "enlarged"}),
    "a start for nothing": lambda d: edited(d, "claim.kind", "asymptotic"),
    "no tube": at("evidence.tube", []),
    "a tube for nothing": at("claim", ASYMPTOTIC),
    "a tube of another kind": at("evidence.tube", {}),
    "null for a tube": at("evidence.tube", None),
    "null for a slab": at("evidence.tube.1", None),
    "no local ball": at("evidence.local", None),
    "too many slabs": slabs_to(lambda slabs: slabs[:1] * 10_001),
    "a key too many": lambda d: edited(d, FIRST, lambda old: old | {"start": old["end"]}),
    "a key too few": lambda d: edited(d, FIRST, lambda old: {k: v for k, v in old.items() if k != "middle"}),
    "a matrix of another size": at(f"{FIRST}.middle", encode([1.0, 1.0])),
    "two rows of multipliers": at(f"{FIRST}.multipliers", encode([[1.0], [1.0]])),
    "NaN": at(f"{FIRST}.middle", encode([math.nan])),
    "an infinite multiplier": at(f"{LOCAL}.multipliers", encode([[math.inf], [1.0], [1.0]])),
    "an infinite J": at(f"{FIRST}.J", encode([math.inf])),
    "an infinite duration": at(f"{FIRST}.duration", "inf"),
    "a duration beyond binary64": at(f"{FIRST}.duration", "0x1.0000000000000p+1024"),
    "a duration in decimals": at(f"{FIRST}.duration", "0.75"),
    "a duration as a number": at(f"{FIRST}.duration", 1),
    "an unknown claim": at("claim.kind", "enlarged "),
    "a practical claim": lambda d: edited(
        edited(d, "claim", ASYMPTOTIC | {"kind": "practical"}),
        "levels",
        {"floor": (0.5).hex(), "local": (0.5).hex(), "roa": (1.0).hex()},
    ),
    "a solver's word": at(
        "evidence",
        {"kind": "trusted-solver", "solver": "s", "version": "1", "precision": "0x1.0000000000000p-10", "queries": []},
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", MALFORMED)
def test_malformed_tubes(name: str) -> None:
    assert verdicts(MALFORMED[name](decay())) == {"format"}


@pytest.mark.parametrize("key", ["end", "middle", "duration", "J"])
def test_a_key_that_stands_twice(key: str) -> None:
    """The last one would win in most readers: here nobody reads it."""
    raw = dump(decay())
    value = json.dumps(decay()["evidence"]["tube"][0][key])
    twice = raw.replace(f'"{key}": {value}'.encode(), f'"{key}": {value}, "{key}": {value}'.encode(), 1)
    assert twice != raw
    assert verdicts(twice) == {"format"}


# ------------------------------------------------------------------------- what the claims say, asked of trajectories


@given(
    st.floats(1.0, 1.5),
    st.lists(st.tuples(st.floats(-1.2, 1.2), st.floats(-1.2, 1.2), st.floats(0.01, 8.0)), min_size=1, max_size=4),
    st.floats(1.0, 1.3),
    st.tuples(st.floats(0, 4), st.floats(0, 2), st.floats(1e-9, 4)),
)
@example(1.0, [(0.3, 0.7, 1.0)], 1.0005, (1.0, 0.0, 1e-9))
def test_no_tube_leads_from_beyond_the_region_of_attraction(
    reach: float, steps: list[tuple[float, float, float]], wide: float, rows: tuple[float, float, float]
) -> None:
    """x' = x^3 - x rests at 1: whatever stands in a tube from |x| <= reach is no proof."""
    node, slabs = 1 / reach**2, []
    for middle, end, h in steps:
        before, node = node, node * math.exp(end)
        J = wide / math.sqrt(min(before, node, before * math.exp(middle)))
        slabs.append(slab(before * math.exp(middle), node, h, J, np.reshape(rows, (3, 1))))
    slabs.append(
        slab(math.sqrt(node * 4.0625), 4.0625, 9.0, wide / math.sqrt(min(node, 4.0)), np.reshape(rows, (3, 1)))
    )
    data = scalar(CUBIC, 0.25, ball(0.5005, joint()), 1 / reach**2, slabs)
    assert verdicts(data) == {"tube"}


@pytest.mark.slow
@given(st.integers(1, 12), st.floats(0.05, 4.0), st.floats(0.2, 1.5), st.floats(0, 1))
@example(12, 2.0, 1.0, 0.5)
@example(12, 2.0, 0.9, 0.5)
@example(1, 1e-3, 0.99, 0.5)
def test_nothing_is_faster_than_the_flow(count: int, over: float, hurry: float, where: float) -> None:
    """x' = -x takes log(2) / 2 for each factor of 2 in P, and no tube takes less; one that takes longer is found."""
    nodes = np.geomspace(1.0625 * math.exp(-over), 1.0625, count + 1).tolist()
    h = over / count / 2 / hurry
    slabs = [
        slab(a ** (1 - where) * b**where, b, h, 1.001 / math.sqrt(a), NO_CURVATURE)
        for a, b in itertools.pairwise(nodes)
    ]
    said = verdicts(decay_from(nodes[0], slabs))
    if hurry >= 1:
        assert said == {"tube"}
    elif where == 0.5 and over / count < 0.2 and hurry <= 0.9:
        assert said == {"ACCEPTED"}


def decay_from(start: float, slabs: list[Document]) -> Document:
    return scalar(["-", "x"], 1.0, ball(1.5, NO_CURVATURE), start, slabs, domain=[("-99", "99")])


def test_runs_of_the_pendulum_stay_in_its_tube() -> None:
    """From the start's boundary: x'P(t)x falls at every step, the inputs and the domain hold, and V ends below c2."""
    data = pendulum()
    c = parse(data)
    assert json.dumps(data["plant"]["dynamics"][1][1:]) == json.dumps(
        [
            ["*", ["/", "981/100", "1/2"], ["sin", "theta"]],
            ["-", ["*", ["/", "1/10", ["*", "3/20", ["**", "1/2", 2]]], "theta_dot"]],
            ["/", "u", ["*", "3/20", ["**", "1/2", 2]]],
            ["/", "0", ["*", "3/20", ["**", "1/2", 2]]],
        ]
    )
    policy, (lo, hi) = c.policy, map(float, c.input_bounds[0])
    assert (policy.squash, policy.centre, policy.clip) == ("tanh", "preactivation", None)

    def net(x: np.ndarray) -> np.ndarray:
        for W, b in (step.arrays for step in policy.network.steps if step.arrays):
            y = W @ x + b[:, None]
            x = np.tanh(y)
        return y

    at_0, beta = net(np.zeros((2, 1))), np.arctanh((float(c.u_eq[0]) - policy.offset) / policy.scale)

    def u_of(x: np.ndarray) -> np.ndarray:
        return (policy.scale * np.tanh(net(x) - at_0 + beta) + policy.offset)[0]

    def field(x: np.ndarray) -> np.ndarray:
        return np.array([x[1], -8 / 3 * x[1] + 80 / 3 * u_of(x) + 981 / 50 * np.sin(x[0])])

    angle = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    inverse = np.linalg.inv(np.linalg.cholesky(c.tube.start)).T
    x = inverse @ np.array([np.cos(angle), np.sin(angle)])
    node, W, steps = c.tube.start, np.ones(64), 12
    for piece in c.tube.slabs:
        h = piece.duration / steps
        for k in range(steps):
            k1 = field(x)
            k2 = field(x + h / 2 * k1)
            k3 = field(x + h / 2 * k2)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + field(x + h * k3))
            s = (k + 1) / steps
            P = (1 - s) ** 2 * node + 2 * s * (1 - s) * piece.middle + s * s * piece.end
            before, W = W, np.einsum("ik,ij,jk->k", x, P, x)
            assert np.all(before > W)
            assert np.all((lo <= u_of(x)) & (u_of(x) <= hi))
            assert all(
                float(low) < v.min() and v.max() < float(high) for v, (low, high) in zip(x, c.domain, strict=True)
            )
        node = piece.end
    assert np.all(np.einsum("ik,ij,jk->k", x, c.P, x) <= c.c2)
    assert W.max() > 1e-3  # the tube is not a proof of something much weaker


# ------------------------------------------------------------------------------------------- soundness of the numbers

FUNCTIONS = ("sin", "cos", "tan", "tanh", "exp", "atan", "sqrt")


def random_tree(random: np.random.Generator, names: Sequence[str], depth: int) -> Any:
    if depth == 0 or random.random() < 0.1:
        return str(random.choice(names)) if random.random() < 0.8 else f"{random.integers(-30, 30)}/7"
    kind, operand = random.integers(0, 9), random_tree(random, names, depth - 1)
    if kind < 2:
        return ["+", operand, random_tree(random, names, depth - 1)]
    if kind < 5:
        return ["*", operand, random_tree(random, names, depth - 1)]
    if kind == 5:
        return ["/", operand, ["+", "3", random_tree(random, names, depth - 1)]]
    if kind == 6:
        return ["**", operand, int(random.choice([-2, -1, 2, 3]))]
    function = str(random.choice(FUNCTIONS))
    return [function, ["+", "2", operand] if function == "sqrt" else operand]


def random_loop(random: np.random.Generator) -> tuple[Document, np.ndarray]:
    """Equations, a network and a ball: some with columns and rows of very different sizes, some steep, some flat."""
    n, m, depth = (int(random.integers(1, most)) for most in (4, 3, 4))
    widths = [n, *random.integers(1, 6, depth - 1), m]
    size = 10.0 ** (random.uniform(-2, 1) if random.random() < 0.7 else random.uniform(-200, 3))
    layers = [
        (random.standard_normal((b, a)) * size, random.standard_normal(b) * 10.0 ** random.uniform(-3, 1.5))
        for a, b in itertools.pairwise(widths)
    ]
    squash = str(random.choice(["tanh", "identity"]))
    centre = "preactivation" if squash == "tanh" and random.random() < 0.5 else "output"
    scale = random.standard_normal(m) * 10.0 ** random.uniform(-2, 2)
    states, inputs = [f"x{i}" for i in range(n)], [f"u{j}" for j in range(m)]
    J = random.standard_normal((n, n)) * 10.0 ** random.uniform(-3, 0.5)
    kind = random.integers(0, 4)
    J *= (
        10.0 ** random.uniform(-300, 1, (1, n))
        if kind == 0
        else 10.0 ** random.uniform(-12, 3, (n, 1))
        if kind == 1
        else 1
    )
    data = make(
        [random_tree(random, states + inputs, int(random.integers(1, 5))) for _ in states],
        layers, np.eye(n), (1.0, 1.0), states=states, inputs=inputs, domain=[("-9", "9")] * n,
        input_bounds=[("-9", "9")] * m, squash=squash,
        centre=centre, scale=scale, offset=[0.0] * m, root=[1.0] * n,
        u_eq=[str(Fraction(float(v)) * Fraction(random.integers(-9, 9).item(), 10)) for v in scale],
    )  # fmt: skip
    data["evidence"] |= {"local": centred(np.eye(n), np.ones((3, n))), "tube": []}
    try:
        parse(data)
    except Rejected as no:  # by chance
        assert no.detail == "a division by the number 0"
        return random_loop(random)
    return data, J


@pytest.mark.parametrize("seed", slow_after(1, range(4)))
def test_models_hold_on_their_balls(seed: int) -> None:
    """F and the inputs at points of random balls of random loops, in ball arithmetic: never certainly outside."""
    random, met, tight = np.random.default_rng(seed), 0, 0.0
    while met < 75:
        data, J = random_loop(random)
        c = parse(data)
        with np.errstate(all="ignore"):
            on = Ball(Case(c), J, "a ball")
            known_there = [*on.F(), *on.inputs]
        if not are_finite(known_there):
            continue
        jets = seen(known_there)
        met += 1
        n = len(J)
        points = random.standard_normal((3, n))
        points *= (np.array([1, 1, 10.0 ** random.uniform(-6, 0)]) / np.linalg.norm(points, axis=1) * (1 - 2**-50))[
            :, None
        ]
        with ctx.workprec(2400):
            rows = [[arb(v) for v in row] for row in J.tolist()]
            at_0 = values(c, data, [arb(0)] * n)
            for d in points.tolist():
                x = [sum((a * arb(v) for a, v in zip(row, d, strict=True)), arb(0)) for row in rows]
                size = sum((arb(v) ** 2 for v in d), arb(0)).sqrt()
                for jet, v, v0 in zip(jets, values(c, data, x), at_0, strict=True):
                    left = v - v0 - curved(jet, d)
                    left -= sum((arb(float(a)) * arb(w) for a, w in zip(jet.a, d, strict=True)), arb(0))
                    known = arb(float(jet.slack)) * size + quadratic(jet.whole.tolist(), d)
                    assert left.is_finite() and not abs(left) > known
                    assert not abs(v0 - arb(float(jet.c))) > arb(float(jet.error))
                    if known > 2.0**-900:
                        tight = max(tight, float((abs(left) / known).mid()))
    assert tight > 0.99  # some remainder is as large as its bound


def values(c: Any, data: Document, x: list[arb]) -> list[arb]:
    """F, and the inputs."""
    u = policy_in_arb(c.policy, c.u_eq, x)
    names = dict(zip((*c.states, *c.inputs), (*x, *u), strict=True))
    return [*(value_of(tree, names) for tree in data["plant"]["dynamics"]), *u]


def rationals(numbers: np.ndarray) -> tuple[fmpq, ...]:
    return tuple(fmpq(*float(v).as_integer_ratio()) for v in numbers)


@pytest.mark.parametrize("seed", range(3))
def test_what_is_just_shown_is_true_of_the_worst_remainder(seed: int) -> None:
    """R is lowered until the inequality is just shown; then nothing within the models is positive on the ball."""
    random, worst = np.random.default_rng(seed), -math.inf
    for _ in range(120):
        n = int(random.integers(1, 4))
        J = random.standard_normal((n, n)) * 10.0 ** random.uniform(-3, 3)
        P = random.standard_normal((n, n))
        P, R, K = P @ P.T + 1e-3 * np.eye(n), random.standard_normal((n, n)), np.linalg.inv(J @ J.T)
        P, R, K = (P + P.T) / 2, R + R.T, (K + K.T) / 2
        a, Q, E = (random.standard_normal((n,) * k) for k in (2, 3, 3))
        E = np.einsum("iab,icb->iac", E, E) * 10.0 ** random.uniform(-3, 0) * (random.random() < 0.7)
        Q = Q * 10.0 ** random.uniform(-2, 1) * (random.random() < 0.7)
        slack = 10.0 ** random.uniform(-6, 0, n) * (random.random() < 0.5)
        models = models_of(
            J, [plain(np.float64(0), 0.0, a[i], slack[i], Q[i], E[i]) for i in range(n)], no_units(n), True
        )
        by = random_multipliers(random, P @ J, Q, E)
        assert are_usable(by)
        decay_of, rest = sides(models, exactly(P), exactly(R), by)
        D = np.array([[int(v.p) / int(v.q) for v in row] for row in (decay_of - rest).tolist()])
        edge = -np.linalg.eigvalsh((D + D.T) / 2)[0]
        lowest = edge + np.abs(D).max() * 1e-12
        shifted = R - K * lowest
        if not shows(models, exactly(P), exactly((shifted + shifted.T) / 2), by):
            continue  # J is too far from the identity for a shift in binary64
        d = random.standard_normal((1500, n))
        d *= (random.random(1500) ** 0.1 / np.linalg.norm(d, axis=1))[:, None]
        along, Jd = d @ (P @ J).T, d @ J.T
        unknown = np.einsum("kj,ijl,kl->ki", d, E, d) + slack * np.linalg.norm(d, axis=1)[:, None]
        parts = d @ a.T + np.einsum("kj,ijl,kl->ki", d, Q, d)
        rate = np.einsum("kj,jl,kl->k", Jd, shifted, Jd)
        value = rate + 2 * np.sum(along * parts + np.abs(along) * unknown, 1)
        size = np.abs(rate) + 2 * np.sum(np.abs(along) * (np.abs(parts) + unknown), 1)
        assert np.all(value < 1e-11 * size)
        worst = max(worst, float(np.max(value / size)))
    assert worst > -1e-2


def random_multipliers(random: np.random.Generator, b: np.ndarray, Q: np.ndarray, E: np.ndarray) -> Multipliers:
    """About as large as they should be, and some 0."""
    n, lengths = len(b), np.linalg.norm(b, axis=1)
    alpha, beta = (np.linalg.norm(A, axis=(1, 2)) / lengths * 10.0 ** random.uniform(-1, 1, n) for A in (E, Q))
    g = np.full(n, 1e-9 + lengths @ np.linalg.norm(Q, axis=(1, 2))) * 10.0 ** random.uniform(-1, 1, n)
    return Multipliers(
        rationals(alpha * (random.random(n) < 0.7)), rationals(beta * (random.random(n) < 0.5)), rationals(g), np.eye(n)
    )


@given(st.integers(0, 2**200), st.integers(1, 2**200), st.integers(-1100, 1100))
@example(0, 1, 0)
@example(1, 1, -2148)
@example(2**106 - 1, 1, 1000)
def test_roots_from_above(p: int, q: int, shift: int) -> None:
    value = fmpq(p, q) * fmpq(2) ** shift
    root = root_above(value)
    assert root * root >= value
    assert root * root <= value * (1 + fmpq(1, 2**58))


DEFINITE: dict[str, tuple[Any, bool]] = {
    "1": ([[1]], True),
    "0": ([[0]], False),
    "-1": ([[-1]], False),
    "the least number": ([[fmpq(1, 2**2000)]], True),
    "two negative": ([[-1, 0], [0, -1]], False),
    "singular": ([[1, 1], [1, 1]], False),
    "nearly singular": ([[1, 1], [1, 1 + fmpq(1, 2**2000)]], True),
    "nearly definite": ([[1, 1], [1, 1 - fmpq(1, 2**2000)]], False),
    "0 first": ([[0, 0], [0, 1]], False),
    "0 last": ([[1, 0], [0, 0]], False),
    "not symmetric, definite": ([[1, 5], [-5, 1]], True),
    "not symmetric, its minors positive": ([[1, 9], [0, 1]], False),
    "not symmetric, its symmetric part singular": ([[1, 2], [0, 1]], False),
    "a positive determinant of two negative": ([[1, 0, 0], [0, -1, 0], [0, 0, -1]], False),
    "too long": ([[fmpq(2) ** MAX_MATRIX_BITS]], False),
}


@pytest.mark.parametrize("name", DEFINITE)
def test_definite_matrices(name: str) -> None:
    rows, definite = DEFINITE[name]
    assert is_definite(fmpq_mat([[fmpq(v) for v in row] for row in rows])) is definite


# --------------------------------------------------------------------------------------------- what each clause is for


def past_the_pole() -> Document:
    """x' = x^3 - x from |x| <= 2, on a ball that knows of |x| <= 1/2 alone."""
    return scalar(CUBIC, 0.25, ball(0.5005, joint()), 0.25, [slab(1.0, 4.0625, 30.0, 0.4, joint())])


def backwards() -> Document:
    """From |x| <= 2 into |x| < 1 in no time at all, by a time that runs backwards."""
    return decay_from(0.25, [slab(0.5, 1.0625, -0.01, 2.125, NO_CURVATURE)])


def bribed() -> Document:
    """A negative g pays for the rate."""
    return decay_from(0.25, [slab(0.5, 1.0625, 0.01, 2.125, [[0.0], [0.0], [-1e6]])])


CLAUSES: dict[str, tuple[Callable[[], Document], str, Any]] = {
    "the ball contains the ellipsoids": (past_the_pole, "contains_ball", lambda *_: True),
    "multipliers": (bribed, "are_usable", lambda *_: True),
    "the last node": (lambda: levels(2.0**-9, decay()), "is_definite", lambda _: True),
}


@pytest.mark.parametrize("clause", CLAUSES)
def test_with_a_clause_disabled_a_false_claim_gets_through(clause: str, monkeypatch: pytest.MonkeyPatch) -> None:
    false, name, blind = CLAUSES[clause]
    assert verdicts(false()) == {"tube"}
    monkeypatch.setattr(tube, name, blind)
    assert verdict(false()) == "ACCEPTED"


def test_a_time_that_runs_backwards() -> None:
    assert verdicts(backwards()) == {"tube"}


# --------------------------------------------------------------------------------------------------- what is printed


@given(st.lists(st.floats(5e-324, 1e300), min_size=1, max_size=5))
@example([0.1] * 10)
@example([1.0, 2.0**-60])
@example([5e-324])
def test_the_time_in_words_is_no_less_than_the_durations(durations: list[float]) -> None:
    slabs = [slab(0.25, 0.25, h, 2.125, NO_CURVATURE) for h in durations]
    c = parse(decay_from(0.25, slabs))
    said = clauses.CLAIMS["enlarged"].format(c=c, time=clauses.duration(c))
    time = said.split(" after ")[1].split(" units")[0]
    assert Fraction(time) >= sum(map(Fraction, durations))


def test_the_claim_and_the_answer_of_odd_numbers(tmp_path: Path) -> None:
    """A time that no binary64 number holds: an answer in plain JSON all the same."""
    data = NEXT["a time of 10^308 and another"]()
    path = write(times(f"{LOCAL}.J", 1e100)(data), tmp_path)
    command = [sys.executable, "-I", "-c", "import sys; sys.path.insert(0, sys.argv.pop(1)); "]
    command[-1] += "from certify.checker.__main__ import main; sys.exit(main(sys.argv[1:]))"
    done = subprocess.run([*command, str(ROOT), str(path), "--json"], capture_output=True, text=True, check=False)
    assert done.returncode == 0 and not done.stderr

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is not JSON")

    answer = json.loads(done.stdout, parse_constant=refuse)
    assert answer["time"] is None and answer["margins"]["local"] is not None
    assert any("after inf units of time at the latest" in line for line in answer["text"])
