"""Models of a tanh network N on boxes, and of N'F, its derivative along the plant's motion.

The network goes layer by layer, all units of a layer at once: a row for each coefficient, so that a layer's weights are
one product of matrices. Q is symmetric, and only its coefficients of d_i d_j with i <= j are carried, which is nearly
half of them. N itself needs the box's symbols only, and most boxes nothing but N; the inputs' errors and what is
uncertain join in its derivative, `y_1 = W_1 F`, `y_(k+1) = W_(k+1) (tanh'(a_k) y_k)` (FORMAT.md, rule `outer`).

On large boxes a model's remainder knows no end, where tanh itself does: there N is bounded from below as policies are,
by parallel lines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from certify.loop.policies import PolicyNetwork
from certify.lyapunov.neural import Neural
from certify.provers.bounds.arrays import Array, Index, chosen, is_whole
from certify.provers.bounds.policy import LayersEnclosure
from certify.provers.bounds.taylor import EPS, TINY, Taylor

_FOURTH = 4.1  # above |tanh''''| everywhere
_FIFTH = 16.0  # as large as the fifth derivative of tanh can be


@dataclass(frozen=True, slots=True)
class _Units:
    """Models of H numbers: `rows` (R, H, B) of c, of the N entries of g, and of the coefficients of d_i d_j, i <= j,
    ordered by j and then by i, or without these where they are 0; the remainders are `r` (H, B)."""

    symbols: int
    rows: Array
    r: Array

    @property
    def c(self) -> Array:
        return np.asarray(self.rows[0])

    @property
    def g(self) -> Array:
        return self.rows[1 : 1 + self.symbols]

    @property
    def q(self) -> Array:
        return self.rows[1 + self.symbols :]

    def at(self, index: Index) -> _Units:
        return _Units(self.symbols, self.rows.take(index, -1), self.r.take(index, -1))

    def model(self) -> Taylor:
        """The only one, with Q in full."""
        N, batch = self.symbols, self.r.shape[1]
        Q = np.zeros((N, N, batch))
        for j in range(N if len(self.q) else 0):
            half = self.q[_block(j), 0] / 2
            Q[: j + 1, j] = half
            Q[j, : j + 1] += half
        return Taylor(self.c[0], self.g[:, 0], Q, self.r[0])


@dataclass(frozen=True, slots=True)
class _Bent:
    """The terms of the tanh of a layer's units: their models a, t = tanh(c), the products g_i g_j as rows of a
    quadratic part, and G, Q of them; `rest` is the remainder of tanh(a)."""

    a: _Units
    t: Array
    square: Array
    G: Array
    Q: Array
    rest: Array

    def at(self, index: Index) -> _Bent:
        fields = (self.t, self.square, self.G, self.Q, self.rest)
        return _Bent(self.a.at(index), *(v.take(index, -1) for v in fields))


@dataclass(frozen=True, slots=True)
class NeuralModels:
    """N on a batch of boxes, `value` in the n symbols of the box."""

    weights: NeuralEnclosure
    value: Taylor
    layers: Sequence[_Bent]

    @property
    def share(self) -> Array:
        """The share of each axis (n, B) in the spread of the units of the first layer that err most, in all 1."""
        return self._share(self.layers[:1], 0.0)

    def _share(self, first: Sequence[_Bent], more: Array | float) -> Array:
        """The same on some boxes, where the units err by `more` besides."""
        if not first:  # an affine N
            return np.full_like(self.value.g, 1 / len(self.value.g))
        layer = first[0]
        share = ((layer.rest + more) * self.weights.reach / (layer.G + TINY) * np.abs(layer.a.g)).sum(1)
        return np.asarray(share / (share.sum(0) + TINY))

    def along(self, F: Sequence[Taylor], index: Index) -> tuple[Taylor, Array]:
        """N'F on the boxes `index`, where F is given, and `share` (n, B): how much each axis spreads the units of the
        first layer that err most."""
        layers = self.layers if is_whole(index, len(self.value.c)) else [layer.at(index) for layer in self.layers]
        y, size = _packed(F)
        errors: Array | float = 0.0
        for k, W in enumerate(self.weights.weights):
            y = _through(W, self.weights.magnitudes[k], None, y, size)
            if k < len(layers):
                y, size = _times_slope(layers[k], y)
                errors = y.r if k == 0 else errors
        return y.model(), self._share(layers[:1], errors)


class NeuralEnclosure:
    """Models of N over batches of boxes."""

    def __init__(self, function: Neural) -> None:
        self.weights, self.biases = function.weights, function.biases
        self.magnitudes = [np.abs(w) for w in self.weights]
        self.units = max(function.widths)
        one, zero = np.ones(1), np.zeros(1)
        network = PolicyNetwork.of_layers(function.weights, function.biases, one, zero, "identity", "none")
        self.lines = LayersEnclosure(network, (zero, zero, zero, zero))
        reach = self.magnitudes[-1]
        for magnitude in reversed(self.magnitudes[1:-1]):
            reach = reach @ magnitude
        self.reach = reach.T  # the most that N moves with a unit of the first layer (units, 1)

    def least(self, x: Array, error: Array, level: float) -> Array:
        """A lower bound of N (B,), good where boxes are large; -inf where N is not above the level at the centre."""
        h = x[:, 0]
        for k, (W, b) in enumerate(zip(self.weights, self.biases, strict=True)):
            h = W @ (np.tanh(h) if k else h) + b[:, None]
        found = np.full_like(h[0], -np.inf)
        index = chosen(h[0] > level)
        if len(index):
            mid, slopes, wide, _ = self.lines(x.take(index, -1), error.take(index, -1))
            spread = np.abs(slopes[0]).sum(0) + wide[0]
            found[index] = mid[0] - spread - 1e-11 * (np.abs(mid[0]) + spread)
        return np.asarray(np.nan_to_num(found, nan=-np.inf, posinf=-np.inf, neginf=-np.inf))

    def __call__(self, x: Array, error: Array) -> NeuralModels:
        """N for states `x[:, 0] + x[:, 1:] d`, (n, n + 1, B), within the error (n, B)."""
        n = x.shape[0]
        h, size = _Units(n, np.ascontiguousarray(x.swapaxes(0, 1)), error), np.abs(x).sum(1) + error
        layers = []
        for k, W in enumerate(self.weights):
            h = _through(W, self.magnitudes[k], self.biases[k], h, size)
            if k + 1 < len(self.weights):
                layer, h, size = _tanh(h)
                layers.append(layer)
        return NeuralModels(self, h.model(), layers)


def _block(j: int) -> slice:
    """The rows with the coefficients of d_0 d_j to d_j d_j."""
    return slice(j * (j + 1) // 2, (j + 1) * (j + 2) // 2)


def _sizes(rows: Array) -> Array:
    """The sum of the rows' magnitudes, a row at a time, which stays in a core's cache."""
    if not len(rows):
        return np.zeros(rows.shape[1:])
    total: Array = np.abs(rows[0])
    size = np.empty_like(total)
    for row in rows[1:]:
        total += np.abs(row, out=size)
    return total


def _through(W: Array, magnitude: Array, bias: Array | None, h: _Units, size: Array) -> _Units:
    """W h + bias, where |c| + G + Q of h is at most `size` (in, B)."""
    rows = np.matmul(W, h.rows)
    r = magnitude @ (h.r * (1 + 2 * EPS) + (W.shape[1] + 4) * EPS * size) * (1 + W.shape[1] * EPS) + TINY
    if bias is not None:
        rows[0] += bias[:, None]
        r += EPS * (np.abs(rows[0]) + np.abs(bias)[:, None])
    return _Units(h.symbols, rows, r)


def _composed(a: _Units, square: Array, f0: Array, f1: Array, f2: Array, rest: Array) -> _Units:
    """`f0 + f1 (a - c) + f2 (g.d)^2` within `rest`."""
    N = a.symbols
    rows = np.empty((1 + N + len(square), *f0.shape))
    np.multiply(a.rows, f1, out=rows[: len(a.rows)])
    rows[0] = f0
    if len(a.q):
        rows[1 + N :] += square * f2
    else:
        np.multiply(square, f2, out=rows[1 + N :])
    return _Units(N, rows, rest)


def _tanh(a: _Units) -> tuple[_Bent, _Units, Array]:
    """tanh of a, its terms, and a bound of |c| + G + Q of it."""
    g, N = a.g, a.symbols
    square = np.empty((N * (N + 1) // 2, *g.shape[1:]))
    for j in range(N):
        block = square[_block(j)]
        np.multiply(g[: j + 1], g[j], out=block)
        block[:j] *= 2
    G, Q = _sizes(g), _sizes(a.q)
    t = np.tanh(a.c)
    f1 = 1 - t * t
    f2 = -t * f1
    q = Q + a.r
    rho = G + q
    rest = f1 * a.r + np.abs(f2) * (q * (2 * G + q)) + (1 / 3 + EPS) * (rho * rho * rho)
    size = np.abs(t) + f1 * (G + Q) + np.abs(f2) * G * G
    rest = rest + 4 * EPS * (size + rest) + 2 * EPS * (1 + rho + rho * rho) + TINY
    return _Bent(a, t, square, G, Q, rest), _composed(a, square, t, f1, f2, rest), size


def _times_slope(layer: _Bent, y: _Units) -> tuple[_Units, Array]:
    """tanh'(a) y, and a bound of |c| + G + Q of it; a has the first symbols of y."""
    a, t = layer.a, layer.t
    f0 = 1 - t * t
    f1, f2 = -2 * t * f0, (3 * t * t - 1) * f0
    q = layer.Q + a.r
    rho = layer.G + q
    third = np.minimum(np.abs(8 * t * (2 - 3 * t * t) * f0) + _FIFTH * (rho + EPS), _FOURTH) / 6
    rest = np.abs(f1) * a.r + np.abs(f2) * (q * (2 * layer.G + q)) + third * (rho * rho * rho) * (1 + 4 * EPS)
    rest = rest + 4 * EPS * rest + 4 * EPS * (1 + rho + rho * rho) + TINY
    slope = _composed(a, layer.square, f0, f1, f2, rest)
    n, inner = a.symbols, len(layer.square)

    rows = y.rows * f0
    rows[1 : 1 + n] += slope.g * y.c
    quadratic = rows[1 + y.symbols :]
    quadratic[:inner] += slope.q * y.c
    for j in range(y.symbols):
        block = quadratic[_block(j)]
        both = min(j + 1, n)
        block[:both] += slope.g[:both] * y.g[j]
        if j < n:
            block[:j] += y.g[:j] * slope.g[j]
    Gs, Qs, Gy, Qy = np.abs(f1) * layer.G, _sizes(slope.q), _sizes(y.g), _sizes(y.q)
    known, whole = Gy + Qy, f0 + Gs + Qs
    r = f0 * y.r + Gs * Qy + Qs * known + rest * (np.abs(y.c) + known + y.r) + y.r * (Gs + Qs)
    size = whole * (np.abs(y.c) + known)
    return _Units(y.symbols, rows, r + 2 * EPS * (size + r) + TINY), size


def _packed(models: Sequence[Taylor]) -> tuple[_Units, Array]:
    """Models as rows, and |c| + G + Q of each."""
    N = len(models[0].g)
    count, batch = len(models), len(models[0].c)
    rows = np.empty((1 + N + N * (N + 1) // 2, count, batch))
    r = np.empty((count, batch))
    for i, model in enumerate(models):
        rows[0, i], rows[1 : 1 + N, i], r[i] = model.c, model.g, model.r
        for j in range(N):
            block = rows[1 + N :][_block(j), i]
            np.add(model.Q[: j + 1, j], model.Q[j, : j + 1], out=block)
            block[j] /= 2
    size = _sizes(rows)
    return _Units(N, rows, r + EPS * size + TINY), size
