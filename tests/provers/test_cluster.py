"""A real Dask cluster: jobs that fail, workers and schedulers that die, and what is left of them afterwards."""

from __future__ import annotations

import os
import pickle
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from certify.analysis.run import RoaOptions, certify_roa
from certify.certificates import run_checker
from certify.certificates.verdict import Stop, Verdict
from certify.effort import UNIT, Effort
from certify.errors import BackendError, InputError
from certify.loop.plants import get_system
from certify.loop.policies import load_policy
from certify.provers.base import Budget
from certify.provers.boxes import ahead
from certify.provers.boxes.search import outwards, prove_outwards
from certify.provers.execution import ThreadRunner
from certify.provers.execution.cluster import ClusterJobs, ClusterRunner, connect, signals_later
from tests.provers.test_vdot import cartpole_case
from tests.support.dask import ROOT, Cluster, cluster, echo

pytest.importorskip("distributed")

POLICIES = ROOT / "examples" / "policies"


@pytest.fixture(scope="module")
def local() -> Iterator[ClusterRunner]:
    with connect("local:2") as client:
        yield ClusterRunner(client)


def wait_for(condition: Callable[[], bool], seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.1)


def answers(jobs: ClusterJobs, count: int, seconds: float = 60.0) -> dict[int, bytes | None]:
    found: dict[int, bytes | None] = {}
    end = time.monotonic() + seconds
    while len(found) < count and time.monotonic() < end:
        found |= dict(jobs.ended(0.25))
    return found


def descendants(pid: int) -> set[int]:
    """Process numbers of all that a process has started."""
    found = subprocess.run(["ps", "-eo", "pid=,ppid="], capture_output=True, text=True, check=True).stdout
    parents = {int(a): int(b) for a, b in (line.split() for line in found.splitlines())}
    mine, more = {pid}, {pid}
    while more:
        more = {child for child, parent in parents.items() if parent in more} - mine
        mine |= more
    return mine - {pid}


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


# ------------------------------------------------------------------------------------------------ two workers from here


def test_answers_are_bytes_and_the_rest_is_none(local: ClusterRunner, capfd: pytest.CaptureFixture[str]) -> None:
    """One answer that cannot be read spoils neither the others, nor the terminal, nor the connection."""
    with local.jobs(echo) as jobs:
        given = {jobs.give(job): job for job in (b"0.01", b"fail", b"wrong", b"number", b"0.02", b"0.03")}
        found = answers(jobs, len(given))
        assert found == {n: None if job in (b"fail", b"wrong", b"number") else job for n, job in given.items()}
        assert answers(jobs, 1, 0.5) == {} and jobs.places == 2 and jobs.failed == 3
    assert (
        local.remark is not None and "3 jobs of the cluster failed" in local.remark and "same sources" in local.remark
    )
    assert capfd.readouterr() == ("", "")


def test_work_that_cannot_be_unpacked_fails_and_is_tried_anew(local: ClusterRunner) -> None:
    """As with another version of the code: what the work is made of does not exist there."""
    with local.jobs(echo) as jobs:
        good = jobs._payload
        jobs._payload = pickle.dumps(echo).replace(b"echo", b"ohce")
        jobs.give(b"0")
        assert answers(jobs, 1) == {0: None}
        jobs._payload = good
        jobs.give(b"0.01")
        assert answers(jobs, 1) == {1: b"0.01"}


def test_jobs_that_are_forgotten_are_not_answered(local: ClusterRunner) -> None:
    with local.jobs(echo) as jobs:
        for _ in range(8):
            jobs.give(b"0.05")
        jobs.forget(range(6))
        assert set(answers(jobs, 2, 10)) == {6, 7} and answers(jobs, 1, 0.5) == {}


@pytest.mark.parametrize(
    ("places", "effort"), [(2, 60.0), (2, 0.07), *(pytest.param(n, 0.07, marks=pytest.mark.slow) for n in (1, 3))]
)
def test_processes_make_the_same_proof(
    places: int, effort: float, local: ClusterRunner, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its levels, tree and count, also where the effort ends in the middle of it, with one process, two and three."""
    monkeypatch.setattr(ahead, "_FEW", 2)
    monkeypatch.setattr(ahead, "_TURN", (0.05, 0.05))
    case, begin = cartpole_case(), local.remark
    with ExitStack() as stack:
        runner = local if places == 2 else ClusterRunner(stack.enter_context(connect(f"local:{places}")))
        expected, found = (
            prove_outwards(case.problem, case.T, 2.5e-4, 1e-3, Budget(batch=16, effort=Effort(effort * UNIT)), each)
            for each in (ThreadRunner(), runner)
        )
    assert (found.outer, found.tree, found.boxes, found.stop) == (
        expected.outer, expected.tree, expected.boxes, expected.stop
    )  # fmt: skip
    assert (expected.stop is Stop.EFFORT) == (effort < 1) and local.remark == begin


@pytest.mark.parametrize("address", ["", "local:0", "local:", "local:99999", "8786", "tcp://", "tcp:// x", "TCP://a:1"])
def test_what_is_no_address_is_refused(address: str) -> None:
    with pytest.raises(InputError, match="must be `local:N`"), connect(address):
        pass


@pytest.mark.parametrize(
    "address", ["tcp://127.0.0.1:1", "nothing://127.0.0.1:1", "tls://127.0.0.1:1", "tcp://nowhere.invalid:1"]
)
def test_where_nobody_answers_is_said_in_one_sentence(address: str, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(BackendError, match=f"no scheduler answers at {address}"), connect(address, patience=0.3):
        pass
    assert capfd.readouterr() == ("", "")


# -------------------------------------------------------------------------------------------- processes that are killed


@pytest.mark.slow
def test_a_worker_that_is_killed_takes_no_job_with_it() -> None:
    with cluster(2) as dask, connect(dask.address) as client, ClusterRunner(client).jobs(echo) as jobs:
        wait_for(lambda: jobs.places == 2)
        for _ in range(8):
            jobs.give(b"0.8")
        time.sleep(1.0)
        dask.processes[1].kill()
        found = answers(jobs, 8)
        assert found == dict.fromkeys(range(8), b"0.8") and jobs.places == 1


@pytest.mark.slow
def test_an_answer_that_died_with_its_worker_is_made_again_or_said_to_be_lost() -> None:
    """Lost is what it is called if it dies while it is fetched: whoever asked then does the job."""
    with cluster(1) as dask, connect(dask.address) as client, ClusterRunner(client).jobs(echo) as jobs:
        wait_for(lambda: jobs.places == 1)
        jobs.give(b"0.1")
        wait_for(lambda: jobs._futures[0].status == "finished")
        dask.processes[1].kill()
        dask.processes[1].wait()
        begin = time.monotonic()
        found = answers(jobs, 1, 1.0)
        assert found in ({}, {0: None}) and time.monotonic() - begin < 25
        dask.worker()
        assert found == {0: None} or answers(jobs, 1) == {0: b"0.1"}


@pytest.mark.slow
def test_a_worker_that_comes_late_is_given_work() -> None:
    case, budget = cartpole_case(), Budget(batch=64, effort=Effort(120 * UNIT))
    expected = prove_outwards(case.problem, case.T, 2.5e-3, 1e-2, budget, ThreadRunner())
    with cluster(0) as dask, connect(dask.address) as client:
        runner = ClusterRunner(client)
        ring = outwards(case.problem, case.T, 2.5e-3, 1e-2, runner)
        places: list[int] = []

        def report(_: Any) -> None:
            places.append(len(client.nthreads()))
            if len(places) == 1:
                dask.worker()
            if len(places) < 6:
                time.sleep(3.0)  # a worker takes seconds to start

        assert ring.advance(budget, report) is None and ring.proof().tree == expected.tree
        assert places[0] == 0 and max(places) == 1 and runner.remark is None


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP], ids=["killed", "silent"])
def test_a_scheduler_that_is_gone_is_noticed(how: signal.Signals, capfd: pytest.CaptureFixture[str]) -> None:
    """Whether its connection breaks or it only says nothing any more."""
    with cluster(1) as dask:
        begin = time.monotonic()
        with connect(dask.address) as client:
            runner = ClusterRunner(client)
            with (
                pytest.raises(BackendError, match=f"the scheduler at {dask.address} is gone"),
                runner.jobs(echo) as jobs,
            ):
                wait_for(lambda: jobs.places == 1)
                jobs.give(b"60")
                dask.scheduler.send_signal(how)
                begin = time.monotonic()
                answers(jobs, 1, 100)
            assert runner.remark is not None and dask.address in runner.remark
        assert time.monotonic() - begin < 40
    assert capfd.readouterr() == ("", "")


@pytest.mark.slow
def test_a_worker_without_memory_is_done_without() -> None:
    """It is killed by its nanny, four times by Dask's default, and the job has failed."""
    settings = {"DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "0"}
    with cluster(0, environment=settings) as dask:
        dask.worker("--nanny", "--memory-limit", "600MB")
        with connect(dask.address) as client, ClusterRunner(client).jobs(echo) as jobs:
            wait_for(lambda: jobs.places == 1)
            jobs.give(b"memory")
            assert answers(jobs, 1, 120) == {0: None}
            jobs.give(b"0.1")
            assert answers(jobs, 1) == {1: b"0.1"}


@pytest.mark.slow
def test_a_worker_with_another_version_of_the_code_is_of_no_harm(tmp_path: Path) -> None:
    """There the classes of the search do not exist: its jobs fail, are done here, and that is said."""
    shutil.copytree(ROOT / "certify", tmp_path / "certify", ignore=shutil.ignore_patterns("__pycache__"))
    older = tmp_path / "certify" / "provers" / "boxes" / "ahead.py"
    older.write_text(older.read_text().replace("class Growing", "class Grown"))
    case, budget = cartpole_case(), Budget(batch=64, effort=Effort(120 * UNIT))
    expected = prove_outwards(case.problem, case.T, 2.5e-4, 1e-3, budget, ThreadRunner())
    with cluster(0) as dask, connect(dask.address) as client:
        dask.worker(environment={"PYTHONPATH": str(tmp_path)})
        runner = ClusterRunner(client)
        with runner.jobs(echo) as jobs:
            wait_for(lambda: jobs.places == 1)
        found = prove_outwards(case.problem, case.T, 2.5e-4, 1e-3, budget, runner)
        assert found.tree == expected.tree
        assert runner.remark is not None and "failed" in runner.remark and "same sources" in runner.remark


# ------------------------------------------------------------------------------------------------------- whole commands


def command(out: Path, address: str, *more: str) -> list[str]:
    policy = POLICIES / "cartpole.pt"
    asked = ["roa", "--policy", str(policy), "--cluster", address, "--out", str(out), "--candidate", "lyapunov", *more]
    return [sys.executable, "-m", "certify", *asked]


def test_ctrl_c_waits_until_all_workers_are_there() -> None:
    """Threads that start meanwhile, and so their processes, do not see it."""
    before, seen = signal.signal(signal.SIGINT, signal.default_int_handler), list[Any]()
    try:
        with pytest.raises(KeyboardInterrupt), signals_later():
            thread = threading.Thread(target=lambda: seen.append(signal.pthread_sigmask(signal.SIG_BLOCK, [])))
            thread.start()
            os.kill(os.getpid(), signal.SIGINT)
            thread.join()
            seen.append("the block ends")
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
    assert signal.SIGINT in seen[0] and seen[1] == "the block ends"
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, [])


@pytest.mark.slow
@pytest.mark.parametrize("processes", [3, 1], ids=["in the search", "while workers start"])
@pytest.mark.parametrize("everybody", [True, False], ids=["as a terminal does", "to certify alone"])
def test_ctrl_c_leaves_no_processes(everybody: bool, processes: int, tmp_path: Path) -> None:
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    run = subprocess.Popen(
        command(tmp_path, "local:2", "--effort", "1.2", "--quiet"),
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment, cwd=ROOT, start_new_session=True,
    )  # fmt: skip
    try:
        wait_for(lambda: len(descendants(run.pid)) >= processes or run.poll() is not None, 120)
        time.sleep(2.0 if processes > 1 else 0.2)
        assert run.poll() is None, run.communicate()
        started = descendants(run.pid)
        (os.killpg if everybody else os.kill)(run.pid, signal.SIGINT)
        out, err = run.communicate(timeout=60)
    finally:
        if run.poll() is None:
            os.killpg(run.pid, signal.SIGKILL)
            run.wait()
    assert run.returncode == 130 and err.startswith("certify: interrupted; ") and err.count("\n") == 1 and not out
    wait_for(lambda: not any(alive(pid) for pid in started), 15)
    assert len(started) >= min(processes, 2)  # workers
    kept = ["search.json"] if "the search is kept" in err else []
    assert [path.name for path in tmp_path.iterdir()] == kept and (kept or "nothing was left half-written" in err)


@pytest.mark.slow
def test_a_scheduler_killed_in_the_middle_of_a_run_leaves_a_certificate_and_a_search(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """It is killed once some hundred boxes were bounded; the run says who is gone, and another one ends the search."""
    for place in ("certify.analysis.stages.candidate", "certify.analysis.stages.ring", "certify.analysis.selection"):
        monkeypatch.setattr(f"{place}.Budget", partial(Budget, batch=64))
    monkeypatch.setattr("certify.analysis.stages.candidate._HEAT", 1e-9)
    monkeypatch.setattr(ahead, "_TURN", (0.05, 0.05))
    policy = load_policy(POLICIES / "cartpole.pt")
    system = get_system("cartpole").with_parameters(policy.parameters)
    killed: list[float] = []
    with cluster(2) as dask:
        with connect(dask.address) as client, ClusterRunner(client).jobs(echo) as jobs:
            wait_for(lambda: jobs.places == 2)

        def progress(stage: str, state: Any) -> None:
            if stage == "ring" and state.boxes > 400 and state.open and not killed:
                dask.scheduler.kill()
                killed.append(time.monotonic())

        options = RoaOptions(candidate="lqr", cluster=dask.address, effort=2.4)
        found = certify_roa(system, policy.network, tmp_path, options, progress=progress)
        assert killed and time.monotonic() - killed[0] < 60
    assert found.verdict is Verdict.PROVED and found.stop is Stop.CLUSTER and found.search is not None
    assert dask.address in found.reason and dask.address in (found.notice or "")
    assert found.certificate is not None and run_checker(found.certificate)["result"] == "ACCEPTED"
    end = certify_roa(system, policy.network, tmp_path, RoaOptions(resume=True, effort=2.4))
    whole = certify_roa(system, policy.network, tmp_path / "whole", RoaOptions(candidate="lqr", effort=2.4))
    assert end.verdict is whole.verdict is Verdict.PROVED and end.search is None
    assert end.levels.roa is not None and found.levels.roa is not None and end.levels.roa >= found.levels.roa
    assert end.levels.roa == pytest.approx(whole.levels.roa, rel=2e-3)
    assert capfd.readouterr() == ("", "")


# ------------------------------------------------------------------------------------------------------------------ TLS


@pytest.mark.slow
def test_a_cluster_over_tls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An authority of one's own, one certificate for all; without it there is no entry."""
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not here to make certificates with")
    ca, key, certificate = (str(tmp_path / name) for name in ("ca.pem", "key.pem", "cert.pem"))
    request, authority = str(tmp_path / "request.pem"), str(tmp_path / "ca-key.pem")
    new = ["openssl", "req", "-newkey", "rsa:2048", "-nodes"]
    for line in (
        [*new, "-x509", "-subj", "/CN=authority", "-days", "2", "-keyout", authority, "-out", ca],
        [*new, "-subj", "/CN=certify", "-keyout", key, "-out", request],
        ["openssl", "x509", "-req", "-in", request, "-CA", ca, "-CAkey", authority, "-CAcreateserial", "-days", "2",
         "-out", certificate],
    ):  # fmt: skip
        subprocess.run(line, check=True, capture_output=True)
    names = {"CA_FILE": ca, "SCHEDULER__CERT": certificate, "SCHEDULER__KEY": key, "WORKER__CERT": certificate}
    names |= {"WORKER__KEY": key, "CLIENT__CERT": certificate, "CLIENT__KEY": key}
    settings = {f"DASK_DISTRIBUTED__COMM__TLS__{name}": value for name, value in names.items()}
    settings["DASK_DISTRIBUTED__COMM__REQUIRE_ENCRYPTION"] = "True"
    program = (
        "import sys\nfrom certify.provers.execution.cluster import ClusterRunner, connect\n"
        "from tests.support.dask import echo\n"
        "import time\n"
        "with connect(sys.argv[1], 20.0) as client, ClusterRunner(client).jobs(echo) as jobs:\n"
        "    while not jobs.places:\n        time.sleep(0.2)\n"
        "    jobs.give(b'0.1')\n    found = []\n"
        "    while not found:\n        found = jobs.ended(0.5)\n"
        "    print(found)\n"
    )
    made = Cluster(environment=settings, scheme="tls")
    try:
        made.worker()
        run = [sys.executable, "-c", program, made.address]
        with_ = subprocess.run(run, env=made.environment, capture_output=True, text=True, timeout=90, check=False)
        assert with_.stdout == "[(0, b'0.1')]\n", with_.stderr
        plain = {name: value for name, value in made.environment.items() if not name.startswith("DASK_")}
        without = subprocess.run(run, env=plain, capture_output=True, text=True, timeout=90, check=False)
        assert without.returncode == 1 and "BackendError: no scheduler answers at tls://" in without.stderr
        run[-1] = made.address.replace("tls", "tcp")
        bare = subprocess.run(run, env=plain, capture_output=True, text=True, timeout=90, check=False)
        assert bare.returncode == 1 and "BackendError: no scheduler answers at tcp://" in bare.stderr
    finally:
        made.close()
