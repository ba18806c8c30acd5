"""Rule `keep`: expressions in states, inputs and uncertain quantities that are negative wherever the loop is.

That is in {V <= c2} by its ball and its leaves, in a second function's set by the leaves of its tree on which states
may be beyond {V <= c2}, and in a tube by the ball of each slab, for no ellipsoid between two nodes leaves it.

With a sample they are so at all times of a period, in which the inputs are held, and what is uncertain may be any
number of its range at each place. On a box the state after a time s is x + s G, G the mean of f until then. The
coefficients of G up to the last are those at x, and the last is taken at all states of the longest period: so it holds
for every s. Each quarter of the longest period has a model of its own. A ball has all of those states at once.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from .document import Interval
from .flow import Steps
from .model import Model
from .motion import Motion, Stage
from .refusal import require, under
from .taylor import Taylor, constant, is_negative

RULE = "keep"


def kept(motion: Motion, at: Stage, within: Mapping[str, Taylor] | None, slacks: Sequence[Taylor]) -> None:
    """The rule on a box, or where on it each of some slacks is not negative at the start of a period.

    With a sample `within` are the states of the whole period.
    """
    expressions = motion.c.keep
    if expressions is None:
        return
    for names in moments(motion, at, within):
        with under(RULE, at.place):
            values: list[Taylor] = expressions.evaluate(names, constant)
        for i, g in enumerate(values):
            holds = g.is_finite() and is_negative(g, slacks)
            require(holds, RULE, at.place, f"expression {i} is not certain to be negative")


def moments(motion: Motion, at: Stage, within: Mapping[str, Taylor] | None) -> Iterator[Mapping[str, Taylor]]:
    """All numbers by their names: those on the box, or with a sample those in each quarter of the period."""
    known = motion.numbers(at)
    names = {**known.states, **known.inputs, **known.uncertain}
    if within is None:
        yield names
        return
    for s in motion.quarters():
        moved = zip(known.states.items(), motion.mean(at, within, s), strict=True)
        yield {**names, **known.anything, **{name: x + s * g for (name, x), g in moved}}


def kept_on_ball(steps: Steps, cells: Iterable[Sequence[Interval]], at: str) -> None:
    """The rule on a ball, for each cell of what is uncertain."""
    loop, known = steps.loop, steps.known
    if steps.within is not None:
        negative_on_ball(steps, {**known.names, **steps.within, **loop.anything(known)}, at)
        return
    for cell in cells:
        negative_on_ball(steps, {**known.names, **loop.varying(known, cell)}, at)


def negative_on_ball(steps: Steps, names: Mapping[str, Any], at: str) -> None:
    expressions = steps.loop.c.keep
    if expressions is None:
        return
    with under(RULE, at):
        values: list[Model] = expressions.evaluate(names, steps.known.constant)
    for i, g in enumerate(values):
        holds = g.is_finite() and bool(g.v + g.reach < 0)
        require(holds, RULE, at, f"expression {i} is not certain to be negative")
