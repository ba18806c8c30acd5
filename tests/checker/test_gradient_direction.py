"""Balls up to the edge of what the remainder of a function allows, along its gradient and across it, in both programs.

Rule `local` is worked out a second time, in floating point and from the text, for plants x' = -x + s (phi(v) -
phi(v(0))) and y' = -b y with v of second degree. A ball just inside is accepted. One just outside, with the least
suprema of fourth derivatives that anybody could use, is a forgery.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from itertools import permutations
from typing import Any

import numpy as np
import pytest

from certify.checker.functions import Expansion
from certify.checker.jets import Jet
from certify.checker.near import Near, outer
from certify.reference import functions
from tests.support.balls import centred
from tests.support.certificates import Document, edited, make, verdict
from tests.support.marks import slow_after
from tests.support.reference import judge

Array = np.ndarray
TINY = 2.0**-20  # beta of the second component, which is linear


@dataclass(frozen=True)
class Phi:
    """phi', phi''/2 and phi'''/6 at the middle, where v(0) is; phi'''' there and beyond, and the table's bound of its
    size for a radius, both by 24."""

    tree: Callable[[object], object]
    f: tuple[float, float, float]
    fourth: Callable[[Array], Array]
    table: Callable[[float], float]

    def largest(self, radius: float) -> float:
        return float(np.abs(self.fourth(np.linspace(-radius, radius, 2001))).max())


def tanh_4(v: Array) -> Array:
    t = np.tanh(v)
    return np.asarray(8 * t * (2 - 3 * t * t) * (1 - t * t) / 24)


def atan_4(v: Array) -> Array:
    return np.asarray(v * (1 - v * v) / (1 + v * v) ** 4)


def least(radius: float) -> float:
    """1/v around 1: four terms leave D^4 / v."""
    return 1 / (1 - radius) if radius < 1 else np.inf


FUNCTIONS = {
    "sin": Phi(lambda v: ["sin", v], (1, 0, -1 / 6), lambda v: np.sin(v) / 24, lambda r: min(1, r) / 24),
    "tanh": Phi(lambda v: ["tanh", v], (1, 0, -1 / 3), tanh_4, lambda r: min(4.1, 16 * r) / 24),
    "atan": Phi(lambda v: ["atan", v], (1, 0, -1 / 3), atan_4, lambda _: 4.7 / 24),
    "exp": Phi(lambda v: ["exp", v], (1, 1 / 2, 1 / 6), lambda v: np.exp(v) / 24, lambda r: np.exp(r) / 24),
    "inv": Phi(lambda v: ["/", "1", ["+", "1", v]], (-1, 1, -1), lambda v: np.full(1, least(v[-1])), least),
}  # fmt: skip


@dataclass(frozen=True)
class Plant:
    """v = slopes.x + m y^2; the rates, P, and a ball whose J is a multiple of `shape`."""

    name: str
    share: Fraction
    slopes: tuple[Fraction, Fraction]
    m: Fraction
    b: Fraction
    P: Array
    shape: Array
    alpha: float
    beta: float

    @classmethod
    def drawn(cls, seed: int) -> Plant:
        draw = np.random.default_rng(seed)
        name = list(FUNCTIONS)[seed % len(FUNCTIONS)]

        def number(lo: float, hi: float) -> Fraction:
            return Fraction(int(draw.uniform(lo, hi) * 64), 64)

        slopes = number(0.6, 1), number(-0.1, 0.1)
        turn = np.array([[1, draw.uniform(-0.2, 0.2)], [draw.uniform(-0.2, 0.2), 1]])
        off = draw.uniform(-0.1, 0.1)
        P, shape = np.array([[1, off], [off, 1]]), turn @ np.diag([draw.uniform(0.5, 1), draw.uniform(0.3, 1)])
        share, m, b, hints = number(-0.7, 0.7), number(0.02, 1), number(0.05, 0.5), 10.0 ** draw.uniform(-1.5, 0, 2)
        return cls(name, share, slopes, m, b, P, shape, *hints.tolist())

    def left(self, size: float, m_of: Callable[[float], float], along: bool = True) -> float:
        """The least eigenvalue of the matrix that rule `local` asks to be positive definite; not `along`, 3 g y^2 z
        counts as slope^2 W, as if it had no direction."""
        J, eye, share = size * self.shape, np.eye(2), float(self.share)
        a, Q = np.array([float(v) for v in self.slopes]) @ J, float(self.m) * np.outer(J[1], J[1])
        slope, curve = float(np.linalg.norm(a)), float(np.linalg.norm(Q))
        p, h, g = FUNCTIONS[self.name].f
        m, aa = m_of(slope + curve) * (slope + curve) ** 2, np.outer(a, a)
        if not np.isfinite(m):
            return -np.inf
        spread = abs(h) * curve + abs(g) * (3 * slope * curve + curve**2) + m * (2 * slope + curve)
        spread += 0 if along else 3 * abs(g) * slope**2
        E = abs(share) * (spread * curve * eye + ((3 * abs(g) * curve if along else 0) + m) * aa)
        b, A = J.T @ self.P, np.array([share * p * a - J[0], -float(self.b) * J[1]])  # b_i are columns
        Q_1 = share * (p * Q + h * aa)
        aQ = np.einsum("i,jk->ijk", a, Q)
        K = share * (2 * h * sum(np.transpose(aQ, each) for each in permutations(range(3))) / 6)
        K = K + share * g * np.einsum("i,j,k->ijk", a, a, a)
        T, column = K.reshape(4, 2), b[:, 0]
        tau = np.sqrt(np.trace(T @ T.T) / (column @ column)) or 1.0
        S = self.alpha * np.outer(column, column) + E.T @ E / self.alpha
        S = S + self.beta * np.outer(column, column) + TINY * np.outer(b[:, 1], b[:, 1]) + Q_1.T @ Q_1 / self.beta
        S = S + tau * np.outer(column, column) + T.T @ T / tau
        falls = J.T @ self.P @ A
        return float(np.linalg.eigvalsh(-(falls + falls.T) - S)[0] / size**2)

    def edge(self, m_of: Callable[[float], float], along: bool = True) -> float:
        """The size up to which a ball is accepted."""
        sizes = np.linspace(0.05, 3, 60)
        fails = next((k for k, size in enumerate(sizes) if self.left(float(size), m_of, along) <= 0), 0)
        if fails == 0:
            return float("nan")
        lo, hi = float(sizes[fails - 1]), float(sizes[fails])
        for _ in range(50):
            middle = (lo + hi) / 2
            lo, hi = (middle, hi) if self.left(middle, m_of, along) > 0 else (lo, middle)
        return lo

    def document(self, size: float) -> Document:
        """With the largest level that the ball holds, nearly."""
        line = [["*", str(q), z] for q, z in zip(self.slopes, "xy", strict=True)]
        v = ["+", *line, ["*", str(self.m), ["**", "y", 2]]]
        phi = FUNCTIONS[self.name].tree(v)
        phi = ["-", phi, "1"] if self.name in ("exp", "inv") else phi
        J = size * self.shape
        c = float(np.linalg.eigvalsh(J.T @ self.P @ J)[0]) * 0.99
        data = make(
            [["+", ["-", "x"], ["*", str(self.share), phi]], ["*", str(-self.b), "y"]], [(np.zeros((1, 2)), [0.0])],
            self.P, (c, c), states=("x", "y"), domain=[("-99", "99")] * 2,
        )  # fmt: skip
        return edited(data, "evidence.local", centred(J, np.array([[self.alpha, 0.0], [self.beta, TINY], [0.0, 0.0]])))


@cache
def plants(count: int) -> list[tuple[Plant, float, float]]:
    """Plants whose edge is 1 % or more beyond that without a direction, with the size up to which the table proves and
    the one beyond which nothing does."""
    found = list[tuple[Plant, float, float]]()
    for seed in range(100 * count):
        plant = Plant.drawn(seed)
        phi = FUNCTIONS[plant.name]
        inner, outer = plant.edge(phi.table), plant.edge(phi.largest)
        if inner > 1.01 * plant.edge(phi.largest, along=False) and outer < 1.05 * inner:
            found.append((plant, inner, outer))
        if len(found) == count:
            return found
    raise AssertionError(f"{len(found)} of {count}")


def verdicts(data: Document) -> tuple[str, str]:
    return verdict(data), judge(data) or "ACCEPTED"


COUNT = 40


@pytest.mark.parametrize("k", slow_after(6, range(COUNT)))
def test_a_ball_is_accepted_up_to_the_edge_and_refused_beyond(k: int) -> None:
    plant, inner, outer = plants(COUNT)[k]
    assert verdicts(plant.document(inner * (1 - 1e-6))) == ("ACCEPTED", "ACCEPTED")
    for beyond in (1e-6, 1e-3, 0.1):
        assert plant.left(outer * (1 + beyond), FUNCTIONS[plant.name].largest) < 0
        assert verdicts(plant.document(outer * (1 + beyond))) == ("local", "local")


def test_without_the_term_along_the_gradient_forgeries_get_through(monkeypatch: pytest.MonkeyPatch) -> None:
    """In the checker and in the reference: the forgeries above would notice."""
    real = Jet.beyond_tangent

    def of_the_checker(jet: Jet, phi: Expansion) -> Any:
        H, C, R = real(jet, phi)
        less = Near(-(phi.f[3].size * jet.curve * 3).top)
        return H, C, R + outer(jet.gradient, jet.gradient) * less

    monkeypatch.setattr(Jet, "beyond_tangent", of_the_checker)
    monkeypatch.setattr(functions, "of_squares", lambda v, phi: phi.fourth * v.radius * v.radius)
    found = [verdicts(plant.document(edge * (1 + 1e-3))) for plant, _, edge in plants(COUNT)[:12]]
    for program in zip(*found, strict=True):
        assert program.count("ACCEPTED") > 3


def test_every_function_is_among_them_and_there_are_many_forgeries() -> None:
    assert {plant.name for plant, _, _ in plants(COUNT)} == {*FUNCTIONS} and 3 * COUNT > 100
