"""Jets for the checker's tests: models that somebody writes down, and what they say at a point, in ball arithmetic."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations_with_replacement
from typing import Any

import numpy as np
from flint import arb

from certify.checker.ball import Units
from certify.checker.jets import Jet
from tests.support.oracle import quadratic


def plain(c: Any, error: Any, a: Any, slack: Any, Q: Any, E: Any, K: Any = None) -> Jet:
    """A model without the errors of inputs, and, if no K is given, without one."""
    k = len(a)
    thirds = np.zeros(k * (k + 1) * (k + 2) // 6) if K is None else np.array(K, float)
    return Jet(c, error, a, slack, Q, thirds, E, np.zeros(1), np.zeros((1, k, k)), np.zeros(0), np.zeros((0, k)), 0.0)


def given(jet: Jet, y: Sequence[Any]) -> Jet:
    """The model where what is uncertain has these y: v(0) and the gradient in binary64, and that rounding apart."""
    y = [float(v) for v in y]
    c, a = jet.c + np.dot(y, jet.c_y), jet.a + np.tensordot(y, jet.a_y, 1)
    lost = (len(y) + 4) * 2.0**-50
    error = jet.error + lost * (abs(jet.c) + np.abs(jet.c_y).sum())
    slack = jet.slack + lost * (np.linalg.norm(jet.a) + np.linalg.norm(jet.a_y))
    return replace(jet, c=c, a=a, error=error, slack=slack, c_y=np.zeros(0), a_y=np.zeros((0, len(a))))


def no_units(k: int) -> Units:
    """Of one input that no tanh reaches."""
    return Units(np.zeros((1, 0)), np.zeros((0, k, k)))


def curved(jet: Jet, d: Sequence[Any]) -> arb:
    """d'Q d + K[d]; K has its entries h <= i <= j, each as often as its indices have orders."""
    value, times = quadratic(jet.Q.tolist(), d), {1: 1, 2: 3, 3: 6}
    kept = combinations_with_replacement(range(len(jet.a)), 3)
    for (h, i, j), entry in zip(kept, jet.K.tolist(), strict=True):
        value += times[len({h, i, j})] * arb(entry) * arb(d[h]) * arb(d[i]) * arb(d[j])
    return value
