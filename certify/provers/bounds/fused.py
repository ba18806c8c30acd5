"""The layers of a policy on boxes as `policy.py` bounds them, with compiled loops between the products of matrices.

The same formulas as there, on boxes few enough that what passes from layer to layer stays in a core's cache, in memory
that is there already: fresh pages of the system cost as much as a product. The results are those up to rounding, of
which each accounts for its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

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


@dataclass(frozen=True, slots=True)
class _Prepared:
    """A layer with the memory that it works in.

    `h` and `errors` come in as matrices (K, ...), `y` and `through` are what W and |W| make of them. `error`, the fresh
    errors and the older ones (H, 2, B), and `slope` (H, B) go on into the backward pass. `ranges`, `chords` and `bend`
    are the arguments of these kernels.
    """

    layer: Layer
    h: Tensor
    errors: Tensor
    y: Tensor
    through: Tensor
    ends: Tensor
    values: Tensor
    t: Tensor
    p: Tensor
    rounding: Tensor
    error: Tensor
    slope: Tensor
    ranges: tuple[Any, ...]
    chords: tuple[Any, ...]
    bend: tuple[Any, ...]


class FusedLayers:
    """Bounds of layers with tanh between them, and behind the last if `squash`, on `batch` boxes at a time.

    Parameters
    ----------
    kernels : the module of that name.
    scale : of the outputs (m,), by which errors are weighed.
    """

    def __init__(self, kernels: ModuleType, layers: Sequence[Layer], squash: bool, scale: Tensor, batch: int) -> None:
        self.kernels, self.squash, self.scale, self.batch = kernels, squash, scale, batch
        n, m = layers[0].W.shape[1], len(scale)
        units = max(len(layer.W) for layer in layers)
        widest = max(n, units)

        def numbers(*shape: int) -> Tensor:
            return torch.empty(*shape, batch, dtype=torch.float64)

        self._x, self._x_errors = numbers(n, n + 1), numbers(n, 2)
        self._size, self._fresh, self._ball, self._share = numbers(), numbers(), numbers(), numbers(n)
        forms, weights = [numbers(units, n + 1) for _ in range(2)], [numbers(widest, m) for _ in range(2)]
        through, ends, values = numbers(units, 2), numbers(2 * units), numbers(2 * units)
        t, p, whole, rounding, spread = (numbers(units) for _ in range(5))
        self._layers, h, errors = list[_Prepared](), self._x, self._x_errors
        for i, layer in enumerate(layers):
            H, K = layer.W.shape
            y, new, slope = forms[i % 2][:H], numbers(H, 2), numbers(H)
            lo_hi, tanh = (v[: 2 * H].view(2, H, batch) for v in (ends, values))
            own = {"t": t[:H], "p": p[:H], "rounding": rounding[:H]}
            sums = (self._size, self._fresh, self._ball)
            known = (layer.bias, layer.bias_error, layer.rows, through[:H], *sums)
            first = (*_arrays(y, *known), layer.norm, K, *_arrays(lo_hi, whole[:H], rounding[:H], spread[:H]))
            given = _arrays(y, lo_hi, tanh, slope, t[:H], p[:H])
            share = self._share if i == 0 else self._share[:0]
            last = (*given, K, *_arrays(whole[:H], rounding[:H], spread[:H], new, *sums, share))
            self._layers.append(
                _Prepared(
                    layer, h.view(K, -1), errors.view(K, -1), y.view(H, -1), through[:H].view(H, -1), lo_hi, tanh,
                    **own, error=new, slope=slope, ranges=first, chords=_arrays(lo_hi, tanh, slope, t[:H]), bend=last,
                )
            )  # fmt: skip
            h, errors = y, new
        self._form = h
        self._weights = [weights[i % 2] for i in range(len(layers) + 1)]
        self._result = numbers(m)

    def __call__(self, x: Tensor, x_error: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The affine form (m, n + 1, B) behind the last layer, the scaled error (m, B) and `share` (n, B)."""
        k = self.kernels
        self._x.copy_(x)
        self._x_errors[:, 0], self._x_errors[:, 1] = x_error, 0.0
        torch.sum(x.abs().sum(1).square(), 0, out=self._size)
        torch.sum(x_error.square(), 0, out=self._fresh)
        self._ball.zero_()
        self._share.zero_()
        for at, each in enumerate(self._layers):
            torch.mm(each.layer.W, each.h, out=each.y)
            torch.mm(each.layer.magnitude, each.errors, out=each.through)
            k.ranges(*each.ranges)
            if at == len(self._layers) - 1 and not self.squash:
                each.error[:, 0] = each.rounding
                each.slope.fill_(1.0)
                break
            torch.tanh(each.ends, out=each.values)
            k.chords(*each.chords)
            torch.atanh(each.t, out=each.p)
            k.bend(*each.bend)
        share = self._share + k.TINY
        return self._form.clone(), self._error_backwards(x_error), share / share.sum(0)

    def _error_backwards(self, x_error: Tensor) -> Tensor:
        """What all errors on the way add to the outputs (m, B), by the magnitudes of their weights."""
        self._result.zero_()
        self._weights[0][: len(self.scale)] = torch.diag(self.scale)[:, :, None]
        for each, weight, on in zip(reversed(self._layers), self._weights, self._weights[1:], strict=False):
            H, K = each.layer.W.shape
            self.kernels.backwards(*_arrays(weight[:H], each.error, each.slope, self._result))
            torch.mm(each.layer.W.T, weight[:H].view(H, -1), out=on[:K].view(K, -1))
        return self._result + (on[: len(x_error)].abs() * x_error[:, None]).sum(0)


def _arrays(*tensors: Tensor) -> tuple[Any, ...]:
    return tuple(v.numpy() for v in tensors)
