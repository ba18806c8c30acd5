"""Samples of a plant that ships, in place of an experiment: states, an input, and the rate of a state.

`python examples/unknown/sample.py pendulum samples.csv` takes them on a grid, `--scattered 525` at random points, half
of them closer to the origin by a random factor. Each rate is off by at most the noise; `certify fit` is told
the noise and bounds of second derivatives, and nothing of the plant's equations.
"""

from __future__ import annotations

import argparse
import csv
from itertools import product
from pathlib import Path

import numpy as np

from certify import get_system
from certify.loop.plants import load_system

HERE = Path(__file__).parent.parent


def spread(end: float, count: int, near: float) -> list[float]:
    """An odd number of values from -end to end, of which the two beside 0 are `near`, with growing steps."""
    steps = (count - 1) // 2
    powers = np.linspace(0, 1, steps) ** 1.5
    half = near * (1 - powers) + end * powers if steps > 1 else np.array([end])
    return [*(-half[::-1]).round(3), 0.0, *half.round(3)]


GRIDS = {  # values of states and inputs; closer to each other near the origin, where slopes are found
    "pendulum": ("pendulum", "theta_dot", [spread(3.14, 21, 0.06), spread(20, 5, 8), spread(6, 5, 3)]),
    "oscillator": (
        "plants/van_der_pol.toml", "x2", [spread(3, 25, 0.02), spread(3, 19, 0.02), [-1, 1]],
    ),
}  # fmt: skip


def main() -> None:
    """Write the file."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("plant", choices=sorted(GRIDS))
    parser.add_argument("out")
    parser.add_argument("--noise", type=float, default=1e-2)
    parser.add_argument("--scattered", type=int, metavar="N", help="N random points instead of a grid")
    parser.add_argument("--even", action="store_true", help="that factor is drawn evenly, and not its logarithm")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    name, state, axes = GRIDS[given.plant]
    plant = load_system(HERE / name) if name.endswith(".toml") else get_system(name)
    draw, n = np.random.default_rng(given.seed), plant.n
    z = np.array(list(product(*axes)), dtype=float)
    if given.scattered:
        z = draw.uniform(-1, 1, (given.scattered, len(axes))) * z.max(axis=0)
        shape = len(z[::2]), 1
        z[::2, :n] *= draw.uniform(0, 1, shape) if given.even else 10 ** draw.uniform(-2.5, 0, shape)
        z = z.round(6)
    row = [s.name for s in plant.states].index(state)
    rates = plant.function()(z[:, :n], z[:, n:])[:, row]
    rates += draw.uniform(-given.noise, given.noise, len(z))
    with open(given.out, "w", newline="") as file:
        table = csv.writer(file)
        table.writerow([*(s.name for s in plant.states), *(u.name for u in plant.inputs), f"{state}_rate"])
        table.writerows(np.column_stack([z, rates]).tolist())


if __name__ == "__main__":
    main()
