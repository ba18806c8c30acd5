"""The largest value of a leaf's model: both bounds against exact maxima in rationals."""

from __future__ import annotations

from fractions import Fraction
from itertools import product

import numpy as np
import pytest
from flint import arb, arb_mat, ctx, fmpq, fmpq_mat

from certify.reference.balls import ON_LEAVES
from certify.reference.taylor import Taylor, peak
from tests.support.marks import slow_after
from tests.support.oracle import ball

Rows = list[list[Fraction]]


def pairs(n: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(n) for j in range(i, n)]


def value(g: list[Fraction], Q: Rows, d: list[Fraction]) -> Fraction:
    n = range(len(g))
    return sum((g[i] * d[i] for i in n), Fraction(0)) + sum((Q[i][j] * d[i] * d[j] for i in n for j in n), Fraction(0))


def largest(g: list[Fraction], Q: Rows) -> Fraction:
    """The exact maximum of g.d + d'Qd on the box: on each face the stationary point, where there is a single one.

    Where there are many on a face they reach its boundary with the same value.
    """
    found = []
    for signs in product((-1, 0, 1), repeat=len(g)):
        free = [i for i, s in enumerate(signs) if s == 0]
        d = [Fraction(s) for s in signs]
        if free:
            A = fmpq_mat([[rational(2 * Q[i][j]) for j in free] for i in free])
            right = [[rational(-g[i] - 2 * sum(Q[i][j] * d[j] for j in range(len(g))))] for i in free]
            if A.det() == 0:
                continue
            for i, v in zip(free, A.solve(fmpq_mat(right)).entries(), strict=True):
                d[i] = Fraction(int(v.p), int(v.q))
        if all(abs(v) <= 1 for v in d):
            found.append(value(g, Q, d))
    return max(found)


def rational(v: Fraction) -> fmpq:
    return fmpq(v.numerator, v.denominator)


def drawn(generator: np.random.Generator, n: int, kind: str) -> tuple[list[Fraction], Rows]:
    """Models whose maximum is inside, on a face, at a corner, or at several corners at once."""
    size = {"steep": 8, "level": 1, "flat": 0}[kind]
    g = [Fraction(int(v), 4) for v in generator.integers(-4 * size, 4 * size + 1, n)]
    Q = [[Fraction(0)] * n for _ in range(n)]
    for i, j in pairs(n):
        Q[i][j] = Q[j][i] = Fraction(int(generator.integers(-8, 9)), 4) * int(generator.integers(0, 2))
    return g, Q


def model(g: list[Fraction], Q: Rows) -> Taylor:
    return Taylor(arb(0), arb_mat([[ball(v) for v in g]]), arb_mat([[ball(v) for v in row] for row in Q]))


@pytest.mark.parametrize("kind", ["steep", "level", "flat"])
@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_no_bound_is_below_the_largest_value(n: int, kind: str) -> None:
    generator, exact, less = np.random.default_rng([n, len(kind)]), 0, 0
    with ctx.workprec(ON_LEAVES):
        for _ in range(60):
            g, Q = drawn(generator, n, kind)
            most, bounded = largest(g, Q), model(g, Q)
            squares, corner = bounded.by_squares(), bounded.from_corner()
            for bound in (squares, corner, bounded.bound()):
                assert not bound < ball(most), (g, Q)
            exact += bool(abs(corner - ball(most)) <= arb(2) ** -40)
            less += bool(corner < squares)
            assert not Taylor(-ball(most) + arb(2) ** -30, bounded.g, bounded.Q).is_negative()
    assert kind != "steep" or (exact > 10 and (less > 5 or n == 1))


@pytest.mark.parametrize("shift", slow_after(2, [0, 1, -1]))
def test_numbers_that_are_not_known_exactly(shift: int) -> None:
    """Balls around 0 decide no sign, and every number in them must be covered; so must what is not finite."""
    generator = np.random.default_rng(3)
    with ctx.workprec(ON_LEAVES):
        for _ in range(60):
            g, Q = drawn(generator, 3, "level")
            wide = [arb(float(v) / 8 * abs(shift), 0.25) for v in g]
            each = [[ball(v) for v in row] for row in Q]
            for i, j in pairs(3):
                if generator.random() < 0.3:
                    each[i][j] = each[j][i] = arb(0, 0.5)
            bound = Taylor(arb(0), arb_mat([wide]), arb_mat(each)).bound()
            for _ in range(6):
                h = [Fraction(float(v.mid())) + Fraction(int(generator.integers(-1, 2)), 4) for v in wide]
                R = [[Fraction(0)] * 3 for _ in range(3)]
                for i, j in pairs(3):
                    drawn_one = Fraction(int(generator.integers(-1, 2)), 2) * (not each[i][j].is_exact())
                    R[i][j] = R[j][i] = Fraction(float(each[i][j].mid())) + drawn_one
                assert not bound < ball(largest(h, R))
        unknown = [arb("nan"), arb("inf"), arb(0, float("inf"))]
        for v in unknown:
            none, flat = arb_mat(1, 2), arb_mat(2, 2)
            for model in (
                Taylor(arb(-1), arb_mat([[v, 1]]), flat),
                Taylor(arb(-1), none, arb_mat([[0, v], [v, 0]])),
                Taylor(arb(-1), none, flat, v),
                Taylor(v, none, flat),
            ):
                assert not model.is_negative() and not model.is_finite()


def test_the_peak_of_a_parabola() -> None:
    """Of g t + q t^2 for |t| <= 1, for all g and q in two balls: exact where they are points, at least all elsewhere."""
    exact = {(2, 1): 3, (0, -1): 0, (1, -1): 0.25, (2, -1): 1, (3, -1): 2, (0, 0): 0, (1, 0): 1}
    for (g, q), most in exact.items():
        assert peak(arb(g), arb(q)) == most
        for wide_g, wide_q in ((arb(g, 0.5), arb(q)), (arb(g), arb(q, 0.5)), (arb(g, 0.5), arb(q, 1.5))):
            assert not peak(abs(wide_g), wide_q) < most
    for g, q in ((arb("nan"), arb(-1)), (arb(1), arb("nan")), (arb("inf"), arb(-1)), (arb(1), arb("inf"))):
        assert not peak(g, q) < 10**9


@pytest.mark.parametrize("kind", ["steep", "level", "flat"])
def test_no_bound_is_above_those_that_take_each_pair_at_its_largest(kind: str) -> None:
    """The exact maximum of each axis and |Q_ij + Q_ji|; a corner's value and what may be gained for the way from it."""
    generator, n, below = np.random.default_rng(len(kind)), 4, 0
    with ctx.workprec(ON_LEAVES):
        for _ in range(200):
            g, Q = drawn(generator, n, kind)
            axes = [peak(abs(ball(g[i])), ball(Q[i][i])) for i in range(n)]
            apart = sum(axes, arb(0)) + ball(sum(2 * abs(Q[i][j]) for i, j in pairs(n) if i < j))
            s = [1 if v >= 0 else -1 for v in g]
            M = [[s[i] * s[j] * Q[i][j] for j in range(n)] for i in range(n)]
            lost = [max(0, 2 * sum(max(0, -v) for v in M[i]) - abs(g[i])) for i in range(n)]
            steep = ball(sum(abs(v) for v in g) + sum(map(sum, M)) + 2 * sum(lost))
            bounded = model(g, Q)
            assert bounded.by_squares() <= apart + arb(2) ** -40
            assert 0 in g or bounded.from_corner() <= steep + arb(2) ** -40
            below += bool(bounded.bound() < apart - arb(2) ** -40) and bool(bounded.bound() < steep - arb(2) ** -40)
    assert below > 20
