"""The closed loop `xdot = F(x) = f(x, pi(x))`: equilibrium, linearisation, and rigorous evaluation at a point.

Floating-point values (numpy) serve the search; `evaluate_vdot` and `jacobian` in Arb balls serve verdicts.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import flint
import numpy as np
import sympy
from numpy.typing import NDArray

from certify.errors import InputError
from certify.policies import TanhNetwork
from certify.systems import System

Array = NDArray[np.float64]
PRECISION = 200  # bits of Arb


@dataclass(frozen=True, slots=True)
class ClosedLoop:
    """A plant under a tanh policy; `u_eq` is the exact equilibrium input, `folded` the policy without its centring.

    Raises
    ------
    InputError : the policy's counts of states and inputs are not the plant's, pi(0) = u_eq cannot hold by the
        centring, or `f(0, u_eq) = 0` fails.
    """

    system: System
    network: TanhNetwork
    u_eq: tuple[Fraction, ...] = field(init=False, repr=False, compare=False)
    folded: TanhNetwork = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        system, network = self.system, self.network
        if (network.n, network.m) != (system.n, system.m):
            raise InputError(
                f"the policy must read {system.n} states and command {system.m} inputs of {system.name}; "
                f"it reads {network.n} and commands {network.m}."
            )
        u_eq = system.exact_u_eq()
        at_zero = dict.fromkeys(system.states, sympy.Integer(0))
        at_zero |= {s: sympy.Rational(u.numerator, u.denominator) for s, u in zip(system.inputs, u_eq, strict=True)}
        for name, expression in zip(system.states, system.exact_dynamics(), strict=True):
            value = expression.subs(at_zero)
            if value != 0:
                raise InputError(
                    f"f(0, u_eq) must be exactly 0; {name}' = {value} at the origin of {system.name}. "
                    "Shift the states or correct u_eq."
                )
        object.__setattr__(self, "u_eq", u_eq)
        object.__setattr__(self, "folded", network.folded(u_eq))
        if network.centre == "none":
            raw = network(np.zeros(network.n), u_eq)
            if not np.allclose(raw, [float(u) for u in u_eq], rtol=1e-9, atol=1e-9):
                raise InputError(
                    f"the policy is not centred: pi(0) = {raw} but u_eq = {[float(u) for u in u_eq]}. "
                    "Use centre 'output' or 'preactivation'."
                )

    def policy(self, x: Any) -> Any:
        """pi(x) in float64, (..., n) to (..., m)."""
        return self.folded(x, self.u_eq)

    def linearise(self) -> tuple[Array, Array, Array]:
        """(A, B, K) in float64: `A = df/dx - B K` the closed loop's Jacobian, K = -J_pi(0)."""
        A_open, B = (_to_float(M) for M in self._plant_jacobians())
        K = -self.network.jacobian_at_origin(self.u_eq)
        return A_open - B @ K, B, K

    def eigenvalues(self) -> list[flint.acb] | None:
        """Rigorous enclosures of the eigenvalues of the closed loop's Jacobian; None if Arb cannot isolate them."""
        flint.ctx.prec = PRECISION
        try:
            return list(flint.acb_mat(self._jacobian_arb()).eig(multiple=True))
        except (ValueError, ArithmeticError):
            return None

    def evaluate_policy(self, x: Array) -> list[flint.arb]:
        """pi(x) at a binary64 point, as Arb balls."""
        flint.ctx.prec = PRECISION
        network, u_eq = self.network, self.u_eq
        y = _net_arb(network, x)
        scale, offset = ([flint.arb(float(v)) for v in a] for a in (network.scale, network.offset))
        if network.centre == "none":
            h = [v.tanh() for v in y] if network.squash == "tanh" else y
            return [s * v + o for s, v, o in zip(scale, h, offset, strict=True)]
        y0 = _net_arb(network, np.zeros(network.n))
        if network.centre == "preactivation":
            result = []
            for v, v0, s, o, u in zip(y, y0, scale, offset, u_eq, strict=True):
                beta = ((_arb(u) - o) / s).atanh()
                result.append(s * (v - v0 + beta).tanh() + o)
            return result
        if network.squash == "tanh":
            y, y0 = [v.tanh() for v in y], [v.tanh() for v in y0]
        return [s * (v - v0) + _arb(u) for s, v, v0, u in zip(scale, y, y0, u_eq, strict=True)]

    def evaluate_vdot(self, P: Array, x: Array) -> flint.arb:
        """`Vdot = 2 x'P F(x)` at a binary64 point, as an Arb ball."""
        values: dict[sympy.Symbol, flint.arb] = dict(zip(self.system.inputs, self.evaluate_policy(x), strict=True))
        values |= {s: flint.arb(float(v)) for s, v in zip(self.system.states, x, strict=True)}
        F = [evaluate_arb(e, values) for e in self.system.exact_dynamics()]
        state = [flint.arb(float(v)) for v in x]
        total = flint.arb(0)
        for i, row in enumerate(P):
            total += 2 * sum((flint.arb(float(p)) * state[j] for j, p in enumerate(row)), flint.arb(0)) * F[i]
        return total

    def _plant_jacobians(self) -> tuple[sympy.Matrix, sympy.Matrix]:
        system = self.system
        f = sympy.Matrix(system.exact_dynamics())
        at_zero = dict.fromkeys(system.states, sympy.Integer(0))
        at_zero |= {
            s: sympy.Rational(u.numerator, u.denominator) for s, u in zip(system.inputs, self.u_eq, strict=True)
        }
        return f.jacobian(list(system.states)).subs(at_zero), f.jacobian(list(system.inputs)).subs(at_zero)

    def _jacobian_arb(self) -> flint.arb_mat:
        """The closed loop's Jacobian at the origin as Arb balls."""
        network, u_eq = self.network, self.u_eq
        y: list[flint.arb] = [flint.arb(0)] * network.n
        J = flint.arb_mat([[int(i == j) for j in range(network.n)] for i in range(network.n)])
        for k, (W, b) in enumerate(zip(network.weights, network.biases, strict=True)):
            if k:
                y, J = _through_tanh(y, J)
            weight = flint.arb_mat([[flint.arb(float(w)) for w in row] for row in W])
            product = weight * flint.arb_mat([[v] for v in y])
            y, J = [product[i, 0] + flint.arb(float(b[i])) for i in range(len(b))], weight * J
        if network.squash == "tanh":
            if network.centre == "preactivation":
                ratios = [
                    (u - Fraction(float(o))) / Fraction(float(s))
                    for u, o, s in zip(u_eq, network.offset, network.scale, strict=True)
                ]
                y = [_arb(q).atanh() for q in ratios]
            y, J = _through_tanh(y, J)
        scale = [flint.arb(float(s)) for s in network.scale]
        gain = flint.arb_mat([[scale[i] * J[i, j] for j in range(network.n)] for i in range(network.m)])
        A, B = (
            flint.arb_mat([[evaluate_arb(M[i, j], {}) for j in range(M.shape[1])] for i in range(M.shape[0])])
            for M in self._plant_jacobians()
        )
        return A + B * gain


def evaluate_arb(expression: sympy.Expr, values: Mapping[sympy.Symbol, flint.arb]) -> flint.arb:
    """An expression of the plant in Arb balls."""
    if expression.is_Rational:
        return _arb(Fraction(int(expression.p), int(expression.q)))
    if expression.is_Symbol:
        return values[expression]
    arguments = [evaluate_arb(a, values) for a in expression.args]
    if expression.is_Add:
        return sum(arguments[1:], arguments[0])
    if expression.is_Mul:
        result = arguments[0]
        for a in arguments[1:]:
            result = result * a
        return result
    if expression.is_Pow:
        base, exponent = arguments[0], int(expression.exp)
        result = base
        for _ in range(abs(exponent) - 1):  # Arb's own power is NaN for a ball around 0
            result = result * base
        return result if exponent > 0 else 1 / result
    functions = {sympy.sin: "sin", sympy.cos: "cos", sympy.tan: "tan"}
    return getattr(arguments[0], functions[expression.func])()


def _arb(q: Fraction) -> flint.arb:
    return flint.arb(flint.fmpq(q.numerator, q.denominator))


def _net_arb(network: TanhNetwork, x: Array) -> list[flint.arb]:
    h = [flint.arb(float(v)) for v in x]
    for k, (W, b) in enumerate(zip(network.weights, network.biases, strict=True)):
        if k:
            h = [v.tanh() for v in h]
        weight = flint.arb_mat([[flint.arb(float(w)) for w in row] for row in W])
        product = weight * flint.arb_mat([[v] for v in h])
        h = [product[i, 0] + flint.arb(float(b[i])) for i in range(len(b))]
    return h


def _through_tanh(y: list[flint.arb], J: flint.arb_mat) -> tuple[list[flint.arb], flint.arb_mat]:
    t = [v.tanh() for v in y]
    rows, columns = J.nrows(), J.ncols()
    return t, flint.arb_mat([[(1 - t[i] ** 2) * J[i, j] for j in range(columns)] for i in range(rows)])


def _to_float(matrix: sympy.Matrix) -> Array:
    return np.array(matrix.tolist(), dtype=np.float64)
