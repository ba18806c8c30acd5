"""The result of a run, as a typed value, with its questions and pictures in Python.

All that a result says of the proved set comes from the numbers that the checker accepted: membership is decided in
rationals, sizes are rounded down, and pictures are drawn from the very bytes that were checked.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from html import escape
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from certify.analysis.facts import Diagnosis, Levels, OuterFacts, RankFacts, SimulatedFacts, Tried, TubeFacts
from certify.analysis.json_object import to_dict
from certify.analysis.stated import in_one_line, stated
from certify.certificates import parse_certificate, write_atomically
from certify.certificates.claims import Problem
from certify.certificates.ellipsoids import Box, Ellipsoid, sublevel_set, tube_start
from certify.certificates.membership import Region
from certify.certificates.ranked import Ranked
from certify.certificates.timing import Timing, reach_time
from certify.certificates.verdict import Stop, Verdict
from certify.errors import InputError
from certify.loop.equilibrium import Rest
from certify.loop.plants import System
from certify.loop.policies import PolicyNetwork
from certify.loop.policies.nonlinearity import Nonlinearity
from certify.lyapunov import volume
from certify.lyapunov.sublevel import Sublevel
from certify.provers.falsify import Witness

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, repr=False)
class RoaResult:
    """The result of a run. `stop` and `detail` say what limits the level, or why nothing was proved.

    If `system` has ranges, the proof holds for every function of time with values in them; `eigenvalues`, `rest` and
    the modes of `diagnosis` are those at the nominal values, as `system.parameters` has them.

    `rest` is the loop's equilibrium, if not the origin. `candidate` is the source of P, `tried` all that were tried,
    `notice` says what is not as it was asked for. `reach_from` is the state that was asked about, by the states'
    values; if the verdict on it is UNKNOWN by `Stop.PATH`, `certificate` and `levels` are of a proved set without it.
    If it is UNKNOWN by `Stop.BEYOND`, these and `outer` describe a smaller set than was asked for. `constraints`
    are those that trajectories are to keep, in words by their names; with a certificate they are proved. `simulated`
    counts runs, in up to three states, and `nonlinearity` is sampled on the set. `checker` is the checker's answer,
    None if it was not reached, about `raw`, the certificate's bytes; `solver` has dReal's version and every query with
    its answer, None if it was not asked. `notices` are facts known before the run; `folder` keeps a temporary folder of
    the certificate alive. `search` is a file that `resume` continues.
    In Python: `contains`, `volume`, `plot`, `report`, `certificate` (the file's path), `to_dict`."""

    verdict: Verdict
    stop: Stop
    system: System
    network: PolicyNetwork
    claim: str = "asymptotic"
    detail: str = ""
    problem: Problem | None = None
    candidate: str | None = None
    tried: tuple[Tried, ...] = ()
    notice: str | None = None
    levels: Levels = field(default_factory=Levels)
    tube: TubeFacts | None = None
    outer: OuterFacts | None = None
    ranks: RankFacts | None = None
    simulated: SimulatedFacts | None = None
    nonlinearity: Nonlinearity | None = None
    constraints: Mapping[str, str] = field(default_factory=dict)
    reach_from: Box | None = None
    witness: Witness | None = None
    eigenvalues: tuple[str, ...] = ()
    boxes: int = 0
    leaves: int = 0
    seconds: Mapping[str, float] = field(default_factory=dict)
    certificate: Path | None = None
    search: Path | None = None
    raw: bytes | None = field(default=None, repr=False)
    checker: Mapping[str, Any] | None = None
    engine: str = "bounds"
    solver: Mapping[str, Any] | None = None
    diagnosis: Diagnosis | None = None
    rest: Rest | None = None
    notices: tuple[str, ...] = ()
    folder: object | None = field(default=None, compare=False)

    @property
    def P(self) -> Array | None:
        """The matrix of V, (n, n); None if nothing was tried."""
        return None if self.problem is None else self.problem.V.P

    @property
    def reason(self) -> str:
        """The limit of the level, or the reason why nothing was proved, in words."""
        return self.stop.explain(self.detail)

    @property
    def timing(self) -> Timing:
        """The loop's timing, with the rate that was asked for."""
        return Timing.of(self.system, 0.0 if self.problem is None else self.problem.rate)

    @property
    def reach_time(self) -> float | None:
        """By when a trajectory from {V <= c2} certainly is in {V <= c0}, or, without a c0, has come to a hundredth of
        its V; in units of time of the plant, in discrete time in steps. None without a proved set or a rate.

        Where the input is held a sampling instant has come by then at which that is so.
        """
        if self.verdict is not Verdict.PROVED:
            return None
        return reach_time(self.timing, self.levels.floor, self.levels.roa)

    @property
    def volume(self) -> float | None:
        """A certain lower bound of the proved set's volume, in the product of the states' units; None without a set.

        With a tube, the larger of the volumes of {V <= c2} and the tube's start, whose union is the set. With an outer
        set or ranks, that of {V <= c2} alone: `outer.volume` estimates the union's, and `ranks.volume` is that of the
        boxes with ranks, rounded down.
        """
        return None if self.ellipsoid is None else volume(*self.ellipsoid)

    @property
    def ellipsoid(self) -> tuple[Array, float] | None:
        """(P, level) of the larger ellipsoid {x'Px <= level} of those that are proved around the operating point:
        {V <= c2}, a tube's start."""
        if self._region is None:
            return None
        largest = self._region.largest
        return largest.P, largest.level

    @property
    def _region(self) -> Region | None:
        """The union of the sets of the levels, the tube, the outer set and the ranks; None if there is no level c2."""
        if self.P is None or self.levels.roa is None:
            return None
        tube, outer = self.tube, self.outer
        starts = () if tube is None else (tube_start(tube.start, tube.centre),)
        beyond = None if outer is None else Sublevel(outer.function, outer.level, tuple(self.system.domain))
        inner = sublevel_set(self.P, self.levels.roa)
        return Region((inner, *starts), beyond, None if self.ranks is None else _ranked(self.ranks, inner, self.system))

    def contains(self, x: ArrayLike, *, deviations: bool = False) -> bool | NDArray[np.bool_]:
        """True for states that lie in the proved set, decided in rationals: no state is let in by rounding.

        The set is {V <= c2}, and with a tube the union of that and the tube's start. With an outer set it is the union
        of that and {N <= n2} within the domain, decided in balls of growing precision: a state at which N is exactly n2
        may not be let in. With ranks the boxes of finite rank belong to it, and states that differ from one of its own
        by multiples of 2 pi in angles.

        Parameters
        ----------
        x : one state, (n,), or several, (N, n), in the states' units. A float means its binary value; for exactly a
            tenth give Fraction(1, 10).
        deviations : True if x are deviations from the operating point x_eq, as in the certificate, and not the states'
            values. If x_eq is 0 the two are the same.

        Returns
        -------
        bool for one state, an array (N,) of them for several.

        Raises
        ------
        InputError : nothing was proved (a solver's word, TRUSTED, is no proof), x has another shape, or an entry is no
            finite number.
        """
        region = self._region
        if self.verdict is not Verdict.PROVED or region is None:
            raise InputError(
                f"there must be a proved set to ask for; the verdict is {self.verdict.value} ({self.reason})."
            )
        states, n = _entries(x), self.system.n
        if states.ndim not in (1, 2) or states.shape[-1] != n:
            names = ", ".join(s.name for s in self.system.states)
            raise InputError(f"`x` must have shape ({n},) or (N, {n}) for the states {names}; found {states.shape}.")
        shifts = [Fraction(0)] * n if deviations else list(self.system.exact_x_eq())
        rows = states.reshape(-1, n).tolist()
        if any(shifts):
            rows = [[Fraction(v) - q for v, q in zip(row, shifts, strict=True)] for row in rows]
        found = region.holds(rows)
        return found[0] if states.ndim == 1 else np.array(found, dtype=np.bool_)

    def report(self, path: str | PathLike[str] | None = None) -> Path:
        """Draw the report as one HTML page, from the bytes that were checked, and give its path.

        Parameters
        ----------
        path : the page; None is `report.html` beside the certificate, which a temporary folder takes with it.

        Raises
        ------
        InputError : there is no certificate, or the page cannot be written.
        """
        from certify.report.drawn import page_of

        raw, certificate = self._checked("report")
        target = certificate.with_name("report.html") if path is None else Path(path)
        page = page_of(raw, certificate, None if self.checker is None else dict(self.checker), self.to_dict())
        write_atomically(target, page.encode())
        return target

    def plot(self) -> Figure:
        """A figure of the proved set in its planes: the sections of {V <= c2} and of the inner set, the domain's box,
        and with more than two states the projection.

        It belongs to no window: save it with `savefig`, or let a notebook show it. Nothing in it is simulated.

        Raises
        ------
        InputError : there is no certificate.
        """
        from certify.report.drawn import figure_of

        raw, certificate = self._checked("plot")
        return figure_of(parse_certificate(raw, str(certificate)), accepted=self.verdict is Verdict.PROVED)

    def _checked(self, what: str) -> tuple[bytes, Path]:
        if self.raw is None or self.certificate is None:
            raise InputError(
                f"there must be a certificate to {what}; the verdict is {self.verdict.value} ({self.reason})."
            )
        return self.raw, self.certificate

    def __repr__(self) -> str:
        return f"RoaResult({in_one_line(self)})"

    def _repr_html_(self) -> str:
        """The result as a small table, for notebooks; every text is escaped."""
        cell = "style='text-align:left'"
        rows = (f"<tr><th {cell}>{escape(n)}</th><td {cell}>{escape(text)}</td></tr>" for n, text in stated(self))
        return f"<table>{''.join(rows)}</table>"

    def to_dict(self) -> dict[str, Any]:
        """The JSON object of `certify roa --json`; lengths along the states are in their units."""
        return to_dict(self)


def _ranked(ranks: RankFacts, inner: Ellipsoid, system: System) -> Ranked:
    names = [s.name for s in system.states]
    return Ranked(ranks.tree, inner, tuple(map(names.index, ranks.angles)))


def _entries(x: ArrayLike) -> NDArray[Any]:
    """The numbers of an array-like as they are, none of them rounded."""
    required = "`x` must be numbers of shape (n,) or (N, n): integers, floats or Fractions"
    try:
        # numpy would round an integer that stands beside a float in a list
        found = np.asarray(x) if hasattr(x, "__array__") else np.asarray(x, dtype=object)
    except (ValueError, TypeError, RuntimeError) as error:  # a tensor that does not give its numbers
        raise InputError(f"{required}; found {type(x).__name__}: {error}.") from error
    entries = found.astype(object)
    for index, value in np.ndenumerate(entries):
        entries[index] = value.item() if isinstance(value, np.generic) else value
        number = isinstance(entries[index], int | float | Fraction) and not isinstance(entries[index], bool)
        if not number or (isinstance(entries[index], float) and not math.isfinite(entries[index])):
            raise InputError(
                f"{required}, all finite; found {value!r:.60}, a {type(value).__name__}, at {list(index)}."
            )
    return entries
