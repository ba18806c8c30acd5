"""Sweeps: the study's file, cases and their identity, what a worker is believed, resuming, tables, places to work."""

from __future__ import annotations

import csv
import hashlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import replace
from fractions import Fraction
from itertools import product
from multiprocessing import forkserver
from pathlib import Path
from typing import Any

import pyarrow.parquet
import pytest

from certify.analysis.facts import Levels
from certify.analysis.studies import Row, Study, read_study, run_sweep
from certify.analysis.studies import sweep as flow
from certify.analysis.studies.judging import judged, kept
from certify.analysis.studies.page import page_of
from certify.analysis.studies.study import Axis, plain
from certify.analysis.studies.tables import names, write_tables
from certify.analysis.studies.work import Answer, answer_in, work
from certify.certificates import parse_certificate
from certify.certificates.verdict import Verdict
from certify.cli.main import _run
from certify.errors import BackendError, InputError, SoundnessError
from certify.loop.plants import exact
from certify.lyapunov import volume
from certify.provers.execution import tasks
from certify.provers.execution.tasks import Cluster, Piece, Processes, place_for
from tests.support import pieces
from tests.support.browser import Browser, find_browser
from tests.support.pieces import Here

ROOT = Path(__file__).parent.parent.parent
POLICIES = ROOT / "examples" / "policies"
QUICK = f"""
policies = ["{POLICIES}/pendulum.pt"]
candidates = ["lyapunov"]
[parameters]
m = [0.15, 0.2]
[options]
level = 0.3
effort = 0.6
"""


def written(folder: Path, text: str, name: str = "study.toml") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


@pytest.fixture
def study(tmp_path: Path) -> Study:
    return read_study(written(tmp_path, QUICK))


# The file


def test_a_study_crosses_exact_values(tmp_path: Path) -> None:
    text = f"""
    policies = ["{POLICIES}/pendulum.pt"]
    candidates = ["lyapunov", "lqr"]
    [parameters]
    m = [0.1, "3/20", 0.2]
    b = {{ from = 0, to = "1", points = 4 }}
    g = "9.8..9.82"
    [domain]
    theta = ["1.5", "-1:2"]
    [options]
    Q = "1,2"
    enlarge = false
    """
    study = read_study(written(tmp_path, text))
    axes = {axis.key: axis for axis in study.axes}
    assert axes["parameters.m"].values == ("0.1", "0.15", "0.2")
    assert [exact(v) for v in axes["parameters.b"].values] == [0, Fraction(1, 3), Fraction(2, 3), 1]
    assert axes["parameters.g"].values == ("9.8..9.82",) and axes["domain.theta"].values == ("1.5", "-1:2")
    assert axes["options.enlarge"].values == ("false",) and not axes["options.Q"].listed
    cases = study.cases()
    assert len(cases) == 2 * 3 * 4 * 2 == len({case.name for case in cases})
    assert [c.coordinates["domain.theta"] for c in cases[:3]] == ["1.5", "-1:2", "1.5"]  # the last entry fastest
    for case in (cases[0], cases[-1]):
        stored, plant, options = case.loop(tmp_path, lambda _: None)
        assert plant.parameters["m"] == exact(case.coordinates["parameters.m"])
        assert plant.ranges["g"] == (Fraction(98, 10), Fraction(982, 100))
        assert options.Q == (1.0, 2.0) and options.candidate == case.coordinates["candidates"] and stored.network
    assert cases[-1].loop(tmp_path, lambda _: None)[1].domain[0] == (-1, 2)
    assert cases[0].loop(tmp_path, lambda _: None)[1].domain[0] == (Fraction(-3, 2), Fraction(3, 2))


def test_text_says_a_number_without_rounding() -> None:
    for q in (Fraction(1, 3), Fraction(1, 10), Fraction(-7), Fraction(1, 10**9), Fraction(10**400), Fraction(1, 2**60)):
        assert exact(plain(q)) == q


@pytest.mark.parametrize(
    ("change", "line", "message"),
    [
        ("policy = 1", 2, "unknown keys are refused: 'policy' is none of a study's; did you mean 'policies'?"),
        ("systems = ['pendulun']", 2, "there is no plant 'pendulun'; did you mean 'pendulum',"),
        ("systems = ['plants.py:plant']", 2, "there is no plant 'plants.py:plant'"),
        ("systems = ['none.toml']", 2, "none.toml cannot be read"),
        ("systems = []", 2, "must be text, or a list of texts"),
        ("candidates = ['best']", 2, "`candidate` must be one of"),
        ("candidates = ['lqr', 'lqr']", 2, "each value must be there once; found lqr twice"),
        ("[parameters]\nmass = 1", 3, "'mass' is no parameter of pendulum; known are m, l, b, g"),
        ("[parameters]\nm = [0.1, 0.10]", 3, "each value must be there once; found 0.1 twice"),
        ("[parameters]\nm = [0.1, '1/10']", 3, "each value must be there once; found 0.1 twice"),
        ("[parameters]\nm = []", 3, "a list must have at least one value"),
        ("[parameters]\nm = 'heavy'", 3, "`m` must be a finite number"),
        ("[parameters]\nm = '0.1..0.2..0.3'", 3, "must be a number, or an interval LO..HI"),
        ("[parameters]\nm = [[0.1]]", 3, "must be a number, text, a list of these"),
        ("[parameters]\nm = { from = 0.1, to = 0.2 }", 3, "a range must be { from = 0.1"),
        ("[parameters]\nm = { from = 0.1, to = 0.2, points = 1 }", 3, "`points` must be a whole number from 2"),
        ("[parameters]\nm = { from = 0.1, to = 0.2, points = 3.0 }", 3, "`points` must be a whole number from 2"),
        ("[parameters]\nm = { from = 0.1, to = 0.1, points = 3 }", 3, "each value must be there once"),
        ("[parameters]\nm = nan", 3, "must be a finite decimal"),
        ("[disturbances]\nwind = 1", 3, "'wind' is no disturbance of pendulum"),
        ("[domain]\nx = 1", 3, "'x' is no state of pendulum"),
        ("[options]\ntimelimit = 1", 3, "'timelimit' is no option of a study; did you mean 'time_limit'?"),
        ("[options]\ncandidate = 'lqr'", 3, "candidates stand at the top"),
        ("[options]\nclaim = 'stable'", 3, "`claim` must be one of"),
        ("[options]\ntime_limit = 0", 3, "must be positive"),
        ("[options]\nseed = 0.5", 3, "`seed` must be a whole number"),
        ("[options]\nenlarge = 1", 3, "`enlarge` must be true or false"),
        ("[options]\nsample_time = 'max'", 3, "`sample_time` must be a finite number"),
        ("[options]\nlyapunov = 'none.pt'", 3, "none.pt cannot be read"),
        (
            "[options]\nrate = { from = 0, to = 1, points = 10000 }\nseed = [0,1,2,3,4,5,6,7,8,9,10]",
            None,
            "at most 100,",
        ),
        ("options = 1", 2, "must be a table"),
    ],
)
def test_a_slip_in_a_study_is_named_with_its_line(tmp_path: Path, change: str, line: int | None, message: str) -> None:
    path = written(tmp_path, f'policies = "{POLICIES}/pendulum.pt"\n{change}\n')
    with pytest.raises(InputError) as error:
        read_study(path)
    assert message in str(error.value)
    assert str(path) in str(error.value) and (line is None or f"line {line}" in str(error.value))


def test_a_study_needs_policies_that_are_there(tmp_path: Path) -> None:
    for text, message in (
        ("candidates = ['lqr']", "a study must have policies"),
        ("policies = ['*.pt']", "none matches '*.pt'"),
        ("policies = ['gone.pt']", "gone.pt cannot be read"),
        ("policies = [", "is not valid TOML"),
    ):
        with pytest.raises(InputError, match=re.escape(message)):
            read_study(written(tmp_path, text))
    (tmp_path / "a.pt").write_bytes(b"no policy")  # a case that fails, no study that does
    assert read_study(written(tmp_path, "policies = ['*.pt']")).cases()[0].name == "a"
    with pytest.raises(InputError, match=r"found a\.pt twice"):
        read_study(written(tmp_path, "policies = ['a.pt', '*.pt']"))


def test_names_of_cases_are_readable_stable_and_safe(tmp_path: Path) -> None:
    def found(text: str) -> list[str]:
        return [
            case.name for case in read_study(written(tmp_path, f'policies = "{POLICIES}/pendulum.pt"\n{text}')).cases()
        ]

    assert found("[parameters]\nm = [0.1]\nb = 0.2") == ["pendulum_m=0.1"]  # what is given once is no part of it
    assert found("candidates = ['lqr']\n[parameters]\nm = [0.1, 0.2]") == ["pendulum_m=0.1_lqr", "pendulum_m=0.2_lqr"]
    thirds = found("[parameters]\nm = { from = 1, to = 2, points = 4 }")
    assert thirds[0] == "pendulum_m=1" and re.fullmatch(r"pendulum_m=4-3-[0-9a-f]{8}", thirds[1])
    assert thirds[1] in found("[parameters]\nm = ['4/3', 7]")
    odd = found("[options]\nbox = ['theta=1', 'theta=2']\nQ = ['1,1', '2,1']")
    assert len(set(odd)) == 4 and not any(re.search(r"[^\w.,=+-]", name) for name in odd)
    long = found("[options]\nbox = ['" + ",".join(f"theta={k}" for k in range(40)) + "']")[0]
    assert len(long) < 120
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "x.pt").write_bytes(b"")
    both = [case.name for case in read_study(written(tmp_path, "policies = '*/x.pt'")).cases()]
    assert len(set(both)) == 2 and all("/" not in name for name in both)


def test_a_case_is_the_same_if_bytes_texts_and_program_are(study: Study, monkeypatch: pytest.MonkeyPatch) -> None:
    case = study.cases()[0]
    moved = replace(case, policy=replace(case.policy, name="other.pt"))
    assert replace(moved, coordinates={**case.coordinates, "policies": "other.pt"}).inputs == case.inputs
    others = [
        study.cases()[1],
        replace(case, policy=replace(case.policy, content=case.policy.content + b" ")),
        replace(case, plant="pendulum"),
        replace(case, plant=replace(case.policy, content=b"name = 'pendulum'")),
        replace(case, lyapunov=case.policy),
        replace(case, coordinates={**case.coordinates, "options.level": "0.31"}),
        replace(case, coordinates={**case.coordinates, "options.effort": "0.62"}),
        replace(case, coordinates={**case.coordinates, "candidates": "lqr"}),
    ]
    assert len({case.inputs, *(other.inputs for other in others)}) == 1 + len(others)
    from certify.analysis.studies import case as module

    monkeypatch.setattr(module, "_program", lambda: {"certify": "another"})
    assert study.cases()[0].inputs != others[0].inputs and replace(case).inputs not in {o.inputs for o in others}


# What a worker is believed


@pytest.fixture(scope="module")
def sent(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """What the work of both cases of the quick study gives, done in this process."""
    read = read_study(written(tmp_path_factory.mktemp("study"), QUICK))
    return {case.name: work(case) for case in read.cases()}


@pytest.fixture
def answer(study: Study, sent: dict[str, bytes]) -> Answer:
    return answer_in(sent[study.cases()[0].name])


def test_a_set_around_another_point_is_of_the_case_if_its_loop_is(tmp_path: Path) -> None:
    """The policy's hash is the same: plant and origin have to move together, and not where the origin was asked for."""
    text = f"""
    policies = ["{POLICIES}/without_gain/pendulum.pt"]
    candidates = ["lqr"]
    [options]
    around = ["auto", "origin"]
    """
    auto, origin = read_study(written(tmp_path, text)).cases()
    answer = answer_in(work(auto))
    row = judged(auto, answer, tmp_path, own=True)
    certificate = parse_certificate(answer.raw or b"", "it")
    assert row.verdict is Verdict.PROVED and row.claim == "nearby" and certificate.network.is_moved
    assert judged(origin, answer, tmp_path, own=False).verdict is Verdict.UNKNOWN
    at = replace(certificate.network, origin=certificate.network.origin + 0.25)
    forged = replace(answer, raw=replace(certificate, network=at).to_json().encode())
    assert "section `plant`" in str(judged(auto, forged, tmp_path, own=False).error)


def test_an_honest_answer_is_a_row_about_the_file_that_was_checked(
    study: Study, answer: Answer, tmp_path: Path
) -> None:
    case = study.cases()[0]
    row = judged(case, answer, tmp_path, own=True)
    raw = (tmp_path / str(row.certificate)).read_bytes()
    certificate = parse_certificate(raw, "it")
    assert row.verdict is Verdict.PROVED and row.checked == "ACCEPTED" and row.stop == "requested"
    assert hashlib.sha256(raw).hexdigest() == row.certificate_sha256 and row.levels.roa == 0.3 == certificate.roa
    assert row.volume == volume(certificate.P, certificate.roa) and row.volume_unit == "rad · rad/s"
    assert row.claim == "asymptotic" and row.units["m"] == "kg" and row.states == ("theta", "theta_dot")
    assert (row.seconds or 0) > 0 and not row.error


def test_numbers_of_the_set_are_the_certificate_s_whatever_a_worker_says(
    study: Study, answer: Answer, tmp_path: Path
) -> None:
    honest = judged(study.cases()[0], answer, tmp_path, own=True)
    lies = {"volume": 1e9, "semi_axes": [1e9], "claim": {"kind": "nearby"}, "checked": "ACCEPTED", "certificate": "/x"}
    lies["levels"] = {**answer.data["levels"], "roa": 1e9, "local": 1e9, "floor": 1.0}
    row = judged(study.cases()[0], replace(answer, data={**answer.data, **lies}), tmp_path, own=False)
    assert row == honest


def edited(raw: bytes, change: Callable[[dict[str, Any]], None]) -> bytes:
    data = json.loads(raw)
    change(data)
    return json.dumps(data).encode()


def _higher(data: dict[str, Any]) -> None:
    data["levels"]["roa"] = (0.9).hex()


def _no_tree(data: dict[str, Any]) -> None:
    data["evidence"]["tree"] = ""


def _wider(data: dict[str, Any]) -> None:
    data["plant"]["input_bounds"] = [["-60", "60"]]


def _renamed(data: dict[str, Any]) -> None:
    data["policy"]["sha256"] = "0" * 64


def _held(data: dict[str, Any]) -> None:
    data["claim"]["sample"] = ["1/100", "1/100"]


@pytest.mark.parametrize("change", [_higher, _no_tree, _wider, _renamed, _held])
def test_a_forged_certificate_is_refused_and_gets_no_name(
    study: Study, answer: Answer, tmp_path: Path, change: Callable[[dict[str, Any]], None]
) -> None:
    forged = replace(answer, raw=edited(answer.raw or b"", change))
    row = judged(study.cases()[0], forged, tmp_path, own=False)
    assert row.verdict is Verdict.UNKNOWN and row.failed and "refused here" in row.error
    assert row.certificate is None and row.volume is None and not list(tmp_path.rglob("*.json"))
    with pytest.raises(SoundnessError, match=r"pendulum_m=0\.15_lyapunov"):
        judged(study.cases()[0], forged, tmp_path, own=True)


def test_an_accepted_certificate_of_another_case_is_refused(
    study: Study, sent: dict[str, bytes], tmp_path: Path
) -> None:
    """The mass is another: the checker accepts the file, which is not about this case."""
    mine, other = study.cases()
    row = judged(mine, answer_in(sent[other.name]), tmp_path, own=False)
    assert row.failed and "section `plant` is not that of this case" in row.error
    assert judged(other, answer_in(sent[other.name]), tmp_path, own=False).verdict is Verdict.PROVED


@pytest.mark.parametrize(
    ("key", "text", "name"),
    [
        ("options.level", "0.4", "level"),
        ("options.rate", "0.1", "rate"),
        ("options.lyapunov_level", "1", "lyapunov_level"),
    ],
)
def test_a_certificate_that_claims_less_than_was_asked_is_refused(
    study: Study, answer: Answer, tmp_path: Path, key: str, text: str, name: str
) -> None:
    case = study.cases()[0]
    asked = replace(case, coordinates={**case.coordinates, key: text})
    row = judged(asked, answer, tmp_path, own=False)
    assert row.failed and re.search(rf"less than was asked for: {name}\b", row.error)


def test_words_without_evidence_prove_nothing(study: Study, answer: Answer, tmp_path: Path) -> None:
    case = study.cases()[0]
    for given in (
        replace(answer, raw=None),
        replace(answer, raw=b"{}"),
        replace(answer, raw=b"\xff"),
        replace(answer, data={**answer.data, "verdict": "TRUSTED"}),  # the checker accepts, and is not believed either
        replace(answer, data={**answer.data, "verdict": "CERTAIN"}),
        replace(answer, data={}),
        replace(answer, data={**answer.data, "boxes": None}),
        replace(answer, data={**answer.data, "reason": 3}),
    ):
        row = judged(case, given, tmp_path, own=False)
        assert row.verdict is Verdict.UNKNOWN and row.failed and row.volume is None, given.data.get("verdict")
    for garbage in (b"", b"[]", b"{}", b"\x80\x04N.", b'{"kind": "proved", "notices": [], "files": {}}', b"[" * 10**5):
        with pytest.raises(InputError, match="is no answer"):
            answer_in(garbage)


def _endless(data: dict[str, Any]) -> None:
    data["lyapunov"]["P"] = "AAAA8H8AAAAAAADwfwAAAAAAAPB/AAAAAAAA8H8="  # infinities


def _nested(data: dict[str, Any]) -> None:
    for _ in range(400):
        data["plant"]["dynamics"][0] = ["-", data["plant"]["dynamics"][0]]


def _other_kind(data: dict[str, Any]) -> None:
    data["evidence"] = {"kind": "trusted-solver", "solver": "x", "version": "1", "precision": "0x1p-1", "queries": []}


def _by_zero(data: dict[str, Any]) -> None:
    data["plant"]["u_eq"] = ["1/0"]


@pytest.mark.parametrize("change", [_endless, _nested, _other_kind, _by_zero])
def test_a_file_that_is_made_to_break_the_reader_is_one_case_s_error(
    study: Study, answer: Answer, tmp_path: Path, change: Callable[[dict[str, Any]], None]
) -> None:
    row = judged(study.cases()[0], replace(answer, raw=edited(answer.raw or b"", change)), tmp_path, own=False)
    assert row.failed and row.verdict is Verdict.UNKNOWN and not list(tmp_path.rglob("certificate*"))


def test_a_row_cannot_say_proved_without_a_check() -> None:
    for fields in ({}, {"checked": "REJECTED"}, {"checked": "TRUSTED", "certificate": "x"}, {"checked": "ACCEPTED"}):
        with pytest.raises(InputError, match="must have a certificate that the checker answered"):
            Row("a", {}, "", Verdict.PROVED, "domain", **fields)
    with pytest.raises(InputError, match="has an error where its stop says so"):
        Row("a", {}, "", Verdict.REFUTED, "error", error="no")


def test_an_error_of_a_case_is_its_answer(tmp_path: Path) -> None:
    (tmp_path / "broken.pt").write_bytes(b"no policy")
    text = f"policies = ['broken.pt', '{POLICIES}/pendulum.pt']\n[parameters]\nm = [-1]"
    for case, said in zip(read_study(written(tmp_path, text)).cases(), ("broken.pt", "must be positive"), strict=True):
        answer = answer_in(work(case))
        assert answer.kind == "error" and said in answer.message and "/tmp" not in answer.message


# The sweep


def canned(sent: dict[str, bytes]) -> Here:
    return Here(lambda piece: sent[piece.key])


def test_what_is_done_is_not_done_again_and_what_changed_is(
    study: Study, sent: dict[str, bytes], tmp_path: Path
) -> None:
    out, place = tmp_path / "out", canned(sent)
    seen: list[tuple[str, int, int]] = []
    first = run_sweep(study, out, place, lambda row, done, cases: seen.append((row.case, done, cases)))
    assert first.verdicts == {"PROVED": 2, "TRUSTED": 0, "REFUTED": 0, "UNKNOWN": 0} and first.exit_status == 0
    assert [(done, cases) for _, done, cases in seen] == [(1, 2), (2, 2)] and first.kept == 0
    table = (out / "sweep.csv").read_bytes()
    again = run_sweep(study, out, nothing := Here())
    assert nothing.done == [] and again.kept == 2 and again.rows == first.rows
    assert (out / "sweep.csv").read_bytes() == table

    one, two = (case.name for case in study.cases())
    spoilt: list[tuple[str, Callable[[bytes], bytes]]] = [
        ("row.json", lambda raw: raw.replace(b'"inputs": "', b'"inputs": "0')),
        ("row.json", lambda raw: raw[: len(raw) // 2]),
        ("row.json", lambda raw: raw.replace(b'"ACCEPTED"', b'"REJECTED"')),
        ("row.json", lambda raw: raw.replace(b"certify-sweep-row/2", b"certify-sweep-row/1")),
        ("row.json", lambda raw: raw.replace(b'"boxes"', b'"bxes"')),
        ("row.json", lambda raw: b"[" * 10**5),
        ("row.json", lambda raw: b"\xff"),
        ("certificate.json", lambda raw: raw + b" "),
    ]
    for name, change in spoilt:
        path = out / "cases" / one / name
        right = path.read_bytes()
        path.write_bytes(change(right))
        assert kept(out, study.cases()[0]) is None, change(right)[:80]
        path.write_bytes(right)
    assert kept(out, study.cases()[0]) == first.rows[0]
    (out / "cases" / two / "certificate.json").unlink()
    place = canned(sent)
    assert run_sweep(study, out, place).rows == first.rows and place.done == [two]

    longer = read_study(written(tmp_path, QUICK.replace("[0.15, 0.2]", "[0.1, 0.15, 0.2]")))
    place = Here(lambda piece: "lost")
    assert run_sweep(longer, out, place).errors == 1 and place.done == [longer.cases()[0].name]
    changed = read_study(written(tmp_path, QUICK.replace("effort = 0.6", "effort = 0.62")))
    run_sweep(changed, out, place := Here(lambda piece: "lost"))
    assert place.done == [one, two]
    assert not (out / "cases" / one / "certificate.json").exists()  # of other inputs


def test_a_kept_row_is_believed_only_as_far_as_it_is_found_out_again(
    study: Study, sent: dict[str, bytes], tmp_path: Path
) -> None:
    """Whoever edits what a sweep left, with hashes that fit, gets no line of the table: the case is done again."""
    out = tmp_path / "out"
    first = run_sweep(study, out, canned(sent))
    one, two = study.cases()
    row, certificate = (out / "cases" / one.name / name for name in ("row.json", "certificate.json"))
    right, raw = row.read_bytes(), certificate.read_bytes()
    other = (out / "cases" / two.name / "certificate.json").read_bytes()

    def edited(data: bytes, **change: Any) -> None:
        """Bytes as the certificate, and a row about them."""
        certificate.write_bytes(data)
        said = json.loads(right) | {"certificate_sha256": hashlib.sha256(data).hexdigest()}
        row.write_text(json.dumps(said | change))

    levels = json.loads(right)["levels"]
    edited(raw)
    assert kept(out, one) == first.rows[0]
    larger = raw.replace((0.3).hex().encode(), (0.9).hex().encode())
    assert larger != raw
    lies: list[tuple[bytes, dict[str, Any]]] = [
        (larger, {"levels": levels | {"roa": 0.9}}),
        (other, {}),
        (b"{}", {}),
        *((raw, {"levels": levels | {name: 7.0}}) for name in levels if name != "ultimate"),
        (raw, {"volume": 7.0}),
        (raw, {"extents": [7.0, 7.0]}),
        (raw, {"semi_axes": [7.0, 7.0]}),
        (raw, {"states": ["a", "b"]}),
        (raw, {"units": {}}),
        (raw, {"volume_unit": "m"}),
        (raw, {"claim": "nearby"}),
        (raw, {"verdict": "TRUSTED", "checked": "TRUSTED"}),
        (raw, {"leaves": 7}),
        (raw, {"seconds": "7"}),
        (raw, {"certificate": "cases/elsewhere/certificate.json"}),
        (raw, {"certificate": None, "verdict": "UNKNOWN"}),
        (raw, {"certificate": None, "verdict": "REFUTED", "stop": "witness"}),
    ]
    for data, change in lies:
        edited(data, **change)
        assert kept(out, one) is None, change
    edited(larger, levels=levels | {"roa": 0.9})
    again = run_sweep(study, out, place := canned(sent))
    assert place.done == [one.name] and again.rows == first.rows and certificate.read_bytes() == raw


def test_what_is_not_kept_does_not_lie_where_its_result_is_looked_for(
    study: Study, sent: dict[str, bytes], tmp_path: Path
) -> None:
    """Also where the sweep ends before the case is done; a file that is somebody's own stays."""
    out = tmp_path / "out"
    run_sweep(study, out, canned(sent))
    one, two = (out / "cases" / case.name for case in study.cases())
    (two / "certificate.json").write_text("my own notes")
    (one / "notes.partial").write_text("my own notes")
    changed = read_study(written(tmp_path, QUICK.replace("effort = 0.6", "effort = 0.62")))
    with pytest.raises(BackendError):
        run_sweep(changed, out, Here(lambda piece: BackendError("gone")))
    assert sorted(path.name for path in one.iterdir()) == ["certificate.earlier.json", "notes.partial"]
    assert (two / "certificate.json").read_text() == "my own notes"


def test_a_case_that_could_not_be_run_ends_nothing_and_is_tried_again(
    study: Study, sent: dict[str, bytes], tmp_path: Path
) -> None:
    lost = study.cases()[0].name
    found = run_sweep(
        study, tmp_path / "out", Here(lambda p: "its process was ended" if p.key == lost else sent[p.key])
    )
    assert found.errors == 1 and found.exit_status == 3 and found.rows[0].error == "its process was ended"
    assert found.verdicts["UNKNOWN"] == 1 and found.verdicts["PROVED"] == 1
    place = canned(sent)
    assert run_sweep(study, tmp_path / "out", place).exit_status == 0 and place.done == [lost]


@pytest.mark.parametrize("end", [KeyboardInterrupt(), BackendError("the scheduler is gone")])
def test_however_a_sweep_ends_the_table_has_what_was_done(
    study: Study, sent: dict[str, bytes], tmp_path: Path, end: BaseException
) -> None:
    first, second = (case.name for case in study.cases())
    with pytest.raises(type(end)):
        run_sweep(study, tmp_path / "out", Here(lambda p: sent[p.key] if p.key == first else end))
    with (tmp_path / "out" / "sweep.csv").open(newline="") as file:
        assert [row["case"] for row in csv.DictReader(file)] == [first]
    assert "1 case is not done" in (tmp_path / "out" / "sweep.html").read_text()
    place = canned(sent)
    assert run_sweep(study, tmp_path / "out", place).exit_status == 0 and place.done == [second]


def test_a_contradiction_ends_the_sweep_loudly_with_what_shows_it(
    study: Study, sent: dict[str, bytes], tmp_path: Path
) -> None:
    first, second = (case.name for case in study.cases())
    said = {"kind": "contradiction", "message": "at odds.", "notices": [], "files": {"../../x.json": "e30="}}
    with pytest.raises(SoundnessError, match=f"case {second}: at odds"):
        run_sweep(study, tmp_path / "out", Here(lambda p: sent[first] if p.key == first else json.dumps(said).encode()))
    assert (tmp_path / "out" / "cases" / second / "contradiction-x.json").read_bytes() == b"{}"
    assert (tmp_path / "out" / "cases" / first / "row.json").is_file() and (tmp_path / "out" / "sweep.html").is_file()


def test_a_worker_s_contradiction_comes_with_its_files(study: Study, monkeypatch: pytest.MonkeyPatch) -> None:
    from certify.analysis.studies import work as module

    def contradict(_plant: object, _network: object, out: Path, *_: object, **__: object) -> None:
        out.mkdir()
        (out / "contradiction.json").write_text("{}")
        raise SoundnessError(f"see {out}/contradiction.json")

    monkeypatch.setattr(module, "certify_roa", contradict)
    answer = answer_in(work(study.cases()[0]))
    assert answer == Answer("contradiction", message="see out/contradiction.json", files={"contradiction.json": b"{}"})


def test_what_somebody_else_refutes_is_tried_here(
    study: Study, sent: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuted(raw: bytes) -> bytes:
        line, _, _ = raw.partition(b"\n")
        data = json.loads(line)
        data["data"] |= {"verdict": "REFUTED", "stop": "witness", "reason": "a worker says so"}
        return json.dumps(data).encode() + b"\n"

    here = canned(sent)
    monkeypatch.setattr(flow, "Processes", lambda jobs: here)
    elsewhere = Here(lambda piece: refuted(sent[piece.key]) if "0.2" in piece.key else sent[piece.key])
    monkeypatch.setattr(flow, "_is_own", lambda place: place is here)
    found = run_sweep(study, tmp_path, elsewhere)
    assert here.done == [study.cases()[1].name] and found.verdicts["PROVED"] == 2


@pytest.mark.parametrize(
    ("verdicts", "status"),
    [("PP", 0), ("PU", 3), ("PT", 3), ("PR", 1), ("UR", 1), ("RR", 1), ("UU", 3), ("P", 3)],
)
def test_the_exit_status_is_the_worst_verdict_s(verdicts: str, status: int) -> None:
    rows = tuple(synthetic({}, letter, str(k)) for k, letter in enumerate(verdicts))
    study = Study("s", (), {})
    assert flow.Sweep(study, rows, 2, 0, {}, 1.0).exit_status == status


# The table


def synthetic(coordinates: dict[str, str], letter: str, name: str, size: float = 2.0) -> Row:
    verdict = {"P": Verdict.PROVED, "T": Verdict.TRUSTED, "R": Verdict.REFUTED}.get(letter, Verdict.UNKNOWN)
    backed: dict[str, Any] = {}
    if letter in "PT":
        checked = "ACCEPTED" if letter == "P" else "TRUSTED"
        backed = {"certificate": f"cases/{name}/certificate.json", "certificate_sha256": "0" * 64, "checked": checked}
        backed |= {"volume": size, "levels": Levels(local=0.1, roa=0.3)}
    if letter == "E":
        return Row(name, coordinates, "", verdict, "error", error="<b>no</b>")
    units = {"theta": "rad", "theta_dot": "rad/s", "m": "kg"}
    return Row(
        name,
        coordinates,
        "",
        verdict,
        "time",
        "time",
        volume_unit="rad · rad/s",
        states=("theta", "theta_dot"),
        units=units,
        **backed,
    )


AXES = {
    "m": Axis("parameters.m", ("0.1", "1/3", "0.5"), True),
    "rate": Axis("options.rate", ("0", "0.5"), True),
    "policies": Axis("policies", ("a/one.pt", "a/<i>two</i>.pt"), True),
    "candidates": Axis("candidates", ("lyapunov", "lqr"), True),
}


def synthetic_study(*which: str, letters: str = "PPURE") -> tuple[Study, list[Row]]:
    study = Study("made up", tuple(AXES[name] for name in which), {})
    keys = [axis.key for axis in study.axes]

    where = [dict(zip(keys, values, strict=True)) for values in product(*(a.values for a in study.axes))]
    return study, [synthetic(w, letters[k % len(letters)], f"case-{k}", 2.0 + k) for k, w in enumerate(where)]


def test_csv_and_parquet_say_the_same(tmp_path: Path) -> None:
    study, rows = synthetic_study("policies", "m", "rate")
    files = write_tables(study, rows, len(rows), tmp_path)
    table = pyarrow.parquet.read_table(files["parquet"])
    with files["csv"].open(newline="", encoding="utf-8") as file:
        found = list(csv.DictReader(file))
    assert table.column_names == names(study.axes) == list(found[0]) and table.num_rows == len(rows) == 12
    for ours, flat, text in zip(rows, table.to_pylist(), found, strict=True):
        assert flat["case"] == text["case"] == ours.case and flat["verdict"] == text["verdict"] == ours.verdict.value
        assert flat["parameters.m"] == float(text["parameters.m"]) == float(Fraction(ours.coordinates["parameters.m"]))
        assert flat["volume"] == (float(text["volume"]) if text["volume"] else None) == ours.volume
        assert flat["level_roa"] == ours.levels.roa and flat["error"] == text["error"] == ours.error
        assert flat["states"] == json.loads(text["states"]) == list(ours.states)


def test_without_pyarrow_there_is_no_old_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    study, rows = synthetic_study("m")
    assert write_tables(study, rows, 3, tmp_path)["parquet"].is_file()
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    assert set(write_tables(study, rows, 3, tmp_path)) == {"csv", "html"} and not (tmp_path / "sweep.parquet").exists()


@pytest.mark.parametrize(
    ("which", "figures", "titles"),
    [
        (("m", "rate"), 1, ["Area over m and rate"]),
        (("policies", "m", "rate"), 2, ["Area over m and rate: policy a/one.pt"]),
        (("m",), 1, ["Area over m"]),
        (("m", "candidates"), 1, ["Area over m"]),
        (("policies", "candidates"), 1, ["Area over policy"]),
    ],
)
def test_the_page_draws_what_was_varied(which: tuple[str, ...], figures: int, titles: list[str]) -> None:
    study, rows = synthetic_study(*which)
    page = page_of(study, rows, len(rows))
    assert page.count("<figure") == figures and all(f"<b>{title}.</b>" in page for title in titles)
    assert not re.search(r"""(?:src|href)=["']?(?:https?:)?//""", page) and "<script src" not in page
    assert "<b>no</b>" not in page and "<i>two" not in page  # every text is escaped
    for word in ("PROVED", "REFUTED", "UNKNOWN", "ERROR"):  # a verdict is a word
        assert (f" {word}</td>" in page) == any(w in page for w in (f" {word}</td>",))
    assert page.count("<tr>") >= len(rows)


def test_cells_of_a_map_say_their_verdict_in_words() -> None:
    from certify.analysis.studies.figures import draw

    study, rows = synthetic_study("m", "rate")
    svg = draw(study.varied, rows[:-1]).pictures[0].svg
    for word in ("unknown", "refuted", "error", "not run", "m (kg)", "area (rad · rad/s)", "1/3"):
        assert (word in svg) == (word != "1/3"), word  # a tick is a decimal


def test_too_many_figures_are_left_out_and_it_says_so() -> None:
    from certify.analysis.studies.figures import draw

    axes = (AXES["m"], AXES["rate"], Axis("options.seed", tuple(map(str, range(14))), True))
    keys = [axis.key for axis in axes]

    rows = [
        synthetic(dict(zip(keys, values, strict=True)), "P", str(k))
        for k, values in enumerate(product(*(axis.values for axis in axes)))
    ]
    drawn = draw(axes, rows)
    assert len(drawn.pictures) == 12 and "2 more figures are left out" in drawn.left_out


# Places


@pytest.fixture(scope="module")
def server() -> None:
    """The one that forks processes, with what these tests need loaded once."""
    forkserver.set_forkserver_preload(
        ["certify.analysis.studies.work", "certify.provers.execution.tasks", "tests.support.pieces"]
    )
    forkserver.ensure_running()


@pytest.mark.usefixtures("server")
def test_each_piece_has_a_process_of_its_own_and_a_lost_one_takes_none_with_it() -> None:
    given = [
        Piece("a", pieces.double, ("x",)),
        Piece("dies", pieces.die, ("",)),
        Piece("b", pieces.process, ("",)),
        Piece("raises", pieces.fail, ("way",)),
        Piece("c", pieces.process, ("",)),
        Piece("odd", pieces.odd, ("",)),
    ]
    found = {outcome.key: outcome for outcome in Processes(2).run(given) if outcome is not None}
    assert set(found) == {piece.key for piece in given}
    assert found["a"].result == b"xx" and found["dies"].result is None
    assert found["dies"].reason == "its process was ended by SIGKILL: was memory short?"
    assert found["raises"].reason == "ValueError: no way"  # one line
    assert found["odd"].result is None and "TypeError" in found["odd"].reason
    own = {found[key].result.split()[0] for key in ("b", "c")}  # type: ignore[union-attr]
    assert len(own) == 2 and str(os.getpid()).encode() not in own


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def until(holds: Callable[[], bool], seconds: float = 30.0) -> bool:
    end = time.monotonic() + seconds
    while not holds() and time.monotonic() < end:
        time.sleep(0.05)
    return holds()


def test_whoever_stops_asking_ends_the_work_and_what_it_started(tmp_path: Path) -> None:
    running = Processes(2).run(Piece(str(k), pieces.linger, (str(tmp_path),)) for k in range(3))
    while len(list(tmp_path.iterdir())) < 2:
        assert next(running) is None
    running.close()
    started = [int(pid) for path in tmp_path.iterdir() for pid in path.name.split(".")]
    assert len(started) == 4 and until(lambda: not any(map(alive, started)), 5.0)


def test_a_place_is_processes_or_a_cluster() -> None:
    assert place_for(None, None).jobs == 1 and place_for(3, None).jobs == 3  # type: ignore[attr-defined]
    assert isinstance(place_for(None, "local:2"), Cluster)
    with pytest.raises(InputError, match="--jobs must stand without --cluster"):
        place_for(2, "local:2")
    with pytest.raises(InputError, match="`jobs` must be at least 1; found 0"):
        place_for(0, None)
    with pytest.raises(InputError, match="a cluster's address must be"):
        next(iter(Cluster("here").run([Piece("a", pieces.double, ("x",))])))


def test_workers_that_are_gone_for_good_are_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    class Deserted:
        left, futures = 5, 0

        def submit(self, *_: object, **__: object) -> Deserted:
            return self

        def add_done_callback(self, _: object) -> None:
            self.futures += 1

        def nthreads(self) -> dict[str, int]:
            self.left -= 1
            return {"a": 1} if self.left > 0 else {}

    monkeypatch.setattr(tasks, "connect", lambda address: nullcontext(Deserted()))
    monkeypatch.setattr(tasks, "_PULSE", 0.01)
    monkeypatch.setattr(tasks, "_DESERTED", 0.05)
    found = Cluster("local:2").run([Piece("a", pieces.double, ("x",))])
    pulses = []
    with pytest.raises(BackendError, match="no worker is left of local:2"):
        pulses.extend(found)
    assert set(pulses) == {None} and len(pulses) >= 8
    elsewhere = Cluster("tcp://somewhere:1").run([Piece("a", pieces.double, ("x",))])
    assert [next(elsewhere) for _ in range(30)] == [None] * 30  # one may yet join
    elsewhere.close()


# The command


def certify(*arguments: object, **options: Any) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "certify", "sweep", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, cwd=ROOT, check=False, **options)


@pytest.mark.usefixtures("server")
def test_the_command_ends_in_one_json_object_and_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def ended(*arguments: object) -> tuple[int, str, str]:
        return _run(["sweep", *map(str, arguments)], "--json" in arguments), *capsys.readouterr()

    path, out = written(tmp_path, QUICK.replace("[0.15, 0.2]", "[0.2, 0.9]")), tmp_path / "out"
    status, said, told = ended(path, "--out", out, "--jobs", 2, "--json")  # 0.9 kg are too heavy for the policy
    found = json.loads(said)
    assert status == 1, told
    assert found["schema"] == "certify-sweep/1" and found["verdicts"]["PROVED"] == found["verdicts"]["REFUTED"] == 1
    assert found["rows"][1]["reason"].startswith("unstable linearisation") and found["kept"] == 0
    assert " of 2  pendulum_m=0.2_lyapunov  PROVED  area" in told
    assert all(Path(file).is_file() for file in found["files"].values())
    status, said, told = ended(path, "--out", out, "--quiet")
    assert (status, told) == (1, "") and "2, 2 of them done before" in said
    status, said, _ = ended(written(tmp_path, "policy = 1"), "--json")
    assert status == 2 and set(json.loads(said)) == {"error"}
    assert ended(path, "--jobs", 1, "--cluster", "local:1")[0] == 2


@pytest.mark.slow
@pytest.mark.skipif(find_browser() is None, reason="no browser is installed")
def test_the_table_can_be_sorted(tmp_path: Path) -> None:
    study, rows = synthetic_study("m", "policies")
    page = tmp_path / "sweep.html"
    page.write_text(page_of(study, rows, len(rows)), encoding="utf-8")
    with Browser(str(find_browser()), tmp_path / "profile") as browser:
        browser.show(page, 1280)
        column = "[...document.querySelectorAll('table.cases tbody tr')].map(r => r.cells[{}].textContent)"
        press = "document.querySelectorAll('table.cases button')[{}].click()"
        assert browser.evaluate("document.documentElement.scrollWidth") == 1280
        for index, key in ((0, float), (2, str)):
            order = browser.evaluate(column.format(index))
            browser.evaluate(press.format(index))
            rising = browser.evaluate(column.format(index))
            browser.evaluate(press.format(index))
            falling = browser.evaluate(column.format(index))
            assert sorted(order) == sorted(rising) == sorted(falling) and len(set(order)) > 1
            numbers = [float(Fraction(text)) for text in rising] if key is float else []
            words = [text.split()[-1].lower() for text in rising]
            assert numbers == sorted(numbers) if key is float else words == sorted(words)
            back = [float(Fraction(text)) for text in falling] if key is float else []
            assert back == sorted(back, reverse=True)


# Slow: what is killed, joins late, or is gone


@contextmanager
def started(*arguments: object, **options: Any) -> Iterator[subprocess.Popen[str]]:
    """A Python process of these tests, which ends with the block."""
    command = [sys.executable, *map(str, arguments)]
    process = subprocess.Popen(command, cwd=ROOT, text=True, **{"stderr": subprocess.DEVNULL, **options})
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


@contextmanager
def scheduler(port: int) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    options = ("--host", "127.0.0.1", "--port", port, "--no-dashboard")
    with started("-m", "distributed.cli.dask_scheduler", *options) as process:
        yield f"tcp://127.0.0.1:{port}", process


def worker(address: str) -> Any:
    return started("-m", "distributed.cli.dask_worker", address, "--no-nanny", "--nthreads", 1, "--no-dashboard")


def sweeping(path: Path, out: Path, *arguments: object) -> Any:
    """The command under way."""
    command = ("-m", "certify", "sweep", path, "--out", out, *arguments)
    return started(*command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True)


LONGER = QUICK.replace("[0.15, 0.2]", "{ from = 0.15, to = 0.2, points = 6 }")


def rows_in(out: Path) -> int:
    return len(list(out.glob("cases/*/row.json")))


@pytest.mark.slow
def test_a_cluster_s_rows_are_those_of_processes(tmp_path: Path) -> None:
    path = written(tmp_path, QUICK.replace("[0.15, 0.2]", "[0.15, 0.2, 0.9]"))
    done = [
        certify(path, "--out", tmp_path / k, f"--{k}", v, "--json") for k, v in (("jobs", 2), ("cluster", "local:2"))
    ]
    assert [d.returncode for d in done] == [1, 1], done[1].stderr
    found = [json.loads(d.stdout)["rows"] for d in done]
    for row in found[0] + found[1]:
        row.pop("seconds")
    assert found[0] == found[1] and [row["verdict"] for row in found[1]] == ["PROVED", "PROVED", "REFUTED"]
    one, two = (sorted((tmp_path / k).glob("cases/*/certificate.json")) for k in ("jobs", "cluster"))
    assert [a.read_bytes() for a in one] == [b.read_bytes() for b in two] and len(one) == 2


@pytest.mark.slow
def test_a_worker_that_is_killed_loses_nothing_and_one_that_joins_late_works(tmp_path: Path) -> None:
    with scheduler(18801) as (address, _), worker(address) as first:
        running = Cluster(address).run(Piece(f"p{k}", pieces.slowly, (f"p{k}", str(tmp_path), 0.5)) for k in range(8))
        outcomes = [next(o for o in running if o is not None)]
        assert outcomes[0].result is not None and outcomes[0].result.split()[1] == str(first.pid).encode()
        assert until(lambda: len(list(tmp_path.iterdir())) >= 2)
        os.kill(first.pid, signal.SIGKILL)
        with worker(address) as late:
            outcomes += [outcome for outcome in running if outcome is not None]
    assert sorted(o.key for o in outcomes) == [f"p{k}" for k in range(8)]
    assert all(o.result is not None for o in outcomes)
    assert {o.result.split()[1] for o in outcomes if o.result} == {str(p.pid).encode() for p in (first, late)}
    marks = [path.name.split(".")[0] for path in tmp_path.iterdir()]
    assert len(marks) > len(set(marks)) == 8  # the piece that was under way was done again


@pytest.mark.slow
def test_a_piece_that_kills_its_workers_or_raises_is_lost_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """A scheduler that blames a piece at its first worker's death blames the others that were there too."""
    monkeypatch.setenv("DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES", "0")
    given = [Piece("dies", pieces.die, ("",)), Piece("raises", pieces.fail, ("way",))]
    given += [Piece(text, pieces.double, (text,)) for text in "abcdef"]
    with scheduler(18804) as (address, _), worker(address), worker(address), worker(address):
        found = {outcome.key: outcome for outcome in Cluster(address).run(given) if outcome is not None}
    assert {text: found[text].result for text in "abcdef"} == {text: 2 * text.encode() for text in "abcdef"}
    assert found["raises"].reason == "ValueError: no way" and found["dies"].result is None
    assert "KilledWorker" in found["dies"].reason and len(found) == len(given)


@pytest.mark.slow
def test_a_scheduler_that_is_gone_is_one_sentence_and_the_sweep_goes_on_elsewhere(tmp_path: Path) -> None:
    path, out = written(tmp_path, LONGER), tmp_path / "out"
    with scheduler(18802) as (address, process), worker(address), sweeping(path, out, "--cluster", address) as run:
        assert until(lambda: rows_in(out) >= 1, 90.0)
        process.kill()
        said, told = run.communicate(timeout=60)
    assert run.returncode == 70 and said == "", told
    last = told.splitlines()[-1]
    assert last.startswith("certify: the scheduler at tcp://127.0.0.1:18802 is gone")
    assert "Traceback" not in told
    done = rows_in(out)
    assert 1 <= done < 6 and len((out / "sweep.csv").read_text().splitlines()) == 1 + done
    again = certify(path, "--out", out, "--jobs", 2, "--json")
    found = json.loads(again.stdout)
    assert again.returncode == 0 and found["kept"] == done and found["verdicts"]["PROVED"] == 6
    nobody = certify(path, "--out", tmp_path / "other", "--cluster", "tcp://127.0.0.1:18803", "--quiet")
    assert nobody.returncode == 70 and "no scheduler answers" in nobody.stderr and "Traceback" not in nobody.stderr


def descendants(pid: int) -> list[int]:
    """The processes below one, by the table of the system."""
    parents = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            parents[int(path.parent.name)] = int(path.read_text().rpartition(")")[2].split()[1])
    found = [pid]
    for one in found:
        found += [child for child, parent in parents.items() if parent == one]
    return found[1:]


@pytest.mark.slow
@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGKILL])
def test_a_sweep_that_is_stopped_leaves_no_process_and_goes_on(tmp_path: Path, end: signal.Signals) -> None:
    path, out = written(tmp_path, LONGER), tmp_path / "out"
    with sweeping(path, out, "--jobs", 2, "--json") as run:
        assert until(lambda: rows_in(out) >= 1, 90.0)
        below = descendants(run.pid)
        os.kill(run.pid, end)
        said, told = run.communicate(timeout=60)
    assert len(below) >= 3 and until(lambda: not any(map(alive, below)), 20.0)
    done = rows_in(out)
    assert 1 <= done < 6
    if end is signal.SIGINT:
        assert run.returncode == 130 and set(json.loads(said)) == {"error"} and "Traceback" not in told
        assert len((out / "sweep.csv").read_text().splitlines()) == 1 + done
    again = certify(path, "--out", out, "--jobs", 2, "--json")
    found = json.loads(again.stdout)
    assert again.returncode == 0 and found["kept"] == done and found["verdicts"]["PROVED"] == 6
    assert [p.name for p in out.rglob("*") if p.suffix == ".partial" or "unchecked" in p.name] == []
