"""Operations that are read as several steps: GELU's tanh form, softsign, hard functions and layer normalisation."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from onnx import TensorProto, helper, numpy_helper

from certify import RoaOptions, Verdict, certify_roa
from certify.errors import InputError
from certify.loop.policies.importers import Imported, ImportOptions, import_policy
from certify.loop.policies.importers.memory import import_module, import_state_dict
from certify.loop.policies.importers.steps import layer_normalised
from tests.support.foreign import plant
from tests.support.marks import slow_after

nn: Any = torch.nn
jit: Any = torch.jit
SAID = ImportOptions(states=("x0", "x1"), normaliser="none", action_scale=(Fraction(1),))
X = np.random.default_rng(1).uniform(-3, 3, (1000, 2))
G, S = np.linspace(0.5, 2, 6), np.linspace(-1, 1, 6)
FORMULAS: dict[str, Any] = {
    "tanh form of gelu": lambda h: nn.functional.gelu(h, approximate="tanh"),
    "gelu": nn.functional.gelu,
    "softsign": nn.functional.softsign,
    "hardswish": nn.functional.hardswish,
    "hardsigmoid": lambda h: torch.clamp(float(np.float32(0.3)) * h + float(np.float32(0.4)), 0, 1),
    "hardsigmoid as torch has it": lambda h: torch.clamp(float(np.float32(0.2)) * h + 0.5, 0, 1),
    "layer norm": lambda h: nn.functional.layer_norm(h, (6,), torch.tensor(G), torch.tensor(S), 0.25),
    "root mean square": lambda h: h / torch.sqrt((h**2).mean(1, keepdim=True) + 0.25),
    "cube": lambda h: h**3,
    "magnitude": torch.abs,
}
N = helper.make_node
GRAPHS: dict[str, tuple[str, int, list[Any]]] = {
    "gelu": ("tanh form of gelu", 20, [N("Gelu", ["h"], ["v"], approximate="tanh")]),
    "gelu written out": ("tanh form of gelu", 17, [
        N("Pow", ["h", "three"], ["p"]), N("Mul", ["p", "c"], ["q"]), N("Add", ["h", "q"], ["r"]),
        N("Mul", ["r", "k"], ["s"]), N("Tanh", ["s"], ["t"]), N("Add", ["t", "one"], ["g"]),
        N("Mul", ["h", "half"], ["f"]), N("Mul", ["f", "g"], ["v"])]),
    "gelu of products": ("tanh form of gelu", 17, [
        N("Mul", ["h", "h"], ["o"]), N("Mul", ["h", "o"], ["p"]), N("Mul", ["c", "p"], ["q"]),
        N("Add", ["q", "h"], ["r"]), N("Mul", ["r", "k"], ["s"]), N("Tanh", ["s"], ["t"]),
        N("Add", ["one", "t"], ["g"]), N("Mul", ["g", "h"], ["f"]), N("Mul", ["half", "f"], ["v"])]),
    "gelu of erf": ("gelu", 17, [
        N("Div", ["h", "root"], ["d"]), N("Erf", ["d"], ["e"]), N("Add", ["e", "one"], ["g"]),
        N("Mul", ["h", "g"], ["f"]), N("Mul", ["f", "half"], ["v"])]),
    "gelu of half and erf": ("gelu", 17, [
        N("Mul", ["half", "h"], ["f"]), N("Mul", ["by", "h"], ["d"]), N("Erf", ["d"], ["e"]),
        N("Add", ["one", "e"], ["g"]), N("Mul", ["f", "g"], ["v"])]),
    "softsign written out": ("softsign", 17, [
        N("Abs", ["h"], ["a"]), N("Add", ["a", "one"], ["b"]), N("Div", ["h", "b"], ["v"])]),
    "hard swish": ("hardswish", 17, [N("HardSwish", ["h"], ["v"])]),
    "hard sigmoid": ("hardsigmoid", 17, [N("HardSigmoid", ["h"], ["v"], alpha=0.3, beta=0.4)]),
    "hard sigmoid that says nothing": ("hardsigmoid as torch has it", 17, [N("HardSigmoid", ["h"], ["v"])]),
    "layer norm written out": ("layer norm", 13, [
        N("ReduceMean", ["h"], ["m"], axes=[-1]), N("Sub", ["h", "m"], ["d"]), N("Pow", ["d", "two"], ["p"]),
        N("ReduceMean", ["p"], ["w"], axes=[-1]), N("Add", ["w", "quarter"], ["e"]), N("Sqrt", ["e"], ["r"]),
        N("Div", ["d", "r"], ["n"]), N("Mul", ["n", "G"], ["o"]), N("Add", ["o", "S"], ["v"])]),
    "layer norm of opset 18": ("layer norm", 18, [
        N("ReduceMean", ["h", "last"], ["m"]), N("Sub", ["h", "m"], ["d"]), N("Mul", ["d", "d"], ["p"]),
        N("ReduceMean", ["p", "last"], ["w"]), N("Add", ["w", "quarter"], ["e"]), N("Sqrt", ["e"], ["r"]),
        N("Div", ["d", "r"], ["n"]), N("Mul", ["n", "G"], ["o"]), N("Add", ["o", "S"], ["v"])]),
    "layer norm as one operation": ("layer norm", 17, [
        N("LayerNormalization", ["h", "G", "S"], ["v"], epsilon=0.25)]),
    "root mean square": ("root mean square", 17, [
        N("Pow", ["h", "two"], ["p"]), N("ReduceMean", ["p"], ["w"], axes=[1]), N("Add", ["w", "quarter"], ["e"]),
        N("Sqrt", ["e"], ["r"]), N("Div", ["h", "r"], ["v"])]),
    "a cube": ("cube", 17, [N("Pow", ["h", "three"], ["v"])]),
    "a magnitude": ("magnitude", 17, [N("Abs", ["h"], ["v"])]),
}  # fmt: skip
REFUSED: dict[str, tuple[str, list[Any]]] = {
    "a fourth power": ("exponent .* must be 2 or 3", [N("Pow", ["h", "four"], ["v"])]),
    "a quotient": ("divides two values", [N("Tanh", ["h"], ["t"]), N("Div", ["h", "t"], ["v"])]),
    "a quotient by more": ("divides two values", [
        N("Abs", ["h"], ["a"]), N("Add", ["a", "two"], ["b"]), N("Div", ["h", "b"], ["v"])]),
    "a square root": ("reads a square root", [N("Sqrt", ["h"], ["r"]), N("Mul", ["h", "r"], ["v"])]),
    "a quotient by another root": ("divides by a square root", [N("Sqrt", ["h"], ["r"]), N("Div", ["h", "r"], ["v"])]),
    "no epsilon": ("with a positive epsilon", [
        N("Mul", ["h", "h"], ["p"]), N("ReduceMean", ["p"], ["w"], axes=[1]), N("Sub", ["w", "quarter"], ["e"]),
        N("Sqrt", ["e"], ["r"]), N("Div", ["h", "r"], ["v"])]),
    "the mean of a batch": ("must be over axis 1", [
        N("ReduceMean", ["h"], ["m"], axes=[0]), N("Sub", ["h", "m"], ["v"])]),
    "a mean that drops its axis": ("must be over axis 1", [
        N("ReduceMean", ["h"], ["m"], axes=[1], keepdims=0), N("Sub", ["h", "m"], ["v"])]),
    "erf with a sum of 1.0000001": ("Erf .*is not read", [
        N("Div", ["h", "root"], ["d"]), N("Erf", ["d"], ["e"]), N("Add", ["e", "above"], ["g"]),
        N("Mul", ["h", "g"], ["f"]), N("Mul", ["f", "half"], ["v"])]),
    "erf of another number": ("Erf .*is not read", [
        N("Div", ["h", "two"], ["d"]), N("Erf", ["d"], ["e"]), N("Add", ["e", "one"], ["g"]),
        N("Mul", ["h", "g"], ["f"]), N("Mul", ["f", "half"], ["v"])]),
    "erf that multiplies another value": ("Erf .*is not read", [
        N("Div", ["h", "root"], ["d"]), N("Erf", ["d"], ["e"]), N("Add", ["e", "one"], ["g"]), N("Tanh", ["h"], ["t"]),
        N("Mul", ["t", "g"], ["f"]), N("Mul", ["f", "half"], ["v"])]),
    "erf that multiplies twice": ("Erf .*is not read", [
        N("Div", ["h", "root"], ["d"]), N("Erf", ["d"], ["e"]), N("Add", ["e", "one"], ["g"]),
        N("Mul", ["h", "g"], ["f"]), N("Mul", ["f", "h"], ["v"])]),
    "a sum with erf that is read elsewhere": ("Erf .*is not read", [
        N("Div", ["h", "root"], ["d"]), N("Erf", ["d"], ["e"]), N("Add", ["e", "one"], ["g"]),
        N("Mul", ["h", "g"], ["f"]), N("Mul", ["f", "half"], ["w"]), N("Add", ["w", "g"], ["v"])]),
    "erf of nothing": ("Erf .*is not read", [N("Erf", [], ["e"]), N("Add", ["e", "one"], ["v"])]),
    "erf that multiplies a product of itself": ("Erf .*is not read", [
        N("Div", ["h", "root"], ["d"]), N("Erf", ["d"], ["e"]), N("Add", ["e", "one"], ["g"]),
        N("Mul", ["h", "w"], ["w"]), N("Mul", ["w", "g"], ["v"])]),
    "another form of gelu": ("must be the exact one or its tanh form", [N("Gelu", ["h"], ["v"], approximate="erf")]),
}  # fmt: skip


def numbers() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    held = {"W": rng.normal(size=(2, 6)), "B": rng.normal(size=6), "U": rng.normal(size=(6, 1)), "G": G, "S": S}
    held |= {"c": np.array(0.044715), "k": np.sqrt(2 / np.pi), "half": np.array(0.5), "quarter": np.array(0.25)}
    held |= {"one": np.array(1.0), "two": np.array(2.0), "three": np.array(3.0), "four": np.array(4.0)}
    held |= {"root": np.sqrt(np.array(2.0)), "by": np.sqrt(np.array(0.5)), "above": np.array(1.0000001)}
    return held | {"last": np.array([-1], np.int64)}


def read(folder: Path, opset: int, nodes: list[Any], kind: Any = np.float64) -> Imported:
    """The policy of a graph with a layer before these nodes and one behind them."""
    all_ = [N("Gemm", ["x", "W", "B"], ["h"]), *nodes, N("MatMul", ["v", "U"], ["u"])]
    used = {i for n in all_ for i in n.input}
    held = {k: a if a.dtype == np.int64 else np.asarray(a, kind) for k, a in numbers().items() if k in used}
    of = TensorProto.DOUBLE if kind is np.float64 else TensorProto.FLOAT
    ends = [helper.make_tensor_value_info(k, of, ["batch", size]) for k, size in (("x", 2), ("u", 1))]
    tensors = [numpy_helper.from_array(a, k) for k, a in held.items()]
    graph = helper.make_graph(all_, "policy", ends[:1], ends[1:], tensors)
    path = folder / "policy.onnx"
    path.write_bytes(helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)]).SerializeToString())
    return import_policy(path, plant(), SAID)


def close(found: Any, wanted: Any) -> None:
    """Equal to 1e-12 of the largest value."""
    found, wanted = np.asarray(found), np.asarray(wanted)
    assert found.shape == wanted.shape and np.max(np.abs(found - wanted)) <= 1e-12 * np.max(np.abs(wanted))


@pytest.mark.parametrize("name", GRAPHS)
def test_graphs_are_their_formulas(name: str, tmp_path: Path) -> None:
    formula, opset, nodes = GRAPHS[name]
    imported = read(tmp_path, opset, nodes)
    held = {k: torch.tensor(a) for k, a in numbers().items()}
    wanted = FORMULAS[formula](torch.tensor(X) @ held["W"] + held["B"]) @ held["U"]
    close(imported.policy.network(X, (Fraction(0),)), wanted)
    assert imported.difference.in_double < (1e-6 if formula == "gelu" else 1e-11)  # onnx's erf is of single precision
    assert read(tmp_path, opset, nodes, np.float32).difference.largest < 1e-3


@pytest.mark.parametrize("name", REFUSED)
def test_other_forms_are_refused(name: str, tmp_path: Path) -> None:
    message, nodes = REFUSED[name]
    with pytest.raises(InputError, match=message):
        read(tmp_path, 20 if name == "another form of gelu" else 17, nodes)


def test_an_observation_is_normalised_by_the_graphs_own_width(tmp_path: Path) -> None:
    nodes = GRAPHS["layer norm written out"][2][:-2]
    renamed = [N(n.op_type, ["x" if i == "h" else i for i in n.input], [f"{o}0" if o == "n" else o for o in n.output])
               for n in nodes]  # fmt: skip
    for node, was in zip(renamed, nodes, strict=True):
        node.attribute.extend(was.attribute)
    held = numbers()
    all_ = [*renamed, N("Gemm", ["n0", "W", "B"], ["h"]), N("MatMul", ["h", "U"], ["u"])]
    used = {i for n in all_ for i in n.input}
    for size, fits in ((2, True), ("n", False), (3, False)):
        ends = [helper.make_tensor_value_info(k, TensorProto.DOUBLE, ["b", s]) for k, s in (("x", size), ("u", 1))]
        tensors = [numpy_helper.from_array(np.asarray(a), k) for k, a in held.items() if k in used]
        model = helper.make_model(
            helper.make_graph(all_, "policy", ends[:1], ends[1:], tensors), opset_imports=[helper.make_opsetid("", 13)]
        )
        (tmp_path / "policy.onnx").write_bytes(model.SerializeToString())
        if not fits:
            with pytest.raises(InputError, match=r"must be of 1 to 4096 numbers|it reads 3 and commands 1"):
                import_policy(tmp_path / "policy.onnx", plant(), SAID)
            continue
        found = import_policy(tmp_path / "policy.onnx", plant(), SAID).policy.network(X, (Fraction(0),))
        h = nn.functional.layer_norm(torch.tensor(X), (2,), eps=0.25).numpy()
        close(found, (h @ held["W"] + held["B"]) @ held["U"])


EXPORTED = {
    "layer norm": nn.LayerNorm(6),
    "gelu": nn.GELU(approximate="tanh"),
    "softsign": nn.Softsign(),
    "hardswish": nn.Hardswish(),
    "hardsigmoid": nn.Hardsigmoid(),
}


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::UserWarning")
@pytest.mark.parametrize("opset", [11, 20])
@pytest.mark.parametrize("name", EXPORTED)
def test_what_torch_exports(name: str, opset: int, tmp_path: Path) -> None:
    """Graphs as torch's exporter writes them, in an old set of operators and in a new one."""
    torch.manual_seed(0)
    module = nn.Sequential(nn.Linear(2, 6), EXPORTED[name], nn.Linear(6, 1))
    said: dict[str, Any] = {
        "dynamo": False,
        "opset_version": opset,
        "input_names": ["o"],
        "dynamic_axes": {"o": {0: "b"}},
    }
    torch.onnx.export(module, (torch.zeros(1, 2),), str(tmp_path / "m.onnx"), **said)
    imported = import_policy(tmp_path / "m.onnx", plant(), SAID)
    assert imported.difference.in_double < 1e-13
    with torch.no_grad():
        wanted = module.double()(torch.tensor(X)).numpy()
        module.float()
    assert np.allclose(imported.policy.network(X, (Fraction(0),)), wanted, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("width", [0, 2**40])
def test_a_width_that_no_policy_has_is_refused(width: int) -> None:
    with pytest.raises(InputError, match="at most 4096 numbers"):
        layer_normalised(width, Fraction(1, 8))


# ------------------------------------------------------------------------------------------------------------- modules


class Written(nn.Module):  # type: ignore[misc]
    """GELU's tanh form as its authors write it."""

    def forward(self, x: Any) -> Any:
        return 0.5 * x * (1.0 + torch.tanh(0.7978845608028654 * (x + 0.044715 * torch.pow(x, 3.0))))


MODULES = {
    "gelu": nn.GELU(approximate="tanh"),
    "gelu written out": Written(),
    "softsign": nn.Softsign(),
}


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("name", MODULES)
def test_modules_and_their_torchscript(name: str, tmp_path: Path) -> None:
    torch.manual_seed(0)
    module = nn.Sequential(nn.Linear(2, 6), MODULES[name], nn.Linear(6, 6), MODULES[name], nn.Linear(6, 1)).double()
    network = import_module(module, plant(), SAID).policy.network
    with torch.no_grad():
        close(network(X, (Fraction(0),)), module(torch.tensor(X)))
        made = [jit.trace(module, torch.zeros(1, 2).double())]
        made += [jit.script(module)] if name == "gelu" else []  # others convert numbers, which is not read
        for program in made:
            jit.save(program, tmp_path / "m.pt")
            assert import_policy(tmp_path / "m.pt", plant(), SAID).policy.network.sha256() == network.sha256()


def test_another_quotient_of_torchscript_is_refused() -> None:
    class Quotient(nn.Module):  # type: ignore[misc]
        def forward(self, x: Any) -> Any:
            return x / (1 + x * x)

    with pytest.raises(InputError, match="divides two values"):
        import_module(nn.Sequential(nn.Linear(2, 6), Quotient(), nn.Linear(6, 1)), plant(), SAID)


# -------------------------------------------------------------------------------------------------------- state_dicts


LAYERS = replace(SAID, activation="gelu-tanh", squash="identity")
ORDERS: dict[Any, tuple[int, int]] = {"layer-before": (0, 1), "layer-after": (1, 0)}


def stack(norm: str, eps: float = 1e-5, width: int = 6) -> Any:
    """Two hidden layers with normalisations, whose gains and biases are no trivial ones."""
    torch.manual_seed(1)
    parts: list[Any] = []
    for reads in (2, width):
        pair = nn.LayerNorm(width, eps=eps), nn.GELU(approximate="tanh")
        nn.init.normal_(pair[0].weight)
        nn.init.normal_(pair[0].bias)
        parts += [nn.Linear(reads, width), *(pair[k] for k in ORDERS[norm])]
    return nn.Sequential(*parts, nn.Linear(width, 1)).double()


@pytest.mark.parametrize("norm", ORDERS)
@pytest.mark.parametrize("eps", [None, 0.125])
def test_layer_norm_of_a_state_dict(norm: Any, eps: float | None) -> None:
    module = stack(norm, 1e-5 if eps is None else eps)
    said = replace(LAYERS, norm=norm, norm_epsilon=None if eps is None else Fraction(eps))
    imported = import_state_dict(module.state_dict(), plant(), said)
    with torch.no_grad():
        close(imported.policy.network(X, (Fraction(0),)), module(torch.tensor(X)))
    assert not imported.not_read and imported.policy.network.sha256() == (
        import_module(module, plant(), SAID).policy.network.sha256()
    )


def test_numbers_that_show_no_activation_fit_both_places() -> None:
    numbers_ = {"0": 0, "1": 1, "3": 2, "4": 3, "6": 4}
    state = {f"net.{numbers_[k[0]]}{k[1:]}": v for k, v in stack("layer-before").state_dict().items()}
    found = [import_state_dict(state, plant(), replace(LAYERS, norm=norm)) for norm in ORDERS]
    assert found[0].policy.network.sha256() != found[1].policy.network.sha256()
    with torch.no_grad():
        close(found[0].policy.network(X, (Fraction(0),)), stack("layer-before")(torch.tensor(X)))


def changed(**more: Any) -> dict[str, Any]:
    state = dict(stack("layer-before").state_dict())
    for name, value in more.items():
        key = name.replace("_", ".")
        if value is None:
            del state[key]
        else:
            state[key] = value
    return state


FLAT: dict[str, tuple[str, dict[str, Any], Any]] = {
    "nothing said": (r"1 must be affine.*--norm layer-before", changed(), None),
    "another place": (r"--norm layer-after does not fit the numbers 0, 1 and 3", changed(), "layer-after"),
    "no bias": ("must have a weight and a bias", changed(**{"1_bias": None}), "layer-before"),
    "another width": ("must have a weight and a bias", changed(**{"1_bias": torch.zeros(5)}), "layer-before"),
    "two in a row": ("one normalisation between two layers",
                     changed(**{"2_weight": torch.ones(6), "2_bias": torch.ones(6)}), "layer-before"),
    "behind the last layer": ("one normalisation between two layers",
                              changed(**{"7_weight": torch.ones(1), "7_bias": torch.ones(1)}), "layer-before"),
    "a running mean": ("belongs to one of another kind", changed(**{"1_running_mean": torch.ones(6)}), "layer-before"),
    "a convolution": ("0 must be affine", changed(**{"0_weight": torch.ones(6, 2, 1)}), "layer-before"),
}  # fmt: skip


@pytest.mark.parametrize("name", FLAT)
def test_normalisations_that_are_not_clear_are_refused(name: str) -> None:
    message, state, norm = FLAT[name]
    state = {f"{k.replace('running.mean', 'running_mean')}": v for k, v in state.items()}
    with pytest.raises(InputError, match=message):
        import_state_dict(state, plant(), replace(LAYERS, norm=norm, prefix=""))


def test_a_norm_that_is_not_there_is_refused() -> None:
    module = nn.Sequential(nn.Linear(2, 3), nn.Tanh(), nn.Linear(3, 1))
    with pytest.raises(InputError, match="--norm must be left out"):
        import_state_dict(module.state_dict(), plant(), replace(LAYERS, norm="layer-before"))
    with pytest.raises(InputError, match="--norm must be left out"):
        import_module(module, plant(), replace(SAID, norm="layer-before"))
    with pytest.raises(InputError, match="go with --norm"):
        replace(LAYERS, norm_epsilon=Fraction(1))
    with pytest.raises(InputError, match="must be positive"):
        replace(LAYERS, norm="layer-after", norm_epsilon=Fraction(0))


# ---------------------------------------------------------------------------------------------------------- the proof


def small(function: Any, *norm: Any) -> Any:
    """A policy for the pendulum that is odd, so that it commands nothing at rest."""
    module = nn.Sequential(nn.Linear(2, 4), *norm, function, nn.Linear(4, 1), nn.Tanh()).double()
    gain = torch.tensor([-0.75, -0.25], dtype=torch.float64)
    with torch.no_grad():
        module[0].weight.copy_(torch.stack([gain, -gain, 0 * gain, 0 * gain]))
        module[0].bias.copy_(torch.tensor([1.0, 1.0, -1.0, -1.0]))
        module[-2].weight.copy_(torch.tensor([[4.0, -4.0, 0.0, 0.0]]))
        module[-2].bias.zero_()
    return module


PROVED = {
    "gelu": small(nn.GELU(approximate="tanh")),
    "layer norm": small(nn.Tanh(), nn.LayerNorm(4)),
    "softsign": small(nn.Softsign()),
    "hardswish": small(nn.Hardswish()),
}


@pytest.mark.parametrize("name", slow_after(1, PROVED))
def test_a_small_policy_is_proved(name: str, tmp_path: Path) -> None:
    said: dict[str, Any] = {"states": ("theta", "theta_dot"), "normaliser": "none", "action_scale": (6,)}
    options = RoaOptions(candidate="lyapunov", effort=0.01)
    given = PROVED[name]
    if name == "layer norm":
        said |= {"norm": "layer-before", "norm_epsilon": 1e-5, "activation": "tanh", "squash": "tanh"}
        given = given.state_dict()
    assert certify_roa("pendulum", given, tmp_path, options, importing=said).verdict is Verdict.PROVED
