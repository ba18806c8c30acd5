"""A check in parts by workers: what they answer is put together for the whole file, or for nothing."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from certify.analysis.options import RoaOptions
from certify.analysis.parts import Part, check_in_parts
from certify.analysis.run import certify_roa
from certify.certificates import run_checker
from certify.certificates.checking import ask
from certify.certificates.verdict import Verdict
from certify.errors import BackendError
from certify.provers.execution import Work
from tests.support.loops import scalar_tanh

CERTIFICATE = Path(__file__).parent.parent.parent / "docs" / "published" / "two_machines.json"
Answer = Callable[[Work, bytes, int], bytes | None]


class Workers:
    """Jobs that are done by a function, the last first."""

    def __init__(self, places: int, answer: Answer) -> None:
        self.there, self.answer = places, answer
        self.work: Work | None = None
        self.waiting: list[tuple[int, bytes]] = []
        self.given = 0

    @property
    def places(self) -> int:
        return self.there

    def give(self, job: bytes) -> int:
        self.waiting.append((self.given, job))
        self.given += 1
        return self.given - 1

    def ended(self, seconds: float) -> list[tuple[int, bytes | None]]:
        if not self.waiting or self.work is None:
            return []
        number, job = self.waiting.pop()
        return [(number, self.answer(self.work, job, number))]

    def forget(self, numbers: Iterable[int]) -> None: ...

    def start(self, bound: Any) -> Any: ...

    @contextmanager
    def jobs(self, work: Work) -> Iterator[Workers]:
        self.work = work
        yield self


def honest(work: Work, job: bytes, number: int) -> bytes:
    return work(job)


@pytest.fixture(autouse=True)
def small_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("certify.analysis.parts._LEAVES", 500)


def test_the_answer_is_that_of_the_whole() -> None:
    whole = run_checker(CERTIFICATE)
    status, answer = check_in_parts(CERTIFICATE, Workers(2, honest))
    assert (status, answer["result"], answer["parts"]) == (0, "ACCEPTED", 4)
    assert all(answer[key] == whole[key] for key in ("certificate_sha256", "levels", "rules", "outer", "claim"))


@pytest.mark.parametrize("places", [0, 2])
def test_what_nobody_can_check_is_checked_here(places: int) -> None:
    status, answer = check_in_parts(CERTIFICATE, Workers(places, lambda work, job, number: None))
    assert (status, answer["result"]) == (0, "ACCEPTED")


def test_workers_that_leave() -> None:
    workers = Workers(2, honest)

    def leaves(work: Work, job: bytes, number: int) -> bytes | None:
        workers.there = 0
        return None

    workers.answer = leaves
    assert check_in_parts(CERTIFICATE, workers)[1]["result"] == "ACCEPTED"


def test_a_refusal_by_one_is_the_answer(tmp_path: Path) -> None:
    data = json.loads(CERTIFICATE.read_text())
    data["claim"]["outer"]["level"] = (1.5 * float.fromhex(data["claim"]["outer"]["level"])).hex()
    path = tmp_path / "forged.json"
    path.write_text(json.dumps(data))
    assert ask(path)[0] == 1
    status, answer = check_in_parts(path, Workers(2, honest))
    assert (status, answer["result"], answer["rule"]) == (1, "REJECTED", "faces")


def replayed(work: Work, job: bytes, number: int) -> bytes:
    """Everybody answers for the first part."""
    return work(job[:0] + (1).to_bytes(8, "little") + job[8:])


def of_another(work: Work, job: bytes, number: int) -> bytes:
    """One worker has checked another file."""
    other = CERTIFICATE.with_name("van_der_pol_1.json")
    return Part(other.read_bytes())(job) if number == 1 else work(job)


def accepted(work: Work, job: bytes, number: int) -> bytes:
    """A worker that says ACCEPTED, about the whole."""
    return json.dumps([0, run_checker(CERTIFICATE)]).encode()


def hasty(work: Work, job: bytes, number: int) -> bytes:
    """A worker that has not looked at all leaves."""
    status, answer = json.loads(work(job))
    return json.dumps([status, answer | {"examined": answer["examined"] - 1}]).encode()


@pytest.mark.parametrize("lie", [replayed, of_another, accepted, hasty])
def test_answers_that_do_not_make_one(lie: Answer) -> None:
    with pytest.raises(BackendError, match="part"):
        check_in_parts(CERTIFICATE, Workers(2, lie))


@pytest.mark.parametrize(
    "garbage",
    [
        b"",
        b"[4]",
        b"[4, {}]",
        b'["4", {"result": "PART"}]',
        b"[" * 10**5,
        b"null",
        b'[0, {"result": "REJECTED"}]',
        b'[0, {"error": "x", "result": "ACCEPTED"}]',
        b'[0, {"error": "internal"}]',
        b'[0, {"result": "ACCEPTED"}]',
        b'[3, {"result": "TRUSTED"}]',
        b'[4, {"result": "REJECTED"}]',
        b'[1, {"result": "PART"}]',
        b'[true, {"result": "REJECTED"}]',
        b'[4, {"result": ["PART"]}]',
    ],
)
def test_garbage_is_no_answer(garbage: bytes) -> None:
    with pytest.raises(BackendError, match="a worker's answer"):
        check_in_parts(CERTIFICATE, Workers(2, lambda work, job, number: garbage))


def certified(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, workers: Workers) -> Any:
    """A run whose cluster these workers are; they grow nothing, and check."""

    @contextmanager
    def runner(_: RoaOptions) -> Iterator[Workers]:
        yield workers

    monkeypatch.setattr("certify.analysis.run._runner_for", runner)
    plant, law = scalar_tanh()
    options = RoaOptions(candidate="lyapunov", level=1.0, cluster="tcp://head:8786", cluster_checks=True)
    return certify_roa(plant, law, tmp_path, options)


class Checkers(Workers):
    """Workers that only check."""

    remark = None

    @contextmanager
    def start(self, bound: Any) -> Iterator[Any]:
        yield bound

    @contextmanager
    def jobs(self, work: Work) -> Iterator[Any]:
        self.work = work
        yield self if isinstance(work, Part) else None


def test_a_run_says_whose_word_its_check_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    result = certified(tmp_path, monkeypatch, Checkers(2, honest))
    assert result.verdict is Verdict.PROVED and "parts" in result.checker
    assert "parts by the workers of tcp://head:8786, whose word it is" in result.notice


def lost(work: Work, job: bytes, number: int) -> bytes:
    raise BackendError("the scheduler at tcp://head:8786 is gone.")


@pytest.mark.parametrize("lie", [hasty, accepted, lost])
def test_where_no_answer_comes_of_it_the_checker_here_decides(
    lie: Answer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    result = certified(tmp_path, monkeypatch, Checkers(2, lie))
    assert result.verdict is Verdict.PROVED and "parts" not in result.checker
    assert result.notice is not None and "checked here, and not by the cluster" in result.notice
