"""The phrases for the placeholders `$name` in the words of a claim (claims.py), by the loop's timing and the rate."""

from __future__ import annotations

from collections.abc import Mapping

from certify.report.timing import TimingInWords


def phrases_of(timing: TimingInWords) -> Mapping[str, str]:
    """The text for each placeholder."""
    held = f" The input is held from each sampling instant to the next, over {timing.periods}." if timing.sample else ""
    return {
        **_when(timing),
        **_how_fast(timing),
        **_by_boxes(timing),
        "held": held,
        "each": timing.each(),
        "every": timing.each(proper=True),
    }


def _when(timing: TimingInWords) -> dict[str, str]:
    """The times at which a claim holds."""
    if timing.is_plain:
        return {
            "begins": "",
            "stays": "stays in it for all time",
            "also": " and",
            "enters": "enters the smaller set",
            "by": "in finite time",
            "remains": "stays there",
            "there": "stays there",
            "at": "",
            "over": "",
            "instants": "",
            "always": "",
            "between": "",
            "kept": "",
            "unique": ": solutions exist and are unique",
        }
    if timing.discrete:
        return {
            "begins": "",
            "stays": "is in it at every later step",
            "also": ", and",
            "enters": "is in the smaller set",
            "by": "after finitely many steps",
            "remains": "is there at every step",
            "there": "is there at every step from then on",
            "at": " at every step",
            "over": "",
            "instants": " step by step",
            "always": " at every step",
            "between": "",
            "kept": "",
            "unique": "",
        }
    always = timing.from_zero
    return {
        "begins": " at a sampling instant",
        "stays": "is in it at all later times" if always else "is in it at every later one, in the domain at all times",
        "also": ", and",
        "enters": "is in the smaller set",
        "by": "at some sampling instant",
        "remains": f"is there at {'all times' if always else 'every one'}",
        "there": f"is there at {'all times' if always else 'every sampling instant'} from then on",
        "at": " from each sampling instant on" if always else " at sampling instants",
        "over": f", the input held over {timing.periods}",
        "always": "" if always else " at every sampling instant",
        "instants": "" if always else " from one sampling instant to the next",
        "between": f" Between two instants V {'stays below its value at the first' if always else 'may rise'}.",
        "kept": f" Between two instants V {'stays below its value at the first, or c₀' if always else 'may rise'}.",
        "unique": ": between two sampling instants solutions are unique",
    }


def _by_boxes(timing: TimingInWords) -> dict[str, str]:
    """The phrases about boxes with ranks and about constraints."""
    if timing.discrete or timing.is_plain:
        return {
            "steps": "steps",
            "meanwhile": "",
            "always_kept": "at every step" if timing.discrete else "at all times",
        }
    return {"steps": "sampling instants", "meanwhile": ", at all times in between too", "always_kept": "at all times"}


def _how_fast(timing: TimingInWords) -> dict[str, str]:
    """The phrases about speed."""
    if not timing.rate:
        return {
            "fall": f"{timing.derivative}(x) < 0",
            "fast": "",
            "slow": "; how fast is not",
            "within": "in finite time",
            "later": "how soon, and what V does below c₀,",
            "speed": "Speed and cost.",
            "converge": "Trajectories converge; how fast, and at what cost, is not part of the claim.",
            "finite": "The time to reach {V ≤ c₀} is finite; how long, and at what cost, is not stated.",
        }
    at_least = f"at least as fast as e^(−2λt) with λ = {timing.shown_rate}"
    return {
        "fall": f"{timing.derivative}(x) + 2λV(x) < 0",
        "fast": f", {at_least},",
        "slow": "",
        "within": at_least,
        "later": "what V does below c₀",
        "speed": "Cost, and more speed.",
        "converge": "V falls at least at the rate λ; whether faster, and at what cost, is not part of the claim.",
        "finite": "The time to reach {V ≤ c₀} is bounded by the rate λ; whether it is shorter, and at what cost, "
        "is not stated.",
    }
