"""Strict reading of a certificate file into plain data.

Everything unexpected is refused under rule `format`: unknown, missing or duplicate keys, decimal numbers,
NaN, infinities, wrong lengths, over-large counts. Numbers arrive as hex floats, exact fractions or raw
little-endian bytes; none passes through decimal.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import json
import os
import re
import struct
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from .errors import Rejected, Unreadable
from .expression import Tape, parse_dynamics

SCHEMA = "certify-certificate/2"
MAX_BYTES = 256 * 2**20
MAX_WIDE_BYTES = 2**24  # with a character beyond ASCII: each may take four bytes
MAX_VALUES = 1_000_000  # each takes up to 100 bytes of memory; numbers come as base64, never as lists
MAX_STATES, MAX_LAYERS, MAX_WIDTH = 64, 64, 2**14
_RATIONAL = re.compile(r"-?(0|[1-9][0-9]{0,1200})(/[1-9][0-9]{0,1200})?")
_HEX_FLOAT = re.compile(r"-?0x[01]\.[0-9a-f]{1,13}p[+-][0-9]{1,4}")
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,63}")

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Policy:
    """The network as stated in the file: exact binary64 numbers."""

    weights: tuple[Array, ...]
    biases: tuple[Array, ...]
    scale: Array
    offset: Array
    squash: str
    centre: str

    def sha256(self) -> str:
        """Hash of squash, centre, then shape and little-endian numbers of each array (FORMAT.md)."""
        digest = hashlib.sha256(b"certify-policy/1\0")
        digest.update(f"{self.squash}\0{self.centre}\0".encode())
        pairs = [a for pair in zip(self.weights, self.biases, strict=True) for a in pair]
        for array in (*pairs, self.scale, self.offset):
            digest.update(struct.pack(f"<{1 + array.ndim}Q", array.ndim, *array.shape))
            digest.update(array.astype("<f8").tobytes())
        return digest.hexdigest()


@dataclass(frozen=True)
class Partition:
    """Evidence that is replayed: a partition tree of the box |z| <= root, x = T z."""

    T: Array
    root: Array
    tree: bytes


@dataclass(frozen=True)
class Trusted:
    """Evidence that cannot be replayed: a solver's name and version, and its answers as (query, answer)."""

    solver: str
    version: str
    queries: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class Certificate:
    """The claim and its evidence. Provenance is not kept: nothing may depend on it."""

    name: str
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    dynamics: Tape
    u_eq: tuple[Fraction, ...]
    domain: tuple[tuple[Fraction, Fraction], ...]
    input_bounds: tuple[tuple[Fraction, Fraction], ...]
    policy: Policy
    P: Array
    c1: float
    c2: float
    evidence: Partition | Trusted
    sha256: str


def read(path: str) -> Certificate:
    """Read and validate the file at `path`; raises `Unreadable` or `Rejected` under rule `format`."""
    try:
        with open(path, "rb") as stream:
            size = os.fstat(stream.fileno()).st_size
            raw = b"" if size > MAX_BYTES else stream.read(MAX_BYTES + 1)
    except OSError as error:
        raise Unreadable(f"{path} cannot be read: {error.strerror}") from error
    if size > MAX_BYTES or len(raw) > MAX_BYTES:
        _fail("file", f"larger than {MAX_BYTES} bytes")
    if len(raw) > MAX_WIDE_BYTES and not raw.isascii():
        _fail("file", f"larger than {MAX_WIDE_BYTES} bytes and not ASCII")
    if sum(map(raw.count, (b",", b"[", b"{"))) > MAX_VALUES:
        _fail("file", f"more than {MAX_VALUES} commas and brackets")
    try:
        data = json.loads(
            raw.decode("utf-8"),
            object_pairs_hook=_object,
            parse_float=lambda text: _fail("file", f"decimal number {text[:40]}"),
            parse_constant=lambda text: _fail("file", f"number {text}"),
            parse_int=_integer,
        )
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise Rejected("format", "file", f"not a JSON document: {type(error).__name__}") from error
    return _certificate(data, hashlib.sha256(raw).hexdigest())


def _certificate(data: Any, sha256: str) -> Certificate:
    top = _keys(data, "file", "schema claim plant policy lyapunov levels evidence provenance")
    if top["schema"] != SCHEMA:
        _fail("schema", f"must be {SCHEMA!r}")
    _keys(top["provenance"], "provenance", None)
    if _keys(top["claim"], "claim", "kind")["kind"] != "asymptotic":
        _fail("claim.kind", "must be 'asymptotic'")

    plant = _keys(top["plant"], "plant", "name states inputs dynamics u_eq domain input_bounds")
    states, inputs = _names(plant["states"], "plant.states"), _names(plant["inputs"], "plant.inputs")
    if len(set(states + inputs)) != len(states + inputs):
        _fail("plant.states", "names must differ")
    n, m = len(states), len(inputs)
    trees = _list(plant["dynamics"], "plant.dynamics", n)
    dynamics = parse_dynamics(trees, states + inputs, _rational)
    u_eq = tuple(_rational(q, "plant.u_eq") for q in _list(plant["u_eq"], "plant.u_eq", m))
    domain = _intervals(plant["domain"], "plant.domain", n)
    input_bounds = _intervals(plant["input_bounds"], "plant.input_bounds", m)

    stated = _keys(top["policy"], "policy", "layers squash centre scale offset sha256")
    policy = _policy(stated, n, m)
    if stated["sha256"] != policy.sha256():
        raise Rejected("hash", "policy.sha256", "does not match the layers in the file")

    lyapunov = _keys(top["lyapunov"], "lyapunov", "kind P")
    if lyapunov["kind"] != "quadratic":
        _fail("lyapunov.kind", "must be 'quadratic'")
    levels = _keys(top["levels"], "levels", "local roa")
    return Certificate(
        name=_name(plant["name"], "plant.name"),
        states=states,
        inputs=inputs,
        dynamics=dynamics,
        u_eq=u_eq,
        domain=domain,
        input_bounds=input_bounds,
        policy=policy,
        P=_array(lyapunov["P"], "lyapunov.P", (n, n)),
        c1=_hex_float(levels["local"], "levels.local"),
        c2=_hex_float(levels["roa"], "levels.roa"),
        evidence=_evidence(top["evidence"], n),
        sha256=sha256,
    )


def _evidence(data: Any, n: int) -> Partition | Trusted:
    kind = data.get("kind") if isinstance(data, dict) else None
    if kind == "trusted-solver":
        stated = _keys(data, "evidence", "kind solver version precision queries")
        if not _hex_float(stated["precision"], "evidence.precision") > 0:
            _fail("evidence.precision", "must be positive")
        pairs = [_list(pair, "evidence.queries", 2) for pair in _list(stated["queries"], "evidence.queries", None)]
        words = [stated["solver"], stated["version"], *(word for pair in pairs for word in pair)]
        if not all(isinstance(w, str) and re.fullmatch(r"[A-Za-z0-9_.+-]{1,80}", w, re.ASCII) for w in words):
            _fail("evidence", "solver, version and answers must be words of letters, digits and _.+-")
        return Trusted(stated["solver"], stated["version"], tuple((name, answer) for name, answer in pairs))
    if kind != "partition-tree":
        _fail("evidence.kind", "must be 'partition-tree' or 'trusted-solver'")
    stated = _keys(data, "evidence", "kind T root tree")
    root = _array(stated["root"], "evidence.root", (n,))
    return Partition(_array(stated["T"], "evidence.T", (n, n)), root, _bytes(stated["tree"], "evidence.tree"))


def _policy(stated: dict[str, Any], n: int, m: int) -> Policy:
    squash, centre = stated["squash"], stated["centre"]
    if squash not in ("tanh", "identity"):
        _fail("policy.squash", "must be 'tanh' or 'identity'")
    if centre not in ("output", "preactivation", "none") or (centre == "preactivation" and squash != "tanh"):
        _fail("policy.centre", "must be 'output', 'none', or 'preactivation' with squash 'tanh'")
    layers = _list(stated["layers"], "policy.layers", None)
    if not 1 <= len(layers) <= MAX_LAYERS:
        _fail("policy.layers", f"must have 1 to {MAX_LAYERS} layers")
    weights, biases, width = [], [], n
    for k, entry in enumerate(layers):
        where = f"policy.layers[{k}]"
        layer = _keys(entry, where, "shape weight bias")
        shape = _list(layer["shape"], f"{where}.shape", 2)
        if not all(type(s) is int and 1 <= s <= MAX_WIDTH for s in shape) or shape[1] != width:
            _fail(f"{where}.shape", f"must be [out, {width}] with out at most {MAX_WIDTH}")
        weights.append(_array(layer["weight"], f"{where}.weight", (shape[0], shape[1])))
        biases.append(_array(layer["bias"], f"{where}.bias", (shape[0],)))
        width = shape[0]
    if width != m:
        _fail("policy.layers", f"must end in {m} outputs")
    scale = _array(stated["scale"], "policy.scale", (m,))
    if not np.all(scale != 0):
        _fail("policy.scale", "must be nonzero")
    return Policy(tuple(weights), tuple(biases), scale, _array(stated["offset"], "policy.offset", (m,)), squash, centre)


def _fail(at: str, detail: str) -> NoReturn:
    raise Rejected("format", at, detail)


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result = dict(pairs)
    if len(result) != len(pairs):
        _fail("file", "duplicate key")
    return result


def _integer(text: str) -> int:
    if len(text) > 10:
        _fail("file", f"integer {text[:20]}... is too long")
    return int(text)


def _keys(value: Any, at: str, wanted: str | None) -> dict[str, Any]:
    if not isinstance(value, dict):
        _fail(at, "must be an object")
    if wanted is not None and set(value) != set(wanted.split()):
        _fail(at, f"must have exactly the keys: {wanted}")
    return value


def _list(value: Any, at: str, length: int | None) -> list[Any]:
    if not isinstance(value, list) or (length is not None and len(value) != length):
        _fail(at, "must be a list" + ("" if length is None else f" of {length}"))
    return value


def _name(value: Any, at: str) -> str:
    if not isinstance(value, str) or not _NAME.fullmatch(value):
        _fail(at, "must be an identifier")
    return value


def _names(value: Any, at: str) -> tuple[str, ...]:
    names = tuple(_name(v, at) for v in _list(value, at, None))
    if not 1 <= len(names) <= MAX_STATES:
        _fail(at, f"must have 1 to {MAX_STATES} names")
    return names


def _rational(value: Any, at: str) -> Fraction:
    if not isinstance(value, str) or not _RATIONAL.fullmatch(value):
        _fail(at, 'must be an exact fraction such as "3/20"')
    return Fraction(value)


def _intervals(value: Any, at: str, length: int) -> tuple[tuple[Fraction, Fraction], ...]:
    pairs = []
    for entry in _list(value, at, length):
        lo, hi = (_rational(q, at) for q in _list(entry, at, 2))
        if not lo < hi:
            _fail(at, "must satisfy lo < hi")
        pairs.append((lo, hi))
    return tuple(pairs)


def _hex_float(value: Any, at: str) -> float:
    if not isinstance(value, str) or not _HEX_FLOAT.fullmatch(value):
        _fail(at, 'must be a hex float such as "0x1.8p+1"')
    try:
        number = float.fromhex(value)
    except OverflowError:
        _fail(at, "is out of range")
    if number.hex() != value:
        _fail(at, f"must be written canonically, {number.hex()}")
    return number


def _bytes(value: Any, at: str) -> bytes:
    if not isinstance(value, str):
        _fail(at, "must be base64 text")
    try:
        raw = base64.b64decode(value.encode("ascii"), validate=True)
    except (UnicodeEncodeError, binascii.Error):
        _fail(at, "must be base64 text")
    if base64.b64encode(raw).decode("ascii") != value:
        _fail(at, "must be canonical base64 text")
    return raw


def _array(value: Any, at: str, shape: tuple[int, ...]) -> Array:
    raw = _bytes(value, at)
    if len(raw) != 8 * int(np.prod(shape)):
        _fail(at, f"must hold {int(np.prod(shape))} little-endian binary64 numbers")
    array = np.frombuffer(raw, dtype="<f8").astype(np.float64).reshape(shape)
    if not np.all(np.isfinite(array)):
        _fail(at, "must be finite")
    return array
