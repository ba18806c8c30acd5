"""One ring, several engines, in one run: bounds, plain interval propagation, and dReal where it is installed.

`python benchmarks/engines.py [--limit 300] [--runs 3]`: the shipped policies, fitted pendulum networks of growing
width, and the fitted planar quadrotor. Each engine is asked for the same ring `c1 <= V <= c2` with c1 from the local
proof and c2 a share of the smaller of the domain's and the sampled limit. Bounds and intervals run in this
process, dReal in one of its own, whose start is not counted. UNKNOWN rows stay in the table.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from fitted import fit_policy, spread_of
from intervals import PlainIntervals

from certify.certificates.claims import Problem
from certify.certificates.claims.conditions import ring_condition
from certify.certificates.claims.queries import Query, query
from certify.effort import Effort
from certify.errors import BackendError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.plants import get_system
from certify.loop.policies import load_policy
from certify.lyapunov import diagonalising_coordinates, domain_limit, solve_lyapunov
from certify.lyapunov.function import Quadratic
from certify.provers.ball.local import prove_local
from certify.provers.base import Budget
from certify.provers.boxes.search import prove_outwards
from certify.provers.dreal import backend as dreal
from certify.provers.execution import ThreadRunner
from certify.provers.falsify import falsify

POLICIES = Path(__file__).parent.parent / "examples" / "policies"


def loops() -> Iterator[tuple[str, ClosedLoop, float]]:
    """(name, closed loop, c2 as a share of the limit)."""
    for name, share in (("pendulum", 1 - 1e-9), ("cartpole", 0.5)):
        policy = load_policy(POLICIES / f"{name}.pt")
        system = get_system(policy.system).with_parameters(policy.parameters)
        yield f"{name}, shipped", ClosedLoop(system, policy.network), share
    pendulum = get_system("pendulum")
    for width in (16, 32, 64, 128):
        yield "pendulum, fitted", ClosedLoop(pendulum, fit_policy(pendulum, (width, width), spread_of(pendulum))), 0.9
    quadrotor = get_system("quadrotor2d")
    yield "quadrotor2d, fitted", ClosedLoop(quadrotor, fit_policy(quadrotor, (256,) * 4, spread_of(quadrotor))), 0.1


def main() -> None:
    """Run the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--limit", type=float, default=300.0, help="seconds for each engine and ring")
    parser.add_argument("--runs", type=int, default=3, help="runs of what takes less than five seconds; medians count")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--precision", type=float, default=1e-3)
    parser.add_argument("--only", default="", help="rows whose name contains this")
    options = parser.parse_args()
    try:
        backend: dreal.Backend | None = dreal.find_backend()
    except BackendError as error:
        print(error)
        backend = None
    version = "no dReal" if backend is None else f"dReal {backend.version}, precision {options.precision:g}"
    print(f"numpy {np.__version__}, {options.threads} threads, {version}, {options.limit:g} s each")
    for name, loop, share in loops():
        if options.only not in name:
            continue
        A, _, _ = loop.linearise()
        P = solve_lyapunov(A, np.eye(len(A)))
        problem, T = Problem(loop, Quadratic(P)), diagonalising_coordinates(P, A)
        limit = domain_limit(P, loop.system.domain)
        witness = falsify(problem, T, limit)
        outer = share * (limit if witness is None else witness.level)
        inner = prove_local(problem, T, outer)
        if inner is None:
            print(f"{name}: the local proof fails")
            continue
        layers = "-".join(map(str, loop.network.layers))
        print(f"\n{name} {layers}: {inner:.3g} <= V <= {outer:.6g}")
        rows: dict[str, Callable[[], tuple[str, float, str]]] = {
            "bounds": lambda p=problem, T=T, a=inner, b=outer: ring(p, T, a, b, options, False),
            "intervals": lambda p=problem, T=T, a=inner, b=outer: ring(p, T, a, b, options, True),
        }
        if backend is not None:
            asked = query(ring_condition(inner, outer), problem)
            rows["dreal"] = lambda q=asked: ask(backend, q, options)
        reference = None
        for engine, run in rows.items():
            verdict, seconds, detail = run()
            if seconds < 5:
                seconds = statistics.median(run()[1] for _ in range(options.runs))
            reference = reference or seconds
            print(f"  {engine:<10}{verdict:<9}{seconds:>9.3f} s {seconds / reference:>9.1f} x   {detail}", flush=True)


def ring(
    problem: Problem, T: np.ndarray, inner: float, outer: float, options: argparse.Namespace, plain: bool
) -> tuple[str, float, str]:
    """Verdict, seconds and detail of this project's branch and bound, with its own rule or with plain intervals."""
    start = time.perf_counter()
    rule = PlainIntervals(problem, T) if plain else None
    budget = Budget(Effort(seconds=options.limit), boxes=10**8)
    proof = prove_outwards(problem, T, inner, outer, budget, ThreadRunner(options.threads), rule=rule)
    seconds = time.perf_counter() - start
    if proof.outer >= outer:
        return "PROVED", seconds, f"{proof.boxes} boxes"
    return "UNKNOWN", seconds, f"{proof.boxes} boxes, proved to {proof.outer / outer:.3g} of c2 ({proof.stop.value})"


def ask(backend: dreal.Backend, query: Query, options: argparse.Namespace) -> tuple[str, float, str]:
    """Verdict, seconds of the solver alone, and detail of dReal."""
    answer = dreal.decide(backend, query, options.precision, 1, options.limit)
    seconds = answer.seconds if answer.solver_seconds is None else answer.solver_seconds
    return "PROVED" if answer.status == "unsat" else "UNKNOWN", seconds, answer.status + answer.detail


if __name__ == "__main__":
    main()
