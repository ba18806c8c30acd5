"""Output feedback: the angle is measured, a network trained here estimates the speed, and the whole loop is proved.

`python examples/output_feedback.py [FOLDER]`. The equations of `output_feedback/pendulum.toml` call the network; the
policy is the shipped pendulum's, which reads the estimates in the place of the states.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import numpy as np
import torch

from certify import RoaResult, certify_roa, load_policy

HERE = Path(__file__).parent
REACH = torch.tensor([3.2, 20.0, 3.2, 6.0]).double()  # of what the network reads: both estimates, the angle, the torque


def rate(x: torch.Tensor) -> torch.Tensor:
    """The rate in rad/s^2 of the speed's estimate that a Luenberger observer has, by the plant's equations."""
    m, r, b, g, (theta, speed, measured, u) = 0.15, 0.5, 0.1, 9.81, x.T
    return g / r * torch.sin(theta) - b / (m * r**2) * speed + u / (m * r**2) + 400 * (measured - theta)


def trained() -> torch.nn.Sequential:
    """A network that says about the same, and exactly 0 at rest."""
    torch.manual_seed(0)
    net = torch.nn.Sequential(torch.nn.Linear(4, 16), torch.nn.Tanh(), torch.nn.Linear(16, 1)).double()
    optimiser = torch.optim.Adam(net.parameters(), 3e-3)
    for _ in range(3000):
        x = (2 * torch.rand(512, 4).double() - 1) * REACH
        x[:, 2] = x[:, 0] + 0.3 * torch.randn(512)  # the estimate is not far from what is measured
        x = x * (0.02 + torch.rand(512, 1))
        optimiser.zero_grad()
        ((200 * net(x / REACH)[:, 0] - rate(x)) ** 2).mean().backward()
        optimiser.step()
    with torch.no_grad():
        net[0].weight /= REACH
        net[2].weight *= 200
        net[2].bias -= net(torch.zeros(1, 4).double())[0]
    return net


def main(folder: str | Path = "out/examples/output_feedback") -> RoaResult:
    """Train the observer, prove the loop, and print what is proved."""
    Path(folder).mkdir(parents=True, exist_ok=True)
    plant = Path(shutil.copy(HERE / "output_feedback" / "pendulum.toml", folder))
    torch.save(trained().state_dict(), Path(folder) / "observer.pt")
    law = load_policy(HERE / "policies" / "pendulum.pt").network
    first, *others = law.weights
    result = certify_roa(plant, law.with_layers((np.hstack([0 * first, first]), *others)), folder)
    print(f"{result!r}\ncertificate  {result.certificate}")
    return result


if __name__ == "__main__":
    main(*sys.argv[1:2])
