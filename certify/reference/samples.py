"""Sampled functions: rule `format` for what is stated of them, and rule `samples`.

Nobody has written these functions down. What is known of each is its values, nearly, at some points of a box, and how
much it bends at most. Weighted sums of the values bound it at each point of a grid, or its slopes at the origin. From
this an equation P + r E has to have all values that such a function may have: on each cell of the grid, or around the
origin. Everything here is rational.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from math import prod
from typing import TYPE_CHECKING, Any

from flint import fmpq, fmpq_mat

from .expressions import operands_of, rational
from .fields import entries, keys
from .refusal import Refused, require

if TYPE_CHECKING:
    from .document import Certificate, Interval, Plant

RULE = "samples"
MAX_POINTS, MAX_VARIABLES, MAX_WEIGHTS, SHORT = 2**18, 8, 64, 2**7  # SHORT in bits
MAX_TERMS, MAX_PAIRS, MAX_DEGREE, LONG, MAX_MOVED = 2**7, 2**10, 20, 2**9, 2**9  # of polynomials; LONG in bits
ZERO, ONE, HALF = fmpq(0), fmpq(1), fmpq(1, 2)
Weighted = tuple[tuple[int, fmpq], ...]
Coefficients = Mapping[tuple[int, ...], fmpq]  # by the powers of variables


@dataclass(frozen=True)
class Sampled:
    """The function whose values the derivative of `state`, or its next value, has.

    On `box` its second derivatives are at most `curvature`, its values at `points` within `noise` of `values`. The
    equation's `error` is r, its `slopes` are the a_j. Two lists of `weights` are for the lower and the upper end of
    each slope, or of the function at each point of the grid of `axes`.
    """

    state: int
    variables: tuple[str, ...]
    box: tuple[Interval, ...]
    curvature: tuple[tuple[fmpq, ...], ...]
    noise: fmpq
    vanishes: bool
    points: tuple[tuple[fmpq, ...], ...]
    values: tuple[fmpq, ...]
    error: str | None
    slopes: tuple[str, ...]
    axes: tuple[tuple[fmpq, ...], ...]
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
    f = keys(value, at, "state", "variables", "box", "curvature", "noise", "vanishes", "points", "values")
    e = keys(shown, by, "error", "slopes", "axes", "weights")
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
    box = tuple((lo, hi) for lo, hi in (short(pair, f"{at}.box", 2) for pair in entries(f["box"], f"{at}.box", d)))
    require(all(bool(lo < hi) for lo, hi in box), "format", f"{at}.box", "lo < hi must hold")
    listed = entries(f["points"], f"{at}.points")
    require(1 <= len(listed) <= MAX_POINTS, "format", f"{at}.points", f"1 to {MAX_POINTS} points were expected")
    points = tuple(short(z, f"{at}.points.{k}", d) for k, z in enumerate(listed))
    inside = all(bool(lo <= v <= hi) for z in points for v, (lo, hi) in zip(z, box, strict=True))
    require(inside, "format", f"{at}.points", "a point is outside of the box")
    values = short(f["values"], f"{at}.values", len(points))
    error, slopes, weights = e["error"], entries(e["slopes"], f"{by}.slopes"), entries(e["weights"], f"{by}.weights")
    uncertain = all(isinstance(name, str) and name in plant.uncertain for name in slopes)
    uncertain = uncertain and (error is None or (isinstance(error, str) and error in plant.uncertain))
    require(uncertain, "format", by, "names of uncertain quantities were expected")
    fitting = not slopes or (f["vanishes"] and len(slopes) == d)
    require(fitting, "format", f"{by}.slopes", "none were expected, or one for each variable of what vanishes at 0")
    spanned = entries(e["axes"], f"{by}.axes", 0 if slopes else d)
    axes = tuple(short(axis, f"{by}.axes.{j}") for j, axis in enumerate(spanned))
    for axis, ends in zip(axes, box, strict=not slopes):
        rising = (*axis[:1], *axis[-1:]) == ends and all(bool(p < q) for p, q in pairwise(axis))
        require(rising, "format", f"{by}.axes", "rising numbers were expected, from one end of the box to the other")
    count = len(weights) == (len(slopes) or prod(map(len, axes)))
    require(count, "format", f"{by}.weights", "an entry was expected for each slope, or each point of the grid")
    pairs = []
    for j, both in enumerate(weights):
        lower, upper = entries(both, f"{by}.weights.{j}", 2)
        place = f"{by}.weights.{j}", len(points)
        pairs.append((weighted(lower, *place), weighted(upper, *place)))
    stated = box, curvature, noise, f["vanishes"], points, values
    return Sampled(plant.states.index(state), tuple(variables), *stated, error, tuple(slopes), axes, tuple(pairs))


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
        for name, (least, most) in zip(f.variables, f.box, strict=True):
            lo, hi = bounds[name]
            covered = bool(least <= lo) and bool(hi <= most)
            covered = covered and (not f.vanishes or (bool(least <= 0) and bool(most >= 0)))
            require(covered, RULE, name, "the box does not reach as far as states and inputs may")
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
    off = []
    for p, q, pair in zip(product(*f.axes), on_grid(P, f.axes), f.weights, strict=True):
        lo, hi = interval(f, pair, p, [ONE, *p], ", ".join(map(str, p)))
        off.append(max(hi - q, q - lo))
    steps = [prod(map(len, f.axes[j + 1 :])) for j in range(len(f.axes))]  # from a value to the next along an axis
    for place in product(*(range(len(axis) - 1) for axis in f.axes)):
        cell = [(axis[i], axis[i + 1]) for axis, i in zip(f.axes, place, strict=True)]
        first = sum(i * step for i, step in zip(place, steps, strict=True))
        corners = [first + sum(step for step, up in zip(steps, side, strict=True) if up)
                   for side in product((0, 1), repeat=len(steps))]  # fmt: skip
        bent = sum((((hi - lo) / 2) ** 2 * f.curvature[j][j] for j, (lo, hi) in enumerate(cell)), ZERO)
        for powers, q in around(P, cell).items():
            bent += abs(q) * sum(k * (k - 1) for k in powers)
        wanted = max(off[k] for k in corners) + HALF * bent
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
    for j, (slope, pair) in enumerate(zip(f.slopes, f.weights, strict=True)):
        least, most = ranges[slope]
        lo, hi = interval(f, pair, [ZERO] * d, [fmpq(int(i == j)) for i in range(d)], slope)
        require(bool(least <= lo) and bool(hi <= most), RULE, slope, "its range lacks what samples allow")


def interval(f: Sampled, pair: Sequence[Weighted], p: Sequence[fmpq], sums: Sequence[fmpq], at: str) -> Interval:
    """The ends, by two lists of weights, of the function at p or of a slope.

    Over each list the sums of the weighted points, or of the weights and these, must be `sums`.
    """
    ends = []
    for weights, sign in zip(pair, (-1, 1), strict=True):
        v, size = fmpq_mat([[q for _, q in weights]]), fmpq_mat([[abs(q) for _, q in weights]])
        *found, end = (v * fmpq_mat([[ONE, *f.points[k], f.values[k]] for k, _ in weights])).entries()
        require(found[-len(sums) :] == sums, RULE, at, "its weighted samples have other sums")
        away = ([a - b for a, b in zip(f.points[k], p, strict=True)] for k, _ in weights)
        ends.append(end + sign * (size * fmpq_mat([[f.noise + rho(f, z)] for z in away]))[0, 0])
    lo, hi = ends
    require(bool(lo <= hi), RULE, at, "no function has such samples")
    return lo, hi


def rho(f: Sampled, z: Sequence[fmpq]) -> fmpq:
    """The largest distance from the linear part."""
    return HALF * sum((m * abs(p) * abs(q) for row, p in zip(f.curvature, z, strict=True)
                       for m, q in zip(row, z, strict=True)), ZERO)  # fmt: skip
