"""The right-hand sides of a plant as Coq's theory has them (`expr` of Spec.v), from the trees of a certificate.

A tree becomes the expression of the same value at every state, node by node: no algebra, no constants are merged.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from fractions import Fraction
from functools import reduce
from math import isqrt
from typing import Any

from certify.errors import CertificateFormatError, InputError

FUNCTIONS = ("sin", "cos", "tanh", "exp", "atan", "sqrt")  # tan is sin over cos
_MOST_NODES = 20_000
_LARGEST_POWER = 64
_DEEPEST = 200
_RATIONAL = re.compile(r"-?(0|[1-9][0-9]{0,1200})(/[1-9][0-9]{0,1200})?", re.ASCII)


@dataclass(frozen=True, slots=True)
class Expression:
    """A node and its operands.

    Parameters
    ----------
    kind : state, input, const, add, neg, mul, inv, pow or one of `FUNCTIONS`.
    operands : none, one, or for add and mul two.
    index : the index of a state or input; for a power, its exponent.
    number : the value of a constant.
    """

    kind: str
    operands: tuple[Expression, ...] = ()
    index: int = 0
    number: Fraction = Fraction(0)


def rational(text: Any, name: str) -> Fraction:
    """The exact number that a certificate writes as text.

    Raises
    ------
    CertificateFormatError : it is no text of FORMAT.md's form.
    """
    if not isinstance(text, str) or _RATIONAL.fullmatch(text) is None:
        raise CertificateFormatError(f'{name} must be a rational, as in "-8/3"; found {str(text)[:40]!r}.')
    return Fraction(text)


def from_tree(tree: Any, states: Mapping[str, int], inputs: Mapping[str, int]) -> Expression:
    """The expression of a certificate's tree.

    Parameters
    ----------
    states, inputs : their names with their places.

    Raises
    ------
    CertificateFormatError : the tree is none of FORMAT.md's, or too large.
    InputError : it has abs, min, max, clip or heaviside.
    """
    names = {name: Expression("input", index=j) for name, j in inputs.items()}
    names |= {name: Expression("state", index=i) for name, i in states.items()}
    found = _Reader(names, iter(range(_MOST_NODES))).read(tree, _DEEPEST)
    nodes, depth = [found], 0
    while nodes:
        nodes, depth = [operand for node in nodes for operand in node.operands], depth + 1
    if depth > _DEEPEST:
        raise CertificateFormatError(
            f"an equation must nest at most {_DEEPEST} deep once its sums and products are of two; found {depth}."
        )
    return found


def at_rest(e: Expression, u: Mapping[int, Fraction]) -> Fraction | None:
    """The value at the origin with inputs u, if it is rational by its form; None if it is not, or undecided.

    >>> at_rest(Expression("cos", (Expression("state"),)), {})
    Fraction(1, 1)
    """
    values = [at_rest(operand, u) for operand in e.operands]
    if e.kind == "state":
        return Fraction(0)
    if e.kind == "input":
        return u[e.index]
    if e.kind == "const":
        return e.number
    known = [v for v in values if v is not None]
    if len(known) < len(values):
        return None
    first = known[0]
    match e.kind:
        case "add":
            return first + known[1]
        case "mul":
            return first * known[1]
        case "neg":
            return -first
        case "inv":
            return 1 / first if first else None
        case "pow":
            return first**e.index
        case "sqrt":
            root = Fraction(isqrt(first.numerator), isqrt(first.denominator)) if first >= 0 else None
            return root if root is not None and root * root == first else None
    return None if first else Fraction(e.kind in ("cos", "exp"))


@dataclass(frozen=True, slots=True)
class _Reader:
    names: Mapping[str, Expression]
    budget: Iterator[int]

    def read(self, tree: Any, depth: int) -> Expression:
        if depth <= 0 or next(self.budget, None) is None:
            raise CertificateFormatError(
                f"an equation must nest at most {_DEEPEST} deep and have at most {_MOST_NODES:,} nodes; found more."
            )
        if isinstance(tree, str):
            return self.names[tree] if tree in self.names else self._constant(tree)
        if not isinstance(tree, list) or len(tree) < 2 or not isinstance(tree[0], str):
            raise CertificateFormatError(f"an equation must be a tree of FORMAT.md; found {str(tree)[:60]!r}.")
        operator, arguments = tree[0], tree[1:]
        if operator == "**":
            return self._power(arguments, depth)
        values = [self.read(a, depth - 1) for a in arguments]
        match operator, len(values):
            case ("+", _):
                return reduce(lambda a, b: Expression("add", (a, b)), values)
            case ("*", _):
                return reduce(lambda a, b: Expression("mul", (a, b)), values)
            case ("-", 1):
                return Expression("neg", (values[0],))
            case ("-", 2):
                return Expression("add", (values[0], Expression("neg", (values[1],))))
            case ("/", 2):
                return Expression("mul", (values[0], Expression("inv", (values[1],))))
            case ("tan", 1):
                # The operand stands twice: it counts twice, for what is written out and proved.
                again = self.read(arguments[0], depth - 1)
                inverse = Expression("inv", (Expression("cos", (again,)),))
                return Expression("mul", (Expression("sin", (values[0],)), inverse))
            case (name, 1) if name in FUNCTIONS:
                return Expression(name, (values[0],))
            case (("abs" | "min" | "max" | "clip" | "heaviside"), _):
                raise InputError(
                    f"Coq's statement is about smooth equations; found {operator}. The checker reads such certificates."
                )
        raise CertificateFormatError(
            f"an equation's operators must be those of FORMAT.md; found {str(operator)[:40]!r}."
        )

    def _constant(self, text: str) -> Expression:
        return Expression("const", number=rational(text, "a leaf of an equation that names no state and no input"))

    def _power(self, arguments: list[Any], depth: int) -> Expression:
        if len(arguments) != 2 or type(arguments[1]) is not int or not 0 < abs(arguments[1]) <= _LARGEST_POWER:
            raise CertificateFormatError(
                f"a power must have a base and an integer exponent k, 0 < |k| <= {_LARGEST_POWER}; "
                f"found {str(arguments)[:60]!r}."
            )
        power = Expression("pow", (self.read(arguments[0], depth - 1),), index=abs(arguments[1]))
        return power if arguments[1] > 0 else Expression("inv", (power,))
