"""Names, units and numbers as people read them. Shared by the terminal summary, the figures and the page."""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Sequence
from typing import TYPE_CHECKING

from certify.errors import CertifyError

if TYPE_CHECKING:
    from certify.systems import System

MINUS, TIMES, ABSENT = "\N{MINUS SIGN}", "\N{MULTIPLICATION SIGN}", "\N{EN DASH}"
_LETTERS = "alpha beta gamma delta epsilon zeta eta theta kappa mu nu xi rho sigma tau phi chi psi omega"
_GREEK = {name: unicodedata.lookup(f"GREEK SMALL LETTER {name}") for name in _LETTERS.split()}
_SUBSCRIPTS = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")
_SUPERSCRIPTS = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")
_DOT = "\u0307"


def symbol(name: str) -> str:
    """A name as a symbol: Greek letters, subscripts, a dot for `_dot`.

    >>> symbol("theta"), symbol("x1"), symbol("speed")
    ('θ', 'x₁', 'speed')
    """
    if name.endswith("_dot") and len(name) > len("_dot"):
        base = symbol(name.removesuffix("_dot"))
        return base[:1] + _DOT + base[1:]
    match = re.fullmatch(r"([A-Za-z]+?)_?(\d*)", name)
    if match is None:
        return name
    letters, digits = match.groups()
    return _GREEK.get(letters, letters) + digits.translate(_SUBSCRIPTS)


def label(name: str, unit: str) -> str:
    """Symbol and unit of an axis."""
    return f"{symbol(name)} ({pretty_unit(unit)})" if unit else symbol(name)


def pretty_unit(unit: str) -> str:
    """`m/s^2` as `m/s²`."""
    return re.sub(r"\^(-?\d+)", lambda match: match.group(1).translate(_SUPERSCRIPTS), unit)


def registered(name: str) -> System | None:
    """The plant of that name that ships with certify, or None."""
    from certify.systems import available_systems, get_system

    try:
        return get_system(name) if name in available_systems() else None
    except CertifyError:
        return None


def units_of(system: System) -> dict[str, str]:
    """Units of states and inputs; a certificate has none, so they come from the shipped plant of the same name."""
    if system.units:
        return dict(system.units)
    shipped = registered(system.name)
    if shipped is None or (shipped.states, shipped.inputs) != (system.states, system.inputs):
        return {}
    return dict(shipped.units)


def volume_name(n: int) -> str:
    """What the n-dimensional volume is called."""
    return {1: "length", 2: "area"}.get(n, "volume")


def volume_unit(units: Sequence[str]) -> str:
    """Unit of the product of the states, or nothing if a state has none."""
    return " · ".join(pretty_unit(u) for u in units) if all(units) and len(units) <= 3 else ""


def number(value: float | None, digits: int = 6) -> str:
    """A number rounded for reading; a dash if it is absent.

    >>> number(1.25e-6), number(-2.5)
    ('1.25 × 10⁻⁶', '−2.5')
    """
    return ABSENT if value is None or math.isnan(value) else _typeset(f"{value:.{digits}g}")


def below(value: float, digits: int = 6) -> str:
    """A positive number rounded towards zero, for levels: the text never says more than was proved.

    >>> below(7.1670597510)
    '7.16705'
    """
    if not (math.isfinite(value) and value > 0):
        return number(value, digits)
    text = f"{value:.{digits}g}"
    if float(text) > value:
        unit = 10.0 ** (math.floor(math.log10(value)) - digits + 1)
        text = f"{float(text) - unit:.{digits}g}"
    return _typeset(text)


def _typeset(text: str) -> str:
    mantissa, e, exponent = text.partition("e")
    power = f" {TIMES} 10{str(int(exponent)).translate(_SUPERSCRIPTS)}" if e else ""
    return mantissa.replace("-", MINUS) + power


def seconds(value: float | None) -> str:
    """A duration; a dash if it is absent."""
    return ABSENT if value is None else f"{value:.2f} s" if value >= 0.095 else f"{value * 1000:.0f} ms"
