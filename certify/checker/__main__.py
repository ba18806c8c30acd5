"""`python -I -m certify.checker FILE [--json] [--arithmetic float64|arb]`: check one certificate.

Exit status: 0 accepted, 1 rejected, 2 usage or unreadable file, 3 trusted (the evidence is a solver's word, which
cannot be checked; what can be was), 70 internal error.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from fractions import Fraction
from typing import Any

from . import document
from .errors import Rejected, Unreadable


def main(arguments: list[str]) -> int:
    """Print the claim and the verdict, or one JSON object; return the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -I -m certify.checker", description="Check one certificate.", allow_abbrev=False
    )
    parser.add_argument("file", metavar="FILE")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--arithmetic", choices=("float64", "arb"), default="float64")
    try:
        options = parser.parse_args(arguments)
    except SystemExit as stop:
        return int(stop.code or 0)
    try:
        certificate = document.read(options.file)
        start = time.perf_counter()
        from . import rules  # after parsing: a malformed file needs no tables

        ready = time.perf_counter()
        tally = rules.check(certificate, options.arithmetic)
        seconds = {"start": ready - start, "check": time.perf_counter() - ready}
    except Unreadable as error:
        return _say(options.json, 2, {"error": str(error)}, [], str(error))
    except Rejected as no:
        stated = {"result": "REJECTED", "rule": no.rule, "at": no.at, "detail": no.detail}
        return _say(options.json, 1, stated, [str(no)])
    except Exception as error:
        detail = f"internal error: {type(error).__name__}: {error}"
        return _say(options.json, 70, {"error": detail}, [], detail)
    evidence, c1, c2 = certificate.evidence, certificate.c1, certificate.c2
    about: dict[str, Any] = {
        "certificate_sha256": certificate.sha256,
        "policy_sha256": certificate.policy.sha256(),
        "levels": {"local": c1, "roa": c2},
        "rules": tally.rules,
        "arithmetic": options.arithmetic,
        "seconds": seconds,
    }
    counts = ", ".join(f"{rule} {count}" for rule, count in tally.rules.items())
    lines = [*_claim(certificate), f"rules that held ({options.arithmetic}): {counts}"]
    if isinstance(evidence, document.Trusted):
        answers = [f"{name}: {answer}" for name, answer in evidence.queries]
        about |= {"solver": evidence.solver, "version": evidence.version, "answers": answers}
        lines.append("not checked, the solver's word: " + ", ".join(answers))
        lines.append(f"TRUSTED {evidence.solver} {evidence.version} c1={c1!r} c2={c2!r} sha256={certificate.sha256}")
        return _say(options.json, 3, {"result": "TRUSTED", **about}, lines)
    about |= {"leaves": tally.rules["tree"], "ring_leaves": tally.rules["ring"]}
    about["margins"] = {"local": tally.local_margin, "ring": tally.ring_margin}
    ring = "" if tally.ring_margin is None else f"; smallest bound of -Vdot on a ring's leaf {tally.ring_margin:.3g}"
    lines.append(f"margins: local {tally.local_margin:.1%}{ring}")
    lines.append(f"ACCEPTED c1={c1!r} c2={c2!r} sha256={certificate.sha256}")
    return _say(options.json, 0, {"result": "ACCEPTED", **about}, lines)


def _say(as_json: bool, status: int, stated: dict[str, Any], lines: list[str], complaint: str = "") -> int:
    """Print one JSON object, or lines and on stderr a complaint; return the status."""
    sys.stdout.write(json.dumps(stated) + "\n" if as_json else "".join(f"{line}\n" for line in lines))
    sys.stderr.write(f"{complaint}\n" if complaint and not as_json else "")
    return status


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
