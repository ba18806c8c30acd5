"""Constraints of a loop at points: the worst value of each in floats, the lowest V at which one is violated, Arb.

The point of {g >= 0} that is nearest to the origin, in coordinates in which V is the squared distance, is looked for by
linearising g again and again: from z to the nearest point of the half-space that g is near z. Of a linear g it is there
after one step (Hasofer and Lind 1974; Rackwitz and Fiessler 1978, for the same question about failures). Nothing is
proved with it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from fractions import Fraction

import flint
import numpy as np
from numpy.typing import NDArray

from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import Expression, Operation, Symbol, constant_of, symbols_of
from certify.loop.plants import System, corners, kept_constraints
from certify.loop.plants.floating_point import function_of
from certify.loop.rigorous import ball, evaluate_arb, evaluate_policy, points, precision

Array = NDArray[np.float64]
_STEPS, _FULL, _DAMPED = (
    40,
    10,
    0.5,
)  # linearisations, the first of which are followed all the way, others by this share
_EACH, _OF_G = 3e5, 0.1  # operations of a step, however few points; of all g at one, relative to the loop's
_APART = 1e-6  # of a difference quotient, as a share of the distance from the origin
_PUSHES = (1e-9, 1e-6, 1e-3)  # shares of that distance, by which a point is moved into the violation
_FAR = 4.0  # shares of the largest distance, beyond which a point has gone astray


class Constraints:
    """The constraints of a closed loop in floats.

    `names` are theirs, and `planes` those that are half-spaces of states: a (n,) and b > 0 of a'x < b.
    """

    def __init__(self, loop: ClosedLoop) -> None:
        self.loop, system = loop, loop.system
        found = kept_constraints(system)
        self.names = tuple(found)
        self.g = function_of(system, tuple(found.values()), [s for s, _ in system.uncertain], "numpy")
        planes = [_plane(system, g) for g in found.values()]
        self.planes, self.is_plane = [p for p in planes if p is not None], [p is not None for p in planes]
        self.reads_inputs = any(symbols_of(g) & set(system.inputs) for g in found.values())
        self.values = [[float(q) for q in corner.values()] for corner in corners(system)]

    def operations(self, n: int, start: int, steps: int = _STEPS) -> float:
        """Operations of `touching` from so many points of n states, about, as an `Effort` counts them."""
        looks = sum(1 if flat else steps * start for flat in self.is_plane) * (n + 1)
        return _EACH * steps * len(self.names) + looks * self.loop.operations * (1 + len(self.values) * _OF_G)

    @np.errstate(all="ignore")
    def at(self, x: Array, u: Array) -> Array:
        """The worst value of each g at states and inputs, over the corners of the ranges: (B, K)."""
        found = np.stack([self.g(x, u, values) for values in self.values]).max(0)
        return np.asarray(np.where(np.isnan(found), np.inf, found))

    @np.errstate(all="ignore")
    def worst(self, x: Array) -> Array:
        """The largest g (...) at states (..., n); the policy is asked for its inputs only if some g reads one."""
        u = self.loop.policy(x) if self.reads_inputs else np.zeros((*x.shape[:-1], self.loop.system.m))
        return np.asarray(self.at(x, u).max(-1))

    @np.errstate(all="ignore")
    def touching(self, T: Array, limit: float, start: Array, steps: int = _STEPS) -> Array:
        """Points z (N, n) of {z'z <= limit} about where each g vanishes nearest to the origin, looked for from several
        points (M, n), x = T z; and points beside them, at which it is violated."""
        found = list[Array]()
        for k in range(len(self.names)):
            z, most = start[:1] if self.is_plane[k] else start, _FAR * limit**0.5
            for step in range(1 if self.is_plane[k] else steps):
                value, slope = self._linearised(T, z, k)
                square = (slope * slope).sum(-1, keepdims=True)
                nearest = slope * ((slope * z).sum(-1, keepdims=True) - value[:, None]) / square
                z = z + (1.0 if step < _FULL else _DAMPED) * (nearest - z)
                size = np.linalg.norm(z, axis=-1, keepdims=True)
                z = np.where(size > most, z * (most / size), z)
                z = z[np.isfinite(z).all(-1)]
                if not len(z):
                    break
            if len(z):
                _, slope = self._linearised(T, z, k)
                unit = slope / np.linalg.norm(slope, axis=-1, keepdims=True)
                size = np.linalg.norm(z, axis=-1, keepdims=True)
                found += [z, *(z + push * size * unit for push in _PUSHES)]
        z = np.concatenate(found) if found else start[:0]
        return np.asarray(z[np.isfinite(z).all(-1) & ((z * z).sum(-1) <= limit)])

    def _linearised(self, T: Array, z: Array, k: int) -> tuple[Array, Array]:
        """The value (N,) of one g at z (N, n), and its gradient (N, n) there, by differences."""
        n = z.shape[1]
        apart = _APART * np.linalg.norm(z, axis=-1)[:, None] + 1e-300
        moved = np.concatenate([z[None], z + np.eye(n)[:, None] * apart]).reshape(-1, n) @ T.T
        values = self.at(moved, self.loop.policy(moved))[:, k].reshape(n + 1, len(z))
        return values[0], ((values[1:] - values[0]) / apart.T).T


def keeping(loop: ClosedLoop) -> Callable[[Array], NDArray[np.bool_]] | None:
    """The test of states (..., n) for all constraints, in floats; None without constraints."""
    if not loop.system.constraints:
        return None
    constraints = Constraints(loop)
    return lambda x: np.asarray(constraints.worst(x) < 0)


def _plane(system: System, g: Expression) -> tuple[Array, float] | None:
    """The half-space g < 0, as a and b of a'x < b; None if g is not linear in the states, or b is not positive."""
    found = _linear(g)
    if found is None:
        return None
    factors, b = found
    a = np.array([float(factors.pop(s, Fraction(0))) for s in system.states])
    return (a, -float(b)) if not factors and b < 0 and np.any(a != 0) else None


def _linear(e: Expression) -> tuple[dict[Symbol, Fraction], Fraction] | None:
    """The factors of symbols in a linear expression, and its value where they are 0; None if it is not linear."""
    constant = constant_of(e)
    if constant is not None:
        return {}, constant
    match e:
        case Symbol():
            return {e: Fraction(1)}, Fraction(0)
        case Operation(operator="-", operands=(inner,)):
            return _times(_linear(inner), Fraction(-1))
        case Operation(operator="*" | "/" as sign, operands=(inner, other)) if k := constant_of(other):
            return _times(_linear(inner), k if sign == "*" else 1 / k)
        case Operation(operator="*", operands=(other, inner)) if (k := constant_of(other)) is not None:
            return _times(_linear(inner), k)
        case Operation(operator="+", operands=terms):
            factors, total = dict[Symbol, Fraction](), Fraction(0)
            for term in map(_linear, terms):
                if term is None:
                    return None
                factors |= {s: factors.get(s, Fraction(0)) + k for s, k in term[0].items()}
                total += term[1]
            return factors, total
    return None


def _times(
    linear: tuple[dict[Symbol, Fraction], Fraction] | None, k: Fraction
) -> tuple[dict[Symbol, Fraction], Fraction] | None:
    return None if linear is None else ({s: k * v for s, v in linear[0].items()}, k * linear[1])


def is_violated_at(loop: ClosedLoop, name: str, x: Array, values: Mapping[str, Fraction]) -> bool:
    """True if the constraint of this name is certain not to be negative at a binary64 point (n,), by Arb."""
    g = kept_constraints(loop.system).get(name)
    return g is not None and bool(_value(loop, g, x, values) >= 0)


def not_kept_at_origin(loop: ClosedLoop) -> tuple[str, float] | None:
    """A constraint that is not certain to hold where V is 0, at a corner of the ranges, and its g there; or None."""
    for name, g in kept_constraints(loop.system).items():
        for values in corners(loop.system):
            found = _value(loop, g, np.zeros(loop.system.n), values)
            if not found < 0:
                return name, float(found.mid())
    return None


def _value(loop: ClosedLoop, g: Expression, x: Array, values: Mapping[str, Fraction]) -> flint.arb:
    with precision():
        known = dict(zip(loop.system.states, points(x), strict=True))
        known |= zip(loop.system.inputs, evaluate_policy(loop, x), strict=True)
        known |= {Symbol(quantity): ball(q) for quantity, q in values.items()}
        return evaluate_arb(g, known)
