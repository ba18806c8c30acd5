"""Compare a folded network with the framework's own outputs, and bound the difference that rounding can cause.

The framework usually works in single precision. Its rounding is bounded step by step in the usual way (Higham, Accuracy
and Stability of Numerical Algorithms, section 3): a sum of k products has an error of at most `k u / (1 - k u)` times
the sum of their magnitudes; an activation multiplies an error by its slope and adds a few units of its own. A
difference beyond four times that bound is no rounding: the file was misread, and the import is rejected. The bound is
loose for wide networks, so the comparison is repeated in double precision, where it is tight.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from certify.errors import InputError
from certify.loop.activations import ACTIVATIONS
from certify.loop.policies.importers.reading import Reading
from certify.loop.policies.importers.steps import (
    Activate,
    Affine,
    Branches,
    Clip,
    Diagonal,
    InverseRoot,
    Normalise,
    Step,
    Tanh,
)
from certify.loop.policies.network import Array

SAMPLES = 10_000
_SLACK = 4.0
_TANH_UNITS = 8.0
_STRAIGHT = 20.0  # from where on torch takes softplus for its argument
_SINGLE, _DOUBLE = 2.0**-24, 2.0**-53


@dataclass(frozen=True, slots=True)
class Difference:
    """The largest difference over the states, and the bound of rounding there.

    Parameters
    ----------
    states : number of compared states.
    largest : the largest difference, in the inputs' units.
    explained : the bound of the framework's rounding at the state of the largest difference.
    in_double : the largest difference where the framework's operations work in double precision.
    """

    states: int
    largest: float
    explained: float
    in_double: float


def apply(steps: Sequence[Step], x: Array) -> Array:
    """The steps in binary64, (k, n) to (k, m)."""
    return _run(steps, x, np.zeros_like(x), _DOUBLE)[0]


def compare_reading(
    reading: Reading,
    before: tuple[Step, ...],
    after: tuple[Step, ...],
    observed: Array,
    ours: Array,
    inexact: bool = False,
) -> Difference:
    """Compare with the framework in the file's precision, and with the same operations in double precision.

    Users see the first; its rounding could hide a small mistake, which the second shows.

    Parameters
    ----------
    before, after : the steps before and after the reading's own steps.
    observed : the network's inputs, without `before`, (k, n).
    ours : the folded network's values at the same states, (k, m).
    inexact : True if `observed` are no numbers of single precision, and so are rounded for the framework.

    Raises
    ------
    InputError : they differ by more than rounding, or the framework cannot evaluate the network.
    """
    chains = before, after
    single, double = (_against(reading, chains, observed, ours, twice, inexact) for twice in (reading.double, True))
    return Difference(single.states, single.largest, single.explained, double.largest)


def _against(
    reading: Reading,
    chains: tuple[tuple[Step, ...], tuple[Step, ...]],
    observed: Array,
    ours: Array,
    double: bool,
    inexact: bool,
) -> Difference:
    before, after = chains
    given = apply(before, observed)
    given = given if double else given.astype(np.float32)
    try:
        theirs = apply(after, np.asarray(reading.evaluate(given, double), dtype=np.float64))
    except (RuntimeError, ValueError, TypeError, LookupError, AttributeError) as error:
        raise InputError(f"the framework cannot evaluate the network itself: {error}.") from error
    if reading.beta is None:
        return compare(ours, theirs, rounding((*before, *reading.steps, *after), observed, double, inexact))
    end = max(k for k, step in enumerate(reading.steps) if isinstance(step, Tanh))
    head, tail = (*before, *reading.steps[:end]), (*reading.steps[end:], *after)
    return compare(ours, theirs, rounding_centred(head, tail, observed, reading.beta, double))


def compare(ours: Array, theirs: Any, bound: Array) -> Difference:
    """Compare two evaluations (k, m) with the bound of their rounding.

    Raises
    ------
    InputError : they differ by more, or the framework's is not finite.
    """
    other = np.asarray(theirs, dtype=np.float64)
    if other.shape != ours.shape:
        raise InputError(f"the framework's own evaluation must have shape {ours.shape}; it has {other.shape}.")
    if not np.all(np.isfinite(other)):
        raise InputError("the framework's own evaluation must be finite; it is not, at states of the plant's domain.")
    off = np.abs(ours - other)
    excess = off - bound
    i = np.unravel_index(int(np.argmax(excess)), off.shape)
    if not excess[i] <= 0:
        raise InputError(
            f"what is folded must agree with the framework's own evaluation up to rounding, {bound[i]:.3g} at most; "
            f"they differ by {off[i]:.3g}. An option may be wrong for this file, or the file was misread."
        )
    j = np.unravel_index(int(np.argmax(off)), off.shape)
    return Difference(len(ours), float(off[j]), float(bound[j]), float(off[j]))


def rounding(steps: Sequence[Step], x: Array, double: bool, inexact: bool = False) -> Array:
    """A bound of the rounding error of the action at observations (k, n), which are `inexact` numbers or exact ones,
    shape (k, m)."""
    unit = _DOUBLE if double else _SINGLE
    return _SLACK * _run(steps, x, 4 * unit * np.abs(x) if inexact else np.zeros_like(x), unit)[1]


def rounding_centred(before: Sequence[Step], after: Sequence[Step], x: Array, beta: Array, double: bool) -> Array:
    """The same for `after(before(x) - before(0) + beta)`, whose beta is stored in single precision."""
    unit = _DOUBLE if double else _SINGLE
    h, error = _run(before, x, np.zeros_like(x), unit)
    at, at_error = _run(before, np.zeros((1, x.shape[1])), np.zeros((1, x.shape[1])), unit)
    error = error + at_error + 4 * unit * (np.abs(h) + np.abs(at)) + 16 * _SINGLE * (np.abs(beta) + 1)
    return _SLACK * _run(after, h - at + beta, error, unit)[1]


def _run(steps: Sequence[Step], x: Array, error: Array, unit: float) -> tuple[Array, Array]:
    """Values and bounds of their errors after the steps; the errors of operations with `unit` roundoff."""
    h, e = x, error
    for step in steps:
        match step:
            case Affine():
                magnitudes = np.abs(step.weight).T
                k = step.weight.shape[1] + 2
                gamma = k * unit / (1 - k * unit)
                e = (1 + gamma) * (e @ magnitudes) + gamma * (np.abs(h) @ magnitudes + np.abs(step.bias))
                h = h @ step.weight.T + step.bias
            case Diagonal():
                scale, offset = _floats(step.scale), _floats(step.offset)
                e = (1 + 4 * unit) * np.abs(scale) * e + 4 * unit * (np.abs(scale * h) + np.abs(offset))
                h = scale * h + offset
            case Normalise():
                mean, divisor = _floats(step.mean), np.sqrt(_floats(step.square))
                e = e / divisor + 8 * unit * (np.abs(h) + np.abs(mean)) / divisor
                h = (h - mean) / divisor
                if step.limit is not None:
                    h = np.clip(h, -float(step.limit), float(step.limit))
            case Tanh():
                h = np.tanh(h)
                e = e + _TANH_UNITS * unit * np.abs(h)
            case Activate():
                phi = ACTIVATIONS[step.function]
                value = phi(h)
                e = phi.steepest * e + _TANH_UNITS * unit * (np.abs(h) + np.abs(value))
                if step.function == "softplus":
                    e = np.where(h > _STRAIGHT - e, e + np.exp(-_STRAIGHT), e)
                if step.function == "elu":  # exp(h) - 1 cancels
                    e = e + 2 * unit * (h < 0)
                if step.function == "gelu":  # the onnx package's own has constants of single precision
                    e = e + _SINGLE * np.abs(h)
                h = value
            case Clip():
                h = np.clip(h, _ends(step.lo, -np.inf), _ends(step.hi, np.inf))
            case InverseRoot():
                least = np.where(h > e, h - e, np.nan)  # where rounding may leave nothing, no bound is known
                h, e = 1 / np.sqrt(h), e / (2 * least**1.5) + 8 * unit / np.sqrt(least)
            case Branches():
                ends = [_run(chain, h, e, unit) for chain in step.of]
                if step.kind == "concat":
                    h, e = (np.concatenate(parts, axis=1) for parts in zip(*ends, strict=True))
                    continue
                if step.kind == "product":
                    (v, of_v), (w, of_w) = ends
                    h = v * w
                    e = np.abs(v) * of_w + np.abs(w) * of_v + of_v * of_w + 2 * unit * np.abs(h)
                    continue
                sizes = sum(np.abs(v) + w for v, w in ends)
                h, e = (np.sum(parts, axis=0) for parts in zip(*ends, strict=True))
                e = e + len(ends) * unit * sizes
    return h, e


def _floats(values: Sequence[Any]) -> Array:
    try:
        return np.array([float(v) for v in values])
    except OverflowError as error:
        raise InputError("the constants of a policy must lie in the range of binary64; one is larger.") from error


def _ends(values: Sequence[Any], nothing: float) -> Array:
    return _floats([nothing if v is None else v for v in values])
