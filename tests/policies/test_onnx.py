"""ONNX graphs, written by hand, against the reference evaluator and against numpy."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from certify.errors import InputError
from certify.policies.importers import ImportOptions, import_policy
from tests.support.foreign import plant

SAID = ImportOptions(states=("x0", "x1"), normaliser="none", action_scale=(Fraction(1),))
RNG = np.random.default_rng(5)
W1, B1 = RNG.standard_normal((2, 6)).astype(np.float32), RNG.standard_normal(6).astype(np.float32)
W2, B2 = RNG.standard_normal((6, 1)).astype(np.float32), RNG.standard_normal(1).astype(np.float32)
MEAN, STD = np.float32([0.1, -0.2]), np.float32([0.3, 1.7])
X = RNG.uniform(-1, 1, (300, 2))
CONSTANTS = {"W1": W1, "B1": B1, "W2": W2, "B2": B2, "W1t": W1.T.copy(), "mean": MEAN, "std": STD}
CONSTANTS |= {"three": np.float32(3), "lo": np.float32(-1), "hi": np.float32(1.5), "zero": np.float32(0)}


def node(kind: str, *inputs: str, out: str = "", **attributes: Any) -> onnx.NodeProto:
    return helper.make_node(kind, list(inputs), [out or f"{kind}{len(inputs)}{'_'.join(inputs)}"], **attributes)


def chain(*operations: tuple[Any, ...]) -> list[onnx.NodeProto]:
    """Nodes one behind the other; `*` stands for what the one before made."""
    nodes, last = [], "x"
    for k, (kind, *inputs) in enumerate(operations):
        attributes = inputs.pop() if isinstance(inputs[-1], dict) else {}
        out = "u" if k == len(operations) - 1 else f"h{k}"
        nodes.append(node(kind, *(last if i == "*" else i for i in inputs), out=out, **attributes))
        last = out
    return nodes


def model(
    nodes: list[onnx.NodeProto], constants: dict[str, np.ndarray] | None = None, kind: int = TensorProto.FLOAT
) -> Any:
    used = {i for n in nodes for i in n.input}
    tensors = [numpy_helper.from_array(a, k) for k, a in (constants or CONSTANTS).items() if k in used]
    ends = [helper.make_tensor_value_info(name, kind, ["batch", size]) for name, size in (("x", 2), ("u", 1))]
    graph = helper.make_graph(nodes, "policy", [ends[0]], [ends[1]], tensors)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])


def written(folder: Path, made: Any) -> Path:
    (folder / "policy.onnx").write_bytes(made.SerializeToString())
    return folder / "policy.onnx"


def net(x: np.ndarray) -> np.ndarray:
    w1, b1, w2, b2 = (a.astype(float) for a in (W1, B1, W2, B2))
    result: np.ndarray = np.tanh(x @ w1 + b1) @ w2 + b2
    return result


MLP = (("Gemm", "*", "W1", "B1"), ("Tanh", "*"), ("Gemm", "*", "W2", "B2"))
NORMALISED = (X - MEAN.astype(float)) / STD.astype(float)
GRAPHS = {
    "gemm": (MLP, net(X)),
    "transposed": ((("Gemm", "*", "W1t", "B1", {"transB": 1}), *MLP[1:]), net(X)),
    "matmul and add": (
        (("MatMul", "*", "W1"), ("Add", "B1", "*"), ("Tanh", "*"), ("MatMul", "*", "W2"), ("Add", "*", "B2")),
        net(X),
    ),
    "alpha and beta": (
        (("Gemm", "*", "W1", "B1", {"alpha": 0.5, "beta": 2.0}), *MLP[1:]),
        np.tanh(0.5 * (X @ W1.astype(float)) + 2 * B1.astype(float)) @ W2.astype(float) + B2.astype(float),
    ),
    "normalised": ((("Sub", "*", "mean"), ("Div", "*", "std"), *MLP), net(NORMALISED)),
    "reversed": ((("Sub", "mean", "*"), ("Mul", "three", "*"), *MLP), net(3 * (MEAN.astype(float) - X))),
    "squashed": ((*MLP, ("Tanh", "*"), ("Mul", "*", "three"), ("Neg", "*"), ("Identity", "*")), -3 * np.tanh(net(X))),
    "clipped": ((*MLP, ("Clip", "*", "lo", "hi")), np.clip(net(X), -1, 1.5)),
    "relu of tanh": ((*MLP, ("Tanh", "*"), ("Relu", "*"), ("Mul", "*", "three")), 3 * np.maximum(np.tanh(net(X)), 0)),
}  # fmt: skip


@pytest.mark.parametrize("name", GRAPHS)
def test_graphs(name: str, tmp_path: Path) -> None:
    operations, expected = GRAPHS[name]
    imported = import_policy(written(tmp_path, model(chain(*operations))), plant(), SAID)
    assert np.max(np.abs(imported.policy.network(X, (Fraction(0),)) - expected)) < 1e-12
    assert imported.difference.in_double < 1e-12 and imported.difference.largest < 1e-4


def test_double_precision_and_constants_in_nodes(tmp_path: Path) -> None:
    doubles = {k: v.astype(np.float64) / 3 for k, v in CONSTANTS.items()}
    doubles["B1"] = doubles["B1"].astype(np.float16).astype(np.float64)
    constants = [
        helper.make_node("Constant", [], ["B1"], value=numpy_helper.from_array(doubles.pop("B1"), "B1")),
    ]
    made = model([*constants, *chain(*MLP)], doubles, TensorProto.DOUBLE)
    imported = import_policy(written(tmp_path, made), plant(), SAID)
    assert imported.difference.largest < 1e-13
    half = {k: v.astype(np.float16) for k, v in CONSTANTS.items()}  # a framework would compute in it too
    with pytest.raises(InputError, match="float32 or float64"):
        import_policy(written(tmp_path, model(chain(*MLP), half)), plant(), SAID)


def test_an_observation_that_is_clipped_in_the_graph(tmp_path: Path) -> None:
    operations = (("Sub", "*", "mean"), ("Div", "*", "std"), ("Clip", "*", "lo", "hi"), *MLP)
    imported = import_policy(written(tmp_path, model(chain(*operations))), plant(), SAID)
    mean, std = MEAN.astype(float), STD.astype(float)
    np.testing.assert_allclose(imported.policy.valid, np.stack([mean - std, mean + 1.5 * std], 1), rtol=1e-15)


def other_file(made: Any) -> Any:
    tensor = made.graph.initializer[0]
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    entry = tensor.external_data.add()
    entry.key, entry.value = "location", "/etc/passwd"
    return made


def two_inputs(made: Any) -> Any:
    made.graph.input.append(helper.make_tensor_value_info("y", TensorProto.FLOAT, [1, 2]))
    return made


def shape_that_lies(made: Any) -> Any:
    made.graph.initializer[0].dims[0] = 2**40
    return made


def own_operator(made: Any) -> Any:
    made.opset_import.append(helper.make_opsetid("ai.onnx.contrib", 1))
    return made


def no_operator_set(made: Any) -> Any:
    made.ClearField("opset_import")
    return made


def twice(made: Any) -> Any:
    made.graph.initializer.append(made.graph.initializer[0])
    return made


def function(made: Any) -> Any:
    made.functions.append(helper.make_function("", "Tanh", ["a"], ["b"], [helper.make_node("Relu", ["a"], ["b"])], []))
    return made


TWO = (("Gemm", "*", "W1", "B1"), ("Tanh", "*"))
REFUSED = {
    "relu": (model(chain(MLP[0], ("Relu", "*"), MLP[2])), "ReLU between its layers"),
    "elu": (model(chain(MLP[0], ("Elu", "*"), MLP[2])), "Elu .*only tanh networks are proved"),
    "sigmoid": (model(chain(*MLP, ("Sigmoid", "*"))), "Sigmoid"),
    "another file": (other_file(model(chain(*MLP))), "must lie in the file itself"),
    "two inputs": (two_inputs(model(chain(*MLP))), "one input"),
    "a shape that lies": (shape_that_lies(model(chain(*MLP))), "damaged"),
    "an operator of its own": (own_operator(model(chain(*MLP))), "standard operators"),
    "a function that redefines tanh": (function(model(chain(*MLP))), "standard operators"),
    "no set of operators": (no_operator_set(model(chain(*MLP))), "evaluator of the onnx package"),
    "a tensor twice": (twice(model(chain(*MLP))), "once"),
    "a branch": (model([*chain(*TWO), node("Add", "h0", "u", out="v")]), "must join one value|one value"),
    "integers": (model(chain(*MLP), {**CONSTANTS, "W1": np.ones((2, 6), np.int64)}), "floating-point"),
    "nan": (model(chain(*MLP), {**CONSTANTS, "B1": B1 * np.nan}), "finite"),
    "a zero": (model(chain(("Div", "*", "zero"), *MLP)), "divides by 0"),
    "transposed observation": (model(chain(("Gemm", "*", "W1", "B1", {"transA": 1}), *MLP[1:])), "transpose"),
    "an unknown attribute": (model(chain(("Gemm", "*", "W1", "B1", {"other": 1}), *MLP[1:])), "other"),
    "matmul from the left": (model(chain(("MatMul", "W1t", "*"), *MLP[1:])), "not read"),
    "a column of constants": (model(chain(*MLP, ("Add", "*", "W2"))), "one for each component"),
    "a missing value": (model(chain(("Gemm", "*", "W9", "B1"), *MLP[1:])), "nothing before it makes"),
    "no dependence": (
        model([node("Identity", "x", out="h"), node("Constant", out="u", value_float=1.0)]),
        "does not depend",
    ),
    "no layer": (model(chain(("Tanh", "*"))), "must have a layer"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_refused_graphs(name: str, tmp_path: Path) -> None:
    made, message = REFUSED[name]
    with pytest.raises(InputError, match=message):
        import_policy(written(tmp_path, made), plant(), SAID)


def test_damaged_files_and_missing_packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = written(tmp_path, model(chain(*MLP)))
    with pytest.raises(InputError, match="must be left out: a file of onnx"):
        import_policy(path, plant(), replace(SAID, activation="tanh"))
    monkeypatch.setitem(__import__("sys").modules, "onnx", None)
    with pytest.raises(InputError, match=r"pip install 'certify\[onnx\]'"):
        import_policy(path, plant(), SAID)
    monkeypatch.undo()
    path.write_bytes(b"\x0a\xff\xff noise")
    with pytest.raises(InputError, match="no ONNX file"):
        import_policy(path, plant(), SAID)
