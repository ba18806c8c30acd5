"""Chapter samples: functions of which only samples and bounds of second derivatives are known.

An equation P + r E stands for all of them. Weighted samples bound a function at the points of a grid, between which it
is near its interpolant, or its slopes at the origin, where it is near its linear part; how near follows from second
derivatives, in rationals.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import pairwise, product
from math import comb, prod
from operator import sub
from typing import TYPE_CHECKING

from flint import fmpq

from .case import Case, Failures, given
from .document import Certificate
from .exact import fraction, quotient
from .expression import evaluate
from .schema import Value
from .words import interval, number

if TYPE_CHECKING:
    from .rules import Tally

MAX_SAMPLES, MAX_VARIABLES, MAX_WEIGHTS, MAX_SHORT = 2**18, 8, 64, 2**7  # bits of a number
MAX_TERMS, MAX_PAIRS, MAX_DEGREE, MAX_BITS, MAX_PARTS = 2**7, 2**10, 20, 2**9, 2**9  # of polynomials
CLAIMS = ("asymptotic", "practical")
ZERO = fmpq(0)
Point = tuple[fmpq, ...]
Pair = tuple[fmpq, fmpq]
Weights = tuple[tuple[int, fmpq], ...]
Terms = Mapping[tuple[int, ...], fmpq]  # the coefficients of a polynomial by the powers of its names


# --------------------------------------------------------------------------------------------------------- the sections


@dataclass(frozen=True)
class Function:
    """A function of d variables and what stands for it: of names, numbers of the plant's states, inputs, uncertain.

    `values` are within `noise` of the function at `points` of the `box`, where `curvature` (d, d) bounds second
    derivatives. `weights` are those of the lower and the upper end of each slope, or without slopes of the function at
    each point of the grid that `axes` span, the last axis fastest.
    """

    state: int
    variables: tuple[int, ...]
    box: tuple[Point, ...]
    curvature: tuple[Point, ...]
    noise: fmpq
    vanishes: bool
    points: tuple[Point, ...]
    values: Point
    error: int | None = None
    slopes: tuple[int, ...] = ()
    axes: tuple[Point, ...] = ()
    weights: tuple[tuple[Weights, Weights], ...] = ()

    def beyond(self, z: Point) -> fmpq:
        """rho(z)."""
        pairs = product(range(len(z)), repeat=2)
        return sum((self.curvature[i][j] * abs(z[i] * z[j]) for i, j in pairs), ZERO) / 2

    def ends(self, p: Point, both: tuple[Weights, Weights]) -> Iterator[tuple[Point, fmpq]]:
        """The sums of v and of v z over each list of weights, and the end of the interval at p."""
        for sign, weights in zip((-1, 1), both, strict=True):
            whole, end = (ZERO,) * (len(p) + 1), ZERO
            for k, v in weights:
                z = self.points[k]
                whole = tuple(s + v * q for s, q in zip(whole, (1, *z), strict=True))
                end += v * self.values[k] + sign * abs(v) * (self.noise + self.beyond(tuple(map(sub, z, p))))
            yield whole, end


@dataclass(frozen=True)
class Samples:
    """Sampled functions, from a file of this hash."""

    sha256: str
    functions: tuple[Function, ...]


def read(claim: Value, evidence: Value, c: Certificate) -> Samples:
    """Rule `format` for both sections."""
    plain = c.claim in CLAIMS and c.data is None and not c.dynamics.calls and c.policy.origin is None
    claim.must(plain, "missing under this claim, or with such equations, data or policy")
    sha256, functions = claim.keys("sha256 functions")
    stated = functions.listed(lambda value: _function(value, c), 1, len(c.states))
    functions.must(len({f.state for f in stated}) == len(stated), "of different states")
    angles = {*c.ranks.angles} if c.ranks else set()
    functions.must(not any(angles & {*f.variables} for f in stated), "of variables that are no angles")
    values = evidence.listed(lambda value: value, len(stated))
    shown = tuple(_shown(value, f, c) for value, f in zip(values, stated, strict=True))
    own = [name for f in shown for name in _own(f)]
    evidence.must(len({*own}) == len(own), "of different uncertain quantities")
    return Samples(sha256.text("[0-9a-f]{64}", "64 hexadecimal digits"), shown)


def _own(f: Function) -> tuple[int, ...]:
    return f.slopes if f.error is None else (f.error, *f.slopes)


def _short(value: Value) -> fmpq:
    q = quotient(value.rational())
    value.must(q.height_bits() <= MAX_SHORT, f"of {MAX_SHORT} bits at most")
    return q


def _function(value: Value, c: Certificate) -> Function:
    state, variables, box, curvature, noise, vanishes, points, values = value.keys(
        "state variables box curvature noise vanishes points values"
    )
    names = (*c.states, *c.inputs)
    read = variables.listed(lambda name: names.index(name.choice(*names)), 1, MAX_VARIABLES)
    variables.must(len({*read}) == len(read), "different names")
    d, bound = len(read), _short(noise)
    M = curvature.listed(lambda row: row.listed(_short, d), d)
    symmetric = all(M[i][j] == M[j][i] >= 0 for i in range(d) for j in range(d))
    curvature.must(symmetric, "symmetric, of numbers that are at least 0")
    noise.must(bound >= 0, "at least 0")
    vanishes.must(isinstance(vanishes.raw, bool), "true or false")
    ends = box.listed(lambda pair: _axis(pair, 2), d)
    sampled = points.listed(lambda z: z.listed(_short, d), 1, MAX_SAMPLES)
    points.must(all(lo <= v <= hi for z in sampled for v, (lo, hi) in zip(z, ends, strict=True)), "in the box")
    of = c.states.index(state.choice(*c.states))
    return Function(of, read, ends, M, bound, vanishes.raw, sampled, values.listed(_short, len(sampled)))


def _axis(value: Value, most: int) -> Point:
    axis = value.listed(_short, 2, most)
    value.must(all(a < b for a, b in pairwise(axis)), "ascending")
    return axis


def _shown(value: Value, f: Function, c: Certificate) -> Function:
    error, slopes, axes, weights = value.keys("error slopes axes weights")
    d, first = len(f.variables), len(c.states) + len(c.inputs)

    def quantity(name: Value) -> int:
        name.must(name.raw in c.uncertain, "the name of an uncertain quantity")
        return first + c.uncertain.index(name.raw)

    named = slopes.listed(quantity, d if slopes.raw else 0)
    slopes.must(f.vanishes or not named, "empty where the function need not vanish")
    grid = axes.listed(lambda axis: _axis(axis, MAX_SAMPLES), 0 if named else d)
    reach = tuple((axis[0], axis[-1]) for axis in grid)
    axes.must(not grid or reach == f.box, "from end to end of the box")
    count = d if named else prod(map(len, grid))
    ends = weights.listed(lambda pair: pair.listed(lambda each: _weights(each, len(f.values)), 2), count)
    pairs = tuple((lower, upper) for lower, upper in ends)
    return replace(f, error=None if error.raw is None else quantity(error), slopes=named, axes=grid, weights=pairs)


def _weights(value: Value, count: int) -> Weights:
    def weight(pair: Value) -> tuple[int, fmpq]:
        pair.must(isinstance(pair.raw, list) and len(pair.raw) == 2, "a number of a value and its weight")
        k, v = (Value(raw, f"{pair.at}[{i}]") for i, raw in enumerate(pair.raw))
        return k.integer(0, count - 1), quotient(v.rational())

    return value.listed(weight, 1, MAX_WEIGHTS)


# ---------------------------------------------------------------------------------------------------------- polynomials


@dataclass(frozen=True)
class Polynomial:
    """A polynomial in all names of the plant, or None for what is none or too large; and the names that it is made of,
    which it may not depend on."""

    terms: Terms | None
    names: frozenset[int] = frozenset()

    @classmethod
    def of(cls, terms: Terms, names: frozenset[int]) -> Polynomial:
        kept = {k: c for k, c in terms.items() if c}
        small = len(kept) <= MAX_TERMS and all(
            max(k, default=0) <= MAX_DEGREE and c.height_bits() <= MAX_BITS for k, c in kept.items()
        )
        return cls(kept if small else None, names)

    def __add__(self, other: Polynomial) -> Polynomial:
        return self._with(other, lambda v, w: {k: v.get(k, ZERO) + w.get(k, ZERO) for k in {**v, **w}})

    def __neg__(self) -> Polynomial:
        return Polynomial(None if self.terms is None else {k: -c for k, c in self.terms.items()}, self.names)

    def __mul__(self, other: Polynomial) -> Polynomial:
        def times(v: Terms, w: Terms) -> Terms:
            found = dict[tuple[int, ...], fmpq]()
            for (k, c), (j, e) in product(v.items(), w.items()):
                both = tuple(a + b for a, b in zip(k, j, strict=True))
                found[both] = found.get(both, ZERO) + c * e
            return found

        few = self.terms is None or other.terms is None or len(self.terms) * len(other.terms) <= MAX_PAIRS
        return self._with(other, times) if few else Polynomial(None, self.names | other.names)

    def function(self, name: str) -> Polynomial:
        return Polynomial(None, self.names)

    def _with(self, other: Polynomial, made: Callable[[Terms, Terms], Terms]) -> Polynomial:
        names = self.names | other.names
        if self.terms is None or other.terms is None:
            return Polynomial(None, names)
        return self.of(made(self.terms, other.terms), names)


def equations(c: Certificate) -> list[Polynomial]:
    """The right-hand sides, expanded."""
    count = len(c.states) + len(c.inputs) + len(c.uncertain)
    alone = [tuple(int(i == k) for i in range(count)) for k in range(count)]
    names = [Polynomial({powers: fmpq(1)}, frozenset([k])) for k, powers in enumerate(alone)]
    return evaluate(c.dynamics, lambda q: Polynomial.of({(0,) * count: quotient(q)}, frozenset()), names)


def parted(f: Function, terms: Terms) -> tuple[Terms, Terms] | None:
    """P in variables and slopes, and E in variables, of a polynomial P + r E; None of another."""
    P, E = dict[tuple[int, ...], fmpq](), dict[tuple[int, ...], fmpq]()
    for powers, c in terms.items():
        z, a = (tuple(powers[k] for k in names) for names in (f.variables, f.slopes))
        by = 0 if f.error is None else powers[f.error]
        if sum(powers) != sum(z) + sum(a) + by or by > 1 or (by and any(a)):
            return None
        if by:
            E[z] = c
        else:
            P[z + a] = c
    return P, E


def moved(terms: Terms, cell: Sequence[Pair]) -> Terms:
    """The coefficients in t of a polynomial at m + h t, m the middle of a cell and h its half widths."""
    for i, (lo, hi) in enumerate(cell):
        m, h, found = (lo + hi) / 2, (hi - lo) / 2, dict[tuple[int, ...], fmpq]()
        for powers, c in terms.items():
            for j in range(powers[i] + 1):
                to = (*powers[:i], j, *powers[i + 1 :])
                found[to] = found.get(to, ZERO) + c * comb(powers[i], j) * m ** (powers[i] - j) * h**j
        terms = found
    return terms


def at(terms: Terms, z: Point) -> fmpq:
    """The value at a point."""
    return sum((c * prod(v**k for v, k in zip(z, powers, strict=True)) for powers, c in terms.items()), ZERO)


def least(terms: Terms, cell: Sequence[Pair]) -> fmpq:
    """The sum of the least values of all terms on a cell."""
    found = ZERO
    for powers, c in terms.items():
        lo = hi = c
        for (a, b), k in zip(cell, powers, strict=True):
            ends = a**k, b**k
            within = (ZERO, max(ends)) if k and k % 2 == 0 and a < 0 < b else (min(ends), max(ends))
            each = [v * w for v in (lo, hi) for w in within]
            lo, hi = min(each), max(each)
        found += lo
    return found


# ------------------------------------------------------------------------------------------------------------- the rule


def is_enclosed(case: Case) -> Failures:
    """`samples`: every consistent function has values of its equation."""
    c, count = case.c, 0
    right = equations(c)
    for f in given(c.samples).functions:
        name = c.states[f.state]
        for state, other in zip(c.states, right, strict=True):
            if state != name and other.names & {*_own(f)}:
                yield state, f"must not have what stands for the function {name}"
        bounds = [_exactly((*c.domain, *c.input_bounds)[k]) for k in f.variables]
        for k, (first, last), (lo, hi) in zip(f.variables, f.box, bounds, strict=True):
            if not (first <= lo and hi <= last and (first <= 0 <= last or not f.vanishes)):
                yield (*c.states, *c.inputs)[k], "the box must hold all of the domain and the input bounds"
        terms = right[f.state].terms
        parts = None if terms is None else parted(f, terms)
        if parts is None:
            yield name, "the equation must be a polynomial P + r E, E of the variables alone"
            continue
        ranges = dict(enumerate(map(_exactly, c.ranges), len(c.states) + len(c.inputs)))
        if f.error is not None and not (ranges[f.error][0] <= -1 and ranges[f.error][1] >= 1):
            yield c.uncertain[f.error - len(c.states) - len(c.inputs)], "its range must hold [-1, 1]"
        yield from near_the_origin(f, *parts, bounds, ranges, name) if f.slopes else on_cells(f, *parts, name)
        count += len(f.values)
    return count


def _exactly(pair: tuple[Fraction, Fraction]) -> Pair:
    lo, hi = map(quotient, pair)
    return lo, hi


def on_cells(f: Function, P: Terms, E: Terms, name: str) -> Iterator[tuple[str, str]]:
    """E is at least what P may be off by."""
    if sum(prod(k + 1 for k in powers) for powers in P) > MAX_PARTS:
        yield name, f"the sum of prod (k + 1) must be at most {MAX_PARTS}"
        return
    off = dict[Point, fmpq]()
    for p, both in zip(product(*f.axes), f.weights, strict=True):
        (low, lo), (high, hi) = f.ends(p, both)
        if not low == high == (1, *p):
            yield name, f"weights must have the sum 1 and give their point, {_shown_point(p)}"
        if not lo <= hi:
            yield name, f"the samples contradict the declared bounds, at {_shown_point(p)}"
        middle = at(P, p)
        off[p] = max(hi - middle, middle - lo)
    for cell in product(*(tuple(pairwise(axis)) for axis in f.axes)):
        bend = sum((M[j] * ((hi - lo) / 2) ** 2 for j, (M, (lo, hi)) in enumerate(zip(f.curvature, cell, strict=True))),
                   ZERO)  # fmt: skip
        bend += sum((abs(c) * sum(k * (k - 1) for k in powers) for powers, c in moved(P, cell).items()), ZERO)
        if not least(E, cell) >= max(off[p] for p in product(*cell)) + bend / 2:
            where = ", ".join(map(_shown_pair, cell))
            yield name, f"the equation may be farther from a function of these samples than it says, on {where}"


def near_the_origin(
    f: Function, P: Terms, E: Terms, bounds: Sequence[Pair], ranges: Mapping[int, Pair], name: str
) -> Iterator[tuple[str, str]]:
    """P has the slopes at 0, in their ranges, and E is at least what is beyond."""
    d = len(f.variables)
    alone = [tuple(int(i == j) for i in range(d)) for j in range(d)]
    squares = [tuple(2 * k for k in one) for one in alone]
    if {*P.items()} != {(one * 2, fmpq(1)) for one in alone}:
        yield name, "P must be the sum of slopes times variables"
    if not {*E} <= {*squares}:
        yield name, "E must be a sum of squares of variables with factors"
    s = [max(abs(lo), abs(hi)) for lo, hi in bounds]
    for square, row, size in zip(squares, f.curvature, s, strict=True):
        bend = sum((M * other for M, other in zip(row, s, strict=True)), ZERO) / 2
        if not E.get(square, ZERO) * size >= bend:
            yield name, "E must be at least what second derivatives allow beyond the linear part"
    for one, k, both in zip(alone, f.slopes, f.weights, strict=True):
        (low, lo), (high, hi) = f.ends((ZERO,) * d, both)
        if not low[1:] == high[1:] == one:
            yield name, "weights must give the direction of their variable"
        if not lo <= hi:
            yield name, "the samples contradict the declared bounds, at the origin"
        if not (ranges[k][0] <= lo and hi <= ranges[k][1]):
            yield name, "a slope may be outside its range, by these weights"


def examine(tally: Tally, case: Case) -> None:
    tally.hold(OF_SAMPLES, case)


OF_SAMPLES = (("samples", is_enclosed),)


# ------------------------------------------------------------------------------------------------------------ the words


def _shown_pair(pair: Pair) -> str:
    lo, hi = map(fraction, pair)
    return interval((lo, hi))


def _shown_point(p: Point) -> str:
    return ", ".join(number(fraction(v)) for v in p)


def sampled(c: Certificate, samples: Samples) -> list[str]:
    """The statement of chapter samples, line by line."""
    names, lines = (*c.states, *c.inputs), list[str]()
    for f in samples.functions:
        z = [names[k] for k in f.variables]
        box = ", ".join(f"{v} in {_shown_pair(pair)}" for v, pair in zip(z, f.box, strict=True))
        pairs = [(i, j) for i in range(len(z)) for j in range(i, len(z))]
        bends = ", ".join(f"{z[i]}*{z[j]} {number(fraction(f.curvature[i][j]))}" for i, j in pairs)
        rest = ", and is 0 at 0" if f.vanishes else ""
        lines.append(
            f"  and so for every plant in which {c.states[f.state]}{'+' if c.discrete else chr(39)} is instead a "
            f"function of {', '.join(z)} with continuous second derivatives, of size at most {bends} where {box}, that "
            f"is within {number(fraction(f.noise))} of the {len(f.values)} samples that the certificate states "
            f"at points there{rest}"
        )
    end = f"  of other functions nothing is claimed; the samples are said to be of a file with sha256 {samples.sha256}"
    return [*lines, end]
