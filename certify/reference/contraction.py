"""Rule `contraction`: in {V <= c0} any two trajectories approach each other, for constant uncertain quantities.

So there is one equilibrium to which all of them go. For two points J d and J d' of a ball, with e = d - d' and m half
of their sum, the components of F differ by a_i.e + 2 m'Q_i e, by K_i[d, d, e] + K_i[d, d', e] + K_i[d', d', e], each
within |T_i e|, and by what is beyond the third order, of which the models have a Lipschitz constant. b_i being the
columns of J'P, the distance's derivative is a quadratic form in e, with one more for each entry of m, sum_j m_j e'N_j
e, and as |m| <= 1 these are together below another: 2 e'w <= e'ge + w'(1/g)w.
"""

from __future__ import annotations

from collections.abc import Sequence

from flint import arb, arb_mat, fmpq_mat

from .balls import columns_scaled, norm, total
from .decrease import certainly_positive, diagonal, whatever_y, with_cubic
from .document import Certificate
from .evidence import Contraction
from .fields import exact
from .local import cells
from .loop import Field, Loop
from .model import Model
from .rational import identity, positive_definite
from .refusal import Refused, require

RULE = "contraction"


def contraction(loop: Loop, evidence: Contraction, parts: Sequence[int]) -> None:
    """The ball contains {V <= c0}, and F contracts on it in each cell of the ranges."""
    c, J, g = loop.c, evidence.J, evidence.weights
    weight = arb_mat(evidence.weight)
    if c.floor is None:
        raise Refused("format", "levels.floor", "the claim needs a floor")
    holds = positive_definite(J.transpose() * c.P * J - exact(c.floor) * identity(c.n))
    require(holds, RULE, "ball", "it does not contain {V <= c0}: J'PJ - c0 I is not positive definite")
    require(all(v > 0 for v in g), RULE, "ball", "a weight is not positive")
    known = loop.steady(J, RULE, "ball")
    for number, cell in enumerate(cells(c.plant.ranges, parts)):
        at = f"cell {number}" if parts else "ball"
        F = loop.within(known, cell, RULE, at)
        approaches = whatever_y(F, lambda G: contracts(c, J, list(map(arb, g)), weight, G))
        require(approaches, RULE, at, "trajectories do not certainly approach each other: its matrix is not definite")


def contracts(c: Certificate, J: fmpq_mat, g: Sequence[arb], weight: arb_mat, F: Field) -> bool:
    """True if 2 (x - y)'P (F(x) - F(y)) is certainly negative for any two points of the ball; models without y.

    At one d and d', and for given quadratic parts and what is beyond them, this is linear in the gradients.
    """
    n, A = c.n, arb_mat([list(f.a.entries()) for f in F.components])
    b = arb_mat(J.transpose() * c.P)
    linear, columns = b * A, [arb_mat(n, 1, column) for column in b.transpose().tolist()]
    turned, inverse = diagonal(g), [1 / v for v in g]
    for j in range(n):
        N = arb_mat(n, n)
        for column, f in zip(columns, F.components, strict=True):
            N += column * arb_mat([f.Q.tolist()[j]])
        N = 2 * (N + N.transpose())
        turned += columns_scaled(N, inverse) * N
    left = -(linear + linear.transpose()) - turned / 2
    for column, f in zip(columns, F.components, strict=True):
        left -= 3 * with_cubic(column, f, weight)
    each = zip(columns, F.components, strict=True)
    rest = total(2 * norm(column.entries()) * (f.slack + lip_of(f)) for column, f in each)
    return certainly_positive(left - diagonal([rest] * n))


def lip_of(f: Model) -> arb:
    """The Lipschitz constant beyond the third order; without one nothing is certain."""
    return arb("nan") if f.lip is None else f.lip
