"""A policy of one's own, from a torch module to a certificate: here one that imitates a saturated LQR.

`python examples/own_policy.py [FOLDER]`. Replace `trained` by your own training: whatever is made of Linear and Tanh
layers is read by what it computes. The numbers that are proved are the module's, to the last bit.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import scipy.linalg
import torch

from certify import RoaResult, certify_roa, get_system
from certify.systems import in_floats, linearise

TORQUE = 6.0  # N m, what the pendulum's motor can do


def trained(seed: int = 0) -> torch.nn.Sequential:
    """A 2-16-1 network in [-1, 1] that has learned to answer as the LQR, saturated by tanh, does."""
    A, B = map(in_floats, linearise(get_system("pendulum")))
    K = B.T @ scipy.linalg.solve_continuous_are(A, B, np.eye(2), np.eye(1))
    torch.manual_seed(seed)
    net = torch.nn.Sequential(torch.nn.Linear(2, 16), torch.nn.Tanh(), torch.nn.Linear(16, 1), torch.nn.Tanh())
    states = (2 * torch.rand(2048, 2) - 1) * torch.tensor([3.0, 12.0])
    wanted = -torch.tanh(states @ torch.tensor(K.T / TORQUE, dtype=torch.float32))
    optimiser = torch.optim.Adam(net.parameters(), lr=1e-2)
    for _ in range(400):
        optimiser.zero_grad()
        torch.nn.functional.mse_loss(net(states), wanted).backward()
        optimiser.step()
    return net


def main(folder: str | Path = "out/examples/own_policy") -> RoaResult:
    """Train, and prove what was trained."""
    # What a module does not say of itself: which states it reads, as they are, and what its output is in N m.
    # Centring makes u = 0 at rest exactly; the policy with that shift is the one that must run.
    said = {"states": ["theta", "theta_dot"], "normaliser": "none", "action_scale": TORQUE, "centre": "preactivation"}
    result = certify_roa("pendulum", trained(), folder, importing=said)
    print(*result.notices, sep="\n")
    print(f"{result.verdict.value}  {result}")
    if result.certificate is not None:
        print(f"theta = 0.5, theta' = -1 is in the set: {result.contains([0.5, -1.0])}")
        print(f"certificate  {result.certificate}")
    return result


if __name__ == "__main__":
    main(*sys.argv[1:2])
