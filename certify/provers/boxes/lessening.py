"""The S-procedure on models: a bound made tighter by multiples of what is not negative where it counts."""

from __future__ import annotations

import numpy as np

from certify.provers.bounds import Taylor, upper_bound
from certify.provers.bounds.arrays import Array, chosen
from certify.provers.bounds.taylor import EPS, TINY


def lessened(bound: Array, decrease: Taylor, gap: Taylor, n: int, most: float = np.inf) -> Array:
    """The bound (B,) of a model, made tighter where it is not negative by multiples of a gap that is >= 0 in the ring.

    Parameters
    ----------
    gap : its model, whose first n symbols are the box coordinates.
    most : the largest multiplier, which is tried too if it is finite.
    """
    scale = gap.r + EPS * sum(gap.norms())
    tried = np.minimum(_multipliers(decrease.g[:n], gap.g[:n], gap.c), most)
    if most < np.inf:
        tried = np.concatenate([tried, np.full_like(tried[:1], most)])
    for each in tried:
        still = chosen(~(bound < 0) & (each > 0))
        if not len(still):
            continue
        k = each[still]
        c = k * gap.c[still]
        rest = k * scale[still] + EPS * np.abs(c) + TINY
        added = Taylor(c, k * gap.g.take(still, -1), k * gap.Q.take(still, -1), rest)
        tighter, _ = upper_bound(decrease.at(still) + added)
        bound[still] = np.fmin(bound[still], tighter)
    return bound


def _multipliers(a: Array, b: Array, c: Array) -> Array:
    """The k at which a term of `c k + sum_i |a_i + k b_i|` vanishes, or 0 where it is negative: (n, B), best first."""
    k = np.maximum(np.nan_to_num(np.where(b != 0, -a / b, 0.0), nan=0.0, posinf=0.0, neginf=0.0), 0.0)
    value = c * k + np.abs(a[:, None] + k * b[:, None]).sum(0)
    return np.asarray(np.take_along_axis(k, value.argsort(0, kind="stable"), 0))
