"""Networks in torch with numbers that are trained: their values, and on boxes what a bound adds to an affine form.

A bound of the policy on a box replaces each unit by a line and an error, and adds the errors up by the magnitudes of
their weights towards the inputs. `Forms` has these errors in the smooth form that a gradient needs, for networks of
any steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce

import torch
from torch import Tensor

from certify.loop.networks import Affine, Algebra, Clip, Concat, Map, Network, Observe, Product, Sum, Values, evaluated
from controllers.training.units import Units

Form = tuple[Tensor, Tensor]  # values (B, width) at the centres, and their changes along k half-axes, (B, k, width)
_CUBIC = 0.3849  # largest distance of t^3 from t on [0, 1]: of a cubic from its chord, by its own change


class Numbers:
    """The numbers of a network's layers as tensors, in the layers' order."""

    def __init__(self, network: Network, weights: Sequence[Tensor], biases: Sequence[Tensor]) -> None:
        self.network = network
        self._of = dict(zip(network.affine, zip(weights, biases, strict=True), strict=True))
        self._units = {name: Units(name) for name in network.functions}

    def layer(self, step: Affine, v: Tensor) -> Tensor:
        """`v W' + b` of rows v."""
        weight, bias = self._of[step]
        return torch.addmm(bias, v, weight.T)

    def weight(self, step: Affine) -> Tensor:
        return self._of[step][0]

    def units(self, step: Map) -> Units:
        return self._units[step.function]


class TrainedValues(Values):
    """Values of states (B, n) by these numbers."""

    def __init__(self, numbers: Numbers) -> None:
        self.numbers = numbers

    def affine(self, step: Affine, v: Tensor) -> Tensor:
        return self.numbers.layer(step, v)

    def map(self, step: Map, v: Tensor) -> Tensor:
        return self.numbers.units(step)(v)

    def __call__(self, x: Tensor) -> Tensor:
        """The network's value (B, gives)."""
        value: Tensor = self.run(self.numbers.network, x)
        return value


class Forms(Algebra[Form]):
    """Affine forms on boxes, with the errors that units and products add; all of it can be differentiated.

    A unit with the values y +- v has its second difference over 4 for the error of two parallel lines around a
    parabola, and 0.385 times its third-order change for those around a cubic.
    """

    def __init__(self, numbers: Numbers) -> None:
        self.numbers = numbers
        self._sources: list[tuple[Tensor, Tensor]] = []  # a zero (B, width) that is added to a vector, and its error

    @property
    def bends(self) -> bool:
        """True once anything has an error."""
        return bool(self._sources)

    def squashed(self, form: Form, units: Units) -> Form:
        """A function of each entry."""
        y, J = form
        v, (h, slope) = J.abs().sum(1), units.pair(y)
        above, below = units(y + v), units(y - v)
        even, odd = (above + below - 2 * h).abs() / 4, ((above - below) / 2 - slope * v).abs()
        return self._with_error(h, even + _CUBIC * odd), slope[:, None] * J

    def errors(self, value: Tensor) -> Tensor:
        """The sums (B, m) of all errors in the entries of value (B, m), which follows from the forms so far."""
        zeros, sizes = zip(*self._sources, strict=True)
        found = []
        for j in range(value.shape[1]):
            gains = torch.autograd.grad(value[:, j].sum(), zeros, create_graph=True)
            found.append(sum(((g.abs() * e).sum(1) for g, e in zip(gains, sizes, strict=True)), value.new_zeros(())))
        return torch.stack(found, 1)

    def _with_error(self, value: Tensor, error: Tensor) -> Tensor:
        zero = torch.zeros_like(value, requires_grad=True)
        self._sources.append((zero, error))
        return value + zero

    def affine(self, step: Affine, v: Form) -> Form:
        return self.numbers.layer(step, v[0]), v[1] @ self.numbers.weight(step).T

    def map(self, step: Map, v: Form) -> Form:
        return self.squashed(v, self.numbers.units(step))

    def clip(self, step: Clip, v: Form) -> Form:
        lo, hi = (torch.as_tensor(end, dtype=v[0].dtype) for end in (step.lo, step.hi))
        return v[0].clamp(lo, hi), torch.where(((v[0] > lo) & (v[0] < hi))[:, None], v[1], 0.0)

    def sum(self, step: Sum, *vectors: Form) -> Form:
        return reduce(lambda a, b: (a[0] + b[0], a[1] + b[1]), vectors)

    def concat(self, step: Concat, *vectors: Form) -> Form:
        return torch.cat([v[0] for v in vectors], -1), torch.cat([v[1] for v in vectors], -1)

    def product(self, step: Product, v: Form, w: Form) -> Form:
        error = v[1].abs().sum(1) * w[1].abs().sum(1)
        return self._with_error(v[0] * w[0], error), v[0][:, None] * w[1] + w[0][:, None] * v[1]

    def observe(self, step: Observe, v: Form) -> Form:
        flat = evaluated(step.slopes, step.symbols, v[0])
        slopes = flat.reshape(len(flat), len(step.expressions), len(step.symbols))
        return evaluated(step.expressions, step.symbols, v[0]), v[1] @ slopes.transpose(1, 2)
