"""The nearest corner of a policy's units: relu has one in its values, elu and softsign have one in their slope.

A unit's argument passes 0 there. The local part of a proof ends near the nearest corner; one of relu at the origin
itself leaves the policy without a Jacobian there.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from certify.loop.networks import Map, Tangent, Tangents
from certify.loop.plants import System
from certify.loop.policies import PolicyNetwork

Array = NDArray[np.float64]


def nearest_corner(network: PolicyNetwork, system: System) -> float:
    """The largest share of the plant's domain in which no unit of `network` passes its corner.

    Infinite for smooth units, 0 if a unit's corner lies at the origin. To first order in the states; exact up to
    rounding for layers of relu that read the states, whose units are affine in that share.
    """
    half_widths = np.array([min(-float(lo), float(hi)) for lo, hi in system.domain])
    corners = _Corners(half_widths)
    corners.run(network.network, Tangent(network.origin, np.eye(network.n)))
    return corners.nearest


class _Corners(Tangents):
    """Tangents that remember how near to its corner the nearest unit is, as a share of a box."""

    def __init__(self, half_widths: Array) -> None:
        self.half_widths, self.nearest = half_widths, math.inf

    def map(self, step: Map, v: Tangent) -> Tangent:
        if not step.phi.is_smooth:
            reach = np.abs(v.J) @ self.half_widths
            moves = reach > 0  # a unit that the states do not move stays on its side
            shares = np.abs(v.y[moves]) / reach[moves]
            self.nearest = min(self.nearest, *shares.tolist()) if len(shares) else self.nearest
        return super().map(step, v)
