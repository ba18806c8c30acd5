"""Certificates with ranges: words say for what the claim holds, and for nothing more; figures say what they show."""

from __future__ import annotations

import io
import re
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from certify import certify_roa
from certify.analysis.results import RoaResult
from certify.certificates import Certificate, PartitionTree, parse_certificate
from certify.certificates.claims import Asymptotic, Practical
from certify.certificates.verdict import Verdict
from certify.loop.expressions import Number, cos, sin, symbols
from certify.loop.plants import System, at_values, with_input_errors
from certify.loop.policies import PolicyNetwork
from certify.lyapunov.function import Quadratic
from certify.report import render_html, summary
from certify.report.figures.paper import PaperOptions, paper_figure
from certify.report.mathml import typeset
from certify.report.words import Varying, held_at, inside, stated_for, varying_in
from tests.report.test_report import Page, exactly
from tests.report.test_tube import soft_spring

F = Fraction
HALF = ((F(-1), F(1)),)


def spring() -> tuple[System, PolicyNetwork]:
    """The soft spring with a stiffness, and a wind."""
    system, network = soft_spring()
    p, v, u, k, wind = symbols("p v u k wind")
    f = (v, -k * p + p**3 / 4 - 2 * v + u + wind)
    return (
        System(
            "spring", (p, v), (u,), {"k": F(1)}, f, (Number(0),), system.domain, system.input_bounds,
            units={**system.units, "k": "N/m", "wind": "N"}, disturbances=(wind,),
        ),
        network,
    )  # fmt: skip


def claimed(system: System, network: PolicyNetwork, *, practical: bool = False) -> Certificate:
    """A claim that nobody has checked."""
    n = system.n
    claim = Practical(roa=0.5, local=0.1, floor=0.1) if practical else Asymptotic(roa=0.5, local=0.5)
    evidence = PartitionTree(np.eye(n), np.ones(n), bytes([255]), cells=(1,) * len(system.ranges))
    written = Certificate(system, network, Quadratic(np.eye(n)), claim, evidence)
    return parse_certificate(written.to_json().encode(), "c")  # as a reader has it, without kinds and nominal values


def page(certificate: Certificate) -> Page:
    return Page(render_html(certificate, None, None, Path("certificate.json")))


def outside(found: Page) -> str:
    """What the page says under what lies outside the claim."""
    return re.search(r"Even with one, this would not be: (.*?) Figures ", found.text)[1]  # type: ignore[index]


@pytest.fixture(scope="module")
def proved(tmp_path_factory: pytest.TempPathFactory) -> RoaResult:
    folder = tmp_path_factory.mktemp("spring")
    result = certify_roa(*spring(), folder, candidate="lyapunov", level=0.5, ranges={"k": ("0.75", "2.25")})
    assert result.verdict is Verdict.PROVED
    return result


def printed(result: RoaResult, width: int = 400) -> str:
    stream = io.StringIO()
    Console(file=stream, width=width, no_color=True).print(summary(result.to_dict()))
    return stream.getvalue()


rationals = st.fractions(min_value=-(10**6), max_value=10**6, max_denominator=10**9)


@given(rationals, rationals)
def test_a_range_is_shown_inside_itself(a: Fraction, b: Fraction) -> None:
    """What is shown is never more than what was proved, and never empty."""
    lo, hi = min(a, b), max(a, b)
    if lo == hi:
        hi += F(1, 10**12)
    first, last = map(exactly, inside(lo, hi)[1:-1].split(", "))
    assert lo <= first < last <= hi


@given(st.fractions(min_value=F(1, 10**9), max_value=10**9, max_denominator=10**9))
def test_a_half_width_is_rounded_down(half: Fraction) -> None:
    shown = Varying("w", -half, half).words.removeprefix("w(t) within ±")
    assert half * (1 - F(1, 10**5)) < exactly(shown) <= half


def test_words_of_ranges() -> None:
    quantities = [Varying("m", F("0.135"), F("0.165"), "kg"), Varying("theta_0", F(-1), F(2), "rad/s^2")]
    said = stated_for(quantities, "Every one.")
    assert said.startswith(
        "For every m(t) in [0.135, 0.165] kg and θ₀(t) in [−1, 2] rad/s², each any measurable function"
    )
    assert "all of them at once" in said and said.endswith("the following holds. Every one.")
    alone = stated_for(quantities[:1], "Every one.")
    assert alone.startswith("For every m(t) in [0.135, 0.165] kg, any measurable function of time \N{EM DASH} constant")
    assert stated_for([], "Every one.") == "Every one."
    system, _ = spring()
    assert held_at(system) == "" and varying_in(system) == ()
    acting = system.with_ranges({"k": (F(1, 2), F(2)), "wind": (F(-1), F(1))})
    assert held_at(acting) == "k = 1 N/m and wind = 0 N"


def test_the_page_says_for_what_it_holds_wherever_it_claims(proved: RoaResult) -> None:
    found = Page(proved.report().read_text("utf-8"))
    text = found.text
    stated = "For every k(t) in [0.75, 2.25] N/m, any measurable function of time"
    assert f"What was proved {stated}" in text and "the following holds. Every trajectory of the closed loop" in text
    assert "dx/dt = f(x, π(x), k) in exact real arithmetic" in text
    assert "Uncertain in them is k(t) in [0.75, 2.25] N/m: nothing but the range is known, at any time." in text
    assert "One V, one P and one policy with one u_eq serve all of these values." in text
    assert "parts, each of them for all values in the ranges:" in text
    assert re.search(r"over the remainder: [\d.]+ %(, the least of \d+ cells of the box of all ranges)?\.", text)
    assert "the error comes on top" not in text


def test_everything_simulated_says_at_which_value(proved: RoaResult) -> None:
    found = Page(proved.report().read_text("utf-8"))
    captions = re.findall(
        r"[^.]*(?:simulated|Simulated or evaluated|imulation)[^.]*(?:with k = 1 N/m throughout)", found.text
    )
    assert len(captions) >= 2
    assert "Simulated or evaluated on a grid with k = 1 N/m throughout, not proved." in found.text
    assert "on the continuous closed loop with k = 1 N/m throughout" in found.text
    assert "all of them with k = 1 N/m from beginning to end" in found.text
    assert any(row[0] == "eigenvalues of the closed loop with k = 1 N/m" for row in found.rows if row)
    assert "Modes at the equilibrium, with k = 1 N/m: " in found.text


def test_what_was_not_proved_shrinks_by_the_ranges_alone() -> None:
    system, network = spring()
    exact = outside(page(claimed(system, network)))
    assert "exactly these numbers: no other mass" in exact and "Disturbances. No wind, no sensor noise" in exact
    assert "Rounding in the controller." in exact
    ranged = outside(page(claimed(system.with_ranges({"k": (F(1, 2), F(3, 2))}), network)))
    assert "with every value of k in its range and none outside, and with exactly these numbers in all else" in ranged
    assert "Other disturbances. Only what k can be in these equations" in ranged
    assert "sensor noise, no estimation error, no delay" in ranged
    assert "Rounding in the controller." in ranged  # nothing bounds it here
    for always in ("Anything outside the set.", "A sampled controller.", "Wrapped angles.", "Speed and cost."):
        assert always in exact and always in ranged


def test_an_error_of_the_input_comes_on_top_of_what_stays_in_bounds() -> None:
    system, network = spring()
    found = page(claimed(with_input_errors(system, {"u": F(1, 1000)}), network, practical=True))
    assert (
        "On the way what the policy asks for, π(x), stays within −1 ≤ u ≤ 1 N; the error comes on top of it."
        in found.text
    )
    assert "The actuator receives u + error_u, where u = π(x) is what the policy asks for." in found.text
    assert "An actuator that clips the two together makes the error no larger, and is covered." in found.text
    said = outside(found)
    assert (
        "Larger errors of the controller. An evaluation of the policy, in float32 for one, is covered as long as"
        in said
    )
    assert "error_u(t) within ±0.001 N" in said and "must be exact" not in said
    assert "Rounding in the controller." not in said


def test_a_name_alone_covers_no_rounding() -> None:
    """A file may call anything error_u: what the equations do not add to u is no error of it."""
    system, network = spring()
    p, v, u, e = symbols("p v u error_u")
    forged = System(
        "forged", (p, v), (u,), {}, (v, -p - 2 * v + u + p * e), (Number(0),), system.domain,
        system.input_bounds, disturbances=(e,), ranges={"error_u": (F(-1), F(1))},
    )  # fmt: skip
    found = page(claimed(forged, network))
    assert "Rounding in the controller." in outside(found) and "comes on top" not in found.text
    assert "The actuator receives" not in found.text


def test_inputs_without_an_error_must_be_exact() -> None:
    x, a, b = symbols("x a b")
    system = System("two", (x,), (a, b), {}, (-x + a - b,), (Number(0),) * 2, HALF, HALF * 2)
    network = PolicyNetwork.of_layers((np.zeros((2, 1)),), (np.zeros(2),), np.ones(2), np.zeros(2), "tanh", "none")
    said = outside(page(claimed(with_input_errors(system, {"b": F(1, 100)}), network, practical=True)))
    assert "error_b(t) within ±0.01" in said and "a must be exact." in said


def test_names_in_equations_are_typeset_as_they_are() -> None:
    """A quantity called I or lambda is no unit and no keyword, and its markup is escaped like every other name."""
    x, u, i = symbols("x u I")
    system = System("s", (x,), (u,), {"I": F(2)}, (-x / i + u,), (Number(0),), HALF, HALF)
    network = PolicyNetwork.of_layers((np.zeros((1, 1)),), (np.zeros(1),), np.ones(1), np.zeros(1), "tanh", "none")
    html = render_html(claimed(system.with_ranges({"I": (F(1), F(3))}), network), None, None, Path("c.json"))
    assert "<mi>I</mi>" in html and "I(t) in [1, 3]" in html


def test_brackets_around_a_letter_do_not_grow_and_its_dot_is_not_small() -> None:
    """Around a fraction they grow."""
    angle, p = symbols("theta_dot p")
    dot = '<mover><mi>θ</mi><mo scriptlevel="0">˙</mo></mover>'
    said = str(typeset("<mi>y</mi>", sin(angle) + cos(p / 2 + 1)))
    assert f'<mi>sin</mi><mo stretchy="false">(</mo><mrow>{dot}</mrow><mo stretchy="false">)</mo>' in said
    assert "<mi>cos</mi><mo>(</mo><mrow>" in said


def test_the_summary_begins_with_the_ranges(proved: RoaResult) -> None:
    said = printed(proved)
    assert (
        "PROVED  spring: for every k(t) in [0.75, 2.25] N/m, {V <= 0.5} is invariant and attracted by the origin"
        in said
    )
    assert re.search(
        r"for every +k\(t\) in \[0\.75, 2\.25\] N/m: any measurable functions of time: constant, drifting or jumping",
        said,
    )
    assert "(at the nominal values)" in said


def test_a_summary_without_ranges_says_nothing_of_them(tmp_path: Path) -> None:
    result = certify_roa(*spring(), tmp_path, candidate="lyapunov", level=0.1)
    said = printed(result)
    assert "for every" not in said and "nominal" not in said
    data = result.to_dict()
    del data["uncertain"]  # a result of an earlier version
    stream = io.StringIO()
    Console(file=stream, width=400, no_color=True).print(summary(data))
    assert stream.getvalue() == said
    text = Page(result.report().read_text("utf-8")).text
    assert "For every" not in text and "throughout" not in text and "range" not in text


def test_what_was_not_proved_is_only_asked_for(proved: RoaResult) -> None:
    data = proved.to_dict() | {"verdict": "UNKNOWN", "checked": None}
    stream = io.StringIO()
    Console(file=stream, width=400, no_color=True).print(summary(data))
    assert "nothing was proved" in stream.getvalue() and re.search(r"asked for every +k\(t\)", stream.getvalue())
    assert "PROVED" not in stream.getvalue()


def test_many_ranges_are_counted_in_the_headline(proved: RoaResult) -> None:
    each = {"kind": "disturbance", "lo": "-1", "hi": "1", "unit": "N"}
    data = proved.to_dict() | {"uncertain": [{"name": f"w{k}", **each} for k in range(5)]}
    stream = io.StringIO()
    Console(file=stream, width=600, no_color=True).print(summary(data))
    assert "for every one of the 5 uncertain quantities within its range at any time, {V <= 0.5}" in stream.getvalue()
    assert all(f"w{'₀₁₂₃₄'[k]}(t) within ±1 N" in stream.getvalue() for k in range(5))


def test_the_figure_of_a_paper_names_the_value(proved: RoaResult) -> None:
    assert proved.raw is not None
    certificate = parse_certificate(proved.raw, "c")
    drawn = paper_figure(certificate, True, PaperOptions(format="svg"))
    exact = certificate_of_nominal(certificate)
    other = paper_figure(exact, False, PaperOptions(format="svg"))
    assert "with k = 1 N/m throughout" in drawn.decode() and "throughout" not in other.decode()


def certificate_of_nominal(certificate: Certificate) -> Certificate:
    system = at_values(certificate.system, {"k": F(1)})
    return Certificate(system, certificate.network, certificate.V, certificate.claim, PartitionTree(
        np.eye(2), np.ones(2), bytes([255])
    ))  # fmt: skip
