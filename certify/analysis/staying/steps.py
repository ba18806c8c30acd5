"""The proof where time goes in steps: boxes that are never left, looked for in the whole domain."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.analysis.beyond import constraints_in_words, rank_facts
from certify.analysis.facts import StayingFacts
from certify.analysis.options import RoaOptions
from certify.analysis.reaching.runs import ends_of_runs
from certify.analysis.staying.results import InvariantResult
from certify.analysis.without_v import Tools, accepted, require_periodic
from certify.certificates import RanksAlone, RankTree, RemainCertificate, leaves_within
from certify.certificates.claims import Ranks, Remains
from certify.certificates.membership import region_of
from certify.certificates.verdict import Verdict
from certify.effort import Effort
from certify.errors import OptionError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.plants import System, kept_constraints
from certify.provers.base import Progress
from certify.provers.execution import ThreadRunner
from certify.provers.ranks import Nothing, Question, prove_remaining, root_box, turning, with_frame, with_order

Array = NDArray[np.float64]
_FOR_SEARCH = 0.7  # share of the effort, the rest being for the check
_OF_RUNS = 1e10  # operations for simulated runs, a few seconds, which no effort is charged with
_LITTLE = 1e-4  # error of a step that does no harm, as a share of the root box
_PROBES, _RUNS, _STEPS = 30, 500, 500  # states at which the series is chosen; simulated states, and their steps
_MENDED = 20  # leaves that the checker may refuse


def proved_in_steps(
    result: InvariantResult,
    loop: ClosedLoop,
    effort: Effort,
    tools: Tools,
    path: Path,
    provenance: Mapping[str, Any],
) -> InvariantResult:
    """The result of the search for boxes, and of the check of what it finds.

    Raises
    ------
    OptionError : an option is about a function N, of which there is none.
    """
    options, system = result.options, loop.system
    _require_no_function(options)
    root = root_box(loop)
    with tools.timing("simulate"):
        begins = np.random.default_rng(0).uniform(*root, (_RUNS, system.n))
        ends, count = ends_of_runs(loop, begins, _STEPS, Effort(_OF_RUNS))
    search = effort.share(_FOR_SEARCH)

    def report(share: float, boxes: int, waiting: int) -> None:
        tools.tell("set", Progress(0.0, 0.0, boxes, waiting, share, search.left))

    with tools.timing("search"):
        seeds = ends[np.isfinite(ends).all(-1)].T
        x = (seeds if seeds.size else begins.T)[:, :_PROBES]
        question = Question(loop, Nothing(), tuple(kept_constraints(system).values()), root)
        question = with_frame(with_order(question, x, search, _LITTLE), x, search)

    def certificate_of(leaves: RankTree, ranks: Ranks) -> RemainCertificate:
        claim = Remains(ranks, question.keep)
        return RemainCertificate(system, loop.network, claim, RanksAlone(leaves, question.order), provenance)

    clerk = tools.clerk(path, options.jobs, True)
    require_periodic(system, tuple(system.states[i].name for i in turning(loop)), root, certificate_of, clerk)
    with tools.timing("search"):
        found = prove_remaining(question, seeds, search, ThreadRunner(), report)
    if found is None:
        return replace(result, reason=_nothing(search.over), following=_following(options, system, search.over))
    proof, without = found

    def mended(_: RemainCertificate, at: str) -> RemainCertificate | None:
        refused = re.fullmatch(r"rank leaf (\d+)", at)
        left = None if refused is None else without(int(refused[1]))
        return None if left is None else certificate_of(*left)

    certificate = certificate_of(proof.evidence, proof.ranks)
    certificate, raw, answer = accepted(certificate, clerk, mended, _MENDED)
    return replace(
        result,
        verdict=Verdict.PROVED,
        reason="done" if proof.done else "effort",
        ranks=rank_facts(certificate, proof),
        simulated=_simulated(certificate, begins, ends, count),
        state=_state_in(certificate),
        boxes=proof.boxes,
        constraints=constraints_in_words(certificate),
        following=() if proof.done or proof.full else (f"--effort {4 * options.effort:g}",),
        certificate=path,
        raw=raw,
        checker=answer,
    )


def _require_no_function(options: RoaOptions) -> None:
    given = {"lyapunov": options.lyapunov, "lyapunov_level": options.lyapunov_level, "candidate": options.learned}
    for name, value in given.items():
        if value is not None:
            raise OptionError(
                f"`{name}` is about a set {{N <= n2}}; where time goes in steps boxes are proved to be never left, "
                "without a function: leave it out."
            )


def _following(options: RoaOptions, system: System, over: bool) -> tuple[str, ...]:
    """Options that may help where nothing is proved."""
    if over:
        return (f"--effort {4 * options.effort:g}", "a smaller --domain")
    return ("another --domain", *(() if system.sample is None else ("a shorter --sample-time",)))


def _nothing(over: bool) -> str:
    """The reason why there is nothing."""
    left = "the effort is over" if over else "no box is left whose halves could be"
    return f"no box of the domain is proved to be never left: {left}"


def _simulated(certificate: RemainCertificate, begins: Array, ends: Array, steps: int) -> StayingFacts:
    """The counts of simulated runs, of those that stay, and of these that start in the boxes."""
    staying = np.isfinite(ends).all(-1)
    held = region_of(certificate).holds_in_floats(begins)
    return StayingFacts(len(begins), steps, int(staying.sum()), int((staying & held).sum()))


def _state_in(certificate: RemainCertificate) -> dict[str, float]:
    """The values of a state in the set: the middle of its largest box."""
    leaves, system = certificate.evidence.ranks, certificate.system
    lower, upper = leaves_within(leaves.tree, leaves.lo, leaves.hi)
    sizes = np.where(leaves.proved, ((upper - lower) / (leaves.hi - leaves.lo)).prod(1), -1.0)
    middle = (0.5 * lower + 0.5 * upper)[int(sizes.argmax())]
    each = zip(system.states, middle.tolist(), system.exact_x_eq(), strict=True)
    return {s.name: float(Fraction(v) + q) for s, v, q in each}
