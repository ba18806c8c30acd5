"""One self-contained HTML page for a certificate: figures inline, no script, nothing loaded from anywhere.

The page says that something was proved only if the checker's answer says ACCEPTED *and* is about this policy and
these levels. Every text that comes from a file passes through jinja2's escaping.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import sympy

from certify.certificate import Certificate
from certify.closed_loop import ClosedLoop
from certify.errors import CertifyError
from certify.lyapunov import domain_limit, extents, semi_axes, volume
from certify.report.figures import Picture, draw, is_ellipsoid
from certify.report.sampling import SimulatedRoa
from certify.report.summary import limit_in_words
from certify.report.words import (
    ABSENT,
    MINUS,
    TIMES,
    below,
    label,
    number,
    pretty_unit,
    seconds,
    symbol,
    units_of,
    volume_name,
    volume_unit,
)

_LONG = 10**6  # numerators and denominators beyond it are shown rounded


@dataclass(frozen=True, slots=True)
class Status:
    """What may be said of a certificate: kind is ACCEPTED, TRUSTED, REJECTED or NOT CHECKED; note says why."""

    kind: str
    note: str

    @property
    def accepted(self) -> bool:
        """Whether the page may speak of a proof."""
        return self.kind == "ACCEPTED"


def status_of(certificate: Certificate, answer: Mapping[str, Any] | None) -> Status:
    """The checker's answer, unless it is about something else than `certificate`."""
    if answer is None:
        return Status("NOT CHECKED", "The checker was not asked. Until it accepts the file, nothing here is proved.")
    if answer.get("result") == "REJECTED":
        where = f"rule {answer.get('rule', '?')} at {answer.get('at', '?')}"
        detail = f": {answer['detail']}" if answer.get("detail") else ""
        return Status("REJECTED", f"The checker refuses the certificate by {where}{detail}. Nothing here is proved.")
    if answer.get("result") == "TRUSTED":
        solver = f"{answer.get('solver')} {answer.get('version')}"
        return Status("TRUSTED", f"The checker checked what is exact (P, the domain, the equilibrium). That Vdot is "
                      f"negative is the word of {solver}, which nothing here can check.")  # fmt: skip
    if answer.get("result") != "ACCEPTED":
        return Status("NOT CHECKED", "The checker gave no verdict. Nothing here is proved.")
    levels = answer.get("levels")
    same_levels = isinstance(levels, Mapping) and (levels.get("local"), levels.get("roa")) == (
        certificate.inner, certificate.roa,
    )  # fmt: skip
    if answer.get("policy_sha256") != certificate.network.sha256() or not same_levels:
        return Status("NOT CHECKED", "The checker's answer is about another certificate. Nothing here is proved.")
    return Status("ACCEPTED", "The independent checker accepted the certificate.")


def render_html(
    certificate: Certificate,
    answer: Mapping[str, Any] | None,
    result: Mapping[str, Any] | None,
    certificate_path: Path,
) -> str:
    """The report as one HTML document.

    Parameters
    ----------
    certificate : what was read from `certificate_path`.
    answer : what `certify.roa.run_checker` returned; None if it was not run.
    result : `RoaResult.to_dict()` of the run that made the certificate; None if there is none.
    certificate_path : the file, for its name and its size.
    """
    import jinja2

    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True)
    source = resources.files("certify.report").joinpath("template.html").read_text(encoding="utf-8")
    status = status_of(certificate, answer)
    pictures: list[Picture] = []
    roa, trouble = None, ""
    try:
        pictures, roa = draw(certificate, status.accepted)
    except (CertifyError, np.linalg.LinAlgError, ValueError, ArithmeticError) as error:
        if status.accepted:
            raise
        trouble = f"There are no figures: {error}"  # a rejected file need not make sense
    page = environment.from_string(source).render(
        status=status,
        pictures=pictures,
        trouble=trouble,
        claim=_claim(certificate, answer if status.accepted else None),
        plant=_plant(certificate),
        tables=_tables(certificate, answer if status.accepted else None, result, certificate_path),
        matrix=[[repr(float(v)) for v in row] for row in certificate.P],
        roa=None if roa is None else _simulated(roa, certificate),
        provenance=sorted((str(k), str(v)) for k, v in certificate.provenance.items()),
        file=certificate_path.name,
        not_proved=_not_proved(certificate),
    )
    return str(page)


def _plant(certificate: Certificate) -> dict[str, Any]:
    system, units = certificate.system, units_of(certificate.system)
    expressions = system.exact_dynamics()

    def interval(name: str, bounds: tuple[Fraction, Fraction]) -> str:
        lo, hi = (number(float(v)) for v in bounds)
        return f"{symbol(name)} ∈ [{lo}, {hi}] {pretty_unit(units.get(name, ''))}".rstrip()

    return {
        "name": system.name,
        "equations": [_equation(s, e, system.states + system.inputs)
                      for s, e in zip(system.states, expressions, strict=True)],
        "rounded": any(_is_long(v) for e in expressions for v in e.atoms(sympy.Rational)),
        "domain": [interval(s.name, b) for s, b in zip(system.states, system.domain, strict=True)],
        "inputs": [interval(s.name, b) for s, b in zip(system.inputs, system.input_bounds, strict=True)],
        "u_eq": ", ".join(
            f"{symbol(s.name)} = {u}" for s, u in zip(system.inputs, system.exact_u_eq(), strict=True)
        ),
    }  # fmt: skip


def _equation(state: sympy.Symbol, expression: sympy.Expr, names: Sequence[sympy.Symbol]) -> Any:
    """`state' = expression` as MathML, which browsers typeset without help."""
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
    left = f"<mfrac><mrow><mi>d</mi>{_identifier(state.name)}</mrow><mrow><mi>d</mi><mi>t</mi></mrow></mfrac>"
    inner = text.removeprefix("<math>").removesuffix("</math>")
    return Markup(f'<math display="block">{left}<mo>=</mo>{inner}</math>')


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


def _claim(certificate: Certificate, answer: Mapping[str, Any] | None) -> dict[str, Any]:
    """The claim of DESIGN.md section 1 in words and numbers, and what the checker showed of each part."""
    system, units = certificate.system, units_of(certificate.system)
    drawable = is_ellipsoid(certificate)
    reach = extents(certificate.P, certificate.roa) if drawable else [math.nan] * system.n
    sides = [
        f"|{symbol(s.name)}| ≤ {_between(float(e), float(min(-lo, hi)))} < {number(float(min(-lo, hi)))}"
        + (f" {pretty_unit(units[s.name])}" if units.get(s.name) else "")
        for s, e, (lo, hi) in zip(system.states, reach, system.domain, strict=True)
    ]
    bounds = [
        f"{number(float(lo))} ≤ {symbol(s.name)} ≤ {number(float(hi))}"
        + (f" {pretty_unit(units[s.name])}" if units.get(s.name) else "")
        for s, (lo, hi) in zip(system.inputs, system.input_bounds, strict=True)
    ]
    margins = answer.get("margins", {}) if answer else {}
    local, ring = margins.get("local"), margins.get("ring")
    local_note = f"Margin of the linear part over the remainder: {number(100 * local, 3)} %." if local else ""
    ring_note = ""
    if answer:
        ring_note = f"Shown on {answer.get('ring_leaves', 0):,} of {answer.get('leaves', 0):,} leaves"
        ring_note += f"; the smallest bound on {MINUS}V̇ is {number(ring, 3)}." if ring is not None else "."
    return {
        "level": below(certificate.roa),
        "local": below(certificate.inner),
        "exact_level": repr(certificate.roa),
        "bounds": bounds,
        "parts": [
            ("Equations", "The closed loop is twice continuously differentiable on {V ≤ c₂}.", ""),
            ("Equilibrium", "P is symmetric positive definite and f(0, u_eq) = 0 exactly.", ""),
            ("Domain", "{V ≤ c₂} lies strictly inside the domain.", "; ".join(sides) + "." if drawable else ""),
            ("Local", "V̇(x) < 0 for all x with 0 < V(x) ≤ c₁, by the linearisation and a bound on its remainder "
             "that holds at all smaller radii: there is no hole around the origin.", local_note),
            ("Ring", "V̇(x) < 0 for all x with c₁ ≤ V(x) ≤ c₂, leaf by leaf of a partition that covers the set by "
             "construction.", ring_note),
            ("Inputs", "On {V ≤ c₂} the input stays in its bounds, so that an actuator that clips changes nothing.",
             "; ".join(bounds) + "."),
        ],
    }  # fmt: skip


def _between(value: float, limit: float) -> str:
    """`value` rounded up, with as many digits as keep it below `limit`."""
    for digits in range(6, 17):
        text = f"{value:.{digits}g}"
        if value <= float(text) < limit:
            return text
    return repr(value)


def _not_proved(certificate: Certificate) -> list[tuple[str, str]]:
    items = [
        ("Anything outside the set.", "The true region of attraction may be larger; a point outside {V ≤ c₂} may "
         "converge or not."),
        ("Any other plant.", "The claim is about the equations above with exactly these numbers: no other mass, no "
         "friction, flexibility or actuator lag that is not in them."),
        ("Disturbances.", "No wind, no sensor noise, no estimation error, no delay."),
        ("A sampled controller.", "u = π(x) acts in continuous time. An action that is held between samples is another "
         "closed loop."),
        ("Rounding in the controller.", "The policy is evaluated in exact real arithmetic on its binary64 numbers; an "
         "embedded float32 evaluation differs by its rounding errors."),
        ("Speed and cost.", "Trajectories converge; how fast, and at what cost, is not part of the claim."),
        ("Wrapped angles.", "States are real numbers: an angle of a full turn is not the origin."),
        ("Simulated figures.", "Trajectories, grids and the share of the simulated region of attraction are "
         "illustrations in floating point."),
    ]  # fmt: skip
    if certificate.system.n > 2:
        items.append(("The sections as wholes.", "A section shows two states with all others 0; the claim is about all "
                      "states together."))  # fmt: skip
    return items


def _tables(
    certificate: Certificate, answer: Mapping[str, Any] | None, result: Mapping[str, Any] | None, path: Path
) -> dict[str, Any]:
    system, P, network = certificate.system, certificate.P, certificate.network
    units = units_of(system)
    state_units = [units.get(s.name, "") for s in system.states]
    levels = [
        ("c₁, local", repr(certificate.inner)),
        ("c₂, enlarged", repr(certificate.roa)),
    ]
    geometry: list[tuple[str, str]] = []
    reach: list[tuple[str, str, str, str]] = []
    if is_ellipsoid(certificate):
        levels.append(("domain's limit", number(domain_limit(P, system.domain), 10)))
        unit = volume_unit(state_units)
        geometry.append((volume_name(system.n), f"{below(volume(P, certificate.roa))} {unit}".rstrip()))
        rows = zip(
            system.states, state_units, semi_axes(P, certificate.roa), extents(P, certificate.roa), system.domain,
            strict=True,
        )  # fmt: skip
        reach = [(label(s.name, unit), number(float(a)), number(float(e)),
                  f"[{number(float(lo))}, {number(float(hi))}]")
                 for s, unit, a, e, (lo, hi) in rows]  # fmt: skip
    if result is not None:
        levels.append(("limited by", limit_in_words(str(result["reason"]))))
        sampled = result["levels"].get("sampled_limit")
        if sampled is not None:
            levels.append(("lowest V of a violation found", number(sampled, 10)))
    if np.all(np.isfinite(P)):
        geometry.append(("eigenvalues of P", ", ".join(number(float(v)) for v in np.linalg.eigvalsh(P))))
    geometry.append(("eigenvalues of the closed loop", _eigenvalues(certificate)))
    evidence = [
        ("policy", f"{'-'.join(map(str, network.layers))} tanh, squash {network.squash}, centre {network.centre}"),
        ("policy sha256", network.sha256()),
    ]
    if answer:
        evidence.append(("certificate sha256", str(answer.get("certificate_sha256", ABSENT))))
        leaves = f"{answer.get('leaves', 0):,}, of which {answer.get('ring_leaves', 0):,} in the ring"
        evidence.append(("leaves", leaves))
    if path.is_file():
        evidence.append(("certificate size", f"{path.stat().st_size:,} bytes"))
    run: list[tuple[str, str]] = []
    if result is not None:
        if result.get("boxes"):
            run.append(("boxes examined", f"{result['boxes']:,}"))
        run += [(f"{k}", seconds(v)) for k, v in result["seconds"].items() if v is not None]
        solver = result.get("solver") or {}
        for q in solver.get("queries", []):
            about = f"{solver['solver']} {solver['version']} on {q['query']}, V <= {number(q['level'])}"
            run.append((about, f"{q['answer']}, {seconds(q['seconds'])}"))
    candidates = [
        (row["candidate"], number(row["level"]), f"{below(row['volume'])} {volume_unit(state_units)}".rstrip(),
         "the domain" if row["limited_by"] == "domain" else "a violation found",
         "the one proved here" if row["proved"] else "")
        for row in (result or {}).get("candidates", [])
    ]  # fmt: skip
    tables = {"levels": levels, "geometry": geometry, "reach": reach, "evidence": evidence, "run": run}
    return {**tables, "candidates": candidates}


def _simulated(roa: SimulatedRoa, certificate: Certificate) -> dict[str, str]:
    return {
        "fraction": ABSENT if np.isnan(roa.fraction) else f"{100 * roa.fraction:.1f} %",
        "grid": f" {TIMES} ".join(str(len(a)) for a in roa.axes),
        "attracted": f"{int(roa.attracted.sum()):,} of {roa.attracted.size:,}",
        "step": f"{number(roa.step, 3)} s",
        "horizon": f"{number(roa.horizon, 3)} s",
        "undecided": f"{roa.undecided:,}",
        "contradictions": f"{roa.contradictions:,}" if roa.contradictions else "",
        "of": volume_name(certificate.system.n),
    }


def _eigenvalues(certificate: Certificate) -> str:
    try:
        A, _, _ = ClosedLoop(certificate.system, certificate.network).linearise()
    except CertifyError as error:
        return str(error)
    return ", ".join(_complex(complex(v)) for v in sorted(np.linalg.eigvals(A), key=lambda v: (v.real, v.imag)))


def _complex(value: complex) -> str:
    if value.imag == 0:
        return number(value.real, 5)
    return f"{number(value.real, 5)} {'+' if value.imag > 0 else MINUS} {number(abs(value.imag), 5)}i"
