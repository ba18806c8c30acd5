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
from certify.loop.policies.importers import ImportOptions, import_policy
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


@pytest.mark.parametrize("kind", ["Elu", "Selu", "Celu"])
def test_the_branch_that_an_elu_does_not_take_may_overflow(tmp_path: Path, kind: str) -> None:
    """Without a word: numpy warned of it in the user's terminal, and a warning is an error in tests."""
    steep = CONSTANTS | {"W1": np.float32(1e4) * W1}
    operations = (("Gemm", "*", "W1", "B1"), (kind, "*"), ("Gemm", "*", "W2", "B2"))
    imported = import_policy(written(tmp_path, model(chain(*operations), steep)), plant(), SAID)
    assert np.all(np.isfinite(imported.policy.network(X, (Fraction(0),))))


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


@pytest.mark.parametrize("axes", [1, 2])
def test_operands_are_broadcast_before_opset_7_as_numpy_does_it(axes: int, tmp_path: Path) -> None:
    """As MATLAB writes them: the numbers of a row, or a row."""
    said = {"broadcast": 1} if axes == 1 else {"broadcast": 0}
    operations = (
        *(("Sub", "*", "mean", said), ("Div", "*", "std", said), ("Gemm", "*", "W1", "B1", said), ("Tanh", "*")),
        *(("MatMul", "*", "W2"), ("Add", "*", "B2", said), ("Mul", "*", "three", {"broadcast": 1})),
    )
    rows = {name: CONSTANTS[name].reshape((1, -1)[2 - axes :]) for name in ("mean", "std", "B1", "B2")}
    made = model(chain(*operations), CONSTANTS | rows)
    made.opset_import[0].version = 6
    imported = import_policy(written(tmp_path, made), plant(), SAID)
    expected = 3 * net(NORMALISED)
    assert np.max(np.abs(imported.policy.network(X, (Fraction(0),)) - expected)) < 1e-12
    made.graph.node[0].attribute.append(helper.make_attribute("axis", 0))
    with pytest.raises(InputError, match=r"Sub .* has axis, broadcast, which is not read"):
        import_policy(written(tmp_path, made), plant(), SAID)
    del made.graph.node[0].attribute[1]
    made.opset_import[0].version = 7
    with pytest.raises(InputError, match=r"Sub .* has broadcast, which is not read"):
        import_policy(written(tmp_path, made), plant(), SAID)


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


def own_operator(made: Any, used: bool = True) -> Any:
    made.opset_import.append(helper.make_opsetid("ai.onnx.ml", 3))
    made.graph.node[1].domain = "ai.onnx.ml" if used else ""
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
    "another file": (other_file(model(chain(*MLP))), "must lie in the file itself"),
    "two inputs": (two_inputs(model(chain(*MLP))), "one input"),
    "a shape that lies": (shape_that_lies(model(chain(*MLP))), "damaged"),
    "an operator of its own": (own_operator(model(chain(*MLP))), "found ai.onnx.ml.Tanh"),
    "a function that redefines tanh": (function(model(chain(*MLP))), "standard operators"),
    "no set of operators": (no_operator_set(model(chain(*MLP))), "evaluator of the onnx package"),
    "a tensor twice": (twice(model(chain(*MLP))), "once"),
    "a quotient": (model([*chain(*TWO)[:1], node("Tanh", "h0", out="v"), node("Div", "h0", "v", out="u")]), "divides"),
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
    with pytest.raises(InputError, match=r"pip install '\.\[onnx\]'"):
        import_policy(path, plant(), SAID)
    monkeypatch.undo()
    path.write_bytes(b"\x0a\xff\xff noise")
    with pytest.raises(InputError, match="no ONNX file"):
        import_policy(path, plant(), SAID)


def test_a_set_of_operators_that_no_node_is_of(tmp_path: Path) -> None:
    """tf2onnx writes one of machine learning beside the standard one."""
    imported = import_policy(written(tmp_path, own_operator(model(chain(*MLP)), used=False)), plant(), SAID)
    assert np.max(np.abs(imported.policy.network(X, (Fraction(0),)) - net(X))) < 1e-12


# ------------------------------------------------------------------------------------------- layers as convolutions


IMAGES = {  # layers as MATLAB writes them: a kernel as large as the image
    "image": MEAN.reshape(1, 1, 1, 2), "K1": W1.T.reshape(6, 1, 1, 2), "K2": W2.T.reshape(1, 6, 1, 1),
    "half": W1.T[:, :1].reshape(6, 1, 1, 1), "b": B1, "c": B2, "upright": W1.T.reshape(6, 1, 2, 1),
    "two": MEAN.reshape(1, 2, 1, 1),
}  # fmt: skip
CONVOLVED = (("Sub", "*", "image"), ("Conv", "*", "K1", "b"), ("Tanh", "*"), ("Conv", "*", "K2", "c"), ("Flatten", "*"))


def of_images(operations: tuple[Any, ...], shape: tuple[Any, ...] = (1, 1, 1, 2)) -> Any:
    made = model(chain(*operations), IMAGES)
    made.graph.input[0].CopyFrom(helper.make_tensor_value_info("x", TensorProto.FLOAT, shape))
    return made


def test_layers_as_convolutions(tmp_path: Path) -> None:
    imported = import_policy(written(tmp_path, of_images(CONVOLVED)), plant(), SAID)
    assert np.max(np.abs(imported.policy.network(X, (Fraction(0),)) - net(X - MEAN.astype(float)))) < 1e-12
    assert imported.difference.in_double < 1e-12


def changed(k: int, *operation: Any) -> tuple[Any, ...]:
    return (*CONVOLVED[:k], operation, *CONVOLVED[k + 1 :])


NO_LAYERS = {
    "a kernel that moves over the image": (of_images(changed(1, "Conv", "*", "half", "b")), "as large as its image"),
    "padding": (of_images(changed(1, "Conv", "*", "K1", "b", {"pads": [0, 1, 0, 1]})), "padding"),
    "padding by itself": (of_images(changed(1, "Conv", "*", "K1", "b", {"auto_pad": "SAME_UPPER"})), "padding"),
    "dilation": (of_images(changed(1, "Conv", "*", "K1", "b", {"dilations": [1, 2]})), "dilation"),
    "groups": (of_images(changed(3, "Conv", "*", "K2", "c", {"group": 2})), "one group"),
    "a kernel that stands upright": (of_images(changed(1, "Conv", "*", "upright", "b")), "evaluat"),
    "an image of open size": (of_images(CONVOLVED, (1, 1, 1, "n")), "whose size the graph says"),
    "a mean of channels": (of_images(changed(0, "Sub", "*", "two")), "shape"),
}


@pytest.mark.parametrize("name", NO_LAYERS)
def test_convolutions_that_are_no_layers(name: str, tmp_path: Path) -> None:
    made, message = NO_LAYERS[name]
    with pytest.raises(InputError, match=message):
        import_policy(written(tmp_path, made), plant(), SAID)


# --------------------------------------------------------------------------------- what exporters write around layers

SHAPE = numpy_helper.from_array(np.array([-1, 1], np.int64), "shape")


def like_stable_baselines() -> Any:
    """The graph that PPO of stable-baselines3 exports: a Flatten, an action, a value and the log of a probability."""
    nodes = [
        node("Cast", "x", out="cast", to=TensorProto.FLOAT),
        node("Flatten", "cast", out="flat", axis=1),
        node("Gemm", "flat", "W1", "B1", out="h"),
        node("Tanh", "h", out="latent"),
        node("Gemm", "latent", "W2", "same", out="value"),
        node("Identity", "B2", out="same"),
        node("Gemm", "latent", "W2", "same", out="mu"),
        node("Exp", "log_std", out="spread"),
        node("Shape", "mu", out="size"),
        node("ConstantOfShape", "size", out="zeros", value=numpy_helper.from_array(np.float32([0]), "z")),
        node("Add", "zeros", "mu", out="sum"),
        node("Add", "sum", "spread", out="both"),
        node("Shape", "both", out="size2"),
        node("Expand", "mu", "size2", out="expanded"),
        node("Reshape", "expanded", "shape", out="action"),
        node("Pow", "expanded", "spread", out="log_prob"),
    ]
    nodes[4], nodes[5] = nodes[5], nodes[4]
    made = model(nodes, CONSTANTS | {"log_std": np.float32([0])})
    made.graph.initializer.append(SHAPE)
    del made.graph.output[:]
    for name in ("action", "value", "log_prob"):
        made.graph.output.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", 1]))
    return made


def test_the_graph_of_stable_baselines_is_read_and_its_outputs_are_named(tmp_path: Path) -> None:
    path = written(tmp_path, like_stable_baselines())
    with pytest.raises(InputError, match=r"it has action, value, log_prob\. Say .* --output action"):
        import_policy(path, plant(), SAID)
    with pytest.raises(InputError, match=r"must name an output of policy\.onnx, action, value, log_prob; found 'mu'"):
        import_policy(path, plant(), replace(SAID, output="mu"))
    imported = import_policy(path, plant(), replace(SAID, output="action"))
    assert np.max(np.abs(imported.policy.network(X, (Fraction(0),)) - net(X))) < 1e-12
    assert imported.difference.in_double < 1e-12
    assert imported.not_read == {"log_std": "action does not depend on it"}
    assert imported.compared_with is not None and "run by the reference evaluator of onnx" in imported.compared_with
    assert imported.policy.training["imported"]["options"]["--output"] == "action"


def test_an_exported_policy_of_stable_baselines(tmp_path: Path) -> None:
    """By torch's own exporter, as the documentation of stable-baselines3 has it."""
    import warnings

    import torch

    from tests.support.foreign import sb3

    class Exported(torch.nn.Module):
        def __init__(self, policy: Any) -> None:
            super().__init__()
            self.policy = policy

        def forward(self, x: torch.Tensor) -> Any:
            return self.policy(x, deterministic=True)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model_, _, _, _ = sb3("PPO", tmp_path)
        with torch.no_grad():
            for parameter in model_.policy.parameters():
                parameter.add_(0.1 * torch.randn_like(parameter))
        names = {"input_names": ["x"], "output_names": ["action", "value", "log_prob"]}
        torch.onnx.export(
            Exported(model_.policy), (torch.zeros(1, 2),), str(tmp_path / "p.onnx"), dynamo=False, **names
        )
    imported = import_policy(tmp_path / "p.onnx", plant(), replace(SAID, output="action"))
    with torch.no_grad():
        theirs = model_.policy(torch.tensor(X, dtype=torch.float32), deterministic=True)[0].numpy()
    assert np.max(np.abs(imported.policy.network(X, (Fraction(0),)) - theirs)) < 1e-5
    assert "policy.log_std" in imported.not_read


def shaped(kind: str, *inputs: str, shape: list[int] | None = None, **attributes: Any) -> Any:
    made = model([*chain(*MLP[:2]), node(kind, "u", *inputs, out="v", **attributes), node("Gemm", "v", "W2", out="w")])
    made.graph.output[0].name = "w"
    if shape is not None:
        made.graph.initializer.append(numpy_helper.from_array(np.array(shape, np.int64), "s"))
    return made


SHAPED = {
    "a column": (shaped("Flatten", axis=0), "Flatten .* is not read"),
    "another width": (shaped("Reshape", "s", shape=[-1, 3]), "Reshape .* is not read"),
    "another rank": (shaped("Reshape", "s", shape=[-1, 2, 3]), "Reshape .* is not read"),
    "allowzero": (shaped("Reshape", "s", shape=[0, -1], allowzero=1), "Reshape .* is not read"),
    "integers": (shaped("Cast", to=TensorProto.INT64), "must be a cast to float32 or float64"),
    "half precision": (shaped("Cast", to=TensorProto.FLOAT16), "must be a cast to float32 or float64"),
    "an unknown shape": (shaped("Expand", "s", shape=[1, 6]), "as wide as it is"),
    "a normalisation": (shaped("InstanceNormalization", "B1", "B1"), "train the policy again without it"),
    "a mean": (shaped("ReduceMean"), "a part of LayerNorm"),
    "a prelu": (shaped("ThresholdedRelu"), r"The activations that are proved are .*activation_fn=torch\.nn\.Tanh"),
}


@pytest.mark.parametrize("name", SHAPED)
def test_what_changes_a_value_is_refused(name: str, tmp_path: Path) -> None:
    made, message = SHAPED[name]
    with pytest.raises(InputError, match=message):
        import_policy(written(tmp_path, made), plant(), SAID)


def test_shapes_that_change_nothing_are_read(tmp_path: Path) -> None:
    first = ("Gemm", "*", "W1", "B1"), ("Tanh", "*")
    for more in (("Flatten", "*", {"axis": 1}), ("Flatten", "*"), ("Reshape", "*", "s"), ("Reshape", "*", "t")):
        made = model(chain(*first, more, MLP[2]))
        for name, shape in (("s", [-1, 6]), ("t", [0, -1])):
            made.graph.initializer.append(numpy_helper.from_array(np.array(shape, np.int64), name))
        imported = import_policy(written(tmp_path, made), plant(), SAID)
        assert np.max(np.abs(imported.policy.network(X, (Fraction(0),)) - net(X))) < 1e-12


# ------------------------------------------------------------------------------------------ weights in a second file


def beside(folder: Path, **entries: str) -> Path:
    """The model with its weights in a second file, and entries of the first tensor changed."""
    made = model(chain(*MLP))
    onnx.save_model(
        made, folder / "policy.onnx", save_as_external_data=True, location="policy.onnx.data", size_threshold=0
    )
    made = onnx.load(folder / "policy.onnx", load_external_data=False)
    tensor = made.graph.initializer[0]
    said = {e.key: e.value for e in tensor.external_data} | entries
    del tensor.external_data[:]
    for key, value in said.items():
        entry = tensor.external_data.add()
        entry.key, entry.value = key, value
    return written(folder, made)


def test_weights_in_a_file_beside_the_model_are_read(tmp_path: Path) -> None:
    import hashlib

    imported = import_policy(beside(tmp_path), plant(), SAID)
    assert np.max(np.abs(imported.policy.network(X, (Fraction(0),)) - net(X))) < 1e-12
    digest = hashlib.sha256((tmp_path / "policy.onnx.data").read_bytes()).hexdigest()
    assert imported.policy.training["imported"]["beside_sha256"] == {"policy.onnx.data": digest}


PLACES = ["../policy.onnx.data", "/etc/passwd", "sub/policy.onnx.data", "..", "", "a\\b", "c:x", "a\0b"]


@pytest.mark.parametrize("place", PLACES)
def test_weights_elsewhere_are_not_read(place: str, tmp_path: Path) -> None:
    (tmp_path / "inner").mkdir()
    path = beside(tmp_path / "inner", location=place)
    for folder in (tmp_path, tmp_path / "inner" / "sub"):
        folder.mkdir(exist_ok=True)
        (folder / "policy.onnx.data").write_bytes((tmp_path / "inner" / "policy.onnx.data").read_bytes())
    with pytest.raises(InputError, match=r"one beside it under a plain name.*external_data=False"):
        import_policy(path, plant(), SAID)


def test_weights_that_are_no_plain_file_are_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import os

    path, data = beside(tmp_path), tmp_path / "policy.onnx.data"
    content = data.read_bytes()
    (tmp_path / "elsewhere").write_bytes(content)
    for make, message in (
        (lambda: None, "Put it there. .*external_data=False"),
        (lambda: data.symlink_to(tmp_path / "elsewhere"), "no link"),
        (lambda: os.mkfifo(data), "plain file"),
        (data.mkdir, "plain file"),
    ):
        if data.is_dir():
            data.rmdir()
        data.unlink(missing_ok=True)
        make()
        with pytest.raises(InputError, match=message):
            import_policy(path, plant(), SAID)
    data.rmdir()
    data.write_bytes(content)
    assert import_policy(path, plant(), SAID).difference.in_double < 1e-12
    monkeypatch.setattr("certify.loop.policies.importers.onnx_weights.MAX_BYTES", len(content) - 1)
    with pytest.raises(InputError, match="at most 0 MiB"):
        import_policy(path, plant(), SAID)


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"offset": "100000"}, "must lie inside of policy.onnx.data"),
        ({"length": "100000"}, "must lie inside of policy.onnx.data"),
        ({"offset": "-4"}, "whole numbers of bytes"),
        ({"length": "1e3"}, "whole numbers of bytes"),
        ({"offset": "9" * 400}, "whole numbers of bytes"),
        ({"length": "4"}, "damaged"),
    ],
)
def test_weights_that_reach_out_of_their_file_are_refused(
    entries: dict[str, str], message: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=message):
        import_policy(beside(tmp_path, **entries), plant(), SAID)


def test_many_tensors_of_one_region_count_each(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = beside(tmp_path, offset="0", length=str((tmp_path / "x").write_bytes(b"") or 48))
    size = (tmp_path / "policy.onnx.data").stat().st_size
    monkeypatch.setattr("certify.loop.policies.importers.onnx_weights.MAX_BYTES", size)
    made = onnx.load(path, load_external_data=False)
    for tensor in made.graph.initializer:
        del tensor.external_data[:]
        for key, value in (("location", "policy.onnx.data"), ("offset", "0"), ("length", str(size))):
            entry = tensor.external_data.add()
            entry.key, entry.value = key, value
    with pytest.raises(InputError, match=r"the tensors of policy\.onnx must have at most"):
        import_policy(written(tmp_path, made), plant(), SAID)


@pytest.mark.parametrize(("beta", "threshold"), [(None, 20.0), (3.0, 20.0), (None, 19.0), (3.0, 19.0)])
def test_softplus_with_its_threshold(beta: float | None, threshold: float, tmp_path: Path) -> None:
    """torch's newer exporter writes Where(beta h > 20, h, softplus(beta h) / beta); with 19 it is no softplus."""
    nodes = [node("Gemm", "x", "W1", "B1", out="h")]
    nodes += [node("Mul", "h", "beta", out="s")] if beta else []
    scaled = "s" if beta else "h"
    nodes += [node("Softplus", scaled, out="p")] + ([node("Div", "p", "beta", out="q")] if beta else [])
    nodes += [node("Greater", scaled, "most", out="above"), node("Where", "above", "h", "q" if beta else "p", out="v")]
    constants = CONSTANTS | {"most": np.float32(threshold), "beta": np.float32(beta or 1)}
    path = written(tmp_path, model([*nodes, node("Gemm", "v", "W2", "B2", out="u")], constants))
    if threshold < 20:
        with pytest.raises(InputError, match="but for softplus"):
            import_policy(path, plant(), SAID)
        return
    found = import_policy(path, plant(), SAID).policy.network(X, plant().exact_u_eq())
    hidden = X @ W1.astype(float) + B1
    soft = np.logaddexp(0, (beta or 1) * hidden) / (beta or 1)
    assert np.allclose(found, soft @ W2.astype(float) + B2, atol=1e-12)


def test_where_between_other_values_is_refused(tmp_path: Path) -> None:
    nodes = [node("Gemm", "x", "W1", "B1", out="h"), node("Greater", "h", "hi", out="above")]
    for one, other in (("h", "h"), ("x", "h")):
        end = [node("Where", "above", one, other, out="v"), node("Gemm", "v", "W2", "B2", out="u")]
        with pytest.raises(InputError, match="but for softplus"):
            import_policy(written(tmp_path, model([*nodes, *end])), plant(), SAID)


def test_entries_of_a_row_are_taken_along_the_row_alone(tmp_path: Path) -> None:
    ends = {"one": np.array([1]), "zero": np.array([0]), "three": np.array([3]), "two": np.array([2])}
    for axis, step, message in (("one", "one", None), ("zero", "one", "axis 1"), ("one", "two", "axis 1")):
        nodes = [node("Gemm", "x", "W1", "B1", out="h"), node("Slice", "h", "one", "three", axis, step, out="v")]
        path = written(
            tmp_path,
            model(
                [*nodes, node("ReduceSum" if message else "Gemm", "v", "W3", out="u")],
                CONSTANTS | ends | {"W3": W2[:2]},
            ),
        )
        if message is None:
            found = import_policy(path, plant(), SAID).policy.network(X, plant().exact_u_eq())
            assert np.allclose(found, (X @ W1.astype(float) + B1)[:, 1:3] @ W2[:2].astype(float), atol=1e-13)
        else:
            with pytest.raises(InputError, match=message):
                import_policy(path, plant(), SAID)
