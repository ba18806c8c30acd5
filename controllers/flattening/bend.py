"""The bend of a network on a box: the departure as its hidden units add it up, signs and all."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from certify.loop.policies import PolicyNetwork

Array = NDArray[np.float64]


def bend(network: PolicyNetwork, box: Sequence[float] | Array, states: int = 1000) -> float:
    """Root mean square of net(x) - net(0) - J x, J its Jacobian at 0, over that of J x, for states uniform in a box.

    `departure` adds up magnitudes of single units, this the units themselves; the same states in every call.

    Parameters
    ----------
    box : half-widths (n,), in the states' units.
    """
    half_widths = np.asarray(box, dtype=np.float64)
    x = np.random.default_rng(0).uniform(-half_widths, half_widths, (states, network.n))
    affine = PolicyNetwork(network.network, np.ones(network.m), np.zeros(network.m), "identity", "none")
    J = affine.jacobian_at_origin(())
    linear = x @ J.T
    rest = affine.net(x) - affine.net(np.zeros(network.n)) - linear
    size = float(np.sqrt((linear**2).mean()))
    return float(np.sqrt((rest**2).mean())) / size if size > 0 else math.inf
