"""Sections of a document that only some certificates have, and the readers of these: tube, outer, ranks, data, a second
certificate, and the claims without V."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

from .document import (
    MAX_CUTS,
    Array,
    Certificate,
    Intervals,
    Multipliers,
    Partition,
    certificate,
    multipliers_of,
    quantity,
)
from .expression import Tape, parse
from .networks import Network
from .schema import Value
from .strict import MAX_VALUES

MAX_SLABS = 10**4
MAX_ORDER = 8  # of a series in time
MAX_CONSTRAINTS, MAX_RANK = 64, 2**16 - 1  # that rank is none
TAKING_OVER = ("asymptotic", "nearby")
WITH_TUBE = ("enlarged", "reached")
MAX_TRANSITIONS, MAX_ROUNDS, MAX_PARTS = 2**16, 64, 4096  # of data; rounds of a part of the priors


@dataclass(frozen=True)
class Outer:
    """The function N, an expression's tape, and the level n2 of {N <= n2}."""

    function: Tape
    level: float


@dataclass(frozen=True)
class Contraction:
    """The ball x = J d, ||d|| <= 1, on which trajectories come closer, and on it the weights g of one bound, and the
    weight of another; with kinks, trees of directions; where inputs are held, the order of the series in time."""

    J: Array
    weights: Array
    weight: Array
    directions: tuple[bytes, ...] | None = None
    order: int = 1


@dataclass(frozen=True)
class OuterTree:
    """A partition tree of the box |z| <= root, x = T z, that contains the domain, and one of each of its faces."""

    T: Array
    root: Array
    tree: bytes
    faces: tuple[bytes, ...]


@dataclass(frozen=True)
class Ranked:
    """Evidence by ranks alone, of a claim without V; the order of the series in time on leaves."""

    order: int


@dataclass(frozen=True)
class Trusted:
    """Evidence that cannot be replayed: a solver's name and version, and its answers as (query, answer)."""

    solver: str
    version: str
    queries: tuple[tuple[str, ...], ...]


def of_claim(claim: Value, stated: dict[str, Any]) -> tuple[Value, dict[str, Any], dict[str, Value]]:
    """The rate, what else a claim with V states, and what stands in the evidence too."""
    kind, discrete = claim.raw["kind"], stated["discrete"]
    stated_of = {"enlarged": "start", "reached": "start centre"}.get(kind, "").split()
    may_be = "".join(map(claim.maybe, ("keep",) if kind in WITH_TUBE else ("ranks", "keep", "data")))
    _, rate, sample, beyond, *more = claim.keys(" ".join(("kind rate sample outer", *stated_of)) + may_be)
    of_tube, others = more[: len(stated_of)], more[len(stated_of) :]
    besides = dict(zip(may_be.split(), others, strict=True))
    fall, periods, n = rate.binary64(), periods_of(sample), len(stated["states"])
    rate.must(fall == 0 or kind not in WITH_TUBE, "0, or a rate where a claim may have one")
    plain = periods is None and not discrete
    sample.must(plain or kind not in WITH_TUBE, "null, and the plant continuous, under this claim")
    sample.must(periods is None or not discrete, "null where time is discrete")
    outer = None
    if beyond.raw is not None:
        outer = read_outer(beyond, stated["states"], {net.name: net for net in stated["networks"]})
    beyond.must(outer is None or (plain and fall == 0 and kind not in WITH_TUBE), "null under this claim")
    found = {
        "sample": periods,
        "outer": outer,
        "start": of_tube[0].array(n, n) if of_tube else None,
        "centre": of_tube[1].array(n) if kind == "reached" else None,
        "keep": kept([besides.pop("keep")] if "keep" in besides else [], stated),
    }
    return rate, found, besides


def beside(
    besides: Mapping[str, Value], evidence: Value, stated: Mapping[str, Any], periods: tuple[Fraction, Fraction] | None
) -> dict[str, Any]:
    """Ranks and data, of claim and evidence."""
    found = dict[str, Any]()
    if "ranks" in besides:
        n = len(stated["states"])
        found["ranks"] = read_ranks(besides["ranks"], evidence.entry("ranks"), n, stated, periods)
    if "data" in besides:
        found["data"] = read_data(besides["data"], evidence.entry("data"), stated)
    return found


def keys_of(more: Mapping[str, Any]) -> str:
    """The keys of evidence for what a claim has more."""
    return "".join(f" {name}" for name in ("ranks", "data") if name in more)


def read_trusted(value: Value, may_be: bool) -> Trusted:
    kinds = ("partition-tree", *(("trusted-solver",) if may_be else ()))
    known = isinstance(value.raw, dict) and value.raw.get("kind") in kinds
    value.must(known, f"an object of kind {' or '.join(kinds)}")
    _, solver, version, precision, queries = value.keys("kind solver version precision queries")
    precision.must(precision.binary64() > 0, "positive")
    answers = queries.listed(lambda pair: pair.listed(Value.word, 2), 0, MAX_VALUES)
    return Trusted(solver.word(), version.word(), answers)


def others(
    claim: str, n: int, k: int, most: int, contraction: Value, tube: Value, beyond: Value, more: Mapping[str, Any]
) -> tuple[Contraction | None, tuple[Slab, ...], OuterTree | None]:
    """The other parts of evidence for a claim, where k quantities are uncertain and `most` is the largest order."""
    outer = more.get("outer")
    tube.must(k == 0 or claim not in WITH_TUBE, "of another claim where quantities are uncertain")
    slabs = tube.listed(lambda slab: read_slab(slab, n, claim), *((1, MAX_SLABS) if claim in WITH_TUBE else (0,)))
    close = _contraction(contraction, n, claim, most if more.get("sample") else 0)
    beyond.must(outer is not None or beyond.raw is None, "null where the claim has none")
    return close, slabs, None if outer is None else read_outer_tree(beyond, n)


def _contraction(value: Value, n: int, claim: str, most: int) -> Contraction | None:
    """With an order, `most` at most, where inputs are held; else that is 0."""
    if claim != "nearby":
        value.must(value.raw is None, "null under this claim")
        return None
    ordered = " order" if most else ""
    J, weights, weight, *others = value.keys(f"J weights weight{ordered}{value.maybe('directions')}")
    order = others.pop(0).integer(1, most) if most else 1
    return Contraction(J.array(n, n), weights.array(n), weight.array(n, n), trees_of(others, n), order)


def trees_of(found: list[Value], n: int) -> tuple[bytes, ...] | None:
    """Trees of directions, if they are stated."""
    if not found:
        return None
    found[0].must(found[0].raw == [] or isinstance(found[0].raw, list), "a list")
    return found[0].listed(Value.octets, 2 * n) if found[0].raw else ()


def periods_of(value: Value) -> tuple[Fraction, Fraction] | None:
    if value.raw is None:
        return None
    lo, hi = value.listed(Value.rational, 2)
    value.must(0 <= lo <= hi and hi > 0, "two periods, 0 <= lo <= hi and hi > 0")
    return lo, hi


def most_order(stated: Mapping[str, Any], periods: tuple[Fraction, Fraction] | None) -> int:
    return MAX_ORDER if periods is not None and not stated["dynamics"].calls else 1


def kept(values: Sequence[Value], stated: Mapping[str, Any]) -> Tape | None:
    """The constraints, if the claim has any."""
    names = (*stated["states"], *stated["inputs"], *stated["uncertain"])
    return constraints(values[0], names) if values else None


def constraints(value: Value, names: tuple[str, ...]) -> Tape:
    """Expressions that call no networks."""
    return parse(value.listed(lambda tree: tree.raw, 1, MAX_CONSTRAINTS), names, value.at)


def taking_over(c: Certificate, value: Value) -> Certificate:
    """The certificate that takes over: by induction on the claim's kind it has none of its own."""
    then = certificate(value.raw, c.sha256, value.at, TAKING_OVER)
    for one in (c, then):
        value.must(one.ranks is None, "missing, and without ranks, where a claim has ranks")
        value.must(isinstance(one.evidence, Partition), "missing where evidence is not replayed, and replayed itself")
    return then


def staying(stated: dict[str, Any], claim: Value, lyapunov: Value, levels: Value, evidence: Value) -> Certificate:
    """The rest of a certificate for a set that is not left."""
    n, networks = len(stated["states"]), {net.name: net for net in stated["networks"]}
    _, beyond, *others = claim.keys(f"kind outer{claim.maybe('keep')}")
    claim.must(not stated["discrete"], "another where time is discrete")
    beyond.must(beyond.raw is not None, "an object under this claim")
    lyapunov.must(lyapunov.raw is None, "null under this claim")
    levels.keys("")
    kind, tree = evidence.keys("kind outer")
    kind.choice("outer")
    outer, keep = read_outer(beyond, stated["states"], networks), kept(others, stated)
    return Certificate("invariant", **stated, evidence=read_outer_tree(tree, n), outer=outer, keep=keep)


def reaching(stated: dict[str, Any], claim: Value, lyapunov: Value, levels: Value, evidence: Value) -> Certificate:
    """The rest of a certificate for a region that is reached."""
    n, names = len(stated["states"]), stated["states"]
    _, sample, target, ranks, *others = claim.keys(f"kind sample target ranks{claim.maybe('keep')}")
    periods = periods_of(sample)
    sample.must(periods is None or not stated["discrete"], "null where time is discrete")
    lyapunov.must(lyapunov.raw is None, "null under this claim")
    levels.keys("")
    kind, order, found = evidence.keys("kind order ranks")
    kind.choice("ranks")
    return Certificate(
        "reaches",
        **stated,
        evidence=Ranked(order.integer(1, most_order(stated, periods))),
        sample=periods,
        ranks=read_ranks(ranks, found, n, stated, periods),
        target=constraints(target, names),
        keep=kept(others, stated),
    )


@dataclass(frozen=True)
class Path:
    """The centre of a slab's ellipsoid at its end, the share of its ball that the motion takes, and the multipliers of
    the tube's boundary and of the motion."""

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
class Ranks:
    """The states that are angles, by their numbers, and the most steps to the target; as evidence a partition tree of
    the box lo <= x <= hi, and of each leaf its rank and the number of its steps."""

    angles: tuple[int, ...]
    most: int
    lo: Array
    hi: Array
    tree: bytes
    ranks: bytes
    steps: bytes


@dataclass(frozen=True)
class Round:
    """A box that holds the rest of another, by weights (2, K, T, n) of all transitions."""

    box: Intervals
    weights: Array


@dataclass(frozen=True)
class Data:
    """Measurements on which ranges of parameters rest, and multipliers that show it.

    A run has states (T + 1, n), within `noise` of the true ones, and the inputs (T, m) that are held in between, for a
    time in `period`, or for a step where that is None; measured is `origin` + x. A transition is followed in so many
    `pieces`, with a series in time of an `order`. The priors are partitioned by a tree; each of its `leaves` has
    rounds, and so has what these leave of the priors.
    """

    sha256: str  # of the file that they come from
    parameters: tuple[str, ...]
    priors: Intervals
    period: tuple[Fraction, Fraction] | None
    origin: tuple[Fraction, ...]
    noise: tuple[Fraction, ...]
    runs: tuple[tuple[Array, Array], ...]
    order: int
    pieces: int
    tree: bytes
    leaves: tuple[tuple[Round, ...], ...]
    rounds: tuple[Round, ...]

    @property
    def transitions(self) -> int:
        return sum(len(inputs) for _, inputs in self.runs)


def read_data(claim: Value, evidence: Value, stated: Mapping[str, Any]) -> Data:
    n, m, discrete = len(stated["states"]), len(stated["inputs"]), stated["discrete"]
    claim.must(not stated["dynamics"].calls, "missing where the equations call a network")
    sha256, priors, period, origin, noise, runs = claim.keys("sha256 parameters period origin noise runs")
    quantities = priors.listed(quantity, 1, len(stated["uncertain"]))
    names = tuple(name for name, _ in quantities)
    priors.must({*names} <= {*stated["uncertain"]} and len({*names}) == len(names), "different uncertain quantities")
    times = periods_of(period)
    period.must((times is None) is discrete and (times is None or times[0] > 0), "null in discrete time, else positive")
    measured = runs.listed(lambda run: _run(run, n, m), 1, MAX_TRANSITIONS)
    count = sum(len(inputs) for _, inputs in measured)
    runs.must(count <= MAX_TRANSITIONS, f"of {MAX_TRANSITIONS} transitions at most")
    errors = noise.listed(Value.rational, n)
    noise.must(min(errors) >= 0, "at least 0")
    order, pieces, tree, leaves, rounds = evidence.keys("order pieces tree leaves rounds")

    def read_rounds(value: Value) -> tuple[Round, ...]:
        return value.listed(lambda each: _round(each, len(names), count, n), 0, MAX_ROUNDS)

    return Data(
        sha256.text("[0-9a-f]{64}", "64 hexadecimal digits"),
        names,
        tuple(pair for _, pair in quantities),
        times,
        origin.listed(Value.rational, n),
        errors,
        measured,
        order.integer(1, 1 if discrete else MAX_ORDER),
        pieces.integer(1, 1 if discrete else MAX_CUTS),
        tree.octets(),
        leaves.listed(read_rounds, 1, MAX_PARTS),
        read_rounds(rounds),
    )


def _round(value: Value, K: int, T: int, n: int) -> Round:
    box, weights = value.keys("box weights")
    lo, hi = box.array(2, K).tolist()
    return Round(tuple(zip(map(Fraction, lo), map(Fraction, hi), strict=True)), weights.array(2, K, T, n))


def _run(value: Value, n: int, m: int) -> tuple[Array, Array]:
    steps, states, inputs = value.keys("steps states inputs")
    count = steps.integer(1, MAX_TRANSITIONS)
    return states.array(count + 1, n), inputs.array(count, m)


def read_ranks(
    claim: Value,
    evidence: Value,
    n: int,
    stated: Mapping[str, Any],
    periods: tuple[Fraction, Fraction] | None,
) -> Ranks:
    claim.must(stated["discrete"] or periods is not None, "missing where time does not go in steps")
    angles, most = claim.keys("angles steps")
    states = stated["states"]
    named = angles.listed(lambda name: states.index(name.choice(*states)), 0, n)
    angles.must(len(set(named)) == len(named), "different names")
    lo, hi, tree, ranks, steps = evidence.keys("lo hi tree ranks steps")
    octets = tree.octets(), ranks.octets(), steps.octets()
    return Ranks(named, most.integer(1, MAX_RANK - 1), lo.array(n), hi.array(n), *octets)


def read_slab(value: Value, n: int, claim: str) -> Slab:
    middle, end, duration, J, multipliers, weight, path = value.keys("middle end duration J multipliers weight path")
    nodes = middle.array(n, n), end.array(n, n)
    by = multipliers_of(multipliers, weight, n, n + (claim == "reached"))
    return Slab(*nodes, duration.binary64(), J.array(n, n), by, _path(path, n, claim))


def _path(value: Value, n: int, claim: str) -> Path | None:
    if claim != "reached":
        value.must(value.raw is None, "null under this claim")
        return None
    centre, *numbers = value.keys("centre share edge motion joint")
    return Path(centre.array(n), *(number.binary64() for number in numbers))


def read_outer(value: Value, states: tuple[str, ...], networks: Mapping[str, Network]) -> Outer:
    tree, level = value.keys("expression level")
    n2 = level.binary64()
    level.must(math.isfinite(n2), "finite")
    return Outer(parse((tree.raw,), states, tree.at, networks), n2)


def read_outer_tree(value: Value, n: int) -> OuterTree:
    T, root, tree, faces = value.keys("T root tree faces")
    return OuterTree(T.array(n, n), root.array(n), tree.octets(), faces.listed(Value.octets, 2 * n))
