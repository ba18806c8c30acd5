"""Threads of this machine: how many there are shows in nothing that is proved."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from threadpoolctl import ThreadpoolController, threadpool_info

from certify.analysis.options import RoaOptions
from certify.analysis.run import certify_roa
from certify.loop.plants import get_system
from certify.loop.policies import load_policy
from certify.provers.execution import ThreadRunner, in_pieces, threads
from certify.provers.execution.threads import cores
from tests.support.marks import slow_after
from tests.support.ways import Way, bounded

POLICIES = Path(__file__).parent.parent.parent / "examples" / "policies"
RUNS = {
    "pendulum": RoaOptions(effort=0.02),
    "cartpole": RoaOptions(candidate="lqr"),
    "quadrotor2d": RoaOptions(candidate="lqr", max_boxes=3000),
}


class Answer(NamedTuple):
    """What a bound answers: arrays whose last axis is the boxes."""

    total: np.ndarray
    lo: np.ndarray


@pytest.mark.parametrize("name", slow_after(1, RUNS))
def test_the_certificate_has_the_same_bytes(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On any number of threads, and with loops that are compiled or not."""
    policy = load_policy(POLICIES / f"{name}.pt")
    system = get_system(policy.system).with_parameters(policy.parameters)
    found = []
    runs: list[tuple[int, Way]] = [(1, "compiled"), (2, "compiled"), (3, "compiled"), (2, "numpy")]
    for k, (count, way) in enumerate(runs):
        monkeypatch.setenv("OMP_NUM_THREADS", str(count))
        with bounded(way):
            result = certify_roa(system, policy.network, tmp_path / str(k), RUNS[name])
        assert result.certificate is not None
        found.append((result.levels, result.boxes, result.certificate.read_bytes()))
    assert found == [found[0]] * len(runs)


@pytest.mark.parametrize("count", [1, 2, 255, 256, 257, 258, 513, 1000])
def test_each_box_is_bounded_once_and_never_alone(count: int) -> None:
    sizes = list[int]()

    def bound(lo: np.ndarray, hi: np.ndarray, inner: float, outer: float) -> Answer:
        sizes.append(lo.shape[1])
        return Answer((lo + hi).sum(0), lo)

    lo = np.random.default_rng(0).random((3, count))
    found = in_pieces(bound)(lo, 2 * lo, 0.0, 1.0)
    assert np.array_equal(found[0], (3 * lo).sum(0)) and np.array_equal(found[1], lo)
    assert min(sizes) >= 2 and max(sizes) <= 257 and sum(sizes) == max(2, count)


def test_cores_are_those_that_are_asked_for_or_all(monkeypatch: pytest.MonkeyPatch) -> None:
    for asked, found in (
        ("3", 3),
        ("4,2", 4),
        ("0", len(os.sched_getaffinity(0))),
        ("x", len(os.sched_getaffinity(0))),
    ):
        monkeypatch.setenv("OMP_NUM_THREADS", asked)
        assert cores() == found and ThreadRunner().threads == found
    monkeypatch.delenv("OMP_NUM_THREADS")
    assert cores() == len(os.sched_getaffinity(0))


def test_linear_algebra_is_on_one_thread_while_boxes_are_bounded() -> None:
    def seen(lo: np.ndarray, hi: np.ndarray, inner: float, outer: float) -> Answer:
        threads = [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]
        assert threads
        return Answer(np.full(lo.shape[1], max(threads)), lo)

    with ThreadRunner(2).start(seen) as bound:
        assert (bound(np.zeros((1, 600)), np.ones((1, 600)), 0.0, 1.0)[0] == 1).all()


def test_libraries_are_looked_for_again_once_there_are_other_modules(monkeypatch: pytest.MonkeyPatch) -> None:
    looked = list[int]()

    class Controller(ThreadpoolController):
        def __init__(self) -> None:
            looked.append(len(sys.modules))
            super().__init__()

    monkeypatch.setattr(threads, "ThreadpoolController", Controller)
    threads._libraries.cache_clear()
    for name in ("first", "second"):
        for _ in range(3):
            with threads.one_thread():
                assert {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"} == {1}
        monkeypatch.setitem(sys.modules, name, sys)
    assert len(looked) == 2
    threads._libraries.cache_clear()


def test_one_thread_holds_for_libraries_that_come_later() -> None:
    """scipy's was not limited where Python asks for a proof: a learned function took thirty times as long on two busy
    cores."""
    program = (
        "from certify.provers.execution.threads import one_thread\n"
        "with one_thread():\n"
        "    import scipy.linalg\n"
        "    from threadpoolctl import threadpool_info\n"
        "    found = [one['num_threads'] for one in threadpool_info() if one['user_api'] == 'blas']\n"
        "print(found)\n"
    )
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "2", "OMP_NUM_THREADS": "2"}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True)
    found = json.loads(done.stdout)
    assert found and set(found) == {1}
