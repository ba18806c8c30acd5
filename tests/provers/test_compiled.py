"""Compiled loops against numpy: the same bits, nothing proved that is not finite, and who pays for it.

That both contain the truth is tested where that of the bounds is: `test_enclosures.py`, `checker/test_rounding.py`.
"""

from __future__ import annotations

import math
import pickle
import subprocess
import sys
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numba
import numpy as np
import pytest

from certify.certificates.claims import Problem
from certify.certificates.tree import LEAF
from certify.loop.expressions import Number, cos, sin, symbols
from certify.loop.expressions.tree import FUNCTIONS
from certify.loop.plants import System, get_system
from certify.loop.policies import PolicyNetwork, load_policy
from certify.provers.base import Budget
from certify.provers.bounds import compiled, kernels, loop_models, tape, taylor, vectors
from certify.provers.bounds import policy as policies
from certify.provers.bounds.compiled import Compiled
from certify.provers.bounds.loop import played
from certify.provers.boxes.mend import cut_leaf
from certify.provers.boxes.rule import BoxBounds, VdotBound
from certify.provers.boxes.search import prove_outwards
from certify.provers.boxes.sweep import RingGrowth, Sweep
from certify.provers.execution import ThreadRunner
from tests.provers.test_steps import Stepped, alone, stepped, uncertain_pendulum
from tests.provers.test_vdot import CASES, cartpole_case
from tests.support.cases import case_of
from tests.support.loops import box, pendulum_network
from tests.support.marks import slow_after
from tests.support.ways import WAYS, Way, bounded

POLICIES = Path(__file__).parent.parent.parent / "examples" / "policies"
Both = tuple[Problem, np.ndarray]


def shipped(name: str) -> Both:
    policy = load_policy(POLICIES / f"{name}.pt")
    case = case_of(get_system(policy.system).with_parameters(policy.parameters), policy.network)
    return case.problem, case.T


def small(name: str) -> Both:
    case = CASES[name]()
    return case.problem, case.T


def with_steps(case: Any) -> Both:
    return case.problem, case.T


LOOPS: dict[str, Callable[[], Both]] = {
    "quadrotor2d": lambda: shipped("quadrotor2d"),
    "cartpole": lambda: shipped("cartpole"),
    "scalar": lambda: small("scalar"),
    "pendulum": lambda: small("pendulum"),
    "uncertain": lambda: with_steps(stepped(uncertain_pendulum(), pendulum_network())),
    "discrete": lambda: with_steps(stepped(*alone("x/2 + u/4"))),
    "rate": lambda: with_steps(stepped(get_system("pendulum"), pendulum_network(), rate=0.1)),
}


def boxes(n: int, count: int, size: float) -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(4)
    centre = np.array(0.3 * generator.standard_normal((n, count)))
    radius = np.array(size * generator.random((n, count)))
    return centre - radius, centre + radius


def judged(way: Way, rule: VdotBound, lo: np.ndarray, hi: np.ndarray) -> BoxBounds:
    with bounded(way):
        return rule(lo, hi, 1e-3, 10.0)


@pytest.mark.parametrize("name", LOOPS)
@pytest.mark.parametrize("size", slow_after(3, [0.0, 1e-9, 1e-3, 0.1, 1.0]))
def test_both_ways_give_the_same_bits(name: str, size: float) -> None:
    problem, T = LOOPS[name]()
    rule = VdotBound(problem, T)
    lo, hi = boxes(len(T), 333, size)  # not a multiple of any piece
    plain, fast = judged("numpy", rule, lo, hi), judged("compiled", rule, lo, hi)
    assert np.isfinite(plain.bound).all()
    for a, b in zip(plain, fast, strict=True):
        assert np.array_equal(a, b)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", LOOPS)
def test_a_box_is_bounded_alike_whatever_boxes_it_comes_with(name: str, way: Way) -> None:
    problem, T = LOOPS[name]()
    rule = VdotBound(problem, T)
    lo, hi = boxes(len(T), 700, 0.3)
    whole = judged(way, rule, lo, hi)
    for part in (np.random.default_rng(0).permutation(700)[:313], np.arange(2), np.array([5])):
        with bounded(way), ThreadRunner(1).start(rule) as bound:
            found = bound(lo.take(part, -1), hi.take(part, -1), 1e-3, 10.0)
        for a, b in zip(whole, found, strict=True):
            assert np.array_equal(a.take(part, -1), b)


def curved() -> Stepped:
    """One state in discrete time, and four uncertain quantities: a model has ten products of these, even at a point,
    which numpy sums in blocks if it may."""
    x, u, *uncertain = symbols(["x", "u", "a", "b", "c", "d"])
    a, b, c, d = uncertain
    row = x / 2 + u / 4 + x * (sin(a + 2 * b + 3 * c + 5 * d) + a * b / 3 - c * d / 7 + cos(a - b / 5 + c - d / 9) - 1)
    ranges = {q.name: (Fraction(-1, n), Fraction(1, n)) for n, q in enumerate(uncertain, 3)}
    plant = System(
        "curved", (x,), (u,), {}, (row,), (Number(0),), box(2), box(9), time="discrete",
        disturbances=tuple(uncertain), ranges=ranges,
    )  # fmt: skip
    return stepped(plant, PolicyNetwork.of_layers((np.array([[0.3]]),), (np.zeros(1),), np.ones(1), np.zeros(1)))


def test_a_violation_s_level_is_the_same_whatever_others_there_are() -> None:
    """The levels after a step, which move the ring's, are of the same bits for a violation alone."""
    case = curved()
    rule = VdotBound(case.problem, case.T, inside=True)
    growth = RingGrowth(cast("Sweep", SimpleNamespace(inner=1e-3, outer=10.0)), rule, np.ones(1))
    lo, hi = boxes(1, 400, 1e-3)
    judgement = judged("numpy", rule, lo, hi)
    centres, every = 0.5 * (lo + hi), np.ones(400, dtype=np.bool_)
    whole = growth.levels_of(centres, judgement._replace(violated=every))
    for way in WAYS:
        with bounded(way):
            alone = [growth.levels_of(centres, judgement._replace(violated=np.arange(400) == i))[i] for i in range(400)]
        assert np.array_equal(whole, alone)


def test_a_leaf_is_cut_by_scores_of_more_than_one_box() -> None:
    """A box alone would be bounded by other sums than the search's, and differently where loops are compiled."""
    asked = list[int]()

    def score(lo: np.ndarray, hi: np.ndarray) -> np.ndarray:
        asked.append(lo.shape[1])
        return hi - lo

    tree = cut_leaf(bytes([LEAF]), 0, np.array([-1.0, -2.0]), np.array([1.0, 2.0]), score)
    assert len(tree) == 15 and set(asked) == {2}


@pytest.mark.parametrize("name", slow_after(1, ["cartpole", "pendulum"]))
def test_both_ways_search_the_same_boxes(name: str) -> None:
    """A whole pass of the shipped policy: every decision is the same."""
    problem, T = shipped(name)
    found = []
    for way in ("numpy", "compiled"):
        with bounded(way):
            found.append(prove_outwards(problem, T, 1e-2, 0.2, Budget(boxes=6000), ThreadRunner()))
    plain, fast = found
    assert plain.boxes == fast.boxes > 20
    assert plain.tree == fast.tree and plain.leaves == fast.leaves
    assert plain.outer == fast.outer and plain.stop == fast.stop


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("way", ["numpy", "compiled"])
def test_what_is_not_finite_is_never_proved_and_spoils_no_other_box(way: Way, bad: float) -> None:
    case = cartpole_case()
    rule = VdotBound(case.problem, case.T)
    lo, hi = boxes(4, 200, 1e-3)
    good = judged(way, rule, lo, hi)
    assert bool(good.proved.any())
    for axis, number in ((0, 7), (3, 130)):
        hi[axis, number] = bad
    found = judged(way, rule, lo, hi)
    spoilt = np.array([7, 130])
    assert not bool(found.proved[spoilt].any()) and not bool((found.bound[spoilt] < 0).any())
    assert not bool(found.violated[spoilt].any()) and not bool(found.smooth[spoilt].any())
    rest = np.delete(np.arange(200), spoilt)
    assert np.array_equal(found.bound[rest], good.bound[rest])


@pytest.mark.parametrize("way", ["numpy", "compiled"])
def test_a_network_whose_sums_overflow_is_never_bounded(way: Way) -> None:
    network = cartpole_case().loop.network
    first, _, last = network.weights
    huge = type(network).of_layers(
        (first, np.full((24, 24), 1e308), last), network.biases, network.scale, network.offset, "identity", "none"
    )
    lo, hi = boxes(4, 40, 0.1)
    x = np.concatenate([((lo + hi) / 2)[:, None], np.eye(len(lo))[:, :, None] * ((hi - lo) / 2)], 1)
    with bounded(way):
        mid, slopes, error, _ = policies.LayersEnclosure(huge, [np.zeros(1)] * 4)(x, np.zeros_like(lo))
    assert not bool(np.isfinite(mid + slopes.sum(1) + error).any())


def test_the_rule_can_be_shipped_after_it_was_used() -> None:
    problem, T = LOOPS["uncertain"]()
    rule = VdotBound(problem, T)
    lo, hi = boxes(2, 100, 0.01)
    before = judged("compiled", rule, lo, hi)
    assert rule.tape is not None
    copy = pickle.loads(pickle.dumps(rule))
    for a, b in zip(before, judged("compiled", copy, lo, hi), strict=True):
        assert np.array_equal(a, b)


def test_threads_share_the_rule() -> None:
    problem, T = shipped("cartpole")
    rule = VdotBound(problem, T)
    lo, hi = boxes(4, 1500, 0.05)
    with bounded("compiled"), ThreadRunner(2).start(rule) as bound:
        pieces = bound(lo, hi, 1e-3, 10.0)
    for a, b in zip(pieces, judged("compiled", rule, lo, hi), strict=True):
        assert np.array_equal(a, b)


def test_the_loops_are_compiled_once_enough_was_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    loads = list[None]()
    monkeypatch.setattr(compiled, "load", lambda: loads.append(None) or kernels)
    wanted = Compiled(worth=100.0)
    assert wanted(9.0) is vectors and wanted(90.0) is vectors
    assert wanted(1.0) is kernels and wanted(0.0) is kernels
    assert loads == [None]


def test_without_numba_numpy_does_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "numba", None)
    wanted = Compiled(worth=0.0)
    assert wanted(1.0) is vectors and wanted(1.0) is vectors
    monkeypatch.setattr(compiled, "_of_process", wanted)
    problem, T = LOOPS["pendulum"]()
    lo, hi = boxes(2, 50, 0.01)
    assert np.isfinite(VdotBound(problem, T)(lo, hi, 1e-3, 10.0).bound).all()


def double(x: kernels.Line) -> None:
    for i in range(len(x)):
        x[i] = 2 * x[i]


def test_a_cache_that_cannot_be_written_is_done_without(monkeypatch: pytest.MonkeyPatch) -> None:
    njit, asked = numba.njit, []

    def refuses(*arguments: Any, cache: bool = False, **options: Any) -> Any:
        asked.append(cache)
        if cache:
            raise RuntimeError("cannot cache function: no locator available for file")
        return njit(*arguments, **options)

    monkeypatch.setattr(numba, "njit", refuses)
    monkeypatch.setitem(double.__annotations__, "x", "Line")
    numbers = np.arange(3.0)
    compiled.compile_one(numba.njit, double, {})(numbers)
    assert asked == [True, False] and numbers.tolist() == [0.0, 2.0, 4.0]


def test_the_kernels_know_the_constants_of_the_models() -> None:
    """numba takes them as they are when it compiles, so that they are written where it does."""
    assert (kernels.EPS, kernels.TINY, kernels.EXP_END) == (taylor.EPS, taylor.TINY, taylor.EXP_END)


def test_functions_that_are_not_those_of_libm_are_not_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numba.config, "USING_SVML", True)
    assert compiled.load() is None


@pytest.mark.slow
def test_a_short_search_does_not_import_numba() -> None:
    code = (
        "import sys, tempfile; from pathlib import Path; from certify import certify_roa;"
        f"found = certify_roa(None, {str(POLICIES / 'pendulum.pt')!r}, out=tempfile.mkdtemp());"
        "print(found.verdict.value, 'numba' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["PROVED", "False"]


@pytest.mark.parametrize("way", WAYS)
def test_a_tape_knows_every_function_of_the_grammar(way: Way) -> None:
    """A new one that only models know would end a search in an error, once loops are compiled."""
    for name in (*FUNCTIONS, "abs"):
        found = tape.recorded(1, lambda values, algebra, name=name: algebra.function(name, values[0]))
        assert len(found.steps) == (4 if name == "tan" else 1)
        given = [np.array([[[0.5], [0.25]]]), np.zeros((1, 1)), np.zeros((0, 1)), np.zeros((0, 1, 1)), np.zeros((0, 1))]
        result = [np.zeros(1), np.zeros((1, 1)), np.zeros((1, 1, 1)), np.zeros(1), np.zeros((1, 1))]
        with bounded(way):
            compiled.loops(1).play(found.steps, found.k, found.places, *given, np.zeros((0, 3)), *result)
        at_half = abs(0.5) if name == "abs" else getattr(math, name)(0.5)
        assert abs(result[0][0] - at_half) < 1e-15 and np.isfinite(result[3]).all()


def test_a_tape_plays_what_its_result_needs_and_uses_places_again() -> None:
    def calculation(values: Any, algebra: tape.Recording) -> tape.Value:
        values[0].sin()  # needed by nobody
        result = values[0]
        for _ in range(20):
            result = (result * values[0]).shifted(1.0)
        return result

    found = tape.recorded(1, calculation)
    assert len(found.steps) == 40 and found.places == 3
    for _, left, right, to in found.steps:
        assert to not in (left, right)
    assert not any(operation == tape.SIN for operation, *_ in found.steps)


@pytest.mark.parametrize("place", range(5))
def test_a_tape_allows_for_the_same_rounding_as_models(place: int) -> None:
    """States, the input, the uncertain quantities: each alone, in a sum, shifted, where only rounding is left."""
    system = uncertain_pendulum()
    n, m = system.n, system.m
    generator = np.random.default_rng(5)
    x, error, mid, slopes, wide = (
        np.array(generator.random((*shape, 40))) for shape in ((n, n + 1), (n,), (m,), (m, n), (m,))
    )
    known = loop_models(system, x, 1e-15 * error, mid, slopes, wide)
    values = [*known.states.values(), *known.inputs.values(), *known.quantities.values()]
    assert len(values) == 5
    for calculate in (
        lambda v: v[place].scaled(1.0),
        lambda v: v[place] + v[(place + 1) % 5],
        lambda v: v[place].shifted(0.3),
    ):
        found, _ = played(
            vectors, tape.recorded(5, lambda v, _, f=calculate: f(v)), system, x, 1e-15 * error, mid, slopes, wide
        )
        model = calculate(values)
        for part in ("c", "g", "Q"):
            assert np.array_equal(getattr(found, part), getattr(model, part))
        assert (np.abs(found.r - model.r) <= 1e-9 * model.r).all()
