"""The matrix inequality of the rules `local` and `tube` in the checker, in rationals and without any tolerance.

What it says of points is formed exactly: a model's gradient anywhere within its slack, a remainder of the worst sign
and size, d a rational point of the unit ball. The reference's own sums say what the numbers must be.
"""

from __future__ import annotations

import math
from array import array
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from flint import arb, arb_mat, ctx, fmpq, fmpq_mat

from certify.checker.decrease import Multipliers, are_finite, are_usable
from certify.checker.exact import exactly
from certify.reference import decrease as reference
from certify.reference.evidence import Ball
from certify.reference.model import Model
from tests.support.jets import Jet, models_of, no_units, plain, shows, sides
from tests.support.marks import slow_after

Generator = np.random.Generator
Rows = tuple[list[float], list[float], list[float]]
JUST = 1 + 2.0**-40
UNITS = [(1, 0, 0), (0, -1, 0), ("3/5", "4/5", 0), ("2/3", "-2/3", "1/3"), (0, 0, 0)]  # none is longer than 1


def quotient(v: Any) -> fmpq:
    if isinstance(v, str):
        return fmpq(*map(int, v.split("/")))
    return fmpq(*float(v).as_integer_ratio())


def by(*rows: Any) -> Multipliers:
    return Multipliers(*(tuple(quotient(v) for v in row) for row in rows), np.eye(len(rows[0])))


def jet(a: Any, slack: float, Q: Any, E: Any) -> Jet:
    return plain(np.float64(0), 0.0, np.array(a, float), slack, np.array(Q, float), np.array(E, float))


def random_jets(generator: Generator, n: int, size: float) -> list[Jet]:
    """E is semidefinite exactly: B B' of whole numbers times a power of two."""
    result = []
    for _ in range(n):
        B, half = generator.integers(-3, 4, (n, n)), generator.integers(-9, 10, (n, n))
        unit = 2.0 ** np.floor(np.log2(size)) / 16
        Q, E = (half + half.T) * unit * generator.choice([0, 1, 1]), B @ B.T * unit * generator.choice([0, 1, 1])
        result.append(jet(generator.standard_normal(n), float(generator.choice([0, 2.0**-6, 2.0**-30])), Q, E))
    return result


def random_multipliers(generator: Generator, n: int, kind: str) -> Multipliers:
    alpha = np.exp(generator.standard_normal(n)) * generator.choice([0, 1], n)
    beta = np.exp(generator.standard_normal(n)) * {"apart": 1, "jointly": 0, "both": generator.choice([0, 1], n)}[kind]
    g = np.exp(generator.standard_normal(n)) if 0 in beta else generator.choice([0.0, 1.0], n)
    return by(alpha, beta, g)


def inside(generator: Generator, n: int) -> list[fmpq]:
    """A point of the unit ball, most often next to its edge."""
    direction = generator.standard_normal(n)
    direction *= generator.choice([1, 1, 0.5, 1e-30]) / np.linalg.norm(direction)
    d = [quotient(v * (1 - 2.0**-50)) for v in direction.tolist()]
    assert sum((v * v for v in d), fmpq(0)) <= 1
    return d


def form(A: fmpq_mat, d: list[fmpq]) -> fmpq:
    column = fmpq_mat(len(d), 1, d)
    return (column.transpose() * A * column)[0, 0]


def dot(p: list[fmpq], q: list[fmpq]) -> fmpq:
    return sum((v * w for v, w in zip(p, q, strict=True)), fmpq(0))


def worst(J: fmpq_mat, P: fmpq_mat, R: fmpq_mat, F: list[Jet], d: list[fmpq], unit: list[fmpq]) -> fmpq:
    """d'J'RJ d + 2 d'J'P F, each gradient off by its slack times a vector of length 1 at most, each r = d'E d."""
    n, value = len(d), form(J.transpose() * R * J, d)
    b = P * J
    for i, f in enumerate(F):
        along = dot([b[i, j] for j in range(n)], d)
        off = quotient(f.slack) * dot(unit, d)
        rest = abs(off) + form(exactly(f.E), d)
        value += 2 * along * (dot([quotient(v) for v in f.a], d) + form(exactly(f.Q), d)) + 2 * abs(along) * rest
    return value


def symmetric(generator: Generator, n: int) -> np.ndarray:
    A = generator.integers(-8, 9, (n, n)) / 8
    return A + A.T


@pytest.mark.parametrize("n", slow_after(2, [1, 2, 3]))
@pytest.mark.parametrize("kind", ["apart", "jointly", "both"])
def test_the_sides_bound_what_they_stand_for(n: int, kind: str) -> None:
    """P and R are symmetric and otherwise arbitrary; J need not have an inverse."""
    generator, closest = np.random.default_rng(n), 0.0
    for _ in range(60):
        F = random_jets(generator, n, float(np.exp(generator.uniform(-6, 2))))
        J, P, R = generator.standard_normal((n, n)), symmetric(generator, n), symmetric(generator, n)
        J, P, R = exactly(J), exactly(P), exactly(R)
        exact = np.array([[float(int(v.p)) / int(v.q) for v in row] for row in J.tolist()])
        decay, rest = sides(models_of(exact, F, no_units(n), True), P, R, random_multipliers(generator, n, kind))
        assert decay == decay.transpose() and rest == rest.transpose()
        for _ in range(12):
            d, unit = inside(generator, n), [quotient(v) for v in UNITS[generator.integers(len(UNITS))][:n]]
            left, bound = worst(J, P, R, F, d, unit) + form(decay, d), form(rest, d)
            assert left <= bound
            closest = max(closest, float(int((left / bound).p)) / int((left / bound).q) if bound else 0.0)
    assert closest > 0.5


@pytest.mark.parametrize("n", [1, 2, 3])
def test_what_is_shown_is_so(n: int) -> None:
    """Systems at random near the edge: nothing that is shown fails at a point, and a good share is shown."""
    generator, answers = np.random.default_rng(n + 50), []
    for _ in range(80):
        size = float(generator.uniform(0.1, 6)) / n**2
        F = random_jets(generator, n, size)
        J = np.eye(n) + 0.1 * generator.standard_normal((n, n))
        near = -np.eye(n) + 0.2 / n * generator.standard_normal((n, n))
        F = [jet(row, f.slack, f.Q, f.E) for row, f in zip(near @ J, F, strict=True)]
        B = generator.integers(-2, 3, (n, n)) / 8
        P, R = exactly(np.eye(n) + B @ B.T), exactly(symmetric(generator, n) / 16)
        hints = by(
            *([float(v) for v in size / 4 * generator.choice([0, 1, 1], n)] for _ in range(2)), [n * size / 4] * n
        )
        answers.append(shows(models_of(J, F, no_units(n), True), P, R, hints))
        for _ in range(20 if answers[-1] else 0):
            d, unit = inside(generator, n), [quotient(v) for v in UNITS[generator.integers(len(UNITS))][:n]]
            assert worst(exactly(J), P, R, F, d, unit) < 0
    assert 5 < sum(answers) < 75


@pytest.mark.parametrize("n", [1, 2, 4])
@pytest.mark.parametrize("kind", ["apart", "jointly", "both"])
def test_the_sums_are_those_of_the_reference(n: int, kind: str) -> None:
    """Entry by entry, but for roots from above; the slack, of which the reference knows nothing, comes on top."""
    generator = np.random.default_rng(n + 70)
    for _ in range(20):
        F, hints = random_jets(generator, n, 1.0), random_multipliers(generator, n, kind)
        J, P, R = generator.standard_normal((n, n)), symmetric(generator, n), symmetric(generator, n)
        decay, rest = sides(models_of(J, F, no_units(n), True), exactly(P), exactly(R), hints)
        with ctx.workprec(300):
            rows = [array("d", [float(int(v.p)) / int(v.q) for v in row]) for row in
                    (hints.rest, hints.apart, hints.joint)]  # fmt: skip
            b = arb_mat(exactly(J).transpose() * exactly(P))
            columns = [arb_mat(n, 1, column) for column in b.transpose().tolist()]
            models = [
                replace(
                    Model.affine(arb(0), [arb(v) for v in f.a.tolist()]),
                    Q=arb_mat(exactly(f.Q)),
                    E=arb_mat(exactly(f.E)),
                )
                for f in F
            ]
            ball = Ball(exactly(J), *rows, exactly(np.eye(n)))
            sums = [part(ball, columns, models) for part in (reference.rest, reference.apart, reference.joint)]
            lengths = [sum((v * v for v in column.entries()), arb(0)).sqrt() for column in columns]
            wrong = sum((2 * length * arb(f.slack) for length, f in zip(lengths, F, strict=True)), arb(0))
            more = arb_mat(n, n, [wrong if i == j else arb(0) for i in range(n) for j in range(n)])
            theirs = sum(sums, more)
            for mine, value in zip(arb_mat(rest).entries(), theirs.entries(), strict=True):
                assert abs(mine - value) <= arb(2) ** -55 * (1 + abs(value) + wrong)
            B = b * arb_mat([list(f.a.entries()) for f in models])
            linear = -(arb_mat(exactly(J).transpose() * exactly(R) * exactly(J)) + B + B.transpose())
            assert all((p - q).contains(0) for p, q in zip(arb_mat(decay).entries(), linear.entries(), strict=True))


def scalar(
    a: float, slack: float, Q: float, E: float, rows: Rows, *, J: float = 1.0, P: float = 1.0, R: float = 0.0
) -> bool:
    one = [jet([a], slack, [[Q]], [[E]])]
    return shows(
        models_of(np.array([[J]]), one, no_units(1), True),
        exactly(np.array([[P]])),
        exactly(np.array([[R]])),
        by(*rows),
    )


@pytest.mark.parametrize(
    ("slack", "Q", "E", "rows"),
    [
        (0.0, 0.0, 1 / JUST, ([0.0], [2.0**-60], [0.0])),
        (0.0, 0.0, 1 / JUST, ([1.0], [2.0**-60], [0.0])),
        (0.0, 1 / JUST, 0.0, ([0.0], [1.0], [0.0])),
        (0.0, -1 / JUST, 0.0, ([0.0], [1.0], [0.0])),
        (0.0, 1 / JUST, 0.0, ([0.0], [0.0], [1.0])),
        (0.0, 0.5 / JUST, 0.5 / JUST, ([0.5], [0.5], [0.0])),
        (1 / JUST, 0.0, 0.0, ([0.0], [2.0**-60], [0.0])),
        (0.25 / JUST, -0.5 / JUST, 0.25 / JUST, ([0.25], [0.0], [0.5])),
    ],
)
def test_the_edge_in_one_state(slack: float, Q: float, E: float, rows: Rows) -> None:
    """2 d (a d + s + Q d^2 + r) with |s| <= slack |d| and |r| <= E d^2, negative while slack + |Q| + E < -a."""
    assert scalar(-1.0, slack, Q, E, rows)
    assert not scalar(-1.0, slack * JUST**2, Q * JUST**2, E * JUST**2, rows)
    assert not scalar(1.0, slack, Q, E, rows)


def test_the_rate_of_P_counts_with_its_sign() -> None:
    """R d^2 + 2 a d^2 < 0."""
    rows: Rows = ([0.0], [5e-324], [0.0])
    below = math.nextafter(2.0, 0.0)
    assert scalar(-1.0, 0.0, 0.0, 0.0, rows, R=below) and not scalar(-1.0, 0.0, 0.0, 0.0, rows, R=2.0)
    assert scalar(1.0, 0.0, 0.0, 0.0, rows, R=-math.nextafter(2.0, 3.0)) and not scalar(
        1.0, 0.0, 0.0, 0.0, rows, R=-2.0
    )
    assert scalar(-4.0, 0.0, 0.0, 0.0, rows, J=2.0, R=below, P=0.5)
    assert not scalar(-4.0, 0.0, 0.0, 0.0, rows, J=2.0, R=2.0, P=0.5)
    assert not scalar(0.0, 0.0, 0.0, 0.0, rows)


def test_errors_of_two_components_cancel_jointly_alone() -> None:
    """F = -x + k x_1^2 (1, -1), and P for which (1, -1) is short: x'PF sees a tenth of the square."""
    P, zero, flat = exactly(np.array([[1.0, 0.9], [0.9, 1.0]])), fmpq_mat(2, 2), np.zeros((2, 2))
    F = [jet([-1, 0], 0.0, [[0.75, 0], [0, 0]], flat), jet([0, -1], 0.0, [[-0.75, 0], [0, 0]], flat)]
    models, each = models_of(np.eye(2), F, no_units(2), True), np.exp(np.arange(-6, 3, 0.25)).tolist()
    assert shows(models, P, zero, by([0, 0], [0, 0], [0.125, 2.0**-60]))
    assert not any(shows(models, P, zero, by([0, 0], [v, w], [0, 0])) for v in each for w in each)


@pytest.mark.parametrize("zero", [0.0, -0.0])
def test_multipliers_that_can_be_used(zero: float) -> None:
    for alpha, beta, g in (
        ([zero, zero], [1.0, 1.0], [zero, zero]),
        ([zero, 5e-324], [zero, 1.0], [1.0, 5e-324]),
        ([1.0, 1.0], [zero, zero], [1.0, 1.0]),
    ):
        assert are_usable(by(alpha, beta, g))
    for beta, g in (([1.0, zero], [1.0, zero]), ([zero, zero], [zero, 1.0]), ([zero, zero], [zero, zero])):
        assert not are_usable(by([1.0, 1.0], beta, g))


@pytest.mark.parametrize("row", [0, 1, 2])
@pytest.mark.parametrize("value", [-1.0, -5e-324])
def test_no_multiplier_is_negative(row: int, value: float) -> None:
    rows = [[1.0, 1.0] for _ in range(3)]
    rows[row][1] = value
    assert not are_usable(by(*rows))


def test_a_negative_multiplier_would_show_what_is_false(monkeypatch: pytest.MonkeyPatch) -> None:
    """x' = x/2: a beta of -9 with Q = 1, or g = -9, takes from the rest what the decay lacks."""
    growing = models_of(np.eye(1), [jet([0.5], 0.0, [[1.0]], [[0.0]])], no_units(1), True)
    one, zero = fmpq_mat([[1]]), fmpq_mat(1, 1)
    for rows in (([0.0], [0.0], [-9.0]), ([-9.0], [0.0], [-9.0])):
        assert shows(growing, one, zero, by(*rows)) and not are_usable(by(*rows))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("part", ["a", "slack", "Q", "E"])
def test_what_is_not_finite_is_no_model(bad: float, part: str) -> None:
    parts: dict[str, Any] = {"a": [1.0, 2.0], "slack": 0.0, "Q": np.eye(2), "E": np.eye(2)}
    assert are_finite([jet(**parts).model])
    spoilt = np.array(parts[part], float)
    spoilt[(-1,) * spoilt.ndim] = bad
    assert not are_finite([jet(**parts).model, jet(**parts | {part: spoilt}).model])


def test_third_orders_whose_sum_overflows_are_no_models() -> None:
    """S_cubic takes the square of the norm of sum_i b_i K_i."""
    none, steep = np.zeros((2, 2)), np.array([1.2e154, 0.0, 0.0, 0.0])
    one = plain(np.float64(0), 0.0, np.zeros(2), 0.0, none, none, steep).model
    with np.errstate(over="ignore"):
        assert are_finite([one]) and not are_finite([one, one])
