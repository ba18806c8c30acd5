"""Equilibria of the closed loop that are not the origin: enclosed by Krawczyk's test, with the eigenvalues of one.

An uncentred policy has pi(0) near u_eq at best, so its equilibrium lies beside the origin, if it has one. Newton's
method finds the point in floats, from the origin or from the end of a trajectory that starts there. The test shows in
Arb that exactly one equilibrium lies in a box around it:
`K = x0 - Y F(x0) + (I - Y J)(X - x0)` lies inside X, J being mean slopes of F on X and Y about the inverse of one.
In discrete time an equilibrium is a fixed point, and F stands for what a step adds to x.

Where some states are fixed exactly there are more components of F than unknowns. Those that are 0, or multiples of
others, are left out: of a body without speed the rates of its positions.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from typing import Any

import flint
import numpy as np
from numpy.typing import NDArray

from certify.errors import InputError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import (
    JUMP,
    Algebra,
    Expression,
    Number,
    Operation,
    Symbol,
    differentiate,
    evaluate,
    in_absolute_values,
    nodes,
)
from certify.loop.plants import with_origin
from certify.loop.plants.system import Time
from certify.loop.rigorous import (
    BallAlgebra,
    Balls,
    MeanSlopes,
    ball,
    evaluate_arb,
    field_on,
    in_digits,
    policy_on,
    precision,
)

Array = NDArray[np.float64]
Factors = frozenset[tuple[Any, int]]  # symbols, or functions of sums, and their powers
Terms = dict[Factors, Fraction]
Change = Callable[[Balls], tuple[Balls, flint.arb_mat]]  # F and its slopes on balls
_STEPS, _HALVINGS = 100, 30  # of Newton's method, and of a step that does not reduce ||F||
_REFINEMENTS = 8  # in Arb, each by some ten digits
_RADIUS = 1e-20  # of the box of the test, of the domain's widths
_LEAP = 1e-9  # of a derivative between states so near to each other, of the largest: by the domain's widths
_DIFFERENCE, _LEAST = 1e-7, 1e-2  # of a difference quotient: of a state, and of this share of its width at least
_ALMOST = 1e-8  # of the domain's widths: a last step of Newton's method from which the test begins
_DIGITS = 12
_MOST_TERMS = 4096  # of a product that is multiplied out
_BITS = 40  # of a point from which a loop is looked at
_WHILE = 100.0  # of a trajectory, in the plant's unit of time
_MOST_STEPS = 10_000  # of one: where F is no number, time stands still
_SETTLED = 1e-9  # share of the domain's widths: a shorter step is none


@dataclass(frozen=True, slots=True)
class Rest:
    """The only equilibrium in a small box.

    Parameters
    ----------
    x, u : decimals with 12 digits that are certain up to the last, or 0 for some 1e-20 of the domain's width or of
        the input's bounds, (n,) and (m,); x is in deviations from the plant's operating point.
    eigenvalues : eigenvalues of the Jacobian there, in discrete time of the map; enclosed, as text; empty if Arb cannot
        isolate them.
    stable : True if all of them certainly lie left of the imaginary axis, in discrete time in the unit circle.
    """

    x: tuple[str, ...]
    u: tuple[str, ...]
    eigenvalues: tuple[str, ...]
    stable: bool


def find_rest(loop: ClosedLoop) -> Rest | None:
    """Enclose the equilibrium that Newton's method reaches from the origin, or from the end of a trajectory that starts
    there: a stable one if either is; None if none can be shown."""
    first = None
    for begin in (_origin, _end):
        x0 = begin(loop)
        start = None if x0 is None else _newton(loop, x0)
        found = None if start is None else _enclosed(loop, start)
        if found is not None and found.stable:
            return found
        first = found if first is None else first
    return first


def seen_from(loop: ClosedLoop, rest: Rest) -> ClosedLoop:
    """The same loop in deviations from its equilibrium, rounded to 40 bits of the domain's widths.

    Raises
    ------
    InputError : the policy is centred or has an origin already, or the point does not lie in the interior of the
    domain.
    """
    system, network = loop.system, loop.network
    if network.centre != "none" or network.is_moved:
        raise InputError(
            "a loop that is to be seen from its equilibrium must have a policy without centring, as it is."
        )
    by = [_short(Fraction(v), hi - lo) for v, (lo, hi) in zip(rest.x, system.domain, strict=True)]
    u = [_short(Fraction(v), hi - lo) for v, (lo, hi) in zip(rest.u, system.input_bounds, strict=True)]
    origin = np.array([float(q) for q in by])
    if [Fraction(v) for v in origin.tolist()] != by:
        raise InputError("a point from which a loop is seen must have coordinates in binary64.")
    return ClosedLoop(with_origin(system, by, u), replace(network, origin=origin))


def _short(q: Fraction, width: Fraction) -> Fraction:
    """Round q to a multiple of 2^-40 times about a width."""
    unit = Fraction(2) ** (width.numerator.bit_length() - width.denominator.bit_length() - _BITS)
    return round(q / unit) * unit


def _enclosed(loop: ClosedLoop, start: Array) -> Rest | None:
    widths = _widths(loop)
    with precision():
        radii = [flint.arb(_RADIUS * w) for w in widths.tolist()]
        box = _zero_of(partial(_change_on, loop), [flint.arb(float(v)) for v in start], radii)
        if box is None:
            return None
        u, _ = policy_on(loop, box)
        _, J = field_on(loop, box)
        if _leaps(J, widths):  # slopes of a corner at the equilibrium
            return None
        eigenvalues, stable = _spectrum(J, loop.system.time)
    return Rest(_decimals(box), _decimals(u), eigenvalues, stable)


def _widths(loop: ClosedLoop) -> Array:
    """The widths of the domain, (n,), by which states of any units compare."""
    return np.array([float(hi - lo) for lo, hi in loop.system.domain])


def _leaps(J: flint.arb_mat, widths: Array) -> bool:
    """True if the slopes of balls are far wider than those of a smooth F."""
    ends = np.array([[(float(v.rad()), float(abs(v).upper())) for v in row] for row in J.tolist()])
    wide, size = np.moveaxis(ends, -1, 0) * widths / widths[:, None]
    return not bool(np.max(wide) <= _LEAP * np.max(size))


def _zero_of(change: Change, x: Balls, radii: Balls) -> Balls | None:
    """Balls of these radii, near x, that hold exactly one zero; None if that is not shown."""
    for _ in range(_REFINEMENTS):
        F, J = change(x)
        Y = _inverse(J)
        if Y is None or not all(v.is_finite() for v in F):
            return None
        step = Y * flint.arb_mat([[v] for v in F])
        x = [(v - step[i, 0]).mid() for i, v in enumerate(x)]
    box = [v + flint.arb(0, 1) * r for v, r in zip(x, radii, strict=True)]
    return box if _is_inside(change, x, box) else None


def _change_on(loop: ClosedLoop, x: list[flint.arb]) -> tuple[list[flint.arb], flint.arb_mat]:
    """F and its Jacobian on balls x, in discrete time less x and the identity."""
    F, J = field_on(loop, x)
    if loop.system.time == "continuous":
        return F, J
    return [f - v for f, v in zip(F, x, strict=True)], J - _identity(len(x))


def _identity(n: int) -> flint.arb_mat:
    return flint.arb_mat([[int(i == j) for j in range(n)] for i in range(n)])


def rest_in(loop: ClosedLoop, x: Sequence[Fraction], free: Sequence[int], radii: Sequence[Fraction]) -> Balls | None:
    """Balls around a state that rests and differs from x in the states `free` alone, in each by less than its radius;
    None if no such state is shown. At the precision of the caller."""
    around = [ball(q) + flint.arb(0, 1) * ball(r) if i in free else ball(q)
              for i, (q, r) in enumerate(zip(x, radii, strict=True))]  # fmt: skip
    rates = _rates_in(loop, x, free, around)
    if not free or rates is None or len(rates) != len(free):
        return None

    def whole(y: Balls) -> Balls:
        """A state, from its values where it is free."""
        found = dict(zip(free, y, strict=True))
        return [found.get(i, v) for i, v in enumerate(around)]

    zero = _zero_of(lambda y: _slopes_by(loop, rates, free, whole(y)), [ball(x[i]) for i in free],
                    [ball(radii[i] / 2) for i in free])  # fmt: skip
    inside = zero is not None and all(bool(around[i].contains(v)) for i, v in zip(free, zero, strict=True))
    return whole(zero) if zero is not None and inside else None


def _rates_in(loop: ClosedLoop, x: Sequence[Fraction], free: Sequence[int], around: Balls) -> list[Expression] | None:
    """The components of F, or of what a step adds, but for those that are 0, or multiples of others, at all states
    `around` x; None if one has no value there. Corners there are decided, or stay."""
    system = loop.system
    values = dict(zip((*system.states, *system.inputs), (*around, *policy_on(loop, around)[0]), strict=True))
    named = {s: _Multiplied().constant(q) for s, q in zip(system.states, x, strict=True)}
    named |= {s: {frozenset({(s, 1)}): Fraction(1)} for s in (*(system.states[i] for i in free), *system.inputs)}
    found: dict[object, Expression] = {}
    for s, f in zip(system.states, loop.dynamics, strict=True):
        rate = f - s if system.time == "discrete" else f
        if not evaluate_arb(rate, values).is_finite():
            return None
        rate = _decided(rate, values)
        terms = evaluate(rate, named, _Multiplied())
        if terms:
            first = terms[min(terms, key=hash)]
            found.setdefault(frozenset((factors, k / first) for factors, k in terms.items()), rate)
    return list(found.values())


def _decided(expression: Expression, values: Mapping[Symbol, flint.arb]) -> Expression:
    """An expression that is the same on these balls, with abs and heaviside of what is certain replaced."""
    found: dict[Expression, Expression] = {}
    plain = in_absolute_values(expression)
    for node in nodes(plain):
        found[node] = node
        if isinstance(node, Operation):
            operands = [found[e] for e in node.operands]
            found[node] = Operation(node.operator, *operands)
            if node.operator in ("abs", JUMP):
                v = evaluate_arb(node.operands[0], values)
                if v > 0:
                    found[node] = operands[0] if node.operator == "abs" else Number(1)
                elif v < 0:
                    found[node] = -operands[0] if node.operator == "abs" else Number(0)
    return found[plain]


class _Multiplied(Algebra[Terms]):
    """Expressions that are multiplied out: sums of products of powers of symbols and of functions of such sums."""

    def constant(self, q: Fraction) -> Terms:
        return {frozenset(): q} if q else {}

    def total(self, constant: Fraction | None, terms: Sequence[Terms]) -> Terms:
        found = self.constant(constant or Fraction(0))
        for term in terms:
            for factors, k in term.items():
                found[factors] = found.get(factors, Fraction(0)) + k
        return {factors: k for factors, k in found.items() if k}

    def product(self, constant: Fraction | None, factors: Sequence[Terms]) -> Terms:
        found = self.constant(Fraction(1) if constant is None else constant)
        for factor in factors:
            long = len(found) * len(factor) > _MOST_TERMS
            one, other = (_atom("*", v) if long else v for v in (found, factor))
            each = ((Counter(dict(a)), Counter(dict(b)), k * q) for a, k in one.items() for b, q in other.items())
            found = self.total(None, [{frozenset((a + b).items()): q} for a, b, q in each])
        return found

    def inverse(self, value: Terms) -> Terms:
        return self.constant(1 / value[frozenset()]) if [*value] == [frozenset()] else _atom("/", value)

    def function(self, name: str, value: Terms) -> Terms:
        at_0 = None if value else {"cos": 1, "exp": 1, "sign": None, JUMP: None}.get(name, 0)
        return _atom(name, value) if at_0 is None else self.constant(Fraction(at_0))


def _atom(name: str, value: Terms) -> Terms:
    """A function of a sum, as one thing."""
    return {frozenset({((name, frozenset(value.items())), 1)}): Fraction(1)}


def _slopes_by(
    loop: ClosedLoop, rates: Sequence[Expression], free: Sequence[int], x: Balls
) -> tuple[Balls, flint.arb_mat]:
    """Rates on balls x, and their slopes by the states `free`, the input following them."""
    system = loop.system
    u, gain = policy_on(loop, x)
    values = dict(zip((*system.states, *system.inputs), (*x, *u), strict=True))
    known: dict[Expression, flint.arb] = {}
    F = [evaluate(e, values, BallAlgebra(), known) for e in rates]
    rows = []
    for e in rates:
        own, through = ([evaluate(differentiate(e, s), values, MeanSlopes(), known) for s in by]
                        for by in ([system.states[i] for i in free], system.inputs))  # fmt: skip
        rows.append(
            [
                v + sum((w * gain[k, i] for k, w in enumerate(through)), flint.arb(0))
                for v, i in zip(own, free, strict=True)
            ]
        )
    return F, flint.arb_mat(rows)


def _rates(loop: ClosedLoop) -> Callable[[Array], Array]:
    """F in floats, in discrete time less x, (n,) to (n,)."""
    f, steps = loop.system.function(), loop.system.time == "discrete"

    def F(x: Array) -> Array:
        with np.errstate(all="ignore"):
            return np.asarray(f(x, loop.policy(x[None])[0]), dtype=np.float64) - (x if steps else 0.0)

    return F


def _origin(loop: ClosedLoop) -> Array:
    return np.zeros(loop.system.n)


def _end(loop: ClosedLoop) -> Array | None:
    """The end of the trajectory from the origin, by a stiff solver; None if it leaves the domain or takes too long."""
    if loop.system.time == "discrete":
        return _last(loop)
    import scipy.integrate

    F, (lo, hi) = _rates(loop), np.array([[float(a), float(b)] for a, b in loop.system.domain]).T
    with warnings.catch_warnings(action="ignore"):  # of steps that fail
        each = {"rtol": 1e-6, "atol": 1e-6 * np.minimum(hi - lo, 1.0)}
        solver = scipy.integrate.LSODA(lambda _, x: F(x), 0.0, _origin(loop), _WHILE, **each)
        for _ in range(_MOST_STEPS):
            solver.step()
            x = np.asarray(solver.y, dtype=np.float64)
            if solver.status == "failed" or not np.all((lo < x) & (x < hi)):
                return None
            if solver.status == "finished":
                return x
    return None


def _last(loop: ClosedLoop) -> Array | None:
    """The last state of so many steps from the origin; None if they leave the domain."""
    change, x, (lo, hi) = _rates(loop), _origin(loop), np.array([[float(a), float(b)] for a, b in loop.system.domain]).T
    for _ in range(_MOST_STEPS):
        step = change(x)
        x = x + step
        if not np.all((lo < x) & (x < hi)):
            return None
        if not np.any(np.abs(step) > _SETTLED * (hi - lo)):
            break
    return x


def _newton(loop: ClosedLoop, x: Array) -> Array | None:
    """A root of F in floats inside the domain, by Newton's method with halved steps; None if it finds none."""
    F, widths = _rates(loop), _widths(loop)
    lo, hi = np.array([[float(a), float(b)] for a, b in loop.system.domain]).T
    value, step = F(x), np.full(len(x), np.inf)
    for _ in range(_STEPS):
        steps = _DIFFERENCE * np.maximum(_LEAST * widths, np.abs(x))
        J = np.stack([(F(x + d) - F(x - d)) / (2 * s) for s, d in zip(steps, np.diag(steps), strict=True)], axis=1)
        if not np.all(np.isfinite(J)):
            return None
        scaled = J * widths / widths[:, None]
        step = widths * np.linalg.lstsq(scaled, value / widths)[0]
        for _ in range(_HALVINGS):
            new = F(x - step)
            less = np.linalg.norm(new / widths) < np.linalg.norm(value / widths)
            if np.all((x - step > lo) & (x - step < hi)) and less:
                break
            step = step / 2
        else:
            break
        x, value = x - step, new
    return x if np.linalg.norm(value / widths) <= _ALMOST * np.linalg.norm(scaled) else None


def _inverse(J: flint.arb_mat) -> flint.arb_mat | None:
    """An approximate inverse, with entries without radius."""
    middle = np.array([[float(J[i, j].mid()) for j in range(J.ncols())] for i in range(J.nrows())])
    if not np.all(np.isfinite(middle)):
        return None
    try:
        return flint.arb_mat(np.linalg.inv(middle).tolist())
    except np.linalg.LinAlgError:
        return None


def _is_inside(change: Change, x: Balls, box: Balls) -> bool:
    """Krawczyk's test (Moore, Kearfott, Cloud, Introduction to Interval Analysis, SIAM 2009, chapter 8)."""
    n = len(x)
    F, _ = change(x)
    everywhere, J = change(box)
    Y = _inverse(J)
    if Y is None or not all(v.is_finite() for v in everywhere):  # at a jump slopes say nothing
        return False
    spread = flint.arb_mat([[b - v] for b, v in zip(box, x, strict=True)])
    K = flint.arb_mat([[v] for v in x]) - Y * flint.arb_mat([[v] for v in F]) + (_identity(n) - Y * J) * spread
    return all(bool(box[i].contains_interior(K[i, 0])) for i in range(n))


def _spectrum(J: flint.arb_mat, time: Time) -> tuple[tuple[str, ...], bool]:
    try:
        found = list(flint.acb_mat(J).eig(multiple=True))
    except (ValueError, ArithmeticError):
        return (), False
    return tuple(map(in_digits, found)), all(bool(abs(v) < 1 if time == "discrete" else v.real < 0) for v in found)


def _decimals(values: list[flint.arb]) -> tuple[str, ...]:
    return tuple("0" if v.contains(0) else v.str(_DIGITS, radius=False) for v in values)
