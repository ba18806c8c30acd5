"""The command line: what it prints where, exit statuses, and bad input in one sentence."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import os
import re
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import torch

from certify.analysis.arguments import changes_of
from certify.analysis.options import RoaOptions
from certify.analysis.stages.state import StageName
from certify.certificates import checking, reading
from certify.cli.main import _run, command_line
from certify.cli.options import options_of
from certify.cli.terminal import ProgressLine, ring_line
from certify.loop.plants import get_system
from certify.loop.policies import Policy, PolicyNetwork, load_policy, save_policy
from certify.provers.base import Progress
from tests.support.loops import chain, pendulum_network
from tests.support.marks import slow_after

SHIPPED = Path(__file__).parent.parent.parent / "examples" / "policies" / "pendulum.pt"
QUICK = ("--candidate", "lyapunov", "--effort", "0.1")
VAN_DER_POL = Path(__file__).parent.parent.parent / "examples" / "van_der_pol.toml"


def saved(path: Path) -> Path:
    save_policy(path, Policy(pendulum_network((8, 8)), "pendulum", {"m": "0.15"}))
    return path


@pytest.fixture
def policy_file(tmp_path: Path) -> Path:
    return saved(tmp_path / "policy.pt")


@pytest.fixture(scope="module")
def proved(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The certificate of that policy."""
    folder = tmp_path_factory.mktemp("proved")
    assert (
        _run(["roa", "--policy", str(saved(folder / "policy.pt")), "--out", str(folder), "--quiet", *QUICK], False) == 0
    )
    return (folder / "certificate.json").read_bytes()


@pytest.fixture
def certificate(tmp_path: Path, proved: bytes) -> Path:
    """A copy of it, to be changed."""
    path = tmp_path / "certificate.json"
    path.write_bytes(proved)
    return path


def run(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> tuple[int, str, str]:
    given = [str(a) for a in arguments]
    status = _run(given, "--json" in given)
    out, err = capsys.readouterr()
    assert "Traceback" not in out + err
    return status, out, err


def test_roa_proves_writes_and_reports(tmp_path: Path, policy_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, err = run(capsys, "roa", "--policy", policy_file, "--out", tmp_path / "o", "--json", *QUICK)
    assert status == 0
    data = json.loads(out)
    assert out.count("\n") == 1
    assert data["verdict"] == "PROVED" and data["checked"] == "ACCEPTED"
    assert data["policy"]["layers"] == [2, 8, 8, 1]
    assert Path(data["certificate"]) == tmp_path / "o" / "certificate.json"
    assert (tmp_path / "o" / "report.html").read_text().startswith("<!DOCTYPE html>")
    assert "pendulum (from the policy file)" in err and "m = 0.15" in err


def test_roa_in_words(tmp_path: Path, policy_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, _ = run(capsys, "roa", "--policy", policy_file, "--out", tmp_path / "o", *QUICK)
    assert status == 0
    assert "PROVED" in out and "ACCEPTED" in out and str(tmp_path / "o" / "report.html") in out.replace("\n", "")


def test_check_accepts_and_compares_the_policy(
    tmp_path: Path, certificate: Path, policy_file: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    status, out, _ = run(capfd, "check", certificate, "--policy", policy_file)
    assert status == 0 and out.splitlines()[-1].startswith("ACCEPTED ")
    status, out, _ = run(capfd, "check", certificate, "--policy", SHIPPED)
    assert status == 1 and out.startswith("REJECTED rule=policy")
    status, out, _ = run(capfd, "check", certificate, "--json")
    assert status == 0 and json.loads(out)["result"] == "ACCEPTED"
    text = certificate.read_text()
    certificate.write_text(text.replace('"0x1.', '"0x2.', 1))
    status, out, _ = run(capfd, "check", certificate)
    assert status == 1 and out.startswith("REJECTED rule=format at=levels")
    status, out, _ = run(capfd, "check", certificate, "--policy", policy_file)
    assert status == 1 and "REJECTED rule=format" in out
    certificate.write_text("{}")
    assert run(capfd, "check", certificate, "--policy", policy_file)[0] == 1
    assert run(capfd, "check", tmp_path / "missing.json")[0] == 2


def test_check_compares_what_a_policy_file_says_beside_its_numbers(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """The box in which an imported policy is that of its file, and the input that beta centres it at."""
    policy, plain, other = load_policy(SHIPPED), tmp_path / "plain.pt", tmp_path / "other.pt"
    ways = ["--candidate", "ellipsoid", "--effort", "0.1", "--quiet", "--out", tmp_path / "o"]
    assert run(capfd, "roa", "--policy", SHIPPED, *ways)[0] == 0
    where = np.array([[-3.15, 3.15], [-np.inf, np.inf]])
    narrow = np.array([[-3.15, 3.0], [-np.inf, np.inf]])
    shifted = policy.network.beta(get_system("pendulum").exact_u_eq())
    save_policy(plain, replace(policy, valid=where, beta=shifted))
    certificate = tmp_path / "o" / "certificate.json"
    assert run(capfd, "check", certificate, "--policy", plain)[0] == 0
    for changed, said in (({"valid": narrow}, "domain of theta must lie in"), ({"beta": shifted + 0.1}, "u_eq is not")):
        save_policy(other, replace(policy, **changed))
        status, out, _ = run(capfd, "check", certificate, "--policy", other)
        assert status == 1 and out.startswith("REJECTED rule=policy at=policy: ") and said in out


def test_report_of_a_certificate(tmp_path: Path, certificate: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, _ = run(capsys, "report", certificate)
    assert status == 0 and "ACCEPTED" in out and (tmp_path / "report.html").exists()
    certificate.write_text("{}")
    status, _, err = run(capsys, "report", certificate)
    assert status == 2 and "not a certificate" in err


def test_systems(capsys: pytest.CaptureFixture[str]) -> None:
    status, out, _ = run(capsys, "systems")
    assert status == 0 and "theta_dot" in out and "0.15 kg" in out
    listed = json.loads(run(capsys, "systems", "--json")[1])["systems"]
    assert {s["name"]: s for s in listed}["pendulum"]["parameters"]["m"] == "3/20"


def test_a_requested_level(tmp_path: Path, policy_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, _ = run(capsys, "roa", "--policy", policy_file, "--out", tmp_path, "--level", "0.1", "--json")
    assert status == 0 and json.loads(out)["levels"]["roa"] == 0.1
    status, out, _ = run(capsys, "roa", "--policy", policy_file, "--out", tmp_path / "b", "--level", "1000", "--json")
    assert status == 1 and json.loads(out)["verdict"] == "REFUTED"
    status, out, _ = run(
        capsys, "roa", "--policy", policy_file, "--out", tmp_path / "b", "--level", "0.15", "--max-boxes", "3", "--json"
    )
    assert status == 3 and json.loads(out)["verdict"] == "UNKNOWN"


def test_unstable_loops_exit_1_and_name_the_eigenvalues(
    tmp_path: Path, policy_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status, out, _ = run(capsys, "roa", "--policy", policy_file, "--out", tmp_path, "--param", "m=5")
    assert status == 1 and "REFUTED" in out and "eigenvalues" in out
    assert "no V can prove" in out and "another V" not in out and "hardest along" not in out


def test_a_run_without_a_certificate_says_where_the_earlier_one_is(
    tmp_path: Path, policy_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """An option that cannot be used leaves it in place."""
    asked = ("roa", policy_file, "--out", tmp_path)
    run(capsys, *asked, "--level", "0.1")
    assert run(capsys, *asked, "--Q", "1,2,3")[0] == 2 and (tmp_path / "certificate.json").exists()
    status, _, err = run(capsys, *asked, "--param", "m=5")
    kept = tmp_path / "certificate.earlier.json"
    assert status == 1 and kept.exists() and not (tmp_path / "certificate.json").exists()
    assert f"that of an earlier run is kept as {kept}" in err


def test_a_plant_of_ones_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    network = PolicyNetwork.of_layers((np.array([[-0.5, -0.4]]),), (np.zeros(1),), np.array([6.0]), np.zeros(1))
    save_policy(tmp_path / "v.pt", Policy(network, "somebody's plant"))
    status, out, err = run(
        capsys,
        "roa",
        "--policy",
        tmp_path / "v.pt",
        "--system",
        VAN_DER_POL,
        "--candidate",
        "lyapunov",
        "--out",
        tmp_path,
        "--json",
    )
    assert status == 0 and json.loads(out)["system"] == "van_der_pol"
    assert "from the command line" in err


def test_a_rounded_beta_is_read_as_the_real_number(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    network = pendulum_network((8, 8))
    save_policy(tmp_path / "b.pt", Policy(network, "pendulum", beta=np.array([1e-7])))
    status, _, err = run(capsys, "roa", "--policy", tmp_path / "b.pt", "--out", tmp_path, *QUICK)
    assert status == 0 and "this shifts u(0) by 6e-07" in err


def bad_policies(tmp_path: Path) -> dict[str, Path]:
    """Files that must be refused, by what is wrong with them."""
    valid = torch.load(SHIPPED, weights_only=True)
    wrong = {
        "format": {**valid, "format": "other"},
        "activation": {**valid, "activation": "relu"},
        "nan": {**valid, "biases": [b * float("nan") for b in valid["biases"]]},
        "infinite": {**valid, "biases": [b / 0 for b in valid["biases"]]},
        "plant": {**valid, "system": {"name": "unicycle", "parameters": {}}},
        "parameter": {**valid, "system": {"name": "pendulum", "parameters": {"z": 1.0}}},
        "mass": {**valid, "system": {"name": "pendulum", "parameters": {"m": "-0.15"}}},
        "object": {**valid, "training": {"path": Path("x")}},
    }
    paths = {}
    for name, data in wrong.items():
        paths[name] = tmp_path / f"{name}.pt"
        torch.save(data, paths[name])
    paths["missing"] = tmp_path / "missing.pt"
    paths["garbage"] = tmp_path / "garbage.pt"
    paths["garbage"].write_bytes(b"\x80garbage")
    _, three = chain(3, [-1, -2, -3])
    paths["shape"] = tmp_path / "shape.pt"
    save_policy(paths["shape"], Policy(three, "pendulum"))
    return paths


def snapshot(folder: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in folder.iterdir()}


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("missing", "cannot be read"), ("garbage", "policy file"), ("object", "plain tensors"), ("format", "format"),
        ("activation", "tanh"), ("nan", "finite"), ("infinite", "finite"), ("plant", "unknown system"),
        ("parameter", "no parameter"), ("mass", "must be positive"), ("shape", "must read 2 states"),
    ],
)  # fmt: skip
def test_bad_policies_exit_2_and_overwrite_nothing(
    tmp_path: Path, name: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = bad_policies(tmp_path)[name]
    out_folder = tmp_path / "out"
    out_folder.mkdir()
    (out_folder / "certificate.json").write_text("precious")
    before = snapshot(out_folder)
    status, out, err = run(capsys, "roa", "--policy", path, "--out", out_folder)
    last = err.strip().splitlines()[-1]
    assert (status, out) == (2, "") and last.startswith("certify: ") and message in last
    assert snapshot(out_folder) == before
    status, out, _ = run(capsys, "roa", "--policy", path, "--out", out_folder, "--json")
    assert status == 2 and message in json.loads(out)["error"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--system", "unicycle"], "unknown system"),
        (["--system", "missing.toml"], "missing.toml cannot be read: there is no such file. Check its name"),
        (["--param", "z=1"], "no parameter"),
        (["--param", "m=0"], "must be positive"),
        (["--param", "m"], "NAME=VALUE"),
        (["--param", "m=abc"], "finite number"),
        (["--param", "m=nan"], "finite number"),
        (["--domain", "theta=0"], "interior"),
        (["--domain", "phi=1"], "no state"),
        (["--domain", "theta=1:2"], "interior"),
        (["--Q", "1"], "positive numbers"),
        (["--Q", "1,x"], "separated by commas"),
        (["--Q", "1,-1"], "positive numbers"),
        (["--level", "-1"], "positive number"),
        (["--level", "nan"], "positive number"),
        (["--level", "x"], "--level"),
        (["--candidate", "sos"], "candidate"),
        (["--time-limit", "0"], "--time-limit must be positive; found 0"),
        (["--bogus"], "--bogus"),
    ],
)
def test_bad_options_exit_2(
    tmp_path: Path, policy_file: Path, arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    out_folder = tmp_path / "out"
    status, out, err = run(capsys, "roa", "--policy", policy_file, "--out", out_folder, *arguments)
    assert (status, out) == (2, "") and message in err
    assert not list(out_folder.glob("*"))
    status, out, _ = run(capsys, "roa", "--policy", policy_file, "--out", out_folder, *arguments, "--json")
    assert status == 2 and message in json.loads(out)["error"]


@pytest.mark.parametrize(
    ("command", "arguments", "message"),
    [
        ("reach", ["--from", "q=1"], "--from must name states of pendulum, theta, theta_dot; found q"),
        ("reach", ["--from", "theta=99"], "--from must lie in the interior of the domain, theta between -3.14 and"),
        ("reach", ["--from", "theta=1", "--kind", "zip"], "--kind must be one of"),
        ("reach", ["--from", "theta=1", "--kind", "onnx"], "--kind must be left out: "),
        ("reach", ["--from", "theta=1", "--time-limit", "-1"], "--time-limit must be positive; found -1"),
        ("roa", ["--precision", "2"], "--precision must lie between 0 and 1; found 2"),
        ("roa", ["--lyapunov-level", "1"], "--lyapunov-level must be the level of a function; give one as --lyapunov."),
        ("roa", ["--box", "q=1"], "--box must name states of pendulum"),
        ("roa", ["--enlarge", "--claim", "practical"], "--enlarge looks for a tube"),
        ("roa", ["--Q", "1"], "--Q must have 2 positive numbers"),
        (
            "roa",
            ["--claim", "global"],
            "--claim must be one of auto, asymptotic, practical, nearby, invariant; found 'global'",
        ),
        ("roa", ["--around", "rest", "--claim", "asymptotic"], "--around rest needs another --claim than asymptotic"),
        ("roa", ["--candidate", "neural", "--rate", "1"], "--candidate neural needs the engine bounds"),
        ("float-error", ["--tanh-ulp", "-1"], "--tanh-ulp must be a number from 0"),
        ("float-error", ["--chain", "0"], "--chain must be at least 1"),
    ],
)
def test_an_option_is_named_as_it_is_typed(
    command: str, arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = [] if command == "float-error" else ["--out", str(tmp_path / "o")]
    for last in ([], ["--json"]):
        status, said, err = run(capsys, command, SHIPPED, *arguments, *out, *last)
        found = json.loads(said)["error"] if last else err
        assert status == 2 and message in found and "`" not in found


def test_each_option_that_python_refuses_by_name_is_an_option_of_the_command_line() -> None:
    """Whoever adds a field to the options and a message about it need not think of how it is typed."""
    command = command_line()
    options = {name: options_of(command.commands[name]) for name in ("roa", "reach")}  # type: ignore[attr-defined]
    only_in_python = {"P"}
    for one in dataclasses.fields(RoaOptions):
        known = options["reach"] if one.name == "reach_from" else options["roa"]
        assert one.name in known or one.name in only_in_python, one.name
    assert options["reach"]["reach_from"] == "--from" and options["roa"]["dreal_precision"] == "--precision"


def test_the_policy_may_be_the_first_word(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plain = ["--level", "0.3", "--quiet", "--json"]
    status, out, _ = run(capsys, "roa", SHIPPED, "--out", tmp_path, *plain)
    assert status == 0 and json.loads(out)["policy"]["sha256"] == load_policy(SHIPPED).network.sha256()
    twice = str(SHIPPED.parent / ".." / "policies" / SHIPPED.name)
    assert run(capsys, "roa", SHIPPED, "--policy", twice, "--out", tmp_path, *plain)[0] == 0
    for command, more in (("roa", []), ("reach", ["--from", "theta=1"])):
        status, _, err = run(capsys, command, SHIPPED, "--policy", tmp_path / "other.pt", *more)
        assert status == 2 and f"found {SHIPPED} and --policy {tmp_path / 'other.pt'}" in err
        status, _, err = run(capsys, command, *more)
        assert status == 2 and f"a policy file must be named, as in certify {command} policy.pt" in err


@pytest.mark.slow
def test_what_to_try_next_names_a_policy_that_was_the_first_word(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status, out, _ = run(
        capsys, *("roa", SHIPPED, "--max-boxes", "3", "--effort", "0.02"), "--out", tmp_path, "--json", "--quiet"
    )
    command = json.loads(out)["diagnosis"]["next"]["command"]
    assert status == 0 and command.startswith(f"certify roa {SHIPPED} ") and "--max-boxes 30" in command


def test_a_certificate_of_another_version_is_told_who_reads_it(
    certificate: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = certificate.read_text()
    commands: list[tuple[object, ...]] = [
        ("check", 1),
        ("check", 1, "--json"),
        ("check", 1, "--reference"),
        ("contains", 2, "theta=0"),
        ("report", 2),
        ("plot", 2, "--out", tmp_path / "f.svg"),
        ("prove-in-coq", 2, "--out", tmp_path / "coq"),
    ]
    for version, commit, some in ((8, "7ddae11", commands), (7, "eb6ab75", commands[:3])):
        certificate.write_text(text.replace("certify-certificate/9", f"certify-certificate/{version}", 1))
        last = f"commit {commit} of certify was the last to read it"
        earlier = f"{last}. To have a certificate of today, run certify roa again"
        for command, status, *more in some:
            found, out, err = run(capsys, command, certificate, *more)
            assert found == status and earlier in err and ("REJECTED" in out) == (command == "check")
    certificate.write_text(text.replace("certify-certificate/9", "certify-certificate/99", 1))
    assert "A later release of certify wrote it" in run(capsys, "check", certificate)[2]
    for other in ("certify-policy/1", "certify-certificate/x", "certify-certificate/9"):
        certificate.write_text(text.replace('"certify-certificate/9"', f'"{other}"', 1).replace('"rational"', '"odd"'))
        assert "release" not in run(capsys, "check", certificate)[2]


@pytest.mark.parametrize("words", [["theta=0.02", "theta_dot=-0.1..0.1"], ["theta=0.02 , theta_dot = -0.1:0.1"]])
def test_states_come_with_commas_or_without(
    words: list[str], certificate: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status, out, _ = run(capsys, "contains", certificate, *words, "--json")
    found = json.loads(out)
    assert status == 0 and found["box"] == {"theta": ["1/50", "1/50"], "theta_dot": ["-1/10", "1/10"]}
    status, _, err = run(capsys, "contains", certificate, *words, "theta=1")
    assert status == 2 and "found theta twice" in err


@pytest.mark.parametrize("interval", ["theta=-1..2", "theta=-1:2"])
def test_a_domain_is_written_as_all_ranges_are(interval: str) -> None:
    assert changes_of({"domain": [interval]}).of(get_system("pendulum")).domain[0] == (-1, 2)


def test_an_output_folder_that_cannot_be_written(
    tmp_path: Path, policy_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("precious")
    status, _, err = run(capsys, "roa", "--policy", policy_file, "--out", tmp_path / "file" / "out")
    assert status == 2 and "cannot be written" in err
    assert (tmp_path / "file").read_text() == "precious"


def test_usage_errors(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(capsys, "roa")[0] == 2
    assert run(capsys, "prove")[0] == 2
    status, out, _ = run(capsys, "--help")
    assert status == 0 and "roa" in out


def test_the_installed_command(tmp_path: Path) -> None:
    """One run as a user has it: a process of its own, standard streams apart."""
    command = [sys.executable, "-m", "certify", "roa", "--policy", str(SHIPPED), "--out", str(tmp_path), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env={**os.environ})
    assert done.returncode == 0, done.stderr
    data: dict[str, Any] = json.loads(done.stdout)
    assert data["policy"]["sha256"] == load_policy(SHIPPED).network.sha256()
    assert data["reason"] in ("domain", "witness", "inputs")


@pytest.mark.parametrize("where", slow_after(1, ["ring", "check"]))
def test_an_interrupt_leaves_a_search_and_nothing_half_written(
    where: str, tmp_path: Path, policy_file: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from certify.provers.boxes.rule import VdotBound

    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    if where == "ring":
        monkeypatch.setattr(VdotBound, "__call__", interrupt)
    else:
        monkeypatch.setattr("certify.analysis.acceptance.run_checker", interrupt)
    status, out, err = run(capsys, "roa", "--policy", policy_file, "--out", tmp_path / "o", "--effort", "0.02")
    assert status == 130 and out == "" and "interrupted" in err and "--resume" in err
    assert [path.name for path in (tmp_path / "o").iterdir()] == ["search.json"]
    monkeypatch.undo()
    assert run(capsys, "roa", "--policy", policy_file, "--out", tmp_path / "o", "--resume", "--effort", "0.02")[0] == 0
    assert sorted(path.name for path in (tmp_path / "o").iterdir()) == ["certificate.json", "report.html"]
    assert run(capsys, "check", tmp_path / "o" / "certificate.json")[0] == 0


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_control_c_ends_a_running_command(tmp_path: Path, number: signal.Signals) -> None:
    """A suite in the background of a script ignores SIGINT, and its children inherit that: this one listens again."""
    listening = (
        "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
        "from certify.cli.main import main; main(sys.argv[1:])"
    )
    command = [sys.executable, "-c", listening, "roa", "--policy", str(SHIPPED.with_name("cartpole.pt"))]
    running = subprocess.Popen(
        [*command, "--out", str(tmp_path / "o")],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert running.stderr is not None
    assert "cartpole" in running.stderr.readline()  # the plant is known, the proof begins
    running.send_signal(number)
    out, err = running.communicate(timeout=60)
    assert running.returncode == 130 and out == ""
    assert "interrupted" in err and "Traceback" not in err
    assert [p.name for p in tmp_path.rglob("*") if p.is_file()] in ([], ["search.json"])


def test_a_wrong_policy_is_named_however_deep_the_provenance_nests(
    certificate: Path, policy_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The comparison is with what the checker says of the bytes that it read: there is no second reader to fail."""
    deep = "[" * 985 + "]" * 985
    text = certificate.read_text().replace('"provenance": {', '"provenance": {"deep": ' + deep + ", ", 1)
    certificate.write_text(text)
    status, out, _ = run(capsys, "check", certificate, "--policy", SHIPPED)
    assert status == 1 and out.startswith("REJECTED rule=")
    assert run(capsys, "check", certificate, "--policy", policy_file)[0] in (0, 1)  # or too deep to be read at all


def test_a_wrong_policy_is_named_when_the_certificate_is_there_for_one_reader(
    tmp_path: Path,
    proved: bytes,
    policy_file: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The file is gone when the checker has read it: its answer alone says whose policy it is."""
    path, ask = tmp_path / "once.json", checking.ask

    def once(path: Path, *arguments: Any) -> tuple[int, dict[str, Any]]:
        answer = ask(path, *arguments)
        path.unlink()
        return answer

    monkeypatch.setattr(checking, "ask", once)
    for policy, expected in ((SHIPPED, (1, "REJECTED rule=policy")), (policy_file, (0, "ACCEPTED "))):
        path.write_bytes(proved)
        status, out, _ = run(capsys, "check", path, "--policy", policy)
        assert (status, out.splitlines()[-1][: len(expected[1])]) == expected and not path.exists()


def test_a_file_whose_name_is_an_option_is_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("--help").write_text("{}")
    command = [sys.executable, "-m", "certify", "check", "./--help"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1 and "REJECTED rule=format" in done.stdout


@pytest.mark.parametrize(
    "arguments", slow_after(1, [["systems", "--json"], ["roa", "--policy", str(SHIPPED), "--effort", "0.1"]])
)
def test_a_reader_that_has_gone_is_not_a_refutation(tmp_path: Path, arguments: list[str]) -> None:
    out = ["--out", str(tmp_path)] if arguments[0] == "roa" else []
    reading, writing = os.pipe()
    os.close(reading)
    command = [sys.executable, "-m", "certify", *arguments, *out]
    done = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writing)
    assert done.returncode == 141 and "Traceback" not in done.stderr


@pytest.mark.parametrize("beta", [0.7, -1e-3])
def test_a_beta_that_is_not_the_rounded_one_is_refused(
    tmp_path: Path, beta: float, capsys: pytest.CaptureFixture[str]
) -> None:
    network = pendulum_network((8, 8))
    save_policy(tmp_path / "b.pt", Policy(network, "pendulum", beta=np.array([beta])))
    status, out, err = run(capsys, "roa", "--policy", tmp_path / "b.pt", "--out", tmp_path / "o")
    assert (status, out) == (2, "") and "`beta` must be atanh" in err and "shifts u(0) by" in err
    assert not (tmp_path / "o").exists()


@pytest.mark.slow
def test_practical_stability_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plain = SHIPPED.parent / "without_gain" / "pendulum.pt"
    status, out, err = run(capsys, "roa", "--policy", plain, "--out", tmp_path, "--claim", "asymptotic")
    assert (status, out) == (2, "") and "--claim practical" in err
    arguments = (
        "roa",
        "--policy",
        plain,
        "--claim",
        "practical",
        "--candidate",
        "lqr",
        "--effort",
        "0.02",
        "--out",
        tmp_path,
    )
    status, out, _ = run(capsys, *arguments)
    claimed = out.partition("simulated")[0]  # what runs did in simulation comes after that
    assert status == 0 and "enters" in claimed and "converge" not in claimed and "floor c0" in claimed
    page = (tmp_path / "report.html").read_text()
    assert "Practical stability" in page and "asymptotically stable" not in page
    for program in ([], ["--reference"]):
        status, out, _ = run(capsys, "check", tmp_path / "certificate.json", "--policy", plain, *program)
        assert status == 0 and "in finite time" in out and out.splitlines()[-1].startswith("ACCEPTED c0=")
        status, out, _ = run(capsys, "check", tmp_path / "certificate.json", "--policy", SHIPPED, *program)
        assert status == 1 and out.startswith("REJECTED rule=policy")
    status, _, err = run(capsys, *arguments, "--engine", "dreal")
    assert status in (2, 3)  # without dReal unknown, with it a claim that it does not prove
    assert run(capsys, *arguments[:4], "stable")[0] == 2


def test_both_checkers_refuse_a_level_that_was_not_proved(
    tmp_path: Path, certificate: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = json.loads(certificate.read_text())
    data["levels"]["roa"] = (float.fromhex(data["levels"]["roa"]) * 1.5).hex()
    certificate.write_text(json.dumps(data))
    for program in ([], ["--reference"]):
        status, out, _ = run(capsys, "check", certificate, "--json", *program)
        assert status == 1 and json.loads(out)["result"] == "REJECTED"
        status, out, err = run(capsys, "check", tmp_path / "missing.json", *program)
        assert (status, out) == (2, "") and "cannot be read" in err and "certify roa writes certificate.json" in err
        status, out, err = run(capsys, "check", tmp_path, *program)
        assert status == 2 and f"Name the certificate in it: {tmp_path / 'certificate.json'}." in err
    assert "certify roa writes certificate.json" in run(capsys, "contains", tmp_path / "missing.json", "x=1")[2]


def test_the_check_of_a_policy_says_that_it_is_one(policy_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, err = run(capsys, "check", policy_file)
    assert status == 1 and out.startswith("REJECTED rule=format") and f"certify roa {policy_file} writes" in err


def test_a_report_is_about_the_bytes_that_were_checked(
    tmp_path: Path, proved: bytes, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The file gives each reader other bytes: there is one reader, and the page names what it read."""
    path, page, read_raw = tmp_path / "once.json", tmp_path / "page.html", reading.read_raw

    def once(path: Path) -> bytes:
        raw = read_raw(path)
        path.write_bytes(b"{}")
        return raw

    path.write_bytes(proved)
    monkeypatch.setattr(reading, "read_raw", once)
    status, out, _ = run(capsys, "report", path, "--out", page)
    assert status == 0 and out.startswith("ACCEPTED")
    assert hashlib.sha256(proved).hexdigest() in page.read_text() and "PROVED" in page.read_text()


SPRING = """
name = "soft_spring"
states = ["p", "v"]
inputs = ["F"]
[dynamics]
p = "v"
v = "-p + p**3/4 - 2*v + F"
[u_eq]
F = 0
[domain]
p = [-2, 2]
v = [-2, 2]
[input_bounds]
F = [-1, 1]
[units]
p = "m"
v = "m/s"
"""


@pytest.fixture
def spring(tmp_path: Path) -> tuple[str | Path, ...]:
    """The options of a command that name a plant of two states and a policy of one tanh."""
    plant, policy = tmp_path / "spring.toml", tmp_path / "spring.pt"
    plant.write_text(SPRING)
    network = PolicyNetwork.of_layers(
        (np.array([[-0.3, -0.2]]),), (np.zeros(1),), np.ones(1), np.zeros(1), "tanh", "none"
    )
    save_policy(policy, Policy(network, "soft_spring"))
    return "--policy", policy, "--system", plant, "--out", tmp_path / "o"


def test_reach_proves_that_a_state_converges(
    tmp_path: Path, spring: tuple[str | Path, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    given = ("reach", *spring, "--from", "p=1.5,v=1.4", "--box", "p=0.1,v=0.2", "--effort", "0.1", "--json")
    status, out, _ = run(capsys, *given)
    assert status == 0 and out.count("\n") == 1
    data = json.loads(out)
    assert data["verdict"] == "PROVED" and data["claim"] == {"kind": "reached"} and data["checked"] == "ACCEPTED"
    assert data["reach_from"] == {"p": "3/2", "v": "7/5"} and data["tube"]["centre"] == [1.5, 1.4]
    assert data["tube"]["shape"] == "box" and data["tube"]["slabs"] > 0
    first, second = data["tube"]["semi_axes"]
    assert second == pytest.approx(2 * first, rel=1e-9)
    page = (tmp_path / "o" / "report.html").read_text()
    assert "around the state c₀, p = 1.5 m, v = 1.4 m/s" in page and "PROVED · ACCEPTED" in page
    status, out, _ = run(capsys, "check", tmp_path / "o" / "certificate.json")
    assert status == 0 and out.splitlines()[-1].startswith("ACCEPTED ") and "c = 1.5 1.4" in out


@pytest.mark.slow
def test_reach_proves_that_a_box_converges(
    tmp_path: Path, spring: tuple[str | Path, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    box = "p=1.49..1.51", "v=1.38..1.42"
    status, out, _ = run(capsys, "reach", *spring, "--from", ",".join(box), "--effort", "0.06", "--json")
    data = json.loads(out)
    assert status == 0 and data["verdict"] == "PROVED" and data["checked"] == "ACCEPTED"
    assert data["reach_from"] == {"p": ["149/100", "151/100"], "v": ["69/50", "71/50"]}
    assert data["tube"]["shape"] == "box" and data["tube"]["centre"] == [1.5, 1.4]
    file = tmp_path / "o" / "certificate.json"
    assert run(capsys, "contains", file, *box)[0] == 0
    wider = [round(1.5 + 2 * (-1) ** k * data["tube"]["semi_axes"][0], 6) for k in (1, 0)]
    assert run(capsys, "contains", file, f"p={wider[0]}..{wider[1]}", box[1])[0] != 0
    status, out, _ = run(capsys, "reach", *spring, "--from", ",".join(box), "--effort", "0.06")
    assert status == 0 and re.search(r"box +p = 1.49..1.51 m, v = 1.38..1.42 m/s", out)


@pytest.mark.slow
def test_a_box_that_is_wider_than_every_tube_is_not_shown_to_converge(
    tmp_path: Path, spring: tuple[str | Path, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    given = ("reach", *spring, "--from", "p=1.3..1.7,v=1.4", "--effort", "0.1")
    status, out, _ = run(capsys, *given)
    said = " ".join(out.split())
    assert status == 3 and "the box is NOT shown to converge" in said and "PROVED" not in said
    share = re.search(r"the widest tube holds (0\.\d+) of the box in each direction", said)
    assert share is not None and 0 < float(share[1]) < 1
    assert "The box p = 1.3..1.7 m, v = 1.4 m/s was asked about" in (tmp_path / "o" / "report.html").read_text()


@pytest.mark.parametrize(
    ("begin", "more", "why"),
    [
        ("p=1.5..1.4", (), "lo <= hi; found p=1.5..1.4"),
        ("p=1.4..2", (), "must lie in the interior of the domain, p between -2 and 2; found 2"),
        ("p=1.4..1.5", ("--box", "p=0.1"), "leave it out where --from is a box"),
    ],
)
def test_a_box_that_cannot_be_asked_about_is_refused(
    begin: str, more: tuple[str, ...], why: str, spring: tuple[str | Path, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    status, _, err = run(capsys, "reach", *spring, "--from", begin, *more)
    assert status == 2 and why in " ".join(err.split())


def test_a_state_that_is_not_shown_to_converge_exits_3(
    tmp_path: Path, spring: tuple[str | Path, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    given = ("reach", *spring, "--from", "p=1.95,v=1.95", "--effort", "0.02")
    status, out, _ = run(capsys, *given)
    assert status == 3
    said = " ".join(out.split())
    assert said.startswith("UNKNOWN soft_spring: the state is NOT shown to converge; what is proved is {V <= ")
    assert "no tube from there" in said and "PROVED" not in said
    assert "It is not shown to converge" in (tmp_path / "o" / "report.html").read_text()
    status, out, _ = run(capsys, *given, "--json")
    data = json.loads(out)
    assert (status, data["verdict"], data["stop"], data["tube"]) == (3, "UNKNOWN", "path", None)


def test_a_state_in_the_proved_set_needs_no_tube(
    spring: tuple[str | Path, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    status, out, err = run(capsys, "reach", *spring, "--from", "p=0.1", "--effort", "0.2", "--json")
    data = json.loads(out)
    assert status == 0 and data["verdict"] == "PROVED" and data["claim"] == {"kind": "asymptotic"}
    assert data["tube"] is None and "the state lies in the proved set, and no tube is needed" in err


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--from", "p=2"), "interior of the domain, p between -2 and 2; found 2"),
        (("--from", "p=1,v=-7"), "interior of the domain, v between -2 and 2; found -7"),
        (("--from", "q=1"), "must name states of soft_spring, p, v; found q"),
        (("--from", "p"), "--from takes NAME=VALUE"),
        (("--from", "p=one"), "one"),
        (("--from", "p=1", "--box", "q=1"), "--box must name states"),
        (("--from", "p=1", "--box", "p=-1"), "positive half-widths"),
    ],
)
def test_states_that_cannot_be_asked_about_exit_2(
    tmp_path: Path,
    spring: tuple[str | Path, ...],
    options: tuple[str, ...],
    words: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    status, out, err = run(capsys, "reach", *spring, *options)
    assert status == 2 and words in err and out == ""
    assert not (tmp_path / "o" / "certificate.json").exists()


# what is uncertain

RANGED = SPRING.replace("[dynamics]", "[parameters]\nk = 1\n[disturbances]\nwind = {wind}\n[dynamics]").replace(
    '"-p + p**3/4 - 2*v + F"', '"-k*p + p**3/4 - 2*v + F + wind"'
)


@pytest.fixture
def ranged(tmp_path: Path, spring: tuple[str | Path, ...]) -> tuple[str | Path, ...]:
    """The same with a stiffness k, and a wind that acts only if it is asked for."""
    (tmp_path / "spring.toml").write_text(RANGED.format(wind=0))
    return spring


def test_roa_for_a_range_says_for_what_it_holds(
    tmp_path: Path, ranged: tuple[str | Path, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    given = ("roa", *ranged, "--param", "k=0.9..1.1", "--candidate", "lyapunov", "--level", "0.5")
    status, out, err = run(capsys, *given)
    said = " ".join(out.split())
    assert status == 0
    assert "with k = 1 in [0.9, 1.1]; policy 2-1" in err
    assert said.startswith("PROVED soft_spring: for every k(t) in [0.9, 1.1], {V <= 0.5} is invariant")
    page = (tmp_path / "o" / "report.html").read_text()
    assert "For every k(t) in [0.9, 1.1], any measurable function of time" in page
    status, out, _ = run(capsys, *given, "--json")
    data = json.loads(out)
    assert data["uncertain"] == [{"name": "k", "kind": "parameter", "lo": "9/10", "hi": "11/10", "unit": ""}]
    assert data["verdict"] == "PROVED" and data["claim"] == {"kind": "asymptotic"}
    status, out, _ = run(capsys, "check", tmp_path / "o" / "certificate.json")
    assert status == 0 and "for every k(t) in [9/10 (about 0.9), 11/10 (about 1.1)]" in out


def test_three_ways_in_make_one_plant(
    tmp_path: Path, ranged: tuple[str | Path, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    """Asked for a level beyond the domain, so that the run ends at once."""
    given = ("--param", "k=3/4..2", "--disturbance", "wind=-0.01..0.02", "--input-error", "F=1e-3", "--level", "100")
    status, out, err = run(capsys, "roa", *ranged, *given, "--claim", "practical", "--json", "--effort", "0.1")
    assert [(q["kind"], q["name"], q["lo"], q["hi"]) for q in json.loads(out)["uncertain"]] == [
        ("parameter", "k", "3/4", "2"),
        ("disturbance", "wind", "-1/100", "1/50"),
        ("input error", "error_F", "-1/1000", "1/1000"),
    ]
    assert status in (1, 3)
    line = err.splitlines()[0]
    assert "k = 1 in [0.75, 2]; disturbance wind in [−0.01, 0.02]; input error error_F in [−0.001, 0.001]" in line


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--param", "k=2..1"), "--param takes a range LO..HI with LO < HI; found k=2..1."),
        (("--param", "k=abc"), "--param takes a finite number such as k=0.15"),
        (("--domain", "x=3..-3"), "--domain takes a range LO..HI with LO < HI; found x=3..-3."),
        (("--sample-time", "-1"), "--sample-time must be a positive time, or a range with 0 <= LO <= HI; found -1."),
        (("--param", "k=1..much"), "or a range k=LO..HI; found k=1..much."),
        (("--param", "wind=-1..1"), "soft_spring has no parameter 'wind'; it has: k"),
        (("--disturbance", "k=1"), "soft_spring has no disturbance 'k'; it has: wind"),
        (("--disturbance", "wind"), "--disturbance takes NAME=VALUE"),
        (("--disturbance", "wind=-0.1"), "must have a half-width that is not negative"),
        (("--disturbance", "wind=0.1..0.2"), "hold its nominal value 0"),
        (("--input-error", "0"), "must be a positive bound for one of F"),
        (("--input-error", "G=1e-4"), "must be a positive bound for one of F"),
        (("--input-error", "some"), "--input-error must be a finite number"),
        (("--param", "k=0.9..1.1", "--engine", "dreal"), "--engine must be bounds where something is uncertain"),
        (("--disturbance", "wind=0.1", "--engine", "both"), "found ranges of wind in soft_spring"),
    ],
)
def test_ranges_that_cannot_be_used_exit_2(
    tmp_path: Path,
    ranged: tuple[str | Path, ...],
    options: tuple[str, ...],
    words: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    status, out, err = run(capsys, "roa", *ranged, *options)
    assert status == 2 and words in err and out == ""
    assert not (tmp_path / "o" / "certificate.json").exists()


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (("reach", "--from", "p=1"), "a tube around a path must be of exact equations"),
        (("export-smt2",), "export-smt2 needs a plant with exact equations"),
    ],
)
def test_a_disturbance_that_always_acts_is_refused_where_it_would_be_left_out(
    tmp_path: Path,
    ranged: tuple[str | Path, ...],
    command: tuple[str, ...],
    words: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "spring.toml").write_text(RANGED.format(wind="0.1"))
    status, out, err = run(capsys, command[0], *ranged, *command[1:])
    assert status == 2 and words in err and "found ranges of wind in soft_spring" in err and out == ""
    assert not (tmp_path / "o").exists() or not any((tmp_path / "o").glob("*.[js]*"))


@pytest.mark.slow
def test_a_tube_of_a_plant_with_a_range(
    tmp_path: Path, ranged: tuple[str | Path, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    status, out, _ = run(
        capsys, "roa", *ranged, "--param", "k=0.9..1.1", "--level", "0.05", "--enlarge", "--effort", "0.2"
    )
    assert status == 0 and "PROVED" in out
    claim = json.loads((tmp_path / "o" / "certificate.json").read_text())
    assert claim["claim"]["kind"] == "enlarged" and claim["plant"]["uncertain"][0]["range"] == ["9/10", "11/10"]


def test_no_condition_is_exported_that_was_not_proved(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of a policy that rests beside the origin Vdot < 0 is false around it, and nothing may say that it was proved."""
    policy = Path(__file__).parents[2] / "examples" / "policies" / "without_gain" / "pendulum.pt"
    status, out, err = run(capsys, "export-smt2", "--policy", policy, "--out", tmp_path / "o")
    assert status == 2 and "pi(0)" in err and out == ""
    assert not list(tmp_path.rglob("*.smt2"))


def test_a_disturbance_of_the_file_can_be_switched_off(
    tmp_path: Path, ranged: tuple[str | Path, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "spring.toml").write_text(RANGED.format(wind="0.1"))
    given = ("roa", *ranged, "--disturbance", "wind=0", "--candidate", "lyapunov", "--level", "0.1", "--json")
    status, out, _ = run(capsys, *given)
    assert status == 0 and json.loads(out)["uncertain"] == [] and json.loads(out)["claim"]["kind"] == "asymptotic"


def test_a_sample_time_and_a_rate_are_said_everywhere(
    tmp_path: Path, ranged: tuple[str | Path, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    """Result, JSON, page and checker speak of the same periods and the same rate."""
    asked = (
        "--candidate",
        "lyapunov",
        "--level",
        "0.25",
        "--sample-time",
        "0.01..0.05",
        "--rate",
        "0.25",
        "--effort",
        "0.2",
    )
    status, out, _ = run(capsys, "roa", *ranged, *asked)
    said = " ".join(out.split())
    assert status == 0 and "is invariant at sampling instants and attracted by the origin" in said
    assert "the input held over any sequence of periods in [0.01, 0.05] s" in said
    assert "falling at least as exp(-2*0.25 t)" in said
    data = json.loads(run(capsys, "roa", *ranged, *asked, "--json")[1])
    assert data["claim"] == {"kind": "asymptotic", "rate": 0.25, "sample": ["1/100", "1/20"]}
    assert data["time"] == "continuous" and 9.26 < data["reach_time"] < 9.27  # ln(100)/0.5 and a period
    page = (tmp_path / "o" / "report.html").read_text("utf-8")
    assert "over any sequence of periods in [0.01, 0.05] s." in page and "for all time" not in page
    status, out, _ = run(capsys, "check", tmp_path / "o" / "certificate.json")
    assert status == 0 and "at a sampling instant is there at every later sampling instant" in out
    answer = json.loads(run(capsys, "check", tmp_path / "o" / "certificate.json", "--json")[1])
    assert (answer["rate"], answer["sample"], answer["discrete"]) == (0.25, ["1/100", "1/20"], False)


def test_a_plant_in_discrete_time_is_listed_by_its_steps(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from certify.loop.plants import get_system

    steps = replace(get_system("pendulum"), time="discrete", dynamics=get_system("pendulum").states)
    monkeypatch.setattr("certify.loop.plants.available_systems", lambda: ("pendulum",))
    monkeypatch.setattr("certify.loop.plants.get_system", lambda _: steps)
    listed = run(capsys, "systems")[1]
    assert "  theta+ = theta\n" in listed and "theta' =" not in listed


@pytest.mark.parametrize(
    ("rate", "u_eq", "said"),
    [
        ("u - 1/3", '"1/3"', "f(x_eq, u_eq) = 0 open loop"),
        (
            "u - 1/3",
            "0.3333333333333",
            "f(x_eq, u_eq) = 0 within rounding, not exactly: the largest residual is 3.3e-14",
        ),
        (
            "6*tan(u) - 1",
            "0.16514867741462683",
            "= 0 within rounding, not exactly: the largest residual is 0 in floats",
        ),
        ("u - 1/3", "0.33", "no equilibrium: x' = -0.00333333 at (x_eq, u_eq) open loop"),
    ],
)
def test_plant_says_how_far_it_is_from_rest(
    rate: str, u_eq: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plant = tmp_path / "s.toml"
    plant.write_text(
        f'name = "s"\nstates = ["x"]\ninputs = ["u"]\n[dynamics]\nx = "{rate}"\n[u_eq]\nu = {u_eq}\n'
        "[domain]\nx = [-1, 1]\n[input_bounds]\nu = [-2, 2]\n"
    )
    assert said in " ".join(run(capsys, "plant", plant)[1].split())


CLOCKED = """
name = "clocked"
time = "continuous"
states = ["x", "t"]
inputs = ["u"]
[dynamics]
x = "u - sin(x)"
t = "1/10"
[u_eq]
u = 0
[domain]
x = [-1, 1]
t = [-0.1, 2]
[input_bounds]
u = [-2, 2]
"""


@pytest.mark.parametrize(
    ("changed", "status", "said"),
    [
        (
            {},
            0,
            "f(x_eq, u_eq) = 0; but t' = 0.1 whatever states and inputs are: certify reach --target and certify roa",
        ),
        (
            {"continuous": "discrete", '"1/10"': '"t + 1/10"', "u - sin": "x + u - sin"},
            0,
            "but t moves by 0.1 whatever",
        ),
        ({"u = 0\n": "u = 0.1\n"}, 2, "no equilibrium: x' = 0.1 at (x_eq, u_eq); but t' = 0.1 whatever states"),
        ({'"1/10"': '"1/10 + x"'}, 2, "no equilibrium: t' = 0.1 at (x_eq, u_eq) open loop"),
        ({"[u_eq]": "[x_eq]\nx = 0\nt = 1\n[u_eq]"}, 0, "= 0; but t' = 0.1 whatever"),
    ],
)
def test_a_plant_with_a_clock_never_rests(
    changed: dict[str, str], status: int, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text, plant = CLOCKED, tmp_path / "clocked.toml"
    for old, new in changed.items():
        text = text.replace(old, new)
    plant.write_text(text)
    found, out, err = run(capsys, "plant", plant)
    assert found == status and said in " ".join(out.split())
    assert ("reach --target and certify roa --claim invariant need no equilibrium" in err) is bool(status)


def test_plants_list_disturbances_and_ranges(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "s.toml").write_text(RANGED.format(wind="[-0.1, 0.2]"))
    status, out, _ = run(capsys, "plant", tmp_path / "s.toml", "--param", "k=0.5..1.5")
    said = " ".join(out.split())
    assert status == 0
    assert "k 1 0.5 1.5" in said and "wind -0.1 0.2" in said
    assert "uncertain wind, k: any value in their ranges, at any time; A, B at nominal ones" in said
    data = json.loads(run(capsys, "plant", tmp_path / "s.toml", "--json")[1])
    assert data["disturbances"] == ["wind"] and data["ranges"] == {"wind": ["-1/10", "1/5"]}
    ranged = tmp_path / "ranged.toml"
    ranged.write_text((tmp_path / "s.toml").read_text().replace("k = 1", "k = [0.5, 1.5]"))
    exact = json.loads(run(capsys, "plant", ranged, "--param", "k=1.2", "--json")[1])
    assert exact["parameters"]["k"] == "6/5" and list(exact["ranges"]) == ["wind"]
    exact = " ".join(run(capsys, "plant", "pendulum")[1].split())
    assert "torque N m 0 0" in exact and "uncertain" not in exact
    listed = run(capsys, "systems")[1]
    assert "  disturbance torque N m, 0 unless asked for" in listed
    known = json.loads(run(capsys, "systems", "--json")[1])["systems"]
    assert all(s["disturbances"] and s["ranges"] == {} for s in known)


@pytest.mark.parametrize("watch", ["", "sys.setprofile(lambda *_: None); "])
@pytest.mark.parametrize(
    ("arguments", "status", "said"),
    [(["--help"], 0, "float-error"), (["systems", "--json"], 0, "}}]}\n"), (["prove"], 2, "No such command")],
)
def test_a_command_that_ends_at_once_has_said_everything(
    watch: str, arguments: list[str], status: int, said: str
) -> None:
    """Into a pipe, which is not flushed line by line; what is left for the end is done, and a profiler sees the end."""
    code = (
        "import atexit, sys; from certify.cli.main import main\n"
        "atexit.register(lambda: sys.stderr.write('left\\n'))\n"
        f"{watch}\n"
        "try:\n    main()\nfinally:\n    sys.stderr.write('ended\\n')"
    )
    done = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=False)
    assert done.returncode == status and said in done.stdout + done.stderr
    assert done.stderr.endswith("ended\nleft\n" if watch else "left\n")
    assert watch or "ended" not in done.stderr


@pytest.mark.parametrize(
    ("command", "both"),
    slow_after(
        5,
        [
            ("certify roa --policy {policy} --out {out}", True),
            ("certify roa --policy nosuch.pt", False),
            ("certify prove", True),
            ("certify roa --help", True),
            ("controllers train pendulum --no-such", False),
            ("certify roa --policy {policy} --out {out}", False),
            ("controllers evaluate nosuch.pt --json", True),
            ("controllers train --help", True),
        ],
    ),
)
def test_a_closed_pipe_is_no_verdict_whatever_was_to_be_said(command: str, both: bool, tmp_path: Path) -> None:
    """Standard error goes into a pipe that nobody reads, with standard output or without it."""
    name, *arguments = command.format(policy=SHIPPED, out=tmp_path / "o").split()
    reading, writing = os.pipe()
    os.close(reading)
    code = f"from {'certify.cli.main' if name == 'certify' else 'controllers.cli'} import main; main()"
    out = writing if both else subprocess.DEVNULL
    done = subprocess.run([sys.executable, "-c", code, *arguments], stdout=out, stderr=writing, check=False)
    os.close(writing)
    assert done.returncode == 141


def test_every_stage_has_a_line_of_progress():
    """One without ended a run with an internal error, if it began when a line was due."""
    for stage in get_args(StageName):
        line = ProgressLine()
        line.last = -math.inf
        line(stage, None)


def test_the_line_of_progress_is_true_of_a_pass_inwards_and_of_nearly_all() -> None:
    """A floor is looked for from above; and a share is not rounded up to all."""
    down = Progress(8.463e-11, 6.612e-14, 900, 3, 1 - 1e-9, None, "lyapunov", down=True)
    said = ring_line("ring", down)
    assert "down to V = 8.463e-11, the aim is 6.612e-14 (99.9 % of the volume)" in said
    assert "to V = 0.5 of 1 (50.0 % of the volume)" in ring_line("ring", Progress(0.5, 1.0, 9, 3, 0.5, None, "x"))
    assert "100.0 %" in ring_line("ring", Progress(1.0, 1.0, 9, 0, 1.0, None, "x"))
    assert "beyond the ellipsoid: proved to N = 0.5 of 1" in ring_line("outer", Progress(0.5, 1.0, 9, 3, 0.5, None))


def test_every_stage_has_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    """A stage that a slow machine leaves waiting is named, whichever it is."""
    for stage in get_args(StageName):
        line = ProgressLine()
        line.last -= 60
        line(stage, None)
        line.close()
        assert capsys.readouterr().err.strip()
