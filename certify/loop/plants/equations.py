"""Read equations as people write them, by a small parser on Python's `ast`.

Nothing in the text is executed, and `0.15` is 3/20, because numbers are read as text. The tree is that of the
text: nothing is cancelled, merged or omitted. An error names the symbol at fault and
a correction: equations are typed by hand, and most faults are slips.
"""

from __future__ import annotations

import ast
import difflib
import keyword
import re
from collections.abc import Callable, Iterable, Mapping
from fractions import Fraction

from certify.errors import InputError
from certify.loop.expressions import CORNERS, MOST_EXPONENT, NAMED, Expression, Number, constant_of, function, nodes
from certify.loop.plants.spelling import instead_of, instead_of_call, instead_of_name
from certify.loop.plants.system import exact

_MOST_NODES, _MOST_DEPTH = 20_000, 200  # a certificate holds no more (FORMAT.md)
_OPERATORS = "+ - * /, integer powers with **"


def parse_expression(
    text: str | int | Fraction,
    names: Mapping[str, Expression],
    known: str = "state, input or parameter",
    networks: Mapping[str, Network] | None = None,
) -> Expression:
    """An expression from text such as `(g/l)*sin(theta) - b/(m*l**2)*theta_dot`.

    Parameters
    ----------
    names : allowed names, with their symbols or the expressions that they stand for.
    known : a description of these names, for messages.
    networks : functions that may be called, as in `observer[1](x, y)`: of an entry's number and of arguments.

    Raises
    ------
    InputError : the text is no equation over them; the message names the symbol.
    """
    source = " ".join(str(text).split())  # a long equation may go over several lines
    if not source.isascii():  # Python would read a bold or a wide x as x
        odd = next(c for c in source if not c.isascii())
        raise InputError(f"equation {source!r}: letters, digits and signs must be plain ASCII; found {odd!r}.")
    if "#" in source:  # Python would leave out what follows, and the plant would be another
        raise InputError(f"equation {source!r}: # begins no comment here; put comments outside the text.")
    try:
        tree = ast.parse(source, mode="eval")
        if any(isinstance(node, ast.BitXor) for node in ast.walk(tree)):
            raise InputError(f"equation {source!r}: `^` is no power here; write ** as in x**2.")
        found = _Reader(source, names, known, networks or {}).read(tree.body)
    except (SyntaxError, RecursionError, ValueError, MemoryError) as error:
        if isinstance(error, InputError):
            raise
        hint = "; for a power write **, not ^" if "^" in source else ""
        hint = "; there are no cases: write one formula" if re.search(r"\bif\b", source) else hint
        if not hint and (word := next(filter(keyword.iskeyword, re.findall(r"\w+", source)), None)):
            hint = f"; {word!r} is a word of Python's: take another name"
        reason = error.msg if isinstance(error, SyntaxError) else str(error)
        raise InputError(f"equation {source!r} cannot be read: {reason}{hint}.") from error
    if found.depth > _MOST_DEPTH:
        raise InputError(f"equation {source!r}: written out it must nest at most {_MOST_DEPTH} deep; it nests deeper.")
    if _size(found) > _MOST_NODES:
        raise InputError(f"equation {source!r}: written out it must have at most {_MOST_NODES:,} terms; it has more.")
    return found


def parse_constraint(
    text: str,
    names: Mapping[str, Expression],
    known: str = "state, input, parameter or disturbance",
    networks: Mapping[str, Network] | None = None,
) -> Expression:
    """The expression g of a constraint g < 0: of a comparison `a <= b` or `b >= a` the difference a - b. Strict and
    other comparisons mean the same, since g < 0 is what is proved.

    Raises
    ------
    InputError : the text is no comparison of two expressions.
    """
    sides = parse_comparison(text, names, known, networks)
    if sides is None:
        parse_expression(text, names, known, networks)  # whose message comes first, of a text that cannot be read
        source = " ".join(str(text).split())
        raise InputError(
            f"constraint {source!r}: it must compare two expressions; write '{source} <= 0' if it must not be "
            f"positive, '{source} >= 0' if it must not be negative."
        )
    return difference(*sides)


def difference(smaller: Expression, larger: Expression) -> Expression:
    """The expression that is negative where one is smaller than the other, without a zero that was written."""
    return smaller if larger is Number(0) else smaller - larger


def parse_comparison(
    text: str,
    names: Mapping[str, Expression],
    known: str = "state, input, parameter or disturbance",
    networks: Mapping[str, Network] | None = None,
) -> tuple[Expression, Expression] | None:
    """The smaller and the larger side of a comparison; None where the text is none.

    Raises
    ------
    InputError : the text compares more than two expressions, or otherwise than by order.
    """
    source = " ".join(str(text).split())
    try:
        tree = ast.parse(source, mode="eval").body
    except (SyntaxError, RecursionError, ValueError, MemoryError):
        return None
    if not isinstance(tree, ast.Compare) or not source.isascii() or "#" in source:
        return None
    if len(tree.ops) != 1 or not isinstance(tree.ops[0], ast.Lt | ast.LtE | ast.Gt | ast.GtE):
        raise InputError(
            f"constraint {source!r}: it must compare two expressions by <=, <, >= or >; write two constraints for a "
            "value between two others."
        )
    left, right = (
        parse_expression(source[side.col_offset : side.end_col_offset], names, known, networks)
        for side in (tree.left, tree.comparators[0])
    )
    return (left, right) if isinstance(tree.ops[0], ast.Lt | ast.LtE) else (right, left)


def _size(expression: Expression) -> int:
    """The number of nodes of the tree, with the expressions that its names stand for."""
    known: dict[Expression, int] = {}
    for node in nodes(expression):
        known[node] = 1 + sum(known[e] for e in node.operands)
    return known[expression]


def nearest(name: str, known: Iterable[str]) -> str:
    """`; did you mean 'theta'?` if one of the known names is close, else nothing.

    >>> nearest("thta", ["theta", "omega"]), nearest("q", ["theta"])
    ("; did you mean 'theta'?", '')
    """
    close = difflib.get_close_matches(name, list(known), n=1, cutoff=0.6)
    return f"; did you mean {close[0]!r}?" if close else ""


def decimal(text: str) -> Fraction:
    """The exact value of a decimal literal; one like 1e999999 must not become an integer of a million digits.

    Raises
    ------
    InputError : it is not a finite decimal number, or far out of range.
    """
    plain = text.replace("_", "")
    exponent = plain.lower().partition("e")[2]
    try:
        far = bool(exponent) and abs(int(exponent)) > 400
    except ValueError as error:
        raise InputError(f"number {text!r} must be a decimal such as 0.15 or 1e-3.") from error
    if far:
        raise InputError(f"number {text} is out of range.")
    try:
        return exact(plain)
    except InputError as error:
        raise InputError(f"number {text!r} must be a finite decimal such as 0.15 or 1e-3.") from error


Network = Callable[[int | None, tuple[Expression, ...]], Expression]


class _Reader:
    def __init__(
        self, source: str, names: Mapping[str, Expression], known: str, networks: Mapping[str, Network]
    ) -> None:
        self.source, self.names, self.known, self.networks = source, names, known, networks

    def read(self, node: ast.expr) -> Expression:
        if isinstance(node, ast.Constant) and isinstance(node.value, int | float) and not isinstance(node.value, bool):
            return Number(decimal(self._text(node)))
        if isinstance(node, ast.Name):
            return self._name(node.id)
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.UAdd):
            operand = self.read(node.operand)
            return -operand if isinstance(node.op, ast.USub) else operand
        if isinstance(node, ast.Call):
            return self._call(node)
        if isinstance(node, ast.BinOp):
            return self._operation(node)
        raise self._refuse(
            instead_of(node, self._text(node))
            or f"{self._text(node)!r} is not allowed; allowed are the plant's names, numbers, {_OPERATORS}, "
            f"and the functions {', '.join(NAMED)}"
        )

    def _name(self, name: str) -> Expression:
        if name in self.names:
            return self.names[name]
        if name in NAMED:
            what, example = {1: ("argument", "x"), 2: ("arguments", "x, y"), 3: ("arguments", "x, -1, 1")}[
                CORNERS.get(name, (1, 1))[0]
            ]
            raise self._refuse(f"the function {name} must have its {what} in brackets, as in {name}({example})")
        instead = instead_of_name(name)
        if instead is not None:
            raise self._refuse(f"{name!r} is no {self.known}; {instead}")
        close = nearest(name, self.names) or f"; known are {', '.join(self.names) or 'none'}"
        raise self._refuse(f"{name!r} is no {self.known}{close}")

    def _call(self, node: ast.Call) -> Expression:
        name = self._text(node.func)
        if (called := self._network(node)) is not None:
            return called
        if not isinstance(node.func, ast.Name) or name not in NAMED:
            given = [*node.args, *(keyword.value for keyword in node.keywords)]
            instead = instead_of_call(name, [self._text(a) for a in given], NAMED)
            if instead is not None and name not in self.names:
                raise self._refuse(instead)
            product = name in self.names or not isinstance(node.func, ast.Name | ast.Attribute)
            what = f"{name} is no function; for a product write {name}*(...)" if product else ""
            raise self._refuse(what or f"the function {name} is not supported; supported are {', '.join(NAMED)}")
        least, most = CORNERS.get(name, (1, 1))
        if node.keywords or len(node.args) < least or (most is not None and len(node.args) > most):
            takes = {1: "one argument", 2: "two arguments or more", 3: "three arguments, a value and two ends"}[least]
            raise self._refuse(f"{name} takes {takes}; found {self._text(node)!r}")
        return function(name, *map(self.read, node.args))

    def _network(self, node: ast.Call) -> Expression | None:
        """A call of a network; None for other calls."""
        of, entry = node.func, None
        match of:
            case ast.Subscript(value=inner, slice=ast.Constant(value=int() as number)):
                of, entry = inner, number
        if not isinstance(of, ast.Name) or of.id not in self.networks:
            return None
        if node.keywords or not node.args:
            raise self._refuse(f"{self._text(node)!r} must have arguments, without names")
        try:
            return self.networks[of.id](entry, tuple(map(self.read, node.args)))
        except InputError as error:
            raise error if str(error).endswith(".") else self._refuse(str(error)) from error

    def _operation(self, node: ast.BinOp) -> Expression:
        left, right = self.read(node.left), self.read(node.right)
        if isinstance(node.op, ast.Add):
            return left + right
        if isinstance(node.op, ast.Sub):
            return left - right
        if isinstance(node.op, ast.Mult):
            return left * right
        if isinstance(node.op, ast.Div):
            if self._number(right) == 0:
                raise self._refuse(f"{self._text(node)!r} divides by 0")
            return left / right
        if isinstance(node.op, ast.Pow):
            return self._power(left, self._number(right), node)
        raise self._refuse(
            instead_of(node, self._text(node))
            or f"the operator of {self._text(node)!r} is not allowed; allowed are {_OPERATORS}"
        )

    def _power(self, base: Expression, exponent: Fraction | None, node: ast.BinOp) -> Expression:
        if exponent is None or exponent.denominator != 1 or not abs(exponent) <= MOST_EXPONENT:
            raise self._refuse(
                f"the exponent of {self._text(node)!r} must be an integer of at most {MOST_EXPONENT}; "
                f"found {self._text(node.right) if exponent is None else exponent}"
                + (
                    "; a root is sqrt(x), and a power 3/2 is x*sqrt(x)"
                    if exponent and exponent.denominator == 2
                    else ""
                )
            )
        if exponent == 0:
            raise self._refuse(f"{self._text(node)!r} is 1 wherever it has a value; write 1")
        if exponent < 0 and self._number(base) == 0:
            raise self._refuse(f"{self._text(node)!r} divides by 0")
        return base ** int(exponent)

    def _number(self, expression: Expression) -> Fraction | None:
        try:
            return constant_of(expression)
        except InputError as error:
            raise self._refuse(str(error)) from error

    def _text(self, node: ast.AST) -> str:
        if not isinstance(node, ast.expr):
            return self.source
        return self.source[node.col_offset : node.end_col_offset]  # of one line, in ASCII

    def _refuse(self, message: str) -> InputError:
        end = "" if message.endswith("?") else "."
        return InputError(f"equation {self.source!r}: {message}{end}")
