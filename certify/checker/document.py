"""The document of a certificate: FORMAT.md's sections, read into plain data."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import numpy as np
from flint import fmpq
from numpy.typing import NDArray

from .errors import Rejected
from .expression import Tape, parse
from .networks import Network, hashed
from .networks import read as read_networks
from .schema import Value
from .strict import load

if TYPE_CHECKING:
    from .sections import Contraction, Data, Outer, OuterTree, Ranked, Ranks, Slab, Trusted

MAX_STATES = 64
MAX_CELLS, MAX_CUTS = 4096, 64  # of the box of uncertain quantities in all, and of one range
CLAIMS = ("asymptotic", "practical", "nearby", "enlarged", "reached", "reaches", "invariant")
PLAIN = ("asymptotic", "practical")
WITHOUT_V = ("reaches", "invariant")
PRACTICAL = ("practical", "nearby")
Array = NDArray[np.float64]
Intervals = tuple[tuple[Fraction, Fraction], ...]


@dataclass(frozen=True)
class Policy:
    """The policy as stated in the file: exact binary64 numbers."""

    network: Network
    scale: Array
    offset: Array
    squash: str
    centre: str
    clip: tuple[Array, Array] | None = None  # lo, hi
    origin: Array | None = None  # the network reads origin + x; None for 0

    def sha256(self) -> str:
        """Hash of squash, centre, then each array."""
        arrays = [array for step in self.network.steps for array in step.arrays]
        heading = f"certify-policy/1\0{self.squash}\0{self.centre}\0"
        return hashed(heading, (*arrays, self.scale, self.offset, *(self.clip or ())), self.network.words())


@dataclass(frozen=True)
class Multipliers:
    """alpha, beta and g of the inequality `decrease`, n of each, and `weight`, (k, k), from which the others follow."""

    rest: tuple[fmpq, ...]
    apart: tuple[fmpq, ...]
    joint: tuple[fmpq, ...]
    weight: Array


@dataclass(frozen=True)
class LocalBall:
    """The ball x = J d, ||d|| <= 1, and multipliers on it, the one of V - c0 among them; the order of the series in
    time there; with kinks, trees of directions."""

    J: Array
    multipliers: Multipliers
    edge: float
    order: int
    directions: tuple[bytes, ...] | None = None


@dataclass(frozen=True)
class Partition:
    """Evidence that is replayed: a partition tree of the box |z| <= root, x = T z; the local ball; the tube's slabs."""

    T: Array
    root: Array
    tree: bytes
    order: int  # of the series in time on leaves
    cells: tuple[int, ...]  # number of parts of each uncertain quantity's range
    local: LocalBall | None
    contraction: Contraction | None = None
    tube: tuple[Slab, ...] = ()
    outer: OuterTree | None = None


@dataclass(frozen=True)
class Certificate:
    """The claim and its evidence. Provenance is not kept: nothing may depend on it.

    `levels` are as stated: c0 (`floor`) of a practical claim, the inner edge of the ring c1 (`local`), and c2 (`roa`);
    a claim without V has none, and its P no entries.
    """

    claim: str
    name: str
    discrete: bool
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    uncertain: tuple[str, ...]
    ranges: Intervals  # of the uncertain quantities
    dynamics: Tape
    u_eq: tuple[Fraction, ...]
    domain: Intervals
    input_bounds: Intervals
    networks: tuple[Network, ...]
    policy: Policy
    evidence: Partition | Trusted | Ranked | OuterTree
    sha256: str
    P: Array = field(default_factory=lambda: np.zeros((0, 0)))
    levels: Mapping[str, float] = field(default_factory=dict)
    rate: float = 0.0
    sample: tuple[Fraction, Fraction] | None = None  # the least and the largest period over which the input is held
    start: Array | None = None  # P_0 of a claim with a tube
    centre: Array | None = None  # c_0 of a claim whose tube follows a path
    outer: Outer | None = None  # whose set trajectories leave into {V <= c2} only; never, if there is no V
    ranks: Ranks | None = None  # of the leaves from which trajectories reach the target
    target: Tape | None = None  # whose outputs are at most 0 there; None if the target is {V <= c2}
    keep: Tape | None = None  # whose outputs stay negative
    data: Data | None = None  # with which the uncertain parameters are consistent
    then: Certificate | None = None  # that takes over where a practical claim ends

    @property
    def practical(self) -> bool:
        return self.claim in PRACTICAL

    @property
    def without_V(self) -> bool:
        return self.claim in WITHOUT_V

    @property
    def c0(self) -> float:
        """The level that a practical claim ends at; 0 of other claims."""
        return self.levels.get("floor", 0.0)

    @property
    def c1(self) -> float:
        """The ring's inner edge."""
        return self.levels["local"]

    @property
    def c2(self) -> float:
        return self.levels["roa"]

    @property
    def step(self) -> Fraction:
        """h where it stands by itself: the longest period, 1 in discrete time, 0 where time does not go in steps."""
        return self.sample[1] if self.sample else Fraction(int(self.discrete))


def read(path: str) -> Certificate:
    """Read and validate the file at `path`; raises `Unreadable`, or `Rejected` under rule `format` or `hash`."""
    return certificate(*load(path))


def certificate(data: Any, sha256: str, at: str = "", kinds: tuple[str, ...] = CLAIMS) -> Certificate:
    """A JSON value at a place of the file as a certificate, whose claim is of one of these kinds."""
    whole = Value(data, at)
    keys = f"schema claim networks plant policy lyapunov levels evidence provenance{whole.maybe('then')}"
    schema, claim, functions, plant, policy, lyapunov, levels, evidence, provenance, *then = whole.keys(keys)
    schema.choice("certify-certificate/9")
    known = isinstance(claim.raw, dict) and claim.raw.get("kind") in kinds
    claim.must(known, f"an object of kind {' or '.join(kinds)}")
    kind = claim.raw["kind"]
    whole.must(not then or kind == "practical", "without `then` under this claim")
    networks = read_networks(functions)
    stated = _plant(plant, networks)
    n, m = len(stated["states"]), len(stated["inputs"])
    stated["policy"] = _policy(policy, networks, n, m, kind in PRACTICAL)
    stated["networks"], stated["sha256"] = tuple(networks.values()), sha256
    provenance.must(isinstance(provenance.raw, dict), "an object")
    if kind in WITHOUT_V:
        from . import sections

        read_rest = sections.reaching if kind == "reaches" else sections.staying
        return read_rest(stated, claim, lyapunov, levels, evidence)
    c = _attracting(stated, claim, lyapunov, levels, evidence)
    if then:
        from . import sections

        return replace(c, then=sections.taking_over(c, then[0]))
    return c


def _attracting(stated: dict[str, Any], claim: Value, lyapunov: Value, levels: Value, evidence: Value) -> Certificate:
    """The rest of a certificate with V."""
    n, kind, plain = len(stated["states"]), claim.raw["kind"], {"kind", "rate", "sample", "outer"}
    more, besides = dict[str, Any](), dict[str, Value]()  # what only some claims have
    if kind in PLAIN and {*claim.raw} <= plain and claim.raw.get("sample") is claim.raw.get("outer") is None:
        _, rate, *_ = claim.keys("kind rate sample outer")
    else:
        from . import sections

        rate, more, besides = sections.of_claim(claim, stated)
    fall = rate.binary64()
    rate.must(0 <= fall < math.inf, "0, or a rate where a claim may have one")
    form, P = lyapunov.keys("kind P")
    form.choice("quadratic")
    edges = (*(("floor",) if kind in PRACTICAL else ()), "local", "roa")
    numbers = {edge: level.binary64() for edge, level in zip(edges, levels.keys(" ".join(edges)), strict=True)}
    by_tree = _evidence(evidence, stated, kind, {**more, **besides, "rate": fall})
    if besides:
        from . import sections

        more |= sections.beside(besides, evidence, stated, more["sample"])
    return Certificate(kind, **stated, **more, evidence=by_tree, P=P.array(n, n), levels=numbers, rate=fall)


def _plant(plant: Value, networks: Mapping[str, Network]) -> dict[str, Any]:
    keys = "name time states inputs uncertain dynamics u_eq domain input_bounds"
    name, time, *names, uncertain, dynamics, u_eq, domain, bounds = plant.keys(keys)
    states, inputs = (value.listed(Value.name, 1, MAX_STATES) for value in names)
    quantities = uncertain.listed(quantity, 0, MAX_STATES)
    n, m, others = len(states), len(inputs), tuple(other for other, _ in quantities)
    everything = states + inputs + others
    plant.must(len(set(everything)) == len(everything), "a plant in which no name stands for two things")
    return {
        "name": name.name(),
        "discrete": time.choice("continuous", "discrete") == "discrete",
        "states": states,
        "inputs": inputs,
        "uncertain": others,
        "ranges": tuple(interval for _, interval in quantities),
        "dynamics": parse(dynamics.listed(lambda tree: tree.raw, n), everything, dynamics.at, networks),
        "u_eq": u_eq.listed(Value.rational, m),
        "domain": domain.listed(Value.interval, n),
        "input_bounds": bounds.listed(Value.interval, m),
    }


def quantity(value: Value) -> tuple[str, tuple[Fraction, Fraction]]:
    name, interval = value.keys("name range")
    return name.name(), interval.interval()


def _policy(value: Value, networks: Mapping[str, Network], n: int, m: int, practical: bool) -> Policy:
    names = "network squash centre scale offset clip origin sha256"
    named, squash, centre, scale, offset, clip, origin, sha256 = value.keys(names)
    network = networks.get(named.name())
    named.must(network is not None and (network.reads, network.gives) == (n, m), f"a network from {n} to {m} numbers")
    words = squash.choice("tanh", "identity"), centre.choice("output", "preactivation", "none")
    centre.must(words != ("identity", "preactivation"), "another where squash is not 'tanh'")
    at = origin.array(n)
    moved = bool(np.any(at != 0))
    origin.must(not moved or (practical and words[1] == "none"), "0 under this claim and centring")
    policy = Policy(networks[named.raw], scale.array(m), offset.array(m), *words, _clip(clip, m), at if moved else None)
    scale.must(bool(np.all(policy.scale != 0)), "nonzero")
    check_hash(policy, sha256.raw)
    return policy


def _local(value: Value, n: int, claim: str, most: int) -> LocalBall | None:
    if claim in PRACTICAL and value.raw is None:
        return None
    names = f"J multipliers weight edge order{value.maybe('directions')}"
    J, multipliers, weight, edge, order, *directions = value.keys(names)
    k = edge.binary64()
    edge.must(0 <= k < math.inf and (k == 0 or claim in PRACTICAL), "0, or a multiplier under a practical claim")
    trees = None
    if directions:
        from .sections import trees_of

        trees = trees_of(directions, n)
    return LocalBall(J.array(n, n), multipliers_of(multipliers, weight, n, n), k, order.integer(1, most), trees)


def multipliers_of(value: Value, weight: Value, n: int, k: int) -> Multipliers:
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
        raise Rejected("hash", "policy.sha256", "does not match the network in the file")


def _evidence(value: Value, stated: Mapping[str, Any], claim: str, more: Mapping[str, Any]) -> Partition | Trusted:
    """The evidence of a claim that has more."""
    n, k, most = len(stated["states"]), len(stated["uncertain"]), 1
    if not isinstance(value.raw, dict) or value.raw.get("kind") != "partition-tree":
        from . import sections

        plain = claim in PLAIN and not (k or stated["discrete"] or any(v is not None and v != 0 for v in more.values()))
        return sections.read_trusted(value, plain)
    keys = "kind T root tree order cells local contraction tube outer"
    if claim not in PLAIN or more.keys() != {"rate"}:
        from . import sections

        most, keys = sections.most_order(stated, more["sample"]), keys + sections.keys_of(more)
    _, T, root, tree, order, cells, local, contraction, tube, beyond, *_ = value.keys(keys)
    cuts = cells.listed(lambda cut: cut.integer(1, MAX_CUTS), k)
    cells.must(math.prod(cuts) <= MAX_CELLS, f"{MAX_CELLS} parts in all")
    ball, by_boxes = (
        _local(local, n, claim, most),
        (T.array(n, n), root.array(n), tree.octets(), order.integer(1, most)),
    )
    if contraction.raw is None and tube.raw == [] and beyond.raw is None and claim in PLAIN and not more.get("outer"):
        return Partition(*by_boxes, cuts, ball)
    from . import sections

    return Partition(*by_boxes, cuts, ball, *sections.others(claim, n, k, most, contraction, tube, beyond, more))
