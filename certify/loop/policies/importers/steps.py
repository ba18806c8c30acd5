"""Exact steps from the observation to the action, as a file describes its policy.

Every reader produces these steps, so that folding, comparing and rejecting are written once. A constant is the exact
number that the file's bytes encode; a step is a function in real arithmetic.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction
from typing import Literal, TypeVar

import numpy as np

from certify.errors import InputError
from certify.loop.activations import ACTIVATIONS
from certify.loop.policies.network import Array

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Affine:
    """`y = W h + b`.

    Parameters
    ----------
    weight : shape (out, in).
    bias : shape (out,).

    Raises
    ------
    InputError : the shapes do not match, or a number is not finite.
    """

    weight: Array
    bias: Array

    def __post_init__(self) -> None:
        for name in ("weight", "bias"):
            array = np.array(getattr(self, name), dtype=np.float64)
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        if self.weight.ndim != 2 or self.bias.shape != self.weight.shape[:1] or 0 in self.weight.shape:
            raise InputError(
                "a layer must have a weight (out, in) and a bias (out,); "
                f"found {self.weight.shape} and {self.bias.shape}."
            )
        if not (np.all(np.isfinite(self.weight)) and np.all(np.isfinite(self.bias))):
            raise InputError("the numbers of a layer must be finite; found NaN or infinity.")


@dataclass(frozen=True, slots=True)
class Diagonal:
    """`y_i = scale_i h_i + offset_i`; one number stands for every component."""

    scale: tuple[Fraction, ...]
    offset: tuple[Fraction, ...]


@dataclass(frozen=True, slots=True)
class Normalise:
    """`y_j = clip((o_j - mean_j) / sqrt(square_j), -limit, limit)`; without a limit, no clip.

    Raises
    ------
    InputError : a square or the limit is not positive.
    """

    mean: tuple[Fraction, ...]
    square: tuple[Fraction, ...]
    limit: Fraction | None = None

    def __post_init__(self) -> None:
        if len(self.mean) != len(self.square):
            raise InputError(
                f"a normaliser must have as many means as variances; found {len(self.mean)} and {len(self.square)}."
            )
        if any(q <= 0 for q in self.square) or (self.limit is not None and self.limit <= 0):
            raise InputError("what a normaliser divides by, and what it clips to, must be positive.")


@dataclass(frozen=True, slots=True)
class Tanh:
    """`y_i = tanh h_i`."""


@dataclass(frozen=True, slots=True)
class Activate:
    """`y_i = phi(h_i)`, phi another activation than tanh, by its name in `certify.loop.activations`."""

    function: str


@dataclass(frozen=True, slots=True)
class Clip:
    """`y_i = min(max(h_i, lo_i), hi_i)`; None for a side without a bound, one bound for every component."""

    lo: tuple[Fraction | None, ...]
    hi: tuple[Fraction | None, ...]

    def __post_init__(self) -> None:
        width = max(len(self.lo), len(self.hi))
        for lo, hi in zip(spread(self.lo, width), spread(self.hi, width), strict=True):
            if lo is not None and hi is not None and not lo < hi:
                raise InputError(f"a clip must have lo < hi; found {float(lo)} and {float(hi)}.")


@dataclass(frozen=True, slots=True)
class InverseRoot:
    """`y = 1/sqrt(h)` of one number that is positive."""


@dataclass(frozen=True, slots=True)
class Branches:
    """Chains of steps that all begin with the same vector, and what joins their results: a sum, a product of two, or
    one behind the other. A chain without steps is that vector, as in a skip connection."""

    kind: Literal["sum", "concat", "product"]
    of: tuple[tuple[Step, ...], ...]


Step = Affine | Diagonal | Normalise | Tanh | Activate | Clip | InverseRoot | Branches
MOST_NORMALISED = 4096
"""The most numbers of which a normalisation is read."""
SQUARE = Branches("product", ((), ()))
"""`y_i = h_i^2`."""
CUBE = Branches("product", ((), (SQUARE,)))
"""`y_i = h_i^3`."""
ABSOLUTE = Branches("sum", ((Activate("relu"),), (Diagonal((Fraction(-1),), (Fraction(0),)), Activate("relu"))))
"""`y_i = |h_i|`."""
_SELU = Fraction(1.0507009873554804934193349852946), Fraction(1.6732632423543772848170429916717)
_GELU_TANH = Fraction(math.sqrt(2 / math.pi)), Fraction(0.044715)  # torch's numbers


def activated(function: str, *numbers: Fraction) -> tuple[Step, ...]:
    """The steps of an activation, by its name and the numbers that torch gives it.

    Functions that are not in the table of activations are sums and scalings of those that are.

    Raises
    ------
    InputError : there is no such function.
    """
    one, none = Fraction(1), Fraction(0)
    match function, numbers:
        case "tanh", ():
            return (Tanh(),)
        case "celu" | "softplus", (number,) if number <= 0:
            raise InputError(f"the {PARAMETERS[function][0]} of {function} must be positive; found {float(number)}.")
        case ("elu" | "softplus", (1,)) | (_, ()) if function in ACTIVATIONS:
            return (Activate(function),)
        case "leaky_relu", _:
            slope = numbers[0] if numbers else Fraction(PARAMETERS[function][1])
            return (_sum((_scaled(slope),), (Activate("relu"), _scaled(1 - slope))),)
        case "elu", (alpha,):
            return (_sum((Activate("elu"), _scaled(alpha)), (Activate("relu"), _scaled(1 - alpha))),)
        case "selu", _:
            scale, alpha = numbers if len(numbers) == 2 else _SELU
            return (_sum((Activate("elu"), _scaled(scale * alpha)), (Activate("relu"), _scaled(scale * (1 - alpha)))),)
        case "celu", _:
            alpha = numbers[0] if numbers else one
            return (_scaled(1 / alpha), Activate("elu"), _scaled(alpha))
        case "hardtanh", ():
            return (Clip((-one,), (one,)),)
        case "relu6", ():
            return (Clip((none,), (6 * one,)),)
        case "hardsigmoid", (alpha, beta):
            return (Diagonal((alpha,), (beta,)), Clip((none,), (one,)))
        case "hardsigmoid", ():
            return (Diagonal((one,), (3 * one,)), Clip((none,), (6 * one,)), _scaled(one / 6))
        case "hardswish", ():
            return (Branches("product", ((), activated("hardsigmoid"))),)
        case "gelu-tanh", ():
            return (Branches("product", ((), _tanh_gate())),)
        case "logsigmoid", ():
            return (_scaled(-one), Activate("softplus"), _scaled(-one))
        case "softplus", (beta,):
            return (_scaled(beta), Activate("softplus"), _scaled(1 / beta))
    raise InputError(f"the activation must be one of {', '.join(IMPORTED)}; found {function}.")


COMPOSED = ("leaky_relu", "selu", "celu", "hardtanh", "relu6", "hardsigmoid", "hardswish", "logsigmoid", "gelu-tanh")
"""Activations that are made of others."""
IMPORTED = (*ACTIVATIONS, *COMPOSED)
"""The names of all activations that are read."""
PARAMETERS = {"leaky_relu": ("slope", 0.01), "elu": ("alpha", 1.0), "celu": ("alpha", 1.0), "softplus": ("beta", 1.0)}
"""The number of an activation that has one: its name, and its value where nothing is said."""


def parted(activation: str) -> tuple[str, tuple[float, ...]]:
    """The name of an activation and the number that is said with it, as in `leaky_relu:0.1`.

    Raises
    ------
    InputError : it takes no number, or what is said is none.
    """
    name, colon, text = activation.partition(":")
    try:
        numbers = (float(text),) if colon else ()
        exact = tuple(map(Fraction, numbers))
    except (ValueError, OverflowError) as error:
        raise InputError(f"a number goes with an activation as in leaky_relu:0.1; found {activation!r}.") from error
    if numbers and name not in PARAMETERS:
        raise InputError(f"a number goes with {', '.join(PARAMETERS)} only; found {activation!r}.")
    activated(name, *exact)
    return name, numbers


def in_words(activation: str) -> str:
    """An activation with its number, for people.

    >>> in_words("leaky_relu"), in_words("elu:2"), in_words("tanh")
    ('leaky_relu (slope 0.01)', 'elu (alpha 2)', 'tanh')
    """
    name, numbers = parted(activation)
    if name not in PARAMETERS:
        return name
    word, usual = PARAMETERS[name]
    return f"{name} ({word} {plainly((*numbers, usual)[0])})"


def plainly(number: float) -> str:
    """A number as it is typed."""
    return str(number).removesuffix(".0")


def mean_of(width: int) -> tuple[Step, ...]:
    """The mean of so many numbers, which is one number."""
    return Affine(np.ones((1, width)), np.zeros(1)), Diagonal((Fraction(1, width),), (Fraction(0),))


def centred(width: int) -> tuple[Step, ...]:
    """So many numbers less their mean.

    Raises
    ------
    InputError : there are more than the import takes.
    """
    if not 0 < width <= MOST_NORMALISED:
        raise InputError(f"a normalisation must be of at most {MOST_NORMALISED} numbers; found {width}.")
    return Affine(width * np.eye(width) - 1, np.zeros(width)), Diagonal((Fraction(1, width),), (Fraction(0),))


def layer_normalised(width: int, epsilon: Fraction) -> tuple[Step, ...]:
    """`c / sqrt(mean of c^2 + epsilon)` of so many numbers, c being these less their mean.

    Raises
    ------
    InputError : epsilon is not positive, so that equal numbers would have no value.
    """
    if epsilon <= 0:
        raise InputError(f"the epsilon of a layer normalisation must be positive; found {float(epsilon)}.")
    apart = centred(width)
    mean = *mean_of(width), Diagonal((Fraction(1),), (epsilon,))
    return (*apart, Branches("product", ((), (SQUARE, *mean, InverseRoot()))))


def _tanh_gate() -> tuple[Step, ...]:
    """`(1 + tanh(k h (1 + c h^2))) / 2`, which multiplies h in the tanh form of GELU."""
    k, c = _GELU_TANH
    half = Fraction(1, 2)
    return Branches("product", ((), (SQUARE, Diagonal((k * c,), (k,))))), Tanh(), Diagonal((half,), (half,))


def _scaled(by: Fraction) -> Diagonal:
    return Diagonal((by,), (Fraction(0),))


def _sum(*chains: tuple[Step, ...]) -> Branches:
    return Branches("sum", chains)


def spread(values: tuple[T, ...], width: int) -> tuple[T, ...]:
    """One value for each of `width` components, where a single one stands for all of them.

    Raises
    ------
    InputError : there are neither one nor `width` values.
    """
    if len(values) == 1:
        return values * width
    if len(values) != width:
        raise InputError(f"there must be one number or {width} of them; found {len(values)}.")
    return values


def nearest(value: Fraction) -> float:
    """The nearest binary64.

    Raises
    ------
    InputError : the number is larger than any.
    """
    try:
        return float(value)
    except OverflowError as error:
        raise InputError("a folded number must lie in the range of binary64; one of them is larger.") from error


def exactly(array: Array) -> tuple[Fraction, ...]:
    """The exact rationals of an array's numbers, in row order.

    Raises
    ------
    InputError : a number is not finite.
    """
    flat = np.asarray(array, dtype=np.float64).ravel()
    if not np.all(np.isfinite(flat)):
        raise InputError("the constants of a policy must be finite; found NaN or infinity.")
    return tuple(Fraction(float(v)) for v in flat)


def linear(weight: Array, bias: Array | None) -> Affine:
    """The layer of a file, whose bias may be missing."""
    return Affine(weight, np.zeros(np.shape(weight)[0]) if bias is None else bias)
