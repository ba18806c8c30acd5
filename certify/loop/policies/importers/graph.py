"""The operations that a graph of ONNX or TorchScript may contain, as exact steps on chains of values.

A chain begins with the observation, and each operation extends a chain with constants, or joins chains: sums, as of
skip connections, products, as of gates, and values one behind the other. Any other operation is rejected by its name.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Any, Literal

import numpy as np

from certify.errors import InputError
from certify.loop.files.arrays import Numbers
from certify.loop.policies.importers.constants import computed, is_computed
from certify.loop.policies.importers.steps import (
    ABSOLUTE,
    CUBE,
    MOST_NORMALISED,
    SQUARE,
    Activate,
    Affine,
    Branches,
    Clip,
    Diagonal,
    InverseRoot,
    Step,
    Tanh,
    activated,
    centred,
    exactly,
    mean_of,
    nearest,
)
from certify.loop.policies.importers.steps import layer_normalised as layer_normalised_steps

Chain = tuple[Step, ...]
_EXACT_INTEGERS = 2**53


def real(value: Any, what: str) -> Numbers:
    """A constant as binary64, which must hold it exactly; one that was computed is rounded once.

    Raises
    ------
    InputError : it is no array of real numbers, is not finite, or is an integer that binary64 does not hold.
    """
    array = np.asarray(value)
    if is_computed(array):
        return np.array([nearest(v) for v in array.ravel()]).reshape(array.shape)
    if array.dtype.kind not in "fiu" or array.dtype.itemsize > 8:
        raise InputError(f"the constants of {what} must be real numbers; found {array.dtype}.")
    if array.dtype.kind in "iu" and array.size and max(abs(int(array.min())), abs(int(array.max()))) > _EXACT_INTEGERS:
        raise InputError(f"an integer of {what} must be at most 2^53 in magnitude.")
    result: Numbers = array.astype(np.float64)
    if not np.all(np.isfinite(result)):
        raise InputError(f"the constants of {what} must be finite; found NaN or infinity.")
    return result


def row(value: Any, what: str) -> tuple[Fraction, ...]:
    """A constant that applies to every row of a batch: one number, or one per component.

    Raises
    ------
    InputError : it has another shape.
    """
    array = np.asarray(value)
    array = array if is_computed(array) else real(value, what)
    if any(size != 1 for size in array.shape[:-1]) or array.size == 0:
        raise InputError(
            f"a constant of {what} must be one number or one for each component; its shape is {array.shape}."
        )
    return tuple(array.ravel()) if is_computed(array) else exactly(array)


def affine(chain: Chain, weight: Any, bias: Any | None, what: str) -> Chain:
    """`W h + b`, with W of shape (out, in)."""
    matrix = real(weight, what)
    if matrix.ndim != 2:
        raise InputError(f"the weight of {what} must be a matrix; its shape is {matrix.shape}.")
    offset = np.zeros(len(matrix)) if bias is None else np.array([float(v) for v in row(bias, what)])
    if offset.shape == (1,):
        offset = np.repeat(offset, len(matrix))
    return (*chain, Affine(matrix, offset))


def held(value: Any, wide: int, what: str) -> Chain:
    """A constant row, as 0 times the observation of `wide` numbers and the row.

    Raises
    ------
    InputError : it is no row, or the width is not known.
    """
    numbers = real(value, what)
    if not wide or numbers.ndim not in (1, 2) or numbers.shape[:-1] not in ((), (1,)):
        raise InputError(f"a constant that {what} reads must be a row; its shape is {numbers.shape}.")
    return (Affine(np.zeros((numbers.size, wide)), numbers.ravel()),)


def scaled(chain: Chain, scale: Any, what: str, *, divide: bool = False) -> Chain:
    """`scale * h`, or `h / scale`."""
    values = row(scale, what)
    if divide and 0 in values:
        raise InputError(f"{what} divides by 0.")
    return (*chain, Diagonal(tuple(1 / v for v in values) if divide else values, (Fraction(0),)))


def shifted(chain: Chain, offset: Any, what: str, *, sign: int = 1) -> Chain:
    """`h + offset`, or `h - offset` with sign -1."""
    return moved(chain, tuple(sign * v for v in row(offset, what)))


def moved(chain: Chain, offset: tuple[Fraction, ...]) -> Chain:
    """`h + offset`, with exact numbers."""
    return (*chain, Diagonal((Fraction(1),), offset))


def negated(chain: Chain) -> Chain:
    """`-h`."""
    return (*chain, Diagonal((Fraction(-1),), (Fraction(0),)))


def mapped(chain: Chain, function: str, *numbers: float) -> Chain:
    """`phi(h)`, by the activation's name and its numbers."""
    return (*chain, *activated(function, *(Fraction(v) for v in numbers)))


def layer_normalised(chain: Chain, width: int, epsilon: float, gain: Any | None, bias: Any | None, what: str) -> Chain:
    """Layer normalisation over all `width` numbers of a row, then its gain and bias.

    Raises
    ------
    InputError : epsilon is not positive, or gain or bias have another shape.
    """
    made: Chain = (*chain, *layer_normalised_steps(width, Fraction(epsilon)))
    made = made if gain is None else scaled(made, gain, what)
    return made if bias is None else shifted(made, bias, what)


def joined(kind: Literal["sum", "concat", "product"], *chains: Chain) -> Chain:
    """The sum of several chains, the product of two, or one behind the other; they part where their steps differ."""
    same = 0
    while all(len(chain) > same and chain[same] is chains[0][same] for chain in chains):
        same += 1
    return (*chains[0][:same], Branches(kind, tuple(chain[same:] for chain in chains)))


def product(one: Chain, other: Chain) -> Chain:
    """The product of two values; `h * sigmoid(h)` and `h * tanh(softplus(h))` are silu and mish."""
    short, long = sorted((one, other), key=len)
    same = all(a is b for a, b in zip(short, long, strict=False))
    more = long[len(short) :]
    for name, gate in (("silu", (Activate("sigmoid"),)), ("mish", (Activate("softplus"), Tanh()))):
        if same and more == gate:
            return (*short, Activate(name))
    return joined("product", one, other)


def powered(chain: Chain, exponent: Any, what: str) -> Chain:
    """`h^2` or `h^3`.

    Raises
    ------
    InputError : the exponent is neither 2 nor 3.
    """
    said = real(exponent, what)
    if said.size != 1 or said.item() not in (2, 3):
        raise InputError(f"the exponent of {what} must be 2 or 3; found {said.ravel()[:4].tolist()}.")
    return (*chain, SQUARE if said.item() == 2 else CUBE)


def magnitude(chain: Chain) -> Chain:
    """`|h|`."""
    return (*chain, ABSOLUTE)


def batch_normalised(
    chain: Chain, mean: Any, var: Any, epsilon: float, gain: Any | None, bias: Any | None, what: str
) -> Chain:
    """`(h - mean) / sqrt(var + epsilon)`, then gain and bias: batch normalisation in evaluation, which is affine."""
    root = computed("sqrt", (computed("add", (var, epsilon), what),), what)
    made = scaled(shifted(chain, mean, what, sign=-1), root, what, divide=True)
    made = made if gain is None else scaled(made, gain, what)
    return made if bias is None else shifted(made, bias, what)


def root_normalised(chain: Chain, width: int, epsilon: Fraction, what: str) -> Chain:
    """`h / sqrt(mean of h^2 + epsilon)` over all `width` numbers of a row.

    Raises
    ------
    InputError : epsilon is not positive, or there are more numbers than are taken.
    """
    if not epsilon > 0 or not 0 < width <= MOST_NORMALISED:
        raise InputError(
            f"{what} must have a positive epsilon and at most {MOST_NORMALISED} numbers; "
            f"found {float(epsilon)} and {width}."
        )
    mean = *mean_of(width), Diagonal((Fraction(1),), (epsilon,))
    return (*chain, Branches("product", ((), (SQUARE, *mean, InverseRoot()))))


def selected(chain: Chain, width: int, start: int, stop: int, what: str) -> Chain:
    """The entries from `start` to `stop` of a row of `width` numbers.

    Raises
    ------
    InputError : there are none, or the width is not known.
    """
    lo, hi = (max(0, min(v + width if v < 0 else v, width)) for v in (start, stop))
    if not 0 < width <= MOST_NORMALISED or not lo < hi:
        raise InputError(f"{what} must take some of the numbers of a row; found {start} to {stop} of {width}.")
    return chain if (lo, hi) == (0, width) else (*chain, Affine(np.eye(width)[lo:hi], np.zeros(hi - lo)))


def leaked(chain: Chain, slope: Any, what: str) -> Chain:
    """`h` where it is positive, and `slope h` where it is negative, with one slope or one for each component."""
    slopes = row(slope, what)
    less = Diagonal(tuple(1 - s for s in slopes), (Fraction(0),))
    return (*chain, Branches("sum", ((Diagonal(slopes, (Fraction(0),)),), (Activate("relu"), less))))


def averaged(chain: Chain, width: int) -> Chain:
    """The mean of the `width` numbers of a row."""
    return (*chain, *mean_of(width))


def subtracted(one: Chain, other: Chain) -> Chain:
    """The difference of two values; `h - mean of h` is that of every number and the one mean."""
    width = _averages(_behind(one, other))
    return (*one, *centred(width)) if width is not None else joined("sum", one, negated(other))


def divided(one: Chain, other: Chain, what: str) -> Chain:
    """`h / (|h| + 1)`, the only quotient of two values that is read.

    Raises
    ------
    InputError : it is another quotient.
    """
    more = _behind(one, other)
    if len(more) == 2 and more[0] is ABSOLUTE and more[1] == Diagonal((Fraction(1),), (Fraction(1),)):
        return mapped(one, "softsign")
    raise InputError(
        f"{what} divides two values that depend on the observation; read are h / (1 + |h|), which is softsign, and "
        f"{_NORMALISED}."
    )


def divided_by_root(one: Chain, under: Chain, what: str) -> Chain:
    """`h / sqrt(mean of h^2 + epsilon)`, as layer normalisation is written out.

    Raises
    ------
    InputError : it is another quotient, or epsilon is not positive.
    """
    bare = one
    while bare and isinstance(bare[-1], Diagonal) and not any(bare[-1].offset) and not _behind(bare, under):
        bare = bare[:-1]  # a gain, which may stand before the quotient as well as behind it
    gains = one[len(bare) :]
    match _behind(bare, under):
        case [Branches() as square, Affine() as total, Diagonal() as share, Diagonal((scale,), (epsilon,)) as last] if (
            square == SQUARE and _averages((total, share)) and scale == 1 and epsilon > 0
        ):
            return (*bare, Branches("product", ((), (square, total, share, last, InverseRoot()))), *gains)
    raise InputError(f"{what} divides by a square root; read is {_NORMALISED}, with a positive epsilon.")


_NORMALISED = "h / sqrt(mean of h^2 + epsilon), which is layer normalisation written out"


def _behind(one: Chain, other: Chain) -> Chain:
    """The steps of `other` after those of `one`; none if it does not begin with them."""
    begins = len(other) >= len(one) and all(a is b for a, b in zip(one, other, strict=False))
    return other[len(one) :] if begins else ()


def _averages(steps: Chain) -> int | None:
    """The number of entries of which these steps are the mean; None if they are another function."""
    match steps:
        case (Affine(weight, bias), Diagonal() as share):
            rows, width = weight.shape
            one = rows == 1 and bool(np.all(weight == 1)) and not np.any(bias)
            return width if one and share == mean_of(width)[1] else None
    return None


def clipped(chain: Chain, lo: Any | None, hi: Any | None, what: str) -> Chain:
    """`min(max(h, lo), hi)`, where None is no bound."""
    if lo is None and hi is None:
        return chain
    none: tuple[Fraction | None, ...] = (None,)
    return (*chain, Clip(none if lo is None else row(lo, what), none if hi is None else row(hi, what)))
