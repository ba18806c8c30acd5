"""Expressions as trees of nested lists, which is how certificates and solvers get them (checker/FORMAT.md)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import sympy

from certify.errors import CertificateFormatError, InputError

FUNCTIONS: Mapping[str, Any] = {
    "sin": sympy.sin,
    "cos": sympy.cos,
    "tan": sympy.tan,
    "tanh": sympy.tanh,
    "exp": sympy.exp,
    "atan": sympy.atan,
    "sqrt": sympy.sqrt,
}
# The only values that are used exactly, beside square roots of squares of rationals.
AT_ZERO: Mapping[str, int] = {"sin": 0, "cos": 1, "tan": 0, "tanh": 0, "exp": 1, "atan": 0}
CONSTANTS: Mapping[Any, tuple[int, str]] = {sympy.E: (1, "exp"), sympy.pi: (4, "atan")}
"""What sympy makes of exp(1) and 4 atan(1): a multiple of a function at 1."""
GRAMMAR = f"+ - * /, integer powers, {', '.join(FUNCTIONS)}"
Tree = Any  # nested lists: a name, an exact fraction as text, or an operator with its operands


def as_power(expression: sympy.Expr) -> tuple[sympy.Expr, int, int] | None:
    """(base, roots, exponent): so many square roots of the base, one after another, to an integer power.

    sympy writes a square root as the power 1/2 and merges powers; None if the expression is no such power.
    """
    if not expression.is_Pow or not expression.exp.is_Rational:
        return None
    denominator = int(expression.exp.q)
    if denominator & (denominator - 1):
        return None
    return expression.base, denominator.bit_length() - 1, int(expression.exp.p)


def as_function(expression: sympy.Expr) -> tuple[str, sympy.Expr] | None:
    """A function's name and argument; None if the expression is none. Square roots are powers."""
    for name, function in FUNCTIONS.items():
        if name != "sqrt" and isinstance(expression, function):
            return name, expression.args[0]
    return None


def has_tree(node: sympy.Expr) -> bool:
    """Whether a node, apart from its operands, is one that trees have."""
    simple = node.is_Symbol or node.is_Rational or node.is_Add or node.is_Mul or node in CONSTANTS
    return bool(simple or as_power(node) or as_function(node))


def to_tree(expression: sympy.Expr) -> Tree:
    """Nested lists: a name, an exact fraction, or an operator with its operands (FORMAT.md).

    Raises
    ------
    InputError : the expression is outside the grammar.
    """
    if expression.is_Symbol:
        return expression.name
    if expression.is_Rational:
        return str(expression)
    if expression in CONSTANTS:
        multiple, name = CONSTANTS[expression]
        return ["*", str(multiple), [name, "1"]]
    arguments = [to_tree(a) for a in expression.args]
    if expression.is_Add:
        return ["+", *arguments]
    if expression.is_Mul:
        return ["*", *arguments]
    if (power := as_power(expression)) is not None:
        _, roots, exponent = power
        tree = arguments[0]
        for _ in range(roots):
            tree = ["sqrt", tree]
        return tree if exponent == 1 else ["**", tree, exponent]
    if (function := as_function(expression)) is not None:
        return [function[0], arguments[0]]
    raise InputError(f"{expression} is outside the grammar; allowed are {GRAMMAR}.")


def from_tree(tree: Tree, names: Mapping[str, sympy.Symbol]) -> sympy.Expr:
    """The sympy expression of a tree; for pictures and summaries, not for proofs.

    Raises
    ------
    CertificateFormatError : an operator that no certificate has.
    """
    if isinstance(tree, str):
        return names[tree] if tree in names else sympy.Rational(tree)
    operator, arguments = tree[0], tree[1:]
    if operator == "**":
        return from_tree(arguments[0], names) ** int(arguments[1])
    values = [from_tree(a, names) for a in arguments]
    if operator == "+":
        return sympy.Add(*values)
    if operator == "*":
        return sympy.Mul(*values)
    if operator == "-":
        return -values[0] if len(values) == 1 else values[0] - values[1]
    if operator == "/":
        return values[0] / values[1]
    if operator in FUNCTIONS:
        return FUNCTIONS[operator](*values)
    raise CertificateFormatError(f"{operator!r} is no operator of a certificate.")
