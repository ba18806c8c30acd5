"""Operators of ONNX whose definitions have constants of single precision, written out for a comparison in double; and
GELU, which exporters write out below opset 20, put together again.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

_GELU_TANH = (
    ("Mul", "x", "x", "square"), ("Mul", "square", 0.044715, "part"), ("Add", "part", 1.0, "factor"),
    ("Mul", "x", "factor", "sum"), ("Mul", "sum", math.sqrt(2 / math.pi), "inner"), ("Tanh", "inner", None, "tanh"),
    ("Add", "tanh", 1.0, "gate"), ("Mul", "x", "gate", "twice"), ("Mul", "twice", 0.5, "y"),
)  # fmt: skip
_ROUNDED = 2.0**-23  # relative: twice what single precision rounds
_HARD_SWISH = (
    ("Add", "x", 3.0, "above"), ("Max", "above", 0.0, "least"), ("Min", "least", 6.0, "gate"),
    ("Mul", "x", "gate", "product"), ("Div", "product", 6.0, "y"),
)  # fmt: skip


def written_out(graph: Any) -> None:
    """Replace the tanh form of Gelu, and HardSwish, by their formulas with constants of double precision."""
    nodes = [part for k, node in enumerate(graph.node) for part in _parts(node, f"{node.output[0]}/written {k}/")]
    del graph.node[:]
    graph.node.extend(nodes)


def _parts(node: Any, name: str) -> Iterator[Any]:
    from onnx import helper, numpy_helper

    tanh = any(a.name == "approximate" and a.s == b"tanh" for a in node.attribute)
    formula = _GELU_TANH if node.op_type == "Gelu" and tanh else _HARD_SWISH if node.op_type == "HardSwish" else ()
    if not formula:
        yield node
    ends = {"x": node.input[0], "y": node.output[0]} if formula else {}
    for kind, one, other, made in formula:
        given = [ends.get(one, name + one)]
        if isinstance(other, float):
            value = numpy_helper.from_array(np.array(other), "value")
            yield helper.make_node("Constant", [], [f"{name}{made} of"], value=value)
            given.append(f"{name}{made} of")
        elif other is not None:
            given.append(ends.get(other, name + other))
        yield helper.make_node(kind, given, [ends.get(made, name + made)])


def with_gelu(nodes: list[Any], constants: dict[str, Any], output: str) -> list[Any]:
    """The nodes with `x (1 + erf(x / sqrt 2)) / 2` as one Gelu, however its three factors are multiplied.

    A file has the root of two in single precision at best, which is read as the root: it moves GELU by less than
    1e-7 |x|, less than one rounding of the program that the file is of.
    """
    from onnx import helper

    made = {node.output[0]: node for node in nodes if node.output}
    gelus = dict[str, Any]()
    for node in nodes:
        x = _under_the_root(made.get(node.input[0]), constants) if node.op_type == "Erf" else None
        end = None if x is None else _end_of_gelu(node.output[0], x, nodes, made, constants)
        if end is not None:
            gelus[end] = helper.make_node("Gelu", [x], [end], name=node.name)
    kept, wanted = list[Any](), {output}
    for node in reversed([gelus.get(node.output[0], node) if node.output else node for node in nodes] if gelus else []):
        if wanted.intersection(node.output):
            kept.append(node)
            wanted.update(node.input)
    return kept[::-1] if gelus else nodes


def _is(name: str, wanted: float, constants: dict[str, Any], within: float = 0.0) -> bool:
    """True for a constant number that is `wanted` up to a relative error."""
    value = constants.get(name)
    return value is not None and np.size(value) == 1 and abs(float(np.ravel(value)[0]) - wanted) <= within * wanted


def _under_the_root(node: Any, constants: dict[str, Any]) -> str | None:
    """The name of x where a node is x / sqrt 2."""
    if node is None or node.op_type not in ("Div", "Mul") or len(node.input) != 2:
        return None
    x, by = node.input if node.op_type == "Div" or node.input[1] in constants else node.input[::-1]
    wanted = math.sqrt(2) if node.op_type == "Div" else math.sqrt(0.5)
    return str(x) if x not in constants and _is(by, wanted, constants, _ROUNDED) else None


def _end_of_gelu(erf: str, x: str, nodes: list[Any], made: dict[str, Any], constants: dict[str, Any]) -> str | None:
    """The name of the product of 1 + erf, x and 1/2; None where what follows is another expression."""

    def after(name: str) -> Any:
        users = [node for node in nodes if name in node.input]
        return users[0] if len(users) == 1 and len(users[0].input) == 2 else None

    def factors(name: str) -> list[str]:
        node = made.get(name)
        if name != x and node is not None and node.op_type == "Mul" and x in node.input:
            return [part for inner in node.input for part in factors(inner)]
        return ["x" if name == x else "half" if _is(name, 0.5, constants) else "another"]

    def other(node: Any, name: str) -> str:
        return str(node.input[1] if node.input[0] == name else node.input[0])

    node, name, found = after(erf), erf, list[str]()
    if node is None or node.op_type != "Add" or not _is(other(node, name), 1.0, constants):
        return None
    while sorted(found) != ["half", "x"]:
        name = node.output[0]
        node = after(name)
        if node is None or node.op_type != "Mul" or "another" in found or len(found) > 1:
            return None
        found += factors(other(node, name))
    return str(node.output[0])
