"""The episode under way in a training run."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controllers.training.environment import PlantEnvironment, Snapshot

Array = NDArray[np.float64]


class RunningEpisode:
    """The episode under way: the plant's state x, and return and length so far.

    Parameters
    ----------
    environment : the plant.
    seed : of its random numbers.

    Attributes
    ----------
    near : True for an episode that starts in the ball and ends on leaving it.
    """

    def __init__(self, environment: PlantEnvironment, seed: int) -> None:
        self.environment = environment
        self.near, self.total, self.length = False, 0.0, 0
        self.x, _ = environment.reset(seed=seed)

    def begin(self, radius: float | None) -> None:
        """Start an episode in the ball of this radius, or in the domain for None."""
        self.near, self.total, self.length = radius is not None, 0.0, 0
        self.x, _ = self.environment.reset(options=None if radius is None else {"radius": radius})

    def step(self, u: Array) -> tuple[Array, float, bool, bool]:
        """Hold the input u for one step: the next state, the reward, and if it is terminated or truncated."""
        x_next, reward, terminated, truncated, _ = self.environment.step(u)
        self.x = x_next
        self.total += reward
        self.length += 1
        return x_next, reward, terminated, truncated

    def state(self) -> dict[str, Any]:
        """Plain values for a checkpoint."""
        standing = self.environment.snapshot()
        return {
            # 128-bit integers: as text, which every reader of plain tensors accepts.
            "environment_generator": json.dumps(self.environment.np_random.bit_generator.state),
            "environment": [list(standing.x), standing.elapsed],
            "episode": [self.near, self.total, self.length],
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Continue from `state()`."""
        self.environment.np_random.bit_generator.state = json.loads(state["environment_generator"])
        x, elapsed = state["environment"]
        self.environment.restore(Snapshot(tuple(x), elapsed))
        self.x = np.array(x)
        self.near, self.total, self.length = state["episode"]
