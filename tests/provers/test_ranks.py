"""The search for ranks: images hold trajectories, only leaves that lead to the set get a rank, checkers accept it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flint import fmpq, fmpq_mat

from certify import certify_roa
from certify.certificates import RankTree, run_checker
from certify.certificates.claims import UNPROVED
from certify.certificates.ranked import Ranked, steps_from
from certify.certificates.verdict import Verdict
from certify.effort import UNIT, UNLIMITED, Effort
from certify.errors import OptionError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import Number, symbols
from certify.loop.plants import System
from certify.loop.policies import PolicyNetwork
from certify.lyapunov.function import Quadratic
from certify.provers.bounds import Taylor
from certify.provers.execution import Runner, ThreadRunner, rows
from certify.provers.ranks import (
    Enough,
    Question,
    RankProof,
    Sublevel,
    prove_ranks,
    root_box,
    with_errors,
    with_frame,
    without_leaf,
)
from certify.provers.ranks.cover import Cover
from certify.provers.ranks.images import Course, Form
from certify.provers.ranks.search import COUNTS, Search
from certify.provers.ranks.wanted import Wanted
from tests.support.jobs import PlayedRunner, Troupe
from tests.support.loops import box
from tests.support.marks import slow_after
from tests.support.ranks import hanging

PERIOD = Fraction(1, 10)


def bistable(time: str = "discrete") -> tuple[System, PolicyNetwork]:
    """Trajectories with |x| < 1 end at 0, others leave; a policy that gives nothing."""
    x, u = symbols("x u")
    pulled = x * x * x - x + u
    discrete = time == "discrete"
    system = System(
        name="bistable",
        states=(x,),
        inputs=(u,),
        parameters={},
        dynamics=(x + pulled / 5,) if discrete else (pulled,),
        u_eq=(Number(0),),
        domain=box(2),
        input_bounds=box(1),
        time="discrete" if discrete else "continuous",
        sample=None if discrete else (PERIOD / 2, PERIOD),
    )
    weights, zeros = (np.zeros((1, 1)),), (np.zeros(1),)
    return system, PolicyNetwork.of_layers(weights, zeros, np.ones(1), np.zeros(1), "identity", "none")


def swinging() -> tuple[System, PolicyNetwork]:
    """The hanging pendulum under a small tanh network."""
    system, _ = hanging()
    generator = np.random.default_rng(5)
    weights = (generator.normal(size=(8, 2)) / 2, generator.normal(size=(1, 8)) / 4)
    biases = (generator.normal(size=8) / 2, np.zeros(1))
    network = PolicyNetwork.of_layers(weights, biases, np.ones(1), np.zeros(1), "tanh", "output")
    return replace(system, angles=()), network


def question(loop: tuple[System, PolicyNetwork], level: float) -> Question:
    closed = ClosedLoop(*loop)
    target = Sublevel(Quadratic(np.eye(loop[0].n)), level)
    return Question(closed, target, (), root_box(closed))


def proved(loop: tuple[System, PolicyNetwork], level: float, effort: float = 0.2, **changes: Any) -> RankProof:
    found = prove_ranks(question(loop, level), Effort(effort * UNIT), ThreadRunner(**changes))
    assert found is not None
    return found


def leaves_of(tree: RankTree) -> list[tuple[list[float], list[float]]]:
    """The corners of the leaves, in preorder."""
    waiting, found = [(tree.lo.tolist(), tree.hi.tolist())], []
    for axis in tree.tree:
        lo, hi = waiting.pop()
        if axis == 255:
            found.append((lo, hi))
            continue
        left, right = list(hi), list(lo)
        left[axis] = right[axis] = 0.5 * lo[axis] + 0.5 * hi[axis]
        waiting += [(right, hi), (lo, left)]
    return found


TROUPES: dict[str, Callable[[], Troupe]] = {
    "three places in any order": lambda: Troupe(places=lambda _: 3, seed=1),
    "jobs are lost": lambda: Troupe(play=lambda job, answer: answer if sum(job) % 2 else None, seed=2),
    "the scheduler is lost": lambda: Troupe(lost_after=5),
    "one place": lambda: Troupe(places=lambda _: 1),
    "two places": Troupe,
    "all places are lost": lambda: Troupe(places=lambda asked: 2 if asked < 9 else 0),
    "answers are cut": lambda: Troupe(play=lambda job, answer: answer[:-1]),
    "answers are too short": lambda: Troupe(play=lambda job, answer: rows.sealed(job, b"")),
}


@pytest.mark.parametrize(("name", "effort"), slow_after(3, [(name, e) for e in (0.05, 0.2) for name in TROUPES]))
@pytest.mark.parametrize("loop", [bistable(), hanging()], ids=["bistable", "hanging"])
def test_ranks_are_the_same_whoever_follows_the_boxes(
    loop: tuple[System, PolicyNetwork], name: str, effort: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("certify.provers.execution.shared._WORTH", 0.0)
    made, left = TROUPES[name](), list[float]()

    def prove(runner: Runner) -> RankProof:
        given = Effort(effort * UNIT)
        found = prove_ranks(question(loop, 0.01), given, runner)
        left.append(given.left)
        assert found is not None
        return found

    expected, found = prove(ThreadRunner()), prove(PlayedRunner(made))
    one, other = found.evidence, expected.evidence
    assert one.tree == other.tree
    assert np.array_equal(one.ranks, other.ranks) and np.array_equal(one.steps, other.steps)
    counts = ("share", "boxes", "rounds", "done")
    assert [getattr(found, c) for c in counts] == [getattr(expected, c) for c in counts] and left[0] == left[1]
    assert made.answered > (1 if name == "one place" else 3) and (made.refused > 0) == name.startswith("answers")


FRAMES = {1: np.array([[-3.0]]), 2: np.array([[1.0, 0.5], [-3.0, 2.0]])}


def followed(loop: tuple[System, PolicyNetwork], frame: np.ndarray | None, memory: int = 1) -> Course:
    """Boxes of a wide root box, whose errors are bounded in this frame."""
    n = loop[0].n
    root = np.full(n, -2.0), np.full(n, 2.0)
    return replace(question(loop, 0.01), root=root, frame=frame, memory=memory).course(COUNTS)


@pytest.mark.parametrize("memory", [1, 3])
@pytest.mark.parametrize("framed", [False, True])
@pytest.mark.parametrize("loop", [bistable(), bistable("held"), hanging(), swinging()])
def test_images_hold_trajectories(loop: tuple[System, PolicyNetwork], framed: bool, memory: int) -> None:
    system, _ = loop
    generator, n = np.random.default_rng(3), system.n
    course = followed(loop, FRAMES[n] if framed else None, memory)
    centre = generator.uniform(-0.7, 0.7, (n, 200))
    radius = generator.uniform(1e-4, 0.05, (n, 200))
    slopes = np.eye(n)[:, :, None] * radius
    form = Form(np.concatenate([centre[:, None], slopes, *memory * [0 * slopes]], 1))
    d = np.sign(generator.normal(size=(n, 200))) * generator.random((n, 200)) ** 0.2
    x, f = (centre + radius * d).T, system.function()
    for _ in range(12):
        form, _, kept, _ = course.step(form)
        if system.sample is None:
            x = f(x, ClosedLoop(*loop).policy(x))
        else:
            h = float(PERIOD) * generator.uniform(0.5, 1.0, (200, 1))
            x = held(f, x, ClosedLoop(*loop).policy(x), h)
        lo, hi = form.box
        assert np.all(kept)
        assert np.all((lo <= x.T + 1e-12) & (hi + 1e-12 >= x.T))
        away = course.errors.into[:, :, 0] @ (x.T - form.x[:, 0] - (form.x[:, 1 : n + 1] * d).sum(1))
        bounds = np.abs(np.einsum("ij,jkb->ikb", course.errors.into[:, :, 0], form.x[:, n + 1 :])).sum(1)
        assert np.all(np.abs(away) <= bounds + 1e-12)


@pytest.mark.parametrize("loop", [bistable(), swinging()])
def test_images_are_the_same_in_any_pieces(loop: tuple[System, PolicyNetwork]) -> None:
    """Models among many symbols are large, and few boxes at a time have to be followed then."""
    course, rng = followed(loop, None, 3), np.random.default_rng(0)
    lo = rng.uniform(-0.4, 0.4, (loop[0].n, 37))
    hi = lo + rng.uniform(1e-3, 1e-2, lo.shape)
    assert course.most == 512
    whole = course(lo, hi, 0.0, 0.0)
    course.most = 4
    for at_once, in_pieces in zip(whole, course(lo, hi, 0.0, 0.0), strict=True):
        np.testing.assert_array_equal(at_once, in_pieces)


def test_many_symbols_are_followed_for_few_boxes_at_a_time() -> None:
    course = followed(swinging(), None, 60)
    assert course.most * course.symbols**2 <= 2**16 and course.most >= 2


@pytest.mark.parametrize("seed", range(5))
def test_errors_in_a_frame_that_is_nearly_singular_are_not_less_than_they_are(seed: int) -> None:
    """The inverse in binary64 is wrong by the frame's condition."""
    generator = np.random.default_rng(seed)
    frame = np.array([[1.0, 1.0], [1.0, 1.0 + 1e-7]]) * generator.uniform(0.5, 1.0, (2, 1))
    course = followed(swinging(), frame)
    rest = [Taylor(np.zeros(1), np.zeros((7, 1)), np.zeros((7, 7, 1)), r) for r in generator.uniform(0, 1, (2, 1))]
    found = np.abs(course.errors.form(rest, course.symbols).x[:, 3:, 0]).sum(1)
    exact = fmpq_mat([[fmpq(*v.as_integer_ratio()) for v in row] for row in frame.tolist()]).inv().tolist()
    bound = np.abs(frame) @ np.array([v.r[0] for v in rest])
    assert np.all(
        found >= [sum(abs(int(v.p) / int(v.q)) * b for v, b in zip(row, bound, strict=True)) for row in exact]
    )


def steep(rate: int, period: Fraction) -> Question:
    """x' = y, y' = rate x + u with u = 200 tanh(-5 x - 3/10 y) held over a period."""
    x, y, u = symbols("x y u")
    system = System(
        name="steep",
        states=(x, y),
        inputs=(u,),
        parameters={},
        dynamics=(y, rate * x + u),
        u_eq=(Number(0),),
        domain=box(2, 2),
        input_bounds=box(10**9),
        sample=(period, period),
    )
    weights, zeros = (np.array([[-5.0, -0.3]]), np.full((1, 1), 200.0)), np.zeros(1)
    network = PolicyNetwork.of_layers(weights, (zeros, zeros), np.ones(1), zeros, "identity", "none")
    return question((system, network), 0.01)


def test_a_frame_is_taken_where_images_are_narrower_in_it() -> None:
    """A steep loop's errors grow in the states' own coordinates; a step whose map overflows has no other ones."""
    probes = np.random.default_rng(0).uniform(-1, 1, (2, 30))
    effort = Effort()
    found = with_frame(steep(0, Fraction(1, 40)), probes / 10, effort)
    assert effort.spent >= 2 * 30 * found.course((1,)).operations  # a step from each state, in both frames
    assert found.frame is not None
    M = np.eye(2) + found.loop.step * found.loop.mean_rate()
    turned = found.frame @ M @ np.linalg.inv(found.frame)
    assert max(np.abs(np.linalg.eigvals(np.abs(M)))) > 0.99 > 0.6 > max(np.abs(np.linalg.eigvals(np.abs(turned))))
    assert with_frame(steep(10**6, Fraction(5)), probes, UNLIMITED).frame is None


def turning_slowly() -> Question:
    """x+ = 0.95 R x + small terms of second order, R a rotation by 0.3: what boxes make of it, a rotation at a time."""
    x, y, u = symbols("x y u")
    c, s = (Fraction(round(v * 10**6), 10**6) for v in (0.95 * np.cos(0.3), 0.95 * np.sin(0.3)))
    system = System(
        name="turning",
        states=(x, y),
        inputs=(u,),
        parameters={},
        dynamics=(Number(c) * x - Number(s) * y + x * y / 4, Number(s) * x + Number(c) * y + x * x / 8 + u),
        u_eq=(Number(0),),
        domain=box(2, 2),
        input_bounds=box(1),
        time="discrete",
    )
    network = PolicyNetwork.of_layers((np.zeros((1, 2)),), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none")
    return question((system, network), 0.01)


def test_errors_are_followed_where_that_is_worth_its_price() -> None:
    turning, straight = turning_slowly(), question(bistable(), 0.01)
    begin = np.array([[0.5], [0.2]])
    box, effort = (begin - 0.05, begin + 0.05), Effort()
    found = with_errors(turning, *box, 45, effort)
    assert found.moving and found.memory == 1
    assert effort.spent >= 45 * found.course((1,)).operations
    found = with_errors(straight, np.array([[0.1]]), np.array([[0.11]]), 10, UNLIMITED)
    assert found.memory == 1 and not found.moving


def test_nothing_else_is_tried_when_the_effort_is_over() -> None:
    """More memory takes more operations a step: one image is all that a run without effort is charged with."""
    turning, begin = turning_slowly(), np.array([[0.5], [0.2]])
    box, effort = (begin - 0.05, begin + 0.05), Effort(1.0)
    assert with_errors(turning, *box, 45, effort) == replace(turning, moving=False, memory=1)
    course = turning.course(range(1, 46))
    assert effort.spent == course.cost(course(*box, 0.0, 0.0))


def test_directions_that_move_follow_a_turn() -> None:
    """A box that turns and shrinks does so; in directions that stand still its errors grow until no image is left."""
    turning, begin = turning_slowly(), np.array([[0.5], [0.2]])
    box = (begin - 0.01, begin + 0.01)
    still, moving = (replace(turning, moving=m).course((20, 300))(*box, 0.0, 0.0) for m in (False, True))
    assert not still.known[1].any() and moving.known.all() and np.all(moving.widths[1] < 1e-6)
    x, y = box[0] + np.random.default_rng(0).uniform(size=(2, 500)) * (box[1] - box[0])
    c, s = (round(v * 10**6) / 10**6 for v in (0.95 * np.cos(0.3), 0.95 * np.sin(0.3)))
    for k in range(1, 301):
        x, y = c * x - s * y + x * y / 4, s * x + c * y + x * x / 8
        for at in np.flatnonzero(np.array([20, 300]) == k):
            lo, hi = moving.lo[at, 0], moving.hi[at, 0]
            assert np.all((lo <= [x, y]) & (hi >= [x, y]))


def test_a_box_whose_parts_lead_straight_there_has_a_tree_of_its_own() -> None:
    """One that is looked at in vain, or not at all, has one of the domain; both have ranks for all of the box."""
    asked = replace(turning_slowly(), memory=4)
    lo, hi = np.array([0.5, 0.2]), np.array([0.6, 0.3])
    for direct, own in ((100, True), (0, False)):
        wanted = Wanted(lo, hi, direct=direct, arrivals=(45,))
        found = prove_ranks(asked, Effort(UNIT), ThreadRunner(), wanted=wanted)
        assert found is not None and found.done
        corners = found.evidence.lo.tolist(), found.evidence.hi.tolist()
        assert (corners == (lo.tolist(), hi.tolist())) is own
        box_ = tuple((Fraction(a), Fraction(b)) for a, b in zip(lo.tolist(), hi.tolist(), strict=True))
        assert steps_from(Ranked(found.evidence, None, ()), box_) is not None
    short = Wanted(np.array([-1.5, -1.5]), np.array([1.5, 1.5]), direct=3, arrivals=(1,))
    other = prove_ranks(asked, Effort(UNIT / 100), ThreadRunner(), wanted=short)
    assert other is None or other.evidence.lo.tolist() != [-1.5, -1.5]


def held(f: Any, x: np.ndarray, u: np.ndarray, h: np.ndarray, steps: int = 50) -> np.ndarray:
    """The solution after the periods h, by the classical method of Runge and Kutta."""
    h = h / steps
    for _ in range(steps):
        a = f(x, u)
        b = f(x + h / 2 * a, u)
        c = f(x + h / 2 * b, u)
        x = x + h / 6 * (a + 2 * b + 2 * c + f(x + h * c, u))
    return x


@pytest.mark.parametrize("time", ["discrete", "held"])
def test_nothing_beyond_the_basin_has_a_rank(time: str) -> None:
    found = proved(bistable(time), 0.01)
    ends = [
        (lo[0], hi[0])
        for (lo, hi), rank in zip(leaves_of(found.evidence), found.evidence.ranks, strict=True)
        if rank < UNPROVED
    ]
    assert max(max(abs(lo), abs(hi)) for lo, hi in ends) < 1
    assert max(hi for _, hi in ends) > 0.99
    assert min(lo for lo, _ in ends) < -0.99


def test_a_target_that_nothing_reaches_gives_no_ranks() -> None:
    x, u = symbols("x u")
    system, network = bistable()
    loop = replace(system, dynamics=(2 * x + u,)), network
    assert prove_ranks(question(loop, 1e-9), Effort(UNIT / 10), ThreadRunner()) is None


def test_ranks_fall_along_trajectories() -> None:
    """Simulated from the corners and middles of leaves: in the target after as many steps as the rank is."""
    loop = hanging()
    found = proved(loop, 0.05)
    tree, f = found.evidence, loop[0].function()
    leaves = [leaf for leaf, rank in zip(leaves_of(tree), tree.ranks, strict=True) if 0 < rank < UNPROVED]
    ranks = np.array([rank for rank in tree.ranks if 0 < rank < UNPROVED])
    corners = np.array(leaves).transpose(1, 0, 2)
    for share in (0.0, 0.5, 1.0):
        x = corners[0] + share * (corners[1] - corners[0])
        late = np.ones(len(x), dtype=bool)
        for step in range(1, int(ranks.max()) + 1):
            x = f(x, np.zeros((len(x), 1)))
            place = np.column_stack([x[:, 0] - 2 * np.pi * np.rint(x[:, 0] / (2 * np.pi)), x[:, 1]])
            late &= ~((place**2).sum(1) <= 0.05 * (1 + 1e-9))
            assert not np.any(late & (ranks == step))
    assert found.share > 0.9


def test_any_number_of_threads_finds_the_same() -> None:
    one, two = (proved(hanging(), 0.05, threads=threads) for threads in (1, 2))
    assert (one.evidence.tree, one.share) == (two.evidence.tree, two.share)
    assert np.array_equal(one.evidence.ranks, two.evidence.ranks)
    assert np.array_equal(one.evidence.steps, two.evidence.steps)


def test_more_effort_proves_more() -> None:
    assert proved(hanging(), 0.05, 0.02).share < proved(hanging(), 0.05, 0.6).share


def test_without_a_leaf_higher_ranks_go() -> None:
    tree = RankTree(
        np.zeros(1), np.ones(1), b"\x00\x00\xff\xff\xff", np.array([0, 3, 5], np.uint16), np.array([0, 3, 2], np.uint16)
    )
    left = without_leaf(tree, 2)
    assert left is not None
    assert left.ranks.tolist() == [0, 3, UNPROVED]
    assert left.steps.tolist() == [0, 3, 0]
    assert without_leaf(tree, 1) is None


def test_boxes_across_a_seam_meet_leaves_on_both_sides() -> None:
    cover = Cover(np.array([-3.1416]), np.array([3.1416]), [0])
    halves = cover.halve(np.array([0]), np.array([0]))
    cover.halve(halves, np.array([0, 0]))
    lo, hi = np.array([[3.0, 3.0 + 4 * np.pi, -0.1, 0.0]]), np.array([[3.3, 3.3 + 4 * np.pi, 7.0, 0.1]])
    inside, box_of, leaf = cover.met_by(lo, hi)
    met = [sorted(set(cover.low[0, leaf[box_of == k]].round(2))) for k in range(4)]
    assert np.all(inside)
    assert met == [[-3.14, 1.57], [-3.14, 1.57], [-3.14, -1.57, 0.0, 1.57], [-1.57, 0.0]]


@pytest.mark.parametrize("loop", [bistable(), bistable("held"), hanging()])
def test_a_run_with_ranks_is_accepted(loop: tuple[System, PolicyNetwork], tmp_path: Path) -> None:
    result = certify_roa(*loop, out=tmp_path, ranks=True, effort=0.004, level=0.05)
    assert result.verdict is Verdict.PROVED
    assert result.ranks is not None
    assert result.ranks.volume > result.volume
    for program in ("checker", "reference")[: 2 if loop[0].n == 1 else 1]:
        answer = run_checker(tmp_path / "certificate.json", program=program)
        assert answer["result"] == "ACCEPTED", answer


def test_ranks_need_steps(tmp_path: Path) -> None:
    system, network = bistable("held")
    with pytest.raises(OptionError, match="time goes in steps"):
        certify_roa(replace(system, sample=None), network, out=tmp_path, ranks=True)
    with pytest.raises(OptionError, match="without a tube"):
        certify_roa(system, network, out=tmp_path, ranks=True, enlarge=True)


def sheared() -> tuple[System, PolicyNetwork]:
    """Trajectories with |x| < 1 and |y| < 1 end at 0, others leave; x and y are seen as their half sum and half
    difference, so that no box of a tree is their region."""
    a, b, u = symbols("a b u")
    pulled = [v * v * v - v for v in (a + b, a - b)]
    system = System(
        name="sheared",
        states=(a, b),
        inputs=(u,),
        parameters={},
        dynamics=(a + (pulled[0] + pulled[1]) / 10 + u, b + (pulled[0] - pulled[1]) / 10),
        u_eq=(Number(0),),
        domain=box(2, 2),
        input_bounds=box(1),
        time="discrete",
    )
    return system, PolicyNetwork.of_layers(
        (np.zeros((1, 2)),), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none"
    )


def converge(x: np.ndarray) -> np.ndarray:
    """True for the states of that region."""
    return np.asarray(np.abs(x).sum(-1) < 1)


def test_the_first_image_counts_however_wide_it_is() -> None:
    """A leaf without any image would never be halved; later images are of use for what is beside them alone."""
    asked = question(sheared(), 0.01)
    course = asked.course((1, 2))
    found = course(np.full((2, 1), 0.1), np.full((2, 1), 0.9), 0.0, 0.0)
    lo, hi = asked.root
    assert np.any(found.widths[0, :, 0] > 0.15 * (hi - lo))
    assert np.all(np.isnan(found.widths[1])) and not found.loose[0] and found.taken[0] == 2


def test_a_search_ends_where_enough_states_have_a_rank() -> None:
    asked, states = question(sheared(), 0.01), np.random.default_rng(0).uniform(-1, 1, (2, 400))
    states = states[:, converge(states.T)]

    def of(count: int) -> RankProof:
        found = prove_ranks(asked, Effort(0.5 * UNIT), ThreadRunner(), enough=Enough(states, count))
        assert found is not None
        return found

    half, most = len(states.T) // 2, len(states.T) * 9 // 10
    some, more = of(half), of(most)
    assert some.boxes < more.boxes and not some.done
    ranked = np.isfinite(Ranked(some.evidence, None, ()).ranks_at(states.T))
    assert half <= ranked.sum() < most


def test_leaves_of_which_a_part_may_pass_wait_until_their_first_step_leads_to_a_rank() -> None:
    """Of two leaves whose steps may leave the domain one leads to a leaf with a rank, the other to itself."""
    asked = question(sheared(), 0.01)
    search = Search(asked.course(COUNTS), *asked.root)
    new = search.halve(
        search.halve(np.zeros(1, dtype=np.int64), np.zeros(1, dtype=np.int64)), np.zeros(2, dtype=np.int64)
    )
    order = new[np.argsort(search.cover.low[0, new])]
    search.rank[order[0]] = 1
    search.loose[order[2:]] = True
    for leaf, towards in ((order[2], order[0]), (order[3], order[3])):
        search.first[0, :, leaf], search.first[1, :, leaf] = search.cover.low[:, towards], search.cover.high[:, towards]
    assert search.spread().tolist() == [order[2]] and search.part[order[2]] == 1 and search.part[order[3]] == 0
    search.first[1, 0, order[3]] = np.inf  # it may lead anywhere
    assert set(search.spread()) == {order[2], order[3]}


def test_leaves_without_a_promising_state_wait() -> None:
    """The same share takes less work, which a guide that knows nothing does not change."""
    asked = question(sheared(), 0.01)
    plain, guided, blind = (
        prove_ranks(asked, Effort(0.5 * UNIT), ThreadRunner(), promising=promising)
        for promising in (None, converge, lambda x: np.zeros(len(x), dtype=bool))
    )
    assert plain is not None and guided is not None and blind is not None
    assert 0.95 < guided.share / plain.share < 1.05 and blind.evidence.tree == plain.evidence.tree
    assert guided.boxes < 0.9 * plain.boxes
    corners = np.array(leaves_of(guided.evidence))[guided.evidence.proved]
    assert np.all(converge(corners.mean(1)))


def test_boxes_are_followed_as_far_as_the_effort_allows_and_the_shortest_run_needs() -> None:
    wanted = Wanted(np.zeros(1), np.ones(1), arrivals=(40, 100))
    assert wanted.straight(1000) == tuple(range(38, 153))
    assert wanted.straight(90) == tuple(range(38, 91))
    assert wanted.straight(10) == tuple(range(38, 63))
