"""The paper's pendulum, with the paper's Lyapunov function: how large a set of it can be proved?

`python examples/pendulum.py [FOLDER]`. The paper (AAAI 2025, arXiv 2409.08382) prints the V below. The policy here is
not the paper's but the one that ships, trained by the paper's method: its gain is another one, and that this V is a
Lyapunov function of its loop all the same is what gets proved.
"""

from __future__ import annotations

import sys
from pathlib import Path

from certify import RoaResult, certify_roa

HERE = Path(__file__).parent

# V(theta, theta') = 1.025121 theta^2 + 0.0379687 theta theta' + 0.0216179 theta'^2, as a matrix.
PRINTED = [[1.025121, 0.0379687 / 2], [0.0379687 / 2, 0.0216179]]


def main(folder: str | Path = "out/examples/pendulum") -> RoaResult:
    """Prove the largest level of the printed V in |theta| <= 3.14, |theta'| <= 20; say what the checker says."""
    result = certify_roa("pendulum", HERE / "policies" / "pendulum.pt", folder, P=PRINTED)
    print(f"{result.verdict.value} in {result.seconds['total']:.2f} s, check included")
    print(f"every trajectory from V <= c2 = {result.levels.roa} converges; limited by the {result.reason}")
    print(f"shown up to c1 = {result.levels.local} by one local argument, from there on by {result.leaves} boxes")
    if result.checker is not None:
        print("the checker, a process of its own, says:")
        print("\n".join(f"    {line}" for line in result.checker["text"]))
    print(f"certificate  {result.certificate}")
    return result


if __name__ == "__main__":
    main(*sys.argv[1:2])
