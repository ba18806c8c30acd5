"""The result of a run: as a typed value, as the JSON object of `certify roa --json`, and with methods for Python.

All that a result says of the proved set comes from the numbers that the checker accepted: membership is decided in
rationals, sizes are rounded down, and pictures are drawn from the very bytes that were checked.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from fractions import Fraction
from html import escape
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from certify.certificates import parse_certificate, write_atomically
from certify.certificates.claims import Problem
from certify.certificates.membership import Region, sublevel_set, tube_start
from certify.certificates.timing import Timing, reach_time
from certify.certificates.verdict import Stop, Verdict
from certify.errors import InputError
from certify.loop.equilibrium import Rest
from certify.loop.plants import System
from certify.loop.policies import TanhNetwork
from certify.lyapunov import extents, semi_axes, volume
from certify.lyapunov.neural import Neural
from certify.lyapunov.sublevel import Sublevel
from certify.lyapunov.symbolic import Symbolic
from certify.provers.falsify import Witness
from certify.report.timing import TimingInWords
from certify.report.words import below, estimated, varying, varying_in, volume_name, volume_unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
_STAGES = ("load", "candidate", "local", "ring", "tube", "learn", "outer", "write", "check", "total")


@dataclass(frozen=True, slots=True)
class Levels:
    """Levels of V. None means that there is none.

    `local` (c1) and `roa` (c2) state an asymptotic claim, `floor` (c0), `local` and `roa` a practical one.
    `sampled_limit` is where the lowest violation was found, `domain_limit` where the set meets the domain.
    """

    local: float | None = None
    floor: float | None = None
    roa: float | None = None
    sampled_limit: float | None = None
    domain_limit: float | None = None

    @property
    def inner(self) -> float | None:
        """The level of the inner set that the claim speaks of: c0 of a practical claim, else c1."""
        return self.local if self.floor is None else self.floor

    @property
    def ultimate(self) -> float | None:
        """c0 of a practical claim: the level below which every trajectory ends."""
        return self.floor

    def to_dict(self) -> dict[str, float | None]:
        """For JSON."""
        return {**{name: getattr(self, name) for name in self.__slots__}, "ultimate": self.ultimate}


@dataclass(frozen=True, slots=True)
class Tried:
    """A candidate that was tried.

    `level` and `volume` are the most within its reach, sampled, ended by `limited_by`; `proved` says that the result is
    about this one, `proved_volume` what the search had proved with it, None if nothing.
    """

    candidate: str
    level: float
    limited_by: str
    volume: float
    proved: bool
    proved_volume: float | None


@dataclass(frozen=True, slots=True)
class Step:
    """A step to try next: options to add to the command (none if no option helps), and why; `flattens` says that the
    policy is to be fine-tuned first, by `controllers flatten`."""

    options: tuple[tuple[str, str], ...]
    why: str
    flattens: bool = False


@dataclass(frozen=True, slots=True)
class TubeFacts:
    """A tube that enlarges the set: it starts at {(x - c)'P(x - c) <= 1}, P = `start` (n, n), c = `centre`, None for 0,
    of this `shape`, and leads into {V <= c2} in `slabs` pieces, in `duration` units of time."""

    start: Array
    shape: str
    slabs: int
    duration: float
    centre: tuple[float, ...] | None = None

    def contains(self, states: Sequence[Sequence[Fraction | float]]) -> list[bool]:
        """True for states, as deviations from the operating point, that lie in the start, decided in rationals."""
        return tube_start(self.start, self.centre).holds(states)

    def to_dict(self) -> dict[str, Any]:
        """For JSON, with the size of the start along the states."""
        sizes = {"semi_axes": semi_axes(self.start, 1.0).tolist(), "extents": extents(self.start, 1.0).tolist()}
        stated = {"shape": self.shape, "slabs": self.slabs, "duration": self.duration, "start": self.start.tolist()}
        return {**stated, "centre": self.centre and list(self.centre), "volume": volume(self.start, 1.0), **sizes}


@dataclass(frozen=True, slots=True)
class OuterFacts:
    """A set beyond {V <= c2}: {N <= level} within the domain, N a `function` of deviations from the operating point.

    `volume` is that of its union with {V <= c2}, estimated from samples of the domain, and `deviation` the standard
    deviation of that estimate; `leaves` are those of all trees; `limit` says what ends the level: `domain` (its faces),
    `witness`, `requested`, or what ran out;
    `witness` is a state, (n,), at which N is no larger than `witness_level` and does not fall, None if none was met.
    """

    function: Neural | Symbolic
    level: float
    volume: float
    deviation: float
    limit: str
    boxes: int
    leaves: int
    witness: tuple[float, ...] | None = None
    witness_level: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        N = self.function
        stated: dict[str, Any] = (
            {"kind": "expression", "expression": str(N.expression)}
            if isinstance(N, Symbolic)
            else {"kind": "network", "layers": list(N.widths), "sha256": N.sha256()}
        )
        numbers = {name: getattr(self, name) for name in self.__slots__ if name not in ("function", "witness")}
        return {**stated, **numbers, "witness": self.witness and list(self.witness)}


@dataclass(frozen=True, slots=True)
class Share:
    """The set's reach along a state, and that as a share of the nearer side of its domain."""

    state: str
    unit: str
    extent: float
    share: float


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """The limit that binds, and its place.

    Parameters
    ----------
    binds : in words, with the names of states and inputs.
    kind : `domain`, `vdot`, `input`, or the name of the stop.
    name, side : the state or input that binds and which side, None where neither does.
    point : a state at which it binds, (n,), None if there is none.
    shares : one for each state; empty without a set.
    fastest, slowest : real parts of the closed loop's eigenvalues at the origin, 1/s.
    hurts : weights of the states, (n,), the largest 1: the direction in which the proof had most to do.
    next : what to try.
    """

    binds: str
    kind: str
    name: str | None
    side: str | None
    point: tuple[float, ...] | None
    shares: tuple[Share, ...]
    fastest: float | None
    slowest: float | None
    hurts: tuple[tuple[str, float], ...]
    next: Step

    @property
    def stiffness(self) -> float | None:
        """The fastest mode's rate of decay relative to the slowest one's; None unless all decay."""
        if self.fastest is None or self.slowest is None or not self.slowest < 0:
            return None
        return self.fastest / self.slowest

    def to_dict(self) -> dict[str, Any]:
        """For JSON: the fields, and `stiffness`; `hurts` by state."""
        stated = asdict(self)
        stated |= {"stiffness": self.stiffness, "hurts": dict(self.hurts)}
        stated["next"] = {"options": dict(self.next.options), "why": self.next.why, "flatten": self.next.flattens}
        return stated


@dataclass(frozen=True, slots=True, repr=False)
class RoaResult:
    """The result of a run. `stop` and `detail` say what limits the level, or why nothing was proved.

    If `system` has ranges, the proof holds for every function of time with values in them; `eigenvalues`, `rest` and
    the modes of `diagnosis` are those at the nominal values, as `system.parameters` has them.

    `rest` is the loop's equilibrium, if not the origin. `candidate` is the source of P, `tried` all that were tried,
    `notice` says what is not as it was asked for. `reach_from` is the state that was asked about, by the states'
    values; if the verdict on it is UNKNOWN by `Stop.PATH`, `certificate` and `levels` are of a proved set without it.
    If the verdict is UNKNOWN by `Stop.BEYOND` they, and `outer`, are of a smaller set than was asked for.
    `checker` is the checker's answer, None if it was not reached, about `raw`, the certificate's bytes; `solver` has
    dReal's version and every query with its answer, None if it was not asked. `notices` are facts about plant and
    policy known before the run, such as a domain that was cut; `folder` keeps a temporary folder of the certificate
    alive. `search` is a file with the search, if more effort could continue it (`resume`).

    In Python: `contains`, `volume`, `plot`, `report`, `certificate` (the file's path), `to_dict`.
    """

    verdict: Verdict
    stop: Stop
    system: System
    network: TanhNetwork
    claim: str = "asymptotic"
    detail: str = ""
    problem: Problem | None = None
    candidate: str | None = None
    tried: tuple[Tried, ...] = ()
    notice: str | None = None
    levels: Levels = field(default_factory=Levels)
    tube: TubeFacts | None = None
    outer: OuterFacts | None = None
    reach_from: tuple[Fraction, ...] | None = None
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

        With a tube it is that of the larger one of {V <= c2} and the tube's start, of which the set is the union; with
        an outer set it is that of {V <= c2} alone: `outer.volume` is an estimate of the union's.
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
        """The union of the sets of the levels, the tube and the outer set; None if there is no level c2."""
        if self.P is None or self.levels.roa is None:
            return None
        tube, outer = self.tube, self.outer
        starts = () if tube is None else (tube_start(tube.start, tube.centre),)
        beyond = None if outer is None else Sublevel(outer.function, outer.level, tuple(self.system.domain))
        return Region((sublevel_set(self.P, self.levels.roa), *starts), beyond)

    def contains(self, x: ArrayLike, *, deviations: bool = False) -> bool | NDArray[np.bool_]:
        """True for states that lie in the proved set, decided in rationals: no state is let in by rounding.

        The set is {V <= c2}, and with a tube the union of that and the tube's start. With an outer set it is the union
        of that and {N <= n2} within the domain, decided in balls of growing precision: a state at which N is exactly n2
        may not be let in.

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
        said = dict(self._stated())
        verdict = said["verdict"] if self.claim == "asymptotic" else f"{said['verdict']} {self.claim}"
        shown = [verdict, *(said[name] for name in ("plant", "in time", "set") if name in said)]
        shown += [
            f"{name} {said[name]}"
            for name in ("rate", "length", "area", "volume", "with N", "limited by", "reason")
            if name in said
        ]
        return f"RoaResult({'; '.join(shown)})"

    def _repr_html_(self) -> str:
        """The result as a small table, for notebooks; every text is escaped."""
        cell = "style='text-align:left'"
        rows = (f"<tr><th {cell}>{escape(n)}</th><td {cell}>{escape(text)}</td></tr>" for n, text in self._stated())
        return f"<table>{''.join(rows)}</table>"

    def _stated(self) -> list[tuple[str, str]]:
        """The result in a few rows, names and values."""
        rows = [("verdict", self.verdict.value), ("plant", self.system.name), ("claim", self.claim)]
        if self.system.ranges:
            rows.append(("for every", varying(varying_in(self.system))))
        timing = TimingInWords.of(self.system, self.timing.rate)
        if not timing.is_plain:
            rows.append(("in time", "by steps" if timing.discrete else f"input held over {timing.periods}"))
        if timing.rate:
            rows.append(("rate", timing.shown_rate))
        shown = self.verdict in (Verdict.PROVED, Verdict.TRUSTED)
        level, size = (self.levels.roa, self.volume) if shown else (None, None)
        if level is not None and size is not None:
            unit = volume_unit([self.system.units.get(s.name, "") for s in self.system.states])
            wider = "" if self.tube is None else ", enlarged by a tube" if self.tube.centre is None else ", and a tube"
            if self.outer is not None:
                wider = f", and N <= {below(self.outer.level)} in the domain"
            rows.append(("set", f"V <= {below(level)}{wider}"))
            rows.append((volume_name(self.system.n), f"{below(size)} {unit}".rstrip()))
            if self.outer is not None:
                rows[-1] = (rows[-1][0], f"{rows[-1][1]}, of V <= {below(level)}")
                rows.append(("with N", estimated(self.outer.volume, self.outer.deviation, unit)))
            rows.append(("limited by", self.reason))
        else:
            rows.append(("reason", self.reason))
        rows += [("certificate", str(self.certificate))] if self.certificate is not None else []
        return rows + [("notice", text) for text in (self.notice, *self.notices) if text is not None]

    def _claim(self) -> dict[str, Any]:
        """The claim's kind, with the rate and the periods where there are any."""
        rate = {"rate": self.timing.rate} if self.timing.rate else {}
        sample = self.system.sample
        return {"kind": self.claim, **rate, **({} if sample is None else {"sample": [str(h) for h in sample]})}

    def _rest(self, rest: Rest) -> dict[str, Any]:
        """The equilibrium, also by the states' values; `origin` says that V is 0 there."""
        moved = map(Fraction, self.network.origin.tolist())  # x is in deviations from where the plant was to rest
        each = zip(self.system.exact_x_eq(), moved, rest.x, strict=True)
        values = [float(at - by + Fraction(x)) for at, by, x in each]
        return asdict(rest) | {"values": values, "origin": self.network.is_moved}

    def to_dict(self) -> dict[str, Any]:
        """The JSON object of `certify roa --json`; lengths along the states are in their units."""
        system, network, witness = self.system, self.network, self.witness
        P = self.P
        geometry: dict[str, Any] = dict.fromkeys(("volume", "semi_axes", "extents"))
        if self.ellipsoid is not None:
            axes, reach = semi_axes(*self.ellipsoid).tolist(), extents(*self.ellipsoid).tolist()
            geometry = {"volume": self.volume, "semi_axes": axes, "extents": reach}
        stated = {
            "schema": "certify-roa/1",
            "verdict": self.verdict.value,
            "reason": self.reason,
            "stop": self.stop.name.lower(),
            "claim": self._claim(),
            "time": self.system.time,
            "system": system.name,
            "parameters": {name: str(q) for name, q in system.parameters.items()},
            "uncertain": [
                {
                    "name": name,
                    "kind": system.kind_of(name),
                    "lo": str(lo),
                    "hi": str(hi),
                    "unit": system.units.get(name, ""),
                }
                for name, (lo, hi) in system.ranges.items()
            ],
            "states": [{"name": s.name, "unit": system.units.get(s.name, "")} for s in system.states],
            "operating_point": {name: str(q) for name, q in system.operating_point().items()},
            "inputs": [{"name": s.name, "unit": system.units.get(s.name, "")} for s in system.inputs],
            "policy": {"sha256": network.sha256(), "layers": list(network.layers)},
            "lyapunov": {
                "P": None if P is None else P.tolist(),
                "candidate": self.candidate,
                "notice": self.notice,
            },
            "levels": self.levels.to_dict(),
            "reach_time": self.reach_time,
            "reach_from": None
            if self.reach_from is None
            else {s.name: str(q) for s, q in zip(system.states, self.reach_from, strict=True)},
            "tube": None if self.tube is None else self.tube.to_dict(),
            "outer": None if self.outer is None else self.outer.to_dict(),
            "witness": None,
            "eigenvalues": list(self.eigenvalues),
            "rest": None if self.rest is None else self._rest(self.rest),
        }
        if witness is not None:
            held = witness.values if witness.kind == "vdot" else {}  # an input does not depend on them
            stated["witness"] = {
                "x": witness.x.tolist(),
                "V": witness.level,
                "kind": witness.kind,
                "values": {name: str(q) for name, q in held.items()},
            }
        return {
            **stated,
            **geometry,
            "candidates": [asdict(one) for one in self.tried],
            "engine": self.engine,
            "solver": None if self.solver is None else dict(self.solver),
            "diagnosis": None if self.diagnosis is None else self.diagnosis.to_dict(),
            "boxes": self.boxes,
            "leaves": self.leaves,
            "seconds": {name: self.seconds.get(name) for name in _STAGES},
            "certificate": None if self.certificate is None else str(self.certificate),
            "search": None if self.search is None else str(self.search),
            "certificate_sha256": None if self.checker is None else self.checker.get("certificate_sha256"),
            "checked": None if self.checker is None else self.checker.get("result"),
            "contains": None,  # the answer to `certify roa --contains`
        }


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
