"""A network as its author wrote it, for words alone: an import has several steps for one function."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from certify.loop.networks.steps import Affine, Map, Network, Sum

_ROUNDED = 4e-16  # of 1 less the slope, in binary64


def as_written(network: Network) -> Network:
    """The network with one function instead of the steps `s h + (1 - s) relu(h)`.

    The function has a name for people, and no value.

    >>> h = Affine((0,), 0.25 * np.eye(1), np.zeros(1)), Map((0,), "relu"), Affine((2,), 0.75 * np.eye(1), np.zeros(1))
    >>> as_written(Network(1, (*h, Sum((1, 3))))).functions
    ('leaky relu (slope 0.25)',)
    """
    read = [i for step in network.steps for i in step.of]
    spent, functions = set[int](), dict[int, Map]()
    for k, step in enumerate(network.steps, 1):
        for straight, bent in (step.of, step.of[::-1]) if isinstance(step, Sum) and len(step.of) == 2 else ():
            found = _leaky(network, straight, bent)
            if found is not None and all(read.count(i) == 1 for i in found[0]):
                spent |= found[0]
                functions[k] = found[1]
    new, steps = {0: 0}, []
    for k, step in enumerate(network.steps, 1):
        if k not in spent:
            kept = functions.get(k, step)
            steps.append(replace(kept, of=tuple(new[i] for i in kept.of)))
            new[k] = len(steps)
    return Network(network.reads, tuple(steps)) if functions else network


def _leaky(network: Network, straight: int, bent: int) -> tuple[set[int], Map] | None:
    """The vectors of which the sum of two is a leaky relu, and that function; None if it is none."""
    s, t = _factor(network, straight), _factor(network, bent)
    if s is None or t is None or not math.isclose(s + t, 1, rel_tol=_ROUNDED):
        return None
    (h,), (r,) = network.steps[straight - 1].of, network.steps[bent - 1].of
    relu = network.steps[r - 1]
    if r == 0 or not isinstance(relu, Map) or relu.function != "relu" or relu.of != (h,):
        return None
    return {straight, bent, r}, Map((h,), f"leaky relu (slope {s:.6g})")


def _factor(network: Network, k: int) -> float | None:
    """The number that vector k is another vector times; None if it is no such multiple."""
    step = network.steps[k - 1]
    if k == 0 or not isinstance(step, Affine) or step.bias.any():
        return None
    factor = float(step.weight[0, 0])
    multiple = step.weight.shape[0] == step.weight.shape[1] and np.array_equal(
        step.weight, factor * np.eye(len(step.weight))
    )
    return factor if multiple else None
