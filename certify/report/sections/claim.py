"""The proved claim in words and numbers, N where there is one, and the checker's result for each part.

`certify/report/claims.py` has the sentences of each kind of claim; here they get their numbers and notes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.certificates import Certificate, PartitionTree, TrustedSolver
from certify.certificates.claims import Outer
from certify.loop.expressions import nodes
from certify.loop.plants import System, input_errors
from certify.lyapunov import Neural, extents
from certify.report.claims import CHECKED_ALWAYS, INPUTS
from certify.report.figures.sets import centre_of, inner_of, is_ellipsoid, is_local_enough, slabs_of, start_of
from certify.report.mathml import inequality, typeset
from certify.report.measured import Measured, stated_of
from certify.report.sampled import Sampled
from certify.report.sections.shared import centre_in_words, duration_in_words, ranks_of, timing_of, words_of
from certify.report.timing import TimingInWords
from certify.report.words import (
    MINUS,
    above,
    below,
    inner_level,
    is_free,
    kept_apart,
    listed,
    network_name,
    pretty_unit,
    shortest,
    symbol,
)

_MOST_OPERATIONS = 200  # of an expression N that is shown


def claim_of(certificate: Certificate, answer: Mapping[str, Any] | None) -> dict[str, Any]:
    """The claim of FORMAT.md in words and numbers, with the checker's result for each part.

    For a solver's answer the checker shows only the exact parts; the others name the solver.
    """
    system, timing = certificate.system, timing_of(certificate)
    units = {s.name: pretty_unit(system.units.get(s.name, "")) for s in (*system.states, *system.inputs)}
    drawable = is_ellipsoid(certificate)
    bounds = [
        f"{below(lo)} ≤ {symbol(s.name)} ≤ {above(hi)} {units[s.name]}".rstrip()
        for s, (lo, hi) in zip(system.inputs, system.input_bounds, strict=True)
        if not is_free(lo, hi)
    ]
    parts = _parts(certificate, _notes(certificate, answer, bounds))
    inner, outer = inner_level(certificate.kind, inner_of(certificate)), below(certificate.roa)
    beyond = _beyond(certificate, certificate.claim.outer)
    practical = not certificate.claim.at_rest
    statement = words_of(certificate).statement.format(
        inner=inner,
        outer=outer,
        beyond="" if beyond is None else beyond["level"],
        duration=duration_in_words(certificate),
        centre=centre_in_words(certificate),
        speed=timing.speed(inner_of(certificate) if practical else None, certificate.roa) if drawable else "",
        constant="where what is uncertain is constant in time, " if system.ranges else "",
        steps="" if certificate.claim.ranks is None else f"{certificate.claim.ranks.steps:,}",
        constraints=listed(list(certificate.constraints)) if certificate.constraints else "",
    )
    return {
        "statement": stated_of(system, statement, by_steps=timing.discrete),
        "definition": timing.definitions,
        "middle": below(certificate.inner) if practical and certificate.inner != inner_of(certificate) else "",
        "enlarged": certificate.claim.start is not None,
        "centre": certificate.claim.centre is not None,
        "beyond": beyond,
        "ranked": certificate.claim.ranks is not None,
        "turned": [symbol(name) for name in system.angles] if certificate.claim.ranks is not None else [],
        "constraints": [inequality(name, g) for name, g in certificate.constraints.items()],
        "level": outer,
        "inner": inner,
        "bounds": bounds,
        "parts": parts,
    }


def _notes(certificate: Certificate, answer: Mapping[str, Any] | None, bounds: Sequence[str]) -> dict[str, str]:
    """The checker's findings on each part, by the part's name; `bounds` are those of the inputs."""
    margins = answer.get("margins", {}) if answer else {}
    local, ring = margins.get("local"), margins.get("ring")
    notes = {
        "Domain": f"{_sides(certificate, certificate.P, certificate.roa)}." if is_ellipsoid(certificate) else "",
        "Inputs": "; ".join(bounds) + ".",
    }
    if local:
        notes["Local"] = (
            f"Margin{' of the linear part over the remainder' if certificate.claim.at_rest else ''}: "
            f"{below(100 * local, 3)} %{_in_cells(certificate.evidence)}."
        )
    if answer and is_local_enough(certificate):
        notes["Ring"] = "As c₁ = c₂, the local part covers the whole set."
    elif answer:
        notes["Ring"] = f"Shown on {answer.get('ring_leaves', 0):,} of {answer.get('leaves', 0):,} leaves"
        if ring is not None:
            notes["Ring"] += f"; {_smallest(timing_of(certificate))} is {below(ring, 3)}."
    return notes | _tube_notes(certificate) | _outer_notes(answer) | _rank_notes(certificate, answer)


def _parts(certificate: Certificate, notes: Mapping[str, str]) -> list[tuple[str, str, str]]:
    """Each part's name, condition and note, and where a solver is believed, that its word was not checked."""
    parts, evidence = [], certificate.evidence
    for name, condition, shown_by in _with_errors(words_of(certificate).parts, certificate.system):
        note = notes.get(name, "")
        if isinstance(evidence, TrustedSolver):
            text = f"{condition.rstrip('.')}."
            by = "Checked in exact arithmetic." if name in CHECKED_ALWAYS else f"Not checked: {evidence.solver}'s word."
            note = f"{by} {note}".rstrip()
        else:
            text = f"{condition}, {shown_by}." if shown_by else condition
        parts.append((name, text, note))
    data, sampled = Measured.of(certificate.system), Sampled.of(certificate.system)
    if sampled is not None:
        parts.append(
            (
                "Samples",
                "Wherever states are in the domain and inputs in their bounds, the equations have the values of every "
                "consistent function: between the points of a grid by how far interpolation may be off, at the origin "
                "by slopes; sums of samples bound values and slopes, in rationals.",
                f"From {sampled.count:,} samples of a file with the sha256 {sampled.sha256}.",
            )
        )
    if data is not None:
        parts.append(
            (
                "Measurements",
                f"Every constant {data.names} in the priors {data.consistent} lies in the ranges, by sums of what the "
                "transitions say, with multipliers of linear programs.",
                f"From a file with the sha256 {data.sha256}.",
            )
        )
    return parts


def _beyond(certificate: Certificate, outer: Outer | None) -> dict[str, Any] | None:
    """Describe N: a network by its widths and hash, an expression by its formula unless it is long."""
    if outer is None:
        return None
    N, level = outer.function, below(outer.level)
    if isinstance(N, Neural):
        return {"level": level, "name": network_name(N.widths), "sha256": N.sha256(), "formula": ""}
    operations = sum(1 for node in nodes(N.expression) if node.operands)
    shown = operations <= _MOST_OPERATIONS
    name = "this expression" if shown else f"an expression of {operations:,} operations, which stands in the file"
    left = "<mi>N</mi><mo>(</mo><mi>x</mi><mo>)</mo>"
    formula = typeset(left, N.expression) if shown else ""
    return {"level": level, "name": name, "sha256": "", "formula": formula}


def _smallest(timing: TimingInWords) -> str:
    """The quantity whose least value is the margin of the ring, in words."""
    return f"the smallest bound on {MINUS}{f'({timing.decrease})' if timing.rate else timing.decrease}"


def _in_cells(evidence: PartitionTree | TrustedSolver) -> str:
    """The number of cells over which a margin is the least; empty if there is only one."""
    count = math.prod(evidence.cells) if isinstance(evidence, PartitionTree) else 1
    return f", the least of {count:,} cells of the box of all ranges" if count > 1 else ""


def _with_errors(parts: Sequence[tuple[str, str, str]], system: System) -> Iterator[tuple[str, str, str]]:
    """The parts of a claim, with the part on inputs reworded for input errors."""
    errors = input_errors(system)
    held = all(lo <= 0 <= hi for lo, hi in (system.ranges[e] for e in errors.values()))
    on_top = (
        "On {V ≤ c₂} what the policy asks for, π(x), stays in the bounds of the input; the error comes on top of it. "
    )
    clips = "An actuator that clips the two together makes the error no larger, and is covered." if held else ""
    for part in parts:
        yield (part[0], (on_top + clips).rstrip(), part[2]) if part == INPUTS and errors else part


def _sides(
    certificate: Certificate, P: NDArray[np.float64], level: float, centre: NDArray[np.float64] | None = None
) -> str:
    """The reach of {(x - c)'P(x - c) <= level} from c along each state, shown as less than the domain's."""
    system = certificate.system
    around = np.zeros(system.n) if centre is None else centre
    each = zip(system.states, extents(P, level), system.domain, map(Fraction, around.tolist()), strict=True)
    units = {s.name: pretty_unit(system.units.get(s.name, "")) for s in system.states}
    return "; ".join(
        f"|{_from(s.name, c)}| ≤ {kept_apart(float(e), min(c - lo, hi - c))} {units[s.name]}".rstrip()
        for s, e, (lo, hi), c in each
    )


def _from(name: str, value: Fraction) -> str:
    """A state less a value: `θ + 0.1`."""
    return f"{symbol(name)} {MINUS if value > 0 else '+'} {shortest(float(abs(value)))}" if value else symbol(name)


def _tube_notes(certificate: Certificate) -> dict[str, str]:
    """Notes on the tube: its number of slabs, its duration, and the reach of its start."""
    start = start_of(certificate)
    if start is None:
        return {}
    sides = _sides(certificate, start, 1.0, centre_of(certificate))
    count = len(slabs_of(certificate))
    slabs = f"{count:,} slabs" if count != 1 else "One slab"
    return {
        "Tube": f"{slabs}, {duration_in_words(certificate)} in all.",
        "Along the tube": f"At the start {sides}.",
    }


def _rank_notes(certificate: Certificate, answer: Mapping[str, Any] | None) -> dict[str, str]:
    """The numbers of boxes with ranks, and of places at which the checker showed the constraints."""
    found, notes, rules = ranks_of(certificate), dict[str, str](), (answer or {}).get("rules") or {}
    if found is not None:
        notes["Boxes"] = f"{found.proved:,} of {found.leaves:,} boxes have a rank."
    if certificate.constraints:
        asked = f"; asked {rules['keep']:,} times" if rules.get("keep") else ""
        notes["Constraints"] = f"{listed(list(certificate.constraints))}{asked}."
    return notes


def _outer_notes(answer: Mapping[str, Any] | None) -> dict[str, str]:
    """Notes on the outer set's parts: the number of leaves on which the checker showed each."""
    beyond = (answer or {}).get("outer")
    if not isinstance(beyond, Mapping):
        return {}
    margin = (answer or {}).get("margins", {}).get("outer")
    least = "" if margin is None else f"; the smallest bound on {MINUS}N′F is {below(margin, 3)}"
    return {
        "Faces": f"Shown on {beyond.get('face_leaves', 0):,} leaves.",
        "Outer set": f"Shown on {beyond.get('leaves', 0):,} leaves{least}.",
    }
