"""Rule `contraction`: in {V <= c0} any two trajectories approach each other, for constant uncertain quantities.

In steps it is their next states that are nearer to each other than they are.

So there is one equilibrium to which all of them go. For two points J d and J d' of a ball, with e = d - d' and m half
of their sum, the components of F differ by a_i.e + 2 m'Q_i e, by K_i[d, d, e] + K_i[d, d', e] + K_i[d', d', e], each
within |T_i e|, and by what is beyond the third order, of which the models have a Lipschitz constant. b_i being the
columns of J'P, the distance's derivative is a quadratic form in e, with one more for each entry of m, sum_j m_j e'N_j
e, and as |m| <= 1 these are together below another: 2 e'w <= e'ge + w'(1/g)w.

A step of length h changes a state by h G, and the square of a distance by h times 2 e'J'P g + h g'Pg, g being what two
G differ by, A e and a remainder. So b_i are the columns of (J + h A)'P there, h A'PA is part of the form, and the
remainder's own square, in the norm of P, is bounded by that of its length. In discrete time h is 1 and G = F - x. With
held inputs the states of a period have Lipschitz constants too, and so has the last term of the series for G.
"""

from __future__ import annotations

from collections.abc import Sequence

from flint import arb, arb_mat, fmpq_mat

from .balls import ZERO, columns_scaled, norm, total
from .decrease import (
    certainly_positive,
    diagonal,
    forms_of,
    length_of,
    length_of_kinks,
    of_kinks,
    whatever_y,
    with_cubic,
)
from .document import Certificate
from .evidence import Contraction
from .fields import exact
from .flow import steps_on
from .kinks import ALL
from .local import cells, cones
from .loop import Field, Loop
from .model import Model
from .rational import identity, positive_definite
from .refusal import Refused, require

RULE = "contraction"


def contraction(loop: Loop, evidence: Contraction, parts: Sequence[int]) -> None:
    """The ball contains {V <= c0}, and the loop contracts on it in each cell of the ranges."""
    c, J, g = loop.c, evidence.J, evidence.weights
    if c.floor is None:
        raise Refused("format", "levels.floor", "the claim needs a floor")
    sides = cones(evidence.directions, c.n, RULE)
    holds = positive_definite(J.transpose() * c.P * J - exact(c.floor) * identity(c.n))
    require(holds, RULE, "ball", "it does not contain {V <= c0}: J'PJ - c0 I is not positive definite")
    require(all(v > 0 for v in g), RULE, "ball", "a weight is not positive")
    known = loop.steady(J, RULE, "ball", None if sides[0] is None else ALL)
    steps = steps_on(loop, known, evidence, "ball", rule=RULE)
    for side, cone in enumerate(sides):
        where = f" cone {side}" if evidence.directions else ""
        here = steps
        if cone not in (None, ALL):
            known = loop.on_cone(J, cone, RULE, f"ball{where}", steady=True)
            here = steps_on(loop, known, evidence, f"ball{where}", steps.within, RULE)
        for number, cell in enumerate(cells(c.plant.ranges, parts)):
            at = (f"cell {number}" if parts else "ball") + where
            G = here.change(cell, RULE, at)
            approaches = whatever_y(G, lambda change: contracts(c, J, list(map(arb, g)), evidence.weight, change))
            words = "trajectories do not certainly approach each other: its matrix is not definite"
            require(approaches, RULE, at, words)


def contracts(c: Certificate, J: fmpq_mat, g: Sequence[arb], weight: fmpq_mat, G: Field) -> bool:
    """True if any two points of the ball certainly approach each other, G being models of F or, in steps, of F - x.

    On a cone of d these are any two of it: a line between two states consists of pieces in cones.

    They have no y: at one d and d', and for given quadratic parts and what is beyond them, what is bounded is a convex
    function of the gradients, as P is positive definite.
    """
    n, A = c.n, arb_mat([list(f.a.entries()) for f in G.components])
    b = arb_mat(J.transpose() * c.P)
    form = b * A
    form += form.transpose()
    wrong = [f.slack + lip_of(f) for f in G.components]
    along = ZERO
    if c.step:
        h, of_A = arb(c.step), A.transpose() * arb_mat(c.P)
        form, b = form + h * (of_A * A), b + h * of_A
        along = h * longest_rest(c.P, G, wrong) ** 2
    columns = [arb_mat(n, 1, column) for column in b.transpose().tolist()]
    turned, inverse = diagonal(g), [1 / v for v in g]
    for j in range(n):
        N = arb_mat(n, n)
        for column, f in zip(columns, G.components, strict=True):
            N += column * arb_mat([f.Q.tolist()[j]])
        N = 2 * (N + N.transpose())
        turned += columns_scaled(N, inverse) * N
    left = -form - turned / 2
    for column, f in zip(columns, G.components, strict=True):
        left -= 3 * with_cubic(column, f, arb_mat(weight))
    left -= of_kinks(columns, G, arb_mat(weight))
    along += total(2 * norm(column.entries()) * v for column, v in zip(columns, wrong, strict=True))
    return certainly_positive(left - diagonal([along] * n))


def longest_rest(P: fmpq_mat, G: Field, wrong: Sequence[arb]) -> arb:
    """The length, v'Pv being its square, of what the difference of G has beyond A e, for an e of length 1.

    Q is met by m and e, twice, and K three times by two points and e.
    """
    squares, cubes = forms_of(G)
    of_P = arb_mat(P)
    moved = total(arb(P[i, i]).sqrt() * v for i, v in enumerate(wrong)) + length_of_kinks(P, G)
    return 2 * length_of(squares, of_P) + 3 * length_of(cubes, of_P) + moved


def lip_of(f: Model) -> arb:
    """The Lipschitz constant beyond the third order; without one nothing is certain."""
    return arb("nan") if f.lip is None else f.lip
