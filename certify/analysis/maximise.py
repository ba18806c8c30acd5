"""The longest period, or the largest rate, for which the set that is proved without it can still be proved.

The set is that of a first run: its P stays, and its level but for a few hundredths. The largest value that sampling
allows for it is found by bisection; then shares of that are tried, the largest first, each as a run of its own for
exactly this set, and middles between the first that is proved and the last that is not. The result is the largest that
the checker accepted, under the usual name.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np

from certify.analysis.asked import require_one_that_knows
from certify.analysis.facts import Step
from certify.analysis.options import RoaOptions
from certify.analysis.results import RoaResult
from certify.analysis.run import Report, certify_roa
from certify.analysis.stages.state import effort_of
from certify.certificates import earlier_aside, sole_writer, write_atomically
from certify.certificates.claims import Problem
from certify.certificates.verdict import Stop, Verdict
from certify.effort import UNIT
from certify.loop.closed_loop import ClosedLoop
from certify.loop.plants import System, exact
from certify.loop.policies import PolicyNetwork
from certify.lyapunov import diagonalising_coordinates
from certify.lyapunov.function import Quadratic
from certify.provers.falsify import is_violated

Quantity = Literal["period", "rate"]
_FOR_THE_SET = 0.25  # share of the effort for the run without it
_SHARES = (0.97, 0.87, 0.66, 0.4, 0.2, 0.1, 0.03)  # shares of what sampling allows
_EACH = 0.25  # share of the effort that is left for one of them
_BISECTIONS, _HALVINGS = 12, 4  # steps to find what sampling allows, and between the proved and the unproved value
_SET = 0.95  # share of the level that is proved without it: at the edge of what can be proved there is room for neither
_LEAST = 2.0**-16  # share of the slowest time constant, or of the fastest rate, that is looked at
_DIGITS = 3


def certify_largest(
    quantity: Quantity,
    system: System,
    network: PolicyNetwork,
    out: Path,
    options: RoaOptions,
    *,
    load_seconds: float = 0.0,
    provenance: Mapping[str, Any] | None = None,
    progress: Report | None = None,
    tell: Callable[[str], None] | None = None,
) -> RoaResult:
    """Certify the set that is proved with an input that follows at once and no rate, but for a few hundredths of its
    level, with as long a period, or as large a rate, as can be proved for it.

    Parameters
    ----------
    quantity : `period`, for exactly which the input is held, or `rate`; with a rate the plant keeps its sample time.
    system, network, out, options, load_seconds, provenance, progress, tell : those of `certify_roa`.

    Returns
    -------
    RoaResult : of the largest; of the first run, with a notice, if no share of what sampling allows is proved.

    Raises
    ------
    InputError, BackendError, SoundnessError : those of `certify_roa`, also where the options allow no such quantity.
    """
    start = time.perf_counter() - load_seconds
    if options.candidate == "auto":
        options = replace(options, candidate="ellipsoid")  # the set is that of a level
    plain = system.with_sample(None) if quantity == "period" else system
    _require_possible(quantity, plain, options)
    effort = effort_of(options.effort, options.time_limit, load_seconds)
    certify = partial(certify_roa, provenance=provenance, progress=progress, keep=False)
    with (
        sole_writer(out),
        earlier_aside(out, tell or (lambda _: None)),
        TemporaryDirectory(dir=out, prefix="attempt-") as folder,
    ):
        share = effort.share(_FOR_THE_SET)
        here = Path(folder) / "first"
        first = certify(plain, network, here, replace(options, rate=0.0), load_seconds=load_seconds, effort=share)
        best, proved = first, None
        if first.verdict is Verdict.PROVED and first.problem is not None and first.levels.roa is not None:
            P = first.problem.V.P
            level = _SET * first.levels.roa if options.level is None else options.level
            plain, network = first.system, first.network  # as seen from where V is 0

            def attempt(value: Fraction) -> RoaResult | None:
                asked = replace(options, P=P, level=level, rate=float(value) if quantity == "rate" else 0.0)
                held = plain.with_sample((value, value)) if quantity == "period" else plain
                share = effort.part(max(UNIT, _EACH * effort.left))
                found = certify(held, network, Path(folder) / "next", asked, effort=share)
                return _named(found, first, options) if found.verdict is Verdict.PROVED else None

            largest = _largest(attempt, _tried(quantity, plain, network, P, level), lambda: effort.over)
            if largest is not None:
                best, proved = largest
        notice = _notice(quantity, proved, first, options)
        return _in_place(best, out, notice, time.perf_counter() - start)


def _require_possible(quantity: Quantity, plain: System, options: RoaOptions) -> None:
    """Refuse at the beginning what no attempt could be asked.

    Raises
    ------
    InputError : an option excludes a rate, or a period, or the plant cannot have one.
    """
    if quantity == "rate":
        replace(options, rate=1.0)
    else:
        require_one_that_knows(plain.with_sample((Fraction(1), Fraction(1))), options)


def _named(found: RoaResult, first: RoaResult, options: RoaOptions) -> RoaResult:
    """An attempt's result, by the names of the first run: its candidate, where the loop rests, whose level it is."""
    name = first.candidate or ""
    tried = tuple(replace(one, candidate=name) for one in found.tried)
    found = replace(found, rest=first.rest, candidate=first.candidate, tried=tried)
    if options.level is not None or found.stop is not Stop.REQUESTED or found.diagnosis is None:
        return found
    detail = f"{_SET:g} of the level proved without it"
    reason, why = found.stop.explain(detail), f"the set that is proved without it is limited by {first.reason}"
    diagnosis = replace(found.diagnosis, binds=reason, next=Step((), why))
    return replace(found, detail=detail, diagnosis=diagnosis)


def _largest(
    attempt: Callable[[Fraction], RoaResult | None], values: Sequence[Fraction], over: Callable[[], bool]
) -> tuple[RoaResult, Fraction] | None:
    """The largest value that is proved, with its result: the first of the falling `values`, or a middle between it and
    the last that is not; None if none is proved before the effort is `over`."""
    proved: tuple[RoaResult, Fraction] | None = None
    refused: Fraction | None = None
    for value in values:
        if over():
            return None
        found = attempt(value)
        if found is not None:
            proved = found, value
            break
        refused = value
    for _ in range(_HALVINGS):
        if proved is None or refused is None or over():
            break
        middle = _short((proved[1] + refused) / 2)
        found = attempt(middle)
        if found is not None:
            proved = found, middle
        else:
            refused = middle
    return proved


def _tried(quantity: Quantity, system: System, network: PolicyNetwork, P: Any, level: float) -> Sequence[Fraction]:
    """Shares of the largest value for which no violation is sampled in the set, rounded to a few digits."""
    loop = ClosedLoop(system, network)
    L = loop.mean_rate()
    T, modes = diagonalising_coordinates(P, L, loop.step), np.abs(np.linalg.eigvals(L).real)
    most = 8 / float(np.min(modes)) if quantity == "period" else 2 * float(np.max(modes))

    def holds(value: float) -> bool:
        if quantity == "period":
            h = exact(value)
            problem = Problem(ClosedLoop(system.with_sample((h, h)), network), Quadratic(P))
        else:
            problem = Problem(loop, Quadratic(P), value)
        return not is_violated(problem, T, level)

    low, high = most * _LEAST, most
    if not holds(low):
        return ()
    for _ in range(_BISECTIONS):
        middle = (low * high) ** 0.5
        low, high = (middle, high) if holds(middle) else (low, middle)
    return [_short(Fraction(share * low)) for share in _SHARES]


def _short(value: Fraction) -> Fraction:
    """Rounded to a few decimal digits, which is what people give."""
    return Fraction(f"{float(value):.{_DIGITS}g}")


def _notice(quantity: Quantity, proved: Fraction | None, first: RoaResult, options: RoaOptions) -> str | None:
    if first.verdict is not Verdict.PROVED:
        return first.notice
    if proved is None:
        return f"no {quantity} could be proved for this set; the claim is the one without it"
    what = f"the input is held over {float(proved):g}" if quantity == "period" else f"the rate is {float(proved):g}"
    level = f"{_SET:g} of the level proved without it" if options.level is None else f"the level {options.level:g}"
    return f"{what}, the largest of those tried that could be proved for {level}"


def _in_place(result: RoaResult, out: Path, notice: str | None, seconds: float) -> RoaResult:
    """The result with its certificate in the folder that was asked for."""
    said = "; ".join(dict.fromkeys(text for text in (notice, result.notice) if text)) or None
    result = replace(result, notice=said)
    result = replace(result, seconds={**result.seconds, "total": seconds})
    if result.certificate is None or result.raw is None:
        return result
    path = out / result.certificate.name
    write_atomically(path, result.raw)
    return replace(result, certificate=path)
