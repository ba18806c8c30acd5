"""Errors of images that stay symbols for p steps: what both programs make of them, beside rationals and trajectories.

Of a loop x+ = M x + B q rationals know the last digit of what the format says, for every p. Of other loops each state
of a trajectory must lie in its image at the same d: what is beyond c + A d is a sum of errors times their
coefficients, so that in each direction it is at most the sum of the magnitudes that these have there.
"""

from __future__ import annotations

import json
import random
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from flint import arb, ctx

from certify.checker import document
from certify.checker.case import Case
from certify.checker.ranks import Course, Steps
from certify.reference.document import read
from certify.reference.evidence import Ranked
from certify.reference.leaves import Box
from certify.reference.ranks import Walk
from certify.reference.refusal import Refused
from tests.checker.test_rank_forgeries import is_a_lie, refuses
from tests.checker.test_rank_frames import (
    GAP,
    WIDE,
    Ends,
    Matrix,
    by_checker,
    by_reference,
    farthest,
    identity,
    inverse,
    leading,
    product,
    times,
)
from tests.checker.test_reference_ranks import PENDULUM, TANH, moved, policy, rates
from tests.support.marks import slow_after
from tests.support.rank_forgeries import Draw, Forger, edited, verdicts
from tests.support.rank_truth import Truth
from tests.support.ranked import Document, Loop, affine, dumped, encode

Array = Any
BILLIONTH = Fraction(1, 10**9)
MEMORIES = (1, 2, 5)
FOLLOWED = (3, 8, 12, 13, 15, 18, 19, 23, 25, 28, 1, 5, 7, 11, 21, 29, 30, *range(32, 42), 44, 45, 47, 48, 49, 50,
    52, 53, 54, *range(58, 67), 68, 69, 70, 71)  # fmt: skip  # those whose images are known for some steps


def exactly(rows: Sequence[Sequence[float]]) -> Matrix:
    return [[Fraction(v) for v in row] for row in rows]


@dataclass
class Linear:
    """x+ = M x + B q, the |q_k| at most 1, with a frame or none; the policy adds nothing."""

    M: Matrix
    B: Matrix
    N: list[list[float]] | None
    lo: list[float]
    hi: list[float]

    @staticmethod
    def drawn(seed: int) -> Linear:
        """Turned by the angle of 3-4-5, sheared, or anything of small rationals."""
        chance = random.Random(seed)
        n = chance.choice([1, 2, 2, 3])
        M = [[Fraction(chance.randint(-8, 8), 8) for _ in range(n)] for _ in range(n)]
        if n > 1 and seed % 3 == 0:
            M = identity(n)
            M[0][:2], M[1][:2] = [Fraction(3, 5), Fraction(-4, 5)], [Fraction(4, 5), Fraction(3, 5)]
        if n > 1 and seed % 3 == 1:
            M = [[Fraction(int(i == j) + (j == i + 1)) for j in range(n)] for i in range(n)]
        B = [[Fraction(chance.randint(-3, 3), 64) * (i == j or seed % 2) for j in range(n)] for i in range(n)]
        N = [[float(chance.randint(-4, 4)) for _ in range(n)] for _ in range(n)] if seed % 4 == 1 else None
        if N is not None and abs(np.linalg.det(N)) < 0.5:
            N = None
        lo = [chance.randint(-64, 64) / 32 for _ in range(n)]
        return Linear(M, B, N, lo, [a + chance.choice([1 / 1024, 1 / 64, 0.5]) for a in lo])

    def loop(self, memory: int | None) -> Loop:
        n = len(self.M)
        names = tuple(f"x{i}" for i in range(n))
        rows = [
            ["+", "u", *(["*", str(a), x] for a, x in zip(along, names, strict=True) if a)]
            + [["*", str(b), f"q{k}"] for k, b in enumerate(doubts) if b]
            for along, doubts in zip(self.M, self.B, strict=True)
        ]
        return Loop(
            rows, [affine([[0.0] * n])], [["-", "x0", "1"]], names, uncertain=[(f"q{k}", "-1", "1") for k in range(n)],
            domain=WIDE, frame=self.N, memory=memory,
        )  # fmt: skip

    def document(self, memory: int | None, steps: int, most: Fraction) -> Document:
        """The claim that the first state is then at most this number."""
        loop = self.loop(memory)
        loop.target = [["-", "x0", str(most)]]
        return leading(loop, self.lo, self.hi, steps)

    def ends(self, steps: int, memory: int | None = None) -> list[Ends]:
        """Where states are after each step: with a memory what the format says, else the truth, in which all errors
        keep their symbols."""
        n, N = len(self.M), identity(len(self.M)) if self.N is None else exactly(self.N)
        sides = list(zip(exactly([self.lo])[0], exactly([self.hi])[0], strict=True))
        A, errors = identity(n), [[[Fraction(0)] * n for _ in range(n)] for _ in range(memory or 0)]
        found = list[Ends]()
        for _ in range(steps):
            A, errors = product(self.M, A), [product(self.M, E) for E in errors]
            if memory is None:
                errors = [self.B, *errors]
            else:
                others = zip(product(N, errors.pop()), product(N, self.B), strict=True)
                b = [sum(map(abs, [*e, *q])) for e, q in others]
                errors = [[[v * k for v, k in zip(row, b, strict=True)] for row in inverse(N)], *errors]
            middle = [times(row, [(p + q) / 2 for p, q in sides]) for row in A]
            reach = [times(list(map(abs, row)), [(q - p) / 2 for p, q in sides]) for row in A]
            reach = [r + sum((sum(map(abs, E[i])) for E in errors), Fraction(0)) for i, r in enumerate(reach)]
            found.append([(m - r, m + r) for m, r in zip(middle, reach, strict=True)])
        return found


# ------------------------------------------------------------------------------------------------------ exact numbers


@pytest.mark.parametrize("memory", [1, 2, 3, 5, 16])
@pytest.mark.parametrize("seed", slow_after(12, range(60)))
def test_images_of_linear_loops_are_those_of_the_format(seed: int, memory: int) -> None:
    """All of the truth, and no more than rounding beyond what rationals give by the format."""
    made, count = Linear.drawn(seed), 6
    true, stated = made.ends(count), made.ends(count, memory)
    assert farthest(true, stated) >= 0
    data = leading(made.loop(memory), made.lo, made.hi, 1)
    for images in (by_checker, by_reference):
        found = images(data, made.lo, made.hi, count)
        assert len(found) == count and farthest(true, found) >= 0 and farthest(stated, found) < count * GAP


TURNED: dict[str, Matrix] = {
    "rotation": [[Fraction(3, 5), Fraction(-4, 5)], [Fraction(4, 5), Fraction(3, 5)]],
    "shear and quarter of a turn": [[Fraction(0), Fraction(-1)], [Fraction(1), Fraction(1, 2)]],
}


@pytest.mark.parametrize("memory", [None, *MEMORIES])
@pytest.mark.parametrize("name", TURNED)
def test_rotations_and_shears_are_exact_for_as_many_steps_as_are_remembered(name: str, memory: int | None) -> None:
    """With a quantity for each state, so that errors of one step are independent; later images are too large."""
    doubts, p = [[Fraction(1, 64), Fraction(0)], [Fraction(0), Fraction(1, 32)]], memory or 1
    made = Linear(TURNED[name], doubts, None, [0.5, -0.25], [0.75, -0.125])
    true, data = made.ends(p + 4), leading(made.loop(memory), made.lo, made.hi, 1)
    for images in (by_checker, by_reference):
        found = images(data, made.lo, made.hi, p + 4)
        assert farthest(true[:p], found[:p]) < p * GAP and farthest(true, found) > 1e-3


@pytest.mark.parametrize("memory", MEMORIES)
def test_coefficients_that_stay_are_bounded_with_their_rounding(memory: int) -> None:
    """q comes to the first state, a q to the next one and a^2 q to the last: single numbers, which are not rounded up,
    so that what is lost of a digit would be seen."""
    doubts = [[Fraction(int(i == j == 0)) for j in range(3)] for i in range(3)]
    for k in range(3, 16):
        M = [[Fraction(int(i == j + 1), k) for j in range(3)] for i in range(3)]
        made = Linear(M, doubts, None, [0.0] * 3, [2.0**-900] * 3)
        data, true = leading(made.loop(memory), made.lo, made.hi, 1), made.ends(3)
        for images in (by_checker, by_reference):
            assert farthest(true, images(data, made.lo, made.hi, 3)) < GAP


# ------------------------------------------------------------------------------------------------------- trajectories


@dataclass
class Image:
    """x = c + A d + B e within `slack`, as floats."""

    c: Array
    A: Array
    B: Array
    slack: Array

    def share(self, x: Array, d: Array, directions: Array) -> float:
        """The largest share of what an image allows that states (n, N) take at their d; none is above 1."""
        away = directions @ (x - self.c[:, None] - self.A @ d)
        most = np.abs(directions @ self.B).sum(1) + np.abs(directions) @ self.slack
        return float(np.max((np.abs(away) - 1e-9) / (most[:, None] + 1e-30), initial=-np.inf))


def checkers_images(data: Document, lo: list[float], hi: list[float], count: int) -> list[Image]:
    found = list[Image]()
    with np.errstate(all="ignore"):
        steps = Steps(Case(document.certificate(json.loads(dumped(data)), "0" * 64)))
        x = steps.start(np.array(lo)[:, None], np.array(hi)[:, None])
        for _ in range(count):
            x, _ = steps.step(x, np.arange(1), Course())
            c, *of_symbols = x.value[:, :, 0]
            if not np.all(np.isfinite(x.size.top)):
                break
            each = np.array(of_symbols).T
            found.append(Image(c, each[:, : len(lo)], each[:, len(lo) :], x.error.top[:, 0]))
    return found


def references_images(data: Document, lo: list[float], hi: list[float], count: int) -> list[Image]:
    def nearly(x: arb) -> float:
        return float(x.mid())

    c, found = read(dumped(data)), list[Image]()
    assert isinstance(c.evidence, Ranked)
    with ctx.workprec(64):
        walk = Walk(c, c.evidence.order, c.evidence.ranking)
        rows = walk.start(Box(0, lo, hi))
        for _ in range(count):
            try:
                (rows,) = walk.step(rows, "here", *walk.inputs([rows]))
            except Refused:
                break
            each = np.array([list(map(nearly, row)) for row in rows])
            slack = np.array([sum(float(v.rad()) for v in row) for row in rows])
            found.append(Image(each[:, 0], each[:, 1 : len(lo) + 1], each[:, len(lo) + 1 :], slack))
    return found


@pytest.mark.parametrize("memory", MEMORIES)
@pytest.mark.parametrize("seed", slow_after(10, FOLLOWED))
def test_images_hold_all_trajectories(seed: int, memory: int) -> None:
    """Of random loops, discrete and held, in a frame or none: at the same d, in every direction."""
    drawn, chance, count = Draw(seed, memory=memory), np.random.default_rng(seed), 7
    lo = chance.uniform(-1, 1, drawn.n).tolist()
    hi = [a + chance.choice([0.01, 0.1, 0.3]) for a in lo]
    data = leading(drawn.loop(), lo, hi, 1)
    truth, both = Truth(data), [images(data, lo, hi, count) for images in (checkers_images, references_images)]
    d = np.concatenate([chance.uniform(-1, 1, (drawn.n, 200)), chance.choice([-1.0, 1.0], (drawn.n, 200))], axis=1)
    x = np.array([(a + b) / 2 + (b - a) / 2 * k for a, b, k in zip(lo, hi, d, strict=True)])
    directions = np.concatenate([np.eye(drawn.n), chance.standard_normal((30, drawn.n))])
    for k in range(max(map(len, both))):
        x = truth.way(x, truth.policy(x), chance)[-1][0]
        for found in both:
            assert k >= len(found) or found[k].share(x, d, directions) <= 1
    assert min(map(len, both)) >= 3


@pytest.mark.parametrize("memory", [1, 3])
@pytest.mark.parametrize("order", [0, 1])
@pytest.mark.parametrize("frame", [None, [[1.0, 0.5], [-3.0, 2.0]]])
def test_images_hold_all_trajectories_where_equations_call_a_network(
    order: int, memory: int, frame: list[list[float]] | None
) -> None:
    """Of a state and of what is uncertain; order 0 is discrete time."""
    called: list[Any] = ["*", "1/3", ["network", "pi", 0, "y", "q"]]
    dynamics, sample = [PENDULUM[0], [*PENDULUM[1], called]], ("1/20", "1/10") if order else None
    uncertain, target = [("q", "-1/10", "1/5")], [["-", "x", "9"]]
    loop = Loop(dynamics, TANH, target, ("x", "y"), sample, 1, uncertain, frame=frame, memory=memory)
    lo, hi, chance = [0.5, -0.5], [0.6, -0.4], random.Random(order)
    data = leading(loop, lo, hi, 4)
    both = [images(data, lo, hi, 4) for images in (checkers_images, references_images)]
    assert min(map(len, both)) >= 3
    d = np.array([[chance.choice([-1.0, 1.0, chance.uniform(-1, 1)]) for _ in range(120)] for _ in lo])
    x, nearest = np.array([[0.55], [-0.45]]) + 0.05 * d, 0.0
    for k in range(max(map(len, both))):

        def q() -> float:
            return chance.choice([-0.1, 0.2])

        states = [tuple(map(float, state)) for state in x.T]
        if order:
            x = np.array([moved(*state, chance.choice([0.05, 0.1]), q, 1) for state in states]).T
        else:
            x = np.array([rates(*state, policy(*state), q(), 1) for state in states]).T
        for found in both:
            share = found[k].share(x, d, np.array([[1, 0], [0, 1], [1, 2], [1, -2]])) if k < len(found) else 0.0
            nearest = max(nearest, share)
            assert share <= 1
    assert nearest > 0.3


# ------------------------------------------------------------------------------------------------------- at the edge


def delayed(memory: int | None, delays: int) -> Loop:
    """q comes to z0, and later to x and to y at once."""
    zs = [f"z{k}" for k in range(delays)]
    last = zs[-1]
    rows = [["+", last, "u"], ["+", last, "u"], ["+", "q", "u"], *(["+", z, "u"] for z in zs[:-1])]
    names, target = ("x", "y", *zs), [["-", ["-", "x", "y"], "1/1000"]]
    return Loop(rows, [affine([[0.0] * len(names)])], target, names, uncertain=[("q", "-1", "1")], memory=memory)


@pytest.mark.parametrize("delays", [1, 2, 5])
def test_what_needs_a_memory_is_refused_with_one_step_less(delays: int) -> None:
    """x - y = 0 needs the error of z0 so many steps later; x + y is 2 at most, and that for every memory."""
    lo, hi = [0.0] * (delays + 2), [0.5] * (delays + 2)
    for memory in (delays, delays + 1):
        loop, rule = delayed(memory, delays), "ranks" if memory == delays else None
        assert verdicts(leading(loop, lo, hi, delays + 1)) == (rule, rule)
    for memory in (None, 1, delays, delays + 1):
        for bound, said in ((2 + BILLIONTH, None), (2 - BILLIONTH, "ranks")):
            loop = delayed(memory, delays)
            loop.target = [["-", ["+", "x", "y"], str(bound)]]
            assert verdicts(leading(loop, lo, hi, delays + 1)) == (said, said)


@pytest.mark.parametrize("memory", [1, 2, 5, 16])
@pytest.mark.parametrize("seed", slow_after(4, range(30)))
def test_claims_at_the_edge(seed: int, memory: int) -> None:
    """What the format gives holds by a billionth, and less does not; what is false is refused with every memory."""
    made, count = Linear.drawn(seed), 5
    _, most = made.ends(count, memory)[-1][0]
    _, true = made.ends(count)[-1][0]
    hair = BILLIONTH * max(abs(most), Fraction(1))
    assert verdicts(made.document(memory, count, most + hair)) == (None, None)
    assert verdicts(made.document(memory, count, most - hair)) == ("ranks", "ranks")
    assert verdicts(made.document(memory, count, true - hair)) == ("ranks", "ranks")


@pytest.mark.parametrize("memory", MEMORIES)
@pytest.mark.parametrize(("turned", "steps"), [(False, 2), (False, 3), (True, 2), (True, 3)])
def test_remainders_are_errors_with_all_memories(memory: int, turned: bool, steps: int) -> None:
    """p^3 is of third order; y has it, and x a step later. In the frame x + y, x - y both have a new error of 1 in each
    step, and so has x beside that which y had; with a memory of 1 the frame takes that for another two numbers."""
    rows: list[Any] = [["+", "y", "u"], ["+", ["*", "p", "p", "p"], "u"]]
    loop = Loop(rows, [affine([[0.0, 0.0]])], [], ("x", "y"), uncertain=[("p", "-1", "1")], memory=memory)
    loop.frame = [[1.0, 1.0], [1.0, -1.0]] if turned else None
    most = (steps if memory == 1 else 2) if turned else 1
    hair = 100 * BILLIONTH  # radii have 30 bits in the reference
    for bound, rule in ((1 - BILLIONTH, "ranks"), (most - BILLIONTH, "ranks"), (most + hair, None)):
        loop.target = [["-", "x", str(bound)]]
        assert verdicts(leading(loop, [0.0, 0.0], [0.5, 0.5], steps)) == (rule, rule)


@pytest.mark.parametrize("memory", [1, 3])
@pytest.mark.parametrize("speed", ["1", "-1"])
@pytest.mark.parametrize("doubt", ["q", "u", "a call"])
def test_a_period_has_a_symbol_that_nothing_else_has(doubt: str, speed: str, memory: int) -> None:
    """h (speed + doubt) is from 3/8 to 5/4 where both may be anything. With one symbol for both h speed and h doubt
    would cancel for one sign of the speed. A doubt is a range, or a clip's, of which a line is twice as far away."""
    cut = {"kind": "clip", "of": [1], "lo": encode(-0.25), "hi": encode(0.25)}
    doubts: dict[str, Any] = {"q": "q", "u": "u", "a call": ["network", "cut", 0, "y"]}
    loop = Loop(
        [["+", speed, doubts[doubt]], ["*", "0", "u"]],
        [affine([[0.0, 2.0**20]]), cut] if doubt == "u" else [affine([[0.0, 0.0]])],
        [],
        ("x", "y"),
        ("1/2", "1"),
        uncertain=[("q", "-1/4", "1/4")] if doubt == "q" else [],
        memory=memory,
    )
    sign, far = 1 if speed == "1" else -1, "-249/1000" if doubt == "q" else "1/1000"
    for along, bound, rule in (
        (sign, "1249/1000", "ranks"),
        (sign, "1251/1000" if doubt == "q" else "1501/1000", None),
        (-sign, "-376/1000", "ranks"),
        (-sign, far, None),
    ):
        loop.target = [["-", ["*", str(along), "x"], bound]]
        data = leading(loop, [-(2.0**-40), -1.0], [2.0**-40, 1.0], 1)
        data["networks"] += [{"name": "cut", "reads": 1, "steps": [affine([[2.0**20]]), cut]}] * (doubt == "a call")
        assert verdicts(data) == (rule, rule)


# ---------------------------------------------------------------------------------------------------------- forgeries

FORGED: dict[str, tuple[Any, str | None]] = {
    "1": (1, None), "16": (16, None), "0": (0, "format"), "17": (17, "format"), "-1": (-1, "format"),
    "1.5": (1.5, "format"), "1.0": (1.0, "format"), "text": ("2", "format"), "true": (True, "format"),
    "null": (None, "format"), "a list": ([2], "format"), "long": (10**9, "format"), "longer": (10**30, "format"),
}  # fmt: skip


@pytest.mark.parametrize("name", FORGED)
def test_which_memories_are_read(name: str) -> None:
    memory, rule = FORGED[name]
    made = Linear.drawn(0)
    data = edited(made.document(1, 3, Fraction(99)), "evidence.ranks.memory", memory)
    assert verdicts(data) == (rule, rule)
    apart = edited(made.document(None, 3, Fraction(99)), "claim.ranks", {"angles": [], "steps": 1000, "memory": memory})
    assert verdicts(apart) == ("format", "format")  # it is a part of the evidence


@pytest.mark.parametrize(("seed", "memory"), slow_after(2, [(s, p) for s in (19, 25, 28, 43, 53) for p in (2, 5, 16)]))
def test_random_loops_do_what_is_accepted_and_no_forgery_is(seed: int, memory: int) -> None:
    drawn = Draw(seed, (1, 1, 2), memory).ranked(depths=(5, 6, 6))
    assert len(drawn.moving) > 5 and verdicts(drawn.document) == (None, None)
    assert is_a_lie(drawn.document, 10) is None
    refused = [refuses(forgery) for forgery in Forger(drawn, seed).all()]
    assert sum(refused) > 25 and refused.count(False) < 30
