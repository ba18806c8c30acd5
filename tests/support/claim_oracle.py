"""What is certainly wrong with a certificate, found without the checker: no code is shared with it.

A *fault* is a reason to refuse the file, in one of three ways.

Exact: the file is not in the format, or a rule that is decided in rationals fails.
Refuted: a point with 0 < V <= c2 where, in ball arithmetic, Vdot >= 0, an input leaves its bounds, or F is undefined.
Incomplete: a leaf that contains points of the ring, and no multiplier of the S-procedure makes the bound negative at
all of a few of the leaf's points; or a local ball on which, at a sampled point, d'G(d) - d'B d outweighs -d'B d.

Every fault is a fact. The absence of faults proves nothing: points are looked for in binary64, by sampling.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import json
import math
import struct
from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from flint import arb, arb_mat, ctx, fmpq
from numpy.typing import NDArray

from tests.support.earlier import strictly_earlier

Array = NDArray[np.float64]
Document = dict[str, Any]
Points = Sequence[tuple[float, ...]]
Matrix = list[list[Fraction]]

LARGEST_FILE = 256 * 2**20
EXACT = ("format", "hash", "levels", "lyapunov", "equilibrium", "domain", "coordinates", "root", "centring", "tree")
PRECISION = 160
EDGES = {"asymptotic": ("local", "roa"), "practical": ("floor", "local", "roa")}


def is_practical(data: Document) -> bool:
    """Whether nothing is claimed about {V < c0}, of a document or of what it claims."""
    return "floor" in data["levels"]


def ring_of(data: Document) -> tuple[float, float]:
    """Both levels, the inner one first."""
    return tuple(float.fromhex(data["levels"][k]) for k in ("floor" if is_practical(data) else "local", "roa"))


class Malformed(Exception):
    """The bytes are not a certificate as FORMAT.md describes it."""


# ----------------------------------------------------------------------------------------------------------- the format


class _Pairs(list[Any]):
    """A JSON object as it stands, with duplicates."""


def read(path: Path) -> Document:
    """The file as plain data; raises `Malformed`."""
    if path.stat().st_size > LARGEST_FILE:
        raise Malformed("too large")

    def number(text: str) -> int:
        if len(text) > 10:
            raise Malformed("long integer")
        return int(text)

    def refuse(text: str) -> None:
        raise Malformed(f"number {text[:20]}")

    try:
        value = json.loads(
            path.read_bytes().decode("utf-8"), object_pairs_hook=_Pairs, parse_int=number, parse_float=refuse,
            parse_constant=refuse,
        )  # fmt: skip
        data = strictly_earlier(_plain(value))
    except (ValueError, RecursionError) as error:
        raise Malformed(type(error).__name__) from error
    _shape(data)
    return data


def _plain(value: Any) -> Any:
    if isinstance(value, _Pairs):
        if len({k for k, _ in value}) < len(value):
            raise Malformed("duplicate key")
        return {k: _plain(v) for k, v in value}
    return [_plain(v) for v in value] if isinstance(value, list) else value


def _need(condition: object, what: str) -> None:
    if not condition:
        raise Malformed(what)


def _section(value: Any, *keys: str) -> None:
    _need(isinstance(value, dict) and sorted(value) == sorted(keys), f"an object with {keys}")


def _rational(text: Any) -> Fraction:
    _need(isinstance(text, str) and text.isascii(), "a rational")
    parts = text.removeprefix("-").split("/")
    _need(len(parts) <= 2, "a rational")
    for part in parts:
        _need(part.isdigit() and len(part) <= 1201 and (part == "0" or part[0] != "0"), "a rational")
    _need(len(parts) == 1 or parts[1] != "0", "a rational")
    return Fraction(int(parts[0]), int(parts[1]) if len(parts) == 2 else 1) * (-1 if text[0] == "-" else 1)


def _rationals(value: Any, count: int) -> list[Fraction]:
    _need(isinstance(value, list) and len(value) == count, "a list of rationals")
    return [_rational(v) for v in value]


def _binary64(text: Any) -> float:
    _need(isinstance(text, str), "a hex float")
    try:
        value = float.fromhex(text)
    except (ValueError, OverflowError) as error:
        raise Malformed("a hex float") from error
    _need(math.isfinite(value) and value.hex() == text, "a canonical hex float")
    return value


def _bytes(text: Any) -> bytes:
    _need(isinstance(text, str) and text.isascii(), "base64")
    try:
        raw = base64.b64decode(text, validate=True)
    except binascii.Error as error:
        raise Malformed("base64") from error
    _need(base64.b64encode(raw) == text.encode(), "canonical base64")
    return raw


def _array(text: Any, *shape: int) -> Array:
    raw = _bytes(text)
    _need(len(raw) == 8 * math.prod(shape), f"an array of shape {shape}")
    values = np.array(struct.unpack(f"<{len(raw) // 8}d", raw)).reshape(shape)
    _need(np.isfinite(values).all(), "finite numbers")
    return values


def _words(value: Any, most: int) -> list[str]:
    _need(isinstance(value, list) and 1 <= len(value) <= most, "a list of identifiers")
    _need(all(isinstance(v, str) and v.isidentifier() for v in value), "identifiers")
    return value


UNARY = ("sin", "cos", "tan", "tanh", "exp", "atan", "sqrt")


def _expression(node: Any, names: set[str]) -> None:
    if isinstance(node, str):
        if node not in names:
            _rational(node)
        return
    _need(isinstance(node, list) and len(node) >= 2 and isinstance(node[0], str), "an expression")
    name, rest = node[0], node[1:]
    if name == "**":
        _need(len(rest) == 2 and type(rest[1]) is int and 0 < abs(rest[1]) <= 64, "an exponent")
        rest = rest[:1]
    elif name in UNARY:
        _need(len(rest) == 1, "one operand")
    else:
        _need(name in ("+", "*", "-", "/"), "an operator")
        _need(name in ("+", "*") or len(rest) == 2 or (name == "-" and len(rest) == 1), "operands")
    for operand in rest:
        _expression(operand, names)


def _shape(data: Any) -> None:
    """Every section, key, count and number."""
    _section(data, "schema", "claim", "plant", "policy", "lyapunov", "levels", "evidence", "provenance")
    _need(data["schema"] == "certify-certificate/8", "schema")
    _need(isinstance(data["provenance"], dict), "provenance")
    plant, policy, evidence = data["plant"], data["policy"], data["evidence"]
    _section(plant, "name", "time", "states", "inputs", "uncertain", "dynamics", "u_eq", "domain", "input_bounds")
    _need(isinstance(plant["name"], str), "name")
    _need(plant["time"] == "continuous", "time: this page knows of no steps")
    _need(plant["uncertain"] == [], "nothing uncertain: this page knows of values only")
    names = _words(plant["states"], 64) + _words(plant["inputs"], 64)
    _need(len(set(names)) == len(names), "different names")
    n, m = len(plant["states"]), len(plant["inputs"])
    _need(isinstance(plant["dynamics"], list) and len(plant["dynamics"]) == n, "n equations")
    for node in plant["dynamics"]:
        _expression(node, set(names))
    _rationals(plant["u_eq"], m)
    for key, count in (("domain", n), ("input_bounds", m)):
        _need(isinstance(plant[key], list) and len(plant[key]) == count, key)
        for pair in plant[key]:
            lo, hi = _rationals(pair, 2)
            _need(lo < hi, "lo < hi")

    _section(policy, "layers", "squash", "centre", "scale", "offset", "clip", "origin", "sha256")
    squash, centre = policy["squash"], policy["centre"]
    _need(squash in ("tanh", "identity") and centre in ("output", "preactivation", "none"), "squash and centre")
    _need(centre != "preactivation" or squash == "tanh", "preactivation without tanh")
    _need(isinstance(policy["layers"], list) and policy["layers"], "layers")
    width = n
    for layer in policy["layers"]:
        _section(layer, "shape", "weight", "bias")
        shape = layer["shape"]
        _need(isinstance(shape, list) and len(shape) == 2 and all(type(s) is int for s in shape), "shape")
        _need(shape[0] >= 1 and shape[1] == width, "shape")
        _array(layer["weight"], *shape)
        _array(layer["bias"], shape[0])
        width = shape[0]
    _need(width == m, "m outputs")
    _need(np.all(_array(policy["scale"], m) != 0), "nonzero scale")
    _array(policy["offset"], m)
    if policy["clip"] is not None:
        _need(isinstance(policy["clip"], list) and len(policy["clip"]) == 2, "clip")
        _need(np.all(_array(policy["clip"][0], m) < _array(policy["clip"][1], m)), "clip: lo < hi")

    still = np.all(_array(policy["origin"], n) == 0)
    _need(still or (is_practical(data) and centre == "none"), "another origin")

    _section(data["claim"], "kind", "rate", "sample", "outer")
    _need(data["claim"]["kind"] in tuple(EDGES), "claim")
    _need(data["claim"]["rate"] == (0.0).hex() and data["claim"]["sample"] is None, "neither a rate nor a sample")
    _need(data["claim"]["outer"] is None, "no outer set")
    _section(data["lyapunov"], "kind", "P")
    _need(data["lyapunov"]["kind"] == "quadratic", "lyapunov")
    _array(data["lyapunov"]["P"], n, n)
    practical, edges = data["claim"]["kind"] == "practical", EDGES[data["claim"]["kind"]]
    _section(data["levels"], *edges)
    for edge in edges:
        _binary64(data["levels"][edge])
    if isinstance(evidence, dict) and evidence.get("kind") == "trusted-solver":
        _section(evidence, "kind", "solver", "version", "precision", "queries")
        _binary64(evidence["precision"])
        _need(isinstance(evidence["queries"], list), "queries")
        pairs = evidence["queries"]
        _need(all(isinstance(pair, list) and len(pair) == 2 for pair in pairs), "pairs")
        words = [evidence["solver"], evidence["version"], *(word for pair in pairs for word in pair)]
        _need(all(isinstance(w, str) and w and not set(w) & set(" \n\t") for w in words), "words")
        return
    _section(evidence, "kind", "T", "root", "tree", "order", "cells", "local", "contraction", "tube", "outer")
    _need(evidence["contraction"] is None and evidence["outer"] is None, "no contraction, nor an outer set")
    _need(type(evidence["order"]) is int and evidence["order"] == 1, "order")
    _need(evidence["cells"] == [], "no cells of nothing")
    _need(evidence["kind"] == "partition-tree", "kind")
    _array(evidence["T"], n, n)
    _array(evidence["root"], n)
    _bytes(evidence["tree"])
    _need(evidence["tube"] == [], "no tube: this page knows of no enlarged claim")
    if practical:
        _need(evidence["local"] is None, "no ball")
        return
    _section(evidence["local"], "J", "multipliers", "weight", "edge", "order")
    _need(evidence["local"]["edge"] == (0.0).hex(), "edge")
    _need(type(evidence["local"]["order"]) is int and evidence["local"]["order"] == 1, "order")
    _array(evidence["local"]["J"], n, n)
    _array(evidence["local"]["multipliers"], 3, n)
    _array(evidence["local"]["weight"], n, n)


# --------------------------------------------------------------------------------------------------------- exact facts


def _matrix(array: Array) -> Matrix:
    return [[Fraction(v) for v in row] for row in array.tolist()]


def _times(A: Matrix, B: Matrix) -> Matrix:
    return [[sum((a * b for a, b in zip(row, column, strict=True)), Fraction(0)) for column in zip(*B, strict=True)]
            for row in A]  # fmt: skip


def _congruence(T: Matrix, P: Matrix) -> Matrix:
    return _times([list(column) for column in zip(*T, strict=True)], _times(P, T))


def _inverse(A: Matrix) -> Matrix | None:
    """The inverse of a symmetric positive definite matrix, None of any other: its LDL' factors, D > 0."""
    n = len(A)
    if any(A[i][j] != A[j][i] for i in range(n) for j in range(i)):
        return None
    L = [[Fraction(int(i == j)) for j in range(n)] for i in range(n)]
    D: list[Fraction] = []
    for j in range(n):
        D.append(A[j][j] - sum((L[j][k] ** 2 * D[k] for k in range(j)), Fraction(0)))
        if D[j] <= 0:
            return None
        for i in range(j + 1, n):
            L[i][j] = (A[i][j] - sum((L[i][k] * L[j][k] * D[k] for k in range(j)), Fraction(0))) / D[j]
    # rows of L^-1 by forward substitution; A^-1 = L^-T D^-1 L^-1
    M = [[Fraction(int(i == j)) for j in range(n)] for i in range(n)]
    for i in range(n):
        for k in range(i):
            M[i] = [v - L[i][k] * w for v, w in zip(M[i], M[k], strict=True)]
    return [[sum((M[k][i] * M[k][j] / D[k] for k in range(n)), Fraction(0)) for j in range(n)] for i in range(n)]


def _row_surplus(S: Matrix) -> Fraction:
    """min_i (S_ii - sum_j |S_ij|)."""
    return min(row[i] - sum((abs(v) for j, v in enumerate(row) if j != i), Fraction(0)) for i, row in enumerate(S))


def _ball(q: Fraction) -> arb:
    return arb(fmpq(q.numerator, q.denominator))


class Undefined(Exception):
    """A division by exactly 0, a root of what is not positive, or a number that outgrows all reason."""


def _at_equilibrium(node: Any, names: dict[str, Fraction]) -> Fraction | None:
    """An expression in rationals; None for a number without a value, such as a sine of 1, which 0 times makes 0.

    Raises `Undefined`, under a factor 0 as well.
    """
    if isinstance(node, str):
        return names[node] if node in names else _rational(node)
    name, rest = node[0], node[1:]
    values = [_at_equilibrium(v, names) for v in (rest[:1] if name == "**" else rest)]
    if any(v is not None and v.numerator.bit_length() + v.denominator.bit_length() > 10**6 for v in values):
        raise Undefined
    if name in UNARY:
        return _function_of(name, values[0])
    if name == "**":
        if rest[1] < 0 and values[0] == 0:
            raise Undefined
        return None if values[0] is None else values[0] ** rest[1]
    if name == "/" and values[1] == 0:
        raise Undefined
    if name in ("*", "/") and 0 in values:
        return Fraction(0)
    known = [v for v in values if v is not None]
    if len(known) < len(values):
        return None
    if name == "+":
        return sum(known, Fraction(0))
    if name == "*":
        return math.prod(known, start=Fraction(1))
    if name == "-":
        return -known[0] if len(known) == 1 else known[0] - known[1]
    return known[0] / known[1]


def _vanishes(node: Any, names: dict[str, Fraction]) -> bool:
    try:
        return _at_equilibrium(node, names) == 0
    except Undefined:
        return False


def _function_of(name: str, value: Fraction | None) -> Fraction | None:
    if value is None:
        return None
    if name == "sqrt":
        if value <= 0:
            raise Undefined
        root = Fraction(math.isqrt(value.numerator), math.isqrt(value.denominator))
        return root if root**2 == value else None
    return Fraction(int(name in ("cos", "exp"))) if value == 0 else None


def _raw_at_0(policy: Document, n: int) -> list[Fraction | None]:
    """scale * squash(net(0)) + offset where it is rational by form: tanh is known at 0 alone; None elsewhere."""
    h: list[Fraction | None] = [Fraction(0)] * n
    for k, layer in enumerate(policy["layers"]):
        rows = _array(layer["weight"], *layer["shape"]).tolist()
        if k:
            h = [Fraction(0) if v is not None and v == 0 else None for v in h]
        used = [[(Fraction(w), v) for w, v in zip(row, h, strict=True) if w != 0] for row in rows]
        biases = _array(layer["bias"], layer["shape"][0]).tolist()
        h = [
            None if any(v is None for _, v in terms) else sum((w * v for w, v in terms if v is not None), Fraction(b))
            for terms, b in zip(used, biases, strict=True)
        ]
    if policy["squash"] == "tanh":
        h = [Fraction(0) if v is not None and v == 0 else None for v in h]
    m = len(h)
    scale, offset = (_array(policy[key], m).tolist() for key in ("scale", "offset"))
    return [None if v is None else Fraction(s) * v + Fraction(o) for v, s, o in zip(h, scale, offset, strict=True)]


def _limits(policy: Document, m: int) -> list[tuple[Any, Any]]:
    """Between which each input is kept."""
    if policy["clip"] is None:
        return [(-math.inf, math.inf)] * m
    lo, hi = (_array(end, m).tolist() for end in policy["clip"])
    return [(Fraction(a), Fraction(b)) for a, b in zip(lo, hi, strict=True)]


def policy_hash(policy: Document) -> str:
    text = b"certify-policy/1\0%s\0%s\0" % (policy["squash"].encode(), policy["centre"].encode())
    arrays = [(layer[key], layer["shape"][:axes]) for layer in policy["layers"] for key, axes in _AXES]
    for numbers in (policy["scale"], policy["offset"], *(policy["clip"] or ())):
        arrays.append((numbers, [len(base64.b64decode(numbers)) // 8]))
    for encoded, shape in arrays:
        text += b"".join(k.to_bytes(8, "little") for k in (len(shape), *shape)) + base64.b64decode(encoded)
    return hashlib.sha256(text).hexdigest()


_AXES = (("weight", 2), ("bias", 1))


def exact_faults(data: Document) -> dict[str, str]:
    """The rules that fail in rationals, of a document that is in the format."""
    faults: dict[str, str] = {}
    plant, policy, evidence = data["plant"], data["policy"], data["evidence"]
    n, m = len(plant["states"]), len(plant["inputs"])
    if policy["sha256"] != policy_hash(policy):
        faults["hash"] = "sha256"
    c1, c2 = map(Fraction, ring_of(data))
    if not 0 < c1 <= c2:
        faults["levels"] = "0 < c1 <= c2"
    if is_practical(data) and Fraction(float.fromhex(data["levels"]["local"])) != c1:
        faults["levels"] = "there is no ball, and c0 is not c1"
    P = _matrix(_array(data["lyapunov"]["P"], n, n))
    inverse = _inverse(P)
    if inverse is None:
        faults["lyapunov"] = "P"
    u_eq = _rationals(plant["u_eq"], m)
    names = dict(zip(plant["states"] + plant["inputs"], [Fraction(0)] * n + u_eq, strict=True))
    wrong_rows = [] if is_practical(data) else [i for i, f in enumerate(plant["dynamics"]) if not _vanishes(f, names)]
    if wrong_rows:
        faults["equilibrium"] = f"component {wrong_rows[0]}"
    domain = [_rationals(pair, 2) for pair in plant["domain"]]
    for i, (lo, hi) in enumerate(domain):
        if not lo < 0 < hi or (inverse is not None and c2 * inverse[i][i] >= min(-lo, hi) ** 2):
            faults.setdefault("domain", f"axis {i}")
    if policy["centre"] == "preactivation":
        pairs = zip(_array(policy["scale"], m).tolist(), _array(policy["offset"], m).tolist(), u_eq, strict=True)
        if not all(-1 < (q - Fraction(o)) / Fraction(s) < 1 for s, o, q in pairs):
            faults["centring"] = "u_eq out of reach"
    elif policy["centre"] == "none" and not is_practical(data):
        limits = _limits(policy, m)
        raw = zip(_raw_at_0(policy, n), limits, strict=True)
        reached = [None if v is None else sorted((lo, v, hi))[1] for v, (lo, hi) in raw]
        if any(v is None or v != q for v, q in zip(reached, u_eq, strict=True)):
            faults["centring"] = "raw(0)"
    if policy["centre"] != "none" and not all(
        lo < q < hi for q, (lo, hi) in zip(u_eq, _limits(policy, m), strict=True)
    ):
        faults["centring"] = "u_eq against the clip"
    if evidence["kind"] == "partition-tree":
        S = _congruence(_matrix(_array(evidence["T"], n, n)), P)
        if _row_surplus(S) <= 0:
            faults["coordinates"] = "T'PT"
        elif inverse is not None:
            reach = _inverse(S)
            root = _array(evidence["root"], n).tolist()
            wrong = [i for i, b in enumerate(root) if reach and not (b > 0 and c2 * reach[i][i] <= Fraction(b) ** 2)]
            if reach is None:
                faults["coordinates"] = "T'PT"
            elif wrong:
                faults["root"] = f"axis {wrong[0]}"
        if not is_practical(data) and inverse is not None:
            wrong = _ball_fault(evidence["local"], P, c1, n)
            if wrong:
                faults["local"] = wrong
        wrong_tree = tree_fault(_bytes(evidence["tree"]), n)
        if wrong_tree:
            faults["tree"] = wrong_tree
    return faults


def _ball_fault(local: Any, P: Matrix, c1: Fraction, n: int) -> str | None:
    """The ball must contain {V <= c1}, and no multiplier be negative, or 0 where it divides."""
    J = _matrix(_array(local["J"], n, n))
    around = _congruence(J, P)
    for i in range(n):
        around[i][i] -= c1
    if _inverse(around) is None:
        return "J'PJ - c1 I"
    alpha, beta, g = _array(local["multipliers"], 3, n).tolist()
    if any(v < 0 for v in (*alpha, *beta, *g)) or (0 in beta and 0 in g):
        return "multipliers"
    return None


def tree_fault(tree: bytes, n: int) -> str | None:
    """What is wrong with the tree's form. Open boxes: 1, one more by a split, one less by a leaf."""
    missing = 1
    for k, byte in enumerate(tree):
        if missing == 0:
            return f"bytes from {k} on belong to no box"
        if byte >= n and byte != 255:
            return f"byte {k}"
        missing += 1 if byte < n else -1
        if missing > 4097:
            return f"more than 4096 boxes behind the current one at byte {k}"
    return f"{missing} boxes are left" if missing else None


# ------------------------------------------------------------------------------------------------------ the closed loop


class Loop:
    """F and Vdot of a document, in binary64 over many points and in ball arithmetic at a few."""

    def __init__(self, data: Document) -> None:
        plant, policy = data["plant"], data["policy"]
        self.plant, self.policy = plant, policy
        self.n, self.m = len(plant["states"]), len(plant["inputs"])
        self.names = plant["states"] + plant["inputs"]
        self.layers = [
            (_array(layer["weight"], *layer["shape"]), _array(layer["bias"], layer["shape"][0]))
            for layer in policy["layers"]
        ]
        self.scale, self.offset = (_array(policy[key], self.m) for key in ("scale", "offset"))
        self.origin = _array(policy["origin"], self.n)
        self.limits = [(float(lo), float(hi)) for lo, hi in _limits(policy, self.m)]
        self.u_eq = _rationals(plant["u_eq"], self.m)
        self.bounds = [_rationals(pair, 2) for pair in plant["input_bounds"]]
        self.P = _array(data["lyapunov"]["P"], self.n, self.n)
        (self.c1, self.c2), self.practical = ring_of(data), is_practical(data)

    # in binary64: to find points, never to judge them

    def inputs(self, x: Array) -> Array:
        """pi at x (n, B)."""
        lo, hi = np.array(self.limits).T[:, :, None]
        return np.asarray(np.clip(self.before_clip(x), lo, hi))

    def before_clip(self, x: Array) -> Array:
        """What pi clips, at x (n, B)."""
        h = np.concatenate([x, np.zeros((self.n, 1))], axis=1) + self.origin[:, None]
        for k, (W, b) in enumerate(self.layers):
            h = W @ (np.tanh(h) if k else h) + b[:, None]
        scale, offset = self.scale[:, None], self.offset[:, None]
        u_eq = np.array([[_near(q)] for q in self.u_eq])
        if self.policy["centre"] == "preactivation":
            beta = np.arctanh((u_eq - offset) / scale)
            return np.asarray(scale * np.tanh(h[:, :-1] - h[:, -1:] + beta) + offset)
        h = np.tanh(h) if self.policy["squash"] == "tanh" else h
        if self.policy["centre"] == "output":
            return np.asarray(scale * (h[:, :-1] - h[:, -1:]) + u_eq)
        return np.asarray(scale * h[:, :-1] + offset)

    def field(self, x: Array, u: Array) -> Array:
        """f(x, u) (n, B)."""
        values = dict(zip(self.names, [*x, *u], strict=True))
        rows = [_evaluate(node, values, _near, np) for node in self.plant["dynamics"]]
        return np.array([np.broadcast_to(row, x.shape[1]) for row in rows])

    def sampled(self, x: Array) -> tuple[Array, Array, Array]:
        """V, Vdot and u at x (n, B)."""
        with np.errstate(all="ignore"):
            u = self.inputs(x)
            gradient = 2 * self.P @ x
            return np.sum(gradient * x, 0) / 2, np.sum(gradient * self.field(x, u), 0), u

    def slope(self) -> Array:
        """dF/dx at the origin by central differences, (n, n)."""
        step = 1e-6
        x = np.concatenate([step * np.eye(self.n), -step * np.eye(self.n)], axis=1)
        with np.errstate(all="ignore"):
            F = self.field(x, self.inputs(x))
        return np.asarray((F[:, : self.n] - F[:, self.n :]) / (2 * step))

    # in ball arithmetic

    def closed_loop(self, points: Sequence[Sequence[arb]]) -> list[tuple[list[arb], list[arb]]]:
        """(pi(x), F(x)) at each point, at the current precision."""
        columns = [*points, [arb(0)] * self.n]
        h = arb_mat([[column[i] + arb(at) for column in columns] for i, at in enumerate(self.origin.tolist())])
        for k, (W, b) in enumerate(self.layers):
            h = _each(h, arb.tanh) if k else h
            bias = arb_mat([[arb(v)] * len(columns) for v in b.tolist()])
            h = arb_mat([[arb(w) for w in row] for row in W.tolist()]) * h + bias
        if self.policy["squash"] == "tanh" and self.policy["centre"] != "preactivation":
            h = _each(h, arb.tanh)
        result = []
        for p, x in enumerate(points):
            u = []
            for j, q in enumerate(self.u_eq):
                y, at_0 = h[j, p], h[j, len(points)]
                eq, scale, offset = _ball(q), arb(float(self.scale[j])), arb(float(self.offset[j]))
                if self.policy["centre"] == "preactivation":
                    u.append(scale * (y - at_0 + ((eq - offset) / scale).atanh()).tanh() + offset)
                elif self.policy["centre"] == "output":
                    u.append(scale * (y - at_0) + eq)
                else:
                    u.append(scale * y + offset)
                if self.policy["clip"] is not None:
                    lo, hi = map(arb, self.limits[j])
                    u[j] = u[j].max(lo).min(hi)
            values = dict(zip(self.names, [*x, *u], strict=True))
            F = [_evaluate(node, values, lambda text: _ball(_rational(text)), None) for node in self.plant["dynamics"]]
            result.append((u, F))
        return result

    def certain(self, points: Points) -> list[tuple[arb, arb, list[arb]]]:
        """V, Vdot and u at each point, as balls."""
        states = [[arb(v) for v in x] for x in points]
        result = []
        for x, (u, F) in zip(states, self.closed_loop(states), strict=True):
            Px = [sum((arb(p) * v for p, v in zip(row, x, strict=True)), arb(0)) for row in self.P.tolist()]
            V = sum((p * v for p, v in zip(Px, x, strict=True)), arb(0))
            result.append((V, 2 * sum((p * v for p, v in zip(Px, F, strict=True)), arb(0)), u))
        return result


def _near(value: Any) -> float:
    q = _rational(value) if isinstance(value, str) else value
    try:
        return float(q)
    except OverflowError:
        return math.inf if q > 0 else -math.inf


def _each(matrix: arb_mat, function: Callable[[arb], arb]) -> arb_mat:
    return arb_mat(matrix.nrows(), matrix.ncols(), [function(v) for v in matrix.entries()])


def _evaluate(node: Any, names: dict[str, Any], constant: Callable[[str], Any], library: Any) -> Any:
    """An expression in the arithmetic of its values: arrays (`library` is numpy) or balls (None)."""
    if isinstance(node, str):
        return names[node] if node in names else constant(node)
    name, rest = node[0], node[1:]
    values = [_evaluate(v, names, constant, library) for v in (rest[:1] if name == "**" else rest)]
    if name in UNARY:
        return getattr(library, name)(values[0]) if library else getattr(values[0], name)()
    if name == "abs":
        return abs(values[0])
    if name == "**":
        power = math.prod([values[0]] * (abs(rest[1]) - 1), start=values[0])
        return power if rest[1] > 0 else _quotient(1, power, library)
    if name == "+":
        return sum(values[1:], values[0])
    if name == "*":
        return math.prod(values[1:], start=values[0])
    if name == "-":
        return -values[0] if len(values) == 1 else values[0] - values[1]
    return _quotient(*values, library)


def _quotient(a: Any, b: Any, library: Any) -> Any:
    if library:
        return np.true_divide(a, b)
    if b.is_zero():
        raise Undefined
    return a / b


# --------------------------------------------------------------------------------------------------- refuted, by points


def _directions(n: int) -> Array:
    """Unit vectors (n, B)."""
    if n == 1:
        return np.array([[1.0, -1.0]])
    if n == 2:
        angle = 2 * np.pi * np.arange(180) / 180
        return np.stack([np.cos(angle), np.sin(angle)])
    v = np.random.default_rng(1).standard_normal((n, 600))
    return np.asarray(v / np.linalg.norm(v, axis=0))


_RADII = np.concatenate([[1 - 1e-9], np.arange(0.98, 0.1, -0.03), 2.0 ** -np.arange(3.5, 12)])


def refutation(data: Document, hints: Points = ()) -> str | None:
    """A point at which the claim is certainly false, in words; None if none is found. P must be positive definite.

    hints : points to look at besides the sampled ones; nothing is believed of them.
    """
    return _refutation(json.dumps([data[k] for k in _CLAIM]), tuple(hints))


_CLAIM = ("plant", "policy", "lyapunov", "levels")


@lru_cache(256)
def _refutation(claim: str, hints: Points) -> str | None:
    loop = Loop(dict(zip(_CLAIM, json.loads(claim), strict=True)))
    try:
        with np.errstate(all="ignore"):
            L = np.linalg.inv(np.linalg.cholesky(loop.P)).T
            x = np.concatenate([L @ _directions(loop.n) * (r * math.sqrt(loop.c2)) for r in _RADII], axis=1)
    except np.linalg.LinAlgError:
        x = np.zeros((loop.n, 0))
    x = x[:, np.isfinite(x).all(axis=0)]
    chosen: list[tuple[float, ...]] = [tuple(map(float, p)) for p in hints]
    if x.shape[1]:
        V, vdot, u = loop.sampled(x)
        with np.errstate(all="ignore"):
            worst = np.where(loop.c1 <= V, vdot, -np.inf) if loop.practical else vdot
            ranks = [worst / V, worst]
            for j, (lo, hi) in enumerate(loop.bounds):
                ranks += [u[j] - _near(hi), _near(lo) - u[j]]
        for values in ranks:
            rank = np.where(np.isnan(values), np.inf, values)
            best = np.argsort(rank)[-2:]
            chosen += [tuple(x[:, k].tolist()) for k in best if rank[k] >= 0]
    for point in dict.fromkeys(chosen):
        reason = _refuted_at(loop, point)
        if reason:
            return f"{reason} at {point}"
    return None


def _refuted_at(loop: Loop, point: tuple[float, ...]) -> str | None:
    for precision in (PRECISION, 4000):
        with ctx.workprec(precision):
            try:
                [(V, vdot, u)] = loop.certain([point])
            except Undefined:
                x = [[Fraction(v)] for v in point]
                inside = _congruence(x, _matrix(loop.P))[0][0] <= Fraction(loop.c2)
                return "F is undefined" if inside else None
            if not 0 < V <= arb(loop.c2):
                if arb(loop.c2) < V:
                    return None
                continue
            for j, (lo, hi) in enumerate(loop.bounds):
                if u[j] < _ball(lo) or u[j] > _ball(hi):
                    return f"{loop.plant['inputs'][j]} leaves its bounds"
            if vdot < 0 or (loop.practical and arb(loop.c1) > V):
                return None
            if vdot >= 0 and (not loop.practical or arb(loop.c1) <= V):
                return "Vdot >= 0"
    return None


# ----------------------------------------------------------------------------------------------- incomplete evidence


def leaves(tree: bytes, root: Array) -> Iterator[tuple[list[float], list[float]]]:
    """The boxes of a well-formed tree: lower and upper corners."""
    position = 0
    waiting = [([-b for b in root.tolist()], root.tolist())]
    while waiting:
        lo, hi = waiting.pop()
        axis = tree[position]
        position += 1
        if axis == 255:
            yield lo, hi
            continue
        middle = 0.5 * lo[axis] + 0.5 * hi[axis]
        waiting.append(([middle if i == axis else v for i, v in enumerate(lo)], hi))
        waiting.append((lo, [middle if i == axis else v for i, v in enumerate(hi)]))


def leaf_fault(data: Document, most: int = 400) -> tuple[str, str] | None:
    """("ring" or "inputs", which leaf and why) for a leaf that no bound within the rules can pass, or None.

    A leaf with a point in the ring cannot be left out. Its bound is at least the largest value at any of its points, of
    Vdot, of Vdot + k (c2 - V) for the chosen k, or of Vdot + k (V - c1): two points may exclude every k >= 0.
    """
    loop = Loop(data)
    n = loop.n
    evidence = data["evidence"]
    T, root = _array(evidence["T"], n, n), _array(evidence["root"], n)
    boxes = list(leaves(_bytes(evidence["tree"]), root))[:most]
    ticks = np.linspace(-1, 1, {1: 41, 2: 11}.get(n, 3))
    d = np.stack(np.meshgrid(*[ticks] * n, indexing="ij")).reshape(n, -1)
    lo, hi = (np.array(side)[:, :, None] for side in zip(*boxes, strict=True))
    with np.errstate(all="ignore"):
        z = np.clip(0.5 * lo + 0.5 * hi + (0.5 * hi - 0.5 * lo) * d, lo, hi)
        x = np.einsum("ij,bjk->bik", T, z)
    V, vdot, u = (v.reshape(*v.shape[:-1], *z.shape[::2]) for v in loop.sampled(np.moveaxis(x, 1, 0).reshape(n, -1)))
    in_ring = (loop.c1 * (1 + 1e-9) <= V) & (loop.c2 * (1 - 1e-9) >= V)
    for leaf in np.flatnonzero(in_ring.any(axis=1)):
        member = int(np.flatnonzero(in_ring[leaf])[0])
        for j, bounds in enumerate(loop.bounds):
            if bounded_by_form(loop, j):
                continue
            worst = int(np.argmax(np.maximum(u[j, leaf] - _near(bounds[1]), _near(bounds[0]) - u[j, leaf])))
            with ctx.workprec(PRECISION):
                if _in_ring(loop, T, z[leaf][:, member]) and _outside(loop, T, z[leaf][:, worst], j):
                    return "inputs", f"leaf {leaf}: {loop.plant['inputs'][j]}"
        found = _without_multiplier(loop, T, z[leaf], V[leaf], vdot[leaf], member)
        if found:
            return "ring", f"leaf {leaf}"
    return None


def bounded_by_form(loop: Loop, j: int) -> bool:
    lo, hi = loop.bounds[j]
    reach, middle = abs(Fraction(loop.scale[j])), Fraction(loop.offset[j])
    form = loop.policy["squash"] == "tanh" and loop.policy["centre"] != "output"
    least, most = loop.limits[j]
    return bool((form and lo <= middle - reach and middle + reach <= hi) or lo <= least < most <= hi)


def _mapped(T: Array, z: Sequence[arb]) -> list[arb]:
    return [sum((arb(t) * v for t, v in zip(row, z, strict=True)), arb(0)) for row in T.tolist()]


def _values(loop: Loop, T: Array, z: Array) -> tuple[arb, arb, list[arb]]:
    """V, Vdot and u at x = T z."""
    x = _mapped(T, [arb(v) for v in z.tolist()])
    [(u, F)] = loop.closed_loop([x])
    Px = [sum((arb(p) * v for p, v in zip(row, x, strict=True)), arb(0)) for row in loop.P.tolist()]
    V = sum((p * v for p, v in zip(Px, x, strict=True)), arb(0))
    return V, 2 * sum((p * v for p, v in zip(Px, F, strict=True)), arb(0)), u


def _in_ring(loop: Loop, T: Array, z: Array) -> bool:
    V = _values(loop, T, z)[0]
    return bool(arb(loop.c1) <= V <= arb(loop.c2))


def _outside(loop: Loop, T: Array, z: Array, j: int) -> bool:
    u = _values(loop, T, z)[2][j]
    return bool(u < _ball(loop.bounds[j][0]) or u > _ball(loop.bounds[j][1]))


def _without_multiplier(loop: Loop, T: Array, z: Array, V: Array, vdot: Array, member: int) -> bool:
    """None of the three bounds can be negative: found in binary64, shown in balls."""
    if not np.fmax.reduce(vdot) >= 0:
        return False
    chosen = {"V": int(np.nanargmax(vdot))}
    for name, gap in (("c2", loop.c2 - V), ("c1", V - loop.c1)):
        with np.errstate(all="ignore"):
            limit = -vdot / gap
        below = np.where(gap > 0, limit, np.inf)  # k must be less
        above = np.where(gap < 0, limit, 0.0)  # k must be more
        least, most = int(np.nanargmax(above)), int(np.nanargmin(below))
        if not above[least] >= below[most]:
            return False
        chosen[f"{name} least"], chosen[f"{name} most"] = least, most
    with ctx.workprec(PRECISION):
        if not _in_ring(loop, T, z[:, member]):
            return False
        at = {k: _values(loop, T, z[:, k]) for k in set(chosen.values())}
        if not at[chosen["V"]][1] >= 0:
            return False
        for name, level, sign in (("c2", loop.c2, 1), ("c1", loop.c1, -1)):
            low, high = at[chosen[f"{name} least"]], at[chosen[f"{name} most"]]
            gap_low, gap_high = sign * (arb(level) - low[0]), sign * (arb(level) - high[0])
            if not gap_high > 0:
                return False
            least = -low[1] / gap_low if gap_low < 0 else arb(0)
            if not least >= -high[1] / gap_high and not high[1] >= 0:
                return False
    return True


def local_fault(data: Document) -> tuple[str, str] | None:
    """("local" or "inputs", why) if the local rule cannot hold on the ball of the document; None otherwise.

    The rule implies that -d'B d exceeds |d'G(d) - d'B d| everywhere on the ball; B is from central differences of step
    2^-150 in balls of 700 bits, and d is sampled.
    """
    return _local_fault(json.dumps([data[k] for k in _CLAIM]), data["evidence"]["local"]["J"])


@lru_cache(256)
def _local_fault(claim: str, encoded: str) -> tuple[str, str] | None:
    loop = Loop(dict(zip(_CLAIM, json.loads(claim), strict=True)))
    n = loop.n
    J, P = _array(encoded, n, n), _matrix(loop.P)
    directions = _directions(n)
    directions = directions[:, :: max(1, directions.shape[1] // 30)]
    d = np.concatenate([directions * r for r in (1 - 1e-9, 0.7, 0.3)], axis=1)
    with ctx.workprec(700):
        step = arb(2) ** -150
        units = [[step * int(i == j) * sign for i in range(n)] for sign in (1, -1) for j in range(n)]
        samples = [[arb(v) for v in column] for column in d.T.tolist()]
        states = [_mapped(J, s) for s in (*units, *samples)]
        try:
            values = loop.closed_loop(states)
        except Undefined:
            return "local", "F is undefined on the ball"
        for j, (lo, hi) in enumerate(loop.bounds):
            if not bounded_by_form(loop, j) and any(u[j] < _ball(lo) or u[j] > _ball(hi) for u, _ in values):
                return "inputs", f"{loop.plant['inputs'][j]} on the local ball"
        for j, (lo, hi) in enumerate(loop.limits):
            if math.isfinite(lo) and any(not (u[j] > lo and u[j] < hi) for u, _ in values):
                return "local", f"{loop.plant['inputs'][j]} is clipped on the local ball"
        TP = [[_ball(v) for v in row] for row in _times(_matrix(J.T), P)]
        G = [[sum((p * f for p, f in zip(row, F, strict=True)), arb(0)) for row in TP] for _, F in values]
        B = [[(G[j][i] - G[n + j][i]) / (2 * step) for j in range(n)] for i in range(n)]
        slack = arb(2) ** -60  # covers the differences' error, of relative order 2^-300
        for s, g in zip(samples, G[2 * n :], strict=True):
            linear = [sum((b * v for b, v in zip(row, s, strict=True)), arb(0)) for row in B]
            decay = -sum((p * q for p, q in zip(s, linear, strict=True)), arb(0))
            rest = abs(sum((p * (q - v) for p, q, v in zip(s, g, linear, strict=True)), arb(0)))
            if not rest.is_finite():
                return None
            if decay + slack * abs(decay) <= rest * (1 - slack):
                return "local", f"at d = {s}: decay {float(decay.mid()):.3g}, the rest {float(rest.mid()):.3g}"
    return None


# ------------------------------------------------------------------------------------------------------------- together


def faults(path: Path, hints: Points = ()) -> dict[str, str]:
    """Rule (or `claim`, if the claim itself is refuted) -> why; empty if nothing certain is found.

    The exact rules come first and alone: without them points mean nothing.
    """
    try:
        data = read(path)
    except Malformed as error:
        return {"format": str(error)}
    found = exact_faults(data)
    if found:
        return found
    return sampled_faults(data, hints)


def sampled_faults(data: Document, hints: Points = ()) -> dict[str, str]:
    """What points show of a document whose exact rules hold."""
    refuted = refutation(data, hints)
    if refuted:
        return {"claim": refuted}
    if data["evidence"]["kind"] != "partition-tree":
        return {}
    practical, (inner, outer) = is_practical(data), ring_of(data)
    found = None if practical else local_fault(data)
    if not found and (practical or inner != outer):
        found = leaf_fault(data)
    return dict([found]) if found else {}
