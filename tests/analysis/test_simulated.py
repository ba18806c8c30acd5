"""A run goes on beyond the ellipsoid where that is little of what converges in simulation, and says the share.

The plant is x' = x (x - 1) (x + 3) under no input: its region of attraction is -3 < x < 1 by inspection, of which an
ellipsoid around 0 holds half. In discrete time it is x+ = x + x (x - 1) (x + 3) / 10, with the same region.
"""

from __future__ import annotations

import hashlib
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from certify import PolicyNetwork, System, certify_roa, get_system
from certify.analysis import suggested
from certify.analysis.acceptance import Clerk
from certify.analysis.facts import SimulatedFacts, Step
from certify.analysis.options import RoaOptions
from certify.analysis.results import RoaResult
from certify.analysis.simulated import Simulator, simulated_region
from certify.analysis.stages import simulation
from certify.analysis.stages.candidate import Candidate
from certify.analysis.stages.state import State
from certify.analysis.suggested import beyond_the_ellipsoid, side, wider
from certify.certificates import Certificate
from certify.certificates.verdict import Verdict
from certify.effort import UNIT, Effort
from certify.errors import InputError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import Expression, Number, Symbol, tanh
from certify.loop.policies import load_policy
from certify.lyapunov import Polynomial
from certify.lyapunov.function import Quadratic
from certify.lyapunov.learning import Learned, Learner
from certify.provers.ranks import search
from certify.report.rows import rows_of
from certify.report.sections.simulated import drawn_of
from certify.report.words import number, percent
from tests.support.marks import slow_after

POLICIES = Path(__file__).parents[2] / "examples" / "policies"
x, u = Symbol("x"), Symbol("u")
RATE = x * (x - 1) * (x + 3) + u
REST = PolicyNetwork.of_layers((np.zeros((1, 1)),), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none")


def plant(rate: Expression = RATE, lo: float = -4, hi: float = 2, time: str = "continuous") -> System:
    return System(
        name="lopsided",
        states=(x,),
        inputs=(u,),
        parameters={},
        dynamics=(rate,),
        u_eq=(Number(0),),
        domain=((Fraction(lo), Fraction(hi)),),
        input_bounds=((Fraction(-1), Fraction(1)),),
        time=time,  # type: ignore[arg-type]
    )


SQUARE = Polynomial(np.array([[2]]), np.array([1.0]))
STEPS = plant(x + RATE / 10, time="discrete")


def proved(folder: Path, system: System | None = None, **options: object) -> RoaResult:
    given: dict[str, object] = {"effort": 0.07} | options
    result = certify_roa(system or plant(), REST, folder, **given)  # type: ignore[arg-type]
    assert result.verdict is Verdict.PROVED
    return result


@pytest.fixture(scope="module")
def by_default(tmp_path_factory: pytest.TempPathFactory) -> RoaResult:
    return proved(tmp_path_factory.mktemp("default"))


@pytest.fixture(scope="module")
def in_steps(tmp_path_factory: pytest.TempPathFactory) -> RoaResult:
    return proved(tmp_path_factory.mktemp("steps"), STEPS, effort=0.04)


def test_states_that_converge_are_those_of_the_region(tmp_path: Path) -> None:
    found = simulated_region(Simulator(ClosedLoop(plant(), REST), Quadratic(np.eye(1)), 0.5), Effort(10 * UNIT))
    assert found is not None and found.runs >= 1000
    assert np.all((found.converging > -3.001) & (found.converging < 1.001))
    share = len(found.converging) / found.runs
    assert abs(share - 4 / 6) < 4 * (share * (1 - share) / found.runs) ** 0.5


@pytest.mark.parametrize("period", [None, 0.01])
def test_states_from_which_an_input_leaves_its_bounds_do_not_count(period: float | None) -> None:
    """The policy commands u = x, and |u| <= 1 is allowed; so no claim holds for runs from below -1, as for others."""
    follows = PolicyNetwork.of_layers((np.ones((1, 1)),), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none")
    system = plant()
    if period is not None:
        system = replace(system, sample=(Fraction(period), Fraction(period)))
    found = simulated_region(Simulator(ClosedLoop(system, follows), Quadratic(np.eye(1)), 0.5), Effort(10 * UNIT))
    assert found is not None and found.runs >= 1000
    assert found.converging.min() >= -1.001 and found.converging.min() < -0.9
    clipped = replace(follows, clip=(-np.ones(1), np.ones(1)))
    found = simulated_region(Simulator(ClosedLoop(system, clipped), Quadratic(np.eye(1)), 0.5), Effort(10 * UNIT))
    assert found is not None and found.converging.min() < -1.5


def test_the_states_that_a_clip_would_add_are_counted(tmp_path: Path) -> None:
    """The policy commands u = x where |u| <= 1 is allowed: states from below -1 converge if it saturates there."""
    follows = PolicyNetwork.of_layers((np.ones((1, 1)),), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none")
    found = certify_roa(plant(), follows, tmp_path, effort=0.04, candidate="ellipsoid")
    assert found.simulated is not None and found.diagnosis is not None
    counts, clipped = found.simulated, replace(follows, clip=(-np.ones(1), np.ones(1)))
    assert counts.clipped is not None and counts.clipped > 1.8 * counts.converging
    said = dict(rows_of(found.to_dict(), True))["simulated"]
    assert f"{counts.more:,} more would converge if the policy were clipped at the bounds of its inputs" in said
    whole = certify_roa(plant(), clipped, tmp_path / "clipped", effort=0.04, candidate="ellipsoid").simulated
    assert whole is not None and whole.clipped is None and whole.more == 0
    assert whole.converging / whole.runs == pytest.approx(counts.clipped / counts.runs, abs=0.05)


def test_runs_that_cannot_be_decided_tell_nothing() -> None:
    assert simulated_region(Simulator(ClosedLoop(plant(), REST), Quadratic(np.eye(1)), 0.5), Effort(1.0)) is None


@pytest.mark.parametrize("time", ["continuous", "held", "discrete"])
def test_runs_last_until_a_saturated_input_has_brought_them_home(time: str) -> None:
    """x' = -tanh(60 x) decays at 60 about 0, 15 time constants of which are 1/4; from 2 the way takes two units."""
    fast = -tanh(60 * x)
    system = plant(x + fast / 100, -2, time="discrete") if time == "discrete" else plant(fast, -2)
    if time == "held":
        system = replace(system, sample=(Fraction(1, 100), Fraction(1, 100)))
    runs = Simulator(ClosedLoop(system, REST), Quadratic(np.eye(1)), 1e-3)
    found = simulated_region(runs, Effort(10 * UNIT))
    assert found is not None and len(found.converging) == found.runs >= 1000


def test_runs_that_go_round_for_ever_are_not_followed_for_longer() -> None:
    """x' = x (x - 1) (x + 3) rests at 1 too: what is there neither converges nor leaves."""
    runs = Simulator(ClosedLoop(plant(), REST), Quadratic(np.eye(1)), 0.5)
    before, here = (runs.horizon, runs.farther), np.array([[1.0], [-1.0]])
    assert runs.converge(here, Effort(10 * UNIT)).tolist() == [False, True]
    assert (runs.horizon, runs.farther) == before and not runs.doublings


def test_the_default_goes_beyond_the_ellipsoid(by_default: RoaResult) -> None:
    assert by_default.outer is not None and by_default.simulated is not None
    assert np.array_equal(by_default.contains([[-2.0], [0.9], [-3.01], [1.01]]), [True, True, False, False])
    share = by_default.simulated.share
    assert share is not None and share > 0.85
    stated = by_default.to_dict()["simulated"]
    assert stated["proved"] <= stated["converging"] <= stated["runs"] and stated["share"] == share
    said = dict(rows_of(by_default.to_dict(), True))["simulated"]
    assert f"about {percent(share)} of what converges is proved" in said and "no part of the proof" in said


@pytest.mark.slow
def test_the_same_run_gives_the_same_bytes(by_default: RoaResult, tmp_path: Path) -> None:
    again = proved(tmp_path)
    assert again.raw is not None and by_default.raw == again.raw


@pytest.mark.parametrize(
    "options",
    slow_after(
        5,
        [
            {"candidate": "ellipsoid"},
            {"candidate": "lyapunov"},
            {"Q": (2.0,)},
            {"P": [[1.0]]},
            {"level": 0.1},
            {"rate": 0.01},
            {"enlarge": True},
        ],
    ),
)
def test_what_asks_for_an_ellipsoid_gets_one(options: dict[str, object], tmp_path: Path) -> None:
    result = proved(tmp_path, plant(), **{"effort": 0.04} | options)
    assert result.outer is None and result.simulated is not None
    assert result.simulated.share is not None and result.simulated.share < 0.6
    assert not result.contains([-2.0])


def test_an_ellipsoid_alone_is_suggested_to_go_on(tmp_path: Path) -> None:
    result = proved(tmp_path, candidate="ellipsoid")
    assert result.diagnosis is not None and dict(result.diagnosis.next.options) == {"--candidate": "auto"}


@pytest.mark.slow
def test_constraints_are_kept_beyond_the_ellipsoid(by_default: RoaResult, tmp_path: Path) -> None:
    """The wall takes states from the set and from the simulated region, by whose share the run went on."""
    result, everything = proved(tmp_path, keep="wall: x <= 0.4"), by_default.simulated
    assert result.verdict is Verdict.PROVED and result.constraints == {"wall": "x - 0.4 < 0"}
    assert result.outer is not None and result.simulated is not None and everything is not None
    assert not result.contains([0.41]) and result.simulated.converging < everything.converging
    assert (result.simulated.share or 0.0) > 0.6


@pytest.mark.slow
def test_an_ellipsoid_that_is_most_of_it_is_enough(tmp_path: Path) -> None:
    """The certificate is then the very one of the ellipsoid alone, and nothing is learned."""
    network = load_policy(POLICIES / "pendulum.pt").network
    found = [
        certify_roa(get_system("pendulum"), network, tmp_path / name, candidate=name, effort=0.2)
        for name in ("auto", "ellipsoid")
    ]
    assert found[0].raw == found[1].raw and found[0].outer is None
    assert all(one.simulated is not None and 0.8 < (one.simulated.share or 0.0) < 0.9 for one in found)
    assert "learn" not in found[0].seconds and found[0].simulated == found[1].simulated


def test_the_ellipsoid_stays_where_nothing_is_learned(
    by_default: RoaResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(*_: object) -> None:
        raise InputError("too little converges.")

    monkeypatch.setattr("certify.lyapunov.learning.learner_of", failing)
    result = proved(tmp_path)
    assert result.outer is None and result.levels == by_default.levels
    assert result.notice is not None and "no function is learned" in result.notice


def test_the_ellipsoid_stays_where_no_level_is_proved(
    by_default: RoaResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    falls_nowhere = Learned(Polynomial(np.array([[2]]), np.array([-1.0])), 1.0, 0.9, ())
    monkeypatch.setattr("certify.lyapunov.learning.Learner.learn", lambda *_: falls_nowhere)
    result = proved(tmp_path)
    assert result.outer is None and result.levels == by_default.levels
    assert result.notice is not None and "no set of the learned function" in result.notice
    assert result.diagnosis is not None and dict(result.diagnosis.next.options) == {"--candidate": "polynomial"}


@pytest.mark.slow
def test_what_a_proof_finds_wrong_is_taught_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A first function of which nothing is proved, as if samples had missed where it rises; the next one counts."""
    learn, functions, corrected = Learner.learn, list[Learned](), list[float]()

    def wrong_at_first(learner: Learner, effort: Effort) -> Learned:
        rises = Polynomial(np.array([[1], [2]]), np.array([2.0, 0.5]))  # least at -2, where the state goes on to 0
        functions.append(learn(learner, effort) if functions else Learned(rises, 1.0, 0.9, ()))
        return functions[-1]

    correct = Learner.correct
    monkeypatch.setattr(Learner, "learn", wrong_at_first)
    monkeypatch.setattr(
        Learner, "correct", lambda learner, x, cover: (corrected.append(float(x[0])), correct(learner, x, cover))[1]
    )
    result = proved(tmp_path)
    assert len(functions) == 2 and len(corrected) == 1 and -2.01 < corrected[0] < -0.9
    assert result.outer is not None and result.simulated is not None and (result.simulated.share or 0.0) > 0.9


@pytest.mark.parametrize(
    ("claim", "effort", "share"), [("practical", 0.4, 0.5), ("practical", 0.04, 1.0), ("auto", 0.04, 1.0)]
)
def test_candidates_whose_heats_are_whole_proofs_leave_half_of_more_effort_than_a_proof_takes(
    claim: str, effort: float, share: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    granted = list[float]()

    class Enough(Exception):
        pass

    def told(stage: Candidate, state: State, effort: Effort) -> State:
        granted.append(effort.left / stage.tools.whole)
        raise Enough

    monkeypatch.setattr(Candidate, "extend", told)
    with pytest.raises(Enough):
        proved(tmp_path, claim=claim, effort=effort)
    assert granted == [pytest.approx(share, abs=0.02)]


def test_a_plant_that_is_stiff_far_out_has_a_simulated_region(tmp_path: Path) -> None:
    """The slowest time constant is 100 s; at the domain's ends the fastest is 1 ms, and steps of that come to 3 s."""
    slow = plant(-x / 100 - 100 * x**9 + u, -1, 1)
    runs = Simulator(ClosedLoop(slow, REST), Quadratic(np.eye(1)), 1e-4)
    assert runs.horizon < 5 and runs.farther == pytest.approx(1500)
    found = simulated_region(runs, Effort(3 * UNIT))
    assert found is not None and len(found.converging) == found.runs
    assert Simulator(ClosedLoop(plant(), REST), Quadratic(np.eye(1)), 1e-4).farther == 0


@pytest.mark.parametrize("system", slow_after(1, [plant(), STEPS]), ids=["outer", "ranks"])
def test_the_ellipsoid_stays_where_the_checker_refuses_more(
    system: System, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ask = Clerk.ask

    def wrong(clerk: Clerk, certificate: Certificate, **_: object) -> object:
        claim = certificate.claim
        if claim.outer is not None:
            certificate = replace(certificate, claim=replace(claim, outer=replace(claim.outer, level=1e3)))
        if claim.ranks is not None:
            certificate = replace(certificate, claim=replace(claim, ranks=replace(claim.ranks, steps=1)))
        return ask(clerk, certificate)

    monkeypatch.setattr(Clerk, "ask", wrong)
    result = proved(tmp_path, system, effort=0.04)
    assert result.outer is None and result.ranks is None
    assert result.notice is not None and "left out" in result.notice
    assert result.simulated is not None and (result.simulated.share or 0.0) < 0.7


@pytest.mark.slow
def test_a_ring_that_is_cut_for_more_is_resumed_without_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All of the effort is kept for what lies beyond, which then is not wanted: the ring takes it after all."""
    network = load_policy(POLICIES / "pendulum.pt").network
    options = {"candidate": "auto", "effort": 0.1}
    plain = certify_roa(get_system("pendulum"), network, tmp_path / "plain", **options)  # type: ignore[arg-type]
    monkeypatch.setattr(simulation, "_FOR_MORE", 1.0)
    monkeypatch.setattr(simulation, "_FOR_RING", 0.0)
    cut = certify_roa(get_system("pendulum"), network, tmp_path / "cut", **options)  # type: ignore[arg-type]
    assert cut.verdict is Verdict.PROVED and cut.volume == plain.volume


def test_boxes_get_ranks_until_nearly_all_is_proved(in_steps: RoaResult, tmp_path: Path) -> None:
    result = in_steps
    every = proved(tmp_path / "all", STEPS, candidate="ellipsoid", ranks=True, effort=0.04)
    assert result.ranks is not None and result.simulated is not None and every.ranks is not None
    assert (result.simulated.share or 0.0) > 0.9 and result.contains([-2.5])
    assert result.ranks.leaves <= every.ranks.leaves and result.ranks.covered <= every.ranks.covered
    alone = proved(tmp_path / "alone", STEPS, candidate="ellipsoid", effort=0.04)
    assert alone.ranks is None and alone.diagnosis is not None
    assert dict(alone.diagnosis.next.options) == {"--ranks": ""}


@pytest.mark.slow
def test_a_wider_domain_that_is_suggested_gives_what_it_promises(tmp_path: Path) -> None:
    """The domain cuts the region off at -2: beyond it lies a quarter."""
    result = proved(tmp_path, plant(lo=-2))
    assert result.outer is not None and result.diagnosis is not None
    step = result.diagnosis.next
    assert dict(step.options) == {"--domain": "x=3"}
    promised = float(step.why.partition("simulation from ")[2].split()[0])
    wider = proved(tmp_path / "wider", plant(lo=-3, hi=3))
    assert wider.outer is not None and wider.contains([-2.5])
    assert wider.outer.volume > 0.9 * promised * result.outer.volume


@pytest.mark.slow
def test_centring_is_suggested_only_where_it_gains(tmp_path: Path) -> None:
    """From the plain policy's equilibrium as much converges as from the operating point of the centred one, and all of
    it to one equilibrium; under the weaker claim alone centring gains the stronger one."""
    network = load_policy(POLICIES / "without_gain" / "pendulum.pt").network
    nearby = certify_roa(get_system("pendulum"), network, tmp_path / "nearby", effort=0.02)
    assert nearby.claim == "nearby" and nearby.diagnosis is not None
    assert "--centre" not in dict(nearby.diagnosis.next.options)
    folder, options = tmp_path / "practical", {"claim": "practical", "candidate": "lqr", "effort": 0.02}
    weaker = certify_roa(get_system("pendulum"), network, folder, **options)  # type: ignore[arg-type]
    assert weaker.claim == "practical" and weaker.diagnosis is not None
    assert dict(weaker.diagnosis.next.options) == {"--centre": "preactivation", "--claim": "auto"}


def test_a_share_is_that_of_the_accepted_set(by_default: RoaResult) -> None:
    assert by_default.raw is not None and by_default.checker is not None
    assert by_default.checker["certificate_sha256"] == hashlib.sha256(by_default.raw).hexdigest()
    loop = ClosedLoop(by_default.system, by_default.network)
    assert by_default.problem is not None and by_default.levels.roa is not None
    runs = Simulator(loop, by_default.problem.V, by_default.levels.roa)
    found = simulated_region(runs, Effort(10 * UNIT))
    assert found is not None and by_default.simulated is not None
    exact = np.asarray(by_default.contains(found.converging, deviations=True))
    assert int(exact.sum()) == by_default.simulated.proved


def test_the_page_says_the_share_where_there_is_no_grid(by_default: RoaResult) -> None:
    said = drawn_of(by_default.to_dict())
    assert said.startswith("about ") and "of what converges is proved" in said
    assert drawn_of(None) == drawn_of({"simulated": None}) == ""


def test_more_effort_comes_before_a_wider_domain_where_little_is_proved(in_steps: RoaResult) -> None:
    """As long as boxes with ranks still grow; where nothing is left for them to gain, a wider domain is looked at."""
    result, options = in_steps, RoaOptions(effort=0.4)
    assert result.ranks is not None and result.simulated is not None

    def step(done: bool, covered: int) -> Step | None:
        assert result.ranks is not None
        ranks, simulated = replace(result.ranks, done=done), SimulatedFacts(1000, 900, covered)
        changed = replace(result, ranks=ranks, simulated=simulated)
        return beyond_the_ellipsoid(changed, options, Effort(10 * UNIT))

    first = step(False, 400)
    assert first is not None and first.options == (("--effort", "1.6"),) and "grows with the effort" in first.why
    for other in (step(True, 400), step(True, 850)):
        assert other is None or "--effort" not in dict(other.options)


@pytest.mark.parametrize("periods", [None, ("1/50", "1/20")])
def test_no_effort_is_suggested_where_images_meet_too_many_boxes(
    periods: tuple[str, str] | None, in_steps: RoaResult
) -> None:
    """The search ended for its size, so that more effort finds the same."""
    result = in_steps
    assert result.ranks is not None
    ranks = replace(result.ranks, done=True, full=True)
    system = result.system if periods is None else plant().with_sample((Fraction(periods[0]), Fraction(periods[1])))
    changed = replace(result, ranks=ranks, simulated=SimulatedFacts(1000, 900, 400), system=system)
    step = beyond_the_ellipsoid(changed, RoaOptions(), Effort(10 * UNIT))
    assert step is not None and "more effort finds the same" in step.why
    assert step.options == (() if periods is None else (("--sample-time", "0.0425..0.05"),))


def test_a_search_for_ranks_says_that_it_ended_for_its_size(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(search, "_MOST_PAIRS", 10)
    result = proved(tmp_path, STEPS, ranks=True)
    assert result.ranks is not None and result.ranks.full and result.ranks.done


def test_a_function_that_was_taught_little_is_taught_more_before_a_wider_domain(by_default: RoaResult) -> None:
    assert by_default.outer is not None and by_default.outer.limit == "witness"

    def step(covered: int, **options: object) -> Step | None:
        changed = replace(by_default, simulated=SimulatedFacts(1000, 900, covered))
        return beyond_the_ellipsoid(changed, RoaOptions(**options), Effort(10 * UNIT))  # type: ignore[arg-type]

    first = step(400, effort=0.4)
    assert first is not None and first.options == (("--effort", "1.6"),)
    for other in (step(850, effort=0.4), step(400, effort=1.0), step(400, effort=0.4, lyapunov=SQUARE)):
        assert other is None or "--effort" not in dict(other.options)


def test_no_wider_domain_is_suggested_where_n_ends_well_inside_of_it(
    by_default: RoaResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    """N does not fall at -3 or 1, of a domain from -4 to 2; near the domain's faces, or with nearly all that converges
    proved, a wider one is the next step."""
    domain = Step((("--domain", "x=6"),), "")
    monkeypatch.setattr(suggested, "_in_a_wider_domain", lambda result, effort: domain)
    outer = by_default.outer
    assert outer is not None and outer.limit == "witness" and outer.witness is not None
    at_a_face = replace(outer, witness=(-3.9,))
    for found, covered, told in ((outer, 780, True), (outer, 850, False), (at_a_face, 780, False)):
        changed = replace(by_default, outer=found, simulated=SimulatedFacts(1000, 900, covered))
        step = beyond_the_ellipsoid(changed, RoaOptions(), Effort(10 * UNIT))
        assert step is not None and (step == domain) is not told
        assert (f"N ends where it does not fall, at x = {number(outer.witness[0], 4)}" in step.why) is told
        assert not told or step.options == (("--candidate", "polynomial"),)
    kept = replace(outer, violation="keep", constraint="wall")  # N falls there
    changed = replace(by_default, outer=kept, simulated=SimulatedFacts(1000, 900, 780))
    step = beyond_the_ellipsoid(changed, RoaOptions(), Effort(10 * UNIT))
    assert step is not None and "N ends where the constraint wall is violated, at x = " in step.why


@pytest.mark.parametrize(
    ("x_eq", "ends", "factor", "printed"),
    [
        ("2/3", (Fraction(1, 20), Fraction(11, 5)), Fraction(3, 2), "x=0.025..2.97"),  # positive: it stays so
        ("0", (Fraction(0), Fraction(2)), Fraction(3, 2), "x=0..3"),
        ("-1", (Fraction(-2), Fraction(-1, 10)), Fraction(3, 2), "x=-2.5..-0.05"),
        ("300", (Fraction(298), Fraction(303)), Fraction(5, 4), "x=297.5..303.75"),
        ("0", (Fraction(-1, 3), Fraction(1, 3)), Fraction(3, 2), "x=0.5"),
    ],
)
def test_a_wider_side_has_round_ends_and_keeps_its_sign(
    x_eq: str, ends: tuple[Fraction, Fraction], factor: Fraction, printed: str
) -> None:
    at = Fraction(x_eq)
    system = plant(lo=-2)
    system = replace(system, x_eq=(Number(at),)).with_domain({"x": tuple(end - at for end in ends)})
    assert side(wider(system, 0, factor), 0) == printed
