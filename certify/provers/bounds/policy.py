"""The policy on a box: affine in the box coordinates, with an error of second order.

Each layer is an affine form in d plus the errors made so far. Functions are relaxed by two parallel lines. Errors pass
forwards to give the next layer's range: the newest through |W|, the older ones through |W| or by their 2-norm through
||W||_2, whichever is less; for four layers of 256 this saves tenfold in boxes, at the price of one more column, where
a backward pass for every hidden neuron would cost a hundred. One backward pass for the outputs then sums each layer's
fresh error times the magnitude of its weight, so that errors cancel through W as they do in truth. A clip comes last,
by two parallel lines as well; where it certainly does nothing, nothing changes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from certify.loop.closed_loop import ClosedLoop
from certify.loop.policies import TanhNetwork
from certify.loop.rigorous import centring_with_errors
from certify.provers.bounds.arrays import Array, joined
from certify.provers.bounds.compiled import loops
from certify.provers.bounds.fused import FusedLayers, Layer
from certify.provers.bounds.taylor import EPS, TINY

_ENTRY, _NEURON = 0.05, 25.0  # operations of an entry of a product, of a relaxation
_NUMBERS = 2**15  # units of a layer times boxes at a time, which stay in a core's cache
_MOST = 512  # boxes at a time


class LayersEnclosure:
    """Affine enclosures of a network over batches of boxes.

    Parameters
    ----------
    centring : what is added to the last layer's bias and to the output, each with its error, (m,) each.
    """

    @np.errstate(all="ignore")  # infinities and NaN are answers, which nothing is proved with
    def __init__(self, network: TanhNetwork, centring: Sequence[Array]) -> None:
        weights, biases = ([v.copy() for v in each] for each in (network.weights, network.biases))
        magnitudes, bias_errors = [np.abs(w) for w in weights], [np.zeros_like(b) for b in biases]
        if network.is_moved:
            at = network.origin
            biases[0] = biases[0] + weights[0] @ at
            size = magnitudes[0] @ np.abs(at) + np.abs(biases[0])
            bias_errors[0] = (len(at) + 2) * EPS * size + TINY
        rows = [np.linalg.norm(w, axis=1) for w in weights]
        norms = [float(np.linalg.norm(w, 2)) * min(w.shape) ** (1 / 128) for w in weights]
        self.squash = network.squash == "tanh"
        self.scale, self.activation = network.scale, network.activation
        shift, shift_error, self.offset, self.offset_error = centring
        bias = biases[-1]
        biases[-1] = bias + shift
        made = np.where(shift == 0, 0.0, shift_error + EPS * (np.abs(bias) + np.abs(shift)))
        bias_errors[-1] = bias_errors[-1] + made
        columns = (weights, magnitudes, biases, bias_errors, rows, norms)
        self.layers = [Layer(*row) for row in zip(*columns, strict=True)]
        self.units = sum(network.layers[1:])
        self.clip = None if network.clip is None else tuple(end[:, None] for end in network.clip)
        self.piece = min(_MOST, 2 ** ((_NUMBERS // max(network.layers)) | 1).bit_length() // 2)
        self._spare: list[FusedLayers] = []

    def __getstate__(self) -> dict[str, object]:
        return {**vars(self), "_spare": []}

    @np.errstate(all="ignore")
    def __call__(self, x: Array, x_error: Array) -> tuple[Array, Array, Array, Array]:
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
        rounding = 4 * EPS * (np.abs(through) + np.abs(self.offset)[:, None] + np.abs(slopes).sum(1)) + TINY
        rounding = rounding + self.offset_error[:, None]
        error = (rounding + error) * (1 + 1e-12)
        if self.clip is not None:
            mid, slopes, error = clipped(mid, slopes, error, *self.clip)
        return mid, slopes, error, share

    def _in_pieces(self, x: Array, x_error: Array) -> tuple[Array, Array, Array]:
        """The layers on as many boxes at a time as stay in a core's cache, with the last repeated to make them up."""
        batch, parts = x.shape[2], []
        try:
            layers = self._spare.pop()
        except IndexError:
            layers = FusedLayers(self.layers, self.squash, self.scale, self.piece, self.activation)
        how = loops(self.units * batch)
        for first in range(0, batch, self.piece):
            index = np.arange(first, first + self.piece).clip(max=batch - 1)
            parts.append(layers(how, x.take(index, -1), x_error.take(index, -1)))
        self._spare.append(layers)
        h, error, share = (joined(column)[..., :batch] for column in zip(*parts, strict=True))
        return h, error, share


def operations_of_policy(network: TanhNetwork) -> float:
    """Operations to enclose a network on a box, about, as an `Effort` counts them."""
    entries, neurons = sum(W.size for W in network.weights), sum(len(b) for b in network.biases)
    return _ENTRY * entries * (network.n + network.m + 3) + _NEURON * neurons


class PolicyEnclosure(LayersEnclosure):
    """Affine enclosures of pi."""

    def __init__(self, loop: ClosedLoop) -> None:
        super().__init__(loop.network, centring_with_errors(loop))


def clipped(mid: Array, slopes: Array, error: Array, least: Array, most: Array) -> tuple[Array, Array, Array]:
    """`min(max(v, least), most)` of affine forms v = mid + slopes.d within error, again as affine forms.

    Between its corners clip(v) - s v is linear, so that its extremes lie at the ends of v's range or at the corners in
    it; s is the chord's slope.
    """
    spread = np.abs(slopes).sum(1)
    reach = (spread + error) * (1 + 8 * EPS * (1 + slopes.shape[1])) + EPS * np.abs(mid) + TINY
    lo, hi = mid - reach, mid + reach
    inside = (lo >= least) & (hi <= most)

    def clip(v: Array) -> Array:
        return np.minimum(np.maximum(v, least), most)

    slope = ((clip(hi) - clip(lo)) / (hi - lo)).clip(0.0, 1.0)
    points = np.stack([lo, hi, *(np.minimum(np.maximum(end, lo), hi) for end in (least, most))])
    above = clip(points) - slope * points
    size = (np.abs(clip(points)) + slope * np.abs(points)).max(0)
    upper, lower = above.max(0), above.min(0)
    shift, gap = (upper + lower) / 2, (upper - lower) / 2
    wide = slope * error + gap + 4 * EPS * (size + slope * (np.abs(mid) + spread)) + TINY
    return (
        np.where(inside, mid, slope * mid + shift),
        np.where(inside[:, None], slopes, slope[:, None] * slopes),
        np.where(inside, error, wide * (1 + EPS)),
    )
