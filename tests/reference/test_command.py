"""`python -I -m certify.reference FILE`: what is printed, the exit status, and files that are no certificates."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from certify.reference import __main__ as command
from certify.reference.rules import judge
from tests.checker.test_rules import honest as of_version_3
from tests.reference.test_practical import scalar
from tests.support.balls import with_ball
from tests.support.certificates import Document, dump, edited, write
from tests.support.marks import slow_after

TRUSTED = {"kind": "trusted-solver", "solver": "dReal", "version": "4", "precision": (0.5).hex(), "queries": []}
KEYS = [
    "result",
    "rule",
    "at",
    "detail",
    "claim",
    "rate",
    "sample",
    "discrete",
    "certificate_sha256",
    "policy_sha256",
    "origin",
    "levels",
    "start",
    "centre",
    "time",
    "leaves",
    "seconds",
    "text",
]


def honest(name: str) -> Document:
    return with_ball(of_version_3(name))


def run(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-I", "-m", "certify.reference", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)


def test_accepted(tmp_path: Path) -> None:
    path = write(honest("rotor"), tmp_path)
    done, sha256 = run(path), hashlib.sha256(path.read_bytes()).hexdigest()
    claim, verdict = done.stdout.splitlines()
    assert done.returncode == 0 and not done.stderr
    assert claim.startswith("claim: ") and "converges to the origin" in claim
    assert verdict.startswith("ACCEPTED c1=") and verdict.endswith(f"sha256={sha256}")


def test_practical_in_words(tmp_path: Path) -> None:
    done = run(write(scalar(["-", "x"]), tmp_path))
    claim, verdict = done.stdout.splitlines()
    assert done.returncode == 0 and "enters V <= 0.04 in finite time" in claim
    assert verdict.startswith("ACCEPTED c0=0.04 c1=0.04 c2=1.0 sha256=")


def test_rejected_and_trusted(tmp_path: Path) -> None:
    done = run(write(edited(honest("scalar"), "levels.local", (0.0).hex()), tmp_path))
    assert done.returncode == 1 and done.stdout.splitlines()[-1].startswith("REJECTED rule=levels at=levels: ")
    done = run(write(edited(honest("scalar"), "evidence", TRUSTED), tmp_path))
    assert done.returncode == 3 and done.stdout.splitlines()[-1].startswith("TRUSTED c1=")
    assert "dReal 4" in done.stdout


@pytest.mark.parametrize(
    ("path", "value", "status", "result", "rule"),
    [
        ("provenance", {}, 0, "ACCEPTED", None),
        ("levels.local", (0.0).hex(), 1, "REJECTED", "levels"),
        ("policy.sha256", "0", 1, "REJECTED", "hash"),
        ("evidence", TRUSTED, 3, "TRUSTED", None),
    ],
)
def test_json(tmp_path: Path, path: str, value: Any, status: int, result: str, rule: str | None) -> None:
    file = write(edited(honest("scalar"), path, value), tmp_path)
    done = run(file, "--json")
    said = json.loads(done.stdout)
    assert done.returncode == status and not done.stderr and list(said) == KEYS
    assert (said["result"], said["rule"]) == (result, rule)
    assert said["certificate_sha256"] == hashlib.sha256(file.read_bytes()).hexdigest()
    assert said["seconds"]["check"] > 0
    if rule != "hash":
        assert set(said["levels"]) == {"local", "roa"} and len(said["policy_sha256"]) == 64
        assert (said["leaves"] is not None) == (result == "ACCEPTED")
        assert (said["rate"], said["sample"], said["discrete"]) == (0.0, None, False)


@pytest.mark.parametrize("json_too", slow_after(1, [False, True]))
def test_files_that_cannot_be_read(tmp_path: Path, json_too: bool) -> None:
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    for path in (tmp_path, tmp_path / "absent", fifo, Path("/dev/null"), tmp_path / ("x" * 300), tmp_path / "\u00e9"):
        done = run(path, *(["--json"] if json_too else []))
        assert done.returncode == 2, path
        if json_too:
            assert "cannot be read" in json.loads(done.stdout)["error"] and not done.stderr
        else:
            assert not done.stdout and done.stderr.count("\n") == 1 and "cannot be read" in done.stderr


def test_usage() -> None:
    for arguments in ((), ("a", "b"), ("--fast", "a"), *(("--seconds", k, "a") for k in ("-1", "0", "1" * 30))):
        assert run(*arguments).returncode == 2
        done = run(*arguments, "--json")
        assert done.returncode == 2 and list(json.loads(done.stdout)) == ["error"]


def test_a_file_that_is_too_large(tmp_path: Path) -> None:
    path = tmp_path / "large"
    with path.open("wb") as stream:
        stream.truncate(2**28 + 1)  # sparse
    done = run(path)
    assert done.returncode == 1 and done.stdout.startswith("REJECTED rule=format at=file: larger than")


def test_an_internal_error_is_no_verdict(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capfd: Any) -> None:
    def broken(raw: bytes, jobs: int) -> None:
        raise ZeroDivisionError("nobody expected that")

    monkeypatch.setattr(command, "judge", broken)
    path = str(write(honest("scalar"), tmp_path))
    assert command.main([path]) == 70 and command.main([path, "--json"]) == 70
    out, err = capfd.readouterr()
    assert list(json.loads(out)) == ["error"] and "internal error of the reference: ZeroDivisionError" in err


def scalar_with(old: str, new: str) -> bytes:
    return dump(honest("scalar")).decode().replace(old, new, 1).encode()


def noted(text: str) -> bytes:
    """With something more in `provenance`."""
    return scalar_with('"provenance": {', f'"provenance": {{"a": {text}, ')


ODD: dict[str, bytes] = {
    "empty": b"",
    "a list": b"[]",
    "brackets": b"[" * 10**5,
    "many brackets": b"[" * (10**6 + 1),
    "objects": b'{"a":' * 10**5,
    "nested provenance": noted("[" * 5000),
    "commas": b"[" + b"1," * 10**6 + b"1]",
    "not UTF-8": b"\xff\xfe",
    "a mark in front": b"\xef\xbb\xbf" + dump(honest("scalar")),
    "a lone surrogate": scalar_with('"plant"', '"\\ud800"'),
    "a key twice": noted('1, "a": 2'),
    "a huge exponent": noted("1e999999999"),
    "not a number": noted("NaN"),
    "a long integer": noted("1" * 5000),
    "16 MiB, not ASCII": scalar_with("written by hand", "\u00e9" + "x" * 2**24),
}


@pytest.mark.parametrize("name", ODD)
def test_odd_bytes_are_refused(name: str) -> None:
    assert judge(ODD[name]).rule == "format"


def nested(depth: int) -> Any:
    """Powers of powers: a number that no memory holds, in few bytes."""
    node: Any = ["+", "x", "2"]
    for _ in range(depth):
        node = ["**", node, 64]
    return node


HUGE: dict[str, tuple[Any, str]] = {
    "a power of powers": (nested(150), "equilibrium"),
    "0 times it": (["*", "0", nested(150)], "equilibrium"),
    "its inverse": (["/", "1", nested(150)], "equilibrium"),
    "a sine of something huge": (["*", "x", ["sin", ["*", "9" * 1201, ["**", "x", 64]]]], "local"),
    "1 / (x - 0)": (["*", "x", ["/", "x", "x"]], "equilibrium"),
}


@pytest.mark.parametrize("name", HUGE)
def test_huge_numbers_end_in_a_refusal(name: str) -> None:
    node, rule = HUGE[name]
    data = edited(honest("scalar"), "plant.dynamics", [node])
    assert judge(dump(data)).rule == rule


@pytest.mark.parametrize("value", ["-0x0.0p+0", "0x0.0p+0", "nan", "inf", "-inf", "0x1p9999", "1e3", "0x1.0p0"])
def test_odd_levels(value: str) -> None:
    for name in ("local", "roa"):
        rule = judge(dump(edited(honest("scalar"), f"levels.{name}", value))).rule
        assert rule == ("levels" if value.endswith("0x0.0p+0") else "format")
