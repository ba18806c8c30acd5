"""Measured transitions of a plant that ships, in place of an experiment: a state, an input held for 0.02 s, a state.

`python examples/unknown/measure.py pendulum data.csv`. States and inputs are drawn at random, and each measured number
is off by at most the noise; `certify identify` is told the noise and the time, and nothing of the plant's numbers.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from certify import System, get_system, load_policy

Array = NDArray[np.float64]
REACH = {  # of the states from which transitions begin
    "pendulum": [1.5, 2.0],
    "cartpole": [1.0, 0.5, 1.0, 1.0],
    "quadrotor2d": [1.0, 1.0, 0.5, 1.0, 1.0, 1.0],
    "quadrotor3d": [1.0, 1.0, 1.0, 0.4, 0.4, 0.5, *[1.0] * 6],
}
PERIOD, STEPS = 0.02, 20


def rubbing(plant: System, friction: float) -> Callable[[Array, Array], Array]:
    """The plant's equations with nearly Coulomb's friction beside the force or torque u, which no structure has."""
    f, rate = plant.function(), plant.n // 2  # the first velocity, along u in both
    return lambda x, u: f(x, u - friction * np.tanh(10 * x[:, rate, None])) if friction else f(x, u)


def main() -> None:
    """Write the file."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("plant", choices=sorted(REACH))
    parser.add_argument("out")
    parser.add_argument("--transitions", type=int, default=200)
    parser.add_argument("--length", type=int, help="of runs, in transitions that follow each other; by default none do")
    parser.add_argument("--noise", type=float, default=1e-3)
    parser.add_argument("--reach", help="of states and then inputs, 1,0.1,2,2,10; by default far, and all inputs")
    parser.add_argument("--friction", type=float, default=0.0, help="D tanh(10 v) less of u, of pendulum or cartpole")
    parser.add_argument("--policy", help="file of a policy that acts; by default inputs are random")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    plant, draw = get_system(given.plant), np.random.default_rng(given.seed)
    f, N, h = rubbing(plant, given.friction), given.transitions, PERIOD / STEPS
    reach = [float(part) for part in given.reach.split(",")] if given.reach else REACH[given.plant]
    runs, length = (N, 1) if given.length is None else (N // given.length, given.length)
    lo, hi = np.array([[float(end) for end in pair] for pair in plant.input_bounds]).T
    lo, hi = ([-1, 1] * np.array(reach[plant.n :])[:, None]).T if given.reach else (lo, hi)
    x, u = [draw.uniform(-1, 1, (runs, plant.n)) * reach[: plant.n]], draw.uniform(lo, hi, (length, runs, plant.m))
    act = load_policy(given.policy).network if given.policy else None
    for k in range(length):
        y = x[-1]
        if act is not None:
            u[k] = np.array([act(row, plant.exact_u_eq()) for row in y])
        held = u[k]
        for _ in range(STEPS):  # Runge and Kutta's method, whose error here is far below the noise
            k1 = f(y, held)
            k2 = f(y + h / 2 * k1, held)
            k3 = f(y + h / 2 * k2, held)
            y = y + h / 6 * (k1 + 2 * k2 + 2 * k3 + f(y + h * k3, held))
        x.append(y)
    seen = np.array(x) + draw.uniform(-given.noise, given.noise, np.shape(x))
    states, inputs = [s.name for s in plant.states], [s.name for s in plant.inputs]
    with open(given.out, "w", newline="") as file:
        table = csv.writer(file)
        if given.length is None:
            table.writerow([*states, *inputs, *(f"{s}_next" for s in states)])
            table.writerows(np.hstack([seen[0], u[0], seen[1]]).tolist())
            return
        table.writerow(["run", *states, *inputs])
        u = np.concatenate([u, u[-1:]])  # a file has an input beside the last state too, which nobody reads
        for run in range(runs):
            table.writerows([run, *state, *held] for state, held in zip(seen[:, run], u[:, run], strict=True))


if __name__ == "__main__":
    main()
