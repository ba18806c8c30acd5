"""The table of the comparison: the figures of `controllers compare` for every plant, as the page shows them.

`make paper` writes it from the tables that lie beside this file, one per plant.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

PAGE = Path(__file__).parent
PLANTS = ("pendulum", "cartpole", "quadrotor2d", "quadrotor3d")
NAMES = {
    "ours": "ours",
    "sac mean": "SAC without gain, mean",
    "sac stochastic": "the same, stochastic",
    "sb3-ppo mean": "PPO, mean",
    "sb3-ppo stochastic": "the same, stochastic",
    "sb3-sac mean": "SAC of stable-baselines3, mean",
    "sb3-sac stochastic": "the same, stochastic",
}
HEAD = (
    "plant",
    "method",
    "seeds",
    "steps: of the policy; made",
    "ended by",
    "settled",
    "left the domain",
    "floor of ‖x‖",
    "cost: quartiles",
    "minutes: wall; processor",
)


def line(found: Mapping[str, Any], row: Mapping[str, Any]) -> str:
    """A method's row, all seeds together."""
    kind = _kind(row["method"])
    runs = [run for run in found["runs"] if run["run"] == kind]
    why = [run["why"] for run in runs]
    ended = ", ".join(f"{reason} {why.count(reason)}" if len(set(why)) > 1 else reason for reason in dict.fromkeys(why))
    steps = f"{_thousands(median(run['kept'] for run in runs))}; {_thousands(median(run['steps'] for run in runs))}"
    cost = ", ".join(_short(row[name]) for name in ("cost_lower", "cost_median", "cost_upper"))
    minutes = "" if row["cpu"] is None else f"{row['wall'] / 60:.1f}; {row['cpu'] / 60:.1f}"
    sampled = row["method"].endswith("stochastic")
    cells = (
        found["system"],
        NAMES[row["method"]],
        "" if sampled else str(len(runs)),
        "" if sampled else steps,
        "" if sampled else ended,
        f"{row['settled']} of {row['trajectories']}",
        f"{row['left_domain']}",
        _short(row["floor"]),
        cost,
        "" if sampled else minutes,
    )
    return f"| {' | '.join(cells)} |"


def _kind(method: str) -> str:
    return method.removesuffix(" mean").removesuffix(" stochastic")


def _short(value: float | None) -> str:
    return "diverges" if value is None else f"{value:.2g}" if value < 100 else f"{value:.0f}"


def _thousands(steps: float) -> str:
    return f"{round(steps):,}"


def table() -> str:
    """Rows of all plants that have been compared."""
    rows = []
    for path in (PAGE / f"{plant}-table.json" for plant in PLANTS):
        if path.is_file():
            found = json.loads(path.read_text("utf-8"))
            rows += [line(found, row) for row in found["rows"] if row["seed"] is None]
    return _table(HEAD, rows)


def main() -> None:
    """Write `baselines.txt`."""
    (PAGE / "baselines.txt").write_text(table(), "utf-8")


def _table(head: Sequence[str], rows: Sequence[str]) -> str:
    return "\n".join([f"| {' | '.join(head)} |", "|---" * len(head) + "|", *rows, ""])


if __name__ == "__main__":
    main()
