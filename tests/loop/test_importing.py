"""Files of other programs become the policies that they are: by the framework's own values, and by what is refused."""

from __future__ import annotations

import io
import math
import pickle
import warnings
import zipfile
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from certify.errors import InputError
from certify.loop.plants import get_system
from certify.loop.policies import Policy, PolicyNetwork, load_policy, save_policy
from certify.loop.policies.importers import Clip, Imported, ImportOptions, content_of, import_policy
from tests.support.compiled import Constant, SetsItsState
from tests.support.foreign import TWO_STAGE, Odd, external, mlp, plant, saved, sb3, two_stage, values
from tests.support.marks import slow_after

U_EQ = (Fraction(0),)
X = np.random.default_rng(3).uniform(-1.5, 1.5, (500, 2)).astype(np.float32).astype(np.float64)
SAID = ImportOptions(states=("x0", "x1"), normaliser="none", action_scale=(Fraction(1),))
LAYERS = replace(SAID, activation="tanh", squash="identity")
TIGHT = 1e-12


def gap(imported: Imported, theirs: np.ndarray, x: np.ndarray = X) -> float:
    return float(np.max(np.abs(imported.policy.network(x, U_EQ) - theirs)))


# ---------------------------------------------------------------------------------------------------- state_dicts


@pytest.mark.parametrize("prefix", ["", "actor.pi_net.fcs", "actor_mean", "controller.layers", "actor", "a.0.b"])
@pytest.mark.parametrize("wrap", [False, True])
def test_perceptrons_under_any_prefix(prefix: str, wrap: bool, tmp_path: Path) -> None:
    module = mlp()
    dot = f"{prefix}." if prefix else ""
    critic = mlp((2, 4, 1), seed=1).state_dict()
    state = {f"{dot}{k}": v for k, v in module.state_dict().items()}
    state |= {f"critic.{k}": v for k, v in critic.items()}
    state["log_std"] = torch.zeros(1)
    imported = import_policy(saved(tmp_path, {"model": state, "step": 3} if wrap else state), plant(), LAYERS)
    network = imported.policy.network
    for layer, key in zip(range(3), (0, 2, 4), strict=True):
        assert np.array_equal(network.weights[layer], module.state_dict()[f"{key}.weight"].double().numpy())
    assert gap(imported, values(module, X)) < TIGHT
    assert imported.difference.states == 10_000 and imported.difference.largest < 1e-5
    assert imported.difference.in_double < TIGHT


@pytest.mark.parametrize("squash", ["identity", "tanh", "relu-tanh"])
def test_what_follows_the_last_layer(squash: Any, tmp_path: Path) -> None:
    module = mlp()
    options = replace(LAYERS, squash=squash, action_scale=(Fraction(6),))
    imported = import_policy(saved(tmp_path, module.state_dict()), plant(), options)
    y = values(module, X)
    y = y if squash == "identity" else np.tanh(y)
    assert gap(imported, 6 * (np.maximum(y, 0) if squash == "relu-tanh" else y)) < TIGHT


def test_no_bias_and_double_precision(tmp_path: Path) -> None:
    module = torch.nn.Sequential(torch.nn.Linear(2, 4, bias=False), torch.nn.Tanh(), torch.nn.Linear(4, 1)).double()
    with torch.no_grad():
        module[0].weight.mul_(1 / 3)
    imported = import_policy(saved(tmp_path, module.state_dict()), plant(), LAYERS)
    assert gap(imported, values(module, X)) < TIGHT and imported.difference.largest < TIGHT


def test_the_order_of_states_and_states_that_are_not_read(tmp_path: Path) -> None:
    module, options = mlp((2, 6, 1)), replace(LAYERS, states=("x2", "x0"))
    imported = import_policy(saved(tmp_path, module.state_dict()), plant(3), options)
    x = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    assert gap(imported, values(module, x[:, [2, 0]]), x) < TIGHT
    assert np.all(imported.policy.network.weights[0][:, 1] == 0)


def test_scale_offset_and_clip_of_the_action(tmp_path: Path) -> None:
    module = mlp()
    options = replace(
        LAYERS,
        action_scale=(Fraction(3, 10),),
        action_offset=(Fraction(1, 7),),
        clip=Clip((Fraction(-1, 9),), (Fraction(1, 8),)),
    )
    imported = import_policy(saved(tmp_path, module.state_dict()), plant(), options)
    expected = 0.3 * np.clip(values(module, X), -1 / 9, 1 / 8) + 1 / 7
    assert gap(imported, expected) < TIGHT and len(np.unique(expected)) < len(X)  # the clip acts
    clip = imported.policy.network.clip
    assert clip is not None and clip[1][0] == float(Fraction(3, 10) * Fraction(1, 8) + Fraction(1, 7))


def change(state: dict[str, Any], **new: Any) -> dict[str, Any]:
    return {**state, **{k.replace("_", "."): v for k, v in new.items()}}


STATE = dict(mlp().state_dict())
REFUSED = {
    "batch normalisation": ({**STATE, "2.running_mean": torch.ones(5)}, LAYERS, "2.running_mean belongs to"),
    "layer normalisation": ({**STATE, "1.weight": torch.ones(7), "1.bias": torch.ones(7)}, LAYERS, "must be affine"),
    "convolution": ({**STATE, "0.weight": torch.ones(7, 2, 1)}, LAYERS, "holds 0|must be affine"),
    "widths": ({**STATE, "2.weight": torch.ones(5, 8)}, LAYERS, "must take 7 numbers"),
    "a bias of another size": ({**STATE, "2.bias": torch.ones(4)}, LAYERS, "a weight .* and a bias"),
    "nan": ({**STATE, "2.bias": torch.full((5,), float("nan"))}, LAYERS, "finite"),
    "integers": ({**STATE, "2.weight": torch.ones(5, 7, dtype=torch.int64)}, LAYERS, "floating-point"),
    "two policies": ({f"{p}.{k}": v for p in ("a", "b") for k, v in STATE.items()}, LAYERS, "--prefix"),
    "only a critic": ({f"critic.{k}": v for k, v in STATE.items()}, LAYERS, "holds 0"),
    "nothing": ({"x": torch.ones(2)}, LAYERS, r"none in x \(2,\) \(layers must be called"),
    "a wrong prefix": (
        STATE,
        replace(LAYERS, prefix="actor"),
        "actor.0.weight and so on; found layers without",
    ),
    "a state twice": (STATE, replace(LAYERS, states=("x0", "x0")), "--states must name each state once"),
    "no expression": (
        STATE,
        replace(LAYERS, states=("x0", "cos(x2)")),
        "--states must name states .*or expressions.*x2",
    ),
    "too many states": (STATE, replace(LAYERS, states=("x0",)), "--states"),
    "an observation": (STATE, replace(LAYERS, states=("x0", "cos_x1")), "names 'cos_x1'"),
    "an epsilon of nothing": (STATE, replace(LAYERS, epsilon=Fraction(1)), "--epsilon must go with"),
    "two scales": (STATE, replace(LAYERS, action_scale=(Fraction(1),) * 2), "one number or 1"),
    "centre": (STATE, replace(LAYERS, centre="preactivation"), "needs `squash` 'tanh'"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refused_state_dicts(name: str, tmp_path: Path) -> None:
    data, options, message = REFUSED[name]
    with pytest.raises(InputError, match=message):
        import_policy(saved(tmp_path, data), plant(), options)


@pytest.mark.parametrize("name", ["prelu", "ELUs", "sin"])
def test_other_activations_are_refused_by_name(name: str) -> None:
    with pytest.raises(InputError, match=f"--activation must be one of tanh, relu, .*{name}"):
        ImportOptions(activation=name)


@pytest.mark.parametrize("name", ["LeakyReLU", "leaky-relu", "leaky_relu", "LEAKYRELU"])
def test_an_activation_may_be_written_as_torch_does(name: str) -> None:
    assert ImportOptions(activation=name).activation == "leaky_relu"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"kind": "keras"}, "--from"),
        ({"squash": "relu"}, "--squash"),
        ({"centre": "middle"}, "--centre"),
        ({"observes": "nothing"}, "--observes"),
        ({"action_scale": (Fraction(0),)}, "--action-scale"),
        ({"epsilon": Fraction(-1)}, "--epsilon"),
    ],
)
def test_options_that_mean_nothing(options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        ImportOptions(**options)


def test_everything_that_is_missing_is_asked_for_at_once(tmp_path: Path) -> None:
    path = saved(tmp_path, STATE)
    with pytest.raises(InputError) as error:
        import_policy(path, plant(x_eq=(1, 0)))
    for option in ("--states x0,x1", "--activation", "--squash", "--normaliser", "--action-scale", "--observes"):
        assert option in str(error.value)
    for missing in ("states", "activation", "squash", "normaliser", "action_scale"):
        with pytest.raises(InputError, match=f"required: --{missing.replace('_', '-')}[^;]*$"):
            import_policy(path, plant(), replace(LAYERS, **{missing: None}))


# ------------------------------------------------------------------------------------------------ operating points


@pytest.mark.parametrize("observes", ["absolute", "deviation"])
def test_policies_that_observe_absolute_states(observes: Any, tmp_path: Path) -> None:
    module, system = mlp(), plant(x_eq=(1, -2))
    imported = import_policy(saved(tmp_path, module.state_dict()), system, replace(LAYERS, observes=observes))
    shift = np.array([1.0, -2.0]) if observes == "absolute" else np.zeros(2)
    assert gap(imported, values(module, X + shift)) < TIGHT
    weight, bias = (STATE[f"0.{k}"].double().numpy() for k in ("weight", "bias"))
    network = imported.policy.network
    assert np.array_equal(network.weights[0], weight)
    for i in range(len(bias)):  # W x_eq in the bias, rounded once
        exact = Fraction(float(bias[i])) + sum(
            Fraction(float(w)) * Fraction(s) for w, s in zip(weight[i], shift, strict=True)
        )
        assert network.biases[0][i] == float(exact)


# ------------------------------------------------------------------------------------------------------ normalisers


def rsl(tmp_path: Path, **extra: Any) -> Path:
    state = (
        {f"actor.{k}": v for k, v in STATE.items()}
        | {f"critic.{k}": v for k, v in STATE.items()}
        | {"std": torch.ones(1)}
    )
    statistics = {"_mean": torch.tensor([[0.3, -0.2]]), "_var": torch.ones(1, 2), "_std": torch.tensor([[0.5, 2.0]])}
    return saved(tmp_path, {"model_state_dict": state, "obs_norm_state_dict": statistics, **extra}, "rsl.pt")


@pytest.mark.parametrize("epsilon", [None, Fraction(1, 2)])
def test_the_normaliser_of_rsl_rl(epsilon: Fraction | None, tmp_path: Path) -> None:
    options = replace(LAYERS, normaliser=None, epsilon=epsilon)
    imported = import_policy(rsl(tmp_path), plant(), options)
    divisor = np.array([0.5, 2.0]) + float(epsilon or Fraction(1, 100))
    mean = np.float32([0.3, -0.2]).astype(float)
    assert gap(imported, values(mlp(), (X - mean) / divisor)) < TIGHT
    assert imported.policy.valid is None
    assert "(std + epsilon)" in imported.formula
    beside = replace(options, normaliser=rsl(tmp_path))
    assert (
        import_policy(saved(tmp_path, STATE), plant(), beside).policy.network.sha256()
        == imported.policy.network.sha256()
    )


@pytest.fixture(scope="module", params=["PPO", "A2C", "SAC", "TD3"])
def stable(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A model of stable-baselines3 with its normaliser, and their files."""
    given = {"activation_fn": torch.nn.Tanh, "net_arch": [16, 8]} if request.param in ("SAC", "TD3") else {}
    return request.param, *sb3(request.param, tmp_path_factory.mktemp(request.param), **given)


def test_stable_baselines_predicts_the_same(stable: Any) -> None:
    kind, model, environment, path, normaliser = stable
    options = ImportOptions(states=("x0", "x1"), normaliser=normaliser)
    imported = import_policy(path, plant(), options)
    valid = imported.policy.valid
    assert valid is not None
    x = np.random.default_rng(0).uniform(valid[:, 0], valid[:, 1], (2000, 2)).astype(np.float32)
    theirs, _ = model.predict(environment.normalize_obs(x), deterministic=True)
    assert gap(imported, theirs, x.astype(np.float64)) < 2e-5
    assert imported.difference.in_double < TIGHT
    network = imported.policy.network
    assert network.layers == ((2, 64, 64, 1) if kind in ("PPO", "A2C") else (2, 16, 8, 1))
    if kind in ("PPO", "A2C"):
        assert network.clip is not None and [v.tolist() for v in network.clip] == [[-6.0], [6.0]]
    else:
        assert network.clip is None and network.squash == "tanh" and network.scale.tolist() == [6.0]


def test_outside_of_the_bounds_stable_baselines_clips_and_the_folded_policy_does_not(stable: Any) -> None:
    _, _, environment, path, normaliser = stable
    imported = import_policy(path, plant(), ImportOptions(states=("x0", "x1"), normaliser=normaliser))
    valid = imported.policy.valid
    assert valid is not None
    for i, side in ((0, 0), (0, 1), (1, 0), (1, 1)):
        x = np.zeros((1, 2))
        x[0, i] = valid[i, side] * (1 - 1e-6)
        z = environment.normalize_obs(x.astype(np.float64))
        assert np.max(np.abs(z)) < 10 and np.max(np.abs(z)) > 9.99
        x[0, i] = valid[i, side] * (1 + 1e-3) + (-1e-3, 1e-3)[side]
        assert np.max(np.abs(environment.normalize_obs(x))) == 10


def test_the_action_scale_is_asked_for_where_spaces_differ(stable: Any) -> None:
    _, _, _, path, _ = stable
    with pytest.raises(InputError, match=r"required: --action-scale[^;]*$"):
        import_policy(path, plant(bound=5), replace(SAID, action_scale=None))
    for bound in (6, 6 + 1e-8):  # in single precision, which spaces are in, they are the same
        assert import_policy(path, plant(bound=bound), replace(SAID, action_scale=None)).policy.valid is None


def test_what_goes_without_saying_in_stable_baselines_is_refused_where_said(stable: Any) -> None:
    _, _, _, path, normaliser = stable
    for wrong in ({"activation": "tanh"}, {"squash": "tanh"}, {"prefix": "actor"}):
        with pytest.raises(InputError, match="must be left out"):
            import_policy(path, plant(), replace(SAID, **wrong))
    with pytest.raises(InputError, match="--epsilon must be left out"):
        import_policy(path, plant(), replace(SAID, normaliser=normaliser, epsilon=Fraction(1)))


@pytest.mark.parametrize(
    ("kind", "given", "message"),
    [
        ("SAC", {"activation_fn": torch.nn.Softshrink}, "it is Softshrink"),
        ("TD3", {"activation_fn": torch.nn.Tanhshrink}, "it is Tanhshrink"),
        ("PPO", {"activation_fn": torch.nn.Hardshrink}, "it is Hardshrink"),
    ],
)
def test_other_activations_of_stable_baselines_are_refused_by_name(
    kind: str, given: Any, message: str, tmp_path: Path
) -> None:
    _, _, path, _ = sb3(kind, tmp_path, **given)
    with pytest.raises(InputError, match=message):
        import_policy(path, plant(), SAID)


def test_a_normaliser_that_the_file_holds_is_not_left_out(tmp_path: Path) -> None:
    for given in ("none", rsl(tmp_path)):
        with pytest.raises(InputError, match="the file holds the normaliser"):
            import_policy(rsl(tmp_path), plant(), replace(LAYERS, normaliser=given))  # type: ignore[arg-type]


def test_order_operating_point_and_normaliser_together(tmp_path: Path) -> None:
    """The network reads (x1, x0) as absolute values through VecNormalize; the policy reads deviations (x0, x1)."""
    model, environment, path, normaliser = sb3("PPO", tmp_path)
    environment.obs_rms.mean, environment.obs_rms.var = np.array([-2.5, 1.25]), np.array([0.01, 0.09])
    environment.save(str(normaliser))
    with pytest.raises(InputError, match=r"is a normaliser of observations: name it with --normaliser"):
        import_policy(normaliser, plant(), SAID)
    options = ImportOptions(states=("x1", "x0"), normaliser=normaliser, observes="absolute")
    policy = import_policy(path, plant(x_eq=(1, -2)), options).policy
    reach = 10 * np.sqrt(environment.obs_rms.var + 1e-8)
    lows, highs = environment.obs_rms.mean - reach, environment.obs_rms.mean + reach
    expected = [[lows[1] - 1, highs[1] - 1], [lows[0] + 2, highs[0] + 2]]
    assert policy.valid is not None
    np.testing.assert_allclose(policy.valid, expected, rtol=1e-14)
    x = np.random.default_rng(0).uniform(policy.valid[:, 0], policy.valid[:, 1], (1000, 2))
    theirs, _ = model.predict(environment.normalize_obs(np.add(x, (1, -2))[:, ::-1]), deterministic=True)
    assert np.max(np.abs(policy.network(x, U_EQ) - theirs)) < 1e-5


@pytest.mark.parametrize("kind", ["PPO", "SAC"])
def test_spaces_in_double_precision(kind: str, tmp_path: Path) -> None:
    given = {"activation_fn": torch.nn.Tanh, "net_arch": [8]} if kind == "SAC" else {}
    model, _, path, _ = sb3(kind, tmp_path, Odd, **given)
    imported = import_policy(path, plant(), SAID)
    theirs, _ = model.predict(X, deterministic=True)
    assert gap(imported, theirs) < 1e-6 and imported.difference.in_double < TIGHT
    network = imported.policy.network
    if kind == "SAC":  # half of the exact difference and sum of the two numbers, rounded once
        lo, hi = Fraction(-0.1), Fraction(0.3)
        assert (network.scale[0], network.offset[0]) == (float((hi - lo) / 2), float((hi + lo) / 2))


HOSTILE = {
    "norm_obs": (np.bool_(False), "true or false"),
    "epsilon": (np.array([1.0, 2.0]), "must be one number"),
    "clip_obs": ("10", "must be a number"),
    "obs_rms": ({"a": 1}, "must hold obs_rms of arrays"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_normalisers_that_say_something_else_are_refused(name: str, tmp_path: Path) -> None:
    value, message = HOSTILE[name]
    _, environment, path, normaliser = sb3("PPO", tmp_path)
    setattr(environment, name, value)
    environment.save(str(normaliser))
    with pytest.raises(InputError, match=message):
        import_policy(path, plant(), ImportOptions(states=("x0", "x1"), normaliser=normaliser))


@pytest.mark.parametrize("change", [{"var": -1.0}, {"var": np.nan}, {"mean": np.inf}, {"mean": "zeros"}])
def test_statistics_that_are_no_statistics_are_refused(change: dict[str, Any], tmp_path: Path) -> None:
    _, environment, path, normaliser = sb3("PPO", tmp_path)
    for name, value in change.items():
        setattr(environment.obs_rms, name, np.zeros((2, 1)) if value == "zeros" else np.full(2, value))
    environment.save(str(normaliser))
    with pytest.raises(InputError, match=r"positive|finite|two vectors"):
        import_policy(path, plant(), ImportOptions(states=("x0", "x1"), normaliser=normaliser))


@pytest.mark.parametrize(("clip", "norm"), [(np.inf, True), (10.0, False)])
def test_normalisers_without_a_clip_or_without_effect(clip: float, norm: bool, tmp_path: Path) -> None:
    _, environment, path, normaliser = sb3("PPO", tmp_path)
    environment.clip_obs, environment.norm_obs = clip, norm
    environment.save(str(normaliser))
    imported = import_policy(path, plant(), ImportOptions(states=("x0", "x1"), normaliser=normaliser))
    plain = import_policy(path, plant(), ImportOptions(states=("x0", "x1"), normaliser="none"))
    assert imported.policy.valid is None
    assert (imported.policy.network.sha256() == plain.policy.network.sha256()) == (not norm)
    assert len(imported.policy.training["imported"]["normaliser_sha256"]) == 64


def test_a_normaliser_of_another_size_or_kind_is_refused(tmp_path: Path) -> None:
    import pickle

    path = saved(tmp_path, STATE)
    files = {
        "list.pkl": (pickle.dumps([1, 2]), "must be a pickle of VecNormalize"),
        "noise.pkl": (b"noise", "no pickle"),
        "weights.pt": (path.read_bytes(), "must hold _mean and _std"),
        "rsl.pt": (None, r"normaliser .*rsl\.pt must be of the 3 numbers .*; it is of 2\. Name the one"),
    }
    for name, (raw, message) in files.items():
        file = tmp_path / name if raw is not None else rsl(tmp_path)
        if raw is not None:
            file.write_bytes(raw)
        many = replace(LAYERS, normaliser=file, states=("x0", "x1", "x2") if raw is None else ("x0", "x1"))
        policy = saved(tmp_path, mlp((3, 4, 1)).state_dict(), "three.pt") if raw is None else path
        with pytest.raises(InputError, match=message):
            import_policy(policy, plant(3), many)
    with pytest.raises(InputError, match="cannot be read"):
        import_policy(path, plant(), replace(LAYERS, normaliser=tmp_path / "missing.pkl"))


# ------------------------------------------------------------------------------------- graphs and other containers


class Scaled(torch.nn.Module):
    """Everything that a graph may do, in one module."""

    def __init__(self) -> None:
        super().__init__()
        self.net = mlp(last=torch.nn.Tanh())
        self.register_buffer("mean", torch.tensor([0.1, 0.2]))
        self.register_buffer("std", torch.tensor([0.9, 2.0]))
        self.gain = 3.0

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        x = torch.clamp((x - self.mean) / self.std, -4.0, 4.0)
        return torch.clamp(-self.net(x) * self.gain + 0.5, -2.0, 2.0)


class Relu(torch.nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.a, self.b = torch.nn.Linear(2, 4), torch.nn.Linear(4, 1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return 6.0 * torch.relu(torch.tanh(self.b(torch.tanh(self.a(x)))))


def scripted(module: torch.nn.Module, how: str, path: Path) -> Path:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        module = module.float().eval()
        compiled = torch.jit.trace(module, torch.zeros(1, 2)) if how == "trace" else torch.jit.script(module)
        if how == "freeze":
            compiled = torch.jit.freeze(compiled)
        torch.jit.save(compiled, str(path))
    return path


def jit(path: Path, x: np.ndarray) -> np.ndarray:
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")
        result: np.ndarray = torch.jit.load(str(path))(torch.tensor(x, dtype=torch.float32)).numpy()
    return result


def before(self: Any, x: tuple[torch.Tensor]) -> tuple[torch.Tensor]:
    return (2.0 * x[0],)


def behind(self: Any, x: tuple[torch.Tensor], u: torch.Tensor) -> torch.Tensor:
    return 3.0 * u + 1.0


def hooked(module: torch.nn.Module, inner: torch.nn.Module, which: str) -> torch.nn.Module:
    if which == "before":
        inner.register_forward_pre_hook(before)
    else:
        inner.register_forward_hook(behind)
    return module


@pytest.mark.parametrize("which", ["before", "behind"])
def test_torchscript_with_a_hook_is_refused_unless_its_code_calls_it(which: str, tmp_path: Path) -> None:
    """torch calls the hooks of the whole module, which no code of the archive does."""
    torch.manual_seed(4)
    module = Relu()
    path = scripted(hooked(module, module.a, which), "script", tmp_path / "inner.pt")
    assert gap(import_policy(path, plant(), SAID), jit(path, X)) < 5e-6
    module = Relu()
    path = scripted(hooked(module, module, which), "script", tmp_path / "whole.pt")
    with pytest.raises(InputError, match="has a forward hook: write it into forward"):
        import_policy(path, plant(), SAID)


class Sized(Relu):
    def NumToTensor(self, count: int) -> int:
        return 3 * count

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.b(torch.tanh(self.a(x))) * self.NumToTensor(x.size(1))


def test_torchscript_with_names_of_its_own_is_what_torch_makes_of_it(tmp_path: Path) -> None:
    """A method is called like an operation of torch, and a function of the archive like a module's forward."""
    torch.manual_seed(4)
    path = scripted(Sized(), "script", tmp_path / "sized.pt")
    assert gap(import_policy(path, plant(), SAID), jit(path, X)) < 5e-6
    path = scripted(Relu(), "script", tmp_path / "policy.pt")
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("policy/code/b.py", "def forward(h: Tensor) -> Tensor:\n  return torch.slice(h, 1, 0, 1)\n")
    assert gap(import_policy(path, plant(), SAID), jit(path, X)) < 5e-6


@pytest.mark.parametrize("how", ["trace", "script", "freeze"])
@pytest.mark.parametrize("make", [mlp, Scaled, Relu, Constant])
def test_torchscript(make: Any, how: str, tmp_path: Path) -> None:
    torch.manual_seed(4)
    path = scripted(make(), how, tmp_path / "policy.pt")
    imported = import_policy(path, plant(), SAID)
    assert gap(imported, jit(path, X)) < 5e-6
    assert imported.difference.in_double < TIGHT
    if make is Scaled:
        mean, std = np.float32([0.1, 0.2]).astype(float), np.float32([0.9, 2.0]).astype(float)
        np.testing.assert_allclose(imported.policy.valid, np.stack([mean - 4 * std, mean + 4 * std], 1), rtol=1e-15)


ACTIVATIONS = [
    *("ReLU", "ELU", "SiLU", "Mish", "Softsign", "LeakyReLU", "SELU", "CELU", "Hardtanh", "ReLU6", "Hardswish"),
    *("Hardsigmoid", "Tanh", "GELU", "Sigmoid", "Softplus", "LogSigmoid"),
]


@pytest.mark.parametrize("how", slow_after(2, ["trace", "script", "freeze"]))
@pytest.mark.parametrize("name", [*ACTIVATIONS, *(f"{name} in place" for name in ACTIVATIONS[:3])])
def test_torchscript_of_every_activation(name: str, how: str, tmp_path: Path) -> None:
    torch.manual_seed(4)
    kind, _, in_place = name.partition(" ")
    unit = getattr(torch.nn, kind)(**({"inplace": True} if in_place else {}))
    path = scripted(torch.nn.Sequential(torch.nn.Linear(2, 6), unit, torch.nn.Linear(6, 1)), how, tmp_path / "p.pt")
    assert gap(import_policy(path, plant(), SAID), jit(path, X)) < 5e-6


class InPlace(torch.nn.Module):
    """What an operation in place has overwritten is read again."""

    def __init__(self) -> None:
        super().__init__()
        self.a, self.b = torch.nn.Linear(2, 6), torch.nn.Linear(6, 1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        y = self.a(x)
        z = torch.nn.functional.relu(y, inplace=True)
        result: torch.Tensor = self.b(y + z)
        return result


@pytest.mark.parametrize("how", ["script", "freeze"])
def test_a_value_that_was_overwritten_is_not_read(how: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="in place has overwritten"):
        import_policy(scripted(InPlace(), how, tmp_path / "p.pt"), plant(), SAID)


def test_a_trace_reads_what_was_written(tmp_path: Path) -> None:
    path = scripted(InPlace(), "trace", tmp_path / "p.pt")
    assert gap(import_policy(path, plant(), SAID), jit(path, X)) < 5e-6


def rewritten(path: Path, old: str, new: str) -> Path:
    """The archive with another text in its code."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        for name, raw in members.items():
            archive.writestr(name, raw.replace(old.encode(), new.encode()) if name.endswith(".py") else raw)
    return path


@pytest.mark.parametrize("name", ["p/CODE", "q/code"])
def test_torchscript_of_which_torch_reads_another_member_is_refused(name: str, tmp_path: Path) -> None:
    """torch looks members up whatever their case, in the folder of the first one."""
    torch.manual_seed(4)
    path = scripted(Relu(), "script", tmp_path / "p.pt")
    with zipfile.ZipFile(path) as archive:
        members = {each: archive.read(each) for each in archive.namelist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        for each in [each for each in members if each.startswith("p/code/")]:
            archive.writestr(each.replace("p/code", name), members[each].replace(b"torch.tanh", b"torch.relu"))
        for each, raw in members.items():
            archive.writestr(each, raw)
    with pytest.raises(InputError, match="differ in capital letters alone"):
        import_policy(path, plant(), SAID)


class Shares(Relu):
    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("whole", torch.tensor([7]))
        self.register_buffer("parts", torch.tensor([2]))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.b(torch.tanh(self.a(x))) * torch.div(self.whole, self.parts)


def test_torchscript_of_an_old_format_divides_no_integers(tmp_path: Path) -> None:
    """There torch rounds the quotient of integers towards 0."""
    torch.manual_seed(4)
    path = scripted(Shares(), "script", tmp_path / "p.pt")
    assert gap(import_policy(path, plant(), SAID), jit(path, X)) < 5e-6
    with zipfile.ZipFile(path) as archive:
        members = {each: archive.read(each) for each in archive.namelist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        for each, raw in members.items():
            archive.writestr(each, b"3\n" if each == "p/version" else raw)
    with pytest.raises(InputError, match="of torch before"):
        import_policy(path, plant(), SAID)


def test_a_function_is_what_its_archive_says(tmp_path: Path) -> None:
    torch.manual_seed(4)
    module = torch.nn.Sequential(torch.nn.Linear(2, 6), torch.nn.ReLU(), torch.nn.Linear(6, 1))
    path = rewritten(scripted(module, "script", tmp_path / "p.pt"), "torch.relu(input)", "torch.tanh(input)")
    module[1] = torch.nn.Tanh()
    with torch.no_grad():
        wanted = module(torch.tensor(X, dtype=torch.float32)).numpy()
    assert gap(import_policy(path, plant(), SAID), wanted) < 5e-6


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("if inplace:", "if torch.relu(input):", "must branch on constants alone"),
        ("return result", "pass", "must return its value"),
        ("inplace: bool=False", "*inplace: bool", "by their place alone"),
        ("relu(input, False, )", "relu(input, False, 1)", "must have 2 arguments"),
        ("result = torch.relu(input)", "result = __torch__.torch.nn.functional.relu(input, False)", "at most 40 deep"),
    ],
)
def test_functions_that_are_not_read(old: str, new: str, message: str, tmp_path: Path) -> None:
    module = torch.nn.Sequential(torch.nn.Linear(2, 6), torch.nn.ReLU(), torch.nn.Linear(6, 1))
    path = rewritten(scripted(module, "script", tmp_path / "p.pt"), old, new)
    with pytest.raises(InputError, match=message):
        import_policy(path, plant(), SAID)


class Hidden(torch.nn.Module):
    def __init__(self, kind: str) -> None:
        super().__init__()
        self.kind, self.a, self.b = kind, torch.nn.Linear(2, 4), torch.nn.Linear(4, 1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        y = self.a(x)
        if self.kind == "elu":
            y = torch.nn.functional.elu(y, 2.0)
        elif self.kind == "skip":
            y = torch.tanh(y) + y
        elif self.kind == "product":
            y = torch.tanh(y) * y
        elif self.kind == "sum":
            y = torch.tanh(y).sum(-1, keepdim=True) * torch.ones(4)
        return self.b(y)


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("sum", r"torch\.sum .* is not read"),
    ],
)
def test_graphs_that_are_no_chain_of_layers_are_refused(kind: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        import_policy(scripted(Hidden(kind), "trace", tmp_path / "p.pt"), plant(), SAID)


def test_loading_torchscript_runs_code_and_reading_it_does_not(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = scripted(SetsItsState(), "script", tmp_path / "p.pt")
    capfd.readouterr()
    jit(path, X)
    assert "executed" in capfd.readouterr().out  # so the attack works
    with pytest.raises(InputError, match="has no k"):
        import_policy(path, plant(), SAID)
    assert "executed" not in capfd.readouterr().out


@pytest.mark.parametrize(
    ("code", "message"),
    [
        ("    é = x\n    return x\n", "no code"),  # TorchScript and Python may take it for other names
        ("    return torch.mul(x, self.k)\n", "says twice what is its training|has no k"),
        ("    return torch.mul(x, self.training)\n", "says twice what is its training"),
        ("    torch = x\n    return x\n", "statement"),
        ("    CONSTANTS = self\n    return x\n", "statement"),
        ("    y = ops.aten.from_file('/etc/passwd')\n    return x\n", "expression"),
        ("    while True:\n      return x\n    return x\n", "statement"),
        ("    if torch.add(x, 1.0):\n      return x\n    return x\n", "branch on constants"),
        ("    return torch.add(x, 1.0, alpha=2)\n", "alpha"),
        ("    return torch.add(x, x)\n", "must have a layer"),
        ("    return torch.mul(x, CONSTANTS.c7)\n", "no constant 7"),
        ("    return self.weight\n", "must return"),
        ("    return self.nothing\n", "has no nothing"),
        ("    return (self).forward(x, )\n", "nest at most"),
        ("    x.data = x\n    return x\n", "statement"),
        ("    return torch.div(x, 0)\n", "divides by 0"),
        ("    return torch.mul(x, True)\n", "must join"),
        ("    return torch.mul(x, 1e999)\n", "finite"),
        ("    y = torch.add(x, 1.0)\n", "must return its value"),
        ("    return self" + ".a" * 20_000 + "\n", "no code|too deep|has no"),
        ("    return torch.mul(x, " + "9" * 400 + ")\n", "real numbers"),
        ("    return [x for x in x]\n", "expression"),
        ("    return torch.linear(x, self.weight, \n", "no code"),
        ("    return " + "(" * 500 + "x" + ")" * 500 + "\n", "no code|expression"),
    ],
)
def test_hostile_code_is_refused(code: str, message: str, tmp_path: Path) -> None:
    import zipfile

    path = scripted(torch.nn.Linear(2, 1), "trace", tmp_path / "p.pt")
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = next(n for n in members if n.endswith(".py"))
    head = members[name].decode().split("    bias = ")[0].replace("input: Tensor", "x: Tensor")
    if "training)" in code:  # torch reads the class, a pickle may say something else
        head = head.replace("  training : bool\n", "  training : Final[int] = 3\n")
    members[name] = (head + code).encode()
    with zipfile.ZipFile(path, "w") as archive:
        for member, content in members.items():
            archive.writestr(member, content)
    with pytest.raises(InputError, match=message):
        import_policy(path, plant(), SAID)


def test_safetensors(tmp_path: Path) -> None:
    from safetensors.torch import save_file

    path = tmp_path / "policy.safetensors"
    save_file({f"actor.{k}": v for k, v in STATE.items()}, path)
    imported = import_policy(path, plant(), LAYERS)
    assert gap(imported, values(mlp(), X)) < TIGHT
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(InputError, match="damaged"):
        import_policy(path, plant(), LAYERS)
    save_file(STATE, path, {"format": "pt", "negative_slope": "0.1", "note": "n" * 99})
    with pytest.raises(InputError, match=r"__metadata__\.negative_slope = 0\.1, .* --activation leaky_relu:0\.1, or"):
        import_policy(path, plant(), replace(LAYERS, activation="leaky_relu"))
    for said, why in (
        ("leaky_relu:0.1", "the slope that"),
        ("leaky_relu:0.3", "it is 0.1, not the slope that"),
        ("tanh", ""),
    ):
        found = import_policy(path, plant(), replace(LAYERS, activation=said)).not_read
        texts = found["__metadata__"]
        assert f"note = {'n' * 80} …" in texts and "format" not in texts
        assert ("negative_slope = 0.1" in texts) is not why.endswith("that")
        assert not why or found["__metadata__.negative_slope"].startswith(why)
    save_file(STATE, path, {"slope": "steep"})
    with pytest.raises(InputError, match=r"slope in the metadata of .* must be a number; found 'steep'"):
        import_policy(path, plant(), replace(LAYERS, activation="leaky_relu"))


# --------------------------------------------------------------------------------------- centring, records, the file


def test_nothing_is_centred_unless_it_is_asked_for(tmp_path: Path) -> None:
    module = mlp(last=torch.nn.Tanh())
    path, options = saved(tmp_path, STATE), replace(LAYERS, squash="tanh")
    plain = import_policy(path, plant(), options)
    assert plain.policy.network.centre == "none"
    at_0 = values(module, np.zeros((1, 2)))[0, 0]
    assert abs(plain.at_origin[0] - at_0) < TIGHT and abs(plain.centring["output"] - abs(at_0)) < TIGHT
    for centre in ("output", "preactivation"):
        centred = import_policy(path, plant(), replace(options, centre=centre))
        assert centred.policy.network.centre == centre and centred.policy.network(np.zeros(2), U_EQ)[0] == 0
        x = np.random.default_rng(0).uniform(-5, 5, (10_000, 2))
        changes = np.abs(centred.policy.network(x, U_EQ) - plain.policy.network(x, U_EQ))
        assert abs(changes.max() / centred.centring[centre] - 1) < 0.02
        assert centred.at_origin == plain.at_origin  # pi(0) of the file, not of what was made of it


def test_the_policy_file_keeps_what_was_found(tmp_path: Path) -> None:
    clipped = replace(LAYERS, clip=Clip((Fraction(-1),), (Fraction(1),)))
    imported = import_policy(saved(tmp_path, STATE), plant(), clipped)
    save_policy(tmp_path / "out.pt", imported.policy)
    read = load_policy(tmp_path / "out.pt")
    assert read.network.sha256() == imported.policy.network.sha256() and read.system == "chain"
    record = read.training["imported"]
    assert record["kind"] == "state-dict" and record["options"]["--clip"] == "-1:1" and len(record["sha256"]) == 64
    again = import_policy(saved(tmp_path, STATE), plant(), clipped)
    save_policy(tmp_path / "again.pt", again.policy)
    assert (tmp_path / "again.pt").read_bytes() == (tmp_path / "out.pt").read_bytes()


def network() -> PolicyNetwork:
    return PolicyNetwork.of_layers((np.ones((1, 2)),), (np.zeros(1),), np.ones(1), np.zeros(1), "tanh", "none")


def test_bounds_of_validity_survive_the_file(tmp_path: Path) -> None:
    valid = np.array([[-1 / 3, 2.0], [-np.inf, np.inf]])
    save_policy(tmp_path / "v.pt", Policy(network(), "chain", valid=valid))
    assert torch.load(tmp_path / "v.pt", weights_only=True)["format"] == "certify-policy/2"
    read = load_policy(tmp_path / "v.pt").valid
    assert read is not None and np.array_equal(read, valid)


@pytest.mark.parametrize(
    "valid",
    [
        [[0.0, 1.0], [-1.0, 1.0]],
        [[-1.0, 1.0]],
        [[1.0, 2.0]] * 2,
        [[-np.inf, np.inf]] * 2,
        [[np.nan, 1.0]] * 2,
        [[1.0, -1.0]] * 2,
    ],
)
def test_bounds_that_mean_nothing_are_refused(valid: Any) -> None:
    with pytest.raises(InputError, match=r"valid|surround the origin"):
        Policy(network(), "chain", valid=np.array(valid))


def test_version_1_has_no_bounds_and_version_2_has_something(tmp_path: Path) -> None:
    save_policy(tmp_path / "v.pt", Policy(network(), "chain", valid=np.array([[-1.0, 1.0]] * 2)))
    data = torch.load(tmp_path / "v.pt", weights_only=True)
    for wrong in ({**data, "format": "certify-policy/1"}, {k: v for k, v in data.items() if k != "valid"}):
        torch.save(wrong, tmp_path / "w.pt")
        with pytest.raises(InputError, match=r"valid|clip"):
            load_policy(tmp_path / "w.pt")


# ---------------------------------------------------------------------------------------------- recognising, refusing


def test_parts_of_a_two_stage_policy_under_different_prefixes_are_none(tmp_path: Path) -> None:
    state = {f"a.controller.layers.{k}": v for k, v in STATE.items()}
    state |= {"b.controller.x_equilibrium": torch.zeros(2), "a.controller.b": torch.zeros(1)}
    path = saved(tmp_path, state)
    assert content_of(path.read_bytes(), path.name) == "state-dict"


def test_a_format_that_holds_itself_is_no_format(tmp_path: Path) -> None:
    deep: Any = ()
    for _ in range(60):
        deep = (deep, deep)
    path = saved(tmp_path, {"format": deep, **STATE})
    assert content_of(path.read_bytes(), path.name) == "state-dict"  # at once, not after 2^60 steps


def test_what_a_file_is_follows_from_its_bytes(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    torch.save(STATE, buffer, _use_new_zipfile_serialization=False)
    assert content_of(buffer.getvalue(), "p.pt") == "state-dict"
    for raw, message in (
        (pickle.dumps(STATE, protocol=0), "a pickle of protocol 2 or later"),
        (b"noise", "none of these"),
        (b"", "none of these"),
        (b"PK\x03\x04noise", "no zip archive"),
    ):
        (tmp_path / "p.pt").write_bytes(raw)
        with pytest.raises(InputError, match=message):
            import_policy(tmp_path / "p.pt", plant(), LAYERS)
    save_policy(tmp_path / "own.pt", Policy(network(), "chain"))
    assert content_of((tmp_path / "own.pt").read_bytes(), "own.pt") == "policy"
    with pytest.raises(InputError, match="already"):
        import_policy(tmp_path / "own.pt", plant(), LAYERS)
    with pytest.raises(InputError, match="--from says, sb3"):
        import_policy(saved(tmp_path, STATE), plant(), replace(LAYERS, kind="sb3"))
    with pytest.raises(InputError, match="cannot be read"):
        import_policy(tmp_path / "missing.pt", plant(), LAYERS)


def members(*names: str) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name in names:
            archive.writestr(name, b"")
    return buffer.getvalue()


BARE: dict[str, Any] = {
    "tensors": STATE,
    "arrays": {"weights": {f"actor.{k}": v.numpy() for k, v in STATE.items()}, "spec": Fraction, "made": Odd()},
    "kernels": {k.replace("weight", "kernel"): v.numpy().T for k, v in STATE.items()},
}


@pytest.mark.parametrize("name", BARE)
def test_pickles_that_stand_alone_are_read_as_data(name: str, tmp_path: Path) -> None:
    for protocol in range(2, pickle.HIGHEST_PROTOCOL + 1):
        (tmp_path / "p.pkl").write_bytes(pickle.dumps(BARE[name], protocol))
        assert gap(import_policy(tmp_path / "p.pkl", plant(), LAYERS), values(mlp(), X)) < TIGHT
    raw = (tmp_path / "p.pkl").read_bytes()
    (tmp_path / "p.pkl").write_bytes(raw[: len(raw) // 2])
    with pytest.raises(InputError, match=r"p\.pkl (ends before its pickle does|is no pickle or is damaged)"):
        import_policy(tmp_path / "p.pkl", plant(), LAYERS)


def test_an_archive_that_is_cut_is_not_read_as_the_last_one_inside(tmp_path: Path) -> None:
    """A file of stable-baselines3 holds files of torch as they are, each with a directory of its own at its end."""
    raw = saved(tmp_path, STATE).read_bytes()
    with zipfile.ZipFile(tmp_path / "sb3.zip", "w") as archive:
        for name, content in (("data", b"{}"), ("policy.pth", raw), ("more", bytes(99))):
            archive.writestr(name, content)
    whole = (tmp_path / "sb3.zip").read_bytes()
    (tmp_path / "sb3.zip").write_bytes(whole[: whole.index(raw) + len(raw) + 50])
    with pytest.raises(InputError, match=r"The file is cut, or damaged"):
        import_policy(tmp_path / "sb3.zip", plant(), LAYERS)


HDF5 = b"\x89HDF\r\n\x1a\n" + bytes(64)
NOT_READ = {
    "policy.keras": (members("metadata.json", "config.json", "model.weights.h5"), "model of Keras.*export.*tf2onnx"),
    "policy.h5": (HDF5, "HDF5, as Keras.*tf2onnx.*numpy.savez.*dense/kernel"),
    "sb2.zip": (members("data", "parameter_list", "parameters"), "stable-baselines 2, .*numpy.load.*numpy.savez"),
    "policy.mat": (b"MATLAB 5.0 MAT-file, Platform" + bytes(200), "MAT-file.*exportONNXNetwork.*loadmat.*0.weight"),
    "new.mat": (b"MATLAB 7.3 MAT-file, Platform".ljust(512) + HDF5, "MAT-file of MATLAB"),
    "params.msgpack": (b"\x81\xa6params\x80{", "msgpack, as flax.*numpy.savez"),
    "ACASXU.nnet": (b"// Neural Network File Format\n1,2,1,2,\n", "NNet.*0.weight.*obs._mean"),
    "K.npy": (b"\x93NUMPY\x01\x00", "one array of numpy.*a gain K.*0.weight = -K"),
    "best.onnx": (b"version https://git-lfs.github.com/spec/v1\noid sha256:1d\nsize 15\n", "Git LFS, .*git lfs pull"),
    "saved_model.pb": (b"\x08\x01", "SavedModel.*tf2onnx.convert --saved-model FOLDER"),
}


@pytest.mark.parametrize("name", NOT_READ)
def test_what_is_known_and_not_read_has_a_next_step(name: str, tmp_path: Path) -> None:
    raw, message = NOT_READ[name]
    (tmp_path / name).write_bytes(raw)
    with pytest.raises(InputError, match=message):
        import_policy(tmp_path / name, plant(), LAYERS)
    with pytest.raises(InputError, match=message):
        load_policy(tmp_path / name)


@pytest.mark.parametrize(
    ("inside", "message"),
    [
        ("saved_model.pb", "SavedModel.*--saved-model .*folder --output policy.onnx"),
        ("_METADATA", "orbax.*numpy.savez"),
        ("a", "a folder. Name the file"),
    ],
)
def test_a_folder_has_a_next_step(inside: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / inside).write_bytes(b"")
    with pytest.raises(InputError, match=message):
        import_policy(tmp_path / "folder", plant(), LAYERS)


def test_the_weights_of_keras_are_read_as_the_next_step_writes_them(tmp_path: Path) -> None:
    module = mlp((2, 5, 1))
    names = {"0": "dense", "2": "dense_1"}
    arrays = {
        f"{names[key[0]]}/{'kernel' if v.ndim == 2 else 'bias'}": v.numpy().T for key, v in module.state_dict().items()
    }
    np.savez(tmp_path / "policy.npz", **arrays)
    found = import_policy(tmp_path / "policy.npz", plant(), replace(LAYERS, prefix="dense,dense_1"))
    assert gap(found, values(module, X)) < TIGHT


# ------------------------------------------------------------------------------------------------- other people's files


def test_two_stage_files_are_centred_inside_the_squash(tmp_path: Path) -> None:
    system = get_system("quadrotor2d")
    path, module = two_stage(tmp_path, system, 6.0)
    names = tuple(s.name for s in system.states)
    options = ImportOptions(states=names, squash="relu-tanh", action_scale=(Fraction(6),))
    imported = import_policy(path, system, options)
    policy, u_eq = imported.policy, system.exact_u_eq()
    x = np.random.default_rng(0).uniform(-0.5, 0.5, (300, 6))
    ratio = np.array([float(u / 6) for u in u_eq])
    y = values(module, x) - values(module, np.zeros((1, 6))) + np.arctanh(ratio)
    assert np.max(np.abs(policy.network(x, u_eq) - 6 * np.maximum(np.tanh(y), 0))) < TIGHT
    assert policy.network.centre == "preactivation" and policy.beta is not None and imported.centring == {}
    assert policy.network.clip is not None and policy.network.clip[1].tolist() == [6.0, 6.0]
    for missing in ("squash", "action_scale", "states"):
        with pytest.raises(InputError, match=f"required: --{missing.replace('_', '-')}[^;]*$"):
            import_policy(path, system, replace(options, **{missing: None}))
    with pytest.raises(InputError, match="must be left out"):
        import_policy(path, system, replace(options, centre="output"))
    with pytest.raises(InputError, match="identity"):
        import_policy(path, system, replace(options, squash="identity"))
    with pytest.raises(InputError, match="trained for other parameters"):
        import_policy(path, system.with_parameters({"m": "0.6"}), options)
    with pytest.raises(InputError, match="trained for other parameters"):
        import_policy(two_stage(tmp_path, system, 6.0, 0.01)[0], system, options)


@pytest.mark.parametrize("name", TWO_STAGE)
def test_the_two_stage_checkpoints(name: str) -> None:
    path = external("two_stage", name)
    if path is None:
        pytest.skip("the folder of other people's policies is not beside the project")
    plant_name, states, squash, scale, parameters = TWO_STAGE[name]
    system = get_system(plant_name).with_parameters(parameters)
    options = ImportOptions(states=tuple(states.split(",")), squash=squash, action_scale=(Fraction(scale),))  # type: ignore[arg-type]
    imported = import_policy(path, system, options)
    assert imported.difference.largest < 2e-4 and imported.difference.in_double < 2e-6
    assert imported.policy.beta_shift(system.exact_u_eq()) < 2e-7
    u_eq = np.array([float(u) for u in system.exact_u_eq()])
    np.testing.assert_allclose(imported.at_origin, u_eq, rtol=1e-14)


def test_the_policy_that_safe_control_gym_ships() -> None:
    """What weights_only refuses, for the numbers of random states beside the weights, is read."""
    path = external("safe_control_gym", "ppo_quadrotor_2D_stab.pt")
    if path is None:
        pytest.skip("the folder of other people's policies is not beside the project")
    names = ("x", "x_dot", "y", "y_dot", "theta", "theta_dot")
    options = replace(
        LAYERS, states=names, clip=Clip((Fraction(-1),), (Fraction(1),)), action_scale=(Fraction("0.01323"),)
    )
    options = replace(options, action_offset=(Fraction("0.1323"),))
    imported = import_policy(path, get_system("quadrotor2d"), options)
    assert imported.words == "state_dict agent.ac.actor.pi_net.fcs 6-128-128-2"
    assert imported.difference.largest < 1e-6 and imported.difference.in_double < TIGHT
    clip = imported.policy.network.clip
    low = float(Fraction("0.11907"))
    assert Fraction(low) < Fraction("0.11907")  # so the end, which is rounded inwards, is the double above it
    assert clip is not None and clip[0].tolist() == [math.nextafter(low, 1)] * 2
    # At the file's own point of rest both actions are 0.
    rest = np.array([0.0611, 0.9626, 0, 0, 0, 0])
    assert np.max(np.abs(imported.policy.network(rest, U_EQ * 2) - 0.1323)) < 2e-4
