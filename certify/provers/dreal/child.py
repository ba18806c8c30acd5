"""Answers one query with the dReal module, in a process of its own that can be killed.

Reads one JSON object from standard input (the fields of `Formula`, `precision`, `jobs`), writes one to standard output:
`{"answer": "unsat" | "delta-sat", "box": {name: [lo, hi]}, "version": text, "seconds": s}`, s of the solver alone.
Run by its path in isolated mode, so that nothing of the folder it is started in is imported; it imports nothing of the
project either. Numbers that binary64 does not hold are refused: dReal would round them.
"""

from __future__ import annotations

import json
import operator
import sys
import time
from collections.abc import Mapping
from fractions import Fraction
from typing import Any

_RELATIONS = {">=": operator.ge, "<=": operator.le, ">": operator.gt, "<": operator.lt}
_OPERATORS = {"+": operator.add, "-": operator.sub, "*": operator.mul, "/": operator.truediv}


def main() -> None:
    """Read, decide, write."""
    import dreal

    query = json.load(sys.stdin)
    config = dreal.Config()
    config.precision = query["precision"]
    config.number_of_jobs = query["jobs"]
    context = dreal.Context()
    context.config = config
    values: dict[str, Any] = {}
    variables = {name: dreal.Variable(name) for name, _, _ in query["variables"]}
    for name, lo, hi in query["variables"]:
        context.DeclareVariable(variables[name], dreal.Expression(lo), dreal.Expression(hi))
        values[name] = dreal.Expression(variables[name])
    for name, tree in query["definitions"]:
        values[name] = _expression(dreal, tree, values)
    for left, relation, right in query["constraints"]:
        a, b = _expression(dreal, left, values), _expression(dreal, right, values)
        context.Assert(_RELATIONS[relation](a, b))
    start = time.perf_counter()
    box = context.CheckSat()
    seconds = time.perf_counter() - start
    found = {} if box is None else {name: [box[v].lb(), box[v].ub()] for name, v in variables.items()}
    answer = "unsat" if box is None else "delta-sat"
    version = str(getattr(dreal, "__version__", "unknown"))
    json.dump({"answer": answer, "box": found, "version": version, "seconds": seconds}, sys.stdout)


def _expression(dreal: Any, tree: Any, values: Mapping[str, Any]) -> Any:
    if isinstance(tree, str):
        return values[tree] if tree in values else dreal.Expression(_number(tree))
    name, *rest = tree
    if name == "**":
        return dreal.pow(_expression(dreal, rest[0], values), int(rest[1]))
    arguments = [_expression(dreal, t, values) for t in rest]
    if name in ("sin", "cos", "tan", "tanh", "exp", "atan", "sqrt", "log"):
        return getattr(dreal, name)(arguments[0])
    if name in ("min", "max"):
        return getattr(dreal, name.capitalize())(*arguments)
    if name == "-" and len(arguments) == 1:
        return -arguments[0]
    result = arguments[0]
    for a in arguments[1:]:
        result = _OPERATORS[name](result, a)
    return result


def _number(text: str) -> float:
    q = Fraction(text)
    if Fraction(float(q)) != q:
        raise ValueError(f"{text} is no binary64 number")
    return float(q)


if __name__ == "__main__":
    main()
