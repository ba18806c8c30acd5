"""The sets of a certificate, as the figures draw them; a rejected file may hold anything."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from certify.certificates import (
    AnyCertificate,
    Certificate,
    PartitionTree,
    RanksAlone,
    RankTree,
    Slab,
)
from certify.certificates.ellipsoids import sublevel_set
from certify.certificates.membership import angles_in
from certify.certificates.ranked import Ranked
from certify.loop.plants import System
from certify.lyapunov import is_positive_definite

Array = NDArray[np.float64]
_POINTS = 240  # of a tube's edge over time, about


def is_ellipsoid(certificate: Certificate) -> bool:
    """True if `{V <= c2}` is an ellipsoid with its levels in order."""
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


def taking_over_of(certificate: Certificate) -> tuple[Array, float] | None:
    """P' (n, n) and c2' of {V' <= c2'}, where the claim of a second certificate begins; None without one, or if a
    rejected file has something else there."""
    then = certificate.then
    if then is None or then.P.shape != certificate.P.shape or not is_ellipsoid(then):
        return None
    return then.P, then.roa


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


def tree_of(certificate: AnyCertificate) -> RankTree | None:
    """The tree of the boxes with ranks; None without any."""
    evidence = certificate.evidence
    return evidence.ranks if isinstance(evidence, PartitionTree | RanksAlone) else None


def ranked_of(certificate: Certificate) -> Ranked | None:
    """The boxes with ranks, with {V <= c2}; None without any.

    Raises
    ------
    CertificateFormatError : a rejected file's tree is none.
    """
    tree = tree_of(certificate)
    if tree is None:
        return None
    return Ranked(tree, sublevel_set(certificate.P, certificate.roa), angles_in(certificate.system))


def system_of(certificate: Certificate) -> System:
    """The plant as pictures simulate it: with its angles only where the claim takes full turns for the same place."""
    system = certificate.system
    if certificate.claim.ranks is not None or not system.angles:
        return system
    return replace(system, angles=())


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


def reach_of_tube(start_reach: Array, centre: Array | None, band: Band | None) -> Array:
    """The reach from the origin of a tube's drawn part, (n,): its start, or all of it around a path."""
    if centre is None:
        return start_reach
    far = np.abs(centre) + start_reach
    if band is None:
        return far
    return np.asarray(np.maximum(far, np.max(np.abs(band.centre) + band.half, axis=0)))
