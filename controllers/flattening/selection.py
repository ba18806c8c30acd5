"""The selection among the policies that flattening tries: the best one within the bounds on settled share and cost."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from certify.errors import InputError, OptionError
from certify.loop.policies import PolicyNetwork, require_centred
from controllers.evaluation.corners import nearest_corner
from controllers.flattening.result import Figures
from controllers.flattening.task import Task
from controllers.training.departure import departure_of

Array = NDArray[np.float64]

GAIN = 100.0
"""Weight of the Jacobian's change at 0 beside the fit: one per cent of it counts like inputs that are off by ten."""


class Selection:
    """The best policy so far whose runs settle as often as before, and at least once, at a median cost that is allowed.

    Parameters
    ----------
    states : states (N, n) on which the fit is taken, the same for all policies.

    Raises
    ------
    InputError : the old policy has no finite median cost, or none of its runs settles and its gain is to be kept.
    """

    def __init__(self, task: Task, states: Array) -> None:
        self.task, self.states = task, states
        self.size = task.size_of_inputs(states)
        self.before = task.figures(task.old)
        if not math.isfinite(self.before.cost):
            raise InputError(
                f"the policy must have a finite median cost to compare with; half of {task.options.states} runs of "
                f"{task.system.name} or more diverge. Choose smaller `initial_states`, or train it further."
            )
        if not self.before.settled and task.options.gain == "kept":
            raise OptionError(
                f"some runs must settle before flattening, for it is by them that the result is judged: none of "
                f"{self.before.states} runs of {task.system.name} does, from its box of initial states towards where "
                "the loop rests. If it is the gain at the origin that lets none settle, ask for another with `gain` lqr"
                "; else train the policy further, or choose smaller `initial_states`."
            )
        self.corner = min(1.0, nearest_corner(task.old, task.system))  # no unit may have its corner nearer
        self.best: tuple[PolicyNetwork, Figures] | None = None
        self.bound = math.inf  # that the next objective must be below

    def keep(self, network: PolicyNetwork, objective_of: Callable[[Figures], float] | None = None) -> bool:
        """Remember a policy that is better than all before and within the bounds; True if it is one.

        Parameters
        ----------
        objective_of : the objective by a policy's figures, where it is not `objective`, and not the departure but
            `bound` says what is easier to prove than the old policy.
        """
        if not all(np.all(np.isfinite(a)) for a in (a for step in network.network.affine for a in step.arrays)):
            return False
        figures = None if objective_of is None else self.task.figures(network)
        objective = self.objective(network) if figures is None or objective_of is None else objective_of(figures)
        if objective >= self.bound:
            return False
        if nearest_corner(network, self.task.system) < self.corner:
            return False
        task, figures = self.task, figures or self.task.figures(network)
        allowed = (1 + task.options.max_cost_change) * self.before.cost
        if not (
            (objective_of is not None or figures.departure < self.before.departure)
            and figures.settled >= max(1, self.before.settled)
            and figures.cost <= allowed
        ):
            return False
        if task.exactly_centred and task.old.centre == "none":
            require_centred(network, task.u_eq)
        self.best, self.bound = (network, figures), objective
        return True

    def objective(self, network: PolicyNetwork) -> float:
        """The loss of training in double precision, on the states that are the same for all."""
        task = self.task
        change = (task.inputs(network, self.states) - task.inputs(task.goal, self.states)) / self.size
        fit = float((change**2).sum(axis=1).mean())
        gain = task.gain_change(network, task.J) ** 2
        return fit + GAIN * gain + task.options.weight * departure_of(network, task.box.tolist())
