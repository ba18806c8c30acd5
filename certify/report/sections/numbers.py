"""The tables of numbers: levels, sizes, the loop near the origin, matrices, the evidence, the run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.certificates import AnyCertificate, Certificate, TrustedSolver
from certify.certificates.claims import Outer
from certify.certificates.drawn import nonlinearity_of
from certify.errors import CertifyError
from certify.loop.closed_loop import ClosedLoop
from certify.lyapunov import Neural, domain_limit, extents, sampled_volume, semi_axes, volume
from certify.report.figures.sets import centre_of, inner_of, is_ellipsoid, is_local_enough, slabs_of, tree_of
from certify.report.limits import limited_by, outer_limited_by
from certify.report.sections.shared import (
    Ellipsoid,
    duration_in_words,
    ellipsoids_of,
    ranks_of,
    read_in_words,
    shares_of,
    timing_of,
    words_of,
)
from certify.report.sections.status import Status, is_missed
from certify.report.words import (
    ABSENT,
    MINUS,
    above,
    below,
    deviation,
    distinguished,
    estimated,
    held_at,
    is_free,
    network_name,
    nonlinearity_in_words,
    number,
    pretty_unit,
    seconds,
    shortest,
    symbol,
    volume_name,
    volume_unit,
)

Rows = list[tuple[str, str]]


def tables_of(
    certificate: Certificate,
    status: Status,
    answer: Mapping[str, Any] | None,
    result: Mapping[str, Any] | None,
    sha256: str,
    size: int | None,
) -> dict[str, Any]:
    """All tables except those of the matrices, and their heads, by their names in the template."""
    drawn = is_ellipsoid(certificate)
    sets = ellipsoids_of(certificate) if drawn else ()
    heads, reach = _reach(certificate, sets) if drawn else ([], [])
    return {
        "levels": _levels(certificate, result),
        "size": _sizes(certificate, sets),
        "ranked": ranked_rows(certificate),
        "estimated": _estimated(certificate, result) if drawn else "",
        "geometry": _geometry(certificate),
        "reach": reach,
        "reach_heads": heads,
        "sets": "the set reaches" if len(heads) <= 2 else "each set reaches",
        "measure": volume_name(certificate.system.n),
        "evidence": _evidence(certificate, answer if status.accepted else None, sha256, size),
        "run": run_rows(result),
        "candidates": _candidates(certificate, result),
    }


def matrices_of(certificate: Certificate) -> list[tuple[str, list[list[str]]]]:
    """Names and entries of the matrices, as the file has them."""
    named = [("P", certificate.P)]
    if certificate.claim.start is not None:
        named.append(("P₀ of the tube's start", certificate.claim.start.P))
    centre = centre_of(certificate)
    if centre is not None:
        named.append(("c₀, a row of states as the tube's start lies around them", centre[None]))
    return [(name, [[repr(float(v)) for v in row] for row in P]) for name, P in named]


def _levels(certificate: Certificate, result: Mapping[str, Any] | None) -> Rows:
    """The levels of V and N, and their limits as far as a run reports them."""
    words, inner, beyond = words_of(certificate), inner_of(certificate), certificate.claim.outer
    rows = [(f"{words.inner}, {words.inner_word}", repr(inner))]
    rows += [("c₁, local", repr(certificate.inner))] if inner != certificate.inner else []
    rows += [("c₂, enlarged", repr(certificate.roa))]
    if is_ellipsoid(certificate):
        limit = domain_limit(certificate.P, certificate.system.domain)
        share = below(100 * Fraction(certificate.roa) / Fraction(limit), 4) if limit > 0 else "?"
        rows.append(("domain's limit", f"{below(limit, 10)}, of which c₂ is {share} %"))
    if beyond is not None:
        rows.append(("n₂, of N", repr(beyond.level)))
    if result is not None:
        if not is_missed(result):
            rows.append(("limited by", limited_by(result)))
        if result.get("outer"):
            rows.append(("n₂ limited by", outer_limited_by(result["outer"])))
        sampled = result["levels"].get("sampled_limit")
        if sampled is not None:
            rows.append(("lowest V of a violation found", number(sampled, 10)))
    return rows


def _sizes(certificate: Certificate, sets: Sequence[Ellipsoid]) -> Rows:
    """The volume of each set."""
    kind, unit = volume_name(certificate.system.n), _unit_of(certificate)
    return [
        (kind + (f" of {one.name}" if len(sets) > 1 else ""), f"{below(volume(one.P, one.level))} {unit}".rstrip())
        for one in sets
    ]


def ranked_rows(certificate: AnyCertificate, target: str = "to {V ≤ c₂}", boxes: str = "boxes with ranks") -> Rows:
    """The boxes with ranks: how many, how large, how far away."""
    found, tree, system = ranks_of(certificate), tree_of(certificate), certificate.system
    if found is None or tree is None:
        return []
    sides = zip(system.states, tree.lo.tolist(), tree.hi.tolist(), strict=True)
    units = system.units
    box = [
        f"{symbol(s.name)} ∈ [{number(a, 8)}, {number(b, 8)}] {pretty_unit(units.get(s.name, ''))}".rstrip()
        for s, a, b in sides
    ]
    steps = "steps" if system.sample is None else "sampling instants"
    size = f"{below(found.volume)} {_unit_of(certificate)}".rstrip()
    return [
        (boxes, f"{found.proved:,} of {found.leaves:,}"),
        (f"most {steps} {target}", f"{found.steps:,}"),
        (f"{volume_name(system.n)} of these boxes", size),
        ("share of the box that was cut", f"{below(100 * found.share, 4)} %"),
        ("that box", ", ".join(box)),
    ]


def _reach(certificate: Certificate, sets: Sequence[Ellipsoid]) -> tuple[list[str], list[tuple[str, ...]]]:
    """Heads of the columns and, for each state, the sets' reach along it, beside its domain."""
    system = certificate.system
    heads, columns = _lengths(certificate, sets)
    names = [
        deviation(s.name, q, system.units.get(s.name, ""))
        for s, q in zip(system.states, system.exact_x_eq(), strict=True)
    ]
    centre = centre_of(certificate) if len(sets) > 1 else None
    if centre is not None:
        heads, columns = ["c₀", *heads], [[shortest(v) for v in centre.tolist()], *columns]
    domain = [f"[{below(lo)}, {above(hi)}]" for lo, hi in system.domain]
    return heads, list(zip(names, *columns, domain, strict=True))


def _geometry(certificate: Certificate) -> Rows:
    """The eigenvalues of V and of the loop, and the timing."""
    system, timing, rows = certificate.system, timing_of(certificate), list[tuple[str, str]]()
    if np.all(np.isfinite(certificate.P)):
        rows.append(("eigenvalues of P", ", ".join(number(float(v)) for v in np.linalg.eigvalsh(certificate.P))))
    if certificate.claim.at_rest:  # elsewhere the origin need not be an equilibrium
        held = f" with {held_at(system)}" if system.ranges else ""
        rows.append((f"eigenvalues of the closed loop{timing.linearised}{held}", _eigenvalues(certificate)))
    if timing.sample is not None:
        rows.append(("input held over", timing.periods))
    if timing.rate:
        rows.append(("rate λ", f"{certificate.claim.rate!r} per {'step' if timing.discrete else 's'}"))
    return rows


def _evidence(certificate: Certificate, accepted: Mapping[str, Any] | None, sha256: str, size: int | None) -> Rows:
    """The claim's basis: the policy, the file, and the checker's counts if it `accepted`."""
    beyond, slabs, rows = certificate.claim.outer, slabs_of(certificate), file_rows(certificate, sha256, size)
    if beyond is not None:
        rows += _outer_rows(beyond, accepted)
    if slabs:
        rows.append(("tube", f"{len(slabs):,} slabs, {duration_in_words(certificate)}"))
    if isinstance(certificate.evidence, TrustedSolver):
        solver = certificate.evidence
        rows.append(("solver", f"{solver.solver} {solver.version}, delta {number(solver.precision)}"))
        rows += [(f"its answer to {name}", said) for name, said in solver.queries]
    elif accepted is not None:
        leaves = f"{accepted.get('leaves', 0):,}, of which {accepted.get('ring_leaves', 0):,} in the ring"
        whole = is_local_enough(certificate)
        rows.append(("leaves", "none needed: the local part covers the whole set" if whole else leaves))
    return rows


def file_rows(certificate: AnyCertificate, sha256: str, size: int | None) -> Rows:
    """The policy and the file."""
    network = certificate.network
    return [
        ("policy", f"{network.words}, squash {network.squash}, centre {network.centre}"),
        *(() if network.clip is None else (("clipped to", _clip(certificate)),)),
        *((("its layers read", read_in_words(certificate)),) if network.is_moved else ()),
        *_nonlinear(certificate),
        ("policy sha256", network.sha256()),
        ("certificate sha256", sha256),
        *(() if size is None else (("certificate size", f"{size:,} bytes"),)),
    ]


def _nonlinear(certificate: AnyCertificate) -> Rows:
    """The policy's distance from its linear part, sampled on the set."""
    found = nonlinearity_of(certificate)
    return [] if found is None else [("linear part *", nonlinearity_in_words(found.to_dict()))]


def run_rows(result: Mapping[str, Any] | None) -> Rows:
    """The run's work and times; empty without a run."""
    if result is None:
        return []
    rows = [("boxes examined", f"{result['boxes']:,}")] if result.get("boxes") else []
    rows += [(f"{k}", seconds(v)) for k, v in result["seconds"].items() if v is not None]
    asked = result.get("solver") or {}
    for q in asked.get("queries", []):
        about = f"{asked['solver']} {asked['version']} on {q['query']}, V <= {number(q['level'])}"
        rows.append((about, f"{q['answer']}, {seconds(q['seconds'])}"))
    return rows


def _candidates(certificate: Certificate, result: Mapping[str, Any] | None) -> list[tuple[str, ...]]:
    """A row for each V that the run tried."""
    unit, found = _unit_of(certificate), list((result or {}).get("candidates", []))
    return [
        (
            name,
            below(row["level"]),
            f"{below(row['volume'])} {unit}".rstrip(),
            "the domain" if row["limited_by"] == "domain" else "a violation found",
            f"{below(row['proved_volume'])} {unit}".rstrip() if row.get("proved_volume") else ABSENT,
            "this one" if row["proved"] else "",
        )
        for name, row in zip(distinguished([one["candidate"] for one in found]), found, strict=True)
    ]


def _unit_of(certificate: AnyCertificate) -> str:
    """The unit of a volume of states."""
    system = certificate.system
    return volume_unit([system.units.get(s.name, "") for s in system.states])


def _outer_rows(beyond: Outer, answer: Mapping[str, Any] | None) -> list[tuple[str, str]]:
    """N, and the number of leaves on which the checker examined it."""
    N = beyond.function
    rows = [("N", network_name(N.widths)), ("sha256 of N", N.sha256())] if isinstance(N, Neural) else []
    found = (answer or {}).get("outer")
    if isinstance(found, Mapping):
        leaves = f"{found.get('leaves', 0):,}, and {found.get('face_leaves', 0):,} on the faces of the domain"
        rows.append(("leaves of the outer set", leaves))
    return rows


def _estimated(certificate: Certificate, result: Mapping[str, Any] | None) -> str:
    """The volume of the union with the outer set, from the run or from samples; empty without one."""
    beyond, system = certificate.claim.outer, certificate.system
    if beyond is None:
        return ""
    found: Mapping[str, Any] = (result or {}).get("outer") or {}
    if found:
        size = float(found["volume"]), float(found["deviation"])
    else:
        N, n2, V, c2 = beyond.function, beyond.level, certificate.V, certificate.roa
        size = sampled_volume(lambda x: (N(x) <= n2) | (V(x) <= c2), system.domain)
    return estimated(*size, _unit_of(certificate))


def _lengths(certificate: Certificate, sets: Sequence[Ellipsoid]) -> tuple[list[str], list[list[str]]]:
    """Heads and columns of the sets' reach along the states: on the axes, rounded down, and at most, rounded up.

    Two sets have their sizes on the axes side by side, also as shares of the domain if both lie around the
    origin.
    """
    axes = [[below(float(v)) for v in semi_axes(each.P, each.level)] for each in sets]
    most = [[above(float(v)) for v in extents(each.P, each.level)] for each in sets]
    if len(sets) == 1:
        return ["others at rest, ±", "at most, ±"], [*axes, *most]
    for column, each in zip(axes, sets, strict=True) if centre_of(certificate) is None else ():
        shares = shares_of(certificate, semi_axes(each.P, each.level))
        column[:] = [f"{v} ({below(100 * q, 3)} %)" for v, q in zip(column, shares, strict=True)]
    heads = [f"{each.name}, {what}, ±" for what in ("others at rest", "at most") for each in sets]
    return heads, [*axes, *most]


def _clip(certificate: AnyCertificate) -> str:
    """Each input's limits, in its unit."""
    inputs, clip = certificate.system.inputs, certificate.network.clip or ()
    each = zip(inputs, *clip, strict=True)
    acting = ((s.name, float(lo), float(hi)) for s, lo, hi in each if not is_free(lo, hi))
    return ", ".join(f"{name} in [{number(lo, 10)}, {number(hi, 10)}]" for name, lo, hi in acting)


def _eigenvalues(certificate: Certificate) -> str:
    try:
        A, B, K = ClosedLoop(certificate.system, certificate.network).linearise()
    except CertifyError as error:
        return str(error)
    if certificate.system.sample is not None:
        A = _over_period(A + B @ K, B, K, float(certificate.system.sample[1]))
    return ", ".join(_complex(complex(v)) for v in sorted(np.linalg.eigvals(A), key=lambda v: (v.real, v.imag)))


def _over_period(A: NDArray[np.float64], B: NDArray[np.float64], K: NDArray[np.float64], h: float) -> Any:
    """The map of x over a period of x' = A x + B u with u = -K x held: e^(A h) - int_0^h e^(A s) ds B K."""
    from scipy.linalg import expm

    n, m = B.shape
    both = expm(h * np.block([[A, B], [np.zeros((m, n + m))]]))
    return both[:n, :n] - both[:n, n:] @ K


def _complex(value: complex) -> str:
    if value.imag == 0:
        return number(value.real, 5)
    return f"{number(value.real, 5)} {'+' if value.imag > 0 else MINUS} {number(abs(value.imag), 5)}i"
