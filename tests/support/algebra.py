"""Whether two expressions are the same function, asked of sympy: the project's own trees never simplify."""

from __future__ import annotations

import sympy

from certify.loop.expressions import Expression


def to_sympy(expression: object) -> sympy.Expr:
    """What sympy makes of an expression's text."""
    e = expression
    if isinstance(e, Expression):
        names = {name: sympy.Symbol(name) for name in ("I", "E", "S", "N", "Q", "O")}
        return sympy.sympify(str(e), locals=names, rational=True)
    return sympy.sympify(e)


def same(a: object, b: object) -> bool:
    """Whether their difference simplifies to 0."""
    return bool(sympy.simplify(to_sympy(a) - to_sympy(b)) == 0)
