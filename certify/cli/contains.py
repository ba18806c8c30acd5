"""`certify contains`."""

from __future__ import annotations

import json
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from certify.analysis.arguments import region
from certify.cli.shared import Json
from certify.cli.terminal import say

if TYPE_CHECKING:
    from certify.certificates.ellipsoids import Box
    from certify.certificates.located import Located
    from certify.loop.plants import System


def contains(
    certificate: Annotated[Path, typer.Argument(help="Certificate file.")],
    states: Annotated[
        list[str],
        typer.Argument(
            help="A state or a box, as in x=1.57 x_dot=-1..1, or with commas; omitted states are at their x_eq."
        ),
    ],
    deviations: Annotated[
        bool, typer.Option("--deviations", help="Read the numbers as deviations from the operating point.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Check a certificate and decide exactly whether a state, or every state of a box, lies in the proved set."""
    from certify.certificates.claims import Reaches
    from certify.certificates.located import Containment
    from certify.certificates.membership import proved_set
    from certify.certificates.ranked import steps_from
    from certify.loop.plants.constraints import in_words

    proved = proved_set(certificate)
    box = region(" ".join(states), proved.system, "STATES", deviations)
    found = proved.locate(box)
    data = {
        "certificate": str(certificate),
        "certificate_sha256": proved.certificate_sha256,
        "claim": {"kind": proved.claim},
        "system": proved.system.name,
        "operating_point": {name: str(q) for name, q in proved.system.operating_point().items()},
        **stated(found, box, proved.system),
    }
    said = text(found, box, proved.system)
    if proved.claim == Reaches.kind and proved.ranked is not None:
        steps = steps_from(proved.ranked, box)
        data["steps"] = steps
        said += "" if steps is None else f"; the region is reached after {steps:,} steps or periods at the latest"
    if proved.system.constraints:
        data["constraints"] = in_words(proved.system)
        if found.answer is Containment.CONTAINED:
            until = " until the region is reached" if proved.claim == Reaches.kind else ""
            said += f"\n(kept along every trajectory from there{until}: {'; '.join(data['constraints'].values())})"
    say(json.dumps(data) if as_json else said)
    raise typer.Exit(found.answer.exit_status)


def stated(found: Located, box: Box, system: System) -> dict[str, Any]:
    """The answer for JSON: numbers are exact fractions; `box` and `outside` are values of the states."""
    at, names = system.exact_x_eq(), [s.name for s in system.states]
    values = {name: [str(lo + q), str(hi + q)] for name, (lo, hi), q in zip(names, box, at, strict=True)}
    corner = found.outside
    outside = None if corner is None else {name: str(v + q) for name, v, q in zip(names, corner, at, strict=True)}
    return {"result": found.answer.value, "within": found.within, "box": values, "outside": outside}


def text(found: Located, box: Box, system: System) -> str:
    """The answer in words, in values of the states."""
    from certify.certificates.located import Containment
    from certify.certificates.membership import NOTHING_PROVED

    at = system.exact_x_eq()
    shown = ", ".join(
        f"{s.name} = {_number(lo + q)}" + ("" if lo == hi else f"..{_number(hi + q)}")
        for s, (lo, hi), q in zip(system.states, box, at, strict=True)
    )
    if found is NOTHING_PROVED:
        said = f"UNDECIDED  {shown}: nothing was proved"
    elif found.answer is Containment.CONTAINED:
        said = f"CONTAINED  {shown}: in {found.within}"
    elif found.outside is not None:
        corner = ", ".join(_number(v + q) for v, q in zip(found.outside, at, strict=True))
        said = f"NOT CONTAINED  {shown}" + (
            "" if all(lo == hi for lo, hi in box) else f": ({corner}) is not in the set"
        )
    else:
        said = f"UNDECIDED  {shown}: neither shown to lie in the set, nor a state of it shown to lie outside"
    rest = ", ".join(f"{name} = {_number(q)}" for name, q in system.operating_point().items())
    return said + (
        f"\n(values of the states; their operating point {rest} is not part of what the checker checks)" if rest else ""
    )


def _number(q: Fraction) -> str:
    """A number that an answer is about: rounded it may lie on the other side of the boundary, so that a long one is
    said to be rounded; the JSON has it exactly.

    >>> _number(Fraction(-1, 10)), _number(Fraction(0.1))
    ('-0.1', 'about 0.10000000000000001')
    """
    from certify.report.words import if_short

    return if_short(q) or f"about {float(q):.17g}"
