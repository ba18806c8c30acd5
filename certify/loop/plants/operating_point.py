"""The operating point of a plant, and f(0, u_eq) of each state there, which is 0 at an equilibrium."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from certify.errors import InputError
from certify.loop.expressions import Symbol, constant_of, differentiate, evaluate_exactly, numerical, symbols_of
from certify.loop.plants.system import System

Array = NDArray[np.float64]
_ROUNDED, _ULPS = 1e-12, 2.0**-50  # of a residual; of each number that is written down
_STEPS = 20


def residuals(system: System) -> dict[str, Fraction | float]:
    """Each state's f(0, u_eq): exact, or rounded if a function is evaluated at another point than 0."""
    at_rest: dict[Symbol, Fraction] = dict.fromkeys(system.states, Fraction(0))
    at_rest |= dict(zip(system.inputs, system.exact_u_eq(), strict=True))
    found: dict[str, Fraction | float] = {}
    for symbol, expression in zip(system.states, system.exact_dynamics(), strict=True):
        try:
            found[symbol.name] = evaluate_exactly(expression, at_rest)
        except InputError:
            with np.errstate(all="ignore"):
                rounded = numerical([expression], list(at_rest))(*(np.float64(q) for q in at_rest.values()))
            found[symbol.name] = float(rounded[0]) if np.isfinite(rounded[0]) else math.nan
    return found


def rests_where(system: System) -> str:
    """The value of f(x_eq, u_eq) at an equilibrium, as text."""
    return "0" if system.time == "continuous" else "x_eq"


def clocks(system: System) -> dict[str, Fraction | float]:
    """States that move at one pace whatever states and inputs are, and that pace: such a plant has no equilibrium."""
    moves = {name: r for name, r in residuals(system).items() if r != 0}
    each = {s: e for s, e in zip(system.states, system.exact_dynamics(), strict=True) if s.name in moves}
    if system.time == "continuous":
        return {s.name: moves[s.name] for s, e in each.items() if not symbols_of(e)}
    own = {s: e for s, e in each.items() if symbols_of(e) == {s}}
    return {s.name: moves[s.name] for s, e in own.items() if constant_of(differentiate(e, s)) == 1}


def moves_off(system: System, but: Collection[str] = ()) -> dict[str, Fraction | float]:
    """The residuals by which an operating point is no equilibrium: of more than rounding x_eq and u_eq explains.

    Numbers of a file are often the digits of an irrational point. A residual of 1e-12 is 0, and so is what some
    roundings of x_eq and u_eq change f by, which is more where rates are large. States named in `but` may move.
    """
    moves = {name: r for name, r in residuals(system).items() if name not in but}
    if all(abs(float(r)) <= _ROUNDED for r in moves.values()):
        return {}
    try:
        _, slopes = _in_floats(system)
        with np.errstate(all="ignore"):
            explained = _by_rounding(slopes(_origin(system)), _values(system, _origin(system)))
    except InputError:
        explained = np.full(system.n, _ROUNDED)
    least: dict[str, float] = {s.name: float(e) for s, e in zip(system.states, explained, strict=True)}
    return {name: r for name, r in moves.items() if not abs(float(r)) <= least[name]}


def require_equilibrium(
    system: System,
    refuse: Callable[[str], InputError] = InputError,
    *,
    but: Collection[str] = (),
) -> None:
    """Reject a plant whose operating point is no equilibrium, within rounding; `refuse` makes the error of a message.

    States named in `but` may move.

    Raises
    ------
    InputError : f(x_eq, u_eq) is not 0; the message has the residual of each state by its name.
    """
    off = moves_off(system, but)
    if off:
        shown = ", ".join(_residual(system, name, r) for name, r in off.items())
        raise refuse(
            f"x_eq of {system.name} must be an equilibrium, f(x_eq, u_eq) = {rests_where(system)}; found {shown}. "
            f"Correct x_eq or u_eq{_at_rest_nearby(system, off)}."
        )


def _at_rest_nearby(system: System, off: dict[str, Fraction | float]) -> str:
    """Name the equilibrium that Newton's method finds, each step the least one measured by domain and bounds; empty if
    it finds none."""
    if not all(math.isfinite(r) for r in off.values()):
        return ""
    widths = np.array([float(hi - lo) for lo, hi in (*system.domain, *system.input_bounds)])
    start = z = _origin(system)
    try:
        rates, slopes = _in_floats(system)
        with np.errstate(all="ignore"):
            for _ in range(_STEPS):
                z = z - widths * np.linalg.lstsq(slopes(z) * widths, rates(z))[0]
            if not np.all(np.abs(rates(z)) <= _by_rounding(slopes(z), _values(system, z))):
                return ""
    except (InputError, np.linalg.LinAlgError):
        return ""
    each = zip((*system.states, *system.inputs), _values(system, z), _values(system, start), strict=True)
    return f": it rests at {', '.join(f'{s.name} = {v:.17g}' for s, v, old in each if v != old)}"


def _in_floats(system: System) -> tuple[Callable[[Array], Array], Callable[[Array], Array]]:
    """The rates, in discrete time what a step adds, (n,), and their slopes (n, n + m), at states and inputs (n + m,).

    Raises
    ------
    InputError : an equation divides by 0, or the like.
    """
    variables, n = [*system.states, *system.inputs], system.n
    rates = [
        e - s if system.time == "discrete" else e for e, s in zip(system.exact_dynamics(), system.states, strict=True)
    ]
    f, slopes = (
        numerical(rates, variables),
        numerical([differentiate(e, s) for e in rates for s in variables], variables),
    )
    return (
        lambda z: np.array(f(*z), dtype=np.float64),
        lambda z: np.reshape(np.broadcast_arrays(*slopes(*z)), (n, -1)).astype(np.float64),
    )


def _origin(system: System) -> Array:
    """The operating point in deviations of the states, with the inputs, (n + m,)."""
    return np.array([*[0.0] * system.n, *map(float, system.exact_u_eq())])


def _values(system: System, z: Array) -> Array:
    """The values of the states, and the inputs, of a point in deviations, (n + m,)."""
    return np.asarray(z + np.array([*map(float, system.exact_x_eq()), *[0.0] * system.m]))


def _by_rounding(slopes: Array, values: Array) -> Array:
    """The residual of each rate that rounding these values explains, (n,)."""
    found = np.maximum(_ROUNDED, _ULPS * np.abs(slopes) @ np.abs(values))
    return np.asarray(np.where(np.isfinite(found), found, _ROUNDED))


def _residual(system: System, name: str, residual: Fraction | float) -> str:
    exactly = f" (exactly {residual})" if isinstance(residual, Fraction) and len(str(residual)) <= 40 else ""
    unit = system.units.get(name, "")
    if system.time == "discrete":
        return f"{name} moves by {float(residual):.6g}{exactly}{unit and f' {unit}'} in a step"
    return f"{name}' = {float(residual):.6g}{exactly}" + (f" in {unit} per second" if unit else "")
