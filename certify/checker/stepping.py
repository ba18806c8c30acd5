"""Steps, of held inputs or in discrete time: G is the increment of x in a step of length h, over h, and
D = 2 x'P G + h G'P G."""

from __future__ import annotations

from fractions import Fraction
from functools import cached_property

import numpy as np
from flint import fmpq, fmpq_mat

from .boxes import multipliers
from .case import Case
from .decrease import Inequality, Models
from .document import Intervals
from .exact import quotient, rational, root_above
from .local import Local
from .near import Above, Array, Near, at_least_0, norm, size, triples
from .ring import Motion, Moving, Ring
from .taylor import Taylor, combination, upper_bound


class OfStep(Inequality):
    """The inequality for d'J'RJ d + 2 d'J'P G + h G'P G."""

    h: fmpq

    @cached_property
    def b(self) -> fmpq_mat:
        return self.P * (self.U + self.h * self.Y)

    def form(self) -> fmpq_mat:
        return super().form() + self.h * (self.Y.transpose() * self.P * self.Y)

    def doubts(self) -> tuple[fmpq, fmpq, fmpq]:
        """Errors of f, and slacks of a, meet each other too, and what is beyond A d."""
        (at_0, along, both), P, h, models = super().doubts(), self.P, self.h, self.models
        beyond = models.beyond
        roots = [root_above(P[i, i]) for i in range(P.nrows())]
        e, s = (
            sum((root * v for root, v in zip(roots, wrong, strict=True)), fmpq(0))
            for wrong in (models.error, models.slack)
        )
        for more in models.more:  # their parts with b_i are bounded elsewhere
            of_1, of_d = more.lengths(models, P)
            e, s = e + of_1, s + of_d
        f = fmpq_mat(len(models.f), 1, models.f) if self.first else fmpq_mat(P.nrows(), 1)
        far = beyond * (beyond + 2 * root_above((f.transpose() * P * f)[0, 0]))
        return at_0 + h * e * e, along + h * (s * s + 2 * beyond * (e + s) + far), both + h * e * s


class Stepping(Local):
    """The ball of the section `local`, from which the state moves in steps."""

    def models(self, cell: Intervals) -> Models | None:
        models = super().models(cell)
        if models is None:
            return None
        most = size_beyond(models, self.case.c.P)
        models.beyond = rational(most) if np.isfinite(most) else models.beyond
        return models if np.isfinite(most) else None

    def inequality(self, models: Models) -> Inequality:
        made, h = OfStep(models, *self.terms), self.case.c.step
        made.h = quotient(h)
        return made


def kind_of(case: Case) -> type[Local]:
    """The ball's, of a certificate whose time goes in steps."""
    if case.c.sample is None:
        return Stepping
    from .flow import Held

    return Held


def size_beyond(models: Models, P: Array) -> float:
    """Gamma: an upper bound of ||g||_P / ||d||^2, g the models less (f, A d); maybe infinite, or NaN."""
    R, E = (norm(M, (0, 1)) for M in (models.units.R, np.stack([g.remainder for g in models.G], -1)))
    c = Near(models.units.reach).through(models.shares)
    each = at_least_0((c * c.through(P)).sum())
    bent, twisted = lengths_of_forms(models, P)
    rest = (each.root * R).sum() + (size(np.diag(P)).root * E).sum()
    return float((bent + twisted + rest).top)


def lengths_of_forms(models: Models, P: Array) -> tuple[Above, Above]:
    """Upper bounds of ||(x'Q_i y)_i||_P and ||(K_i[x, y, z])_i||_P, where x, y and z are no longer than 1."""
    often, Q = triples(models.A.ncols())[-1], np.array([g.Q.value.ravel() for g in models.G])
    bent = at_least_0(form_of(Near(Q.T), Q, P))
    twisted = at_least_0(form_of(Near(models.K) * Near(often[:, None]), models.K.T, P))
    return bent.root, twisted.root


def form_of(x: Near, y: Array, P: Array) -> Near:
    """sum_ij P_ij x_i.y_j, x (N, n) and y (n, N)."""
    return (x.through(y) * Near(P)).sum().sum()


class StepRing(Ring):
    """The bounds that the rules for a leaf ask for."""

    def rise(self, states: list[Taylor], G: list[Taylor]) -> Taylor:
        """D = sum_i G_i (2 P x + h P G)_i, from above."""
        step = self.number(self.c.sample or (self.c.step,) * 2, self.symbols - 1, len(states[0].c))
        return self.product(G, [v.scaled(2.0) + step * g for v, g in zip(states, G, strict=True)])

    def bound(self, rise: Taylor, centre: Array, radius: Array, beyond: Array = None) -> Array:
        """Without a ball a step must not lead out of {V <= c0} either."""
        bound = super().bound(rise, centre, radius, beyond)
        return bound if self.case.covered else np.where(beyond, bound, self.bound_of_steps(rise, centre, radius))

    def bound_of_steps(self, rise: Taylor, centre: Array, radius: Array) -> Array:
        """Upper bound of D' + k (V - c0) on boxes for the best of some k between 0 and 1/h: where V >= c0 it bounds D',
        and where V < c0, a step does not lead out of {V <= c0}."""
        most = float(1 / self.c.step)
        most = most if Fraction(most) * self.c.step <= 1 else float(np.nextafter(most, 0.0))
        gap = self.gap(centre, radius, self.c.c0, -1.0)
        tried = multipliers(rise.g[: self.n], gap.g[: self.n], gap.c)
        bound = upper_bound(rise)
        for k in [*np.minimum(tried, most), np.full_like(bound, most)]:
            bound = np.fmin(bound, upper_bound(combination((1.0, rise), (k, gap))))
        return bound

    def hold(self, bound: Array, meet: Array, G: list[Taylor]) -> Array:
        """On leaves that cannot meet the ring a step must not lead out."""
        return bound < 0


def motion(boxes: Moving, states: list[Taylor], inputs: list[Taylor]) -> Motion:
    """G on boxes, and where the state may be until the step is done."""
    if boxes.c.sample:
        from .flow import motion

        return motion(boxes, boxes.c.sample, states, inputs, boxes.quantities(len(inputs[0].c)))
    held = [*inputs, *boxes.quantities(len(inputs[0].c))]
    return Motion([f + -x for f, x in zip(boxes.f(states, held), states, strict=True)], [states], held)
