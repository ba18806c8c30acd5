"""Second-order Taylor models on a leaf, in which every coefficient is a ball.

The quadratic part is kept as one coefficient for each pair of symbols, i <= j in the order of `pairs`, so that what
cancels between Q_ij and Q_ji is gone at once. None stands for coefficients that are all 0: constants have no g, and
what is affine has no Q.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from flint import arb

from .balls import ZERO, derivatives, finite, third, total
from .refusal import Refused
from .symmetric import pairs

Coefficients = list[arb] | None


def mix(a: arb, x: Coefficients, b: arb, y: Coefficients) -> Coefficients:
    """a x + b y."""
    if x is None:
        return None if y is None else [b * v for v in y]
    return [a * v for v in x] if y is None else [a * v + b * w for v, w in zip(x, y, strict=True)]


def plus(x: Coefficients, y: Coefficients) -> Coefficients:
    if x is None:
        return y
    return x if y is None else [v + w for v, w in zip(x, y, strict=True)]


def square(x: Coefficients, y: Coefficients) -> Coefficients:
    """(x.d)(y.d)."""
    if x is None or y is None:
        return None
    return [x[i] * y[j] + x[j] * y[i] if i < j else x[i] * y[i] for i, j in pairs(len(x))]


@dataclass(frozen=True)
class Taylor:
    """c + g.d + d'Qd + [-r, r] for d in [-1, 1]^symbols."""

    c: arb
    g: Coefficients = None
    Q: Coefficients = None
    r: arb = ZERO

    @cached_property
    def first(self) -> arb:
        """The largest |g.d|."""
        return total(abs(v) for v in self.g or ())

    @cached_property
    def second(self) -> arb:
        """A bound of |d'Qd|."""
        return total(abs(v) for v in self.Q or ())

    def is_finite(self) -> bool:
        return finite([self.c, self.r, *(self.g or ()), *(self.Q or ())])

    def __add__(self, other: Taylor) -> Taylor:
        return Taylor(self.c + other.c, plus(self.g, other.g), plus(self.Q, other.Q), self.r + other.r)

    def averaged(self, symbols: range) -> Taylor:
        """The mean of such numbers for many values of these symbols, each of which then stands for its own mean.

        The mean of the product of two is another number than that of their means: it lies in [-1, 1], that of a square
        in [0, 1].
        """
        if self.Q is None or not symbols:
            return self
        c, r, Q = self.c, self.r, list(self.Q)
        for k, (i, j) in enumerate(pairs(len(self.g or ()))):
            if i in symbols and j in symbols:
                c, r, Q[k] = (c + Q[k] / 2, r + abs(Q[k]) / 2, ZERO) if i == j else (c, r + abs(Q[k]), ZERO)
        return Taylor(c, self.g, Q, r)

    def scaled(self, k: arb) -> Taylor:
        return Taylor(k * self.c, mix(k, self.g, ZERO, None), mix(k, self.Q, ZERO, None), abs(k) * self.r)

    def __neg__(self) -> Taylor:
        return self.scaled(arb(-1))

    def __mul__(self, other: Taylor) -> Taylor:
        p, q = self, other
        r = p.first * q.second + p.second * q.first + p.second * q.second
        r += p.r * (abs(q.c) + q.first + q.second + q.r) + q.r * (abs(p.c) + p.first + p.second)
        Q = plus(mix(p.c, q.Q, q.c, p.Q), square(p.g, q.g))
        return Taylor(p.c * q.c, mix(p.c, q.g, q.c, p.g), Q, r)

    def function(self, name: str) -> Taylor:
        """phi(c) + phi'(c) e + phi''(c) e^2 / 2 + phi'''(.) e^3 / 6 with e the model less its constant c."""
        rest = self.second + self.r
        reach, at = self.first + rest, derivatives(name, self.c)
        most = third(name, at[3], self.c, reach)
        if most is None:
            raise Refused(
                "ring",
                "leaf",
                "a root of what may not be positive" if name == "sqrt" else "a division by what may be 0",
            )
        half = at[2] / 2
        r = abs(at[1]) * self.r + abs(half) * (2 * self.first * rest + rest * rest) + most * reach**3 / 6
        Q = mix(at[1], self.Q, half, square(self.g, self.g))
        return Taylor(at[0], mix(at[1], self.g, ZERO, None), Q, r)

    def is_negative(self) -> bool:
        """True if it certainly is, on all of the box."""
        return bool(self.by_pairs() < 0) or bool(self.from_corner() < 0)

    def bound(self) -> arb:
        """A bound from above: one of two, the lesser if that is certain."""
        first, second = self.by_pairs(), self.from_corner()
        return second if second < first else first

    def by_pairs(self) -> arb:
        """c + r, a bound of each pair, and the exact maximum of g_i t + Q_ii t^2 over |t| <= 1 for each symbol."""
        result = self.c + self.r
        if self.g is None:
            return result
        if self.Q is None:
            return result + self.first
        for (i, j), q in zip(pairs(len(self.g)), self.Q, strict=True):
            g = abs(self.g[i])
            if i < j:
                result += abs(q)
            elif q < 0 and g <= -2 * q:
                result += g * g / (-4 * q)  # at t = -g / 2q
            elif q < 0 and g >= -2 * q:
                result += g + q
            else:
                result += g + q.max(ZERO)
        return result

    def from_corner(self) -> arb:
        """The value at the corner to which g points, and a bound of what a move away from it adds.

        With M_ij = s_i s_j Q_ij for signs s_i, of which any will do, and d_i = s_i (1 - w_i), this is sum_i w_i (sum_j
        -M_ij (2 - w_j) - s_i g_i), where w_i and 2 - w_j lie in [0, 2].
        """
        if self.g is None or self.Q is None:
            return self.c + self.r + self.first
        negative = [bool(v < 0) for v in self.g]
        gains = [v if n else -v for v, n in zip(self.g, negative, strict=True)]  # -s_i g_i and what is added below
        result = self.c + self.r - total(gains)
        for (i, j), q in zip(pairs(len(self.g)), self.Q, strict=True):
            M = -q if negative[i] != negative[j] else q  # 2 M_ij for i < j
            result += M
            if not M >= 0:
                fall = positive_part(-M)
                gains[i] += fall
                gains[j] += fall
        return result + 2 * total(map(positive_part, gains))


def positive_part(v: arb) -> arb:
    """A number at or above v and 0, and the greater of both if that is certain."""
    return ZERO if v <= 0 else v if v >= 0 else abs(v)
