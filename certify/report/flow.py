"""The closed loop as pictures simulate it, in floats.

The continuous closed loop is integrated by the classical Runge-Kutta method of order four with the policy evaluated at
every stage, many initial states at a time; where the input is held over a period, with the policy evaluated at its
beginning, in steps that divide it. A loop in discrete time takes its own steps.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from certify.certificates.membership import angles_in
from certify.effort import UNLIMITED, Effort
from certify.errors import InputError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.constraints import keeping
from certify.loop.plants import System
from certify.loop.plants.ode import eigenvalues_of, fastest_at, rk4_step
from certify.loop.policies import PolicyNetwork, bounded_by_form

Array = NDArray[np.float64]
Field = Callable[[Array], Array]
_STEP = 1.0  # of the time constant of the fastest eigenvalue
_HORIZON = 15.0  # time constants of the slowest eigenvalue
_MAX_STEPS = 3000
_STAGES = 4  # evaluations in a step of Runge and Kutta
_RATE_SAMPLES = 200
_TANH = 30  # multiplications' worth
_EQUATIONS = 500  # multiplications' worth of one evaluation, and of what surrounds it
_ROUNDING = 1e-9  # of an input, relative to its bounds
_AROUND = 1_000_000  # multiplications' worth of what surrounds a step, of however many states


@dataclass(frozen=True, slots=True)
class Flow:
    """The closed loop for simulation, in float64. It need not have an equilibrium at the origin.

    Parameters
    ----------
    field : `F(x) = f(x, pi(x))`, shapes (..., n) to (..., n). Compiling it takes a while for large plants, hence this
        class.
    policy : pi, shapes (..., n) to (..., m).
    lo, hi : corners of the domain box, shape (n,).
    plant : f, shapes (..., n) and (..., m) to (..., n).
    period : over which the input is held, the longest that is allowed, in seconds; 0 if it follows the state at once.
    discrete : whether F(x) is the state one step later, and not the rate of change.
    cost : of F at one state, in multiplications' worth.
    kept : whether states (..., n) and their inputs keep all constraints, (...); None without constraints.
    commands : whether the policy commands inputs within their bounds, but for rounding, at states (..., n), (...); None
        where its form says so.
    angles : the numbers of states in which full turns are the same place: they are kept within half a turn of 0.
    """

    field: Field
    policy: Field
    lo: Array
    hi: Array
    plant: Callable[[Array, Array], Array]
    period: float = 0.0
    discrete: bool = False
    cost: float = 0.0
    angles: tuple[int, ...] = ()
    kept: Callable[[Array], NDArray[np.bool_]] | None = None
    commands: Callable[[Array], NDArray[np.bool_]] | None = None

    @classmethod
    def of(cls, system: System, network: PolicyNetwork) -> Flow:
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

        def plant(x: Array, u: Array) -> Array:
            return np.asarray(f(x, u))

        period = 0.0 if system.sample is None else float(system.sample[1])
        steps, angles, kept = system.time == "discrete", angles_in(system), keeping(ClosedLoop(system, network))
        within = None if bounded_by_form(network, system.input_bounds) else _within(system, policy)
        return cls(field, policy, *domain_bounds(system), plant, period, steps, cost_of(network), angles, kept, within)

    def keeps(self, x: Array) -> NDArray[np.bool_]:
        """True for each state (..., n) that keeps all constraints with the input that the policy has there."""
        return np.ones(x.shape[:-1], dtype=np.bool_) if self.kept is None else self.kept(x)

    def fitting(self, step: float) -> float:
        """The largest step of a simulation up to `step`, in seconds, that divides the period; in discrete time 1."""
        if self.discrete:
            return 1.0
        return self.period / math.ceil(self.period / step) if self.period else step

    def steps_between(self, step: float) -> int:
        """The number of these steps between two instants of which the claim speaks."""
        return max(round(self.period / step), 1)

    def input(self, x: Array, held: Array | None, k: int, step: float) -> Array | None:
        """The input that acts from step k on, (..., m): the one that is held, or a new one; None if none is held."""
        if not self.period:
            return None
        return self.policy(x) if held is None or k % self.steps_between(step) == 0 else held

    def operations(self, states: int) -> float:
        """Multiplications' worth of a step of so many states: a held input asks the policy once, not at each stage."""
        if self.discrete:
            each = self.cost
        else:
            each = _STAGES * self.cost if not self.period else self.cost + (_STAGES - 1) * min(_EQUATIONS, self.cost)
        return each * states + _AROUND

    def steps_at(self, x: Array, least: float, most: float) -> Array:
        """A step in seconds for each state (N, n), (N, 1): the fastest time constant there, between two bounds."""
        fastest = np.clip(fastest_at(self.field, x, self.hi - self.lo), _STEP / most, _STEP / least)
        return np.asarray(_STEP / fastest[:, None])

    def advance(self, x: Array, u: Array | None, step: float | Array) -> Array:
        """States one step later, (..., n), with the input held at u if there is one."""
        if self.discrete:
            after = self.field(x)
        else:
            after = rk4_step(self.field if u is None else lambda y: self.plant(y, u), x, step)
        for i in self.angles:
            after[..., i] -= 2 * np.pi * np.round(after[..., i] / (2 * np.pi))
        return after


def _within(system: System, policy: Field) -> Callable[[Array], NDArray[np.bool_]]:
    lo, hi = np.array([[float(end) for end in pair] for pair in system.input_bounds]).T
    slack = _ROUNDING * (np.abs(lo) + np.abs(hi))

    def within(x: Array) -> NDArray[np.bool_]:
        u = policy(x)
        return np.asarray(np.all((u >= lo - slack) & (u <= hi + slack), axis=-1))

    return within


def cost_of(network: PolicyNetwork) -> float:
    """Multiplications' worth of one evaluation of a loop with this policy."""
    return _EQUATIONS + network.network.entries + _TANH * network.network.units


def time_scales(
    flow: Flow, samples: int = _RATE_SAMPLES, reach: Array | None = None, most: float = _MAX_STEPS
) -> tuple[float, float]:
    """(step, horizon) in seconds: the fastest time constant, and 15 times the slowest at the origin.

    Of `samples` states in the domain, or in the part of it where `|x_i| <= reach_i`.

    The fastest is taken over Jacobians at the origin and at sampled states of the domain, because a plant can be
    stiffer away from the origin; Runge-Kutta of order four is stable up to 2.8 of it. The horizon is cut at `most`
    steps, 3,000. In discrete time the two are numbers of steps, the first 1.
    """
    lo, hi = (flow.lo, flow.hi) if reach is None else (np.maximum(flow.lo, -reach), np.minimum(flow.hi, reach))
    x = np.random.default_rng(0).uniform(lo, hi, (samples, len(lo)))
    rates = eigenvalues_of(flow.field, np.concatenate([np.zeros((1, len(flow.lo))), x]), flow.hi - flow.lo)
    if flow.discrete:
        with np.errstate(divide="ignore"):
            slowest = -float(np.max(np.log(np.abs(rates[:1])), initial=-math.inf))
        return 1.0, min(math.ceil(_HORIZON / slowest) if slowest > _HORIZON / _MAX_STEPS else _MAX_STEPS, _MAX_STEPS)
    fastest = float(np.max(np.abs(rates), initial=0.0))
    slowest = float(np.min(np.abs(rates[:1].real), initial=math.inf))
    step = _STEP / fastest if fastest > 0 else 1.0
    return step, min(_HORIZON / slowest if slowest > 0 else math.inf, most * flow.fitting(step))


def simulate(flow: Flow, starts: Array, step: float, steps: int, effort: Effort = UNLIMITED) -> Array:
    """Trajectories from `starts` (N, n), shape (steps + 1, N, n); NaN from the first step outside the domain on.

    Where the effort is over the trajectories end, in fewer steps. Where the input is held `step` must divide the period
    (Flow.fitting); the first period begins at the start.
    """
    u: Array | None = None
    x = np.array(starts, dtype=np.float64)
    path = np.full((steps + 1, *x.shape), math.nan)
    path[0] = x
    alive = np.arange(len(x))
    with np.errstate(all="ignore"):
        for k in range(1, steps + 1):
            if not alive.size:
                break
            if k > 1 and effort.over:
                return path[:k]
            effort.charge(flow.operations(len(x)))
            u = flow.input(x, u, k - 1, step)
            x = flow.advance(x, u, step)
            inside = np.all((x >= flow.lo) & (x <= flow.hi), axis=-1)
            x, alive, u = x[inside], alive[inside], None if u is None else u[inside]
            path[k, alive] = x
    return path


def domain_bounds(system: System) -> tuple[Array, Array]:
    """Lower and upper corner of the domain box in float64."""
    bounds = np.array([[float(a), float(b)] for a, b in system.domain])
    return bounds[:, 0], bounds[:, 1]
