"""Second-order Taylor models on a leaf, in which every coefficient is a ball.

The coefficients are matrices, so that one operation of flint meets all of them. None stands for coefficients that are
all 0: constants have no g, and what is affine has no Q.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from functools import cache

from flint import arb, arb_mat, fmpq

from .balls import ONE, SPREAD, ZERO, cube, total
from .refusal import Refused
from .rows import Function
from .table import FUNCTIONS

HALF = ONE / 2
LITTLE = ONE / 2**30


def mix(a: arb, x: arb_mat | None, b: arb, y: arb_mat | None) -> arb_mat | None:
    """a x + b y."""
    if x is None:
        return None if y is None else y * b
    return x * a if y is None else x * a + y * b


def plus(x: arb_mat | None, y: arb_mat | None) -> arb_mat | None:
    if x is None:
        return y
    return x if y is None else x + y


@cache
def anywhere(symbols: int) -> arb_mat:
    """Every d of the box at once, a column; callers must not change it."""
    return arb_mat(symbols, 1, [SPREAD] * symbols)


@cache
def anywhere_row(symbols: int) -> arb_mat:
    return anywhere(symbols).transpose()


def largest(value: arb_mat) -> arb:
    """The largest magnitude in a ball, which is the only entry."""
    return arb(value[0, 0].abs_upper())


class Taylor:
    """c + g.d + d'Qd + [-r, r] for d in [-1, 1]^symbols; g is a row, Q symmetric. Nothing changes a model.

    A plain class, for a leaf has dozens of models and a certificate many thousands of leaves.
    """

    __slots__ = ("Q", "c", "g", "r", "reached")

    def __init__(self, c: arb, g: arb_mat | None = None, Q: arb_mat | None = None, r: arb = ZERO) -> None:
        if g is None and Q is not None:
            g = arb_mat(1, Q.ncols())
        self.c, self.g, self.Q, self.r = c, g, Q, r
        self.reached: tuple[arb, arb] | None = None

    def reaches(self) -> tuple[arb, arb]:
        """Bounds of |g.d| and of |d'Qd|: in balls the magnitudes of all coefficients add up."""
        if self.reached is None:
            first = second = ZERO
            if self.g is not None:
                d = anywhere(self.g.ncols())
                first = largest(self.g * d)
                if self.Q is not None:
                    second = largest(anywhere_row(self.g.ncols()) * (self.Q * d))
            self.reached = first, second
        return self.reached

    @property
    def first(self) -> arb:
        return self.reaches()[0]

    @property
    def second(self) -> arb:
        return self.reaches()[1]

    @property
    def symbols(self) -> int:
        return 0 if self.g is None else int(self.g.ncols())

    def is_finite(self) -> bool:
        """True if all coefficients are, for the bounds of no others are."""
        return bool((self.c + sum(self.reaches(), self.r)).is_finite())

    def __add__(self, other: Taylor) -> Taylor:
        return Taylor(self.c + other.c, plus(self.g, other.g), plus(self.Q, other.Q), self.r + other.r)

    def averaged(self, symbols: Collection[int]) -> Taylor:
        """The mean of such numbers for many values of these symbols, each of which then stands for its own mean.

        The mean of the product of two is another number than that of their means: it lies in [-1, 1], that of a square
        in [0, 1].
        """
        if self.Q is None or not symbols:
            return self
        c, r, rows = self.c, self.r, self.Q.tolist()
        for i in symbols:
            c += rows[i][i] / 2
            r += abs(rows[i][i]) / 2 + total(abs(rows[i][j]) for j in symbols if j != i)
            rows[i] = [ZERO if j in symbols else v for j, v in enumerate(rows[i])]
        return Taylor(c, self.g, arb_mat(rows), r)

    def scaled(self, k: arb) -> Taylor:
        return Taylor(k * self.c, mix(k, self.g, ZERO, None), mix(k, self.Q, ZERO, None), abs(k) * self.r)

    def __neg__(self) -> Taylor:
        return Taylor(-self.c, None if self.g is None else -self.g, None if self.Q is None else -self.Q, self.r)

    def widened(self, more: arb) -> Taylor:
        return Taylor(self.c, self.g, self.Q, self.r + more)

    def __mul__(self, other: Taylor) -> Taylor:
        p, q = self, other
        if p.g is None or q.g is None:
            p, q = (p, q) if p.g is None else (q, p)
            return q.scaled(p.c).widened(p.r * (abs(q.c) + q.first + q.second + q.r))
        return p.without_third(q).widened(p.first * q.second + p.second * q.first)

    def without_third(self, other: Taylor) -> Taylor:
        """The product without what is of third order."""
        p, q = self, other
        if p.g is None or q.g is None:
            return p * q
        (p_first, p_second), (q_first, q_second) = p.reaches(), q.reaches()
        r = p_second * q_second
        if not q.r.is_zero():
            r += q.r * (abs(p.c) + p_first + p_second)
        if not p.r.is_zero():
            r += p.r * (abs(q.c) + q_first + q_second + q.r)
        outer = p.g.transpose() * (q.g * HALF)
        Q = plus(mix(p.c, q.Q, q.c, p.Q), outer + outer.transpose())
        return Taylor(p.c * q.c, q.g * p.c + p.g * q.c, Q, r)

    def slopes(self, symbols: int) -> list[arb]:
        """g, which has so many entries or none."""
        return [ZERO] * symbols if self.g is None else list(self.g.entries())

    @property
    def reach(self) -> arb:
        """A bound of how far the model is from c."""
        return sum(self.reaches(), self.r)

    def sign(self) -> int:
        """1 or -1 where it certainly has this sign on all of the box, else 0."""
        return 1 if self.c > self.reach else -1 if -self.c > self.reach else 0

    def function(self, name: str) -> Taylor:
        """phi of the model; where it may have a corner the line in the middle between two, and how far these are."""
        row = FUNCTIONS[name]
        at = row.derivatives(self.c)
        most = row.third(self.c, at, self.reach)
        if most is None and row.cornered and self.g is None and self.r.is_zero():
            return Taylor(row.value(self.c))
        between = row.line(self.c, self.reach) if most is None and row.cornered else None
        if between is None:
            return self.expanded(row, at[:3], most)
        slope, shift, gap = between
        return (self.scaled(slope) + Taylor(shift)).widened(gap)

    def slope_of(self, name: str) -> Taylor:
        """phi' of the model: its third derivative is the fourth of phi."""
        row = FUNCTIONS[name]
        at = row.derivatives(self.c)
        return self.expanded(row, at[1:], row.last(self.c, at, self.reach))

    def expanded(self, row: Function, at: Sequence[arb], most: arb | None) -> Taylor:
        """phi(c) + phi'(c) e + phi''(c) e^2 / 2 + phi'''(.) e^3 / 6 with e the model less its constant c.

        `at` has the first three of these, `most` is a bound of |phi'''|, or None where phi may be undefined.
        """
        first, second = self.reaches()
        rest = second + self.r
        reach = first + rest
        if most is None:
            raise Refused("ring", "leaf", row.undefined)
        half = at[2] / 2
        r = abs(at[1]) * self.r + abs(half) * (2 * first * rest + rest * rest) + most * cube(reach) / 6
        Q = mix(at[1], self.Q, ZERO, None)
        if self.g is not None and not half.is_zero():
            Q = plus(Q, self.g.transpose() * (self.g * half))
        return Taylor(at[0], mix(at[1], self.g, ZERO, None), Q, r)

    def is_negative(self) -> bool:
        """True if it certainly is, on all of the box."""
        return bool(self.by_squares() < 0) or bool(self.from_corner() < 0)

    def bound(self) -> arb:
        """A bound from above: one of two, the lesser if that is certain."""
        first, second = self.by_squares(), self.from_corner()
        return second if second < first else first

    def by_squares(self) -> arb:
        """The largest sum of terms in one symbol, after 2 |d_i d_j| <= d_i^2 + d_j^2."""
        result = self.c + self.r
        if self.g is None:
            return result
        if self.Q is None:
            return result + total(map(abs, self.g.entries()))  # exact, where `first` is rounded
        squares = [row[i] for i, row in enumerate(self.Q.tolist())]
        for i, j, q in self.mixed():
            squares[i] += abs(q)
            squares[j] += abs(q)
        return result + total(peak(abs(g), q) for g, q in zip(self.g.entries(), squares, strict=True))

    def from_corner(self) -> arb:
        """The same around the corner to which g points, of 1 and -1: d_i = s_i e_i, where -e_i e_j <= 1 - e_i - e_j.

        This is taken for the pairs whose term is certainly negative at the corner.
        """
        if self.g is None or self.Q is None:
            return self.by_squares()
        rows, result = self.Q.tolist(), self.c + self.r
        down = directions(self.g.entries(), rows)
        slopes = [-g if s else g for g, s in zip(self.g.entries(), down, strict=True)]
        squares = [row[i] for i, row in enumerate(rows)]
        for i, j, q in self.mixed():
            M = q if down[i] == down[j] else -q
            if M < 0:
                result -= 2 * M
                slopes[i] += 2 * M
                slopes[j] += 2 * M
            else:
                squares[i] += abs(M)
                squares[j] += abs(M)
        return result + total(peak(abs(v), q) for v, q in zip(slopes, squares, strict=True))

    def mixed(self) -> list[tuple[int, int, arb]]:
        """(i, j, Q_ij) for i < j, of what is not 0."""
        rows = [] if self.Q is None else self.Q.tolist()
        each = ((i, j, q) for i, row in enumerate(rows) for j, q in enumerate(row[i + 1 :], i + 1))
        return [(i, j, q) for i, j, q in each if not q.is_zero()]


def peak(g: arb, q: arb) -> arb:
    """A bound of g t + q t^2 over |t| <= 1, g >= 0: its value at 1 where it certainly rises until there. At -g / 2q it
    is nowhere less, if q is negative."""
    if g >= -2 * q:
        return g + q
    return g * g / (-4 * q) if q < 0 else g + q.max(ZERO)


def directions(g: list[arb], rows: list[list[arb]]) -> list[bool]:
    """True where a corner's entry is -1: by the sign of g_i or, where |g_i| <= 2^-30 sum |g| is what multipliers may
    have left of 0, by that of sum_j Q_ij s_j over the other entries."""
    least = sum(map(abs, g), ZERO) * LITTLE
    told = [None if not abs(v) > least else bool(v < 0) for v in g]
    return [
        bool(sum((-q if t else q for t, q in zip(told, row, strict=True) if t is not None), ZERO).mid() < 0)
        if s is None
        else s
        for s, row in zip(told, rows, strict=True)
    ]


def inner_product(x: Sequence[Taylor], y: Sequence[Taylor]) -> Taylor:
    """At least sum_i x_i y_i, and nothing else is known of it.

    Its terms of third order have their coefficients from all products, c_ijk for i <= j <= k, and |d_i d_j d_k| is at
    most (d_i^2 + d_j^2 + d_k^2) / 3.
    """
    result, gradients, forms = Taylor(ZERO), list[arb_mat](), list[arb_mat]()
    for p, q in zip(x, y, strict=True):
        result += p.without_third(q)
        for g, Q in ((p.g, q.Q), (q.g, p.Q)):
            if g is not None and Q is not None:
                gradients.append(g)
                forms.append(Q)
    if not forms:
        return result
    N = forms[0].ncols()
    pairs = [(j, k) for j in range(N) for k in range(j, N)]
    rows = arb_mat([[Q[j, k] if j == k else 2 * Q[j, k] for j, k in pairs] for Q in forms])
    times = arb_mat([list(g.entries()) for g in gradients]).transpose() * rows
    third: dict[tuple[int, ...], arb] = {}
    for i, row in enumerate(times.tolist()):
        for (j, k), c in zip(pairs, row, strict=True):
            at = tuple(sorted((i, j, k)))
            third[at] = third[at] + c if at in third else c
    squares = [ZERO] * N
    for at, c in third.items():
        if not c.is_zero():
            share = abs(c) / 3
            for i in at:
                squares[i] += share
    more = arb_mat(N, N)
    for i, v in enumerate(squares):
        more[i, i] = v
    return Taylor(result.c, result.g, plus(result.Q, more), result.r)


def constant(q: fmpq) -> Taylor:
    return Taylor(arb(q))


def is_negative(D: Taylor, slacks: Sequence[Taylor]) -> bool:
    """True if D, or D + k times one of the others for some k > 0, is certainly negative."""
    if D.is_negative():
        return True
    return any(k > 0 and (D + slack.scaled(k)).is_negative() for slack in slacks for k in kinks(D, slack))


def kinks(D: Taylor, slack: Taylor) -> list[arb]:
    """Each k at which a coefficient of the first order vanishes in D + k slack."""
    if D.g is None or slack.g is None:
        return []
    each = zip(D.g.entries(), slack.g.entries(), strict=True)
    return [-(g / w).mid() for g, w in each if not w.is_zero()]
