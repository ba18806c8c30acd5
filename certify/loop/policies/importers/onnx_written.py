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

    if not any(node.op_type == "Erf" for node in nodes):
        return nodes
    found = _Written(nodes, constants)
    gelus = {end: helper.make_node("Gelu", [x], [end]) for end, x in map(found.gelu, nodes) if end is not None}
    kept, wanted = list[Any](), {output}
    for node in reversed([gelus.get(node.output[0], node) if node.output else node for node in nodes]):
        if wanted.intersection(node.output):
            kept.append(node)
            wanted.update(node.input)
    return kept[::-1] if gelus else nodes


class _Written:
    """A graph as written: the node that makes a value, and those that read it."""

    def __init__(self, nodes: list[Any], constants: dict[str, Any]) -> None:
        self.constants = constants
        self.made = {name: node for node in nodes for name in node.output}
        self.read = dict[str, list[Any]]()
        for node in nodes:
            for name in set(node.input):
                self.read.setdefault(name, []).append(node)

    def gelu(self, node: Any) -> tuple[str | None, str]:
        """The value that is GELU of x where the node is the Erf in it, None if there is none; and x."""
        x = self._under_the_root(self.made.get(node.input[0])) if node.op_type == "Erf" and node.input else None
        return (None, "") if x is None or not node.output else (self._product(node.output[0], x), x)

    def _is(self, name: str, wanted: float, within: float = 0.0) -> bool:
        """True for a constant number that is `wanted` up to a relative error."""
        value = self.constants.get(name)
        return value is not None and np.size(value) == 1 and abs(float(np.ravel(value)[0]) - wanted) <= within * wanted

    def _under_the_root(self, node: Any) -> str | None:
        """The name of x where a node is x / sqrt 2."""
        if node is None or node.op_type not in ("Div", "Mul") or len(node.input) != 2:
            return None
        x, by = node.input if node.op_type == "Div" or node.input[1] in self.constants else node.input[::-1]
        wanted = math.sqrt(2) if node.op_type == "Div" else math.sqrt(0.5)
        return str(x) if x not in self.constants and self._is(by, wanted, _ROUNDED) else None

    def _product(self, erf: str, x: str) -> str | None:
        """The name of the product of 1 + erf, x and 1/2; None where what follows is another expression."""
        name, beside = self._after("Add", erf)
        if name is None or not self._is(beside, 1.0):
            return None
        found = list[str]()
        while sorted(found) != ["half", "x"]:
            name, beside = self._after("Mul", name)
            if name is None or len(found) > 1:
                return None
            found += self._factors(beside, x)
        return name

    def _after(self, kind: str, name: str) -> tuple[str | None, str]:
        """The value of the one node that reads a value, if it is of this kind, and what it reads beside it."""
        users = self.read.get(name, [])
        if len(users) != 1 or users[0].op_type != kind or len(users[0].input) != 2 or not users[0].output:
            return None, ""
        one, other = users[0].input
        return str(users[0].output[0]), str(other if one == name else one)

    def _factors(self, name: str, x: str) -> list[str]:
        """The factors of a value, as far as they are x and 1/2."""
        node = self.made.get(name)
        inputs = [name] if node is None or name == x or node.op_type != "Mul" else list(node.input)
        return ["x" if one == x else "half" if self._is(one, 0.5) else "another" for one in inputs]
