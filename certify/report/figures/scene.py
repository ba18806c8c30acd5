"""What the figures of one certificate share: sets, labels, the flow, and trajectories."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from certify.certificate import Certificate, PartitionTree, leaves
from certify.errors import CertificateFormatError
from certify.lyapunov import extents, is_positive_definite
from certify.report.figures.geometry import circle, on_level, refine
from certify.report.sampling import SETTLED, Flow, quadratic, simulate, time_scales
from certify.report.words import deviation, label, words_for

Array = NDArray[np.float64]
Leaves = tuple[Array, Array]
"""Boxes `lower <= z <= upper`, both (N, n)."""
ON_BOUNDARY = 14  # trajectories that start on the certified boundary, in each plane
PATH_STEP = 0.6  # of the step of `time_scales`
_MOST_LEAVES = 400_000
_GRID = 101
_MOST_STEPS = 500


def is_ellipsoid(certificate: Certificate) -> bool:
    """Whether `{V <= c2}` is one, with levels in order; a rejected file may hold anything."""
    P = certificate.P
    ordered = 0 < certificate.inner <= certificate.roa < np.inf
    return ordered and bool(np.all(np.isfinite(P))) and is_positive_definite(P)


class Scene:
    """What the figures of one certificate share.

    Raises
    ------
    CertificateFormatError : there is no ellipsoid to draw, or the tree has no leaves.
    """

    def __init__(self, certificate: Certificate, accepted: bool) -> None:
        if not is_ellipsoid(certificate):
            raise CertificateFormatError("P must be positive definite and the levels positive and in order.")
        self.certificate, self.kind, self.words = certificate, certificate.kind, words_for(certificate.kind)
        self.word, self.proved = ("certified", "proved") if accepted else ("claimed", "claimed")
        self.system, self.P = certificate.system, certificate.P
        self.inner, self.outer = certificate.inner, certificate.roa
        self.n = self.system.n
        self.reach = extents(self.P, self.outer)
        self.inner_reach = extents(self.P, self.inner)
        self.flow = Flow.of(self.system, certificate.network)
        self.lo, self.hi = self.flow.lo, self.flow.hi
        self.step, self.horizon = time_scales(self.flow)
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

    @property
    def settling_level(self) -> float:
        """V at which a run has done what the claim says of it: near the origin, or in {V <= c0}."""
        return self.inner if self.kind == "practical" else SETTLED * self.outer

    @property
    def local_is_enough(self) -> bool:
        """Whether the local rule covers the whole set, so that leaves are not asked (FORMAT.md, local)."""
        return self.kind == "asymptotic" and self.inner == self.outer

    @property
    def meaning(self) -> str:
        """Of the outer set, for captions."""
        return self.words.meaning + ("" if self.proved == "proved" else ", if the claim is true")

    def vdot(self, x: Array) -> Array:
        """Vdot in float64; NaN where the equations have a pole."""
        with np.errstate(all="ignore"):
            value = 2 * np.einsum("...i,...i->...", x @ self.P, self.flow.field(x))
        return np.where(np.isfinite(value), value, np.nan)

    def simulate(self, begin: ArrayLike, steps: int | None = None) -> Array:
        """Trajectories for a picture, by default over half the horizon."""
        step = PATH_STEP * self.step
        count = steps or min(int(0.5 * self.horizon / step) + 1, _MOST_STEPS)
        return refine(simulate(self.flow, np.asarray(begin, dtype=np.float64), step, count), self.flow.field, step)

    def plane(self, i: int, j: int, points: int = _GRID) -> tuple[Array, Array, Array]:
        """Grid coordinates along states i and j, and the states themselves (all others 0)."""
        a, b = (np.linspace(self.lo[k], self.hi[k], points) for k in (i, j))
        x = np.zeros((points, points, self.n))
        x[..., i], x[..., j] = a[None, :], b[:, None]
        return a, b, x


def planes(scene: Scene) -> list[tuple[int, int]]:
    """Pairs of states to show: each position with its rate where names tell, else neighbours; three at most."""
    names = [s.name for s in scene.system.states]
    pairs = [(i, names.index(f"{name}_dot")) for i, name in enumerate(names) if f"{name}_dot" in names]
    return (pairs or list(pairwise(range(scene.n)))[::2])[:3]


def starts(scene: Scene, pairs: Sequence[tuple[int, int]]) -> Array:
    """Starting points in the planes: around the certified boundary and, for two states, along the domain's edge."""
    blocks = []
    for pair in pairs:
        block = np.zeros((ON_BOUNDARY, scene.n))
        block[:, list(pair)] = on_level(scene.P[np.ix_(pair, pair)], circle(ON_BOUNDARY), 0.999 * scene.outer)
        blocks.append(block)
    if scene.n == 2:
        edge = 2 * np.pi * (np.arange(22) + 0.25) / 22
        ring = np.stack([np.cos(edge), np.sin(edge)], -1)
        ring /= np.max(np.abs(ring), axis=1, keepdims=True)
        middle, half = (scene.lo + scene.hi) / 2, (scene.hi - scene.lo) / 2
        blocks.append(middle + 0.985 * half * ring)
    return np.concatenate(blocks)


def settled(scene: Scene, paths: Array) -> NDArray[np.bool_]:
    """Runs that end deep inside the certified set; under the practical claim, inside the inner one."""
    target = scene.inner if scene.kind == "practical" else 0.1 * scene.outer
    with np.errstate(invalid="ignore"):
        return np.asarray(quadratic(scene.P, paths[-1]) <= target)
