"""The two loops of VNN-COMP 2024's benchmark `lsnc`, each proved as a whole: a planar quadrotor with a ReLU controller.

`python benchmarks/lsnc.py FOLDER --out DIR` wants a copy of shizhouxing/LSNC_VNNCOMP2024, and the package onnx. Each of
its two graphs says the state of a step later, V and the fall of V. Out of a graph's numbers this makes a plant in
discrete time, a policy and, of the second, an observer; it compares them with the graph in onnx's reference evaluator,
in double precision and as it is, and asks for proofs with the graph's V and with a V of our own. Nothing of the graph's
file is executed but the operators that onnx knows.

Numbers are the file's single-precision ones, exactly; what is proved is about real numbers, as the graph writes them
down. The benchmark's own questions are about random boxes without a neighbourhood of the origin, and tolerate 1e-6.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import numpy_helper
from onnx.reference import ReferenceEvaluator

from certify import Policy, PolicyNetwork, certify_roa, get_system, save_policy
from certify.loop.composition import composed
from certify.loop.policies.network import Array

SAMPLES = 10_000
STATE_BOX = {"x": 0.75, "y": 0.75, "theta": 1.57, "x_dot": 4, "y_dot": 4, "theta_dot": 3}
OUTPUT_BOX = {
    "y": "0.1",
    "theta": "0.6283185307179586",
    "y_dot": "0.2",
    "theta_dot": "0.6283185307179586",
    "e_y": "0.05",
    "e_theta": "0.3141592653589793",
    "e_y_dot": "0.1",
    "e_theta_dot": "0.3141592653589793",
}


@dataclass(frozen=True, slots=True)
class Graph:
    """A graph's numbers: the tensors by name, and the values of its constants, in double precision."""

    model: onnx.ModelProto
    tensors: dict[str, Array]
    constants: dict[str, Array]

    def layers(self, name: str) -> tuple[list[Array], list[Array]]:
        """Weights and biases of two layers."""
        return [self.tensors[f"{name}.{k}.weight"] for k in (0, 2)], [self.tensors[f"{name}.{k}.bias"] for k in (0, 2)]

    def number(self, name: str) -> str:
        """A constant of one value, as its exact decimal."""
        (value,) = set(self.constants[name].ravel().tolist())
        return str(Decimal(value))

    def P(self) -> Array:
        """The matrix of V, rounded once to doubles."""
        R = [[Fraction(v) for v in row] for row in self.tensors["lyapunov.R"].tolist()]
        E, n = Fraction(float(self.constants["/lyapunov/Constant_1_output_0"][0, 0])), len(R)
        return np.array(
            [[float(sum(r[i] * r[j] for r in R) + (E if i == j else 0)) for j in range(n)] for i in range(n)]
        )

    def evaluate(self, x: Array, double: bool) -> Array:
        """The graph's values at states, (N, 2 + n): the fall of V, V, and the state a step later."""
        if not double:
            return np.asarray(ReferenceEvaluator(self.model).run(None, {"input": x.astype(np.float32)})[0])
        wide = onnx.ModelProto()
        wide.CopyFrom(self.model)
        for tensor in wide.graph.initializer:
            tensor.CopyFrom(_widened(tensor))
        for node in wide.graph.node:
            for attribute in node.attribute:
                if attribute.type == onnx.AttributeProto.TENSOR:
                    attribute.t.CopyFrom(_widened(attribute.t))
        wide.graph.input[0].type.tensor_type.elem_type = onnx.TensorProto.DOUBLE
        return np.asarray(ReferenceEvaluator(wide).run(None, {"input": x})[0])


def _widened(tensor: onnx.TensorProto) -> onnx.TensorProto:
    array = numpy_helper.to_array(tensor)
    return numpy_helper.from_array(array.astype(np.float64), tensor.name) if array.dtype == np.float32 else tensor


def read(file: Path) -> Graph:
    """A graph of the benchmark."""
    model = onnx.load(file)
    tensors = {t.name: numpy_helper.to_array(t).astype(np.float64) for t in model.graph.initializer}
    constants = {}
    for node in model.graph.node:
        if node.op_type == "Constant":
            array = numpy_helper.to_array(node.attribute[0].t)
            constants[node.output[0]] = array.astype(np.float64)
    return Graph(model, tensors, constants)


def _table(name: str, lines: dict[str, str]) -> str:
    return f"[{name}]\n" + "".join(f"{key} = {value}\n" for key, value in lines.items()) + "\n"


def state_feedback(graph: Graph, out: Path, wide: bool) -> tuple[Path, PolicyNetwork]:
    """The plant's file and the policy of six states; `wide` does not end the domain at the benchmark's box."""
    dt = graph.number("/Constant_24_output_0")
    most = graph.number("/controller/Constant_3_output_0")
    rest = graph.number("/controller/Constant_output_0")
    box = {**STATE_BOX, "y": 1.2, "theta_dot": 5} if wide else STATE_BOX
    plant = out / ("state_wide.toml" if wide else "state.toml")
    head = f'name = "lsnc_state"\ntime = "discrete"\nstates = {json.dumps(list(box))}\ninputs = ["u1", "u2"]\n\n'
    parameters = {
        "dt": dt,
        "k": graph.number("/Constant_17_output_0"),
        "g": graph.number("/Constant_18_output_0"),
        "r": graph.number("/Constant_19_output_0"),
    }
    where = {
        "x_then": '"x_dot - dt*k*sin(theta)*(u1 + u2)"',
        "y_then": '"y_dot + dt*(k*cos(theta)*(u1 + u2) - g)"',
        "theta_then": '"theta_dot + dt*r*(u1 - u2)"',
    }
    dynamics = {name: f'"{name} + dt/2*({name}_dot + {name}_then)"' for name in ("x", "y", "theta")}
    dynamics |= {f"{name}_dot": f'"{name}_then"' for name in ("x", "y", "theta")}
    plant.write_text(
        head
        + _table("parameters", parameters)
        + _table("where", where)
        + _table("dynamics", dynamics)
        + _table("u_eq", {"u1": rest, "u2": rest})
        + _table("domain", {name: f"[-{v}, {v}]" for name, v in box.items()})
        + _table("input_bounds", {"u1": f"[0, {most}]", "u2": f"[0, {most}]"}),
        "utf-8",
    )
    return plant, _controller(graph, float(most))


def _controller(graph: Graph, most: float) -> PolicyNetwork:
    weights, biases = graph.layers("controller.net")
    clip = (np.zeros(2), np.full(2, most))
    return PolicyNetwork.of_layers(
        weights, biases, np.ones(2), np.zeros(2), "identity", "output", clip, activation="relu"
    )


def compare(graph: Graph, plant: Path, policy: PolicyNetwork, box: dict[str, Any]) -> tuple[float, float]:
    """The largest difference of a step later, of all states, in double precision and in the file's own."""
    system, network = composed(get_system(str(plant)), policy)
    limits = np.array([float(v) for v in box.values()])
    x = np.random.default_rng(0).uniform(-limits, limits, (SAMPLES, len(limits)))
    x = x.astype(np.float32).astype(np.float64)
    u = network(x, system.exact_u_eq())
    ours = np.asarray(system.function()(x, u))
    return tuple(float(np.max(np.abs(ours - graph.evaluate(x, double)[:, 2:]))) for double in (True, False))
