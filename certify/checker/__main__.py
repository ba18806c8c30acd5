"""`python -I -m certify.checker FILE [--json]`: check one certificate.

Exit status: 0 accepted, 1 rejected, 2 usage or unreadable file, 3 trusted (the evidence is a solver's word, which
cannot be checked; what can be was), 70 internal error.
"""

from __future__ import annotations

import json
import sys
from fractions import Fraction
from typing import Any

from . import document
from .errors import Rejected, Unreadable


def main(arguments: list[str]) -> int:
    """Print the claim and the verdict, or one JSON object; return the exit status."""
    as_json = "--json" in arguments
    paths = [a for a in arguments if a != "--json"]
    if len(paths) != 1 or paths[0].startswith("-"):
        sys.stderr.write("usage: python -m certify.checker FILE [--json]\n")
        return 2
    try:
        certificate = document.read(paths[0])
        from . import rules  # after parsing: a malformed file needs no tables

        tally = rules.check(certificate)
    except Unreadable as error:
        sys.stdout.write(json.dumps({"error": str(error)}) + "\n" if as_json else "")
        sys.stderr.write("" if as_json else f"{error}\n")
        return 2
    except Rejected as no:
        stated = {"result": "REJECTED", "rule": no.rule, "at": no.at, "detail": no.detail}
        sys.stdout.write((json.dumps(stated) if as_json else str(no)) + "\n")
        return 1
    except Exception as error:
        stated = {"error": f"internal error: {type(error).__name__}: {error}"}
        sys.stdout.write(json.dumps(stated) + "\n" if as_json else "")
        sys.stderr.write("" if as_json else stated["error"] + "\n")
        return 70
    about: dict[str, Any] = {
        "certificate_sha256": certificate.sha256,
        "policy_sha256": certificate.policy.sha256(),
        "levels": {"local": certificate.c1, "roa": certificate.c2},
    }
    if isinstance(certificate.evidence, document.Trusted):
        return _trusted(certificate, certificate.evidence, about, as_json)
    if as_json:
        accepted = {
            "result": "ACCEPTED",
            **about,
            "leaves": tally.leaves,
            "ring_leaves": tally.ring_leaves,
            "margins": {"local": tally.local_margin, "ring": tally.ring_margin},
        }
        sys.stdout.write(json.dumps(accepted) + "\n")
    else:
        sys.stdout.write("\n".join(_claim(certificate)) + "\n")
        ring = "" if tally.ring_margin is None else f"; smallest -Vdot bound {tally.ring_margin:.3g}"
        sys.stdout.write(
            f"checked: {tally.leaves} leaves, {tally.ring_leaves} of them in the ring{ring}; "
            f"local margin {tally.local_margin:.1%}\n"
        )
        sys.stdout.write(f"ACCEPTED c1={certificate.c1!r} c2={certificate.c2!r} sha256={certificate.sha256}\n")
    return 0


def _trusted(c: document.Certificate, evidence: document.Trusted, about: dict[str, Any], as_json: bool) -> int:
    answers = [f"{name}: {answer}" for name, answer in evidence.queries]
    if as_json:
        solver = {"solver": evidence.solver, "version": evidence.version, "answers": answers}
        sys.stdout.write(json.dumps({"result": "TRUSTED", **about, **solver}) + "\n")
    else:
        sys.stdout.write("\n".join([*_claim(c), "not checked, the solver's word: " + ", ".join(answers)]) + "\n")
        sys.stdout.write(f"TRUSTED {evidence.solver} {evidence.version} c1={c.c1!r} c2={c.c2!r} sha256={c.sha256}\n")
    return 3


def _claim(c: document.Certificate) -> list[str]:
    """The claim in words and numbers; what is printed is what was parsed."""
    widths = [c.policy.weights[0].shape[1], *(len(W) for W in c.policy.weights)]
    lines = [f"plant {c.name}: xdot = f(x, u), states ({', '.join(c.states)}), inputs ({', '.join(c.inputs)})"]
    lines += [f"  {name}' = {text}" for name, text in zip(c.states, c.dynamics.text, strict=True)]
    lines += [
        f"  domain {name} in [{_number(lo)}, {_number(hi)}]" for name, (lo, hi) in zip(c.states, c.domain, strict=True)
    ]
    lines += [
        f"  input {name} in [{_number(lo)}, {_number(hi)}], u_eq = {_number(u)}"
        for name, (lo, hi), u in zip(c.inputs, c.input_bounds, c.u_eq, strict=True)
    ]
    lines.append(
        f"policy {'-'.join(map(str, widths))} tanh, squash {c.policy.squash}, centred by {c.policy.centre}, "
        f"sha256 {c.policy.sha256()}"
    )
    lines.append("V(x) = x'Px with P = " + "; ".join(" ".join(repr(float(v)) for v in row) for row in c.P))
    lines.append(
        "claim: the origin is asymptotically stable, and every trajectory of the closed loop that starts in "
        f"V <= {c.c2!r} stays there and converges to the origin; u stays in its bounds"
    )
    return lines


def _number(q: Fraction) -> str:
    return str(q) if q.denominator == 1 or len(str(q)) > 40 else f"{q} (about {float(q):.6g})"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
