"""The plant `xdot = f(x, u)`, or `x+ = f(x, u)`: expressions as they were written, over exact rational parameters.

Numbers are exact because the proof is about *this* plant: `m = 0.15` written as text is 3/20, while a
Python float stands for its binary value; an expression that contains one is refused. Nothing simplifies an equation
either: parameters are replaced by their values and deviations by `x_eq + x`, and the tree stays what it was.

Everything works in deviations from the operating point x_eq: the claims, the certificate and the policy are about
`x - x_eq`, whose equilibrium is the origin. So no rule of the checkers uses x_eq; it is for people, and only
`in_deviations` moves equations there.
"""

from __future__ import annotations

import itertools
import math
import random
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from decimal import Decimal, InvalidOperation
from fractions import Fraction
from types import MappingProxyType
from typing import Any, Literal, get_args

import numpy as np

from certify.errors import InputError
from certify.loop.expressions import (
    Expression,
    Number,
    Operation,
    Symbol,
    as_expression,
    constant_of,
    evaluate_exactly,
    nodes,
    numerical,
    substitute,
    symbols,
    symbols_of,
    value_if_rational,
)
from certify.loop.expressions.gathering import MOST_BITS
from certify.loop.expressions.numerical import Module
from certify.loop.plants.ode import rk4_step

Interval = tuple[Fraction, Fraction]
Kind = Literal["parameter", "disturbance", "input error"]
Time = Literal["continuous", "discrete"]

_SUBSTEPS = 2  # of a sampling period, in simulation
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
        powers, sin, cos, tan, tanh, exp, atan and sqrt.
    u_eq : m expressions in the parameters; `f(0, u_eq) = 0` is proved later, not assumed.
    domain : n intervals `(lo, hi)` with `lo < 0 < hi`, in the units of the states.
    input_bounds : m intervals `(lo, hi)` with `lo < hi`, in the units of the inputs.
    positive : names of parameters that must be positive (masses, lengths, ...).
    units : unit of each state, input and parameter by name.
    description : one line for people.
    x_eq : n expressions in the parameters, with rational values; empty means zeros. `dynamics` and `domain` are in
        deviations from it already (`in_deviations` brings equations there), so that nothing of what is proved depends
        on it.
    disturbances : symbols of the dynamics that are 0 unless they have a range.
    ranges : intervals by name, of uncertain parameters and of disturbances that act; values may change at any
    time. A parameter's value in `parameters` lies in its range and is the nominal one, which u_eq, the
    linearisation and simulation use.
    time : `continuous`, or `discrete`: then the equations are those of x+, the state one step later.
    sample : the shortest and longest sampling period of a continuous plant; None if the input follows the
        state at once.

    Raises
    ------
    InputError : counts do not match, a domain does not contain 0 in its interior, a parameter that
        must be positive is not, an expression is outside the grammar, x_eq is irrational, or a name with a range is
    neither a parameter nor a disturbance.
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

    def __post_init__(self) -> None:
        object.__setattr__(self, "parameters", MappingProxyType(dict(self.parameters)))
        object.__setattr__(self, "ranges", MappingProxyType(dict(self.ranges)))
        object.__setattr__(self, "units", MappingProxyType(dict(self.units)))
        n, m = len(self.states), len(self.inputs)
        for symbol in (*self.states, *self.inputs, *self.disturbances):
            if not isinstance(symbol, Symbol):
                raise InputError(f"a name in {self.name} must be one of certify.symbols; found {symbol!r}.")
        object.__setattr__(self, "x_eq", tuple(self.x_eq) or (Number(0),) * n)
        for key in ("dynamics", "u_eq", "x_eq"):
            try:
                object.__setattr__(self, key, tuple(map(as_expression, getattr(self, key))))
                for equation in getattr(self, key):
                    constant_of(equation)
            except InputError as error:
                raise InputError(f"`{key}` of {self.name}: {error}") from error
        for label, found, wanted in (
            ("dynamics", len(self.dynamics), n),
            ("domain", len(self.domain), n),
            ("u_eq", len(self.u_eq), m),
            ("input_bounds", len(self.input_bounds), m),
            ("x_eq", len(self.x_eq), n),
        ):
            if found != wanted:
                raise InputError(f"`{label}` of {self.name} must have {wanted} entries; found {found}.")
        if n == 0 or m == 0:
            raise InputError(f"{self.name} must have at least one state and one input.")
        names = [s.name for s in (*self.states, *self.inputs, *self.disturbances)] + list(self.parameters)
        for name in (self.name, *names):
            if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]{0,63}", name):
                raise InputError(f"names in {self.name} must be identifiers of at most 64 letters; found {name!r}.")
        if len(set(names)) != len(names):
            raise InputError(
                f"names of states, inputs, parameters and disturbances of {self.name} must differ; found {names}."
            )
        for symbol, (lo, hi) in zip(self.states, self.domain, strict=True):
            if not lo < 0 < hi:
                raise InputError(
                    f"the domain of {symbol} must contain 0 in its interior, as a deviation from x_eq; "
                    f"found [{float(lo)}, {float(hi)}]."
                )
        for symbol, (lo, hi) in zip(self.inputs, self.input_bounds, strict=True):
            if not lo < hi:
                raise InputError(f"the bounds of {symbol} must satisfy lo < hi; found [{float(lo)}, {float(hi)}].")
        for name in sorted(self.positive):
            if name not in self.parameters:
                known = ", ".join(self.parameters) or "none"
                raise InputError(f"`positive` of {self.name} must name parameters, {known}; found {name!r}.")
            if not self.parameters[name] > 0:
                raise InputError(f"parameter {name} of {self.name} must be positive; found {self.parameters[name]}.")
        for name, q in self.parameters.items():
            if max(q.numerator.bit_length(), q.denominator.bit_length()) > MOST_BITS:
                raise InputError(f"parameter {name} of {self.name} must have at most {MOST_BITS} bits; it has more.")
        parameters = {Symbol(p) for p in self.parameters}
        everything = {*self.states, *self.inputs, *parameters, *self.disturbances}
        for allowed, equations in ((everything, self.dynamics), (parameters, (*self.u_eq, *self.x_eq))):
            for node in nodes(*equations):
                if isinstance(node, Symbol) and node not in allowed:
                    raise InputError(
                        f"an equation of {self.name} uses {node}, which is no state, input, parameter or disturbance."
                    )
        self.exact_x_eq()
        self._check_ranges()
        self._check_time()

    def __reduce__(self) -> tuple[type[System], tuple[Any, ...]]:
        """Pickle the fields, with read-only mappings as dictionaries; unpickling checks them again."""
        values = (getattr(self, each.name) for each in fields(self))
        return System, tuple(dict(v) if isinstance(v, MappingProxyType) else v for v in values)

    def _check_ranges(self) -> None:
        acting, fixed = {s.name for s in self.disturbances}, {s.name for s in symbols_of(*self.x_eq)}
        for name, (lo, hi) in self.ranges.items():
            if name not in self.parameters and name not in acting:
                known = ", ".join([*self.parameters, *sorted(acting)]) or "none"
                raise InputError(f"{self.name} has no parameter or disturbance {name!r}; it has: {known}.")
            if name in fixed:
                raise InputError(
                    f"{name} must have one value, because the operating point of {self.name} depends on it; found the "
                    f"range [{float(lo):g}, {float(hi):g}]."
                )
            nominal = self.parameters.get(name, Fraction(0))
            if not (lo < hi and lo <= nominal <= hi):
                raise InputError(
                    f"the range of {name} must satisfy lo < hi and hold its nominal value {float(nominal):g}; found "
                    f"[{float(lo):g}, {float(hi):g}]."
                )
            if name in self.positive and not lo > 0:
                raise InputError(f"parameter {name} of {self.name} must be positive; found {float(lo):g} in its range.")

    def _check_time(self) -> None:
        if self.time not in get_args(Time):
            raise InputError(f"`time` of {self.name} must be one of {get_args(Time)}; found {self.time!r}.")
        if self.sample is None:
            return
        if self.time == "discrete":
            raise InputError(
                f"{self.name} is a plant in discrete time, whose steps are its samples: leave out `sample`."
            )
        lo, hi = self.sample
        if not 0 <= lo <= hi or not hi > 0:
            raise InputError(
                f"`sample` must be a positive time, or two with 0 <= lo <= hi; found {float(lo):g} and {float(hi):g}."
            )

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
        moved = [self._rational(e, f"x_eq of {s}", parameters) for s, e in zip(self.states, self.x_eq, strict=True)]
        shifts = [old - new for old, new in zip(self.exact_x_eq(), moved, strict=True)]
        domain = tuple((lo + shift, hi + shift) for (lo, hi), shift in zip(self.domain, shifts, strict=True))
        return replace(self, parameters=parameters, domain=domain)

    def seen_from(self, origin: Sequence[Fraction], u: Sequence[Fraction]) -> System:
        """The same plant in deviations from another point, `origin` (n,) in today's deviations, with u_eq = u, (m,),
        the inputs there: the operating point and the box keep their places.

        Raises
        ------
        InputError : the point does not lie in the interior of the domain.
        """
        by = map(Number, origin)
        x_eq = tuple(q if e == Number(0) else e + q if q.value else e for e, q in zip(self.x_eq, by, strict=True))
        return replace(
            self,
            dynamics=in_deviations(self.dynamics_of_values(), self.states, x_eq, self.time),
            u_eq=tuple(map(Number, u)),
            x_eq=x_eq,
            domain=tuple((lo - q, hi - q) for (lo, hi), q in zip(self.domain, origin, strict=True)),
        )

    def with_domain(self, bounds: Mapping[str, Interval]) -> System:
        """The same plant on another box; unknown state names are rejected."""
        names = [s.name for s in self.states]
        for name in bounds:
            if name not in names:
                raise InputError(f"{self.name} has no state {name!r}; it has: {', '.join(names)}.")
        domain = tuple(bounds.get(name, old) for name, old in zip(names, self.domain, strict=True))
        return replace(self, domain=domain)

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

    def with_input_errors(self, bounds: Mapping[str, Fraction]) -> System:
        """The same plant with u + e instead of u, |e| at most the bound, for the inputs that are named."""
        by_name, names = {s.name: s for s in self.inputs}, list[str]()
        moved: dict[Expression, Expression] = {}
        for name, bound in bounds.items():
            if name not in by_name or not bound > 0:
                raise InputError(
                    f"an input error must be a positive bound for one of {', '.join(by_name)}; found {name} = {bound}."
                )
            names.append(f"error_{name}")
            moved[by_name[name]] = Operation("+", by_name[name], Symbol(names[-1]))
        ranges = {error: (-bound, bound) for error, bound in zip(names, bounds.values(), strict=True)}
        units = {error: self.units[name] for error, name in zip(names, bounds, strict=True) if name in self.units}
        return replace(
            self,
            dynamics=tuple(substitute(e, moved) for e in self.dynamics),
            disturbances=(*self.disturbances, *symbols(names)),
            ranges={**self.ranges, **ranges},
            units={**self.units, **units},
        )

    @property
    def in_steps(self) -> bool:
        """True in discrete time or with held inputs: V is then compared at the ends of steps or periods."""
        return self.time == "discrete" or self.sample is not None

    @property
    def rests_where(self) -> str:
        """The value of f(x_eq, u_eq) at an equilibrium, as text."""
        return "0" if self.time == "continuous" else "x_eq"

    @property
    def uncertain(self) -> tuple[tuple[Symbol, Interval], ...]:
        """The uncertain quantities with their ranges, in the order of the ranges."""
        return tuple((Symbol(name), interval) for name, interval in self.ranges.items())

    @property
    def input_errors(self) -> Mapping[str, str]:
        """The input errors: each uncertain quantity's name, by the name of its input.

        An uncertain error_u is an input error if u and error_u occur in the equations only as u + error_u. The name
        alone does not suffice: a file may give it to anything.
        """
        found = {}
        for u in self.inputs:
            error = Symbol(f"error_{u.name}")
            acting = Operation("+", u, error)
            free = symbols_of(*(substitute(e, {acting: Number(0)}) for e in self.dynamics))
            acts = acting in nodes(*self.dynamics)
            if error.name in self.ranges and acts and not free & {u, error}:
                found[u.name] = error.name
        return found

    def kind_of(self, name: str) -> Kind:
        """The kind of the uncertain quantity with this name."""
        if name in self.input_errors.values():
            return "input error"
        return "parameter" if name in self.parameters else "disturbance"

    def at(self, values: Mapping[str, Fraction]) -> System:
        """The plant without uncertainty, where parameters and disturbances have these values.

        u_eq stays that of the nominal parameters: it belongs to the policy, which does not know these values.
        """
        known = {name: q for name, q in values.items() if name in self.parameters}
        held = {s: Number(values.get(s.name, Fraction(0))) for s in self.disturbances}
        dynamics = tuple(substitute(e, held) for e in self.dynamics)
        u_eq = tuple(map(Number, self.exact_u_eq()))
        return replace(self.with_parameters(known), dynamics=dynamics, u_eq=u_eq, disturbances=(), ranges={})

    def corners(self, most: int = 64) -> tuple[dict[str, Fraction], ...]:
        """The vertices of the box of ranges, in a fixed order; if there are more than `most`, some of them."""
        vertices = list(itertools.islice(itertools.product((0, 1), repeat=len(self.ranges)), most))
        if 2 ** len(self.ranges) > most:
            drawn = random.Random(0)
            vertices = [tuple(drawn.randint(0, 1) for _ in self.ranges) for _ in range(most)]
        return tuple(
            {name: ends[side] for (name, ends), side in zip(self.ranges.items(), vertex, strict=True)}
            for vertex in vertices
        )

    def exact_dynamics(self) -> tuple[Expression, ...]:
        """The nominal f: parameters replaced by exact rationals, disturbances by 0; free are states and inputs."""
        return self._with_numbers(())

    def uncertain_dynamics(self) -> tuple[Expression, ...]:
        """f with uncertain quantities free, like states and inputs.

        These are the trees of a certificate: the equations as they were written, with numbers instead of the names that
        have one value.
        """
        return self._with_numbers(self.ranges)

    def _with_numbers(self, acting: Collection[str]) -> tuple[Expression, ...]:
        numbers = {Symbol(name): Number(q) for name, q in self.parameters.items() if name not in acting}
        numbers |= {s: Number(0) for s in self.disturbances if s.name not in acting}
        return tuple(self._substituted(e, numbers) for e in self.dynamics)

    def exact_u_eq(self) -> tuple[Fraction, ...]:
        """The equilibrium input as exact rationals, shape (m,)."""
        return tuple(self._rational(e, f"u_eq of {s}") for s, e in zip(self.inputs, self.u_eq, strict=True))

    def exact_x_eq(self) -> tuple[Fraction, ...]:
        """The operating point as exact rationals, shape (n,); states are deviations from it."""
        return tuple(self._rational(e, f"x_eq of {s}") for s, e in zip(self.states, self.x_eq, strict=True))

    def operating_point(self) -> dict[str, Fraction]:
        """x_eq by the names of the states; empty if it is 0."""
        values = self.exact_x_eq()
        return {s.name: q for s, q in zip(self.states, values, strict=True)} if any(values) else {}

    def dynamics_of_values(self) -> tuple[Expression, ...]:
        """f over the states' values x_eq + x, as people write it, with the parameters by name."""
        found, none = self.dynamics, Number(0)
        shifts = [(s, at) for s, at in zip(self.states, self.x_eq, strict=True) if at != none]
        if self.time == "discrete":
            found = tuple(_without(e, at) for e, at in zip(found, self.x_eq, strict=True))
        whole = {Operation("+", at, s): Symbol(f" {s.name}") for s, at in shifts}
        rest = {s: Operation("+", s, -at) for s, at in shifts}
        plain = {Symbol(f" {s.name}"): s for s, _ in shifts}
        return tuple(substitute(substitute(substitute(e, whole), rest), plain) for e in found)

    def domain_of_values(self) -> tuple[Interval, ...]:
        """The domain's intervals of the states' values x_eq + x."""
        return tuple((lo + q, hi + q) for (lo, hi), q in zip(self.domain, self.exact_x_eq(), strict=True))

    def residuals(self) -> dict[str, Fraction | float]:
        """Each state's f(0, u_eq): exact, or rounded if a function is evaluated at another point than 0."""
        at_rest: dict[Symbol, Fraction] = dict.fromkeys(self.states, Fraction(0))
        at_rest |= dict(zip(self.inputs, self.exact_u_eq(), strict=True))
        found: dict[str, Fraction | float] = {}
        for symbol, expression in zip(self.states, self.exact_dynamics(), strict=True):
            try:
                found[symbol.name] = evaluate_exactly(expression, at_rest)
            except InputError:
                with np.errstate(all="ignore"):
                    rounded = numerical([expression], list(at_rest))(*(np.float64(q) for q in at_rest.values()))
                found[symbol.name] = float(rounded[0]) if np.isfinite(rounded[0]) else math.nan
        return found

    def function(self, module: Module = "numpy") -> Callable[[Any, Any], Any]:
        """Floating-point nominal f: arrays x (..., n) and u (..., m) to xdot (..., n); `module` numpy or torch.

        For simulation and search only: nothing is proved with it.
        """
        f = self._function(self.exact_dynamics(), (), module)
        return lambda x, u: f(x, u, ())

    def uncertain_function(self, module: Module = "numpy") -> Callable[[Any, Any, Sequence[Any]], Any]:
        """The same with a third argument: values of the uncertain quantities, k numbers in the order of the ranges."""
        return self._function(self.uncertain_dynamics(), [s for s, _ in self.uncertain], module)

    def mean_rate(self, f: Callable[[Any, Any], Any], x: Any, u: Any, step: Any) -> Any:
        """G (..., n) of `x+ = x + h G` in floating point, from this plant's f, with the input held over the step h.

        f itself where h is the number 0; in discrete time h = 1 and G = f - x; else h may be an array (..., 1) of
        positive numbers. For search only: nothing is proved with it.
        """
        if self.time == "discrete":
            return f(x, u) - x
        if isinstance(step, float | int) and step == 0:
            return f(x, u)
        after = x
        for _ in range(_SUBSTEPS):
            after = rk4_step(lambda y: f(y, u), after, step / _SUBSTEPS)
        return (after - x) / step

    def _function(
        self, expressions: Sequence[Expression], more: Sequence[Symbol], module: Module
    ) -> Callable[[Any, Any, Sequence[Any]], Any]:
        stack: Any
        broadcast: Any
        number: Callable[[Any, Any], Any]
        if module == "numpy":
            stack, broadcast, number = np.stack, np.broadcast_arrays, _as_it_is
        elif module == "torch":
            import torch

            stack, broadcast, number = torch.stack, torch.broadcast_tensors, _as_tensor
        else:
            raise InputError(f"`module` must be 'numpy' or 'torch'; found {module!r}.")
        raw = numerical(expressions, [*self.states, *self.inputs, *more], module)
        n, m = self.n, self.m

        def f(x: Any, u: Any, values: Sequence[Any]) -> Any:
            columns: list[Any] = [x[..., i] for i in range(n)] + [u[..., j] for j in range(m)]
            zero = 0.0 * (columns[0] + columns[n])  # constant components take the batch's shape
            held = [number(value, x) for value in values]
            return stack(tuple(broadcast(*[value + zero for value in raw(*columns, *held)])), -1)

        return f

    def _substituted(self, expression: Expression, numbers: Mapping[Symbol, Number]) -> Expression:
        """Substitute the numbers; reject the expression if it then divides by 0, or the like."""
        result = substitute(expression, numbers)
        try:
            constant_of(result)
        except InputError as error:
            shown = ", ".join(f"{name} = {q}" for name, q in self.parameters.items()) or "none"
            raise InputError(
                f"an equation of {self.name} has no value with the parameters {shown}: {error}."
            ) from error
        return result

    def _rational(
        self, expression: Expression, what: str, parameters: Mapping[str, Fraction] | None = None
    ) -> Fraction:
        parameters = self.parameters if parameters is None else parameters
        result = self._substituted(expression, {Symbol(name): Number(q) for name, q in parameters.items()})
        value = value_if_rational(result, {})
        if isinstance(value, str):
            raise InputError(
                f"{what} in {self.name} must be rational, because the equilibrium is decided in rationals; "
                f"found {result}. Choose parameters for which it is, or make it a parameter itself."
            )
        return value


def _as_it_is(value: Any, _: Any) -> Any:
    return value


def _as_tensor(value: Any, like: Any) -> Any:
    """A number as a tensor: torch has no power, and no function, of a plain one."""
    import torch

    return torch.as_tensor(value, dtype=like.dtype, device=like.device)


def in_deviations(
    equations: Sequence[Expression | Fraction],
    states: Sequence[Symbol],
    x_eq: Sequence[Expression | Fraction],
    time: Time = "continuous",
) -> tuple[Expression, ...]:
    """Equations in the states' values as equations in deviations from x_eq: each state s becomes `x_eq_s + s`.

    A rate is the same there; the state one step later is a deviation as well. Where x_eq is 0 nothing changes.

    >>> h, h0 = symbols(["h", "h0"])
    >>> in_deviations([1 - h0 / h], [h], [h0])
    (1 - h0/(h0 + h),)
    """
    none = Number(0)
    shifts = [None if at is none else at for at in map(as_expression, x_eq)]
    values = {s: Operation("+", at, s) for s, at in zip(states, shifts, strict=True) if at is not None}
    moved = [substitute(as_expression(e), values) for e in equations]
    if time == "continuous":
        return tuple(moved)
    return tuple(e if at is None else Operation("+", e, -at) for e, at in zip(moved, shifts, strict=True))


def _without(equation: Expression, at: Expression) -> Expression:
    """The equation of a state's value one step later, from that of its deviation from `at`."""
    if at == Number(0):
        return equation
    if isinstance(equation, Operation) and equation.operator == "+" and equation.operands[1:] == (-at,):
        return equation.operands[0]
    return Operation("+", equation, at)
