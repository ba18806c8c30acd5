"""What a proof in Coq costs: boxes, seconds of the search and of Coq, by policy and number of states.

Run with `python benchmarks/coq.py [--only NAME ...] [--folder FOLDER] [--boxes 20000] [--time-limit 900]
[--out out/coq]`; needs Coq with its library Interval. Each row is certified (`certify roa`), then proved again
(`certify prove-in-coq`); of Coq's seconds those of the theory, the same for all, stand apart from those of the
certificate. The folder holds a policy that others trained (Two-Stage, NeurIPS 2025); its row is left out where it is
not there. Linear plants are chains of integrators under a saturated LQR in tanh; the small cart-pole imitates the
shipped policy with 16 and 16 units. Rows that are not proved stay in the table. Absolute times are this machine's.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import scipy.linalg
import torch

from certify import RoaResult, certify_roa, load_policy
from certify.certificates.coq.kernel import find_coqc
from certify.certificates.coq.proving import CoqOptions, prove_in_coq
from certify.certificates.verdict import Verdict
from certify.loop.plants import get_system

EXAMPLES = Path(__file__).parents[1] / "examples"
FOLDER = Path(__file__).parents[2] / "shared" / "external" / "two_stage"
SCALE = 4.0  # bound of the input of the linear plants


@dataclass(frozen=True, slots=True)
class Row:
    """A policy by its name, its layers, and what certifies it into a folder."""

    name: str
    layers: str
    certified: Callable[[Path], RoaResult]


def shipped(name: str, system: str | Path) -> Callable[[Path], RoaResult]:
    """A policy that ships, for its plant."""
    return lambda out: certify_roa(system, EXAMPLES / "policies" / f"{name}.pt", out)


def others(folder: Path) -> Callable[[Path], RoaResult]:
    """The pendulum's policy of Two-Stage."""
    said = {"states": ["theta", "theta_dot"], "squash": "tanh", "action_scale": 6.0}
    return lambda out: certify_roa("pendulum", folder / "pendulum_bigtorque_seed_0.pth", out, importing=said)


def chain(n: int) -> Callable[[Path], RoaResult]:
    """x1' = x2, ..., xn' = u under the LQR of unit weights, saturated, which 2 n units of tanh nearly are."""

    def certified(out: Path) -> RoaResult:
        A, B = np.eye(n, k=1), np.eye(n)[:, -1:]
        K = B.T @ scipy.linalg.solve_continuous_are(A, B, np.eye(n), np.eye(1))
        small = 1 / 16  # of a state, in a unit of tanh: there it is nearly linear
        net = torch.nn.Sequential(
            torch.nn.Linear(n, 2 * n), torch.nn.Tanh(), torch.nn.Linear(2 * n, 1), torch.nn.Tanh()
        )
        first, last = net[0], net[2]
        gain = np.hstack([-K, -K]) / (2 * small * SCALE)
        first.weight = parameter(small * np.vstack([np.eye(n), np.eye(n)]))
        first.bias = parameter(np.linspace(-0.2, 0.2, 2 * n))
        last.weight, last.bias = parameter(gain), parameter(np.zeros(1))
        text = plant_text(n)
        out.mkdir(parents=True, exist_ok=True)
        path = out / "plant.toml"
        path.write_text(text, encoding="utf-8")
        said = {"states": [f"x{k + 1}" for k in range(n)], "normaliser": "none", "action_scale": SCALE}
        return certify_roa(path, net, out, importing={**said, "centre": "preactivation"})

    return certified


def parameter(numbers: np.ndarray) -> torch.nn.Parameter:
    """Numbers in binary32."""
    return torch.nn.Parameter(torch.from_numpy(numbers).float())


def plant_text(n: int) -> str:
    """A chain of n integrators as a plant's file."""
    names = [f"x{k + 1}" for k in range(n)]
    rates = [*names[1:], "u"]
    return "\n".join(
        [
            f'name = "chain_{n}"',
            f"states = {names}".replace("'", '"'),
            'inputs = ["u"]',
            "[dynamics]",
            *(f'{x} = "{rate}"' for x, rate in zip(names, rates, strict=True)),
            "[u_eq]",
            "u = 0",
            "[domain]",
            *(f"{x} = [-1, 1]" for x in names),
            "[input_bounds]",
            f"u = [-{SCALE:g}, {SCALE:g}]",
            "",
        ]
    )


def small_cartpole(out: Path) -> RoaResult:
    """A 4-16-16-1 network that has learned to answer as the shipped policy of the cart-pole."""
    system = get_system("cartpole")
    teacher = load_policy(EXAMPLES / "policies" / "cartpole.pt")
    torch.manual_seed(0)
    sizes = (4, 16, 16, 1)
    layers = [torch.nn.Linear(a, b) for a, b in pairwise(sizes)]
    net = torch.nn.Sequential(layers[0], torch.nn.Tanh(), layers[1], torch.nn.Tanh(), layers[2], torch.nn.Tanh())
    box = np.array(system.domain, dtype=np.float64)[:, 1]
    x = np.random.default_rng(0).uniform(-0.5, 0.5, (8192, 4)) * box
    scale = float(teacher.network.scale[0])
    wanted = torch.from_numpy(teacher.network(x, system.exact_u_eq()) / scale).float()
    seen = torch.from_numpy(x).float()
    optimiser = torch.optim.Adam(net.parameters(), lr=5e-3)
    for _ in range(3000):
        optimiser.zero_grad()
        torch.nn.functional.mse_loss(net(seen), wanted).backward()  # type: ignore[no-untyped-call]
        optimiser.step()
    said = {"states": [one.name for one in system.states], "normaliser": "none", "action_scale": scale}
    return certify_roa(system, net, out, importing={**said, "centre": "preactivation"})


def rows(folder: Path) -> list[Row]:
    """All rows whose files are there."""
    plants = EXAMPLES / "plants"
    found = [
        Row("pendulum", "2-16-16-1", shipped("pendulum", "pendulum")),
        Row("van_der_pol", "2-16-16-1", shipped("van_der_pol", plants / "van_der_pol.toml")),
        Row("bicycle", "3-16-16-1", shipped("bicycle", plants / "bicycle.toml")),
        *(Row(f"chain_{n}", f"{n}-{2 * n}-1", chain(n)) for n in (2, 3, 4)),
        Row("small_cartpole", "4-16-16-1", small_cartpole),
    ]
    if folder.is_dir():
        found.insert(1, Row("pendulum_of_others", "2-10-10-1", others(folder)))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=[])
    parser.add_argument("--folder", type=Path, default=FOLDER)
    parser.add_argument("--boxes", type=int, default=20_000)
    parser.add_argument("--time-limit", type=float, default=900.0)
    parser.add_argument("--out", type=Path, default=Path("out/coq"))
    options = parser.parse_args()
    coqc = find_coqc()
    print("| policy | layers | c2 | rate | boxes | search, s | certificate in Coq, s | theory in Coq, s | verdict |")
    print("|---|---|---|---|---|---|---|---|---|")
    for row in rows(options.folder):
        if options.only and row.name not in options.only:
            continue
        out = options.out / row.name
        result = row.certified(out)
        if result.certificate is None:
            print(
                f"| {row.name} | {row.layers} |  |  |  |  |  |  | not certified: {result.verdict.value} |", flush=True
            )
            continue
        limits = CoqOptions(time_limit=options.time_limit, boxes=options.boxes)
        found = prove_in_coq(Path(result.certificate).read_bytes(), out / "coq", limits)
        proved = found.verdict is Verdict.PROVED
        own = again(coqc.path, out / "coq") if proved else 0.0
        cells = [row.name, row.layers, f"{found.level:.6g}", str(found.rate), f"{found.boxes or found.looked_at:,}"]
        cells += [f"{found.search_seconds:.1f}"]
        cells += [f"{own:.1f}", f"{max(found.coq_seconds - own, 0.0):.1f}"] if proved else ["", ""]
        print("| " + " | ".join([*cells, "proved in Coq" if proved else found.reason[:120]]) + " |", flush=True)


def again(coqc: str, folder: Path) -> float:
    """Seconds in which Coq compiles what is of the certificate, once more and elsewhere."""
    with tempfile.TemporaryDirectory() as name:
        copy = Path(shutil.copytree(folder, Path(name) / "coq"))
        took = dict[str, float]()
        for file in (copy / "_CoqProject").read_text().split():
            began = time.perf_counter()
            words = [coqc, "-q", "-R", ".", "", file]
            subprocess.run(words, cwd=copy, check=True, stdout=subprocess.DEVNULL)
            took[file] = time.perf_counter() - began
    return sum(took[f"{name}.v"] for name in ("Claim", "Evidence", "Proof"))


if __name__ == "__main__":
    main()
