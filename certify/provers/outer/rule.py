"""The rules for a box of an outer set's trees: N falls on it, or nothing is asked there (FORMAT.md, `faces`, `outer`).

What is cheap comes first, and only the boxes that it leaves open go on: where a box lies in the domain and in V, then
N's model, then the policy, the plant and N'F. What is proved for a level n2 is proved for each lower one, because
`k (n2 - N)` only falls with it and the multipliers do not depend on it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from certify.certificates.claims import Problem
from certify.loop.expressions import Expression, evaluate, nodes
from certify.loop.plants import System
from certify.loop.policies import bounded_by_form
from certify.lyapunov.neural import Neural
from certify.lyapunov.symbolic import Symbolic
from certify.provers.bounds import (
    Models,
    NeuralEnclosure,
    NeuralModels,
    PolicyEnclosure,
    SymbolicEnclosure,
    SymbolicModels,
    Taylor,
    loop_models,
    operations_of_policy,
    upper_bound,
)
from certify.provers.bounds.taylor import EPS, TINY
from certify.provers.boxes.form import FormBound
from certify.provers.boxes.rule import input_bounds_kept, lessened

Array = NDArray[np.float64]
_SLACK = 1e-9  # relative distance from c2 at which a box counts as inside
_ENDS = 1e-11  # relative distance kept from the ends of the domain
_EACH = 2.0  # operations of an entry of a model
_NUMBERS = 2**19  # in the largest tensor of a piece of a batch, so that it stays in a core's cache


class OuterBounds(NamedTuple):
    """What is known of each box: `proved` (B,), `bound` (B,) of what has to be negative, `score` (n, B): what each axis
    adds to the bound, `lowest` (B,): N is at least that where something is asked, infinite where nothing is; and
    `violated` (B,): N at the centre where a condition fails there, else infinite."""

    proved: Tensor
    bound: Tensor
    score: Tensor
    lowest: Tensor
    violated: Tensor


def enclosure_of(function: Neural | Symbolic, device: torch.device) -> NeuralEnclosure | SymbolicEnclosure:
    """Models of N, whatever it is."""
    return NeuralEnclosure(function, device) if isinstance(function, Neural) else SymbolicEnclosure(function, device)


class FallBound:
    """Whether N falls on boxes in the coordinates z, x = T z, wherever N <= n2 and V >= c2 in the domain."""

    def __init__(
        self, problem: Problem, c2: float, T: Array, function: Neural | Symbolic, device: torch.device
    ) -> None:
        self.system, self.c2 = problem.loop.system, c2
        self.T = torch.tensor(T, dtype=torch.float64, device=device)
        self.V = FormBound(problem.V.P, T, device)
        self.N = enclosure_of(function, device)
        self.policy = PolicyEnclosure(problem.loop, device)
        self.dynamics = self.system.uncertain_dynamics()
        self.check_inputs = not bounded_by_form(problem.loop.network, self.system.input_bounds)
        ends = [[float(end) for end in pair] for pair in self.system.domain]
        self.ends = torch.tensor(ends, dtype=torch.float64, device=device).T[:, :, None]
        symbols = self.system.n + self.system.m + len(self.system.uncertain)
        equations = sum(1 for _ in nodes(*self.dynamics)) + 3 * self.system.n
        own = _EACH * (1 + symbols) ** 2 * (equations + 4 * self.N.units)
        self.operations = operations_of_policy(problem.loop.network) + own  # of a box, about
        self.piece = max(16, _NUMBERS // (self.N.units * (1 + symbols) * (2 + symbols) // 2))

    def __call__(self, lo: Tensor, hi: Tensor, inner: float, outer: float) -> OuterBounds:
        """Bounds for the level `outer` on boxes lo, hi (n, B)."""
        n = len(lo)
        centre = 0.5 * lo + 0.5 * hi
        radius = torch.maximum(hi - centre, centre - lo) * (1 + EPS)
        x = torch.cat([(self.T @ centre)[:, None], self.T[:, :, None] * radius], 1)
        error = 2 * (n + 4) * EPS * (self.T.abs() @ (centre.abs() + radius)) + TINY
        settled = self._outside(x, error) | (self.V.levels(lo, hi)[1] < self.c2 * (1 - _SLACK))
        index = torch.nonzero(~settled)[:, 0]
        found = OuterBounds(
            settled,
            torch.full_like(x[0, 0], -torch.inf),
            radius.clone(),
            torch.full_like(x[0, 0], torch.inf),
            torch.full_like(x[0, 0], torch.inf),
        )
        opened = []
        for part in index.tensor_split(_pieces(len(index), self.piece)):
            lowest, own, known = least_value(self.N, x[:, :, part], error[:, part], outer)
            proved = lowest > outer
            found.lowest[part], found.proved[part] = lowest, proved
            left = torch.nonzero(~proved[own])[:, 0]
            if known is not None and len(left):
                opened.append((known, left, part[own[left]]))
        if opened:
            models, lefts, parts = zip(*opened, strict=True)
            left = torch.cat(parts)
            here = self._falls(models, lefts, x[:, :, left], error[:, left], centre[:, left], radius[:, left], outer)
            found.proved[left], found.bound[left], found.score[:, left], found.violated[left] = here
        return found

    def _outside(self, x: Tensor, error: Tensor) -> Tensor:
        """Which boxes (B,) lie outside of the domain."""
        reach = x[:, 1:].abs().sum(1) + error
        low, high = self.ends
        slack = _ENDS * (low.abs() + high.abs() + x[:, 0].abs() + reach)
        outside: Tensor = ((x[:, 0] - reach > high + slack) | (x[:, 0] + reach < low - slack)).any(0)
        return outside

    def _inside(self, x: Tensor) -> Tensor:
        """Which points (n, B) lie in the domain."""
        low, high = self.ends
        slack = _ENDS * (low.abs() + high.abs())
        inside: Tensor = ((x > low + slack) & (x < high - slack)).all(0)
        return inside

    def _falls(
        self,
        known: Sequence[NeuralModels | SymbolicModels],
        lefts: Sequence[Tensor],
        x: Tensor,
        error: Tensor,
        centre: Tensor,
        radius: Tensor,
        level: float,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """`proved`, `bound`, `score` and `violated` of the boxes on which N may be at most the level: those at the
        indices `lefts` of pieces, whose models are known."""
        n = len(x)
        mid, slopes, wide, share = self.policy(x, error)
        models = loop_models(self.system, x, error, mid, slopes, wide)
        values = {**models.states, **models.inputs, **models.quantities}
        algebra = Models(next(iter(models.states.values())))
        terms: dict[Expression, Taylor] = {}
        F = [evaluate(expression, values, algebra, terms) for expression in self.dynamics]
        first, pieces = 0, []
        for piece, left in zip(known, lefts, strict=True):
            part = torch.arange(first, first := first + len(left), device=left.device)
            pieces.append((*piece.along([f.at(part) for f in F], left), piece.value.at(left)))
        falls, spreads, values_of_n = zip(*pieces, strict=True)
        fall, spread = _joined(falls), torch.cat(spreads, -1)
        bound, excess = upper_bound(fall)
        N = _widened(_joined(values_of_n), fall)
        inputs = n + self.system.m
        doubt = fall.g[n:inputs].abs().sum(0) + fall.Q[n:, n:].abs().sum((0, 1)) + fall.r
        rises = fall.c + fall.g[inputs:].abs().sum(0) - doubt >= 0
        # What the inputs' errors add is charged to the axes that spread the policy, and what is left to those of N.
        score = excess[:n] + share * excess[n:].sum(0) + spread * fall.r
        smooth = torch.isfinite(bound)
        for model in (N, *F):  # a component that is multiplied by 0 must be enclosed as well
            smooth = smooth & torch.isfinite(sum(model.norms()) + model.r)
        bound = self._where_asked(bound, fall, N, centre, radius, level)
        bound = torch.where(smooth, bound, torch.inf)
        proved = bound < 0
        score = torch.where(torch.isfinite(score) & smooth, score, (x[:, 1:].abs()).sum(0))
        if self.check_inputs:
            for j, (inside, outside) in enumerate(input_bounds_kept(self.system, mid, slopes, wide)):
                proved, rises = proved & inside, rises | outside
                score = torch.where(inside, score, slopes[j].abs() + share * wide[j])
        asked = (N.c <= level) & (self.V.at(centre) >= self.c2) & self._inside(x[:, 0])
        return proved, bound, score, torch.where(rises & asked, N.c, torch.inf)

    def _where_asked(
        self, bound: Tensor, fall: Taylor, N: Taylor, centre: Tensor, radius: Tensor, level: float
    ) -> Tensor:
        """The bound, made tighter where it is not negative by `k (n2 - N)` and `k (V - c2)`, which are >= 0 there."""
        n = len(centre)
        left = torch.nonzero(~(bound < 0))[:, 0]
        if len(left):
            own, at = N.at(left), fall.at(left)
            rest = own.r + EPS * (own.c.abs() + abs(level))
            gap = Taylor(level - own.c, -own.g, -own.Q, rest)
            bound = bound.index_put((left,), lessened(bound[left], at, gap, n))
        below = self.V.levels(centre - radius, centre + radius)[0] < self.c2
        left = torch.nonzero(below & ~(bound < 0))[:, 0]
        if len(left):
            at = fall.at(left)
            gap = self.V.gap(centre[:, left], radius[:, left], at, self.c2, -1.0)
            bound = bound.index_put((left,), lessened(bound[left], at, gap, n))
        return bound


class FaceBound:
    """Whether N > n2 on boxes of a face of the domain, in the states themselves.

    `side` is 0 at the lower end of state `axis`, and 1 at the upper one.
    """

    def __init__(self, system: System, axis: int, side: int, function: Neural | Symbolic, device: torch.device) -> None:
        self.axis, self.N = axis, enclosure_of(function, device)
        self.end = float(system.domain[axis][side])
        self.piece = max(16, _NUMBERS // (self.N.units * (1 + system.n) * (2 + system.n) // 2))
        self.operations = 4 * _EACH * self.N.units * (1 + system.n) ** 2  # of a box, about

    def __call__(self, lo: Tensor, hi: Tensor, inner: float, outer: float) -> OuterBounds:
        """Bounds for the level `outer` on boxes lo, hi (n, B), which have no extent along the face's own axis."""
        cut = _pieces(lo.shape[1], self.piece)
        both = zip(lo.tensor_split(cut, 1), hi.tensor_split(cut, 1), strict=True)
        parts = [self._judge(low, high, outer) for low, high in both]
        return OuterBounds(*(torch.cat(column, -1) for column in zip(*parts, strict=True)))

    def _judge(self, lo: Tensor, hi: Tensor, level: float) -> OuterBounds:
        centre = 0.5 * lo + 0.5 * hi
        radius = torch.maximum(hi - centre, centre - lo) * (1 + EPS)
        centre[self.axis], radius[self.axis] = self.end, 0.0
        error = EPS * (centre.abs() + radius) + TINY
        x = torch.cat([centre[:, None], torch.diag_embed(radius.T).permute(1, 2, 0)], 1)
        lowest, index, known = least_value(self.N, x, error, level)
        score, violated = radius.clone(), torch.full_like(lowest, torch.inf)
        if known is not None:
            excess = upper_bound(_negative(known.value))[1] + known.share * known.value.r
            score[:, index] = torch.where(torch.isfinite(excess), excess, radius[:, index])
            violated[index] = torch.where(known.value.c <= level, known.value.c, torch.inf)
        score[self.axis] = -torch.inf
        return OuterBounds(lowest > level, level - lowest, score, lowest, violated)


def least_value(
    N: NeuralEnclosure | SymbolicEnclosure, x: Tensor, error: Tensor, level: float
) -> tuple[Tensor, Tensor, NeuralModels | SymbolicModels | None]:
    """A lower bound of N on boxes (B,), and its models on those, by their indices, that a first one leaves."""
    lowest = N.least(x, error, level)
    index = torch.nonzero(~(lowest > level))[:, 0]
    if not len(index):
        return lowest, index, None
    whole = len(index) == len(lowest)
    known = N(x if whole else x[:, :, index], error if whole else error[:, index])
    by_model = -upper_bound(_negative(known.value))[0]
    by_model = torch.where(torch.isfinite(by_model), by_model, -torch.inf)
    return lowest.index_put((index,), torch.maximum(lowest[index], by_model)), index, known


def _pieces(count: int, most: int) -> int:
    """Into how many pieces of at most so many boxes these are cut, at least one."""
    return max(1, -(-count // most))


def _negative(model: Taylor) -> Taylor:
    return Taylor(-model.c, -model.g, -model.Q, model.r)


def _joined(models: Sequence[Taylor]) -> Taylor:
    """Models of several batches as one."""
    if len(models) == 1:
        return models[0]
    return Taylor(*(torch.cat([getattr(v, part) for v in models], -1) for part in ("c", "g", "Q", "r")))


def _widened(model: Taylor, like: Taylor) -> Taylor:
    """The model among as many symbols as another has."""
    n, g, Q = len(model.g), torch.zeros_like(like.g), torch.zeros_like(like.Q)
    g[:n], Q[:n, :n] = model.g, model.Q
    return Taylor(model.c, g, Q, model.r)
