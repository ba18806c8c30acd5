"""Chapter handover: where a practical claim ends, the claim of another certificate about the same loop takes over."""

from __future__ import annotations

from typing import TYPE_CHECKING

from flint import fmpq_mat

from .case import Case, Failures, given
from .document import Certificate
from .exact import exactly, is_definite, rational

if TYPE_CHECKING:
    from .rules import Tally


def difference(c: Certificate, then: Certificate) -> fmpq_mat:
    """c2' P - c0 P', exactly; if it is positive definite, {V <= c0} lies in {V' <= c2'}.

    For then V'(x) = x'P'x < (c2'/c0) x'Px <= c2' where 0 < V(x) <= c0, and V'(0) = 0.
    """
    return rational(then.c2) * exactly(c.P) - rational(c.c0) * exactly(then.P)


def is_same_loop(case: Case) -> Failures:
    """Numbers of both mean the same, the policy is one function, and inputs are held for the same times."""
    c, then = case.c, given(case.c.then)
    for at, one, other in (
        ("plant.time", c.discrete, then.discrete),
        ("plant.states", c.states, then.states),
        ("plant.inputs", c.inputs, then.inputs),
        ("plant.u_eq", c.u_eq, then.u_eq),
        ("claim.sample", c.sample, then.sample),
        ("policy.sha256", c.policy.sha256(), then.policy.sha256()),
        ("policy.origin", _point(c), _point(then)),
    ):
        if one != other:
            yield f"then.{at}", "must be that of the certificate before"
    if c.data is not None and then.data is not None and c.data.origin != then.data.origin:
        yield "then.claim.data.origin", "must be that of the certificate before"
    return 1


def _point(c: Certificate) -> list[float] | None:
    """The point that the policy reads at x = 0; None at 0, as in the document."""
    return None if c.policy.origin is None else c.policy.origin.tolist()


def is_entered(case: Case) -> Failures:
    if not is_definite(difference(case.c, given(case.c.then))):
        yield "then.levels.roa", "{V <= c0} must lie in {V <= c2} of the certificate that takes over"
    return 1


def examine(tally: Tally, case: Case) -> None:
    tally.hold(OF_HANDOVER, case)


OF_HANDOVER = (("handover", is_same_loop), ("handover", is_entered))
