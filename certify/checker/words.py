"""The claim in words and numbers; what is printed is what was parsed."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

from .document import Certificate

CLAIMS = {
    "asymptotic": "the origin is asymptotically stable, and every trajectory of the closed loop that starts in "
    "V <= {c.c2!r} stays there and converges to the origin",
    "practical": "every trajectory of the closed loop that starts in V <= {c.c2!r} stays there, enters "
    "V <= {c.c1!r} in finite time and stays there from then on; nothing is claimed about what happens inside "
    "V <= {c.c1!r}, and the origin need not be an equilibrium",
}


def claim(c: Certificate) -> list[str]:
    """The plant, the policy, V, and what is claimed of them, line by line."""
    widths = [len(c.states), *map(len, c.policy.weights)]
    inputs = zip(c.inputs, c.input_bounds, c.u_eq, strict=True)
    return [
        f"plant {c.name}: xdot = f(x, u), states ({', '.join(c.states)}), inputs ({', '.join(c.inputs)})",
        *(f"  {name}' = {expression(tree)}" for name, tree in zip(c.states, c.dynamics.trees, strict=True)),
        *(f"  domain {name} in {_interval(pair)}" for name, pair in zip(c.states, c.domain, strict=True)),
        *(f"  input {name} in {_interval(pair)}, u_eq = {_number(u)}" for name, pair, u in inputs),
        f"policy {'-'.join(map(str, widths))} tanh, squash {c.policy.squash}, centred by {c.policy.centre}, "
        f"sha256 {c.policy.sha256()}",
        "V(x) = x'Px with P = " + "; ".join(" ".join(repr(float(v)) for v in row) for row in c.P),
        f"claim: {CLAIMS[c.claim].format(c=c)}; u stays in its bounds",
    ]


def expression(tree: Any) -> str:
    """A tree of the grammar, with all its brackets."""
    if isinstance(tree, str):
        if tree[0].isalpha() or tree[0] == "_":
            return tree
        q = Fraction(tree)
        return str(q) if q >= 0 and q.denominator == 1 else f"({q})"
    name, *rest = tree
    if name == "**":
        return f"({expression(rest[0])}**{rest[1]})"
    words = [expression(operand) for operand in rest]
    if name in ("sin", "cos", "tan"):
        return f"{name}({words[0]})"
    return f"(-{words[0]})" if name == "-" and len(words) == 1 else f"({f' {name} '.join(words)})"


def _interval(pair: tuple[Fraction, Fraction]) -> str:
    return f"[{_number(pair[0])}, {_number(pair[1])}]"


def _number(q: Fraction) -> str:
    return str(q) if q.denominator == 1 or len(str(q)) > 40 else f"{q} (about {float(q):.6g})"
