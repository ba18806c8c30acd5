"""Policies of other programs that are more than layers: observations, branches, activations made of others."""

from __future__ import annotations

from argparse import Namespace
from collections import defaultdict
from dataclasses import replace
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from certify.errors import InputError
from certify.loop.networks import Affine, Clip, Concat, Map, Network, Observe, Sum
from certify.loop.networks.written import as_written
from certify.loop.plants import System, get_system, load_system
from certify.loop.policies import load_policy, save_policy
from certify.loop.policies.importers import ImportOptions, import_policy, import_state_dict
from certify.loop.policies.importers.memory import import_module
from certify.loop.policies.importers.steps import COMPOSED, IMPORTED, Normalise, activated
from certify.loop.rigorous import evaluate_policy

torch = pytest.importorskip("torch")
nn: Any = torch.nn
PLANT = get_system("pendulum")
SAID = ImportOptions(states=("theta", "theta_dot"), normaliser="none", action_scale=(Fraction(1),))
STATES = np.random.default_rng(0).normal(size=(50, 2)) * [2, 6]


class Residual(nn.Module):  # type: ignore[misc]
    """A hidden skip connection, and the gain beside the network."""

    def __init__(self, function: Any, kind: str = "skip") -> None:
        super().__init__()
        torch.manual_seed(3)
        self.a, self.b, self.c = nn.Linear(2, 6), nn.Linear(6, 6), nn.Linear(12 if kind == "cat" else 6, 1)
        self.gain, self.function, self.kind = nn.Linear(2, 1, bias=False), function, kind

    def forward(self, x: Any) -> Any:
        h = self.function(self.a(x))
        g = self.function(self.b(h))
        if self.kind == "cat":
            return torch.tanh(self.c(torch.cat([h, g], 1)) - self.gain(x)) * 6
        return torch.tanh(self.c(h + g) + self.gain(x)) * 6


FUNCTIONS = {
    "ReLU": nn.ReLU(),
    "LeakyReLU": nn.LeakyReLU(0.2),
    "SELU": nn.SELU(),
    "CELU": nn.CELU(2.0),
    "ELU": nn.ELU(0.5),
    "Hardtanh": nn.Hardtanh(-0.5, 0.7),
    "ReLU6": nn.ReLU6(),
    "Hardsigmoid": nn.Hardsigmoid(),
    "LogSigmoid": nn.LogSigmoid(),
    "GELU": nn.GELU(),
    "GELU of tanh": nn.GELU(approximate="tanh"),
    "Tanh": nn.Tanh(),
}


@pytest.mark.parametrize("kind", ["skip", "cat"])
@pytest.mark.parametrize("name", FUNCTIONS)
def test_modules_with_branches(name: str, kind: str, tmp_path: Path) -> None:
    """In floats, in Arb and from a file again they are the module."""
    module = Residual(FUNCTIONS[name], kind).double()
    found = import_module(module, PLANT, SAID).policy
    with torch.no_grad():
        wanted = module(torch.tensor(STATES)).numpy()
    u_eq = PLANT.exact_u_eq()
    assert np.allclose(found.network(STATES, u_eq), wanted, atol=1e-13)
    from certify.loop.closed_loop import ClosedLoop

    loop = ClosedLoop(PLANT, found.network)
    for x, u in zip(STATES[:5], wanted[:5], strict=True):
        assert abs(float(evaluate_policy(loop, x)[0].mid()) - u[0]) < 1e-13
    kinds = {type(step) for step in found.network.network.steps}
    assert Sum in kinds and (kind == "skip" or Concat in kinds)
    save_policy(tmp_path / "p.pt", found)
    again = load_policy(tmp_path / "p.pt").network
    assert again.sha256() == found.network.sha256()
    assert np.array_equal(again(STATES, u_eq), found.network(STATES, u_eq))


@pytest.mark.parametrize("function", [nn.ELU(), nn.ELU(0.5), nn.CELU(2), nn.SELU()])
def test_the_exponential_less_one_cancels_near_0(function: nn.Module) -> None:
    module = nn.Sequential(nn.Linear(2, 1), function, nn.Linear(1, 1)).double()
    with torch.no_grad():
        for layer in (module[0], module[2]):
            layer.weight.copy_(torch.eye(2)[:1, : layer.in_features])
            layer.bias.zero_()
    assert import_module(module, PLANT, SAID).difference.in_double < 1e-15


@pytest.mark.parametrize("name", IMPORTED)
def test_state_dicts_of_every_activation(name: str) -> None:
    generator = np.random.default_rng(1)
    tensors = {
        "0.weight": generator.normal(size=(5, 2)), "0.bias": generator.normal(size=5),
        "2.weight": generator.normal(size=(5, 5)), "2.bias": generator.normal(size=5),
        "4.weight": generator.normal(size=(1, 5)), "4.bias": generator.normal(size=1),
    }  # fmt: skip
    found = import_state_dict(tensors, PLANT, replace(SAID, activation=name, squash="identity"))
    known = {"relu6": "relu6", "leaky_relu": "leaky_relu", "logsigmoid": "logsigmoid"}
    tanh_form = partial(nn.functional.gelu, approximate="tanh")
    phi = tanh_form if name == "gelu-tanh" else getattr(nn.functional, known.get(name, name))
    h = torch.tensor(STATES)
    for k in (0, 2, 4):
        h = nn.functional.linear(phi(h) if k else h, *(torch.tensor(tensors[f"{k}.{p}"]) for p in ("weight", "bias")))
    assert np.allclose(found.policy.network(STATES, (Fraction(0),)), h.numpy(), atol=1e-12)


NUMBERED = {
    "leaky_relu:0.1": nn.LeakyReLU(0.1),
    "leaky_relu:0.01": nn.LeakyReLU(),
    "elu:0.5": nn.ELU(0.5),
    "elu:1": nn.ELU(),
    "celu:2": nn.CELU(2),
    "softplus:3": nn.Softplus(3),
}


@pytest.mark.parametrize("name", NUMBERED)
def test_the_number_of_an_activation_is_that_of_the_option(name: str) -> None:
    module = nn.Sequential(nn.Linear(2, 5), NUMBERED[name], nn.Linear(5, 1)).double()
    options = replace(SAID, activation=name, squash="identity")
    found = import_state_dict(module.state_dict(), PLANT, options)
    with torch.no_grad():
        assert np.allclose(found.policy.network(STATES, (Fraction(0),)), module(torch.tensor(STATES)), atol=1e-13)
    function, number = name.split(":")
    assert f"{function} (" in found.assumed and f" {number})" in found.assumed
    assert found.policy.training["imported"]["options"]["--activation"] == name


SLOPE = {"negative_slope": 0.1}
SAYS_A_NUMBER: dict[str, tuple[dict[str, Any], str, str]] = {
    "beside": (SLOPE, "leaky_relu", "negative_slope = 0.1, .* --activation leaky_relu:0.1, or .* leaky_relu:0.01 if"),
    "deep": ({"config": {"nets": [SLOPE]}}, "leaky_relu", "config.nets.0.negative_slope = 0.1, "),
    "an attribute": ({"args": Namespace(relu_slope=0.1)}, "leaky_relu", "args.relu_slope = 0.1, "),
    "in a dictionary of another class": ({"config": defaultdict(int, SLOPE)}, "leaky_relu", "config.negative_slope = "),
    "of numpy": ({"negative_slope": np.float64(0.1)}, "leaky_relu", "negative_slope = 0.1, "),
    "a tensor": ({"negative_slope": torch.tensor(0.5)}, "leaky_relu", "negative_slope = 0.5, "),
    "elu": ({"elu_alpha": 2}, "elu", "elu_alpha = 2, .* --activation elu:2, or --activation elu:1 if"),
    "celu": ({"alpha": 0.5}, "celu", "--activation celu:0.5"),
    "softplus": (
        {"beta": 3.0, "softplus_beta": 1},
        "softplus",
        "softplus_beta = 1.*beta = 3|beta = 3.*softplus_beta = 1",
    ),
}


@pytest.mark.parametrize("name", SAYS_A_NUMBER)
def test_a_number_that_the_file_says_is_not_passed_over(name: str, tmp_path: Path) -> None:
    more, function, message = SAYS_A_NUMBER[name]
    weights = dict(nn.Sequential(nn.Linear(2, 5), nn.ReLU(), nn.Linear(5, 1)).state_dict())
    torch.save({"state_dict": weights} | more, tmp_path / "p.pt")
    options = replace(SAID, activation=function, squash="identity")
    with pytest.raises(InputError, match=message) as refused:
        import_policy(tmp_path / "p.pt", PLANT, options)
    typed = str(refused.value).split("--activation ")[1].partition(",")[0]
    found = import_policy(tmp_path / "p.pt", PLANT, replace(options, activation=typed))
    assert typed.partition(":")[2] in found.assumed and "that --activation says" in {*found.not_read.values()}.pop()
    found = import_policy(tmp_path / "p.pt", PLANT, replace(options, activation=f"{function}:0.75"))
    assert all(why.startswith("it is ") and ", not the " in why for why in found.not_read.values()) and found.not_read
    import_policy(
        tmp_path / "p.pt",
        PLANT,
        replace(options, activation="relu", ignore=("*negative_slope",) if name == "a tensor" else None),
    )


def test_other_numbers_of_the_run_say_nothing_of_the_activation(tmp_path: Path) -> None:
    weights = dict(nn.Sequential(nn.Linear(2, 5), nn.ReLU(), nn.Linear(5, 1)).state_dict())
    rest = {"opt": {"param_groups": [{"alpha": 0.99}]}, "log_alpha": 0.2, "critic": SLOPE, "lr": 1e-3}
    torch.save({"state_dict": weights} | rest, tmp_path / "p.pt")
    import_policy(tmp_path / "p.pt", PLANT, replace(SAID, activation="leaky_relu", squash="identity"))


@pytest.mark.parametrize("said", ["celu:0", "softplus:-1", "tanh:1", "leaky_relu:x", "elu:nan", "elu:inf", "elu:"])
def test_a_number_that_no_activation_takes_is_refused(said: str) -> None:
    with pytest.raises(InputError, match=r"number|must be positive"):
        replace(SAID, activation=said)


@pytest.mark.parametrize(
    ("states", "words"),
    [
        (("theta", "theta_dot"), "2-6-5-1 leaky relu (slope 0.01)"),
        (("sin(theta)", "theta_dot"), "2-6-5-1 leaky relu (slope 0.01) of sin(theta), theta_dot"),
    ],
)
def test_leaky_relu_is_shown_as_it_was_written(states: tuple[str, ...], words: str) -> None:
    """The widths are those of the layers that the file has; the steps stay as they are."""
    module = nn.Sequential(nn.Linear(2, 6), nn.LeakyReLU(), nn.Linear(6, 5), nn.LeakyReLU(), nn.Linear(5, 1))
    network = import_module(module, PLANT, replace(SAID, states=states)).policy.network
    assert network.words == words and network.layers == (2, 6, 5, 1)
    assert network.network.functions == ("relu",) and len(network.network.steps) >= 11


def test_a_sum_that_is_no_leaky_relu_is_shown_as_steps() -> None:
    """A skip around relu has factors of another sum than 1, or one function has two arguments."""
    one, two = Affine((0,), 0.5 * np.eye(2), np.zeros(2)), Affine((2,), 0.25 * np.eye(2), np.zeros(2))
    relu, last = Map((0,), "relu"), Affine((4,), np.ones((1, 2)), np.zeros(1))
    good = (one, relu, replace(two, weight=0.5 * np.eye(2)), Sum((1, 3)), last)
    others = {
        "another sum": (one, relu, two, Sum((1, 3)), last),
        "no multiple": (one, relu, replace(two, weight=np.diag([0.5, 0.25])), Sum((1, 3)), last),
        "a bias": (replace(one, bias=np.ones(2)), *good[1:]),
        "another function": (one, Map((0,), "tanh"), *good[2:]),
        "another argument": (one, replace(relu, of=(1,)), *good[2:]),
        "read twice": (*good[:3], Sum((1, 3)), replace(last, of=(4,)), Concat((5, 2))),
    }
    assert as_written(Network(2, good)).functions == ("leaky relu (slope 0.5)",)
    for name, steps in others.items():
        assert len(as_written(Network(2, steps)).steps) == len(steps), name


def test_every_activation_that_is_named_has_steps() -> None:
    assert all(activated(name) for name in IMPORTED) and set(COMPOSED) < set(IMPORTED)
    with pytest.raises(InputError, match="activation must be one of"):
        activated("prelu")


# --------------------------------------------------------------------------------------------------------- observations


def observing(**changes: Any) -> ImportOptions:
    states = ("cos(theta)", "sin(theta)", "theta_dot/8")
    return replace(SAID, states=states, activation="tanh", squash="tanh", action_scale=(Fraction(6),), **changes)


def three() -> dict[str, np.ndarray]:
    generator = np.random.default_rng(2)
    return {
        "0.weight": generator.normal(size=(5, 3)), "0.bias": generator.normal(size=5),
        "2.weight": generator.normal(size=(1, 5)), "2.bias": generator.normal(size=1),
    }  # fmt: skip


def by_hand(tensors: dict[str, np.ndarray], o: np.ndarray) -> np.ndarray:
    h = np.tanh(o @ tensors["0.weight"].T + tensors["0.bias"])
    return np.asarray(6 * np.tanh(h @ tensors["2.weight"].T + tensors["2.bias"]))


def observations() -> np.ndarray:
    theta, speed = STATES.T
    return np.stack([np.cos(theta), np.sin(theta), speed / 8], axis=1)


def test_expressions_of_the_states() -> None:
    found = import_state_dict(three(), PLANT, observing()).policy
    assert np.allclose(found.network(STATES, (Fraction(0),)), by_hand(three(), observations()), atol=1e-13)
    first = found.network.network.steps[0]
    assert isinstance(first, Observe) and found.network.n == 2 and found.valid is None
    assert found.network.words == "3-5-1 tanh of cos(theta), sin(theta), theta_dot/8"


@pytest.mark.parametrize("limit", [10.0, 0.5])
def test_a_normaliser_of_observations_keeps_its_clip_where_it_may_act(
    limit: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """|cos| and |sin| are within 1, the speed is not bounded by its form."""
    mean, square = np.array([0.1, -0.2, 0.05]), np.array([0.5, 0.4, 0.3])
    rational = (tuple(map(Fraction, part.tolist())) for part in (mean, square))
    normaliser = Normalise(*rational, Fraction(limit))
    monkeypatch.setattr("certify.loop.policies.importers.importing.load_normaliser", lambda *_: normaliser)
    (tmp_path / "n.pkl").touch()
    for speed, kept in (("theta_dot/8", True), ("sin(theta_dot)", limit < 1)):
        states = ("cos(theta)", "sin(theta)", speed)
        options = replace(observing(normaliser=tmp_path / "n.pkl"), states=states)
        found = import_state_dict(three(), PLANT, options).policy
        o = observations()
        o[:, 2] = STATES[:, 1] / 8 if speed == "theta_dot/8" else np.sin(STATES[:, 1])
        clipped = np.clip((o - mean) / np.sqrt(square), -limit, limit)
        assert np.allclose(found.network(STATES, (Fraction(0),)), by_hand(three(), clipped), atol=1e-12)
        assert any(isinstance(step, Clip) for step in found.network.network.steps) is kept and found.valid is None


def test_a_plant_says_what_is_observed(tmp_path: Path) -> None:
    text = (Path(__file__).parents[2] / "examples/plants/gymnasium/pendulum.toml").read_text()
    plant = load_system(_written(tmp_path, text))
    tensors = three()
    found = import_state_dict(tensors, plant, replace(observing(), states=None)).policy
    theta, speed = STATES.T
    o = np.stack([np.cos(theta), np.sin(theta), speed], axis=1)
    assert np.allclose(found.network(STATES, (Fraction(0),)), by_hand(tensors, o), atol=1e-13)
    with pytest.raises(InputError, match=r"observations.*theta_dott"):
        load_system(_written(tmp_path, text.replace('speed = "theta_dot"', 'speed = "theta_dott"')))


def test_an_observation_does_not_depend_on_what_is_uncertain(tmp_path: Path) -> None:
    text = (Path(__file__).parents[2] / "examples/plants/gymnasium/pendulum.toml").read_text()
    plant = load_system(_written(tmp_path, text.replace('speed = "theta_dot"', 'speed = "l*theta_dot"')))
    said = replace(observing(), states=None)
    assert import_state_dict(three(), plant, said).policy.network.n == 2
    with pytest.raises(InputError, match="must not depend on what is uncertain"):
        import_state_dict(three(), plant.with_ranges({"l": (Fraction(1, 2), Fraction(2))}), said)


def _written(folder: Path, text: str) -> Path:
    path = folder / "plant.toml"
    path.write_text(text)
    return path


def test_observations_are_of_values_or_of_deviations() -> None:
    x, y, u = PLANT.states[0], PLANT.states[1], PLANT.inputs[0]
    plant = System(
        "away", (x, y), (u,), {}, (y, u - 1), (Fraction(1),), ((-2, 2), (-2, 2)), ((-9, 9),), x_eq=(Fraction(1, 2), 0)
    )
    for observes, at in (("absolute", 0.5), ("deviation", 0.0)):
        found = import_state_dict(three(), plant, observing(observes=observes)).policy
        theta, speed = STATES.T
        o = np.stack([np.cos(theta + at), np.sin(theta + at), speed / 8], axis=1)
        assert np.allclose(found.network(STATES, (Fraction(1),)), by_hand(three(), o), atol=1e-13)


@pytest.mark.parametrize("parts", ["theta,cos(theta), max(theta,1)", " theta , cos( theta ),max(theta, 1)"])
def test_commas_in_brackets_part_nothing(parts: str) -> None:
    from certify.cli.importing import _parts

    assert [part.replace(" ", "") for part in _parts(parts)] == ["theta", "cos(theta)", "max(theta,1)"]
