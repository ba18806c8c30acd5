"""What follows exactly from a policy's form: the bounds of its inputs, and pi(0). Decided in rationals."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

from certify.errors import InputError
from certify.policies.network import TanhNetwork


def bounded_by_form(network: TanhNetwork, bounds: Sequence[tuple[Fraction, Fraction]]) -> bool:
    """True if squash and centring alone keep every input in its bounds `(lo, hi)`, whatever the state."""
    if network.squash != "tanh" or network.centre == "output":
        return False
    return all(
        lo <= Fraction(float(o)) - abs(Fraction(float(s))) and Fraction(float(o)) + abs(Fraction(float(s))) <= hi
        for o, s, (lo, hi) in zip(network.offset, network.scale, bounds, strict=True)
    )


def raw_at_origin(network: TanhNetwork) -> tuple[Fraction | None, ...]:
    """raw(0) as rationals, (m,); None where a tanh stands at another point than exact 0.

    A weight of exact 0 removes a value that is not known.
    """
    h: list[Fraction | None] = [Fraction(0)] * network.n
    last = len(network.weights) - 1
    for k, (W, b) in enumerate(zip(network.weights, network.biases, strict=True)):
        y = [_affine(row, h, float(c)) for row, c in zip(W, b, strict=True)]
        h = [_tanh(v) for v in y] if k < last or network.squash == "tanh" else y
    return tuple(
        None if v is None else Fraction(float(s)) * v + Fraction(float(o))
        for v, s, o in zip(h, network.scale, network.offset, strict=True)
    )


def require_centred(network: TanhNetwork, u_eq: Sequence[Fraction], names: Sequence[str] = ()) -> None:
    """Refuse a policy whose `pi(0) = u_eq` does not hold exactly; `names` are what the message calls its inputs.

    Raises
    ------
    InputError : u_eq lies outside the squash's range (centre `preactivation`), or raw(0) is another number or not a
        rational (centre `none`).
    """
    if network.centre == "preactivation":
        network.ratios(u_eq)
    if network.centre != "none":
        return
    for j, (value, u) in enumerate(zip(raw_at_origin(network), u_eq, strict=True)):
        if value != u:
            named = f"input {names[j]}" if names else f"input {j}"
            found = "not a rational number" if value is None else f"{float(value)!r}, exactly {_short(value)}"
            raise InputError(
                f"the policy is not centred: pi(0) must be exactly u_eq = {float(u)!r}; its {named} is {found}. "
                "Use centre 'output' or 'preactivation', or claim practical stability, which does not need it."
            )


def _affine(row: Sequence[float], h: Sequence[Fraction | None], bias: float) -> Fraction | None:
    total = Fraction(bias)
    for w, v in zip(row, h, strict=True):
        if w != 0 and v != 0:
            if v is None:
                return None
            total += Fraction(float(w)) * v
    return total


def _tanh(v: Fraction | None) -> Fraction | None:
    return v if v == 0 else None


def _short(q: Fraction) -> str:
    text = str(q)
    return text if len(text) <= 60 else "a longer fraction"
