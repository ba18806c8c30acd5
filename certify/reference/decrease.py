"""The matrix inequality of the rules `local` and `tube`: d'J'RJ d + 2 d'J'P G + h G'PG < 0 for 0 < ||d|| <= 1.

G is F in continuous time, where h = 0, and by how much the state changes, over h, where time has steps. Around a
level G need not vanish at the centre, and the inequality has k (V - c0) beside it. Along a path d = (z, sigma), x = m +
J z + w sigma, and it is of z'J'RJ z + 2 z'J'P (F - v), v the velocity.

With b_i the columns of (J + h A)'P and models f_i + a_i.d + d'Q_i d + K_i[d] + sum_j B_ij e_j + r_i of the components
of G, a_i the rows of A, the left side is a quadratic form, what is left of the products of b_i.d with the other parts,
and the square of these. Each is put below a quadratic form: 2 p q <= k p^2 + q^2 / k for any k > 0. The file gives
these numbers, as multipliers or by a weight.

Where something is uncertain f and A are affine in its symbols y. At one d, and for one value of the other parts, the
left side is a convex function of G, as P is positive definite, and so of y: it is largest at a corner of [-1, 1]^N.
Of many symbols most are no corners' but errors eps_i of the components, of which 2 (b_i.d) eps_i is bounded as above,
term by term, and the rest by lengths.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import product

from flint import arb, arb_mat, fmpq, fmpq_mat

from .balls import ONE, ZERO, certainly_definite, columns_scaled, finite, identity, norm, total
from .evidence import Ball, Path
from .fields import exact
from .kinks import Cone, multiplier
from .loop import Field
from .model import Model
from .rational import positive_definite
from .refusal import require
from .symmetric import orders, pairs, places
from .tangents import Units

AT_CORNERS = 6  # uncertain quantities whose corners are all asked
MAX_CORNERS = 2**16  # of one cell
NO_STEP = fmpq(0)


def sound_multipliers(ball: Ball, rule: str, at: str) -> None:
    """None is negative, and where a component's Q is taken jointly with others every g is positive."""
    none_negative = all(v >= 0 for row in (ball.alpha, ball.beta, ball.g) for v in row)
    require(none_negative, rule, at, "a multiplier is negative")
    divisible = all(v > 0 for v in ball.beta) or all(v > 0 for v in ball.g)
    require(divisible, rule, at, "where a beta is 0 every g must be positive")


def contains(ball: Ball, P: fmpq_mat, level: fmpq_mat) -> bool:
    """True if J'PJ - level is positive definite: for level = c I, the ball then contains {x'Px <= c}.

    P must be symmetric. J is then invertible, and x = J d gives c ||d||^2 <= x'Px.
    """
    return positive_definite(ball.J.transpose() * P * ball.J - level)


def whatever_y(F: Field, holds: Callable[[Field], bool], P: fmpq_mat | None = None) -> bool:
    """True if it holds with every y absorbed into the balls of the models, or else at each corner.

    With P, where more than AT_CORNERS move anything, only the corners of those that move most are asked, and the
    others are handed over as `others`.
    """
    count = max(len(f.dv) for f in F.components)
    if count == 0:
        return holds(F)
    if holds(F.whatever()):
        return True
    moved = [not all(f.without(j) for f in F.components) for j in range(count)]
    if P is not None and sum(moved) > AT_CORNERS:
        order = sorted((j for j in range(count) if moved[j]), key=lambda j: effect(F, j, P), reverse=True)
        F = replace(F, others=tuple(F.moved_by(j) for j in order[AT_CORNERS:]))
        moved = [j in order[:AT_CORNERS] for j in range(count)]
    few = 2 ** sum(moved) <= MAX_CORNERS
    return few and all(holds(F.where(y)) for y in product(*((-1, 1) if each else (0,) for each in moved)))


def effect(F: Field, j: int, P: fmpq_mat) -> tuple[bool, float]:
    """By how much y_j moves F, to order the symbols: any order will do."""
    each = F.moved_by(j)
    size = total(arb(abs(P[i, i])).sqrt() * norm(da.entries()) for i, (_, da) in enumerate(each))
    return any(not dv.is_zero() for dv, _ in each), float(size.mid())


def decreases(ball: Ball, P: fmpq_mat, R: fmpq_mat, G: Field, h: fmpq = NO_STEP) -> bool:
    """True if the remaining matrix is certainly positive definite, at rest: G vanishes at d = 0, exactly.

    P, positive definite where h > 0, and R are symmetric, G are the models on the ball, without y.
    """
    known, A, columns = quadratic(ball, P, R, G, h)
    gamma = length_beyond(P, G, A.nrows()) if h > 0 else ZERO
    along = doubts(P, G, h, columns, gamma)[1] + arb(h) * gamma * gamma
    errors = of_others(columns, [[da for _, da in each] for each in G.others], arb_mat(ball.weight))
    errors += of_kinks(columns, G, weight_on(G.cone, ball.weight))
    left = -known - beyond_second(ball, columns, G) - errors - along * identity(A.ncols())
    return positive_on(G.cone, left)


def decreases_around(ball: Ball, P: fmpq_mat, R: fmpq_mat, G: Field, h: fmpq, level: fmpq) -> bool:
    """True if d'J'RJ d + 2 d'J'P G + h G'PG + edge (V - level) is certainly negative on the ball, V = d'J'PJ d.

    The form is one in (1, d): a first row and column hold the value of G at the centre.
    """
    n, k = P.nrows(), exact(ball.edge)
    known, A, columns = quadratic(ball, P, R + k * P, G, h)
    f, of_P = arb_mat(n, 1, [g.v for g in G.components]), arb_mat(P)
    length = (f.transpose() * of_P * f)[0, 0]
    gamma = length_beyond(P, G, n) if h > 0 else ZERO
    at_centre, along = doubts(P, G, h, columns, gamma, arb(h) * (of_P * f))
    along += arb(h) * (gamma * gamma + 2 * root(length) * gamma)
    below = -known - beyond_second(ball, columns, G) - along * identity(n)
    linear = -((arb_mat(ball.J) + arb(h) * A).transpose() * of_P * f)
    first = [arb(k * level) - arb(h) * length - at_centre, *linear.entries()]
    below = (below + below.transpose()) / 2
    whole = arb_mat([first, *([v, *row] for v, row in zip(first[1:], below.tolist(), strict=True))])
    at_1 = (arb(h) * (of_P * f)).entries()
    b = [arb_mat(n + 1, 1, [p, *column.entries()]) for p, column in zip(at_1, columns, strict=True)]
    others = [[arb_mat(n + 1, 1, [dv, *da.entries()]) for dv, da in each] for each in G.others]
    whole -= of_others(b, others, with_one(arb_mat(ball.weight)))
    return positive_on(G.cone, whole - of_kinks(b, G, with_one(weight_on(G.cone, ball.weight))))


def doubts(
    P: fmpq_mat,
    G: Field,
    h: fmpq,
    columns: Sequence[arb_mat],
    gamma: arb,
    moved: arb_mat | None = None,
    share: arb = ONE / 4,
) -> tuple[arb, arb]:
    """Parts of the form, those of 1 and of each entry of d, that cover what is not known of values and gradients.

    An error eps_i within e_i + s_i ||d|| adds 2 sum_i (h (P f)_i + b_i.d) eps_i + 2 h eps'P g + h eps'P eps, and
    2 ||d|| is at most share + ||d||^2 / share. `moved` is h P f; without it f is 0, exactly, and so is each e_i.
    """
    components = G.components
    turn = total(2 * norm(b.entries()) * g.slack for b, g in zip(columns, components, strict=True))
    roots = [arb(P[i, i]).sqrt() for i in range(P.nrows())] if h > 0 else []
    s = total(root * g.slack for root, g in zip(roots, components, strict=h > 0))
    far, wide = lengths_of_others(P, G) if h > 0 else (ZERO, ZERO)
    s += wide + (length_of_kinks(P, G) if h > 0 else ZERO)
    turn += arb(h) * (s * s + 2 * gamma * s)
    if moved is None:
        return ZERO, turn
    e = far + total(root * g.off for root, g in zip(roots, components, strict=h > 0))
    each = list(zip(columns, map(abs, moved.entries()), components, strict=True))
    both = total(norm(b.entries()) * g.off + p * g.slack for b, p, g in each) + arb(h) * e * s
    still = total(2 * p * g.off for _, p, g in each) + arb(h) * e * e
    return still + share * both, turn + 2 * arb(h) * gamma * e + both / share


def lengths_of_others(P: fmpq_mat, G: Field) -> tuple[arb, arb]:
    """(e, s): with ||v|| = (v'Pv)^(1/2) what the others add to G is never longer than e + s ||d||."""
    of_P, e, s = arb_mat(P), ZERO, ZERO
    for each in G.others:
        e += length_of(arb_mat([[dv] for dv, _ in each]), of_P)
        s += length_of(arb_mat([list(da.entries()) for _, da in each]), of_P)
    return e, s


def of_others(b: Sequence[arb_mat], others: Sequence[Sequence[arb_mat]], weight: arb_mat) -> arb_mat:
    """S_ranges: a bound of 2 sum_i |b_i.d| |a_i.d| of each of the others, whose columns a_i are given, as that of
    pairs."""
    result = arb_mat(weight.nrows(), weight.nrows())
    for each in others:
        for p, a in zip(b, each, strict=True):
            result += balanced(p, a * a.transpose(), weight)
    return result


def of_kinks(b: Sequence[arb_mat], G: Field, weight: arb_mat) -> arb_mat:
    """S_kinks: 2 sum_q (p_q.d) e_q, p_q = sum_i b_i sum_j B_ij L_jq, |e_q| <= |alpha_q.d| + beta_q ||d||. The b_i may
    have an entry of 1 before those of d."""
    size, n = weight.nrows(), G.units.n
    result = arb_mat(size, size)
    if not G.units.kinks:
        return result
    above, square = size - n, nothing(b)
    for i in range(above, size):
        square[i, i] = ONE
    p = arb_mat([column.entries() for column in b]).transpose() * arb_mat([list(g.B) for g in G.components]) * G.units.L
    columns = p.transpose().tolist()
    for q, kink in G.units.kinks.items():
        column = arb_mat(size, 1, columns[q])
        alpha = arb_mat(size, 1, [ZERO] * above + kink.alpha.entries())
        result += balanced(column, alpha * alpha.transpose(), weight)
        result += balanced(column, kink.beta * kink.beta * square, weight)
    return result


def length_of_kinks(P: fmpq_mat, G: Field) -> arb:
    """A number s: with ||v|| = (v'Pv)^(1/2) what kinks add to G is never longer than s ||d||."""
    if not G.units.kinks:
        return ZERO
    moved = (arb_mat([list(g.B) for g in G.components]) * G.units.L).transpose()
    lengths = row_products(moved * arb_mat(P), moved)
    return total(root(lengths[q]) * kink.rho for q, kink in G.units.kinks.items())


def weight_on(cone: Cone | None, weight: fmpq_mat) -> arb_mat:
    return arb_mat(weight) if cone is None or cone.is_all else cone.weight


def with_one(weight: arb_mat) -> arb_mat:
    """The weight of (1, d). That of 1 is 16 times that of d: d is short where a level is reached."""
    n = weight.nrows()
    return arb_mat([[16 * weight.trace(), *[ZERO] * n], *([ZERO, *row] for row in weight.tolist())])


def quadratic(ball: Ball, P: fmpq_mat, R: fmpq_mat, G: Field, h: fmpq) -> tuple[arb_mat, arb_mat, list[arb_mat]]:
    """J'RJ + J'PA + A'PJ + h A'PA, A, and the columns of (J + h A)'P."""
    n, b = P.nrows(), arb_mat(ball.J.transpose() * P)
    A = arb_mat([list(g.a.entries()) for g in G.components])
    B, known = b * A, arb_mat(ball.J.transpose() * R * ball.J)
    known += B + B.transpose()
    if h > 0:
        stepped = arb(h) * (A.transpose() * arb_mat(P))
        known, b = known + stepped * A, b + stepped
    return known, A, [arb_mat(n, 1, column) for column in b.transpose().tolist()]


def length_beyond(P: fmpq_mat, G: Field, size: int) -> arb:
    """Gamma: with ||v|| = (v'Pv)^(1/2) all that is beyond the first order is within Gamma ||d||^2.

    sum_i e_i d'Q_i d is the image of the matrix dd' under a linear map, and so is that of K; each error counts with the
    length of what it moves.
    """
    of_P, components = arb_mat(P), G.components
    bent, cubes = forms_of(G)
    gamma = length_of(bent, of_P) + length_of(cubes, of_P)
    gamma += total(arb(P[i, i]).sqrt() * norm(g.E.entries()) for i, g in enumerate(components))
    if G.units.R:
        moved = (arb_mat([list(g.B) for g in components]) * G.units.L).transpose()
        lengths = row_products(moved * of_P, moved)
        sizes = [total(G.units.squares[q, i * (size + 1)] for i in range(size)) for q in range(len(lengths))]
        gamma += total(root(v) * root(w) for v, w in zip(lengths, sizes, strict=True))
    return gamma


def forms_of(G: Field) -> tuple[arb_mat, arb_mat]:
    """The coefficients of Q and of K, a row for each component, those of K scaled: some stand in several orders."""
    bent = arb_mat([list(g.Q.entries()) for g in G.components])
    often = [arb(count).sqrt() for count in orders(G.components[0].a.nrows())]
    return bent, columns_scaled(arb_mat([list(g.K.entries()) for g in G.components]), often)


def length_of(M: arb_mat, P: arb_mat) -> arb:
    """The root of sum_ij P_ij M_i.M_j over the rows of M."""
    return root(total(row_products(P * M, M)))


def root(value: arb) -> arb:
    """The largest root of what is not negative."""
    return arb(value.upper()).sqrt()


def certainly_positive(left: arb_mat) -> bool:
    """True if the symmetric part of each matrix is positive definite, by its pivots or by its midpoints and radii.

    A ball takes part in many pivots and counts in each for itself. But with the radii r_ij the form of what a matrix
    differs from its midpoints by is at most sum r_ij |d_i| |d_j|, and that at most sum_i d_i^2 sum_j r_ij w_j / w_i,
    for any w > 0: here of the size that evens out the diagonal.
    """
    left = (left + left.transpose()) / 2
    if not finite(left.entries()):
        return False
    if certainly_definite(left):
        return True
    rows, n = left.tolist(), left.nrows()
    if not all(rows[i][i].mid() > 0 for i in range(n)):
        return False
    w = [arb((1 / arb(rows[i][i].mid()).sqrt()).mid()) for i in range(n)]
    middle = [[arb(v.mid()) for v in row] for row in rows]
    for i in range(n):
        middle[i][i] -= total(arb(rows[i][j].rad()) * w[j] for j in range(n)) / w[i]
    return certainly_definite(arb_mat(middle))


def positive_on(cone: Cone | None, left: arb_mat) -> bool:
    """True if the form of each matrix is certainly positive on the cone but for 0, by one mu >= 0 or by none.

    On the cone c.d >= t ||d||, so that (c.d)^2 - t^2 d.d is not negative there. A matrix may have a row for 1 first.
    """
    if certainly_positive(left):
        return True
    if cone is None or cone.is_all or not finite(left.entries()):
        return False
    n, above = cone.axis.nrows(), left.nrows() - cone.axis.nrows()
    inner = [[ZERO] * above + row for row in cone.slack.tolist()]
    slack = arb_mat([[ZERO] * (above + n)] * above + inner)
    left = (left + left.transpose()) / 2
    return certainly_positive(left - multiplier(left, slack, cone) * slack)


def decreases_along(ball: Ball, path: Path, P: fmpq_mat, R: fmpq_mat, F: Field) -> bool:
    """True if z'J'RJ z + 2 z'J'P F + edge (z'J'PJ z - 1) + motion (share^2 - sigma^2) is certainly negative.

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
    at_centre, along = doubts(P, F, NO_STEP, columns, ZERO, arb_mat(n, 1), ONE)
    below = -(bordered + B + B.transpose()) - beyond_second(ball, columns, F) - along * identity(n + 1)
    below = (below + below.transpose()) / 2
    first = [arb(edge - motion * exact(path.share) ** 2) - at_centre, *(-v for v in linear.entries())]
    left = arb_mat([first, *([v, *row] for v, row in zip(first[1:], below.tolist(), strict=True))])
    return finite(left.entries()) and certainly_definite(left)


def beyond_second(ball: Ball, b: Sequence[arb_mat], F: Field) -> arb_mat:
    """S: the bound of the parts of the form beyond the square."""
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
            result += with_cubic(column, f, weight)
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


def with_cubic(column: arb_mat, f: Model, weight: arb_mat) -> arb_mat:
    """<b, T> of the K of one component."""
    size, K = column.nrows(), f.K.entries()
    place, two = places(size), pairs(size)
    rows = [[K[place[(h * size + i) * size + j]] for j in range(size)] for h, i in two]
    return balanced(column, square_of(rows, two), weight)


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
    """tau = sqrt(tr(T weight T') / p'weight p), or 1; any positive number will do, so it is one number and no ball.

    Of balls that may be 0 it is the largest values that count.
    """
    ratio = trace / length
    if not (ratio > 0 or ratio < 0):
        ratio = arb(abs(trace).upper()) / arb(abs(length).upper())
    tau = arb(ratio.sqrt().mid())
    return tau if tau.is_finite() and tau > 0 else ONE


def row_products(A: arb_mat, B: arb_mat) -> list[arb]:
    """The sum of the products of each row of A with that of B."""
    return [total(x * y for x, y in zip(a, b, strict=True)) for a, b in zip(A.tolist(), B.tolist(), strict=True)]


def unit_vector(k: int, n: int) -> arb_mat:
    return arb_mat(n, 1, [int(i == k) for i in range(n)])


def is_zero(values: Iterable[arb]) -> bool:
    """True if all of them are exactly 0."""
    return all(v.is_zero() for v in values)


def nothing(b: Sequence[arb_mat]) -> arb_mat:
    """Zeros, with a row for each entry of d."""
    return arb_mat(b[0].nrows(), b[0].nrows())


def diagonal(values: Sequence[arb]) -> arb_mat:
    return arb_mat([[v if i == j else ZERO for j in range(len(values))] for i, v in enumerate(values)])
