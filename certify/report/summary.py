"""The terminal summary of `certify roa`: the result in one screen.

Everything comes from the result, names and units too, because a user's plant may have the name of another.
"""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction
from typing import TYPE_CHECKING, Any

from certify.report.measured import Measured
from certify.report.rows import (
    inner_of,
    is_missed,
    kind_of,
    of_which,
    rows_of,
    state_names,
    state_units,
    uncertain_of,
    words_of,
)
from certify.report.sampled import Sampled
from certify.report.timing import TimingInWords
from certify.report.words import (
    above,
    below,
    deviation,
    inner_level,
    listed,
    pretty_unit,
    state_or_box,
    varying,
)

if TYPE_CHECKING:
    from rich.console import RenderableType

_COLOURS = {"PROVED": "bold green", "REFUTED": "bold red", "UNKNOWN": "bold yellow", "TRUSTED": "bold yellow"}


def summary(result: Mapping[str, Any]) -> RenderableType:
    """A few lines for the terminal from the dictionary of `RoaResult.to_dict`.

    Parameters
    ----------
    result : the object that `certify roa --json` prints. Of its keys `states` and `inputs` (lists of `{name, unit}`),
        `operating_point` (values by state), `reach_from` (by state the value, or both ends, that was asked about),
        `claim` (`{kind}`, with `rate` and `sample` where there are), `time` and `uncertain` may be absent: then there
        are no units, the operating point is 0, no state was asked about, the claim is the asymptotic one, time is
        continuous, and all of the plant is exact.

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
    for name, value in rows_of(result, shown):
        grid.add_row(Text(name), Text(value))
    parts: list[RenderableType] = [head, Text(), grid]
    if shown and result.get("extents"):
        parts += [Text(), _reach(result)]
    if shown and any(result.get(part) for part in ("tube", "outer", "ranks")):
        parts.append(Text(f"lengths{of_which(result)}", style="dim"))
    return Group(*parts, Text())


def _verdict(result: Mapping[str, Any]) -> str:
    """The verdict, unless it exceeds the checker's answer: PROVED needs the checker's ACCEPTED."""
    verdict, checked = str(result["verdict"]), result.get("checked")
    if verdict == "PROVED" and checked != "ACCEPTED":
        return "TRUSTED" if checked == "TRUSTED" else "UNKNOWN"
    return verdict


def _headline(result: Mapping[str, Any], verdict: str) -> str:
    name, level = result["system"], result["levels"].get("roa")
    if verdict in ("PROVED", "TRUSTED") and level is not None:
        word = ", if the solver is right: nothing checked its answers" if verdict == "TRUSTED" else ""
        return f"{name}: {_whatever(result)}{in_a_line(result)}{word}"
    if verdict == "REFUTED" and result.get("stop") == "unstable":
        return f"{name}: the closed loop is unstable at {_where_v_is_0(result)}, so that no V can prove the claim"
    if verdict == "REFUTED":
        return f"{name}: a condition of the claim fails for this V and level; another V may show what this one cannot"
    if is_missed(result) and result.get("stop") == "beyond":
        outer = result.get("outer")
        smaller = f" with the states of the domain where N(x) <= {below(outer['level'])}" if outer else ""
        return f"{name}: the level of N is NOT proved; what is proved is {{V <= {below(level)}}}{smaller}"
    if is_missed(result):
        shape = state_or_box(result.get("reach_from") or {})
        return f"{name}: the {shape} is NOT shown to converge; what is proved is {{V <= {below(level)}}}, without it"
    return f"{name}: nothing was proved"


def in_a_line(result: Mapping[str, Any]) -> str:
    """The claim of a result in a line, about its levels."""
    inner = inner_of(result)
    stated = words_of(result).headline.format(
        outer=below(result["levels"]["roa"]),
        inner="?" if inner is None else inner_level(kind_of(result), inner),
        speed=TimingInWords.of_result(result).headline_rate(),
        beyond=below(result["outer"]["level"]) if result.get("outer") else "",
        steps=f"{result['ranks']['steps']:,}" if result.get("ranks") else "",
        constraints=listed(list(result.get("constraints") or ())),
        constant="where what is uncertain is constant in time, " if result.get("uncertain") else "",
    )
    return stated.replace("the origin", _where_v_is_0(result))


def _where_v_is_0(result: Mapping[str, Any]) -> str:
    """The name of the origin for people who read values: the operating point, if that is not 0."""
    moved = any(map(Fraction, (result.get("operating_point") or {}).values()))
    return "the operating point" if moved else "the origin"


_FEW = 3  # uncertain quantities that a headline names


def _whatever(result: Mapping[str, Any]) -> str:
    """The uncertain quantities for the headline; empty for an exact plant."""
    found, data, sampled = uncertain_of(result), Measured.of_result(result), Sampled.of_result(result)
    if sampled is not None:
        others = sampled.others(found)
        return f"for every {sampled.consistent}{f' and every {varying(others)}' if others else ''}, "
    if data is not None:
        others = data.others(found)
        also = f" and every {varying(others)}" if others else ""
        return f"for every constant {data.names} in the priors {data.consistent}{also}, "
    if not found:
        return ""
    if len(found) > _FEW:
        return f"for every one of the {len(found)} uncertain quantities within its range at any time, "
    return f"for every {varying(found)}, "


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
    columns = zip(state_names(result), state_units(result), result["semi_axes"], result["extents"], strict=True)
    at = [Fraction((result.get("operating_point") or {}).get(name, 0)) for name in state_names(result)]
    for k, (name, unit, semi_axis, extent) in enumerate(columns):
        title = deviation(name, at[k], unit) if name.isascii() else f"{name} {pretty_unit(unit)}"
        cells = [title, below(semi_axis), above(extent)] + ([f"{100 * shares[k]:.3g} %"] if shares else [])
        table.add_row(*map(Text, cells))
    return table
