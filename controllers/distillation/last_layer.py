"""The last layer by least squares: the inputs that are wanted at states, and exactly the Jacobian at the origin."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from certify.loop.policies import PolicyNetwork

Array = NDArray[np.float64]
ROUNDS = 6  # Gauss-Newton steps at most: the squash and the clip are not linear
DAMPINGS = (10.0, 1.0, 0.1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6)  # of which each step takes the first that is nearly the best
NEARLY = 1.1  # its loss, relative to the smallest: less damping makes large weights that cancel


def fitted(
    weight: Array, features: Array, slopes: Array, wanted: Array, J: Array, weights: Array, form: PolicyNetwork
) -> Array:
    """The last layer's weights (m, h), from `weight` on.

    They lower the weighted squares of `u - wanted` with `u = clip(scale * squash(features W' + value) + offset)`, and
    `W slopes = J` holds up to rounding, as far as the units allow.

    Parameters
    ----------
    features : (N, h), the last units' values less those at the origin.
    slopes : (h, n), their Jacobian at the origin.
    wanted : (N, m), inputs.
    J : (m, n), the Jacobian of net at the origin.
    weights : (N,), of the states.
    form : a policy without centring whose squash, scale, offset and clip are meant; its net(0) is the value.
    """
    value = form.net(np.zeros(form.n))
    rows = np.array(weight)
    ends = form.clip or (np.full(form.m, -np.inf), np.full(form.m, np.inf))
    for j in range(form.m):

        def inputs(row: Array, j: int = j) -> tuple[Array, Array]:
            y = form.squashed(features @ row + value[j])
            u, slope = form.scale[j] * y + form.offset[j], form.scale[j] * form.squash_slope(y)
            return np.clip(u, ends[0][j], ends[1][j]), np.where((u > ends[0][j]) & (u < ends[1][j]), slope, 0.0)

        def loss(row: Array, j: int = j) -> float:
            u, _ = inputs(row, j)
            return float((weights * (u - wanted[:, j]) ** 2).mean())

        best = np.inf
        for _ in range(ROUNDS):
            u, slope = inputs(rows[j])
            steps = _steps(
                features * (np.sqrt(weights) * slope)[:, None],
                np.sqrt(weights) * (wanted[:, j] - u),
                slopes,
                J[j] - slopes.T @ rows[j],
            )
            losses = [loss(rows[j] + step) for step in steps]
            k = next(k for k, found in enumerate(losses) if found <= NEARLY * min(losses))
            if not losses[k] < best:
                break
            best, rows[j] = losses[k], rows[j] + steps[k]
    return rows


def _steps(A: Array, r: Array, slopes: Array, c: Array) -> list[Array]:
    """For each damping the d with `slopes' d = c` that lowers `|A d - r|^2 + damping |d|^2`, scaled by A."""
    h, n = slopes.shape
    G, g = A.T @ A, A.T @ r
    size = max(float(np.trace(G)) / h, 1e-300)
    system, right = np.zeros((h + n, h + n)), np.concatenate([g / size, c])
    found = []
    for damping in DAMPINGS:
        system[:h, :h] = G / size + damping * np.eye(h)
        system[:h, h:], system[h:, :h] = slopes, slopes.T
        found.append(np.linalg.lstsq(system, right, rcond=1e-12)[0][:h])
    return found
