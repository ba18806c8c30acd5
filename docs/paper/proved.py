"""What is proved of the mean action of every method: the table of certificates of the page on the paper's figures.

`make paper-proved RUNS=runs`, minutes a plant. A simulation that ends near the origin may still leave it later; a
certificate says what never happens. Each run's `policy.pt`, which `controllers compare` leaves in the folder of runs,
is given to `certify roa`: ours is centred and is proved to converge; what is not centred rests, if at all, beside the
origin, and what can be proved of it is that from a set it enters a small one and stays there. Results that
`out/paper` already has are checked again and not searched for again.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from certify.certificate import read_certificate, run_checker
from certify.policies import load_policy
from certify.report.words import above, below
from controllers.course import ENDED
from controllers.responses import NAMES, Run

ROOT = Path(__file__).parents[2]
PAGE = Path(__file__).parent
OUT = ROOT / "out" / "paper"
PLANTS = ("pendulum", "cartpole", "quadrotor2d", "quadrotor3d")
SECONDS = {"pendulum": 60, "cartpole": 120, "quadrotor2d": 150, "quadrotor3d": 240}
KINDS: tuple[Run, ...] = ("ours", "sac", "sb3-ppo")
IN_WORDS = {
    "asymptotic": "converges to the origin",
    "practical": "enters a ball around the origin",
    "nearby": "converges to one equilibrium beside the origin",
}


@dataclass(frozen=True)
class Proved:
    """What one run's policy is proved to do: the claim, the volume from which, and the radius of ||x|| into which."""

    claim: str
    volume: float
    radius: float


def proved(plant: str, folder: Path) -> Proved | None:
    """What the checker accepts of the policy in a run's folder; None where nothing was proved in the time."""
    policy = folder / "policy.pt"
    out = OUT / plant / folder.parent.name / folder.name
    said, path = out / "said.json", out / "certificate.json"
    sha = load_policy(policy).network.sha256()
    if not said.exists() or json.loads(said.read_text("utf-8"))["about"] != sha:
        out.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        program = str(Path(sys.executable).parent / "certify")
        full = [program, *command(policy, SECONDS[plant])[1:], "--out", str(out), "--quiet", "--json"]
        done = subprocess.run(full, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=False)
        if done.returncode not in (0, 1, 2, 3):  # 2: refused, as where the clip acts at the origin
            raise SystemExit(f"{' '.join(full)} ended with {done.returncode}.")
        said.write_text(json.dumps({"about": sha, "said": json.loads(done.stdout)}), "utf-8")
    found = json.loads(said.read_text("utf-8"))["said"]
    if found.get("verdict") != "PROVED":
        print(policy, found.get("error") or found["reason"])
        return None
    answer = run_checker(path)
    if answer["result"] != "ACCEPTED":
        raise SystemExit(f"{path} must be accepted; the checker said {answer}. Remove the folder and run this again.")
    certificate = read_certificate(path)
    if certificate.network.sha256() != sha:
        raise SystemExit(f"{path} must be about {policy}; it is about another policy.")
    ultimate = found["levels"].get("ultimate")
    radius = 0.0 if ultimate is None else largest_norm(certificate.P, ultimate)
    return Proved(found["claim"]["kind"], found["volume"], radius)


def largest_norm(P: Any, level: float) -> float:
    """Largest ||x|| in {x'Px <= level}; the smallest eigenvalue is lowered by more than its rounding."""
    eigenvalues = np.linalg.eigvalsh(np.asarray(P, dtype=np.float64))
    smallest = float(eigenvalues[0]) - 1e-12 * float(eigenvalues[-1])
    return math.sqrt(level / smallest) * (1 + 1e-9) if smallest > 0 else math.inf


def command(policy: Path, seconds: int) -> list[str]:
    """What proves it."""
    return ["certify", "roa", "--policy", str(policy), "--time-limit", str(seconds)]


def row(plant: str, kind: Run, folders: Sequence[Path]) -> str:
    """A line of the table for all seeds of a method: the median radius and volume of those that are proved."""
    every = [proved(plant, folder) for folder in folders]
    found = [one for one in every if one is not None]
    name = "ours" if kind == "ours" else f"{NAMES[kind]}, mean"
    if not found:
        return f"| {plant} | {name} | 0 of {len(every)} | | | |"
    claims = sorted({IN_WORDS[one.claim] for one in found})
    radius = median(one.radius for one in found)
    return (
        f"| {plant} | {name} | {len(found)} of {len(every)} | {'; '.join(claims)} | "
        f"{below(median(one.volume for one in found), 3)} | {'0' if radius == 0 else above(radius, 2)} |"
    )


def main() -> None:
    """The table, and the command behind each number."""
    runs = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "runs"
    rows = []
    for plant in PLANTS:
        for kind in KINDS:
            folders = sorted(path.parent for path in (runs / plant / kind).glob(f"seed-*/{ENDED}"))
            if folders:
                rows.append(row(plant, kind, folders))
    head = ["plant", "method", "runs proved", "what", "from a volume of", "into ‖x‖ of at most"]
    limits = [" ".join(command(Path("RUNS/PLANT/METHOD/seed-K/policy.pt"), SECONDS[plant])) for plant in PLANTS]
    block = ["", "<!-- shown: by make paper-proved -->", "```sh", *dict.fromkeys(limits), "```", ""]
    (PAGE / "proved.txt").write_text(
        "\n".join([f"| {' | '.join(head)} |", "|---" * len(head) + "|", *rows, *block]), "utf-8"
    )


if __name__ == "__main__":
    main()
