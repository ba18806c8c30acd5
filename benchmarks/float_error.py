"""How far above the worst that is seen the bound of `certify float-error` lies, for each policy in examples/policies.

Run from the project's folder with `python -m benchmarks.float_error [NAME ...]`. Seen is the largest difference from
binary64 over some ten thousand states, random ones, corners and ones that were climbed to, of torch in float32 and of a
plain loop over the products; `chain 20` is the bound where no product passes through more than 20 additions.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from certify.loop.float32 import FloatOptions, float_error
from certify.loop.plants import available_systems, get_system, load_system
from certify.loop.policies import load_policy
from tests.support.single import Machine, adversarial, by_torch

EXAMPLES = Path(__file__).parent.parent / "examples"


def main() -> None:
    """Parse the arguments and run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=sorted(p.stem for p in (EXAMPLES / "policies").glob("*.pt")))
    print(f"{'policy':14}{'layers':>34}{'seen':>10}{'bound':>10}{'times':>8}{'chain 20':>10}{'times':>8}{'s':>6}")
    for name in parser.parse_args().names:
        print(row(name), flush=True)


def row(name: str) -> str:
    """The figures of one policy."""
    policy = load_policy(EXAMPLES / "policies" / f"{name}.pt")
    network, shipped = policy.network, policy.system in available_systems()
    plant = get_system(policy.system) if shipped else load_system(EXAMPLES / "plants" / f"{name}.toml")
    plant = plant.with_parameters(policy.parameters)
    u_eq = plant.exact_u_eq()
    lo, hi = (np.nextafter(end, 0) for end in np.array(plant.domain, dtype=float).T)
    states = adversarial(lambda x: by_torch(network, u_eq, x), lambda x: network(x, u_eq), lo, hi)
    exact = network(states, u_eq)
    computed = by_torch(network, u_eq, states), Machine()(network, u_eq, states)
    seen = max(float(np.abs(u - exact).max()) for u in computed)
    start = time.perf_counter()
    bound = max(float_error(network, plant).bounds)
    seconds = time.perf_counter() - start
    short = max(float_error(network, plant, FloatOptions(chain=20)).bounds)
    layers = "-".join(map(str, network.layers))
    figures = f"{seen:10.2g}{bound:10.2g}{bound / seen:8.0f}{short:10.2g}{short / seen:8.0f}{seconds:6.1f}"
    return f"{name:14}{layers:>34}{figures}"


if __name__ == "__main__":
    main()
