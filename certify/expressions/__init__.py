"""Expressions of plants: as nested lists, and evaluated in any arithmetic. The one list of functions is here."""

from __future__ import annotations

from certify.expressions.evaluate import Algebra, evaluate
from certify.expressions.rational import evaluate_exactly
from certify.expressions.series import PowerSeries, Series, solution_series
from certify.expressions.tree import FUNCTIONS, GRAMMAR, Tree, as_power, from_tree, has_tree, to_tree

__all__ = [
    "FUNCTIONS",
    "GRAMMAR",
    "Algebra",
    "PowerSeries",
    "Series",
    "Tree",
    "as_power",
    "evaluate",
    "evaluate_exactly",
    "from_tree",
    "has_tree",
    "solution_series",
    "to_tree",
]
