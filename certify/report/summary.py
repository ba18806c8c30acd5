"""The terminal summary of `certify roa`: the result in one screen.

Everything comes from the result, names and units too, because a user's plant may have the name of another.
"""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction
from typing import TYPE_CHECKING, Any
from unicodedata import normalize

from certify.certificates.timing import reach_time
from certify.report.claims import Words, words_for
from certify.report.limits import AT_A_POINT, hardest, limited_by, outer_limited_by
from certify.report.timing import TimingInWords
from certify.report.words import (
    ABSENT,
    PRACTICAL,
    Varying,
    above,
    at_rest,
    below,
    deviation,
    distinguished,
    estimated,
    inner_level,
    modes,
    network_name,
    number,
    point,
    pretty_unit,
    quantity,
    seconds,
    symbol,
    varying,
    volume_name,
    volume_unit,
)

if TYPE_CHECKING:
    from rich.console import RenderableType

_COLOURS = {"PROVED": "bold green", "REFUTED": "bold red", "UNKNOWN": "bold yellow", "TRUSTED": "bold yellow"}
_STAGES = ("load", "candidate", "local", "ring", "tube", "learn", "outer", "write", "check")


def summary(result: Mapping[str, Any]) -> RenderableType:
    """A few lines for the terminal from the dictionary of `RoaResult.to_dict`.

    Parameters
    ----------
    result : the object that `certify roa --json` prints. Of its keys `states` and `inputs` (lists of `{name, unit}`),
        `operating_point` (values by state), `reach_from` (values by state, of the state that was asked about), `claim`
        (`{kind}`, with `rate` and `sample` where there are), `time` and `uncertain` may be absent: then there are no
        units, the operating point is 0, no state was asked about, the claim is the asymptotic one, time is continuous,
        and all of the plant is exact.

    Returns
    -------
    a rich renderable. Names are shown as they are: no markup in them is obeyed.
    """
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    verdict = _verdict(result)
    shown = verdict in ("PROVED", "TRUSTED")
    head = Text.assemble((verdict, _COLOURS.get(verdict, "bold")), "  ", (_headline(result, verdict), "bold"))
    grid = Table.grid(padding=(0, 2))
    grid.add_column(style="dim", no_wrap=True)
    grid.add_column(overflow="fold")
    for name, value in _rows(result, shown):
        grid.add_row(Text(name), Text(value))
    parts: list[RenderableType] = [head, Text(), grid]
    if shown and result.get("extents"):
        parts += [Text(), _reach(result)]
    if shown and (result.get("tube") or result.get("outer")):
        parts.append(Text(f"lengths{_of_which(result)}", style="dim"))
    return Group(*parts, Text())


def _verdict(result: Mapping[str, Any]) -> str:
    """The verdict, unless it exceeds the checker's answer: PROVED needs the checker's ACCEPTED."""
    verdict, checked = str(result["verdict"]), result.get("checked")
    if verdict == "PROVED" and checked != "ACCEPTED":
        return "TRUSTED" if checked == "TRUSTED" else "UNKNOWN"
    return verdict


def _kind(result: Mapping[str, Any]) -> str:
    return str((result.get("claim") or {}).get("kind", "asymptotic"))


def _inner(result: Mapping[str, Any]) -> float | None:
    value: float | None = result["levels"].get(_words(result).inner_word)
    return value


def _words(result: Mapping[str, Any]) -> Words:
    return words_for(_kind(result), TimingInWords.of_result(result), beyond=bool(result.get("outer")))


def _headline(result: Mapping[str, Any], verdict: str) -> str:
    name, level, kind = result["system"], result["levels"].get("roa"), _kind(result)
    if verdict in ("PROVED", "TRUSTED") and level is not None:
        inner = _inner(result)
        stated = _words(result).headline.format(
            outer=below(level),
            inner="?" if inner is None else inner_level(kind, inner),
            speed=TimingInWords.of_result(result).headline_rate(),
            beyond=below(result["outer"]["level"]) if result.get("outer") else "",
            constant="where what is uncertain is constant in time, " if result.get("uncertain") else "",
        )
        word = ", if the solver is right: nothing checked its answers" if verdict == "TRUSTED" else ""
        if any(map(Fraction, (result.get("operating_point") or {}).values())):
            stated = stated.replace("the origin", "the operating point")
        return f"{name}: {_whatever(result)}{stated}{word}"
    if verdict == "REFUTED":
        return f"{name}: a condition of the claim fails for this V and level; another V may show what this one cannot"
    if _is_missed(result) and result.get("stop") == "beyond":
        outer = result.get("outer")
        smaller = f" with the states of the domain where N(x) <= {below(outer['level'])}" if outer else ""
        return f"{name}: the level of N is NOT proved; what is proved is {{V <= {below(level)}}}{smaller}"
    if _is_missed(result):
        return f"{name}: the state is NOT shown to converge; what is proved is {{V <= {below(level)}}}, without it"
    return f"{name}: nothing was proved"


_LONG = 200  # characters of an expression, beyond which it is not shown
_FEW = 3  # uncertain quantities that a headline names


def _uncertain(result: Mapping[str, Any]) -> list[Varying]:
    each = result.get("uncertain") or ()
    return [Varying(q["name"], Fraction(q["lo"]), Fraction(q["hi"]), q.get("unit") or "") for q in each]


def _whatever(result: Mapping[str, Any]) -> str:
    """The uncertain quantities for the headline; empty for an exact plant."""
    found = _uncertain(result)
    if not found:
        return ""
    if len(found) > _FEW:
        return f"for every one of the {len(found)} uncertain quantities within its range at any time, "
    return f"for every {varying(found)}, "


def _is_missed(result: Mapping[str, Any]) -> bool:
    """True if a set is proved but the request is not: a state shown neither to lie in the set nor to reach it, or a
    level of N."""
    proved = result.get("checked") == "ACCEPTED" and result["levels"].get("roa") is not None
    return bool(result.get("stop") in ("path", "beyond") and proved)


def _rows(result: Mapping[str, Any], shown: bool) -> list[tuple[str, str]]:
    levels, rows = result["levels"], []
    found, timing = _uncertain(result), TimingInWords.of_result(result)
    if found:
        each = "; ".join(q.words for q in found)
        what = "for every" if shown else "asked for every"
        rows.append((what, f"{each}: {_functions(timing)}"))
    if timing.sample is not None:
        rows.append(("input held over" if shown else "asked to hold", timing.periods))
    if shown:
        rows.append(("limited by", limited_by(result)))
        if (result.get("diagnosis") or {}).get("kind") in AT_A_POINT:
            rows.append(("namely", str(result["diagnosis"]["binds"])))
    else:
        rows.append(("reason", str(result["reason"])))
    if timing.rate:
        rows.append(("rate", _rate(result, timing) if shown else f"asked for {timing.shown_rate}"))
    kind, inner = _kind(result), _inner(result)
    words = _words(result)
    local = levels.get("local") if kind in PRACTICAL else None
    known = [
        (f"{words.inner_word} {normalize('NFKC', words.inner)}", "" if inner is None else inner_level(kind, inner)),
        ("local c1", _level(local) if local != inner else ""),
        ("enlarged c2", _level(levels.get("roa"))),
        ("the domain's edge at", _level(levels.get("domain_limit"))),
        ("the lowest violation found at", _level(levels.get("sampled_limit"))),
    ]
    stated = [f"{name} {text}" for name, text in known if text]
    if stated:
        rows.append(("levels of V", ", ".join(stated)))
    units = _state_units(result)
    if result.get("reach_from"):
        asked = _asked(result)
        rows.append(("state", f"{asked}, which lies in {{V <= c2}}" if shown and not result.get("tube") else asked))
    if result.get("tube"):
        rows.append(("tube", _tube(result)))
    if result.get("outer"):
        rows += _outer(result["outer"])
    if result.get("volume") is not None:
        unit = volume_unit(units)
        size = f"{below(result['volume'])} {unit}".rstrip()
        rows.append((volume_name(len(units)), size + _of_which(result)))
        if result.get("outer"):
            union = estimated(result["outer"]["volume"], result["outer"]["deviation"], unit)
            rows.append(("with outer set", union))
    if len(result.get("candidates", [])) > 1:
        unit = volume_unit(units)
        named = distinguished([c["candidate"] for c in result["candidates"]])
        tried = [
            f"{name}: {below(c.get('proved_volume') or 0.0, 3)} of {number(c['volume'], 3)}"
            for name, c in zip(named, result["candidates"], strict=True)
        ]
        rows.append(
            (
                "candidates",
                f"{'; '.join(tried)} {unit}".rstrip() + " (volume proved, of what sampling allows)",
            )
        )
    at = result.get("operating_point") or {}
    if at:
        names = _state_names(result)
        point = at_rest(names, [Fraction(at.get(name, 0)) for name in names], units)
        rests = ", where the loop rests" if (result.get("rest") or {}).get("origin") else ""
        rows.append(
            ("operating point", f"{point}{rests}; the set lies around it, and its lengths are deviations from it")
        )
    if result.get("rest"):
        rows.append(_rest(result))
    rows += _diagnosis_rows(result)
    rows.append(("policy", "-".join(map(str, result["policy"]["layers"]))))
    rows.append(("its sha256", str(result["policy"]["sha256"])))
    if result.get("eigenvalues"):
        held = " (at the nominal values)" if result.get("uncertain") else ""
        rows.append(("eigenvalues", ", ".join(map(str, result["eigenvalues"])) + held))
    whole = levels.get("local") if kind not in PRACTICAL or local != inner else None
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
    if _is_missed(result):
        beyond = result.get("stop") == "beyond"
        about = ", about a smaller set" if beyond else ", about {V <= c2} alone, in which the state does not lie"
    rows.append(("checker", f"{result['checked'] or 'not reached'}{about}"))
    return rows


def _rest(result: Mapping[str, Any]) -> tuple[str, str]:
    """The loop's equilibrium in the states' values, and its eigenvalues there."""
    rest: Mapping[str, Any] = result["rest"]
    held = " at the nominal values" if result.get("uncertain") else ""
    each = zip(_state_names(result), rest["values"], _state_units(result), strict=True)
    where = ", ".join(f"{symbol(name)} = {quantity(value, unit, 9)}" for name, value, unit in each)
    return "rests at", f"{where}{held}; eigenvalues there {', '.join(rest['eigenvalues']) or 'not enclosed'}"


def _functions(timing: TimingInWords) -> str:
    if timing.discrete:
        return "any sequences of values: constant, drifting or jumping"
    return "any measurable functions of time: constant, drifting or jumping"


def _rate(result: Mapping[str, Any], timing: TimingInWords) -> str:
    """The rate and the time that follows from it, rounded up."""
    floor = result["levels"].get("floor") if _kind(result) in PRACTICAL else None
    latest = reach_time(timing, floor, result["levels"].get("roa"))
    what = "V at most 1 % of what it was" if floor is None else "in {V <= c0}"
    when = f"after {ABSENT if latest is None else above(latest)} {timing.unit} at the latest"
    return f"{timing.shown_rate}; {what} {when}{', at sampling instants' if timing.sample else ''}"


def _asked(result: Mapping[str, Any]) -> str:
    """The requested state, by the states' values."""
    names = _state_names(result)
    return point(names, [Fraction(result["reach_from"][name]) for name in names], _state_units(result))


def _tube(result: Mapping[str, Any]) -> str:
    """A tube's start, the reach of the start, and the duration.

    Around a path the reach is along one state at a time, with the others at the centre, rounded down.
    """
    tube = result["tube"]
    size = f"{tube['slabs']} slabs, {above(tube['duration'], 3)} s"
    start = f"from an ellipsoid of the shape {tube['shape']}"
    if not tube.get("centre"):
        return f"{start}, {size}"
    each = zip(_state_names(result), tube["semi_axes"], _state_units(result), strict=True)
    alone = ", ".join(f"{symbol(name)} +- {below(v, 3)} {pretty_unit(unit)}".rstrip() for name, v, unit in each)
    at = [Fraction((result.get("operating_point") or {}).get(name, 0)) for name in _state_names(result)]
    centre = [q + Fraction(c) for q, c in zip(at, tube["centre"], strict=True)]
    where = point(_state_names(result), centre, _state_units(result))
    return (
        f"{start} around {where}, which holds {alone}, one at a time, into {{V <= c2}}, {size}; nothing is claimed "
        "about states between the two sets"
    )


def _outer(outer: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Describe N, its outer set, and the limit of its level."""
    if outer["kind"] == "network":
        name, named = network_name(outer["layers"]), [("sha256 of N", str(outer["sha256"]))]
    else:
        text = str(outer["expression"])
        name, named = text if len(text) <= _LONG else f"an expression of {len(text):,} characters", []
    about = f"{{N(x) <= {below(outer['level'])}}} in the domain, and nothing outside of it, N being {name}"
    work = f"{outer['boxes']:,} boxes, {outer['leaves']:,} leaves"
    return [("outer set", about), *named, ("its limit", outer_limited_by(outer)), ("its work", work)]


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
    if found["hurts"] and found.get("kind") not in AT_A_POINT:
        rows.append(("hardest along", hardest(found["hurts"])))
    step = found["next"]
    command = f"{step['command']}  ({step['why']})" if step.get("command") else step["why"]
    return [*rows, ("try next", command)]


def _level(value: float | None) -> str:
    return "" if value is None else below(value)


def _times(spent: Mapping[str, float | None]) -> str:
    stages = [f"{stage} {seconds(spent[stage])}" for stage in _STAGES if spent.get(stage) is not None]
    return f"{seconds(spent.get('total'))}  ({', '.join(stages)})" if stages else seconds(spent.get("total"))


def _of_which(result: Mapping[str, Any]) -> str:
    """Name the set that the sizes describe, if there are two; empty if there is only one."""
    tube = result.get("tube")
    if result.get("outer"):
        return ", of {V <= c2} alone"
    if not tube:
        return ""
    return (
        ", of the tube's start" if not tube.get("centre") and tube["volume"] == result["volume"] else ", of {V <= c2}"
    )


def _reach(result: Mapping[str, Any]) -> RenderableType:
    from rich import box
    from rich.table import Table
    from rich.text import Text

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False, header_style="dim")
    table.add_column("state")
    table.add_column("others at rest, ±", justify="right")
    table.add_column("at most, ±", justify="right")
    shares = [one["share"] for one in (result.get("diagnosis") or {}).get("shares", [])]
    if shares:
        table.add_column("of its domain", justify="right")
    columns = zip(_state_names(result), _state_units(result), result["semi_axes"], result["extents"], strict=True)
    at = [Fraction((result.get("operating_point") or {}).get(name, 0)) for name in _state_names(result)]
    for k, (name, unit, semi_axis, extent) in enumerate(columns):
        title = deviation(name, at[k], unit) if name.isascii() else f"{name} {pretty_unit(unit)}"
        cells = [title, below(semi_axis), above(extent)] + ([f"{100 * shares[k]:.3g} %"] if shares else [])
        table.add_row(*map(Text, cells))
    return table


def _state_names(result: Mapping[str, Any]) -> list[str]:
    return [s["name"] for s in _states(result)]


def _state_units(result: Mapping[str, Any]) -> list[str]:
    return [s.get("unit") or "" for s in _states(result)]


def _states(result: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Names and units of the states as the result gives them; never those of a plant that is called the same."""
    n = result["policy"]["layers"][0]
    return list(result.get("states") or ({"name": f"x{i + 1}"} for i in range(n)))
