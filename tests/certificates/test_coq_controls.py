"""Proofs that Coq must refuse, each beside one that it accepts: what is altered, and why it then is false or unshown.

The claim and the evidence are taken apart into plain lists, altered, and written down again, also where no certificate
and no search could say so. What is false is shown to be false in floats, apart from Coq: by a state of the set. What is
unshown is a claim that holds, led by evidence that does not show it.
"""

from __future__ import annotations

import copy
import math
import re
import shutil
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from certify.certificates.coq.data import read_claim
from certify.certificates.coq.evidence import Leaf, Split, inverse
from certify.certificates.coq.expression import Expression
from certify.certificates.coq.kernel import compile_folder, find_coqc, theory_files, write_folder
from certify.certificates.coq.search import search
from certify.certificates.coq.text import ASSUMPTIONS, PROOF, dyadic, expression, ratio
from tests.certificates.coq_cases import pendulum, raw
from tests.support.certificates import edited, encode, make

pytestmark = [pytest.mark.slow, pytest.mark.skipif(shutil.which("coqc") is None, reason="needs coqc")]
SQUASH = {"tanh": "ByTanh", "identity": "ByIdentity"}
CENTRE = {"output": "AtOutput", "preactivation": "AtPreactivation", "none": "NotCentred"}
HEAD = "From Coq Require Import List ZArith Floats.\nRequire Import Vectors Spec Data.\nImport ListNotations.\n"


@dataclass
class Pieces:
    """A claim and its evidence, as lists that can be altered."""

    field: list[Expression]
    domain: list[list[Fraction]]
    channels: list[list[Any]]  # scale, offset, rest, least, greatest
    layers: list[list[list[Any]]]  # of each row its weights and its bias
    squash: str
    centre: str
    P: list[list[float]]
    level: float
    rate: Fraction
    T: list[list[Fraction]]
    W: list[list[Fraction]]
    root: list[float]
    core: list[float]
    splits: Any


Change = Callable[[Pieces], None]
CLAIMED = ("field", "domain", "channels", "layers", "squash", "centre", "P", "level", "rate")


def nothing(p: Pieces) -> None:
    """All as it was."""


@dataclass(frozen=True)
class Control:
    """What is altered.

    Parameters
    ----------
    why : it is refused: a condition that is false, `shape`, or `unshown` where the claim is as it was.
    wrong, right : alterations in place; the second one, of the same place, leaves it true.
    """

    why: str
    wrong: Change
    right: Change = nothing


# Coq's words


def words(pieces: Pieces, base: Pieces) -> tuple[str, str, str]:
    """Certificate, rate and evidence; what is as in the base is named there."""

    def part(name: str, text: str) -> str:
        return f"Base.{name}" if getattr(pieces, name) == getattr(base, name) else f"({text})"

    layers = "; ".join(
        f"Base.layer_{k}" if k < len(base.layers) and layer == base.layers[k] else _layer(layer)
        for k, layer in enumerate(pieces.layers)
    )
    certificate = " ".join((
        "Certificate", part("field", _list(map(expression, pieces.field))),
        part("domain", _list(f"({ratio(lo)}, {ratio(hi)})" for lo, hi in pieces.domain)),
        part("channels", _list(map(_channel, pieces.channels))), f"[{layers}]", SQUASH[pieces.squash],
        CENTRE[pieces.centre], part("P", _matrix(pieces.P, dyadic)), f"({dyadic(pieces.level)})",
    ))  # fmt: skip
    evidence = " ".join((
        "Evidence", part("T", _matrix(pieces.T, ratio)), part("W", _matrix(pieces.W, ratio)),
        _list(map(_float, pieces.root)), _list(map(_float, pieces.core)), part("splits", _tree(pieces.splits)),
    ))  # fmt: skip
    return certificate, ratio(pieces.rate), evidence


def base_text(pieces: Pieces) -> str:
    """Definitions of the parts that others name."""
    parts = {
        "field": ("list expr", _list(map(expression, pieces.field))),
        "domain": ("list (rational * rational)", _list(f"({ratio(lo)}, {ratio(hi)})" for lo, hi in pieces.domain)),
        "channels": ("list channel", _list(map(_channel, pieces.channels))),
        "P": ("list (list dyadic)", _matrix(pieces.P, dyadic)),
        "T": ("list (list rational)", _matrix(pieces.T, ratio)),
        "W": ("list (list rational)", _matrix(pieces.W, ratio)),
        "splits": ("tree", _tree(pieces.splits)),
        **{f"layer_{k}": ("layer", _layer(layer)) for k, layer in enumerate(pieces.layers)},
    }
    return HEAD + "".join(f"Definition {name} : {kind} := {text}.\n" for name, (kind, text) in parts.items())


def _list(items: Iterator[str] | Any) -> str:
    return f"[{'; '.join(items)}]"


def _matrix(rows: list[list[Any]], text: Callable[[Any], str]) -> str:
    return _list(_list(map(text, row)) for row in rows)


def _layer(rows: list[list[Any]]) -> str:
    return _list(f"({_list(map(dyadic, weights))}, {dyadic(bias)})" for weights, bias in rows)


def _channel(c: list[Any]) -> str:
    scale, offset, *rest = c
    return f"Channel ({dyadic(scale)}) ({dyadic(offset)}) " + " ".join(f"({ratio(Fraction(q))})" for q in rest)


def _float(value: float) -> str:
    if math.isnan(value):
        return "PrimFloat.nan"
    if math.isinf(value):
        return "PrimFloat.infinity" if value > 0 else "PrimFloat.neg_infinity"
    return f"({value.hex()})%float"


def _tree(node: Any) -> str:
    if isinstance(node, Leaf):
        return f"Leaf {_float(node.k)}"
    return f"Split {node.axis} {_float(node.at)} ({_tree(node.below)}) ({_tree(node.above)})"


# What is false, in floats


def conditions_broken(p: Pieces) -> set[str]:
    """Those that fail by far more than rounding, at a state of the set where one is needed."""
    if shape_broken(p):
        return {"shape"}
    broken = set()
    if p.level <= 0:
        broken.add("level")
    if p.rate <= 0:
        broken.add("rate")
    P = np.array(p.P)
    if not np.array_equal(P, P.T) or np.linalg.eigvalsh((P + P.T) / 2).min() <= 0:
        return broken | {"positive"}
    if broken:
        return broken
    with np.errstate(all="ignore"):
        return {name for name, margin in margins(p).items() if not margin < 1e-6}


def shape_broken(p: Pieces) -> bool:
    n = len(p.domain)
    widths = [n]
    for layer in p.layers:
        if any(len(weights) != widths[-1] for weights, _ in layer):
            return True
        widths.append(len(layer))
    square = len(p.P) == n and all(len(row) == n for row in p.P)
    return not (len(p.field) == n and square and p.layers and widths[-1] == len(p.channels))


def margins(p: Pieces) -> dict[str, float]:
    """By how much each condition fails at most; NaN where something is not defined."""
    n, rng = len(p.domain), np.random.default_rng(0)
    P = np.array(p.P)
    around = rng.standard_normal((4000, n))
    around /= np.sqrt(np.einsum("ki,ij,kj->k", around, P, around))[:, None]
    shares = np.concatenate([np.ones(2000), np.full(1000, 1e-2), rng.uniform(0.05, 1, 1000)])
    x = around * (0.999999 * math.sqrt(p.level) * shares)[:, None]
    u, F = loop(p, x)
    u0, F0 = loop(p, np.zeros((1, n)))
    V, D = np.einsum("ki,ij,kj->k", x, P, x), 2 * np.einsum("ki,ij,kj->k", x, P, F)
    lo, hi = np.array(p.domain, dtype=float).T
    rest, least, greatest = np.array([c[2:] for c in p.channels], dtype=float).T
    return {
        "decrease": float(np.max((D + float(p.rate) * V) / V)),
        "domain": float(max(np.max(x - hi), np.max(lo - x))),
        "bounds": float(max(np.max(u - greatest), np.max(least - u))),
        "rest": float(max(np.abs(u0[0] - rest).max(), np.abs(F0).max())),
    }


def loop(p: Pieces, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Inputs and F, as FORMAT.md has them."""
    at_x, at_0 = net(p, x), net(p, np.zeros((1, len(p.domain))))
    scale, offset, rest = (np.array([c[k] for c in p.channels], dtype=float) for k in (0, 1, 2))
    squash = np.tanh if p.squash == "tanh" else np.array
    u = scale * squash(at_x) + offset
    if p.centre == "output":
        u = scale * squash(at_x) - scale * squash(at_0) + rest
    if p.centre == "preactivation":
        u = scale * squash(at_x - at_0 + np.arctanh((rest - offset) / scale)) + offset
    return u, np.stack([value(e, x, u) for e in p.field], 1)


def net(p: Pieces, y: np.ndarray) -> np.ndarray:
    for k, layer in enumerate(p.layers):
        y = (np.tanh(y) if k else y) @ np.array([w for w, _ in layer]).T + np.array([b for _, b in layer])
    return y


def value(e: Expression, x: np.ndarray, u: np.ndarray) -> Any:
    a = [value(operand, x, u) for operand in e.operands]
    nothing = np.full(len(x), math.nan)
    match e.kind:
        case "state":
            return x[:, e.index] if e.index < x.shape[1] else nothing
        case "input":
            return u[:, e.index] if e.index < u.shape[1] else nothing
        case "const":
            return np.full(len(x), float(e.number))
        case "add":
            return a[0] + a[1]
        case "mul":
            return a[0] * a[1]
        case "neg":
            return -a[0]
        case "pow":
            return a[0] ** e.index
        case "inv":
            return 1 / a[0]
    return {"sin": np.sin, "cos": np.cos, "tanh": np.tanh, "exp": np.exp, "atan": np.arctan, "sqrt": np.sqrt}[e.kind](
        a[0]
    )


# Two claims


def pieces_of(data: dict[str, Any], rate: Fraction) -> Pieces:
    c = read_claim(raw(data))
    found = search(c, rate)
    assert found.evidence is not None, found.reason
    e = found.evidence
    channels = zip(c.network.scale.tolist(), c.network.offset.tolist(), c.u_eq, c.bounds, strict=True)
    return Pieces(
        list(c.field), [list(pair) for pair in c.domain], [[s, o, u, *ends] for s, o, u, ends in channels],
        [[[w, b] for w, b in zip(W.tolist(), B.tolist(), strict=True)]
         for W, B in zip(c.network.weights, c.network.biases, strict=True)],
        c.network.squash, c.network.centre, c.P.tolist(), c.level, rate,
        [list(row) for row in e.T], [list(row) for row in e.W], list(e.root), list(e.core), e.splits,
    )  # fmt: skip


@cache
def pendulums() -> Pieces:
    P = encode([[1.10546875, 0.01953125], [0.01953125, 0.02734375]])
    return pieces_of(edited(pendulum(0.3), "lyapunov.P", P), Fraction(1, 2))


@cache
def crossed() -> Pieces:
    """Two inputs, either of which acts on both states, that rest at 1/2 and -1/3; centring at the output."""
    first = [
        "+",
        ["*", "1/4", "x"],
        "y",
        ["-", "u", "1/2"],
        ["*", "1/4", ["+", "w", "1/3"]],
        ["*", "1/5", ["**", "x", 2]],
    ]
    second = ["+", ["-", ["sin", "x"]], ["*", "1/3", "y"], ["+", "w", "1/3"], ["*", "-1/4", ["-", "u", "1/2"]]]
    layers = [
        ([[1.0, 0.25], [-0.5, 1.0], [0.125, -0.75]], [0.125, -0.25, 0.5]),
        ([[-0.75, 0.25, 0.0], [0.5, 1.25, -0.5]], [0.0625, -0.125]),
    ]
    return pieces_of(make(
        [first, second], layers, [[1.0, 0.125], [0.125, 0.75]], (0.001, 0.04), states=("x", "y"), inputs=("u", "w"),
        u_eq=("1/2", "-1/3"), domain=(("-1/2", "3/4"), ("-1", "1/2")), input_bounds=(("-1", "2"), ("-2", "1")),
        centre="output", scale=(2.0, -2.0), offset=(0.25, 3.0),
    ), Fraction(1))  # fmt: skip


# Alterations


def flip(*places: tuple[int, int, int | None]) -> Change:
    """Signs of weights: layer, row, column, or None for the bias."""
    return scaled(-1.0, *places)


def scaled(factor: float, *places: tuple[int, int, int | None]) -> Change:
    def change(p: Pieces) -> None:
        for layer, row, column in places:
            neuron = p.layers[layer][row]
            if column is None:
                neuron[1] *= factor
            else:
                neuron[0][column] *= factor

    return change


def nudge(*places: tuple[int, int, int | None]) -> Change:
    """Weights that hardly change."""
    return scaled(1 + 2.0**-40, *places)


def put(name: str, *path: int, to: Any) -> Change:
    """Another entry, at a path of indices."""

    def change(p: Pieces) -> None:
        if not path:
            setattr(p, name, to(getattr(p, name)) if callable(to) else to)
            return
        at = getattr(p, name)
        for k in path[:-1]:
            at = at[k]
        at[path[-1]] = to(at[path[-1]]) if callable(to) else to

    return change


def drop(name: str, *path: int) -> Change:
    def change(p: Pieces) -> None:
        at = getattr(p, name)
        for k in path[:-1]:
            at = at[k]
        del at[path[-1]]

    return change


def all_of(*changes: Change) -> Change:
    def change(p: Pieces) -> None:
        for one in changes:
            one(p)

    return change


def node(kind: str, *operands: Expression, **more: Any) -> Expression:
    return Expression(kind, operands, **more)


def number(text: str) -> Expression:
    return node("const", number=Fraction(text))


def plus(i: int, text: str, factor: Expression) -> Change:
    """The i-th equation with a multiple of another expression."""
    return put("field", i, to=lambda e: node("add", e, node("mul", number(text), factor)))


def constants(f: Callable[[Fraction], Fraction]) -> Change:
    """Every number of the equations."""

    def of(e: Expression) -> Expression:
        return Expression(e.kind, tuple(map(of, e.operands)), e.index, f(e.number) if e.kind == "const" else e.number)

    return put("field", to=lambda field: [of(e) for e in field])


def renamed(old: str, new: str) -> Change:
    """Every node of a kind."""

    def of(e: Expression) -> Expression:
        return Expression(new if e.kind == old else e.kind, tuple(map(of, e.operands)), e.index, e.number)

    return put("field", to=lambda field: [of(e) for e in field])


def tree(f: Callable[[Any], Any]) -> Change:
    """The partition, each node from its parts upwards."""

    def of(t: Any) -> Any:
        return f(t if isinstance(t, Leaf) else Split(t.axis, t.at, of(t.below), of(t.above)))

    return put("splits", to=of)


def splits(f: Callable[[Split], Any]) -> Change:
    return tree(lambda t: f(t) if isinstance(t, Split) else t)


def multipliers(k: Callable[[float], float]) -> Change:
    return tree(lambda t: Leaf(k(t.k)) if isinstance(t, Leaf) else t)


def deepest_dropped(p: Pieces) -> None:
    """The deepest split becomes a leaf."""

    def depth(t: Any) -> int:
        return 0 if isinstance(t, Leaf) else 1 + max(depth(t.below), depth(t.above))

    def without(t: Any) -> Any:
        if depth(t) == 1:
            return Leaf(0.0)
        below = depth(t.below) >= depth(t.above)
        return Split(t.axis, t.at, without(t.below) if below else t.below, t.above if below else without(t.above))

    p.splits = without(p.splits)


def transposed(M: list[list[Any]]) -> list[list[Any]]:
    return [list(row) for row in zip(*M, strict=True)]


def other_coordinates(T: list[list[int]]) -> Change:
    """T with its own inverse."""
    exact = tuple(tuple(Fraction(q) for q in row) for row in T)
    return all_of(put("T", to=[list(row) for row in exact]), put("W", to=[list(row) for row in inverse(exact)]))


def exchanged(p: Pieces) -> None:
    """T and its inverse."""
    p.T, p.W = p.W, p.T


def mirrored(p: Pieces) -> None:
    """-T, with its inverse: every z changes its sign, and with it each box and each split."""

    def of(t: Any) -> Any:
        return t if isinstance(t, Leaf) else Split(t.axis, -t.at, of(t.above), of(t.below))

    p.T, p.W = ([[-q for q in row] for row in M] for M in (p.T, p.W))
    p.splits = of(p.splits)


def evidence_of(other: Callable[[], Pieces]) -> Change:
    def change(p: Pieces) -> None:
        for name in ("T", "W", "root", "core", "splits"):
            setattr(p, name, copy.deepcopy(getattr(other(), name)))

    return change


def minus(v: Any) -> Any:
    return -v


x0, x1, u0 = node("state"), node("state", index=1), node("input")
A_LITTLE = Fraction(1, 2**30)
NAN, INF = math.nan, math.inf

PENDULUM = {
    # the policy
    "a weight of layer 1": Control("decrease", flip((0, 6, 0)), nudge((0, 6, 0))),
    "another weight of layer 1": Control("decrease", flip((0, 8, 0)), nudge((0, 8, 0))),
    "three weights of layer 2": Control(
        "decrease", flip((1, 14, 13), (1, 5, 14), (1, 5, 6)), nudge((1, 14, 13), (1, 5, 14), (1, 5, 6))
    ),
    "a weight of layer 3": Control("decrease", flip((2, 0, 5)), nudge((2, 0, 5))),
    "another weight of layer 3": Control("decrease", flip((2, 0, 14)), nudge((2, 0, 14))),
    "biases of layer 1": Control(
        "decrease", put("layers", 0, to=lambda rows: [[w, b + 3] for w, b in rows]), nudge((0, 0, None), (0, 1, None))
    ),
    "biases of layer 2": Control(
        "decrease", put("layers", 1, to=lambda rows: [[w, b + 3] for w, b in rows]), nudge((1, 0, None), (1, 1, None))
    ),
    "layer 2 transposed": Control(
        "decrease",
        put(
            "layers",
            1,
            to=lambda rows: [[w, b] for w, (_, b) in zip(transposed([w for w, _ in rows]), rows, strict=True)],
        ),
        flip((2, 0, None)),  # centring takes the last bias away
    ),
    "layer 2 dropped": Control("decrease", drop("layers", 1), put("layers", 2, 0, 1, to=5.0)),
    "the last layer dropped": Control("shape", drop("layers", 2)),
    "the first layer dropped": Control("shape", drop("layers", 0)),
    "all layers dropped": Control("shape", put("layers", to=[])),
    "a row too long": Control("shape", put("layers", 1, 3, 0, to=lambda w: [*w, 0.0])),
    "a row too short": Control("shape", drop("layers", 1, 3, 0, 15)),
    "a row less": Control("shape", drop("layers", 0, 15)),
    "a row more": Control("shape", put("layers", 0, to=lambda rows: [*rows, [[0.0, 0.0], 0.0]])),
    "a neuron that nobody reads": Control(
        "shape",
        put("layers", 1, to=lambda rows: [*rows, [[0.0] * 16, 0.0]]),
        all_of(
            put("layers", 1, to=lambda rows: [*rows, [[0.0] * 16, 0.0]]),
            put("layers", 2, 0, 0, to=lambda w: [*w, 0.0]),
        ),
    ),
    "the scale's sign": Control("decrease", put("channels", 0, 0, to=minus), put("channels", 0, 0, to=6.000000001)),
    "a scale of 0": Control("decrease", put("channels", 0, 0, to=0.0)),
    "the offset": Control("rest", put("channels", 0, 1, to=7.0), put("channels", 0, 1, to=2.0**-40)),
    "u_eq": Control("rest", put("channels", 0, 2, to=Fraction(1, 10))),
    "no centring": Control("rest", put("centre", to="none"), put("centre", to="output")),
    "centring that has no meaning": Control("unshown", put("squash", to="identity")),
    "no inputs": Control("shape", put("channels", to=[])),
    "an input twice": Control("shape", put("channels", to=lambda c: [*c, c[0]])),
    "bounds of the input": Control(
        "bounds", all_of(put("channels", 0, 3, to=-1), put("channels", 0, 4, to=1)), put("channels", 0, 4, to=7)
    ),
    "the upper bound of the input": Control(
        "bounds", put("channels", 0, 4, to=Fraction(3, 2)), put("channels", 0, 3, to=-6 - A_LITTLE)
    ),
    "the lower bound of the input": Control(
        "bounds", put("channels", 0, 3, to=Fraction(-3, 2)), put("channels", 0, 4, to=6 + A_LITTLE)
    ),
    # the plant
    "ten times the gravity": Control(
        "decrease",
        constants(lambda q: 10 * q if q == Fraction(981, 50) else q),
        constants(lambda q: q + A_LITTLE if q == Fraction(981, 50) else q),
    ),
    "the friction's sign": Control(
        "decrease", constants(lambda q: 9 * abs(q) if q < 0 else q), constants(lambda q: q - A_LITTLE if q < 0 else q)
    ),
    "the torque's sign": Control(
        "decrease",
        constants(lambda q: -q if q == Fraction(80, 3) else q),
        constants(lambda q: q + A_LITTLE if q == Fraction(80, 3) else q),
    ),
    "cos instead of sin": Control("rest", renamed("sin", "cos")),
    "something that does not vanish": Control("rest", plus(1, "1/1000", number("1")), plus(1, "0", number("1"))),
    "an unstable equation": Control("decrease", plus(0, "9", x0), plus(0, "1/1000000000", x0)),
    "an equation dropped": Control("shape", drop("field", 1)),
    "an equation more": Control("shape", put("field", to=lambda f: [*f, number("0")])),
    "no equations": Control("shape", put("field", to=[])),
    "equations in another order": Control("decrease", put("field", to=lambda f: f[::-1])),
    "a state that is not there": Control("decrease", plus(0, "0", node("state", index=2)), plus(0, "0", x1)),
    "an input that is not there": Control("decrease", plus(0, "0", node("input", index=1)), plus(0, "0", u0)),
    "a pole in the set": Control(
        "decrease",
        plus(0, "1", node("mul", x0, node("inv", node("add", x0, number("-1/10"))))),
        plus(0, "1/1000000000", node("mul", x0, node("inv", node("add", x0, number("3"))))),
    ),
    "a root in the set": Control(
        "decrease",
        plus(0, "0", node("sqrt", node("add", node("mul", number("10"), x0), number("1")))),
        plus(0, "0", node("sqrt", node("add", node("mul", number("1/4"), x0), number("1")))),
    ),
    # V, the levels and the rate
    "a level out of the domain": Control("domain", put("level", to=12.0), put("level", to=0.29)),
    "a level above what is shown": Control("unshown", put("level", to=0.5), put("level", to=0.1)),
    "a level a little above": Control("unshown", put("level", to=0.3001), put("level", to=0.2999)),
    "a negative level": Control("level", put("level", to=-0.3)),
    "a level of 0": Control("level", put("level", to=0.0)),
    "a rate that is too large": Control("decrease", put("rate", to=Fraction(1)), put("rate", to=Fraction(1, 3))),
    "a rate of 0": Control("rate", put("rate", to=Fraction(0)), put("rate", to=Fraction(1, 10**9))),
    "a negative rate": Control("rate", put("rate", to=Fraction(-1, 2))),
    "P that is not symmetric": Control(
        "positive",
        put("P", 0, 1, to=lambda v: v + 2.0**-40),
        all_of(put("P", 0, 1, to=lambda v: v + 2.0**-40), put("P", 1, 0, to=lambda v: v + 2.0**-40)),
    ),
    "P that is indefinite": Control(
        "positive", put("P", 1, 1, to=minus), put("P", 1, 1, to=lambda v: v * (1 + 2.0**-40))
    ),
    "P that is negative": Control("positive", put("P", to=lambda P: [[-v for v in r] for r in P])),
    "P that is 0": Control("positive", put("P", to=[[0.0, 0.0], [0.0, 0.0]])),
    "another P": Control(
        "decrease",
        put("P", to=[[1.0, 0.0], [0.0, 1.0]]),
        all_of(put("P", to=lambda P: [[2 * v for v in r] for r in P]), put("level", to=0.6)),
    ),
    "a row of P dropped": Control("shape", drop("P", 1)),
    "a column of P dropped": Control("shape", drop("P", 0, 1)),
    "a smaller domain": Control(
        "domain",
        put("domain", 0, to=[Fraction(-1, 2), Fraction(1, 2)]),
        put("domain", 0, to=[Fraction(-3, 5), Fraction(3, 5)]),
    ),
    "a domain that ends soon on one side": Control(
        "domain", put("domain", 1, 1, to=Fraction(3)), put("domain", 1, 1, to=Fraction(4))
    ),
    "a domain beside the origin": Control(
        "domain", put("domain", 0, 0, to=Fraction(1, 100)), put("domain", 0, 0, to=Fraction(-1))
    ),
    "the domain of a state dropped": Control("shape", drop("domain", 1)),
    "no domain": Control("shape", put("domain", to=[])),
    # what leads the proof
    "a smaller root": Control("unshown", put("root", to=[0.9, 0.9]), put("root", to=[1.00001, 1.00001])),
    "a root that is smaller by little": Control("unshown", put("root", 1, to=0.9999), put("root", 1, to=1.0001)),
    "a negative root": Control("unshown", put("root", 0, to=-1.1)),
    "a root that is no number": Control("unshown", put("root", 0, to=NAN)),
    "a root without end": Control("unshown", put("root", 0, to=INF)),
    "a root less": Control("unshown", drop("root", 1)),
    "a larger core": Control("unshown", put("core", to=[1.0, 1.0]), put("core", to=lambda c: [-v for v in c])),
    "a core without end": Control("unshown", put("core", to=[INF, INF])),
    "a core that is no number": Control("unshown", put("core", to=[NAN, NAN])),
    "a smaller core": Control("unshown", put("core", to=lambda c: [v / 64 for v in c])),
    "a core less": Control("unshown", drop("core", 1)),
    "no partition": Control("unshown", put("splits", to=Leaf(0.0))),
    "a split dropped": Control("unshown", deepest_dropped),
    "halves exchanged": Control("unshown", splits(lambda s: Split(s.axis, s.at, s.above, s.below))),
    "other axes": Control("unshown", splits(lambda s: Split(1 - s.axis, s.at, s.below, s.above))),
    "an axis that is not there": Control("unshown", splits(lambda s: Split(7, s.at, s.below, s.above))),
    "split points outside": Control("unshown", splits(lambda s: Split(s.axis, s.at + 9, s.below, s.above))),
    "split points that are no numbers": Control("unshown", splits(lambda s: Split(s.axis, NAN, s.below, s.above))),
    "split points without end": Control("unshown", splits(lambda s: Split(s.axis, INF, s.below, s.above))),
    "negative multipliers": Control("unshown", multipliers(lambda k: -1.0)),
    "multipliers that are no numbers": Control("unshown", multipliers(lambda k: NAN)),
    "multipliers without end": Control("unshown", multipliers(lambda k: INF)),
    "large multipliers": Control("unshown", multipliers(lambda k: 1e6), multipliers(lambda k: k * (1 + 2.0**-40))),
    "an inverse that is none": Control("unshown", put("W", 0, 0, to=lambda q: q + A_LITTLE)),
    "an inverse transposed": Control("unshown", put("W", to=transposed)),
    "the inverse instead of T": Control("unshown", exchanged),
    "a row of the inverse dropped": Control("unshown", drop("W", 1)),
    "T of something else": Control("unshown", other_coordinates([[1, 0], [0, 1]]), mirrored),
    "T doubled": Control(
        "unshown",
        all_of(
            put("T", to=lambda T: [[2 * q for q in r] for r in T]),
            put("W", to=lambda W: [[q / 2 for q in r] for r in W]),
        ),
    ),
    "T without an inverse": Control("unshown", put("T", to=[[1, 1], [1, 1]])),
    "no evidence": Control("unshown", all_of(*(put(k, to=[]) for k in ("T", "W", "root", "core")))),
    "evidence of another certificate": Control("unshown", evidence_of(crossed)),
}


CROSSED = {
    "a weight of layer 1": Control("decrease", flip((0, 0, 0)), nudge((0, 0, 0))),
    "another weight of layer 1": Control("decrease", flip((0, 1, 1)), nudge((0, 1, 1))),
    "a weight of layer 2": Control("decrease", flip((1, 0, 0)), nudge((1, 0, 0))),
    "another weight of layer 2": Control("decrease", flip((1, 1, 1)), nudge((1, 1, 1))),
    "a bias of layer 1": Control("decrease", put("layers", 0, 0, 1, to=3.0), nudge((0, 0, None))),
    "a bias of layer 2": Control("decrease", put("layers", 1, 0, 1, to=3.0), nudge((1, 0, None))),
    "weights transposed": Control(
        "shape", put("layers", 0, to=lambda rows: [[w, 0.0] for w in transposed([w for w, _ in rows])]), nothing
    ),
    "outputs in another order": Control("decrease", put("layers", 1, to=lambda rows: rows[::-1])),
    "inputs in another order": Control("rest", put("channels", to=lambda c: c[::-1]), put("squash", to="identity")),
    "states in another order": Control(
        "domain",
        all_of(put("domain", to=lambda d: d[::-1]), put("level", to=0.2)),
    ),
    "a scale's sign": Control("decrease", put("channels", 1, 0, to=2.0), put("channels", 1, 0, to=-2.0000001)),
    "u_eq of the first input": Control("rest", put("channels", 0, 2, to=Fraction(3, 5))),
    "u_eq of the second input": Control("rest", put("channels", 1, 2, to=Fraction(1, 3))),
    "no centring": Control("rest", put("centre", to="none"), put("channels", 0, 1, to=9.0)),
    "centring before the squash": Control("rest", put("centre", to="preactivation")),
    "bounds of the first input": Control(
        "bounds", put("channels", 0, 4, to=Fraction(6, 10)), put("channels", 0, 4, to=3)
    ),
    "bounds of the second input": Control(
        "bounds", put("channels", 1, 3, to=Fraction(-4, 10)), put("channels", 1, 3, to=-3)
    ),
    "a negative level": Control("level", put("level", to=-0.04), put("level", to=0.03)),
    "a level out of the domain": Control("domain", put("level", to=0.5), put("level", to=0.01)),
    "a rate that is too large": Control("decrease", put("rate", to=Fraction(3)), put("rate", to=Fraction(1, 2))),
    "an unstable equation": Control("decrease", plus(1, "5", x1), plus(1, "1/1000000000", x1)),
    "a power that is too high": Control(
        "rest", plus(0, "1", node("pow", u0, index=2)), plus(0, "1/1000000000", node("pow", x0, index=64))
    ),
    "evidence of another certificate": Control("unshown", evidence_of(pendulums)),
}


@pytest.fixture(scope="session")
def theory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the theory, compiled."""
    folder, coqc = tmp_path_factory.mktemp("theory"), find_coqc()
    write_folder(folder, theory_files())
    for name in theory_files():
        subprocess.run([coqc.path, "-q", name], cwd=folder, check=True, capture_output=True)
    return folder


def answers(theory: Path, base: Pieces, asked: list[Pieces]) -> list[bool]:
    """What Coq computes of each; what is asked twice is computed once."""
    checks = [f"Eval vm_compute in (Check.check ({c}) ({r}) ({e})).\n" for c, r, e in (words(p, base) for p in asked)]
    once = list(dict.fromkeys(checks))
    (theory / "Base.v").write_text(base_text(base))
    (theory / "Asked.v").write_text("".join([HEAD, "Require Check Base.\n", *once]))
    coqc = find_coqc()
    for name in ("Base.v", "Asked.v"):
        done = subprocess.run([coqc.path, "-q", name], cwd=theory, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr[-2000:]
    said = re.findall(r" += (true|false)\n +: bool\n", done.stdout)
    assert len(said) == len(once)
    found = dict(zip(once, said, strict=True))
    return [found[check] == "true" for check in checks]


def altered(base: Pieces, change: Change) -> Pieces:
    pieces = copy.deepcopy(base)
    change(pieces)
    return pieces


BOTH = pytest.mark.parametrize(
    ("of", "controls"), [(pendulums, PENDULUM), (crossed, CROSSED)], ids=["pendulum", "crossed"]
)


@BOTH
def test_controls(of: Callable[[], Pieces], controls: dict[str, Control], theory: Path) -> None:
    base = of()
    wrong = [altered(base, control.wrong) for control in controls.values()]
    right = [altered(base, control.right) for control in controls.values()]
    found = answers(theory, base, [*wrong, *right])
    yes = dict(zip(controls, found[: len(wrong)], strict=True))
    no = {name: not answer for name, answer in zip(controls, found[len(wrong) :], strict=True)}
    assert [name for name in controls if yes[name]] == []
    assert [name for name in controls if no[name]] == []


@BOTH
def test_what_is_refused_is_false_or_unshown(of: Callable[[], Pieces], controls: dict[str, Control]) -> None:
    """By the floats of this file, which know nothing of the evidence."""
    base = of()
    assert not conditions_broken(base)
    for name, control in controls.items():
        wrong, right = altered(base, control.wrong), altered(base, control.right)
        broken = conditions_broken(wrong)
        assert not conditions_broken(right), name
        assert control.why in broken if control.why != "unshown" else not broken, (name, broken)
        assert words(wrong, base) not in (words(base, base), words(right, base)), name


def test_there_are_enough() -> None:
    assert len(PENDULUM) >= 80 and len(CROSSED) >= 20
    for controls in (PENDULUM, CROSSED):
        assert {control.why for control in controls.values()} >= {
            "decrease",
            "domain",
            "bounds",
            "rest",
            "level",
            "unshown",
        }


def test_proofs_are_refused_where_the_check_is(theory: Path) -> None:
    """The whole way to the theorem, by what runs Coq; what is not altered is proved."""
    base, coqc = pendulums(), find_coqc()
    for name in ("a weight of layer 1", "a negative level", "a larger core", None):
        certificate, rate, evidence = words(altered(base, PENDULUM[name].wrong if name else nothing), base)
        head = f"{HEAD}Require Base.\n"
        files = {
            "Base.v": base_text(base),
            "Claim.v": f"{head}Definition certificate := {certificate}.\nDefinition rate := {rate}.\n",
            "Evidence.v": f"{head}Definition evidence := {evidence}.\n",
            "Proof.v": PROOF,
            "Assumptions.v": ASSUMPTIONS,
        }
        write_folder(theory, {file: text.encode() for file, text in files.items()})
        compiled = compile_folder(coqc, theory, list(files), 300)
        if name is None:
            assert compiled.axioms and not compiled.reason
        else:
            assert compiled.axioms is None and "refuses Proof.v (status 1)" in compiled.reason, name
