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
from typing import Any, TypeVar

from .errors import Rejected

MAX_OPERATIONS, MAX_DEPTH, MAX_EXPONENT = 20_000, 200, 64
Operation = tuple[Any, ...]  # ("const", q) | ("var", i) | (name, operand indices ...)
_METHODS: dict[str, Callable[..., Any]] = {
    **{name: getattr(operator, name) for name in ("add", "mul", "neg")},
    **{name: operator.methodcaller(name) for name in ("inv", "sin", "cos")},
}
V = TypeVar("V")


@dataclass(frozen=True)
class Tape:
    """`operations` in order of evaluation; `outputs` index the n components of f; `text` is for people."""

    operations: tuple[Operation, ...]
    outputs: tuple[int, ...]
    text: tuple[str, ...]


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


def parse_dynamics(trees: list[Any], names: Sequence[str], rational: Callable[[Any, str], Fraction]) -> Tape:
    """Compile n trees over `names`; raises `Rejected` under rule `format`."""
    builder = _Builder({name: i for i, name in enumerate(names)}, rational)
    outputs, text = [], []
    for i, tree in enumerate(trees):
        index, words = builder.build(tree, f"plant.dynamics[{i}]", 0)
        outputs.append(index)
        text.append(words)
    return Tape(tuple(builder.operations), tuple(outputs), tuple(text))


class _Builder:
    """Appends operations; an operation that already stands on the tape is shared."""

    def __init__(self, names: dict[str, int], rational: Callable[[Any, str], Fraction]) -> None:
        self.names, self.rational = names, rational
        self.operations: list[Operation] = []
        self.known: dict[str, int] = {}
        self.visited = 0

    def push(self, *operation: Any) -> int:
        key = " ".join(map(str, operation))  # strings, whose hashes nobody can predict
        if key not in self.known:
            if len(self.operations) >= MAX_OPERATIONS:
                raise Rejected("format", "plant.dynamics", f"more than {MAX_OPERATIONS} operations")
            self.known[key] = len(self.operations)
            self.operations.append(operation)
        return self.known[key]

    def build(self, tree: Any, at: str, depth: int) -> tuple[int, str]:
        """Index of the tree's value on the tape, and the tree in words."""
        self.visited += 1
        if depth > MAX_DEPTH or self.visited > MAX_OPERATIONS:
            raise Rejected("format", at, f"deeper than {MAX_DEPTH} or more than {MAX_OPERATIONS} nodes")
        if isinstance(tree, str):
            if tree in self.names:
                return self.push("var", self.names[tree]), tree
            q = self.rational(tree, at)
            return self.push("const", q), str(q) if q >= 0 and q.denominator == 1 else f"({q})"
        if not isinstance(tree, list) or len(tree) < 2 or not isinstance(tree[0], str):
            raise Rejected("format", at, "a node must be a list: an operator and its operands")
        name, arguments = tree[0], tree[1:]
        if name == "**" and len(arguments) == 2:
            base, words = self.build(arguments[0], at, depth + 1)
            return self.power(base, arguments[1], at), f"({words}**{arguments[1]})"
        indices, words_of = zip(*(self.build(a, at, depth + 1) for a in arguments), strict=True)
        if name in ("+", "*"):
            result = indices[0]
            for index in indices[1:]:
                result = self.push("add" if name == "+" else "mul", result, index)
            return result, "(" + f" {name} ".join(words_of) + ")"
        if name == "-" and len(indices) == 1:
            return self.push("neg", indices[0]), f"(-{words_of[0]})"
        if name == "-" and len(indices) == 2:
            return self.push("add", indices[0], self.push("neg", indices[1])), f"({words_of[0]} - {words_of[1]})"
        if name == "/" and len(indices) == 2:
            return self.push("mul", indices[0], self.push("inv", indices[1])), f"({words_of[0]} / {words_of[1]})"
        if name in ("sin", "cos") and len(indices) == 1:
            return self.push(name, indices[0]), f"{name}({words_of[0]})"
        if name == "tan" and len(indices) == 1:
            sine, cosine = self.push("sin", indices[0]), self.push("cos", indices[0])
            return self.push("mul", sine, self.push("inv", cosine)), f"tan({words_of[0]})"
        raise Rejected("format", at, f"operator {name[:20]!a} with {len(indices)} operands is not in the grammar")

    def power(self, base: int, exponent: Any, at: str) -> int:
        if type(exponent) is not int or not 0 < abs(exponent) <= MAX_EXPONENT:
            raise Rejected("format", at, f"an exponent must be a nonzero integer up to {MAX_EXPONENT}")
        result = base
        for bit in bin(abs(exponent))[3:]:
            result = self.push("mul", result, result)
            if bit == "1":
                result = self.push("mul", result, base)
        return result if exponent > 0 else self.push("inv", result)
