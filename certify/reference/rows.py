"""Rows of the table of functions: what is known of each, and the functions whose derivatives are written down.

A row has the exact value, as far as rationals have it; phi, phi', phi'' and phi''' on a ball; bounds of what phi adds
to its parabola and to its cubic at y, which are those of phi''' and phi'''' near y or better; and lines around phi.

A division by a ball that contains 0, or a root of one that contains numbers that are not positive, must be refused
whatever the use of the result: 0 times it is 0. A bound that is None refuses, with the words that `undefined` has.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

from flint import arb, fmpq

from .balls import ONE, cube
from .lines import Line, tanh_between
from .refusal import require

Four = tuple[arb, arb, arb, arb]


class Function(ABC):
    """A row: phi. `cornered` says that lines around it are known wherever its derivatives are not."""

    name: str
    undefined = ""
    cornered = False

    def exact(self, q: fmpq) -> fmpq | None:
        """phi(q), or None where rationals do not tell it."""
        return fmpq(0) if q == 0 else None

    @abstractmethod
    def derivatives(self, y: arb) -> Four:
        """phi, phi', phi'', phi''' on a ball."""

    def value(self, y: arb) -> arb:
        """phi on a ball, also where it has a corner."""
        return self.derivatives(y)[0]

    @abstractmethod
    def third(self, y: arb, at: Four, reach: arb) -> arb | None:
        """Six times a bound of what phi adds to its parabola at y, by |D|^3, for D = v - y, |D| <= reach.

        `at` has the derivatives at y. A bound of |phi'''| is one; None where phi may be undefined.
        """

    @abstractmethod
    def fourth(self, y: arb, at: Four, reach: arb) -> arb | None:
        """24 times a bound of what phi adds to its cubic at y, by D^4, as `third`."""

    def last(self, y: arb, at: Four, reach: arb) -> arb | None:
        """Six times the factor of |D|^3 in the derivative of what phi adds to its cubic: a bound of |phi''''| is one.

        Only rows in which `fourth` is of the remainder have another.
        """
        return self.fourth(y, at, reach)

    def corner(self, y: arb) -> tuple[arb, arb] | None:
        """Bounds for a phi with a corner: it is within the first times D^2 of its tangent at y, and phi' within the
        second, which may be infinite, times |D|^3 of phi'(y). None without a corner, and if phi may have no tangent."""
        return None

    def line(self, middle: arb, reach: arb) -> Line | None:
        """Lines around phi on |y - middle| <= reach, here the tangent's; None where phi may be undefined."""
        at = self.derivatives(middle)
        most = self.third(middle, at, reach)
        if most is None:
            return None
        value, slope, second, _ = at
        return slope, value - slope * middle, abs(second) / 2 * reach * reach + most / 6 * cube(reach)


class Tanh(Function):
    """|phi'''| is at most 2, |phi''''| below 4.1 and the fifth at most 16."""

    name = "tanh"

    def derivatives(self, y: arb) -> Four:
        t = y.tanh()
        slope = 1 - t * t
        return t, slope, -2 * t * slope, (6 * t * t - 2) * slope

    def third(self, y: arb, at: Four, reach: arb) -> arb:
        return arb(2)

    def fourth(self, y: arb, at: Four, reach: arb) -> arb:
        square = at[0] * at[0]
        return (abs(8 * at[0] * (2 - 3 * square) * (1 - square)) + 16 * reach).min(arb(41) / 10)

    def line(self, middle: arb, reach: arb) -> Line:
        return tanh_between(middle - reach, middle + reach)


class Atan(Function):
    """|phi'''| is at most 2, |phi''''| below 4.7."""

    name = "atan"

    def derivatives(self, y: arb) -> Four:
        p = 1 / (1 + y * y)
        return y.atan(), p, -2 * y * p * p, (6 * y * y - 2) * p * p * p

    def third(self, y: arb, at: Four, reach: arb) -> arb:
        return arb(2)

    def fourth(self, y: arb, at: Four, reach: arb) -> arb:
        return arb(47) / 10


class Exp(Function):
    name = "exp"

    def exact(self, q: fmpq) -> fmpq | None:
        return fmpq(1) if q == 0 else None

    def derivatives(self, y: arb) -> Four:
        e = y.exp()
        return e, e, e, e

    def third(self, y: arb, at: Four, reach: arb) -> arb:
        return (y + reach).exp()

    def fourth(self, y: arb, at: Four, reach: arb) -> arb:
        return self.third(y, at, reach)


class Sine(Function):
    """sin; with a quarter, cos."""

    def __init__(self, name: str) -> None:
        self.name = name

    def exact(self, q: fmpq) -> fmpq | None:
        return fmpq(self.name == "cos") if q == 0 else None

    def derivatives(self, y: arb) -> Four:
        s, k = y.sin(), y.cos()
        return (s, k, -s, -k) if self.name == "sin" else (k, -s, -k, s)

    def third(self, y: arb, at: Four, reach: arb) -> arb:
        return (abs(at[3]) + reach).min(ONE)

    def fourth(self, y: arb, at: Four, reach: arb) -> arb:
        return (abs(at[0]) + reach).min(ONE)


class Inverse(Function):
    """1/v is its parabola at y less D^3 / (y^3 v), and its cubic and D^4 / (y^4 v), whose derivative is
    D^3 (3 v + y) / (y^4 v^2). All fall as |v| rises, and as |y| does."""

    name, undefined = "1/", "a division by what may be 0"

    def exact(self, q: fmpq) -> fmpq | None:
        require(bool(q != 0), "equilibrium", "dynamics", "a division by 0")
        return 1 / q

    def derivatives(self, y: arb) -> Four:
        p = 1 / y
        return p, -(p * p), 2 * p * p * p, -6 * p * p * p * p

    def third(self, y: arb, at: Four, reach: arb) -> arb | None:
        size, least = self.least(y, reach)
        return 6 / (size * size * size * least) if least > 0 else None

    def fourth(self, y: arb, at: Four, reach: arb) -> arb | None:
        size, least = self.least(y, reach)
        return 24 / (size * size * size * size * least) if least > 0 else None

    def last(self, y: arb, at: Four, reach: arb) -> arb | None:
        size, least = self.least(y, reach)
        return 6 * (3 * least + arb(abs(y).upper())) / (size**4 * least * least) if least > 0 else None

    def least(self, y: arb, reach: arb) -> tuple[arb, arb]:
        """The least |y| and |v|, numbers: the power of a wide ball may hold 0 where the ball does not."""
        size = arb(abs(y).lower())
        return size, arb((size - reach).lower())


class Sqrt(Function):
    """With s and w the roots of y and v, w is its parabola at y and D^3 (3 s + w) / (8 s^3 (s + w)^3), and its cubic
    less D^4 (5 s^2 + 4 s w + w^2) / (16 s^5 (s + w)^4), whose derivative is D^3 (8 s^2 + 9 s w + 3 w^2) by
    16 s^5 w (s + w)^3. All fall as w rises."""

    name, undefined = "sqrt", "a root of what may not be positive"

    def exact(self, q: fmpq) -> fmpq | None:
        numerator, denominator = int(q.p), int(q.q)
        require(numerator > 0, "equilibrium", "dynamics", "sqrt of what is not positive")
        roots = math.isqrt(numerator), math.isqrt(denominator)
        return fmpq(*roots) if roots[0] ** 2 == numerator and roots[1] ** 2 == denominator else None

    def derivatives(self, y: arb) -> Four:
        root = y.sqrt()
        p = 1 / root
        return root, p / 2, -p * p * p / 4, 3 * p * p * p * p * p / 8

    def third(self, y: arb, at: Four, reach: arb) -> arb | None:
        roots = self.roots(y, reach)
        if roots is None:
            return None
        s, w = roots
        return 6 * (3 * s + w) / (8 * s * s * s * (s + w) * (s + w) * (s + w))

    def fourth(self, y: arb, at: Four, reach: arb) -> arb | None:
        roots = self.roots(y, reach)
        if roots is None:
            return None
        s, w = roots
        return 24 * (5 * s * s + 4 * s * w + w * w) / (16 * s**5 * (s + w) ** 4)

    def last(self, y: arb, at: Four, reach: arb) -> arb | None:
        roots = self.roots(y, reach)
        if roots is None:
            return None
        s, w = roots
        far = arb(y.upper()).sqrt()
        return 6 * (8 * far * far + 9 * far * w + 3 * w * w) / (16 * s**5 * w * (s + w) ** 3)

    def roots(self, y: arb, reach: arb) -> tuple[arb, arb] | None:
        """The least that s and w may be."""
        least = arb((y - reach).lower())
        return (arb(y.lower()).sqrt(), least.sqrt()) if least > 0 and y > 0 else None
