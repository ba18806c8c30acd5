"""The proof of ranks: a search is run until nothing is left to gain, or its effort is over."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from certify.certificates import RankTree
from certify.certificates.claims import Ranks
from certify.effort import Effort
from certify.errors import InputError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import Expression
from certify.provers.bounds.arrays import Array
from certify.provers.execution import Runner
from certify.provers.execution.shared import shared
from certify.provers.ranks.images import Course, Images
from certify.provers.ranks.remaining import Remaining
from certify.provers.ranks.search import COUNTS, Promising, Search
from certify.provers.ranks.targets import TURN, Target
from certify.provers.ranks.wanted import COUNTS_FROM, MOST_STEPS, Direct, SearchFrom, Wanted

_HALF_TURN = 3.1416  # and a little more
_SLIVER, _SAMPLES = 1e-6, 64
_ORDERS = (2, 3, 4, 5, 6, 7, 8)
_LITTLE, _GAIN = 1e-7, 0.5  # share of the root box that an error may be; a gain that is worth an order
_OF_A_PAIR, _OF_A_LEAF = 500.0, 50_000.0  # operations, beside those of the steps
_SMALL, _LOST = 0.002, 1e3  # half-width of a box, as a share of the root box's width; growth that counts for no image
_DEPENDENT = 1e8  # condition of a frame that is of no use
_MEMORIES = (1, 2, 4, 8)
_WORTH = 0.2  # logarithm of a gain in cost below which directions do not move: two programs turn them differently
_THERE = 1e-6  # width of an image in the target, as a share of the root box's
_COUNTS_BACK = COUNTS[:7]  # the leaf itself or its neighbours are not far away
_BOXES, _STEPS = 1_000, 255  # that are followed straight to the target, as far as the effort allows; at least so far
_AT_FIRST = 0.1  # share of the effort for the first tree


@dataclass(frozen=True, slots=True)
class Question:
    """From which leaves of a box do trajectories reach a target?

    Parameters
    ----------
    loop, target : the loop, and the set that is to be reached.
    keep : expressions that stay negative on the way.
    root : corners lo and hi (n,) of the box, in deviations; of an angle more than a turn apart.
    order : of the series in time, where inputs are held.
    frame : N, (n, n), in whose coordinates N x errors of images are bounded; None: in those of the states.
    moving : they are bounded in directions that turn with them.
    memory : the number of steps for which errors of images stay symbols.
    """

    loop: ClosedLoop
    target: Target
    keep: tuple[Expression, ...]
    root: tuple[Array, Array]
    order: int = 2
    frame: Array | None = None
    moving: bool = False
    memory: int = 1

    def course(self, counts: Sequence[int], kept: int | None = None) -> Course:
        """The course of boxes through the loop, with images after so many steps, of the first `kept` or all."""
        (lo, hi), angles = self.root, turning(self.loop)
        by = self.order, self.frame, self.moving, self.memory
        return Course(self.loop, self.target, angles, self.keep, hi - lo, counts, kept, *by)


def with_order(
    question: Question, x: Array, effort: Effort, little: float = _LITTLE, leaves: int = 0, most: float = math.inf
) -> Question:
    """The question with the lowest order of the series in time, from its own on, that leaves an error of `little` of
    the root box at states x (n, N), or with the last one that still gained something; as it is where no input is
    held. So many other leaves, which take steps of the same order, may cost `most` operations."""
    system = question.loop.system
    if system.sample is None or system.calls:
        return replace(question, order=1)
    best, least = question, math.inf
    for order in (k for k in _ORDERS if k >= question.order):
        asked = replace(question, order=order)
        course = asked.course((1,))
        if leaves * course.operations > most:
            break
        found = _images(course, x, x, effort)
        widths = (found.widths[0] / (question.root[1] - question.root[0])[:, None]).max(0)
        width = float(np.nanmedian(widths)) if np.any(np.isfinite(widths)) else math.inf
        if width < _GAIN * least or least == math.inf:
            best, least = asked, width
        if least < little:
            break
    return best


def with_frame(question: Question, x: Array, effort: Effort) -> Question:
    """The question with the frame in which images of small boxes around states x (n, N) are the narrowest: that of the
    states, or the left eigenvectors of the step's linear map at the origin, if there is one."""
    frame = _eigenframe(question.loop)
    if frame is None:
        return question
    reach = _SMALL * (question.root[1] - question.root[0])[:, None]

    def widths(asked: Question) -> float:
        found = _images(asked.course(COUNTS), x - reach, x + reach, effort)
        relative = found.widths / reach[None]
        return float(np.where(found.arrived, 0.0, np.log(np.nan_to_num(relative.max(1), nan=_LOST))).sum())

    other = replace(question, frame=frame)
    return other if widths(other) < widths(question) else question


def with_errors(
    question: Question, lo: Array, hi: Array, steps: int, effort: Effort, weights: Array | None = None
) -> Question:
    """The question with the way to bound errors that is worth most for boxes (n, B), of these weights (B,), that are to
    be in the target after so many steps: how long they stay symbols, and if their directions move. The boxes that are
    needed grow with the root of an image's width in each state, and each has its operations."""
    root = (question.root[1] - question.root[0])[:, None]

    best, least = question, math.inf
    for memory, moving in product(_MEMORIES, (False, True)):
        asked = replace(question, memory=memory, moving=moving)
        course = asked.course(range(1, steps + 1))
        found = _images(course, lo, hi, effort)
        widths = np.nan_to_num((found.widths[-1] / root).max(0), nan=1.0)
        boxes = np.average(np.log(np.where(found.arrived.any(0), _THERE, widths)), weights=weights) * len(lo) / 2
        cost = boxes + math.log(course.operations)
        if cost < least - (_WORTH if moving else 0.0):
            best, least = asked, cost
        if np.all(found.arrived.any(0)) or effort.over:  # more memory has more operations, and no fewer boxes
            break
    return best


def affordable(question: Question, effort: Effort) -> int:
    """The steps over which a thousand boxes may be followed with the effort; neither few nor very many."""
    return int(np.clip(effort.left / (_BOXES * question.course((1,)).operations), _STEPS, MOST_STEPS))


def _images(course: Course, lo: Array, hi: Array, effort: Effort) -> Images:
    """Images of boxes (n, B), whose steps are charged."""
    found = course(lo, hi, 0.0, 0.0)
    effort.charge(course.cost(found))
    return found


def _eigenframe(loop: ClosedLoop) -> Array | None:
    """Left eigenvectors (n, n) of a step's map at the origin, real and imaginary parts; None where there is no map, its
    numbers are too large, or they are nearly dependent."""
    try:
        with np.errstate(all="ignore"):
            rate = loop.mean_rate()
    except InputError:  # no Jacobian
        return None
    if not np.all(np.isfinite(rate)):
        return None
    values, vectors = np.linalg.eig(np.eye(len(rate)) + loop.step * rate.T)
    rows = [v.imag if value.imag < 0 else v.real for value, v in zip(values, vectors.T, strict=True)]
    frame: Array = np.stack(rows) / np.abs(rows).max(1, keepdims=True)
    return frame if np.all(np.isfinite(frame)) and np.linalg.cond(frame) < _DEPENDENT else None


@dataclass(frozen=True, slots=True)
class Enough:
    """The end of a search: so many of some states (n, N) have a rank."""

    states: Array
    count: int


@dataclass(frozen=True, slots=True)
class RankProof:
    """Leaves from which the target is reached, with their evidence.

    Parameters
    ----------
    ranks, evidence : as the claim and the certificate have them.
    share : of the root box's volume.
    leaves : of finite rank; `boxes` were looked at, in `rounds` rounds.
    done : no leaf is left whose halves could gain anything, or the box that was wanted is proved.
    full : the search ended because leaves, or those that images meet, are too many: more effort finds the same.
    """

    ranks: Ranks
    evidence: RankTree
    share: float
    leaves: int
    boxes: int
    rounds: int
    done: bool
    full: bool = False


def turning(loop: ClosedLoop) -> list[int]:
    """The plant's angles, by their numbers, if the policy is the same after a turn of each of them at samples; else
    none: a policy that reads an angle itself counts turns."""
    system = loop.system
    angles = [i for i, s in enumerate(system.states) if s.name in system.angles]
    x = np.random.default_rng(0).uniform(-1, 1, (_SAMPLES, system.n))
    u = loop.policy(x)
    moved = (loop.policy(x + TURN * np.eye(system.n)[i]) for i in angles)
    return angles if all(np.allclose(u, v, rtol=1e-9, atol=1e-9) for v in moved) else []


def root_box(loop: ClosedLoop) -> tuple[Array, Array]:
    """The box of places of a plant, corners (n,): a turn of each angle around 0, of other states the domain but for a
    sliver along its ends."""
    system, turns = loop.system, turning(loop)
    ends = np.array([[float(end) for end in pair] for pair in system.domain])
    inwards = _SLIVER * np.abs(ends).max(1)
    lo, hi = ends[:, 0] + inwards, ends[:, 1] - inwards
    angles = np.isin(np.arange(system.n), turns)
    return np.where(angles, -_HALF_TURN, lo), np.where(angles, _HALF_TURN, hi)


def prove_ranks(
    question: Question,
    effort: Effort,
    runner: Runner,
    report: Callable[[float, int, int], None] | None = None,
    wanted: Wanted | None = None,
    enough: Enough | None = None,
    promising: Promising | None = None,
) -> RankProof | None:
    """Prove from which leaves of a box trajectories reach a target.

    Parameters
    ----------
    report : called after every round with the share that is proved, the boxes looked at, and the leaves that wait.
    wanted : a box on which alone it depends; the search ends once it is proved.
    enough : ends the search before nothing is left to gain.
    promising : says which states (N, n) seem to reach the target, so that leaves without any wait.

    Returns
    -------
    RankProof | None : None if no leaf beyond the target has a rank, and no leaf of a box that was wanted.
    """
    if wanted is None:
        searches = [Search(question.course(COUNTS), *question.root, promising)]
    else:
        searches = [SearchFrom(question.course(COUNTS_FROM), *question.root, wanted)]
        if wanted.direct:
            counts = wanted.straight(affordable(question, effort))
            searches.insert(0, Direct(question.course(counts, 0), *question.root, wanted))
    boxes = rounds = 0
    for search in searches:
        with shared(runner, search.course) as bound:
            more, done = _grow(search, bound, effort, report, enough)
        boxes, rounds = boxes + search.boxes, rounds + more
        if done or effort.over or not search.hopeless:
            break
    search.tighten()
    tree = search.evidence()
    if not np.any(tree.steps if wanted is None else tree.proved):
        return None
    return _proof(search, tree, boxes, rounds, done)


def prove_remaining(
    question: Question,
    seeds: Array,
    effort: Effort,
    runner: Runner,
    report: Callable[[float, int, int], None] | None = None,
) -> tuple[RankProof, Callable[[int], tuple[RankTree, Ranks] | None]] | None:
    """Prove which leaves of a box are never left; the target of the question is nothing.

    Parameters
    ----------
    seeds : states (n, N) that runs come to.
    report : as that of `prove_ranks`.

    Returns
    -------
    tuple[RankProof, Callable] | None : the leaves, and what is left of them without the one of this number; None if
        there are no such leaves.
    """
    course = question.course(_COUNTS_BACK)
    search = Remaining(course, *question.root, seeds)
    with shared(runner, course) as bound:
        rounds, done = _grow(search, bound, effort, report, None)
    search.tighten()
    tree = search.evidence()
    if not np.any(tree.proved):
        return None

    def without(leaf: int) -> tuple[RankTree, Ranks] | None:
        if not search.without(leaf):
            return None
        left = search.evidence()
        return left, _ranks(search, left)

    return _proof(search, tree, search.boxes, rounds, done), without


def _proof(search: Search, tree: RankTree, boxes: int, rounds: int, done: bool) -> RankProof:
    """The proof that a search ends with, whose evidence is this tree."""
    return RankProof(
        _ranks(search, tree), tree, search.share, int(tree.proved.sum()), boxes, rounds, done, not done and search.full
    )


def _ranks(search: Search, tree: RankTree) -> Ranks:
    """The claim's part on the leaves of a tree."""
    states = search.course.system.states
    return Ranks(tuple(states[i].name for i in search.course.angles), max(1, tree.most))


def _grow(
    search: Search,
    bound: Callable[[Array, Array, float, float], Images],
    effort: Effort,
    report: Callable[[float, int, int], None] | None,
    enough: Enough | None,
) -> tuple[int, bool]:
    """Grow a search's tree until nothing is left to gain, which is the second answer, or it has to end; the first is
    the number of rounds."""
    course = search.course
    new, rounds = search.begin(_AT_FIRST * effort.left / (course.counts[-1] * course.operations)), 0
    while True:
        found = bound(search.cover.low[:, new], search.cover.high[:, new], 0.0, 0.0)
        effort.charge(course.cost(found))
        search.take(new, found)
        near, rounds = search.spread(), rounds + 1
        effort.charge(_OF_A_PAIR * search.pairs + _OF_A_LEAF * len(new))
        if report is not None:
            report(search.share, search.boxes, len(search.unknown))
        done = search.is_done(near)
        satisfied = enough is not None and search.counted(enough.states) >= enough.count
        if done or satisfied or effort.over or search.full or search.gives_up:
            return rounds, done
        new = search.further(near)
