"""True values in ball arithmetic, and where to look for errors: shared by the tests that ask for containment.

A comparison of balls is True only if it is certain; what follows is phrased so that "not certain" counts as a failure.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Any

import numpy as np
from flint import arb, arb_mat, fmpq
from numpy.typing import NDArray

from certify.checker.document import Policy
from certify.checker.networks import Affine, Map, Network

Array = NDArray[np.float64]


def ball(q: Fraction) -> arb:
    return arb(fmpq(q.numerator, q.denominator))


def certainly_within(value: arb, centre: float, bound: float) -> bool:
    return bool(abs(value - arb(float(centre))) <= arb(float(bound)))


def awkward(end: float, ulps: int = 1) -> Array:
    """Where a table of step 2^-5 up to `end` may go wrong, each with its neighbours up to `ulps` away, both signs.

    Grid points, the midpoints between them, the table's end; subnormals, the least normal number, huge numbers, zeros.
    """
    grid = np.arange(int(end * 64) + 3) / 64
    special = [5e-324, 1e-310, 2.0**-1022, 2.0**-600, 2.0**-30, end, 2 * end, 1e9, 2.0**60, 1e300, np.finfo(float).max]
    points = np.concatenate([grid, special])
    below, above, result = points, points, [points, np.zeros(1)]
    for _ in range(ulps):
        below, above = np.nextafter(below, 0.0), np.nextafter(above, 1e308)
        result += [below, above]
    positive = np.concatenate(result)
    return np.concatenate([positive, -positive])


def value_of(node: Any, names: Mapping[str, arb]) -> arb:
    """An expression tree of a certificate."""
    if isinstance(node, str):
        return names[node] if node in names else ball(Fraction(node))
    name, *rest = node
    if name == "**":  # python-flint's own power of a ball around 0 is NaN
        power = math.prod([value_of(rest[0], names)] * abs(rest[1]), start=arb(1))
        return power if rest[1] > 0 else 1 / power
    values = [value_of(v, names) for v in rest]
    if name == "+":
        return sum(values[1:], values[0])
    if name == "*":
        return math.prod(values[1:], start=values[0])
    if name == "-":
        return -values[0] if len(values) == 1 else values[0] - values[1]
    if name in ("min", "max"):
        return getattr(values[0], name)(values[1])
    return values[0] / values[1] if name == "/" else getattr(values[0], name)()


def policy_in_arb(policy: Policy, u_eq: Sequence[Fraction], x: Sequence[arb]) -> list[arb]:
    """pi(x) in ball arithmetic at the current precision, by the words of FORMAT.md."""
    return policies_in_arb(policy, u_eq, [x])[0]


def policies_in_arb(policy: Policy, u_eq: Sequence[Fraction], states: Sequence[Sequence[arb]]) -> list[list[arb]]:
    """pi at each of the states; the origin goes through the network as one more column."""
    columns = [*states, [arb(0)] * len(states[0])]
    origin = [0.0] * len(states[0]) if policy.origin is None else policy.origin.tolist()
    h = network_in_arb(
        policy.network, arb_mat([[arb(at) + column[i] for column in columns] for i, at in enumerate(origin)])
    )
    net = h.tolist()
    if policy.squash == "tanh" and policy.centre != "preactivation":
        net = _tanh(h).tolist()
    result = []
    for j, q in enumerate(u_eq):
        *values, at_0 = net[j]
        eq, scale, offset = ball(q), arb(float(policy.scale[j])), arb(float(policy.offset[j]))
        if policy.centre == "preactivation":
            beta = ((eq - offset) / scale).atanh()
            result.append([scale * (y - at_0 + beta).tanh() + offset for y in values])
        elif policy.centre == "output":
            result.append([scale * (y - at_0) + eq for y in values])
        else:
            result.append([scale * y + offset for y in values])
        if policy.clip is not None:
            lo, hi = (arb(float(end[j])) for end in policy.clip)
            result[-1] = [u.max(lo).min(hi) for u in result[-1]]
    return [list(u) for u in zip(*result, strict=True)]


def network_in_arb(network: Network, h: arb_mat) -> arb_mat:
    """The network's values at the columns of h."""
    vectors = [h]
    for step in network.steps:
        vectors.append(step_in_arb(step, vectors[step.of[0]]))
    return vectors[-1]


def step_in_arb(step: Any, h: arb_mat) -> arb_mat:
    """What a step makes of a vector, column by column."""
    if isinstance(step, Affine):
        bias = arb_mat([[arb(v)] * h.ncols() for v in step.bias.tolist()])
        return arb_mat([[arb(w) for w in row] for row in step.weight.tolist()]) * h + bias
    if isinstance(step, Map):
        return arb_mat(h.nrows(), h.ncols(), [getattr(v, step.function)() for v in h.entries()])
    raise TypeError(f"no oracle for a step of this kind: {type(step).__name__}")


def _tanh(h: arb_mat) -> arb_mat:
    return arb_mat(h.nrows(), h.ncols(), [v.tanh() for v in h.entries()])


def quadratic(matrix: Any, d: Sequence[float]) -> arb:
    """d'M d, the entries of M being binary64 numbers or balls."""
    each = zip(d, matrix, strict=True)
    return sum((arb(p) * arb(m) * arb(q) for p, row in each for m, q in zip(row, d, strict=True)), arb(0))
