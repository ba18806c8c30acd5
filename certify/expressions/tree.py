"""Expressions as trees of nested lists, which is how certificates and solvers get them (checker/FORMAT.md)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import sympy

from certify.errors import CertificateFormatError, InputError

FUNCTIONS: Mapping[str, Any] = {"sin": sympy.sin, "cos": sympy.cos, "tan": sympy.tan}
AT_ZERO: Mapping[str, int] = {"sin": 0, "cos": 1, "tan": 0}  # the only values that are used exactly
Tree = Any  # nested lists: a name, an exact fraction as text, or an operator with its operands


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
    arguments = [to_tree(a) for a in expression.args]
    if expression.is_Add:
        return ["+", *arguments]
    if expression.is_Mul:
        return ["*", *arguments]
    if expression.is_Pow and expression.exp.is_Integer:
        return ["**", arguments[0], int(expression.exp)]
    for name, function in FUNCTIONS.items():
        if isinstance(expression, function):
            return [name, arguments[0]]
    known_names = ", ".join(FUNCTIONS)
    raise InputError(f"{expression} is outside the grammar; allowed are + - * /, integer powers, {known_names}.")


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
