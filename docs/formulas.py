"""Formulas of the site as MathML, which browsers typeset without help.

Arithmatex keeps what stands between dollars from the rest of Markdown, which would take `\\{` for an escaped brace, and
puts it into an element of its own. What latex2mathml makes of it is touched up here where browsers would space it as no
book does.
"""

from __future__ import annotations

import html
import re
from typing import Any

from latex2mathml.converter import convert

_FORMULA = re.compile(
    r'(?P<before>[(\[]?)<(?P<tag>span|div) class="arithmatex">\\[(\[]\s*(?P<tex>.*?)\s*\\[)\]]</(?P=tag)>'
    r"(?P<behind>[^\s<]*)",
    re.S,
)
_THIN = "0.167em"
_LEFT = r"&#x(?:00028|0007B|0002C|0003C|0003D|0003E|02264|02265);</mo>|[(\[]</mo>|<mspace[^>]*>"
_PRIME = r"&#x0(?:203[234]|2057);"
_TOUCHES = (
    # Not letters: "{x : V(x) ≤ c}", "E ⪰ 0", "a ± b"; at the end of an index the colon is one. Letters: infinity, dots.
    (r"<mi>(:|&#x02AB0;)</mi>(?=<m)", r'<mo lspace="0.278em" rspace="0.278em">\1</mo>'),
    (r"<mi>(&#x000B1;)</mi>", r"<mo>\1</mo>"),
    (r"<mo>(&#x0221E;|&#x02026;)</mo>", r"<mi>\1</mi>"),
    # A word is a name and no remark, beside which operators would get no room.
    (r"<mtext>([a-z]+)</mtext>", r"<mi>\1</mi>"),
    # Bars and slashes are operators to a browser unless it is told otherwise, and get room on both sides.
    (r"<mo[^>]*>(?=(?:&#x0007C;|&#x02016;|&#x0002F;)</mo>)", '<mo stretchy="false" lspace="0" rspace="0">'),
    # A minus after a bracket, a relation, a comma or a space is a sign.
    (rf"({_LEFT})<mo>(?=&#x02212;|&#x000B1;)", r'\1<mo form="prefix">'),
    # The dot of a derivative is as large as the letter, and primes stand as high as in a text.
    (r"<mo>(?=[^<]*</mo></mover>)", '<mo scriptlevel="0">'),
    (rf"<msup>(<mi>[^<]*</mi>)<mi>({_PRIME})</mi></msup>", r'\1<mo lspace="0" rspace="0">\2</mo>'),
    (r"<mtext>(?=\(\d+\)</mtext>)", '<mspace width="2em"/><mtext>'),  # a formula's number
)
_FUNCTION = re.compile(
    r"(?P<factor></m(?:i|n|text|frac|sub|sup|subsup)>|&#x00029;</mo>)?(?P<base><m(?:sub|sup)>)?"
    r"<m[io][^>]*>(?P<name>sin|cos|tan|tanh|atanh|exp|ln|log|min|max|sup|det|clip)</m[io]>"
    rf"(?P<close>(?:<m[in]>[^<]*</m[in]></msu[bp]>)?(?:<mo[^>]*>(?:&#x0002[89];|[()]|{_PRIME})|</mrow></math>))?"
)


def on_page_content(content: str, **_: Any) -> str:
    """The page with its formulas as MathML."""
    return _FORMULA.sub(_placed, content)


def _placed(formula: re.Match[str]) -> str:
    """A formula as MathML, with what a line's end may not part from it: a bracket before, a comma behind."""
    text = mathml(html.unescape(formula["tex"]), display=formula["tag"] == "div")
    if formula["before"] or formula["behind"]:
        return f'<span class="unparted">{formula["before"]}{text}{formula["behind"]}</span>'
    return text


def mathml(formula: str, display: bool) -> str:
    """MathML of a formula in TeX, in a line of its own or within a text."""
    text = convert(formula, display="block" if display else "inline")
    for pattern, replacement in _TOUCHES:
        text = re.sub(pattern, replacement, text)
    return _FUNCTION.sub(_spaced, text)


def _spaced(function: re.Match[str]) -> str:
    """A function's name with room between it and what it is multiplied by or applied to, unless that is in brackets."""
    factor, base, close = (function[group] or "" for group in ("factor", "base", "close"))
    before, behind = _THIN if factor else "0", "0" if close else _THIN
    return f'{factor}{base}<mo lspace="{before}" rspace="{behind}">{function["name"]}</mo>{close}'
