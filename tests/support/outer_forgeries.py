"""Forgeries of certificates with an outer set, by what they are made from: each with the rule that must refuse it, in
both checkers.

What a reader must refuse comes first; then trees, coordinates and roots that do not cover what they should; then claims
that are false, each at a point that a search has found and ball arithmetic confirms. Of these the inner part is left as
it was or is accepted by itself, so that only rules about the outer set can notice.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from fractions import Fraction
from functools import cache
from typing import Any

import numpy as np

from tests.support.balls import enlarged_from
from tests.support.certificates import (
    LEAF,
    Document,
    decode,
    edited,
    encode,
    rehash,
    verdict,
)
from tests.support.outer import (
    at_level,
    expression,
    network,
    packed,
    proved,
    refutation,
    unpacked,
    wells,
    with_faces,
    with_uniform_trees,
)
from tests.support.outer_loops import BASES, PLANAR, SQUARE, WITH_NETWORK, base
from tests.support.step_forgeries import Edit, Forgery, array, at, without

CLAIM, EVIDENCE = "claim.outer", "evidence.outer"
TRUSTED = {"kind": "trusted-solver", "solver": "s", "version": "1", "precision": (0.5).hex(), "queries": []}
WELL = network(wells([[1.0]], 2.0), -1.2)


def replaced(function: Any) -> Edit:
    return at(CLAIM, function)


def formula(tree: Any) -> Edit:
    return replaced(expression(tree, 1.0))


def layers(change: Any) -> Edit:
    """Another list of layers of a network."""
    return lambda d: edited(d, f"{CLAIM}.layers", change)


def nested(depth: int) -> Any:
    tree: Any = "x"
    for _ in range(depth):
        tree = ["-", tree]
    return tree


def as_tube(data: Document) -> Document:
    outer = data["claim"]["outer"]
    return edited(data, "claim", enlarged_from(16 * np.eye(len(data["plant"]["states"]))) | {"outer": outer})


MALFORMED: dict[str, Edit] = {
    "no claim beside the evidence": at(CLAIM, None),
    "no evidence beside the claim": at(EVIDENCE, None),
    "no key in the claim": without(CLAIM),
    "no key in the evidence": without(EVIDENCE),
    "an empty object": at(CLAIM, {}),
    "an empty list": at(CLAIM, []),
    "false": at(CLAIM, False),
    "a word": at(CLAIM, "network"),
    "a list of functions": lambda d: edited(d, CLAIM, lambda old: [old]),
    "kind null": at(f"{CLAIM}.kind", None),
    "kind quadratic": at(f"{CLAIM}.kind", "quadratic"),
    "kind in capitals": lambda d: edited(d, f"{CLAIM}.kind", str.upper),
    "kind with a space": lambda d: edited(d, f"{CLAIM}.kind", lambda kind: kind + " "),
    "the other kind": lambda d: edited(
        d, f"{CLAIM}.kind", lambda kind: "expression" if kind == "network" else "network"
    ),
    "no level": without(f"{CLAIM}.level"),
    "level null": at(f"{CLAIM}.level", None),
    "level 0": at(f"{CLAIM}.level", 0),
    "level true": at(f"{CLAIM}.level", True),
    "level in decimals": at(f"{CLAIM}.level", "3.6"),
    "level as a rational": at(f"{CLAIM}.level", "18/5"),
    "level in a list": lambda d: edited(d, f"{CLAIM}.level", lambda v: [v]),
    "infinite level": at(f"{CLAIM}.level", "inf"),
    "level below everything": at(f"{CLAIM}.level", "-inf"),
    "level that overflows": at(f"{CLAIM}.level", "0x1.0000000000000p+1024"),
    "level that is no number": at(f"{CLAIM}.level", "nan"),
    "level not in canonical form": at(f"{CLAIM}.level", "0x1p+1"),
    "another key in the claim": lambda d: edited(d, CLAIM, lambda old: {**old, "sha256": ""}),
    "another key in the evidence": lambda d: edited(d, EVIDENCE, lambda old: {**old, "order": 1}),
    "evidence in a list": lambda d: edited(d, EVIDENCE, lambda old: [old]),
    "no T": without(f"{EVIDENCE}.T"),
    "no root": without(f"{EVIDENCE}.root"),
    "no tree": without(f"{EVIDENCE}.tree"),
    "no faces": without(f"{EVIDENCE}.faces"),
    "T null": at(f"{EVIDENCE}.T", None),
    "T of one number more": array(f"{EVIDENCE}.T", lambda a: [*a, 1.0]),
    "T of no number": at(f"{EVIDENCE}.T", ""),
    "T that is no number": array(f"{EVIDENCE}.T", lambda a: a * np.nan),
    "infinite T": array(f"{EVIDENCE}.T", lambda a: np.where(a, np.inf, a)),
    "root of one number more": array(f"{EVIDENCE}.root", lambda a: [*a, 9.0]),
    "root of no number": at(f"{EVIDENCE}.root", ""),
    "infinite root": array(f"{EVIDENCE}.root", lambda a: a * np.inf),
    "root that is no number": array(f"{EVIDENCE}.root", lambda a: a * np.nan),
    "tree null": at(f"{EVIDENCE}.tree", None),
    "tree of numbers": at(f"{EVIDENCE}.tree", [LEAF]),
    "tree with stray bits": at(f"{EVIDENCE}.tree", "/x=="),
    "tree with excess padding": lambda d: edited(d, f"{EVIDENCE}.tree", lambda text: text + "===="),
    "tree in hexadecimal": lambda d: edited(d, f"{EVIDENCE}.tree", lambda text: unpacked(text).hex() + "g"),
    "faces null": at(f"{EVIDENCE}.faces", None),
    "no face": at(f"{EVIDENCE}.faces", []),
    "a face less": lambda d: edited(d, f"{EVIDENCE}.faces", lambda f: f[:-1]),
    "a face more": lambda d: edited(d, f"{EVIDENCE}.faces", lambda f: [*f, f[-1]]),
    "faces by name": lambda d: edited(d, f"{EVIDENCE}.faces", lambda f: {str(i): v for i, v in enumerate(f)}),
    "faces in one text": lambda d: edited(d, f"{EVIDENCE}.faces", "".join),
    "a face null": at(f"{EVIDENCE}.faces.0", None),
    "a face of numbers": at(f"{EVIDENCE}.faces.1", [LEAF]),
    "a face in a list": lambda d: edited(d, f"{EVIDENCE}.faces.1", lambda v: [v]),
    "a face with stray bits": at(f"{EVIDENCE}.faces.0", "/x=="),
    "a rate": at("claim.rate", (2.0**-60).hex()),
    "a sample": at("claim.sample", ["1/1000", "1/1000"]),
    "a sample from 0": at("claim.sample", ["0", "1/1000000"]),
    "discrete time": at("plant.time", "discrete"),
    "a tube": as_tube,
    "a solver's word": at("evidence", TRUSTED),
    "a solver's word and a tree": lambda d: edited(
        d, "evidence", lambda old: {**TRUSTED, "outer": old["outer"]}
    ),
    "a solver's word without a key": lambda d: edited(d, "evidence", {**TRUSTED, "outer": None}),
    "version 6": at("schema", "certify-certificate/6"),
    "an expression of an input": formula(["+", SQUARE, "u"]),
    "an input times 0": formula(["+", SQUARE, ["*", "0", "u"]]),
    "an expression of what is unknown": formula(["+", SQUARE, "v"]),
    "an expression of time": formula(["*", SQUARE, "t"]),
    "an expression of a function that nobody knows": formula(["log", ["+", "1", SQUARE]]),
    "an expression of sign": formula(["sign", "x"]),
    "an absolute value of two": formula(["abs", "x", SQUARE]),
    "a minimum of one": formula(["min", SQUARE]),
    "a clip of two": formula(["clip", SQUARE, "1"]),
    "a call of no network": formula(["network", "nobody", 0, "x"]),
    "an expression in decimals": formula(["*", "0.5", SQUARE]),
    "an expression in binary64": formula(["*", "0x1.8000000000000p+1", SQUARE]),
    "an expression with a number": formula(["*", 2, SQUARE]),
    "an expression null": formula(None),
    "an empty expression": formula([]),
    "an operator alone": formula(["+"]),
    "two expressions": formula([SQUARE, SQUARE]),
    "a square root of two": formula(["sqrt", SQUARE, SQUARE]),
    "exponent 0": formula(["**", "x", 0]),
    "exponent 65": formula(["**", "x", 65]),
    "exponent in words": formula(["**", "x", "2"]),
    "exponent true": formula(["**", "x", True]),
    "a quotient of three": formula(["/", "x", "x", "2"]),
    "a rational over 0": formula(["*", "1/0", SQUARE]),
    "nested 201 deep": formula(nested(201)),
    "20,001 nodes": formula(["+", *["x"] * 20_000]),
    "no layers": replaced({**WELL, "layers": []}),
    "layers null": replaced({**WELL, "layers": None}),
    "a layer without a bias": replaced({**WELL, "layers": [
        {k: v for k, v in layer.items() if k != "bias"} for layer in WELL["layers"]]}),
    "a layer with a squash": replaced({**WELL, "layers": [{**layer, "squash": "tanh"} for layer in WELL["layers"]]}),
    "129 layers": replaced({**WELL, "layers": [
        {"shape": [1, 1], "weight": encode([1.0]), "bias": encode([0.0])}] * 129}),
}  # fmt: skip

OF_NETWORKS: dict[str, Edit] = {
    "no output": layers(lambda each: [*each[:-1], {**each[-1], "shape": [0, each[-1]["shape"][1]]}]),
    "one column more": layers(lambda each: [{
        **each[0], "shape": [each[0]["shape"][0], each[0]["shape"][1] + 1]}, *each[1:]]),
    "one input more": layers(lambda each: [{
        "shape": [each[0]["shape"][0], each[0]["shape"][1] + 1], "bias": each[0]["bias"],
        "weight": encode(np.ones(each[0]["shape"][0] * (each[0]["shape"][1] + 1)))}, *each[1:]]),
    "the last layer alone": layers(lambda each: each[-1:]),
    "layers in the other order": layers(lambda each: each[::-1]),
    "a layer twice": layers(lambda each: [each[0], *each]),
    "one bias less": array(f"{CLAIM}.layers.0.bias", lambda a: a[:-1]),
    "one bias more": array(f"{CLAIM}.layers.1.bias", lambda a: [*a, 0.0]),
    "a weight that is no number": array(f"{CLAIM}.layers.0.weight", lambda a: [np.nan, *a[1:]]),
    "an infinite weight": array(f"{CLAIM}.layers.1.weight", lambda a: [np.inf, *a[1:]]),
    "an infinite bias": array(f"{CLAIM}.layers.1.bias", lambda a: [-np.inf, *a[1:]]),
    "a shape of true": at(f"{CLAIM}.layers.1.shape.0", True),
    "a shape in words": at(f"{CLAIM}.layers.0.shape.0", "2"),
    "a shape of three": layers(lambda each: [{**each[0], "shape": [*each[0]["shape"], 1]}, *each[1:]]),
    "a layer as a list": layers(lambda each: [list(each[0].values()), *each[1:]]),
    "weights in hexadecimal": at(f"{CLAIM}.layers.1.weight", (1.0).hex()),
}  # fmt: skip


def malformed() -> Iterator[Forgery]:
    for name in ("square", "well", "oscillator"):
        for what, edit in MALFORMED.items():
            yield "format", f"{name}: {what}", edit(base(name))
    for name in WITH_NETWORK:
        for what, edit in OF_NETWORKS.items():
            if (name, what) == ("deep well", "the last layer alone"):
                continue  # N = x, of one state
            yield "format", f"{name}: {what}", edit(base(name))
    yield "format", "range: an expression of what is uncertain", formula(["+", SQUARE, "q"])(base("range"))
    yield "format", "practical: an expression of the disturbance", formula(["+", SQUARE, "w"])(base("practical"))
    yield "format", "nearby: an expression of the disturbance", formula(["*", SQUARE, "w"])(base("nearby"))
    yield "format", "square: a state of another plant", formula(["+", SQUARE, ["**", "y", 2]])(base("square"))


# ------------------------------------------------------------------------------------------- what is not covered by it


def uncovered() -> Iterator[Forgery]:
    for name in BASES:
        data = base(name)
        n, outer = len(data["plant"]["states"]), data["evidence"]["outer"]
        yield from _faces(name, data, n)
        tree = unpacked(outer["tree"])
        for what, other in {
            "no byte": b"", "cut": tree[:-1], "one leaf more": tree + bytes([LEAF]), "twice": 2 * tree,
            "an axis that is none": bytes([n]) + tree[1:], "byte 254": tree[:-1] + bytes([254]),
            "byte 64": bytes([64]) + tree[1:], "turned round": tree[::-1],
            "one box too many": bytes(4097) + bytes([LEAF]) * 4098,
        }.items():  # fmt: skip
            yield "outer", f"{name}: tree, {what}", edited(data, f"{EVIDENCE}.tree", packed(other))
        yield "outer", f"{name}: T of 0", array(f"{EVIDENCE}.T", lambda a: 0 * a)(data)
        yield "outer", f"{name}: T a thousandth", array(f"{EVIDENCE}.T", lambda a: a / 1000)(data)
        yield "outer", f"{name}: T a hair less", array(f"{EVIDENCE}.T", lambda a: a * (1 - 2.0**-40))(data)
        if n > 1:
            singular = np.ones((n, n))
            yield "outer", f"{name}: T that is singular", at(f"{EVIDENCE}.T", encode(singular))(data)
            singular[-1] = 0
            yield "outer", f"{name}: T with a row of 0", at(f"{EVIDENCE}.T", encode(singular))(data)
        for axis in range(n):
            for what, factor in (("half", 0.5), ("of 0", 0.0), ("below 0", -1.0), ("a hair less", 1 - 2.0**-50)):
                change = np.where(np.arange(n) == axis, factor, 1.0)
                yield "outer", f"{name}: root {axis} {what}", array(f"{EVIDENCE}.root", lambda a, c=change: a * c)(data)
        if n > 1 and name != "three states":
            continue  # the root is a binary64 number above what it has to be
        for axis, side in itertools.product(range(n), (0, 1)):
            pair = [Fraction(q) for q in data["plant"]["domain"][axis]]
            if abs(pair[side]) == max(map(abs, pair)):  # the root box is symmetric
                end = str(pair[side] * (1 + Fraction(1, 10**30)))
                wider = at(f"plant.domain.{axis}.{side}", end)(data)
                yield "outer", f"{name}: domain {axis}, {side} wider by 10^-30", wider


def _faces(name: str, data: Document, n: int) -> Iterator[Forgery]:
    for k, text in enumerate(data["evidence"]["outer"]["faces"]):
        tree, own = unpacked(text), k // 2
        for what, other in {
            "no byte": b"", "cut": tree[:-1], "one leaf more": tree + bytes([LEAF]),
            "split on its own axis": bytes([own]) + 2 * tree, "an axis that is none": bytes([n]) + 2 * tree,
            "byte 254": bytes([254]) + 2 * tree,
        }.items():  # fmt: skip
            if n < 3 or k in (0, 3) or what == "split on its own axis":
                yield "faces", f"{name}: face {k}, {what}", edited(data, f"{EVIDENCE}.faces.{k}", packed(other))
    if name == "walls":
        swapped = edited(data, f"{EVIDENCE}.faces", lambda f: [f[2], f[3], f[0], f[1]])
        yield "faces", f"{name}: faces of the other state", swapped
        yield "faces", f"{name}: faces moved by one", edited(data, f"{EVIDENCE}.faces", lambda f: [*f[1:], f[0]])


# ---------------------------------------------------------------------------------------------------- what is not true


def stripped(data: Document) -> Document:
    return edited(edited(data, CLAIM, None), EVIDENCE, None)


def rule_of(found: str) -> str:
    """Under which a confirmed violation is refused."""
    return "faces" if "boundary" in found else "inputs" if "an input" in found else "outer"


def constants(tree: Any, path: str, below: bool = False) -> Iterator[tuple[str, Any, bool]]:
    """Places of an expression, and what stands there; true in a denominator."""
    yield path, tree, below
    if isinstance(tree, list):
        for i, part in enumerate(tree[1:], 1):
            if type(part) is not int:
                yield from constants(part, f"{path}.{i}", below or (tree[0] == "/" and i == 2))


NUMBERS = {"-1 times": lambda q: -q, "twice": lambda q: 2 * q, "half": lambda q: q / 2, "plus 1": lambda q: q + 1,
           "0 in place of": lambda q: 0 * q}  # fmt: skip
SWAPS = {"+": "-", "*": "+", "/": "*", "sqrt": "cos"}


def of_functions(data: Document) -> Iterator[tuple[str, Edit]]:
    """Another N with the trees of the old one: each weight, bias and number, and operators."""
    outer, states = data["claim"]["outer"], data["plant"]["states"]
    for k, layer in enumerate(outer.get("layers", ())):
        for part in ("weight", "bias"):
            for i, (what, change) in itertools.product(range(len(decode(layer[part]))), NUMBERS.items()):

                def other(a: np.ndarray, i: int = i, change: Any = change) -> np.ndarray:
                    a[i] = change(a[i])
                    return a

                yield f"{what} {part} {k}, {i}", array(f"{CLAIM}.layers.{k}.{part}", other)
    for path, part, below in constants(outer.get("expression", "0"), f"{CLAIM}.expression"):
        if isinstance(part, str) and part not in states:
            for what, change in NUMBERS.items():
                yield f"{what} {path}", at(path, str(change(Fraction(part))))
        elif isinstance(part, str):
            for other_part in (*states, *(() if below else ("0",)), "1", ["-", "1", part], ["*", "1/2", part]):
                yield f"{other_part} at {path}", at(path, other_part)
        elif part[0] == "**":
            for k in (1, 3, -2):
                yield f"exponent {k} at {path}", at(f"{path}.2", k)
        elif len(part) <= 3 and part[0] in SWAPS:
            yield f"another operator at {path}", at(f"{path}.0", SWAPS[part[0]])


def of_levels(data: Document) -> Iterator[tuple[str, Edit]]:
    """A higher level, with the old trees and with some that are made for it."""
    level = float.fromhex(data["claim"]["outer"]["level"])
    for share in (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 3.0, 1e3, 1e300):
        high = level + share * max(1.0, abs(level))
        moved = at(f"{CLAIM}.level", high.hex())
        yield f"level {share} higher", moved
        if 0.05 <= share <= 0.2:
            yield f"level {share} higher, proved", lambda d, m=moved: proved(m(d))
            yield f"level {share} higher, as good as can be", lambda d, high=high: at_level(d, high, 300)
            yield f"level {share} higher, fine", lambda d, m=moved: with_uniform_trees(m(d), 7)


def of_the_loop(data: Document) -> Iterator[tuple[str, Edit]]:
    """Equations, ranges, bounds, domains, policies and levels that differ where the outer set is alone."""
    plant = data["plant"]
    for (i, state), k, power in itertools.product(enumerate(plant["states"]), ("2", "-2", "1/4"), (9, 17, 33)):
        away = ["*", k, state, ["**", ["*", "3/4", state], power - 1]]
        yield (
            f"{k} {state}^{power} more",
            lambda d, i=i, a=away: edited(d, f"plant.dynamics.{i}", ["+", a, plant["dynamics"][i]]),
        )
    pole = ["/", ["**", "x", 5], ["-", ["**", "x", 2], "1"]]
    yield "a pole", lambda d: edited(d, "plant.dynamics.0", lambda tree: ["+", tree, pole])
    for (i, pair), side, share in itertools.product(enumerate(plant["domain"]), (0, 1), ("7/8", "3/4", "5/8")):
        yield (
            f"{share} of domain {i}, {side}",
            at(f"plant.domain.{i}.{side}", str(Fraction(pair[side]) * Fraction(share))),
        )
    for (j, q), side, k in itertools.product(enumerate(plant["uncertain"]), (0, 1), ("3/2", "2", "3", "5", "9")):
        yield (
            f"range {j}, {side}, {k} times",
            at(f"plant.uncertain.{j}.range.{side}", str(Fraction(q["range"][side]) * Fraction(k))),
        )
    for side, share in itertools.product((0, 1), ("99/100", "15/16", "3/4", "1/2")):
        end = str(Fraction(plant["input_bounds"][0][side]) * Fraction(share))
        yield f"{share} of bound {side}", at(f"plant.input_bounds.0.{side}", end)
    if data["policy"]["clip"]:
        for scale, side in itertools.product((0.97, 0.75, 0.5), (0, 1)):
            tight = array(f"policy.clip.{side}", lambda a, scale=scale: a * scale)
            yield f"{scale} of clip {side}", lambda d, tight=tight: rehash(tight(d))
    else:
        for end in (1.0, 0.6, 0.52):
            clip = at("policy.clip", [encode([-end]), encode([end])])
            yield f"a clip at {end}", lambda d, clip=clip: rehash(clip(d))
    for scale in (0.5, 0.75, 0.9):
        gain = array("policy.scale", lambda a, scale=scale: a * scale)
        yield f"{scale} of the gain", lambda d, gain=gain: rehash(gain(d))
    if "floor" not in data["levels"]:
        for level in (0.04, 0.01, 1e-4):
            yield f"c2 of {level}", at("levels", {"local": level.hex(), "roa": level.hex()})


def false(every: int) -> Iterator[Forgery]:
    """Of all these, or of each so many, what is certainly false and of which the inner part is accepted."""
    each = ((name, *edit) for of in (of_levels, of_functions, of_the_loop) for name in BASES for edit in of(base(name)))
    for name, what, edit in itertools.islice(each, 0, None, every):
        data = edit(base(name))
        found = refutation(data)
        if found is not None and verdict(stripped(data)) == "ACCEPTED":
            refaced = name in PLANAR and "boundary" not in found  # what is shown of faces comes before the leaves
            yield rule_of(found), f"{name}: {what}", with_faces(data) if refaced else data


@cache
def forgeries(every: int = 1) -> tuple[Forgery, ...]:
    """With all that is malformed; of the others, each so many."""
    return (*malformed(), *itertools.islice(uncovered(), 0, None, every), *false(every))
