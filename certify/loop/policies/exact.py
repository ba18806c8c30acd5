"""Exact consequences of a policy's form, decided in rationals: the bounds of its inputs, and pi(0)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from fractions import Fraction

import numpy as np

from certify.errors import InputError
from certify.loop.activations import ACTIVATIONS
from certify.loop.expressions import Expression, Symbol, value_if_rational
from certify.loop.networks import Affine, Algebra, Clip, Concat, Map, Observe, Product, Sum, repeated
from certify.loop.policies.network import PolicyNetwork

Exact = list[Fraction | None]
_READ = 24  # letters of a fraction that somebody reads
_NEAR = 1e-9
_MOST_BITS = 2**16  # of a number, beyond which it counts as unknown: sums of fractions grow from layer to layer


def bounded_by_form(network: PolicyNetwork, bounds: Sequence[tuple[Fraction, Fraction]]) -> bool:
    """True if squash, centring and clip keep every input in its bounds `(lo, hi)`, whatever the state.

    The clip comes last and is monotone: it maps a range [a, b] to the range between the clipped a and b. That need not
    lie in [a, b].
    """
    known = network.squash == "tanh" and network.centre != "output"
    middles, reaches = ([Fraction(float(v)) for v in end] for end in (network.offset, network.scale))
    ranges = [(o - abs(s), o + abs(s)) for o, s in zip(middles, reaches, strict=True)]
    if network.clip is not None:
        low, high = ([Fraction(float(v)) for v in end] for end in network.clip)
        limits = list(zip(low, high, strict=True))
        clipped = [tuple(min(max(v, lo), hi) for v in ends) for ends, (lo, hi) in zip(ranges, limits, strict=True)]
        ranges = [(a, b) for a, b in clipped] if known else limits
    elif not known:
        return False
    return all(lo <= a and b <= hi for (a, b), (lo, hi) in zip(ranges, bounds, strict=True))


def clipped_at(network: PolicyNetwork, bounds: Sequence[tuple[Fraction, Fraction]]) -> PolicyNetwork | None:
    """The policy that saturates at the inputs' bounds, in floats; None where its form keeps it within them."""
    if bounded_by_form(network, bounds):
        return None
    ends = np.array([[float(end) for end in ends] for ends in bounds])
    lo, hi = network.clip or (-math.inf, math.inf)
    clip = np.maximum(lo, ends[:, 0]), np.minimum(hi, ends[:, 1])
    return replace(network, clip=clip) if np.all(clip[0] < clip[1]) else None


def raw_at_origin(network: PolicyNetwork) -> tuple[Fraction | None, ...]:
    """raw(0) as rationals, (m,), x = 0 being the network's origin; None where a function has no rational value.

    A weight of exact 0 removes an unknown value.
    """
    h = _Rationals().run(network.network, [Fraction(float(v)) for v in network.origin])
    if network.squash == "tanh":
        h = [None if v is None else ACTIVATIONS["tanh"].exact(v) for v in h]
    return tuple(
        None if v is None else Fraction(float(s)) * v + Fraction(float(o))
        for v, s, o in zip(h, network.scale, network.offset, strict=True)
    )


class _Rationals(Algebra[Exact]):
    """Vectors of rationals, None for a number that rationals do not know."""

    def affine(self, step: Affine, v: Exact) -> Exact:
        return [_affine(row, v, float(c)) for row, c in zip(step.weight, step.bias, strict=True)]

    def map(self, step: Map, v: Exact) -> Exact:
        return [None if q is None else step.phi.exact(q) for q in v]

    def clip(self, step: Clip, v: Exact) -> Exact:
        ends = ([Fraction(float(e)) for e in end] for end in (step.lo, step.hi))
        return [None if q is None else min(max(q, lo), hi) for q, lo, hi in zip(v, *ends, strict=True)]

    def sum(self, step: Sum, *vectors: Exact) -> Exact:
        return [None if None in row else sum(q for q in row if q is not None) for row in zip(*vectors, strict=True)]

    def concat(self, step: Concat, *vectors: Exact) -> Exact:
        return [q for v in vectors for q in v]

    def product(self, step: Product, v: Exact, w: Exact) -> Exact:
        return [_product(p, q) for p, q in zip(*repeated(v, w), strict=True)]

    def observe(self, step: Observe, v: Exact) -> Exact:
        known = {s: q for s, q in zip(step.symbols, v, strict=True) if q is not None}
        unknown = [s for s in step.symbols if s not in known]
        return [_expression(e, known, unknown) for e in step.expressions]


def _product(p: Fraction | None, q: Fraction | None) -> Fraction | None:
    """Exact 0 removes what is unknown."""
    if p == 0 or q == 0:
        return Fraction(0)
    if p is None or q is None:
        return None
    value = p * q
    return None if max(value.numerator.bit_length(), value.denominator.bit_length()) > _MOST_BITS else value


def _expression(e: Expression, known: Mapping[Symbol, Fraction], unknown: Sequence[Symbol]) -> Fraction | None:
    try:
        value = value_if_rational(e, known, unknown)
    except InputError:  # it divides by 0, or the like
        return None
    return None if isinstance(value, str) else value


def at_origin(network: PolicyNetwork) -> tuple[Fraction | None, ...]:
    """pi(0) of a policy without centring as rationals, (m,); None where raw(0) is not known."""
    raw = raw_at_origin(network)
    if network.clip is None:
        return raw
    ends = ([Fraction(float(v)) for v in end] for end in network.clip)
    return tuple(None if v is None else min(max(v, lo), hi) for v, lo, hi in zip(raw, *ends, strict=True))


def require_centred(network: PolicyNetwork, u_eq: Sequence[Fraction], names: Sequence[str] = ()) -> None:
    """Refuse a policy whose `pi(0) = u_eq` does not hold exactly; `names` are what the message calls its inputs.

    Raises
    ------
    InputError : u_eq lies outside the squash's range (centre `preactivation`) or not strictly inside the clip, or
        pi(0) is another number or not a rational (centre `none`).
    """
    if network.centre == "preactivation":
        network.ratios(u_eq)
    if network.centre != "none":
        network.require_unclipped(u_eq)
        return
    for j, (value, u) in enumerate(zip(at_origin(network), u_eq, strict=True)):
        if value != u:
            named = f"input {names[j]}" if names else f"input {j}"
            found = _found(network, value, float(network(np.zeros(network.n), u_eq)[j]), float(u))
            raise InputError(
                f"the policy is not centred: pi(0), what it commands at the operating point, must be exactly "
                f"u_eq = {float(u):.12g}; its {named} is {found}. Shift it by the difference with "
                f"{_centrings(network, u_eq)}, or ask for less with --claim practical, which needs no rest there."
            )


def _found(network: PolicyNetwork, value: Fraction | None, about: float, wanted: float) -> str:
    """pi(0) of an input in words, `about` being it in floats."""
    if value is not None:
        exact = _short(value)
        return f"{float(value)!r}" + (f", exactly {exact}" if len(exact) <= _READ or float(value) == wanted else "")
    near = math.isclose(about, wanted, rel_tol=_NEAR, abs_tol=_NEAR)
    why = f"{_inside(network)} at the operating point gives no fraction"
    undecided = f", and whether exactly that cannot be decided: {why}" if near else ""
    return f"about {about:.9g}{undecided}"


def _inside(network: PolicyNetwork) -> str:
    """The parts of the network that rationals may not know."""
    return (
        " or ".join([*network.network.functions, *(["an observation"] if network.network.operations else [])]) or "tanh"
    )


def _centrings(network: PolicyNetwork, u_eq: Sequence[Fraction]) -> str:
    """The options that centre it: inside the squash only if u_eq is in its range."""
    reaches = zip(u_eq, network.scale.tolist(), network.offset.tolist(), strict=True)
    inside = network.squash == "tanh" and all(abs(float(u) - o) < abs(s) for u, s, o in reaches)
    return "--centre output" + " or --centre preactivation" * inside


def _affine(row: Sequence[float], h: Sequence[Fraction | None], bias: float) -> Fraction | None:
    total = Fraction(bias)
    for w, v in zip(row, h, strict=True):
        if w != 0 and v != 0:
            if v is None:
                return None
            total += Fraction(float(w)) * v
            if max(total.numerator.bit_length(), total.denominator.bit_length()) > _MOST_BITS:
                return None
    return total


def _short(q: Fraction) -> str:
    text = str(q)
    return text if len(text) <= 60 else "a longer fraction"
