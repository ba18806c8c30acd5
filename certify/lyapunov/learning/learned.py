"""Learn a function N whose sublevel set extends a proved ellipsoid.

A fit to values along simulated runs gives the shape. Rounds of counterexamples then make N fall along the flow wherever
it is low, and keep it high where nothing converges. Later rounds drop the values: only the side of the level and the
fall of N count. The fit uses a smaller ellipsoid, so that N keeps falling well inside, and a slightly different
ellipsoid works as well.

Everything here is in floats and proves nothing: below the level samples found no violation. With the same seed and
enough time the result is the same.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from certify.effort import UNLIMITED, Effort
from certify.errors import InputError
from certify.loop.closed_loop import ClosedLoop
from certify.lyapunov.function import Quadratic
from certify.lyapunov.learning.counterexamples import Search
from certify.lyapunov.learning.fit import Slopes, Values, fit
from certify.lyapunov.learning.flow import LearningFlow
from certify.lyapunov.learning.models import Model, Network, Terms
from certify.lyapunov.learning.samples import Samples, draw
from certify.lyapunov.neural import Neural
from certify.lyapunov.polynomial import Polynomial

Array = NDArray[np.float64]
_WITHIN = 0.5  # of c2: the ellipsoid outside of which N is to fall
_ROUNDS, _FIRST, _STEPS = 20, 36, 12  # of counterexamples; steps of the first fit and of each other
_RELAXED = 0.4  # of the rounds, after which values may be anything below the level
_MARGIN = 0.1  # the least fall of N per scaled length,
_NATURAL = 0.3  # or this share of how fast the value does
_TOLERANCE = 0.02  # of values
_ABOVE = 0.05  # the level, for states that do not belong to the set
_ROWS = 1500  # of values and of slopes for each state of the plant
_FACES = 300  # for each state
_KEPT = 3000  # counterexamples
_NEW = 600  # of them at most in a round
_SLOPE_WEIGHT, _EDGE_WEIGHT = 3.0, 2.0
_SEARCHED, _EACH = 3e5, 0.3  # states at which a search evaluates the function; operations for a parameter
_BESIDE = 0.003  # the lowest violation


@dataclass(frozen=True, slots=True)
class Round:
    """One fit: the cost, the level below which samples show no violation, the share of the region of attraction that
    lies below it (sampled), the counterexamples found, and the seconds since the beginning."""

    cost: float
    level: float
    cover: float
    found: int
    seconds: float


@dataclass(frozen=True, slots=True)
class Learned:
    """A function with sampled results; nothing of this is proved.

    Parameters
    ----------
    function : N, of the plant's states.
    level : below which no violation was sampled.
    cover : sampled share of the region of attraction in {N <= level} united with the smaller ellipsoid.
    history : the rounds, in order.
    """

    function: Neural | Polynomial
    level: float
    cover: float
    history: tuple[Round, ...]


Report = Callable[[Round], None]


def learn(
    loop: ClosedLoop,
    inner: Quadratic,
    c2: float,
    hidden: Sequence[int] = (16, 16),
    seed: int = 0,
    effort: Effort = UNLIMITED,
    progress: Report | None = None,
) -> Learned:
    """Learn a tanh network for a loop on its domain.

    Parameters
    ----------
    loop : in continuous time, its input following the state at once.
    inner, c2 : a region of attraction {V <= c2}.
    hidden : widths of the layers between the states and the output.
    seed : of everything random.
    effort : where it ends, no further round begins.
    progress : called after each round.

    Raises
    ------
    InputError : the loop goes in steps, the ellipsoid is none of its states, or too little converges to learn from.
    """
    return learner_of(loop, inner, c2, Network(loop.system.n, tuple(hidden)), seed, effort).learn(effort, progress)


def fit_polynomial(
    loop: ClosedLoop,
    inner: Quadratic,
    c2: float,
    degree: int = 4,
    seed: int = 0,
    effort: Effort = UNLIMITED,
    progress: Report | None = None,
) -> Learned:
    """Fit a polynomial of an even degree for a loop on its domain; the arguments are those of `learn`.

    Raises
    ------
    InputError : as `learn`, or the degree is odd or out of range.
    """
    return learner_of(loop, inner, c2, Terms(loop.system.n, degree), seed, effort).learn(effort, progress)


def learn_staying(
    loop: ClosedLoop, model: Model, seed: int = 0, effort: Effort = UNLIMITED, progress: Report | None = None
) -> Learned:
    """Learn a function for a set that is never left: N falls on the way to where simulated runs end up, and is high
    where a run leaves the domain, or violates a constraint or the bounds of an input.

    Parameters
    ----------
    model : a `Network` or `Terms` of the plant's states.
    loop, seed, effort, progress : as of `learn`.

    Raises
    ------
    InputError : the loop goes in steps, or too few runs stay in the domain to learn from.
    """
    from certify.lyapunov.learning.staying import StayingFlow

    _require_continuous(loop)
    generator = np.random.default_rng(seed)
    return Learner(StayingFlow(loop, generator, effort), model, generator).learn(effort, progress)


def learner_of(
    loop: ClosedLoop, inner: Quadratic, c2: float, model: Model, seed: int = 0, effort: Effort = UNLIMITED
) -> Learner:
    """The learner of a function for a set beyond {V <= c2}; the arguments are those of `learn`.

    Raises
    ------
    InputError : as `learn`.
    """
    system = loop.system
    _require_continuous(loop)
    if inner.n != system.n or not (math.isfinite(c2) and c2 > 0):
        raise InputError(
            f"the ellipsoid must be of the {system.n} states of {system.name}, at a positive level; "
            f"found {inner.n} states and the level {c2}."
        )
    generator = np.random.default_rng(seed)
    return Learner(LearningFlow(loop, inner, _WITHIN * c2, effort), model, generator)


def _require_continuous(loop: ClosedLoop) -> None:
    if loop.system.in_steps:
        raise InputError(
            f"a function is learned for plants in continuous time whose input follows the state at once; the time of "
            f"{loop.system.name} goes in steps."
        )


class Learner:
    """A function being learned, which a prover may send back with a state where it is wrong.

    Parameters
    ----------
    flow : the loop with the set outside of which the function is to fall.
    model : of the function.
    """

    def __init__(self, flow: LearningFlow, model: Model, generator: np.random.Generator) -> None:
        self._start, self._model, self._generator = time.monotonic(), model, generator
        self._samples = draw(flow, generator)
        self._lesson, self._search = _Lesson(flow, self._samples, generator), Search(flow, self._samples)
        self._p, self._damping = model.initial(generator), 1.0
        self._best, self._reached = self._p, Round(math.inf, -math.inf, -math.inf, 0, 0.0)
        self._history = list[Round]()

    def learn(self, effort: Effort = UNLIMITED, progress: Report | None = None) -> Learned:
        """Up to 20 rounds, one at least: the best function of all so far."""
        done = len(self._history)
        while len(self._history) < done + _ROUNDS and (len(self._history) == done or not effort.over):
            self._round(effort)
            if progress is not None:
                progress(self._history[-1])
        function = self._model.function(self._best, self._samples.scale)
        return Learned(function, self._reached.level, self._reached.cover, tuple(self._history))

    def cover(self, function: Neural | Polynomial, level: float) -> float:
        """The sampled share of the region of attraction in {N <= level}, N a function of the plant's states."""
        return self._cover(function(self._search.region), level)

    def correct(self, x: Array, cover: float) -> None:
        """Take it that only this share can be proved of the best function, which does not fall near the state x (n,);
        what is found there is asked of later ones."""
        self._reached = replace(self._reached, cover=cover)
        at = x / self._samples.scale
        self._lesson.add(
            *self._search.near(self._model.function(self._best), at, self._generator), np.zeros((0, len(x))), True
        )

    def _cover(self, values: Array, level: float) -> float:
        return self._samples.inner + (1 - self._samples.inner) * float(np.mean(values <= level))

    def _round(self, effort: Effort) -> None:
        done, model, lesson, search = len(self._history), self._model, self._lesson, self._search
        steps = _STEPS if done else _FIRST
        slopes = lesson.slopes(model.function(self._p))
        fitted = fit(model, self._p, lesson.values(), slopes, steps, self._damping, effort)
        self._p, self._damping = fitted.p, max(fitted.damping, 1e-4) if done else 1.0
        function, generator = model.function(self._p), self._generator
        effort.charge(_SEARCHED * _EACH * len(self._p))
        z, v, slope = search.rising(function, lesson.sought, -_NATURAL * _MARGIN, lesson.risen, generator, lesson.least)
        low = search.low(function, lesson.sought, generator)
        level = min(
            float(function(z[slope >= 0]).min(initial=math.inf)),
            float(function(low).min(initial=math.inf)),
            lesson.sought,
        )
        level -= _BESIDE * abs(level)
        cover, seconds = self._cover(function(search.region / search.scale), level), time.monotonic() - self._start
        self._history.append(Round(fitted.cost, level, cover, len(z) + len(low), seconds))
        if cover > self._reached.cover:
            self._best, self._reached = self._p, self._history[-1]
        lesson.add(z, v, low, relax=done + 1 >= _RELAXED * _ROUNDS)


class _Lesson:
    """The rows of the fits: those of the samples, and those of counterexamples."""

    def __init__(self, flow: LearningFlow, samples: Samples, generator: np.random.Generator) -> None:
        n, scale = flow.n, samples.scale
        self.flow, self.scale, self.generator, self.relaxed = flow, scale, generator, False
        # Of many states the rim holds most of the volume, and to follow it costs a proof dearly.
        self.top = (0.95 if n <= 2 else 0.85 if n == 3 else 0.65) ** (1 / n)
        self.sought = self.top + _ABOVE / 2  # below which counterexamples are looked for
        self.least = -math.inf if flow.collar == 1 else (1 - flow.collar) * self.top  # and from which on
        mixed = generator.permutation(len(samples.x))
        some = mixed[: _ROWS * n]
        faces = flow.faces(_FACES * n, generator) / scale
        self._z = np.concatenate([samples.x[some] / scale, faces])
        self._value = np.concatenate([samples.value[some], np.full(len(faces), math.inf)])
        self._weight = np.concatenate(
            [np.full(len(some), len(some) ** -0.5), np.full(len(faces), _EDGE_WEIGHT * len(faces) ** -0.5)]
        )
        self._edge = _EDGE_WEIGHT * (_FACES * n) ** -0.5
        falls = mixed[: _ROWS * n]
        falls = falls[samples.attracted[falls]]
        shell = flow.shell(max(_ROWS * n // 5, 1), generator)
        x = np.concatenate([samples.x[falls], shell])
        self._falls = x / scale
        self._flow = _drawn(flow.directions(x, scale), generator)
        self._most = -np.concatenate(
            [np.minimum(_MARGIN, _NATURAL * samples.slope[falls]), np.full(len(shell), _NATURAL * _MARGIN)]
        )
        self._slope_weight = _SLOPE_WEIGHT * (_ROWS * n) ** -0.5
        self.risen, self._risen_flow = np.zeros((0, n)), np.zeros((0, n))
        self._rounds = 0

    def values(self) -> Values:
        """Bounds of N: near the values at first, and then below or above the level."""
        beyond = self._value > self.top
        low = np.where(beyond, np.minimum(self._value, self.top + _ABOVE), self._value - _TOLERANCE)
        high = np.where(beyond, math.inf, self._value + _TOLERANCE)
        if self.relaxed:
            low = np.where(beyond, low, -math.inf)
            high = np.where(beyond, high, np.minimum(np.maximum(high, 0.9 * self.top), self.top - 0.01))
        return Values(self._z, low, high, self._weight)

    def slopes(self, function: Neural | Polynomial) -> Slopes:
        """Bounds of N's derivative where N is low now; none before the first fit, and heavier with each round."""
        most = np.concatenate([self._most, np.full(len(self.risen), -_NATURAL * _MARGIN)])
        z, v = np.concatenate([self._falls, self.risen]), np.concatenate([self._flow, self._risen_flow])
        value = function(z)
        asked = (value < self.top + _ABOVE) & (value >= self.least)
        some = asked if self._rounds else np.zeros(len(z), dtype=bool)
        weight = self._slope_weight * min(1.0, (self._rounds + 0.3) / (0.4 * _ROUNDS))
        return Slopes(z[some], v[some], most[some], np.full(int(some.sum()), weight))

    def add(self, z: Array, v: Array, low: Array, relax: bool) -> None:
        """Add counterexamples: states where N rises, with the flow there, and states where N is low."""
        self._rounds, self.relaxed = self._rounds + 1, relax
        some = self.generator.permutation(len(z))[:_NEW]
        self.risen = np.concatenate([self.risen, z[some]])[-_KEPT:]
        self._risen_flow = np.concatenate([self._risen_flow, v[some]])[-_KEPT:]
        low = low[self.generator.permutation(len(low))[:_NEW]]
        self._z = np.concatenate([self._z, low])
        self._value = np.concatenate([self._value, np.full(len(low), math.inf)])
        self._weight = np.concatenate([self._weight, np.full(len(low), self._edge)])


def _drawn(directions: Array, generator: np.random.Generator) -> Array:
    """Draw for each state one of its directions (C, B, n), over the C corners of the ranges: (B, n)."""
    corners, count = directions.shape[:2]
    drawn = np.zeros(count, dtype=np.int64) if corners == 1 else generator.integers(corners, size=count)
    return np.asarray(directions[drawn, np.arange(count)])
