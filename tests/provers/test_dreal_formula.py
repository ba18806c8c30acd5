"""Queries as dReal gets them: they say the same as before, in numbers that no simplification can round."""

from __future__ import annotations

from fractions import Fraction

import flint
import numpy as np
import pytest

from certify.certificates.claims import Asymptotic, conditions
from certify.certificates.claims.conditions import local_condition, ring_condition
from certify.certificates.claims.queries import Query, query
from certify.errors import InputError
from certify.loop.expressions import Tree
from certify.loop.plants import get_system
from certify.provers.dreal import backend
from certify.provers.dreal.backend import to_smt2
from certify.provers.dreal.formula import Formula, formula
from tests.certificates.test_queries import CASES, quadrotor, values
from tests.support.cases import case_of
from tests.support.loops import pendulum_network
from tests.support.oracle import value_of


def enclosed(found: Formula, x: np.ndarray) -> dict[str, flint.arb]:
    """Every variable and definition of a formula at a state, in Arb; variables beyond the states in their bounds."""
    flint.ctx.prec = 200
    names = {name: flint.arb(float(v)) for (name, _, _), v in zip(found.variables[: len(x)], x, strict=True)}
    for name, lo, hi in found.variables[len(x) :]:
        names[name] = flint.arb(lo).union(flint.arb(hi))
    for name, tree in found.definitions:
        names[name] = value_of(tree, names)
    return names


def numbers(tree: Tree) -> list[Fraction]:
    """The numbers of a tree."""
    if isinstance(tree, list):
        return [q for part in tree[1:] if not isinstance(part, int) for q in numbers(part)]
    try:
        return [Fraction(tree)]
    except ValueError:
        return []


@pytest.mark.parametrize("name", CASES)
def test_a_formula_says_what_the_query_says(name: str) -> None:
    """left - right of each constraint at random states, in balls that are hardly wider."""
    case = case_of(*CASES[name]())
    generator = np.random.default_rng(0)
    for condition in conditions(Asymptotic(roa=1.0, local=0.1), case.problem):
        asked = query(condition, case.problem)
        found = formula(asked)
        assert len(found.constraints) == len(asked.constraints)
        trees = [t for _, t in found.definitions] + [t for left, _, right in found.constraints for t in (left, right)]
        for q in (q for tree in trees for q in numbers(tree)):
            assert Fraction(float(q)) == q
        for x in 0.3 * generator.standard_normal((2, case.loop.system.n)):
            before, after = values(asked, x), enclosed(found, x)
            for (a, relation, b), (c, rounded, d) in zip(asked.constraints, found.constraints, strict=True):
                assert rounded[0] == relation[0]
                expected = value_of(a, before) - value_of(b, before)
                difference = value_of(c, after) - value_of(d, after)
                if isinstance(c, str):  # a bound on one state, rounded outwards
                    slack = difference - expected if relation[0] == ">" else expected - difference
                    assert slack >= 0 and slack < 1e-14
                else:
                    assert difference.overlaps(expected)
                    assert difference.rad() < 1e-9 * (1 + abs(expected))


def test_like_terms_are_added_in_rationals() -> None:
    x = "x"
    tree = ["-", ["+", ["/", x, "10"], ["/", x, "5"]], ["/", ["*", "3", x], "10"]]
    found = formula(Query("q", (("x", Fraction(1), Fraction(2)),), (), ((tree, "<=", "0"),)))
    assert [left for left, _, _ in found.constraints] == [["*", "0", "c.0"]]
    assert found.variables == (("x", 1.0, 2.0), ("c.0", 1.0, 1.0))


def test_numbers_that_binary64_does_not_hold_are_variables_between_neighbours() -> None:
    big = 2**53 + 1
    definitions = (("a", ["*", "3/10", "x", "y"]), ("b", ["*", str(big), ["sin", "y"]]))
    box = (("x", Fraction(-1, 3), Fraction(1, 3)), ("y", Fraction(0), Fraction(1)))
    found = formula(Query("q", box, definitions, ((["+", "a", "b"], ">", "0"), ("x", "<", "1/10"))))
    names = {name: (lo, hi) for name, lo, hi in found.variables}
    pins = {Fraction(q): names[name] for name, q in found.stands_for.items()}
    assert set(pins) == {Fraction(3, 10), Fraction(big)}
    for q, (lo, hi) in (*pins.items(), (Fraction(1, 3), names["x"])):
        assert Fraction(lo) <= q <= Fraction(hi)
    assert all(hi == np.nextafter(lo, np.inf) for lo, hi in pins.values())
    left, relation, right = found.constraints[1]
    assert (left, relation) == ("x", "<=") and Fraction(1, 10) <= Fraction(right) < Fraction(1, 10) + Fraction(1, 2**55)


def test_terms_that_are_not_told_apart_have_no_numbers() -> None:
    """x / x is 1 for dReal: 0.1 (x / x) + 0.2 would be a sum of two constants."""
    tenth, fifth = str(Fraction(0.1)), str(Fraction(0.2))
    tree = ["+", ["*", tenth, ["/", "x", "x"]], ["*", tenth, "y"], fifth]
    box = (("x", Fraction(1), Fraction(2)), ("y", Fraction(1), Fraction(2)))
    found = formula(Query("q", box, (), ((tree, "<=", "0"),)))
    assert not [q for q in numbers(found.constraints[0][0]) if abs(q) != 1]


@pytest.mark.parametrize(
    "tree", [["/", "x", "0"], ["/", "1", ["-", "x", "x"]], ["asin", "x"], ["*", f"{10**400}", ["sin", "x"]]]
)
def test_what_cannot_be_written_is_refused(tree: Tree) -> None:
    with pytest.raises(InputError):
        formula(Query("q", (("x", Fraction(1), Fraction(2)),), (), ((["+", tree, "1"], "<=", "0"),)))


def test_what_depends_on_no_state_is_one_variable() -> None:
    """The network at the origin, and beta, are numbers."""
    case = case_of(*quadrotor())
    found = formula(query(ring_condition(0.01, 0.02), case.problem))
    assert not [t for _, t in found.definitions if t[0] == "log"]
    assert len([t for _, t in found.definitions if t[0] == "tanh"]) == 42
    constants = [n for n, what in found.stands_for.items() if what.startswith("a constant near")]
    assert len(constants) == 2
    widths = {name: hi - lo for name, lo, hi in found.variables}
    assert all(widths[name] < 1e-15 for name in constants)


def test_smt2_is_balanced_and_exact() -> None:
    text = to_smt2(query(ring_condition(0.01, 0.02), case_of(*quadrotor()).problem), "unsat")
    assert text.count("(") == text.count(")")
    assert text.startswith("; ring") and "; expected: unsat" in text and "(set-logic QF_NRA)" in text
    assert "stands for 500/243" in text  # 1/m with m = 0.486, never rounded
    assert text.rstrip().endswith("(check-sat)\n(exit)")
    assert "/ " not in "".join(line for line in text.splitlines() if not line.startswith(";"))  # quotients are rounded


def test_smt2_makes_no_variable_of_a_definition(monkeypatch: pytest.MonkeyPatch) -> None:
    """dReal searches over what `let` and functions without arguments name."""
    asked = query(local_condition(0.01), case_of(get_system("pendulum"), pendulum_network((6,))).problem)
    text = to_smt2(asked, None)
    assert "define-fun" not in text and "(let" not in text and "t.0" not in text
    monkeypatch.setattr(backend, "_INLINED", 0)
    short = to_smt2(asked, None)
    assert "(define-fun t.0 ((v. Real)) Real " in short and "(t.0 theta)" in short
    assert short.count("(") == short.count(")") and len(short) < len(text)
