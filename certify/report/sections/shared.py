"""Parts of a certificate that several sections need: the words for its claim, its ellipsoids, its tube, its policy.

Code for a single section stands in that section.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from certify.certificates import AnyCertificate, Certificate, PartitionTree
from certify.certificates.membership import angles_in
from certify.certificates.ranked import Count, count
from certify.errors import CertificateFormatError
from certify.report.claims import Additions, Words, words_for
from certify.report.figures.sets import centre_of, slabs_of, start_of, tree_of
from certify.report.handover import TakingOver
from certify.report.timing import TimingInWords
from certify.report.words import ABSENT, above, below, number, point, symbol


def timing_of(certificate: AnyCertificate) -> TimingInWords:
    """The timing of its loop, with the rate at which V is claimed to fall."""
    rate = certificate.claim.rate if isinstance(certificate, Certificate) else 0.0
    return TimingInWords.of(certificate.system, rate)


def words_of(certificate: Certificate) -> Words:
    """Its kind of claim in words."""
    return words_for(certificate.kind, timing_of(certificate), additions_of(certificate))


def additions_of(certificate: Certificate) -> Additions:
    """The parts that its claim has beside its levels, and a ball in its evidence."""
    evidence, claim = certificate.evidence, certificate.claim
    return Additions(
        ball=(ball := evidence.local if isinstance(evidence, PartitionTree) else None) is not None,
        kinked=ball is not None and ball.directions is not None,
        beyond=claim.outer is not None,
        ranked=claim.ranks is not None,
        angles=() if claim.ranks is None else claim.ranks.angles,
        kept=bool(claim.keep),
        then=None if certificate.then is None else TakingOver(certificate.then.kind, below(certificate.then.roa)),
    )


def ranks_of(certificate: AnyCertificate) -> Count | None:
    """The numbers of its boxes with ranks; None without any, and where a rejected file's tree is none."""
    tree = tree_of(certificate)
    try:
        return None if tree is None else count(tree, angles_in(certificate.system))
    except CertificateFormatError:
        return None


@dataclass(frozen=True, slots=True)
class Ellipsoid:
    """{x'Px <= level}, a set of the certificate; `kind` is `start` for that of a tube, else `set`.

    It lies around the origin, that of a tube around a path around its c₀.
    """

    kind: str
    name: str
    P: NDArray[np.float64]
    level: float


def ellipsoids_of(certificate: Certificate) -> list[Ellipsoid]:
    """The start of a tube where there is one, and {V <= c2}."""
    start = start_of(certificate)
    inner = Ellipsoid("set", "{V ≤ c₂}", certificate.P, certificate.roa)
    name = "the start" if centre_of(certificate) is None else "the start, around c₀"
    return [inner] if start is None else [Ellipsoid("start", name, start, 1.0), inner]


def shares_of(certificate: Certificate, lengths: NDArray[np.float64]) -> list[float]:
    """Lengths along the states (n,) as shares of the nearer sides of the domain; infinite where that has none."""
    sides = [min(-lo, hi) for lo, hi in certificate.system.domain]
    each = zip(lengths, sides, strict=True)
    return [float(Fraction(float(v)) / side) if side > 0 else math.inf for v, side in each]


def centre_in_words(certificate: Certificate, *, of_values: bool = False) -> str:
    """c₀ of a tube around a path in words, as a deviation or by the states' values; a dash where there is none."""
    system, centre = certificate.system, centre_of(certificate)
    if centre is None or start_of(certificate) is None:
        return ABSENT
    names, units = [s.name for s in system.states], [system.units.get(s.name, "") for s in system.states]
    shifts = system.exact_x_eq() if of_values else [Fraction(0)] * system.n
    return point(names, [q + Fraction(c) for q, c in zip(shifts, centre.tolist(), strict=True)], units)


def duration_in_words(certificate: Certificate) -> str:
    """The tube's duration, rounded up; a dash if there is none, or a rejected file's is not finite."""
    each = [slab.duration for slab in slabs_of(certificate)]
    return f"{above(sum(map(Fraction, each)))} s" if each and all(map(math.isfinite, each)) else ABSENT


def read_in_words(certificate: AnyCertificate) -> str:
    """The layers' inputs under a policy whose origin is another state, in the states' units."""
    states, origin = certificate.system.states, certificate.network.origin.tolist()
    each = zip(states, origin, strict=True)
    return ", ".join(f"{number(v, 10)} + {symbol(s.name)}" if v else symbol(s.name) for s, v in each)
