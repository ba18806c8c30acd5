"""A pendulum that its motor cannot lift: a network swings it up from a box of states, as no gain does; proved.

`python examples/swing_up.py [FOLDER]`. Gymnasium's Pendulum-v1 has 2 N m where gravity needs 5. Gains are simulated.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import numpy as np

from certify import RoaResult, certify_roa, load_policy
from certify.certificates.membership import proved_set
from certify.loop.closed_loop import ClosedLoop
from certify.loop.plants import in_floats, linearise, load_system
from controllers.identification.riccati import riccati_gain

HERE = Path(__file__).parent
BOX = ((2.75, 3.55), (2.5, 3.8))  # theta in rad and its rate in rad/s: hanging is pi, upright takes 7.7 rad/s there
Law = Callable[[np.ndarray], np.ndarray]
PLANT = load_system(HERE / "plants" / "gymnasium" / "pendulum.toml").with_domain({"theta_dot": (-9, 9)})


def nearest(x: np.ndarray) -> np.ndarray:
    return x - np.array([2 * np.pi, 0]) * np.round(x[:, :1] / (2 * np.pi))  # the angle from the nearest upright


def run(law: Law, x: np.ndarray, steps: int) -> list[np.ndarray]:
    path, step = [x], PLANT.function()
    for _ in range(steps):
        path.append(step(path[-1], law(nearest(path[-1]))))
    return path


def settled(law: Law, x: np.ndarray) -> np.ndarray:
    return np.linalg.norm(nearest(run(law, x, 400)[-1]), axis=1) < 1e-3  # at rest upright after 20 s


def laws(K: np.ndarray) -> dict[str, Law]:
    A, B = map(in_floats, linearise(PLANT))
    gains = {"its own gain": K, "the LQR": riccati_gain(A, B, np.eye(2), np.eye(1))}
    return {name: lambda x, K=K: np.clip(-x @ K.T, -2, 2) for name, K in gains.items()}


def main(folder: str | Path = "out/examples/swing_up") -> RoaResult:
    loop = ClosedLoop(PLANT, load_policy(HERE / "policies" / "gymnasium" / "swing_up.pt").network)
    x0 = np.stack(np.meshgrid(*(np.linspace(*ends, 21) for ends in BOX)), -1).reshape(-1, 2)
    for name, law in {"the network": loop.policy, **laws(loop.linearise()[2])}.items():
        print(f"simulated: {name} settles from {settled(law, x0).sum()} of {len(x0)} states of the box")
    result = certify_roa(PLANT, loop.network, folder, ranks=True, effort=0.4)
    box = proved_set(result.certificate).locate([(Fraction(lo), Fraction(hi)) for lo, hi in BOX])
    print(f"the box is {box.answer.value} in the proved set\n{result}\ncertificate  {result.certificate}")
    return result


if __name__ == "__main__":
    main(*sys.argv[1:2])
