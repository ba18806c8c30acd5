"""The share of the simulated region, under the figures: the results of the grid of runs, and their integration.

The runs themselves are those of `certify/report/sampling.py`; the figures draw them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from certify.certificates import Certificate
from certify.report.claims import words_for
from certify.report.sampling import SimulatedRoa
from certify.report.sections.shared import timing_of
from certify.report.timing import TimingInWords
from certify.report.words import ABSENT, TIMES, number, percent, share_of_runs, volume_name


def simulated_of(roa: SimulatedRoa, certificate: Certificate) -> dict[str, str]:
    """The counts of a grid of runs, and their integration in words."""
    timing = timing_of(certificate)
    return {
        "fraction": ABSENT if np.isnan(roa.fraction) else percent(roa.fraction, 1),
        "tells": "yes" if roa.tells else "",
        "grid": f" {TIMES} ".join(str(len(a)) for a in roa.axes),
        "attracted": f"{int(roa.attracted.sum()):,} of {roa.attracted.size:,}",
        "how": _integrated(roa, timing),
        "horizon": f"{number(roa.horizon, 3)} {timing.unit}",
        "undecided": f"{roa.undecided:,}",
        "left": f"{int(roa.left.sum()):,}",
        "contradictions": f"{roa.contradictions:,}" if roa.contradictions else "",
        "slow": f"{roa.slow:,}" if roa.slow else "",
        "bounds": "" if roa.clipped is None else " or the bounds of inputs",
        "clipped": f"{roa.clipped:,}" if roa.clipped else "",
        "of": volume_name(certificate.system.n),
        "who": words_for(certificate.kind).simulated,
    }


def drawn_of(result: Mapping[str, Any] | None) -> str:
    """The share of the run's own simulation, from drawn states, in words; empty without one."""
    found: Mapping[str, Any] = (result or {}).get("simulated") or {}
    return share_of_runs(found) if found and found["share"] is not None else ""


def _integrated(roa: SimulatedRoa, timing: TimingInWords) -> str:
    """The integration of a grid's runs in words; {} stands for the values that are held."""
    step = f"step {number(roa.step, 3)} s"
    if timing.discrete:
        return "the loop's own steps{}"
    if timing.sample is not None:
        return f"Runge–Kutta of order four with the input held over {number(float(timing.sample[1]), 6)} s{{}}, {step}"
    return f"Runge–Kutta of order four on the continuous closed loop{{}}, {step}"
