"""The rules: each raises `Rejected` under its own name unless what it stands for has been shown.

Together they imply claims 0 to 5 (FORMAT.md gives the inequalities and why they suffice):

levels       0 < c1 <= c2
lyapunov     P is symmetric positive definite                          exact
equilibrium  f(0, u_eq) = 0                                            exact
centring     pi(0) = u_eq                                              exact, by form
domain       {V <= c2} lies in the interior of the domain              exact
coordinates  S = T'PT is positive definite                             exact
root         the root box contains {V <= c2}                           exact
local        Vdot < 0 on 0 < V <= c1, f is smooth, u within its bounds   on a ball around the origin
tree         the tree is consumed exactly
ring, inputs for each leaf: it misses c1 <= V <= c2, or Vdot < 0 (and u within its bounds) on it
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from .document import Certificate, Trusted
from .errors import Rejected
from .exact import RationalAlgebra, Undecided, congruence, gershgorin_lower, inverse_diagonal, rational
from .expression import evaluate
from .float64 import EPS, Array, float_with_error, gamma, norm, self_test, total, up
from .local import Jet, JetAlgebra
from .network import Folded, enclose_at_origin, enclose_on_boxes, fold
from .taylor import Taylor, TaylorAlgebra, upper_bound

LEAF = 255
MAX_DEPTH = 4096
_BATCH_NUMBERS = 4_000_000  # numbers in the largest array of a batch


@dataclass
class Tally:
    """What was checked, for the printed summary; margins are floats for people."""

    leaves: int = 0
    ring_leaves: int = 0
    ring_margin: float | None = None  # smallest -Vdot bound over the ring's leaves
    local_margin: float = 0.0  # smallest eigenvalue less remainder, over the eigenvalue


def check(certificate: Certificate) -> Tally:
    """Check every rule; returns the tally, raises `Rejected` at the first rule that fails.

    Of evidence that cannot be replayed only the exact rules are checked: levels, lyapunov, equilibrium, domain,
    centring. The tally then has no leaves, and the caller must not say ACCEPTED.
    """
    self_test()
    c = certificate
    tally = Tally()
    with np.errstate(all="ignore"):  # overflow becomes infinity or NaN, and every test below then fails
        _check_levels(c)
        P = rational(c.P)
        inverse_P = inverse_diagonal(P)
        if inverse_P is None:
            raise Rejected("lyapunov", "lyapunov.P", "P must be symmetric and positive definite")
        _check_equilibrium(c)
        c2 = Fraction(c.c2)
        for i, ((lo, hi), p) in enumerate(zip(c.domain, inverse_P, strict=True)):
            if not (lo < 0 < hi and c2 * p < min(-lo, hi) ** 2):
                raise Rejected("domain", c.states[i], "{V <= c2} must lie in the interior of the domain")
        if isinstance(c.evidence, Trusted):
            fold(c.policy, c.u_eq)
            return tally
        T, root = c.evidence.T, c.evidence.root
        S = congruence(rational(T), P)
        inverse_S = inverse_diagonal(S)
        least = gershgorin_lower(S)
        if inverse_S is None or not least > 0:
            raise Rejected("coordinates", "evidence.T", "T'PT must be positive definite and diagonally dominant")
        for i, (b, s) in enumerate(zip(root, inverse_S, strict=True)):
            if not (b > 0 and c2 * s <= Fraction(float(b)) ** 2):
                raise Rejected("root", f"axis {i}", "the root box must contain {V <= c2}")
        net = fold(c.policy, c.u_eq)
        bounded = _inputs_bounded_by_form(c)
        _check_local(c, T, net, least, bounded, tally)
        ring = _Ring(c, T, net, S, bounded)
        for first, lo_z, hi_z in _leaves(c.evidence.tree, root, ring.batch):
            tally.leaves += len(lo_z)
            if c.c1 < c.c2:  # otherwise the local rule has covered V <= c2
                ring.check(first, lo_z.T, hi_z.T, tally)
    return tally


def _check_levels(c: Certificate) -> None:
    if not 0 < c.c1 <= c.c2 < float("inf"):
        raise Rejected("levels", "levels", "must satisfy 0 < local <= roa")


def _check_equilibrium(c: Certificate) -> None:
    try:
        value = evaluate(c.dynamics, RationalAlgebra(), [*[Fraction(0)] * len(c.states), *c.u_eq])
    except Undecided as error:
        raise Rejected("equilibrium", "plant.dynamics", f"f(0, u_eq) is not decided exactly: {error}") from error
    for name, v in zip(c.states, value, strict=True):
        if v != 0:
            raise Rejected("equilibrium", name, "f(0, u_eq) must be 0")


def _inputs_bounded_by_form(c: Certificate) -> bool:
    """True if `offset +- scale` lies in the input bounds and the centring keeps the input there."""
    if c.policy.squash != "tanh" or c.policy.centre == "output":
        return False
    return all(
        lo <= Fraction(float(o)) - abs(Fraction(float(s))) and Fraction(float(o)) + abs(Fraction(float(s))) <= hi
        for o, s, (lo, hi) in zip(c.policy.offset, c.policy.scale, c.input_bounds, strict=True)
    )


def _within(bounds: tuple[Fraction, Fraction], mid: Array, radius: Array) -> NDArray[np.bool_]:
    """Elementwise: [mid - radius, mid + radius] certainly lies in the bounds."""
    (lo, lo_error), (hi, hi_error) = float_with_error(bounds[0]), float_with_error(bounds[1])
    reach = up(radius + EPS * np.abs(mid))
    slack = up(lo_error + hi_error + EPS * (abs(lo) + abs(hi)))
    return np.asarray((mid - reach >= lo + slack) & (mid + reach <= hi - slack))


def _check_local(c: Certificate, T: Array, net: Folded, least: Fraction, bounded: bool, tally: Tally) -> None:
    """Claim 3: with z = rho d, {V <= c1} lies in ||d|| <= 1 and Vdot = 2 rho d'G(d), G = T'P F(T rho d).

    F(0) = 0 exactly, so G(d) = B d + R(d) with ||R(d)|| <= k ||d||^2, and Vdot <= 2 rho ||d||^2 (-mu + k ||d||) with
    mu a lower bound of the smallest eigenvalue of -(B + B')/2.
    """
    n = len(c.states)
    ratio, _ = float_with_error(Fraction(c.c1) / least)
    rho = float(np.sqrt(ratio) * (1 + 2.0**-40)) + 2.0**-960
    if not (rho < float("inf") and least * Fraction(rho) ** 2 >= Fraction(c.c1)):
        raise Rejected("local", "levels.local", "the level is out of range")
    J = rho * T
    slack = float(up(EPS * float(norm(norm(J, 1), 0))))
    states = [Jet(0.0, 0.0, J[i], slack, 0.0) for i in range(n)]
    gradient, u_slack, u_k = enclose_at_origin(net, J, slack)
    inputs = []
    for j, (q, scale) in enumerate(zip(c.u_eq, net.scale, strict=True)):
        value, error = float_with_error(q)
        wide = float(up(abs(scale) * u_slack + EPS * float(norm(gradient[j], 0))))
        inputs.append(Jet(value, error, gradient[j], wide, float(up(abs(scale) * u_k))))
        reach = up(np.array(error + inputs[j].radius))
        if not bounded and not _within(c.input_bounds[j], np.array(value), reach):
            raise Rejected("inputs", "local ball", f"{c.inputs[j]} may leave its bounds")
    algebra = JetAlgebra(n)
    F = evaluate(c.dynamics, algebra, [*states, *inputs])
    PT = _product_with_error(c.P, T)
    B, doubt, k = np.zeros((n, n)), 0.0, 0.0
    for i in range(n):
        row, slack_i, k_i = np.zeros(n), 0.0, 0.0
        for j in range(n):
            value, error = float(PT[0][j, i]), float(PT[1][j, i])
            row = row + value * F[j].a
            size = up(abs(value) + error)
            slack_i = float(up(slack_i + size * F[j].slack + (error + EPS * n * size) * F[j].slope))
            k_i = float(up(k_i + size * F[j].k))
        B[i] = row
        doubt, k = float(up(doubt + slack_i * slack_i)), float(up(k + k_i * k_i))
    M = -(B + B.T) / 2
    off = total(np.abs(M - np.diag(np.diag(M))), 1)
    mu = float(np.min(np.diag(M) - off)) - float(up(np.sqrt(doubt) + gamma(n) * float(norm(norm(M, 1), 0))))
    bound = float(up(np.sqrt(k)))
    if not mu > up(bound):
        raise Rejected(
            "local", "levels.local", f"Vdot < 0 is not shown on the local ball: {mu:.3g} against {bound:.3g}"
        )
    tally.local_margin = 1 - bound / mu


def _product_with_error(P: Array, T: Array) -> tuple[Array, Array]:
    """`P T` and a bound of the rounding error of each entry."""
    return P @ T, np.asarray(up(gamma(len(P)) * norm(P, 1)[:, None] * norm(T, 0)[None, :]))


class _Ring:
    """The rule for a leaf, on batches of leaves."""

    def __init__(self, c: Certificate, T: Array, net: Folded, S: list[list[Fraction]], bounded: bool) -> None:
        self.c, self.T, self.net, self.bounded = c, T, net, bounded
        self.n, self.m = len(c.states), len(c.inputs)
        pairs = [[float_with_error(v) for v in row] for row in S]
        self.S_diagonal = np.array([pairs[i][i] for i in range(self.n)])
        size = np.array([[abs(v) + e for v, e in row] for row in pairs])
        self.S_cross = up(size - np.diag(np.diag(size)))
        width = max(max(W.shape) for W in net.weights)
        symbols = self.n + self.m
        numbers = max(width * (self.n + self.m + 4), symbols * symbols * (len(c.dynamics.operations) + 4))
        self.batch = max(1, min(4096, _BATCH_NUMBERS // numbers))

    def check(self, first: int, lo: Array, hi: Array, tally: Tally) -> None:
        """Leaves `first`, `first + 1`, ... with corners lo, hi (n, B) in the coordinates z."""
        inside = np.flatnonzero(np.logical_not(self._misses(lo, hi)))
        if len(inside) == 0:
            return
        lo, hi = lo[:, inside], hi[:, inside]
        centre = 0.5 * lo + 0.5 * hi
        radius = up(np.maximum(hi - centre, centre - lo))
        x, error = self._states(centre, radius)
        mid, slopes, wide = enclose_on_boxes(self.net, x, error)
        if not self.bounded:
            for j, bounds in enumerate(self.c.input_bounds):
                kept = _within(bounds, mid[j], up(total(np.abs(slopes[j]), 0) + wide[j]))
                if not np.all(kept):
                    leaf = first + int(inside[np.argmin(kept)])
                    raise Rejected("inputs", f"leaf {leaf}", f"{self.c.inputs[j]} may leave its bounds")
        bound = self._bound(self._vdot(x, error, mid, slopes, wide), centre, radius)
        good = bound < 0
        if not np.all(good):
            worst = int(np.argmin(good))
            raise Rejected("ring", f"leaf {first + int(inside[worst])}", f"Vdot < 0 is not shown: {bound[worst]:.3g}")
        tally.ring_leaves += len(inside)
        margin = float(np.min(-bound))
        tally.ring_margin = margin if tally.ring_margin is None else min(tally.ring_margin, margin)

    def _misses(self, lo: Array, hi: Array) -> NDArray[np.bool_]:
        """True where the leaf certainly has V < c1 everywhere, or V > c2 everywhere."""
        far = np.maximum(np.abs(lo), np.abs(hi))
        near = np.where((lo <= 0) & (hi >= 0), 0.0, np.minimum(np.abs(lo), np.abs(hi)))
        value, error = self.S_diagonal[:, :1], self.S_diagonal[:, 1:]
        cross = up(self._cross(far) + total(error * far * far, 0))
        least = np.sum(value * near * near, axis=0) * (1 - gamma(self.n + 4)) - cross - 2.0**-960
        most = up(total(value * far * far, 0) + cross)
        least = least - EPS * np.abs(least) - EPS * cross
        return np.asarray((least > self.c.c2) | (most < self.c.c1))

    def _states(self, centre: Array, radius: Array) -> tuple[Array, Array]:
        """x = T z on the boxes as affine forms (n, n + 1, B), and a bound of their rounding errors (n, B)."""
        T = self.T
        slopes = T[:, :, None] * radius[None]
        x = np.concatenate([(T @ centre)[:, None], slopes], axis=1)
        error = gamma(self.n) * norm(T, 1)[:, None] * norm(centre, 0) + EPS * total(np.abs(slopes), 1)
        return x, np.asarray(up(error))

    def _bound(self, vdot: Taylor, centre: Array, radius: Array) -> Array:
        """Upper bound of Vdot on the part of each box that lies in the ring.

        There c2 - V and V - c1 are not negative, so Vdot is at most Vdot + k (c2 - V), and at most Vdot + k (V - c1),
        for any k >= 0.
        """
        bound = upper_bound(vdot)
        for level, sign in ((self.c.c2, 1.0), (self.c.c1, -1.0)):
            open_ = np.flatnonzero(np.logical_not(bound < 0))
            gap, part = self._gap(centre[:, open_], radius[:, open_], level, sign), vdot.at(open_)
            k = _multiplier(part.g[: self.n], gap.g[: self.n], gap.c)
            bound[open_] = np.fmin(bound[open_], upper_bound(part + gap.scaled(k, 0.0)))
        return bound

    def _gap(self, centre: Array, radius: Array, level: float, sign: float) -> Taylor:
        """sign (level - V) on the boxes, which is not negative on the part of a leaf that lies in the ring."""
        far = up(np.abs(centre) + radius)
        value, error = self.S_diagonal[:, :1], self.S_diagonal[:, 1:]
        size = up(level + total(value * far * far, 0))
        g = np.zeros((self.n + self.m, centre.shape[1]))
        Q = np.zeros((self.n + self.m, *g.shape))
        g[: self.n] = -2 * sign * value * centre * radius
        for i in range(self.n):
            Q[i, i] = -sign * value[i] * radius[i] * radius[i]
        c = sign * (level - np.sum(value * centre * centre, axis=0))
        return Taylor(c, g, Q, up(self._cross(far) + total(error * far * far, 0) + gamma(self.n + 8) * size))

    def _cross(self, far: Array) -> Array:
        """Upper bound of what the off-diagonal part of S adds to V in magnitude where |z| <= far."""
        return np.asarray(total(total(self.S_cross[:, :, None] * far[:, None] * far[None, :], 0), 0))

    def _vdot(self, x: Array, error: Array, mid: Array, slopes: Array, wide: Array) -> Taylor:
        """Vdot = (2 P x)'f(x, u) on the boxes; symbols: n box coordinates, m input errors."""
        n, m, batch = self.n, self.m, x.shape[2]
        algebra = TaylorAlgebra(n + m, batch)
        variables = []
        for i in range(n):
            plain = algebra.affine(x[i, 0], np.concatenate([x[i, 1:], np.zeros((m, batch))]))
            variables.append(Taylor(plain.c, plain.g, plain.Q, error[i]))
        for j in range(m):
            own = np.zeros((m, batch))
            own[j] = wide[j]
            variables.append(algebra.affine(mid[j], np.concatenate([slopes[j], own])))
        F = evaluate(self.c.dynamics, algebra, variables)
        terms = []
        for i in range(n):
            gradient = [variables[j].scaled(2 * float(self.c.P[i, j]), 0.0) for j in range(n)]
            terms.append(_sum(gradient) * F[i])
        return _sum(terms)


def _multiplier(a: Array, b: Array, c: Array) -> Array:
    """The k >= 0 that minimises `c k + sum_i |a_i + k b_i|`, shape (B,): it is 0 or lies where a term vanishes.

    Any number k >= 0 would do for the proof; an infinite one or NaN makes the bound NaN.
    """
    k = np.maximum(np.where(b != 0, -a / b, 0.0), 0.0)
    value = c * k + np.sum(np.abs(a[:, None] + k * b[:, None]), axis=0)
    best = np.argmin(value, axis=0)
    return np.asarray(np.take_along_axis(k, best[None], 0)[0])


def _sum(models: list[Taylor]) -> Taylor:
    result = models[0]
    for model in models[1:]:
        result = result + model
    return result


def _leaves(tree: bytes, root: Array, batch: int) -> Iterator[tuple[int, Array, Array]]:
    """Batches (index of the first leaf, lo, hi) of the leaves of the partition tree, in preorder.

    A byte below n splits the current box at the middle of that axis, lower half first; 255 is a leaf. Both children
    share the same binary64 midpoint, so the leaves cover the root box.
    """
    n = len(root)
    half = [float(b) for b in root]
    stack = [([-b for b in half], half)]
    lows: list[list[float]] = []
    highs: list[list[float]] = []
    count = 0
    for position, axis in enumerate(tree):
        if not stack:
            raise Rejected("tree", f"byte {position}", "the tree goes on after its last leaf")
        lo, hi = stack.pop()
        if axis == LEAF:
            lows.append(lo)
            highs.append(hi)
            if len(lows) == batch:
                yield count, np.array(lows), np.array(highs)
                count += batch
                lows, highs = [], []
        elif axis < n:
            if len(stack) >= MAX_DEPTH:
                raise Rejected("tree", f"byte {position}", f"deeper than {MAX_DEPTH}")
            middle = 0.5 * lo[axis] + 0.5 * hi[axis]
            left, right = hi.copy(), lo.copy()
            left[axis] = right[axis] = middle
            stack.append((right, hi))
            stack.append((lo, left))
        else:
            raise Rejected("tree", f"byte {position}", f"must be an axis below {n} or {LEAF}")
    if stack:
        raise Rejected("tree", "end", f"the tree ends with {len(stack)} boxes open")
    if lows:
        yield count, np.array(lows), np.array(highs)
