"""The partition and its open boxes: numbers stand for boxes, whatever was put away comes back, memory is bounded."""

from __future__ import annotations

import heapq
import os
import resource
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from certify.provers.boxes.frontier import _HANDFUL, Frontier
from certify.provers.boxes.partition import LEAF, Partition
from tests.provers.test_bounds import leaves


def grown(seed: int, calls: int = 30, n: int = 3) -> tuple[Partition, dict[int, tuple[np.ndarray, np.ndarray]]]:
    """A partition, and its open boxes by number, kept the plain way."""
    generator = np.random.default_rng(seed)
    partition = Partition(generator.uniform(0.5, 2.0, n))
    boxes = {0: (-partition.root, partition.root.copy())}
    for _ in range(calls):
        chosen = generator.permutation(sorted(boxes))[: generator.integers(1, 6)].astype(np.int64)
        axes = generator.integers(0, n, len(chosen))
        halves = partition.split(chosen, axes)
        for k, (number, axis) in enumerate(zip(chosen.tolist(), axes.tolist(), strict=True)):
            lo, hi = boxes.pop(number)
            middle = 0.5 * lo[axis] + 0.5 * hi[axis]
            left, right = hi.copy(), lo.copy()
            left[axis] = right[axis] = middle
            boxes[int(halves[2 * k])], boxes[int(halves[2 * k + 1])] = (lo, left), (right, hi)
    return partition, boxes


@given(seed=st.integers(0, 10**6))
def test_corners_are_rebuilt_bit_for_bit(seed: int) -> None:
    partition, boxes = grown(seed)
    numbers = np.array(sorted(boxes))
    lo, hi = partition.corners(numbers)
    for k, number in enumerate(numbers.tolist()):
        assert np.array_equal(lo[:, k], boxes[number][0]) and np.array_equal(hi[:, k], boxes[number][1])


@given(seed=st.integers(0, 10**6))
def test_the_preorder_has_the_open_boxes_as_leaves(seed: int) -> None:
    partition, boxes = grown(seed)
    expected = sorted((*lo, *hi) for lo, hi in boxes.values())
    assert sorted((*lo, *hi) for lo, hi in leaves(partition.preorder(), partition.root)) == expected


def test_a_partition_without_splits_is_one_leaf() -> None:
    assert Partition(np.ones(2)).preorder() == bytes([LEAF])


@given(seed=st.integers(0, 10**6), capacity=st.sampled_from([8, 16, 10_000]))
def test_boxes_come_in_the_order_of_their_lowest_level(seed: int, capacity: int) -> None:
    """Against a heap: with a small capacity most boxes are put away and rebuilt."""
    generator = np.random.default_rng(seed)
    partition = Partition(np.ones(2))
    frontier = Frontier(partition, capacity)
    model: list[tuple[float, int]] = [(0.0, 0)]
    levels = {0: 0.0}
    one = np.ones((2, 1))
    frontier.add(-one, one, np.zeros(1), np.zeros(1, dtype=np.int64))
    ceiling = np.inf
    for _ in range(40):
        assert len(frontier) == len(model)
        if not model:
            assert frontier.least() == np.inf
            break
        assert frontier.least() == model[0][0]
        count = int(generator.integers(1, 5))
        lo, hi, number, _ = frontier.take(count, np.inf)
        assert 1 <= len(number) <= count
        expected = [heapq.heappop(model) for _ in range(len(number))]
        taken = [levels[k] for k in number.tolist()]
        assert sorted(taken) == [v for v, _ in expected]
        rebuilt = partition.corners(number)
        assert np.array_equal(rebuilt[0], lo) and np.array_equal(rebuilt[1], hi)
        halves = partition.split(number, generator.integers(0, 2, len(number)))
        step = 10.0 ** -generator.integers(0, 16)  # some levels differ in their last digits only
        level = (generator.permutation(len(halves)) / 7.0 + halves * 1e-9) * step + max(v for v, _ in expected)
        keep = level <= ceiling
        lo, hi = (np.array(a) for a in partition.corners(halves[keep]))
        frontier.add(lo, hi, np.array(level[keep]), np.array(halves[keep]))
        for value, k in zip(level[keep].tolist(), halves[keep].tolist(), strict=True):
            heapq.heappush(model, (value, k))
            levels[k] = value
        if generator.random() < 0.1:
            ceiling = float(np.median([v for v, _ in model])) if model else 0.0
            frontier.drop_above(ceiling)
            model = [pair for pair in model if pair[0] <= ceiling]
            heapq.heapify(model)


def test_a_limit_holds_boxes_back_but_never_a_handful() -> None:
    frontier = Frontier(Partition(np.ones(1)))
    corner = np.ones((1, 1000))
    frontier.add(-corner, corner, np.arange(1000), np.arange(1000))
    assert frontier.take(1000, 299.0)[2].tolist() == list(range(300))
    assert frontier.take(1000, 0.0)[2].tolist() == list(range(300, 300 + _HANDFUL))
    assert frontier.take(10, 0.0)[2].tolist() == list(range(300 + _HANDFUL, 310 + _HANDFUL))


def test_levels_that_nearly_agree_keep_their_order() -> None:
    """Three chunks put away with interleaved levels within 1e-13 of each other, and one far above."""
    partition = Partition(np.ones(1))
    halves = np.zeros(1, dtype=np.int64)
    for _ in range(8):
        halves = partition.split(halves, np.zeros(len(halves), dtype=np.int64))
    frontier = Frontier(partition, capacity=16)
    order = np.random.default_rng(0).permutation(len(halves))
    levels = 1.0 + 1e-15 * order.astype(np.float64)
    levels[0] = 1e6
    for part in np.split(np.arange(len(halves)), 8):
        lo, hi = (np.array(a) for a in partition.corners(halves[part]))
        frontier.add(lo, hi, np.array(levels[part]), np.array(halves[part]))
    level_of = dict(zip(halves.tolist(), levels.tolist(), strict=True))
    taken: list[float] = []
    while len(frontier):
        number = frontier.take(3, np.inf)[2].tolist()
        assert number
        taken += sorted(level_of[k] for k in number)
    assert taken == sorted(levels)


def test_the_lowest_comes_back_before_many_a_hair_above_it() -> None:
    """Two chunks away: the first holds more ties than come back at once, the second one box a last digit lower."""
    partition = Partition(np.ones(1))
    halves = np.zeros(1, dtype=np.int64)
    for _ in range(4):
        halves = partition.split(halves, np.zeros(len(halves), dtype=np.int64))
    frontier, high = Frontier(partition, capacity=4), np.nextafter(1.0, 2.0)
    taken: list[float] = []
    levels = np.array([0.0, 0.0, high, high, high, high, 0.0, 0.0, 1.0])
    for part in (np.arange(6), np.arange(6, 9)):
        lo, hi = (np.array(a) for a in partition.corners(halves[part]))
        frontier.add(lo, hi, np.array(levels[part]), np.array(halves[part]))
    level_of = dict(zip(halves.tolist(), levels.tolist(), strict=False))
    while len(frontier):
        number = frontier.take(1, np.inf)[2].tolist()
        assert number
        taken.append(level_of[number[0]])
    assert taken == sorted(levels)


HARD = """
import resource
import numpy as np
from certify.provers.base import Budget
from certify.provers.boxes.rule import BoxBounds, VdotBound
from certify.provers.boxes.search import prove_outwards
from certify.provers.execution import ThreadRunner
from tests.support.cases import case_of
from tests.support.loops import chain

class Undecided(VdotBound):
    def __call__(self, lo, hi, inner, outer):
        none = np.zeros(lo.shape[1], dtype=np.bool_)
        one = np.ones(lo.shape[1], dtype=lo.dtype)
        return BoxBounds(none, one, hi - lo, none, ~none, one)

case = case_of(*chain(4, [-1, -2, -3, -4]))
budget = Budget(boxes=10**9, batch=32768, least_width=0.0)
rule = Undecided(case.problem, case.T)
proof = prove_outwards(case.problem, case.T, 1e-9, 1e-2, budget, ThreadRunner(), rule=rule)
print(proof.stop.value, proof.boxes, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


@pytest.mark.slow
def test_memory_stays_below_two_gibibytes_when_no_box_is_ever_proved() -> None:
    """The pass ends at the most splits that a certificate can hold, with nothing proved."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, "-c", HARD], capture_output=True, text=True, check=True, env=environment)
    reason, boxes, kilobytes = done.stdout.split()
    assert reason == "boxes" and int(boxes) > 13_000_000  # each of which is split three times, 40 million in all
    assert int(kilobytes) < 2 * 1024**2, f"{int(kilobytes) / 1024:.0f} MiB"
    assert resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss >= int(kilobytes)
