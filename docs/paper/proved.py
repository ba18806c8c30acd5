"""What is proved of the mean action of every method: the table of certificates of the page on the paper's figures.

`make paper-proved RUNS=runs` takes minutes per plant, and is about the runs of `manifest.txt` alone. A simulation that
ends near the origin may still leave it later; a certificate says what never happens. Each run's `policy.pt`, which
`controllers compare` leaves in the folder of runs, is given to `certify roa`: ours is centred and is proved to
converge; what is not centred rests, if at all, beside the origin, and what can be proved of it is that from a set it
enters a small one and stays there. A certificate that `out/paper` already has is checked again, and used if it is about
this policy on the plant as it is now; what was searched for in vain is searched for again only with another policy,
plant or time.

A line is of several runs, and what it says is true of each of them that is proved: the smallest volume, and the largest
radius.
"""

from __future__ import annotations

import hashlib
import json
import math
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from manifest import MANIFEST, differences, digests, read

from certify.certificates import loop_sections, read_certificate
from certify.certificates.claims import Practical
from certify.certificates.membership import proved_set
from certify.errors import CertificateFormatError, InputError
from certify.loop.plants import System, shipped_system
from certify.loop.policies import Policy, load_policy
from certify.lyapunov import volume
from certify.report.words import above, below
from controllers.comparison.methods import NAMES, Run
from controllers.evaluation.proved_set import require_same_question

ROOT = Path(__file__).parents[2]
PAGE = Path(__file__).parent
OUT = ROOT / "out" / "paper"
PLANTS = ("pendulum", "cartpole", "quadrotor2d", "quadrotor3d")
EFFORT = {"pendulum": 1.2, "cartpole": 2.4, "quadrotor2d": 3.0, "quadrotor3d": 2.4}
KINDS: tuple[Run, ...] = ("ours", "sac", "sb3-ppo")
IN_WORDS = {
    "asymptotic": "converges to the origin",
    "practical": "enters a small set and stays there",
    "nearby": "converges to one equilibrium beside the origin",
}


@dataclass(frozen=True)
class Proved:
    """What one run's policy is proved to do: the claim, the volume from which, and the radius of ||x|| into which."""

    claim: str
    volume: float
    radius: float


def proved(plant: str, folder: Path) -> Proved | None:
    """What the checker accepts of the policy in a run's folder; None where nothing was proved with that effort."""
    path = folder / "policy.pt"
    out = OUT / plant / folder.parent.name / folder.name
    policy = load_policy(path)
    system = shipped_system(policy.system).with_parameters(policy.parameters)
    found = accepted(out / "certificate.json", policy, system)
    if found is None and not in_vain(out / "said.json", about := asked(plant, policy, system)):
        out.mkdir(parents=True, exist_ok=True)
        (out / "certificate.json").unlink(missing_ok=True)
        program = str(Path(sys.executable).parent / "certify")
        full = [program, *command(path, EFFORT[plant])[1:], "--out", str(out), "--quiet", "--json"]
        done = subprocess.run(full, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=False)
        if done.returncode not in (0, 1, 2, 3):  # 2: refused, as where the clip acts at the origin
            raise SystemExit(f"{' '.join(full)} ended with {done.returncode}.")
        said = json.loads(done.stdout)
        (out / "said.json").write_text(json.dumps({"about": about, "said": said}), "utf-8")
        if said.get("verdict") == "PROVED":
            found = accepted(out / "certificate.json", policy, system)
            if found is None:
                raise SystemExit(f"{out / 'certificate.json'} must be what was just proved of {path}; it is not.")
        else:
            print(path, said.get("error") or said["reason"])
    return found


def accepted(path: Path, policy: Policy, system: System) -> Proved | None:
    """What a certificate says that the checker accepts, if it is about this policy on this plant; None otherwise."""
    if not path.is_file():
        return None
    try:
        proved_about = proved_set(path)
        require_same_question(proved_about, policy.network, system)
        certificate = read_certificate(path)
    except (InputError, CertificateFormatError):
        return None
    claim = certificate.claim
    beside = float(np.linalg.norm(certificate.network.origin)) * (1 + 1e-9)  # of the set's middle
    radius = beside + largest_norm(certificate.P, claim.floor) if isinstance(claim, Practical) else 0.0
    return Proved(certificate.kind, volume(certificate.P, certificate.roa), radius)


def asked(plant: str, policy: Policy, system: System) -> dict[str, Any]:
    """What an answer depends on: the loop with its domain and bounds, and the effort."""
    loop = json.dumps(loop_sections(system, policy.network), sort_keys=True)
    return {"loop": hashlib.sha256(loop.encode()).hexdigest(), "effort": EFFORT[plant]}


def in_vain(path: Path, about: dict[str, Any]) -> bool:
    """Whether just this was searched for before, and not found."""
    if not path.is_file():
        return False
    record = json.loads(path.read_text("utf-8"))
    return record.get("about") == about and record["said"].get("verdict") != "PROVED"


def largest_norm(P: Any, level: float) -> float:
    """Largest ||x|| in {x'Px <= level}; the smallest eigenvalue is lowered by more than its rounding."""
    eigenvalues = np.linalg.eigvalsh(np.asarray(P, dtype=np.float64))
    smallest = float(eigenvalues[0]) - 1e-12 * float(eigenvalues[-1])
    return math.sqrt(level / smallest) * (1 + 1e-9) if smallest > 0 else math.inf


def command(policy: Path, effort: float) -> list[str]:
    """What proves it."""
    return ["certify", "roa", "--policy", str(policy), "--effort", f"{effort:g}"]


def row(plant: str, kind: Run, folders: Sequence[Path]) -> str:
    """A line of the table for all seeds of a method: the smallest volume and the largest radius of what is proved."""
    every = [proved(plant, folder) for folder in folders]
    found = [one for one in every if one is not None]
    name = "ours" if kind == "ours" else f"{NAMES[kind]}, mean"
    if not found:
        return f"| {plant} | {name} | 0 of {len(every)} | | | |"
    claims = sorted({IN_WORDS[one.claim] for one in found})
    radius = max(one.radius for one in found)
    return (
        f"| {plant} | {name} | {len(found)} of {len(every)} | {'; '.join(claims)} | "
        f"{below(min(one.volume for one in found), 3)} | {'0' if radius == 0 else above(radius, 2)} |"
    )


def main() -> None:
    """The table, and the command behind each number."""
    runs = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "runs"
    policies = {name: digest for name, digest in read(MANIFEST).items() if name.endswith("/policy.pt")}
    found = digests(runs, (runs / name for name in policies if (runs / name).is_file()))
    if lines := differences(policies, found):
        raise SystemExit(
            "\n".join((*lines, f"{runs} must hold the runs that the page shows: first `make paper RUNS={runs}`."))
        )
    rows = []
    for plant in PLANTS:
        for kind in KINDS:
            folders = sorted((runs / name).parent for name in policies if name.startswith(f"{plant}/{kind}/"))
            if folders:
                rows.append(row(plant, kind, folders))
    head = ["plant", "method", "runs proved", "what", "from a volume of at least", "into ‖x‖ of at most"]
    limits = [" ".join(command(Path("RUNS/PLANT/METHOD/seed-K/policy.pt"), EFFORT[plant])) for plant in PLANTS]
    block = ["", "<!-- shown: by make paper-proved -->", "```sh", *dict.fromkeys(limits), "```", ""]
    (PAGE / "proved.txt").write_text(
        "\n".join([f"| {' | '.join(head)} |", "|---" * len(head) + "|", *rows, *block]), "utf-8"
    )


if __name__ == "__main__":
    main()
