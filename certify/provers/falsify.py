"""The falsifier: the lowest V at which D' >= 0, the input leaves its bounds, or a constraint is violated.

D' = D + 2 lambda V, where D is Vdot, or V's increment over a step by time. Violating samples of the ellipsoid are
improved by descending V along D' = 0, each on its own so that they end in different valleys: a gradient step on D'
along the sphere V = const makes room, and the point is scaled towards the origin as far as it stays violating. A
reported witness is shown in Arb; the search itself proves nothing.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from certify.certificates.claims import Problem
from certify.effort import UNLIMITED, Effort
from certify.loop.constraints import Constraints, is_violated_at
from certify.loop.networks import Gradients
from certify.loop.plants import System, at_values, corners, mean_rate
from certify.loop.policies import bounded_by_form
from certify.loop.rigorous import evaluate_increment, evaluate_policy

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
_RATIO, _LEVELS, _LOWER = 1.4, 60, 13  # a survey: ratio of levels, their number, further steps of 8
_CALL, _EACH = 3e5, 0.3  # operations of evaluating few states at once; of an operation at one, with its derivative
_TOGETHER = 15  # levels that are looked at in one batch
_SPREAD, _WORST = 64, 64  # samples of a level from which a survey climbs: in all directions, and the worst ones
Kind = Literal["vdot", "input", "keep"]
_STARTS = 256  # points from which each constraint is looked for
_APART = 1e-7  # share of a state's or an input's size between the points of a difference
_NEAR_0 = 1e-6  # share of the largest state, below which the rounding of the policy hides its values
_CASES = 8  # corners of the ranges, and periods, at which a state is shown to violate: the worst ones


@dataclass(frozen=True, slots=True)
class Witness:
    """A state `x` (n,) with D' >= 0 (kind `vdot`), an input out of bounds (`input`), or a `constraint` that is violated
    (`keep`), by its name; `level` is V(x), rounded.

    `values` are those of what is uncertain, at which it is so, and `period` the sampling period; None without one.
    """

    x: Array
    level: float
    kind: Kind
    values: Mapping[str, Fraction] = field(default_factory=dict)
    period: Fraction | None = None
    constraint: str = ""

    def describe(self, system: System, rate: float = 0.0) -> str:
        """The violation in words, of a claim with this rate."""
        names = ", ".join(f"{s} = {v:.6g}" for s, v in zip(system.states, self.x, strict=True))
        names += "".join(f", {name} = {float(q):.6g}" for name, q in self.values.items())
        names += ", in deviations from x_eq," if system.operating_point() else ""
        what = "the input leaves its bounds" if self.kind == "input" else "Vdot >= 0"
        what = f"the constraint {self.constraint} is violated" if self.kind == "keep" else what
        at_rate = f" faster than at the rate {rate:g}" if rate else ""
        if self.kind == "vdot" and rate:
            what = f"V does not fall{at_rate}"
        if self.kind == "vdot" and (system.time == "discrete" or self.period):
            over = "a step" if self.period is None else f"a period of {float(self.period):.6g}"
            what = f"V does not fall{at_rate} over {over}"
        return f"{what} at {names} with V = {self.level:.12g} (shown in Arb)"


@dataclass(frozen=True, slots=True)
class Band:
    """Levels between which sampling found no violation; `below` and `above` are their neighbours, at which it did,
    or the ends of the samples."""

    below: float
    floor: float
    top: float
    above: float


def falsify(
    problem: Problem, T: Array, limit: float, samples: int = 20_000, seed: int = 0, effort: Effort = UNLIMITED
) -> Witness | None:
    """Search {V <= limit} for the lowest violation; None if none was found. `x = T z`, (n, n): T'PT is about I.

    Where the effort ends, the search ends with what it has.
    """
    search = _Search(problem, T, effort)
    generator = np.random.default_rng(seed)
    n = problem.loop.system.n
    direction = generator.standard_normal((samples, n))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    # Half of the samples on the boundary, where violations usually begin, half spread over the levels.
    radius = np.where(np.arange(samples) % 2 == 0, 1.0, generator.random(samples))
    z = direction * (radius * np.sqrt(limit) * (1 - 1e-9))[:, None]
    if search.constraints is not None:
        effort.charge(search.constraints.operations(n, _STARTS))
        z = np.concatenate([z, search.constraints.touching(T, limit, z[:_STARTS])])
    best = search.lowest(z)
    if best is None and not effort.over:  # climb D' on the boundary before giving up
        z = search.climb(z[:: max(1, samples // 512)], limit)
        best = search.lowest(z)
    return best


def touch(problem: Problem, T: Array, limit: float, seed: int = 0) -> Witness | None:
    """Search {V <= limit} for the lowest violation of a constraint; None if none was found, or none can be."""
    if not problem.keep:
        return None
    search, n = _Search(problem, T), problem.loop.system.n
    direction = np.random.default_rng(seed).standard_normal((_STARTS, n))
    z = direction / np.linalg.norm(direction, axis=1, keepdims=True) * np.sqrt(limit)
    return search.touched(z, limit)


def is_violated(problem: Problem, T: Array, limit: float, samples: int = 4000, seed: int = 0) -> bool:
    """True if a violation is sampled in {V <= limit}, at any level, in floats: nothing is shown of it."""
    search = _Search(problem, T)
    direction = np.random.default_rng(seed).standard_normal((samples, problem.loop.system.n))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    radius = np.sqrt(limit) * (1 - 1e-9) * np.linspace(0.01, 1.0, samples)
    z = np.concatenate([direction * radius[:, None], search.climb(direction[::8] * radius[-1], limit)])
    return bool(search.bad(z).any())


def survey(
    problem: Problem, T: Array, limit: float, samples: int = 512, seed: int = 0, effort: Effort = UNLIMITED
) -> list[Band]:
    """The bands of levels up to `limit` on which no violation was found, the highest first: by samples, and by ascent
    from some of them; once the effort is over, samples are not climbed from."""
    search = _Search(problem, T, effort)
    steps = 20 if problem.loop.system.sample is None else 8  # each of many times the work
    generator = np.random.default_rng(seed)
    direction = generator.standard_normal((samples, problem.loop.system.n))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)

    def clear(level: Array, steps: int) -> list[bool]:
        """True for each level (k,) whose samples show no violation, after so many steps of ascent from some of them."""
        found: list[bool] = []
        for k in range(0, len(level), _TOGETHER):
            each = level[k : k + _TOGETHER, None, None]
            z = (np.sqrt(each) * direction).reshape(-1, direction.shape[1])
            if steps:
                starts = _promising(search, z.reshape(len(each), *direction.shape))
                z = search.climb(starts, np.repeat(each.ravel(), len(starts) // len(each))[:, None], steps)
            found += [not bad.any() for bad in search.bad(z).reshape(len(each), -1)]
        return found

    def good(levels: list[float]) -> list[bool]:
        level = np.array(levels)
        found = np.array(clear(level, 0))
        found[found] = clear(level[found], steps)
        return [bool(ok) for ok in found]

    levels = [limit * _RATIO**-k for k in range(_LEVELS)]  # from the highest
    found = good(levels)
    if found[-1]:  # on to the first at which one is found
        lower = [levels[-1] * _RATIO ** (-8 * k) for k in range(1, _LOWER + 1)]
        further = good(lower)
        count = next((k + 1 for k, ok in enumerate(further) if not ok), _LOWER)
        levels, found = levels + lower[:count], found + further[:count]
    runs = [list(run) for ok, run in itertools.groupby(range(len(levels)), key=found.__getitem__) if ok]
    last = len(levels) - 1
    return [Band(levels[min(k[-1] + 1, last)], levels[k[-1]], levels[k[0]], levels[max(k[0] - 1, 0)]) for k in runs]


def descend(problem: Problem, T: Array, z: Array) -> Witness | None:
    """The lowest violation reached from a violating point `x = T z`, shape (n,)."""
    return _Search(problem, T).lowest(z[None])


def confirm(problem: Problem, witness: Witness) -> bool:
    """True if the violation at the witness's binary64 point is shown in Arb."""
    loop = problem.loop
    if witness.kind == "vdot":
        held = replace(loop, system=at_values(loop.system, witness.values)) if witness.values else loop
        found = evaluate_increment(held, problem.V.P, witness.x, witness.period, problem.rate)
        return bool(np.any(witness.x != 0)) and found >= 0
    if witness.kind == "keep":
        return is_violated_at(problem.loop, witness.constraint, witness.x, witness.values)
    for u, (lo, hi) in zip(evaluate_policy(loop, witness.x), loop.system.input_bounds, strict=True):
        if u * lo.denominator < lo.numerator or u * hi.denominator > hi.numerator:
            return True
    return False


def refutes(problem: Problem, witness: Witness, level: float) -> bool:
    """True if the witness shows that a condition of the asymptotic claim fails on {V <= level}.

    The violation is shown in Arb, and `V(x) <= level` is decided in rationals: a point that lies above the level by
    less than a rounding says nothing about it.
    """
    return problem.V.exactly(witness.x) <= Fraction(level) and confirm(problem, witness)


def _promising(search: _Search, z: Array) -> Array:
    """Samples to climb from, (k * fewer, n), of those (k, B, n) on each of k spheres: some in all directions, and
    those of the largest D', or next to a bound."""
    vdot, excess = search.violation(z.reshape(-1, z.shape[-1]))
    every = max(1, z.shape[1] // _SPREAD)
    found = [z[:, ::every]]
    for value in (vdot, excess) if search.asks_more else (vdot,):
        worst = np.argsort(-value.reshape(z.shape[:2]), axis=1, kind="stable")[:, :_WORST]
        found.append(np.take_along_axis(z, worst[:, :, None], axis=1))
    return np.concatenate(found, axis=1).reshape(-1, z.shape[-1])


class _Search:
    def __init__(self, problem: Problem, T: Array, effort: Effort = UNLIMITED) -> None:
        self.problem, self.T, self.effort = problem, T, effort
        self.loop, self.network, self.P = problem.loop, problem.loop.folded, problem.V.P
        self.f = self.loop.system.uncertain_function()
        self.corners = corners(self.loop.system)
        system = self.loop.system
        self.periods: list[Fraction | None] = [None] if system.sample is None else [*dict.fromkeys(system.sample)]
        self.worst = self._worst()
        self.lo, self.hi = np.array([[float(end) for end in pair] for pair in system.input_bounds]).T
        self.check_inputs = not bounded_by_form(self.network, system.input_bounds)
        self.constraints = Constraints(self.loop) if problem.keep else None
        self.asks_more = self.check_inputs or self.constraints is not None

    @np.errstate(all="ignore")
    def violation(self, z: Array) -> tuple[Array, Array]:
        """(D', how far the worst input lies outside its bounds, or the largest g of a constraint) at x = T z, (B,)."""
        self._charge(len(z), 1)
        x = z @ self.T.T
        return self._at(x, self.loop.policy(x))

    def _charge(self, states: int, evaluations: int) -> None:
        """Count evaluations of the equations at states, and of the policy with each."""
        again = len(self.corners) * len(self.periods) - 1  # the policy's values are the same for all
        each = self.loop.operations + again * self.loop.of_equations
        self.effort.charge(_CALL + _EACH * states * evaluations * each * (4 if self.loop.system.sample else 1))

    @np.errstate(all="ignore")
    def _at(self, x: Array, u: Array) -> tuple[Array, Array]:
        decrease = [self._decrease(x, u, values, step) for values, step in self.worst]
        beyond = np.maximum(self.lo - u, u - self.hi).max(-1)
        if self.constraints is not None:
            worst = self.constraints.at(x, u).max(-1)
            beyond = np.maximum(beyond, worst) if self.check_inputs else worst
        return np.concatenate(decrease).max(0), beyond

    @np.errstate(all="ignore")
    def _inputs(self, x: Array) -> tuple[Array, Array, Gradients]:
        """u (B, m), its values before the clip, and the network with its derivatives there."""
        network, inner = self.network, Gradients(self.network.network, x)
        whole = network.scale * network.squashed(inner.value) + network.offset
        return network.clipped(whole), whole, inner

    def _slopes(self, z: Array) -> tuple[Array, Array, Array, Array]:
        """`violation` at z (B, n), and the gradients (B, n) of both: by differences in x and u, and from u on by the
        chain rule."""
        x, n = z @ self.T.T, z.shape[1]
        self._charge(len(z), n + self.network.m + 3)
        u, whole, inner = self._inputs(x)
        size = np.linalg.norm(z, axis=-1, keepdims=True) * np.linalg.norm(self.T, axis=1)
        apart = _APART * np.concatenate([size, np.broadcast_to(np.abs(self.network.scale), u.shape)], -1) + 1e-300
        here = np.concatenate([x, u], -1)
        ways = np.eye(here.shape[1])
        moved = np.concatenate([here[None], here + ways[:, None] * apart]).reshape(-1, len(ways))
        values = [v.reshape(-1, len(z)) for v in self._at(moved[:, :n], moved[:, n:])]
        slopes = [((v[1:] - v[0]) / apart.T).T for v in values]
        gradients = [(s[:, :n] + self._backwards(s[:, n:], whole, inner)) @ self.T for s in slopes]
        return values[0][0], values[1][0], gradients[0], gradients[1]

    def _backwards(self, slope: Array, whole: Array, inner: Gradients) -> Array:
        """The slope in the states (B, n) that follows from a slope in the inputs (B, m)."""
        network = self.network
        if network.clip is not None:
            slope = np.where((whole > network.clip[0]) & (whole < network.clip[1]), slope, 0.0)
        behind = network.squash_slope(network.squashed(inner.value))
        return inner.backwards(slope * network.scale * behind)

    def _worst(self) -> list[tuple[list[Array], float | Array]]:
        """Corners (C, 1) of the ranges and steps, one for all or (C, 1, 1), at which D' is looked at together."""
        rows = [[float(q) for q in corner.values()] for corner in self.corners]

        def columns(times: int) -> list[Array]:
            return [np.array(column * times)[:, None] for column in zip(*rows, strict=True)]

        if self.periods == [None]:
            return [(columns(1), self.loop.step)]
        positive = [float(period) for period in self.periods if period]
        steps = np.array([h for h in positive for _ in rows])[:, None, None]
        found: list[tuple[list[Array], float | Array]] = [(columns(len(positive)), steps)]
        return found if len(positive) == len(self.periods) else [*found, (columns(1), 0.0)]

    def _decrease(self, x: Array, u: Array, values: list[Array], step: float | Array) -> Array:
        """D' (C, B) for constant values of what is uncertain, or (1, B) without any."""
        G = mean_rate(self.loop.system, lambda y, v: self.f(y, v, values), x[None], u, step)
        gradient = 2 * (x @ self.P)
        result: Array = (gradient * G).sum(-1)
        if self.loop.step:
            result = result + (step * (G @ self.P) * G).sum(-1)
        if self.problem.rate:
            result = result + self.problem.rate * (gradient * x).sum(-1)
        return result

    def bad(self, z: Array) -> Mask:
        """True (B,) where a condition fails."""
        vdot, excess = self.violation(z)
        return (vdot >= 0) | (excess > 0) if self.asks_more else vdot >= 0

    @np.errstate(all="ignore")
    def lowest(self, start: Array) -> Witness | None:
        """The lowest violation reached from the points `start` (B, n)."""
        z = start[self.bad(start)]
        if len(z) == 0:
            return None
        z = self._lowest_few(self._shrink(self._lowest_few(z, 2048), 1.0, halvings=8), 32)
        step = np.full((len(z), 1), 0.3)
        for _ in range(60):
            norm = np.linalg.norm(z, axis=-1, keepdims=True)
            moved = z + step * norm * self._uphill(z)
            moved = moved * (norm / np.linalg.norm(moved, axis=-1, keepdims=True))
            bad = self.bad(moved)[:, None]
            moved = np.where(bad, self._shrink(moved, np.minimum(4 * step, 1.0), halvings=10), z)
            better = np.linalg.norm(moved, axis=-1, keepdims=True) < norm
            z = np.where(better, moved, z)
            step = np.minimum(np.where(better, 1.5 * step, 0.4 * step), 0.5)
            if float(step.max()) < 1e-7 or self.effort.over:
                break
        return self._shown(self._lowest_few(_lifted(self, self._shrink(z, 1.0, halvings=50), start), 32))

    def _shown(self, z: Array) -> Witness | None:
        """A violation at one of these points (B, n): the binary64 state is what counts, so that a point is pulled
        outwards until the violation is certain there."""
        for point in z:
            for factor in (1.0, 1 + 1e-12, 1 + 1e-9, 1 + 1e-6):
                x = self.T @ (factor * point)
                for witness in self._witnesses(x, float(self.problem.V(x))):
                    if confirm(self.problem, witness):
                        return witness
        return None

    def _witnesses(self, x: Array, level: float) -> Iterator[Witness]:
        """All that may be violated at a state."""
        for period, values in _worst_cases(self, x):
            yield Witness(x, level, "vdot", values, period)
        if self.check_inputs:
            yield Witness(x, level, "input", self.corners[0])
        for name in () if self.constraints is None else self.constraints.names:
            for values in self.corners:
                yield Witness(x, level, "keep", values, constraint=name)

    def touched(self, start: Array, limit: float) -> Witness | None:
        """The lowest violation of a constraint in {V <= limit}, looked for from points (N, n)."""
        if self.constraints is None:
            return None
        z = self.constraints.touching(self.T, limit, start)
        x = z @ self.T.T
        z = z[self.constraints.worst(x) > 0] if len(z) else z
        for point in self._lowest_few(z, 32):
            x = self.T @ point
            every = self._witnesses(x, float(self.problem.V(x)))
            shown = (one for one in every if one.kind == "keep" and confirm(self.problem, one))
            if (found := next(shown, None)) is not None:
                return found
        return None

    @np.errstate(all="ignore")
    def climb(self, start: Array, limit: float | Array, steps: int = 60) -> Array:
        """Gradient ascent of D' from `start` (B, n) on the sphere V = limit, or each point's own, (B, 1)."""
        z, radius, step = start, np.sqrt(limit) * (1 - 1e-9), 0.1
        for _ in range(steps):
            vdot, _, by_vdot, by_excess = self._slopes(z)
            square = (z * z).sum(-1, keepdims=True)
            gradient = by_vdot / square - 2 * vdot[:, None] * z / (square * square)
            gradient = gradient + by_excess if self.asks_more else gradient
            moved = z + step * radius * gradient / (np.linalg.norm(gradient, axis=-1, keepdims=True) + 1e-300)
            z = radius * moved / np.linalg.norm(moved, axis=-1, keepdims=True)
            step *= 0.95
            if self.effort.over:
                break
        return z

    def _lowest_few(self, z: Array, count: int) -> Array:
        return z[np.argsort((z * z).sum(-1), kind="stable")][:count]

    def _shrink(self, z: Array, share: float | Array, halvings: int) -> Array:
        """Scale violating points down to where they just violate, by bisection, but by `share` (B, 1) at most."""
        high = np.ones((len(z), 1))
        low = high - share
        whole = self.bad(low * z)[:, None] & (low > 0)
        least = low
        for _ in range(halvings):
            middle = (low + high) / 2
            bad = self.bad(middle * z)[:, None]
            low, high = np.where(bad, low, middle), np.where(bad, middle, high)
        return np.asarray(np.where(whole, least, high) * z)

    def _uphill(self, z: Array) -> Array:
        """Unit directions (B, n), tangent to the sphere, in which the violation grows fastest."""
        vdot, _, gradient, by_excess = self._slopes(z)
        if self.asks_more:
            gradient = np.where(vdot[:, None] >= 0, gradient, by_excess)
        z = z / np.linalg.norm(z, axis=-1, keepdims=True)
        tangent = gradient - (gradient * z).sum(-1, keepdims=True) * z
        return np.asarray(tangent / (np.linalg.norm(tangent, axis=-1, keepdims=True) + 1e-300))


def _lifted(search: _Search, z: Array, start: Array) -> Array:
    """Violating points (B, n), those moved outwards that are so near to the origin that floats say nothing there.

    A V that rises at all radii along a ray is refuted as well by a state of a size that can be computed with.
    """
    size = np.max(np.abs(z), axis=-1, keepdims=True)  # squares may be below binary64's numbers
    norm = size * np.linalg.norm(z / np.maximum(size, 1e-300), axis=-1, keepdims=True)
    least = _NEAR_0 * np.max(np.linalg.norm(start, axis=-1))
    lifted = np.where((norm > 0) & (norm < least), z / np.maximum(norm, 1e-300) * least, z)
    return np.asarray(lifted[search.bad(lifted)])


@np.errstate(all="ignore")
def _worst_cases(search: _Search, x: Array) -> list[tuple[Fraction | None, Mapping[str, Fraction]]]:
    """The periods and the corners of the ranges at which D' is not negative at a state (n,), in floats; the worst
    first."""
    u = search._inputs(x[None])[0]
    decrease = np.concatenate([search._decrease(x[None], u, values, step) for values, step in search.worst])[:, 0]
    later = sorted(search.periods, key=lambda period: period == 0)  # as `worst` has them
    every = list(itertools.product(later, search.corners))
    return [every[k] for k in np.argsort(-decrease, kind="stable")[:_CASES] if not decrease[k] < 0]
