"""Equations as MathML, which browsers typeset without help: a plant's, and a function that is an expression.

A page shows the proved tree. Only numbers are multiplied out, and terms that are the number 0 left out, as that of a
disturbance without a range; nothing else is merged or cancelled. The result is marked
as safe to insert in a page, so every name is escaped here.
"""

from __future__ import annotations

from decimal import Context, Decimal
from fractions import Fraction
from typing import Any

from certify.errors import InputError
from certify.loop.expressions import Expression, Number, Operation, Symbol, constant_of, nodes
from certify.loop.expressions.tree import ATOM, MINUS, POWER, PRODUCT, SUM, binding, decimal_text
from certify.report.words import MINUS as SIGN
from certify.report.words import symbol

_LONG = 10**6  # numerators and denominators beyond it are shown rounded
_DIGITS = 8  # of what is rounded
_SPACE, _DOT = '<mspace width="0.15em"/>', "<mo>·</mo>"


def typeset(left: str, expression: Expression) -> Any:
    """`left = expression` as MathML, which browsers typeset without help."""
    from markupsafe import Markup

    return Markup(f'<math display="block">{left}<mo>=</mo>{_row(multiplied_out(expression), SUM)}</math>')


def inequality(name: str, expression: Expression) -> Any:
    """`name: expression < 0` as MathML."""
    from markupsafe import Markup

    said = f"<mtext>{_escape(name)}:</mtext>{_SPACE}{_SPACE}{_SPACE}"
    below = f"{_row(multiplied_out(expression), SUM)}<mo>&lt;</mo><mn>0</mn>"
    return Markup(f'<math display="block">{said}{below}</math>')


def comparison(expression: Expression) -> Any:
    """`expression <= 0` as MathML; what is a difference as `a <= b`."""
    from markupsafe import Markup

    left: Expression
    right: Expression
    left, right = expression, Number(0)
    match expression:
        case Operation(operator="+", operands=(a, Operation(operator="-", operands=(b,)))):
            left, right = a, b
        case Operation(operator="-", operands=(a, b)):
            left, right = a, b
        case Operation(operator="+", operands=(a, Number(value=q))):
            left, right = a, Number(-q)
    each = f"{_row(multiplied_out(left), SUM)}<mo>&#x2264;</mo>{_row(multiplied_out(right), SUM)}"
    return Markup(f'<math display="block">{each}</math>')


def multiplied_out(expression: Expression) -> Expression:
    """The expression with each part that is a number replaced by that number, and without terms that are 0."""
    found: dict[Expression, Expression] = {}
    for node in nodes(expression):
        try:
            value = constant_of(node) if isinstance(node, Operation) else None
        except InputError:  # it has no value: shown as it is
            value = None
        if value is not None:
            found[node] = Number(value)
        elif isinstance(node, Operation):
            parts = [found[e] for e in node.operands]
            if node.operator == "+":  # one at least is no number
                parts = [part for part in parts if not (isinstance(part, Number) and part.value == 0)]
            found[node] = parts[0] if node.operator == "+" and len(parts) == 1 else Operation(node.operator, *parts)
        else:
            found[node] = node
    return found[expression]


def identifier(name: str) -> str:
    """A name in MathML; the dot of a derivative is set above, as large as the letter."""
    base = name.removesuffix("_dot")
    if base and base != name and "_" not in symbol(base):
        return f'<mover>{identifier(base)}<mo scriptlevel="0">˙</mo></mover>'
    return f"<mi>{_escape(symbol(name))}</mi>"


def is_long(value: Fraction) -> bool:
    """True if a number is shown rounded."""
    return max(abs(value.numerator), value.denominator) > _LONG


def _row(node: Expression, at_least: int) -> str:
    """A node, in brackets if it binds less than `at_least`."""
    inner = _written(node)
    if _binding(node) < at_least:
        inner = f"<mo>(</mo>{inner}<mo>)</mo>"
    return f"<mrow>{inner}</mrow>"


def _binding(node: Expression) -> int:
    """The precedence as in text, except that a fraction's bar makes brackets around a factor unnecessary."""
    if isinstance(node, Number):
        return MINUS if node.value < 0 else ATOM if _is_decimal(node.value) else POWER
    return POWER if isinstance(node, Operation) and node.operator == "/" else binding(node)


def _written(node: Expression) -> str:
    if isinstance(node, Symbol):
        return identifier(node.name)
    if isinstance(node, Number):
        return f"<mo>{SIGN}</mo>{_number(-node.value)}" if node.value < 0 else _number(node.value)
    if not isinstance(node, Operation):
        return ""
    first, *rest = node.operands
    match node.operator:
        case "+":
            return _row(first, SUM) + "".join(map(_term, rest))
        case "*":
            return _row(first, PRODUCT) + "".join(map(_factor, rest))
        case "/":
            return f"<mfrac>{_row(first, SUM)}{_row(rest[0], SUM)}</mfrac>"
        case "-":
            return f"<mo>{SIGN}</mo>{_row(first, POWER)}"
        case "**":
            return f"<msup>{_row(first, ATOM)}<mrow>{_written(Number(node.exponent))}</mrow></msup>"
        case "sqrt":
            return f"<msqrt>{_row(first, SUM)}</msqrt>"
        case "abs":
            return f"<mo>|</mo>{_row(first, SUM)}<mo>|</mo>"
    still = ' stretchy="false"' if isinstance(first, Symbol) else ""  # or brackets grow beyond a letter
    given = "<mo>,</mo>".join(_row(e, SUM) for e in node.operands)
    return f"<mi>{node.operator}</mi><mo{still}>(</mo>{given}<mo{still}>)</mo>"


def _term(node: Expression) -> str:
    """The node with the sign that joins it to a sum."""
    if isinstance(node, Operation) and node.operator == "-":
        inner = node.operands[0]
        negative = isinstance(inner, Operation) and inner.operator == "*" and _is_negative(inner.operands[0])
        return f"<mo>{SIGN}</mo>{_row(inner, POWER if negative else PRODUCT)}"
    if isinstance(node, Number) and node.value < 0:
        return f"<mo>{SIGN}</mo>{_number(-node.value)}"
    leading = node.operands[0] if isinstance(node, Operation) and node.operator == "*" else None
    if isinstance(leading, Number) and leading.value < 0:
        return f"<mo>{SIGN}</mo>{_row(Operation('*', Number(-leading.value), *node.operands[1:]), PRODUCT)}"
    return f"<mo>+</mo>{_row(node, PRODUCT)}"


def _is_negative(node: Expression) -> bool:
    return isinstance(node, Number) and node.value < 0


def _factor(node: Expression) -> str:
    return (_DOT if isinstance(node, Number) else _SPACE) + _row(node, POWER)


def _is_decimal(q: Fraction) -> bool:
    return is_long(q) or decimal_text(q) is not None


def _number(q: Fraction) -> str:
    """A number that is not negative: in digits where these are few, else as a fraction, else rounded."""
    short = decimal_text(q)
    if not is_long(q) and short is None:
        return f"<mfrac><mn>{q.numerator}</mn><mn>{q.denominator}</mn></mfrac>"
    if short is not None and len(short) <= 10:
        return f"<mn>{short}</mn>"
    rounded = Context(prec=_DIGITS).divide(Decimal(q.numerator), Decimal(q.denominator)).normalize()
    exponent = rounded.adjusted()
    if -5 < exponent < _DIGITS:
        return f"<mn>{rounded:f}</mn>"
    power = f"<msup><mn>10</mn><mrow>{_written(Number(exponent))}</mrow></msup>"
    return f"<mn>{rounded.scaleb(-exponent):f}</mn><mo>·</mo>{power}"


def _escape(text: str) -> str:
    from markupsafe import escape

    return str(escape(text))
