"""Equations as a list of operations, in which equal subexpressions are one operation.

An equation may name the same power of the same sine a dozen times. Written out as a tree it would be bounded a dozen
times, and nested powers would take time that is exponential in their depth.
"""

from __future__ import annotations

import operator
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from flint import fmpq

from .refusal import Refused, require

if TYPE_CHECKING:
    from .networks import Network

MAX_NESTING, MAX_NODES = 200, 20_000  # of lists; of lists, names and numbers in all equations, and of operations
HEAVISIDE, MAX_JUMPS = "heaviside", 6
RATIONAL = re.compile(r"-?(0|[1-9][0-9]{0,1200})(/[1-9][0-9]{0,1200})?")
OPERANDS = {
    "+": (1, MAX_NODES),
    "*": (1, MAX_NODES),
    "-": (1, 2),
    "/": (2, 2),
    "sin": (1, 1),
    "cos": (1, 1),
    "tan": (1, 1),
    "tanh": (1, 1),
    "exp": (1, 1),
    "atan": (1, 1),
    "sqrt": (1, 1),
    "abs": (1, 1),
    HEAVISIDE: (1, 1),
    "min": (2, MAX_NODES),
    "max": (2, MAX_NODES),
    "clip": (3, 3),
}
MAX_BITS = 2**14  # of a numerator or a denominator
RATIONALLY: Mapping[str, Callable[..., fmpq]] = {
    "+": operator.add,
    "*": operator.mul,
    "-": operator.neg,
    "1/": lambda q: 1 / q,
}
PLAIN = ("sin", "cos", "tanh", "exp", "atan", "sqrt")  # smooth functions that are one operation
HALF = fmpq(1, 2)

# ("name", str), ("rational", fmpq), ("network", str, numbers of earlier steps), ("entry", the number of such a call,
# i), or the name of an operation and the numbers of earlier steps
Step = tuple[Any, ...]
Called = Callable[["Call", Sequence[Any]], Sequence[Any]]
Jump = Callable[[Any], Any]


def rational(text: Any, at: str) -> fmpq:
    require(isinstance(text, str) and RATIONAL.fullmatch(text) is not None, "format", at, "a rational was expected")
    numerator, _, denominator = text.partition("/")
    return fmpq(int(numerator), int(denominator or 1))


@dataclass(frozen=True)
class Call:
    """A network at given arguments: `entries` of its value are used, the first as number `place` of all calls'."""

    network: Network
    entries: tuple[int, ...]
    place: int


@dataclass(frozen=True)
class Equations:
    """`steps` in an order in which they can be evaluated; `results` are the steps whose values are the equations'.

    `calls` has those steps that are calls of networks.
    """

    steps: tuple[Step, ...]
    results: tuple[int, ...]
    calls: Mapping[int, Call]

    @property
    def entries(self) -> int:
        """The number of entries of calls that are used."""
        return sum(len(call.entries) for call in self.calls.values())

    @property
    def jumps(self) -> int:
        """The number of operations whose value is 0 or 1, either where their argument is 0."""
        return sum(step[0] == HEAVISIDE for step in self.steps)

    @cached_property
    def used_up(self) -> list[list[int]]:
        """For each step the earlier ones that no later step asks for, nor a result."""
        last = {operand: k for k, step in enumerate(self.steps) for operand in operands_of(step)}
        found: list[list[int]] = [[] for _ in self.steps]
        for operand, k in last.items():
            if operand not in self.results:
                found[k].append(operand)
        return found

    def evaluate(
        self,
        names: Mapping[str, Any],
        constant: Callable[[fmpq], Any],
        called: Called | None = None,
        jump: Jump | None = None,
    ) -> list[Any]:
        """Over anything that has `+`, `*`, unary `-` and `function(name)`; `1/` is a function.

        `called` gives the entries of a call that are used, `jump` the value of a jump at its argument, one jump after
        the other in the order of the steps. A value is dropped after its last use: a model of many variables is large.
        """
        values: dict[int, Any] = {}
        for k, (step, used_up) in enumerate(zip(self.steps, self.used_up, strict=True)):
            if step[0] == "network":
                if called is None:
                    raise TypeError("nothing is said of calls")
                call = self.calls[k]
                given = called(call, [values[operand] for operand in step[2:]])
                values[k] = dict(zip(call.entries, given, strict=True))
            elif step[0] == HEAVISIDE and jump is not None:
                values[k] = jump(values[step[1]])
            else:
                values[k] = evaluated(step, values, names, constant)
            for operand in used_up:
                del values[operand]
        return [values[k] for k in self.results]


def operands_of(step: Step) -> Sequence[int]:
    if step[0] in ("name", "rational"):
        return ()
    return step[2:] if step[0] == "network" else step[1:2] if step[0] == "entry" else step[1:]


def moved(step: Step, place: Mapping[int, int]) -> Step:
    """The same, its operands being at other places."""
    if step[0] in ("name", "rational"):
        return step
    operands = [place[k] for k in operands_of(step)]
    if step[0] == "network":
        return *step[:2], *operands
    return (step[0], *operands, step[2]) if step[0] == "entry" else (step[0], *operands)


def evaluated(step: Step, values: Mapping[int, Any], names: Mapping[str, Any], constant: Callable[[fmpq], Any]) -> Any:
    kind, first = step[0], step[1]
    if kind == "name":
        return names[first]
    if kind == "rational":
        return constant(first)
    if kind == "entry":
        return values[first][step[2]]
    if kind == "+":
        return values[first] + values[step[2]]
    if kind == "*":
        return values[first] * values[step[2]]
    return -values[first] if kind == "-" else values[first].function(kind)


class _Compiler:
    """Checks the grammar and writes the steps down, each once."""

    def __init__(self, names: set[str], at: str, networks: Mapping[str, Network], jumps: bool) -> None:
        self.names, self.at, self.networks, self.jumps, self.nodes = names, at, networks, jumps, 0
        self.steps, self.rationals = dict[Step, int](), dict[int, fmpq]()

    def step(self, *step: Any) -> int:
        """The number of a step; what is made of rationals by + * - 1/ is a rational."""
        if step[0] in RATIONALLY:
            known = [self.rationals[operand] for operand in step[1:] if operand in self.rationals]
            if len(known) == len(step) - 1:
                step = ("rational", self.computed(step[0], known))
        number = self.steps.setdefault(step, len(self.steps))
        if step[0] == "rational":
            self.rationals[number] = step[1]
        return number

    def computed(self, kind: str, operands: Sequence[fmpq]) -> fmpq:
        require(kind != "1/" or bool(operands[0] != 0), "format", self.at, "a division by the number 0")
        value = RATIONALLY[kind](*operands)
        require(value.height_bits() <= MAX_BITS, "format", self.at, f"a number of more than {MAX_BITS} bits")
        return value

    def compile(self, node: Any, at: str, depth: int = 0) -> int:
        self.nodes += 1
        require(self.nodes <= MAX_NODES, "format", at, f"more than {MAX_NODES} nodes in the equations")
        if isinstance(node, str):
            return self.step("name", node) if node in self.names else self.step("rational", rational(node, at))
        well_formed = isinstance(node, list) and len(node) > 1 and isinstance(node[0], str)
        require(well_formed, "format", at, "an expression was expected")
        require(depth < MAX_NESTING, "format", at, f"expressions nest more than {MAX_NESTING} deep")
        name, *rest = node
        if name == "network":
            return self.call(rest, at, depth)
        if name == "**":
            good = len(rest) == 2 and type(rest[1]) is int and 0 < abs(rest[1]) <= 64
            require(good, "format", at, "the exponent must be an integer, not 0 and at most 64 in magnitude")
            result = self.power(self.compile(rest[0], at, depth + 1), abs(rest[1]))
            return result if rest[1] > 0 else self.step("1/", result)
        require(self.jumps or name != HEAVISIDE, "format", at, "a jump was not expected here")
        least, most = OPERANDS.get(name, (1, 0))
        require(least <= len(rest) <= most, "format", at, "an operator with its number of operands was expected")
        return self.operation(name, [self.compile(operand, at, depth + 1) for operand in rest])

    def operation(self, name: str, operands: list[int]) -> int:
        first, *others = operands
        if name in (*PLAIN, "abs", HEAVISIDE):
            return self.step(name, first)
        if name == "tan":
            return self.step("*", self.step("sin", first), self.step("1/", self.step("cos", first)))
        if name == "-" and not others:
            return self.step("-", first)
        if name == "clip":
            return self.extreme("min", self.extreme("max", first, others[0]), others[1])
        for other in others:  # from left to right
            if name in ("min", "max"):
                first = self.extreme(name, first, other)
                continue
            term = self.step("-", other) if name == "-" else self.step("1/", other) if name == "/" else other
            first = self.step("+" if name in "+-" else "*", first, term)
        return first

    def extreme(self, name: str, a: int, b: int) -> int:
        """The lesser or the greater of two: half of their sum, and of how far they are apart."""
        apart = self.step("abs", self.step("+", a, self.step("-", b)))
        if name == "min":
            apart = self.step("-", apart)
        return self.step("*", self.step("rational", HALF), self.step("+", self.step("+", a, b), apart))

    def call(self, rest: list[Any], at: str, depth: int) -> int:
        """An entry of the value of a network."""
        name, i, *arguments = rest if len(rest) >= 2 else (None, None)
        network = self.networks.get(name) if isinstance(name, str) else None
        if network is None or type(i) is not int or not 0 <= i < network.size or len(arguments) != network.reads:
            raise Refused("format", at, "a network's name, a number of its value's and its arguments were expected")
        operands = [self.compile(operand, at, depth + 1) for operand in arguments]
        return self.step("entry", self.step("network", name, *operands), i)

    def power(self, base: int, k: int) -> int:
        """The square of the power of half the exponent, times the base if k is odd."""
        if k == 1:
            return base
        half = self.power(base, k // 2)
        square = self.step("*", half, half)
        return self.step("*", square, base) if k % 2 else square


def equations(
    nodes: Sequence[Any],
    names: set[str],
    at: str,
    networks: Mapping[str, Network] = MappingProxyType({}),
    jumps: bool = False,
) -> Equations:
    """Rule `format` for expressions in some names, which may call these networks, and may have jumps or not."""
    compiler = _Compiler(names, at, networks, jumps)
    results = [compiler.compile(node, f"{at}.{i}") for i, node in enumerate(nodes)]
    steps, wanted = list(compiler.steps), set(results)
    for k in reversed(range(len(steps))):
        wanted |= set(operands_of(steps[k])) if k in wanted else set()
    require(len(wanted) <= MAX_NODES, "format", at, f"more than {MAX_NODES} operations in the equations")
    place = {k: number for number, k in enumerate(sorted(wanted))}
    kept = tuple(moved(steps[k], place) for k in place)
    used = dict[int, list[int]]()
    for step in kept:
        if step[0] == "entry":
            used.setdefault(step[1], []).append(step[2])
    calls, count = dict[int, Call](), 0
    for k in sorted(used):
        calls[k] = Call(networks[kept[k][1]], tuple(used[k]), count)
        count += len(used[k])
    found = Equations(kept, tuple(place[k] for k in results), calls)
    require(found.jumps <= MAX_JUMPS, "format", at, f"more than {MAX_JUMPS} different jumps in the equations")
    return found
