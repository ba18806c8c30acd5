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

from certify import Policy, PolicyNetwork, RoaResult, certify_roa, get_system, save_policy
from certify.certificates.checking import run_checker
from certify.loop.composition import composed
from certify.loop.expressions import Symbol
from certify.loop.networks import Affine, Concat, Map, Network, Observe
from certify.loop.plants.equations import parse_expression
from certify.loop.policies.network import Array

SAMPLES = 10_000
FREE, SLOPES = (0, 5, 7), ("0.0099", "1")  # units of the observer, and slopes beyond those of a secant of its LeakyReLU
SMALL = 3e-10  # about the largest level of which the nearest kink lets a ball be proved
_COLUMNS = "| loop | V | claim | V <= | from V = | volume | s | second checker |"
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


def output_feedback(graph: Graph, out: Path, free: tuple[int, ...] = ()) -> tuple[Path, PolicyNetwork]:
    """The plant's file, an observer's beside it and the policy of eight states: plant, and errors of the estimates.

    Four rays from the quadrotor to the ground are measured, of lengths in [0, 5]. Controller and observer read the
    estimates and the difference between measured and expected lengths.

    The observer's units counted in `free` are LeakyReLUs between whose values at two points, here with and without a
    difference of lengths, lies a secant with a slope in [0.01, 1]: the plant has these slopes as parameters `s`, and
    with them as any function of time it has all trajectories of the loop, and more.
    """
    weights, biases = graph.layers("observer.fc_net")
    angles = [str(Decimal(v)) for v in graph.constants["/Constant_19_output_0"].ravel().tolist()]
    above, longest = graph.number("/Constant_14_output_0"), graph.number("/Constant_20_output_0")
    most, rest = graph.number("/Constant_39_output_0"), graph.number("/Constant_36_output_0")
    names = list(OUTPUT_BOX)[:4]
    estimate = {name: f"({name} - e_{name})" for name in names}

    def ray(angle: str, y: str, theta: str) -> str:
        return f"clip(({y} + {above})/cos({theta} - ({angle})), 0, {longest})"

    read = [
        *estimate.values(),
        *(f"{ray(a, 'y', 'theta')} - {ray(a, estimate['y'], estimate['theta'])}" for a in angles),
    ]
    now, expected = ", ".join(read), ", ".join((*read[:4], "0", "0", "0", "0"))
    parameters = {
        "dt": graph.number("/Constant_74_output_0"),
        "k": graph.number("/Constant_57_output_0"),
        "g": graph.number("/Constant_58_output_0"),
        "r": graph.number("/Constant_64_output_0"),
    }
    where = {
        "y_then": '"y_dot + dt*(k*cos(theta)*(u1 + u2) - g)"',
        "theta_then": '"theta_dot + dt*r*(u1 - u2)"',
        "y_guess": f'"{estimate["y_dot"]} + dt*(k*cos{estimate["theta"]}*(u1 + u2) - g)"',
        "theta_guess": f'"{estimate["theta_dot"]} + dt*r*(u1 - u2)"',
    }
    gaps = {
        i: " + ".join(f"({Decimal(w)})*({d})" for w, d in zip(weights[0][i, 4:], read[4:], strict=True)) for i in free
    }
    for k in range(4):
        secants = "".join(f" + ({Decimal(weights[1][k, i])})*s{i}*({gap})" for i, gap in gaps.items())
        where[f"shift{k}"] = f'"observer[{k}]({now}) - observer[{k}]({expected}){secants}"'
    parameters |= {f"s{i}": "1" for i in free}
    then = [
        "y + dt/2*(y_dot + y_then)",
        "theta + dt/2*(theta_dot + theta_then)",
        "y_then",
        "theta_then",
    ]
    guess = [
        f"{estimate['y']} + dt/2*({estimate['y_dot']} + y_guess)",
        f"{estimate['theta']} + dt/2*({estimate['theta_dot']} + theta_guess)",
        "y_guess",
        "theta_guess",
    ]
    dynamics = {name: f'"{e}"' for name, e in zip(names, then, strict=True)}
    dynamics |= {f"e_{names[k]}": f'"{then[k]} - ({guess[k]} + shift{k})"' for k in range(4)}
    name = "".join(["output", *(f"_{i}" for i in free)])
    plant = out / f"{name}.toml"
    plant.write_text(
        'name = "lsnc_output"\ntime = "discrete"\n'
        + f'states = {json.dumps(list(OUTPUT_BOX))}\ninputs = ["u1", "u2"]\n\n'
        + _table("parameters", parameters)
        + _table("networks", {"observer": f'{{file = "{name}.pt"}}'})
        + _table("where", where)
        + _table("dynamics", dynamics)
        + _table("u_eq", {"u1": rest, "u2": rest})
        + _table("domain", {name: f"[-{v}, {v}]" for name, v in OUTPUT_BOX.items()})
        + _table("input_bounds", {"u1": f"[0, {most}]", "u2": f"[0, {most}]"}),
        "utf-8",
    )
    (slope,) = {a.f for n in graph.model.graph.node if n.op_type == "LeakyRelu" for a in n.attribute}
    kept = [i for i in range(8) if i not in free]
    eye = np.eye(len(kept))
    leaky = np.hstack([slope * eye, (1 - slope) * eye])  # of h and its positive part, exactly
    steps = (
        Affine((0,), weights[0][kept], biases[0][kept]),
        Map((1,), "relu"),
        Concat((1, 2)),
        Affine((3,), leaky, np.zeros(len(kept))),
        Affine((4,), weights[1][:, kept], biases[1]),
    )
    observer = PolicyNetwork(Network(8, steps), np.ones(4), np.zeros(4), "identity", "none")
    save_policy(out / f"{name}.pt", Policy(observer, "lsnc_observer"))

    states = tuple(Symbol(name) for name in OUTPUT_BOX)
    named = {str(s): s for s in states}
    seen = tuple(parse_expression(text, named) for text in read)
    weights, biases = graph.layers("controller.net")
    law = (
        Observe((0,), states, seen),
        Affine((1,), weights[0], biases[0]),
        Map((2,), "relu"),
        Affine((3,), weights[1], biases[1]),
    )
    clip = (np.zeros(2), np.full(2, float(most)))
    return plant, PolicyNetwork(Network(8, law), np.ones(2), np.zeros(2), "identity", "output", clip)


def compare(graph: Graph, plant: Path, policy: PolicyNetwork, box: dict[str, Any]) -> tuple[float, float]:
    """The largest difference of a step later, of all states, in double precision and in the file's own."""
    system, network = composed(get_system(str(plant)), policy)
    limits = np.array([float(v) for v in box.values()])
    x = np.random.default_rng(0).uniform(-limits, limits, (SAMPLES, len(limits)))
    x = x.astype(np.float32).astype(np.float64)
    u = network(x, system.exact_u_eq())
    ours = np.asarray(system.function()(x, u))
    wide, single = (float(np.max(np.abs(ours - graph.evaluate(x, double)[:, 2:]))) for double in (True, False))
    return wide, single


@dataclass(frozen=True, slots=True)
class Row:
    """A proof: what it is about, what was asked for, and what came of it."""

    loop: str
    V: str
    result: RoaResult
    seconds: float
    second: str

    @property
    def cells(self) -> list[str]:
        """Of the table."""
        found = self.result.levels
        numbers = ["", "", ""]
        if self.result.verdict == "PROVED" and found.roa is not None and found.floor is not None:
            numbers = [f"{found.roa:.5g}", f"{found.floor:.2g}", f"{self.result.volume:.4g}"]
        claim = self.result.claim if numbers[0] else f"{self.result.verdict}: {self.result.reason}"
        return [self.loop, self.V, claim, *numbers, f"{self.seconds:.1f}", self.second]


def proved(loop: str, V: str, plant: Path, policy: PolicyNetwork, out: Path, **asked: Any) -> Row:
    """Ask for a proof, and the second checker for its answer."""
    start = time.perf_counter()
    result = certify_roa(str(plant), policy, out, **asked)
    seconds, second = time.perf_counter() - start, ""
    if result.verdict == "PROVED":
        second = "accepts" if run_checker(out / "certificate.json", "reference")["result"] == "ACCEPTED" else "no"
    row = Row(loop, V, result, seconds, second)
    print(" ".join(row.cells), flush=True)
    return row


def state_rows(graph: Graph, out: Path) -> list[Row]:
    """The loop with six states: with the graph's V in the benchmark's box, up to the benchmark's level and beyond it;
    and with a V of our own in the box."""
    plant, policy = state_feedback(graph, out, wide=False)
    wide, _ = state_feedback(graph, out, wide=True)
    theirs, P = "the graph's", graph.P()
    print("state: differences", compare(graph, plant, policy, STATE_BOX))
    return [
        proved("state, their box", theirs, plant, policy, out / "state", P=P),
        proved("state, wider box", theirs, wide, policy, out / "state_level", P=P, level=1.3392),
        proved("state, wider box", theirs, wide, policy, out / "state_wide", P=P),
        proved("state, their box", "our own", plant, policy, out / "state_own"),
    ]


def output_rows(graph: Graph, out: Path) -> list[Row]:
    """The loop with eight states and the graph's V: the loop itself in a small set, and in a larger one with three
    units of the observer, whose kinks are nearest, as secants."""
    plant, policy = output_feedback(graph, out)
    secants, _ = output_feedback(graph, out, FREE)
    theirs, P = "the graph's", graph.P()
    print("output: differences", compare(graph, plant, policy, OUTPUT_BOX))
    slopes = {f"s{i}": SLOPES for i in FREE}
    asked: dict[str, Any] = {"P": P, "claim": "practical", "ranges": slopes}
    return [
        proved("output", theirs, plant, policy, out / "output", P=P, level=SMALL),
        proved("output, secants", theirs, secants, policy, out / "output_secants", **asked),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="a copy of shizhouxing/LSNC_VNNCOMP2024")
    parser.add_argument("--out", type=Path, default=Path("out/lsnc"), help="plants, certificates and the table")
    parser.add_argument("--loops", default="state,output", help="which of the two")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    rows = []
    for name, of in (("state", state_rows), ("output", output_rows)):
        if name in given.loops.split(","):
            rows += of(read(given.folder / "onnx" / f"quadrotor2d_{name}.onnx"), given.out)
    lines = [_COLUMNS, "|" + "---|" * (_COLUMNS.count("|") - 1), *(f"| {' | '.join(row.cells)} |" for row in rows)]
    text = "\n".join(lines) + "\n"
    (given.out / "lsnc.md").write_text(text, "utf-8")
    print(text, end="")


if __name__ == "__main__":
    main()
