"""Decide whether states lie in the set that a certificate proves: in rationals and, for N, in Arb balls.

The proved set consists of {V <= c2} and, under a claim with a tube, the tube's start. These are ellipsoids and so
convex: a box of states lies in one of them exactly if its corners do, and the corners' values are rational numbers.
Under a claim with an outer set, {N <= n2} within the domain belongs to it too and need not be convex. Then a box is cut
into pieces until each piece lies in one of the sets, or a state is found that lies in none. Under a claim with ranks
the leaves of finite rank belong to it (ranked.py).
Answers are about bytes that the checker accepted; a file that it rejects has no proved set.
"""

from __future__ import annotations

import hashlib
import itertools
import tempfile
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from certify.certificates import (
    AnyCertificate,
    InvariantCertificate,
    PartitionTree,
    ReachCertificate,
    RemainCertificate,
    parse_any,
    read_raw,
    run_checker,
)
from certify.certificates.ellipsoids import Box, Ellipsoid, steepest, sublevel_set, tube_start
from certify.certificates.formats import version_in
from certify.certificates.located import Containment, Located
from certify.certificates.ranked import Ranked
from certify.errors import InputError
from certify.loop.plants import System, with_origin
from certify.lyapunov import volume
from certify.lyapunov.sublevel import Sublevel

Array = NDArray[np.float64]
_CORNERS = 16  # 2 to the power of this many corners are looked at one by one
_PIECES = 4096  # of a box, that are looked at


NOTHING_PROVED = Located(Containment.UNDECIDED)
"""The place of any box if there is no proved set."""


@dataclass(frozen=True, slots=True)
class Region:
    """The union of `ellipsoids` and, where a claim has them, of an `outer` set or of `ranked` boxes, in deviations from
    x_eq; under a claim without V of `outer` or `ranked` alone."""

    ellipsoids: tuple[Ellipsoid, ...]
    outer: Sublevel | None = None
    ranked: Ranked | None = None

    @property
    def n(self) -> int:
        """The number of states."""
        if self.ranked is not None:
            return len(self.ranked.tree.lo)
        return len(self.ellipsoids[0].P) if self.outer is None else self.outer.function.n

    @property
    def largest(self) -> Ellipsoid:
        """The largest one of the ellipsoids around x_eq."""
        return max((e for e in self.ellipsoids if not e.centre), key=lambda e: volume(e.P, e.level))

    def holds(self, states: Iterable[Sequence[Fraction | float]]) -> list[bool]:
        """True for each state, as a deviation from x_eq, that lies in the set; a float means its binary value.

        Where N decides, True means shown: rounding admits no state, and one with N exactly n2 may stay undecided.
        """
        points = list(states)
        found = [e.holds(points) for e in self.ellipsoids]
        inside = [any(each) for each in zip(*found, strict=True)] if found else [False] * len(points)
        more = self.ranked if self.outer is None else self.outer
        if more is None:
            return inside
        beyond = iter(more.holds(x for x, known in zip(points, inside, strict=True) if not known))
        return [known or next(beyond) for known in inside]

    def holds_in_floats(self, x: Array) -> NDArray[np.bool_]:
        """True for states (N, n), as deviations from x_eq, that lie in the set up to rounding: for estimates."""
        inside = np.zeros(len(x), dtype=np.bool_)
        for one in self.ellipsoids:
            y = x if not one.centre else x - np.array(one.centre)
            inside |= np.einsum("bi,ij,bj->b", y, one.P, y) <= one.level
        if self.outer is not None:
            inside |= self.outer.function(x) <= self.outer.level
        if self.ranked is not None:
            inside |= np.isfinite(self.ranked.ranks_at(x))
        return inside

    def excludes(self, states: Iterable[Sequence[Fraction | float]]) -> list[bool]:
        """True for each state, as a deviation from x_eq, that is shown to lie outside the set."""
        points = list(states)
        found = [[not inside for inside in e.holds(points)] for e in self.ellipsoids]
        found += [more.excludes(points) for more in (self.outer, self.ranked) if more is not None]
        return [all(each) for each in zip(*found, strict=True)]

    def locate(self, box: Box) -> Located:
        """Decide whether a box of states, as deviations from x_eq, lies in the set.

        If at most 16 intervals have a width, the corners decide, unless one ellipsoid holds some of them and another
        the rest. With more, a bound of x'Px on the box may show that it is contained, and a corner that it is not.
        With an outer set the question is put to pieces of the box, at most 4,096; with ranks to the leaves that it
        meets.

        Raises
        ------
        InputError : the box has another number of states, or an interval has lo > hi.
        """
        n = self.n
        if len(box) != n or not all(lo <= hi for lo, hi in box):
            raise InputError(f"a box must have {n} intervals lo <= hi; found {_shown(box)}.")
        wide = [i for i, (lo, hi) in enumerate(box) if lo < hi]
        if len(wide) > _CORNERS:
            corners = [steepest(e, box) for e in self.ellipsoids]
            contained = [e.covers(box) for e in self.ellipsoids]
        else:
            ends = (pair if pair[0] < pair[1] else pair[:1] for pair in box)
            corners = list(itertools.product(*ends))
            contained = [e.covers(box) or all(e.holds(corners)) for e in self.ellipsoids]  # a bound costs no corner
        for ellipsoid, whole in zip(self.ellipsoids, contained, strict=True):
            if whole:
                return Located(Containment.CONTAINED, within=ellipsoid.name)
        for corner, outside in zip(corners, self.excludes(corners), strict=True):
            if outside:
                return Located(Containment.NOT_CONTAINED, outside=corner)
        if self.ranked is not None:
            return self.ranked.locate(box)
        return Located(Containment.UNDECIDED) if self.outer is None else self._by_pieces(box, self.outer)

    def _by_pieces(self, box: Box, outer: Sublevel) -> Located:
        """The same for a box that is cut into pieces, the large ones first, each at its middle along an axis."""
        waiting, used = deque([box]), set[str]()
        for _ in range(_PIECES):
            piece = waiting.popleft()
            name = next((e.name for e in self.ellipsoids if e.covers(piece)), None)
            seen = outer.look(piece) if name is None else None
            if seen is None or seen.covered:
                used.add(name or outer.name)
                if not waiting:
                    named = (one for one in (*(e.name for e in self.ellipsoids), outer.name) if one in used)
                    return Located(Containment.CONTAINED, within=" and ".join(named))
                continue
            middle = tuple((lo + hi) / 2 for lo, hi in piece)
            if self.excludes([middle])[0]:
                return Located(Containment.NOT_CONTAINED, outside=middle)
            if seen.axis is None:
                break
            (lo, hi), at = piece[seen.axis], middle[seen.axis]
            waiting += [(*piece[: seen.axis], half, *piece[seen.axis + 1 :]) for half in ((lo, at), (at, hi))]
        return Located(Containment.UNDECIDED)


@dataclass(frozen=True, slots=True, kw_only=True)
class ProvedSet(Region):
    """The union of the sets that an accepted certificate proves something about, in deviations from x_eq.

    Parameters
    ----------
    system : the plant of the certificate. Its x_eq is what the file says for people; no rule depends on it.
    claim : the claim's kind.
    policy_sha256, certificate_sha256 : of the policy that it is about, and of the file.
    origin : where x = 0 lies among the states that the policy's layers read, (n,); empty for 0. The plant is in
        deviations from there, and so are the states that are asked about.
    """

    system: System
    claim: str
    policy_sha256: str
    certificate_sha256: str
    origin: tuple[float, ...] = ()

    def seen_from_there(self, system: System) -> System:
        """A plant whose states the policy's layers read, in deviations from where x = 0 lies for this set.

        Raises
        ------
        InputError : that does not lie in the interior of the plant's domain.
        """
        if not any(self.origin):
            return system
        return with_origin(system, [Fraction(v) for v in self.origin], self.system.exact_u_eq())

    def deviations(self, states: Iterable[Sequence[Fraction | float]]) -> list[list[Fraction]]:
        """States that the policy's layers read, as deviations from where x = 0 lies for this set."""
        at = [Fraction(v) for v in self.origin] or [Fraction(0)] * self.system.n
        return [[Fraction(v) - q for v, q in zip(x, at, strict=True)] for x in states]


def proved_set(path: Path) -> ProvedSet:
    """The set of a certificate that the checker accepts.

    Raises
    ------
    InputError : the checker does not accept it.
    CertificateFormatError : the file cannot be read.
    """
    return set_of(accepted_bytes(path), str(path))


def accepted_bytes(path: Path) -> bytes:
    """The bytes of a certificate, after a check of exactly them, as `certify check` does it.

    Raises
    ------
    InputError : the checker does not accept it; a solver's answer, TRUSTED, is no proof.
    CertificateFormatError : the file cannot be read.
    """
    raw = read_raw(path)
    with tempfile.TemporaryDirectory() as folder:  # whatever happens to the path meanwhile
        private = Path(folder) / "certificate.json"
        private.write_bytes(raw)
        answer = run_checker(private)
    if answer["result"] != "ACCEPTED":
        old = version_in(raw)
        why = f" rule={answer['rule']} at={answer['at']}: {answer['detail']}" if "rule" in answer else ""
        raise InputError(
            f"{path} must be a certificate that the checker accepts; it says {answer['result']}{why:.300}. "
            f"{old or 'Without that there is no proved set.'}"
        )
    return raw


def set_of(raw: bytes, name: str) -> ProvedSet:
    """The set of a certificate's bytes, which the checker has accepted; `name` names them in messages.

    Raises
    ------
    CertificateFormatError : the bytes are no certificate.
    """
    read = parse_any(raw, name)
    region = region_of(read)
    return ProvedSet(
        region.ellipsoids,
        region.outer,
        region.ranked,
        system=read.system,
        claim=read.kind,
        policy_sha256=read.network.sha256(),
        certificate_sha256=hashlib.sha256(raw).hexdigest(),
        origin=tuple(read.network.origin.tolist()) if read.network.is_moved else (),
    )


def region_of(read: AnyCertificate) -> Region:
    """The region that a certificate is about; whether it is proved is for the checker to say."""
    if isinstance(read, ReachCertificate | RemainCertificate):
        return Region((), ranked=Ranked(read.evidence.ranks, None, angles_in(read.system)))
    if isinstance(read, InvariantCertificate):
        return Region((), Sublevel(read.claim.outer.function, read.claim.outer.level, tuple(read.system.domain)))
    claim = read.claim
    starts = () if claim.start is None else (tube_start(claim.start.P, claim.centre),)
    outer = (
        None if claim.outer is None else Sublevel(claim.outer.function, claim.outer.level, tuple(read.system.domain))
    )
    inner, tree = (
        sublevel_set(read.P, claim.roa),
        read.evidence.ranks if isinstance(read.evidence, PartitionTree) else None,
    )
    ranked = None if claim.ranks is None or tree is None else Ranked(tree, inner, angles_in(read.system))
    return Region((inner, *starts), outer, ranked)


def angles_in(system: System) -> tuple[int, ...]:
    """The numbers of a plant's angles among its states."""
    return tuple(i for i, s in enumerate(system.states) if s.name in system.angles)


def _shown(box: Box) -> str:
    return ", ".join(f"[{float(lo):.6g}, {float(hi):.6g}]" for lo, hi in box)
