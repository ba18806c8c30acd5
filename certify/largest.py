"""The longest period, or the largest rate, for which the set that is proved without it can still be proved.

The set is that of a first run: its P and its level stay. What sampling allows for it is found by bisection; then
shares of that are tried, the largest first, each as a run of its own for exactly this set. What is returned is the last
that the checker accepted, under the usual name.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np

from certify.certificate import sole_writer, write_atomically
from certify.claims import Problem
from certify.closed_loop import ClosedLoop
from certify.engines.falsify import falsify
from certify.lyapunov import diagonalising_coordinates
from certify.lyapunov.function import Quadratic
from certify.options import RoaOptions
from certify.policies import TanhNetwork
from certify.results import RoaResult
from certify.roa import Report, certify_roa
from certify.systems import System, exact
from certify.verdict import Verdict

Quantity = Literal["period", "rate"]
_FOR_THE_SET = 0.25  # of the time, for the run without it
_SHARES = (0.97, 0.93, 0.87, 0.78, 0.66, 0.5, 0.33, 0.2, 0.1)  # of what sampling allows
_EACH = 0.25  # of the time that is left, for one of them
_BISECTIONS, _SAMPLES = 12, 4000
_LEAST = 2.0**-16  # of the slowest time constant, or of the fastest rate, that is looked at
_DIGITS = 3


def certify_largest(
    quantity: Quantity,
    system: System,
    network: TanhNetwork,
    out: Path,
    options: RoaOptions,
    *,
    load_seconds: float = 0.0,
    provenance: Mapping[str, Any] | None = None,
    progress: Report | None = None,
) -> RoaResult:
    """Certify the set that is proved with an input that follows at once and no rate, with as long a period, or as large
    a rate, as can be proved for it.

    Parameters
    ----------
    quantity : `period`, for exactly which the input is held, or `rate`; with a rate the plant keeps its sample time.
    system, network, out, options, load_seconds, provenance, progress : those of `certify_roa`.

    Returns
    -------
    RoaResult : of the largest; of the first run, with a notice, if no share of what sampling allows is proved.

    Raises
    ------
    InputError, BackendError, SoundnessError : those of `certify_roa`.
    """
    start = time.perf_counter() - load_seconds
    plain = system.with_sample(None) if quantity == "period" else system

    def left() -> float:
        return options.time_limit - (time.perf_counter() - start)

    with sole_writer(out), TemporaryDirectory(dir=out, prefix="attempt-") as folder:
        first = certify_roa(
            plain,
            network,
            Path(folder) / "first",
            replace(options, rate=0.0, time_limit=_FOR_THE_SET * options.time_limit),
            load_seconds=load_seconds,
            provenance=provenance,
            progress=progress,
        )
        best, proved = first, None
        if first.verdict is Verdict.PROVED and first.problem is not None and first.levels.roa is not None:
            P, level = first.problem.V.P, first.levels.roa
            for value in _tried(quantity, plain, network, P, level):
                if not left() > 0:
                    break
                attempt = certify_roa(
                    plain.with_sample((value, value)) if quantity == "period" else plain,
                    network,
                    Path(folder) / "next",
                    replace(
                        options,
                        P=P,
                        level=level,
                        rate=float(value) if quantity == "rate" else 0.0,
                        time_limit=max(1.0, _EACH * left()),
                    ),
                    provenance=provenance,
                    progress=progress,
                )
                if attempt.verdict is Verdict.PROVED:
                    best, proved = attempt, value
                    break
        return _in_place(best, out, _notice(quantity, proved, first), time.perf_counter() - start)


def _tried(quantity: Quantity, system: System, network: TanhNetwork, P: Any, level: float) -> Sequence[Fraction]:
    """Shares of the largest value for which no violation is sampled in the set, rounded to a few digits."""
    loop = ClosedLoop(system, network)
    T = diagonalising_coordinates(P, loop.linearise()[0])
    modes = np.abs(np.linalg.eigvals(loop.linearise()[0]).real)
    most = 8 / float(np.min(modes)) if quantity == "period" else 2 * float(np.max(modes))

    def holds(value: float) -> bool:
        if quantity == "period":
            h = exact(value)
            problem = Problem(ClosedLoop(system.with_sample((h, h)), network), Quadratic(P))
        else:
            problem = Problem(loop, Quadratic(P), value)
        return falsify(problem, T, level, _SAMPLES) is None

    low, high = most * _LEAST, most
    if not holds(low):
        return ()
    for _ in range(_BISECTIONS):
        middle = (low * high) ** 0.5
        low, high = (middle, high) if holds(middle) else (low, middle)
    return [Fraction(f"{share * low:.{_DIGITS}g}") for share in _SHARES]


def _notice(quantity: Quantity, proved: Fraction | None, first: RoaResult) -> str | None:
    if first.verdict is not Verdict.PROVED:
        return first.notice
    if proved is None:
        return f"no {quantity} could be proved for this set; the claim is the one without it"
    what = f"the input is held over {float(proved):g}" if quantity == "period" else f"the rate is {float(proved):g}"
    return f"{what}, the largest of those tried that could be proved for this set"


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
