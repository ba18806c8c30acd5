"""The reference on loops with steps, rates, levels and corners: claims known to be true or false, and forgeries.

Most loops here are so small that the truth is known by hand, up to the number at which a claim begins to be false.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from functools import cache
from typing import Any

import mpmath
import numpy as np
import pytest

from certify.reference import decrease, flow, leaves, local, rules
from certify.reference.__main__ import in_words
from certify.reference.document import read
from tests.support.certificates import Document, decode, dump, edited, encode
from tests.support.marks import slow_after
from tests.support.periods import mean_change, switching
from tests.support.reference import judge
from tests.support.steps import accepted, at_level, grown, stepping, with_ball

Edit = Callable[[Document], Document]
STILL: list[Any] = [([[0.0]], [0.0])]
WIDE = {"input_bounds": [("-99", "99")]}


def gain(k: float) -> list[Any]:
    return [([[-k]], [0.0])]


# ---------------------------------------------------------------------------------------------------- discrete and held


@pytest.mark.parametrize(("factor", "true"), [("99/100", True), ("-99/100", True), ("1", False), ("-101/100", False)])
@pytest.mark.parametrize("inner", [1.0, 0.25])
def test_a_discrete_loop(factor: str, true: bool, inner: float) -> None:
    data = stepping([["*", factor, "x"]], STILL, [[1.0]], (inner, 1.0), discrete=True, leaves=50)
    assert accepted(data) == true
    continuous = edited(data, "plant.time", "continuous")
    assert accepted(continuous) == factor.startswith("-")


@pytest.mark.parametrize(("rate", "true"), [(0.0, True), (0.374, True), (0.375, False), (0.4, False), (1e300, False)])
def test_the_rate_of_a_discrete_loop(rate: float, true: bool) -> None:
    """V(x/2) - V(x) = -3/4 V."""
    data = stepping([["*", "1/2", "x"]], STILL, [[1.0]], (0.25, 1.0), discrete=True)
    assert accepted(edited(data, "claim.rate", rate.hex())) == true
    only = stepping([["*", "1/2", "x"]], STILL, [[1.0]], (1.0, 1.0), discrete=True)
    assert accepted(edited(only, "claim.rate", rate.hex())) == true


@pytest.mark.parametrize(("rate", "true"), [(0.999, True), (1.0, False), (5e-324, True)])
@pytest.mark.parametrize("inner", [0.25, 1.0])
def test_the_rate_of_a_continuous_loop(rate: float, true: bool, inner: float) -> None:
    data = stepping([["-", "x"]], STILL, [[1.0]], (inner, 1.0))
    assert accepted(edited(data, "claim.rate", rate.hex())) == true


def test_a_rate_that_only_leaves_break(monkeypatch: pytest.MonkeyPatch) -> None:
    """x' = -x + x^3: at x^2 the rate is 1 - x^2; the ball ends at 1/4, the leaves at 1/2."""
    data = stepping([["+", ["-", "x"], ["**", "x", 3]]], STILL, [[1.0]], (0.25, 0.5), domain=[("-1", "1")], leaves=400)
    for rate, rule in ((0.45, None), (0.55, "ring"), (0.8, "local")):
        data = grown(edited(data, "claim.rate", rate.hex()), 400)
        assert judge(data) == rule


@pytest.mark.parametrize("order", slow_after(2, [1, 2, 3, 8]))
@pytest.mark.parametrize("sample", [("0", "1"), ("1", "1"), ("1/2", "1")])
@pytest.mark.parametrize(("k", "true"), [(1.9, True), (2.0, False), (2.1, False)])
def test_an_integrator_whose_input_is_held(k: float, true: bool, sample: tuple[str, str], order: int) -> None:
    """x(h) = (1 - h k) x, so that hi k < 2 must hold."""
    for inner in (1.0, 0.25):
        data = stepping(["u"], gain(k), [[1.0]], (inner, 1.0), sample=sample, order=order, leaves=100, **WIDE)
        assert accepted(data) == true


@pytest.mark.parametrize("order", [2, 4, 6])
@pytest.mark.parametrize(("hi", "true"), [("1/4", True), ("9/20", False)])
def test_an_unstable_loop_whose_input_is_held(order: int, hi: str, true: bool) -> None:
    """x' = x + u, u = -k x: x(h) = (e^h - k (e^h - 1)) x, and -1 at e^h = (k + 1) / (k - 1): for k = 6 at 0.336."""
    data = stepping([["+", "x", "u"]], gain(6.0), [[1.0]], (0.25, 1.0), sample=(hi, hi), order=order, leaves=60, **WIDE)
    assert accepted(data) == true
    assert not accepted(edited(data, "claim.sample", ["0", "7/20"]))


def test_a_period_that_the_file_makes_longer() -> None:
    domain = [("-9", "9")]
    data = stepping(
        [["+", "x", "u"]], gain(6.0), [[1.0]], (1.0, 1.0), sample=("1/4", "1/4"), order=4, domain=domain, **WIDE
    )
    assert judge(data) is None
    assert judge(edited(data, "claim.sample", ["1/4", "17/50"])) == "local"
    assert judge(edited(data, "claim.sample", ["1/4", "2"])) == "flow"
    assert judge(edited(data, "claim.sample", None)) == "format"  # the order belongs to a sample
    longer = edited(data, "claim.sample", ["3/10", "3/10"])
    assert judge(longer) is None and judge(edited(longer, "evidence.local.order", 1)) == "local"  # too coarse


# ------------------------------------------------------------------------------------------------ practical with a ball


def drifting(edge: float | None, levels: tuple[float, float, float] = (0.25, 0.5, 1.0), **more: Any) -> Document:
    """x' = -x + w, |w| <= 1/4: V falls where x^2 > 1/16."""
    options: dict[str, Any] = {"uncertain": [("w", "-1/4", "1/4")], "leaves": 200, **more}
    return stepping([["+", ["-", "x"], "w"]], STILL, [[1.0]], levels, edge=edge, **options)


def test_a_ball_around_a_level() -> None:
    """-2 x^2 + 2 x w + k (x^2 - c0) < 0 for w = 1/4 at its edge: c0 > 1/16 / (k (2 - k)), and k = 1 is best."""
    for c0, true in ((0.0635, True), (0.0624, False)):
        assert accepted(drifting(1.0, (c0, 0.5, 1.0))) == true
        assert accepted(drifting(1.0, (c0, 1.0, 1.0))) == true
    assert not accepted(drifting(0.0)) and not accepted(drifting(2.0)) and not accepted(drifting(1e300))
    assert not accepted(drifting(5e-324))
    assert accepted(drifting(1.9, (0.4, 0.5, 1.0))) and not accepted(drifting(1.9, (0.3, 0.5, 1.0)))


def test_the_rate_around_a_level() -> None:
    """-2 x^2 + 2 x w + 2 lambda x^2 + k (x^2 - c0): c0 > 1/16 / (k (2 - 2 lambda - k))."""
    for rate, true in ((0.4, True), (0.6, False)):
        data = drifting(0.5 if true else 0.4, (0.25, 0.5, 1.0), rate=rate)
        assert accepted(data) == true


@pytest.mark.parametrize(("edge", "rule"), [(0.5, None), (0.7, None), (0.75, "local"), (1.0, "local"), (1.5, "local")])
def test_the_edge_of_a_discrete_loop(edge: float, rule: str | None) -> None:
    """x+ = x/2 + w/4: -3/4 x^2 + k x^2 must be negative, for which k < 3/4; beyond 1 nothing could be."""
    data = stepping(
        [["+", ["*", "1/2", "x"], ["*", "1/4", "w"]]], STILL, [[1.0]], (0.25, 0.5, 0.5), edge=edge, discrete=True,
        uncertain=[("w", "-1/4", "1/4")],
    )  # fmt: skip
    assert judge(data) == rule


def test_a_discrete_loop_must_not_jump_out_of_the_level() -> None:
    """x+ = 2 exp(-9 x^2) / 3: from the middle it leaves {V <= 1/4}, and comes back. Only condition 4' says so."""
    jump = ["*", "2/3", ["exp", ["*", "-9", ["**", "x", 2]]]]
    near = ["*", "2/5", ["exp", ["*", "-9", ["**", "x", 2]]]]
    for f, true in ((jump, False), (near, True)):
        data = stepping([f], STILL, [[1.0]], (0.25, 0.25, 1.0), edge=None, discrete=True, leaves=600)
        assert accepted(data) == true
        for edge in (0.1, 0.5, 0.9):
            with_one = stepping([f], STILL, [[1.0]], (0.25, 0.3, 1.0), edge=edge, discrete=True, leaves=600)
            assert true or not accepted(with_one)


def test_without_the_bound_of_k_a_loop_would_jump_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """x+ = -2 x for small x, -x/2 beyond: V may double in {V <= c0} and D + k (V - c0) < 0 for a k above 1."""
    f = ["*", "x", ["-", ["/", "6", ["+", "1", ["*", "20", ["**", "x", 2]]]]]]
    data = stepping([f], STILL, [[1.0]], (1.0, 1.0, 2.0), edge=None, discrete=True, leaves=900)
    x = np.sqrt(1 / 20)  # where it is largest, 6 / 2 x
    assert 3 * x < 1  # so far true: nothing leaves {V <= 1}
    assert 6 * x / 2 == pytest.approx(0.67, abs=0.01) and accepted(data)
    lower = stepping([f], STILL, [[1.0]], (0.3, 0.3, 2.0), edge=None, discrete=True, leaves=900)
    assert judge(lower) == "ring"  # 0.67^2 > 0.3, and from 0.3 on V falls: (6 / 7)^2 < 1
    monkeypatch.setattr(leaves.Leaves, "stays", lambda self, D, above: any(
        (D + above.scaled(k)).bound() < 0 for k in [leaves.ZERO, *leaves.kinks(D, above), *map(leaves.arb, (1, 9, 99))]
    ))  # fmt: skip
    assert accepted(grown(lower, 900))


def test_a_hole_is_looked_at_where_time_has_steps() -> None:
    """In continuous time nothing is asked of what V does inside {V <= c0}."""
    for discrete, rule in ((False, None), (True, "ring")):
        f = ["+", ["*", "1/2", "x"], "1"] if discrete else ["+", ["-", "x"], "1/2"]
        data = stepping([f], STILL, [[1.0]], (0.5, 0.5, 1.0), edge=None, discrete=discrete, leaves=300)
        assert judge(data) == rule


def test_held_inputs_around_a_level() -> None:
    """x' = u + w, u = -x, h = 1: x(1) = w, |w| <= 1/4, from anywhere."""
    for edge in (None, 0.5, 0.9, 1.5):
        data = stepping(
            [["+", "u", "w"]], gain(1.0), [[1.0]], (0.25, 0.25 if edge is None else 0.5, 1.0), edge=edge,
            sample=("1", "1"), order=2, uncertain=[("w", "-1/4", "1/4")], leaves=600, **WIDE,
        )  # fmt: skip
        assert judge(data) == ("local" if edge == 1.5 else None)
        if edge == 0.9:
            assert judge(at_level(data, floor=0.08)) is None and judge(at_level(data, floor=0.06)) == "local"


def test_centring_none_starts_from_the_policy_at_0() -> None:
    """u(0) = 1/2 and not u_eq = 0: x' = -x + u moves to 1/2."""
    for bias, true in ((0.5, False), (0.0, True), (0.125, True)):
        data = stepping(
            [["+", ["-", "x"], "u"]], [([[0.0]], [bias])], [[1.0]], (0.1, 0.5, 0.5), edge=1.0, **WIDE,
        )  # fmt: skip
        assert accepted(data) == true


# -------------------------------------------------------------------------------------------------------------- corners


def turned(w: Fraction, cells: int = 1, **more: Any) -> Document:
    """x' = -x + a y, y' = -b x - y, a and b in 6 +- w: V falls up to |a - b| < 2, though both are larger."""
    ranges = [(name, str(6 - w), str(6 + w)) for name in "ab"]
    f = [["+", ["-", "x"], ["*", "a", "y"]], ["-", ["-", ["*", "b", "x"]], "y"]]
    return stepping(
        f, [([[0.0, 0.0]], [0.0])], np.eye(2), (0.5, 0.5), states="xy", domain=[("-3", "3")] * 2, uncertain=ranges,
        cells=[cells, cells], **more,
    )  # fmt: skip


@pytest.mark.parametrize(("w", "true"), [("1/2", True), ("99/100", True), ("1", False), ("101/100", False)])
@pytest.mark.parametrize("cells", [1, 2, 5])
def test_corners_are_exact_where_everything_is_linear(w: str, true: bool, cells: int) -> None:
    assert accepted(turned(Fraction(w), cells)) == true


def test_a_norm_would_not_do(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stiff pair: what 10 % of 1000 does is far more than what the slow state leaves."""
    stiff = stepping(
        [["+", ["-", "x"], "y"], ["+", ["*", "-1000", "q", "y"], ["*", "-10", "p", "x"]]], [([[0.0, 0.0]], [0.0])],
        np.eye(2), (0.5, 0.5), states="xy", domain=[("-9", "9")] * 2,
        uncertain=[("q", "9/10", "11/10"), ("p", "9/10", "11/10")],
    )  # fmt: skip
    assert accepted(stiff)

    def by_norms(F: Any, holds: Any, P: Any) -> bool:
        """Each gradient within the 2-norm of what y does to it, in any direction."""
        far = [decrease.norm(sum((decrease.arb_mat(p) for p in f.da), 0 * f.a).entries()) for f in F.components]
        models = [
            replace(f.where((0,) * len(f.dv)), a=f.a + r * leaves.arb(0, 1) * decrease.arb_mat(2, 1, [1, 1]))
            for f, r in zip(F.components, far, strict=True)
        ]
        return bool(holds(replace(F, components=models)))

    monkeypatch.setattr(local, "whatever_y", by_norms)
    assert not accepted(stiff)


def test_each_corner_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    """With any one of the four left out a false claim gets through, or else its opposite is no corner of it."""
    false, found = turned(Fraction(101, 100)), []
    for left_out in itertools.product((-1, 1), repeat=2):

        def some(F: Any, holds: Any, P: Any, left_out: tuple[int, int] = left_out) -> bool:
            return all(holds(F.where(y)) for y in itertools.product((-1, 1), repeat=2) if y != left_out)

        monkeypatch.setattr(local, "whatever_y", some)
        found.append(accepted(false))
    assert found == [False] * 4  # (1, -1) and (-1, 1) both fail
    monkeypatch.setattr(local, "whatever_y", lambda F, holds, P: all(holds(F.where(y)) for y in ((1, 1), (-1, -1))))
    assert accepted(false)


@pytest.mark.parametrize("power", [2, -1])
def test_what_is_not_affine_in_q_is_taken_in(power: int) -> None:
    """x' = (q^2 - 2) x, (1/q - 1) x: false at one end of a range."""
    for hi, true in (("7/5", True), ("3/2", False)) if power == 2 else (("3", True), ("1/2", False)):
        ends = ("-7/5", hi) if power == 2 else (("11/10", hi) if true else (hi, "3"))
        f = ["*", ["-", ["**", "q", power], "2" if power == 2 else "1"], "x"]
        data = stepping([f], STILL, [[1.0]], (0.5, 0.5), uncertain=[("q", *ends)], cells=[40])
        assert accepted(data) == true


# ------------------------------------------------------------------------------------- periods that visit several cells


def test_a_period_that_visits_several_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    """x' = -x + q y, y' = -2 y + q x: all but x_1 takes q from its whole range, whatever the cells are."""
    f = [["+", ["*", "q", "y"], ["-", "x"]], ["+", ["*", "-2", "y"], ["*", "q", "x"]]]
    more: dict[str, Any] = {"states": "xy", "domain": [("-3", "3")] * 2, "uncertain": [("q", "-1/2", "1/2")]}
    data = stepping(
        f, [([[0.0, 0.0]], [0.0])], np.eye(2), (0.5, 0.5), sample=("1/10", "1/10"), order=2, cells=[8], **more
    )
    asked, of_all = [], flow.Loop.anything
    monkeypatch.setattr(flow.Loop, "anything", lambda self, known: asked.append(of_all(self, known)) or asked[-1])
    assert accepted(data)
    assert asked and all(abs(q["q"].v) + 0.5 <= q["q"].size and not q["q"].dv for q in asked)


# --------------------------------------------------------------------------------------------- what is accepted is true


@pytest.mark.parametrize("kind", slow_after(2, ["held", "discrete", "held 0"]))
@pytest.mark.parametrize("practical", slow_after(1, [False, True]))
@pytest.mark.parametrize("seed", slow_after(1, range(3)))
def test_what_is_accepted_of_a_random_loop_is_true(seed: int, practical: bool, kind: str) -> None:
    """Gains are raised until the claim is refused; each that is accepted is held against periods that jump."""
    generator, some = np.random.default_rng([seed, practical]), False
    a, b, K = generator.uniform(0.2, 0.6, 2), generator.uniform(0.2, 0.5), generator.uniform(0.8, 1.2, 2)
    for factor in (0.5, 1.0, 2.0, 4.0, 8.0, 16.0):
        data = loop_of(kind, practical, a, b, K * factor)
        if judge(data) is not None:
            continue
        some = True
        worst = largest(data, generator, 25)
        assert worst < 0, (factor, worst)
    assert some


def loop_of(kind: str, practical: bool, a: np.ndarray, b: float, K: np.ndarray) -> Document:
    stays = "1/5" if kind == "discrete" else "-1"
    more = [["*", "1/40", "w"]] if practical else []
    f = [
        ["+", ["*", stays, "x"], ["*", str(Fraction(a[0]).limit_denominator(100)), "q", ["sin", "y"]], *more],
        ["+", ["*", stays, "y"], ["*", "q", "x", "y"], ["*", str(Fraction(b).limit_denominator(100)), "u"]],
    ]
    uncertain = [("q", "1/4", "3/4")] + [("w", "-1", "1")] * practical
    sample = {"discrete": None, "held": ("1/5", "1/5"), "held 0": ("0", "1/5")}[kind]
    return stepping(
        f, [(np.array([-K]) / 2, [0.0]), ([[1.0]], [0.0])], np.array([[1.0, 0.125], [0.125, 1.0]]),
        (0.02, 0.05, 0.08) if practical else (0.05, 0.08), discrete=kind == "discrete", sample=sample, order=3,
        edge=0.4 * practical, states="xy", domain=[("-3", "3")] * 2, uncertain=uncertain, leaves=120, **WIDE,
    )  # fmt: skip


def largest(data: Document, generator: np.random.Generator, count: int) -> float:
    """The largest D + 2 lambda V where it must be negative, and V - c0 after a step from below."""
    P, discrete = np.array([[1.0, 0.125], [0.125, 1.0]]), data["plant"]["time"] == "discrete"
    c2, c0 = (float.fromhex(data["levels"].get(key, "0x0.0p+0")) for key in ("roa", "floor"))
    K = decode(data["policy"]["layers"][0]["weight"])
    worst = -np.inf
    for _ in range(count):
        x = generator.standard_normal(2)
        V = float(generator.choice([c2, c0 or c2 / 9, generator.uniform(0, c2)])) * (1 - 1e-12)
        x *= np.sqrt(V / (x @ P @ x))
        u = mpmath.tanh(sum(mpmath.mpf(k) * v for k, v in zip(K, x, strict=True)))
        h = 1.0 if discrete else float(generator.choice([0.2, generator.uniform(1e-3, 0.2)]))
        h = h if discrete or data["claim"]["sample"][0] == "0" else 0.2
        pieces = switching(data, 0.0 if discrete else h, generator)
        pieces = pieces[:1] if discrete else pieces
        G = np.array([float(v) for v in mean_change(data, list(x), [u], pieces)]) - (x if discrete else 0)
        after = float((x + h * G) @ P @ (x + h * G))
        worst = max(worst, (after - V) / V if c0 * (1 - 1e-9) <= V else after - c0)
    return worst


# ------------------------------------------------------------------------------------------------------------ forgeries


@cache
def honest(name: str) -> Document:
    if name == "held":
        return stepping(["u"], gain(1.0), [[1.0]], (0.25, 1.0), sample=("0", "1"), order=2, **WIDE)
    if name == "held, a ball":
        return stepping(["u"], gain(1.0), [[1.0]], (1.0, 1.0), sample=("0", "1"), order=2, **WIDE)
    if name == "discrete":
        return stepping([["*", "1/2", "x"]], STILL, [[1.0]], (0.25, 1.0), discrete=True)
    if name == "level":
        return drifting(1.0)
    if name == "no ball":
        return drifting(None, (0.25, 0.25, 1.0))
    return stepping([["-", "x"]], STILL, [[1.0]], (0.25, 1.0), rate=0.5)


def at(path: str, value: Any) -> Edit:
    return lambda data: edited(data, path, value)


def without(path: str, key: str) -> Edit:
    return lambda data: edited(data, path, lambda old: {k: v for k, v in old.items() if k != key})


TRUSTED = {"kind": "trusted-solver", "solver": "dReal", "version": "4", "precision": (0.5).hex(), "queries": []}
FORGERIES: list[tuple[str, str, str, Edit]] = [
    ("format", "rate", "a negative rate", at("claim.rate", (-0.5).hex())),
    ("format", "rate", "a rate of nan", at("claim.rate", "nan")),
    ("format", "rate", "a rate that is infinite", at("claim.rate", "inf")),
    ("format", "rate", "a rate as a number", at("claim.rate", 1)),
    ("format", "rate", "a rate as a rational", at("claim.rate", "1/2")),
    ("format", "rate", "no rate", without("claim", "rate")),
    ("format", "rate", "no sample", without("claim", "sample")),
    ("format", "rate", "no time", without("plant", "time")),
    ("format", "rate", "another time", at("plant.time", "sampled")),
    ("format", "rate", "no order", without("evidence", "order")),
    ("format", "rate", "no order of the ball", without("evidence.local", "order")),
    ("format", "rate", "no edge", without("evidence.local", "edge")),
    ("format", "rate", "an edge under claim asymptotic", at("evidence.local.edge", (0.5).hex())),
    ("format", "level", "a negative edge", at("evidence.local.edge", (-0.5).hex())),
    ("format", "level", "an edge of nan", at("evidence.local.edge", "nan")),
    ("format", "rate", "an order without a sample", at("evidence.order", 2)),
    ("format", "rate", "an order of the ball without a sample", at("evidence.local.order", 2)),
    ("format", "held", "order 0", at("evidence.order", 0)),
    ("format", "held", "order 9", at("evidence.order", 9)),
    ("format", "held", "order true", at("evidence.order", True)),
    ("format", "held", "order null", at("evidence.local.order", None)),
    ("format", "held", "order -1", at("evidence.local.order", -1)),
    ("format", "held", "a sample that ends before it begins", at("claim.sample", ["1", "1/2"])),
    ("format", "held", "a sample before 0", at("claim.sample", ["-1/2", "1"])),
    ("format", "held", "a sample of 0", at("claim.sample", ["0", "0"])),
    ("format", "held", "a sample of three", at("claim.sample", ["0", "0", "1"])),
    ("format", "held", "a sample in binary64", at("claim.sample", [(0.0).hex(), (1.0).hex()])),
    ("format", "held", "a discrete plant with a sample", at("plant.time", "discrete")),
    ("format", "discrete", "a trusted solver, discrete", at("evidence", TRUSTED)),
    ("format", "held", "a trusted solver with a sample", at("evidence", TRUSTED)),
    ("format", "rate", "a trusted solver with a rate", at("evidence", TRUSTED)),
    ("format", "level", "no floor", without("levels", "floor")),
    ("format", "level", "no local level", without("levels", "local")),
    ("format", "rate", "a floor under claim asymptotic", lambda d: edited(
        d, "levels", lambda old: old | {"floor": (0.1).hex()})),
    ("format", "rate", "the last version", at("schema", "certify-certificate/4")),
    ("levels", "level", "a floor of 0", at("levels.floor", (0.0).hex())),
    ("levels", "level", "a floor beyond c1", at("levels.floor", (0.75).hex())),
    ("levels", "level", "c1 beyond c2", at("levels.local", (2.0).hex())),
    ("levels", "no ball", "two levels without a ball", at("levels.local", (0.5).hex())),
    ("levels", "level", "a ball taken away", at("evidence.local", None)),
    ("local", "level", "an edge of 0", at("evidence.local.edge", (0.0).hex())),
    ("local", "level", "a huge edge", at("evidence.local.edge", (1e300).hex())),
    ("local", "level", "the least edge", at("evidence.local.edge", (5e-324).hex())),
    ("local", "level", "a ball too small", lambda d: edited(
        d, "evidence.local.J", lambda J: encode(0.9 * decode(J)))),
    ("local", "level", "a negative multiplier", lambda d: edited(
        d, "evidence.local.multipliers", encode([1.0, -1.0, 1.0]))),
    ("local", "level", "a floor too low", at("levels.floor", (0.06).hex())),
    ("flow", "held, a ball", "a domain that may be left between", at("plant.domain.0", ["-51/50", "51/50"])),
    ("equilibrium", "held", "a drift", at("plant.dynamics.0", ["+", "u", "1/1000"])),
    ("equilibrium", "discrete", "a drift, discrete", at("plant.dynamics.0", ["+", "1/1000", ["*", "1/2", "x"]])),
]  # fmt: skip


@pytest.mark.parametrize(("rule", "base", "edit"), [pytest.param(r, b, e, id=what) for r, b, what, e in FORGERIES])
def test_forgeries(rule: str, base: str, edit: Edit) -> None:
    assert judge(honest(base)) is None
    assert judge(edit(honest(base))) == rule


@pytest.mark.parametrize("path", ["claim.rate", "evidence.local.edge"])
def test_minus_0_is_0(path: str) -> None:
    """At least 0, in binary64, and what it means is 0."""
    assert judge(edited(stepping([["-", "x"]], STILL, [[1.0]], (1.0, 1.0)), path, (-0.0).hex())) is None


@pytest.mark.parametrize("key", ["rate", "sample", "time"])
def test_a_tube_has_neither(key: str) -> None:
    claim = {"kind": "enlarged", "rate": (0.0).hex(), "sample": None, "outer": None, "start": encode([1.0])}
    data = edited(honest("rate"), "claim", claim)
    path, value = {"rate": ("claim.rate", (0.5).hex()), "sample": ("claim.sample", ["0", "1"])}.get(
        key, ("plant.time", "discrete")
    )
    verdict = rules.judge(dump(edited(data, path, value)))
    assert (verdict.rule, verdict.at) == ("format", path)


def test_with_the_domain_disabled_a_forgery_gets_through(monkeypatch: pytest.MonkeyPatch) -> None:
    data = stepping(["u"], gain(1.9), [[1.0]], (1.0, 1.0), sample=("1", "1"), order=1, **WIDE)
    forged = edited(data, "plant.domain.0", ["-6/5", "6/5"])
    assert judge(forged) == "flow"
    monkeypatch.setattr(flow, "in_domain", lambda *_: None)
    assert judge(forged) is None


def test_the_step_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    """x+ = x/2 + 7 x^3 / 2: V falls for x^2 < 1/7 alone, and without S_step a larger ball would be accepted."""
    f = ["+", ["*", "1/2", "x"], ["*", "7/2", ["**", "x", 3]]]
    found = [accepted(stepping([f], STILL, [[1.0]], (c, c), discrete=True)) for c in (0.03, 0.1425, 0.1435, 0.16, 0.3)]
    assert found[0] and not any(found[2:])
    monkeypatch.setattr(decrease, "length_beyond", lambda P, G, size: decrease.ZERO)
    without_it = [accepted(stepping([f], STILL, [[1.0]], (c, c), discrete=True)) for c in (0.1435, 0.16, 0.3)]
    assert any(without_it)


# ---------------------------------------------------------------------------------------------------------------- words


def test_the_words_say_how_time_passes() -> None:
    held, discrete, level, rate = (in_words(read(dump(honest(name)))) for name in ("held", "discrete", "level", "rate"))
    assert "its inputs held for any periods in [0, 1]" in held and "at a sampling instant is there at every" in held
    assert "in discrete time" in discrete and "discrete" not in held + level + rate
    assert "enters V <= 0.25" in level and "V <= 0.5" not in level
    assert "V falling at least as exp(-2 lambda t), lambda = 0.5" in rate and "lambda" not in held


def test_a_ball_made_anew_is_the_same_ball() -> None:
    data = honest("level")
    assert judge(with_ball(data, 1, 1.0)) is None and judge(at_level(data, roa=0.9)) is None
