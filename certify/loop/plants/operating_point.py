"""The operating point of a plant, and f(0, u_eq) of each state there, which is 0 at an equilibrium."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from fractions import Fraction

import numpy as np

from certify.errors import InputError
from certify.loop.expressions import Symbol, constant_of, differentiate, evaluate_exactly, numerical, symbols_of
from certify.loop.plants.system import System

_ROUNDED = 1e-12  # of a residual with functions at other points than 0, which rationals do not decide
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


def require_equilibrium(
    system: System,
    refuse: Callable[[str], InputError] = InputError,
    *,
    rounded: bool = False,
    but: Collection[str] = (),
) -> None:
    """Reject a plant whose operating point is no equilibrium; `refuse` makes the error of a message.

    With `rounded` an exact residual of 1e-12 is 0 as well, as where u_eq is a rounded number. States named in `but` may
    move.

    Raises
    ------
    InputError : f(x_eq, u_eq) is not 0; the message has the residual of each state by its name.
    """
    moves = {name: r for name, r in residuals(system).items() if name not in but}
    off = {name: r for name, r in moves.items() if _is_off(float(r) if rounded else r)}
    if off:
        shown = ", ".join(_residual(system, name, r) for name, r in off.items())
        raise refuse(
            f"x_eq of {system.name} must be an equilibrium, f(x_eq, u_eq) = {rests_where(system)}; found {shown}. "
            f"Correct x_eq or u_eq{_at_rest_nearby(system, off)}."
        )


def _at_rest_nearby(system: System, off: dict[str, Fraction | float]) -> str:
    """Name the equilibrium that Newton's method finds, each step the least one measured by domain and bounds; empty if
    it finds none, or the residual is rational, of which no rounded number makes 0."""
    if not all(isinstance(r, float) and math.isfinite(r) for r in off.values()):
        return ""
    variables, n = [*system.states, *system.inputs], system.n
    rates = [
        e - s if system.time == "discrete" else e for e, s in zip(system.exact_dynamics(), system.states, strict=True)
    ]
    widths = np.array([float(hi - lo) for lo, hi in (*system.domain, *system.input_bounds)])
    start = np.array([0.0] * n + [float(u) for u in system.exact_u_eq()])
    z = start
    try:
        f = numerical(rates, variables)
        slopes = numerical([differentiate(e, s) for e in rates for s in variables], variables)
        with np.errstate(all="ignore"):
            for _ in range(_STEPS):
                J = np.reshape(np.broadcast_arrays(*slopes(*z)), (n, -1))
                z = z - widths * np.linalg.lstsq(J * widths, np.array(f(*z), dtype=np.float64))[0]
            if not np.max(np.abs(f(*z))) <= _ROUNDED:
                return ""
    except (InputError, np.linalg.LinAlgError):
        return ""
    at = np.array([*map(float, system.exact_x_eq()), *[0.0] * system.m])
    moved = [f"{s.name} = {v:.17g}" for s, v, old in zip(variables, z + at, start + at, strict=True) if v != old]
    return f": it rests at {', '.join(moved)}"


def _is_off(residual: Fraction | float) -> bool:
    return residual != 0 if isinstance(residual, Fraction) else not abs(residual) <= _ROUNDED


def _residual(system: System, name: str, residual: Fraction | float) -> str:
    exactly = f" (exactly {residual})" if isinstance(residual, Fraction) and len(str(residual)) <= 40 else ""
    unit = system.units.get(name, "")
    if system.time == "discrete":
        return f"{name} moves by {float(residual):.6g}{exactly}{unit and f' {unit}'} in a step"
    return f"{name}' = {float(residual):.6g}{exactly}" + (f" in {unit} per second" if unit else "")
