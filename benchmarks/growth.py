"""How boxes and seconds grow with width, depth, dimension, and the ratio of the levels.

`python benchmarks/growth.py [--seconds 60] [--threads 2]`: fitted policies, the ring to half of the sampled or domain
limit. A row that ran out of time stays in the table with the share of the level it reached.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from fitted import chain, fit_policy, spread_of

from certify.certificates.claims import Problem
from certify.effort import Effort
from certify.loop.closed_loop import ClosedLoop
from certify.loop.plants import System, get_system
from certify.lyapunov import diagonalising_coordinates, domain_limit, solve_lyapunov
from certify.lyapunov.function import Quadratic
from certify.provers.ball.local import prove_local
from certify.provers.base import Budget
from certify.provers.boxes.search import prove_outwards
from certify.provers.execution import ThreadRunner
from certify.provers.falsify import falsify

WIDTHS = (10, 10, 10, 9, 9, 9)


def cases() -> Iterator[tuple[str, System, tuple[int, ...], float | None]]:
    """(what varies, plant, hidden widths, c2 / c1 or None for the local proof's c1)."""
    for width in (16, 32, 64, 128, 256, 512):
        yield f"width {width}", get_system("cartpole"), (width, width), None
    for depth in (1, 2, 3, 4, 5):
        yield f"depth {depth}", get_system("cartpole"), (64,) * depth, None
    for n in (2, 3, 4, 5, 6):
        yield f"dimension {n}", chain(n), (32, 32), None
    for exponent in (1, 2, 4, 6, 8):
        yield f"c2/c1 1e{exponent}", get_system("cartpole"), (64, 64), 10.0**exponent


def problem_for(system: System, widths: tuple[int, ...]) -> tuple[Problem, np.ndarray]:
    """P from Q = I for a policy that is fitted here, and coordinates for boxes."""
    loop = ClosedLoop(system, fit_policy(system, widths, spread_of(system)))
    A, _, _ = loop.linearise()
    P = solve_lyapunov(A, np.eye(system.n))
    return Problem(loop, Quadratic(P)), diagonalising_coordinates(P, A)


def main() -> None:
    """Run the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0, help="limit for each ring")
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    print(f"numpy {np.__version__}, {options.threads} threads, {options.seconds:g} s a ring")
    print(
        f"{'case':<15}{'layers':<18}{'c1':>10}{'c2':>10}{'boxes':>10}{'leaves':>9}{'seconds':>9}{'boxes/s':>9}  result"
    )
    known: dict[tuple[str, tuple[int, ...]], tuple[Problem, np.ndarray]] = {}
    for what, system, widths, ratio in cases():
        key = (system.name, widths)
        if key not in known:
            known[key] = problem_for(system, widths)
        problem, T = known[key]
        limit = domain_limit(problem.V.P, system.domain)
        witness = falsify(problem, T, limit)
        target = 0.5 * (limit if witness is None else witness.level)
        inner = prove_local(problem, T, target) if ratio is None else target / ratio
        if inner is None:
            print(f"{what:<15}the local proof fails")
            continue
        start = time.perf_counter()
        proof = prove_outwards(
            problem, T, inner, target, Budget(Effort(seconds=options.seconds)), ThreadRunner(options.threads)
        )
        seconds = time.perf_counter() - start
        layers = "-".join(map(str, problem.loop.network.layers))
        share = "proved" if proof.outer >= target else f"{proof.stop.value}: {proof.outer / target:.3f} of c2"
        print(
            f"{what:<15}{layers:<18}{inner:>10.2e}{target:>10.2e}{proof.boxes:>10}{proof.leaves:>9}"
            f"{seconds:>9.2f}{proof.boxes / seconds:>9.0f}  {share}",
            flush=True,
        )


if __name__ == "__main__":
    main()
