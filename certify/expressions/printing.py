"""Expressions as text, in the notation in which plant files are written."""

from __future__ import annotations

from decimal import Decimal
from fractions import Fraction

from certify.expressions.tree import Expression, Number, Operation, Symbol

_DIGITS = 17  # of a decimal number; longer ones are written as fractions

SUM, PRODUCT, MINUS, POWER, ATOM = range(5)
"""How tightly a node binds: what binds less than its place asks for is put into brackets."""


def binding(node: Expression) -> int:
    """How tightly a node binds where it is written out."""
    if isinstance(node, Number):
        plain = decimal_text(node.value) is not None
        return PRODUCT if not plain else MINUS if node.value < 0 else ATOM
    if not isinstance(node, Operation):
        return ATOM
    return {"+": SUM, "*": PRODUCT, "/": PRODUCT, "-": MINUS, "**": POWER}.get(node.operator, ATOM)


def text(expression: Expression) -> str:
    """An expression as a plant file has it: reading the text gives an expression of the same value.

    >>> from certify.expressions.tree import sin, symbols
    >>> g, l, x = symbols(["g", "l", "x"])
    >>> text(g / l * sin(x) - x / (l * x**2))
    'g/l*sin(x) - x/(l*x**2)'
    """
    return _Text({})(expression, SUM)


class _Text:
    def __init__(self, known: dict[Expression, str]) -> None:
        self.known = known

    def __call__(self, node: Expression, at_least: int) -> str:
        if node not in self.known:
            self.known[node] = self._written(node)
        return f"({self.known[node]})" if binding(node) < at_least else self.known[node]

    def _written(self, node: Expression) -> str:
        if isinstance(node, Symbol):
            return node.name
        if isinstance(node, Number):
            return decimal_text(node.value) or str(node.value)
        if not isinstance(node, Operation):
            return object.__repr__(node)
        first, *rest = node.operands
        if node.operator == "+":
            return self(first, SUM) + "".join(map(self._term, rest))
        if node.operator == "*":
            return "*".join([self(first, PRODUCT), *(self(e, POWER) for e in rest)])
        if node.operator == "/":
            return f"{self(first, PRODUCT)}/{self(rest[0], POWER)}"
        if node.operator == "-":
            return f"-{self(first, POWER)}"
        if node.operator == "**":
            return f"{self(first, ATOM)}**{node.exponent if node.exponent > 0 else f'({node.exponent})'}"
        return f"{node.operator}({self(first, SUM)})"

    def _term(self, node: Expression) -> str:
        """` + b`, or ` - b` of what begins with a minus."""
        if isinstance(node, Operation) and node.operator == "-":
            return f" - {self(node.operands[0], PRODUCT)}"
        if isinstance(node, Number) and node.value < 0:
            return f" - {self(Number(-node.value), PRODUCT)}"
        return f" + {self(node, PRODUCT)}"


def decimal_text(q: Fraction) -> str | None:
    """A rational in decimal digits, if a few of them are all.

    >>> decimal_text(Fraction(981, 100)), decimal_text(Fraction(1, 3))
    ('9.81', None)
    """
    short = f"{Decimal(q.numerator) / Decimal(q.denominator):.{_DIGITS}g}" if abs(q) < 10**_DIGITS else str(q)
    return short if "e" not in short and Fraction(short) == q else None
