"""Expressions: trees as they were written, evaluated in any arithmetic. This package has the list of functions."""

from __future__ import annotations

from certify.loop.expressions.derivative import differentiate
from certify.loop.expressions.evaluate import Algebra, evaluate
from certify.loop.expressions.from_sympy import from_sympy
from certify.loop.expressions.gathering import constant_of, gathered
from certify.loop.expressions.nested import Tree, from_tree, to_tree
from certify.loop.expressions.numerical import numerical
from certify.loop.expressions.rational import evaluate_exactly, value_if_rational
from certify.loop.expressions.series import PowerSeries, Series, solution_series
from certify.loop.expressions.tree import (
    FUNCTIONS,
    GRAMMAR,
    MOST_EXPONENT,
    Expression,
    Number,
    Operation,
    Symbol,
    as_expression,
    atan,
    cos,
    exp,
    function,
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
    "FUNCTIONS",
    "GRAMMAR",
    "MOST_EXPONENT",
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
    "constant_of",
    "cos",
    "differentiate",
    "evaluate",
    "evaluate_exactly",
    "exp",
    "from_sympy",
    "from_tree",
    "function",
    "gathered",
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
