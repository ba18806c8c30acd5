"""The gain of the discrete Riccati equation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from certify.errors import InputError

Array = NDArray[np.float64]


def riccati_gain(A: Array, B: Array, Q: Array, R: Array) -> Array:
    """K (m, n) of `u = -K x` that minimises the sum of `x'Q x + u'R u` along `x+ = A x + B u`.

    Raises
    ------
    InputError : the Riccati equation has no stabilising solution.
    """
    import control

    try:
        K, _, eigenvalues = control.dlqr(A, B, Q, R)
    except (np.linalg.LinAlgError, control.ControlArgument, ValueError) as error:
        raise InputError(f"the discrete Riccati equation has no stabilising solution: {error}.") from error
    if not np.all(np.abs(eigenvalues) < 1):
        raise InputError(f"the LQR loop must be stable; its eigenvalues are {eigenvalues}.")
    return np.ascontiguousarray(K, dtype=np.float64)
