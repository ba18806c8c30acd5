"""The pictures of the page on the paper's figures, from a folder of runs: `make paper RUNS=runs`.

Nothing is trained here. Of each plant the methods are compared whose runs are over, with as many seeds as all of them
have, and the history of a run is drawn whose policies were kept; `figures.txt` lists every picture that lies beside it.
So the page is whole whatever is missing, and a run that is added adds its pictures. Files that are not those of
`manifest.txt` are named, and the manifest is written for what was drawn.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from manifest import MANIFEST, differences, digests, of_parts, read, replaced, run_files, write

from controllers.comparison.methods import NAMES, Run
from controllers.comparison.run_files import ENDED

ROOT = Path(__file__).parents[2]
PAGE = Path(__file__).parent
OUT = ROOT / "out" / "paper"
LARGEST = 200_000  # bytes of a picture
EFFORTS = {"pendulum": 0.6, "cartpole": 1.2, "quadrotor2d": 1.2, "quadrotor3d": 2.4}  # for a policy of a history
SECONDS = {"quadrotor2d": ("--duration", "30")}  # its slowest mode takes that long
BASELINES: tuple[Run, ...] = ("sac", "sb3-sac", "sb3-ppo")
COMPARED = {
    "curves": "Floor and cost of the mean action while it is trained",
    "cost": "Accumulated cost over time, mean and stochastic actions",
    "norm": "Distance from the equilibrium over time, mean and stochastic actions",
    "positions": "Positions over time, mean and stochastic actions",
    "space": "Trajectories in space, mean actions",
}
LOOKED_BACK = {
    "gain": "The learned gain and the mean action's Jacobian against the true gain, over steps",
    "growth": "The proved set over training",
}
HISTORIES = {"history": "", "first-steps": "-first"}  # folder of kept policies, what its pictures add to their names


@dataclass(frozen=True)
class Command:
    """A command line of the project."""

    words: tuple[str, ...]

    def run(self) -> None:
        program = str(Path(sys.executable).parent / self.words[0])
        subprocess.run([program, *self.words[1:]], cwd=ROOT, check=True, stdout=subprocess.DEVNULL)


def seeds(runs: Path, run: Run) -> int:
    """How many runs of this kind, with the seeds 0, 1, ..., are over."""
    found = 0
    while (runs / run / f"seed-{found}" / ENDED).is_file():
        found += 1
    return found


def compare(plant: str, folder: Path) -> bool:
    """Compare what is over of a plant and keep the pictures of a page and the table; whether there was anything."""
    runs = folder / plant
    there = {run: count for run in ("ours", *BASELINES) if (count := seeds(runs, run))}
    if "ours" not in there or len(there) < 2:
        return False
    count = min(there.values())
    used = [runs / run / f"seed-{seed}" for run in there for seed in range(count)]
    parts = [f"{plant}/{run}" for run in ("ours", *BASELINES)]
    say_differences(folder, parts, run_files(used))
    without = [word for run in BASELINES if run not in there for word in ("--without", run)]
    out = OUT / "compared"
    words = ("controllers", "compare", plant, "--runs", str(runs), "--seeds", str(count))
    Command((*words, *without, *SECONDS.get(plant, ()), "--out", str(out))).run()
    for name in COMPARED:
        keep(out / f"{plant}-{name}.png", PAGE / f"{plant}-{name}.png")
    table = json.loads((out / f"{plant}-table.json").read_text("utf-8"))
    table.pop("files", None)  # paths of this machine
    (PAGE / f"{plant}-table.json").write_text(json.dumps(table, indent=1) + "\n", "utf-8")
    note_drawn(folder, parts, run_files(used))
    print(plant, ", ".join(f"{NAMES[run]}: {count}" for run, count in there.items()))
    return True


def look_back(plant: str, folder: Path, name: str, adds: str) -> bool:
    """Draw the history of a run whose policies were kept; whether there is one."""
    kept = folder / plant / name
    if not kept.is_dir():
        return False
    out, evaluations = OUT / f"{plant}-{name}", kept.with_suffix(".csv")
    used = [*kept.glob("*.pt"), *([evaluations] if evaluations.is_file() else [])]
    say_differences(folder, [f"{plant}/{name}"], used)
    words = ["controllers", "history", str(kept), "--out", str(out), "--effort", str(EFFORTS[plant])]
    Command((*words, *(("--evaluations", str(evaluations)) if evaluations.is_file() else ()))).run()
    for figure in LOOKED_BACK:
        keep(out / f"{plant}-{figure}.png", PAGE / f"{plant}{adds}-{figure}.png")
    note_drawn(folder, [f"{plant}/{name}"], used)
    print(plant, name)
    return True


def say_differences(folder: Path, parts: list[str], used: list[Path]) -> None:
    """Name the files that are not those of the manifest, before hours are spent on them."""
    for line in differences(of_parts(read(MANIFEST), parts), digests(folder, used)):
        print(line)


def note_drawn(folder: Path, parts: list[str], used: list[Path]) -> None:
    """Write the manifest for what was drawn of these parts."""
    write(MANIFEST, replaced(read(MANIFEST), parts, digests(folder, used)))


def keep(made: Path, path: Path) -> None:
    """Copy a picture to the page, if it was made."""
    if not made.is_file():
        return
    size = made.stat().st_size
    if size > LARGEST:
        raise SystemExit(f"{made} must be below {LARGEST} bytes; it has {size}. Draw less.")
    shutil.copyfile(made, path)


def section(plant: str) -> str:
    """What lies beside this file of a plant, in the order of the page; empty if nothing does."""
    lines = []
    for name, said in COMPARED.items():
        if (PAGE / f"{plant}-{name}.png").is_file():
            lines += [f"![{said}: {plant}](paper/{plant}-{name}.png)", ""]
    for adds in HISTORIES.values():
        for name, said in LOOKED_BACK.items():
            if (PAGE / f"{plant}{adds}-{name}.png").is_file():
                first = ", the first steps" if adds else ""
                lines += [f"![{said}{first}: {plant}](paper/{plant}{adds}-{name}.png)", ""]
    return "\n".join([f"### {plant}", "", *lines]) if lines else ""


def main() -> None:
    """Every plant that has runs, then the list of all pictures."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "runs").resolve()
    if not folder.is_dir():
        raise SystemExit(f"RUNS must be a folder of runs; {folder} is none. docs/paper.md says how to get one.")
    OUT.mkdir(parents=True, exist_ok=True)
    drawn = {}
    for plant in EFFORTS:
        looked_back = (look_back(plant, folder, name, adds) for name, adds in HISTORIES.items())
        drawn[plant] = compare(plant, folder), *looked_back
    sections = [text for plant in EFFORTS if (text := section(plant))]
    (PAGE / "figures.txt").write_text("\n".join(sections), "utf-8")
    print(json.dumps(drawn))


if __name__ == "__main__":
    main()
