"""The closed loop on a ball, ||d|| <= 1: every quantity as a jet over d (jets.py).

Around the origin x = J d; there F is 0 at rest. Along a path the last entry of d is the motion of the ball's middle
on a line: x = m + J z + w sigma, d = (z, sigma).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from .case import Case, Failures
from .document import Intervals
from .expression import Call, evaluate
from .functions import FUNCTIONS
from .jets import First, Jet, Units, between, constant, no_kinks, uncertain
from .near import ZERO, Above, Array, Cubic, Near, Square, Vector, all_near, mixed, near, size, stacked, triples, within
from .network import norm2
from .networks import Affine, Algebra, Map, Network, Step

if TYPE_CHECKING:
    from .kinks import Cone

_MOST_JETS = 2**26  # numbers in the matrices and tensors of all jets
_MOST_NUMBERS = 2**25  # in those of a layer and the paths to it
_MOST_PRODUCTS = 2**33  # in the sums over paths


@dataclass(frozen=True)
class Ball:
    """The models that rules need on a ball, each computed on first use. J (n, n) is exact, `at` its place."""

    case: Case
    J: Array
    at: str
    cone: Cone | None = field(
        default=None, kw_only=True
    )  # of d, on which relus and clips have kinks; None if there are none

    @property
    def motion(self) -> tuple[list[Fraction], list[Fraction]] | None:
        """m and w of a ball along a path, n numbers each; None around the origin."""
        return None

    @property
    def starts_at_u_eq(self) -> bool:
        """True if the inputs at d = 0 are u_eq: by form, or by rule `centring`."""
        return self.motion is None and (self.case.c.policy.centre != "none" or not self.case.c.practical)

    @property
    def order(self) -> int:
        """The order of the series in time."""
        return 1

    @property
    def count(self) -> int:
        """The number of variables y: one per uncertain quantity, and one for the period if it has a range."""
        lo, hi = self.case.c.sample or (0, 0)
        return len(self.case.c.ranges) + (lo < hi)

    @cached_property
    def states(self) -> list[Jet]:
        """x on the ball, exact but for rounding."""
        n, still = len(self.J), self.motion is None
        m, w = ([Fraction(0)] * n, [Fraction(0)] * n) if self.motion is None else self.motion
        k = n if still else n + 1
        nothing = constant(Fraction(0), Units(np.zeros((k, k, 0))), self.count)
        jets = []
        for row, at, by in zip(self.J, m, w, strict=True):
            step = near(by)
            a = Vector(row) if still else Vector(np.append(row, step.value), step.error)
            jets.append(replace(nothing, c=near(at), a=a))
        return jets

    @cached_property
    def outputs(self) -> Jet:
        """The network's values, squashed if the policy is: a batch of jets, whose errors belong to the units."""
        net = self.case.net
        h = OnBall(len(self.states[0].a.value), self.cone).value(net.network, self.states, net.origin, net.shift)
        return h.function("tanh") if net.squash else h

    @cached_property
    def units(self) -> Units:
        """The errors of the inputs: sums of those of all units of the network, the squash's included."""
        return reached(self.outputs, self.reach.value, self.case.net.scale)

    @cached_property
    def reach(self) -> Near:
        """The numbers (N, m) with which the units of `outputs` reach the inputs."""
        return Near(self.outputs.B.value) * Near(self.case.net.scale)

    @cached_property
    def inputs(self) -> list[Jet]:
        """pi(x) on the ball before the clip, each input with its own error.

        The remainder of `outputs` is a unit of each input's error (`reached`). Left for E are the roundings of the
        product with the scale: those of Q and K are errors of these, and those of `reach` count times the units.
        """
        h, scale = self.outputs, Near(self.case.net.scale)
        at_0 = all_near(self.case.c.u_eq) if self.starts_at_u_eq else h.c * scale + self.case.net.offset
        a = (h.a * scale).wider(h.by_kinks(self.reach.error + h.B.error * size(scale.value)))
        u = replace(h, c=at_0, a=a, Q=Square(h.Q.value) * scale, K=Cubic(h.K.value) * scale)
        E, lip = mixed(Square(h.units.U), Near(self.reach.error.top)), h.lipschitz * size(scale.value)
        return rows(replace(u, E=E, lip=lip), range(len(self.case.c.inputs)), self.units, 0, self.count)

    def constant(self, q: Fraction) -> Jet:
        """A rational among the jets of this ball."""
        return constant(q, self.units, self.count)

    def F(self, cell: Intervals = ()) -> list[Jet]:
        """The components of F on the ball, for all values of the uncertain quantities in a cell. At rest F(0) = 0, but
        these jets only know that 0 is near."""
        return self.f(self.states, self.symbols(cell))

    def change(self, cell: Intervals = ()) -> list[Jet]:
        """F, or in discrete time F - x, by how much a step changes x."""
        if not self.case.c.discrete:
            return self.F(cell)
        return [f + -x for f, x in zip(self.F(cell), self.shared(self.states), strict=True)]

    def f(self, states: Sequence[Jet], quantities: Sequence[Jet]) -> list[Jet]:
        """f(x, pi(x), q) at such states and quantities, all components in one family of errors: the inputs', and then
        those of each call."""
        units = self.units

        def called(call: Call, arguments: list[Jet]) -> list[Jet]:
            nonlocal units
            h = OnBall(len(units.R), self.cone).value(call.network, arguments)
            h = h.at(list(call.entries))
            first, units = units.count, units.with_more(reached(h, h.B.value, np.ones(len(call.entries))))
            plain = replace(
                h,
                a=h.a.wider(h.by_kinks(h.B.error)),
                Q=Square(h.Q.value),
                K=Cubic(h.K.value),
                E=Square(np.zeros_like(h.E.value)),
            )
            return rows(replace(plain, lip=h.lipschitz), range(len(call.entries)), units, first, self.count)

        F = evaluate(self.case.c.dynamics, self.constant, [*self.shared(states), *self.inputs, *quantities], called)
        return [f if f.units is units else f.among(units) for f in F]

    def constraints(self, states: Sequence[Jet], quantities: Sequence[Jet]) -> list[Jet]:
        """The expressions that have to stay negative."""
        keep = self.case.c.keep
        return evaluate(keep, self.constant, [*self.shared(states), *self.inputs, *quantities]) if keep else []

    def shared(self, states: Sequence[Jet]) -> list[Jet]:
        """The states as jets with the inputs' errors."""
        return [replace(x, B=Near(np.zeros(self.units.count)), units=self.units) for x in states]

    def symbols(self, cell: Intervals) -> list[Jet]:
        """The uncertain quantities of a cell, as the numbers y have them."""
        return [uncertain(lo, hi, self.units, j, self.count) for j, (lo, hi) in enumerate(cell)]

    @property
    def ranges(self) -> list[Jet]:
        """The uncertain quantities, of which only their whole ranges are known."""
        return [between(lo, hi, self.units, self.count) for lo, hi in self.case.c.ranges]


def fits(ball: Ball) -> Failures:
    """The jets take neither too much memory nor too much time."""
    c, symbols = ball.case.c, len(ball.J) + (ball.motion is not None)
    operations = (c.dynamics.size + c.policy.network.operations) * ball.order**2 * (1 + ball.count)
    if operations * numbers_of(symbols) > _MOST_JETS:
        yield "plant.dynamics", "the equations are too large for this rule"
    called = [(call.network, call.network.reads) for call in c.dynamics.calls.values()]
    for network, arguments in ((c.policy.network, 0), *called):
        if is_too_large(network, symbols, arguments):
            yield "networks", f"the network {network.name} is too large for this rule"
    return 0


def keeps_inputs(ball: Ball) -> Failures:
    """`inputs`: by form, or by the enclosure on the ball."""
    c = ball.case.c
    if not ball.case.bounded:
        for name, bounds, u in zip(c.inputs, c.input_bounds, ball.inputs, strict=True):
            if not within(bounds, u.range):
                yield ball.at, f"{name} may leave its bounds"
    return len(c.inputs)


def keeps_constraints(ball: Ball, constraints: Sequence[Jet]) -> Failures:
    """`keep`: every constraint is negative on the ball."""
    for j, g in enumerate(constraints):
        if not g.range.ends[1] < 0:
            yield ball.at, f"constraint {j} may be violated"
    return len(constraints)


def is_not_clipped(ball: Ball) -> Failures:
    """Every input lies strictly inside the policy's clip, so that the clip does not change its jets."""
    clip = ball.case.net.clip
    for name, u, *limits in zip(ball.case.c.inputs, ball.inputs, *clip, strict=True) if clip else ():
        low, high = u.range.ends
        if not limits[0] < low <= high < limits[1]:
            yield ball.at, f"{name} may be clipped: policy.clip"
    return 0


def numbers_of(k: int) -> int:
    """Numbers in the matrices and tensors of a jet."""
    return k * k + len(triples(k)[0])


def is_too_large(network: Network, k: int, arguments: int) -> bool:
    """True if jets of a network in k symbols, of which so many arguments are units, take too much memory or time."""
    products = 0
    for rows, width, before in network.shapes:
        if before + arguments:
            columns = k + before + arguments
            products += rows * columns * (width + numbers_of(k))
            if columns * (rows + numbers_of(k)) > _MOST_NUMBERS or products > _MOST_PRODUCTS:
                return True
    return False


# ------------------------------------------------------------------------------------------------------------- networks


def reached(h: Jet, reach: Array, scale: Array) -> Units:
    """The errors of the rows of a batch of jets, scaled, as sums over units: those of its family, which reach them by
    `reach` (N, m), and for each row what else it does not know."""
    first, count = h.units.first, h.remainder.shape[2]
    first = None if first is None else first.beside(no_kinks(len(h.units.R), count))
    R, L = np.concatenate([h.units.U, h.remainder], 2), np.concatenate([reach, np.diag(scale)]).T
    return Units(R, L, first=first)


def rows(u: Jet, of: Sequence[int], units: Units, first: int, count: int) -> list[Jet]:
    """Some rows of a batch of jets, whose error is the one of its own number, from `first` on, in a family."""
    k, one = len(u.a.value), np.eye(units.count)
    nothing = Near(np.zeros(count)), Vector(np.zeros((k, count)))
    return [Jet(u.c[j], u.a[j], u.Q[j], u.K[j], u.E[j], Near(one[first + j]), units, *nothing, u.lip[j]) for j in of]


@dataclass(frozen=True)
class Rows:
    """A vector on a ball: y(0) + X (d, A), A stacking what the units so far add to their tangents, X (width, k + N),
    each column within an error of its own. Those of its own units, if it has `own`, come last, are the identity, and
    are not in X."""

    y: Near
    X: Vector
    own: int | None = None  # the number of the first
    at_0: Array | None = None  # which y(0) are exactly 0, where kinks ask


class OnBall(Algebra[Rows]):
    """Networks on a ball.

    Every vector is y(d) = y(0) + a.d + B A(d), where A_q is what a unit q adds to its tangent, and B has the products
    of weights and slopes with which it arrives, so that errors cancel as they do in truth. A unit is an entry of a map,
    or of expressions, or of an argument. A_q(d) is d'H_q d + C_q[d] + e_q(d), |e_q(d)| <= d'R_q d, and e_q has the
    Lipschitz constant lips_q.
    """

    def __init__(self, k: int, cone: Cone | None = None) -> None:
        self.k, self.cone = k, cone
        self.first = None if cone is None else no_kinks(k, 0)
        self.H, self.C, self.R = np.zeros((k, k, 0)), np.zeros((len(triples(k)[0]), 0)), np.zeros((k, k, 0))
        self.lips = Above(np.zeros(0))

    def value(
        self, network: Network, arguments: Sequence[Jet], origin: Array | None = None, shift: Near | None = None
    ) -> Jet:
        """The network's value at `origin` + the arguments, and a shift: a batch of jets, whose errors belong to the
        units."""
        x = self.entered(arguments)
        if origin is not None and np.any(origin):
            x = replace(x, y=x.y + Near(origin), at_0=None if x.at_0 is None else x.at_0 & (origin == 0))
        h = self.run(network, x)
        return self.jets(h if shift is None else replace(h, y=h.y + shift))

    def entered(self, jets: Sequence[Jet]) -> Rows:
        """Jets as a vector. What they have beyond a.d becomes units, unless there is nothing."""
        y, at_0 = stacked([v.v0 for v in jets]), None
        if self.cone is not None:
            at_0 = np.array([v.v0.value == 0 and v.v0.error.v == 0 for v in jets])  # a bound of 0 is 0
        errors = stacked([Near(0.0, v.gradient.error) for v in jets]).error.norm()
        X = Vector(np.array([v.a.value for v in jets]), errors * np.ones(self.k))
        if not any(np.any(part) for v in jets for part in (v.Q.value, v.K.value, v.remainder, v.B.value)):
            return Rows(y, X, at_0=at_0)
        H, C = np.stack([v.Q.value for v in jets], -1), np.stack([v.K.value for v in jets], -1)
        R = np.stack([(Square(v.remainder) + v.shares).majorant for v in jets], -1)
        own = self.with_units(H, C, R, Above(np.array([v.lipschitz.top for v in jets])))
        return Rows(y, X, own, at_0)

    def with_units(self, H: Array, C: Array, R: Array, lips: Above, first_order: First | None = None) -> int:
        """Add units; the number of the first."""
        if self.first is not None:
            self.first = self.first.beside(first_order or no_kinks(self.k, R.shape[2]))
        first = self.R.shape[2]
        self.H, self.C, self.R = (np.concatenate(pair, -1) for pair in ((self.H, H), (self.C, C), (self.R, R)))
        self.lips = self.lips.beside(lips)
        return first

    def columns(self, v: Rows, units: int) -> Vector:
        """X among so many units, those of its own among them."""
        X = v.X if v.own is None else wider(v.X, self.k + v.own).beside(np.eye(len(v.X.value)))
        return wider(X, self.k + units)

    def jets(self, v: Rows) -> Jet:
        """A vector as a batch of jets."""
        X, k = v.X if v.own is None else self.columns(v, v.own + len(v.X.value)), self.k
        B, ones = Near(X.value[:, k:].T, X.error[k:, None]), np.ones(len(X.value))
        N = len(B.value)
        R = self.R[..., :N]
        a, Q, K = Vector(X.value[:, :k].T, (X.error[:k].norm() + self.doubt_of_kinks(B)) * ones), *self.beyond(B)
        E = Square(np.zeros_like(Q.value), (B.error * Square(R).size[:, None]).sum() * ones)
        of_y = Near(np.zeros((0, len(ones)))), Vector(np.zeros((k, 0, len(ones))))  # a network knows nothing of y
        units = Units(R, first=None if self.first is None else self.first.of(N))
        return Jet(v.y, a, Q, K, E, Near(B.value), units, *of_y, (B.size * self.lips[:N, None]).sum())

    def doubt_of_kinks(self, B: Near) -> Above:
        """Upper bound of what kinks add by the errors of B, over ||d||: their R is 0, so that E does not have it."""
        return ZERO if self.first is None else (B.error * Above(self.first.rho[: len(B.value), None])).sum()

    def beyond(self, B: Near) -> tuple[Square, Cubic]:
        """Q and K of vectors that units reach by B (N, width)."""
        N = len(B.value)
        return mixed(Square(self.H[..., :N]), B), mixed(Cubic(self.C[:, :N]), B)

    def affine(self, step: Affine, v: Rows) -> Rows:
        X = v.X if v.own is None else wider(v.X, self.k + v.own)
        X = X.mapped(step.weight, norm2(step))
        if v.own is not None:  # the units of the step just before arrive through W alone
            X = X.beside(step.weight)
        at_0 = None if v.at_0 is None else (step.bias == 0) & ~np.any((step.weight != 0) & ~v.at_0, 1)
        return Rows(v.y.through(step.weight) + Near(step.bias), X, at_0=at_0)

    def map(self, step: Map, v: Rows) -> Rows:
        value = self.jets(v)
        if self.cone is not None and step.function == "relu":
            return self.bent(step, v, value)
        phi = FUNCTIONS[step.function].expansion(value.v0, value.radius)
        bent, twisted, rest = value.beyond_tangent(phi)
        rest = rest.wider(bent.error + twisted.error)
        lips = value.lip_beyond_tangent(phi) + bent.error * 2 + twisted.error * 3
        X = self.columns(v, value.units.count).times(phi.f[1])
        at_0 = None if v.at_0 is None else v.at_0 & (FUNCTIONS[step.function].at_0 == 0)
        return Rows(phi.f[0], X, self.with_units(bent.value, twisted.value, rest.majorant, lips), at_0)

    def bent(self, step: Step, v: Rows, value: Jet) -> Rows:
        """Entries that are known to first order."""
        if self.cone is None:
            raise TypeError("kinks are asked for on a cone")
        found = self.cone.bent(step, value, v.at_0)
        X, N, k = self.columns(v, value.units.count).times(Near(found.slope)), len(found.slope), self.k
        nothing = np.zeros((k, k, N)), np.zeros((len(triples(k)[0]), N)), np.zeros((k, k, N)), Above(np.zeros(N))
        at_0 = v.at_0 & (found.y.value == 0)  # relu(0) = 0, and a clip of 0 is exact
        return Rows(found.y, X, self.with_units(*nothing, found.first), at_0)


def wider(X: Vector, columns: int) -> Vector:
    """X with columns of zeros, up to so many."""
    more = columns - X.value.shape[1]
    if more == 0:
        return X
    return Vector(np.concatenate([X.value, np.zeros((len(X.value), more))], 1), X.error.beside(Above(np.zeros(more))))
