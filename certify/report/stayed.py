"""The terminal summary of `certify roa --claim invariant`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from certify.report.reached import steps_of
from certify.report.words import below, nonlinearity_in_words, percent, volume_name

if TYPE_CHECKING:
    from rich.console import RenderableType

_COLOURS = {"PROVED": "bold green", "REFUTED": "bold red", "UNKNOWN": "bold yellow"}
_LONGEST = 160  # letters of an expression


def summary(result: Mapping[str, Any]) -> RenderableType:
    """A few lines for the terminal from the dictionary of `InvariantResult.to_dict`."""
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    verdict = str(result["verdict"])
    if verdict == "PROVED" and result["checked"] != "ACCEPTED":
        verdict = "UNKNOWN"
    name = result["system"]
    head = (
        f"{name}: {_set_of(result)} never left"
        if verdict == "PROVED"
        else f"{name}: no set is proved that is never left"
    )
    grid = Table.grid(padding=(0, 2))
    grid.add_column(style="dim", no_wrap=True)
    grid.add_column(overflow="fold")
    for label, value in _rows(result):
        grid.add_row(Text(label), Text(value))
    return Group(Text.assemble((verdict, _COLOURS[verdict]), "  ", (head, "bold")), Text(), grid, Text())


def _set_of(result: Mapping[str, Any]) -> str:
    return "boxes that are" if result["outer"] is None else f"{{N <= {result['outer']['level']:.6g}}} is"


def function_of(outer: Mapping[str, Any]) -> str:
    """N in words, an expression up to some length."""
    if outer["kind"] == "network":
        return f"network {'-'.join(map(str, outer['layers']))}"
    text = str(outer["expression"])
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."


def _rows(result: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    outer = result["outer"]
    if result["reason"] == "effort":
        yield "limited by", "the effort"
    elif result["reason"] not in ("requested", "done"):
        yield "reason", result["reason"]
    if result["learned"]:
        yield "learned", result["learned"]
    if outer is not None:
        yield "N", function_of(outer)
        kind = volume_name(len(result["states"]))
        yield kind, f"{outer['volume']:.4g}, estimated, standard deviation {outer['deviation']:.2g}"
        yield "leaves", f"{outer['leaves']:,}, of {outer['boxes']:,} boxes"
    if result["ranks"] is not None:
        yield from _boxes(result)
    if result["state"]:
        yield "holds", ", ".join(f"{name} = {value:.6g}" for name, value in result["state"].items())
    for name, words in result["constraints"].items():
        yield "kept", f"{name}: {words}, at {'every step' if result['time'] == 'discrete' else 'all times'}"
    if result["uncertain"]:
        yield "for every", ", ".join(f"{name} in [{lo}, {hi}]" for name, (lo, hi) in result["uncertain"].items())
    if result["nonlinearity"] is not None:
        yield "linear part", nonlinearity_in_words(result["nonlinearity"])
    if result["next"]:
        yield "try", " or ".join(result["next"])
    if result["checked"] is not None:
        both = ", and by the reference" if result["reference"] == "ACCEPTED" else ""
        yield "checked", f"{result['checked']}{both}"
    yield "seconds", ", ".join(f"{name} {value:.2g}" for name, value in result["seconds"].items())


def _boxes(result: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """The boxes that are never left, and how much that is."""
    ranks, simulated = result["ranks"], result["simulated"]
    yield volume_name(len(result["states"])), below(ranks["volume"])
    yield "share", f"{below(100 * ranks['covered'], 4)} % of the domain"
    if simulated is not None and simulated["share"] is not None:
        yield (
            "simulated",
            f"about {percent(simulated['share'])} of what stays {simulated['steps']:,} steps is proved",
        )
    back = steps_of(result, ranks["steps"])
    yield (
        "boxes",
        f"{ranks['proved']:,} of {ranks['leaves']:,} leaves; from each back into one of them in {back} at most",
    )
