"""MuJoCo's InvertedPendulum as a black box: measured, identified, and proved for every plant that the data allow.

`MUJOCO_GL=disable PYTHONPATH=FOLDER python benchmarks/mujoco_pendulum.py` wants mujoco, which
`pip install --no-deps --target FOLDER mujoco==3.4.0` puts into a folder, and gymnasium, of which it reads the XML file
of InvertedPendulum-v5. It sets random states near upright, holds random inputs for 0.04 s, the two steps that the
environment makes of one, and writes what it saw with bounded errors. `examples/unknown/inverted_pendulum.toml` has the
equations without numbers. The policy is the saturated LQR of the middle of the ranges: it knows the data alone.

What is proved is about the differential equation of the structure. MuJoCo's Runge-Kutta steps are not its flow: the
difference at the recorded transitions is printed, and the declared noise has to cover it beside the measurements'
errors, which are drawn within 0.95 of the noise. The numbers in MuJoCo's own model are used only for that, to say
whether the ranges hold them, and for the plant beside which the sets are compared.
"""

from __future__ import annotations

import argparse
import csv
import importlib
import time
from fractions import Fraction
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from certify import IdentifyResult, Policy, PolicyNetwork, certify_roa, identify, save_policy
from certify.certificates.checking import run_checker
from certify.loop.closed_loop import ClosedLoop
from certify.loop.plants import System, load_system

STRUCTURE = Path(__file__).parent.parent / "examples" / "unknown" / "inverted_pendulum.toml"
REACH, INPUT = [0.4, 0.3, 1.0, 1.0], 1.0  # of states and inputs from which transitions begin
SKIP, PERIOD, SHARE, PIECES = 2, "0.04", 0.95, 40
_COLUMNS = "| noise | input | plant | claim | from V = | V <= | volume | of nominal | s | checkers |"
Array = NDArray[np.float64]


class Simulator:
    """MuJoCo's model of the environment, step by step, and the structure's numbers in it."""

    def __init__(self) -> None:
        self.mujoco: Any = importlib.import_module("mujoco")
        file = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / "inverted_pendulum.xml"
        self.model = self.mujoco.MjModel.from_xml_path(str(file))
        self.data = self.mujoco.MjData(self.model)

    def step(self, x: Array, u: Array) -> Array:
        """The state after the environment's step."""
        self.mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:], self.data.qvel[:], self.data.ctrl[:] = x[:2], x[2:], u
        self.mujoco.mj_step(self.model, self.data, nstep=SKIP)
        return np.concatenate([self.data.qpos, self.data.qvel])

    def numbers(self) -> dict[str, float]:
        """The structure's parameters, from masses, inertias and dampings."""
        cart, pole = self.model.body_mass[1:]
        x, _, z = self.model.body_ipos[2]
        moment = pole * np.hypot(x, z)
        inertia = self.model.body_inertia[2][0] + pole * (x * x + z * z)
        rail, hinge = self.model.dof_damping
        mass = cart + pole
        found = {"b": 1 / mass, "k": moment / mass, "q": moment / inertia, "e": rail / mass, "f": hinge / inertia}
        return {name: float(v) for name, v in (found | {"tilt": np.arctan2(x, z)}).items()}


def nominal(numbers: dict[str, float]) -> System:
    """The structure with the simulator's numbers."""
    system = load_system(STRUCTURE)
    return system.with_ranges(dict.fromkeys(numbers)).with_parameters({n: Fraction(v) for n, v in numbers.items()})


def record(simulator: Simulator, plant: System, count: int, noise: float, path: Path) -> Array:
    """Write single transitions; how far the steps are from the plant's flow, (4,)."""
    draw = np.random.default_rng(0)
    x, u = draw.uniform(-1, 1, (count, 4)) * REACH, draw.uniform(-INPUT, INPUT, (count, 1))
    after = np.array([simulator.step(*pair) for pair in zip(x, u, strict=True)])
    errors = draw.uniform(-SHARE * noise, SHARE * noise, (2, count, 4))
    states = [s.name for s in plant.states]
    with path.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow([*states, "u", *(f"{s}_next" for s in states)])
        table.writerows(np.hstack([x + errors[0], u, after + errors[1]]).tolist())
    return np.asarray(np.abs(after - flow(plant, x, u)).max(0))


def flow(plant: System, x: Array, u: Array) -> Array:
    """The plant's states after the period, by many steps of Runge and Kutta."""
    f, h = plant.function(), float(PERIOD) / PIECES
    for _ in range(PIECES):
        k1 = f(x, u)
        k2 = f(x + h / 2 * k1, u)
        k3 = f(x + h / 2 * k2, u)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + f(x + h * k3, u))
    return x


def saturated(system: System) -> PolicyNetwork:
    """The tanh of an LQR of the nominal plant with inputs held for the period, within the input bounds."""
    n, m, h = system.n, system.m, float(PERIOD)
    still = PolicyNetwork.of_layers((np.zeros((m, n)),), (np.zeros(m),), np.ones(m), np.zeros(m), "identity", "none")
    A, B, _ = ClosedLoop(system, still).linearise()
    E = scipy.linalg.expm(h * np.block([[A, B], [np.zeros((m, n + m))]]))
    A, B = E[:n, :n], E[:n, n:]
    P = scipy.linalg.solve_discrete_are(A, B, np.diag([1, 1, 0.1, 0.1]), np.eye(m))
    K = np.linalg.solve(np.eye(m) + B.T @ P @ B, B.T @ P @ A)
    most = np.array([float(hi) for _, hi in system.input_bounds])
    return PolicyNetwork.of_layers((-K / most[:, None],), (np.zeros(m),), most, np.zeros(m), "tanh", "none")


def identified(data: Path, noise: float, numbers: dict[str, float], out: Path) -> IdentifyResult:
    """The ranges that the data leave, beside the simulator's numbers."""
    start = time.perf_counter()
    found = identify(data, STRUCTURE, noise=noise, sample_time=PERIOD)
    print(f"\nnoise {noise:g}: identified in {time.perf_counter() - start:.1f} s")
    for name, (lo, hi) in found.ranges.items():
        inside = "inside" if lo <= Fraction(numbers[name]) <= hi else "OUTSIDE"
        print(f"  {name:5} {float(lo):.9f} to {float(hi):.9f}, the simulator's {numbers[name]:.9f} {inside}")
    policy = Policy(saturated(found.system), found.system.name)
    save_policy(out / "policy.pt", policy)
    return found


def proved(system: System, network: PolicyNetwork, out: Path, held: bool, effort: float) -> tuple[list[str], float]:
    """A proof's cells of the table, and its volume."""
    start = time.perf_counter()
    given: dict[str, Any] = {"sample_time": PERIOD} if held else {}
    result = certify_roa(system, network, out, effort=effort, **given)
    seconds = time.perf_counter() - start
    if result.verdict != "PROVED" or result.volume is None:
        return [f"{result.verdict}: {result.reason}", "", "", "", "", f"{seconds:.0f}", ""], 0.0
    answer = run_checker(out / "certificate.json", "reference")
    second = f"beyond its {answer['rule']}" if answer.get("rule") == "limits" else str(answer["result"])
    first = "nothing" if result.checker is None else str(result.checker["result"])
    levels = [f"{v:.3g}" for v in (result.levels.floor, result.levels.roa) if v is not None]
    return [result.claim, *levels, f"{result.volume:.4g}", "", f"{seconds:.0f}", f"{first}, {second}"], result.volume


def main() -> None:
    """Record, identify, prove, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/mujoco"))
    parser.add_argument("--transitions", type=int, default=600)
    parser.add_argument("--noise", default="1e-4,1e-3", help="bounds, separated by commas")
    parser.add_argument("--inputs", default="continuous,held", help="which of the two")
    parser.add_argument("--effort", type=float, default=0.3)
    given = parser.parse_args()
    simulator = Simulator()
    numbers, rows = simulator.numbers(), list[list[str]]()
    plant = nominal(numbers)
    for noise in map(float, given.noise.split(",")):
        out = given.out / f"{noise:g}"
        out.mkdir(parents=True, exist_ok=True)
        off = record(simulator, plant, given.transitions, noise, out / "data.csv")
        print(f"MuJoCo's steps are within {', '.join(f'{v:.2g}' for v in off)} of the flow; declared noise {noise:g}")
        found = identified(out / "data.csv", noise, numbers, out)
        network = saturated(found.system)
        for kind in given.inputs.split(","):
            of_nominal = 0.0
            for name, system in (("nominal", plant), ("data", found.system)):
                cells, volume = proved(system, network, out / f"{kind}_{name}", kind == "held", given.effort)
                of_nominal = volume if name == "nominal" else of_nominal
                cells[4] = f"{volume / of_nominal:.1%}" if of_nominal else ""
                rows.append([f"{noise:g}", kind, name, *cells])
                print(" ".join(rows[-1]), flush=True)
    lines = [_COLUMNS, "|" + "---|" * (_COLUMNS.count("|") - 1), *(f"| {' | '.join(row)} |" for row in rows)]
    (given.out / "mujoco.md").write_text("\n".join(lines) + "\n", "utf-8")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
