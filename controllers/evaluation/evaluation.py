"""The evaluation of a policy by simulation: figures for a report, never a proof.

Runs are simulated twice from the same initial states: with the policy evaluated at every Runge-Kutta stage, in steps
that resolve the fastest eigenvalue of the closed loop, and with inputs held over the training step. A plant in discrete
time is simulated once, by its own map.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from certify.certificates.membership import ProvedSet
from certify.errors import InputError
from certify.loop.plants import System
from certify.loop.plants.system import Time
from certify.loop.policies import Policy
from certify.loop.policies.nonlinearity import Nonlinearity
from controllers.evaluation.corners import nearest_corner
from controllers.evaluation.curvature import curvature, nonlinearity_on
from controllers.evaluation.proved_set import Covered, count_covered
from controllers.evaluation.record import recorded, recorded_step
from controllers.evaluation.settling import EvaluationOptions, Settling, settle, settling_of
from controllers.evaluation.threads import threads_for
from controllers.identification.gain_learner import Identified
from controllers.identification.linearisation import errors_of
from controllers.options import Plant
from controllers.plants.choice import plant_of
from controllers.simulation.closed_loop import continuous_loop
from controllers.simulation.trajectories import initial_states, mean_action

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Figures of one policy. A, B, K are the learned ones of its record; NaN where the record has none.

    `K_relative_error` is against the gain of the true plant, for the weights that the record says K was made for.
    `curvature` is that of `curvature()` in the ball in which the plant was identified; NaN without `training.eta`.
    `corner` is that of `nearest_corner()`, infinite for smooth units; `nonlinearity` is on the box of initial states.
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
    corner: float = math.inf
    nonlinearity: Nonlinearity | None = None

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
            "nearest_corner": _finite(self.corner),
            "nonlinearity": None if self.nonlinearity is None else self.nonlinearity.to_dict(),
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
    chosen: tuple[System, Plant] | None = None,
    proved: ProvedSet | None = None,
) -> Evaluation:
    """Simulate `policy` on its plant, or on the `chosen` one with its box, and compare it with its learned gain.

    With a `proved` set of this policy the initial states in it are counted.

    Raises
    ------
    InputError : the plant is unknown or has no box of initial states, the sizes of policy and plant differ,
        the record lacks what the held simulation needs (weights, in continuous time `dt`), or `proved` is about
        another loop.
    """
    options = options or EvaluationOptions()
    system, plant = plant_of(policy, chosen)
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
            continuous = settling_of(
                continuous_loop(system, h, mean_action(network, system), Q, R), system, x0, options
            )
        held = settle(network, system, dt, Q, R, options, plant)

    distance, relative, learned = _gain_figures(policy, system, dt, Q, R)
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
        corner=nearest_corner(network, system),
        nonlinearity=nonlinearity_on(network, system.exact_u_eq(), plant.initial_states),
    )


def _gain_figures(
    policy: Policy, system: System, dt: float, Q: Array, R: Array
) -> tuple[float, float, tuple[float, float, float]]:
    """||J + K||, the same relative to ||K||, and the relative errors of A, B, K; NaN without a learned gain."""
    if not {"A", "B", "K"} <= set(policy.training):
        return math.nan, math.nan, (math.nan,) * 3
    n, m = system.n, system.m
    A, B, K = (recorded(policy, *entry) for entry in (("A", (n, n)), ("B", (n, m)), ("K", (m, n))))
    distance = float(np.linalg.norm(policy.network.jacobian_at_origin(system.exact_u_eq()) + K))
    errors = errors_of(Identified(A, B, K), system, dt, *_gain_weights(policy, Q, R))
    return distance, distance / float(np.linalg.norm(K)), errors


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


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
