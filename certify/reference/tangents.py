"""Networks on a ball x = centre + J d, ||d|| <= 1: the policy as models of the inputs before their clip, and calls.

A vector is y(d) = y(0) + G A d + L U(d). A has the gradients of *roots*: arguments, and results of `observe`. U stacks
*units*: what each entry of a `map`, and each root, adds to its tangent at d = 0. Of these y(0), G and L depend on the
ball's centre alone, and L is most of the work; so they are found once for all balls around the origin. There the policy
is u_eq, by its form or because rule `centring` has shown it; at any other centre it is a number like others, and so it
is at the origin with centring `none` where nothing is asked of it.

What the models of units leave out is an error of its own, which reaches every entry through L.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

from flint import arb, arb_mat, fmpq

from .balls import ONE, ZERO, absolute, beta, columns_scaled, finite, identity, total
from .document import Certificate
from .expressions import Call
from .function import net_at_0
from .functions import Beyond, beyond_tangent, expansion, unsure
from .kinks import Cone, Entry, Kink, entry, on_one_side
from .model import Model
from .networks import Affine, Clip, Concat, Map, Observe, Product, Sum, paired
from .symmetric import half, no_form, whole


@dataclass(frozen=True)
class Units:
    """The errors of all units: e_q, |e_q| <= d'R_q d, of which input or entry j sees sum_q L_jq e_q.

    Each row of R has half of a symmetric matrix, for n variables. Units that are kinks, by their numbers, have R = 0.
    """

    n: int
    L: arb_mat
    R: list[list[arb]]
    kinks: Mapping[int, Kink] = field(default_factory=dict)

    @cached_property
    def wholes(self) -> list[arb_mat]:
        return [whole(row, self.n) for row in self.R]

    @cached_property
    def squares(self) -> arb_mat:
        """R_q'R_q, a row for each unit."""
        return arb_mat(len(self.R), self.n**2, [v for R in self.wholes for v in (R.transpose() * R).entries()])

    def errors(self) -> tuple[arb_mat, ...]:
        """U_j of each input: sum_q |L_jq| R_q."""
        if not self.R:
            return tuple(arb_mat(self.n, self.n) for _ in range(self.L.nrows()))
        sums: list[list[arb]] = (absolute(self.L) * arb_mat(self.R)).tolist()
        return tuple(whole(row, self.n) for row in sums)

    def rhos(self) -> tuple[arb, ...]:
        """sum_q |L_jq| rho_q of each input; none without kinks."""
        if not self.kinks:
            return ()
        return tuple(total(abs(row[q]) * kink.rho for q, kink in self.kinks.items()) for row in self.L.tolist())

    def is_finite(self) -> bool:
        known = all(kink.is_finite() for kink in self.kinks.values())
        return known and finite(self.L.entries()) and all(finite(row) for row in self.R)

    def beside(self, other: Units) -> Units:
        """The units of both, each seen by its own entries."""
        ours, theirs = [ZERO] * len(self.R), [ZERO] * len(other.R)
        rows = [[*row, *theirs] for row in self.L.tolist()] + [[*ours, *row] for row in other.L.tolist()]
        L = arb_mat(len(rows), len(ours + theirs), [v for row in rows for v in row])
        kinks = {**self.kinks, **{len(ours) + q: kink for q, kink in other.kinks.items()}}
        return Units(self.n, L, self.R + other.R, kinks)


@dataclass
class Stack:
    """H, C and R of the units so far, a row for each, halves of H and R; their Lipschitz constants, if needed."""

    n: int
    steady: bool
    H: list[list[arb]] = field(default_factory=list)
    C: list[list[arb]] = field(default_factory=list)
    R: list[list[arb]] = field(default_factory=list)
    lip: list[arb] = field(default_factory=list)
    kinks: dict[int, Kink] = field(default_factory=dict)

    def bend(self, kink: Kink | None) -> None:
        """A unit that is a kink, or nothing."""
        if kink is not None:
            self.kinks[len(self.R)] = kink
        none = arb_mat(self.n, self.n)
        self.append(Beyond(none, no_form(self.n), none, ZERO if self.steady else None))

    def with_kinks(self, models: list[Model], L: arb_mat) -> list[Model]:
        """The same, each with one error that is all it sees of the kinks, within sum_q |L_iq| rho_q ||d||."""
        if not self.kinks:
            return models
        seen = [(q, kink.rho) for q, kink in self.kinks.items() if q < L.ncols()]
        swings = [total(abs(row[q]) * rho for q, rho in seen) for row in L.tolist()]
        none = (arb_mat(self.n, self.n),)
        return [replace(v, B=(ONE,), errors=none, rhos=(s,)) for v, s in zip(models, swings, strict=True)]

    def append(self, unit: Beyond) -> None:
        self.H.append(half(unit.H))
        self.C.append(unit.C.entries())
        self.R.append(half(unit.R))
        if unit.lip is not None:
            self.lip.append(unit.lip)


@dataclass(frozen=True)
class Tangent:
    """Values at the centre, G and L of a vector; L may have fewer columns than there are units by now.

    With `own` entry i has besides the unit number own + i, with which L goes on.
    """

    at_0: list[arb]
    G: arb_mat
    L: arb_mat
    own: bool = False

    @cached_property
    def ways(self) -> arb_mat:
        """All of L."""
        return beside(self.L, identity(len(self.at_0))) if self.own else self.L

    @cached_property
    def magnitudes(self) -> arb_mat:
        return absolute(self.ways)

    def scaled(self, factors: Sequence[arb], at_0: list[arb], own: bool) -> Tangent:
        """Every entry times a factor, but for the values, and then units for each."""
        G, L = (columns_scaled(A.transpose(), factors).transpose() for A in (self.G, self.ways))
        return Tangent(at_0, G, L, own)


@dataclass(frozen=True)
class Vector:
    """A value at the centre lies within `off` of its tangent's, a gradient within `slack`; None is 0."""

    tangent: Tangent
    off: list[arb] | None = None
    slack: list[arb] | None = None

    def doubts(self) -> list[tuple[arb, arb]]:
        """off and slack of each entry."""
        nothing = [ZERO] * len(self.tangent.at_0)
        return list(zip(self.off or nothing, self.slack or nothing, strict=True))


class OnBall:
    """Networks between tangents. A `memo` has those of all balls around the same centre.

    `changes` counts what has been made of vectors, in the same order on each ball. With a cone kinks have models.
    """

    def __init__(
        self, given: Sequence[Model], memo: dict[int, Tangent] | None = None, cone: Cone | None = None
    ) -> None:
        n = given[0].a.nrows()
        self.memo, self.changes, self.cone = memo if cone is None else None, 0, cone
        self.roots = list[list[arb]]()
        self.stack = Stack(n, given[0].lip is not None)
        self.first = self.rooted(given, [not bends(v) for v in given])

    def rooted(self, given: Sequence[Model], straight: Sequence[bool]) -> Vector:
        """A vector of models, each a root with a unit unless it is straight; without what they say of y."""
        before, count = len(self.stack.R), len(given)
        at = [k for k, each in enumerate(straight) if not each]
        for k in at:
            v = given[k]
            lip = v.lip if self.stack.steady else None
            self.stack.append(Beyond(v.Q, v.K, v.whole, lip))
        earlier = len(self.roots)
        self.roots += [list(v.a.entries()) for v in given]

        def make() -> Tangent:
            G = beside(arb_mat(count, earlier), identity(count))
            own = [[ONE if k == q else ZERO for q in at] for k in range(count)]
            L = beside(arb_mat(count, before), arb_mat(count, len(at), [v for row in own for v in row]))
            return Tangent([v.v for v in given], G, L)

        return self.made(make, *([f(v) for v in given] for f in (doubt_of, turn_of)))

    def made(self, make: Callable[[], Tangent], off: list[arb] | None = None, slack: list[arb] | None = None) -> Vector:
        self.changes += 1
        certain = all(v.is_zero() for v in (off or []) + (slack or []))
        doubts = (None, None) if certain else (off, slack)
        if self.memo is None:
            return Vector(make(), *doubts)
        if self.changes not in self.memo:
            self.memo[self.changes] = make()
        return Vector(self.memo[self.changes], *doubts)

    # --------------------------------------------------------------------------------------------------- the steps

    def affine(self, step: Affine, v: Vector) -> Vector:
        def make() -> Tangent:
            W, y = step.W, v.tangent
            at_0 = (W * arb_mat(len(y.at_0), 1, y.at_0)).entries()
            L = beside(W * y.L, W) if y.own else W * y.ways
            return Tangent([x + b for x, b in zip(at_0, step.b, strict=True)], W * y.G, L)

        return self.made(make, *(through(step, part) for part in (v.off, v.slack)))

    def map(self, step: Map, v: Vector) -> Vector:
        models = self.models(v)
        if self.cone is not None and step.function == "relu":
            return self.kinked(v, [entry(self.cone, y, ZERO, None) for y in models])
        each = list[Entry]()
        for y in models:
            phi = expansion(y, step.function)
            self.stack.append(beyond_tangent(y, phi))
            each.append(Entry(*phi.at[:2], *unsure(y, phi)))
        return self.sloped(v, each, True)

    def kinked(self, v: Vector, each: Sequence[Entry]) -> Vector:
        """Entries with a unit each, which is a kink or nothing."""
        for one in each:
            self.stack.bend(one.kink)
        return self.sloped(v, each, True)

    def sloped(self, v: Vector, each: Sequence[Entry], own: bool) -> Vector:
        """Every entry times its slope, but for the values, and then units for each, which are there by now."""
        slopes, values = [one.slope for one in each], [one.value for one in each]

        def make() -> Tangent:
            return (self.widened(v.tangent) if own else v.tangent).scaled(slopes, values, own)

        return self.made(make, [one.off for one in each], [one.slack for one in each])

    def widened(self, y: Tangent) -> Tangent:
        """The same with a column for each unit before those of a map."""
        missing = len(self.stack.R) - len(y.at_0) - y.ways.ncols()
        return y if missing == 0 else replace(y, L=beside(y.ways, arb_mat(len(y.at_0), missing)), own=False)

    def clip(self, step: Clip, v: Vector) -> Vector:
        """Each entry as it is or as an end, if one of both is certain; else, with a cone, it is a kink."""
        each = list(zip(self.models(v), map(arb, step.lo), map(arb, step.hi), strict=True))
        if self.cone is not None:
            return self.kinked(v, [entry(self.cone, *one) for one in each])
        return self.sloped(v, [on_one_side(*one) for one in each], False)

    def sum(self, step: Sum, *vectors: Vector) -> Vector:
        def make() -> Tangent:
            at_0 = [sum(each, ZERO) for each in zip(*(v.tangent.at_0 for v in vectors), strict=True)]
            first, *others = (self.aligned(v.tangent) for v in vectors)
            G, L = first
            for more_G, more_L in others:
                G, L = G + more_G, L + more_L
            return Tangent(at_0, G, L)

        each = [sum_of(pairs) for pairs in zip(*(v.doubts() for v in vectors), strict=True)]
        return self.made(make, *([*part] for part in zip(*each, strict=True)))

    def concat(self, step: Concat, *vectors: Vector) -> Vector:
        def make() -> Tangent:
            parts = [self.aligned(v.tangent) for v in vectors]
            G, L = (stacked([part[k] for part in parts]) for k in range(2))
            return Tangent([x for v in vectors for x in v.tangent.at_0], G, L)

        each = [doubts for v in vectors for doubts in v.doubts()]
        return self.made(make, *([*part] for part in zip(*each, strict=True)))

    def product(self, step: Product, v: Vector, w: Vector) -> Vector:
        """v w = v(0) w(0) + v(0) (w - w(0)) + w(0) (v - v(0)) and a unit, the product of what is in brackets."""
        pairs = list(paired(self.models(v), self.models(w)))

        def make() -> Tangent:
            values = list(paired(v.tangent.at_0, w.tangent.at_0))
            (G, L), (H, M) = self.aligned(v.tangent), self.aligned(w.tangent)
            return Tangent([p * q for p, q in values], crossed(values, G, H), crossed(values, L, M), True)

        off = [x.size * y.off + y.size * x.off for x, y in pairs]
        slack = [x.size * y.slack + x.off * y.slope + y.size * x.slack + y.off * x.slope for x, y in pairs]
        slack = [s + x.doubt * y.kinked + y.doubt * x.kinked for s, (x, y) in zip(slack, pairs, strict=True)]
        result = self.made(make, off, slack)
        for x, y in pairs:
            both = replace(x, v=ZERO) * replace(y, v=ZERO)
            self.stack.append(Beyond(both.Q, both.K, both.whole, both.lip))
        return result

    def aligned(self, y: Tangent) -> tuple[arb_mat, arb_mat]:
        """G and L with a column for each root and each unit so far."""
        rows, L = len(y.at_0), y.ways
        G = beside(y.G, arb_mat(rows, len(self.roots) - y.G.ncols()))
        return G, beside(L, arb_mat(rows, len(self.stack.R) - L.ncols()))

    def observe(self, step: Observe, v: Vector) -> Vector:
        """The expressions of models of the entries, whose errors are those of the units."""
        units = Units(self.stack.n, arb_mat(0, 0), list(self.stack.R))
        rhos = tuple(self.stack.kinks[q].rho if q in self.stack.kinks else ZERO for q in range(len(self.stack.R)))
        errors, rows = tuple(units.wholes), self.aligned(v.tangent)[1].tolist()
        nothing = arb_mat(self.stack.n, self.stack.n)
        models = [
            replace(y, E=nothing, B=tuple(row), errors=errors, rhos=rhos)
            for y, row in zip(self.models(v), rows, strict=True)
        ]
        some = models[0]

        def constant(q: fmpq) -> Model:
            return Model.affine(arb(q), [ZERO] * self.stack.n, errors, None if some.lip is None else ZERO)

        results = step.expressions.evaluate(dict(zip(step.names, models, strict=True)), constant)
        return self.rooted(results, [False] * step.size)

    # ------------------------------------------------------------------------------------------------- the results

    def models(self, v: Vector) -> list[Model]:
        """Sums over the units with L, and of their bounds with its magnitudes. Kinks are one error of each together."""
        n, y, stack = self.stack.n, v.tangent, self.stack
        a, seen = (y.G * arb_mat(self.roots[: y.G.ncols()])).tolist(), y.ways.ncols()
        each = list(zip(y.at_0, a, v.doubts(), strict=True))
        if not seen:
            lip = ZERO if stack.steady else None
            return [replace(Model.affine(x, row, lip=lip), off=off, slack=slack) for x, row, (off, slack) in each]
        parts = ((y.ways, stack.H), (y.ways, stack.C), (y.magnitudes, stack.R))
        Q, K, E = ((W * arb_mat(rows[:seen])).tolist() for W, rows in parts)
        lips: list[arb | None] = [None] * len(a)
        if stack.steady:
            lips = list((y.magnitudes * arb_mat(seen, 1, stack.lip[:seen])).entries())
        models = [
            Model(x, arb_mat(n, 1, row), whole(q, n), arb_mat(1, len(k), k), whole(e, n), lip=lip, off=off, slack=slack)
            for (x, row, (off, slack)), q, k, e, lip in zip(each, Q, K, E, lips, strict=True)
        ]
        return stack.with_kinks(models, y.ways)

    def results(
        self, v: Vector, wanted: Sequence[int], before: Sequence[arb_mat] = (), rhos: Sequence[arb] = ()
    ) -> tuple[list[Model], Units]:
        """Some entries, each with an error of its own, B = 1, behind those `before`, of which kinks add `rhos`; and the
        units behind these."""
        models, (_, L) = self.models(v), self.aligned(v.tangent)
        rows = L.tolist()
        L = arb_mat(len(wanted), L.ncols(), [x for i in wanted for x in rows[i]])
        units = Units(self.stack.n, L, self.stack.R, self.stack.kinks)
        rhos = tuple(rhos) if self.cone is None else (*rhos, *(units.rhos() or (ZERO,) * len(wanted)))
        errors, nothing = (*before, *units.errors()), arb_mat(self.stack.n, self.stack.n)
        own = range(len(before), len(errors))
        return [
            replace(
                models[i],
                E=nothing,
                B=tuple(ONE if q == k else ZERO for q in range(len(errors))),
                errors=errors,
                rhos=rhos,
            )
            for i, k in zip(wanted, own, strict=True)
        ], units


class Calls:
    """The calls of one evaluation of the equations: their units stand beside the policy's."""

    def __init__(
        self, units: Units, errors: Sequence[arb_mat], rhos: Sequence[arb] = (), cone: Cone | None = None
    ) -> None:
        self.units, self.errors, self.rhos, self.cone = units, tuple(errors), tuple(rhos), cone

    def __call__(self, call: Call, given: Sequence[Model]) -> list[Model]:
        algebra = OnBall(given, cone=self.cone)
        value = call.network.run(algebra, algebra.first)
        models, units = algebra.results(value, call.entries, self.errors, self.rhos)
        self.units, self.errors, self.rhos = self.units.beside(units), models[0].errors, models[0].rhos
        return models


class Policy:
    """The policy of a certificate. At the origin it is u_eq, but for claims with a floor, with centring `none`."""

    def __init__(self, c: Certificate) -> None:
        self.c, self.memo, self.net_at_0 = c, dict[int, Tangent](), net_at_0(c)
        self.beta = beta(c) if c.policy.centre == "preactivation" else []

    def on(self, states: Sequence[Model], at_origin: bool, cone: Cone | None = None) -> tuple[list[Model], Units]:
        """The inputs before their clip, given models of the states on the ball, on a cone of it with kinks."""
        policy = self.c.policy
        read = [x.shifted(arb(v)) for x, v in zip(states, policy.origin, strict=True)]
        algebra = OnBall(read, self.memo if at_origin else None, cone)
        net = policy.network.run(algebra, algebra.first)
        before = [self.before_squash(j, v, at_origin) for j, v in enumerate(net.tangent.at_0)]
        y = replace(net, tangent=replace(net.tangent, at_0=before))
        if policy.squash == "tanh":
            y = algebra.map(Map((), self.c.m, "tanh"), y)
        values = [self.input_at(j, v, at_origin) for j, v in enumerate(y.tangent.at_0)]
        each = [
            Entry(value, scale, abs(scale) * off, abs(scale) * slack)
            for value, scale, (off, slack) in zip(values, map(arb, policy.scale), y.doubts(), strict=True)
        ]
        return algebra.results(algebra.sloped(y, each, False), range(self.c.m))

    def before_squash(self, j: int, net: arb, at_origin: bool) -> arb:
        """The value before the squash at the centre, where the network is `net`; `preactivation` gives beta at 0."""
        if self.c.policy.centre != "preactivation":
            return net
        return self.beta[j] if at_origin else net - self.net_at_0[j] + self.beta[j]

    def input_at(self, j: int, squashed: arb, at_origin: bool) -> arb:
        """Input j at the centre, before its clip."""
        policy, u_eq = self.c.policy, arb(self.c.plant.u_eq[j])
        if at_origin and (self.c.ends_at_origin or policy.centre != "none"):
            return u_eq
        scale, at_0 = arb(policy.scale[j]), self.net_at_0[j]
        if policy.centre != "output":
            return scale * squashed + arb(policy.offset[j])
        return scale * (squashed - (at_0.tanh() if policy.squash == "tanh" else at_0)) + u_eq


def bends(v: Model) -> bool:
    """True if it is not certain to be its tangent."""
    parts = (v.Q, v.K, v.whole)
    return not all(x.is_zero() for part in parts for x in part.entries()) or not (v.lip is None or v.lip.is_zero())


def doubt_of(v: Model) -> arb:
    return v.doubt


def turn_of(v: Model) -> arb:
    return v.turn


def sum_of(pairs: Sequence[tuple[arb, arb]]) -> tuple[arb, arb]:
    return sum((a for a, _ in pairs), ZERO), sum((b for _, b in pairs), ZERO)


def crossed(values: Sequence[tuple[arb, arb]], A: arb_mat, B: arb_mat) -> arb_mat:
    """For each pair (p, q) a row q a + p b, a and b of A and B, of which one may have a single row for all."""
    result = list[arb]()
    for (p, q), (a, b) in zip(values, paired(A.tolist(), B.tolist()), strict=True):
        result += [q * x + p * y for x, y in zip(a, b, strict=True)]
    return arb_mat(len(values), A.ncols(), result)


def through(step: Affine, part: list[arb] | None) -> list[arb] | None:
    return None if part is None else list((step.magnitudes * arb_mat(len(part), 1, part)).entries())


def beside(A: arb_mat, B: arb_mat) -> arb_mat:
    if A.ncols() == 0 or B.ncols() == 0:
        return A if B.ncols() == 0 else B
    return arb_mat([[*a, *b] for a, b in zip(A.tolist(), B.tolist(), strict=True)])


def stacked(parts: Sequence[arb_mat]) -> arb_mat:
    rows = [row for part in parts for row in part.tolist()]
    return arb_mat(len(rows), parts[0].ncols(), [v for row in rows for v in row])
