"""From how much of a plant's state space trained agents are proved to converge, by ranks of boxes, as a table.

`python benchmarks/ranks.py FOLDER --system PLANT --states 'cos(theta),sin(theta),theta_dot'` takes every policy file
of a folder (`NAME.zip`, with `NAME-vecnormalize.pkl` beside it if there is one), runs `certify roa --ranks` on it, and
then `certify check`. Seconds are those of this machine.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

_COLUMNS = (
    "| agent | network | claim | ellipsoid | share of the box, % | boxes with a rank | steps | s | check, s | MB |"
)


def proved(policy: Path, arguments: argparse.Namespace, out: Path) -> dict[str, Any]:
    """The answer of `certify roa --ranks` about a policy, and the seconds that it took."""
    beside = policy.with_name(f"{policy.stem}-vecnormalize.pkl")
    command = [
        *(sys.executable, "-m", "certify", "roa", "--policy", str(policy), "--system", arguments.system),
        *("--states", arguments.states, "--normaliser", str(beside) if beside.is_file() else "none"),
        *("--ranks", "--effort", str(arguments.effort), "--out", str(out), "--json", "--quiet"),
    ]
    start = time.perf_counter()
    found = subprocess.run(command, check=False, capture_output=True, text=True)
    answer: dict[str, Any] = json.loads(found.stdout)
    return {**answer, "took": time.perf_counter() - start}


def row(policy: Path, arguments: argparse.Namespace) -> str:
    """A policy's row."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        answer = proved(policy, arguments, out)
        if answer.get("verdict") != "PROVED":
            why = answer.get("reason", answer.get("error"))
            return f"| {policy.stem} | | {answer.get('verdict')} | {why} | | | | | | |"
        file = out / "certificate.json"
        start = time.perf_counter()
        subprocess.run([sys.executable, "-m", "certify", "check", str(file)], check=True, capture_output=True)
        check, size = time.perf_counter() - start, file.stat().st_size / 1e6
    ranks, layers = answer.get("ranks") or {}, "-".join(map(str, answer["policy"]["layers"]))
    cells = [
        policy.stem,
        layers,
        answer["claim"]["kind"],
        f"{answer['volume']:.3g}",
        f"{100 * ranks.get('covered', 0.0):.2f}",
    ]
    cells += [f"{ranks.get('proved', 0):,}", str(ranks.get("steps", 0)), f"{answer['took']:.0f}", f"{check:.0f}"]
    return f"| {' | '.join([*cells, f'{size:.2f}'])} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--system", required=True, help="as for certify roa")
    parser.add_argument("--states", required=True, help="what the policies read, as for certify roa")
    parser.add_argument("--effort", type=float, default=1.0, help="as for certify roa")
    parser.add_argument("--only", nargs="*", help="names of policies")
    arguments = parser.parse_args()
    print(f"{_COLUMNS}\n|{' --- |' * (_COLUMNS.count('|') - 1)}")
    for policy in sorted(arguments.folder.glob("*.zip")):
        if not arguments.only or policy.stem in arguments.only:
            print(row(policy, arguments), flush=True)


if __name__ == "__main__":
    main()
