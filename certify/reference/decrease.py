"""The matrix inequality of the rules `local` and `tube`: d'J'RJ d + 2 d'J'P F(Jd) < 0 for 0 < ||d|| <= 1.

Along a path d = (z, sigma), x = m + J z + w sigma, and the inequality is of z'J'RJ z + 2 z'J'P (F - v), v the velocity.

With b_i the columns of J'P and models a_i.d + d'Q_i d + r_i of the components of F, |r_i| <= d'E_i d, the left side is
a quadratic form and 2 sum (b_i.d)(d'Q_i d + r_i). What the file gives are the multipliers with which these products are
put below quadratic forms; any that are not negative will do, since 2 p q <= k p^2 + q^2 / k.
"""

from __future__ import annotations

from collections.abc import Sequence

from flint import arb, arb_mat, fmpq_mat

from .balls import ZERO, certainly_definite, finite, norm
from .evidence import Ball, Path
from .fields import exact
from .model import Model
from .rational import positive_definite
from .refusal import require


def sound_multipliers(ball: Ball, rule: str, at: str) -> None:
    """None is negative, and where a component's Q is taken jointly with others every g is positive."""
    none_negative = all(v >= 0 for row in (ball.alpha, ball.beta, ball.g) for v in row)
    require(none_negative, rule, at, "a multiplier is negative")
    divisible = all(v > 0 for v in ball.beta) or all(v > 0 for v in ball.g)
    require(divisible, rule, at, "where a beta is 0 every g must be positive")


def contains(ball: Ball, P: fmpq_mat, level: fmpq_mat) -> bool:
    """Whether J'PJ - level is positive definite: for level = c I, the ball then contains {x'Px <= c}.

    P must be symmetric. J is then invertible, and x = J d gives c ||d||^2 <= x'Px.
    """
    return positive_definite(ball.J.transpose() * P * ball.J - level)


def decreases(ball: Ball, P: fmpq_mat, R: fmpq_mat, F: Sequence[Model]) -> bool:
    """Whether the matrix that is left is certainly positive definite; P and R symmetric, F the models on the ball."""
    n, b = P.nrows(), arb_mat(ball.J.transpose() * P)
    columns = [arb_mat(n, 1, column) for column in b.transpose().tolist()]
    B = b * arb_mat([list(f.a.entries()) for f in F])
    sums = rest(ball, columns, F) + apart(ball, columns, F) + joint(ball, columns, F)
    left = -(arb_mat(ball.J.transpose() * R * ball.J) + B + B.transpose()) - sums
    left = (left + left.transpose()) / 2
    return finite(left.entries()) and certainly_definite(left)


def decreases_along(ball: Ball, path: Path, P: fmpq_mat, R: fmpq_mat, F: Sequence[Model]) -> bool:
    """Whether z'J'RJ z + 2 z'J'P F + edge (z'J'PJ z - 1) + motion (share^2 - sigma^2) is certainly negative.

    For all d = (z, sigma) with ||d|| <= 1. P and R are symmetric, F are models in d, of F less the path's velocity.
    They do not vanish at the centre, so the form is one in (1, d): a first row and column hold what is linear in d.
    """
    n, J, edge, motion = P.nrows(), ball.J, exact(path.edge), exact(path.motion)
    b = arb_mat([*(J.transpose() * P).tolist(), [0] * n])  # no P is along the motion
    columns = [arb_mat(n + 1, 1, column) for column in b.transpose().tolist()]
    B = b * arb_mat([list(f.a.entries()) for f in F])
    linear = b * arb_mat(n, 1, [f.v for f in F])
    known = (J.transpose() * (R + edge * P) * J).tolist()
    bordered = arb_mat([*([*row, 0] for row in known), [0] * n + [-motion]])
    sums = rest(ball, columns, F) + apart(ball, columns, F) + joint(ball, columns, F)
    below = -(bordered + B + B.transpose()) - sums
    below = (below + below.transpose()) / 2
    first = [arb(edge - motion * exact(path.share) ** 2), *(-v for v in linear.entries())]
    left = arb_mat([first, *([v, *row] for v, row in zip(first[1:], below.tolist(), strict=True))])
    return finite(left.entries()) and certainly_definite(left)


def rest(ball: Ball, b: Sequence[arb_mat], F: Sequence[Model]) -> arb_mat:
    """S_rest: 2 |b.d| d'Ed <= alpha (b.d)^2 + d'E'Ed / alpha, or without alpha 2 ||b|| d'Ed."""
    result = nothing(b)
    for alpha, column, f in zip(map(arb, ball.alpha), b, F, strict=True):
        if alpha > 0:
            result += alpha * (column * column.transpose()) + f.E.transpose() * f.E / alpha
        else:
            result += 2 * norm(column.entries()) * f.E
    return result


def apart(ball: Ball, b: Sequence[arb_mat], F: Sequence[Model]) -> arb_mat:
    """S_apart: the same for Q, of components that have a beta."""
    result = nothing(b)
    for beta, column, f in zip(map(arb, ball.beta), b, F, strict=True):
        if beta > 0:
            result += beta * (column * column.transpose()) + f.Q.transpose() * f.Q / beta
    return result


def joint(ball: Ball, b: Sequence[arb_mat], F: Sequence[Model]) -> arb_mat:
    """S_joint: of all other components together, v = sum_i (b_i.d) Q_i d = sum_j d_j C_j d, 2 d'v <= d'gd + v'(1/g)v.

    Where there are none, v is 0 and so is this, whatever g is.
    """
    together = [(column, f) for beta, column, f in zip(ball.beta, b, F, strict=True) if beta == 0]
    if not together:
        return nothing(b)
    result = diagonal([arb(g) for g in ball.g])
    inverse = diagonal([1 / arb(g) for g in ball.g])
    for j in range(len(ball.g)):
        C = sum((column[j, 0] * f.Q for column, f in together), nothing(b))
        result += C.transpose() * inverse * C
    return result


def nothing(b: Sequence[arb_mat]) -> arb_mat:
    """Zeros, with a row for each entry of d."""
    return arb_mat(b[0].nrows(), b[0].nrows())


def diagonal(values: Sequence[arb]) -> arb_mat:
    return arb_mat([[v if i == j else ZERO for j in range(len(values))] for i, v in enumerate(values)])
