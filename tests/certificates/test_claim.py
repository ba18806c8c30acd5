"""Claims as values: each says which sets and levels it has, and which claims are next to it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from certify.certificates.claims import (
    CLAIMS,
    Asymptotic,
    Claim,
    Enlarged,
    Nearby,
    Outer,
    Practical,
    Reached,
)
from certify.loop.expressions import symbols
from certify.lyapunov.function import Quadratic
from certify.lyapunov.symbolic import Symbolic

W = Quadratic(np.eye(2))
EACH: list[Claim] = [
    Asymptotic(4.0, 1.0, rate=0.5),
    Practical(4.0, 1.0, 0.25, rate=0.5),
    Nearby(4.0, 1.0, 0.25, rate=0.5),
    Enlarged(4.0, 1.0, W),
    Reached(4.0, 1.0, W, (1.0, 0.0)),
]
each = pytest.mark.parametrize("claim", EACH, ids=lambda claim: claim.kind)


def test_each_kind_is_here() -> None:
    assert {claim.kind: type(claim) for claim in EACH} == CLAIMS


@each
def test_a_claim_says_what_it_has(claim: Claim) -> None:
    practical, tube = claim.kind in ("practical", "nearby"), claim.kind in ("enlarged", "reached")
    assert claim.at_rest is not practical and claim.floor == (0.25 if practical else None)
    assert list(claim.levels) == (["floor"] if practical else []) + ["local", "roa"]
    assert claim.start is (W if tube else None)
    assert claim.centre == ((1.0, 0.0) if claim.kind == "reached" else None)
    assert claim.one_equilibrium is (claim.kind == "nearby")


@each
def test_a_level_is_lowered_above_the_inner_one_only(claim: Claim) -> None:
    lower = claim.lowered(2.0)
    assert lower is not None and lower == replace(claim, roa=2.0)
    assert all(claim.lowered(level) is None for level in (0.5, 1.0, 4.0, 5.0))


@each
def test_a_floor_rises_below_the_local_level_only(claim: Claim) -> None:
    higher = claim.with_floor(0.5)
    assert (higher is None) is claim.at_rest
    assert higher is None or (type(higher), higher.floor, higher.roa) == (type(claim), 0.5, 4.0)
    assert all(claim.with_floor(floor) is None for floor in (0.1, 0.25, 1.0, 2.0))


@each
def test_what_is_left_of_the_local_set_is_asymptotic(claim: Claim) -> None:
    found = claim.local_only(0.5)
    assert found == (Asymptotic(0.5, 0.5, rate=claim.rate) if claim.at_rest else None)


@each
def test_a_tube_and_an_equilibrium_come_and_go(claim: Claim) -> None:
    """What is given up and claimed again is the same claim; nothing else changes on the way."""
    plain, free = claim.without_tube(), claim.without_equilibrium()
    assert (plain is None) is (claim.start is None) and (free is None) is not claim.one_equilibrium
    if plain is not None and claim.start is not None:
        assert type(plain) is Asymptotic and plain.with_tube(claim.start, claim.centre) == claim
    if free is not None:
        assert type(free) is Practical and free.converging() == claim
    assert (claim.with_tube(W) is None) is not claim.at_rest
    assert (claim.converging() is None) is claim.at_rest


@each
def test_an_outer_set_is_kept_until_it_is_given_up(claim: Claim) -> None:
    x = symbols("x0 x1")
    beyond = replace(claim, outer=Outer(Symbolic(x[0] ** 2 + x[1] ** 2, x), 3.0))
    assert claim.without_outer() is None and beyond.without_outer() == claim
    others = (beyond.lowered(2.0), beyond.with_floor(0.5), beyond.without_tube(), beyond.without_equilibrium())
    kept = [other for other in others if other is not None]
    assert kept and all(other.outer == beyond.outer for other in kept)
