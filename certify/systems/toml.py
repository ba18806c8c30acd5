"""A plant of one's own, described in TOML.

Equations are text over names, read by a small parser on Python's `ast`: nothing in the file is
executed, and `0.15` is 3/20, because numbers are read as text. See `examples/van_der_pol.toml`.
"""

from __future__ import annotations

import ast
import tomllib
from collections.abc import Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any

import sympy

from certify.errors import InputError
from certify.expressions import FUNCTIONS
from certify.systems.system import Interval, System, exact, symbols

_KEYS = {
    "name",
    "description",
    "states",
    "inputs",
    "parameters",
    "positive",
    "dynamics",
    "u_eq",
    "domain",
    "input_bounds",
    "units",
}
_REQUIRED = {"name", "states", "inputs", "dynamics", "u_eq", "domain", "input_bounds"}
_MAX_EXPONENT = 64


def load_system(path: Path) -> System:
    """Read a plant from a TOML file.

    Raises
    ------
    InputError : the file is missing or not TOML, a key is unknown or absent, or an equation is
        outside the grammar.
    """
    try:
        text = path.read_text(encoding="utf-8")
        # Decimal text goes to Fraction unrounded; a literal like 1e999999 must not become an integer.
        data = tomllib.loads(text, parse_float=_decimal)
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"system file {path} cannot be read: {error}.") from error
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"system file {path} is not valid TOML: {error}.") from error
    unknown, missing = sorted(set(data) - _KEYS), sorted(_REQUIRED - set(data))
    if unknown or missing:
        raise InputError(f"system file {path}: unknown keys {unknown}, missing keys {missing}.")
    try:
        return _build(data)
    except (TypeError, AttributeError, KeyError) as error:
        raise InputError(f"system file {path} has an entry of the wrong type: {error}.") from error


def _build(data: Mapping[str, Any]) -> System:
    states, inputs = symbols(data["states"]), symbols(data["inputs"])
    parameters = {name: exact(value, name) for name, value in data.get("parameters", {}).items()}
    names = {s.name: s for s in (*states, *inputs, *symbols(list(parameters)))}
    return System(
        name=data["name"],
        description=data.get("description", ""),
        states=states,
        inputs=inputs,
        parameters=parameters,
        positive=frozenset(data.get("positive", ())),
        dynamics=tuple(parse_expression(data["dynamics"][s.name], names) for s in states),
        u_eq=tuple(parse_expression(data["u_eq"][s.name], names) for s in inputs),
        domain=tuple(_interval(data["domain"][s.name], s.name) for s in states),
        input_bounds=tuple(_interval(data["input_bounds"][s.name], s.name) for s in inputs),
        units=data.get("units", {}),
    )


def parse_expression(text: str | int | Fraction, names: Mapping[str, sympy.Symbol]) -> sympy.Expr:
    """A sympy expression from text such as `(g/l)*sin(theta) - b/(m*l**2)*theta_dot`; `^` is refused."""
    source = str(text)
    try:
        tree = ast.parse(source, mode="eval")
        return _convert(tree.body, source, names)
    except (SyntaxError, RecursionError, ValueError, MemoryError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"equation {source!r} cannot be read: {error}.") from error


def _convert(node: ast.expr, source: str, names: Mapping[str, sympy.Symbol]) -> sympy.Expr:
    if isinstance(node, ast.Constant) and isinstance(node.value, int | float) and not isinstance(node.value, bool):
        literal = _decimal(ast.get_source_segment(source, node) or "")
        return sympy.Rational(literal.numerator, literal.denominator)
    if isinstance(node, ast.Name) and node.id in names:
        return names[node.id]
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.UAdd):
        operand = _convert(node.operand, source, names)
        return -operand if isinstance(node.op, ast.USub) else operand
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and not node.keywords and len(node.args) == 1:
        function = FUNCTIONS.get(node.func.id)
        if function is not None:
            return function(_convert(node.args[0], source, names))
    if isinstance(node, ast.BinOp):
        left, right = _convert(node.left, source, names), _convert(node.right, source, names)
        if isinstance(node.op, ast.Add):
            return left + right
        if isinstance(node.op, ast.Sub):
            return left - right
        if isinstance(node.op, ast.Mult):
            return left * right
        if isinstance(node.op, ast.Div) and right != 0:
            return left / right
        if isinstance(node.op, ast.Pow) and right.is_Integer and abs(right) <= _MAX_EXPONENT:
            return left**right
    raise InputError(
        f"equation {source!r}: {ast.get_source_segment(source, node)!r} is not allowed; use the plant's names, "
        f"numbers, + - * /, integer powers up to {_MAX_EXPONENT}, {', '.join(FUNCTIONS)}."
    )


def _decimal(text: str) -> Fraction:
    exponent = text.lower().replace("_", "").partition("e")[2]
    if exponent and abs(int(exponent)) > 400:
        raise InputError(f"number {text} is out of range.")
    return exact(text.replace("_", ""))


def _interval(value: Any, name: str) -> Interval:
    if not isinstance(value, list) or len(value) != 2:
        raise InputError(f"the bounds of {name} must be a pair [lo, hi]; found {value!r}.")
    return exact(value[0], name), exact(value[1], name)
