"""Gather the constants of an expression, exactly, to make its evaluation cheaper.

`b/(m*l**2)*v` with numbers instead of b, m and l is one number times v; a sum of sums is one sum. That saves
operations where an expression is evaluated on a million boxes. The value is the same at every point, and so are the
points that have one: no operand is omitted, not even one that is multiplied by 0. A claim is about the tree as it was
written; no file contains the gathered one.
"""

from __future__ import annotations

from fractions import Fraction
from math import prod

from certify.errors import InputError
from certify.loop.expressions.tree import Expression, Number, Operation, nodes, total

MOST_BITS = 14_000  # of a number on the way: the checkers allow 2^14, and Python writes 4,300 digits
_MOST_JOINED = 64  # terms


def gathered(expression: Expression) -> Expression:
    """The same function in sums and products with one number each, integer powers, and functions.

    Raises
    ------
    InputError : it divides by a number that is 0, takes the square root of a negative number, or a number grows too
        long.
    """
    if expression.gathered is None:
        for node in nodes(expression):
            node.gathered = node.gathered or _scaled(*_split(node))
    return expression.gathered or expression


def constant_of(expression: Expression) -> Fraction | None:
    """The number that an expression is, if it is one by `+ - * /` and powers of numbers alone; raises as `gathered`."""
    found = gathered(expression)
    return found.value if isinstance(found, Number) else None


def _split(node: Expression) -> tuple[Fraction, Expression | None]:
    """A number and an expression without one, whose product the node is; None stands for 1."""
    if isinstance(node, Number):
        return _short(node.value), None
    if not isinstance(node, Operation):
        return Fraction(1), node
    operator, first = node.operator, node.operands[0]
    if operator == "+":
        return _sum(node.operands)
    if operator == "*":
        return _product([_parts(e) for e in node.operands])
    if operator == "-":
        factor, core = _parts(first)
        return -factor, core
    if operator == "/":
        return _product([_parts(first), _power(*_parts(node.operands[1]), -1)])
    if operator == "**":
        return _power(*_parts(first), node.exponent)
    inner = [gathered(e) for e in node.operands]
    if operator == "sqrt" and isinstance(inner[0], Number) and inner[0].value < 0:
        raise InputError(f"it takes the square root of {inner[0].value}")
    return Fraction(1), Operation(operator, *inner)


def _parts(node: Expression) -> tuple[Fraction, Expression | None]:
    """`_split` with a memo of earlier nodes."""
    found = gathered(node)
    if isinstance(found, Number):
        return found.value, None
    if isinstance(found, Operation) and found.operator == "*" and isinstance(found.operands[0], Number):
        return found.operands[0].value, found.operands[1]
    return Fraction(1), found


def _sum(operands: tuple[Expression, ...]) -> tuple[Fraction, Expression | None]:
    constant, terms = Fraction(0), list[Expression]()
    for operand in operands:
        factor, core = _parts(operand)
        if core is None:
            constant = _short(constant + factor)
        elif abs(factor) == 1 and _is_short_sum(core):
            for term in core.operands:
                inner, of = _parts(term)
                if of is None:
                    constant = _short(constant + factor * inner)
                else:
                    terms.append(_scaled(factor * inner, of))
        else:
            terms.append(_scaled(factor, core))
    if not terms:
        return constant, None
    if constant == 0 and len(terms) == 1:
        return _parts(terms[0])
    return Fraction(1), total([Number(constant), *terms] if constant else terms)


def _is_short_sum(core: Expression) -> bool:
    """True if its terms may join those of a sum around it; a long sum that stands in many others stays one."""
    return isinstance(core, Operation) and core.operator == "+" and len(core.operands) <= _MOST_JOINED


def _product(parts: list[tuple[Fraction, Expression | None]]) -> tuple[Fraction, Expression | None]:
    factor = _short(prod((q for q, _ in parts), start=Fraction(1)))
    cores = [core for _, core in parts if core is not None]
    return factor, Operation("*", *cores) if len(cores) > 1 else cores[0] if cores else None


def _power(factor: Fraction, core: Expression | None, exponent: int) -> tuple[Fraction, Expression | None]:
    if factor == 0 and exponent < 0:
        raise InputError("it divides by 0")
    _short(factor, abs(exponent))
    return factor**exponent, core if core is None or exponent == 1 else Operation("**", core, Number(exponent))


def _scaled(factor: Fraction, core: Expression | None) -> Expression:
    found = Number(factor) if core is None else core if factor == 1 else Operation("*", Number(factor), core)
    found.gathered = found
    return found


def _short(q: Fraction, times: int = 1) -> Fraction:
    """The number, if its numerator and denominator, and those of its power, are not too long."""
    if times * max(q.numerator.bit_length(), q.denominator.bit_length()) > MOST_BITS:
        raise InputError(f"a number on the way has more than {MOST_BITS} bits")
    return q
