"""The document of a certificate: what FORMAT.md calls sections, declared, and the plain data that they become."""

from __future__ import annotations

import hashlib
import struct
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import schema as s
from . import strict
from .errors import Rejected
from .expression import Tape, parse_dynamics
from .schema import Known

LEVELS = {
    "asymptotic": s.section(local=s.binary64, roa=s.binary64),
    "practical": s.section(floor=s.binary64, roa=s.binary64),
}
MAX_STATES, MAX_LAYERS, MAX_WIDTH = 64, 64, 2**14
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
        for numbers in (*pairs, self.scale, self.offset):
            digest.update(struct.pack(f"<{1 + numbers.ndim}Q", numbers.ndim, *numbers.shape))
            digest.update(numbers.astype("<f8").tobytes())
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
    """The claim and its evidence. Provenance is not kept: nothing may depend on it.

    `levels` are as stated: the inner edge of the ring, which is c1 (`local`) or c0 (`floor`), and c2 (`roa`).
    """

    claim: str

    name: str
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    dynamics: Tape
    u_eq: tuple[Fraction, ...]
    domain: tuple[tuple[Fraction, Fraction], ...]
    input_bounds: tuple[tuple[Fraction, Fraction], ...]
    policy: Policy
    P: Array
    levels: dict[str, float]
    evidence: Partition | Trusted
    sha256: str

    @property
    def c1(self) -> float:
        """The ring's inner edge: c1, or c0 of a practical claim."""
        return self.levels["floor" if self.claim == "practical" else "local"]

    @property
    def c2(self) -> float:
        return self.levels["roa"]


def _plant(stated: dict[str, Any], at: str, known: Known) -> dict[str, Any]:
    names = stated["states"] + stated["inputs"]
    if len(set(names)) != len(names):
        strict.fail(f"{at}.states", "names must differ")
    return stated | {"dynamics": parse_dynamics(stated["dynamics"], names)}


def _shape(value: Any, at: str, known: Known) -> None:
    """[rows, columns] of a layer: the columns are the rows of the layer before, the first ones the states."""
    rows, columns = s.listed(s.anything, 2)(value, at, known)
    if not (type(rows) is type(columns) is int and 1 <= rows <= MAX_WIDTH and columns == known.get("rows", known["n"])):
        strict.fail(at, f"must be [out, {known.get('rows', known['n'])}] with out at most {MAX_WIDTH}")
    known |= {"rows": rows, "columns": columns}


def _policy(stated: dict[str, Any], at: str, known: Known) -> Policy:
    if known["rows"] != known["m"]:
        strict.fail(f"{at}.layers", f"must end in {known['m']} outputs")
    if not np.all(stated["scale"] != 0):
        strict.fail(f"{at}.scale", "must be nonzero")
    if stated["centre"] == "preactivation" and stated["squash"] != "tanh":
        strict.fail(f"{at}.centre", "'preactivation' needs squash 'tanh'")
    weights, biases = (tuple(layer[key] for layer in stated["layers"]) for key in ("weight", "bias"))
    policy = Policy(weights, biases, *(stated[key] for key in ("scale", "offset", "squash", "centre")))
    for failure in hash_of_the_policy(stated["sha256"], policy):
        raise Rejected("hash", *failure)
    return policy


def hash_of_the_policy(stated: Any, policy: Policy) -> list[tuple[str, str]]:
    """Rule `hash`: what is wrong, as (place, detail)."""
    return [] if stated == policy.sha256() else [("policy.sha256", "does not match the layers in the file")]


def _trusted(stated: dict[str, Any], at: str, known: Known) -> Trusted:
    if not stated["precision"] > 0:
        strict.fail(f"{at}.precision", "must be positive")
    return Trusted(stated["solver"], stated["version"], stated["queries"])


_DOCUMENT = s.section(
    schema=s.choice("certify-certificate/2"),
    claim=s.then(
        s.section(kind=s.choice(*LEVELS)), lambda stated, at, known: known.setdefault("claim", stated["kind"])
    ),
    plant=s.then(
        s.section(
            name=s.name,
            states=s.listed(s.name, "n", 1, MAX_STATES),
            inputs=s.listed(s.name, "m", 1, MAX_STATES),
            dynamics=s.listed(s.anything, "n"),
            u_eq=s.listed(s.rational, "m"),
            domain=s.listed(s.interval, "n"),
            input_bounds=s.listed(s.interval, "m"),
        ),
        _plant,
    ),
    policy=s.then(
        s.section(
            squash=s.choice("tanh", "identity"),
            centre=s.choice("output", "preactivation", "none"),
            layers=s.listed(
                s.section(shape=_shape, weight=s.array("rows", "columns"), bias=s.array("rows")), "", 1, MAX_LAYERS
            ),
            scale=s.array("m"),
            offset=s.array("m"),
            sha256=s.anything,
        ),
        _policy,
    ),
    lyapunov=s.section(kind=s.choice("quadratic"), P=s.array("n", "n")),
    levels=lambda value, at, known: LEVELS[known["claim"]](value, at, known),
    evidence=s.by_kind(
        partition_tree=s.then(
            s.section(kind=s.anything, T=s.array("n", "n"), root=s.array("n"), tree=s.base64_bytes),
            lambda stated, at, known: Partition(stated["T"], stated["root"], stated["tree"]),
        ),
        trusted_solver=s.then(
            s.section(
                kind=s.anything,
                solver=s.word,
                version=s.word,
                precision=s.binary64,
                queries=s.listed(s.listed(s.word, 2)),
            ),
            _trusted,
        ),
    ),
    provenance=s.mapping,
)


def read(path: str) -> Certificate:
    """Read and validate the file at `path`; raises `Unreadable`, or `Rejected` under rule `format` or `hash`."""
    return certificate(*strict.load(path))


def certificate(data: Any, sha256: str) -> Certificate:
    """A JSON value as a certificate."""
    top = _DOCUMENT(data, "", {})
    return Certificate(
        claim=top["claim"],
        **top["plant"],
        policy=top["policy"],
        P=top["lyapunov"]["P"],
        levels=top["levels"],
        evidence=top["evidence"],
        sha256=sha256,
    )
