"""Expressions as functions of arrays, in binary64: for simulation, search and pictures. Nothing is proved with them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from functools import partial, reduce
from typing import Any, Literal

from certify.errors import InputError
from certify.loop.expressions.gathering import gathered
from certify.loop.expressions.tree import FUNCTIONS, JUMP, Expression, Number, Operation, Symbol, nodes

Module = Literal["numpy", "torch"]
_NAMES = {"numpy": {"atan": "arctan"}, "torch": {}}
_EXTREMES = {"min": "minimum", "max": "maximum"}


def numerical(
    expressions: Sequence[Expression], variables: Sequence[Symbol], module: Module = "numpy"
) -> Callable[..., tuple[Any, ...]]:
    """A function of arrays, one argument per variable, to the values of the expressions, each computed once.

    An expression without variables gives a plain number, which is infinite where binary64 ends.

    Raises
    ------
    InputError : an expression has a symbol that is no variable, or divides by a number that is 0.

    Examples
    --------
    >>> x, y = Symbol("x"), Symbol("y")
    >>> numerical([x * y, Number(1) / 4], [x, y])(3.0, 5.0)
    (15.0, 0.25)
    """
    plain = [gathered(e) for e in expressions]
    written = {symbol: f"x{k}" for k, symbol in enumerate(variables)}
    constant: dict[Expression, float] = {}
    lines = [f"def f({', '.join(written.values())}):"]
    code: dict[Expression, str] = dict(written.items())
    for node in nodes(*plain):
        if node in code:
            continue
        if isinstance(node, Symbol):
            raise InputError(f"the expression uses {node}, which has no value here.")
        if all(e in constant for e in node.operands):
            constant[node] = _constant(node, [constant[e] for e in node.operands])
            code[node] = f"({constant[node]!r})".replace("inf", "math.inf").replace("nan", "math.nan")
            continue
        code[node] = f"v{len(lines)}"
        lines.append(f"    {code[node]} = {_code(node, [code[e] for e in node.operands], module)}")
    lines.append(f"    return ({', '.join([*(code[e] for e in plain), ''])})")
    space: dict[str, Any] = {"math": math, module: __import__(module)}
    space |= {name: partial(_extreme, space[module], name) for name in _EXTREMES.values()}
    exec("\n".join(lines), space)  # of nothing but names, numbers and operators that stand above
    made: Callable[..., tuple[Any, ...]] = space["f"]
    return made


def _code(node: Expression, operands: Sequence[str], module: Module) -> str:
    if isinstance(node, Operation):
        if node.operator in ("+", "*"):
            return f" {node.operator} ".join(operands)
        if node.operator == "**":
            power = operands[0] if abs(node.exponent) == 1 else f"{operands[0]} ** {abs(node.exponent)}"
            return power if node.exponent > 0 else f"1.0 / ({power})"
        if node.operator in _EXTREMES:
            return reduce(lambda a, b: f"{_EXTREMES[node.operator]}({a}, {b})", operands)
        if node.operator == "clip":
            v, lo, hi = operands
            return f"minimum(maximum({v}, {lo}), {hi})"
        if node.operator == "sign":
            return f"{module}.where({operands[0]} < 0, -1.0, 1.0)"
        if node.operator == JUMP:
            return f"{module}.where({operands[0]} < 0, 0.0, 1.0)"
        if node.operator in (*FUNCTIONS, "abs"):
            return f"{module}.{_NAMES[module].get(node.operator, node.operator)}({operands[0]})"
    raise InputError(f"{node!r} is no expression.")


def _constant(node: Expression, operands: Sequence[float]) -> float:
    """A number, rounded; NaN where there is none."""
    try:
        if isinstance(node, Number):
            return _rounded(node.value)
        if isinstance(node, Operation) and node.operator in ("+", "*"):
            return (math.fsum if node.operator == "+" else math.prod)(operands)
        if isinstance(node, Operation) and node.operator == "**":
            return float(operands[0] ** node.exponent)
        if isinstance(node, Operation) and node.operator in FUNCTIONS:
            return float(getattr(math, node.operator)(operands[0]))
        if isinstance(node, Operation) and node.operator in _PLAIN:
            return float(_PLAIN[node.operator](*operands))
    except OverflowError:
        return math.inf
    except (ValueError, ZeroDivisionError):
        return math.nan
    raise InputError(f"{node!r} is no expression.")


_PLAIN: Mapping[str, Callable[..., float]] = {
    **{"abs": abs, "min": min, "max": max},
    "clip": lambda v, lo, hi: min(max(v, lo), hi),
    "sign": lambda v: -1.0 if v < 0 else 1.0,
    JUMP: lambda v: 0.0 if v < 0 else 1.0,
}


def _extreme(library: Any, name: str, a: Any, b: Any) -> Any:
    """The lesser or larger of two, of which torch takes tensors only."""
    if library.__name__ == "torch":
        tensors = [v for v in (a, b) if isinstance(v, library.Tensor)]
        kind = {"dtype": tensors[0].dtype, "device": tensors[0].device} if tensors else {"dtype": library.float64}
        a, b = (library.as_tensor(v, **kind) for v in (a, b))
    return getattr(library, name)(a, b)


def _rounded(q: Fraction) -> float:
    try:
        return float(q)
    except OverflowError:
        return math.copysign(math.inf, q)
