"""The task of flattening: a policy on its plant, the goal that is copied, and the runs that judge."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from certify.errors import InputError, OptionError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.equilibrium import find_rest
from certify.loop.plants import System
from certify.loop.policies import Policy, PolicyNetwork, require_centred
from controllers.evaluation.curvature import nonlinearity_on
from controllers.evaluation.settling import MONITORING, settle
from controllers.flattening.contraction import with_value_at_origin
from controllers.flattening.gain_change import regained
from controllers.flattening.options import FlattenOptions
from controllers.flattening.result import Figures
from controllers.identification.linearisation import discrete_linearisation
from controllers.identification.riccati import riccati_gain
from controllers.options import Plant, held_over
from controllers.plants.choice import plant_of
from controllers.simulation.closed_loop import held_loop
from controllers.simulation.trajectories import initial_states, mean_action
from controllers.training.departure import departure_of

Array = NDArray[np.float64]

SMALLEST = 1e-12  # relative: below it a mean square counts as zero
_RUNS, _EVERY = 64, 10  # runs that give states to fit on, of which every tenth state is taken, in discrete time each


class Task:
    """A policy to flatten, as its plant and the options have it.

    Parameters
    ----------
    chosen : the plant and how it is judged, where it is not the one that ships under the policy's name.

    Attributes
    ----------
    old, goal : the policy's network, and the network that is copied: the old one, or the old one with the LQR gain K.
    box : half-widths (n,) of the box on which the departure is taken.
    value : the value (m,) that enters the goal's squash at the origin.
    J : the goal's Jacobian (m, n) at the origin.

    Raises
    ------
    InputError : policy, box and plant do not fit each other, or there is no LQR gain where it is asked for.
    """

    def __init__(self, policy: Policy, options: FlattenOptions, chosen: tuple[System, Plant] | None) -> None:
        self.policy, self.options, self.old = policy, options, policy.network
        self.system, self.plant = plant_of(policy, chosen)
        self.plant.check(self.system)
        self._require_sizes()
        self.u_eq = self.system.exact_u_eq()
        self.dt, self.Q, self.R = judging_weights(policy, self.system, self.plant)
        self.box = np.array(options.box if options.box is not None else self.plant.initial_states)
        self.K = None if options.gain == "kept" else self._lqr_gain()
        self.goal = self.old if self.K is None else regained(self.old, self.u_eq, -self.K, self.box)
        self.folded = self.goal.folded(self.u_eq)
        self.value = np.asarray(self.folded.net(np.zeros(self.system.n)))
        self.J = self.goal.jacobian_at_origin(self.u_eq)
        self.exactly_centred = self._is_exactly_centred()
        self.x0 = initial_states(self.system, _RUNS, options.seed, self.plant)

    def visited(self, network: PolicyNetwork) -> Array:
        """States (N, n) on the way from the box of initial states, over an episode's horizon, inside the domain."""
        return visited_states(network, self.system, self.plant, (self.dt, self.Q, self.R), self.x0)

    def inputs(self, network: PolicyNetwork, states: Array) -> Array:
        """The inputs (N, m) that a policy gives at states (N, n)."""
        return mean_action(network, self.system)(states)

    def size_of_inputs(self, states: Array) -> Array:
        """Root mean square (m,) of the goal's deviations from u(0) on these states: one share of each input's scale.

        Raises
        ------
        InputError : the inputs never leave u(0).
        """
        at_0 = self.inputs(self.goal, np.zeros((1, self.system.n)))
        relative = (self.inputs(self.goal, states) - at_0) / np.abs(self.goal.scale)
        mean = float((relative**2).sum(axis=1).mean())
        if not mean > SMALLEST:
            raise InputError(
                "the policy must act on the states from its box of initial states; its inputs never leave u(0) there."
            )
        return np.asarray(math.sqrt(mean) * np.abs(self.goal.scale))

    def slope(self) -> Array:
        """d u / d net (m,) of the goal at the origin."""
        squashed = self.folded.squashed(self.value)
        return np.asarray(self.folded.scale * self.folded.squash_slope(squashed) * np.ones(self.system.m))

    def gain_change(self, network: PolicyNetwork, J: Array) -> float:
        """The difference of a policy's Jacobian at the origin from J (m, n), on the box and relative to J."""
        size = max(float(np.linalg.norm(J * self.box)), SMALLEST)
        return float(np.linalg.norm((network.jacobian_at_origin(self.u_eq) - J) * self.box)) / size

    def rest_of(self, network: PolicyNetwork) -> Array:
        """The state (n,) where the loop of a policy rests: the origin, or beside it if nothing centres the policy."""
        if network.centre != "none" or self.exactly_centred:
            return np.zeros(self.system.n)
        rest = find_rest(ClosedLoop(self.system, network))
        return np.array(rest.x, dtype=np.float64) if rest is not None and rest.stable else np.zeros(self.system.n)

    def figures(self, network: PolicyNetwork) -> Figures:
        """The figures of a policy, by the runs that judge: they settle towards where its loop rests."""
        judged = replace(MONITORING, states=self.options.states, seed=self.options.seed)
        found = settle(network, self.system, self.dt, self.Q, self.R, judged, self.plant, self.rest_of(network))
        return Figures(
            departure=departure_of(network, self.box.tolist()),
            bend=nonlinearity_on(network, self.u_eq, self.box).bend,
            settled=found.settled,
            states=found.states,
            cost=found.cost,
        )

    def with_layers(self, weights: tuple[Array, ...], biases: tuple[Array, ...]) -> PolicyNetwork:
        """The old policy with other layers, and with the old value before its squash at the origin."""
        network = self.old.with_numbers(weights, biases)
        return with_value_at_origin(network, np.asarray(self.old.net(np.zeros(self.system.n))))

    def lqr_weights(self) -> tuple[Array, Array]:
        """Diagonals of the LQR's weights: those of the options, else of the runs that judge.

        Raises
        ------
        InputError : they have other sizes than the plant, or an input has no weight.
        """
        asked = zip((self.options.Q, self.options.R), (self.Q, self.R), strict=True)
        Q, R = (judging if given is None else np.array(given) for given, judging in asked)
        if (len(Q), len(R)) != (self.system.n, self.system.m):
            raise OptionError(
                f"`Q` and `R` must have {self.system.n} and {self.system.m} weights for {self.system.name}; "
                f"found {len(Q)} and {len(R)}."
            )
        if not np.all(R > 0):
            raise OptionError(
                f"the LQR gain needs input weights that are positive; the policy's record has {R.tolist()}. Give "
                "others with `R`, or keep the policy's own gain."
            )
        return Q, R

    def _lqr_gain(self) -> Array:
        """K (m, n) of `u = u_eq - K x`, for the plant's linearisation at the time step of the runs that judge."""
        Q, R = self.lqr_weights()
        return riccati_gain(*discrete_linearisation(self.system, self.dt), np.diag(Q), np.diag(R))

    def _require_sizes(self) -> None:
        network, system, box = self.old, self.system, self.options.box
        if (network.n, network.m) != (system.n, system.m):
            raise InputError(
                f"the policy must map {system.n} states to {system.m} inputs for {system.name}; "
                f"it maps {network.n} to {network.m}."
            )
        if not network.network.functions:
            raise InputError("a policy to flatten must have hidden units; this one is a single layer, already flat.")
        if box is not None and len(box) != system.n:
            raise OptionError(f"`box` must have {system.n} half-widths for {system.name}; found {len(box)}.")

    def _is_exactly_centred(self) -> bool:
        """True if pi(0) = u_eq rests on the biases' own numbers, which must then stay as they are."""
        if self.old.centre != "none":
            return False
        try:
            require_centred(self.old, self.u_eq)
        except InputError:
            return False
        return True


def visited_states(
    network: PolicyNetwork, system: System, plant: Plant, judging: tuple[float, Array, Array], x0: Array
) -> Array:
    """States (N, n) on the way from x0, over an episode's horizon, inside the domain; `judging` is dt, Q and R."""
    dt, Q, R = judging
    loop = held_loop(system, dt, mean_action(network, system), Q, R)
    preset, every = plant.preset, 1 if system.time == "discrete" else _EVERY
    runs = loop.run(x0, preset.horizon * preset.dt)
    states = np.concatenate([x for k, (x, _) in enumerate(runs) if k % every == 0])
    lo, hi = np.array(system.domain, dtype=np.float64).T
    return np.asarray(states[((states >= lo) & (states <= hi)).all(axis=1)])  # NaN, a run that diverged, is not


def judging_weights(policy: Policy, system: System, plant: Plant) -> tuple[float, Array, Array]:
    """dt, Q and R of the runs that judge: the policy's record, and the plant's preset where it has none.

    dt is one over which the plant holds its inputs, in discrete time 1.

    Raises
    ------
    InputError : the record holds something else.
    """
    preset, record = plant.preset, policy.training
    wanted = (("dt", ()), ("state_weights", (system.n,)), ("input_weights", (system.m,)))
    found = []
    for name, shape in wanted:
        try:
            value = np.array(record.get(name, getattr(preset, name)), dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise InputError(f"`training.{name}` of the policy must hold numbers.") from error
        if value.shape != shape or not np.all(np.isfinite(value)) or np.any(value < 0):
            raise InputError(f"`training.{name}` must hold finite numbers of shape {shape}, none of them negative.")
        found.append(value)
    dt = float(found[0])
    if not dt > 0:
        raise InputError(f"`training.dt` of the policy must be positive; found {dt}.")
    return held_over(system, dt), found[1], found[2]
