"""A result in a few rows, as Python and notebooks show it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from certify.certificates.verdict import Verdict
from certify.report.measured import Measured
from certify.report.sampled import Sampled
from certify.report.timing import TimingInWords
from certify.report.words import below, estimated, share_of_runs, varying, varying_in, volume_name, volume_unit

if TYPE_CHECKING:
    from certify.analysis.results import RoaResult


def in_one_line(result: RoaResult) -> str:
    """The most important of the rows, for `repr`."""
    said = dict(stated(result))
    verdict = said["verdict"] if result.claim == "asymptotic" else f"{said['verdict']} {result.claim}"
    shown = [verdict, *(said[name] for name in ("plant", "in time", "set") if name in said)]
    shown += [
        f"{name} {said[name]}"
        for name in ("rate", "length", "area", "volume", "with N", "with boxes", "kept", "limited by", "reason")
        if name in said
    ]
    return "; ".join(shown)


def stated(result: RoaResult) -> list[tuple[str, str]]:
    """The rows, names and values."""
    rows = [("verdict", result.verdict.value), ("plant", result.system.name), ("claim", result.claim)]
    data, found = Measured.of(result.system), list(varying_in(result.system))
    sampled = Sampled.of(result.system)
    if sampled is not None:
        rows.append(("for every", sampled.consistent))
        found = sampled.others(found)
    if data is not None:
        rows.append(("for every", f"constant {data.in_priors} {data.consistent}"))
        found = data.others(found)
    if found:
        rows.append(("for every" if data is None and sampled is None else "and every", varying(found)))
    timing = TimingInWords.of(result.system, result.timing.rate)
    if not timing.is_plain:
        rows.append(("in time", "by steps" if timing.discrete else f"input held over {timing.periods}"))
    if timing.rate:
        rows.append(("rate", timing.shown_rate))
    shown = result.verdict in (Verdict.PROVED, Verdict.TRUSTED)
    level, size = (result.levels.roa, result.volume) if shown else (None, None)
    if level is not None and size is not None:
        unit = volume_unit([result.system.units.get(s.name, "") for s in result.system.states])
        wider = "" if result.tube is None else ", enlarged by a tube" if result.tube.centre is None else ", and a tube"
        if result.outer is not None:
            wider = f", and N <= {below(result.outer.level)} in the domain"
        rows.append(("set", f"V <= {below(level)}{wider}"))
        rows.append((volume_name(result.system.n), f"{below(size)} {unit}".rstrip()))
        if result.ranks is not None:
            ranks, steps = result.ranks, "steps" if result.system.sample is None else "sampling instants"
            rows[-1] = (rows[-1][0], f"{rows[-1][1]}, of V <= {below(level)}")
            size_of_boxes = f"{volume_name(result.system.n)} {below(ranks.volume)} {unit}".rstrip()
            rows.append(
                (
                    "with boxes",
                    f"{size_of_boxes}, {below(100 * ranks.covered, 4)} % of what was cut, "
                    f"at most {ranks.steps:,} {steps} away",
                )
            )
        if result.constraints:
            rows.append(("kept", "; ".join(result.constraints.values())))
        if result.outer is not None:
            rows[-1] = (rows[-1][0], f"{rows[-1][1]}, of V <= {below(level)}")
            rows.append(("with N", estimated(result.outer.volume, result.outer.deviation, unit)))
        if result.simulated is not None and result.simulated.share is not None:
            rows.append(("simulated", share_of_runs(result.simulated.to_dict())))
        rows.append(("limited by", result.reason))
    else:
        rows.append(("reason", result.reason))
    rows += [("certificate", str(result.certificate))] if result.certificate is not None else []
    return rows + [("notice", text) for text in (result.notice, *result.notices) if text is not None]
