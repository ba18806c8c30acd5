"""The layers of a policy on boxes, as `policy.py` describes them: products of matrices, and the loops between them.

Boxes are few enough that what passes from layer to layer stays in a core's cache, in memory that is there already:
fresh pages of the system cost as much as a product. They are always as many, because a product rounds as its width has
it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from certify.provers.bounds.arrays import Array
from certify.provers.bounds.compiled import Loops
from certify.provers.bounds.lines import LINES


@dataclass(frozen=True, slots=True)
class Layer:
    """W (H, K) and |W|, the bias and its error (H,), the 2-norms of the rows (H,), and that of W."""

    W: Array
    magnitude: Array
    bias: Array
    bias_error: Array
    rows: Array
    norm: float


@dataclass(frozen=True, slots=True)
class _Prepared:
    """A layer with the memory that it works in.

    `h` and `errors` come in as matrices (K, ...), `y` and `through` are what W and |W| make of them. `error`, the fresh
    errors and the older ones (H, 2, B), and `slope` (H, B) enter the backward pass. `ranges`, `chords`, `relax`
    and `bend` are the arguments of these kernels; `relax` leaves the lines' shifts in t, their gaps in p.
    """

    layer: Layer
    h: Array
    errors: Array
    y: Array
    through: Array
    ends: Array
    values: Array
    t: Array
    p: Array
    rounding: Array
    error: Array
    slope: Array
    ranges: tuple[Any, ...]
    chords: tuple[Any, ...]
    relax: tuple[Any, ...]
    bend: tuple[Any, ...]


class FusedLayers:
    """Bounds of layers with a function between them, and tanh behind the last if `squash`, on `batch` boxes at a time.

    Parameters
    ----------
    n : box coordinates.
    scale : of the outputs (m,), by which errors are weighed.
    activation : the function's name.
    """

    def __init__(
        self, layers: Sequence[Layer], n: int, squash: bool, scale: Array, batch: int, activation: str = "tanh"
    ) -> None:
        self.squash, self.scale, self.batch, self.around = squash, scale, batch, LINES.get(activation)
        reads, m = layers[0].W.shape[1], len(scale)
        units = max(len(layer.W) for layer in layers)
        widest = max(reads, units)

        def numbers(*shape: int) -> Array:
            return np.empty((*shape, batch))

        self._x, self._x_errors = numbers(reads, n + 1), numbers(reads, 2)
        self._size, self._fresh, self._ball, self._share = numbers(), numbers(), numbers(), numbers(n)
        forms, weights = [numbers(units, n + 1) for _ in range(2)], [numbers(widest, m) for _ in range(2)]
        through, ends, values = numbers(units, 2), numbers(2 * units), numbers(2 * units)
        t, p, whole, rounding, spread = (numbers(units) for _ in range(5))
        self._layers, h, errors = list[_Prepared](), self._x, self._x_errors
        for i, layer in enumerate(layers):
            H, K = layer.W.shape
            y, new, slope = forms[i % 2][:H], numbers(H, 2), numbers(H)
            lo_hi, tanh = (v[: 2 * H].reshape(2, H, batch) for v in (ends, values))
            own = {"t": t[:H], "p": p[:H], "rounding": rounding[:H]}
            sums = (self._size, self._fresh, self._ball)
            known = (layer.bias, layer.bias_error, layer.rows, through[:H], *sums)
            first = (y, *known, layer.norm, K, lo_hi, whole[:H], rounding[:H], spread[:H])
            given = (lo_hi, tanh, slope, t[:H], p[:H])
            share = self._share if i == 0 else self._share[:0]
            last = (y, *given[2:], K, whole[:H], rounding[:H], spread[:H], new, *sums, share)
            self._layers.append(
                _Prepared(
                    layer, h.reshape(K, -1), errors.reshape(K, -1), y.reshape(H, -1), through[:H].reshape(H, -1), lo_hi,
                    tanh, **own, error=new, slope=slope, ranges=first, chords=given[:-1], relax=(*given, y),
                    bend=last,
                )
            )  # fmt: skip
            h, errors = y, new
        self._form = h
        self._weights = [weights[i % 2] for i in range(len(layers) + 1)]
        self._result = numbers(m)

    def __call__(self, loops: Loops, x: Array, x_error: Array) -> tuple[Array, Array, Array, Array]:
        """The affine form (m, n + 1, B) behind the last layer, the scaled error (m, B), what each axis adds to the
        bends of the first layer, (n, B), and the ends between which the last layer lies, squashed, (2, m, B); x is
        (reads, n + 1, B), its error (reads, B)."""
        self._x[:] = x
        self._x_errors[:, 0], self._x_errors[:, 1] = x_error, 0.0
        np.square(np.abs(x).sum(1)).sum(0, out=self._size)
        np.square(x_error).sum(0, out=self._fresh)
        self._ball[:], self._share[:] = 0.0, 0.0
        for at, each in enumerate(self._layers):
            np.matmul(each.layer.W, each.h, out=each.y)
            np.matmul(each.layer.magnitude, each.errors, out=each.through)
            loops.ranges(*each.ranges)
            if at == len(self._layers) - 1 and not self.squash:
                each.error[:, 0] = each.rounding
                each.slope[:] = 1.0
                break
            if self.around is None or at == len(self._layers) - 1:
                np.tanh(each.ends, out=each.values)
                loops.chords(*each.chords)
                np.arctanh(each.t, out=each.p)
                loops.relax(*each.relax)
            else:
                each.slope[:], each.t[:], each.p[:] = self.around(*each.ends)
            loops.bend(*each.bend)
        ends = (each.values if self.squash else each.ends).copy()
        return self._form.copy(), self._error_backwards(loops, x_error), self._share.copy(), ends

    def _error_backwards(self, loops: Loops, x_error: Array) -> Array:
        """The sum of all errors on the way in the outputs (m, B), by the magnitudes of their weights."""
        self._result[:] = 0.0
        self._weights[0][: len(self.scale)] = np.diag(self.scale)[:, :, None]
        for each, weight, on in zip(reversed(self._layers), self._weights, self._weights[1:], strict=False):
            H, K = each.layer.W.shape
            loops.backwards(weight[:H], each.error, each.slope, self._result)
            np.matmul(each.layer.W.T, weight[:H].reshape(H, -1), out=on[:K].reshape(K, -1))
        result: Array = self._result + (np.abs(on[: len(x_error)]) * x_error[:, None]).sum(0)
        return result
