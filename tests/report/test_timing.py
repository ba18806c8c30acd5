"""Claims about held inputs, steps and rates: words that say when they hold, pictures of the loop that is claimed."""

from __future__ import annotations

import hashlib
import io
import itertools
import json
import math
import re
from fractions import Fraction
from pathlib import Path
from typing import Any

import flint
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from certify.analysis.facts import Levels
from certify.analysis.results import RoaResult
from certify.certificates import Certificate, Contraction, LocalBall, PartitionTree, parse_certificate
from certify.certificates.claims import Asymptotic, Claim, Nearby, Practical, Problem
from certify.certificates.timing import reach_time
from certify.certificates.verdict import Stop, Verdict
from certify.checker import document
from certify.checker import words as checker_words
from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import Number, Symbol, symbols
from certify.loop.plants import System
from certify.loop.policies import PolicyNetwork
from certify.lyapunov.function import Quadratic
from certify.report import render_html, summary
from certify.report.claims import CLAIMS, Additions, words_for
from certify.report.flow import Flow, simulate, time_scales
from certify.report.limits import limited_by
from certify.report.sampling import growth, quadratic, runs_of, simulated_roa_fraction
from certify.report.timing import TimingInWords
from tests.report.test_report import Page, exactly
from tests.support.loops import box
from tests.support.marks import slow_after

F = Fraction
EXACT, RANGE, FROM_0 = (F(1, 50), F(1, 50)), (F(1, 100), F(1, 50)), (F(0), F(1, 50))
TIMINGS = {
    "plain": TimingInWords(),
    "exact": TimingInWords(sample=EXACT),
    "range": TimingInWords(sample=RANGE),
    "from 0": TimingInWords(sample=FROM_0),
    "discrete": TimingInWords(discrete=True),
}
STEPPED = [name for name in TIMINGS if name != "plain"]
CONTINUOUS_ONLY = re.compile(
    r"for all time\b|V̇(?! at h = 0)|A sampled controller|continuous closed loop|\bdx/dt = f\(x, π\(x\)\)"
)
UNPROVED_SPEED = re.compile(r"how fast is not|how fast, and at what cost|how soon")


def gain(k: str, n: int = 1) -> PolicyNetwork:
    """u = -k x_1, as it is."""
    weight = np.zeros((1, n))
    weight[0, 0] = -float(F(k))
    return PolicyNetwork.of_layers((weight,), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none")


def integrator(timing: TimingInWords, *, push: bool = False) -> System:
    """x' = u, or x+ = x + u/50, with a mode that decays by itself; a wind if something is to push."""
    x, y, u, w = symbols("x y u w")
    wind = w if push else Number(0)
    f = (u + wind, -y) if not timing.discrete else (x + (u + wind) / 50, y * Fraction(49, 50))
    return System(
        "integrator", (x, y), (u,), {}, f, (Number(0),), box(2, 2), box(3),
        disturbances=(w,) if push else (), ranges={"w": (F(-1, 10), F(1, 10))} if push else {},
        time="discrete" if timing.discrete else "continuous", sample=timing.sample,
    )  # fmt: skip


def claimed(timing: TimingInWords, claim: Claim, *, push: bool = False, ball: bool = True) -> Certificate:
    """A certificate that nobody has checked."""
    local = LocalBall(np.eye(2), np.ones((3, 2)), np.eye(2)) if ball else None
    evidence = PartitionTree(np.eye(2), np.ones(2), bytes([255]), local, cells=(1,) * push)
    system = integrator(timing, push=push)
    return Certificate(system, gain("1", 2), Quadratic(np.eye(2)), claim, evidence)


def asymptotic(rate: float = 0.0) -> Claim:
    return Asymptotic(roa=2.0, local=0.5, rate=rate)


def practical(rate: float = 0.0) -> Claim:
    return Practical(roa=2.0, local=0.5, floor=0.125, rate=rate)


def answer_of(certificate: Certificate) -> dict[str, Any]:
    """What a checker that accepts says."""
    return {
        "result": "ACCEPTED",
        "certificate_sha256": hashlib.sha256(certificate.to_json().encode()).hexdigest(),
        "policy_sha256": certificate.network.sha256(),
        "levels": dict(certificate.claim.levels),
        "leaves": 9,
        "ring_leaves": 8,
        "margins": {"local": 0.25, "ring": 0.0123456},
    }


def page(certificate: Certificate) -> Page:
    answer = answer_of(certificate)
    read = parse_certificate(certificate.to_json().encode(), "c")
    return Page(
        render_html(read, answer, None, Path("certificate.json"), sha256=answer["certificate_sha256"], size=1000)
    )


def outside(found: Page) -> str:
    """What the page says under what was not proved."""
    return re.search(r"What was not proved (?!What|Figures)(.*?) Figures ", found.text)[1]  # type: ignore[index]


def every_text(words: Any) -> list[str]:
    """All texts of a claim's words."""
    if isinstance(words, str):
        return [words]
    parts = words if isinstance(words, tuple) else [getattr(words, name) for name in type(words).__slots__]
    return list(itertools.chain.from_iterable(map(every_text, parts)))


# Words


def test_without_anything_new_the_words_are_those_of_continuous_time() -> None:
    of = words_for("asymptotic")
    assert of.statement.format(outer="1", speed="") == (
        "Every trajectory of the closed loop that starts in the set {V(x) ≤ 1} stays in it for all time and converges "
        "to the origin, which is asymptotically stable."
    )
    assert of.headline.format(outer="1", speed="") == "{V <= 1} is invariant and attracted by the origin"
    assert of.decay == "That V falls to 0 is {word}; how fast is not."
    assert ("Ring", "V̇(x) < 0 for all x with c₁ ≤ V(x) ≤ c₂") in [part[:2] for part in of.parts]
    of = words_for("practical")
    assert of.statement.format(outer="1", inner="0.5", speed="") == (
        "Every trajectory of the closed loop that starts in the set {V(x) ≤ 1} stays in it for all time, enters the "
        "smaller set {V(x) ≤ 0.5} in finite time, and stays there from then on. That is all: the claim says nothing "
        "about motion inside the smaller set."
    )
    assert of.decay == (
        "That V falls below c₀ in finite time and stays there is {word}; how soon, and what V does below c₀, is not."
    )
    assert (
        TimingInWords().speed(None, 1.0)
        == TimingInWords().headline_rate()
        == TimingInWords().definitions
        == TimingInWords().periods
        == ""
    )


@pytest.mark.parametrize("kind", ["asymptotic", "practical"])
def test_of_kinks_no_linearisation_is_said(kind: str) -> None:
    """And that there is no hole only where the ball is around an equilibrium."""
    plain, kinked = (words_for(kind, has=Additions(ball=True, kinked=one)).parts for one in (False, True))
    changed = [(old, new) for old, new in zip(plain, kinked, strict=True) if old != new]
    assert [old[0] for old, _ in changed] == ["Local"]
    how = changed[0][1][2]
    assert "cones of directions" in how and "linearisation" not in how and ("no hole" in how) == (kind == "asymptotic")


@pytest.mark.parametrize("rate", [0.0, 0.3])
@pytest.mark.parametrize("kinked", [False, True])
@pytest.mark.parametrize("timing", TIMINGS)
@pytest.mark.parametrize("kind", ["asymptotic", "practical"])
def test_every_place_is_filled(kind: str, timing: str, kinked: bool, rate: float) -> None:
    how = TIMINGS[timing]
    how = TimingInWords(how.discrete, how.sample, rate)
    words = words_for(kind, how, Additions(ball=True, kinked=kinked))
    for text in every_text(words):
        assert "$" not in text and "  " not in text
        if timing != "plain":
            assert CONTINUOUS_ONLY.search(text) is None, text
        if rate:
            assert UNPROVED_SPEED.search(text) is None, text
    said = words.statement.format(outer="2", inner="1", speed=how.speed(1.0 if kind == "practical" else None, 2.0))
    assert ("λ" in said) == (rate > 0) and "{inner}" not in said
    assert all(("2λV(x) < 0" in part[1]) == (rate > 0) for part in words.parts if part[0] in ("Local", "Ring"))


def test_each_kind_has_words() -> None:
    for kind in CLAIMS:
        assert all("$" not in text for text in every_text(words_for(kind)))


@pytest.mark.parametrize(
    "claim", slow_after(2, [asymptotic(), practical(), asymptotic(0.25), practical(0.25)]), ids=repr
)
def test_a_sampled_page_cannot_be_misread(claim: Claim) -> None:
    found = page(claimed(TIMINGS["range"], claim))
    for text in (found.text, *found.drawings(), *(a.get("alt") or "" for _, a in found.tags)):
        assert CONTINUOUS_ONLY.search(text) is None, CONTINUOUS_ONLY.search(text)
    text = found.text
    assert "at a sampling instant is in it at every later one, in the domain at all times" in text
    assert "over any sequence of periods in [0.01, 0.02] s." in text and "every h in [0.01, 0.02] s" in text
    assert "D(x) = (V(φ(h)) − V(x))/h" in text and "dx/dt = f(x, π(x(tₖ)))" in text
    assert "Within a period." in text and "exists for 0.02 s and stays strictly inside the domain" in text
    said = outside(found)
    assert (
        "Other periods, and delay." in said and "longer or shorter even once" in said and "computing the input" in said
    )
    assert "The set between two sampling instants." in said and "no delay" in said
    assert "Rounding in the controller." in said  # no error of the input is claimed
    assert ("Speed and cost." in said) == (not claim.rate) and ("Cost, and more speed." in said) == (claim.rate > 0)
    assert ("the smallest bound on −(D + 2λV) is" if claim.rate else "the smallest bound on −D is") in text
    assert ("Inner set. V(φ(h)) < c₀ for all x with V(x) ≤ c₀ and every h in" in text) == (claim.kind == "practical")


def test_periods_from_zero_keep_the_set_between_instants() -> None:
    found = page(claimed(TIMINGS["from 0"], practical()))
    assert "is in it at all later times" in found.text and "is there at all times from then on" in found.text
    assert "every h from 0 to 0.02 s" in found.text and "every h above 0, up to 0.02 s" in found.text.replace(
        "above 0 up", "above 0, up"
    )
    assert "The set between" not in outside(found) and "that is longer even once" in outside(found)


def test_a_page_of_a_discrete_plant() -> None:
    found = page(claimed(TIMINGS["discrete"], asymptotic(0.0078125), push=False))
    text = found.text
    for shown in (text, *found.drawings()):
        assert CONTINUOUS_ONLY.search(shown) is None, CONTINUOUS_ONLY.search(shown)
    assert "is in it at every later step, and converges to the origin" in text and "x⁺ = f(x, π(x))" in text
    assert "V(xₖ) ≤ V(x₀) e^(−2λk) after k steps, with λ = 0.0078125 per step" in text
    assert "after ln(100)/(2λ) = 295 steps at the latest" in text
    assert "Time between the steps." in outside(found) and "sampling" not in outside(found)
    assert any(row and row[0] == "eigenvalues of the closed loop over a step" for row in found.rows)
    assert "the loop's own steps." in text and "time (s)" not in "".join(found.drawings())


@pytest.mark.slow
def test_ranges_and_errors_stay_what_they_are_under_a_sample() -> None:
    found = page(claimed(TIMINGS["exact"], practical(), push=True))
    assert "For every w(t) within ±0.1, any measurable function of time" in found.text
    assert "The input is held from each sampling instant to the next, over exactly 0.02 s." in found.text
    steps = page(claimed(TIMINGS["discrete"], practical(), push=True))
    assert "any sequence of values from step to step" in steps.text and "measurable" not in steps.text
    assert "c₀ = 0.125 (floor), c₁ = 0.5 (local) and c₂ = 2 (enlarged)" in steps.text
    assert "D(x) < 0 for all x with c₀ ≤ V(x) ≤ c₁" in steps.text
    without = page(claimed(TIMINGS["plain"], Practical(roa=2.0, local=0.125, floor=0.125), push=True, ball=False))
    assert "V̇(x) < 0 for all x with c₀ ≤ V(x) ≤ c₂, both boundaries included" in without.text
    assert "c₁" not in without.text


def test_a_rate_alone_in_continuous_time() -> None:
    found = page(claimed(TIMINGS["plain"], practical(0.25)))
    text = found.text
    # ln(16) / 0.5 = 5.5451774...
    assert "with λ = 0.25 per s: it is there after ln(c₂/c₀)/(2λ) = 5.54518 s at the latest." in text
    assert (
        "V̇(x) + 2λV(x) < 0" in text
        and "stays in it for all time" in text
        and "sampl"
        not in text.split("Figures")[0].replace("A sampled controller", "").replace("held between samples", "")
    )
    assert ["rate λ", "0.25 per s"] in found.rows


# A nearby equilibrium


def nearby(*, push: bool, rate: float = 0.0, timing: TimingInWords | None = None) -> Certificate:
    """A practical claim with one condition more."""
    timing = timing or TimingInWords()
    ball = LocalBall(np.eye(2), np.ones((3, 2)), np.eye(2))
    evidence = PartitionTree(
        np.eye(2),
        np.ones(2),
        bytes([255]),
        ball,
        cells=(1,) * push,
        contraction=Contraction(np.eye(2), np.ones(2), np.eye(2), order=1 if timing.sample else None),
    )
    claim = Nearby(roa=2.0, local=0.5, floor=0.125, rate=rate)
    return Certificate(integrator(timing, push=push), gain("1", 2), Quadratic(np.eye(2)), claim, evidence)


def test_one_equilibrium_is_said_of_constants_alone() -> None:
    found = page(nearby(push=True, rate=0.25))
    assert (
        "stays there from then on. Moreover V(x(t)) ≤ V(x(0)) e^(−2λt) until it is in the smaller set, with λ = 0.25 "
        "per s: it is there after ln(c₂/c₀)/(2λ) = 5.54518 s at the latest. And where what is uncertain is constant in "
        "time, there is exactly one equilibrium in the smaller set, and every one of these trajectories converges to "
        "it."
    ) in found.text
    assert "Contraction. 2(x − y)′P(F(x) − F(y)) < 0" in found.text and "That is all" not in found.text
    said = outside(found)
    assert "Where the equilibrium is." in said and "Where something uncertain changes with time" in said
    assert "Region of attraction" not in found.text and "asymptotically" not in found.text
    alone = page(nearby(push=False))
    assert "And there is exactly one equilibrium in the smaller set" in alone.text
    assert "c₀ = 0.125 (floor), c₁ = 0.5 (local)" in alone.text
    headline = printed(result_of(TimingInWords(), nearby(push=True).claim, push=True).to_dict())
    assert (
        "enters {V <= 0.125} and stays there; where what is uncertain is constant in time, it converges to the one "
        "equilibrium in that set"
    ) in headline


@pytest.mark.parametrize("timing", ["discrete", "exact", "range"])
def test_trajectories_come_closer_with_steps(timing: str) -> None:
    text, held = page(nearby(push=False, timing=TIMINGS[timing])).text, timing != "discrete"
    (said,) = (part for part in text.split("Contraction. ")[1:] if part.startswith("V("))
    condition = said.split("by models")[0]
    closer = "V(φ(h, x) − φ(h, y)) < V(x − y)" if held else "V(F(x) − F(y)) < V(x − y)"
    assert condition.startswith(f"{closer} for all x other than y with V(x) ≤ c₀ and V(y) ≤ c₀")
    assert ("and φ(h, x) = x only where F(x) = 0" in condition) == held and "2(x − y)′P" not in text
    assert ("every" in condition) == (timing == "range")


# Times


@given(
    st.fractions(min_value=1, max_value=10**12, max_denominator=10**12),
    st.floats(min_value=1e-9, max_value=1e9),
)
def test_a_time_is_never_too_short(factor: Fraction, rate: float) -> None:
    time = TimingInWords(rate=rate).time_to_fall(factor)
    exact = flint.arb(flint.fmpq(factor.numerator, factor.denominator)).log() / (2 * flint.arb(rate))
    assert exact <= flint.arb(time) and flint.arb(time) <= exact * (1 + 1e-12) + 1e-15 / rate
    steps = TimingInWords(discrete=True, rate=rate).time_to_fall(factor)
    assert steps == math.ceil(time)
    sampled = TimingInWords(sample=RANGE, rate=rate).reach_time(factor)
    assert sampled is not None and F(sampled) >= F(time) + RANGE[1]


def test_times_that_no_number_holds() -> None:
    assert TimingInWords().reach_time(100) is None and TimingInWords(rate=5e-324).reach_time(100) is None
    assert reach_time(TimingInWords(rate=1e308), None, 1.0) > 0  # type: ignore[operator]
    assert reach_time(TimingInWords(rate=1.0), 5e-324, 1e308) == pytest.approx((math.log(1e308) - math.log(5e-324)) / 2)
    assert "= " not in TimingInWords(rate=5e-324).speed(1.0, 2.0).split("/(2λ)")[1]


# Simulation


@pytest.mark.parametrize("h", [F(1, 50), F(1, 2), F(3, 2)])
def test_a_held_input_is_held(h: Fraction) -> None:
    """x' = u, u = -x held: x(t_k) = (1 - h)^k x(0), which Runge-Kutta gets exactly."""
    system = integrator(TimingInWords(sample=(h, h)))
    flow = Flow.of(system, gain("1", 2))
    step = flow.fitting(0.3)
    apart = flow.steps_between(step)
    assert apart * step == pytest.approx(float(h)) and step <= 0.3
    path = simulate(flow, np.array([[1.0, 0.5], [-0.5, 1.0]]), step, 6 * apart)[::apart]
    expected = (1 - float(h)) ** np.arange(7)
    assert path[:, :, 0] == pytest.approx(expected[:, None] * np.array([1.0, -0.5]))
    assert path[:, 0, 1] == pytest.approx(0.5 * np.exp(-float(h) * np.arange(7)), rel=1e-3)


def test_too_long_a_period_leaves_though_the_continuous_loop_settles() -> None:
    held = integrator(TimingInWords(sample=(F(5, 2), F(5, 2))))  # 1 - h = -3/2
    P, network = np.eye(2), gain("1", 2)
    for system, attracted in ((held, False), (integrator(TimingInWords()), True)):
        roa = simulated_roa_fraction(system, network, P, 1.0, points=9, horizon=30.0)
        off = np.abs(roa.axes[0]) > 0.1
        assert np.all(roa.attracted[off] == attracted)


def test_a_run_may_pass_the_level_between_two_instants() -> None:
    """x' = u, y' = x with a long period: V rises on the way, and only what it is at the instants counts."""
    x, u = symbols("x u")
    t = Symbol("t")
    # t turns once in a period and carries x out and back
    system = System("detour", (x, t), (u,), {}, (-x * t, Number(0)), (Number(0),), box(9, 9), box(1),
                    sample=(F(1), F(1)))  # fmt: skip
    flow = Flow.of(
        system, PolicyNetwork.of_layers((np.zeros((1, 2)),), (np.zeros(1),), np.ones(1), np.zeros(1), "tanh", "none")
    )
    path = simulate(flow, np.array([[1.0, 1.0]]), 0.25, 4)
    V = quadratic(np.eye(2), path)[:, 0]
    level = float(V[0])
    runs = runs_of(flow, np.array([[1.0, 1.0], [1.0, -1.0]]), np.eye(2), level, 0.1, 0.25, 8)
    assert runs.left.tolist() == [False, True]


def test_a_discrete_plant_takes_its_own_steps() -> None:
    timing = TIMINGS["discrete"]
    flow = Flow.of(integrator(timing), gain("5", 2))
    assert flow.fitting(0.01) == 1.0 and flow.steps_between(1.0) == 1
    path = simulate(flow, np.array([[1.0, -1.0]]), 1.0, 10)
    assert path[:, 0, 0] == pytest.approx(0.9 ** np.arange(11)) and path[:, 0, 1] == pytest.approx(
        -(0.98 ** np.arange(11))
    )
    step, horizon = time_scales(flow)
    assert step == 1.0 and horizon == pytest.approx(math.ceil(15 / -math.log(0.98)), abs=1)
    roa = simulated_roa_fraction(integrator(timing), gain("1", 2), np.eye(2), 1.0, points=5)
    assert roa.step == 1.0 and roa.attracted.all()


def test_the_change_of_V() -> None:
    x, P = np.array([[1.0, 0.0], [0.5, 0.0]]), np.eye(2)
    for h in (F(1, 50), F(1, 2)):
        flow = Flow.of(integrator(TimingInWords(sample=(h, h))), gain("1", 2))
        assert growth(flow, P, x, 0.1) == pytest.approx(((1 - float(h)) ** 2 - 1) / float(h) * x[:, 0] ** 2)
    flow = Flow.of(integrator(TIMINGS["discrete"]), gain("5", 2))
    assert growth(flow, P, x, 1.0) == pytest.approx((0.81 - 1) * x[:, 0] ** 2)
    flow = Flow.of(integrator(TimingInWords()), gain("1", 2))
    assert growth(flow, P, x, 1.0) == pytest.approx(-2 * x[:, 0] ** 2)


# Results


def result_of(timing: TimingInWords, claim: Claim, *, push: bool = False) -> RoaResult:
    system, network = integrator(timing, push=push), gain("1", 2)
    problem = Problem(ClosedLoop(system, network), Quadratic(np.eye(2)), claim.rate)
    return RoaResult(
        Verdict.PROVED, Stop.REQUESTED, system, network, claim.kind, problem=problem, levels=Levels(**claim.levels),
        checker={"result": "ACCEPTED"}, seconds={"total": 1.0},
    )  # fmt: skip


def printed(data: dict[str, Any]) -> str:
    stream = io.StringIO()
    Console(file=stream, width=600, no_color=True).print(summary(data))
    return " ".join(stream.getvalue().split())


def test_the_json_of_a_plain_claim_is_what_it_was() -> None:
    data = result_of(TimingInWords(), asymptotic()).to_dict()
    assert data["claim"] == {"kind": "asymptotic"} and data["time"] == "continuous" and data["reach_time"] is None
    assert data["levels"]["ultimate"] is None
    json.dumps(data)


def test_the_json_of_a_sampled_claim_with_a_rate() -> None:
    result = result_of(TIMINGS["range"], practical(0.25))
    data = result.to_dict()
    assert data["claim"] == {"kind": "practical", "rate": 0.25, "sample": ["1/100", "1/50"]}
    assert data["levels"]["ultimate"] == data["levels"]["floor"] == 0.125
    assert data["reach_time"] == pytest.approx(math.log(16) / 0.5 + 0.02) and data["reach_time"] == result.reach_time
    assert "input held over any sequence of periods in [0.01, 0.02] s" in repr(result)
    unknown = RoaResult(Verdict.UNKNOWN, Stop.TIME, result.system, result.network, problem=result.problem)
    assert unknown.reach_time is None and unknown.to_dict()["claim"]["rate"] == 0.25  # what was asked for


@pytest.mark.parametrize("kind", ["asymptotic", "practical"])
@pytest.mark.parametrize("timing", STEPPED)
def test_the_summary_says_when(timing: str, kind: str) -> None:
    claim = asymptotic(0.25) if kind == "asymptotic" else practical(0.25)
    said = printed(result_of(TIMINGS[timing], claim).to_dict())
    headline = said.split(" limited by ")[0].split(" rate ")[0]
    when = {"exact": "at sampling instants", "range": "at sampling instants", "from 0": "from each sampling instant on"}
    then = {"from 0": "is there at all times from then on"}
    if kind == "asymptotic":
        assert f"is invariant {when.get(timing, 'at every step')} and attracted by the origin" in headline
    else:
        assert then.get(timing, "at every s") in headline
    assert (", the input held over" in headline) == (timing != "discrete")
    assert "V falling at least as exp(-2*0.25 " in headline and "0.25 per s" in said
    assert "at the latest" in said
    asked = printed({**result_of(TIMINGS[timing], claim).to_dict(), "verdict": "UNKNOWN", "checked": None})
    assert "asked for 0.25 per" in asked and "at the latest" not in asked and "PROVED" not in asked


def test_a_plain_summary_says_nothing_of_times() -> None:
    said = printed(result_of(TimingInWords(), asymptotic()).to_dict())
    assert not re.search(r"sampl(ing|e )|held|rate|step", said), said


def test_what_limits_names_the_step() -> None:
    data = result_of(TIMINGS["exact"], asymptotic(0.1)).to_dict() | {"reason": "witness"}
    assert limited_by(data) == "a point where V does not fall at the rate asked for over a period"
    assert (
        limited_by(result_of(TimingInWords(), asymptotic()).to_dict() | {"reason": "witness"})
        == "a point where Vdot >= 0"
    )


# The checker's words


def printed_by_checker(timing: TimingInWords, claim: Claim, *, push: bool = False) -> list[str]:
    raw = claimed(timing, claim, push=push).to_json().encode()
    read = document.certificate(json.loads(raw), hashlib.sha256(raw).hexdigest())
    answer = {"result": "ACCEPTED", "rules": {"tree": 1}, "modules": ["ring"], "margins": {"local": 0.5, "ring": 0.25}}
    return checker_words.report(read, answer)


def test_the_checker_prints_the_claim_of_a_sampled_loop() -> None:
    lines = printed_by_checker(TIMINGS["range"], practical(0.25))
    text = "\n".join(lines)
    assert "plant integrator: xdot = f(x, u)" in text and "x' = (u + 0)" in text
    assert "that starts in V <= 2.0 at a sampling instant is there at every later sampling instant" in text
    assert (
        "in the domain at all times, enters V <= 0.125 at some sampling instant and is there at every sampling" in text
    )
    assert "for any sequence of periods in [1/100 (about 0.01), 1/50 (about 0.02)] units of time" in text
    assert "V(x(t_k)) <= V(x(t_0)) exp(-2 lambda (t_k - t_0)) at sampling instants, until V <= 0.125" in text
    assert "lambda = 0.25" in text and "smallest bound of -(D + 2 lambda V) on" in text and "Vdot" not in text
    assert lines[-1].startswith("ACCEPTED c0=0.125 c1=0.5 c2=2.0 sha256=")
    kept = "\n".join(printed_by_checker(TIMINGS["from 0"], practical()))
    assert "is there at all later times" in kept and "lambda" not in kept


def test_the_checker_prints_the_claim_of_a_discrete_plant() -> None:
    text = "\n".join(printed_by_checker(TIMINGS["discrete"], practical(), push=True))
    assert "x+ = f(x, u)" in text and "for every w(k) in" in text and "  y+ = " in text and "xdot" not in text
    assert (
        "is there at every later step, enters V <= 0.125 after finitely many steps and is there at every step" in text
    )
    assert "-D on a ring" in text


def test_the_checker_prints_a_plain_claim_as_ever() -> None:
    text = "\n".join(printed_by_checker(TIMINGS["plain"], asymptotic()))
    assert (
        "claim: the origin is asymptotically stable, and every trajectory of the closed loop that starts in V <= 2.0 "
        "stays there and converges to the origin; u stays in its bounds\nrules that held"
    ) in text
    assert "smallest bound of -Vdot on a ring's leaf" in text


def test_rates_are_rounded_down() -> None:
    shown = TimingInWords(rate=1 / 3).shown_rate.removesuffix(" per s")
    assert exactly(shown) <= F(1 / 3) and shown == "0.333333"
