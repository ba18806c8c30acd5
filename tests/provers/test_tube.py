"""Tubes: what they claim holds along simulated runs, the checker accepts them, and none is found where none is."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from fractions import Fraction
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from certify.analysis.candidates.robust import robust_candidate
from certify.analysis.diagnosis import diagnose
from certify.analysis.results import RoaResult
from certify.analysis.run import RoaOptions, certify_roa
from certify.certificates import PartitionTree, read_certificate
from certify.certificates.claims import Enlarged, Problem
from certify.certificates.verdict import Stop, Verdict
from certify.effort import UNIT, Effort
from certify.errors import InputError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.plants import get_system
from certify.loop.plants.ode import rk4_step
from certify.loop.policies import load_policy
from certify.lyapunov import SOLVED, choose_candidate, diagonalising_coordinates, domain_limit, volume
from certify.lyapunov.function import Quadratic
from certify.provers.ball.decrease import Multipliers, best_multipliers, decay_of, multipliers_for, rest_of
from certify.provers.ball.local import ball_around, local_margin, prove_local
from certify.provers.ball.models import paths
from certify.provers.tube import enlarge as enlarging
from certify.provers.tube.enlarge import enlarge
from certify.provers.tube.tube import Around, Tube, find_tube
from tests.support.cases import Case, case_of
from tests.support.loops import pendulum_network, scalar_tanh

Array = NDArray[np.float64]
POLICIES = Path(__file__).parents[2] / "examples" / "policies"
CURVED = Path(__file__).parents[1] / "data"  # quadrotors before they were flattened


@cache
def pendulum() -> tuple[Case, Array]:
    """The loop, and P / c1 of its local level."""
    case = case_of(get_system("pendulum"), load_policy(POLICIES / "pendulum.pt").network)
    level = prove_local(case.problem, case.T, domain_limit(case.P, case.loop.system.domain))
    assert level is not None
    return case, case.P / level


@cache
def enlarged() -> Tube:
    case, goal = pendulum()
    tube = find_tube(Around.of(case.loop, ()), goal / 1.3**2, goal)
    assert tube is not None
    return tube


def at(tube: Tube, k: int, s: float) -> Array:
    """P(s) of slab k."""
    start = tube.start if k == 0 else tube.slabs[k - 1].end
    slab = tube.slabs[k]
    return (1 - s) ** 2 * start + 2 * s * (1 - s) * slab.middle + s**2 * slab.end


def test_a_tube_ends_inside_its_goal() -> None:
    _, goal = pendulum()
    tube = enlarged()
    assert np.linalg.eigvalsh(tube.slabs[-1].end - goal)[0] > 0
    assert np.linalg.eigvalsh(tube.start - goal)[0] < 0  # it starts outside
    assert tube.duration == pytest.approx(sum(slab.duration for slab in tube.slabs)) and tube.duration > 0


def test_w_falls_along_trajectories() -> None:
    """W(t) = x'P(t)x of runs from the start's boundary falls from slab to slab, by a step that is small beside them."""
    case, _ = pendulum()
    tube, loop = enlarged(), case.loop
    f = loop.system.function()
    angles = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    x = np.stack([np.cos(angles), np.sin(angles)], -1) @ np.linalg.inv(np.linalg.cholesky(tube.start))
    W = np.einsum("ki,ij,kj->k", x, tube.start, x)
    np.testing.assert_allclose(W, 1)
    for k, slab in enumerate(tube.slabs):
        for step in range(4):
            x = rk4_step(lambda y: f(y, loop.policy(y)), x, slab.duration / 4)
            P = at(tube, k, (step + 1) / 4)
            now = np.einsum("ki,ij,kj->k", x, P, x)
            assert np.all(now < W * (1 + 1e-9))
            W = now


def test_the_bound_of_a_slab_dominates_its_loop() -> None:
    """On every ball of the tube, d'J'P'J d + 2 d'J'PF(Jd) < 0 at sampled points and times."""
    case, _ = pendulum()
    tube, loop, generator = enlarged(), case.loop, np.random.default_rng(0)
    f = loop.system.function()
    for k in range(0, len(tube.slabs), 5):
        slab = tube.slabs[k]
        start = tube.start if k == 0 else tube.slabs[k - 1].end
        for s in (0.0, 0.3, 0.5, 1.0):
            rate = 2 * ((1 - s) * (slab.middle - start) + s * (slab.end - slab.middle)) / slab.duration
            P = at(tube, k, s)
            assert np.linalg.eigvalsh(slab.J.T @ P @ slab.J)[0] > 1
            d = generator.standard_normal((200, 2))
            d *= generator.random((200, 1)) / np.linalg.norm(d, axis=1, keepdims=True)
            x = d @ slab.J.T
            F = f(x, loop.policy(x))
            assert np.all(np.einsum("ki,ij,kj->k", x, rate, x) + 2 * np.einsum("ki,ij,kj->k", x, P, F) < 0)


def test_none_is_found_from_beyond_what_settles() -> None:
    """xdot = x/2 - tanh(x) rests at 0 and at 1.915: a start beyond that has no tube, one inside has."""
    system, network = scalar_tanh()
    loop = ClosedLoop(system, network)
    known = Around.of(loop, ())
    goal = np.array([[1 / 0.3**2]])
    assert find_tube(known, np.array([[1 / 0.6**2]]), goal) is not None
    for size in (1.92, 2.5, 4.0):
        assert find_tube(known, np.array([[1 / size**2]]), goal) is None


def test_a_start_that_leaves_the_domain_has_none() -> None:
    case, goal = pendulum()
    limit = domain_limit(goal, case.loop.system.domain)
    assert find_tube(Around.of(case.loop, ()), goal / (1.01 * limit), goal) is None


def test_no_effort_is_no_tube() -> None:
    case, goal = pendulum()
    assert find_tube(Around.of(case.loop, ()), goal / 1.3**2, goal, Effort(0.0)) is None


@pytest.mark.parametrize("seed", range(3))
def test_the_bounds_of_the_rest_hold(seed: int) -> None:
    """2 sum (b_i.d)(d'Q_i d + K_i[d] + r_i) + 2 sum (p_q.d) e_q <= d'S d for any |r_i| <= d'E_i d, |e_q| <= d'R_q d,
    and any multipliers."""
    case, goal = pendulum()
    generator = np.random.default_rng(seed)
    J = np.linalg.inv(np.linalg.cholesky(goal)).T @ np.diag([1.0, 0.7])
    models = paths(case.loop).models(J)
    b = goal @ J
    rows = np.abs(generator.standard_normal((3, 2)))
    root = generator.standard_normal((2, 2))
    every = [
        multipliers_for(models, b, np.eye(2)),
        Multipliers(rows + 0.01, root @ root.T),
        Multipliers(rows * [[0], [0], [1]] + [[0], [0], [0.01]], np.diag([1.0, 1e-3])),
    ]
    d = generator.standard_normal((500, 2))
    d *= generator.random((500, 1)) / np.linalg.norm(d, axis=1, keepdims=True)
    Q, E, R = (np.einsum("ki,mij,kj->km", d, part, d) for part in (models.Q, models.E, models.R))
    K = np.einsum("mhij,kh,ki,kj->km", models.K, d, d, d)
    errors = np.sum(np.abs(d @ b.T) * E, axis=1) + np.sum(np.abs(d @ b.T @ models.shares) * R, axis=1)
    for quadratic, cubic in product((1, -1), repeat=2):
        left = 2 * np.sum((d @ b.T) * (quadratic * Q + cubic * K), axis=1) + 2 * errors
        for multipliers in every:
            S = rest_of(models, b, multipliers)
            assert np.all(left <= np.einsum("ki,ij,kj->k", d, S, d) * (1 + 1e-9) + 1e-12)


def test_the_best_multipliers_are_no_worse_than_the_first() -> None:
    case, goal = pendulum()
    J = np.linalg.inv(np.linalg.cholesky(goal)).T
    models = paths(case.loop).models(J)
    shown, b = best_multipliers(models, J, goal), goal @ J
    decay = decay_of(models, J, b)
    inverse = np.linalg.inv(np.linalg.cholesky(decay))

    def margin(multipliers: Multipliers) -> float:
        return float(1 - np.linalg.eigvalsh(inverse @ rest_of(models, b, multipliers) @ inverse.T)[-1])

    assert shown.margin == pytest.approx(margin(shown.multipliers))
    assert shown.margin >= margin(multipliers_for(models, b, inverse.T @ inverse)) - 1e-12
    assert np.all(shown.multipliers.rows >= 0)


def test_a_search_for_enough_decides_as_the_whole_search_does() -> None:
    """On balls from well inside of what the multipliers show to well outside."""
    case, goal = pendulum()
    known, seen = paths(case.loop), set()
    for size in np.linspace(0.5, 1.6, 12):
        J = size * np.linalg.inv(np.linalg.cholesky(goal)).T
        models = known.models(J)
        whole, quick = best_multipliers(models, J, goal), best_multipliers(models, J, goal, enough=0.1)
        assert quick.margin <= whole.margin + 1e-2 and (quick.margin >= 0.1) == (whole.margin >= 0.1)
        seen.add(whole.margin >= 0.1)
    assert seen == {True, False}


def test_no_multipliers_are_much_better_than_the_best() -> None:
    """The weighted mean of what is left bounds what any multipliers leave in the worst direction."""
    loop = ClosedLoop(get_system("quadrotor2d"), load_policy(CURVED / "quadrotor2d_curved.pt").network)
    P = choose_candidate(loop, "lqr").P
    J = 0.05 * np.linalg.inv(np.linalg.cholesky(P)).T * volume(P, 1.0) ** (-1 / 6)
    models, generator = paths(loop).models(J), np.random.default_rng(0)
    shown = best_multipliers(models, J, P)
    inverse = np.linalg.inv(np.linalg.cholesky(decay_of(models, J, P @ J)))
    others = []
    for joint in (True, False):
        for _ in range(100):
            factor = generator.standard_normal((6, 6)) * generator.uniform(0, 1, 6) ** 3
            weight = inverse.T @ (factor @ factor.T + 1e-4 * np.eye(6)) @ inverse
            rest = rest_of(models, P @ J, multipliers_for(models, P @ J, weight, joint))
            others.append(1 - np.linalg.eigvalsh(inverse @ rest @ inverse.T)[-1])
    assert shown.margin > max(others)


def test_a_rate_takes_its_part_of_the_decay() -> None:
    """x'Px must fall faster where P grows: R = tP leaves t less of the decay."""
    case, goal = pendulum()
    J = np.linalg.inv(np.linalg.cholesky(goal)).T
    models = paths(case.loop).models(J)
    without, with_rate = (decay_of(models, J, goal @ J, R) for R in (None, 0.3 * goal))
    np.testing.assert_allclose(without - with_rate, 0.3 * J.T @ goal @ J, atol=1e-12)


@pytest.mark.slow
def test_enlarge_keeps_the_largest_of_the_shapes() -> None:
    case, goal = pendulum()
    seen: list[float] = []
    shapes = {"round": np.diag([1.0, 0.02]), "goal": goal}
    found = enlarge(Around.of(case.loop, ()), goal, shapes, Effort(20.0 * UNIT), report=lambda e: seen.append(e.volume))
    assert found is not None and found.shape in shapes
    assert seen == sorted(seen) and found.volume == seen[-1] > volume(goal, 1.0)


def test_enlarge_asks_for_more_than_it_is_worth() -> None:
    case, goal = pendulum()
    assert enlarge(Around.of(case.loop, ()), goal, {"goal": goal}, Effort(20.0 * UNIT), worth=1e9) is None


@pytest.mark.slow
def test_robust_is_larger_than_what_it_starts_from() -> None:
    """By the local rule, on the planar quadrotor, where Q = I and LQR are far from the best."""
    system = get_system("quadrotor2d")
    loop = ClosedLoop(system, load_policy(CURVED / "quadrotor2d_curved.pt").network)
    known = paths(loop)

    def local(P: Array) -> float:
        T = diagonalising_coordinates(P, loop.linearise()[0])
        level = prove_local(Problem(loop, Quadratic(P)), T, domain_limit(P, system.domain) * (1 - 1e-9), known)
        return 0.0 if level is None else volume(P, level)

    P = robust_candidate(loop)
    assert np.array_equal(P, P.T) and volume(P, 1.0) == pytest.approx(local(P), rel=0.3)  # in other coordinates
    assert local(P) > 300 * max(local(choose_candidate(loop, name).P) for name in SOLVED)


@pytest.mark.slow
def test_robust_of_a_held_input_gains_on_that_of_the_loop_without_a_period() -> None:
    """By the rule of the held input, which judges both."""
    network = load_policy(CURVED / "quadrotor2d_curved.pt").network
    plain, held = (get_system("quadrotor2d").with_sample(h) for h in (None, (Fraction(1, 50), Fraction(1, 50))))
    loop = ClosedLoop(held, network)

    def local(P: Array) -> float:
        T = diagonalising_coordinates(P, loop.mean_rate(), loop.step)
        level = prove_local(Problem(loop, Quadratic(P)), T, domain_limit(P, held.domain) * (1 - 1e-9))
        return 0.0 if level is None else volume(P, level)

    before, after = robust_candidate(ClosedLoop(plain, network)), robust_candidate(loop)
    assert volume(after, 1.0) == pytest.approx(local(after), rel=0.3)  # in other coordinates
    assert local(after) > 1.5 * local(before) > 0


def test_a_level_is_looked_for_where_it_is_expected() -> None:
    """Whether the highest good one lies between the two, above both or below both."""
    case, goal = pendulum()
    problem, known = Problem(case.loop, Quadratic(goal)), paths(case.loop)
    T = diagonalising_coordinates(goal, case.loop.linearise()[0])
    limit = domain_limit(goal, case.loop.system.domain) * (1 - 1e-9)
    level = prove_local(problem, T, limit, known)
    assert level is not None and level < limit / 2
    for low, high in ((0.7, 1.3), (0.1, 0.2), (0.9, 0.95)):
        near = prove_local(problem, T, limit, known, between=(low * level, high * level))
        assert near == pytest.approx(level, rel=0.03)
        assert local_margin(problem, T, near or 0.0, known) > 0
    assert prove_local(problem, T, limit, known, between=(1.1 * level, 2 * level)) is None
    assert prove_local(problem, T, limit, known, between=(2 * limit, 3 * limit)) is None
    top = prove_local(problem, T, 0.5 * level, known, between=(0.3 * level, 0.4 * level))
    assert top is not None and 0.48 * level < top <= 0.5 * level


@pytest.mark.slow
def test_robust_minds_the_bounds_of_inputs() -> None:
    """Where these are what limits the set, P gives way along the policy's gradient and gains elsewhere."""
    wide = get_system("quadrotor2d")
    network = load_policy(CURVED / "quadrotor2d_curved.pt").network
    room = Fraction(1, 20)
    around = tuple((u - room, u + room) for u in ClosedLoop(wide, network).u_eq)
    narrow = replace(wide, input_bounds=around)
    loops = [ClosedLoop(system, network) for system in (wide, narrow)]
    free, bound = (robust_candidate(loop) for loop in loops)
    K = loops[0].linearise()[2]
    reach = [np.max(np.sqrt(np.diag(K @ np.linalg.inv(P) @ K.T))) for P in (free, bound)]
    assert reach[0] > room > reach[1] > room / 3
    known = paths(loops[1])
    T = diagonalising_coordinates(free, loops[1].linearise()[0])
    blind = prove_local(Problem(loops[1], Quadratic(free)), T, domain_limit(free, narrow.domain), known)
    assert blind is not None and volume(bound, 1.0) > 2 * volume(free, blind)


def test_the_ball_contains_its_level_set() -> None:
    case, _ = pendulum()
    J = ball_around(case.problem, case.T, 0.3)
    assert np.linalg.eigvalsh(J.T @ case.P @ J - 0.3 * np.eye(2))[0] > 0
    known = paths(case.loop)
    margins = [local_margin(case.problem, case.T, level, known) for level in (1e-4, 1e-3, 1e-2)]
    assert margins == sorted(margins, reverse=True) and margins[0] > 0.9


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> RoaResult:
    """A pendulum whose ring is not given enough boxes to reach far, so that a tube is worth its while."""
    options = RoaOptions(candidate="lqr", enlarge=True, max_boxes=1, effort=0.12)
    policy = load_policy(POLICIES / "pendulum.pt")
    return certify_roa(get_system("pendulum"), policy.network, tmp_path_factory.mktemp("tube"), options)


def test_a_run_ends_with_an_enlarged_claim(result: RoaResult) -> None:
    assert result.verdict is Verdict.PROVED and result.claim == "enlarged" and result.tube is not None
    assert result.checker is not None and result.checker["rules"]["tube"] == result.tube.slabs
    assert result.certificate is not None and result.P is not None and result.levels.roa is not None
    read = read_certificate(result.certificate)
    assert isinstance(read.claim, Enlarged) and isinstance(read.evidence, PartitionTree)
    assert np.array_equal(read.claim.start.P, result.tube.start)
    assert len(read.evidence.tube) == result.tube.slabs
    assert result.volume == volume(result.tube.start, 1.0) > volume(result.P, result.levels.roa)
    said = result.to_dict()
    assert said["claim"] == {"kind": "enlarged"} and said["tube"]["slabs"] == result.tube.slabs
    assert said["volume"] == said["tube"]["volume"] and said["seconds"]["tube"] > 0


def test_the_set_is_the_union(result: RoaResult) -> None:
    assert result.tube is not None and result.P is not None and result.levels.roa is not None
    generator = np.random.default_rng(0)
    x = generator.uniform(-1, 1, (400, 2)) * 1.2 / np.sqrt(np.diag(result.tube.start))
    inside = np.einsum("ki,ij,kj->k", x, result.tube.start, x) <= 1
    inside |= np.einsum("ki,ij,kj->k", x, result.P, x) <= result.levels.roa
    assert np.array_equal(result.contains(x), inside) and 0 < inside.sum() < len(x)


@pytest.mark.slow
def test_a_box_asks_for_its_shape(tmp_path: Path) -> None:
    options = RoaOptions(candidate="lqr", box={"theta": 1.0, "theta_dot": 4.0}, max_boxes=1, effort=0.6)
    policy = load_policy(POLICIES / "pendulum.pt")
    result = certify_roa(get_system("pendulum"), policy.network, tmp_path, options)
    assert result.tube is not None and result.tube.shape == "box"
    P = result.tube.start
    np.testing.assert_allclose([P[0, 1], P[0, 0] / P[1, 1]], [0, 16], atol=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"box": {"theta": 0.0}}, "positive half-widths"),
        ({"box": {"theta": float("nan")}}, "positive half-widths"),
        ({"enlarge": True, "claim": "practical"}, "needs the engine bounds"),
        ({"enlarge": True, "engine": "dreal"}, "needs the engine bounds"),
    ],
)
def test_options_that_cannot_be(change: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        replace(RoaOptions(), **change)  # type: ignore[arg-type]


def test_a_box_must_name_states(tmp_path: Path) -> None:
    options = RoaOptions(candidate="lqr", box={"thete": 1.0}, max_boxes=1)
    with pytest.raises(InputError, match=r"must name states of pendulum, theta, theta_dot; found thete"):
        certify_roa(get_system("pendulum"), load_policy(POLICIES / "pendulum.pt").network, tmp_path, options)


@pytest.mark.slow
def test_a_tube_that_the_checker_refuses_is_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A careless producer ends with what is proved without it."""

    def careless(*arguments: Any) -> Tube | None:
        tube = find_tube(*arguments)
        return tube and Tube(tube.start, tuple(replace(slab, duration=slab.duration / 100) for slab in tube.slabs))

    monkeypatch.setattr(enlarging, "find_tube", careless)
    options = RoaOptions(candidate="lqr", enlarge=True, max_boxes=1, effort=0.4)
    result = certify_roa(get_system("pendulum"), load_policy(POLICIES / "pendulum.pt").network, tmp_path, options)
    assert result.verdict is Verdict.PROVED and result.claim == "asymptotic" and result.tube is None
    assert result.stop is not Stop.STALLED and "left out with its tube" in (result.notice or "")


@pytest.mark.slow
def test_a_policy_that_is_not_centred_has_no_tube(tmp_path: Path) -> None:
    network = replace(pendulum_network(), centre="none")
    result = certify_roa(get_system("pendulum"), network, tmp_path, RoaOptions(enlarge=True, effort=0.03))
    assert result.verdict is Verdict.PROVED and result.claim == "nearby" and result.tube is None


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "box", "seconds"),
    [
        (
            "quadrotor2d",
            dict(zip(("x", "y", "theta", "x_dot", "y_dot", "theta_dot"), (1, 1, 0.5, 1, 1, 1), strict=True)),
            200,
        ),
        (
            "quadrotor3d",
            dict.fromkeys(("x", "y", "z", "vx", "vy", "vz"), 0.3)
            | dict.fromkeys(("phi", "theta"), 0.12)
            | {"psi": 0.12}
            | dict.fromkeys(("p", "q", "r"), 0.6),
            300,
        ),
    ],
)
def test_the_shipped_quadrotors_are_proved_where_they_fly(
    name: str, box: dict[str, float], seconds: float, tmp_path: Path
) -> None:
    """All of the ellipsoid in this box, and both checkers say so."""
    policy = load_policy(POLICIES / f"{name}.pt")
    system = get_system(name).with_parameters(policy.parameters)
    result = certify_roa(system, policy.network, tmp_path, RoaOptions(box=box, time_limit=seconds))
    assert result.verdict is Verdict.PROVED and result.tube is not None and result.certificate is not None
    for state, half in box.items():
        x = np.zeros(system.n)
        x[[s.name for s in system.states].index(state)] = half
        assert result.contains(x) and result.contains(-x)
    command = [sys.executable, "-I", "-m", "certify.reference", str(result.certificate)]
    assert subprocess.run(command, capture_output=True, timeout=1500, check=False).returncode == 0


def test_where_boxes_gain_nothing_the_next_step_is_a_tube(result: RoaResult) -> None:
    """Only if there is one: not where nothing larger settles."""
    assert result.P is not None and result.levels.roa is not None
    stalled = replace(result, stop=Stop.STALLED, tube=None, claim="asymptotic")
    step = diagnose(stalled, RoaOptions(candidate="auto"), None).next
    assert step.options == (("--enlarge", ""),) and "1.1 times" in step.why
    largest = replace(stalled, levels=replace(stalled.levels, roa=domain_limit(result.P, result.system.domain)))
    assert diagnose(largest, RoaOptions(), None).next.options == ()


def test_errors_beyond_binary64_are_not_shown() -> None:
    """Squares of remainders overflow: that is no margin, and no exception."""
    case, goal = pendulum()
    models = paths(case.loop).models(np.linalg.inv(np.linalg.cholesky(goal)).T)
    for part in ("E", "K", "squares"):
        huge = replace(models, **{part: np.full_like(getattr(models, part), 1e200)})
        with np.errstate(all="ignore"):
            assert not best_multipliers(huge, np.eye(2), goal).margin > 0
