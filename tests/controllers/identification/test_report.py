"""Ranges of A and B hold the true ones, and the range of K the gain of every plant in them."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest

from certify.errors import InputError
from certify.loop.plants import get_system
from controllers.identification.enclosed_gain import Box, enclosed_gain
from controllers.identification.gain_learner import Identified
from controllers.identification.report import Declared, identify_report
from controllers.identification.riccati import riccati_gain
from tests.support.marks import slow_after

Q, R = np.diag([1.0, 0.5]), np.eye(1)
A, B = np.array([[1.004, 0.0195], [0.3825, 0.9519]]), np.array([[0.0052], [0.52]])
SECOND = {"theta": "0.003*theta**2", "theta_dot": "0.03*theta**2 + 0.01*theta*u"}


def around(M: np.ndarray, reach: np.ndarray | float) -> Box:
    return Box(M - reach, M + reach)


def plants(A: Box, B: Box, count: int, seed: int = 0):
    """Plants in the boxes, half of them at corners."""
    draw = np.random.default_rng(seed)
    for k in range(count):
        for_A, for_B = draw.uniform(-1, 1, A.lo.shape), draw.uniform(-1, 1, B.lo.shape)
        if k % 2:
            for_A, for_B = np.sign(for_A), np.sign(for_B)
        yield tuple(np.clip(box.middle + box.reach * share, box.lo, box.hi) for box, share in ((A, for_A), (B, for_B)))


@pytest.mark.parametrize("n, m, reach", [(1, 1, 1e-2), (2, 1, 3e-4), (3, 2, 1e-3), (4, 2, 3e-5), (6, 2, 1e-5)])
@pytest.mark.parametrize("seed", range(3))
def test_the_gain_of_every_plant_in_the_boxes_is_enclosed(n, m, reach, seed):
    draw = np.random.default_rng(seed)
    a = np.eye(n) + 0.2 * draw.standard_normal((n, n))
    b = 0.5 * draw.standard_normal((n, m))
    boxes = around(a, reach * draw.uniform(0, 1, a.shape)), around(b, reach * draw.uniform(0, 1, b.shape))
    weights = np.diag(draw.uniform(0.1, 2, n)), np.diag(draw.uniform(0.1, 2, m))
    found = enclosed_gain(*boxes, *weights)
    assert found is not None
    gains = np.array([riccati_gain(*plant, *weights) for plant in plants(*boxes, 60, seed)])
    assert (found.lo <= gains).all() and (gains <= found.hi).all()
    assert (found.hi - found.lo <= 20 * np.ptp(gains, 0)).all()  # corners drawn at random are seldom the worst


def test_small_ranges_cost_no_more_than_the_linear_part():
    """The half-widths of K are sums of |dK / dA_ij| and |dK / dB_ij| times those of A and B, nearly."""
    reach, h = 1e-7, 1e-6
    found, linear = enclosed_gain(around(A, reach), around(B, reach), Q, R), np.zeros((1, 2))
    for i in range(2):
        for j in range(3):
            move = np.zeros((2, 3))
            move[i, j] = h
            ends = [riccati_gain(A + s * move[:, :2], B + s * move[:, 2:], Q, R) for s in (1, -1)]
            linear += np.abs(ends[0] - ends[1]) / (2 * h) * reach
    assert found is not None
    np.testing.assert_allclose((found.hi - found.lo) / 2, linear, rtol=2e-3)


def test_a_gain_that_is_known_exactly():
    """a = b = q = r = 1: P is the golden ratio, and K one less."""
    one = np.ones((1, 1))
    found = enclosed_gain(Box(one, one), Box(one, one), one, one)
    assert found is not None
    assert found.lo <= (math.sqrt(5) - 1) / 2 <= found.hi and found.hi - found.lo < 1e-12


@pytest.mark.parametrize("reach", [0.02, 0.3, 5.0])
def test_boxes_that_are_too_wide_have_no_enclosure(reach):
    """The widest hold plants that no input reaches, which have no gain at all."""
    assert enclosed_gain(around(A, reach), around(B, reach), Q, R) is None


def test_a_plant_that_cannot_be_stabilised_has_no_enclosure():
    box = Box(np.diag([1.2, 0.5]), np.diag([1.2, 0.5]))
    assert enclosed_gain(box, Box(np.array([[0.0], [1.0]]), np.array([[0.0], [1.0]])), Q, R) is None


def test_weights_of_0_are_refused():
    with pytest.raises(InputError, match="must be positive"):
        enclosed_gain(around(A, 1e-6), around(B, 1e-6), np.diag([1.0, 0.0]), R)


def rows_of(seed: int, noise: float, share: float = 1.0, count: int = 60):
    """Transitions of a plant with errors and residuals at their bounds, of either sign, or at a share of them."""
    draw = np.random.default_rng(seed)
    x, v = draw.uniform(-0.1, 0.1, (count, 2)), draw.uniform(-1, 1, (count, 1)) * (np.arange(count)[:, None] > 20)
    bounds = np.column_stack([0.003 * x[:, 0] ** 2, 0.03 * x[:, 0] ** 2 + 0.01 * np.abs(x[:, 0] * v[:, 0])])
    signs = draw.choice([-1, 1], (3, count, 2)) * share
    after = x @ A.T + v @ B.T + signs[0] * bounds + signs[1] * noise * 0.999
    return list(zip(x + signs[2] * noise * 0.999, v, after, strict=True))


def report_of(rows, noise="1e-5", second=SECOND):
    learned = Identified(A, B, riccati_gain(A, B, Q, R))
    return identify_report(learned, rows, get_system("pendulum"), (Q, R), Declared(second, Fraction(noise)))


@pytest.mark.parametrize("seed", slow_after(8, range(20)))
def test_the_true_plant_lies_in_the_ranges(seed):
    found = report_of(rows_of(seed, 1e-5))
    for box, true in ((found.A, A), (found.B, B)):
        assert (box.lo <= true).all() and (true <= box.hi).all()
        assert (box.hi - box.lo < 0.02).all()
    assert found.K is not None and max(found.shares.values()) <= 1
    gains = [riccati_gain(*plant, Q, R) for plant in [(A, B), *plants(found.A, found.B, 40, seed)]]
    assert all((found.K.lo <= K).all() and (found.K.hi >= K).all() for K in gains)


def test_noise_of_states_is_bounded_by_the_ranges_themselves():
    """With much noise in the states the bound of |A| counts: the truth stays inside, and no less noise is claimed."""
    for seed in range(5):
        found = report_of(rows_of(seed, 3e-2), "3e-2")
        assert (found.A.lo <= A).all() and (found.A.hi >= A).all() and (found.B.lo <= B).all()
        assert found.K is None  # far too wide


def test_what_is_declared_too_small_is_refuted():
    with pytest.raises(InputError, match=r"of theta_dot the bounds must be at least \S+ times"):
        report_of(rows_of(0, 1e-9), "1e-9", {"theta": "0.003*theta**2", "theta_dot": "0.003*theta**2"})


def test_least_shares_say_how_much_smaller_bounds_could_be():
    found = report_of(rows_of(1, 1e-7, share=0.3), "1e-7")
    assert all(0.15 < share <= 0.3001 for share in found.shares.values())


@pytest.mark.parametrize(
    "second, noise, said",
    [
        ({"omega": "theta**2"}, "1e-6", "names 'omega'"),
        ({"theta": "speed**2"}, "1e-6", "`second` of theta"),
        ({}, "0", "must be a positive bound"),
    ],
)
def test_declarations_are_read_before_anything_is_bounded(second, noise, said):
    with pytest.raises(InputError, match=said):
        report_of(rows_of(0, 1e-6), noise, second)


def test_too_few_transitions_determine_nothing():
    with pytest.raises(InputError, match="do not determine"):
        report_of(rows_of(0, 1e-6)[:20])  # without an input


def test_the_table_and_the_object_say_the_same():
    found = report_of(rows_of(2, 1e-5))
    said, text = found.to_dict(), "\n".join(found.lines())
    assert said["K"]["range"] == {"lo": found.K.lo.tolist(), "hi": found.K.hi.tolist()}
    assert [line.split()[0] for line in text.splitlines()[2:]] == [
        "A11",
        "A12",
        "A21",
        "A22",
        "B11",
        "B21",
        "K11",
        "K12",
    ]
    assert said["noise"] == {"theta": "1/100000", "theta_dot": "1/100000"} and said["transitions"] == 60
    wide = report_of(rows_of(0, 3e-2), "3e-2")
    assert wide.to_dict()["K"]["range"] is None and "no enclosure" in "\n".join(wide.lines())
