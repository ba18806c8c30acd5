"""The words of ranks and of constraints, which a claim of any kind may have beside its set.

They have placeholders as the words of claims do (claims.py): $name by the loop's timing, and in braces {steps}, the
most steps of a box, and {constraints}, the constraints' names.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from certify.report.words import listed, symbol

if TYPE_CHECKING:
    from certify.report.claims import Words

BOXES = "the boxes with ranks"
_IMAGES = "leaf by leaf of a partition, by a box that contains all states that a leaf's states become"
_SMOOTH_TURN = "by the equations, number by number, and the weights with which the policy reads these angles"


def with_ranks(words: Words, angles: Sequence[str]) -> Words:
    """The words of a claim with ranks; `angles` are names of states."""
    turned = listed([symbol(name) for name in angles]) if angles else ""
    place = f"; states that differ by full turns, multiples of 2π in {turned}, are the same place" if angles else ""
    inside = f"all states but {turned} are" if angles else "the state is"
    boxes = (
        "Boxes",
        "A box of rank 0 lies in {V ≤ c₂}. From every other box with a rank r, after its number k of steps, every "
        "trajectory is in {V ≤ c₂} or in boxes of rank r − k at most; before each of these steps the closed loop is "
        f"defined, the input keeps its bounds and {inside} strictly inside the domain$meanwhile{place}",
        _IMAGES,
    )
    periodic = (
        "Angles",
        f"After a full turn of {turned} the closed loop is the same, and so are the input and all constraints",
        _SMOOTH_TURN,
    )
    return replace(
        words,
        statement=words.statement + " Moreover every trajectory that starts in one of the certificate's boxes with "
        "ranks$begins is in {{V(x) ≤ {outer}}} after {steps} $steps at the latest, and from then on behaves as just "
        f"stated; until then {inside} inside the domain{place}.",
        headline=words.headline + "; from the boxes with ranks {{V <= {outer}}} is reached after {steps} $steps at the "
        "latest",
        parts=(*words.parts, boxes, *((periodic,) if angles else ())),
        excluded=(*words.excluded[:-1], *_not_ranked(turned), words.excluded[-1]),
        sets=f"{words.sets} and {BOXES}",
    )


def _not_ranked(turned: str) -> tuple[tuple[str, str], ...]:
    """The gaps of a claim with ranks."""
    found = (
        (
            "Boxes without a rank.",
            "Of their states nothing is said: they may reach {V ≤ c₂} too, or not.",
        ),
        (
            "The way to {V ≤ c₂}.",
            "On the way from a box V may rise, and the trajectory may pass states of which nothing is proved, within "
            "the domain. The numbers of $steps are bounds: most trajectories need fewer.",
        ),
    )
    turns = (
        "The number of turns.",
        f"Full turns of {turned} are not counted: a trajectory may turn over on its way, and ends at the place, not at "
        "the number.",
    )
    return (*found, turns) if turned else found


def with_constraints(words: Words, *, ranked: bool, beyond: bool) -> Words:
    """The words of a claim with constraints; it may have ranks too, or a set `beyond` {V <= c2}."""
    where = "for all x with V(x) ≤ c₂" + (" and all x of the outer set" if beyond else "")
    where += " and all x in an ellipsoid of the tube" if words.start else ""
    where += ", and before each step from a box with a rank" if ranked else ""
    part = ("Constraints", f"Each of the constraints above, g(x, π(x)) < 0, holds {where}$meanwhile", _ON_ALL)
    other = (
        "Other constraints.",
        "Only the inequalities named are kept, by the policy's exact input. That nothing else breaks, and with how "
        "much room they hold, is not part of the claim.",
    )
    return replace(
        words,
        statement=words.statement
        + " Along each of these trajectories the constraints hold $always_kept: {constraints}.",
        headline=words.headline + "; kept on the way: {constraints}",
        simulated=words.simulated.replace("domain", "domain, keep the constraints", 1),
        parts=(*words.parts, part),
        excluded=(*words.excluded[:-1], other, words.excluded[-1]),
    )


_ON_ALL = "on the ball and on every leaf on which anything else is shown"
