"""`certify compose`: what it prints, exit statuses, files, and what cannot be joined."""

from __future__ import annotations

import html
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from certify.certificates import parse_certificate
from certify.certificates.handover import share
from certify.cli.main import _run
from certify.loop.policies import Policy, save_policy
from tests.checker.test_handover import dumped, ellipsoids, far, near, of_forms
from tests.support.certificates import Document, edited


@pytest.fixture
def two(tmp_path: Path) -> list[str]:
    paths = [tmp_path / "outer.json", tmp_path / "inner.json"]
    for path, data in zip(paths, (far(), near()), strict=True):
        path.write_bytes(dumped(data))
    return ["compose", *map(str, paths), "--out", str(tmp_path / "out")]


def changed(place: str, path: str, value: Any) -> None:
    data: Document = json.loads(Path(place).read_bytes())
    Path(place).write_bytes(dumped(edited(data, path, value)))


def test_two_are_joined(two: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert _run([*two, "--json"], True) == 0
    data = json.loads(capsys.readouterr().out)
    assert (data["verdict"], data["checked"], data["reference"]) == ("PROVED", "ACCEPTED", "ACCEPTED")
    assert data["claim"] == {"kind": "practical", "then": {"kind": "asymptotic"}} and 0.79 < data["share"] < 0.81
    page = (tmp_path / "out" / "report.html").read_text("utf-8")
    assert "A second claim takes over there" in page and "That is all" not in page
    assert "converges to the origin, which is asymptotically stable" in page
    assert "the second claim's set" in html.unescape(page)
    certificate = str(tmp_path / "out" / "certificate.json")
    for options in ([], ["--reference"]):
        assert _run(["check", certificate, *options], False) == 0
    assert "of every plant that is one of the certificate above" in capsys.readouterr().out


def test_a_policy_file_is_compared_with_both(
    two: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The second claim's domain is wider than the box in which the policy file's numbers are its origin's."""
    Path(two[2]).write_bytes(dumped(near(domain=[("-4", "4")])))
    assert _run(two, False) == 0
    certificate, policy = str(tmp_path / "out" / "certificate.json"), str(tmp_path / "policy.pt")
    network = parse_certificate(Path(certificate).read_bytes(), "").network
    for half, said in (
        (4.0, "ACCEPTED"),
        (3.5, "of the claim that takes over, the certificate's domain of x must lie in"),
    ):
        save_policy(policy, Policy(network, "plant", valid=np.array([[-half, half]])))
        capsys.readouterr()
        assert _run(["check", certificate, "--policy", policy], False) == (0 if half == 4 else 1)
        assert said in capsys.readouterr().out


def test_the_words_of_the_terminal(two: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert _run(two, False) == 0
    said = capsys.readouterr().out
    assert said.startswith("PROVED  plant: of every plant that is one of both, every trajectory from {V <= 1} enters ")
    assert "checker      ACCEPTED, reference ACCEPTED" in said


def test_the_file_is_read_and_written_as_it_is(two: list[str], tmp_path: Path) -> None:
    _run(two, False)
    raw = (tmp_path / "out" / "certificate.json").read_bytes()
    read = parse_certificate(raw, "")
    assert read.then is not None and read.then.kind == "asymptotic"
    again = json.loads(replace(read, provenance={}).to_json())
    stated = json.loads(raw)
    assert {k: v for k, v in again["then"].items() if k != "provenance"} == {
        k: v for k, v in stated["then"].items() if k != "provenance"
    }


def test_a_floor_that_is_too_high_is_unknown(
    two: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    changed(two[2], "levels.roa", (0.06).hex())
    assert _run(two, False) == 3
    assert "reaches 1.333 times the level" in capsys.readouterr().out and not (tmp_path / "out").exists()


def test_a_false_part_is_not_proved(two: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The second certificate is about a plant that is not attracted: the checker says so, and no file is left."""
    changed(two[2], "plant.uncertain.0.range", ["-11/10", "1"])
    assert _run(two, False) == 3
    assert "the checker refuses it under rule local at then." in capsys.readouterr().out
    assert not list((tmp_path / "out").iterdir())


@pytest.mark.parametrize(
    ("at", "path", "value", "named"),
    [
        (2, "plant.u_eq", ["1/8"], "u_eq"),
        (2, "claim.sample", ["1/10", "1/10"], "sample time"),
        (2, "policy.squash", "identity", "policy"),
        (2, "provenance", {"x_eq": {"x": "1"}}, "operating point"),
    ],
)
def test_loops_that_differ(
    two: list[str], capsys: pytest.CaptureFixture[str], at: int, path: str, value: Any, named: str
) -> None:
    changed(two[at], path, value)
    assert _run(two, False) == 2
    assert f"they differ in {named}" in capsys.readouterr().err


def test_the_order_of_the_two(two: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert _run(["compose", two[2], two[1]], False) == 2
    assert "the first certificate must have a practical claim" in capsys.readouterr().err
    assert _run(["compose", two[1], two[1]], False) == 2
    assert "in the order OUTER INNER" in capsys.readouterr().err
    assert _run(two, False) == 0
    assert _run(["compose", str(tmp_path / "out" / "certificate.json"), two[2]], False) == 2
    assert "takes over already" in capsys.readouterr().err


@pytest.mark.parametrize("seed", range(20))
def test_the_share_is_the_largest_value_on_the_floor(seed: int) -> None:
    P, other, floor = ellipsoids(seed)
    read = parse_certificate(dumped(of_forms(P, other, floor, 2.0)), "")
    assert read.then is not None
    found = share(read, read.then)
    directions = np.random.default_rng(seed).normal(size=(20_000, len(P)))
    points = directions * np.sqrt(floor / np.einsum("ki,ij,kj->k", directions, P, directions))[:, None]
    sampled = np.einsum("ki,ij,kj->k", points, other, points).max() / 2
    assert sampled * (1 - 1e-9) <= found <= 1.1 * sampled + 1e-9
