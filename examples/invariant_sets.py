"""Sets that are never left, without an equilibrium: a limit cycle, and a car on a round course past an obstacle.

`python examples/invariant_sets.py [FOLDER]`. Both policies are small tanh networks whose last layer is fitted here by
least squares; the same numbers come out each time. `certify roa --claim invariant` proves the same from their files.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from certify.analysis.arguments import options_of
from certify.analysis.staying import InvariantResult, certify_invariant
from certify.loop.plants import load_system
from certify.loop.policies import Policy, PolicyNetwork, save_policy

PLANTS = Path(__file__).parent / "plants" / "invariant"
BESIDE = "(x**2 + y**2 - course**2)/course**2"  # about how far the car is beside the course, of its radius
COURSE = f"7/4*({BESIDE})**2 - 7/6*psi*({BESIDE}) + psi**2"


def imitate(law: Callable[[Any], Any], x: Any, units: int, scale: float, middle: float) -> PolicyNetwork:
    """A policy of one hidden layer, middle + scale tanh(...), fitted to a law at states x (N, n)."""
    generator = np.random.default_rng(0)
    W, b = generator.normal(size=(units, x.shape[1])) / x.std(0), generator.normal(size=units)
    before = np.arctanh((law(x) - middle) / scale)
    last, *_ = np.linalg.lstsq(np.column_stack([np.tanh(x @ W.T + b), np.ones(len(x))]), before, rcond=1e-4)
    return PolicyNetwork.of_layers([W, last[None, :-1]], [b, last[-1:]], [scale], [middle], centre="none")


def proved(name: str, network: PolicyNetwork, folder: Path, **options: str) -> InvariantResult:
    """Write the policy, and prove a set of its loop."""
    plant = load_system(PLANTS / f"{name}.toml")
    (folder / name).mkdir(parents=True, exist_ok=True)
    save_policy(folder / name / "policy.pt", Policy(network, plant.name))
    result = certify_invariant(
        plant, network, folder / name, options_of({"claim": "invariant", **options}, plant, print)
    )
    print(f"{name}: {result.verdict.value}\ncertificate  {result.certificate}")
    return result


def main(folder: str | Path = "out/examples/invariant_sets") -> list[InvariantResult]:
    """Prove both sets: the oscillator with a brake, the car that turns more the farther it is outside of the course."""
    generator = np.random.default_rng(1)
    brake = imitate(lambda x: -0.2 * x[:, 1], generator.uniform([-3, -4], [3, 4], (2000, 2)), 6, 1.0, 0.0)
    cycle = proved("limit_cycle", brake, Path(folder), candidate="polynomial", degree="8")
    r, angle, psi = generator.uniform([1.3, 0, -0.6], [2.7, 2 * np.pi, 0.6], (4000, 3)).T
    x = np.stack([r * np.cos(angle), r * np.sin(angle), psi], 1)
    steer = imitate(lambda x: 0.5 + 0.2 * (x[:, 0] ** 2 + x[:, 1] ** 2 - 4) - 1.2 * x[:, 2], x, 40, 2.5, 0.5)
    return [cycle, proved("round_course", steer, Path(folder), lyapunov=COURSE)]


if __name__ == "__main__":
    main(*sys.argv[1:2])
