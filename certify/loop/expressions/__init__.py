"""Expressions: trees as they were written, evaluated in any arithmetic. This package has the list of functions."""

from __future__ import annotations

from certify.loop.expressions.derivative import differentiate
from certify.loop.expressions.evaluate import Algebra, evaluate
from certify.loop.expressions.from_sympy import from_sympy
from certify.loop.expressions.gathering import constant_of, gathered
from certify.loop.expressions.nested import Tree, from_tree, to_tree
from certify.loop.expressions.numerical import numerical
from certify.loop.expressions.rational import AT_CORNER, evaluate_exactly, value_if_rational
from certify.loop.expressions.series import PowerSeries, Series, solution_series
from certify.loop.expressions.tree import (
    CORNERS,
    FUNCTIONS,
    GRAMMAR,
    MOST_EXPONENT,
    NAMED,
    Expression,
    Number,
    Operation,
    Symbol,
    as_expression,
    atan,
    clip,
    cornered,
    cos,
    exp,
    function,
    in_absolute_values,
    maximum,
    minimum,
    nodes,
    sin,
    sqrt,
    substitute,
    symbols,
    symbols_of,
    tan,
    tanh,
    total,
)

__all__ = [
    "AT_CORNER",
    "CORNERS",
    "FUNCTIONS",
    "GRAMMAR",
    "MOST_EXPONENT",
    "NAMED",
    "Algebra",
    "Expression",
    "Number",
    "Operation",
    "PowerSeries",
    "Series",
    "Symbol",
    "Tree",
    "as_expression",
    "atan",
    "clip",
    "constant_of",
    "cornered",
    "cos",
    "differentiate",
    "evaluate",
    "evaluate_exactly",
    "exp",
    "from_sympy",
    "from_tree",
    "function",
    "gathered",
    "in_absolute_values",
    "maximum",
    "minimum",
    "nodes",
    "numerical",
    "sin",
    "solution_series",
    "sqrt",
    "substitute",
    "symbols",
    "symbols_of",
    "tan",
    "tanh",
    "to_tree",
    "total",
    "value_if_rational",
]
