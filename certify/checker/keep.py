"""Constraints: expressions of states, inputs and uncertain quantities that have to stay negative."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from .ball import Ball
from .boxes import Boxes, Leaves
from .case import Failures
from .expression import evaluate
from .jets import Jet
from .local import Local
from .near import Array
from .taylor import Taylor, constants


def constraints(boxes: Boxes, states: list[Taylor], held: list[Taylor]) -> list[Taylor]:
    """Their models on boxes, of states, and of inputs and uncertain quantities."""
    return evaluate(boxes.c.keep, constants(held[0]), [*states, *held]) if boxes.c.keep else []


def on_boxes(
    boxes: Boxes, courses: list[list[Taylor]], held: list[Taylor], gaps: Sequence[Callable[[Array], Taylor]]
) -> Array:
    """True for each constraint and box on which it is negative at all of these states where no gap is."""
    of_all = [lambda left, gap=gap: gap(left).widened(held[0].symbols) for gap in gaps]
    models = (constraints(boxes, states, held) for states in courses)
    return np.all([[boxes.least_bound(g, of_all) < 0 for g in some] for some in models], axis=0)


def on_leaves(leaves: Leaves) -> Failures:
    """`keep`: every constraint is negative."""
    for j, hold in enumerate(leaves.kept):
        if not np.all(hold):
            yield f"{leaves.place}{leaves.numbers[np.argmin(hold)]}", f"constraint {j} may be violated"
    return int(leaves.kept.size)


def on_ball(ball: Ball, states: Sequence[Jet], quantities: Sequence[Jet]) -> Failures:
    """`keep`: every constraint is negative on the ball."""
    keep, variables = ball.case.c.keep, [*ball.shared(states), *ball.inputs, *quantities]
    made = evaluate(keep, ball.constant, variables) if keep else []
    for j, g in enumerate(made):
        if not g.range.ends[1] < 0:
            yield ball.at, f"constraint {j} may be violated"
    return len(made)


def on_local_ball(local: Local) -> Failures:
    """`keep`: they are on the ball, during a period too."""
    count = 0
    for states, quantities in local.courses():
        count += yield from on_ball(local, states, quantities)
    return count
