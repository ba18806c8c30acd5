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
from typing import Any

from flint import fmpq

from .refusal import require

MAX_NESTING, MAX_NODES = 200, 20_000  # of lists; of lists, names and numbers in all equations
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
}
MAX_BITS = 2**14  # of a numerator or a denominator
RATIONALLY: Mapping[str, Callable[..., fmpq]] = {
    "+": operator.add,
    "*": operator.mul,
    "-": operator.neg,
    "1/": lambda q: 1 / q,
}
PLAIN = ("sin", "cos", "tanh", "exp", "atan", "sqrt")  # functions that are one operation

Step = tuple[Any, ...]  # ("name", str), ("rational", fmpq), or a name and the numbers of earlier steps


def rational(text: Any, at: str) -> fmpq:
    require(isinstance(text, str) and RATIONAL.fullmatch(text) is not None, "format", at, "a rational was expected")
    numerator, _, denominator = text.partition("/")
    return fmpq(int(numerator), int(denominator or 1))


@dataclass(frozen=True)
class Equations:
    """`steps` in an order in which they can be evaluated; `results` are the steps whose values are the equations'."""

    steps: tuple[Step, ...]
    results: tuple[int, ...]

    @cached_property
    def used_up(self) -> list[list[int]]:
        """For each step the earlier ones that no later step asks for, nor a result."""
        last = {operand: k for k, step in enumerate(self.steps) for operand in operands_of(step)}
        found: list[list[int]] = [[] for _ in self.steps]
        for operand, k in last.items():
            if operand not in self.results:
                found[k].append(operand)
        return found

    def evaluate(self, names: Mapping[str, Any], constant: Callable[[fmpq], Any]) -> list[Any]:
        """Over anything that has `+`, `*`, unary `-` and `function(name)`; `1/` is a function.

        A value is dropped after its last use: a model of many variables is large.
        """
        values: dict[int, Any] = {}
        for k, (step, used_up) in enumerate(zip(self.steps, self.used_up, strict=True)):
            values[k] = evaluated(step, values, names, constant)
            for operand in used_up:
                del values[operand]
        return [values[k] for k in self.results]


def operands_of(step: Step) -> Sequence[int]:
    return () if step[0] in ("name", "rational") else step[1:]


def evaluated(step: Step, values: Mapping[int, Any], names: Mapping[str, Any], constant: Callable[[fmpq], Any]) -> Any:
    kind, first = step[0], step[1]
    if kind == "name":
        return names[first]
    if kind == "rational":
        return constant(first)
    if kind == "+":
        return values[first] + values[step[2]]
    if kind == "*":
        return values[first] * values[step[2]]
    return -values[first] if kind == "-" else values[first].function(kind)


class _Compiler:
    """Checks the grammar and writes the steps down, each once."""

    def __init__(self, names: set[str], at: str) -> None:
        self.names, self.at, self.nodes = names, at, 0
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
        if name == "**":
            good = len(rest) == 2 and type(rest[1]) is int and 0 < abs(rest[1]) <= 64
            require(good, "format", at, "the exponent must be an integer, not 0 and at most 64 in magnitude")
            result = self.power(self.compile(rest[0], at, depth + 1), abs(rest[1]))
            return result if rest[1] > 0 else self.step("1/", result)
        least, most = OPERANDS.get(name, (1, 0))
        require(least <= len(rest) <= most, "format", at, "an operator with its number of operands was expected")
        first, *others = [self.compile(operand, at, depth + 1) for operand in rest]
        if name in PLAIN:
            return self.step(name, first)
        if name == "tan":
            return self.step("*", self.step("sin", first), self.step("1/", self.step("cos", first)))
        if name == "-" and not others:
            return self.step("-", first)
        for other in others:  # from left to right
            term = self.step("-", other) if name == "-" else self.step("1/", other) if name == "/" else other
            first = self.step("+" if name in "+-" else "*", first, term)
        return first

    def power(self, base: int, k: int) -> int:
        """The square of the power of half the exponent, times the base if k is odd."""
        if k == 1:
            return base
        half = self.power(base, k // 2)
        square = self.step("*", half, half)
        return self.step("*", square, base) if k % 2 else square


def equations(nodes: Sequence[Any], names: set[str], at: str) -> Equations:
    """Rule `format` for the expressions of a plant."""
    compiler = _Compiler(names, at)
    results = [compiler.compile(node, f"{at}.{i}") for i, node in enumerate(nodes)]
    steps, wanted = list(compiler.steps), set(results)
    for k in reversed(range(len(steps))):
        wanted |= set(operands_of(steps[k])) if k in wanted else set()
    place = {k: number for number, k in enumerate(sorted(wanted))}
    kept = [(s[0], *(place[k] for k in s[1:])) if operands_of(s) else s for s in (steps[k] for k in place)]
    return Equations(tuple(kept), tuple(place[k] for k in results))
