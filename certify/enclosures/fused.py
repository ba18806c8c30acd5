"""The layers of a policy on a box as `policy.py` bounds them, with compiled loops between the products of matrices.

The same formulas as there, on boxes few enough that what passes from layer to layer stays in a core's cache, in memory
that is there already: fresh pages of the system cost as much as a product. The results are those up to rounding, of
which each accounts for its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType

import torch
from torch import Tensor


@dataclass(frozen=True, slots=True)
class Layer:
    """W (H, K) and |W|, the bias and its error (H,), the 2-norms of the rows (H,), and that of W, on the processor."""

    W: Tensor
    magnitude: Tensor
    bias: Tensor
    bias_error: Tensor
    rows: Tensor
    norm: float


class FusedLayers:
    """Bounds of layers with tanh between them, and behind the last if `squash`, on up to `batch` boxes at a time.

    Parameters
    ----------
    kernels : the module of that name.
    scale : of the outputs (m,), by which errors are weighed.
    """

    def __init__(self, kernels: ModuleType, layers: Sequence[Layer], squash: bool, scale: Tensor, batch: int) -> None:
        self.kernels, self.layers, self.squash, self.scale = kernels, layers, squash, scale
        n, m = layers[0].W.shape[1], len(scale)
        widths = [len(layer.W) for layer in layers]
        units, widest = max(widths) * batch, max(n, *widths) * batch

        def numbers(count: int) -> Tensor:
            return torch.empty(count, dtype=torch.float64)

        self._forms = [numbers(units * (n + 1)) for _ in range(2)]
        self._weights = [numbers(widest * m) for _ in range(2)]
        self._ends, self._values, self._through = (numbers(2 * units) for _ in range(3))
        self._t, self._p, self._error, self._rounding, self._spread = (numbers(units) for _ in range(5))
        self._slopes = [numbers(width * batch) for width in widths]
        self._errors = [numbers(2 * width * batch) for width in widths]

    def __call__(self, x: Tensor, x_error: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The affine form (m, n + 1, B) behind the last layer, the scaled error (m, B) and `share` (n, B)."""
        k, (n, forms, batch) = self.kernels, x.shape
        h, errors = x.reshape(n, -1), torch.stack([x_error, torch.zeros_like(x_error)], 1)
        size, fresh = x.abs().sum(1).square().sum(0), x_error.square().sum(0)
        ball, share = torch.zeros_like(size), torch.zeros_like(x_error)
        for i, layer in enumerate(self.layers):
            units, width = layer.W.shape
            y, through = _shaped(self._forms[i % 2], units, forms, batch), _shaped(self._through, units, 2, batch)
            torch.mm(layer.W, h, out=y.view(units, -1))
            torch.mm(layer.magnitude, errors.reshape(width, -1), out=through.view(units, -1))
            ends, values = _shaped(self._ends, 2, units, batch), _shaped(self._values, 2, units, batch)
            error, rounding, spread = (_shaped(v, units, batch) for v in (self._error, self._rounding, self._spread))
            known = (layer.bias, layer.bias_error, layer.rows, through, size, fresh, ball)
            found = (v.numpy() for v in (ends, error, rounding, spread))
            k.ranges(y.numpy(), *(v.numpy() for v in known), layer.norm, width, *found)
            errors, slope = _shaped(self._errors[i], units, 2, batch), _shaped(self._slopes[i], units, batch)
            if i == len(self.layers) - 1 and not self.squash:
                errors[:, 0], slope[:] = rounding, 1.0
            else:
                t, p = _shaped(self._t, units, batch), _shaped(self._p, units, batch)
                torch.tanh(ends, out=values)
                k.chords(*(v.numpy() for v in (ends, values, slope, t)))
                torch.atanh(t, out=p)
                before = (v.numpy() for v in (y, ends, values, slope, t, p))
                after = (v.numpy() for v in (error, rounding, spread, errors, size, fresh, ball))
                k.bend(*before, width, *after, (share if i == 0 else share[:0]).numpy())
            h = y.view(units, -1)
        return y.clone(), self._backwards(x_error), self._normalised(share)

    def _backwards(self, x_error: Tensor) -> Tensor:
        """What all errors on the way add to the outputs' (m, B), by the magnitudes of their weights."""
        m, batch = len(self.scale), x_error.shape[1]
        weight = _shaped(self._weights[0], m, m, batch)
        weight[:] = torch.diag(self.scale)[:, :, None]
        result = torch.zeros(m, batch, dtype=torch.float64)
        for i in range(len(self.layers) - 1, -1, -1):
            units, width = self.layers[i].W.shape
            errors, slope = _shaped(self._errors[i], units, 2, batch), _shaped(self._slopes[i], units, batch)
            self.kernels.backwards(*(v.numpy() for v in (weight, errors, slope, result)))
            on = _shaped(self._weights[(len(self.layers) - i) % 2], width, m, batch)
            torch.mm(self.layers[i].W.T, weight.view(units, -1), out=on.view(width, -1))
            weight = on
        return result + (weight.abs() * x_error[:, None]).sum(0)

    def _normalised(self, share: Tensor) -> Tensor:
        if len(self.layers) == 1 and not self.squash:
            return torch.full_like(share, 1 / len(share))
        share = share + self.kernels.TINY
        return share / share.sum(0)


def _shaped(buffer: Tensor, *shape: int) -> Tensor:
    """The first numbers of a buffer."""
    return buffer[: torch.Size(shape).numel()].view(shape)
