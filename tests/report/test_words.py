"""What a run says to a control engineer: values beside values, what is met where it is met, and what to type next."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from certify.analysis.diagnosis import diagnose
from certify.analysis.facts import Tried
from certify.analysis.options import RoaOptions
from certify.analysis.results import RoaResult
from certify.analysis.run import certify_roa
from certify.certificates import read_certificate
from certify.certificates.verdict import Stop
from certify.cli.main import _run
from certify.loop.plants import load_system
from certify.loop.policies import Policy, PolicyNetwork, load_policy, save_policy
from certify.report import summary
from certify.report.figures.portrait import keys
from certify.report.figures.scene import Scene
from certify.report.figures.trajectories import runs_from, starts
from tests.support.loops import pendulum_network

EXAMPLES = Path(__file__).parents[2] / "examples"
MAGLEV = EXAMPLES / "plants" / "maglev.toml"


def printed(result: RoaResult) -> str:
    """The summary on one line: where it wraps is nobody's concern."""
    console = Console(width=100)
    with console.capture() as captured:
        console.print(summary(result.to_dict()))
    return " ".join(captured.get().split())


def bent(system: str = "pendulum") -> Policy:
    """A policy that is all but linear, and whose hidden units bend in pairs that cancel: bounds see each of them."""
    K, s = np.array([[-8.0, -2.0]]), 1e-2
    first = np.vstack([s * K, [[3.0, 0.0]], [[3.0, 1e-9]]])
    last = np.array([[1 / s, 300.0, -300.0]])
    layers, biases = (first, last), (np.zeros(3), np.zeros(1))
    return Policy(PolicyNetwork.of_layers(layers, biases, np.ones(1), np.zeros(1), "identity", "none"), system, {})


@pytest.fixture(scope="module")
def beside(tmp_path_factory: pytest.TempPathFactory) -> RoaResult:
    """The levitated ball under a policy that is not centred: its loop rests half a millimetre below where it should."""
    stored = load_policy(EXAMPLES / "policies" / "maglev.pt").network
    off = stored.with_layers(centre="none", biases=(*stored.biases[:-1], stored.biases[-1] + 0.01))
    return certify_roa(load_system(MAGLEV), off, tmp_path_factory.mktemp("beside"), RoaOptions(effort=0.05))


def test_where_a_loop_rests_is_said_by_the_states_values(beside: RoaResult) -> None:
    """The operating point and the point of rest are one point, and are said to be."""
    data = beside.to_dict()
    assert beside.network.is_moved and beside.rest is not None
    (h, v), at = data["rest"]["values"], Fraction(data["operating_point"]["h"])
    assert (
        h == pytest.approx(0.01 + float(beside.rest.x[0]), abs=1e-12) == pytest.approx(float(at), abs=1e-9) and v == 0
    )
    text = printed(beside)
    assert re.search(rf"operating point h = {float(at)!r} m, v = 0 m/s, the loop's equilibrium; the set lies", text)
    assert re.search(rf"equilibrium h = {h:.9g} m, v = 0 m/s; eigenvalues there", text)
    around = certify_roa(
        load_system(MAGLEV), replace(beside.network, origin=np.zeros(2)), beside.certificate.parent / "o",  # type: ignore[union-attr]
        RoaOptions(effort=0.05, around="origin"),
    )  # fmt: skip
    said = printed(around)
    assert not around.network.is_moved and f"equilibrium h = {h:.9g} m" in said
    assert "operating point h = 0.01 m, v = 0 m/s; the set lies around it" in said


def test_a_side_of_the_domain_is_said_by_its_value(beside: RoaResult) -> None:
    text = printed(beside)
    assert beside.diagnosis is not None and beside.diagnosis.kind == "domain"
    assert re.search(
        r"namely the upper side of the domain in h, 0\.016 m \(0\.00\d+ m from the operating point\)", text
    )
    assert not any(word in text for word in ("hurts", "stiffness", "binds", "hardest along", "on its axis"))
    assert "modes all decay at" in text and "time constant" in text
    assert (
        "attracted by the origin" not in text and "others at rest, ±" in text and re.search(r"h − 0\.01\d* \(m\)", text)
    )


def test_a_limit_that_is_met_at_no_state_names_the_hardest(beside: RoaResult) -> None:
    late = replace(beside, stop=Stop.TIME)
    late = replace(late, diagnosis=diagnose(late, RoaOptions(), None))
    assert re.search(
        r"hardest along [hv](; then [hv], \d+ % as much, each measured by its domain)? try next", printed(late)
    )
    assert "namely" not in printed(late)


def test_candidates_of_one_name_are_told_apart(beside: RoaResult) -> None:
    rows = tuple(
        Tried(n, 1.0, "domain", v, v > 2, v / 2) for n, v in (("optimised", 2.0), ("lqr", 1.0), ("optimised", 3.0))
    )
    text = printed(replace(beside, tried=rows))
    assert "optimised, round 1: 1 of 2; lqr: 0.5 of 1; optimised, round 2: 1.5 of 3" in text
    assert beside.certificate is not None and beside.raw is not None
    page = replace(beside, tried=rows).report(beside.certificate.with_name("rounds.html")).read_text("utf-8")
    assert "<td>optimised, round 1</td>" in page and "<td>optimised, round 2</td>" in page


def test_a_set_that_cannot_be_seen_is_in_no_legend(beside: RoaResult) -> None:
    assert beside.certificate is not None and beside.levels.floor is not None and beside.levels.floor < 1e-8
    certificate = read_certificate(beside.certificate)
    scene = Scene(certificate, accepted=True)
    assert not any("inner set" in key.text for key in keys(scene, runs_from(scene, starts(scene)), None, False))
    page = beside.report().read_text("utf-8")
    assert "The inner set, V ≤ 1 × 10⁻¹⁰, is too small to be seen here; a picture below shows it." in page
    assert "All states are drawn as deviations from the operating point, h = 0.010" in page
    assert "the upper side of the domain in h, 0.016 m" in page and "had most to do" not in page
    large = replace(certificate, claim=replace(certificate.claim, floor=0.05, local=0.05))  # type: ignore[call-arg]
    seen = Scene(large, accepted=False)
    assert any("inner set" in key.text for key in keys(seen, runs_from(seen, starts(seen)), None, False))


@pytest.mark.slow
def test_flattening_is_suggested_where_bounds_see_bends_and_little_is_proved(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("certify.analysis.diagnosis._TELLING", 0)
    path, out = tmp_path / "bent.pt", tmp_path / "o"
    save_policy(path, bent())
    status = _run(["roa", str(path), "--max-boxes", "3", "--effort", "0.04", "--out", str(out), "--json"], True)
    following = json.loads(capsys.readouterr().out)["diagnosis"]["next"]
    flat = tmp_path / "bent_flat.pt"
    assert status in (0, 3) and following["flatten"] and following["options"] == {}
    assert following["command"] == (
        f"controllers flatten {path} --out {flat} && certify roa {flat} --effort 0.04 --max-boxes 3 --out {out} --json"
    )
    assert "a flatter policy that does the same" in following["why"]


def test_flattening_is_not_suggested_to_whom_it_cannot_help(tmp_path: Path) -> None:
    """A policy without bends, one without hidden units, much proved, a known pace."""
    result = certify_roa(
        load_system(EXAMPLES / "van_der_pol.toml"), bent().network, tmp_path, RoaOptions(max_boxes=3, effort=0.02)
    )
    little = tuple(replace(one, volume=1e6 * one.volume) for one in result.tried)
    short = replace(result, stop=Stop.BOXES, tried=little)
    assert diagnose(short, RoaOptions(), None).next.flattens
    assert not diagnose(replace(short, tried=()), RoaOptions(), None).next.flattens
    assert not diagnose(replace(short, stop=Stop.WITNESS), RoaOptions(), None).next.flattens
    K = np.array([[-8.0, -2.0]])
    linear = PolicyNetwork.of_layers((K,), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none")
    flat = PolicyNetwork.of_layers(
        (1e-3 * K, np.array([[1e3]])), (np.zeros(1),) * 2, np.ones(1), np.zeros(1), "identity", "none"
    )
    for network in (linear, flat):
        assert not diagnose(replace(short, network=network), RoaOptions(), None).next.flattens


@pytest.mark.slow
def test_a_policy_of_another_program_is_imported_before_it_is_flattened(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    import torch

    monkeypatch.setattr("certify.analysis.diagnosis._TELLING", 0)
    network, path, out = bent().network, tmp_path / "actor.pt", tmp_path / "o"
    state = {}
    for k, (W, b) in enumerate(zip(network.weights, network.biases, strict=True)):
        state |= {f"{2 * k}.weight": torch.tensor(W), f"{2 * k}.bias": torch.tensor(b)}
    torch.save(state, path)
    said = ["--system", "pendulum", "--states", "theta,theta_dot", "--activation", "tanh", "--squash", "identity"]
    said += ["--normaliser", "none", "--action-scale", "1", "--centre", "output"]
    more = ["--max-boxes", "3", "--effort", "0.04", "--out", str(out), "--json"]
    _run(["roa", str(path), *said, *more], True)
    printed_out = capsys.readouterr().out
    following = json.loads(printed_out)["diagnosis"]["next"]
    read, flat = tmp_path / "actor_imported.pt", tmp_path / "actor_flat.pt"
    first, second, third = following["command"].split(" && ")
    assert first.startswith(f"certify import {path} --system pendulum ") and first.endswith(f"--out {read}")
    assert all(f"{option} {value}" in first for option, value in zip(said[::2], said[1::2], strict=True))
    assert second == f"controllers flatten {read} --system pendulum --out {flat}"
    assert third.startswith(f"certify roa {flat} --system pendulum ") and "--states" not in third
    assert _run(first.split()[1:], False) == 0 and load_policy(read).network.layers == (2, 3, 1)


def test_bends_are_those_that_flattening_lowers() -> None:
    from certify.analysis.diagnosis import _bend
    from controllers.training.departure import departure_of

    box = np.array([1.0, 5.0])
    for network in (
        bent().network,
        pendulum_network((8, 8), centre="none"),
        pendulum_network((16, 16, 16), centre="none"),
    ):
        assert _bend(network, box) == pytest.approx(departure_of(network, box.tolist()), rel=1e-9)


def test_bounds_that_bound_nothing_are_not_shown() -> None:
    from certify.report.words import is_free

    assert is_free(Fraction(-(2**100)), Fraction(2**100)) and not is_free(Fraction(-(10**6)), Fraction(10**6))
