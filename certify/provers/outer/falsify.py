"""The falsifier of an outer set: the lowest N in the domain and outside of {V < c2} at which N does not fall.

Samples of the domain are driven to where N'F is largest on their level, and violating ones are driven down, along the
edge of what violates and along V = c2 where they meet these. It says where to look for a level; nothing is proved with
it, and what it reports is a value in floats.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from certify.certificates.claims import Problem
from certify.effort import UNLIMITED, Effort
from certify.loop.closed_loop import ClosedLoop
from certify.loop.constraints import Constraints
from certify.loop.plants import System, corners
from certify.loop.policies import bounded_by_form
from certify.lyapunov.function import Quadratic
from certify.lyapunov.neural import Neural
from certify.lyapunov.symbolic import Symbolic

Array = NDArray[np.float64]
_SAMPLES, _CLIMBERS, _FEW = 65_536, 512, 128
_ON_A_FACE, _FEW_THERE = 4096, 32
_CALL = 2e5  # operations of evaluating few states at once
_CLIMB, _DESCENT = 40, 80  # steps
_APART = 1e-6  # share of the domain between the points of a difference
_PUSH = 0.05  # away from the edge of what violates, beside a step along it


@dataclass(frozen=True, slots=True)
class Rise:
    """A state `x` (n,) in the domain and outside of {V < c2} with N'F >= 0 (kind `rise`), an input out of bounds
    (`input`) or a `constraint` that is violated (`keep`), in floats; `level` is N(x). `values` are those of the
    uncertain quantities."""

    x: Array
    level: float
    kind: Literal["rise", "input", "keep"]
    values: Mapping[str, Fraction] = field(default_factory=dict)
    constraint: str = ""

    def describe(self, system: System) -> str:
        """The violation in words."""
        names = ", ".join(f"{s} = {v:.6g}" for s, v in zip(system.states, self.x, strict=True))
        names += "".join(f", {name} = {float(q):.6g}" for name, q in self.values.items())
        what = "the input leaves its bounds" if self.kind == "input" else "N does not fall"
        what = f"the constraint {self.constraint} is violated" if self.kind == "keep" else what
        return f"{what} at {names} with N = {self.level:.6g}"


class Sampler:
    """A search of the domain of a loop for states at which N does not fall, or an input leaves its bounds; `beyond` is
    (V, c2) of a set {V < c2} that is left out."""

    def __init__(
        self,
        loop: ClosedLoop,
        function: Neural | Symbolic,
        effort: Effort = UNLIMITED,
        beyond: tuple[Quadratic, float] | None = None,
    ) -> None:
        self.beyond = beyond
        self.loop, self.N, self.effort, self.system = loop, function, effort, loop.system
        self.f = self.system.uncertain_function()
        self.corners = corners(self.system)
        self.low, self.high = np.array([[float(e) for e in pair] for pair in self.system.domain]).T
        self.half = (self.high - self.low) / 2
        ends = np.array([[float(e) for e in pair] for pair in self.system.input_bounds]).T
        self.least, self.most = ends
        self.check_inputs = not bounded_by_form(loop.network, self.system.input_bounds)

    def rates(self, x: Array) -> tuple[Array, Array]:
        """(N'F at each corner of the ranges (C, B), how far the worst input lies outside its bounds (B,))."""
        self.effort.charge(_CALL + 2 * len(x) * len(self.corners) * self.loop.operations)
        u, gradient = self.loop.policy(x), self.N.gradient(x)
        rows = [(gradient * self.f(x, u, [float(q) for q in values.values()])).sum(-1) for values in self.corners]
        return np.stack(rows), np.maximum(self.least - u, u - self.most).max(-1)

    def value(self, x: Array) -> Array:
        """N (B,); infinite where it has no value, which is for the rules to find."""
        return np.nan_to_num(self.N(x), nan=np.inf, posinf=np.inf, neginf=-np.inf)

    def violation(self, x: Array) -> Array:
        """A number (B,) that is at least 0 where a condition fails."""
        rates, excess = self.rates(x)
        worst = np.nan_to_num(rates.max(0), nan=-np.inf)
        # Either counts, and where both fail the input's stays out of the way of a difference.
        return np.where(self.check_inputs & (worst < 0) & (excess > 0), excess, worst)

    def asked(self, x: Array) -> NDArray[np.bool_]:
        """True where a condition is asked: in the domain, and V >= c2."""
        inside: NDArray[np.bool_] = np.all((x >= self.low) & (x <= self.high), axis=-1)
        return inside if self.beyond is None else inside & (self.beyond[0](x) >= self.beyond[1])

    def wall(self, x: Array) -> Array:
        """The direction (B, n) along which states are asked for only up to some surface, the gradient of V; zeros if
        there is none."""
        return np.zeros_like(x) if self.beyond is None else self.beyond[0].gradient(x)

    def sample(self, generator: np.random.Generator) -> Array:
        """Points of the domain, (B, n)."""
        return np.asarray(generator.uniform(self.low, self.high, (_SAMPLES, self.system.n)))

    @np.errstate(all="ignore")
    def least_value(self, seed: int = 1) -> float:
        """The least N of samples of the domain that are asked for; infinite if there is none."""
        x = self.sample(np.random.default_rng(seed))
        return float(np.min(self.value(x[self.asked(x)]), initial=np.inf))

    @np.errstate(all="ignore")
    def search(self, cap: float, seed: int = 0) -> Rise | None:
        """The lowest violation found with N <= cap; None if there is none."""
        generator = np.random.default_rng(seed)
        x = self.sample(generator)
        x = x[self.asked(x)]
        x = x[self.value(x) <= cap]
        if not len(x):
            return None
        violation = self.violation(x)
        bad = x[violation >= 0]
        best = x[np.argsort(-violation, kind="stable")[: _CLIMBERS // 2]]
        drawn = x[generator.integers(len(x), size=_CLIMBERS // 2)]
        climbed = self.climb(np.concatenate([best, drawn]))
        climbed = climbed[self.asked(climbed) & (self.violation(climbed) >= 0)]
        found = self.lowest(np.concatenate([bad, climbed]))
        return found if found is not None and found.level <= cap else None

    @np.errstate(all="ignore")
    def lowest(self, x: Array) -> Rise | None:
        """The lowest violation reached from violating points (B, n)."""
        x = x[self.asked(x)]
        x = x[self.violation(x) >= 0]
        if not len(x):
            return None
        x = x[np.argsort(self.value(x), kind="stable")[:_FEW]]
        level, step = self.value(x), np.full(len(x), 0.05)
        for _ in range(_DESCENT):
            moved, lower = x, level
            for direction in self._ways_down(x):
                tried = np.clip(x + step[:, None] * direction * self.half, self.low, self.high)
                value = self.value(tried)
                value = np.where(self.asked(tried) & (self.violation(tried) >= 0), value, np.inf)
                better = value < lower
                moved, lower = np.where(better[:, None], tried, moved), np.where(better, value, lower)
            step = np.where(lower < level, 1.5 * step, 0.4 * step)
            x, level = moved, lower
            if step.max() < 1e-9:
                break
        return self.rise(x[int(np.argmin(level))])

    def rise(self, x: Array) -> Rise:
        """The violation at a state (n,)."""
        rates, _ = self.rates(x[None])
        level = float(self.value(x))
        if rates.max() >= 0:
            return Rise(x, level, "rise", self.corners[int(rates[:, 0].argmax())])
        return Rise(x, level, "input")

    def _ways_down(self, x: Array) -> list[Array]:
        """Directions (B, n) in the domain's own scale: down, down along the edge, and that along V = c2 as well."""
        down = _unit(-self.N.gradient(x) * self.half)
        edge, wall = _unit(self._uphill(x)), _unit(self.wall(x) * self.half)
        along = _unit(_without(down, edge))
        beside = _unit(_without(_without(down, wall), _unit(_without(edge, wall))))
        return [down, along + _PUSH * edge, _without(down, wall) + _PUSH * wall, beside + _PUSH * (edge + wall)]

    def _uphill(self, x: Array) -> Array:
        """The gradient of the violation in the domain's own scale, by differences."""
        steps = np.concatenate([np.zeros((1, x.shape[1])), np.diag(_APART * self.half)])
        values = self.violation((x[None] + steps[:, None]).reshape(-1, x.shape[1])).reshape(len(steps), -1)
        return np.asarray(np.nan_to_num(((values[1:] - values[0]) / _APART).T, nan=0.0, posinf=0.0, neginf=0.0))

    def climb(self, x: Array) -> Array:
        """Points driven to where the violation is larger, about along N = const."""
        step = 0.05
        for _ in range(_CLIMB):
            way = _without(self._uphill(x), _unit(self.N.gradient(x) * self.half))
            x = np.clip(x + step * _unit(way) * self.half, self.low, self.high)
            step *= 0.94
        return x

    @np.errstate(all="ignore")
    def lowest_on_faces(self, seed: int = 0) -> float:
        """The least N found on the domain's boundary."""
        generator = np.random.default_rng(seed)
        least = np.inf
        for axis in range(self.system.n):
            for end in (self.low, self.high):
                x = generator.uniform(self.low, self.high, (_ON_A_FACE, self.system.n))
                x[:, axis] = end[axis]
                x = x[np.argsort(self.value(x), kind="stable")[:_FEW_THERE]]
                level, step = self.value(x), np.full(len(x), 0.05)
                for _ in range(_DESCENT):
                    way = -self.N.gradient(x) * self.half
                    way[:, axis] = 0.0
                    tried = np.clip(x + step[:, None] * _unit(way) * self.half, self.low, self.high)
                    value = self.value(tried)
                    better = value < level
                    x, level = np.where(better[:, None], tried, x), np.where(better, value, level)
                    step = np.where(better, 1.5 * step, 0.4 * step)
                least = min(least, float(level.min()))
        return least


class Falsifier(Sampler):
    """A search of the domain outside of {V < c2}."""

    def __init__(self, problem: Problem, c2: float, function: Neural | Symbolic, effort: Effort = UNLIMITED) -> None:
        super().__init__(problem.loop, function, effort, (problem.V, c2))


class Hazards(Sampler):
    """A search of the domain for states that no set may have: an input or a constraint is violated."""

    @cached_property
    def constraints(self) -> Constraints | None:
        """The constraints of the plant, in floats; None without any."""
        return Constraints(self.loop) if self.system.constraints else None

    def violation(self, x: Array) -> Array:
        """A number (B,) that is at least 0 where one is violated."""
        self.effort.charge(_CALL + 2 * len(x) * self.loop.operations)
        u = self.loop.policy(x)
        excess = np.maximum(self.least - u, u - self.most).max(-1)
        found = np.where(excess > 0, excess, -np.inf) if self.check_inputs else np.full(len(x), -np.inf)
        return found if self.constraints is None else np.maximum(found, self.constraints.at(x, u).max(-1))

    def rise(self, x: Array) -> Rise:
        """The violation at a state (n,)."""
        u = self.loop.policy(x[None])
        names = () if self.constraints is None else self.constraints.names
        worst = [] if self.constraints is None else self.constraints.at(x[None], u)[0].tolist()
        broken = next((name for name, g in zip(names, worst, strict=True) if g >= 0), "")
        return Rise(x, float(self.value(x)), "keep" if broken else "input", constraint=broken)


def _unit(v: Array) -> Array:
    return np.asarray(v / (np.linalg.norm(v, axis=-1, keepdims=True) + 1e-300))


def _without(v: Array, unit: Array) -> Array:
    return np.asarray(v - (v * unit).sum(-1, keepdims=True) * unit)
