"""Power series in time of everything in the equations, while the inputs are held: x + x_1 t + x_2 t^2 + ...

A coefficient may be any kind of number that has `+`, `*`, unary `-`, `scaled` and `function(name)`. Each rule below
gives the coefficient of t^k from those of the operands up to t^k, so that all series are continued together, one order
at a time, in the order in which the equations' operations were written down; x_(k+1) is f_k / (k + 1).

What is uncertain may change within the period. A coefficient then stands for the mean of what the rule gives for the
values at several instants; so it must hold that for any choice of one value for each place where a quantity stands. For
that reason no rule knows that two of its factors come from the same series: a square is a product of any two.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol, Self

from flint import arb, fmpq

from .expressions import Called, Equations
from .refusal import Refused


class Number(Protocol):
    def __add__(self, other: Self, /) -> Self: ...
    def __mul__(self, other: Self, /) -> Self: ...
    def __neg__(self) -> Self: ...
    def scaled(self, k: arb) -> Self: ...
    def function(self, name: str) -> Self: ...
    def sign(self) -> int: ...


Coefficient = Any  # a Number, or None where it is 0 by the rules alone
Rule = Callable[[int], Coefficient]
Constant = Callable[[fmpq], Any]


class Term:
    """One series: `c` holds its coefficients so far, `rule` gives the next."""

    def __init__(self, tape: Tape, rule: Rule) -> None:
        self.tape, self.rule, self.c = tape, rule, list[Coefficient]()
        tape.terms.append(self)

    def __add__(self, other: Term) -> Term:
        return Term(self.tape, lambda k: added([self.c[k], other.c[k]]))

    def __neg__(self) -> Term:
        return Term(self.tape, lambda k: negative(self.c[k]))

    def __mul__(self, other: Term) -> Term:
        return Term(self.tape, lambda k: convolved(self.c, other.c, k))

    def function(self, name: str) -> Term:
        return FUNCTIONS[name](self)


class Tape:
    """All series of a plant's equations, each after its operands."""

    def __init__(self, constant: Constant) -> None:
        self.constant, self.terms = constant, list[Term]()

    def still(self, value: Coefficient) -> Term:
        """A constant in time."""
        return Term(self, lambda k: None if k else value)

    def extend(self) -> None:
        """Every series by one coefficient."""
        for term in self.terms:
            term.c.append(term.rule(len(term.c)))


def coefficients(
    dynamics: Equations,
    states: Mapping[str, Any],
    held: Mapping[str, Any],
    constant: Constant,
    order: int,
    settled: Callable[[Any], Any],
) -> list[list[Coefficient]]:
    """x_1 to x_order of each state, None where it is 0, from states where they start and what does not move.

    `settled` makes of each coefficient what is known of it beyond the arithmetic.
    """
    tape, found = Tape(constant), list[list[Coefficient]]()

    def moving(i: int, start: Any) -> Term:
        return Term(tape, lambda k: found[k - 1][i] if k else start)

    names = {name: moving(i, start) for i, (name, start) in enumerate(states.items())}
    names |= {name: tape.still(value) for name, value in held.items()}
    results = dynamics.evaluate(names, lambda q: tape.still(constant(q)))
    for k in range(1, order + 1):
        tape.extend()
        each = [scaled(f.c[-1], arb(1) / k) for f in results]
        found.append([None if x is None else settled(x) for x in each])
    return found


def along(
    expressions: Equations,
    states: Mapping[str, Any],
    rates: Mapping[str, Any],
    constant: Constant,
    called: Called | None = None,
) -> list[list[Coefficient]]:
    """The value of each expression and its derivative where the states move at these rates."""
    tape = Tape(constant)

    def moving(name: str) -> Term:
        return Term(tape, lambda k: rates[name] if k else states[name])

    names = {name: moving(name) for name in states}
    results = expressions.evaluate(names, lambda q: tape.still(constant(q)), called)
    for _ in range(2):
        tape.extend()
    return [value.c for value in results]


# -------------------------------------------------------------------------------------------------- sums without zeros


def added(terms: Sequence[Coefficient]) -> Coefficient:
    result = None
    for term in terms:
        if term is not None:
            result = term if result is None else result + term
    return result


def negative(v: Coefficient) -> Coefficient:
    return None if v is None else -v


def times(v: Coefficient, w: Coefficient) -> Coefficient:
    return None if v is None or w is None else v * w


def scaled(v: Coefficient, factor: arb) -> Coefficient:
    return None if v is None else v.scaled(factor)


def convolved(v: Sequence[Coefficient], w: Sequence[Coefficient], k: int) -> Coefficient:
    """(v w)_k = sum v_i w_(k - i)."""
    return added([times(v[i], w[k - i]) for i in range(k + 1)])


def chained(v: Sequence[Coefficient], slope: Sequence[Coefficient], k: int) -> Coefficient:
    """phi(v)_k from k phi(v)_k = sum over j = 1..k of j v_j phi'(v)_(k - j), for k >= 1."""
    return scaled(added([scaled(times(v[j], slope[k - j]), arb(j)) for j in range(1, k + 1)]), arb(1) / k)


# ------------------------------------------------------------------------------------------------------- the functions


def first(v: Term, name: str, beyond: Rule) -> Term:
    """phi(v), whose first coefficient is the function of that of v."""
    return Term(v.tape, lambda k: beyond(k) if k else v.c[0].function(name))


def exp(v: Term) -> Term:
    result = first(v, "exp", lambda k: chained(v.c, result.c, k))
    return result


def sin_and_cos(v: Term) -> tuple[Term, Term]:
    """Each has the other's coefficients below its own: at order k both have them up to k - 1."""
    sin = first(v, "sin", lambda k: chained(v.c, cos.c, k))
    cos = first(v, "cos", lambda k: negative(chained(v.c, sin.c, k)))
    return sin, cos


def tanh(v: Term) -> Term:
    """tanh' = 1 - tanh^2, a series behind that of tanh, of which the orders below k are enough."""
    result = first(v, "tanh", lambda k: chained(v.c, slope.c, k))
    slope = v.tape.still(v.tape.constant(fmpq(1))) + -(result * result)
    return result


def atan(v: Term) -> Term:
    """atan' = 1 / (1 + v^2)."""
    slope = inverse(v.tape.still(v.tape.constant(fmpq(1))) + v * v)
    return first(v, "atan", lambda k: chained(v.c, slope.c, k))


def inverse(v: Term) -> Term:
    """v_0 (1/v)_k = - sum over j >= 1 of v_j (1/v)_(k - j)."""

    def beyond(k: int) -> Coefficient:
        left = added([times(v.c[j], result.c[k - j]) for j in range(1, k + 1)])
        return negative(times(left, result.c[0]))

    result = first(v, "1/", beyond)
    return result


def sqrt(v: Term) -> Term:
    """2 w_0 w_k = v_k - sum over 0 < j < k of w_j w_(k - j)."""

    def beyond(k: int) -> Coefficient:
        both = added([times(result.c[j], result.c[k - j]) for j in range(1, k)])
        left = added([v.c[k], negative(both)])
        return None if left is None else scaled(times(left, result.c[0].function("1/")), arb(1) / 2)

    result = first(v, "sqrt", beyond)
    return result


def absolute(v: Term) -> Term:
    """sign(v_0) v_k, if the sign is certain or v_k is 0."""

    def beyond(k: int) -> Coefficient:
        sign = 0 if v.c[k] is None else v.c[0].sign()
        if v.c[k] is not None and not sign:
            raise Refused("ring", "leaf", "abs of what may vanish")
        return v.c[k] if sign >= 0 else negative(v.c[k])

    return first(v, "abs", beyond)


FUNCTIONS: dict[str, Callable[[Term], Term]] = {
    "sin": lambda v: sin_and_cos(v)[0],
    "cos": lambda v: sin_and_cos(v)[1],
    "exp": exp,
    "tanh": tanh,
    "atan": atan,
    "1/": inverse,
    "sqrt": sqrt,
    "abs": absolute,
}
