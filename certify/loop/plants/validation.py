"""The requirements on a plant's fields, beyond their types."""

from __future__ import annotations

import re
from fractions import Fraction
from typing import TYPE_CHECKING

from certify.errors import InputError
from certify.loop.expressions import Expression, Symbol, constant_of, jumping, nodes, symbols_of
from certify.loop.expressions.gathering import MOST_BITS

if TYPE_CHECKING:
    from certify.loop.plants.system import System

MOST_JUMPS = 6  # heavisides that a checker takes


def validate(system: System) -> None:
    """Reject a plant whose fields do not fit together.

    Raises
    ------
    InputError : as `System` says.
    """
    _check_counts(system)
    _check_names(system)
    _check_intervals(system)
    _check_parameters(system)
    _check_equations(system)
    _check_observations(system)
    _check_angles(system)
    _check_constraints(system)
    system.exact_x_eq()
    _check_ranges(system)
    _check_sample(system)


def require_origin_inside(system: System) -> None:
    """Reject a plant whose operating point does not lie in the interior of its domain: no V is 0 there.

    Raises
    ------
    InputError : it does not, in some state.
    """
    for symbol, (lo, hi) in zip(system.states, system.domain, strict=True):
        if not lo < 0 < hi:
            raise InputError(
                f"the domain of {symbol} must contain 0 in its interior, as a deviation from x_eq; "
                f"found [{float(lo)}, {float(hi)}]."
            )


def require_no_jumps(system: System) -> None:
    """Reject a plant whose equations jump: sets around an equilibrium are not proved of it.

    Raises
    ------
    InputError : they do.
    """
    for jump in jumping(*system.dynamics):
        raise InputError(
            f"the equations of {system.name} jump, at {jump}, and sets around an equilibrium are not proved of such "
            "plants; certify reach proves that regions are reached, certify roa --claim invariant that boxes are never "
            "left."
        )


def _check_counts(system: System) -> None:
    n, m = len(system.states), len(system.inputs)
    for label, found, wanted in (
        ("dynamics", len(system.dynamics), n),
        ("domain", len(system.domain), n),
        ("u_eq", len(system.u_eq), m),
        ("input_bounds", len(system.input_bounds), m),
        ("x_eq", len(system.x_eq), n),
    ):
        if found != wanted:
            raise InputError(f"`{label}` of {system.name} must have {wanted} entries; found {found}.")
    if n == 0 or m == 0:
        raise InputError(f"{system.name} must have at least one state and one input.")


def _check_observations(system: System) -> None:
    known = {*system.states, *map(Symbol, system.parameters)}
    for e in system.observations:
        odd = sorted(s.name for s in symbols_of(e) - known)
        if odd:
            raise InputError(f"observations of {system.name} must be of states and parameters; {e} has {odd[0]}.")


def _check_name(what: str, name: str) -> None:
    if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]{0,63}", name):
        raise InputError(f"{what} must be an identifier, at most 64 letters, digits and _; found {name!r}.")


def _check_names(system: System) -> None:
    names = [s.name for s in (*system.states, *system.inputs, *system.disturbances)] + list(system.parameters)
    _check_name("the plant's name", system.name)
    for name in names:
        _check_name(f"a name in {system.name}", name)
    if len(set(names)) != len(names):
        raise InputError(
            f"names of states, inputs, parameters and disturbances of {system.name} must differ; found {names}."
        )


def _check_intervals(system: System) -> None:
    for symbol, (lo, hi) in zip(system.states, system.domain, strict=True):
        if not lo < hi:
            raise InputError(
                f"the domain of {symbol} must satisfy lo < hi and so have an interior; "
                f"found [{float(lo):g}, {float(hi):g}]."
            )
    for symbol, (lo, hi) in zip(system.inputs, system.input_bounds, strict=True):
        if not lo < hi:
            raise InputError(f"the bounds of {symbol} must satisfy lo < hi; found [{float(lo)}, {float(hi)}].")


def _check_parameters(system: System) -> None:
    for name in sorted(system.positive):
        if name not in system.parameters:
            known = ", ".join(system.parameters) or "none"
            raise InputError(f"`positive` of {system.name} must name parameters, {known}; found {name!r}.")
        if not system.parameters[name] > 0:
            raise InputError(f"parameter {name} of {system.name} must be positive; found {system.parameters[name]}.")
    for name, q in system.parameters.items():
        if max(q.numerator.bit_length(), q.denominator.bit_length()) > MOST_BITS:
            raise InputError(f"parameter {name} of {system.name} must have at most {MOST_BITS} bits; it has more.")


def _check_equations(system: System) -> None:
    """Reject a symbol that the plant does not have."""
    parameters = {Symbol(p) for p in system.parameters}
    results, known = set[Symbol](), {*system.states, *system.inputs, *parameters}
    for call in system.calls:
        odd = symbols_of(*call.arguments) - known - results
        if odd:
            raise InputError(f"arguments of {call.name} must be of states, inputs and parameters; found {odd.pop()}.")
        results |= {symbol for _, symbol in call.results}
    everything = {*system.states, *system.inputs, *parameters, *system.disturbances, *results}
    for allowed, equations in ((everything, system.dynamics), (parameters, (*system.u_eq, *system.x_eq))):
        for node in nodes(*equations):
            if isinstance(node, Symbol) and node not in allowed:
                raise InputError(
                    f"an equation of {system.name} uses {node}, which is no state, input, parameter or disturbance."
                )
    _check_jumps(system)


def _check_jumps(system: System) -> None:
    """Reject a heaviside that stands elsewhere than in equations of discrete time, or one too many."""
    jumps, arguments = jumping(*system.dynamics), [a for call in system.calls for a in call.arguments]
    if jumps and system.time != "discrete":
        y = jumps[0].operands[0]
        raise InputError(
            f"equations may jump in discrete time alone, and {system.name} has {jumps[0]}. Smooth it, as "
            f"in (1 + tanh(50*({y})))/2."
        )
    if len(jumps) > MOST_JUMPS:
        raise InputError(f"{system.name} must have at most {MOST_JUMPS} different heavisides; it has {len(jumps)}.")
    others = (*system.u_eq, *system.x_eq, *system.observations, *system.constraints.values(), *arguments)
    if elsewhere := jumping(*others):
        raise InputError(f"only the equations of {system.name} may jump; {elsewhere[0]} stands elsewhere.")


def _check_angles(system: System) -> None:
    names = [s.name for s in system.states]
    for name in system.angles:
        if name not in names:
            raise InputError(
                f"an angle of {system.name} must be one of its states, {', '.join(names)}; found {name!r}."
            )
        if system.angles.count(name) > 1:
            raise InputError(f"`angles` of {system.name} must name each state once; found {name!r} twice.")


def _check_constraints(system: System) -> None:
    known = {*system.states, *system.inputs, *map(Symbol, system.parameters), *system.disturbances}
    known |= {symbol for call in system.calls for _, symbol in call.results}
    for name, e in system.constraints.items():
        _check_name(f"a name in {system.name}", name)
        if not isinstance(e, Expression):
            raise InputError(f"constraint {name} of {system.name} must be an expression; found {e!r:.60}.")
        constant_of(e)
        odd = sorted(s.name for s in symbols_of(e) - known)
        if odd:
            raise InputError(
                f"constraint {name} of {system.name} uses {odd[0]}, which is no state, input, parameter or disturbance."
            )


def _check_ranges(system: System) -> None:
    acting, fixed = {s.name for s in system.disturbances}, {s.name for s in symbols_of(*system.x_eq)}
    for name, (lo, hi) in system.ranges.items():
        if name not in system.parameters and name not in acting:
            known = ", ".join([*system.parameters, *sorted(acting)]) or "none"
            raise InputError(f"{system.name} has no parameter or disturbance {name!r}; it has: {known}.")
        if name in fixed:
            raise InputError(
                f"{name} must have one value, because the operating point of {system.name} depends on it; found the "
                f"range [{float(lo):g}, {float(hi):g}]."
            )
        nominal = system.parameters.get(name, Fraction(0))
        if not (lo < hi and lo <= nominal <= hi):
            raise InputError(
                f"the range of {name} must satisfy lo < hi and hold its nominal value {float(nominal):g}; found "
                f"[{float(lo):g}, {float(hi):g}]."
                if lo < hi
                else f"the range of {name} must satisfy lo < hi; found [{float(lo):g}, {float(hi):g}]."
            )
        if name in system.positive and not lo > 0:
            raise InputError(f"parameter {name} of {system.name} must be positive; found {float(lo):g} in its range.")


def _check_sample(system: System) -> None:
    if system.sample is None:
        return
    if system.time == "discrete":
        raise InputError(f"{system.name} is a plant in discrete time, whose steps are its samples: leave out `sample`.")
    lo, hi = system.sample
    if not 0 <= lo <= hi or not hi > 0:
        raise InputError(
            f"`sample` must be a positive time, or two with 0 <= lo <= hi; found {float(lo):g} and {float(hi):g}."
        )
