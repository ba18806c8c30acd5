"""The parts of a page that only a certificate has by which a region is reached."""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.certificates import ReachCertificate
from certify.errors import CertifyError
from certify.report.figures.ranks import reach_maps
from certify.report.figures.style import Picture
from certify.report.mathml import comparison, inequality
from certify.report.ranked import BOXES
from certify.report.reached import box_of, steps_of
from certify.report.sections.not_proved import not_reached_of
from certify.report.sections.numbers import ranked_rows
from certify.report.sections.shared import timing_of
from certify.report.sections.status import Status
from certify.report.words import listed, symbol, volume_name

Array = NDArray[np.float64]


def reached_parts(certificate: ReachCertificate, status: Status, result: Mapping[str, Any] | None) -> dict[str, Any]:
    """The values of `reached.html` that pages of other claims do not have, or have otherwise."""
    pictures, trouble = _pictures(certificate, status, result)
    return {
        "claim": _claim(certificate),
        "asked": _asked(result) if status.accepted else {},
        "pictures": pictures,
        "trouble": trouble,
        "ranked": ranked_rows(certificate, "to the region"),
        "measure": volume_name(certificate.system.n),
        "not_proved": not_reached_of(certificate),
    }


def _claim(certificate: ReachCertificate) -> dict[str, Any]:
    """The claim in words and formulas, and its parts."""
    claim, timing = certificate.claim, timing_of(certificate)
    angles = [symbol(name) for name in claim.ranks.angles]
    steps = "steps" if timing.discrete else "sampling instants"
    inside = f"all states but {listed(angles)} are" if angles else "the state is"
    meanwhile = "" if timing.discrete else ", at all times in between too"
    parts = [
        ("Region", "Every box of rank 0 lies in it", ""),
        (
            "Boxes",
            f"From every other box with a rank r, after its number k of {steps}, every trajectory is in the region or "
            f"in boxes of rank r − k at most; before each of these {steps} the closed loop is defined, the input keeps "
            f"its bounds and {inside} strictly inside the domain{meanwhile}",
            "leaf by leaf of a partition, by a box that contains all states that a leaf's states become",
        ),
    ]
    if angles:
        parts.append(
            ("Angles", f"After a full turn of {listed(angles)} the closed loop and the region are the same", "")
        )
    if claim.keep:
        parts.append(("Constraints", f"Each of them holds before each of these {steps}{meanwhile}", ""))
    return {
        "own": "region",
        "target": [comparison(t) for t in claim.target],
        "constraints": [inequality(name, g) for name, g in certificate.constraints.items()],
        "steps": f"{claim.ranks.steps:,} {steps if claim.ranks.steps > 1 else steps[:-1]}",
        "boxes": BOXES,
        "turned": angles,
        "inside": inside,
        "parts": [(name, f"{text}, {how}." if how else f"{text}.") for name, text, how in parts],
    }


def _asked(result: Mapping[str, Any] | None) -> dict[str, str]:
    """The box that the run was asked about, and the answer; empty without one."""
    box = None if result is None else box_of(result)
    if result is None or box is None:
        return {}
    steps = "" if result["steps"] is None else steps_of(result, result["steps"])
    simulated = result["simulated"] or {}
    longest = "" if simulated.get("longest") is None else steps_of(result, simulated["longest"])
    return {"box": box, "steps": steps, "longest": longest, "runs": f"{simulated.get('runs', 0):,}"}


def _pictures(
    certificate: ReachCertificate, status: Status, result: Mapping[str, Any] | None
) -> tuple[list[Picture], str]:
    """The maps, or the reason why there are none."""
    box = None
    if result is not None and result["from"] is not None:
        ends = [[Fraction(end) for end in pair] for pair in result["from"].values()]
        each = list(zip(ends, certificate.system.exact_x_eq(), strict=True))
        box = np.array([float(lo - q) for (lo, _), q in each]), np.array([float(hi - q) for (_, hi), q in each])
    try:
        return reach_maps(certificate, status.accepted, box), ""
    except (CertifyError, ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
        if status.accepted:
            raise
        return [], f"There are no figures: {error}"  # a rejected file need not make sense
