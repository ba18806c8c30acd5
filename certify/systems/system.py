"""The plant `xdot = f(x, u)`: sympy expressions over exact rational parameters.

Numbers are exact because the proof is about *this* plant: `m = 0.15` written as text is 3/20, while a
Python float stands for its binary value. sympy never folds floats here; an expression that contains
one is refused.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from decimal import Decimal
from fractions import Fraction
from types import MappingProxyType
from typing import Any

import sympy

from certify.errors import InputError
from certify.expressions import GRAMMAR, has_tree

Interval = tuple[Fraction, Fraction]


def exact(value: Fraction | float | int | str | Decimal, name: str = "value") -> Fraction:
    """Exact rational of a number: text means its decimal value, a float its binary value.

    >>> exact("0.15"), exact(0.5), exact("3/20")
    (Fraction(3, 20), Fraction(1, 2), Fraction(3, 20))
    """
    if isinstance(value, float) and not math.isfinite(value):
        raise InputError(f"`{name}` must be a finite number; found {value}.")
    try:
        return Fraction(value)
    except (ValueError, TypeError, OverflowError, ZeroDivisionError) as error:
        raise InputError(f"`{name}` must be a finite number such as 0.15 or 3/20; found {value!r}.") from error


@dataclass(frozen=True, slots=True)
class System:
    """A plant `xdot = f(x, u)` on a box domain, with an equilibrium at the origin.

    Parameters
    ----------
    name : identifier of the plant.
    states : n symbols, in the order of x.
    inputs : m symbols, in the order of u.
    parameters : exact value of each parameter symbol.
    dynamics : n expressions in states, inputs and parameters, built from `+ - * /`, integer constant
        powers, sin, cos, tan, tanh, exp, atan and sqrt.
    u_eq : m expressions in the parameters; `f(0, u_eq) = 0` is proved later, not assumed.
    domain : n intervals `(lo, hi)` with `lo < 0 < hi`, in the units of the states.
    input_bounds : m intervals `(lo, hi)` with `lo < hi`, in the units of the inputs.
    positive : names of parameters that must be positive (masses, lengths, ...).
    units : unit of each state, input and parameter by name.
    description : one line for people.

    Raises
    ------
    InputError : counts do not match, a domain does not contain 0 in its interior, a parameter that
        must be positive is not, or an expression uses something outside the grammar.
    """

    name: str
    states: tuple[sympy.Symbol, ...]
    inputs: tuple[sympy.Symbol, ...]
    parameters: Mapping[str, Fraction]
    dynamics: tuple[sympy.Expr, ...]
    u_eq: tuple[sympy.Expr, ...]
    domain: tuple[Interval, ...]
    input_bounds: tuple[Interval, ...]
    positive: frozenset[str] = frozenset()
    units: Mapping[str, str] = field(default_factory=dict)
    description: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "parameters", MappingProxyType(dict(self.parameters)))
        object.__setattr__(self, "units", MappingProxyType(dict(self.units)))
        n, m = len(self.states), len(self.inputs)
        for label, found, wanted in (
            ("dynamics", len(self.dynamics), n),
            ("domain", len(self.domain), n),
            ("u_eq", len(self.u_eq), m),
            ("input_bounds", len(self.input_bounds), m),
        ):
            if found != wanted:
                raise InputError(f"`{label}` of {self.name} must have {wanted} entries; found {found}.")
        if n == 0 or m == 0:
            raise InputError(f"{self.name} must have at least one state and one input.")
        names = [s.name for s in (*self.states, *self.inputs)] + list(self.parameters)
        for name in (self.name, *names):
            if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]{0,63}", name):
                raise InputError(f"names in {self.name} must be identifiers of at most 64 letters; found {name!r}.")
        if len(set(names)) != len(names):
            raise InputError(f"names of states, inputs and parameters of {self.name} must differ; found {names}.")
        for symbol, (lo, hi) in zip(self.states, self.domain, strict=True):
            if not lo < 0 < hi:
                raise InputError(
                    f"the domain of {symbol} must contain 0 in its interior; found [{float(lo)}, {float(hi)}]."
                )
        for symbol, (lo, hi) in zip(self.inputs, self.input_bounds, strict=True):
            if not lo < hi:
                raise InputError(f"the bounds of {symbol} must satisfy lo < hi; found [{float(lo)}, {float(hi)}].")
        for name in sorted(self.positive):
            if not self.parameters[name] > 0:
                raise InputError(f"parameter {name} of {self.name} must be positive; found {self.parameters[name]}.")
        parameters = {sympy.Symbol(p) for p in self.parameters}
        for expression in self.dynamics:
            _check_grammar(expression, {*self.states, *self.inputs, *parameters}, self.name)
        for expression in self.u_eq:
            _check_grammar(expression, parameters, self.name)

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.states)

    @property
    def m(self) -> int:
        """Number of inputs."""
        return len(self.inputs)

    def with_parameters(self, values: Mapping[str, Fraction | float | int | str]) -> System:
        """The same plant with some parameters replaced; unknown names are refused."""
        for name in values:
            if name not in self.parameters:
                known = ", ".join(self.parameters) or "none"
                raise InputError(f"{self.name} has no parameter {name!r}; it has: {known}.")
        exact_values = {name: exact(value, name) for name, value in values.items()}
        return replace(self, parameters={**self.parameters, **exact_values})

    def with_domain(self, bounds: Mapping[str, Interval]) -> System:
        """The same plant on another box; unknown state names are refused."""
        names = [s.name for s in self.states]
        for name in bounds:
            if name not in names:
                raise InputError(f"{self.name} has no state {name!r}; it has: {', '.join(names)}.")
        domain = tuple(bounds.get(name, old) for name, old in zip(names, self.domain, strict=True))
        return replace(self, domain=domain)

    def exact_dynamics(self) -> tuple[sympy.Expr, ...]:
        """f with the parameters replaced by exact rationals; free symbols are states and inputs."""
        return tuple(self._substitute(e) for e in self.dynamics)

    def exact_u_eq(self) -> tuple[Fraction, ...]:
        """The equilibrium input as exact rationals, shape (m,)."""
        values = []
        for name, expression in zip(self.inputs, self.u_eq, strict=True):
            value = self._substitute(expression)
            if not value.is_Rational:
                raise InputError(f"u_eq of {name} must be rational; found {value}.")
            values.append(Fraction(int(value.p), int(value.q)))
        return tuple(values)

    def function(self, module: str = "numpy") -> Callable[[Any, Any], Any]:
        """Floating-point f: arrays x (..., n) and u (..., m) to xdot (..., n); `module` numpy or torch.

        For simulation and search only: nothing is proved with it.
        """
        stack: Any
        broadcast: Any
        if module == "numpy":
            import numpy

            stack, broadcast = numpy.stack, numpy.broadcast_arrays
        elif module == "torch":
            import torch

            stack, broadcast = torch.stack, torch.broadcast_tensors
        else:
            raise InputError(f"`module` must be 'numpy' or 'torch'; found {module!r}.")
        # torch has no sine of a plain number
        rounded = [e.replace(_is_constant_function, lambda c: c.evalf(17)) for e in self.exact_dynamics()]
        raw = sympy.lambdify([*self.states, *self.inputs], rounded, modules=module, cse=True)
        n, m = self.n, self.m

        def f(x: Any, u: Any) -> Any:
            columns: list[Any] = [x[..., i] for i in range(n)] + [u[..., j] for j in range(m)]
            zero = 0.0 * (columns[0] + columns[n])  # constant components take the batch's shape
            return stack(tuple(broadcast(*[value + zero for value in raw(*columns)])), -1)

        return f

    def _substitute(self, expression: sympy.Expr) -> sympy.Expr:
        values = {sympy.Symbol(name): sympy.Rational(q.numerator, q.denominator) for name, q in self.parameters.items()}
        result = expression.subs(values)
        if result.has(sympy.zoo, sympy.nan, sympy.oo):
            raise InputError(f"an equation of {self.name} divides by zero with the parameters {dict(self.parameters)}.")
        return result


def _is_constant_function(node: sympy.Expr) -> bool:
    return bool(node.is_number and not node.is_Rational and (node.is_Function or node.is_Pow or not node.args))


def symbols(names: Sequence[str]) -> tuple[sympy.Symbol, ...]:
    """Plain sympy symbols, one a name."""
    return tuple(sympy.Symbol(name) for name in names)


def _check_grammar(expression: sympy.Expr, allowed: set[sympy.Symbol], system: str) -> None:
    for node in sympy.preorder_traversal(expression):
        if node in allowed or (has_tree(node) and not node.is_Symbol):
            continue
        if node.is_Float:
            raise InputError(f"an equation of {system} holds the rounded number {node}; write it as a fraction.")
        if node.is_Symbol:
            raise InputError(f"an equation of {system} uses {node}, which is no state, input or parameter.")
        raise InputError(f"an equation of {system} uses {node}; allowed are {GRAMMAR} and exact numbers.")
