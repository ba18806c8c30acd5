"""The reference on uncertain quantities: forgeries, claims that are just accepted, models in cells, words."""

from __future__ import annotations

from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
from flint import arb, arb_mat, ctx, fmpq

from certify.reference.__main__ import in_words
from certify.reference.balls import PRECISION
from certify.reference.document import Certificate
from certify.reference.document import read as read_certificate
from certify.reference.leaves import Box, Leaves
from certify.reference.local import cells
from certify.reference.loop import Loop
from certify.reference.model import Model
from certify.reference.rational import coordinates
from certify.reference.refusal import Refused
from certify.reference.rules import judge as whole_verdict
from certify.reference.table import FUNCTIONS
from certify.reference.taylor import Taylor
from tests.checker.test_ball import points
from tests.checker.test_uncertain import HONEST, Edit, forgeries, honest, in_arb, wider
from tests.support.balls import exactly
from tests.support.certificates import Document, dump, edited, grow, make
from tests.support.marks import slow_after
from tests.support.models import may_be
from tests.support.oracle import ball
from tests.support.reference import judge
from tests.support.uncertain import FACTORS, drawn, largest, random_plant, ranges_of, refutation

MANY = ("4,096 cells", "64 quantities")  # which take seconds


@pytest.mark.parametrize("name", [name for name in HONEST if name not in MANY])
def test_honest_certificates_are_accepted(name: str) -> None:
    assert judge(honest(name)) is None


@pytest.mark.slow
@pytest.mark.parametrize("name", MANY)
def test_large_honest_certificates_are_accepted(name: str) -> None:
    assert judge(honest(name)) is None


@pytest.mark.parametrize(("rule", "base", "edit"), forgeries())
def test_forgeries_are_refused(rule: str, base: str, edit: Edit) -> None:
    assert judge(edit(honest(base))) == rule


@pytest.mark.parametrize("practical", [False, True])
@pytest.mark.parametrize("seed", slow_after(2, range(20, 26)))
def test_what_is_accepted_of_a_random_plant_is_true(seed: int, practical: bool) -> None:
    generator, first = np.random.default_rng(seed), True
    for data in wider(random_plant(seed, practical)):
        grown = grow(data, max_leaves=100, depth=11)
        if judge(grown) is not None:
            assert not first or (seed, practical) in REFUSED
            break
        first = False
        worst, where = largest(grown, generator, 2000)
        assert worst < 0, where
        assert refutation(grown, [where]) is None


REFUSED = ((21, False), (25, True))  # plants of which nothing is accepted


# ------------------------------------------------------------------------------------------------------ models enclose


def document(factor: str = "1/q", width: str = "1/8") -> tuple[Certificate, Document]:
    """g(q) in products, quotients and functions with two states and an input."""
    g, lo = FACTORS[factor], Fraction(3, 8)
    tree = ["+", ["*", g, ["sin", ["*", "q", "x"]]], ["*", "x", ["exp", ["*", g, "y"]]], ["/", "y", ["+", g, "q", "4"]],
            ["*", g, "u"], ["tanh", ["*", "q", "x", "y"]], ["*", "x", ["sqrt", ["+", "q", "2", "y"]]]]  # fmt: skip
    data = make(
        [tree, "y"], [(np.array([[-1.0, 0.5]]), [0.0])], np.eye(2), (0.01, 0.01), states="xy", centre="none",
        domain=[("-3", "3")] * 2, uncertain=[("q", str(lo), str(lo + Fraction(width)))],
    )  # fmt: skip
    return read_certificate(dump(data)), data


@pytest.mark.parametrize("factor", FACTORS)
def test_models_in_a_cell_enclose_F_for_all_its_values(factor: str) -> None:
    """v(q) + a.d + d'Q d within d'E d, every number a ball that holds what it is at q."""
    c, data = document(factor)
    generator = np.random.default_rng(3)
    J = 0.1 * generator.standard_normal((2, 2))
    with ctx.workprec(PRECISION):
        loop = Loop(c)
        (cell,) = cells(c.plant.ranges, (1,))
        try:
            F = loop.within(loop.known(exactly(J), "local", "ball"), cell, "local", "ball").components[0]
        except Refused:
            assert factor == "q^-3"  # of a wide number the product with itself may be 0
            return
    lo, hi = ranges_of(data)["q"]
    with ctx.workprec(1000):
        for share in (0, 1, Fraction(1, 2), Fraction(1, 7)):
            q = lo + (hi - lo) * share
            for d in points(generator, 2):
                x = [sum((arb(p) * arb(e) for p, e in zip(row, d, strict=True)), arb(0)) for row in J.tolist()]
                true = in_arb(data, x, {"q": q}, data["plant"]["dynamics"][0])
                assert holds(F, true, d, 2 * share - 1), (q, d)


def spanning(ends: tuple[fmpq, fmpq]) -> arb:
    """A ball that contains every number between two rationals."""
    return arb(ends[0]).union(arb(ends[1]))


def holds(f: Model, true: arb, d: list[float], y: Fraction | int) -> bool:
    return may_be(f.where([ball(Fraction(y))]), true, d)


@pytest.mark.parametrize("name", ["1/", "sqrt", "exp", "sin", "cos", "tanh", "atan"])
def test_functions_of_wide_balls(name: str) -> None:
    """All derivatives and the bound of the third at every number of the ball."""
    for lo, hi in ((fmpq(1, 3), fmpq(4)), (fmpq(5, 4), fmpq(2)), (fmpq(1), fmpq(1, 1) + fmpq(1, 2**40))):
        wide, reach = spanning((lo, hi)), arb(fmpq(1, 5))
        row = FUNCTIONS[name]
        found = row.derivatives(wide)
        most = row.third(wide, found, reach)
        assert most is not None and most.is_finite()
        for k in range(9):
            y = arb(lo + (hi - lo) * k / 8)
            single = row.derivatives(y)
            assert all(a.overlaps(b) for a, b in zip(single, found, strict=True))
            for shift in (-0.1999, -0.1, 0, 0.1, 0.1999):
                v = y + arb(shift)
                left = abs(row.derivatives(v)[0] - single[0] - single[1] * shift - single[2] * arb(shift) ** 2 / 2)
                assert not left > most * abs(arb(shift)) ** 3 / 6


@pytest.mark.parametrize("ends", [(fmpq(-1), fmpq(2)), (fmpq(0), fmpq(2)), (fmpq(-2), fmpq(0))])
def test_a_wide_ball_with_0_in_it_has_no_inverse_and_no_root(ends: tuple[fmpq, fmpq]) -> None:
    wide = spanning(ends)
    assert all(FUNCTIONS[name].third(wide, (arb(0),) * 4, arb(0)) is None for name in ("1/", "sqrt"))


def test_cells_cover_the_ranges_exactly() -> None:
    ranges = ((fmpq(1, 3), fmpq(5, 7)), (fmpq(-1), fmpq(0)), (fmpq(0), fmpq(1, 10**30)))
    found = list(cells(ranges, (3, 1, 5)))
    assert len(found) == 15 and list(cells((), ())) == [()]
    for j, (lo, hi) in enumerate(ranges):
        pieces = sorted({(str(a), str(b)): (a, b) for a, b in (cell[j] for cell in found)}.values(), key=lambda p: p[0])
        assert pieces[0][0] == lo and pieces[-1][1] == hi
        assert all(a[1] == b[0] for a, b in pairwise(pieces))
        assert all(spanning(p).contains(arb(p[0])) and spanning(p).contains(arb(p[1])) for p in pieces)


@pytest.mark.parametrize("seed", range(6))
def test_leaf_models_enclose_Vdot_at_every_value(seed: int) -> None:
    """At points of a leaf with values drawn: the model's value is at least Vdot for some errors of the inputs."""
    data = random_plant(200 + seed, practical=bool(seed % 2))
    c, generator = read_certificate(dump(data)), np.random.default_rng(seed)
    ranges = ranges_of(data)
    with ctx.workprec(PRECISION):
        leaves = Leaves(c, c.evidence.T, coordinates(c, c.evidence)[0])  # type: ignore[union-attr]
        centre = 0.2 * generator.standard_normal(c.n)
        radius = 10.0 ** generator.uniform(-3, -0.7, c.n)
        box = Box(0, (centre - radius).tolist(), (centre + radius).tolist())
        (leaf,) = leaves.enclose([box])
        model = leaves.D(leaf)
    for _ in range(12):
        values = drawn(data, generator)
        share = np.where(generator.random(c.n) < 0.4, 1.0, generator.random(c.n))
        with ctx.workprec(300):
            z = [arb(a) + (arb(b) - arb(a)) * arb(float(s)) for a, b, s in zip(box.lo, box.hi, share, strict=True)]
            x = [sum((arb(t) * v for t, v in zip(row, z, strict=True)), arb(0)) for row in c.evidence.T.tolist()]  # type: ignore[union-attr]
            F = [in_arb(data, x, values, tree) for tree in data["plant"]["dynamics"]]
            P = c.P.tolist()
            true = 2 * sum((x[i] * arb(P[i][j]) * F[j] for i in range(c.n) for j in range(c.n)), arb(0))
            d = [(v - m) / r for v, m, r in zip(z, leaf.centre, leaf.radius, strict=True)]
            unknown = [arb(0).union(arb(1)).union(arb(-1))] * c.m
            d += unknown + [
                (ball(values[q]) - ball((lo + hi) / 2)) / ball((hi - lo) / 2) for q, (lo, hi) in ranges.items()
            ]
            assert not value_at(model, d) < true, values
            assert not true > model.bound()


def value_at(model: Taylor, d: list[arb]) -> arb:
    value, column = model.c, arb_mat(len(d), 1, list(d))
    if model.g is not None:
        value += (model.g * column)[0, 0]
    if model.Q is not None:
        value += (column.transpose() * model.Q * column)[0, 0]
    return value + model.r.union(-model.r)


# -------------------------------------------------------------------------------------------------------------- places


def test_the_cell_that_fails_is_named() -> None:
    data = edited(honest("scaled"), "plant.uncertain.0.range", ["1/10", "11/10"])
    verdict = whole_verdict(dump(edited(data, "evidence.cells", [10])))
    assert (verdict.rule, verdict.at) == ("local", "cell 8")  # [9/10, 1] with 1 in it


def test_the_words_say_what_is_uncertain() -> None:
    said = in_words(read_certificate(dump(honest("two"))))
    assert said.endswith(
        "u within the input bounds, whatever values these have at any time: q in [-1, 9/10], p in [-1/2, 1]"
    )
