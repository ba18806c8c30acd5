"""Rule `handover`: what a practical claim leads into is where another certificate about the same loop begins."""

from __future__ import annotations

from flint import fmpq_mat

from .document import Certificate
from .fields import exact
from .rational import positive_definite
from .refusal import require

RULE = "handover"


def handover(c: Certificate) -> None:
    """Equal names, times and policy, and c0 P' < c2' P in the order of symmetric matrices."""
    then = c.then
    if then is None:
        return
    for what in ("discrete", "states", "inputs", "u_eq"):
        same = getattr(c.plant, what) == getattr(then.plant, what)
        require(same, RULE, f"then.plant.{what}", "the two certificates differ")
    require(c.sample == then.sample, RULE, "then.claim.sample", "the two certificates differ")
    for what in ("sha256", "origin"):
        same = getattr(c.policy, what) == getattr(then.policy, what)
        require(same, RULE, f"then.policy.{what}", "the two certificates differ")
    measured = [one.data.origin for one in (c, then) if one.data is not None]
    require(measured[:1] == measured[1:] or len(measured) < 2, RULE, "then.claim.data.origin", "the two differ")
    require(positive_definite(gap(c)), RULE, "then.levels", "V <= c0 does not lie in V <= c2 of what takes over")


def gap(c: Certificate) -> fmpq_mat:
    """c2' P - c0 P': where it is positive definite V' < c2' wherever 0 < V <= c0."""
    if c.then is None or c.floor is None:
        raise TypeError("this is about certificates that another takes over from")
    return exact(c.then.outer) * c.P - exact(c.floor) * c.then.P
