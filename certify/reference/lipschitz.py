"""Lipschitz constants on a ball of what products and functions of models leave out.

A model's `lip` is that of what it has beyond v(0) + a.d + d'Qd + K[d].
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from flint import arb

if TYPE_CHECKING:
    from .model import Expansion, Model


@dataclass(frozen=True)
class Beyond:
    """The largest size on the ball of a part of a number, and a Lipschitz constant of it: how `steep` it is."""

    size: arb
    steep: arb

    @property
    def both(self) -> arb:
        return self.size + self.steep


def of_product(v: Model, w: Model, wrong: arb) -> arb | None:
    """The Lipschitz constant of v w beyond K: v(0) times w's, (a.d) times w beyond Q, and the product beyond a.d.

    A product has the size of each times the other's constant. `wrong` bounds what Q and K are wrong by.
    """
    if v.lip is None or w.lip is None:
        return None
    result = v.size * w.lip + w.size * v.lip
    result += v.slope * _beyond_square(w, w.lip).both + w.slope * _beyond_square(v, v.lip).both
    of_v, of_w = _beyond_linear(v, v.lip), _beyond_linear(w, w.lip)
    return result + of_v.size * of_w.steep + of_w.size * of_v.steep + 3 * wrong


def of_function(v: Model, phi: Expansion, wrong: arb) -> arb | None:
    """The Lipschitz constant of phi(v) beyond its K; `wrong` as above, of phi' Q and phi' K."""
    beyond = beyond_tangent(v, phi)
    return None if v.lip is None or beyond is None else phi.steepest * v.lip + beyond + 3 * wrong


def beyond_tangent(v: Model, phi: Expansion) -> arb | None:
    """The Lipschitz constant of phi''/2 (D^2 - y^2 - 2 y d'Qd) + phi'''/6 (D^3 - y^3) and the rest of the series.

    D = y + z, y = a.d. The derivative of the rest by D is at most `last` |D|^3.
    """
    if v.lip is None:
        return None
    beyond, left = _beyond_linear(v, v.lip), _beyond_square(v, v.lip)
    y, z, steep = v.slope, beyond.size, beyond.steep
    second = 2 * phi.bent * (y * left.both + z * steep)
    third = 3 * phi.twisted * (y * y * (steep + 2 * z) + y * z * (2 * steep + z) + z * z * steep)
    return second + third + phi.last * v.radius**3 * (y + steep) + 3 * v.mistaken(phi)


def _beyond_linear(v: Model, lip: arb) -> Beyond:
    """Bounds of the terms beyond v(0) + a.d; the Lipschitz constants of d'Qd and K[d] are 2 bend and 3 twist."""
    return Beyond(v.bend + v.twist + lip, 2 * v.bend + 3 * v.twist + lip)


def _beyond_square(v: Model, lip: arb) -> Beyond:
    """Bounds of the terms beyond v(0) + a.d + d'Qd."""
    return Beyond(v.twist + lip, 3 * v.twist + lip)
