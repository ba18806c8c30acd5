"""How `swing_up.pt` was trained: `python examples/policies/gymnasium/swing_up.py [FILE]`, half a minute on one core.

The dynamic program of Gymnasium's Pendulum-v1 is solved on a grid, over all states and 9 torques; then a small network
learns to take the step with the least value behind it. It reads cos, sin and the speed, and so is periodic.
"""

from __future__ import annotations

import math
import sys
from fractions import Fraction
from pathlib import Path

import torch
from torch import Tensor, nn

from certify.loop.plants import load_system
from certify.loop.policies import Policy, save_policy
from certify.loop.policies.importers import ImportOptions, import_module

PLANT = Path(__file__).parents[2] / "plants" / "gymnasium" / "pendulum.toml"
SEEN = ("cos(theta)", "sin(theta)", "theta_dot")
CELLS, SPEEDS = 180, 161  # of one turn, and of speeds from -8 to 8 rad/s


def step(x: Tensor, u: Tensor) -> Tensor:
    speed = (x[:, 1] + 0.05 * (15 * torch.sin(x[:, 0]) + 3 * u)).clamp(-8, 8)
    return torch.stack([x[:, 0] + 0.05 * speed, speed], 1)


def cost(x: Tensor, u: Tensor) -> Tensor:
    return 0.05 * (1 - torch.cos(x[:, 0]) + 0.02 * x[:, 1] ** 2 + 0.1 * u**2)


def at(V: Tensor, x: Tensor) -> Tensor:
    """Values on the grid, between its points by bilinear interpolation."""
    a, b = (x[:, 0] / math.tau % 1) * CELLS, ((x[:, 1] + 8) * (SPEEDS - 1) / 16).clamp(0, SPEEDS - 1.001)
    i, j = a.detach().long() % CELLS, b.detach().long()
    s, t, k = a - a.detach().floor(), b - j, (i + 1) % CELLS
    return (1 - s) * ((1 - t) * V[i, j] + t * V[i, j + 1]) + s * ((1 - t) * V[k, j] + t * V[k, j + 1])


def trained(seed: int = 0) -> nn.Sequential:
    """A 3-8-8-1 network of (cos, sin, speed) that takes the step with the least value behind it."""
    torch.manual_seed(seed)
    grid = torch.cartesian_prod(torch.arange(CELLS) * math.tau / CELLS, torch.linspace(-8, 8, SPEEDS))
    inputs, V = [u.expand(len(grid)) for u in torch.linspace(-2, 2, 9)], torch.zeros(CELLS, SPEEDS)
    for _ in range(80):
        V = torch.stack([cost(grid, u) + 0.999 * at(V, step(grid, u)) for u in inputs]).min(0)[0].view_as(V)
    net = nn.Sequential(nn.Linear(3, 8), nn.Tanh(), nn.Linear(8, 8), nn.Tanh(), nn.Linear(8, 1), nn.Tanh())
    optimiser = torch.optim.Adam(net.parameters(), 1e-2)
    rate = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, 4000, 1e-4)
    for _ in range(4000):
        x = (2 * torch.rand(1024, 2) - 1) * torch.tensor([math.pi, 8.0])
        x[:300] *= 0.15
        upright, seen = torch.eye(3)[:1], torch.stack([x[:, 0].cos(), x[:, 0].sin(), x[:, 1]], 1)
        u = 2 * torch.tanh(net[:-1](seen) - net[:-1](upright))[:, 0]
        optimiser.zero_grad()
        (cost(x, u) + 0.999 * at(V, step(x, u)) - at(V, x)).mean().backward()
        optimiser.step()
        rate.step()
    return net


def main(file: str | Path) -> None:
    """Train, and write the policy."""
    torch.set_num_threads(1)
    plant, scale = load_system(PLANT), (Fraction(2),)
    said = ImportOptions(states=SEEN, action_scale=scale, normaliser="none", centre="preactivation")
    network = import_module(trained(), plant, said).policy.network
    save_policy(Path(file), Policy(network, plant.name, training={"script": Path(__file__).name, "seed": 0}))


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).with_suffix(".pt"))
