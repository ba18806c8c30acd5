"""A calculation with Taylor models written down once, so that a compiled loop can repeat it on batches of boxes.

Each operation of numpy walks through all numbers of a model, and a model in N symbols has N^2 of them: what a plant's
equations cost there is memory. A tape is the same operations in the same order, recorded by running the very code that
computes with models on stand-ins; `kernels.play` runs it on a few boxes at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from certify.provers.bounds.taylor import ConstantsLast

ADD, SCALED, SHIFTED, CONSTANT, ABS, MULTIPLY, INNER, INVERSE, SQRT, EXP, TANH, ATAN, SIN, COS = range(14)


@dataclass(frozen=True, slots=True)
class Step:
    """An operation on the values of two steps, or twice the same, and its constant if it has one."""

    operation: int
    left: int
    right: int
    k: float = 0.0


@dataclass(frozen=True, slots=True)
class Value:
    """A placeholder of a Taylor model: the result of a step, or an input, of which no step is made."""

    steps: list[Step] = field(repr=False)
    number: int

    def _then(self, operation: int, other: Value | None = None, k: float = 0.0) -> Value:
        self.steps.append(Step(operation, self.number, (other or self).number, k))
        return Value(self.steps, len(self.steps) - 1)

    def __add__(self, other: Value) -> Value:
        return self._then(ADD, other)

    def __mul__(self, other: Value) -> Value:
        return self._then(MULTIPLY, other)

    def in_inner(self, other: Value) -> Value:
        """The product, as a term of the inner product that the tape ends with: see `taylor.inner_product`."""
        return self._then(INNER, other)

    def scaled(self, k: float) -> Value:
        return self._then(SCALED, k=k)

    def shifted(self, k: float) -> Value:
        return self._then(SHIFTED, k=k)

    def abs(self) -> Value:
        return self._then(ABS)

    def inverse(self) -> Value:
        return self._then(INVERSE)

    def sqrt(self) -> Value:
        return self._then(SQRT)

    def exp(self) -> Value:
        return self._then(EXP)

    def tanh(self) -> Value:
        return self._then(TANH)

    def atan(self) -> Value:
        return self._then(ATAN)

    def sin(self) -> Value:
        return self._then(SIN)

    def cos(self) -> Value:
        return self._then(COS)


class Recording(ConstantsLast[Value]):
    """The arithmetic that records each operation on its values."""

    def __init__(self, steps: list[Step]) -> None:
        self._steps = steps

    def constant(self, q: Fraction) -> Value:
        self._steps.append(Step(CONSTANT, 0, 0, float(q)))
        return Value(self._steps, len(self._steps) - 1)


@dataclass(frozen=True, slots=True)
class Tape:
    """Steps as numbers, for `kernels.play`.

    `steps` (S, 4): the operation, the places of its operands, and that of its result, which is none of them; `k` (S,)
    their constants. The inputs come in the first of `places` places, and the result is the last step's.
    """

    steps: NDArray[np.int64]
    k: NDArray[np.float64]
    places: int


def recorded(inputs: int, calculation: Callable[[Sequence[Value], Recording], Value]) -> Tape:
    """The tape of a calculation with that many inputs, whose result is not one of them."""
    steps = [Step(CONSTANT, 0, 0)] * inputs  # they are never played
    result = calculation([Value(steps, i) for i in range(inputs)], Recording(steps))
    needed = _needed(steps, result.number)
    last = {number: at for at in needed for number in (steps[at].left, steps[at].right)}
    place, free, places = {i: i for i in range(inputs)}, list[int](), inputs
    rows = []
    for at in (at for at in needed if at >= inputs):
        step = steps[at]
        if not free:
            free, places = [places], places + 1
        place[at] = free.pop()
        rows.append((step.operation, place[step.left], place[step.right], place[at]))
        free += [
            place[number] for number in {step.left, step.right} if last[number] == at and step.operation != CONSTANT
        ]
    k = [steps[at].k for at in needed if at >= inputs]
    return Tape(np.array(rows, dtype=np.int64), np.array(k), places)


def _needed(steps: Sequence[Step], result: int) -> list[int]:
    """The steps that a result needs, in order."""
    found, left = set[int](), [result]
    while left:
        at = left.pop()
        if at not in found:
            found.add(at)
            left += [steps[at].left, steps[at].right] if steps[at].operation != CONSTANT else []
    return sorted(found)
