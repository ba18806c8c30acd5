"""The tables of the comparison: what `controllers compare` measured on every plant, as the page and the README show it.

`make paper` writes them from the tables that lie beside this file, one a plant.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from statistics import median
from typing import Any

PAGE = Path(__file__).parent
README = PAGE.parents[1] / "README.md"
BEGIN, END = "<!-- by make paper: -->\n", "<!-- to here -->"  # around the README's table
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
SHORT = ("plant", "method", "seeds", "steps", "settled", r"floor of \|\|x\|\|", "median cost")


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


def brief(found: Mapping[str, Any]) -> list[str]:
    """A plant's rows in the README: a method a row, the mean's figure before the sampled policy's."""
    lines = []
    for kind, rows in groupby((row for row in found["rows"] if row["seed"] is None), lambda row: _kind(row["method"])):
        both, runs = list(rows), [run for run in found["runs"] if run["run"] == kind]
        sampled = "; stochastic" if len(both) > 1 else ""
        cells = (
            "" if lines else found["system"],
            NAMES[both[0]["method"]] + sampled,
            str(len(runs)),
            _thousands(median(run["steps"] for run in runs)),
            "; ".join(map(_settled, both)),
            "; ".join(_short(row["floor"]) for row in both),
            "; ".join(_short(row["cost_median"]) for row in both),
        )
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def between(text: str, block: str) -> str:
    """The README with `block` for what stands between its two marks."""
    before, rest = text.split(BEGIN)
    return before + BEGIN + block + END + rest.split(END)[1]


def _kind(method: str) -> str:
    return method.removesuffix(" mean").removesuffix(" stochastic")


def _settled(row: Mapping[str, Any]) -> str:
    left = f" ({row['left_domain']} left the domain)" if row["left_domain"] else ""
    return f"{row['settled']} of {row['trajectories']}{left}"


def _short(value: float | None) -> str:
    return "diverges" if value is None else f"{value:.2g}" if value < 100 else f"{value:.0f}"


def _thousands(steps: float) -> str:
    return f"{round(steps):,}"


def tables() -> tuple[str, str]:
    """The page's table and the README's, of the plants that have been compared."""
    rows, short = [], []
    for path in (PAGE / f"{plant}-table.json" for plant in PLANTS):
        if path.is_file():
            found = json.loads(path.read_text("utf-8"))
            rows += [line(found, row) for row in found["rows"] if row["seed"] is None]
            short += brief(found)
    return _table(HEAD, rows), _table(SHORT, short)


def main() -> None:
    """Write `baselines.txt` and the README's table."""
    long, short = tables()
    (PAGE / "baselines.txt").write_text(long, "utf-8")
    README.write_text(between(README.read_text("utf-8"), short), "utf-8")


def _table(head: Sequence[str], rows: Sequence[str]) -> str:
    return "\n".join([f"| {' | '.join(head)} |", "|---" * len(head) + "|", *rows, ""])


if __name__ == "__main__":
    main()
