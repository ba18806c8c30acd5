"""The table of what is proved: only of this policy on this plant, and true of every run of a line."""

from __future__ import annotations

import importlib.util
import json
import sys
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from certify.analysis.api import certify_roa
from certify.certificates.claims import Practical
from certify.loop.plants import get_system
from certify.loop.policies import Policy, PolicyNetwork, save_policy

PENDULUM = get_system("pendulum")


@pytest.fixture
def page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The script, with a folder of results of its own."""
    path = Path(__file__).parents[2] / "docs" / "paper" / "proved.py"
    monkeypatch.syspath_prepend(str(path.parent))  # where Python looks when it runs a script
    spec = importlib.util.spec_from_file_location("proved_page", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["proved_page"] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    module.__dict__["OUT"] = tmp_path / "out"
    return module


def _law(gain: list[list[float]]) -> Policy:
    network = PolicyNetwork.of_layers((-np.array(gain),), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none")
    return Policy(network, "pendulum", {"m": "0.15", "l": "0.5", "b": "0.1", "g": "9.81"})


def _run(folder: Path, gain: list[list[float]]) -> Path:
    run = folder / "runs" / "ours" / "seed-0"
    run.mkdir(parents=True)
    save_policy(run / "policy.pt", _law(gain))
    return run


def test_a_certificate_that_is_there_counts_for_this_policy_on_this_plant_alone(
    page: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, out = _run(tmp_path, [[8.0, 2.0]]), tmp_path / "out" / "pendulum" / "ours" / "seed-0"
    result = certify_roa(PENDULUM, _law([[8.0, 2.0]]), out, candidate="lyapunov", effort=0.4)
    raw, searched = (out / "certificate.json").read_bytes(), list[list[str]]()
    refusal = json.dumps({"verdict": "UNKNOWN", "reason": "time"})

    def search(full: list[str], **_: object) -> SimpleNamespace:
        searched.append(full)
        return SimpleNamespace(returncode=3, stdout=refusal)

    monkeypatch.setattr(page, "subprocess", SimpleNamespace(run=search, PIPE=None))  # the checker needs the true one
    found = page.proved("pendulum", run)
    assert (found.claim, found.volume, found.radius) == ("asymptotic", result.volume, 0.0) and not searched
    smaller = PENDULUM.with_domain({"theta": (Fraction(-1), Fraction(1))})
    for plant in (smaller, replace(PENDULUM, input_bounds=((Fraction(-1), Fraction(1)),))):
        monkeypatch.setattr(page, "shipped_system", lambda _, plant=plant: plant)
        (out / "certificate.json").write_bytes(raw)
        assert page.proved("pendulum", run) is None
        assert searched.pop() and not (out / "certificate.json").exists()
        assert page.proved("pendulum", run) is None and not searched  # in vain, just so, before
    monkeypatch.setattr(page, "shipped_system", lambda _: PENDULUM)
    assert page.proved("pendulum", run) is None and searched.pop()  # another plant is another question
    monkeypatch.setitem(page.EFFORT, "pendulum", 1.3)
    assert page.proved("pendulum", run) is None and searched.pop()  # and so is another time
    (out / "certificate.json").write_bytes(raw)
    save_policy(run / "policy.pt", _law([[8.5, 2.0]]))
    assert page.proved("pendulum", run) is None and searched.pop()


def test_a_line_says_what_holds_for_each_of_its_runs(page: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    found = {"a": page.Proved("nearby", 196.99, 0.01), "b": page.Proved("practical", 20.99, 0.0551), "c": None}
    found["d"] = page.Proved("nearby", 197.0, 0.002)
    monkeypatch.setattr(page, "proved", lambda plant, folder: found[folder.name])
    line = page.row("pendulum", "sac", [Path(name) for name in found])
    assert "| 3 of 4 |" in line and line.endswith("| 20.9 | 0.056 |")
    assert "enters a small set and stays there" in line and "one equilibrium" in line


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e9])
def test_the_radius_is_not_below_any_state_s_norm(page: ModuleType, scale: float) -> None:
    generator = np.random.default_rng(0)
    for n in range(1, 7):
        root = generator.standard_normal((n, n)) * np.logspace(0, 2, n)
        P = scale * (root @ root.T)
        P = (P + P.T) / 2
        radius = page.largest_norm(P, 0.3)
        exact = np.array([[Fraction(v) for v in row] for row in P.tolist()], dtype=object)
        direction = np.linalg.eigh(P)[1][:, 0]
        x = np.array([Fraction(v) for v in direction.tolist()], dtype=object)
        square = Fraction(0.3) / (x @ exact @ x) * (x @ x)  # of the state on the set's edge in this direction
        assert square <= Fraction(radius) ** 2 <= square * (1 + Fraction(1, 10**3))


def test_a_matrix_whose_smallest_eigenvalue_is_not_certain_has_no_radius(page: ModuleType) -> None:
    assert page.largest_norm(np.diag([1.0, 1e-13]), 1.0) == np.inf


def test_the_radius_is_that_of_the_floor(page: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Not of the set from which it is reached, nor of the ring's inner level; and how far its middle is counts."""
    claim = Practical(roa=4.0, local=1.0, floor=0.25)
    network = SimpleNamespace(origin=np.zeros(2))
    certificate: Any = SimpleNamespace(claim=claim, kind=claim.kind, P=np.eye(2), roa=claim.roa, network=network)
    (tmp_path / "certificate.json").write_text("")
    monkeypatch.setattr(page, "proved_set", lambda _: None)
    monkeypatch.setattr(page, "require_same_question", lambda *_: None)
    monkeypatch.setattr(page, "read_certificate", lambda _: certificate)
    found = page.accepted(tmp_path / "certificate.json", _law([[8.0, 2.0]]), PENDULUM)
    assert 0.5 <= found.radius < 0.5 + 1e-8 and found.volume == pytest.approx(4 * np.pi)
    network.origin = np.array([3.0, -4.0])
    assert 5.5 <= page.accepted(tmp_path / "certificate.json", _law([[8.0, 2.0]]), PENDULUM).radius < 5.5 + 1e-7
