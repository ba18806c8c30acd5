"""Search for the evidence of Coq's check, in plain floats: coordinates, a core around the origin, a partition.

Coq says of each box that it lies outside of the set, that it lies in the core, or that `Vdot + rate V + k (c2 - V) < 0`
on it for some k >= 0, the inputs within their bounds; on the core it compares F with its slopes from the origin, by
Gaussian elimination in intervals. Nothing found here is trusted, so rounding is ignored; a small margin leaves room for
Coq's rounding.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from certify.certificates.coq.data import Claimed
from certify.certificates.coq.evidence import Evidence, Matrix, Tree, inverse
from certify.certificates.coq.expression import at_rest
from certify.certificates.coq.nodes import Nodes
from certify.certificates.coq.slopes import Bounds, Boxes, Interval, bounds, field_of, inputs_of
from certify.errors import InputError

Array = NDArray[np.float64]
_MARGIN = 1e-9  # relative; Coq's rounding needs far less
_BITS = 20  # of the coordinates
_DEEPEST = 60
_BATCH = 2_000
_TRIALS = 6
_WORTHWHILE = 0.7  # of the boxes: a smaller rate that needs more is not worth it
_SHARE = Fraction(1, 20)  # of the slowest rate of the linearised loop


@dataclass(frozen=True, slots=True)
class Limits:
    """The limits of a search: seconds and leaves."""

    seconds: float = 60.0
    boxes: int = 20_000

    def __post_init__(self) -> None:
        if not (self.seconds > 0 and self.boxes >= 1):
            raise InputError(
                f"the limits must be positive seconds and at least one box; found {self.seconds} and {self.boxes}."
            )


@dataclass(frozen=True, slots=True)
class Found:
    """The result of a search.

    Parameters
    ----------
    rate : the rate required of V.
    evidence : the evidence; None if none was found.
    boxes : the number of boxes examined.
    seconds : the time taken.
    reason : why no evidence was found; empty if it was.
    """

    rate: Fraction
    evidence: Evidence | None
    boxes: int
    seconds: float
    reason: str = ""


class _NotFound(Exception):
    """One attempt, of one rate in one choice of coordinates, ends without a proof."""


def search(claimed: Claimed, rate: Fraction | None = None, limits: Limits | None = None) -> Found:
    """Find the evidence for Coq's check of a claim.

    Parameters
    ----------
    rate : the claimed rate of V; None for one that costs little: a small share of the slowest rate of the linearised
    loop, or a smaller one if nothing is found with it or far fewer boxes suffice then.
    limits : limits of the whole search.

    Raises
    ------
    InputError : the rate is not positive, or less than the certificate's; or the loop's form does not show that the
    origin is its equilibrium.
    """
    limits = limits or Limits()
    least = 2 * Fraction(claimed.rate)
    if rate is not None and not (rate > 0 and rate >= least):
        raise InputError(f"the rate must be positive and at least {2 * claimed.rate:.6g}; found {rate}.")
    start = time.monotonic()
    _require_rest(claimed)
    try:
        return _searched(claimed, rate, start, limits)
    except (ArithmeticError, np.linalg.LinAlgError) as error:
        reason = f"the claim has numbers, or the search found some, that floats cannot hold: {error}"
        return Found(rate or least or Fraction(1), None, 0, time.monotonic() - start, reason)


def _searched(claimed: Claimed, rate: Fraction | None, start: float, limits: Limits) -> Found:
    slowest = -float(np.linalg.eigvals(jacobian(claimed)).real.max())
    deadline, most = start + limits.seconds, limits.boxes
    boxes, reason, tried = 0, "the linearised loop does not decay", rate or Fraction(1)
    best: tuple[Fraction, Evidence] | None = None
    for tried in [rate] if rate is not None else _rates(slowest, 2 * Fraction(claimed.rate)):
        attempts = [_Attempt(claimed, T, tried, deadline, most) for T in _coordinates(claimed)]
        evidence, why = _first(attempts)
        boxes, reason = boxes + sum(attempt.boxes for attempt in attempts), why or reason
        if evidence is not None:
            best, most = (tried, evidence), math.floor(_WORTHWHILE * evidence.leaves)
        elif best is not None:
            break
        if most < 1:
            break
    seconds = time.monotonic() - start
    return Found(tried, None, boxes, seconds, reason) if best is None else Found(*best, boxes, seconds)


def _first(attempts: list[_Attempt]) -> tuple[Evidence | None, str]:
    """The evidence of the first attempt that finds one, and why the last that failed did not."""
    reason = ""
    for attempt in attempts:
        try:
            return attempt.run(), reason
        except _NotFound as why:
            reason = str(why)
    return None, reason


def _require_rest(claimed: Claimed) -> None:
    """Reject a loop whose equilibrium at the origin Coq's check cannot decide: it decides it in rationals."""
    network, u_eq = claimed.network, dict(enumerate(claimed.u_eq))
    for i, e in enumerate(claimed.field):
        value = at_rest(e, u_eq)
        if value != 0:
            found = "no rational number" if value is None else str(value)
            raise InputError(
                f"f(0, u_eq) must be 0 by its form, as Coq decides it in rationals; found {found} in entry {i}."
            )
    if network.centre == "preactivation":
        network.ratios(claimed.u_eq)
    offsets = tuple(Fraction(float(o)) for o in network.offset)
    if network.centre == "none" and (any(b.any() for b in network.biases) or offsets != claimed.u_eq):
        raise InputError(
            "a policy without centring must have no biases and the offset u_eq, for Coq to see that it is u_eq at the "
            "origin; found others. Centre it."
        )


def jacobian(claimed: Claimed) -> Array:
    """dF/dx at the origin, (n, n): the slopes on a box that is a point."""
    point = np.zeros((1, claimed.n))
    x = Boxes(point, point).coordinates()
    return np.array([f.slopes.lo[0] for f in field_of(claimed, x, inputs_of(claimed, x))])


def _rates(slowest: float, least: Fraction) -> Iterator[Fraction]:
    """Rates to try, short ones: never less than the certificate's."""
    share = Fraction(max(slowest, 0.0)) * _SHARE
    for _ in range(_TRIALS):
        if share > 0:
            short = Fraction(math.floor(share)) if share >= 1 else Fraction(1, math.ceil(1 / share))
            yield max(short, least)
            if short <= least:
                return
            share /= 4


def _coordinates(claimed: Claimed) -> Iterator[Matrix]:
    """Coordinates in which the set is about the unit ball: in the first, its derivative along the linearised loop is a
    sum of squares; in the second, boxes lie as those of the certificate's evidence."""
    P, A, level = claimed.P, jacobian(claimed), claimed.level
    try:
        whitened = np.linalg.inv(np.linalg.cholesky(P)).T * math.sqrt(level)  # whitened' P whitened = level
    except np.linalg.LinAlgError:
        return
    decrease = whitened.T @ (P @ A + A.T @ P) @ whitened
    yield _short(whitened @ np.linalg.eigh(decrease + decrease.T)[1])
    if claimed.coordinates is not None and abs(np.linalg.det(claimed.coordinates)) > 0:
        T = claimed.coordinates
        yield _short(T * np.sqrt(level / np.einsum("ik,ij,jk->k", T, P, T)))


def _short(T: Array) -> Matrix:
    """The matrix with entries of few binary digits, each row to the same place."""
    found = []
    for row in T:
        unit = Fraction(2) ** (math.frexp(float(np.abs(row).max()))[1] - _BITS)
        found.append(tuple(round(Fraction(float(v)) / unit) * unit for v in row))
    return tuple(found)


def _up(value: float, bits: int = 24) -> float:
    """A number of few binary digits, not less."""
    mantissa, exponent = math.frexp(value)
    return math.ldexp(math.ceil(mantissa * 2**bits), exponent - bits)


def _down(value: float, bits: int = 12) -> float:
    return -_up(-value, bits) if value else 0.0


class _Attempt:
    """The search for one rate in one choice of coordinates."""

    def __init__(self, claimed: Claimed, T: Matrix, rate: Fraction, deadline: float, leaves: int) -> None:
        self.claimed, self.exact, self.rate = claimed, T, float(rate)
        self.T = np.array([[float(v) for v in row] for row in T])
        self.S = self.T.T @ claimed.P @ self.T
        self.deadline, self.most, self.boxes = deadline, leaves, 0

    def run(self) -> Evidence:
        """The evidence.

        Raises
        ------
        _NotFound : with what was reached.
        """
        widths = np.sqrt(self.claimed.level * np.diag(np.linalg.inv(self.S)))
        root = np.array([_up(v * (1 + 1e-6)) for v in widths])
        self._require_fitting(root)
        core = self._core(root)
        tree = self._partition(root, core)
        return Evidence(self.exact, inverse(self.exact), tuple(root.tolist()), tuple(core.tolist()), tree)

    def _require_fitting(self, root: Array) -> None:
        """The set lies in the root box, and in the domain, as Coq looks at it."""
        level, n = self.claimed.level, self.claimed.n
        reach = np.array([min(-float(lo), float(hi)) for lo, hi in self.claimed.domain])
        for rows, widths, what in ((np.eye(n), root, "the root box"), (self.T, reach, "the domain")):
            for row, width in zip(rows, widths, strict=True):
                matrix = width**2 * self.S - level * np.outer(row, row)
                if not (width > 0 and _definite(Interval(matrix[None], matrix[None]))[0]):
                    raise _NotFound(f"the set does not lie in {what} by a margin that floats show")

    # The core

    def _core(self, root: Array) -> Array:
        """Half-widths of a large box around the origin on which Coq's comparison with the slopes succeeds."""
        shares = np.geomspace(1e-4, 1, 97)
        good = self._compares(shares[:, None] * root)
        if not good[0]:
            raise _NotFound("no box around the origin is small enough for the slopes there; is the rate too large?")
        core = shares[int(np.argmin(good)) - 1 if not good.all() else -1] * root
        for factor in (1.5, 1.2, 1.1, 1.05, 1.02):
            while True:
                wider = np.minimum(core * np.where(np.eye(len(core), dtype=bool), factor, 1.0), root)
                ok = self._compares(wider) & np.any(wider > core, axis=1)
                if not ok.any():
                    break
                core = wider[int(np.argmax(np.where(ok, wider.prod(1), 0)))]
        return np.array([w if w >= r else _down(w) for w, r in zip(core, root, strict=True)])

    def _compares(self, widths: Array) -> NDArray[np.bool_]:
        """True for each box around the origin, (N, n), on which the comparison succeeds."""
        self.boxes += len(widths)
        found = bounds(self.claimed, self.T, Boxes(np.zeros_like(widths), widths))
        Y = self.claimed.P @ self.T
        G = Interval(*(np.stack([getattr(f.slopes, end) for f in found.F], axis=1) for end in ("lo", "hi")))
        doubled = G.through(2 * Y.T)
        S = self.rate * self.S
        negated = -Interval(doubled.lo + S, doubled.hi + S)
        return np.asarray(_definite(negated) & self._within(found))

    def _within(self, found: Bounds) -> NDArray[np.bool_]:
        """True on each box where the inputs keep their bounds; on all if tanh keeps them, which Coq decides exactly."""
        network, fits = self.claimed.network, np.ones(len(found.V.value), dtype=bool)
        by_form = network.squash == "tanh" and network.centre != "output"
        for j, (u, (lo, hi)) in enumerate(zip(found.inputs, self.claimed.bounds, strict=True)):
            scale, offset = abs(Fraction(float(network.scale[j]))), Fraction(float(network.offset[j]))
            if not (by_form and lo <= offset - scale and offset + scale <= hi):
                margin = _MARGIN * float(hi - lo)
                fits &= (u.range.lo >= float(lo) + margin) & (u.range.hi <= float(hi) - margin)
        return fits

    # The ring

    def _partition(self, root: Array, core: Array) -> Tree:
        """Divide the root box: first around the core, and then every box that is not done."""
        nodes = Nodes(len(root))
        open_, lo, hi = nodes.around(core, root)
        leaves = 1
        while len(open_):
            if time.monotonic() > self.deadline:
                raise _NotFound(f"the time ended with {leaves} boxes done and {len(open_)} left")
            if leaves + len(open_) > self.most:
                raise _NotFound(f"more than {self.most} boxes are needed: {leaves} done and {len(open_)} left")
            lost, at = [], []
            for part in range(0, len(open_), _BATCH):
                piece = slice(part, part + _BATCH)
                done, k, axes = self._examine(lo[piece], hi[piece], core)
                leaves += int(done.sum())
                nodes.close(open_[piece][done], k[done])
                lost.append(~done)
                at.append(axes)
            left, axis = np.concatenate(lost), np.concatenate(at)
            open_, lo, hi = nodes.divide(open_[left], lo[left], hi[left], axis[left])
            if nodes.depth > _DEEPEST:
                raise _NotFound(
                    f"boxes get too small: {leaves} done and {len(open_)} left, one around {lo[0].tolist()}"
                )
        return nodes.tree()

    def _examine(self, lo: Array, hi: Array, core: Array) -> tuple[NDArray[np.bool_], Array, NDArray[np.intp]]:
        """Find for each box: whether it is done, its multiplier k, and the best axis to split it."""
        self.boxes += len(lo)
        with np.errstate(all="ignore"):
            found = bounds(self.claimed, self.T, Boxes((lo + hi) / 2, (hi - lo) / 2))
            self._require_decrease(found)
            level = self.claimed.level
            outside = found.V_plain.lo > level * (1 + _MARGIN)
            inner = np.all((lo >= -core) & (hi <= core), axis=1)
            k, largest, slopes = self._multiplier(found)
            size = np.abs(found.Vdot.value) + (self.rate + k) * level
            decreasing = (largest < -_MARGIN * size) & self._within(found)
            done = outside | inner | decreasing
            steepness = np.nan_to_num(slopes.magnitude * found.V.boxes.half, nan=0.0, posinf=0.0)
            lost = ~(steepness.max(axis=1) > 0)
            steepness[lost] = ((hi - lo) / (2 * core))[lost]
        return done, np.where(outside | inner, 0.0, k), np.argmax(steepness, axis=1)

    def _multiplier(self, found: Bounds) -> tuple[Array, Array, Interval]:
        """Choose among few candidates the k >= 0 with the least bound of `Vdot + rate V + k (c2 - V)`.

        Return k, the bound, and the slopes. The bound by slopes is convex and piecewise linear in k; it bends where a
        slope of the sum is 0 in its middle.
        """
        D = found.Vdot + found.V.times(self.rate)
        V, W = found.V, found.V.plus(-self.claimed.level)
        ratios = (D.slopes.lo + D.slopes.hi) / (V.slopes.lo + V.slopes.hi)
        candidates = np.nan_to_num(np.maximum(ratios, 0.0), nan=0.0, posinf=0.0).T
        k = np.zeros(len(D.value))
        largest, slopes = D.range.hi, D.slopes
        for each in candidates:
            short = np.ldexp(np.rint(np.ldexp(np.frexp(each)[0], 8)), np.frexp(each)[1] - 8)
            term = Interval(-short, -short)
            total = (D.range + W.range * term).hi
            turned = D.slopes + V.slopes.scaled(-short[:, None])
            near = D.value - short * W.value + V.boxes.spread(turned)
            bound = np.minimum(total, near)
            better = bound < largest
            k, largest = np.where(better, short, k), np.where(better, bound, largest)
            slopes = Interval(
                *(np.where(better[:, None], getattr(turned, e), getattr(slopes, e)) for e in ("lo", "hi"))
            )
        return k, largest, slopes

    def _require_decrease(self, found: Bounds) -> None:
        """No partition helps where V does not decrease at the centre of a box."""
        V, Vdot = found.V.value, found.Vdot.value
        excess = Vdot + self.rate * V - _MARGIN * self.claimed.level * self.rate
        bad = (excess > 0) & (self.claimed.level >= V)
        if bad.any():
            x = self.T @ found.V.boxes.centre[int(np.argmax(bad))]
            raise _NotFound(f"at x = {x.tolist()} in the set V does not decrease at this rate")


def _definite(M: Interval) -> NDArray[np.bool_]:
    """True where every form x'M x with a matrix within M, (N, n, n), is positive: elimination, as Coq does it."""
    count, n = M.lo.shape[:2]
    good = np.ones(count, dtype=bool)
    size = np.abs(M.hi).max(axis=(1, 2))
    with np.errstate(all="ignore"):
        for _ in range(n):
            pivot = M[:, 0, 0]
            good &= pivot.lo > _MARGIN * size
            safe = np.where(pivot.lo > 0, pivot.lo, 1.0), np.where(pivot.lo > 0, pivot.hi, 1.0)
            b = M[:, 0, 1:] + M[:, 1:, 0]
            inverse4 = Interval(0.25 / safe[1], 0.25 / safe[0])
            products = b[:, :, None] * b[:, None, :]
            M = M[:, 1:, 1:] - products * inverse4[:, None, None]
    return good
