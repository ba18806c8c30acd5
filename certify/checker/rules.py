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

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from .arithmetic import Number, carry, frobenius, is_ball, lesser, maximum, middle, norm, product, spectral, total, up
from .document import Certificate, Partition
from .errors import Rejected
from .exact import Exact, Matrix, Undecided, congruence, gershgorin_lower, inverse_diagonal, rational
from .expression import evaluate
from .float64 import EPS, Array, float_with_error, gamma, self_test
from .local import Jet, enclose_at_origin, refuse_large, widen
from .local import constant as constant_jet
from .network import Folded, enclose_on_boxes, fold
from .taylor import Taylor, affine, upper_bound
from .taylor import constant as constant_model

RULES = (
    "format", "hash", "levels", "lyapunov", "equilibrium", "domain",
    "coordinates", "root", "centring", "inputs", "local", "tree", "ring",
)  # fmt: skip
LEAF = 255
MAX_DEPTH = 4096
_BATCH_NUMBERS = {"float64": 4_000_000, "arb": 100_000}  # numbers in the largest array of a batch


@dataclass
class Tally:
    """How often each rule was applied, and the margins, which are floats for people."""

    rules: Counter[str] = field(default_factory=lambda: Counter({**dict.fromkeys(RULES, 0), "format": 1, "hash": 1}))
    ring_margin: float | None = None  # smallest -Vdot bound over the ring's leaves
    local_margin: float = 0.0  # 1 - the remainder's largest part of the decay


def check(c: Certificate, arithmetic: str = "float64") -> Tally:
    """Check every rule; returns the tally, raises `Rejected` at the first rule that fails.

    Of evidence that cannot be replayed only the exact rules are checked: levels, lyapunov, equilibrium, domain,
    centring. The tally then has no leaves, and the caller must not say ACCEPTED.
    """
    self_test()
    with np.errstate(all="ignore"):  # overflow becomes infinity or NaN, and every test below then fails
        tally = Tally()
        P = rational(c.P)
        _check_exactly(c, P, tally)
        if isinstance(c.evidence, Partition):
            _check_evidence(c, c.evidence, P, arithmetic, tally)
        else:
            fold(c.policy, c.u_eq, arithmetic)
            tally.rules["centring"] += 1
    return tally


def _check_exactly(c: Certificate, P: Matrix, tally: Tally) -> None:
    if not 0 < c.c1 <= c.c2 < float("inf"):
        raise Rejected("levels", "levels", "must satisfy 0 < local <= roa")
    inverse = inverse_diagonal(P)
    if inverse is None:
        raise Rejected("lyapunov", "lyapunov.P", "P must be symmetric and positive definite")
    try:
        origin = [Exact(q) for q in (*[Fraction(0)] * len(c.states), *c.u_eq)]
        value = evaluate(c.dynamics, Exact, origin)
    except Undecided as error:
        raise Rejected("equilibrium", "plant.dynamics", f"f(0, u_eq) is not decided exactly: {error}") from error
    for name, v in zip(c.states, value, strict=True):
        if v.value != 0:
            raise Rejected("equilibrium", name, "f(0, u_eq) must be 0")
    for name, (lo, hi), p in zip(c.states, c.domain, inverse, strict=True):
        if not (lo < 0 < hi and Fraction(c.c2) * p < min(-lo, hi) ** 2):
            raise Rejected("domain", name, "{V <= c2} must lie in the interior of the domain")
    tally.rules.update(levels=1, lyapunov=1, equilibrium=len(value), domain=len(inverse))


def _check_evidence(c: Certificate, evidence: Partition, P: Matrix, arithmetic: str, tally: Tally) -> None:
    S = congruence(rational(evidence.T), P)
    inverse = inverse_diagonal(S)
    least = gershgorin_lower(S)
    if inverse is None or not least > 0:
        raise Rejected("coordinates", "evidence.T", "T'PT must be positive definite and diagonally dominant")
    for i, (b, s) in enumerate(zip(evidence.root, inverse, strict=True)):
        if not (b > 0 and Fraction(c.c2) * s <= Fraction(float(b)) ** 2):
            raise Rejected("root", f"axis {i}", "the root box must contain {V <= c2}")
    net = fold(c.policy, c.u_eq, arithmetic)
    T, bounded = carry(evidence.T, arithmetic), _inputs_bounded_by_form(c)
    tally.rules.update(coordinates=1, root=len(inverse), centring=1, inputs=len(c.inputs) if bounded else 0)
    _check_local(c, T, net, least, bounded, tally)
    ring = _Ring(c, T, net, S, bounded, arithmetic)
    for first, lo, hi in _leaves(evidence.tree, evidence.root, ring.batch):
        tally.rules["tree"] += len(lo)
        if c.c1 < c.c2:  # otherwise the local rule has covered V <= c2
            ring.check(first, carry(lo.T, arithmetic), carry(hi.T, arithmetic), tally)


def _inputs_bounded_by_form(c: Certificate) -> bool:
    """True if `offset +- scale` lies in the input bounds and the centring keeps the input there."""
    if c.policy.squash != "tanh" or c.policy.centre == "output":
        return False
    return all(
        lo <= Fraction(float(o)) - abs(Fraction(float(s))) and Fraction(float(o)) + abs(Fraction(float(s))) <= hi
        for o, s, (lo, hi) in zip(c.policy.offset, c.policy.scale, c.input_bounds, strict=True)
    )


def _within(bounds: tuple[Fraction, Fraction], mid: Number, radius: Number) -> NDArray[np.bool_]:
    """Elementwise: [mid - radius, mid + radius] certainly lies in the bounds."""
    (lo, lo_error), (hi, hi_error) = float_with_error(bounds[0]), float_with_error(bounds[1])
    reach = up(radius + EPS * np.abs(mid))
    least, most = lo + up(lo_error + EPS * abs(lo)), hi - up(hi_error + EPS * abs(hi))
    return np.asarray((mid - reach >= least) & (mid + reach <= most))


def _check_local(c: Certificate, T: Number, net: Folded, least: Fraction, bounded: bool, tally: Tally) -> None:
    """Claim 3: with z = rho d, {V <= c1} lies in ||d|| <= 1 and Vdot = 2 rho d'G(d), G = T'P F(T rho d).

    F(0) = 0 exactly, so d'G = d'B d + sum_j d_j d'C_j d + R, where |R| <= d'E d with E = sum_i ||(PT)_i|| E_i. Take any
    diagonal D > 0 and d = D e. With N = D (-(B + B')/2 - E) D and the n x n^2 matrix W of all D C_j D, d'G is at most
    -e'N e + ||W||_2 ||e||^2, and e'N e >= (1 - ||I - N||_2) ||e||^2.
    """
    n = len(c.states)
    ratio, _ = float_with_error(Fraction(c.c1) / least)
    rho = float(np.sqrt(ratio) * (1 + 2.0**-40)) + 2.0**-960
    if not (rho < float("inf") and least * Fraction(rho) ** 2 >= Fraction(c.c1)):
        raise Rejected("local", "levels.local", "the level is out of range")
    J = rho * T
    refuse_large(net, len(c.dynamics.operations), n, "arb" if is_ball(J) else "float64")
    slack = up(EPS * frobenius(J))
    nothing = np.zeros((n, n))
    variables = [Jet(0 * J[i, 0], 0.0, J[i], slack, nothing, nothing) for i in range(n)]
    gradient, u_slack, u_Q, u_E = enclose_at_origin(net, J, slack)
    each = zip(c.inputs, c.u_eq, net.scale, c.input_bounds, gradient, u_Q, u_E, strict=True)
    for name, q, scale, bounds, row, Q, E in each:
        u = _input(q, scale, row, u_slack, Q, E)
        variables.append(u)
        if not bounded:
            tally.rules["inputs"] += 1
            if not _within(bounds, u.c, up(u.error + u.radius)):
                raise Rejected("inputs", "local ball", f"{name} may leave its bounds")
    F = evaluate(c.dynamics, lambda q: constant_jet(q, n), variables)
    gradients, Q, E = (np.array([getattr(jet, field) for jet in F]) for field in ("a", "Q", "E"))
    slopes, slacks, bends = (np.array([[getattr(jet, field)] for jet in F]) for field in ("slope", "slack", "bend"))
    PT, doubt = product(c.P, T), up(gamma(n) * norm(c.P, 1)[:, None] * norm(T, 0)[None, :])  # of each entry
    size = up(np.abs(PT) + doubt)
    B, C = product(PT.T, gradients), product(PT.T, Q.reshape(n, -1))
    wrong = total(size * slacks + doubt * slopes + gamma(n) * (size * slopes), 0)  # of each row of B, in the 2-norm
    wrong = norm(wrong, 0) + norm(total(doubt * bends + gamma(n) * (size * bends), 0), 0)  # and of each C_j
    E = product(norm(size, 1)[None], E.reshape(n, -1)).reshape(n, n)
    M = -(B + B.T) / 2
    D = 1 / np.sqrt(middle(np.diagonal(M)))
    N = D[:, None] * (M - widen(E, wrong + EPS * frobenius(M), gamma(n) + EPS)) * D
    W = (C.reshape(n, n, n) * D[:, None] * D).reshape(n, -1)
    remainder = spectral(np.eye(n) - N) + spectral(W) + EPS * (frobenius(N) + frobenius(W) + n)
    tally.rules["local"] += 1
    if not remainder < 1:
        number = f"{float(middle(remainder)):.3g}"
        raise Rejected("local", "levels.local", f"Vdot < 0 is not shown on the local ball: {number} of the decay")
    tally.local_margin = float(1 - middle(remainder))


def _input(u_eq: Fraction, scale: Number, gradient: Number, slack: Number, Q: Number, E: Number) -> Jet:
    """u_eq + scale (G.d + d'Q d + r(d)), `gradient` being scale G, computed, and G within `slack` before scaling."""
    value, error = float_with_error(u_eq)
    rest = widen(abs(scale) * E, EPS * (abs(scale) * frobenius(Q)))
    return Jet(np.float64(value), error, gradient, up(abs(scale) * slack + EPS * norm(gradient, 0)), scale * Q, rest)


class _Ring:
    """The rule for a leaf, on batches of leaves."""

    def __init__(
        self, c: Certificate, T: Number, net: Folded, S: Matrix, bounded: bool, arithmetic: str = "float64"
    ) -> None:
        self.c, self.T, self.net, self.bounded = c, T, net, bounded
        self.n, self.m = len(c.states), len(c.inputs)
        value, error = np.moveaxis(np.array([[float_with_error(v) for v in row] for row in S]), 2, 0)
        self.S, self.S_error = np.diag(value)[:, None], np.diag(error)[:, None]  # of the diagonal, (n, 1)
        self.S_cross = up((np.abs(value) + error) * (1 - np.eye(self.n)))
        width = max(max(W.shape) for W in net.weights)
        symbols = self.n + self.m
        numbers = max(width * (symbols + 4), symbols * symbols * (len(c.dynamics.operations) + 4))
        self.batch = max(1, min(4096, _BATCH_NUMBERS[arithmetic] // numbers))

    def check(self, first: int, lo: Number, hi: Number, tally: Tally) -> None:
        """Leaves `first`, `first + 1`, ... with corners lo, hi (n, B) in the coordinates z."""
        inside = np.flatnonzero(np.logical_not(self._misses(lo, hi)))
        if len(inside) == 0:
            return
        lo, hi = lo[:, inside], hi[:, inside]
        centre = 0.5 * lo + 0.5 * hi
        radius = up(maximum(hi - centre, centre - lo))
        x, error = self._states(centre, radius)
        mid, slopes, wide = enclose_on_boxes(self.net, x, error)
        if not self.bounded:
            for j, bounds in enumerate(self.c.input_bounds):
                kept = _within(bounds, mid[j], up(total(np.abs(slopes[j]), 0) + wide[j]))
                if not np.all(kept):
                    leaf = first + int(inside[np.argmin(kept)])
                    raise Rejected("inputs", f"leaf {leaf}", f"{self.c.inputs[j]} may leave its bounds")
                tally.rules["inputs"] += len(kept)
        bound = self._bound(self._vdot(x, error, mid, slopes, wide), centre, radius)
        good = bound < 0
        if not np.all(good):
            worst = int(np.argmin(good))
            number = f"{middle(bound)[worst]:.3g}"
            raise Rejected("ring", f"leaf {first + int(inside[worst])}", f"Vdot < 0 is not shown: {number}")
        tally.rules["ring"] += len(inside)
        margin = float(np.min(middle(-bound)))
        tally.ring_margin = margin if tally.ring_margin is None else min(tally.ring_margin, margin)

    def _misses(self, lo: Number, hi: Number) -> NDArray[np.bool_]:
        """True where the leaf certainly has V < c1 everywhere, or V > c2 everywhere."""
        far = maximum(np.abs(lo), np.abs(hi))
        near = np.where((lo <= 0) & (hi >= 0), 0.0, lesser(np.abs(lo), np.abs(hi)))  # corners are exact
        cross = up(self._cross(far) + total(self.S_error * far * far, 0))
        least = np.sum(self.S * near * near, axis=0) * (1 - gamma(self.n + 4)) - cross - 2.0**-960
        most = up(total(self.S * far * far, 0) + cross)
        least = least - EPS * np.abs(least) - EPS * cross
        return np.asarray((least > self.c.c2) | (most < self.c.c1))

    def _states(self, centre: Number, radius: Number) -> tuple[Number, Number]:
        """x = T z on the boxes as affine forms (n, n + 1, B), and a bound of their rounding errors (n, B)."""
        slopes = self.T[:, :, None] * radius[None]
        x = np.concatenate([product(self.T, centre)[:, None], slopes], axis=1)
        error = gamma(self.n) * norm(self.T, 1)[:, None] * norm(centre, 0) + EPS * total(np.abs(slopes), 1)
        return x, up(error)

    def _bound(self, vdot: Taylor, centre: Number, radius: Number) -> Number:
        """Upper bound of Vdot on the part of each box that lies in the ring.

        There c2 - V and V - c1 are not negative, so Vdot is at most Vdot + k (c2 - V), and at most Vdot + k (V - c1),
        for any k >= 0.
        """
        bound = upper_bound(vdot)
        for level, sign in ((self.c.c2, 1.0), (self.c.c1, -1.0)):
            open_ = np.flatnonzero(np.logical_not(bound < 0))
            gap, part = self._gap(centre[:, open_], radius[:, open_], level, sign), vdot.at(open_)
            k = _multiplier(middle(part.g[: self.n]), middle(gap.g[: self.n]), middle(gap.c))
            other = upper_bound(part + gap.scaled(k, 0.0))
            better = np.full(bound.shape, np.inf, dtype=other.dtype)
            better[open_] = other
            bound = lesser(better, bound)
        return bound

    def _gap(self, centre: Number, radius: Number, level: float, sign: float) -> Taylor:
        """sign (level - V) on the boxes, which is not negative on the part of a leaf that lies in the ring."""
        far = up(np.abs(centre) + radius)
        size = up(level + total(self.S * far * far, 0))
        zeros = np.zeros((self.m, centre.shape[1]))
        g = np.concatenate([-2 * sign * self.S * centre * radius, zeros])
        q = np.concatenate([-sign * self.S * radius * radius, zeros])
        c = sign * (level - np.sum(self.S * centre * centre, axis=0))
        r = up(self._cross(far) + total(self.S_error * far * far, 0) + gamma(self.n + 8) * size)
        return Taylor(c, g, np.eye(len(q))[:, :, None] * q, r)

    def _cross(self, far: Number) -> Number:
        """Upper bound of what the off-diagonal part of S adds to V in magnitude where |z| <= far."""
        return total(far * total(self.S_cross[:, :, None] * far[None, :], 1), 0)

    def _vdot(self, x: Number, error: Number, mid: Number, slopes: Number, wide: Number) -> Taylor:
        """Vdot = (2 P x)'f(x, u) on the boxes; symbols: n box coordinates, m input errors."""
        n, m, batch = self.n, self.m, x.shape[2]
        variables = []
        for i in range(n):
            plain = affine(x[i, 0], np.concatenate([x[i, 1:], np.zeros((m, batch))]))
            variables.append(Taylor(plain.c, plain.g, plain.Q, error[i]))
        for j in range(m):
            variables.append(affine(mid[j], np.concatenate([slopes[j], np.eye(m)[:, j : j + 1] * wide[j]])))
        F = evaluate(self.c.dynamics, lambda q: constant_model(q, n + m, batch), variables)
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
