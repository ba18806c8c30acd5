"""Policies: exact numbers, centring, the file."""

from __future__ import annotations

import dataclasses
import inspect
import pickle
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from certify.errors import InputError
from certify.loop.policies import Policy, PolicyNetwork, load_policy, save_policy
from certify.loop.policies import file as policy_file
from tests.support import plain
from tests.support.loops import pendulum_network

U_EQ = (Fraction(1, 3),)


def network(centre: str = "preactivation", squash: str = "tanh") -> PolicyNetwork:
    base = pendulum_network((5, 4))
    return PolicyNetwork.of_layers(base.weights, base.biases, base.scale, np.array([0.25]), squash, centre)  # type: ignore[arg-type]


@pytest.mark.parametrize(("centre", "squash"), [("preactivation", "tanh"), ("output", "tanh"), ("output", "identity")])
def test_centring_moves_a_wrong_equilibrium_to_the_right_one(centre: str, squash: str) -> None:
    policy = network(centre, squash)
    raw = dataclasses.replace(policy, centre="none")
    assert abs(raw(np.zeros(2), U_EQ) - float(U_EQ[0])) > 1e-3
    np.testing.assert_allclose(policy(np.zeros(2), U_EQ), [float(U_EQ[0])], rtol=1e-14)
    x = np.random.default_rng(0).standard_normal((7, 2))
    np.testing.assert_allclose(policy(torch.tensor(x), U_EQ).numpy(), policy(x, U_EQ), rtol=1e-13, atol=1e-15)


@pytest.mark.parametrize(("centre", "squash"), [("preactivation", "tanh"), ("output", "tanh"), ("output", "identity")])
def test_jacobian_at_the_origin(centre: str, squash: str) -> None:
    policy = network(centre, squash)
    step = 1e-6 * np.eye(2)
    differences = (policy(step, U_EQ) - policy(-step, U_EQ)).T / 2e-6
    np.testing.assert_allclose(policy.jacobian_at_origin(U_EQ), differences, rtol=1e-7)


def test_preactivation_needs_u_eq_inside_the_range() -> None:
    with pytest.raises(InputError, match="strictly inside"):
        network()(np.zeros(2), (Fraction(25, 4),))


def test_file_round_trip_is_exact_and_repeatable(tmp_path: Path) -> None:
    policy = Policy(network(), "pendulum", {"m": "0.15"}, {"seed": 3, "A": [[1.0, 2.0]], "mass": "".join(["0.", "15"])})
    save_policy(tmp_path / "a.pt", policy)
    save_policy(tmp_path / "other name.pt", policy)
    assert (tmp_path / "a.pt").read_bytes() == (tmp_path / "other name.pt").read_bytes()
    read = load_policy(tmp_path / "a.pt")
    save_policy(tmp_path / "again.pt", read)
    assert (tmp_path / "again.pt").read_bytes() == (tmp_path / "a.pt").read_bytes()
    assert read.network.sha256() == policy.network.sha256()
    assert (read.system, read.parameters, read.training) == (policy.system, policy.parameters, policy.training)


def test_single_precision_means_what_it_says(tmp_path: Path) -> None:
    base = network()
    single = PolicyNetwork.of_layers(
        tuple(w.astype(np.float32) for w in base.weights), tuple(b.astype(np.float32) for b in base.biases),
        base.scale, base.offset,
    )  # fmt: skip
    save_policy(tmp_path / "a.pt", Policy(single, "pendulum"))
    stored = torch.load(tmp_path / "a.pt", weights_only=True)
    assert stored["weights"][0].dtype == torch.float32
    assert load_policy(tmp_path / "a.pt").network.sha256() == single.sha256()


def test_the_checker_computes_the_same_hash() -> None:
    ours = network("output")
    assert plain.policy(ours).sha256() == ours.sha256()


@pytest.mark.parametrize("change", ["weight", "bias", "scale", "offset", "centre", "squash"])
def test_the_hash_sees_every_part(change: str) -> None:
    base = network("output")
    names = inspect.signature(PolicyNetwork.of_layers).parameters
    parts: dict[str, Any] = {name: getattr(base, name) for name in names}
    match change:
        case "weight":
            parts["weights"] = (base.weights[0] * (1 + 2**-52), *base.weights[1:])
        case "bias":
            parts["biases"] = (*base.biases[:-1], base.biases[-1] + 1)
        case "centre":
            parts["centre"] = "none"
        case "squash":
            parts["squash"] = "identity"
        case _:
            parts[change] = parts[change] * 2
    assert PolicyNetwork.of_layers(**parts).sha256() != base.sha256()


class _Executes:
    def __reduce__(self) -> Any:
        return (Path("executed").touch, ())


def valid() -> dict[str, Any]:
    return {
        "format": "certify-policy/1",
        "activation": "tanh",
        "weights": [torch.ones(3, 2), torch.ones(1, 3)],
        "biases": [torch.zeros(3), torch.zeros(1)],
        "output": {"squash": "tanh", "scale": torch.ones(1), "offset": torch.zeros(1)},
        "centre": "output",
        "system": {"name": "pendulum", "parameters": {}},
        "training": {},
    }


def change(*path: Any, to: Any) -> dict[str, Any]:
    data: Any = valid()
    inner = data
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = to
    return dict(data)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (change("format", to="certify-policy/5"), "format"),
        (change("format", to="certify-policy/2"), "clip"),
        (change("activation", to="relu"), "`activation` of certify-policy/[12] must be one of tanh; found 'relu'"),
        (change("weights", 0, to=torch.ones(3, 2) * float("nan")), "finite"),
        (change("biases", 1, to=torch.tensor([float("inf")])), "finite"),
        (change("weights", 0, to=torch.ones(3, 2, dtype=torch.int64)), "float32 or float64"),
        (change("weights", 0, to=[[1.0, 2.0]]), "float32 or float64"),
        (change("weights", 1, to=torch.ones(1, 4)), "outputs of layer 0"),
        (change("biases", 0, to=torch.zeros(4)), "bias"),
        (change("weights", to=torch.ones(3)), "lists of tensors"),
        (change("weights", to=[torch.ones(3, 2)]), "as many weights as biases"),
        (change("output", "scale", to=torch.zeros(1)), "nonzero"),
        (change("output", "scale", to=torch.ones(2)), "shape"),
        (change("output", "squash", to="relu"), "squash"),
        (change("output", to=None), "output"),
        (change("centre", to="middle"), "centre"),
        (change("system", to="pendulum"), "system"),
        (change("extra", to=1), "unknown keys"),
        ([1, 2], "format"),
        (change("beta", to=torch.zeros(1)), "beta"),
    ],
)
def test_bad_files_are_refused_in_one_sentence(tmp_path: Path, data: Any, message: str) -> None:
    torch.save(data, tmp_path / "bad.pt")
    with pytest.raises(InputError, match=message):
        load_policy(tmp_path / "bad.pt")


def test_nothing_in_a_file_is_executed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    torch.save(change("training", to={"x": _Executes()}), tmp_path / "bad.pt")
    with pytest.raises(InputError, match="nothing in it was executed"):
        load_policy(tmp_path / "bad.pt")
    (tmp_path / "raw.pt").write_bytes(pickle.dumps(_Executes()))
    with pytest.raises(InputError):
        load_policy(tmp_path / "raw.pt")
    assert not (tmp_path / "executed").exists()


@pytest.mark.parametrize("content", [b"", b"garbage", b"PK\x03\x04 not a zip"])
def test_damaged_files(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "bad.pt").write_bytes(content)
    with pytest.raises(InputError):
        load_policy(tmp_path / "bad.pt")


def test_truncated_and_missing_files(tmp_path: Path) -> None:
    torch.save(valid(), tmp_path / "a.pt")
    content = (tmp_path / "a.pt").read_bytes()
    (tmp_path / "a.pt").write_bytes(content[: len(content) // 2])
    with pytest.raises(InputError):
        load_policy(tmp_path / "a.pt")
    with pytest.raises(InputError, match="cannot be read"):
        load_policy(tmp_path / "b.pt")
    with pytest.raises(InputError, match="cannot be read"):
        load_policy(tmp_path)


@pytest.mark.parametrize("weight", [np.ones((1, 2))[0, 0:1].reshape(()), np.ones(3)])
def test_a_weight_that_is_no_matrix_is_refused(weight: np.ndarray) -> None:
    data = {"format": "certify-policy/1", "activation": "tanh", "weights": [weight], "biases": [np.zeros(1)]}
    with pytest.raises(InputError, match="layer 0 must have a weight"):
        policy_file._read_layers(data)


def test_expressions_are_a_list() -> None:
    with pytest.raises(InputError, match="expressions` must be a text of expressions as lists"):
        policy_file._read_observation({"names": ["a"], "expressions": '{"a": 1}'}, "steps[0]")
