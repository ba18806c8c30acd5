"""The plant's equations: a JSON tree becomes a tape of operations, each evaluated once.

A leaf is a name or an exact fraction; a node is `["+", a, b, ...]`, `["*", a, b, ...]`, `["-", a]`,
`["-", a, b]`, `["/", a, b]`, `["**", a, k]` with an integer k, or `[f, a]` with a function f.
Powers and tan are expanded here, so that an arithmetic needs only +, *, unary -, and `function` for inv and the others.
The result of these four on rationals alone is a rational, computed here.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import reduce
from typing import Any

from . import strict
from .schema import Value

MAX_OPERATIONS, MAX_DEPTH, MAX_EXPONENT = 20_000, 200, 64
MAX_BITS = 2**14  # of a numerator or a denominator
Operation = tuple[Any, ...]  # ("const", q) | ("var", i) | (name, operand indices ...)
_LEAVES = ("const", "var")
_OPERATORS: dict[str, Callable[..., Any]] = {"+": operator.add, "*": operator.mul, "neg": operator.neg}
Part = int | Fraction  # of an operation: an index on the tape, or a number that stands on it only if it has to


@dataclass(frozen=True)
class Tape:
    """`operations` in order of evaluation; `outputs` index the n components of f; `trees` are for people."""

    operations: tuple[Operation, ...]
    outputs: tuple[int, ...]
    trees: tuple[Any, ...]


def evaluate(tape: Tape, constant: Callable[[Fraction], Any], variables: Sequence[Any]) -> list[Any]:
    """The outputs of `tape` at `variables` (states, inputs, uncertain quantities), in their arithmetic; a value is kept
    no longer than it is needed."""
    last = {i: k for k, (name, *operands) in enumerate(tape.operations) if name not in _LEAVES for i in operands}
    last |= dict.fromkeys(tape.outputs, len(tape.operations))
    values: dict[int, Any] = {}
    for k, (name, *operands) in enumerate(tape.operations):
        if name in _LEAVES:
            values[k] = constant(operands[0]) if name == "const" else variables[operands[0]]
            continue
        a, *b = [values[i] for i in operands]
        values[k] = _OPERATORS[name](a, *b) if name in _OPERATORS else a.function(name)
        for i in set(operands):
            if last[i] == k:
                del values[i]
    return [values[i] for i in tape.outputs]


def parse(trees: Sequence[Any], names: Sequence[str], at: str) -> Tape:
    """Compile trees over `names`, which stand at this place; raises `Rejected` under rule `format`."""
    builder = _Builder({name: i for i, name in enumerate(names)}, at)
    outputs = tuple(builder.index(builder.build(tree, f"{at}[{i}]", 0)) for i, tree in enumerate(trees))
    return Tape(tuple(operation for _, operation in builder.tape.values()), outputs, tuple(trees))


class _Builder:
    """Appends operations; an operation that already stands on the tape is shared."""

    def __init__(self, names: dict[str, int], at: str) -> None:
        self.names, self.at, self.visited = names, at, 0
        self.tape: dict[str, tuple[int, Operation]] = {}  # by strings, whose hashes nobody can predict

    def apply(self, name: str, *parts: Part) -> Part:
        """An operation on parts; a number where all of them are numbers, and it is not a function's."""
        numbers = [part for part in parts if isinstance(part, Fraction)]
        if len(numbers) < len(parts) or (name not in _OPERATORS and name != "inv"):
            return self.push(name, *map(self.index, parts))
        if name == "inv" and numbers[0] == 0:
            strict.fail(self.at, "a division by the number 0")
        made: Fraction = 1 / numbers[0] if name == "inv" else _OPERATORS[name](*numbers)
        if max(made.numerator.bit_length(), made.denominator.bit_length()) > MAX_BITS:
            strict.fail(self.at, f"a number of more than {MAX_BITS} bits")
        return made

    def index(self, part: Part) -> int:
        """The position of a part on the tape."""
        return self.push("const", part) if isinstance(part, Fraction) else part

    def push(self, *operation: Any) -> int:
        index, _ = self.tape.setdefault(" ".join(map(_word, operation)), (len(self.tape), operation))
        if index >= MAX_OPERATIONS:
            strict.fail(self.at, f"more than {MAX_OPERATIONS} operations")
        return index

    def build(self, tree: Any, at: str, depth: int) -> Part:
        """The tree's value: a number, or its index on the tape."""
        self.visited += 1
        if depth > MAX_DEPTH or self.visited > MAX_OPERATIONS:
            strict.fail(at, f"deeper than {MAX_DEPTH} or more than {MAX_OPERATIONS} nodes")
        if isinstance(tree, str) and tree in self.names:
            return self.push("var", self.names[tree])
        if isinstance(tree, str):
            return Value(tree, at).rational()
        if not isinstance(tree, list) or len(tree) < 2 or not isinstance(tree[0], str):
            strict.fail(at, "a node must be a list: an operator and its operands")
        name, *arguments = tree
        if name == "**" and len(arguments) == 2:
            return self.power(self.build(arguments[0], at, depth + 1), arguments[1], at)
        match name, [self.build(a, at, depth + 1) for a in arguments]:
            case (("+" | "*"), operands):
                return reduce(lambda a, b: self.apply(name, a, b), operands)
            case "-", [a]:
                return self.apply("neg", a)
            case "-", [a, b]:
                return self.apply("+", a, self.apply("neg", b))
            case "/", [a, b]:
                return self.apply("*", a, self.apply("inv", b))
            case (("sin" | "cos" | "tanh" | "exp" | "atan" | "sqrt"), [a]):
                return self.apply(name, a)
            case "tan", [a]:
                return self.apply("*", self.apply("sin", a), self.apply("inv", self.apply("cos", a)))
        strict.fail(at, f"operator {name[:20]!a} with {len(arguments)} operands is not in the grammar")

    def power(self, base: Part, exponent: Any, at: str) -> Part:
        if type(exponent) is not int or not 0 < abs(exponent) <= MAX_EXPONENT:
            strict.fail(at, f"an exponent must be a nonzero integer up to {MAX_EXPONENT}")
        result = base
        for bit in bin(abs(exponent))[3:]:
            result = self.apply("*", result, result)
            if bit == "1":
                result = self.apply("*", result, base)
        return result if exponent > 0 else self.apply("inv", result)


def _word(part: Any) -> str:
    """A part of an operation, for the tape's keys; Python writes no integer of more than 4,300 decimal digits."""
    return f"{part.numerator:x}/{part.denominator:x}" if isinstance(part, Fraction) else str(part)
