"""Plants of one's own: what a run takes where nobody has chosen for it, from the domain and the input bounds.

A plant that ships has a file with its preset. One in a TOML file may choose in a table `[training]` there; the rest is
computed here, and the command line overrides both. What is computed has sizes for units: every weight is relative to
how far a state or an input may go (Bryson's rule), so that millimetres and metres train alike.
"""

from __future__ import annotations

import math
from dataclasses import fields, replace
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from certify.errors import InputError
from controllers.lqr import riccati_gain
from controllers.options import Plant, TrainingOptions, available_plants, get_plant, held_over

if TYPE_CHECKING:
    from certify.loop.plants import System
    from certify.loop.plants.source import PlantFile

Array = NDArray[np.float64]

STEPS = 20_000
RESOLUTION = 0.2  # of the time step, in units of 1 / (fastest rate of the LQR loop)
_BOX = ("initial_states", "positions")


def chosen_plant(name: str) -> tuple[System, Plant]:
    """The plant that somebody typed: its name, `FILE.toml` or `FILE.py:NAME`, and how it is trained.

    Raises
    ------
    InputError : no such plant; its own file bears the name of one that ships; or its options cannot be used.
    """
    from certify.loop.plants import available_systems, chosen_system, get_system

    if name in available_plants():
        return get_system(name), get_plant(name)
    if name in available_systems():
        return get_system(name), get_plant(name)  # which says that there are no options for it
    if not (name.endswith(".toml") or name.rpartition(":")[0].endswith(".py")):
        get_plant(name)  # which knows none of this name
    system = chosen_system(name)
    if system.name in available_systems():
        raise InputError(
            f"the plant of {name} must not bear the name of one that ships, {system.name!r}: a policy is told by "
            "the name of its plant. Give it another `name`."
        )
    plant = default_plant(system)
    if name.endswith(".toml"):
        from certify.loop.plants.source import read_plant_file

        plant = _with_table(plant, read_plant_file(Path(name)))
    plant.check(system)
    return system, plant


def default_plant(system: System) -> Plant:
    """How a plant is trained of which nothing is known but its equations, domain and input bounds.

    With w the half-width of a state's domain and U that of an input's bounds around u_eq, weights are 1/w^2 and 1/U^2.
    The time step is that of `time_step`.

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
        dt=time_step(system, w, U),
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
    """Time for which an action is held: 1 in discrete time, where it is a step; else seconds.

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


def _with_table(plant: Plant, file: PlantFile) -> Plant:
    """The plant with what its file's table `[training]` chooses."""
    table, hints = file.table("training"), get_type_hints(TrainingOptions)
    known = [option.name for option in fields(TrainingOptions)]
    file.require_known("training", [*known, *_BOX], "option of a training")
    chosen: dict[str, Any] = {}
    for name, value in table.items():
        if name not in _BOX:
            chosen[name] = _value(value, hints[name], file, name)
    box: dict[str, Any] = {}
    if "start" in chosen:  # simulations start where episodes do
        share = chosen["start"] / plant.preset.start
        box["initial_states"] = tuple(share * width for width in plant.initial_states)
    if "initial_states" in table:
        box["initial_states"] = _value(table["initial_states"], tuple[float, ...], file, "initial_states")
    if "positions" in table:
        box["positions"] = _value(table["positions"], tuple[str, ...], file, "positions")
    try:
        return replace(plant, preset=replace(plant.preset, **chosen), **box)
    except InputError as error:
        raise file.refuse(str(error), "training") from error


def _value(value: Any, kind: Any, file: PlantFile, name: str) -> Any:
    """A value of the table as the option's kind: numbers of a TOML file are integers and exact fractions."""
    if get_origin(kind) is tuple:
        if not isinstance(value, list):
            raise file.refuse(f"must be a list, as in [1, 2]; found {value!r}.", "training", name)
        return tuple(_value(part, get_args(kind)[0], file, name) for part in value)
    allowed = {int: (int,), float: (int, Fraction)}.get(kind, (str,))
    if isinstance(value, bool) or not isinstance(value, allowed):
        wanted = {int: "an integer", float: "a number"}.get(kind, "text")
        raise file.refuse(f"must be {wanted}; found {value!r}.", "training", name)
    return float(value) if kind is float else value
