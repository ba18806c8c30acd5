"""An environment of Gymnasium that somebody named, in place of the equations: states are read from what it shows."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.errors import OptionError
from controllers.options import TrainingOptions
from controllers.plants.black_box import BlackBox, turned
from controllers.training.environment import PlantEnvironment

Array = NDArray[np.float64]


class BlackBoxEnvironment(PlantEnvironment):
    """A plant whose steps are those of another environment; states are deviations from the operating point.

    The reward is that of `PlantEnvironment`; the environment's own is of no account. An end of its episode by itself
    counts as leaving the domain. Where its state may be set, episodes start as of any plant, else where its `reset`
    puts them. An angle is followed over full turns.

    Raises
    ------
    InputError : `identification_starts` is "ball", and the state cannot be set.
    """

    def __init__(self, box: BlackBox, options: TrainingOptions) -> None:
        super().__init__(box.system, options)
        if options.identification_starts == "ball" and not box.settable:
            raise OptionError(
                "`identification_starts` must be domain: this environment's state cannot be set, so that episodes "
                "start where its reset puts them."
            )
        self.box, self._step = box, self._held
        self._x_eq = np.array([float(q) for q in box.system.exact_x_eq()])
        self._ended = False, False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Start as `PlantEnvironment` does where the state may be set, else anew."""
        x, _ = super().reset(seed=seed, options=options)
        shown, info = self.box.env.reset(seed=seed)
        if self.box.settable:
            self.box.env.unwrapped.state = self._x_eq + x
        else:
            self._x = turned(self.box.read(shown) - self._x_eq, self.box.angles)
        return self._x.copy(), info

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """One step of the environment."""
        x, reward, left, over, info = super().step(action)
        terminated, truncated = self._ended
        if terminated and not left:
            reward -= self.options.penalty
        return x, reward, left or terminated, over or truncated, info

    def acting(self, u: Array) -> NDArray[Any]:
        """The input as it acts: in the environment's own type and bounds."""
        space = self.box.env.action_space
        return np.asarray(np.clip(np.asarray(u, dtype=space.dtype), space.low, space.high))

    def _held(self, x: Array, u: Array) -> Array:
        shown, _, terminated, truncated, _ = self.box.env.step(self.acting(u))
        self._ended = bool(terminated), bool(truncated)
        return np.asarray(x + turned(self.box.read(shown) - self._x_eq - x, self.box.angles))
