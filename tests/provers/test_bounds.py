"""Engines: what they prove is so, what is false they never prove."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from certify.certificates.verdict import Stop
from certify.effort import UNIT, Effort
from certify.errors import InputError
from certify.loop.plants import System, get_system
from certify.loop.policies import PolicyNetwork, bounded_by_form, load_policy
from certify.loop.rigorous import evaluate_policy, evaluate_vdot
from certify.lyapunov import domain_limit
from certify.lyapunov.function import Quadratic
from certify.provers.ball import models
from certify.provers.ball.local import local_margin, prove_local
from certify.provers.ball.models import paths
from certify.provers.base import Budget
from certify.provers.boxes.partition import LEAF
from certify.provers.boxes.search import prove_outwards
from certify.provers.execution import ThreadRunner
from certify.provers.falsify import Witness, _Search, confirm, falsify
from tests.support.cases import Case, case_of
from tests.support.loops import chain, pendulum_network, scalar_tanh

RUNNER = ThreadRunner()
POLICIES = Path(__file__).parents[2] / "examples" / "policies"
CURVED = Path(__file__).parents[1] / "data"  # quadrotors before they were flattened


def vdot(case: Case, x: np.ndarray) -> np.ndarray:
    loop = case.loop
    return 2 * np.sum((x @ case.P) * loop.system.function()(x, loop.policy(x)), axis=-1)


def sphere(case: Case, level: float, count: int) -> np.ndarray:
    """Points on V = level."""
    z = np.random.default_rng(0).standard_normal((count, case.loop.system.n))
    z *= np.sqrt(level) / np.linalg.norm(z, axis=1, keepdims=True)
    return z @ case.T.T


def leaves(tree: bytes, root: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """The boxes that a preorder stands for."""
    stack = [(-root, root)]
    for axis in tree:
        lo, hi = stack.pop()
        if axis == LEAF:
            yield lo, hi
            continue
        middle = 0.5 * lo[axis] + 0.5 * hi[axis]
        left, right = hi.copy(), lo.copy()
        left[axis] = right[axis] = middle
        stack += [(right, hi), (lo, left)]
    assert not stack


@pytest.mark.parametrize("name", ["scalar", "pendulum", "chain"])
def test_the_local_proof_holds_on_samples_of_every_smaller_level(name: str) -> None:
    system, network = {
        "scalar": scalar_tanh(),
        "pendulum": (get_system("pendulum"), pendulum_network()),
        "chain": chain(4, [-1, -2, -3, -4]),
    }[name]
    case = case_of(system, network)
    level = prove_local(case.problem, case.T, domain_limit(case.P, system.domain))
    assert level is not None and local_margin(case.problem, case.T, level, paths(case.loop)) > 0
    for share in (1.0, 1e-2, 1e-4):
        assert np.max(vdot(case, sphere(case, share * level, 2000))) < 0
    # The margin shrinks with the level, so smaller levels are proved as well.
    margins = [local_margin(case.problem, case.T, level * 4.0**-k, paths(case.loop)) for k in range(6)]
    assert margins == sorted(margins)


def test_the_local_proof_knows_the_scalar_plant() -> None:
    """|rem| <= x^2 sup|tanh''|/2: the proof must stop below the true limit but reach past V = 0.3."""
    case = case_of(*scalar_tanh())
    level = prove_local(case.problem, case.T, 9.0)
    assert level is not None
    assert 0.3 < level < 1.915**2


def test_the_local_proof_uses_signs_and_directions() -> None:
    """Twelve states, five layers: sums of magnitudes and one number a remainder reach 2.0e-6 here."""
    policy = load_policy(CURVED / "quadrotor3d_curved.pt")
    case = case_of(get_system("quadrotor3d"), policy.network)
    level = prove_local(case.problem, case.T, 1.0)
    assert level is not None and 4e-4 < level < 0.043  # the falsifier's limit


@pytest.mark.parametrize("limit", ["_MOST_NUMBERS", "_MOST_PRODUCTS"])
def test_a_network_too_large_for_the_local_proof_is_named(limit: str, monkeypatch: pytest.MonkeyPatch) -> None:
    case = case_of(get_system("pendulum"), pendulum_network())
    monkeypatch.setattr(models, limit, 100)
    with pytest.raises(InputError, match="too large for the local proof"):
        prove_local(case.problem, case.T, 1.0)


def test_the_ring_covers_and_holds(pendulum: System) -> None:
    case = case_of(pendulum, pendulum_network())
    limit = domain_limit(case.P, pendulum.domain) * (1 - 1e-9)
    inner = prove_local(case.problem, case.T, limit)
    assert inner is not None
    proof = prove_outwards(case.problem, case.T, inner, limit, Budget(), RUNNER)
    assert (proof.outer, proof.stop) == (limit, Stop.REQUESTED)
    boxes = list(leaves(proof.tree, proof.root))
    assert len(boxes) == proof.leaves
    volume = sum(np.prod(hi - lo) for lo, hi in boxes)
    assert volume == pytest.approx(np.prod(2 * proof.root), rel=1e-12)
    for share in np.geomspace(inner / limit, 1.0, 20):
        assert np.max(vdot(case, sphere(case, share * limit, 500))) < 0


def test_the_ring_is_deterministic(pendulum: System) -> None:
    case = case_of(pendulum, pendulum_network((8, 8)))
    first, second = (prove_outwards(case.problem, case.T, 1e-4, 0.2, Budget(), RUNNER) for _ in range(2))
    assert first.tree == second.tree and first.outer == second.outer


def test_budgets_stop_the_pass_with_what_is_proved_so_far(pendulum: System) -> None:
    case = case_of(pendulum, pendulum_network())
    small = prove_outwards(case.problem, case.T, 1e-6, 6.0, Budget(boxes=60, batch=16), RUNNER)
    assert small.stop is Stop.BOXES and 1e-6 <= small.outer < 6.0
    large = prove_outwards(case.problem, case.T, 1e-6, 6.0, Budget(boxes=10_000, batch=16), RUNNER)
    assert large.stop is Stop.REQUESTED and large.outer == 6.0
    timed = prove_outwards(case.problem, case.T, 1e-6, 6.0, Budget(Effort(1e-09 * UNIT), batch=4), RUNNER)
    assert timed.stop is Stop.EFFORT and timed.outer < 6.0
    nothing = prove_outwards(case.problem, case.T, 1.0, 6.0, Budget(Effort(1e-09 * UNIT)), RUNNER)
    assert (nothing.stop, nothing.outer, nothing.tree, nothing.leaves) == (Stop.EFFORT, 1.0, bytes([LEAF]), 1)


def test_a_level_beyond_the_truth_is_capped_by_a_witness() -> None:
    case = case_of(*scalar_tanh())
    proof = prove_outwards(case.problem, case.T, 0.5, 8.0, Budget(), RUNNER)
    assert proof.stop in (Stop.WITNESS, Stop.SMALL)
    assert 0.9 * 1.915008**2 < proof.outer < 1.9150081**2


def test_the_falsifier_finds_the_known_limit() -> None:
    case = case_of(*scalar_tanh())
    witness = falsify(case.problem, case.T, 9.0)
    assert witness is not None and witness.kind == "vdot"
    assert 1.915008**2 <= witness.level <= 1.915009**2
    assert confirm(case.problem, witness)
    assert falsify(case.problem, case.T, 1.915**2) is None


def test_a_wrong_witness_is_not_confirmed() -> None:
    case = case_of(*scalar_tanh())
    assert not confirm(case.problem, Witness(np.array([1.9]), 1.9**2, "vdot"))
    assert not confirm(case.problem, Witness(np.zeros(1), 0.0, "vdot"))
    assert not confirm(case.problem, Witness(np.array([1.0]), 1.0, "input"))


def test_inputs_that_leave_their_bounds_are_found(pendulum: System) -> None:
    """Centred at the output, the input can pass 6 N m."""
    case = case_of(pendulum, pendulum_network(centre="output"))
    assert not bounded_by_form(case.loop.network, pendulum.input_bounds)
    witness = falsify(case.problem, case.T, domain_limit(case.P, pendulum.domain))
    assert witness is not None and confirm(case.problem, witness)
    if witness.kind == "input":  # just outside 6 N m, too close for binary64 to tell
        assert abs(evaluate_policy(case.loop, witness.x)[0]) > 6


def planted(seed: int) -> tuple[Case, np.ndarray]:
    """A stabilising policy with a narrow bump in the input, and the state at which it makes Vdot positive."""
    generator = np.random.default_rng(seed)
    system = get_system("pendulum")
    K, width = np.array([2.8, 0.95]), 6 * 10.0 ** generator.uniform(-3, -0.5)
    angle = generator.uniform(0, 2 * np.pi)
    place = np.array([1.2 * np.cos(angle), 6.0 * np.sin(angle)]) * generator.uniform(0.4, 1.0)
    if abs(place[1]) < 1:
        place[1] = np.copysign(1.0, place[1])
    normal = np.array([1.0, 0.2]) / np.hypot(1.0, 0.2)
    steep, at = 6 / width, normal @ place
    # tanh(-Kx/6) passes through one near-linear neuron; two steep neurons make the bump.
    first = np.array([-K / 600, steep * normal, steep * normal])
    bias = np.array([0.0, -steep * (at - width / 2), -steep * (at + width / 2)])
    height = np.copysign(0.75, place[1])
    network = PolicyNetwork.of_layers(
        (first, np.array([[100.0, height, -height]])), (bias, np.zeros(1)), np.array([6.0]), np.zeros(1)
    )
    return case_of(system, network), place


def _check_planted(seed: int) -> bool:
    try:
        case, place = planted(seed)
    except InputError:  # the bump reaches the origin and makes it unstable
        return False
    level = float(place @ case.P @ place)
    limit = domain_limit(case.P, case.loop.system.domain)
    if not (evaluate_vdot(case.loop, case.P, place) > 0 and level < limit):
        return False  # nothing false was planted: this seed does not count
    inner = prove_local(case.problem, case.T, level)
    if inner is not None:
        proof = prove_outwards(case.problem, case.T, inner, min(1.5 * level, limit), Budget(boxes=20_000), RUNNER)
        assert proof.outer < level
    return True


def test_planted_counterexamples_are_never_proved() -> None:
    assert sum(_check_planted(seed) for seed in range(10)) >= 5


@pytest.mark.slow
def test_many_planted_counterexamples_are_never_proved() -> None:
    assert sum(_check_planted(seed) for seed in range(10, 450)) >= 210


def test_an_asymmetric_P_is_named() -> None:
    with pytest.raises(InputError, match=r"P\[0, 1\] = 0.25 but P\[1, 0\] = 0.26"):
        Quadratic(np.array([[1.0, 0.25], [0.26, 1.0]]))


@pytest.mark.parametrize("kind", ["plain", "clip", "held", "rate"])
def test_the_falsifier_knows_where_a_violation_grows(kind: str, pendulum: System) -> None:
    """Its gradients against central differences of what it climbs on."""
    system = pendulum.with_sample((Fraction(1, 100), Fraction(1, 50))) if kind == "held" else pendulum
    network = pendulum_network(centre="output")
    if kind == "clip":
        network = replace(network, clip=(np.array([-1.0]), np.array([1.5])))
    case = case_of(system, network)
    problem = replace(case.problem, rate=0.3) if kind == "rate" else case.problem
    search = _Search(problem, case.T)
    z = np.random.default_rng(0).standard_normal((200, 2))
    vdot, excess, *gradients = search._slopes(z)
    assert np.array_equal(vdot, search.violation(z)[0]) and np.array_equal(excess, search.violation(z)[1])
    for k, gradient in enumerate(gradients):
        for axis in range(2):
            apart = 1e-5 * np.eye(2)[axis]
            wanted = (search.violation(z + apart)[k] - search.violation(z - apart)[k]) / 2e-5
            near = np.abs(gradient[:, axis] - wanted) <= 1e-4 * (1 + np.abs(wanted))
            assert near.mean() > 0.97  # but for what lies on a corner of the clip or of a maximum
            assert np.abs(wanted).max() > 1e-3
