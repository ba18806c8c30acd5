"""How much of the box of initial states is proved, and of what sampling allows: the table of the gallery's end.

`make shares`, a quarter of an hour. A proved volume says little by itself. Beside it belong the states that the policy
was trained for, and what the same V could give at most as far as samples tell. Two shares because they answer two
questions: lengths compare plants of different dimension, volumes say how many of the states are covered. Results that
`out/shares` already has are checked again and not searched for again.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.certificates import read_certificate, run_checker
from certify.certificates.claims import Enlarged
from certify.report.words import below
from controllers.options import get_plant

Array = NDArray[np.float64]
ROOT = Path(__file__).parents[2]
PAGE = Path(__file__).parent
OUT = ROOT / "out" / "shares"
SAMPLES = 200_000


@dataclass(frozen=True)
class Entry:
    """A plant; the effort for a tube from its box, 0 for no tube."""

    name: str
    tube_effort: float = 0.0

    @property
    def own(self) -> list[str]:
        """The command that proves the largest set."""
        return ["certify", "roa", "--policy", f"examples/policies/{self.name}.pt"]

    @property
    def box(self) -> list[str]:
        """The command that proves the largest multiple of the box' ellipsoid."""
        return [*self.own, "--effort", f"{self.tube_effort:g}", "--box", _text(self.name)]


ENTRIES = (
    Entry("pendulum"),
    Entry("cartpole"),
    Entry("quadrotor2d"),
    Entry("quadrotor3d", tube_effort=12.0),
)


def _text(name: str) -> str:
    from certify.loop.plants import shipped_system

    states = [state.name for state in shipped_system(name).states]
    return ",".join(f"{s}={width:.4g}" for s, width in zip(states, get_plant(name).initial_states, strict=True))


def made(command: list[str], folder: Path) -> tuple[Array, dict[str, Any]]:
    """What a command proves as {x'Mx <= 1}, M (n, n), accepted by the checker, and what it says."""
    said, path = folder / "said.json", folder / "certificate.json"
    if not (said.exists() and path.exists()):
        folder.mkdir(parents=True, exist_ok=True)
        program = str(Path(sys.executable).parent / command[0])
        full = [program, *command[1:], "--out", str(folder), "--quiet", "--json"]
        said.write_text(subprocess.run(full, cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True).stdout, "utf-8")
    answer = run_checker(path)
    if answer["result"] != "ACCEPTED":
        raise SystemExit(f"{path} must be accepted; the checker said {answer}. Remove the file and run this again.")
    certificate = read_certificate(path)
    claim = certificate.claim
    M = claim.start.P if isinstance(claim, Enlarged) else certificate.P / certificate.roa
    return M, json.loads(said.read_text("utf-8"))


def multiple(M: Array, box: Array) -> float:
    """Of the ellipsoid with half-axes `box`, the largest one inside {x'Mx <= 1}."""
    return float(1 / math.sqrt(np.linalg.eigvalsh(box[:, None] * M * box)[-1]))


def covered(M: Array, box: Array) -> float:
    """Share of the volume of the ellipsoid with half-axes `box` in {x'Mx <= 1}, by samples."""
    generator, n = np.random.default_rng(0), len(box)
    direction = generator.standard_normal((SAMPLES, n))
    radius = generator.uniform(size=(SAMPLES, 1)) ** (1 / n)
    x = box * radius * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    return float((np.einsum("ij,jk,ik->i", x, M, x) <= 1).mean())


def row(entry: Entry) -> str:
    """A line of the table: of both commands the larger share counts, and the levels are those of the first."""
    box = np.array(get_plant(entry.name).initial_states)
    M, said = made(entry.own, OUT / entry.name)
    levels = said["levels"]
    limit = levels["sampled_limit"] or levels["domain_limit"]
    length = math.sqrt(levels["roa"] / limit)
    found = [M] if not entry.tube_effort else [M, made(entry.box, OUT / f"{entry.name}-box")[0]]
    inside, share = max(multiple(one, box) for one in found), max(covered(one, box) for one in found)
    by = "samples" if levels["sampled_limit"] else "domain"
    return (
        f"| {entry.name} | {_percent(inside)} | {_percent(share)} | {_percent(length)} | "
        f"{_percent(length ** len(box))} | {by} |"
    )


def _percent(share: float) -> str:
    """Rounded down, and never more than what is there; a share above one is one."""
    return "all" if share >= 1 - 1e-6 else f"{below(100 * share, 2)} %"


def main() -> None:
    """The table, and the commands that it takes its numbers from."""
    head = [
        "plant",
        "of the ellipsoid, in length",
        "in volume *",
        "of the limit of V, in length",
        "in volume",
        "limit by",
    ]
    rows = [row(entry) for entry in ENTRIES]
    commands = [" ".join(c) for e in ENTRIES for c in ([e.own] if not e.tube_effort else [e.own, e.box])]
    block = ["", "<!-- shown: by make shares -->", "```sh", *commands, "```", ""]
    (PAGE / "shares.txt").write_text(
        "\n".join([f"| {' | '.join(head)} |", "|---" * len(head) + "|", *rows, *block]), "utf-8"
    )


if __name__ == "__main__":
    main()
