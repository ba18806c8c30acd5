"""What rule `ring` computes on boxes, step by step, for tests that ask whether it is so."""

from __future__ import annotations

from certify.checker.float64 import Array
from certify.checker.network import enclose_on_boxes
from certify.checker.ring import Ring
from certify.checker.taylor import Taylor


def on_boxes(ring: Ring, centre: Array, radius: Array) -> tuple[list[Taylor], list[Taylor], Array]:
    """Models of the states and of G on boxes (n, B) in the coordinates z, and the ends of the states in a period."""
    x, error = ring.states(centre, radius)
    mid, slopes, wide = enclose_on_boxes(ring.net, x, error)
    states, held = ring.affine(x, error, mid, slopes, wide)
    G, ends = ring.increment(states, held)
    return states, G, ends
