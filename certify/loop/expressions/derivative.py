"""Derivatives of expressions, as expressions.

A derivative has a value wherever the expression has one and is differentiable. Nothing is cancelled, so that its bounds
are bounds of a Jacobian. That of abs(v) is `sign(v)` times that of v, an operator which no equation has: in floats 1 at
v = 0, and elsewhere no number where the sign is not certain, or [-1, 1] where slopes between two states are meant.
"""

from __future__ import annotations

from certify.loop.expressions.tree import (
    Expression,
    Number,
    Operation,
    Symbol,
    cos,
    in_absolute_values,
    nodes,
    sin,
    total,
)


def differentiate(expression: Expression, by: Symbol) -> Expression:
    """d/dx of an expression, for a symbol x; 0 if x does not occur in it.

    >>> from certify.loop.expressions.tree import symbols
    >>> x, y = symbols(["x", "y"])
    >>> differentiate(x * sin(x) + y / x, x)
    sin(x) + cos(x)*x - y/x**2
    """
    expression = in_absolute_values(expression)
    slopes: dict[Expression, Expression | None] = {}  # None stands for what does not depend on x
    for node in nodes(expression):
        slopes[node] = Number(1) if node is by else None
        if isinstance(node, Operation) and any(slopes[e] is not None for e in node.operands):
            slopes[node] = _slope(node, [slopes[e] for e in node.operands])
    return slopes[expression] or Number(0)


def _slope(node: Operation, slopes: list[Expression | None]) -> Expression:
    first, slope = node.operands[0], slopes[0]
    if node.operator == "+":
        return total(s for s in slopes if s is not None)
    if node.operator == "*":
        return total(
            _times(s, [e for k, e in enumerate(node.operands) if k != j]) for j, s in enumerate(slopes) if s is not None
        )
    if node.operator == "/":
        (_, below), fall = node.operands, slopes[1]
        terms = [] if slope is None else [slope / below]
        return total(terms if fall is None else [*terms, -_times(fall, [first / below**2])])
    slope = slope or Number(0)
    if node.operator == "-":
        return -slope
    if node.operator == "**":
        k = node.exponent
        power = [] if k == 1 else [first ** (k - 1) if k > 0 else node / first]
        return _times(slope, [Number(k), *power])
    return _times(slope, [_of_function(node, first)])


def _of_function(node: Operation, at: Expression) -> Expression:
    """phi'(v) of a function phi, given phi(v)."""
    one = Number(1)
    match node.operator:
        case "sin":
            return cos(at)
        case "cos":
            return -sin(at)
        case "tan":
            return one + node**2
        case "tanh":
            return one - node**2
        case "exp":
            return node
        case "atan":
            return one / (one + at**2)
        case "abs":
            return Operation("sign", at)
        case "heaviside":  # where the sign is certain
            return Operation("*", Number(0), Operation("sign", at))
    return one / (2 * node)  # sqrt


def _times(slope: Expression, factors: list[Expression]) -> Expression:
    """The slope by the chain or product rule; a slope 1 is omitted."""
    product = [*factors] if slope is Number(1) else [slope, *factors]
    return Operation("*", *product) if len(product) > 1 else product[0] if product else slope
