"""A policy beside the saturated linear feedback of its own gain: how much of it a gain cannot do, at given states.

The linear feedback is the policy with `net(0) + J x` instead of net(x), J the Jacobian of net at 0: the same
gain at the origin, the same squash, centring, scale, offset and clip. So saturation counts for neither of the two.
Floats and sampled states: nothing here is part of a proof.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.loop.networks import has_kink_at, mean_tangent, tangent_at
from certify.loop.policies.network import PolicyNetwork

Array = NDArray[np.float64]
_END = 0.01  # of the width of an input's range: nearer to an end it counts as saturated
_ROUNDING = 1e-12  # of a value, or of 1


@dataclass(frozen=True, slots=True)
class Nonlinearity:
    """Distance of a policy from the saturated linear feedback of its own gain, at sampled states.

    Parameters
    ----------
    rms, largest : root mean square and maximum of the difference between the two, each relative to that of the linear
        feedback's own deviation from its value at 0; inputs count in units of their scale, roundings as 0.
    bend : root mean square of net(x) - net(0) - J x relative to that of J x, before the squash.
    saturated : share of the states at which some input of the policy is within 1 % of an end of its range.
    states : their number.
    fitted : the linear part is a fit to these states, since 0 is no equilibrium of the loop.
    """

    rms: float
    largest: float
    bend: float
    saturated: float
    states: int
    fitted: bool = False

    def to_dict(self) -> dict[str, Any]:
        """For JSON; a ratio to a linear part that is 0 is null."""
        return {name: v if math.isfinite(v) else None for name, v in asdict(self).items()}


def nonlinearity(network: PolicyNetwork, u_eq: Sequence[Fraction], states: Array, fitted: bool = False) -> Nonlinearity:
    """Compare a policy with the saturated linear feedback of its own gain at states (N, n).

    Parameters
    ----------
    fitted : take the affine function that is nearest to net at these states, by least squares, for net(0) + J x.
    """
    policy = network.folded(u_eq)
    y, line = policy.net(states), _line(policy, states, fitted)
    u, v, v0 = (policy.clipped(policy.scale * policy.squashed(each) + policy.offset) for each in (y, *line))
    difference, linear = (_beyond_rounding(each / policy.scale, u / policy.scale) for each in (u - v, v - v0))
    bend, straight = (_beyond_rounding(each, y) for each in (y - line[0], line[0] - line[1]))
    return Nonlinearity(
        _ratio(_rms(difference), _rms(linear)),
        _ratio(float(difference.max()), float(linear.max())),
        _ratio(_rms(bend), _rms(straight)),
        float(_saturated(policy, u).mean()),
        len(states),
        fitted,
    )


def _beyond_rounding(difference: Array, of: Array) -> Array:
    """The size of a difference of values like these; 0 where it is a rounding, as all are on a set of one point."""
    size = np.abs(difference)
    return np.where(size < _ROUNDING * np.maximum(1.0, np.abs(of)), 0.0, size)


def _line(policy: PolicyNetwork, states: Array, fitted: bool) -> tuple[Array, Array]:
    """The linear part of net at states (N, n) and at 0: (N, m) and (m,)."""
    if not fitted:
        at_0 = np.zeros(policy.n)
        at = (mean_tangent if has_kink_at(policy.network, at_0) else tangent_at)(policy.network, at_0)
        return at.y + states @ at.J.T, np.asarray(at.y)
    affine = np.column_stack([states, np.ones(len(states))])
    found = np.linalg.lstsq(affine, policy.net(states), rcond=None)[0]
    return affine @ found, (affine @ found).mean(axis=0)


def _saturated(policy: PolicyNetwork, u: Array) -> NDArray[np.bool_]:
    """True for inputs (N, m) of which one is near an end of its range, (N,)."""
    lo, hi = np.full(policy.m, -np.inf), np.full(policy.m, np.inf)
    if policy.squash == "tanh":
        lo, hi = policy.offset - np.abs(policy.scale), policy.offset + np.abs(policy.scale)
    if policy.clip is not None:
        lo, hi = np.maximum(lo, policy.clip[0]), np.minimum(hi, policy.clip[1])
    with np.errstate(over="ignore"):
        near = _END * (hi - lo)
    near = np.where(np.isfinite(near), near, 0.0)
    return np.asarray(((u <= lo + near) | (u >= hi - near)).any(axis=1))


def _rms(values: Array) -> float:
    return float(np.sqrt((values**2).mean()))


def _ratio(part: float, whole: float) -> float:
    if whole > 0:
        return part / whole
    return math.inf if part > 0 else 0.0
