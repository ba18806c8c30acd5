"""The closed loop at single points in Arb balls, for REFUTED, and the eigenvalues at the origin.

A comparison of balls is True only if it is certain, so `not (a < b)` proves nothing; an uncertain result counts as not
shown.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from fractions import Fraction
from functools import lru_cache

import flint
import numpy as np
from numpy.typing import NDArray

from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import (
    JUMP,
    Algebra,
    Expression,
    Symbol,
    differentiate,
    evaluate,
    solution_series,
    total,
)
from certify.loop.networks import (
    Affine,
    Clip,
    Concat,
    Map,
    Network,
    Observe,
    Product,
    Sum,
    has_kink_at,
    repeated,
)
from certify.loop.networks import Algebra as Networks
from certify.loop.policies import PolicyNetwork

Array = NDArray[np.float64]
_PRECISION = 200  # bits
_ATTEMPTS, _WIDER, _ORDER = 6, 1.25, 30  # at the balls around a solution over a period; of its series in time
Balls = list[flint.arb]


class BallAlgebra(Algebra[flint.arb]):
    """Expressions in Arb balls."""

    at_corner = flint.arb.nan()  # the sign of what may be 0

    def constant(self, q: Fraction) -> flint.arb:
        return ball(q)

    def inverse(self, value: flint.arb) -> flint.arb:
        return 1 / value

    def function(self, name: str, value: flint.arb) -> flint.arb:
        if name == "sign":
            return flint.arb(1) if value > 0 else flint.arb(-1) if value < 0 else self.at_corner
        if name == JUMP:
            return flint.arb(1) if value > 0 else flint.arb(0) if value < 0 else flint.arb.nan()
        return abs(value) if name == "abs" else super().function(name, value)

    def extreme(self, name: str, a: flint.arb | Fraction, b: flint.arb | Fraction) -> flint.arb | Fraction:
        v, w = (ball(q) if isinstance(q, Fraction) else q for q in (a, b))
        return v.max(w) if name == "max" else v.min(w)


class MeanSlopes(BallAlgebra):
    """Derivatives by which a value moves between two states: at a corner any slope between those beside it."""

    at_corner = flint.arb(0, 1)


@contextmanager
def precision(bits: int = _PRECISION) -> Iterator[None]:
    """Arb at the precision of this module, or at another one."""
    before, flint.ctx.prec = flint.ctx.prec, bits
    try:
        yield
    finally:
        flint.ctx.prec = before


def ball(q: Fraction) -> flint.arb:
    """The ball around a rational."""
    return flint.arb(flint.fmpq(q.numerator, q.denominator))


def evaluate_arb(expression: Expression, values: Mapping[Symbol, flint.arb]) -> flint.arb:
    """An expression of the plant in Arb balls."""
    return evaluate(expression, values, BallAlgebra())


def evaluate_policy(loop: ClosedLoop, x: Array) -> Balls:
    """pi(x) at a binary64 point (n,), as Arb balls."""
    with precision():
        return policy_at(loop, points(x))


def policy_at(loop: ClosedLoop, x: Balls) -> Balls:
    """pi at balls around a state, at the precision of the caller."""
    network, (shift, offset) = loop.network, _centring(loop)
    u = [
        flint.arb(float(s)) * network.squashed(v + d, _NUMBERS) + o
        for v, d, s, o in zip(_net(network, x), shift, network.scale, offset, strict=True)
    ]
    return list(network.clipped(u, _NUMBERS))


def states_after(loop: ClosedLoop, x: Sequence[Fraction]) -> Iterator[tuple[Balls, Balls]]:
    """The states and inputs of a loop in steps along the trajectory from a state, at its beginning and after each step,
    without an end; of several periods over which an input may be held the longest. No numbers where none are enclosed.
    """
    sample, state = loop.system.sample, [ball(q) for q in x]
    while True:
        states = dict(zip(loop.system.states, state, strict=True))
        u = policy_at(loop, state)
        yield state, u
        inputs = dict(zip(loop.system.inputs, u, strict=True))
        now = field_at(loop, {**states, **inputs})
        if sample is None:
            state = now
            continue
        mean = _mean_rate(loop.dynamics, states, inputs, now, sample[1])
        state = [v + ball(sample[1]) * g for v, g in zip(state, mean, strict=True)]


def centring_with_errors(loop: ClosedLoop) -> tuple[Array, Array, Array, Array]:
    """`shift` and `offset` of the centring rounded to binary64, each followed by an upper bound of its error, (m,)."""
    with precision():
        columns = []
        for balls in _centring(loop):
            middle = [float(b.mid()) for b in balls]
            columns += [middle, [rounded_up((b - m).abs_upper()) for b, m in zip(balls, middle, strict=True)]]
    shift, shift_error, offset, offset_error = map(np.array, columns)
    return shift, shift_error, offset, offset_error


def rounded_up(x: flint.arb) -> float:
    """A binary64 number that is not below x >= 0."""
    value = float(x)
    return value if value >= x else float(np.nextafter(value * (1 + 2.0**-50), np.inf))


def evaluate_vdot(loop: ClosedLoop, P: Array, x: Array) -> flint.arb:
    """`Vdot = 2 x'P F(x)` at a binary64 point (n,), as an Arb ball."""
    with precision():
        state = points(x)
        values: dict[Symbol, flint.arb] = dict(zip(loop.system.states, state, strict=True))
        values |= zip(loop.system.inputs, evaluate_policy(loop, x), strict=True)
        total, known = flint.arb(0), dict[Expression, flint.arb]()
        for row, expression in zip(P, loop.dynamics, strict=True):
            Px = sum((flint.arb(float(p)) * v for p, v in zip(row, state, strict=True)), flint.arb(0))
            total += 2 * Px * evaluate(expression, values, BallAlgebra(), known)
        return total


def evaluate_increment(
    loop: ClosedLoop, P: Array, x: Array, period: Fraction | None = None, rate: float = 0.0
) -> flint.arb:
    """`D + 2 lambda V` at a binary64 point (n,), as an Arb ball; D is V's increment over a step, per unit of time.

    That is `Vdot = 2 x'P F(x)`; in discrete time V(F(x)) - V(x); with a `period` h over which the input is held
    (V(phi(h)) - V(x))/h, or Vdot where h = 0. No number where no solution is enclosed.
    """
    with precision():
        state = points(x)
        states = dict(zip(loop.system.states, state, strict=True))
        inputs = dict(zip(loop.system.inputs, evaluate_policy(loop, x), strict=True))
        step, G = flint.arb(0), field_at(loop, {**states, **inputs})
        if loop.system.time == "discrete":
            step, G = flint.arb(1), [after - before for after, before in zip(G, state, strict=True)]
        elif period:
            step, G = ball(period), _mean_rate(loop.dynamics, states, inputs, G, period)
        lam, total = flint.arb(float(rate)), flint.arb(0)
        for row, v, own in zip(P, state, G, strict=True):
            p = [flint.arb(float(entry)) for entry in row]
            Px, PG = (sum((a * b for a, b in zip(p, by, strict=True)), flint.arb(0)) for by in (state, G))
            total += own * (2 * Px + step * PG) + 2 * lam * v * Px
        return total


def field_at(loop: ClosedLoop, values: Mapping[Symbol, flint.arb]) -> Balls:
    """f at balls around states and inputs, by their symbols."""
    return _values(loop.dynamics, values)


def _values(expressions: Sequence[Expression], values: Mapping[Symbol, flint.arb]) -> Balls:
    known: dict[Expression, flint.arb] = {}
    return [evaluate(expression, values, BallAlgebra(), known) for expression in expressions]


def _mean_rate(
    dynamics: Sequence[Expression],
    states: Mapping[Symbol, flint.arb],
    inputs: Mapping[Symbol, flint.arb],
    now: Balls,
    period: Fraction,
) -> Balls:
    """(phi(h) - x)/h with the input held, by a series whose last coefficient is taken on balls around all of phi.

    A solution cannot be the first to leave the balls of radius kappa if h |f| < kappa on them.
    """
    h, size = ball(period), [v.abs_upper() for v in now]
    for _ in range(_ATTEMPTS):
        kappa = [(_WIDER * h * v).abs_upper() + flint.arb(2) ** -_PRECISION for v in size]
        around = {s: v + flint.arb(0, k) for (s, v), k in zip(states.items(), kappa, strict=True)}
        size = [v.abs_upper() for v in _values(dynamics, {**around, **inputs})]
        if all(bool(h * v < k) for v, k in zip(size, kappa, strict=True)):
            break
    else:
        return [flint.arb.nan()] * len(size)
    rows = solution_series(dynamics, states, inputs, BallAlgebra(), _ORDER - 1)
    last = [row[-1] for row in solution_series(dynamics, around, inputs, BallAlgebra(), _ORDER)]
    result = last
    for k in reversed(range(_ORDER - 1)):
        result = [row[k] + h * v for row, v in zip(rows, result, strict=True)]
    return result


def eigenvalues(loop: ClosedLoop) -> list[flint.acb] | None:
    """Rigorous enclosures of the eigenvalues of the closed loop's Jacobian at 0.

    Where the input is held, those of the linear maps over the shortest (if it is not 0) and the longest period.
    None if Arb cannot isolate them, there is no Jacobian because of a kink, or the clip is not certain to be inactive
    at the origin.
    """
    if has_kink_at(loop.network.network, loop.network.origin):
        return None
    with precision():
        if not _unclipped(loop):
            return None
        sample = loop.system.sample
        try:
            found = [_jacobian(loop)] if sample is None else [_held_map(loop, h) for h in dict.fromkeys(sample) if h]
            return [value for matrix in found for value in flint.acb_mat(matrix).eig(multiple=True)]
        except (ValueError, ArithmeticError):
            return None


def in_digits(eigenvalue: flint.acb) -> str:
    """The middle to six digits, a real number where the enclosure meets the real line."""
    middle = complex(eigenvalue.mid())
    return f"{middle.real:.6g}" if eigenvalue.imag.contains(0) else f"{middle:.6g}"


def instability(loop: ClosedLoop, eigenvalue: flint.acb) -> flint.arb:
    """A number that is negative for a stable eigenvalue: its real part, or |v| - 1 for a loop in steps."""
    with precision():
        return eigenvalue.real if loop.step == 0 else abs(eigenvalue) - 1


def policy_on(loop: ClosedLoop, x: Balls) -> tuple[Balls, flint.arb_mat]:
    """pi and its Jacobian (m, n) on balls x.

    If the clip may or may not act, the slope is the ball of all slopes between 0 and 1: valid only for mean
    values.
    """
    network = loop.network
    eye = flint.arb_mat([[int(i == j) for j in range(network.n)] for i in range(network.n)])
    y, J = _Slopes().run(network.network, (_read(network, x), eye))
    shift, offset = _centring(loop)
    squashed = [network.squashed(v + d, _NUMBERS) for v, d in zip(y, shift, strict=True)]
    slopes = [network.squash_slope(v, _NUMBERS) for v in squashed]
    scale = [flint.arb(float(s)) for s in network.scale]
    u = [s * v + o for s, v, o in zip(scale, squashed, offset, strict=True)]
    slopes = [s * slope * clip for s, slope, clip in zip(scale, slopes, _clip_slopes(network, u), strict=True)]
    return list(network.clipped(u, _NUMBERS)), _scaled(slopes, J)


def _clip_slopes(network: PolicyNetwork, u: Balls) -> Balls:
    return [flint.arb(1)] * len(u) if network.clip is None else _slopes_of_clip(u, *network.clip)


def _slopes_of_clip(u: Balls, least: Array, most: Array) -> Balls:
    slopes = []
    for v, lo, hi in zip(u, least, most, strict=True):
        inside, outside = v > float(lo) and v < float(hi), v < float(lo) or v > float(hi)
        slopes.append(flint.arb(1) if inside else flint.arb(0) if outside else flint.arb(0.5, 0.5))
    return slopes


def field_on(loop: ClosedLoop, x: Balls) -> tuple[Balls, flint.arb_mat]:
    """F and its Jacobian (n, n) on balls x, the Jacobian as `policy_on` says."""
    system = loop.system
    u, gain = policy_on(loop, x)
    values = dict(zip((*system.states, *system.inputs), (*x, *u), strict=True))
    known: dict[Expression, flint.arb] = {}
    F = [evaluate(e, values, BallAlgebra(), known) for e in loop.dynamics]
    A, B = (
        flint.arb_mat([[evaluate(differentiate(e, s), values, MeanSlopes(), known) for s in by] for e in loop.dynamics])
        for by in (system.states, system.inputs)
    )
    return F, A + B * gain


def step_on(loop: ClosedLoop, x: Balls) -> tuple[Balls, flint.arb_mat]:
    """The state one step later, of several periods the longest, and its Jacobian (n, n), on balls x of a loop in steps.

    The Jacobian is one for mean values, as `policy_on` says. Where the input is held, its columns v solve the
    variational equation v' = f_x v + f_u w for the directions w of the input, along with the state (Hairer, Norsett and
    Wanner 1993, I.14).
    """
    system = loop.system
    if system.sample is None:
        return field_on(loop, x)
    n, period = system.n, system.sample[1]
    u, gain = policy_on(loop, x)
    inputs = dict(zip(system.inputs, u, strict=True))
    states = dict(zip(system.states, x, strict=True))
    dynamics = list(loop.dynamics)
    for j in range(n):
        of_x, of_u = ([Symbol(f"d{s.name}/d{j}") for s in by] for by in (system.states, system.inputs))
        along = list(zip((*system.states, *system.inputs), (*of_x, *of_u), strict=True))
        dynamics += [total(differentiate(f, s) * v for s, v in along) for f in loop.dynamics]
        states |= {v: flint.arb(int(i == j)) for i, v in enumerate(of_x)}
        inputs |= {w: gain[i, j] for i, w in enumerate(of_u)}
    now = _values(dynamics, {**states, **inputs})
    mean = _mean_rate(dynamics, states, inputs, now, period)
    after = [v + ball(period) * g for v, g in zip(states.values(), mean, strict=True)]
    return after[:n], flint.arb_mat([after[n + i :: n] for i in range(n)])


def gain_at_origin(loop: ClosedLoop) -> flint.arb_mat:
    """The policy's Jacobian J (m, n) at the origin."""
    return policy_on(loop, [flint.arb(0)] * loop.network.n)[1]


def plant_at_origin(loop: ClosedLoop) -> tuple[flint.arb_mat, flint.arb_mat]:
    """A (n, n) and B (n, m) of the plant at the origin and u_eq."""
    A, B = (
        flint.arb_mat([[evaluate(e, {}, MeanSlopes(), {}) for e in row] for row in M]) for M in loop.plant_jacobians()
    )
    return A, B


def held_at_origin(loop: ClosedLoop, period: Fraction) -> tuple[flint.arb_mat, flint.arb_mat]:
    """A (n, n) and B (n, m) of the map over a period of the linearised plant whose input is held."""
    n, m = loop.system.n, loop.system.m
    A, B = plant_at_origin(loop)
    block = flint.arb_mat(n + m, n + m)
    for i in range(n):
        for j in range(n + m):
            block[i, j] = ball(period) * (A[i, j] if j < n else B[i, j - n])
    motion = block.exp()
    free = flint.arb_mat([[motion[i, j] for j in range(n)] for i in range(n)])
    forced = flint.arb_mat([[motion[i, n + j] for j in range(m)] for i in range(n)])
    return free, forced


def is_definite(M: flint.arb_mat) -> bool:
    """True if a symmetric matrix, given by its lower triangle, is certainly positive definite.

    The true pivots lie in the balls' pivots. A pivot that is not certainly positive shows nothing.
    """
    rows = [[M[i, j] for j in range(i + 1)] for i in range(M.nrows())]
    for k, top in enumerate(rows):
        if not top[k] > 0:
            return False
        for row in rows[k + 1 :]:
            factor = row[k] / top[k]
            for j in range(k + 1, len(row)):
                row[j] -= factor * rows[j][k]
    return True


def _jacobian(loop: ClosedLoop) -> flint.arb_mat:
    """The closed loop's Jacobian at the origin and u_eq."""
    A, B = plant_at_origin(loop)
    return A + B * gain_at_origin(loop)


def _held_map(loop: ClosedLoop, period: Fraction) -> flint.arb_mat:
    """The map over a period of the linearised plant whose input `-K x` is held."""
    free, forced = held_at_origin(loop, period)
    return free + forced * gain_at_origin(loop)


def _unclipped(loop: ClosedLoop) -> bool:
    """True if every input at the origin, before the clip, certainly lies strictly inside the clip's interval."""
    network = loop.network
    if network.clip is None:
        return True
    u, _ = policy_on(loop, [flint.arb(0)] * network.n)
    return all(bool(v > float(lo)) and bool(v < float(hi)) for v, lo, hi in zip(u, *network.clip, strict=True))


class _Numbers:
    def number(self, q: Fraction) -> flint.arb:
        return ball(q)

    def atanh(self, q: Fraction) -> flint.arb:
        return ball(q).atanh()

    def tanh(self, v: flint.arb) -> flint.arb:
        return v.tanh()

    def clip(self, v: flint.arb, lo: Fraction, hi: Fraction) -> flint.arb:
        return v.max(ball(lo)).min(ball(hi))


_NUMBERS = _Numbers()


def _centring(loop: ClosedLoop) -> tuple[Balls, Balls]:
    at_0 = _net(loop.network, [flint.arb(0)] * loop.network.n)
    return loop.network.centring(loop.u_eq, at_0, _NUMBERS)


def _net(network: PolicyNetwork, x: Balls) -> Balls:
    return network_on(network.network, _read(network, x))


class _Points(Networks[Balls]):
    """A network's vectors as balls."""

    def affine(self, step: Affine, v: Balls) -> Balls:
        return affine(step.weight, step.bias, v)

    def map(self, step: Map, v: Balls) -> Balls:
        return [step.phi.in_arb(b) for b in v]

    def clip(self, step: Clip, v: Balls) -> Balls:
        ends = zip(v, step.lo, step.hi, strict=True)
        return [b.max(flint.arb(float(lo))).min(flint.arb(float(hi))) for b, lo, hi in ends]

    def sum(self, step: Sum, *vectors: Balls) -> Balls:
        return [sum(row, flint.arb(0)) for row in zip(*vectors, strict=True)]

    def concat(self, step: Concat, *vectors: Balls) -> Balls:
        return [b for v in vectors for b in v]

    def product(self, step: Product, v: Balls, w: Balls) -> Balls:
        return [a * b for a, b in zip(*repeated(v, w), strict=True)]

    def observe(self, step: Observe, v: Balls) -> Balls:
        return _expressions(step.expressions, step.symbols, v)


_POINTS = _Points()
Tangent = tuple[Balls, flint.arb_mat]


class _Slopes(Networks[Tangent]):
    """The same with the Jacobian by the states, as `policy_on` says."""

    def affine(self, step: Affine, v: Tangent) -> Tangent:
        return affine(step.weight, step.bias, v[0]), matrix(step.weight) * v[1]

    def map(self, step: Map, v: Tangent) -> Tangent:
        return _POINTS.map(step, v[0]), _scaled([step.phi.slope_in_arb(b) for b in v[0]], v[1])

    def clip(self, step: Clip, v: Tangent) -> Tangent:
        return _POINTS.clip(step, v[0]), _scaled(_slopes_of_clip(v[0], step.lo, step.hi), v[1])

    def sum(self, step: Sum, *vectors: Tangent) -> Tangent:
        first, *others = (J for _, J in vectors)
        return _POINTS.sum(step, *(y for y, _ in vectors)), sum(others, first)

    def concat(self, step: Concat, *vectors: Tangent) -> Tangent:
        return _POINTS.concat(step, *(y for y, _ in vectors)), flint.arb_mat(
            [row for _, J in vectors for row in J.tolist()]
        )

    def product(self, step: Product, v: Tangent, w: Tangent) -> Tangent:
        (y, z), (J, K) = repeated(v[0], w[0]), repeated(v[1].tolist(), w[1].tolist())
        return _POINTS.product(step, v[0], w[0]), _scaled(y, flint.arb_mat(K)) + _scaled(z, flint.arb_mat(J))

    def observe(self, step: Observe, v: Tangent) -> Tangent:
        k, slopes = len(step.symbols), _expressions(step.slopes, step.symbols, v[0])
        own = flint.arb_mat([slopes[i : i + k] for i in range(0, len(slopes), k)])
        return _POINTS.observe(step, v[0]), own * v[1]


def _expressions(expressions: Sequence[Expression], symbols: Sequence[Symbol], v: Balls) -> Balls:
    values, known = dict(zip(symbols, v, strict=True)), dict[Expression, flint.arb]()
    return [evaluate(e, values, BallAlgebra(), known) for e in expressions]


def _read(network: PolicyNetwork, x: Balls) -> Balls:
    """The layers' inputs at a state."""
    return [v + at for v, at in zip(x, points(network.origin), strict=True)] if network.is_moved else list(x)


def network_on(network: Network, x: Balls) -> Balls:
    """A network's value on balls."""
    return _POINTS.run(network, x)


def affine(W: Array, b: Array, h: Balls) -> Balls:
    """W h + b on balls."""
    product = matrix(W) * flint.arb_mat([[v] for v in h])
    return [product[i, 0] + flint.arb(float(c)) for i, c in enumerate(b)]


def _scaled(by: Balls, J: flint.arb_mat) -> flint.arb_mat:
    """The matrix whose rows are multiplied by numbers."""
    return flint.arb_mat([[by[i] * J[i, j] for j in range(J.ncols())] for i in range(J.nrows())])


def matrix(W: Array) -> flint.arb_mat:
    """A binary64 matrix as a matrix of exact balls."""
    return _balls_of(np.asarray(W, dtype=np.float64).tobytes(), W.shape)


@lru_cache(maxsize=32)  # a network's numbers, which are exact at any precision, for all the states that it is asked at
def _balls_of(raw: bytes, shape: tuple[int, ...]) -> flint.arb_mat:
    return flint.arb_mat([points(row) for row in np.frombuffer(raw).reshape(shape)])


def points(x: Array) -> Balls:
    """Binary64 numbers as exact balls."""
    return [flint.arb(float(v)) for v in x]
