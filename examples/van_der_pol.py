"""A plant of one's own from a TOML file: Van der Pol's oscillator in reversed time, under a trained policy.

`python examples/van_der_pol.py [FOLDER]`. Without an input the origin attracts what lies inside the limit cycle; the
proof says how much of that an ellipse can show. Beside the certificate come a picture and the report, one page.
"""

from __future__ import annotations

import sys
from pathlib import Path

from certify import RoaResult, Verdict, certify_roa

HERE = Path(__file__).parent


def main(folder: str | Path = "out/examples/van_der_pol") -> RoaResult:
    """Prove, draw, and ask about two states."""
    # The policy was made by `controllers train examples/plants/van_der_pol.toml --transitions latest --out FILE`.
    result = certify_roa(
        HERE / "plants" / "van_der_pol.toml", HERE / "policies" / "van_der_pol.pt", folder, candidate="optimised"
    )
    print(result)
    if result.verdict is not Verdict.PROVED:
        return result
    for state in ([1.0, 1.0], [2.0, 2.0]):
        # Not in the set means not proved: it may converge all the same.
        print(f"x = {state} is in the proved set: {result.contains(state)}")
    picture = Path(folder) / "set.png"
    result.plot().savefig(picture, dpi=150)
    print(f"picture      {picture}")
    print(f"report       {result.report()}")
    print(f"certificate  {result.certificate}")
    return result


if __name__ == "__main__":
    main(*sys.argv[1:2])
