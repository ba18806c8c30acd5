"""A plant step by step, batched.

The plant that is trained on is the plant that is proved: nothing here restates an equation, and nothing else in
`controllers` reads one. An input is held over `dt` and the state moves by one classical Runge-Kutta step of order four,
in float64; a plant in discrete time moves by one application of its map. Angles are never wrapped.
"""

from __future__ import annotations

from typing import Any, Literal

from certify.errors import InputError
from certify.loop.plants import System
from certify.loop.plants.ode import rk4_step
from controllers.options import require_one_step

Module = Literal["numpy", "torch"]


class Stepper:
    """The plant step by step, `x+ = F(x, u)`, batched: its own map, or in continuous time RK4 with u held over `dt`.

    Parameters
    ----------
    system : the plant.
    dt : seconds for which u is held; 1 for a plant in discrete time.
    module : arithmetic of the arguments, numpy arrays or torch tensors.

    Raises
    ------
    InputError : `dt` is not positive, or not 1 for a plant in discrete time.

    Notes
    -----
    Called with x (..., n) and u (..., m) it returns x+ (..., n); with torch it can be differentiated.
    u is used as given: clipping is the environment's business.
    """

    def __init__(self, system: System, dt: float, module: Module = "torch") -> None:
        if not dt > 0:
            raise InputError(f"`dt` must be positive; found {dt}.")
        require_one_step(system, dt)
        self._f, self._dt = system.function(module), None if system.time == "discrete" else dt

    def __call__(self, x: Any, u: Any) -> Any:
        if self._dt is None:
            return self._f(x, u)
        return rk4_step(lambda state: self._f(state, u), x, self._dt)
