"""The table of a comparison.

Quartiles are over seeds and states together. A trajectory that has diverged has an infinite cost and norm from there
on, and infinity takes part in every quartile.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.loop.plants import System
from controllers.comparison.methods import Method
from controllers.comparison.options import CompareOptions

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Spent:
    """The expense of a run: its steps in all, and seconds of wall and processor time, evaluations included."""

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
