"""Answers one query with the dReal module, in a process of its own that can be killed.

Reads one JSON object from standard input (the fields of `Query`, `precision`, `jobs`), writes one to standard output:
`{"answer": "unsat" | "delta-sat", "box": {name: [lo, hi]}, "version": text, "seconds": s}`, s of the solver alone.
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


def main() -> None:
    """Read, decide, write."""
    import dreal

    query = json.load(sys.stdin)
    values: dict[str, Any] = {}
    constraints = []
    variables = {name: dreal.Variable(name) for name, _, _ in query["variables"]}
    for name, lo, hi in query["variables"]:
        values[name] = variables[name]
        constraints += [_number(dreal, lo) <= values[name], values[name] <= _number(dreal, hi)]
    for name, tree in query["definitions"]:
        values[name] = _expression(dreal, tree, values)
    for left, relation, right in query["constraints"]:
        a, b = _expression(dreal, left, values), _expression(dreal, right, values)
        constraints.append(_RELATIONS[relation](a, b))
    config = dreal.Config()
    config.precision = query["precision"]
    config.number_of_jobs = query["jobs"]
    start = time.perf_counter()
    box = dreal.CheckSatisfiability(dreal.And(*constraints), config)
    seconds = time.perf_counter() - start
    found = {} if box is None else {name: [box[v].lb(), box[v].ub()] for name, v in variables.items()}
    answer = "unsat" if box is None else "delta-sat"
    version = str(getattr(dreal, "__version__", "unknown"))
    json.dump({"answer": answer, "box": found, "version": version, "seconds": seconds}, sys.stdout)


def _number(dreal: Any, text: str) -> Any:
    """An exact fraction; dReal itself encloses the quotient of two integers, or takes a binary64 number as it is."""
    q = Fraction(text)
    if Fraction(float(q)) == q:
        return dreal.Expression(float(q))
    return dreal.Expression(float(q.numerator)) / dreal.Expression(float(q.denominator))


def _expression(dreal: Any, tree: Any, values: Mapping[str, Any]) -> Any:
    if isinstance(tree, str):
        return values[tree] if tree in values else _number(dreal, tree)
    operator, *rest = tree
    if operator == "**":
        return dreal.pow(_expression(dreal, rest[0], values), int(rest[1]))
    arguments = [_expression(dreal, t, values) for t in rest]
    if operator in ("sin", "cos", "tan", "tanh", "log"):
        return getattr(dreal, operator)(arguments[0])
    if operator == "-" and len(arguments) == 1:
        return -arguments[0]
    result = arguments[0]
    for a in arguments[1:]:
        if operator == "+":
            result = result + a
        elif operator == "-":
            result = result - a
        elif operator == "*":
            result = result * a
        else:
            result = result / a
    return result


if __name__ == "__main__":
    main()
