"""Lipschitz constants on a ball of what products and functions of models leave out.

A model's `lip` is that of what it has beyond v(0) + a.d + d'Qd + K[d].
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from flint import arb

if TYPE_CHECKING:
    from .model import Model


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

    A product has the size of each times the other's constant. `wrong` is twice what Q and three times what K is off by.
    """
    if v.lip is None or w.lip is None:
        return None
    result = v.size * w.lip + w.size * v.lip
    result += v.slope * beyond_square(w, w.lip).both + w.slope * beyond_square(v, v.lip).both
    of_v, of_w = beyond_linear(v, v.lip), beyond_linear(w, w.lip)
    return result + of_v.size * of_w.steep + of_w.size * of_v.steep + wrong


def on_the_ball(v: Model) -> arb:
    """A bound over ||d|| of what v adds to v(0); a Lipschitz constant of v, where it has a lip."""
    return v.radius if v.lip is None else v.slope + beyond_linear(v, v.lip).steep


def beyond_linear(v: Model, lip: arb) -> Beyond:
    """Bounds of the terms beyond v(0) + a.d; the Lipschitz constants of d'Qd and K[d] are 2 bend and 3 twist."""
    return Beyond(v.bend + v.twist + lip, 2 * v.bend + 3 * v.twist + lip)


def beyond_square(v: Model, lip: arb) -> Beyond:
    """Bounds of the terms beyond v(0) + a.d + d'Qd."""
    return Beyond(v.twist + lip, 3 * v.twist + lip)
