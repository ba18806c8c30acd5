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
from .model import Model
from .network import Network, Units
from .refusal import Refused, require


@dataclass(frozen=True)
class Field:
    """Models of the components of F on a ball, and the errors behind those of the inputs."""

    components: list[Model]
    units: Units

    def whatever(self) -> Field:
        return replace(self, components=[f.whatever() for f in self.components])

    def where(self, y: Sequence[int]) -> Field:
        return replace(self, components=[f.where(y) for f in self.components])


@dataclass(frozen=True)
class Known:
    """States and inputs on a ball, by their names, and the errors behind those of the inputs."""

    names: Mapping[str, Model]
    units: Units

    def constant(self, value: fmpq) -> Model:
        """The model of a number that does not depend on d."""
        some = next(iter(self.names.values()))
        return Model.affine(arb(value), [ZERO] * some.a.nrows(), some.errors, None if some.lip is None else ZERO)

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
        self.c, self.network, self.bounded = c, Network(c), bounded_by_form(c)
        self.symbols = c.k + c.varies

    def on(self, J: fmpq_mat, rule: str, at: str, centre: fmpq_mat | None = None) -> Field:
        """Models of F on a ball of a plant of which nothing is uncertain."""
        return self.within(self.known(J, rule, at, centre), (), rule, at)

    def known(self, J: fmpq_mat, rule: str, at: str, centre: fmpq_mat | None = None) -> Known:
        """States and inputs, or a refusal under `inputs` or under the rule that asks, at the place it names.

        Without a centre it is the origin, where the policy is u_eq, but for claims that do not ask it. J has a row for
        each state.
        """
        u, units = self.network.on(J, centre)
        bounded = self.bounded or within_bounds(self.c, [(v.v, v.radius) for v in u])
        require(bounded, "inputs", at, "an input is not certain to stay in its bounds")
        return self.unclipped(u, units, J, rule, at, centre)

    def steady(self, J: fmpq_mat, rule: str, at: str) -> Known:
        """The same around the origin, with Lipschitz constants; whether inputs keep their bounds is not asked."""
        return self.unclipped(*self.network.on(J, steady=True), J, rule, at)

    def unclipped(
        self, u: Sequence[Model], units: Units, J: fmpq_mat, rule: str, at: str, centre: fmpq_mat | None = None
    ) -> Known:
        """States and inputs, which no clip changes, or a refusal."""
        c = self.c
        for j, v in enumerate(u):
            limits = c.policy.limits(j)
            alone = limits is None or bool(v.v - v.radius > arb(limits[0]) and v.v + v.radius < arb(limits[1]))
            require(alone, rule, at, f"{c.plant.inputs[j]} is not certain to be left alone by the clip")
        middle = [ZERO] * c.n if centre is None else list(arb_mat(centre).entries())
        errors, lip = u[0].errors, None if u[0].lip is None else ZERO
        states = [Model.affine(v, row, errors, lip) for v, row in zip(middle, arb_mat(J).tolist(), strict=True)]
        return Known(dict(zip(c.plant.states + c.plant.inputs, [*states, *u], strict=True)), units)

    def within(self, known: Known, cell: Sequence[Interval], rule: str, at: str) -> Field:
        """Models of f that are good for every value of what is uncertain in a cell, or a refusal."""
        return self.field(known, self.varying(known, cell), rule, at)

    def field(self, known: Known, uncertain: Mapping[str, Model], rule: str, at: str) -> Field:
        """Models of f, all of them finite."""
        try:
            F = self.c.plant.dynamics.evaluate({**known.names, **uncertain}, known.constant)
        except Refused as no:
            raise Refused(rule, at, no.detail) from None
        finite = known.units.is_finite() and all(f.is_finite() for f in F)
        require(finite, rule, at, "F has no finite model")
        return Field(F, known.units)

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
