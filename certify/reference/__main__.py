"""The command line: `python -I -m certify.reference FILE [--json] [--jobs N] [--seconds N]`.

The claim in words and the verdict. Exit status 0 accepted, 1 rejected, 2 usage or an unreadable file, 3 trusted,
70 an error of this program.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import stat
import sys
import time
from collections.abc import Sequence
from fractions import Fraction
from typing import Any

from flint import arb, fmpq

from .document import MAX_BYTES, Certificate, Data
from .evidence import INVARIANT, REMAINS, WITHOUT_V, Tree
from .rules import Verdict, judge

STATUS = {"ACCEPTED": 0, "REJECTED": 1, "TRUSTED": 3}
UNUSABLE, INTERNAL, MAX_JOBS = 2, 70, 256
MOST_BYTES, MAX_SECONDS = 2**33, 10**9


def read_once(path: str) -> bytes:
    """The bytes of a regular file, one more than are allowed at most; raises OSError."""
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))  # a pipe must not keep us waiting
    with os.fdopen(descriptor, "rb") as stream:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise OSError(0, "it is not a regular file")
        return stream.read(MAX_BYTES + 1)


def in_words(c: Certificate) -> str:
    if c.claim == INVARIANT:
        return of_staying(c) + kept(c)
    said = of_ranks(c) if c.claim in WITHOUT_V else of_trajectories(c) + further(c) + in_ranks(c)
    return said + kept(c) + measured(c) + sampled(c) + handed_over(c)


def of_trajectories(c: Certificate) -> str:
    """The statement about trajectories from {V <= c2}, and from the start of a tube that leads there."""
    bounds = f"{', '.join(c.plant.inputs)} within the input bounds{whatever(c)}"
    read = "" if not any(c.policy.origin) else f" read at ({', '.join(map(repr, c.policy.origin))}) + x"
    policy = f"policy {c.policy.sha256}{read}{stepping(c)}"
    head = f"{c.plant.name}, {policy}: every trajectory that starts in V <= {c.outer!r}"
    remains = "stays there" if c.sample is None else "at a sampling instant is there at every later one"
    between = "" if c.sample is None else ", is in the domain at all times"
    if c.floor is not None:
        enters = f"enters V <= {c.floor!r} in finite time and stays in that set from then on"
        at_last = "" if c.sample is None else " at sampling instants"
        return f"{head} {remains}{between}, {enters}{at_last}{falling(c)}, with {bounds}{nearby(c)}"
    stays = (
        f"{head} {remains}{between} and "
        f"converges to the origin, which is asymptotically stable{falling(c)}, with {bounds}"
    )
    if c.start is None:
        return stays
    around = "x'P_0 x" if c.centre is None else "(x - c_0)'P_0 (x - c_0)"
    centre = "" if c.centre is None else f"; c_0 = {centre_numbers(c)}"
    return (
        f"{stays}; and every trajectory that starts in {around} <= 1 reaches V <= {c.outer!r} after the sum of the "
        f"durations ({time_of_tube(c)}) at the latest, stays in the domain on the way, and converges to the origin, "
        f"with {bounds}; "
        f"P_0 = {start_rows(c)}{centre}"
    )


def further(c: Certificate) -> str:
    """The statement about the outer set of a second function."""
    N = c.beyond
    if N is None:
        return ""
    return (
        f"; and every trajectory that starts in the domain where N(x) <= {N.level!r}, N being the expression that the "
        f"certificate states, stays in the union of that set and V <= {c.outer!r}, enters V <= {c.outer!r} in finite "
        f"time, and is one of these from then on, with {', '.join(c.plant.inputs)} within the input bounds{whatever(c)}"
    )


def of_ranks(c: Certificate) -> str:
    """The statement of a claim without V."""
    either = ", a heaviside of 0 being 0 or 1 at each step anew" if c.plant.dynamics.jumps else ""
    head = f"{c.plant.name}, policy {c.policy.sha256}{stepping(c)}{either}: {from_leaves(c)}"
    if c.target is None:
        return f"{head}{on_the_way(c)}; nothing is said of where it goes among these boxes"
    return (
        f"{head} where each of the {len(c.target.results)} expressions that the certificate states as its target is at "
        f"most 0{on_the_way(c)}; nothing is said of what happens there"
    )


def of_staying(c: Certificate) -> str:
    """The statement of a claim that a set is never left."""
    level = None if c.beyond is None else c.beyond.level
    return (
        f"{c.plant.name}, policy {c.policy.sha256}: every trajectory that starts in the domain where N(x) <= {level!r}"
        ", N being the expression that the certificate states, exists at all times and stays in that set, in the "
        f"interior of the domain, with {', '.join(c.plant.inputs)} within the input bounds{whatever(c)}; nothing is "
        "said of where in it it goes"
    )


def in_ranks(c: Certificate) -> str:
    """The statement about ranks beside that about V."""
    if c.ranks is None:
        return ""
    place = ", as a place," if c.ranks.angles else ""
    return f"; and {from_leaves(c)} in V <= {c.outer!r}{on_the_way(c)}, and is{place} one of these from then on"


def from_leaves(c: Certificate) -> str:
    """The words for the starts and the time; where the trajectory is then follows, unless it is in boxes again."""
    most = 0 if c.ranks is None else c.ranks.steps
    after, when = ("steps", "") if c.plant.discrete else ("periods", " at a sampling instant")
    start = f"every trajectory that starts{when} in a box of the certificate's tree of ranks whose rank is r < 65535"
    if c.claim == REMAINS:
        return f"{start} exists at all times, is in such a box again after at most {most} {after}, and so on for ever"
    return f"{start} is, after r {after} at the latest ({most} at most),"


def on_the_way(c: Certificate) -> str:
    """The words for what holds until then, or always, and for places."""
    angles = () if c.ranks is None else c.ranks.angles
    others = [name for name in c.plant.states if name not in angles]
    places = f" (states that differ by multiples of 2 pi in {', '.join(angles)} being the same)" if angles else ""
    inside = f", and {', '.join(others)} inside the domain" if others else ""
    when = "at all times" if c.claim == REMAINS else "until then"
    return f"{places}, {when} with {', '.join(c.plant.inputs)} within the input bounds{inside}{whatever(c)}"


def kept(c: Certificate) -> str:
    """The words for constraints."""
    if c.keep is None:
        return ""
    until = ", until it is there" if c.target is not None else ""
    when = "at every step" if c.plant.discrete else "at all times"
    count = len(c.keep.results)
    return f"; and along each of these trajectories the {count} expressions of keep are negative {when}{until}"


def measured(c: Certificate) -> str:
    """The words for parameters whose ranges follow from measurements."""
    data = c.data
    if data is None:
        return ""
    priors = zip(data.parameters, data.priors, strict=True)
    constants = ", ".join(f"{name} in [{lo}, {hi}]" for name, (lo, hi) in priors)
    states = zip(c.plant.states, data.origin, data.noise, strict=True)
    around = ", ".join(f"{name}{'' if b == 0 else f' + {b}'} +- {e}" for name, b, e in states)
    when = "" if data.period is None else f", each over some time in [{data.period[0]}, {data.period[1]}]"
    return (
        f"; and of all constants {constants} none is consistent with the {data.steps} transitions in {len(data.runs)} "
        f"runs that the certificate states (sha256 of their file {data.sha256}; measured {around}{when}), unless it "
        f"lies in these ranges{turned(data)}"
    )


def turned(data: Data) -> str:
    """The words for quantities that are sums of parameters."""
    each = [
        f"{axis.name} = {short(axis.at)}"
        + "".join(f" + ({short(by)}) {p}" for by, p in zip(axis.by, data.parameters, strict=True))
        for axis in data.axes
    ]
    return f" with {', '.join(each)}, to six digits; the certificate states them exactly" if each else ""


def short(q: fmpq) -> str:
    """A number to six digits."""
    return str(arb(q).str(6, radius=False))


def sampled(c: Certificate) -> str:
    """The words for functions that nobody wrote down."""
    if c.samples is None:
        return ""
    each = []
    for f in c.samples.functions:
        where = ", ".join(f"{name} in [{lo}, {hi}]" for name, (lo, hi) in zip(f.variables, f.box, strict=True))
        d = range(len(f.variables))
        bends = ", ".join(
            f"{f.curvature[i][j]} by {f.variables[i]} and {f.variables[j]}" for i in d for j in d if i <= j
        )
        zero = ", is 0 at 0" if f.vanishes else ""
        each.append(
            f"{c.plant.states[f.state]}, of {', '.join(f.variables)} in {where}: continuous second derivatives of at "
            f"most {bends}, at points there values within {f.noise} of the {len(f.values)} that the certificate "
            f"states{zero}"
        )
    return (
        f"; and this holds, instead of for the equations alone, for all functions of these (samples said to be of a "
        f"file with sha256 {c.samples.sha256}): {'; '.join(each)}; of other functions nothing is said"
    )


def handed_over(c: Certificate) -> str:
    """The words for the certificate that takes over."""
    then = c.then
    if then is None:
        return ""
    right = "x+ = g(k, x, u)" if c.plant.discrete else "x' = g(t, x, u)"
    sampled = c.samples is not None or then.samples is not None
    also = " (those with functions of its samples are among them)" if sampled else ""
    return (
        f"; and of every plant {right} whose right side, at any time and wherever x and u are in domain and input "
        "bounds, is one that the equations of this certificate have, and also one that those of the next have (for "
        f"some of what is uncertain, what was measured being constant and consistent){also}, each of these "
        f"trajectories is, once in V <= {c.floor!r}, one from V <= {then.outer!r} of the next, which says: "
        f"{in_words(then)}"
    )


def stepping(c: Certificate) -> str:
    """The words for held inputs or discrete time; empty in continuous time."""
    if c.sample is not None:
        return f", its inputs held for any periods in [{c.sample[0]}, {c.sample[1]}]"
    return ", in discrete time" if c.plant.discrete else ""


def falling(c: Certificate) -> str:
    """The words for the rate at which V falls; it is a binary64 number and so printed exactly."""
    if c.rate == 0:
        return ""
    until = f" until V <= {c.floor!r}" if c.floor is not None else ""
    return f", V falling at least as exp(-2 lambda t){until}, lambda = {rate_of(c)!r}"


def nearby(c: Certificate) -> str:
    """The words for convergence to a nearby equilibrium, if that is claimed."""
    if c.claim != "nearby":
        return ""
    still = f" where {', '.join(c.plant.uncertain)} stays as it is" if c.plant.uncertain else ""
    inside = f"{still} there is exactly one equilibrium in V <= {c.floor!r}"
    return f"; and{inside}, to which every such trajectory converges"


def rate_of(c: Certificate) -> float:
    return int(c.rate.p) / int(c.rate.q)


def whatever(c: Certificate) -> str:
    """The uncertain quantities and their ranges, in words."""
    each = [f"{name} in [{lo}, {hi}]" for name, (lo, hi) in zip(c.plant.uncertain, c.plant.ranges, strict=True)]
    return f", whatever values these have at any time: {', '.join(each)}" if each else ""


def start_rows(c: Certificate) -> list[list[float]] | None:
    """P_0, whose numbers are binary64 and so exact here."""
    if c.start is None:  # a matrix of zeros is false
        return None
    return [[int(v.p) / int(v.q) for v in row] for row in c.start.tolist()]


def centre_numbers(c: Certificate) -> list[float] | None:
    """c_0, exactly as well."""
    return None if c.centre is None else [int(v.p) / int(v.q) for v in c.centre.entries()]


def time_of_tube(c: Certificate) -> float | None:
    """The sum of the durations, rounded upwards; None without a tube, and where no binary64 number is as large."""
    if c.start is None or not isinstance(c.evidence, Tree):
        return None
    exactly = sum((Fraction(slab.duration) for slab in c.evidence.tube), Fraction(0))
    try:
        nearest = float(exactly)
    except OverflowError:
        return None
    upwards = nearest if nearest >= exactly else math.nextafter(nearest, math.inf)
    return upwards if math.isfinite(upwards) else None


def level_names(c: Certificate) -> tuple[tuple[str, str, float], ...]:
    """Key in the file, letter, value; none without V."""
    if c.claim in WITHOUT_V:
        return ()
    least = () if c.floor is None else (("floor", "c0", c.floor),)
    return *least, ("local", "c1", c.inner), ("roa", "c2", c.outer)


def line(verdict: Verdict) -> str:
    sha256, c = verdict.certificate_sha256, verdict.certificate
    if c is None or verdict.result == "REJECTED":
        return f"REJECTED rule={verdict.rule} at={verdict.at}: {verdict.detail}"
    levels = "".join(f"{letter}={value!r} " for _, letter, value in level_names(c))
    return f"{verdict.result} {levels}sha256={sha256}" + (f": {verdict.detail}" if verdict.detail else "")


def as_json(verdict: Verdict, seconds: float) -> dict[str, Any]:
    c = verdict.certificate
    return {
        "result": verdict.result,
        "rule": verdict.rule,
        "at": verdict.at,
        "detail": verdict.detail,
        "claim": c and c.claim,
        "rate": c and rate_of(c),
        "sample": c and c.sample and [str(h) for h in c.sample],
        "discrete": c and c.plant.discrete,
        "certificate_sha256": verdict.certificate_sha256,
        "policy_sha256": c and c.policy.sha256,
        "origin": list(c.policy.origin) if c and any(c.policy.origin) else None,
        "levels": c and {key: value for key, _, value in level_names(c)},
        "start": c and start_rows(c),
        "centre": c and centre_numbers(c),
        **taken_over(c),
        "time": c and time_of_tube(c),
        "leaves": verdict.leaves,
        "seconds": {"check": seconds},
        "text": [*([in_words(c)] if c and verdict.result != "REJECTED" else []), line(verdict)],
    }


def taken_over(c: Certificate | None) -> dict[str, Any]:
    """The claim and the levels of the certificate that takes over; nothing where there is none."""
    if c is None or c.then is None:
        return {}
    return {"then": {"claim": c.then.claim, "levels": {key: value for key, _, value in level_names(c.then)}}}


def say(text: str) -> None:
    sys.stdout.buffer.write(text.encode("ascii", "backslashreplace") + b"\n")
    sys.stdout.flush()


class _Parser(argparse.ArgumentParser):
    """One object on standard output with `--json`, for a wrong command too."""

    json = False

    def error(self, message: str) -> Any:
        if self.json:
            say(json.dumps({"error": message}))
        else:
            sys.stderr.write(f"{self.format_usage()}{message}\n")
        self.exit(UNUSABLE)


def main(arguments: Sequence[str] | None = None) -> int:
    given = list(sys.argv[1:] if arguments is None else arguments)
    parser = _Parser(prog="python -I -m certify.reference", description="Check one certificate, a second time.")
    parser.json = "--json" in given
    parser.add_argument("file", metavar="FILE")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="examine the leaves in N processes")
    parser.add_argument("--seconds", type=int, metavar="N", help="end without a verdict after so long on the processor")
    options = parser.parse_args(given)
    if not 1 <= options.jobs <= MAX_JOBS:
        parser.error(f"argument --jobs: 1 to {MAX_JOBS} processes are allowed")
    if options.seconds is not None and not 1 <= options.seconds <= MAX_SECONDS:
        parser.error(f"argument --seconds: 1 to {MAX_SECONDS} seconds are allowed")

    if options.seconds is not None:
        from resource import RLIMIT_CPU, setrlimit

        setrlimit(RLIMIT_CPU, (options.seconds, options.seconds + 1))

    def failed(message: str, status: int) -> int:
        if options.json:
            say(json.dumps({"error": message}))
        else:
            sys.stderr.write(message.encode("ascii", "backslashreplace").decode() + "\n")
        return status

    start = time.perf_counter()
    try:
        raw = read_once(options.file)
    except (OSError, ValueError) as error:
        return failed(f"{options.file} cannot be read: {getattr(error, 'strerror', None) or error}", UNUSABLE)
    try:
        verdict = judge(raw, options.jobs)
    except MemoryError:
        return failed("this needs more memory than there is", INTERNAL)
    except Exception as error:  # whatever it is, it must not look like a verdict
        return failed(f"internal error of the reference: {type(error).__name__}: {error}", INTERNAL)
    seconds = time.perf_counter() - start
    if options.json:
        say(json.dumps(as_json(verdict, seconds)))
    else:
        if verdict.certificate is not None:
            say(f"claim: {in_words(verdict.certificate)}")
        say(line(verdict))
    return STATUS[verdict.result]


def bound_memory() -> None:
    """A few kilobytes may describe a loop that fills all memory; a system without this limit is left as it is."""
    try:
        from resource import RLIMIT_AS, getrlimit, setrlimit

        setrlimit(RLIMIT_AS, (MOST_BYTES, getrlimit(RLIMIT_AS)[1]))
    except (ImportError, OSError, ValueError):
        return


if __name__ == "__main__":
    bound_memory()
    sys.exit(main())
