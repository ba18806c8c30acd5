"""Rules `ranks`, `inputs`, `flow` and `keep` on boxes with ranks: each leads to lower ones, and so to the target, or
without a target to any that have a rank.

A leaf of rank r with k steps is followed for these steps as a box that is affine in the leaf's symbols and in those of
the errors of its last steps. Where it ends all of it is in the target, or every leaf that it meets has a rank of at
most r - k.

Equations that jump have an image for each value that their jumps may have, by the bounds of what these are jumps of. So
a box may become many, which are followed one by one until they lie in the target.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import product

from flint import arb, arb_mat, fmpq, fmpq_mat

from .balls import ZERO, total
from .batches import in_batches
from .directions import Frame
from .document import Certificate, Ranks
from .evidence import REMAINS, Ranked, Ranking, Tree
from .keep import kept
from .leaves import LEAF, Box, cut, structure
from .motion import Input, Motion, Stage
from .rational import bits
from .refusal import Refused, require
from .taylor import Taylor, constant

RULE, UNRANKED = "ranks", 65_535
MAX_MET = 2**14  # nodes of the tree that one image meets
MAX_FRAME_BITS = 2**14  # of its longest number, times its rows
MAX_IMAGES = 64  # of a leaf after each step
Rows = list[list[arb]]  # for each state the constant, the coefficients of the leaf's symbols, and those of errors
Range = tuple[float, float]


def ranks(c: Certificate, evidence: Tree | Ranked, jobs: int) -> int:
    """The tree with its ranks and steps first, then its leaves; their number."""
    ranking = evidence.ranking
    if c.ranks is None or ranking is None:
        raise Refused("format", "evidence.ranks", "the claim needs boxes with ranks")
    cover = Cover(c, c.ranks, ranking)
    walk = Walk(c, evidence.order, ranking)
    target = None if c.claim == REMAINS else Target(c, c.ranks)
    asked = (box for box in cut(cover.lo, cover.hi, ranking.tree) if cover.ranks[box.number] != UNRANKED)

    def check(some: list[Box]) -> None:
        try:
            follow(some, cover, walk, target)
        except Refused:  # maybe of a leaf that is not the first
            for box in some:
                follow([box], cover, walk, target)

    in_batches(c, walk.d, asked, check, jobs)
    return len(cover.ranks)


def follow(some: Sequence[Box], cover: Cover, walk: Walk, target: Target | None) -> None:
    """The rules for some leaves, whose policies are enclosed together, or a refusal."""
    places = [f"ranks leaf {box.number}" for box in some]
    steps = [cover.steps[box.number] for box in some]
    each = [[walk.start(box)] for box in some]
    for done in range(max(steps)):
        left = [(b, rows) for b, count in enumerate(steps) if count > done for rows in each[b]]
        moved = {b: list[Rows]() for b, _ in left}
        for (b, rows), u in zip(left, walk.inputs([rows for _, rows in left]), strict=True):
            for image in walk.step(rows, places[b], u):
                there = walk.jumps > 0 and target is not None and target.holds(image)
                moved[b] += [] if there else [image]
            few = len(moved[b]) <= MAX_IMAGES
            require(few, RULE, places[b], f"more than {MAX_IMAGES} images outside of the target at once")
        for b, images in moved.items():
            each[b] = images
    for box, images, count, at in zip(some, each, steps, places, strict=True):
        rank = cover.ranks[box.number]
        for rows in images:
            if target is None or not target.holds(rows):
                require(rank > 0, RULE, at, "its rank is 0, and it is not certain to lie in a target")
                cover.leads_to(rows, UNRANKED - 1 if target is None else rank - count, at)


def pairs(octets: bytes) -> list[int]:
    """Numbers of two bytes each, the lower first."""
    return [low + 256 * high for low, high in zip(octets[::2], octets[1::2], strict=True)]


class Cover:
    """The tree with what is needed to find the leaves that a box meets."""

    def __init__(self, c: Certificate, stated: Ranks, ranking: Ranking) -> None:
        self.c, self.stated, self.tree = c, stated, ranking.tree
        self.lo, self.hi = list(ranking.lo), list(ranking.hi)
        self.turn = 2 * arb.pi()
        for name, lo, hi in zip(c.plant.states, self.lo, self.hi, strict=True):
            require(lo < hi, RULE, name, "lo < hi does not hold")
            whole = name not in stated.angles or bool(arb(hi) - arb(lo) > self.turn)
            require(whole, RULE, name, "an angle's ends are not certain to be more than 2 pi apart")
        count = structure(self.tree, range(c.n), RULE)
        require(len(ranking.ranks) == 2 * count, RULE, "ranks", f"two bytes for each of {count} leaves were expected")
        one, two = (len(ranking.steps) == size * count for size in (1, 2))
        require(one or two, RULE, "steps", f"one or two bytes for each of {count} leaves were expected")
        self.ranks, self.steps = pairs(ranking.ranks), pairs(ranking.steps) if two else list(ranking.steps)
        for i, (r, k) in enumerate(zip(self.ranks, self.steps, strict=True)):
            good = k == 0 if r in (0, UNRANKED) else 0 < k <= r <= stated.steps
            require(good, RULE, f"ranks leaf {i}", f"{k} steps with rank {r}, of at most {stated.steps}")
        self.middle, self.above, self.most = self.nodes()

    def nodes(self) -> tuple[list[float], list[int], list[int]]:
        """For each node of the tree where it is cut, its upper half, and the highest rank in it."""
        size = len(self.tree)
        middle, above, most = [0.0] * size, [0] * size, [0] * size
        boxes = [(self.lo, self.hi)]
        for node, axis in enumerate(self.tree):
            lo, hi = boxes.pop()
            if axis != LEAF:
                middle[node] = 0.5 * lo[axis] + 0.5 * hi[axis]  # as in `cut`
                below, upper = list(hi), list(lo)
                below[axis] = upper[axis] = middle[node]
                boxes += [(upper, hi), (lo, below)]
        waiting, ranks = list[int](), list(self.ranks)
        for node in reversed(range(size)):  # the upper half of a node is met before the lower one, and that before it
            if self.tree[node] == LEAF:
                most[node] = ranks.pop()
            else:
                lower, above[node] = waiting.pop(), waiting.pop()
                most[node] = max(most[lower], most[above[node]])
            waiting.append(node)
        return middle, above, most

    def leads_to(self, rows: Rows, rank: int, at: str) -> None:
        """All leaves that the box of these rows meets, as places, have at most this rank, or a refusal."""
        each = list[list[Range]]()
        for name, row, lo, hi in zip(self.c.plant.states, rows, self.lo, self.hi, strict=True):
            a, b = ends(row)
            require(a.is_finite() and b.is_finite(), RULE, at, "its image is not finite")
            if name in self.stated.angles:
                each.append(around(a, b, lo, hi, self.turn))
                continue
            inside = bool(a >= arb(lo)) and bool(b <= arb(hi))
            require(inside, RULE, at, f"its image is not certain to lie in the tree's box along {name}")
            each.append([outward(a, b)])
        left = MAX_MET
        for box in product(*each):
            left = self.below(box, rank, left, at)

    def below(self, box: Sequence[Range], rank: int, left: int, at: str) -> int:
        """The same for a box that lies in that of the tree; how many nodes may still be met after it."""
        waiting = [0]
        while waiting:
            node, left = waiting.pop(), left - 1
            require(left >= 0, RULE, at, f"its image meets more than {MAX_MET} nodes of the tree")
            if self.most[node] <= rank:
                continue
            axis = self.tree[node]
            require(axis != LEAF, RULE, at, f"its image meets a leaf whose rank is above {rank}")
            if box[axis][0] <= self.middle[node]:
                waiting.append(node + 1)
            if box[axis][1] >= self.middle[node]:
                waiting.append(self.above[node])
        return left


class Walk(Motion):
    """Steps of boxes: of the states' symbols the first n are the leaf's, then come n for the errors of each of the last
    steps, the last one first. What is not affine in those that stay is an error, bounded after the matrix `frame`, or
    after one that moves along with the oldest errors."""

    rule = RULE

    def __init__(self, c: Certificate, order: int, ranking: Ranking) -> None:
        angles = c.ranks.angles if c.ranks is not None else ()
        self.stay, self.jumps = c.n * ranking.memory, c.plant.dynamics.jumps
        super().__init__(c, c.n + self.stay, order, None, angles)
        self.domain = [(arb(lo), arb(hi)) for lo, hi in c.plant.domain]
        one = fmpq_mat([[int(i == k) for k in range(c.n)] for i in range(c.n)])
        exact = one if ranking.frame is None else ranking.frame
        short = exact.nrows() * bits(exact) <= MAX_FRAME_BITS
        require(short and exact.det() != 0, RULE, "frame", "the matrix has no inverse, or one that takes minutes")
        self.frame, self.moves = Frame(arb_mat(exact), arb_mat(exact.inv())), ranking.moving

    def start(self, box: Box) -> Rows:
        """x = centre + radius d."""
        rows = list[list[arb]]()
        for i, (a, b) in enumerate(zip(box.lo, box.hi, strict=True)):
            radius = (arb(b) - arb(a)) / 2
            rows.append([(arb(a) + arb(b)) / 2, *(radius if k == i else ZERO for k in range(self.d))])
        return rows

    def inputs(self, each: Sequence[Rows]) -> list[list[Input]]:
        """The inputs on each of some boxes."""
        if not each:
            return []
        x = arb_mat([[v for rows in each for v in rows[i]] for i in range(self.n)])
        u = self.policy(x, len(each))
        return [[row[b] for row in u] for b in range(len(each))]

    def step(self, rows: Rows, at: str, u: list[Input]) -> Iterator[Rows]:
        """The states after one step more, in which these are the inputs, for all that jumps may be, or a refusal."""
        c = self.c
        here = Stage(at, rows, u)
        self.keep_bounds(here)
        within = None if c.sample is None else self.reached(here)
        if c.keep is not None:
            kept(self, here, within, [])
        defined = all((mid + reach).is_finite() for mid, reach in here.ranges())
        require(defined, RULE, at, "the policy has no finite model")
        for name, row, (lo, hi) in zip(c.plant.states, rows, self.domain, strict=True):
            a, b = ends(row)
            inside = name in self.free or bool(a > lo and b < hi)
            require(inside, RULE, at, f"{name} is not certain to be inside of the domain before a step")
        return (self.settled(models, at) for models in self.after(here, within))

    def after(self, here: Stage, within: dict[str, Taylor] | None) -> Iterator[list[Taylor]]:
        """Models of the next state: F in discrete time, for all that jumps may be, else x + h G."""
        if within is None:
            waiting = [list[int]()]
            while waiting:
                choice = Choice(waiting.pop())
                yield self.F(here, choice)
                waiting += choice.others
            return
        h = self.period()
        G = self.mean(here, within, h)
        moved = [h * g if self.c.varies else g.scaled(h.c) for g in G]
        yield [self.affine(row) + g for row, g in zip(here.x, moved, strict=True)]

    def settled(self, models: list[Taylor], at: str) -> Rows:
        """The states as rows of numbers: what is not affine in the symbols that stay, all but those of the oldest
        errors, is an error, and so are the radii of the balls, which would grow many times over with each step."""
        require(all(v.is_finite() for v in models), RULE, at, "the next state has no finite model")
        first = [[v.c, *v.slopes(self.symbols)[: self.stay]] for v in models]
        frame = self.moved_frame(models, at) if self.moves else self.frame
        loose = [total(arb(b.rad()) for b in row) for row in first]
        errors = list[arb]()
        for turned in frame.N.tolist():
            v = Taylor(ZERO)
            for k, model in zip(turned, models, strict=True):
                v += model.scaled(k)
            others = total(map(abs, v.slopes(self.symbols)[self.stay :]))
            rounded = total(abs(k) * r for k, r in zip(turned, loose, strict=True))
            errors.append(arb((others + v.second + v.r + rounded).upper()))
        rows, leaf = list[list[arb]](), self.n + 1
        for row, back in zip(first, frame.inverse.tolist(), strict=True):
            stay = [b.mid() for b in row]
            rows.append([*stay[:leaf], *(k * e for k, e in zip(back, errors, strict=True)), *stay[leaf:]])
        return rows

    def moved_frame(self, models: list[Taylor], at: str) -> Frame:
        """The frame in the directions of the oldest errors, which do not stay."""
        oldest = arb_mat([v.slopes(self.symbols)[self.stay : self.stay + self.n] for v in models])
        return self.frame.moved(oldest, self.rule, at)


class Choice:
    """A value for each jump, in the order in which they are evaluated: first those that are given, then the lesser of
    those that each may have. `others` are given the greater one instead, so that each choice comes once.

    An argument's model is that with the values that jumps before it have.
    """

    def __init__(self, given: list[int]) -> None:
        self.given, self.values, self.others = given, list[int](), list[list[int]]()

    def __call__(self, a: Taylor) -> Taylor:
        number = len(self.values)
        if number < len(self.given):
            value = self.given[number]
        else:
            require(a.is_finite(), RULE, "jump", "its argument has no finite model")  # or maybe it does not exist
            excluded = (-a).is_negative(), a.is_negative()  # a value of 0, of 1
            possible = [v for v in (0, 1) if not excluded[v]]
            require(len(possible) > 0, RULE, "jump", "its argument is positive and negative")
            value, *greater = possible
            self.others += [[*self.values, v] for v in greater]
        self.values.append(value)
        return constant(fmpq(value))


class Target:
    """The set that is reached: {V <= c2} as places, or that where no expression of the target is positive."""

    def __init__(self, c: Certificate, stated: Ranks) -> None:
        self.c, self.stated, self.turn = c, stated, 2 * arb.pi()
        self.P = None if c.target is not None else arb_mat(c.P)

    def holds(self, rows: Rows) -> bool:
        """True if all of the box is certainly in the target, where numbers have finite models."""
        try:
            values = self.values(rows)
        except Refused:
            return False
        return all(v.is_finite() and (bool(v.by_squares() <= 0) or bool(v.from_corner() <= 0)) for v in values)

    def values(self, rows: Rows) -> list[Taylor]:
        """Models of numbers that are at most 0 in the target."""
        if self.c.target is None:
            return [self.V_beyond(rows)]
        names = {name: Taylor(x, arb_mat([g])) for name, (x, *g) in zip(self.c.plant.states, rows, strict=True)}
        return self.c.target.evaluate(names, constant)

    def V_beyond(self, rows: Rows) -> Taylor:
        """V - c2, at the place near 0."""
        if self.P is None:
            raise TypeError("a claim with a target has no V")
        n, centre = len(rows), [row[0] for row in rows]
        for i, name in enumerate(self.c.plant.states):
            if name in self.stated.angles:
                centre[i] -= turns(centre[i], ZERO, self.turn) * self.turn
        x, A = arb_mat(n, 1, centre), arb_mat([row[1:] for row in rows])
        PA = self.P * A
        V = (x.transpose() * (self.P * x))[0, 0]
        return Taylor(V - arb(self.c.outer), 2 * (x.transpose() * PA), A.transpose() * PA)


def ends(row: Sequence[arb]) -> tuple[arb, arb]:
    """The ends of a form, numbers."""
    middle, *slopes = row
    reach = total(map(abs, slopes))
    return arb((middle - reach).lower()), arb((middle + reach).upper())


def turns(value: arb, near: arb, turn: arb) -> int:
    """The whole turns by which a number is away from another, nearly; any integer would do."""
    away = float(((value - near) / turn).mid())
    return round(away) if abs(away) < 2**53 else 0  # False of what is no number


def around(a: arb, b: arb, lo: float, hi: float, turn: arb) -> list[Range]:
    """Parts of [lo, hi], which is longer than a turn, that have every place of [a, b] between them.

    Numbers below lo are less than a turn away from hi when they have been moved by one, as those above hi from lo.
    """
    w = turns((a + b) / 2, (arb(lo) + arb(hi)) / 2, turn)
    a, b = arb((a - w * turn).lower()), arb((b - w * turn).upper())
    first, last = arb(lo), arb(hi)
    if a >= first and b <= last:
        return [outward(a, b)]
    parts = (
        [(first, b), (arb((a + turn).lower()), last)] if a < first else [(a, last), (first, arb((b - turn).upper()))]
    )
    inside = all(p >= first and q <= last for p, q in parts)
    found = [outward(p, q) for p, q in parts if not p > q]  # one that is empty has no place of [a, b]
    return found if inside and found else [(lo, hi)]


def outward(a: arb, b: arb) -> Range:
    """Numbers of binary64 at or below a and at or above b, numbers; those of binary64 are their own."""
    below, above = float(a), float(b)
    while not arb(below) <= a:
        below = math.nextafter(below, -math.inf)
    while not arb(above) >= b:
        above = math.nextafter(above, math.inf)
    return below, above
