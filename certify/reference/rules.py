"""All rules in their order, and the verdict on the bytes of a file."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

from flint import ctx

from . import rational
from .balls import ON_LEAVES, PRECISION
from .contraction import contraction
from .data import data
from .document import Certificate, read
from .evidence import WITH_TUBE, Covering, Ranked, Tree, Trusted
from .handover import handover
from .invariant import invariant
from .leaves import Leaves, check_leaves, structure
from .local import local
from .loop import Loop
from .outer import outer
from .periodic import angles
from .ranks import ranks
from .refusal import Refused
from .samples import samples
from .tube import tube


@dataclass(frozen=True)
class Verdict:
    """`result` is ACCEPTED, REJECTED (with rule, at and detail) or TRUSTED (with detail)."""

    result: str
    certificate_sha256: str
    rule: str | None = None
    at: str | None = None
    detail: str | None = None
    certificate: Certificate | None = None
    leaves: int | None = None


def judge(raw: bytes, jobs: int = 1) -> Verdict:
    """The verdict on a file; so many processes examine its leaves. Its hash is taken over the very bytes."""
    sha256, c, leaves = hashlib.sha256(raw).hexdigest(), None, None
    try:
        with ctx.workprec(PRECISION):
            c = read(raw)
            leaves = check(c, jobs)
            if c.then is not None:
                check_after(c.then, jobs)
    except Refused as no:
        return Verdict("REJECTED", sha256, no.rule, no.at, no.detail, c)
    if isinstance(c.evidence, Trusted):
        detail = f"the word of {c.evidence.solver} {c.evidence.version}"
        return Verdict("TRUSTED", sha256, detail=detail, certificate=c)
    return Verdict("ACCEPTED", sha256, certificate=c, leaves=leaves)


def check_after(c: Certificate, jobs: int) -> None:
    """Every rule for the certificate that takes over."""
    try:
        check(c, jobs)
    except Refused as no:
        raise Refused(no.rule, f"then.{no.at}", no.detail) from None


def check(c: Certificate, jobs: int) -> int | None:
    """Every rule in its order; the number of leaves, or None where the evidence cannot be replayed."""
    if isinstance(c.evidence, Ranked):
        rational.centring(c)
        return with_ranks(c, c.evidence, jobs)
    if isinstance(c.evidence, Covering):
        rational.centring(c)
        with ctx.workprec(ON_LEAVES):
            return invariant(c, c.evidence, jobs)
    rational.levels(c)
    inverse = rational.inverse_diagonal(c.P, "lyapunov")
    if c.ends_at_origin:
        rational.equilibrium(c)
    rational.domain(c, inverse)
    evidence = c.evidence
    if isinstance(evidence, Trusted):
        rational.centring(c)
        return None
    S, inverse = rational.coordinates(c, evidence)
    rational.root(c, evidence, inverse)
    rational.centring(c)
    handover(c)
    if evidence.fit is not None:
        with ctx.workprec(ON_LEAVES):
            data(c, evidence.fit)
    samples(c)
    loop = None
    if evidence.ball is not None:
        loop = Loop(c)
        local(loop, evidence.ball, evidence.cells)
    leaves = structure(evidence.tree, range(c.n))
    if c.inner < c.outer or loop is None:  # no local ball stands in for the leaves
        with ctx.workprec(ON_LEAVES):
            check_leaves(Leaves(c, evidence.T, S), evidence, jobs)
    if c.claim in WITH_TUBE:
        if loop is None or c.start is None:
            raise Refused("format", "claim.start", "the claim needs a start")
        tube(loop, c.start, c.centre, evidence)
    if evidence.contraction is not None:
        contraction(loop or Loop(c), evidence.contraction, evidence.cells)
    if c.beyond is not None:
        with ctx.workprec(ON_LEAVES):
            outer(c, evidence, jobs)
    if evidence.ranking is not None:
        with_ranks(c, evidence, jobs)
    return leaves


def with_ranks(c: Certificate, evidence: Tree | Ranked, jobs: int) -> int:
    """Rules `angles` and `ranks`; the number of leaves that have a rank."""
    angles(c)
    with ctx.workprec(ON_LEAVES):
        return ranks(c, evidence, jobs)
