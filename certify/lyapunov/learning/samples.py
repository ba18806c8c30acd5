"""Training data: states of the region of attraction with a value each, and states outside of it.

Zubov's function integrates a positive function along the trajectory to the origin. It decreases along trajectories and
tends to infinity at the region's boundary. Here the integrand is the speed, so that the integral is the trajectory's
length, with a penalty near the domain's faces. Only the sublevel sets count, so any increasing function of it will do:
the value is the share of the region's volume with a smaller integral, to the power 1/n. It grows about linearly with
the distance from the origin and is 1 at the boundary, which a small network can follow.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from certify.errors import InputError
from certify.lyapunov.learning.flow import LearningFlow

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
_STATES = 12_000
_LOOKED_AT, _FIRST, _FEW = 4000, 500, 1000  # states, by the first of which runs are judged; runs in any case
_FOR_RUNS = 0.4  # share of the effort that is left
_SHARE = 0.15  # of the domain that converges, from which on states are drawn from the domain
_CHAINS, _MOVES = 600, 24  # of the walk through a smaller region
_STRIDES = (0.3, 0.8, 1.5)  # in standard deviations of the chains' states
_KNOTS = 60
_FEWEST = 100


@dataclass(frozen=True, slots=True)
class Samples:
    """States with values.

    Parameters
    ----------
    x : (B, n), states of the domain outside of the inner ellipsoid.
    value : (B,), from 0 to 1 in the region of attraction, infinite beyond it.
    slope : (B,), how fast the value falls per scaled length of the way; 0 beyond the region.
    scale : (n,), the region's half-widths.
    inner : share of the region's volume in the inner ellipsoid.
    """

    x: Array
    value: Array
    slope: Array
    scale: Array
    inner: float

    def __post_init__(self) -> None:
        if not len(self.x) == len(self.value) == len(self.slope):
            raise InputError("each state must have a value and a slope; their counts differ.")

    @property
    def attracted(self) -> Mask:
        """True for each state that converges, (B,)."""
        return np.asarray(np.isfinite(self.value))


def draw(flow: LearningFlow, generator: np.random.Generator) -> Samples:
    """States, uniform in the region of attraction, and others beyond it.

    Raises
    ------
    InputError : almost nothing converges from outside of the inner ellipsoid.
    """
    looked, widths, before = flow.uniform(_LOOKED_AT, generator), flow.high - flow.low, flow.effort.spent
    converged = flow.run(looked[:_FIRST], widths).converged
    each = (flow.effort.spent - before) / _FIRST
    looked = looked[: _FIRST + _affordable(flow, each, _LOOKED_AT - _FIRST)]
    converged = np.concatenate([converged, flow.run(looked[_FIRST:], widths).converged])
    if converged.mean() >= _SHARE:
        scale = np.abs(looked[converged]).max(0)
        x = flow.uniform(_affordable(flow, each, _STATES), generator)
    else:
        region, beyond = _walk(flow, generator)
        scale = np.abs(region).max(0)
        some = generator.permutation(len(region))[:_STATES]
        others = generator.permutation(len(beyond))[: _STATES // 2]
        x = np.concatenate([region[some], beyond[others], flow.uniform(_STATES // 4, generator)])
    runs = flow.run(x, scale)
    home = flow.is_home(x)
    way = runs.converged & ~home & (runs.nearness < 1)
    if way.sum() < _FEWEST:
        raise InputError(
            f"at least {_FEWEST} of {len(x)} sampled states must converge from outside of the ellipsoid to learn "
            f"from; {int(way.sum())} do. Choose a domain that fits the region of attraction."
        )
    rate = 1 / float(np.median(runs.length[way]))
    key = np.where(way, rate * runs.length - np.log1p(-np.where(way, runs.nearness, 0.0)), math.inf)
    share = float(home.sum() / (home.sum() + way.sum()))
    value, slope = _ranked(key, share, flow.n)
    return Samples(x[~home], value[~home], (rate * slope)[~home], scale, share)


def _affordable(flow: LearningFlow, each: float, wanted: int) -> int:
    """As many of the wanted runs as a share of the effort is worth, at so many operations for each."""
    return int(min(wanted, max(_FEW, _FOR_RUNS * flow.effort.left / each))) if each else wanted


def _ranked(key: Array, inner: float, n: int) -> tuple[Array, Array]:
    """The share of volume below each finite key, to the power 1/n, and its derivative in the key; `inner` below 0."""
    finite = np.isfinite(key)
    shares = np.linspace(0.0, 1.0, _KNOTS)
    knots, at = np.unique(np.concatenate([[0.0], np.quantile(key[finite], shares[1:])]), return_index=True)
    curve = PchipInterpolator(knots, (inner + (1 - inner) * shares[at]) ** (1 / n))
    held = np.where(finite, np.minimum(key, knots[-1]), 0.0)
    return np.where(finite, curve(held), math.inf), np.where(finite, curve.derivative()(held), 0.0)


def _walk(flow: LearningFlow, generator: np.random.Generator) -> tuple[Array, Array]:
    """States about uniform in the region of attraction, and states of the domain near it that do not converge.

    A random walk that moves only to what converges, with steps as long as the region is wide so far: samples of the
    domain would hit a region of several states too seldom.
    """
    x = flow.homes(_CHAINS, generator)
    kept, beyond = [], []
    for move in range(_MOVES):
        spread = np.linalg.cholesky(np.cov(x.T).reshape(flow.n, flow.n))
        stride = generator.choice(_STRIDES, (_CHAINS, 1)) * generator.normal(size=(_CHAINS, flow.n))
        y = x + stride @ spread.T
        converged = flow.run(y, np.ones(flow.n)).converged
        if move >= _MOVES // 3:
            beyond.append(y[~converged & flow.inside(y)])
        x = np.where(converged[:, None], y, x)
        if move >= _MOVES // 2:
            kept.append(x)
    return np.concatenate(kept), np.concatenate(beyond)
