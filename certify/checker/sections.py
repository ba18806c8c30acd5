"""Sections of a document that only some certificates have, and the readers of these: tube, contraction, outer, ranks,
data, a second certificate, and another program's answer."""

from __future__ import annotations

import math
from collections.abc import Mapping, Set
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Annotated, NamedTuple

import numpy as np

from .document import (
    EMPTY,
    MAX_CUTS,
    MAX_ORDER,
    WITH_TUBE,
    Certificate,
    Directions,
    Intervals,
    Order,
    Partition,
    ThreeRows,
    certificate,
    quantity,
)
from .expression import Tape, parse
from .schema import Array, Binary64, Matrix, Octets, Row, Value, section, shaped
from .strict import MAX_VALUES

MAX_SLABS = 10**4
MAX_CONSTRAINTS, MAX_MEMORY = 64, 16
MAX_RANK = 2**16 - 1  # that rank is none
TAKING_OVER = ("asymptotic", "nearby")
MAX_TRANSITIONS, MAX_ROUNDS, MAX_PARTS = 2**16, 64, 4096  # of data; rounds of a part of the priors
MAX_PARAMETERS = 64  # of axes


Faces = Annotated[tuple[bytes, ...], lambda value, sizes: value.listed(Value.octets, 2 * sizes["n"])]
Memory = Annotated[int, lambda value, _: value.integer(1, MAX_MEMORY)]  # in a class it would not find the name


@dataclass(frozen=True)
class OuterTree:
    """A partition tree of the box |z| <= root, x = T z, that contains the domain, and one of each of its faces."""

    T: Matrix
    root: Row
    tree: Octets
    faces: Faces


@dataclass(frozen=True)
class Outer(OuterTree):
    """The function N, an expression's tape, and the level n2 of {N <= n2}, with its evidence."""

    function: Tape
    level: float


@dataclass(frozen=True)
class Contraction:
    """The ball x = J d, ||d|| <= 1, on which trajectories come closer, and on it the weights g of one bound, and the
    weight of another; with kinks, trees of directions; where inputs are held, the order of the series in time."""

    J: Matrix
    weights: Row
    weight: Matrix
    directions: Directions = None
    order: Order = 1


@dataclass(frozen=True)
class Trusted:
    """Evidence that cannot be replayed: a solver's name and version, and its answers as (query, answer)."""

    solver: str
    version: str
    queries: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Path:
    """The centre of a slab's ellipsoid at its end, the share of its ball that the motion takes, and the multipliers of
    the tube's boundary and of the motion."""

    centre: Row
    share: Binary64
    edge: Binary64
    motion: Binary64
    joint: Binary64


def _path(value: Value, sizes: Mapping[str, int]) -> Path | None:
    if sizes["k"] > sizes["n"]:
        return section(value, Path, **sizes)
    value.must(value.raw is None, "null under this claim")
    return None


@dataclass(frozen=True)
class Slab:
    """A piece of the tube up to the node `end`, in its time, with a ball that contains it and multipliers on it."""

    middle: Matrix
    end: Matrix
    duration: Binary64
    J: Matrix
    multipliers: ThreeRows
    weight: Annotated[Array, shaped("k", "k")]
    path: Annotated[Path | None, _path]


@dataclass(frozen=True)
class Tube:
    """An ellipsoid around `centre`, which is None around the origin, and the slabs that lead from it into {V <= c2}."""

    start: Array
    centre: Array | None
    slabs: tuple[Slab, ...]


def _true(value: Value, sizes: Mapping[str, int]) -> bool:
    value.must(value.raw is True, "true")
    return True


@dataclass(frozen=True)
class RankTree:
    """A partition tree of the box lo <= x <= hi, and of each leaf its rank and the number of its steps. `frame` is N of
    the coordinates N x in which errors are bounded, None for the identity; they turn with the errors where they are
    `moving`. Errors stay symbols for `memory` steps."""

    lo: Row
    hi: Row
    tree: Octets
    ranks: Octets
    steps: Octets
    frame: Annotated[Array | None, shaped("n", "n")] = field(default=None, kw_only=True)
    moving: Annotated[bool, _true] = field(default=False, kw_only=True)
    memory: Memory = field(default=1, kw_only=True)

    @property
    def numbers(self) -> tuple[Array, Array]:
        """The ranks and the steps of all leaves: numbers of two bytes, the lower first, of steps also of one."""
        size = "<u2" if len(self.steps) == len(self.ranks) else "u1"
        rank, steps = np.frombuffer(self.ranks, dtype="<u2"), np.frombuffer(self.steps, dtype=size)
        return rank.astype(np.int64), steps.astype(np.int64)


@dataclass(frozen=True)
class Ranks(RankTree):
    """The states that are angles, by their numbers, and the most steps to the target, with the evidence; the order of
    the series in time on its leaves."""

    angles: tuple[int, ...]
    most: int
    order: int


def _box(value: Value, sizes: Mapping[str, int]) -> Intervals:
    return tuple((Fraction(lo), Fraction(hi)) for lo, hi in value.array(2, sizes["K"]).T.tolist())


@dataclass(frozen=True)
class Round:
    """A box that holds the rest of another, by weights of all transitions."""

    box: Annotated[Intervals, _box]
    weights: Annotated[Array, shaped(2, "K", "T", "n")]


def _rounds(value: Value, sizes: Mapping[str, int]) -> tuple[Round, ...]:
    return value.listed(lambda each: section(each, Round, **sizes), 0, MAX_ROUNDS)


def _leaves(value: Value, sizes: Mapping[str, int]) -> tuple[tuple[Round, ...], ...]:
    return value.listed(lambda leaf: _rounds(leaf, sizes), 1, MAX_PARTS)


def _pieces(value: Value, sizes: Mapping[str, int]) -> int:
    return value.integer(1, sizes["pieces"])


@dataclass(frozen=True, kw_only=True)
class Shown:
    """The evidence of data. A transition is followed in so many `pieces`, with a series in time of an `order`. The
    priors are partitioned by a tree; each of its `leaves` has rounds, and so has what these leave of the priors;
    `turned` are weights for the axes, of which there may be none."""

    order: Order
    pieces: Annotated[int, _pieces]
    tree: Octets
    leaves: Annotated[tuple[tuple[Round, ...], ...], _leaves]
    rounds: Annotated[tuple[Round, ...], _rounds]
    turned: Annotated[Array | None, shaped(2, "J", "T", "n")] = None


class Axis(NamedTuple):
    """A quantity `at + sum_k by_k p_k` of the parameters."""

    name: str
    at: Fraction
    by: tuple[Fraction, ...]


@dataclass(frozen=True, kw_only=True)
class Data(Shown):
    """Measurements on which ranges of parameters rest, with the multipliers that show it.

    A run has states (T + 1, n), within `noise` of the true ones, and the inputs (T, m) that are held in between, for a
    time in `period`, or for a step where that is None; measured is `origin` + x. Without `axes` the parameters are
    uncertain quantities of the plant; else those are.
    """

    sha256: str  # of the file that they come from
    parameters: tuple[str, ...]
    priors: Intervals
    axes: tuple[Axis, ...]
    period: tuple[Fraction, Fraction] | None
    origin: tuple[Fraction, ...]
    noise: tuple[Fraction, ...]
    runs: tuple[tuple[Array, Array], ...]

    @property
    def constants(self) -> tuple[str, ...]:
        """The uncertain quantities that the parameters are, or that are sums of these."""
        return tuple(axis.name for axis in self.axes) or self.parameters

    @property
    def transitions(self) -> int:
        return sum(len(inputs) for _, inputs in self.runs)


def completed(
    c: Certificate, said: Mapping[str, Value], shown: Mapping[str, Value], beyond: Set[str], then: Value | None
) -> Certificate:
    """A certificate with the sections that only some have, by the values of its claim (`said`) and of its evidence
    (`shown`); `beyond` are the keys of what the claim has."""
    kind, n = c.claim, len(c.states)
    if "sample" in beyond:
        c = replace(c, sample=_periods(said["sample"]))
        said["sample"].must(not c.discrete and kind not in WITH_TUBE, "null under this claim and time")
    most = MAX_ORDER if c.sample and not c.dynamics.calls else 1
    orders = [c.evidence, c.evidence.local] if isinstance(c.evidence, Partition) else []
    if any(part is not None and part.order > most for part in orders):
        shown["order"].must(False, "1, and that of the ball, where the equations call a network")
    wanted = {"contraction": kind == "nearby", "tube": kind in WITH_TUBE, "outer": "outer" in beyond}
    for key, none in EMPTY.items() if kind != "invariant" else ():
        if key in shown and not wanted[key]:
            shown[key].must(shown[key].raw == none, "null, or empty, where the claim has none")
    if "keep" in beyond:
        c = replace(c, keep=_constraints(said["keep"], (*c.states, *c.inputs, *c.uncertain)))
    if "target" in said:
        c = replace(c, target=_constraints(said["target"], c.states))
    if "outer" in beyond or kind == "invariant":
        c = replace(c, outer=_outer(said["outer"], shown["outer"], c))
    if "ranks" in said:
        order = c.evidence.order if isinstance(c.evidence, Partition) else shown["order"].integer(1, most)
        c = replace(c, ranks=_ranks(said["ranks"], shown["ranks"], c, order))
    if "data" in said:
        c = replace(c, data=_data(said["data"], shown["data"], c))
    if "samples" in said:
        from . import samples

        c = replace(c, samples=samples.read(said["samples"], shown["samples"], c))
    if kind == "nearby":
        close = shown["contraction"]
        c = replace(c, contraction=section(close, Contraction, n=n, order=most))
        close.must(
            ("order" in close.raw) is (c.sample is not None),
            "an object with an order where inputs are held, and only there",
        )
    if kind in WITH_TUBE:
        c = replace(c, tube=_tube(said, shown["tube"], c))
    if "solver" in shown:
        c = replace(c, evidence=_trusted(shown))
    return c if then is None else replace(c, then=_taking_over(c, then))


def _periods(value: Value) -> tuple[Fraction, Fraction]:
    lo, hi = value.listed(Value.rational, 2)
    value.must(0 <= lo <= hi and hi > 0, "two periods, 0 <= lo <= hi and hi > 0")
    return lo, hi


def _constraints(value: Value, names: tuple[str, ...]) -> Tape:
    """Expressions that call no networks."""
    return parse(value.listed(lambda tree: tree.raw, 1, MAX_CONSTRAINTS), names, value.at)


def _outer(claim: Value, evidence: Value, c: Certificate) -> Outer:
    claim.must(c.step == 0 and c.rate == 0 and c.claim not in WITH_TUBE, "null under this claim")
    tree, level = claim.keys("expression level")
    n2 = level.binary64()
    level.must(math.isfinite(n2), "finite")
    function = parse((tree.raw,), c.states, tree.at, {network.name: network for network in c.networks})
    return Outer(**vars(section(evidence, OuterTree, n=len(c.states))), function=function, level=n2)


def _ranks(claim: Value, evidence: Value, c: Certificate, order: int) -> Ranks:
    claim.must(c.step > 0, "missing where time does not go in steps")
    angles, most = claim.keys("angles steps")
    named = angles.listed(lambda name: c.states.index(name.choice(*c.states)), 0, len(c.states))
    angles.must(len(set(named)) == len(named), "different names")
    tree = section(evidence, RankTree, n=len(c.states))
    return Ranks(**vars(tree), angles=named, most=most.integer(1, MAX_RANK - 1), order=order)


def _tube(said: Mapping[str, Value], value: Value, c: Certificate) -> Tube:
    n, moving = len(c.states), c.claim == "reached"
    value.must(c.step == 0, "of another claim where time goes in steps")
    value.must(not (moving and c.uncertain), "of another claim where quantities are uncertain")
    slabs = value.listed(lambda slab: section(slab, Slab, n=n, k=n + moving), 1, MAX_SLABS)
    return Tube(said["start"].array(n, n), said["centre"].array(n) if moving else None, slabs)


def _trusted(shown: Mapping[str, Value]) -> Trusted:
    shown["precision"].must(shown["precision"].binary64() > 0, "positive")
    answers = shown["queries"].listed(lambda pair: pair.listed(Value.word, 2), 0, MAX_VALUES)
    return Trusted(shown["solver"].word(), shown["version"].word(), answers)


def _data(claim: Value, evidence: Value, c: Certificate) -> Data:
    n, m = len(c.states), len(c.inputs)
    claim.must(not c.dynamics.calls, "missing where the equations call a network")
    said = claim.entries("sha256 parameters period origin noise runs", "axes")
    sha256, priors, period, origin, noise, runs = list(said.values())[:6]
    quantities = priors.listed(quantity, 1, MAX_PARAMETERS if "axes" in said else len(c.uncertain))
    names = tuple(name for name, _ in quantities)
    axes = said["axes"].listed(lambda axis: _axis(axis, len(names)), 1, len(c.uncertain)) if "axes" in said else ()
    if axes:
        new = not {*names} & {*c.states, *c.inputs, *c.uncertain} and len({*names}) == len(names)
        priors.must(new, "different names of nothing in the plant, where there are axes")
    constant = tuple(axis.name for axis in axes) or names
    known = {*constant} <= {*c.uncertain} and len({*constant}) == len(constant)
    (said["axes"] if axes else priors).must(known, "different uncertain quantities")
    times = None if period.raw is None else _periods(period)
    positive = times is not None and times[0] > 0
    period.must(positive is not c.discrete and (times is None) is c.discrete, "null in discrete time, else positive")
    measured = runs.listed(lambda run: _run(run, n, m), 1, MAX_TRANSITIONS)
    count = sum(len(inputs) for _, inputs in measured)
    runs.must(count <= MAX_TRANSITIONS, f"of {MAX_TRANSITIONS} transitions at most")
    errors = noise.listed(Value.rational, n)
    noise.must(min(errors) >= 0, "at least 0")
    most = (1, 1) if c.discrete else (MAX_ORDER, MAX_CUTS)
    by = section(evidence, Shown, n=n, K=len(names), J=len(axes), T=count, order=most[0], pieces=most[1])
    evidence.must((by.turned is not None) is bool(axes), "an object with `turned` if the claim has axes, and only then")
    return Data(
        **vars(by),
        axes=axes,
        sha256=sha256.text("[0-9a-f]{64}", "64 hexadecimal digits"),
        parameters=names,
        priors=tuple(pair for _, pair in quantities),
        period=times,
        origin=origin.listed(Value.rational, n),
        noise=errors,
        runs=measured,
    )


def _axis(value: Value, count: int) -> Axis:
    name, at, by = value.keys("name at by")
    return Axis(name.name(), at.rational(), by.listed(Value.rational, count))


def _run(value: Value, n: int, m: int) -> tuple[Array, Array]:
    steps, states, inputs = value.keys("steps states inputs")
    count = steps.integer(1, MAX_TRANSITIONS)
    return states.array(count + 1, n), inputs.array(count, m)


def _taking_over(c: Certificate, value: Value) -> Certificate:
    """The certificate that takes over: by induction on the claim's kind it has none of its own."""
    value.must(c.claim == "practical", "missing under this claim")
    then = certificate(value.raw, c.sha256, value.at, TAKING_OVER)
    for one in (c, then):
        value.must(one.ranks is None, "missing, and without ranks, where a claim has ranks")
        value.must(isinstance(one.evidence, Partition), "missing where evidence is not replayed, and replayed itself")
    return then
