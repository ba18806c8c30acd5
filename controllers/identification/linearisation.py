"""The linearisation of the simulator's step, and how far an identified plant is from it."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray

from certify.errors import InputError
from certify.loop.plants import System
from controllers.identification.gain_learner import Identified
from controllers.identification.riccati import riccati_gain
from controllers.simulation.stepping import Stepper

Array = NDArray[np.float64]


def discrete_linearisation(system: System, dt: float) -> tuple[Array, Array]:
    """A and B of the simulator's step at (0, u_eq), which least squares should have found; dt as `Stepper` takes it."""
    stepper = Stepper(system, dt, "torch")
    x = torch.zeros(system.n, dtype=torch.float64)
    u = torch.tensor([float(v) for v in system.exact_u_eq()], dtype=torch.float64)
    A, B = torch.autograd.functional.jacobian(stepper, (x, u))  # type: ignore[no-untyped-call]
    return A.numpy(), B.numpy()


def errors_of(learned: Identified, system: System, dt: float, Q: Array, R: Array) -> tuple[float, float, float]:
    """Relative errors of A, B and K in the Frobenius norm, against the simulator's own linearisation and its gain.

    NaN where what is true is 0, and for K where the true plant has no gain for these weights.

    Parameters
    ----------
    Q, R : diagonals of the weights that K was made for, shapes (n,) and (m,).
    """
    A, B = discrete_linearisation(system, dt)
    try:
        K = riccati_gain(A, B, np.diag(Q), np.diag(R))
    except InputError:
        K = np.full_like(learned.K, math.nan)
    return _relative(learned.A, A), _relative(learned.B, B), _relative(learned.K, K)


def _relative(found: Array, true: Array) -> float:
    size = float(np.linalg.norm(true))
    return float(np.linalg.norm(found - true)) / size if size > 0 else math.nan
