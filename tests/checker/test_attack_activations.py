"""Attacks on activations with kinks, in both checkers: rows and models against Arb without a tolerance, loops that are
false because of a kink near the origin alone, and small files that ask for too much memory."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from fractions import Fraction
from functools import cache
from itertools import combinations, combinations_with_replacement
from typing import Any

import numpy as np
import pytest
from flint import arb, arb_mat, ctx, fmpq, fmpq_mat

from certify.checker import ball, contraction, document, rules
from certify.checker.activations import add as add_activations
from certify.checker.ball import Ball
from certify.checker.case import Case
from certify.checker.errors import Rejected
from certify.checker.expression import Tape, evaluate, parse
from certify.checker.functions import FUNCTIONS
from certify.checker.jets import Jet, Units, constant
from certify.checker.near import Near, Vector, triples
from certify.checker.networks import FUNCTIONS as MAPS
from certify.checker.networks import Affine, Map, Network, Step
from certify.checker.smooth import add as add_smooth
from certify.checker.wiring import Concat, Observe, Sum
from certify.reference import contraction as other
from certify.reference.balls import PRECISION
from certify.reference.document import read
from certify.reference.evidence import Tree
from certify.reference.flow import Steps
from certify.reference.loop import Loop
from certify.reference.model import Model
from certify.reference.refusal import Refused
from tests.checker import test_attack_networks as earlier_attacks
from tests.checker.test_attack_networks import Truth, Truths, affine, call, encode_tree, linear, net
from tests.checker.test_networks import CORNERED, Numbers, a_jet, checked, hash_of, needed
from tests.support.certificates import Document, encode, make
from tests.support.earlier import newer
from tests.support.marks import slow_after
from tests.support.reference import judge_bytes

add_activations()
add_smooth()


Array = Any
PROGRAMS = pytest.mark.parametrize("program", [checked, judge_bytes], ids=["checker", "reference"])
ZERO, BITS = arb(0), 300
DEFINITIONS: dict[str, Callable[[arb], arb]] = {
    "inv": lambda v: 1 / v,
    "abs": abs,
    "relu": lambda v: v.max(ZERO),
    "elu": lambda v: v.min(ZERO).expm1() + v.max(ZERO),
    "softsign": lambda v: v / (1 + abs(v)),
    "sigmoid": lambda v: 1 / (1 + (-v).exp()),
    "silu": lambda v: v / (1 + (-v).exp()),
    "gelu": lambda v: v * (1 + (v / arb(2).sqrt()).erf()) / 2,
    "softplus": lambda v: (1 + v.exp()).log(),
    "mish": lambda v: v * (1 + v.exp()).log().tanh(),
}


class Value(Truth):
    def __add__(self, other: Truth) -> Value:
        return Value(self.v + other.v)

    def __mul__(self, other: Truth) -> Value:
        return Value(self.v * other.v)

    def __neg__(self) -> Value:
        return Value(-self.v)

    def function(self, name: str) -> Value:
        return Value(DEFINITIONS[name](self.v))


class Values(Truths):
    """Networks in Arb, with all activations."""

    def map(self, step: Map, v: list[arb]) -> list[arb]:
        return [DEFINITIONS[step.function](x) for x in v]

    def observe(self, step: Observe, v: list[arb]) -> list[arb]:
        return values(step.tape, v)


def values(tape: Tape, variables: Sequence[arb]) -> list[arb]:
    def called(made: Any, given: list[Value]) -> list[Value]:
        found = Values().run(made.network, [x.v for x in given])
        return [Value(found[i]) for i in made.entries]

    def number(q: Fraction) -> Value:
        return Value(arb(fmpq(q.numerator, q.denominator)))

    return [x.v for x in evaluate(tape, number, [Value(v) for v in variables], called)]


@pytest.fixture
def many_digits() -> Any:
    with ctx.workprec(BITS):
        yield


@pytest.mark.parametrize("name", sorted({*MAPS} & {*DEFINITIONS}))
def test_the_earlier_attacks_know_all_functions(name: str) -> None:
    """tests/checker/test_attack_networks.py draws them from test_networks.FUNCTIONS, and then has no values."""
    assert earlier_attacks.phi(name, arb(1) / 3).overlaps(DEFINITIONS[name](arb(1) / 3))


# ---------------------------------------------------------------------------------------------------------- the rows


def edges() -> Array:
    """Points of the grid of h = 2^-5, half-points, their neighbours, ends of tables and tiny and huge numbers."""
    rng, h = np.random.default_rng(0), 2.0**-5
    grid = np.concatenate([rng.integers(-1280, 1281, 40), [0, 1, -1, 1280, -1280]]) * h
    halves = np.concatenate([grid, grid + h / 2, grid - h / 2, [64.0, -64.0, 20.0, -20.0]])
    others = np.array([5e-324, 1e-310, 2.0**-1022, 41.0, 700.0, 1e17, 1e300, 1.7e308])
    found = np.concatenate([halves, np.nextafter(halves, 100), np.nextafter(halves, -100), others, -others])
    return found[found != 0]


@pytest.mark.usefixtures("many_digits")
@pytest.mark.parametrize("name", ["silu", "gelu", "softplus", "mish", "sigmoid", "elu", "softsign", "relu", "abs"])
def test_values_at_the_edges_of_tables(name: str) -> None:
    y = edges()
    with np.errstate(all="ignore"):
        f = FUNCTIONS[name].at(Near(y))[0]
    for v, found, error in zip(y.tolist(), f.value, np.broadcast_to(f.error.top, y.shape), strict=True):
        if abs(v) < 1e6:
            assert not abs(DEFINITIONS[name](arb(v)) - arb(float(found))) > arb(float(error))
            assert error <= 2.0**-45 * (1 + abs(v))
        elif name in ("silu", "gelu", "softplus", "mish"):  # no formula of these has an answer in 300 bits
            assert abs(found - max(v, 0)) < error <= 2.0**-45
    with np.errstate(all="ignore"):
        lost = FUNCTIONS[name].at(Near(np.array([np.nan, np.inf, -np.inf])))
        assert not np.any(np.isfinite(np.abs(lost[0].value) + lost[0].error.top))


# ------------------------------------------------------------------------------------------------------- kinks on balls


def kinked(rng: Any, reads: int, middle: Array, scale: float) -> Network:
    """A network whose preactivations at the ball's middle are some share of how far they move on the ball, or much
    less: units with one kink, kinks of kinks, kinks behind sums and others, kinks of expressions."""
    steps, at = list[Step](), [middle[:, None]]

    def add(step: Step) -> int:
        steps.append(step)
        at.append(Numbers().make(step, [at[i] for i in step.of]))
        return len(at) - 1

    def near_kinks(i: int, rows: int) -> int:
        W = rng.normal(size=(rows, len(at[i])))
        often = [0.02, 0.03, 0.15, 0.2, 0.2, 0.15, 0.15, 0.1]
        shares = rng.choice([1e-9, 1e-3, 0.1, 0.5, 0.9, 1, 1.1, 3], rows, p=often)
        away = rng.choice([-1.0, 1.0], rows) * scale * shares * np.linalg.norm(W, axis=1)
        return add(Affine((i,), rows, W, away - W @ at[i][:, 0]))

    for _ in range(int(rng.integers(1, 4))):
        i = near_kinks(len(at) - 1, int(rng.integers(1, 5)))
        width = len(at[i])
        if rng.random() < 0.3:
            names = tuple("abcdefghijklmnopqrst"[:width])
            trees = [["abs", "a"], ["max", "a", names[-1]], ["*", "a", ["abs", names[-1]]]]
            i = add(Observe((i,), 3, names, parse(trees, names, "here")))
        else:
            i = add(Map((i,), width, str(rng.choice([*CORNERED, *CORNERED, "silu", "mish", "gelu", "sigmoid"]))))
        if rng.random() < 0.4:
            j = int(rng.integers(0, len(at)))
            i = add(Concat((i, j), len(at[i]) + len(at[j])))
        if rng.random() < 0.3:
            k = add(Map((i,), len(at[i]), str(rng.choice(CORNERED))))
            add(Sum((k, i), len(at[i])))
    add(Affine((len(at) - 1,), 2, rng.normal(size=(2, len(at[-1]))), rng.normal(size=2)))
    return Network("net", reads, tuple(needed(steps)))


def directions(rng: Any, count: int) -> list[list[arb]]:
    turns = rng.uniform(0, 2 * np.pi, count)
    lengths = (1 - 1e-9) * rng.choice([1.0, 1.0, 0.9, 0.5, 1e-3], count)
    return [[arb(float(r * np.cos(t))), arb(float(r * np.sin(t)))] for t, r in zip(turns, lengths, strict=True)]


def length(d: Sequence[arb]) -> arb:
    return sum((v * v for v in d), ZERO).sqrt()


def polynomial(a: Sequence[arb], Q: Array, K: Array, d: list[arb]) -> arb:
    p, q, r, often = triples(len(d))
    known = sum((x * y for x, y in zip(a, d, strict=True)), ZERO) + linear(Q.ravel(), [x * y for x in d for y in d])
    each = zip(often.tolist(), K.tolist(), p, q, r, strict=True)
    return known + sum((arb(w) * arb(v) * d[i] * d[j] * d[k] for w, v, i, j, k in each), ZERO)


def no_steeper(rests: Sequence[tuple[list[arb], arb]], most: arb) -> bool:
    """The rests change by no more than this times the distance, between any two of some points."""
    for (d, v), (e, w) in combinations(rests, 2):
        if abs(v - w) > most * length([x - y for x, y in zip(d, e, strict=True)]):
            return False
    return True


@pytest.mark.usefixtures("many_digits")
@pytest.mark.parametrize("seed", slow_after(20, range(60)))
def test_a_network_with_kinks_lies_in_its_model_to_the_last_bit(seed: int) -> None:
    rng = np.random.default_rng(100 + seed)
    scale, units = 10.0 ** rng.uniform(-6, -0.3), Units(np.zeros((2, 2, 0)), np.zeros((0, 0)))
    given = [a_jet(rng, 2, scale, units)[0] for _ in range(2)]
    network = kinked(rng, 2, np.array([float(v.c.value) for v in given]), scale)
    with np.errstate(all="ignore"):
        h = ball.OnBall(2).value(network, given)
        steep, slack = h.lipschitz.top, h.a.error.top
    if not np.all(np.isfinite(h.radius.top) & np.isfinite(h.v0.size.top)):
        pytest.skip("no finite model")
    M = h.remainder + np.tensordot(h.units.U, np.abs(h.B.value), 1)
    start = Values().run(network, [arb(float(v.c.value)) for v in given])
    each = zip(start, h.c.value.tolist(), h.c.error.top.tolist(), strict=True)
    assert not any(abs(v - arb(c)) > arb(e) for v, c, e in each)
    rests: list[list[tuple[list[arb], arb]]] = [[], []]
    for d in directions(rng, 10):
        true = Values().run(network, [arb(float(v.c.value)) + linear(v.a.value, d) for v in given])
        for j in range(2):
            a = [arb(float(v)) for v in h.a.value[:, j]]
            rest = true[j] - start[j] - polynomial(a, h.Q.value[..., j], h.K.value[:, j], d)
            most = linear(M[..., j].ravel(), [x * y for x in d for y in d])
            assert not abs(rest) > most * (1 + 2.0**-50) + arb(float(slack[j])) * length(d)
            rests[j].append((d, rest))
    for j in range(2):
        if np.isfinite(steep[j]):
            assert no_steeper(rests[j], arb(float(steep[j])) + arb(float(slack[j])))


def on_a_line(c: float, a: float) -> tuple[Jet, Model]:
    """c + a d for |d| <= 1, in both programs."""
    x = constant(Fraction(0), Units(np.zeros((1, 1, 0)), np.zeros((0, 0))))
    return replace(x, c=Near(np.float64(c)), a=Vector(np.array([a]))), Model.affine(arb(c), [arb(a)], lip=ZERO)


@pytest.mark.usefixtures("many_digits")
@pytest.mark.parametrize("bent", [False, True])
@pytest.mark.parametrize("name", [*CORNERED, "abs"])
def test_one_kink_on_a_line(name: str, bent: bool) -> None:
    """Of x, and of x + x^2, wherever the kink is: where relu and abs reach their bound, beside it, and beyond."""
    rng = np.random.default_rng(7)
    for _ in range(60):
        c = float(rng.choice([-1.0, 1.0]) * 10.0 ** rng.uniform(-9, 0))
        a = c * float(rng.choice([-1, 1]) * rng.choice([0.3, 0.999999, 1.0, 1.000001, 2.0, 3.0, 1e3, 1e6]))
        with np.errstate(all="ignore"):
            jet, model = on_a_line(c, a)
            jet, model = (jet + jet * jet, model + model * model) if bent else (jet, model)
            jet, model = jet.function(name), model.function(name)
            p, e = float(jet.a.value[0]), float(jet.a.error.top)
            Q, K, M = jet.Q.value[0, 0], jet.K.value[0], jet.remainder[0, 0]
            steep = [arb(float(jet.lipschitz.top)) + arb(e), model.lip]
        (P,), (R,), (L,), (W,) = (part.entries() for part in (model.a, model.Q, model.K, model.whole))
        assert np.isfinite(M) and W.is_finite() and steep[1] is not None
        rests: list[list[tuple[list[arb], arb]]] = [[], []]
        for share in (-1.0, 1.0, -c / a, -2 * c / a, -1.5 * c / a, -c / a * (1 + 1e-9), 0.5, -0.3):
            if abs(share) > 1:
                continue
            d = arb(share)
            x = arb(c) + arb(a) * d
            start, x = (arb(c) + arb(c) ** 2, x + x * x) if bent else (arb(c), x)
            moved = DEFINITIONS[name](x) - DEFINITIONS[name](start)
            own = moved - arb(p) * d - arb(float(Q)) * d**2 - arb(float(K)) * d**3
            theirs = moved - P * d - R * d**2 - L * d**3
            assert not abs(own) > arb(float(M)) * d**2 + arb(e) * abs(d) and not abs(theirs) > W * d**2
            rests[0].append(([d], own))
            rests[1].append(([d], theirs))
        assert all(not most.is_finite() or no_steeper(each, most) for each, most in zip(rests, steep, strict=True))


def equations_with_kinks(seed: int) -> tuple[Document, Array]:
    """Two states, a policy, two networks that equations call with kinks in their arguments, and a quantity that moves
    kinks; with a ball of its own, for a claim that has the rule contraction."""
    rng = np.random.default_rng(seed)
    scale, at = 10.0 ** rng.uniform(-5, -0.6), rng.normal(size=2)
    middles = {"policy": at, "f": np.array([0.0, 0.25]), "g": np.array([1.0, -0.5])}
    reach = scale * float(rng.choice([1e-9, 1e-3, 0.05]))
    near = [str(Fraction(float(scale * v))) for v in rng.choice([1e-6, 0.4, 0.9, 1.2, 3], 3) * (1, -1, 1)]
    f = ["+", "x", "q"], ["+", "1/4", ["*", "x", "y"]]
    data = make(
        [["+", "x", "u"], ["+", "y", "v"]], [(np.zeros((2, 2)), np.zeros(2))], np.eye(2), (1.0, 1.0), states=("x", "y"),
        inputs=("u", "v"), u_eq=("0", "0"), domain=[("-9", "9")] * 2, input_bounds=[("-999", "999")] * 2,
        squash=str(rng.choice(["tanh", "identity"])), centre="none", scale=[1.5, -0.7], offset=[0.1, 0.2],
        claim="nearby", time=str(rng.choice(["discrete", "continuous"])),
        uncertain=[("q", str(Fraction(-reach)), str(Fraction(reach)))],
    )  # fmt: skip
    data = newer(data)
    data["networks"] = [
        {"name": name, "reads": 2, "steps": [written(step) for step in kinked(rng, 2, middle, scale).steps]}
        for name, middle in middles.items()
    ]
    data["plant"]["dynamics"] = [
        ["+", call("f", *f), ["*", "u", ["abs", ["+", "x", near[0], ["*", str(rng.choice(["0", "1"])), "q"]]]]],
        ["-", ["max", ["+", "v", ["*", "q", "x"]], ["-", ["+", "v", near[1]], "y"]],
         ["*", ["network", "f", 1, *f], call("g", ["+", "1", ["abs", ["+", "y", near[2]]]], ["-", "q", "1/2"])]],
    ]  # fmt: skip
    J = rng.normal(size=(2, 2)) * scale
    data["policy"].update(network="policy", origin=encode(at))
    data["evidence"]["contraction"] = {"J": encode(J), "weights": encode([1.0, 1.0]), "weight": encode(np.eye(2))}
    data["policy"]["sha256"] = hash_of(data)
    return data, J


def written(step: Step) -> Document:
    match step:
        case Affine():
            return affine(step.of[0], step.weight, step.bias)
        case Map():
            return {"kind": "map", "of": list(step.of), "function": step.function}
        case Observe():
            trees = list(step.tape.trees)
            return {"kind": "observe", "of": list(step.of), "names": list(step.names), "expressions": trees}
    return {"kind": type(step).__name__.lower(), "of": list(step.of)}


def changes(c: document.Certificate, x: list[arb], q: arb) -> list[arb]:
    raw = Values().run(c.policy.network, [arb(float(v)) + a for v, a in zip(c.policy.origin, x, strict=True)])
    raw = [v.tanh() for v in raw] if c.policy.squash == "tanh" else raw
    ends = zip(c.policy.scale.tolist(), raw, c.policy.offset.tolist(), strict=True)
    F = values(c.dynamics, [*x, *(arb(s) * v + arb(o) for s, v, o in ends), q])
    return [f - v for f, v in zip(F, x, strict=True)] if c.discrete else F


def of_the_reference(data: Document, J: Array, ends: tuple[Fraction, Fraction]) -> list[Model] | None:
    """With Lipschitz constants, or without them where there are none."""
    with ctx.workprec(PRECISION):
        exact, (lo, hi) = fmpq_mat([[fmpq(*v.as_integer_ratio()) for v in row] for row in J.tolist()]), ends
        cell = ((fmpq(lo.numerator, lo.denominator), fmpq(hi.numerator, hi.denominator)),)
        around = Loop(read(json.dumps(data).encode()))
        for steady in (True, False):
            try:
                states = around.states(exact, None, steady)
                known = around.unclipped(states, *around.inputs(states, True, "local", "ball"), "local", "ball")
                return Steps(around, known).change(cell, "local", "ball").components
            except Refused:
                pass
        return None


@pytest.mark.usefixtures("many_digits")
@pytest.mark.parametrize("seed", slow_after(20, range(60)))
def test_equations_with_kinks_lie_in_the_models_of_both_programs(seed: int) -> None:
    """Values at d = 0, on the ball, and how fast what is beyond the models changes, for one q at a time."""
    rng, (data, J) = np.random.default_rng(seed), equations_with_kinks(400 + seed)
    c = document.certificate(json.loads(json.dumps(data)), "")
    with np.errstate(all="ignore"):
        G, (lo, hi) = Ball(Case(c), J, "here").change(c.ranges), c.ranges[0]
        parts = [part for g in G for part in (g.v0.size.top, g.radius.top, g.remainder, g.slack.top)]
        known = all(np.all(np.isfinite(part)) for part in parts)
    theirs = of_the_reference(data, J, c.ranges[0])
    if not known and theirs is None:
        pytest.skip("no finite model")
    for y in (Fraction(1), Fraction(-1), Fraction(float(rng.uniform(-1, 1)))):
        q, share = (lo + hi) / 2 + (hi - lo) / 2 * y, arb(fmpq(y.numerator, y.denominator))
        of_q = arb(fmpq(q.numerator, q.denominator))
        start, points = changes(c, [ZERO, ZERO], of_q), directions(rng, 5)
        there = [changes(c, [linear(row, d) for row in J], of_q) for d in points]
        moved = [[v - s for v, s in zip(found, start, strict=True)] for found in there]
        for j in range(2):
            own = [(d, v[j]) for d, v in zip(points, moved, strict=True)]
            if known:
                lies_in_the_checkers(G[j], share, start[j], own)
            if theirs is not None:
                lies_in_the_references(theirs[j].where([share]), start[j], own)


def lies_in_the_checkers(g: Jet, y: arb, start: arb, moved: list[tuple[list[arb], arb]]) -> None:
    with np.errstate(all="ignore"):
        off, slack, steep = (arb(float(v.top)) for v in (g.error, g.slack, g.lipschitz))
        M = g.remainder + np.tensordot(g.units.U, np.abs(g.B.value), 1)
    assert not abs(start - arb(float(g.c.value)) - y * arb(float(g.c_y.value[0]))) > off
    a = [arb(float(v)) + y * arb(float(w)) for v, w in zip(g.a.value, g.a_y.value[:, 0], strict=True)]
    rests = [(d, v - polynomial(a, g.Q.value, g.K.value, d)) for d, v in moved]
    for d, rest in rests:
        most = linear(M.ravel(), [u * w for u in d for w in d])
        assert not abs(rest) > most * (1 + 2.0**-50) + slack * length(d)
    assert not steep.is_finite() or no_steeper(rests, steep + slack)


def lies_in_the_references(g: Model, start: arb, moved: list[tuple[list[arb], arb]]) -> None:
    assert not abs(start - g.v) > g.off
    rests = list[tuple[list[arb], arb]]()
    for d, v in moved:
        column = arb_mat(2, 1, d)
        known = (g.a.transpose() * column + column.transpose() * g.Q * column)[0, 0]
        for each, entry in zip(combinations_with_replacement(range(2), 3), g.K.entries(), strict=True):
            known += (1, 3, 6)[len(set(each)) - 1] * entry * d[each[0]] * d[each[1]] * d[each[2]]
        rests.append((d, v - known))
        assert not abs(v - known) > (column.transpose() * g.whole * column)[0, 0] + g.turn * length(d)
    assert g.lip is None or no_steeper(rests, g.lip + g.slack)


# --------------------------------------------------------------------------- loops that are false because of a kink

T = 0.125  # where the kinks are
SHIFT = str(Fraction(T))


@cache
def base() -> str:
    still = make(
        [["-", "x"]], [([[0.0]], [0.0])], [[1.0]], (1.0, 1.0), squash="identity", centre="none", scale=[1.0],
        domain=(("-99", "99"),), input_bounds=(("-999", "999"),),
    )  # fmt: skip
    return json.dumps(newer(still))


def sampled(c: Any, J: Any, rng: np.random.Generator, count: int) -> Iterator[tuple[arb, int, arb, Any]]:
    """For q at the ends, the middle and within the range: its place, and of each equation its number, its value at
    d = 0, and its changes at so many d."""
    lo, hi = c.ranges[0]
    for y in (Fraction(1), Fraction(-1), Fraction(0), Fraction(float(rng.uniform(-1, 1)))):
        q, share = (lo + hi) / 2 + (hi - lo) / 2 * y, arb(fmpq(y.numerator, y.denominator))
        of_q = arb(fmpq(q.numerator, q.denominator))
        start, points = changes(c, [ZERO, ZERO], of_q), directions(rng, count)
        there = [changes(c, [linear(row, d) for row in J], of_q) for d in points]
        for j in range(2):
            yield share, j, start[j], [(d, found[j] - start[j]) for d, found in zip(points, there, strict=True)]


def on_a_ball(
    tree: Any, r: float, f: Document | None = None, claim: Any = None, policy: Any = None, **plant: Any
) -> bytes:
    """The claim of one state that {|x| <= r} is attracted, by the local rule alone."""
    data = json.loads(base())
    data["plant"].update(dynamics=[["+", tree, ["*", "0", "u"]]], **plant)
    data["networks"] += [f] if f else []
    data["networks"][0]["steps"] = policy or data["networks"][0]["steps"]
    data["claim"].update(claim or {})
    data["levels"] = {"local": (r * r).hex(), "roa": (r * r).hex()}
    data["evidence"].update(root=encode([r * (1 + 1e-12)]), cells=[1] * len(data["plant"]["uncertain"]))
    data["evidence"]["local"].update(J=encode([[r * (1 + 1e-9)]]), multipliers=encode([[0.0], [2.0**-60], [1.0]]))
    data["policy"]["sha256"] = hash_of(data)
    return json.dumps(data).encode()


def mapped(of: int, function: str) -> Document:
    return {"kind": "map", "of": [of], "function": function}


def behind(*functions: str, shift: float = -T, more: float = -T / 8) -> Document:
    """phi(x + shift), and further functions of what that gives and a further shift."""
    steps = list[Document]()
    for k, function in enumerate(functions):
        steps += [affine(2 * k, [[1.0]], [more if k else shift]), mapped(2 * k + 1, function)]
    return net("f", *steps)


F: Any = call("f", "x")
PLUS = ["+", "x", SHIFT]
TWICE = net("f", affine(0, [[1.0], [1.0]], [-T, -T]), mapped(1, "relu"), affine(2, [[1.5, 1.5]]))
BEYOND = [affine(0, [[1.0]], [-T]), mapped(1, "relu"), affine(2, [[-8.0]])]
STEEP = [*BEYOND, affine(0, [[-1.0]]), {"kind": "sum", "of": [3, 4]}]
RANGE = [{"name": "q", "range": ["0", "3"]}]
HELD: Any = {"sample": ["1/4", "1/2"]}
TURN: Any = ["-", "x", SHIFT]
Claim = Callable[[float], bytes]
OF_ONE_STATE: dict[str, tuple[Claim, float, float]] = {  # up to which r it is true, and what is shown
    "relu": (lambda r: on_a_ball(["-", ["*", "3", F], "x"], r, behind("relu")), 1.5 * T, 0.6),
    "relu of relu": (lambda r: on_a_ball(["-", ["*", "3", F], "x"], r, behind("relu", "relu")), 1.5 * 1.125 * T, 0.5),
    "two units with one kink": (lambda r: on_a_ball(["-", F, "x"], r, TWICE), 1.5 * T, 0.6),
    "abs": (lambda r: on_a_ball(["-", ["*", "3/2", ["+", ["abs", TURN], TURN]], "x"], r), 1.5 * T, 0.6),
    "abs of relu": (
        lambda r: on_a_ball(["-", ["*", "3/2", ["+", ["abs", ["-", F, "1/4"]], F, "-1/4"]], "x"], r, behind("relu")),
        4.5 * T, 0.2,
    ),
    "elu": (lambda r: on_a_ball(["-", ["*", "16", ["-", PLUS, F]], "x"], r, behind("elu", shift=T)), 0.275, 0.3),
    "a range": (lambda r: on_a_ball(["-", ["*", "q", F], "x"], r, behind("relu"), uncertain=RANGE), 1.5 * T, 0.6),
    "discrete time": (
        lambda r: on_a_ball(["-", ["/", "x", "2"], ["*", "4", F]], r, behind("relu"), time="discrete"), 1.6 * T, 0.5,
    ),
    "a held input": (lambda r: on_a_ball("u", r, claim=HELD, policy=STEEP), 1.6 * T, 0.5),
}  # fmt: skip


def is_limited(program: Callable[[bytes], str | None], claim: Claim, limit: float, share: float) -> None:
    """A share of the limit up to which a claim is true is accepted, and nothing beyond the limit."""
    assert program(claim(share * limit)) is None
    for r in (1.001, 1.01, 1.1, 1.5, 3.0):
        assert program(claim(r * limit)) == "local"


@PROGRAMS
@pytest.mark.parametrize("name", OF_ONE_STATE)
def test_a_kink_off_the_middle_limits_a_ball(name: str, program: Callable[[bytes], str | None]) -> None:
    """The tangent alone would show any level: what lies beyond the kink turns outwards, or overshoots."""
    is_limited(program, *OF_ONE_STATE[name])


@PROGRAMS
def test_a_relu_with_its_kink_in_the_middle_has_no_model(program: Callable[[bytes], str | None]) -> None:
    """Also where it would do no harm, or its factor is 0, or the argument only touches 0."""
    f = net("f", mapped(0, "relu"))
    for tree in (["-", ["*", "2", F], "x"], ["-", ["/", F, "-2"], "x"], ["-", ["*", "0", F], "x"]):
        assert program(on_a_ball(tree, 0.5, f)) == "local"
    assert program(on_a_ball(["-", call("f", ["*", "x", "x"]), "x"], 0.5, f)) == "local"


@PROGRAMS
@pytest.mark.parametrize(
    ("tree", "falls"),
    [
        (["-", ["*", "2", ["abs", "x"]], "x"], False),  # x' = x for x > 0
        (["-", ["/", ["abs", "x"], "-2"], "x"], True),
        (["-", ["*", "0", ["abs", "x"]], "x"], True),
        (["-", ["abs", ["*", "x", "x"]], "x"], True),  # up to x = 1
        (["-", ["*", "2", ["abs", ["*", "x", "x"]]], "x"], False),  # up to x = 1/2, and the ball reaches further
    ],
)
def test_abs_with_its_corner_in_the_middle(tree: Any, falls: bool, program: Callable[[bytes], str | None]) -> None:
    assert program(on_a_ball(tree, 0.5)) == (None if falls else "local")


# ------------------------------------------------------------------------------------------- contraction, N of outer


def contracts(data: Document) -> set[str]:
    """The programs whose rule contraction accepts."""
    found, c = set[str](), document.certificate(json.loads(json.dumps(data)), "")
    with np.errstate(all="ignore"):
        try:
            rules.Tally().hold(
                contraction.OF_CONTRACTION,
                contraction.Contracted.of(Case(c)),
            )
            found.add("checker")
        except Rejected:
            pass
    with ctx.workprec(PRECISION):
        r = read(json.dumps(data).encode())
        assert isinstance(r.evidence, Tree) and r.evidence.contraction is not None
        try:
            other.contraction(Loop(r), r.evidence.contraction, r.evidence.cells)
            found.add("reference")
        except Refused:
            pass
    return found


def closer(tree: Any, f: Document | None, r: float, time: str, weight: float) -> Document:
    data = newer(make(
        [["-", "x"]], [([[0.0]], [0.0])], [[1.0]], (r * r, r * r), squash="identity", centre="none", scale=[1.0],
        domain=(("-99", "99"),), input_bounds=(("-9", "9"),), claim="nearby", time=time,
    ))  # fmt: skip
    data["plant"]["dynamics"] = [["+", tree, ["*", "0", "u"]]]
    data["networks"] += [f] if f else []
    ball = {"J": encode([[r * (1 + 1e-9)]]), "weights": encode([weight]), "weight": encode([[1.0]])}
    data["evidence"]["contraction"] = ball
    data["policy"]["sha256"] = hash_of(data)
    return data


CLOSER: dict[str, tuple[Any, Document | None, str]] = {  # pairs beyond T part, all others come closer
    "steps beyond a relu": (["+", ["/", "x", "2"], ["*", "3/4", F], "1/64"], behind("relu"), "discrete"),
    "steps that turn beyond a relu": (
        ["-", ["-", "1/64", ["/", "x", "2"]], ["*", "3/4", F]], behind("relu"), "discrete",
    ),
    "steps beyond abs": (["+", ["*", "7/8", "x"], ["/", ["abs", ["-", "x", SHIFT]], "4"]], None, "discrete"),
    "time beyond a relu": (["+", ["-", "x"], ["*", "3/2", F], "1/64"], behind("relu"), "continuous"),
    "time beyond abs": (["+", ["*", "-1/4", "x"], ["/", ["abs", ["-", "x", SHIFT]], "2"]], None, "continuous"),
}  # fmt: skip


@pytest.mark.parametrize("name", CLOSER)
def test_pairs_beyond_a_kink_do_not_come_closer(name: str) -> None:
    tree, f, time = CLOSER[name]
    weights = (2.0**-40, 2.0**-20, 0.01, 0.1)
    assert set().union(*(contracts(closer(tree, f, 0.4 * T, time, w)) for w in weights)) == {"checker", "reference"}
    for r in (1.001, 1.05, 1.5, 4.0):
        assert not any(contracts(closer(tree, f, r * T, time, w)) for w in weights)


@pytest.mark.parametrize("function", ["elu", "softsign"])
@pytest.mark.parametrize("time", ["continuous", "discrete"])
def test_kinks_without_a_leap_have_no_constant(function: str, time: str) -> None:
    """Where the sign is certain they have one, elsewhere the rule has no answer."""
    tree = ["*", "1/8", call("f", "x")] if time == "discrete" else ["-", ["*", "1/8", call("f", "x")], "x"]
    near, beyond = (closer(tree, behind(function, shift=T), r * T, time, 1e-3) for r in (0.9, 1.1))
    assert contracts(near) == {"checker", "reference"} and not contracts(beyond)


@PROGRAMS
@pytest.mark.parametrize("function", ["relu", "abs", "elu", "softsign", "softplus"])
def test_a_function_with_a_kink_has_no_derivative(function: str, program: Callable[[bytes], str | None]) -> None:
    """N = x^2 + phi(4 (x - 3/2))/8 falls on both sides of 3/2, which is a corner of leaves, and has none of its own."""
    data = newer(earlier_attacks.odd_loop())
    steps = [affine(0, [[4.0]], [-6.0]), mapped(1, function)]
    inner = ["abs", ["*", "4", ["-", "x", "3/2"]]] if function == "abs" else call("g", "x")
    data["networks"] += [] if function == "abs" else [net("g", *steps)]
    data["plant"]["input_bounds"] = [["-100", "100"]]
    data["claim"]["outer"] = {"expression": ["+", ["*", "x", "x"], ["/", inner, "8"]], "level": (3.5).hex()}
    leaf = encode_tree(1)
    data["evidence"]["outer"] = {
        "T": encode([1.0]), "root": encode([3.0]), "tree": encode_tree(512), "faces": [leaf, leaf],
    }  # fmt: skip
    data["policy"]["sha256"] = hash_of(data)
    assert program(json.dumps(data).encode()) == (None if function == "softplus" else "outer")


# ------------------------------------------------------------------------------------------------- faults, as found
