"""N of a claim that goes beyond {V <= c2}, and how it changes along F, in models on a box.

A network's layers are products of matrices: a row for each model, its coefficients behind each other, its remainder by
the magnitudes of the weights. An expression is a series in time of which two coefficients are asked. Where a box is
wide, the tanhs of a network are far from their tangents, and lie better between two lines.
"""

from __future__ import annotations

from collections.abc import Sequence

from flint import arb, arb_mat

from .affine import Network
from .balls import ZERO, total
from .document import Function
from .flow import constant
from .layers import Layer
from .series import along
from .taylor import Taylor


class Models:
    """The function of a claim on as many boxes as are asked for, given the models of the states there."""

    def __init__(self, N: Function, states: tuple[str, ...]) -> None:
        self.N, self.states, self.level = N, states, arb(N.level)
        self.network = Network(N.layers)

    def value(self, x: Sequence[Taylor]) -> Taylor:
        """N, or a refusal where it may be undefined."""
        if self.N.expression is not None:
            value: Taylor = self.N.expression.evaluate(dict(zip(self.states, x, strict=True)), constant)[0]
            return value
        for k, layer in enumerate(self.N.layers):
            x = self.affine(k, layer, [a.function("tanh") for a in x] if k else x)
        return x[0]

    def is_above(self, x: Sequence[Taylor]) -> bool:
        """True if N is certainly defined, and above its level, on all of the box; x without remainders."""
        N = self.value(x)
        if N.is_finite() and bool(-(-N).bound() > self.level):
            return True
        return self.N.expression is None and self.is_above_by_lines(x)

    def is_above_by_lines(self, x: Sequence[Taylor]) -> bool:
        """The same of a network by the least value of its affine form."""
        symbols = max(v.symbols for v in x)
        forms = arb_mat([[v.c, *entries(v.g, symbols)] for v in x])
        (((mid, slopes, error),),) = self.network.outputs(forms, 1)
        least = mid - total(abs(v) for v in slopes) - error
        return bool(least.is_finite()) and bool(least > self.level)

    def moving(self, x: Sequence[Taylor], F: Sequence[Taylor]) -> tuple[Taylor, Taylor]:
        """N and N'F, or a refusal where N may be undefined."""
        if self.N.expression is not None:
            states, rates = dict(zip(self.states, x, strict=True)), dict(zip(self.states, F, strict=True))
            ((value, rate),) = along(self.N.expression, states, rates, constant)
            return value, Taylor(ZERO) if rate is None else rate
        y = F
        for k, (layer, W) in enumerate(zip(self.N.layers, self.network.weights, strict=True)):
            if k:
                y = [a.function("tanh'") * v for a, v in zip(x, y, strict=True)]
                x = [a.function("tanh") for a in x]
            x, y = self.affine(k, layer, x), mapped(W, self.network.absolute[k], y)
        return x[0], y[0]

    def affine(self, k: int, layer: Layer, x: Sequence[Taylor]) -> list[Taylor]:
        """Layer k."""
        each = zip(mapped(self.network.weights[k], self.network.absolute[k], x), layer.bias, strict=True)
        return [v + Taylor(arb(b)) for v, b in each]


def mapped(W: arb_mat, magnitudes: arb_mat, x: Sequence[Taylor]) -> list[Taylor]:
    """W times a column of models."""
    symbols = max(v.symbols for v in x)
    square = symbols**2 if any(v.Q is not None for v in x) else 0
    rows = (W * arb_mat([[v.c, *entries(v.g, symbols), *entries(v.Q, square)] for v in x])).tolist()
    rest, end = (magnitudes * arb_mat([[v.r] for v in x])).entries(), 1 + symbols
    return [
        Taylor(
            row[0],
            arb_mat(1, symbols, row[1:end]) if symbols else None,
            arb_mat(symbols, symbols, row[end:]) if square else None,
            r,
        )
        for row, r in zip(rows, rest, strict=True)
    ]


def entries(part: arb_mat | None, count: int) -> list[arb]:
    return [ZERO] * count if part is None else list(part.entries())
