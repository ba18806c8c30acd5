"""The whole job on the shipped policies, and the engine's throughput against the machine's matrix product.

Run with `python benchmarks/roa.py [--runs 5] [--threads 2] [--candidate lqr] [--effort 2] [POLICY ...]`. One
warm-up run is not counted; the figures are medians of the counted runs in this one process. Absolute times are this
machine's; the ratios are what to compare. With `--against REV` the working tree and another commit run side by side
instead (`against.py`).
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
import time
from dataclasses import asdict
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from against import compare

from certify.analysis.results import RoaResult
from certify.analysis.run import RoaOptions, certify_roa
from certify.certificates.claims import Problem
from certify.loop.closed_loop import ClosedLoop
from certify.loop.plants import get_system
from certify.loop.policies import load_policy
from certify.lyapunov import diagonalising_coordinates, solve_lyapunov, volume
from certify.lyapunov.function import Quadratic
from certify.provers.boxes.rule import VdotBound
from certify.provers.execution import ThreadRunner

POLICIES = Path(__file__).parent.parent / "examples" / "policies"


def whole_job(path: Path, options: RoaOptions, runs: int) -> None:
    """Levels, boxes, certificate size, and median seconds of each stage."""
    policy = load_policy(path)
    system = get_system(policy.system).with_parameters(policy.parameters)
    results: list[RoaResult] = []
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(runs + 1):
            results.append(certify_roa(system, policy.network, Path(folder), options))
        last = results[-1]
        size = last.certificate.stat().st_size if last.certificate is not None else 0
    counted = results[1:]
    seconds = {k: statistics.median(r.seconds.get(k, 0.0) for r in counted) for k in last.seconds}
    prove = seconds["candidate"] + seconds["local"] + seconds["ring"]
    layers = "-".join(map(str, policy.network.layers))
    print(f"\n{path.name}: {last.verdict.value}, {layers}, limited by {last.reason}")
    print("  levels  " + ", ".join(f"{k} {v:.6g}" for k, v in asdict(last.levels).items() if v is not None))
    level = last.levels.roa
    if last.P is not None and level is not None:
        print(f"  volume  {volume(last.P, level):.6g}")
    print(f"  boxes   {last.boxes}, leaves {last.leaves}, certificate {size} bytes")
    print("  seconds " + ", ".join(f"{k} {v:.3f}" for k, v in seconds.items()))
    alone = [r.checker["seconds"]["check"] for r in counted if r.checker is not None]
    if prove > 0 and alone:
        check = statistics.median(alone)
        print(
            f"  ratio   check / prove {check / prove:.2f} (check {check:.3f} s, start-up aside; prove: candidate, "
            f"local, ring); the checker starts in {seconds['check'] - check:.3f} s"
        )


def throughput(path: Path, runs: int) -> None:
    """Boxes a second of the ring's bound, and the share of dgemm that its matrix products take at that rate."""
    policy = load_policy(path)
    loop = ClosedLoop(get_system(policy.system).with_parameters(policy.parameters), policy.network)
    A, _, _ = loop.linearise()
    P = solve_lyapunov(A, np.eye(len(A)))
    runner = ThreadRunner()
    rule = VdotBound(Problem(loop, Quadratic(P)), diagonalising_coordinates(P, A))
    n, m = loop.system.n, loop.system.m
    batch = 2048
    generator = np.random.default_rng(0)
    lo = 0.1 * generator.random((n, batch))
    rates = []
    a, b = generator.random((512, 512)), generator.random((512, 8192))
    products = []
    for _ in range(runs + 1):  # in turn, so that both see the same machine
        with runner.start(rule) as bound:
            bound(lo, lo + 0.01, 1e-9, 1e9)
            start = time.perf_counter()
            bound(lo, lo + 0.01, 1e-9, 1e9)
            rates.append(batch / (time.perf_counter() - start))
        start = time.perf_counter()
        _ = a @ b
        products.append(2 * 512 * 512 * 8192 / (time.perf_counter() - start))
    rate, dgemm = statistics.median(rates[1:]), statistics.median(products[1:])
    flops = sum(2 * W.size * (n + 1 + 2 + m) for W in policy.network.weights)
    share = f"{flops * rate / dgemm:.1%} of dgemm ({dgemm / 1e9:.0f} Gflop/s)"
    print(f"  bound   {rate:.0f} boxes/s; its matrix products are {share}")


def main() -> None:
    """Parse the arguments and run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("policies", nargs="*", type=Path, default=sorted(POLICIES.glob("*.pt")))
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--candidate", default="lyapunov", choices=("auto", "lyapunov", "scaled", "lqr", "optimised"))
    parser.add_argument("--effort", type=float, default=2.0)
    parser.add_argument("--against", metavar="REV", help="another commit, to be compared with")
    parser.add_argument("--boxes", type=int, default=20_000, help="in a pass of that comparison, at most")
    options = parser.parse_args()
    if options.against is not None:
        chosen = ["--candidate", options.candidate, "--effort", str(options.effort)]
        compare(options.against, options.policies, options.runs, options.threads, options.boxes, chosen)
        return
    os.environ["OMP_NUM_THREADS"] = str(options.threads)  # a runner reads it
    print(f"numpy {np.__version__}, {options.threads} threads, median of {options.runs} runs")
    for path in options.policies:
        whole_job(path, RoaOptions(candidate=options.candidate, effort=options.effort), options.runs)
        throughput(path, options.runs)


if __name__ == "__main__":
    main()
