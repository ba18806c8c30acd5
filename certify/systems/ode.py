"""The one Runge-Kutta step that simulates plants: for training, for falsification and for pictures, never for a proof.

Two copies of it would agree until one of them was changed; a policy is trained bit by bit on this one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

T = TypeVar("T")


def rk4_step(field: Callable[[T], T], x: T, step: Any) -> T:
    """One step of the classical Runge-Kutta method of order four for `xdot = field(x)`.

    Parameters
    ----------
    field : states (..., n) to their derivatives (..., n), numpy arrays or torch tensors.
    x : states, of any leading shape. The first stage is `field(x)` with this very object, so that a caller who knows
        the field there need not compute it again.
    step : seconds; a number, or an array or tensor that broadcasts against x, such as one step a state (..., 1).

    Notes
    -----
    Nothing here mixes states: what becomes of one depends on the others of its batch only if `field` does. With torch
    the step can be differentiated in x, in `step` and in whatever `field` holds.

    >>> rk4_step(lambda x: -x, 1.0, 0.1)  # exp(-0.1) = 0.90483742, and 0.1^5 / 120 = 8e-8
    0.9048375
    """
    f: Callable[[Any], Any] = field
    y: Any = x
    k1 = f(y)
    k2 = f(y + (step / 2) * k1)
    k3 = f(y + (step / 2) * k2)
    k4 = f(y + step * k3)
    after: T = y + (step / 6) * (k1 + 2 * k2 + 2 * k3 + k4)
    return after
