"""Attacks on networks and corners of format 9: false claims that must be refused, enclosures against Arb without a
tolerance, and small files that ask for too much."""

from __future__ import annotations

import base64
import json
import tracemalloc
from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from flint import arb, ctx, fmpq

from certify.checker import ball, calls, document, flow, network, rules
from certify.checker.calls import enclose
from certify.checker.case import Case
from certify.checker.errors import Rejected
from certify.checker.expression import Call, Tape, evaluate, parse
from certify.checker.jets import Units
from certify.checker.near import Above, Form, triples
from certify.checker.networks import Affine, Algebra, Map
from certify.checker.ring import Ring
from certify.checker.taylor import Taylor, constants
from certify.checker.taylor import affine as form_of
from certify.checker.wiring import Clip, Concat, Observe, Product, Sum
from tests.checker.test_networks import a_jet, a_network, hash_of, odd_loop
from tests.support.certificates import Document, encode
from tests.support.earlier import newer
from tests.support.marks import slow_after

Array = Any
SEEDS = slow_after(40, [*range(60, 80), *range(60), *range(80, 100)])  # with products first
TWO_CALLS = [
    [
        "+",
        ["*", ["network", "net", 0, "x", ["abs", "y"]], ["network", "net", 1, "y", "x"]],
        ["-", ["network", "net", 0, "y", "x"], ["network", "net", 0, "x", "2/3"]],
    ],
    ["network", "net", 1, ["*", "1/8", ["network", "net", 0, "x", ["abs", "y"]]], ["max", "x", "y"]],
]


class Truth:
    """A number on a tape."""

    def __init__(self, v: arb) -> None:
        self.v = v

    def __add__(self, other: Truth) -> Truth:
        return Truth(self.v + other.v)

    def __mul__(self, other: Truth) -> Truth:
        return Truth(self.v * other.v)

    def __neg__(self) -> Truth:
        return Truth(-self.v)

    def function(self, name: str) -> Truth:
        return Truth(phi(name, self.v))


def phi(name: str, v: arb) -> arb:
    return PHI[name](v) if name in PHI else getattr(v, name)()


PHI: dict[str, Callable[[arb], arb]] = {
    "inv": lambda v: 1 / v,
    "abs": abs,
    "relu": lambda v: v.max(arb(0)),
    "elu": lambda v: v.max(arb(0)) + v.min(arb(0)).expm1(),
    "softsign": lambda v: v / (1 + abs(v)),
    "sigmoid": lambda v: 1 / (1 + (-v).exp()),
    "silu": lambda v: v / (1 + (-v).exp()),
    "gelu": lambda v: v * (1 + (v / arb(2).sqrt()).erf()) / 2,
    "softplus": lambda v: (1 + v.exp()).log(),
    "mish": lambda v: v * (1 + v.exp()).log().tanh(),
}


class Truths(Algebra[list[arb]]):
    """Networks in Arb."""

    def affine(self, step: Affine, v: list[arb]) -> list[arb]:
        return [
            sum((arb(w) * x for w, x in zip(row, v, strict=True)), arb(b))
            for row, b in zip(step.weight.tolist(), step.bias.tolist(), strict=True)
        ]

    def map(self, step: Map, v: list[arb]) -> list[arb]:
        return [phi(step.function, x) for x in v]

    def clip(self, step: Clip, v: list[arb]) -> list[arb]:
        ends = zip(v, step.lo.tolist(), step.hi.tolist(), strict=True)
        return [x.max(arb(lo)).min(arb(hi)) for x, lo, hi in ends]

    def sum(self, step: Sum, *vectors: list[arb]) -> list[arb]:
        return [sum(entries, arb(0)) for entries in zip(*vectors, strict=True)]

    def concat(self, step: Concat, *vectors: list[arb]) -> list[arb]:
        return [x for v in vectors for x in v]

    def product(self, step: Product, v: list[arb], w: list[arb]) -> list[arb]:
        return [v[i % len(v)] * w[i % len(w)] for i in range(step.size)]

    def observe(self, step: Observe, v: list[arb]) -> list[arb]:
        return true_values(step.tape, v)


def true_values(tape: Tape, variables: Sequence[arb], made: list[arb] | None = None) -> list[arb]:
    """The tape's outputs; the entries of calls go to `made`, one after another."""

    def called(call: Call, given: list[Truth]) -> list[Truth]:
        value = Truths().run(call.network, [x.v for x in given])
        found = [value[i] for i in call.entries]
        if made is not None:
            made.extend(found)
        return [Truth(v) for v in found]

    def number(q: Fraction) -> Truth:
        return Truth(arb(fmpq(q.numerator, q.denominator)))

    return [x.v for x in evaluate(tape, number, [Truth(v) for v in variables], called)]


@pytest.fixture
def many_digits() -> Any:
    before, ctx.prec = ctx.prec, 300
    yield
    ctx.prec = before


def linear(a: Array, d: Sequence[arb]) -> arb:
    return sum((arb(v) * x for v, x in zip(np.asarray(a).tolist(), d, strict=True)), arb(0))


def value_of(model: Taylor, symbols: Sequence[arb]) -> arb:
    i, j = np.triu_indices(model.symbols)
    squares = [symbols[a] * symbols[b] for a, b in zip(i.tolist(), j.tolist(), strict=True)]
    return arb(float(model.c[0])) + linear(model.g[:, 0], symbols) + linear(model.q[:, 0], squares)


@pytest.mark.usefixtures("many_digits")
@pytest.mark.parametrize("seed", SEEDS)
def test_calls_hold_in_all_equations_with_one_symbol_each(seed: int) -> None:
    """The number in [-1, 1] that makes a call's entry true makes every equation true that has this entry, also where
    calls have calls as arguments, or the same network is called with others."""
    rng = np.random.default_rng(7000 + seed)
    net, radius = a_network(seed, 2, 2), 10.0 ** rng.uniform(-6, -0.3)
    tape = parse(TWO_CALLS, ("x", "y"), "here", {"net": net})
    centre, wide = rng.normal(size=2) * rng.integers(0, 2), np.diag([radius, radius])
    states = [
        form_of(np.array([centre[i]]), np.concatenate([wide[i], np.zeros(tape.entries)])[:, None]) for i in range(2)
    ]
    forms: list[Taylor] = []

    def called(call: Call, given: list[Taylor]) -> list[Taylor]:
        found = calls.entries(call, given, 2)
        forms.extend(found)
        return found

    with np.errstate(all="ignore"):
        F = evaluate(tape, constants(states[0]), states, called)
    assert len(forms) == tape.entries == 5
    if not all(np.isfinite(v.size.top) for v in (*forms, *F)):
        pytest.skip("no finite model")
    for _ in range(8):
        d = np.where(rng.random(2) < 0.5, np.sign(rng.normal(size=2)), rng.uniform(-1, 1, 2))
        symbols, entries = [arb(float(v)) for v in d], list[arb]()
        x = [arb(float(centre[i])) + arb(radius) * symbols[i] for i in range(2)]
        true = true_values(tape, x, entries)
        for k, (form, entry) in enumerate(zip(forms, entries, strict=True)):
            assert not np.any(form.g[2 + k + 1 :, 0])  # later errors
            left, own = entry - value_of(form, [*symbols, *[arb(0)] * (5 - k)]), float(form.g[2 + k, 0])
            assert not abs(left) > arb(own)
            symbols.append(left / arb(own))
        for model, value in zip(F, true, strict=True):
            assert not abs(value - value_of(model, symbols)) > arb(float(np.max(model.r.top)))


@pytest.mark.usefixtures("many_digits")
@pytest.mark.parametrize("seed", SEEDS)
def test_a_program_lies_in_its_model_on_a_ball_to_the_last_bit(seed: int) -> None:
    rng = np.random.default_rng(8000 + seed)
    k, scale = 2, 10.0 ** rng.uniform(-5, -0.7)
    net, units = a_network(seed, 2, 2), Units(np.zeros((k, k, 0)), np.zeros((0, 0)))
    given = [a_jet(rng, k, scale, units)[0] for _ in range(2)]
    with np.errstate(all="ignore"):
        h = ball.OnBall(k).value(net, given)
    if not np.all(np.isfinite(h.v0.size.top)) or not np.all(np.isfinite(h.radius.top)):
        pytest.skip("no finite model")
    M = h.remainder + np.tensordot(h.units.U, np.abs(h.B.value), 1)
    p, q, r, often = triples(k)
    start = Truths().run(net, [arb(float(v.c.value)) for v in given])
    for _ in range(8):
        direction = rng.normal(size=k)
        d = [arb(float(v)) for v in direction / np.linalg.norm(direction) * (1 - 1e-9) * rng.choice([1.0, 1e-3])]
        x = [arb(float(v.c.value)) + linear(v.a.value, d) for v in given]
        squares = [a * b for a in d for b in d]
        cubes = [d[a] * d[b] * d[c] for a, b, c in zip(p, q, r, strict=True)]
        for j, (value, at_0) in enumerate(zip(Truths().run(net, x), start, strict=True)):
            assert not abs(at_0 - arb(float(h.c.value[j]))) > arb(float(h.c.error.top[j]))
            known = at_0 + linear(h.a.value[:, j], d) + linear(h.Q.value[..., j].ravel(), squares)
            third = zip(often.tolist(), h.K.value[:, j].tolist(), cubes, strict=True)
            known += sum((arb(w) * arb(v) * c for w, v, c in third), arb(0))
            slack = arb(float(h.a.error.top[j])) * sum((v * v for v in d), arb(0)).sqrt()
            # 2^-50 of the bound for the products in M, which are rounded here
            assert not abs(value - known) > (1 + 2.0**-50) * linear(M[..., j].ravel(), squares) + slack


# ----------------------------------------------------------------------------------------------------------- documents


def verdict(data: Document) -> str:
    data["policy"]["sha256"] = hash_of(data)
    try:
        rules.check(document.certificate(json.loads(json.dumps(data)), ""))
    except Rejected as no:
        return no.rule
    return "ACCEPTED"


def loop(tree: Any, *networks: Document, c2: float | None = None, leaves: int = 256) -> Document:
    """x' = tree, of a policy that no equation need use, with a tree of equal leaves."""
    data = newer(odd_loop())
    data["plant"]["dynamics"] = [["+", tree, ["*", "0", "u"]]]
    data["networks"] += networks
    if c2 is not None:
        data["levels"]["roa"] = c2.hex()
        data["evidence"]["root"] = encode([np.sqrt(c2) * (1 + 1e-12)])
    data["evidence"]["tree"] = encode_tree(leaves)
    return data


def encode_tree(leaves: int) -> str:
    """A tree of equal leaves, along one axis."""

    def halves(count: int) -> bytes:
        return bytes([0]) + 2 * halves(count // 2) if count > 1 else bytes([255])

    return base64.b64encode(halves(leaves)).decode()


def net(name: str, *steps: Document, reads: int = 1) -> Document:
    return {"name": name, "reads": reads, "steps": list(steps)}


def affine(of: int, weight: Any, bias: Any = (0.0,)) -> Document:
    W = np.atleast_2d(weight)
    return {"kind": "affine", "of": [of], "shape": list(W.shape), "weight": encode(W), "bias": encode(bias)}


TANH: Document = {"kind": "map", "of": [0], "function": "tanh"}
CLIP: Document = {"kind": "clip", "of": [0], "lo": encode([-0.5]), "hi": encode([0.5])}
SQUARE: Document = {"kind": "observe", "of": [0], "names": ["a"], "expressions": [["*", "a", "a"]]}


def call(name: str, *arguments: Any) -> list[Any]:
    return ["network", name, 0, *arguments]


LOOPS: dict[str, tuple[Any, list[Document]]] = {  # x', which goes inwards near 0 and not everywhere
    "a clip that acts": (["-", ["/", "x", "2"], call("f", "x")], [net("f", CLIP)]),
    "a skip": (
        call("f", "x"),
        [net("f", TANH, affine(1, [[-2.0]]), {"kind": "sum", "of": [0, 2]})],
    ),
    "a square": (["*", "x", ["-", call("f", "x"), "1"]], [net("f", SQUARE)]),
    "a square of a call": (
        ["*", "x", ["-", call("f", call("g", "x")), "1"]],
        [net("f", SQUARE), net("g", affine(0, [[2.0]]))],
    ),
    "a corner off the origin": (
        ["-", ["max", "0", ["*", "4", ["-", ["abs", ["+", "x", "3"]], "15/4"]]], "x"],
        [],
    ),
    "two calls of one network": (
        ["-", call("f", "x"), ["*", "3/4", call("f", ["*", "2", "x"])]],
        [net("f", TANH)],
    ),
}


def limit_of(name: str) -> float:
    """Where the loop's right-hand side changes its sign, by its own numbers."""
    tree, networks = LOOPS[name]
    data = loop(tree, *networks)
    c = document.certificate(json.loads(json.dumps(data | {"policy": data["policy"] | {"sha256": hash_of(data)}})), "")

    def inwards(x: float) -> bool:
        return all(bool(true_values(c.dynamics, [arb(v), arb(0)])[0] * arb(v) < 0) for v in (x, -x))

    lo, hi = 0.26, next(x for x in np.arange(0.27, 2.9, 0.01).tolist() if not inwards(x))
    for _ in range(50):
        middle = (lo + hi) / 2
        lo, hi = (middle, hi) if inwards(middle) else (lo, middle)
    return float(lo)


@pytest.mark.parametrize("name", LOOPS)
def test_a_level_beyond_the_basin_is_refused(name: str) -> None:
    """The same evidence, a level 3 per cent below the one at which the loop leaves, and 0.1 per cent beyond it."""
    tree, networks = LOOPS[name]
    limit = limit_of(name)
    for share, expected in ((0.97, "ACCEPTED"), (1.001, "ring")):
        data = loop(tree, *networks, c2=(share * limit) ** 2)
        data["levels"]["local"] = (0.01).hex()
        data["evidence"]["local"]["J"] = encode([0.1 * (1 + 1e-6)])
        data["evidence"]["local"]["multipliers"] = encode([0.0, 0.0, 0.001])
        assert verdict(data) == expected, (name, share)


@pytest.mark.parametrize(
    "tree",
    [
        ["-", ["*", "3", ["abs", "x"]], "x"],  # false: x' = 2 x for x > 0
        ["-", ["*", "1001/1000", ["abs", "x"]], "x"],  # false: x' = x/1000 for x > 0
        ["-", call("f", ["*", "2", "x"]), call("f", "x")],  # false: a symbol for both would cancel
        ["-", ["*", "1000", ["max", "x", "0"]], "x"],  # false: x' = 999 x for x > 0
        ["-", ["*", "4", ["abs", ["*", "x", "x"]]], "x"],  # false from x = 1/4 on: x x touches the corner
    ],
)
def test_kinks_at_rest_and_calls_that_differ_show_nothing(tree: Any) -> None:
    assert verdict(loop(tree, net("f", TANH))) == "local"


@pytest.mark.parametrize(
    "tree",
    [
        ["-", ["/", ["abs", "x"], "2"], "x"],  # x' = -x/2 for x > 0, -3 x/2 else
        ["-", ["*", "1000", ["max", ["-", "x"], "0"]], "x"],  # x' = -1001 x for x < 0
    ],
)
def test_a_corner_at_rest_is_as_steep_as_its_argument(tree: Any) -> None:
    assert verdict(loop(tree, net("f", TANH))) == "ACCEPTED"


@pytest.mark.parametrize("clipped", [False, True])
def test_a_function_whose_network_clips_does_not_fall(clipped: bool) -> None:
    """N = x^2 - 2 min(x^2, 4), rises for 1 < |x| < 2; the derivative that is left out of a clip would say it falls."""
    data = newer(odd_loop())
    data["networks"].append(net("g", affine(0, [[1.0]]), {**CLIP, "of": [1], "hi": encode([4.0])}))
    tree: Any = ["*", "x", "x"]
    if clipped:
        tree = ["-", tree, ["*", "2", call("g", tree)]]
    data["plant"]["input_bounds"] = [["-100", "100"]]
    data["claim"]["outer"] = {"expression": tree, "level": (0.5 if clipped else 8.5).hex()}
    leaf = encode_tree(1)
    data["evidence"]["outer"] = {
        "T": encode([1.0]), "root": encode([3.0]), "tree": encode_tree(256), "faces": [leaf, leaf],
    }  # fmt: skip
    assert verdict(data) == ("outer" if clipped else "ACCEPTED")


def test_products_of_errors_of_calls_do_not_stand_for_means() -> None:
    """In a period the product of two calls' errors has another mean than the product of their means."""
    data = loop(["-", ["*", call("f", "x"), call("f", ["+", "x", "1"])], "x"], net("f", TANH), leaves=1)
    data["claim"]["sample"] = ["1/20", "1/10"]
    data["policy"]["sha256"] = hash_of(data)
    ring = Ring.of(Case(document.certificate(json.loads(json.dumps(data)), "")))
    n, i, j = ring.symbols, *np.triu_indices(ring.symbols)
    of_calls = (i >= ring.calls) & (j >= ring.calls) & (j < n - 1)
    p = np.ones((n + len(i), 1))
    mean = flow.of_mean(ring, Taylor(np.zeros(1), p, network.ZERO))
    assert ring.calls == 2 and n == 5 and of_calls.sum() == 3  # x, u; two calls; h
    assert not np.any(mean.q[of_calls]) and np.all(mean.q[~of_calls] == 1) and mean.r.top[0] >= 3


# ------------------------------------------------------------------------------------------------- faults, as found


@pytest.mark.parametrize("kind", [[], {}, [["affine"]]])
def test_a_kind_of_step_that_is_no_word_is_refused(kind: Any) -> None:
    data = newer(odd_loop())
    data["networks"][0]["steps"][0]["kind"] = kind
    with pytest.raises(Rejected):
        document.certificate(json.loads(json.dumps(data)), "")


def test_a_function_that_is_a_negative_constant_has_an_answer() -> None:
    data = newer(odd_loop())
    leaf = encode_tree(1)
    data["claim"]["outer"] = {"expression": "-1/3", "level": (-1.0).hex()}
    data["evidence"]["outer"] = {"T": encode([1.0]), "root": encode([4.0]), "tree": leaf, "faces": [leaf, leaf]}
    assert verdict(data) == "ACCEPTED"


def doubled(k: int, of: int = 0, first: int = 1) -> list[Document]:
    """2^k copies of a vector."""
    return [{"kind": "concat", "of": 2 * [of if i == 0 else first + i - 1]} for i in range(k)]


def wide_value() -> list[Document]:
    """16,384 entries, one of which is used: an identity of 2 GB chooses it."""
    return doubled(14)


def test_an_entry_of_a_wide_value_is_chosen_without_a_matrix() -> None:
    f = net("f", *wide_value())
    data = loop("x", f)
    data["plant"]["dynamics"] = [["+", ["/", "x", "2"], "u", ["*", "0", ["network", "f", 0, "x"]]]]
    data["policy"]["sha256"] = hash_of(data)
    c = document.certificate(json.loads(json.dumps(data)), "")
    tracemalloc.start()
    enclose(c.dynamics.calls[next(iter(c.dynamics.calls))].network, Form(np.ones((2, 1, 4)), Above(0.0)), (0,))
    assert tracemalloc.get_traced_memory()[1] < 2**26
    tracemalloc.stop()
