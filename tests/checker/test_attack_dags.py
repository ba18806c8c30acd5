"""Attacks on observations, sums and concats: random networks with connections that skip many steps and expressions of
all kinds between them, in both checkers, on boxes, on balls and along a field, against Arb without a tolerance."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from flint import arb, ctx

from certify.checker import ball
from certify.checker.calls import enclose
from certify.checker.expression import evaluate, parse
from certify.checker.jets import Units
from certify.checker.near import Above, Form, triples
from certify.checker.networks import FUNCTIONS as MAPS
from certify.checker.networks import Affine, Map, Network, Step
from certify.checker.outer import Dual, InRows
from certify.checker.taylor import Taylor, constants
from certify.checker.taylor import affine as form_of
from certify.checker.wiring import Clip, Concat, Observe, Sum
from certify.reference.affine import OnBoxes
from certify.reference.balls import PRECISION
from certify.reference.model import Model
from certify.reference.refusal import Refused
from certify.reference.tangents import OnBall
from tests.checker.test_attack_networks import Truths, linear, true_values, value_of
from tests.checker.test_networks import a_jet, needed
from tests.reference.test_networks import read
from tests.support.marks import slow_after
from tests.support.models import curved as curved_in
from tests.support.models import form as form_in
from tests.support.models import linear as linear_in

Array = Any
BITS = 300
SEEDS = slow_after(12, range(240))


@pytest.fixture(autouse=True)
def many_digits() -> Any:
    with ctx.workprec(BITS):
        yield


def a_tree(rng: Any, names: list[str], depth: int) -> Any:
    """An expression that has a value at most states: roots and quotients are of what is positive nearly everywhere."""
    if depth == 0 or rng.random() < 0.15:
        return str(rng.choice(names)) if rng.random() < 0.85 else str(rng.choice(["1/3", "-2", "7/5"]))
    a, b = (a_tree(rng, names, depth - 1) for _ in range(2))
    above = ["+", "1", ["*", b, b]]
    match rng.choice(SHAPES):
        case "product":
            return ["*", a, b]
        case "sum":
            return ["+", a, ["-", b], a_tree(rng, names, 0)]
        case "quotient":
            return ["/", a, above]
        case "root":
            return ["sqrt", above]
        case "power":
            return ["**", a, int(rng.integers(2, 5))]
        case "inverse":
            return ["**", above, -int(rng.integers(1, 3))]
        case "corner":
            return ["abs", a] if rng.random() < 0.5 else ["max", a, b]
        case "same":
            return ["-", ["*", a, a], ["*", a, a_tree(rng, names, 0)]]
    return [str(rng.choice(["sin", "cos", "tanh", "atan", "exp"])), ["*", str(rng.choice(["1/2", "1", "-3/2"])), a]]


SHAPES = [*["product"] * 3, "sum", "quotient", "root", "power", "inverse", "same", *["function"] * 3, "corner"]


def a_dag(seed: int, reads: int, corners: bool = True) -> Network:
    """Steps that read any vectors before them, which need not be near; the same vector more than once, too."""
    rng = np.random.default_rng([11, seed])
    sizes, steps = [reads], list[Step]()
    maps = [name for name in MAPS if name != "sqrt" and (corners or name not in ("relu", "elu", "softsign"))]
    kinds = ["observe"] * 4 + ["sum"] * 3 + ["concat"] * 3 + ["affine"] * 3 + ["map"] * 3 + ["clip"] * corners

    def add(step: Step) -> int:
        steps.append(step)
        sizes.append(step.size)
        return len(steps)

    def affine(i: int, rows: int) -> int:
        W = rng.normal(size=(rows, sizes[i])) * float(rng.choice([0.3, 0.7, 1.0])) / np.sqrt(sizes[i])
        return add(Affine((i,), rows, W, rng.normal(size=rows) * 0.3))

    for kind in rng.choice(kinds, int(rng.integers(4, 12))):
        i = int(rng.integers(0, len(sizes)))
        others = tuple(int(j) for j in rng.integers(0, len(sizes), int(rng.integers(1, 4))))
        match kind:
            case "affine":
                affine(i, int(rng.integers(1, 5)))
            case "map":
                add(Map((i,), sizes[i], str(rng.choice(maps))))
            case "clip":
                lo = rng.normal(size=sizes[i]) - 1.0
                add(Clip((i,), sizes[i], lo, lo + rng.uniform(0.1, 3.0, sizes[i])))
            case "concat" if sum(sizes[j] for j in (i, *others)) <= 12:
                add(Concat((i, *others), sum(sizes[j] for j in (i, *others))))
            case "sum":
                same = [j for j, size in enumerate(sizes) if size == sizes[i]]
                of = tuple(int(j) for j in rng.choice(same, int(rng.integers(2, 5))))
                add(Sum(of, sizes[i]))
            case "observe":
                names = [f"{letter}{seed % 7}" for letter in "abcdefghijkl"[: sizes[i]]]
                trees = [a_tree(rng, names, int(rng.integers(1, 4))) for _ in range(int(rng.integers(1, 5)))]
                text = str(trees)
                if corners or not ("abs" in text or "max" in text):
                    add(Observe((i,), len(trees), tuple(names), parse(trees, names, "here")))
    ends = [affine(i, 2) for i in (len(steps), int(rng.integers(0, len(sizes))), 0)]
    add(Sum(tuple(ends), 2))
    return Network("net", reads, tuple(needed(steps)))


def arbs(values: Any) -> list[arb]:
    return [arb(float(v)) for v in np.ravel(values)]


def inner(p: list[arb], q: list[arb]) -> arb:
    return sum((a * b for a, b in zip(p, q, strict=True)), arb(0))


def corner_of(rng: Any, k: int) -> Array:
    return np.sign(rng.normal(size=k)) * rng.random(k) ** rng.choice([0.0, 0.2, 1.0])


@pytest.mark.parametrize("seed", SEEDS)
def test_values_lie_within_their_forms_on_boxes(seed: int) -> None:
    """Of arguments that are known within an error, in both programs; two entries and one of them again."""
    rng = np.random.default_rng([12, seed])
    net, radius = a_dag(seed, 2), float(10.0 ** rng.uniform(-6, 0))
    x = np.concatenate([rng.normal(size=(1, 2, 1)), rng.normal(size=(3, 2, 1)) * radius])
    doubt = np.abs(rng.normal(size=(2, 1))) * radius * float(rng.choice([0.0, 0.1]))
    with np.errstate(all="ignore"):
        u = enclose(net, Form(x, Above(doubt)), (1, 0, 1))
    with ctx.workprec(PRECISION):
        algebra = OnBoxes(1)
        first = algebra.given([arbs(x[:, i, 0]) for i in range(2)], [arbs(row) for row in doubt])
        try:
            theirs = algebra.forms(read(net).run(algebra, first), [1, 0, 1])
        except Refused:
            theirs = None
    for _ in range(10):
        d = arbs(corner_of(rng, 3))
        share = arbs(rng.choice([-1.0, 1.0, 0.5], 2))
        at = [arb(float(x[0, i, 0])) + linear(x[1:, i, 0], d) + share[i] * arb(float(doubt[i, 0])) for i in range(2)]
        value = Truths().run(net, at)
        for j, k in enumerate((1, 0, 1)):
            own = value[k] - arb(float(u.value[0, j, 0])) - linear(u.value[1:, j, 0], d)
            assert not abs(own) > arb(float(u.error.top[j, 0]))
            if theirs is not None:
                middle, slopes, error = theirs[j][0]
                assert not abs(value[k] - middle - inner(slopes, d)) > error


@pytest.mark.parametrize("seed", SEEDS)
def test_values_lie_within_their_models_on_balls(seed: int) -> None:
    """Of arguments that bend, in both programs: values, and how far rests of two states are apart."""
    rng = np.random.default_rng([13, seed])
    k, scale = 2, float(10.0 ** rng.uniform(-5, -0.5))
    net, units = a_dag(seed, 2), Units(np.zeros((k, k, 0)), np.zeros((0, 0)))
    given = [a_jet(rng, k, scale, units)[0] for _ in range(2)]
    bends = seed % 2 == 1
    with np.errstate(all="ignore"):
        h = ball.OnBall(k).value(net, [v * v + v.function("sin") for v in given] if bends else given)
        slack, steep = h.a.error.top, h.lipschitz.top
    known = bool(np.all(np.isfinite(h.v0.size.top) & np.isfinite(h.radius.top)))
    M = h.remainder + np.tensordot(h.units.U, np.abs(h.B.value), 1)
    with ctx.workprec(PRECISION):
        models = [Model.affine(arb(float(v.c.value)), arbs(v.a.value), lip=arb(0)) for v in given]
        models = [v * v + v.function("sin") for v in models] if bends else models
        algebra = OnBall(models)
        try:
            theirs, _ = algebra.results(read(net).run(algebra, algebra.first), [0, 1])
        except Refused:
            theirs = None
    if not known and theirs is None:
        pytest.skip("no finite model")
    p, q, r, often = triples(k)

    def value(d: list[arb]) -> list[arb]:
        x = [arb(float(v.c.value)) + linear(v.a.value, d) for v in given]
        return Truths().run(net, [v * v + v.sin() for v in x] if bends else x)

    start, rests = value([arb(0)] * k), list[tuple[list[arb], list[arb], list[arb]]]()
    for _ in range(8):
        direction = rng.normal(size=k)
        d = arbs(direction / np.linalg.norm(direction) * (1 - 1e-9) * rng.choice([1.0, 1.0, 0.5, 1e-3]))
        floats, mine, others = [float(v) for v in d], list[arb](), list[arb]()
        for j, v in enumerate(value(d)):
            if known:
                squares = [a * b for a in d for b in d]
                cubes = [d[a] * d[b] * d[c] for a, b, c in zip(p, q, r, strict=True)]
                each = zip(often.tolist(), h.K.value[:, j].tolist(), cubes, strict=True)
                third = sum((arb(w) * arb(c) * x for w, c, x in each), arb(0))
                rest = v - start[j] - linear(h.a.value[:, j], d) - linear(h.Q.value[..., j].ravel(), squares) - third
                length = inner(d, d).sqrt()
                assert not abs(start[j] - arb(float(h.c.value[j]))) > arb(float(h.c.error.top[j]))
                assert (
                    not abs(rest) > (1 + 2.0**-50) * linear(M[..., j].ravel(), squares) + arb(float(slack[j])) * length
                )
                mine.append(rest)
            if theirs is not None:
                model = theirs[j]
                left = v - linear_in(model, floats) - curved_in(model, floats)
                length = inner(d, d).sqrt()
                assert not abs(left) > form_in(model.whole, floats) + model.off + model.slack * length
                others.append(left)
        rests.append((d, mine, others))
    for (d, one, their_one), (e, two, their_two) in pairwise(rests):
        between = [a - b for a, b in zip(d, e, strict=True)]
        apart = inner(between, between).sqrt()
        for j, (v, w) in enumerate(zip(one, two, strict=True)):
            most = arb(float(steep[j])) + arb(float(slack[j])) if np.isfinite(steep[j]) else None
            assert most is None or not abs(v - w) > most * apart
        for j, (v, w) in enumerate(zip(their_one, their_two, strict=True)):
            lip = None if theirs is None else theirs[j].lip
            assert lip is None or not abs(v - w) > (lip + theirs[j].slack) * apart  # type: ignore[index]


@pytest.mark.parametrize("seed", SEEDS)
def test_models_in_rows_hold_values_and_their_derivatives(seed: int) -> None:
    """N and its first coefficient along a field, to the difference of values that are 2^-100 apart."""
    rng = np.random.default_rng([14, seed])
    net, radius = a_dag(seed, 2, corners=False), float(10.0 ** rng.uniform(-6, -0.5))
    centre, F = rng.normal(size=2), rng.normal(size=2)
    states = [form_of(np.array([centre[i]]), np.eye(2)[i][:, None] * radius) for i in range(2)]
    rates = [form_of(np.array([F[i]]), np.zeros((2, 1))) for i in range(2)]
    tape = parse([["*", "x", ["network", "net", 1, "x", ["+", "x", "y"]]]], ("x", "y"), "here", {"net": net})
    number = constants(states[0])
    with np.errstate(all="ignore"):
        (N,) = evaluate(
            tape, lambda q: Dual(number(q)), [Dual(x, f) for x, f in zip(states, rates, strict=True)], InRows().entries
        )  # fmt: skip
    for _ in range(6):
        d = arbs(corner_of(rng, 2))
        at = [arb(float(centre[i])) + arb(radius) * d[i] for i in range(2)]
        (value,) = true_values(tape, at)
        h = arb(2) ** -100
        (more,), (less,) = (
            true_values(tape, [x + sign * h * arb(float(f)) for x, f in zip(at, F, strict=True)]) for sign in (1, -1)
        )
        assert inside(N.value, d, value, arb(0))
        assert inside(N.rate, d, (more - less) / (2 * h), arb(2) ** -60 * (1 + abs(value)))


def inside(model: Taylor, d: list[arb], value: arb, tolerance: arb) -> bool:
    """False if the value is certainly not in the model."""
    return not abs(value - value_of(model, d)) > arb(float(np.max(model.r.top))) + tolerance
