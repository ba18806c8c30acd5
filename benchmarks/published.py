"""Sets of neural Lyapunov functions beside the published ones: the same checkpoints, plants and boxes.

Run with `python benchmarks/published.py [--folder FOLDER] [--only NAME ...] [--effort 36] [--learning 6]
[--out out/published]`. The folder holds checkpoints that others trained (of Two-Stage, NeurIPS 2025); rows whose files
are not there are left out, and say so. Each of these imports policy and function, proves, has the certificate checked,
and prints what was proved with the seconds that it took. The other rows learn a function for a loop, and print which
share of the simulated region of attraction inside the domain the proved set covers, in floats. Certificates stay in
`--out`. Absolute times are this machine's.
"""

from __future__ import annotations

import argparse
import hashlib
import math
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import scipy.linalg

from certify import PolicyNetwork, certify_roa, load_policy
from certify.analysis.results import RoaResult
from certify.loop.plants import System, get_system, load_system
from certify.loop.policies.importers import ImportOptions, import_policy
from certify.lyapunov import import_lyapunov
from certify.lyapunov.learning.flow import LearningFlow

EXAMPLES = Path(__file__).parent.parent / "examples"
SAMPLED = 40_000  # states, of which is simulated what becomes of them
FOLDER = Path(__file__).parent.parent.parent / "shared" / "external" / "two_stage"


@dataclass(frozen=True, slots=True)
class Row:
    """A checkpoint with what is said of it.

    Parameters
    ----------
    file : its name without the ending.
    plant, parameters, domain : the plant, and half-widths of the box by state.
    states, squash, scale : what the file does not say of the policy.
    published : what its makers report.
    """

    file: str
    plant: str
    domain: Mapping[str, str]
    scale: str
    published: str
    parameters: Mapping[str, str]
    squash: str = "tanh"

    def system(self) -> System:
        """The plant in the box."""
        box = {name: (-Fraction(half), Fraction(half)) for name, half in self.domain.items()}
        return get_system(self.plant).with_parameters(self.parameters).with_domain(box)


ROWS = (
    Row(
        "pendulum_bigtorque_seed_0",
        "pendulum",
        {"theta": "30", "theta_dot": "120"},
        "6",
        "0.01 <= V <= 0.989, alpha,beta-CROWN 3.64 s on a GPU, dReal 1,480 s",
        {},
    ),
    Row(
        "cartpole_seed_0",
        "cartpole",
        {"p": "3.6", "theta": "2.4", "p_dot": "12", "theta_dot": "12"},
        "30",
        "0.01 <= V <= 0.989, alpha,beta-CROWN 76,443 s on a GPU, dReal timed out",
        {"l": "1"},
    ),
    Row(
        "2dquadrotor_seed_0",
        "quadrotor2d",
        {"x": "12", "y": "13.2", "theta": "12", "x_dot": "19.2", "y_dot": "20.4", "theta_dot": "88.8"},
        "6",
        "verified on a GPU with 32 GB",
        {},
        "relu-tanh",
    ),
)


def run(row: Row, folder: Path, out: Path, effort: float) -> RoaResult | None:
    """The row's result; None if its file is not there."""
    path = folder / f"{row.file}.pth"
    if not path.is_file():
        print(f"{row.file}: left out, {path} is not there")
        return None
    system = row.system()
    options = ImportOptions(
        kind="two-stage",
        states=tuple(s.name for s in system.states),
        squash=row.squash,  # type: ignore[arg-type]
        action_scale=(Fraction(row.scale),),
    )
    network = import_policy(path, system, options).policy.network
    N = import_lyapunov(path, system, options).stored.function
    start = time.perf_counter()
    result = certify_roa(system, network, out / row.file, lyapunov=N, effort=effort)
    seconds = time.perf_counter() - start
    print(f"\n{row.file} (sha256 {hashlib.sha256(path.read_bytes()).hexdigest()[:16]}...)")
    print(f"  published  {row.published}")
    print(
        f"  box        {', '.join(f'|{name}| <= {half}' for name, half in row.domain.items())}; no hole, no tolerance"
    )
    checked = "nothing" if result.checker is None else result.checker["result"]
    print(f"  here       {result.verdict.value}, checker {checked}, {seconds:.1f} s in all")
    stages = ", ".join(f"{name} {s:.2f}" for name, s in result.seconds.items())
    print(f"  seconds    {stages}")
    print(f"  ellipsoid  {result.volume:.6g}" if result.volume is not None else "  ellipsoid  none")
    if result.outer is None:
        print(f"  set        none beyond it: {result.notice}")
    if result.outer is not None:
        o = result.outer
        print(f"  set        N <= {o.level:.8g}, V = {1 / (1 + math.exp(-o.level)):.6f}, ended by {o.limit}")
        print(f"  volume     {o.volume:.6g} (estimated, standard deviation {o.deviation:.2g})")
        print(f"  boxes      {o.boxes:,}, leaves {o.leaves:,}")
    return result


@dataclass(frozen=True, slots=True)
class Loop:
    """A plant under a policy, on a box, for which a function is learned."""

    name: str
    system: System
    network: PolicyNetwork
    published: str


def _still(n: int) -> PolicyNetwork:
    """No input."""
    return PolicyNetwork.of_layers((np.zeros((1, n)),), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none")


def _shipped(name: str, box: Mapping[str, str]) -> tuple[System, PolicyNetwork]:
    policy = load_policy(EXAMPLES / "policies" / f"{name}.pt")
    system = get_system(policy.system).with_parameters(policy.parameters)
    return system.with_domain({s: (-Fraction(d), Fraction(d)) for s, d in box.items()}), policy.network


def _saturated() -> tuple[System, PolicyNetwork]:
    """The pendulum with its LQR, tanh of it, of 0.75 N m at most."""
    system = get_system("pendulum").with_domain(
        {"theta": (Fraction(-6), Fraction(6)), "theta_dot": (Fraction(-40), Fraction(40))}
    )
    A, B = np.array([[0, 1], [9.81 / 0.5, -0.1 / 0.0375]]), np.array([[0], [1 / 0.0375]])
    K = B.T @ scipy.linalg.solve_continuous_are(A, B, np.eye(2), np.eye(1))
    return system, PolicyNetwork.of_layers(
        (-K / 0.75,), (np.zeros(1),), np.array([0.75]), np.zeros(1), "tanh", "preactivation"
    )


def loops() -> tuple[Loop, ...]:
    """The loops that a function is learned for."""
    oscillator, machines = (
        load_system(EXAMPLES / "plants" / f"{name}.toml") for name in ("van_der_pol", "two_machines")
    )
    first, second = (s.name for s in oscillator.states)
    slow = oscillator.with_parameters({"mu": "1"}).with_domain({first: _sides("5/2"), second: _sides("7/2")})
    fast = oscillator.with_parameters({"mu": "3"}).with_domain({first: _sides("3"), second: _sides("6")})
    angle, speed = (s.name for s in machines.states)
    power = machines.with_domain({angle: (Fraction(-2), Fraction(3)), speed: (Fraction(-3), Fraction(3, 2))})
    wide = {"p": "12", "theta": "24/5", "p_dot": "32", "theta_dot": "32"}
    return (
        Loop("learned_pendulum", *_shipped("pendulum", {"theta": "6", "theta_dot": "40"}), "nobody's"),
        Loop("learned_saturated_pendulum", *_saturated(), "nobody's with this policy"),
        Loop("learned_van_der_pol_1", slow, _still(2), "LyZNet: 94.8 % of its box's region, 973 s"),
        Loop("learned_van_der_pol_3", fast, _still(2), "LyZNet: 85.2 %, 442 s"),
        Loop("learned_two_machines", power, _still(2), "LyZNet: 82.3 %, 3,375 s"),
        Loop("learned_cartpole", *_shipped("cartpole", wide), "nobody's"),
    )


def _sides(half: str) -> tuple[Fraction, Fraction]:
    return -Fraction(half), Fraction(half)


def learn(loop: Loop, out: Path, effort: float) -> RoaResult:
    """The loop's result, with a function that is learned."""
    start = time.perf_counter()
    result = certify_roa(loop.system, loop.network, out / loop.name, candidate="neural", effort=effort)
    seconds = time.perf_counter() - start
    checked = "nothing" if result.checker is None else result.checker["result"]
    print(f"\n{loop.name}")
    print(f"  published  {loop.published}")
    print(f"  box        {', '.join(f'{s} in [{lo}, {hi}]' for s, (lo, hi) in _box(loop.system))}")
    print(f"  here       {result.verdict.value}, checker {checked}, {seconds:.1f} s in all")
    if result.problem is None or result.levels.roa is None or result.outer is None:
        print("  set        none beyond the ellipsoid")
        return result
    V, c2, N, n2 = result.problem.V, result.levels.roa, result.outer.function, result.outer.level
    flow = LearningFlow(result.problem.loop, V, c2)
    x = flow.uniform(SAMPLED, np.random.default_rng(7))
    attracted = flow.run(x, flow.high - flow.low).converged
    covered = float(np.mean(((N(x) <= n2) | (V(x) <= c2))[attracted]))
    ellipse = float(np.mean((V(x) <= c2)[attracted]))
    print(f"  region     {np.mean(attracted) * float(np.prod(flow.high - flow.low)):.6g} by simulation inside the box")
    print(f"  covered    {covered:.1%} of it, by the ellipsoid alone {ellipse:.1%}")
    print(f"  volume     {result.outer.volume:.6g} (estimated), of the ellipsoid {result.volume:.6g}")
    print(f"  boxes      {result.outer.boxes:,}, leaves {result.outer.leaves:,}")
    print(f"  seconds    {', '.join(f'{name} {s:.2f}' for name, s in result.seconds.items())}")
    return result


def _box(system: System) -> list[tuple[str, tuple[Fraction, Fraction]]]:
    return [(s.name, pair) for s, pair in zip(system.states, system.domain, strict=True)]


def main(arguments: Sequence[str] | None = None) -> None:
    """Parse the arguments and run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, default=FOLDER)
    parser.add_argument("--only", nargs="*", default=None)
    parser.add_argument("--effort", type=float, default=36.0)
    parser.add_argument("--learning", type=float, default=6.0, help="effort for a loop with a learned function")
    parser.add_argument("--out", type=Path, default=Path("out") / "published")
    options = parser.parse_args(arguments)
    for row in ROWS:
        if options.only is None or row.file in options.only:
            run(row, options.folder, options.out, options.effort)
    for loop in loops():
        if options.only is None or loop.name in options.only:
            learn(loop, options.out, options.learning)


if __name__ == "__main__":
    main()
