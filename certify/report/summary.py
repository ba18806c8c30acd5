"""The terminal summary of `certify roa`: what the result says, in one screen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from certify.report.words import below, label, number, pretty_unit, registered, seconds, volume_name, volume_unit

if TYPE_CHECKING:
    from rich.console import RenderableType

_COLOURS = {"PROVED": "bold green", "REFUTED": "bold red", "UNKNOWN": "bold yellow"}
_LIMITS = {
    "domain": "the domain",
    "inputs": "the input bounds: beyond it the policy asks for more than the actuator gives",
    "witness": "a point where Vdot >= 0",
    "time": "the time limit: more may be provable",
    "boxes": "the limit on boxes: more may be provable",
    "requested": "the level that was asked for",
}
_STAGES = ("load", "candidate", "local", "ring", "write", "check")


def limit_in_words(reason: str) -> str:
    """What limits the level, in words; other reasons are sentences already."""
    return _LIMITS.get(reason, reason)


def summary(result: Mapping[str, Any]) -> RenderableType:
    """A few lines for the terminal from the dictionary of `RoaResult.to_dict`.

    Parameters
    ----------
    result : the object that `certify roa --json` prints.

    Returns
    -------
    a rich renderable. Names are shown as they are: no markup in them is obeyed.
    """
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    verdict, proved = str(result["verdict"]), result["verdict"] == "PROVED"
    head = Text.assemble((verdict, _COLOURS.get(verdict, "bold")), "  ", (_headline(result), "bold"))
    grid = Table.grid(padding=(0, 2))
    grid.add_column(style="dim", no_wrap=True)
    grid.add_column(overflow="fold")
    for name, value in _rows(result, proved):
        grid.add_row(Text(name), Text(value))
    parts: list[RenderableType] = [head, Text(), grid]
    if proved and result.get("extents"):
        parts += [Text(), _reach(result)]
    return Group(*parts, Text())


def _headline(result: Mapping[str, Any]) -> str:
    name, level = result["system"], result["levels"].get("roa")
    if result["verdict"] == "PROVED" and level is not None:
        word = ", if the solver is right: nothing checked its answers" if result.get("checked") == "TRUSTED" else ""
        return f"{name}: {{V <= {below(level)}}} is invariant and attracted by the origin{word}"
    if result["verdict"] == "REFUTED":
        return f"{name}: the claim is false for this V"
    return f"{name}: nothing was proved"


def _rows(result: Mapping[str, Any], proved: bool) -> list[tuple[str, str]]:
    levels, rows = result["levels"], []
    if proved:
        rows.append(("limited by", limit_in_words(str(result["reason"]))))
    else:
        rows.append(("reason", str(result["reason"])))
    known = [f"{key} {shown}" for key, shown in (
        ("local c1", _level(levels.get("local"))),
        ("enlarged c2", _level(levels.get("roa"))),
        ("domain limit", _level(levels.get("domain_limit"))),
        ("sampled limit", _level(levels.get("sampled_limit"))),
    ) if shown]  # fmt: skip
    if known:
        rows.append(("levels of V", ", ".join(known)))
    units = _state_units(result)
    if result.get("volume") is not None:
        unit = volume_unit(units)
        rows.append((volume_name(len(units)), f"{below(result['volume'])} {unit}".rstrip()))
    if len(result.get("candidates", [])) > 1:
        unit = volume_unit(units)
        shown = [f"{c['candidate']} {below(c['volume'])}" for c in result["candidates"]]
        rows.append(("candidates", f"{', '.join(shown)} {unit}".rstrip() + " (sampled, at most)"))
    rows.append(("policy", "-".join(map(str, result["policy"]["layers"]))))
    rows.append(("its sha256", str(result["policy"]["sha256"])))
    if result.get("eigenvalues"):
        rows.append(("eigenvalues", ", ".join(map(str, result["eigenvalues"]))))
    if result.get("boxes"):
        rows.append(("work", f"{result['boxes']:,} boxes, {result['leaves']:,} leaves"))
    solver = result.get("solver") or {}
    if "missing" in solver:
        rows.append(("dReal", f"not asked: {solver['missing']}"))
    elif solver:
        answers = [q["answer"] for q in solver["queries"]]
        rows.append(("dReal", f"{answers.count('unsat')} of {len(answers)} queries unsat, version {solver['version']}"))
    rows.append(("time", _times(result["seconds"])))
    rows.append(("checker", result["checked"] or "not reached"))
    return rows


def _level(value: float | None) -> str:
    return "" if value is None else below(value)


def _times(spent: Mapping[str, float | None]) -> str:
    stages = [f"{stage} {seconds(spent[stage])}" for stage in _STAGES if spent.get(stage) is not None]
    return f"{seconds(spent.get('total'))}  ({', '.join(stages)})" if stages else seconds(spent.get("total"))


def _reach(result: Mapping[str, Any]) -> RenderableType:
    from rich import box
    from rich.table import Table
    from rich.text import Text

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False, header_style="dim")
    table.add_column("state")
    table.add_column("on its axis, +-", justify="right")
    table.add_column("largest in the set, +-", justify="right")
    columns = zip(_state_names(result), _state_units(result), result["semi_axes"], result["extents"], strict=True)
    for name, unit, semi_axis, extent in columns:
        title = label(name, unit) if name.isascii() else f"{name} {pretty_unit(unit)}"
        table.add_row(Text(title), Text(number(semi_axis)), Text(number(extent)))
    return table


def _state_names(result: Mapping[str, Any]) -> Sequence[str]:
    plant, n = registered(str(result["system"])), len(result["extents"])
    return [s.name for s in plant.states] if plant and plant.n == n else [f"x{i + 1}" for i in range(n)]


def _state_units(result: Mapping[str, Any]) -> list[str]:
    plant, n = registered(str(result["system"])), result["policy"]["layers"][0]
    return [plant.units.get(s.name, "") for s in plant.states] if plant and plant.n == n else [""] * n
