"""Images of boxes after several steps of a loop: affine in the coordinates of the box and in errors, zonotopes.

The n errors of a step are symbols of their own in the next steps, as many as the memory has, so that the policy's
answer to them cancels them there, as it does in truth; what is not of first order in the symbols is a new error, and
so are the oldest ones (Kuehn 1998, Girard 2005). Errors are those of N x for a matrix N, the frame: where its rows are
left eigenvectors of the step's map, errors shrink as fast as states do, while those of single states may grow by a
factor with each step (the wrapping effect; Moore 1966). A frame that moves turns with the errors (Lohner 1987), which
costs more and pays where many steps follow one another.
Where equations jump, a box has an image for each choice of heavisides that may occur, as many as `ways` says.
FORMAT.md has the same in its chapter on ranks; boxes here are wider by more than rounding makes of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import product as choices
from typing import NamedTuple

import numpy as np

from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import JUMP, Expression, Symbol, evaluate, jumping
from certify.loop.policies import bounded_by_form
from certify.provers.bounds import Flow, Models, Taylor, loop_models, policy_enclosure, upper_bound
from certify.provers.bounds.arrays import Array, Index, Mask, joined, pieces
from certify.provers.bounds.taylor import EPS, TINY
from certify.provers.boxes.kept import ConstraintModels
from certify.provers.boxes.rule import input_bounds_kept, operations_of_box
from certify.provers.ranks.targets import Target

_WIDER = 1e-7  # share of a box's width, beyond all that two programs' rounding may differ by
_MARGIN = 0.03  # share of a width, where directions move: two programs' affine bounds, which differ, turn them
_ENDS = 1e-9  # relative distance kept from ends of the domain
_WIDEST = 0.15  # share of the root box beyond which an image is of no use
_MORE_THAN_ROUNDING = 1e-13  # relative, of sums whose terms may cancel
_NUMBERS = 2**16  # half a mebibyte of a model of second order at a time, of which a step of a loop has hundreds
_WAYS = 4  # images of a box at once that are of use
_APART = 2.0**-20  # of a column's size, by which columns are kept from being dependent
_OF_A_STEP = 1e6  # operations
_MORE = 1.5  # operations of a step of a box, relative to those of a box's bound, whose symbols are fewer


class Images(NamedTuple):
    """Images of boxes (n, B) after so many steps each, K of them, up to R for each.

    Parameters
    ----------
    lo, hi : (k, R, n, B), of the first k numbers of steps; NaN where there are no more images, as of those that were
        in the target before.
    there : (k, R, B), the image lies in the target.
    known, arrived : (K, B), all images of the box are of use; all are, or were before, in the target.
    inside, meets : (B,), the box itself does; it may have states there.
    loose : (B,), all that is asked for in the first step may hold in a part of the box, though not in all of it.
    fails : (B,), the first step violates a constraint from everywhere in the box, or leaves the domain.
    first : (2, n, B), corners of the states after the first step, whatever is asked for; NaN where there are none.
    taken : (B,), the steps that were followed.
    steep : (n, B), by how much each axis of the box widens its first image that reaches far, relative to the root.
    """

    lo: Array
    hi: Array
    there: Mask
    known: Mask
    arrived: Mask
    inside: Mask
    meets: Mask
    loose: Mask
    fails: Mask
    first: Array
    taken: Array
    steep: Array

    @property
    def widths(self) -> Array:
        """The largest width of a box's images, (k, n, B); NaN where they are of no use."""
        widths: Array = np.fmax.reduce(self.hi - self.lo, axis=1)
        return widths


@dataclass(frozen=True)
class Form:
    """States `x[:, 0] + x[:, 1:] d`, the symbols d being n of a box, and n of errors for each of the last p steps, the
    last one first: (n, 1 + n + p n, B)."""

    x: Array

    def wider(self, by: float) -> Form:
        """The same with symbols that reach farther."""
        return Form(np.concatenate([self.x[:, :1], self.x[:, 1:] * (1 + by)], 1))

    def at(self, index: Index | Mask) -> Form:
        """Some of the boxes."""
        return Form(self.x[..., index])

    @property
    def box(self) -> tuple[Array, Array]:
        """Their corners, (n, B) each, a little farther out."""
        reach = np.abs(self.x[:, 1:]).sum(1)
        reach = reach * (1 + _WIDER) + 4 * EPS * np.abs(self.x[:, 0])
        return self.x[:, 0] - reach, self.x[:, 0] + reach


class Course:
    """The course of boxes of states through a loop in discrete time, or with held inputs.

    Parameters
    ----------
    loop, target : the loop, and the set that is to be reached.
    angles : the states that are angles, by their numbers.
    keep : expressions that have to stay negative.
    root : the widths of the root box, (n,).
    counts : the numbers of steps after which images are wanted, ascending; corners of the first `kept` alone, or all.
    order : of the series in time, where inputs are held.
    frame : N, (n, n), in whose coordinates N x errors are bounded; None: in those of the states.
    moving : errors are bounded in directions that turn with them.
    memory : p, the number of steps for which errors stay symbols.
    """

    piece = 512

    def __init__(
        self,
        loop: ClosedLoop,
        target: Target,
        angles: Sequence[int],
        keep: Sequence[Expression],
        root: Array,
        counts: Sequence[int],
        kept: int | None = None,
        order: int = 2,
        frame: Array | None = None,
        moving: bool = False,
        memory: int = 1,
    ) -> None:
        self.system, self.target, self.constraints = loop.system, target, ConstraintModels(loop.system, keep)
        self.angles, self.root, self.frame, self.moving = tuple(angles), root, frame, moving
        self.counts, self.kept = tuple(counts), len(counts) if kept is None else kept
        self.errors = Errors(self.system.n, frame, moving)
        self.straight = [i for i in range(self.system.n) if i not in self.angles]
        self.memory, self.symbols = memory, self.system.n * (1 + memory)
        self.most = min(self.piece, max(2, _NUMBERS // (self.symbols + self.system.m + 1) ** 2))
        self.policy = policy_enclosure(loop, self.symbols)
        self.dynamics = self.system.uncertain_dynamics()
        self.check_inputs = not bounded_by_form(loop.network, self.system.input_bounds)
        sample = self.system.sample
        self.flow = None if sample is None else Flow(self.dynamics, sample, order, bool(keep))
        self.ends = np.array([[float(end) for end in pair] for pair in self.system.domain]).T[:, :, None]
        self.jumps = len(jumping(*self.dynamics))
        self.ways = _WAYS if self.jumps else 1
        self.operations = _MORE * operations_of_box(loop, order, (memory - 1) * self.system.n)  # of a step

    @np.errstate(all="ignore")  # infinities and NaN are answers, which nothing is proved with
    def __call__(self, lo: Array, hi: Array, inner: float, outer: float) -> Images:
        """The images of boxes lo, hi (n, B); levels of V do not matter here."""
        cut = pieces(lo.shape[1], self.most)
        both = zip(np.array_split(lo, cut, 1), np.array_split(hi, cut, 1), strict=True)
        return Images(*map(joined, zip(*(self._followed(*each) for each in both), strict=True)))

    def cost(self, found: Images) -> float:
        """The operations that images took; a step of a batch takes some, however few boxes it has."""
        batches = pieces(len(found.taken), self.most)
        return max(self.operations * float(found.taken.sum()), _OF_A_STEP * batches * float(found.taken.max(initial=0)))

    def _followed(self, lo: Array, hi: Array) -> Images:
        """The same for as many boxes as memory is meant for."""
        (n, batch), K, k = lo.shape, len(self.counts), self.kept
        centre = 0.5 * lo + 0.5 * hi
        radius = np.maximum(hi - centre, centre - lo) * (1 + EPS)
        slopes, errors = np.eye(n)[:, :, None] * radius, np.zeros((n, self.symbols - n, batch))
        form = Form(np.concatenate([centre[:, None], slopes, errors], 1))
        found = Images(
            np.full((k, self.ways, n, batch), np.nan),
            np.full((k, self.ways, n, batch), np.nan),
            np.zeros((k, self.ways, batch), dtype=bool),
            np.zeros((K, batch), dtype=bool),
            np.zeros((K, batch), dtype=bool),
            self.target.holds(form.x, self.angles),
            ~self.target.misses(form.x, self.angles),
            np.zeros(batch, dtype=bool),
            np.zeros(batch, dtype=bool),
            np.full((2, n, batch), np.nan),
            np.zeros(batch),
            np.abs(slopes).sum(0) / self.root[:, None],
        )
        of = np.flatnonzero(~found.inside)  # the box of each image
        form, widest = form.at(of), np.zeros(batch)
        for count in range(1, self.counts[-1] + 1):
            if not len(of):
                break
            np.add.at(found.taken, of, 1)
            form, before, kept, lost = self.step(form)
            of = of[before]
            starts = np.flatnonzero(np.diff(of, prepend=-1))
            if count == 1:
                self._first(found, of, starts, form, kept, lost)
            good = kept & ((self._width(form) < _WIDEST) | (count == 1))
            often = np.diff(starts, append=len(of))
            whole = np.logical_and.reduceat(good, starts) & (often <= self.ways)
            left = np.repeat(whole, often)
            of, form = of[left], form.at(left)
            if count in self.counts and len(of):
                left = self._note(found, self.counts.index(count), of, form, widest)
                of, form = of[left], form.at(left)
        return found

    def _width(self, form: Form) -> Array:
        """Widths of images, as shares of the root's."""
        below, above = form.box
        widths: Array = ((above - below) / self.root[:, None]).max(0)
        return widths

    def _first(self, found: Images, of: Index, starts: Index, form: Form, kept: Mask, lost: Mask) -> None:
        """Take in the first step of boxes `of`, each with its images from `starts` on."""
        (below, above), box = form.box, of[starts]
        (least, most), seen = self.ends[:, self.straight], (below[self.straight], above[self.straight])
        fails = np.logical_and.reduceat(lost | ((seen[1] < least) | (seen[0] > most)).any(0), starts)
        found.first[0, :, box] = np.minimum.reduceat(below, starts, 1).T
        found.first[1, :, box] = np.maximum.reduceat(above, starts, 1).T
        found.fails[box], found.loose[box] = fails, ~(np.logical_and.reduceat(kept, starts) | fails)

    def _note(self, found: Images, k: int, of: Index, form: Form, widest: Array) -> Mask:
        """Take in the images of boxes `of` after the k-th number of steps; the images that do not lie in the target."""
        n, starts = self.system.n, np.flatnonzero(np.diff(of, prepend=-1))
        form = form.wider(_MARGIN) if self.errors.moving else form
        there, (below, above), box = self.target.holds(form.x, self.angles), form.box, of[starts]
        number = np.arange(len(of)) - np.repeat(starts, np.diff(starts, append=len(of)))
        found.known[k, box], found.arrived[k, box] = True, np.logical_and.reduceat(there, starts)
        if k < self.kept:
            found.there[k, number, of] = there
            found.lo[k, number, :, of], found.hi[k, number, :, of] = below.T, above.T
        width = np.maximum.reduceat(self._width(form), starts)
        steep = np.abs(form.x[:, 1 : n + 1]) / self.root[:, None, None]
        further = width > widest[box]
        found.steep[:, box[further]] = np.maximum.reduceat(steep.sum(0), starts, 1)[:, further]
        widest[box] = np.maximum(widest[box], width)
        return ~there

    def step(self, form: Form) -> tuple[Form, Index, Mask, Mask]:
        """The images after a step, and of which states each is; where (B,) all that is asked for on the way holds, and
        where a constraint certainly does not."""
        system, x = self.system, form.x
        error = 4 * EPS * np.abs(x).sum(1) + TINY
        mid, slopes, wide, _ = self.policy(x, error)
        below, above = form.box
        kept = self.in_domain(below, above)
        if self.check_inputs:
            for inside, _ in input_bounds_kept(system, self.policy, x, error, mid, slopes, wide):
                kept = kept & inside
        states, inputs, quantities = loop_models(
            system, x, error, mid, slopes, wide, 0 if self.flow is None else self.flow.symbols
        )
        values = {**states, **inputs, **quantities}
        here = list(states.values())
        during: Sequence[Mapping[Symbol, Taylor]] = [values]
        if self.flow is None:
            after, of = self._stepped(values, here[0])
        else:
            mean = self.flow(states, inputs, quantities, self.symbols + system.m)
            after = [v + self.flow.times_period(rate) for v, rate in zip(here, mean.G, strict=True)]
            of = np.arange(len(kept))
            kept = kept & mean.exists & self.in_domain(below - mean.down, above + mean.up)
            during = mean.during
        lost = np.zeros_like(kept)
        for g in self.constraints.during(during):
            kept, lost = kept & (upper_bound(g)[0] < 0), lost | (upper_bound(g.scaled(-1.0))[0] < 0)
        finite = np.all([np.isfinite(v.c + v.radius()) for v in after], axis=0)
        return self.errors.form(after, self.symbols), of, kept[of] & finite, lost[of]

    def _stepped(self, values: Mapping[Symbol, Taylor], like: Taylor) -> tuple[list[Taylor], Index]:
        """The next states in discrete time, and of which states each is: of those where the signs of all arguments of
        heavisides are certain; of others those that each choice of values may lead to."""
        each, of = list[list[Taylor]](), list[Index]()

        def follow(some: Index, choice: Sequence[int] | None) -> Mask:
            models, known = _Chosen(like.at(some), choice), dict[Expression, Taylor]()
            here = {symbol: v.at(some) for symbol, v in values.items()}
            after = [evaluate(expression, here, models, known) for expression in self.dynamics]
            there = np.flatnonzero(models.possible)
            each.append([v.at(there) for v in after])
            of.append(some[there])
            return models.possible

        every = np.arange(len(like.c))
        left = every[~follow(every, None)]
        if not len(left):
            return each[0], of[0]
        for choice in choices((0, 1), repeat=self.jumps):
            follow(left, choice)
        order = np.argsort(np.concatenate(of), kind="stable")
        return [_joined(of_state).at(order) for of_state in zip(*each, strict=True)], np.concatenate(of)[order]

    def in_domain(self, below: Array, above: Array) -> Mask:
        """True on boxes (n, B) inside the domain, but for angles."""
        inside = np.ones(below.shape[1], dtype=bool)
        for i in self.straight:
            low, high = self.ends[:, i]
            slack = _ENDS * (np.abs(low) + np.abs(high))
            inside &= (below[i] > low + slack) & (above[i] < high - slack)
        return inside


class Errors:
    """The way in which errors of n states are bounded: in coordinates N x, N being `frame` or the identity, or in
    directions that move with them in these coordinates."""

    def __init__(self, n: int, frame: Array | None, moving: bool) -> None:
        N, self.n, self.moving = np.eye(n) if frame is None else frame, n, moving
        self.into, self.back = N[:, :, None], np.linalg.inv(N).astype(np.float64)[:, :, None]
        self.doubt = 1e-12 + 16 * EPS * float(np.linalg.cond(N))  # relative, of errors: also of the inverse

    def form(self, models: Sequence[Taylor], symbols: int) -> Form:
        """The part of models that is of first order in all of so many symbols but the oldest; all else is an error."""
        n, kept = self.n, symbols - self.n
        first = np.stack([np.concatenate([v.c[None], v.g[:kept]]) for v in models])
        rest = np.stack([np.concatenate([v.g[kept:], v.Q.reshape(-1, v.Q.shape[-1])]) for v in models])
        into, back = self.moved(rest[:, :n]) if self.moving else (self.into, self.back)
        e = np.abs(turned(into, rest)).sum(1) + turned(np.abs(into), np.stack([v.r for v in models])[:, None])[:, 0]
        e = e * (1 + self.doubt) + _MORE_THAN_ROUNDING * turned(np.abs(into), np.abs(rest).sum(1)[:, None])[:, 0]
        return Form(np.concatenate([first[:, : n + 1], back * e, first[:, n + 1 :]], 1))

    def moved(self, oldest: Array) -> tuple[Array, Array]:
        """Q'N and N^-1 Q, (n, n, B), Q the orthogonal factor of N times the oldest errors' coefficients (n, n, B),
        each column on the scale of 1."""
        columns = turned(self.into, oldest)
        columns = np.nan_to_num(columns / np.abs(columns).sum(0), posinf=0.0, neginf=0.0)
        columns[np.diag_indices(self.n)] += _APART
        Q, R = (M.transpose(1, 2, 0) for M in np.linalg.qr(columns.transpose(2, 0, 1)))
        Q = Q * np.where(R[np.diag_indices(self.n)] < 0, -1.0, 1.0)
        return turned(Q.transpose(1, 0, 2), self.into), turned(self.back, Q)


class _Chosen(Models):
    """Models with chosen values of heavisides, in the order of evaluation, and the boxes where each may be; without a
    choice those that are certain."""

    def __init__(self, like: Taylor, choice: Sequence[int] | None) -> None:
        super().__init__(like)
        self.left, self.possible = None if choice is None else iter(choice), np.ones(len(like.c), dtype=bool)

    def function(self, name: str, value: Taylor) -> Taylor:
        if name != JUMP:
            return super().function(name, value)
        above, below = upper_bound(value.scaled(-1.0))[0] < 0, upper_bound(value)[0] < 0
        if self.left is None:
            self.possible &= above | below
            return replace(self.zero, c=np.where(above, 1.0, 0.0))
        chosen = next(self.left)
        self.possible &= ~(below if chosen else above)
        return self.constant(Fraction(chosen))


def turned(N: Array, columns: Array) -> Array:
    """N, (n, n, 1) or (n, n, B), times columns (n, K, B)."""
    found: Array = N[:, 0, None] * columns[0]
    for j in range(1, len(columns)):
        found += N[:, j, None] * columns[j]
    return found


def _joined(models: Sequence[Taylor]) -> Taylor:
    """Models on several batches as those on one."""
    parts = zip(*((v.c, v.g, v.Q, v.r) for v in models), strict=True)
    return Taylor(*(np.concatenate(part, -1) for part in parts))
