"""Plants as gymnasium environments.

Importing this module registers `certify/<plant>-v0` for each file of `controllers.plants.shipped`. Gymnasium 1.0 and
later read no entry points of installed packages; an id that names this module finds the environment without an import:

>>> import gymnasium
>>> environment = gymnasium.make("controllers.training.environment:certify/pendulum-v0")
>>> state, _ = environment.reset(seed=0)
>>> state.dtype, environment.action_space
(dtype('float64'), Box(-6.0, 6.0, (1,), float64))
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from certify.loop.plants import System, get_system
from controllers.options import TrainingOptions, available_plants, preset
from controllers.simulation.stepping import Stepper

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Snapshot:
    """The state of an environment, enough to continue an episode exactly."""

    x: tuple[float, ...]
    elapsed: int


class PlantEnvironment(gymnasium.Env):  # type: ignore[misc]  # gymnasium is untyped here
    """A plant as a gymnasium environment.

    Observation: the raw, unwrapped state in float64. Action: the physical input; outside its bounds it is
    clipped, as an actuator would. Reward: `r0 - x'Q_r x` at the state reached, or with `reward_at` "current" at the
    state left; less `c` when the state reached lies outside the domain, which is `terminated`; the time limit is
    `truncated`.

    Parameters
    ----------
    system : the plant.
    options : `dt`, `horizon`, `start`, and the reward's numbers.

    Raises
    ------
    InputError : Q_r does not have one weight a state, or `dt` is no time step of this plant.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  # gymnasium's own signature

    def __init__(self, system: System, options: TrainingOptions) -> None:
        options.check(system)
        self.system = system
        self.options = options
        self._step: Callable[[Array, Array], Array] = Stepper(system, options.dt, "numpy")
        self._lo, self._hi = np.array(system.domain, dtype=np.float64).T
        self._u_lo, self._u_hi = np.array(system.input_bounds, dtype=np.float64).T
        self._Q_r = np.array(options.reward_weights)
        # The last observation of an episode lies outside the domain, so the space is unbounded.
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (system.n,), np.float64)
        self.action_space = gymnasium.spaces.Box(self._u_lo, self._u_hi, dtype=np.float64)
        self._x = np.zeros(system.n)
        self._elapsed = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Start uniformly in the share `start` of the domain, or in a ball with `options={"radius": eta}`."""
        super().reset(seed=seed)
        radius = None if options is None else options.get("radius")
        if radius is None:
            share = self.options.start
            self._x = self.np_random.uniform(share * self._lo, share * self._hi)
        else:
            self._x = _uniform_in_ball(self.np_random, self.system.n, float(radius))
        self._elapsed = 0
        return self._x.copy(), {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Hold `action` for dt, or for one step of a plant in discrete time."""
        u = np.clip(np.asarray(action, dtype=np.float64), self._u_lo, self._u_hi)
        left = self._x
        x = self._x = self._step(left, u)
        self._elapsed += 1
        terminated = bool(((x < self._lo) | (x > self._hi)).any())
        judged = x if self.options.reward_at == "next" else left
        reward = self.options.reward_offset - float((self._Q_r * judged * judged).sum())
        if terminated:
            reward -= self.options.penalty
        return x.copy(), reward, terminated, self._elapsed >= self.options.horizon, {}

    def snapshot(self) -> Snapshot:
        """The state of the episode; the random generator is `np_random` and is saved by its owner."""
        return Snapshot(tuple(self._x.tolist()), self._elapsed)

    def restore(self, snapshot: Snapshot) -> None:
        """Continue from `snapshot`."""
        self._x, self._elapsed = np.array(snapshot.x), snapshot.elapsed


def make_environment(name: str) -> PlantEnvironment:
    """The registered plant `name` with its preset options."""
    return PlantEnvironment(get_system(name), preset(name))


def _uniform_in_ball(generator: np.random.Generator, n: int, radius: float) -> Array:
    direction = generator.standard_normal(n)
    length = radius * generator.uniform() ** (1 / n)
    return np.asarray(direction * (length / np.linalg.norm(direction)))


for _name in available_plants():
    _id = f"certify/{_name}-v0"
    if _id not in gymnasium.registry:  # executed twice, it would warn of every id
        # By name: the entry point is looked up when an environment is made.
        gymnasium.register(_id, entry_point="controllers.training.environment:make_environment", kwargs={"name": _name})
