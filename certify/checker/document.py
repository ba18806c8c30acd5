"""The document of a certificate: FORMAT.md's sections, read into plain data."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from .errors import Rejected
from .expression import Tape, parse
from .networks import Network, hashed
from .networks import read as read_networks
from .schema import Array, Binary64, Matrix, Value, section, shaped
from .strict import load

if TYPE_CHECKING:
    from .samples import Samples
    from .sections import Contraction, Data, Outer, Ranks, Trusted, Tube

MAX_STATES = 64
MAX_ORDER = 8  # of a series in time
MAX_CELLS, MAX_CUTS = 4096, 64  # of the box of uncertain quantities in all, and of one range
PLAIN, WITH_TUBE = ("asymptotic", "practical"), ("enlarged", "reached")
PRACTICAL, WITHOUT_V = ("practical", "nearby"), ("reaches", "remains", "invariant")
JUMPING = ("reaches", "remains")  # claims of which equations may jump, in discrete time
CLAIMS = {  # the keys of each claim, and those that may be missing
    **dict.fromkeys((*PLAIN, "nearby"), ("rate sample outer", "ranks keep data samples")),
    "enlarged": ("rate sample outer start", "keep data"),
    "reached": ("rate sample outer start centre", "keep"),
    "reaches": ("sample target ranks", "keep"),
    "remains": ("sample ranks", "keep"),
    "invariant": ("outer", "keep"),
}
EVIDENCE = {  # the keys of each kind of evidence
    "partition-tree": "T root tree order cells local contraction tube outer",
    "trusted-solver": "solver version precision queries",
    "ranks": "order ranks",
    "outer": "outer",
}
EMPTY: dict[str, Any] = {"contraction": None, "tube": [], "outer": None}  # of evidence where the claim has nothing
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


def _trees(value: Value, sizes: Mapping[str, int]) -> tuple[bytes, ...]:
    return value.listed(Value.octets, 2 * sizes["n"] if value.raw else 0)


ThreeRows = Annotated[Array, shaped(3, "n")]  # alpha, beta and g of the inequality `decrease`
Order = Annotated[int, lambda value, sizes: value.integer(1, sizes["order"])]
Directions = Annotated[tuple[bytes, ...] | None, _trees]


@dataclass(frozen=True)
class LocalBall:
    """The ball x = J d, ||d|| <= 1, and multipliers on it, the one of V - c0 among them; the order of the series in
    time there; with kinks, trees of directions."""

    J: Matrix
    multipliers: ThreeRows
    weight: Matrix
    edge: Binary64
    order: Order
    directions: Directions = None


@dataclass(frozen=True)
class Partition:
    """Evidence that is replayed: a partition tree of the box |z| <= root, x = T z; the local ball."""

    T: Array
    root: Array
    tree: bytes
    order: int  # of the series in time on leaves
    cells: tuple[int, ...]  # number of parts of each uncertain quantity's range
    local: LocalBall | None


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
    sha256: str
    evidence: Partition | Trusted | None = None  # None without V
    P: Array = field(default_factory=lambda: np.zeros((0, 0)))
    levels: Mapping[str, float] = field(default_factory=dict)
    rate: float = 0.0
    sample: tuple[Fraction, Fraction] | None = None  # the least and the largest period over which the input is held
    tube: Tube | None = None  # an ellipsoid from which trajectories lead into {V <= c2}
    contraction: Contraction | None = None  # a ball on which they come closer
    outer: Outer | None = None  # whose set trajectories leave into {V <= c2} only; never, if there is no V
    ranks: Ranks | None = None  # of the leaves from which trajectories reach the target
    target: Tape | None = None  # whose outputs are at most 0 there; None if the target is {V <= c2}, or nothing
    keep: Tape | None = None  # whose outputs stay negative
    data: Data | None = None  # with which the uncertain parameters are consistent
    samples: Samples | None = None  # of functions that equations stand for
    then: Certificate | None = None  # that takes over where a practical claim ends

    @property
    def practical(self) -> bool:
        return self.claim in PRACTICAL

    @property
    def without_V(self) -> bool:
        return self.claim in WITHOUT_V

    @property
    def comparisons(self) -> int:
        """The number of operations of constraints and of the target."""
        return sum(tape.size for tape in (self.keep, self.target) if tape is not None)

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


def certificate(data: Any, sha256: str, at: str = "", kinds: Sequence[str] = tuple(CLAIMS)) -> Certificate:
    """A JSON value at a place of the file as a certificate, whose claim is of one of these kinds."""
    keys = "schema claim networks plant policy lyapunov levels evidence provenance"
    whole = Value(data, at).entries(keys, "then")
    whole["schema"].choice("certify-certificate/9")
    whole["provenance"].must(isinstance(whole["provenance"].raw, dict), "an object")
    kind, networks = whole["claim"].kind(kinds), read_networks(whole["networks"])
    plant = _plant(whole["plant"], networks, kind in JUMPING)
    n, m = len(plant["states"]), len(plant["inputs"])
    policy = _policy(whole["policy"], networks, n, m, kind in PRACTICAL)
    c = Certificate(kind, **plant, networks=tuple(networks.values()), policy=policy, sha256=sha256)
    said, may_be = whole["claim"].entries(f"kind {CLAIMS[kind][0]}", CLAIMS[kind][1]), CLAIMS[kind][1].split()
    if kind in WITHOUT_V:
        whole["lyapunov"].must(whole["lyapunov"].raw is None, "null under this claim")
        whole["levels"].keys("")
    else:
        c = replace(c, **_of_V(whole["lyapunov"], whole["levels"], said["rate"], c))
    beyond = {*said} - {"kind", "rate"}
    beyond -= {key for key in beyond if said[key].raw is None and key not in may_be}
    by = {"reaches": "ranks", "remains": "ranks", "invariant": "outer"}.get(kind, "partition-tree")
    solved = kind in PLAIN and not (beyond or c.rate or c.discrete or c.uncertain)
    by = whole["evidence"].kind((by, "trusted-solver") if solved else (by,))
    both = ("ranks", "data", "samples") if by == "partition-tree" else ()
    shown = whole["evidence"].entries(" ".join(["kind", EVIDENCE[by], *(key for key in both if key in beyond)]))
    if by == "partition-tree":
        c = replace(c, evidence=_partition(shown, c, MAX_ORDER if "sample" in beyond else 1))
    others = by != "partition-tree" or any(shown[key].raw != none for key, none in EMPTY.items())
    if kind in PLAIN and not (beyond or others or "then" in whole):
        return c
    from . import sections

    return sections.completed(c, said, shown, beyond, whole.get("then"))


def _of_V(lyapunov: Value, levels: Value, rate: Value, c: Certificate) -> dict[str, Any]:
    fall, n = rate.binary64(), len(c.states)
    may_fall = 0 <= fall < math.inf and (fall == 0 or c.claim not in WITH_TUBE)
    rate.must(may_fall, "0, or a rate where a claim may have one")
    form, P = lyapunov.keys("kind P")
    form.choice("quadratic")
    edges = levels.entries("floor local roa" if c.practical else "local roa")
    return {"rate": fall, "P": P.array(n, n), "levels": {edge: level.binary64() for edge, level in edges.items()}}


def _partition(shown: Mapping[str, Value], c: Certificate, most: int) -> Partition:
    """The evidence by a tree and a ball, whose orders are up to `most`."""
    n, cells, local, ball = len(c.states), shown["cells"], shown["local"], None
    cuts = cells.listed(lambda cut: cut.integer(1, MAX_CUTS), len(c.uncertain))
    cells.must(math.prod(cuts) <= MAX_CELLS, f"{MAX_CELLS} parts in all")
    if not (c.practical and local.raw is None):
        ball = section(local, LocalBall, n=n, order=most)
        edge = 0 <= ball.edge < math.inf and (ball.edge == 0 or c.practical)
        Value(None, f"{local.at}.edge").must(edge, "0, or a multiplier under a practical claim")
    of_tree = shown["T"].array(n, n), shown["root"].array(n), shown["tree"].octets(), shown["order"].integer(1, most)
    return Partition(*of_tree, cuts, ball)


def _plant(plant: Value, networks: Mapping[str, Network], jumping: bool) -> dict[str, Any]:
    keys = "name time states inputs uncertain dynamics u_eq domain input_bounds"
    name, time, *names, uncertain, dynamics, u_eq, domain, bounds = plant.keys(keys)
    states, inputs = (value.listed(Value.name, 1, MAX_STATES) for value in names)
    quantities = uncertain.listed(quantity, 0, MAX_STATES)
    n, m, others = len(states), len(inputs), tuple(other for other, _ in quantities)
    everything = states + inputs + others
    plant.must(len(set(everything)) == len(everything), "a plant in which no name stands for two things")
    discrete, trees = time.choice("continuous", "discrete") == "discrete", dynamics.listed(lambda tree: tree.raw, n)
    return {
        "name": name.name(),
        "discrete": discrete,
        "states": states,
        "inputs": inputs,
        "uncertain": others,
        "ranges": tuple(interval for _, interval in quantities),
        "dynamics": parse(trees, everything, dynamics.at, networks, discrete and jumping),
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
