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
import torch
from torch import Tensor

from certify.loop.policies import TanhNetwork
from certify.lyapunov.neural import Neural
from certify.provers.bounds.policy import LayersEnclosure
from certify.provers.bounds.taylor import EPS, TINY, Taylor

_FOURTH = 4.1  # above |tanh''''| everywhere
_FIFTH = 16.0  # as large as the fifth derivative of tanh can be


@dataclass(frozen=True, slots=True)
class _Units:
    """Models of H numbers: `rows` (R, H, B) of c, of the N entries of g, and of the coefficients of d_i d_j, i <= j,
    ordered by j and then by i, or without these where they are 0; the remainders are `r` (H, B)."""

    symbols: int
    rows: Tensor
    r: Tensor

    @property
    def c(self) -> Tensor:
        return self.rows[0]

    @property
    def g(self) -> Tensor:
        return self.rows[1 : 1 + self.symbols]

    @property
    def q(self) -> Tensor:
        return self.rows[1 + self.symbols :]

    def at(self, index: Tensor) -> _Units:
        return _Units(self.symbols, self.rows[:, :, index], self.r[:, index])

    def model(self) -> Taylor:
        """The only one, with Q in full."""
        N, batch = self.symbols, self.r.shape[1]
        Q = torch.zeros(N, N, batch, dtype=self.rows.dtype, device=self.rows.device)
        for j in range(N if len(self.q) else 0):
            half = self.q[_block(j), 0] / 2
            Q[: j + 1, j] = half
            Q[j, : j + 1] += half
        return Taylor(self.c[0], self.g[:, 0], Q, self.r[0])


@dataclass(frozen=True, slots=True)
class _Bent:
    """What the tanh of a layer's units was evaluated with: their models a, t = tanh(c), the products g_i g_j as rows of
    a quadratic part, and G, Q of them; `rest` is the remainder of tanh(a)."""

    a: _Units
    t: Tensor
    square: Tensor
    G: Tensor
    Q: Tensor
    rest: Tensor

    def at(self, index: Tensor) -> _Bent:
        fields = (self.t[:, index], self.square[:, :, index], self.G[:, index], self.Q[:, index], self.rest[:, index])
        return _Bent(self.a.at(index), *fields)


@dataclass(frozen=True, slots=True)
class NeuralModels:
    """N on a batch of boxes, `value` in the n symbols of the box."""

    weights: NeuralEnclosure
    value: Taylor
    layers: Sequence[_Bent]

    @property
    def share(self) -> Tensor:
        """How much each axis (n, B) spreads the units of the first layer that err most, in all 1."""
        return self._share(self.layers[:1], 0.0)

    def _share(self, first: Sequence[_Bent], more: Tensor | float) -> Tensor:
        """The same on some boxes, where the units err by `more` besides."""
        if not first:  # an affine N
            return torch.full_like(self.value.g, 1 / len(self.value.g))
        layer = first[0]
        share = ((layer.rest + more) * self.weights.reach / (layer.G + TINY) * layer.a.g.abs()).sum(1)
        return share / (share.sum(0) + TINY)

    def along(self, F: Sequence[Taylor], index: Tensor) -> tuple[Taylor, Tensor]:
        """N'F on the boxes `index`, F being what it is there, and `share` (n, B): how much each axis spreads the units
        of the first layer that err most."""
        layers = self.layers if len(index) == len(self.value.c) else [layer.at(index) for layer in self.layers]
        y, size = _packed(F)
        errors: Tensor | float = 0.0
        for k, W in enumerate(self.weights.weights):
            y = _through(W, self.weights.magnitudes[k], None, y, size)
            if k < len(layers):
                y, size = _times_slope(layers[k], y)
                errors = y.r if k == 0 else errors
        return y.model(), self._share(layers[:1], errors)


class NeuralEnclosure:
    """Models of N over batches of boxes, on the device that holds its weights."""

    def __init__(self, function: Neural, device: torch.device) -> None:
        def tensor(array: object) -> Tensor:
            return torch.tensor(array, dtype=torch.float64, device=device)

        self.weights = [tensor(w) for w in function.weights]
        self.magnitudes = [w.abs() for w in self.weights]
        self.biases = [tensor(b) for b in function.biases]
        self.units = max(function.widths)
        one, zero = np.ones(1), np.zeros(1)
        network = TanhNetwork(function.weights, function.biases, one, zero, "identity", "none")
        self.lines = LayersEnclosure(network, (zero, zero, zero, zero), device)
        reach = self.magnitudes[-1]
        for magnitude in reversed(self.magnitudes[1:-1]):
            reach = reach @ magnitude
        self.reach = reach.T  # how far, at most, N moves with a unit of the first layer (units, 1)

    def least(self, x: Tensor, error: Tensor, level: float) -> Tensor:
        """A lower bound of N (B,), good where boxes are large; -inf where N is not above the level at the centre."""
        h = x[:, 0]
        for k, (W, b) in enumerate(zip(self.weights, self.biases, strict=True)):
            h = torch.addmm(b[:, None], W, h.tanh() if k else h)
        found = torch.full_like(h[0], -torch.inf)
        index = torch.nonzero(h[0] > level)[:, 0]
        if len(index):
            mid, slopes, wide, _ = self.lines(x[:, :, index], error[:, index])
            spread = slopes[0].abs().sum(0) + wide[0]
            found[index] = mid[0] - spread - 1e-11 * (mid[0].abs() + spread)
        return found.nan_to_num(-torch.inf, -torch.inf, -torch.inf)

    def __call__(self, x: Tensor, error: Tensor) -> NeuralModels:
        """N for states `x[:, 0] + x[:, 1:] d`, (n, n + 1, B), within the error (n, B)."""
        n = x.shape[0]
        h, size = _Units(n, x.transpose(0, 1).contiguous(), error), x.abs().sum(1) + error
        layers = []
        for k, W in enumerate(self.weights):
            h = _through(W, self.magnitudes[k], self.biases[k], h, size)
            if k + 1 < len(self.weights):
                layer, h, size = _tanh(h)
                layers.append(layer)
        return NeuralModels(self, h.model(), layers)


def _block(j: int) -> slice:
    """Where the coefficients of d_0 d_j to d_j d_j are."""
    return slice(j * (j + 1) // 2, (j + 1) * (j + 2) // 2)


def _sizes(rows: Tensor) -> Tensor:
    """The sum of the rows' magnitudes, a row at a time, which stays in a core's cache."""
    if not len(rows):
        return rows.new_zeros(rows.shape[1:])
    total = rows[0].abs()
    size = torch.empty_like(total)
    for row in rows[1:]:
        total += torch.abs(row, out=size)
    return total


def _through(W: Tensor, magnitude: Tensor, bias: Tensor | None, h: _Units, size: Tensor) -> _Units:
    """W h + bias, where |c| + G + Q of h is at most `size` (in, B)."""
    rows = torch.matmul(W, h.rows)
    r = magnitude @ (h.r * (1 + 2 * EPS) + (W.shape[1] + 4) * EPS * size) * (1 + W.shape[1] * EPS) + TINY
    if bias is not None:
        rows[0] += bias[:, None]
        r += EPS * (rows[0].abs() + bias.abs()[:, None])
    return _Units(h.symbols, rows, r)


def _composed(a: _Units, square: Tensor, f0: Tensor, f1: Tensor, f2: Tensor, rest: Tensor) -> _Units:
    """`f0 + f1 (a - c) + f2 (g.d)^2` within `rest`."""
    N = a.symbols
    rows = torch.empty(1 + N + len(square), *f0.shape, dtype=f0.dtype, device=f0.device)
    torch.mul(a.rows, f1, out=rows[: len(a.rows)])
    rows[0] = f0
    if len(a.q):
        rows[1 + N :].addcmul_(square, f2)
    else:
        torch.mul(square, f2, out=rows[1 + N :])
    return _Units(N, rows, rest)


def _tanh(a: _Units) -> tuple[_Bent, _Units, Tensor]:
    """tanh of a, what it was evaluated with, and a bound of |c| + G + Q of it."""
    g, N = a.g, a.symbols
    square = torch.empty(N * (N + 1) // 2, *g.shape[1:], dtype=g.dtype, device=g.device)
    for j in range(N):
        block = square[_block(j)]
        torch.mul(g[: j + 1], g[j], out=block)
        block[:j] *= 2
    G, Q = _sizes(g), _sizes(a.q)
    t = a.c.tanh()
    f1 = 1 - t * t
    f2 = -t * f1
    q = Q + a.r
    rho = G + q
    rest = f1 * a.r + f2.abs() * (q * (2 * G + q)) + (1 / 3 + EPS) * rho**3
    size = t.abs() + f1 * (G + Q) + f2.abs() * G * G
    rest = rest + 4 * EPS * (size + rest) + 2 * EPS * (1 + rho + rho * rho) + TINY
    return _Bent(a, t, square, G, Q, rest), _composed(a, square, t, f1, f2, rest), size


def _times_slope(layer: _Bent, y: _Units) -> tuple[_Units, Tensor]:
    """tanh'(a) y, and a bound of |c| + G + Q of it; a has the first symbols of y."""
    a, t = layer.a, layer.t
    f0 = 1 - t * t
    f1, f2 = -2 * t * f0, (3 * t * t - 1) * f0
    q = layer.Q + a.r
    rho = layer.G + q
    third = ((8 * t * (2 - 3 * t * t) * f0).abs() + _FIFTH * (rho + EPS)).clamp(max=_FOURTH) / 6
    rest = f1.abs() * a.r + f2.abs() * (q * (2 * layer.G + q)) + third * rho**3 * (1 + 4 * EPS)
    rest = rest + 4 * EPS * rest + 4 * EPS * (1 + rho + rho * rho) + TINY
    slope = _composed(a, layer.square, f0, f1, f2, rest)
    n, inner = a.symbols, len(layer.square)

    rows = y.rows * f0
    rows[1 : 1 + n].addcmul_(slope.g, y.c)
    quadratic = rows[1 + y.symbols :]
    quadratic[:inner].addcmul_(slope.q, y.c)
    for j in range(y.symbols):
        block = quadratic[_block(j)]
        both = min(j + 1, n)
        block[:both].addcmul_(slope.g[:both], y.g[j])
        if j < n:
            block[:j].addcmul_(y.g[:j], slope.g[j])
    Gs, Qs, Gy, Qy = f1.abs() * layer.G, _sizes(slope.q), _sizes(y.g), _sizes(y.q)
    known, whole = Gy + Qy, f0 + Gs + Qs
    r = f0 * y.r + Gs * Qy + Qs * known + rest * (y.c.abs() + known + y.r) + y.r * (Gs + Qs)
    size = whole * (y.c.abs() + known)
    return _Units(y.symbols, rows, r + 2 * EPS * (size + r) + TINY), size


def _packed(models: Sequence[Taylor]) -> tuple[_Units, Tensor]:
    """Models as rows, and |c| + G + Q of each."""
    N = len(models[0].g)
    count, batch = len(models), len(models[0].c)
    rows = models[0].c.new_empty(1 + N + N * (N + 1) // 2, count, batch)
    r = models[0].c.new_empty(count, batch)
    for i, model in enumerate(models):
        rows[0, i], rows[1 : 1 + N, i], r[i] = model.c, model.g, model.r
        for j in range(N):
            block = rows[1 + N :][_block(j), i]
            torch.add(model.Q[: j + 1, j], model.Q[j, : j + 1], out=block)
            block[j] /= 2
    size = _sizes(rows)
    return _Units(N, rows, r + EPS * size + TINY), size
