"""Small loops that go in steps, decay at a rate, or stay near a level, whose truth is known.

V is x'x on a ball alone (c1 = c2), unless a loop says otherwise. Multipliers are hints: they are balanced for the
models that the checker finds, and only decide whether something is accepted, never whether it is true.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np

from certify.checker.case import Case
from certify.checker.errors import Rejected
from certify.checker.local import Local
from tests.support.balls import centred, ones
from tests.support.certificates import Document, decode, edited, encode, grow, make, parse
from tests.support.jets import seen

TINY = 2.0**-40
WIDE = [("-99", "99")]


def fitted(data: Document, edge: float = 0.0, order: int = 1, wider: float = 1e-6) -> Document:
    """With the least ball that holds {V <= c1}, nearly, and multipliers that balance what the models leave."""
    P, c1 = decode(data["lyapunov"]["P"]), float.fromhex(data["levels"]["local"])
    n = round(len(P) ** 0.5)
    P = P.reshape(n, n)
    J = np.linalg.inv(np.linalg.cholesky(P / c1)).T * (1 + wider)
    data = edited(data, "evidence.local", centred(J, ones(n), edge=edge, order=order))
    rows = np.stack([np.full(n, TINY), np.full(n, TINY), np.ones(n)])
    try:
        with np.errstate(all="ignore"):
            local = Local.of(Case(parse(data)))
            G = seen(local.G(next(iter(local.case.cells))))
            A, Q, E = (np.array([getattr(g, part) for g in G]) for part in ("a", "Q", "E"))
            sizes = np.linalg.norm((J + float(local.case.c.step) * A).T @ P, axis=0)
            for row, parts in ((0, E), (1, Q)):
                found = np.linalg.norm(parts, axis=(1, 2)) / np.maximum(sizes, TINY)
                rows[row] = np.maximum(np.where(np.isfinite(found), found, 1.0), TINY)
    except Rejected:
        pass
    data["evidence"]["local"] = centred(J, rows, edge=edge, order=order)
    return data


def linear(dynamics: Any, gains: Any, level: Any = 1.0, **more: Any) -> Document:
    """Any equations under u = -gains x, in binary64 as they stand; scalar unless `more` says otherwise."""
    gains, levels = np.atleast_2d(gains), (level, level) if isinstance(level, float) else level
    n = gains.shape[1]
    options: dict[str, Any] = {
        "states": ["x", "y"][:n], "domain": WIDE * n, "input_bounds": [("-9999", "9999")], "squash": "identity",
        "centre": "none", **more,
    }  # fmt: skip
    P = options.pop("P", np.eye(n))
    return make(dynamics, [(gains, [0.0])], P, levels, **options)


def exactly(value: float) -> str:
    return str(Fraction(value))


# ------------------------------------------------------------------------------------------ loops with a known boundary


@dataclass(frozen=True)
class Family:
    """Claims by one number, true below `limit` (above it if `falls`), and how near to it one is accepted."""

    name: str
    limit: float
    claim: Callable[[float], Document]
    near: float = 0.005
    falls: bool = False

    def beyond(self, share: float) -> Document:
        """Past the limit by this share of it: false."""
        return self.claim(self.limit * (1 - share if self.falls else 1 + share))

    def within(self, share: float) -> Document:
        return self.claim(self.limit * (1 + share if self.falls else 1 - share))


def held_gain(a: float, b: float, h: str, order: int) -> Family:
    """x' = a x - b k x(t_k): |e^(a h) - k b (e^(a h) - 1)/a| < 1, largest k."""
    t = float(Fraction(h))
    grown, input_share = math.exp(a * t), math.expm1(a * t) / a if a else t
    limit = (grown + 1) / (b * input_share)

    def claim(k: float) -> Document:
        plant = [["+", ["*", exactly(a), "x"], ["*", exactly(b), "u"]]]
        return fitted(linear(plant, k, sample=(h, h)), order=order)

    return Family(f"held, a = {a}, b = {b}, h = {h}: largest gain", limit, claim, near=0.02)


def held_for(a: float, k: float, lo: str) -> Family:
    """The longest period, from a shortest one: x' = a x - k x(t_k)."""
    limit = 2 / k if a == 0 else math.log((k + a) / (k - a)) / a

    def claim(h: float) -> Document:
        plant = [["+", ["*", exactly(a), "x"], "u"]]
        hi = str(Fraction(h).limit_denominator(10**6))
        return fitted(linear(plant, k, sample=(hi if lo == "exact" else lo, hi)), order=5)

    return Family(
        f"held, a = {a}, k = {k}, from {lo}: longest period", limit, claim, near=0.02 if lo == "exact" else 0.3
    )


def discrete_gain(a: float, b: float, largest: bool) -> Family:
    """x+ = (a - b k) x."""
    limit = (a + 1) / b if largest else (a - 1) / b
    plant = [["+", ["*", exactly(a), "x"], ["*", exactly(b), "u"]]]
    return Family(
        f"discrete, a = {a}, b = {b}: {'largest' if largest else 'least'} gain",
        limit, lambda k: fitted(linear(plant, k, time="discrete")), falls=not largest,
    )  # fmt: skip


def rate_of(kind: str, k: float, h: str = "1") -> Family:
    """The largest rate: x' = -k x; x+ = (1 - k) x; x' = -k x(t_k)."""
    t = float(Fraction(h))
    limit = k if kind == "continuous" else (1 - (1 - k * t) ** 2) / (2 * t)
    plant = [["+", "x", "u"]] if kind == "discrete" else ["u"]
    more: dict[str, Any] = {"sample": (h, h)} if kind == "held" else {"time": kind}
    return Family(
        f"rate, {kind}, k = {k}, h = {h}", limit, lambda rate: fitted(linear(plant, k, rate=rate, **more)),
    )  # fmt: skip


def quantity(kind: str, k: float, cells: int, h: str = "1/4") -> Family:
    """The largest end of a range [0, end] of q: x' = q x - k x; x+ = q x + (1/4 - k) x; x' = (q - k) x(t_k)."""
    limit = k if kind != "discrete" else 0.75 + k
    plant = [["+", ["*", "q", "x"], "u"]]
    more: dict[str, Any] = {"time": kind}
    if kind == "discrete":
        plant = [["+", ["*", "q", "x"], ["/", "x", "4"], "u"]]
    elif kind == "held":
        more = {"sample": (h, h)}

    def claim(end: float) -> Document:
        return fitted(
            linear(plant, k, uncertain=[("q", "0", exactly(end))], cells=[cells], **more),
            order=1 + 3 * (kind == "held"),
        )

    return Family(f"range, {kind}, k = {k}, {cells} cells", limit, claim, near=0.1 if kind == "held" else 0.005)


def floor(kind: str, k: float, w: float, h: str = "1/4") -> Family:
    """The least r of {|x| <= r} that keeps x' = -k x + w; x+ = (1 - k) x + w; x' = -k x(t_k) + w(t), |w| <= w."""
    t = 1.0 if kind == "discrete" else float(Fraction(h))
    if kind == "continuous":
        limit, edge = w / k, k
    else:
        limit, edge = t * w / (1 - abs(1 - k * t)), (1 - abs(1 - k * t)) / t
    plant = [["+", "x", "u", "w"]] if kind == "discrete" else [["+", "u", "w"]]
    more: dict[str, Any] = {"sample": (h, h)} if kind == "held" else {"time": kind}

    def claim(r: float) -> Document:
        data = linear(
            plant,
            k,
            (r * r, 4 * r * r, 4 * r * r),
            claim="practical",
            uncertain=[("w", exactly(-w), exactly(w))],
            **more,
        )
        return fitted(data, edge=edge * (1 - 2.0**-40))

    return Family(f"floor, {kind}, k = {k}, w = {w}", limit, claim, falls=True)


def turning(share: float, h: str = "1/2") -> Family:
    """x' = y, y' = -g (x + 2 y)(t_k): the largest g for which V decreases, P from a smaller one."""
    t = float(Fraction(h))

    def step(g: float) -> np.ndarray:
        return np.array([[1 - t * t * g / 2, t - t * t * g], [-t * g, 1 - 2 * t * g]])

    A = step(share)
    P = np.linalg.solve(np.eye(4) - np.kron(A.T, A.T), np.eye(2).ravel()).reshape(2, 2)
    P = np.round(2**20 * (P + P.T)) / 2**21
    low, high = share, 20.0
    for _ in range(60):
        g = (low + high) / 2
        decreases = np.linalg.eigvalsh(step(g).T @ P @ step(g) - P)[-1] < 0
        low, high = (g, high) if decreases else (low, g)

    def claim(g: float) -> Document:
        plant = ["y", "u"]
        T = np.round(2**20 * np.linalg.inv(np.linalg.cholesky(P)).T) / 2**20
        return fitted(linear(plant, [[g, 2 * g]], sample=(h, h), P=P, T=T), order=3)

    return Family(f"turning, from {share}, h = {h}", low, claim, near=0.02)


def saturated(kind: str, c: float = 0.5, h: str = "1/8") -> Family:
    """x' = c x - tanh(x), x' = c x - tanh(x(t_k)), x+ = (1 + c) x - tanh(x) come nearer to 0 where tanh(x) > c x."""
    low, high = 1e-3, 1 / c
    for _ in range(80):
        middle = (low + high) / 2
        low, high = (middle, high) if math.tanh(middle) > c * middle else (low, middle)
    plant = [["+", ["*", exactly(1 + c if kind == "discrete" else c), "x"], "u"]]
    more: dict[str, Any] = {"sample": (h, h), "order": 3} if kind == "held" else {"time": kind}

    def claim(reach: float) -> Document:
        levels = (0.01, reach * reach)
        data = make(plant, [([[1.0]], [0.25])], 1.0, levels, domain=WIDE, **more)
        return grow(fitted(data, order=more.get("order", 1)), max_leaves=800, depth=14)

    return Family(f"saturated, {kind}", low, claim, near=0.02)


def moved(kind: str, c: float = 0.5, w: float = 0.0625, h: str = "1/8") -> Family:
    """The same with |w(t)| <= w and without a ball: the least r of {|x| <= r} that keeps it, tanh(r) = c r + w."""
    low, high = 1e-3, 1.0
    for _ in range(80):
        middle = (low + high) / 2
        low, high = (low, middle) if math.tanh(middle) > c * middle + w else (middle, high)
    plant = [["+", ["*", exactly(1 + c if kind == "discrete" else c), "x"], "u", "w"]]
    more: dict[str, Any] = {"sample": (h, h), "order": 3} if kind == "held" else {"time": kind}

    def claim(r: float) -> Document:
        levels, range_ = (r * r, 1.0), [("w", exactly(-w), exactly(w))]
        data = make(plant, [([[1.0]], [0.25])], 1.0, levels, domain=WIDE, claim="practical", uncertain=range_, **more)
        return grow(data, max_leaves=800, depth=14)

    return Family(f"moved, {kind}", low, claim, near=0.05, falls=True)


def bent_rate() -> Family:
    """x' = x^3/4 - x decays at the rate 1 - x^2/4, the least of which in {x^2 <= 1} is 3/4, on leaves."""
    plant = [["+", ["*", "1/4", ["**", "x", 3]], "u"]]
    return Family("bent, rate", 0.75, lambda rate: grow(fitted(linear(plant, 1.0, (0.01, 1.0), rate=rate)), 800, 14))


def peaked(peak: float) -> Document:
    """x+ = peak / (1 + 4 x^2) in discrete time, without a ball; {|x| <= 1/2} is kept if peak is below 1/2."""
    plant = [["+", ["/", exactly(peak), ["+", "1", ["*", "4", "x", "x"]]], ["*", "0", "u"]]]
    return grow(linear(plant, 0.0, (0.25, 1.0), claim="practical", time="discrete"), 400, 12)


def families() -> Iterator[Family]:
    for a, b, h, order in ((0.0, 1.0, "1/2", 2), (0.5, 2.0, "1/4", 5), (-1.0, 0.5, "1/4", 6), (1.0, 1.0, "1/8", 5)):
        yield held_gain(a, b, h, order)
    for a, k, lo in (
        (0.0, 2.0, "exact"),
        (0.25, 4.0, "exact"),
        (-0.5, 8.0, "exact"),
        (0.0, 1.0, "1/2"),
        (0.0, 2.0, "0"),
    ):
        yield held_for(a, k, lo)
    for a, b in ((1.5, 1.0), (1.25, 0.5), (3.0, -2.0)):
        yield discrete_gain(a, b, b > 0)
        yield discrete_gain(a, b, b < 0)
    yield from (rate_of("continuous", 1.5), rate_of("discrete", 0.25), rate_of("discrete", 1.5))
    yield from (rate_of("held", 1.0, "1/4"), rate_of("held", 3.0, "1/2"))
    yield from (quantity("continuous", 1.0, 1), quantity("continuous", 2.5, 3), quantity("discrete", 0.5, 1))
    yield from (quantity("discrete", 0.25, 2), quantity("held", 1.0, 1), quantity("held", 0.5, 4))
    yield from (floor("continuous", 1.0, 0.25), floor("continuous", 3.0, 0.5), floor("discrete", 0.5, 0.125))
    yield from (floor("discrete", 1.5, 0.25), floor("held", 2.0, 0.5), floor("held", 6.0, 0.25))
    yield from (turning(0.25), turning(0.5), saturated("held"), saturated("discrete"))
    yield from (moved("held"), moved("discrete"), bent_rate())


def with_multipliers(data: Document, change: Callable[[np.ndarray], Any]) -> Document:
    return edited(data, "evidence.local.multipliers", lambda text: encode(change(decode(text))))


def shares(count: int, generator: np.random.Generator) -> Sequence[float]:
    """Half of them below 5 %, down to a tenth of one; the others up to 100 %."""
    few = count - count // 2
    return [*np.geomspace(0.001, 0.049, few), *generator.uniform(0.06, 1.0, count // 2)]
