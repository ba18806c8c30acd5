"""Equations as MathML, which browsers typeset without help: a plant's, and a function that is an expression.

It stands apart from the sections because two of them write equations. What comes out is marked as safe to stand in a
page as it is, so every name passes through escaping here.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import sympy

from certify.report.words import MINUS, symbol

_LONG = 10**6  # numerators and denominators beyond it are shown rounded


def typeset(left: str, expression: sympy.Expr, names: Sequence[sympy.Symbol]) -> Any:
    """`left = expression` as MathML, which browsers typeset without help."""
    from markupsafe import Markup
    from sympy.printing.mathml import MathMLPresentationPrinter

    # Markers first: a pretty name may be the plain name of another symbol.
    markers = {s: sympy.Symbol(f"NAME{k}NAME") for k, s in enumerate(names)}
    long = {v: sympy.Float(v, 8) for v in expression.atoms(sympy.Rational) if is_long(v)}
    text = MathMLPresentationPrinter().doprint(expression.xreplace(long).xreplace(markers))
    for k, s in enumerate(names):
        marker, name = f"<mi>NAME{k}NAME</mi>", identifier(s.name)
        close = f'<mo stretchy="false">(</mo>{name}<mo stretchy="false">)</mo>'  # or brackets grow beyond a letter
        text = text.replace(f"<mo>(</mo>{marker}<mo>)</mo>", close).replace(marker, name)
    text = text.replace("<mo>-</mo>", f"<mo>{MINUS}</mo>")
    text = text.replace("<mo>&InvisibleTimes;</mo>", '<mspace width="0.15em"/>')
    inner = text.removeprefix("<math>").removesuffix("</math>")
    return Markup(f'<math display="block">{left}<mo>=</mo>{inner}</math>')


def identifier(name: str) -> str:
    """A name in MathML; the dot of a derivative is set above, as large as the letter."""
    base = name.removesuffix("_dot")
    if base and base != name:
        return f'<mover>{identifier(base)}<mo scriptlevel="0">˙</mo></mover>'
    return f"<mi>{_escape(symbol(name))}</mi>"


def _escape(text: str) -> str:
    from markupsafe import escape

    return str(escape(text))


def is_long(value: sympy.Rational) -> bool:
    return max(abs(int(value.p)), int(value.q)) > _LONG
