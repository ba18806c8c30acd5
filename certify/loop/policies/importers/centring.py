"""A network that a file's program centres itself, as in `clip(net(x) - net(x_eq) + u_eq)`.

A file that subtracts the network's value at the operating point says by its form that pi(0) = u_eq. Its steps without
the subtraction, centred by this program, are the same function in real arithmetic, up to the rounding of u_eq, and rest
at the origin exactly.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from itertools import permutations
from typing import TypeGuard

import numpy as np

from certify.loop.policies.importers.steps import (
    Activate,
    Affine,
    Branches,
    Clip,
    Diagonal,
    Step,
    Tanh,
    exactly,
    spread,
)
from certify.loop.policies.network import Centre

Exact = Sequence[Fraction | None]
_NEGATED = Diagonal((Fraction(-1),), (Fraction(0),))


def without_centring(
    steps: Sequence[Step], at_origin: Exact, u_eq: Sequence[Fraction]
) -> tuple[tuple[Step, ...], Centre] | None:
    """The steps without `- net(x_eq)`, and the centring that they have by it; None if the steps subtract no such value.

    Parameters
    ----------
    steps : from the observation to the action.
    at_origin : the observations at the operating point, (n,); None for one that is no rational.
    u_eq : shape (m,).
    """
    place = next((k for k, step in enumerate(steps) if isinstance(step, Branches)), len(steps))
    before, tail = tuple(steps[:place]), tuple(steps[place + 1 :])
    addends = _addends(steps[place : place + 1])
    for (k, net), (j, subtracted) in permutations(enumerate(addends), 2):
        found = _apart(net, subtracted) or _apart(_layers(net), _layers(subtracted))
        if found is None:
            continue
        first, core, shifts, at = found
        others = [addend for i, addend in enumerate(addends) if i not in (k, j)]
        known = [_through((*before, *other), at_origin) for other in others]
        if _through((*before, *first), at_origin) != at or not _gives((*shifts, *tail), known, u_eq):
            continue
        centre: Centre = "preactivation" if any(isinstance(step, Tanh) for step in tail) else "output"
        kept = (*first, *core, *shifts)
        return (*before, *((Branches("sum", (kept, *others)),) if others else kept), *tail), centre
    return None


def _addends(steps: Sequence[Step]) -> list[tuple[Step, ...]]:
    """The chains that steps add up, where the last of them is a sum."""
    if not steps or not isinstance(steps[-1], Branches) or steps[-1].kind != "sum":
        return [tuple(steps)]
    return [(*steps[:-1], *addend) for chain in steps[-1].of for addend in _addends(chain)]


def _apart(
    net: tuple[Step, ...], subtracted: tuple[Step, ...]
) -> tuple[tuple[Step, ...], tuple[Step, ...], tuple[Step, ...], tuple[Fraction, ...]] | None:
    """The steps before a network, its own, shifts behind it, and the constant that the same network reads in what is
    subtracted; None if that is something else."""
    if len(subtracted) < 3 or subtracted[-1] != _NEGATED:
        return None
    held, core = subtracted[0], subtracted[1:-1]
    if not isinstance(held, Affine) or np.any(held.weight) or _ends_clipped(core):
        return None
    end = len(net)
    while end > len(core) and _is_shift(net[end - 1]) and not _same(net[end - len(core) : end], core):
        end -= 1
    start = end - len(core)
    if start < 0 or not _same(net[start:end], core):
        return None
    return net[:start], core, net[end:], exactly(held.bias)


def _ends_clipped(core: Sequence[Step]) -> bool:
    """True if a clip stands behind the last layer, which as the policy's own would act after the centring."""
    last = max((k for k, step in enumerate(core) if isinstance(step, Affine | Activate | Branches)), default=-1)
    return any(isinstance(step, Clip) for step in core[last + 1 :])


def _layers(steps: tuple[Step, ...]) -> tuple[Step, ...]:
    """The steps with a matrix product and the sum behind it as the layer that they are."""
    made: list[Step] = []
    for step in steps:
        last = made[-1] if made else None
        if isinstance(last, Affine) and _is_shift(step) and not np.any(last.bias):
            shift = [float(v) for v in spread(step.offset, len(last.bias))]
            if list(map(Fraction, shift)) == list(spread(step.offset, len(last.bias))):
                made[-1] = Affine(last.weight, np.array(shift))
                continue
        made.append(step)
    return tuple(made)


def _is_shift(step: Step) -> TypeGuard[Diagonal]:
    return isinstance(step, Diagonal) and all(scale == 1 for scale in step.scale)


def _same(some: Sequence[Step], others: Sequence[Step]) -> bool:
    """True if these steps are the same function, step by step."""
    return len(some) == len(others) and all(map(_equal, some, others))


def _equal(one: Step, other: Step) -> bool:
    match one, other:
        case Affine(), Affine():
            return np.array_equal(one.weight, other.weight) and np.array_equal(one.bias, other.bias)
        case Branches(), Branches():
            same = one.kind == other.kind and len(one.of) == len(other.of)
            return same and all(map(_same, one.of, other.of))
    return type(one) is type(other) and one == other


def _through(steps: Sequence[Step], values: Exact) -> tuple[Fraction, ...] | None:
    """The values after affine steps; None if there are others, or a value is no rational."""
    known = tuple(v for v in values if v is not None)
    if len(known) < len(values):
        return None
    for step in steps:
        match step:
            case Affine():
                rows = zip(step.weight.tolist(), exactly(step.bias), strict=True)
                known = tuple(sum((Fraction(w) * v for w, v in zip(row, known, strict=True)), b) for row, b in rows)
            case Diagonal():
                both = zip(spread(step.scale, len(known)), known, spread(step.offset, len(known)), strict=True)
                known = tuple(s * v + o for s, v, o in both)
            case _:
                return None
    return known


def _gives(tail: Sequence[Step], addends: Sequence[tuple[Fraction, ...] | None], u_eq: Sequence[Fraction]) -> bool:
    """True if the steps take the sum of these values to u_eq, rounded to binary64, by scales, shifts, clips that are
    inactive there, and at most one tanh, of 0."""
    m, values = len(u_eq), [value for value in addends if value is not None]
    if len(values) < len(addends) or any(len(value) not in (1, m) for value in values):
        return False
    columns = zip(*(spread(value, m) for value in values), [Fraction(0)] * m, strict=True)
    known: tuple[Fraction, ...] | None = tuple(sum(column, Fraction(0)) for column in columns)
    squashed = False
    for step in tail:
        match step:
            case Diagonal() if known is not None:
                known = _through((step,), known)
            case Tanh() if known is not None and not squashed and not any(known):
                squashed = True
            case Clip() if known is not None and (squashed or not any(isinstance(s, Tanh) for s in tail)):
                ends = zip(spread(step.lo, m), known, spread(step.hi, m), strict=True)
                if not all(lo is not None and hi is not None and lo < v < hi for lo, v, hi in ends):
                    return False
            case _:
                return False
    return known is not None and list(map(float, known)) == list(map(float, u_eq))
