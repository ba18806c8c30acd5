"""A policy in binary32: its numbers, and on a box of states the errors of its operations (see `float32.py`)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import flint
import numpy as np
from numpy.typing import NDArray

from certify.errors import InputError, OptionError
from certify.loop.activations import ACTIVATIONS, Activation
from certify.loop.closed_loop import ClosedLoop
from certify.loop.rigorous import Balls, ball, centring_with_errors, rounded_up

Array = NDArray[np.float64]
Box = tuple[tuple[Fraction, Fraction], ...]

_DIGITS = 24  # of binary32
_UNIT = Fraction(1, 2**_DIGITS)
_NORMAL = Fraction(1, 2**126)  # below it binary32 numbers lose digits, or are taken for 0
_TINY = Fraction(1, 2**120)  # more than the few times 2^-126 that results and operands of one operation may lose there
_LARGEST = Fraction(2**127)  # a factor of 2 below overflow
_SQUARINGS = 4  # of W'W, in the bound of its largest eigenvalue


@dataclass(frozen=True, slots=True)
class Errors:
    """Bounds of the errors on a box by their source, each (m,), in their order."""

    parts: dict[str, Balls]

    def total(self, j: int) -> flint.arb:
        """Their sum for an input."""
        return sum((errors[j] for errors in self.parts.values()), flint.arb(0))


@dataclass(frozen=True, slots=True)
class _Layer:
    """A layer's numbers, exact, and their errors in binary32.

    `weight`, `magnitude` (out, in); `bias` (out,) with what centring adds; `bias_size` bounds the magnitudes of the
    terms that a program may keep it in. `growth` is sums' error relative to their terms' magnitudes. `norm` bounds
    ||weight||_2, `columns` (in,) the norms of its columns.
    """

    weight: flint.arb_mat
    magnitude: flint.arb_mat
    weight_error: flint.arb_mat
    bias: Balls
    bias_size: Balls
    bias_error: Balls
    growth: flint.arb
    lost: flint.arb
    norm: flint.arb
    columns: Balls


@dataclass(frozen=True, slots=True)
class _Step:
    """A layer's own errors on a box: of its numbers and sums before the function, (out,), and of the function itself,
    with its name and the slopes through which errors pass; None without a function."""

    numbers: Balls
    sums: Balls
    name: str
    fresh: Balls | None
    slopes: Balls | None


@dataclass(frozen=True, slots=True)
class Machine:
    """The policy with its numbers in binary32; `reach` (n,) weighs the states for cuts."""

    layers: tuple[_Layer, ...]
    squash: bool
    scale: Balls
    scale_error: Balls
    offset_size: Balls
    offset_error: Balls
    clip_errors: tuple[tuple[float, float], ...]
    tanh_ulp: flint.arb
    phi: Activation
    reach: tuple[float, ...]

    @property
    def m(self) -> int:
        """Number of inputs."""
        return len(self.scale)

    @property
    def weights(self) -> int:
        """Number of weights."""
        return sum(layer.weight.nrows() * layer.weight.ncols() for layer in self.layers)

    @classmethod
    def of(cls, loop: ClosedLoop, tanh_ulp: float, chain: int | None) -> Machine:
        """The machine of a closed loop's policy; `tanh_ulp` and `chain` are those of `FloatOptions`.

        Raises
        ------
        InputError : a number overflows, or no sum has chains as short as asked for.
        """
        network = loop.network
        shift, shift_error, offset, offset_error = centring_with_errors(loop)
        layers = []
        for k, (W, b) in enumerate(zip(network.weights, network.biases, strict=True)):
            bias, size, error = _points(b), _points(np.abs(b)), _rounding(b, f"bias {k}")
            terms = W.shape[1] + 1
            if k == len(network.weights) - 1 and network.centre == "preactivation":
                # kept as a number of its own or put into the bias: what covers the one covers the other
                added = [flint.arb(float(s), float(e)) for s, e in zip(shift, shift_error, strict=True)]
                bias = [v + s for v, s in zip(bias, added, strict=True)]
                size = [v + s.abs_upper() for v, s in zip(size, added, strict=True)]
                error = [v + 4 * ball(_UNIT) * s + ball(_TINY) for v, s in zip(error, size, strict=True)]
                terms += 1
            layers.append(_layer(W, bias, size, error, _growth(terms, chain), terms, k))
        scale_error = _rounding(network.scale, "scale")
        if network.centre == "output":
            reals = [flint.arb(float(o), float(e)) for o, e in zip(offset, offset_error, strict=True)]
            offset_size = [v.abs_upper() for v in reals]
            error_of_offset = [2 * ball(_UNIT) * v + ball(_TINY) for v in offset_size]
        else:
            offset_size = _points(np.abs(network.offset))
            error_of_offset = _rounding(network.offset, "offset")
        clip: list[list[float]] = []
        if network.clip is not None:
            clip = [[rounded_up(e) for e in _rounding(end, "clip")] for end in network.clip]
        return cls(
            layers=tuple(layers),
            squash=network.squash == "tanh",
            scale=_points(network.scale),
            scale_error=scale_error,
            offset_size=offset_size,
            offset_error=error_of_offset,
            clip_errors=tuple(zip(*clip, strict=True)),
            tanh_ulp=flint.arb(float(tanh_ulp)),
            phi=ACTIVATIONS[network.activation],
            reach=tuple(np.abs(network.weights[0]).sum(axis=0).tolist()),
        )

    def errors(self, box: Box) -> Errors:
        """Bounds of the errors for all states of a box.

        Raises
        ------
        InputError : a sum may overflow in binary32.
        """
        steps, entering, output = self._forward(box)
        return self._backward(steps, entering, output)

    def _forward(self, box: Box) -> tuple[list[_Step], Balls, Balls]:
        """The layers' steps, the errors of the state itself, (n,), and those of the output map, (m,)."""
        x = [ball(lo).union(ball(hi)) for lo, hi in box]
        middle = [v.mid() for v in x]
        away = [v - c for v, c in zip(x, middle, strict=True)]
        n = len(x)
        J = flint.arb_mat([[int(i == j) for j in range(n)] for i in range(n)])
        for v in x:
            _require_finite(v.abs_upper(), "a state")
        entering = [ball(_UNIT) * v.abs_upper() + ball(_TINY) for v in x]
        h, error, steps = x, entering, []
        for k, layer in enumerate(self.layers):
            size = [v.abs_upper() + e for v, e in zip(h, error, strict=True)]
            off = _times(layer.weight_error, size)
            terms = [p + q + b for p, q, b in zip(_times(layer.magnitude, size), off, layer.bias_size, strict=True)]
            terms = [t + e for t, e in zip(terms, layer.bias_error, strict=True)]
            numbers = [v + e for v, e in zip(off, layer.bias_error, strict=True)]
            sums = [layer.growth * t + layer.lost for t in terms]
            for t, s in zip(terms, sums, strict=True):
                _require_finite(t + s, f"a sum in layer {k}")
            error = [e + v + s for e, v, s in zip(_times(layer.magnitude, error), numbers, sums, strict=True)]
            J = layer.weight * J
            natural = [v + b for v, b in zip(_times(layer.weight, h), layer.bias, strict=True)]
            middle = [v + b for v, b in zip(_times(layer.weight, middle), layer.bias, strict=True)]
            y = [
                v.intersection(c + d)  # the range by its own terms, and by its derivatives
                for v, c, d in zip(natural, middle, _times(J, away), strict=True)
            ]
            if k == len(self.layers) - 1 and not self.squash:
                steps.append(_Step(numbers, sums, "", None, None))
                h = y
                break
            phi = self.phi if k < len(self.layers) - 1 else ACTIVATIONS["tanh"]
            wide = [v + flint.arb(0, e) for v, e in zip(y, error, strict=True)]
            slopes = [_slope(phi, v) for v in wide]
            fresh = [_fresh(phi, v, self.tanh_ulp) for v in wide]
            steps.append(_Step(numbers, sums, phi.name, fresh, slopes))
            over = [_slope(phi, v) for v in y]
            h, middle = [_value(phi, v) for v in y], [phi.in_arb(v) for v in middle]
            J = flint.arb_mat([[s * J[i, j] for j in range(n)] for i, s in enumerate(over)])
            error = [s.abs_upper() * e + f for s, e, f in zip(slopes, error, fresh, strict=True)]
        return steps, entering, self._output([v.abs_upper() + e for v, e in zip(h, error, strict=True)])

    def _output(self, size: Balls) -> Balls:
        """Errors of `scale * . + offset` on values of these magnitudes, (m,)."""
        twice, once, found = _growth(2, None), ball(_UNIT), []
        for j, q in enumerate(size):
            product = (self.scale[j].abs_upper() + self.scale_error[j]) * q
            constant = self.offset_size[j] + self.offset_error[j]
            rounding = twice * product + once * constant + 4 * ball(_TINY)
            _require_finite(product + constant + rounding, "the output")
            found.append(self.scale_error[j] * q + self.offset_error[j] + rounding)
        return found

    def _backward(self, steps: Sequence[_Step], entering: Balls, output: Balls) -> Errors:
        """Carry the errors of each step to the output."""
        m, found = self.m, dict[str, Balls]()
        rows = _Rows(
            flint.arb_mat([[self.scale[j] if i == j else 0 for j in range(m)] for i in range(m)]),
            flint.arb_mat(m, m),
            [flint.arb(0)] * m,
        )
        for k in reversed(range(len(steps))):
            step, layer = steps[k], self.layers[k]
            if step.fresh is not None and step.slopes is not None:
                found[f"layer {k}, {step.name}"] = rows.on(step.fresh)
                rows = rows.through_function(step.slopes)
            found[f"layer {k}, sums"] = rows.on(step.sums)
            found[f"layer {k}, rounded numbers"] = rows.on(step.numbers)
            rows = rows.through(layer)
        return Errors({"state": rows.on(entering)} | dict(reversed(found.items())) | {"output": output})


@dataclass(frozen=True, slots=True)
class _Rows:
    """Derivatives (m, k) of the output: `centre`, a real matrix in its balls, and a deviation.

    The deviation is at most `spread` (m, k) entry by entry, and its rows have at most the 2-norms `radius` (m,).
    """

    centre: flint.arb_mat
    spread: flint.arb_mat
    radius: Balls

    def on(self, errors: Balls) -> Balls:
        """A bound of the effect of errors (k,) at the output, (m,)."""
        length = _norm(errors)
        direct, added = _times(_magnitude(self.centre), errors), _times(self.spread, errors)
        return [(c + s.min(r * length)).upper() for c, s, r in zip(direct, added, self.radius, strict=True)]

    def through_function(self, slopes: Balls) -> _Rows:
        """The derivatives in front of a function, whose slopes are in these balls, (k,)."""
        m, columns = self.centre.nrows(), range(len(slopes))
        middles, radii = [s.mid() for s in slopes], [flint.arb(s.rad()).upper() for s in slopes]
        steepest = [s.abs_upper() for s in slopes]
        largest = max(steepest, key=float)
        fresh = [[self.centre[j, i].abs_upper() * radii[i] for i in columns] for j in range(m)]
        spread = [[self.spread[j, i] * steepest[i] + fresh[j][i] for i in columns] for j in range(m)]
        radius = [(r * largest + _norm(f)).min(_norm(s)) for r, f, s in zip(self.radius, fresh, spread, strict=True)]
        centre = flint.arb_mat([[self.centre[j, i] * middles[i] for i in columns] for j in range(m)])
        return _Rows(centre, flint.arb_mat(spread), radius)

    def through(self, layer: _Layer) -> _Rows:
        """The derivatives in front of an affine layer."""
        product, m = self.spread * layer.magnitude, self.centre.nrows()
        spread = [
            [product[j, i].min(self.radius[j] * column) for i, column in enumerate(layer.columns)] for j in range(m)
        ]
        radius = [(r * layer.norm).min(_norm(s)) for r, s in zip(self.radius, spread, strict=True)]
        return _Rows(self.centre * layer.weight, flint.arb_mat(spread), radius)


def _layer(W: Array, bias: Balls, size: Balls, error: Balls, growth: flint.arb, terms: int, k: int) -> _Layer:
    rows, columns = W.shape
    lost = 2 * terms * ball(_TINY) * (1 + growth)
    weight = flint.arb_mat([_points(row) for row in W])
    return _Layer(
        weight=weight,
        magnitude=flint.arb_mat([_points(row) for row in np.abs(W)]),
        weight_error=flint.arb_mat(rows, columns, _rounding(W.ravel(), f"weight {k}")),
        bias=bias,
        bias_size=size,
        bias_error=error,
        growth=growth,
        lost=lost,
        norm=_spectral_norm(weight),
        columns=[_norm(_points(column)) for column in W.T],
    )


def _growth(terms: int, chain: int | None) -> flint.arb:
    """(1 + u)^k - 1 of a sum of products and other terms: k one more than the additions that a product passes through.

    Raises
    ------
    InputError : no order of the additions has such short chains.
    """
    longest, shortest = terms - 1, (terms - 1).bit_length()
    if chain is not None and chain < shortest:
        raise OptionError(
            f"`chain` must be at least {shortest}: in a sum of {terms} terms some term passes through as many "
            f"additions, in whatever order; found {chain}."
        )
    additions = longest if chain is None else min(chain, longest)
    return (1 + ball(_UNIT)) ** (additions + 1) - 1


def _rounding(numbers: Array, what: str) -> Balls:
    """|fl(v) - v| of binary64 numbers, fl rounding to the nearest binary32 number, or to 0 if that is tiny.

    Raises
    ------
    InputError : one is too large for binary32.
    """
    if np.any(np.abs(numbers) >= float(_LARGEST)):
        raise InputError(
            f"{what} of the policy must lie below 2^127, or it may overflow in binary32; found "
            f"{float(np.max(np.abs(numbers))):.3g}."
        )
    with np.errstate(under="ignore"):
        single = numbers.astype(np.float32).astype(np.float64)
    lost = np.where(np.abs(single) < float(_NORMAL), np.abs(single), 0.0)
    return [
        (flint.arb(float(v)) - flint.arb(float(s))).abs_upper() + flint.arb(float(z))
        for v, s, z in zip(numbers, single, lost, strict=True)
    ]


def _require_finite(size: flint.arb, what: str) -> None:
    """Reject values that may overflow."""
    if not size < ball(_LARGEST):
        raise InputError(
            f"{what} must stay below 2^127, or it may overflow in binary32; found up to {float(size.upper()):.3g} on "
            "the domain. Make the domain smaller, or the policy's numbers."
        )


def _value(phi: Activation, y: flint.arb) -> flint.arb:
    """phi of a whole ball; tanh from its ends, since it rises: Arb's own is wide on wide balls."""
    return y.lower().tanh().union(y.upper().tanh()) if phi.name == "tanh" else phi.in_arb(y)


def _slope(phi: Activation, y: flint.arb) -> flint.arb:
    """The slopes of phi on a ball; those of tanh are 1 - t^2 at its values t."""
    if phi.name != "tanh":
        return phi.slope_in_arb(y)
    t = _value(phi, y)
    most, least = t.abs_upper(), t.abs_lower()
    return (1 - most * most).union(1 - least * least)


def _ulp(t: flint.arb, most: float = math.inf) -> flint.arb:
    """The unit in the last place of the largest binary32 number within t, of numbers below `most`, a power of two, in
    truth."""
    size = float(t.abs_upper())  # rounding does not lead below a power of two
    exponent = math.frexp(size)[1] if size else -149
    exponent = min(exponent, math.frexp(most)[1] - 1) if most < math.inf else exponent
    return flint.arb(2) ** max(exponent - _DIGITS, -149)


def _fresh(phi: Activation, y: flint.arb, units: flint.arb) -> flint.arb:
    """The error of phi itself, of so many units in the last place; relu has none."""
    t, most = _value(phi, y), 1.0 if phi.name == "tanh" else math.inf
    return flint.arb(0) if phi.name == "relu" else units * _ulp(t, most) + ball(_TINY)


def _spectral_norm(W: flint.arb_mat) -> flint.arb:
    """A bound of ||W||_2: with G = W'W or WW', its largest eigenvalue is at most ||G^k||_F^(1/k)."""
    wide = W.nrows() < W.ncols()
    G, power = (W * W.transpose() if wide else W.transpose() * W), 1
    for _ in range(_SQUARINGS):
        G, power = G * G, 2 * power
    length = _norm(G.entries())
    return length if length == 0 else length.root(2 * power).upper()


def _norm(v: Balls) -> flint.arb:
    """A bound of the 2-norm."""
    sizes = [x.abs_upper() for x in v]
    return sum((s * s for s in sizes), flint.arb(0)).upper().sqrt().upper()


def _magnitude(M: flint.arb_mat) -> flint.arb_mat:
    return flint.arb_mat(M.nrows(), M.ncols(), [v.abs_upper() for v in M.entries()])


def _times(M: flint.arb_mat, v: Balls) -> Balls:
    return list((M * flint.arb_mat([[x] for x in v])).entries())


def _points(numbers: Array) -> Balls:
    return [flint.arb(float(v)) for v in numbers]
