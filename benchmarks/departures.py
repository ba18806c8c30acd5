"""What each departure from the paper is worth: the preset with one of them undone, and with all, beside ours.

Run with `python benchmarks/departures.py [PLANT ...] [--seeds 2] [--only NAME ...] [--rows docs/departures/rows.json]
[--runs runs/departures] [--steps N] [--time-limit 60] [--table FILE] [--no-training]`. Runs are trained one at a time;
what is in the file of rows is not made again, a run that was cut off goes on from its checkpoint in the folder of runs,
and the table is printed of all rows that were asked for.
`ours` is the plant's preset, `paper` its preset of that name, every other row the preset with the departure of that
name in `controllers.plants.paper_preset` undone; those that a plant does not depart in are left out. A policy is
simulated with its action held, from 100 states of the plant's box for 20 s: the floor is the median of the largest
||x|| in the last second, settled is below 1e-6 there. Then `certify roa` gets its time, and what is proved is what the
checker accepted.
A run without a gain ends with the policy that it has, and says so: a row that failed stays in the table. With
`--no-training` so does one that was not made, and says that.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import torch

from certify import certify_roa
from certify.certificates import write_atomically
from certify.certificates.verdict import Verdict
from certify.errors import InputError
from certify.loop.plants import System, get_system
from certify.loop.policies import Policy, save_policy
from certify.report.words import below
from controllers.comparison.methods import OURS
from controllers.comparison.options import CompareOptions
from controllers.comparison.table import Response, table
from controllers.identification.linearisation import discrete_linearisation
from controllers.identification.riccati import riccati_gain
from controllers.options import TrainingOptions, default_record, get_plant
from controllers.plants.paper_preset import DEPARTURES
from controllers.simulation.trajectories import initial_states, mean_action, simulate
from controllers.storage import make_folder
from controllers.training.record import parameters_of
from controllers.training.trainer import Trainer

EVERY = 5_000  # steps between checkpoints
_AMPLE = 100.0  # an effort that the limit on the clock ends first, as in the rows that are kept
JUDGED = CompareOptions(states=100, start_seed=1)
HEAD = (
    "undone",
    "floor",
    "settled",
    "left the domain",
    "median cost",
    "‖J + K‖/‖K‖",
    "error of K",
    "proved volume",
    "processor seconds",
    "remark",
)


def cases(name: str, only: Sequence[str]) -> Iterator[tuple[str, TrainingOptions]]:
    """(row, options) of a plant: ours, each departure undone alone, and the preset named after the paper."""
    plant = get_plant(name)
    every = {"ours": plant.preset}
    every |= {departure.name: departure.undone(plant.preset) for departure in DEPARTURES}
    every["paper"] = plant.named("paper")
    unknown = [row for row in only if row not in every]
    if unknown:
        raise InputError(f"`--only` must be of {', '.join(every)}; found {unknown[0]!r}.")
    for row, options in every.items():
        if (not only or row in only) and (row == "ours" or options != plant.preset):
            yield row, options


def trained(system: System, options: TrainingOptions, folder: Path) -> tuple[Trainer, float, str]:
    """The run at its end, its seconds of processor time in all, and what went wrong, if anything."""
    trainer, checkpoint, spent = Trainer(system, options), folder / "checkpoint.pt", folder / "seconds.json"
    before = 0.0
    if checkpoint.is_file() and spent.is_file():
        trainer.restore(checkpoint.read_bytes())
        before = json.loads(spent.read_text("utf-8"))
    began = time.process_time()
    try:
        while trainer.steps_done < options.steps:
            trainer.advance()
            if trainer.steps_done % EVERY == 0:
                write_atomically(spent, json.dumps(before + time.process_time() - began).encode())
                write_atomically(checkpoint, trainer.snapshot())
    except InputError as error:  # it has diverged
        return trainer, before + time.process_time() - began, str(error)
    trouble = "" if trainer.gain.identified is not None else f"no gain, in phase {trainer.gain.phase}"
    return trainer, before + time.process_time() - began, trouble


def measured(system: System, options: TrainingOptions, folder: Path, seconds: float) -> dict[str, Any]:
    """Train, judge and certify one run; its row."""
    trainer, spent, trouble = trained(system, options, folder)
    network, found = trainer.sac.actor.network(), trainer.gain.identified
    row: dict[str, Any] = {"steps": trainer.steps_done, "cpu": spent, "trouble": trouble}
    if not all(np.isfinite(weights).all() for weights in network.weights):
        return row
    x0 = initial_states(system, JUDGED.states, JUDGED.start_seed)
    x, cost = simulate(system, options, mean_action(network, system), x0, JUDGED.duration)
    [judged, _] = table(system, options.dt, [Response(OURS, options.seed, trainer.steps_done, x, cost)], JUDGED)
    row |= {name: judged.as_json()[name] for name in ("floor", "cost_median", "settled", "left_domain", "trajectories")}
    record = options.record()
    if found is not None:
        true = riccati_gain(
            *discrete_linearisation(system, options.dt), np.diag(options.state_weights), np.diag(options.input_weights)
        )
        row["distance"] = trainer.distance()[0] / float(np.linalg.norm(found.K))
        row["K_error"] = float(np.linalg.norm(found.K - true) / np.linalg.norm(true))
        record |= {"A": found.A.tolist(), "B": found.B.tolist(), "K": found.K.tolist()}
    policy = Policy(network, system.name, parameters_of(system), training=record)
    save_policy(folder / "policy.pt", policy)
    result = certify_roa(system, policy, folder, effort=_AMPLE, time_limit=seconds)
    proved = result.verdict is Verdict.PROVED
    return row | {
        "verdict": result.verdict.value,
        "claim": result.claim,
        "volume": result.volume if proved else None,
        "limited_by": result.reason,
    }


class Rows:
    """The rows of a file, by plant, name and seed, each with the options and the time it was asked with."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.known: dict[str, Any] = json.loads(path.read_text("utf-8")) if path.is_file() else {}

    def find(self, name: str, asked: dict[str, Any]) -> dict[str, Any] | None:
        """The row, None if it is not there; ends the program if it is of other options or another time."""
        there = self.known.get(name)
        if there is None:
            return None
        before = there["asked"] | {"options": {**default_record(), **there["asked"]["options"]}}  # some came later
        if before != asked:
            raise SystemExit(f"{name} in {self.path} is of other options. Give another file by --rows.")
        row: dict[str, Any] = there["row"]
        return row

    def add(self, name: str, asked: dict[str, Any], row: dict[str, Any]) -> None:
        """Write the file with one row more."""
        self.known = dict(sorted({**self.known, name: {"asked": asked, "row": row}}.items()))
        write_atomically(self.path, (json.dumps(self.known, indent=1) + "\n").encode())


def rows(
    store: Rows, folder: Path, system: System, options: TrainingOptions, seeds: int, limit: float, training: bool
) -> list[dict[str, Any]]:
    """The rows of all seeds that are there; with `training` the others are made, in the folder of runs."""
    found = []
    for seed in range(seeds):
        own = replace(options, seed=seed)
        name, asked = f"{system.name}/{folder.name}/{seed}", {"options": own.full_record(), "time_limit": limit}
        row = store.find(name, asked)
        if row is None and training:
            place = folder / f"seed-{seed}"
            make_folder(place)
            row = measured(system, own, place, limit)
            store.add(name, asked, row)
            (place / "checkpoint.pt").unlink(missing_ok=True)
            print(f"{name}: {json.dumps(row)}", flush=True)
        if row is not None:
            found.append(row)
    return found


def line(name: str, found: Sequence[dict[str, Any]]) -> str:
    """A line of the table; the seeds' values side by side."""

    def every(key: str, form: str, none: str = "-") -> str:
        return ", ".join(none if row.get(key) is None else format(row[key], form) for row in found)

    if not found:
        return f"| {name} | not measured yet |{' |' * (len(HEAD) - 2)}"
    settled = ", ".join(f"{row['settled']} of {row['trajectories']}" if "settled" in row else "-" for row in found)
    volume = ", ".join("none" if row.get("volume") is None else below(row["volume"], 4) for row in found)
    trouble = "; ".join(dict.fromkeys(row["trouble"] for row in found if row["trouble"]))
    cells = [
        name,
        every("floor", ".2g", "inf"),
        settled,
        every("left_domain", "d"),
        every("cost_median", ".4g", "inf"),
        every("distance", ".1e"),
        every("K_error", ".1e"),
        volume,
        every("cpu", ".0f"),
        trouble,
    ]
    return f"| {' | '.join(cells)} |"


def main() -> None:
    """Parse the arguments, make what is missing, print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("plants", nargs="*", default=["pendulum"], metavar="PLANT")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--only", nargs="*", default=[], metavar="NAME")
    parser.add_argument("--rows", type=Path, default=Path("docs") / "departures" / "rows.json")
    parser.add_argument("--runs", type=Path, default=Path("runs") / "departures")
    parser.add_argument("--steps", type=int, help="of every run; default: the preset's")
    parser.add_argument("--time-limit", type=float, default=60.0, help="seconds for a certificate")
    parser.add_argument("--table", type=Path, help="a file for the table")
    parser.add_argument("--no-training", action="store_true", help="the table of what is there")
    asked = parser.parse_args()
    torch.set_num_threads(1)
    several, store = len(asked.plants) > 1, Rows(asked.rows)
    head = (*("plant",) * several, *HEAD)
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    for plant in asked.plants:
        system = get_system(plant)
        for name, options in cases(plant, asked.only):
            chosen = options if asked.steps is None else replace(options, steps=asked.steps)
            folder = asked.runs / plant / name
            made = rows(store, folder, system, chosen, asked.seeds, asked.time_limit, not asked.no_training)
            lines.append(f"| {plant} " * several + line(name, made))
    print("\n".join(lines))
    if asked.table is not None:
        write_atomically(asked.table, ("\n".join(lines) + "\n").encode())


if __name__ == "__main__":
    main()
