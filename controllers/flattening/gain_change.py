"""A change of the gain at the origin, for a policy whose gain is the trouble.

A policy that was trained elsewhere may ask for its largest input at a hundredth of its box, and chatter there as soon
as its input is held. No bound on its hidden units helps a proof then: between that hundredth and the box the loop
lives in the last tanh's bend, and its rates are hundreds of times apart. The gain has to change; layers, limits and
form need not.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from certify.errors import InputError
from certify.loop.policies import PolicyNetwork

Array = NDArray[np.float64]
_LEAST = 1e-6  # ratio of singular values: below it an input follows from the others, up to single precision


def regained(network: PolicyNetwork, u_eq: Sequence[Fraction], J: Array, box: Array) -> PolicyNetwork:
    """The policy `x -> pi(G x)`, whose Jacobian at the origin is J; only the first layer's weights are other ones.

    `G x` is the smallest state, relative to the box, at which the old Jacobian asks for what J asks for at x:
    `G = D (J_pi D)^+ J`, D the diagonal matrix of `box`. So the policy's own shape stays, along the m directions
    in which it acts; its action in the other n - m is gone. The input of the first hidden layer at 0 is its bias as it
    was, and with it pi(0) and the centring stay exactly.

    Parameters
    ----------
    J : (m, n), the Jacobian that is wanted, in inputs per state.
    box : half-widths (n,), in the states' units.

    Raises
    ------
    InputError : at the origin the old inputs do not act independently of each other, so no G can give J; or the clip
        may act there.
    """
    old = network.jacobian_at_origin(u_eq) * box
    singular = np.linalg.svd(old, compute_uv=False)
    if len(singular) < network.m or not singular[-1] > _LEAST * singular[0]:
        rank = int((singular > _LEAST * singular[0]).sum())
        raise InputError(
            f"for another gain the policy's {network.m} inputs must act independently at the origin; its Jacobian "
            f"there has rank {rank}. Keep its gain."
        )
    first = network.weights[0] @ (box[:, None] * (np.linalg.pinv(old) @ J))
    single = np.asarray(first.astype(np.float32), dtype=np.float64)
    return network.with_layers(weights=(single, *network.weights[1:]))
