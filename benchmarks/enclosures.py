"""How wide the checker's enclosures of the elementary functions are, in units in the last place of the value.

Run with `python benchmarks/enclosures.py [--arguments 1000000]`. Width means hi - lo of the enclosure. Near a zero of
sin or cos other than the origin the width is a few ulp of 1. tan is a quotient of Taylor models, as the ring rule
evaluates it: its remainder bounds the rounding of all coefficients together, small only against the largest.
"""

from __future__ import annotations

import argparse

import numpy as np

from certify.checker.near import Near, sin_cos, tanh
from certify.checker.taylor import Taylor, affine


def _point(y: np.ndarray) -> Taylor:
    return affine(y, np.zeros((1, len(y))))


def main() -> None:
    """Parse the arguments and run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--arguments", type=int, default=1_000_000)
    count = parser.parse_args().arguments
    generator = np.random.default_rng(0)
    uniform = generator.uniform(-1, 1, count)
    tiny = 2.0 ** generator.uniform(-60, 0, count)
    for where, y in (("|y| < 20", 20 * uniform), ("2^-60 < y < 1", tiny), ("|y| < 1.5", 1.5 * uniform)):
        t, (s, c) = tanh(Near(y)), sin_cos(Near(y))
        quotient = _point(y).function("sin") * _point(y).function("cos").function("inv")
        rows = {"tanh": t, "sin": s, "cos": c, "tan": Near(quotient.c, quotient.r)}
        print(f"{where}, {count:,} arguments: width in ulp, median and largest; in ulp of 1, largest")
        for name, number in rows.items():
            error = number.error.top
            width = 2 * error / np.spacing(np.abs(number.value))
            print(f"  {name:5}{np.median(width):8.1f}{np.max(width):14.4g}{2 * np.max(error) / 2.0**-52:14.4g}")


if __name__ == "__main__":
    main()
