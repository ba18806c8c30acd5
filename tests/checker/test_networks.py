"""Networks of all kinds of steps: what the checker says of them on boxes and on balls holds of their values."""

from __future__ import annotations

import base64
import hashlib
import json
import struct
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from scipy.special import erf

from certify.checker import ball, calls, document, rules
from certify.checker.activations import add as add_activations
from certify.checker.errors import Rejected
from certify.checker.exact import Exact, Exactly
from certify.checker.expression import Tape, evaluate, parse
from certify.checker.functions import Undecided
from certify.checker.jets import Jet, Units, constant
from certify.checker.near import Above, Form, Near, Vector
from certify.checker.networks import Affine, Algebra, Map, Network, Step
from certify.checker.outer import Dual, InRows
from certify.checker.smooth import add as add_smooth
from certify.checker.taylor import Taylor, constants
from certify.checker.taylor import affine as form_of
from certify.checker.wiring import Clip, Concat, Observe, Product, Sum
from tests.support.certificates import Document, decode, encode, grow, make
from tests.support.earlier import newer
from tests.support.marks import slow_after
from tests.support.reference import judge_bytes

Array = Any
SEEDS = slow_after(40, [*range(60, 80), *range(60), *range(80, 100)])  # with products first
WITH_PRODUCTS = 60  # from this seed on networks have products, too
add_activations()
add_smooth()
FUNCTIONS: dict[str, Callable[[Array], Array]] = {
    "tanh": np.tanh,
    "sin": np.sin,
    "cos": np.cos,
    "exp": np.exp,
    "atan": np.arctan,
    "sqrt": np.sqrt,
    "abs": np.abs,
    "relu": lambda v: np.maximum(v, 0),
    "elu": lambda v: np.where(v < 0, np.expm1(np.minimum(v, 0)), v),
    "sigmoid": lambda v: 1 / (1 + np.exp(-v)),
    "silu": lambda v: v / (1 + np.exp(-v)),
    "gelu": lambda v: v * (1 + erf(v / np.sqrt(2))) / 2,
    "softplus": lambda v: np.logaddexp(0, v),
    "mish": lambda v: v * np.tanh(np.logaddexp(0, v)),
    "softsign": lambda v: v / (1 + np.abs(v)),
}
CORNERED = ("relu", "elu", "softsign")  # functions that have no derivatives where their sign is not certain
CORNERS = [
    ["abs", "a"],
    ["min", "a", "1/7", ["*", "a", "a"]],
    ["clip", ["sin", ["*", "2", "a"]], "-1/2", "1/3"],
    ["max", "a", "0"],
]
TREES = [["sin", "a"], ["*", "a", "a"], ["cos", ["+", "a", "1/3"]], "a", ["-", ["exp", ["*", "1/4", "a"]], "a"]]


def has_corners(net: Network) -> bool:
    """True if its steps may have no derivative somewhere, apart from expressions."""
    return any(isinstance(step, Clip) or getattr(step, "function", "") in CORNERED for step in net.steps)


class Numbers(Algebra[Array]):
    """Plain numbers, (width, B)."""

    def affine(self, step: Affine, v: Array) -> Array:
        return step.weight @ v + step.bias[:, None]

    def map(self, step: Map, v: Array) -> Array:
        return FUNCTIONS[step.function](v)

    def clip(self, step: Clip, v: Array) -> Array:
        return np.clip(v, step.lo[:, None], step.hi[:, None])

    def sum(self, step: Sum, *vectors: Array) -> Array:
        return sum(vectors)

    def concat(self, step: Concat, *vectors: Array) -> Array:
        return np.concatenate(vectors)

    def product(self, step: Product, v: Array, w: Array) -> Array:
        return v * w

    def observe(self, step: Observe, v: Array) -> Array:
        return np.array([Plain.of(step.tape, list(v))[i] for i in range(len(step.tape.outputs))])


class Plain:
    """A number on a tape."""

    def __init__(self, v: Array) -> None:
        self.v = v

    def __add__(self, other: Plain) -> Plain:
        return Plain(self.v + other.v)

    def __mul__(self, other: Plain) -> Plain:
        return Plain(self.v * other.v)

    def __neg__(self) -> Plain:
        return Plain(-self.v)

    def function(self, name: str) -> Plain:
        return Plain(1 / self.v if name == "inv" else FUNCTIONS[name](self.v))

    @classmethod
    def of(cls, tape: Tape, variables: list[Array]) -> list[Array]:
        def called(call: Any, given: list[Plain]) -> list[Plain]:
            value = Numbers().run(call.network, np.array([x.v + 0 * variables[0] for x in given]))
            return [Plain(value[i]) for i in call.entries]

        return [x.v for x in evaluate(tape, lambda q: Plain(float(q)), [Plain(v) for v in variables], called)]


def a_network(seed: int, reads: int, gives: int, kinds: str = "affine map clip sum concat observe") -> Network:
    """A network of random steps, which read random vectors before them."""
    rng = np.random.default_rng(seed)
    functions = [name for name in FUNCTIONS if name not in ("sqrt", "abs")]
    trees = [*TREES, *CORNERS] if seed % 3 == 0 and "clip" in kinds else TREES
    sizes, steps = [reads], list[Step]()
    kinds += " product product" * (seed >= WITH_PRODUCTS)

    def add(step: Step) -> None:
        steps.append(step)
        sizes.append(step.size)

    for kind in [*rng.choice(kinds.split(), int(rng.integers(2, 9))), "affine"]:
        i = int(rng.integers(max(0, len(sizes) - 3), len(sizes)))
        same = [j for j, size in enumerate(sizes) if size == sizes[i]]
        few = (int(rng.choice(same)), i)
        match kind:
            case "affine":
                rows = gives if len(steps) and kind == "affine" and rng.random() < 0.2 else int(rng.integers(1, 5))
                add(Affine((i,), rows, rng.normal(size=(rows, sizes[i])) * 0.8, rng.normal(size=rows) * 0.3))
            case "map":
                add(Map((i,), sizes[i], str(rng.choice(functions))))
            case "clip":
                middle = rng.normal(size=sizes[i]) * 0.4
                add(Clip((i,), sizes[i], middle - rng.random(sizes[i]), middle + rng.random(sizes[i])))
            case "sum":
                add(Sum(few, sizes[i]))
            case "concat":
                two = (int(rng.integers(0, len(sizes))), i)
                add(Concat(two, sum(sizes[j] for j in two)))
            case "product":
                fits = [j for j, size in enumerate(sizes) if size == sizes[i] or 1 in (size, sizes[i])]
                pair = tuple(int(j) for j in rng.permutation([rng.choice(fits), i]))
                add(Product(pair, max(sizes[j] for j in pair)))
            case "observe":
                names = tuple("abcdefghijklmnop"[: sizes[i]])
                chosen = [trees[int(k)] for k in rng.integers(0, len(trees), 3)]
                add(Observe((i,), 3, names, parse(chosen, names, "here")))
    last = len(steps)
    add(Affine((last,), gives, rng.normal(size=(gives, sizes[last])), rng.normal(size=gives)))
    return Network("net", reads, tuple(needed(steps)))


def needed(steps: list[Step]) -> list[Step]:
    """The steps without those that none reads, numbered anew."""
    wanted = {len(steps)}
    for k in range(len(steps), 0, -1):
        wanted |= set(steps[k - 1].of) if k in wanted else set()
    number = {old: new for new, old in enumerate(sorted(wanted | {0}))}
    return [replace(steps[k - 1], of=tuple(number[i] for i in steps[k - 1].of)) for k in sorted(wanted - {0})]


@pytest.mark.parametrize("seed", SEEDS)
def test_a_value_lies_within_its_enclosure_on_boxes(seed: int) -> None:
    rng = np.random.default_rng(1000 + seed)
    net, radius = a_network(seed, 3, 2), 10.0 ** rng.uniform(-6, 0.5, 5)
    x = np.concatenate([rng.normal(size=(1, 3, 5)), rng.normal(size=(4, 3, 5)) * radius])
    doubt = np.abs(rng.normal(size=(3, 5))) * radius * 0.1
    with np.errstate(all="ignore"):
        u = calls.enclose(net, Form(x, Above(doubt)), (1, 0, 1))
    for _ in range(40):
        d = np.sign(rng.normal(size=(4, 5))) * rng.random((4, 5)) ** rng.choice([0.0, 0.2, 1.0])
        at = x[0] + np.einsum("kb,knb->nb", d, x[1:]) + doubt * np.sign(rng.normal(size=(3, 5)))
        value = Numbers().run(net, at)[[1, 0, 1]]
        off = np.abs(value - u.value[0] - np.einsum("kb,knb->nb", d, u.value[1:]))
        assert not np.any(off > u.error.top + 1e-12 * (1 + np.abs(value)))


@pytest.mark.parametrize("seed", SEEDS)
def test_a_call_in_equations_is_one_with_its_value(seed: int) -> None:
    """With a symbol for the error of each entry: some number of [-1, 1] for it gives the value."""
    rng = np.random.default_rng(2000 + seed)
    net, radius = a_network(seed, 2, 2), 10.0 ** rng.uniform(-6, -0.5)
    tape = parse(
        [["+", ["network", "net", 1, ["*", "x", "y"], "y"], ["*", "x", ["network", "net", 0, "y", "2/3"]]]],
        ("x", "y"),
        "here",
        {"net": net},
    )
    centre, wide = rng.normal(size=2), np.diag([radius, radius])
    states = [
        form_of(np.array([centre[i]]), np.concatenate([wide[i], np.zeros(tape.entries)])[:, None]) for i in range(2)
    ]
    with np.errstate(all="ignore"):
        (f,) = evaluate(tape, constants(states[0]), states, lambda call, given: calls.entries(call, given, 2))
    for _ in range(40):
        d = rng.uniform(-1, 1, 2)
        (value,) = Plain.of(tape, [np.array([v]) for v in centre + wide @ d])
        i, j = np.triu_indices(f.symbols)
        own = np.concatenate([d, np.full(tape.entries, np.nan)])
        mixed, plain = np.where(np.isnan(own[i] * own[j]), 0, own[i] * own[j]), np.where(np.isnan(own), 0, own)
        loose = np.abs(f.g[2:, 0]).sum() + np.abs(f.q[np.isnan(own[i] * own[j]), 0]).sum()
        known = f.c[0] + plain @ f.g[:, 0] + mixed @ f.q[:, 0]
        assert not abs(value[0] - known) > loose + f.r.top[0] + 1e-12 * (1 + abs(value[0]))


def a_jet(rng: Any, k: int, scale: float, units: Units) -> tuple[Jet, Callable[[Array], Array]]:
    """x on a ball, exactly, and its function of d."""
    c, a = float(rng.normal()), rng.normal(size=k) * scale
    x = constant(Fraction(0), units)
    jet = Jet(
        Near(np.float64(c)),
        Vector(a),
        *(getattr(x, name) for name in ("Q", "K", "E", "B", "units", "lip")),
    )
    return jet, lambda d: c + a @ d


@pytest.mark.parametrize("seed", SEEDS)
def test_a_value_lies_within_its_model_on_a_ball(seed: int) -> None:
    """Clips act nowhere or everywhere on the ball, or there is no finite model."""
    rng = np.random.default_rng(3000 + seed)
    k, scale = 3, 10.0 ** rng.uniform(-4, -0.7)
    net, units = a_network(seed, 3, 2), Units(np.zeros((k, k, 0)), np.zeros((0, 0)))
    given = [a_jet(rng, k, scale, units) for _ in range(3)]
    bent = [jet * jet + jet.function("sin") if seed % 2 else jet for jet, _ in given]
    with np.errstate(all="ignore"):
        h = ball.OnBall(k).value(net, bent)
    if seed % 3 and not has_corners(net):
        assert np.all(np.isfinite(h.v0.size.top))
    steps = np.zeros((2, 2))
    for _ in range(40):
        d = rng.normal(size=(k, 2))
        d *= rng.random(2) ** rng.choice([0.0, 0.3]) / np.linalg.norm(d, axis=0)
        value, middle = (
            Numbers().run(net, np.array([f(at) ** 2 + np.sin(f(at)) if seed % 2 else f(at) for _, f in given]))
            for at in (d, np.zeros((k, 1)))
        )
        for j in range(2):
            off = np.abs(middle[j] - h.v0.value[j])
            assert not np.any(off > h.v0.error.top[j] + 1e-12)
            for p in range(2):
                steps[j, p] = beyond(h, j, d[:, p], value[j, p] - middle[j, 0])
        # the remainder beyond a.d + d'Q d + K[d] has the Lipschitz constant that is stated
        apart = np.linalg.norm(d[:, 0] - d[:, 1])
        assert not np.any(np.abs(steps[:, 0] - steps[:, 1]) > h.lipschitz.top * apart + 1e-11)


def beyond(h: Jet, j: int, d: Array, moved: float) -> float:
    """What a value has beyond its model, which is less than is stated."""
    a, Q, (p, q, r, often) = h.a.value[:, j], h.Q.value[..., j], ball.triples(len(d))
    known = a @ d + d @ Q @ d + np.sum(often * h.K.value[:, j] * d[p] * d[q] * d[r])
    M = h.remainder[..., j] + np.tensordot(h.units.U, np.abs(h.B.value[:, j]), 1)
    rest = moved - known
    slack = h.a.error.top[j] * np.linalg.norm(d)
    assert not abs(rest) > d @ M @ d + slack + 1e-12
    return float(rest)


@pytest.mark.parametrize("seed", SEEDS)
def test_models_in_rows_contain_values_and_their_derivatives(seed: int) -> None:
    rng = np.random.default_rng(4000 + seed)
    net, radius = a_network(seed, 2, 1, "affine map sum concat observe"), 10.0 ** rng.uniform(-5, -0.5)
    centre, F = rng.normal(size=2), rng.normal(size=2)
    states = [form_of(np.array([centre[i]]), np.eye(2)[i][:, None] * radius) for i in range(2)]
    rates = [form_of(np.array([F[i]]), np.zeros((3, 1))) for i in range(2)]
    tape = parse([["*", "x", ["network", "net", 0, "x", ["+", "x", "y"]]]], ("x", "y"), "here", {"net": net})
    number = constants(states[0])
    (N,) = evaluate(
        tape,
        lambda q: Dual(number(q)),
        [Dual(x, f) for x, f in zip(states, rates, strict=True)],
        InRows().entries,
    )
    for _ in range(30):
        d = rng.uniform(-1, 1, 2)
        at = centre + radius * d
        (value,) = Plain.of(tape, [np.array([v]) for v in at])
        (more,), (less,) = (Plain.of(tape, [np.array([v]) for v in at + h * F]) for h in (1e-6, -1e-6))
        assert within(N.value, d, value[0], 1e-12)
        known = has_corners(net) and np.isnan(N.rate.r.top[0])
        assert known or within(N.rate, np.append(d, 0.0), (more[0] - less[0]) / 2e-6, 1e-7)


def within(model: Taylor, d: Array, value: float, tolerance: float) -> bool:
    i, j = np.triu_indices(model.symbols)
    known = model.c[0] + d @ model.g[:, 0] + (d[i] * d[j]) @ model.q[:, 0]
    return bool(abs(value - known) <= model.r.top[0] + tolerance * (1 + abs(value)))


@pytest.mark.parametrize("seed", SEEDS)
def test_exact_values_are_the_networks(seed: int) -> None:
    """At a rational point a value is exact, or not known."""
    net = a_network(seed, 2, 2, "affine clip sum concat affine map")
    try:
        value = Exactly().run(net, [Exact(Fraction(0)), Exact(Fraction(3, 8))])
    except Undecided:
        return
    plain = Numbers().run(net, np.array([[0.0], [0.375]]))
    assert all(q.value is None or abs(float(q.value) - p[0]) < 1e-9 for q, p in zip(value, plain, strict=True))


@pytest.mark.parametrize("seed", SEEDS)
def test_corners_of_equations_lie_in_their_models(seed: int) -> None:
    """abs, min, max and clip: on boxes between lines, on balls where the sign is certain."""
    rng = np.random.default_rng(5000 + seed)
    tree = [
        "+",
        ["abs", ["-", "x", ["*", "y", "y"]]],
        ["*", "y", ["clip", "x", "-1/2", "1/3"]],
        ["min", "x", "y", "1/5"],
    ]
    tape = parse([tree, ["max", "x", ["sin", "y"]]], ("x", "y"), "here")
    centre, radius = rng.normal(size=2), 10.0 ** rng.uniform(-6, 0.3)
    states = [form_of(np.array([centre[i]]), np.eye(2)[i][:, None] * radius) for i in range(2)]
    units = Units(np.zeros((2, 2, 0)), np.zeros((0, 0)))
    jets = [a_jet(rng, 2, radius, units) for _ in range(2)]
    with np.errstate(all="ignore"):
        on_box = evaluate(tape, constants(states[0]), states)
        on_ball = evaluate(tape, lambda q: constant(q, units), [jet for jet, _ in jets])
    for _ in range(40):
        d = rng.uniform(-1, 1, 2)
        for model, value in zip(on_box, Plain.of(tape, [np.array([v]) for v in centre + radius * d]), strict=True):
            assert np.isfinite(model.r.top[0]) and within(model, d, value[0], 1e-12)
        d /= max(1.0, np.linalg.norm(d))
        at = [np.array([f(d)]) for _, f in jets]
        for v, value in zip(on_ball, Plain.of(tape, at), strict=True):
            p, q, r, often = ball.triples(2)
            known = v.c.value + v.a.value @ d + d @ v.Q.value @ d + np.sum(often * v.K.value * d[p] * d[q] * d[r])
            off = v.c.error.top + v.a.error.top * np.linalg.norm(d) + d @ v.remainder @ d
            assert not abs(value[0] - known) > off + 1e-12 * (1 + abs(value[0]))
    if radius < 1e-5:
        assert all(np.isfinite(v.v0.size.top) for v in on_ball)


# -------------------------------------------------------------------------------------------------------- the documents


def checked(raw: bytes) -> str | None:
    """None if the checker accepts a file, or the name of the first rule that fails."""
    try:
        rules.check(document.certificate(json.loads(raw), ""))
    except Rejected as no:
        return no.rule
    return None


def a_document() -> Document:
    """An accepted certificate of format 9, of a policy with a hidden layer and no centring."""
    return newer(odd_loop())


def odd_loop() -> Document:
    """x' = x/2 + u, u = -2 tanh(x) by a hidden layer, so that the origin is an equilibrium exactly."""
    data = make(
        [["+", ["/", "x", "2"], "u"]],
        [([[1.0]], [0.0]), ([[-2.0]], [0.0])],
        [[1.0]],
        (0.25, 1.0),
        squash="identity",
        centre="none",
        scale=[1.0],
        input_bounds=(("-3", "3"),),
    )
    return grow(data)


def step(k: int, **changes: Any) -> Callable[[Document], None]:
    def change(data: Document) -> None:
        own = data["networks"][0]["steps"][k]
        own.update(changes)
        for key in [key for key, value in changes.items() if value is GONE]:
            del own[key]

    return change


GONE = object()
AFFINE = {"kind": "affine", "of": [1], "shape": [1, 1], "weight": encode([1.0]), "bias": encode([0.0])}


def more(*steps: Document) -> Callable[[Document], None]:
    """Further steps before the last, which reads the last of them."""

    def change(data: Document) -> None:
        own = data["networks"][0]["steps"]
        own[-1:] = [*steps, {**own[-1], "of": [len(own) - 1 + len(steps)]}]

    return change


def dynamics(tree: Any) -> Callable[[Document], None]:
    def change(data: Document) -> None:
        data["plant"]["dynamics"] = [tree]

    return change


def networks(change: Callable[[list[Document]], Any]) -> Callable[[Document], None]:
    def apply(data: Document) -> None:
        data["networks"] = change(data["networks"])

    return apply


def sampled(data: Document) -> None:
    data["claim"]["sample"] = ["1/100", "1/50"]
    data["evidence"]["order"] = data["evidence"]["local"]["order"] = 2


MALFORMED: dict[str, Callable[[Document], None]] = {
    "no networks": networks(lambda old: []),
    "networks null": networks(lambda old: None),
    "65 networks": networks(lambda old: [old[0], *({**old[0], "name": f"n{k}"} for k in range(64))]),
    "two of one name": networks(lambda old: old * 2),
    "a network without steps": networks(lambda old: [{**old[0], "steps": []}]),
    "a network of 257 steps": more(*[{"kind": "map", "of": [k], "function": "sin"} for k in range(2, 256)]),
    "a name with a space": networks(lambda old: [{**old[0], "name": "the policy"}]),
    "reads 2": networks(lambda old: [{**old[0], "reads": 2}]),
    "reads true": networks(lambda old: [{**old[0], "reads": True}]),
    "reads 0": networks(lambda old: [{**old[0], "reads": 0}]),
    "a key more": networks(lambda old: [{**old[0], "scale": encode([1.0])}]),
    "another policy": lambda d: d["policy"].update(network="nobody"),
    "a policy null": lambda d: d["policy"].update(network=None),
    "kind of step": step(1, kind="relu"),
    "kind null": step(1, kind=None),
    "kind a list": step(1, kind=[]),
    "kind an object": step(1, kind={}),
    "a vector that no step reads": more({"kind": "map", "of": [1], "function": "sin"}),
    "of nothing": step(1, of=[]),
    "of itself": step(1, of=[2]),
    "of a later one": step(0, of=[1]),
    "of minus one": step(1, of=[-1]),
    "of true": step(1, of=[True]),
    "of a number": step(1, of=1),
    "of two": step(1, of=[1, 1]),
    "without of": step(1, of=GONE),
    "another function": step(1, function="swish"),
    "abs of expressions": step(1, function="abs"),
    "a tangent": step(1, function="tan"),
    "without a function": step(1, function=GONE),
    "a function more": step(0, function="tanh"),
    "shape of two columns": step(0, shape=[1, 2]),
    "shape of two rows": step(0, shape=[2, 1]),
    "shape of true": step(0, shape=[True, 1]),
    "a bias of two": step(0, bias=encode([0.0, 0.0])),
    "a weight that is no number": step(0, weight=encode([np.nan])),
    "two outputs": step(2, shape=[2, 1], weight=encode([1.0, 1.0]), bias=encode([0.0, 0.0])),
    "a sum of one": more({"kind": "sum", "of": [1]}),
    "a sum of unequal ones": more({"kind": "concat", "of": [1, 1]}, {"kind": "sum", "of": [1, 3]}),
    "a concat of one": more({"kind": "concat", "of": [1]}),
    "a clip the wrong way": more({"kind": "clip", "of": [2], "lo": encode([1.0]), "hi": encode([-1.0])}),
    "a clip of one number": more({"kind": "clip", "of": [2], "lo": encode([1.0]), "hi": encode([1.0])}),
    "a clip of two": more({"kind": "clip", "of": [2], "lo": encode([-1.0] * 2), "hi": encode([1.0] * 2)}),
    "an infinite clip": more({"kind": "clip", "of": [2], "lo": encode([-np.inf]), "hi": encode([1.0])}),
    "a product of one": more({"kind": "product", "of": [2]}),
    "a product of three": more({"kind": "product", "of": [2, 2, 2]}),
    "a product of unequal ones": more(
        {"kind": "concat", "of": [1, 1]}, {"kind": "concat", "of": [1, 1, 2]}, {"kind": "product", "of": [3, 4]}
    ),
    "a product with itself to come": more({"kind": "product", "of": [2, 3]}),
    "a product with numbers": more({"kind": "product", "of": [2, 2], "weight": encode([1.0])}),
    "two names for one": more({"kind": "observe", "of": [2], "names": ["a", "b"], "expressions": ["a"]}),
    "no name": more({"kind": "observe", "of": [2], "names": [], "expressions": ["1"]}),
    "one name twice": more(
        {"kind": "concat", "of": [1, 1]}, {"kind": "observe", "of": [3], "names": ["a", "a"], "expressions": ["a"]}
    ),
    "no expression": more({"kind": "observe", "of": [2], "names": ["a"], "expressions": []}),
    "an expression of a state": more({"kind": "observe", "of": [2], "names": ["a"], "expressions": ["x"]}),
    "a call in a network": more(
        {"kind": "observe", "of": [2], "names": ["a"], "expressions": [["network", "policy", 0, "a"]]}
    ),
    "a call of nobody": dynamics(["+", ["/", "x", "2"], ["network", "nobody", 0, "x"]]),
    "a call of entry 1": dynamics(["+", ["/", "x", "2"], ["network", "policy", 1, "x"]]),
    "a call of entry -1": dynamics(["+", ["/", "x", "2"], ["network", "policy", -1, "x"]]),
    "a call of entry true": dynamics(["+", ["/", "x", "2"], ["network", "policy", False, "x"]]),
    "a call of an entry in words": dynamics(["+", ["/", "x", "2"], ["network", "policy", "0", "x"]]),
    "a call without arguments": dynamics(["+", ["/", "x", "2"], ["network", "policy", 0]]),
    "a call with two arguments": dynamics(["+", ["/", "x", "2"], ["network", "policy", 0, "x", "x"]]),
    "a call of a name alone": dynamics(["network", "policy"]),
    "a call of a list": dynamics(["+", ["/", "x", "2"], ["network", ["policy"], 0, "x"]]),
    "order 2 of a call": lambda d: (dynamics(["+", ["/", "x", "2"], ["network", "policy", 0, "x"]])(d), sampled(d))[0],
}


@pytest.mark.parametrize("program", [checked, judge_bytes], ids=["checker", "reference"])
@pytest.mark.parametrize("name", MALFORMED)
def test_what_is_no_network_is_refused(name: str, program: Callable[[bytes], str | None]) -> None:
    data = a_document()
    MALFORMED[name](data)
    assert program(json.dumps(data).encode()) == "format"


def split_in_two(data: Document) -> None:
    """W h as a sum of two halves."""
    first = data["networks"][0]["steps"][0]
    half = {**first, "weight": encode(decode(first["weight"]) / 2), "bias": encode(decode(first["bias"]) / 2)}
    data["networks"][0]["steps"] = [
        half,
        half,
        {"kind": "sum", "of": [1, 2]},
        {"kind": "map", "of": [3], "function": "tanh"},
        {**data["networks"][0]["steps"][-1], "of": [4]},
    ]


def skipping(data: Document) -> None:
    """-2 tanh(x) as -tanh(x) - (x + (tanh(x) - x)): a skip connection that cancels."""
    tanh = {"kind": "map", "of": [0], "function": "tanh"}
    data["networks"][0]["steps"] = [
        tanh,
        {"kind": "affine", "of": [0], "shape": [1, 1], "weight": encode([-1.0]), "bias": encode([0.0])},
        {"kind": "sum", "of": [1, 2]},
        {"kind": "sum", "of": [0, 1, 3]},
        {"kind": "affine", "of": [4], "shape": [1, 1], "weight": encode([-1.0]), "bias": encode([0.0])},
    ]


def observed(data: Document) -> None:
    """The state through an observation of it twice, one of which counts for nothing."""
    first, tanh, last = data["networks"][0]["steps"]
    data["networks"][0]["steps"] = [
        {"kind": "observe", "of": [0], "names": ["x"], "expressions": ["x", ["sin", "x"]]},
        {**first, "of": [1], "shape": [1, 2], "weight": encode([1.0, 0.0])},
        {**tanh, "of": [2]},
        {**last, "of": [3]},
    ]


def clipped_far_out(data: Document) -> None:
    more({"kind": "clip", "of": [2], "lo": encode([-2.0]), "hi": encode([2.0])})(data)


def called(data: Document) -> None:
    """The equations call the network; the input is of no use."""
    data["plant"]["dynamics"] = [["+", ["/", "x", "2"], ["network", "policy", 0, "x"], ["*", "0", "u"]]]


def called_in_part(data: Document) -> None:
    half = ["*", "1/2", ["network", "policy", 0, "x"]]
    data["plant"]["dynamics"] = [["+", ["/", "x", "2"], half, ["*", "1/2", "u"]]]


def multiplied(data: Document) -> None:
    """tanh(x) times a vector of one entry, which is 1, and then entry by entry."""
    one = {"kind": "affine", "of": [0], "shape": [1, 1], "weight": encode([0.0]), "bias": encode([1.0])}
    more(one, {"kind": "concat", "of": [2, 2]}, {"kind": "product", "of": [4, 3]}, {"kind": "product", "of": [3, 5]})(
        data
    )
    last = data["networks"][0]["steps"][-1]
    last |= {"shape": [1, 2], "weight": encode([-1.0, -1.0])}


def normalised(data: Document) -> None:
    """Layer normalisation of (x, -x) with epsilon 1, x/sqrt(x^2 + 1), instead of tanh: 0 at 0 in rationals."""
    inverse_root = ["/", "1", ["sqrt", "v"]]
    data["networks"][0]["steps"] = [
        {"kind": "affine", "of": [0], "shape": [2, 1], "weight": encode([1.0, -1.0]), "bias": encode([0.0, 0.0])},
        {"kind": "product", "of": [1, 1]},
        {"kind": "affine", "of": [2], "shape": [1, 2], "weight": encode([0.5, 0.5]), "bias": encode([1.0])},
        {"kind": "observe", "of": [3], "names": ["v"], "expressions": [inverse_root]},
        {"kind": "product", "of": [1, 4]},
        {"kind": "affine", "of": [5], "shape": [1, 2], "weight": encode([-1.0, 1.0]), "bias": encode([0.0])},
    ]
    tree = b"\xff"
    for _ in range(6):
        tree = b"\0" + tree * 2
    data["evidence"]["tree"] = base64.b64encode(tree).decode()


def saturated(data: Document) -> None:
    data["plant"]["dynamics"] = [
        ["+", ["/", "x", "2"], ["clip", "u", "-5/2", "5/2"], ["*", "0", ["abs", ["+", "u", "3"]]]]
    ]


REWRITTEN = [
    split_in_two,
    skipping,
    observed,
    clipped_far_out,
    multiplied,
    normalised,
    called,
    called_in_part,
    saturated,
]


@pytest.mark.parametrize("program", [checked, judge_bytes], ids=["checker", "reference"])
@pytest.mark.parametrize("rewrite", REWRITTEN)
def test_the_same_loop_in_other_words_is_proved(
    rewrite: Callable[[Document], None], program: Callable[[bytes], str | None]
) -> None:
    data = a_document()
    assert program(json.dumps(data).encode()) is None
    rewrite(data)
    data["policy"]["sha256"] = hash_of(data)
    kept = program(json.dumps(data).encode())
    assert kept is None
    data["networks"][0]["steps"][-1]["weight"] = encode(-decode(data["networks"][0]["steps"][-1]["weight"]))
    data["policy"]["sha256"] = hash_of(data)
    assert program(json.dumps(data).encode()) in ("local", "ring")


def hash_of(data: Document) -> str:
    """The hash that FORMAT.md defines, written down once more."""
    policy, words = data["policy"], ""
    digest = hashlib.sha256(f"certify-policy/1\0{policy['squash']}\0{policy['centre']}\0".encode())
    steps = data["networks"][0]["steps"]
    for each in steps:
        for key in ("weight", "bias", "lo", "hi"):
            if key in each:
                raw = base64.b64decode(each[key])
                shape = each["shape"] if key == "weight" else [len(raw) // 8]
                digest.update(struct.pack(f"<{1 + len(shape)}Q", len(shape), *shape) + raw)
        words += " ".join([each["kind"], *map(str, each["of"])])
        words += f" {each['function']}\0" if "function" in each else "\0"
        if each["kind"] == "observe":
            words += "".join(f"{name}\0" for name in each["names"])
            words += json.dumps(each["expressions"], separators=(",", ":")) + "\0"
    for text in (policy["scale"], policy["offset"], *(policy["clip"] or ())):
        raw = base64.b64decode(text)
        digest.update(struct.pack("<2Q", 1, len(raw) // 8) + raw)
    chain = [(each["kind"], each["of"]) for each in steps]
    plain = chain == [(("affine", "map")[k % 2], [k]) for k in range(len(steps))] and len(steps) % 2 == 1
    if not (plain and all(each.get("function", "tanh") == "tanh" for each in steps)):
        digest.update(words.encode())
    return digest.hexdigest()


@pytest.mark.parametrize("program", [checked, judge_bytes], ids=["checker", "reference"])
def test_steps_in_another_order_have_another_hash(program: Callable[[bytes], str | None]) -> None:
    data = a_document()
    split_in_two(data)
    own = data["networks"][0]["steps"]
    own[2] = {"kind": "sum", "of": [2, 1]}
    with_first = hash_of(data)
    data["policy"]["sha256"] = with_first
    own[2] = {"kind": "sum", "of": [1, 2]}
    assert hash_of(data) != with_first and program(json.dumps(data).encode()) == "hash"


@pytest.mark.parametrize("program", [checked, judge_bytes], ids=["checker", "reference"])
def test_a_product_with_another_vector_has_another_hash(program: Callable[[bytes], str | None]) -> None:
    data = a_document()
    multiplied(data)
    data["policy"]["sha256"] = hash_of(data)
    for of in ([5, 3], [3, 3], [5, 5], [4, 5]):
        data["networks"][0]["steps"][5]["of"] = of
        assert program(json.dumps(data).encode()) in ("hash", "format")
