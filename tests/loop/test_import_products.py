"""Layer normalisation and gates of other programs: modules, TorchScript and ONNX are read, and rounding stays small."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from onnx import helper, numpy_helper

from certify.errors import InputError
from certify.loop.networks import Observe, Product, values
from certify.loop.policies.importers import ImportOptions, import_policy
from certify.loop.policies.importers.memory import import_module
from certify.loop.policies.importers.steps import layer_normalised
from tests.support.foreign import plant

SAID = ImportOptions(states=("x0", "x1"), normaliser="none", action_scale=(Fraction(1),))
X = np.random.default_rng(1).uniform(-1, 1, (50, 2))


class Gated(torch.nn.Module):
    """tanh(A x) * sigmoid(B x), one number times all, and a product of a value with itself."""

    def __init__(self) -> None:
        super().__init__()
        self.a, self.b, self.one = torch.nn.Linear(2, 6), torch.nn.Linear(2, 6), torch.nn.Linear(2, 1)
        self.last = torch.nn.Linear(6, 1)

    def forward(self, x: torch.Tensor) -> Any:
        h = torch.tanh(self.a(x)) * torch.sigmoid(self.b(x))
        return self.last(self.one(x) * h + h * h)


def normalised(*more: torch.nn.Module, width: int = 12, **said: Any) -> torch.nn.Sequential:
    torch.manual_seed(3)
    norm = torch.nn.LayerNorm(width, **said)
    if norm.weight is not None:
        torch.nn.init.normal_(norm.weight)
        torch.nn.init.normal_(norm.bias)
    return torch.nn.Sequential(torch.nn.Linear(2, width), norm, *more, torch.nn.Linear(width, 1))


MODULES: dict[str, Any] = {
    "layer norm": normalised(torch.nn.Tanh()),
    "another epsilon": normalised(torch.nn.Tanh(), eps=0.5),
    "without gain and bias": normalised(torch.nn.ReLU(), elementwise_affine=False),
    "one entry": normalised(torch.nn.Tanh(), width=1),
    "of observations": torch.nn.Sequential(torch.nn.LayerNorm(2), torch.nn.Linear(2, 1)),
    "last": torch.nn.Sequential(torch.nn.Linear(2, 4), torch.nn.LayerNorm(4), torch.nn.Linear(4, 1), torch.nn.Tanh()),
    "hardswish": torch.nn.Sequential(torch.nn.Linear(2, 6), torch.nn.Hardswish(), torch.nn.Linear(6, 1)),
    "gates": Gated(),
}


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("name", MODULES)
def test_a_module_is_what_it_computes(name: str, tmp_path: Path) -> None:
    module = MODULES[name].eval()
    read = import_module(module, plant(), SAID)
    with torch.no_grad():
        expected = module.double()(torch.tensor(X)).numpy()
        module.float()
    network = read.policy.network
    assert any(isinstance(step, Product) for step in network.network.steps)
    raw = values(network.network, X)
    found = (np.tanh(raw) if network.squash == "tanh" else raw) * network.scale + network.offset
    assert np.allclose(found, expected, atol=1e-6, rtol=1e-6)
    traced = torch.jit.trace(module, torch.zeros(1, 2))
    torch.jit.save(traced, tmp_path / "m.pt")
    assert import_policy(tmp_path / "m.pt", plant(), SAID).policy.network.sha256() == network.sha256()


def of_onnx(folder: Path, nodes: list[Any], **numbers: Any) -> Any:
    rng = np.random.default_rng(0)
    held = {"W": rng.normal(size=(2, 6)), "B": rng.normal(size=6), "U": rng.normal(size=(6, 1)), **numbers}
    used = {i for n in nodes for i in n.input}
    tensors = [numpy_helper.from_array(np.float32(a), k) for k, a in held.items() if k in used]
    ends = [helper.make_tensor_value_info(k, 1, ["batch", size]) for k, size in (("x", 2), ("u", 1))]
    graph = helper.make_graph(nodes, "policy", ends[:1], ends[1:], tensors)
    path = folder / "policy.onnx"
    path.write_bytes(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)]).SerializeToString())
    return import_policy(path, plant(), SAID).policy.network.network


def between(*nodes: Any) -> list[Any]:
    return [
        helper.make_node("Gemm", ["x", "W", "B"], ["h"]),
        *nodes,
        helper.make_node("MatMul", ["v", "U"], ["u"]),
    ]


G, S = np.linspace(0.5, 2, 6), np.linspace(-1, 1, 6)
NODES = {
    "normalised": [helper.make_node("LayerNormalization", ["h", "G", "S"], ["v"], axis=-1, epsilon=1e-3)],
    "without bias": [helper.make_node("LayerNormalization", ["h", "G"], ["v"])],
    "a gate": [helper.make_node("Sigmoid", ["h"], ["s"]), helper.make_node("Tanh", ["h"], ["t"]),
               helper.make_node("Mul", ["s", "t"], ["v"])],
    "a square": [helper.make_node("Mul", ["h", "h"], ["v"])],
}  # fmt: skip


@pytest.mark.parametrize("name", NODES)
def test_graphs_of_onnx_have_products(name: str, tmp_path: Path) -> None:
    net = of_onnx(tmp_path, between(*NODES[name]), G=G, S=S)
    assert any(isinstance(step, Product) for step in net.steps)


def test_silu_stays_one_function(tmp_path: Path) -> None:
    nodes = [helper.make_node("Sigmoid", ["h"], ["s"]), helper.make_node("Mul", ["h", "s"], ["v"])]
    assert of_onnx(tmp_path, between(*nodes)).functions == ("silu",)


@pytest.mark.parametrize("axis", [0, -2])
def test_another_axis_is_refused(axis: int, tmp_path: Path) -> None:
    nodes = [helper.make_node("LayerNormalization", ["h", "G"], ["v"], axis=axis)]
    with pytest.raises(InputError, match=r"LayerNormalization .*is not read"):
        of_onnx(tmp_path, between(*nodes), G=G)


def test_a_layer_normalisation_without_epsilon_is_refused() -> None:
    with pytest.raises(InputError, match="must be positive"):
        layer_normalised(3, Fraction(0))
    with pytest.raises(InputError, match="must be positive"):
        import_module(normalised(eps=0.0), plant(), SAID)


def test_the_inverse_root_is_an_observation_of_one_number() -> None:
    net = import_module(MODULES["layer norm"], plant(), SAID).policy.network.network
    assert [len(step.symbols) for step in net.steps if isinstance(step, Observe)] == [1]
