"""A suggestion is true: whoever follows it gets what it promises."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

from certify.analysis.candidates.trials import Trial, trial
from certify.analysis.diagnosis import diagnose
from certify.analysis.facts import SimulatedFacts, Step
from certify.analysis.options import RoaOptions
from certify.analysis.results import RoaResult
from certify.analysis.run import certify_roa
from certify.analysis.suggested import limited_outside
from certify.certificates.verdict import Stop, Verdict
from certify.loop.closed_loop import ClosedLoop
from certify.loop.plants import System, get_system
from certify.loop.policies import load_policy
from tests.support.loops import chain

PENDULUM = Path(__file__).parents[2] / "examples" / "policies" / "pendulum.pt"
LITTLE = RoaOptions(effort=0.2)


def step_of(result: RoaResult, options: RoaOptions) -> Step:
    found = diagnose(result, options, None).next
    assert found is not None
    return found


def widened(system: System, step: Step) -> System:
    """The plant with the domain that a step suggests, whose sides are symmetric."""
    name, _, end = dict(step.options)["--domain"].partition("=")
    return system.with_domain({name: (-Fraction(end), Fraction(end))})


@pytest.fixture(scope="module")
def pendulum_result(tmp_path_factory: pytest.TempPathFactory) -> RoaResult:
    network = load_policy(PENDULUM).network
    return certify_roa(get_system("pendulum"), network, tmp_path_factory.mktemp("pendulum"), LITTLE)


@pytest.mark.slow
def test_a_wider_domain_that_is_suggested_gives_a_larger_set(pendulum_result: RoaResult, tmp_path: Path) -> None:
    """Both sides of the domain bind, so this very V reaches no further: another one does, and the run finds it."""
    assert pendulum_result.diagnosis is not None
    step = pendulum_result.diagnosis.next
    assert dict(step.options) == {"--domain": "theta_dot=25"} and "a V that is stretched" in step.why
    wider = certify_roa(widened(pendulum_result.system, step), pendulum_result.network, tmp_path, LITTLE)
    assert wider.volume is not None and pendulum_result.volume is not None
    assert wider.volume > 1.2 * pendulum_result.volume


def test_a_domain_that_allows_no_more_is_not_sampled(
    pendulum_result: RoaResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both sides of the domain bind, so that this V is not sampled where one is wider: only what is stretched is."""
    sampled, of = list[float](), trial

    def noted(loop: ClosedLoop, P: np.ndarray, *given: Any) -> Trial:
        sampled.append(float(P[1, 1]))
        return of(loop, P, *given)

    monkeypatch.setattr("certify.analysis.diagnosis.trial", noted)
    step = step_of(pendulum_result, LITTLE)
    assert dict(step.options) == {"--domain": "theta_dot=25"}
    assert pendulum_result.P is not None and len(sampled) == 2
    assert all(entry < 0.9 * pendulum_result.P[1, 1] for entry in sampled)


def test_a_wider_domain_is_suggested_for_this_v_where_it_alone_reaches_further(tmp_path: Path) -> None:
    system, network = chain(2, [-1.0, -2.0])
    options = replace(LITTLE, P=np.array([[1.0, 0.2], [0.2, 0.3]]))
    result = certify_roa(system, network, tmp_path, options)
    assert result.reason == "domain" and result.volume is not None
    step = step_of(result, options)
    assert "to this V" in step.why
    wider = certify_roa(widened(system, step), network, tmp_path / "wider", options)
    promised = float(step.why.partition("samples allow ")[2].split()[0])
    assert wider.volume == pytest.approx(promised * result.volume, rel=0.02)


def test_a_v_that_is_given_is_not_stretched(pendulum_result: RoaResult) -> None:
    assert pendulum_result.P is not None
    step = step_of(pendulum_result, replace(LITTLE, P=pendulum_result.P))
    assert step.options == () and step.why.startswith("samples allow hardly more to this V where the domain is wider")


def test_another_candidate_is_suggested_with_the_domain_that_needs_it(pendulum_result: RoaResult) -> None:
    step = step_of(pendulum_result, replace(LITTLE, candidate="lqr"))
    assert dict(step.options) == {"--domain": "theta_dot=25", "--candidate": "auto"}


def test_a_domain_that_no_sample_tells_of_is_suggested_without_a_number(
    pendulum_result: RoaResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("certify.analysis.diagnosis._LOOK", 1.0)
    step = step_of(pendulum_result, LITTLE)
    assert dict(step.options) == {"--domain": "theta_dot=30"} and step.why.endswith("the set may be larger")


def test_no_wider_domain_is_suggested_where_samples_allow_no_more(
    pendulum_result: RoaResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("certify.analysis.diagnosis._WORTH", 2.0)
    step = step_of(pendulum_result, LITTLE)
    assert step.options == ()
    assert step.why == (
        "samples allow hardly more to this V, and to one that is stretched along with the domain, where the domain is "
        "wider in θ̇ or θ"
    )


@pytest.mark.parametrize("claim, said", [("asymptotic", "no V can prove"), ("practical", "you must give P yourself")])
def test_an_unstable_loop_needs_another_policy(
    tmp_path: Path, claim: Literal["asymptotic", "practical"], said: str
) -> None:
    """The practical claim may still hold beyond a floor, and a P that is given may show it."""
    system, network = chain(1, [0.5])
    result = certify_roa(system, network, tmp_path, RoaOptions(claim=claim))
    assert result.diagnosis is not None and result.diagnosis.next.options == ()
    assert result.diagnosis.next.why.startswith("another policy") and said in result.diagnosis.next.why


@pytest.mark.parametrize("precision", [np.float32, np.float64])
def test_a_clip_that_a_rounding_puts_out_of_bounds_is_named(tmp_path: Path, precision: Any) -> None:
    """The policy saturates at 0.4, in both precisions above 2/5; clipped inside, the whole domain is proved."""
    (system, network), quick = chain(1, [-1.0]), RoaOptions(effort=0.01, candidate="lyapunov")
    bounded = replace(system, input_bounds=((Fraction(-2, 5), Fraction(2, 5)),))
    most = np.array([float(precision(0.4))])
    result = certify_roa(bounded, replace(network, clip=(-most, most)), tmp_path, quick)
    assert result.diagnosis is not None and result.diagnosis.next.why.startswith("u is clipped at -0.4")
    little = replace(result, stop=Stop.WITNESS, simulated=SimulatedFacts(1000, 500, 50))  # V ends before the clip does
    assert diagnose(little, quick, None).next.why.startswith("u is clipped at -0.4")
    inside = np.nextafter([0.4], 0)
    assert certify_roa(bounded, replace(network, clip=(-inside, inside)), tmp_path, quick).stop is Stop.DOMAIN


def test_a_squash_that_a_rounding_puts_out_of_bounds_is_named(tmp_path: Path) -> None:
    """float32's 0.4 is above 2/5, and so is the nearest double, by too little to matter. It is named even where nearly
    all of what converges is proved, if a clip would add to that."""
    (system, network), quick = chain(1, [-1.0]), RoaOptions(effort=0.01, candidate="lyapunov")
    bounded = replace(system, input_bounds=((Fraction(-2, 5), Fraction(2, 5)),))
    single, double = (replace(network, squash="tanh", scale=np.array([v])) for v in (float(np.float32(0.4)), 0.4))
    said = limited_outside(bounded, single)
    assert said is not None and said.startswith("u is squashed to -0.4000000059604644")
    assert limited_outside(bounded, double) is None and limited_outside(system, single) is None
    result = certify_roa(bounded, single, tmp_path, quick)
    for clipped, named in ((900, True), (500, False)):
        nearly = replace(result, stop=Stop.WITNESS, simulated=SimulatedFacts(1000, 500, 490, clipped))
        assert (diagnose(nearly, quick, None).next.why == said) is named


@pytest.mark.parametrize("claim", ["asymptotic", "practical"])
def test_a_period_that_is_too_long_is_to_be_shorter(tmp_path: Path, claim: Literal["asymptotic", "practical"]) -> None:
    """x' = u with u = -x held over 5 s: a step multiplies by 1 - h, which is -1/4 at a quarter and -3/2 at a half."""
    system, network = chain(1, [-1.0])
    held = system.with_sample((Fraction(5), Fraction(5)))
    result = certify_roa(held, network, tmp_path, RoaOptions(claim=claim))
    assert result.stop is Stop.UNSTABLE and result.diagnosis is not None
    assert result.diagnosis.next.options == (("--sample-time", "1.25"),)


@pytest.mark.filterwarnings("error")
def test_a_plant_that_rests_elsewhere_is_to_be_corrected(tmp_path: Path) -> None:
    """No warning of floats on the way: levels sink to 0 around a point at which nothing rests."""
    system, network = chain(2, [-1.0, -2.0])
    law = network.with_layers(biases=(np.zeros(1),), centre="output")
    x, v = system.states
    pushed = replace(system, dynamics=(v, system.inputs[0] - 2 + 0 * x), input_bounds=((Fraction(-1), Fraction(1)),))
    result = certify_roa(pushed, law, tmp_path, LITTLE)
    assert result.verdict is Verdict.UNKNOWN and result.diagnosis is not None
    assert "x2' = -2" in result.diagnosis.next.why and "Correct x_eq or u_eq" in result.diagnosis.next.why


def test_a_level_that_is_refuted_is_to_be_left_out(pendulum_result: RoaResult, tmp_path: Path) -> None:
    options = replace(LITTLE, level=20.0)
    refuted = certify_roa(pendulum_result.system, pendulum_result.network, tmp_path, options)
    assert refuted.verdict is Verdict.REFUTED and refuted.diagnosis is not None
    assert refuted.diagnosis.next.why.startswith("leave --level out")
    assert "the level is of the V of --candidate lyapunov" in refuted.diagnosis.next.why
    refuted = certify_roa(
        pendulum_result.system, pendulum_result.network, tmp_path, replace(options, candidate="scaled")
    )
    assert refuted.diagnosis is not None and "candidate" not in refuted.diagnosis.next.why


def test_a_policy_that_is_out_of_bounds_at_rest_is_to_be_read_again(tmp_path: Path) -> None:
    """Not to be shifted by 50, though that centres it: its observations or its action's scale were misread."""
    system, network = chain(1, [-1.0])
    bounded = replace(system, input_bounds=((Fraction(-1), Fraction(1)),))
    result = certify_roa(bounded, network.with_layers(biases=(np.array([50.0]),)), tmp_path, RoaOptions(effort=0.01))
    assert result.diagnosis is not None and result.diagnosis.next.options == ()
    assert "commands u = 50, outside of -1..1" in result.diagnosis.next.why


def test_a_rate_below_the_slowest_mode_is_proved(tmp_path: Path) -> None:
    """The modes are -1 and -2; the V of Q = I falls at 0.38 alone near the origin."""
    assert certify_roa(*chain(2, [-1.0, -2.0]), tmp_path, RoaOptions(rate=0.8, effort=0.02)).verdict is Verdict.PROVED
