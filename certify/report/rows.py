"""The rows of the terminal's summary: names and values, from the object that `certify roa --json` prints."""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction
from typing import Any
from unicodedata import normalize

from certify.certificates.timing import reach_time
from certify.report.claims import Additions, Words, words_for
from certify.report.limits import AT_A_POINT, hardest, limited_by, outer_limited_by
from certify.report.measured import Measured
from certify.report.sampled import Sampled
from certify.report.timing import TimingInWords
from certify.report.words import (
    ABSENT,
    PRACTICAL,
    Varying,
    above,
    at_rest,
    below,
    distinguished,
    estimated,
    inner_level,
    modes,
    network_name,
    nonlinearity_in_words,
    number,
    place,
    point,
    pretty_unit,
    quantity,
    seconds,
    share_of_runs,
    shortest,
    state_or_box,
    symbol,
    volume_name,
    volume_unit,
)

STAGES = (
    "load",
    "data",
    "candidate",
    "local",
    "ring",
    "tube",
    "simulate",
    "learn",
    "outer",
    "ranks",
    "write",
    "check",
    "report",
)
_LONG = 200  # characters of an expression, beyond which it is not shown


def rows_of(result: Mapping[str, Any], shown: bool) -> list[tuple[str, str]]:
    """The rows, names and values; `shown` says that there is a set."""
    rows = [*_claim_rows(result, shown), *_level_rows(result), *_set_rows(result, shown)]
    if len(result.get("candidates", [])) > 1:
        rows.append(_candidates(result))
    if result.get("operating_point"):
        rows.append(_operating_point(result))
    if result.get("rest"):
        rows.append(_rest(result))
    return [*rows, *_diagnosis_rows(result), *_policy_rows(result), *_work_rows(result, shown)]


def _claim_rows(result: Mapping[str, Any], shown: bool) -> list[tuple[str, str]]:
    """The functions of time and the periods that the claim is for, its rate, and what limits it."""
    rows, found, timing = [], uncertain_of(result), TimingInWords.of_result(result)
    data, what = Measured.of_result(result), "for every" if shown else "asked for every"
    sampled = Sampled.of_result(result)
    if sampled is not None:
        rows += [(what, sampled.consistent), ("consistent", sampled.assumed)]
        found = sampled.others(found)
    if data is not None:
        rows += [(what, f"constant {data.in_priors} {data.consistent}"), ("consistent", data.assumed)]
        rows.append(("data leave", data.in_ranges))
        found = data.others(found)
    if found:
        each = "; ".join(q.words for q in found)
        first = what if data is None and sampled is None else "and every"
        rows.append((first, f"{each}: {_functions(timing)}"))
    if timing.sample is not None:
        rows.append(("input held over" if shown else "asked to hold", timing.periods))
    if shown:
        rows.append(("limited by", limited_by(result)))
        if (result.get("diagnosis") or {}).get("kind") in AT_A_POINT:
            rows.append(("namely", str(result["diagnosis"]["binds"])))
    else:
        rows.append(("reason", str(result["reason"])))
    if timing.rate:
        asked = f"asked for {shortest(timing.rate)} {timing.per_time}"
        rows.append(("rate", _rate(result, timing) if shown else asked))
    return rows


def _level_rows(result: Mapping[str, Any]) -> list[tuple[str, str]]:
    levels, words, inner, local = result["levels"], words_of(result), inner_of(result), _local(result)
    known = [
        (
            f"{words.inner_word} {normalize('NFKC', words.inner)}",
            "" if inner is None else inner_level(kind_of(result), inner),
        ),
        ("local c1", _level(local) if local != inner else ""),
        ("proved c2", _level(levels.get("roa"))),
        ("the domain's boundary at", _level(levels.get("domain_limit"))),
        ("the lowest violation found at", _level(levels.get("sampled_limit"))),
    ]
    stated = ", ".join(f"{name} {text}" for name, text in known if text)
    return [("levels of V", stated)] if stated else []


def _local(result: Mapping[str, Any]) -> float | None:
    """c1 of a practical claim; the inner level of any other is c1 itself."""
    return result["levels"].get("local") if kind_of(result) in PRACTICAL else None


def _set_rows(result: Mapping[str, Any], shown: bool) -> list[tuple[str, str]]:
    """The state that was asked about, the tube, the outer set, and the size."""
    rows, units = [], state_units(result)
    if result.get("reach_from"):
        asked = _asked(result)
        shape = state_or_box(result["reach_from"])
        rows.append((shape, f"{asked}, which lies in {{V <= c2}}" if shown and not result.get("tube") else asked))
    if result.get("tube"):
        rows.append(("tube", _tube(result)))
    if result.get("outer"):
        rows += _outer(result["outer"])
    if result.get("ranks"):
        rows += _ranks(result)
    if result.get("constraints"):
        rows.append(("kept" if shown else "asked to keep", "; ".join(_constraints(result["constraints"]))))
    if result.get("volume") is not None:
        unit = volume_unit(units)
        size = f"{below(result['volume'])} {unit}".rstrip()
        rows.append((volume_name(len(units)), size + of_which(result)))
        if result.get("outer"):
            union = estimated(result["outer"]["volume"], result["outer"]["deviation"], unit)
            rows.append(("with outer set", union))
    return [*rows, *_simulated(result)]


def _simulated(result: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The proved share of what converges in simulation, of drawn states."""
    found = result.get("simulated") or {}
    if not found or found["share"] is None:
        return []
    return [("simulated", f"{share_of_runs(found)}; this is no part of the proof")]


def _candidates(result: Mapping[str, Any]) -> tuple[str, str]:
    named = distinguished([c["candidate"] for c in result["candidates"]])
    tried = [
        f"{name}: {below(c.get('proved_volume') or 0.0, 3)} of {number(c['volume'], 3)}"
        for name, c in zip(named, result["candidates"], strict=True)
    ]
    sizes = f"{'; '.join(tried)} {volume_unit(state_units(result))}".rstrip()
    return "candidates", f"{sizes} (volume proved, of what sampling allows)"


def _operating_point(result: Mapping[str, Any]) -> tuple[str, str]:
    names, at = state_names(result), result["operating_point"]
    where = at_rest(names, [Fraction(at.get(name, 0)) for name in names], state_units(result))
    rests = ", the loop's equilibrium" if (result.get("rest") or {}).get("origin") else ""
    return "operating point", f"{where}{rests}; the set lies around it, and its lengths are deviations from it"


def _policy_rows(result: Mapping[str, Any]) -> list[tuple[str, str]]:
    policy = result["policy"]
    rows = [("policy", policy["words"]), ("its sha256", begun(str(policy["sha256"])))]
    if result.get("nonlinearity"):
        rows.append(("linear part", nonlinearity_in_words(result["nonlinearity"])))
    if result.get("eigenvalues"):
        held = " (at the nominal values)" if result.get("uncertain") else ""
        rows.append(("eigenvalues", ", ".join(map(str, result["eigenvalues"])) + held))
    return rows


def begun(sha256: str) -> str:
    """The first digits of a hash, which stay on one line of a terminal; `--json` and `certify check` have all."""
    return f"{sha256[:16]}…"


def _work_rows(result: Mapping[str, Any], shown: bool) -> list[tuple[str, str]]:
    """Boxes, dReal's answers, times, and what the checker said."""
    rows, levels = [], result["levels"]
    whole = levels.get("local") if kind_of(result) not in PRACTICAL or _local(result) != inner_of(result) else None
    if shown and whole is not None and whole == levels.get("roa"):
        rows.append(("work", f"{result['boxes']:,} boxes; the local part covers the whole set and no leaf is needed"))
    elif result.get("boxes"):
        rows.append(("work", f"{result['boxes']:,} boxes, {result['leaves']:,} leaves"))
    solver = result.get("solver") or {}
    if "missing" in solver:
        rows.append(("dReal", f"not asked: {solver['missing']}"))
    elif solver:
        answers = [q["answer"] for q in solver["queries"]]
        rows.append(("dReal", f"{answers.count('unsat')} of {len(answers)} queries unsat, version {solver['version']}"))
    rows.append(("time", _times(result["seconds"])))
    about = ""
    if is_missed(result):
        beyond = result.get("stop") == "beyond"
        shape = state_or_box(result.get("reach_from") or {})
        about = ", about a smaller set" if beyond else f", about {{V <= c2}} alone, in which the {shape} does not lie"
    both = " BY BOTH" if result["checked"] == result.get("reference") == "ACCEPTED" else ""
    rows.append(("checker", f"{result['checked'] or 'not reached'}{both}{about}"))
    return rows


def _rest(result: Mapping[str, Any]) -> tuple[str, str]:
    """The loop's equilibrium in the states' values, and its eigenvalues there."""
    rest: Mapping[str, Any] = result["rest"]
    held = " at the nominal values" if result.get("uncertain") else ""
    each = zip(state_names(result), rest["values"], state_units(result), strict=True)
    where = ", ".join(f"{symbol(name)} = {quantity(value, unit, 9)}" for name, value, unit in each)
    return "equilibrium", f"{where}{held}; eigenvalues there {', '.join(rest['eigenvalues']) or 'not enclosed'}"


def _functions(timing: TimingInWords) -> str:
    if timing.discrete:
        return "any sequences of values: constant, drifting or jumping"
    return "any measurable functions of time: constant, drifting or jumping"


def _rate(result: Mapping[str, Any], timing: TimingInWords) -> str:
    """The rate, and the time that follows from it, rounded up."""
    floor = result["levels"].get("floor") if kind_of(result) in PRACTICAL else None
    latest = reach_time(timing, floor, result["levels"].get("roa"))
    what = "V at most 1 % of what it was" if floor is None else "in {V <= c0}"
    when = f"after {ABSENT if latest is None else above(latest)} {timing.unit} at the latest"
    return f"{timing.shown_rate}; {what} {when}{', at sampling instants' if timing.sample else ''}"


def _asked(result: Mapping[str, Any]) -> str:
    """The requested state or box, by the states' values."""
    return place({name: result["reach_from"][name] for name in state_names(result)}, state_units(result))


def _tube(result: Mapping[str, Any]) -> str:
    """A tube's start, the reach of the start, and the duration.

    Around a path the reach is along one state at a time, with the others at the centre, rounded down.
    """
    tube = result["tube"]
    size = f"{tube['slabs']} slabs, {above(tube['duration'], 3)} s"
    start = f"from an ellipsoid of the shape {tube['shape']}"
    if not tube.get("centre"):
        return f"{start}, {size}"
    each = zip(state_names(result), tube["semi_axes"], state_units(result), strict=True)
    alone = ", ".join(f"{symbol(name)} +- {below(v, 3)} {pretty_unit(unit)}".rstrip() for name, v, unit in each)
    at = [Fraction((result.get("operating_point") or {}).get(name, 0)) for name in state_names(result)]
    centre = [q + Fraction(c) for q, c in zip(at, tube["centre"], strict=True)]
    where = point(state_names(result), centre, state_units(result))
    return (
        f"{start} around {where}, which holds {alone}, one at a time, into {{V <= c2}}, {size}; nothing is claimed "
        "about states between the two sets"
    )


def _outer(outer: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Describe N, its outer set, and the limit of its level."""
    if outer["kind"] == "network":
        name, named = network_name(outer["layers"]), [("sha256 of N", begun(str(outer["sha256"])))]
    else:
        text = str(outer["expression"])
        name, named = text if len(text) <= _LONG else f"an expression of {len(text):,} characters", []
    about = f"{{N(x) <= {below(outer['level'])}}} in the domain, and nothing outside of it, N being {name}"
    work = f"{outer['boxes']:,} boxes, {outer['leaves']:,} leaves"
    return [("outer set", about), *named, ("its limit", outer_limited_by(outer)), ("its work", work)]


def _ranks(result: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The boxes with ranks: their number, their share of the box that was cut, their size, and the work."""
    ranks, names, units = result["ranks"], state_names(result), state_units(result)
    timing = TimingInWords.of_result(result)
    steps = "steps" if timing.sample is None else "sampling instants"
    share = f"{below(100 * ranks['covered'], 4)} % of the box that was cut"
    about = (
        f"{ranks['proved']:,} of {ranks['leaves']:,}, {share}: from each of them every trajectory is in {{V <= c2}} "
        f"after {ranks['steps']:,} {steps} at the latest"
    )
    rows = [("boxes with ranks", about)]
    if ranks["angles"]:
        turned = ", ".join(symbol(name) for name in ranks["angles"])
        rows.append(("angles", f"{turned}: states that differ by full turns are the same place"))
    unit = volume_unit(units)
    rows.append((f"their {volume_name(len(names))}", f"{below(ranks['volume'])} {unit}".rstrip()))
    if ranks.get("rounds"):
        rows.append(("their work", f"{ranks['rounds']:,} round{'s' * (ranks['rounds'] > 1)}"))
    return rows


def _constraints(constraints: Mapping[str, str]) -> list[str]:
    """Each constraint with its name."""
    return [f"{name}: {text}" for name, text in constraints.items()]


def _diagnosis_rows(result: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The loop's modes, the states that cost the proof most, and the next thing to try."""
    found, rows = result.get("diagnosis"), []
    if not found:
        return []
    timing = TimingInWords.of_result(result)
    if found.get("stiffness") and not timing.discrete:
        held = " (at the nominal values)" if result.get("uncertain") else ""
        at_once = "" if timing.sample is None else ", if the input followed at once"
        rows.append(("modes", modes(found["fastest"], found["slowest"]) + held + at_once))
    if found["hurts"] and found.get("kind") not in (*AT_A_POINT, "unstable"):  # an unstable loop has no proof
        rows.append(("hardest along", hardest(found["hurts"])))
    step = found["next"]
    if not step.get("command") and step["why"] == result.get("reason"):  # which is said already
        return rows
    return [*rows, try_next(step)]


def try_next(step: Mapping[str, Any]) -> tuple[str, str]:
    """The row of a next step: the command to type, if there is one, and why."""
    return "try next", f"{step['command']}  ({step['why']})" if step.get("command") else step["why"]


def _level(value: float | None) -> str:
    return "" if value is None else below(value)


def _times(spent: Mapping[str, float | None]) -> str:
    stages = [f"{stage} {seconds(spent[stage])}" for stage in STAGES if spent.get(stage) is not None]
    return f"{seconds(spent.get('total'))}  ({', '.join(stages)})" if stages else seconds(spent.get("total"))


def of_which(result: Mapping[str, Any]) -> str:
    """Name the set that the sizes describe, if there are two; empty if there is only one."""
    tube = result.get("tube")
    if result.get("outer") or result.get("ranks"):
        return ", of {V <= c2} alone"
    if not tube:
        return ""
    return (
        ", of the tube's start" if not tube.get("centre") and tube["volume"] == result["volume"] else ", of {V <= c2}"
    )


def kind_of(result: Mapping[str, Any]) -> str:
    return str((result.get("claim") or {}).get("kind", "asymptotic"))


def inner_of(result: Mapping[str, Any]) -> float | None:
    value: float | None = result["levels"].get(words_of(result).inner_word)
    return value


def words_of(result: Mapping[str, Any]) -> Words:
    ranks = result.get("ranks") or {}
    has = Additions(
        beyond=bool(result.get("outer")),
        ranked=bool(ranks),
        angles=tuple(ranks.get("angles", ())),
        kept=bool(result.get("constraints")),
    )
    return words_for(kind_of(result), TimingInWords.of_result(result), has)


def uncertain_of(result: Mapping[str, Any]) -> list[Varying]:
    each = result.get("uncertain") or ()
    return [Varying(q["name"], Fraction(q["lo"]), Fraction(q["hi"]), q.get("unit") or "") for q in each]


def is_missed(result: Mapping[str, Any]) -> bool:
    """True if a set is proved but the request is not: a state shown neither to lie in the set nor to reach it, or a
    level of N."""
    proved = result.get("checked") == "ACCEPTED" and result["levels"].get("roa") is not None
    return bool(result.get("stop") in ("path", "beyond") and proved)


def state_names(result: Mapping[str, Any]) -> list[str]:
    return [s["name"] for s in _states(result)]


def state_units(result: Mapping[str, Any]) -> list[str]:
    return [s.get("unit") or "" for s in _states(result)]


def _states(result: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Names and units of the states as the result gives them; never those of a plant that is called the same."""
    n = result["policy"]["layers"][0]
    return list(result.get("states") or ({"name": f"x{i + 1}"} for i in range(n)))
