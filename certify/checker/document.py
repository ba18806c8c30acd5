"""The document of a certificate: what FORMAT.md calls sections, read into plain data."""

from __future__ import annotations

import hashlib
import struct
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from flint import fmpq
from numpy.typing import NDArray

from .errors import Rejected
from .expression import Tape, parse_dynamics
from .schema import Value
from .strict import MAX_VALUES, load

MAX_STATES, MAX_LAYERS, MAX_WIDTH, MAX_SLABS = 64, 64, 2**14, 10**4
CLAIMS = ("asymptotic", "practical", "enlarged", "reached")
WITH_TUBE = ("enlarged", "reached")
Array = NDArray[np.float64]
Intervals = tuple[tuple[Fraction, Fraction], ...]


@dataclass(frozen=True)
class Policy:
    """The network as stated in the file: exact binary64 numbers."""

    weights: tuple[Array, ...]
    biases: tuple[Array, ...]
    scale: Array
    offset: Array
    squash: str
    centre: str
    clip: tuple[Array, Array] | None = None  # lo, hi

    def sha256(self) -> str:
        """Hash of squash, centre, then shape and little-endian numbers of each array (FORMAT.md)."""
        digest = hashlib.sha256(f"certify-policy/1\0{self.squash}\0{self.centre}\0".encode())
        layers = [array for layer in zip(self.weights, self.biases, strict=True) for array in layer]
        for numbers in (*layers, self.scale, self.offset, *(self.clip or ())):
            digest.update(struct.pack(f"<{1 + numbers.ndim}Q", numbers.ndim, *numbers.shape))
            digest.update(numbers.astype("<f8").tobytes())
        return digest.hexdigest()


@dataclass(frozen=True)
class Multipliers:
    """alpha, beta and g of the inequality `decrease`, n of each, and `weight`, (k, k), from which the others follow."""

    rest: tuple[fmpq, ...]
    apart: tuple[fmpq, ...]
    joint: tuple[fmpq, ...]
    weight: Array


@dataclass(frozen=True)
class LocalBall:
    """The ball x = J d, ||d|| <= 1, and multipliers on it."""

    J: Array
    multipliers: Multipliers


@dataclass(frozen=True)
class Path:
    """Where a slab's ellipsoids have their centre at its end, the share of its ball that the motion takes, and the
    multipliers of the tube's edge and of the motion."""

    centre: Array
    share: float
    edge: float
    motion: float
    joint: float


@dataclass(frozen=True)
class Slab:
    """A piece of the tube up to the node `end`, in its time, with a ball that contains it and multipliers on it."""

    middle: Array
    end: Array
    duration: float
    J: Array
    multipliers: Multipliers
    path: Path | None


@dataclass(frozen=True)
class Partition:
    """Evidence that is replayed: a partition tree of the box |z| <= root, x = T z; the local ball; the tube's slabs."""

    T: Array
    root: Array
    tree: bytes
    local: LocalBall | None
    tube: tuple[Slab, ...]


@dataclass(frozen=True)
class Trusted:
    """Evidence that cannot be replayed: a solver's name and version, and its answers as (query, answer)."""

    solver: str
    version: str
    queries: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Certificate:
    """The claim and its evidence. Provenance is not kept: nothing may depend on it.

    `levels` are as stated: the inner edge of the ring, which is c1 (`local`) or c0 (`floor`), and c2 (`roa`).
    """

    claim: str
    name: str
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    dynamics: Tape
    u_eq: tuple[Fraction, ...]
    domain: Intervals
    input_bounds: Intervals
    policy: Policy
    P: Array
    levels: dict[str, float]
    evidence: Partition | Trusted
    sha256: str
    start: Array | None = None  # P_0 of a claim with a tube
    centre: Array | None = None  # c_0 of a claim whose tube follows a path

    @property
    def practical(self) -> bool:
        return self.claim == "practical"

    @property
    def c1(self) -> float:
        """The ring's inner edge: c1, or c0 of a practical claim."""
        return self.levels["floor" if self.practical else "local"]

    @property
    def c2(self) -> float:
        return self.levels["roa"]


def read(path: str) -> Certificate:
    """Read and validate the file at `path`; raises `Unreadable`, or `Rejected` under rule `format` or `hash`."""
    return certificate(*load(path))


def certificate(data: Any, sha256: str) -> Certificate:
    """A JSON value as a certificate."""
    keys = "schema claim plant policy lyapunov levels evidence provenance"
    schema, claim, plant, policy, lyapunov, levels, evidence, provenance = Value(data).keys(keys)
    schema.choice("certify-certificate/5")
    known = isinstance(claim.raw, dict) and claim.raw.get("kind") in CLAIMS
    claim.must(known, f"an object of kind {' or '.join(CLAIMS)}")
    kind = claim.raw["kind"]
    stated = _plant(plant)
    n, m = len(stated["states"]), len(stated["inputs"])
    stated["policy"] = _policy(policy, n, m)
    stated_of = {"enlarged": "kind start", "reached": "kind start centre"}
    _, *of_tube = claim.keys(stated_of.get(kind, "kind"))
    form, P = lyapunov.keys("kind P")
    form.choice("quadratic")
    edges = ("floor" if kind == "practical" else "local", "roa")
    numbers = {edge: level.binary64() for edge, level in zip(edges, levels.keys(" ".join(edges)), strict=True)}
    provenance.must(isinstance(provenance.raw, dict), "an object")
    return Certificate(
        kind,
        **stated,
        P=P.array(n, n),
        levels=numbers,
        evidence=_evidence(evidence, n, kind),
        sha256=sha256,
        start=of_tube[0].array(n, n) if of_tube else None,
        centre=of_tube[1].array(n) if kind == "reached" else None,
    )


def _plant(plant: Value) -> dict[str, Any]:
    name, *names, dynamics, u_eq, domain, bounds = plant.keys("name states inputs dynamics u_eq domain input_bounds")
    states, inputs = (value.listed(Value.name, 1, MAX_STATES) for value in names)
    n, m = len(states), len(inputs)
    plant.must(len({*states, *inputs}) == n + m, "a plant whose states and inputs have different names")
    return {
        "name": name.name(),
        "states": states,
        "inputs": inputs,
        "dynamics": parse_dynamics(dynamics.listed(lambda tree: tree.raw, n), states + inputs),
        "u_eq": u_eq.listed(Value.rational, m),
        "domain": domain.listed(Value.interval, n),
        "input_bounds": bounds.listed(Value.interval, m),
    }


def _policy(value: Value, n: int, m: int) -> Policy:
    layers, squash, centre, scale, offset, clip, sha256 = value.keys("layers squash centre scale offset clip sha256")
    read: list[tuple[Array, Array]] = []
    columns = n  # of a layer: the rows of the layer before
    for shape, weight, bias in layers.listed(lambda layer: layer.keys("shape weight bias"), 1, MAX_LAYERS):
        rows, stated = shape.listed(lambda size: size.raw, 2)
        fits = type(rows) is type(stated) is int and 1 <= rows <= MAX_WIDTH and stated == columns
        shape.must(fits, f"[out, {columns}] with out at most {MAX_WIDTH}")
        read.append((weight.array(rows, columns), bias.array(rows)))
        columns = rows
    layers.must(columns == m, f"a network with {m} outputs")
    words = squash.choice("tanh", "identity"), centre.choice("output", "preactivation", "none")
    centre.must(words != ("identity", "preactivation"), "another where squash is not 'tanh'")
    weights, biases = zip(*read, strict=True)
    policy = Policy(weights, biases, scale.array(m), offset.array(m), *words, _clip(clip, m))
    scale.must(bool(np.all(policy.scale != 0)), "nonzero")
    check_hash(policy, sha256.raw)
    return policy


def _local(value: Value, n: int, claim: str) -> LocalBall | None:
    if claim == "practical":
        value.must(value.raw is None, "null under this claim")
        return None
    J, multipliers, weight = value.keys("J multipliers weight")
    return LocalBall(J.array(n, n), _multipliers(multipliers, weight, n, n))


def _slab(value: Value, n: int, claim: str) -> Slab:
    middle, end, duration, J, multipliers, weight, path = value.keys("middle end duration J multipliers weight path")
    nodes = middle.array(n, n), end.array(n, n)
    by = _multipliers(multipliers, weight, n, n + (claim == "reached"))
    return Slab(*nodes, duration.binary64(), J.array(n, n), by, _path(path, n, claim))


def _path(value: Value, n: int, claim: str) -> Path | None:
    if claim != "reached":
        value.must(value.raw is None, "null under this claim")
        return None
    centre, *numbers = value.keys("centre share edge motion joint")
    return Path(centre.array(n), *(number.binary64() for number in numbers))


def _multipliers(value: Value, weight: Value, n: int, k: int) -> Multipliers:
    rows = value.array(3, n)
    rest, apart, joint = (tuple(fmpq(*v.as_integer_ratio()) for v in row) for row in rows.tolist())
    return Multipliers(rest, apart, joint, weight.array(k, k))


def _clip(value: Value, m: int) -> tuple[Array, Array] | None:
    if value.raw is None:
        return None
    lo, hi = value.listed(lambda end: end.array(m), 2)
    value.must(bool(np.all(lo < hi)), "lower, then upper ends")
    return lo, hi


def check_hash(policy: Policy, stated: Any) -> None:
    """Rule `hash`."""
    if stated != policy.sha256():
        raise Rejected("hash", "policy.sha256", "does not match the layers in the file")


def _evidence(value: Value, n: int, claim: str) -> Partition | Trusted:
    kinds = ("partition-tree", *(() if claim in WITH_TUBE else ("trusted-solver",)))
    known = isinstance(value.raw, dict) and value.raw.get("kind") in kinds
    value.must(known, f"an object of kind {' or '.join(kinds)}")
    if value.raw["kind"] == "partition-tree":
        _, T, root, tree, local, tube = value.keys("kind T root tree local tube")
        slabs = tube.listed(lambda slab: _slab(slab, n, claim), *((1, MAX_SLABS) if claim in WITH_TUBE else (0, 0)))
        return Partition(T.array(n, n), root.array(n), tree.octets(), _local(local, n, claim), slabs)
    _, solver, version, precision, queries = value.keys("kind solver version precision queries")
    precision.must(precision.binary64() > 0, "positive")
    answers = queries.listed(lambda pair: pair.listed(Value.word, 2), 0, MAX_VALUES)
    return Trusted(solver.word(), version.word(), answers)
