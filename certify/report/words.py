"""Words of a report: names, units, ranges and numbers as people read them.

The terminal summary, the figures and the page share them; the words of each claim are in claims.py. Wherever a reader
could take a number for a bound it is rounded in a direction: `below` for a set's claimed size, `above` for a set that
contains it.
"""

from __future__ import annotations

import math
import re
import unicodedata
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from certify.loop.plants import System

MINUS, TIMES, ABSENT = "\N{MINUS SIGN}", "\N{MULTIPLICATION SIGN}", "\N{EN DASH}"
_LETTERS = "alpha beta gamma delta epsilon zeta eta theta kappa mu nu xi rho sigma tau phi chi psi omega"
_GREEK = {name: unicodedata.lookup(f"GREEK SMALL LETTER {name}") for name in _LETTERS.split()}
_SUBSCRIPTS = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")
_SUPERSCRIPTS = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")
_DOT = "\u0307"
PRACTICAL = frozenset({"practical", "nearby"})
"""The claims whose inner set is the one in which trajectories end."""
_ROUNDS_TO_ALL = 0.995
_SHORT, _LONGEST = 10, 24  # characters of an exact number that is written as it is: among others, and alone
_A_GAIN = ((0.05, ": a gain does nearly the same"), (0.2, ""))
_NO_GAIN = ": its own gain does not do the same"
"""Conclusions for a reader, by the rms."""
_MOST = 2.0  # of it that is said as a share


def symbol(name: str) -> str:
    """A name as a symbol: Greek letters, subscripts, a dot for `_dot`.

    >>> symbol("theta"), symbol("x1"), symbol("speed"), symbol("residual_x_dot"), symbol("th_dot")
    ('θ', 'x₁', 'speed', 'residual_x_dot', 'th_dot')
    """
    if name.endswith("_dot") and len(name) > len("_dot"):
        base = symbol(name.removesuffix("_dot"))
        several = any(c.isalpha() or c == "_" for c in base[1:])  # residual_theta_dot is no rate
        return name if several else base[:1] + _DOT + base[1:]
    match = re.fullmatch(r"([A-Za-z]+?)_?(\d*)", name)
    if match is None:
        return name
    letters, digits = match.groups()
    return _GREEK.get(letters, letters) + digits.translate(_SUBSCRIPTS)


def label(name: str, unit: str) -> str:
    """Symbol and unit of an axis."""
    shown = pretty_unit(unit)
    return f"{symbol(name)} ({shown})" if shown else symbol(name)


def quantity(value: float | Fraction, unit: str, digits: int = 6) -> str:
    """A number with its unit.

    >>> quantity(0.016, "m"), quantity(-2, "1")
    ('0.016 m', '−2')
    """
    return f"{number(float(value), digits)} {pretty_unit(unit)}".rstrip()


def deviation(name: str, x_eq: Fraction, unit: str) -> str:
    """Symbol and unit of an axis along which a state's deviation from its operating point is drawn.

    >>> deviation("h", Fraction(1, 100), "m"), deviation("h", Fraction(0), "m")
    ('h − 0.01 (m)', 'h (m)')
    """
    if not x_eq:
        return label(name, unit)
    value = number(float(abs(x_eq)))
    shifted, shown = f"{symbol(name)} {MINUS if x_eq > 0 else '+'} {value}", pretty_unit(unit)
    return f"{shifted} ({shown})" if shown else shifted


@dataclass(frozen=True, slots=True)
class Varying:
    """An uncertain quantity: it may take any value in [lo, hi], at any time."""

    name: str
    lo: Fraction
    hi: Fraction
    unit: str = ""

    @property
    def words(self) -> str:
        """The range as people read it, never wider than it is.

        >>> Varying("m", Fraction(27, 200), Fraction(33, 200), "kg").words
        'm(t) in [0.135, 0.165] kg'
        >>> Varying("wind", Fraction(-1, 3), Fraction(1, 3), "N").words
        'wind(t) within ±0.333333 N'
        """
        ends = f"within ±{below(self.hi)}" if self.lo == -self.hi else f"in {inside(self.lo, self.hi)}"
        return f"{symbol(self.name)}(t) {ends} {pretty_unit(self.unit)}".rstrip()


def varying_in(system: System) -> tuple[Varying, ...]:
    """The uncertain quantities of a plant, in its order."""
    return tuple(Varying(name, lo, hi, system.units.get(name, "")) for name, (lo, hi) in system.ranges.items())


def varying(quantities: Sequence[Varying]) -> str:
    """Several of them in a sentence: `m(t) in [0.135, 0.165] kg and torque(t) within ±0.05 N m`."""
    return listed([q.words for q in quantities])


def listed(words: Sequence[str]) -> str:
    """Words in a row, with `and` before the last.

    >>> listed(["a", "b", "c"]), listed(["a"])
    ('a, b and c', 'a')
    """
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


def inside(lo: Fraction, hi: Fraction) -> str:
    """`[lo, hi]` rounded inwards, in as many digits as keep the one end below the other.

    >>> inside(Fraction(1, 3), Fraction(2, 3)), inside(Fraction(1, 3), Fraction(1, 3) + Fraction(1, 10**8))
    ('[0.333334, 0.666666]', '[0.333333334, 0.333333343]')
    """
    for digits in range(6, 40):
        ends = [_value(q, digits, direction) for q, direction in ((lo, math.ceil), (hi, math.floor))]
        if ends[0] < ends[1]:
            return f"[{above(lo, digits)}, {below(hi, digits)}]"
    return f"[{lo}, {hi}]"


def outside(lo: Fraction, hi: Fraction) -> str:
    """`[lo, hi]` rounded outwards.

    >>> outside(Fraction(1, 3), Fraction(2, 3))
    '[0.333333, 0.666667]'
    """
    return f"[{below(lo)}, {above(hi)}]"


def _value(exact: Fraction, digits: int, direction: Callable[[Fraction], int]) -> Fraction:
    """The value that `_rounded` shows."""
    if exact == 0:
        return exact
    coefficient, last = _decimal(exact, digits, direction)
    return coefficient * Fraction(10) ** last


def stated_for(quantities: Sequence[Varying], statement: str, *, by_steps: bool = False) -> str:
    """A claim's statement for all that is uncertain, from step to step or in time; as it is where nothing is."""
    if not quantities:
        return statement
    which = "each any" if len(quantities) > 1 else "any"
    at_once = ", all of them at once" if len(quantities) > 1 else ""
    functions = "sequence of values from step to step" if by_steps else "measurable function of time"
    return (
        f"For every {varying(quantities)}, {which} {functions}{at_once} \N{EM DASH} constant, drifting "
        f"or jumping, whatever it is that moves it within its range \N{EM DASH} the following holds. {statement}"
    )


def held_at(system: System) -> str:
    """The values of what is uncertain at which a plant is simulated and linearised; nothing where all is exact."""
    nominal = {name: system.parameters.get(name, Fraction(0)) for name in system.ranges}
    each = [
        f"{symbol(n)} = {number(float(q))} {pretty_unit(system.units.get(n, ''))}".rstrip() for n, q in nominal.items()
    ]
    return listed(each) if each else ""


def at_rest(names: Sequence[str], x_eq: Sequence[Fraction], units: Sequence[str]) -> str:
    """The operating point in words; nothing where it is 0 in all states.

    Sets are said in deviations from it, which may be smaller than the sixth digit: it is exact where that is short, and
    has all digits of a float elsewhere.

    >>> at_rest(["h", "v", "a"], [Fraction(18, 17), Fraction(0), Fraction(0.1)], ["m", "m/s", ""])
    'h = 18/17 m, v = 0 m/s, a = 0.1'
    """
    values = [shortest(float(q)) if (short := if_short(q, _SHORT)) is None else _typeset(short) for q in x_eq]
    return _values(names, values, units) if any(x_eq) else ""


def point(names: Sequence[str], values: Sequence[float | Fraction], units: Sequence[str]) -> str:
    """A state in words, such as `p = 1.5 m, v = 0 m/s`; of a float the shortest decimal that reads back as it.

    >>> point(["p", "theta"], [1.5, -0.1], ["m", ""])
    'p = 1.5 m, θ = −0.1'
    """
    return _values(names, [shortest(float(v)) for v in values], units)


def place(asked: Mapping[str, str | Sequence[str]], units: Sequence[str]) -> str:
    """A state or a box in words, from exact numbers as text, or two of them.

    >>> place({"p": ["7/5", "8/5"], "theta": "-1/10"}, ["m", ""])
    'p = 1.4..1.6 m, θ = −0.1'
    """
    ends = [[v] if isinstance(v, str) else v for v in asked.values()]
    return _values(list(asked), ["..".join(shortest(float(Fraction(v))) for v in each) for each in ends], units)


def state_or_box(asked: Mapping[str, str | Sequence[str]]) -> str:
    """Names what was asked about: a box if it has an interval."""
    return "state" if all(isinstance(v, str) for v in asked.values()) else "box"


def _values(names: Sequence[str], values: Sequence[str], units: Sequence[str]) -> str:
    each = zip(names, values, units, strict=True)
    return ", ".join(f"{symbol(name)} = {v} {pretty_unit(unit)}".rstrip() for name, v, unit in each)


def pretty_unit(unit: str) -> str:
    """`m/s^2` as `m/s²`; nothing for 1, the unit of what has none."""
    return "" if unit == "1" else re.sub(r"\^(-?\d+)", lambda match: match.group(1).translate(_SUPERSCRIPTS), unit)


def volume_name(n: int) -> str:
    """The name of the n-dimensional volume."""
    return {1: "length", 2: "area"}.get(n, "volume")


def network_name(widths: Sequence[int]) -> str:
    """The name of a network without a squash.

    >>> network_name((2, 16, 1))
    'the 2-16-1 tanh network'
    """
    return f"the {'-'.join(map(str, widths))} tanh network"


def share_of_runs(found: Mapping[str, Any]) -> str:
    """The share of the simulated region that is proved, from a result's entry on it.

    >>> share_of_runs({"runs": 2000, "converging": 1063, "proved": 774, "share": 774 / 1063})
    'about 73 % of what converges is proved: 774 of the 1,063 states that do so in the domain, of 2,000 drawn'
    >>> share_of_runs({"runs": 2000, "converging": 50, "proved": 50, "clipped": 1063, "share": 1.0})[-82:]
    '; 1,013 more would converge if the policy were clipped at the bounds of its inputs'
    """
    proved, converging, runs = (f"{found[name]:,}" for name in ("proved", "converging", "runs"))
    about = f"about {percent(found['share'])} of what converges is proved"
    more = max(0, (found.get("clipped") or 0) - found["converging"])
    return f"{about}: {proved} of the {converging} states that do so in the domain, of {runs} drawn" + (
        f"; {more:,} more would converge if the policy were clipped at the bounds of its inputs" if more else ""
    )


def nonlinearity_in_words(found: Mapping[str, Any]) -> str:
    """The distance of a policy from the saturated linear feedback of its own gain, from a result's entry on it.

    >>> nonlinearity_in_words(
    ...     {"rms": 0.0312, "largest": 0.121, "bend": 0.2, "saturated": 0.0, "states": 1000, "fitted": False}
    ... )
    'the policy is within 13 % of its saturated linear part on the set, 3.1 % rms (bend 20 %, saturated at 0 %): \
a gain does nearly the same; sampled at 1,000 states, no part of the proof'
    >>> nonlinearity_in_words(
    ...     {"rms": 60.0, "largest": 81.0, "bend": 60.0, "saturated": 0.0, "states": 1000, "fitted": True}
    ... )
    'the policy departs from the nearest saturated linear feedback by more than that varies on the set: its own gain \
does not do the same; sampled at 1,000 states, no part of the proof'
    """
    rms, bend, saturated = (_percent(found[name]) for name in ("rms", "bend", "saturated"))
    part = "the nearest saturated linear feedback" if found["fitted"] else "its saturated linear part"
    sampled = f"; sampled at {found['states']:,} states, no part of the proof"
    if found["rms"] is None or found["rms"] > _MOST:  # a share of next to nothing says nothing
        return f"the policy departs from {part} by more than that varies on the set{_NO_GAIN}{sampled}"
    does = next((words for most, words in _A_GAIN if found["rms"] <= most), _NO_GAIN)
    near = f"the policy is within {_at_most(found['largest'])} of {part} on the set"
    return f"{near}, {rms} rms (bend {bend}, saturated at {saturated}){does}{sampled}"


def _percent(share: float | None) -> str:
    """A share in two digits, above 1 in whole per cent.

    >>> _percent(0.0312), _percent(0.9987), _percent(2.126), _percent(None)
    ('3.1 %', '99 %', '213 %', 'any share')
    """
    if share is None:
        return "any share"
    return f"{100 * share:.2g} %" if share < _ROUNDS_TO_ALL else percent(share)


def _at_most(share: float) -> str:
    """The same rounded up, as the words `is within` ask for.

    >>> _at_most(0.0374), _at_most(0.121), _at_most(0.9987), _at_most(1.124)
    ('3.8 %', '13 %', '99.9 %', '113 %')
    """
    return f"{math.ceil(100 * share)} %" if share >= 1 else f"{above(100 * share, 2 + (share > 0.99))} %"


def percent(share: float, digits: int = 0) -> str:
    """A share of 1 rounded to so many decimals of per cent; 100 % is all of it and nothing else.

    >>> percent(0.728), percent(1999 / 2000), percent(1.0), percent(0.99999, 1)
    ('73 %', '99 %', '100 %', '99.9 %')
    """
    shown = f"{100 * share:.{digits}f}"
    return f"{100 - 10.0**-digits:.{digits}f} %" if share < 1 and float(shown) == 100 else f"{shown} %"


def estimated(volume: float, deviation: float, unit: str) -> str:
    """A volume that samples give, with the standard deviation of the estimate.

    >>> estimated(3.14159, 0.0123, "m · m/s"), estimated(2.0, 0.0, "")
    ('about 3.142 m · m/s, estimated (standard deviation 0.013)', 'about 2, estimated (standard deviation 0)')
    """
    return f"about {number(volume, 4)} {unit}".rstrip() + f", estimated (standard deviation {above(deviation, 2)})"


def volume_unit(units: Sequence[str]) -> str:
    """Unit of the product of the states, or nothing if a state has none."""
    return " · ".join(filter(None, map(pretty_unit, units))) if all(units) and len(units) <= 3 else ""


def distinguished(names: Sequence[str]) -> list[str]:
    """Names of candidates, those that come again with their round.

    >>> distinguished(["optimised", "lqr", "optimised"])
    ['optimised, round 1', 'lqr', 'optimised, round 2']
    """
    counts, seen = Counter(names), Counter[str]()
    shown = []
    for name in names:
        seen[name] += 1
        shown.append(name if counts[name] == 1 else f"{name}, round {seen[name]}")
    return shown


def modes(fastest: float, slowest: float) -> str:
    """The decay of a loop's modes, from the real parts of its slowest and fastest eigenvalue, both negative.

    >>> modes(-16.8, -1.63), modes(-0.5, -0.5)
    ('the slowest decays at 1.63 per second (time constant 0.61 s), the fastest at 16.8 per second (0.06 s)', \
'all decay at 0.5 per second (time constant 2 s)')
    """
    slow, fast = ((number(-v, 3), number(-1 / v, 2)) for v in (slowest, fastest))
    if slow == fast:
        return f"all decay at {slow[0]} per second (time constant {slow[1]} s)"
    return (
        f"the slowest decays at {slow[0]} per second (time constant {slow[1]} s), the fastest at {fast[0]} per second "
        f"({fast[1]} s)"
    )


def number(value: float | None, digits: int = 6) -> str:
    """A number rounded to the nearest, for reading; a dash if it is absent.

    >>> number(1.25e-6), number(-2.5)
    ('1.25 × 10⁻⁶', '−2.5')
    """
    return ABSENT if value is None or math.isnan(value) else _typeset(f"{value:.{digits}g}")


def shortest(value: float) -> str:
    """The shortest decimal that reads back as this number.

    >>> shortest(0.1), shortest(-2.0), shortest(1e-9)
    ('0.1', '−2', '1 × 10⁻⁹')
    """
    return _typeset(repr(value).removesuffix(".0"))


def is_free(lo: Fraction | float, hi: Fraction | float) -> bool:
    """True if bounds are so far apart that they are none, as those of a network's result that equations use."""
    return bool(hi - lo >= 2**100)


def below(value: float | Fraction, digits: int = 6) -> str:
    """A number rounded down to so many digits: the decimal that is shown is not above the exact value.

    >>> below(7.1670597510), below(2e-7), below(Fraction(2, 3), 3)
    ('7.16705', '1.99999 × 10⁻⁷', '0.666')
    """
    return _rounded(value, digits, math.floor)


def above(value: float | Fraction, digits: int = 6) -> str:
    """A number rounded up to so many digits: the decimal that is shown is not below the exact value.

    >>> above(7.1670597510), above(0.5), above(Fraction(2, 3), 3)
    ('7.16706', '0.5', '0.667')
    """
    return _rounded(value, digits, math.ceil)


def _rounded(value: float | Fraction, digits: int, direction: Callable[[Fraction], int]) -> str:
    if isinstance(value, float) and not math.isfinite(value):
        return number(value, digits)
    exact = Fraction(value)
    if exact == 0:
        return "0"
    coefficient, last = _decimal(exact, digits, direction)
    text = str(abs(coefficient))
    exponent = last + len(text) - 1
    text = text.rstrip("0")
    if -5 < exponent < digits:  # as format code g does
        whole = text[: exponent + 1].ljust(exponent + 1, "0") if exponent >= 0 else "0"
        fraction = text[exponent + 1 :] if exponent >= 0 else "0" * (-exponent - 1) + text
        shown = whole + ("." + fraction if fraction else "")
    else:
        shown = text[0] + ("." + text[1:] if text[1:] else "") + f"e{exponent}"
    return _typeset(("-" if coefficient < 0 else "") + shown)


def _decimal(exact: Fraction, digits: int, direction: Callable[[Fraction], int]) -> tuple[int, int]:
    """(coefficient, exponent of ten) of a nonzero number rounded to so many digits."""
    size = abs(exact)
    exponent = len(str(size.numerator)) - len(str(size.denominator))  # of the leading digit, or one more
    exponent -= Fraction(10) ** exponent > size
    last = exponent - digits + 1
    return direction(exact / Fraction(10) ** last), last


def if_short(value: Fraction, most: int = _LONGEST) -> str | None:
    """A number without rounding, a decimal or a fraction that can be typed, in so many characters at most; None of
    another.

    >>> if_short(Fraction(-1, 10)), if_short(Fraction(1, 3)), if_short(Fraction(314159, 10**5)), if_short(Fraction(0.1))
    ('-0.1', '1/3', '3.14159', None)
    """
    shown = f"{float(value):.6g}", repr(float(value)), str(value)
    return next((text for text in shown if len(text) <= most and Fraction(text) == value), None)


def exact_number(value: Fraction) -> str:
    """A number without rounding: a decimal where a short one is it, else a fraction.

    >>> exact_number(Fraction(1, 50)), exact_number(Fraction(1, 3)), exact_number(Fraction(2))
    ('0.02', '1/3', '2')
    """
    shown = shortest(float(value))
    return shown if Fraction(repr(float(value))) == value else str(value)


def kept_apart(value: float, limit: Fraction) -> str:
    """`value < limit`, the value rounded up and the limit down, in as many digits as keep the one below the other.

    >>> kept_apart(1.9999999, Fraction(2)), kept_apart(1.0, Fraction(2))
    ('1.9999999 < 2', '1 < 2')
    """
    if 0 < value < limit:
        for digits in range(6, 30):
            (a, at), (b, below_at) = _decimal(Fraction(value), digits, math.ceil), _decimal(limit, digits, math.floor)
            if a * Fraction(10) ** at < b * Fraction(10) ** below_at:
                return f"{above(value, digits)} < {below(limit, digits)}"
    return f"{above(value)}, domain {below(limit)}"


def _typeset(text: str) -> str:
    mantissa, e, exponent = text.partition("e")
    power = f" {TIMES} 10{str(int(exponent)).translate(_SUPERSCRIPTS)}" if e else ""
    return mantissa.replace("-", MINUS) + power


def seconds(value: float | None) -> str:
    """A duration; a dash if it is absent."""
    return ABSENT if value is None else f"{value:.2f} s" if value >= 0.095 else f"{value * 1000:.0f} ms"


def inner_level(kind: str, value: float | Fraction, digits: int = 6) -> str:
    """The inner level rounded to the safe side: down where something is claimed inside it, up where outside."""
    return above(value, digits) if kind in PRACTICAL else below(value, digits)
