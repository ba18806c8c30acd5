"""Expressions as nested lists, as a certificate has them (checker/FORMAT.md)."""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction
from typing import Any

from certify.errors import CertificateFormatError, InputError
from certify.loop.expressions.tree import CORNERS, FUNCTIONS, JUMP, Expression, Number, Operation, Symbol

Tree = Any  # nested lists: a name, an exact fraction as text, or an operator with its operands


def to_tree(expression: Expression) -> Tree:
    """Nested lists: a name, an exact fraction, or an operator with its operands (FORMAT.md)."""
    if isinstance(expression, Symbol):
        return expression.name
    if isinstance(expression, Number):
        return str(expression.value)
    if not isinstance(expression, Operation):
        raise InputError(f"{expression!r} is no expression.")
    if expression.operator == "**":
        return ["**", to_tree(expression.operands[0]), expression.exponent]
    return [expression.operator, *map(to_tree, expression.operands)]


_OPERANDS = {
    **{"+": (1, None), "*": (1, None), "-": (1, 2), "/": (2, 2), "**": (2, 2)},
    **dict.fromkeys((*FUNCTIONS, JUMP), (1, 1)),
    **CORNERS,
}


def from_tree(tree: Tree, names: Mapping[str, Symbol]) -> Expression:
    """The expression of nested lists.

    Raises
    ------
    CertificateFormatError : it is no tree of a certificate over these names.
    """
    if isinstance(tree, str):
        try:
            return names[tree] if tree in names else Number(Fraction(tree))
        except (ValueError, ZeroDivisionError) as error:
            raise CertificateFormatError(f"{tree[:40]!r} is no name of the plant and no exact number.") from error
    if not isinstance(tree, list) or not tree or not isinstance(tree[0], str) or tree[0] not in _OPERANDS:
        raise CertificateFormatError(f"{str(tree)[:40]!r} is no expression of a certificate.")
    operator, arguments = tree[0], tree[1:]
    least, most = _OPERANDS[operator]
    if len(arguments) < least or (most is not None and len(arguments) > most):
        raise CertificateFormatError(f"{operator!r} with {len(arguments)} operands is no operator of a certificate.")
    if operator == "**":
        if type(arguments[1]) is not int:
            raise CertificateFormatError(f"an exponent must be an integer; found {str(arguments[1])[:40]!r}.")
        return Operation("**", from_tree(arguments[0], names), Number(arguments[1]))
    operands = [from_tree(a, names) for a in arguments]
    if operator == "-" and len(operands) == 2:
        return Operation("+", operands[0], Operation("-", operands[1]))
    return operands[0] if operator in "+*" and len(operands) == 1 else Operation(operator, *operands)
