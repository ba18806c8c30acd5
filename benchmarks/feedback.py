"""The loops of Yang et al., state and output feedback in discrete time (ICML 2024), from the authors' own files.

`python benchmarks/feedback.py FOLDER` wants a copy of Verified-Intelligence/Lyapunov_Stable_NN_Controllers, of which it
reads `models`. Plants, steps, bounds and boxes are those of its `neural_lyapunov_training` and `verification`; output
feedback is written in the state and the error e of the observer's estimate, as there. Each loop is proved with default
options, and the second checker asked.

Beside it stands the most that the file's own V could show: the volume of {V < r} with r the least value of V on the
faces of the box, exactly for a quadratic V, else by samples, which overrate it.
"""

from __future__ import annotations

import argparse
import hashlib
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np
import scipy.stats.qmc
import torch

from certify import RoaResult, certify_roa
from certify.certificates.checking import run_checker
from certify.loop.plants import load_system
from certify.loop.policies.importers import ImportOptions, import_policy
from certify.loop.policies.importers.steps import Clip

SAMPLES = 20  # powers of 2
PENDULUM = {"m": "0.15", "l": "0.5", "b": "0.1", "g": "9.81"}
SPEEDING = "g/l*sin(theta) - b/(m*l**2)*theta_dot + u/(m*l**2)"
PARTING = "g/l*(sin(theta) - sin(theta - e)) - b/(m*l**2)*e_dot"
TRAINING = ("lower_limit", "upper_limit", "kappa", "rho", "x_boundary")


@dataclass(frozen=True, slots=True)
class Loop:
    """A file of the folder, and its plant.

    Parameters
    ----------
    file : name of the file without its ending.
    parameters, where, dynamics : of the plant's file, the dynamics being the next states.
    reads : the expressions that the policy reads.
    box : half-widths of the domain, by the states.
    limits : the ends of each input's range.
    inputs, u_eq : their names, and what each is at rest.
    """

    file: str
    parameters: Mapping[str, str]
    where: Mapping[str, str]
    dynamics: Mapping[str, str]
    reads: tuple[str, ...]
    box: Mapping[str, str]
    limits: tuple[str, str]
    inputs: tuple[str, ...] = ("u",)
    u_eq: str = "0"

    @property
    def observed(self) -> bool:
        """True if the loop has an observer."""
        return "e" in self.dynamics

    def toml(self, folder: Path) -> str:
        """The plant's file."""
        observer = (
            f'observer = {{file = "{folder / self.file}.pth", kind = "state-dict", activation = "leaky_relu", '
            f'squash = "identity", gives = 2, prefix = "state_dict.observer.fc_net", '
            f"ignore = {_ignored(self, folder)}}}"
        )
        tables = {
            "parameters": self.parameters,
            "where": {k: f'"{v}"' for k, v in self.where.items()},
            "dynamics": {k: f'"{v}"' for k, v in self.dynamics.items()},
            "u_eq": dict.fromkeys(self.inputs, f'"{self.u_eq}"'),
            "domain": {k: f"[-{v}, {v}]" for k, v in self.box.items()},
            "input_bounds": dict.fromkeys(self.inputs, f"[{', '.join(self.limits)}]"),
        }
        lines = [f'name = "{self.file}"', 'time = "discrete"']
        lines += [f"states = {_listed(self.dynamics)}", f"inputs = {_listed(self.inputs)}"]
        lines += ["[networks]", observer] if self.observed else []
        for name, rows in tables.items():
            lines += [f"[{name}]", *(f"{key} = {value}" for key, value in rows.items())]
        return "\n".join(lines) + "\n"


def _listed(names: tuple[str, ...] | Mapping[str, str]) -> str:
    return "[" + ", ".join(f'"{name}"' for name in names) + "]"


def _ignored(loop: Loop, folder: Path, of: str = "observer") -> list[str]:
    """What is no part of the observer or of the policy."""
    there = torch.load(folder / f"{loop.file}.pth", map_location="cpu", weights_only=True)
    beside = {"observer": "state_dict.controller.*", "controller": "state_dict.observer.*"}
    names = [name for name in TRAINING if isinstance(there.get(name), torch.Tensor)]
    return names + ([beside[of]] if loop.observed else [])


def _pendulum(file: str, torque: str) -> Loop:
    dynamics = {"theta": "theta + dt*theta_dot", "theta_dot": "theta_dot + dt*speeding"}
    where = {"speeding": SPEEDING}
    box = dict.fromkeys(dynamics, "12")
    return Loop(file, PENDULUM | {"dt": "0.05"}, where, dynamics, tuple(dynamics), box, (f"-{torque}", torque))


def _tracking(file: str, steering: str) -> Loop:
    dynamics = {"d": "d + dt*v*sin(theta)", "theta": "theta + dt*(v*u/L - cos(theta)/(R/v - sin(theta)))"}
    parameters = {"v": "2", "L": "1", "R": "10", "dt": "0.05"}
    box, limits = dict.fromkeys(dynamics, "3"), (f"-{steering}", steering)
    return Loop(file, parameters, {}, dynamics, tuple(dynamics), box, limits, u_eq="L/R")


def _measured(file: str, torque: str, angle: str, error: str) -> Loop:
    """The pendulum of which the angle is measured; a network corrects the estimate."""
    z = "theta - e, theta_dot - e_dot"
    corrected = [f"(observer[{k}]({z}, e) - observer[{k}]({z}, 0))" for k in range(2)]
    dynamics = {
        "theta": "theta + dt*theta_dot + dt**2/2*speeding",
        "theta_dot": "theta_dot + dt*speeding",
        "e": f"e + dt*e_dot + dt**2/2*parting - {corrected[0]}",
        "e_dot": f"e_dot + dt*parting - {corrected[1]}",
    }
    where = {"speeding": SPEEDING, "parting": PARTING}
    box = {"theta": angle, "theta_dot": angle, "e": error, "e_dot": error}
    reads = (*z.split(", "), "e")
    return Loop(file, PENDULUM | {"dt": "0.01"}, where, dynamics, reads, box, (f"-{torque}", torque))


def _pvtol(file: str) -> Loop:
    dynamics = {
        "x": "x + dt*(vx*cos(theta) - vy*sin(theta))",
        "y": "y + dt*(vx*sin(theta) + vy*cos(theta))",
        "theta": "theta + dt*w",
        "vx": "vx + dt*(vy*w - g*sin(theta))",
        "vy": "vy + dt*(-vx*w - g*cos(theta) + (u1 + u2)/m)",
        "w": "w + dt*(u1 - u2)*r/I",
    }
    parameters = {"m": "4", "r": "0.25", "I": "0.0475", "g": "9.8", "dt": "0.05"}
    box = dict.fromkeys(dynamics, "1")
    return Loop(file, parameters, {}, dynamics, tuple(dynamics), box, ("0", "39.2"), ("u1", "u2"), "m*g/2")


LOOPS = (
    _pendulum("pendulum_state_feedback", "6"),
    _pendulum("pendulum_state_feedback_small_torque", "0.75"),
    _pendulum("pendulum_state_feedback_quadratic", "0.75"),
    _tracking("path_tracking_state_feedback", "0.84"),
    _tracking("path_tracking_state_feedback_small_torque", "0.5"),
    _tracking("path_tracking_state_feedback_quadratic", "0.5"),
    _measured("pendulum_output_feedback", "1", "2.1991148575128552", "0.5497787143782138"),
    _measured("pendulum_output_feedback_small_torque", "0.25", "1.2566370614359172", "0.3141592653589793"),
    _measured("pendulum_output_feedback_nn", "1", "3.141592653589793", "0.7853981633974483"),
    _pvtol("pvtol_state_feedback"),
)


def most_of(path: Path, box: np.ndarray) -> float:
    """The volume of the largest sublevel set of the file's V that does not reach beyond the box, for a neural V about,
    and rather more."""
    stored = torch.load(path, map_location="cpu", weights_only=True)["state_dict"]
    numbers = {name: tensor.double() for name, tensor in stored.items() if name.startswith("lyapunov")}
    R, n = numbers["lyapunov.R"], len(box)
    Q = 0.01 * torch.eye(n).double() + R.T @ R
    if len(numbers) == 1:  # x'Qx
        level = float((torch.from_numpy(box) ** 2 / torch.diag(torch.linalg.inv(Q))).min())
        return math.pi ** (n / 2) / math.gamma(n / 2 + 1) * level ** (n / 2) / math.sqrt(torch.linalg.det(Q))

    def phi(x: torch.Tensor) -> torch.Tensor:
        last = max(int(name.split(".")[2]) for name in numbers if "net" in name)
        for k in range(0, last + 1, 2):
            x = x @ numbers[f"lyapunov.net.{k}.weight"].T + numbers[f"lyapunov.net.{k}.bias"]
            x = x if k == last else torch.nn.functional.leaky_relu(x)
        return x[:, 0]

    def V(x: torch.Tensor) -> torch.Tensor:
        return (phi(x) - phi(torch.zeros(1, n).double())).abs() + (x @ Q).abs().sum(1)

    x = torch.from_numpy((2 * scipy.stats.qmc.Sobol(n, seed=0).random_base2(SAMPLES) - 1) * box)
    faces = []
    for k in range(n):
        for end in (-box[k], box[k]):
            face = x[: len(x) // (2 * n)].clone()
            face[:, k] = end
            faces.append(V(face).min())
    return float((V(x) < min(faces)).double().mean() * np.prod(2 * box))


def run(loop: Loop, folder: Path, out: Path, effort: float) -> RoaResult:
    """Prove a loop, and print its row."""
    path, plant = folder / f"{loop.file}.pth", out / f"{loop.file}.toml"
    plant.write_text(loop.toml(folder), "utf-8")
    system = load_system(plant)
    options = ImportOptions(
        kind="state-dict",
        prefix="state_dict.controller.net",
        activation="relu",
        squash="identity",
        states=loop.reads,
        normaliser="none",
        action_scale=(Fraction(1),),
        clip=Clip(*((Fraction(end),) * len(loop.inputs) for end in loop.limits)),
        centre="output",
        observes="absolute",
        ignore=tuple(_ignored(loop, folder, "controller")),
    )
    policy = import_policy(path, system, options).policy.network
    start = time.perf_counter()
    result = certify_roa(system, policy, out / loop.file, effort=effort)
    seconds = time.perf_counter() - start
    said = ["nothing"]
    if result.certificate is not None:
        said = [run_checker(result.certificate, program)["result"] for program in ("checker", "reference")]
    theirs = most_of(path, np.array([float(half) for half in loop.box.values()]))
    digest = hashlib.sha256(path.read_bytes()).hexdigest()[:16]
    print(f"\n{loop.file} ({digest}...)")
    print(f"  their V    at most {theirs:.4g} in the box")
    print(f"  here       {result.verdict.value}, {seconds:.1f} s in all; checkers: {' and '.join(said)}")
    print(f"  ellipsoid  {result.volume or 0:.4g}")
    if result.ranks is not None:
        print(f"  boxes      {result.ranks.volume:.4g}, {result.ranks.covered:.2%} of the box")
    return result


def main() -> None:
    """Parse the arguments and run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="a copy of Lyapunov_Stable_NN_Controllers")
    parser.add_argument("--only", nargs="*", default=[loop.file for loop in LOOPS])
    parser.add_argument("--effort", type=float, default=1.0)
    parser.add_argument("--out", type=Path, default=Path("out") / "feedback")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    for loop in LOOPS:
        if loop.file in given.only:
            run(loop, given.folder.resolve() / "models", given.out, given.effort)


if __name__ == "__main__":
    main()
