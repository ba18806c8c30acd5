"""The closed loop on a ball x = centre + J d, ||d|| <= 1: what is asked before anything decreases.

By the rules `local` and `tube`: the inputs within their bounds, no clip that acts, and a finite model of every
component of F.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from flint import arb, arb_mat, fmpq, fmpq_mat

from .balls import ZERO, bounded_by_form, within_bounds
from .document import Certificate, Interval
from .kinks import Cone
from .model import Model
from .refusal import require, under
from .tangents import Calls, Policy, Units


@dataclass(frozen=True)
class Field:
    """Models of the components of F on a ball, and the errors behind those of the inputs.

    F may differ from them by sum_j y_j (dv_i + da_i.d) in component i, |y_j| <= 1; `others` has dv_i and da_i, i being
    the inner index. With kinks they are models on a `cone`.
    """

    components: list[Model]
    units: Units
    others: tuple[Sequence[tuple[arb, arb_mat]], ...] = ()
    cone: Cone | None = None

    def whatever(self) -> Field:
        return replace(self, components=[f.whatever() for f in self.components])

    def where(self, y: Sequence[int]) -> Field:
        return replace(self, components=[f.where(y) for f in self.components])

    def moved_by(self, j: int) -> list[tuple[arb, arb_mat]]:
        """dv and da of y_j in each component."""
        return [(f.dv[j], f.da[j]) if f.dv else (ZERO, 0 * f.a) for f in self.components]


@dataclass(frozen=True)
class Known:
    """States and inputs on a ball, or on a `cone` of it, by their names, and the errors behind those of the inputs."""

    names: Mapping[str, Model]
    units: Units
    cone: Cone | None = None

    @property
    def errors(self) -> tuple[arb_mat, ...]:
        return max((v.errors for v in self.names.values()), key=len)

    @property
    def rhos(self) -> tuple[arb, ...]:
        return max((v.rhos for v in self.names.values()), key=len)

    def constant(self, value: fmpq) -> Model:
        """The model of a number that does not depend on d."""
        some = next(iter(self.names.values()))
        return Model.affine(arb(value), [ZERO] * some.a.nrows(), lip=None if some.lip is None else ZERO)

    def anything(self, ends: Interval) -> Model:
        """A number between two others, which may be another one at each place."""
        lo, hi = ends
        return replace(self.constant((lo + hi) / 2), off=arb((hi - lo) / 2))

    def moving(self, ends: Interval, symbol: int, symbols: int) -> Model:
        """A number between two others, with a symbol of its own."""
        lo, hi = ends
        middle, half = self.constant((lo + hi) / 2), arb((hi - lo) / 2)
        none = arb_mat(middle.a.nrows(), 1)
        return replace(middle, dv=tuple(half if i == symbol else ZERO for i in range(symbols)), da=(none,) * symbols)


class Loop:
    """F(x) = f(x, pi(x), q) of a certificate, for as many balls and cells as it has."""

    def __init__(self, c: Certificate) -> None:
        self.c, self.policy, self.bounded = c, Policy(c), bounded_by_form(c)
        self.symbols = c.k + c.varies

    def known(self, J: fmpq_mat, rule: str, at: str, centre: fmpq_mat | None = None, cone: Cone | None = None) -> Known:
        """States and inputs, or a refusal under `inputs` or under the rule that asks, at the place it names.

        Without a centre it is the origin, where the policy is u_eq, but for claims that do not ask it. J has a row for
        each state. With a cone kinks have models, which are good on the cone.
        """
        states = self.states(J, centre)
        u, units = self.inputs(states, centre is None, rule if self.bounded else "inputs", at, cone)
        bounded = self.bounded or within_bounds(self.c, [(v.v, v.radius) for v in u])
        require(bounded, "inputs", at, "an input is not certain to stay in its bounds")
        return replace(self.unclipped(states, u, units, rule, at), cone=cone)

    def states(self, J: fmpq_mat, centre: fmpq_mat | None, steady: bool = False) -> list[Model]:
        """With Lipschitz constants where these are needed, `steady`."""
        middle = [ZERO] * self.c.n if centre is None else list(arb_mat(centre).entries())
        lip = ZERO if steady else None
        return [Model.affine(v, row, lip=lip) for v, row in zip(middle, arb_mat(J).tolist(), strict=True)]

    def inputs(
        self, states: Sequence[Model], at_origin: bool, rule: str, at: str, cone: Cone | None = None
    ) -> tuple[list[Model], Units]:
        """The inputs before their clip, or a refusal where the policy has no model."""
        with under(rule, at):
            return self.policy.on(states, at_origin, cone)

    def steady(self, J: fmpq_mat, rule: str, at: str, cone: Cone | None = None) -> Known:
        """The same around the origin, with Lipschitz constants; whether inputs keep their bounds is not asked."""
        states = self.states(J, None, steady=True)
        known = self.unclipped(states, *self.inputs(states, True, rule, at, cone), rule, at)
        return replace(known, cone=cone)

    def on_cone(self, J: fmpq_mat, cone: Cone, rule: str, at: str, steady: bool = False) -> Known:
        """States and inputs around the origin on a cone, where on all of the ball more has been asked of inputs."""
        states = self.states(J, None, steady)
        u, units = self.inputs(states, True, rule, at, cone)
        return self.named(states, u, units, cone)

    def named(self, states: Sequence[Model], u: Sequence[Model], units: Units, cone: Cone | None = None) -> Known:
        plant = self.c.plant
        return Known(dict(zip(plant.states + plant.inputs, [*states, *u], strict=True)), units, cone)

    def unclipped(self, states: Sequence[Model], u: Sequence[Model], units: Units, rule: str, at: str) -> Known:
        """States and inputs, which no clip changes, or a refusal."""
        c = self.c
        for j, v in enumerate(u):
            limits = c.policy.limits(j)
            alone = limits is None or bool(v.v - v.radius > arb(limits[0]) and v.v + v.radius < arb(limits[1]))
            require(alone, rule, at, f"{c.plant.inputs[j]} is not certain to be left alone by the clip")
        return self.named(states, u, units)

    def within(self, known: Known, cell: Sequence[Interval], rule: str, at: str) -> Field:
        """Models of f that are good for every value of what is uncertain in a cell, or a refusal."""
        return self.field(known, self.varying(known, cell), rule, at)

    def field(self, known: Known, uncertain: Mapping[str, Model], rule: str, at: str) -> Field:
        """Models of f, all of them finite."""
        calls = Calls(known.units, known.errors, known.rhos, known.cone)
        with under(rule, at):
            F = self.c.plant.dynamics.evaluate({**known.names, **uncertain}, known.constant, calls)
        F = [f.among(calls.errors, calls.rhos) for f in F]
        finite = calls.units.is_finite() and all(f.is_finite() for f in F)
        require(finite, rule, at, "F has no finite model")
        return Field(F, calls.units, cone=known.cone)

    def varying(self, known: Known, cell: Sequence[Interval]) -> dict[str, Model]:
        """The uncertain quantities, each with a symbol of its own that runs through the cell."""
        return {
            name: known.moving(ends, j, self.symbols)
            for j, (name, ends) in enumerate(zip(self.c.plant.uncertain, cell, strict=True))
        }

    def anything(self, known: Known) -> dict[str, Model]:
        """The uncertain quantities by their ranges, without symbols."""
        plant = self.c.plant
        return {q: known.anything(ends) for q, ends in zip(plant.uncertain, plant.ranges, strict=True)}
