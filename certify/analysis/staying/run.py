"""`certify_invariant`: learn N unless it is given, prove a set {N <= n2} that is never left, have it accepted; where
time goes in steps the set is one of boxes (steps.py).

Nothing is PROVED before the checker, run as a process of its own, has accepted the very bytes that were written.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from certify.analysis.beyond import constraints_in_words, with_hazard
from certify.analysis.facts import OuterFacts
from certify.analysis.options import RoaOptions
from certify.analysis.stages.state import Report, effort_of
from certify.analysis.staying.results import InvariantResult
from certify.analysis.staying.steps import proved_in_steps
from certify.analysis.without_v import Tools, accepted
from certify.certificates import InvariantCertificate, earlier_aside, require_within_limits, sole_writer
from certify.certificates.claims import Invariant, Outer
from certify.certificates.verdict import Verdict
from certify.effort import Effort
from certify.errors import OptionError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.composition import composed
from certify.loop.plants import System, kept_constraints
from certify.loop.policies import PolicyNetwork
from certify.lyapunov import Neural, Polynomial, Symbolic, of_polynomial, sampled_volume
from certify.lyapunov.sublevel import Sublevel
from certify.provers.base import Budget
from certify.provers.execution import ThreadRunner
from certify.provers.outer import Nothing, StayProof, prove_staying, split_face_of, split_staying

_FOR_LEARNING, _FOR_SEARCH = 0.5, 0.8  # shares of the effort that is left, the rest being for what follows
_MENDED = 6  # leaves that the checker may refuse
_SAMPLES = 200_000  # states among which one of the set is looked for


def certify_invariant(
    system: System,
    network: PolicyNetwork,
    out: Path,
    options: RoaOptions,
    *,
    load_seconds: float = 0.0,
    provenance: Mapping[str, Any] | None = None,
    progress: Report | None = None,
    tell: Callable[[str], None] | None = None,
) -> InvariantResult:
    """Prove that a set {N <= n2} of the domain is never left, or where time goes in steps one of boxes; no equilibrium
    is needed.

    Parameters
    ----------
    system, network : the closed loop.
    out : folder for `certificate.json`; it is made if it is not there.
    options : with the claim `invariant`; N is `lyapunov`, or learned as `candidate` says, by default a network.
    load_seconds : time already spent on reading, for the report.
    provenance : entries for the certificate that the checker ignores.
    progress : called with the stage and where it stands.
    tell : told where an earlier run's certificate is kept, if this run ends without one.

    Raises
    ------
    InputError : the closed loop or an option cannot be used, or `out` cannot be written or is another run's.
    SoundnessError : the checker rejects what was proved.
    """
    from certify.provers.execution.threads import one_thread

    start, tools = time.perf_counter(), Tools(progress)
    system, network = composed(system, network)
    loop = ClosedLoop(system, network)
    require_within_limits(system, network)
    if (system.measurements and system.measurements.runs) or (system.samples and system.samples.taken):
        raise OptionError(
            "`claim` invariant must be for ranges as they stand: no such claim has measurements yet; leave out `data`."
        )
    effort = effort_of(options.effort, options.time_limit, load_seconds)
    with one_thread(), sole_writer(out), earlier_aside(out, tell or (lambda _: None)):
        result = InvariantResult(Verdict.UNKNOWN, "", system, network, options)
        prove = proved_in_steps if system.in_steps else _proved
        result = prove(result, loop, effort, tools, out / "certificate.json", provenance or {})
    seconds = {"load": load_seconds, **tools.seconds, "total": load_seconds + time.perf_counter() - start}
    return replace(result, seconds=seconds, notice=tools.notice(system))


def _proved(
    result: InvariantResult,
    loop: ClosedLoop,
    effort: Effort,
    tools: Tools,
    path: Path,
    provenance: Mapping[str, Any],
) -> InvariantResult:
    """The result of learning and search, and of the check of what they find."""
    options, system, keep = result.options, loop.system, tuple(kept_constraints(loop.system).values())
    N, learned = _function(loop, options, effort, tools)
    result = replace(result, learned=learned)
    with tools.timing("search"):
        tools.tell("set")
        budget = Budget(effort.share(_FOR_SEARCH), options.max_boxes)
        found = prove_staying(
            loop, keep, N, options.lyapunov_level, budget, ThreadRunner(), lambda state: tools.tell("set", state)
        )
    if isinstance(found, Nothing):
        return replace(result, reason=found.why, following=_following(options, effort.over))
    shown = _state_in(found.outer, system)
    if shown is None:
        why = f"no state of the domain was found that certainly has N <= {found.outer.level:.6g}"
        return replace(result, reason=why, boxes=found.boxes, following=_following(options, False))
    certificate = InvariantCertificate(system, loop.network, Invariant(found.outer, keep), found.evidence, provenance)
    certificate, raw, answer = accepted(
        certificate, tools.clerk(path, options.jobs, False), partial(_split, loop), _MENDED
    )
    return replace(
        result,
        verdict=Verdict.PROVED,
        reason="requested" if options.lyapunov_level is not None else "done",
        outer=_facts(found, system),
        state=shown,
        boxes=found.boxes,
        constraints=constraints_in_words(certificate),
        certificate=path,
        raw=raw,
        checker=answer,
    )


def _function(loop: ClosedLoop, options: RoaOptions, effort: Effort, tools: Tools) -> tuple[Neural | Symbolic, str]:
    """N, and how it was learned, in words; empty if it is given."""
    given, states = options.lyapunov, loop.system.states
    if given is not None:
        if given.n != loop.system.n:
            raise OptionError(f"`lyapunov` must be a function of {loop.system.n} states; found one of {given.n}.")
        return of_polynomial(given, states) if isinstance(given, Polynomial) else given, ""
    from certify.lyapunov.learning import Network, Terms, learn_staying

    terms = options.learned == "polynomial"
    model = Terms(loop.system.n, options.degree) if terms else Network(loop.system.n, options.hidden)
    with tools.timing("learn"):
        tools.tell("function")
        learned = learn_staying(
            loop, model, options.seed, effort.share(_FOR_LEARNING), lambda _: tools.tell("function")
        )
    N = learned.function
    said = f"in {len(learned.history)} rounds; {learned.cover:.1%} of the sampled states whose runs stay lie below"
    if isinstance(N, Polynomial):
        return of_polynomial(N, states), f"a polynomial of degree {N.degree}, {said}"
    return N, f"a network {'-'.join(map(str, N.widths))}, {said}"


def _following(options: RoaOptions, over: bool) -> tuple[str, ...]:
    """Options that may help, the first before the others."""
    found = [f"--effort {4 * options.effort:g}"] if over else []
    if options.lyapunov_level is not None:
        found.append("leave out --lyapunov-level")
    if options.lyapunov is not None:
        return (*found, "--candidate polynomial", "another --lyapunov")
    if options.learned == "polynomial":
        more = [f"--degree {options.degree + 2}"] if options.degree < 10 else []
        return (*found, *more, "--candidate neural", "another --domain, which the set may not touch")
    wider = f"--hidden {','.join(str(2 * width) for width in options.hidden)}"
    return (*found, wider, "another --seed", "another --domain, which the set may not touch")


def _state_in(outer: Outer, system: System) -> dict[str, float] | None:
    """The values of a state that certainly lies in the set; None if none is found."""
    lo, hi = np.array([[float(end) for end in pair] for pair in system.domain]).T
    x = np.random.default_rng(0).uniform(lo, hi, (_SAMPLES, system.n))
    with np.errstate(all="ignore"):
        value = np.nan_to_num(outer.function(x), nan=np.inf)
    least = x[int(value.argmin())]
    if not Sublevel(outer.function, outer.level, tuple(system.domain)).holds([least.tolist()])[0]:
        return None
    each = zip(system.states, least.tolist(), system.exact_x_eq(), strict=True)
    return {s.name: float(Fraction(v) + q) for s, v, q in each}


def _facts(found: StayProof, system: System) -> OuterFacts:
    """The facts on the set; its volume is estimated from samples."""
    outer, hazard = found.outer, found.hazard
    held = sampled_volume(lambda x: outer.function(x) <= outer.level, system.domain)
    limit = "domain" if hazard is None else "witness"
    return with_hazard(OuterFacts(outer.function, outer.level, *held, limit, found.boxes, found.leaves), hazard)


def _split(loop: ClosedLoop, certificate: InvariantCertificate, at: str) -> InvariantCertificate | None:
    """The certificate with the leaf split again that the checker refuses."""
    claim, evidence = certificate.claim, certificate.evidence
    leaf, face = re.fullmatch(r"outer leaf (\d+)", at), re.fullmatch(r"face (\d+) leaf (\d+)", at)
    if leaf is not None:
        return replace(certificate, evidence=split_staying(loop, claim, evidence, int(leaf[1])))
    if face is not None:
        split = split_face_of(loop.system, claim.outer, evidence, int(face[1]), int(face[2]))
        return replace(certificate, evidence=split)
    return None
