"""More uncertain quantities than have corners: the bound of the others holds at every value, in both checkers, and
claims that fail at one corner of many by little are refused."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from flint import arb, arb_mat, ctx
from numpy.typing import NDArray

from certify.checker.case import AT_CORNERS
from certify.checker.decrease import Level, Models, Multipliers
from certify.checker.exact import exactly
from certify.checker.stepping import size_beyond
from certify.provers.ball.models import AT_CORNERS as PRODUCER_S
from certify.reference import decrease as reference
from certify.reference.decrease import AT_CORNERS as REFERENCE_S
from tests.checker.test_flow import beyond, models_of, numbers, q, stepped
from tests.support.balls import with_ball
from tests.support.certificates import Document, edited, encode, grow, make, verdict
from tests.support.jets import changed, given, sides
from tests.support.marks import slow_after
from tests.support.reference import judge

Array = NDArray[np.float64]


def test_all_programs_take_as_many_corners() -> None:
    assert AT_CORNERS == PRODUCER_S == REFERENCE_S


def test_what_moves_nothing_has_no_corner() -> None:
    generator = np.random.default_rng(0)
    jets, units = stepped(generator, 2, 2, 3)
    still = [changed(jet, c_y=jet.c_y * [1, 0, 1], a_y=jet.a_y * np.array([[1], [0], [0]])) for jet in jets]
    assert len(list(models_of(np.eye(2), still, units, False).corners())) == 4  # by the third f alone moves
    assert len(list(models_of(np.eye(2), still, units, True).corners())) == 2  # at rest not even that


# ------------------------------------------------------------------------------------------ the bound, value by value


def corner_of(models: Models, P: Array, jets: list[Any], y: Array) -> Models:
    """The one of the corners that y belongs to, found by its A."""
    found, level = list(models.corners(P)), bool(models.f)
    others = [Y.tolist() for Y in found[0].more[0].parts]

    def added(j: int) -> list[Any]:
        c_y = [[jet.c_y[j] for jet in jets]] if level else []
        rows: list[Any] = exactly(np.column_stack([*c_y, np.array([jet.a_y[j] for jet in jets])])).tolist()
        return rows

    own = [j for j in range(len(y)) if added(j) not in others]
    assert len(own) == min(AT_CORNERS, len(y))
    A = np.array([jet.a + sum(y[j] * jet.a_y[j] for j in own) for jet in jets])
    near = [np.abs(numbers(corner.A) - A).max() for corner in found]
    assert min(near) < 1e-9
    return found[int(np.argmin(near))]


@pytest.mark.parametrize("n", slow_after(2, [1, 2, 3]))
@pytest.mark.parametrize("level", [False, True])
@pytest.mark.parametrize("h", slow_after(1, [0.25, 0.0, 1.0]))
def test_the_sides_hold_for_the_others_at_every_value(n: int, level: bool, h: float) -> None:
    """D + 2 lambda V + k (V - c0) at points and values of y is at most what the matrices of y's corner say."""
    generator, closest = np.random.default_rng(n + 7), np.inf
    for _ in range(6):
        count = int(generator.integers(AT_CORNERS + 1, AT_CORNERS + 4))
        jets, units = stepped(generator, n, 2, count)
        jets = [changed(jet, error=0.02 * generator.random(), slack=0.02 * generator.random()) for jet in jets]
        root, J = generator.standard_normal((2, n, n))
        P = root @ root.T + 0.1 * np.eye(n)
        rate, c0, k = 0.3, 0.5, float(generator.choice([0.0, 0.7, 2.0]))
        rows = np.exp(generator.uniform(-3, 1, (3, n))).tolist()
        W = generator.standard_normal((n, n))
        by = Multipliers(*(tuple(map(q, row)) for row in rows), W @ W.T + 0.01 * np.eye(n))
        models = models_of(J, jets, units, not level)
        most, around = size_beyond(models, P), Level(q(c0), q(k)) if level else None
        for _ in range(8):
            y = generator.choice([-1.0, 1.0], count)
            corner = corner_of(models, P, jets, y)
            R = 2 * q(rate) * exactly(P)
            decay, rest = sides(corner, exactly(P), R, by, None, q(h), q(most), around)
            left = numbers(decay - rest)
            for _ in range(25):
                d = generator.standard_normal(n)
                d /= np.linalg.norm(d) * (1 + 2.0**-40)
                d *= generator.choice([1.0, 1.0, 0.5, 0.01])
                at = [given(changed(jet, error=0.0, slack=0.0), y.tolist()) for jet in jets]
                f = np.array([jet.c for jet in at]) + np.array([jet.error for jet in jets]) * generator.choice(
                    [-1, 1], n
                )
                away = generator.standard_normal((n, n))
                away /= np.linalg.norm(away, axis=1, keepdims=True)
                a = np.array([jet.a for jet in at]) + np.array([[jet.slack] for jet in jets]) * away
                G = (f if level else 0 * f) + a @ d + beyond(jets, units, generator, d)
                x = J @ d
                V = x @ P @ x
                true = 2 * x @ P @ G + h * G @ P @ G + 2 * rate * V + (k * (V - c0) if level else 0.0)
                whole = np.append(1.0, d) if level else d
                bound = -float(whole @ left @ whole)
                assert true <= bound + 1e-9 * (1 + abs(bound))
                closest = min(closest, (bound - true) / (1 + abs(bound)))
    assert closest < 0.6


def test_the_reference_bounds_products_of_the_others() -> None:
    generator = np.random.default_rng(3)
    with ctx.workprec(120):
        for n in (1, 2, 4):
            b = [arb_mat(n, 1, list(map(arb, row))) for row in generator.standard_normal((n, n)).tolist()]
            others = [
                [arb_mat(n, 1, list(map(arb, row))) for row in (generator.standard_normal((n, n)) * s).tolist()]
                for s in (1.0, 0.01, 0.0)
            ]
            W = generator.standard_normal((n, n))
            S = reference.of_others(b, others, arb_mat((W @ W.T + 0.1 * np.eye(n)).tolist()))
            for _ in range(50):
                d = arb_mat(n, 1, list(map(arb, generator.standard_normal(n).tolist())))
                true = sum((2 * abs((p.transpose() * d)[0, 0]) * abs((a.transpose() * d)[0, 0])
                            for each in others for p, a in zip(b, each, strict=True)), arb(0))  # fmt: skip
                assert (d.transpose() * S * d)[0, 0] > true or bool((true - (d.transpose() * S * d)[0, 0]).contains(0))


# ------------------------------------------------------------------------------- plants that are false at one corner


def linear(rows: list[list[Fraction]], half: dict[tuple[int, int], Fraction], scale: Fraction, **more: Any) -> Document:
    """x' = (A + E) x + u, u = -tanh(x_1): |E_ij| <= scale half_ij, a quantity for each entry, and a few squares."""
    n = len(rows)
    x, names = [f"x{i}" for i in range(n)], {ij: f"q{ij[0]}{ij[1]}{k}" for k, ij in enumerate(half)}
    dynamics: list[Any] = []
    for i in range(n):
        terms: list[Any] = [["*", str(rows[i][j]), x[j]] for j in range(n)]
        terms += [["*", names[ij], x[ij[1] % n]] for ij in half if ij[0] == i]
        dynamics.append(["+", *terms, *(["u"] if i == 0 else [])])
    dynamics[0].append(["*", "r", "1/1000", "x0", "x0"])
    uncertain = [(names[ij], str(-scale * w), str(scale * w)) for ij, w in half.items()] + [("r", "-1", "1")]
    settings: dict[str, Any] = {
        "states": x, "domain": [("-3", "3")] * n, "input_bounds": [("-1", "1")], "centre": "none",
        "uncertain": uncertain, "cells": [1] * len(uncertain),
    }  # fmt: skip
    layer = [([[1.0] + [0.0] * (n - 1)], [0.0])]
    return make(dynamics, layer, more.pop("P"), more.pop("levels"), **settings, **more)


def drawn(seed: int) -> tuple[list[list[Fraction]], dict[tuple[int, int], Fraction], Array]:
    """A loop with P = 1 or near it, and half-widths of 7 to 9 quantities, several of which may move one entry."""
    generator = np.random.default_rng(seed)
    n = int(generator.integers(1, 4))
    part = [[Fraction(int(generator.integers(-16, 17)), 32) - (Fraction(5, 4) if i == j else 0) for j in range(n)]
            for i in range(n)]  # fmt: skip
    count, half = int(generator.integers(7, 10)), dict[tuple[int, int], Fraction]()
    for k in range(count):
        i, j = (int(v) for v in generator.integers(0, n, 2))
        half[(i, j + n * k)] = Fraction(int(generator.integers(1, 9)), 64)
    root = np.eye(n) + np.tril(generator.uniform(-0.3, 0.3, (n, n)), -1)
    return part, half, np.round(256 * root @ root.T) / 256


def edge(rows: list[list[Fraction]], half: dict[tuple[int, int], Fraction], P: Array) -> tuple[float, Array]:
    """The scale at which V stops to decrease near 0 for some values, and these, over all corners."""
    n = len(rows)
    A = np.array([[float(v) for v in row] for row in rows])
    A[0, 0] -= 1.0
    least = np.inf
    E = np.array([[[float(w) if (i, j) == (ij[0], ij[1] % n) else 0.0 for j in range(n)] for i in range(n)]
                  for ij, w in half.items()])  # fmt: skip
    L = np.linalg.inv(np.linalg.cholesky(-(P @ A + A.T @ P)))
    for y in itertools.product((-1.0, 1.0), repeat=len(half)):
        M = np.tensordot(np.array(y), E, 1)
        top = np.linalg.eigvalsh(L @ (P @ M + M.T @ P) @ L.T)[-1]
        if top > 0 and 1 / top < least:
            least = 1 / top
    return least, A


def settled(data: Document) -> Document:
    """With its ball, and a weight that suits it."""
    return grow(with_ball(data), max_leaves=300)


@pytest.mark.parametrize("program", [verdict, judge])
@pytest.mark.parametrize("seed", slow_after(1, range(30)))
def test_claims_that_fail_at_one_corner_are_refused(program: Callable[[Document], str | None], seed: int) -> None:
    rows, half, P = drawn(seed)
    A = np.array([[float(v) for v in row] for row in rows]) - np.diag([1.0, *[0.0] * (len(rows) - 1)])
    if np.linalg.eigvalsh(-(P @ A + A.T @ P))[0] <= 0.1:
        P = np.eye(len(rows))
    limit, _ = edge(rows, half, P)
    levels = (1e-6, 1e-6)
    for over in (1e-9, 1e-6, 1e-3, 0.1):
        scale = Fraction(limit) * (1 + Fraction(over))
        assert program(settled(linear(rows, half, scale, P=P, levels=levels))) == "local"
    share = next((s for s in (0.9, 0.7, 0.5, 0.3) if program(
        settled(linear(rows, half, Fraction(limit * s), P=P, levels=levels))) in (None, "ACCEPTED")), 0.0)  # fmt: skip
    assert share > 0.25


def one_state(hi: str, lo: str = "0", **more: Any) -> Document:
    """x' = (q1 + ... + q8) x + u, u = -tanh(x): V falls near 0 if the q add up to less than 1; in discrete time if they
    add up to more than 0 and less than 2."""
    terms = [["*", f"q{i}", "x"] for i in range(8)]
    uncertain = [(f"q{i}", lo, hi) for i in range(8)]
    return make([["+", *terms, "u"]], [([[1.0]], [0.0])], [[1.0]], (1e-8, 1e-8), uncertain=uncertain,
                cells=[1] * 8, centre="none", **more)  # fmt: skip


@pytest.mark.parametrize("program", [verdict, judge])
@pytest.mark.parametrize("over", slow_after(1, ["1/1000000", "1/1000", "1/10"]))
def test_in_one_state_nothing_is_lost(program: Callable[[Document], str | None], over: str) -> None:
    above, below = Fraction(1, 8) * (1 + Fraction(over)), Fraction(1, 8) * (1 - Fraction(over))
    assert program(settled(one_state(str(above)))) == "local"
    assert program(settled(one_state(str(below)))) in (None, "ACCEPTED")


@pytest.mark.parametrize("program", [verdict, judge])
@pytest.mark.parametrize("over", slow_after(1, ["1/1000000", "1/1000", "1/10"]))
def test_nor_with_a_step(program: Callable[[Document], str | None], over: str) -> None:
    for sign in (1, -1):
        hi = Fraction(1, 4) * (1 + sign * Fraction(over))
        data = settled(one_state(str(hi), "1/10", time="discrete"))
        data = edited(data, "evidence.local.multipliers", encode([0.0, 2.0**-60, 1.0]))
        assert program(data) in (("local",) if sign > 0 else (None, "ACCEPTED"))


FORGED: dict[str, Callable[[Document], Document]] = {
    "weight 0": lambda d: edited(d, "evidence.local.weight", encode([0.0])),
    "weight negative": lambda d: edited(d, "evidence.local.weight", encode([-1.0])),
    "weight huge": lambda d: edited(d, "evidence.local.weight", encode([1e300])),
    "weight tiny": lambda d: edited(d, "evidence.local.weight", encode([1e-300])),
}


@pytest.mark.parametrize("program", [verdict, judge])
@pytest.mark.parametrize("name", FORGED)
def test_no_weight_shows_what_is_false(program: Callable[[Document], str | None], name: str) -> None:
    assert program(FORGED[name](settled(one_state("1001/8000")))) == "local"


@pytest.mark.parametrize("program", [verdict, judge])
@pytest.mark.parametrize("over", ["1/1000", "1/10"])
@pytest.mark.parametrize("time", ["continuous", "discrete"])
def test_disturbances_count_around_a_level(program: Callable[[Document], str | None], over: str, time: str) -> None:
    """x' = -x + sum w_i, or a step of it, u = 0: from |x| = 8 w on V falls, and not before."""
    step = [["*", "1/2", "x"]] if time == "discrete" else [["-", "x"]]
    share = Fraction(1, 2) if time == "discrete" else Fraction(1)

    def claim(w: Fraction) -> Document:
        terms = [f"w{i}" for i in range(8)]
        uncertain = [(name, str(-w * share), str(w * share)) for name in terms]
        data = make([["+", *step, *terms, ["*", "0", "u"]]], [([[1.0]], [0.0])], [[1.0]], (0.01, 0.04, 0.04), time=time,
                    uncertain=uncertain, cells=[1] * 8, centre="none", claim="practical")  # fmt: skip
        data = with_ball(data)
        return edited(data, "evidence.local.edge", (0.05 if time == "discrete" else 0.25).hex())

    assert program(claim(Fraction(1, 80) * (1 + Fraction(over)))) == "local"
    assert program(claim(Fraction(1, 80) / 4)) in (None, "ACCEPTED")
