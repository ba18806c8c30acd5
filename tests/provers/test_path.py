"""Tubes around a path: W falls on their edge along simulated runs, the checker accepts them, and none is found where
none is."""

from __future__ import annotations

import json
from dataclasses import replace
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from certify.analysis.results import RoaResult
from certify.analysis.run import RoaOptions, certify_roa
from certify.certificates import PartitionTree, read_certificate
from certify.certificates.claims import Reached
from certify.certificates.verdict import Stop, Verdict
from certify.checker.document import read
from certify.checker.rules import check
from certify.effort import UNIT, Effort
from certify.errors import InputError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.plants import System, get_system
from certify.loop.plants.ode import rk4_step
from certify.loop.policies import PolicyNetwork, load_policy
from certify.lyapunov import domain_limit
from certify.provers.ball.local import prove_local
from certify.provers.ball.models import paths
from certify.provers.tube import enlarge as enlarging
from certify.provers.tube.enlarge import surround
from certify.provers.tube.path import after, find_path
from certify.provers.tube.tube import Tube
from tests.support.cases import case_of
from tests.support.loops import pendulum_network, scalar_tanh

Array = NDArray[np.float64]
POLICIES = Path(__file__).parents[2] / "examples" / "policies"
FAR = np.array([2.6, -3.0])  # of the pendulum: outside of what the local rule proves
ATTRACTED = 1.915  # of x' = x/2 - tanh(x), rounded down


@cache
def pendulum() -> tuple[ClosedLoop, Array, Tube]:
    """The loop, P / c1 of its local level, and a tube from a state far outside of it."""
    case = case_of(get_system("pendulum"), load_policy(POLICIES / "pendulum.pt").network)
    level = prove_local(case.problem, case.T, domain_limit(case.P, case.loop.system.domain))
    assert level is not None
    goal = case.P / level
    assert FAR @ goal @ FAR > 2
    tube, why = find_path(case.loop, FAR, goal / 0.1**2, goal)
    assert tube is not None, why
    return case.loop, goal, tube


def nodes(tube: Tube) -> list[tuple[Array, Array]]:
    """(P, c) of the start and of the end of each slab."""
    assert tube.centre is not None
    later = [(slab.end, slab.path.centre) for slab in tube.slabs if slab.path is not None]
    assert len(later) == len(tube.slabs)
    return [(tube.start, np.array(tube.centre)), *later]


def at(tube: Tube, k: int, s: float) -> tuple[Array, Array, Array, Array]:
    """P, its rate, c and its rate at s of slab k."""
    (P, c), (end, onwards) = nodes(tube)[k : k + 2]
    slab = tube.slabs[k]
    rate = 2 * ((1 - s) * (slab.middle - P) + s * (end - slab.middle)) / slab.duration
    now = (1 - s) ** 2 * P + 2 * s * (1 - s) * slab.middle + s**2 * end
    return now, rate, (1 - s) * c + s * onwards, (onwards - c) / slab.duration


def test_a_tube_ends_in_the_goal() -> None:
    _, goal, tube = pendulum()
    P, c = nodes(tube)[-1]
    angles = np.linspace(0, 2 * np.pi, 200)
    edge = c + np.stack([np.cos(angles), np.sin(angles)], -1) @ np.linalg.inv(np.linalg.cholesky(P))
    assert np.max(np.einsum("ki,ij,kj->k", edge, goal, edge)) < 1
    assert tube.duration == pytest.approx(sum(slab.duration for slab in tube.slabs))


def test_w_falls_on_the_edge() -> None:
    """On each slab, at several times, at points all around the edge, in floats."""
    loop, _, tube = pendulum()
    f, angles = loop.system.function(), np.linspace(0, 2 * np.pi, 64)
    for k in range(len(tube.slabs)):
        for s in (0.0, 0.4, 1.0):
            P, rate, c, v = at(tube, k, s)
            e = np.stack([np.cos(angles), np.sin(angles)], -1) @ np.linalg.inv(np.linalg.cholesky(P))
            F = f(c + e, loop.policy(c + e))
            fall = np.einsum("ki,ij,kj->k", e, rate, e) + 2 * np.einsum("ki,ij,kj->k", e, P, F - v)
            assert np.all(fall < 0), (k, s)


def test_runs_stay_in_the_tube_and_arrive() -> None:
    loop, goal, tube = pendulum()
    f, generator = loop.system.function(), np.random.default_rng(0)
    d = generator.standard_normal((100, 2))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    P, c = nodes(tube)[0]
    x = c + d @ np.linalg.inv(np.linalg.cholesky(P))
    for (P, c), slab in zip(nodes(tube)[1:], tube.slabs, strict=True):
        for _ in range(4):
            x = rk4_step(lambda y: f(y, loop.policy(y)), x, slab.duration / 4)
        assert np.max(np.einsum("ki,ij,kj->k", x - c, P, x - c)) < 1 + 1e-9
    assert np.max(np.einsum("ki,ij,kj->k", x, goal, x)) < 1


@pytest.mark.parametrize("centre", ["none", "output", "preactivation"])
@pytest.mark.parametrize("squash", ["tanh", "identity"])
def test_models_away_from_the_origin_enclose_the_loop(centre: str, squash: str) -> None:
    """F = f + A d + d'Q d + K[d] within what the tanhs leave and d'E d on a ball around a state, the last entry of d a
    motion."""
    if (centre, squash) == ("preactivation", "identity"):
        return
    generator = np.random.default_rng(3)
    plain = load_policy(POLICIES / "pendulum.pt").network
    network = replace(plain, centre=centre, squash=squash)
    loop, m = ClosedLoop(get_system("pendulum"), network), np.array([0.7, -1.1])
    J = generator.standard_normal((2, 3)) * 0.2
    models = paths(loop, m).models(J)
    d = generator.standard_normal((500, 3))
    d *= generator.random((500, 1)) ** 0.2 / np.linalg.norm(d, axis=1, keepdims=True)
    x = m + d @ J.T
    F = loop.system.function()(x, loop.policy(x))
    model = models.f + d @ models.A.T + np.einsum("ka,iab,kb->ki", d, models.Q, d)
    model += np.einsum("iabc,ka,kb,kc->ki", models.K, d, d, d)
    units = np.einsum("ka,qab,kb->kq", d, models.R, d)
    away = np.einsum("ka,iab,kb->ki", d, models.E, d) + units @ np.abs(models.shares).T
    assert np.all(np.abs(F - model) <= away + 1e-12)
    assert np.max(np.abs(F - model)) > 1e-6  # there is something to bound


@pytest.mark.parametrize(("x", "found"), [(1.5, True), (-1.8, True), (1.9, True), (1.92, False), (2.5, False)])
def test_a_tube_leads_from_what_is_attracted_and_from_nothing_else(x: float, found: bool) -> None:
    """x' = x/2 - tanh(x), whose origin attracts |x| < 1.915008."""
    loop, goal = ClosedLoop(*scalar_tanh()), np.array([[1 / 0.3**2]])
    tube, why = find_path(loop, np.array([x]), np.array([[1e6]]), goal, Effort(60 * UNIT))
    assert (tube is not None) is found
    assert found or "leaves the domain" in why or "not arrived" in why or "cannot be continued" in why


@pytest.mark.slow
def test_the_widest_tube_stays_below_what_is_attracted() -> None:
    loop, goal = ClosedLoop(*scalar_tanh()), np.array([[1 / 0.3**2]])
    best, _ = surround(loop, np.array([1.5]), goal, {"one": np.eye(1)}, Effort(20 * UNIT))
    assert best is not None
    reach = 1.5 + 1 / np.sqrt(best.tube.start[0, 0])
    assert 1.65 < reach < ATTRACTED


@pytest.mark.slow
def test_a_saddle_beside_the_path_bounds_the_width() -> None:
    """From close to the edge of what is attracted the tube is narrower than the way to the edge."""
    loop, goal = ClosedLoop(*scalar_tanh()), np.array([[1 / 0.3**2]])
    best, _ = surround(loop, np.array([1.9]), goal, {"one": np.eye(1)}, Effort(20 * UNIT))
    assert best is not None and 1.9 + 1 / np.sqrt(best.tube.start[0, 0]) < 1.915008049


def test_no_effort_is_no_tube() -> None:
    loop, goal, _ = pendulum()
    tube, why = find_path(loop, FAR, goal, goal, Effort(0.0))
    assert tube is None and "the effort ended after 0 slabs" in why


def test_a_start_beyond_the_domain_has_none() -> None:
    loop, goal, _ = pendulum()
    tube, why = find_path(loop, np.array([3.1, 0.0]), goal, goal)
    assert tube is None and "leaves the domain after 0 " in why


def test_after_is_the_flow() -> None:
    """x' = x/2 - tanh(x) against steps that are a hundred times shorter."""
    loop = ClosedLoop(*scalar_tanh())
    f, x = loop.system.function(), np.array([1.0])

    def flow(y: Array) -> Array:
        return np.asarray(f(y, loop.policy(y)))

    for _ in range(100):
        x = after(flow, x, 0.002)
    assert after(flow, np.array([1.0]), 0.2)[0] == pytest.approx(x[0], abs=1e-10)


# ------------------------------------------------------------------------------------------------------- whole runs


def run(out: Path, plant: tuple[System, PolicyNetwork], state: dict[str, Any], **change: Any) -> RoaResult:
    options = {"candidate": "lqr", "max_boxes": 1, "effort": 0.04} | change
    return certify_roa(*plant, out, RoaOptions(reach_from=state, **options))


def shipped() -> tuple[System, PolicyNetwork]:
    return get_system("pendulum"), load_policy(POLICIES / "pendulum.pt").network


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> RoaResult:
    """A ring with one box, so that the state lies outside of what is proved without a tube."""
    state = {"theta": Fraction(26, 10), "theta_dot": Fraction(-3)}
    return run(tmp_path_factory.mktemp("reach"), shipped(), state)


def test_a_run_ends_with_a_reached_claim(result: RoaResult) -> None:
    assert result.verdict is Verdict.PROVED and result.claim == "reached" and result.tube is not None
    assert result.certificate is not None and result.checker is not None
    assert result.checker["rules"]["tube"] == result.tube.slabs
    written = read_certificate(result.certificate)
    assert isinstance(written.claim, Reached) and isinstance(written.evidence, PartitionTree)
    assert written.claim.centre == result.tube.centre == (2.6, -3.0)
    assert np.array_equal(written.claim.start.P, result.tube.start)
    said = result.to_dict()
    assert said["claim"] == {"kind": "reached"} and said["tube"]["centre"] == [2.6, -3.0]
    assert said["checked"] == "ACCEPTED" and json.dumps(said)


def test_the_file_says_it_again(result: RoaResult) -> None:
    """Read and written, the bytes are the same, and the checker's rules hold in this process too."""
    assert result.certificate is not None and result.raw is not None
    assert read_certificate(result.certificate).to_json().encode() == result.raw
    assert check(read(str(result.certificate))).rules["tube"] > 0


def test_the_set_is_the_union(result: RoaResult) -> None:
    assert result.tube is not None and result.P is not None and result.levels.roa is not None
    assert result.contains([Fraction(26, 10), -3]) and result.contains([0, 0])
    e = np.random.default_rng(0).uniform(-1, 1, (400, 2)) * 1.2 * np.sqrt(np.diag(np.linalg.inv(result.tube.start)))
    x = np.array([2.6, -3.0]) + e
    inside = np.einsum("ki,ij,kj->k", e, result.tube.start, e) <= 1
    inside |= np.einsum("ki,ij,kj->k", x, result.P, x) <= result.levels.roa
    assert np.array_equal(result.contains(x), inside) and 0 < inside.sum() < len(x)


def test_the_sizes_are_those_of_the_set_around_the_origin(result: RoaResult) -> None:
    """The volume of the tube's start is its own."""
    assert result.ellipsoid is not None and result.P is not None and result.tube is not None
    assert np.array_equal(result.ellipsoid[0], result.P) and result.ellipsoid[1] == result.levels.roa
    assert result.to_dict()["tube"]["volume"] != result.volume


def test_a_state_in_the_proved_set_needs_no_tube(tmp_path: Path) -> None:
    result = run(tmp_path, shipped(), {"theta": Fraction(1, 100)})
    assert result.verdict is Verdict.PROVED and result.claim == "asymptotic" and result.tube is None
    assert result.notice is not None and "lies in the proved set" in result.notice


def test_a_state_that_leaves_is_unknown(tmp_path: Path) -> None:
    """x' = x/2 - tanh(x) from 2.5: what is proved around the origin does not make the state proved."""
    result = run(tmp_path, scalar_tanh(), {"x": Fraction(5, 2)}, effort=0.06)
    assert result.verdict is Verdict.UNKNOWN and result.stop is Stop.PATH and result.tube is None
    assert result.verdict.exit_status == 3 and result.levels.roa is not None


def test_a_tube_that_the_checker_refuses_proves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A careless producer: the smaller claim is accepted, and the state is not proved."""

    def careless(*arguments: Any) -> tuple[Tube | None, str]:
        tube, why = find_path(*arguments)
        return tube and replace(tube, slabs=tuple(replace(s, duration=s.duration / 100) for s in tube.slabs)), why

    monkeypatch.setattr(enlarging, "find_path", careless)
    result = run(tmp_path, shipped(), {"theta": Fraction(26, 10), "theta_dot": Fraction(-3)})
    assert result.verdict is Verdict.UNKNOWN and result.stop is Stop.PATH
    assert "refused" in result.reason and result.claim == "asymptotic" and result.tube is None


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ({"thete": 1}, r"must name states of pendulum, theta, theta_dot; found thete"),
        ({}, r"must name states of pendulum"),
        ({"theta": Fraction(4)}, r"interior of the domain, theta between -3.14 and 3.14; found 4"),
        ({"theta": float("nan")}, r"finite numbers"),
    ],
)
def test_states_that_cannot_be(state: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        run(tmp_path, shipped(), state)


def test_a_loop_that_does_not_rest_at_the_origin_has_no_such_tube(tmp_path: Path) -> None:
    system, network = get_system("pendulum"), replace(pendulum_network(), centre="none")
    needed = "a tube from a state needs a loop whose equilibrium is the origin.*--centre preactivation"
    with pytest.raises(InputError, match=needed):
        run(tmp_path, (system, network), {"theta": Fraction(1, 10)})
