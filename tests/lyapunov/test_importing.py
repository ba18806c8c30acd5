"""Lyapunov networks in files of other programs: the framework's own values, and nothing that is not a network's."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from certify.errors import InputError
from certify.loop.plants import get_system
from certify.loop.policies.importers import ImportOptions, import_policy
from certify.lyapunov import ImportedLyapunov, import_lyapunov, load_lyapunov, save_lyapunov
from tests.support.foreign import TWO_STAGE, external, mlp, plant, saved, sb3, two_stage, values

N = mlp((2, 6, 5, 1), seed=5)
POLICY = {f"controller.{k}": v for k, v in mlp().state_dict().items()}
STATE = POLICY | {f"V.net.{k}": v for k, v in N.state_dict().items()}
SAID = ImportOptions(states=("x0", "x1"), activation="tanh", normaliser="none")
TIGHT = 1e-12
X = np.random.default_rng(3).uniform(-2, 2, (300, 2))


def gap(imported: ImportedLyapunov, module: torch.nn.Sequential, x: np.ndarray, given: np.ndarray) -> float:
    """How far the function at states x is from the module at what it is given, at most."""
    return float(np.max(np.abs(imported.function(x) - values(module, given)[:, 0])))


@pytest.mark.parametrize("wrap", [False, True])
def test_a_network_beside_a_policy(wrap: bool, tmp_path: Path) -> None:
    path = saved(tmp_path, {"model": STATE, "step": 3} if wrap else STATE)
    prefix = "model.V.net" if wrap else "V.net"
    imported = import_lyapunov(path, plant(), SAID, prefix)
    for weight, layer in zip(imported.function.weights, (0, 2, 4), strict=True):
        assert np.array_equal(weight, N.state_dict()[f"{layer}.weight"].double().numpy())
    assert gap(imported, N, X, X) < TIGHT
    assert imported.words == f"{prefix} 2-6-5-1" and imported.function.widths == (2, 6, 5, 1)
    assert imported.difference.states == 10_000 and imported.difference.largest < 1e-5
    assert imported.difference.in_double < TIGHT
    assert imported.at_origin == imported.function(np.zeros(2))
    assert "what increases strictly" in imported.meaning and "sigmoid" not in imported.meaning


def test_the_record_goes_into_the_file(tmp_path: Path) -> None:
    path, system = saved(tmp_path, STATE), plant()
    stored = import_lyapunov(path, system, SAID, "V.net").stored
    for name in ("a.pt", "b.pt"):
        save_lyapunov(tmp_path / name, stored.function, stored.system, stored.parameters, stored.training)
    assert (tmp_path / "a.pt").read_bytes() == (tmp_path / "b.pt").read_bytes()
    read = load_lyapunov(tmp_path / "a.pt")
    record = read.training["imported"]
    assert (read.system, record["kind"], record["network"]) == ("chain", "state-dict", "V.net 2-6-5-1")
    assert record["options"]["--lyapunov-prefix"] == "V.net" and len(record["sha256"]) == 64
    assert not {"level", "V"} & record.keys()
    with pytest.raises(InputError, match="must hold a policy; it is a Lyapunov function of this program"):
        import_policy(tmp_path / "a.pt", system, SAID)


def test_states_in_another_order_and_states_that_are_not_read(tmp_path: Path) -> None:
    path = saved(tmp_path, STATE)
    x = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    imported = import_lyapunov(path, plant(3), replace(SAID, states=("x2", "x0")), "V.net")
    assert gap(imported, N, x, x[:, [2, 0]]) < TIGHT and np.all(imported.function.gradient(x)[:, 1] == 0)


@pytest.mark.parametrize("observes", ["absolute", "deviation"])
def test_networks_that_observe_absolute_states(observes: Any, tmp_path: Path) -> None:
    system = plant(x_eq=(1, -2))
    imported = import_lyapunov(saved(tmp_path, STATE), system, replace(SAID, observes=observes), "V.net")
    shift = np.array([1.0, -2.0]) if observes == "absolute" else np.zeros(2)
    assert gap(imported, N, X, X + shift) < TIGHT and imported.difference.in_double < TIGHT
    weight, bias = (N.state_dict()[f"0.{k}"].double().numpy() for k in ("weight", "bias"))
    for i in range(len(bias)):  # W x_eq in the bias, rounded once
        exact = Fraction(float(bias[i])) + sum(
            Fraction(float(w)) * Fraction(s) for w, s in zip(weight[i], shift, strict=True)
        )
        assert imported.function.biases[0][i] == float(exact)


def test_the_network_of_a_two_stage_file(tmp_path: Path) -> None:
    system = get_system("quadrotor2d")
    path, _ = two_stage(tmp_path, system, 6.0)
    options = ImportOptions(states=tuple(s.name for s in system.states), squash="relu-tanh")
    imported = import_lyapunov(path, system, options)
    x = np.random.default_rng(0).uniform(-1, 1, (50, 6))
    assert gap(imported, mlp((6, 4, 1)), x, x) < TIGHT
    # What is said of levels: the sigmoid of N is at most v where N is at most log(v / (1 - v)).
    assert "sigmoid(N)" in imported.meaning and "log(v / (1 - v))" in imported.meaning
    v = 1 / (1 + np.exp(-imported.function(x)))
    np.testing.assert_allclose(np.log(v / (1 - v)), imported.function(x), rtol=1e-9)
    with pytest.raises(InputError, match="--lyapunov-prefix must be left out"):
        import_lyapunov(path, system, options, "state_dict.lyapunov.layers")


def changed(tmp_path: Path, **new: torch.Tensor | None) -> Path:
    """A two-stage file for the chain, with tensors instead of others, or without those that are None."""
    state = {f"controller.layers.{k}": v for k, v in mlp().state_dict().items()}
    state |= {"controller.x_equilibrium": torch.zeros(2), "controller.b": torch.zeros(1)}
    state |= {f"lyapunov.layers.{k}": v for k, v in N.state_dict().items()}
    state |= {k.replace("__", "."): v for k, v in new.items()}
    return saved(tmp_path, {"state_dict": {k: v for k, v in state.items() if v is not None}, "domain": torch.ones(2)})


NONE: dict[str, Any] = {f"lyapunov__layers__{k}".replace(".", "__"): None for k in N.state_dict()}
BUFFER, SHIFTED = {"lyapunov__x_equilibrium": torch.zeros(2)}, {"controller__x_equilibrium": torch.tensor([1.0, 0.0])}
TWO = {"lyapunov__layers__4__weight": torch.ones(2, 5), "lyapunov__layers__4__bias": torch.ones(2)}
TWO_STAGE_REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "no network": (NONE, r"no tensor is called state_dict\.lyapunov\.layers\.0\.weight.*controller\.layers\."),
    "a buffer": (BUFFER, r"the file has state_dict\.lyapunov\.x_equilibrium as well"),
    "a scale": ({"lyapunov__scale": torch.ones(1)}, r"lyapunov\.scale as well"),
    "a second network": ({"lyapunov__other__0__weight": torch.ones(1, 2)}, r"other\.0\.weight as well"),
    "a normalisation": ({"lyapunov__layers__2__running_mean": torch.ones(5)}, "belongs to one of another kind"),
    "two outputs": (TWO, "have one output; .* 2-6-5-2 reads 2 and has 2"),
    "three states": ({"lyapunov__layers__0__weight": torch.ones(6, 3)}, "'s 2; it is 3-6-5-1"),
    "widths": ({"lyapunov__layers__2__weight": torch.ones(5, 7)}, "must take 6 numbers"),
    "a layer without its weight": ({"lyapunov__layers__2__weight": None}, "there must be layers"),
    "nan": ({"lyapunov__layers__2__bias": torch.full((5,), float("nan"))}, "finite"),
    "integers": ({"lyapunov__layers__2__weight": torch.ones(5, 6, dtype=torch.int64)}, "floating-point"),
    "another operating point": (SHIFTED, r"operating point, \[0\.0, 0\.0\].*x_equilibrium is \[1\.0, 0\.0\]"),
}  # fmt: skip


@pytest.mark.parametrize("name", TWO_STAGE_REFUSED)
def test_refused_two_stage_files(name: str, tmp_path: Path) -> None:
    new, message = TWO_STAGE_REFUSED[name]
    path = changed(tmp_path, **new)
    with pytest.raises(InputError, match=f"^Lyapunov network of .*{message}"):
        import_lyapunov(path, plant(), ImportOptions(states=("x0", "x1")))


def test_the_two_stage_file_that_is_changed_above_is_read(tmp_path: Path) -> None:
    options = ImportOptions(states=("x0", "x1"))
    assert gap(import_lyapunov(changed(tmp_path), plant(), options), N, X, X) < TIGHT
    # The policy's x_equilibrium says where the networks read the plant's operating point.
    moved = changed(tmp_path, controller__x_equilibrium=torch.tensor([1.0, -2.0]))
    imported = import_lyapunov(moved, plant(x_eq=(1, -2)), replace(options, observes="absolute"))
    assert gap(imported, N, X, X + np.array([1.0, -2.0])) < TIGHT
    with pytest.raises(InputError, match="operating point"):
        import_lyapunov(moved, plant(x_eq=(1, -2)), replace(options, observes="deviation"))


def test_everything_that_is_missing_is_asked_for_at_once(tmp_path: Path) -> None:
    path = saved(tmp_path, STATE)
    with pytest.raises(InputError) as error:
        import_lyapunov(path, plant(x_eq=(1, 0)))
    asked = ("--states x0,x1", "--observes", "--lyapunov-prefix", "--activation tanh", "--normaliser none")
    assert all(option in str(error.value) for option in asked)
    for missing in ("states", "activation", "normaliser"):
        with pytest.raises(InputError, match=f"required: --{missing}[^;]*$"):
            import_lyapunov(path, plant(), replace(SAID, **{missing: None}), "V.net")
    with pytest.raises(InputError, match=r"required: --states[^;]*$"):
        import_lyapunov(changed(tmp_path), plant())


def test_normalised_observations_are_refused(tmp_path: Path) -> None:
    """Whether they are the Lyapunov network's too, no file says."""
    statistics = {"_mean": torch.zeros(1, 2), "_std": torch.ones(1, 2)}
    held = saved(tmp_path, {"model_state_dict": STATE, "obs_norm_state_dict": statistics}, "rsl.pt")
    for options in (SAID, replace(SAID, normaliser=None)):
        with pytest.raises(InputError, match="observations are normalised"):
            import_lyapunov(held, plant(), options, "model_state_dict.V.net")
    with pytest.raises(InputError, match="observations are normalised"):
        import_lyapunov(saved(tmp_path, STATE), plant(), replace(SAID, normaliser=tmp_path / "rsl.pt"), "V.net")


@pytest.mark.parametrize(
    ("options", "prefix", "message"),
    [
        (SAID, "W.net", r"no tensor is called W\.net\.0\.weight"),
        (SAID, "V", r"no tensor is called V\.0\.weight.*under .*V\.net"),
        (SAID, "", r"no tensor is called 0\.weight"),
        (replace(SAID, states=("x0",)), "V.net", "read the 1 states x0 .*--states"),
        (replace(SAID, states=("x0", "cos_x1")), "V.net", "names 'cos_x1'"),
        (replace(SAID, kind="sb3"), "V.net", "--from says, sb3"),
    ],
)
def test_refused_options(options: ImportOptions, prefix: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        import_lyapunov(saved(tmp_path, STATE), plant(), options, prefix)


def test_a_prefix_with_more_below_it_is_refused(tmp_path: Path) -> None:
    more = {**STATE, "V.net.log_scale": torch.zeros(1), "V.net.0.mask": torch.ones(6, 2)}
    with pytest.raises(InputError, match=r"the file has V\.net\.log_scale as well"):
        import_lyapunov(saved(tmp_path, more), plant(), SAID, "V.net")
    del more["V.net.log_scale"]
    with pytest.raises(InputError, match=r"V\.net\.0\.mask belongs to one of another kind"):
        import_lyapunov(saved(tmp_path, more), plant(), SAID, "V.net")


def test_a_policy_with_two_inputs_is_no_function(tmp_path: Path) -> None:
    path = saved(tmp_path, mlp((2, 4, 2)).state_dict())
    with pytest.raises(InputError, match=r"one output; no prefix 2-4-2 reads 2 and has 2"):
        import_lyapunov(path, plant(), SAID, "")


def test_kinds_without_names_of_tensors_are_refused(tmp_path: Path) -> None:
    path = sb3("PPO", tmp_path)[2]
    with pytest.raises(InputError, match=r"must lie in a state_dict.*the file is sb3"):
        import_lyapunov(path, plant(), SAID, "V.net")
    with pytest.raises(InputError, match="cannot be read"):
        import_lyapunov(tmp_path / "missing.pt", plant(), SAID, "V.net")


def test_safetensors(tmp_path: Path) -> None:
    from safetensors.torch import save_file

    save_file(STATE, tmp_path / "p.safetensors")
    imported = import_lyapunov(tmp_path / "p.safetensors", plant(), SAID, "V.net")
    assert gap(imported, N, X, X) < TIGHT


@pytest.mark.parametrize("name", TWO_STAGE)
def test_the_two_stage_checkpoints(name: str) -> None:
    """By torch's own evaluation of the file, in single precision and in double."""
    path = external("two_stage", name)
    if path is None:
        pytest.skip("the folder of other people's policies is not beside the project")
    plant_name, states, _, _, parameters = TWO_STAGE[name]
    system = get_system(plant_name).with_parameters(parameters)
    imported = import_lyapunov(path, system, ImportOptions(states=tuple(states.split(","))))
    data = torch.load(path, map_location="cpu", weights_only=True)
    layers = {k: v for k, v in data.get("state_dict", data).items() if k.startswith("lyapunov.")}
    module = mlp(imported.function.widths)
    module.load_state_dict({k.removeprefix("lyapunov.layers."): v for k, v in layers.items()})
    x = np.random.default_rng(0).uniform(-1, 1, (200, system.n)).astype(np.float32)
    with torch.no_grad():
        single = module(torch.tensor(x)).numpy()[:, 0]
    assert np.max(np.abs(imported.function(x.astype(np.float64)) - single)) < 1e-5
    assert gap(imported, module, x.astype(np.float64), x) < TIGHT
    assert imported.difference.largest < 1e-5 and imported.difference.in_double < TIGHT
