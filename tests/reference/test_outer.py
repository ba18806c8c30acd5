"""The reference on sets beyond {V <= c2}: honest claims about networks and expressions, and one forgery for each rule.

The trees are grown with the reference's own conditions on a leaf. What it accepts is then looked at without it, in
ball arithmetic or at points drawn in the domain.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np
import pytest
from flint import arb, arb_mat, ctx, fmpq, fmpq_mat

from certify.reference import outer, rules
from certify.reference.__main__ import in_words
from certify.reference.balls import PRECISION, bounded_by_form, within_bounds
from certify.reference.document import Certificate, read
from certify.reference.evidence import Tree
from certify.reference.function import Models
from certify.reference.leaves import Box
from certify.reference.outer import Region, binary64_above
from certify.reference.refusal import Refused
from certify.reference.table import FUNCTIONS
from certify.reference.taylor import Taylor
from tests.reference.test_contraction import honest as around_a_level
from tests.reference.test_practical import practical
from tests.support.certificates import LEAF, Document, decode, dump, edited, encode, make, rehash, verdict
from tests.support.marks import slow_after
from tests.support.oracle import value_of
from tests.support.outer import finer
from tests.support.reference import CONTINUOUS, judge

Pass = Callable[[Box], bool]

# -------------------------------------------------------------------------------------------- certificates from nothing


def expression(tree: Any, level: float) -> Document:
    return {"kind": "expression", "expression": tree, "level": float(level).hex()}


def network(layers: Sequence[tuple[Any, Any]], level: float) -> Document:
    arrays = [(np.atleast_2d(np.asarray(W, dtype=float)), np.atleast_1d(b)) for W, b in layers]
    described = [{"shape": list(W.shape), "weight": encode(W), "bias": encode(b)} for W, b in arrays]
    return {"kind": "network", "layers": described, "level": float(level).hex()}


def stated(data: Document, N: Document, T: Any = None) -> Document:
    """The claim with N and trees of one leaf; the root box is the least that binary64 can name."""
    n = len(data["plant"]["states"])
    T = np.eye(n) if T is None else np.asarray(T, dtype=float)
    inverse = fmpq_mat([[fmpq(*float(v).as_integer_ratio()) for v in row] for row in T]).inv().tolist()
    far = [max(-fmpq(*map(int, f"{lo}/1".split("/")[:2])), fmpq(*map(int, f"{hi}/1".split("/")[:2])))
           for lo, hi in data["plant"]["domain"]]  # fmt: skip
    sums = (sum((abs(v) * x for v, x in zip(row, far, strict=True)), fmpq(0)) for row in inverse)
    root = [binary64_above(s, "") for s in sums]
    data = edited(data, "claim.outer", N)
    data["evidence"]["outer"] = {
        "T": encode(T), "root": encode(root), "tree": text(bytes([LEAF])), "faces": [text(bytes([LEAF]))] * 2 * n,
    }  # fmt: skip
    return data


def text(tree: bytes) -> str:
    return base64.b64encode(tree).decode()


def split(lo: list[float], hi: list[float], axes: Sequence[int], passes: Pass, most: int) -> bytes:
    """In preorder: what does not pass is halved along its widest axis, as long as the tree is not too large."""
    tree, waiting, extent = bytearray(), [(lo, hi)], [b - a for a, b in zip(lo, hi, strict=True)]
    while waiting:
        a, b = waiting.pop()
        if len(tree) >= most or not axes or passes(Box(0, a, b)):
            tree.append(LEAF)
            continue
        axis = max(axes, key=lambda i: (b[i] - a[i]) / extent[i])
        tree.append(axis)
        below, above = list(b), list(a)
        below[axis] = above[axis] = 0.5 * a[axis] + 0.5 * b[axis]
        waiting += [(above, b), (a, below)]
    return bytes(tree)


def grown(data: Document, most: int = 4000) -> Document:
    """Trees whose leaves pass, if they are not too large."""
    result = edited(data, "evidence.outer.tree", "/w==")
    with ctx.workprec(PRECISION):
        c = read(dump(data))
        region, bounded = region_of(c), bounded_by_form(c)
        models, root = region.models, list(region_tree(c).root)

        def falls(box: Box) -> bool:
            if region.is_free(box):
                return True
            (leaf,) = region.leaves.enclose([box])
            try:
                return (bounded or within_bounds(c, leaf.ranges())) and region.falls(leaf)
            except Refused:
                return False

        result["evidence"]["outer"]["tree"] = text(split([-b for b in root], root, range(c.n), falls, most))
        for k in range(2 * c.n):
            axes = [i for i in range(c.n) if i != k // 2]
            lo = [-binary64_above(-end[0], "") for end in c.plant.domain]
            hi = [binary64_above(end[1], "") for end in c.plant.domain]
            end = c.plant.domain[k // 2][k % 2]

            def above(box: Box, axis: int = k // 2, end: fmpq = end) -> bool:
                try:
                    return models.is_above(on_face(box, axis, end))
                except Refused:
                    return False

            result["evidence"]["outer"]["faces"][k] = text(split(lo, hi, axes, above, most))
    return result


def on_face(box: Box, axis: int, end: fmpq) -> list[Taylor]:
    x = affine(box, np.eye(len(box.lo)))
    x[axis] = Taylor(arb(end))
    return x


def affine(box: Box, T: np.ndarray, symbols: int = 0) -> list[Taylor]:
    """x = T z on a box."""
    n = len(box.lo)
    centre = [(arb(a) + arb(b)) / 2 for a, b in zip(box.lo, box.hi, strict=True)]
    radius = [(arb(b) - arb(a)) / 2 for a, b in zip(box.lo, box.hi, strict=True)]
    return [
        Taylor(
            sum((arb(t) * v for t, v in zip(row, centre, strict=True)), arb(0)),
            arb_mat([[arb(t) * v for t, v in zip(row, radius, strict=True)] + [arb(0)] * (max(symbols, n) - n)]),
        )
        for row in T.tolist()
    ]


def region_of(c: Certificate) -> Region:
    assert c.beyond is not None
    return Region(c, Models(c.beyond, c.plant.states), region_tree(c))


def region_tree(c: Certificate) -> Any:
    assert isinstance(c.evidence, Tree) and c.evidence.covering is not None
    return c.evidence.covering


# ------------------------------------------------------------------------------------------------------- honest claims

TANH = [([[1.0]], [0.0])]
HALF_LESS_TANH = ["+", ["*", "1/2", "x"], "u"]  # with u = -tanh(x): stays below 1.915008
EDGE = 1.915008
STABLE = [
    ["+", ["-", "x"], ["*", "1/4", "y"]],
    ["+", ["-", "y"], ["*", "-1/4", "x"], ["*", "1/8", "u"]],
]
BUMPS = [(np.kron(np.eye(2), [[0.5], [-0.5]]), -0.5 * np.ones(4)), (np.ones((1, 4)), [0.0])]  # rises with |x| and |y|


def scalar(N: Document, dynamics: Any = HALF_LESS_TANH, **more: Any) -> Document:
    """{x^2 <= 1/4} by a ball alone, and N beyond."""
    return stated(make([dynamics], TANH, [[1.0]], (0.25, 0.25), **more), N)


def planar(N: Document, T: Any = None, dynamics: Any = STABLE, **more: Any) -> Document:
    options: dict[str, Any] = {"states": "xy", "domain": [("-3", "3"), ("-3", "3")], **more}
    layers = [([[0.5, 0.25]], [0.0])]
    return stated(make(dynamics, layers, np.eye(2), (0.25, 0.25), **options), N, T)


def uncertain(level: float = 1.5) -> Document:
    """x' = q x - tanh(x) with q up to 1/2, which may change in time."""
    return scalar(expression(["**", "x", 2], level**2), ["+", ["*", "q", "x"], "u"], uncertain=[("q", "-1/2", "1/2")])


def disturbed(level: float = 2.25) -> Document:
    """x' = -x + w, |w| <= 1/8: ends in {x^2 <= 1/4}."""
    data = make(
        [["+", ["-", "x"], "w"]], TANH, [[1.0]], (0.0625, 0.25), claim="practical", tree=bytes([0, LEAF, LEAF]),
        uncertain=[("w", "-1/8", "1/8")],
    )  # fmt: skip
    return stated(edited(data, "evidence.tree", text(halves(5))), expression(["**", "x", 2], level))


def halves(depth: int) -> bytes:
    return bytes([LEAF]) if depth == 0 else bytes([0]) + 2 * halves(depth - 1)


def clipped() -> Document:
    """The clip acts beyond {V <= c2}, where x' = -x/4 + clip(-tanh(x))."""
    plant = ["+", ["*", "-1/4", "x"], "u"]
    return scalar(network([([[1.0], [-1.0]], [-1.5, -1.5]), ([[1.0, 1.0]], [0.0])], -0.5), plant, clip=([-0.75], [0.6]),
                  input_bounds=[("-3/4", "3/5")])  # fmt: skip


SLANTED = [[1.0, 0.5], [-0.25, 1.0]]
ROUND = ["+", ["**", "x", 2], ["**", "y", 2]]
CURVED = ["+", ["sqrt", ["+", "1", ["**", "x", 2]]], ["*", "y", ["atan", "y"]], ["-", ["exp", ["/", "x", "9"]]],
          ["*", "1/8", ["-", "1", ["cos", "x"]]],
          ["*", ["tanh", "x"], ["/", "x", ["+", "4", ["sin", "y"]]]]]  # fmt: skip


def spatial() -> Document:
    """Three states, two inputs, a clip and an uncertain quantity."""
    plant = [
        ["+", ["-", "x"], ["*", "q", "y"], ["*", "1/4", "u"]],
        ["+", ["-", "y"], ["*", "-1/4", "x"], ["*", "1/8", "v"]],
        ["+", ["-", "z"], ["*", "1/8", ["sin", "x"], "u"]],
    ]
    layers = [(np.array([[0.5, 0.25, 0.0], [0.0, 0.5, -0.25]]), np.zeros(2))]
    data = make(
        plant, layers, np.eye(3), (0.25, 0.25), states="xyz", inputs="uv", u_eq=["0", "0"], scale=[-1.0, -0.5],
        offset=[0.0, 0.0], domain=[("-2", "2")] * 3, input_bounds=[("-1", "1")] * 2, clip=([-0.75, -1.0], [1.0, 0.25]),
        uncertain=[("q", "0", "1/4")],
    )  # fmt: skip
    rising = [(np.kron(np.eye(3), [[1.0], [-1.0]]), -np.ones(6)), (np.ones((1, 6)), [0.0])]
    return stated(data, network(rising, -3.35), [[1.0, 0.25, 0.0], [0.0, 1.0, 0.0], [0.0, -0.25, 1.0]])


HONEST: dict[str, Callable[[], Document]] = {
    "a state": lambda: scalar(expression(["**", "x", 2], 1.9**2)),
    "close to the edge": lambda: scalar(expression(["**", "x", 2], (EDGE - 1e-6) ** 2)),
    "a network of a state": lambda: scalar(network([([[1.0], [-1.0]], [-1.5, -1.5]), ([[1.0, 1.0]], [0.0])], -0.61)),
    "an affine network": lambda: scalar(network([([[1.0]], [0.0])], -3.5)),  # its set is empty
    "a clip": clipped,
    "uncertain": uncertain,
    "disturbed": disturbed,
    "nearby": lambda: stated(around_a_level(), expression(["**", "x", 2], 8.0)),
    "three states": spatial,
    "two states": lambda: planar(network(BUMPS, -1.25)),
    "up to a face": lambda: planar(network(BUMPS, -1.127)),
    "in other coordinates": lambda: planar(network(BUMPS, -1.25), SLANTED),
    "a round set": lambda: planar(expression(ROUND, 8.5)),
    "functions": lambda: planar(expression(CURVED, 1.75), SLANTED),
    "an odd domain": lambda: planar(expression(ROUND, 4.0), domain=[("-7/3", "31/10"), ("-17/8", "1000/333")]),
    "two layers": lambda: planar(network(
        [*BUMPS[:1], (np.kron(np.eye(2), [[1.0, 1.0]]), [0.25, 0.25]), (np.ones((1, 2)), [0.0])], -0.9)),
    "nowhere defined near 0": lambda: planar(expression(["-", ["/", "-1", ROUND]], -1.0)
        | {"expression": ["/", "-1", ROUND], "level": (-1 / 8.5).hex()}),
}  # fmt: skip


@cache
def cached(name: str) -> Document:
    return grown(HONEST[name]())


def honest(name: str) -> Document:
    """Do not change it; `edited` copies."""
    return cached(name)


@pytest.mark.parametrize("name", slow_after(9, HONEST))
def test_honest_certificates_are_accepted(name: str) -> None:
    assert judge(honest(name)) is None
    other = finer(honest(name))  # another checker, which shares no line, has other bounds
    assert judge(other) is None and verdict(other) == "ACCEPTED"


@pytest.mark.parametrize("name", HONEST)
def test_what_is_accepted_is_true(name: str) -> None:
    """At points of the domain, drawn: N falls where it is at most n2 and V is at least c2, and is larger on faces."""
    data, generator = honest(name), np.random.default_rng(5)
    ends = np.array([[eval_rational(end) for end in pair] for pair in data["plant"]["domain"]])
    n2, c2 = (float.fromhex(v) for v in (data["claim"]["outer"]["level"], data["levels"]["roa"]))
    met = 0
    for k in range(300):
        x = generator.uniform(ends[:, 0], ends[:, 1])
        if k % 3 == 0:
            axis, end = generator.integers(len(x)), generator.integers(2)
            x[axis] = ends[axis, end]
            assert N_at(data, x) > n2 - 1e-9
        elif N_at(data, x) <= n2 and x @ x >= c2:
            met += 1
            for _ in range(3):
                assert rate_at(data, x, generator) < 0
    assert met > 20 or name == "an affine network"


def eval_rational(rational: str) -> float:
    p, _, q = rational.partition("/")
    return int(p) / int(q or 1)


def N_at(data: Document, x: np.ndarray, forwards: np.ndarray | None = None) -> float:
    """N(x), or N(x + forwards) less N(x) in many digits."""
    with ctx.workprec(400):
        if forwards is None:
            return float(N_in_arb(data, [arb(v) for v in x]))
        h = arb(2) ** -60
        far, near = ([arb(v) + d * arb(s) for v, s in zip(x, forwards, strict=True)] for d in (h, -h))
        return float((N_in_arb(data, far) - N_in_arb(data, near)) / (2 * h))


def N_in_arb(data: Document, x: list[arb]) -> arb:
    N = data["claim"]["outer"]
    if N["kind"] == "expression":
        return value_of(N["expression"], dict(zip(data["plant"]["states"], x, strict=True)))
    for k, layer in enumerate(N["layers"]):
        W, b = decode(layer["weight"]).reshape(layer["shape"]).tolist(), decode(layer["bias"]).tolist()
        x = [v.tanh() for v in x] if k else x
        x = [sum((arb(w) * v for w, v in zip(row, x, strict=True)), arb(c)) for row, c in zip(W, b, strict=True)]
    return x[0]


def rate_at(data: Document, x: np.ndarray, generator: np.random.Generator) -> float:
    """N'F with what is uncertain drawn from its range."""
    plant, policy = data["plant"], data["policy"]
    W, b = (decode(policy["layers"][0][key]) for key in ("weight", "bias"))
    u = decode(policy["scale"]) * np.tanh(W.reshape(len(b), len(x)) @ x + b)
    if policy["clip"] is not None:
        u = np.clip(u, *map(decode, policy["clip"]))
    names = {
        name: arb(v) for name, v in zip(plant["states"] + plant["inputs"], [*x.tolist(), *u.tolist()], strict=True)
    }
    for each in plant["uncertain"]:
        lo, hi = map(eval_rational, each["range"])
        names[each["name"]] = arb(generator.choice([lo, hi, generator.uniform(lo, hi)]))
    return N_at(data, x, np.array([float(value_of(tree, names)) for tree in plant["dynamics"]]))


# ----------------------------------------------------------------------------------------------------------- forgeries

Edit = Callable[[Document], Document]
CIRCLE = ["+", ["**", "x", 2], ["**", "y", 2], "u"]


def setting(path: str, value: Any) -> Edit:
    return lambda data: edited(data, path, value)


def level(value: float) -> Edit:
    return setting("claim.outer.level", value.hex())


def tree(edit: Callable[[bytes], bytes], at: str = "tree") -> Edit:
    return setting(f"evidence.outer.{at}", lambda old: text(edit(base64.b64decode(old))))


def regrown(*edits: Edit) -> Edit:
    """The trees that are best for what was changed."""

    def edit(data: Document) -> Document:
        for each in edits:
            data = each(data)
        return grown(data)

    return edit


def root(factor: float) -> Edit:
    return setting("evidence.outer.root", lambda old: encode(decode(old) * factor))


def nudged(data: Document) -> Document:
    """An axis that is too short by one bit."""
    return edited(
        data, "evidence.outer.root", lambda old: encode([*np.nextafter(decode(old)[:1], 0), *decode(old)[1:]])
    )


def without(path: str, key: str) -> Edit:
    return setting(path, lambda old: {name: value for name, value in old.items() if name != key})


FORGED: list[tuple[str, str, str, Edit]] = [
    ("format", "no expression", "a state", without("claim.outer", "expression")),
    ("format", "a second output of one", "two states",
     setting("claim.outer", expression(["network", "policy", 1, "x", "y"], 0.0))),
    ("format", "of one state", "two states", setting("claim.outer", expression(["network", "policy", 0, "x"], 0.0))),
    ("format", "of nobody", "a state", setting("claim.outer", expression(["network", "nobody", 0, "x"], 0.0))),
    ("format", "no level", "a state", without("claim.outer", "level")),
    ("format", "one key more", "a state", setting("claim.outer", lambda old: old | {"layers": []})),
    ("format", "another kind", "a state", setting("claim.outer.kind", "polynomial")),
    ("format", "a kind that is a list", "a state", setting("claim.outer.kind", [])),
    ("format", "a list", "a state", setting("claim.outer", [])),
    ("format", "no number", "a state", setting("claim.outer.level", "nan")),
    ("format", "an infinite level", "a state", setting("claim.outer.level", "inf")),
    ("format", "a level in decimal", "a state", setting("claim.outer.level", "3")),
    ("format", "an expression in an input", "a state", setting("claim.outer.expression", ["+", ["**", "x", 2], "u"])),
    ("format", "in what is uncertain", "uncertain", setting("claim.outer.expression", ["+", ["**", "x", 2], "q"])),
    ("format", "an unknown function", "a state", setting("claim.outer.expression", ["tanh'", "x"])),
    ("format", "the power 0", "a state", setting("claim.outer.expression", ["**", "x", 0])),
    ("format", "too many nodes", "a state", setting("claim.outer.expression", ["+", *["x"] * 20_000])),
    ("format", "no layers", "two states", setting("claim.outer.layers", [])),
    ("faces", "the first of four outputs", "two states", setting("claim.outer.layers", lambda old: old[:1])),
    ("format", "another width", "a network of a state", setting("claim.outer.layers.0.shape", [1, 2])),
    ("format", "true rows", "an affine network", setting("claim.outer.layers.0.shape", [True, 1])),
    ("format", "a weight that is no number", "an affine network",
     setting("claim.outer.layers.0.weight", encode([np.nan]))),
    ("format", "no evidence", "a state", setting("evidence.outer", None)),
    ("format", "evidence alone", "a state", setting("claim.outer", None)),
    ("format", "no key", "a state", without("evidence", "outer")),
    ("format", "nor in the claim", "a state", without("claim", "outer")),
    ("format", "a face is missing", "two states", setting("evidence.outer.faces", lambda old: old[:3])),
    ("format", "a face too many", "two states", setting("evidence.outer.faces", lambda old: [*old, old[0]])),
    ("format", "faces in base64", "a state", setting("evidence.outer.faces", "/w==")),
    ("format", "T of other states", "two states", setting("evidence.outer.T", encode([1.0]))),
    ("format", "a rate", "a state", setting("claim.rate", (0.001).hex())),
    ("format", "a sample", "a state", setting("claim.sample", ["0", "1/1000"])),
    ("format", "in discrete time", "a state", setting("plant.time", "discrete")),
    ("format", "with a tube", "a state",
     setting("claim", lambda old: old | {"kind": "enlarged", "start": encode([1.0])})),
    ("format", "a solver's word", "a state", setting("evidence", {
        "kind": "trusted-solver", "solver": "dReal", "version": "4", "precision": (0.5).hex(), "queries": []})),
    ("faces", "a level beyond a face", "a state", level(9.0)),
    ("faces", "a level beyond all of them", "a round set", regrown(level(10.0))),
    ("faces", "beyond one face", "an odd domain", regrown(level(2.125**2 + 1e-9))),
    ("faces", "near the lower end of another state", "a round set",
     regrown(setting("plant.domain", [["-3", "5/2"], ["-3", "3"]]), level(0.01), setting("claim.outer.expression",
             ["+", ["**", ["+", "x", "11/4"], 2], ["**", ["-", "y", "3"], 2]]))),
    ("faces", "near the upper end", "a round set",
     regrown(setting("plant.domain", [["-5/2", "3"], ["-3", "3"]]), level(0.01), setting("claim.outer.expression",
             ["+", ["**", ["-", "x", "11/4"], 2], ["**", ["+", "y", "3"], 2]]))),
    ("faces", "on a face, exactly", "a state", setting("claim.outer", expression(["+", "9", ["*", "x", "0"]], 9.0))),
    ("faces", "below a level nowhere", "an affine network", level(0.0)),
    ("faces", "a tree that is too coarse", "up to a face", setting("evidence.outer.faces.3", "/w==")),
    ("faces", "a split of the axis without extent", "two states", tree(lambda old: b"\x01\xff\xff", "faces.2")),
    ("faces", "no such axis", "two states", tree(lambda old: b"\x02\xff\xff", "faces.0")),
    ("faces", "any split with one state", "a state", tree(lambda old: b"\x00\xff\xff", "faces.1")),
    ("faces", "an empty tree", "two states", tree(lambda old: b"", "faces.3")),
    ("faces", "a tree cut short", "two states", tree(lambda old: old[:-1], "faces.2")),
    ("faces", "a byte behind it", "two states", tree(lambda old: old + b"\xff", "faces.0")),
    ("faces", "too many boxes wait", "two states", tree(lambda old: bytes([0] * 4097 + [LEAF] * 4098), "faces.3")),
    ("faces", "undefined on a face", "two states",
     setting("claim.outer", expression(["+", "100", ["*", "0", ["sqrt", ["-", "3", "x"]]]], 0.0))),
    ("faces", "a pole on a face", "a round set",
     regrown(setting("claim.outer.expression", ["+", ["**", ["-", "y", "x"], -2], "100"]))),
    ("faces", "a domain beyond binary64", "two states", setting("plant.domain.0", ["-3", "1" + "0" * 400])),
    ("outer", "a level beyond the edge", "close to the edge", regrown(level(1.9151**2))),
    ("outer", "far beyond", "a state", regrown(level(2.5**2))),
    ("outer", "less is known", "uncertain", regrown(setting("plant.uncertain.0.range", ["-1/2", "2/3"]))),
    ("outer", "least on the edge of {V <= c2}", "disturbed",
     regrown(setting("claim.outer.expression", ["**", ["+", "x", "1/2"], 2]), level(6.0))),
    ("outer", "it rises", "a state",
     regrown(setting("claim.outer.expression", ["**", ["-", "x", "2"], 2]), level(0.5))),
    ("outer", "no derivative there", "a state", setting("claim.outer",
     expression(["sqrt", ["*", ["-", "x", "1"], ["-", "x", "1"]]], 1.5))),
    ("outer", "a pole of F", "a state", regrown(setting("plant.dynamics", [["+", HALF_LESS_TANH,
     ["*", "0", ["/", "1", ["-", "x", "7/5"]]]]]))),
    ("outer", "a pole of N", "a round set",
     regrown(setting("claim.outer.expression", ["+", ROUND, ["*", "0", ["/", "1", ["-", ROUND, "1"]]]]))),
    ("outer", "a singular T", "two states", setting("evidence.outer.T", encode(np.ones((2, 2))))),
    ("outer", "T = 0", "a state", setting("evidence.outer.T", encode([0.0]))),
    ("outer", "a root too small", "two states", root(1 - 1e-15)),
    ("outer", "by one bit", "an odd domain", nudged),
    ("outer", "in other coordinates", "in other coordinates", nudged),
    ("outer", "a negative root", "two states", root(-1.0)),
    ("outer", "a larger T", "two states", setting("evidence.outer.T", encode(0.5 * np.eye(2)))),
    ("outer", "a leaf for all", "two states", tree(lambda old: b"\xff")),
    ("outer", "no tree", "two states", tree(lambda old: b"")),
    ("outer", "a tree cut short", "two states", tree(lambda old: old[:-1])),
    ("outer", "a byte behind it", "two states", tree(lambda old: old + b"\xff")),
    ("outer", "no such axis", "two states", tree(lambda old: b"\x02" + old + b"\xff")),
    ("outer", "the other half", "functions", tree(lambda old: bytes([old[0], LEAF]) + old[1:-1])),
    ("outer", "too many boxes wait", "two states", tree(lambda old: bytes([0] * 4097 + [LEAF] * 4098))),
    ("inputs", "beyond the bounds", "a state", regrown(setting("plant.input_bounds", [["-9/10", "9/10"]]),
     setting("policy.centre", "output"), rehash)),
    ("inputs", "with another N", "two states", setting("plant.input_bounds", [["-1/2", "1/2"]])),
    ("hash", "another policy", "a state", setting("policy.scale", encode([-1.5]))),
    ("domain", "none below 0", "a state", setting("plant.domain", [["1", "3"]])),
]  # fmt: skip


MIXED = FORGED[::2] + FORGED[1::2]  # of every rule among the first half


@pytest.mark.parametrize(
    ("rule", "what", "base", "edit"), slow_after(20, MIXED), ids=[f"{f[0]}, {f[2]}: {f[1]}" for f in MIXED]
)
def test_forgeries_are_refused(rule: str, what: str, base: str, edit: Edit) -> None:
    forged = edit(honest(base))
    assert judge(forged) == rule
    if rule not in ("format", "hash"):
        assert verdict(forged) == rule


HARMLESS: list[tuple[str, str, Edit]] = [
    ("a lower level", "a state", level(1.5)),
    ("a constant above its level", "a state", setting("claim.outer", expression("1", 0.0))),
    ("a negative level", "a state", level(-1.0)),
    ("a level that is -0", "a state", level(-0.0)),
    ("a larger root", "a state", regrown(root(1.5))),
    ("a finer face", "two states", tree(lambda old: halves(4), "faces.2")),
    ("a T that turns", "a state", regrown(setting("evidence.outer.T", encode([-1.0])))),
    ("words", "a state", setting("provenance", {"outer": None})),
]


@pytest.mark.parametrize(("what", "base", "edit"), HARMLESS, ids=[h[0] for h in HARMLESS])
def test_harmless_edits_stay_accepted(what: str, base: str, edit: Edit) -> None:
    data = edit(honest(base))
    assert judge(data) is None and verdict(data) == "ACCEPTED"


def test_every_leaf_counts() -> None:
    """Two leaves that pass become one that does not, wherever they are."""
    data, seen = honest("in other coordinates"), set()
    whole = base64.b64decode(data["evidence"]["outer"]["tree"])
    for place in [k for k in range(len(whole) - 2) if whole[k] != LEAF and whole[k + 1 : k + 3] == b"\xff\xff"]:
        merged = whole[:place] + b"\xff" + whole[place + 3 :]
        answer = rules.judge(dump(edited(data, "evidence.outer.tree", text(merged))))
        number = whole[:place].count(LEAF)
        assert (answer.rule, answer.at) == ("outer", f"outer leaf {number}")
        seen.add(answer.at)
    assert len(seen) > 10


def test_places_have_names() -> None:
    data = honest("up to a face")
    for k in range(4):
        answer = rules.judge(dump(edited(data, f"evidence.outer.faces.{k}", text(b""))))
        assert (answer.rule, answer.at) == ("faces", f"face {k} byte 0")
        answer = rules.judge(dump(edited(data, f"evidence.outer.faces.{k}", "/w==")))
        assert (answer.rule, answer.at) == ("faces", f"face {k} leaf 0")
    far = rules.judge(dump(edited(data, "plant.input_bounds", [["-1/2", "1/2"]])))
    assert far.rule == "inputs" and str(far.at).startswith("outer leaf ")
    assert rules.judge(dump(nudged(data))).at == "axis 0"


# ---------------------------------------------------------------------------------------------- what each clause is for

CLAUSES: dict[str, tuple[str, Callable[..., Any], str, str]] = {
    "faces": ("face", lambda *_: None, "faces", "a level beyond all of them"),
    "the root box": ("covers_domain", lambda *_: None, "outer", "by one bit"),
    "the tree": ("structure", lambda *_: 0, "outer", "a tree cut short"),
    "the inputs": ("Leaves.keep_bounds", lambda *_: None, "inputs", "with another N"),
}


def test_with_a_clause_disabled_a_forgery_gets_through(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, instead, rule, what in CLAUSES.values():
        forged = next(edit(honest(base)) for r, w, base, edit in FORGED if (r, w) == (rule, what))
        assert judge(forged) == rule
        with monkeypatch.context() as patch:
            patch.setattr(f"certify.reference.outer.{name}", instead)
            assert judge(forged) is None, name


WELL = ["**", ["-", ROUND, "6/25"], 2]  # least just inside {V <= c2}, where it does not fall


@pytest.mark.slow
@pytest.mark.parametrize(("name", "needed"), [("close to the edge", 0), ("a well", 1)])
def test_multipliers_pay(name: str, needed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where N'F vanishes beyond n2, or within {V < c2}, it does not fall on all of a leaf."""
    keep, bare = outer.is_negative, planar(expression(WELL, 60.0)) if name == "a well" else HONEST[name]()
    data = grown(bare)
    assert judge(data) is None
    sizes = []
    for some in (slice(0, 2), slice(0, 1), slice(1, 2), slice(0)):
        monkeypatch.setattr(outer, "is_negative", lambda D, slacks, some=some: keep(D, slacks[some]))
        assert some == slice(0, 2) or judge(data) == ("outer" if some != slice(needed, needed + 1) else judge(data))
        sizes.append(len(base64.b64decode(grown(bare, 2000)["evidence"]["outer"]["tree"])))
    both, *alone, none = sizes
    assert 2 * both < none and alone[needed] < alone[1 - needed], sizes


def test_lines_pay(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a face that is one leaf the tanhs are far from their tangents."""
    assert judge(honest("three states")) is None
    monkeypatch.setattr(Models, "by_forms", lambda self, x: Taylor(arb("nan")))
    assert judge(honest("three states")) == "faces"


# ---------------------------------------------------------------------------------------------------- models enclose


def mixed() -> Document:
    """Three layers with weights of both signs."""
    generator = np.random.default_rng(17)
    shapes = ((5, 2), (4, 5), (1, 4))
    return planar(network([(generator.standard_normal(s), generator.standard_normal(s[0])) for s in shapes], 0.0))


@pytest.mark.parametrize("name", ["two layers", "functions", "mixed"])
@pytest.mark.parametrize("seed", range(3))
def test_models_enclose_N_and_its_rate(name: str, seed: int) -> None:
    """On boxes of all sizes, along models of F with coefficients of every kind."""
    data, generator = mixed() if name == "mixed" else HONEST[name](), np.random.default_rng(seed)
    c = read(dump(data))
    assert c.beyond is not None
    symbols = 4
    for _ in range(6):
        T = generator.standard_normal((2, 2))
        centre = 0.5 * generator.standard_normal(2)
        radius = 10.0 ** generator.uniform(-4, -0.3, 2)
        box = Box(0, (centre - radius).tolist(), (centre + radius).tolist())
        with ctx.workprec(PRECISION):
            models, lined = Models(c.beyond, c.plant.states), Taylor(arb(0), None, None, arb("inf"))
            x = affine(box, T, symbols)
            F = [
                Taylor(
                    arb(generator.standard_normal()),
                    arb_mat([[arb(v) for v in generator.standard_normal(symbols)]]),
                    symmetric(0.1 * generator.standard_normal((symbols, symbols))),
                    arb(0.01),
                ),
                Taylor(arb(generator.standard_normal())),
            ]
            try:
                value, rate = models.moving(x, F)
                alone = models.value(affine(box, T))
                if models.N.calls:
                    lined = models.by_forms(affine(box, T))
                    *slopes, error = lined.g.entries()  # the last is that of the network's value
                    assert lined.Q is None
                    lined = Taylor(lined.c, arb_mat([slopes]), None, abs(error) + lined.r)
            except Refused:
                assert name == "functions"
                continue
        for _ in range(8):
            d = np.where(generator.random(symbols) < 0.4, 1.0, generator.uniform(-1, 1, symbols)).tolist()
            with ctx.workprec(400):
                at = [exactly_at(v, d) for v in x]
                moved = [exactly_at(f, d) + f.r * generator.uniform(-1, 1) for f in F]
                true = N_in_arb(data, at)
                for model, e in ((value, d), (alone, d[:2]), (lined, d[:2])):
                    assert abs(true - exactly_at(model, e)) <= model.r + arb("1e-25")
                h = arb(2) ** -60
                far = N_in_arb(data, [v + h * f for v, f in zip(at, moved, strict=True)])
                near = N_in_arb(data, [v - h * f for v, f in zip(at, moved, strict=True)])
                assert abs((far - near) / (2 * h) - exactly_at(rate, d)) <= rate.r + arb("1e-25")
                assert not true > value.bound() and not true < -(-value).bound()


@pytest.mark.parametrize("name", ["in other coordinates", "an odd domain", "functions"])
def test_a_free_leaf_holds_no_point_of_which_something_is_said(name: str) -> None:
    """In the domain, V at least c2 and N at most n2: drawn in boxes that are free, of which many touch an end."""
    data, generator = HONEST[name](), np.random.default_rng(11)
    c = read(dump(data))
    n2, T = float.fromhex(data["claim"]["outer"]["level"]), decode(data["evidence"]["outer"]["T"]).reshape(2, 2)
    ends = np.array([[eval_rational(end) for end in pair] for pair in data["plant"]["domain"]])
    with ctx.workprec(PRECISION):
        region = region_of(c)
        inverse, kinds = np.linalg.inv(T), {"outside": 0, "below c2": 0, "above n2": 0}
        for _ in range(400):
            x = generator.uniform(1.1 * ends[:, 0], 1.1 * ends[:, 1]) * generator.choice([0.3, 1.0])
            if generator.random() < 0.5:
                axis = generator.integers(2)
                x[axis] = ends[axis, generator.integers(2)] * (1 + 0.01 * generator.standard_normal())
            centre, radius = inverse @ x, 10.0 ** generator.uniform(-3, -0.3, 2)
            box = Box(0, (centre - radius).tolist(), (centre + radius).tolist())
            if not region.is_free(box):
                continue
            points = (T @ (centre[:, None] + radius[:, None] * generator.choice([-1, 1, 0.3, -0.6], (2, 30)))).T
            inside = [p for p in points if (ends[:, 0] <= p).all() and (p <= ends[:, 1]).all()]
            kinds["outside"] += not inside
            kinds["below c2"] += any(p @ p < 0.25 for p in inside)
            kinds["above n2"] += any(p @ p >= 0.25 for p in inside)
            assert all(p @ p < 0.25 + 1e-12 or N_at(data, p) > n2 - 1e-12 for p in inside)
    assert min(kinds.values()) > 5, kinds


def exactly_at(model: Taylor, d: Sequence[float]) -> arb:
    """c + g.d + d'Qd."""
    value, column = model.c, arb_mat(len(d), 1, list(map(arb, d)))
    if model.g is not None:
        value += (model.g * column)[0, 0]
    if model.Q is not None:
        value += (column.transpose() * model.Q * column)[0, 0]
    return value


def symmetric(A: np.ndarray) -> arb_mat:
    return arb_mat([[arb(v) for v in row] for row in (A + A.T).tolist()])


@pytest.mark.parametrize("bad", ["inf", "-inf", "nan"])
def test_what_is_not_finite_is_not_accepted(bad: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """+inf > n2 and -inf < 0 are certain, and say nothing."""
    data, broken = honest("an affine network"), Taylor(arb(bad), arb_mat([[0]]))
    with ctx.workprec(PRECISION):
        region = region_of(read(dump(data)))
        assert not region.models.is_above([broken])
        (leaf,) = region.leaves.enclose([Box(0, [1.0], [1.25])])
        monkeypatch.setattr(region.leaves, "F", lambda leaf: [broken])
        assert not region.falls(leaf)


@pytest.mark.parametrize("name", ["sin", "cos", "tanh", "exp", "atan", "sqrt"])
def test_the_slope_of_a_function_as_a_function(name: str) -> None:
    """Its second-order model about every centre, whose remainder is that of the series; or there is none."""
    for at in np.linspace(-4, 4, 33):
        for reach in (0.0, 1e-3, 0.1, 1.0, 5.0):
            y, x = arb(at), Taylor(arb(at), arb_mat([[arb(reach)]]))
            if name == "sqrt" and at <= reach:
                with pytest.raises(Refused):
                    x.slope_of(name)
                continue
            slope, p = x.slope_of(name), FUNCTIONS[name].derivatives(y)
            most = FUNCTIONS[name].last(y, p, arb(reach))
            assert most is not None
            for share in np.linspace(-1, 1, 9):
                v = y + arb(share * reach)
                true = FUNCTIONS[name].derivatives(v)[1]
                rest = true - p[1] - p[2] * (v - y) - p[3] * (v - y) ** 2 / 2
                assert not abs(rest) > most * abs(v - y) ** 3 / 6
                assert not abs(true - exactly_at(slope, [share])) > slope.r


@pytest.mark.parametrize("seed", slow_after(2, range(4)))
def test_what_is_accepted_of_a_random_network_is_true(seed: int) -> None:
    """The largest level of three that is accepted; for each the claim is looked at, at many points."""
    generator = np.random.default_rng(seed)
    W, b, v = (0.05 * generator.standard_normal(shape) for shape in ((4, 2), 4, (1, 4)))
    bumps = [(BUMPS[0][0] + W, BUMPS[0][1] + b), (BUMPS[1][0] + v, [0.0])]
    T = np.eye(2) + 0.2 * generator.standard_normal((2, 2))
    for n2 in (-1.25, -1.4, -1.55):
        data = grown(planar(network(bumps, n2), T), 1500)
        if judge(data) is not None:
            continue
        for k in range(1000):
            x = generator.uniform(-3, 3, 2)
            if k % 4 == 0:
                x[generator.integers(2)] = generator.choice([-3, 3])
                assert N_at(data, x) > n2
            elif N_at(data, x) <= n2 and x @ x >= 0.25:
                assert rate_at(data, x, generator) < 0
        return
    pytest.fail("none is accepted")


# ---------------------------------------------------------------------------------------------------------- other ends


@pytest.mark.parametrize(
    "value", ["1/3", "-1/3", "3", "0", "-10/7", f"1/{10**400}", f"-1/{10**400}", str(2**53 + 1), str(-(2**53) - 1)]
)
def test_the_least_binary64_above(value: str) -> None:
    numerator, _, denominator = value.partition("/")
    q = fmpq(int(numerator), int(denominator or 1))
    found = binary64_above(q, "")
    assert fmpq(*found.as_integer_ratio()) >= q > fmpq(*math.nextafter(found, -math.inf).as_integer_ratio())


@pytest.mark.parametrize("value", [10**400, 2**1024, int(1.7976931348623157e308) + 1])
def test_no_binary64_above(value: int) -> None:
    with pytest.raises(Refused):
        binary64_above(fmpq(value), "")


def test_an_end_that_is_no_binary64_number_is_meant_exactly() -> None:
    """N is 0 at 1/10 itself, and its binary64 neighbours lie on both sides of it."""
    data = scalar(expression(["*", ["-", "1/10", "x"], "-1"], 0.0), domain=[("-1", "1/10")])
    data = edited(data, "levels", {"local": (0.0025).hex(), "roa": (0.0025).hex()})
    assert judge(grown(data)) == "faces"


def test_equal_levels_excuse_no_leaf() -> None:
    """{V <= c2} by the ball alone, which says nothing of inputs beyond it."""
    data = honest("two states")
    assert data["levels"]["local"] == data["levels"]["roa"]
    assert judge(edited(data, "plant.input_bounds", [["-1/2", "1/2"]])) == "inputs"


# -------------------------------------------------------------------------------------------------------------- words


def test_words_say_where_N_is_stated_and_its_level() -> None:
    data = honest("two states")
    said = in_words(read(dump(data)))
    assert "converges to the origin" in said
    assert "N(x) <= -1.25, N being the expression that the certificate states" in said
    said = in_words(read(dump(honest("uncertain"))))
    assert "N(x) <= 2.25, N being the expression" in said and said.endswith("these have at any time: q in [-1/2, 1/2]")


def test_the_practical_claim_with_another_function() -> None:
    data = practical(make([["-", "x"]], TANH, [[1.0]], (0.04, 0.25), tree=halves(5)))
    data["claim"] = {"kind": "practical", **CONTINUOUS}
    data = grown(stated(data, expression(["**", "x", 2], 8.0)))
    assert judge(data) is None
    assert "enters V <= 0.04 in finite time" in in_words(read(dump(data)))
