"""Which V? Four candidates for one policy, the bicycle that follows a path, side by side.

`python examples/candidates.py [FOLDER]`. A set is proved with each; what differs is P alone. Where states have
different units, as a distance and two angles have, the identity is an arbitrary Q, and costs most of the set.
"""

from __future__ import annotations

import sys
from pathlib import Path

from certify import RoaResult, certify_roa
from certify.lyapunov import Candidate

HERE = Path(__file__).parent

CANDIDATES: dict[Candidate, str] = {
    "lyapunov": "A'P + PA = -I, A the closed loop's Jacobian",
    "scaled": "... = -diag(1 / d_i^2), d the half-widths of the domain",
    "lqr": "... = -(I + K'K), K the policy's gain at the origin",
    "optimised": "from the best of these on, changed as long as the set grows",
}


def main(folder: str | Path = "out/examples/candidates") -> dict[Candidate, RoaResult]:
    """Prove a set with each candidate; print them, the smallest set first."""
    plant, policy = HERE / "plants" / "bicycle.toml", HERE / "policies" / "bicycle.pt"
    found = {name: certify_roa(plant, policy, Path(folder) / name, candidate=name) for name in CANDIDATES}
    print(f"{'candidate':12}{'verdict':9}{'volume':>9}{'boxes':>7}{'seconds':>9}  P")
    for name, result in sorted(found.items(), key=lambda item: item[1].volume or 0.0):
        size, seconds = result.volume or 0.0, result.seconds["total"]
        print(f"{name:12}{result.verdict.value:9}{size:9.3g}{result.boxes:7}{seconds:9.2f}  {CANDIDATES[name]}")
    best = max(found.values(), key=lambda result: result.volume or 0.0)
    print(f"certificate  {best.certificate}")
    return found


if __name__ == "__main__":
    main(*sys.argv[1:2])
