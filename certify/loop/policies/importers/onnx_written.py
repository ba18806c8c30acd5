"""Operators of ONNX whose definitions have constants of single precision, written out for a comparison in double."""

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
