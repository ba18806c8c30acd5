"""The monitoring of a run: its policy judged now and then, in a second or so."""

from __future__ import annotations

import math

import numpy as np

from certify.loop.plants import System
from certify.loop.policies import PolicyNetwork
from controllers.evaluation.curvature import curvature
from controllers.evaluation.settling import settle
from controllers.identification.gain_learner import Identified
from controllers.identification.linearisation import errors_of
from controllers.options import Plant, TrainingOptions, available_plants
from controllers.training.log import Monitored


def monitored(
    network: PolicyNetwork,
    identified: Identified | None,
    system: System,
    plant: Plant | None,
    options: TrainingOptions,
    at: tuple[int, float, float],
) -> Monitored:
    """A row of the second log.

    Parameters
    ----------
    plant : whose box runs start in; None for that of the plant that ships under the system's name, if there is one.
    at : the step, and the actor's ||J_mu(0) + K|| and ||mu(0) - u_eq||.
    """
    Q, R = np.array(options.state_weights), np.array(options.input_weights)
    settled = cost = math.nan
    if plant is not None or system.name in available_plants():
        found = settle(network, system, options.dt, Q, R, plant=plant)
        settled, cost = found.settled / found.states, found.cost
    bend, errors = curvature(network, system, options.eta), (math.nan,) * 3
    if identified is not None:
        errors = errors_of(identified, system, options.dt, Q, R)
    return Monitored(*at, bend, settled, cost, *errors)
