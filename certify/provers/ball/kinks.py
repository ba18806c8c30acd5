"""Kinks on a ball, in floats: entries of relu and of clips that may change sides there, known to first order, and cones
of directions on each of which the rule's inequality is asked (checker/FORMAT.md, kinks).

A kink adds at most |alpha.d| + beta ||d|| to m times what it reads, m the middle of the slopes of its chords.
In few directions of d a kink is undecided: cones that are narrow there, and wide elsewhere, leave next to nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from certify.certificates.tree import LEAF
from certify.loop.activations import CERTAIN
from certify.loop.networks import Affine, Algebra, Clip, Concat, Map, Network, Observe, Product, Sum
from certify.provers.ball.jets import basis, beyond_tangent, observed, product_beyond, remainder, sizes

Array = NDArray[np.float64]
_NONE = 1e-12  # what a unit reads that counts as 0 there
_FINEST = 2.0**-14  # half width of a leaf: what does not hold there does not hold on narrower cones
_SIDE = 1 + 1e-6  # factor of what an entry moves beside its cone's middle, for the checker's rounding
_LEFT = 0.05  # the least eigenvalue that a cone's decay has to have, scaled to a diagonal of 1
_COARSE, _FINE = np.arange(-4.0, 24.0), np.arange(-7.0, 8.0) / 8  # powers of 2 to choose a multiplier from


@dataclass(frozen=True, slots=True)
class Kinks:
    """Kinks among N units: |e_q(d)| is at most |alpha_q.d| + beta_q ||d|| and at most rho_q ||d||; alpha
    (N, k), beta and rho (N,), 0 of other units."""

    alpha: Array
    beta: Array
    rho: Array


@dataclass(frozen=True)
class Cone:
    """All d with `c.d >= t ||d||`, t^2 = |c|^2 - |r|^2, c and r (k,); all d if c is empty."""

    c: Array
    r: Array
    close: bool = False  # for the difference of any two d, not of d and 0

    @property
    def narrow(self) -> bool:
        return len(self.c) > 0

    @cached_property
    def squares(self) -> tuple[float, float]:
        """|c|^2 and |r|^2."""
        return float(self.c @ self.c), float(self.r @ self.r)

    @property
    def weight(self) -> Array:
        """The weight of directions that the checker takes."""
        return np.outer(self.c, self.c) + self.squares[1] * np.eye(len(self.c))

    @property
    def form(self) -> Array:
        """c c' - t^2 I, not negative on the cone."""
        square, wide = self.squares
        return np.outer(self.c, self.c) - (square - wide) * np.eye(len(self.c))

    def reach(self, a: Array, off: Array) -> tuple[Array, Array]:
        """(below, above): values with the gradients a (N, k), and off ||d|| more, lie in ||d|| [-below, above]."""
        if not self.narrow:
            far = np.linalg.norm(a, axis=1) + off
            return far, far
        square, wide = self.squares
        length, sine, cosine = math.sqrt(square), math.sqrt(wide / square), math.sqrt(1 - wide / square)
        g = a @ self.c / length
        side = _SIDE * off + _SIDE * sine * np.linalg.norm(a - np.outer(g, self.c) / length, axis=1)
        ends = g, g * cosine
        return np.maximum(side - np.minimum(*ends), 0.0), np.maximum(side + np.maximum(*ends), 0.0)

    def left(self, decay: Array) -> Array:
        """The decay less the multiple of `form` with which its least eigenvalue is largest, about."""
        if not self.narrow or not np.any(self.form):
            return decay
        scale = 1 / np.sqrt(np.abs(np.diag(decay)))
        left, right = (A * scale * scale[:, None] for A in (decay, self.form))
        start, mu = float(np.linalg.norm(left) / np.linalg.norm(right)), 0.0
        for powers in (_COARSE, _FINE):
            tried = np.append(start * 2.0**powers, mu)
            stack = left - tried[:, None, None] * right
            if not np.all(np.isfinite(stack)):
                return decay
            mu = start = float(tried[np.argmax(np.linalg.eigvalsh(stack)[:, 0])])
        return np.asarray(decay - mu * self.form)


ALL = Cone(np.zeros(0), np.zeros(0))


@dataclass(frozen=True)
class Directions:
    """Trees of the faces of the cube |d_j| <= 1, d_1 = -1, d_1 = 1, d_2 = -1 and so on; none for one cone of all d."""

    n: int
    trees: tuple[bytes, ...] = ()

    @property
    def cones(self) -> list[Cone]:
        """The cones of all leaves, in their order."""
        return [cone for k in range(len(self.trees)) for cone in self._leaves(k)] or [ALL]

    def _leaves(self, k: int) -> Iterator[Cone]:
        boxes = [_face(k, self.n)]
        for axis in self.trees[k]:
            lo, hi = boxes.pop()
            if axis == LEAF:
                yield _cone(lo, hi)
            else:
                boxes += reversed(_halves(lo, hi, axis))

    def refined(self, holds: Callable[[Cone], bool], most: int) -> Directions | None:
        """With leaves halved on their longest axis until it holds on all; None if that takes more than so many."""
        trees, count = list[bytes](), 0
        for k in range(2 * self.n):
            known = iter(self.trees[k] if self.trees else bytes([LEAF]))
            tree, boxes = bytearray(), [(*_face(k, self.n), True)]
            while boxes:
                lo, hi, old = boxes.pop()
                axis = next(known) if old else LEAF
                if axis == LEAF:
                    old, (_, r) = False, _middle(lo, hi)
                    if holds(_cone(lo, hi)):
                        tree.append(LEAF)
                        count += 1
                        continue
                    if not np.any(r > _FINEST) or count + len(boxes) >= most:
                        return None
                    axis = int(np.argmax(r))
                tree.append(axis)
                lower, upper = _halves(lo, hi, axis)
                boxes += [(*upper, old), (*lower, old)]
            trees.append(bytes(tree))
        return Directions(self.n, tuple(trees))


def _middle(lo: Array, hi: Array) -> tuple[Array, Array]:
    return 0.5 * (lo + hi), 0.5 * (hi - lo)


def _cone(lo: Array, hi: Array) -> Cone:
    c, r = _middle(lo, hi)
    return Cone(c, r) if r @ r < c @ c else ALL


def _face(k: int, n: int) -> tuple[Array, Array]:
    lo, hi = -np.ones(n), np.ones(n)
    lo[k // 2] = hi[k // 2] = -1.0 if k % 2 == 0 else 1.0
    return lo, hi


def _halves(lo: Array, hi: Array, axis: int) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    left, right = hi.copy(), lo.copy()
    left[axis] = right[axis] = 0.5 * (lo[axis] + hi[axis])
    return (lo, left), (right, hi)


def has_kinks(network: Network) -> bool:
    """True if an entry may be a kink."""
    return any(isinstance(step, Clip) or (isinstance(step, Map) and step.function == "relu") for step in network.steps)


class Vector(NamedTuple):
    """A vector on a ball, y + G d + L A(d), A of all units so far; Q and K are rows in their basis."""

    y: Array
    G: Array
    L: Array
    Q: Array
    K: Array


class OnCone(Algebra[Vector]):
    """A network on a ball x = middle + J d, for d in a cone. R has the remainders of all units so far, a row each, and
    alpha, beta, rho say which are kinks."""

    def __init__(self, J: Array, cone: Cone) -> None:
        k = J.shape[1]
        self.J, self.cone, self.form = J, cone, basis(k)
        self.R, self.alpha, self.beta = np.zeros((0, len(self.form.eye))), np.zeros((0, k)), np.zeros(0)
        self.rho = np.zeros(0)

    def argument(self, at: Array) -> Vector:
        """The states."""
        n, form = len(at), self.form
        return Vector(at, self.J, np.zeros((n, 0)), np.zeros((n, len(form.eye))), np.zeros((n, len(form.scale3))))

    @property
    def kinks(self) -> Kinks:
        return Kinks(self.alpha, self.beta, self.rho)

    def reached(self, v: Vector) -> tuple[Array, Array, Array]:
        """L among all units, the bound E of what is of second order there, and the tilt by kinks."""
        L = np.pad(v.L, ((0, 0), (0, len(self.R) - v.L.shape[1])))
        return L, np.abs(L) @ self.R, np.abs(L) @ self.rho

    def _with(self, rest: Array, kinks: tuple[Array, Array, Array] | None = None) -> None:
        rows = len(rest)
        alpha, beta, rho = kinks or (np.zeros((rows, self.J.shape[1])), np.zeros(rows), np.zeros(rows))
        self.R, self.alpha = np.concatenate([self.R, rest]), np.concatenate([self.alpha, alpha])
        self.beta, self.rho = np.append(self.beta, beta), np.append(self.rho, rho)

    def _units(self, y: Array, slope: Array, v: Vector, L: Array, H: Any = 0.0, C: Any = 0.0) -> Vector:
        """A step of each entry, whose units are the last."""
        own, x = np.eye(len(y)), slope[:, None]
        return Vector(y, x * v.G, np.concatenate([x * L, own], 1), x * v.Q + H, x * v.K + C)

    def affine(self, step: Affine, v: Vector) -> Vector:
        W = step.weight
        return Vector(W @ v.y + step.bias, W @ v.G, W @ v.L, W @ v.Q, W @ v.K)

    def map(self, step: Map, v: Vector) -> Vector:
        if step.function == "relu":
            y = np.maximum(v.y, 0.0)
            return self._bent(y, v, np.zeros_like(y), np.full_like(y, np.inf), np.abs(v.y) <= _NONE)
        L, E, tilt = self.reached(v)
        plain = sizes(v.G, v.Q, v.K, E)
        size = replace(plain, slope=plain.slope + tilt)
        y, slope, second, third, fourth = step.phi.around(v.y, size.radius)
        squares = self.form.square(v.G)
        H, C = beyond_tangent(v.G, squares, v.Q, v.K, second, third)
        h, g, m = np.abs(second), np.abs(third), fourth * size.radius**2
        turned = (h + m + 3 * g * size.curve) * (size.slope**2 - plain.slope**2) + g * (size.slope**3 - plain.slope**3)
        turned += 2 * h * tilt * size.bend
        self._with(remainder(squares, size, E, h, g, fourth) + turned[:, None] * self.form.eye)
        return self._units(y, slope, v, L, H, C)

    def clip(self, step: Clip, v: Vector) -> Vector:
        y = np.minimum(np.maximum(v.y, step.lo), step.hi)
        return self._bent(y, v, step.lo, step.hi, np.zeros(len(y), dtype=bool))

    def _bent(self, y: Array, v: Vector, lo: Array, hi: Array, at_0: NDArray[np.bool_]) -> Vector:
        L, E, tilt = self.reached(v)
        off = tilt + sizes(v.G, v.Q, v.K, E).curve
        below, above = self.cone.reach(v.G, off)
        p, q = sectors(v.y, below, above, lo, hi)
        p, q = np.where(at_0, np.where(below > 0, 0.0, 1.0), p), np.where(at_0, np.where(above > 0, 1.0, 0.0), q)
        far = np.maximum(below, above)
        if self.cone.close:  # all slopes between any two points; curves have at most three times their size
            p, q, off = np.where(p < 1, 0.0, p), np.where(q > 0, 1.0, q), tilt + 3 * (off - tilt)
            far = np.linalg.norm(v.G, axis=1) + off
        w = (q - p) / 2
        self._with(np.zeros_like(E), (w[:, None] * v.G, w * off, w * far))
        return self._units(y, (p + q) / 2, v, L)

    def sum(self, step: Sum, *vectors: Vector) -> Vector:
        L = np.sum([self.reached(v)[0] for v in vectors], axis=0)
        y, G, Q, K = (np.sum([getattr(v, part) for v in vectors], axis=0) for part in ("y", "G", "Q", "K"))
        return Vector(y, G, L, Q, K)

    def concat(self, step: Concat, *vectors: Vector) -> Vector:
        L = np.concatenate([self.reached(v)[0] for v in vectors])
        y, G, Q, K = (np.concatenate([getattr(v, part) for v in vectors]) for part in ("y", "G", "Q", "K"))
        return Vector(y, G, L, Q, K)

    def product(self, step: Product, v: Vector, w: Vector) -> Vector:
        """The product of what both add to their values is that of a unit; of kinks nothing is known here."""
        (L, E, tilt), (M, F, turn) = self.reached(v), self.reached(w)
        H, C, rest = product_beyond(v.G, v.Q, v.K, E, w.G, w.Q, w.K, F)
        self._with(np.where((tilt + turn > 0)[:, None], np.nan, rest))
        y, z = v.y[:, None], w.y[:, None]
        G, reach = y * w.G + z * v.G, y * M + z * L
        own = np.eye(len(H))
        return Vector(v.y * w.y, G, np.concatenate([reach, own], 1), y * w.Q + z * v.Q + H, y * w.K + z * v.K + C)

    def observe(self, step: Observe, v: Vector) -> Vector:
        """Jets of the expressions, whose terms beyond their tangents become those of units; no kinks come before."""
        L, E, tilt = self.reached(v)
        y, G, Q, K, rest = observed(step, v.y, v.G, v.Q, v.K, np.where((tilt > 0)[:, None], np.nan, E))
        self._with(rest)
        return Vector(y, G, np.concatenate([np.zeros((len(y), L.shape[1])), np.eye(len(y))], 1), Q, K)


def sectors(y: Array, below: Array, above: Array, lo: Array, hi: Array) -> tuple[Array, Array]:
    """(p, q), between which the chords' slopes of a clip to [lo, hi] lie, from y to numbers within [-below, above]."""
    with np.errstate(divide="ignore", invalid="ignore"):
        down, up = _share(y - lo, below), _share(hi - y, above)
        under, over = 1 - _share(lo - y, above), 1 - _share(y - hi, below)
    p = np.where((y > lo) & (y < hi), np.minimum(down, up), 0.0)
    return p, np.where(y < lo, under, np.where(y > hi, over, 1.0))


def _share(length: Array, far: Array) -> Array:
    """min(1, length/far), 1 only where that is certain beyond all rounding."""
    return np.asarray(np.where(far * CERTAIN < length, 1.0, np.clip(length / far, 0.0, 1.0)))


def is_left(decay: Array) -> bool:
    """True if the decay (k, k) that is left on a cone is positive definite, by a margin that larger balls need."""
    if not (np.all(np.isfinite(decay)) and np.all(np.diag(decay) > 0)):
        return False
    scale = 1 / np.sqrt(np.diag(decay))
    return bool(np.linalg.eigvalsh(decay * scale * scale[:, None])[0] > _LEFT)


def bound_of(kinks: Kinks, p: Array, weight: Array) -> Array:
    """The checker's bound of 2 sum_q |p_q.y| (|alpha_q.d| + beta_q ||d||), d the last entries of y, for rows p."""
    more, k = p.shape[1] - kinks.alpha.shape[1], kinks.alpha.shape[1]
    some = (kinks.rho > 0) & np.any(p != 0, axis=1)
    p, alpha, beta = p[some], np.pad(kinks.alpha[some], ((0, 0), (more, 0))), kinks.beta[some]
    along, found = np.einsum("qi,ij,qj->q", p, weight, p), np.zeros_like(weight)
    eye = np.diag(np.append(np.zeros(more), np.ones(k)))
    with np.errstate(divide="ignore", invalid="ignore"):
        tau = np.sqrt(np.einsum("qi,ij,qj->q", alpha, weight, alpha) / along)
        flat = np.sqrt(beta**2 * float(np.trace(eye @ weight)) / along)
        for one, each in ((tau, alpha[:, :, None] * alpha[:, None]), (flat, beta[:, None, None] ** 2 * eye)):
            used = np.isfinite(one) & (one > 0)
            found = found + (p[used].T * one[used]) @ p[used] + np.tensordot(1 / one[used], each[used], 1)
    return np.asarray(found)
