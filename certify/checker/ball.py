"""The closed loop on a ball, ||d|| <= 1: every quantity as a jet over d (jets.py).

Around the origin x = J d; there F is 0 at rest. Along a path the last entry of d is the motion of the ball's middle
on a line: x = m + J z + w sigma, d = (z, sigma).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cached_property
from typing import TYPE_CHECKING, Self

import numpy as np

from .case import Case, Failures
from .document import Intervals
from .expression import evaluate
from .functions import FUNCTIONS
from .jets import Jet, Units, constant
from .near import Above, Array, Cubic, Near, Square, Vector, all_near, mixed, near, size, stacked, triples, within
from .network import norm2
from .networks import Affine, Algebra, Map, Network

if TYPE_CHECKING:
    from .decrease import Models
    from .kinks import Cone


@dataclass(frozen=True)
class Ball:
    """The models that rules need on a ball, each computed on first use. J (n, n) is exact, `at` its place."""

    case: Case
    J: Array
    at: str
    directions: tuple[bytes, ...] | None = field(default=None, kw_only=True)  # trees of them; None if nothing has kinks
    cone: Cone | None = field(default=None, kw_only=True)  # the leaf of a tree whose d these are; None for all d
    close = False  # True if errors are meant for the difference of any two d

    @property
    def motion(self) -> tuple[list[Fraction], list[Fraction]] | None:
        """m and w of a ball along a path, n numbers each; None around the origin."""
        return None

    @property
    def starts_at_u_eq(self) -> bool:
        """True if the inputs at d = 0 are u_eq: by form, or by rule `centring`."""
        return self.motion is None and (self.case.c.policy.centre != "none" or not self.case.c.practical)

    @property
    def count(self) -> int:
        """The number of variables y: one per uncertain quantity, and one for the period if it has a range."""
        lo, hi = self.case.c.sample or (0, 0)
        return len(self.case.c.ranges) + (lo < hi)

    def on_cones(self) -> Iterator[Self]:
        """It, or it on each cone of d that trees of directions make."""
        if not self.directions:
            yield self
            return
        from .kinks import cones

        for cone in cones(self.directions, len(self.J), self.close):
            yield replace(self, cone=cone)

    def algebra(self, k: int) -> OnBall:
        """The algebra of networks, in k symbols."""
        if self.directions is None:
            return OnBall(k)
        from .kinks import OnCone, cone_of

        return OnCone(k, cone_of(self))

    def note_kinks(self, models: Models) -> None:
        """Add to models what kinks have beyond them."""
        if self.directions is not None:
            from .kinks import Kinks, cone_of

            models.more.append(Kinks.of(cone_of(self), models, self.case.c.P))

    @cached_property
    def states(self) -> list[Jet]:
        """x on the ball, exact but for rounding."""
        n, still = len(self.J), self.motion is None
        m, w = ([Fraction(0)] * n, [Fraction(0)] * n) if self.motion is None else self.motion
        k = n if still else n + 1
        nothing = constant(Fraction(0), Units(np.zeros((k, k, 0))))
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
        h = self.algebra(len(self.states[0].a.value)).value(net.network, self.states, net.origin, net.shift)
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
        a = (h.a * scale).wider(h.units.tilt(self.reach.error + h.B.error * size(scale.value)))
        u = replace(h, c=at_0, a=a, Q=Square(h.Q.value) * scale, K=Cubic(h.K.value) * scale)
        E, lip = mixed(Square(h.units.U), Near(self.reach.error.top)), h.lipschitz * size(scale.value)
        return self.of_y(rows(replace(u, E=E, lip=lip), range(len(self.case.c.inputs)), self.units, 0))

    def constant(self, q: Fraction) -> Jet:
        """A rational among the jets of this ball."""
        return constant(q, self.units)

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
        """f(x, pi(x), q) at such states and quantities, all components in one family of errors."""
        dynamics, variables = self.case.c.dynamics, [*self.shared(states), *self.inputs, *quantities]
        if not dynamics.calls:
            return evaluate(dynamics, self.constant, variables)
        from .calls import on_ball

        return on_ball(self, variables)

    def shared(self, states: Sequence[Jet]) -> list[Jet]:
        """The states as jets with the inputs' errors."""
        return self.of_y([replace(x, B=Near(np.zeros(self.units.count)), units=self.units) for x in states])

    def of_y(self, jets: list[Jet]) -> list[Jet]:
        """The same as functions of y too, if there are such numbers."""
        if not self.count:
            return jets
        from .ranges import in_y

        return [in_y(v, self.count) for v in jets]

    def symbols(self, cell: Intervals) -> list[Jet]:
        """The uncertain quantities of a cell, as the numbers y have them."""
        if not cell:
            return []
        from .ranges import uncertain

        return [uncertain(lo, hi, self.units, j, self.count) for j, (lo, hi) in enumerate(cell)]


def keeps_inputs(ball: Ball) -> Failures:
    """`inputs`: by form, or by the enclosure on the ball."""
    c = ball.case.c
    if not ball.case.bounded:
        for name, bounds, u in zip(c.inputs, c.input_bounds, ball.inputs, strict=True):
            if not within(bounds, u.range):
                yield ball.at, f"{name} may leave its bounds"
    return len(c.inputs)


def is_not_clipped(ball: Ball) -> Failures:
    """Every input lies strictly inside the policy's clip, so that the clip does not change its jets."""
    clip = ball.case.net.clip
    for name, u, *limits in zip(ball.case.c.inputs, ball.inputs, *clip, strict=True) if clip else ():
        low, high = u.range.ends
        if not limits[0] < low <= high < limits[1]:
            yield ball.at, f"{name} may be clipped: policy.clip"
    return 0


# ------------------------------------------------------------------------------------------------------------- networks


def reached(h: Jet, reach: Array, scale: Array) -> Units:
    """The errors of the rows of a batch of jets, scaled, as sums over units: those of its family, which reach them by
    `reach` (N, m), and for each row what else it does not know."""
    return h.units.beside(Units(h.remainder), np.concatenate([reach, np.diag(scale)]).T)


def rows(u: Jet, of: Sequence[int], units: Units, first: int) -> list[Jet]:
    """Some rows of a batch of jets, whose error is the one of its own number, from `first` on, in a family."""
    one = np.eye(units.count)
    return [Jet(u.c[j], u.a[j], u.Q[j], u.K[j], u.E[j], Near(one[first + j]), units, u.lip[j]) for j in of]


@dataclass(frozen=True)
class Rows:
    """A vector on a ball: y(0) + X (d, A), A stacking what the units so far add to their tangents, X (width, k + N),
    each column within an error of its own. Those of its own units, if it has `own`, come last, are the identity, and
    are not in X."""

    y: Near
    X: Vector
    own: int | None = None  # the number of the first
    at_0: Array = None  # which y(0) are exactly 0, where kinks.py asks


class OnBall(Algebra[Rows]):
    """Networks on a ball.

    Every vector is y(d) = y(0) + a.d + B A(d), where A_q is what a unit q adds to its tangent, and B has the products
    of weights and slopes with which it arrives, so that errors cancel as they do in truth. A unit is an entry of a map,
    or of expressions, or of an argument. A_q(d) is d'H_q d + C_q[d] + e_q(d), |e_q(d)| <= d'R_q d, and e_q has the
    Lipschitz constant lips_q.
    """

    def __init__(self, k: int) -> None:
        self.k = k
        self.H, self.C, self.R = np.zeros((k, k, 0)), np.zeros((len(triples(k)[0]), 0)), np.zeros((k, k, 0))
        self.lips = Above(np.zeros(0))

    def value(
        self, network: Network, arguments: Sequence[Jet], origin: Array | None = None, shift: Near | None = None
    ) -> Jet:
        """The network's value at `origin` + the arguments, and a shift: a batch of jets, whose errors belong to the
        units."""
        x = self.entered(arguments)
        if origin is not None and np.any(origin):
            x = self.moved(x, origin)
        h = self.run(network, x)
        return self.jets(h if shift is None else replace(h, y=h.y + shift))

    def moved(self, x: Rows, origin: Array) -> Rows:
        """The sum with exact numbers."""
        return replace(x, y=x.y + Near(origin))

    def entered(self, jets: Sequence[Jet]) -> Rows:
        """Jets as a vector. What they have beyond a.d becomes units, unless there is nothing."""
        y = stacked([v.v0 for v in jets])
        errors = stacked([Near(0.0, v.gradient.error) for v in jets]).error.norm()
        X = Vector(np.array([v.a.value for v in jets]), errors * np.ones(self.k))
        if not any(np.any(part) for v in jets for part in (v.Q.value, v.K.value, v.remainder, v.B.value, v.lip.top)):
            return Rows(y, X)
        H, C = np.stack([v.Q.value for v in jets], -1), np.stack([v.K.value for v in jets], -1)
        R = np.stack([(Square(v.remainder) + v.shares).majorant for v in jets], -1)
        own = self.with_units(H, C, R, Above(np.array([v.lipschitz.top for v in jets])))
        return Rows(y, X, own)

    def with_units(self, H: Array, C: Array, R: Array, lips: Above) -> int:
        """Add units; the number of the first."""
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
        units = self.units(len(B.value))
        a, Q, K = Vector(X.value[:, :k].T, (X.error[:k].norm() + units.tilt(B.error)) * ones), *self.beyond(B)
        E = Square(np.zeros_like(Q.value), (B.error * Square(units.R).size[:, None]).sum() * ones)
        return Jet(v.y, a, Q, K, E, Near(B.value), units, (B.size * self.lips[: units.count, None]).sum())

    def units(self, count: int) -> Units:
        """So many of the units, as a family of errors."""
        return Units(self.R[..., :count])

    def beyond(self, B: Near) -> tuple[Square, Cubic]:
        """Q and K of vectors that units reach by B (N, width)."""
        N = len(B.value)
        return mixed(Square(self.H[..., :N]), B), mixed(Cubic(self.C[:, :N]), B)

    def affine(self, step: Affine, v: Rows) -> Rows:
        X = v.X if v.own is None else wider(v.X, self.k + v.own)
        X = X.mapped(step.weight, norm2(step))
        if v.own is not None:  # the units of the step just before arrive through W alone
            X = X.beside(step.weight)
        return Rows(v.y.through(step.weight) + Near(step.bias), X)

    def map(self, step: Map, v: Rows) -> Rows:
        value = self.jets(v)
        phi = FUNCTIONS[step.function].expansion(value.v0, value.radius)
        bent, twisted, rest = value.beyond_tangent(phi)
        rest = rest.wider(bent.error + twisted.error)
        lips = value.lip_beyond_tangent(phi) + bent.error * 2 + twisted.error * 3
        X = self.columns(v, value.units.count).times(phi.f[1])
        return Rows(phi.f[0], X, self.with_units(bent.value, twisted.value, rest.majorant, lips))


def wider(X: Vector, columns: int) -> Vector:
    """X with columns of zeros, up to so many."""
    return X.beside(np.zeros((len(X.value), columns - X.value.shape[1])))
