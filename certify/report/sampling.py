"""Simulation for pictures. Nothing here is proved, and the report labels it as simulated.

Runs leave the batch as soon as they are decided, which is what keeps a grid of a few thousand states well below a
second.

A run has one of three fates: it settles, it leaves, or it does neither by the end. The third is separate: a slow run is
no sign of leaving.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from certify.effort import UNLIMITED, Effort
from certify.errors import InputError
from certify.loop.plants import System
from certify.loop.plants.ode import DOUBLINGS, lengthened
from certify.loop.policies import PolicyNetwork, clipped_at
from certify.report.flow import Flow, simulate, time_scales

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Holds = Callable[[Array], Mask]
SETTLED = 1e-3
"""A run has settled when V is at most this share of the proved level: a thirtieth of the set's radius."""
_GRID = {1: 401, 2: 35}
_FINER = 8  # of the step, in runs that are asked again because they contradict what is claimed
_HALVINGS = 2  # of the grid's cells along the boundary of the region
_FEWEST_STEPS = 100  # of a run with steps of its own
_WIDTH = 4  # fine cells to either side that a smoothed value knows of
_OUTSIDE = 1.01  # times the level: a run that starts below it and comes so high has left the set


@dataclass(frozen=True, slots=True)
class SimulatedRoa:
    """The simulated region of attraction on a grid, beside the proved set.

    Parameters
    ----------
    axes : grid coordinates along each state, the centres of equal cells.
    attracted : runs that stayed in the domain and came near the origin; shape of the grid.
    left : runs that left the domain or the inputs' bounds; shape of the grid. The others had not settled within the
        horizon, and count as not attracted.
    certified : grid points in the proved set; shape of the grid.
    step, horizon : of the integration, in seconds; the horizon is how far it came if the effort was over.
    clipped : those of `left` that would come near the origin if the policy were clipped at the inputs' bounds; None if
        its form keeps it within them.
    """

    axes: tuple[Array, ...]
    attracted: Mask
    left: Mask
    certified: Mask
    step: float
    horizon: float
    clipped: int | None = None

    def __post_init__(self) -> None:
        shape = tuple(len(a) for a in self.axes)
        if not self.attracted.shape == self.left.shape == self.certified.shape == shape:
            raise InputError(f"masks must have the shape {shape} of the grid; one has another.")
        if np.any(self.attracted & self.left):
            raise InputError("a run must not both settle and leave; one does.")

    @property
    def undecided(self) -> int:
        """Runs that did neither settle nor leave within the horizon."""
        return int((~self.attracted & ~self.left).sum())

    @property
    def fraction(self) -> float:
        """Certified grid points over attracted grid points; NaN if nothing was attracted, or the runs tell little."""
        count = int(self.attracted.sum())
        return float(self.certified.sum()) / count if count and self.tells else math.nan

    @property
    def tells(self) -> bool:
        """False if most runs from certified grid points had not settled within the horizon, nor left: then the runs
        were too short to say what is attracted."""
        return 2 * self.slow <= int(self.certified.sum())

    @property
    def contradictions(self) -> int:
        """Certified grid points whose simulation left the domain; more than 0 calls for an explanation."""
        return int((self.certified & self.left).sum())

    @property
    def slow(self) -> int:
        """Certified grid points whose simulation had not settled within the horizon, which contradicts nothing."""
        return int((self.certified & ~self.attracted & ~self.left).sum())


@dataclass(frozen=True, slots=True)
class Runs:
    """Trajectories with their fates.

    Parameters
    ----------
    path : states (T + 1, N, n) at equal steps; NaN after a run has left the domain.
    step : between two states, in seconds.
    settled, left : of each run (N,); a run of neither kind had not settled when the time was over.
    """

    path: Array
    step: float
    settled: Mask
    left: Mask

    def __post_init__(self) -> None:
        if self.path.ndim != 3 or not self.settled.shape == self.left.shape == self.path.shape[1:2]:
            raise InputError(f"`path` must be (T + 1, N, n) with N fates; found the shape {self.path.shape}.")
        if np.any(self.settled & self.left):
            raise InputError("a run must not both settle and leave; one does.")

    @property
    def seconds(self) -> float:
        """The simulated time."""
        return self.step * (len(self.path) - 1)

    @property
    def unsettled(self) -> Mask:
        """Runs that did neither settle nor leave, (N,)."""
        return ~self.settled & ~self.left


def runs_of(flow: Flow, starts: Array, P: Array, level: float, target: float, step: float, steps: int,
            effort: Effort = UNLIMITED, start: Array | None = None,
            centre: Array | None = None, beyond: Holds | None = None) -> Runs:  # fmt: skip
    """Simulate and tell the fates.

    A run settles if it comes to `V <= target`, and leaves if it leaves the domain, or rises well above `level` from a
    start below it. Runs from below the level, or from a tube's `start` {(x - c)'P(x - c) <= 1}, c = `centre` or 0, or
    from a set `beyond`, that seem to leave are simulated again in much smaller steps: the first suspect is the
    integration.
    """
    path, apart = simulate(flow, starts, step, steps, effort), flow.steps_between(step)
    begins = quadratic(P, path[0]) <= level
    settled, left = _fates(path, begins, P, level, target, apart)
    suspects = np.flatnonzero(left & _in_sets(path[0], P, level, start, centre, beyond))
    if suspects.size and not flow.discrete and not effort.over:
        finer = simulate(flow, path[0, suspects], step / _FINER, _FINER * (len(path) - 1), effort)[::_FINER]
        if len(finer) == len(path):
            path[:, suspects] = finer
            settled, left = _fates(path, begins, P, level, target, apart)
    return Runs(path, step, settled, left)


def _in_sets(x: Array, P: Array, level: float, start: Array | None, centre: Array | None, beyond: Holds | None) -> Mask:
    """True for each state (N, n) in {V <= level}, in a tube's start (around `centre` or 0), or in the set `beyond`."""
    inside = quadratic(P, x) <= level
    if beyond is not None:
        inside |= beyond(x)
    return inside if start is None else inside | (quadratic(start, x if centre is None else x - centre) <= 1.0)


def _fates(path: Array, begins: Mask, P: Array, level: float, target: float, apart: int) -> tuple[Mask, Mask]:
    """True for each run that settles, and for each that leaves, (N,), by V at instants so many steps `apart`."""
    V = quadratic(P, path[::apart])
    with np.errstate(invalid="ignore"):
        settled = np.any(target >= V, axis=0)
        left = np.any(np.isnan(path[-1]), axis=-1) | (begins & np.any(_OUTSIDE * level < V, axis=0))
    return settled & ~left, left


def simulated_roa_fraction(
    system: System,
    network: PolicyNetwork,
    P: Array,
    level: float,
    *,
    points: int | None = None,
    step: float | None = None,
    horizon: float | None = None,
    settled: float | None = None,
    effort: Effort = UNLIMITED,
    start: Array | None = None,
    centre: Array | None = None,
    beyond: Holds | None = None,
) -> SimulatedRoa:
    """Simulate the closed loop from a grid over the domain and compare with `{x'Px <= level}`.

    A grid point counts as attracted if its run stays inside the domain and comes to `V <= settled` within the
    horizon. A run from the proved set that leaves is simulated again in much smaller steps before it counts.

    Parameters
    ----------
    system, network : the closed loop; one or two states.
    P, level : the proved set.
    points : grid points along each state; default 401 for one state, 35 for two.
    step, horizon : in seconds; defaults from the eigenvalues, see `time_scales`; the default horizon is doubled as
        long as that lets more runs settle.
    settled : the level that a run has to reach; default `SETTLED * level`, near the origin.
    effort : counted work; where it is over the simulation ends wherever it is.
    start, centre : (n, n) and (n,), of the ellipsoid {(x - c)'P(x - c) <= 1} that belongs to the proved set too,
        where a tube leads from it; c = 0 without a centre.
    beyond : which states (N, n) of the domain belong to it besides, (N,).

    Raises
    ------
    InputError : the plant has more than two states, or an option is not positive.
    """
    if system.n not in _GRID:
        raise InputError(f"a grid needs a plant with one or two states; {system.name} has {system.n}.")
    flow = Flow.of(system, network)
    default_step, default_horizon = time_scales(flow)
    given = horizon is not None
    step = default_step if step is None else step
    horizon = default_horizon if horizon is None else horizon
    points = _GRID[system.n] if points is None else points
    if not (points >= 1 and 0 < step < math.inf and 0 < horizon < math.inf):
        raise InputError("`points`, `step` and `horizon` must be positive and finite.")
    step = flow.fitting(step)
    centres = (np.arange(points) + 0.5) / points
    axes = tuple(a + (b - a) * centres for a, b in zip(flow.lo, flow.hi, strict=True))
    x = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, system.n)
    certified = _in_sets(x, P, level, start, centre, beyond)
    target = SETTLED * level if settled is None else settled
    decide = run_until_near if given else _until_decided
    attracted, left, reached = decide(flow, x, P, target, step, horizon, effort)
    suspects = np.flatnonzero(certified & left)
    if suspects.size and not flow.discrete:
        again, gone, _ = run_until_near(flow, x[suspects], P, target, step / _FINER, reached, effort)
        attracted[suspects], left[suspects] = again, gone
    clipped = clipped_at(network, system.input_bounds)
    saturating = None if clipped is None else Flow.of(system, clipped)
    more = None if saturating is None else run_until_near(saturating, x[left], P, target, step, reached, effort)[0]
    shape = (points,) * system.n
    attracted, left, certified = (mask.reshape(shape) for mask in (attracted, left, certified))
    count = None if more is None or effort.over else int(more.sum())
    return SimulatedRoa(axes, attracted, left, certified, step, reached, count)


def _until_decided(
    flow: Flow, x: Array, P: Array, target: float, step: float, horizon: float, effort: Effort
) -> tuple[Mask, Mask, float]:
    """As `run_until_near`, in twice the horizon as long as more runs come near in it."""
    attracted, left, reached = run_until_near(flow, x, P, target, step, horizon, effort)
    undecided = ~attracted & ~left

    def again(at: NDArray[np.int64], k: int) -> tuple[Mask, Mask] | None:
        late, gone, _ = run_until_near(flow, x[at], P, target, step, 2**k * reached, effort)
        return None if effort.over else (late, ~late & ~gone)

    reached *= 2 ** lengthened(attracted, undecided, again, DOUBLINGS)
    return attracted, ~attracted & ~undecided, reached


def run_until_near(
    flow: Flow,
    x: Array,
    P: Array,
    target: float,
    step: float,
    horizon: float,
    effort: Effort = UNLIMITED,
    farther: float = 0.0,
) -> tuple[Mask, Mask, float]:
    """Simulate; return the runs that reached `V <= target`, those that left the domain, what is kept or the bounds of
    inputs, and the simulated seconds.

    With `farther`, a horizon beyond `horizon`, each state has a step of its own, at least `step`, by which most runs
    come so far in as many steps.
    """
    attracted, left = np.zeros((2, len(x)), dtype=np.bool_)
    keeps = flow.keeps(x)
    alive, x, apart = np.flatnonzero(keeps), x[keeps], flow.steps_between(step)
    left[~keeps] = True
    reached, u, time = horizon, None, np.zeros(len(left))
    with np.errstate(all="ignore"):
        for k in range(math.ceil(horizon / step / apart) * apart):
            if k % apart == 0:
                near = quadratic(P, x) <= target
                attracted[alive[near]] = True
                x, alive, u = x[~near], alive[~near], None
                if flow.commands is not None:
                    within = flow.commands(x)
                    left[alive[~within]] = True
                    x, alive = x[within], alive[within]
            if not alive.size:
                break
            if effort.over:
                reached = k * step
                break
            effort.charge(flow.operations(len(x)))
            u = flow.input(x, u, k, step)
            if farther:
                effort.charge(flow.operations(len(x)))
                own = flow.steps_at(x, step, farther / _FEWEST_STEPS)
                time[alive] += own[:, 0]
                x = flow.advance(x, u, own)
            else:
                x = flow.advance(x, u, step)
            inside = np.all((x >= flow.lo) & (x <= flow.hi), axis=-1)  # False for NaN
            inside &= flow.keeps(x)
            left[alive[~inside]] = True
            inside &= time[alive] <= farther
            x, alive, u = x[inside], alive[inside], None if u is None else u[inside]
        near = quadratic(P, x) <= target
    attracted[alive[near]] = True
    return attracted, left, reached


def edge_of(
    flow: Flow, roa: SimulatedRoa, P: Array, target: float, effort: Effort = UNLIMITED
) -> tuple[Array, Array, Array]:
    """The simulated region of a plane, four times finer along its boundary: axes (K,), (L,), a share in [0, 1], (K, L).

    Between grid points that agree nothing is simulated; where neighbours differ their middle is, twice. What is left
    of the steps is smoothed over one fine cell, so that the line at 1/2 is as smooth as the boundary is known.

    Raises
    ------
    InputError : the grid is not one of a plane.
    """
    if len(roa.axes) != 2:
        raise InputError(f"the boundary of a region is drawn in a plane; the grid has {len(roa.axes)} axes.")
    (a, b), mask = roa.axes, roa.attracted
    for _ in range(_HALVINGS):
        if min(mask.shape) < 2 or effort.over:
            break
        # A new point takes a neighbour's answer, and is asked where the points around it differ.
        near = np.minimum((np.arange(2 * mask.shape[0] - 1) + 1) // 2, mask.shape[0] - 1)
        close = np.minimum((np.arange(2 * mask.shape[1] - 1) + 1) // 2, mask.shape[1] - 1)
        fine = mask[np.ix_(near, close)]
        known = np.zeros(fine.shape, dtype=np.bool_)
        known[::2, ::2] = True
        fine[::2, ::2] = mask
        around = np.lib.stride_tricks.sliding_window_view(np.pad(fine, 1, "edge"), (3, 3))
        ask = ~known & (around.any((2, 3)) != around.all((2, 3)))
        a, b = _halved(a), _halved(b)
        points = np.stack(np.meshgrid(a, b, indexing="ij"), -1)[ask]
        fine[ask] = run_until_near(flow, points, P, target, roa.step, roa.horizon, effort)[0]
        mask = fine
    return a, b, _smoothed(_smoothed(mask.astype(np.float64)).T).T


def _smoothed(values: Array) -> Array:
    """Gaussian means along the columns, as of `scipy.ndimage`, which takes longer to load than all of this."""
    weights = np.exp(-0.5 * np.arange(-_WIDTH, _WIDTH + 1) ** 2)
    weights, count = weights / weights.sum(), len(values)
    x = np.pad(values, ((_WIDTH, _WIDTH), (0, 0)), "edge")
    found: Array = weights[_WIDTH] * values
    for k in range(_WIDTH):
        found += weights[k] * (x[k : k + count] + x[2 * _WIDTH - k : 2 * _WIDTH - k + count])
    return found


def _halved(axis: Array) -> Array:
    """The points of an axis with their middles."""
    fine = np.empty(2 * len(axis) - 1)
    fine[::2], fine[1::2] = axis, (axis[:-1] + axis[1:]) / 2
    return fine


def growth(flow: Flow, P: Array, x: Array, step: float) -> Array:
    """V's change by time at states (..., n), shape (...): Vdot, in discrete time the increment of a step, with a held
    input that of a period over the period, simulated in steps up to `step`."""
    with np.errstate(all="ignore"):
        if flow.discrete:
            return quadratic(P, flow.field(x)) - quadratic(P, x)
        if not flow.period:
            return np.asarray(2 * np.einsum("...i,...i->...", x @ P, flow.field(x)))
        u, y, step = flow.policy(x), x, flow.fitting(step)
        for _ in range(flow.steps_between(step)):
            y = flow.advance(y, u, step)
        return (quadratic(P, y) - quadratic(P, x)) / flow.period


def quadratic(P: Array, x: Array) -> Array:
    """`x'Px` along the last axis."""
    return np.asarray(np.einsum("...i,...i->...", x @ P, x))
