"""The working tree against another commit: the ring's throughput on the same passes, and the whole command.

Run as `python benchmarks/roa.py --against REV`. The other commit is checked out into a temporary folder, and child
processes of the two alternate, A B A B, so that both see the same machine; what counts are the ratios within a run.
A pass is the ring of what the whole command proved here, from a tenth of its local level on, with the same P and the
same coordinates in both; a child repeats it until everything is loaded, and then once more, which counts.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
_INWARDS = 0.1  # of the local level, from which a pass starts
_WARM = 40_000  # boxes that a child bounds before the pass that counts


def compare(revision: str, policies: Sequence[Path], runs: int, threads: int, boxes: int, options: list[str]) -> None:
    """Print both sides and their ratios for each policy; `options` are those of `certify roa`."""
    with _checked_out(revision) as other, tempfile.TemporaryDirectory() as folder:
        trees = {"here": ROOT, revision: other}
        for path in policies:
            whole: dict[str, list[dict[str, Any]]] = {name: [] for name in trees}
            passes: dict[str, list[dict[str, Any]]] = {name: [] for name in trees}
            for _ in range(runs):
                for name, tree in trees.items():
                    whole[name].append(_command(tree, path, Path(folder), threads, options))
            print(f"\n{path.name}, {runs} runs each, {threads} threads")
            _table("certify roa", whole, ("seconds", "cpu"), ("boxes", "leaves", "level"))
            found = whole["here"][0]
            if found["P"] is None or found["level"] is None:
                print(f"  no ring: the command says {found['verdict']}")
                continue
            given = Path(folder) / "pass.json"
            given.write_text(json.dumps({**found, "policy": str(path), "max": boxes, "threads": threads}))
            for _ in range(runs):
                for name, tree in trees.items():
                    passes[name].append(_child(tree, [__file__, str(given)], threads))
            _table("ring", passes, ("boxes/s", "boxes/s cpu"), ("boxes", "leaves", "level"))


def _table(title: str, rows: dict[str, list[dict[str, Any]]], medians: Sequence[str], last: Sequence[str]) -> None:
    """A line for each side, and the ratio of the first to the second, run by run."""
    for name, found in rows.items():
        figures = [f"{key} {statistics.median(v[key] for v in found):.6g}" for key in medians]
        figures += [f"{key} {found[-1][key]}" for key in last]
        print(f"  {title:12}{name:14}" + ", ".join(figures))
    here, there = rows.values()
    pairs = zip(here, there, strict=True)
    ratios = [{key: a[key] / b[key] for key in medians} for a, b in pairs]
    print(
        f"  {title:12}{'ratio':14}" + ", ".join(f"{k} {statistics.median(r[k] for r in ratios):.2f}" for k in medians)
    )


@contextmanager
def _checked_out(revision: str) -> Iterator[Path]:
    """A worktree of another commit, which is gone afterwards."""
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "other"
        subprocess.run(["git", "worktree", "add", "--quiet", "--detach", tree, revision], cwd=ROOT, check=True)
        try:
            yield tree
        finally:
            subprocess.run(["git", "worktree", "remove", "--force", tree], cwd=ROOT, check=True)


def _environment(tree: Path, threads: int) -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(tree), "OMP_NUM_THREADS": str(threads), "OPENBLAS_NUM_THREADS": "1"}


def _command(tree: Path, policy: Path, folder: Path, threads: int, options: list[str]) -> dict[str, Any]:
    """What the whole command takes and finds."""
    command = [sys.executable, "-m", "certify", "roa", "--policy", str(policy.resolve()), "--json", *options]
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    command += ["--out", str(folder / "out")]
    # the exit status says what was proved, and an error is in the JSON
    done = subprocess.run(command, cwd=tree, env=_environment(tree, threads), stdout=subprocess.PIPE, check=False)
    seconds, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    found = json.loads(done.stdout)
    if "error" in found:
        raise SystemExit(f"certify roa in {tree} ended with: {found['error']}")
    levels, P = found["levels"], found["lyapunov"]
    return {
        "verdict": found["verdict"],
        "seconds": seconds,
        "cpu": after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime,
        "boxes": found["boxes"],
        "leaves": found["leaves"],
        "level": levels["roa"],
        "local": levels["local"],
        "P": None if P is None else P["P"],
    }


def _child(tree: Path, arguments: list[str], threads: int) -> dict[str, Any]:
    done = subprocess.run(
        [sys.executable, *arguments], cwd=tree, env=_environment(tree, threads), check=True, stdout=subprocess.PIPE
    )
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def one_pass(given: Path) -> None:
    """In a child: the pass that a file describes, again and again, and the last one's figures as JSON."""
    import numpy as np

    import certify
    from certify.certificates.claims import Problem
    from certify.loop.closed_loop import ClosedLoop
    from certify.loop.plants import get_system
    from certify.loop.policies import load_policy
    from certify.lyapunov import diagonalising_coordinates
    from certify.lyapunov.function import Quadratic
    from certify.provers.base import Budget
    from certify.provers.boxes.search import prove_outwards
    from certify.provers.execution import ThreadRunner

    if Path(certify.__file__).parent.parent.resolve() != Path.cwd().resolve():
        raise SystemExit(f"certify was imported from {certify.__file__}, which is not the tree {Path.cwd()}")
    asked = json.loads(given.read_text())
    policy = load_policy(asked["policy"])
    loop = ClosedLoop(get_system(policy.system).with_parameters(policy.parameters), policy.network)
    P = np.array(asked["P"], dtype=np.float64)
    problem, T = Problem(loop, Quadratic(P)), diagonalising_coordinates(P, loop.linearise()[0])
    budget = Budget(boxes=asked["max"])  # both trees know that one
    bounded, counts = 0, False
    while not counts:
        counts = bounded >= _WARM
        wall, cpu = time.perf_counter(), time.process_time()
        ring = prove_outwards(problem, T, _INWARDS * asked["local"], asked["level"], budget, ThreadRunner())
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        bounded += ring.boxes
        if not ring.boxes:
            raise SystemExit(f"the ring of {asked['policy']} has no boxes to compare; choose another policy")
    figures = {"boxes": ring.boxes, "leaves": ring.leaves, "level": ring.outer}
    print(json.dumps({**figures, "boxes/s": ring.boxes / wall, "boxes/s cpu": ring.boxes / cpu}))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("given", type=Path)
    one_pass(parser.parse_args().given)
