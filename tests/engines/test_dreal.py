"""dReal as an engine: how its answers become verdicts, what is written, and what happens without it.

Most tests put a script in the place of the `dreal` binary or of single answers, so that they run everywhere.
"""

from __future__ import annotations

import importlib.util
import json
import stat
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from certify.obligations import Query

from certify.certificate import read_certificate
from certify.cli import _run
from certify.engines import dreal, dreal_proof
from certify.engines.dreal.backend import Answer, Backend, decide, find_backend
from certify.engines.dreal.proof import DrealOptions, prove_with_dreal
from certify.errors import BackendError, SoundnessError
from certify.policies import Policy, TanhNetwork, save_policy
from certify.report import render_html
from certify.roa import RoaOptions, certify_roa, run_checker
from certify.systems import System, get_system
from certify.verdict import Verdict
from tests.support.cases import case_of
from tests.support.certificates import encode
from tests.support.loops import pendulum_network, scalar_tanh

FAKE = Backend("binary", ("dreal",), "4.21-fake")


def binary(folder: Path, script: str) -> Backend:
    """A `dreal` made of shell."""
    path = folder / "dreal"
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(path.stat().st_mode | stat.S_IEXEC)
    return Backend("binary", (str(path),), "fake")


def answering(monkeypatch: pytest.MonkeyPatch, say: Callable[[Query, str], Answer]) -> list[str]:
    """Answers in the place of dReal's; returns the names of what was asked."""
    asked: list[str] = []

    def fake(backend: Backend, query: Query, precision: float, jobs: int, seconds: float) -> Answer:
        asked.append(query.name)
        return say(query, query.name)

    monkeypatch.setattr(dreal_proof, "decide", fake)
    monkeypatch.setattr(dreal, "find_backend", lambda: FAKE)
    return asked


def unsat(*_: object) -> Answer:
    return Answer("unsat", 0.1, "4.21-fake")


def level_of(query: Query) -> float:
    """c2 of a query, from its constraint on V."""
    from fractions import Fraction

    return float(next(Fraction(b) for a, relation, b in query.constraints if a == "V." and relation == "<="))


# The binary


@pytest.mark.parametrize(
    ("script", "status"),
    [
        ("echo unsat", "unsat"),
        ("echo 'delta-sat with delta = 0.001'; echo 'x : [1.5, 1.75]'", "delta-sat"),
        ("echo sat", "failed"),
        ("echo unsatisfactory", "failed"),
        ("echo", "failed"),
        ("true", "failed"),
        ("echo unsat; exit 1", "failed"),
        ("kill -9 $$", "failed"),
        ("sleep 30", "timeout"),
    ],
)
def test_only_a_clean_unsat_is_unsat(script: str, status: str, tmp_path: Path) -> None:
    case = case_of(*scalar_tanh())
    start = time.monotonic()
    answer = decide(binary(tmp_path, f"exec {script}" if script.startswith("sleep") else script),
                    query(ring_condition(0.5, 1.0), case.problem), 1e-3, 1, 1.0)  # fmt: skip
    assert answer.status == status
    assert time.monotonic() - start < 20  # the process does not live on
    if status == "delta-sat":
        assert dict(answer.box) == {"x": (1.5, 1.75)}


def test_the_binary_gets_the_query_the_precision_and_the_jobs(tmp_path: Path) -> None:
    case = case_of(*scalar_tanh())
    keep = tmp_path / "kept"
    backend = binary(tmp_path, f'for last; do :; done; echo "$@" > {keep}; cat "$last" >> {keep}; echo unsat')
    assert decide(backend, query(ring_condition(0.5, 1.0), case.problem), 1e-4, 3, 10.0).status == "unsat"
    text = keep.read_text()
    assert "--precision 0.0001" in text and "--jobs 3" in text
    assert "(declare-fun x () Real)" in text and "(check-sat)" in text


def test_without_dreal_the_message_says_what_to_get(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(BackendError, match=r"libibex\.so.*coinor-libclp1"):
        find_backend()
    binary(tmp_path, "echo v4.21.06.2")
    found = find_backend()
    assert (found.kind, found.version) == ("binary", "v4.21.06.2")


# From answers to levels


def test_levels_are_found_by_bisection(monkeypatch: pytest.MonkeyPatch) -> None:
    """dReal plays along up to V = 0.7 locally and V = 2.1 in the ring."""
    case = case_of(*scalar_tanh())

    def say(query: Query, name: str) -> Answer:
        bound = {"local": 0.7, "ring": 2.1}.get(name, np.inf)
        return unsat() if level_of(query) <= bound else Answer("timeout", 0.1, "")

    answering(monkeypatch, say)
    proof = prove_with_dreal(case, 1e-3, 3.0, FAKE, DrealOptions())
    assert proof.inner is not None and 0.7 / 1.06 < proof.inner <= 0.7
    assert proof.level is not None and 2.1 / 1.01 < proof.level <= 2.1
    assert proof.witness is None and proof.reason.startswith("solver")


@pytest.mark.parametrize("status", ["timeout", "failed", "delta-sat"])
def test_no_answer_is_no_proof(status: dreal.Status, monkeypatch: pytest.MonkeyPatch) -> None:
    answering(monkeypatch, lambda query, name: Answer(status, 0.1, ""))
    proof = prove_with_dreal(case_of(*scalar_tanh()), 1e-3, 3.0, FAKE, DrealOptions())
    assert proof.level is None and proof.inner is None


def test_delta_sat_caps_the_level_only_with_a_genuine_violation(monkeypatch: pytest.MonkeyPatch) -> None:
    """Truth is 1.915008: a box at 2.0 holds a violation, a box at 1.5 does not."""
    case = case_of(*scalar_tanh())
    for at, genuine in ((2.0, True), (1.5, False)):

        def say(query: Query, name: str, at: float = at) -> Answer:
            if name == "local":
                return unsat() if level_of(query) < 0.7 else Answer("timeout", 0.1, "")
            beyond = name == "ring" and level_of(query) > 1.9**2
            return Answer("delta-sat", 0.1, "", {"x": (at, at + 1e-6)}) if beyond else unsat()

        answering(monkeypatch, say)
        proof = prove_with_dreal(case, 1e-3, 2.5**2, FAKE, DrealOptions())
        assert proof.level is not None and proof.level <= 1.9**2
        assert (proof.witness is not None) is genuine
        assert proof.reason == "witness" if genuine else proof.reason.startswith("solver")


def test_inputs_are_confirmed_on_the_local_level_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without an answer about the inputs there is no level at all, though Vdot is confirmed everywhere."""
    case = case_of(get_system("pendulum"), pendulum_network(centre="output"))
    for confirmed in (False, True):

        def say(query: Query, name: str, confirmed: bool = confirmed) -> Answer:
            return unsat() if confirmed or not name.startswith("inputs") else Answer("timeout", 0.1, "")

        asked = answering(monkeypatch, say)
        proof = prove_with_dreal(case, 1e-3, 0.5, FAKE, DrealOptions())
        assert "inputs-u-below" in asked
        assert (proof.level == 0.5) if confirmed else (proof.level is None and proof.reason.startswith("inputs"))


def test_time_runs_out_for_all_queries_together(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = answering(monkeypatch, unsat)
    proof = prove_with_dreal(case_of(*scalar_tanh()), 1e-3, 3.0, FAKE, DrealOptions(seconds=0.0))
    assert proof.level is None and not asked


# Certificates


def test_what_dreal_confirms_is_written_as_trusted(
    pendulum: System, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    answering(monkeypatch, unsat)
    result = certify_roa(pendulum, pendulum_network(), tmp_path, RoaOptions(engine="dreal"))
    assert result.verdict is Verdict.PROVED and result.to_dict()["checked"] == "TRUSTED"
    assert result.to_dict()["engine"] == "dreal" and result.reason == "domain"
    assert result.solver is not None and {q["query"] for q in result.solver["queries"]} >= {"local"}
    assert result.certificate is not None
    answer = run_checker(result.certificate)
    assert answer["result"] == "TRUSTED" and answer["version"] == "4.21-fake"
    assert "leaves" not in answer and "ACCEPTED" not in json.dumps(answer)


@pytest.mark.parametrize(
    ("change", "rule"),
    [
        ({"lyapunov": {"P": None}}, "lyapunov"),
        ({"levels": {"roa": (1e6).hex()}}, "domain"),
        ({"levels": {"local": (0.0).hex()}}, "levels"),
        ({"plant": {"u_eq": ["1/2"]}}, "equilibrium"),
        ({"policy": {"sha256": "0" * 64}}, "hash"),
        ({"evidence": {"solver": "d Real"}}, "format"),
        ({"evidence": {"queries": [["ring", "unsat\nACCEPTED"]]}}, "format"),
        ({"evidence": {"queries": [["ring"]]}}, "format"),
        ({"evidence": {"kind": "trusted"}}, "format"),
        ({"evidence": {"tree": "/w=="}}, "format"),
    ],
)
def test_what_can_be_checked_is_checked(
    change: dict[str, dict[str, object]], rule: str, pendulum: System, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    answering(monkeypatch, unsat)
    certify_roa(pendulum, pendulum_network(), tmp_path, RoaOptions(engine="dreal"))
    path = tmp_path / "certificate.json"
    data = json.loads(path.read_text())
    for section, fields in change.items():
        for name, value in fields.items():
            data[section][name] = encode(-np.eye(2)) if value is None else value
    path.write_text(json.dumps(data))
    answer = run_checker(path)
    assert (answer["result"], answer["rule"]) == ("REJECTED", rule)


def test_a_level_that_dreal_does_not_reach_is_unknown(
    pendulum: System, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gives_up = Answer("timeout", 0.1, "")
    answering(monkeypatch, lambda q, name: unsat() if level_of(q) < 1 or name.startswith("domain") else gives_up)
    result = certify_roa(pendulum, pendulum_network(), tmp_path, RoaOptions(engine="dreal", level=2.0))
    assert result.verdict is Verdict.UNKNOWN and result.certificate is None
    assert not (tmp_path / "certificate.json").exists()


def test_missing_dreal_is_unknown_when_named_and_a_notice_when_not(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing() -> Backend:
        raise BackendError("dReal cannot be used: libibex.so is missing.")

    monkeypatch.setattr(dreal, "find_backend", missing)
    path = tmp_path / "policy.pt"
    save_policy(path, Policy(pendulum_network((8, 8)), "pendulum", {"m": "0.15"}))
    arguments = ["roa", "--policy", str(path), "--out", str(tmp_path / "o"), "--json"]
    assert _run([*arguments, "--engine", "dreal"], True) == 3
    assert "libibex.so is missing" in json.loads(capsys.readouterr().out)["reason"]
    monkeypatch.setenv("CERTIFY_ENGINE", "dreal")
    assert _run(arguments, True) == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["checked"] == "ACCEPTED" and "engine bounds in the place of dreal" in err
    monkeypatch.setenv("CERTIFY_ENGINE", "both")
    monkeypatch.delenv("CERTIFY_ENGINE")
    assert _run([*arguments, "--engine", "both"], True) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["checked"] == "ACCEPTED" and "libibex.so" in data["solver"]["missing"]


def test_both_engines_agree_or_say_so(pendulum: System, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = answering(monkeypatch, unsat)
    result = certify_roa(pendulum, pendulum_network(), tmp_path, RoaOptions(engine="both"))
    assert result.to_dict()["checked"] == "ACCEPTED" and {"local", "ring"} <= set(asked)
    assert result.solver is not None and all(q["answer"] == "unsat" for q in result.solver["queries"])
    assert result.certificate is not None
    page = render_html(read_certificate(result.certificate), result.checker, result.to_dict(), result.certificate)
    assert "4.21-fake on ring" in page and "PROVED · ACCEPTED" in page


def test_the_report_does_not_call_trusted_a_proof(
    pendulum: System, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    answering(monkeypatch, unsat)
    result = certify_roa(pendulum, pendulum_network((8, 8)), tmp_path, RoaOptions(engine="dreal"))
    assert result.certificate is not None
    page = render_html(read_certificate(result.certificate), result.checker, result.to_dict(), result.certificate)
    assert "TRUSTED" in page and "ACCEPTED" not in page.split("<h2>How to check")[0].split("</style>")[1]
    assert "the word of dreal 4.21-fake" in page


def test_a_contradiction_is_an_error_with_a_reproduction(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """dReal points at a state, and Arb is made to see a violation there."""
    system, network = scalar_tanh()
    answering(
        monkeypatch,
        lambda q, name: Answer("delta-sat", 0.1, "", {"x": (1.0, 1.0)}) if name == "ring" else unsat(),
    )
    assert certify_roa(system, network, tmp_path, RoaOptions(engine="both")).verdict is Verdict.PROVED
    monkeypatch.setattr(dreal_proof, "confirm", lambda case, witness: True)
    with pytest.raises(SoundnessError, match=r"contradiction\.json"):
        certify_roa(system, network, tmp_path, RoaOptions(engine="both"))
    stated = json.loads((tmp_path / "contradiction.json").read_text())
    assert float.fromhex(stated["witness"]["x"][0]) == 1.0


def test_export_writes_one_file_a_claim(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "policy.pt"
    save_policy(path, Policy(pendulum_network((6,)), "pendulum", {"m": "0.15"}))
    assert _run(["export-smt2", "--policy", str(path), "--out", str(tmp_path / "o"), "--json"], True) == 0
    files = [Path(f) for f in json.loads(capsys.readouterr().out)["files"]]
    assert {f.stem for f in files} >= {"local", "ring", "domain-theta-above"}
    for f in files:
        text = f.read_text()
        assert "; expected: unsat" in text and text.count("(") == text.count(")")


# The real one


@pytest.fixture
def real() -> Backend:
    try:
        return find_backend()
    except BackendError as error:
        pytest.skip(f"dReal is not here: {error}")


def test_real_dreal_on_the_scalar_plant(real: Backend, tmp_path: Path) -> None:
    """Levels below the truth are confirmed, a level beyond it is refuted with a witness in Arb."""
    system, network = scalar_tanh()
    truth = 1.915008**2
    found = certify_roa(system, network, tmp_path, RoaOptions(engine="dreal"))
    assert found.verdict is Verdict.PROVED and found.levels.roa is not None
    assert 0.95 * truth < found.levels.roa < truth
    beyond = certify_roa(system, network, tmp_path, RoaOptions(engine="dreal", level=2.2**2))
    assert beyond.verdict is Verdict.REFUTED


def test_real_dreal_on_the_pendulum(real: Backend, tmp_path: Path) -> None:
    network: TanhNetwork = pendulum_network((12,))
    options = RoaOptions(engine="dreal", level=0.5, time_limit=60)
    result = certify_roa(get_system("pendulum"), network, tmp_path, options)
    assert result.verdict is Verdict.PROVED and result.to_dict()["checked"] == "TRUSTED"
    case = case_of(get_system("pendulum"), network)
    assert decide(real, query(local_condition(1e-3), case.problem), 1e-3, 1, 60.0).status == "unsat"
    assert decide(real, query(ring_condition(0.01, 0.5), case.problem), 1e-3, 1, 60.0).solver_seconds is not None
