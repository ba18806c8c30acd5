"""Small loops with a set {N <= n2} beyond their ellipsoid, whose largest level, or gain, or range, is known.

Of one state the truth is a zero of F or an end of the domain; of two states it is algebra where F is linear and N
quadratic, and otherwise the least N among the points at which a fine search finds a violation.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from fractions import Fraction
from functools import cache
from typing import Any

import numpy as np

from tests.support.certificates import Document, edited, encode, grow, make
from tests.support.outer import Layers, Numbers, expression, finer, network, quadratic, wells, with_outer
from tests.support.stepped_loops import Family, exactly

SQUARE = ["**", "x", 2]
UNUSED = ["*", "0", "u"]
PLANE: dict[str, Any] = {"states": ("x", "y"), "squash": "identity", "centre": "none", "scale": [1.0]}
PLAIN: dict[str, Any] = {"squash": "identity", "centre": "none", "scale": [1.0], "input_bounds": [("-9", "9")]}
Step = Callable[[float], float]


def zero_of(f: Step, low: float, high: float) -> float:
    """Where f changes its sign between low and high, nearly."""
    for _ in range(200):
        middle = (low + high) / 2
        low, high = (middle, high) if (f(middle) > 0) == (f(low) > 0) else (low, middle)
    return low


# ----------------------------------------------------------------------------------------------------- inner ellipsoids


def saturated(c: float = 0.5, c2: float = 0.25, **more: Any) -> Document:
    """x' = c x - tanh(x) attracts |x| < x*, tanh(x*) = c x*."""
    return make([["+", ["*", exactly(c), "x"], "u"]], [([[1.0]], [0.0])], 1.0, (c2, c2), **more)


def edge_of(c: float = 0.5) -> float:
    return zero_of(lambda x: math.tanh(x) - c * x, 0.5, 1 / c)


def scalar(tree: Any, c2: float = 0.25, gain: float = 0.0, **more: Any) -> Document:
    """x' = tree, under u = gain x."""
    return make([tree], [([[gain]], [0.0])], 1.0, (c2, c2), **(PLAIN | more))


def planar(
    dynamics: Any, gains: Any, P: Any, c2: float, *, domain: Any = (("-2", "2"), ("-2", "2")), bound: str = "99",
    **more: Any,
) -> Document:  # fmt: skip
    """Two states under u = gains x."""
    options = PLANE | {"domain": domain, "input_bounds": [(f"-{bound}", bound)], "T": factor(P)} | more
    return make(dynamics, [(np.atleast_2d(gains), [0.0])], P, (c2, c2), **options)


def factor(P: Any) -> np.ndarray:
    """T with T'PT near to the unit matrix, of few digits."""
    return np.asarray(np.round(2**12 * np.linalg.inv(np.linalg.cholesky(np.asarray(P, dtype=float))).T) / 2**12)


def lyapunov(A: np.ndarray, Q: np.ndarray) -> np.ndarray:
    """P with A'P + PA = -Q, rounded to few digits."""
    n = len(A)
    P = np.linalg.solve(np.kron(A.T, np.eye(n)) + np.kron(np.eye(n), A.T), -Q.ravel()).reshape(n, n)
    return np.asarray(np.round(2**12 * (P + P.T)) / 2**13)


OSCILLATOR = np.array([[0.0, 1.0], [-1.0, -1.0]])
P_OSCILLATOR, M_OSCILLATOR = lyapunov(OSCILLATOR, np.diag([1.0, 3.0])), lyapunov(OSCILLATOR, np.eye(2))


def oscillator(c2: float = 0.25, **more: Any) -> Document:
    """x' = y, y' = u, u = -x - y."""
    return planar(["y", "u"], [[-1.0, -1.0]], P_OSCILLATOR, c2, **more)


# --------------------------------------------------------------------------------------------------------------- honest


def three_states() -> Document:
    """x' = -x + y/4, y' = -y - x/4, z' = u, u = -z: x^2 + 3/4 y^2 + 5/4 z^2 falls; 27/16 on a face."""
    data = make(
        [["+", ["-", "x"], ["/", "y", "4"]], ["-", ["-", "y"], ["/", "x", "4"]], "u"], [([[0.0, 0.0, -1.0]], [0.0])],
        np.eye(3), (0.25, 0.25), states=("x", "y", "z"), domain=[("-3/2", "3/2")] * 3,
        input_bounds=[("-3", "3")], squash="identity", centre="none", scale=[1.0],
    )  # fmt: skip
    return with_outer(data, expression(quadratic(np.diag([1.0, 0.75, 1.25])), 1.6))


def practical(kind: str = "practical") -> Document:
    """x' = -x + x^3/4 + u + w, |w| <= 1/16, around a level: x - x^3/4 = 1/16 at 1.968."""
    tree = ["+", ["-", "x"], ["/", ["**", "x", 3], "4"], "u", "w"]
    data = make(
        [tree], [([[0.0]], [0.0])], 1.0, (0.04, 0.25), claim=kind, uncertain=[("w", "-1/16", "1/16")], **PLAIN,
        tree=bytes([255]),
    )  # fmt: skip
    if kind == "nearby":
        data = edited(
            data,
            "evidence.contraction",
            {"J": encode([[0.2001]]), "weights": encode([0.01]), "weight": encode([[1.0]])},
        )
    return with_outer(grow(data), expression(SQUARE, 3.7))


def bent_walls() -> Document:
    """x' = -x + y/8, y' = u - x/8, u = -y, over wells in three directions, on a domain that is not symmetric."""
    dynamics = [["+", ["-", "x"], ["/", "y", "8"]], ["-", "u", ["/", "x", "8"]]]
    domain = (("-2", "5/2"), ("-9/4", "7/3"))
    data = planar(dynamics, [[0.0, -1.0]], np.eye(2), 0.25, domain=domain)
    N = wells([[1.0, 0.0], [-0.5, 0.875], [-0.5, -0.875]], 0.75)
    return finer(with_outer(data, network(N, -2.25)))


def van_der_pol() -> Document:
    """x' = -y, y' = x - (1 - x^2) y, backwards in time; N is not a quadratic form."""
    dynamics = [["-", "y"], ["+", "x", ["*", ["-", SQUARE, "1"], "y"], UNUSED]]
    A = np.array([[0.0, -1.0], [1.0, -1.0]])
    P = lyapunov(A, np.eye(2))
    data = planar(dynamics, [[0.0, 0.0]], P, 0.5, domain=(("-5/2", "5/2"), ("-3", "3")))
    N = ["+", quadratic(P), ["*", "-1/32", ["**", "x", 3], "y"], ["*", "1/64", ["**", ["*", "x", "y"], 2]]]
    return with_outer(data, expression(N, 2.0))


def ranged(q: str = "1/16") -> Document:
    """x' = -x + q x^3 + u, |q| <= 1/16: |x| < 4; the inner ellipsoid hardly knows of q."""
    tree = ["+", ["-", "x"], ["*", "q", ["**", "x", 3]], "u"]
    data = scalar(tree, uncertain=[("q", "-" + q, q)], domain=[("-5", "5")])
    return with_outer(data, expression(SQUARE, 15.0))


def bounded(bound: str = "3") -> Document:
    """x' = x + u, u = -2 x: |u| <= 3 where |x| <= 3/2, within a domain of 2."""
    data = scalar(["+", "x", "u"], gain=-2.0, input_bounds=[("-" + bound, bound)], domain=[("-2", "2")])
    return with_outer(data, expression(SQUARE, 2.2))


def clipped(limit: float = 0.5) -> Document:
    """x' = x/2 + 2 u, u = -x between -1/2 and 1/2: |x| < 2; the clip acts beyond the inner ellipsoid."""
    tree = ["+", ["/", "x", "2"], ["*", "2", "u"]]
    data = scalar(tree, c2=0.2, gain=-1.0, clip=([-limit], [limit]), input_bounds=[("-1", "1")])
    return with_outer(data, expression(SQUARE, 3.9))


def rotated() -> Document:
    """The oscillator with boxes that stand askew and have sides of different lengths."""
    data = oscillator(T=np.array([[0.5, 0.0], [0.0, 0.5]]))
    return with_outer(data, expression(quadratic(M_OSCILLATOR), 3.2), T=np.array([[0.75, -0.25], [0.5, 1.0]]))


BASES: dict[str, Callable[[], Document]] = {
    "square": lambda: with_outer(saturated(), expression(SQUARE, 3.6)),
    "quotient, askew": lambda: with_outer(  # x' = x^2 - x on [-5, 3/2], where 1 is at rest
        scalar(["+", ["-", "x"], SQUARE, UNUSED], 0.1, domain=[("-5", "3/2")]),
        expression(["/", SQUARE, ["-", "2", "x"]], 0.9),
    ),
    "pole": lambda: with_outer(saturated(), expression(["-", ["/", "1", SQUARE]], -0.28)),
    "root": lambda: with_outer(
        scalar(["+", ["-", "x"], ["/", ["**", "x", 3], "4"], "u"]), expression(["sqrt", ["-", SQUARE, "1/16"]], 1.9)
    ),
    "least elsewhere": lambda: with_outer(saturated(), expression(["**", ["+", "x", "1/4"], 2], 2.7)),
    "well": lambda: with_outer(saturated(), network(wells([[1.0]], 2.0), -1.2)),
    "deep well": lambda: with_outer(saturated(), network(deep(), 0.65)),
    "oscillator": lambda: with_outer(oscillator(), expression(quadratic(M_OSCILLATOR), 3.2)),
    "rotated": rotated,
    "walls": bent_walls,
    "van der Pol": van_der_pol,
    "range": ranged,
    "inputs": bounded,
    "clip": clipped,
    "practical": practical,
    "nearby": lambda: practical("nearby"),
    "three states": three_states,
}
WITH_NETWORK = ("well", "deep well", "walls")
WITH_EXPRESSION = tuple(name for name in BASES if name not in WITH_NETWORK)
PLANAR = ("oscillator", "rotated", "walls", "van der Pol")


def deep() -> Layers:
    """tanh of a well, two hidden layers, moved so that its values lie in [-1, 1] and rise with |x|."""
    (W1, b1), (W2, b2) = wells([[0.75]], 1.0)
    return [(W1, b1), (np.array(W2) * 2.0, np.array(b2) + 2.0), ([[1.0]], [0.0])]


@cache
def base(name: str) -> Document:
    """An honest certificate. Shared between tests, which edit copies only."""
    return BASES[name]()


# ------------------------------------------------------------------------------------------------ with a known boundary

SHAPES: dict[str, tuple[Any, Step]] = {  # that rise with |x|, if need be below 3 only
    "x^2": (SQUARE, lambda x: x * x),
    "x^2 - 10": (["-", SQUARE, "10"], lambda x: x * x - 10),
    "-1/x^2": (["-", ["**", "x", -2]], lambda x: -1 / (x * x)),
    "exp": (["exp", ["/", SQUARE, "4"]], lambda x: math.exp(x * x / 4)),
    "atan": (["atan", SQUARE], lambda x: math.atan(x * x)),
    "tanh": (["tanh", ["/", SQUARE, "4"]], lambda x: math.tanh(x * x / 4)),
    "sqrt": (["sqrt", ["+", "1", SQUARE]], lambda x: math.sqrt(1 + x * x)),
    "root with a hole": (["sqrt", ["-", SQUARE, "1/16"]], lambda x: math.sqrt(x * x - 1 / 16)),
    "-cos": (["-", ["cos", "x"]], lambda x: -math.cos(x)),
    "sin": (["sin", ["/", SQUARE, "8"]], lambda x: math.sin(x * x / 8)),
    "tan": (["tan", ["/", SQUARE, "8"]], lambda x: math.tan(x * x / 8)),
    "quotient": (["/", SQUARE, ["+", "1", SQUARE]], lambda x: x * x / (1 + x * x)),
    "sixth": (["**", "x", 6], lambda x: x**6),
}


def reaching(name: str, data: Document, N: Step, function: Callable[[float], Document], limit: float) -> Family:
    """Sets {N <= n2} by how far they reach, which is where F or the domain ends them."""
    return Family(name, limit, lambda r: with_outer(data, function(N(r)), max_leaves=150), near=0.02)


def of_shape(name: str, c: float = 0.5) -> Family:
    """x' = c x - tanh(x)."""
    tree, N = SHAPES[name]
    data = saturated(c, domain=[("-5", "5")] if c < 0.5 else [("-3", "3")])
    return reaching(f"{name}, c = {c}", data, N, lambda level: expression(tree, level), edge_of(c))


def of_wells(centre: float, c: float, scale: float = 1.0) -> Family:
    def N(x: float) -> float:
        return math.tanh(scale * x - centre) - math.tanh(scale * x + centre)

    layers = wells([[scale]], centre)
    return reaching(
        f"well at {centre}, {scale}, c = {c}", saturated(c), N, lambda level: network(layers, level), edge_of(c)
    )  # fmt: skip


def up_to_a_face(end: str) -> Family:
    """x' = -x, asked up to an end of the domain: what is above 1 is as near as binary64 comes to it, or nearer."""
    lo, hi = ("-" + end, "7") if len(end) % 2 else ("-7", end)
    data = scalar(["+", ["-", "x"], "u"], domain=[(lo, hi)])
    limit = float(Fraction(end))
    return reaching(f"face at {end}", data, lambda x: x * x, lambda level: expression(SQUARE, level), limit)


def by_gain(scale: float) -> Family:
    """x' = x/2 - k tanh(scale x) falls on 1/2 <= |x| <= 3/2 if k is large enough there: least at 3/2."""
    limit = 0.75 / math.tanh(1.5 * scale)

    def claim(k: float) -> Document:
        data = make(
            [["+", ["/", "x", "2"], "u"]],
            [([[scale]], [0.0])],
            1.0,
            (0.25, 0.25),
            scale=[-k],
            input_bounds=[("-9", "9")],
        )
        return with_outer(data, expression(SQUARE, 2.25), max_leaves=150)

    return Family(f"gain, {scale}", limit, claim, near=0.05, falls=True)


def by_range(power: int) -> Family:
    """x' = -x + q x^power, |q| <= end: end r^(power - 1) < 1 at r = 2."""
    tree = ["+", ["-", "x"], ["*", "q", ["**", "x", power]], "u"]

    def claim(end: float) -> Document:
        data = scalar(tree, uncertain=[("q", exactly(-end), exactly(end))])
        return with_outer(data, expression(SQUARE, 4.0), max_leaves=150)

    return Family(f"range, power {power}", 2.0 ** (1 - power), claim, near=0.05)


def by_bound(sign: int) -> Family:
    """The input's bound on one side: u = -2 x is 3 in magnitude at the ends of {N <= 9/4}."""

    def claim(end: float) -> Document:
        bounds = ("-4", exactly(end)) if sign > 0 else (exactly(-end), "4")
        data = scalar(["+", "x", "u"], gain=-2.0, input_bounds=[bounds], domain=[("-2", "2")])
        return with_outer(data, expression(SQUARE, 2.25), max_leaves=150)

    return Family(f"input, {sign}", 3.0, claim, near=0.02, falls=True)


def by_clip(rate: float) -> Family:
    """x' = x/2 + rate clip(-x) on |x| <= 2: rate times the clip's end must be above 1."""
    tree = ["+", ["/", "x", "2"], ["*", exactly(rate), "u"]]

    def claim(end: float) -> Document:
        data = scalar(tree, c2=0.04, gain=-1.0, clip=([-9.0], [end]), input_bounds=[("-9", "9")])
        return with_outer(data, expression(SQUARE, 4.0), max_leaves=150)

    return Family(f"clip, {rate}", 1 / rate, claim, near=0.05, falls=True)


def by_disturbance() -> Family:
    """x' = -x + x^3/4 + w on |x| <= 3/2: |w| below 3/2 - 27/32."""
    tree = ["+", ["-", "x"], ["/", ["**", "x", 3], "4"], "u", "w"]

    def claim(end: float) -> Document:
        data = make(
            [tree], [([[0.0]], [0.0])], 1.0, (1.21, 1.44), claim="practical",
            uncertain=[("w", exactly(-min(end, 0.7)), exactly(end))], **PLAIN,
        )  # fmt: skip
        return with_outer(grow(data), expression(SQUARE, 2.25), max_leaves=150)

    return Family("disturbance", 1.5 - 27 / 32, claim, near=0.05)


def linear_beyond(turn: float) -> Family:
    """x' = Ax, V falls, and N = x'Mx falls with M = P + s R for s up to some number, where A'M + MA is not definite."""
    A = np.array([[-1.0, turn], [-turn, -1.5]])
    R = np.array([[1.0, 0.0], [0.0, -0.5]])
    lowest = zero_of(lambda s: -np.linalg.eigvalsh(-(A.T @ (np.eye(2) + s * R) + (np.eye(2) + s * R) @ A))[0], 0.0, 1.9)

    def claim(s: float) -> Document:
        dynamics = [["+", *(["*", exactly(v), name] for v, name in zip(row, "xy", strict=True)), UNUSED] for row in A]
        data = planar(dynamics, [[0.0, 0.0]], np.eye(2), 0.25)
        return with_outer(data, expression(quadratic(np.eye(2) + s * R), 0.6), max_leaves=200)

    return Family(f"linear, {turn}", lowest, claim, near=0.05)


def linear_to_a_face(turn: float) -> Family:
    """x' = Ax with A'M + MA = -I: by the level, up to the lowest of N on the ends of the domain."""
    A = np.array([[-1.0, turn], [-turn, -0.5]])
    M = lyapunov(A, np.eye(2))
    domain = (("-2", "7/3"), ("-5/3", "2"))
    reach = np.array([4.0, 25 / 9])
    limit = float(np.min(reach / np.diag(np.linalg.inv(M))))

    def claim(level: float) -> Document:
        dynamics = [["+", *(["*", exactly(v), name] for v, name in zip(row, "xy", strict=True)), UNUSED] for row in A]
        data = planar(dynamics, [[0.0, 0.0]], np.eye(2), 0.25, domain=domain)
        return with_outer(data, expression(quadratic(M), level), max_leaves=200)

    return Family(f"linear to a face, {turn}", limit, claim, near=0.02)


def of_chance(seed: int) -> Family:
    """A loop of two states with cubic terms under a function N of chance, by the level: the limit is the least N at
    which a search finds a violation, and what is asked is where between N's least value and that the level lies."""
    generator = np.random.default_rng([17, seed])
    turn, cubic = generator.uniform(-1, 1), np.round(generator.uniform(-0.4, 0.7, (2, 2)) * 64) / 64
    dynamics = [
        ["+", ["-", name], ["*", exactly(round(sign * turn, 2)), other], ["*", exactly(a), ["**", name, 3]],
         ["*", exactly(b), name, ["**", other, 2]], *([UNUSED] if name == "x" else ["u"])]
        for name, other, sign, (a, b) in (("x", "y", 1, cubic[0]), ("y", "x", -1, cubic[1]))
    ]  # fmt: skip
    data = planar(dynamics, [[0.0, -0.25]], np.eye(2), 0.09, domain=(("-3/2", "3/2"), ("-4/3", "5/3")))
    if seed % 2:
        angles = generator.uniform(0, 1) + np.arange(3) * np.pi / 3
        directions = np.stack([np.cos(angles), np.sin(angles)], axis=1) * generator.uniform(0.8, 1.2, (3, 1))
        N = network(wells(directions, generator.uniform(0.5, 1.2, 3), generator.uniform(0.7, 1.3, 3)), 0.0)
    else:
        a, b = (Fraction(int(v), 64) for v in generator.integers(-12, 12, 2))
        N = expression(
            ["+", SQUARE, ["*", "5/4", "y", "y"], ["*", str(a), "x", "y"], ["*", str(b), "x", "y", "y"]], 0.0
        )
    least, most = span(edited(data, "claim.outer", N))

    def claim(share: float) -> Document:
        return with_outer(data, {**N, "level": (least + share * (most - least)).hex()}, max_leaves=200)

    return Family(f"chance {seed}", 1.0, claim, near=0.08)


def span(data: Document) -> tuple[float, float]:
    """The least N of all, and where condition 10 or 11 is violated, in binary64."""
    numbers = Numbers(edited(data, "claim.outer.level", (2.0**1000).hex()))
    grid = np.meshgrid(*(np.linspace(*ends, 301) for ends in numbers.domain), indexing="ij")
    x = np.array([axis.ravel() for axis in grid])
    N, edge = numbers.N(x), np.any((x == numbers.domain[:, :1]) | (x == numbers.domain[:, 1:]), axis=0)
    wrong = edge | ((numbers.V(x) >= numbers.c2) & (np.max(numbers.rises(x), axis=0) >= 0))
    return float(N.min()), float(N[wrong].min())


def families() -> Iterator[Family]:
    yield from map(of_shape, SHAPES)
    for c in (0.25, 0.75):
        yield of_shape("x^2", c)
        yield of_shape("-1/x^2", c)
    for centre, c, scale in ((2.0, 0.5, 1.0), (1.0, 0.5, 0.5), (4.0, 0.4, 2.0), (0.5, 0.75, 1.0)):
        yield of_wells(centre, c, scale)
    yield from map(up_to_a_face, ("1", "4/3", "5/7", "3/2", "10/3"))
    yield from map(by_gain, (1.0, 1.5, 2.0))
    yield from map(by_range, (2, 3, 5))
    yield from (by_bound(1), by_bound(-1), by_clip(1.0), by_clip(3.0), by_disturbance())
    yield from (linear_beyond(1.0), linear_beyond(2.0), linear_to_a_face(0.5), linear_to_a_face(2.0))
    yield from map(of_chance, range(10))
