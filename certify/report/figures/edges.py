"""The states of a plane at which a constraint of the claim is violated, on a grid."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.loop.closed_loop import ClosedLoop
from certify.loop.constraints import Constraints
from certify.report.figures.pairs import Pair
from certify.report.figures.scene import Scene
from certify.report.figures.style import EDGE, EDGE_FILL, Key

Array = NDArray[np.float64]


def violation(scene: Scene, pair: Pair) -> tuple[Array, Array, Array] | None:
    """Axes of a grid along two states, and the largest g of a constraint there, all other states 0, at the worst corner
    of the ranges; None where no point violates one."""
    certificate = scene.certificate
    if not certificate.claim.keep:
        return None
    constraints = Constraints(ClosedLoop(certificate.system, certificate.network))
    a, b, x = scene.plane(pair)
    flat = x.reshape(-1, scene.n)
    with np.errstate(all="ignore"):
        worst = constraints.at(flat, constraints.loop.policy(flat)).max(-1).reshape(x.shape[:-1])
    worst = np.nan_to_num(worst, posinf=np.finfo(np.float64).max)
    return (a, b, worst) if np.any(worst >= 0) else None


def draw_edges(axes: Any, scene: Scene, pair: Pair) -> None:
    """Draw where a constraint is violated, and the edge of that."""
    found = violation(scene, pair)
    if found is None:
        return
    axes.contourf(*found, levels=[0, np.inf], colors=[EDGE_FILL], zorder=0.7)
    if np.any(found[2] < 0):
        axes.contour(*found, levels=[0.0], colors=[EDGE], linewidths=1.4, zorder=3.2)


def keys_of_edges(scene: Scene) -> list[Key]:
    """The entry of the legend; none where no picture shows a violation."""
    shown = any(violation(scene, pair) is not None for pair in scene.pairs)
    return [Key("where a constraint is violated, on a grid*", EDGE, 1.4, fill=EDGE_FILL)] if shown else []
