"""Rule `flow`: the mean of f over a period in which the inputs are held, for every period of the sample.

phi(h) = x + h G, where x_1 is the mean over the period of f(x, u, q(t)), and what f changes by on the way is written as
a series in time whose last coefficient is taken at every state that phi may reach. That is found first: where hi f
stays between -a and b as long as the state is between x - a and x + b, no component can be the first to leave. On a
ball a and b are one number, kappa + kappa' ||d||.

What is uncertain may be another number at each instant. In x_1 alone a quantity stands at one instant at a time, so
that a symbol can be its mean. All else takes it as any number of its whole range, and not of a cell of it: within a
period q may go through several, and these numbers hold for all of them. D is a convex function of x_1 with the rest
given, and x_1 is a mean of means over the times that q spends in each cell, so that cells, one after the other, are
enough.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from flint import arb

from . import lipschitz
from .balls import SPREAD, ZERO, lesser
from .document import Certificate, Interval
from .evidence import Ball, Contraction
from .expressions import Called, Equations
from .fields import exact
from .loop import Field, Known, Loop
from .model import Model
from .rational import inverse_diagonal
from .refusal import Refused, require, under
from .series import Constant, added, coefficients
from .taylor import Taylor, constant

Move = tuple[arb, arb]  # by how much a state falls, and rises, at most
ATTEMPTS, MORE = 24, arb(1.25)  # more than the last move is tried, as long as that grows by more than this
LEAST = arb(2) ** -200  # of what is tried: it is positive, also for a state that moves one way only, or not at all


def later(
    dynamics: Equations,
    states: Mapping[str, Any],
    within: Mapping[str, Any],
    held: Mapping[str, Any],
    constant: Constant,
    order: int,
    settled: Callable[[Any], Any],
    times_h: Callable[[Any], Any],
) -> list[Any]:
    """h x_2 + ... + h^(order - 1) x_order of each component, None where nothing is left.

    `states` are those at the instant of the sample, `within` those of the whole period, from which the last comes.
    """
    result: list[Any] = [None] * len(states)
    if order == 1:
        return result
    known = coefficients(dynamics, states, held, constant, order - 1, settled) if order > 2 else [[]]
    last = coefficients(dynamics, within, held, constant, order, settled)[-1]
    for x in reversed([*known[1:], last]):
        result = [None if v is None else times_h(v) for v in map(added, zip(result, x, strict=True))]
    return result


# ------------------------------------------------------------------------------------------------------------ on a ball


@dataclass(frozen=True)
class Steps:
    """By how much the states of a ball change over a step: `within` a period they are these, `tail` is all but x_1."""

    loop: Loop
    known: Known
    order: int = 1
    within: Mapping[str, Model] | None = None
    tail: Sequence[Model | None] = ()

    def change(self, cell: Sequence[Interval], rule: str, at: str) -> Field:
        """Models of G for every q of a cell, or a refusal."""
        c, known = self.loop.c, self.known
        if self.within is not None and self.order == 1:
            known = replace(known, names={**known.names, **self.within})
        F = self.loop.within(known, cell, rule, at)
        if c.plant.discrete:
            less = (-known.names[name] for name in c.plant.states)
            return replace(F, components=[f + x for f, x in zip(F.components, less, strict=True)])
        if self.within is None:
            return F
        G = [f if t is None else settled(c)(f) + t for f, t in zip(F.components, self.tail, strict=True)]
        require(all(g.is_finite() for g in G), rule, at, "the series of F has no finite model")
        return replace(F, components=G)


def settled(c: Certificate) -> Callable[[Model], Model]:
    """At rest every coefficient vanishes at d = 0: f does, for every q, and each term has f as a factor."""
    return Model.at_rest if c.ends_at_origin else lambda v: v


def steps_on(
    loop: Loop,
    known: Known,
    ball: Ball | Contraction,
    at: str,
    within: Mapping[str, Model] | None = None,
    rule: str = "flow",
) -> Steps:
    """Rule `flow` on a ball; without a sample nothing is asked. On a cone the states `within` are those of the ball."""
    c = loop.c
    if c.sample is None:
        return Steps(loop, known)
    states = {name: known.names[name] for name in c.plant.states}
    within = reached_on(loop, known, at, rule) if within is None else within
    held = {name: known.names[name] for name in c.plant.inputs} | loop.anything(known)
    hi = arb(c.step)
    period = known.moving(c.sample, c.k, loop.symbols)

    def times_h(v: Model) -> Model:
        return period * v if c.varies else v.scaled(hi)

    with under(rule, at):
        tail = later(c.plant.dynamics, states, within, held, known.constant, ball.order, settled(c), times_h)
    return Steps(loop, known, ball.order, within, tail)


def reached_on(loop: Loop, known: Known, at: str, rule: str) -> dict[str, Model]:
    """The states of a whole period, each within kappa + kappa' ||d|| of where it was, or a refusal.

    For each d they have a model with these numbers: what a state moves by is a part that depends on d alone, and a part
    that is a multiple of d / ||d||. Where models have Lipschitz constants kappa' is one of what a state moves by.
    """
    c, hi = loop.c, arb(loop.c.step)
    states = [known.names[name] for name in c.plant.states]
    uncertain = loop.anything(known)
    far, turned = [ZERO] * c.n, [ZERO] * c.n
    for _ in range(ATTEMPTS):
        moved = [beyond(x, k, t) for x, k, t in zip(states, far, turned, strict=True)]
        within = dict(zip(c.plant.states, moved, strict=True))
        F = loop.field(replace(known, names={**known.names, **within}), uncertain, rule, at).components
        F = [settled(c)(f) for f in F]
        most = [arb((hi * f.size).upper()) for f in F], [arb((hi * lipschitz.on_the_ball(f)).upper()) for f in F]
        rests = [c.ends_at_origin and v.is_zero() for v in most[0]]
        stays = all(rest or v < k for rest, v, k in zip(rests, most[0], far, strict=True))
        if stays and all(v < t for v, t in zip(most[1], turned, strict=True)):
            if rule == "flow":
                ranges = [f.v + f.reach * SPREAD for f in F]
                largest = (arb(exact(c.inner) * s).sqrt() for s in inverse_diagonal(c.P, "lyapunov"))
                sizes = [x.slope.min(size) for x, size in zip(states, largest, strict=True)]
                in_domain(c, [v * SPREAD for v in sizes], swept(hi, ranges), at)
            return {name: beyond(x, k, t) for name, x, k, t in zip(c.plant.states, states, *most, strict=True)}
        far = [ZERO if rest else MORE * v + LEAST for rest, v in zip(rests, most[0], strict=True)]
        turned = [MORE * v + LEAST for v in most[1]]
    raise Refused(rule, at, "no bound of how far the state goes within a period was found")


def beyond(x: Model, far: arb, turned: arb) -> Model:
    """x within far + turned ||d||."""
    lip = None if x.lip is None else x.lip + turned
    return replace(x, off=x.off + far, slack=x.slack + turned, lip=lip)


def swept(period: arb, F: Sequence[arb]) -> list[Move]:
    """By how much the states fall and rise at most within a period, t times a mean of f_i: neither is less than 0.

    By their ends: the product of two balls also holds what would be the least t f_i if t could be negative.
    """
    return [((-period * arb(f.lower())).max(ZERO), (period * arb(f.upper())).max(ZERO)) for f in F]


def in_domain(
    c: Certificate, states: Sequence[arb], moves: Sequence[Move], at: str, free: Collection[str] = ()
) -> None:
    """The states less and plus their moves lie strictly inside; those that are `free` are not asked."""
    for x, (down, up), (lo, hi), name in zip(states, moves, c.plant.domain, c.plant.states, strict=True):
        inside = arb(x.lower()) - down > arb(lo) and arb(x.upper()) + up < arb(hi)
        require(inside or name in free, "flow", at, f"{name} is not certain to stay in the domain within a period")


# ------------------------------------------------------------------------------------------------------------ on a leaf


@dataclass(frozen=True)
class Moving:
    """The numbers of a leaf by their names, models in d, `anything` being what is uncertain without a symbol.

    `bounds` are those of the |x_i| that count, None where all do, and `free` names states whose domain is not asked.
    `varying` are the symbols of quantities and of calls, which in x_1 are those of means; `called` gives the entries of
    calls.
    """

    states: Mapping[str, Taylor]
    inputs: Mapping[str, Taylor]
    uncertain: Mapping[str, Taylor]
    anything: Mapping[str, Taylor]
    bounds: Sequence[arb] | None
    free: Collection[str]
    varying: Collection[int]
    called: Called | None


def reached_from(c: Certificate, leaf: Moving, order: int, at: str) -> dict[str, Taylor]:
    """The states of a whole period, all of them in the domain, or a refusal.

    Of the two bounds of a move the one by x_1 and x_2 is asked for only where f alone does not do.
    """
    within, moves = moved_within(c, leaf, arb(c.step), at)
    states = [x.c + (x.first + x.r) * SPREAD for x in leaf.states.values()]
    if leaf.bounds is not None:
        states = [within_both(x, w) for x, w in zip(states, leaf.bounds, strict=True)]
    try:
        in_domain(c, states, moves, at, leaf.free)
    except Refused:
        if order == 1:
            raise
        bent = [tuple(map(lesser, *each)) for each in zip(turning(c, leaf, within, at), moves, strict=True)]
        in_domain(c, states, bent, at, leaf.free)
    return within


def turning(c: Certificate, leaf: Moving, within: Mapping[str, Taylor], at: str) -> list[Move]:
    """By how much the states fall and rise at most within a period as t x_1 + t^2 x_2, x_1 where they start and x_2
    anywhere `within`: f(x, q) and, at every place of it, the next coefficient with other q."""
    held, h = {**leaf.inputs, **leaf.anything}, arb(c.step)
    with under("flow", at):
        first = c.plant.dynamics.evaluate({**leaf.states, **held}, constant, leaf.called)
        _, second = coefficients(c.plant.dynamics, within, held, constant, 2, lambda v: v)
    each = [(v, Taylor(ZERO) if w is None else w) for v, w in zip(first, second, strict=True)]
    return [(highest(-v, -w, h), highest(v, w, h)) for v, w in each]


def highest(first: Taylor, second: Taylor, h: arb) -> arb:
    """A bound of the largest a t + b t^2 over 0 <= t <= h, a and b any numbers of the models: those at their ends."""
    a, b = arb(first.bound().upper()), arb(second.bound().upper())
    if a > 0 and b < 0 and not a >= -2 * h * b:
        return a * a / (-4 * b)  # at t = -a / 2b, or farther on
    return (h * (a + h * b)).max(ZERO)


def moved_within(c: Certificate, leaf: Moving, hi: arb, at: str) -> tuple[dict[str, Taylor], list[Move]]:
    """The states until hi, and by how much each falls and rises at most, or a refusal.

    Where less than what was tried is found for all of them, that much is what they move by. Models of boxes that are
    not even bound the lesser move less well, so that it may grow without end where even boxes serve: they come second.
    """

    def within(moves: Sequence[Move]) -> dict[str, Taylor]:
        return dict(zip(c.plant.states, map(between, leaf.states.values(), moves), strict=True))

    def moves_on(states: Mapping[str, Taylor]) -> list[Move] | None:
        with under("flow", at):
            F = c.plant.dynamics.evaluate({**states, **leaf.inputs, **leaf.anything}, constant, leaf.called)
        if not all(f.is_finite() for f in F):
            return None
        return swept(hi, [arb((-(-f).bound()).lower()).union(arb(f.bound().upper())) for f in F])

    for even in (False, True):
        tried = [(ZERO, ZERO)] * c.n
        for _ in range(ATTEMPTS):
            found = moves_on(within(tried))
            if found is None:
                break
            if all(fall < a and rise < b for (fall, rise), (a, b) in zip(found, tried, strict=True)):
                return within(found), moves_on(within(found)) or found
            each = [(fall.max(rise),) * 2 for fall, rise in found] if even else found
            tried = [(MORE * fall + LEAST, MORE * rise + LEAST) for fall, rise in each]
    raise Refused("flow", at, "no bound of how far the state goes within a period was found")


def within_both(x: arb, w: arb) -> arb:
    """The part of x between -w and w; x itself if that is empty, since then no claim rests on it."""
    lo, hi = arb(x.lower()).max(-w), arb(x.upper()).min(w)
    return lo.union(hi) if lo <= hi else x


def between(x: Taylor, move: Move) -> Taylor:
    """x, or up to so much less, or more."""
    fall, rise = move
    return (x + Taylor((rise - fall) / 2)).widened((rise + fall) / 2)


def mean_on(
    c: Certificate, leaf: Moving, within: Mapping[str, Taylor], order: int, period: Taylor, at: str
) -> list[Taylor]:
    """G on a leaf, or a refusal; `period` is h, with a symbol of its own where it may be one of many."""
    start = within if order == 1 else leaf.states

    def times_h(v: Taylor) -> Taylor:
        return v.scaled(period.c) if period.g is None else period * v

    with under("flow", at):
        x_1 = c.plant.dynamics.evaluate({**start, **leaf.inputs, **leaf.uncertain}, constant, leaf.called)
        held = {**leaf.inputs, **leaf.anything}
        tail = later(c.plant.dynamics, leaf.states, within, held, constant, order, lambda v: v, times_h)
    x_1 = [f.averaged(leaf.varying) for f in x_1]
    G = [f if t is None else f + t for f, t in zip(x_1, tail, strict=True)]
    require(all(g.is_finite() for g in G), "flow", at, "the series of F has no finite model")
    return G
