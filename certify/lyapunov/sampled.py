"""Estimate the volume of a set without a formula: the share of samples of the domain that lie in it.

The estimate has a standard deviation and is never a bound. The samples are the same each time, so that a run and its
certificate give the same number for the same set.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
SAMPLES = 400_000
_AT_ONCE = 20_000  # fits into a processor's cache for a network of some hundred units


def sampled_volume(
    holds: Callable[[Array], NDArray[np.bool_]], domain: Sequence[tuple[Fraction, Fraction]]
) -> tuple[float, float]:
    """Volume of the part of a box that lies in a set, estimated, and the estimate's standard deviation.

    Parameters
    ----------
    holds : whether states (N, n) lie in the set, (N,).
    domain : the box, an interval for each state.

    Examples
    --------
    >>> half = sampled_volume(lambda x: x[:, 0] < 0, [(Fraction(-1), Fraction(1)), (Fraction(0), Fraction(2))])
    >>> abs(half[0] - 2) < 4 * half[1], round(half[1], 4)
    (True, 0.0032)
    """
    lo, hi = np.array([[float(end) for end in pair] for pair in domain]).T
    x = np.random.default_rng(0).uniform(lo, hi, (SAMPLES, len(lo)))
    with np.errstate(all="ignore"):  # a function need not have a value everywhere
        count = sum(int(np.count_nonzero(holds(x[k : k + _AT_ONCE]))) for k in range(0, SAMPLES, _AT_ONCE))
    share, size = count / SAMPLES, float(np.prod(hi - lo))
    return size * share, size * math.sqrt(share * (1 - share) / SAMPLES)
