"""Corrections for equations written as in Python or mathematics.

This module only gives messages; the reader decides what an equation may contain.
"""

from __future__ import annotations

import ast
from collections.abc import Collection, Sequence

_MODULES = ("np", "numpy", "math", "cmath", "sympy", "sp", "torch", "jnp", "jax", "scipy", "casadi", "ca", "tf")
_NO_JUMPS = "equations must have no jumps but heaviside, in discrete time"
_STEP = f"{_NO_JUMPS}; in continuous time a step from 0 to 1 where y changes its sign is (1 + tanh(50*y))/2"
_ANGLE = "an angle needs no wrapping, since sin and cos repeat"
_TABLE = "a table with lines between its points is a sum such as y0 + k0*(x - x0) + (k1 - k0)*max(x - x1, 0) + ..."
# {x} and {y} are the arguments, {X} and {Y} the same in brackets where they need some.
_FORMULAS = {
    "arctan": "atan({x})",
    "power": "{X}**{Y}",
    "pow": "{X}**{Y}",
    "square": "{X}**2",
    "arctan2": "atan({X}/{Y}), which is the same where {y} > 0",
    "atan2": "atan({X}/{Y}), which is the same where {y} > 0",
    "arcsin": "atan({X}/sqrt(1 - {X}**2))",
    "asin": "atan({X}/sqrt(1 - {X}**2))",
    "arccos": "2*atan(sqrt((1 - {X})/(1 + {X})))",
    "acos": "2*atan(sqrt((1 - {X})/(1 + {X})))",
    "sinh": "(exp({x}) - exp(-{X}))/2",
    "cosh": "(exp({x}) + exp(-{X}))/2",
    "sigmoid": "(1 + tanh({X}/2))/2",
    "expit": "(1 + tanh({X}/2))/2",
    "cot": "1/tan({x})",
    "sec": "1/cos({x})",
    "radians": "{X}*3.141592653589793/180",
    "deg2rad": "{X}*3.141592653589793/180",
    "sign": f"tanh(50*{{X}}), as steep as its factor says: {_NO_JUMPS}, and the sign jumps at 0",
    "sat": "clip({x}, -1, 1)",
    "saturate": "clip({x}, -1, 1)",
    "relu": "max({x}, 0)",
    "hypot": "sqrt({X}**2 + {Y}**2)",
}
_SAME = {
    **dict.fromkeys(("fabs", "absolute", "Abs"), "abs"),
    **{"sgn": "sign", "fmin": "min", "fmax": "max", "Min": "min", "Max": "max"},
    **{"minimum": "min", "maximum": "max", "clamp": "clip", "Heaviside": "heaviside"},
}
_NOT_ALLOWED = {
    **dict.fromkeys(("step", "where", "Piecewise", "piecewise"), _STEP),
    **dict.fromkeys(("floor", "ceil", "ceiling", "round", "trunc", "fix", "int"), _STEP),
    **dict.fromkeys(("mod", "fmod", "remainder", "Mod", "wrap", "angle_normalize"), f"{_NO_JUMPS}; {_ANGLE}"),
    **dict.fromkeys(("interp", "interp1d", "interpolate", "lookup", "table"), f"there are no tables; {_TABLE}"),
}
_CONSTANTS = {"pi": "3.141592653589793", "e": "exp(1)", "E": "exp(1)", "tau": "6.283185307179586"}


def instead_of_call(name: str, arguments: Sequence[str], functions: Collection[str]) -> str | None:
    """Say what to write instead of a function of that name, such as `np.sin`; None if the name is not known.

    >>> instead_of_call("np.sin", ["p"], ["sin"])
    'for np.sin(p) write sin(p)'
    >>> instead_of_call("arctan", ["p"], ["atan"]), instead_of_call("gamma", ["p"], ["atan"])
    ('for arctan(p) write atan(p)', None)
    """
    module, _, bare = name.rpartition(".")
    if module and module.partition(".")[0] not in _MODULES:
        return None
    bare, call = _SAME.get(bare, bare), f"{name}({', '.join(arguments)})"
    if bare in functions and bare != name:
        return f"for {call} write {bare}({', '.join(arguments)})"
    formula = _FORMULAS.get(bare)
    if formula is not None and len(arguments) == 1 + ("{Y}" in formula):
        each = dict(zip("xy", arguments, strict=False))
        each |= {
            name.upper(): text if text.isidentifier() or text.isalnum() else f"({text})" for name, text in each.items()
        }
        return f"for {call} write {formula.format(**each)}"
    return f"{call} is not allowed: {_NOT_ALLOWED[bare]}" if bare in _NOT_ALLOWED else None


def instead_of_name(name: str) -> str | None:
    """Say what to write instead of a constant, such as `pi` or `np.pi`; None if it is none.

    >>> instead_of_name("np.pi")
    'for np.pi write its value as a number, 3.141592653589793, or as a parameter: what is written is meant exactly'
    """
    module, _, bare = name.rpartition(".")
    value = _CONSTANTS.get(bare) if not module or module in _MODULES else None
    if value is None:
        return None
    if value.startswith("exp"):
        return f"for {name} write {value}"
    return f"for {name} write its value as a number, {value}, or as a parameter: what is written is meant exactly"


def instead_of(node: ast.expr, text: str) -> str | None:
    """Say what to write instead of anything else that equations may not contain; None if it is not known."""
    if isinstance(node, ast.Attribute):
        return instead_of_name(text)
    if isinstance(node, ast.IfExp | ast.Compare | ast.BoolOp):
        return f"{text!r} is not allowed, because there are no cases: {_STEP}"
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Mod | ast.FloorDiv):
        return f"{text!r} is not allowed: {_NO_JUMPS}; {_ANGLE if isinstance(node.op, ast.Mod) else _STEP}"
    return None
