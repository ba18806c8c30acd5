"""Rules `tree`, `ring`, `inputs`, `flow` and `keep`: the leaves of the partition.

The policy is enclosed on several leaves at a time.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

from flint import arb, arb_mat, fmpq_mat

from .balls import ZERO, total
from .batches import in_batches
from .document import Certificate
from .evidence import Covering, Tree
from .keep import kept
from .motion import Motion, Stage
from .rational import inverse_diagonal
from .refusal import require
from .taylor import Taylor, inner_product, is_negative, kinks

LEAF = 255
MAX_WAITING = 4096  # boxes of the tree beside the one in hand


def structure(tree: bytes, axes: Collection[int], rule: str = "tree", where: str = "") -> int:
    """Rule `tree`: one binary tree in preorder, and nothing behind it; the number of its leaves."""
    waiting = 1
    for position, byte in enumerate(tree):
        require(waiting > 0, rule, f"{where}byte {position}", "bytes stand behind the tree")
        waiting -= 1  # the box in hand
        require(waiting <= MAX_WAITING, rule, f"{where}byte {position}", f"more than {MAX_WAITING} boxes wait")
        if byte != LEAF:
            require(byte in axes, rule, f"{where}byte {position}", "neither an axis nor a leaf")
            waiting += 2
    require(waiting == 0, rule, f"{where}byte {len(tree)}", "the tree ends too early")
    return tree.count(LEAF)


@dataclass(frozen=True)
class Box:
    number: int
    lo: list[float]
    hi: list[float]

    def largest(self) -> list[float]:
        """max|z_i|."""
        return [max(abs(a), abs(b)) for a, b in zip(self.lo, self.hi, strict=True)]

    def least(self) -> list[float]:
        """min|z_i|."""
        return [0.0 if a <= 0 <= b else min(abs(a), abs(b)) for a, b in zip(self.lo, self.hi, strict=True)]


def boxes(evidence: Tree | Covering) -> Iterator[Box]:
    """The leaves' boxes of a tree whose structure is sound."""
    return cut([-b for b in evidence.root], list(evidence.root), evidence.tree)


def cut(least: list[float], most: list[float], tree: bytes) -> Iterator[Box]:
    """The leaves' boxes of the root box between these two corners."""
    waiting, number = [(least, most)], 0
    for axis in tree:
        lo, hi = waiting.pop()
        if axis == LEAF:
            yield Box(number, lo, hi)
            number += 1
            continue
        middle = 0.5 * lo[axis] + 0.5 * hi[axis]
        below, above = list(hi), list(lo)
        below[axis] = above[axis] = middle
        waiting += [(above, hi), (lo, below)]  # the lower half is next


@dataclass(frozen=True)
class Leaf(Stage):
    """A box as z = centre + radius d with what is affine in d: x, the inputs within an error, and 2 P x."""

    box: Box
    centre: list[arb]
    radius: list[arb]
    gradient: list[list[arb]]


class Leaves(Motion):
    """Data and bounds shared by all leaves of a certificate."""

    def __init__(self, c: Certificate, T: fmpq_mat, S: fmpq_mat) -> None:
        if not isinstance(c.evidence, Tree):
            raise TypeError("a solver's word has no leaves")
        squares = inverse_diagonal(c.P, "lyapunov") if c.sample is not None else []
        super().__init__(c, c.n, c.evidence.order, [(arb(c.outer) * arb(square)).sqrt() for square in squares])
        self.alone, self.step, self.steps = c.evidence.ball is None, arb(c.step), c.step > 0
        self.P, self.rate = arb_mat(c.P), arb(2 * c.rate)
        self.T, self.PT2 = arb_mat(T), arb_mat(2 * (c.P * T))
        self.S = [arb(S[i, i]) for i in range(c.n)]
        self.cross = [(i, j, arb(2 * abs(S[i, j]))) for j in range(c.n) for i in range(j) if S[i, j] != 0]
        self.inner, self.outer = arb(c.inner), arb(c.outer)

    # ------------------------------------------------------------------------------------------------- which leaves

    def diagonal_part(self, ends: Sequence[float]) -> arb:
        return total(s * arb(z) ** 2 for s, z in zip(self.S, ends, strict=True))

    def cross_part(self, box: Box) -> arb:
        """sum_{i != j} |S_ij| max|z_i| max|z_j|."""
        most = [arb(z) for z in box.largest()]
        return total(s * most[i] * most[j] for i, j, s in self.cross)

    def is_outside(self, box: Box) -> bool:
        """True if certainly V > c2 on all of the box."""
        return bool(self.diagonal_part(box.least()) - self.cross_part(box) > self.outer)

    def is_inside(self, box: Box) -> bool:
        """True if V is certainly below the inner level on all of the box."""
        return self.is_below(self.inner, box)

    def is_below(self, level: arb, box: Box) -> bool:
        return bool(self.diagonal_part(box.largest()) + self.cross_part(box) < level)

    # -------------------------------------------------------------------------------------------------- the box

    def enclose(self, some: Sequence[Box], kind: str = "leaf") -> list[Leaf]:
        """Each leaf with its models of x, 2 P x and the policy."""
        n, stride = self.n, self.n + 1
        centres = [[(arb(a) + arb(b)) / 2 for a, b in zip(box.lo, box.hi, strict=True)] for box in some]
        radii = [[(arb(b) - arb(a)) / 2 for a, b in zip(box.lo, box.hi, strict=True)] for box in some]
        entries = []
        for i in range(n):
            for centre, radius in zip(centres, radii, strict=True):
                entries += [centre[i], *(radius[i] if j == i else ZERO for j in range(n))]
        z = arb_mat(n, stride * len(some), entries)
        x = self.T * z
        u = self.policy(x, len(some))
        states, gradients, at = x.tolist(), (self.PT2 * z).tolist(), range(0, stride * len(some), stride)
        return [
            Leaf(
                f"{kind} {box.number}",
                [row[k : k + stride] for row in states],
                [row[b] for row in u],
                box,
                centres[b],
                radii[b],
                [row[k : k + stride] for row in gradients],
            )
            for b, (box, k) in enumerate(zip(some, at, strict=True))
        ]

    # ----------------------------------------------------------------------------------------------------- the ring

    def G(self, leaf: Leaf, within: dict[str, Taylor] | None = None) -> list[Taylor]:
        """The states' change over a step, divided by its length: F in continuous time.

        With a sample `within` are the states of the whole period.
        """
        if within is None:
            F = self.F(leaf)
            if not self.c.plant.discrete:
                return F
            return [f + -self.affine(row) for f, row in zip(F, leaf.x, strict=True)]
        return self.mean(leaf, within, self.period())

    def D(self, leaf: Leaf, within: dict[str, Taylor] | None = None) -> Taylor:
        """(2 P x + h P G)'G from above: Vdot in continuous time. What V changes by over a step, by its length.

        h is the very number on which G depends, with the same symbol where it may be one of many.
        """
        G, rows, h = self.G(leaf, within), list[Taylor](), self.period()
        for i, row in enumerate(leaf.gradient):
            along = self.affine(row)
            if self.steps:
                moved = Taylor(ZERO)
                for k, other in enumerate(G):
                    moved += other.scaled(self.P[i, k])
                along += h * moved if self.c.varies else moved.scaled(self.step)
            rows.append(along)
        return inner_product(rows, G)

    def V(self, leaf: Leaf) -> Taylor:
        """z'Sz, the off-diagonal part in the remainder."""
        each = list(zip(self.S, leaf.centre, leaf.radius, strict=True))
        c = total(s * z * z for s, z, _ in each)
        g = [2 * s * z * r for s, z, r in each] + [ZERO] * (self.symbols - self.n)
        Q = arb_mat(self.symbols, self.symbols)
        for i, (s, _, r) in enumerate(each):
            Q[i, i] = s * r * r
        return Taylor(c, arb_mat(1, self.symbols, g), Q, self.cross_part(leaf.box))

    def decreases(self, leaf: Leaf, within: dict[str, Taylor] | None = None) -> bool:
        """True if D', D' + k (c2 - V) or D' + k (V - c1), D' = D + 2 lambda V, is certainly negative for some k >= 0.

        The first-order part of the bound is piecewise linear in k, and each of its kinks is tried. Any k is sound: if
        it is not finite, the bound is not finite either, and no comparison finds that negative.
        """
        D, V = self.D(leaf, within), self.V(leaf)
        if self.rate > 0:
            D += V.scaled(self.rate)
        if self.alone and self.steps and not self.is_beyond_floor(leaf.box):
            return self.stays(D, V + Taylor(-self.inner))
        return is_negative(D, [Taylor(self.outer) + -V, V + Taylor(-self.inner)])

    def stays(self, D: Taylor, above: Taylor) -> bool:
        """True if D' + k (V - c0) is certainly negative for some k from 0 to 1/h, where V may be below c0.

        A step from there then leads to V + h D < V + h k (c0 - V) <= c0, if no ball has shown it. From c0 on D' < 0.
        """
        tried = [ZERO, *(k for k in kinks(D, above) if k >= 0 and k * self.step <= 1), 1 / self.step]
        return any((D + above.scaled(k)).is_negative() for k in tried)

    def is_beyond_floor(self, box: Box) -> bool:
        """True if V is certainly at least the inner level on all of the box."""
        return bool(self.diagonal_part(box.least()) - self.cross_part(box) >= self.inner)


def check_leaves(leaves: Leaves, evidence: Tree, jobs: int) -> None:
    """Rules `inputs`, `flow`, `keep` and `ring`; in each batch of leaves they are taken in this order.

    An inside leaf has been covered by rule `local` where there is a ball. Without one nothing has: there the inputs are
    asked, and in continuous time that F has a finite model, but where time has steps that V stays below c0.
    """
    c, covered = leaves.c, not leaves.alone
    asked = (box for box in boxes(evidence) if not (leaves.is_outside(box) or (covered and leaves.is_inside(box))))

    def check(some: list[Box]) -> None:
        enclosed = leaves.enclose(some)
        for leaf in enclosed:
            leaves.keep_bounds(leaf)
        reached = [None if c.sample is None else leaves.reached(leaf) for leaf in enclosed]
        if c.keep is not None:
            for leaf, within in zip(enclosed, reached, strict=True):
                kept(leaves, leaf, within, [Taylor(leaves.outer) + -leaves.V(leaf)])
        for leaf, within in zip(enclosed, reached, strict=True):
            if leaves.is_inside(leaf.box) and not leaves.steps:
                leaves.F(leaf)
                continue
            falls = leaves.decreases(leaf, within)
            require(falls, "ring", leaf.place, "no bound of what V changes by is certainly negative")

    in_batches(c, c.n, asked, check, jobs)
