"""Shared by the figures of one certificate: sets, labels, the flow, trajectories, and the effort for simulation.

The number of simulated points follows from the cost of one, counted in operations, so that equal certificates give
equal pages on fast and slow machines. The clock is the last resort: if it runs out, runs end early and say so.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import ArrayLike, NDArray

from certify.certificates import Certificate, PartitionTree, Slab, leaves
from certify.errors import CertificateFormatError
from certify.loop.policies import TanhNetwork
from certify.lyapunov import extents, is_positive_definite
from certify.report.claims import words_for
from certify.report.figures.geometry import PARTS, Box, circle, over_level, refine
from certify.report.figures.pairs import Pair, pairs_of
from certify.report.flow import Flow, time_scales
from certify.report.sampling import SETTLED, Runs, growth, quadratic, runs_of
from certify.report.timing import TimingInWords
from certify.report.words import deviation, exact_number, held_at, label

Array = NDArray[np.float64]
Leaves = tuple[Array, Array]
"""Boxes `lower <= z <= upper`, both (N, n)."""
ON_BOUNDARY = 14  # trajectories that start on the certified boundary, in each plane
PATH_STEP = 0.6  # of the step of `time_scales`
_MOST_LEAVES = 400_000
_MOST_STEPS = 500
_MOST_SHORT = 8  # times as many where a period is shorter than a step would be
_TANH = 30  # multiplications' worth
_EQUATIONS = 500  # multiplications' worth of one evaluation, and of what surrounds it
_GRIDS, _RUNS, _RATES = 2e9, 1e10, 5e8  # operations for grids, trajectories and the time scales
_SHARE = 0.45  # of the time, after which nothing is simulated any more: the rest is for drawing
_LEAST = 25  # points along a grid
_POINTS = 240  # of a tube's edge over time, about
_FINE, _SEVERAL = (
    241,
    121,
)  # points along a grid on which the outline of an outer set is drawn, in one plane and in each
_ALONG = 400  # points of a ray, of which the last one in the sets is where a trajectory starts
_SEEN = 1 / 200  # of a picture's width: less is no more than a dot
_VIEW = 1.3  # of the set's reach, in pictures of more than two states


def is_ellipsoid(certificate: Certificate) -> bool:
    """True if `{V <= c2}` is an ellipsoid with its levels in order; a rejected file may hold anything."""
    P = certificate.P
    ordered = 0 < inner_of(certificate) <= certificate.inner <= certificate.roa < np.inf
    return ordered and bool(np.all(np.isfinite(P))) and is_positive_definite(P)


def inner_of(certificate: Certificate) -> float:
    """The level of the claim's inner set: c0 of a practical claim, else c1."""
    claim = certificate.claim
    return claim.local if claim.floor is None else claim.floor


def is_local_enough(certificate: Certificate) -> bool:
    """True if the local rule covers the whole set, so that leaves need not decrease (FORMAT.md, local)."""
    evidence = certificate.evidence
    ball = certificate.claim.at_rest or (isinstance(evidence, PartitionTree) and evidence.local is not None)
    return ball and certificate.claim.local == certificate.roa


def start_of(certificate: Certificate) -> Array | None:
    """P (n, n) of the ellipsoid {(x - c)'P(x - c) <= 1} from which a tube leads into {V <= c2}, c as `centre_of` says.

    None if the claim has none, or if a rejected file has something else there.
    """
    claim = certificate.claim
    if claim.start is None:
        return None
    P, c = claim.start.P, centre_of(certificate)
    return P if is_positive_definite(P) and (c is None or bool(np.all(np.isfinite(c)))) else None


def centre_of(certificate: Certificate) -> Array | None:
    """The state (n,) that a tube around a path begins around; None where the claim has none."""
    centre = certificate.claim.centre
    return None if centre is None else np.array(centre)


def slabs_of(certificate: Certificate) -> tuple[Slab, ...]:
    """The tube's slabs; none where the claim has no tube."""
    return certificate.evidence.tube if isinstance(certificate.evidence, PartitionTree) else ()


@dataclass(frozen=True, slots=True)
class Band:
    """A tube over time, in floats: its ellipsoid at a time is {(x - c)'P(x - c) <= 1}.

    Parameters
    ----------
    time : (K,), rising.
    P, centre : (K, n, n) and (K, n).
    half : `sqrt((P^-1)_ii)` (K, n): its reach from the centre along each state.
    """

    time: Array
    P: Array
    centre: Array
    half: Array


def band_of(start: Array, centre: Array | None, slabs: Sequence[Slab]) -> Band | None:
    """The tube over time; None where a rejected file's slabs are none.

    On a slab P(s) = (1 - s)^2 P_0 + 2 s (1 - s) M + s^2 P_1 and c(s) = (1 - s) c_0 + s c_1 for s from 0 to 1, from one
    node to the next.
    """
    if not slabs:
        return None
    pieces = max(1, _POINTS // len(slabs))
    s = np.arange(1, pieces + 1)[:, None, None] / pieces
    P, begin, c = start, 0.0, np.zeros(len(start)) if centre is None else centre
    times, matrices, centres = [np.zeros(1)], [start[None]], [c[None]]
    for slab in slabs:
        end = c if slab.path is None else slab.path.centre
        times.append(begin + slab.duration * s[:, 0, 0])
        matrices.append((1 - s) ** 2 * P + 2 * s * (1 - s) * slab.middle + s**2 * slab.end)
        centres.append((1 - s[:, 0]) * c + s[:, 0] * end)
        P, begin, c = slab.end, begin + slab.duration, end
    time, whole, middle = np.concatenate(times), np.concatenate(matrices), np.concatenate(centres)
    with np.errstate(invalid="ignore"):
        try:
            half = np.sqrt(np.diagonal(np.linalg.inv(whole), axis1=1, axis2=2))
        except np.linalg.LinAlgError:
            return None
    usable = all(bool(np.all(np.isfinite(v))) for v in (time, whole, middle, half)) and bool(np.all(np.diff(time) > 0))
    return Band(time, whole, middle, half) if usable else None


@dataclass(frozen=True, slots=True)
class Effort:
    """The effort for simulation.

    Parameters
    ----------
    grid : points along each side of a grid, for one picture.
    starts : trajectories from the boundary of the set, in each plane.
    steps : the steps of a trajectory.
    rates : the number of states at which time scales are estimated.
    """

    grid: int
    starts: int
    steps: int
    rates: int

    @classmethod
    def of(cls, network: TanhNetwork, planes: int) -> Effort:
        """The effort that a policy's cost allows in so many planes."""
        cost = _EQUATIONS + sum(w.size for w in network.weights) + _TANH * sum(b.size for b in network.biases)
        steps = _RUNS / (4 * cost)  # of all trajectories together
        starts = int(min(max(steps / (_MOST_STEPS * planes), 4), ON_BOUNDARY if planes == 1 else 8))
        return cls(
            grid=int(min(max(math.sqrt(_GRIDS / cost / (planes + 1)), _LEAST), 101)),
            starts=starts,
            steps=int(min(max(steps / (starts * planes), 120), _MOST_STEPS)),
            rates=int(min(max(_RATES / (2 * network.n * cost), 24), 200)),
        )


class Scene:
    """Data shared by the figures of one certificate.

    Parameters
    ----------
    accepted : True if the checker accepted it; if not, the captions speak of claims.
    pairs : states that are drawn against each other; a function of system, P and shares chooses them.
    seconds : for all figures.

    Raises
    ------
    CertificateFormatError : there is no ellipsoid to draw, or the tree has no leaves.
    """

    def __init__(
        self, certificate: Certificate, accepted: bool, pairs: Sequence[Pair] | None = None, seconds: float = 10.0
    ) -> None:
        self.deadline = time.monotonic() + _SHARE * seconds
        if not is_ellipsoid(certificate):
            raise CertificateFormatError("P must be positive definite and the levels positive and in order.")
        self.timing = TimingInWords.of(certificate.system, certificate.claim.rate)
        self.certificate, self.beyond = certificate, certificate.claim.outer
        self.words = words_for(certificate.kind, self.timing, beyond=self.beyond is not None)
        self.kind = "asymptotic" if certificate.claim.floor is None else "practical"
        self.word, self.proved = ("certified", "proved") if accepted else ("claimed", "claimed")
        self.system, self.P = certificate.system, certificate.P
        self.inner, self.outer = inner_of(certificate), certificate.roa
        self.n = self.system.n
        self.reach = extents(self.P, self.outer)
        self.inner_reach = extents(self.P, self.inner)
        self.start, self.slabs = start_of(certificate), slabs_of(certificate)
        self.start_reach = None if self.start is None else extents(self.start, 1.0)
        self.centre = None if self.start is None else centre_of(certificate)
        self.band = None if self.start is None else band_of(self.start, self.centre, self.slabs)
        self.far = self.reach if self.start_reach is None else np.maximum(self.reach, self._farthest(self.start_reach))
        self.flow = Flow.of(self.system, certificate.network)
        self.lo, self.hi = self.flow.lo, self.flow.hi
        side = np.minimum(-self.lo, self.hi)  # not positive in files that the checker refuses
        side = np.where(side > 0, side, np.nan)
        self.shares = self.reach / side
        self.start_shares = None if self.start_reach is None or self.centre is not None else self.start_reach / side
        self.pairs = list(pairs) if pairs is not None else pairs_of(self.system, self.P, self.far / side)
        self.effort = Effort.of(certificate.network, len(self.pairs))
        # With more than two states nothing is simulated from outside the sets.
        self.step, self.horizon = time_scales(self.flow, self.effort.rates, None if self.n <= 2 else self.far)
        units = self.system.units
        points = zip(self.system.states, self.system.exact_x_eq(), strict=True)
        self.labels = [deviation(s.name, q, units.get(s.name, "")) for s, q in points]
        self.input_labels = [label(s.name, units.get(s.name, "")) for s in self.system.inputs]
        # Another solver's word has no leaves; a partition in z, x = T z, is drawn only if it is small enough.
        evidence = certificate.evidence
        self.T, self.root = np.eye(self.n), np.ones(self.n)
        self.leaves: Leaves | None = None
        if isinstance(evidence, PartitionTree) and len(evidence.tree) <= 2 * _MOST_LEAVES:
            self.T, self.root = evidence.T, evidence.root
            self.leaves = leaves(evidence.tree, evidence.root)

    def _farthest(self, start_reach: Array) -> Array:
        """The reach from the origin of a tube's drawn part, (n,): its start, or all of it around a path."""
        if self.centre is None:
            return start_reach
        far = np.abs(self.centre) + start_reach
        if self.band is None:
            return far
        return np.asarray(np.maximum(far, np.max(np.abs(self.band.centre) + self.band.half, axis=0)))

    @property
    def held(self) -> str:
        """The values of uncertain quantities, and the period out of several, at which pictures are computed; empty if
        there is neither."""
        held = f" with {held_at(self.system)} throughout" if self.system.ranges else ""
        lo, hi = self.system.sample or (Fraction(0), Fraction(0))
        return held + (f" with periods of {exact_number(hi)} s" if lo < hi else "")

    @property
    def start_on_line(self) -> tuple[float, float]:
        """The interval from which a tube leads, for one state."""
        half = 0.0 if self.start_reach is None else float(self.start_reach[0])
        middle = 0.0 if self.centre is None else float(self.centre[0])
        return middle - half, middle + half

    @property
    def begin_on_line(self) -> tuple[float, float]:
        """The interval from which trajectories are drawn, for one state."""
        return (-float(self.far[0]), float(self.far[0])) if self.centre is None else self.start_on_line

    @property
    def settling_level(self) -> float:
        """The level of V at which a run counts as settled: near the origin, or {V <= c0}, which may be too small for a
        simulation to reach."""
        return max(self.inner if self.kind == "practical" else 0.0, SETTLED * self.outer)

    @property
    def duration(self) -> float:
        """The tube's duration in seconds; 0 without one."""
        return math.fsum(slab.duration for slab in self.slabs)

    @property
    def local_is_enough(self) -> bool:
        """True if the local rule covers the whole set, so that there are no leaves to show."""
        return is_local_enough(self.certificate)

    @property
    def shows_inner(self) -> bool:
        """True if there is an inner set besides the outer one."""
        return self.kind == "practical" or not self.local_is_enough

    def sees_inner(self, pair: Pair) -> bool:
        """True if the inner set is large enough to be seen in a picture of two states."""
        if not self.shows_inner:
            return False
        box = self.view(pair)
        return bool(np.any(2 * self.inner_reach[list(pair)] > _SEEN * (box.hi - box.lo)))

    @property
    def there(self) -> str:
        """The times at which trajectories are in a set after entering it, in words."""
        return self.timing.phrases["there"]

    @property
    def meaning(self) -> str:
        """The outer set's meaning, for captions."""
        return self.words.meaning + ("" if self.proved == "proved" else ", if the claim is true")

    def growth(self, x: Array) -> Array:
        """V's change per unit of time in float64: Vdot, or D in steps; NaN where the equations have a pole.

        With an outer set it is N's, and NaN in {V <= c2}, where N has no condition.
        """
        if self.beyond is None:
            value = growth(self.flow, self.P, x, self.step)
        else:
            with np.errstate(all="ignore"):
                value = np.sum(self.beyond.function.gradient(x) * self.flow.field(x), axis=-1)
            value = np.where(quadratic(self.P, x) <= self.outer, np.nan, value)
        return np.where(np.isfinite(value), value, np.nan)

    @property
    def falling(self) -> str:
        """The symbol of the quantity of `growth`."""
        return self.timing.derivative if self.beyond is None else "N′F"

    def in_outer(self, x: Array) -> NDArray[np.bool_]:
        """True for each state (..., n) in the outer set, in float64; False everywhere without one."""
        if self.beyond is None:
            return np.zeros(x.shape[:-1], dtype=np.bool_)
        with np.errstate(all="ignore"):
            low = self.beyond.function(x) <= self.beyond.level
        return np.asarray(low & np.all((x >= self.lo) & (x <= self.hi), axis=-1))

    def outline(self, pair: Pair) -> tuple[Array, Array, Array] | None:
        """Axes of a fine grid over the domain along two states and N less its level there, all other states 0.

        None without an outer set, and where it has no point on the grid.
        """
        if self.beyond is None:
            return None
        (i, j), points = pair, _FINE if self.n == 2 else _SEVERAL
        a, b = (np.linspace(self.lo[k], self.hi[k], points) for k in pair)
        x = np.zeros((points, points, self.n))
        x[..., i], x[..., j] = a[None, :], b[:, None]
        with np.errstate(all="ignore"):
            excess = self.beyond.function(x) - self.beyond.level
        return (a, b, np.where(np.isfinite(excess), excess, np.nan)) if np.any(excess <= 0) else None

    def farthest(self, pair: Pair, count: int) -> Array:
        """The last state of the outer set, or of {V <= c2}, along rays from the origin in a plane, (count, n)."""
        directions = np.zeros((count, self.n))
        directions[:, list(pair)] = circle(count)
        with np.errstate(divide="ignore"):
            far = np.min(
                np.maximum(self.lo / directions, self.hi / directions), axis=1, where=directions != 0, initial=np.inf
            )
        x = far[:, None, None] * np.linspace(0, 1, _ALONG)[:, None] * directions[:, None]
        inside = self.in_outer(x) | (quadratic(self.P, x) <= self.outer)
        last = _ALONG - 1 - np.argmax(inside[:, ::-1], axis=1)
        return np.asarray(x[np.arange(count), last])

    def simulate(self, begin: ArrayLike, steps: int | None = None) -> Runs:
        """Trajectories with their fates, by default over the tube and half the horizon; smooth for a picture."""
        wanted = PATH_STEP * self.step
        step = self.flow.fitting(wanted)
        every = (
            min(max(int(wanted / step), 1), _MOST_SHORT) if self.flow.period else 1
        )  # of short periods some are kept
        count = steps or min(int((self.duration + 0.5 * self.horizon) / step) + 1, every * self.effort.steps)
        starts, target = np.asarray(begin, dtype=np.float64), self.settling_level
        begins = self.start, self.centre, self.in_outer
        runs = runs_of(self.flow, starts, self.P, self.outer, target, step, count, self.deadline, *begins)
        if not self.timing.is_plain:  # the rate of change jumps where the input does
            return Runs(runs.path[::every], every * step, runs.settled, runs.left)
        return Runs(refine(runs.path, self.flow.field, step), step / PARTS, runs.settled, runs.left)

    def view(self, pair: Pair) -> Box:
        """The axes' limits of a picture of two states: the sets with some room within the domain; the domain itself if
        there are no other states, or there is an outer set."""
        lo, hi = self.lo[list(pair)], self.hi[list(pair)]
        if self.n == 2 or self.beyond is not None:
            margin = 0.03 * (hi - lo)
            return Box(lo - margin, hi + margin)
        if self.centre is not None and self.band is not None:
            ends = (
                self.band.centre[:, pair] - self.band.half[:, pair],
                self.band.centre[:, pair] + self.band.half[:, pair],
            )
            least, most = np.min(ends[0], axis=0), np.max(ends[1], axis=0)
            least, most = np.minimum(least, -self.reach[list(pair)]), np.maximum(most, self.reach[list(pair)])
            room = (_VIEW - 1) / 2 * (most - least)
            return Box(np.maximum(least - room, 1.06 * lo), np.minimum(most + room, 1.06 * hi))
        reach = _VIEW * self.far[list(pair)]
        return Box(np.maximum(-reach, 1.06 * lo), np.minimum(reach, 1.06 * hi))

    def plane(self, pair: Pair) -> tuple[Array, Array, Array]:
        """Grid coordinates along two states within the view and the domain, and the states (all others 0)."""
        box, (i, j) = self.view(pair), pair
        points = self.effort.grid if time.monotonic() < self.deadline else _LEAST
        lo, hi = np.maximum(box.lo, self.lo[[i, j]]), np.minimum(box.hi, self.hi[[i, j]])
        a, b = np.linspace(lo[0], hi[0], points), np.linspace(lo[1], hi[1], points)
        x = np.zeros((points, points, self.n))
        x[..., i], x[..., j] = a[None, :], b[:, None]
        return a, b, x


def starts(scene: Scene) -> Array:
    """Starting points: around the outline of a set in each plane and, for two states, along the domain's edge.

    The set is that of a tube's start if there is one, wherever it lies, else {V <= c2}; with an outer set it is the
    union of the two, and its outline that in the plane through the origin.
    """
    count = scene.effort.starts
    P, level = (scene.P, scene.outer) if scene.start is None else (scene.start, 1.0)
    middle = 0.0 if scene.centre is None else scene.centre
    blocks = [middle + over_level(P, pair, circle(count), 0.999 * level) for pair in scene.pairs]
    if scene.beyond is not None:
        blocks = [scene.farthest(pair, count) for pair in scene.pairs]
    if scene.n == 2:
        edge = 2 * np.pi * (np.arange(22) + 0.25) / 22
        ring = np.stack([np.cos(edge), np.sin(edge)], -1)
        ring /= np.max(np.abs(ring), axis=1, keepdims=True)
        centre, half = (scene.lo + scene.hi) / 2, (scene.hi - scene.lo) / 2
        blocks.append(centre + 0.985 * half * ring)
    return np.concatenate(blocks)
