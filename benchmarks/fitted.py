"""Policies fitted to a saturated LQR, for plants and sizes that no shipped policy has.

`python benchmarks/fitted.py quadrotor2d --widths 256,256,256,256 --out out/quadrotor2d.pt` writes a policy file that
`certify roa --policy out/quadrotor2d.pt` reads. The fit is to `u = u_eq + s tanh(-K x / s)` over the domain, with the
gain's error as a second term: what the trained policies come close to, at a hundredth of the time.
"""

from __future__ import annotations

import argparse
from itertools import pairwise
from pathlib import Path

import numpy as np
import scipy.linalg
import torch
from numpy.typing import NDArray

from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import Number, Symbol, sin, symbols
from certify.loop.plants import System, available_systems, exact, get_system
from certify.loop.policies import Policy, PolicyNetwork, save_policy

Array = NDArray[np.float64]


def fit_policy(
    system: System, widths: tuple[int, ...], spread: Array, steps: int = 1200, seed: int = 0
) -> PolicyNetwork:
    """A tanh policy `n-widths-m` for `system`, within its input bounds.

    Parameters
    ----------
    spread : (n,), half-widths of the states that are fitted.
    """
    torch.manual_seed(seed)
    n, m = system.n, system.m
    lo, hi = (torch.tensor([float(b[k]) for b in system.input_bounds]) for k in (0, 1))
    u_eq = torch.tensor([float(u) for u in system.exact_u_eq()])
    scale, offset = (hi - lo) / 2, (hi + lo) / 2
    K = torch.tensor(lqr_gain(system), dtype=torch.float32)
    beta = torch.atanh((u_eq - offset) / scale)
    sizes = [n, *widths, m]
    layers = [torch.nn.Linear(a, b) for a, b in pairwise(sizes)]
    optimiser = torch.optim.Adam([p for layer in layers for p in layer.parameters()], 3e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)

    def net(x: torch.Tensor) -> torch.Tensor:
        for k, layer in enumerate(layers):
            x = layer(x.tanh() if k else x)
        return x

    origin, box = torch.zeros(n), torch.tensor(spread, dtype=torch.float32)
    slope = scale * (1 - beta.tanh() ** 2)
    for _ in range(steps):
        x = (2 * torch.rand(512, n) - 1) * box * torch.rand(512, 1)
        y = net(x) - net(origin)
        wanted = torch.atanh(((u_eq - x @ K.T).clamp(lo + 1e-3 * scale, hi - 1e-3 * scale) - offset) / scale)
        J = torch.autograd.functional.jacobian(net, origin, create_graph=True)
        gain_error = ((slope[:, None] * J + K) ** 2).sum() / (K**2).sum()
        loss = (((y + beta).tanh() - wanted.tanh()) ** 2).mean() + 0.1 * gain_error
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    return PolicyNetwork.of_layers(
        tuple(layer.weight.detach().double().numpy() for layer in layers),
        tuple(layer.bias.detach().double().numpy() for layer in layers),
        scale.double().numpy(),
        offset.double().numpy(),
        "tanh",
        "preactivation",
    )


def lqr_gain(system: System) -> Array:
    """Continuous LQR gain (m, n) for Q = I and R = 1 / (half the input's range)^2 scaled to a tenth of the state's."""
    n, m = system.n, system.m
    linear = PolicyNetwork.of_layers((np.zeros((m, n)),), (np.zeros(m),), np.ones(m), np.zeros(m), "identity", "output")
    A, B, _ = ClosedLoop(system, linear).linearise()
    half = np.array([float(hi - lo) / 2 for lo, hi in system.input_bounds])
    R = np.diag(9 / half**2)
    return np.asarray(np.linalg.solve(R, B.T @ scipy.linalg.solve_continuous_are(A, B, np.eye(n), R)))


def chain(n: int) -> System:
    """`x_i' = x_(i+1)`, `x_n' = sin(x_1) + u`: one family of plants in any dimension."""
    x = symbols(f"x{i}" for i in range(1, n + 1))
    u = Symbol("u")
    wide = (exact(-4), exact(4))
    return System(
        name=f"chain{n}",
        states=x,
        inputs=(u,),
        parameters={},
        dynamics=(*x[1:], sin(x[0]) + u),
        u_eq=(Number(0),),
        domain=(wide,) * n,
        input_bounds=((exact(-20), exact(20)),),
    )


def spread_of(system: System) -> Array:
    """A third of the domain, where the plants here do not yet saturate for long."""
    return np.array([float(min(-lo, hi)) / 3 for lo, hi in system.domain])


def main() -> None:
    """Fit one policy and write it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("system", choices=available_systems())
    parser.add_argument("--widths", default="256,256,256,256")
    parser.add_argument("--steps", type=int, default=1200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    torch.set_num_threads(1)
    system = get_system(options.system)
    widths = tuple(int(w) for w in options.widths.split(","))
    network = fit_policy(system, widths, spread_of(system), options.steps, options.seed)
    parameters = {name: str(q) for name, q in system.parameters.items()}
    options.out.parent.mkdir(parents=True, exist_ok=True)
    save_policy(options.out, Policy(network, options.system, parameters, training={"fitted": vars(options)["widths"]}))


if __name__ == "__main__":
    main()
