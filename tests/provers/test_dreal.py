"""dReal as an engine: how its answers become verdicts, what is written, and what happens without it.

Most tests use a script instead of the `dreal` binary or of single answers, so that they run everywhere.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import shutil
import stat
import subprocess
import sys
import time
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from certify.analysis.run import RoaOptions, certify_roa
from certify.certificates import read_certificate, run_checker
from certify.certificates.claims import Practical, Problem
from certify.certificates.claims.conditions import local_condition, ring_condition
from certify.certificates.claims.queries import Query, query
from certify.certificates.verdict import Stop, Verdict
from certify.cli.main import _run
from certify.effort import UNIT, Effort
from certify.errors import BackendError, InputError, SoundnessError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import Number, symbols
from certify.loop.plants import System, get_system
from certify.loop.policies import Policy, PolicyNetwork, save_policy
from certify.lyapunov.function import Quadratic
from certify.provers.base import Budget, Proof, Task
from certify.provers.dreal import backend as dreal
from certify.provers.dreal import proof as dreal_proof
from certify.provers.dreal.backend import Answer, Backend, decide, find_backend
from certify.provers.dreal.proof import DrealEngine, DrealOptions, confirm_with_dreal
from certify.provers.falsify import Witness, confirm
from certify.report import render_html
from tests.support.cases import Case, case_of
from tests.support.certificates import encode
from tests.support.loops import box, pendulum_network, scalar_tanh

FAKE = Backend("binary", ("dreal",), "4.21-fake")


def binary(folder: Path, script: str) -> Backend:
    """A `dreal` made of shell."""
    path = folder / "dreal"
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(path.stat().st_mode | stat.S_IEXEC)
    return Backend("binary", (str(path),), "fake")


def answering(monkeypatch: pytest.MonkeyPatch, say: Callable[[Query, str], Answer]) -> list[str]:
    """Give answers instead of dReal; return the names of the queries."""
    asked: list[str] = []

    def fake(backend: Backend, query: Query, precision: float, jobs: int, seconds: float) -> Answer:
        asked.append(query.name)
        return say(query, query.name)

    monkeypatch.setattr(dreal_proof, "decide", fake)
    monkeypatch.setattr(dreal, "find_backend", lambda: FAKE)
    monkeypatch.setattr(dreal_proof, "find_backend", lambda: FAKE)
    return asked


def attempt(monkeypatch: pytest.MonkeyPatch, case: Case, guess: float, target: float, seconds: float = 600.0) -> Proof:
    """The engine's proof, where the local level is looked for from `guess` on."""
    monkeypatch.setattr(dreal_proof, "prove_local", lambda *_: guess / 16)
    return DrealEngine(case.T, 1e-3, 1).prove(Task(case.problem, "asymptotic", target), Budget(Effort(seconds * UNIT)))


def unsat(*_: object) -> Answer:
    return Answer("unsat", 0.1, "4.21-fake")


def without_dreal(folder: Path) -> Path:
    """A Python that finds no module `dreal`."""
    path = folder / "python"
    path.write_text("#!/bin/sh\necho \"ModuleNotFoundError: No module named 'dreal'\" >&2; exit 1\n")
    path.chmod(path.stat().st_mode | stat.S_IEXEC)
    return path


def level_of(query: Query) -> float:
    """c2 of a query, from its constraint on V."""
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
    solver = binary(tmp_path, f"exec {script}" if script.startswith("sleep") else script)
    answer = decide(solver, query(ring_condition(0.5, 1.0), case.problem), 1e-3, 1, 1.0)
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
    monkeypatch.setattr(sys, "executable", str(without_dreal(tmp_path)))
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
    proof = attempt(monkeypatch, case, 1e-3, 3.0)
    assert 0.7 / 1.06 < proof.partial["local"] <= 0.7 and 2.1 / 1.01 < proof.partial["roa"] <= 2.1
    assert proof.claim is not None and dict(proof.claim.levels) == proof.partial
    assert proof.witness is None and proof.stop is Stop.SOLVER


@pytest.mark.parametrize("status", ["timeout", "failed", "delta-sat"])
def test_no_answer_is_no_proof(status: dreal.Status, monkeypatch: pytest.MonkeyPatch) -> None:
    answering(monkeypatch, lambda query, name: Answer(status, 0.1, ""))
    proof = attempt(monkeypatch, case_of(*scalar_tanh()), 1e-3, 3.0)
    assert proof.claim is None and not proof.partial and proof.stop is Stop.LOCAL


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
        proof = attempt(monkeypatch, case, 1e-3, 2.5**2)
        assert proof.claim is not None and proof.claim.roa <= 1.9**2
        assert (proof.witness is not None) is genuine
        assert proof.stop is (Stop.WITNESS if genuine else Stop.SOLVER)


def test_inputs_are_confirmed_on_the_local_level_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without an answer about the inputs there is no level at all, though Vdot is confirmed everywhere."""
    case = case_of(get_system("pendulum"), pendulum_network(centre="output"))
    for confirmed in (False, True):

        def say(query: Query, name: str, confirmed: bool = confirmed) -> Answer:
            return unsat() if confirmed or not name.startswith("inputs") else Answer("timeout", 0.1, "")

        asked = answering(monkeypatch, say)
        proof = attempt(monkeypatch, case, 1e-3, 0.5)
        assert "inputs-u-below" in asked
        assert proof.stop is (Stop.REQUESTED if confirmed else Stop.INPUTS)
        assert proof.partial.get("roa") == (0.5 if confirmed else None)


def test_time_runs_out_for_all_queries_together(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = answering(monkeypatch, unsat)
    proof = attempt(monkeypatch, case_of(*scalar_tanh()), 1e-3, 3.0, seconds=0.0)
    assert proof.claim is None and not asked and proof.stop is Stop.TIME


# Certificates


def test_what_dreal_confirms_is_written_as_trusted(
    pendulum: System, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    answering(monkeypatch, unsat)
    result = certify_roa(pendulum, pendulum_network(), tmp_path, RoaOptions(engine="dreal", candidate="lyapunov"))
    assert result.verdict is Verdict.TRUSTED and result.to_dict()["checked"] == "TRUSTED"
    assert result.to_dict()["engine"] == "dreal" and result.reason == "domain"
    assert result.solver is not None and {q["query"] for q in result.solver["queries"]} >= {"local"}
    assert result.certificate is not None
    answer = run_checker(result.certificate)
    assert answer["result"] == "TRUSTED" and answer["version"] == "4.21-fake"
    assert "leaves" not in answer and "ACCEPTED" not in json.dumps(answer)


@pytest.fixture(scope="module")
def trusted(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A certificate that a solver's word stands for."""
    out = tmp_path_factory.mktemp("trusted")
    with pytest.MonkeyPatch.context() as monkeypatch:
        answering(monkeypatch, unsat)
        options = RoaOptions(engine="dreal", candidate="lyapunov")
        certify_roa(get_system("pendulum"), pendulum_network(), out, options)
    return (out / "certificate.json").read_bytes()


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
    change: dict[str, dict[str, object]], rule: str, trusted: bytes, tmp_path: Path
) -> None:
    path = tmp_path / "certificate.json"
    data = json.loads(trusted)
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
    monkeypatch.setattr(dreal_proof, "find_backend", missing)
    path = tmp_path / "policy.pt"
    save_policy(path, Policy(pendulum_network((8, 8)), "pendulum", {"m": "0.15"}))
    arguments = ["roa", "--policy", str(path), "--out", str(tmp_path / "o"), "--effort", "0.2", "--json"]
    assert _run([*arguments, "--engine", "dreal"], True) == 3
    assert "libibex.so is missing" in json.loads(capsys.readouterr().out)["reason"]
    monkeypatch.setenv("CERTIFY_ENGINE", "dreal")
    assert _run(arguments, True) == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["checked"] == "ACCEPTED" and "engine bounds instead of dreal" in err
    monkeypatch.setenv("CERTIFY_ENGINE", "both")
    monkeypatch.delenv("CERTIFY_ENGINE")
    assert _run([*arguments, "--engine", "both"], True) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["checked"] == "ACCEPTED" and "libibex.so" in data["solver"]["missing"]


def test_both_engines_agree_or_say_so(pendulum: System, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = answering(monkeypatch, unsat)
    result = certify_roa(
        pendulum, pendulum_network(), tmp_path, RoaOptions(engine="both", candidate="lyapunov", effort=0.2)
    )
    assert result.to_dict()["checked"] == "ACCEPTED" and {"local", "ring"} <= set(asked)
    assert result.solver is not None and all(q["answer"] == "unsat" for q in result.solver["queries"])
    assert result.certificate is not None
    page = render_html(read_certificate(result.certificate), result.checker, result.to_dict(), result.certificate)
    assert "4.21-fake on ring" in page and "PROVED · ACCEPTED" in page


def test_the_report_does_not_call_trusted_a_proof(
    pendulum: System, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    answering(monkeypatch, unsat)
    result = certify_roa(pendulum, pendulum_network((8, 8)), tmp_path, RoaOptions(engine="dreal", candidate="lyapunov"))
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
    assert (
        certify_roa(system, network, tmp_path, RoaOptions(engine="both", candidate="lyapunov")).verdict
        is Verdict.PROVED
    )
    monkeypatch.setattr(dreal_proof, "confirm", lambda case, witness: True)
    with pytest.raises(SoundnessError, match=r"contradiction\.json"):
        certify_roa(system, network, tmp_path, RoaOptions(engine="both", candidate="lyapunov"))
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


# What stops a level


def test_a_guess_far_below_the_target_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = answering(monkeypatch, unsat)
    proof = attempt(monkeypatch, case_of(*scalar_tanh()), 1e-14 * 3.0, 3.0)
    assert asked[0] == "local" and proof.stop is Stop.REQUESTED
    assert proof.claim is not None and proof.claim.roa == 3.0


def test_the_margin_to_the_domain_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """A set that touches the domain is delta-sat; the level is lowered, and the reason says by what."""
    touches = Answer("delta-sat", 0.1, "", {"x": (2.99, 3.0)})
    answering(monkeypatch, lambda q, name: touches if name.startswith("domain") else unsat())
    proof = attempt(monkeypatch, case_of(*scalar_tanh()), 0.1, 8.99)
    assert proof.claim is not None and 0.99 * 8.99 < proof.claim.roa < 8.99
    assert proof.stop is Stop.MARGIN and "0.996" in proof.detail


def test_another_claim_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Practical stability needs a smooth F inside the floor, of which no query speaks."""
    asked = answering(monkeypatch, unsat)
    case = case_of(*scalar_tanh())
    with pytest.raises(InputError, match=r"asymptotic only, not practical\. Use engine bounds"):
        DrealEngine(case.T, 1e-3, 1).prove(Task(case.problem, "practical", 1.0), Budget())
    assert not asked


def test_a_delta_sat_is_said_to_touch_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    touches = Answer("delta-sat", 0.1, "", {"x": (1.0, 1.0)})
    answering(monkeypatch, lambda q, name: touches if name == "ring" else unsat())
    result = certify_roa(*scalar_tanh(), tmp_path, RoaOptions(engine="both", candidate="lyapunov"))
    assert result.verdict is Verdict.PROVED and result.solver is not None
    (ring,) = (row for row in result.solver["queries"] if row["query"] == "ring")
    assert ring["answer"] == "delta-sat" and "no violation was shown" in ring["meaning"]


# The process


def test_a_module_of_the_same_name_in_the_folder_is_never_imported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    marker = tmp_path / "imported"
    for name in ("dreal.py", "json.py", "fractions.py"):
        (tmp_path / name).write_text(f"open({str(marker)!r}, 'w').close()\n__version__ = 'planted'\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setenv("PATH", "")
    with contextlib.suppress(BackendError):
        assert find_backend().version != "planted"
    child = Backend("module", (sys.executable, "-I", str(Path(dreal.__file__).with_name("child.py"))), "")
    decide(child, query(ring_condition(0.5, 1.0), case_of(*scalar_tanh()).problem), 1e-3, 1, 30.0)
    assert not marker.exists()


def test_the_child_refuses_a_number_that_binary64_does_not_hold(tmp_path: Path) -> None:
    """A stand-in for the module tells what reached it."""
    (tmp_path / "dreal.py").write_text("class Config: pass\nclass Context: pass\nExpression = float\n")
    child = Path(dreal.__file__).with_name("child.py")
    stated = {"variables": [], "definitions": [["t.0", "3/20"]], "constraints": [], "precision": 1e-3, "jobs": 1}
    command = [sys.executable, "-c", f"import runpy; runpy.run_path({str(child)!r}, run_name='__main__')"]
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    done = subprocess.run(
        command, input=json.dumps(stated), capture_output=True, text=True, env=environment, check=False
    )
    assert done.returncode != 0 and "3/20 is no binary64 number" in done.stderr


# The real one


def sums_of_like_terms() -> list[Query]:
    """Each holds everywhere on [1, 2]; rounded coefficients say that it holds nowhere."""
    x, between = "x", (("x", Fraction(1), Fraction(2)),)
    tenth, fifth, third = (str(Fraction(v)) for v in (0.1, 0.2, 0.3))  # binary64: 0.1 + 0.2 > 0.3 by less than a unit
    rationals = ["-", ["+", ["*", "1/10", x], ["*", "1/5", x]], ["*", "3/10", x]]
    doubles = ["-", ["*", "3", ["*", tenth, x]], ["*", str(3 * Fraction(0.1)), x]]
    squares = ["-", ["*", tenth, ["*", tenth, x]], ["*", str(Fraction(0.1) ** 2), x]]
    shifted = ["-", ["+", ["*", tenth, ["+", x, "1"]], ["*", fifth, ["+", x, "1"]]], ["*", third, ["+", x, "1"]]]
    gap = Fraction(0.1) + Fraction(0.2) - Fraction(0.3)
    return [
        Query("rationals", between, (), ((rationals, "<=", "0"),)),
        Query("rationals-above", between, (), ((rationals, ">=", "0"),)),
        Query("doubles", between, (), ((doubles, ">=", "0"), (doubles, "<=", "0"))),
        Query("squares", between, (), ((squares, ">=", "0"), (squares, "<=", "0"))),
        Query("shifted", between, (("s", shifted),), (("s", ">=", str(2 * gap)), ("s", "<=", str(3 * gap)))),
    ]


def nearly_nothing(seed: int) -> Query:
    """A sum that comes to hardly more than 0, asked to have the very value that it has at some point of its box."""
    generator = random.Random(seed)
    x, y = (Fraction(generator.randint(101, 199), 100) for _ in range(2))
    known = {"x": x, "y": y, "xy": x * y, "xx": x**2, "x/(x+y+1)": x / (x + y + 1), "x+y": x + y}
    trees = {
        "x": "x",
        "y": "y",
        "xy": ["*", "x", "y"],
        "xx": ["**", "x", 2],
        "x/(x+y+1)": ["/", "x", ["+", "x", "y", "1"]],
    }
    trees["x+y"] = ["+", "x", "y"]
    terms, value = [], Fraction(0)
    for name in generator.sample(sorted(known), generator.randint(1, 3)):
        numbers = [Fraction(generator.uniform(-1, 1)) for _ in range(2)]
        numbers.append(Fraction(generator.randint(-9, 9), generator.randint(1, 12)))
        numbers.append(-Fraction(float(sum(numbers))))
        for c in numbers:
            k = generator.choice([Fraction(1), Fraction(3, 7), Fraction(generator.uniform(0.5, 2))])
            terms.append(["*", str(k), ["*", str(c / k), trees[name]]])
        value += sum(numbers) * known[name]
    generator.shuffle(terms)
    box = (("x", Fraction(1), Fraction(2)), ("y", Fraction(1), Fraction(2)))
    return Query(f"seed {seed}", box, (("s", ["+", *terms]),), (("s", ">=", str(value)), ("s", "<=", str(value))))


def genuine_violation(case: Case, x: np.ndarray) -> bool:
    return confirm(case.problem, Witness(x, float(case.problem.V(x)), "vdot"))


def destabilised() -> tuple[System, PolicyNetwork, np.ndarray]:
    """x' = -x + 3/10 x^5 + u x^4 - t x^9 under u = -0.3 x: the binary64 number leaves 3/10 - 0.3 > 0 of x^5.

    x'/x = -1 + d s - t s^2 with s = x^4, d = 3/10 - 0.3 and t = d^2/5 is 1/4 at s = 5/(2d).
    """
    x, u = symbols("x u")
    d = Fraction(3, 10) - Fraction(0.3)
    t = Fraction(d.numerator, d.denominator) ** 2 / 5
    system = System(
        name="destabilised",
        states=(x,),
        inputs=(u,),
        parameters={},
        dynamics=(-x + Fraction(3, 10) * x**5 + u * x**4 - t * x**9,),
        u_eq=(Number(0),),
        domain=box(24000),
        input_bounds=box(10**6),
    )
    network = PolicyNetwork.of_layers(
        (np.array([[-0.3]]),), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none"
    )
    return system, network, np.array([[0.5]])


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
    found = certify_roa(system, network, tmp_path, RoaOptions(engine="dreal", candidate="lyapunov"))
    assert found.verdict is Verdict.TRUSTED and found.levels.roa is not None
    assert 0.95 * truth < found.levels.roa < truth
    beyond = certify_roa(system, network, tmp_path, RoaOptions(engine="dreal", level=2.2**2))
    assert beyond.verdict is Verdict.REFUTED


def test_real_dreal_on_the_pendulum(real: Backend, tmp_path: Path) -> None:
    network: PolicyNetwork = pendulum_network((12,))
    options = RoaOptions(engine="dreal", level=0.5, time_limit=60)
    result = certify_roa(get_system("pendulum"), network, tmp_path, options)
    assert result.verdict is Verdict.TRUSTED and result.to_dict()["checked"] == "TRUSTED"
    case = case_of(get_system("pendulum"), network)
    assert decide(real, query(local_condition(1e-3), case.problem), 1e-3, 1, 60.0).status == "unsat"
    assert decide(real, query(ring_condition(0.01, 0.5), case.problem), 1e-3, 1, 60.0).solver_seconds is not None


def test_real_dreal_rounds_no_sum_of_like_terms(real: Backend) -> None:
    for asked in sums_of_like_terms():
        assert decide(real, asked, 1e-3, 1, 60.0).status == "delta-sat", asked.name
    for seed in range(20):
        asked = nearly_nothing(seed)
        assert decide(real, asked, 1e-3, 1, 60.0).status == "delta-sat", asked.name
    never = Query("never", (("x", Fraction(1), Fraction(2)),), (), (("x", "<=", "1/2"),))
    assert decide(real, never, 1e-3, 1, 60.0).status == "unsat"


def test_real_dreal_does_not_confirm_a_level_beyond_a_violation(real: Backend) -> None:
    case = case_of(*destabilised())
    level = 0.5 * 23999.0**2
    x = np.array([20601.79])
    assert 0.5 * x[0] ** 2 < level
    assert genuine_violation(case, x)
    assert decide(real, query(ring_condition(1.0, level), case.problem), 1e-3, 1, 60.0).status != "unsat"


def test_real_dreal_reads_the_smt2_files(tmp_path: Path) -> None:
    """The binary answers as fast as the module: no definition has become a variable."""
    path = shutil.which("dreal")
    if path is None:
        pytest.skip("dReal is not here: no `dreal` binary is on the PATH")
    solver = Backend("binary", (path,), "")
    case = case_of(get_system("pendulum"), pendulum_network((16,)))
    assert decide(solver, query(ring_condition(0.05, 0.5), case.problem), 1e-3, 1, 60.0).status == "unsat"
    assert decide(solver, query(local_condition(1e-3), case.problem), 1e-3, 1, 60.0).status == "unsat"
    for asked in sums_of_like_terms():
        assert decide(solver, asked, 1e-3, 1, 60.0).status == "delta-sat", asked.name


@pytest.mark.parametrize(("at", "contradicts"), [(0.9, False), (1.1, True)])
def test_a_violation_contradicts_only_where_the_guards_hold(
    at: float, contradicts: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """xdot = 2x: Vdot > 0 everywhere, but a practical claim speaks of nothing below its floor."""
    x, u = symbols("x u")
    system = System("away", (x,), (u,), {}, (3 * x + u,), (Number(0),), box(3), box(9))
    network = PolicyNetwork.of_layers(
        (np.array([[-1.0]]),), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none"
    )
    problem = Problem(ClosedLoop(system, network), Quadratic(np.eye(1)))
    answer = Answer("delta-sat", 0.1, "fake", {"x": (at, at)})
    monkeypatch.setattr("certify.provers.dreal.proof.decide", lambda *_: answer)
    _, witness = confirm_with_dreal(problem, Practical(roa=4.0, local=1.0, floor=1.0), FAKE, DrealOptions())
    assert (witness is not None) is contradicts
