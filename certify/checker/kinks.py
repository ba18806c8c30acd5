"""Kinks on a ball: entries of relu and of clips that may change sides there, known to first order, and cones of
directions on each of which the matrix inequality is asked. Only certificates with `directions` load this module.

On the cone of a leaf with the centre c and half widths r, `c.d >= t ||d||`, t^2 = |c|^2 - |r|^2: of b = c + s on the
leaf c.b = (|c|^2 + |b|^2 - |s|^2)/2 is at least (t^2 + |b|^2)/2, and so at least t |b|.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cached_property

import numpy as np
from flint import fmpq, fmpq_mat

from .ball import Ball, OnBall, Rows
from .boxes import batches, is_whole
from .case import Failures
from .decrease import OF_ONE, Models, vectors
from .elementary import least_share, sqrt
from .exact import Exact, exactly, fraction, quotient, rational
from .expression import evaluate
from .functions import FUNCTIONS, Undecided
from .jets import Jet, Units
from .near import ZERO, Above, Array, Near, Tensor, Vector, at_least_0, near, norm, triples
from .networks import Affine, Map, Step
from .pairs import bound_of_pairs, in_binary64
from .wiring import MEANINGS, BallSteps, Clip, Concat, Observe, Product, Sum

_AT_ONCE = 4096  # leaves
_COARSE, _FINE = np.arange(-4.0, 24.0), np.arange(-7.0, 8.0) / 8  # powers of 2 to choose a multiplier from


@dataclass(frozen=True)
class First:
    """Kinks among N units: |e_q(d)| is at most |alpha_q.d| + beta_q ||d||, and at most rho_q ||d||; alpha (k, N), beta
    and rho (N,), 0 of other units. In rule `contraction` so is the difference at any two d, d being theirs."""

    alpha: Array
    beta: Array
    rho: Array

    def beside(self, other: First) -> First:
        """These, and then others."""
        parts = zip((self.alpha, self.beta, self.rho), (other.alpha, other.beta, other.rho), strict=True)
        return First(*(np.concatenate(pair, -1) for pair in parts))

    def of(self, count: int) -> First:
        """So many of them."""
        return First(self.alpha[:, :count], self.beta[:count], self.rho[:count])


def no_kinks(k: int, count: int) -> First:
    """Units that are no kinks."""
    return First(np.zeros((k, count)), np.zeros(count), np.zeros(count))


@dataclass(frozen=True)
class KinkedUnits(Units):
    """Errors of which some are of first order: U knows nothing of what `first` has."""

    first: First = field(kw_only=True)

    @cached_property
    def tilts(self) -> Above:
        """Upper bounds of what kinks add to each of the common errors, over ||d||."""
        return Above(self.first.rho) if self.L is None else Above(self.first.rho).through(self.L)

    @property
    def norms(self) -> list[Above]:
        first = self.first
        return [*super().norms, norm(first.alpha, (0, 1)), norm(first.beta), norm(first.rho)]

    def beside(self, more: Units, L: Array) -> KinkedUnits:
        others = more.first if isinstance(more, KinkedUnits) else no_kinks(len(more.R), more.R.shape[2])
        return KinkedUnits(np.concatenate([self.R, more.R], 2), L, self, first=self.first.beside(others))

    def tilt(self, size: Above) -> Above:
        if size is ZERO:
            return ZERO
        return (size * self.tilts[(slice(None), *[None] * (np.ndim(size.v) - 1))]).sum()


class OnCone(OnBall):
    """Networks on a ball, or on a cone of it, whose relus and clips may have kinks there."""

    def __init__(self, k: int, cone: Cone) -> None:
        super().__init__(k)
        self.cone, self.first = cone, no_kinks(k, 0)

    def units(self, count: int) -> Units:
        return KinkedUnits(super().units(count).R, first=self.first.of(count))

    def with_units(self, H: Array, C: Array, R: Array, lips: Above, first: First | None = None) -> int:
        self.first = self.first.beside(first or no_kinks(self.k, R.shape[2]))
        return super().with_units(H, C, R, lips)

    def moved(self, x: Rows, origin: Array) -> Rows:
        return replace(super().moved(x, origin), at_0=x.at_0 & (origin == 0))

    def entered(self, jets: Sequence[Jet]) -> Rows:
        at_0 = np.array([v.v0.value == 0 and v.v0.error.v == 0 for v in jets])  # a bound of 0 is 0
        return replace(super().entered(jets), at_0=at_0)

    def affine(self, step: Affine, v: Rows) -> Rows:
        at_0 = (step.bias == 0) & ~np.any((step.weight != 0) & ~v.at_0, 1)
        return replace(super().affine(step, v), at_0=at_0)

    def map(self, step: Map, v: Rows) -> Rows:
        if step.function == "relu":
            return self.bent(step, v)
        return replace(super().map(step, v), at_0=v.at_0 & (FUNCTIONS[step.function].at_0 == 0))

    def bent(self, step: Step, v: Rows) -> Rows:
        """Entries that are known to first order."""
        value = self.jets(v)
        found = self.cone.bent(step, value, v.at_0)
        X, N, k = self.columns(v, value.units.count).times(Near(found.slope)), len(found.slope), self.k
        nothing = np.zeros((k, k, N)), np.zeros((len(triples(k)[0]), N)), np.zeros((k, k, N)), Above(np.zeros(N))
        at_0 = v.at_0 & (found.y.value == 0)  # relu(0) = 0, and a clip of 0 is exact
        return Rows(found.y, X, self.with_units(*nothing, found.first), at_0)


class ConeSteps(BallSteps):
    """The other steps, which know what is exactly 0 too."""

    ball: OnCone

    def clip(self, step: Clip, v: Rows) -> Rows:
        return self.ball.bent(step, v)

    def sum(self, step: Sum, *vectors: Rows) -> Rows:
        return replace(super().sum(step, *vectors), at_0=np.all([v.at_0 for v in vectors], axis=0))

    def concat(self, step: Concat, *vectors: Rows) -> Rows:
        return replace(super().concat(step, *vectors), at_0=np.concatenate([v.at_0 for v in vectors]))

    def product(self, step: Product, v: Rows, w: Rows) -> Rows:
        return replace(super().product(step, v, w), at_0=v.at_0 | w.at_0)

    def observe(self, step: Observe, v: Rows) -> Rows:
        found = super().observe(step, v)
        try:
            known = evaluate(step.tape, Exact, [Exact(Fraction(0) if still else None) for still in v.at_0.tolist()])
        except Undecided:  # nothing is known to be 0
            return replace(found, at_0=np.zeros(step.size, dtype=bool))
        return replace(found, at_0=np.array([x.value == 0 for x in known]))


MEANINGS[OnCone] = ConeSteps


@dataclass(frozen=True)
class Bent:
    """A relu or clip of entries: their values at d = 0, and the slopes m that their rows take, exact numbers; what is
    left of each is a unit, of first order if it is a kink."""

    y: Near
    slope: Array
    first: First


@dataclass(frozen=True)
class Cone:
    """All d with `c.d >= t ||d||`, c and r (k,); all d there are if these are empty. If it is `close` units are meant
    for the difference of any two d, else for d against 0."""

    c: Array = field(default_factory=lambda: np.zeros(0))
    r: Array = field(default_factory=lambda: np.zeros(0))
    close: bool = False

    @property
    def narrow(self) -> bool:
        """True if it is not all of d."""
        return len(self.c) > 0

    @property
    def squares(self) -> tuple[Fraction, Fraction]:
        """|c|^2 and |r|^2."""
        c, r = (sum(Fraction(v) ** 2 for v in part.tolist()) for part in (self.c, self.r))
        return Fraction(c), Fraction(r)

    @property
    def weight(self) -> Array:
        """The weight of directions that are of interest here: no bound depends on it."""
        return np.outer(self.c, self.c) + float(self.r @ self.r) * np.eye(len(self.c))

    def bent(self, step: Step, v: Jet, at_0: Array) -> Bent:
        """The units of a step of a vector, a batch of jets; `at_0` says which v(0) are exactly 0."""
        below, above, falls, rises = self.reach(v)
        if isinstance(step, Clip):
            y = np.clip(v.c.value, step.lo, step.hi)
            p, q = _of_clip(*v.v0.ends, step.lo, step.hi, below, above)
        else:
            y = np.maximum(v.c.value, 0.0)
            p, q = _of_relu(*v.v0.ends, below, above)
            p, q = np.where(at_0 & ~falls, 1.0, p), np.where(at_0 & ~rises, 0.0, q)
        if self.close:
            p, q = np.where(p < 1, 0.0, p), np.where(q > 0, 1.0, q)
        m = np.where(p == q, p, 0.5 * (p + q))
        w = Above(np.where(p == q, 0.0, ((Near(q) - Near(m)).size.most((Near(m) - Near(p)).size)).top))
        off = v.gradient.error + (v.beyond[1] if self.close else v.curve)
        alpha = Vector(v.a.value) * Near(w.top)
        far = v.a.size + off if self.close else Above(np.maximum(below.top, above.top))
        first = First(alpha.value, (w * off + alpha.error).top, (w * far).top)
        kept = np.where(p == q, 0.0, 1.0)  # of no kink nothing is left, not even what underflows
        return Bent(Near(y, v.v0.error), m, First(first.alpha * kept, first.beta * kept, first.rho * kept))

    def reach(self, v: Jet) -> tuple[Above, Above, Array, Array]:
        """(below, above): v - v(0) lies in ||d|| [-below, above]; and whether it may fall, or rise, at all."""
        off = v.gradient.error + v.curve
        if not self.narrow:
            far = v.a.size + off
            return far, far, np.ones(len(off.v), dtype=bool), np.ones(len(off.v), dtype=bool)
        c, (square, wide) = self.c, self.squares
        length, sine = sqrt(near(square)), _root(wide / square).ends[1]
        t = v.a.value.T @ c / float(square)  # any number: whatever a has beyond t c is bounded as it is
        rest = Near(v.a.value) - Near(c[:, None]) * Near(t)
        along = (rest * Near(c[:, None])).sum().size.over(length.ends[0])
        beside = off + along + rest.size.norm() * float(sine)
        least, most = (Near(t) * length).ends
        least = np.where(least > 0, _shorter(least, square, wide), least)
        most = np.where(most < 0, -_shorter(-most, square, wide), most)
        return beside.less(least), beside.less(-most), ~(least >= beside.top), ~(-most >= beside.top)

    def within(self, decay: fmpq_mat, rest: fmpq_mat) -> fmpq_mat:
        """The decay less mu (c c' - t^2 I) over d, the last entries, which is not negative on the cone.
        mu is any number >= 0, here one for which the least eigenvalue beyond the rest is largest, about."""
        if not self.narrow:
            return decay
        (square, wide), n = self.squares, len(self.c)
        c, short = exactly(self.c[None]), square - wide
        form, first = c.transpose() * c, decay.nrows() - n
        more = [[fmpq(0)] * (n + first) for _ in range(n + first)]
        for i in range(n):
            for j in range(n):
                more[first + i][first + j] = form[i, j] - quotient(short) * int(i == j)
        C = fmpq_mat(more)
        return decay - _best(decay - rest, C) * C


def cone_of(ball: Ball) -> Cone:
    """The cone that a ball's d are of."""
    return ball.cone or Cone(close=ball.close)


def are_whole(directions: Sequence[bytes], n: int, at: str) -> Failures:
    """The trees are trees, and the middles of their leaves numbers of binary64."""
    count = 0
    for k, tree in enumerate(directions):
        yield from is_whole(tree, [j for j in range(n) if j != k // 2], f"{at}[{k}] ")
        for _, lo, hi in batches(tree, *_face(k, n), _AT_ONCE):
            if not all(map(_has_middle, lo.ravel().tolist(), hi.ravel().tolist())):
                yield f"{at}[{k}]", "a leaf is too small"
            count += lo.shape[1]
    return count


def cones(directions: Sequence[bytes], n: int, close: bool) -> Iterator[Cone]:
    """Yield cones that together have all d, (n,), after `are_whole`."""
    for k, tree in enumerate(directions):
        for _, lo, hi in batches(tree, *_face(k, n), _AT_ONCE):
            for a, b in zip(lo.T, hi.T, strict=True):
                c, r = 0.5 * a + 0.5 * b, 0.5 * b - 0.5 * a
                narrow = sum(Fraction(v) ** 2 for v in r.tolist()) < sum(Fraction(v) ** 2 for v in c.tolist())
                yield Cone(c, r, close) if narrow else Cone(close=close)


def _has_middle(lo: float, hi: float) -> bool:
    """True if c and r of [lo, hi] are what binary64 makes of them."""
    c, r = 0.5 * lo + 0.5 * hi, 0.5 * hi - 0.5 * lo
    return Fraction(c) - Fraction(r) == lo and Fraction(c) + Fraction(r) == hi


def _face(k: int, n: int) -> tuple[Array, Array]:
    """The corners of a face of the cube: d_1 = -1, d_1 = 1, d_2 = -1 and so on."""
    lo, hi = -np.ones(n), np.ones(n)
    lo[k // 2] = hi[k // 2] = -1.0 if k % 2 == 0 else 1.0
    return lo, hi


@dataclass(frozen=True)
class Kinks:
    """The kinks in models on a cone: `length` is at or above sum_q ||c_q||_P rho_q."""

    cone: Cone
    first: First
    length: fmpq

    @classmethod
    def of(cls, cone: Cone, models: Models, P: Array) -> Kinks:
        """The length is NaN or infinite nowhere, if the models are finite."""
        if not isinstance(models.units, KinkedUnits):
            raise TypeError("models on a cone have such units")
        first, c = models.units.first, Near(models.units.reach).through(models.shares)
        each = at_least_0((c * c.through(P)).sum()).root * Above(first.rho)
        most = float(each.sum().top)
        return cls(cone, first, rational(most) if np.isfinite(most) else fmpq(2) ** 1100)

    def lengths(self, models: Models, P: fmpq_mat) -> tuple[fmpq, fmpq]:
        """The charges of a step to the errors of f, and to those of A."""
        return fmpq(0), self.length

    def bound(self, models: Models, b: fmpq_mat, weight: Array) -> fmpq_mat:
        """S_kinks: twice the sum of |p_q.y| (|alpha_q.d| + beta_q ||d||), y = d or (1, d), row i of b being b_i."""
        k, more = len(self.first.alpha), b.ncols() - len(self.first.alpha)
        W = np.zeros((more + k, more + k))
        W[more:, more:] = self.cone.weight if self.cone.narrow and not self.cone.close else weight
        W[:more, :more] = OF_ONE * np.trace(W) * np.eye(more)
        row, by = in_binary64(models.B.transpose() * b)
        p = vectors(row.through(models.units.reach.T))
        alpha = np.concatenate([np.zeros((more, len(self.first.beta))), self.first.alpha])
        eye = np.concatenate([np.zeros((more, k)), np.eye(k)])
        S = bound_of_pairs(p, Tensor(alpha[:, None]), W)
        return (S + bound_of_pairs(p, Tensor(eye[..., None] * self.first.beta), W)) * fmpq(2) ** by


def _of_relu(lo: Array, hi: Array, below: Above, above: Above) -> tuple[Array, Array]:
    """Sectors of relu for v(0) in [lo, hi]."""
    return np.where(lo > 0, least_share(lo, below), 0.0), np.where(hi < 0, _up_to_1(least_share(-hi, above)), 1.0)


def _of_clip(lo: Array, hi: Array, least: Array, most: Array, below: Above, above: Above) -> tuple[Array, Array]:
    """Sectors of clips to [least, most] for v(0) in [lo, hi]."""
    after, before, under, over = (
        (Near(a) - Near(b)).ends[0] for a, b in ((lo, least), (most, hi), (least, hi), (lo, most))
    )
    p = np.where((after > 0) & (before > 0), np.minimum(least_share(after, below), least_share(before, above)), 0.0)
    q = np.where(under > 0, _up_to_1(least_share(under, above)), 1.0)
    return p, np.where(over > 0, _up_to_1(least_share(over, below)), q)


def _up_to_1(p: Array) -> Array:
    """Upper bounds of 1 - p for exact p in [0, 1]: exact at 1."""
    return np.where(p == 1, 0.0, np.minimum((Near(np.float64(1)) - Near(p)).ends[1], 1.0))


def _root(q: Fraction) -> Near:
    return sqrt(near(q)) if q > 0 else Near(np.float64(0))


def _shorter(x: Array, square: Fraction, wide: Fraction) -> Array:
    """Lower bounds of x cos for exact numbers x >= 0."""
    return np.maximum((Near(x) * _root((square - wide) / square)).ends[0], 0.0)


def _best(M: fmpq_mat, C: fmpq_mat) -> fmpq:
    """A number mu >= 0, of one bit or a few, for which the least eigenvalue of M - mu C, scaled to a diagonal of 1, is
    largest, about."""
    try:
        left, right = (np.array([[float(fraction(v)) for v in row] for row in A.tolist()]) for A in (M, C))
    except OverflowError:
        return fmpq(0)
    with np.errstate(all="ignore"):
        scale = 1 / np.sqrt(np.abs(np.diag(left)))
        left, right = (A * scale * scale[:, None] for A in (left, right))
        if not (np.all(np.isfinite(left)) and np.all(np.isfinite(right)) and np.any(right)):
            return fmpq(0)
        mu, start = 0.0, float(np.linalg.norm(left) / np.linalg.norm(right))
        for powers in (_COARSE, _FINE):
            tried = np.append(start * 2.0**powers, mu)
            least = np.linalg.eigvalsh(left - tried[:, None, None] * right)[:, 0]
            mu = start = float(tried[np.argmax(least)])
    m, e = np.frexp(mu)
    return fmpq(int(np.round(m * 64))) * fmpq(2) ** (int(e) - 6) if 0 < mu < np.inf else fmpq(0)
