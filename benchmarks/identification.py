"""How well A, B and K are identified, round by round: which transitions are fitted, and with which terms.

Run as `python benchmarks/identification.py [PLANT ...]`. Rounds are gathered as a training run gathers them, with
uniform random inputs instead of the actor's; there are no networks. Every learner sees the same transitions.
"""

from __future__ import annotations

import argparse
import itertools
from dataclasses import replace
from typing import get_args

import numpy as np

from certify.loop.plants import get_system
from controllers.identification.gain_learner import GainLearner
from controllers.identification.linearisation import errors_of
from controllers.options import Terms, Transitions, available_plants, preset
from controllers.training.environment import PlantEnvironment

Kind = tuple[Transitions, Terms]
KINDS: list[Kind] = list(itertools.product(get_args(Transitions), get_args(Terms)))


def errors(plant: str, seed: int, rounds: int, shrink: float) -> dict[Kind, list[tuple[float, float, float]]]:
    """Relative errors of (A, B, K) after each round; episodes start in the ball and end on leaving it."""
    system = get_system(plant)
    options = replace(preset(plant), eta=shrink * preset(plant).eta)
    Q, R = np.array(options.state_weights), np.array(options.input_weights)
    learners = {
        kind: GainLearner(options.eta, options.n_A, options.n_B, np.diag(Q), np.diag(R), "idle", *kind)
        for kind in KINDS
    }
    first = learners[KINDS[0]]
    environment = PlantEnvironment(system, options)
    environment.reset(seed=seed)
    u_eq = np.array([float(u) for u in system.exact_u_eq()])
    found: dict[Kind, list[tuple[float, float, float]]] = {kind: [] for kind in KINDS}
    for _ in range(rounds):
        for learner in learners.values():
            learner.refresh()
        while first.phase != "idle":
            x, _ = environment.reset(options={"radius": options.eta})
            ended = False
            while not ended and first.phase != "idle":
                u = (
                    u_eq
                    if first.phase == "A"
                    else environment.np_random.uniform(*np.array(system.input_bounds, float).T)
                )
                x_next, _, terminated, truncated, _ = environment.step(u)
                for learner in learners.values():
                    learner.observe(x, u - u_eq, x_next)
                x, ended = x_next, terminated or truncated or not first.inside(x_next)
        for kind, learner in learners.items():
            if learner.identified is not None:
                found[kind].append(errors_of(learner.identified, system, options.dt, Q, R))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("plants", nargs="*", default=available_plants())
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--rounds", type=int, default=4)
    parser.add_argument("--shrink", type=float, default=1.0, help="factor on the preset's eta")
    arguments = parser.parse_args()
    print(f"medians over {arguments.seeds} seeds, in per cent; of K the largest as well")
    for plant in arguments.plants:
        runs = [errors(plant, seed, arguments.rounds, arguments.shrink) for seed in range(arguments.seeds)]
        for kind in KINDS:
            figures = 100 * np.array([run[kind] for run in runs])  # (seeds, rounds, 3)
            for k, (A, B, K) in enumerate(np.median(figures, axis=0)):
                largest = figures[:, k, 2].max()
                title = f"{plant:12} {kind[0]:7} {kind[1]:10} round {k + 1}"
                print(f"{title}   A {A:8.4f}   B {B:8.4f}   K {K:8.4f}, at most {largest:.4f}", flush=True)


if __name__ == "__main__":
    main()
