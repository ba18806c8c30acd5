"""Folding: exact but for one rounding of each number, with the states where no observation is clipped."""

from __future__ import annotations

import math
from decimal import Decimal, localcontext
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from certify.errors import InputError
from certify.loop.networks import values
from certify.loop.policies.importers.comparing import apply, rounding
from certify.loop.policies.importers.folding import Folded, fold
from certify.loop.policies.importers.steps import Activate, Affine, Branches, Clip, Diagonal, Normalise, Step, Tanh

NUMBER = st.floats(-4, 4).map(lambda v: round(v, 6))
POSITIVE = st.floats(1e-3, 4)


def affine(draw: Any, out: int, columns: int) -> Affine:
    numbers = st.lists(NUMBER, min_size=out * columns, max_size=out * columns)
    return Affine(
        np.reshape(draw(numbers), (out, columns)), np.array(draw(st.lists(NUMBER, min_size=out, max_size=out)))
    )


def rationals(draw: Any, kind: st.SearchStrategy[float], size: int) -> tuple[Fraction, ...]:
    return tuple(Fraction(v) for v in draw(st.lists(kind, min_size=size, max_size=size)))


@st.composite
def policies(draw: st.DrawFn) -> tuple[list[Step], int]:
    """Steps from n observations, with everything that folds in every place where it may stand."""
    n, width = draw(st.integers(1, 3)), draw(st.integers(1, 3))
    steps: list[Step] = []
    if draw(st.booleans()):
        steps.append(Diagonal((Fraction(1),), rationals(draw, NUMBER, n)))
    if draw(st.booleans()):
        limit = Fraction(10) if draw(st.booleans()) else None
        steps.append(Normalise(rationals(draw, NUMBER, n), rationals(draw, POSITIVE, n), limit))
    if draw(st.booleans()):
        steps.append(Diagonal(rationals(draw, POSITIVE, n), rationals(draw, NUMBER, 1)))
    steps.append(affine(draw, width, n))
    for _ in range(draw(st.integers(0, 2))):
        steps.append(Tanh())
        if draw(st.booleans()):
            steps.append(Diagonal(rationals(draw, NUMBER, 1), rationals(draw, NUMBER, width)))
        steps.append(affine(draw, width, width))
        if draw(st.booleans()):
            steps.append(affine(draw, width, width))
    if draw(st.booleans()):
        steps.append(Tanh())
    steps.append(Diagonal(tuple(-v for v in rationals(draw, POSITIVE, width)), rationals(draw, NUMBER, width)))
    if draw(st.booleans()):
        steps.append(Clip((Fraction(-1),), (Fraction(2),)))
        steps.append(Diagonal((Fraction(3),), (Fraction(1, 3),)))
    return steps, n


def value(folded: Folded, x: np.ndarray) -> np.ndarray:
    x = values(folded.network, x)
    x = folded.scale * (np.tanh(x) if folded.squash == "tanh" else x) + folded.offset
    return x if folded.clip is None else np.clip(x, *folded.clip)


def weights(folded: Folded) -> list[np.ndarray]:
    return [step.weight for step in folded.network.affine]


def biases(folded: Folded) -> list[np.ndarray]:
    return [step.bias for step in folded.network.affine]


@given(policies())
def test_the_folded_policy_is_the_steps(policy: tuple[list[Step], int]) -> None:
    steps, n = policy
    folded = fold(steps, n)
    x = np.random.default_rng(0).uniform(-2, 2, (50, n))
    for i, (lo, hi) in enumerate(folded.inactive):
        x[:, i] = np.clip(x[:, i], -9 if lo is None else float(lo), 9 if hi is None else float(hi))
    assert np.all(np.abs(value(folded, x) - apply(steps, x)) <= 2 * rounding(steps, x, True) + 1e-300)


def test_a_layer_that_stands_alone_keeps_its_bits() -> None:
    rng = np.random.default_rng(0)
    layers = [
        Affine(rng.standard_normal((3, 2)), rng.standard_normal(3)),
        Affine(rng.standard_normal((1, 3)), np.ones(1)),
    ]
    folded = fold([layers[0], Tanh(), layers[1], Tanh(), Diagonal((Fraction(1, 3),), (Fraction(1, 7),))], 2)
    assert all(np.array_equal(w, layer.weight) for w, layer in zip(weights(folded), layers, strict=True))
    assert all(np.array_equal(b, layer.bias) for b, layer in zip(biases(folded), layers, strict=True))
    assert (folded.scale[0], folded.offset[0], folded.squash, folded.clip) == (1 / 3, 1 / 7, "tanh", None)


@given(
    st.lists(NUMBER, min_size=3, max_size=3),
    st.lists(NUMBER, min_size=2, max_size=2),
    st.lists(POSITIVE, min_size=2, max_size=2),
)
def test_a_normaliser_is_rounded_once(row: list[float], mean: list[float], var: list[float]) -> None:
    """Every folded number is the binary64 nearest to the real one, computed here in 80 decimals."""
    epsilon = Fraction(1e-8)
    squares = tuple(Fraction(v) + epsilon for v in var)
    folded = fold(
        [Normalise(tuple(map(Fraction, mean)), squares), Affine(np.array([row[:2]]), np.array(row[2:]))], 2
    )  # fmt: skip
    with localcontext() as context:
        context.prec = 80
        decimals = [Decimal(q.numerator) / Decimal(q.denominator) for q in squares]
        entries = [Decimal(w) / q.sqrt() for w, q in zip(row, decimals, strict=False)]
        bias = Decimal(row[2]) - sum(w * Decimal(m) for w, m in zip(entries, mean, strict=True))
    # Decimal to float is correctly rounded; the 80 decimals stand for the real number unless it is a tie.
    assert weights(folded)[0].ravel().tolist() == [float(w) for w in entries]
    assert biases(folded)[0][0] == float(bias) or abs(bias) < Decimal(10) ** -60


def test_a_square_root_that_is_rational_is_exact() -> None:
    folded = fold(
        [Normalise((Fraction(1, 3),), (Fraction(4, 9),), Fraction(10)), Affine(np.array([[2.0]]), np.array([1.0]))], 1
    )
    assert (weights(folded)[0][0, 0], biases(folded)[0][0]) == (3.0, 0.0)
    assert folded.inactive == ((Fraction(1, 3) - Fraction(20, 3), Fraction(1, 3) + Fraction(20, 3)),)


def test_terms_that_cancel_exactly_are_rounded_to_zero() -> None:
    """sqrt 2 - sqrt 2: no enclosure, however narrow, tells its ends apart from 0."""
    steps = [Normalise((Fraction(1), Fraction(-1)), (Fraction(2), Fraction(2))), Affine(np.ones((1, 2)), np.zeros(1))]
    assert abs(biases(fold(steps, 2))[0][0]) < 1e-300


@given(NUMBER, POSITIVE, st.floats(0.5, 20), st.booleans())
def test_the_clip_is_inactive_inside_and_active_outside(mean: float, var: float, limit: float, negative: bool) -> None:
    """The bounds are inside the true interval, in rationals, and miss it by next to nothing."""
    m, q, c = Fraction(mean), Fraction(var), Fraction(limit)
    layer = Affine(np.ones((1, 1)), np.zeros(1))
    ((lo, hi),) = fold([Normalise((m,), (q,), c), layer], 1).inactive
    assert lo is not None and hi is not None
    assert (lo - m) ** 2 <= c**2 * q and (hi - m) ** 2 <= c**2 * q
    assert lo < m < hi
    further = Fraction(1, 2**100)
    assert (lo - further - m) ** 2 > c**2 * q and (hi + further - m) ** 2 > c**2 * q
    # the same as two steps, with a factor of either sign
    s = Fraction(-2 if negative else 2)
    ends = (Fraction(-3), Fraction(5))
    ((lo, hi),) = fold([Diagonal((s,), (m,)), Clip((ends[0],), (ends[1],)), layer], 1).inactive
    assert lo is not None and hi is not None and sorted([s * lo + m, s * hi + m]) == list(ends)


def test_several_clips_of_an_observation_meet() -> None:
    steps: list[Step] = [Clip((Fraction(-1),), (None,)), Diagonal((Fraction(2),), (Fraction(0),))]
    steps += [Clip((None,), (Fraction(3),)), Affine(np.ones((1, 2)), np.zeros(1))]
    assert fold(steps, 2).inactive == ((Fraction(-1), Fraction(3, 2)),) * 2


ONE = Affine(np.ones((1, 1)), np.zeros(1))


@pytest.mark.parametrize(
    ("tail", "expected"),
    [
        ([Clip((Fraction(-1),), (Fraction(1),))], ([-1.0], [1.0])),
        ([Tanh(), Clip((Fraction(-1),), (Fraction(1),))], None),  # never acts
        ([Tanh(), Clip((Fraction(0),), (None,))], ([0.0], [1.0])),  # relu(tanh)
        ([Tanh(), Clip((Fraction(0),), (None,)), Diagonal((Fraction(6),), (Fraction(0),))], ([0.0], [6.0])),
        ([Tanh(), Clip((Fraction(0),), (None,)), Diagonal((Fraction(-6),), (Fraction(1),))], ([-5.0], [1.0])),
        ([Clip((Fraction(-1),), (Fraction(1),)), Diagonal((Fraction(-2),), (Fraction(1),))], ([-1.0], [3.0])),
        ([Clip((Fraction(-1),), (Fraction(1),)), Clip((Fraction(0),), (Fraction(5),))], ([0.0], [1.0])),
        ([Clip((Fraction(-1),), (None,)), Clip((None,), (Fraction(1),))], ([-1.0], [1.0])),  # max, then min
        # Inwards: an actuator's bound of 2/5 is below 0.4.
        ([Clip((Fraction(-2, 5),), (Fraction(2, 5),))], ([-math.nextafter(0.4, 0)], [math.nextafter(0.4, 0)])),
        ([Clip((Fraction(-1),), (Fraction(1),)), Diagonal((Fraction(3, 5),), (Fraction(0),))], ([-0.6], [0.6])),
    ],
)
def test_clips_of_the_action(tail: list[Step], expected: Any) -> None:
    found = fold([ONE, *tail], 1).clip
    assert found is None if expected is None else [v.tolist() for v in found or ()] == list(expected)


@pytest.mark.parametrize(
    ("steps", "message"),
    [
        ([Tanh()], "must have a layer"),
        ([ONE, Diagonal((Fraction(0),), (Fraction(0),))], "must not be 0"),
        ([ONE, Normalise((Fraction(0),), (Fraction(1),))], "may be a tanh"),
        ([ONE, Tanh(), Normalise((Fraction(0),), (Fraction(1),)), ONE], "read the observation itself"),
        ([Diagonal((Fraction(2),), (Fraction(0),)), Normalise((Fraction(0),), (Fraction(1),)), ONE], "read the obs"),
        ([Diagonal((Fraction(0),), (Fraction(0),)), Clip((Fraction(0),), (None,)), ONE], "multiplied by 0"),
        ([Clip((Fraction(1),), (None,)), Clip((None,), (Fraction(0),)), ONE], "leave no states"),
        ([ONE, Clip((Fraction(1),), (Fraction(2),)), Clip((Fraction(3),), (Fraction(4),))], "leave nothing between"),
        ([ONE, Diagonal((Fraction(10) ** 400,), (Fraction(0),))], "range of binary64"),
        ([Affine(np.ones((1, 2)), np.zeros(1))], "must take 1 numbers"),
        ([ONE, Affine(np.ones((1, 2)), np.zeros(1))], "must take 1 numbers"),
        ([Diagonal((Fraction(1),) * 2, (Fraction(0),)), ONE], "one number or 1 of them"),
    ],
)
def test_what_does_not_fold_is_refused(steps: list[Step], message: str) -> None:
    with pytest.raises(InputError, match=message):
        fold(steps, 1)


TWO, HALF = Affine(np.array([[1.5], [-0.5]]), np.array([0.1, 0.2])), Diagonal((Fraction(1, 2),), (Fraction(1),))
JOIN = Affine(np.array([[1.0, -2.0]]), np.zeros(1))


@pytest.mark.parametrize(
    "steps",
    [
        [ONE, Clip((Fraction(0),), (None,)), ONE, Tanh(), ONE],
        [ONE, Activate("elu")],
        [Activate("elu"), ONE],
        [ONE, Clip((Fraction(-1),), (Fraction(1),)), ONE],
        [ONE, Clip((Fraction(-1, 2),), (None,)), ONE, Clip((None,), (Fraction(1, 3),)), ONE],
        [ONE, Clip((Fraction(0),), (None,))],
        [ONE, Clip((None,), (Fraction(1),)), HALF],
        [ONE, Tanh(), Tanh()],
        [ONE, Tanh(), Diagonal((Fraction(2),), (Fraction(0),)), Tanh()],
        [Tanh(), ONE],
        [TWO, Branches("sum", ((), (HALF, Activate("silu")))), JOIN, Tanh(), HALF],
        [Branches("concat", ((ONE, Activate("relu")), (HALF,))), JOIN],
        [Branches("sum", ((HALF,), (TWO, Tanh(), JOIN), (Branches("sum", ((), (HALF,))),)))],
    ],
)
def test_more_than_layers_is_folded_to_steps(steps: list[Step]) -> None:
    folded, x = fold(steps, 1), np.random.default_rng(0).uniform(-3, 3, (200, 1))
    assert np.all(np.abs(value(folded, x) - apply(steps, x)) <= 2 * rounding(steps, x, True) + 1e-300)


def test_a_clip_of_the_observation_may_stay() -> None:
    steps: list[Step] = [Normalise((Fraction(1, 2),), (Fraction(2),), Fraction(1)), HALF, TWO, Tanh(), JOIN]
    folded, x = fold(steps, 1, keep_clips=True), np.random.default_rng(0).uniform(-9, 9, (200, 1))
    assert folded.inactive == ((None, None),)
    assert np.all(np.abs(value(folded, x) - apply(steps, x)) <= 2 * rounding(steps, x, True) + 1e-300)
    assert [step.kind for step in folded.network.steps] == ["affine", "clip", "affine", "map", "affine"]


def test_steps_refuse_what_is_no_number() -> None:
    for weight in (math.nan, math.inf):
        with pytest.raises(InputError, match="finite"):
            Affine(np.array([[weight]]), np.zeros(1))
    with pytest.raises(InputError, match="lo < hi"):
        Clip((Fraction(1),), (Fraction(1),))
    with pytest.raises(InputError, match="positive"):
        Normalise((Fraction(0),), (Fraction(0),))
    with pytest.raises(InputError, match="as many means"):
        Normalise((Fraction(0),), (Fraction(1),) * 2)
