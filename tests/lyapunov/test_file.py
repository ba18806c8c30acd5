"""The Lyapunov file: exact, repeatable, and nothing in it executed."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from certify.errors import InputError
from certify.loop.policies import load_policy
from certify.lyapunov import Neural, Polynomial, Quadratic, load_lyapunov, save_lyapunov
from tests.lyapunov.test_functions import neural, polynomial


def double(N: Neural) -> Neural:
    """One that single precision does not hold."""
    return Neural(tuple(w / 3 for w in N.weights), N.biases)


FUNCTIONS: dict[str, Neural | Polynomial] = {
    "single": neural()[0],
    "double": double(neural()[0]),
    "large": Neural((np.full((1, 2), 1e300),), (np.zeros(1),)),
    "polynomial": polynomial(),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_round_trip_is_exact_and_repeatable(name: str, tmp_path: Path) -> None:
    function = FUNCTIONS[name]
    given = ("pendulum", {"m": "0.15"}, {"seed": 3, "mass": "".join(["0.", "15"])})
    save_lyapunov(tmp_path / "a.pt", function, *given)
    save_lyapunov(tmp_path / "other name.pt", function, *given)
    read = load_lyapunov(tmp_path / "a.pt")
    save_lyapunov(tmp_path / "again.pt", read.function, read.system, read.parameters, read.training)
    raw = (tmp_path / "a.pt").read_bytes()
    assert raw == (tmp_path / "other name.pt").read_bytes() == (tmp_path / "again.pt").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.pt", "again.pt", "other name.pt"]
    assert (read.system, read.parameters, read.training) == given
    if isinstance(function, Neural):
        found = read.function
        assert isinstance(found, Neural)
        for ours, theirs in zip((*function.weights, *function.biases), (*found.weights, *found.biases), strict=True):
            assert np.array_equal(ours, theirs)
        stored = torch.load(tmp_path / "a.pt", weights_only=True)["weights"][0].dtype
        assert stored == (torch.float32 if name == "single" else torch.float64)


def test_the_order_of_terms_is_no_part_of_a_polynomial(tmp_path: Path) -> None:
    p = polynomial()
    for k, order in enumerate((slice(None), np.random.default_rng(0).permutation(len(p.coefficients)))):
        save_lyapunov(tmp_path / f"{k}.pt", Polynomial(p.exponents[order], p.coefficients[order]), "chain")
    assert (tmp_path / "0.pt").read_bytes() == (tmp_path / "1.pt").read_bytes()
    read = load_lyapunov(tmp_path / "1.pt").function
    x = np.array([0.3, -1.1, 0.7])
    assert isinstance(read, Polynomial) and read.exactly(x) == p.exactly(x)


@pytest.mark.parametrize("change", ["weight", "bias", "coefficient", "exponent", "system", "parameters"])
def test_the_bytes_show_every_change(change: str, tmp_path: Path) -> None:
    N, p = neural()[0], Polynomial(np.array([[2, 0], [0, 2]]), np.ones(2))
    save_lyapunov(tmp_path / "N.pt", N, "chain", {"k": "2"})
    save_lyapunov(tmp_path / "p.pt", p, "chain", {"k": "2"})
    other: Neural | Polynomial = N
    system, parameters = "chain", {"k": "2"}
    match change:
        case "weight":
            other = Neural((N.weights[0] * (1 + 2**-52), *N.weights[1:]), N.biases)
        case "bias":
            other = Neural(N.weights, (*N.biases[:-1], N.biases[-1] + 1))
        case "coefficient":
            other = Polynomial(p.exponents, np.array([1.0, 2.0]))
        case "exponent":
            other = Polynomial(np.array([[2, 0], [0, 4]]), p.coefficients)
        case "system":
            system = "pendulum"
        case _:
            parameters = {"k": "3"}
    save_lyapunov(tmp_path / "other.pt", other, system, parameters)
    first = "p.pt" if isinstance(other, Polynomial) else "N.pt"
    assert (tmp_path / "other.pt").read_bytes() != (tmp_path / first).read_bytes()


class _Executes:
    def __reduce__(self) -> Any:
        return (Path("executed").touch, ())


def network() -> dict[str, Any]:
    return {
        "format": "certify-lyapunov/1",
        "kind": "network",
        "activation": "tanh",
        "weights": [torch.ones(3, 2), torch.ones(1, 3)],
        "biases": [torch.zeros(3), torch.zeros(1)],
        "system": {"name": "pendulum", "parameters": {}},
        "training": {},
    }


def terms() -> dict[str, Any]:
    return {
        "format": "certify-lyapunov/1",
        "kind": "polynomial",
        "exponents": torch.tensor([[2, 0], [0, 2]]),
        "coefficients": torch.ones(2),
        "system": {"name": "pendulum", "parameters": {}},
    }


def change(data: dict[str, Any], key: str, to: Any) -> dict[str, Any]:
    changed = copy.copy(data)
    changed[key] = to
    return changed


def test_the_files_that_are_changed_below_are_read(tmp_path: Path) -> None:
    for data in (network(), terms()):
        torch.save(data, tmp_path / "good.pt")
        assert load_lyapunov(tmp_path / "good.pt").function.n == 2


REFUSED: dict[str, tuple[Any, str]] = {
    "no dictionary": ([1, 2], "`format` must be"),
    "another format": (change(network(), "format", "certify-lyapunov/2"), "found 'certify-lyapunov/2'"),
    "a policy": (change(network(), "format", "certify-policy/1"), "found 'certify-policy/1'"),
    "another kind": (change(network(), "kind", "quadratic"), "one of network, polynomial; found 'quadratic'"),
    "a kind that is no text": (change(network(), "kind", [1]), "one of network, polynomial"),
    "another activation": (change(network(), "activation", "relu"), "Only tanh"),
    "a key more": (change(network(), "level", 1.0), r"unknown keys \['level'\]"),
    "keys of the other kind": (change(terms(), "weights", []), r"unknown keys \['weights'\]"),
    "a key less": ({k: v for k, v in terms().items() if k != "exponents"}, r"missing keys \['exponents'\]"),
    "two outputs": (change(change(network(), "weights", [torch.ones(2, 2)]), "biases", [torch.ones(2)]), "one output"),
    "no lists": (change(network(), "weights", torch.ones(3)), "lists of tensors"),
    "integers": (change(network(), "biases", [torch.zeros(3, dtype=torch.int64), torch.zeros(1)]), "float32 or"),
    "nan": (change(network(), "biases", [torch.zeros(3), torch.tensor([float("nan")])]), "finite"),
    "sparse": (change(network(), "weights", [torch.ones(3, 2).to_sparse(), torch.ones(1, 3)]), "dense"),
    "real exponents": (change(terms(), "exponents", torch.ones(2, 2)), "int64 tensor; found float32"),
    "listed exponents": (change(terms(), "exponents", [[2, 0], [0, 2]]), "int64 tensor; found list"),
    "negative exponents": (change(terms(), "exponents", torch.tensor([[2, 0], [0, -2]])), "between 0 and 12"),
    "a term twice": (change(terms(), "exponents", torch.tensor([[2, 0], [2, 0]])), "twice"),
    "integer coefficients": (change(terms(), "coefficients", torch.tensor([1, 2])), "float32 or float64"),
    "infinite coefficients": (change(terms(), "coefficients", torch.tensor([1.0, float("inf")])), "finite"),
    "a plant's name alone": (change(terms(), "system", "pendulum"), "`system` must be"),
    "parameters": (change(terms(), "system", {"name": "pendulum", "parameters": [1]}), "must be dictionaries"),
    "training": (change(terms(), "training", 3), "must be dictionaries"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_bad_files_are_refused_in_one_sentence(name: str, tmp_path: Path) -> None:
    data, message = REFUSED[name]
    torch.save(data, tmp_path / "bad.pt")
    with pytest.raises(InputError, match=f"Lyapunov file .*bad.pt.*{message}"):
        load_lyapunov(tmp_path / "bad.pt")


def test_nothing_in_a_file_is_executed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    torch.save(change(network(), "training", {"x": _Executes()}), tmp_path / "bad.pt")
    with pytest.raises(InputError, match="nothing in it was executed"):
        load_lyapunov(tmp_path / "bad.pt")
    assert not (tmp_path / "executed").exists()


def test_files_that_are_none(tmp_path: Path) -> None:
    save_lyapunov(tmp_path / "a.pt", polynomial(), "chain")
    raw = (tmp_path / "a.pt").read_bytes()
    for content in (b"", b"garbage", raw[: len(raw) // 2]):
        (tmp_path / "bad.pt").write_bytes(content)
        with pytest.raises(InputError, match="Lyapunov file"):
            load_lyapunov(tmp_path / "bad.pt")
    with pytest.raises(InputError, match="cannot be read"):
        load_lyapunov(tmp_path / "missing.pt")
    with pytest.raises(InputError, match="cannot be written"):
        save_lyapunov(tmp_path / "missing" / "a.pt", polynomial(), "chain")


def test_it_is_no_policy_file_and_holds_no_quadratic_function(tmp_path: Path) -> None:
    save_lyapunov(tmp_path / "a.pt", neural()[0], "chain")
    with pytest.raises(InputError, match="found 'certify-lyapunov/1'"):
        load_policy(tmp_path / "a.pt")
    with pytest.raises(InputError, match="a Neural or a Polynomial; found Quadratic"):
        save_lyapunov(tmp_path / "b.pt", Quadratic(np.eye(2)), "chain")  # type: ignore[arg-type]
    assert not (tmp_path / "b.pt").exists()
