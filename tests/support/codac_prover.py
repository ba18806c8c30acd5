"""Queries decided with codac, an interval-contractor library that shares no code with this project.

In a process of its own: importing codac leaves the floating-point unit rounding upwards, which no other arithmetic in
the process expects (the checker's self-test refuses to run then).
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import Mapping
from fractions import Fraction
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from certify.certificates.claims.queries import Query


def decide(query: Query, boxes: int = 20_000, least: float = 1e-6) -> tuple[str, list[float] | None]:
    """`unsat` if contraction and bisection leave nothing, else `unknown` and where they stopped."""
    data = {
        "variables": [(name, float(lo), float(hi)) for name, lo, hi in query.variables],
        "definitions": query.definitions, "constraints": query.constraints, "boxes": boxes, "least": least,
    }  # fmt: skip
    done = subprocess.run(
        [sys.executable, __file__], input=json.dumps(data), capture_output=True, text=True, check=True
    )
    status, x = json.loads(done.stdout)
    return status, x


def main() -> None:
    """Answer one query from standard input."""
    import codac

    data = json.load(sys.stdin)
    x = codac.VectorVar(len(data["variables"]))
    values: dict[str, Any] = {name: x[i] for i, (name, _, _) in enumerate(data["variables"])}
    for name, tree in data["definitions"]:
        values[name] = expression(codac, tree, values)
    contractors = []
    for left, relation, right in data["constraints"]:
        a, b = expression(codac, left, values), expression(codac, right, values)
        difference = codac.AnalyticFunction([x], b - a if relation == "<=" else a - b)
        contractors.append(codac.CtcInverse(difference, codac.Interval(0, math.inf)))
    stack = [codac.IntervalVector([[lo, hi] for _, lo, hi in data["variables"]])]
    for _ in range(data["boxes"]):
        if not stack:
            break
        box = stack.pop()
        for contractor in contractors:
            contracted = contractor.contract(box)
            box = box if contracted is None else contracted
        if box.is_empty():
            continue
        if box.max_diam() < data["least"]:
            json.dump(("unknown", [float(box[i].mid()) for i in range(box.size())]), sys.stdout)
            return
        stack += box.bisect(box.max_diam_index())
    json.dump(("unknown" if stack else "unsat", None), sys.stdout)


def expression(codac: Any, tree: Any, values: Mapping[str, Any]) -> Any:
    """A tree as a codac expression; a fraction that binary64 cannot name becomes an interval around it."""
    if isinstance(tree, str):
        if tree in values:
            return values[tree]
        q = Fraction(tree)
        v = float(q)
        exact = Fraction(v) == q
        return codac.Interval(v) if exact else codac.Interval(math.nextafter(v, -math.inf), math.nextafter(v, math.inf))
    operator, *rest = tree
    if operator == "**":
        return codac.pow(expression(codac, rest[0], values), codac.Interval(int(rest[1])))
    arguments = [expression(codac, t, values) for t in rest]
    if operator in ("sin", "cos", "tan", "tanh", "exp", "atan", "sqrt", "log"):
        return getattr(codac, operator)(arguments[0])
    if operator in ("min", "max"):
        return getattr(codac, operator)(*arguments)
    result = -arguments[0] if operator == "-" and len(arguments) == 1 else arguments[0]
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
