"""Layers of tanhs on leaves, between affine forms: the policy before its squash, and a network N.

The weights meet several leaves at a time: a layer is one product of matrices of balls whose columns are the centres and
the half-widths of all leaves of a batch. What is left to Python is a few operations for each tanh of each leaf.
"""

from __future__ import annotations

from collections.abc import Sequence

from flint import arb, arb_mat

from .balls import ONE, ZERO, absolute, columns_scaled, total, weights
from .layers import Layer

Affine = tuple[arb, list[arb], arb]  # mid + slopes.d within an error


class Network:
    """Layers with tanh between them."""

    def __init__(self, layers: Sequence[Layer]) -> None:
        self.layers, self.weights = layers, weights(layers)
        self.absolute = [absolute(W) for W in self.weights]

    def outputs(self, forms: arb_mat, count: int) -> list[list[Affine]]:
        """For each output and each leaf, given x on the leaves: a column for its centre and one for each symbol.

        Each tanh lies in slope y + shift +- gap. The output sees the gaps through products of weights and slopes, taken
        backwards. The tanhs between see them through such products too, but with one slope for all leaves of the
        batch, that of its first, so that a product is shared; by what a leaf's own slope differs from it, the error of
        y goes into a `rest` that spreads by absolute weights. That takes far more leaves than absolute weights alone
        where there are three layers of tanhs or more.
        """
        last, stride = len(self.weights) - 1, forms.ncols() // count
        slopes, gaps = list[list[list[arb]]](), list[list[list[arb]]]()
        ways, spreads, rest = list[arb_mat](), list[arb_mat](), None
        for k, (W, layer) in enumerate(zip(self.weights, self.layers, strict=True)):
            preactivations = (W * forms).tolist()
            if k == last:
                break
            if k:  # the way of each earlier layer's gaps to this layer's y
                scaled = columns_scaled(W, [slope[0] for slope in slopes[-1]])
                ways = [*(scaled * way for way in ways), W]
            seen = arb_mat(layer.rows, count)
            for way, spread in zip(ways, spreads, strict=True):
                seen += absolute(way) * spread
            beyond = self.absolute[k] * rest if rest is not None else arb_mat(layer.rows, count)
            entries, left = [], []
            slopes.append([])
            gaps.append([])
            for row, bias, near, far in zip(
                preactivations, map(arb, layer.bias), seen.tolist(), beyond.tolist(), strict=True
            ):
                reached = [v + w for v, w in zip(near, far, strict=True)]
                each = zip(range(0, stride * count, stride), reached, strict=True)
                lined = [tanh((row[b] + bias, row[b + 1 : b + stride], error)) for b, error in each]
                entries += [v for (mid, slope, _), _, _ in lined for v in (mid, *slope)]
                own = [slope for _, slope, _ in lined]
                left += [abs(s - own[0]) * v + s * w for s, v, w in zip(own, near, far, strict=True)]
                slopes[k].append(own)
                gaps[k].append([gap for _, _, gap in lined])
            spreads.append(arb_mat(gaps[k]))
            forms, rest = arb_mat(layer.rows, len(row), entries), arb_mat(layer.rows, count, left)
        behind = self.backwards(slopes, gaps, count)
        result = []
        for row, errors, bias in zip(preactivations, behind, map(arb, self.layers[last].bias), strict=True):
            places = zip(range(0, stride * count, stride), errors, strict=True)
            result.append([(row[b] + bias, row[b + 1 : b + stride], error) for b, error in places])
        return result

    def backwards(self, slopes: list[list[list[arb]]], gaps: list[list[list[arb]]], count: int) -> list[list[arb]]:
        """The error of each output on each leaf: each gap times the magnitude of its way to the output."""
        m, last = self.layers[-1].rows, len(self.weights) - 1
        errors = [[ZERO] * count for _ in range(m)]
        ways = [[w for w in column for _ in range(count)] for column in zip(*self.weights[last].tolist(), strict=True)]
        for k in reversed(range(last)):  # ways[i] is from tanh i of layer k to output 0 on all leaves, to output 1, ...
            for way, gap in zip(ways, gaps[k], strict=True):
                for j in range(m):
                    errors[j] = [
                        e + abs(w) * g for e, w, g in zip(errors[j], way[j * count : (j + 1) * count], gap, strict=True)
                    ]
            if k:
                scaled = [
                    w * s
                    for way, slope in zip(ways, slopes[k], strict=True)
                    for w, s in zip(way, slope * m, strict=True)
                ]
                ways = (self.weights[k].transpose() * arb_mat(len(ways), m * count, scaled)).tolist()
        return errors


def tanh(y: Affine) -> tuple[Affine, arb, arb]:
    """The tanh of an affine form: an affine form, the slope of its two lines, and half the gap between them."""
    mid, coefficients, error = y
    reach = total(abs(v) for v in coefficients) + error
    slope, shift, gap = lines(arb((mid - reach).lower()), arb((mid + reach).upper()))
    return (slope * mid + shift, [slope * v for v in coefficients], slope * error + gap), slope, gap


def lines(lo: arb, hi: arb) -> tuple[arb, arb, arb]:
    """slope, shift, gap with |tanh(y) - slope y - shift| <= gap on [lo, hi]; the slope is near the chord's.

    The extrema of tanh(y) - slope y are at the ends or where tanh(y)^2 = 1 - slope; a point that may lie in [lo, hi]
    counts, and one that does not lie there can only make the gap too wide.
    """
    at_lo, at_hi = lo.tanh(), hi.tanh()
    slope = (((at_hi - at_lo) / (hi - lo)) if lo < hi else 1 - at_lo * at_lo).mid()
    slope = ONE if slope > 1 else slope if slope > 1e-30 else ZERO  # at 0 there is no critical point
    top, bottom = at_lo - slope * lo, at_hi - slope * hi
    top, bottom = top.max(bottom), top.min(bottom)
    if slope > 0:
        t = (1 - slope).sqrt()
        y = t.atanh()
        value = t - slope * y
        if not (y < lo or y > hi):
            top, bottom = top.max(value), bottom.min(value)
        if not (-y < lo or -y > hi):
            top, bottom = top.max(-value), bottom.min(-value)
    return slope, (top + bottom) / 2, (top - bottom) / 2


def clip(y: Affine, lo: arb, hi: arb) -> Affine:
    """min(max(y, lo), hi) of an affine form.

    It is y where y certainly lies between them. Else it lies between two lines of a slope from 0 to 1: clip(y) - slope
    y rises between lo and hi and falls elsewhere, so it is least and greatest at the ends of the range of y, at lo or
    at hi; a corner that is certain to lie outside of the range does not count.
    """
    mid, coefficients, error = y
    reach = total(abs(v) for v in coefficients) + error
    first, last = arb((mid - reach).lower()), arb((mid + reach).upper())
    if first >= lo and last <= hi:
        return y
    ends = first.max(lo).min(hi), last.max(lo).min(hi)
    slope = ((ends[1] - ends[0]) / (last - first)).mid() if first < last else ZERO
    slope = ZERO if slope < 0 else ONE if slope > 1 else slope
    away = [ends[0] - slope * first, ends[1] - slope * last]
    away += [(1 - slope) * corner for corner in (lo, hi) if not (corner < first or corner > last)]
    top = bottom = away[0]
    for v in away[1:]:
        top, bottom = top.max(v), bottom.min(v)
    shift, gap = (top + bottom) / 2, (top - bottom) / 2
    return slope * mid + shift, [slope * v for v in coefficients], slope * error + gap
