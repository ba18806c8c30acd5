"""The states of a plane at which a constraint of the claim is violated, on a grid."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.certificates import AnyCertificate
from certify.loop.closed_loop import ClosedLoop
from certify.loop.constraints import Constraints
from certify.report.figures.style import EDGE, EDGE_FILL, Key

Array = NDArray[np.float64]
_PART = 512  # states at a time, whose hidden units stay in a core's cache


def worst_of(certificate: AnyCertificate) -> Callable[[Array], Array] | None:
    """The largest g of a constraint at states (..., n), at the worst corner of the ranges; None without constraints."""
    if not certificate.claim.keep:
        return None
    constraints = Constraints(ClosedLoop(certificate.system, certificate.network))

    def worst(x: Array) -> Array:
        flat = x.reshape(-1, x.shape[-1])
        found = [constraints.worst(part) for part in np.array_split(flat, 1 + len(flat) // _PART)]
        return np.nan_to_num(np.concatenate(found).reshape(x.shape[:-1]), posinf=np.finfo(np.float64).max)

    return worst


def draw_edges(axes: Any, certificate: AnyCertificate, a: Array, b: Array, states: Array, order: float) -> bool:
    """Draw where a constraint is violated, with this `zorder`, at states (rows, columns, n) of a grid or, if there is
    one row, of a line; True if it is somewhere."""
    function = worst_of(certificate)
    if function is None:
        return False
    worst = function(states)
    broken = worst >= 0
    if len(worst) == 1:
        axes.fill_between(a, 0.0, 1.0, where=broken[0], color=EDGE_FILL, lw=0, zorder=order)
    elif np.any(broken):
        axes.contourf(a, b, worst, levels=[0, np.inf], colors=[EDGE_FILL], zorder=order)
        if not np.all(broken):
            axes.contour(a, b, worst, levels=[0.0], colors=[EDGE], linewidths=1.4, zorder=3.2)
    return bool(np.any(broken))


def key_of_edges(star: str = "") -> Key:
    """The entry of the legend."""
    return Key(f"where a constraint is violated, on a grid{star}", EDGE, 1.4, fill=EDGE_FILL)
