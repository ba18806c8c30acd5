"""One self-contained HTML page for a certificate: figures inline, no script, nothing loaded from anywhere.

The page says that something was proved only if the checker's answer says ACCEPTED *and* is about the very bytes that
the page is drawn from: by their hash, and for good measure by the policy and the levels. An answer about anything else
is an error, not a page. Every text that comes from a file passes through jinja2's escaping.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import sympy
from numpy.typing import NDArray

from certify.certificate import Certificate, PartitionTree, TrustedSolver
from certify.claims import Asymptotic, Enlarged, Outer, Reached
from certify.closed_loop import ClosedLoop
from certify.errors import CertifyError, InputError, SoundnessError
from certify.lyapunov import Neural, domain_limit, extents, sampled_volume, semi_axes, volume
from certify.report.claims import CHECKED_ALWAYS, INPUTS, Words, words_for
from certify.report.figures import Picture, draw
from certify.report.figures.scene import centre_of, inner_of, is_ellipsoid, is_local_enough, slabs_of, start_of
from certify.report.limits import limit_in_words, limited_by, outer_limited_by
from certify.report.sampling import SimulatedRoa
from certify.report.sheet import filled
from certify.report.timing import Timing
from certify.report.words import (
    ABSENT,
    MINUS,
    TIMES,
    Varying,
    above,
    at_rest,
    below,
    deviation,
    estimated,
    held_at,
    inner_level,
    kept_apart,
    listed,
    network_name,
    number,
    point,
    pretty_unit,
    seconds,
    shortest,
    stated_for,
    symbol,
    varying_in,
    volume_name,
    volume_unit,
)
from certify.systems import System

Figures = tuple[list[Picture], SimulatedRoa | None]
TEMPLATE = "certify.report", "template.html"
_LONG = 10**6  # numerators and denominators beyond it are shown rounded
_MOST_OPERATIONS = 200  # of an expression N that is shown
_SECONDS, _SHARE = 10.0, 0.1  # the drawing takes no longer than the one, or than this share of the run


@dataclass(frozen=True, slots=True)
class Status:
    """What may be said of a certificate: kind is ACCEPTED, TRUSTED, REJECTED or NOT CHECKED; note says why."""

    kind: str
    note: str

    @property
    def accepted(self) -> bool:
        """Whether the page may speak of a proof."""
        return self.kind == "ACCEPTED"


def status_of(certificate: Certificate, sha256: str, answer: Mapping[str, Any] | None) -> Status:
    """What the checker's answer lets be said of the certificate whose bytes have this hash.

    Raises
    ------
    SoundnessError : the answer accepts, or trusts, something else than this certificate.
    """
    if answer is None:
        return Status("NOT CHECKED", "The checker was not asked. Until it accepts the file, nothing here is proved.")
    kind = answer.get("result")
    if kind == "REJECTED":
        where = f"rule {answer.get('rule', '?')} at {answer.get('at', '?')}"
        detail = f": {answer['detail']}" if answer.get("detail") else ""
        return Status("REJECTED", f"The checker refuses the certificate by {where}{detail}. Nothing here is proved.")
    if kind not in ("ACCEPTED", "TRUSTED"):
        return Status("NOT CHECKED", "The checker gave no verdict. Nothing here is proved.")
    levels = answer.get("levels")
    given = dict(levels) if isinstance(levels, Mapping) else {}
    beyond, stated = answer.get("outer"), certificate.claim.outer
    beyond = beyond if beyond is None or (isinstance(beyond, Mapping) and "level" in beyond) else {"level": "none"}
    for what, found, wanted in (
        ("bytes with sha256", answer.get("certificate_sha256"), sha256),
        ("policy with sha256", answer.get("policy_sha256"), certificate.network.sha256()),
        ("levels", given, dict(certificate.claim.levels)),
        (
            "level of the outer set",
            None if beyond is None else [beyond["level"]],
            None if stated is None else [stated.level],
        ),
        ("evidence to replay", kind == "ACCEPTED", isinstance(certificate.evidence, PartitionTree)),
    ):
        if found != wanted:
            raise SoundnessError(
                f"the checker's answer must be about the certificate that the report shows; {what}: the answer has "
                f"{found}, the certificate {wanted}. Read the file once and check the bytes that were read."
            )
    if isinstance(certificate.evidence, TrustedSolver):
        solver = f"{certificate.evidence.solver} {certificate.evidence.version}"
        return Status(
            "TRUSTED",
            f"The checker checked what is exact: {_checked(certificate.kind)}. All else, above all that V̇ "
            f"is negative, is the word of {solver}, which nothing here can check. It is not a proof.",
        )
    return Status("ACCEPTED", "The independent checker accepted the certificate.")


def _timing(certificate: Certificate) -> Timing:
    return Timing.of(certificate.system, certificate.claim.rate)


def _words(certificate: Certificate) -> Words:
    evidence = certificate.evidence
    ball = isinstance(evidence, PartitionTree) and evidence.local is not None
    return words_for(certificate.kind, _timing(certificate), ball=ball, beyond=certificate.claim.outer is not None)


def _checked(kind: str) -> str:
    """What is checked whatever the evidence is."""
    names = {"Lyapunov function": "P", "Equilibrium": "P, the equilibrium", "Domain": "the domain"}
    return ", ".join(names[name] for name, _, _ in words_for(kind).parts if name in CHECKED_ALWAYS)


def render_html(
    certificate: Certificate,
    answer: Mapping[str, Any] | None,
    result: Mapping[str, Any] | None,
    certificate_path: Path,
    *,
    sha256: str | None = None,
    size: int | None = None,
    figures: Figures | None = None,
) -> str:
    """The report as one HTML document.

    Read the file once, with `read_raw`; take the certificate from these bytes with `parse_certificate`, their sha256
    and size, and the answer of `certify.certificate.run_checker` about a private file that holds them.

    Parameters
    ----------
    certificate : what is shown.
    answer : what the checker said; None if it was not run.
    result : `RoaResult.to_dict()` of the run that made the certificate; None if there is none.
    certificate_path : for its name alone; nothing is read from it.
    sha256, size : of the bytes that the certificate was parsed from. Without them, those of the bytes that
        `write_certificate` writes for it: the answer must then be about exactly such a file.
    figures : `figures_of` this certificate as accepted, if they are there already.

    Raises
    ------
    SoundnessError : the answer is not about these bytes.
    InputError : the result is not of the run that made the certificate.
    """
    if sha256 is None:
        raw = certificate.to_json().encode("utf-8")
        sha256, size = hashlib.sha256(raw).hexdigest(), len(raw)
    status = status_of(certificate, sha256, answer)
    beyond = certificate.claim.outer
    if result is not None and (
        result["policy"]["sha256"],
        result["levels"].get("roa"),
        (result.get("outer") or {}).get("level"),
    ) != (certificate.network.sha256(), certificate.roa, None if beyond is None else beyond.level):
        raise InputError("`result` must be of the run that made the certificate; its policy or a level is another.")
    words = _words(certificate)
    pictures: list[Picture] = []
    roa, trouble = None, ""
    try:
        if figures is None or not status.accepted:
            figures = figures_of(certificate, status.accepted, result)
        pictures, roa = figures
    except np.linalg.LinAlgError as error:
        trouble = f"There are no figures: floating point cannot draw them: {error}"
    except (CertifyError, ValueError, ArithmeticError) as error:
        if status.accepted:
            raise
        trouble = f"There are no figures: {error}"  # a rejected file need not make sense
    limits = _limits(certificate, result)
    return filled(
        *TEMPLATE,
        contents=_contents(status, limits),
        limits=limits,
        one_plane=certificate.system.n <= 2,
        status=status,
        words=words,
        replayed=isinstance(certificate.evidence, PartitionTree),
        pictures=[(legend, list(members)) for legend, members in groupby(pictures, lambda p: p.legend)],
        trouble=trouble,
        claim=_claim(certificate, answer if status.accepted else None),
        missed=_missed(result, status),
        plant=_plant(certificate),
        tables=_tables(certificate, status, answer, result, sha256, size),
        matrices=_matrices(certificate),
        roa=None if roa is None else _simulated(roa, certificate),
        timing=_timing(certificate),
        provenance=sorted((str(k), str(v)) for k, v in certificate.provenance.items()),
        file=certificate_path.name,
        not_proved=_not_proved(certificate, words),
    )


def figures_of(certificate: Certificate, accepted: bool, result: Mapping[str, Any] | None) -> Figures:
    """The figures, in the time that they may take after a run that has taken what `result` says.

    Raises
    ------
    CertifyError, ValueError, ArithmeticError : the certificate makes no sense, which one that is accepted does.
    """
    return draw(certificate, accepted, seconds=_time_for(result))


def _time_for(result: Mapping[str, Any] | None) -> float:
    """Seconds that the figures may take."""
    total = None if result is None else result["seconds"].get("total")
    return max(_SECONDS, _SHARE * (total or 0.0))


def _contents(status: Status, limits: Mapping[str, Any] | None) -> list[tuple[str, str]]:
    """Targets and titles of the table of contents."""
    found = [
        ("claim", "What was proved" if status.accepted else "What is claimed"),
        ("outside", "What was not proved" if status.accepted else "What lies outside the claim"),
        ("figures", "Figures"),
    ]
    if limits is not None:
        found.append(("limits", "What limits the set" if limits["binds"] else "Share of the domain"))
    return [*found, ("numbers", "Numbers"), ("check", "How to check")]


@dataclass(frozen=True, slots=True)
class _Ellipsoid:
    """{x'Px <= level}, of those that the certificate is about; `kind` is `start` for that of a tube, else `set`.

    It lies around the origin, that of a tube around a path around its c₀.
    """

    kind: str
    name: str
    P: NDArray[np.float64]
    level: float


def _ellipsoids(certificate: Certificate) -> list[_Ellipsoid]:
    """The start of a tube where there is one, and {V <= c2}."""
    start = start_of(certificate)
    inner = _Ellipsoid("set", "{V ≤ c₂}", certificate.P, certificate.roa)
    name = "the start" if centre_of(certificate) is None else "the start, around c₀"
    return [inner] if start is None else [_Ellipsoid("start", name, start, 1.0), inner]


def _shares(certificate: Certificate, lengths: NDArray[np.float64]) -> list[float]:
    """Lengths along the states (n,) as shares of the nearer sides of the domain; infinite where that has none."""
    sides = [min(-lo, hi) for lo, hi in certificate.system.domain]
    each = zip(lengths, sides, strict=True)
    return [float(Fraction(float(v)) / side) if side > 0 else math.inf for v, side in each]


def _matrices(certificate: Certificate) -> list[tuple[str, list[list[str]]]]:
    """Names and entries of what the quadratic forms are, as the file has them."""
    named = [("P", certificate.P)]
    if isinstance(certificate.claim, Enlarged | Reached):
        named.append(("P₀ of the tube's start", certificate.claim.start.P))
    centre = centre_of(certificate)
    if centre is not None:
        named.append(("c₀, a row of states as the tube's start lies around them", centre[None]))
    return [(name, [[repr(float(v)) for v in row] for row in P]) for name, P in named]


def _is_missed(result: Mapping[str, Any] | None) -> bool:
    """Whether the run's reason is about what it was asked for, a state or a level of N, and not about the certificate's
    set."""
    return result is not None and result.get("stop") in ("path", "beyond")


def _missed(result: Mapping[str, Any] | None, status: Status) -> str:
    """That a state, or a level of N, was asked about of which this certificate says nothing; else nothing."""
    if result is None or not _is_missed(result):
        return ""
    if result.get("stop") == "beyond":
        smaller = " The certificate is about a smaller set." if status.accepted else ""
        return f"An outer set was asked for that is not proved: {result['reason'].rstrip('.')}.{smaller}"
    asked: Mapping[str, str] = result.get("reach_from") or {}
    units = {s["name"]: s.get("unit") or "" for s in result.get("states") or ()}
    where = point(list(asked), [Fraction(v) for v in asked.values()], [units.get(name, "") for name in asked])
    proved = "The certificate is about {V ≤ c₂} alone, in which this state does not lie." if status.accepted else ""
    return f"The state {where} was asked about. It is not shown to converge: {result['reason']}. {proved}".rstrip()


def _limits(certificate: Certificate, result: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """How much of its domain the set takes, and what the run says of what limits it; None where there is no set.

    The shares are the certificate's own; only words and the next step come from the run.
    """
    if not is_ellipsoid(certificate):
        return None
    system = certificate.system
    sets = _ellipsoids(certificate)
    if centre_of(certificate) is not None:  # how far a set that lies elsewhere reaches is no share of a side
        sets = sets[-1:]
    reach = [extents(each.P, each.level) for each in sets]
    shares = [_shares(certificate, e) for e in reach]
    found: Mapping[str, Any] = (result or {}).get("diagnosis") or {}
    names = {s.name: symbol(s.name) for s in system.states}
    step: Mapping[str, Any] = found.get("next") or {}
    options = " ".join(f"{name} {value}" for name, value in (step.get("options") or {}).items())
    return {
        "binds": "" if _is_missed(result) else limit_in_words(str(found.get("binds", "")), _timing(certificate)),
        "modes": ""
        if _timing(certificate).discrete
        else _modes(found, "with " * bool(system.ranges) + held_at(system)),
        "outer": _outer_limit(result),
        "sets": len(sets),
        "shares": [
            {
                "name": symbol(s.name) if each is sets[0] else "",
                "of": each.name,
                "kind": each.kind,
                "reach": f"{above(float(e[k]), 4)} {pretty_unit(system.units.get(s.name, ''))}".rstrip(),
                "share": f"{above(100 * share[k], 3)} %",
                "width": f"{min(100.0, 100 * share[k]):.1f}",
                "binds": share[k] == max(share),
            }
            for k, s in enumerate(system.states)
            for each, e, share in zip(sets, reach, shares, strict=True)
        ],
        "hurts": [
            (names.get(name, name), f"{100 * weight:.1f}", number(weight, 2))
            for name, weight in (found.get("hurts") or {}).items()
        ],
        "why": str(step.get("why", "")).rstrip("."),
        "command": step.get("command") or options,
    }


def _outer_limit(result: Mapping[str, Any] | None) -> str:
    """What the run says of what limits its outer set; nothing where there is none."""
    found: Mapping[str, Any] = (result or {}).get("outer") or {}
    return outer_limited_by(found) if found else ""


def _modes(found: Mapping[str, Any], held: str) -> str:
    """How fast the closed loop is at the origin, in a sentence, with the values that are not exact `held`."""
    if not found.get("stiffness"):
        return ""
    fast, slow = number(abs(found["fastest"]), 3), number(abs(found["slowest"]), 3)
    where = f"At the origin, {held}," if held else "At the origin"
    return (
        f"{where} its slowest mode decays at {slow} per second, its fastest at {fast} per second: a stiffness of "
        f"{number(found['stiffness'], 2)}."
    )


def _plant(certificate: Certificate) -> dict[str, Any]:
    system, units = certificate.system, certificate.system.units
    expressions, steps = system.uncertain_dynamics(), system.time == "discrete"

    def interval(name: str, bounds: tuple[Fraction, Fraction]) -> str:
        lo, hi = bounds
        return f"{symbol(name)} ∈ [{below(lo)}, {above(hi)}] {pretty_unit(units.get(name, ''))}".rstrip()

    names = (*system.states, *system.inputs, *(s for s, _ in system.uncertain))
    equilibrium = zip(system.inputs, system.exact_u_eq(), strict=True)
    return {
        "name": system.name,
        "equations": [_equation(s, e, names, steps=steps) for s, e in zip(system.states, expressions, strict=True)],
        "rounded": any(_is_long(v) for e in (*expressions, *system.u_eq) for v in e.atoms(sympy.Rational)),
        "domain": [interval(s.name, b) for s, b in zip(system.states, system.domain, strict=True)],
        "inputs": [interval(s.name, b) for s, b in zip(system.inputs, system.input_bounds, strict=True)],
        "at": at_rest(
            [s.name for s in system.states], system.exact_x_eq(), [units.get(s.name, "") for s in system.states]
        ),
        "read": _read(certificate) if certificate.network.is_moved else "",
        "centre": _centre(certificate, of_values=True),
        "u_eq": ", ".join(f"{symbol(s.name)} = {_short(u)}" for s, u in equilibrium),
        "uncertain": [q.words for q in varying_in(system)],
        "held": held_at(system),
        "listed": ", ".join(symbol(name) for name in system.ranges),
        "errors": [f"{symbol(u)} + {symbol(e)}" for u, e in system.input_errors.items()],
    }


def _equation(state: sympy.Symbol, expression: sympy.Expr, names: Sequence[sympy.Symbol], *, steps: bool) -> Any:
    """`state' = expression`, or by steps `state+ = expression`."""
    left = f"<mfrac><mrow><mi>d</mi>{_identifier(state.name)}</mrow><mrow><mi>d</mi><mi>t</mi></mrow></mfrac>"
    if steps:
        left = f"<msup>{_identifier(state.name)}<mo>+</mo></msup>"
    return _typeset(left, expression, names)


def _typeset(left: str, expression: sympy.Expr, names: Sequence[sympy.Symbol]) -> Any:
    """`left = expression` as MathML, which browsers typeset without help."""
    from markupsafe import Markup
    from sympy.printing.mathml import MathMLPresentationPrinter

    # Markers first: a pretty name may be the plain name of another symbol.
    markers = {s: sympy.Symbol(f"NAME{k}NAME") for k, s in enumerate(names)}
    long = {v: sympy.Float(v, 8) for v in expression.atoms(sympy.Rational) if _is_long(v)}
    text = MathMLPresentationPrinter().doprint(expression.xreplace(long).xreplace(markers))
    for k, s in enumerate(names):
        text = text.replace(f"<mi>NAME{k}NAME</mi>", _identifier(s.name))
    text = text.replace("<mo>-</mo>", f"<mo>{MINUS}</mo>")
    text = text.replace("<mo>&InvisibleTimes;</mo>", '<mspace width="0.15em"/>')
    inner = text.removeprefix("<math>").removesuffix("</math>")
    return Markup(f'<math display="block">{left}<mo>=</mo>{inner}</math>')


def _beyond(certificate: Certificate, outer: Outer | None) -> dict[str, Any] | None:
    """What N is: a network by its widths and hash, an expression itself unless it is long."""
    if outer is None:
        return None
    N, level = outer.function, below(outer.level)
    if isinstance(N, Neural):
        return {"level": level, "name": network_name(N.widths), "sha256": N.sha256(), "formula": ""}
    operations = int(sympy.count_ops(N.expression))
    shown = operations <= _MOST_OPERATIONS
    name = "this expression" if shown else f"an expression of {operations:,} operations, which stands in the file"
    left = "<mi>N</mi><mo>(</mo><mi>x</mi><mo>)</mo>"
    formula = _typeset(left, N.expression, certificate.system.states) if shown else ""
    return {"level": level, "name": name, "sha256": "", "formula": formula}


def _identifier(name: str) -> str:
    """A name in MathML; the dot of a derivative is set above."""
    base = name.removesuffix("_dot")
    if base and base != name:
        return f"<mover>{_identifier(base)}<mo>˙</mo></mover>"
    return f"<mi>{_escape(symbol(name))}</mi>"


def _escape(text: str) -> str:
    from markupsafe import escape

    return str(escape(text))


def _is_long(value: sympy.Rational) -> bool:
    return max(abs(int(value.p)), int(value.q)) > _LONG


def _short(value: Fraction) -> str:
    return number(float(value)) if _is_long(sympy.Rational(value.numerator, value.denominator)) else str(value)


def _claim(certificate: Certificate, answer: Mapping[str, Any] | None) -> dict[str, Any]:
    """The claim of FORMAT.md in words and numbers, and what the checker showed of each part.

    Of a solver's word the checker shows only the exact parts; the others say whose word they are.
    """
    system, words, evidence, timing = (
        certificate.system,
        _words(certificate),
        certificate.evidence,
        _timing(certificate),
    )
    units = {s.name: pretty_unit(system.units.get(s.name, "")) for s in (*system.states, *system.inputs)}
    drawable = is_ellipsoid(certificate)
    bounds = [
        f"{below(lo)} ≤ {symbol(s.name)} ≤ {above(hi)} {units[s.name]}".rstrip()
        for s, (lo, hi) in zip(system.inputs, system.input_bounds, strict=True)
    ]
    margins = answer.get("margins", {}) if answer else {}
    local, ring = margins.get("local"), margins.get("ring")
    notes = {
        "Domain": f"{_sides(certificate, certificate.P, certificate.roa)}." if drawable else "",
        "Inputs": "; ".join(bounds) + ".",
    }
    if local:
        notes["Local"] = (
            f"Margin{' of the linear part over the remainder' if certificate.claim.at_rest else ''}: "
            f"{below(100 * local, 3)} %{_in_cells(evidence)}."
        )
    if answer and is_local_enough(certificate):
        notes["Ring"] = "As c₁ = c₂, the local part covers the whole set."
    elif answer:
        shown = f"Shown on {answer.get('ring_leaves', 0):,} of {answer.get('leaves', 0):,} leaves"
        notes["Ring"] = f"{shown}; {_smallest(timing)} is {below(ring, 3)}." if ring is not None else shown
    notes |= _tube_notes(certificate) | _outer_notes(answer)
    parts = []
    for name, condition, shown_by in _with_errors(words.parts, system):
        note = notes.get(name, "")
        if isinstance(evidence, TrustedSolver):
            text = f"{condition.rstrip('.')}."
            by = "Checked in exact arithmetic." if name in CHECKED_ALWAYS else f"Not checked: {evidence.solver}'s word."
            note = f"{by} {note}".rstrip()
        else:
            text = f"{condition}, {shown_by}." if shown_by else condition
        parts.append((name, text, note))
    inner, outer = inner_level(certificate.kind, inner_of(certificate)), below(certificate.roa)
    beyond = _beyond(certificate, certificate.claim.outer)
    practical = not certificate.claim.at_rest
    statement = words.statement.format(
        inner=inner,
        outer=outer,
        beyond="" if beyond is None else beyond["level"],
        duration=_duration(certificate),
        centre=_centre(certificate),
        speed=timing.speed(inner_of(certificate) if practical else None, certificate.roa) if drawable else "",
        constant="where what is uncertain is constant in time, " if system.ranges else "",
    )
    return {
        "statement": stated_for(varying_in(system), statement, by_steps=timing.discrete),
        "definition": timing.definitions,
        "middle": below(certificate.inner) if practical and certificate.inner != inner_of(certificate) else "",
        "enlarged": isinstance(certificate.claim, Enlarged | Reached),
        "centre": isinstance(certificate.claim, Reached),
        "beyond": beyond,
        "level": outer,
        "inner": inner,
        "bounds": bounds,
        "parts": parts,
    }


def _smallest(timing: Timing) -> str:
    """Of what the margin of the ring is the least."""
    return f"the smallest bound on {MINUS}{f'({timing.decrease})' if timing.rate else timing.decrease}"


def _in_cells(evidence: PartitionTree | TrustedSolver) -> str:
    """Of how many cells of the ranges a margin is the least; nothing where there is but one."""
    count = math.prod(evidence.cells) if isinstance(evidence, PartitionTree) else 1
    return f", the least of {count:,} cells of the box of all ranges" if count > 1 else ""


def _with_errors(parts: Sequence[tuple[str, str, str]], system: System) -> Iterator[tuple[str, str, str]]:
    """The parts of a claim, the one on inputs in words that know the error that comes on top of what is asked for."""
    errors = system.input_errors
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
    """How far {(x - c)'P(x - c) <= level} reaches from c along each state, which is less than the domain does."""
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


def _centre(certificate: Certificate, *, of_values: bool = False) -> str:
    """c₀ of a tube around a path in words, as a deviation or by the states' values; a dash where there is none."""
    system, centre = certificate.system, centre_of(certificate)
    if centre is None or start_of(certificate) is None:
        return ABSENT
    names, units = [s.name for s in system.states], [system.units.get(s.name, "") for s in system.states]
    shifts = system.exact_x_eq() if of_values else [Fraction(0)] * system.n
    return point(names, [q + Fraction(c) for q, c in zip(shifts, centre.tolist(), strict=True)], units)


def _duration(certificate: Certificate) -> str:
    """Of the tube, rounded up; a dash where there is none, or a rejected file's is no number."""
    each = [slab.duration for slab in slabs_of(certificate)]
    return f"{above(sum(map(Fraction, each)))} s" if each and all(map(math.isfinite, each)) else ABSENT


def _tube_notes(certificate: Certificate) -> dict[str, str]:
    """Of the tube's part of the claim: how many slabs in what time, and how far its start reaches."""
    start = start_of(certificate)
    if start is None:
        return {}
    sides = _sides(certificate, start, 1.0, centre_of(certificate))
    count = len(slabs_of(certificate))
    slabs = f"{count:,} slabs" if count != 1 else "One slab"
    return {
        "Tube": f"{slabs}, {_duration(certificate)} in all.",
        "Along the tube": f"At the start {sides}.",
    }


def _outer_notes(answer: Mapping[str, Any] | None) -> dict[str, str]:
    """Of the outer set's parts: on how many leaves the checker has shown them."""
    beyond = (answer or {}).get("outer")
    if not isinstance(beyond, Mapping):
        return {}
    margin = (answer or {}).get("margins", {}).get("outer")
    least = "" if margin is None else f"; the smallest bound on {MINUS}N′F is {below(margin, 3)}"
    return {
        "Faces": f"Shown on {beyond.get('face_leaves', 0):,} leaves.",
        "Outer set": f"Shown on {beyond.get('leaves', 0):,} leaves{least}.",
    }


def _not_proved(certificate: Certificate, words: Words) -> list[tuple[str, str]]:
    items = [
        *words.excluded[:-1],
        (
            "Anything outside the set.",
            f"The true set may be larger: what starts outside {words.sets} may do the same or not.",
        ),
        *_not_of_the_plant(certificate.system),
        *_other_times(_timing(certificate)),
        _rounding(certificate.system),
        *words.excluded[-1:],
        ("Wrapped angles.", "States are real numbers: an angle of a full turn is not the origin."),
        (
            "Simulated figures.",
            "Trajectories, grids and the share of the simulated region are illustrations in floating point"
            + (f", all of them with {held} from beginning to end." if (held := held_at(certificate.system)) else "."),
        ),
    ]
    if certificate.claim.outer is not None:
        items.append(
            (
                "The size of the outer set.",
                "Its volume is estimated from samples, and its outline in the figures is drawn from a grid; only the "
                "inequality N(x) ≤ n₂ within the domain says which states belong to it.",
            )
        )
    if certificate.system.n > 2:
        items.append(
            (
                "The pictures as wholes.",
                "A section shows two states with all others 0, a projection two states whatever the others are; the "
                "claim is about all states together.",
            )
        )
    return items


def _other_times(timing: Timing) -> Iterator[tuple[str, str]]:
    """In which other ways than the claim's time may pass in a loop."""
    if timing.discrete:
        yield (
            "Time between the steps.",
            "The equations say what the state is one step later, and nothing of what lies between two steps. Where "
            "they come from a plant in continuous time, that they are exact for it, and what it does between them, is "
            "not part of the claim.",
        )
    elif timing.sample is None:
        yield (
            "A sampled controller.",
            "u = π(x) acts in continuous time. An action that is held between samples is another closed loop.",
        )
    else:
        longer = "longer" if timing.from_zero else "longer or shorter"
        yield (
            "Other periods, and delay.",
            f"The input changes at the sampling instants, at once, and is held over {timing.periods}. With a period "
            f"that is {longer} even once, a sample that is missed, or the time that computing the input takes, it is "
            "another closed loop.",
        )
        if not timing.from_zero:
            yield (
                "The set between two sampling instants.",
                "At the sampling instants the state is in the set; between two of them it is in the domain, and may be "
                "outside the set.",
            )


def _not_of_the_plant(system: System) -> list[tuple[str, str]]:
    """What of plant and surroundings the claim does not cover: less, where something has a range."""
    if not system.ranges:
        return [
            (
                "Any other plant.",
                "The claim is about the equations above with exactly these numbers: no other mass, no friction, "
                "flexibility or actuator lag that is not in them.",
            ),
            ("Disturbances.", "No wind, no sensor noise, no estimation error, no delay."),
        ]
    names = listed([symbol(name) for name in system.ranges])
    within = "its range" if len(system.ranges) == 1 else "their ranges"
    return [
        (
            "Any other plant.",
            f"The claim is about the equations above: with every value of {names} in {within} and none outside, and "
            "with exactly these numbers in all else: no friction, flexibility or actuator lag that is not in them.",
        ),
        (
            "Other disturbances.",
            f"Only what {names} can be in these equations: no other force, no sensor noise, no estimation error, no "
            "delay.",
        ),
    ]


def _rounding(system: System) -> tuple[str, str]:
    """What is not said of how the policy is evaluated: less, where inputs may be in error."""
    errors = system.input_errors
    exact = [s.name for s in system.inputs if s.name not in errors]
    if len(exact) == system.m:
        return (
            "Rounding in the controller.",
            "The policy is evaluated in exact real arithmetic on its binary64 numbers; an embedded float32 evaluation "
            "differs by its rounding errors.",
        )
    ranges = listed([Varying(e, *system.ranges[e], system.units.get(e, "")).words for e in errors.values()])
    others = f" {listed([symbol(name) for name in exact])} must be exact." if exact else ""
    return (
        "Larger errors of the controller.",
        f"An evaluation of the policy, in float32 for one, is covered as long as its error is {ranges}, at "
        f"every state of the set. That a certain program is, is not part of the claim.{others}",
    )


def _tables(
    certificate: Certificate,
    status: Status,
    answer: Mapping[str, Any] | None,
    result: Mapping[str, Any] | None,
    sha256: str,
    size: int | None,
) -> dict[str, Any]:
    system, P, network, words = certificate.system, certificate.P, certificate.network, _words(certificate)
    timing, inner = _timing(certificate), inner_of(certificate)
    state_units = [system.units.get(s.name, "") for s in system.states]
    levels = [(f"{words.inner}, {words.inner_word}", repr(inner))]
    levels += [("c₁, local", repr(certificate.inner))] if inner != certificate.inner else []
    levels += [("c₂, enlarged", repr(certificate.roa))]
    reach: list[tuple[str, ...]] = []
    heads: list[str] = []
    size_of_set: list[tuple[str, str]] = []
    if is_ellipsoid(certificate):
        limit = domain_limit(P, system.domain)
        share = below(100 * Fraction(certificate.roa) / Fraction(limit), 4) if limit > 0 else "?"
        levels.append(("domain's limit", f"{below(limit, 10)}, of which c₂ is {share} %"))
        sets = _ellipsoids(certificate)
        for each in sets:
            named = volume_name(system.n) + (f" of {each.name}" if len(sets) > 1 else "")
            size_of_set.append((named, f"{below(volume(each.P, each.level))} {volume_unit(state_units)}".rstrip()))
        heads, columns = _lengths(certificate, sets)
        points = zip(system.states, system.exact_x_eq(), state_units, strict=True)
        names = [deviation(s.name, q, unit) for s, q, unit in points]
        centre = centre_of(certificate) if len(sets) > 1 else None
        if centre is not None:
            heads, columns = ["c₀", *heads], [[shortest(v) for v in centre.tolist()], *columns]
        domain = [f"[{below(lo)}, {above(hi)}]" for lo, hi in system.domain]
        reach = list(zip(names, *columns, domain, strict=True))
    beyond = certificate.claim.outer
    if beyond is not None:
        levels.append(("n₂, of N", repr(beyond.level)))
    if result is not None:
        if not _is_missed(result):
            levels.append(("limited by", limited_by(result)))
        if result.get("outer"):
            levels.append(("n₂ limited by", outer_limited_by(result["outer"])))
        sampled = result["levels"].get("sampled_limit")
        if sampled is not None:
            levels.append(("lowest V of a violation found", number(sampled, 10)))
    geometry: list[tuple[str, str]] = []
    if np.all(np.isfinite(P)):
        geometry.append(("eigenvalues of P", ", ".join(number(float(v)) for v in np.linalg.eigvalsh(P))))
    if isinstance(certificate.claim, Asymptotic):  # elsewhere the origin need not be an equilibrium
        held = f" with {held_at(system)}" if system.ranges else ""
        geometry.append((f"eigenvalues of the closed loop{timing.linearised}{held}", _eigenvalues(certificate)))
    if timing.sample is not None:
        geometry.append(("input held over", timing.periods))
    if timing.rate:
        geometry.append(("rate λ", f"{certificate.claim.rate!r} per {'step' if timing.discrete else 's'}"))
    slabs = slabs_of(certificate)
    evidence = [
        ("policy", f"{'-'.join(map(str, network.layers))} tanh, squash {network.squash}, centre {network.centre}"),
        *(() if network.clip is None else (("clipped to", _clip(certificate)),)),
        *((("its layers read", _read(certificate)),) if network.is_moved else ()),
        ("policy sha256", network.sha256()),
        ("certificate sha256", sha256),
    ]
    if size is not None:
        evidence.append(("certificate size", f"{size:,} bytes"))
    if beyond is not None:
        evidence += _outer_rows(beyond, answer if status.accepted else None)
    if slabs:
        evidence.append(("tube", f"{len(slabs):,} slabs, {_duration(certificate)}"))
    if isinstance(certificate.evidence, TrustedSolver):
        solver = certificate.evidence
        evidence.append(("solver", f"{solver.solver} {solver.version}, delta {number(solver.precision)}"))
        evidence += [(f"its answer to {name}", said) for name, said in solver.queries]
    elif answer is not None and status.accepted:
        leaves = f"{answer.get('leaves', 0):,}, of which {answer.get('ring_leaves', 0):,} in the ring"
        whole = is_local_enough(certificate)
        evidence.append(("leaves", "none needed: the local part covers the whole set" if whole else leaves))
    run: list[tuple[str, str]] = []
    if result is not None:
        if result.get("boxes"):
            run.append(("boxes examined", f"{result['boxes']:,}"))
        run += [(f"{k}", seconds(v)) for k, v in result["seconds"].items() if v is not None]
        asked = result.get("solver") or {}
        for q in asked.get("queries", []):
            about = f"{asked['solver']} {asked['version']} on {q['query']}, V <= {number(q['level'])}"
            run.append((about, f"{q['answer']}, {seconds(q['seconds'])}"))
    unit = volume_unit(state_units)
    candidates = [
        (
            row["candidate"],
            below(row["level"]),
            f"{below(row['volume'])} {unit}".rstrip(),
            "the domain" if row["limited_by"] == "domain" else "a violation found",
            f"{below(row['proved_volume'])} {unit}".rstrip() if row.get("proved_volume") else ABSENT,
            "this one" if row["proved"] else "",
        )
        for row in (result or {}).get("candidates", [])
    ]
    return {
        "levels": levels,
        "size": size_of_set,
        "estimated": _estimated(certificate, result) if is_ellipsoid(certificate) else "",
        "geometry": geometry,
        "reach": reach,
        "reach_heads": heads,
        "sets": "the set reaches" if len(heads) <= 2 else "each set reaches",
        "measure": volume_name(system.n),
        "evidence": evidence,
        "run": run,
        "candidates": candidates,
    }


def _outer_rows(beyond: Outer, answer: Mapping[str, Any] | None) -> list[tuple[str, str]]:
    """N, and on how many leaves the checker has looked at it."""
    N = beyond.function
    rows = [("N", network_name(N.widths)), ("sha256 of N", N.sha256())] if isinstance(N, Neural) else []
    found = (answer or {}).get("outer")
    if isinstance(found, Mapping):
        leaves = f"{found.get('leaves', 0):,}, and {found.get('face_leaves', 0):,} on the faces of the domain"
        rows.append(("leaves of the outer set", leaves))
    return rows


def _estimated(certificate: Certificate, result: Mapping[str, Any] | None) -> str:
    """The volume of the union with the outer set, as the run has it or from samples; nothing without one."""
    beyond, system = certificate.claim.outer, certificate.system
    if beyond is None:
        return ""
    found: Mapping[str, Any] = (result or {}).get("outer") or {}
    if found:
        size = float(found["volume"]), float(found["deviation"])
    else:
        N, n2, V, c2 = beyond.function, beyond.level, certificate.V, certificate.roa
        size = sampled_volume(lambda x: (N(x) <= n2) | (V(x) <= c2), system.domain)
    return estimated(*size, volume_unit([system.units.get(s.name, "") for s in system.states]))


def _lengths(certificate: Certificate, sets: Sequence[_Ellipsoid]) -> tuple[list[str], list[list[str]]]:
    """Heads and columns of how far the sets reach along the states: on the axes, rounded down, and at all, up.

    Where there are two sets, their sizes on the axes stand side by side, as shares of the domain too if both lie around
    the origin.
    """
    axes = [[below(float(v)) for v in semi_axes(each.P, each.level)] for each in sets]
    most = [[above(float(v)) for v in extents(each.P, each.level)] for each in sets]
    if len(sets) == 1:
        return ["on its axis, ±", "largest in the set, ±"], [*axes, *most]
    for column, each in zip(axes, sets, strict=True) if centre_of(certificate) is None else ():
        shares = _shares(certificate, semi_axes(each.P, each.level))
        column[:] = [f"{v} ({below(100 * q, 3)} %)" for v, q in zip(column, shares, strict=True)]
    heads = [f"{what} {each.name}, ±" for what in ("axis of", "largest in") for each in sets]
    return heads, [*axes, *most]


def _simulated(roa: SimulatedRoa, certificate: Certificate) -> dict[str, str]:
    timing = _timing(certificate)
    return {
        "fraction": ABSENT if np.isnan(roa.fraction) else f"{100 * roa.fraction:.1f} %",
        "grid": f" {TIMES} ".join(str(len(a)) for a in roa.axes),
        "attracted": f"{int(roa.attracted.sum()):,} of {roa.attracted.size:,}",
        "how": _integrated(roa, timing),
        "horizon": f"{number(roa.horizon, 3)} {timing.unit}",
        "undecided": f"{roa.undecided:,}",
        "left": f"{int(roa.left.sum()):,}",
        "contradictions": f"{roa.contradictions:,}" if roa.contradictions else "",
        "slow": f"{roa.slow:,}" if roa.slow else "",
        "of": volume_name(certificate.system.n),
        "who": words_for(certificate.kind).simulated,
    }


def _integrated(roa: SimulatedRoa, timing: Timing) -> str:
    """How the runs of a grid come about; {} stands for the values that are held."""
    step = f"step {number(roa.step, 3)} s"
    if timing.discrete:
        return "the loop's own steps{}"
    if timing.sample is not None:
        return f"Runge–Kutta of order four with the input held over {number(float(timing.sample[1]), 6)} s{{}}, {step}"
    return f"Runge–Kutta of order four on the continuous closed loop{{}}, {step}"


def _clip(certificate: Certificate) -> str:
    """Each input's limits, in its unit."""
    inputs, clip = certificate.system.inputs, certificate.network.clip or ()
    each = zip(inputs, *clip, strict=True)
    return ", ".join(f"{s.name} in [{number(float(lo), 10)}, {number(float(hi), 10)}]" for s, lo, hi in each)


def _read(certificate: Certificate) -> str:
    """What the layers of a policy read that is seen from elsewhere, in the states' units."""
    states, origin = certificate.system.states, certificate.network.origin.tolist()
    each = zip(states, origin, strict=True)
    return ", ".join(f"{number(v, 10)} + {symbol(s.name)}" if v else symbol(s.name) for s, v in each)


def _eigenvalues(certificate: Certificate) -> str:
    try:
        A, B, K = ClosedLoop(certificate.system, certificate.network).linearise()
    except CertifyError as error:
        return str(error)
    if certificate.system.sample is not None:
        A = _over_period(A + B @ K, B, K, float(certificate.system.sample[1]))
    return ", ".join(_complex(complex(v)) for v in sorted(np.linalg.eigvals(A), key=lambda v: (v.real, v.imag)))


def _over_period(A: NDArray[np.float64], B: NDArray[np.float64], K: NDArray[np.float64], h: float) -> Any:
    """What the linear loop x' = A x + B u makes of x over a period, u = -K x held: e^(A h) - int_0^h e^(A s) ds B K."""
    from scipy.linalg import expm

    n, m = B.shape
    both = expm(h * np.block([[A, B], [np.zeros((m, n + m))]]))
    return both[:n, :n] - both[:n, n:] @ K


def _complex(value: complex) -> str:
    if value.imag == 0:
        return number(value.real, 5)
    return f"{number(value.real, 5)} {'+' if value.imag > 0 else MINUS} {number(abs(value.imag), 5)}i"
