"""Rule `contraction` with held inputs, attacked in both checkers: no two states may part over a period that are said to
come closer, and no period may lead back to a state that is no equilibrium.

What is true is known here without models: by Runge and Kutta's method in small steps, between pairs of states.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

import numpy as np
import pytest
from flint import ctx

from certify.checker import words
from certify.checker.held import HeldClose
from certify.checker.near import Above
from certify.reference import flow as other
from certify.reference.__main__ import in_words
from certify.reference.balls import PRECISION
from certify.reference.document import read
from tests.checker.test_contraction_in_steps import INSIDE, JUDGES, exactly, last, pairs_of, passes_the_checker
from tests.support.balls import around, square
from tests.support.certificates import Document, dump, edited, encode, grow, make, parse, verdict
from tests.support.claim_oracle import Loop as Plant
from tests.support.earlier import newer
from tests.support.marks import slow_after
from tests.support.network_loops import affine, mapped
from tests.support.reference import judge
from tests.support.uncertain import corners, drawn, held

HELD = [([[1.0]], [0.0])]  # u = x


def nearby(
    dynamics: list[Any],
    P: Any,
    level: float,
    weights: Any,
    *,
    periods: tuple[str, str] = ("1/10", "1/10"),
    layers: Any = None,
    J: Any = None,
    order: int = 4,
    **more: Any,
) -> Document:
    """A claim with held inputs about {V <= level}, of which nothing but the contraction is meant to hold."""
    P = np.atleast_2d(np.asarray(P, dtype=float))
    n = len(P)
    settings = {"squash": "identity", "centre": "none", "scale": [1.0], "domain": [("-9", "9")] * n, **more}
    data = make(
        dynamics, layers or HELD, P, (level, level), states=("x", "y", "z")[:n], claim="nearby", sample=periods,
        input_bounds=[("-99", "99")], **settings,
    )  # fmt: skip
    J = around(P / level) if J is None else J
    ball = {"J": encode(J), "weights": encode(weights), "weight": encode(np.eye(n)), "order": order}
    return edited(data, "evidence.contraction", ball)


def after(plant: Plant, x: np.ndarray, h: float, steps: int = 40) -> np.ndarray:
    """The states a period later, the input held."""
    u, s = plant.inputs(x), h / steps
    for _ in range(steps):
        a = plant.field(x, u)
        b = plant.field(x + s / 2 * a, u)
        c = plant.field(x + s / 2 * b, u)
        x = x + s / 6 * (a + 2 * b + 2 * c + plant.field(x + s * c, u))
    return x


# ----------------------------------------------------------------------------------------------------------- one state

TERMS: dict[str, tuple[Any, float]] = {  # g of x' = g(x) + 1/64 - t u, and the radius
    "nothing": (["*", "0", "x"], 1.0),
    "line": (["*", "2", "x"], 1.0),
    "damped": (["*", "-1", "x"], 1.0),
    "square": (["*", "x", "x"], 0.125),
    "cube": (["**", "x", 3], 0.125),
    "sin": (["sin", ["*", "2", "x"]], 0.0625),
    "exp": (["exp", "x"], 0.0625),
    "tanh": (["tanh", "x"], 0.0625),
    "inverse": (["/", "1", ["+", "4", "x"]], 0.0625),
    "root": (["sqrt", ["+", "1", "x"]], 0.0625),
    "atan": (["atan", "x"], 0.0625),
    "corner": (["abs", ["+", "x", "3/2"]], 0.0625),
}
SHARE = {"nothing": 0.95, "line": 0.95, "damped": 0.95, "square": 0.8}  # the least that is found; of others less:
# the way has a Lipschitz constant without directions, which grows with the radius


def scalar(term: Any, t: float, radius: float, weight: float, **more: Any) -> Document:
    rise = ["+", term, "1/64", ["*", exactly(-t), "u"]]
    return nearby([rise], [[1.0]], (radius * INSIDE) ** 2, [weight], J=[[radius]], **more)


def parts(t: float, term: Any, radius: float, h: float) -> float:
    """The steepest slope of a period's map."""
    x = np.linspace(-radius, radius, 2001)[None] * INSIDE
    y = after(Plant(scalar(term, t, radius, 1.0)), x, h)
    return float(np.max(np.abs(np.diff(y[0]) / np.diff(x[0]))))


@pytest.mark.parametrize("passes", JUDGES)
@pytest.mark.parametrize("name", slow_after(2, TERMS))
def test_a_period_is_accepted_until_its_slope_is_minus_1(name: str, passes: Callable[[Document], bool]) -> None:
    """The gain t may be about 2/h, beyond which each period overshoots by more than all."""
    term, radius = TERMS[name]
    start, end = 6.0, 40.0
    assert parts(start, term, radius, 0.1) < 1 < parts(end, term, radius, 0.1)
    low, high = start, end
    while high > low * 1.00005:
        middle = (low + high) / 2
        low, high = (middle, high) if parts(middle, term, radius, 0.1) < 1 else (low, middle)
    found = max(
        last(lambda t, w=w: scalar(term, t, radius, w), start, 1.5 * high, passes)  # type: ignore[misc]
        for w in (2.0**-40, 0.05, 0.5)
    )
    assert SHARE.get(name, 0.3) * high <= found <= high * (1 + 2e-3), found / high


def calling(t: float, radius: float, weight: float) -> Document:
    """x' = 1/2 tanh(2 x + 1/8) + 1/64 - t u, of which a network that moves within the period says the first term."""
    data = newer(scalar(["*", "0", "x"], t, radius, weight, order=1))
    steps = [affine(0, [[2.0]], [0.125]), mapped(1, "tanh"), affine(2, [[0.5]])]
    data["networks"].append({"name": "g", "reads": 1, "steps": steps})
    data["plant"]["dynamics"] = [["+", ["network", "g", 0, "x"], "1/64", ["*", exactly(-t), "u"]]]
    return data


@pytest.mark.parametrize("passes", JUDGES)
def test_a_network_that_the_equations_call_moves_within_a_period(passes: Callable[[Document], bool]) -> None:
    """It is about as good as the same function written out, and no gain beyond the truth is accepted."""
    radius, written = 0.0625, ["*", "1/2", ["tanh", ["+", "1/8", ["*", "2", "x"]]]]
    low, high = 6.0, 40.0
    assert parts(low, written, radius, 0.1) < 1 < parts(high, written, radius, 0.1)
    while high > low * 1.00005:
        middle = (low + high) / 2
        low, high = (middle, high) if parts(middle, written, radius, 0.1) < 1 else (low, middle)
    weight = 2.0**-10
    found = last(lambda t: calling(t, radius, weight), 3.0, 1.5 * high, passes)
    plain = last(lambda t: scalar(written, t, radius, weight, order=1), 3.0, 1.5 * high, passes)
    assert 0.3 * high < 0.9 * plain <= found <= high, (found, plain, high)
    assert not passes(calling(0.9, radius, weight)), "the slope of g is about 1"


@pytest.mark.parametrize("passes", JUDGES)
def test_the_least_gain_is_that_of_the_plant(passes: Callable[[Document], bool]) -> None:
    """x' = 2 x - t u is not stable for t below 2, and each order says so; of a range the ends count."""
    for order in (1, 2, 4, 8):
        assert not passes(scalar(["*", "2", "x"], 1.99, 1.0, 2.0**-40, order=order))
        assert passes(scalar(["*", "2", "x"], 5.0, 1.0, 2.0**-40, order=order))
    assert passes(scalar(["*", "2", "x"], 19.0, 1.0, 2.0**-40, periods=("0", "1/10")))
    for periods in (("1/100", "1/8"), ("0", "1/8"), ("1/8", "1/8")):
        assert not passes(scalar(["*", "2", "x"], 19.0, 1.0, 2.0**-40, periods=periods))
    assert not passes(scalar(["*", "20", "x"], 25.0, 1.0, 2.0**-40)), "no bound of the way is found"


@pytest.mark.parametrize("passes", JUDGES)
@pytest.mark.parametrize("cells", [1, 4])
def test_an_uncertain_factor(cells: int, passes: Callable[[Document], bool]) -> None:
    """x' = q x + r - 5 u, q below 5 by more than rounding."""

    def claim(lo: str, hi: str) -> Document:
        ranges = [("q", lo, hi), ("r", "-1", "1")]
        term = ["+", ["*", "q", "x"], "r"]
        return scalar(term, 5.0, 1.0, 2.0**-40, uncertain=ranges, cells=[cells, 1])

    assert passes(claim("-1/2", "1/2"))
    for pair in (("0", "501/100"), ("501/100", "6"), ("-40", "0")):
        assert not passes(claim(*pair))


def swinging(level: float) -> Document:
    """Polar coordinates around (-1, 0): a limit cycle of radius 1 that is run through once a period, and on which the
    input draws the phase to the origin. A period contracts to the origin, where the plant does not rest."""
    p, turn = ["+", "1", "x"], ["+", "6283185307/100000000", "u"]
    radial = ["*", "20", ["-", "1", ["+", ["*", p, p], ["*", "y", "y"]]]]
    rows = [["-", ["*", radial, p], ["*", turn, "y"]], ["+", ["*", radial, "y"], ["*", turn, p]]]
    return nearby(rows, np.eye(2), level, [0.1, 0.1], layers=[([[0.0, -4.0]], [0.0])])


def test_a_swing_of_one_period_is_no_equilibrium() -> None:
    data = swinging(1e-4)
    plant, origin = Plant(data), np.zeros((2, 1))
    x, y = (0.01 * v for v in next(pairs_of(2, np.random.default_rng(0))))
    gap = after(plant, x, 0.1, 400) - after(plant, y, 0.1, 400)
    assert np.all(np.linalg.norm(gap, axis=0) < 0.99 * np.linalg.norm(x - y, axis=0))
    assert np.linalg.norm(after(plant, origin, 0.1, 400)) < 1e-4 < np.linalg.norm(plant.field(origin, origin[:1]))
    assert not any(passes(swinging(level)) for passes in JUDGES for level in (1e-12, 1e-4))


# ------------------------------------------------------------------------------------------------------- broken rules


def test_a_way_that_is_not_gone_is_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    """x' = 2 x - t u: a period overshoots beyond t = 20.1, the steps of Euler's method beyond 22."""
    claim = scalar(["*", "2", "x"], 21.0, 1.0, 2.0**-40, order=1)
    assert not any(passes(claim) for passes in JUDGES)
    monkeypatch.setattr(HeldClose, "during", lambda self, way: self.states)
    monkeypatch.setattr(HeldClose, "steepness", lambda self, f: Above(1e-3))
    monkeypatch.setattr(other, "beyond", lambda x, far, turned: x)
    assert all(passes(claim) for passes in JUDGES)


# ------------------------------------------------------------------------------------------------------ a whole claim


@cache
def honest() -> Document:
    """x' = q x + w + x^2/8 + 1/40 - 5 u over 1/20 to 1/10, with |x| at most 3/10 in the end."""
    term = ["+", ["*", "q", "x"], "w", "1/40", ["*", "1/8", "x", "x"], ["*", "-5", "u"]]
    ranges = [("q", "-1/2", "1/2"), ("w", "-1/10", "1/10")]
    data = nearby([term], [[1.0]], 0.09, [0.05], J=[[0.31]], uncertain=ranges, periods=("1/20", "1/10"))
    data = edited(edited(data, "levels.roa", (1.0).hex()), "evidence.root", encode([1.0]))
    return grow(edited(data, "evidence.order", 3))


def test_an_honest_claim() -> None:
    data = honest()
    assert verdict(data) == "ACCEPTED" and judge(data) is None
    said = " ".join(words.claim(parse(data)))
    assert "exactly one equilibrium" in said and "any sequence of periods" in said
    with ctx.workprec(PRECISION):
        assert "exactly one equilibrium" in in_words(read(dump(data)))


def ball(key: str, value: Any) -> Callable[[Document], Document]:
    return lambda data: edited(data, f"evidence.contraction.{key}", encode(value))


def at(path: str, value: Any) -> Callable[[Document], Document]:
    return lambda data: edited(data, path, value)


def without_order(data: Document) -> Document:
    found = edited(data, "evidence.contraction.order", 1)
    del found["evidence"]["contraction"]["order"]
    return found


ORDER = "evidence.contraction.order"
FORGERIES: list[tuple[str, str, Callable[[Document], Document]]] = [
    ("contraction", "a ball in the set", ball("J", [[0.3 * (1 - 1e-9)]])),
    ("contraction", "a ball of 0", ball("J", [[0.0]])),
    ("contraction", "a huge ball", ball("J", [[1e200]])),
    ("contraction", "a ball on which states part", ball("J", [[22.0]])),
    ("contraction", "a weight of 0", ball("weights", [0.0])),
    ("contraction", "a weight below 0", ball("weights", [-0.05])),
    ("contraction", "a weight that is too large", ball("weights", [10.0])),
    ("format", "no order", without_order),
    ("format", "order 0", at(ORDER, 0)),
    ("format", "order 9", at(ORDER, 9)),
    ("format", "order true", at(ORDER, True)),
    ("format", "order of a half", at(ORDER, 0.5)),
    ("format", "an order in words", at(ORDER, "4")),
    ("format", "an order without a sample", at("claim.sample", None)),
    ("format", "no contraction", at("evidence.contraction", None)),
    ("format", "a period of 0", at("claim.sample", ["0", "0"])),
    ("format", "periods that end before they begin", at("claim.sample", ["1/10", "1/20"])),
    ("format", "practical with a contraction", at("claim.kind", "practical")),
    ("format", "discrete time", at("plant.time", "discrete")),
    ("ring", "a period at which it swings", at("claim.sample", ["1/20", "2/5"])),
    ("ring", "a period that is too long", at("claim.sample", ["1", "1"])),
]  # fmt: skip


@pytest.mark.parametrize(("rule", "edit"), [pytest.param(rule, edit, id=what) for rule, what, edit in FORGERIES])
def test_forgeries(rule: str, edit: Callable[[Document], Document]) -> None:
    data = edit(honest())
    found = verdict(data), judge(data)
    assert found == (rule, rule) or (rule == "ring" and set(found) <= {"ring", "flow"}), found


# --------------------------------------------------------------------------------------------- some states, at random


def random_plant(seed: int) -> Document:
    """A plant of one to three states whose feedback is held over some period."""
    random = np.random.default_rng(seed)
    n = int(random.integers(1, 4))
    names, hi = ("x", "y", "z")[:n], str(random.choice(["1/50", "1/20", "1/8", "1/4"]))
    lo = str(random.choice(["0", "1/100", hi]))
    rows: list[Any] = []
    for i in range(n):
        one, two = random.choice(names, 2)
        strength = exactly(int(random.integers(-32, 33)) / 32)
        rows.append(["+", ["*", exactly(int(random.integers(-64, 33)) / 32), names[i]], ["*", strength, [
            ["*", one, two], ["sin", ["+", one, two]], ["**", one, 3], ["*", "q", one], ["exp", two],
            ["abs", ["+", one, "3"]], ["tanh", ["*", "2", two]], ["/", two, ["+", "2", one]],
        ][int(random.integers(8))]], ["*", "2", "u"] if i == n - 1 else ["+", names[i + 1], "r"]])  # fmt: skip
    K = -np.abs(random.uniform(0.5, 4.0, n)) * 2
    layers = [(random.standard_normal((2, n)) / 2 + K, 0.2 * random.standard_normal(2)), ([[0.5, 0.5]], [0.1])]
    ranges = [("q", "-1/2", "1/2"), ("r", "-1/8", "1/8")]
    order, cells = int(random.integers(1, 6)), [int(random.integers(1, 3)), 1]
    return nearby(
        rows, np.eye(n), 1.0, np.ones(n), layers=layers, uncertain=ranges, cells=cells, order=order, periods=(lo, hi)
    )


def ends(data: Document) -> list[float]:
    lo, hi = (float(np.divide(*map(float, (*h.split("/"), "1")[:2]))) for h in data["claim"]["sample"])
    return [h for h in {lo, (lo + hi) / 2, hi} if h > 0]


def with_P(data: Document) -> Document:
    """P of the linearised period's map, which is its candidate for coming closer; else that of the document."""
    plant = Plant(held(data, next(corners(data))))
    n, h, step = plant.n, ends(data)[-1], 1e-5
    x = np.concatenate([step * np.eye(n), -step * np.eye(n)], axis=1)
    y = after(plant, x, h)
    A = (y[:, :n] - y[:, n:]) / (2 * step)
    if not np.all(np.isfinite(A)) or np.max(np.abs(np.linalg.eigvals(A))) >= 1:
        return data
    P, M = np.zeros((n, n)), np.eye(n)
    for _ in range(2000):
        P, M = P + M.T @ M, A @ M
    return edited(data, "lyapunov.P", encode((P + P.T) / 2))


def on_ball(data: Document, P: np.ndarray, level: float, share: float) -> Document:
    old = data["evidence"]["contraction"]
    new = {"J": encode(around(P / level)), "weights": encode(share * level * np.ones(len(P)))}
    data = edited(data, "levels", {name: level.hex() for name in ("floor", "local", "roa")})
    return edited(data, "evidence.contraction", old | new)


SHARES = (1e-3, 0.02, 0.1, 0.4, 2.0)


def levels_of(data: Document, P: np.ndarray) -> Iterator[float]:
    """The largest accepted level, of each checker; 0 if there is none."""
    for passes in JUDGES:
        found = 0.0
        for level in 4.0 ** np.arange(-8, 3):
            if not any(passes(on_ball(data, P, float(level), share)) for share in SHARES):
                break
            found = float(level)
        yield found


@pytest.mark.parametrize("seed", slow_after(1, range(100)))
def test_no_pair_parts_over_a_period_of_a_random_plant(seed: int) -> None:
    data = with_P(random_plant(seed))
    P = square(data["lyapunov"]["P"])
    n, random, accepted = len(P), np.random.default_rng(seed), [*levels_of(data, P)]
    level = max(accepted)
    if level == 0:
        return
    J = around(P / level)
    for q in [*corners(data), *(drawn(data, random) for _ in range(2))]:
        plant = Plant(held(data, q))
        for h in ends(data):
            for d, e in pairs_of(n, random):
                x, y = J @ d, J @ e
                gap, moved = x - y, after(plant, x, h, 20) - after(plant, y, h, 20)
                first, then = (np.einsum("ib,ij,jb->b", v, P, v) for v in (gap, moved))
                some = first > 1e-12
                assert np.all(then[some] < first[some] * (1 + 1e-6)), (accepted, h, np.max(then[some] / first[some]))


def test_some_random_plants_are_accepted() -> None:
    for seed in (1, 6, 11, 12):
        data = with_P(random_plant(seed))
        P = square(data["lyapunov"]["P"])
        assert any(passes_the_checker(on_ball(data, P, 2.0**-12, share)) for share in SHARES), seed
