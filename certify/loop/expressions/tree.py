"""Expressions of plants and Lyapunov functions, as trees that stay as they were written.

Nothing here simplifies. `x*(x - 1)/(x - 1)` has no value at x = 1 and keeps its quotient, `sqrt(x)**2` keeps its root
and `0/(x - 1)` its pole, because the proof must be about the equations as they were written. Equal trees are
one object, so that a repeated subexpression is evaluated once and compared by identity.
"""

from __future__ import annotations

import numbers
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from decimal import Decimal
from fractions import Fraction
from functools import reduce
from typing import Any, TypeVar
from weakref import WeakValueDictionary

from certify.errors import InputError

FUNCTIONS = ("sin", "cos", "tan", "tanh", "exp", "atan", "sqrt")
"""The smooth functions, of one operand."""
CORNERS: Mapping[str, tuple[int, int | None]] = {"abs": (1, 1), "min": (2, None), "max": (2, None), "clip": (3, 3)}
"""The functions with corners, and the least and largest number of their operands."""
JUMP = "heaviside"
"""The function that jumps: 0 of negative numbers, 1 of positive ones, and either of 0; for discrete time."""
NAMED = (*FUNCTIONS, *CORNERS, JUMP)
GRAMMAR = f"+ - * /, integer powers, {', '.join(NAMED)}"
MOST_EXPONENT = 64
MOST_DEPTH = 800  # of a tree; a certificate holds less
E = TypeVar("E", bound="Expression")
_KNOWN: WeakValueDictionary[tuple[Any, ...], Any] = WeakValueDictionary()
_DIGITS = 17  # of a decimal number in text; longer ones are written as fractions
_LOCK = threading.RLock()  # two threads that make the same tree must get the same object


class Expression:
    """A node: a `Symbol`, a `Number`, or an `Operation` on other nodes.

    Python's operators build expressions, numbers among them being `int` and `Fraction`: a float is refused, because
    0.1 is no tenth.

    >>> x = Symbol("x")
    >>> -x * (x - 1) / (x - 1)
    -x*(x - 1)/(x - 1)
    """

    __slots__ = ("__weakref__", "depth", "gathered", "operands")
    operands: tuple[Expression, ...]
    depth: int
    gathered: Expression | None

    def __add__(self, other: object) -> Expression:
        return _joined("+", self, as_expression(other))

    def __radd__(self, other: object) -> Expression:
        return _joined("+", as_expression(other), self)

    def __sub__(self, other: object) -> Expression:
        return _joined("+", self, -as_expression(other))

    def __rsub__(self, other: object) -> Expression:
        return _joined("+", as_expression(other), -self)

    def __mul__(self, other: object) -> Expression:
        return _joined("*", self, as_expression(other))

    def __rmul__(self, other: object) -> Expression:
        return _joined("*", as_expression(other), self)

    def __truediv__(self, other: object) -> Expression:
        return Operation("/", self, as_expression(other))

    def __rtruediv__(self, other: object) -> Expression:
        return Operation("/", as_expression(other), self)

    def __neg__(self) -> Expression:
        return Number(-self.value) if isinstance(self, Number) else Operation("-", self)

    def __pos__(self) -> Expression:
        return self

    def __abs__(self) -> Expression:
        return function("abs", self)

    def __lt__(self, other: object) -> bool:
        raise InputError(
            "expressions have no order, and equations no cases; instead of Python's min and max take certify.minimum "
            "and certify.maximum, and certify.clip for bounds."
        )

    __gt__ = __le__ = __ge__ = __lt__

    def __pow__(self, exponent: object) -> Expression:
        return Operation("**", self, as_expression(exponent))

    def __repr__(self) -> str:
        return text(self)


class Symbol(Expression):
    """A name: a state, an input, a parameter, or an uncertain quantity."""

    __slots__ = ("name",)
    name: str

    def __new__(cls, name: str) -> Symbol:
        def make() -> Symbol:
            made = object.__new__(cls)
            made.name, made.operands, made.depth, made.gathered = name, (), 0, None
            return made

        return _only(("symbol", name), make)

    def __reduce__(self) -> tuple[Any, ...]:
        return Symbol, (self.name,)


class Number(Expression):
    """An exact rational."""

    __slots__ = ("value",)
    value: Fraction

    def __new__(cls, value: Fraction | int) -> Number:
        def make() -> Number:
            made = object.__new__(cls)
            made.value, made.operands, made.depth, made.gathered = Fraction(value), (), 0, None
            return made

        return _only(("number", value), make)

    def __reduce__(self) -> tuple[Any, ...]:
        return Number, (self.value,)


class Operation(Expression):
    """An operator on its operands: `+` and `*` of two or more, `-` of one, `/` of two, `**` of an expression and an
    integer, or one of the functions.

    Raises
    ------
    InputError : an exponent is not an integer from 1 to 64 in magnitude, a function has too few operands or too many,
        or the tree is too deep.
    """

    __slots__ = ("operator",)
    operator: str

    def __new__(cls, operator: str, *operands: Expression) -> Operation:
        def make() -> Operation:
            if operator == "**":
                _require_exponent(*operands)
            _require_operands(operator, len(operands))
            made = object.__new__(cls)
            made.operator, made.operands, made.gathered = operator, operands, None
            made.depth = 1 + max(e.depth for e in operands)
            if made.depth > MOST_DEPTH:
                raise InputError(f"an equation must nest at most {MOST_DEPTH} deep; it nests deeper.")
            return made

        return _only((operator, *operands), make)

    def __reduce__(self) -> tuple[Any, ...]:
        return Operation, (self.operator, *self.operands)

    @property
    def exponent(self) -> int:
        """The integer k of a power `a**k`."""
        k = self.operands[1]
        return int(k.value) if isinstance(k, Number) else 0


def _only(key: tuple[Any, ...], make: Callable[[], E]) -> E:
    """The one object with this key; equal trees are the same object."""
    with _LOCK:
        found: E | None = _KNOWN.get(key)
        if found is None:
            found = _KNOWN[key] = make()
        return found


def as_expression(value: object) -> Expression:
    """An expression as it is, an exact number as a `Number`.

    Raises
    ------
    InputError : it is neither; a float is rounded, and sympy simplifies what it is given.
    """
    if isinstance(value, Expression):
        return value
    if isinstance(value, numbers.Rational) and not isinstance(value, bool):
        return Number(Fraction(int(value.numerator), int(value.denominator)))
    if isinstance(value, float):
        raise InputError(f"an equation holds the rounded number {value}; write exact('{value}') for this decimal.")
    if type(value).__module__.partition(".")[0] == "sympy":
        raise InputError(
            f"an equation holds {value}, which is sympy's and was simplified when it was made; write it with "
            "certify.symbols and certify.sin, or take what sympy made of it with certify.from_sympy."
        )
    raise InputError(f"an equation must be made of symbols, exact numbers and {GRAMMAR}; found {value!r}.")


def symbols(names: str | Iterable[str]) -> tuple[Symbol, ...]:
    """One symbol per name; a text holds names with spaces between them.

    >>> symbols("theta theta_dot u")
    (theta, theta_dot, u)
    """
    return tuple(map(Symbol, names.split() if isinstance(names, str) else names))


def function(name: str, *arguments: object) -> Expression:
    """One of `NAMED`, by its name."""
    return Operation(name, *map(as_expression, arguments))


def sin(x: object) -> Expression:
    """The sine of an angle in radians."""
    return function("sin", x)


def cos(x: object) -> Expression:
    """The cosine of an angle in radians."""
    return function("cos", x)


def tan(x: object) -> Expression:
    """The tangent of an angle in radians: `sin(x)/cos(x)`."""
    return function("tan", x)


def tanh(x: object) -> Expression:
    """The hyperbolic tangent."""
    return function("tanh", x)


def exp(x: object) -> Expression:
    """The exponential."""
    return function("exp", x)


def atan(x: object) -> Expression:
    """The arc tangent, in radians."""
    return function("atan", x)


def sqrt(x: object) -> Expression:
    """The square root; a proof needs a positive argument."""
    return function("sqrt", x)


def minimum(*values: object) -> Expression:
    """The least of two or more."""
    return function("min", *values)


def maximum(*values: object) -> Expression:
    """The largest of two or more."""
    return function("max", *values)


def clip(value: object, lo: object, hi: object) -> Expression:
    """The value, or the nearer of the ends where it lies beyond them: `min(max(value, lo), hi)`.

    >>> clip(2 * Symbol("u"), -1, 1), abs(Symbol("x"))
    (clip(2*u, -1, 1), abs(x))
    """
    return function("clip", value, lo, hi)


def heaviside(x: object) -> Expression:
    """1 of positive numbers, 0 of negative ones; at 0 it may be either, at each step anew."""
    return function(JUMP, x)


def in_absolute_values(expression: Expression) -> Expression:
    """The tree with each min, max and clip written with abs, as FORMAT.md says; it has the same values.

    >>> in_absolute_values(maximum(Symbol("x"), 1))
    0.5*(x + 1 + abs(x - 1))
    """
    found: dict[Expression, Expression] = {}
    for node in nodes(expression):
        operands = [found[e] for e in node.operands]
        match node:
            case Operation(operator="min" | "max" as name):
                found[node] = reduce(lambda a, b: _extreme(name, a, b), operands)
            case Operation(operator="clip"):
                found[node] = _extreme("min", _extreme("max", *operands[:2]), operands[2])
            case Operation(operator=name):
                found[node] = Operation(name, *operands) if (*operands,) != node.operands else node
            case _:
                found[node] = node
    return found[expression]


def _extreme(name: str, a: Expression, b: Expression) -> Expression:
    apart = abs(a - b)
    return Number(Fraction(1, 2)) * Operation("+", a, b, apart if name == "max" else -apart)


def total(terms: Iterable[Expression]) -> Expression:
    """The sum of these; 0 if there are none."""
    found = tuple(terms)
    return Operation("+", *found) if len(found) > 1 else found[0] if found else Number(0)


def nodes(*expressions: Expression) -> Iterator[Expression]:
    """Every different node once, operands first."""
    seen: set[Expression] = set()
    waiting = [(e, False) for e in reversed(expressions)]
    while waiting:
        node, ready = waiting.pop()
        if ready:
            yield node
        elif node not in seen:
            seen.add(node)
            waiting.append((node, True))
            waiting += [(e, False) for e in reversed(node.operands)]


def symbols_of(*expressions: Expression) -> set[Symbol]:
    """The symbols of the expressions."""
    return {node for node in nodes(*expressions) if isinstance(node, Symbol)}


def cornered(*expressions: Expression) -> Iterator[Operation]:
    """The parts that are abs, min, max or clip of others."""
    return (node for node in nodes(*expressions) if isinstance(node, Operation) and node.operator in CORNERS)


def jumping(*expressions: Expression) -> list[Operation]:
    """The different parts that are heavisides of others."""
    return [node for node in nodes(*expressions) if isinstance(node, Operation) and node.operator == JUMP]


def substitute(expression: Expression, values: Mapping[Any, Expression]) -> Expression:
    """The tree with some of its nodes replaced, all at once, and nothing simplified: a replacement stays whole."""
    found: dict[Expression, Expression] = {}
    for node in nodes(expression):
        operands = tuple(found[e] for e in node.operands)
        changed = isinstance(node, Operation) and operands != node.operands
        found[node] = Operation(node.operator, *operands) if changed and isinstance(node, Operation) else node
        found[node] = values.get(node, found[node])
    return found[expression]


def _joined(operator: str, left: Expression, right: Expression) -> Expression:
    """A sum or product from left to right: `a + b + c` is one sum of three, as in FORMAT.md."""
    chain = isinstance(left, Operation) and left.operator == operator
    return Operation(operator, *(left.operands if chain else (left,)), right)


def _require_exponent(base: Expression, exponent: Expression) -> None:
    k = exponent.value if isinstance(exponent, Number) else None
    if k == 0:
        raise InputError(f"{base} to the power 0 is 1 wherever it has a value; write 1.")
    if k is None or k.denominator != 1 or abs(k) > MOST_EXPONENT:
        raise InputError(f"an exponent must be an integer of at most {MOST_EXPONENT} in magnitude; found {exponent}.")


def _require_operands(name: str, found: int) -> None:
    least, most = CORNERS.get(name, (1, 1 if name in (*FUNCTIONS, JUMP) else None))
    if found < least or (most is not None and found > most):
        wanted = str(most) if least == most else f"at least {least}"
        raise InputError(f"{name} must have {wanted} operand{'s' if wanted[-1] != '1' else ''}; found {found}.")


SUM, PRODUCT, MINUS, POWER, ATOM = range(5)
"""The binding of a node: one that binds less than its place asks for is put into brackets."""


def binding(node: Expression) -> int:
    """The precedence of a node in written text."""
    if isinstance(node, Number):
        plain = decimal_text(node.value) is not None
        return PRODUCT if not plain else MINUS if node.value < 0 else ATOM
    if not isinstance(node, Operation):
        return ATOM
    return {"+": SUM, "*": PRODUCT, "/": PRODUCT, "-": MINUS, "**": POWER}.get(node.operator, ATOM)


def text(expression: Expression) -> str:
    """Write an expression as a plant file does; reading the text gives an expression of the same value.

    >>> g, l, x = symbols(["g", "l", "x"])
    >>> text(g / l * sin(x) - x / (l * x**2))
    'g/l*sin(x) - x/(l*x**2)'
    """
    return _Text({})(expression, SUM)


class _Text:
    def __init__(self, known: dict[Expression, str]) -> None:
        self.known = known

    def __call__(self, node: Expression, at_least: int) -> str:
        if node not in self.known:
            self.known[node] = self._written(node)
        return f"({self.known[node]})" if binding(node) < at_least else self.known[node]

    def _written(self, node: Expression) -> str:
        if isinstance(node, Symbol):
            return node.name
        if isinstance(node, Number):
            return decimal_text(node.value) or str(node.value)
        if not isinstance(node, Operation):
            return object.__repr__(node)
        first, *rest = node.operands
        if node.operator == "+":
            return self(first, SUM) + "".join(map(self._term, rest))
        if node.operator == "*":
            return "*".join([self(first, PRODUCT), *(self(e, POWER) for e in rest)])
        if node.operator == "/":
            return f"{self(first, PRODUCT)}/{self(rest[0], POWER)}"
        if node.operator == "-":
            return f"-{self(first, POWER)}"
        if node.operator == "**":
            return f"{self(first, ATOM)}**{node.exponent if node.exponent > 0 else f'({node.exponent})'}"
        return f"{node.operator}({', '.join(self(e, SUM) for e in node.operands)})"

    def _term(self, node: Expression) -> str:
        """` + b`, or ` - b` for a term that begins with a minus."""
        if isinstance(node, Operation) and node.operator == "-":
            return f" - {self(node.operands[0], PRODUCT)}"
        if isinstance(node, Number) and node.value < 0:
            return f" - {self(Number(-node.value), PRODUCT)}"
        return f" + {self(node, PRODUCT)}"


def decimal_text(q: Fraction) -> str | None:
    """A rational in decimal digits, if a few are exact.

    >>> decimal_text(Fraction(981, 100)), decimal_text(Fraction(1, 3))
    ('9.81', None)
    """
    if abs(q) >= 10**_DIGITS:
        return str(q) if q.denominator == 1 else None
    short = f"{Decimal(q.numerator) / Decimal(q.denominator):.{_DIGITS}g}"
    return short if "e" not in short and Fraction(short) == q else None
