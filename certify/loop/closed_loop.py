"""The closed loop `xdot = F(x) = f(x, pi(x))` in floating point, and a test of its equilibrium in rationals.

Verdicts rest on `certify.loop.rigorous` and on the checker; the rounded numbers here serve the search.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.errors import InputError
from certify.loop.expressions import Expression, Symbol, evaluate_exactly, nodes, symbols_of
from certify.loop.plants import Matrix, System, in_floats, linearise
from certify.loop.policies import PolicyNetwork, require_centred

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ClosedLoop:
    """A plant under a policy; `u_eq` is the exact equilibrium input, `folded` the policy without its centring,
    `dynamics` the nominal equations. `operations` estimates the cost of F at one state, as an `Effort` counts it;
    `of_equations` is the part of f.

    Raises
    ------
    InputError : the policy's counts of states and inputs are not the plant's, or its centring cannot hold.
    """

    system: System
    network: PolicyNetwork
    u_eq: tuple[Fraction, ...] = field(init=False, repr=False, compare=False)
    folded: PolicyNetwork = field(init=False, repr=False, compare=False)
    dynamics: tuple[Expression, ...] = field(init=False, repr=False, compare=False)
    operations: float = field(init=False, repr=False, compare=False)
    of_equations: float = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        system, network = self.system, self.network
        if (network.n, network.m) != (system.n, system.m):
            raise InputError(
                f"the policy must read {system.n} states and command {system.m} inputs of {system.name}; "
                f"it reads {network.n} and commands {network.m}."
            )
        if system.calls:
            raise InputError(
                f"the equations of {system.name} call {', '.join(call.name for call in system.calls)}; certify roa and "
                "certify_roa take such a plant, this does not yet."
            )
        u_eq = system.exact_u_eq()
        object.__setattr__(self, "u_eq", u_eq)
        object.__setattr__(self, "folded", network.folded(u_eq))
        object.__setattr__(self, "dynamics", system.exact_dynamics())
        of = network.network
        equations = 4.0 * sum(1 for _ in nodes(*self.dynamics))
        object.__setattr__(self, "of_equations", equations)
        object.__setattr__(self, "operations", 0.07 * of.entries + 2.0 * of.units + 4.0 * of.operations + equations)

    def require_rest(self) -> None:
        """Refuse a loop whose origin is not an equilibrium, exactly: `f(0, u_eq) = 0` and `pi(0) = u_eq`.

        Raises
        ------
        InputError : one of the two fails, or rationals cannot decide it (a function at another point than 0).
        """
        system = self.system
        at_zero = dict.fromkeys(system.states, Fraction(0)) | dict(zip(system.inputs, self.u_eq, strict=True))
        unknown = [s for s, _ in system.uncertain]
        for symbol, expression in zip(system.states, system.uncertain_dynamics(), strict=True):
            wanted = f"f(0, u_eq) must be exactly 0 in {system.name}"
            try:
                value = evaluate_exactly(expression, at_zero, unknown)
            except InputError as error:
                acting = [s.name for s in unknown if s in symbols_of(expression)]
                if acting:
                    raise InputError(
                        f"the loop must rest at the operating point of {system.name} whatever {' and '.join(acting)} "
                        f"may be; {symbol}' {_depends(expression, at_zero, system)}. Ask for --claim practical or "
                        "nearby, which do not need it."
                    ) from error
                raise InputError(f"{wanted}; {symbol}' is not decided in rationals: {error}.") from error
            if value != 0:
                raise InputError(
                    f"{wanted}; {symbol}' = {float(value):.6g} at the origin. Shift the states or correct u_eq, "
                    "or ask for --claim practical, which does not need it."
                )
        require_centred(self.network, self.u_eq, [s.name for s in system.inputs])

    def policy(self, x: Any) -> Any:
        """pi(x) in float64, (..., n) to (..., m)."""
        return self.folded(x, self.u_eq)

    def linearise(self) -> tuple[Array, Array, Array]:
        """(A, B, K) in float64: `A = df/dx - B K` the closed loop's Jacobian, K = -J_pi(0).

        Raises
        ------
        InputError : the plant has no Jacobian at the origin, or an entry is too large for binary64.
        """
        A_open, B = (in_floats(M) for M in self.plant_jacobians())
        if not (np.all(np.isfinite(A_open)) and np.all(np.isfinite(B))):
            raise InputError(
                f"derivatives of {self.system.name} at the origin must be within the range of binary64; found others. "
                "Scale the states."
            )
        K = -self.network.jacobian_at_origin(self.u_eq)
        return A_open - B @ K, B, K

    @property
    def step(self) -> float:
        """h in V's increment over a step, `2 x'P G + h G'P G`: 0 in continuous time, 1 in discrete time, and else the
        longest period over which the input is held, in units of time."""
        sample = self.system.sample
        return float(self.system.time == "discrete") if sample is None else float(sample[1])

    def mean_rate(self) -> Array:
        """L (n, n) with `G = L x` to first order, G the mean rate of a step: A; A - I; (Phi(h) - I)/h, Phi the map of
        the linearised plant whose input is held over the step h.

        With L the linear formulas are the same in continuous and discrete time: `I + h L` is the map of a step, and V
        decreases if `L'P + P L + h L'P L < 0`.
        """
        A, B, K = self.linearise()
        if self.system.time == "discrete":
            return A - np.eye(len(A))
        if self.system.sample is None:
            return A
        from scipy.linalg import expm

        n, m, h = self.system.n, self.system.m, self.step
        held = np.zeros((n + m, n + m))
        held[:n] = h * np.hstack([A + B @ K, B])
        # (exp(M) - I)/h without the cancellation: the corner of the exponential of a block matrix
        mean = expm(np.block([[held, np.eye(n + m)], [np.zeros((n + m, 2 * (n + m)))]]))[: n + m, n + m :]
        rate: Array = (mean @ held / h)[:n] @ np.vstack([np.eye(n), -K])
        return rate

    def plant_jacobians(self) -> tuple[Matrix, Matrix]:
        """(df/dx, df/du) at the origin and u_eq, exact."""
        return linearise(self.system)


def _depends(expression: Expression, at_zero: Mapping[Symbol, Fraction], system: System) -> str:
    """The words for an equation that depends on what is uncertain at rest: by its value, or only as it is written."""
    acting = [(name, ends) for name, ends in system.uncertain if name in symbols_of(expression)]
    corners = itertools.islice(itertools.product(*(ends for _, ends in acting)), 64)
    try:
        values = [
            evaluate_exactly(expression, {**at_zero, **dict(zip((name for name, _ in acting), corner, strict=True))})
            for corner in corners
        ]
    except InputError:
        return "depends on that there"
    if any(values):
        return "depends on that there"
    return "is 0 there at the ends of the ranges, but its terms cancel only when (a - b)/m is written, not a/m - b/m"
