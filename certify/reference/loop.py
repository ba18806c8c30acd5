"""The closed loop on a ball x = centre + J d, ||d|| <= 1: what is asked before anything decreases.

By the rules `local` and `tube`: the inputs within their bounds, no clip that acts, and a finite model of every
component of F.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from flint import arb, arb_mat, fmpq_mat

from .balls import ZERO, bounded_by_form, finite, spanning, within_bounds
from .document import Certificate, Interval
from .model import Model
from .network import Network
from .refusal import Refused, require


class Loop:
    """F(x) = f(x, pi(x), q) of a certificate, for as many balls and cells as it has."""

    def __init__(self, c: Certificate) -> None:
        self.c, self.network, self.bounded = c, Network(c), bounded_by_form(c)

    def on(self, J: fmpq_mat, rule: str, at: str, centre: fmpq_mat | None = None) -> list[Model]:
        """Models of F on a ball of a plant of which nothing is uncertain."""
        return self.within(self.known(J, rule, at, centre), (), rule, at)

    def known(self, J: fmpq_mat, rule: str, at: str, centre: fmpq_mat | None = None) -> dict[str, Model]:
        """States and inputs by their names, or a refusal under `inputs` or under the rule that asks, at the place.

        Without a centre it is the origin, where pi(0) = u_eq exactly. J has a row for each state.
        """
        c = self.c
        u = self.network.on(J, centre)
        bounded = self.bounded or within_bounds(c, [(v.v, v.radius) for v in u])
        require(bounded, "inputs", at, "an input is not certain to stay in its bounds")
        for j, v in enumerate(u):
            limits = c.policy.limits(j)
            alone = limits is None or bool(v.v - v.radius > arb(limits[0]) and v.v + v.radius < arb(limits[1]))
            require(alone, rule, at, f"{c.plant.inputs[j]} is not certain to be left alone by the clip")
        middle = [ZERO] * c.n if centre is None else list(arb_mat(centre).entries())
        states = [Model.affine(v, row) for v, row in zip(middle, arb_mat(J).tolist(), strict=True)]
        return dict(zip(c.plant.states + c.plant.inputs, [*states, *u], strict=True))

    def within(self, known: Mapping[str, Model], cell: Sequence[Interval], rule: str, at: str) -> list[Model]:
        """Models of F that are good for every value of what is uncertain in a cell, or a refusal.

        What is uncertain does not depend on d. Its value is a ball with the cell in it, and so each number of a model
        is a ball with all that it can be.
        """
        plant, size = self.c.plant, next(iter(known.values())).a.nrows()

        def constant(value: arb) -> Model:
            return Model.affine(value, [ZERO] * size)

        uncertain = {q: constant(spanning(ends)) for q, ends in zip(plant.uncertain, cell, strict=True)}
        try:
            F = plant.dynamics.evaluate({**known, **uncertain}, lambda q: constant(arb(q)))
        except Refused as no:
            raise Refused(rule, at, no.detail) from None
        finitely = all(finite([f.v, *f.a.entries(), *f.Q.entries(), *f.E.entries()]) for f in F)
        require(finitely, rule, at, "F has no finite model")
        return F
