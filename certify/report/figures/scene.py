"""Shared by the figures of one certificate: sets, labels, the flow, trajectories, and the effort for simulation.

The number of simulated points follows from the cost of one, and the work of all is counted, so that equal certificates
give equal pictures on fast, slow and busy machines. Where the effort is over runs end early, and say so.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from certify.certificates import Certificate, PartitionTree, leaves
from certify.effort import Effort
from certify.errors import CertificateFormatError
from certify.loop.policies import PolicyNetwork
from certify.lyapunov import extents
from certify.report.claims import Additions, words_for
from certify.report.figures.geometry import Box
from certify.report.figures.pairs import Pair, pairs_of
from certify.report.figures.sets import (
    band_of,
    centre_of,
    inner_of,
    is_ellipsoid,
    is_local_enough,
    ranked_of,
    reach_of_tube,
    slabs_of,
    start_of,
    system_of,
    taking_over_of,
)
from certify.report.flow import Flow, cost_of, time_scales
from certify.report.phrases import phrases_of
from certify.report.sampling import SETTLED, growth, quadratic
from certify.report.timing import TimingInWords
from certify.report.words import deviation, exact_number, held_at, label

Array = NDArray[np.float64]
Leaves = tuple[Array, Array]
"""Boxes `lower <= z <= upper`, both (N, n)."""
ON_BOUNDARY = 14  # trajectories that start on the proved set's boundary, in each plane
PATH_STEP = 0.6  # of the step of `time_scales`
_MOST_LEAVES = 400_000
_MOST_STEPS = 500
_GRIDS, _RUNS, _RATES = 2e9, 1e10, 5e8  # operations for grids, trajectories and the time scales
_SIMULATED = 3e10  # operations for all that is simulated, a few seconds on a quiet core
_LEAST = 25  # points along a grid
_FINE, _SEVERAL = 241, 121  # points along a grid for the outline of an outer set, in one plane and in each
_SEEN = 1 / 200  # of a picture's width: less is no more than a dot
_VIEW = 1.3  # of the set's reach, in pictures of more than two states


@dataclass(frozen=True, slots=True)
class Detail:
    """Amounts that are simulated.

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
    def of(cls, network: PolicyNetwork, planes: int) -> Detail:
        """The amounts that a policy's cost allows in so many planes."""
        cost = cost_of(network)
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
    effort : counted work for simulation; by default some seconds of it.

    Raises
    ------
    CertificateFormatError : there is no ellipsoid to draw, or the tree has no leaves.
    """

    def __init__(
        self,
        certificate: Certificate,
        accepted: bool,
        pairs: Sequence[Pair] | None = None,
        effort: Effort | None = None,
    ) -> None:
        self.effort = Effort(_SIMULATED) if effort is None else effort
        if not is_ellipsoid(certificate):
            raise CertificateFormatError("P must be positive definite and the levels positive and in order.")
        self.timing = TimingInWords.of(certificate.system, certificate.claim.rate)
        self.certificate, self.beyond = certificate, certificate.claim.outer
        self.words = words_for(certificate.kind, self.timing, Additions(beyond=self.beyond is not None))
        self.kind = "asymptotic" if certificate.claim.floor is None else "practical"
        self.word = "proved" if accepted else "claimed"
        self.system, self.P = system_of(certificate), certificate.P
        self.inner, self.outer = inner_of(certificate), certificate.roa
        self.n = self.system.n
        self.reach = extents(self.P, self.outer)
        self.ranked = ranked_of(certificate)
        self.inner_reach = extents(self.P, self.inner)
        self.taking_over = taking_over_of(certificate)
        self.start, self.slabs = start_of(certificate), slabs_of(certificate)
        self.start_reach = None if self.start is None else extents(self.start, 1.0)
        self.centre = None if self.start is None else centre_of(certificate)
        self.band = None if self.start is None else band_of(self.start, self.centre, self.slabs)
        self.far = (
            self.reach
            if self.start_reach is None
            else np.maximum(self.reach, reach_of_tube(self.start_reach, self.centre, self.band))
        )
        self.flow = Flow.of(self.system, certificate.network)
        self.lo, self.hi = self.flow.lo, self.flow.hi
        side = np.minimum(-self.lo, self.hi)  # not positive in files that the checker refuses
        side = np.where(side > 0, side, np.nan)
        self.shares = self.reach / side
        self.start_shares = None if self.start_reach is None or self.centre is not None else self.start_reach / side
        self.pairs = list(pairs) if pairs is not None else pairs_of(self.system, self.P, self.far / side)
        self.detail = Detail.of(certificate.network, len(self.pairs))
        # With more than two states nothing is simulated from outside the sets.
        self.step, self.horizon = time_scales(self.flow, self.detail.rates, None if self.n <= 2 else self.far)
        self.drawn = 0.5 * self.horizon  # of trajectories
        points = zip(self.system.states, self.system.exact_x_eq(), strict=True)
        self.labels = [deviation(s.name, q, self.system.units.get(s.name, "")) for s, q in points]
        self.input_labels = [label(s.name, self.system.units.get(s.name, "")) for s in self.system.inputs]
        # Another solver's word has no leaves; a partition in z, x = T z, is drawn only if it is small enough.
        evidence = certificate.evidence
        self.T, self.root = np.eye(self.n), np.ones(self.n)
        self.leaves: Leaves | None = None
        if isinstance(evidence, PartitionTree) and len(evidence.tree) <= 2 * _MOST_LEAVES:
            self.T, self.root = evidence.T, evidence.root
            self.leaves = leaves(evidence.tree, evidence.root)

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
        return phrases_of(self.timing)["there"]

    @property
    def meaning(self) -> str:
        """The outer set's meaning, for captions."""
        return self.words.meaning + ("" if self.word == "proved" else ", if the claim is true")

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

    def in_more(self, x: Array) -> NDArray[np.bool_]:
        """True for each state (..., n) in the outer set or in a box with a rank, in float64."""
        flat = x.reshape(-1, self.n)
        ranked = False if self.ranked is None else np.isfinite(self.ranked.ranks_at(flat)).reshape(x.shape[:-1])
        return np.asarray(self.in_outer(x) | ranked)

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
        points = _LEAST if self.effort.over else self.detail.grid
        lo, hi = np.maximum(box.lo, self.lo[[i, j]]), np.minimum(box.hi, self.hi[[i, j]])
        a, b = np.linspace(lo[0], hi[0], points), np.linspace(lo[1], hi[1], points)
        x = np.zeros((points, points, self.n))
        x[..., i], x[..., j] = a[None, :], b[:, None]
        return a, b, x
