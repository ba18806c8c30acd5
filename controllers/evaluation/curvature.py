"""The curvature of a policy near the origin, which a proof has to absorb, and its nonlinearity on a box."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

import numpy as np
import torch
from numpy.typing import NDArray

from certify.errors import InputError
from certify.loop.plants import System
from certify.loop.policies import PolicyNetwork
from certify.loop.policies.nonlinearity import Nonlinearity, nonlinearity


def curvature(network: PolicyNetwork, system: System, radius: float, points: int = 256) -> float:
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


def nonlinearity_on(
    network: PolicyNetwork,
    u_eq: Sequence[Fraction],
    box: Sequence[float] | NDArray[np.float64],
    states: int = 1000,
) -> Nonlinearity:
    """The policy beside the saturated linear feedback of its own gain, at states uniform in a box, always the same.

    `departure` adds up magnitudes of single hidden units, `bend` here the units themselves, signs and all.

    Parameters
    ----------
    box : half-widths (n,), in the states' units.
    """
    half_widths = np.asarray(box, dtype=np.float64)
    x = np.random.default_rng(0).uniform(-half_widths, half_widths, (states, network.n))
    return nonlinearity(network, u_eq, x)
