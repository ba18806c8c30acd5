"""What a comparison measures: ways to act, their responses from shared initial states, and the table of them.

Quartiles are over seeds and states together. A trajectory that has diverged has an infinite cost and norm from there
on, and infinity takes part in every quartile.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from certify.errors import InputError
from certify.loop.plants import System

Array = NDArray[np.float64]
Run = Literal["ours", "sac", "before", "uncentred", "sb3-sac", "sb3-ppo"]

NAMES: dict[Run, str] = {
    "ours": "ours",
    "sac": "SAC without gain",
    "before": "identified before",
    "uncentred": "not centred",
    "sb3-sac": "SB3 SAC",
    "sb3-ppo": "SB3 PPO",
}
"""Kinds of trained runs, for people."""


@dataclass(frozen=True, slots=True)
class Method:
    """A way to act: a kind of run, and whether its action is the mean or sampled."""

    run: Run
    sampled: bool

    @property
    def name(self) -> str:
        """For the table: `ours`, `sac mean`, `sac stochastic`, ..."""
        return self.run if self.run == "ours" else f"{self.run} {'stochastic' if self.sampled else 'mean'}"

    @property
    def label(self) -> str:
        """For people."""
        return NAMES[self.run] + ("" if self.run == "ours" else ", stochastic" if self.sampled else ", mean")


OURS = Method("ours", False)
_OTHERS: tuple[Run, ...] = ("sac", "sb3-sac", "sb3-ppo")
BASELINES: tuple[Method, ...] = (OURS, *(Method(run, sampled) for run in _OTHERS for sampled in (False, True)))
"""Ours beside the same SAC without the gain and beside stable-baselines3."""
ABLATIONS: tuple[Method, ...] = (OURS, *(Method(run, False) for run in ("sac", "before", "uncentred")))
"""Ours with one part changed: no gain; A and B learned once before training; the mean not centred."""


def remaining(methods: Sequence[Method], without: Sequence[str]) -> tuple[Method, ...]:
    """`methods` less those of the kinds of runs in `without`.

    Raises
    ------
    InputError : a name is of none of them, or ours.
    """
    kinds = {method.run for method in methods} - {"ours"}
    for name in without:
        if name not in kinds:
            raise InputError(f"`without` must be one of {', '.join(sorted(kinds))}; found {name!r}.")
    return tuple(method for method in methods if method.run not in without)


@dataclass(frozen=True, slots=True, kw_only=True)
class CompareOptions:
    """What is compared.

    Parameters
    ----------
    methods : ways to act, with the runs that they need.
    seeds : trained runs of each kind, with the seeds 0, 1, ...
    states, start_seed : number and seed of the initial states, which all methods share.
    duration, window : seconds simulated, and the last seconds in which the floor of ||x|| is measured.
    duration_steps, window_steps : the same of a plant in discrete time, in steps.
    tolerance : bound on ||x|| in the window for a trajectory that has settled.
    to_floor : baselines learn until they no longer improve, not for as many steps as ours.
    budget, patience : of that rule, where they are not `controllers.runs.RULES`'s.
    """

    methods: tuple[Method, ...] = BASELINES
    seeds: int = 5
    states: int = 50
    start_seed: int = 0
    duration: float = 20.0
    window: float = 1.0
    duration_steps: int = 1000
    window_steps: int = 50
    tolerance: float = 1e-6
    to_floor: bool = False
    budget: int | None = None
    patience: int | None = None

    def __post_init__(self) -> None:
        for name in ("seeds", "states", "duration", "window", "duration_steps", "window_steps", "tolerance"):
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"`{name}` must be positive and finite; found {getattr(self, name)}.")
        if self.start_seed < 0 or self.window > self.duration or self.window_steps > self.duration_steps:
            raise InputError(
                "`start_seed` must be at least 0, and `window` at most `duration`, in seconds and in steps."
            )

    def span(self, system: System) -> tuple[float, float]:
        """Duration and window in the plant's unit of time: seconds, or steps."""
        if system.time == "discrete":
            return self.duration_steps, self.window_steps
        return self.duration, self.window


@dataclass(frozen=True, slots=True)
class Spent:
    """What a run took: the steps that were made in all, and seconds of wall and processor time, evaluations with it."""

    steps: int
    wall: float
    cpu: float


@dataclass(frozen=True, slots=True)
class Response:
    """One trained run, simulated.

    Parameters
    ----------
    steps : after which the policy was taken.
    spent : by the whole run; None where nobody counted.
    x : states (T + 1, N, n); NaN after a divergence.
    cost : accumulated cost (T + 1, N), 0 at first; infinite after a divergence.
    """

    method: Method
    seed: int
    steps: int
    x: Array
    cost: Array
    spent: Spent | None = None

    @property
    def norm(self) -> Array:
        """||x||, shape (T + 1, N); infinite after a divergence."""
        norm = np.linalg.norm(self.x, axis=2)
        return np.where(np.isnan(norm), math.inf, norm)


@dataclass(frozen=True, slots=True)
class Row:
    """A line of the table; `seed` is None for all seeds together.

    `steps` are those after which the policy was taken, `made` those of its whole run, both the largest of the seeds';
    `wall` and `cpu` are seconds of the runs, the seeds' median, None where nobody counted.

    `floor` is the median over the trajectories of the largest ||x|| in the window; `settled`, `diverged` and
    `left_domain` count trajectories out of `trajectories`; the costs are quartiles at the end.
    """

    method: str
    seed: int | None
    steps: int
    made: int
    wall: float | None
    cpu: float | None
    trajectories: int
    settled: int
    diverged: int
    left_domain: int
    floor: float
    cost_lower: float
    cost_median: float
    cost_upper: float

    def as_json(self) -> dict[str, Any]:
        """Plain values; infinity becomes None."""
        values = {column.name: getattr(self, column.name) for column in fields(self)}
        return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in values.items()}


def quartiles(values: Array) -> Array:
    """Lower quartile, median and upper quartile along the last axis, shape (3, ...); infinity is a value like any.

    >>> quartiles(np.array([4.0, 1.0, 2.0, 3.0]))
    array([1.75, 2.5 , 3.25])
    >>> quartiles(np.array([1.0, np.inf, 2.0, np.inf, np.inf]))
    array([ 2., inf, inf])
    """
    ordered = np.moveaxis(np.sort(values, axis=-1), -1, 0)
    place = np.array([0.25, 0.5, 0.75]) * (len(ordered) - 1)
    low, high = np.floor(place).astype(int), np.ceil(place).astype(int)
    weight = (place - low).reshape(3, *[1] * (ordered.ndim - 1))
    below, above = ordered[low], ordered[high]
    finite = np.where(np.isinf(above), 0.0, above)
    between = np.where(np.isinf(below), 0.0, below) * (1 - weight) + finite * weight
    return np.asarray(np.where(weight == 0, below, np.where(np.isinf(above), above, between)))


def table(system: System, dt: float, responses: Sequence[Response], options: CompareOptions) -> list[Row]:
    """A row for each response, and after those of a method one for all its seeds."""
    rows = []
    for method in dict.fromkeys(response.method for response in responses):
        own = [response for response in responses if response.method == method]
        rows += [_row(system, dt, [response], response.seed, options) for response in own]
        rows.append(_row(system, dt, own, None, options))
    return rows


def _row(system: System, dt: float, responses: Sequence[Response], seed: int | None, options: CompareOptions) -> Row:
    lo, hi = np.array(system.domain, dtype=np.float64).T
    x = np.concatenate([response.x for response in responses], axis=1)
    norm = np.concatenate([response.norm for response in responses], axis=1)
    cost = np.concatenate([response.cost[-1] for response in responses])
    largest = norm[-1 - math.ceil(options.span(system)[1] / dt - 1e-9) :].max(axis=0)
    lower, median, upper = quartiles(cost)
    steps = max(response.steps for response in responses)
    spent = [response.spent for response in responses if response.spent is not None]
    return Row(
        method=responses[0].method.name,
        seed=seed,
        steps=steps,
        made=max((each.steps for each in spent), default=steps),
        wall=float(np.median([each.wall for each in spent])) if spent else None,
        cpu=float(np.median([each.cpu for each in spent])) if spent else None,
        trajectories=len(largest),
        settled=int((largest < options.tolerance).sum()),
        diverged=int(np.isnan(x[-1]).any(axis=1).sum()),
        left_domain=int((~((x >= lo) & (x <= hi)).all(axis=(0, 2))).sum()),
        floor=float(quartiles(largest)[1]),
        cost_lower=float(lower),
        cost_median=float(median),
        cost_upper=float(upper),
    )
