"""The rules that are decided in rationals, from `levels` to `centring`."""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence
from dataclasses import dataclass

from flint import fmpq, fmpq_mat

from .document import Certificate
from .evidence import Tree
from .expressions import MAX_BITS, Call
from .fields import exact
from .networks import Affine, Clip, Observe, OnLists
from .refusal import require, under
from .table import FUNCTIONS

MAX_MATRIX_BITS = 2**16  # of a numerator over a common denominator, times rows: beyond it a decision takes minutes
ZERO = fmpq(0)


def levels(c: Certificate) -> None:
    """0 < c1 <= c2; with a floor 0 < c0 <= c1, and c0 = c1 where no ball lies between them."""
    require(0 < c.inner <= c.outer, "levels", "levels", f"0 < {c.inner!r} <= {c.outer!r} does not hold")
    if c.floor is not None:
        require(0 < c.floor <= c.inner, "levels", "levels", f"0 < {c.floor!r} <= {c.inner!r} does not hold")
        between = isinstance(c.evidence, Tree) and c.evidence.ball is not None
        require(between or c.floor == c.inner, "levels", "levels", "without a ball c0 = c1 must hold")


def inverse_diagonal(A: fmpq_mat, rule: str, at: str | None = None) -> list[fmpq]:
    """The diagonal of A^-1, by cofactors, if A = A' and every leading principal minor is positive."""
    n = A.nrows()
    symmetric = A.transpose() == A
    require(symmetric, rule, at or "symmetry", "the matrix differs from its transpose")
    require(is_short(A), rule, at or "bits", f"rows times bits exceed {MAX_MATRIX_BITS}")
    for k in range(1, n + 1):
        require(bool(minor(A, range(k)) > 0), rule, at or f"minor {k}", "a leading principal minor is not positive")
    whole = A.det()
    return [minor(A, [k for k in range(n) if k != i]) / whole for i in range(n)]


def positive_definite(A: fmpq_mat) -> bool:
    """True if A = A' and every leading principal minor is positive (Sylvester); False where that takes too long."""
    sound = is_short(A) and bool(A.transpose() == A)
    return sound and all(bool(minor(A, range(k)) > 0) for k in range(1, A.nrows() + 1))


def bits(A: fmpq_mat) -> int:
    """Bits of the longest numerator over a common denominator."""
    return int(max(v.height_bits() for v in A.numer_denom()[0].entries()))


def is_short(A: fmpq_mat) -> bool:
    return bool(A.nrows() * bits(A) <= MAX_MATRIX_BITS)


def identity(n: int) -> fmpq_mat:
    return fmpq_mat(n, n, [int(i == j) for i in range(n) for j in range(n)])


def root_above(value: fmpq) -> fmpq:
    """A rational at or above the root of what is not negative, and at most 2^-63 of itself above it."""
    numerator, denominator = int(value.p), int(value.q)
    shift = max(0, 64 - (numerator * denominator).bit_length() // 2)
    square = numerator * denominator << 2 * shift
    above = math.isqrt(square)
    return fmpq(above + (above * above < square), denominator << shift)


def minor(A: fmpq_mat, kept: range | list[int]) -> fmpq:
    """The determinant of the kept rows and columns; that of none is 1."""
    return fmpq_mat(len(kept), len(kept), [A[i, j] for i in kept for j in kept]).det() if kept else fmpq(1)


def domain(c: Certificate, inverse: list[fmpq]) -> None:
    """The largest x_i^2 on {V <= c2} is c2 (P^-1)_ii."""
    for (lo, hi), name in zip(c.plant.domain, c.plant.states, strict=True):
        require(bool(lo < 0) and bool(hi > 0), "domain", name, "the domain must contain 0 in its interior")
    left = beyond_domain(c, [exact(c.outer) * s for s in inverse])
    require(left is None, "domain", left or "", "the ellipsoid {V <= c2} leaves the interior of the domain")


def beyond_domain(c: Certificate, largest: Sequence[fmpq], centre: fmpq_mat | None = None) -> str | None:
    """The first state that is not certain to lie inside its bounds where no (x_i - centre_i)^2 exceeds `largest`."""
    middle = [ZERO] * c.n if centre is None else centre.entries()
    for (lo, hi), most, x, name in zip(c.plant.domain, largest, middle, c.plant.states, strict=True):
        room = min(x - lo, hi - x)
        if not (room > 0 and most < room**2):
            return name
    return None


def coordinates(c: Certificate, tree: Tree) -> tuple[fmpq_mat, list[fmpq]]:
    """S = T'PT and the diagonal of its inverse."""
    S = tree.T.transpose() * c.P * tree.T
    inverse = inverse_diagonal(S, "coordinates")
    discs = (row[i] - sum((abs(v) for j, v in enumerate(row) if j != i), ZERO) for i, row in enumerate(S.tolist()))
    require(all(bool(left > 0) for left in discs), "coordinates", "rows", "S_ii > sum_j |S_ij| does not hold")
    return S, inverse


def root(c: Certificate, tree: Tree, inverse: list[fmpq]) -> None:
    for i, (b, s) in enumerate(zip(tree.root, inverse, strict=True)):
        large = b > 0 and bool(exact(c.outer) * s <= exact(b) ** 2)
        require(large, "root", f"axis {i}", "the root box does not contain {V <= c2}")


@dataclass(frozen=True)
class Exact:
    """A number on the way to f(0, u_eq); the rationals do not tell the value of one that is `UNTOLD`."""

    value: fmpq | None

    def __post_init__(self) -> None:
        short = self.value is None or self.value.height_bits() <= MAX_BITS
        require(short, "equilibrium", "dynamics", f"a number of more than {MAX_BITS} bits")

    def __add__(self, other: Exact) -> Exact:
        if self.value is None or other.value is None:
            return UNTOLD
        return Exact(self.value + other.value)

    def __mul__(self, other: Exact) -> Exact:
        if ZERO in (self.value, other.value):
            return Exact(ZERO)
        if self.value is None or other.value is None:
            return UNTOLD
        return Exact(self.value * other.value)

    def __neg__(self) -> Exact:
        return UNTOLD if self.value is None else Exact(-self.value)

    def function(self, name: str) -> Exact:
        if self.value is None:
            return UNTOLD
        value = FUNCTIONS[name].exact(self.value)
        return UNTOLD if value is None else Exact(value)

    def between(self, lo: fmpq, hi: fmpq) -> Exact:
        """min(max(v, lo), hi)."""
        return UNTOLD if self.value is None else Exact(min(max(self.value, lo), hi))


UNTOLD = Exact(None)


class Exactly(OnLists):
    """Networks of exact numbers: vectors are lists of them."""

    def affine(self, step: Affine, v: list[Exact]) -> list[Exact]:
        return [weighted(step.row(i), b, v) for i, b in enumerate(step.bias)]

    def clip(self, step: Clip, v: list[Exact]) -> list[Exact]:
        return [x.between(exact(lo), exact(hi)) for x, lo, hi in zip(v, step.lo, step.hi, strict=True)]

    def observe(self, step: Observe, v: list[Exact]) -> list[Exact]:
        return step.expressions.evaluate(dict(zip(step.names, v, strict=True)), Exact)


def weighted(weights: array[float], bias: float, h: list[Exact]) -> Exact:
    """A row of an affine step; weights of exact 0 ignore what stands behind them."""
    result = Exact(exact(bias))
    for w, v in zip(weights, h, strict=True):
        if w != 0 and v.value != 0:
            result += UNTOLD if v.value is None else Exact(exact(w) * v.value)
    return result


def called(call: Call, given: Sequence[Exact]) -> list[Exact]:
    value = call.network.run(Exactly(), list(given))
    return [value[i] for i in call.entries]


def equilibrium(c: Certificate) -> None:
    """f(0, u_eq) = 0, whatever the uncertain quantities are."""
    names = {name: Exact(ZERO) for name in c.plant.states}
    names.update(zip(c.plant.inputs, map(Exact, c.plant.u_eq), strict=True))
    names.update(dict.fromkeys(c.plant.uncertain, UNTOLD))  # so that what is 0 here is 0 for each of their values
    for i, component in enumerate(c.plant.dynamics.evaluate(names, Exact, called)):
        zero = component.value is not None and bool(component.value == 0)
        require(zero, "equilibrium", f"dynamics.{i}", "f(0, u_eq) is not 0, or the rationals do not tell")


def centring(c: Certificate) -> None:
    policy = c.policy
    each = list(zip(c.plant.u_eq, map(exact, policy.scale), map(exact, policy.offset), strict=True))
    if policy.centre == "preactivation":
        for j, (q, scale, offset) in enumerate(each):
            within = bool(abs((q - offset) / scale) < 1)
            require(within, "centring", c.plant.inputs[j], "u_eq is not a value of scale * tanh + offset")
    for j, q in enumerate(c.plant.u_eq):
        limits = policy.limits(j)
        if limits is not None and policy.centre != "none":
            inside = bool(limits[0] < q) and bool(q < limits[1])
            require(inside, "centring", c.plant.inputs[j], "u_eq does not lie strictly inside the clip")
    if policy.centre == "none" and c.ends_at_origin:
        with under("centring", "policy"):
            values = [clipped_at_0(c, j, y) for j, y in enumerate(squashed_at_0(c))]
        for name, value, q in zip(c.plant.inputs, values, c.plant.u_eq, strict=True):
            holds = value.value is not None and bool(value.value == q)
            require(holds, "centring", name, "raw(0) = u_eq does not hold by its form")


def squashed_at_0(c: Certificate) -> list[Exact]:
    """The squash of net(0)."""
    net: list[Exact] = c.policy.network.run(Exactly(), [Exact(ZERO)] * c.n)
    return [y.function("tanh") for y in net] if c.policy.squash == "tanh" else net


def clipped_at_0(c: Certificate, j: int, y: Exact) -> Exact:
    policy = c.policy
    value, limits = Exact(exact(policy.scale[j])) * y + Exact(exact(policy.offset[j])), policy.limits(j)
    return value if limits is None else value.between(*limits)
