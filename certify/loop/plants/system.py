"""The plant `xdot = f(x, u)`, or `x+ = f(x, u)`: expressions as they were written, over exact rational parameters.

Numbers are exact because the proof is about *this* plant: `m = 0.15` written as text is 3/20, while a
Python float stands for its binary value; an expression that contains one is refused. Nothing simplifies an equation
either: parameters are replaced by their values and deviations by `x_eq + x`, and the tree stays what it was.

Everything works in deviations from the operating point x_eq: the claims, the certificate and the policy are about
`x - x_eq`, whose equilibrium is the origin. So no rule of the checkers uses x_eq; it is for people, and only
`in_deviations` moves equations there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from decimal import Decimal, InvalidOperation
from fractions import Fraction
from types import MappingProxyType
from typing import Any, Literal, get_args

from certify.errors import InputError
from certify.loop.expressions import (
    Expression,
    Number,
    Symbol,
    as_expression,
    constant_of,
    substitute,
    symbols_of,
    value_if_rational,
)
from certify.loop.expressions.numerical import Module, numerical
from certify.loop.plants.calls import Call
from certify.loop.plants.floating_point import function_of
from certify.loop.plants.measurements import Measurements
from certify.loop.plants.samples import Samples
from certify.loop.plants.validation import validate

Interval = tuple[Fraction, Fraction]
Time = Literal["continuous", "discrete"]

_MOST_DIGITS = 1000  # before or after the point: 1e999999999 would fill the memory


def exact(value: Fraction | float | int | str | Decimal, name: str = "value") -> Fraction:
    """Exact rational of a number: text means its decimal value, a float its binary value.

    >>> exact("0.15"), exact(0.5), exact("3/20")
    (Fraction(3, 20), Fraction(1, 2), Fraction(3, 20))
    """
    if isinstance(value, float) and not math.isfinite(value):
        raise InputError(f"`{name}` must be a finite number; found {value}.")
    try:
        if isinstance(value, str) and "e" in value.lower() and abs(Decimal(value).adjusted()) > _MOST_DIGITS:
            raise OverflowError(value)
        return Fraction(value)
    except (ValueError, TypeError, OverflowError, ZeroDivisionError, InvalidOperation) as error:
        raise InputError(f"`{name}` must be a finite number such as 0.15 or 3/20; found {value!r}.") from error


@dataclass(frozen=True, slots=True)
class System:
    """A plant `xdot = f(x, u)` on a box domain, with an equilibrium at the origin.

    x are deviations from the operating point `x_eq`: where that is not 0, the value of a state is x_eq + x, and a
    policy reads x.

    Parameters
    ----------
    name : identifier of the plant.
    states : n symbols, in the order of x.
    inputs : m symbols, in the order of u.
    parameters : exact value of each parameter symbol.
    dynamics : n expressions in states, inputs and parameters, built from `+ - * /`, integer constant
        powers, sin, cos, tan, tanh, exp, atan, sqrt, abs, min, max and clip.
    u_eq : m expressions in the parameters; `f(0, u_eq) = 0` is proved later, not assumed.
    domain : n intervals `(lo, hi)` with `lo < 0 < hi`, in the units of the states.
    input_bounds : m intervals `(lo, hi)` with `lo < hi`, in the units of the inputs.
    positive : names of parameters that must be positive (masses, lengths, ...).
    units : unit of each state, input and parameter by name.
    description : one line for people.
    x_eq : n expressions in the parameters, with rational values; empty means zeros. `dynamics` and `domain` are in
        deviations from it already (`in_deviations` brings equations there): nothing that is proved depends on it.
    disturbances : symbols of the dynamics that are 0 unless they have a range.
    ranges : intervals by name, of uncertain parameters and of disturbances that act; values may change at any time. A
        parameter's value in `parameters` lies in its range and is the nominal one, which u_eq and simulation use.
    time : `continuous`, or `discrete`: then the equations are those of x+, the state one step later.
    sample : the shortest and longest sampling period of a continuous plant; None if the input follows at once.
    observations : expressions of the states' values and the parameters, which a policy for this plant reads if nothing
        else is said; empty for the states.
    calls : networks that the dynamics call, whose results stand there as symbols; see `certify.loop.composition`.
    rest_of_calls : exact values of results at the operating point, by their symbols' names, where they are given.
    angles : names of states that are angles: x and x + 2 pi are the same place.
    constraints : expressions g by name, as the dynamics; g < 0 is asked for along trajectories.
    measurements : those with which uncertain parameters, constants, are consistent; None where ranges are assumed.
    samples : of unknown functions for which equations stand; None where they stand for themselves.

    Raises
    ------
    InputError : counts do not match, an interval is empty, a parameter that must be positive is not, an
        expression is outside the grammar, x_eq is irrational, a range is of no name, or an angle is no state.
    """

    name: str
    states: tuple[Symbol, ...]
    inputs: tuple[Symbol, ...]
    parameters: Mapping[str, Fraction]
    dynamics: tuple[Expression, ...]
    u_eq: tuple[Expression, ...]
    domain: tuple[Interval, ...]
    input_bounds: tuple[Interval, ...]
    positive: frozenset[str] = frozenset()
    units: Mapping[str, str] = field(default_factory=dict)
    description: str = ""
    x_eq: tuple[Expression, ...] = ()
    disturbances: tuple[Symbol, ...] = ()
    ranges: Mapping[str, Interval] = field(default_factory=dict)
    time: Time = "continuous"
    sample: Interval | None = None
    observations: tuple[Expression, ...] = ()
    calls: tuple[Call, ...] = ()
    rest_of_calls: Mapping[str, Fraction] = field(default_factory=dict)
    angles: tuple[str, ...] = ()
    constraints: Mapping[str, Expression] = field(default_factory=dict)
    measurements: Measurements | None = None
    samples: Samples | None = None

    def __post_init__(self) -> None:
        for key in ("parameters", "ranges", "units", "rest_of_calls", "constraints"):
            object.__setattr__(self, key, MappingProxyType(dict(getattr(self, key))))
        for symbol in (*self.states, *self.inputs, *self.disturbances):
            if not isinstance(symbol, Symbol):
                raise InputError(f"a name in {self.name} must be one of certify.symbols; found {symbol!r}.")
        object.__setattr__(self, "x_eq", tuple(self.x_eq) or (Number(0),) * self.n)
        for key in ("dynamics", "u_eq", "x_eq", "observations"):
            try:
                object.__setattr__(self, key, tuple(map(as_expression, getattr(self, key))))
                for equation in getattr(self, key):
                    constant_of(equation)
            except InputError as error:
                raise InputError(f"`{key}` of {self.name}: {error}") from error
        if self.time not in get_args(Time):
            raise InputError(f"`time` of {self.name} must be one of {get_args(Time)}; found {self.time!r}.")
        validate(self)

    def __reduce__(self) -> tuple[type[System], tuple[Any, ...]]:
        """Pickle the fields, with read-only mappings as dictionaries; unpickling checks them again."""
        values = (getattr(self, each.name) for each in fields(self))
        return System, tuple(dict(v) if isinstance(v, MappingProxyType) else v for v in values)

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.states)

    @property
    def m(self) -> int:
        """Number of inputs."""
        return len(self.inputs)

    def with_parameters(self, values: Mapping[str, Fraction | float | int | str]) -> System:
        """The same plant with some parameters replaced; unknown names are rejected.

        Where x_eq moves with them, the domain keeps its place and its deviations move.
        """
        for name in values:
            if name not in self.parameters:
                known = ", ".join(self.parameters) or "none"
                raise InputError(f"{self.name} has no parameter {name!r}; it has: {known}.")
        parameters = {**self.parameters, **{name: exact(value, name) for name, value in values.items()}}
        moved = [_rational(self, e, f"x_eq of {s}", parameters) for s, e in zip(self.states, self.x_eq, strict=True)]
        shifts = [old - new for old, new in zip(self.exact_x_eq(), moved, strict=True)]
        domain = tuple((lo + shift, hi + shift) for (lo, hi), shift in zip(self.domain, shifts, strict=True))
        return replace(self, parameters=parameters, domain=domain)

    def with_domain(self, bounds: Mapping[str, tuple[Fraction | float, Fraction | float]]) -> System:
        """The same plant on another box; unknown state names are rejected."""
        names = [s.name for s in self.states]
        for name in bounds:
            if name not in names:
                raise InputError(f"{self.name} has no state {name!r}; it has: {', '.join(names)}.")
        box = (bounds.get(name, old) for name, old in zip(names, self.domain, strict=True))
        return replace(self, domain=tuple((exact(lo, "domain"), exact(hi, "domain")) for lo, hi in box))

    def with_ranges(self, ranges: Mapping[str, Interval | None]) -> System:
        """The same plant where some parameters are uncertain and some disturbances act; None takes a range away.

        A parameter whose value does not lie in its range takes the middle of it.
        """
        given = {name: ends for name, ends in ranges.items() if ends is not None}
        outside = {
            name: (lo + hi) / 2
            for name, (lo, hi) in given.items()
            if name in self.parameters and not lo <= self.parameters[name] <= hi
        }
        kept = {name: ends for name, ends in self.ranges.items() if name not in ranges}
        return replace(self.with_parameters(outside), ranges={**kept, **given})

    def with_sample(self, sample: Interval | None) -> System:
        """The same plant whose inputs are held over periods of these lengths; None for inputs that follow at once."""
        return replace(self, sample=sample)

    @property
    def in_steps(self) -> bool:
        """True in discrete time or with held inputs: V is then compared at the ends of steps or periods."""
        return self.time == "discrete" or self.sample is not None

    @property
    def uncertain(self) -> tuple[tuple[Symbol, Interval], ...]:
        """The uncertain quantities with their ranges, in the order of the ranges."""
        return tuple((Symbol(name), interval) for name, interval in self.ranges.items())

    def exact_dynamics(self) -> tuple[Expression, ...]:
        """The nominal f: parameters replaced by exact rationals, disturbances by 0; free are states and inputs."""
        return self._with_numbers(())

    def uncertain_dynamics(self) -> tuple[Expression, ...]:
        """f with uncertain quantities free, like states and inputs.

        These are the trees of a certificate: the equations as they were written, with numbers instead of the names that
        have one value.
        """
        return self._with_numbers(self.ranges)

    def uncertain_constraints(self) -> dict[str, Expression]:
        """The constraints' g by name, with uncertain quantities free, like states and inputs."""
        found = self._with_numbers(self.ranges, tuple(self.constraints.values()))
        return dict(zip(self.constraints, found, strict=True))

    def _with_numbers(
        self, acting: Collection[str], expressions: Sequence[Expression] | None = None
    ) -> tuple[Expression, ...]:
        numbers = {Symbol(name): Number(q) for name, q in self.parameters.items() if name not in acting}
        numbers |= {s: Number(0) for s in self.disturbances if s.name not in acting}
        each = self.dynamics if expressions is None else expressions
        return tuple(_substituted(self, e, numbers) for e in each)

    def exact_u_eq(self) -> tuple[Fraction, ...]:
        """The equilibrium input as exact rationals, shape (m,)."""
        return tuple(_rational(self, e, f"u_eq of {s}") for s, e in zip(self.inputs, self.u_eq, strict=True))

    def exact_x_eq(self) -> tuple[Fraction, ...]:
        """The operating point as exact rationals, shape (n,); states are deviations from it."""
        return tuple(_rational(self, e, f"x_eq of {s}") for s, e in zip(self.states, self.x_eq, strict=True))

    def operating_point(self) -> dict[str, Fraction]:
        """x_eq by the names of the states; empty if it is 0."""
        values = self.exact_x_eq()
        return {s.name: q for s, q in zip(self.states, values, strict=True)} if any(values) else {}

    def function(self, module: Module = "numpy") -> Callable[[Any, Any], Any]:
        """Floating-point nominal f: arrays x (..., n) and u (..., m) to xdot (..., n); `module` numpy or torch.

        For simulation and search only: nothing is proved with it.
        """
        f = function_of(self, self.exact_dynamics(), (), module)
        return lambda x, u: f(x, u, ())

    def uncertain_function(self, module: Module = "numpy") -> Callable[[Any, Any, Sequence[Any]], Any]:
        """The same with a third argument: values of the uncertain quantities, k numbers in the order of the ranges."""
        return function_of(self, self.uncertain_dynamics(), [s for s, _ in self.uncertain], module)


def observations_of(system: System) -> tuple[Expression, ...]:
    """A plant's observations as expressions of the states, deviations from the operating point.

    Raises
    ------
    InputError : one depends on a parameter that is uncertain.
    """
    odd = symbols_of(*system.observations) & {s for s, _ in system.uncertain}
    if odd:
        raise InputError(f"an observation of {system.name} must not depend on what is uncertain; found {odd.pop()}.")
    numbers: dict[Symbol, Expression] = {Symbol(name): Number(q) for name, q in system.parameters.items()}
    numbers |= {s: s + q for s, q in zip(system.states, system.exact_x_eq(), strict=True) if q}
    return tuple(_substituted(system, e, numbers) for e in system.observations)


def _substituted(system: System, expression: Expression, numbers: Mapping[Symbol, Expression]) -> Expression:
    """Substitute the numbers; reject the expression if it then divides by 0, or the like."""
    result = substitute(expression, numbers)
    try:
        constant_of(result)
    except InputError as error:
        shown = ", ".join(f"{name} = {q}" for name, q in system.parameters.items()) or "none"
        raise InputError(f"an equation of {system.name} has no value with the parameters {shown}: {error}.") from error
    return result


def _rational(
    system: System, expression: Expression, what: str, parameters: Mapping[str, Fraction] | None = None
) -> Fraction:
    parameters = system.parameters if parameters is None else parameters
    result = _substituted(system, expression, {Symbol(name): Number(q) for name, q in parameters.items()})
    value = value_if_rational(result, {})
    if isinstance(value, str):
        raise InputError(f"{what} in {system.name} {irrational(result)}")
    return value


def irrational(point: Expression) -> str:
    """Say that an entry of the operating point has no rational value, and what to write."""
    value = float(numerical([point], [])()[0])
    digits = f"Write its digits, {value:.17g}, or choose" if math.isfinite(value) else "Choose"
    return (
        f"must be rational, because the equilibrium is decided in rationals; found {point}. {digits} parameters for "
        "which it is rational."
    )
