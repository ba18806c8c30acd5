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
    chosen = options_of({"claim": "invariant", **options}, plant, print)
    result = certify_invariant(plant, network, folder / name, chosen)
    print(f"{name}: {result.verdict.value}\ncertificate  {result.certificate}")
    return result


def main(folder: str | Path = "out/examples/invariant_sets") -> list[InvariantResult]:
    """Prove both sets."""
    generator = np.random.default_rng(1)
    x = generator.uniform([-3, -4], [3, 4], (2000, 2))
    brake = imitate(lambda x: -0.2 * x[:, 1], x, 6, 1.0, 0.0)
    radius, angle, psi = generator.uniform([1.3, 0, -0.6], [2.7, 2 * np.pi, 0.6], (4000, 3)).T
    steer = imitate(_steering, np.stack([radius * np.cos(angle), radius * np.sin(angle), psi], 1), 40, 2.5, 0.5)
    cycle = proved("limit_cycle", brake, Path(folder), candidate="polynomial", degree="8")
    course = proved("round_course", steer, Path(folder), lyapunov=COURSE)
    return [cycle, course]


def _steering(x: Any) -> Any:
    """The turning rate of the course, v/course = 1/2, more where the car is outside of it, less if it turns inwards."""
    beside = (x[:, 0] ** 2 + x[:, 1] ** 2 - 4) / 4
    return 0.5 + 0.8 * beside - 1.2 * x[:, 2]


if __name__ == "__main__":
    main(*sys.argv[1:2])
