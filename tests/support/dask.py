"""A Dask scheduler and workers as processes of their own, to be killed; and work for them."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).parents[2]


def echo(job: bytes) -> bytes:
    """Work: sleep as long as the job says, or fail as it says."""
    text = job.decode()
    if text == "fail":
        raise ZeroDivisionError("asked for")
    if text == "wrong":
        return object()  # type: ignore[return-value]
    if text == "number":
        return 3.5  # type: ignore[return-value]
    if text == "memory":
        held = bytearray(2**31)
        held[:: 2**12] = bytes(len(held[:: 2**12])).replace(b"\0", b"\1")
        time.sleep(20)
        return bytes(held[:1])
    time.sleep(float(text))
    return job


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


class Cluster:
    """Processes, all of which are gone at the end."""

    def __init__(self, environment: dict[str, str] | None = None, scheme: str = "tcp") -> None:
        self.environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)} | (environment or {})
        self.port = free_port()
        self.address = f"{scheme}://127.0.0.1:{self.port}"
        self.processes: list[subprocess.Popen[bytes]] = []
        listen = ["--protocol", scheme, "--host", "127.0.0.1", "--port", str(self.port), "--no-dashboard"]
        self.scheduler = self._run("dask_scheduler", *listen)

    def worker(self, *more: str, environment: dict[str, str] | None = None) -> subprocess.Popen[bytes]:
        """One more, with one thread, and a nanny only if `--nanny` is among the rest."""
        options = ["--nthreads", "1", "--no-dashboard", *more]
        return self._run(
            "dask_worker", self.address, *options, *([] if "--nanny" in more else ["--no-nanny"]),
            environment=environment,
        )  # fmt: skip

    def _run(self, name: str, *more: str, environment: dict[str, str] | None = None) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", f"distributed.cli.{name}", *more]
        environment = self.environment | (environment or {})
        quiet = subprocess.DEVNULL
        process = subprocess.Popen(
            command, stdout=quiet, stderr=quiet, env=environment, cwd="/", start_new_session=True
        )
        self.processes.append(process)
        return process

    def close(self) -> None:
        for process in self.processes:
            for number in (signal.SIGCONT, signal.SIGKILL):
                try:
                    os.killpg(process.pid, number)  # a nanny's worker is of its group
                except ProcessLookupError:
                    continue
            process.wait()


@contextmanager
def cluster(workers: int = 1, **more: object) -> Iterator[Cluster]:
    """A scheduler with so many workers."""
    made = Cluster(**more)  # type: ignore[arg-type]
    try:
        for _ in range(workers):
            made.worker()
        yield made
    finally:
        made.close()
