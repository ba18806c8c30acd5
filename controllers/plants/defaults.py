"""Defaults of training for a plant of one's own, from its domain and its input bounds.

A plant that ships has a file with its preset. One in a TOML file may choose in a table `[training]` there; the rest is
computed here, and the command line overrides both. Computed weights have no units: each is relative to the largest
value of a state or an input (Bryson's rule), so that millimetres and metres train alike.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from certify.errors import InputError
from controllers.identification.riccati import riccati_gain
from controllers.options import Plant, TrainingOptions, held_over

if TYPE_CHECKING:
    from certify.loop.plants import System


Array = NDArray[np.float64]
STEPS = 20_000
RESOLUTION = 0.2  # the time step in units of 1 / (fastest rate of the LQR loop)


def default_plant(system: System, dt: float | None = None) -> Plant:
    """The training of a plant of which nothing is known but its equations, domain and input bounds.

    With w the half-width of a state's domain and U that of an input's bounds around u_eq, weights are 1/w^2 and 1/U^2.
    The time step is `dt`, or that of `time_step`, which reads the equations.

    Raises
    ------
    InputError : u_eq is not inside the input bounds, or the linearisation cannot be stabilised.
    """
    w = np.array([float(min(-lo, hi)) for lo, hi in system.domain])
    u_eq = system.exact_u_eq()
    U = np.array([float(min(u - lo, hi - u)) for u, (lo, hi) in zip(u_eq, system.input_bounds, strict=True)])
    if not np.all(U > 0):
        names = ", ".join(s.name for s, half in zip(system.inputs, U, strict=True) if not half > 0)
        raise InputError(f"u_eq of {system.name} must lie inside the input bounds; it does not for {names}.")
    size = 100 * max(system.n, system.m)
    options = TrainingOptions(
        steps=STEPS,
        dt=time_step(system, w, U) if dt is None else dt,
        horizon=250,
        start=0.5,
        reward_offset=1.0,
        reward_weights=_rounded(1 / w**2),
        penalty=100.0,
        actor=(32, 32),
        critic=(64, 64),
        rest_weight=1.0,
        eta=float(_rounded(0.03 * w.min(keepdims=True))[0]),
        n_A=size,
        n_B=size,
        refresh=10_000,
        gain_weight=float(_rounded(6 * w.min(keepdims=True) / U.max())[0]),
        state_weights=_rounded(1 / w**2),
        input_weights=_rounded(1 / U**2),
    )
    box = tuple(float(v) for v in options.start * w)
    return Plant(preset=options, initial_states=box, positions=tuple(s.name for s in system.states[:3]))


def time_step(system: System, w: Array, U: Array) -> float:
    """Time for which an input is held: 1 in discrete time, where it is a step; else seconds.

    It is `RESOLUTION` over the fastest rate of the LQR loop with the weights 1/w^2 and 1/U^2, rounded down to 1, 2 or 5
    times ten^k; and where the plant says over which times its inputs are held, the nearest of these.

    Raises
    ------
    InputError : the linearisation at the operating point cannot be stabilised.
    """
    import scipy.linalg

    A, B = linearisation(system)
    Q, R = np.diag(1 / w**2), np.diag(1 / U**2)
    try:
        if system.time == "discrete":
            riccati_gain(A, B, Q, R)
            return 1.0
        P = scipy.linalg.solve_continuous_are(A, B, Q, R)
    except (np.linalg.LinAlgError, ValueError, InputError) as error:
        raise InputError(
            f"the linearisation of {system.name} must be stabilisable, or no policy near the operating point can hold "
            f"it: {str(error).rstrip('.')}. `certify plant` shows A, B and what cannot be controlled."
        ) from error
    rates = np.abs(np.linalg.eigvals(A - B @ (U[:, None] ** 2 * B.T) @ P))
    step = RESOLUTION / float(rates.max())
    scale = 10.0 ** math.floor(math.log10(step))
    step = float(f"{max(k for k in (1, 2, 5) if k * scale <= step * (1 + 1e-9)) * scale:.1e}")
    return held_over(system, step)


def linearisation(system: System) -> tuple[Array, Array]:
    """A (n, n) and B (n, m) of the plant's equations at its operating point, in floats."""
    from certify.loop.plants import in_floats, linearise

    A, B = linearise(system)
    return in_floats(A), in_floats(B)


def _rounded(values: Array) -> tuple[float, ...]:
    """Two digits: what is written into a policy's record should be readable."""
    return tuple(float(f"{v:.2g}") for v in values)
