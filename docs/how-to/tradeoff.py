"""Flatten one policy with several weights, prove each result, and write the table and the picture of the page.

`make tradeoff`, half an hour. What a weight buys is only worth a figure where it is proved: the volumes are read from
certificates that the checker has accepted in this run. A result that `out/tradeoff` already has is not made again.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from certify.certificates import read_certificate, run_checker
from certify.loop.plants import shipped_system
from certify.loop.policies import load_policy
from certify.lyapunov import volume
from certify.report.figures.style import INK, MUTED, RC, SET, START, to_svg
from certify.report.words import below
from controllers.options import get_plant

ROOT = Path(__file__).parents[2]
PAGE = Path(__file__).parent
OUT = ROOT / "out" / "tradeoff"
POLICY = "tests/data/quadrotor2d_curved.pt"
WEIGHTS = ("0.001", "0.003", "0.01", "0.03", "0.1", "1")
FLATTEN = ("controllers", "flatten", POLICY, "--time-limit", "300")
PROVE = ("certify", "roa", "--effort", "2")


@dataclass(frozen=True)
class Row:
    """One policy; `length` is the geometric mean of the proved half-axes, relative to the box of initial states."""

    name: str
    departure: float
    bend: float
    settled: int
    states: int
    cost: float
    volume: float
    length: float

    @property
    def text(self) -> str:
        return (
            f"| {self.name} | {self.departure:.3g} | {100 * self.bend:.3g} % | {self.settled} of {self.states} | "
            f"{self.cost:.3f} | {below(self.volume, 2)} | {below(self.length, 3)} |"
        )


def row(weight: str | None) -> Row:
    """The policy as it was (None), or flattened with a weight: its runs, and its certificate."""
    name = "curved" if weight is None else weight
    folder, file = OUT / name, ROOT / POLICY if weight is None else OUT / f"{name}.pt"
    said = OUT / f"{weight or WEIGHTS[-1]}.json"
    if weight is not None and not said.exists():
        told = run([*FLATTEN, "--weight", weight, "--out", str(file), "--json"])
        said.write_text(told, "utf-8")
    figures = json.loads(said.read_text("utf-8"))["before" if weight is None else "after"]
    path = folder / "certificate.json"
    if not path.exists():
        run([*PROVE, "--policy", str(file), "--out", str(folder), "--quiet"])
    answer = run_checker(path)
    if answer["result"] != "ACCEPTED":
        raise SystemExit(f"{path} must be accepted; the checker said {answer}. Remove the file and run this again.")
    certificate = read_certificate(path)
    proved = volume(certificate.P, certificate.roa)
    policy = load_policy(file)
    if certificate.network.sha256() != policy.network.sha256() or certificate.network.is_moved:
        raise SystemExit(f"{path} must be about {file}; it is about another policy. Remove it and run this again.")
    system, plant = shipped_system(policy.system).with_parameters(policy.parameters), get_plant(policy.system)
    ball = math.pi ** (system.n / 2) / math.gamma(system.n / 2 + 1)
    length = (proved / (ball * math.prod(plant.initial_states))) ** (1 / system.n)
    return Row(
        "as it was" if weight is None else weight,
        figures["departure"],
        figures["bend"],
        figures["settled"],
        figures["states"],
        figures["cost"],
        proved,
        length,
    )


def run(command: list[str]) -> str:
    """What a command of the project prints."""
    program = str(Path(sys.executable).parent / command[0])
    done = subprocess.run([program, *command[1:]], cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True)
    return done.stdout


def picture(rows: list[Row]) -> str:
    """Proved length and median cost for each weight, the policy as it was at the left."""
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context({**RC, "font.size": 9.0}):
        figure = Figure(figsize=(6.4, 3.0), layout="constrained")
        axes = figure.add_subplot()
        at = range(len(rows))
        axes.plot(at, [r.length for r in rows], color=SET, marker="o")
        axes.set_ylabel("proved length, of the box", color=SET)
        axes.set_ylim(0, 1.1 * max(r.length for r in rows))
        axes.set_xticks(at, [r.name for r in rows])
        axes.set_xlabel("--weight")
        beside = axes.twinx()
        beside.plot(at, [r.cost for r in rows], color=START, marker="s", linestyle="--")
        beside.set_ylabel(f"median cost of {rows[0].states} runs *", color=START)
        beside.set_ylim(0, 1.1 * max(r.cost for r in rows))
        beside.spines["right"].set_visible(True)
        beside.spines["right"].set_color(MUTED)
        figure.text(0.99, 0.005, "* simulated, not proved", ha="right", va="bottom", fontsize=7, color=INK)
        return to_svg(figure)


def main() -> None:
    """All rows, the table and the picture."""
    OUT.mkdir(parents=True, exist_ok=True)
    flattened = [row(weight) for weight in WEIGHTS]
    rows = [row(None), *flattened]
    head = ["weight", "departure", "bend", "settled", "median cost", "proved volume", "proved length"]
    top = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    (PAGE / "tradeoff.txt").write_text("\n".join([*top, *(r.text for r in rows)]) + "\n", "utf-8")
    (PAGE / "tradeoff.svg").write_text(picture(rows), "utf-8")


if __name__ == "__main__":
    main()
