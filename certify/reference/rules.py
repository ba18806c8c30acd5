"""All rules in their order, and the verdict on the bytes of a file."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

from flint import ctx

from . import rational
from .balls import PRECISION
from .contraction import contraction
from .document import Certificate, read
from .evidence import WITH_TUBE, Tree, Trusted
from .leaves import Leaves, check_leaves, structure
from .local import local
from .loop import Loop
from .outer import outer
from .refusal import Refused, require
from .tube import tube

MAX_PLANT = 2**26  # numbers of a model times operations of the plant
MAX_NETWORK = 2**22  # entries of the matrices of a network


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


def judge(raw: bytes) -> Verdict:
    """The verdict on a file; its hash is taken over the very bytes that are judged."""
    sha256, c, leaves = hashlib.sha256(raw).hexdigest(), None, None
    try:
        with ctx.workprec(PRECISION):
            c = read(raw)
            leaves = check(c)
    except Refused as no:
        return Verdict("REJECTED", sha256, no.rule, no.at, no.detail, c)
    if isinstance(c.evidence, Trusted):
        detail = f"the word of {c.evidence.solver} {c.evidence.version}"
        return Verdict("TRUSTED", sha256, detail=detail, certificate=c)
    return Verdict("ACCEPTED", sha256, certificate=c, leaves=leaves)


def check(c: Certificate) -> int | None:
    """Every rule in its order; the number of leaves, or None where the evidence cannot be replayed."""
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
    bearable(c, evidence)
    loop = None
    if evidence.ball is not None:
        loop = Loop(c)
        local(loop, evidence.ball, evidence.cells)
    leaves = structure(evidence.tree, range(c.n))
    if c.inner < c.outer or loop is None:  # no local ball stands in for the leaves
        check_leaves(Leaves(c, evidence.T, S), evidence)
    if c.claim in WITH_TUBE:
        if loop is None or c.start is None:
            raise Refused("format", "claim.start", "the claim needs a start")
        tube(loop, c.start, c.centre, evidence.tube)
    if evidence.contraction is not None:
        contraction(loop or Loop(c), evidence.contraction, evidence.cells)
    if c.beyond is not None:
        outer(c, evidence)
    return leaves


def bearable(c: Certificate, evidence: Tree) -> None:
    """Refuses what would fill the memory, or take days, before it is decided.

    Models on a ball are of the third order, on a leaf not. The symbols are states and the motion, on a leaf states,
    inputs, what is uncertain and a period. A series of order r has r products for each of r^2 / 2 coefficients.
    """
    ball, size = evidence.ball, c.n + (c.claim == "reached")
    balls = ball is not None or evidence.contraction is not None
    thirds = size * (size + 1) * (size + 2) // 6 if balls else 0
    order = max(evidence.order, ball.order if ball else 1)
    plant = len(c.plant.dynamics.steps) * max((c.n + c.m + c.k + c.varies) ** 2, size**2 + thirds) * order**2
    rule = "local" if ball else "contraction" if balls else "ring"
    require(plant <= MAX_PLANT, rule, "plant", "the equations are too large for this checker")
    before, network = 0, 0
    for layer in c.policy.layers:
        network += layer.rows * (layer.columns + before + size**2 + thirds)
        before += layer.rows
    require(network <= MAX_NETWORK, rule, "policy", "the network is too large for this checker")
