"""What rules `ring` and `outer` compute on boxes, step by step, for tests that ask whether it is so."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from certify.checker.boxes import middle
from certify.checker.near import Form
from certify.checker.network import enclose_on_boxes
from certify.checker.outer import Beyond, Function
from certify.checker.ring import Ring
from certify.checker.taylor import Taylor as Model
from certify.checker.taylor import constants, models, upper_bound
from tests.support.plain import Array, Taylor, shown


def on_boxes(ring: Ring, centre: Array, radius: Array) -> tuple[list[Model], list[Model], Array]:
    """Models of the states and of G on boxes (n, B) in the coordinates z, and the ends of the states in a period."""
    x = ring.states(centre, radius)
    states, held = ring.models(x, enclose_on_boxes(ring.net, x))
    motion = ring.motion(states, held)
    G, ends = motion.G, motion.ends
    return states, G, ends


def least(function: Function, x: Form) -> Array:
    """A lower bound of N on boxes by the forms of its networks, (B,); that it is none where nothing is known."""
    if not function.tape.calls:
        return np.full(x.value.shape[2], -np.inf)
    N = function._by_forms(models(Form(x.value), x.error))
    return np.where(np.isfinite(N.size.top), -upper_bound(-N), -np.inf)


def beyond_on_boxes(beyond: Beyond, lo: Array, hi: Array) -> tuple[Taylor, Taylor, Array, Array, Array, Array]:
    """What rule `outer` has on boxes (n, B): models of N and N'F, N's least value by other means, and mid, slopes
    and error of the inputs' enclosures."""
    centre, radius = middle(lo, hi)
    x = beyond.states(centre, radius)
    u = enclose_on_boxes(beyond.net, x)
    states, held = beyond.models(x, u)
    F = beyond.f(states, [*held, *beyond.quantities(lo.shape[1])])
    N = beyond.function.along(models(Form(x.value), x.error), F)
    rise = constants(F[0])(Fraction(0)) if N.rate is None else N.rate
    return Taylor.of(N.value), Taylor.of(rise), least(beyond.function, x), *shown(u)
