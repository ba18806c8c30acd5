"""The plant's equations: a JSON tree becomes a tape of operations, each evaluated once.

A leaf is a name or an exact fraction; a node is `["+", a, b, ...]`, `["*", a, b, ...]`, `["-", a]`,
`["-", a, b]`, `["/", a, b]`, `["**", a, k]` with an integer k, `[f, a]` with a function f, or a call of a network,
`["network", name, i, a, ...]`. Powers and tan are expanded here, so that an arithmetic needs only +, *, unary -,
`function` for inv and the others, and a function that calls networks. The result of +, *, - and inv on rationals alone
is a rational, computed here. abs is a function; `["min", a, b, ...]`, `["max", a, b, ...]` and `["clip", v, lo, hi]`
are written with it. Where equations may jump, `["heaviside", a]` is an operation whose value is chosen: 0 or 1.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property, reduce
from typing import TYPE_CHECKING, Any

from . import strict
from .schema import Value

if TYPE_CHECKING:
    from .networks import Network

MAX_OPERATIONS, MAX_DEPTH, MAX_EXPONENT = 20_000, 200, 64
MAX_JUMPS = 6  # heavisides of equations
MAX_BITS = 2**14  # of a numerator or a denominator
_OPERATORS: dict[str, Callable[..., Any]] = {"+": operator.add, "*": operator.mul, "neg": operator.neg}
Part = int | Fraction  # of an operation: an index on the tape, or a number that stands on it only if it has to


@dataclass(frozen=True)
class Operation:
    """An operation on earlier values, by their indices; a rational, a name's number, a network or an entry's number is
    its detail."""

    name: str
    operands: tuple[int, ...] = ()
    detail: Any = None


@dataclass(frozen=True)
class Call:
    """A call of a network, of whose value these entries are used; `first` counts those of the calls before."""

    network: Network
    entries: tuple[int, ...]
    first: int


@dataclass(frozen=True)
class Tape:
    """`operations` in order of evaluation; `outputs` index the n components of f; `trees` are for people."""

    operations: tuple[Operation, ...]
    outputs: tuple[int, ...]
    trees: tuple[Any, ...]

    @cached_property
    def calls(self) -> dict[int, Call]:
        """The calls, by their index on the tape."""
        used: dict[int, list[int]] = {k: [] for k, operation in enumerate(self.operations) if operation.name == "call"}
        for operation in self.operations:
            if operation.name == "entry":
                used[operation.operands[0]].append(operation.detail)
        found, first = dict[int, Call](), 0
        for k, entries in used.items():
            found[k] = Call(self.operations[k].detail, tuple(sorted(entries)), first)
            first += len(entries)
        return found

    @property
    def called(self) -> list[Network]:
        """The network of each call."""
        return [call.network for call in self.calls.values()]

    @property
    def entries(self) -> int:
        """The number of entries of calls."""
        return sum(len(call.entries) for call in self.calls.values())

    @property
    def jumps(self) -> int:
        """The number of heavisides."""
        return sum(operation.name == "heaviside" for operation in self.operations)

    @property
    def size(self) -> int:
        """The number of operations, with those in networks, for each call."""
        return len(self.operations) + sum(network.operations for network in self.called)


def evaluate(
    tape: Tape, constant: Callable[[Fraction], Any], variables: Sequence[Any], calling: Any = None, choose: Any = None
) -> list[Any]:
    """The outputs of `tape` at `variables` (states, inputs, uncertain quantities), in their arithmetic;
    `calling` gives the entries that a call uses, of it and its arguments; `choose` the value of a heaviside, of its
    argument."""
    values: list[Any] = []
    for k, operation in enumerate(tape.operations):
        given, detail = [values[i] for i in operation.operands], operation.detail
        match operation.name:
            case "const":
                value = constant(detail)
            case "var":
                value = variables[detail]
            case "call":
                value = dict(zip(tape.calls[k].entries, calling(tape.calls[k], given), strict=True))
            case "entry":
                value = given[0][detail]
            case "heaviside" if choose is not None:
                value = choose(*given)
            case "+" | "*" | "neg":
                value = _OPERATORS[operation.name](*given)
            case name:
                value = given[0].function(name)
        values.append(value)
    return [values[i] for i in tape.outputs]


def parse(
    trees: Sequence[Any],
    names: Sequence[str],
    at: str,
    networks: Mapping[str, Network] | None = None,
    jumping: bool = False,
) -> Tape:
    """Compile trees over `names`, which stand at this place, may call networks, and may have heavisides if they are
    `jumping`; raises `Rejected` under rule `format`."""
    builder = _Builder({name: i for i, name in enumerate(names)}, at, networks or {}, jumping)
    outputs = tuple(builder.index(builder.build(tree, f"{at}[{i}]", 0)) for i, tree in enumerate(trees))
    tape = Tape(tuple(operation for _, operation in builder.tape.values()), outputs, tuple(trees))
    if tape.jumps > MAX_JUMPS:
        strict.fail(at, f"more than {MAX_JUMPS} different heavisides")
    return tape


def load(function: str) -> None:
    """Add the function's row to the table of functions, if it is one that only some certificates need."""
    if function in ("inv", "exp", "atan", "sqrt"):
        from . import smooth

        smooth.add()
    elif function not in (*_OPERATORS, "sin", "cos", "tanh"):
        from . import activations

        activations.add()


class _Builder:
    """Appends operations; an operation that already stands on the tape is shared."""

    def __init__(self, names: dict[str, int], at: str, networks: Mapping[str, Network], jumping: bool) -> None:
        self.names, self.at, self.networks, self.jumping, self.visited = names, at, networks, jumping, 0
        self.tape: dict[str, tuple[int, Operation]] = {}  # by strings, whose hashes nobody can predict

    def apply(self, name: str, *parts: Part) -> Part:
        """An operation on parts; a number where all of them are numbers, and it is not a function's."""
        numbers = [part for part in parts if isinstance(part, Fraction)]
        if len(numbers) < len(parts) or (name not in _OPERATORS and name != "inv"):
            load(name)
            return self.push(name, tuple(map(self.index, parts)))
        if name == "inv" and numbers[0] == 0:
            strict.fail(self.at, "a division by the number 0")
        made: Fraction = 1 / numbers[0] if name == "inv" else _OPERATORS[name](*numbers)
        if max(made.numerator.bit_length(), made.denominator.bit_length()) > MAX_BITS:
            strict.fail(self.at, f"a number of more than {MAX_BITS} bits")
        return made

    def index(self, part: Part) -> int:
        """The position of a part on the tape."""
        return self.push("const", detail=part) if isinstance(part, Fraction) else part

    def push(self, name: str, operands: tuple[int, ...] = (), detail: Any = None) -> int:
        key = " ".join([name, *map(str, operands), _word(detail)])
        index, _ = self.tape.setdefault(key, (len(self.tape), Operation(name, operands, detail)))
        if index >= MAX_OPERATIONS:
            strict.fail(self.at, f"more than {MAX_OPERATIONS} operations")
        return index

    def build(self, tree: Any, at: str, depth: int) -> Part:
        """The tree's value: a number, or its index on the tape."""
        self.visited += 1
        if depth > MAX_DEPTH or self.visited > MAX_OPERATIONS:
            strict.fail(at, f"deeper than {MAX_DEPTH} or more than {MAX_OPERATIONS} nodes")
        if isinstance(tree, str) and tree in self.names:
            return self.push("var", detail=self.names[tree])
        if isinstance(tree, str):
            return Value(tree, at).rational()
        if not isinstance(tree, list) or len(tree) < 2 or not isinstance(tree[0], str):
            strict.fail(at, "a node must be a list: an operator and its operands")
        name, *arguments = tree
        if name == "network":
            return self.call(arguments, at, depth)
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
            case (("sin" | "cos" | "tanh" | "exp" | "atan" | "sqrt" | "abs"), [a]):
                return self.apply(name, a)
            case "heaviside", [a] if self.jumping:
                return self.push(name, (self.index(a),))
            case "tan", [a]:
                return self.apply("*", self.apply("sin", a), self.apply("inv", self.apply("cos", a)))
            case (("min" | "max"), [first, *others]) if others:
                return reduce(lambda a, b: self.extreme(name, a, b), others, first)
            case "clip", [v, lo, hi]:
                return self.extreme("min", self.extreme("max", v, lo), hi)
        strict.fail(at, f"operator {name[:20]!a} with {len(arguments)} operands is not in the grammar")

    def extreme(self, name: str, a: Part, b: Part) -> Part:
        """The larger of two numbers, (a + b + |a - b|)/2, or the lesser one, with -|a - b|."""
        apart = self.apply("abs", self.apply("+", a, self.apply("neg", b)))
        apart = apart if name == "max" else self.apply("neg", apart)
        return self.apply("*", Fraction(1, 2), self.apply("+", self.apply("+", a, b), apart))

    def call(self, arguments: list[Any], at: str, depth: int) -> Part:
        """An entry of a network's value; calls with the same arguments are one."""
        name, entry, *given = [*arguments, None, None][: max(2, len(arguments))]
        network = self.networks.get(name) if isinstance(name, str) else None
        if network is None or type(entry) is not int or not 0 <= entry < network.gives or len(given) != network.reads:
            strict.fail(at, "a call must name a network, an entry of its value, and its arguments")
        operands = tuple(self.index(self.build(a, at, depth + 1)) for a in given)
        return self.push("entry", (self.push("call", operands, network),), entry)

    def power(self, base: Part, exponent: Any, at: str) -> Part:
        if type(exponent) is not int or not 0 < abs(exponent) <= MAX_EXPONENT:
            strict.fail(at, f"an exponent must be a nonzero integer up to {MAX_EXPONENT}")
        result = base
        for bit in bin(abs(exponent))[3:]:
            result = self.apply("*", result, result)
            if bit == "1":
                result = self.apply("*", result, base)
        return result if exponent > 0 else self.apply("inv", result)


def _word(detail: Any) -> str:
    """A detail, for the tape's keys; Python writes no integer of more than 4,300 decimal digits."""
    if isinstance(detail, Fraction):
        return f"{detail.numerator:x}/{detail.denominator:x}"
    return str(getattr(detail, "name", detail))
