"""Layers of tanhs on leaves, between affine forms: the policy before its scale, and a network N.

The weights meet several leaves at a time: a layer is one product of matrices of balls whose columns are the centres and
the half-widths of all leaves of a batch, and one of magnitudes for their errors. What is left to Python is a few
operations for each tanh of each leaf.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

from flint import arb, arb_mat

from .balls import ONE, ZERO, absolute, norm, spectral_norm, total, weights
from .layers import Layer

Affine = tuple[arb, list[arb], arb]  # mid + slopes.d within an error
Rows = list[list[arb]]  # for each tanh of a layer a number for each leaf
COLUMNS, WIDE = 48, 64  # of a product; layers from this width on take more of them at once without loss


class Network:
    """Layers with tanh between them, and behind the last if `squashed`; `last_bias` may replace that of the last."""

    def __init__(self, layers: Sequence[Layer], squashed: bool = False, last_bias: list[arb] | None = None) -> None:
        self.layers, self.weights = layers, weights(layers)
        self.biases = [[arb(b) for b in layer.bias] for layer in layers]
        if last_bias is not None:
            self.biases[-1] = last_bias
        self.absolute = [absolute(W) for W in self.weights]
        self.tanhs = len(layers) if squashed else len(layers) - 1  # so many layers have tanhs behind them

    def batch(self, symbols: int) -> int:
        """The number of leaves that should meet the weights together."""
        narrow = max(layer.rows for layer in self.layers) < WIDE
        return max(1, (COLUMNS if narrow else 8 * COLUMNS) // (symbols + 1))

    @cached_property
    def lengths(self) -> list[list[arb]]:
        """The 2-norm of each row of each layer."""
        return [[norm(row) for row in W.tolist()] for W in self.weights]

    @cached_property
    def norms(self) -> list[arb]:
        return [spectral_norm(W) for W in self.weights]

    def outputs(self, forms: arb_mat, count: int) -> list[list[Affine]]:
        """The form of each output on each leaf, given x on the leaves: a column for its centre and one for each symbol.

        Each tanh lies in slope y + shift +- gap on the range of its y, which is that of the form and of the errors
        before it. The outputs see each gap through the product of weights and slopes on its way to them.
        """
        stride = forms.ncols() // count
        slopes, gaps, errors = list[Rows](), list[Rows](), Errors.none(count)
        for k in range(self.tanhs):
            rows, steep, apart = list[list[arb]](), Rows(), Rows()
            behind = errors.behind(self, k)
            for row, bias, each in zip((self.weights[k] * forms).tolist(), self.biases[k], behind, strict=True):
                entries, s, g = relaxed(row, bias, each, stride)
                rows.append(entries)
                steep.append(s)
                apart.append(g)
            errors = errors.passed(self, k, behind, steep, apart)
            forms = arb_mat(rows)
            slopes.append(steep)
            gaps.append(apart)
        rows = forms.tolist()
        if self.tanhs < len(self.weights):
            rows = (self.weights[-1] * forms).tolist()
            for row, bias in zip(rows, self.biases[-1], strict=True):
                row[::stride] = [v + bias for v in row[::stride]]
        places = range(0, stride * count, stride)
        return [
            [(row[b], row[b + 1 : b + stride], error) for b, error in zip(places, own, strict=True)]
            for row, own in zip(rows, self.backwards(slopes, gaps, count), strict=True)
        ]

    def backwards(self, slopes: list[Rows], gaps: list[Rows], count: int) -> Rows:
        """The error of each output on each leaf: each gap times the magnitude of its way to the output."""
        m = self.layers[-1].rows
        errors = [[ZERO] * count for _ in range(m)]
        last = [[ONE if i == j else ZERO for j in range(m)] for i in range(m)]
        if self.tanhs < len(self.weights):
            last = self.weights[-1].transpose().tolist()
        ways = [[w for w in row for _ in range(count)] for row in last]
        for k in reversed(range(self.tanhs)):  # ways[i] is from tanh i of layer k to output 0 on all leaves, to 1, ...
            for way, gap in zip(ways, gaps[k], strict=True):
                for j in range(m):
                    part = way[j * count : (j + 1) * count]
                    errors[j] = [e + abs(w) * g for e, w, g in zip(errors[j], part, gap, strict=True)]
            if k:
                scaled = [
                    [w * s for w, s in zip(way, steep * m, strict=True)]
                    for way, steep in zip(ways, slopes[k], strict=True)
                ]
                ways = (self.weights[k].transpose() * arb_mat(scaled)).tolist()
        return errors


class Errors:
    """Bounds of what the values in front of a layer differ from their forms by, on each leaf.

    `fresh` is by the gaps of the tanhs just before, `old` by what came through these; `length` bounds the 2-norm of all
    that is old.
    """

    def __init__(self, fresh: Rows, old: Rows, length: list[arb]) -> None:
        self.fresh, self.old, self.length = fresh, old, length

    @classmethod
    def none(cls, count: int) -> Errors:
        return cls([], [], [ZERO] * count)

    def behind(self, network: Network, k: int) -> Rows:
        """The errors behind layer k's weights, old ones through magnitudes or the norm of a row, whichever is less."""
        rows, count = network.layers[k].rows, len(self.length)
        if not self.fresh:
            return [[ZERO] * count] * rows
        if not self.old:
            through: Rows = (network.absolute[k] * arb_mat(self.fresh)).tolist()
            return through
        both = (network.absolute[k] * arb_mat([f + o for f, o in zip(self.fresh, self.old, strict=True)])).tolist()
        return [
            [f + lesser(o, length * v) for f, o, v in zip(row[:count], row[count:], self.length, strict=True)]
            for row, length in zip(both, network.lengths[k], strict=True)
        ]

    def passed(self, network: Network, k: int, behind: Rows, slopes: Rows, gaps: Rows) -> Errors:
        """The errors behind the tanhs of layer k."""
        if not self.fresh:
            return Errors(gaps, [], self.length)
        old = [[s * e for s, e in zip(*both, strict=True)] for both in zip(slopes, behind, strict=True)]
        if k + 1 == network.tanhs:
            return Errors(gaps, old, self.length)
        length = []
        leaves = zip(self.length, by_leaf(self.fresh), by_leaf(slopes), by_leaf(old), strict=True)
        for before, fresh, steep, after in leaves:
            through = network.norms[k] * (before + norm(fresh))
            length.append(lesser(max_of(steep) * through, norm(after)))
        return Errors(gaps, old, length)


def by_leaf(rows: Rows) -> Rows:
    return [list(column) for column in zip(*rows, strict=True)]


def lesser(a: arb, b: arb) -> arb:
    """One of two bounds, the lesser if that is certain."""
    return a if a < b else b


def max_of(values: Sequence[arb]) -> arb:
    """A number at or above all of them."""
    result = values[0]
    for v in values[1:]:
        if not v <= result:
            result = v if v >= result else result.max(v)
    return arb(result.upper())


def relaxed(row: list[arb], bias: arb, errors: list[arb], stride: int) -> tuple[list[arb], list[arb], list[arb]]:
    """The forms of a tanh on all leaves, given those of its y without the bias; the lines' slopes, and their gaps."""
    entries, slopes, gaps = list[arb](), list[arb](), list[arb]()
    for b, error in enumerate(errors):
        middle, *coefficients = row[b * stride : (b + 1) * stride]
        middle += bias
        reach = sum(map(abs, coefficients), error)
        slope, shift, gap = lines(middle - reach, middle + reach)
        entries.append(slope * middle + shift)
        entries += [slope * v for v in coefficients]
        slopes.append(slope)
        gaps.append(gap)
    return entries, slopes, gaps


def lines(lo: arb, hi: arb) -> tuple[arb, arb, arb]:
    """slope, shift, gap with |tanh(y) - slope y - shift| <= gap on [lo, hi]; the slope is near the chord's.

    The extrema of tanh(y) - slope y are at the ends or where tanh(y)^2 = 1 - slope; a point that may lie in [lo, hi]
    counts, and one that does not lie there can only make the gap too wide. A ball for an end holds the end.
    """
    at_lo, at_hi = lo.tanh(), hi.tanh()
    slope = ((at_hi - at_lo) / (hi - lo)).mid()
    if not (slope > 0 and slope < 1):
        on_a_point = not slope.is_finite()  # where there is no chord
        slope = (1 - at_lo * at_lo).mid() if on_a_point else ONE if slope > 0 else ZERO
    first, last = at_lo - slope * lo, at_hi - slope * hi
    top, bottom = (last, first) if first < last else (first, last) if last < first else (first.union(last),) * 2
    if slope > 0:
        t = (1 - slope).sqrt()
        y = t.atanh() if slope > 1e-9 else ((1 + t) / slope.sqrt()).log()  # of t near 1 it asks for 1 - t
        value = t - slope * y
        if not (y < lo or y > hi):
            top, bottom = value if value > top else top.max(value), bottom if bottom < value else bottom.min(value)
        if not (-y < lo or -y > hi):
            top, bottom = top if top > -value else top.max(-value), -value if -value < bottom else bottom.min(-value)
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
