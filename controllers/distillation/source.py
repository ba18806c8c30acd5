"""The source of distillation: a policy on its plant, the states at which it is imitated, and the runs that judge."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from certify.errors import InputError
from certify.loop.plants import System
from certify.loop.policies import Policy, PolicyNetwork
from controllers.distillation.options import DistilOptions
from controllers.evaluation.settling import MONITORING, Settling, settle
from controllers.flattening.task import judging_weights, visited_states
from controllers.options import Plant
from controllers.plants.choice import plant_of
from controllers.simulation.trajectories import initial_states, mean_action

Array = NDArray[np.float64]

_RUNS = 64  # of the source's loop, whose states are imitated
_NEAREST = 1e-3  # share of the domain down to which states near the origin are drawn
_LEVEL = 0.05  # share of the domain inside which all states weigh the same


class Source:
    """A policy to imitate.

    Attributes
    ----------
    network, folded : the policy, and the same without centring.
    J : its Jacobian (m, n) at the origin.
    lo, hi : the states that are imitated: the plant's domain, cut to the policy's bounds of validity.
    half_widths : (n,), of the box around the origin in it.
    factors : powers of two (n,) that bring this box to order one.
    judging : dt, Q and R of the runs.

    Raises
    ------
    InputError : policy and plant do not fit each other, or the policy's clip may act at the origin.
    """

    def __init__(self, policy: Policy, options: DistilOptions, chosen: tuple[System, Plant] | None) -> None:
        self.policy, self.options, self.network = policy, options, policy.network
        self.system, self.plant = plant_of(policy, chosen)
        self.plant.check(self.system)
        if (self.network.n, self.network.m) != (self.system.n, self.system.m):
            raise InputError(
                f"the policy must map {self.system.n} states to {self.system.m} inputs for {self.system.name}; "
                f"it maps {self.network.n} to {self.network.m}."
            )
        u_eq = self.system.exact_u_eq()
        self.folded, self.J = self.network.folded(u_eq), self.network.jacobian_at_origin(u_eq)
        self.lo, self.hi = np.array(self.system.domain, dtype=np.float64).T
        if policy.valid is not None:
            self.lo, self.hi = np.maximum(self.lo, policy.valid[:, 0]), np.minimum(self.hi, policy.valid[:, 1])
        self.half_widths = np.minimum(-self.lo, self.hi)
        self.factors = 0.5 ** np.round(np.log2(np.maximum(-self.lo, self.hi)))
        self.judging = judging_weights(policy, self.system, self.plant)

    def inputs(self, network: PolicyNetwork, states: Array) -> Array:
        """The inputs (N, m) that a policy gives at states (N, n)."""
        return mean_action(network, self.system)(states)

    def uniform(self, count: int, seed: int) -> Array:
        """States (count, n), uniform in the domain."""
        return np.random.default_rng(seed).uniform(self.lo, self.hi, (count, self.system.n))

    def samples(self) -> tuple[Array, Array]:
        """States (N, n) to imitate, and their weights (N,) of mean 1."""
        seed, count = self.options.seed, self.options.samples
        generator = np.random.default_rng(seed)
        half = self.uniform(count - count // 2, seed)
        sizes = _NEAREST ** generator.uniform(size=(count // 4, 1))
        near = sizes * generator.uniform(self.lo, self.hi, (count // 4, self.system.n))
        x0 = initial_states(self.system, _RUNS, seed, self.plant)
        visited = visited_states(self.network, self.system, self.plant, self.judging, x0)
        visited = visited[((visited >= self.lo) & (visited <= self.hi)).all(axis=1)]
        if len(visited):
            visited = visited[generator.integers(len(visited), size=count // 4)]
        x = np.concatenate([half, near, visited])
        share = np.abs(x / np.where(x < 0, self.lo, self.hi)).max(axis=1)
        weights = 1 / (_LEVEL**2 + share**2)
        return x, weights / weights.mean()

    def size(self, inputs: Array) -> Array:
        """The inputs' scale (m,): root mean square of their deviations from u(0) on the samples, as one share."""
        at_0 = self.inputs(self.network, np.zeros((1, self.system.n)))
        relative = (inputs - at_0) / np.abs(self.network.scale)
        mean = float((relative**2).sum(axis=1).mean())
        return np.asarray(max(np.sqrt(mean), 1e-6) * np.abs(self.network.scale))

    def runs(self, network: PolicyNetwork) -> Settling:
        """The runs of a policy, from the same initial states for all."""
        judged = replace(MONITORING, states=self.options.states, seed=self.options.seed)
        return settle(network, self.system, *self.judging, judged, self.plant)
