"""Policy files as other programs write them, and the plants that they control."""

from __future__ import annotations

import itertools
import warnings
from fractions import Fraction
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch

from certify.loop.expressions import Number, Symbol
from certify.loop.plants import System

TWO_STAGE = {
    "pendulum_bigtorque_seed_0.pth": ("pendulum", "theta,theta_dot", "tanh", 6, {}),
    "cartpole_seed_0.pth": ("cartpole", "p,theta,p_dot,theta_dot", "tanh", 30, {"l": 1}),
    "2dquadrotor_seed_0.pth": ("quadrotor2d", "x,y,theta,x_dot,y_dot,theta_dot", "relu-tanh", 6, {}),
    "3dquad_seed_0.pth": ("quadrotor3d", "x,y,z,phi,theta,psi,vx,vy,vz,p,q,r", "relu-tanh", "3.6", {}),
}
"""The checkpoints that somebody else trained: the plant, what the networks read, squash and scale, other parameters."""
ROOT = Path(__file__).parents[2]
PLACES = tuple(folder / "shared" / "external" for folder in (ROOT.parent, ROOT.parent.parent))  # beside the project


def external(*parts: str) -> Path | None:
    """A file that somebody else trained, if the folder with such files is there."""
    return next((f.joinpath(*parts) for f in PLACES if f.joinpath(*parts).is_file()), None)


def plant(n: int = 2, bound: float = 6, x_eq: tuple[int, ...] = ()) -> System:
    """A chain of n integrators with a stable last one; its states are x0, x1, ..."""
    states = tuple(Symbol(f"x{i}") for i in range(n))
    u = Symbol("u")
    return System(
        name="chain",
        states=states,
        inputs=(u,),
        parameters={},
        dynamics=(*states[1:], -sum(states) * 2 - states[-1] + u / 100),
        u_eq=(Number(0),),
        domain=((Fraction(-5), Fraction(5)),) * n,
        input_bounds=((Fraction(-bound), Fraction(bound)),),
        x_eq=tuple(Number(v) for v in x_eq),
    )


def mlp(
    widths: tuple[int, ...] = (2, 7, 5, 1), last: torch.nn.Module | None = None, seed: int = 0
) -> torch.nn.Sequential:
    """A perceptron with tanh between its layers."""
    torch.manual_seed(seed)
    modules: list[torch.nn.Module] = []
    for i, o in itertools.pairwise(widths):
        modules += [torch.nn.Linear(i, o), torch.nn.Tanh()]
    return torch.nn.Sequential(*modules[:-1], *([] if last is None else [last]))


def values(module: torch.nn.Module, x: np.ndarray) -> np.ndarray:
    """A module's values at states (k, n), in double precision."""
    with torch.no_grad():
        result: np.ndarray = module.double()(torch.tensor(x, dtype=torch.float64)).numpy()
    return result


def saved(folder: Path, data: Any, name: str = "policy.pt") -> Path:
    torch.save(data, folder / name)
    return folder / name


def two_stage(tmp_path: Path, system: System, scale: float, change: float = 0.0) -> tuple[Path, torch.nn.Sequential]:
    """A file in the form of the two-stage checkpoints, for a plant with two inputs."""
    module = mlp((system.n, 6, system.m))
    u_eq = torch.tensor([float(u) for u in system.exact_u_eq()])
    state = {f"controller.layers.{k}": v for k, v in module.state_dict().items()}
    state["controller.x_equilibrium"] = torch.zeros(system.n)
    state["controller.u_equilibrium"] = u_eq
    state["controller.b"] = torch.atanh(u_eq / scale) + change
    state |= {f"lyapunov.layers.{k}": v for k, v in mlp((system.n, 4, 1)).state_dict().items()}
    return saved(tmp_path, {"state_dict": state, "domain": 1.0}), module


class Toy(gymnasium.Env[np.ndarray, np.ndarray]):
    """Two states that decay; only the spaces matter."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = gymnasium.spaces.Box(-6.0, 6.0, (1,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        self.x = np.array([1.5, -0.5], dtype=np.float32)
        return self.x, {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.x = (0.9 * self.x + 0.1).astype(np.float32)
        return self.x, 0.0, False, False, {}


class Odd(Toy):
    """Spaces in double precision, whose bounds single precision does not hold."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gymnasium.spaces.Box(-0.1, 0.3, (1,), np.float64)


class Several(Toy):
    """A dictionary of observations, which `Dict` puts in the order of their names."""

    observation_space = gymnasium.spaces.Dict(
        {"speed": gymnasium.spaces.Box(-9, 9, (1,), np.float32), "place": gymnasium.spaces.Box(-9, 9, (1,), np.float32)}
    )

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset()
        return {"speed": self.x[1:], "place": self.x[:1]}, {}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        super().step(action)
        return {"speed": self.x[1:], "place": self.x[:1]}, 0.0, False, False, {}


def sb3(
    kind: str, folder: Path, world: type[Toy] = Toy, *, sde: bool | None = None, **policy: Any
) -> tuple[Any, Any, Path, Path]:
    """(model, normaliser, file of the model, file of the normaliser) of stable-baselines3, untrained."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import stable_baselines3
        from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

        environment = VecNormalize(DummyVecEnv([world]))
        algorithm = vars(stable_baselines3)[kind]
        of = "MultiInputPolicy" if world is Several else "MlpPolicy"
        given: dict[str, Any] = {} if sde is None else {"use_sde": sde}
        model = algorithm(of, environment, policy_kwargs=policy or None, seed=1, device="cpu", **given)
        environment.reset()
        for _ in range(20):
            environment.step(np.zeros((1, 1)))
        environment.training = False
        model.save(folder / f"{kind}.zip")
        environment.save(str(folder / "normaliser.pkl"))
    return model, environment, folder / f"{kind}.zip", folder / "normaliser.pkl"
