"""Sampled functions: rule `format` for what is stated of them, and rule `samples`.

Nobody has written these functions down. What is known of each is its values, nearly, at the points of a grid, and how
much it bends at most. From this an equation P + r E has to have all values that such a function may have: on each cell
of the grid, or around the origin. Everything here is rational.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from math import prod
from typing import TYPE_CHECKING, Any

from flint import fmpq

from .expressions import operands_of, rational
from .fields import entries, keys
from .refusal import Refused, require

if TYPE_CHECKING:
    from .document import Certificate, Interval, Plant

RULE = "samples"
MAX_VALUES, MAX_VARIABLES, MAX_WEIGHTS, SHORT = 2**18, 8, 64, 2**7  # SHORT in bits
MAX_TERMS, MAX_PAIRS, MAX_DEGREE, LONG, MAX_MOVED = 2**7, 2**10, 20, 2**9, 2**9  # of polynomials; LONG in bits
ZERO, ONE, HALF = fmpq(0), fmpq(1), fmpq(1, 2)
Weighted = tuple[tuple[int, fmpq], ...]
Coefficients = Mapping[tuple[int, ...], fmpq]  # by the powers of variables


@dataclass(frozen=True)
class Sampled:
    """The function whose values the derivative of `state`, or its next value, has.

    Its second derivatives are at most `curvature`, its values at the points of the grid of `axes` within `noise` of
    `values`. The equation's `error` is r, its `slopes` are the a_j, each with weights for its lower and upper end.
    """

    state: int
    variables: tuple[str, ...]
    curvature: tuple[tuple[fmpq, ...], ...]
    noise: fmpq
    vanishes: bool
    axes: tuple[tuple[fmpq, ...], ...]
    values: tuple[fmpq, ...]
    error: str | None
    slopes: tuple[str, ...]
    weights: tuple[tuple[Weighted, Weighted], ...]

    @property
    def own(self) -> tuple[str, ...]:
        """The quantities that no other equation may have."""
        return (*self.slopes, *([] if self.error is None else [self.error]))

    @property
    def cells(self) -> int:
        return prod(len(axis) - 1 for axis in self.axes)


@dataclass(frozen=True)
class Samples:
    sha256: str
    functions: tuple[Sampled, ...]


# ---------------------------------------------------------------------------------------------------------- the format


def read_samples(value: Any, shown: Any, sha256_is: Any, plant: Plant, angles: Sequence[str]) -> Samples:
    """`value` of the claim and `shown` of the evidence, of a certificate that may have them."""
    at = "claim.samples"
    stated = keys(value, at, "sha256", "functions")
    sha256, functions = stated["sha256"], entries(stated["functions"], f"{at}.functions")
    named = isinstance(sha256, str) and sha256_is.fullmatch(sha256) is not None
    require(named, "format", f"{at}.sha256", "64 hexadecimal digits were expected")
    count = 1 <= len(functions) <= len(plant.states)
    require(count, "format", f"{at}.functions", "one function or more were expected, of a state each")
    evidence = entries(shown, "evidence.samples", len(functions))
    read = [read_function(f, e, k, plant) for k, (f, e) in enumerate(zip(functions, evidence, strict=True))]
    require(len({f.state for f in read}) == len(read), "format", f"{at}.functions", "different states were expected")
    turning = any(name in angles for f in read for name in f.variables)
    require(not turning, "format", f"{at}.functions", "no angle was expected among the variables")
    own = [name for f in read for name in f.own]
    require(len(set(own)) == len(own), "format", "evidence.samples", "a quantity stands for two things")
    return Samples(sha256, tuple(read))


def read_function(value: Any, shown: Any, number: int, plant: Plant) -> Sampled:
    at, by = f"claim.samples.functions.{number}", f"evidence.samples.{number}"
    f = keys(value, at, "state", "variables", "curvature", "noise", "vanishes", "axes", "values")
    e = keys(shown, by, "error", "slopes", "weights")
    state, variables = f["state"], entries(f["variables"], f"{at}.variables")
    known = isinstance(state, str) and state in plant.states
    require(known, "format", f"{at}.state", "the name of a state was expected")
    d = len(variables)
    known = all(isinstance(name, str) and name in (*plant.states, *plant.inputs) for name in variables)
    sound = known and 1 <= d <= MAX_VARIABLES and len(set(variables)) == d
    require(sound, "format", f"{at}.variables", f"1 to {MAX_VARIABLES} different states and inputs were expected")
    curvature = tuple(short(row, f"{at}.curvature.{j}", d) for j, row in enumerate(entries(f["curvature"], at, d)))
    sides = all(curvature[j][i] == b and b >= 0 for i in range(d) for j, b in enumerate(curvature[i]))
    require(sides, "format", f"{at}.curvature", "a symmetric matrix was expected, nothing in it below 0")
    (noise,) = short([f["noise"]], f"{at}.noise", 1)
    require(bool(noise >= 0), "format", f"{at}.noise", "must not be negative")
    require(type(f["vanishes"]) is bool, "format", f"{at}.vanishes", "true or false was expected")
    axes = tuple(short(axis, f"{at}.axes.{j}") for j, axis in enumerate(entries(f["axes"], f"{at}.axes", d)))
    rising = all(len(axis) >= 2 and all(bool(p < q) for p, q in pairwise(axis)) for axis in axes)
    require(rising, "format", f"{at}.axes", "two numbers or more were expected on each axis, one above the other")
    points = prod(map(len, axes))
    require(points <= MAX_VALUES, "format", f"{at}.axes", f"more than {MAX_VALUES} points")
    values = short(f["values"], f"{at}.values", points)
    error, slopes, weights = e["error"], entries(e["slopes"], f"{by}.slopes"), entries(e["weights"], f"{by}.weights")
    uncertain = all(isinstance(name, str) and name in plant.uncertain for name in slopes)
    uncertain = uncertain and (error is None or (isinstance(error, str) and error in plant.uncertain))
    require(uncertain, "format", by, "names of uncertain quantities were expected")
    fitting = not slopes or (f["vanishes"] and len(slopes) == d)
    require(fitting, "format", f"{by}.slopes", "none were expected, or one for each variable of what vanishes at 0")
    require(len(weights) == len(slopes), "format", f"{by}.weights", "an entry for each slope was expected")
    ends = [
        tuple(weighted(w, f"{by}.weights.{j}", points) for w in entries(both, f"{by}.weights.{j}", 2))
        for j, both in enumerate(weights)
    ]
    pairs = tuple((lower, upper) for lower, upper in ends)
    more = noise, f["vanishes"], axes, values, error, tuple(slopes), pairs
    return Sampled(plant.states.index(state), tuple(variables), curvature, *more)


def short(value: Any, at: str, count: int | None = None) -> tuple[fmpq, ...]:
    """Rationals of few bits."""
    found = tuple(rational(q, at) for q in entries(value, at, count))
    require(all(q.height_bits() <= SHORT for q in found), "format", at, f"a number of more than {SHORT} bits")
    return found


def weighted(value: Any, at: str, points: int) -> Weighted:
    found, pairs = [], [entries(pair, at, 2) for pair in entries(value, at)]
    require(1 <= len(pairs) <= MAX_WEIGHTS, "format", at, f"1 to {MAX_WEIGHTS} weights were expected")
    for k, v in pairs:
        good = type(k) is int and 0 <= k < points  # True is an int to isinstance
        require(good, "format", at, f"an integer below {points} was expected")
        found.append((k, rational(v, at)))
    return tuple(found)


# -------------------------------------------------------------------------------------------------------- polynomials

Monomial = tuple[tuple[str, int], ...]  # powers by name, names in order, none to the power 0


@dataclass(frozen=True)
class Expanded:
    """A sum of monomials with factors; None where it is none, or too long."""

    sum: Mapping[Monomial, fmpq] | None

    def __add__(self, other: Expanded) -> Expanded:
        if self.sum is None or other.sum is None:
            return NEVER
        found = dict(self.sum)
        for monomial, c in other.sum.items():
            found[monomial] = found.get(monomial, ZERO) + c
        return expanded(found)

    def __mul__(self, other: Expanded) -> Expanded:
        if self.sum is None or other.sum is None or len(self.sum) * len(other.sum) > MAX_PAIRS:
            return NEVER
        found: dict[Monomial, fmpq] = {}
        for one, c in self.sum.items():
            for two, e in other.sum.items():
                powers = dict(one)
                for name, k in two:
                    powers[name] = powers.get(name, 0) + k
                monomial = tuple(sorted(powers.items()))
                found[monomial] = found.get(monomial, ZERO) + c * e
        return expanded(found)

    def __neg__(self) -> Expanded:
        return self * constant(-ONE)

    def function(self, name: str) -> Expanded:
        return NEVER


NEVER = Expanded(None)


def expanded(terms: Mapping[Monomial, fmpq]) -> Expanded:
    left = {monomial: c for monomial, c in terms.items() if c != 0}
    fits = len(left) <= MAX_TERMS
    for monomial, c in left.items():
        fits = fits and c.height_bits() <= LONG and all(k <= MAX_DEGREE for _, k in monomial)
    return Expanded(left) if fits else NEVER


def constant(q: fmpq) -> Expanded:
    return expanded({(): q})


def parts(f: Sampled, right: Expanded) -> tuple[Mapping[Monomial, fmpq], Coefficients]:
    """P, of variables and slopes, and E by the powers of the variables."""
    P: dict[Monomial, fmpq] = {}
    E: dict[tuple[int, ...], fmpq] = {}
    if right.sum is None:
        raise Refused(RULE, f"dynamics.{f.state}", "it is no polynomial, or too long a one")
    for monomial, c in right.sum.items():
        powers = dict(monomial)
        to = powers.pop(f.error, 0) if f.error is not None else 0
        allowed = {*f.variables, *(f.slopes if to == 0 else ())}
        sound = to <= 1 and set(powers) <= allowed
        require(sound, RULE, f"dynamics.{f.state}", "a term is neither of P nor of r E")
        if to:
            E[tuple(powers.get(name, 0) for name in f.variables)] = c
        else:
            P[tuple(powers.items())] = c
    return P, E


# ----------------------------------------------------------------------------------------------------------- the rule


def samples(c: Certificate) -> None:
    """All functions that are consistent with what was sampled are among the equations' values."""
    if c.samples is None:
        return
    plant = c.plant
    names = {name: expanded({((name, 1),): ONE}) for name in (*plant.states, *plant.inputs, *plant.uncertain)}
    right = plant.dynamics.evaluate(names, constant)
    for f in c.samples.functions:
        for i in range(c.n):
            alone = i == f.state or not mentioned(c, i) & set(f.own)
            require(alone, RULE, f"dynamics.{i}", f"it has quantities of the function of {plant.states[f.state]}")
        bounds = dict(zip((*plant.states, *plant.inputs), (*plant.domain, *plant.input_bounds), strict=True))
        for name, axis in zip(f.variables, f.axes, strict=True):
            lo, hi = bounds[name]
            covered = bool(axis[0] <= lo) and bool(hi <= axis[-1])
            covered = covered and (not f.vanishes or (bool(axis[0] <= 0) and bool(axis[-1] >= 0)))
            require(covered, RULE, name, "samples do not reach as far as states and inputs may")
        ranges = dict(zip(plant.uncertain, plant.ranges, strict=True))
        P, E = parts(f, right[f.state])
        if f.error is not None:
            least, most = ranges[f.error]
            require(bool(least <= -1) and bool(most >= 1), RULE, f.error, "its range lacks some of [-1, 1]")
        if f.slopes:
            linear(f, P, E, [bounds[name] for name in f.variables], ranges)
        else:
            between(f, {tuple(dict(m).get(name, 0) for name in f.variables): q for m, q in P.items()}, E)


def mentioned(c: Certificate, i: int) -> set[str]:
    """The names that an equation is written with."""
    steps, waiting, seen = c.plant.dynamics.steps, [c.plant.dynamics.results[i]], set[int]()
    while waiting:
        k = waiting.pop()
        if k not in seen:
            seen.add(k)
            waiting += operands_of(steps[k])
    return {str(steps[k][1]) for k in seen if steps[k][0] == "name"}


def between(f: Sampled, P: Coefficients, E: Coefficients) -> None:
    """On each cell E is at least the distance of the function from P that samples and second derivatives allow."""
    size = sum(prod(k + 1 for k in powers) for powers in P)
    require(size <= MAX_MOVED, RULE, f"dynamics.{f.state}", f"{size} coefficients on a cell, {MAX_MOVED} are allowed")
    off = [abs(y - p) for y, p in zip(f.values, on_grid(P, f.axes), strict=True)]
    steps = [prod(map(len, f.axes[j + 1 :])) for j in range(len(f.axes))]  # from a value to the next along an axis
    for place in product(*(range(len(axis) - 1) for axis in f.axes)):
        cell = [(axis[i], axis[i + 1]) for axis, i in zip(f.axes, place, strict=True)]
        first = sum(i * step for i, step in zip(place, steps, strict=True))
        corners = [first + sum(step for step, up in zip(steps, side, strict=True) if up)
                   for side in product((0, 1), repeat=len(steps))]  # fmt: skip
        bent = sum((((hi - lo) / 2) ** 2 * f.curvature[j][j] for j, (lo, hi) in enumerate(cell)), ZERO)
        for powers, q in around(P, cell).items():
            bent += abs(q) * sum(k * (k - 1) for k in powers)
        wanted = max(off[k] for k in corners) + f.noise + HALF * bent
        smallest = sum((least(q, powers, cell) for powers, q in E.items()), ZERO)
        at = ", ".join(f"{name} in [{lo}, {hi}]" for name, (lo, hi) in zip(f.variables, cell, strict=True))
        require(bool(smallest >= wanted), RULE, f"dynamics.{f.state}", f"E is too small where {at}")


def on_grid(P: Coefficients, axes: Sequence[Sequence[fmpq]]) -> Iterator[fmpq]:
    """The values of P, the last axis fastest."""
    if not axes:
        yield P.get((), ZERO)
        return
    for z in axes[0]:
        rest: dict[tuple[int, ...], fmpq] = {}
        for (k, *others), q in P.items():
            rest[tuple(others)] = rest.get(tuple(others), ZERO) + q * z**k
        yield from on_grid(rest, axes[1:])


def around(P: Coefficients, cell: Sequence[Interval]) -> Coefficients:
    """P(m + h t) by the powers of t: on each axis by Horner's scheme, over and over, then scaled."""
    for j, (lo, hi) in enumerate(cell):
        m, h = (lo + hi) / 2, (hi - lo) / 2
        lines: dict[tuple[tuple[int, ...], tuple[int, ...]], dict[int, fmpq]] = {}
        for powers, q in P.items():
            lines.setdefault((powers[:j], powers[j + 1 :]), {})[powers[j]] = q
        found: dict[tuple[int, ...], fmpq] = {}
        for (before, after), line in lines.items():
            a = [line.get(k, ZERO) for k in range(max(line) + 1)]
            for i in range(len(a)):
                for k in range(len(a) - 2, i - 1, -1):
                    a[k] += m * a[k + 1]
            found |= {(*before, k, *after): q * h**k for k, q in enumerate(a)}
        P = found
    return P


def least(q: fmpq, powers: Sequence[int], cell: Sequence[Interval]) -> fmpq:
    """The least value of q prod z^k on a cell."""
    below, above = q, q
    for k, (lo, hi) in zip(powers, cell, strict=True):
        if k == 0:
            continue
        a, b = lo**k, hi**k
        if k % 2 == 0:
            a, b = (a, b) if lo >= 0 else (b, a) if hi <= 0 else (ZERO, max(a, b))
        ends = below * a, below * b, above * a, above * b
        below, above = min(ends), max(ends)
    return below


def linear(
    f: Sampled, P: Mapping[Monomial, fmpq], E: Coefficients, bounds: Sequence[Interval], ranges: Mapping[str, Interval]
) -> None:
    """The linear part at 0 has slopes in their ranges, and what is beyond is at most E."""
    d, at = len(f.variables), f"dynamics.{f.state}"
    wanted = {frozenset({a, z}) for a, z in zip(f.slopes, f.variables, strict=True)}
    plain = all(q == 1 and all(k == 1 for _, k in monomial) for monomial, q in P.items())
    found = {frozenset(name for name, _ in monomial) for monomial in P}
    require(plain and found == wanted and len(P) == d, RULE, at, "P is not the sum of slopes times variables")
    squares = {tuple(2 * (i == j) for i in range(d)): j for j in range(d)}
    require(all(powers in squares for powers in E), RULE, at, "E is not a sum of squares")
    k = {squares[powers]: q for powers, q in E.items()}
    sizes = [max(abs(lo), abs(hi)) for lo, hi in bounds]
    for j in range(d):
        bent = HALF * sum((f.curvature[j][i] * sizes[i] for i in range(d)), ZERO)
        require(bool(k.get(j, ZERO) * sizes[j] >= bent), RULE, at, f"E is too small along {f.variables[j]}")
    for j, (slope, (lower, upper)) in enumerate(zip(f.slopes, f.weights, strict=True)):
        lo, hi = ranges[slope]
        for weights, sign in ((lower, -1), (upper, 1)):
            direction, end = [ZERO] * d, ZERO
            for number, v in weights:
                z = point(f, number)
                direction = [p + v * q for p, q in zip(direction, z, strict=True)]
                end += v * f.values[number] + sign * abs(v) * (f.noise + rho(f, z))
            right = direction == [fmpq(int(i == j)) for i in range(d)]
            require(right, RULE, slope, "the weighted points do not give the direction of its variable")
            require(bool(lo <= end) if sign < 0 else bool(end <= hi), RULE, slope, "its range lacks what samples allow")


def point(f: Sampled, number: int) -> list[fmpq]:
    """The point of a value, by its number."""
    found: list[fmpq] = []
    for j, axis in enumerate(f.axes):
        found.append(axis[number // prod(map(len, f.axes[j + 1 :])) % len(axis)])
    return found


def rho(f: Sampled, z: Sequence[fmpq]) -> fmpq:
    """The largest distance from the linear part."""
    return HALF * sum((m * abs(p) * abs(q) for row, p in zip(f.curvature, z, strict=True)
                       for m, q in zip(row, z, strict=True)), ZERO)  # fmt: skip
