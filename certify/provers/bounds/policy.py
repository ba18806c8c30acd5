"""The policy on a box: affine in the box coordinates, with an error of second order.

Each layer is an affine form in d plus the errors made so far. Functions are relaxed by two parallel lines. Errors pass
forwards to give the next layer's range: the newest through |W|, the older ones through |W| or by their 2-norm through
||W||_2, whichever is less; for four layers of 256 this saves tenfold in boxes, at the price of one more column, where
a backward pass for every hidden neuron would cost a hundred. One backward pass for the outputs then sums each layer's
fresh error times the magnitude of its weight, so that errors cancel through W as they do in truth. A clip comes last,
by two parallel lines as well; where it certainly does nothing, nothing changes.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np

from certify.loop.closed_loop import ClosedLoop
from certify.loop.networks import Step
from certify.loop.policies import PolicyNetwork
from certify.loop.rigorous import centring_with_errors
from certify.provers.bounds.arrays import Array, joined
from certify.provers.bounds.compiled import loops
from certify.provers.bounds.fused import FusedLayers, Layer
from certify.provers.bounds.lines import clip_lines
from certify.provers.bounds.steps import StepsOnBoxes, observed
from certify.provers.bounds.taylor import EPS, TINY

_ENTRY, _NEURON, _OBSERVATION = 0.05, 25.0, 4.0  # operations of an entry of a product, of a relaxation, a model
_NUMBERS = 2**15  # units of a layer times boxes at a time, which stay in a core's cache, with a symbol for each axis
_MOST = 512  # boxes at a time
_TANH = 2.0**-46  # error of tanh and of what is made of it, relative to 1


Parts = tuple[Array, Array, Array, Array]


class Enclosure(ABC):
    """Affine enclosures of a network over batches of boxes.

    Parameters
    ----------
    centring : what is added to the last layer's value and to the output, each with its error, (m,) each.
    symbols : of the forms that the states come as; by default the n box coordinates.
    """

    def __init__(self, network: PolicyNetwork, centring: Sequence[Array], symbols: int | None = None) -> None:
        self.squash, self.scale = network.squash == "tanh", network.scale
        self.symbols = symbols or network.n
        self.shift, self.shift_error, self.offset, self.offset_error = centring
        self.clip = None if network.clip is None else tuple(end[:, None] for end in network.clip)
        numbers = max(network.network.sizes) * max(1, self.symbols // network.n)
        self.piece = min(_MOST, 2 ** ((_NUMBERS // numbers) | 1).bit_length() // 2)

    @np.errstate(all="ignore")
    def __call__(self, x: Array, x_error: Array) -> tuple[Array, Array, Array, Array]:
        """Enclose the network for states `x[:, 0] + x[:, 1:] d` within x_error.

        Parameters
        ----------
        x : (n, k + 1, B) in k symbols, by default the n box coordinates; x_error : (n, B)

        Returns
        -------
        mid (m, B), slopes (m, k, B), error (m, B), share (k, B) : share says how much each axis spreads the
            first layer, which is where a split reduces the error.
        """
        h, error, share, _ = self._in_pieces(x, x_error)
        through = self.scale[:, None] * h[:, 0]
        mid, slopes = through + self.offset[:, None], self.scale[:, None, None] * h[:, 1:]
        rounding = 4 * EPS * (np.abs(through) + np.abs(self.offset)[:, None] + np.abs(slopes).sum(1)) + TINY
        rounding = rounding + self.offset_error[:, None]
        error = (rounding + error) * (1 + 1e-12)
        if self.clip is not None:
            mid, slopes, error = clipped(mid, slopes, error, *self.clip)
        return mid, slopes, error, share / share.sum(0)

    @np.errstate(all="ignore")
    def between(self, x: Array, x_error: Array) -> tuple[Array, Array]:
        """The inputs' lower and upper ends (m, B) for such states, by the range of what the squash is taken of: tanh is
        monotone. They know nothing of a clip."""
        first, second = self.scale[:, None] * self._in_pieces(x, x_error)[3] + self.offset[:, None]
        doubt = (_TANH * np.abs(self.scale) + 4 * EPS * np.abs(self.offset) + self.offset_error)[:, None]
        return np.minimum(first, second) - doubt, np.maximum(first, second) + doubt

    def _in_pieces(self, x: Array, x_error: Array) -> Parts:
        """As many boxes at a time as stay in a core's cache, with the last repeated to make them up."""
        batch, parts = x.shape[2], []
        for first in range(0, batch, self.piece):
            index = np.arange(first, first + self.piece).clip(max=batch - 1)
            parts.append(self._inside(x.take(index, -1), x_error.take(index, -1), batch))
        h, error, share, ends = (joined(column)[..., :batch] for column in zip(*parts, strict=True))
        return h, error, share + TINY, ends

    @abstractmethod
    def _inside(self, x: Array, x_error: Array, batch: int) -> Parts:
        """The affine form (m, n + 1, B) of what is scaled, its scaled error (m, B), what each axis adds to the bends,
        (n, B), and the ends between which it lies, (2, m, B); `batch` is the number of boxes in all pieces."""


class LayersEnclosure(Enclosure):
    """Layers with one function between them, maybe behind an observation; states are forms in so many symbols."""

    @np.errstate(all="ignore")  # infinities and NaN are answers, which nothing is proved with
    def __init__(self, network: PolicyNetwork, centring: Sequence[Array], symbols: int | None = None) -> None:
        super().__init__(network, centring, symbols)
        self.observation, self.origin = network.network.observation, None
        layers = network.network.affine
        weights, biases = [step.weight.copy() for step in layers], [step.bias.copy() for step in layers]
        magnitudes, bias_errors = [np.abs(w) for w in weights], [np.zeros_like(b) for b in biases]
        if network.is_moved and self.observation is not None:
            self.origin = network.origin
        elif network.is_moved:
            at = network.origin
            biases[0] = biases[0] + weights[0] @ at
            size = magnitudes[0] @ np.abs(at) + np.abs(biases[0])
            bias_errors[0] = (len(at) + 2) * EPS * size + TINY
        rows = [np.linalg.norm(w, axis=1) for w in weights]
        norms = [norm_of(w) for w in weights]
        self.activation = next(iter(network.network.functions), "tanh")
        bias = biases[-1]
        biases[-1] = bias + self.shift
        made = np.where(self.shift == 0, 0.0, self.shift_error + EPS * (np.abs(bias) + np.abs(self.shift)))
        bias_errors[-1] = bias_errors[-1] + made
        columns = (weights, magnitudes, biases, bias_errors, rows, norms)
        self.layers = [Layer(*row) for row in zip(*columns, strict=True)]
        self.units = sum(network.layers[1:])
        self._spare: list[FusedLayers] = []

    def __getstate__(self) -> dict[str, object]:
        return {**vars(self), "_spare": []}

    def _inside(self, x: Array, x_error: Array, batch: int) -> Parts:
        bent = None
        if self.observation is not None:
            if self.origin is not None:
                x, x_error = moved(x, x_error, self.origin)
            x, x_error, bent = observed(self.observation, x, x_error)
        try:
            layers = self._spare.pop()
        except IndexError:
            layers = FusedLayers(self.layers, self.symbols, self.squash, self.scale, self.piece, self.activation)
        form, error, share, ends = layers(loops(self.units * batch), x, x_error)
        self._spare.append(layers)
        if bent is not None:
            share = share + (self.layers[0].magnitude.sum(0)[:, None, None] * bent).sum(0)
        return form, error, share, ends


class StepsEnclosure(Enclosure):
    """A network of any steps."""

    def __init__(self, network: PolicyNetwork, centring: Sequence[Array], symbols: int | None = None) -> None:
        super().__init__(network, centring, symbols)
        self.network, self.origin = network.network, network.origin if network.is_moved else None
        self.norms: dict[Step, float] = {step: norm_of(step.weight) for step in self.network.affine}

    def _inside(self, x: Array, x_error: Array, batch: int) -> Parts:
        if self.origin is not None:
            x, x_error = moved(x, x_error, self.origin)
        boxes = StepsOnBoxes(self.norms)
        value = boxes.value(self.network, x, x_error)
        if np.any(self.shift):
            value = boxes.shifted(value, self.shift, self.shift_error)
        ends = np.stack([value.h[:, 0] - value.radius, value.h[:, 0] + value.radius])
        if self.squash:
            value, ends = boxes.squashed(value), np.tanh(ends)
        return value.h, boxes.backwards(np.diag(self.scale)), boxes.share, ends


def norm_of(weight: Array) -> float:
    """At or above the 2-norm of a matrix."""
    return float(np.linalg.norm(weight, 2) * min(weight.shape) ** (1 / 128))


def moved(x: Array, x_error: Array, origin: Array) -> tuple[Array, Array]:
    """States as forms with their origin added."""
    at, h = origin[:, None], x.copy()
    h[:, 0] += at
    return h, x_error + EPS * (np.abs(x[:, 0]) + np.abs(at)) + TINY


def operations_of_policy(network: PolicyNetwork) -> float:
    """Operations to enclose a network on a box, about, as an `Effort` counts them."""
    of = network.network
    observations = _OBSERVATION * of.operations * (1 + network.n) ** 2
    return _ENTRY * of.entries * (network.n + network.m + 3) + _NEURON * of.units + observations


def policy_enclosure(loop: ClosedLoop, symbols: int | None = None) -> Enclosure:
    """Affine enclosures of pi in so many symbols, by default one for each state."""
    if loop.network.network.is_observed_chain:
        return LayersEnclosure(loop.network, centring_with_errors(loop), symbols)
    return StepsEnclosure(loop.network, centring_with_errors(loop), symbols)


def clipped(mid: Array, slopes: Array, error: Array, least: Array, most: Array) -> tuple[Array, Array, Array]:
    """`min(max(v, least), most)` of affine forms v = mid + slopes.d within error, again as affine forms."""
    spread = np.abs(slopes).sum(1)
    reach = (spread + error) * (1 + 8 * EPS * (1 + slopes.shape[1])) + EPS * np.abs(mid) + TINY
    lo, hi = mid - reach, mid + reach
    inside = (lo >= least) & (hi <= most)
    slope, shift, gap = clip_lines(lo, hi, least, most)
    wide = slope * error + gap + 4 * EPS * (slope * (np.abs(mid) + spread) + np.abs(shift)) + TINY
    return (
        np.where(inside, mid, slope * mid + shift),
        np.where(inside[:, None], slopes, slope[:, None] * slopes),
        np.where(inside, error, wide * (1 + EPS)),
    )
