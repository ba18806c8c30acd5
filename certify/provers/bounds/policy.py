"""The policy on a box: affine in the box coordinates, with an error of second order.

Each layer is an affine form in d plus the errors made so far. tanh is relaxed by two parallel lines. Errors pass
forwards to give the next layer's range: the newest through |W|, the older ones through |W| or by their 2-norm through
||W||_2, whichever is less; for four layers of 256 this saves tenfold in boxes, at the price of one more column, where
a backward pass for every hidden neuron would cost a hundred. One backward pass for the outputs then sums each layer's
fresh error times the magnitude of its weight, so that errors cancel through W as they do in truth. A clip comes last,
by two parallel lines as well; where it certainly does nothing, nothing changes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from certify.loop.closed_loop import ClosedLoop
from certify.loop.policies import TanhNetwork
from certify.loop.rigorous import centring_with_errors
from certify.provers.bounds.compiled import kernels
from certify.provers.bounds.fused import FusedLayers, Layer
from certify.provers.bounds.taylor import EPS, TINY

Array = NDArray[np.float64]
_ENTRY, _NEURON = 0.05, 25.0  # operations of an entry of a product, of a relaxation
_NUMBERS = 2**15  # units of a layer times boxes at a time, which stay in a core's cache
_LIBM = 2.0**-47  # error allowed to torch.tanh, relative to 1


class LayersEnclosure:
    """Affine enclosures of a network over batches of boxes, on the device that holds its weights.

    Parameters
    ----------
    centring : what is added to the last layer's bias and to the output, each with its error, (m,) each.
    """

    def __init__(self, network: TanhNetwork, centring: Sequence[Array], device: torch.device) -> None:
        def tensor(array: object) -> Tensor:
            return torch.tensor(array, dtype=torch.float64, device=device)

        self.weights = [tensor(w) for w in network.weights]
        self.magnitudes = [w.abs() for w in self.weights]
        self.biases = [tensor(b) for b in network.biases]
        self.bias_errors = [torch.zeros_like(b) for b in self.biases]
        if network.is_moved:
            W, at = self.weights[0], tensor(network.origin)
            self.biases[0] = self.biases[0] + W @ at
            size = W.abs() @ at.abs() + self.biases[0].abs()
            self.bias_errors[0] = (len(at) + 2) * EPS * size + TINY
        self.rows = [w.norm(dim=1) for w in self.weights]
        self.norms = [float(torch.linalg.matrix_norm(w, 2)) * min(w.shape) ** (1 / 128) for w in self.weights]
        self.squash = network.squash == "tanh"
        self.scale = tensor(network.scale)
        shift, shift_error, offset, offset_error = (tensor(a) for a in centring)
        bias = self.biases[-1]
        self.biases[-1], self.offset = bias + shift, offset
        made = torch.where(shift == 0, 0.0, shift_error + EPS * (bias.abs() + shift.abs()))
        self.bias_errors[-1] = self.bias_errors[-1] + made
        self.offset_error = offset_error
        rows = (self.weights, self.magnitudes, self.biases, self.bias_errors, self.rows, self.norms)
        self.layers = [Layer(*row) for row in zip(*rows, strict=True)]
        self.units, self.widest = sum(network.layers[1:]), max(network.layers)
        self.clip = None if network.clip is None else tuple(tensor(end)[:, None] for end in network.clip)

    def __call__(self, x: Tensor, x_error: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Enclose the network for states `x[:, 0] + x[:, 1:] d` within x_error.

        Parameters
        ----------
        x : (n, n + 1, B); x_error : (n, B)

        Returns
        -------
        mid (m, B), slopes (m, n, B), error (m, B), share (n, B) : share says how much each axis spreads the
            first layer, which is where a split reduces the error.
        """
        h, error, share = self._in_pieces(x, x_error)
        through = self.scale[:, None] * h[:, 0]
        mid, slopes = through + self.offset[:, None], self.scale[:, None, None] * h[:, 1:]
        rounding = 4 * EPS * (through.abs() + self.offset.abs()[:, None] + slopes.abs().sum(1)) + TINY
        rounding = rounding + self.offset_error[:, None]
        error = (rounding + error) * (1 + 1e-12)
        if self.clip is not None:
            mid, slopes, error = clipped(mid, slopes, error, *self.clip)
        return mid, slopes, error, share

    def _in_pieces(self, x: Tensor, x_error: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """`_layers` on as many boxes at a time as stay in a core's cache, compiled where that pays."""
        batch = x.shape[2]
        if x.device.type != "cpu" or not batch:
            return self._layers(x, x_error)
        compiled, parts = kernels(self.units * batch), []
        bounds, piece = self._layers, max(1, _NUMBERS // self.widest)
        for one, its_error in zip(torch.split(x, piece, 2), torch.split(x_error, piece, 1), strict=True):
            if compiled is not None and not (isinstance(bounds, FusedLayers) and bounds.batch == one.shape[2]):
                bounds = FusedLayers(compiled, self.layers, self.squash, self.scale, one.shape[2])
            parts.append(bounds(one, its_error))
        h, error, share = (torch.cat(column, -1) for column in zip(*parts, strict=True))
        return h, error, share

    def _layers(self, x: Tensor, x_error: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The affine form (m, n + 1, B) behind the last layer, the scaled error (m, B) and `share`."""
        n, batch = x.shape[0], x.shape[2]
        h, ball = x, torch.zeros_like(x_error[0])
        errors = torch.stack([x_error, torch.zeros_like(x_error)], 1)  # fresh ones and older ones
        size = x.abs().sum(1)  # sum_j |h_ij|; its 2-norm over i, times sqrt(n + 1), bounds the sum of ||h_j||_2
        share = torch.ones(n, batch, dtype=x.dtype, device=x.device) / n
        passed: list[tuple[Tensor, Tensor | None, Tensor]] = []
        for k, W in enumerate(self.weights):
            last = k == len(self.weights) - 1
            width = W.shape[1]
            y = (W @ h.reshape(width, -1)).reshape(-1, n + 1, batch)
            y[:, 0] += self.biases[k][:, None]
            rounding = (width + 2) * EPS * (n + 1) ** 0.5 * self.rows[k][:, None] * size.norm(dim=0)
            rounding = rounding + 8 * EPS * (y[:, 0].abs() + self.biases[k].abs()[:, None]) + TINY
            rounding = rounding + self.bias_errors[k][:, None]
            through = (self.magnitudes[k] @ errors.reshape(width, -1)).reshape(-1, 2, batch)
            older = torch.minimum(through[:, 1], self.rows[k][:, None] * ball)
            error = (through[:, 0] + older) * (1 + width * EPS) + rounding
            ball = (self.norms[k] * (ball + errors[:, 0].norm(dim=0)) + rounding.norm(dim=0)) * (1 + width * EPS)
            if last and not self.squash:
                passed.append((W, None, rounding))
                h = y
                break
            spreads = y[:, 1:].abs()
            spread = spreads.sum(1)
            slope, shift, gap = relax_tanh(y[:, 0], (spread + error) * (1 + n * EPS))
            fresh = gap + slope * rounding + EPS * (slope * (y[:, 0].abs() + spread) + shift.abs()) + TINY
            if k == 0:
                share = (gap[:, None] * spreads / (spread[:, None] + TINY)).sum(0) + TINY
                share = share / share.sum(0)
            h = slope[:, None] * y
            h[:, 0] += shift
            size = (h[:, 0].abs() + slope * spread) * (1 + n * EPS)
            errors = torch.stack([fresh, slope * error], 1)
            ball = torch.minimum(slope.amax(0) * ball, errors[:, 1].norm(dim=0) * (1 + width * EPS))
            passed.append((W, slope, fresh))
        return h, self._error_backwards(passed, x_error), share

    def _error_backwards(self, passed: list[tuple[Tensor, Tensor | None, Tensor]], x_error: Tensor) -> Tensor:
        m, batch = len(self.scale), x_error.shape[1]
        weight = torch.diag(self.scale)[:, :, None].expand(m, m, batch)
        result = torch.zeros(m, batch, dtype=x_error.dtype, device=x_error.device)
        for W, slope, fresh in reversed(passed):
            result = result + (weight.abs() * fresh[:, None]).sum(0)
            through = weight if slope is None else slope[:, None] * weight
            weight = (W.T @ through.reshape(len(W), -1)).reshape(-1, m, batch)
        return result + (weight.abs() * x_error[:, None]).sum(0)


def operations_of_policy(network: TanhNetwork) -> float:
    """Operations to enclose a network on a box, about, as an `Effort` counts them."""
    entries, neurons = sum(W.size for W in network.weights), sum(len(b) for b in network.biases)
    return _ENTRY * entries * (network.n + network.m + 3) + _NEURON * neurons


class PolicyEnclosure(LayersEnclosure):
    """Affine enclosures of pi."""

    def __init__(self, loop: ClosedLoop, device: torch.device) -> None:
        super().__init__(loop.network, centring_with_errors(loop), device)


def relax_tanh(centre: Tensor, radius: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Parallel lines: (s, m, gap) with |tanh(y) - s y - m| <= gap for |y - centre| <= radius.

    s is the chord's slope. D(y) = tanh(y) - s y rises up to the p >= 0 at which tanh' is s and falls beyond, among
    y >= 0; among y <= 0 it is convex and largest at an end; and it is odd. tanh(p) = sqrt(1 - s), so that neither bound
    needs another tanh. Where p is not exact, |D'(p)| <= 2^-48 and D' is monotone between p and the exact one.
    """
    radius = radius * (1 + EPS) + EPS * centre.abs() + TINY
    lo, hi = centre - radius, centre + radius
    t_lo, t_hi = lo.tanh(), hi.tanh()
    width = hi - lo
    slope = ((t_hi - t_lo) / width).clamp(0.0, 1.0)
    t = (1 - slope).clamp(max=1 - EPS).sqrt()
    p = t.atanh()
    a, b = t_lo - slope * lo, t_hi - slope * hi
    slack = _LIBM * (1 + width)
    above = t.clamp(t_lo, t_hi) - slope * p.clamp(lo, hi)
    below = (-t).clamp(t_lo, t_hi) - slope * (-p).clamp(lo, hi)
    upper = torch.maximum(torch.maximum(a, b), above) + slack
    lower = torch.minimum(torch.minimum(a, b), below) - slack
    gap = (upper - lower) / 2 + EPS * (upper.abs() + lower.abs() + slope * (centre.abs() + radius)) + TINY
    return slope, (upper + lower) / 2, gap


def clipped(mid: Tensor, slopes: Tensor, error: Tensor, least: Tensor, most: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """`min(max(v, least), most)` of affine forms v = mid + slopes.d within error, again as affine forms.

    Between its corners clip(v) - s v is linear, so that its extremes lie at the ends of v's range or at the corners in
    it; s is the chord's slope.
    """
    spread = slopes.abs().sum(1)
    reach = (spread + error) * (1 + 8 * EPS * (1 + slopes.shape[1])) + EPS * mid.abs() + TINY
    lo, hi = mid - reach, mid + reach
    inside = (lo >= least) & (hi <= most)

    def clip(v: Tensor) -> Tensor:
        return torch.minimum(torch.maximum(v, least), most)

    slope = ((clip(hi) - clip(lo)) / (hi - lo)).clamp(0.0, 1.0)
    points = torch.stack(
        [lo, hi, torch.minimum(torch.maximum(least, lo), hi), torch.minimum(torch.maximum(most, lo), hi)]
    )
    above = clip(points) - slope * points
    size = (clip(points).abs() + slope * points.abs()).amax(0)
    upper, lower = above.amax(0), above.amin(0)
    shift, gap = (upper + lower) / 2, (upper - lower) / 2
    wide = slope * error + gap + 4 * EPS * (size + slope * (mid.abs() + spread)) + TINY
    return (
        torch.where(inside, mid, slope * mid + shift),
        torch.where(inside[:, None], slopes, slope[:, None] * slopes),
        torch.where(inside, error, wide * (1 + EPS)),
    )
