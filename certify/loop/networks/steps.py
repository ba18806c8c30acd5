"""A network as a list of steps, and the interpreter that takes an argument through them in any algebra.

Vector 0 is the argument, step k makes vector k of vectors before it, and the last vector is the value. A chain, layers
with one function between them, is a list of `Affine` and `Map` in turn; observations, skip connections, branches and
clips are further steps.
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from certify.errors import InputError
from certify.loop.activations import Activation, activation
from certify.loop.expressions import Expression, Symbol, differentiate, nodes, symbols_of, to_tree
from certify.loop.networks.layers import frozen_layers

Array = NDArray[np.float64]
T = TypeVar("T")
V = TypeVar("V")
MOST_NAMES = 64  # that an observation reads or makes


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """`of` are the numbers of the vectors that it reads."""

    kind: ClassVar[str]
    of: tuple[int, ...]

    @property
    def arrays(self) -> tuple[Array, ...]:
        """The numbers that it states."""
        return ()

    def size(self, widths: Sequence[int]) -> int:
        """The number of entries that it makes of vectors of these widths.

        Raises
        ------
        InputError : it cannot read them.
        """
        return widths[0]


@dataclass(frozen=True, slots=True, eq=False)
class Affine(Step):
    """`W h + b`, W (out, in)."""

    kind = "affine"
    weight: Array
    bias: Array

    @property
    def arrays(self) -> tuple[Array, ...]:
        return self.weight, self.bias

    def size(self, widths: Sequence[int]) -> int:
        if self.weight.ndim != 2 or self.bias.shape != self.weight.shape[:1] or self.weight.shape[1] != widths[0]:
            raise InputError(
                f"a layer of {widths[0]} numbers must have a weight (out, {widths[0]}) and a bias (out,); found "
                f"{self.weight.shape} and {self.bias.shape}."
            )
        return len(self.bias)


@dataclass(frozen=True, slots=True, eq=False)
class Map(Step):
    """A function of each entry, by its name in `certify.loop.activations`."""

    kind = "map"
    function: str

    @property
    def phi(self) -> Activation:
        """The function."""
        return activation(self.function)


@dataclass(frozen=True, slots=True, eq=False)
class Clip(Step):
    """`min(max(h, lo), hi)`."""

    kind = "clip"
    lo: Array
    hi: Array

    @property
    def arrays(self) -> tuple[Array, ...]:
        return self.lo, self.hi

    def size(self, widths: Sequence[int]) -> int:
        if self.lo.shape != (widths[0],) or self.hi.shape != (widths[0],) or not np.all(self.lo < self.hi):
            raise InputError(f"a clip of {widths[0]} numbers must have as many lower ends below upper ends.")
        return widths[0]


@dataclass(frozen=True, slots=True, eq=False)
class Sum(Step):
    """The sum of two or more vectors, from left to right."""

    kind = "sum"

    def size(self, widths: Sequence[int]) -> int:
        if len(widths) < 2 or len(set(widths)) > 1:
            raise InputError(f"a sum must have two or more vectors of equal length; found lengths {list(widths)}.")
        return widths[0]


@dataclass(frozen=True, slots=True, eq=False)
class Concat(Step):
    """Two or more vectors one behind the other."""

    kind = "concat"

    def size(self, widths: Sequence[int]) -> int:
        if len(widths) < 2:
            raise InputError("vectors one behind the other must be two or more.")
        return sum(widths)


@dataclass(frozen=True, slots=True, eq=False)
class Product(Step):
    """The product of two vectors, entry by entry; one of a single entry multiplies every entry of the other."""

    kind = "product"

    def size(self, widths: Sequence[int]) -> int:
        if len(widths) != 2 or (widths[0] != widths[1] and 1 not in widths):
            raise InputError(
                f"a product must have two vectors of equal length, or one of one entry; found lengths {list(widths)}."
            )
        return max(widths)


@dataclass(frozen=True, slots=True, eq=False)
class Observe(Step):
    """Expressions of the entries, which have the names `symbols`."""

    kind = "observe"
    symbols: tuple[Symbol, ...]
    expressions: tuple[Expression, ...]

    @property
    def slopes(self) -> tuple[Expression, ...]:
        """The derivatives of each expression by each symbol, row after row."""
        return _slopes(self.expressions, self.symbols)

    @property
    def operations(self) -> int:
        """The number of operations in the expressions, about."""
        return sum(1 for _ in nodes(*self.expressions))

    def size(self, widths: Sequence[int]) -> int:
        if len(set(self.symbols)) != widths[0] or len(self.symbols) != widths[0]:
            raise InputError(f"observations of {widths[0]} numbers must have as many different names for them.")
        unknown = sorted(str(s) for s in symbols_of(*self.expressions) - set(self.symbols))
        if unknown:
            raise InputError(
                f"an observation must be an expression of {', '.join(map(str, self.symbols))}; it uses "
                f"{', '.join(unknown)}."
            )
        if not 1 <= len(self.expressions) <= MOST_NAMES or len(self.symbols) > MOST_NAMES:
            raise InputError(f"observations must be 1 to {MOST_NAMES}, of at most as many states.")
        return len(self.expressions)


@cache
def _slopes(expressions: tuple[Expression, ...], symbols: tuple[Symbol, ...]) -> tuple[Expression, ...]:
    return tuple(differentiate(e, s) for e in expressions for s in symbols)


@dataclass(frozen=True, eq=False)
class Network:
    """A function of `reads` numbers, written as steps; its numbers are binary64 and exact.

    Raises
    ------
    InputError : there is no step, a step reads a vector that is not before it or is of the wrong length, a vector but
        the last is read by none, or a number is not finite.
    """

    reads: int
    steps: tuple[Step, ...]
    sizes: tuple[int, ...] = field(init=False)
    spent: tuple[tuple[int, ...], ...] = field(init=False)

    def __post_init__(self) -> None:
        sizes = [self.reads]
        for k, step in enumerate(self.steps, 1):
            if not step.of or not all(0 <= i < k for i in step.of):
                raise InputError(f"step {k} of a network must read vectors before it; it reads {list(step.of)}.")
            if not all(np.all(np.isfinite(array)) for array in step.arrays):
                raise InputError("the numbers of a network must be finite; found NaN or infinity.")
            sizes.append(step.size([sizes[i] for i in step.of]))
        last = {i: k for k, step in enumerate(self.steps) for i in step.of}  # the last that reads it
        if set(last) != set(range(len(self.steps))) or not self.steps:
            raise InputError("a network must have a step, and each vector but the last must be read by one.")
        spent = tuple(tuple(i for i, reader in last.items() if reader == k) for k in range(len(self.steps)))
        object.__setattr__(self, "sizes", tuple(sizes))
        object.__setattr__(self, "spent", spent)

    @property
    def gives(self) -> int:
        """The number of entries of its value."""
        return self.sizes[-1]

    @property
    def observation(self) -> Observe | None:
        """The first step, if that is an observation which alone reads the argument."""
        first = self.steps[0]
        if not isinstance(first, Observe) or any(0 in step.of for step in self.steps[1:]):
            return None
        return first

    @property
    def is_chain(self) -> bool:
        """True if it is layers with one function between them, each of the vector just before."""
        return _is_chain(self.steps, 0)

    @property
    def is_observed_chain(self) -> bool:
        """True if it is a chain, maybe behind an observation."""
        behind = 0 if self.observation is None else 1
        return _is_chain(self.steps[behind:], behind)

    @property
    def affine(self) -> tuple[Affine, ...]:
        """Its layers, in order."""
        return tuple(step for step in self.steps if isinstance(step, Affine))

    @property
    def functions(self) -> tuple[str, ...]:
        """The names of the functions between its layers, each once, in order."""
        return tuple(dict.fromkeys(step.function for step in self.steps if isinstance(step, Map)))

    @property
    def widths(self) -> tuple[int, ...]:
        """The number of entries that the first layer reads, and those of all layers, such as (2, 16, 16, 1)."""
        layers = self.affine
        first = self.reads if not layers else layers[0].weight.shape[1]
        return (int(first), *(len(step.bias) for step in layers))

    @property
    def entries(self) -> int:
        """The number of entries of all matrices."""
        return sum(step.weight.size for step in self.affine)

    @property
    def units(self) -> int:
        """The number of entries that its layers make."""
        return sum(len(step.bias) for step in self.affine)

    @property
    def operations(self) -> int:
        """The number of operations of all observations, about."""
        return sum(step.operations for step in self.steps if isinstance(step, Observe))

    def words(self) -> str:
        """Its steps but for their numbers, as the hash has them (FORMAT.md); nothing for a chain of tanh."""
        if self.is_chain and self.functions in ((), ("tanh",)):
            return ""
        return "".join(map(_in_words, self.steps))

    def shifted(self, by: Array) -> Network:
        """The network with numbers (gives,) added to its value."""
        last = self.steps[-1]
        if isinstance(last, Affine):
            return Network(self.reads, (*self.steps[:-1], Affine(last.of, last.weight, last.bias + by)))
        return Network(self.reads, (*self.steps, Affine((len(self.steps),), np.eye(self.gives), by)))

    def read_at(self, origin: Array) -> Network:
        """The network of `origin` + the argument, in floats."""
        first = self.steps[0]
        if isinstance(first, Affine) and not any(0 in step.of for step in self.steps[1:]):
            moved = Affine(first.of, first.weight, first.bias + first.weight @ origin)
            return Network(self.reads, (moved, *self.steps[1:]))
        return self.behind(self.reads, Affine((0,), np.eye(self.reads), origin))

    def behind(self, reads: int, first: Step) -> Network:
        """The network of what a step makes of `reads` numbers."""
        return Network(reads, (first, *(replace(step, of=tuple(i + 1 for i in step.of)) for step in self.steps)))


def layered(
    weights: Sequence[Any], biases: Sequence[Any], function: str = "tanh", whose: str = "a network", behind: int = 0
) -> tuple[Step, ...]:
    """Layers with a function between them as steps, the first of which reads vector `behind`.

    Raises
    ------
    InputError : shapes do not chain, a number is not finite, or there is no such function.
    """
    steps: list[Step] = []
    for weight, bias in zip(*frozen_layers(weights, biases, whose), strict=True):
        if steps:
            steps.append(Map((behind + len(steps),), activation(function).name))
        steps.append(Affine((behind + len(steps),), weight, bias))
    return tuple(steps)


def _is_chain(steps: Sequence[Step], behind: int) -> bool:
    kinds = all(isinstance(step, (Affine, Map)[k % 2]) for k, step in enumerate(steps))
    straight = all(step.of == (k,) for k, step in enumerate(steps, behind))
    functions = {step.function for step in steps if isinstance(step, Map)}
    return len(steps) % 2 == 1 and kinds and straight and len(functions) <= 1


def _in_words(step: Step) -> str:
    text = " ".join([step.kind, *map(str, step.of)])
    text += f" {step.function}\0" if isinstance(step, Map) else "\0"
    if isinstance(step, Observe):
        trees = json.dumps([to_tree(e) for e in step.expressions], separators=(",", ":"))
        text += "".join(f"{s.name}\0" for s in step.symbols) + f"{trees}\0"
    return text


def repeated(v: list[T], w: list[T]) -> tuple[list[T], list[T]]:
    """A product's two vectors as lists of equal length, a single entry as often as the other has entries."""
    return v * len(w) if len(v) == 1 else v, w * len(v) if len(w) == 1 else w


class Algebra(ABC, Generic[V]):
    """The meaning of each kind of step for vectors V."""

    @abstractmethod
    def affine(self, step: Affine, v: V) -> V:
        """`W v + b`."""

    @abstractmethod
    def map(self, step: Map, v: V) -> V:
        """The function of each entry."""

    @abstractmethod
    def clip(self, step: Clip, v: V) -> V:
        """`min(max(v, lo), hi)`."""

    @abstractmethod
    def sum(self, step: Sum, *vectors: V) -> V:
        """The sum of vectors."""

    @abstractmethod
    def concat(self, step: Concat, *vectors: V) -> V:
        """Vectors one behind the other."""

    @abstractmethod
    def product(self, step: Product, v: V, w: V) -> V:
        """The product of two vectors, of which one may have a single entry."""

    @abstractmethod
    def observe(self, step: Observe, v: V) -> V:
        """Expressions of the entries."""

    def run(self, network: Network, argument: V) -> V:
        """The network's value; vectors are dropped once no further step reads them."""
        vectors = {0: argument}
        for k, (step, spent) in enumerate(zip(network.steps, network.spent, strict=True), 1):
            vectors[k] = getattr(self, step.kind)(step, *(vectors[i] for i in step.of))
            for i in spent:
                del vectors[i]
        return vectors[len(network.steps)]
