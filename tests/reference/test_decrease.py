"""The matrix inequality of the rules `local` and `tube`, on its own.

What it must not do: say yes where a point of the ball and remainders within their bounds make the form 0 or more. What
it should do: say yes up to the edge in cases that can be worked out by hand.
"""

from __future__ import annotations

import dataclasses
import math
from array import array
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from flint import arb, arb_mat, ctx, fmpq, fmpq_mat

from certify.reference.balls import PRECISION, certainly_definite
from certify.reference.decrease import apart, contains, cubic, decreases, joint, rest, sound_multipliers
from certify.reference.decrease import units as of_units
from certify.reference.evidence import Ball
from certify.reference.model import Model
from certify.reference.rational import positive_definite
from certify.reference.refusal import Refused
from tests.support.balls import exactly
from tests.support.marks import slow_after
from tests.support.models import curves, field, model, units

Rows = tuple[list[float], list[float], list[float]]


@pytest.fixture(autouse=True)
def precision() -> Iterator[None]:
    with ctx.workprec(PRECISION):
        yield


def ball(J: Any, alpha: Any, beta: Any, g: Any, weight: Any = None) -> Ball:
    J = np.atleast_2d(J)
    rows = (array("d", list(row)) for row in (alpha, beta, g))
    return Ball(exactly(J), *rows, exactly(np.eye(len(J)) if weight is None else weight))


def scalar(
    a: float, Q: float, E: float, rows: Rows, *, K: float = 0.0, J: float = 1.0, P: float = 1.0, R: float = 0.0
) -> bool:
    F = field([model(0.0, [a], [[Q]], [[E]], [K])])
    return decreases(ball([[J]], *rows), exactly(np.array([[P]])), exactly(np.array([[R]])), F)


# ----------------------------------------------------------------------------------------------------- definiteness


def test_definite_matrices_and_those_next_to_them() -> None:
    generator = np.random.default_rng(0)
    for n in (1, 2, 3, 7, 12):
        B = generator.standard_normal((n, n))
        A = arb_mat(exactly(B @ B.T + np.eye(n)))
        assert certainly_definite(A) and not certainly_definite(-A)
        assert positive_definite(exactly(B.T @ B + B @ B.T)) and not positive_definite(exactly(-(B @ B.T + np.eye(n))))
        least = math.nextafter(float(np.linalg.eigvalsh(B @ B.T + np.eye(n))[0]), 0)
        shift = arb_mat(n, n, [arb(0, 1.01 * least) if i == j else 0 for i in range(n) for j in range(n)])
        assert not certainly_definite(A + shift)


@pytest.mark.parametrize("entry", ["nan", "inf", "-inf", "[0 +/- inf]", "[1 +/- 1]", "0", "-1"])
@pytest.mark.parametrize("place", [0, 1, 2])
def test_a_pivot_must_be_a_positive_number(entry: str, place: int) -> None:
    A = arb_mat(3, 3, [int(i == j) for i in range(3) for j in range(3)])
    assert certainly_definite(A)
    A[place, place] = arb(entry)
    assert not certainly_definite(A)


@pytest.mark.parametrize("entry", ["nan", "inf", "[0 +/- inf]", "1", "[0.9 +/- 0.2]", "-2"])
@pytest.mark.parametrize("place", [(1, 0), (2, 0), (2, 1)])
def test_what_stands_beside_the_diagonal(entry: str, place: tuple[int, int]) -> None:
    A = arb_mat(3, 3, [int(i == j) for i in range(3) for j in range(3)])
    A[place] = A[place[::-1]] = arb(entry)
    assert not certainly_definite(A)


@pytest.mark.parametrize(
    "A", [[[0]], [[1, 1], [1, 1]], [[1, 2], [2, 1]], [[-1, 0], [0, -1]], [[1, 1], [0, 1]], [[0, 0], [0, 1]]]
)
def test_rationals_that_are_not_definite(A: Any) -> None:
    assert not positive_definite(fmpq_mat(A))
    assert positive_definite(fmpq_mat(A) * fmpq_mat(A).transpose() + fmpq_mat(np.eye(len(A), dtype=int).tolist()))


# -------------------------------------------------------------------------------------------------------- the ball


def test_the_ball_contains_what_is_strictly_inside() -> None:
    one, half = fmpq_mat([[1]]), fmpq_mat([[fmpq(1, 2)]])
    assert not contains(ball([[1.0]], [0], [1], [1]), one, one)
    assert contains(ball([[math.nextafter(1, 2)]], [0], [1], [1]), one, one)
    assert not contains(ball([[0.0]], [0], [1], [1]), one, half)
    P = exactly(np.array([[2.0, 1.0], [1.0, 1.0]]))
    singular = np.array([[1e9, 1e9], [1e9, 1e9]])
    assert not contains(ball(singular, [0, 0], [1, 1], [1, 1]), P, fmpq_mat([[1, 0], [0, 1]]))
    assert contains(ball(-np.diag([9.0, 8.0]), [0, 0], [1, 1], [1, 1]), P, fmpq_mat([[1, 0], [0, 1]]))


def test_the_ball_contains_the_ellipsoid() -> None:
    """J at random, near the edge: where the rule says yes no point of {x'Px = 1} has ||J^-1 x|| above 1."""
    generator, answers = np.random.default_rng(3), set()
    for _ in range(200):
        B = generator.standard_normal((2, 2))
        P = B @ B.T + 0.1 * np.eye(2)
        J = np.linalg.inv(np.linalg.cholesky(P)).T @ (
            np.eye(2) * generator.uniform(0.8, 1.3) + 0.1 * generator.standard_normal((2, 2))
        )
        answer = contains(ball(J, [0, 0], [1, 1], [1, 1]), exactly((P + P.T) / 2), fmpq_mat([[1, 0], [0, 1]]))
        angle = np.linspace(0, 2 * np.pi, 721)
        x = np.linalg.solve(np.linalg.cholesky(P).T, np.stack([np.cos(angle), np.sin(angle)]))
        outside = np.linalg.norm(np.linalg.solve(J, x), axis=0).max()
        assert outside < 1 + 1e-9 if answer else outside > 1 - 1e-4
        answers.add(answer)
    assert answers == {True, False}


# -------------------------------------------------------------------------------------------------------- multipliers


@pytest.mark.parametrize("row", [0, 1, 2])
@pytest.mark.parametrize("value", [-1.0, -5e-324])
def test_no_multiplier_is_negative(row: int, value: float) -> None:
    rows = [[1.0, 1.0] for _ in range(3)]
    sound_multipliers(ball(np.eye(2), *rows), "tube", "slab 7")
    rows[row][1] = value
    with pytest.raises(Refused, match="rule=tube at=slab 7"):
        sound_multipliers(ball(np.eye(2), *rows), "tube", "slab 7")


@pytest.mark.parametrize("zero", [0.0, -0.0])
def test_where_a_beta_is_0_every_g_is_positive(zero: float) -> None:
    sound_multipliers(ball(np.eye(2), [zero, zero], [1.0, 1.0], [zero, zero]), "local", "ball")
    sound_multipliers(ball(np.eye(2), [zero, zero], [zero, 1.0], [1.0, 5e-324]), "local", "ball")
    for beta, g in (([1.0, zero], [1.0, zero]), ([zero, zero], [zero, 1.0]), ([zero, zero], [zero, zero])):
        with pytest.raises(Refused, match="rule=local at=ball"):
            sound_multipliers(ball(np.eye(2), [1.0, 1.0], beta, g), "local", "ball")


def any_weight(generator: np.random.Generator, n: int) -> np.ndarray:
    """Good, indifferent, or none at all: nothing may depend on it but how tight a bound is."""
    B = generator.standard_normal((n, n))
    kinds = (np.eye(n), B @ B.T, B, np.zeros((n, n)), -np.eye(n), 1e300 * B, np.full((n, n), 5e-324))
    return kinds[generator.integers(len(kinds))]


def any_form(generator: np.random.Generator, n: int) -> tuple[list[Model], list[np.ndarray], list[np.ndarray]]:
    Q = [generator.standard_normal((n, n)) * generator.choice([0, 1, 1]) for _ in range(n)]
    Q = [A + A.T for A in Q]
    K = [generator.standard_normal(n * (n + 1) * (n + 2) // 6) * generator.choice([0, 1, 1]) for _ in range(n)]
    E = [A @ A.T * generator.choice([0, 1, 1]) for A in generator.standard_normal((n, n, n))]
    return [model(0.0, [0.0] * n, q, e, k) for q, e, k in zip(Q, E, K, strict=True)], Q, E


@pytest.mark.parametrize("n", slow_after(3, [1, 2, 3, 5]))
@pytest.mark.parametrize("kind", ["apart", "jointly", "both"])
def test_the_sums_bound_what_they_stand_for(n: int, kind: str) -> None:
    """At points of the ball, most of them on its edge, with multipliers and weights at random."""
    generator, closest = np.random.default_rng(n), np.zeros(5)
    for _ in range(40):
        F, Q, E = any_form(generator, n)
        L, R = generator.standard_normal((2, 4)), generator.standard_normal((4, n, n))
        R = np.einsum("qab,qcb->qac", R, R) * generator.choice([0, 1, 1], (4, 1, 1))
        weights_of = generator.standard_normal((n, 2)) * generator.choice([0, 1, 1], (n, 1))
        F = [dataclasses.replace(f, B=tuple(map(arb, row))) for f, row in zip(F, weights_of.tolist(), strict=True)]
        b = generator.standard_normal((n, n))  # b[i] is b_i
        columns = [arb_mat([[arb(float(v))] for v in row]) for row in b]
        alpha = np.exp(generator.standard_normal(n)) * generator.choice([0, 1], n)
        beta = np.exp(generator.standard_normal(n))
        beta *= {"apart": 1, "jointly": 0, "both": generator.choice([0, 1], n)}[kind]
        hints = ball(np.eye(n), alpha, beta, np.exp(generator.standard_normal(n)), any_weight(generator, n))
        forms = [*sums(hints, columns, F), of_units(hints, columns, F, units(L, R))]
        at_all = np.array([[float(v) for v in S.entries()] for S in forms]).reshape(-1, n, n)
        for direction in generator.standard_normal((20, n)):
            d = inside(generator, direction)
            at, along = [float(d @ A @ d) for A in at_all], b @ d
            squares = np.array([float(d @ A @ d) for A in Q])
            cubes = np.array([float(curves(f, d[:, None])[0]) for f in F]) - squares
            truth = [
                2 * np.sum(np.abs(along) * [float(d @ A @ d) for A in E]),
                abs(2 * np.sum(along[beta > 0] * squares[beta > 0])),
                abs(2 * np.sum(along[beta == 0] * squares[beta == 0])),
                abs(2 * np.sum(along * cubes)),
                2 * np.sum(np.abs(along @ weights_of @ L) * [d @ A @ d for A in R]),
            ]
            for k, (value, bound) in enumerate(zip(truth, at, strict=True)):
                assert value <= bound * (1 + 1e-9) + 1e-12
                closest[k] = max(closest[k], value / bound if bound else 0)
    joint_alone = {"apart": [0, 1, 3, 4], "jointly": [0, 2, 3, 4], "both": [0, 1, 2, 3, 4]}[kind]
    assert closest[joint_alone].min() > 0.2


@pytest.mark.parametrize("n", [1, 2, 4])
def test_the_weight_is_the_best_for_its_own_form(n: int) -> None:
    """tau makes tr(<p, T> weight) least, twice the root of p'weight p tr(T weight T')."""
    generator = np.random.default_rng(n)
    for _ in range(20):
        p, T, B = generator.standard_normal(n), generator.standard_normal((n, n)), generator.standard_normal((n, n))
        weight = B @ B.T + 0.1 * np.eye(n)
        R = T @ T.T
        columns = [arb_mat([[arb(float(v))] for v in p])] + [arb_mat(n, 1)] * (n - 1)
        flat = np.zeros((n, n))
        F = [model(0.0, [0.0] * n, flat, flat, B=[1.0]) for _ in range(n)]
        S = of_units(ball(np.eye(n), [0] * n, [1] * n, [1] * n, weight), columns, F, units([[1.0]], [R]))
        found = np.trace(np.array([float(v) for v in S.entries()]).reshape(n, n) @ weight)
        best = 2 * math.sqrt((p @ weight @ p) * np.trace(R @ weight @ R.T))
        assert abs(found / best - 1) < 1e-9


@pytest.mark.parametrize("weight", [1.0, 5e-324, 1e308, -1.0, 0.0, -0.0])
def test_no_weight_makes_a_bound_smaller_than_it_is(weight: float) -> None:
    """In one state <p, T> = tau p^2 + T^2 / tau is 2 |p T| at best."""
    for p, T in ((1.0, 1.0), (3.0, 0.5), (1e-200, 1e200), (0.25, 0.0), (0.0, 4.0)):
        F = [model(0.0, [0.0], [[0.0]], [[0.0]], B=[1.0])]
        hints, column = ball([[1.0]], [0.0], [1.0], [1.0], [[weight]]), [arb_mat([[arb(p)]])]
        S = of_units(hints, column, F, units([[1.0]], [[[T]]]))[0, 0]
        least = 2 * abs(arb(p) * arb(T))
        assert least * (1 - arb(2) ** -100) <= S and (least > 0 or S.is_zero())
        F = [model(0.0, [0.0], [[0.0]], [[0.0]], [T])]
        assert cubic(hints, column, F)[0, 0] >= least * (1 - arb(2) ** -100)


def inside(generator: np.random.Generator, direction: np.ndarray) -> np.ndarray:
    """A point of the unit ball, most often next to its edge."""
    result: np.ndarray = direction * generator.choice([1, 1, 0.5]) * (1 - 1e-12) / np.linalg.norm(direction)
    return result


def sums(hints: Ball, columns: list[arb_mat], F: list[Model]) -> list[arb_mat]:
    return [part(hints, columns, F) for part in (rest, apart, joint, cubic)]


def test_the_joint_sum_is_nothing_where_nobody_is_joint() -> None:
    F, _, _ = any_form(np.random.default_rng(1), 2)
    columns = [arb_mat([[1], [0]]), arb_mat([[0], [1]])]
    for g in ([1.0, 1.0], [0.0, 0.0], [1e300, 0.0]):
        assert joint(ball(np.eye(2), [0, 0], [1, 1], g), columns, F) == arb_mat(2, 2)


def test_errors_of_two_components_cancel_jointly_alone() -> None:
    """F = -x + k x_1^2 (1, -1), and P for which (1, -1) is short: x'PF sees a tenth of the square."""
    P, zero, flat = exactly(np.array([[1.0, 0.9], [0.9, 1.0]])), fmpq_mat(2, 2), np.zeros((2, 2))
    first, second = ([[0.75, 0], [0, 0]], [[-0.75, 0], [0, 0]])
    F = field([model(0.0, [-1, 0], first, flat), model(0.0, [0, -1], second, flat)])
    each = np.exp(np.arange(-6, 3, 0.25)).tolist()
    assert decreases(ball(np.eye(2), [0, 0], [0, 0], [0.125, 2.0**-60]), P, zero, F)
    assert not any(decreases(ball(np.eye(2), [0, 0], [v, w], [0, 0]), P, zero, F) for v in each for w in each)


# ------------------------------------------------------------------------------------------------------ the inequality

JUST = 1 + 2.0**-40


@pytest.mark.parametrize(
    ("a", "Q", "E", "rows"),
    [
        (-1.0, 0.0, 0.0, ([0.0], [2.0**-60], [0.0])),
        (-1.0, 0.0, 1 / JUST, ([0.0], [2.0**-60], [0.0])),
        (-1.0, 0.0, 1 / JUST, ([1.0], [2.0**-60], [0.0])),
        (-1.0, 1 / JUST, 0.0, ([0.0], [1.0], [0.0])),
        (-1.0, -1 / JUST, 0.0, ([0.0], [1.0], [0.0])),
        (-1.0, 1 / JUST, 0.0, ([0.0], [0.0], [1.0])),
        (-1.0, 0.5 / JUST, 0.5 / JUST, ([0.5], [0.5], [0.0])),
    ],
)
def test_the_edge_in_one_state(a: float, Q: float, E: float, rows: Rows) -> None:
    """2 d (a d + Q d^2 + r) with |r| <= E d^2, negative while |Q| + E < -a; a cube counts as its magnitude."""
    assert scalar(a, Q, E, rows)
    assert not scalar(0.0 if Q == E == 0 else a, Q * JUST**2, E * JUST**2, rows)
    assert not scalar(-a, Q, E, rows)


def test_the_edge_of_a_cube_in_one_state() -> None:
    """2 d (-d + K d^3) < 0 while K < 1; by the rule while |K| < 1."""
    rows = ([0.0], [2.0**-60], [0.0])
    for sign in (1, -1):
        assert scalar(-1.0, 0.0, 0.0, rows, K=sign / JUST) and not scalar(-1.0, 0.0, 0.0, rows, K=sign * JUST)
        assert scalar(-1.0, 0.0, 0.25, rows, K=0.75 * sign / JUST)
        assert not scalar(-1.0, 0.0, 0.25, rows, K=0.75 * sign * JUST)


@pytest.mark.parametrize("B", [1.0, -0.5])
def test_the_edge_of_an_error_of_an_input(B: float) -> None:
    """x' = -x + B e, |e| <= |L| R d^2: negative while |B L R| < 1, whatever the signs."""
    hints, one, zero = ball([[1.0]], [0.0], [2.0**-60], [0.0]), fmpq_mat([[1]]), fmpq_mat(1, 1)
    for factor, found in ((1 / JUST, True), (JUST, False)):
        for L in (0.5, -2.0):
            behind = units([[L]], [[[factor / abs(B * L)]]])
            assert decreases(hints, one, zero, field([model(0, [-1], [[0]], [[0]], B=[B])], behind)) == found


def test_errors_of_an_input_cancel_between_equations() -> None:
    """x' = -x + e, y' = -y - e with P for which (1, -1) is short: x'PF sees a tenth of e. Not so in E."""
    P, zero, flat = exactly(np.array([[1.0, 0.9], [0.9, 1.0]])), fmpq_mat(2, 2), np.zeros((2, 2))
    hints, size = ball(np.eye(2), [0, 0], [2.0**-60] * 2, [0, 0], np.diag([1.0, 9.0])), 0.6 * np.diag([1.0, 1e-9])
    together = field(
        [model(0, [-1, 0], flat, flat, B=[1]), model(0, [0, -1], flat, flat, B=[-1])], units([[1]], [size])
    )
    assert decreases(hints, P, zero, together)
    each = np.exp(np.arange(-6, 3, 0.25)).tolist()
    F = field([model(0, [-1, 0], flat, size), model(0, [0, -1], flat, size)])
    assert not any(decreases(ball(np.eye(2), [v, w], [2.0**-60] * 2, [0, 0]), P, zero, F) for v in each for w in each)


def test_the_rate_of_P_counts_with_its_sign() -> None:
    """R d^2 + 2 a d^2 < 0."""
    rows = ([0.0], [2.0**-60], [0.0])
    assert scalar(-1.0, 0.0, 0.0, rows, R=1.999) and not scalar(-1.0, 0.0, 0.0, rows, R=2.0)
    assert scalar(1.0, 0.0, 0.0, rows, R=-2.001) and not scalar(1.0, 0.0, 0.0, rows, R=-2.0)
    assert scalar(-4.0, 0.0, 0.0, rows, J=2.0, R=1.9, P=0.5) and not scalar(-4.0, 0.0, 0.0, rows, J=2.0, R=2.0, P=0.5)


@pytest.mark.parametrize("bad", ["nan", "inf", "-inf", "[0 +/- inf]"])
@pytest.mark.parametrize("part", ["a", "Q", "K", "E", "B", "L", "R"])
@pytest.mark.parametrize("rows", [([0.0], [1.0], [1.0]), ([1.0], [0.0], [1.0])])
def test_what_is_not_finite_does_not_decrease(bad: str, part: str, rows: Rows) -> None:
    one, zero = fmpq_mat([[1]]), fmpq_mat(1, 1)
    F, behind = model(0.0, [-9], [[0]], [[0]], B=[1.0]), units([[1.0]], [[[1.0]]])
    assert decreases(ball([[1.0]], *rows), one, zero, field([F], behind))
    number = arb(bad)
    if part in "aQKE":
        F = dataclasses.replace(F, **{part: arb_mat([[number]])})
    elif part == "B":
        F = dataclasses.replace(F, B=(number,))
    else:
        behind = dataclasses.replace(behind, **{part: arb_mat([[number]]) if part == "L" else [[number]]})
    assert not decreases(ball([[1.0]], *rows), one, zero, field([F], behind))


@pytest.mark.parametrize("n", slow_after(1, [1, 2, 3]))
def test_what_decreases_does_so_at_every_point(n: int) -> None:
    """Systems at random, near the edge; the remainder takes the worst sign and size that its bound allows."""
    generator, answers = np.random.default_rng(n), []
    for _ in range(150):
        size = generator.uniform(0, 1.0) / n**3
        F, Q, E = any_form(generator, n)
        Q, E = [size * A for A in Q], [size * A for A in E]
        K = [size / n * np.array([float(v) for v in f.K.entries()]) for f in F]
        inputs, L, S = (generator.standard_normal(shape) for shape in ((n, 2), (2, 3), (3, n, n)))
        S = 0.5 * size / n * np.einsum("qab,qcb->qac", S, S)
        a = -np.eye(n) + 0.3 / n * generator.standard_normal((n, n))
        J, B, R = (generator.standard_normal((n, n)) for _ in range(3))
        P, R = B @ B.T + np.eye(n), 0.2 / n * (R + R.T)
        P = (P + P.T) / 2
        J = 0.2 * J + np.linalg.inv(np.linalg.cholesky(P)).T
        a = a @ J
        alpha, beta = size * generator.choice([0, 1], n), size * generator.choice([0, 1], n)
        hints = ball(J, alpha, beta, n * size * np.ones(n), any_weight(generator, n))
        F = [model(0.0, *each) for each in zip(a, Q, E, K, inputs.tolist(), strict=True)]
        answer = decreases(hints, exactly(P), exactly(R), field(F, units(L, S)))
        answers.append(answer)
        if not answer:
            continue
        for direction in generator.standard_normal((200, n)):
            d = inside(generator, direction)
            b = P @ J @ d
            known = a @ d + np.array([curves(f, d[:, None])[0] for f in F])
            worst = np.sign(b) * np.array([d @ e @ d for e in E])
            errors = np.sign(b @ inputs @ L) * np.array([d @ each @ d for each in S])
            assert d @ J.T @ R @ J @ d + 2 * b @ (known + worst + inputs @ L @ errors) < 0
    assert 5 < sum(answers) < 145
