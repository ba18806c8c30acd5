"""Rules `format` and `hash`: the bytes of a file, read as FORMAT.md describes them, every number exact.

Weights stay binary64 numbers in flat arrays until a rule asks for them: a file of the largest size holds millions.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import json
import math
import re
import struct
import sys
from array import array
from dataclasses import dataclass
from typing import Any

from flint import fmpq, fmpq_mat

from .expressions import Equations, equations, rational
from .refusal import Refused, require

MAX_BYTES, MAX_BYTES_BEYOND_ASCII = 256 * 2**20, 16 * 2**20
MAX_TOKENS = 10**6  # commas and opening brackets
MAX_NAMES, MAX_LAYERS, MAX_WIDTH = 64, 64, 2**14
WORD = re.compile(r"[A-Za-z0-9_.+-]{1,80}")
IDENTIFIER = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,63}")

Interval = tuple[fmpq, fmpq]


@dataclass(frozen=True)
class Layer:
    """`W h + b`: W row by row, all numbers as they stand in the file."""

    rows: int
    columns: int
    weight: array[float]
    bias: array[float]

    def row(self, i: int) -> array[float]:
        return self.weight[i * self.columns : (i + 1) * self.columns]


@dataclass(frozen=True)
class Plant:
    name: str
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    dynamics: Equations
    u_eq: tuple[fmpq, ...]
    domain: tuple[Interval, ...]
    input_bounds: tuple[Interval, ...]


@dataclass(frozen=True)
class Policy:
    layers: tuple[Layer, ...]
    squash: str
    centre: str
    scale: array[float]
    offset: array[float]
    clip: tuple[array[float], array[float]] | None
    sha256: str

    def limits(self, j: int) -> tuple[fmpq, fmpq] | None:
        """Between which input j is kept."""
        return None if self.clip is None else (exact(self.clip[0][j]), exact(self.clip[1][j]))


@dataclass(frozen=True)
class Tree:
    """Evidence that can be replayed."""

    T: fmpq_mat
    root: array[float]
    tree: bytes


@dataclass(frozen=True)
class Trusted:
    """Evidence that cannot."""

    solver: str
    version: str


@dataclass(frozen=True)
class Certificate:
    """`inner` and `outer`, between which the leaves show Vdot < 0, are c1 (`practical`: c0) and c2."""

    claim: str
    plant: Plant
    policy: Policy
    P: fmpq_mat
    inner: float
    outer: float
    evidence: Tree | Trusted

    @property
    def n(self) -> int:
        return len(self.plant.states)

    @property
    def m(self) -> int:
        return len(self.plant.inputs)


def read(raw: bytes) -> Certificate:
    """The certificate in the bytes of a file, in the order of FORMAT.md's sections."""
    sections = ("schema", "claim", "plant", "policy", "lyapunov", "levels", "evidence", "provenance")
    data = keys(parsed(raw), "file", *sections)
    require(data["schema"] == "certify-certificate/3", "format", "schema", "'certify-certificate/3' was expected")
    require(isinstance(data["provenance"], dict), "format", "provenance", "an object was expected")
    claim = keys(data["claim"], "claim", "kind")["kind"]
    require(claim in ("asymptotic", "practical"), "format", "claim.kind", "'asymptotic' or 'practical' was expected")
    inner_name = "local" if claim == "asymptotic" else "floor"
    plant = read_plant(data["plant"])
    n = len(plant.states)
    policy = read_policy(data["policy"], n, len(plant.inputs))
    lyapunov = keys(data["lyapunov"], "lyapunov", "kind", "P")
    require(lyapunov["kind"] == "quadratic", "format", "lyapunov.kind", "'quadratic' was expected")
    P = numbers(lyapunov["P"], "lyapunov.P", n * n)
    levels = keys(data["levels"], "levels", inner_name, "roa")
    inner, outer = binary64(levels[inner_name], f"levels.{inner_name}"), binary64(levels["roa"], "levels.roa")
    return Certificate(claim, plant, policy, matrix(P, n), inner, outer, read_evidence(data["evidence"], n))


def parsed(raw: bytes) -> Any:
    """JSON without decimal fractions, constants and duplicate keys."""
    require(len(raw) <= MAX_BYTES, "format", "file", "larger than 256 MiB")
    short = len(raw) <= MAX_BYTES_BEYOND_ASCII or raw.isascii()
    require(short, "format", "file", "larger than 16 MiB and not all of it ASCII")
    tokens = sum(raw.count(token) for token in (b",", b"[", b"{"))
    require(tokens <= MAX_TOKENS, "format", "file", f"more than {MAX_TOKENS} commas and opening brackets")
    try:
        return json.loads(
            raw.decode("utf-8"), object_pairs_hook=unique, parse_float=refuse, parse_constant=refuse, parse_int=integer
        )
    except ValueError as error:
        raise Refused("format", "file", f"not JSON in UTF-8 ({type(error).__name__})") from None
    except RecursionError:
        raise Refused("format", "file", "JSON nests too deep") from None


def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result = dict(pairs)
    require(len(result) == len(pairs), "format", "file", "a key stands twice in an object")
    return result


def refuse(text: str) -> None:
    raise Refused("format", "file", f"the number {text[:20]} is not an integer")


def integer(text: str) -> int:
    require(len(text) <= 10, "format", "file", "an integer of more than 10 characters")
    return int(text)


def read_plant(value: Any) -> Plant:
    plant = keys(value, "plant", "name", "states", "inputs", "dynamics", "u_eq", "domain", "input_bounds")
    states, inputs = entries(plant["states"], "plant.states"), entries(plant["inputs"], "plant.inputs")
    n, m = len(states), len(inputs)
    require(1 <= n <= MAX_NAMES and 1 <= m <= MAX_NAMES, "format", "plant", "1 to 64 states and inputs are allowed")
    for word in (plant["name"], *states, *inputs):
        named = isinstance(word, str) and IDENTIFIER.fullmatch(word) is not None
        require(named, "format", "plant", "an identifier was expected")
    require(len({*states, *inputs}) == n + m, "format", "plant", "a name stands for two things")
    u_eq = entries(plant["u_eq"], "plant.u_eq", m)
    return Plant(
        name=plant["name"],
        states=tuple(states),
        inputs=tuple(inputs),
        dynamics=equations(entries(plant["dynamics"], "plant.dynamics", n), {*states, *inputs}, "plant.dynamics"),
        u_eq=tuple(rational(q, f"plant.u_eq.{j}") for j, q in enumerate(u_eq)),
        domain=intervals(plant["domain"], "plant.domain", n),
        input_bounds=intervals(plant["input_bounds"], "plant.input_bounds", m),
    )


def intervals(value: Any, at: str, count: int) -> tuple[Interval, ...]:
    result = []
    for i, pair in enumerate(entries(value, at, count)):
        lo, hi = (rational(q, f"{at}.{i}") for q in entries(pair, f"{at}.{i}", 2))
        require(lo < hi, "format", f"{at}.{i}", "lo < hi must hold")
        result.append((lo, hi))
    return tuple(result)


def read_policy(value: Any, n: int, m: int) -> Policy:
    """The hash is taken over the very bytes that were decoded."""
    policy = keys(value, "policy", "layers", "squash", "centre", "scale", "offset", "clip", "sha256")
    squash, centre = policy["squash"], policy["centre"]
    require(squash in ("tanh", "identity"), "format", "policy.squash", "'tanh' or 'identity' was expected")
    require(centre in ("output", "preactivation", "none"), "format", "policy.centre", "an unknown centring")
    both = squash == "tanh" or centre != "preactivation"
    require(both, "format", "policy.centre", "'preactivation' needs squash 'tanh'")
    digest = hashlib.sha256(f"certify-policy/1\0{squash}\0{centre}\0".encode())
    layers, width = [], n
    described = entries(policy["layers"], "policy.layers")
    require(1 <= len(described) <= MAX_LAYERS, "format", "policy.layers", "1 to 64 layers are allowed")
    for k, entry in enumerate(described):
        at = f"policy.layers.{k}"
        layer = keys(entry, at, "shape", "weight", "bias")
        rows, columns = entries(layer["shape"], f"{at}.shape", 2)
        fits = type(rows) is int and type(columns) is int and 1 <= rows <= MAX_WIDTH and columns == width
        require(fits, "format", f"{at}.shape", f"[rows, {width}] with 1 to {MAX_WIDTH} rows was expected")
        W, b = numbers(layer["weight"], f"{at}.weight", rows * columns), numbers(layer["bias"], f"{at}.bias", rows)
        digest.update(struct.pack("<3Q", 2, rows, columns) + little_endian(W))
        digest.update(struct.pack("<2Q", 1, rows) + little_endian(b))
        layers.append(Layer(rows, columns, W, b))
        width = rows
    require(width == m, "format", "policy.layers", f"the last layer must have {m} rows")
    scale, offset = numbers(policy["scale"], "policy.scale", m), numbers(policy["offset"], "policy.offset", m)
    require(all(s != 0 for s in scale), "format", "policy.scale", "must not be 0")
    clip = read_clip(policy["clip"], m)
    for values in (scale, offset, *(clip or ())):
        digest.update(struct.pack("<2Q", 1, m) + little_endian(values))
    sha256 = digest.hexdigest()
    require(policy["sha256"] == sha256, "hash", "policy.sha256", f"the policy's hash is {sha256}")
    return Policy(tuple(layers), squash, centre, scale, offset, clip, sha256)


def read_clip(value: Any, m: int) -> tuple[array[float], array[float]] | None:
    if value is None:
        return None
    lo, hi = (numbers(end, "policy.clip", m) for end in entries(value, "policy.clip", 2))
    require(all(a < b for a, b in zip(lo, hi, strict=True)), "format", "policy.clip", "lo < hi must hold")
    return lo, hi


def read_evidence(value: Any, n: int) -> Tree | Trusted:
    if isinstance(value, dict) and value.get("kind") == "trusted-solver":
        evidence = keys(value, "evidence", "kind", "solver", "version", "precision", "queries")
        positive = binary64(evidence["precision"], "evidence.precision") > 0
        require(positive, "format", "evidence.precision", "must be positive")
        queries = entries(evidence["queries"], "evidence.queries")
        said = [word for pair in queries for word in entries(pair, "evidence.queries", 2)]
        for word in (evidence["solver"], evidence["version"], *said):
            good = isinstance(word, str) and WORD.fullmatch(word) is not None
            require(good, "format", "evidence", "a word was expected")
        return Trusted(evidence["solver"], evidence["version"])
    evidence = keys(value, "evidence", "kind", "T", "root", "tree")
    require(evidence["kind"] == "partition-tree", "format", "evidence.kind", "an unknown kind")
    T, root = numbers(evidence["T"], "evidence.T", n * n), numbers(evidence["root"], "evidence.root", n)
    return Tree(matrix(T, n), root, decoded(evidence["tree"], "evidence.tree"))


# ------------------------------------------------------------------------------------------------------- single values


def keys(value: Any, at: str, *names: str) -> dict[str, Any]:
    good = isinstance(value, dict) and set(value) == set(names)
    require(good, "format", at, f"an object with the keys {', '.join(names)} was expected")
    return dict(value)


def entries(value: Any, at: str, count: int | None = None) -> list[Any]:
    good = isinstance(value, list) and count in (None, len(value))
    require(good, "format", at, f"a list{'' if count is None else f' of {count}'} was expected")
    return list(value)


def binary64(text: Any, at: str) -> float:
    try:
        value = float.fromhex(text)
    except (TypeError, ValueError, OverflowError):
        raise Refused("format", at, "a hex float was expected") from None
    canonical = math.isfinite(value) and value.hex() == text
    require(canonical, "format", at, "a canonical finite hex float was expected")
    return value


def decoded(text: Any, at: str) -> bytes:
    try:
        raw = base64.b64decode(text, validate=True) if isinstance(text, str) else b""
    except (binascii.Error, ValueError):
        raise Refused("format", at, "base64 was expected") from None
    canonical = isinstance(text, str) and base64.b64encode(raw).decode() == text
    require(canonical, "format", at, "canonical base64 was expected")
    return raw


def numbers(text: Any, at: str, count: int) -> array[float]:
    raw = decoded(text, at)
    require(len(raw) == 8 * count, "format", at, f"{count} binary64 numbers were expected")
    values = array("d")
    values.frombytes(raw)
    if sys.byteorder == "big":
        values.byteswap()
    require(all(map(math.isfinite, values)), "format", at, "finite numbers were expected")
    return values


def little_endian(values: array[float]) -> bytes:
    if sys.byteorder == "big":
        values = values[:]
        values.byteswap()
    return values.tobytes()


def exact(value: float) -> fmpq:
    return fmpq(*value.as_integer_ratio())


def matrix(values: array[float], n: int) -> fmpq_mat:
    return fmpq_mat(n, n, [exact(v) for v in values])
