"""What has to be proved, as frozen data: the same description for every engine.

For the closed loop F, `V = x'Px` and `Vdot = 2 x'P F`:

- local: Vdot < 0 on 0 < V <= inner, for every smaller level too;
- ring: Vdot < 0 on inner <= V <= outer, and the input stays in its bounds;
- domain: {V <= outer} lies in the interior of the domain box.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from certify.closed_loop import ClosedLoop
from certify.errors import InputError

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Obligations:
    """The claims about one closed loop and one quadratic Lyapunov function.

    Parameters
    ----------
    loop : the closed loop.
    P : (n, n), symmetric.
    T : (n, n), invertible; `x = T z` are the coordinates in which boxes are drawn. No claim depends on it.
    """

    loop: ClosedLoop
    P: Array
    T: Array

    def __post_init__(self) -> None:
        n = self.loop.system.n
        for name in ("P", "T"):
            array = np.array(getattr(self, name), dtype=np.float64)
            if array.shape != (n, n) or not np.all(np.isfinite(array)):
                raise InputError(f"`{name}` must be a finite matrix of shape ({n}, {n}); found shape {array.shape}.")
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        if not np.array_equal(self.P, self.P.T):
            i, j = np.argwhere(self.P != self.P.T)[0]
            raise InputError(f"`P` must be symmetric; P[{i}, {j}] = {self.P[i, j]} but P[{j}, {i}] = {self.P[j, i]}.")

    @property
    def inputs_bounded_by_form(self) -> bool:
        """True if the squashing alone keeps the input in its bounds."""
        network, bounds = self.loop.network, self.loop.system.input_bounds
        if network.squash != "tanh" or network.centre == "output":
            return False
        return all(
            lo <= float(o) - abs(float(s)) and float(o) + abs(float(s)) <= hi
            for o, s, (lo, hi) in zip(network.offset, network.scale, bounds, strict=True)
        )
