"""The plant's equations: a JSON tree becomes a tape of operations, each evaluated once.

A leaf is a name or an exact fraction; a node is `["+", a, b, ...]`, `["*", a, b, ...]`, `["-", a]`,
`["-", a, b]`, `["/", a, b]`, `["**", a, k]` with an integer k, `["sin", a]`, `["cos", a]` or `["tan", a]`.
Powers and tan are expanded here, so that an arithmetic needs only +, *, unary -, inv, sin and cos.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import reduce
from typing import Any, Self, TypeVar

from . import schema, strict

MAX_OPERATIONS, MAX_DEPTH, MAX_EXPONENT = 20_000, 200, 64
Operation = tuple[Any, ...]  # ("const", q) | ("var", i) | (name, operand indices ...)
_METHODS: dict[str, Callable[..., Any]] = {
    **{name: getattr(operator, name) for name in ("add", "mul", "neg")},
    **{name: operator.methodcaller(name) for name in ("inv", "sin", "cos")},
}
V = TypeVar("V")


class Functions:
    """The functions of an arithmetic, all by one method of its own: `function("inv")`, `"sin"`, `"cos"`."""

    def function(self, name: str) -> Self:
        raise NotImplementedError

    def inv(self) -> Self:
        return self.function("inv")

    def sin(self) -> Self:
        return self.function("sin")

    def cos(self) -> Self:
        return self.function("cos")


@dataclass(frozen=True)
class Tape:
    """`operations` in order of evaluation; `outputs` index the n components of f; `trees` are for people."""

    operations: tuple[Operation, ...]
    outputs: tuple[int, ...]
    trees: tuple[Any, ...]


def evaluate(tape: Tape, constant: Callable[[Fraction], V], variables: Sequence[V]) -> list[V]:
    """The outputs of `tape` at `variables` (states, then inputs), in the arithmetic of these; a value is kept no
    longer than it is needed."""
    last = {i: k for k, operation in enumerate(tape.operations) if operation[0] in _METHODS for i in operation[1:]}
    values: dict[int, V] = {}
    for k, (name, *operands) in enumerate(tape.operations):
        if name == "const":
            values[k] = constant(operands[0])
        elif name == "var":
            values[k] = variables[operands[0]]
        else:
            values[k] = _METHODS[name](*[values[i] for i in operands])
            for i in set(operands):
                if last[i] == k and i not in tape.outputs:
                    del values[i]
    return [values[i] for i in tape.outputs]


def parse_dynamics(trees: Sequence[Any], names: Sequence[str]) -> Tape:
    """Compile n trees over `names`; raises `Rejected` under rule `format`."""
    builder = _Builder({name: i for i, name in enumerate(names)})
    outputs = tuple(builder.build(tree, f"plant.dynamics[{i}]", 0) for i, tree in enumerate(trees))
    return Tape(tuple(builder.operations), outputs, tuple(trees))


class _Builder:
    """Appends operations; an operation that already stands on the tape is shared."""

    def __init__(self, names: dict[str, int]) -> None:
        self.names = names
        self.operations: list[Operation] = []
        self.known: dict[str, int] = {}
        self.visited = 0

    def push(self, *operation: Any) -> int:
        key = " ".join(map(str, operation))  # strings, whose hashes nobody can predict
        if key not in self.known:
            if len(self.operations) >= MAX_OPERATIONS:
                strict.fail("plant.dynamics", f"more than {MAX_OPERATIONS} operations")
            self.known[key] = len(self.operations)
            self.operations.append(operation)
        return self.known[key]

    def build(self, tree: Any, at: str, depth: int) -> int:
        """Index of the tree's value on the tape."""
        self.visited += 1
        if depth > MAX_DEPTH or self.visited > MAX_OPERATIONS:
            strict.fail(at, f"deeper than {MAX_DEPTH} or more than {MAX_OPERATIONS} nodes")
        if isinstance(tree, str):
            if tree in self.names:
                return self.push("var", self.names[tree])
            return self.push("const", schema.rational(tree, at, {}))
        if not isinstance(tree, list) or len(tree) < 2 or not isinstance(tree[0], str):
            strict.fail(at, "a node must be a list: an operator and its operands")
        name, *arguments = tree
        if name == "**" and len(arguments) == 2:
            return self.power(self.build(arguments[0], at, depth + 1), arguments[1], at)
        operands = [self.build(a, at, depth + 1) for a in arguments]
        match name, operands:
            case "+", _:
                return reduce(lambda a, b: self.push("add", a, b), operands)
            case "*", _:
                return reduce(lambda a, b: self.push("mul", a, b), operands)
            case "-", [a]:
                return self.push("neg", a)
            case "-", [a, b]:
                return self.push("add", a, self.push("neg", b))
            case "/", [a, b]:
                return self.push("mul", a, self.push("inv", b))
            case (("sin" | "cos"), [a]):
                return self.push(name, a)
            case "tan", [a]:
                sine, cosine = self.push("sin", a), self.push("cos", a)
                return self.push("mul", sine, self.push("inv", cosine))
        strict.fail(at, f"operator {name[:20]!a} with {len(operands)} operands is not in the grammar")

    def power(self, base: int, exponent: Any, at: str) -> int:
        if type(exponent) is not int or not 0 < abs(exponent) <= MAX_EXPONENT:
            strict.fail(at, f"an exponent must be a nonzero integer up to {MAX_EXPONENT}")
        result = base
        for bit in bin(abs(exponent))[3:]:
            result = self.push("mul", result, result)
            if bit == "1":
                result = self.push("mul", result, base)
        return result if exponent > 0 else self.push("inv", result)
