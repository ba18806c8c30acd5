"""How well a policy controls its plant, by simulation: figures for a report, never a proof.

A run has *settled* when ||x|| < 1e-6 throughout the last second of 60 s. It is simulated twice from the same
initial states: with the policy evaluated at every Runge-Kutta stage, in steps that resolve the fastest
eigenvalue of the closed loop, and with the action held over the training step. While a policy is trained,
`MONITORING` asks for less: ||x|| < 1e-3 throughout the last second of 20 s, action held, 100 initial states.

A plant in discrete time is simulated once, by its own map, and its time is counted in steps: the last 50 of 3,000, and
of 1,000 while a policy is trained.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from certify.certificates.membership import ProvedSet
from certify.errors import InputError
from certify.loop.expressions import Expression, gathered
from certify.loop.plants import System, shipped_system
from certify.loop.plants.system import Time
from certify.loop.policies import Policy, TanhNetwork
from controllers.environments import Stepper
from controllers.lqr import Identified, riccati_gain
from controllers.options import Plant, held_over
from controllers.simulation import Loop, continuous_loop, held_loop, initial_states, mean_action
from controllers.threads import threads_for

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluationOptions:
    """How a policy is judged.

    Parameters
    ----------
    states : number of initial states, uniform in the plant's box.
    seed : of the initial states.
    duration, window : seconds simulated, and the last seconds in which the state must stay small.
    duration_steps, window_steps : the same of a plant in discrete time, in steps.
    tolerance : bound on ||x|| in the window.
    resolution : step of the continuous simulation, as a multiple of 1 / (fastest eigenvalue's modulus).
    """

    states: int = 1000
    seed: int = 0
    duration: float = 60.0
    window: float = 1.0
    duration_steps: int = 3000
    window_steps: int = 50
    tolerance: float = 1e-6
    resolution: float = 0.2

    def __post_init__(self) -> None:
        for name in ("states", "duration", "window", "duration_steps", "window_steps", "tolerance", "resolution"):
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"`{name}` must be positive and finite; found {getattr(self, name)}.")
        if self.seed < 0 or self.window > self.duration or self.window_steps > self.duration_steps:
            raise InputError("`seed` must be at least 0, and `window` at most `duration`, in seconds and in steps.")

    def span(self, system: System) -> tuple[float, float]:
        """Duration and window in the plant's unit of time: seconds, or steps."""
        if system.time == "discrete":
            return self.duration_steps, self.window_steps
        return self.duration, self.window


MONITORING = EvaluationOptions(states=100, duration=20.0, duration_steps=1000, tolerance=1e-3)
"""How a policy is judged now and then while it is trained."""


@dataclass(frozen=True, slots=True)
class Settling:
    """One simulation of all initial states.

    `largest` is the largest ||x|| of any run in the window; `left_domain` counts runs that were outside the
    domain at some step. `cost` is the integral of `x'Q x + (u - u_eq)'R (u - u_eq)`, in discrete time its sum, median
    over the runs. `step` is in seconds, and 1 in discrete time.
    """

    settled: int
    states: int
    largest: float
    left_domain: int
    cost: float
    step: float


@dataclass(frozen=True, slots=True)
class Covered:
    """How many of the initial states lie in the set that a certificate proves, each of them decided in rationals.

    `claim` is what kind of claim it makes about them, `certificate_sha256` says which file.
    """

    inside: int
    states: int
    claim: str
    certificate_sha256: str


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Figures of one policy. A, B, K are the learned ones of its record; NaN where the record has none.

    `K_relative_error` is against the gain of the true plant, for the weights that the record says K was made for.
    `curvature` is that of `curvature()` in the ball in which the plant was identified; NaN without `training.eta`.
    `eigenvalues` are those of the closed loop's Jacobian at the origin: of the rate of change, or, where `time` is
    discrete, of a step. `continuous` is None in discrete time. `covered` is None without a certificate.
    """

    system: str
    time: Time
    sha256: str
    gain_distance: float
    gain_relative: float
    curvature: float
    A_relative_error: float
    B_relative_error: float
    K_relative_error: float
    eigenvalues: tuple[complex, ...]
    continuous: Settling | None
    held: Settling
    covered: Covered | None = None

    def as_json(self) -> dict[str, Any]:
        """Plain values; NaN and infinity become None."""

        def settling(s: Settling) -> dict[str, Any]:
            return {
                "settled": s.settled,
                "states": s.states,
                "largest": _finite(s.largest),
                "left_domain": s.left_domain,
                "cost": _finite(s.cost),
                "step": s.step,
            }

        return {
            "system": self.system,
            "time": self.time,
            "policy": {"sha256": self.sha256},
            "gain": {"distance": _finite(self.gain_distance), "relative": _finite(self.gain_relative)},
            "curvature": _finite(self.curvature),
            "identification": {
                "A": _finite(self.A_relative_error),
                "B": _finite(self.B_relative_error),
                "K": _finite(self.K_relative_error),
            },
            "eigenvalues": [[e.real, e.imag] for e in self.eigenvalues],
            "continuous": None if self.continuous is None else settling(self.continuous),
            "held": settling(self.held),
            "proved": None if self.covered is None else asdict(self.covered),
        }


def evaluate(
    policy: Policy,
    options: EvaluationOptions | None = None,
    own: tuple[System, Plant] | None = None,
    proved: ProvedSet | None = None,
) -> Evaluation:
    """Simulate `policy` on the plant that it names, or on `own` with its box, and compare it with its learned gain.

    With a `proved` set of this policy the initial states in it are counted.

    Raises
    ------
    InputError : the plant is unknown or has no box of initial states, the sizes of policy and plant differ,
        the record lacks what the held simulation needs (weights, in continuous time `dt`), or `proved` is about
        another loop.
    """
    options = options or EvaluationOptions()
    if own is None:
        system, plant = shipped_system(policy.system).with_parameters(policy.parameters), None
    else:
        system, plant = own
    network = policy.network
    if (network.n, network.m) != (system.n, system.m):
        raise InputError(
            f"the policy must map {system.n} states to {system.m} inputs for {system.name}; "
            f"it maps {network.n} to {network.m}."
        )
    x0 = initial_states(system, options.states, options.seed, plant)
    covered = None if proved is None else count_covered(proved, network, system, x0)
    dt = recorded_step(policy, system)
    Q = np.asarray(recorded(policy, "state_weights", (system.n,)))
    R = np.asarray(recorded(policy, "input_weights", (system.m,)))

    eigenvalues = np.linalg.eigvals(_closed_loop_jacobian(system, policy))
    continuous = None
    with threads_for(network):
        if system.time == "continuous":
            fastest = float(np.abs(eigenvalues).max())
            h = min(dt, options.resolution / fastest) if fastest > 0 else dt
            continuous = _settling(continuous_loop(system, h, mean_action(network, system), Q, R), system, x0, options)
        held = settle(network, system, dt, Q, R, options, plant)

    distance = relative = math.nan
    learned = (math.nan, math.nan, math.nan)
    if {"A", "B", "K"} <= set(policy.training):
        n, m = system.n, system.m
        A, B, K = (recorded(policy, *entry) for entry in (("A", (n, n)), ("B", (n, m)), ("K", (m, n))))
        distance = float(np.linalg.norm(network.jacobian_at_origin(system.exact_u_eq()) + K))
        relative = distance / float(np.linalg.norm(K))
        learned = errors_of(Identified(A, B, K), system, dt, *_gain_weights(policy, Q, R))
    return Evaluation(
        system=system.name,
        time=system.time,
        sha256=network.sha256(),
        gain_distance=distance,
        gain_relative=relative,
        curvature=curvature(network, system, recorded(policy, "eta", ())) if "eta" in policy.training else math.nan,
        A_relative_error=learned[0],
        B_relative_error=learned[1],
        K_relative_error=learned[2],
        eigenvalues=tuple(complex(e) for e in eigenvalues),
        continuous=continuous,
        held=held,
        covered=covered,
    )


def count_covered(proved: ProvedSet, network: TanhNetwork, system: System, x0: Array) -> Covered:
    """How many of the states (N, n), deviations from x_eq, lie in a set that is proved about this very closed loop.

    Raises
    ------
    InputError : as `require_same_loop`.
    """
    require_same_loop(proved, network, system)
    inside = sum(proved.holds(proved.deviations(x0.tolist())))
    return Covered(inside, len(x0), proved.claim, proved.certificate_sha256)


def require_same_loop(proved: ProvedSet, network: TanhNetwork, system: System) -> None:
    """Refuse a set that is proved about another closed loop.

    Raises
    ------
    InputError : the certificate is about another policy, about other equations, or about less of what is uncertain.
    """
    if proved.policy_sha256 != network.sha256():
        raise InputError(
            f"the certificate must be about the policy that is evaluated, {network.sha256()}; it is about "
            f"{proved.policy_sha256}. Certify this one with `certify roa`."
        )
    theirs = proved.system
    for name, (lo, hi) in system.ranges.items():
        known = theirs.ranges.get(name)
        if known is None or not known[0] <= lo <= hi <= known[1]:
            said = "one value of it" if known is None else f"[{float(known[0]):g}, {float(known[1]):g}]"
            raise InputError(
                f"the certificate must hold for all that is uncertain of {system.name}, `{name}` in [{float(lo):g}, "
                f"{float(hi):g}]; it is about {said}. Certify the policy on this plant."
            )
    alike = (theirs.states, theirs.inputs, theirs.time) == (system.states, system.inputs, system.time)
    mine = proved.seen_from_there(system) if alike else system
    equal = _dynamics(theirs, system.ranges) == _dynamics(mine, system.ranges)
    if not alike or not equal or theirs.exact_u_eq() != mine.exact_u_eq():
        raise InputError(
            f"the certificate must be about the plant that is simulated, {system.name} with these parameters; it is "
            f"about {theirs.name} with other equations. Certify the policy on this plant."
        )


def require_same_question(proved: ProvedSet, network: TanhNetwork, system: System) -> None:
    """Refuse a set that is proved about another closed loop, or is not what would be proved of this one today.

    Raises
    ------
    InputError : as `require_same_loop`; or domain, bounds of the inputs, what is uncertain, or how long inputs are held
        were others.
    """
    require_same_loop(proved, network, system)
    seen = proved.seen_from_there(system)
    for name in ("domain", "input_bounds", "ranges", "sample"):
        theirs, mine = getattr(proved.system, name), getattr(seen, name)
        if theirs != mine:
            raise InputError(
                f"the certificate must be about {system.name} as it is; its `{name}` was another one. Certify the "
                "policy on this plant."
            )


def _dynamics(system: System, acting: Iterable[str]) -> tuple[Expression, ...]:
    """The equations with these uncertain quantities free, all others at their nominal values, and constants gathered:
    an input with an error of 0 is the input."""
    still = {name: None for name in system.ranges if name not in set(acting)}
    return tuple(map(gathered, system.with_ranges(still).uncertain_dynamics()))


def settle(
    network: TanhNetwork,
    system: System,
    dt: float,
    Q: Array,
    R: Array,
    options: EvaluationOptions = MONITORING,
    plant: Plant | None = None,
) -> Settling:
    """Simulate `network` with its action held over dt, or in discrete time a step, from the plant's initial states.

    Parameters
    ----------
    Q, R : diagonals of the cost's weights, shapes (n,) and (m,).
    plant : whose box the initial states come from; default: the plant that ships under the system's name.

    Raises
    ------
    InputError : the plant has no box of initial states.
    """
    loop = held_loop(system, dt, mean_action(network, system), Q, R)
    return _settling(loop, system, initial_states(system, options.states, options.seed, plant), options)


def curvature(network: TanhNetwork, system: System, radius: float, points: int = 256) -> float:
    """Largest `||J_pi(x) - J_pi(0)|| / ||x||` over random states of ||x|| <= radius, Frobenius norm.

    An estimate from below of the largest second derivative of pi in the ball, in input units per state squared.
    What the local proof must absorb near the origin grows with it, so the certified local level shrinks.
    The states are always the same ones.

    Raises
    ------
    InputError : `radius` is not positive.
    """
    if not radius > 0:
        raise InputError(f"`radius` must be positive; found {radius}.")
    generator = np.random.default_rng(0)
    x = generator.standard_normal((points, system.n))
    length = radius * generator.uniform(size=(points, 1)) ** (1 / system.n)
    x *= length / np.linalg.norm(x, axis=1, keepdims=True)
    u_eq = system.exact_u_eq()
    folded = network.folded(u_eq)
    jacobians = torch.func.vmap(torch.func.jacrev(lambda y: folded(y, u_eq)))(torch.from_numpy(x)).numpy()
    change = np.linalg.norm(jacobians - network.jacobian_at_origin(u_eq), axis=(1, 2))
    return float((change / length[:, 0]).max())


def discrete_linearisation(system: System, dt: float) -> tuple[Array, Array]:
    """A and B of the simulator's step at (0, u_eq): what least squares should have found; dt as `Stepper` takes it."""
    stepper = Stepper(system, dt, "torch")
    x = torch.zeros(system.n, dtype=torch.float64)
    u = torch.tensor([float(v) for v in system.exact_u_eq()], dtype=torch.float64)
    A, B = torch.autograd.functional.jacobian(stepper, (x, u))  # type: ignore[no-untyped-call]
    return A.numpy(), B.numpy()


def errors_of(learned: Identified, system: System, dt: float, Q: Array, R: Array) -> tuple[float, float, float]:
    """Relative errors of A, B and K in the Frobenius norm, against the simulator's own linearisation and its gain.

    NaN where what is true is 0, and for K where the true plant has no gain for these weights.

    Parameters
    ----------
    Q, R : diagonals of the weights that K was made for, shapes (n,) and (m,).
    """
    A, B = discrete_linearisation(system, dt)
    try:
        K = riccati_gain(A, B, np.diag(Q), np.diag(R))
    except InputError:
        K = np.full_like(learned.K, math.nan)
    return _relative(learned.A, A), _relative(learned.B, B), _relative(learned.K, K)


def _relative(found: Array, true: Array) -> float:
    size = float(np.linalg.norm(true))
    return float(np.linalg.norm(found - true)) / size if size > 0 else math.nan


def _gain_weights(policy: Policy, Q: Array, R: Array) -> tuple[Array, Array]:
    """The weights of the record's K: those of training, or those for which `controllers flatten` gave it another."""
    flattened = policy.training.get("flattened")
    if not isinstance(flattened, dict) or "K" not in flattened:
        return Q, R
    record = replace(policy, training=flattened)
    return np.asarray(recorded(record, "Q", Q.shape)), np.asarray(recorded(record, "R", R.shape))


def _closed_loop_jacobian(system: System, policy: Policy) -> Array:
    f, u_eq = system.function("torch"), system.exact_u_eq()
    x = torch.zeros(system.n, dtype=torch.float64)
    jacobian = torch.autograd.functional.jacobian(  # type: ignore[no-untyped-call]
        lambda y: f(y, policy.network(y, u_eq)), x
    )
    return np.asarray(jacobian)


def _settling(loop: Loop, system: System, x0: Array, options: EvaluationOptions) -> Settling:
    domain = np.array(system.domain, dtype=np.float64)
    duration, window = options.span(system)
    window_begins = loop.count(duration) - loop.count(window)
    largest, outside, cost = np.zeros(len(x0)), np.zeros(len(x0), dtype=bool), np.zeros(len(x0))
    for k, (x, total) in enumerate(loop.run(x0, duration)):
        if k >= window_begins:
            norm = np.linalg.norm(x, axis=1)
            largest = np.maximum(largest, np.where(np.isnan(norm), math.inf, norm))
        outside |= ~((x >= domain[:, 0]) & (x <= domain[:, 1])).all(axis=1)
        cost = total
    return Settling(
        settled=int((largest < options.tolerance).sum()),
        states=len(x0),
        largest=float(largest.max()),
        left_domain=int(outside.sum()),
        cost=float(np.median(cost)),
        step=loop.h,
    )


def recorded_step(policy: Policy, system: System) -> float:
    """The time step of the record, or the nearest of those that the plant has, whatever the record says: 1 in discrete
    time, else where inputs are held over given times one of these.

    Raises
    ------
    InputError : the record has no time step that is positive, and needs one.
    """
    if system.time == "discrete":
        return 1.0
    dt = float(recorded(policy, "dt", ()))
    if not dt > 0:
        raise InputError(f"`training.dt` of the policy must be positive; found {dt}.")
    return held_over(system, dt)


def recorded(policy: Policy, name: str, shape: Sequence[int]) -> Any:
    """`training[name]`, which is not trusted: finite numbers of the given shape, or InputError."""
    try:
        value = np.array(policy.training[name], dtype=np.float64)
    except KeyError as error:
        raise InputError(f"the policy's `training` record must have {name!r}.") from error
    except (TypeError, ValueError) as error:
        raise InputError(f"`training.{name}` of the policy must hold numbers.") from error
    if value.shape != tuple(shape) or not np.all(np.isfinite(value)):
        raise InputError(f"`training.{name}` must hold finite numbers of shape {tuple(shape)}.")
    return float(value) if not shape else value


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
