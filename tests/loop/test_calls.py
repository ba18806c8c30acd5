"""Networks that a plant's equations call: how they are read, and the loop that they make."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from certify import certify_roa
from certify.certificates.verdict import Verdict
from certify.errors import InputError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.composition import composed
from certify.loop.expressions import numerical
from certify.loop.plants import System, load_system
from certify.loop.policies import Policy, PolicyNetwork, save_policy

PLANT = """
name = "measured"
states = ["x", "v", "z"]
inputs = ["u"]
[parameters]
k = 2
[networks]
observer = {file = "observer.pt"}
pair = "pair.pt"
[where]
y = "x"
[dynamics]
x = "v"
v = "u - k*x + pair[1](z, observer(z, y, u))/100"
z = "observer(z, y, u) + pair[0](z - y/4, k*v)/100"
[u_eq]
u = 0
[domain]
x = [-1, 1]
v = [-1, 1]
z = [-1, 1]
[input_bounds]
u = [-3, 3]
"""


def network(reads: int, gives: int, seed: int) -> PolicyNetwork:
    generator = np.random.default_rng(seed)
    W, V = generator.normal(size=(4, reads)), generator.normal(size=(gives, 4)) / 4
    scale, offset = np.linspace(0.5, 1.5, gives), np.linspace(-0.1, 0.1, gives)
    return PolicyNetwork.of_layers((W, V), (W[:, 0] / 3, V[:, 0]), scale, offset, "tanh", "none")


OBSERVER, PAIR = network(3, 1, 1), network(2, 2, 2)


def plant(folder: Path, text: str = PLANT) -> System:
    save_policy(folder / "observer.pt", Policy(OBSERVER, "none"))
    save_policy(folder / "pair.pt", Policy(PAIR, "none"))
    (folder / "plant.toml").write_text(text)
    return load_system(folder / "plant.toml")


def law(centre: str = "preactivation") -> PolicyNetwork:
    weights = np.array([[0.5, -1.5, 0.0], [0.1, 0.2, 0.3]]), np.array([[1.0, 0.2]])
    biases = np.array([0.1, 0.3]), np.array([0.2])
    return PolicyNetwork.of_layers(weights, biases, np.array([3.0]), np.zeros(1), "tanh", centre)  # type: ignore[arg-type]


def by_hand(x: np.ndarray, policy: PolicyNetwork) -> tuple[np.ndarray, np.ndarray]:
    """F and u at states (k, 3), from the equations as they stand."""
    u = policy(x, (Fraction(0),))
    position, v, z = x.T
    seen = OBSERVER(np.column_stack([z, position, u[:, 0]]), (Fraction(0),))[:, 0]
    of_v = PAIR(np.column_stack([z, seen]), (Fraction(0),) * 2)[:, 1]
    of_z = PAIR(np.column_stack([z - position / 4, 2 * v]), (Fraction(0),) * 2)[:, 0]
    return np.column_stack([v, u[:, 0] - 2 * position + of_v / 100, seen + of_z / 100]), u


@pytest.mark.parametrize("centre", ["none", "preactivation"])
def test_the_loop_is_what_the_equations_say(centre: str, tmp_path: Path) -> None:
    system, policy = composed(plant(tmp_path), law(centre))
    assert (system.n, system.m, system.calls) == (3, 4, ())
    assert [s.name for s in system.inputs] == ["u", "observer_0", "pair_1", "pair_at2_0"]
    loop = ClosedLoop(system, policy)
    x = np.random.default_rng(0).uniform(-1, 1, (200, 3))
    wanted, u = by_hand(x, law(centre))
    inputs = loop.policy(x)
    assert np.allclose(system.function()(x, inputs), wanted, atol=1e-14) and np.allclose(inputs[:, :1], u, atol=1e-14)
    assert policy.centre == ("none" if centre == "none" else "output")
    lo, hi = policy.clip or ((), ())
    assert (lo[0], hi[0]) == (-3.0, 3.0) and hi[1] > 1e30


def test_arguments_are_deviations_where_the_operating_point_is_not_0(tmp_path: Path) -> None:
    """The network reads values; the system's states are deviations."""
    text = PLANT.replace("[u_eq]\nu = 0", "[x_eq]\nx = 0.25\n[u_eq]\nu = 0.5")
    text = text.replace('z = "observer(z, y, u) + pair[0](z - y/4, k*v)/100"', 'z = "observer(z, y, u)"')
    text = text.replace("pair[1](z, observer(z, y, u))/100", "0*pair[1](z, y)")
    free = text.replace("[x_eq]\nx = 0.25\n", "")
    calls = plant(tmp_path, free.replace("x = [-1, 1]", "x = [-1, 2]")).calls
    found = numerical(calls[0].arguments, plant(tmp_path, free).states + plant(tmp_path, free).inputs)(
        1.0, 2.0, 3.0, 4.0
    )
    assert found == (3.0, 1.0, 4.0)


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("pair[1](z,", "pair[2](z,", "gives 2 numbers, from 0 on; there is no 2"),
        ("pair[1](z,", "pair(z,", "write which, as in pair"),
        ("observer(z, y, u) + ", "observer(z, y) + ", "reads 3 numbers; found 2 arguments"),
        ("observer(z, y, u) + ", "observer() + ", "must have arguments"),
        ("observer(z, y, u) + ", "observers(z, y, u) + ", "observers"),
        ('"pair.pt"', '"other.pt"', "cannot be read"),
        ('"pair.pt"', "3", "must be the path of a file"),
        ('{file = "observer.pt"}', '{file = "observer.pt", colour = 1}', "must be the path of a file, or a table of"),
        ("observer = {", "sin = {", "must be a new name"),
        ('[parameters]', '[parameters]\nobserver_0 = 1', "observer_0 is that of a result"),
    ],
)  # fmt: skip
def test_what_is_no_call_is_refused(before: str, after: str, message: str, tmp_path: Path) -> None:
    assert before in PLANT
    with pytest.raises(InputError, match=message):
        composed(plant(tmp_path, PLANT.replace(before, after)), law())


def test_what_is_uncertain_is_no_argument(tmp_path: Path) -> None:
    """Else another loop would be proved: the nominal value would stand there."""
    uncertain = plant(tmp_path).with_ranges({"k": (Fraction(1), Fraction(3))})
    with pytest.raises(InputError, match=r"must not depend on what is uncertain.*on k"):
        composed(uncertain, law())


def test_a_network_that_is_centred_is_refused(tmp_path: Path) -> None:
    plant(tmp_path)
    save_policy(tmp_path / "pair.pt", Policy(PolicyNetwork.of_layers(
        PAIR.weights, PAIR.biases, PAIR.scale, PAIR.offset, "tanh", "output"), "none"))  # fmt: skip
    with pytest.raises(InputError, match="must be without a centring"):
        composed(load_system(tmp_path / "plant.toml"), law())


def test_a_loop_with_an_observer_is_proved_and_one_with_a_wrong_observer_is_not(tmp_path: Path) -> None:
    """x' = z + u/2 - x, z a filter of x that a network makes."""
    text = """
name = "filtered"
states = ["x", "z"]
inputs = ["u"]
[networks]
filter = {file = "filter.pt", rest = [0]}
[dynamics]
x = "x/2 + u"
z = "filter[0](x, z)"
[u_eq]
u = 0
[domain]
x = [-1, 1]
z = [-1, 1]
[input_bounds]
u = [-3, 3]
"""
    (tmp_path / "plant.toml").write_text(text)
    gain = PolicyNetwork.of_layers((np.array([[0.0, -0.9]]),), (np.zeros(1),), [3.0], [0.0], "tanh", "preactivation")
    for sign, wanted in ((1.0, Verdict.PROVED), (-1.0, Verdict.REFUTED)):
        W, V = np.array([[0.5, 0.0], [0.0, 0.4]]), sign * np.array([[20.0, -25.0]])
        net = PolicyNetwork.of_layers((W, V), (np.array([0.1, 0.0]), np.zeros(1)), [1.0], [0.0], "identity", "none")
        save_policy(tmp_path / "filter.pt", Policy(net, "none"))
        result = certify_roa(tmp_path / "plant.toml", gain, tmp_path / "out", candidate="ellipsoid")
        assert (result.verdict is Verdict.PROVED) == (wanted is Verdict.PROVED)
        if wanted is Verdict.PROVED:
            assert result.claim == "asymptotic" and [s.name for s in result.system.inputs] == ["u", "filter_0"]


def test_results_are_not_held_with_the_inputs(tmp_path: Path) -> None:
    """A larger plant would hold them: the claim would be about another loop."""
    held = plant(tmp_path).with_sample((Fraction(1, 50), Fraction(1, 50)))
    with pytest.raises(InputError, match=r"call observer, pair, whose results move within a period"):
        composed(held, law())
    with pytest.raises(InputError, match=r"Leave `sample_time` out"):
        certify_roa(tmp_path / "plant.toml", law(), tmp_path / "out", sample_time="0.02")
