"""Attacks on the checker: honest certificates are accepted, every tampered one is rejected by the rule it breaks.

Three closed loops with small proofs: `scalar` is xdot = x/2 + u, u = -tanh(x), whose origin attracts exactly
|x| < 1.915008..., `enlarged` with a tube from |x| <= 7/10 into |x| <= 1/2; `linear` is a double integrator under a
linear policy; `rotor` is a pendulum under a random tanh network with output centring, u_eq = 1/2 and input bounds that
only the leaves can show.

Where a certificate claims something false, an oracle in ball arithmetic, which shares no arithmetic with the checker,
shows it first. The last section disables one rule at a time and shows that some certificate then gets through.
"""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from flint import arb, ctx, fmpq
from hypothesis import given
from hypothesis import strategies as st

import certify.checker
from certify.checker import network, rules
from certify.checker.boxes import batches
from certify.checker.case import Case
from certify.checker.document import Policy
from certify.checker.errors import Rejected
from certify.checker.exact import policy_at_origin
from certify.checker.near import Above, Near, within
from certify.checker.networks import Affine, Map, Network
from certify.checker.ring import Ring, is_partition
from certify.checker.rules import Tally
from tests.support import outer_loops
from tests.support.ablation import checker_without
from tests.support.balls import enlarge, with_ball
from tests.support.certificates import (
    LEAF,
    Document,
    decode,
    dump,
    edited,
    encode,
    grow,
    least_root,
    make,
    parse,
    rehash,
    tree_of,
    verdict,
    with_tree,
    write,
)
from tests.support.earlier import newer
from tests.support.marks import slow_after
from tests.support.oracle import policy_in_arb, value_of

# ------------------------------------------------------------------------------------------------- honest certificates


def scalar_claim(c1: float = 0.01, c2: float = 3.5, bias: float = 0.25, **changes: Any) -> Document:
    return make([["+", ["/", "x", "2"], "u"]], [([[1.0]], [bias])], [[1.0]], (c1, c2), **changes)


def enlarged_claim() -> Document:
    nodes = [np.eye(1) / c for c in np.geomspace(0.49, 0.2499, 9)]
    return enlarge(scalar_claim(c2=0.25), nodes, [0.25] * 8)


def clipped_claim(c1: float = 0.2, c2: float = 1.9999**2, **changes: Any) -> Document:
    """xdot = x/2 + clip(-2 x, -1, 1): the origin attracts exactly |x| < 2, and the clip acts for |x| > 1/2."""
    settings = {
        "squash": "identity", "centre": "output", "scale": [1.0], "clip": ([-1.0], [1.0]),
    }  # fmt: skip
    return make([["+", ["/", "x", "2"], "u"]], [([[-2.0]], [0.0])], [[1.0]], (c1, c2), **{**settings, **changes})


def moved_claim(origin: float = 0.25, c2: float = 1.9999**2) -> Document:
    """The loop of `clipped_claim`, under a policy that rests there if its layers read 1/4 + x."""
    return make(
        [["+", ["/", "x", "2"], "u"]], [([[-2.0]], [0.5])], [[1.0]], (1.0, c2), squash="identity", centre="none",
        scale=[1.0], clip=([-1.0], [1.0]), claim="practical", origin=[origin],
    )  # fmt: skip


def linear_claim(c1: float = 0.5, c2: float = 3.0, **changes: Any) -> Document:
    P, A = np.array([[1.25, 0.25], [0.25, 0.25]]), np.array([[0.0, 1.0], [-2.0, -3.0]])
    settings = {
        "states": ("x1", "x2"), "domain": [("-2", "2"), ("-4", "4")], "input_bounds": [("-20", "20")],
        "squash": "identity", "centre": "none", "scale": [1.0], "T": coordinates(P, A),
    }  # fmt: skip
    return make(["x2", ["+", "x1", "u"]], [([[-3.0, -3.0]], [0.0])], P, (c1, c2), **{**settings, **changes})


def rotor_claim(c1: float = 1e-4, c2: float = 0.3, centre: str = "output", **changes: Any) -> Document:
    """theta'' = sin theta - theta'/2 + u - 1/2 under a 2-6-5-1 network near u = 1/2 + 2 tanh(-(2.5, 1.5) x / 2)."""
    generator = np.random.default_rng(0)
    W1, b1 = 0.5 * generator.standard_normal((6, 2)), generator.uniform(-0.4, 0.4, 6)
    W2, b2 = 0.4 * generator.standard_normal((5, 6)), generator.uniform(-0.4, 0.4, 5)
    x = generator.uniform(-1, 1, (2000, 2)) * [1.5, 2.0]
    gain = np.array([2.5, 1.5])

    def features(x: np.ndarray) -> np.ndarray:
        return np.tanh(np.tanh(x @ W1.T + b1) @ W2.T + b2)

    at_0 = features(np.zeros((1, 2)))
    target = np.arctanh(np.clip(-(x @ gain) / 2, -0.95, 0.95))
    last = np.linalg.lstsq(features(x) - at_0, target, rcond=1e-2)[0]
    hidden, outer = 1 - np.tanh(b1) ** 2, 1 - at_0[0] ** 2
    slope = 2 * (last * outer) @ W2 @ (hidden[:, None] * W1)
    slope = slope * (15 / 16 if centre == "preactivation" else 1)  # tanh' at atanh(1/4)
    A = np.array([[0.0, 1.0], [1.0 + slope[0], -0.5 + slope[1]]])
    P = lyapunov(A)
    settings = {
        "states": ("theta", "omega"), "u_eq": ["1/2"], "domain": [("-3", "3"), ("-5", "5")],
        "input_bounds": [("-3/2", "5/2")], "centre": centre, "scale": [2.0], "T": coordinates(P, A),
    }  # fmt: skip
    dynamics = ["omega", ["+", ["sin", "theta"], ["*", "-1/2", "omega"], "u", "-1/2"]]
    layers = [(W1, b1), (W2, b2), (last[None], [-float(at_0[0] @ last)])]
    return make(dynamics, layers, P, (c1, c2), **{**settings, **changes})


def sampled_claim() -> Document:
    """x' = x/2 - 2 tanh(x), the input held for 1/16 to 1/10."""
    return scalar_claim(0.01, 0.25, scale=[-2.0], input_bounds=[("-2", "2")], sample=("1/16", "1/10"), order=2)


def nearby_claim(cubic: str = "0", J: float = 0.2 * (1 + 1e-9), weight: float = 2.0**-40) -> Document:
    """x' = cubic x^3 - x + 1/100 has one equilibrium in {x^2 <= 1/25} if there it falls."""
    data = make(
        [["+", ["-", "x"], "1/100", ["*", cubic, ["**", "x", 3]], ["*", "0", "u"]]], [([[0.0]], [0.0])], 1.0,
        (0.04, 0.09), claim="nearby",
    )  # fmt: skip
    return edited(
        data, "evidence.contraction", {"J": encode([J]), "weights": encode([weight]), "weight": encode([1.0])}
    )


def lyapunov(A: np.ndarray) -> np.ndarray:
    """P with A'P + PA = -I."""
    n = len(A)
    operator = np.kron(np.eye(n), A.T) + np.kron(A.T, np.eye(n))
    P = np.linalg.solve(operator, -np.eye(n).ravel()).reshape(n, n)
    return (P + P.T) / 2


def coordinates(P: np.ndarray, A: np.ndarray) -> np.ndarray:
    """T that diagonalises P and A'P + PA together."""
    inverse = np.linalg.inv(np.linalg.cholesky(P))
    return inverse.T @ np.linalg.eigh(inverse @ (A.T @ P + P @ A) @ inverse.T)[1]


@cache
def honest(name: str) -> Document:
    """Shared between tests, which edit copies only."""
    return grow(HONEST[name]())


OUTER = ("outer, an expression", "outer, a network")
HONEST: dict[str, Callable[[], Document]] = {
    "scalar": scalar_claim,
    "scalar, no centring": lambda: scalar_claim(bias=0.0, centre="none"),
    "linear": linear_claim,
    "sampled": sampled_claim,
    "nearby": nearby_claim,
    "outer, an expression": lambda: outer_loops.base("square"),
    "outer, a network": lambda: outer_loops.base("walls"),
    "local only": lambda: linear_claim(3.0, 3.0),
    "rotor": rotor_claim,
    "rotor, preactivation": lambda: rotor_claim(c2=0.2, centre="preactivation"),
    "clipped": clipped_claim,
    "clipped, no centring": lambda: clipped_claim(centre="none"),
    "clipped rotor": lambda: rotor_claim(clip=([-0.75], [1.75])),
    "enlarged": enlarged_claim,
    "practical, moved": moved_claim,
    "practical, clipped": lambda: clipped_claim(c1=1.0, claim="practical", u_eq=["3/4"]),
}


@pytest.mark.parametrize("name", HONEST)
def test_honest_certificates_are_accepted(name: str) -> None:
    data = honest(name)
    tally = rules.check(parse(data))
    assert tally.rules["tree"] == tree_of(data).count(LEAF)
    assert tally.rules["tube"] == len(data["evidence"]["tube"])
    assert (
        (tally.margins["local"] is None)
        if name.startswith(("practical", "nearby"))
        else 0 < tally.margins["local"] <= 1
    )
    if name == "scalar":  # bounded by form: no leaf is asked for its inputs
        assert tally.rules["inputs"] == 1
    if name in ("local only", *OUTER):
        assert tally.rules["ring"] == 0 and tally.margins["ring"] is None
    else:
        assert tally.rules["ring"] > 0 and tally.margins["ring"] is not None and tally.margins["ring"] > 0


def reordered(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: reordered(v) for k, v in reversed(value.items())}
    return [reordered(v) for v in value] if isinstance(value, list) else value


HARMLESS: dict[str, Callable[[Document], bytes]] = {
    "provenance": lambda d: dump(edited(d, "provenance", {"author": "\u00e9", "list": [True, None, 7]})),
    "no provenance": lambda d: dump(edited(d, "provenance", {})),
    "name": lambda d: dump(edited(d, "plant.name", "another_name")),
    "order of keys": lambda d: json.dumps(reordered(newer(d))).encode(),
    "white space": lambda d: b"\n\t " + json.dumps(newer(d), indent=3).encode() + b" \r\n",
    "escapes": lambda d: dump(d).replace(b'"plant"', b'"\\u0070lant"', 1),
    "raw UTF-8": lambda d: json.dumps(
        newer(edited(d, "provenance", {"who": "\u017d\u016f"})), ensure_ascii=False
    ).encode(),
}


@pytest.mark.parametrize("edit", sorted(HARMLESS))
def test_harmless_edits_stay_accepted(edit: str, tmp_path: Path) -> None:
    from certify.checker import document

    raw = HARMLESS[edit](honest("linear"))
    assert raw != dump(honest("linear"))
    rules.check(document.read(str(write(raw, tmp_path))))


def test_renamed_states_stay_accepted() -> None:
    data = edited(honest("scalar"), "plant.states", ["position"])
    assert verdict(edited(data, "plant.dynamics", [["+", ["/", "position", "2"], "u"]])) == "ACCEPTED"


def test_a_last_bias_that_centring_removes_stays_accepted() -> None:
    assert verdict(rehash(edited(honest("scalar"), "policy.layers.0.bias", encode([-0.6])))) == "ACCEPTED"


def test_scaling_P_and_the_levels_together_changes_nothing() -> None:
    data = honest("rotor")
    for exponent in (-300, -40, 40, 300):
        scaled = edited(data, "lyapunov.P", encode(decode(data["lyapunov"]["P"]) * 2.0**exponent))
        for level in ("local", "roa"):
            scaled = edited(scaled, f"levels.{level}", lambda v, e=exponent: (float.fromhex(v) * 2.0**e).hex())
        rows = array(
            "evidence.local.multipliers", lambda a, e=exponent: (a.reshape(3, -1).T * 2.0 ** np.array([-e, -e, e])).T
        )
        assert verdict(scaled) == "local", exponent  # the multipliers weigh P against the models, which stay
        scaled = rows(scaled)
        assert verdict(scaled) == "ACCEPTED", exponent


# ----------------------------------------------------------------------------------------------------------- tampering

Edit = Callable[[Document], Document]


def at(path: str, value: Any) -> Edit:
    return lambda data: edited(data, path, value)


def array(path: str, change: Callable[[np.ndarray], np.ndarray]) -> Edit:
    return lambda data: edited(data, path, lambda text: encode(change(decode(text))))


def rehashed(path: str, value: Any) -> Edit:
    """An edit of the policy by someone who knows how to hash it."""
    return lambda data: rehash(edited(data, f"policy.{path}", value))


def policy_array(path: str, change: Callable[[np.ndarray], np.ndarray]) -> Edit:
    return lambda data: rehash(array(f"policy.{path}", change)(data))


def tree(change: Callable[[bytes], bytes]) -> Edit:
    return lambda data: with_tree(data, change(tree_of(data)))


def level(name: str, value: float) -> Edit:
    return at(f"levels.{name}", float(value).hex())


def both(*edits: Edit) -> Edit:
    def apply(data: Document) -> Document:
        for edit in edits:
            data = edit(data)
        return data

    return apply


def nudged(index: int) -> Callable[[np.ndarray], np.ndarray]:
    """One unit in the last place towards 0."""

    def change(a: np.ndarray) -> np.ndarray:
        a[index] = np.nextafter(a[index], 0.0)
        return a

    return change


def collapsed(name: str) -> bytes:
    """The tree with the last split above two leaves removed, at the latest place where that matters."""
    bytes_ = tree_of(honest(name))
    for k in range(len(bytes_) - 2):
        if bytes_[k] != LEAF and bytes_[k + 1] == bytes_[k + 2] == LEAF:
            shorter = bytes_[:k] + bytes_[k + 1 : k + 2] + bytes_[k + 3 :]
            if verdict(with_tree(honest(name), shorter)) == "ring":
                return shorter
    raise AssertionError("no split of this tree is needed")


def multipliers(where: str, place: tuple[int, int], value: float) -> Edit:
    """One of the (3, n) multipliers of a ball."""

    def change(a: np.ndarray) -> np.ndarray:
        rows = a.reshape(3, -1)
        rows[place] = value
        return rows

    return array(f"evidence.{where}.multipliers", change)


MUTANTS: list[tuple[str, str, str, Edit]] = [  # rule, base, what, edit
    ("format", "scalar", "schema", at("schema", "certify-certificate/2")),
    ("format", "clipped", "origin where pi(0) is u_eq by form", at("policy.origin", encode([0.25]))),
    ("format", "clipped, no centring", "origin where 0 is an equilibrium", at("policy.origin", encode([2.0**-1074]))),
    ("format", "practical, clipped", "origin of a policy that is centred", at("policy.origin", encode([0.25]))),
    ("format", "practical, moved", "origin of two numbers", at("policy.origin", encode([0.25, 0.0]))),
    ("format", "practical, moved", "no origin", at("policy.origin", None)),
    ("format", "practical, moved", "origin with NaN", at("policy.origin", encode([np.nan]))),
    ("ring", "practical, moved", "origin too low", at("policy.origin", encode([-0.75]))),
    ("ring", "practical, moved", "origin too high", at("policy.origin", encode([1.25]))),
    ("ring", "practical, moved", "origin out of reach", at("policy.origin", encode([2.0**1000]))),
    ("format", "clipped", "clip of equal ends", rehashed("clip", [encode([1.0]), encode([1.0])])),
    ("format", "clipped", "clip with its ends exchanged", rehashed("clip", [encode([1.0]), encode([-1.0])])),
    ("format", "clipped", "clip with NaN", rehashed("clip", [encode([-1.0]), encode([np.nan])])),
    ("format", "clipped", "clip of infinity", rehashed("clip", [encode([-1.0]), encode([np.inf])])),
    ("format", "clipped", "clip of two inputs", rehashed("clip", [encode([-1.0, -1.0]), encode([1.0, 1.0])])),
    ("format", "clipped", "clip without its upper end", rehashed("clip", [encode([-1.0])])),
    ("format", "clipped", "clip of three", rehashed("clip", [encode([-1.0]), encode([1.0]), encode([2.0])])),
    ("format", "clipped", "clip of numbers", at("policy.clip", [-1, 1])),
    ("format", "clipped", "clip of false", at("policy.clip", False)),
    ("format", "clipped", "clip of nothing", at("policy.clip", [])),
    ("format", "scalar", "claim", at("claim.kind", "stable")),
    ("format", "scalar", "Lyapunov function", at("lyapunov.kind", "neural")),
    ("format", "scalar", "state not in the equations", at("plant.states", ["y"])),
    ("format", "scalar", "input not in the equations", at("plant.inputs", ["v"])),
    ("format", "scalar", "shape", rehashed("layers.0.shape", [1, 2])),
    ("format", "scalar", "state named as an input", at("plant.states", ["u"])),
    ("format", "scalar", "name", at("plant.name", "two words")),
    ("format", "scalar", "one equation too many", at("plant.dynamics", lambda d: d * 2)),
    ("format", "scalar", "one equilibrium input too many", at("plant.u_eq", ["0", "0"])),
    ("format", "scalar", "empty domain", at("plant.domain", [["3", "3"]])),
    ("format", "scalar", "empty input bounds", at("plant.input_bounds", [["1", "-1"]])),
    ("format", "scalar", "no layers", rehashed("layers", [])),
    ("format", "scalar", "squash", at("policy.squash", "relu")),
    ("format", "scalar", "identity with preactivation", rehashed("squash", "identity")),
    ("format", "scalar", "centre", rehashed("centre", "input")),
    ("format", "scalar", "scale of zero", policy_array("scale", lambda a: 0 * a)),
    ("format", "scalar", "scale of minus zero", policy_array("scale", lambda a: -0.0 * np.abs(a))),
    ("format", "scalar", "infinite weight", policy_array("layers.0.weight", lambda a: a * np.inf)),
    ("format", "scalar", "NaN offset", policy_array("offset", lambda a: a * np.nan)),
    ("format", "linear", "P too short", array("lyapunov.P", lambda a: a[:3])),
    ("format", "linear", "P not finite", array("lyapunov.P", lambda a: a * np.inf)),
    ("format", "scalar", "level not canonical", at("levels.local", "0x1p-7")),
    ("format", "scalar", "level infinite", at("levels.roa", "inf")),
    ("format", "scalar", "kind of evidence", at("evidence.kind", "trust-me")),
    ("format", "scalar", "T not finite", array("evidence.T", lambda a: a * np.nan)),
    ("format", "scalar", "root not finite", array("evidence.root", lambda a: a * np.inf)),
    ("format", "scalar", "tree not base64", at("evidence.tree", "AP8")),
    ("format", "scalar", "no ball", at("evidence.local", None)),
    ("format", "practical, clipped", "a ball of another order", lambda d: edited(
        d, "evidence.local", honest("scalar")["evidence"]["local"] | {"order": 2})),
    ("format", "scalar", "an edge", at("evidence.local.edge", (1.0).hex())),
    ("format", "scalar", "orders on leaves of what is not sampled", at("evidence.order", 2)),
    ("format", "scalar", "a rate below 0", at("claim.rate", (-1.0).hex())),
    ("format", "scalar", "a sample of nothing", at("claim.sample", ["0", "0"])),
    ("format", "scalar", "time by another name", at("plant.time", "sampled")),
    ("format", "nearby", "no contraction", at("evidence.contraction", None)),
    ("format", "scalar", "a contraction", at("evidence.contraction", {
        "J": encode([1.0]), "weights": encode([1.0]), "weight": encode([1.0])})),
    ("format", "scalar", "a contraction in words", at("evidence.contraction", "null")),
    ("contraction", "nearby", "a ball in the set", array("evidence.contraction.J", lambda a: a * 0.999)),
    ("contraction", "nearby", "a weight of 0", array("evidence.contraction.weights", lambda a: 0 * a)),
    ("contraction", "nearby", "a weight below 0", array("evidence.contraction.weights", lambda a: -a)),
    ("contraction", "nearby", "a weight that takes all", array("evidence.contraction.weights", lambda a: a + 1)),
    ("contraction", "nearby", "a ball where it rises", lambda d: grow(edited(d, "plant.dynamics.0.3.1", "9"))),
    ("format", "outer, an expression", "evidence without a claim", at("claim.outer", None)),
    ("format", "scalar", "a function in words", at("claim.outer", "null")),
    ("format", "scalar", "a partition in words", at("evidence.outer", "null")),
    ("format", "scalar", "a claim without evidence", lambda d: edited(
        d, "claim.outer", outer_loops.base("square")["claim"]["outer"])),
    ("format", "scalar", "evidence of what is not claimed", lambda d: edited(
        d, "evidence.outer", outer_loops.base("square")["evidence"]["outer"])),
    ("format", "outer, an expression", "kind of a function", at("claim.outer.kind", "network")),
    ("format", "outer, a network", "shape of a layer", at("claim.outer.layers.1.shape", [2, 6])),
    ("faces", "outer, an expression", "level", at("claim.outer.level", (9.5).hex())),
    ("faces", "outer, an expression", "another function", at("claim.outer.expression", ["sin", "x"])),
    ("faces", "outer, a network", "weights", array("claim.outer.layers.0.weight", lambda a: a / 8)),
    ("faces", "outer, a network", "bias", array("claim.outer.layers.1.bias", lambda a: a - 1)),
    ("faces", "outer, a network", "a face without a leaf", at("evidence.outer.faces.0", "")),
    ("outer", "outer, an expression", "level of what is at rest", at("claim.outer.level", (3.7).hex())),
    ("outer", "outer, a network", "T", array("evidence.outer.T", lambda a: a / 2)),
    ("outer", "outer, a network", "root", array("evidence.outer.root", lambda a: a * 0.999)),
    ("outer", "outer, a network", "a leaf for the tree", at(
        "evidence.outer.tree", base64.b64encode(bytes([LEAF])).decode())),
    ("flow", "sampled", "held for so long that nothing is known", at("claim.sample", ["1/16", "9"])),
    ("format", "scalar", "the schema of version 5", at("schema", "certify-certificate/5")),
    ("format", "scalar", "J of another size", array("evidence.local.J", lambda a: np.ones(4))),
    ("format", "scalar", "J not finite", array("evidence.local.J", lambda a: a * np.nan)),
    ("format", "scalar", "two rows of multipliers", array("evidence.local.multipliers", lambda a: a[:2])),
    ("format", "scalar", "multipliers not finite", array("evidence.local.multipliers", lambda a: a + np.inf)),
    ("format", "scalar", "a tube", lambda d: edited(d, "evidence.tube", honest("enlarged")["evidence"]["tube"])),
    ("format", "scalar", "enlarged without a start", at("claim.kind", "enlarged")),
    ("format", "enlarged", "asymptotic with a start", at("claim.kind", "asymptotic")),
    ("format", "enlarged", "no slabs", at("evidence.tube", [])),
    ("format", "enlarged", "start of another size", array("claim.start", lambda a: np.ones(4))),
    ("format", "enlarged", "start not finite", array("claim.start", lambda a: a * np.inf)),
    ("format", "enlarged", "middle of another size", array("evidence.tube.1.middle", lambda a: np.ones(4))),
    ("format", "enlarged", "end not finite", array("evidence.tube.1.end", lambda a: a * np.nan)),
    ("format", "enlarged", "duration not finite", at("evidence.tube.1.duration", "inf")),
    ("format", "enlarged", "a path in words", at("evidence.tube.1.path", "null")),
    ("format", "enlarged", "a path", at("evidence.tube.1.path", {
        "centre": encode([0.0]), **dict.fromkeys(("share", "edge", "motion", "joint"), (0.5).hex())})),
    ("format", "scalar", "the schema before", at("schema", "certify-certificate/4")),
    ("format", "scalar", "something uncertain without cells", at(
        "plant.uncertain", [{"name": "q", "range": ["0", "1"]}])),
    ("format", "scalar", "cells of nothing", at("evidence.cells", [1])),
    ("hash", "scalar", "sha256", at("policy.sha256", "0" * 64)),
    ("hash", "scalar", "sha256 in capitals", at("policy.sha256", str.upper)),
    ("hash", "scalar", "sha256 of another type", at("policy.sha256", None)),
    ("hash", "rotor", "first weight", array("policy.layers.0.weight", nudged(3))),
    ("hash", "rotor", "last weight", array("policy.layers.2.weight", nudged(0))),
    ("hash", "rotor", "bias", array("policy.layers.1.bias", nudged(1))),
    ("hash", "rotor", "scale", array("policy.scale", nudged(0))),
    ("hash", "rotor", "offset", array("policy.offset", lambda a: a + 1)),
    ("hash", "rotor", "sign of a zero", array("policy.offset", lambda a: -a)),
    ("hash", "clipped", "clip left out", at("policy.clip", None)),
    ("hash", "scalar", "clip added", at("policy.clip", [encode([-1.0]), encode([1.0])])),
    ("hash", "clipped", "clip widened by one bit", array("policy.clip.1", lambda a: np.nextafter(a, 2))),
    ("hash", "clipped", "ends exchanged with the signs", at("policy.clip", [encode([-1.0]), encode([1.5])])),
    ("hash", "rotor", "squash", at("policy.squash", "identity")),
    ("hash", "rotor", "centre", at("policy.centre", "preactivation")),
    ("levels", "scalar", "local of zero", level("local", 0.0)),
    ("levels", "scalar", "local of minus zero", level("local", -0.0)),
    ("levels", "scalar", "negative local", level("local", -0.01)),
    ("levels", "scalar", "both negative", both(level("local", -3.5), level("roa", -0.01))),
    ("levels", "scalar", "local above roa", level("local", 3.6)),
    ("lyapunov", "scalar", "negative P", array("lyapunov.P", lambda a: -a)),
    ("lyapunov", "scalar", "P of zero", array("lyapunov.P", lambda a: 0 * a)),
    ("lyapunov", "linear", "P not symmetric by one bit", array("lyapunov.P", nudged(1))),
    ("lyapunov", "linear", "P indefinite", array("lyapunov.P", lambda a: a * [1, 1, 1, -1])),
    ("lyapunov", "linear", "P singular", array("lyapunov.P", lambda a: np.ones(4))),
    ("equilibrium", "scalar", "u_eq", at("plant.u_eq", ["1/1000000"])),
    ("equilibrium", "rotor", "constant in the equations", at("plant.dynamics.1.4", "-500000001/1000000000")),
    ("equilibrium", "scalar", "0/0", at("plant.dynamics.0", ["/", ["*", "x", "x"], "x"])),
    ("equilibrium", "scalar", "sine of 22/7", at("plant.dynamics.0", ["+", "u", ["sin", ["+", "x", "22/7"]]])),
    ("equilibrium", "scalar", "numbers without end", at(
        "plant.dynamics.0", ["*", "x", ["**", ["**", ["**", ["**", ["+", "u", "3/2"], 64], 64], 64], 64]])),
    ("centring", "scalar, no centring", "bias", policy_array("layers.0.bias", lambda a: a + 2.0**-1074)),
    ("centring", "scalar", "centring left out", rehashed("centre", "none")),
    ("centring", "scalar, no centring", "offset", policy_array("offset", lambda a: a + 1e-9)),
    ("centring", "rotor", "no centring", rehashed("centre", "none")),
    ("centring", "rotor, preactivation", "u_eq at the end of the range", policy_array("scale", lambda a: 0 * a + 0.5)),
    ("centring", "rotor, preactivation", "u_eq out of the range", policy_array("scale", lambda a: 0 * a - 0.25)),
    ("centring", "scalar", "offset out of reach", policy_array("offset", lambda a: a + 2)),
    ("centring", "clipped", "clip above u_eq", rehashed("clip", [encode([2.0**-60]), encode([1.0])])),
    ("centring", "clipped", "clip below u_eq", rehashed("clip", [encode([-1.0]), encode([-(2.0**-1074)])])),
    ("centring", "clipped", "clip from u_eq", rehashed("clip", [encode([0.0]), encode([1.0])])),
    ("centring", "clipped", "clip up to u_eq", rehashed("clip", [encode([-1.0]), encode([0.0])])),
    ("centring", "clipped, no centring", "clip above u_eq", rehashed("clip", [encode([0.25]), encode([1.0])])),
    ("centring", "practical, clipped", "clip below u_eq", rehashed("clip", [encode([-1.0]), encode([0.5])])),
    ("local", "clipped, no centring", "clip from u_eq", rehashed("clip", [encode([0.0]), encode([1.0])])),
    ("local", "clipped", "clip that acts on the ball", level("local", 0.26)),
    ("local", "clipped", "clip that touches the ball", level("local", 0.25)),
    ("local", "clipped rotor", "clip that acts on the ball", rehashed("clip", [encode([-0.75]), encode([0.5 + 1e-9])])),
    ("ring", "clipped", "clip too narrow for the set", rehashed("clip", [encode([-0.999]), encode([1.0])])),
    ("ring", "practical, clipped", "clip too narrow", rehashed("clip", [encode([-0.999]), encode([1.0])])),
    ("inputs", "clipped rotor", "clip beyond the bounds", both(
        rehashed("clip", [encode([-9.0]), encode([9.0])]), at("plant.input_bounds", [["1/4", "3/4"]]))),
    ("domain", "scalar", "left", at("plant.domain", [["-187/100", "3"]])),
    ("domain", "scalar", "right", at("plant.domain", [["-3", "187/100"]])),
    ("domain", "scalar", "without the origin", at("plant.domain", [["1/10", "30"]])),
    ("domain", "scalar", "to the right of the origin", at("plant.domain", [["5", "30"]])),
    ("domain", "scalar", "to the left of the origin", at("plant.domain", [["-30", "-5"]])),
    ("domain", "scalar", "origin at its edge", at("plant.domain", [["0", "30"]])),
    ("domain", "linear", "second axis", at("plant.domain.1", ["-4", "38/10"])),
    ("coordinates", "linear", "T singular", array("evidence.T", lambda a: a * [1, 1, 0, 0])),
    ("coordinates", "linear", "T of zero", array("evidence.T", lambda a: 0 * a)),
    ("coordinates", "linear", "S not dominant", array("evidence.T", lambda a: np.array([1.0, 9.0, 0.0, 1.0]))),
    ("root", "scalar", "one bit too small", array("evidence.root", nudged(0))),
    ("root", "linear", "one bit too small, axis 1", array("evidence.root", nudged(1))),
    ("root", "scalar", "zero", array("evidence.root", lambda a: 0 * a)),
    ("root", "scalar", "negative", array("evidence.root", lambda a: -a)),
    ("root", "scalar", "roa raised", level("roa", 3.6)),
    ("root", "linear", "T shrunk", array("evidence.T", lambda a: a * 0.9)),
    ("local", "scalar", "local too large", level("local", 3.0)),
    ("local", "scalar", "sign of the scale", policy_array("scale", lambda a: -a)),
    ("local", "scalar", "sign of the weight", policy_array("layers.0.weight", lambda a: -a)),
    ("local", "scalar", "weight too small", policy_array("layers.0.weight", lambda a: 0.499 * a)),
    ("local", "scalar", "sign of the input", at("plant.dynamics.0.2", ["-", "u"])),
    ("local", "linear", "V that does not decrease", both(
        array("lyapunov.P", lambda a: np.eye(2)), array("evidence.T", lambda a: np.eye(2)),
        array("evidence.root", lambda a: 0 * a + 2))),
    ("local", "linear", "equations exchanged", at("plant.dynamics", lambda d: d[::-1])),
    ("local", "scalar", "pole on the local ball", at("plant.dynamics.0", lambda d: ["+", d, [
        "*", "x", "x", ["/", "1/1000000", ["-", "x", "1/20"]]]])),
    ("local", "scalar", "hidden pole", at("plant.dynamics.0", lambda d: ["+", d, [
        "*", "0", ["-", ["tan", ["*", "40", "x"]], ["*", "40", "x"]]]])),
    ("local", "rotor", "gain removed", policy_array("layers.2.weight", lambda a: 0 * a)),
    ("local", "scalar", "ball of zero", array("evidence.local.J", lambda a: 0 * a)),
    ("local", "scalar", "ball too small", array("evidence.local.J", lambda a: 0.999 * a)),
    ("local", "scalar", "ball that touches its set", both(
        level("local", 2.0**-6), array("evidence.local.J", lambda a: 0 * a + 2.0**-3))),
    ("local", "scalar", "ball too large", array("evidence.local.J", lambda a: 40 * a)),
    ("local", "linear", "ball of rank one", array("evidence.local.J", lambda a: np.full(4, 9.0))),
    ("local", "rotor", "negative alpha", multipliers("local", (0, 1), -(2.0**-1074))),
    ("local", "rotor", "negative beta", multipliers("local", (1, 0), -1.0)),
    ("local", "rotor", "negative g", multipliers("local", (2, 1), -1.0)),
    ("local", "rotor", "g of 0 where it is used", both(
        multipliers("local", (1, 1), 0.0), multipliers("local", (2, 0), 0.0))),
    ("local", "rotor", "g of 0 where it may be used", both(
        multipliers("local", (1, 0), 0.0), multipliers("local", (2, 0), 0.0))),
    ("local", "rotor", "multipliers too large", array("evidence.local.multipliers", lambda a: 1e9 * a)),
    ("local", "rotor", "multipliers too small", array("evidence.local.multipliers", lambda a: 1e-9 * a)),
    ("tube", "enlarged", "larger start", array("claim.start", lambda a: 0.9 * a)),
    ("tube", "enlarged", "start of zero", array("claim.start", lambda a: 0 * a)),
    ("tube", "enlarged", "negative start", array("claim.start", lambda a: -a)),
    ("tube", "enlarged", "negative middle", array("evidence.tube.3.middle", lambda a: -a)),
    ("tube", "enlarged", "middle out of its ball", array("evidence.tube.3.middle", lambda a: 0.9 * a)),
    ("tube", "enlarged", "middle too early", array("evidence.tube.3.middle", lambda a: 1.5 * a)),
    ("tube", "enlarged", "end too early", array("evidence.tube.3.end", lambda a: 1.5 * a)),
    ("tube", "enlarged", "end out of its ball", array("evidence.tube.3.end", lambda a: 0.5 * a)),
    ("tube", "enlarged", "end of zero", array("evidence.tube.3.end", lambda a: 0 * a)),
    ("tube", "enlarged", "last end on the edge of the set", array("evidence.tube.7.end", lambda a: 0 * a + 4.0)),
    ("tube", "enlarged", "no last slab", at("evidence.tube", lambda t: t[:-1])),
    ("tube", "enlarged", "no first slab", at("evidence.tube", lambda t: t[1:])),
    ("tube", "enlarged", "slabs exchanged", at("evidence.tube", lambda t: [t[1], t[0], *t[2:]])),
    ("tube", "enlarged", "duration of zero", at("evidence.tube.2.duration", (0.0).hex())),
    ("tube", "enlarged", "duration of minus zero", at("evidence.tube.2.duration", (-0.0).hex())),
    ("tube", "enlarged", "negative duration", at("evidence.tube.2.duration", (-0.25).hex())),
    ("tube", "enlarged", "duration too short", at("evidence.tube.2.duration", (0.03).hex())),
    ("tube", "enlarged", "ball too small", array("evidence.tube.2.J", lambda a: 0.99 * a)),
    ("tube", "enlarged", "ball too large", array("evidence.tube.2.J", lambda a: 9 * a)),
    ("tube", "enlarged", "negative alpha", multipliers("tube.2", (0, 0), -1.0)),
    ("tube", "enlarged", "negative beta", multipliers("tube.2", (1, 0), -1.0)),
    ("tube", "enlarged", "negative g", multipliers("tube.2", (2, 0), -1.0)),
    ("tube", "enlarged", "g of 0 where it is used", both(
        multipliers("tube.2", (1, 0), 0.0), multipliers("tube.2", (2, 0), 0.0))),
    ("tube", "enlarged", "multipliers too large", array("evidence.tube.2.multipliers", lambda a: 1e18 * a)),
    ("tube", "enlarged", "domain reached by the start alone", at("plant.domain", [["-69/100", "3"]])),
    ("tube", "enlarged", "plant too strong for the tube alone", at("plant.dynamics.0", lambda d: ["+", d, [
        "*", "2000", ["**", "x", 21]]])),
    ("tube", "enlarged", "pole on a slab alone", at("plant.dynamics.0", lambda d: ["+", d, [
        "*", "0", ["/", "1", ["-", "x", "7/10"]]]])),
    ("inputs", "enlarged", "tight on a slab alone", at("plant.input_bounds", [["-11/20", "1"]])),
    ("tree", "scalar", "empty", tree(lambda t: b"")),
    ("tree", "scalar", "cut", tree(lambda t: t[:-1])),
    ("tree", "scalar", "no leaves", tree(lambda t: bytes([0]))),
    ("tree", "scalar", "a leaf too many", tree(lambda t: t + bytes([LEAF]))),
    ("tree", "scalar", "a split too many", tree(lambda t: t + bytes([0]))),
    ("tree", "scalar", "no such axis", tree(lambda t: bytes([1]) + t[1:])),
    ("tree", "linear", "no such axis, below", tree(lambda t: t.replace(bytes([1]), bytes([254]), 1))),
    ("tree", "scalar", "too deep", tree(lambda t: bytes([0]) * 5000 + bytes([LEAF]) * 5001)),
    ("ring", "scalar", "one leaf", tree(lambda t: bytes([LEAF]))),
    ("ring", "linear", "one leaf", tree(lambda t: bytes([LEAF]))),
    ("ring", "linear", "another axis", tree(lambda t: t.replace(bytes([1]), bytes([0])))),
    ("ring", "linear", "a leaf in place of a split", lambda d: with_tree(d, collapsed("linear"))),
    ("ring", "rotor", "a leaf in place of a split", lambda d: with_tree(d, collapsed("rotor"))),
    ("ring", "scalar", "stronger plant", at("plant.dynamics.0.1", ["*", "x", "52/100"])),
    ("ring", "scalar", "bounded policy too weak", policy_array("scale", lambda a: 0.9 * a)),
    ("ring", "scalar", "pole in the ring", both(at("plant.dynamics.0", lambda d: ["+", d, [
        "*", "x", "x", ["/", "1/1000000", ["-", "x", "3/2"]]]]), with_ball)),
    ("ring", "scalar", "local lowered to nothing", level("local", 2.0**-500)),
    ("ring", "rotor", "sign of omega's equation at a distance", at("plant.dynamics.1", lambda d: [
        *d, ["*", "9", "theta", "theta", "theta"]])),
    ("inputs", "scalar", "tight on the ring", at("plant.input_bounds", [["-9/10", "1"]])),
    ("inputs", "scalar", "tight at the origin", at("plant.input_bounds", [["-1/100", "1"]])),
    ("inputs", "scalar", "without u_eq", at("plant.input_bounds", [["1/100", "2"]])),
    ("inputs", "linear", "tight on the ring", at("plant.input_bounds", [["-20", "4"]])),
    ("inputs", "rotor", "tight on the ring", at("plant.input_bounds", [["-1/2", "5/2"]])),
    ("inputs", "rotor", "u_eq at the bound", at("plant.input_bounds", [["1/2", "5/2"]])),
    ("inputs", "scalar", "offset", both(policy_array("offset", lambda a: a + 0.5), with_ball)),
    ("inputs", "scalar", "scale", policy_array("scale", lambda a: 1.1 * a)),
]  # fmt: skip


@pytest.mark.parametrize(
    ("rule", "base", "edit"), [pytest.param(r, b, e, id=f"{r}-{b}-{what}") for r, b, what, e in MUTANTS]
)
def test_tampered_certificates_are_rejected_by_the_rule_they_break(rule: str, base: str, edit: Edit) -> None:
    assert verdict(edit(honest(base))) == rule


def test_every_field_and_every_rule_has_a_mutant() -> None:
    format_page = (Path(certify.checker.__file__).parent / "FORMAT.md").read_text()
    table = format_page.split("| rule | holds if |")[1].split("\n\n")[0]
    documented = {name for row in table.splitlines()[2:] for name in re.findall(r"`(\w+)`", row.split("|")[1])}
    # test_rank_forgeries.py, test_reference_data.py, test_handover.py
    elsewhere = {"angles", "ranks", "keep", "data", "samples", "handover"}
    assert len(documented) == 24 and {rule for rule, *_ in MUTANTS} == documented - elsewhere
    touched = set()
    for _, base, _, edit in MUTANTS:
        before, after = dict(leaves_of(honest(base))), dict(leaves_of(edit(honest(base))))
        touched |= {general(path) for path in before.keys() | after.keys() if before.get(path) != after.get(path)}
    fields = {general(path) for base in ("rotor", "enlarged", *OUTER) for path, _ in leaves_of(honest(base))}
    fields |= {"evidence.contraction.J", "evidence.contraction.weights"}
    assert fields - touched == {"provenance.tool"}


def leaves_of(value: Any, path: str = "") -> list[tuple[str, Any]]:
    if isinstance(value, dict):
        return [leaf for k, v in value.items() for leaf in leaves_of(v, f"{path}.{k}".lstrip("."))]
    if isinstance(value, list):
        return [leaf for k, v in enumerate(value) for leaf in leaves_of(v, f"{path}.{k}")]
    return [(path, value)]


def general(path: str) -> str:
    """The path without list indices."""
    return ".".join(p for p in path.split(".") if not p.isdigit())


# -------------------------------------------------------------------------------------------------------- false claims


def v_and_vdot(data: Document, x: list[float]) -> tuple[arb, arb, list[arb]]:
    """V, Vdot and the input at x; at the current precision."""
    c, plant = parse(data), data["plant"]
    state = [arb(v) for v in x]
    u = policy_in_arb(c.policy, c.u_eq, state)
    names = dict(zip(plant["states"] + plant["inputs"], state + u, strict=True))
    f = [value_of(node, names) for node in plant["dynamics"]]
    Px = [sum((arb(p) * v for p, v in zip(row, state, strict=True)), arb(0)) for row in c.P.tolist()]
    V = sum((p * v for p, v in zip(Px, state, strict=True)), arb(0))
    return V, 2 * sum((p * v for p, v in zip(Px, f, strict=True)), arb(0)), u


def is_refuted_at(data: Document, x: list[float]) -> bool:
    """Vdot > 0 certainly, at a point that certainly has 0 < V <= c2."""
    with ctx.workprec(2000):
        v, vdot, _ = v_and_vdot(data, x)
        return bool(v <= arb(float.fromhex(data["levels"]["roa"])) and v > 0 and vdot > 0)


def bump(exponent: int, sign: str = "-") -> Document:
    """xdot = -x ((x/s - 1)^2 -+ 1/10^4), s = 2^exponent: with the minus, Vdot > 0 near x = s alone."""
    s = Fraction(2) ** exponent
    depth = ["+", ["**", ["-", ["*", str(1 / s), "x"], "1"], 2], f"{'-' if sign == '-' else ''}1/10000"]
    edge = str(2 * s)
    return make(
        [["+", ["*", "0", "u"], ["-", ["*", "x", depth]]]], [([[1.0]], [0.0])], [[1.0]],
        (0.01 * 4.0**exponent, 2.25 * 4.0**exponent), domain=[("-" + edge, edge)], centre="none",
    )  # fmt: skip


@pytest.mark.parametrize("exponent", [-430, -400, -300, -270, -265, -262, -258, -100, 0, 100, 255, 300, 400, 440])
def test_a_claim_that_is_false_on_a_small_interval_is_rejected_at_every_scale(exponent: int) -> None:
    false = bump(exponent)
    assert is_refuted_at(false, [2.0**exponent])
    assert verdict(grow(false, max_leaves=3000, depth=16)) != "ACCEPTED"


@pytest.mark.parametrize("exponent", [-200, -100, 0, 100])
def test_and_its_true_neighbour_is_accepted(exponent: int) -> None:
    true = bump(exponent, "+")
    assert not is_refuted_at(true, [2.0**exponent])
    assert verdict(grow(true, max_leaves=3000, depth=30)) == "ACCEPTED"


@pytest.mark.parametrize("power", [900, 1000, 1015, 1020, 1023, 1030])
@pytest.mark.parametrize("shrink", slow_after(2, [1, 2.0**-300, 2.0**-470]))
def test_false_claims_with_numbers_near_overflow_are_rejected(power: int, shrink: float) -> None:
    data = bump(0)
    data = edited(data, "plant.dynamics.0.2.1", lambda product: [*product, str(2**power)])
    data = edited(data, "evidence.T", encode([[shrink]]))
    data = edited(data, "evidence.root", encode(least_root(np.eye(1), np.array([[shrink]]), 2.25)))
    assert is_refuted_at(data, [1.0])
    assert verdict(grow(data, max_leaves=3000, depth=16)) != "ACCEPTED"


FALSE: list[tuple[str, str, Document, float]] = [  # rule, what, certificate, point where Vdot > 0
    ("ring", "beyond the region of attraction", scalar_claim(c2=4.0), 1.95),
    ("root", "a hole behind the root box", scalar_claim(c2=4.0, root=[1.9]), 1.95),
    ("tree", "nothing is covered", scalar_claim(c2=4.0, tree=bytes([0])), 1.95),
    ("tree", "a quarter is covered", scalar_claim(0.3, 4.0, tree=bytes([0, 0, LEAF])), 1.95),
    ("local", "local everywhere", scalar_claim(4.0, 4.0), 1.95),
    ("local", "unstable origin", scalar_claim(scale=[1.0]), 0.5),
    ("local", "unstable origin, hardly", scalar_claim(scale=[-0.499999]), 0.001),
]


@pytest.mark.parametrize(("rule", "data", "x"), [pytest.param(rule, data, x, id=what) for rule, what, data, x in FALSE])
def test_false_claims_are_rejected(rule: str, data: Document, x: float) -> None:
    assert is_refuted_at(data, [x])
    assert verdict(data) == rule


@pytest.mark.parametrize("claim", ["asymptotic", "practical"])
def test_no_tree_helps_a_claim_about_a_saturated_loop_beyond_its_region(claim: str) -> None:
    beyond = clipped_claim(c2=2.00001**2, claim=claim)
    assert is_refuted_at(beyond, [2.000005])
    assert verdict(grow(beyond, max_leaves=4000, depth=40)) == "ring"
    within_region = grow(clipped_claim(c2=1.99999**2, claim=claim), max_leaves=4000, depth=40)
    assert verdict(within_region) == "ACCEPTED"
    assert verdict(rehash(edited(within_region, "policy.clip", None))) == "inputs"


def test_a_clip_keeps_inputs_by_form_up_to_the_last_bit() -> None:
    data = honest("clipped")
    assert verdict(edited(data, "plant.input_bounds", [["-1", "1"]])) == "ACCEPTED"
    below = str(Fraction(1) - Fraction(1, 10**30))
    assert verdict(edited(data, "plant.input_bounds", [["-1", below]])) == "inputs"
    tanh = rotor_claim(clip=([-7.0], [7.0]), centre="preactivation", c2=0.2)
    assert Case(parse(edited(tanh, "plant.input_bounds", [["-2", "5/2"]]))).bounded is True
    assert Case(parse(rotor_claim(clip=([-7.0], [7.0])))).bounded is False


def test_the_interior_is_open_and_the_root_box_is_closed() -> None:
    data = grow(scalar_claim(c2=2.25))
    assert decode(data["evidence"]["root"])[0] == 1.5  # touches {V <= c2}
    assert verdict(data) == "ACCEPTED"
    assert verdict(edited(data, "plant.domain", [["-3/2", "3"]])) == "domain"
    assert verdict(edited(data, "plant.domain", [["-3", "3/2"]])) == "domain"
    barely = "1500000000000000000000000000001/1000000000000000000000000000000"
    assert verdict(edited(data, "plant.domain", [["-" + barely, barely]])) == "ACCEPTED"


def test_no_tree_helps_a_claim_beyond_the_region_of_attraction() -> None:
    data = scalar_claim(c2=1.915009**2)
    assert is_refuted_at(data, [1.9150085])
    assert verdict(grow(data, max_leaves=4000, depth=40)) == "ring"
    assert verdict(grow(scalar_claim(c2=1.915007**2), max_leaves=4000, depth=40)) == "ACCEPTED"


@given(st.integers(0, 10**6))
def test_random_cubic_plants(seed: int) -> None:
    """xdot = a x + b x^2 + c x^3 + u, u = -k x: everything is rational, the truth is known at every point."""
    generator = np.random.default_rng(seed)
    a, b, c, k = (Fraction(int(v), 64) for v in generator.integers([-64, -200, -200, 0], [65, 201, 201, 129]))
    x2 = ["*", "x", "x"]
    dynamics = ["+", ["*", str(a), "x"], ["*", str(b), x2], ["*", str(c), "x", x2], "u"]
    c2 = float(generator.uniform(0.05, 2))
    data = make(
        [dynamics], [([[-float(k)]], [0.0])], [[float(generator.uniform(0.5, 2))]], (c2 / 1000, c2),
        squash="identity", centre="none", scale=[1.0], input_bounds=[("-9", "9")],
    )  # fmt: skip
    data = grow(data, max_leaves=1000, depth=14)
    P, edge = Fraction(float(decode(data["lyapunov"]["P"])[0])), Fraction(c2)
    points = [Fraction(i, 100) for i in range(-300, 301) if i and P * Fraction(i, 100) ** 2 <= edge]
    worst = max(x * ((a - k) * x + b * x * x + c * x**3) / (x * x) for x in points)
    accepted = verdict(data) == "ACCEPTED"
    assert not (accepted and worst >= 0)
    if worst < Fraction(-1, 2) and all((a - k) + b * x + c * x * x < Fraction(-1, 4) for x in points):
        assert accepted  # and it is not merely always rejecting


@pytest.mark.parametrize("name", ["rotor", "rotor, preactivation", "linear"])
def test_what_is_accepted_is_true_at_many_points(name: str) -> None:
    data, generator = honest(name), np.random.default_rng(5)
    c = parse(data)
    L = np.linalg.inv(np.linalg.cholesky(c.P)).T
    with ctx.workprec(200):
        for r in np.concatenate([np.ones(60), generator.random(60), 2.0 ** -generator.uniform(0, 60, 60)]):
            z = generator.standard_normal(2)
            x = L @ (z / np.linalg.norm(z)) * (r * np.sqrt(c.c2) * (1 - 1e-12))
            v, vdot, u = v_and_vdot(data, x.tolist())
            assert v <= arb(c.c2) and vdot < 0
            for value, (lo, hi) in zip(u, c.input_bounds, strict=True):
                assert arb(fmpq(lo.numerator, lo.denominator)) <= value <= arb(fmpq(hi.numerator, hi.denominator))


# ---------------------------------------------------------------------------------------------------- the leaf's parts


@given(st.lists(st.sampled_from([0, 1, LEAF]), max_size=60), st.integers(0, 10**6))
def test_leaves_cover_the_root_box(marks: list[int], seed: int) -> None:
    needed, nodes = 1, []
    for mark in [*marks, *[LEAF] * (len(marks) + 1)]:  # complete the tree with leaves
        nodes.append(mark)
        needed += 1 if mark != LEAF else -1
        if needed == 0:
            break
    generator = np.random.default_rng(seed)
    root = 2.0 ** generator.uniform(-1074, 1023, 2)
    found = list(batches(bytes(nodes), -root, root, 7))
    lo, hi = (np.concatenate([batch[k].T for batch in found]) for k in (1, 2))
    assert [first for first, _, _ in found] == list(range(0, len(lo), 7)) and len(lo) == nodes.count(LEAF)
    whole = is_partition(Case(parse(with_tree(honest("linear"), bytes(nodes)))))
    with pytest.raises(StopIteration) as done:
        next(whole)
    assert done.value.value == len(lo)
    points = np.concatenate([generator.uniform(-1, 1, (50, 2)) * root, lo, hi, np.stack([lo[:, 0], hi[:, 1]], 1)])
    for p in points:
        assert np.any(np.all((lo <= p) & (p <= hi), axis=1))


@pytest.mark.parametrize("exponent", slow_after(1, [-900, 0, 500, -540, -200, 200]))
def test_a_leaf_is_missed_only_if_it_lies_outside_the_ring(exponent: int) -> None:
    generator = np.random.default_rng(exponent + 2000)
    missed = kept = 0
    for _ in range(60):
        c = parse(linear_claim())
        S = [[Fraction(float(v)) for v in row] for row in [[2.0**exponent, 0.0], [0.0, 2.0**exponent]]]
        S[0][1] = S[1][0] = Fraction(float(generator.uniform(-0.9, 0.9))) * Fraction(2) ** exponent
        levels = sorted(generator.uniform(0.1, 2, 2) * 2.0 ** (exponent + 2))
        c = replace(c, levels={"local": float(levels[0]), "roa": float(levels[1])})
        with np.errstate(all="ignore"):
            P = np.array([[float(v) for v in row] for row in S])
            ring = Ring.of(Case(replace(c, P=P, evidence=replace(c.evidence, T=np.eye(2)))))
            lo = generator.uniform(-3, 3, (2, 40))
            hi = lo + generator.uniform(0, 1, (2, 40))
            result = np.logical_or(*ring.misses(lo, hi)[:2])
        missed, kept = missed + int(result.sum()), kept + int((~result).sum())
        for box in np.flatnonzero(result):
            t = np.concatenate([generator.uniform(0, 1, (15, 2)), [[0, 0], [0, 1], [1, 0], [1, 1]]])
            z = np.clip(lo[:, box] + t * (hi - lo)[:, box], lo[:, box], hi[:, box])
            z = [[Fraction(float(v)) for v in row] for row in z]
            V = [S[0][0] * a * a + 2 * S[0][1] * a * b + S[1][1] * b * b for a, b in z]
            assert max(V) < Fraction(c.c1) or min(V) > Fraction(c.c2)
    assert missed > 50 and kept > 50


def test_a_lower_bound_of_V_that_overflows_puts_no_leaf_outside() -> None:
    """V computed is infinite, V itself is below c2, the largest binary64 number."""
    c = replace(parse(scalar_claim()), levels={"local": 1.0, "roa": float(np.finfo(float).max)})
    generator, met = np.random.default_rng(0), 0
    for s in (1 + generator.random(600)).tolist():
        near = float(np.sqrt(2.0**1023 / s) * np.sqrt(2.0))
        for _ in range(3):
            with np.errstate(all="ignore"):
                ring = Ring.of(Case(replace(c, P=np.array([[s]]))))
                overflows = not np.isfinite(s * near * near)
                outside, *_ = ring.misses(np.array([[near]]), np.array([[1.001 * near]]))
            if overflows and Fraction(s) * Fraction(near) ** 2 < Fraction(c.c2):
                met += 1
                assert not outside[0]
            near = float(np.nextafter(near, 0.0))
    assert met > 3


@given(st.fractions(-5, 5), st.fractions(-5, 5), st.floats(-5, 5), st.floats(0, 5))
def test_input_bounds_are_compared_in_the_safe_direction(p: Fraction, q: Fraction, mid: float, radius: float) -> None:
    lo, hi = sorted((p, q))
    if within((lo, hi), Near(np.array(mid), Above(np.array(radius)))):
        assert lo <= Fraction(mid) - Fraction(radius) and Fraction(mid) + Fraction(radius) <= hi


def test_input_bounds_beyond_binary64_hold_nothing_and_harm_nothing() -> None:
    huge = Fraction(10) ** 400
    assert not within((-huge, huge), Near(np.array(0.0), Above(np.array(1.0))))
    assert not within((huge, 2 * huge), Near(np.array(1e308), Above(np.array(0.0))))
    assert not within((Fraction(-1), Fraction(1)), Near(np.array(np.nan), Above(np.array(0.0))))


# ------------------------------------------------------------------------------------- each rule is there for a reason


def accepted_by(package: ModuleType, data: Document) -> bool:
    certificate = package.document.certificate(json.loads(dump(data)), "0" * 64)
    package.rules.check(certificate)
    return True


def unsymmetric(data: Document) -> Document:
    wider = array("evidence.root", lambda a: 1.001 * a)(data)
    return edited(wider, "lyapunov.P", encode([1.25, 0.2500001, 0.25, 0.25]))


def skewed() -> Document:
    """xdot = -N x with T'NT = I, but S = T'T = [[1, 3], [3, 10]] is not dominated by its diagonal."""
    dynamics = [["+", ["-", ["*", "3", "x2"], "x1"], ["*", "0", "u"]], ["-", ["*", "3", "x1"], ["*", "10", "x2"]]]
    return make(
        dynamics, [([[0.0, 0.0]], [0.0])], np.eye(2), (1.0, 1.0), states=("x1", "x2"), domain=[("-2", "2")] * 2,
        T=[[1.0, 3.0], [0.0, 1.0]],
    )  # fmt: skip


def held_near_a_face() -> Document:
    """x' = A x + u, whose set ends 1 % before a face, towards which a speed held over a period leads further than that:
    nothing says that V, which decreases from sample to sample, does so in between."""
    return make(
        [["+", "x2", ["*", "1", "u1"]], ["*", "1", "u2"]], [([[4.0, 0.75], [0.0, 4.0]], [0.0, 0.0])],
        np.diag([1.0, 1 / 16]), (1e-4, 1e-4), states=("x1", "x2"), inputs=("u1", "u2"), u_eq=("0", "0"),
        scale=(-1.0, -1.0), offset=(0.0, 0.0), input_bounds=[("-1", "1")] * 2,
        domain=[("-101/10000", "101/10000"), ("-9", "9")], sample=("1/8", "1/8"),
    )  # fmt: skip


ABLATED: dict[str, Callable[[], Document]] = {
    "format": lambda: honest("scalar") | {"comment": "unknown key"},
    "hash": lambda: array("policy.layers.0.bias", nudged(0))(honest("scalar")),
    "levels": lambda: with_ball(level("local", 3.1)(honest("linear"))),
    "lyapunov": lambda: unsymmetric(honest("linear")),
    "equilibrium": lambda: edited(honest("rotor"), "plant.dynamics.1.4", "-500000001/1000000000"),
    "centring": lambda: policy_array("layers.0.bias", lambda a: a + 1e-9)(honest("scalar, no centring")),
    "domain": lambda: at("plant.domain", [["-187/100", "3"]])(honest("scalar")),
    "coordinates": skewed,
    "root": lambda: grow(scalar_claim(c2=4.0, root=[1.9])),
    "local": lambda: scalar_claim(4.0, 4.0),
    "tube": lambda: array("claim.start", lambda a: 0.9 * a)(honest("enlarged")),
    "tree": lambda: scalar_claim(c2=4.0, tree=bytes([0])),
    "ring": lambda: scalar_claim(c2=4.0),
    "inputs": lambda: at("plant.input_bounds", [["-9/10", "1"]])(honest("scalar")),
    "flow": held_near_a_face,
    "contraction": lambda: grow(nearby_claim("9")),
    "faces": lambda: outer_loops.up_to_a_face("1").beyond(0.2),
    "outer": lambda: outer_loops.of_shape("x^2").beyond(0.02),
}


@pytest.mark.parametrize("rule", sorted(ABLATED))
def test_with_one_rule_disabled_a_bad_certificate_gets_through(rule: str, tmp_path: Path) -> None:
    data = ABLATED[rule]()
    assert verdict(data) == rule
    with checker_without(rule, tmp_path) as package:
        assert accepted_by(package, data)


def test_every_rule_is_disabled_once() -> None:
    assert set(ABLATED) == {rule for rule, *_ in MUTANTS}


@pytest.mark.parametrize(
    ("hidden", "weight", "last", "squash", "offset", "u_eq", "known"),
    [
        (0.0, 2.0, 0.0, "tanh", 0.25, Fraction(1, 4), True),
        (0.0, 2.0, 0.5, "identity", 0.25, Fraction(7, 4), True),
        (0.5, 0.0, 0.0, "tanh", 0.0, Fraction(0), True),  # 0 times an unknown number
        (0.5, 0.0, 0.5, "identity", 0.0, Fraction(3, 2), True),
        (0.0, 2.0, 0.0, "tanh", 0.25, Fraction(1, 3), False),
        (0.0, 2.0, 2.0**-1074, "tanh", 0.0, Fraction(0), False),
        (0.5, 1.0, 0.0, "tanh", 0.0, Fraction(0), False),  # an unknown number is not 0
        (0.5, 1.0, 0.0, "identity", 0.0, Fraction(0), False),
        (0.5, 1.0, -0.5, "identity", 0.0, Fraction(0), False),  # tanh(1/2) is not 1/2
        (0.0, 1.0, 0.5, "tanh", -1.5, Fraction(0), False),
        (0.5, 1.0, float(-np.tanh(0.5)), "identity", 0.0, Fraction(0), False),  # nearly
    ],
)
def test_without_centring_the_equilibrium_is_decided_exactly(
    hidden: float, weight: float, last: float, squash: str, offset: float, u_eq: Fraction, known: bool
) -> None:
    steps = (
        Affine((0,), 1, np.ones((1, 1)), np.full(1, hidden)),
        Map((1,), 1, "tanh"),
        Affine((2,), 1, np.full((1, 1), weight), np.full(1, last)),
    )
    policy = Policy(Network("policy", 1, steps), np.full(1, 3.0), np.full(1, offset), squash, "none")
    case = Case(replace(parse(scalar_claim()), policy=policy, u_eq=(u_eq,)))
    failures = list(dict(rules.STATED)["centring"](case))
    if known:
        assert not failures and network.fold(policy, (u_eq,)).offset.value is policy.offset
    else:
        assert [at for at, _ in failures] == ["policy.centre"] and policy_at_origin(policy) != [u_eq]


def test_a_leaf_that_overflows_is_never_accepted() -> None:
    """NaN and infinity come through every comparison as a failure."""
    for W in (2.0**600, 2.0**1000, np.finfo(float).max):
        data = rehash(edited(scalar_claim(), "policy.layers.0.weight", encode([W])))
        assert verdict(grow(data, max_leaves=200, depth=8)) != "ACCEPTED"


def test_rejections_name_the_first_failing_leaf() -> None:
    data = honest("scalar")
    with pytest.raises(Rejected) as no:
        rules.check(parse(with_tree(data, bytes([LEAF]))))
    assert (no.value.rule, no.value.at) == ("ring", "leaf 0")
    assert str(no.value).startswith("REJECTED rule=ring at=leaf 0: ")


def test_the_whole_tree_is_read_before_its_leaves() -> None:
    """The first leaf fails the ring's rule, and the tree is broken behind it."""
    assert verdict(with_tree(honest("scalar"), bytes([LEAF]))) == "ring"
    assert verdict(with_tree(honest("scalar"), bytes([LEAF, LEAF]))) == "tree"
    assert verdict(with_tree(honest("scalar"), bytes([0, LEAF]))) == "tree"


def test_tally_counts_a_leaf_once() -> None:
    """A uniform tree of 64 leaves: those in the corners of the root box miss the ring."""
    assert Tally().rules["tree"] == 0

    def uniform(depth: int) -> bytes:
        return bytes([LEAF]) if depth == 0 else bytes([depth % 2]) + 2 * uniform(depth - 1)

    tally = rules.check(parse(with_tree(honest("linear"), uniform(6))))
    assert tally.rules["tree"] == 64 > tally.rules["ring"] > 0


@pytest.mark.parametrize(
    ("second", "found"),
    [
        (["-", ["+", ["**", "x2", 3], "x2"]], ("ACCEPTED", "ring")),  # true, and a leaf's rule underflows
        (["-", ["*", "0", ["**", "x2", 3]], ["/", "x2", "2"]], ("ACCEPTED", "ring")),
        (["-", ["/", "x2", "2"], ["*", "0", ["**", "x2", 3]]], ("local", "local")),  # grows
        (["**", "x2", 3], ("local", "local")),  # x2^3 underflows
        (["-", ["**", "x2", 3]], ("local", "local")),  # true, but the rule is about a linear decay
        (
            ["-", ["*", str(2**1022), ["**", "x2", 3]], ["/", "x2", "2"]],
            ("local", "local"),
        ),  # grows where x2^2 > 2^-1023
    ],
)
def test_a_decay_below_every_binary64_number(second: Any, found: tuple[str, str]) -> None:
    """On the whole set it is less than any binary64 number, and so are the terms of third order."""
    for levels, rule in zip(((2.0**-1018, 2.0**-1018), (2.0**-1020, 2.0**-1018)), found, strict=True):
        far = "1" + "0" * 400
        data = make(
            [["+", "u", ["-", ["tan", "x1"]]], second], [([[1.0, 1.0]], [0.0])], np.eye(2), levels,
            states=("x1", "x2"), domain=[(f"-{far}", far)] * 2, input_bounds=[("-1000", "1000")],
            centre="none", scale=(-4.9e-91,), T=np.eye(2) * 8.9e-308, root=[6.8e153, 6.8e153],
        )  # fmt: skip
        assert verdict(data) == rule


@pytest.mark.parametrize(
    ("gain", "verdict_of"), [("30", "contraction"), ("90", "contraction"), ("1" + "0" * 7, "ACCEPTED")]
)
def test_contraction_takes_derivatives_of_what_a_function_leaves(gain: str, verdict_of: str) -> None:
    """x' = 1 - x + x^2 - 1/(1 + x) - gain x: next to -0.9 what 1/(1 + x) leaves rises by 97, four times what its size
    says."""
    left = ["-", ["+", "1", ["-", "x"], ["*", "x", "x"]], ["/", "1", ["+", "1", "x"]]]
    data = make(
        [["-", left, ["+", ["*", gain, "x"], ["*", "0", "u"]]]], [([[0.0]], [0.0])], 1.0, (0.81, 0.8181),
        claim="nearby", domain=[("-97/100", "97/100")],
    )  # fmt: skip
    data["evidence"]["contraction"] = {
        "J": encode([0.9 * (1 + 1e-9)]),
        "weights": encode([1e-9]),
        "weight": encode([1.0]),
    }
    assert verdict(grow(data)) == verdict_of
