"""The rules for a box of an outer set's trees: N falls on it, or nothing is asked there (FORMAT.md, `faces`, `outer`).

Cheap tests come first, and only the boxes that they leave open go further: the box's place in the domain and in V, then
N's model, then the policy, the plant and N'F. A proof for a level n2 holds for each lower one, because `k (n2 - N)`
only falls with it and the multipliers do not depend on it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from certify.certificates.claims import Problem
from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import Expression, Symbol, evaluate, nodes
from certify.loop.plants import System
from certify.loop.policies import bounded_by_form
from certify.lyapunov.neural import Neural
from certify.lyapunov.symbolic import Symbolic
from certify.provers.bounds import (
    Models,
    NeuralEnclosure,
    NeuralModels,
    SymbolicEnclosure,
    SymbolicModels,
    Taylor,
    loop_models,
    operations_of_policy,
    policy_enclosure,
    upper_bound,
)
from certify.provers.bounds.arrays import Array, Index, Mask, chosen, is_whole, joined, pieces, product
from certify.provers.bounds.taylor import EPS, TINY
from certify.provers.boxes.form import FormBound
from certify.provers.boxes.lessening import lessened
from certify.provers.boxes.rule import input_bounds_kept

_SLACK = 1e-9  # relative distance from c2 at which a box counts as inside
_ENDS = 1e-11  # relative distance kept from the ends of the domain
_EACH = 2.0  # operations of an entry of a model
_NUMBERS = 2**19  # in the largest tensor of a piece of a batch, so that it stays in a core's cache


class OuterBounds(NamedTuple):
    """Bounds of each box: `proved` (B,), `bound` (B,) of what has to be negative, `score` (n, B): what each axis adds
    to the bound, `lowest` (B,): N is at least that where something is asked, infinite where nothing is; and `violated`
    (B,): N at the centre where a condition fails there, else infinite."""

    proved: Mask
    bound: Array
    score: Array
    lowest: Array
    violated: Array


@dataclass(frozen=True, slots=True)
class OnBoxes:
    """Models on boxes: `fall` of N'F, `N`, and `values` of what equations read; `smooth` (B,) where N and F are finite;
    the shares of the inputs' errors and of remainders with which each axis (n, B) is charged; centres and radii."""

    fall: Taylor
    N: Taylor
    smooth: Mask
    values: Mapping[Symbol, Taylor]
    share: Array
    spread: Array
    centre: Array
    radius: Array

    def score(self, excess: Array, of: Taylor) -> Array:
        """The score (n, B) of each axis by a bound's `excess`: the inputs' errors are charged to the axes that spread
        the policy, and the rest to those of N."""
        n = len(self.centre)
        return np.asarray(excess[:n] + self.share * excess[n:].sum(0) + self.spread * of.r)


def enclosure_of(function: Neural | Symbolic) -> NeuralEnclosure | SymbolicEnclosure:
    """Models of N, whatever it is."""
    return NeuralEnclosure(function) if isinstance(function, Neural) else SymbolicEnclosure(function)


class LoopOnN(ABC):
    """A rule about N and the loop on boxes in the coordinates z, x = T z, wherever N <= n2 in the domain; there each g
    of `keep` is negative."""

    def __init__(
        self, loop: ClosedLoop, T: Array, function: Neural | Symbolic, keep: Sequence[Expression] = ()
    ) -> None:
        self.system = loop.system
        self.T = np.ascontiguousarray(T)
        self.N = enclosure_of(function)
        self.policy = policy_enclosure(loop)
        self.dynamics, self.keep = self.system.uncertain_dynamics(), tuple(keep)
        self.check_inputs = not bounded_by_form(loop.network, self.system.input_bounds)
        self.ends = np.array([[float(end) for end in pair] for pair in self.system.domain]).T[:, :, None]
        symbols = self.system.n + self.system.m + len(self.system.uncertain)
        equations = sum(1 for _ in nodes(*self.dynamics, *self.keep)) + 3 * self.system.n
        own = _EACH * (1 + symbols) ** 2 * (equations + 4 * self.N.units)
        self.operations = operations_of_policy(loop.network) + own  # of a box, roughly
        self.piece = max(16, _NUMBERS // (self.N.units * (1 + symbols) * (2 + symbols) // 2))

    @np.errstate(all="ignore")  # infinities and NaN are answers, which nothing is proved with
    def __call__(self, lo: Array, hi: Array, inner: float, outer: float) -> OuterBounds:
        """Bounds for the level `outer` on boxes lo, hi (n, B)."""
        n = len(lo)
        centre = 0.5 * lo + 0.5 * hi
        radius = np.maximum(hi - centre, centre - lo) * (1 + EPS)
        x = np.concatenate([product(self.T, centre)[:, None], self.T[:, :, None] * radius], 1)
        error = 2 * (n + 4) * EPS * product(np.abs(self.T), np.abs(centre) + radius) + TINY
        settled = self._outside(x, error) | self.free(lo, hi)
        index = chosen(~settled)
        found = OuterBounds(
            settled,
            np.full_like(x[0, 0], -np.inf),
            radius.copy(),
            np.full_like(x[0, 0], np.inf),
            np.full_like(x[0, 0], np.inf),
        )
        opened = []
        for part in np.array_split(index, pieces(len(index), self.piece)):
            lowest, own, known = least_value(self.N, x.take(part, -1), error.take(part, -1), outer)
            proved = lowest > outer
            found.lowest[part], found.proved[part] = lowest, proved
            left = chosen(~proved[own])
            if known is not None and len(left):
                opened.append((known, left, part[own[left]]))
        if opened:
            models, lefts, parts = zip(*opened, strict=True)
            left = np.concatenate(parts)
            here = self._judged(models, lefts, [v.take(left, -1) for v in (x, error, centre, radius)], outer)
            found.proved[left], found.bound[left], found.score[:, left], found.violated[left] = here
        return found

    @abstractmethod
    def free(self, lo: Array, hi: Array) -> Mask:
        """True for the boxes (B,) in z of which nothing is asked, whatever N is there."""

    @abstractmethod
    def asks(self, z: Array) -> Mask:
        """True for the points (n, B) of which something is asked, if N is at most the level there."""

    @abstractmethod
    def judged(self, on: OnBoxes, level: float) -> tuple[Mask, Array, Array, Mask]:
        """`proved`, `bound` and `score` of the boxes as of `OuterBounds`, and True where a condition fails at the
        centre if N is at most the level there; bounds of inputs are not meant."""

    def kept(
        self, on: OnBoxes, bound: Array, score: Array, gaps: Callable[[Taylor, Index], Sequence[Taylor]]
    ) -> tuple[Array, Array, Mask]:
        """`bound` and `score`, worse on boxes where a constraint is not shown; True where one is broken at the centre.

        `gaps` gives models that are not negative where anything is asked, on boxes by their indices.
        """
        algebra, known, broken = Models(on.fall), dict[Expression, Taylor](), np.zeros(len(bound), dtype=bool)
        n, inputs = len(on.centre), len(on.centre) + self.system.m
        for g in self.keep:
            model = evaluate(g, on.values, algebra, known)
            own, excess = upper_bound(model)
            left = chosen(~(own < 0))
            if len(left):
                for gap in gaps(model, left):
                    own[left] = lessened(own[left], model.at(left), gap, n)
            doubt = np.abs(model.g[n:inputs]).sum(0) + np.abs(model.Q[n:, n:]).sum((0, 1)) + model.r
            broken |= model.c + np.abs(model.g[inputs:]).sum(0) - doubt >= 0
            score = np.where(own < 0, score, on.score(excess, model))
            bound = np.where(own < 0, bound, np.inf)
        return bound, score, broken

    def _outside(self, x: Array, error: Array) -> Mask:
        """True for the boxes (B,) that lie outside of the domain."""
        reach = np.abs(x[:, 1:]).sum(1) + error
        low, high = self.ends
        slack = _ENDS * (np.abs(low) + np.abs(high) + np.abs(x[:, 0]) + reach)
        outside: Mask = ((x[:, 0] - reach > high + slack) | (x[:, 0] + reach < low - slack)).any(0)
        return outside

    def _inside(self, x: Array) -> Mask:
        """True for the points (n, B) that lie in the domain."""
        low, high = self.ends
        slack = _ENDS * (np.abs(low) + np.abs(high))
        inside: Mask = ((x > low + slack) & (x < high - slack)).all(0)
        return inside

    def _judged(
        self,
        known: Sequence[NeuralModels | SymbolicModels],
        lefts: Sequence[Index],
        boxes: Sequence[Array],
        level: float,
    ) -> tuple[Mask, Array, Array, Array]:
        """`proved`, `bound`, `score` and `violated` of the boxes on which N may be at most the level: those at the
        indices `lefts` of pieces, whose models are known; of the boxes are given x, its error, centres and radii."""
        x, error, centre, radius = boxes
        mid, slopes, wide, share = self.policy(x, error)
        models = loop_models(self.system, x, error, mid, slopes, wide)
        values = {**models.states, **models.inputs, **models.quantities}
        algebra = Models(next(iter(models.states.values())))
        terms: dict[Expression, Taylor] = {}
        F = [evaluate(expression, values, algebra, terms) for expression in self.dynamics]
        first, pieces = 0, []
        for piece, left in zip(known, lefts, strict=True):
            part = np.arange(first, first := first + len(left))
            pieces.append((*piece.along([f.at(part) for f in F], left), piece.value.at(left)))
        falls, spreads, values_of_n = zip(*pieces, strict=True)
        fall = _joined(falls)
        N = _widened(_joined(values_of_n), fall)
        smooth = np.ones(len(N.c), dtype=bool)
        for model in (N, *F):  # a component that is multiplied by 0 must be enclosed as well
            smooth = smooth & np.isfinite(sum(model.norms()) + model.r)
        on = OnBoxes(fall, N, smooth, values, share, joined(spreads), centre, radius)
        proved, bound, score, rises = self.judged(on, level)
        score = np.where(np.isfinite(score) & smooth, score, np.abs(x[:, 1:]).sum(0))
        if self.check_inputs:
            found = input_bounds_kept(self.system, self.policy, x, error, mid, slopes, wide)
            for j, (inside, outside) in enumerate(found):
                proved, rises = proved & inside, rises | outside
                score = np.where(inside, score, np.abs(slopes[j]) + share * wide[j])
        asked = (N.c <= level) & self.asks(centre) & self._inside(x[:, 0])
        return proved, bound, score, np.where(rises & asked, N.c, np.inf)


class FallBound(LoopOnN):
    """The rule that N falls, and constraints hold, wherever N <= n2 and V >= c2 in the domain."""

    def __init__(self, problem: Problem, c2: float, T: Array, function: Neural | Symbolic) -> None:
        super().__init__(problem.loop, T, function, problem.keep)
        self.c2, self.V = c2, FormBound(problem.V.P, T)

    def free(self, lo: Array, hi: Array) -> Mask:
        """True where V < c2."""
        free: Mask = self.V.levels(lo, hi)[1] < self.c2 * (1 - _SLACK)
        return free

    def asks(self, z: Array) -> Mask:
        """True where V >= c2."""
        asks: Mask = self.V.at(z) >= self.c2
        return asks

    def judged(self, on: OnBoxes, level: float) -> tuple[Mask, Array, Array, Mask]:
        """N'F, where N <= n2 and V >= c2."""
        n, fall = len(on.centre), on.fall
        bound, excess = upper_bound(fall)
        inputs = n + self.system.m
        doubt = np.abs(fall.g[n:inputs]).sum(0) + np.abs(fall.Q[n:, n:]).sum((0, 1)) + fall.r
        rises = fall.c + np.abs(fall.g[inputs:]).sum(0) - doubt >= 0
        smooth = on.smooth & np.isfinite(bound)
        bound = self._where_asked(bound, fall, on.N, on.centre, on.radius, level)
        score = on.score(excess, fall)

        def gaps(g: Taylor, index: Index) -> list[Taylor]:
            at = on.centre.take(index, -1), on.radius.take(index, -1)
            return [below(on.N.at(index), level), self.V.gap(*at, g.at(index), self.c2, -1.0)]

        bound, score, broken = self.kept(on, bound, score, gaps)
        bound = np.where(smooth, bound, np.inf)
        return bound < 0, bound, np.where(smooth, score, np.inf), rises | broken

    def _where_asked(self, bound: Array, fall: Taylor, N: Taylor, centre: Array, radius: Array, level: float) -> Array:
        """The bound, made tighter where it is not negative by `k (n2 - N)` and `k (V - c2)`, which are >= 0 there."""
        n = len(centre)
        left = chosen(~(bound < 0))
        if len(left):
            bound[left] = lessened(bound[left], fall.at(left), below(N.at(left), level), n)
        left = chosen((self.V.levels(centre - radius, centre + radius)[0] < self.c2) & ~(bound < 0))
        if len(left):
            at = fall.at(left)
            gap = self.V.gap(centre.take(left, -1), radius.take(left, -1), at, self.c2, -1.0)
            bound[left] = lessened(bound[left], at, gap, n)
        return bound


class FaceBound:
    """The rule that N > n2 on boxes of a face of the domain, in the states themselves.

    `side` is 0 at the lower end of state `axis`, and 1 at the upper one.
    """

    def __init__(self, system: System, axis: int, side: int, function: Neural | Symbolic) -> None:
        self.axis, self.N = axis, enclosure_of(function)
        self.end = float(system.domain[axis][side])
        self.piece = max(16, _NUMBERS // (self.N.units * (1 + system.n) * (2 + system.n) // 2))
        self.operations = 4 * _EACH * self.N.units * (1 + system.n) ** 2  # of a box, about

    @np.errstate(all="ignore")  # infinities and NaN are answers, which nothing is proved with
    def __call__(self, lo: Array, hi: Array, inner: float, outer: float) -> OuterBounds:
        """Bounds for the level `outer` on boxes lo, hi (n, B), which have no extent along the face's own axis."""
        cut = pieces(lo.shape[1], self.piece)
        both = zip(np.array_split(lo, cut, 1), np.array_split(hi, cut, 1), strict=True)
        parts = [self._judge(low, high, outer) for low, high in both]
        return OuterBounds(*map(joined, zip(*parts, strict=True)))

    def _judge(self, lo: Array, hi: Array, level: float) -> OuterBounds:
        centre = 0.5 * lo + 0.5 * hi
        radius = np.maximum(hi - centre, centre - lo) * (1 + EPS)
        centre[self.axis], radius[self.axis] = self.end, 0.0
        error = EPS * (np.abs(centre) + radius) + TINY
        x = np.concatenate([centre[:, None], np.eye(len(centre))[:, :, None] * radius], 1)
        lowest, index, known = least_value(self.N, x, error, level)
        score, violated = radius.copy(), np.full_like(lowest, np.inf)
        if known is not None:
            excess = upper_bound(_negative(known.value))[1] + known.share * known.value.r
            score[:, index] = np.where(np.isfinite(excess), excess, radius.take(index, -1))
            violated[index] = np.where(known.value.c <= level, known.value.c, np.inf)
        score[self.axis] = -np.inf
        return OuterBounds(lowest > level, level - lowest, score, lowest, violated)


def least_value(
    N: NeuralEnclosure | SymbolicEnclosure, x: Array, error: Array, level: float
) -> tuple[Array, Index, NeuralModels | SymbolicModels | None]:
    """A lower bound of N on boxes (B,), and its models on those, by their indices, that a first one leaves."""
    lowest = N.least(x, error, level)
    index = chosen(~(lowest > level))
    if not len(index):
        return lowest, index, None
    whole = is_whole(index, len(lowest))
    known = N(x if whole else x.take(index, -1), error if whole else error.take(index, -1))
    by_model = -upper_bound(_negative(known.value))[0]
    by_model = np.where(np.isfinite(by_model), by_model, -np.inf)
    lowest[index] = np.maximum(lowest[index], by_model)
    return lowest, index, known


def below(N: Taylor, level: float) -> Taylor:
    """n2 - N."""
    return Taylor(level - N.c, -N.g, -N.Q, N.r + EPS * (np.abs(N.c) + abs(level)))


def _negative(model: Taylor) -> Taylor:
    return Taylor(-model.c, -model.g, -model.Q, model.r)


def _joined(models: Sequence[Taylor]) -> Taylor:
    """Models of several batches as one."""
    if len(models) == 1:
        return models[0]
    return Taylor(*(joined([getattr(v, part) for v in models]) for part in ("c", "g", "Q", "r")))


def _widened(model: Taylor, like: Taylor) -> Taylor:
    """The model among as many symbols as another has."""
    n, g, Q = len(model.g), np.zeros_like(like.g), np.zeros_like(like.Q)
    g[:n], Q[:n, :n] = model.g, model.Q
    return Taylor(model.c, g, Q, model.r)
