"""Simulation for pictures. Nothing here is proved, and whatever is shown of it is labelled as simulated.

The continuous closed loop is integrated by the classical Runge-Kutta method of order four with the policy evaluated at
every stage, many initial states at a time. Runs leave the batch as soon as they are decided, which is
what keeps a grid of a few thousand states well below a second.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from certify.errors import InputError
from certify.policies import TanhNetwork
from certify.systems import System
from certify.systems.ode import rk4_step

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Field = Callable[[Array], Array]
SETTLED = 1e-3
"""A run has settled when V is at most this share of the certified level: a thirtieth of the set's radius."""
_STEP = 1.0  # of the time constant of the fastest eigenvalue
_HORIZON = 15.0  # time constants of the slowest eigenvalue
_MAX_STEPS = 3000
_RATE_SAMPLES = 200
_GRID = {1: 401, 2: 35}


@dataclass(frozen=True, slots=True)
class SimulatedRoa:
    """The region of attraction seen by simulation from a grid, beside the certified set.

    Parameters
    ----------
    axes : grid coordinates along each state, the centres of equal cells.
    attracted : runs that stayed in the domain and came near the origin; shape of the grid.
    certified : grid points in the certified set; shape of the grid.
    undecided : runs that did neither settle nor leave within the horizon; they count as not attracted.
    step, horizon : of the integration, in seconds.
    """

    axes: tuple[Array, ...]
    attracted: Mask
    certified: Mask
    undecided: int
    step: float
    horizon: float

    @property
    def fraction(self) -> float:
        """Certified grid points over attracted grid points; NaN if nothing was attracted."""
        count = int(self.attracted.sum())
        return float(self.certified.sum()) / count if count else math.nan

    @property
    def contradictions(self) -> int:
        """Certified grid points whose simulation did not settle; more than 0 calls for an explanation."""
        return int((self.certified & ~self.attracted).sum())


@dataclass(frozen=True, slots=True)
class Flow:
    """The closed loop for simulation, in float64. It need not have an equilibrium at the origin.

    Parameters
    ----------
    field : `F(x) = f(x, pi(x))`, shapes (..., n) to (..., n). Compiling it takes a while for large plants, hence this
        class.
    policy : pi, shapes (..., n) to (..., m).
    lo, hi : corners of the domain box, shape (n,).
    """

    field: Field
    policy: Field
    lo: Array
    hi: Array

    @classmethod
    def of(cls, system: System, network: TanhNetwork) -> Flow:
        """Compile the equations.

        Raises
        ------
        InputError : the policy is not one for this plant.
        """
        if (network.n, network.m) != (system.n, system.m):
            raise InputError(
                f"the policy must read {system.n} states and command {system.m} inputs of {system.name}; "
                f"it reads {network.n} and commands {network.m}."
            )
        f, u_eq = system.function(), system.exact_u_eq()
        folded = network.folded(u_eq)  # once, not in every step

        def policy(x: Array) -> Array:
            return np.asarray(folded(x, u_eq))

        def field(x: Array) -> Array:
            return np.asarray(f(x, policy(x)))

        return cls(field, policy, *domain_bounds(system))


def time_scales(flow: Flow) -> tuple[float, float]:
    """(step, horizon) in seconds: the fastest time constant, and 15 times the slowest at the origin.

    The fastest is taken over Jacobians at the origin and at sampled states of the domain, because a plant can be
    stiffer away from the origin; Runge-Kutta of order four is stable up to 2.8 of it. The horizon is cut at 3,000
    steps.
    """
    x = np.random.default_rng(0).uniform(flow.lo, flow.hi, (_RATE_SAMPLES, len(flow.lo)))
    rates = _eigenvalues(flow, np.concatenate([np.zeros((1, len(flow.lo))), x]))
    fastest = float(np.max(np.abs(rates), initial=0.0))
    slowest = float(np.min(np.abs(rates[:1].real), initial=math.inf))
    step = _STEP / fastest if fastest > 0 else 1.0
    return step, min(_HORIZON / slowest if slowest > 0 else math.inf, _MAX_STEPS * step)


def _eigenvalues(flow: Flow, x: Array) -> NDArray[np.complex128]:
    """Eigenvalues of the Jacobians (central differences) at states (N, n), without those states that have none."""
    delta = 1e-5 * (flow.hi - flow.lo)
    shifted = x[:, None, None, :] + np.array([1.0, -1.0])[:, None, None] * np.diag(delta)
    with np.errstate(all="ignore"):
        F = flow.field(shifted)
        J = (F[:, 0] - F[:, 1]) / (2 * delta)[:, None]  # transposed; the eigenvalues are the same
    return np.asarray(np.linalg.eigvals(J[np.all(np.isfinite(J), axis=(1, 2))]), dtype=np.complex128)


def simulate(flow: Flow, starts: Array, step: float, steps: int) -> Array:
    """Trajectories from `starts` (N, n), shape (steps + 1, N, n); NaN from the first step outside the domain on."""
    x = np.array(starts, dtype=np.float64)
    path = np.full((steps + 1, *x.shape), math.nan)
    path[0] = x
    alive = np.arange(len(x))
    with np.errstate(all="ignore"):
        for k in range(1, steps + 1):
            if not alive.size:
                break
            x = rk4_step(flow.field, x, step)
            inside = np.all((x >= flow.lo) & (x <= flow.hi), axis=-1)
            x, alive = x[inside], alive[inside]
            path[k, alive] = x
    return path


def simulated_roa_fraction(
    system: System,
    network: TanhNetwork,
    P: Array,
    level: float,
    *,
    points: int | None = None,
    step: float | None = None,
    horizon: float | None = None,
    settled: float | None = None,
) -> SimulatedRoa:
    """Simulate the closed loop from a grid over the domain and compare with `{x'Px <= level}`.

    A grid point counts as attracted if its run stays inside the domain and comes to `V <= settled` within the
    horizon.

    Parameters
    ----------
    system, network : the closed loop; one or two states.
    P, level : the certified set.
    points : grid points along each state; default 401 for one state, 35 for two.
    step, horizon : in seconds; defaults from the eigenvalues, see `time_scales`.
    settled : the level that a run has to reach; default `SETTLED * level`, near the origin.

    Raises
    ------
    InputError : the plant has more than two states, or an option is not positive.
    """
    if system.n not in _GRID:
        raise InputError(f"a grid needs a plant with one or two states; {system.name} has {system.n}.")
    flow = Flow.of(system, network)
    default_step, default_horizon = time_scales(flow)
    step = default_step if step is None else step
    horizon = default_horizon if horizon is None else horizon
    points = _GRID[system.n] if points is None else points
    if not (points >= 1 and 0 < step < math.inf and 0 < horizon < math.inf):
        raise InputError("`points`, `step` and `horizon` must be positive and finite.")
    centres = (np.arange(points) + 0.5) / points
    axes = tuple(a + (b - a) * centres for a, b in zip(flow.lo, flow.hi, strict=True))
    x = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, system.n)
    certified = quadratic(P, x) <= level
    target = SETTLED * level if settled is None else settled
    attracted, undecided = _run(flow, x, P, target, step, horizon)
    shape = (points,) * system.n
    return SimulatedRoa(axes, attracted.reshape(shape), certified.reshape(shape), undecided, step, horizon)


def _run(flow: Flow, x: Array, P: Array, target: float, step: float, horizon: float) -> tuple[Mask, int]:
    attracted = np.zeros(len(x), dtype=np.bool_)
    alive = np.arange(len(x))
    with np.errstate(all="ignore"):
        for _ in range(math.ceil(horizon / step)):
            near = quadratic(P, x) <= target
            attracted[alive[near]] = True
            x, alive = x[~near], alive[~near]
            if not alive.size:
                break
            x = rk4_step(flow.field, x, step)
            inside = np.all((x >= flow.lo) & (x <= flow.hi), axis=-1)  # False for NaN
            x, alive = x[inside], alive[inside]
        near = quadratic(P, x) <= target
    attracted[alive[near]] = True
    return attracted, int((~near).sum())


def quadratic(P: Array, x: Array) -> Array:
    """`x'Px` along the last axis."""
    return np.asarray(np.einsum("...i,...i->...", x @ P, x))


def domain_bounds(system: System) -> tuple[Array, Array]:
    """Lower and upper corner of the domain box in float64."""
    bounds = np.array([[float(a), float(b)] for a, b in system.domain])
    return bounds[:, 0], bounds[:, 1]
