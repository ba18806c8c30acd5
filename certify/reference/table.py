"""The table of functions: all that this program knows of a function of one number is its row."""

from __future__ import annotations

from flint import arb, arb_series, fmpq

from .balls import ONE, ZERO
from .lines import Turn
from .rows import Atan, Exp, Function, Inverse, Sine, Sqrt, Tanh
from .smooth import Bumpy, Cornered, Smooth

# ------------------------------------------------------------------------------- formulas that lose no large numbers


def sigmoid(v: arb_series) -> arb_series:
    if v[0].mid() < 0:
        e = v.exp()
        return e / (1 + e)
    return 1 / (1 + (-v).exp())


def silu(v: arb_series) -> arb_series:
    return v * sigmoid(v)


def gelu(v: arb_series) -> arb_series:
    half = arb(fmpq(1, 2))
    if v[0].mid() < 0:
        return v * (v * -half.sqrt()).erfc() * half
    return v - v * (v * half.sqrt()).erfc() * half


def softplus(v: arb_series) -> arb_series:
    return (1 + v.exp()).log() if v[0].mid() < 0 else v + (1 + (-v).exp()).log()


def mish(v: arb_series) -> arb_series:
    """tanh(log w) is (w^2 - 1)/(w^2 + 1), with w = 1 + exp(v)."""
    if v[0].mid() < 0:
        e = v.exp()
        w = e * (e + 2)
        return v * w / (w + 2)
    e = (-v).exp()
    w = 1 + 2 * e
    return v * w / (w + 2 * e * e)


# ------------------------------------------------------------ turns of phi(y) - slope y: there phi' is the slope


def turns_of_sigmoid(slope: arb) -> list[Turn]:
    """At tanh(y/2) = r or -r, with 1 - r^2 = 4 slope."""
    r = (1 - 4 * slope).sqrt()
    y = 2 * ((1 + r) / (2 * slope.sqrt())).log()
    half, away = ONE / 2, r / 2 - slope * y
    return [(y, half + away), (-y, half - away)]


def turns_of_softplus(slope: arb) -> list[Turn]:
    """At sigmoid(y) = slope, where softplus(y) is -log(1 - slope)."""
    a, b = slope.log(), (1 - slope).log()
    return [(a - b, -slope * a - (1 - slope) * b)]


def turns_of_elu(slope: arb) -> list[Turn]:
    """At exp(y) = slope."""
    y = slope.log()
    return [(y, slope - 1 - slope * y)]


def turns_of_softsign(slope: arb) -> list[Turn]:
    """At (1 + |y|)^2 = 1/slope."""
    root = slope.sqrt()
    y, value = 1 / root - 1, (1 - root) * (1 - root)
    return [(y, value), (-y, -value)]


def at_corner(slope: arb) -> list[Turn]:
    return [(ZERO, ZERO)]


QUARTER = arb(fmpq(1, 4))
ROWS: tuple[Function, ...] = (
    *(Sine("sin"), Sine("cos"), Tanh(), Exp(), Atan(), Sqrt(), Inverse()),
    Cornered("abs", lambda v: -v, lambda v: v, abs, abs, -ONE, at_corner),
    Cornered("relu", lambda v: v * 0, lambda v: v, lambda y: y.max(ZERO), lambda q: max(q, fmpq(0)), ZERO, at_corner),
    Cornered(
        "elu",
        lambda v: v.exp() - 1,
        lambda v: v,
        lambda y: y.min(ZERO).expm1() + y.max(ZERO),
        lambda q: q if q >= 0 else None,
        ZERO,
        turns_of_elu,
        bend=arb(fmpq(1, 2)),
    ),
    Cornered(
        "softsign",
        lambda v: v / (1 - v),
        lambda v: v / (1 + v),
        lambda y: y / (1 + abs(y)),
        lambda q: q / (1 + abs(q)),
        ZERO,
        turns_of_softsign,
        ONE / 16,
        bend=ONE,
    ),
    Smooth("sigmoid", sigmoid, fmpq(1, 2), (250_000, 97_000, 125_000, 128_125, 250_000), QUARTER, turns_of_sigmoid),
    Smooth("softplus", softplus, None, (10**6, 250_000, 97_000, 125_000, 128_125), ONE, turns_of_softplus),
    Bumpy("silu", silu, (1_100_000, 500_100, 308_300, 500_100, 658_200)),
    Bumpy("gelu", gelu, (1_129_000, 798_000, 778_900, 1_596_000, 2_843_000)),
    Bumpy("mish", mish, (1_088_600, 644_300, 588_500, 1_102_000, 2_234_500)),
)
FUNCTIONS: dict[str, Function] = {row.name: row for row in ROWS}
