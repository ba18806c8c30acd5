"""What rules `ring` and `outer` compute on boxes, step by step, for tests that ask whether it is so."""

from __future__ import annotations

from certify.checker.boxes import middle
from certify.checker.network import enclose_on_boxes
from certify.checker.outer import Beyond
from certify.checker.ring import Ring
from certify.checker.taylor import Taylor as Model
from certify.checker.taylor import affine
from tests.support.plain import Array, Taylor, shown


def on_boxes(ring: Ring, centre: Array, radius: Array) -> tuple[list[Model], list[Model], Array]:
    """Models of the states and of G on boxes (n, B) in the coordinates z, and the ends of the states in a period."""
    x = ring.states(centre, radius)
    states, held = ring.models(x, enclose_on_boxes(ring.net, x))
    G, ends = ring.increment(states, held)
    return states, G, ends


def beyond_on_boxes(beyond: Beyond, lo: Array, hi: Array) -> tuple[Taylor, Taylor, Array, Array, Array, Array]:
    """What rule `outer` has on boxes (n, B): models of N and N'F, N's least value by other means, and mid, slopes
    and error of the inputs' enclosures."""
    centre, radius = middle(lo, hi)
    x = beyond.states(centre, radius)
    models = beyond.function.models([affine(x.value[0, i], x.value[1:, i], x.error[i]) for i in range(beyond.n)])
    u = enclose_on_boxes(beyond.net, x)
    states, held = beyond.models(x, u)
    F = beyond.f(states, [*held, *beyond.quantities(lo.shape[1])])
    N, rise = beyond.function.value(models), beyond.function.along(models, F)
    return Taylor.of(N), Taylor.of(rise), beyond.function.least(x) + 0 * N.c, *shown(u)
