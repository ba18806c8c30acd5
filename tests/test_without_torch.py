"""The core runs where torch is not installed: the Python interface, and each command that needs no training."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
import torch

from tests.support.foreign import mlp, sb3

ROOT = Path(__file__).parent.parent
SHIPPED = ROOT / "examples" / "policies" / "pendulum.pt"
SAID = ["--system", "pendulum", "--states", "theta,theta_dot", "--normaliser", "none", "--action-scale", "1"]
LAYERS = [*SAID, "--activation", "tanh", "--squash", "identity"]


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """One in which an import of torch fails, also in the processes of processes."""
    folder = tmp_path_factory.mktemp("blocked")
    (folder / "torch.py").write_text("raise ImportError('there is no torch here')\n")
    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), str(ROOT)])}


def ended(environment: dict[str, str], *arguments: str) -> str:
    done = subprocess.run([sys.executable, *arguments], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_torch_is_blocked(environment: dict[str, str]) -> None:
    with pytest.raises(AssertionError, match="there is no torch here"):
        ended(environment, "-c", "import torch")


def test_the_python_interface(environment: dict[str, str], tmp_path: Path) -> None:
    code = (
        "import certify; from pathlib import Path\n"
        f"found = certify.certify_roa('pendulum', {str(SHIPPED)!r}, out={str(tmp_path / 'out')!r}, effort=0.02)\n"
        "print(found.verdict.value, found.contains([0.1, 0.1]))\n"
        f"policy = certify.load_policy({str(SHIPPED)!r})\n"
        "state = {f'{2 * k}.{name}': v for k, pair in enumerate(zip(policy.network.weights, policy.network.biases))"
        " for name, v in zip(('weight', 'bias'), pair)}\n"
        "said = dict(states=('theta', 'theta_dot'), activation='tanh', squash='tanh', normaliser='none',"
        " action_scale=(6,), centre='preactivation')\n"
        f"found = certify.certify_roa('pendulum', state, importing=said, out={str(tmp_path / 'o')!r}, effort=0.02)\n"
        "print(found.verdict.value)\n"
    )
    assert ended(environment, "-c", code).split() == ["PROVED", "True", "PROVED"]


def test_the_commands(environment: dict[str, str], tmp_path: Path) -> None:
    out = tmp_path / "out"
    certificate = out / "certificate.json"
    said = ended(environment, "-m", "certify", "roa", str(SHIPPED), "--effort", "0.02", "--out", str(out))
    assert said.startswith("PROVED") and "Figures" in (out / "report.html").read_text()
    assert "ACCEPTED" in ended(environment, "-m", "certify", "check", str(certificate), "--policy", str(SHIPPED))
    (out / "report.html").unlink()
    ended(environment, "-m", "certify", "report", str(certificate))
    assert "Figures" in (out / "report.html").read_text()
    assert "theta" in ended(environment, "-m", "certify", "contains", str(certificate), "theta=0.1")


def test_imports(environment: dict[str, str], tmp_path: Path) -> None:
    onnx = pytest.importorskip("onnx")
    net = mlp()
    torch.save({"model": net.state_dict()}, tmp_path / "weights.pt")
    sb3("PPO", tmp_path)
    helper, tensor = onnx.helper, onnx.numpy_helper.from_array
    gemm = helper.make_node("Gemm", ["x", "W", "b"], ["u"], transB=1)
    sides = [helper.make_tensor_value_info(name, 1, [None, n]) for name, n in (("x", 2), ("u", 1))]
    numbers = [tensor(net[0].weight.detach().numpy()[:1], "W"), tensor(net[0].bias.detach().numpy()[:1], "b")]
    graph = helper.make_graph([gemm], "policy", sides[:1], sides[1:], numbers)
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9), tmp_path / "p.onnx")
    for name, options in (("weights.pt", LAYERS), ("PPO.zip", SAID), ("p.onnx", SAID)):
        given = ["import", str(tmp_path / name), *options, "--out", str(tmp_path / f"{name}.pt")]
        assert "written" in ended(environment, "-m", "certify", *given)
        assert (tmp_path / f"{name}.pt").exists()


def test_torchscript_names_what_is_missing(environment: dict[str, str], tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch has something newer
        traced = torch.jit.trace(mlp(), torch.zeros(1, 2))  # type: ignore[no-untyped-call]
        torch.jit.save(traced, tmp_path / "script.pt")
    given = ["-m", "certify", "import", str(tmp_path / "script.pt"), *SAID, "--out", str(tmp_path / "p.pt")]
    done = subprocess.run([sys.executable, *given], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 2 and "pip install '.[torch]'" in done.stderr and "Traceback" not in done.stderr


def test_no_module_imports_torch_when_it_is_loaded() -> None:
    """Only functions do, and what types alone need."""
    for path in (ROOT / "certify").rglob("*.py"):
        waiting, found = list[ast.AST]([ast.parse(path.read_text())]), list[str]()
        while waiting:
            node = waiting.pop()
            if isinstance(node, ast.Import):
                found += [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                found.append(node.module or "")
            elif not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and not (
                isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
            ):
                waiting += ast.iter_child_nodes(node)
        assert not any(name.split(".")[0] == "torch" for name in found), path
