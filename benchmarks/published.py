"""Sets of neural Lyapunov functions beside the published ones: the same checkpoints, plants and boxes.

Run with `python benchmarks/published.py [--folder FOLDER] [--only NAME ...] [--time-limit 1800] [--out out/published]`.
The folder holds checkpoints that others trained (of Two-Stage, NeurIPS 2025); rows whose files are not there are left
out, and say so. Each row imports policy and function, proves, has the certificate checked, and prints what was proved
with the seconds that it took; certificates stay in `--out`. Absolute times are this machine's.
"""

from __future__ import annotations

import argparse
import hashlib
import math
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from certify import certify_roa
from certify.lyapunov import import_lyapunov
from certify.policies.importers import ImportOptions, import_policy
from certify.results import RoaResult
from certify.systems import System, get_system

FOLDER = Path(__file__).parent.parent.parent / "shared" / "external" / "two_stage"


@dataclass(frozen=True, slots=True)
class Row:
    """A checkpoint with what is said of it.

    Parameters
    ----------
    file : its name without the ending.
    plant, parameters, domain : the plant, and half-widths of the box by state.
    states, squash, scale : what the file does not say of the policy.
    published : what its makers report.
    """

    file: str
    plant: str
    domain: Mapping[str, str]
    scale: str
    published: str
    parameters: Mapping[str, str]
    squash: str = "tanh"

    def system(self) -> System:
        """The plant in the box."""
        box = {name: (-Fraction(half), Fraction(half)) for name, half in self.domain.items()}
        return get_system(self.plant).with_parameters(self.parameters).with_domain(box)


ROWS = (
    Row(
        "pendulum_bigtorque_seed_0",
        "pendulum",
        {"theta": "30", "theta_dot": "120"},
        "6",
        "0.01 <= V <= 0.989, alpha,beta-CROWN 3.64 s on a GPU, dReal 1,480 s",
        {},
    ),
    Row(
        "cartpole_seed_0",
        "cartpole",
        {"p": "3.6", "theta": "2.4", "p_dot": "12", "theta_dot": "12"},
        "30",
        "0.01 <= V <= 0.989, alpha,beta-CROWN 76,443 s on a GPU, dReal timed out",
        {"l": "1"},
    ),
)


def run(row: Row, folder: Path, out: Path, limit: float) -> RoaResult | None:
    """The row's result; None if its file is not there."""
    path = folder / f"{row.file}.pth"
    if not path.is_file():
        print(f"{row.file}: left out, {path} is not there")
        return None
    system = row.system()
    options = ImportOptions(
        kind="two-stage",
        states=tuple(s.name for s in system.states),
        squash=row.squash,  # type: ignore[arg-type]
        action_scale=(Fraction(row.scale),),
    )
    network = import_policy(path, system, options).policy.network
    N = import_lyapunov(path, system, options).stored.function
    start = time.perf_counter()
    result = certify_roa(system, network, out / row.file, lyapunov=N, time_limit=limit)
    seconds = time.perf_counter() - start
    print(f"\n{row.file} (sha256 {hashlib.sha256(path.read_bytes()).hexdigest()[:16]}...)")
    print(f"  published  {row.published}")
    print(
        f"  box        {', '.join(f'|{name}| <= {half}' for name, half in row.domain.items())}; no hole, no tolerance"
    )
    checked = "nothing" if result.checker is None else result.checker["result"]
    print(f"  here       {result.verdict.value}, checker {checked}, {seconds:.1f} s in all")
    stages = ", ".join(f"{name} {s:.2f}" for name, s in result.seconds.items())
    print(f"  seconds    {stages}")
    print(f"  ellipsoid  {result.volume:.6g}" if result.volume is not None else "  ellipsoid  none")
    if result.outer is not None:
        o = result.outer
        print(f"  set        N <= {o.level:.8g}, V = {1 / (1 + math.exp(-o.level)):.6f}, ended by {o.limit}")
        print(f"  volume     {o.volume:.6g} (estimated, standard deviation {o.deviation:.2g})")
        print(f"  boxes      {o.boxes:,}, leaves {o.leaves:,}")
    return result


def main(arguments: Sequence[str] | None = None) -> None:
    """Parse the arguments and run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, default=FOLDER)
    parser.add_argument("--only", nargs="*", default=[row.file for row in ROWS])
    parser.add_argument("--time-limit", type=float, default=1800.0)
    parser.add_argument("--out", type=Path, default=Path("out") / "published")
    options = parser.parse_args(arguments)
    for row in ROWS:
        if row.file in options.only:
            run(row, options.folder, options.out, options.time_limit)


if __name__ == "__main__":
    main()
