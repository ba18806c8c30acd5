"""Rules `format` and `hash`: the bytes of a file, read as FORMAT.md describes them, every number exact."""

from __future__ import annotations

import hashlib
import json
import math
import re
from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from flint import fmpq, fmpq_mat

from .evidence import (
    INVARIANT,
    REACHES,
    REMAINS,
    WITH_FLOOR,
    WITH_TUBE,
    WITHOUT_V,
    Covering,
    Fitted,
    Ranked,
    Tree,
    Trusted,
    read_evidence,
)
from .expressions import Equations, equations, rational
from .fields import IDENTIFIER, MAX_NAMES, binary64, column, entries, exact, keys, numbers, square
from .networks import Network, packed, read_networks
from .refusal import Refused, require
from .samples import Samples, read_samples

MAX_BYTES, MAX_BYTES_BEYOND_ASCII = 256 * 2**20, 16 * 2**20
MAX_TOKENS = 10**6  # commas and opening brackets
MAX_EXPRESSIONS, MAX_RANK = 64, 65_534  # of `keep` or of `target`; of a leaf that is claimed
MAX_STEPS, SHA256 = 2**16, re.compile(r"[0-9a-f]{64}")  # of all measured runs; of a file of measurements
TAKE_OVER = ("asymptotic", "nearby")
SCHEMA, CLAIMS = "certify-certificate/9", ("asymptotic", *WITH_FLOOR, *WITH_TUBE, *WITHOUT_V)

Interval = tuple[fmpq, fmpq]


@dataclass(frozen=True)
class Plant:
    """`ranges` are those of what is `uncertain`: the claim is meant for every value in all of them.

    `dynamics` are those of xdot, or of the next state where the plant is `discrete`.
    """

    name: str
    discrete: bool
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    dynamics: Equations
    u_eq: tuple[fmpq, ...]
    domain: tuple[Interval, ...]
    input_bounds: tuple[Interval, ...]
    uncertain: tuple[str, ...]
    ranges: tuple[Interval, ...]


@dataclass(frozen=True)
class Policy:
    network: Network
    squash: str
    centre: str
    scale: array[float]
    offset: array[float]
    clip: tuple[array[float], array[float]] | None
    origin: array[float]  # the network reads origin + x
    sha256: str

    def limits(self, j: int) -> tuple[fmpq, fmpq] | None:
        """The interval to which the policy's clip limits input j."""
        return None if self.clip is None else (exact(self.clip[0][j]), exact(self.clip[1][j]))


@dataclass(frozen=True)
class Function:
    """N, of which the claim has the set {N <= level} beside {V <= c2}: an expression in the states."""

    expression: Equations
    level: float


@dataclass(frozen=True)
class Ranks:
    """The statement about boxes with ranks, none of which is above `steps`.

    States that differ by multiples of 2 pi in `angles` are one place.
    """

    angles: tuple[str, ...]
    steps: int


@dataclass(frozen=True)
class Run:
    """A run of so many steps: rows of measured states, one more than of inputs."""

    steps: int
    states: tuple[array[float], ...]
    inputs: tuple[array[float], ...]


@dataclass(frozen=True)
class Axis:
    """An uncertain quantity that is a number `at` and multiples `by` of the parameters."""

    name: str
    at: fmpq
    by: tuple[fmpq, ...]


@dataclass(frozen=True)
class Data:
    """Measurements from which the ranges of some uncertain quantities follow, that are constant: parameters in their
    `priors`, or where there are `axes` these, of parameters that stand nowhere else.

    A measured state is within `noise` of `origin` + x, a transition takes a time in `period`, None in discrete time.
    """

    sha256: str
    parameters: tuple[str, ...]
    priors: tuple[Interval, ...]
    period: Interval | None
    origin: tuple[fmpq, ...]
    noise: tuple[fmpq, ...]
    runs: tuple[Run, ...]
    axes: tuple[Axis, ...]

    @property
    def steps(self) -> int:
        """The number of transitions of all runs."""
        return sum(run.steps for run in self.runs)


@dataclass(frozen=True)
class Certificate:
    """`inner` and `outer`, between which the leaves show that V falls, are c1 and c2; `floor` is c0, if there is one.

    V falls at the `rate` lambda, D + 2 lambda V < 0. With a `sample` inputs are held for a time in this range.
    `start` is P_0 of a claim with a tube, `centre` the column c_0 around which it lies where the tube follows a path.
    `beyond` is the second function of a claim with an outer set, called `outer` in the file. Expressions of `keep` are
    claimed to be negative, those of `target` to become at most 0. With `data` the ranges of some uncertain quantities
    are those that measurements leave, with `samples` some equations stand for functions that nobody wrote down.

    Some claims have no V: P has no entries and its levels are no numbers, so that no rule about V can hold.
    """

    claim: str
    rate: fmpq
    sample: Interval | None
    start: fmpq_mat | None
    centre: fmpq_mat | None
    beyond: Function | None
    ranks: Ranks | None
    keep: Equations | None
    target: Equations | None
    data: Data | None
    plant: Plant
    policy: Policy
    P: fmpq_mat
    floor: float | None
    inner: float
    outer: float
    evidence: Tree | Ranked | Covering | Trusted
    samples: Samples | None = None
    then: Certificate | None = None  # which takes over where this one ends

    @property
    def n(self) -> int:
        return len(self.plant.states)

    @property
    def m(self) -> int:
        return len(self.plant.inputs)

    @property
    def k(self) -> int:
        """The number of uncertain quantities."""
        return len(self.plant.uncertain)

    @property
    def varies(self) -> bool:
        """True if the sampling period has a range."""
        return self.sample is not None and bool(self.sample[0] < self.sample[1])

    @property
    def ends_at_origin(self) -> bool:
        """True if the claim is about the equilibrium at the origin; every model is at rest there."""
        return self.claim not in (*WITH_FLOOR, *WITHOUT_V)

    @property
    def step(self) -> fmpq:
        """h of D = 2 x'PG + h G'PG: the longest period of a sample, 1 in discrete time, else 0."""
        if self.sample is not None:
            return self.sample[1]
        return fmpq(int(self.plant.discrete))


def read(raw: bytes) -> Certificate:
    """The certificate in the bytes of a file, with the one that takes over, if there is one."""
    data = parsed(raw)
    if not (isinstance(data, dict) and "then" in data):
        return read_sections(data, CLAIMS)
    data = dict(data)
    after = data.pop("then")
    c = read_sections(data, ("practical",))
    try:
        then = read_sections(after, TAKE_OVER)
    except Refused as no:
        raise Refused(no.rule, f"then.{no.at}", no.detail) from None
    for one in (c, then):
        plain = isinstance(one.evidence, Tree) and one.ranks is None
        require(plain, "format", "then", "partition trees without ranks were expected on both sides")
    return replace(c, then=then)


def read_sections(value: Any, claims: tuple[str, ...]) -> Certificate:
    """One certificate, in the order of FORMAT.md's sections, with a claim of one of these kinds."""
    sections = ("schema", "claim", "networks", "plant", "policy", "lyapunov", "levels", "evidence", "provenance")
    data = keys(value, "file", *sections)
    require(data["schema"] == SCHEMA, "format", "schema", f"'{SCHEMA}' was expected")
    require(isinstance(data["provenance"], dict), "format", "provenance", "an object was expected")
    said = read_claim(data["claim"])
    claim = str(said["kind"])
    require(claim in claims, "format", "claim.kind", f"one of {', '.join(claims)} was expected with `then`")
    rate, sample = read_rate(said["rate"], claim), read_sample(said["sample"])
    networks = read_networks(data["networks"], "networks")
    plant = read_plant(data["plant"], networks, claim)
    n = len(plant.states)
    fixed = claim != "reached" or not plant.uncertain
    require(fixed, "format", "plant.uncertain", f"nothing may be uncertain with claim '{claim}'")
    continuous = not (claim in WITH_TUBE and plant.discrete)
    require(continuous, "format", "plant.time", f"time must be continuous with claim '{claim}'")
    free = sample is None or not (claim in WITH_TUBE or plant.discrete)
    require(free, "format", "claim.sample", f"null was expected with claim '{claim}', or in discrete time")
    start = square(said["start"], "claim.start", n) if "start" in said else None
    centre = column(said["centre"], "claim.centre", n) if "centre" in said else None
    beyond = None if said["outer"] is None else read_function(said["outer"], plant.states, networks)
    simple = not (claim in WITH_TUBE or rate > 0 or sample is not None or plant.discrete)
    plainly = beyond is None or simple
    require(plainly, "format", "claim.outer", "null was expected with a tube, a rate, a sample and in discrete time")
    timeless = claim != INVARIANT or not plant.discrete
    require(timeless, "format", "plant.time", f"time must be continuous with claim '{claim}'")
    ranks, keep, target = read_more(said, plant)
    measured = read_data(said["data"], plant, claim) if "data" in said else None
    policy = read_policy(data["policy"], networks, n, len(plant.inputs), claim)
    P = read_P(data["lyapunov"], n, claim)
    named_levels = () if claim in WITHOUT_V else ("floor", "local", "roa") if claim in WITH_FLOOR else ("local", "roa")
    levels = keys(data["levels"], "levels", *named_levels)
    *floor, inner, outer = [binary64(levels[name], f"levels.{name}") for name in named_levels] or [math.nan] * 2
    least = floor[0] if floor else None
    further = beyond is not None
    longer = sample is not None and not plant.dynamics.calls  # a series goes through no network
    fitted = (
        None
        if measured is None
        else Fitted(len(measured.parameters), measured.steps * n, plant.discrete, len(measured.axes))
    )
    evidence = read_evidence(
        data["evidence"],
        n,
        len(plant.uncertain),
        claim,
        longer,
        further,
        ranked=ranks is not None,
        fitted=fitted,
        held=sample is not None,
        functions="samples" in said,
    )
    replayed = not isinstance(evidence, Trusted) or (simple and not further and keep is None and "samples" not in said)
    words = "a rate, a sample, discrete time, another set and constraints must be replayed"
    require(replayed, "format", "evidence.kind", words)
    more = (start, centre, beyond, ranks, keep, target, measured)
    c = Certificate(claim, rate, sample, *more, plant, policy, P, least, inner, outer, evidence)
    return with_samples(c, said["samples"], data["evidence"]["samples"]) if "samples" in said else c


def with_samples(c: Certificate, value: Any, shown: Any) -> Certificate:
    """The same with what was sampled, if it may have that."""
    plain = c.claim in ("asymptotic", "practical") and c.data is None and not c.plant.dynamics.calls
    plain = plain and not any(c.policy.origin)
    require(plain, "format", "claim.samples", "it was not expected with this claim, data, calls or the policy's origin")
    angles = () if c.ranks is None else c.ranks.angles
    return replace(c, samples=read_samples(value, shown, SHA256, c.plant, angles))


def read_claim(value: Any) -> dict[str, Any]:
    """Its keys by its kind. Claims without V have no rate, as if it were 0, and `invariant` no sample, the others no
    outer set, as if these were null."""
    named = isinstance(value, dict) and value.get("kind") in CLAIMS
    require(named, "format", "claim.kind", f"one of {', '.join(CLAIMS)} was expected")
    if value["kind"] == INVARIANT:
        said = keys(value, "claim", "kind", "outer", maybe=("keep",))
        require(said["outer"] is not None, "format", "claim.outer", "an object was expected")
        return {**said, "rate": (0.0).hex(), "sample": None}
    if value["kind"] in (REACHES, REMAINS):
        target = ("target",) if value["kind"] == REACHES else ()
        said = keys(value, "claim", "kind", "sample", *target, "ranks", maybe=("keep",))
        return {**said, "rate": (0.0).hex(), "outer": None}
    more = {"enlarged": ("start",), "reached": ("start", "centre")}.get(value["kind"], ())
    maybe = {"enlarged": ("keep", "data"), "reached": ("keep",)}.get(
        value["kind"], ("ranks", "keep", "data", "samples")
    )
    return keys(value, "claim", "kind", "rate", "sample", "outer", *more, maybe=maybe)


def read_more(said: Mapping[str, Any], plant: Plant) -> tuple[Ranks | None, Equations | None, Equations | None]:
    """`ranks`, `keep` and `target`, of which each may be missing."""
    ranks = keep = target = None
    if "ranks" in said:
        steps = plant.discrete or said["sample"] is not None
        require(steps, "format", "claim.ranks", "it was not expected in continuous time without a sample")
        ranks = read_ranks(said["ranks"], plant.states)
    if "keep" in said:
        keep = read_expressions(said["keep"], "claim.keep", {*plant.states, *plant.inputs, *plant.uncertain})
    if "target" in said:
        target = read_expressions(said["target"], "claim.target", set(plant.states))
    return ranks, keep, target


def read_ranks(value: Any, states: tuple[str, ...]) -> Ranks:
    at = "claim.ranks"
    ranks = keys(value, at, "angles", "steps")
    angles, steps = entries(ranks["angles"], f"{at}.angles"), ranks["steps"]
    known = all(isinstance(name, str) and name in states for name in angles)
    require(known and len(set(angles)) == len(angles), "format", f"{at}.angles", "different states were expected")
    good = type(steps) is int and 1 <= steps <= MAX_RANK  # True is an int to isinstance
    require(good, "format", f"{at}.steps", f"an integer from 1 to {MAX_RANK} was expected")
    return Ranks(tuple(angles), steps)


def read_data(value: Any, plant: Plant, claim: str) -> Data:
    at, n, m = "claim.data", len(plant.states), len(plant.inputs)
    require(claim != "reached", "format", at, "it was not expected with a tube along a path")
    require(not plant.dynamics.calls, "format", at, "it was not expected where the equations call a network")
    data = keys(value, at, "sha256", "parameters", "period", "origin", "noise", "runs", maybe=("axes",))
    sha256 = data["sha256"]
    named = isinstance(sha256, str) and SHA256.fullmatch(sha256) is not None
    require(named, "format", f"{at}.sha256", "64 hexadecimal digits were expected")
    stated = entries(data["parameters"], f"{at}.parameters")
    stated = [keys(each, f"{at}.parameters.{j}", "name", "range") for j, each in enumerate(stated)]
    names = tuple(each["name"] for each in stated)
    if "axes" in data:
        free = all(isinstance(name, str) and IDENTIFIER.fullmatch(name) for name in names)
        free = free and not {*plant.states, *plant.inputs, *plant.uncertain} & {*names} and len(names) <= MAX_NAMES
        require(free, "format", f"{at}.parameters", "names that the plant has not were expected, as there are axes")
        require(distinct(names, names), "format", f"{at}.parameters", "different names were expected")
    else:
        known = distinct(names, plant.uncertain)
        require(known, "format", f"{at}.parameters", "different uncertain quantities were expected, at least one")
    axes = read_axes(data["axes"], f"{at}.axes", plant, len(names)) if "axes" in data else ()
    priors = tuple(interval(each["range"], f"{at}.parameters.{j}.range") for j, each in enumerate(stated))
    period = read_period(data["period"], plant.discrete)
    origin = tuple(rational(q, f"{at}.origin.{i}") for i, q in enumerate(entries(data["origin"], f"{at}.origin", n)))
    noise = tuple(rational(q, f"{at}.noise.{i}") for i, q in enumerate(entries(data["noise"], f"{at}.noise", n)))
    require(all(q >= 0 for q in noise), "format", f"{at}.noise", "must not be negative")
    runs = entries(data["runs"], f"{at}.runs")
    require(1 <= len(runs) <= MAX_STEPS, "format", f"{at}.runs", f"1 to {MAX_STEPS} runs are allowed")
    read = Data(
        sha256, names, priors, period, origin, noise,
        tuple(read_run(run, f"{at}.runs.{k}", n, m) for k, run in enumerate(runs)), axes,
    )  # fmt: skip
    require(read.steps <= MAX_STEPS, "format", f"{at}.runs", f"more than {MAX_STEPS} steps in all")
    return read


def distinct(names: Sequence[Any], among: Sequence[str]) -> bool:
    """True for one or more different strings, each of which is one of some."""
    known = all(isinstance(name, str) and name in among for name in names)
    return known and 1 <= len(names) == len(set(names))


def read_axes(value: Any, at: str, plant: Plant, count: int) -> tuple[Axis, ...]:
    found = list[Axis]()
    for j, each in enumerate(entries(value, at)):
        axis, place = keys(each, f"{at}.{j}", "name", "at", "by"), f"{at}.{j}.by"
        by = tuple(rational(q, place) for q in entries(axis["by"], place, count))
        found.append(Axis(axis["name"], rational(axis["at"], f"{at}.{j}.at"), by))
    known = distinct([axis.name for axis in found], plant.uncertain)
    require(known, "format", at, "different uncertain quantities were expected, at least one")
    return tuple(found)


def read_period(value: Any, discrete: bool) -> Interval | None:
    at = "claim.data.period"
    if discrete:
        require(value is None, "format", at, "null was expected in discrete time")
        return None
    lo, hi = (rational(q, at) for q in entries(value, at, 2))
    require(bool(0 < lo <= hi), "format", at, "0 < lo <= hi must hold")
    return lo, hi


def read_run(value: Any, at: str, n: int, m: int) -> Run:
    run = keys(value, at, "steps", "states", "inputs")
    steps = run["steps"]
    good = type(steps) is int and 1 <= steps <= MAX_STEPS  # True is an int to isinstance
    require(good, "format", f"{at}.steps", f"an integer from 1 to {MAX_STEPS} was expected")
    x, u = numbers(run["states"], f"{at}.states", (steps + 1) * n), numbers(run["inputs"], f"{at}.inputs", steps * m)
    return Run(steps, *(tuple(v[k : k + size] for k in range(0, len(v), size)) for v, size in ((x, n), (u, m))))


def read_expressions(value: Any, at: str, names: set[str]) -> Equations:
    """A list of expressions that call no networks."""
    nodes = entries(value, at)
    require(1 <= len(nodes) <= MAX_EXPRESSIONS, "format", at, f"1 to {MAX_EXPRESSIONS} expressions are allowed")
    return equations(nodes, names, at)


def read_P(value: Any, n: int, claim: str) -> fmpq_mat:
    if claim in WITHOUT_V:
        require(value is None, "format", "lyapunov", f"null was expected with claim '{claim}'")
        return fmpq_mat(0, 0)
    lyapunov = keys(value, "lyapunov", "kind", "P")
    require(lyapunov["kind"] == "quadratic", "format", "lyapunov.kind", "'quadratic' was expected")
    return square(lyapunov["P"], "lyapunov.P", n)


def read_rate(value: Any, claim: str) -> fmpq:
    rate = binary64(value, "claim.rate")
    require(rate >= 0, "format", "claim.rate", "must not be negative")
    require(rate == 0 or claim not in WITH_TUBE, "format", "claim.rate", f"0 was expected with claim '{claim}'")
    return exact(rate)


def read_sample(value: Any) -> Interval | None:
    if value is None:
        return None
    lo, hi = (rational(q, "claim.sample") for q in entries(value, "claim.sample", 2))
    require(bool(lo >= 0) and bool(lo <= hi) and bool(hi > 0), "format", "claim.sample", "0 <= lo <= hi and hi > 0")
    return lo, hi


def read_function(value: Any, states: tuple[str, ...], networks: Mapping[str, Network]) -> Function:
    """Its values are those at states alone, and its expression is held to the limits of the plant's by itself."""
    at = "claim.outer"
    function = keys(value, at, "expression", "level")
    level = binary64(function["level"], f"{at}.level")
    return Function(equations([function["expression"]], set(states), f"{at}.expression", networks), level)


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


def read_plant(value: Any, networks: Mapping[str, Network], claim: str) -> Plant:
    """Equations may have jumps in discrete time, with claims that follow each of their values."""
    sections = ("name", "time", "states", "inputs", "uncertain", "dynamics", "u_eq", "domain", "input_bounds")
    plant = keys(value, "plant", *sections)
    timed = plant["time"] in ("continuous", "discrete")
    require(timed, "format", "plant.time", "'continuous' or 'discrete' was expected")
    states, inputs = entries(plant["states"], "plant.states"), entries(plant["inputs"], "plant.inputs")
    n, m = len(states), len(inputs)
    require(1 <= n <= MAX_NAMES and 1 <= m <= MAX_NAMES, "format", "plant", "1 to 64 states and inputs are allowed")
    quantities = entries(plant["uncertain"], "plant.uncertain")
    few = len(quantities) <= MAX_NAMES
    require(few, "format", "plant.uncertain", f"at most {MAX_NAMES} uncertain quantities are allowed")
    quantities = [keys(each, f"plant.uncertain.{j}", "name", "range") for j, each in enumerate(quantities)]
    uncertain = [each["name"] for each in quantities]
    for word in (plant["name"], *states, *inputs, *uncertain):
        named = isinstance(word, str) and IDENTIFIER.fullmatch(word) is not None
        require(named, "format", "plant", "an identifier was expected")
    names = {*states, *inputs, *uncertain}
    require(len(names) == n + m + len(uncertain), "format", "plant", "a name stands for two things")
    u_eq = entries(plant["u_eq"], "plant.u_eq", m)
    discrete, nodes = plant["time"] == "discrete", entries(plant["dynamics"], "plant.dynamics", n)
    jumps = discrete and claim in (REACHES, REMAINS)
    return Plant(
        name=plant["name"],
        discrete=discrete,
        states=tuple(states),
        inputs=tuple(inputs),
        dynamics=equations(nodes, names, "plant.dynamics", networks, jumps),
        u_eq=tuple(rational(q, f"plant.u_eq.{j}") for j, q in enumerate(u_eq)),
        domain=intervals(plant["domain"], "plant.domain", n),
        input_bounds=intervals(plant["input_bounds"], "plant.input_bounds", m),
        uncertain=tuple(uncertain),
        ranges=tuple(interval(each["range"], f"plant.uncertain.{j}.range") for j, each in enumerate(quantities)),
    )


def intervals(value: Any, at: str, count: int) -> tuple[Interval, ...]:
    return tuple(interval(pair, f"{at}.{i}") for i, pair in enumerate(entries(value, at, count)))


def interval(value: Any, at: str) -> Interval:
    lo, hi = (rational(q, at) for q in entries(value, at, 2))
    require(lo < hi, "format", at, "lo < hi must hold")
    return lo, hi


def read_policy(value: Any, networks: Mapping[str, Network], n: int, m: int, claim: str) -> Policy:
    """The hash is taken over the very bytes that were decoded."""
    policy = keys(value, "policy", "network", "squash", "centre", "scale", "offset", "clip", "origin", "sha256")
    squash, centre = policy["squash"], policy["centre"]
    require(squash in ("tanh", "identity"), "format", "policy.squash", "'tanh' or 'identity' was expected")
    require(centre in ("output", "preactivation", "none"), "format", "policy.centre", "an unknown centring")
    both = squash == "tanh" or centre != "preactivation"
    require(both, "format", "policy.centre", "'preactivation' needs squash 'tanh'")
    name = policy["network"]
    network = networks.get(name) if isinstance(name, str) else None
    if network is None or network.reads != n or network.size != m:
        raise Refused("format", "policy.network", f"the name of a network from {n} numbers to {m} was expected")
    scale, offset = numbers(policy["scale"], "policy.scale", m), numbers(policy["offset"], "policy.offset", m)
    require(all(s != 0 for s in scale), "format", "policy.scale", "must not be 0")
    clip = read_clip(policy["clip"], m)
    origin = numbers(policy["origin"], "policy.origin", n)
    still = all(v == 0 for v in origin) or (claim in WITH_FLOOR and centre == "none")
    require(still, "format", "policy.origin", "must be 0 where the origin is an equilibrium, or by centring u_eq")
    digest = hashlib.sha256(f"certify-policy/1\0{squash}\0{centre}\0".encode())
    for part in network.hashed():
        digest.update(part)
    for values in (scale, offset, *(clip or ())):
        digest.update(packed((m,), values))
    digest.update(network.described())
    sha256 = digest.hexdigest()
    require(policy["sha256"] == sha256, "hash", "policy.sha256", f"the policy's hash is {sha256}")
    return Policy(network, squash, centre, scale, offset, clip, origin, sha256)


def read_clip(value: Any, m: int) -> tuple[array[float], array[float]] | None:
    if value is None:
        return None
    lo, hi = (numbers(end, "policy.clip", m) for end in entries(value, "policy.clip", 2))
    require(all(a < b for a, b in zip(lo, hi, strict=True)), "format", "policy.clip", "lo < hi must hold")
    return lo, hi
