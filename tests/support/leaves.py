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


def beyond_on_boxes(beyond: Beyond, lo: Array, hi: Array) -> tuple[Taylor, Taylor, Array, Array, Array, Array]:
    """What rule `outer` has on boxes (n, B): models of N and N'F, N's least value by other means, and mid, slopes
    and error of the inputs' enclosures."""
    centre, radius = middle(lo, hi)
    x, error = beyond.states(centre, radius)
    models = beyond.function.models([affine(own[0], own[1:], e) for own, e in zip(x, error, strict=True)])
    mid, slopes, wide = enclose_on_boxes(beyond.net, x, error)
    states, held = beyond.affine(x, error, mid, slopes, wide)
    F = beyond.f(states, [*held, *beyond.quantities(lo.shape[1])])
    N, rise = beyond.function.value(models), beyond.function.along(models, F)
    return N, rise, beyond.function.least(x, error) + np.zeros_like(N.c), mid, slopes, wide
