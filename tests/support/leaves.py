"""What rules `ring` and `outer` compute on boxes, step by step, for tests that ask whether it is so."""

from __future__ import annotations

import numpy as np

from certify.checker.boxes import middle
from certify.checker.float64 import Array
from certify.checker.network import enclose_on_boxes
from certify.checker.outer import Beyond
from certify.checker.ring import Ring
from certify.checker.taylor import Taylor, affine


def on_boxes(ring: Ring, centre: Array, radius: Array) -> tuple[list[Taylor], list[Taylor], Array]:
    """Models of the states and of G on boxes (n, B) in the coordinates z, and the ends of the states in a period."""
    x, error = ring.states(centre, radius)
    mid, slopes, wide = enclose_on_boxes(ring.net, x, error)
    states, held = ring.affine(x, error, mid, slopes, wide)
    G, ends = ring.increment(states, held)
    return states, G, ends


def beyond_on_boxes(beyond: Beyond, lo: Array, hi: Array) -> tuple[Taylor, Taylor, Array, Array, Array]:
    """What rule `outer` has on boxes (n, B): models of N and N'F, and the inputs' enclosures: mid, slopes, error."""
    centre, radius = middle(lo, hi)
    x, error = beyond.states(centre, radius)
    models = beyond.function.models(
        [affine(x[i, 0], np.moveaxis(x, 1, 0)[1:, i], error[i]) for i in range(beyond.n)]
    )  # fmt: skip
    mid, slopes, wide = enclose_on_boxes(beyond.net, x, error)
    states, held = beyond.affine(x, error, mid, slopes, wide)
    F = beyond.f(states, [*held, *beyond.quantities(lo.shape[1])])
    return beyond.function.value(models), beyond.function.along(models, F), mid, slopes, wide
