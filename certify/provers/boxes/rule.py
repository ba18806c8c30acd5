"""The rule for a box: an upper bound of D' = D + 2 lambda V on the part of the ring that lies in it.

D is V's increment over a step, by time: Vdot; V(F(x)) - V(x) in discrete time; (V(phi(h)) - V(x))/h where the input is
held over h. With the mean rate of the step, G = F; F(x) - x; (phi(h) - x)/h, it is `2 x'P G + h G'P G`.

Where a box sticks out of the ring, D' need not be negative on all of it. For any multiplier >= 0,
`D' < 0` on {V <= c2} follows from `D' + multiplier (c2 - V) < 0`, and on {V >= c1} from
`D' + multiplier (V - c1) < 0` (the S-procedure: Boyd, El Ghaoui, Feron, Balakrishnan 1994, section 2.6.3). Near the
point where {V <= c2} touches {D' >= 0} the two gradients are parallel, and the right multiplier cancels the first
order: close to the largest level this saves tenfold in boxes.

A bound over a step keeps something that no splitting takes away, because a solution leaves each box, however small.
The centre of a box is therefore bounded alone: if it cannot be proved, no splitting would help.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from certify.certificates.claims import Problem
from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import Expression, evaluate, nodes
from certify.loop.plants import System, kept_constraints
from certify.loop.policies import bounded_by_form
from certify.provers.bounds import (
    Enclosure,
    Flow,
    Models,
    Taylor,
    loop_models,
    operations_of_policy,
    policy_enclosure,
    upper_bound,
)
from certify.provers.bounds.arrays import Array, Mask, chosen, product
from certify.provers.bounds.compiled import loops
from certify.provers.bounds.flow import Mean, Values
from certify.provers.bounds.loop import played
from certify.provers.bounds.tape import Recording, Tape, Value, recorded
from certify.provers.bounds.taylor import EPS, TINY, ConstantsLast, V, inner_product
from certify.provers.boxes.form import FormBound
from certify.provers.boxes.kept import ConstraintModels, held_back
from certify.provers.boxes.lessening import lessened

_SLACK = 1e-9  # relative distance from the inner level at which a box counts as inside
_ENDS = 1e-11  # relative distance kept from the ends of the domain
_EACH = 2.0  # operations of an entry of a model
_PIECES = 2  # the most pieces of the policy in one of a batch
_THIRD = 6.0  # times what a symbol's terms of third order come to, it matters besides: measured
_POINT = 2.0**-20  # share of a box that is left of it around its centre


class BoxBounds(NamedTuple):
    """Bounds of each box: `proved` (B,), `bound` of D' (B,), `score` (n, B): how much each axis matters to the bound,
    `violated` (B,): a condition fails at the centre, or cannot be proved there; `smooth` (B,): the conditions inside
    the inner level hold; `decay` (B,): -D' at the centre, but for the policy's error."""

    proved: Mask
    bound: Array
    score: Array
    violated: Mask
    smooth: Mask
    decay: Array


def operations_of_box(loop: ClosedLoop, order: int = 2, more: int = 0) -> float:
    """Operations to bound a box, about, as an `Effort` counts them; with so many symbols more."""
    system = loop.system
    symbols = system.n + system.m + len(system.uncertain) + (system.sample is not None) + more
    times = 1 if system.sample is None else 2 + 2 * order**2
    asked = kept_constraints(system).values() if system.constraints else ()
    equations = sum(1 for _ in nodes(*system.uncertain_dynamics(), *asked)) * times + system.n * (system.n + 3)
    return operations_of_policy(loop.network) + _EACH * equations * (symbols + 1) ** 2


class VdotBound:
    """Upper bounds of D', which is Vdot in continuous time, and bounds of V, over boxes in the coordinates z.

    With `inside`, a box on which V is below the inner level is proved if F is enclosed there and the inputs keep their
    bounds, and, if time has steps, no step leads from it to V of at least that level; without `inside` nothing is
    required there. `order` is that of the series in time where the input is held.
    """

    def __init__(self, problem: Problem, T: Array, inside: bool = False, order: int = 2) -> None:
        self.inside = inside
        loop = problem.loop
        self.system = loop.system
        self.rate = problem.rate
        self.T = np.ascontiguousarray(T)
        self.P = problem.V.P
        self.V = FormBound(self.P, T)
        self.operations = operations_of_box(loop, order)
        self.policy = policy_enclosure(loop)
        self.piece = _PIECES * self.policy.piece
        self.dynamics: tuple[Expression, ...] = loop.system.uncertain_dynamics()
        self.check_inputs = not bounded_by_form(loop.network, loop.system.input_bounds)
        sample = loop.system.sample
        self.flow = None if sample is None else Flow(self.dynamics, sample, order, bool(problem.keep))
        self.order = 1 if self.flow is None else order
        self.step = loop.step
        self.tape: Tape | None = None  # the tape of D, recorded when it is first played
        self.constraints = ConstraintModels(loop.system, problem.keep) if problem.keep else None
        self.ends = np.array([[float(end) for end in pair] for pair in loop.system.domain]).T[:, :, None]
        self.extent = (np.sqrt(np.diag(np.linalg.inv(self.P))) * (1 + 1e-9))[:, None]  # half-widths of {V <= 1}

    def levels(self, lo: Array, hi: Array) -> tuple[Array, Array]:
        """Bounds of V from below and above on boxes (n, B)."""
        return self.V.levels(lo, hi)

    def levels_at(self, z: Array) -> Array:
        """V at points (n, B)."""
        return self.V.at(z)

    @np.errstate(all="ignore")  # infinities and NaN are answers, which nothing is proved with
    def at_points(self, z: Array, outer: float) -> Array:
        """The bound of D' at points (n, B) in {V <= outer}; infinite where nothing is known of it."""
        return np.nan_to_num(
            self._judge(z, np.zeros_like(z), z, z, 0.0, outer).bound, nan=np.inf, posinf=np.inf, neginf=-np.inf
        )

    def levels_after(self, z: Array, outer: float) -> Array:
        """V after a step from points (n, B) in {V <= outer}, from above; infinite where nothing is known of it."""
        return self.levels_at(z) + self.step * self.at_points(z, outer)

    @np.errstate(all="ignore")
    def __call__(self, lo: Array, hi: Array, inner: float, outer: float) -> BoxBounds:
        """Bounds on inner <= V <= outer within boxes lo, hi (n, B)."""
        centre = 0.5 * lo + 0.5 * hi
        radius = np.maximum(hi - centre, centre - lo) * (1 + EPS)
        found = self._judge(centre, radius, lo, hi, inner, outer)
        if self.step == 0:
            return found
        asked = ~found.proved & ~found.violated
        if not self.inside:
            asked = asked & (self.levels_at(centre) >= inner)
        index = chosen(asked)
        if len(index):
            z, small = centre.take(index, -1), _POINT * radius.take(index, -1)
            found.violated[index] = ~self._judge(z, small, z - small, z + small, inner, outer).proved
        return found

    def _judge(self, centre: Array, radius: Array, lo: Array, hi: Array, inner: float, outer: float) -> BoxBounds:
        n = self.system.n
        slopes_x = self.T[:, :, None] * radius
        x = np.concatenate([product(self.T, centre)[:, None], slopes_x], 1)
        error = 2 * (n + 4) * EPS * product(np.abs(self.T), np.abs(centre) + radius) + TINY
        mid, slopes, wide, share = self.policy(x, error)
        decrease, third, kept, during = self._decrease(x, error, mid, slopes, wide, outer)
        if self.rate:
            decrease = decrease + self.V.model(centre, radius, decrease).scaled(2 * self.rate)
        above = decrease.with_squares(third)
        bound, excess = upper_bound(above)
        excess = excess + _THIRD * third
        smooth = np.isfinite(bound)  # a component of F that is not enclosed leaves a NaN in the sum over all
        # At the box's centre, and for the worst values of the uncertain quantities, only the inputs' errors, the terms
        # of second order in all these, and the remainder are left.
        known = n + self.system.m
        doubt = (
            np.abs(decrease.g[n:known]).sum(0) + np.abs(decrease.Q[n:, n:]).sum((0, 1)) + decrease.r + third[n:].sum(0)
        )
        violated = decrease.c + np.abs(decrease.g[known:]).sum(0) - doubt >= 0
        bound = self._within_ring(bound, above, lo, hi, centre, radius, inner, outer)
        proved = bound < 0
        if self.inside and self.step == 0:
            proved = smooth & (proved | (self.levels(lo, hi)[1] < inner * (1 - _SLACK)))
        # The inputs' errors and the remainder are charged to the axes that spread the network.
        extra = excess[n:].sum(0) + decrease.r
        score = excess[:n] + share * extra
        score = np.where(np.isfinite(score), score, np.abs(slopes_x).sum(0))
        if kept is not None:
            score = np.where(kept, score, np.abs(slopes_x).sum(0))
            proved, bound = proved & kept, np.where(kept, bound, np.inf)
        if self.check_inputs:
            found = input_bounds_kept(self.system, self.policy, x, error, mid, slopes, wide)
            for j, (inside, outside) in enumerate(found):
                proved, violated, smooth = proved & inside, violated | outside, smooth & inside
                score = np.where(inside, score, np.abs(slopes[j]) + share * wide[j])
        if self.constraints is not None:
            asked = self.constraints
            models = asked(x, error, mid, slopes, wide) if during is None else asked.during(during)
            for held in held_back(models, known, self.V, centre, radius, outer):
                proved, violated, smooth = proved & held.inside, violated | held.outside, smooth & held.inside
                score = np.where(held.inside, score, held.score[:n] + share * held.score[n:].sum(0))
        if self.inside and self.step:
            smooth = proved
        return BoxBounds(proved, bound, score, violated, smooth, -decrease.c)

    def _decrease(
        self, x: Array, error: Array, mid: Array, slopes: Array, wide: Array, outer: float
    ) -> tuple[Taylor, Array, Mask | None, Sequence[Values] | None]:
        """D, what its third order adds (see `inner_product`), where (B,) the solution stays in the domain over a period
        in which the input is held, if it is, and what all values are in its quarters.

        Symbols: n box coordinates, m input errors, k uncertain quantities, and the period if that is in a range.
        """
        if self.flow is None:
            if self.tape is None:
                count = self.system.n + self.system.m + len(self.system.uncertain)
                self.tape = recorded(count, self._at_rates)
            how = loops(0)  # the policy's own output counts
            return *played(how, self.tape, self.system, x, error, mid, slopes, wide), None, None
        states, inputs, quantities = loop_models(self.system, x, error, mid, slopes, wide, self.flow.symbols)
        here = list(states.values())
        models = Models(here[0])
        mean = self.flow(states, inputs, quantities, self.system.n + self.system.m)
        moved = [self.flow.times_period(rate) for rate in mean.G]
        kept = mean.exists & self._in_domain(here, mean, outer)
        return *inner_product(self._along(here, moved, models), mean.G), kept, mean.during

    def _at_rates(self, values: Sequence[Value], algebra: Recording) -> Value:
        """D where the input is not held over time, from states, inputs and uncertain quantities."""
        system = self.system
        known: dict[Expression, Value] = {}
        symbols = [*system.states, *system.inputs, *(symbol for symbol, _ in system.uncertain)]
        named, here = dict(zip(symbols, values, strict=True)), values[: system.n]
        G: list[Value] = [evaluate(expression, named, algebra, known) for expression in self.dynamics]
        if system.time == "discrete":
            G = [after + before.scaled(-1.0) for after, before in zip(G, here, strict=True)]
        terms = [row.in_inner(rate) for row, rate in zip(self._along(here, G, algebra), G, strict=True)]
        return algebra.total(None, terms)

    def _along(self, here: Sequence[V], moved: Sequence[V], algebra: ConstantsLast[V]) -> list[V]:
        """P (2 x + h G), of which the inner product with G is D; `moved` is h G."""
        if not self.step:
            return algebra.combined(2.0 * self.P, here)
        return algebra.combined(self.P, [v.scaled(2.0) + by for v, by in zip(here, moved, strict=True)])

    def _in_domain(self, states: list[Taylor], mean: Mean, outer: float) -> Mask:
        """True (B,) if the solution from V <= outer stays inside the domain over the longest period."""
        centre = np.stack([model.c for model in states])
        reach = np.stack([model.radius() for model in states])
        wide = outer**0.5 * self.extent
        down = np.maximum(centre - reach, -wide) - mean.down
        up = np.minimum(centre + reach, wide) + mean.up
        low, high = self.ends
        slack = _ENDS * (np.abs(low) + np.abs(high) + np.abs(centre) + reach)
        inside: Mask = ((down > low + slack) & (up < high - slack)).all(0)
        return inside

    def _within_ring(
        self,
        bound: Array,
        decrease: Taylor,
        lo: Array,
        hi: Array,
        centre: Array,
        radius: Array,
        inner: float,
        outer: float,
    ) -> Array:
        """The bound, made tighter by the S-procedure where it is not negative and the box sticks out of the ring.

        Where nothing but a step's end shows that it does not lead out of {V < inner}, on boxes that meet that set, the
        multiplier of V - inner is at most 1/h, and there is no other.
        """
        n = len(centre)
        lowest, highest = self.levels(lo, hi)
        below, beyond = lowest < inner, highest > outer
        most = np.inf
        if self.inside and self.step:
            below = lowest < inner * (1 + _SLACK)
            beyond = beyond & ~below
            most = (1 - 1e-12) / self.step
        for level, sign, outside in ((outer, 1.0, beyond), (inner, -1.0, below)):
            index = chosen(outside & ~(bound < 0))
            if not len(index):
                continue
            # it is >= 0 in the ring
            part = decrease.at(index)
            gap = self.V.gap(centre.take(index, -1), radius.take(index, -1), part, level, sign)
            bound[index] = lessened(bound[index], part, gap, n, most)
        return bound


def input_bounds_kept(
    system: System, policy: Enclosure, x: Array, error: Array, mid: Array, slopes: Array, wide: Array
) -> list[tuple[Mask, Mask]]:
    """Two masks (B,) for each input, on boxes of states `x[:, 0] + x[:, 1:] d` within `error`: it lies in its bounds on
    the box, as `mid + slopes.d` within `wide` or as the squash is monotone; and it certainly leaves them at the centre.
    """
    low, high = np.array([[float(end) for end in pair] for pair in system.input_bounds]).T[:, :, None]
    slack = 1e-11 * (np.abs(low) + np.abs(high))
    low, high = low + slack, high - slack
    reach = np.abs(slopes).sum(1) + wide + 1e-11 * np.abs(mid)
    inside = (mid - reach > low) & (mid + reach < high)
    left = chosen(~inside.all(0))
    if len(left) and policy.squash and policy.clip is None:
        least, most = policy.between(x.take(left, -1), error.take(left, -1))
        inside[:, left] |= (least > low) & (most < high)
    outside = (mid - wide > high + 2 * slack) | (mid + wide < low - 2 * slack)
    return list(zip(inside, outside, strict=True))
