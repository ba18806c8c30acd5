"""The largest value of a leaf's model: both bounds against exact maxima in rationals."""

from __future__ import annotations

from fractions import Fraction
from itertools import product

import numpy as np
import pytest
from flint import arb, arb_mat, ctx, fmpq

from certify.reference.balls import ON_LEAVES
from certify.reference.taylor import Taylor, inner_product, peak
from tests.support.marks import slow_after
from tests.support.maxima import Rows, drawn, largest, pairs, value
from tests.support.oracle import ball


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
    """Of g t + q t^2 for |t| <= 1: exact where g and q are points, and at least all where they are balls."""
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


@pytest.mark.parametrize("count", [1, 3])
def test_an_inner_product_is_nowhere_below(count: int) -> None:
    """Of exact models without remainders, and of balls around others: the products of members, at many points."""
    generator, n = np.random.default_rng(count), 3
    with ctx.workprec(ON_LEAVES):
        for wide in (0, 0.25):
            for _ in range(30):
                drawn_of = [[drawn(generator, n, "level") for _ in range(count)] for _ in range(2)]
                sides = [[widened(*one, wide) for one in side] for side in drawn_of]
                bound = inner_product(*sides)
                assert bound.g is not None and bound.Q is not None
                for _ in range(8):
                    d = [Fraction(int(v), 8) for v in generator.integers(-8, 9, n)]
                    truth = sum((value(*v, d) * value(*w, d) for v, w in zip(*drawn_of, strict=True)), Fraction(0))
                    column = arb_mat([[ball(v)] for v in d])
                    most = (
                        bound.c + (bound.g * column)[0, 0] + (column.transpose() * (bound.Q * column))[0, 0] + bound.r
                    )
                    assert not most < ball(truth)


def at(v: Taylor, d: tuple[int, ...]) -> arb:
    """c + g.d + d'Qd + r."""
    column, result = arb_mat([[x] for x in d]), v.c + v.r
    if v.g is not None:
        result += (v.g * column)[0, 0]
    return result if v.Q is None else result + (column.transpose() * (v.Q * column))[0, 0]


def test_an_inner_product_covers_remainders() -> None:
    """Of models of which some parts are 0, at corners, whatever the members: nothing else has room for these."""
    generator, n = np.random.default_rng(8), 2
    with ctx.workprec(ON_LEAVES):
        for _ in range(300):
            both = list[tuple[int, int, list[Fraction], Rows]]()
            for _ in range(2):
                c, r, *rest = (int(v) for v in generator.integers(0, 4, 7) * generator.integers(0, 2, 7))
                g, q, mixed, last = [Fraction(v) for v in rest[:2]], *map(Fraction, rest[2:])
                both.append((c, r, g, [[q, mixed], [mixed, last]]))
            v, w = (Taylor(arb(c), model(g, Q).g, model(g, Q).Q, arb(r)) for c, r, g, Q in both)
            for d in product((-1, 1), repeat=n):
                (x, r), (y, s) = ((c + value(g, Q, [Fraction(t) for t in d]), r) for c, r, g, Q in both)
                most = max((x + i * r) * (y + k * s) for i, k in product((-1, 1), repeat=2))
                assert not any(at(bound, d) < ball(most) for bound in (inner_product([v], [w]), v * w))


def test_an_inner_product_is_exact_where_its_third_order_is_largest() -> None:
    """x (2 y z), from either side, is 2 at (1, 1, 1), and x (x y) is 1 at (1, 1)."""
    for g, Q, most in (
        ([1, 0, 0], [[0, 0, 0], [0, 0, 2], [0, 2, 0]], 2),
        ([1, 0, 0], [[0, 1, 0], [1, 0, 0], [0, 0, 0]], 1),
        ([0, 0, 1], [[0, 0, 0], [0, 0, 0], [0, 0, 2]], 1),
    ):
        v, w = Taylor(arb(0), arb_mat([g])), model([Fraction(0)] * 3, [[Fraction(x, 2) for x in row] for row in Q])
        for bound in (inner_product([v], [w]), inner_product([w], [v])):
            assert at(bound, (1, 1, 1)).contains(most) and abs(at(bound, (1, 1, 1)) - most) < arb(2) ** -40


def widened(g: list[Fraction], Q: Rows, by: float) -> Taylor:
    """Balls of this radius around what is off by half as much."""
    off = arb(by / 2, by)
    return Taylor(arb(0), arb_mat([[ball(v) + off for v in g]]), arb_mat([[ball(v) + off for v in row] for row in Q]))


def test_an_inner_product_knows_what_cancels() -> None:
    """x y^2 - x y^2, of which term by term nothing is known; and x y^2 alone is at most (x^2 + 2 y^2) / 3."""
    x, squares = Taylor(arb(0), arb_mat([[1, 0]])), arb_mat([[0, 0], [0, 1]])
    both = inner_product([x, x], [Taylor(arb(0), None, squares), Taylor(arb(0), None, -squares)])
    assert both.bound() == 0
    alone = inner_product([x], [Taylor(arb(0), None, squares)])
    assert alone.Q is not None and alone.Q[0, 0].contains(fmpq(1, 3)) and alone.Q[1, 1].contains(fmpq(2, 3))
    assert alone.r == 0
    constants = inner_product([Taylor(arb(2))], [Taylor(arb(3), None, squares)])
    assert constants.c == 6 and constants.Q is not None and constants.Q[1, 1] == 2
