"""The boxes with ranks of a certificate, together with {V <= c2} if it has a V: the states and boxes in them.

With angles, states that differ by multiples of 2 pi in them are one place: a state lies in the set if one of its turns
lies in a leaf of finite rank, or in {V <= c2}. Corners of leaves are binary64 numbers and states rationals, so that
every answer about a state is exact (turns.py). A box descends the tree, cut where the tree is cut.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction

import flint
import numpy as np
from numpy.typing import NDArray

from certify.certificates.ellipsoids import Box, Ellipsoid
from certify.certificates.evidence import RankTree
from certify.certificates.located import Containment, Located
from certify.certificates.tree import LEAF, leaves_within
from certify.certificates.turns import Turned, bounds_of, sign_against, turns_into
from certify.errors import CertificateFormatError
from certify.loop.rigorous import ball, precision
from certify.lyapunov import extents

Array = NDArray[np.float64]
Piece = tuple[tuple[Turned, Turned], ...]
"""A box whose ends may be turned."""
_NODES = 2**18  # of the tree, that a box may meet
_BITS = 80  # of V at a turned state, at first


@dataclass(frozen=True, slots=True)
class Ranked:
    """The leaves of finite rank of `tree`, and {V <= c2}, the `ellipsoid`, under a claim with a V; `angles` are the
    numbers of states in which 2 pi more is the same place.

    Raises
    ------
    CertificateFormatError : the tree's bytes are not exactly one tree.
    """

    tree: RankTree
    ellipsoid: Ellipsoid | None
    angles: tuple[int, ...] = ()
    name: str = field(default="the boxes with ranks", init=False)
    _upper: NDArray[np.int64] = field(init=False, repr=False)
    _proved: NDArray[np.bool_] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_upper", upper_children(self.tree.tree))
        leaf = np.frombuffer(self.tree.tree, np.uint8) == LEAF
        proved = np.zeros(len(leaf), dtype=np.bool_)
        proved[leaf] = self.tree.proved
        object.__setattr__(self, "_proved", proved)

    def holds(self, states: Iterable[Sequence[Fraction | float]]) -> list[bool]:
        """True for each state that lies in the set, decided exactly; a float means its binary value."""
        exact = ([Fraction(v) for v in x] for x in states)
        return [self._in_leaves(x) or self._in_ellipsoid(x) for x in exact]

    def excludes(self, states: Iterable[Sequence[Fraction | float]]) -> list[bool]:
        """True for each state that lies outside."""
        return [not inside for inside in self.holds(states)]

    def locate(self, box: Box) -> Located:
        """Decide whether a box of states lies in the set: each part of it in a leaf of finite rank or in {V <= c2}.

        UNDECIDED means that some part is shown to lie in neither, and no state of it outside.
        """
        used, nodes, answer = set[str](), 0, Containment.CONTAINED
        for piece, turns in self._pieces(box):
            for part, inside in self._parts(piece):
                nodes += 1
                if nodes > _NODES:
                    return Located(Containment.UNDECIDED)
                name = self.name if inside else self._covered(part)
                if name is not None:
                    used.add(name)
                    continue
                state = _middle(part, turns, box)
                if state is not None and self.excludes([state])[0]:
                    return Located(Containment.NOT_CONTAINED, outside=state)
                answer = Containment.UNDECIDED
        if answer is not Containment.CONTAINED:
            return Located(answer)
        inner = () if self.ellipsoid is None else (self.ellipsoid.name,)
        return Located(answer, within=" and ".join(n for n in (*inner, self.name) if n in used))

    def ranks_at(self, states: Array) -> Array:
        """The ranks of leaves that hold states (N, n), in floats; NaN outside of the root and where nothing is said.

        For pictures: angles are not turned.
        """
        lo, hi = (np.tile(end, (len(states), 1)) for end in (self.tree.lo, self.tree.hi))
        inside = np.all((states >= lo) & (states <= hi), axis=1)
        axes, node = np.frombuffer(self.tree.tree, np.uint8), np.zeros(len(states), dtype=np.int64)
        while len(going := np.flatnonzero(axes[node] != LEAF)):
            axis = axes[node[going]]
            at = 0.5 * lo[going, axis] + 0.5 * hi[going, axis]
            upper = states[going, axis] >= at
            lo[going[upper], axis[upper]], hi[going[~upper], axis[~upper]] = at[upper], at[~upper]
            node[going] = np.where(upper, self._upper[node[going]], node[going] + 1)
        leaf = np.cumsum(axes == LEAF) - 1
        return np.where(inside & self._proved[node], self.tree.ranks[leaf[node]].astype(np.float64), np.nan)

    def _in_leaves(self, x: Sequence[Fraction]) -> bool:
        ranges = []
        for i, v in enumerate(x):
            lo, hi = Fraction(float(self.tree.lo[i])), Fraction(float(self.tree.hi[i]))
            ranges.append(turns_into(v, lo, hi) if i in self.angles else range(0, int(lo <= v <= hi)))
        each = itertools.product(*ranges)
        return any(self._is_met(tuple(((v, w), (v, w)) for v, w in zip(x, turns, strict=True))) for turns in each)

    def _is_met(self, point: Piece) -> bool:
        """True if some leaf of finite rank holds a state, given as a box."""
        return any(inside for _, inside in self._parts(point))

    def _parts(self, piece: Piece) -> Iterator[tuple[Piece, bool]]:
        """A box in pieces: each with True if it lies in a leaf of finite rank, and False if it lies in another leaf or
        outside of the root."""
        sides: list[tuple[Turned, Turned]] = list(piece)
        for i, (lo, hi) in enumerate(zip(self.tree.lo.tolist(), self.tree.hi.tolist(), strict=True)):
            below, within = _split(sides[i], Fraction(lo))
            inner, above = (None, None) if within is None else _split(within, Fraction(hi))
            below, above = (None if part is inner else part for part in (below, above))
            for outside in (below, above):
                if outside is not None:
                    yield (*sides[:i], outside, *sides[i + 1 :]), False
            if inner is None:
                return
            sides[i] = inner
        yield from self._descend(0, tuple(sides), self.tree.lo.tolist(), self.tree.hi.tolist())

    def _descend(self, node: int, piece: Piece, lo: list[float], hi: list[float]) -> Iterator[tuple[Piece, bool]]:
        waiting = [(node, piece, lo, hi)]
        while waiting:
            node, piece, lo, hi = waiting.pop()
            axis = self.tree.tree[node]
            if axis == LEAF:
                yield piece, bool(self._proved[node])
                continue
            at = 0.5 * lo[axis] + 0.5 * hi[axis]
            lower, upper = _split(piece[axis], Fraction(at))
            if lower is upper:
                # on the edge between both halves: one of them suffices
                halves = [
                    (k, *_half(lo, hi, axis, at, side)) for side, k in ((0, node + 1), (1, int(self._upper[node])))
                ]
                found = [list(self._descend(k, piece, a, b)) for k, a, b in halves]
                yield from next((parts for parts in found if all(inside for _, inside in parts)), found[0])
                continue
            for side, (part, k) in enumerate(((lower, node + 1), (upper, int(self._upper[node])))):
                if part is not None:
                    waiting.append((k, (*piece[:axis], part, *piece[axis + 1 :]), *_half(lo, hi, axis, at, side)))

    def _pieces(self, box: Box) -> Iterator[tuple[Piece, tuple[int, ...]]]:
        """A box with its angles turned into the root, in pieces, with the turns of each."""
        sides = []
        for i, (a, b) in enumerate(box):
            lo, hi = Fraction(float(self.tree.lo[i])), Fraction(float(self.tree.hi[i]))
            sides.append(_turned(a, b, lo, hi) if i in self.angles else [(((a, 0), (b, 0)), 0)])
        for each in itertools.product(*sides):
            yield tuple(side for side, _ in each), tuple(turn for _, turn in each)

    def _covered(self, piece: Piece) -> str | None:
        """The name of {V <= c2} if a bound of V shows that a box lies in it, as it is or turned; else None."""
        if self.ellipsoid is None:
            return None
        ends = [(bounds_of(a)[0], bounds_of(b)[1]) for a, b in piece]
        turns = [round(float(a + b) / (4 * math.pi)) if i in self.angles else 0 for i, (a, b) in enumerate(ends)]
        moved = tuple(
            (bounds_of((a[0], a[1] - w))[0], bounds_of((b[0], b[1] - w))[1])
            for (a, b), w in zip(piece, turns, strict=True)
        )
        return self.ellipsoid.name if self.ellipsoid.covers(moved) else None

    def _in_ellipsoid(self, x: Sequence[Fraction]) -> bool:
        inner = self.ellipsoid
        if inner is None or inner.holds([x])[0]:
            return inner is not None
        reach = [Fraction(v) for v in extents(inner.P, inner.level).tolist()] if self.angles else []
        each = [turns_into(v, -reach[i], reach[i]) if i in self.angles else (0,) for i, v in enumerate(x)]
        return any(any(turns) and _is_low(inner, x, turns) for turns in itertools.product(*each))


def steps_from(ranked: Ranked, box: Box) -> int | None:
    """The least number of steps after which every trajectory from a box of states has been in the target, as the ranks
    show it; None if they do not show that it ever is."""

    def shown(most: int) -> bool:
        known = replace(ranked, tree=ranked.tree.without(ranked.tree.ranks > most))
        return known.locate(box).answer is Containment.CONTAINED

    each = np.unique(ranked.tree.ranks[ranked.tree.proved]).tolist()
    if not each or not shown(each[-1]):
        return None
    low, high = 0, len(each) - 1
    while low < high:
        middle = (low + high) // 2
        low, high = (low, middle) if shown(each[middle]) else (middle + 1, high)
    return int(each[high])


def _is_low(inner: Ellipsoid, x: Sequence[Fraction], turns: Sequence[int]) -> bool:
    """True if V of a turned state is at most c2; V is a polynomial of degree 2 in pi, which equals no rational."""
    bits, level = _BITS, inner.level
    while True:
        with precision(bits):
            at = [ball(v) + 2 * w * flint.arb.pi() for v, w in zip(x, turns, strict=True)]
            rows = zip(at, inner.P.tolist(), strict=True)
            value = sum(a * p * b for a, row in rows for p, b in zip(row, at, strict=True))
            if bool(value <= level) or bool(value > level):
                return bool(value <= level)
        bits *= 2


def upper_children(tree: bytes) -> NDArray[np.int64]:
    """The place of the upper child of each node in the bytes of a tree; 0 for leaves.

    Raises
    ------
    CertificateFormatError : the bytes are not exactly one tree.
    """
    upper, sizes = np.zeros(len(tree), dtype=np.int64), list[int]()
    for k in range(len(tree) - 1, -1, -1):
        if tree[k] == LEAF:
            sizes.append(1)
        elif len(sizes) >= 2:
            lower = sizes.pop()
            upper[k] = k + 1 + lower
            sizes.append(1 + lower + sizes.pop())
        else:
            raise CertificateFormatError("the tree of ranks ends early.")
    if len(sizes) != 1:
        raise CertificateFormatError("the bytes of the tree of ranks must be exactly one tree.")
    return upper


@dataclass(frozen=True, slots=True)
class Count:
    """Numbers of a tree of ranks: its leaves, those with a finite rank, their volume and its share of the root box, in
    angles of one turn, both rounded down, and the most steps."""

    leaves: int
    proved: int
    volume: float
    share: float
    steps: int


def count(tree: RankTree, angles: Sequence[int] = ()) -> Count:
    """The numbers of a tree.

    Raises
    ------
    CertificateFormatError : the tree's bytes are not exactly one tree.
    """
    return Count(len(tree.ranks), int(tree.proved.sum()), *proved_volume(tree, angles), tree.most)


def proved_volume(tree: RankTree, angles: Sequence[int] = ()) -> tuple[float, float]:
    """The volume of the leaves of finite rank, and their share of the root box, both rounded down.

    In an angle only one turn of the root box counts, from its lower end. In a state in which nothing is cut a leaf has
    all of the root box, however narrow that is.

    Raises
    ------
    CertificateFormatError : the tree's bytes are not exactly one tree.
    """
    lower, upper = leaves_within(tree.tree, tree.lo, tree.hi)
    most, proved = tree.hi.copy(), tree.proved
    for i in angles:
        most[i] = min(most[i], math.nextafter(tree.lo[i] + 2 * math.pi, -math.inf))  # 2 math.pi is below 2 pi
    size, share = np.ones(len(lower)), np.ones(len(lower))
    for i in range(len(most)):
        width = np.maximum(np.nextafter(np.minimum(upper[:, i], most[i]) - lower[:, i], 0.0), 0.0)
        size = np.nextafter(size * width, 0.0)
        part = np.nextafter(width / math.nextafter(float(most[i] - tree.lo[i]), math.inf), 0.0)
        uncut = (lower[:, i] == tree.lo[i]) & (upper[:, i] >= most[i])
        share = np.where(uncut, share, np.maximum(np.nextafter(share * part, 0.0), 0.0))
    volume, known = (math.nextafter(math.fsum(each[proved]), 0.0) for each in (size, share))
    return volume, 1.0 if np.all(proved) else max(0.0, known)


def _half(lo: list[float], hi: list[float], axis: int, at: float, side: int) -> tuple[list[float], list[float]]:
    """A node's lower or upper half."""
    if side == 0:
        return lo, [*hi[:axis], at, *hi[axis + 1 :]]
    return [*lo[:axis], at, *lo[axis + 1 :]], hi


def _split(
    side: tuple[Turned, Turned], at: Fraction
) -> tuple[tuple[Turned, Turned] | None, tuple[Turned, Turned] | None]:
    """The parts of an interval below and above a number, None where there is none; the whole of it twice if it is this
    number alone."""
    first, last = sign_against(side[0], at), sign_against(side[1], at)
    if first == last == 0:
        return side, side
    if last <= 0:
        return side, None
    return (None, side) if first >= 0 else ((side[0], (at, 0)), ((at, 0), side[1]))


def _turned(a: Fraction, b: Fraction, lo: Fraction, hi: Fraction) -> list[tuple[tuple[Turned, Turned], int]]:
    """An interval of an angle turned into [lo, hi], which is longer than a turn, in one piece or two, with the turns of
    each; one that is as long as a turn counts as all of [lo, hi]."""
    if sign_against((b - a, -1), Fraction(0)) >= 0:
        return [(((lo, 0), (hi, 0)), 0)]
    w = turns_into(a, lo, hi)[0]
    if sign_against((b, w), hi) <= 0:
        return [(((a, w), (b, w)), w)]
    return [(((a, w), (hi, 0)), w), (((hi, -1), (b, w - 1)), w - 1)]


def _middle(piece: Piece, turns: Sequence[int], box: Box) -> tuple[Fraction, ...] | None:
    """A state in the middle of a piece, turned back into the box that it comes from; None if rounding leaves none."""
    state = []
    for (a, b), w, (lo, hi) in zip(piece, turns, box, strict=True):
        first, last = bounds_of((a[0], a[1] - w)), bounds_of((b[0], b[1] - w))
        q = (first[1] + last[0]) / 2
        if not (lo <= q <= hi and first[1] <= q <= last[0]):
            return None
        state.append(q)
    return tuple(state)
