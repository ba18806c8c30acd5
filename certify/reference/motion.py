"""The closed loop on boxes of states that are affine in some symbols: the policy, and models of what a step does.

A leaf of the partition has a symbol for each coordinate. A box that some steps have moved has one more for each state,
for all of it that is not affine in those of the leaf.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

from flint import arb, arb_mat, fmpq

from .affine import Form, OnBoxes, called, clip
from .balls import ZERO, beta, bounded_by_form, lies_within, total
from .document import Certificate
from .expressions import Call, Jump
from .flow import Moving, mean_on, reached_from
from .function import net_at_0
from .networks import Map
from .refusal import require, under
from .taylor import Taylor, constant


@dataclass(frozen=True)
class Input:
    """An input on a box. It lies between `ends` as well, two numbers in any order, unless there are none."""

    form: Form
    ends: tuple[arb, ...]

    @property
    def range(self) -> tuple[arb, arb]:
        """The centre and the radius of its form within the error."""
        mid, slopes, error = self.form
        return mid, total(map(abs, slopes)) + error

    @property
    def has_value(self) -> bool:
        """True if its form is finite."""
        return all(part.is_finite() for part in self.range)

    def keeps(self, lo: fmpq, hi: fmpq) -> bool:
        """True if it certainly lies in these bounds."""
        centre, radius = self.range
        return any(lies_within(pair, lo, hi) for pair in ((centre - radius, centre + radius), self.ends) if pair)


@dataclass(frozen=True)
class Stage:
    """A box that `place` names: `x` are lists [constant, coefficients of d], `u` the inputs."""

    place: str
    x: list[list[arb]]
    u: list[Input]

    def ranges(self) -> list[tuple[arb, arb]]:
        """The centre and the radius of each input's enclosure."""
        return [u.range for u in self.u]


class Motion:
    """Models in `d` symbols of the states, with one more for each input's error, uncertain quantity, entry of a call,
    and for a time: of a period that may be one of many, or within a period, in this order.

    Refusals are of the rule `rule`, where it is not `inputs` or `flow`. With a sample `free` are states whose domain is
    not asked, and of the others no |x_i| counts beyond its bound, where there are `bounds`.
    """

    rule = "ring"

    def __init__(
        self, c: Certificate, d: int, order: int, bounds: Sequence[arb] | None = None, free: Collection[str] = ()
    ) -> None:
        self.c, self.n, self.d, self.bounded = c, c.n, d, bounded_by_form(c)
        self.quantities = d + c.m
        self.calls = self.quantities + c.k
        timed = c.varies or (c.sample is not None and c.keep is not None)
        self.symbols = self.calls + c.plant.dynamics.entries + timed
        self.order, self.bounds, self.free = order, bounds, free
        self.shifts, self.offset = centred(c)

    # --------------------------------------------------------------------------------------------------- the policy

    def keep_bounds(self, at: Stage) -> None:
        """Rule `inputs`."""
        each = zip(at.u, self.c.plant.input_bounds, strict=True)
        good = all(u.has_value if self.bounded else u.keeps(*bounds) for u, bounds in each)
        require(good, "inputs", at.place, "an input is not certain to stay in its bounds, or to have a value")

    def policy(self, x: arb_mat, count: int) -> list[list[Input]]:
        """For each input and each leaf, given x on the leaves; the network reads x from its origin."""
        policy, algebra, rows = self.c.policy, OnBoxes(count), x.tolist()
        first = algebra.shifted(algebra.given(rows), map(arb, policy.origin))
        net = algebra.shifted(policy.network.run(algebra, first), self.shifts)
        taken = algebra.ranges(net)
        if policy.squash == "tanh":
            net = algebra.map(Map((), self.c.m, "tanh"), net)
        each = enumerate(zip(algebra.forms(net, range(self.c.m)), taken, strict=True))
        return [[self.input(j, *of_leaf) for of_leaf in zip(*rows, strict=True)] for j, rows in each]

    def input(self, j: int, squashed: Form, taken: tuple[arb, arb]) -> Input:
        """Input j from the squash of the network's output, and from the middle and the reach of that output.

        tanh rises: without a clip the input is between what it would be at both ends, where there is one at all.
        """
        policy, (mid, slopes, error), (middle, reach) = self.c.policy, squashed, taken
        scale, limits, offset = arb(policy.scale[j]), policy.limits(j), self.offset[j]
        u = scale * mid + offset, [scale * v for v in slopes], abs(scale) * error
        if limits is not None:
            return Input(clip(u, arb(limits[0]), arb(limits[1])), ())
        rises = policy.squash == "tanh" and mid.is_finite()
        ends = (middle - reach, middle + reach) if rises else ()
        return Input(u, tuple(scale * y.tanh() + offset for y in ends))

    # --------------------------------------------------------------------------------------------------- the models

    def numbers(self, at: Stage) -> Moving:
        """Models by their names; an input's error and what is uncertain have a symbol each."""
        plant, forms = self.c.plant, [u.form for u in at.u]
        states = {name: self.affine(row) for name, row in zip(plant.states, at.x, strict=True)}
        inputs = {
            name: self.moving(mid, slopes, self.d + j, error)
            for j, (name, (mid, slopes, error)) in enumerate(zip(plant.inputs, forms, strict=True))
        }
        uncertain, anything = dict[str, Taylor](), dict[str, Taylor]()
        for j, (name, (lo, hi)) in enumerate(zip(plant.uncertain, plant.ranges, strict=True)):
            middle, half = arb((lo + hi) / 2), arb((hi - lo) / 2)
            uncertain[name] = self.moving(middle, [ZERO] * self.d, self.quantities + j, half)
            anything[name] = Taylor(middle, r=half)
        varying = range(self.quantities, self.calls + plant.dynamics.entries)
        return Moving(states, inputs, uncertain, anything, self.bounds, self.free, varying, self.called)

    def called(self, call: Call, given: Sequence[Taylor]) -> list[Taylor]:
        return called(call, given, self.symbols, self.calls)

    def affine(self, row: list[arb]) -> Taylor:
        """A list [constant, coefficients of d]."""
        return Taylor(row[0], arb_mat(1, self.symbols, row[1:] + [ZERO] * (self.symbols - self.d)))

    def F(self, at: Stage, jump: Jump | None = None) -> list[Taylor]:
        """Models of f(x, pi(x), q), all of them finite; `jump` says which values jumps have."""
        known = self.numbers(at)
        names = {**known.states, **known.inputs, **known.uncertain}
        with under(self.rule, at.place):
            result = self.c.plant.dynamics.evaluate(names, constant, self.called, jump)
        require(all(f.is_finite() for f in result), self.rule, at.place, "F has no finite model")
        return result

    def reached(self, at: Stage) -> dict[str, Taylor]:
        """Rule `flow`: the states of a whole period."""
        return reached_from(self.c, self.numbers(at), self.order, at.place)

    def mean(self, at: Stage, within: Mapping[str, Taylor], time: Taylor) -> list[Taylor]:
        """The mean of f over so much time of a period in which the states are `within`."""
        return mean_on(self.c, self.numbers(at), within, self.order, time, at.place)

    def period(self) -> Taylor:
        return self.between(*(self.c.sample or (self.c.step, self.c.step)))

    def quarters(self) -> list[Taylor]:
        """Any time of each quarter of the longest period; each ends where the next starts, as rationals."""
        ends = [self.c.step * fmpq(k, 4) for k in range(5)]
        return [self.between(*pair) for pair in pairwise(ends)]

    def between(self, lo: fmpq, hi: fmpq) -> Taylor:
        """With the last symbol, where it may be one of many."""
        middle = arb((lo + hi) / 2)
        if lo == hi:
            return Taylor(middle)
        return self.moving(middle, [ZERO] * self.d, self.symbols - 1, arb((hi - lo) / 2))

    def moving(self, mid: arb, slopes: list[arb], symbol: int, size: arb) -> Taylor:
        """mid + slopes.d + size times a symbol of its own."""
        own = [size if i == symbol else ZERO for i in range(self.d, self.symbols)]
        return Taylor(mid, arb_mat(1, self.symbols, slopes + own))


def centred(c: Certificate) -> tuple[list[arb], list[arb]]:
    """The shift by which centring changes the network's output, and the offset with what it adds to that."""
    policy, nothing, offset = c.policy, [ZERO] * c.m, [arb(v) for v in c.policy.offset]
    if policy.centre == "none":
        return nothing, offset
    at_0 = net_at_0(c)
    if policy.centre == "preactivation":
        return [at - v for v, at in zip(at_0, beta(c), strict=True)], offset
    each = zip(policy.scale, at_0, c.plant.u_eq, strict=True)
    squashed = policy.squash == "tanh"
    return nothing, [arb(u_eq) - arb(s) * (v.tanh() if squashed else v) for s, v, u_eq in each]
