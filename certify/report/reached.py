"""The terminal summary of `certify reach --target`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from fractions import Fraction
from typing import TYPE_CHECKING, Any

from certify.report.rows import try_next
from certify.report.summary import in_a_line
from certify.report.words import below, nonlinearity_in_words, pretty_unit

if TYPE_CHECKING:
    from rich.console import RenderableType

_COLOURS = {"PROVED": "bold green", "REFUTED": "bold red", "UNKNOWN": "bold yellow"}


def summary(result: Mapping[str, Any]) -> RenderableType:
    """A few lines for the terminal from the dictionary of `ReachResult.to_dict`."""
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    verdict = str(result["verdict"])
    if verdict == "PROVED" and result["checked"] != "ACCEPTED":
        verdict = "UNKNOWN"
    head = Text.assemble((verdict, _COLOURS[verdict]), "  ", (_headline(result, verdict), "bold"))
    grid = Table.grid(padding=(0, 2))
    grid.add_column(style="dim", no_wrap=True)
    grid.add_column(overflow="fold")
    for name, value in _rows(result):
        grid.add_row(Text(name), Text(value))
    return Group(head, Text(), grid, Text())


def target_of(result: Mapping[str, Any]) -> str:
    """The region as it was written, or the certificate's set."""
    if result["levels"]:
        return f"V <= {below(result['levels']['roa'])}"
    return " and ".join(" ".join(text.split()) for text in result["target"])


def steps_of(result: Mapping[str, Any], count: int) -> str:
    """A number of steps, and the time that they take where the input is held over one period."""
    sample = result["claim"].get("sample")
    word = "step" if sample is None else "period"
    said = f"{count:,} {word}{'s' if count != 1 else ''}"
    return said if sample is None or sample[0] != sample[1] else f"{said} ({float(count * Fraction(sample[1])):g} s)"


def _headline(result: Mapping[str, Any], verdict: str) -> str:
    name, target = result["system"], target_of(result)
    box = box_of(result)
    if verdict == "PROVED" and box is None:
        return f"{name}: from the boxes with ranks, {target} after {steps_of(result, result['ranks']['steps'])} at most"
    if verdict == "PROVED":
        return f"{name}: from all of {box}, {target} after {steps_of(result, result['steps'])} at the latest"
    within = "" if result["within"] is None else f" within {steps_of(result, result['within'])}"
    where = "any box" if box is None else f"all of {box}"
    if verdict == "REFUTED":
        return f"{name}: {target}{within}: not from {where}"
    return f"{name}: {target}{within} is NOT proved from {where}"


def _rows(result: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    ranks, simulated = result["ranks"], result["simulated"]
    if result["reason"] == "effort":
        yield "limited by", "the effort"
    elif result["reason"] not in ("requested", "done"):
        yield "reason", result["reason"]
    if result["levels"]:
        yield "V of", result["target"][0]
        yield "then", in_a_line({**result, "ranks": None, "constraints": {}})
    if ranks is not None:
        share = f"{below(100 * ranks['covered'], 4)} % of the box that was cut"
        yield (
            "boxes",
            f"{ranks['proved']:,} of {ranks['leaves']:,} leaves have a rank, {share}, volume {below(ranks['volume'])}",
        )
        yield "steps", f"{steps_of(result, ranks['steps'])} at most from any of them"
    for name, words in result["constraints"].items():
        yield "kept", f"{name}: {words}, {'at all times' if result['levels'] else 'until then'}"
    if result["uncertain"]:
        yield "for every", ", ".join(f"{name} in [{lo}, {hi}]" for name, (lo, hi) in result["uncertain"].items())
    if simulated is not None and simulated["longest"] is not None:
        longest = f"{steps_of(result, simulated['longest'])} at most of those that get there"
        yield "simulated", f"{simulated['runs']} runs from the box, {longest}"
    if result["nonlinearity"] is not None:
        yield "linear part", nonlinearity_in_words(result["nonlinearity"])
    if result["checked"] is not None:
        both = ", and by the reference" if result["reference"] == "ACCEPTED" else ""
        yield "checked", f"{result['checked']}{both}"
    if result["next"] is not None:
        yield try_next(result["next"])
    yield "seconds", ", ".join(f"{name} {value:.2g}" for name, value in result["seconds"].items())


def box_of(result: Mapping[str, Any]) -> str | None:
    """The box that was asked about, in words; None if there is none."""
    if result["from"] is None:
        return None
    units = {s["name"]: pretty_unit(s["unit"]) for s in result["states"]}
    found = []
    for name, ends in result["from"].items():
        lo, hi = (float(Fraction(end)) for end in ends)
        found.append(f"{name} = {lo:g}{f'..{hi:g}' if hi > lo else ''} {units[name]}".rstrip())
    return ", ".join(found)
