"""The next step where a search for boxes ends: before it is done, or without any."""

from __future__ import annotations

from dataclasses import replace

from certify.analysis.facts import Step
from certify.analysis.reaching.results import ReachResult
from certify.effort import Effort

_MORE, _MUCH = 4, 10  # times the effort, where some boxes are proved, and where none is


def with_following(result: ReachResult, effort: Effort) -> ReachResult:
    """The result with a step that goes on where its search ended, with this effort."""
    options, nothing = result.options, result.ranks is None
    why = f"{'nothing was proved yet' if nothing else 'more boxes were still found'} when the "
    if effort.is_short_of_time and options.time_limit is not None:
        step = Step((("--time-limit", f"{_MUCH * options.time_limit:g}"),), f"{why}time ended")
    elif nothing and options.effort >= 1 and (middle := _middle(result)) is not None:
        step = Step((("--from", middle),), f"{why}effort ended; a smaller box asks for less")
    else:
        step = Step((("--effort", f"{(_MUCH if nothing else _MORE) * options.effort:g}"),), f"{why}effort ended")
    return replace(result, following=step)


def without_boxes(result: ReachResult) -> ReachResult:
    """The result with the step after a search that found no box and had effort left."""
    middle = _middle(result)
    if result.begin is None:
        why = (
            "no box of the domain meets the target or leads there: see what the target says; --domain widens the domain"
        )
        return replace(result, following=Step((), why))
    if middle is None:
        why = "bounds of the runs from this state are too wide; a larger target asks for less"
        return replace(result, following=Step((), why))
    why = "bounds of the runs from this box are too wide, whatever the effort; a smaller one asks for less"
    return replace(result, following=Step((("--from", middle),), why))


def _middle(result: ReachResult) -> str | None:
    """The box with ends halfway to the middle of the one that was asked about; None if that is a state."""
    box = result.begin or {}
    if all(lo == hi for lo, hi in box.values()):
        return None
    halves = {name: (float(3 * lo + hi) / 4, float(lo + 3 * hi) / 4) for name, (lo, hi) in box.items()}
    return ",".join(f"{name}={lo:.12g}" + (f"..{hi:.12g}" if hi > lo else "") for name, (lo, hi) in halves.items())
