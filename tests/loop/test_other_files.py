"""Files that are no policy file of this program, given where one is wanted: what they are, and the command to type."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from certify.cli.main import _run
from certify.errors import InputError
from certify.loop.policies import load_policy
from certify.loop.policies.importers import ImportOptions, import_policy
from tests.support.foreign import mlp, plant, saved, sb3

SAID = ImportOptions(states=("x0", "x1"), normaliser="none", action_scale=(Fraction(1),))
LAYERS = replace(SAID, activation="tanh", squash="identity")
TANH = r"policy_kwargs=dict\(activation_fn=torch\.nn\.Tanh\)"


def zipped(folder: Path) -> Path:
    return sb3("PPO", folder)[2]


def traced(folder: Path, module: torch.nn.Module | None = None) -> Path:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        made = torch.jit.trace(module or mlp(), torch.zeros(2, 2))  # type: ignore[no-untyped-call]
        torch.jit.save(made, str(folder / "traced.pt"))
    return folder / "traced.pt"


def tensors(folder: Path) -> Path:
    from safetensors.torch import save_file

    save_file(mlp().state_dict(), folder / "p.safetensors")
    return folder / "p.safetensors"


def text(folder: Path) -> Path:
    (folder / "README.md").write_text("# A page\n\nWith words, ünd mehr.\n" * 200, "utf-8")
    return folder / "README.md"


def graph(folder: Path) -> Path:
    (folder / "p.onnx").write_bytes(b"\x08\x08\x12\x00")
    return folder / "p.onnx"


def certificate(folder: Path) -> Path:
    path = folder / "certificate.json"
    path.write_text('{\n"schema": "certify-certificate/9",\n"claim": {"kind": "reaches"}\n}\n')
    return path


def gain(folder: Path) -> Path:
    np.save(folder / "K.npy", np.eye(2))
    return folder / "K.npy"


COMMAND = r"certify import .*{} --system PLANT --out {}-policy\.pt"
OTHERS: dict[str, tuple[Callable[[Path], Path], str]] = {
    "stable-baselines3": (zipped, r"a zip file of stable-baselines3.*" + COMMAND.format(r"PPO\.zip", "PPO")),
    "torchscript": (traced, r"a file of TorchScript.*" + COMMAND.format(r"traced\.pt", "traced")),
    "state_dict": (lambda f: saved(f, mlp().state_dict()), "without `format`.*certify import"),
    "a list": (lambda f: saved(f, [1, 2]), "without `format`, a list.*certify import"),
    "a checkpoint": (lambda f: saved(f, {"a": Fraction(1)}), "more than plain tensors in it.*certify import"),
    "safetensors": (tensors, "a file of safetensors.*certify import"),
    "onnx": (graph, "an ONNX model.*certify import"),
    "a certificate": (certificate, "it is a certificate, which has a policy inside.*Name the policy file"),
    "a gain": (gain, "it is one array of numpy.*numpy.savez"),
    "text": (text, "must hold a policy; it is text.*controllers train.*certify import"),
}


@pytest.mark.parametrize("name", OTHERS)
def test_another_programs_file_is_named_with_the_command_to_type(name: str, tmp_path: Path) -> None:
    make, message = OTHERS[name]
    path = make(tmp_path)
    with pytest.raises(InputError, match=message) as error:
        load_policy(path)
    assert "inline_container" not in str(error.value)


def test_bytes_that_are_nothing_are_no_archive(tmp_path: Path) -> None:
    for raw in (b"\x00\x01\x02", b"", b"PK"):
        (tmp_path / "noise.pt").write_bytes(raw)
        with pytest.raises(InputError, match=r"policy file .*noise.pt is no zip archive"):
            load_policy(tmp_path / "noise.pt")
    with pytest.raises(InputError, match="cannot be read"):
        load_policy(tmp_path / "missing.pt")


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_readme_is_no_policy_for_the_command(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text(here)
    for arguments in (["roa", "--policy", "README.md", "--system", "pendulum", "--out", "o"],):
        assert _run(arguments, False) == 2
        assert "must hold a policy; it is text" in capsys.readouterr().err
    assert _run(["import", "README.md", "--system", "pendulum", "--out", "p.pt"], False) == 2
    assert "none of these, but text" in capsys.readouterr().err


def test_evaluate_and_flatten_say_how_to_import(here: Path) -> None:
    from typer.testing import CliRunner

    from controllers.cli import app

    zipped(here)
    for arguments in (["evaluate", "PPO.zip"], ["flatten", "PPO.zip", "--out", "f.pt"]):
        done = CliRunner().invoke(app, arguments)
        assert done.exit_code == 2
        assert "certify import PPO.zip --system PLANT --out PPO-policy.pt" in " ".join(done.output.split())


@pytest.mark.slow
def test_a_study_says_how_to_import(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    zipped(here)
    Path("study.toml").write_text('policies = ["PPO.zip"]\nsystems = ["pendulum"]\n')
    _run(["sweep", "study.toml", "--out", "o", "--json"], True)
    rows = json.dumps(json.loads(capsys.readouterr().out))
    assert "a zip file of stable-baselines3" in rows and "certify import " in rows


# --------------------------------------------------------------------------------- the next step where one is refused


class Normalised(torch.nn.Module):
    def __init__(self, norm: torch.nn.Module) -> None:
        super().__init__()
        self.net = torch.nn.Sequential(torch.nn.Linear(2, 32), norm, torch.nn.Tanh(), torch.nn.Linear(32, 1))

    def forward(self, x: torch.Tensor) -> Any:
        return self.net(x)


@pytest.mark.parametrize("norm", [torch.nn.GroupNorm(1, 32), torch.nn.GroupNorm(2, 32)])
def test_normalisations_are_refused_by_name(norm: torch.nn.Module, tmp_path: Path) -> None:
    message = "for another normalisation between layers train the policy again without it"
    with pytest.raises(InputError, match=message):
        import_policy(traced(tmp_path, Normalised(norm).eval()), plant(), SAID)


def test_layer_norm_in_a_state_dict_is_named(tmp_path: Path) -> None:
    state = Normalised(torch.nn.LayerNorm(32)).state_dict()
    with pytest.raises(InputError, match=r"net\.1 must be affine.*LayerNorm is read .*--norm layer-before"):
        import_policy(saved(tmp_path, state), plant(), LAYERS)


@pytest.mark.parametrize("kind", ["SAC", "TD3"])
def test_the_default_activation_of_stable_baselines_is_read(kind: str, tmp_path: Path) -> None:
    read = import_policy(sb3(kind, tmp_path, net_arch=[8])[2], plant(), SAID)
    assert read.policy.network.activation == "relu" and "relu between the layers is the default" in read.assumed
    given = {"activation_fn": torch.nn.SELU, "net_arch": [8]}
    assert "selu between the layers" in import_policy(sb3(kind, tmp_path, **given)[2], plant(), SAID).assumed
    given = {"activation_fn": torch.nn.Softshrink, "net_arch": [8]}
    with pytest.raises(InputError, match=rf"it is Softshrink\. .* again with .*{TANH}"):
        import_policy(sb3(kind, tmp_path, **given)[2], plant(), SAID)


def test_other_activations_have_a_next_step(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=f"found 'prelu'.* Train .*{TANH}"):
        ImportOptions(activation="prelu")
    for layer, message in (
        (torch.nn.Softshrink(), r"torch\.softshrink .* is not read"),
        (torch.nn.Threshold(0.1, 0.0), r"torch\.threshold .* is not read"),
    ):
        module = torch.nn.Sequential(torch.nn.Linear(2, 4), layer, torch.nn.Linear(4, 1))
        with pytest.raises(InputError, match=f"{message}.*{TANH}"):
            import_policy(traced(tmp_path, module), plant(), SAID)


def test_observations_that_are_no_states_have_a_next_step(tmp_path: Path) -> None:
    options = replace(LAYERS, states=("x0", "cos_theta"))
    with pytest.raises(InputError, match=r"names 'cos_theta'|expressions of them, such as cos\(x0\)"):
        import_policy(saved(tmp_path, mlp().state_dict()), plant(), options)
