"""The closed loop on a ball x = centre + J d, ||d|| <= 1: what is asked before anything decreases.

By the rules `local` and `tube`: the inputs within their bounds, no clip that acts, and a finite model of every
component of F.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from flint import arb, arb_mat, fmpq_mat

from .balls import ZERO, bounded_by_form, spanning, within_bounds
from .document import Certificate, Interval
from .model import Model
from .network import Network, Units
from .refusal import Refused, require


@dataclass(frozen=True)
class Field:
    """Models of the components of F on a ball, and the errors behind those of the inputs."""

    components: list[Model]
    units: Units


@dataclass(frozen=True)
class Known:
    """States and inputs on a ball, by their names, and the errors behind those of the inputs."""

    names: Mapping[str, Model]
    units: Units


class Loop:
    """F(x) = f(x, pi(x), q) of a certificate, for as many balls and cells as it has."""

    def __init__(self, c: Certificate) -> None:
        self.c, self.network, self.bounded = c, Network(c), bounded_by_form(c)

    def on(self, J: fmpq_mat, rule: str, at: str, centre: fmpq_mat | None = None) -> Field:
        """Models of F on a ball of a plant of which nothing is uncertain."""
        return self.within(self.known(J, rule, at, centre), (), rule, at)

    def known(self, J: fmpq_mat, rule: str, at: str, centre: fmpq_mat | None = None) -> Known:
        """States and inputs, or a refusal under `inputs` or under the rule that asks, at the place it names.

        Without a centre it is the origin, where pi(0) = u_eq exactly. J has a row for each state.
        """
        c, (u, units) = self.c, self.network.on(J, centre)
        bounded = self.bounded or within_bounds(c, [(v.v, v.radius) for v in u])
        require(bounded, "inputs", at, "an input is not certain to stay in its bounds")
        for j, v in enumerate(u):
            limits = c.policy.limits(j)
            alone = limits is None or bool(v.v - v.radius > arb(limits[0]) and v.v + v.radius < arb(limits[1]))
            require(alone, rule, at, f"{c.plant.inputs[j]} is not certain to be left alone by the clip")
        middle = [ZERO] * c.n if centre is None else list(arb_mat(centre).entries())
        errors = u[0].errors
        states = [Model.affine(v, row, errors) for v, row in zip(middle, arb_mat(J).tolist(), strict=True)]
        return Known(dict(zip(c.plant.states + c.plant.inputs, [*states, *u], strict=True)), units)

    def within(self, known: Known, cell: Sequence[Interval], rule: str, at: str) -> Field:
        """Models of F that are good for every value of what is uncertain in a cell, or a refusal.

        What is uncertain does not depend on d. Its value is a ball with the cell in it, and so each number of a model
        is a ball with all that it can be.
        """
        plant, some = self.c.plant, next(iter(known.names.values()))

        def constant(value: arb) -> Model:
            return Model.affine(value, [ZERO] * some.a.nrows(), some.errors)

        uncertain = {q: constant(spanning(ends)) for q, ends in zip(plant.uncertain, cell, strict=True)}
        try:
            F = plant.dynamics.evaluate({**known.names, **uncertain}, lambda q: constant(arb(q)))
        except Refused as no:
            raise Refused(rule, at, no.detail) from None
        finite = known.units.is_finite() and all(f.is_finite() for f in F)
        require(finite, rule, at, "F has no finite model")
        return Field(F, known.units)
