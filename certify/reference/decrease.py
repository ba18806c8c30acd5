"""The matrix inequality of the rules `local` and `tube`: d'J'RJ d + 2 d'J'P F(Jd) < 0 for 0 < ||d|| <= 1.

Along a path d = (z, sigma), x = m + J z + w sigma, and the inequality is of z'J'RJ z + 2 z'J'P (F - v), v the velocity.

With b_i the columns of J'P and models a_i.d + d'Q_i d + K_i[d] + sum_j B_ij e_j + r_i of the components of F the left
side is a quadratic form and what is left of the products of b_i.d with the other parts, each of which is put below a
quadratic form: 2 p q <= k p^2 + q^2 / k for any k > 0. The file gives these numbers, as multipliers or by a weight.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from flint import arb, arb_mat, fmpq_mat

from .balls import ONE, ZERO, certainly_definite, columns_scaled, finite, norm, total
from .evidence import Ball, Path
from .fields import exact
from .loop import Field
from .model import Model
from .network import Units
from .rational import positive_definite
from .refusal import require
from .symmetric import pairs, places


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


def decreases(ball: Ball, P: fmpq_mat, R: fmpq_mat, F: Field) -> bool:
    """Whether the matrix that is left is certainly positive definite; P and R symmetric, F the models on the ball."""
    n, b = P.nrows(), arb_mat(ball.J.transpose() * P)
    columns = [arb_mat(n, 1, column) for column in b.transpose().tolist()]
    B = b * arb_mat([list(f.a.entries()) for f in F.components])
    sums = beyond_second(ball, columns, F)
    left = -(arb_mat(ball.J.transpose() * R * ball.J) + B + B.transpose()) - sums
    left = (left + left.transpose()) / 2
    return finite(left.entries()) and certainly_definite(left)


def decreases_along(ball: Ball, path: Path, P: fmpq_mat, R: fmpq_mat, F: Field) -> bool:
    """Whether z'J'RJ z + 2 z'J'P F + edge (z'J'PJ z - 1) + motion (share^2 - sigma^2) is certainly negative.

    For all d = (z, sigma) with ||d|| <= 1. P and R are symmetric, F are models in d, of F less the path's velocity.
    They do not vanish at the centre, so the form is one in (1, d): a first row and column hold what is linear in d.
    """
    n, J, edge, motion = P.nrows(), ball.J, exact(path.edge), exact(path.motion)
    b = arb_mat([*(J.transpose() * P).tolist(), [0] * n])  # no P is along the motion
    columns = [arb_mat(n + 1, 1, column) for column in b.transpose().tolist()]
    B = b * arb_mat([list(f.a.entries()) for f in F.components])
    linear = b * arb_mat(n, 1, [f.v for f in F.components])
    known = (J.transpose() * (R + edge * P) * J).tolist()
    bordered = arb_mat([*([*row, 0] for row in known), [0] * n + [-motion]])
    sums = beyond_second(ball, columns, F)
    below = -(bordered + B + B.transpose()) - sums
    below = (below + below.transpose()) / 2
    first = [arb(edge - motion * exact(path.share) ** 2), *(-v for v in linear.entries())]
    left = arb_mat([first, *([v, *row] for v, row in zip(first[1:], below.tolist(), strict=True))])
    return finite(left.entries()) and certainly_definite(left)


def beyond_second(ball: Ball, b: Sequence[arb_mat], F: Field) -> arb_mat:
    """S: what bounds the parts of the form that are no square."""
    known = rest(ball, b, F.components) + apart(ball, b, F.components) + joint(ball, b, F.components)
    return known + cubic(ball, b, F.components) + units(ball, b, F.components, F.units)


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


def cubic(ball: Ball, b: Sequence[arb_mat], F: Sequence[Model]) -> arb_mat:
    """S_cubic: of components that have a beta each (b_i.d) K_i[d] by itself, |K_i[d]| <= ||d||^2 ||T_i d||.

    The sum of all others is sum_k d_k N_k[d], N the mean of its coefficients over all orders of four indices, and
    |N_k[d]| <= ||d||^2 ||N_k d||. T_i and N_k are matrices with a row for each two indices.
    """
    size, weight, result = b[0].nrows(), arb_mat(ball.weight), nothing(b)
    place, two, quarter = places(size), pairs(size), ONE / 4
    if all(f.twist.is_zero() for f in F):
        return result
    together = list[tuple[arb_mat, Model]]()
    for beta, column, f in zip(ball.beta, b, F, strict=True):
        if beta > 0:
            K = f.K.entries()
            rows = [[K[place[(h * size + i) * size + j]] for j in range(size)] for h, i in two]
            result += balanced(column, square_of(rows, two), weight)
        else:
            together.append((column, f))
    if not together:
        return result
    columns = arb_mat([column.entries() for column, _ in together]).transpose()
    M = (columns * arb_mat([f.K.entries() for _, f in together])).tolist()
    for k in range(size):
        rows = []
        for h, i in two:
            hi, ki, kh = ((p * size + q) * size for p, q in ((h, i), (k, i), (k, h)))
            row = [
                (M[k][place[hi + j]] + M[h][place[ki + j]] + M[i][place[kh + j]] + M[j][place[kh + i]]) * quarter
                for j in range(size)
            ]
            rows.append(row)
        result += balanced(unit_vector(k, size), square_of(rows, two), weight)
    return result


def square_of(rows: list[list[arb]], two: Sequence[tuple[int, int]]) -> arb_mat:
    """T'T of a matrix with a row for each two indices, of which both orders are one of these rows."""
    counted = [row if h == i else [2 * v for v in row] for row, (h, i) in zip(rows, two, strict=True)]
    return arb_mat(rows).transpose() * arb_mat(counted)


def units(ball: Ball, b: Sequence[arb_mat], F: Sequence[Model], each: Units) -> arb_mat:
    """S_units: 2 sum_q (p_q.d) e_q with p_q = sum_i b_i sum_j B_ij L_jq, and |e_q| <= ||d|| ||R_q d||."""
    size = b[0].nrows()
    if not each.R:
        return nothing(b)
    columns = arb_mat([column.entries() for column in b]).transpose()
    p, weight = columns * arb_mat([list(f.B) for f in F]) * each.L, arb_mat(ball.weight)
    lengths = row_products(p.transpose() * weight, p.transpose())
    traces = (each.squares * arb_mat(size**2, 1, weight.transpose().entries())).entries()
    taus, inverses = list[arb](), list[arb]()
    for column, row, length, trace in zip(p.transpose().tolist(), each.R, lengths, traces, strict=True):
        tau = ZERO if is_zero(column) or is_zero(row) else share(trace, length)
        taus.append(tau)
        inverses.append(ZERO if tau.is_zero() else 1 / tau)
    outer = columns_scaled(p, taus) * p.transpose()
    inner = (arb_mat(1, len(inverses), inverses) * each.squares).entries()
    return outer + arb_mat(size, size, inner)


def balanced(p: arb_mat, square: arb_mat, weight: arb_mat) -> arb_mat:
    """<p, T> = tau p p' + T'T / tau, given T'T: 2 |p.d| ||T d|| <= d'<p, T>d."""
    if is_zero(p.entries()) or is_zero(square.entries()):
        return arb_mat(square.nrows(), square.nrows())
    tau = share((square * weight).trace(), (p.transpose() * weight * p)[0, 0])
    return tau * (p * p.transpose()) + square / tau


def share(trace: arb, length: arb) -> arb:
    """tau = sqrt(tr(T weight T') / p'weight p), or 1; any positive number will do, so it is one number and no ball."""
    tau = arb((trace / length).sqrt().mid()) if length != 0 else ONE
    return tau if tau.is_finite() and tau > 0 else ONE


def row_products(A: arb_mat, B: arb_mat) -> list[arb]:
    """The sum of the products of each row of A with that of B."""
    return [total(x * y for x, y in zip(a, b, strict=True)) for a, b in zip(A.tolist(), B.tolist(), strict=True)]


def unit_vector(k: int, n: int) -> arb_mat:
    return arb_mat(n, 1, [int(i == k) for i in range(n)])


def is_zero(values: Iterable[arb]) -> bool:
    """Whether all of them are exactly 0."""
    return all(v.is_zero() for v in values)


def nothing(b: Sequence[arb_mat]) -> arb_mat:
    """Zeros, with a row for each entry of d."""
    return arb_mat(b[0].nrows(), b[0].nrows())


def diagonal(values: Sequence[arb]) -> arb_mat:
    return arb_mat([[v if i == j else ZERO for j in range(len(values))] for i, v in enumerate(values)])
