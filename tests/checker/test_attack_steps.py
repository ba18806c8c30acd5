"""Claims of loops with steps, levels, rates and contraction, each driven to the last value that the checker accepts.

That value is held against the truth, which closed forms give here for loops of one state, and integration over many
courses of what is uncertain for random ones. An accepted value beyond the truth is a hole; one far below it would make
the search blind, so that a least share of the truth is asked as well. Each search is shown to catch a rule that is
broken on purpose.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from functools import reduce
from typing import Any

import numpy as np
import pytest

from certify.checker import flow, local
from certify.checker import stepping as steps
from certify.checker.decrease import Inequality, Models
from certify.checker.jets import Jet
from certify.checker.near import ZERO
from certify.checker.ring import Ring
from certify.checker.taylor import upper_bound
from tests.support.certificates import Document, edited, encode, verdict
from tests.support.marks import slow_after
from tests.support.steps import stepping

LINEAR: list[tuple[Any, Any]] = [([[-3.0]], [0.0])]  # u = -3 x
WIDE = 1.5  # a factor by which a value is driven at first


def halved(depth: int) -> str:
    """The tree of one axis with 2^depth leaves of one size."""
    tree = reduce(lambda part, _: b"\x00" + part + part, range(depth), b"\xff")
    return base64.b64encode(tree).decode()


def loop(dynamics: Any, levels: tuple[float, ...], *, depth: int = 0, **more: Any) -> Document:
    """A loop of one state and V = x^2, with a tree of that depth instead of a ball where `edge` is None.

    On a ball it is linear in the state, so that multipliers next to 0 serve whether the claim is true or not.
    """
    settings = {"layers": LINEAR, "domain": [("-9", "9")], "input_bounds": [("-99", "99")], **more}
    data = stepping([dynamics], settings.pop("layers"), [[1.0]], levels, leaves=1, **settings)
    data["evidence"].setdefault("contraction", None)
    if data["evidence"]["local"] is not None:
        data["evidence"]["local"]["multipliers"] = encode([2.0**-30, 2.0**-30, 1.0])
    return edited(data, "evidence.tree", halved(depth)) if depth else data


def exactly(value: float) -> str:
    return str(Fraction(value))


def most(period: float) -> float:
    """The largest edge for a step."""
    k = 1 / period
    return k if Fraction(k) * Fraction(period) <= 1 else math.nextafter(k, 0.0)


@dataclass(frozen=True)
class Drive:
    """A claim that depends on a number; its conditions hold below `truth`, and not above."""

    claim: Callable[[float], Document]
    start: float
    truth: float
    share: float  # of the truth, which is accepted at least

    def last(self) -> float:
        """The largest value accepted, within a thousandth; nothing beyond ten times the truth is tried."""
        good, bad = self.start, 10 * self.truth
        if verdict(self.claim(good)) != "ACCEPTED":
            return 0.0
        while (t := min(good * WIDE, bad)) < bad and verdict(self.claim(t)) == "ACCEPTED":
            good = t
        bad = t
        while bad > good * 1.0005:
            t = math.sqrt(good * bad)
            good, bad = (t, bad) if verdict(self.claim(t)) == "ACCEPTED" else (good, t)
        return good


def held(t: float, lo: str | None = None) -> Document:
    """x' = x - 5 x(t_k): x is multiplied by 5 - 4 e^h, which is -1 at h = log(3/2)."""
    period = exactly(t)
    return loop(["+", "x", "u"], (1.0, 1.0), layers=[([[-5.0]], [0.0])], sample=(lo or period, period), order=8)


H = 0.125
FACTOR = 3 - 2 * math.exp(H)  # by which x' = x - 3 x(t_k) multiplies x over H
DISTURBED = ["+", "x", "u", "w"]  # for |w| <= 1 it ends at |x| <= 1/2, whatever the period
W = [("w", "-1", "1")]


def disturbed(t: float, **more: Any) -> Document:
    """To the level 1/t."""
    return loop(DISTURBED, (1 / t, 1.001 / t, 1.001 / t), sample=(exactly(H),) * 2, uncertain=W, order=4, **more)


def on_leaves(t: float, dynamics: Any, outer: float, **more: Any) -> Document:
    """To the level 1/t, without a ball."""
    return loop(dynamics, (1 / t, 1 / t, outer), edge=None, depth=9, **more)


DISCRETE: dict[str, Any] = {"discrete": True, "layers": [([[0.5]], [0.0])]}
DRIVES = {
    "a rate of steps": Drive(lambda t: loop("u", (1.0, 1.0), rate=t, **DISCRETE), 0.1, 0.375, 0.999),
    "a period": Drive(held, 0.05, math.log(1.5), 0.7),
    "any period up to": Drive(lambda t: held(t, "0"), 0.05, math.log(1.5), 0.4),
    "a rate of samples": Drive(
        lambda t: loop(["+", "x", "u"], (1.0, 1.0), rate=t, sample=(exactly(H),) * 2, order=8),
        0.1, (1 - FACTOR**2) / (2 * H), 0.99,
    ),
    "a level of flow": Drive(
        lambda t: loop(["+", ["-", "x"], "w", ["*", "0", "u"]], (1 / t, 1.5 / t, 1.5 / t), uncertain=W, edge=1.0),
        0.5, 1.0, 0.99,
    ),
    "a level of steps": Drive(
        lambda t: loop(["+", "u", ["*", "1/2", "w"]], (1 / t, 1.5 / t, 1.5 / t), uncertain=W, edge=0.5, **DISCRETE),
        0.5, 1.0, 0.99,
    ),
    "a level of samples": Drive(lambda t: disturbed(t, edge=(1 - FACTOR) / H), 1.5, 4.0, 0.7),
    "a level on leaves": Drive(
        lambda t: on_leaves(t, DISTURBED, 1.5, sample=(exactly(H),) * 2, uncertain=W, order=4), 1.5, 4.0, 0.6
    ),
    "a jump from within": Drive(  # |x| falls beyond 0.46, and 0 is taken to 0.6
        lambda t: on_leaves(t, ["*", "3/5", ["exp", ["-", ["*", "x", "x"]]], ["+", "1", ["*", "0", "u"]]], 1.5,
                            discrete=True),
        1.5, 1 / 0.36, 0.9,
    ),
    "a range": Drive(
        lambda t: loop(["+", ["*", "q", "x"], ["*", "0", "u"]], (1.0, 1.0), sample=(exactly(H),) * 2, order=4,
                       uncertain=[("q", str(-1 - Fraction(t)), str(Fraction(t) - 1))], cells=[4]),
        0.1, 1.0, 0.6,
    ),
    "a range that moves all": Drive(  # it ends at (t/3) / (1 - t/2), which is 1 at t = 6/5
        lambda t: loop(["+", ["-", ["*", "x", ["+", "1", ["*", "1/2", "q"]]]], ["*", "1/3", "q"], ["*", "0", "u"]],
                       (1.0, 1.1, 1.1), uncertain=[("q", exactly(-t), exactly(t))], cells=[8], edge=0.4),
        0.2, 1.2, 0.5,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", slow_after(6, DRIVES))
def test_nothing_is_accepted_beyond_the_truth(name: str) -> None:
    drive = DRIVES[name]
    assert drive.share * drive.truth <= drive.last() <= drive.truth


def in_steps_of_euler(dynamics: Any, constant: Any, states: Any, *rest: Any) -> Any:
    nothing = [constant(Fraction(0)) for _ in states]
    return [[v] for v in nothing], nothing


def without_the_square(ball: Any, models: Any) -> Any:
    return Inequality(models, *ball.terms)


def without_the_rate(ball: Any) -> Any:
    P, R, *rest = TERMS(ball)
    return P, 0 * R, *rest


def without_doubt(ball: Any, models: Any) -> Any:
    return INEQUALITY(ball, certain(models))


def from_any_level(ring: Ring, rise: Any, centre: Any, radius: Any) -> Any:
    gap = ring.gap(centre, radius, ring.c.c0, -1.0)
    return np.min([upper_bound(rise + gap.scaled(k)) for k in (0.0, 0.5, 1.0, 2.0, 4.0, 8.0)], axis=0)


TERMS, INEQUALITY = local.Local.terms.func, steps.Stepping.inequality
NO_RATE = property(without_the_rate)
BROKEN: dict[str, tuple[str, Any, str, Any]] = {
    "Euler's steps": ("a period", flow, "later", in_steps_of_euler),
    "no square of the step": ("a rate of steps", steps.Stepping, "inequality", without_the_square),
    "no rate": ("a rate of samples", local.Local, "terms", NO_RATE),
    "one corner": ("a range that moves all", Models, "corners", lambda models, P: iter([models])),
    "no doubt": ("a level of samples", steps.Stepping, "inequality", without_doubt),
    "any multiplier of the level": ("a jump from within", steps.StepRing, "bound_of_steps", from_any_level),
}


def certain(models: Models) -> Models:
    """Models whose errors of f and slacks of a are forgotten."""
    models.error = [0 * v for v in models.error]
    models.slack = [0 * v for v in models.slack]
    return models


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_rule_is_caught(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    drive, owner, rule, broken = BROKEN[name]
    monkeypatch.setattr(owner, rule, broken)
    assert DRIVES[drive].last() > DRIVES[drive].truth


# --------------------------------------------------------------------------------------------------------- contraction

# phi at which point, its parabola there as coefficients, the ball's radius, and the derivative of what is left
X = ["+", "1", "x"]
CURVES: dict[str, tuple[Any, tuple[str, str, str], float, Callable[[Any], Any]]] = {
    "sin": (["sin", "x"], ("0", "1", "0"), 1.0, lambda x: np.cos(x) - 1),
    "cos": (["cos", "x"], ("1", "0", "-1/2"), 1.0, lambda x: x - np.sin(x)),
    "tan": (["tan", "x"], ("0", "1", "0"), 0.5, lambda x: np.tan(x) ** 2),
    "tanh": (["tanh", "x"], ("0", "1", "0"), 0.5, lambda x: -(np.tanh(x) ** 2)),
    "exp": (["exp", "x"], ("1", "1", "1/2"), 1.0, lambda x: np.exp(x) - 1 - x),
    "atan": (["atan", "x"], ("0", "1", "0"), 0.5, lambda x: 1 / (1 + x * x) - 1),
    "cube": (["*", "x", "x", "x"], ("0", "0", "0"), 1.0, lambda x: 3 * x * x),
    "quartic": (["*", "x", "x", "x", "x"], ("0", "0", "0"), 1.0, lambda x: 4 * x * x * x),
    "inverse": (["/", "1", X], ("1", "-1", "1"), 0.75, lambda x: -1 / (1 + x) ** 2 + 1 - 2 * x),
    "root": (["sqrt", X], ("1", "1/2", "-1/8"), 0.96875, lambda x: 0.5 / np.sqrt(1 + x) - 0.5 + x / 4),
}


def closer(name: str, sign: int) -> Drive:
    """x' = -x / t +- what phi leaves of its parabola: the larger 1/t, the closer any two trajectories come."""
    phi, (c, b, a), radius, slope = CURVES[name]
    parabola = ["+", c, ["*", b, "x"], ["*", a, "x", "x"]]
    level = (radius * (1 - 2.0**-20)) ** 2
    x = np.linspace(-1, 1, 20001) * math.sqrt(level)
    steepest = float(np.max(sign * slope(x)))

    def claim(t: float) -> Document:
        left = ["+", ["*", exactly(-1 / t), "x"], ["*", str(sign), ["-", phi, parabola]], ["*", "0", "u"]]
        data = loop(left, (level, level, level), edge=None, depth=9)
        data["claim"]["kind"] = "nearby"
        weights = {"J": encode([[radius]]), "weights": encode([2.0**-40]), "weight": encode([[1.0]])}
        return edited(data, "evidence.contraction", weights)

    return Drive(claim, 0.05 / steepest, 1 / steepest, 0.1)


def drives(name: str) -> list[Drive]:
    """For each sign with which what is left makes trajectories part somewhere."""
    _, _, radius, slope = CURVES[name]
    x = np.linspace(-radius, radius, 101)[1:-1]
    return [closer(name, sign) for sign in (1, -1) if np.max(sign * slope(x)) > 1e-6]


@pytest.mark.parametrize("name", slow_after(2, CURVES))
def test_most_of_what_comes_closer_is_accepted(name: str) -> None:
    assert all(drive.share * drive.truth <= drive.last() for drive in drives(name))


@pytest.mark.parametrize("name", slow_after(2, CURVES))
def test_no_two_trajectories_part_that_are_said_to_come_closer(name: str) -> None:
    assert all(drive.last() <= drive.truth for drive in drives(name))


@pytest.mark.parametrize("name", slow_after(1, ["cos", "exp", "quartic"]))
def test_without_lipschitz_constants_trajectories_part(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is left of x^4 is left by products, of the others by functions."""
    product = Jet.__mul__
    monkeypatch.setattr(Jet, "__mul__", lambda x, y: forgetful(product(x, y)))
    monkeypatch.setattr(Jet, "lip_beyond_tangent", lambda jet, phi: ZERO)
    drive = closer(name, 1)
    assert drive.last() > drive.truth


def forgetful(jet: Jet) -> Jet:
    object.__setattr__(jet, "lip", ZERO)
    return jet


# ---------------------------------------------------------------------------------------------------- two random states

KINDS: dict[str, dict[str, Any]] = {
    "flow": {},
    "steps": {"discrete": True},
    "samples": {"sample": ("1/16", "1/16"), "order": 5},
    "any sample": {"sample": ("0", "1/16"), "order": 3},
}
PIECES, HALVES = 4, 4  # of a period: q is constant on each piece, which takes some steps of Runge and Kutta


@dataclass(frozen=True)
class Planar:
    """x' = A x + (u + s sin(x_1) + q x_2 / 4 + r x_1 x_2 + w) e_2 and u = K x; w only where a level is claimed."""

    A: np.ndarray
    K: np.ndarray
    P: np.ndarray
    s: float
    r: float
    kind: str
    level: bool

    @property
    def drawn(self) -> list[tuple[float, float]]:
        """What (q, w) may be at the ends of their ranges."""
        return [(q, w) for q in (-0.5, 0.5) for w in ((-0.125, 0.125) if self.level else (0.0,))]

    def claim(self, rate: float, floor: float, edge: float, multipliers: str | None) -> Document:
        rows = [["+", *(["*", exactly(a), name] for a, name in zip(row, "xy", strict=True))] for row in self.A.tolist()]
        rows[0].append(["*", "0", "u"])
        rows[1] += ["u", ["*", exactly(self.s), ["sin", "x"]], ["*", "1/4", "q", "y"], ["*", exactly(self.r), "x", "y"]]
        ranges = [("q", "-1/2", "1/2")]
        if self.level:
            rows[1].append("w")
            ranges.append(("w", "-1/8", "1/8"))
        data = stepping(
            rows, [(self.K, [0.0])], self.P, ((floor,) if self.level else ()) + (1.0, 1.0), states=("x", "y"),
            domain=[("-9", "9")] * 2, input_bounds=[("-999", "999")], uncertain=ranges, rate=rate, edge=edge,
            **KINDS[self.kind],
        )  # fmt: skip
        data["evidence"].setdefault("contraction", None)
        return data if multipliers is None else edited(data, "evidence.local.multipliers", multipliers)

    def f(self, x: np.ndarray, u: np.ndarray, q: float, w: float) -> np.ndarray:
        moved = self.A @ x
        moved[1] += u + self.s * np.sin(x[0]) + q * x[1] / 4 + self.r * x[0] * x[1] + w
        return moved

    def increments(self, x: np.ndarray, random: np.random.Generator) -> list[tuple[float, np.ndarray]]:
        """h and G from the points x, for courses of (q, w) that stay at ends of their ranges, or jump between them."""
        u, ends = (self.K @ x)[0], self.drawn
        if "sample" not in KINDS[self.kind]:
            F = [self.f(x, u, *end) for end in ends]
            return [(1.0, f - x) for f in F] if self.kind == "steps" else [(0.0, f) for f in F]
        found = []
        courses = [[end] * PIECES for end in ends]
        courses += [[ends[k] for k in random.integers(len(ends), size=PIECES)] for _ in range(12)]
        for h in (1 / 16, *((1 / 64, 1 / 1024) if self.kind == "any sample" else ())):
            step = h / PIECES / HALVES
            for course in courses:
                z = x
                for end in np.repeat(course, HALVES, axis=0).tolist():
                    a = self.f(z, u, *end)
                    b = self.f(z + step / 2 * a, u, *end)
                    c = self.f(z + step / 2 * b, u, *end)
                    z = z + step / 6 * (a + 2 * b + 2 * c + self.f(z + step * c, u, *end))
                found.append((h, (z - x) / h))
        return found

    def excess(self, rate: float, floor: float, count: int = 4000) -> float:
        """The largest (D + 2 rate V) / V where V >= floor, or V / floor - 1 after a step from below; V is at most 1."""
        random = np.random.default_rng(count)
        angle = random.uniform(0, 2 * np.pi, count)
        V = np.concatenate([np.ones(count // 3), np.full(count // 3, floor or 1e-6), random.random(count)])[:count]
        x = np.linalg.solve(np.linalg.cholesky(self.P).T, np.array([np.cos(angle), np.sin(angle)])) * np.sqrt(V)
        V, worst = np.sum(x * (self.P @ x), 0), -np.inf
        for h, G in self.increments(x, random):
            D = 2 * np.sum(x * (self.P @ G), 0) + h * np.sum(G * (self.P @ G), 0)
            worst = max(worst, float(np.max(((D + 2 * rate * V) / V)[floor * (1 - 1e-12) <= V])))
            below = floor > V
            if h > 0 and below.any():
                worst = max(worst, float(np.max((V + h * D)[below] / floor - 1)))
        return worst


def drawn_at_random(random: np.random.Generator, kind: str, level: bool) -> Planar:
    """A loop that would be stable if it were linear, and V of its own Lyapunov equation, with decay to spare."""
    while True:
        A, K = random.integers(-16, 17, (2, 2)) / 8, random.integers(-32, 33, (1, 2)) / 8
        A = np.eye(2) * 0.75 + A / 8 if kind == "steps" else A
        K = K / 8 if kind == "steps" else K
        whole = A + np.array([[0.0], [1.0]]) @ K
        roots = np.linalg.eigvals(whole)
        if np.max(np.abs(roots)) > 0.8 if kind == "steps" else np.max(roots.real) > -0.7:
            continue
        flat = np.kron(whole.T, whole.T) - np.eye(4) if kind == "steps" else (
            np.kron(whole.T, np.eye(2)) + np.kron(np.eye(2), whole.T)
        )  # fmt: skip
        P = np.linalg.solve(flat, -np.eye(2).ravel()).reshape(2, 2)
        P = (P + P.T) * random.choice([2.0, 8.0, 32.0])  # {V <= 1} is small, or large
        s, r = random.integers(-8, 9, 2) / (128 if kind == "steps" else 16)
        return Planar(A, K, P, float(s), float(r), kind, level)


def driven(loop_: Planar) -> tuple[float, float] | None:
    """The last rate that is accepted, or the last floor; None where none is."""
    hints = loop_.claim(0.0, 0.9, 0.0, None)["evidence"]["local"]["multipliers"]
    if not loop_.level:
        rates = bisected(lambda rate: loop_.claim(rate, 0.0, 0.0, hints), 2.0**-12, 8.0)
        return None if rates is None else (rates, 0.0)
    period = {"flow": 0.25, "steps": 1.0}.get(loop_.kind, 1 / 16)
    edges = [most(period) * part for part in (1.0, 0.5, 0.25, 0.125, 0.0625, 0.03125)]
    floors = [bisected(lambda t, k=edge: loop_.claim(0.0, 1 / t, k, hints), 1.0, 2.0**12) for edge in edges]
    known = [t for t in floors if t is not None]
    return (0.0, 1 / max(known)) if known else None


def bisected(claim: Callable[[float], Document], good: float, bad: float) -> float | None:
    if verdict(claim(good)) != "ACCEPTED":
        return None
    while bad > good * 1.001:
        t = math.sqrt(good * bad)
        good, bad = (t, bad) if verdict(claim(t)) == "ACCEPTED" else (good, t)
    return good


def found(kind: str, level: bool, seeds: range) -> list[tuple[float, Planar, float, float]]:
    """The excess at what is accepted last, of each loop of which anything is."""
    loops = [drawn_at_random(np.random.default_rng(seed), kind, level) for seed in seeds]
    last = [(each, driven(each)) for each in loops]
    return [(each.excess(*values), each, *values) for each, values in last if values is not None]


QUICK = [("flow", False, range(1)), ("steps", False, range(1)), ("steps", True, range(1))]
LONG = [(kind, level, range(1, 24)) for kind in KINDS for level in (False, True)]


@pytest.mark.parametrize(
    ("kind", "level", "seeds"), [*QUICK, *(pytest.param(*case, marks=pytest.mark.slow) for case in LONG)]
)
def test_random_loops_hold_what_is_accepted_last(kind: str, level: bool, seeds: range) -> None:
    cases = found(kind, level, seeds)
    assert cases
    assert max(excess for excess, *_ in cases) < 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "owner", "rule", "broken"),
    [
        ("steps", steps.Stepping, "inequality", without_the_square),
        pytest.param("flow", local.Local, "terms", NO_RATE, marks=pytest.mark.slow),
        pytest.param("samples", flow, "later", in_steps_of_euler, marks=pytest.mark.slow),
    ],
)
def test_random_loops_catch_a_broken_rule(
    kind: str, owner: Any, rule: str, broken: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(owner, rule, broken)
    assert max(excess for excess, *_ in found(kind, False, range(4))) > 0
