"""Parameters that measurements bound along axes of their own: p = centre + T q, with q in the plant in place of p.

Data of a closed loop say much of a sum of parameters and little of each. A box of q is then a small part of the box of
p that holds it. All numbers are exact rationals, and so is the inverse q = at + S p.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction

from flint import fmpq, fmpq_mat

from certify.errors import InputError
from certify.loop.expressions import Expression, Number, Symbol, substitute, symbols_of
from certify.loop.plants.measurements import Axis
from certify.loop.plants.system import System

_RANGE = Fraction(-1), Fraction(1)
Row = tuple[Fraction, ...]


def axes_of(sums: Sequence[Row]) -> tuple[Axis, ...]:
    """The axes q of parameters p_k = c_k + sum_j T_kj q_j, from rows (c_k, T_k1, ..., T_kK).

    Raises
    ------
    InputError : T has no inverse.
    """
    at, by = _inverted([row[0] for row in sums], [row[1:] for row in sums])
    return tuple(Axis(f"axis_{j + 1}", *each) for j, each in enumerate(zip(at, by, strict=True)))


def sums_of(axes: Sequence[Axis]) -> list[Row]:
    """The rows (c_k, T_k1, ..., T_kK) of the parameters p_k = c_k + sum_j T_kj q_j of these axes q."""
    centre, by = _inverted([axis.at for axis in axes], [axis.by for axis in axes])
    return [(c, *row) for c, row in zip(centre, by, strict=True)]


def along_axes(system: System) -> System:
    """The plant of measurements with axes, in these: each in [-1, 1], in place of the parameters.

    Raises
    ------
    InputError : an observation depends on a parameter, or a name stands for two things.
    """
    data = system.measurements
    if data is None or not data.axes:
        return system
    odd = symbols_of(*system.observations) & {Symbol(p) for p in data.priors}
    if odd:
        raise InputError(f"observations of {system.name} must not depend on {odd.pop()}, where data have axes.")
    names = [axis.name for axis in data.axes]
    taken = {s.name for s in (*system.states, *system.inputs, *system.disturbances)} | {*system.parameters}
    if taken & {*names}:
        raise InputError(f"{system.name} must have no {min(taken & {*names})} of its own, where data have axes.")
    sums = {Symbol(p): _sum(row, names) for p, row in zip(data.priors, sums_of(data.axes), strict=True)}
    others = {name: q for name, q in system.parameters.items() if name not in data.priors}
    acting = {name: ends for name, ends in system.ranges.items() if name not in data.priors}
    return replace(
        system,
        parameters=others | dict.fromkeys(names, Fraction(0)),
        positive=system.positive - {*data.priors},
        dynamics=tuple(substitute(e, sums) for e in system.dynamics),
        u_eq=tuple(substitute(e, sums) for e in system.u_eq),
        constraints={name: substitute(e, sums) for name, e in system.constraints.items()},
        ranges=dict.fromkeys(names, _RANGE) | acting,
    )


def _sum(row: Row, names: Sequence[str]) -> Expression:
    found: Expression = Number(row[0])
    for factor, name in zip(row[1:], names, strict=True):
        if factor:
            found = found + factor * Symbol(name)
    return found


def _inverted(at: Sequence[Fraction], by: Sequence[Row]) -> tuple[Row, list[Row]]:
    """(-S a, S) for y = a + T x: x = -S a + S y."""
    T = fmpq_mat([[fmpq(q.numerator, q.denominator) for q in row] for row in by])
    try:
        S = T.inv()
    except ZeroDivisionError as error:
        raise InputError("the axes of parameters must span all of these.") from error
    a = fmpq_mat([[fmpq(q.numerator, q.denominator)] for q in at])
    exact = [[Fraction(int(q.p), int(q.q)) for q in row] for row in S.tolist()]
    return tuple(Fraction(-int(q.p), int(q.q)) for q in (S * a).entries()), [tuple(row) for row in exact]
