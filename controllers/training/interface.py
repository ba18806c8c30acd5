"""The knowledge that a learner has of the plant before it begins."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from certify.errors import InputError
from certify.loop.plants import System

Array = NDArray[np.float64]


class Interface:
    """The plant as a learner is told of it: its input bounds, u_eq and the ranges of its states.

    `u = scale * tanh(w) + offset`; `state_factors` bring the states to order one, `reach` is the domain's half-width.
    """

    def __init__(self, system: System) -> None:
        u_lo, u_hi = np.array(system.input_bounds, dtype=np.float64).T
        lo, hi = np.array(system.domain, dtype=np.float64).T
        u_eq = np.array([float(u) for u in system.exact_u_eq()])
        if not np.all((u_lo < u_eq) & (u_eq < u_hi)):
            raise InputError(f"u_eq of {system.name} must lie inside the input bounds; found {u_eq}.")
        self.scale, self.offset, self.u_eq = (u_hi - u_lo) / 2, (u_hi + u_lo) / 2, u_eq
        self.reach = np.minimum(-lo, hi)
        self.state_factors = 0.5 ** np.round(np.log2(np.maximum(-lo, hi)))

    def to_action(self, normalised: Array) -> Array:
        """Physical input of `tanh(w)`."""
        return np.asarray(self.scale * normalised + self.offset)

    def to_normalised(self, u: Array) -> Array:
        """`tanh(w)` of a physical input."""
        return np.asarray((u - self.offset) / self.scale)
