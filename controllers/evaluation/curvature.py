"""The curvature of a policy near the origin, which a proof has to absorb."""

from __future__ import annotations

import numpy as np
import torch

from certify.errors import InputError
from certify.loop.plants import System
from certify.loop.policies import PolicyNetwork


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
